"""What may be wrong with the numbers in the loop: the signals `fault` and `fault_at_hand`.

A fault is a number that cannot be: not finite, larger than anything here, or of long ago. Nothing
is displayed that was made of one (`passivity.safe_state`, docs/station.md).
"""

from __future__ import annotations

from enum import IntEnum

from drake_teleop.common.compiled import njit

#: What is larger is no force, torque, length, angle or speed of this station, in SI units.
LARGEST = 1e6


class Fault(IntEnum):
    """Causes, in the order in which they are asked for."""

    NONE = 0
    STALE = 1
    READING = 2
    JOINTS = 3
    LOAD = 4
    WRENCH = 5
    HAND = 6
    RESUMING = 7


MEANINGS = {
    Fault.STALE: "the wrist sensor's last sample is too old, or of another time",
    Fault.READING: "the wrist sensor gives no reading, or one that no sensor survives",
    Fault.JOINTS: "the slave's joint angles are no numbers",
    Fault.LOAD: "the load estimate is no number",
    Fault.WRENCH: "the wrench that comes to the hand is none",
    Fault.HAND: "the hand's joint angles are no numbers",
    Fault.RESUMING: "the force at the hand comes back after a fault",
}
"""In words, for warnings."""


@njit(cache=True)
def sound(numbers):
    """Whether each of them is finite and no larger than `LARGEST`."""
    good = True
    for x in numbers:
        good = good and abs(x) <= LARGEST
    return good
