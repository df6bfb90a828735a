"""Block of the force display at the haptic device."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import Context

from drake_teleop.common.errors import expect_type
from drake_teleop.common.numeric import Array, finite_array
from drake_teleop.station.master import force_display as display
from drake_teleop.station.master.dynamics import HapticDevice
from drake_teleop.station.master.force_display import DISPLAYED_WRENCH_SLICE
from drake_teleop.station.stepped_block import SteppedBlock


class ForceDisplay(SteppedBlock):
    """Block that converts a wrench to motor torques; invalid data fade the wrench to 0 in 50 ms.

    .. pydrake_system::

        name: ForceDisplay
        input_ports:
        - wrench_command: (6,) F_E_B, [f; tau] to render at E, in B [N, N m]
        - joint_position: (6,) of the device [rad]
        output_ports:
        - joint_torque: (6,) J^T F + gravity compensation [N m]
        - force_to_master: (6,) displayed wrench F [N, N m]
        - fault_at_hand: (1,) `Fault` code, 0 without fault

    Args:
        device: haptic device, such as `Master().device(hand_mass=0.0, hand_inertia=0.0)`.
        period: sampling period [s].
        start: (6,) joint positions to use until valid ones arrive [rad].
    """

    __slots__ = ()

    def __init__(self, device: HapticDevice, period: float, start: ArrayLike = (0.0,) * 6) -> None:
        super().__init__()
        expect_type(HapticDevice, device, "ForceDisplay: device", "choose another master.model")
        self._period, self._jacobian = period, np.zeros((6, 6))
        self._parameters = device.packed_parameters
        memory = display.initial_display_state(finite_array("start", start, 6), device.parameters)
        self._command = self.DeclareVectorInputPort("wrench_command", 6)
        self._position = self.DeclareVectorInputPort("joint_position", 6)
        self._declare_step([memory], 1, period)
        self._declare_output("joint_torque", 0, slice(0, 6))
        self._declare_output("force_to_master", 0, DISPLAYED_WRENCH_SLICE)
        fault = DISPLAYED_WRENCH_SLICE.stop
        self._declare_output("fault_at_hand", 0, slice(fault, fault + 1))

    def _advance_states_and_outputs(self, context: Context, results: list[Array]) -> None:
        (drive,), command = results, self._command.Eval(context)
        device = drive.copy()
        device[:6] = self._position.Eval(context)
        display.step_display(command, device, self._parameters, self._period, self._jacobian, drive)
