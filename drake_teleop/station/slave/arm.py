"""Compiled kinematics and dynamics of a serial arm with revolute and prismatic joints.

For prismatic joints, the units rad, N m and kg m^2 become m, N and kg. The state ``x`` of a frame L
has 21 numbers in W: ``[s(3), omega(3), alpha(3), p_WL(3), R_WL(9, by rows)]``. The specific force
of its origin is ``s = a - g`` [m/s^2]. Arguments `table` are `ArmModel.table`."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from drake_teleop.common.blocks import NO_EXTRA_SLOTS, weak_callback
from drake_teleop.common.compiled import njit
from drake_teleop.common.numeric import Array
from drake_teleop.common.vectors import (
    add_cross_product,
    add_vector_into,
    apply_matrix,
    cross,
    dot,
    matrix_at,
    minus,
    plus,
    quaternion_of_matrix,
    scale_vector,
    solve_by_cholesky,
    symmetric_matrix_at,
    transposed,
    vector_at,
)

# Columns of ArmModel.table.
ROTATION_COLUMN, TRANSLATION_COLUMN, PHI_COLUMN, ROTOR_COLUMN = 0, 9, 12, 22
DAMPING_COLUMN, DRY_FRICTION_COLUMN, IS_PRISMATIC_COLUMN = 23, 24, 25
NUM_ARM_TABLE_COLUMNS = 26
ARM_FRICTION_TANH_SPEED_SI = 2e-3
"""Speed v_0 of the dry friction tau = -tau_C tanh(v / v_0) [rad/s, m/s], estimate."""
LAST_ROW_GRAVITY_COLUMN = 22  # first of three columns with gravity, in the last row only

SENSOR_MOTION_SIZE = 21
"""Length of the vector that `sensor_motion` fills."""


@dataclass(frozen=True, eq=False)
class ArmModel:
    """Serial arm of n joints from the world to the sensor frame S, as numeric arrays.

    Frame L_j of link j rotates about its z axis, or slides along it. At q_j = 0 it coincides with
    the joint frame J_j, which is fixed to the previous link; L_0 is the world. Bodies welded to a
    link belong to it. Bodies beyond S are the load. phi (10,) are inertial parameters about a
    frame's origin, in its axes: mass, mass times centre (3,), inertia xx, xy, xz, yy, yz, zz.

    Attributes:
        joint_names: names from the base outwards.
        table: (n+1, 26), a row for each joint and a last row for S, fixed to L_n. Columns: 0-8
            R_PJ by rows, with the previous link's frame P; 9-11 p_PJ [m]; 12-21 phi of the link, in
            L_j (last row: of the load, in S); 22 rotor inertia at the joint [kg m^2]; 23 damping
            [N m s/rad]; 24 dry friction [N m]; 25 is 1 for a prismatic joint. In the last row,
            22-24 are gravity in W [m/s^2].
        lower, upper: (n,) joint limits [rad], -inf and inf for joints without limits.
        velocity_limit, acceleration_limit, effort_limit: (n,) [rad/s, rad/s^2, N m] or inf.
        position_index, velocity_index: (n,) indices in the plant's positions and velocities.
    """

    joint_names: tuple[str, ...]
    table: Array
    lower: Array
    upper: Array
    velocity_limit: Array
    acceleration_limit: Array
    effort_limit: Array
    position_index: NDArray[np.intp]
    velocity_index: NDArray[np.intp]

    @property
    def num_joints(self) -> int:
        return len(self.joint_names)

    @property
    def sliding_joints(self) -> tuple[int, ...]:
        """Indices of the prismatic joints, whose positions are in m."""
        return tuple(map(int, np.flatnonzero(self.table[:-1, IS_PRISMATIC_COLUMN])))

    @property
    def middle_positions(self) -> Array:
        """Middles (n,) of the joint ranges; for an infinite range its point nearest to 0."""
        bounded = np.isfinite(self.lower) & np.isfinite(self.upper)
        with np.errstate(invalid="ignore"):  # inf - inf
            middle = (self.lower + self.upper) / 2
        return np.where(bounded, middle, np.clip(0.0, self.lower, self.upper))

    @property
    def phi_load(self) -> Array:
        return self.phi_load_view.copy()

    @property
    def phi_load_view(self) -> Array:
        """Writable view into `table`: inertial parameters phi (10,) of the load about So, in S."""
        return self.table[-1, PHI_COLUMN:ROTOR_COLUMN]

    def pose(self, q: Array) -> Array:
        """Return the pose X_WS (7,) [qw qx qy qz px py pz] [m] at q (n,) [rad, m]."""
        pose = np.empty(7)
        pose_into(self.table, q, pose)
        return pose

    def with_load(self, phi: Array) -> ArmModel:
        table = self.table.copy()
        table[-1, PHI_COLUMN:ROTOR_COLUMN] = phi
        return replace(self, table=table)


@njit(cache=True, inline="always")
def _propagate_pose_to_child_link(
    table: Array, row: int, q: float, x: Array
) -> tuple[float, float, float]:
    """Replace the pose of link P in x by that of the next link L; return p_PL_W [m]."""
    joint = table[row]
    p_PL_P = vector_at(joint, TRANSLATION_COLUMN)
    if joint[IS_PRISMATIC_COLUMN] != 0.0:
        p_PL_P = plus(p_PL_P, scale_vector(q, (joint[2], joint[5], joint[8])))
        q = 0.0
    p_PL_W = apply_matrix(matrix_at(x, 12), p_PL_P)
    add_vector_into(x, 9, p_PL_W)
    c = np.cos(q)
    s = np.sin(q)
    R_JP = transposed(matrix_at(joint, ROTATION_COLUMN))
    for i in range(12, 21, 3):
        u, v, w = apply_matrix(R_JP, vector_at(x, i))
        x[i], x[i + 1], x[i + 2] = c * u + s * v, c * v - s * u, w
    return p_PL_W


@njit(cache=True, inline="always")
def _propagate_motion_to_child_link(
    table: Array, row: int, q: float, qd: float, qdd: float, x: Array
) -> None:
    r = _propagate_pose_to_child_link(table, row, q, x)
    omega, alpha, z = vector_at(x, 3), vector_at(x, 6), (x[14], x[17], x[20])
    add_vector_into(x, 0, add_cross_product(cross(alpha, r), omega, cross(omega, r)))
    if table[row, IS_PRISMATIC_COLUMN] != 0.0:
        add_vector_into(x, 0, plus(scale_vector(qdd, z), scale_vector(2.0 * qd, cross(omega, z))))
    else:
        add_vector_into(x, 3, scale_vector(qd, z))
        add_vector_into(x, 6, plus(scale_vector(qdd, z), scale_vector(qd, cross(omega, z))))


def accelerations_from_specific_forces(arm: ArmModel, q: Array, s: Array) -> Array:
    """Return accelerations s + g of So, in S, from specific forces s (N, 3), in S, at q (N, n)."""
    out = np.empty_like(s)
    for k in range(len(s)):
        acceleration_from_specific_force_into(arm.table, q[k], s[k], out[k])
    return out


@njit(cache=True)
def acceleration_from_specific_force_into(table: Array, q: Array, s: Array, out: Array) -> None:
    R_WS, p_WS = np.empty((3, 3)), np.empty(3)
    forward_kinematics(table, q, R_WS, p_WS)
    g = table[table.shape[0] - 1, LAST_ROW_GRAVITY_COLUMN : LAST_ROW_GRAVITY_COLUMN + 3]
    for i in range(3):
        out[i] = s[i] + R_WS[0, i] * g[0] + R_WS[1, i] * g[1] + R_WS[2, i] * g[2]


@njit(cache=True, inline="always")
def _start_motion_at_rest_with_minus_gravity(table: Array, x: Array) -> None:
    x[:] = 0.0
    for k in range(3):
        x[k] = -table[table.shape[0] - 1, LAST_ROW_GRAVITY_COLUMN + k]
        x[12 + 4 * k] = 1.0


@njit(cache=True)
def forward_kinematics(table: Array, q: Array, R_WS: Array, p_WS: Array) -> None:
    """Write the pose of S at q (n,) [rad] to R_WS (3, 3) and p_WS (3,) [m]."""
    n = table.shape[0] - 1
    x = np.zeros(21)
    x[12] = x[16] = x[20] = 1.0
    for row in range(n + 1):
        _propagate_pose_to_child_link(table, row, q[row] if row < n else 0.0, x)
    for i in range(3):
        p_WS[i] = x[9 + i]
        R_WS[i, 0], R_WS[i, 1], R_WS[i, 2] = vector_at(x, 12 + 3 * i)


@njit(cache=True)
def jacobian(table: Array, q: Array, J_out: Array) -> None:
    """Write the Jacobian J (6, n) at So, in W, to J_out: ``[v_WS; omega_WS] = J v``."""
    jacobian_and_pose(table, q, J_out, np.empty(21))


@njit(cache=True)
def jacobian_and_pose(table: Array, q: Array, J_out: Array, x: Array) -> None:
    """Write the `jacobian` to J_out, p_WS [m] to x[9:12] and R_WS, by rows, to x[12:21]."""
    n = table.shape[0] - 1
    x[:] = 0.0
    x[12] = x[16] = x[20] = 1.0
    for row in range(n):
        _propagate_pose_to_child_link(table, row, q[row], x)
        for i in range(3):
            J_out[i, row] = x[9 + i]
            J_out[3 + i, row] = x[14 + 3 * i]
    _propagate_pose_to_child_link(table, n, 0.0, x)
    p_WS = vector_at(x, 9)
    for row in range(n):
        column = J_out[:, row]
        axis = vector_at(column, 3)
        if table[row, IS_PRISMATIC_COLUMN] != 0.0:
            column[0], column[1], column[2] = axis
            column[3] = column[4] = column[5] = 0.0
        else:
            column[0], column[1], column[2] = cross(axis, minus(p_WS, column))


@njit(cache=True)
def sensor_motion(table: Array, q: Array, v: Array, vdot: Array, out: Array) -> None:
    """Write the motion x of S to out (21,), but with s, omega, alpha in S instead of W."""
    n = table.shape[0] - 1
    _start_motion_at_rest_with_minus_gravity(table, out)
    for row in range(n + 1):
        qi, vi, ai = (q[row], v[row], vdot[row]) if row < n else (0.0, 0.0, 0.0)
        _propagate_motion_to_child_link(table, row, qi, vi, ai, out)
    R_SW = transposed(matrix_at(out, 12))
    for i in range(0, 9, 3):
        out[i], out[i + 1], out[i + 2] = apply_matrix(R_SW, vector_at(out, i))


@njit(cache=True)
def link_motions(table: Array, q: Array, v: Array, vdot: Array, out: Array) -> None:
    """Write the states x of all links and of S to out (n+1, 21)."""
    n = table.shape[0] - 1
    _start_motion_at_rest_with_minus_gravity(table, out[0])
    for row in range(n + 1):
        if row > 0:
            out[row] = out[row - 1]
        qi, vi, ai = (q[row], v[row], vdot[row]) if row < n else (0.0, 0.0, 0.0)
        _propagate_motion_to_child_link(table, row, qi, vi, ai, out[row])


@njit(cache=True, inline="always")
def _write_joint_axis_and_inertial_wrench(table: Array, row: int, x: Array, link: Array) -> None:
    """Write [z_L, p_WL, f, tau] in W to `link[row]`; the motion x needs force f, tau about Wo."""
    phi, wrench, R_WL, p_WL = table[row, PHI_COLUMN:], link[row], matrix_at(x, 12), vector_at(x, 9)
    R_LW, m, h, inertia = transposed(R_WL), phi[0], vector_at(phi, 1), symmetric_matrix_at(phi, 4)
    s, omega = apply_matrix(R_LW, vector_at(x, 0)), apply_matrix(R_LW, vector_at(x, 3))
    alpha = apply_matrix(R_LW, vector_at(x, 6))
    f = add_cross_product(add_cross_product(scale_vector(m, s), alpha, h), omega, cross(omega, h))
    tau = add_cross_product(apply_matrix(inertia, alpha), omega, apply_matrix(inertia, omega))
    tau = add_cross_product(tau, h, s)
    f_W = apply_matrix(R_WL, f)
    tau_W = plus(apply_matrix(R_WL, tau), cross(p_WL, f_W))
    for i in range(3):
        wrench[i] = x[14 + 3 * i]
        wrench[3 + i] = p_WL[i]
        wrench[6 + i] = f_W[i]
        wrench[9 + i] = tau_W[i]


@njit(cache=True)
def _project_wrenches_on_joints(table: Array, link: Array, tau: Array) -> None:
    n = tau.shape[0]
    for row in range(n, 0, -1):
        for k in range(6, 12):
            link[row - 1, k] += link[row, k]
    for row in range(n):
        x = link[row]
        if table[row, IS_PRISMATIC_COLUMN] != 0.0:
            tau[row] = dot(vector_at(x, 0), vector_at(x, 6))
        else:
            to_Wo = scale_vector(-1.0, vector_at(x, 3))
            moment_about_Lo = add_cross_product(vector_at(x, 9), to_Wo, vector_at(x, 6))
            tau[row] = dot(vector_at(x, 0), moment_about_Lo)


@njit(cache=True)
def inverse_dynamics(table: Array, q: Array, v: Array, vdot: Array, tau_out: Array) -> None:
    """Write joint torques (n,) [N m] by recursive Newton-Euler (Luh, Walker, Paul 1980).

    The torques include rotors, damping, gravity and load, but neither contact nor dry friction.
    """
    n = table.shape[0] - 1
    x = np.empty(21)
    link = np.empty((n + 1, 12))
    _start_motion_at_rest_with_minus_gravity(table, x)
    for row in range(n + 1):
        qi, vi, ai = (q[row], v[row], vdot[row]) if row < n else (0.0, 0.0, 0.0)
        _propagate_motion_to_child_link(table, row, qi, vi, ai, x)
        _write_joint_axis_and_inertial_wrench(table, row, x, link)
    _project_wrenches_on_joints(table, link, tau_out)
    for row in range(n):
        tau_out[row] += table[row, ROTOR_COLUMN] * vdot[row] + table[row, DAMPING_COLUMN] * v[row]


def holding_torque(arm: ArmModel, q: Array) -> Array:
    zeros, torque = np.zeros(arm.num_joints), np.empty(arm.num_joints)
    inverse_dynamics(arm.table, q, zeros, zeros, torque)
    return torque


@njit(cache=True, inline="always")
def _add_link_inertia_about_world(table: Array, row: int, x: Array, inertia: Array) -> None:
    phi, p = table[row, PHI_COLUMN:], vector_at(x, 9)
    h = apply_matrix(matrix_at(x, 12), vector_at(phi, 1))
    m, about_Lo = phi[0], symmetric_matrix_at(phi, 4)
    inertia[0] += m
    add_vector_into(inertia, 1, plus(h, scale_vector(m, p)))
    # From Lo to Wo: 2 p.h 1 - p h' - h p' + m (p.p 1 - p p')
    diagonal = 2.0 * dot(p, h) + m * dot(p, p)
    k = 4
    for i in range(3):
        rotated = apply_matrix(about_Lo, vector_at(x, 12 + 3 * i))
        for j in range(i, 3):
            value = dot(rotated, vector_at(x, 12 + 3 * j))
            value -= p[i] * h[j] + h[i] * p[j] + m * p[i] * p[j]
            if i == j:
                value += diagonal
            inertia[k] += value
            k += 1


@njit(cache=True)
def _lower_mass_matrix_into(table: Array, link: Array, inertia: Array, M: Array) -> None:
    """Write the lower half of the mass matrix to M (n, n); inputs `link`, `inertia` change."""
    # Composite rigid bodies: Featherstone, Rigid Body Dynamics Algorithms (2008), section 6.2.
    n = M.shape[0]
    for row in range(n):
        # Velocity at Wo and angular velocity for unit joint speed.
        x = link[row]
        x[9], x[10], x[11] = vector_at(x, 0)
        x[6], x[7], x[8] = cross(vector_at(x, 3), vector_at(x, 9))
        if table[row, IS_PRISMATIC_COLUMN] != 0.0:
            x[6], x[7], x[8] = vector_at(x, 9)
            x[9] = x[10] = x[11] = 0.0
    for row in range(n - 1, -1, -1):
        for k in range(10):
            inertia[row, k] += inertia[row + 1, k]
        c = inertia[row]
        h = vector_at(c, 1)
        v, w = vector_at(link[row], 6), vector_at(link[row], 9)
        # Momentum about Wo of all outboard links for unit speed of this joint.
        linear = add_cross_product(scale_vector(c[0], v), w, h)
        angular = add_cross_product(apply_matrix(symmetric_matrix_at(c, 4), w), h, v)
        # `solve_by_cholesky` reads the lower half only.
        for i in range(row + 1):
            v, w = vector_at(link[i], 6), vector_at(link[i], 9)
            M[row, i] = dot(w, angular) + v[0] * linear[0] + v[1] * linear[1] + v[2] * linear[2]
        M[row, row] += table[row, ROTOR_COLUMN]


@njit(cache=True)
def dry_friction(coulomb: float, speed: float) -> float:
    """Return the dry friction torque [N m], opposite to the speed [rad/s] and at most `coulomb`."""
    return -coulomb * np.tanh(speed / ARM_FRICTION_TANH_SPEED_SI)


@njit(cache=True)
def forward_dynamics(
    table: Array, q: Array, v: Array, tau: Array, wrench_W: Array, vdot_out: Array
) -> None:
    """Write joint accelerations vdot, from M(q) vdot = tau + tau_friction(v) + J^T F - h(q, v).

    tau_friction is joint damping and dry friction; h is the torque of gravity, Coriolis and
    centrifugal effects; F, J: wrench `wrench_W` on the load and Jacobian about Wo [N, N m].
    """
    n = table.shape[0] - 1
    x = np.empty(21)
    link = np.empty((n + 1, 12))
    inertia = np.zeros((n + 1, 10))
    M = np.empty((n, n))
    _start_motion_at_rest_with_minus_gravity(table, x)
    for row in range(n + 1):
        qi, vi = (q[row], v[row]) if row < n else (0.0, 0.0)
        _propagate_motion_to_child_link(table, row, qi, vi, 0.0, x)
        _write_joint_axis_and_inertial_wrench(table, row, x, link)
        _add_link_inertia_about_world(table, row, x, inertia[row])
    for k in range(6):
        link[n, 6 + k] -= wrench_W[k]
    _project_wrenches_on_joints(table, link, vdot_out)
    for row in range(n):
        vdot_out[row] = tau[row] - vdot_out[row] - table[row, DAMPING_COLUMN] * v[row]
        if table[row, DRY_FRICTION_COLUMN] != 0.0:
            vdot_out[row] += dry_friction(table[row, DRY_FRICTION_COLUMN], v[row])
    _lower_mass_matrix_into(table, link, inertia, M)
    solve_by_cholesky(M, vdot_out, n)


@njit(cache=True)
def pose_into(table, q, pose):
    R, p = np.empty((3, 3)), np.empty(3)
    forward_kinematics(table, q, R, p)
    pose[0], pose[1], pose[2], pose[3] = quaternion_of_matrix(R)
    pose[4], pose[5], pose[6] = vector_at(p, 0)


class ForwardKinematics(LeafSystem):
    """Block that outputs the pose X_WS (7,) of the sensor frame from the arm's state [q; v]."""

    __slots__ = NO_EXTRA_SLOTS

    def __init__(self, arm: ArmModel) -> None:
        super().__init__()
        self._arm = arm.table
        self._n = arm.num_joints
        self._state = self.DeclareVectorInputPort("slave_state", 2 * arm.num_joints)
        inputs = {self._state.ticket()}
        self.DeclareVectorOutputPort("pose_slave", 7, weak_callback(self._calc_slave_pose), inputs)

    def _calc_slave_pose(self, context: Context, output: BasicVector) -> None:
        pose_into(self._arm, self._state.Eval(context)[: self._n], output.get_mutable_value())


@njit(cache=True)
def _write_joint_friction_forces(coulomb, index, state, force):
    force[:] = 0.0
    for i in range(coulomb.shape[0]):
        force[index[i]] = dry_friction(coulomb[i], state[coulomb.shape[0] + i])


class JointFriction(LeafSystem):
    """Block that outputs dry friction of the arm's joints as generalized force on the whole plant.

    `index` contains the joints' indices in the plant's `num_velocities` velocities.
    """

    __slots__ = NO_EXTRA_SLOTS

    def __init__(self, coulomb: Array, index: NDArray[np.intp], num_velocities: int) -> None:
        super().__init__()
        self._constants = coulomb, index
        self._state = self.DeclareVectorInputPort("slave_state", 2 * len(coulomb))
        calc, inputs = weak_callback(self._calc_friction_force), {self._state.ticket()}
        self.DeclareVectorOutputPort("generalized_force", num_velocities, calc, inputs)

    def _calc_friction_force(self, context: Context, output: BasicVector) -> None:
        state = self._state.Eval(context)
        _write_joint_friction_forces(*self._constants, state, output.get_mutable_value())
