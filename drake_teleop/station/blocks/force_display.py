"""Force display: motor torques J^T F for a wrench F, within the limits of any haptic device."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiscreteValues,
    LeafSystem,
    ValueProducer,
)

from drake_teleop.common.blocks import DoubleOnly, weak_callback
from drake_teleop.common.numeric import Array, finite_array
from drake_teleop.station.master.dynamics import HapticDeviceBase
from drake_teleop.station.master.force_display import (
    DISPLAYED_SLOTS,
    initial_display_state,
    step_display,
)


class ForceDisplay(DoubleOnly, LeafSystem):
    """Block that converts a wrench to motor torques of a haptic device, with a safe state.

    .. pydrake_system::

        name: ForceDisplay
        input_ports:
        - wrench_command: (6,) F_E_B, [f; tau] to render at E, in B [N, N m]
        - joint_position: (6,) of the device [rad]
        output_ports:
        - joint_torque: (6,) J^T F + gravity compensation [N m]
        - force_to_master: (6,) displayed wrench F [N, N m]
        - fault_at_hand: (1,) code of a `Fault`, 0 without fault

    Args:
        device: device model, such as `Master().device(0.0, 0.0)`.
        period: sampling period [s].
        start: (6,) joint positions before the first valid ones.
    """

    __slots__ = ()

    def __init__(
        self, device: HapticDeviceBase, period: float, start: ArrayLike = (0.0,) * 6
    ) -> None:
        super().__init__()
        self._period, self._parameters, self._jacobian = period, device.parameters, np.zeros((6, 6))
        memory = initial_display_state(finite_array("start", start, 6), device.parameters)
        self._command = self.DeclareVectorInputPort("wrench_command", 6)
        self._position = self.DeclareVectorInputPort("joint_position", 6)
        self.DeclareDiscreteState(memory)
        step = self.DeclareCacheEntry(
            "step",
            ValueProducer(
                allocate=lambda: AbstractValue.Make(memory.copy()),
                calc=weak_callback(self._calc_step),
            ),
            {self.all_input_ports_ticket(), self.xd_ticket()},
        )
        self._step = step.cache_index()
        for name, size, calc in (
            ("joint_torque", 6, self._calc_torque),
            ("force_to_master", 6, self._calc_force),
            ("fault_at_hand", 1, self._calc_fault),
        ):
            self.DeclareVectorOutputPort(name, size, weak_callback(calc), {step.ticket()})
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _calc_step(self, context: Context, step: AbstractValue) -> None:
        device = context.get_discrete_state(0).CopyToVector()
        device[:6] = self._position.Eval(context)
        drive, command = step.get_mutable_value(), self._command.Eval(context)
        step_display(command, device, self._parameters, self._period, self._jacobian, drive)

    def _display_state(self, context: Context) -> Array:
        drive: Array = self.get_cache_entry(self._step).Eval(context)
        return drive

    def _calc_torque(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._display_state(context)[:6])

    def _calc_force(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._display_state(context)[DISPLAYED_SLOTS])

    def _calc_fault(self, context: Context, output: BasicVector) -> None:
        output[0] = self._display_state(context)[DISPLAYED_SLOTS.stop]

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        discrete_state.set_value(0, self._display_state(context))
