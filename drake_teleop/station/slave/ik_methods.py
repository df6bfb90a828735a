"""Inverse kinematics methods by name."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import LeafSystem

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.station.slave.arm import ArmModel
from drake_teleop.station.slave.inverse_kinematics import InverseKinematics, has_closed_form
from drake_teleop.station.slave.numeric_inverse_kinematics import NumericInverseKinematics

AUTOMATIC = "automatic"
"""Name that selects the closed form where it exists, otherwise the numeric method."""

METHODS: dict[str, Callable[[ArmModel, NDArray[np.float64], float], LeafSystem]] = {
    "closed_form": lambda arm, q_start, period: InverseKinematics(arm.lower, arm.upper),
    "numeric": NumericInverseKinematics,
}
"""Constructors by name, called with the arm, its start (n,) [rad] and the period [s]; the systems
have the ports of `InverseKinematics`."""


def ik_method_name(name: str, arm: ArmModel) -> str:
    """Return the key in `METHODS` for `name`; raise DrakeTeleopError without a closed form."""
    if name == AUTOMATIC:
        return "closed_form" if has_closed_form(arm) else "numeric"
    if name == "closed_form" and not has_closed_form(arm):
        raise DrakeTeleopError(
            "the closed form is that of an RX90 whose base stands at the world's origin",
            where="slave.inverse_kinematics",
            remedy=f"set it to {AUTOMATIC} or numeric",
        )
    return name
