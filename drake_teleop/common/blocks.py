"""Weak callbacks, base class, fault codes and value range for Drake systems."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from enum import IntEnum
from typing import Any, NoReturn

from drake_teleop.common.compiled import njit
from drake_teleop.common.errors import DrakeTeleopError

NO_EXTRA_SLOTS: tuple[str, ...] = ()
"""`__slots__` of a system; its attributes are in the `__dict__` of the bound class."""


def weak_callback(method: Any) -> Callable[..., None]:
    """Return a callback that calls a system's method but does not keep the system alive."""
    system, function = weakref.ref(method.__self__), method.__func__

    def call_method(context: Any, output: Any) -> None:
        function(system(), context, output)

    return call_method


class DoubleOnlySystem:
    """Base class of Drake systems for double only; ToAutoDiffXd and ToSymbolic raise an error."""

    __slots__ = NO_EXTRA_SLOTS

    def _refuse_scalar_conversion(self, *_: Any) -> NoReturn:
        what = "has no AutoDiffXd or symbolic version: compiled code is for double only"
        remedy = "use NonContactWrench or WrenchScaling, or linearize numerically"
        raise DrakeTeleopError(what, where=type(self).__name__, remedy=remedy)

    ToAutoDiffXd = ToSymbolic = _refuse_scalar_conversion


#: Maximum magnitude of any force, torque, length, angle or speed of a station, in SI units.
LARGEST_PORT_VALUE = 1e6


class Fault(IntEnum):
    """Codes of faults that suppress the force at the hand; the lowest active code is reported."""

    NONE = 0
    OLD_SAMPLE = 1
    BAD_READING = 2
    SLAVE_JOINTS = 3
    INVALID_LOAD = 4
    HAND_WRENCH = 5
    HAND_JOINTS = 6
    RESUMING = 7


_PORT_VALUE_OUT_OF_RANGE_TEXT = f"not finite or above {LARGEST_PORT_VALUE:g} in SI units"
FAULT_WARNINGS = {
    Fault.OLD_SAMPLE: "the wrist sensor's last sample is more than 50 ms and two periods from now",
    Fault.BAD_READING: "the wrist sensor gives no reading, or one beyond its valid range",
    Fault.SLAVE_JOINTS: f"the slave's joint angles are {_PORT_VALUE_OUT_OF_RANGE_TEXT}",
    Fault.INVALID_LOAD: f"the load estimate is {_PORT_VALUE_OUT_OF_RANGE_TEXT}",
    Fault.HAND_WRENCH: f"the wrench for the hand is {_PORT_VALUE_OUT_OF_RANGE_TEXT}",
    Fault.HAND_JOINTS: f"the hand's joint angles are {_PORT_VALUE_OUT_OF_RANGE_TEXT}",
    Fault.RESUMING: "the force at the hand increases again after a fault",
}
"""Warning text by fault."""


@njit(cache=True)
def are_valid_port_values(numbers):
    """Return whether all numbers are finite and at most `LARGEST_PORT_VALUE` in magnitude."""
    good = True
    for x in numbers:
        good = good and abs(x) <= LARGEST_PORT_VALUE
    return good
