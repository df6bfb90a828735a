"""Force display of the master: converts a wrench to motor torques within the device's limits."""

from __future__ import annotations

import math

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from drake_teleop.common.blocks import NO_EXTRA_SLOTS, Fault, are_valid_port_values, weak_callback
from drake_teleop.common.compiled import njit
from drake_teleop.common.numeric import Array
from drake_teleop.common.vectors import copy_into
from drake_teleop.station.master import dynamics
from drake_teleop.station.master.device_parameters import DeviceParameters
from drake_teleop.station.master.leader import LeaderDevice, scale_wrench_to_motor_limits
from drake_teleop.station.passivity import safe_state
from drake_teleop.station.passivity.memory import SlotAllocator
from drake_teleop.station.passivity.packet import limit_group

# Vector from the device: joint positions, and memory of the last period: last valid positions,
# displayed wrench and fault, 1 if a fault changed the wrench, time since the last fault [s], memory
# of `master_wrench_limits_into`. Vector to the device: motor torques in place of the positions, and
# the new memory.
_memory = SlotAllocator(6 + 6 + 7 + 1 + 1 + safe_state.MASTER_MONITOR_SIZE)
_JOINT_POSITIONS_SLICE, _LAST_VALID_POSITIONS_SLICE = _memory.vector(6), _memory.vector(6)
DISPLAYED_WRENCH_SLICE, _FAULT_INDEX = _memory.vector(6), _memory.number()
_IS_WRENCH_REDUCED_INDEX, _FAULT_AGE_INDEX = _memory.number(), _memory.number()
_SAFE_STATE_MONITOR_SLICE = _memory.vector(safe_state.MASTER_MONITOR_SIZE)
_DISPLAYED_WRENCH_AND_FAULT_SLICE = slice(DISPLAYED_WRENCH_SLICE.start, _FAULT_INDEX + 1)
_NO_FAULT, _WRENCH_FAULT, _HAND_FAULT, _RESUMING_FAULT = map(
    int, (Fault.NONE, Fault.HAND_WRENCH, Fault.HAND_JOINTS, Fault.RESUMING)
)


@njit(cache=True)
def _peak_force_and_torque_of_device(parameters):
    return np.array([parameters.peak_force, parameters.peak_torque.max()])


def initial_display_state(q: Array, parameters: DeviceParameters) -> Array:
    display = np.zeros(_SAFE_STATE_MONITOR_SLICE.stop)
    display[_JOINT_POSITIONS_SLICE] = display[_LAST_VALID_POSITIONS_SLICE] = q
    peaks = _peak_force_and_torque_of_device(parameters)
    display[_SAFE_STATE_MONITOR_SLICE] = safe_state.initial_master_monitor(peaks)
    return display


@njit(cache=True)
def limit_wrench_into(wrench, parameters, J, displayed):
    """Write `wrench` (6,) [f; tau] at E, in B, reduced to the device's limits, into `displayed`.

    Force and torque keep their directions. A wrench that is not finite gives zero.
    """
    for k in range(6):
        if not math.isfinite(wrench[k]):
            displayed[:] = 0.0
            return
    # hypot does not overflow.
    force = math.hypot(math.hypot(wrench[0], wrench[1]), wrench[2])
    scale = 1.0 if force <= parameters.peak_force else parameters.peak_force / force
    for k in range(3):
        displayed[k] = scale * wrench[k]
    scale, peak = 1.0, parameters.peak_torque
    for i in range(3):
        motor = abs(J[3, 3 + i] * wrench[3] + J[4, 3 + i] * wrench[4] + J[5, 3 + i] * wrench[5])
        if motor * scale > peak[i]:
            scale = peak[i] / motor
    for k in range(3, 6):
        displayed[k] = scale * wrench[k]


@njit(cache=True)
def motor_torque_into(displayed, q, parameters, J, torque):
    """Write motor torques (6,), J^T `displayed` plus gravity compensation at q, into `torque`."""
    dynamics.gravity_compensation_torque_into(q, parameters, torque)
    for i in range(6):
        for k in range(6):
            torque[i] += J[k, i] * displayed[k]


@njit(cache=True, omits_reference_counting=True)
def step_display(wrench, device, packed_parameters, period, J, drive):
    """Advance the force display by one `period` [s] for the wrench F_E_B (6,) to render.

    `device` (27,) is the output `for_display` of the device block; `drive` (27,) its next input.
    """
    parameters = packed_parameters[0]
    q, fault = device[_JOINT_POSITIONS_SLICE], _NO_FAULT
    copy_into(drive, 6, device, 6, _SAFE_STATE_MONITOR_SLICE.stop - 6)
    if are_valid_port_values(q):
        copy_into(drive, _LAST_VALID_POSITIONS_SLICE.start, q, 0, 6)
    else:
        q, fault = device[_LAST_VALID_POSITIONS_SLICE], _HAND_FAULT
    if not are_valid_port_values(wrench):
        fault = _WRENCH_FAULT
    displayed, drive[_FAULT_INDEX] = drive[DISPLAYED_WRENCH_SLICE], fault
    dynamics.jacobian_into(q, parameters, J)
    limit_wrench_into(wrench, parameters, J, displayed)
    if fault != _NO_FAULT or device[_IS_WRENCH_REDUCED_INDEX] != 0.0:
        _fade_wrench_after_fault(device, parameters, period, drive)
    motor_torque_into(displayed, q, parameters, J, drive[:6])


@njit(cache=True)
def _fade_wrench_after_fault(device, parameters, period, drive):
    displayed, last = drive[DISPLAYED_WRENCH_SLICE], device[DISPLAYED_WRENCH_SLICE]
    limits, device_limits = np.empty(2), _peak_force_and_torque_of_device(parameters)
    fault = drive[_FAULT_INDEX] != _NO_FAULT
    drive[_FAULT_AGE_INDEX] = 0.0 if fault else device[_FAULT_AGE_INDEX] + period
    # Complete within STOP_TIME_S, so that the direction does not jump either.
    left = safe_state.STOP_TIME_S + period - drive[_FAULT_AGE_INDEX]
    share = 0.0 if fault else period / max(left, period)
    for i in range(6):
        displayed[i] = (1.0 - share) * last[i] + share * displayed[i]
    safe_state.master_wrench_limits_into(
        not fault, fault, period, 0.0, device_limits, last, drive[_SAFE_STATE_MONITOR_SLICE], limits
    )
    drive[_IS_WRENCH_REDUCED_INDEX] = 0.0
    for g in range(2):
        limit_group(displayed, g, limits[g])
        if limits[g] < device_limits[g]:
            drive[_IS_WRENCH_REDUCED_INDEX] = 1.0
    if not fault:
        drive[_FAULT_INDEX] = _RESUMING_FAULT


class ForceDisplay(LeafSystem):
    """Block that converts the wrench to render into motor torques of the master.

    While an input is invalid, the displayed wrench fades to zero in 50 ms, and then ramps up. For a
    leader arm, the wrench is scaled so that motors, with weight compensation, stay within limits.

    .. pydrake_system::

        name: ForceDisplay
        input_ports:
        - wrench_command: (6,) F_E_B, [f; tau] to render at E, in B [N, N m]
        - for_display: (27,) from the device: joint positions (6) [rad; m], this block's memory
        - state: (2 n,) [q; qdot] of the device (only of a leader arm)
        output_ports:
        - drive: (27,) for the device: J^T F + gravity compensation (6) [N m; N] (leader: F), memory
        - force_to_master: (6,) wrench F, displayed within the device's limits [N, N m]
        - fault_at_hand: code of `blocks.Fault`
        - displayed_and_fault: (7,) the last two ports in one vector
    """

    __slots__ = NO_EXTRA_SLOTS

    def __init__(self, period: float, device: dynamics.HapticDevice | LeaderDevice) -> None:
        super().__init__()
        self._period, self._parameters = period, device.packed_parameters
        self._jacobian, self._limited = np.zeros((6, 6)), np.zeros(6)
        self._num_joints = device.num_joints
        self._command = self.DeclareVectorInputPort("wrench_command", 6)
        self._device = self.DeclareVectorInputPort("for_display", _SAFE_STATE_MONITOR_SLICE.stop)
        self._leader = device.compiled_constants if isinstance(device, LeaderDevice) else None
        dynamics.jacobian_into(np.zeros(6), device.parameters, self._jacobian)  # of a leader arm
        if self._leader is not None:
            self._state = self.DeclareVectorInputPort("state", 2 * device.num_joints)
        inputs = {self.all_input_ports_ticket()}
        self._drive = self.DeclareVectorOutputPort(
            "drive", _SAFE_STATE_MONITOR_SLICE.stop, weak_callback(self._calc_drive), inputs
        )
        # The log samples with the device, so the drive is calculated once.
        for name, size, calc in (
            ("force_to_master", 6, self._calc_displayed_wrench),
            ("fault_at_hand", 1, self._calc_fault_code),
            ("displayed_and_fault", 7, self._calc_displayed_wrench_and_fault),
        ):
            self.DeclareVectorOutputPort(name, size, weak_callback(calc), inputs)

    def _calc_drive(self, context: Context, output: BasicVector) -> None:
        wrench = self._command.Eval(context)
        if self._leader is not None:
            q = self._state.Eval(context)[: self._num_joints]
            if np.isfinite(wrench).all() and np.isfinite(q).all():
                limits = self._parameters[0], self._jacobian, self._limited
                limit_wrench_into(wrench, *limits)  # first: undisplayed torque needs no motor
                scale_wrench_to_motor_limits(self._leader, q, self._limited, self._limited)
                wrench = self._limited
        constants = self._parameters, self._period, self._jacobian
        step_display(wrench, self._device.Eval(context), *constants, output.get_mutable_value())

    def _calc_displayed_wrench(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._drive.Eval(context)[DISPLAYED_WRENCH_SLICE])

    def _calc_fault_code(self, context: Context, output: BasicVector) -> None:
        output[0] = self._drive.Eval(context)[_FAULT_INDEX]

    def _calc_displayed_wrench_and_fault(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._drive.Eval(context)[_DISPLAYED_WRENCH_AND_FAULT_SLICE])
