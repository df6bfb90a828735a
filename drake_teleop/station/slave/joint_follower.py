"""Joint commands for a slave that follows a leader arm joint by joint."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from drake_teleop.common.fault import sound
from drake_teleop.common.lifetime import ONE_DICT, weak_callback
from drake_teleop.station.slave.arm import ArmModel
from drake_teleop.station.slave.inverse_kinematics import IkStatus

Array = NDArray[np.float64]


class JointFollower(LeafSystem):
    """Limits of position and speed for the leader's joints; invalid input holds the command.

    .. pydrake_system::

        name: JointFollower
        input_ports:
        - leader_joints: (n,) requested positions [rad]
        output_ports:
        - joint_command: (n,) [rad]
        - ik_status: an `IkStatus`: OK, JOINT_LIMIT or BAD_POSE
    """

    __slots__ = ONE_DICT

    def __init__(self, arm: ArmModel, q_start: Array, period: float) -> None:
        super().__init__()
        self._lower, self._upper = arm.lower, arm.upper
        self._step = arm.velocity_limit * period
        n = arm.num_joints
        self._leader = self.DeclareVectorInputPort("leader_joints", n)
        self.DeclareDiscreteState(np.array(q_start, dtype=np.float64))
        self.DeclareVectorOutputPort("joint_command", n, weak_callback(self._calc_command))
        self.DeclareVectorOutputPort("ik_status", 1, weak_callback(self._calc_status))
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _next(self, context: Context) -> tuple[Array, IkStatus]:
        last, leader = context.get_discrete_state(0).value(), self._leader.Eval(context)
        if not sound(leader):
            return last, IkStatus.BAD_POSE
        within = np.clip(leader, self._lower, self._upper)
        status = IkStatus.OK if (within == leader).all() else IkStatus.JOINT_LIMIT
        return np.clip(within, last - self._step, last + self._step), status

    def _calc_command(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._next(context)[0])

    def _calc_status(self, context: Context, output: BasicVector) -> None:
        output[0] = self._next(context)[1]

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        discrete_state.set_value(0, self._next(context)[0])
