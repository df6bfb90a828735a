"""Command of the slave joint by joint by a leader arm: q_slave = q_start + (q_leader - q_home)."""

from __future__ import annotations

import numpy as np
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from drake_teleop.common.blocks import NO_EXTRA_SLOTS, weak_callback
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.station.slave.arm import ArmModel, pose_into


class JointCoupling(LeafSystem):
    """Block that couples the slave's joint positions to those of the leader arm, with a clutch.

    While the clutch is open the command is constant. When it closes the command jumps to
    start + (leader's joints - home), and follows it.

    .. pydrake_system::

        name: JointCoupling
        input_ports:
        - master_state: (2 n,) [q; dq/dt] of the leader [rad, rad/s]
        - clutch: (1,) engaged if above 0.5; unconnected it is always engaged
        output_ports:
        - leader_joints: (n,) commanded joint positions of the slave [rad]
        - pose_command: (7,) X_WS for these joints

    The command is `start` (n,) [rad] when the leader is at `home` (n,) [rad].
    """

    __slots__ = NO_EXTRA_SLOTS

    def __init__(self, slave: ArmModel, start: Array, home: Array, period: float) -> None:
        super().__init__()
        if len(home) != len(start):
            numbers = f"{len(home)} joints, but the slave {len(start)}"
            what = f"the leader has {numbers} (they must agree)"
            remedy = "set leads: pose, or give arms of the same kinematics"
            raise DrakeTeleopError(what, where="master.leader.leads", remedy=remedy)
        self._table, self._offset, n = slave.table, np.array(start) - home, len(start)
        self._state = self.DeclareVectorInputPort("master_state", 2 * n)
        self._clutch = self.DeclareVectorInputPort("clutch", 1)
        self.DeclareDiscreteState(np.append(start, 0.0))  # joints; clutch closed
        sources = {self._state.ticket(), self.xd_ticket()}
        joints, pose = weak_callback(self._calc_joints), weak_callback(self._calc_pose)
        self.DeclareVectorOutputPort("leader_joints", n, joints, sources)
        self.DeclareVectorOutputPort("pose_command", 7, pose, sources)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update_joints_and_clutch)
        self.DeclareInitializationDiscreteUpdateEvent(self._update_joints_and_clutch)

    def _commanded_joint_positions(self, context: Context) -> Array:
        memory, n = context.get_discrete_state(0).value(), len(self._offset)
        joints: Array = memory[:n]
        return self._state.Eval(context)[:n] + self._offset if memory[n] > 0.5 else joints

    def _calc_joints(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._commanded_joint_positions(context))

    def _calc_pose(self, context: Context, output: BasicVector) -> None:
        joints = np.array(self._commanded_joint_positions(context))
        pose_into(self._table, joints, output.get_mutable_value())

    def _update_joints_and_clutch(self, context: Context, discrete_state: DiscreteValues) -> None:
        memory = discrete_state.get_mutable_value(0)
        joints = self._commanded_joint_positions(context)
        if np.isfinite(joints).all():  # an opened clutch must hold a finite command
            memory[:-1] = joints
        memory[-1] = not self._clutch.HasValue(context) or self._clutch.Eval(context)[0] > 0.5
