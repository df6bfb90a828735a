"""Kinematics and inverse dynamics of any serial arm, compiled (long: recursions over one table).

`ArmModelFromPlant` reads the arm out of a finalized MultibodyPlant into one table of numbers; the
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
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    BodyIndex,
    Joint,
    JointActuator,
    ModelInstanceIndex,
    RevoluteJoint,
    RigidBody,
    SpatialInertia,
    WeldJoint,
)

from drake_teleop._compiled import njit
from drake_teleop.errors import DrakeTeleopError

Array = NDArray[np.float64]

# Columns of ArmModel.table.
_ROTATION, _TRANSLATION, _PHI, _ROTOR, _DAMPING, _WIDTH = 0, 9, 12, 22, 23, 25
# In the last row, which has no joint, gravity stands from here on.
_GRAVITY = 22

MOTION_SIZE = 21
"""Length of the vector that `sensor_motion` fills."""


@dataclass(frozen=True, eq=False)
class ArmModel:
    """A serial chain of n revolute joints from the world to the sensor frame S, as plain arrays.

    Link frame L_j turns with joint j about its z axis and coincides with the joint's frame J_j at
    q_j = 0; L_0 is the world. Everything welded to a link belongs to the link; everything outboard
    of the body that carries S is the load.

    Attributes:
        joint_names: names of the joints, from the base outwards.
        table: (n+1, 25), what the kernels read. Row j, of joint j (row n: of S, fixed to L_n):
            columns 0-8 rotation from the joint's frame to the previous link's (by rows), 9-11 its
            origin in the previous link's frame [m], 12-21 phi of the link about the origin of L_j
            in L_j (row n: of the load, in S), ordered [m, m c (3), Ixx, Ixy, Ixz, Iyy, Iyz, Izz],
            22 reflected rotor inertia [kg m^2], 23 damping [N m s/rad]; in row n columns 22-24 are
            gravity in the world [m/s^2].
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
        return self.table[-1, _PHI:_ROTOR]

    def with_load(self, phi: Array) -> ArmModel:
        """The same arm carrying ``phi`` (10,) beyond S instead; zeros for the bare arm."""
        table = self.table.copy()
        table[-1, _PHI:_ROTOR] = phi
        return replace(self, table=table)


def ArmModelFromPlant(
    plant: MultibodyPlant,
    model_instance: ModelInstanceIndex,
    sensor_frame_name: str = "sensor",
) -> ArmModel:
    """Reads the chain from the world to a sensor frame out of a finalized plant.

    Joints beyond the sensor frame (a gripper's fingers) count as held at their default positions.

    Args:
        plant: a finalized plant; other models in it do not matter, whatever is attached to the arm
            counts, whichever model instance it belongs to.
        model_instance: the arm's.
        sensor_frame_name: a frame of that model instance, on the last link or welded to it.

    Raises:
        DrakeTeleopError: there is no such frame, or what leads to it from the world is not a chain
            of welds and revolute joints, or a link carries a further moving joint.
    """
    if not plant.HasFrameNamed(sensor_frame_name, model_instance):
        raise DrakeTeleopError(
            f"the arm has no frame named {sensor_frame_name!r}",
            where=plant.GetModelInstanceName(model_instance),
            remedy="name the frame or link at which the sensor measures",
        )
    frame_S = plant.GetFrameByName(sensor_frame_name, model_instance)
    inboard = {
        joint.child_body().index(): joint for joint in map(plant.get_joint, plant.GetJointIndices())
    }
    joints = _chain(inboard, frame_S.body())
    n = len(joints)
    table = np.zeros((n + 1, _WIDTH))
    for row, joint in enumerate(joints):
        table[row, _ROTOR] = _reflected_inertia(plant, joint)
        table[row, _DAMPING] = joint.default_damping()
    gravity = plant.gravity_field()
    table[n, _GRAVITY:] = gravity.gravity_vector() * gravity.is_enabled(model_instance)

    context = plant.CreateDefaultContext()
    # C turns the joint's axis into z.
    C = [RigidTransform(RotationMatrix.MakeFromOneVector(j.revolute_axis(), 2)) for j in joints]
    X_WS = frame_S.CalcPoseInWorld(context)
    X_WJ = [
        j.frame_on_parent().CalcPoseInWorld(context) @ X for j, X in zip(joints, C, strict=True)
    ]
    X_WL = [j.frame_on_child().CalcPoseInWorld(context) @ X for j, X in zip(joints, C, strict=True)]
    X_WJ.append(X_WS)
    X_WL.append(X_WS)
    for row, X_WP in enumerate([RigidTransform(), *X_WL[:-1]]):
        X_PJ = X_WP.InvertAndCompose(X_WJ[row])
        table[row, _ROTATION:_TRANSLATION] = X_PJ.rotation().matrix().ravel()
        table[row, _TRANSLATION:_PHI] = X_PJ.translation()
    rows = {joint.child_body().index(): row for row, joint in enumerate(joints)}
    for index in inboard:
        body = plant.get_body(index)
        found = _row_of(body, inboard, rows, frame_S.body())
        if found is not None:
            X_LB = X_WL[found].InvertAndCompose(body.EvalPoseInWorld(context))
            M_B = body.CalcSpatialInertiaInBodyFrame(context)
            table[found, _PHI:_ROTOR] += _phi(M_B, X_LB)
    return ArmModel(
        joint_names=tuple(joint.name() for joint in joints),
        table=table,
        lower=_per_joint([j.position_lower_limits()[0] for j in joints]),
        upper=_per_joint([j.position_upper_limits()[0] for j in joints]),
        velocity_limit=_per_joint([j.velocity_upper_limits()[0] for j in joints]),
        acceleration_limit=_per_joint([j.acceleration_upper_limits()[0] for j in joints]),
        effort_limit=_per_joint([_effort_limit(plant, j) for j in joints]),
        position_index=np.array([j.position_start() for j in joints], dtype=np.intp),
        velocity_index=np.array([j.velocity_start() for j in joints], dtype=np.intp),
    )


def _per_joint(values: list[float]) -> Array:
    return np.array(values, dtype=np.float64)


def _chain(inboard: dict[BodyIndex, Joint], body: RigidBody) -> list[RevoluteJoint]:
    """The revolute joints from the world to ``body``, from the base outwards."""
    joints: list[RevoluteJoint] = []
    while body.index() in inboard:
        joint = inboard[body.index()]
        if isinstance(joint, RevoluteJoint):
            joints.append(joint)
        elif not isinstance(joint, WeldJoint):
            raise DrakeTeleopError(
                f"the arm hangs on a {joint.type_name()} joint",
                where=joint.name(),
                remedy="weld the arm's base to the world and use revolute joints up to the sensor",
            )
        body = joint.parent_body()
    if not joints:
        raise DrakeTeleopError(
            "no revolute joint between the world and the sensor frame", where=body.name()
        )
    return joints[::-1]


def _row_of(
    body: RigidBody,
    inboard: dict[BodyIndex, Joint],
    rows: dict[BodyIndex, int],
    sensor_body: RigidBody,
) -> int | None:
    """The row of the table that carries the body's inertia; None if the arm does not carry it."""
    moving = None
    outermost = body
    while True:
        if body.index() == sensor_body.index() and outermost.index() != body.index():
            return len(rows)
        if body.index() in rows:
            break
        if body.index() not in inboard:
            return None
        joint = inboard[body.index()]
        if not isinstance(joint, WeldJoint):
            moving = joint
        body = joint.parent_body()
    if moving is not None:
        raise DrakeTeleopError(
            f"link {body.name()} carries a moving part beside the chain to the sensor",
            where=moving.name(),
            remedy="weld that joint",
        )
    return rows[body.index()]


def _phi(M_BBo_B: SpatialInertia, X_LB: RigidTransform) -> Array:
    """(10,) phi of a body about the origin of L, in L."""
    M_BBo_L = M_BBo_B.ReExpress(X_LB.rotation())
    M_BLo_L = M_BBo_L.Shift(np.negative(X_LB.translation()))
    I_BLo_L = M_BLo_L.CalcRotationalInertia().CopyToFullMatrix3()
    return np.array([M_BLo_L.get_mass(), *M_BLo_L.CalcComMoment(), *I_BLo_L[np.triu_indices(3)]])


def _actuators(plant: MultibodyPlant, joint: Joint) -> list[JointActuator]:
    actuators = map(plant.get_joint_actuator, plant.GetJointActuatorIndices())
    return [a for a in actuators if a.joint().index() == joint.index()]


def _reflected_inertia(plant: MultibodyPlant, joint: Joint) -> float:
    return sum(a.default_reflected_inertia() for a in _actuators(plant, joint))


def _effort_limit(plant: MultibodyPlant, joint: Joint) -> float:
    return min((a.effort_limit() for a in _actuators(plant, joint)), default=np.inf)


@njit(cache=True, inline="always")
def _advance_pose(table: Array, row: int, q: float, x: Array) -> tuple[float, float, float]:
    """Moves the pose in x from the previous link to this one; returns p_PL_W."""
    r0 = r1 = r2 = 0.0
    for k in range(3):
        p = table[row, 9 + k]
        r0 += x[12 + k] * p
        r1 += x[15 + k] * p
        r2 += x[18 + k] * p
    x[9] += r0
    x[10] += r1
    x[11] += r2
    c = np.cos(q)
    s = np.sin(q)
    for i in range(12, 21, 3):
        a, b, d = x[i], x[i + 1], x[i + 2]
        u = a * table[row, 0] + b * table[row, 3] + d * table[row, 6]
        v = a * table[row, 1] + b * table[row, 4] + d * table[row, 7]
        x[i] = c * u + s * v
        x[i + 1] = c * v - s * u
        x[i + 2] = a * table[row, 2] + b * table[row, 5] + d * table[row, 8]
    return r0, r1, r2


@njit(cache=True, inline="always")
def _advance(table: Array, row: int, q: float, qd: float, qdd: float, x: Array) -> None:
    """Moves the state x from the previous link to this one."""
    r0, r1, r2 = _advance_pose(table, row, q, x)
    w0, w1, w2, a0, a1, a2 = x[3], x[4], x[5], x[6], x[7], x[8]
    # omega x r, then alpha x r + omega x (omega x r)
    u0 = w1 * r2 - w2 * r1
    u1 = w2 * r0 - w0 * r2
    u2 = w0 * r1 - w1 * r0
    x[0] += a1 * r2 - a2 * r1 + w1 * u2 - w2 * u1
    x[1] += a2 * r0 - a0 * r2 + w2 * u0 - w0 * u2
    x[2] += a0 * r1 - a1 * r0 + w0 * u1 - w1 * u0
    z0, z1, z2 = x[14], x[17], x[20]
    x[3] += z0 * qd
    x[4] += z1 * qd
    x[5] += z2 * qd
    x[6] += z0 * qdd + (w1 * z2 - w2 * z1) * qd
    x[7] += z1 * qdd + (w2 * z0 - w0 * z2) * qd
    x[8] += z2 * qdd + (w0 * z1 - w1 * z0) * qd


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
    g = table[table.shape[0] - 1, _GRAVITY : _GRAVITY + 3]
    for i in range(3):
        out[i] = s[i] + R_WS[0, i] * g[0] + R_WS[1, i] * g[1] + R_WS[2, i] * g[2]


@njit(cache=True, inline="always")
def _start(table: Array, x: Array) -> None:
    """The state of the world's frame at rest: s = -g, identity pose."""
    x[:] = 0.0
    for k in range(3):
        x[k] = -table[table.shape[0] - 1, _GRAVITY + k]
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
    n = table.shape[0] - 1
    x = np.zeros(21)
    x[12] = x[16] = x[20] = 1.0
    for row in range(n):
        _advance_pose(table, row, q[row], x)
        for i in range(3):
            J_out[i, row] = x[9 + i]
            J_out[3 + i, row] = x[14 + 3 * i]
    _advance_pose(table, n, 0.0, x)
    for row in range(n):
        r0 = x[9] - J_out[0, row]
        r1 = x[10] - J_out[1, row]
        r2 = x[11] - J_out[2, row]
        J_out[0, row] = J_out[4, row] * r2 - J_out[5, row] * r1
        J_out[1, row] = J_out[5, row] * r0 - J_out[3, row] * r2
        J_out[2, row] = J_out[3, row] * r1 - J_out[4, row] * r0


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
    for i in range(0, 9, 3):
        a, b, c = out[i], out[i + 1], out[i + 2]
        for k in range(3):
            out[i + k] = out[12 + k] * a + out[15 + k] * b + out[18 + k] * c


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
    m, h0, h1, h2 = table[row, 12], table[row, 13], table[row, 14], table[row, 15]
    xx, xy, xz = table[row, 16], table[row, 17], table[row, 18]
    yy, yz, zz = table[row, 19], table[row, 20], table[row, 21]
    s0 = x[12] * x[0] + x[15] * x[1] + x[18] * x[2]
    s1 = x[13] * x[0] + x[16] * x[1] + x[19] * x[2]
    s2 = x[14] * x[0] + x[17] * x[1] + x[20] * x[2]
    w0 = x[12] * x[3] + x[15] * x[4] + x[18] * x[5]
    w1 = x[13] * x[3] + x[16] * x[4] + x[19] * x[5]
    w2 = x[14] * x[3] + x[17] * x[4] + x[20] * x[5]
    a0 = x[12] * x[6] + x[15] * x[7] + x[18] * x[8]
    a1 = x[13] * x[6] + x[16] * x[7] + x[19] * x[8]
    a2 = x[14] * x[6] + x[17] * x[7] + x[20] * x[8]
    u0, u1, u2 = w1 * h2 - w2 * h1, w2 * h0 - w0 * h2, w0 * h1 - w1 * h0
    f0 = m * s0 + a1 * h2 - a2 * h1 + w1 * u2 - w2 * u1
    f1 = m * s1 + a2 * h0 - a0 * h2 + w2 * u0 - w0 * u2
    f2 = m * s2 + a0 * h1 - a1 * h0 + w0 * u1 - w1 * u0
    l0 = xx * w0 + xy * w1 + xz * w2
    l1 = xy * w0 + yy * w1 + yz * w2
    l2 = xz * w0 + yz * w1 + zz * w2
    t0 = xx * a0 + xy * a1 + xz * a2 + w1 * l2 - w2 * l1 + h1 * s2 - h2 * s1
    t1 = xy * a0 + yy * a1 + yz * a2 + w2 * l0 - w0 * l2 + h2 * s0 - h0 * s2
    t2 = xz * a0 + yz * a1 + zz * a2 + w0 * l1 - w1 * l0 + h0 * s1 - h1 * s0
    for i in range(3):
        j = 12 + 3 * i
        link[row, i] = x[j + 2]
        link[row, 3 + i] = x[9 + i]
        link[row, 6 + i] = x[j] * f0 + x[j + 1] * f1 + x[j + 2] * f2
        link[row, 9 + i] = x[j] * t0 + x[j + 1] * t1 + x[j + 2] * t2
    p0, p1, p2 = link[row, 3], link[row, 4], link[row, 5]
    g0, g1, g2 = link[row, 6], link[row, 7], link[row, 8]
    link[row, 9] += p1 * g2 - p2 * g1
    link[row, 10] += p2 * g0 - p0 * g2
    link[row, 11] += p0 * g1 - p1 * g0


@njit(cache=True)
def _to_the_joints(link: Array, tau: Array) -> None:
    """Torques (n,) of the joints for the links' wrenches, see `_link_wrench`; sums them inboard."""
    n = tau.shape[0]
    for row in range(n, 0, -1):
        for k in range(6, 12):
            link[row - 1, k] += link[row, k]
    for row in range(n):
        z0, z1, z2 = link[row, 0], link[row, 1], link[row, 2]
        p0, p1, p2 = link[row, 3], link[row, 4], link[row, 5]
        f0, f1, f2 = link[row, 6], link[row, 7], link[row, 8]
        tau[row] = (
            z0 * (link[row, 9] - p1 * f2 + p2 * f1)
            + z1 * (link[row, 10] - p2 * f0 + p0 * f2)
            + z2 * (link[row, 11] - p0 * f1 + p1 * f0)
        )


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
    _to_the_joints(link, tau_out)
    for row in range(n):
        tau_out[row] += table[row, _ROTOR] * vdot[row] + table[row, _DAMPING] * v[row]


@njit(cache=True, inline="always")
def _composite_inertia(table: Array, row: int, x: Array, inertia: Array) -> None:
    """Adds a link's inertia about Wo in W: m, m c (3), Ixx, Ixy, Ixz, Iyy, Iyz, Izz."""
    m, h0, h1, h2 = table[row, 12], table[row, 13], table[row, 14], table[row, 15]
    p0, p1, p2 = x[9], x[10], x[11]
    u0 = x[12] * h0 + x[13] * h1 + x[14] * h2
    u1 = x[15] * h0 + x[16] * h1 + x[17] * h2
    u2 = x[18] * h0 + x[19] * h1 + x[20] * h2
    inertia[0] += m
    inertia[1] += u0 + m * p0
    inertia[2] += u1 + m * p1
    inertia[3] += u2 + m * p2
    # From Lo to Wo: 2 p.h 1 - p h' - h p' + m (p.p 1 - p p')
    across = 2.0 * (p0 * u0 + p1 * u1 + p2 * u2) + m * (p0 * p0 + p1 * p1 + p2 * p2)
    k = 4
    for i in range(3):
        a, b, c = x[12 + 3 * i], x[13 + 3 * i], x[14 + 3 * i]
        r0 = a * table[row, 16] + b * table[row, 17] + c * table[row, 18]
        r1 = a * table[row, 17] + b * table[row, 19] + c * table[row, 20]
        r2 = a * table[row, 18] + b * table[row, 20] + c * table[row, 21]
        u_i = u0 if i == 0 else (u1 if i == 1 else u2)
        for j in range(i, 3):
            u_j = u0 if j == 0 else (u1 if j == 1 else u2)
            value = r0 * x[12 + 3 * j] + r1 * x[13 + 3 * j] + r2 * x[14 + 3 * j]
            value -= x[9 + i] * u_j + u_i * x[9 + j] + m * x[9 + i] * x[9 + j]
            if i == j:
                value += across
            inertia[k] += value
            k += 1


@njit(cache=True)
def _mass_matrix(table: Array, link: Array, inertia: Array, M: Array) -> None:
    """M (n, n) from the joints' axes in `link` and the links' inertias; sums them inboard.

    Composite rigid bodies (Featherstone, Rigid Body Dynamics Algorithms, 2008, section 6.2).
    """
    n = M.shape[0]
    for row in range(n - 1, -1, -1):
        for k in range(10):
            inertia[row, k] += inertia[row + 1, k]
        c = inertia[row]
        z0, z1, z2 = link[row, 0], link[row, 1], link[row, 2]
        p0, p1, p2 = link[row, 3], link[row, 4], link[row, 5]
        v0, v1, v2 = p1 * z2 - p2 * z1, p2 * z0 - p0 * z2, p0 * z1 - p1 * z0
        # Momentum about Wo of all that is outboard, for a unit of this joint's speed.
        l0 = c[0] * v0 + z1 * c[3] - z2 * c[2]
        l1 = c[0] * v1 + z2 * c[1] - z0 * c[3]
        l2 = c[0] * v2 + z0 * c[2] - z1 * c[1]
        a0 = c[4] * z0 + c[5] * z1 + c[6] * z2 + c[2] * v2 - c[3] * v1
        a1 = c[5] * z0 + c[7] * z1 + c[8] * z2 + c[3] * v0 - c[1] * v2
        a2 = c[6] * z0 + c[8] * z1 + c[9] * z2 + c[1] * v1 - c[2] * v0
        M[row, row] = z0 * a0 + z1 * a1 + z2 * a2 + v0 * l0 + v1 * l1 + v2 * l2
        M[row, row] += table[row, _ROTOR]
        # Only the lower half is needed; the axis of joint i moves along z_i through p_i.
        for i in range(row):
            z0, z1, z2 = link[i, 0], link[i, 1], link[i, 2]
            p0, p1, p2 = link[i, 3], link[i, 4], link[i, 5]
            M[row, i] = (
                z0 * a0 + z1 * a1 + z2 * a2
                + (p1 * z2 - p2 * z1) * l0 + (p2 * z0 - p0 * z2) * l1 + (p0 * z1 - p1 * z0) * l2
            )  # fmt: skip


@njit(cache=True)
def _solve_spd(M: Array, x: Array) -> None:
    """x := M^-1 x by Cholesky in M's lower half: so small that LAPACK's calls would cost more."""
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
    inverse: M(q) vdot = tau + J^T F - h(q, v).

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
    _to_the_joints(link, vdot_out)
    for row in range(n):
        vdot_out[row] = tau[row] - vdot_out[row] - table[row, _DAMPING] * v[row]
    _mass_matrix(table, link, inertia, M)
    _solve_spd(M, vdot_out)
