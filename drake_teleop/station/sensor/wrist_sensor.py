"""Wrist sensor in the station (long: one file for the compiled step and its Drake block).

    truth --[sensor_chain]--> reading --[motion_estimation]--> sample

The state at each sampling instant is interpolated within an integration step. If Drake calculates
the contact, each sample is an event at a step's end.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache, partial

import numpy as np
from numpy.typing import NDArray
from pydrake.common import RandomDistribution
from pydrake.common.value import Value
from pydrake.multibody.plant import ContactResults
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiagramBuilder,
    DiscreteValues,
    EventStatus,
    LeafSystem,
    OutputPort,
)
from pydrake.systems.primitives import Demultiplexer, RandomSource

from drake_teleop.common.blocks import NO_EXTRA_SLOTS, weak_callback
from drake_teleop.common.compiled import njit
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.common.vectors import (
    apply_matrix,
    copy_into,
    cross,
    matrix_at,
    minus,
    transposed,
    vector_at,
)
from drake_teleop.load import regressor
from drake_teleop.station.environment.moving_bodies import interpolate_joint_state
from drake_teleop.station.sensor import motion_estimation, sensor_chain
from drake_teleop.station.slave import arm as serial_arm
from drake_teleop.station.slave.plant import SlavePlant
from drake_teleop.station.slave.plant_dynamics import (
    PROXIMITY_FAR,
    PROXIMITY_NEAR_MONITORED,
    PROXIMITY_TOUCHING,
    ContactPlantCopy,
    assemble_plant_state_into,
    classify_tool_proximity,
    contact_and_plant_rates_into,
    contact_wrench_W,
    environment_wrench_about_Wo_into,
    plant_rates_under_wrench_into,
)
from drake_teleop.station.wiring import connect_matching_inputs

_EQUAL_TIME_TOLERANCE_PERIODS, _MAX_QUEUED_PLANT_STEPS = 1e-6, 16
#: Period of the comparison of the plant's acceleration with the dynamics here [s], and relative
#: tolerance: rounding is 1e-12, in a stiff contact 1e-9.
_ACCELERATION_CHECK_PERIOD_S, _ACCELERATION_CHECK_TOLERANCE = 0.1, 1e-6
#: Value of `contact_W` in `take_due_samples` that selects the compiled contact law.
_NO_GIVEN_CONTACT_WRENCH = np.zeros(0)


@njit(cache=True)
def true_sample_into(arm, phi, q, v, vdot, contact_W, out):
    """Write the true wrench, specific force, omega and alpha of S into `out[:15]`.

    `contact_W` (6,) is the wrench of the environment on the tool about Wo, in W; `phi` (10,) are
    the tool's inertial parameters.
    """
    motion = np.empty(serial_arm.SENSOR_MOTION_SIZE)
    serial_arm.sensor_motion(arm, q, v, vdot, motion)
    copy_into(out, regressor.MOTION_SLICE.start, motion, 0, 9)
    wrench = out[regressor.WRENCH_SLICE]
    regressor.non_contact_wrench_into(motion[:3], motion[3:6], motion[6:9], phi, wrench)
    # The contact wrench is about the world's origin; about So its moment is tau - p_WS x f.
    f, p_WS, R_SW = vector_at(contact_W, 0), vector_at(motion, 9), transposed(matrix_at(motion, 12))
    tau = minus(vector_at(contact_W, 3), cross(p_WS, f))
    wrench[0], wrench[1], wrench[2] = minus(vector_at(wrench, 0), apply_matrix(R_SW, f))
    wrench[3], wrench[4], wrench[5] = minus(vector_at(wrench, 3), apply_matrix(R_SW, tau))


@njit(cache=True)
def _quintic_state_into(step_s, fraction, x, xdot, end, end_dot, out):
    half, h, u = x.shape[0] // 2, step_s, fraction
    for i in range(half):
        q, v, a = x[i], x[half + i], xdot[half + i]
        dq = end[i] - q - h * v - 0.5 * h * h * a
        dv = h * (end[half + i] - v) - h * h * a
        da = h * h * (end_dot[half + i] - a)
        c3 = 10.0 * dq - 4.0 * dv + 0.5 * da
        c4 = -15.0 * dq + 7.0 * dv - da
        c5 = 6.0 * dq - 3.0 * dv + 0.5 * da
        out[i] = q + u * (h * v + u * (0.5 * h * h * a + u * (c3 + u * (c4 + u * c5))))
        d2, d3 = 3.0 * dv - da, da - 2.0 * dv
        out[half + i] = v + u * (h * h * a + u * (d2 + u * d3)) / h


@njit(cache=True)
def _take_sample(physics, sensor, x, xdot, wrench_W, noise, memory):
    arm, phi, _, _, _, _ = physics
    constants, middle, end = sensor
    half = x.shape[0] // 2
    n = half - 1
    truth = np.empty(15 + n)
    v, vdot = x[half : half + n], xdot[half : half + n]
    true_sample_into(arm, phi, x[:n], v, vdot, wrench_W, truth)
    copy_into(truth, sensor_chain.TRUE_ANGLES_SLICE.start, x, 0, n)
    size = regressor.FIRST_JOINT_INDEX + n
    copy_into(memory, size, memory, 0, size)
    filters = memory[2 * size : middle], memory[middle:end]
    motion_estimation.measure_sample_into(constants, arm, noise, truth, *filters, memory[:size])


@njit(cache=True)
def append_step_to_queue(queue, time, state, surroundings):
    """Append the end time and end state of an integration step to the sensor's queue."""
    width = state.shape[0] + 1 + surroundings.shape[0]
    entry = queue[2 + int(queue[1]) * width :][:width]
    entry[0] = time
    assemble_plant_state_into(state, surroundings, entry[1:])
    queue[1] += 1.0


@njit(cache=True, omits_reference_counting=True)
def _append_if_space(memory, queue_start, max_steps, time, state, surroundings):
    if memory[queue_start + 1] >= max_steps:
        return False
    append_step_to_queue(memory[queue_start:], time, state, surroundings)
    return True


@njit(cache=True)
def _extrapolate_torque_into(torque_and_rate, elapsed_s, torque):
    copy_into(torque, 0, torque_and_rate[0], 0, torque.shape[0])
    for i in range(torque_and_rate[1].shape[0]):
        torque[i] += elapsed_s * torque_and_rate[1][i]


@njit(cache=True, omits_reference_counting=True)
def take_due_samples(
    physics, sensor, period, time, state, surroundings, torques, applied_W, noise, memory,
    include_now, contact_W, scratch, result,
):  # fmt: skip
    """Take the samples that are due in the integration steps since the last call.

    Args:
        physics: tuple of the arm's table, inertial parameters phi of the tool, pairs of shapes in
            contact, sheet spring, joint table of other moving bodies, and wrenches from Drake.
        sensor: (`sensor` of `measure_sample_into`, indices of estimator's memory and `tail`).
        time: present time [s], the end of a step.
        state: (2 n,) present state [q; v] of the arm.
        surroundings: [deflection and rate of the sheet, plant's state if other bodies move] now.
        torques: motor torque (n,) now [N m], and its rate (n,) in these steps, or (0,) if constant.
        applied_W: (6,) additional wrench on the tool.
        memory: [last two samples (16 + n each) | sensor chain | motion estimator | `tail`:
            number of samples, number of queued steps, time and state of each queued step's end].
        include_now: True to include a sample at `time`.
        contact_W: (6,) contact wrench on the tool about Wo, in W; (0,): calculate by `physics`.
        scratch: work array for nine states, overwritten.
        result: written: [last sample before now (16 + n) | its time [s] | memory].
    """
    n = state.shape[0] // 2
    size, half, tau, joints = regressor.FIRST_JOINT_INDEX + n, n + 1, scratch[7, :n], physics[4]
    extra = surroundings.shape[0] - 2
    full = 2 * half + extra
    width = 1 + full
    after = result[size + 1 :]
    copy_into(after, 0, memory, 0, memory.shape[0])
    tail = after[sensor[2] :]
    count, queued = tail[0], int(tail[1])
    now, between = scratch[0, :full], scratch[1, :full]
    now_dot, between_dot = scratch[2, : 2 * half], scratch[3, : 2 * half]
    start_dot, end_dot = scratch[4, : 2 * half], now_dot
    now_wrench_W, wrench_W = scratch[5, :6], scratch[6, :6]
    assemble_plant_state_into(state, surroundings, now)
    copy_into(between, 2 * half, now, 2 * half, extra)  # only other bodies are interpolated there
    _extrapolate_torque_into(torques, 0.0, tau)
    if contact_W.shape[0] > 0:
        none, sheet, plant = physics[2][:0], surroundings[:2], surroundings[2:]
        environment_wrench_about_Wo_into(
            physics[0], none, joints, applied_W, state[:n], state[n:], sheet, plant, now_wrench_W
        )
        now_wrench_W += contact_W
        plant_rates_under_wrench_into(physics, now, tau, applied_W, now_wrench_W, now_dot)
    else:
        contact_and_plant_rates_into(physics, now, tau, applied_W, now_wrench_W, now_dot)
    for k in range(queued):
        start = tail[2 + k * width :][:width]
        until, end, end_dot = time, now, now_dot
        if k < queued - 1:
            following = tail[2 + (k + 1) * width :][:width]
            until, end, end_dot = following[0], following[1:], scratch[8, : 2 * half]
        if (count + _EQUAL_TIME_TOLERANCE_PERIODS) * period >= until:
            continue
        _extrapolate_torque_into(torques, start[0] - time, tau)
        contact_and_plant_rates_into(physics, start[1:], tau, applied_W, wrench_W, start_dot)
        if k < queued - 1:
            _extrapolate_torque_into(torques, until - time, tau)
            contact_and_plant_rates_into(physics, end, tau, applied_W, wrench_W, end_dot)
        h = until - start[0]
        while (count + _EQUAL_TIME_TOLERANCE_PERIODS) * period < until:
            u = (count * period - start[0]) / h
            _quintic_state_into(h, u, start[1 : width - extra], start_dot, end, end_dot, between)
            if extra > 0:
                at_start, at_end = start[width - extra :], end[2 * half :]
                interpolate_joint_state(joints, h, u, at_start, at_end, between[2 * half :])
            _extrapolate_torque_into(torques, count * period - time, tau)
            contact_and_plant_rates_into(physics, between, tau, applied_W, wrench_W, between_dot)
            _take_sample(physics, sensor, between[: 2 * half], between_dot, wrench_W, noise, after)
            count += 1.0
    # A step of rounding length may have ended just before and have taken this sample.
    taken = (count - 1.0 + _EQUAL_TIME_TOLERANCE_PERIODS) * period > time
    copy_into(result, 0, after, size if taken else 0, size)
    result[size] = (count - (2.0 if taken else 1.0)) * period
    if include_now and (count - _EQUAL_TIME_TOLERANCE_PERIODS) * period < time:
        _take_sample(physics, sensor, now[: 2 * half], now_dot, now_wrench_W, noise, after)
        count += 1.0
    tail[0], tail[1] = count, 0.0
    append_step_to_queue(tail, time, state, surroundings)


class WristSensor(LeafSystem):
    """Block of the station's wrist sensor: force, torque, motion of S and joint angles.

    .. pydrake_system::

        name: WristSensor
        input_ports:
        - slave_state: state [q; v] of the arm
        - joint_torque: (n,) present torque of the motors [N m]
        - torque_rate: (n,) rate of joint_torque [N m/s] (only with `ramps`)
        - slave_acceleration: (n,) vdot of the arm, to detect forces that no input contains
        - sheet_state: [z; v_z] of the sheet spring (only if there is one)
        - plant_state: [q; v] of the whole plant (only if other bodies move)
        - contact_results: contact results of the plant (only with surroundings)
        - noise: (NOISE_BLOCK_SIZE,) standard normal numbers (not if the sensor is ideal)
        - applied_wrench_W: (6,) [f; tau] on the tool about So, in W, from all sources except
          contacts [N, N m] (may be left unconnected)
        output_ports:
        - step: [last sample before now (16 + n), see `load.regressor` | its time [s] | memory]

    A force that no input contains raises a DrakeTeleopError during simulation.

    Args:
        hold_time: time between changes of the motor torque, or with `ramps` of its rate [s].
        ramps: True if motor torques are linear in time between these changes.
    """

    __slots__ = NO_EXTRA_SLOTS

    def __init__(
        self,
        slave: SlavePlant,
        config: sensor_chain.WristSensorConfig,
        motion: motion_estimation.MotionEstimationConfig,
        period: float,
        hold_time: float,
        *,
        ramps: bool = False,
    ) -> None:
        super().__init__()
        arm = slave.arm
        n = self._n = arm.num_joints
        constants, chain = sensor_chain.initialize_sensor_chain(config, n, period)
        motion_constants, estimator = motion_estimation.initialize_motion_estimator(
            motion, config, n, period
        )
        self._physics, contact = slave.compiled_constants, slave.contact
        #: Offset (6,) of force and torque [N, N m] and inertial parameters (10,) of the tool; both
        #: are views that may be changed during a run.
        self.offset, self.phi = constants["offset"][0, :6], self._physics[1]
        self.contact_pairs = self._physics[2]
        first = sample_at_rest(arm, slave.start)
        if not config.ideal:
            first[regressor.WRENCH_SLICE] += config.offset
        #: Reason why contact is outside the compiled contact law, or "".
        self.reason_beyond_contact_law = contact.drake_contact_reason
        # The plant's contact wrench costs as much as two samples; noise exceeds its gain by 1e9.
        self._uses_plant_contact = config.ideal or bool(contact.drake_contact_reason)
        # Contact needs many steps per torque sample, so queueing them saves time.
        queues = slave.can_tool_touch and not contact.drake_contact_reason
        self._max_queued_steps = _MAX_QUEUED_PLANT_STEPS if queues else 1
        self._around = np.zeros(2 + contact.plant_state_size)
        tail = np.zeros(2 + self._max_queued_steps * (2 * n + 1 + len(self._around)))
        memory = np.concatenate([first, first, chain, estimator, tail])
        ends = np.cumsum([2 * len(first), len(chain), len(estimator)])
        self._sensor = ((constants, motion_constants, config.ideal), *ends[1:].tolist())
        self._monitored_pairs = contact.monitored_pairs
        #: Sentence that names the moving bodies around the arm except a sheet spring, or "".
        moving = contact.moving_bodies
        self.moving_bodies_sentence = ", ".join(moving) + " can move" * bool(moving)
        # No reference to the plant: it would be a cycle with the Diagram that owns this block.
        copy = partial(ContactPlantCopy, slave.config, slave.environment, slave.start)
        self._plant_copy = cache(copy)  # made at its first use
        self._max_copy_wrenches = 2 * self._max_queued_steps + int(hold_time / period) + 4
        self._period = period
        self._event_periods = (hold_time, sensor_chain.SAMPLES_PER_NOISE_BLOCK * period)
        self._no_noise, self._zero_wrench = np.zeros(sensor_chain.NOISE_BLOCK_SIZE), np.zeros(6)
        self._no_rate = np.zeros(0)

        self._state = self.DeclareVectorInputPort("slave_state", 2 * n)
        self._torque = self.DeclareVectorInputPort("joint_torque", n)
        self._rate = self.DeclareVectorInputPort("torque_rate", n) if ramps else None
        self._acceleration = self.DeclareVectorInputPort("slave_acceleration", n)
        self._applied = self.DeclareVectorInputPort("applied_wrench_W", 6)
        self._sheet = self._contacts = self._noise = self._plant = None
        if slave.leaf_instance_in_compiled_law is not None:
            self._sheet = self.DeclareVectorInputPort("sheet_state", 2)
        if contact.plant_state_size:
            self._plant = self.DeclareVectorInputPort("plant_state", contact.plant_state_size)
        if slave.can_tool_touch:
            contacts = Value[ContactResults]()
            self._contacts = self.DeclareAbstractInputPort("contact_results", contacts)
            self._tool = contact.tool_bodies, contact.tool_shapes
        if not config.ideal:
            self._noise = self.DeclareVectorInputPort("noise", sensor_chain.NOISE_BLOCK_SIZE)
        self.DeclareDiscreteState(memory)
        self._result = np.zeros(len(first) + 1 + len(memory))
        self._memory_slice = slice(len(first) + 1, None)  # memory in the output
        self._scratch = np.empty((9, 2 * n + 6 + contact.plant_state_size))
        # Without the acceleration: each change in the plant would invalidate twice.
        pushes = (self._torque, self._rate, self._applied)
        around = (self._sheet, self._plant, self._contacts)
        seen = (self._state, *pushes, *around, self._noise)
        tickets = {port.ticket() for port in seen if port is not None}
        tickets |= {self.time_ticket(), self.xd_ticket()}
        calc = weak_callback(self._calc_samples_until_now)
        self._step = self.DeclareVectorOutputPort("step", len(self._result), calc, tickets)
        if self.reason_beyond_contact_law:
            self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._queue_step_or_take_samples)
        else:
            self.DeclarePerStepDiscreteUpdateEvent(self._queue_step_or_take_samples)
        check = self._check_acceleration_for_unknown_forces
        self.DeclarePeriodicPublishEvent(_ACCELERATION_CHECK_PERIOD_S, 0.0, check)

    @property
    def motion_dependent_state_indices(self) -> NDArray[np.intp]:
        """Indices of the numbers of this block's discrete state that depend on the motion."""
        _, chain_end, end = self._sensor
        size = regressor.sample_size(self._n)
        before_and_walks = range(size, 2 * size + sensor_chain.FILTER_START_INDEX)
        others = [regressor.SATURATION_FLAG_INDEX, *before_and_walks, chain_end, chain_end + 1]
        return np.delete(np.arange(end), others)

    def take_samples(self, context: Context) -> None:
        """Take the samples that are due before now, and store them in the context."""
        self._take_due_samples_into(context, False, self._result)
        context.SetDiscreteState(self._result[self._memory_slice])

    def reset_queue(self, context: Context) -> None:
        """Reset the queue of steps to the current time; call this after setting states manually."""
        memory = context.get_mutable_discrete_state_vector().get_mutable_value()
        tail, time = memory[self._sensor[2] :], context.get_time()
        tail[0], tail[1] = np.ceil(time / self._period - _EQUAL_TIME_TOLERANCE_PERIODS), 0.0
        append_step_to_queue(tail, time, *self._states_of_arm_and_environment(context))

    def _states_of_arm_and_environment(self, context: Context) -> tuple[Array, Array]:
        if self._plant is not None:
            self._around[2:] = self._plant.Eval(context)
        around = self._around if self._sheet is None else self._sheet.Eval(context)
        return self._state.Eval(context), around

    def _evaluate_applied_wrench(self, context: Context) -> Array:
        return self._applied.Eval(context) if self._applied.HasValue(context) else self._zero_wrench

    def _classify_tool_proximity(self, state: Array, surroundings: Array) -> int:
        if self._contacts is None:
            return PROXIMITY_FAR
        if self.reason_beyond_contact_law:
            return PROXIMITY_TOUCHING
        arm, _, pairs, _, joints, _ = self._physics
        q, sheet, plant = state[: self._n], surroundings[:2], surroundings[2:]
        return classify_tool_proximity(arm, pairs, self._monitored_pairs, joints, q, sheet, plant)

    def _plant_contact_wrench_W(self, context: Context) -> Array:
        assert self._contacts is not None
        return contact_wrench_W(self._contacts.Eval(context), *self._tool)

    def _calc_samples_until_now(self, context: Context, output: BasicVector) -> None:
        self._take_due_samples_into(context, True, output.get_mutable_value())

    def _take_due_samples_into(self, context: Context, include_now: bool, result: Array) -> None:
        seen = self._states_of_arm_and_environment(context)
        near, contact_W = self._classify_tool_proximity(*seen), _NO_GIVEN_CONTACT_WRENCH
        if include_now and near == PROXIMITY_FAR:
            contact_W = self._zero_wrench
        elif include_now and (near == PROXIMITY_NEAR_MONITORED or self._uses_plant_contact):
            contact_W = self._plant_contact_wrench_W(context)
        rate = self._no_rate if self._rate is None else self._rate.Eval(context)
        torques = self._torque.Eval(context), rate
        applied = self._evaluate_applied_wrench(context)
        noise = self._no_noise if self._noise is None else self._noise.Eval(context)
        memory = context.get_discrete_state_vector().value()
        constants = self._physics, self._sensor, self._period
        inputs = (*constants, context.get_time(), *seen, torques, applied, noise, memory)
        if near != PROXIMITY_NEAR_MONITORED:
            take_due_samples(*inputs, include_now, contact_W, self._scratch, result)
            return
        own = 2 * self._n + 2
        size = own + len(self._around) - 2
        # Row 0: number of wrenches in the other rows, number requested, state of the last request.
        table = np.zeros((1 + self._max_copy_wrenches, 2 + size))
        physics = (*self._physics[:-1], table)
        # The state of each requested wrench depends on the previous wrenches.
        for k in range(self._max_copy_wrenches):
            table[0, :2] = k, 0.0
            take_due_samples(physics, *inputs[1:], include_now, contact_W, self._scratch, result)
            if table[0, 1] <= k:
                return
            state = table[0, 2:]
            table[1 + k, :6] = self._plant_copy().wrench_W(state[:own], state[own:])

    def _queue_step_or_take_samples(self, context: Context, discrete_state: DiscreteValues) -> None:
        time = context.get_time()
        if self._max_queued_steps > 1 and not self._is_torque_or_noise_update_time(time):
            seen = self._states_of_arm_and_environment(context)
            monitored = self._monitored_pairs.size
            if not monitored or self._classify_tool_proximity(*seen) != PROXIMITY_NEAR_MONITORED:
                memory = discrete_state.get_mutable_value(0)
                if _append_if_space(memory, self._sensor[2], self._max_queued_steps, time, *seen):
                    return
        discrete_state.set_value(0, self._step.Eval(context)[self._memory_slice])

    def _is_torque_or_noise_update_time(self, time: float) -> bool:
        # Inline for speed: called at every step in contact.
        margin, (held, block) = _EQUAL_TIME_TOLERANCE_PERIODS * self._period, self._event_periods
        if abs(time - held * round(time / held)) < margin:
            return True
        return abs(time - block * round(time / block)) < margin

    def _check_acceleration_for_unknown_forces(self, context: Context) -> EventStatus:
        n, physics = self._n, self._physics
        state, around = self._states_of_arm_and_environment(context)
        x, xdot = np.empty(2 * n + len(around)), np.empty(2 * n + 2)
        assemble_plant_state_into(state, around, x)
        if not np.isfinite(x).all():  # the samples are flagged
            return EventStatus.Succeeded()
        torque, applied = self._torque.Eval(context), self._evaluate_applied_wrench(context)
        near = self._classify_tool_proximity(state, around)
        if self.reason_beyond_contact_law or near == PROXIMITY_NEAR_MONITORED:
            contact_W, p_WS = self._plant_contact_wrench_W(context).copy(), np.empty(3)
            serial_arm.forward_kinematics(physics[0], state[:n], np.empty((3, 3)), p_WS)
            contact_W[3:] -= np.cross(p_WS, contact_W[:3])  # about So instead of the world's origin
            applied = applied + contact_W
            physics = (*physics[:2], physics[2][:0], *physics[3:])
        contact_and_plant_rates_into(physics, x, torque, applied, np.empty(6), xdot)
        vdot = self._acceleration.Eval(context)
        error, size = np.abs(xdot[n + 1 : -1] - vdot).max(), np.abs(vdot).max()
        if not error < _ACCELERATION_CHECK_TOLERANCE * (1.0 + size):
            what = "a force moves the slave, but the wrist sensor does not receive it"
            what, where = f"at {context.get_time():g} s {what}", "wrist_sensor.applied_wrench_W"
            remedy = "connect every wrench on the tool to this port"
            raise DrakeTeleopError(what, where=where, remedy=remedy)
        return EventStatus.Succeeded()


def sample_at_rest(arm: serial_arm.ArmModel, q: Array) -> Array:
    """Return the true sample (16 + n,) with the arm at rest at the joint angles q (n,) [rad]."""
    sample, still = np.zeros(regressor.sample_size(len(q))), np.zeros(len(q))
    true_sample_into(arm.table, arm.phi_load, q, still, still, np.zeros(6), sample)
    sample[regressor.JOINT_POSITIONS_SLICE] = q
    return sample


def AddCompiledWristSensor(
    builder: DiagramBuilder,
    slave: SlavePlant,
    config: sensor_chain.WristSensorConfig,
    motion: motion_estimation.MotionEstimationConfig,
    period: float,
    hold_time: float,
    torque: Mapping[str, OutputPort],
) -> dict[str, OutputPort]:
    """Add the block "wrist_sensor" with its noise source; return the ports by name.

    `torque` contains the joint control's ports: `joint_torque`, and `torque_rate` if torques ramp.
    """
    sensor = WristSensor(slave, config, motion, period, hold_time, ramps="torque_rate" in torque)
    builder.AddNamedSystem("wrist_sensor", sensor)
    connect_matching_inputs(builder, sensor, slave.ports)
    connect_matching_inputs(builder, sensor, torque)
    if not config.ideal:
        block_s = sensor_chain.SAMPLES_PER_NOISE_BLOCK * period
        noise = RandomSource(RandomDistribution.kGaussian, sensor_chain.NOISE_BLOCK_SIZE, block_s)
        builder.AddNamedSystem("wrist_sensor_noise", noise)
        builder.Connect(noise.get_output_port(), sensor.GetInputPort("noise"))
    parts = regressor.signal_sizes_of_sample(slave.arm.num_joints)
    sizes = list(parts.values())
    step = sensor.GetOutputPort("step")
    rest = step.size() - sum(sizes)
    whole = builder.AddNamedSystem("wrist_sample", Demultiplexer([sum(sizes) + 1, rest - 1]))
    divided = builder.AddNamedSystem("sample_parts", Demultiplexer([*sizes, 1, rest - 1]))
    for splitter in (whole, divided):
        builder.Connect(step, splitter.get_input_port())
    ports = {name: divided.get_output_port(i) for i, name in enumerate([*parts, "sample_time"])}
    return ports | {"sample": whole.get_output_port(0)}
