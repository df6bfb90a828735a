"""An arm of sticks, for films of models whose meshes are missing or cannot be read."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Capsule
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant

from drake_teleop.slave.plant import SlavePlant

_RADIUS = 0.035  # m
_COLOUR = np.array([0.62, 0.64, 0.67, 1.0])


def AddSkeleton(plant: MultibodyPlant, slave: SlavePlant) -> None:
    """Adds to links of which nothing is seen a stick from their joint to the next, or to S.

    To the base one from its origin.

    Args:
        plant: with the arm and a scene graph, not finalized.
        slave: the same arm, finalized, for its numbers.
    """
    known, context = slave.plant, slave.plant.CreateDefaultContext()
    joints = [known.GetJointByName(name, slave.instance) for name in slave.arm.joint_names]
    starts = [joints[0].parent_body().body_frame(), *(j.frame_on_child() for j in joints)]
    ends = [*(joint.frame_on_parent() for joint in joints), slave.sensor_frame]
    for first, last in zip(starts, ends, strict=True):
        body = plant.get_body(first.body().index())
        if plant.GetVisualGeometriesForBody(body) or body.index() == plant.world_body().index():
            continue
        start, end = (
            known.CalcRelativeTransform(context, first.body().body_frame(), frame)
            for frame in (first, last)
        )
        way: NDArray[np.float64] = end.translation() - start.translation()
        length = float(np.linalg.norm(way))
        along = way / length if length > _RADIUS else np.array([0.0, 0.0, 1.0])
        pose = RigidTransform(
            RotationMatrix.MakeFromOneVector(along, 2), start.translation() + way / 2
        )
        stick = Capsule(_RADIUS, max(length, 1e-3))
        plant.RegisterVisualGeometry(body, pose, stick, f"stick_of_{body.name()}", _COLOUR)
