"""Closed-form inverse kinematics of the Staubli RX90 (Pieper 1968).

At q = 0 the arm points up and S is parallel to W. The wrist centre is at the height z above the
shoulder and at the distance rho from the first axis, negative behind it. Arm lengths are l2, l3:

    rho = -(l2 sin q2 + l3 sin(q2 + q3)),   z = l2 cos q2 + l3 cos(q2 + q3),
    R_WS = Rz(q1) Ry(-q2 - q3) Rz(q4) Ry(-q5) Rz(q6)."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from drake_teleop.common.blocks import NO_EXTRA_SLOTS, are_valid_port_values, weak_callback
from drake_teleop.common.compiled import njit
from drake_teleop.common.numeric import Array
from drake_teleop.common.vectors import copy_into
from drake_teleop.station.slave.arm import IS_PRISMATIC_COLUMN, ArmModel, forward_kinematics

#: Base to shoulder [m]; shoulder to elbow [m].
SHOULDER_HEIGHT_M, UPPER_ARM_LENGTH_M = 0.420, 0.450
#: Elbow to wrist centre [m]; wrist centre to the origin of S, along z_S [m].
FOREARM_LENGTH_M, WRIST_TO_S_M = 0.450, 0.085

# Distance of the wrist from the first axis, and sin q5, below which the arm is singular.
_MAX_SINGULAR_DISTANCE_M, _MAX_SINGULAR_SIN_Q5 = 1e-9, 1e-9
# Tolerance of a joint limit [rad]; the angle is clipped to the limit.
_JOINT_LIMIT_TOLERANCE_RAD = 1e-9


class IkStatus(IntEnum):
    """Status of an inverse kinematics solution near a reference posture.

    Members are described for the closed form. The numeric method reports a singularity only for a
    missed pose: WRIST_SINGULAR if the last three axes are nearly coplanar, else SHOULDER_SINGULAR.
    With fewer than 6 joints: WRIST_SINGULAR, or OUT_OF_REACH for position errors above 1 mm.
    """

    OK = 0
    """The pose is met."""
    WRIST_SINGULAR = 1
    """The pose is met; axes 4 and 6 are aligned: q4 is that of the reference, q6 adds the rest."""
    SHOULDER_SINGULAR = 2
    """The pose is met; the wrist centre is on the first axis: q1 is that of the reference."""
    OUT_OF_REACH = 3
    """The orientation is met; the wrist centre moves towards the shoulder into reach."""
    JOINT_LIMIT = 4
    """Each branch violates a joint limit: the reference is held, clipped to the limits."""
    BAD_POSE = 5
    """The pose is not finite, beyond 1e6 m, or has a zero quaternion: the reference is held, within
    limits. With an invalid reference the result is invalid."""
    SPEED_LIMIT = 6
    """The pose is not met yet: a joint moves at its speed limit."""


# Compiled code requires plain integers.
_OK, _WRIST_SINGULAR, _SHOULDER_SINGULAR, _OUT_OF_REACH, *_others = map(int, IkStatus)
_JOINT_LIMIT, _BAD_POSE, _ = _others


@njit(cache=True)
def _solve_all_branches_into(R: Array, p: Array, q1_kept: float, q4_kept: float, q: Array) -> int:
    """Write all eight solutions for S at R, p to the rows of q (8, 6); return the `IkStatus`.

    Row ``4 a + 2 b + c``: a = 1 reaches backwards over the first axis, b = 1 has q3 <= 0, c = 1 has
    q5 <= 0. A wrist centre out of reach is replaced by the nearest reachable one. At a singularity
    of shoulder or wrist, `q1_kept` or `q4_kept` replaces the undetermined angle.
    """
    status = _OK
    x = p[0] - WRIST_TO_S_M * R[0, 2]
    y = p[1] - WRIST_TO_S_M * R[1, 2]
    z = p[2] - WRIST_TO_S_M * R[2, 2] - SHOULDER_HEIGHT_M
    reach = UPPER_ARM_LENGTH_M + FOREARM_LENGTH_M
    inner_reach = abs(UPPER_ARM_LENGTH_M - FOREARM_LENGTH_M)
    distance = np.sqrt(x * x + y * y + z * z)
    if distance > reach or distance < inner_reach:
        scale = (reach if distance > reach else inner_reach) / distance
        x, y, z = scale * x, scale * y, scale * z
        distance *= scale
        status = _OUT_OF_REACH
    rho = np.sqrt(x * x + y * y)
    if rho < _MAX_SINGULAR_DISTANCE_M:
        q1_front = q1_kept
        status = max(status, _SHOULDER_SINGULAR)
    else:
        q1_front = np.arctan2(y, x)
    # The half-angle form is accurate where the arm is nearly stretched.
    stretched = max((reach - distance) * (reach + distance), 0.0)
    folded = max((distance - inner_reach) * (distance + inner_reach), 0.0)
    q3_up = 2.0 * np.arctan2(np.sqrt(stretched), np.sqrt(folded))
    for a in range(2):
        q1 = q1_front + a * np.pi
        c1, s1 = np.cos(q1), np.sin(q1)
        for b in range(2):
            q3 = q3_up if b == 0 else -q3_up
            to_wrist = np.arctan2(-rho if a == 0 else rho, z)
            along = UPPER_ARM_LENGTH_M + FOREARM_LENGTH_M * np.cos(q3)
            q2 = to_wrist - np.arctan2(FOREARM_LENGTH_M * np.sin(q3), along)
            c, s = np.cos(q2 + q3), np.sin(q2 + q3)
            # M = Ry(q2 + q3) Rz(-q1) R = Rz(q4) Ry(-q5) Rz(q6)
            u = c1 * R[0, 2] + s1 * R[1, 2]
            m02 = c * u + s * R[2, 2]
            m12 = c1 * R[1, 2] - s1 * R[0, 2]
            m22 = c * R[2, 2] - s * u
            m10 = c1 * R[1, 0] - s1 * R[0, 0]
            m11 = c1 * R[1, 1] - s1 * R[0, 1]
            m00 = c * (c1 * R[0, 0] + s1 * R[1, 0]) + s * R[2, 0]
            m01 = c * (c1 * R[0, 1] + s1 * R[1, 1]) + s * R[2, 1]
            sin_q5 = np.sqrt(m02 * m02 + m12 * m12)
            q4_up = q4_kept if sin_q5 < _MAX_SINGULAR_SIN_Q5 else np.arctan2(-m12, -m02)
            q5_up = np.arctan2(sin_q5, m22)
            # q6 depends on q4, so that an inexact q4 near the singularity cancels.
            c4, s4 = np.cos(q4_up), np.sin(q4_up)
            q6_up = np.arctan2(c4 * m10 - s4 * m00, c4 * m11 - s4 * m01)
            for w in range(2):
                row = 4 * a + 2 * b + w
                q[row, 0], q[row, 1], q[row, 2] = q1, q2, q3
                q[row, 3] = q4_up + w * np.pi
                q[row, 4] = q5_up if w == 0 else -q5_up
                q[row, 5] = q6_up + w * np.pi
    return status


@njit(cache=True)
def _wrap_angle_into_limits(angle: float, near: float, lower: float, upper: float) -> float:
    """Return the angle plus whole turns, nearest to `near` within the limits, or NaN if none is."""
    full_turn = 2.0 * np.pi
    angle += full_turn * np.round((near - angle) / full_turn)
    if angle > upper + _JOINT_LIMIT_TOLERANCE_RAD:
        angle -= full_turn * np.ceil((angle - upper - _JOINT_LIMIT_TOLERANCE_RAD) / full_turn)
    if angle < lower - _JOINT_LIMIT_TOLERANCE_RAD:
        angle += full_turn * np.ceil((lower - _JOINT_LIMIT_TOLERANCE_RAD - angle) / full_turn)
    if angle > upper + _JOINT_LIMIT_TOLERANCE_RAD:
        return np.nan
    return min(max(angle, lower), upper)


@njit(cache=True)
def _nearest_branch_into(
    R: Array, p: Array, reference: Array, lower: Array, upper: Array, max_step: float, q: Array
) -> int:
    if not np.isfinite(reference.sum()):
        q[:] = np.nan
        return _BAD_POSE
    for i in range(6):
        q[i] = min(max(reference[i], lower[i]), upper[i])
    if not (np.isfinite(R.sum()) and are_valid_port_values(p)):
        return _BAD_POSE
    branches = np.empty((8, 6))
    status = _solve_all_branches_into(R, p, reference[0], reference[3], branches)
    best = -1
    best_distance = np.inf
    for row in range(8):
        distance = 0.0
        for i in range(6):
            angle = _wrap_angle_into_limits(branches[row, i], reference[i], lower[i], upper[i])
            step = abs(angle - reference[i])
            # A nan (outside the limits) also gives inf.
            distance += step * step if step <= max_step else np.inf
            branches[row, i] = angle
        if distance < best_distance:
            best, best_distance = row, distance
    if best < 0:
        return _JOINT_LIMIT
    copy_into(q, 0, branches[best], 0, 6)
    if abs(np.sin(q[4])) < _MAX_SINGULAR_SIN_Q5:
        status = max(status, _WRIST_SINGULAR)
    return status


@njit(cache=True)
def solve_pose_command(
    pose: Array, reference: Array, lower: Array, upper: Array, max_step: float, q: Array
) -> int:
    """Write the solution nearest to `reference` for X_WS (7,) to q (6,); return `IkStatus`."""
    w, x, y, z = pose[0], pose[1], pose[2], pose[3]
    norm = w * w + x * x + y * y + z * z
    k = 2.0 / norm if norm > 0.0 else np.nan
    R = np.empty((3, 3))
    R[0, 0], R[0, 1], R[0, 2] = 1 - k * (y * y + z * z), k * (x * y - w * z), k * (x * z + w * y)
    R[1, 0], R[1, 1], R[1, 2] = k * (x * y + w * z), 1 - k * (x * x + z * z), k * (y * z - w * x)
    R[2, 0], R[2, 1], R[2, 2] = k * (x * z - w * y), k * (y * z + w * x), 1 - k * (x * x + y * y)
    return _nearest_branch_into(R, pose[4:7], reference, lower, upper, max_step, q)


def nearest_branch(
    R_WS: Array,
    p_WS: Array,
    q_reference: Array,
    lower: Array,
    upper: Array,
    max_step: float = np.inf,
) -> tuple[Array, IkStatus]:
    """Return the solution within the limits nearest to a reference (6,) [rad], and the `IkStatus`.

    Solutions with a joint over `max_step` [rad] from the reference are discarded. A wrist centre
    out of reach is replaced by the nearest one in reach. Without a solution, the clipped reference
    is returned.
    """
    q = np.empty(6)
    # Drake's matrices are stored by columns; one layout avoids a second compilation.
    R = np.ascontiguousarray(R_WS)
    status = _nearest_branch_into(R, p_WS, q_reference, lower, upper, max_step, q)
    return q, IkStatus(status)


def has_closed_form(arm: ArmModel) -> bool:
    if arm.num_joints != 6 or arm.table[:, IS_PRISMATIC_COLUMN].any():
        return False
    R_WS, p_WS, endless = np.empty((3, 3)), np.empty(3), np.full(6, np.inf)
    for q in ([0.3, -0.5, -1.1, 0.7, 0.9, -0.4], [-1.0, 0.6, 1.3, -0.8, 0.5, 1.2]):
        forward_kinematics(arm.table, np.array(q), R_WS, p_WS)
        found, _ = nearest_branch(R_WS, p_WS, np.array(q), -endless, endless)
        if not np.allclose(found, q, rtol=0.0, atol=1e-9):
            return False
    return True


class InverseKinematics(LeafSystem):
    """Block that converts a commanded pose to joint positions in closed form.

    If each solution violates a joint limit or is over 2 rad from the measured positions, it outputs
    these, clipped to the limits.

    .. pydrake_system::

        name: InverseKinematics
        input_ports:
        - pose_command: (7,) X_WS
        - joint_position: (n,) measured positions [rad]
        output_ports:
        - joint_command: (n,) solution nearest to joint_position [rad]
        - ik_status: an `IkStatus`
    """

    __slots__ = NO_EXTRA_SLOTS

    MAX_JOINT_JUMP_RAD = 2.0
    """Largest joint displacement [rad]; joints 4 and 6 may need 90 degrees past q5 = 0."""

    def __init__(self, lower: Array, upper: Array) -> None:
        super().__init__()
        self._lower = np.array(lower, dtype=np.float64)
        self._upper = np.array(upper, dtype=np.float64)
        self._pose = self.DeclareVectorInputPort("pose_command", 7)
        self._position = self.DeclareVectorInputPort("joint_position", 6)
        inputs = {self.all_input_ports_ticket()}
        self.DeclareVectorOutputPort("joint_command", 6, weak_callback(self._calc_command), inputs)
        self.DeclareVectorOutputPort("ik_status", 1, weak_callback(self._calc_status), inputs)

    def _solve_command(self, context: Context, q: np.ndarray) -> int:
        inputs = self._pose.Eval(context), self._position.Eval(context)
        limits = self._lower, self._upper, self.MAX_JOINT_JUMP_RAD
        return solve_pose_command(*inputs, *limits, q)

    def _calc_command(self, context: Context, output: BasicVector) -> None:
        self._solve_command(context, output.get_mutable_value())

    def _calc_status(self, context: Context, output: BasicVector) -> None:
        output[0] = self._solve_command(context, np.empty(6))
