"""Stick figure of an arm, for 3D replays of models without readable meshes."""

from __future__ import annotations

import numpy as np
from pydrake.geometry import Capsule
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, Frame, Joint, RigidBody, WeldJoint

_RADIUS = 0.035  # m
_COLOUR = np.array([0.62, 0.64, 0.67, 1.0])


def AddSkeleton(plant: MultibodyPlant, sensor_frame: Frame) -> None:
    """Add sticks to links without visuals, each from its joint to the next, or to S."""
    joints = map(plant.get_joint, plant.GetJointIndices())
    inboard = {joint.child_body().index(): joint for joint in joints}
    end, body = sensor_frame, sensor_frame.body()
    while body.index() in inboard:
        joint = inboard[body.index()]
        parent = joint.parent_body()
        on_world = parent.index() == plant.world_body().index()
        if not isinstance(joint, WeldJoint):
            _add_stick(plant, joint.frame_on_child(), _in_body(end, body, inboard), body)
            end = joint.frame_on_parent()
        elif on_world:
            _add_stick(plant, body.body_frame(), _in_body(end, body, inboard), body)
        body = parent


def _in_body(frame: Frame, body: RigidBody, inboard: dict[BodyIndex, Joint]) -> RigidTransform:
    """Return X_BodyFrame of a frame on the body, or on a body welded to it."""
    pose, on = frame.GetFixedPoseInBodyFrame(), frame.body()
    while on.index() != body.index():
        weld = inboard[on.index()]
        X_FB = weld.X_FM() @ weld.frame_on_child().GetFixedPoseInBodyFrame().inverse()
        pose = weld.frame_on_parent().GetFixedPoseInBodyFrame() @ X_FB @ pose
        on = weld.parent_body()
    return pose


def _add_stick(plant: MultibodyPlant, first: Frame, last: RigidTransform, body: RigidBody) -> None:
    if plant.GetVisualGeometriesForBody(body):
        return
    start = first.GetFixedPoseInBodyFrame().translation()
    way = last.translation() - start
    length = float(np.linalg.norm(way))
    along = way / length if length > _RADIUS else np.array([0.0, 0.0, 1.0])
    pose = RigidTransform(RotationMatrix.MakeFromOneVector(along, 2), start + way / 2)
    stick = Capsule(_RADIUS, max(length, 1e-3))
    plant.RegisterVisualGeometry(body, pose, stick, f"stick_of_{body.name()}", _COLOUR)
