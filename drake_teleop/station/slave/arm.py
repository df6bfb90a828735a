"""Kinematics and dynamics of any serial arm of revolute and prismatic joints, compiled.

`ArmModel` is the arm as one table of numbers (`arm_from_plant` reads it out of a plant); the
kernels below run on that table. They repeat what the plant can do because an 8 kHz sample has
125 us in all and the plant's output ports take 5-20 us each; a test ties each kernel to the plant.

The kernels walk from the world outwards in world coordinates. Their state ``x`` is 21 numbers,
the motion of a frame L: ``[s(3), omega(3), alpha(3), p_WL(3), R_WL(9, by rows)]`` with the specific
force ``s = a - g`` [m/s^2] of L's origin, angular velocity [rad/s], angular acceleration [rad/s^2].
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.compiled import njit
from drake_teleop.common.vectors import (
    add_into,
    apply,
    cross,
    dot,
    minus,
    nine,
    plus,
    plus_cross,
    symmetric,
    three,
    times,
    transposed,
)
from drake_teleop.station.slave.joint_friction import dry_friction

Array = NDArray[np.float64]

# Columns of ArmModel.table.
ROTATION, TRANSLATION, PHI, ROTOR, DAMPING, FRICTION, SLIDES = 0, 9, 12, 22, 23, 24, 25
WIDTH = 26
# In the last row, which has no joint, gravity stands from here on.
GRAVITY = 22

MOTION_SIZE = 21
"""Length of the vector that `sensor_motion` fills."""


@dataclass(frozen=True, eq=False)
class ArmModel:
    """A serial chain of n joints from the world to the sensor frame S, as plain arrays.

    Link frame L_j turns with joint j about its z axis, or slides along it, and coincides with the
    joint's frame J_j at q_j = 0; L_0 is the world. Everything welded to a link belongs to the link;
    everything outboard of the body that carries S is the load. Where a joint slides, read m for
    rad, N for N m and kg for kg m^2.

    Attributes:
        joint_names: names of the joints, from the base outwards.
        table: (n+1, 26), what the kernels read. Row j, of joint j (row n: of S, fixed to L_n):
            columns 0-8 rotation from the joint's frame to the previous link's (by rows), 9-11 its
            origin in the previous link's frame [m], 12-21 phi of the link about the origin of L_j
            in L_j (row n: of the load, in S), ordered [m, m c (3), Ixx, Ixy, Ixz, Iyy, Iyz, Izz],
            22 reflected rotor inertia [kg m^2], 23 damping [N m s/rad], 24 dry friction [N m],
            which `forward_dynamics` alone knows, 25 is 1 where the joint slides; in row n columns
            22-24 are gravity in the world [m/s^2].
        lower: (n,) joint limits [rad].
        upper: (n,) joint limits [rad].
        velocity_limit: (n,) [rad/s], inf where the model gives none.
        acceleration_limit: (n,) [rad/s^2], inf where the model gives none.
        effort_limit: (n,) [N m], inf where the joint has no actuator or the model gives none.
        position_index: (n,) where the joints stand in the plant's vector of positions.
        velocity_index: (n,) where they stand in its vector of velocities.
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
        """The number of joints n."""
        return len(self.joint_names)

    @property
    def phi_load(self) -> Array:
        """(10,) the load that the dynamics carry, about the origin of S, in S."""
        return self.load.copy()

    @property
    def load(self) -> Array:
        """The same, a view into the table."""
        return self.table[-1, PHI:ROTOR]

    def with_load(self, phi: Array) -> ArmModel:
        """The same arm carrying ``phi`` (10,) beyond S instead; zeros for the bare arm."""
        table = self.table.copy()
        table[-1, PHI:ROTOR] = phi
        return replace(self, table=table)


@njit(cache=True, inline="always")
def _advance_pose(table: Array, row: int, q: float, x: Array) -> tuple[float, float, float]:
    """Moves the pose in x from the previous link to this one; returns p_PL_W."""
    joint = table[row]
    p_PL_P = three(joint, TRANSLATION)
    if joint[SLIDES] != 0.0:
        p_PL_P = plus(p_PL_P, times(q, (joint[2], joint[5], joint[8])))
        q = 0.0
    p_PL_W = apply(nine(x, 12), p_PL_P)
    add_into(x, 9, p_PL_W)
    c = np.cos(q)
    s = np.sin(q)
    R_JP = transposed(nine(joint, ROTATION))
    for i in range(12, 21, 3):
        u, v, w = apply(R_JP, three(x, i))
        x[i], x[i + 1], x[i + 2] = c * u + s * v, c * v - s * u, w
    return p_PL_W


@njit(cache=True, inline="always")
def _advance(table: Array, row: int, q: float, qd: float, qdd: float, x: Array) -> None:
    """Moves the state x from the previous link to this one."""
    r = _advance_pose(table, row, q, x)
    omega, alpha, z = three(x, 3), three(x, 6), (x[14], x[17], x[20])
    add_into(x, 0, plus_cross(cross(alpha, r), omega, cross(omega, r)))
    if table[row, SLIDES] != 0.0:
        add_into(x, 0, plus(times(qdd, z), times(2.0 * qd, cross(omega, z))))
    else:
        add_into(x, 3, times(qd, z))
        add_into(x, 6, plus(times(qdd, z), times(qd, cross(omega, z))))


def accelerations(arm: ArmModel, q: Array, s: Array) -> Array:
    """(N, 3) a = s + g in S, of specific forces s (N, 3) at joint positions q (N, n)."""
    out = np.empty_like(s)
    for k in range(len(s)):
        acceleration_into(arm.table, q[k], s[k], out[k])
    return out


@njit(cache=True)
def acceleration_into(table: Array, q: Array, s: Array, out: Array) -> None:
    """Writes a = s + g of So, in S, of the specific force s (3,) at q (n,) into out (3,)."""
    R_WS, p_WS = np.empty((3, 3)), np.empty(3)
    forward_kinematics(table, q, R_WS, p_WS)
    g = table[table.shape[0] - 1, GRAVITY : GRAVITY + 3]
    for i in range(3):
        out[i] = s[i] + R_WS[0, i] * g[0] + R_WS[1, i] * g[1] + R_WS[2, i] * g[2]


@njit(cache=True, inline="always")
def _start(table: Array, x: Array) -> None:
    """The state of the world's frame at rest: s = -g, identity pose."""
    x[:] = 0.0
    for k in range(3):
        x[k] = -table[table.shape[0] - 1, GRAVITY + k]
        x[12 + 4 * k] = 1.0


@njit(cache=True)
def forward_kinematics(table: Array, q: Array, R_WS: Array, p_WS: Array) -> None:
    """Pose of the sensor frame.

    Args:
        table: `ArmModel.table`.
        q: (n,) joint positions [rad].
        R_WS: (3, 3) filled with the rotation of S in W.
        p_WS: (3,) filled with the origin of S in W [m].
    """
    n = table.shape[0] - 1
    x = np.zeros(21)
    x[12] = x[16] = x[20] = 1.0
    for row in range(n):
        _advance_pose(table, row, q[row], x)
    _advance_pose(table, n, 0.0, x)
    for i in range(3):
        p_WS[i] = x[9 + i]
        for k in range(3):
            R_WS[i, k] = x[12 + 3 * i + k]


@njit(cache=True)
def jacobian(table: Array, q: Array, J_out: Array) -> None:
    """Geometric Jacobian of the origin of S in W: ``[v_WS; omega_WS] = J v``.

    Args:
        table: `ArmModel.table`.
        q: (n,) joint positions [rad].
        J_out: (6, n) filled; rows 0-2 velocity of the origin of S, rows 3-5 angular velocity, in W.
    """
    jacobian_and_pose(table, q, J_out, np.empty(21))


@njit(cache=True)
def jacobian_and_pose(table: Array, q: Array, J_out: Array, x: Array) -> None:
    """`jacobian`, and the pose of S in x (21,): ``x[9:12]`` p_WS [m], ``x[12:21]`` R_WS by rows."""
    n = table.shape[0] - 1
    x[:] = 0.0
    x[12] = x[16] = x[20] = 1.0
    for row in range(n):
        _advance_pose(table, row, q[row], x)
        for i in range(3):
            J_out[i, row] = x[9 + i]
            J_out[3 + i, row] = x[14 + 3 * i]
    _advance_pose(table, n, 0.0, x)
    p_WS = three(x, 9)
    for row in range(n):
        column = J_out[:, row]
        axis = three(column, 3)
        if table[row, SLIDES] != 0.0:
            column[0], column[1], column[2] = axis
            column[3] = column[4] = column[5] = 0.0
        else:
            column[0], column[1], column[2] = cross(axis, minus(p_WS, column))


@njit(cache=True)
def sensor_motion(table: Array, q: Array, v: Array, vdot: Array, out: Array) -> None:
    """What a perfect sensor at S would see, and its pose, in one pass.

    Args:
        table: `ArmModel.table`.
        q: (n,) joint positions [rad].
        v: (n,) joint velocities [rad/s].
        vdot: (n,) joint accelerations [rad/s^2].
        out: (21,) filled: ``out[0:3]`` specific force s_S = a - g of the origin of S [m/s^2],
            ``out[3:6]`` omega_WS_S [rad/s], ``out[6:9]`` alpha_WS_S [rad/s^2], all in S;
            ``out[9:12]`` p_WS [m] and ``out[12:21]`` R_WS by rows.
    """
    n = table.shape[0] - 1
    _start(table, out)
    for row in range(n):
        _advance(table, row, q[row], v[row], vdot[row], out)
    _advance(table, n, 0.0, 0.0, 0.0, out)
    R_SW = transposed(nine(out, 12))
    for i in range(0, 9, 3):
        out[i], out[i + 1], out[i + 2] = apply(R_SW, three(out, i))


@njit(cache=True)
def link_motions(table: Array, q: Array, v: Array, vdot: Array, out: Array) -> None:
    """Motion of every link, and of S as the last one, in world coordinates.

    Args:
        table: `ArmModel.table`.
        q: (n,) joint positions [rad].
        v: (n,) joint velocities [rad/s].
        vdot: (n,) joint accelerations [rad/s^2].
        out: (n+1, 21) filled: row j with the state x (see the module) of table's row j.
    """
    n = table.shape[0] - 1
    _start(table, out[0])
    for row in range(n):
        if row > 0:
            out[row] = out[row - 1]
        _advance(table, row, q[row], v[row], vdot[row], out[row])
    out[n] = out[n - 1]
    _advance(table, n, 0.0, 0.0, 0.0, out[n])


@njit(cache=True, inline="always")
def _link_wrench(table: Array, row: int, x: Array, link: Array) -> None:
    """Fills link[row]: axis z and origin p of L, then what moves the link (force; moment about Wo).

    All in W. The wrench is Newton and Euler about the origin of L, Eqs. (1)-(2), taken in L.
    """
    phi, wrench, R_WL, p_WL = table[row, PHI:], link[row], nine(x, 12), three(x, 9)
    R_LW, m, h, inertia = transposed(R_WL), phi[0], three(phi, 1), symmetric(phi, 4)
    s, omega, alpha = apply(R_LW, three(x, 0)), apply(R_LW, three(x, 3)), apply(R_LW, three(x, 6))
    f = plus_cross(plus_cross(times(m, s), alpha, h), omega, cross(omega, h))
    tau = plus_cross(apply(inertia, alpha), omega, apply(inertia, omega))
    tau = plus_cross(tau, h, s)
    f_W = apply(R_WL, f)
    tau_W = plus(apply(R_WL, tau), cross(p_WL, f_W))
    for i in range(3):
        wrench[i] = x[14 + 3 * i]
        wrench[3 + i] = p_WL[i]
        wrench[6 + i] = f_W[i]
        wrench[9 + i] = tau_W[i]


@njit(cache=True)
def _to_the_joints(table: Array, link: Array, tau: Array) -> None:
    """Torques (n,) of the joints for the links' wrenches, see `_link_wrench`; sums them inboard."""
    n = tau.shape[0]
    for row in range(n, 0, -1):
        for k in range(6, 12):
            link[row - 1, k] += link[row, k]
    for row in range(n):
        x = link[row]
        if table[row, SLIDES] != 0.0:
            tau[row] = dot(three(x, 0), three(x, 6))
        else:
            # About the joint's own origin.
            moment = plus_cross(three(x, 9), times(-1.0, three(x, 3)), three(x, 6))
            tau[row] = dot(three(x, 0), moment)


@njit(cache=True)
def inverse_dynamics(table: Array, q: Array, v: Array, vdot: Array, tau_out: Array) -> None:
    """Joint torques of a motion, recursive Newton-Euler (Luh, Walker, Paul 1980).

    With rotor inertia, joint damping and gravity, and with the table's load beyond S; without
    contact. The plant's ``CalcInverseDynamics`` leaves damping to its caller, this does not:
    applying ``tau_out`` to the plant makes it accelerate with ``vdot``.

    Args:
        table: `ArmModel.table`.
        q: (n,) joint positions [rad].
        v: (n,) joint velocities [rad/s].
        vdot: (n,) joint accelerations [rad/s^2].
        tau_out: (n,) filled with the torques [N m].
    """
    n = table.shape[0] - 1
    x = np.empty(21)
    link = np.empty((n + 1, 12))
    _start(table, x)
    for row in range(n + 1):
        if row < n:
            _advance(table, row, q[row], v[row], vdot[row], x)
        else:
            _advance(table, row, 0.0, 0.0, 0.0, x)
        _link_wrench(table, row, x, link)
    _to_the_joints(table, link, tau_out)
    for row in range(n):
        tau_out[row] += table[row, ROTOR] * vdot[row] + table[row, DAMPING] * v[row]


@njit(cache=True, inline="always")
def _composite_inertia(table: Array, row: int, x: Array, inertia: Array) -> None:
    """Adds a link's inertia about Wo in W: m, m c (3), Ixx, Ixy, Ixz, Iyy, Iyz, Izz."""
    phi, p = table[row, PHI:], three(x, 9)
    m, h, about_Lo = phi[0], apply(nine(x, 12), three(phi, 1)), symmetric(phi, 4)
    inertia[0] += m
    add_into(inertia, 1, plus(h, times(m, p)))
    # From Lo to Wo: 2 p.h 1 - p h' - h p' + m (p.p 1 - p p')
    across = 2.0 * dot(p, h) + m * dot(p, p)
    k = 4
    for i in range(3):
        turned = apply(about_Lo, three(x, 12 + 3 * i))
        for j in range(i, 3):
            value = dot(turned, three(x, 12 + 3 * j))
            value -= p[i] * h[j] + h[i] * p[j] + m * p[i] * p[j]
            if i == j:
                value += across
            inertia[k] += value
            k += 1


@njit(cache=True)
def _mass_matrix(table: Array, link: Array, inertia: Array, M: Array) -> None:
    """M (n, n) from the joints' axes in `link` and the links' inertias; sums them inboard.

    Composite rigid bodies (Featherstone, Rigid Body Dynamics Algorithms, 2008, section 6.2). What
    is in `link` of wrenches is lost.
    """
    n = M.shape[0]
    for row in range(n):
        # Of a unit of the joint's speed: velocity at Wo and angular velocity.
        x = link[row]
        x[9], x[10], x[11] = three(x, 0)
        x[6], x[7], x[8] = cross(three(x, 3), three(x, 9))
        if table[row, SLIDES] != 0.0:
            x[6], x[7], x[8] = three(x, 9)
            x[9] = x[10] = x[11] = 0.0
    for row in range(n - 1, -1, -1):
        for k in range(10):
            inertia[row, k] += inertia[row + 1, k]
        c = inertia[row]
        h = three(c, 1)
        v, w = three(link[row], 6), three(link[row], 9)
        # Momentum about Wo of all that is outboard, for a unit of this joint's speed.
        linear = plus_cross(times(c[0], v), w, h)
        angular = plus_cross(apply(symmetric(c, 4), w), h, v)
        # Only the lower half is needed.
        for i in range(row + 1):
            v, w = three(link[i], 6), three(link[i], 9)
            M[row, i] = dot(w, angular) + v[0] * linear[0] + v[1] * linear[1] + v[2] * linear[2]
        M[row, row] += table[row, ROTOR]


@njit(cache=True)
def solve_spd(M: Array, x: Array) -> None:
    """x := M^-1 x by Cholesky in M's lower half.

    As `vectors.solve`, by columns, and with the last digit of its own: m / sqrt(m) on the diagonal.
    """
    n = x.shape[0]
    for j in range(n):
        for k in range(j):
            for i in range(j, n):
                M[i, j] -= M[i, k] * M[j, k]
        pivot = np.sqrt(M[j, j])
        for i in range(j, n):
            M[i, j] /= pivot
        for k in range(j):
            x[j] -= M[j, k] * x[k]
        x[j] /= M[j, j]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            x[i] -= M[k, i] * x[k]
        x[i] /= M[i, i]


@njit(cache=True)
def forward_dynamics(
    table: Array, q: Array, v: Array, tau: Array, wrench_W: Array, vdot_out: Array
) -> None:
    """Accelerations under joint torques and a wrench on what is beyond S.

    With rotor inertia, joint damping and gravity, as `inverse_dynamics`, of which it is the
    inverse but for dry friction, which a controller does not know:
    M(q) vdot = tau + tau_friction(v) + J^T F - h(q, v).

    Args:
        table: `ArmModel.table`.
        q: (n,) joint positions [rad].
        v: (n,) joint velocities [rad/s].
        tau: (n,) joint torques [N m].
        wrench_W: (6,) [f; tau] on the load, about the world's origin, in W [N, N m].
        vdot_out: (n,) filled with the accelerations [rad/s^2].
    """
    n = table.shape[0] - 1
    x = np.empty(21)
    link = np.empty((n + 1, 12))
    inertia = np.zeros((n + 1, 10))
    M = np.empty((n, n))
    _start(table, x)
    for row in range(n + 1):
        if row < n:
            _advance(table, row, q[row], v[row], 0.0, x)
        else:
            _advance(table, row, 0.0, 0.0, 0.0, x)
        _link_wrench(table, row, x, link)
        _composite_inertia(table, row, x, inertia[row])
    for k in range(6):
        link[n, 6 + k] -= wrench_W[k]
    _to_the_joints(table, link, vdot_out)
    for row in range(n):
        vdot_out[row] = tau[row] - vdot_out[row] - table[row, DAMPING] * v[row]
        if table[row, FRICTION] != 0.0:
            vdot_out[row] += dry_friction(table[row, FRICTION], v[row])
    _mass_matrix(table, link, inertia, M)
    solve_spd(M, vdot_out)
