"""Joint commands during identification, Eqs. (9)-(10)."""

from __future__ import annotations

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from drake_teleop.common.lifetime import ONE_DICT, weak_callback
from drake_teleop.load.trajectory import FourierTrajectory


class JointTrajectory(LeafSystem):
    """One period of an excitation trajectory from `start` [s], at rest before and after.

    .. pydrake_system::

        name: JointTrajectory
        output_ports:
        - joint_command: (n,) [rad]
    """

    __slots__ = ONE_DICT

    def __init__(self, trajectory: FourierTrajectory, start: float) -> None:
        super().__init__()
        self._trajectory, self._start = trajectory, start
        self.DeclareVectorOutputPort("joint_command", len(trajectory.q0), weak_callback(self._calc))

    def _calc(self, context: Context, output: BasicVector) -> None:
        time = np.clip(context.get_time() - self._start, 0.0, self._trajectory.period)
        output.SetFromVector(self._trajectory.evaluate(time)[0])
