"""3D replay of an excitation trajectory."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydrake.geometry import Box, Cylinder, Meshcat, Rgba
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import Context

from drake_teleop.common.numeric import Array
from drake_teleop.common.style import BLUE
from drake_teleop.lab.excitation.check import CHECK_RATE_HZ
from drake_teleop.lab.excitation.excite import Excitation, trajectory_sensor_motion
from drake_teleop.lab.excitation.robot import Robot
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.station import replay_file

_TABLE_COLOUR, _LINK_COLOUR = Rgba(0.85, 0.80, 0.72), Rgba(0.55, 0.58, 0.63)
_TABLE_THICKNESS_M = 0.03


def write_motion_replay(path: Path, excitation: Excitation) -> None:
    robot, trajectory = excitation.robot, excitation.trajectory
    times, slow_motion = replay_file.frame_times(0.0, trajectory.period, 1.0)
    q = trajectory.evaluate(times)[0]
    root = robot.scene.diagram.CreateDefaultContext()
    context = robot.scene.plant.GetMyMutableContextFromRoot(root)
    poses = [_set_posture_and_get_poses_W(robot, context, posture) for posture in q]
    path_S = np.array([pose.translation() for _, pose in poses])
    speed = np.linalg.norm(np.gradient(path_S, times, axis=0), axis=1)
    motion = trajectory_sensor_motion(robot, trajectory)
    force = np.linalg.norm(non_contact_wrench(*motion, robot.limits.heaviest_phi)[:, :3], axis=1)
    samples = np.minimum(np.rint(times * CHECK_RATE_HZ).astype(int), len(force) - 1)
    replay = replay_file.ReplayFile(
        f"Excitation of {robot.name}",
        times,
        slow_motion,
        displayed_numbers=[
            replay_file.DisplayedNumber("Force of the heaviest load", "N", force[samples], BLUE),
            replay_file.DisplayedNumber("Speed of the sensor", "m/s", speed),
        ],
        notes=("Line: path of the sensor, from rest to rest.",),
        clock_label="of the motion",
        curves_label="colour: force at the sensor, 0 to {top} N",
    )

    def make_scene(meshcat: Meshcat) -> replay_file.ShowFrame:
        bodies = np.array([X_WB.translation() for X_WB in poses[0][0].values()])
        _add_table_and_sensor_path(meshcat, path_S, bodies)
        _AddLinkShapesAndLines(meshcat, robot, context)

        def show(replay_time: float, picture_index: int) -> None:
            for body, X_WB in poses[picture_index][0].items():
                meshcat.SetTransform(f"/arm/{int(body)}", X_WB, replay_time)

        return show

    replay.write(path, make_scene)


def _set_posture_and_get_poses_W(
    robot: Robot, context: Context, posture: Array
) -> tuple[dict[BodyIndex, RigidTransform], RigidTransform]:
    plant = robot.scene.plant
    q = plant.GetPositions(context)
    q[robot.arm.position_index] = posture
    plant.SetPositions(context, q)
    bodies = (plant.get_body(BodyIndex(k)) for k in range(1, plant.num_bodies()))
    poses = {body.index(): plant.EvalBodyPoseInWorld(context, body) for body in bodies}
    return poses, robot.scene.sensor_frame.CalcPoseInWorld(context)


def _AddLinkShapesAndLines(meshcat: Meshcat, robot: Robot, context: Context) -> None:
    plant, inspector = robot.scene.plant, robot.scene.scene_graph.model_inspector()
    for k in range(1, plant.num_bodies()):
        body = plant.get_body(BodyIndex(k))
        visuals = plant.GetVisualGeometriesForBody(body)
        shapes = visuals or plant.GetCollisionGeometriesForBody(body)
        replay_file.add_shapes(meshcat, f"/arm/{k}", inspector, shapes, _LINK_COLOUR)
        joints = [] if visuals else [plant.get_joint(index) for index in plant.GetJointIndices()]
        frames = [joint.frame_on_parent() for joint in joints if joint.parent_body() is body]
        if robot.scene.sensor_frame.body() is body and not visuals:
            frames.append(robot.scene.sensor_frame)
        points = (frame.CalcPose(context, body.body_frame()).translation() for frame in frames)
        for number, p_BJ in enumerate(p for p in points if np.linalg.norm(p) > 1e-3):
            name, length = f"/arm/{k}/bone_{number}", float(np.linalg.norm(p_BJ))
            meshcat.SetObject(name, Cylinder(0.04 * length, length), _LINK_COLOUR)
            along = RotationMatrix.MakeFromOneVector(p_BJ, 2)
            meshcat.SetTransform(name, RigidTransform(along, p_BJ / 2))


def _add_table_and_sensor_path(meshcat: Meshcat, path_S: Array, bodies: Array) -> None:
    replay_file.set_plain_background(meshcat)
    visuals = np.vstack([path_S, bodies, np.zeros((1, 3))])
    low, high = visuals.min(axis=0), visuals.max(axis=0)
    middle, size = (low + high) / 2, float(np.linalg.norm(high - low))
    meshcat.SetObject("/room/table", Box(2 * size, 2 * size, _TABLE_THICKNESS_M), _TABLE_COLOUR)
    meshcat.SetTransform("/room/table", RigidTransform([0.0, 0.0, -_TABLE_THICKNESS_M / 2]))
    meshcat.SetLine("/way", path_S.T, 3.0, replay_file.colour_to_rgba(BLUE))
    meshcat.SetCameraPose(middle + size * np.array([0.55, -0.75, 0.3]), middle)
