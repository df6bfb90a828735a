"""Pose of a moving body, for the log and the 3D replay."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    BodyIndex,
    Joint,
    PrismaticJoint,
    QuaternionFloatingJoint,
    RevoluteJoint,
)
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from drake_teleop.common.lifetime import ONE_DICT, weak_callback
from drake_teleop.station.environment.moving_bodies import POSE_AND_TWIST, JointTable, bodies_into


def supports_pose(joint: Joint) -> bool:
    """Return True if the joint's positions follow from a pose, see `positions_of`."""
    kinds = (RevoluteJoint, PrismaticJoint, QuaternionFloatingJoint)
    return joint.num_positions() == 0 or isinstance(joint, kinds)


def positions_of(joint: Joint, X_FM: RigidTransform) -> NDArray[np.float64]:
    """Return the joint positions for the pose X_FM of its child frame."""
    if isinstance(joint, RevoluteJoint):
        turn = AngleAxis(X_FM.rotation().matrix())
        return np.array([turn.angle() * (turn.axis() @ joint.revolute_axis())])
    if isinstance(joint, PrismaticJoint):
        return np.array([X_FM.translation() @ joint.translation_axis()])
    turned = X_FM.rotation().ToQuaternion().wxyz()
    return np.concatenate([turned, X_FM.translation()])[: joint.num_positions()]


class MovingPose(LeafSystem):
    """Pose of a body.

    .. pydrake_system::

        name: MovingPose
        input_ports:
        - plant_state: [q; v] of the whole plant
        output_ports:
        - pose: (7,) [qw, qx, qy, qz, px, py, pz] in W [1, m]
    """

    __slots__ = ONE_DICT

    def __init__(self, plant: MultibodyPlant, body: BodyIndex) -> None:
        super().__init__()
        self._joints, order = JointTable(plant, [body])
        self._bodies = np.empty((len(order), POSE_AND_TWIST))
        self._state = self.DeclareVectorInputPort("plant_state", plant.num_multibody_states())
        self.DeclareVectorOutputPort("pose", 7, weak_callback(self._calc))

    def _calc(self, context: Context, output: BasicVector) -> None:
        bodies_into(self._joints, self._state.Eval(context), self._bodies)
        output.SetFromVector(self._bodies[-1, :7])  # the body is last in its chain
