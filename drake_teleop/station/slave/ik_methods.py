"""The ways from a commanded pose to joint positions that a station may take."""

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
"""The closed form for an arm that has it, numeric for others."""

METHODS: dict[str, Callable[[ArmModel, NDArray[np.float64], float], LeafSystem]] = {
    "closed_form": lambda arm, q_start, period: InverseKinematics(arm.lower, arm.upper),
    "numeric": NumericInverseKinematics,
}
"""Systems with the ports of `InverseKinematics`, made of the arm, (n,) where it starts [rad] and
the period of commands [s], by name: a line here enters one."""


def method_of(name: str, arm: ArmModel) -> str:
    """Which of `METHODS` a scenario means.

    Args:
        name: one of them, or `AUTOMATIC`.
        arm: whose joints are to be moved.

    Raises:
        DrakeTeleopError: for the closed form of an arm that has none.
    """
    if name == AUTOMATIC:
        return "closed_form" if has_closed_form(arm) else "numeric"
    if name == "closed_form" and not has_closed_form(arm):
        raise DrakeTeleopError(
            "the closed form is that of an RX90 whose base stands at the world's origin",
            where="slave.inverse_kinematics",
            remedy=f"set it to {AUTOMATIC} or numeric",
        )
    return name
