"""Independent check of a trajectory against every limit at 1 kHz, with Drake's plant."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from pydrake.geometry import QueryObject
from pydrake.multibody.tree import MultibodyForces, SpatialInertia

from drake_teleop.common.numeric import Array
from drake_teleop.lab.excitation.collision import CollisionScene
from drake_teleop.lab.excitation.robot import Robot
from drake_teleop.load.trajectory import FourierTrajectory
from drake_teleop.station.slave.chain_joints import bodies_carried_by

CHECK_RATE_HZ = 1000.0  #: sample rate of the check [Hz]
# Step of finite differences [s]; errors of 1e-7 rad/s and 1e-6 rad/s^2 at 30 rad/s^2.
_DIFFERENCE_STEP_S = 1e-4


@dataclass(frozen=True)
class LimitUse:
    """Largest use of one limit by a motion, and where and when it occurs.

    Attributes:
        used_share: largest |value| over the limit; violated above 1.
        time_s: time of this value [s].
        where: joint, axis or pair of shapes with this value.
    """

    limit_name: str
    used_share: float
    time_s: float
    where: str

    def __str__(self) -> str:
        share = f"{self.used_share:.1%}" if np.isfinite(self.used_share) else "more than all"
        return f"{share} of the {self.limit_name} limit ({self.where}, at {self.time_s:.3f} s)"


def check_trajectory(
    robot: Robot,
    trajectory: FourierTrajectory,
    progress: Callable[[float], None] = lambda done: None,
) -> list[LimitUse]:
    """Return the use of every limit over one period of a trajectory, largest first."""
    t = np.linspace(0, trajectory.period, round(trajectory.period * CHECK_RATE_HZ) + 1)
    before, q, after = (
        trajectory.evaluate(t + step)[0] for step in (-_DIFFERENCE_STEP_S, 0.0, _DIFFERENCE_STEP_S)
    )
    qd = (after - before) / (2 * _DIFFERENCE_STEP_S)
    qdd = (after - 2 * q + before) / _DIFFERENCE_STEP_S**2
    return check_motion(robot, t, q, qd, qdd, progress)


def check_motion(
    robot: Robot,
    t: Array,
    q: Array,
    qd: Array,
    qdd: Array,
    progress: Callable[[float], None] = lambda done: None,
) -> list[LimitUse]:
    """Return, largest first, the use of every limit by joint motion q, qd, qdd (T, n) at t (T,)."""
    names, limits = robot.arm.joint_names, robot.limits
    quantities = _evaluate_limited_quantities(robot, q, qd, qdd, progress)
    torque, sensor, workspace, clearance, nearest = quantities
    sensor_names = ("force", "torque", "specific force", "angular acceleration")
    uses = [
        _largest_limit_use("position", np.abs(q - limits.q_middle) / limits.q_half, t, names),
        _largest_limit_use("velocity", np.abs(qd) / limits.velocity, t, names),
        _largest_limit_use("acceleration", np.abs(qdd) / limits.acceleration, t, names),
        _largest_limit_use("torque", np.abs(torque) / limits.max_torques, t, names),
        _largest_limit_use("sensor", sensor / limits.max_sensor_norms, t, sensor_names),
        _largest_limit_use("workspace", workspace, t, ("x", "y", "z") * len(limits.points_S)),
        _largest_limit_use("clearance", clearance[:, np.newaxis], t, ("",)),
    ]
    uses[-1] = replace(uses[-1], where=nearest[int(np.argmax(clearance))])
    without_end = {"position": limits.q_half, "workspace": limits.box_half}
    missing = [name for name, half in without_end.items() if np.isinf(half).all()]
    uses = [use for use in uses if use.limit_name not in missing]
    return sorted(uses, key=lambda use: -use.used_share)


def _largest_limit_use(limit: str, shares: Array, t: Array, names: tuple[str, ...]) -> LimitUse:
    when, which = np.unravel_index(np.argmax(shares), shares.shape)
    return LimitUse(limit, float(shares[when, which]), float(t[when]), names[which])


def _evaluate_limited_quantities(
    robot: Robot, q: Array, qd: Array, qdd: Array, progress: Callable[[float], None]
) -> tuple[Array, Array, Array, Array, list[str]]:
    # Joint torques, sensor norms, uses of workspace and clearance, nearest shapes.
    scene, limits, arm = robot.scene, robot.limits, robot.arm
    plant, frame_S, root = scene.plant, scene.sensor_frame, scene.diagram.CreateDefaultContext()
    context = plant.GetMyMutableContextFromRoot(root)
    scene_context = scene.scene_graph.GetMyContextFromRoot(root)
    gravity = plant.gravity_field().gravity_vector()
    position, velocity = plant.GetPositions(context), np.zeros(plant.num_velocities())
    acceleration = velocity.copy()
    body, X_BS = frame_S.body(), frame_S.GetFixedPoseInBodyFrame()
    outboard = [each.index() for each in bodies_carried_by(plant, body)]
    M_S = plant.CalcSpatialInertia(context, frame_S, outboard)
    torque, kinematics = np.empty(q.shape), np.empty((len(q), 3, 3))
    workspace = np.empty((len(q), limits.points_S.size))
    clearance, nearest = np.empty(len(q)), []
    for k in range(len(q)):
        position[arm.position_index] = q[k]
        velocity[arm.velocity_index], acceleration[arm.velocity_index] = qd[k], qdd[k]
        plant.SetPositionsAndVelocities(context, np.concatenate([position, velocity]))
        forces = MultibodyForces(plant)
        plant.CalcForceElementsContribution(context, forces)
        tau = plant.CalcInverseDynamics(context, acceleration, forces)
        torque[k] = tau[arm.velocity_index]
        A_WB = plant.CalcSpatialAccelerationsFromVdot(context, acceleration)[body.index()]
        X_WB = plant.EvalBodyPoseInWorld(context, body)
        X_WS = X_WB @ X_BS
        w_WS = plant.EvalBodySpatialVelocityInWorld(context, body).rotational()
        A_WS = A_WB.Shift(X_WB.rotation().multiply(X_BS.translation()), w_WS)
        kinematics[k] = A_WS.translational() - gravity, w_WS, A_WS.rotational()
        kinematics[k] = kinematics[k] @ X_WS.rotation().matrix()
        p = X_WS.multiply(limits.points_S.T).T
        workspace[k] = (np.abs(p - limits.box_middle) / limits.box_half).ravel()
        query = scene.scene_graph.get_query_output_port().Eval(scene_context)
        distance, words = _nearest_shapes(scene, query, limits.clearance + 0.01)
        clearance[k] = limits.clearance / distance if distance > 0 else np.inf
        nearest.append(words)
        if k % 200 == 0:
            progress(k / len(q))
    progress(1.0)
    sensor = _wrench_and_motion_norms(M_S, *kinematics.swapaxes(0, 1))
    return torque, sensor, workspace, clearance, nearest


def _wrench_and_motion_norms(M_S: SpatialInertia, s: Array, omega: Array, alpha: Array) -> Array:
    mass, com = M_S.get_mass(), M_S.get_com()
    inertia = M_S.CalcRotationalInertia().CopyToFullMatrix3()
    force = mass * (s + np.cross(alpha, com) + np.cross(omega, np.cross(omega, com)))
    torque = alpha @ inertia + np.cross(omega, omega @ inertia) + mass * np.cross(com, s)
    return np.linalg.norm([force, torque, s, alpha], axis=2).T


def _nearest_shapes(scene: CollisionScene, query: QueryObject, reach: float) -> tuple[float, str]:
    found = query.ComputeSignedDistancePairwiseClosestPoints(reach)
    if not found:
        return reach, "all shapes are farther apart"
    pair = min(found, key=lambda pair: pair.distance)
    inspector = scene.scene_graph.model_inspector()
    frames = (inspector.GetFrameId(shape) for shape in (pair.id_A, pair.id_B))
    names = (scene.plant.GetBodyFromFrameId(frame).name() for frame in frames)
    return float(pair.distance), " and ".join(names)
