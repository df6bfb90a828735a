"""What lies between a haptic device and the station: encoders with steps, and a rate of its own.

The hand feels the device itself; what the station reads of it is in steps of the encoders, counted
from the start. A device that is slower than `rates.hand_hz` is read, and takes a force, at its own
rate: both are held in between, and `force_to_master` is the force as it is held.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from drake_teleop.common.compiled import njit
from drake_teleop.common.lifetime import ONE_DICT, weak_callback
from drake_teleop.station.master.dynamics import HapticDevice, pose_into


@njit(cache=True)
def read_pose_into(q, q_start, steps, device, pose):
    """Writes X_BE (7,) as encoders read it: q (6,) to whole `steps` (6,) from `q_start` (6,)."""
    read = np.empty(6)
    for i in range(6):
        away = q[i] - q_start[i]
        read[i] = q_start[i] + (np.rint(away / steps[i]) * steps[i] if steps[i] > 0.0 else away)
    pose_into(read, device, pose)


class Encoders(LeafSystem):
    """The pose that the device's encoders read.

    .. pydrake_system::

        name: Encoders
        input_ports:
        - master_state: (12,) of the device
        output_ports:
        - pose_read: (7,) X_BE

    Args:
        device: whose kinematics it is.
        q_start: (6,) from where it counts.
        steps: (6,) of its axes [m, rad]; 0 for one that is read exactly.
    """

    __slots__ = ONE_DICT

    def __init__(
        self, device: HapticDevice, q_start: NDArray[np.float64], steps: NDArray[np.float64]
    ) -> None:
        super().__init__()
        self._constants = q_start, steps, device.numbers
        self._state = self.DeclareVectorInputPort("master_state", 12)
        inputs = {self._state.ticket()}
        self.DeclareVectorOutputPort("pose_read", 7, weak_callback(self._read), inputs)

    def _read(self, context: Context, output: BasicVector) -> None:
        q = self._state.Eval(context)[:6]
        read_pose_into(q, *self._constants, output.get_mutable_value())


class Held(LeafSystem):
    """A vector that is looked at with a rate of its own. Unlike Drake's hold it has a start.

    .. pydrake_system::

        name: Held
        input_ports:
        - value: (n,)
        output_ports:
        - held: (n,) as it was at the last look

    Args:
        period: from one look to the next [s].
        start: (n,) before the first.
    """

    __slots__ = ONE_DICT

    def __init__(self, period: float, start: NDArray[np.float64]) -> None:
        super().__init__()
        self._value = self.DeclareVectorInputPort("value", len(start))
        self.DeclareStateOutputPort("held", self.DeclareDiscreteState(start))
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._look)

    def _look(self, context: Context, discrete_state: DiscreteValues) -> None:
        discrete_state.set_value(0, self._value.Eval(context))
