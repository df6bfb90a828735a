"""Joint control of a commercial arm with a position interface (docs/station.md).

command --[dead time, held]--> target --[generator]--> reference r --[drives]--> torque

d2r/dt2 = acceleration_per_error (target - (r + lookahead dr/dt))
d2q/dt2 = d2r/dt2 + 2 w (dr/dt - dq/dt) + w^2 (r - q),  w = 2 pi drive_bandwidth_hz"""

import math
from dataclasses import dataclass

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from drake_teleop.common.blocks import ONE_DICT, are_finite_and_in_range
from drake_teleop.common.compiled import njit
from drake_teleop.common.config import quantity, settings
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.common.vectors import copy_into
from drake_teleop.station.slave.arm import ArmModel, holding_torque, inverse_dynamics

# Memory of the servo: periods since the last command, index of the oldest command in the queue;
# then target, r and dr/dt (n each), and the queue of commands.
_PERIODS_SINCE_COMMAND_INDEX, _OLDEST_QUEUED_INDEX = 0, 1
_TWICE_BRAKING_SHARE = 2 * 0.8  # braking v^2 = 2 a d with 80 % of the largest acceleration


@settings
@dataclass
class PositionInterface:
    """Settings of the position interface of an arm; m instead of rad for prismatic joints."""

    command_hz: float = quantity(500.0, "Hz", 1.0, 1e4, "rate of the commands")
    dead_time: float = quantity(0.004, "s", 0.0, 1.0, "dead time; whole periods of command_hz")
    acceleration_per_error: float = quantity(
        300.0, "1/s^2", 1.0, 1e7, "acceleration per position error"
    )
    lookahead: float = quantity(0.1, "s", 1e-4, 2.0, "lag behind a steady motion")
    max_speed: float = quantity(
        math.pi, "rad/s", 1e-3, 100.0, "speed limit of each joint, unless the model's is lower"
    )
    max_acceleration: float = quantity(
        40.0, "rad/s^2", 1e-2, 1e4, "limit of each joint, unless the model's is lower"
    )
    drive_bandwidth_hz: float = quantity(
        30.0, "Hz", 0.1, 1e3, "bandwidth of the drives; sets joint stiffness"
    )

    def check(self, where: str, rate: float) -> None:
        """Raise DrakeTeleopError if a setting does not fit the control rate [Hz]."""
        periods = rate / self.command_hz
        if periods < 1.0 or abs(periods - round(periods)) > 1e-6 * periods:
            commands = f"command_hz, {self.command_hz:g} Hz"
            what = f"rates.joint_control_hz, {rate:g} Hz, is no multiple of {commands}"
            remedy = "choose a rate of the joint control that is a multiple of it"
            raise DrakeTeleopError(what, where=f"{where}.command_hz", remedy=remedy)
        damping = self.acceleration_per_error * self.lookahead / rate
        if damping + 0.5 * self.acceleration_per_error / rate**2 > 1.5:  # unstable from 2
            limits = f"a lookahead of {self.lookahead:g} s and control steps of {1e3 / rate:g} ms"
            what = f"{self.acceleration_per_error:g} 1/s^2 is too high for {limits}"
            remedy = "lower it or lookahead, or raise rates.joint_control_hz"
            raise DrakeTeleopError(what, where=f"{where}.acceleration_per_error", remedy=remedy)
        if self.drive_bandwidth_hz > 0.1 * rate:
            control = f"joint control at {rate:g} Hz"
            what = f"the bandwidth, {self.drive_bandwidth_hz:g} Hz, is too high for {control}"
            remedy = "choose at most a tenth of rates.joint_control_hz"
            raise DrakeTeleopError(what, where=f"{where}.drive_bandwidth_hz", remedy=remedy)


#: Interfaces by name; docs/station.md lists the sources.
POSITION_INTERFACES: dict[str, PositionInterface] = {
    "ur_servoj": PositionInterface(),
    "franka_position": PositionInterface(
        command_hz=1000.0,
        dead_time=0.002,
        acceleration_per_error=(200 * math.pi) ** 2,
        lookahead=1 / (100 * math.pi),
        max_speed=2.175,
        max_acceleration=7.5,
        drive_bandwidth_hz=20.0,
    ),
}


@njit(cache=True)
def _advance_joint_reference(command, interface, limits, memory, reference):
    """Accept the command (n,) [rad] if one is due, and advance the reference by one period.

    Args:
        interface: (6,) period [s], acceleration per error [1/s^2], lookahead [s], drive bandwidth
            [rad/s], periods per command, length of the command queue.
        limits: (2, n) speed and acceleration limits.
        memory: memory of `PositionServo`, see `_PERIODS_SINCE_COMMAND_INDEX`; updated.
        reference: (3, n) output: reference position, velocity, acceleration.
    """
    period, gain, lookahead, _, every, queued = interface
    n = command.shape[0]
    target, r, speed = memory[2 : 2 + n], memory[2 + n : 2 + 2 * n], memory[2 + 2 * n : 2 + 3 * n]
    if memory[_PERIODS_SINCE_COMMAND_INDEX] == 0.0 and are_finite_and_in_range(command):
        if queued > 0.0:
            place = 2 + 3 * n + int(memory[_OLDEST_QUEUED_INDEX]) * n
            copy_into(target, 0, memory, place, n)
            copy_into(memory, place, command, 0, n)
            memory[_OLDEST_QUEUED_INDEX] = (memory[_OLDEST_QUEUED_INDEX] + 1.0) % queued
        else:
            copy_into(target, 0, command, 0, n)
    memory[_PERIODS_SINCE_COMMAND_INDEX] = (memory[_PERIODS_SINCE_COMMAND_INDEX] + 1.0) % every
    for i in range(n):
        away = target[i] - r[i]
        fastest = min(limits[0, i], math.sqrt(_TWICE_BRAKING_SHARE * limits[1, i] * abs(away)))
        towards = min(max(away / lookahead, -fastest), fastest)
        wanted = gain * lookahead * (towards - speed[i])
        wanted = min(max(wanted, -limits[1, i]), limits[1, i])
        faster = min(max(speed[i] + period * wanted, -limits[0, i]), limits[0, i])
        reference[0, i], reference[1, i] = r[i], speed[i]
        reference[2, i] = (faster - speed[i]) / period
        speed[i] = faster
        r[i] += period * faster


@njit(cache=True)
def position_servo_torque_into(
    table, command, state, interface, limits, effort_limit, scratch, memory, torque
):  # fmt: skip
    """Write the motor torques (n,) for the next period, within `effort_limit` (n,) [N m].

    `state` is [q; v], `scratch` (6, n). An invalid command is replaced by the last one. If encoder
    readings are invalid, the torque compensates gravity.
    """
    n = torque.shape[0]
    _advance_joint_reference(command, interface, limits, memory, scratch)
    q, v, wanted, w = scratch[3], scratch[4], scratch[5], interface[3]
    if are_finite_and_in_range(state):
        copy_into(q, 0, state, 0, n)
        copy_into(v, 0, state, n, n)
        for i in range(n):
            wanted[i] = scratch[2, i]
            wanted[i] += 2.0 * w * (scratch[1, i] - v[i]) + w * w * (scratch[0, i] - q[i])
    else:
        copy_into(q, 0, scratch[0], 0, n)
        v[:] = 0.0
        wanted[:] = 0.0
    inverse_dynamics(table, q, v, wanted, torque)
    for i in range(n):
        torque[i] = min(max(torque[i], -effort_limit[i]), effort_limit[i])


class PositionServo(LeafSystem):
    """Block that controls joints as an arm's position interface; ports as `JointControl`.

    `period` is the drives' period [s], `q_start` the posture held before the first command.
    """

    __slots__ = ONE_DICT

    def __init__(
        self, arm: ArmModel, interface: PositionInterface, period: float, q_start: Array
    ) -> None:
        super().__init__()
        n = arm.num_joints
        self._arm = arm.table
        queued = round(interface.dead_time * interface.command_hz)
        drives = 2 * np.pi * interface.drive_bandwidth_hz
        every = round(1 / (interface.command_hz * period))
        gains = interface.acceleration_per_error, interface.lookahead
        numbers = [period, *gains, drives, every, queued]
        speed = np.minimum(arm.velocity_limit, interface.max_speed)
        acceleration = np.minimum(arm.acceleration_limit, interface.max_acceleration)
        limits = np.array([speed, acceleration]), arm.effort_limit
        self._constants = (np.array(numbers), *limits, np.zeros((6, n)))
        self._command = self.DeclareVectorInputPort("joint_command", n)
        self._state = self.DeclareVectorInputPort("slave_state", 2 * n)
        holding = self.DeclareDiscreteState(holding_torque(arm, q_start))
        self.DeclareStateOutputPort("joint_torque", holding)
        memory = np.concatenate([[0.0, 0.0], q_start, q_start, np.zeros(n), *(queued * [q_start])])
        self.DeclareDiscreteState(memory)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update_servo_state)

    def _update_servo_state(self, context: Context, discrete_state: DiscreteValues) -> None:
        inputs = self._command.Eval(context), self._state.Eval(context)
        torque, memory = (discrete_state.get_mutable_value(group) for group in range(2))
        position_servo_torque_into(self._arm, *inputs, *self._constants, memory, torque)
