"""Pose of the slave from the joint angles that its control uses.

Those in the sensor's sample are older and would distort the energy of passivity methods.
"""

from __future__ import annotations

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from drake_teleop.common.compiled import njit
from drake_teleop.common.lifetime import ONE_DICT, weak_callback
from drake_teleop.common.quaternions import quaternion_of
from drake_teleop.station.slave.arm import ArmModel, forward_kinematics


@njit(cache=True)
def pose_into(arm, q, pose):
    """Write X_WS (7,) [qw qx qy qz px py pz] of the arm table at q (n,) [rad]."""
    R, p = np.empty((3, 3)), np.empty(3)
    forward_kinematics(arm, q, R, p)
    orientation = quaternion_of(R)
    for i in range(4):
        pose[i] = orientation[i]
    for i in range(3):
        pose[4 + i] = p[i]


class ForwardKinematics(LeafSystem):
    """Pose of the slave's sensor frame.

    .. pydrake_system::

        name: ForwardKinematics
        input_ports:
        - slave_state: [q; v] of the arm [rad, rad/s]
        output_ports:
        - pose_slave: (7,) X_WS
    """

    __slots__ = ONE_DICT

    def __init__(self, arm: ArmModel) -> None:
        super().__init__()
        self._arm = arm.table
        self._n = arm.num_joints
        self._state = self.DeclareVectorInputPort("slave_state", 2 * arm.num_joints)
        inputs = {self._state.ticket()}
        self.DeclareVectorOutputPort("pose_slave", 7, weak_callback(self._calc), inputs)

    def _calc(self, context: Context, output: BasicVector) -> None:
        pose_into(self._arm, self._state.Eval(context)[: self._n], output.get_mutable_value())
