"""Invalid numbers in the control loop: the signals `fault` and `fault_at_hand`.

Forces computed from invalid, too large or too old numbers are not displayed (docs/station.md).
"""

from __future__ import annotations

from enum import IntEnum

from drake_teleop.common.compiled import njit

#: Maximum magnitude of any force, torque, length, angle or speed of a station, in SI units.
LARGEST = 1e6


class Fault(IntEnum):
    """Causes, by priority."""

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
"""Texts for warnings."""


@njit(cache=True)
def sound(numbers):
    """Return whether all magnitudes are finite and at most `LARGEST`."""
    good = True
    for x in numbers:
        good = good and abs(x) <= LARGEST
    return good
