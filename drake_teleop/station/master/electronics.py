"""Encoders with finite steps, and the sampling rate of a slow haptic device."""

from __future__ import annotations

import numpy as np
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from drake_teleop.common.blocks import NO_EXTRA_SLOTS, weak_callback
from drake_teleop.common.compiled import njit
from drake_teleop.common.numeric import Array
from drake_teleop.station.master.dynamics import HapticDevice, pose_into


@njit(cache=True)
def encoder_pose_into(q, q_start, steps, packed_device, pose):
    """Write the pose X_BE (7,) of q (6,) rounded to whole encoder steps from `q_start` (6,).

    `steps` (6,) are in m or rad; 0 disables rounding.
    """
    read = np.empty(6)
    for i in range(6):
        away = q[i] - q_start[i]
        read[i] = q_start[i] + (np.rint(away / steps[i]) * steps[i] if steps[i] > 0.0 else away)
    pose_into(read, packed_device[0], pose)


class Encoders(LeafSystem):
    """Encoders that round joint positions to `steps` (6,) [m, rad] from `q_start` (6,); 0: exact.

    .. pydrake_system::

        name: Encoders
        input_ports:
        - master_state: (12,) state of the device
        output_ports:
        - pose_read: (7,) X_BE of the rounded positions
    """

    __slots__ = NO_EXTRA_SLOTS

    def __init__(self, device: HapticDevice, q_start: Array, steps: Array) -> None:
        super().__init__()
        self._constants = q_start, steps, device.packed_parameters
        self._state = self.DeclareVectorInputPort("master_state", 12)
        inputs = {self._state.ticket()}
        self.DeclareVectorOutputPort("pose_read", 7, weak_callback(self._calc_encoder_pose), inputs)

    def _calc_encoder_pose(self, context: Context, output: BasicVector) -> None:
        q = self._state.Eval(context)[:6]
        encoder_pose_into(q, *self._constants, output.get_mutable_value())


class SampleHold(LeafSystem):
    """Sample and hold with `period` [s]; unlike Drake's ZeroOrderHold it has a start value (n,).

    .. pydrake_system::

        name: SampleHold
        input_ports:
        - value: (n,)
        output_ports:
        - held: (n,) value at the last sample
    """

    __slots__ = NO_EXTRA_SLOTS

    def __init__(self, period: float, start: Array) -> None:
        super().__init__()
        self._value = self.DeclareVectorInputPort("value", len(start))
        self.DeclareStateOutputPort("held", self.DeclareDiscreteState(start))
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._sample_and_hold_input)

    def _sample_and_hold_input(self, context: Context, discrete_state: DiscreteValues) -> None:
        discrete_state.set_value(0, self._value.Eval(context))
