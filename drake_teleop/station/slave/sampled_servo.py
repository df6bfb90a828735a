"""Joint control with a period T shorter than the interval h = m T of the simulation's events.

Each event predicts the motion, one midpoint step per sample of the controller:

    tau_k = servo(x_k),  x_k+1 = x_k + T f(x_k + T/2 f(x_k, tau_k), tau_k),  k = 0 .. m - 1

The plant receives the torque a + b (t - h/2) with the integral and first moment of the tau_k."""

from __future__ import annotations

import numpy as np
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from drake_teleop.common.blocks import NO_EXTRA_SLOTS, weak_callback
from drake_teleop.common.compiled import njit
from drake_teleop.common.vectors import copy_into
from drake_teleop.station.slave.arm import holding_torque
from drake_teleop.station.slave.joint_control import (
    JointControlConfig,
    computed_torque_into,
    servo_gains_and_limits,
)
from drake_teleop.station.slave.plant import SlavePlant
from drake_teleop.station.slave.plant_dynamics import (
    assemble_plant_state_into,
    contact_and_plant_rates_into,
)

#: Event rate [Hz]; over longer intervals a ramp differs too much from the servo's samples.
_MIN_SERVO_EVENT_HZ = 2000.0


def servo_samples_per_event(control_hz: float, hand_hz: float) -> int:
    """Return the largest number of servo samples per event that keeps events at 2 kHz or more.

    Events include each sample of the haptic device. Arguments are rates [Hz].
    """
    ratio = control_hz / hand_hz
    whole = round(ratio)
    if whole < 1 or abs(ratio - whole) > 1e-9 * whole:
        return 1
    most = max(int(control_hz / _MIN_SERVO_EVENT_HZ), 1)
    return next(m for m in range(most, 0, -1) if whole % m == 0)


@njit(cache=True)
def predict_torque_ramp(arm, command, state, sheet, servo, physics, samples, period, scratch, ramp):
    """Write the motor torque over the next `samples` of the servo as a linear function of time.

    Args:
        arm: `ArmModel.table` of the controller.
        command: (n,) joint command [rad].
        state: (2 n,) [q; v].
        sheet: (2,) deflection of the leaf and its rate.
        servo: gains and limits from `servo_gains_and_limits`.
        physics: `SlavePlant.compiled_constants`.
        period: period of the servo [s].
        ramp: (3 n,) output: torque now [N m], its rate [N m/s], last predicted torque [N m].
    """
    n = command.shape[0]
    kp, kv, speed_limit, effort_limit = servo
    now, rate, torque = ramp[:n], ramp[n : 2 * n], ramp[2 * n :]
    x, half, xdot = np.empty(2 * n + 2), np.empty(2 * n + 2), np.empty(2 * n + 2)
    predicted, wrench_W, no_wrench = np.empty(2 * n), np.empty(6), np.zeros(6)
    assemble_plant_state_into(state, sheet, x)
    now[:] = 0.0
    rate[:] = 0.0
    for k in range(samples):
        copy_into(predicted, 0, x, 0, n)
        copy_into(predicted, n, x, n + 1, n)
        computed_torque_into(
            arm, command, predicted, kp, kv, speed_limit, effort_limit, scratch, torque
        )
        for i in range(n):
            now[i] += torque[i]
            rate[i] += (k - 0.5 * (samples - 1)) * torque[i]
        if k == samples - 1:
            break
        contact_and_plant_rates_into(physics, x, torque, no_wrench, wrench_W, xdot)
        for i in range(2 * n + 2):
            half[i] = x[i] + 0.5 * period * xdot[i]
        contact_and_plant_rates_into(physics, half, torque, no_wrench, wrench_W, xdot)
        for i in range(2 * n + 2):
            x[i] += period * xdot[i]
    for i in range(n):
        # `away` is half the rise of the ramp; both ends are clipped to the torque limits.
        mean, away = now[i] / samples, 6.0 * rate[i] / samples**2
        start = min(max(mean - away, -effort_limit[i]), effort_limit[i])
        end = min(max(mean + away, -effort_limit[i]), effort_limit[i])
        now[i], rate[i] = start, (end - start) / (samples * period)


@njit(cache=True, omits_reference_counting=True)
def _evaluate_torque_ramp_into(time, ramp, torque):
    n = torque.shape[0]
    for i in range(n):
        torque[i] = ramp[i] + (time - ramp[-1]) * ramp[n + i]


class SampledServo(LeafSystem):
    """Block that controls joints by computed torque, with several servo samples per event.

    Outputs are the torque (n,) now [N m] and its rate (n,) [N m/s]. `period` is the servo's period
    [s], `samples` their number per event.
    """

    __slots__ = NO_EXTRA_SLOTS

    def __init__(
        self, slave: SlavePlant, config: JointControlConfig, period: float, samples: int
    ) -> None:
        super().__init__()
        arm = slave.arm
        n = self._n = arm.num_joints
        self._arm = arm.table
        servo, scratch = servo_gains_and_limits(arm, config), np.zeros(3 * n)
        self._constants = servo, slave.compiled_constants, samples, period, scratch
        self._command = self.DeclareVectorInputPort("joint_command", n)
        self._state = self.DeclareVectorInputPort("slave_state", 2 * n)
        self._at_rest, self._sheet = np.zeros(2), None
        if slave.leaf_instance_in_compiled_law is not None:
            self._sheet = self.DeclareVectorInputPort("sheet_state", 2)
        holding = holding_torque(arm, slave.start)
        # The ramp that `predict_torque_ramp` writes, then its start time.
        self.DeclareDiscreteState(np.concatenate([holding, np.zeros(n), holding, [0.0]]))
        when = {self.time_ticket(), self.xd_ticket()}
        torque, rate = weak_callback(self._calc_torque), weak_callback(self._calc_torque_rate)
        self.DeclareVectorOutputPort("joint_torque", n, torque, when)
        self.DeclareVectorOutputPort("torque_rate", n, rate, {self.xd_ticket()})
        self.DeclarePeriodicDiscreteUpdateEvent(samples * period, 0.0, self._predict_torque_ramp)

    def _calc_torque(self, context: Context, output: BasicVector) -> None:
        ramp = context.get_discrete_state_vector().value()
        _evaluate_torque_ramp_into(context.get_time(), ramp, output.get_mutable_value())

    def _calc_torque_rate(self, context: Context, output: BasicVector) -> None:
        ramp = context.get_discrete_state_vector().value()
        output.SetFromVector(ramp[self._n : 2 * self._n])

    def _predict_torque_ramp(self, context: Context, discrete_state: DiscreteValues) -> None:
        following = discrete_state.get_mutable_value(0)
        sheet = self._at_rest if self._sheet is None else self._sheet.Eval(context)
        inputs = self._command.Eval(context), self._state.Eval(context), sheet
        predict_torque_ramp(self._arm, *inputs, *self._constants, following[:-1])
        following[-1] = context.get_time()
