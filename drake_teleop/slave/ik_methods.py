"""The ways from a commanded pose to joint positions that a station may take."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import LeafSystem

from drake_teleop.slave.arm import ArmModel
from drake_teleop.slave.inverse_kinematics import InverseKinematics
from drake_teleop.slave.numeric_inverse_kinematics import NumericInverseKinematics

METHODS: dict[str, Callable[[ArmModel, NDArray[np.float64], float], LeafSystem]] = {
    "closed_form": lambda arm, q_start, period: InverseKinematics(arm.lower, arm.upper),
    "numeric": NumericInverseKinematics,
}
"""Systems with the ports of `InverseKinematics`, made of the arm, (n,) where it starts [rad] and
the period of commands [s], by name: a line here enters one."""
