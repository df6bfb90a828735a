"""Joint control of the slave: computed torque with position and velocity loop (paper, VI-A)."""

from dataclasses import dataclass

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from drake_teleop.common.blocks import ONE_DICT, are_finite_and_in_range
from drake_teleop.common.compiled import njit
from drake_teleop.common.config import choice, plain, quantity, settings
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.common.vectors import copy_into
from drake_teleop.station.slave.arm import ArmModel, holding_torque, inverse_dynamics, jacobian
from drake_teleop.station.slave.position_servo import (
    POSITION_INTERFACES,
    PositionInterface,
    PositionServo,
)

COMPUTED_TORQUE_SERVO_NAME = "computed_torque"


@settings
@dataclass
class JointControlConfig:
    """Settings of the slave's joint control: computed torque or a position interface."""

    position_bandwidth_hz: float = quantity(12.0, "Hz", 0.1, 1e4, "position loop bandwidth (E)")
    velocity_bandwidth_hz: float = quantity(70.0, "Hz", 0.1, 1e4, "velocity loop bandwidth (E)")
    servo: str = choice(
        COMPUTED_TORQUE_SERVO_NAME,
        (COMPUTED_TORQUE_SERVO_NAME, *POSITION_INTERFACES, "position"),
        "computed_torque uses the bandwidths above; the others are position interfaces: by name, or"
        " position for the fields of `interface`",
    )
    interface: PositionInterface | None = plain(
        None, "values in place of those of the servo; null: the servo's"
    )

    @property
    def position_interface(self) -> PositionInterface | None:
        if self.servo == COMPUTED_TORQUE_SERVO_NAME:
            return None
        return self.interface or POSITION_INTERFACES.get(self.servo, PositionInterface())

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
            what = "the servo computed_torque has bandwidths, but no position interface"
            remedy = "leave it out, or choose another servo, such as position"
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

    def check_computed_torque(self, what: str) -> None:
        """Raise DrakeTeleopError unless the servo is computed torque; `what` names the caller."""
        if self.servo != COMPUTED_TORQUE_SERVO_NAME:
            what = f"{what} does not support the servo {self.servo}"
            hz = 1 / (2 * np.pi * self.tracking_delay_s)
            value = f"with a position_bandwidth_hz of {hz:.2g} for the same lag"
            remedy = f"choose {COMPUTED_TORQUE_SERVO_NAME}, {value}; `run` supports every servo"
            raise DrakeTeleopError(what, where="joint_control.servo", remedy=remedy)


@njit(cache=True, omits_reference_counting=True)
def computed_torque_into(table, command, state, kp, kv, speed_limit, effort_limit, scratch, torque):
    """Write the computed torque (n,) [N m], tau = ID(q, v, kv (clip(kp (q_command - q)) - v)).

    ID is the inverse dynamics, `state` [q; v]; clip keeps within `speed_limit`, and tau is within
    `effort_limit`. Invalid encoder readings give gravity compensation at the commanded posture; an
    invalid command keeps the last torque.
    """
    if not are_finite_and_in_range(command):
        return
    n = torque.shape[0]
    q, v, acceleration = scratch[:n], scratch[n : 2 * n], scratch[2 * n :]
    copy_into(scratch, 0, state, 0, 2 * n)
    if not are_finite_and_in_range(state):
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
    """Return position and velocity gain [1/s] and (n,) limits of joint speed and torque."""
    kp, kv = 2 * np.pi * config.position_bandwidth_hz, 2 * np.pi * config.velocity_bandwidth_hz
    return kp, kv, arm.velocity_limit, arm.effort_limit


class JointControl(LeafSystem):
    """Block that controls joint positions by computed torque, at a fixed period.

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

    __slots__ = ONE_DICT

    def __init__(
        self, arm: ArmModel, config: JointControlConfig, period: float, q_start: Array
    ) -> None:
        super().__init__()
        n = arm.num_joints
        self._arm = arm.table
        self._constants = (*servo_gains_and_limits(arm, config), np.zeros(3 * n))
        self._command = self.DeclareVectorInputPort("joint_command", n)
        self._state = self.DeclareVectorInputPort("slave_state", 2 * n)
        holding = self.DeclareDiscreteState(holding_torque(arm, q_start))
        self.DeclareStateOutputPort("joint_torque", holding)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update_joint_torque)

    def _update_joint_torque(self, context: Context, discrete_state: DiscreteValues) -> None:
        inputs = self._command.Eval(context), self._state.Eval(context)
        torque = discrete_state.get_mutable_value(0)
        computed_torque_into(self._arm, *inputs, *self._constants, torque)


class HeldTorque(LeafSystem):
    """Block that holds a requested motor torque for a period, within the limits.

    An invalid request keeps the last torque; the first torque holds the posture `q_start`.
    """

    __slots__ = ONE_DICT

    def __init__(self, arm: ArmModel, period: float, q_start: Array) -> None:
        super().__init__()
        self._limit = arm.effort_limit
        self._request = self.DeclareVectorInputPort("requested_torque", arm.num_joints)
        holding = self.DeclareDiscreteState(holding_torque(arm, q_start))
        self.DeclareStateOutputPort("joint_torque", holding)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._hold_requested_torque)

    def _hold_requested_torque(self, context: Context, discrete_state: DiscreteValues) -> None:
        torque = self._request.Eval(context)
        if are_finite_and_in_range(torque):
            discrete_state.set_value(0, np.clip(torque, -self._limit, self._limit))


def MakeJointControl(
    arm: ArmModel, config: JointControlConfig, period: float, q_start: Array
) -> LeafSystem:
    interface = config.position_interface
    if interface is None:
        return JointControl(arm, config, period, q_start)
    return PositionServo(arm, interface, period, q_start)


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


def servo_at_tool(
    arm: ArmModel, q: Array, config: JointControlConfig
) -> tuple[list[float], list[float], list[float]]:
    """Return stiffness K, damping D and mass of the slave at the tool, each (2,), in SI units.

    The servo is then the wrench K (x_command - x) - D v, for translation and rotation. Mass m and
    inertia J bound the inertia Lambda: diag(m, m, m, J, J, J) >= Lambda. Their ratio is that of the
    largest eigenvalues of its two blocks, their size the smallest possible.
    """
    config.check_computed_torque("the servo model of the passivity methods")
    inertia = operational_inertia(arm, q)
    blocks = [np.linalg.eigvalsh(inertia[i : i + 3, i : i + 3])[-1] for i in (0, 3)]
    unit = 1 / np.sqrt(np.repeat(blocks, 3))
    mass = np.linalg.eigvalsh(unit[:, np.newaxis] * inertia * unit)[-1] * np.array(blocks)
    kp, kv, *_ = servo_gains_and_limits(arm, config)
    return (kp * kv * mass).tolist(), (kv * mass).tolist(), mass.tolist()
