"""Joint control of the slave: computed torque (paper, VI-A), or the position interface of an arm.

Position interface: command --[dead time, hold]--> target --[generator]--> reference r --> torque

d2r/dt2 = acceleration_per_error (target - (r + lookahead dr/dt))
d2q/dt2 = d2r/dt2 + 2 w (dr/dt - dq/dt) + w^2 (r - q),  w = 2 pi drive_bandwidth_hz"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from drake_teleop.common.blocks import NO_EXTRA_SLOTS, are_valid_port_values
from drake_teleop.common.compiled import njit
from drake_teleop.common.config import choice, plain, quantity, settings
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.common.registry import Presets
from drake_teleop.common.vectors import copy_into
from drake_teleop.station.slave.arm import ArmModel, holding_torque, inverse_dynamics, jacobian

# Memory of a position interface: periods since the last command, index of the oldest command in
# the queue; then target, r and dr/dt (n each), and the queue of commands.
_PERIODS_SINCE_COMMAND_INDEX, _OLDEST_QUEUED_INDEX = 0, 1
_BRAKING_TO_MAX_ACCELERATION_RATIO = 0.8  # of the limit a, in the braking speed v^2 = 2 a d
COMPUTED_TORQUE_SERVO_NAME = "computed_torque"


@settings
@dataclass
class PositionInterface:
    """Settings of a robot controller for position commands; for prismatic joints rad means m."""

    command_hz: float = quantity(500.0, "Hz", 1.0, 1e4, "rate of the commands")
    dead_time: float = quantity(0.004, "s", 0.0, 1.0, "command delay, rounded to 1/command_hz")
    acceleration_per_error: float = quantity(300.0, "1/s^2", 1.0, 1e7, "acceleration per error")
    lookahead: float = quantity(0.1, "s", 1e-4, 2.0, "lag behind a command of constant speed")
    max_speed: float = quantity(
        math.pi, "rad/s", 1e-3, 100.0, "joint speed limit, unless the arm's own is lower"
    )
    max_acceleration: float = quantity(
        40.0, "rad/s^2", 1e-2, 1e4, "limit of joint acceleration, unless the arm's own is lower"
    )
    drive_bandwidth_hz: float = quantity(30.0, "Hz", 0.1, 1e3, "drives' bandwidth; sets stiffness")

    def check(self, where: str, rate: float) -> None:
        """Raise DrakeTeleopError if a setting does not fit the control rate [Hz]."""
        periods = rate / self.command_hz
        if periods < 1.0 or abs(periods - round(periods)) > 1e-6 * periods:
            commands = f"command_hz, {self.command_hz:g} Hz"
            what = f"rates.joint_control_hz, {rate:g} Hz, is no multiple of {commands}"
            remedy = "set rates.joint_control_hz to a multiple of command_hz"
            raise DrakeTeleopError(what, where=f"{where}.command_hz", remedy=remedy)
        damping = self.acceleration_per_error * self.lookahead / rate
        if damping + 0.5 * self.acceleration_per_error / rate**2 > 1.5:  # unstable from 2
            timing = f"a lookahead of {self.lookahead:g} s and control steps of {1e3 / rate:g} ms"
            what = f"{self.acceleration_per_error:g} 1/s^2 is too high for {timing}"
            remedy = "lower it or lookahead, or raise rates.joint_control_hz"
            raise DrakeTeleopError(what, where=f"{where}.acceleration_per_error", remedy=remedy)
        if self.drive_bandwidth_hz > 0.1 * rate:
            control = f"joint control at {rate:g} Hz"
            what = f"the bandwidth, {self.drive_bandwidth_hz:g} Hz, is too high for {control}"
            remedy = "choose at most a tenth of rates.joint_control_hz"
            raise DrakeTeleopError(what, where=f"{where}.drive_bandwidth_hz", remedy=remedy)


_interface_presets = {
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
#: Interfaces by name; docs/station.md lists the sources.
POSITION_INTERFACE_PRESETS = Presets(_interface_presets)


@settings
@dataclass
class JointControlConfig:
    """Settings of the slave's joint control: computed torque or a position interface."""

    position_bandwidth_hz: float = quantity(12.0, "Hz", 0.1, 1e4, "position bandwidth (estimate)")
    velocity_bandwidth_hz: float = quantity(70.0, "Hz", 0.1, 1e4, "velocity bandwidth (estimate)")
    servo: str = choice(
        COMPUTED_TORQUE_SERVO_NAME,
        (COMPUTED_TORQUE_SERVO_NAME, *POSITION_INTERFACE_PRESETS, "position"),
        "computed_torque: with position_bandwidth_hz and velocity_bandwidth_hz; position: position"
        " interface with the settings `interface`; others: presets for arms",
    )
    interface: PositionInterface | None = plain(
        None, "settings of the position interface; null: those of the preset `servo`"
    )

    @property
    def position_interface(self) -> PositionInterface | None:
        if self.servo == COMPUTED_TORQUE_SERVO_NAME:
            return None
        return self.interface or POSITION_INTERFACE_PRESETS.get(self.servo, PositionInterface())

    @property
    def tracking_delay_s(self) -> float:
        """Approximate delay of the joints behind a command of constant speed [s]."""
        interface = self.position_interface
        if interface is not None:
            return interface.lookahead + interface.dead_time + 1 / interface.command_hz
        return 1 / (2 * np.pi * min(self.position_bandwidth_hz, self.velocity_bandwidth_hz))

    @property
    def position_loop_gain_per_s(self) -> float:
        """Commanded joint speed divided by the position error [1/s]."""
        if self.position_interface is None:
            return 2 * np.pi * self.position_bandwidth_hz
        return 1 / self.tracking_delay_s

    def check(self, where: str, rate: float) -> None:
        """Raise DrakeTeleopError if a setting does not fit the control rate [Hz]."""
        if self.servo == COMPUTED_TORQUE_SERVO_NAME and self.interface is not None:
            what = "the servo computed_torque has no position interface, only bandwidths"
            remedy = "remove this field, or choose another servo, such as position"
            raise DrakeTeleopError(what, where=f"{where}.interface", remedy=remedy)
        interface = self.position_interface
        if interface is not None:
            interface.check(f"{where}.interface", rate)
            return
        for name in ("position_bandwidth_hz", "velocity_bandwidth_hz"):
            # A double integrator with held torques is stable below gain 2 / period in both loops.
            if (bandwidth := getattr(self, name)) >= rate / np.pi:
                what = f"{bandwidth:g} Hz is unstable with joint control at {rate:g} Hz"
                what = f"{what} (stable below {rate / np.pi:.4g} Hz)"
                remedy = "lower it, or raise rates.joint_control_hz"
                raise DrakeTeleopError(what, where=f"{where}.{name}", remedy=remedy)

    def require_computed_torque(self, caller: str) -> None:
        if self.servo != COMPUTED_TORQUE_SERVO_NAME:
            what = f"{caller} does not support the servo {self.servo}"
            hz = 1 / (2 * np.pi * self.tracking_delay_s)
            value = f"with a position_bandwidth_hz of {hz:.2g} for the same lag"
            remedy = f"choose {COMPUTED_TORQUE_SERVO_NAME}, {value}; `run` supports every servo"
            raise DrakeTeleopError(what, where="joint_control.servo", remedy=remedy)


@njit(cache=True, omits_reference_counting=True)
def computed_torque_into(table, command, state, kp, kv, speed_limit, effort_limit, scratch, torque):
    """Write the computed torque (n,) [N m], tau = ID(q, v, kv (clip(kp (q_command - q)) - v)).

    ID is the inverse dynamics, `state` [q; v]. The inner clip is to `speed_limit`; tau is clipped
    to `effort_limit`. Invalid encoder readings give gravity compensation at the commanded posture.
    An invalid command keeps the torque.
    """
    if not are_valid_port_values(command):
        return
    n = torque.shape[0]
    q, v, acceleration = scratch[:n], scratch[n : 2 * n], scratch[2 * n :]
    copy_into(scratch, 0, state, 0, 2 * n)
    if not are_valid_port_values(state):
        copy_into(q, 0, command, 0, n)
        v[:] = 0.0
    for i in range(n):
        setpoint = min(max(kp * (command[i] - q[i]), -speed_limit[i]), speed_limit[i])
        acceleration[i] = kv * (setpoint - v[i])
    inverse_dynamics(table, q, v, acceleration, torque)
    for i in range(n):
        torque[i] = min(max(torque[i], -effort_limit[i]), effort_limit[i])


def servo_gains_and_limits(
    arm: ArmModel, config: JointControlConfig
) -> tuple[float, float, Array, Array]:
    """Return position and velocity gain [1/s], and (n,) limits of joint speed and torque."""
    kp, kv = 2 * np.pi * config.position_bandwidth_hz, 2 * np.pi * config.velocity_bandwidth_hz
    return kp, kv, arm.velocity_limit, arm.effort_limit


@njit(cache=True)
def _advance_joint_reference(command, interface, limits, memory, reference):
    """Read the command (n,) [rad] once per command period; advance the reference by a period.

    Args:
        interface: (6,) period [s], acceleration per error [1/s^2], lookahead [s], drive bandwidth
            [rad/s], periods per command, length of the command queue.
        limits: (2, n) speed and acceleration limits.
        memory: updated: periods since a command, queue index, target, r, dr/dt, command queue.
        reference: (3, n) output: reference position, velocity, acceleration.
    """
    period, gain, lookahead, _, periods_per_command, queue_length = interface
    n = command.shape[0]
    target, r, speed = memory[2 : 2 + n], memory[2 + n : 2 + 2 * n], memory[2 + 2 * n : 2 + 3 * n]
    if memory[_PERIODS_SINCE_COMMAND_INDEX] == 0.0:
        is_valid = are_valid_port_values(command)
        if queue_length > 0.0:
            oldest, start = memory[_OLDEST_QUEUED_INDEX], 2 + 3 * n
            place, newest = start + int(oldest) * n, start + int((oldest - 1.0) % queue_length) * n
            copy_into(target, 0, memory, place, n)
            if is_valid:
                copy_into(memory, place, command, 0, n)
            else:
                copy_into(memory, place, memory, newest, n)
            memory[_OLDEST_QUEUED_INDEX] = (oldest + 1.0) % queue_length
        elif is_valid:
            copy_into(target, 0, command, 0, n)
    periods = memory[_PERIODS_SINCE_COMMAND_INDEX] + 1.0
    memory[_PERIODS_SINCE_COMMAND_INDEX] = periods % periods_per_command
    for i in range(n):
        error = target[i] - r[i]
        braking = math.sqrt(2.0 * _BRAKING_TO_MAX_ACCELERATION_RATIO * limits[1, i] * abs(error))
        max_speed = min(limits[0, i], braking)
        setpoint = min(max(error / lookahead, -max_speed), max_speed)
        acceleration = gain * lookahead * (setpoint - speed[i])
        acceleration = min(max(acceleration, -limits[1, i]), limits[1, i])
        next_speed = min(max(speed[i] + period * acceleration, -limits[0, i]), limits[0, i])
        reference[0, i], reference[1, i] = r[i], speed[i]
        reference[2, i] = (next_speed - speed[i]) / period
        speed[i] = next_speed
        r[i] += period * next_speed


@njit(cache=True)
def position_servo_torque_into(
    table, command, state, interface, limits, effort_limit, scratch, memory, torque
):  # fmt: skip
    """Write the motor torques (n,) for the next period, within `effort_limit` (n,) [N m].

    `state` is [q; v], `scratch` (6, n); `_advance_joint_reference` explains the others. The last
    command replaces an invalid one. With invalid encoder readings the torque compensates gravity.
    """
    n = torque.shape[0]
    _advance_joint_reference(command, interface, limits, memory, scratch)
    q, v, acceleration, w = scratch[3], scratch[4], scratch[5], interface[3]
    if are_valid_port_values(state):
        copy_into(q, 0, state, 0, n)
        copy_into(v, 0, state, n, n)
        for i in range(n):
            acceleration[i] = scratch[2, i]
            acceleration[i] += 2.0 * w * (scratch[1, i] - v[i]) + w * w * (scratch[0, i] - q[i])
    else:
        copy_into(q, 0, scratch[0], 0, n)
        v[:] = 0.0
        acceleration[:] = 0.0
    inverse_dynamics(table, q, v, acceleration, torque)
    for i in range(n):
        torque[i] = min(max(torque[i], -effort_limit[i]), effort_limit[i])


def _position_servo_constants_and_memory(
    arm: ArmModel, interface: PositionInterface, period: float, q_start: Array
) -> tuple[tuple[Array, ...], Array]:
    n, queued = arm.num_joints, round(interface.dead_time * interface.command_hz)
    gains = interface.acceleration_per_error, interface.lookahead
    drives = 2 * np.pi * interface.drive_bandwidth_hz
    every = round(1 / (interface.command_hz * period))
    speed = np.minimum(arm.velocity_limit, interface.max_speed)
    acceleration = np.minimum(arm.acceleration_limit, interface.max_acceleration)
    limits = np.array([speed, acceleration]), arm.effort_limit
    constants = np.array([period, *gains, drives, every, queued]), *limits, np.zeros((6, n))
    memory = [np.zeros(2), q_start, q_start, np.zeros(n), *(queued * [q_start])]
    return constants, np.concatenate(memory)


class JointControl(LeafSystem):
    """Block that controls joint positions by the configured servo, at a fixed period [s].

    While encoder readings are invalid, the motors only compensate gravity. `q_start` is the posture
    held before the first sample.

    .. pydrake_system::

        name: JointControl
        input_ports:
        - joint_command: (n,) [rad]
        - slave_state: (2 n,) [q; v] of the arm [rad, rad/s]
        output_ports:
        - joint_torque: (n,) [N m], held between samples
    """

    __slots__ = NO_EXTRA_SLOTS

    def __init__(
        self, arm: ArmModel, config: JointControlConfig, period: float, q_start: Array
    ) -> None:
        super().__init__()
        n, interface = arm.num_joints, config.position_interface
        self._command = self.DeclareVectorInputPort("joint_command", n)
        self._state = self.DeclareVectorInputPort("slave_state", 2 * n)
        holding = self.DeclareDiscreteState(holding_torque(arm, q_start))
        self.DeclareStateOutputPort("joint_torque", holding)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update_joint_torque)
        self._arm, self._groups, self._constants = arm.table, [0], tuple[Any, ...]()
        if interface is None:
            self._servo = computed_torque_into
            self._constants = (*servo_gains_and_limits(arm, config), np.zeros(3 * n))
        else:
            self._servo, self._groups = position_servo_torque_into, [1, 0]
            arguments = _position_servo_constants_and_memory(arm, interface, period, q_start)
            self._constants, memory = arguments
            self.DeclareDiscreteState(memory)

    def _update_joint_torque(self, context: Context, discrete_state: DiscreteValues) -> None:
        inputs = self._command.Eval(context), self._state.Eval(context)
        states = map(discrete_state.get_mutable_value, self._groups)
        self._servo(self._arm, *inputs, *self._constants, *states)


class HeldTorque(LeafSystem):
    """Block that samples a requested motor torque, clips it to limits, holds it for a period.

    An invalid request keeps the last torque; the first torque holds `q_start` against gravity.
    """

    __slots__ = NO_EXTRA_SLOTS

    def __init__(self, arm: ArmModel, period: float, q_start: Array) -> None:
        super().__init__()
        self._limit = arm.effort_limit
        self._request = self.DeclareVectorInputPort("requested_torque", arm.num_joints)
        holding = self.DeclareDiscreteState(holding_torque(arm, q_start))
        self.DeclareStateOutputPort("joint_torque", holding)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._sample_and_clip_torque)

    def _sample_and_clip_torque(self, context: Context, discrete_state: DiscreteValues) -> None:
        torque = self._request.Eval(context)
        if are_valid_port_values(torque):
            discrete_state.set_value(0, np.clip(torque, -self._limit, self._limit))


def mass_matrix(arm: ArmModel, q: Array) -> Array:
    """Return the mass matrix M(q) (n, n) of the arm with rotors and tool."""
    zeros, weight = np.zeros(len(q)), holding_torque(arm, q)
    columns = np.empty((len(q), len(q)))
    for unit, column in zip(np.eye(len(q)), columns, strict=True):
        inverse_dynamics(arm.table, q, zeros, unit, column)
        column -= weight
    return columns.T


def operational_inertia(arm: ArmModel, q: Array) -> Array:
    """Return the inertia Lambda = (J M^-1 J^T)^-1 (6, 6) at So, translation first, in W.

    J must have rank 6. Khatib, A unified approach for motion and force control (1987).
    """
    J = np.empty((6, arm.num_joints))
    jacobian(arm.table, q, J)
    return np.linalg.inv(J @ np.linalg.inv(mass_matrix(arm, q)) @ J.T)


def servo_impedance(
    arm: ArmModel, q: Array, config: JointControlConfig
) -> tuple[list[float], list[float], list[float]]:
    """Return stiffness K, damping D and mass of the slave at the tool, each (2,), in SI units.

    The first number is for translation, the second for rotation. The servo acts as the wrench K
    (x_command - x) - D v. Mass m and inertia J are the smallest for which diag(m, m, m, J, J, J) -
    Lambda is positive semidefinite; m / J is the ratio of its blocks' largest eigenvalues.
    """
    config.require_computed_torque("the servo model of the passivity methods")
    inertia = operational_inertia(arm, q)
    blocks = [np.linalg.eigvalsh(inertia[i : i + 3, i : i + 3])[-1] for i in (0, 3)]
    unit = 1 / np.sqrt(np.repeat(blocks, 3))
    mass = np.linalg.eigvalsh(unit[:, np.newaxis] * inertia * unit)[-1] * np.array(blocks)
    kp, kv, *_ = servo_gains_and_limits(arm, config)
    return (kp * kv * mass).tolist(), (kv * mass).tolist(), mass.tolist()
