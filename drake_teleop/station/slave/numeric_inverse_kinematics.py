"""Numeric inverse kinematics of any serial arm within limits of position and speed.

Levenberg-Marquardt steps minimize ``e = [p_WS* - p_WS; L log(R_WS* R_SW)]`` with the length L of
`orientation_weight_m`. Joints that the error pushes against a limit are fixed (active set). If the
smallest singular value sigma of the Jacobian (rotation rows times L) is below
``s = MIN_SINGULAR_VALUE_M``, `follow_pose` adds damping ``lambda^2 = s^2 - sigma^2`` (Chiaverini,
Siciliano, Egeland 1994)."""

from __future__ import annotations

import numpy as np
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from drake_teleop.common import vectors
from drake_teleop.common.blocks import NO_EXTRA_SLOTS, are_valid_port_values, weak_callback
from drake_teleop.common.compiled import njit
from drake_teleop.common.numeric import Array
from drake_teleop.station.slave.arm import (
    IS_PRISMATIC_COLUMN,
    PHI_COLUMN,
    TRANSLATION_COLUMN,
    ArmModel,
    jacobian_and_pose,
)
from drake_teleop.station.slave.inverse_kinematics import IkStatus

POSE_TOLERANCE_M = 1e-8
"""Largest error of position [m] and orientation [rad] at which a pose counts as met."""

_MAX_POSE_ROUNDING_ERROR_M = 1e-14  # largest error that is rounding only [m]
MIN_SINGULAR_VALUE_M = 5e-3
"""Singular value of the Jacobian below which motion is damped [m]."""
MAX_SOLVER_STEPS_PER_COMMAND = 10
"""Maximum number of Levenberg-Marquardt steps per command; two or three are typical."""
# Minimum damping of a step [m^2], which keeps redundant joints at rest.
_MIN_STEP_DAMPING_M2 = 1e-14
# Initial damping divided by the squared error; `find_posture`: steps per start, and starts.
_INITIAL_RELATIVE_DAMPING, _NUM_STEPS_PER_SEARCH_START, _NUM_SEARCH_STARTS = 1e-3, 100, 100
# Ratio |J^T e| / |e| below which the gradient counts as zero [m].
_MIN_GRADIENT_TO_ERROR_RATIO_M = 1e-3
# Error below which out of reach and singular are indistinguishable [m].
_MIN_OUT_OF_REACH_ERROR_M = 5e-6
# The same for `find_posture`, which stops the search earlier [m].
_MIN_OUT_OF_REACH_SEARCH_ERROR_M = 1e-3
# The same for the position [m] of an arm with fewer than 6 joints, which always misses a part of
# the orientation. 1 mm is visible at the tool, and about the repeatability of small arms.
_MIN_OUT_OF_REACH_ERROR_BELOW_6_DOF_M = 1e-3
# Largest joint displacement to escape from a singularity [rad, m].
_MAX_SINGULARITY_ESCAPE_RAD_OR_M, _SEARCH_SINGULARITY_ESCAPE_RAD_OR_M = 0.05, 0.3
# Triple product of the last three axes below which the wrist is singular.
_MAX_COPLANAR_WRIST_TRIPLE_PRODUCT = 0.1

_STATUS_OK, _WRIST_SINGULAR, _SHOULDER_SINGULAR, _OUT_OF_REACH, *_others = map(int, IkStatus)
_JOINT_LIMIT, _BAD_POSE, _SPEED_LIMIT = _others


@njit(cache=True)
def _pose_error_into(table, L, pose, q, x, J, e, Jt_e):
    """Write Jacobian J (6, n), pose error e (6,) and `Jt_e` = J^T e (n,) at q; return |e|^2.

    Rotational rows of J and e are multiplied by L [m]; x (21,) is scratch memory.
    """
    jacobian_and_pose(table, q, J, x)
    a = vectors.normalized_quaternion(vectors.quaternion_at(pose, 0))
    inverse = vectors.conjugate_quaternion(vectors.quaternion_of_matrix(x[12:].reshape(3, 3)))
    turn = vectors.quaternion_logarithm(vectors.quaternion_product(a, inverse))
    squared = 0.0
    for i in range(3):
        e[i] = pose[4 + i] - x[9 + i]
        e[3 + i] = L * turn[i]
        squared += e[i] * e[i] + e[3 + i] * e[3 + i]
        for k in range(q.shape[0]):
            J[3 + i, k] *= L
    for k in range(q.shape[0]):
        Jt_e[k] = 0.0
        for i in range(6):
            Jt_e[k] += J[i, k] * e[i]
    return squared


@njit(cache=True)
def _gram_matrix_of_size_into(J, H):
    """Write J^T J or J J^T to H (m, m), whichever has this size."""
    n = H.shape[0]
    A = J if n == J.shape[1] else J.T
    for i in range(n):
        for k in range(i + 1):
            value = 0.0
            for m in range(A.shape[0]):
                value += A[m, i] * A[m, k]
            H[i, k] = H[k, i] = value


@njit(cache=True)
def _find_smallest_eigenpair(H, u):
    m = H.shape[0]
    M = np.empty((m, m))
    for i in range(m):
        u[i] = 0.5 + (0.618 * (i + 1)) % 1.0
    growth = 1.0
    for _ in range(3):
        M[:] = H
        for i in range(m):
            M[i, i] += _MIN_STEP_DAMPING_M2
        vectors.solve_by_cholesky(M, u, m)
        growth = 0.0
        for i in range(m):
            growth += u[i] * u[i]
        growth = np.sqrt(growth)
        for i in range(m):
            u[i] /= growth
    return max(1.0 / growth - _MIN_STEP_DAMPING_M2, 0.0)


@njit(cache=True)
def _is_joint_pushed_against_limit(q, lower, upper, i, push):
    return (push > 0.0 and q[i] >= upper[i]) or (push < 0.0 and q[i] <= lower[i])


@njit(cache=True)
def _take_damped_step_within_limits(H, g, damping, q, lower, upper, trial):
    """Write q + (H + damping I)^-1 g, within limits, to `trial` (n,); return the largest step.

    H (n, n) is the Gram matrix J^T J, g (n,) minus the gradient of the cost.
    """
    n = q.shape[0]
    M, d, fixed, held = np.empty((n, n)), np.empty(n), np.zeros(n), np.empty(n, np.bool_)
    for i in range(n):
        held[i] = _is_joint_pushed_against_limit(q, lower, upper, i, g[i])
    outside = True
    while outside:
        for i in range(n):
            d[i] = fixed[i] if held[i] else g[i]
            for k in range(n):
                M[i, k] = 0.0 if held[i] or held[k] else H[i, k]
                if held[k] and not held[i]:
                    d[i] -= H[i, k] * fixed[k]
            M[i, i] = 1.0 if held[i] else H[i, i] + damping
        vectors.solve_by_cholesky(M, d, n)
        outside = False
        for i in range(n):
            if not (held[i] or lower[i] <= q[i] + d[i] <= upper[i]):
                fixed[i] = (upper[i] if d[i] > 0.0 else lower[i]) - q[i]
                held[i] = outside = True
    largest = 0.0
    for i in range(n):
        trial[i] = min(max(q[i] + d[i], lower[i]), upper[i])
        largest = max(largest, abs(d[i]))
    return largest


@njit(cache=True)
def _classify_wrist_or_shoulder_singularity(L, J):
    n = J.shape[1]
    if n < 6:  # such an arm lacks a direction in every posture
        return _WRIST_SINGULAR
    a, b, c = (
        vectors.vector_at(J[3:, n - 3], 0),
        vectors.vector_at(J[3:, n - 2], 0),
        vectors.vector_at(J[3:, n - 1], 0),
    )
    coplanar = abs(vectors.dot(a, vectors.cross(b, c))) < _MAX_COPLANAR_WRIST_TRIPLE_PRODUCT * L**3
    return _WRIST_SINGULAR if coplanar else _SHOULDER_SINGULAR


@njit(cache=True)
def follow_pose(
    table, L, pose, reference, lower, upper, max_step, posture, pull, min_singular_value, steps, q
):
    """Write joint positions q (n,) near a reference that bring S to a pose; return the `IkStatus`.

    Args:
        table: `ArmModel.table`.
        L: length that weights orientation against position error [m].
        pose: (7,) X_WS.
        reference: (n,) joint positions, normally the last command.
        lower, upper: (n,) joint limits.
        max_step: (n,) largest displacement from the reference.
        posture: (n,) joint positions that a redundant arm approaches.
        pull: share of the distance to the posture that is covered by this call.
        min_singular_value: singular value of the Jacobian below which the motion is damped [m].
        steps: maximum number of Levenberg-Marquardt steps.
    """
    n = q.shape[0]
    low, high = np.empty(n), np.empty(n)
    for i in range(n):
        q[i] = min(max(reference[i], lower[i]), upper[i])
        low[i], high[i] = max(q[i] - max_step[i], lower[i]), min(q[i] + max_step[i], upper[i])
    length = pose[0] * pose[0] + pose[1] * pose[1] + pose[2] * pose[2] + pose[3] * pose[3]
    if not (are_valid_port_values(reference) and are_valid_port_values(pose) and length > 0.0):
        if not are_valid_port_values(reference):
            q[:] = np.nan
        return _BAD_POSE
    start, towards_posture = q.copy(), n > 6 and pull > 0.0
    x, e, J, H = np.empty(21), np.empty(6), np.empty((6, n)), np.empty((n, n))
    g, push, trial, kept = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    if towards_posture:
        if upper[n - 1] - lower[n - 1] == np.inf:
            _pose_error_into(table, L, pose, q, x, J, e, push)
        for i in range(n):
            step = pull * (posture[i] - q[i])
            if upper[i] - lower[i] == np.inf:
                step = pull * np.sin(posture[i] - q[i])
                if i == n - 1:  # the last joint turns the tool without the links
                    step = push[i] / (J[:, i] ** 2).sum()
            q[i] = min(max(q[i] + step, low[i]), high[i])
    B, u = np.empty((min(n, 6), min(n, 6))), np.empty(min(n, 6))
    squared = _pose_error_into(table, L, pose, q, x, J, e, push)
    _gram_matrix_of_size_into(J, B)
    damping = max(min_singular_value * min_singular_value - _find_smallest_eigenpair(B, u), 0.0)
    before, missed, expected_gain = np.inf, 0.0, 0.0
    limit = _MIN_OUT_OF_REACH_ERROR_BELOW_6_DOF_M if n < 6 else _MIN_OUT_OF_REACH_ERROR_M
    while True:
        anchor = q.copy()
        cost, relative_damping, stalled_steps, better = squared, _INITIAL_RELATIVE_DAMPING, 0, True
        for _ in range(steps):
            is_met = squared < _MAX_POSE_ROUNDING_ERROR_M * _MAX_POSE_ROUNDING_ERROR_M
            if is_met or stalled_steps > 3 or relative_damping > 1e9:
                break
            if better:
                _gram_matrix_of_size_into(J, H)
                for i in range(n):
                    g[i] = damping * (anchor[i] - q[i]) + push[i]
            stiff = damping + max(_MIN_STEP_DAMPING_M2, relative_damping * squared)
            largest = _take_damped_step_within_limits(H, g, stiff, q, low, high, trial)
            if largest < _MAX_POSE_ROUNDING_ERROR_M:
                break
            found = _pose_error_into(table, L, pose, trial, x, J, e, push)
            total = found
            for i in range(n):
                total += damping * (trial[i] - anchor[i]) ** 2
            better = total < cost
            if better:
                stalled_steps = stalled_steps + 1 if total > 0.99 * cost else 0
                squared, cost, relative_damping = found, total, 0.2 * relative_damping
                vectors.copy_into(q, 0, trial, 0, n)
            else:
                relative_damping = 10.0 * max(relative_damping, _INITIAL_RELATIVE_DAMPING)
        _pose_error_into(table, L, pose, q, x, J, e, push)
        p, rotation = vectors.vector_at(e, 0), vectors.vector_at(e, 3)
        if (
            vectors.dot(p, p) <= POSE_TOLERANCE_M * POSE_TOLERANCE_M
            and vectors.dot(rotation, rotation) <= L * L * POSE_TOLERANCE_M * POSE_TOLERANCE_M
        ):
            return _STATUS_OK
        if towards_posture:
            # The pose has priority: repeat without the posture.
            towards_posture = False
            vectors.copy_into(q, 0, start, 0, n)
            squared = _pose_error_into(table, L, pose, q, x, J, e, push)
            continue
        if before < np.inf:
            if squared < (1.0 - 1e-7) * before - expected_gain:
                return _classify_wrist_or_shoulder_singularity(L, J)
            vectors.copy_into(q, 0, kept, 0, n)
            far = missed > limit**2 and (n < 6 or expected_gain < 1e-3 * before)
            return _OUT_OF_REACH if far else _classify_wrist_or_shoulder_singularity(L, J)
        held, free = -1, 0.0
        for i in range(n):
            if not _is_joint_pushed_against_limit(q, low, high, i, push[i]):
                free += push[i] * push[i]
            elif held < 0 or lower[i] < q[i] < upper[i]:
                held = i
        if held >= 0:
            return _SPEED_LIMIT if lower[held] < q[held] < upper[held] else _JOINT_LIMIT
        zero_gradient = _MIN_GRADIENT_TO_ERROR_RATIO_M * _MIN_GRADIENT_TO_ERROR_RATIO_M * squared
        if min_singular_value > 0.0 and free > zero_gradient:
            return _classify_wrist_or_shoulder_singularity(L, J) if damping > 0.0 else _SPEED_LIMIT
        before, missed = squared, vectors.dot(p, p) if n < 6 else squared
        # Gain expected from later samples; without it, every pose would count as reachable.
        expected_gain = 4.0 * free / max(damping, _MIN_STEP_DAMPING_M2)
        vectors.copy_into(kept, 0, q, 0, n)
        # Displace along the weakest direction, in proportion to the error, so that noise does not
        # move the arm.
        _find_smallest_eigenpair(H, g)
        size = _SEARCH_SINGULARITY_ESCAPE_RAD_OR_M
        if min_singular_value > 0.0:
            size = min(_MAX_SINGULARITY_ESCAPE_RAD_OR_M, 10.0 * np.sqrt(squared) / L)
        slope = 0.0
        for i in range(n):
            slope += g[i] * push[i]
        for i in range(n):
            q[i] = min(max(q[i] + (size if slope >= 0.0 else -size) * g[i], low[i]), high[i])
        squared = _pose_error_into(table, L, pose, q, x, J, e, push)


def find_posture(arm: ArmModel, pose: Array, reference: Array) -> tuple[Array, IkStatus]:
    """Return joint positions (n,) that bring S to the pose X_WS (7,), and the `IkStatus`.

    The search starts at the reference (n,). Without a solution, the positions nearest to the pose
    are returned, with OUT_OF_REACH, JOINT_LIMIT or, within 1 mm, the status of a singularity.
    """
    n, lower, upper = arm.num_joints, arm.lower, arm.upper
    first = np.where(np.isfinite(lower), lower, reference - np.pi)  # of the other starts
    width = np.where(np.isfinite(upper), upper, reference + np.pi) - first
    far, q, nearest = np.full(n, np.inf), np.empty(n), np.empty(n)
    # Quasi-random starts (Roberts's R sequence).
    ratio = 2.0
    for _ in range(30):
        ratio = (1.0 + ratio) ** (1.0 / (n + 1))
    start, status, L, smallest = reference, _OUT_OF_REACH, orientation_weight_m(arm), np.inf
    x, e, J, push = np.empty(21), np.empty(6), np.empty((6, n)), np.empty(n)
    for k in range(_NUM_SEARCH_STARTS):
        found = follow_pose(
            arm.table, L, pose, start, lower, upper, far, start, 0.0, 0.0,
            _NUM_STEPS_PER_SEARCH_START, q,
        )  # fmt: skip
        if found in (_STATUS_OK, _BAD_POSE):
            return _nearest_joints_by_whole_turns(arm, q, reference), IkStatus(found)
        squared = _pose_error_into(arm.table, L, pose, q, x, J, e, push)
        if squared < smallest:
            smallest, nearest = squared, q.copy()
            status = _JOINT_LIMIT if found == _JOINT_LIMIT else _OUT_OF_REACH
            if (
                squared < _MIN_OUT_OF_REACH_SEARCH_ERROR_M**2
                and np.linalg.svd(J)[1][-1] < MIN_SINGULAR_VALUE_M
            ):
                status = _classify_wrist_or_shoulder_singularity(L, J)
        part = (0.5 + (k + 1) * ratio ** -np.arange(1.0, n + 1)) % 1.0
        start = first + part * width
    return _nearest_joints_by_whole_turns(arm, nearest, reference), IkStatus(status)


def _nearest_joints_by_whole_turns(arm: ArmModel, q: Array, reference: Array) -> Array:
    turns = 2 * np.pi * np.round((reference - q) / (2 * np.pi))
    nearer = q + np.where(arm.table[:-1, IS_PRISMATIC_COLUMN] == 0, turns, 0.0)
    return np.where((arm.lower <= nearer) & (nearer <= arm.upper), nearer, q)


def orientation_weight_m(arm: ArmModel) -> float:
    """Return the length [m] that weights orientation against position error: arm length / 5."""
    return float(np.linalg.norm(arm.table[:, TRANSLATION_COLUMN:PHI_COLUMN], axis=1).sum()) / 5.0


@njit(cache=True)
def _follow_command(
    table, L, lower, upper, speed, posture, pull, pose, position, last, time, q
):  # fmt: skip
    """Write the next command q (n,), from the last one towards the pose; return the `IkStatus`.

    `speed` (n,) contains speed limits, `last` (n + 1,) the last command and its time [s]. Invalid
    encoder readings `position` (n,) hold the last command.
    """
    n = q.shape[0]
    vectors.copy_into(q, 0, last, 0, n)
    if not are_valid_port_values(position):
        return _BAD_POSE
    reference, max_step, elapsed = q.copy(), np.zeros(n), max(time - last[n], 0.0)
    if elapsed > 0.0:  # inf * 0 is nan
        for i in range(n):
            max_step[i] = speed[i] * elapsed
    steps = np.int64(MAX_SOLVER_STEPS_PER_COMMAND)  # a literal would compile `follow_pose` again
    return follow_pose(
        table, L, pose, reference, lower, upper, max_step, posture, min(pull * elapsed, 1.0),
        MIN_SINGULAR_VALUE_M, steps, q,
    )  # fmt: skip


class NumericInverseKinematics(LeafSystem):
    """Block that converts a commanded pose to joint positions, for any serial arm.

    Its ports are those of `InverseKinematics`. Joints continue from the last command, not the
    measured position, so that a redundant arm does not drift.
    """

    __slots__ = NO_EXTRA_SLOTS

    POSTURE_RATE_PER_S = 1.0
    """Rate at which a redundant arm approaches its posture [1/s]."""

    def __init__(self, arm: ArmModel, q_start: Array, period: float) -> None:
        super().__init__()
        n = arm.num_joints
        self._joints, posture = n, np.array(q_start, dtype=np.float64)
        #: Joint speed limits (n,) [rad/s, m/s]; values may be changed in place.
        self.speed_limit = arm.velocity_limit.copy()
        limits = arm.lower, arm.upper, self.speed_limit
        self._fixed = (arm.table, orientation_weight_m(arm), *limits, posture)
        self._pose = self.DeclareVectorInputPort("pose_command", 7)
        self._position = self.DeclareVectorInputPort("joint_position", n)
        self.DeclareDiscreteState(np.append(posture, 0.0))  # last command and its time
        calc_command = weak_callback(self._calc_command)
        self._command = self.DeclareVectorOutputPort("joint_command", n, calc_command)
        self.DeclareVectorOutputPort("ik_status", 1, weak_callback(self._calc_status))
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._store_command_and_time)

    def _solve_command(self, context: Context, q: Array) -> int:
        last = context.get_discrete_state_vector().value()
        time, inputs = context.get_time(), (self._pose.Eval(context), self._position.Eval(context))
        status: int = _follow_command(*self._fixed, self.POSTURE_RATE_PER_S, *inputs, last, time, q)
        return status

    def _calc_command(self, context: Context, output: BasicVector) -> None:
        self._solve_command(context, output.get_mutable_value())

    def _calc_status(self, context: Context, output: BasicVector) -> None:
        output[0] = self._solve_command(context, np.empty(self._joints))

    def _store_command_and_time(self, context: Context, discrete_state: DiscreteValues) -> None:
        next_state = discrete_state.get_mutable_value(0)
        next_state[:-1] = self._command.Eval(context)  # cached for the joint control
        next_state[-1] = context.get_time()
