"""Start posture of the arm, by default with the tool down."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pydrake.math import RotationMatrix

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.station.slave.arm import IS_PRISMATIC_COLUMN, ArmModel, holding_torque
from drake_teleop.station.slave.arm_from_plant import values_per_joint
from drake_teleop.station.slave.inverse_kinematics import IkStatus, has_closed_form, nearest_branch
from drake_teleop.station.slave.joint_control import mass_matrix
from drake_teleop.station.slave.numeric_inverse_kinematics import find_posture
from drake_teleop.station.slave.slave_config import Slave

# Smallest eigenvalue of a valid mass matrix [kg m^2]: a grain of sand at an arm's length.
_MIN_MASS_MATRIX_EIGENVALUE_KG_M2 = 1e-9
#: Orientation of S at home: the tool points down, x_S along x_W.
R_WS_HOME = RotationMatrix(np.diag([1.0, -1.0, -1.0]))
_SEARCH_TO_JOINT_RANGE_RATIOS = (0.7, 0.9, 1.0)  # about the middles of the ranges
#: Elbow up, reaching forward [rad]; home is the branch nearest to it.
_ELBOW_UP_POSTURE_RAD = np.array([0.0, -0.5, -1.8, 0.0, -0.9, np.pi])


def solve_start_posture(
    arm: ArmModel, position: Array, R_WS: RotationMatrix = R_WS_HOME
) -> tuple[Array, IkStatus]:
    """Return q (n,) [rad, m] with S at the pose `R_WS`, `position` [m], and the `IkStatus`."""
    if has_closed_form(arm):
        return nearest_branch(R_WS.matrix(), position, _ELBOW_UP_POSTURE_RAD, arm.lower, arm.upper)
    pose = np.array([*R_WS.ToQuaternion().wxyz(), *position])
    middle = arm.middle_positions
    for share in _SEARCH_TO_JOINT_RANGE_RATIOS:
        lower, upper = (middle + share * (limit - middle) for limit in (arm.lower, arm.upper))
        q, status = find_posture(replace(arm, lower=lower, upper=upper), pose, middle)
        if status == IkStatus.OK:
            break
    return q, status


def home_posture(arm: ArmModel, position: list[float]) -> Array:
    q, status = solve_start_posture(arm, np.array(position))
    if status != IkStatus.OK:
        what = f"the arm cannot reach {position} with the tool down ({IkStatus(status).name})"
        remedy = "change it, or give joint positions of a reachable posture in slave.home"
        if has_closed_form(arm):
            remedy = "choose a position nearer to (0.55, 0, 0.45)"
        raise DrakeTeleopError(what, where="slave.position", remedy=remedy)
    return q


def find_start_posture(slave: Slave, arm: ArmModel) -> Array:
    if not slave.home:
        return home_posture(arm, slave.position)
    q = values_per_joint(arm, slave.home, "slave.home")
    outside = (q < arm.lower) | (q > arm.upper)
    if outside.any():
        k = int(outside.argmax())
        limits = f"{arm.lower[k]:.4g} to {arm.upper[k]:.4g}"
        what = f"joint {arm.joint_names[k]} at {q[k]:g} is outside its limits, {limits}"
        raise DrakeTeleopError(what, where="slave.home", remedy="give a position within them")
    return q


def check_inertia_and_holding_torque(arm: ArmModel, q: Array) -> None:
    """Raise DrakeTeleopError if the mass matrix is singular or a motor cannot hold posture q."""
    if not np.linalg.eigvalsh(mass_matrix(arm, q))[0] > _MIN_MASS_MATRIX_EIGENVALUE_KG_M2:
        what = "the mass matrix is singular: the links have too little inertia"
        remedy = "give masses and inertias of the links, or rotor inertias of the joints"
        raise DrakeTeleopError(what, where="slave.model", remedy=remedy)
    torque = holding_torque(arm, q)
    k = int((np.abs(torque) / arm.effort_limit).argmax())
    needed, limit, name = abs(torque[k]), arm.effort_limit[k], arm.joint_names[k]
    if needed > limit:
        unit = "N" if arm.table[k, IS_PRISMATIC_COLUMN] else "N m"
        needs = f"{name} needs {needed:.3g} {unit}, but its limit is {limit:.3g} {unit}"
        what = f"the arm cannot hold its {arm.phi_load[0]:.3g} kg at the start: {needs}"
        remedy = "give a lighter tool or payload, start nearer to the base, or set"
        remedy = f"{remedy} slave.torque_limits if the model's limits are wrong"
        raise DrakeTeleopError(what, where="slave.tool", remedy=remedy)
