"""Model of the station with one degree of freedom: plant, task and measures.

The station's own `step_channel` connects hand and slave along x at 1 kHz, with held forces.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.compiled import njit
from drake_teleop.common.noise import random_normal
from drake_teleop.common.numeric import Array
from drake_teleop.common.vectors import copy_into
from drake_teleop.lab.analysis.one_axis import AxisParameters
from drake_teleop.station.channel import network
from drake_teleop.station.channel.channel import (
    MASTER_METHOD_MEMORY_SLICE,
    NUM_PORTS_VALUES,
    SLAVE_METHOD_MEMORY_SLICE,
    initial_state_of_master_and_slave_ends,
    step_channel,
)
from drake_teleop.station.channel.network import NetworkConfig
from drake_teleop.station.passivity import methods
from drake_teleop.station.passivity.memory import STORED_ENERGY
from drake_teleop.station.passivity.methods import METHODS, PassivityConfig
from drake_teleop.station.passivity.packet import PACKET_SIZE

PERIOD_S = 1e-3  #: period of the channel [s]
_SUBSTEPS_PER_CHANNEL_PERIOD = 20
# Speeds that regularise the Coulomb friction.
_DEVICE_FRICTION_SPEED_M_S, _SLAVE_FRICTION_SPEED_M_S = 5e-3, 1e-3
AT_HAND, AT_COMMAND, AT_MOTOR, AT_SLAVE = range(4)  #: places of the energy balances

_IMPEDANCE_FREQUENCIES_RAD_S = np.geomspace(0.01, 0.5 / PERIOD_S, 20000) * 2 * np.pi  # rad/s
_MAX_PEAK_TO_PEAK_AT_REST_M = 0.5e-3  # m, peak to peak at rest
TAP_RATES_HZ = (1.0, 1.5)  #: Hz
WRIST_TO_TIP_DISTANCE_M = 0.2  #: m, from the wrist to the tool's tip
_REST_POSITION_M, _PRESS_DEPTH_M = -0.04, 0.02  # m, from the wall: rest position, intended depth


@dataclass(frozen=True)
class Task:
    """Start and end times [s] of the operator's task: swing, rest, press, hold, retreat, rest."""

    swing_start: float = 0.5
    swing_end: float = 3.0
    press_start: float = 5.5
    press_end: float = 6.5
    release_start: float = 11.5
    release_end: float = 12.5
    end: float = 17.0
    rest_window: float = 1.9  #: length of the windows in which rest is required

    def is_held(self, t: Array) -> NDArray[np.bool_]:
        """Return whether times (N,) [s] are in the last `rest_window` of the hold."""
        return (t >= self.release_start - self.rest_window) & (t < self.release_start)


@dataclass(frozen=True, kw_only=True)
class OneDof(AxisParameters):
    """One-axis parameters with Coulomb friction, motor lag, encoders, noise; no device damping.

    The equations of motion, with intended motion x_i, displayed force f, command x_cmd::

        (m_h + m_m) a = K_h (x_i - x) + B_h (v_i - v) - f_c tanh(v / v_c) + f    hand and device
        m_s a_s = K (x_cmd - x_s) - D v_s + f_w          slave, K = D k_p, D = m_s k_v
        f_w = -max(k_e (x_s - x_w) + b_e (v_s - v_w), 0) where x_s > x_w         wall
        f_e = k_f (gamma f_w - sigma m_t a_s)                       force sent to the master
    """

    device_friction: float = 0.05  #: N, Coulomb
    slave_friction: float = 0.0  #: N, Coulomb, of the arm
    wall_damping: float = 0.0  #: N s/m
    motor_lag: float = 0.0  #: s, time constant of the motor force
    master_resolution: float = 0.0  #: m, of the master's encoder; 0: exact
    slave_resolution: float = 0.0  #: m, of the slave's encoder; 0: exact
    wrench_noise: float = 0.0  #: N, standard deviation of the wrist's force
    configured_stiffness_ratio: float = 1.0  #: configured servo stiffness over the true one
    configured_damping_ratio: float = 1.0  #: configured servo damping over the true one
    configured_mass_ratio: float = 1.0  #: configured slave mass over the true one


REFERENCE_ONE_DOF = OneDof(
    hand_mass=0.2, hand_damping=5.0, hand_stiffness=300.0, position_gain=58.5, velocity_gain=234.0
)
"""Model of the figures in docs/delay.md, notebook 02 and benchmarks/README.md.

The model's servo is softer than the station's and critically damped: 207 instead of 502 kN/m, -3 dB
at 12 instead of 14 Hz, delay 17 instead of 13 ms.
"""


@dataclass(frozen=True)
class OneDofRun:
    """Time series (N,) of a run.

    `input_energies` (N, 4) is the energy [J] put into the station so far at four places, scaled to
    the master. In a passive station, AT_HAND plus any other is at least -start_energy::

        AT_HAND     -sum f_(k-1) (x_k - x_(k-1))   f: displayed force, held
        AT_COMMAND   sum w_k (c_k - c_(k-1))       w: sent wrench; c: command; no physical port
        AT_MOTOR    -integral k_f gamma f_m dx_s   f_m: servo's force
        AT_SLAVE     integral k_f gamma f_w dx_s   f_w: wall's force
    """

    t: Array  #: s
    master_position: Array  #: m
    slave_position: Array  #: m
    command_position: Array  #: m, received by the slave
    hand_force: Array  #: N, on the hand
    wall_force: Array  #: N, on the slave
    channel_energy: Array  #: (N, 2) from hand and slave into the channel [J]
    time_without_packets: Array  #: (N, 2) time without packets of hand and slave [s]
    input_energies: Array  #: (N, 4) J
    start_energy: float  #: E_0 of the method's stores [J]

    def least_energy_sum(self, place: int) -> float:
        """Return the minimum [J] of start energy plus input at the hand and a place (column).

        Negative: the station is active.
        """
        other = 0.0 if place == AT_HAND else self.input_energies[:, place]
        return self.start_energy + float(np.nanmin(self.input_energies[:, AT_HAND] + other))


@dataclass(frozen=True)
class RunMeasures:
    """Measures of one run of the task."""

    #: True: at rest in hold and end, within 0.5 mm about a parabola, also at a rotating tool's tip.
    stable: bool
    hunting: float  #: largest peak-to-peak motion in hold and end [m]
    turning: float  #: largest peak-to-peak rotation in hold and end [rad]
    felt_force: float  #: mean force on the hand in the hold [N]
    chatter: float  #: standard deviation of the force on the hand in the hold [N]
    force_error: float  #: relative error of felt_force, compared with the scaled contact force
    drift: float  #: position of slave minus master, 2 s after contact [m]
    free_force: float  #: rms force on the hand in free motion [N]
    rise_delay: float  #: from contact to displayed force, at half its steady value [s], or NaN
    least_energy: float  #: minimum of the energy put in so far [J]; negative: active

    @property
    def rendered_share(self) -> float:
        """Displayed force over scaled contact force in the hold, at least 0, or NaN."""
        return max(1.0 + self.force_error, 0.0)


def run_one_dof(
    model: OneDof,
    passivity: PassivityConfig,
    forward: NetworkConfig,
    backward: NetworkConfig | None = None,
    *,
    seed: int = 0,
    timeout: float = 0.2,
    intent: Array | None = None,
    grip: Array | None = None,
    wall: Array | None = None,
    delays: tuple[NDArray[np.int64], NDArray[np.int64]] | None = None,
) -> OneDofRun:
    """Simulate one run of the model with a passivity method and a network.

    Args:
        backward: network from slave to master; default: `forward`.
        timeout: time without packets before both ends come to rest [s].
        intent: (N, 2) intended position [m] and velocity [m/s]; default: those of `Task()`.
        grip: (N, 3) mass, damping and stiffness of the hand, zeros after release.
        wall: (N, 2) position [m] and stiffness [N/m]; default: 0 m and the model's.
        delays: (forward, backward) travel times of each packet in periods, -1 if lost.
    """
    scale = model.force_scale
    passivity = dataclasses.replace(
        passivity,
        servo_stiffness=[model.configured_stiffness_ratio * model.servo_stiffness] * 2,
        servo_damping=[model.configured_damping_ratio * model.servo_damping] * 2,
        slave_mass=[model.configured_mass_ratio * model.slave_mass] * 2,
    )
    p = methods.method_parameters(passivity, [scale * (model.gamma or 1.0)] * 2)
    intent = operator_intent() if intent is None else intent
    start = np.array([1.0, 0.0, 0.0, 0.0, intent[0, 0], 0.0, 0.0])
    # The channel's command belongs to the next step; here it is used at once.
    playout = forward.playout + PERIOD_S if forward.playout > 0 else 0.0
    forward_line = dataclasses.replace(forward, delay=forward.delay + PERIOD_S, playout=playout)
    ahead, back = (None, None) if delays is None else (delays[0] + (delays[0] >= 0), delays[1])
    lines = [
        network.network_parameters(line, seed, direction, PERIOD_S, min_steps=1, delays=travels)
        for line, direction, travels in (
            (forward_line, network.FORWARD, ahead),
            (backward or forward, network.BACKWARD, back),
        )
    ]
    states = [network.initial_network_state(line, np.zeros(PACKET_SIZE)) for line in lines]
    ends = initial_state_of_master_and_slave_ends(passivity.method, p, start)
    memories = ends[MASTER_METHOD_MEMORY_SLICE], ends[SLAVE_METHOD_MEMORY_SLICE]
    stored = float(memories[0][STORED_ENERGY][0] + memories[1][STORED_ENERGY][0])
    numbers = (
        model.device_mass, model.device_friction, model.slave_mass, model.servo_stiffness,
        model.servo_damping, model.ideal_servo, model.slave_friction, model.motor_lag,
        model.tool_mass, model.wall_damping, scale, model.sigma, model.gamma,
        model.master_resolution, model.slave_resolution, model.wrench_noise, seed % 2**53,
    )  # fmt: skip
    hand = (model.hand_mass, model.hand_damping, model.hand_stiffness) if grip is None else grip
    inputs = intent, hand, (0.0, model.wall_stiffness) if wall is None else wall
    columns = [np.broadcast_to(part, (len(intent), np.shape(part)[-1])) for part in inputs]
    # These methods use the motor's force, which is held over a period; the others interpolate the
    # command over it.
    held = METHODS[passivity.method].balance_at_motors and not model.ideal_servo
    rows = _simulate_one_dof_run(
        methods.step_addresses(passivity.method), tuple(map(float, numbers)), held, p, *lines,
        *states, ends, start, timeout, np.concatenate(columns, axis=1),
    )  # fmt: skip
    t = np.arange(len(intent), dtype=np.float64) * PERIOD_S
    master, slave, command, displayed, pushed = rows.T[:5]
    rest = rows[:, 5:7], rows[:, 7:9], rows[:, 9:], stored
    return OneDofRun(t, master, slave, command, displayed, pushed, *rest)


def operator_intent(task: Task = Task()) -> Array:
    """Return the operator's intended position [m] and velocity [m/s] (N, 2); the wall is at 0."""
    t = np.arange(round(task.end / PERIOD_S), dtype=np.float64) * PERIOD_S
    x = np.full_like(t, _REST_POSITION_M)
    fading_out = _smooth_ramp(t, task.swing_end - 0.5, 0.5)
    fade = np.minimum(_smooth_ramp(t, task.swing_start, 0.5), 1 - fading_out)
    x += 0.03 * fade * np.sin(2 * np.pi * 1.5 * (t - task.swing_start))
    pressing = _smooth_ramp(t, task.press_start, task.press_end - task.press_start)
    releasing = _smooth_ramp(t, task.release_start, task.release_end - task.release_start)
    x += (_PRESS_DEPTH_M - _REST_POSITION_M) * (pressing - releasing)
    return np.stack([x, np.gradient(x, PERIOD_S)], axis=1)


def _smooth_ramp(t: Array, start: float, duration: float) -> Array:
    u = np.clip((t - start) / duration, 0.0, 1.0)
    return u**3 * (10.0 + u * (6.0 * u - 15.0))


def measures_of_run(run: OneDofRun, model: OneDof, task: Task = Task()) -> RunMeasures:
    return measures_of_traces(
        t=run.t,
        master=run.master_position,
        slave=run.slave_position,
        hand_force=run.hand_force,
        pressed=model.force_scale * model.gamma * run.wall_force,
        energy=run.channel_energy.sum(axis=1),
        task=task,
    )


def measures_of_traces(
    *,
    t: Array,
    master: Array,
    slave: Array,
    hand_force: Array,
    pressed: Array,
    energy: Array,
    task: Task,
    turned: Array | None = None,
) -> RunMeasures:
    """Return the measures of a run of the task from equidistant arrays (N,).

    Args:
        master, slave: positions in the direction of pressing [m].
        hand_force, pressed: displayed force and scaled contact force, both on the hand's side [N].
        energy: energy put into the channel or the station so far [J].
        turned: (N, 3) rotation vector of the slave's tool [rad], if it can rotate.
    """
    dt = float(t[1] - t[0])

    def window_slice(start: float, stop: float) -> slice:
        return slice(round(start / dt), round(stop / dt))

    hold = window_slice(task.release_start - task.rest_window, task.release_start)
    rest = window_slice(task.end - task.rest_window, task.end)
    swing = window_slice(task.swing_start, task.swing_end)
    parts, angles = (hold, rest), () if turned is None else turned.T
    hunting = max(_detrended_peak_to_peak(x[part]) for x in (master, slave) for part in parts)
    turning = max((_detrended_peak_to_peak(x[part]) for x in angles for part in parts), default=0.0)
    steady, goal = float(hand_force[hold].mean()), float(pressed[hold].mean())
    after = min(round((task.release_end + 2.0) / dt), len(t) - 1)
    start = round(task.press_start / dt)
    return RunMeasures(
        stable=bool(
            hunting < _MAX_PEAK_TO_PEAK_AT_REST_M
            and turning < _MAX_PEAK_TO_PEAK_AT_REST_M / WRIST_TO_TIP_DISTANCE_M
        ),
        hunting=hunting,
        turning=turning,
        felt_force=abs(steady),
        chatter=float(hand_force[hold].std()),
        force_error=steady / goal - 1 if goal != 0 else float("nan"),
        drift=float(slave[after] - master[after]),
        free_force=float(np.sqrt(np.mean(hand_force[swing] ** 2))),
        rise_delay=_rise_delay_in_samples(hand_force[start:], pressed[start:], steady) * dt,
        least_energy=float(energy.min()),
    )


def damping_for_passivity(model: OneDof, round_trip: float) -> float:
    """Return the least device damping [N s/m] that makes the displayed impedance passive (T43)."""
    return max(0.0, -float(_displayed_impedance_real_part(model, round_trip).min()))


def _displayed_impedance_real_part(model: OneDof, round_trip: float) -> Array:
    s = 1j * _IMPEDANCE_FREQUENCIES_RAD_S
    D, K = model.servo_damping, model.servo_stiffness
    slave = model.slave_mass * s**2 + D * s + K + model.wall_stiffness
    closed_loop = 1.0 if model.ideal_servo else K / slave
    # The command's interpolation and the held force add 1.5 periods.
    delay_factor = np.exp(-s * (round_trip + 1.5 * PERIOD_S))
    contact = model.gamma * model.wall_stiffness / s
    inertia = model.sigma * model.tool_mass * s
    displayed = model.force_scale * (contact + inertia) * closed_loop * delay_factor
    return np.asarray(displayed.real)


def _detrended_peak_to_peak(x: Array) -> float:
    if not np.isfinite(x).all():
        return float("inf")
    t = np.linspace(-1.0, 1.0, len(x))
    return float(np.ptp(x - np.polyval(np.polyfit(t, x, 2), t)))


def _rise_delay_in_samples(hand_force: Array, contact_force: Array, steady_force: float) -> float:
    level, sign = 0.5 * abs(steady_force), np.sign(steady_force)
    exceeds, displayed = contact_force * sign > level, hand_force * sign > level
    start = int(np.argmax(exceeds))
    if not exceeds.any() or displayed[max(start - 1, 0)] or not displayed[start:].any():
        return float("nan")
    return float(np.argmax(displayed[start:]))


@njit(cache=True)
def _simulate_one_dof_run(
    method_steps, model, holds_motor_force, method_parameters, forward_network, backward_network,
    forward_state, backward_state, channel_end_states, start, timeout, inputs,
):  # fmt: skip
    device_mass, friction, slave_mass, K, D, ideal, slave_friction, lag = model[:8]
    tool_mass, wall_damping, scale, sigma, gamma = model[8:13]
    master_resolution, slave_resolution, noise, seed = model[13:]
    frame = np.zeros(11)
    frame[0] = frame[4] = frame[8] = frame[9] = frame[10] = 1.0
    pose_m, pose_s, received = start.copy(), start.copy(), start.copy()
    wrench, load, hand = np.zeros(6), np.zeros(6), np.zeros(6)
    displayed, ports = np.zeros(7), np.zeros(NUM_PORTS_VALUES)
    # Columns: master, slave, command, displayed, wall, energy (2), silent (2), energies (4).
    rows, energies = np.empty((inputs.shape[0], 13)), np.zeros(4)
    x = x_s = x_before = start[4]
    v = v_s = a_s = motor = 0.0
    dt = PERIOD_S / _SUBSTEPS_PER_CHANNEL_PERIOD
    for k in range(inputs.shape[0]):
        mass, damping, stiffness = device_mass + inputs[k, 2], inputs[k, 3], inputs[k, 4]
        x_w, wall_stiffness, following = inputs[k, 5], inputs[k, 6], min(k + 1, len(inputs) - 1)
        v_w = (inputs[following, 5] - x_w) / PERIOD_S
        push = _wall_force(wall_stiffness, wall_damping, x_s - x_w, v_s - v_w)
        wall = -max(push, 0.0)
        wrench[0] = scale * (gamma * wall - sigma * tool_mass * a_s)
        load[0] = -scale * sigma * tool_mass * a_s
        if noise > 0.0:
            wrench[0] += scale * noise * random_normal(np.uint64(seed), k)
        hand[0] = stiffness * (inputs[k, 0] - x) + damping * (inputs[k, 1] - v)
        pose_m[4], pose_s[4] = _quantise(x, master_resolution), _quantise(x_s, slave_resolution)
        energies[AT_HAND] -= displayed[0] * (x - x_before)
        before, x_before = received[4], x
        # A literal False would compile the whole channel once more.
        step_channel(
            method_steps, pose_m, wrench, load, hand, pose_s, np.bool_(False), 0.0, PERIOD_S,
            timeout, frame, method_parameters, forward_network, backward_network, forward_state,
            backward_state, channel_end_states, received, ports, displayed,
        )  # fmt: skip
        command, energies[AT_COMMAND] = received[4], ports[6]
        copy_into(rows[k], 0, (x, x_s, command, displayed[0], wall, ports[0], ports[2]), 0, 7)
        copy_into(rows[k], 7, ports, 4, 2)
        copy_into(rows[k], 9, energies, 0, 4)
        servo_force = K * (command - x_s) - D * v_s
        for i in range(_SUBSTEPS_PER_CHANNEL_PERIOD):
            share = (i + 0.5) / _SUBSTEPS_PER_CHANNEL_PERIOD
            x_i = inputs[k, 0] + share * (inputs[following, 0] - inputs[k, 0])
            v_i = inputs[k, 1] + share * (inputs[following, 1] - inputs[k, 1])
            force = stiffness * (x_i - x) + damping * (v_i - v) + displayed[0]
            v += dt / mass * (force - friction * np.tanh(v / _DEVICE_FRICTION_SPEED_M_S))
            x += dt * v
            x_then, v_then = x_s, v_s
            if ideal > 0.0:
                x_s = before + (i + 1.0) / _SUBSTEPS_PER_CHANNEL_PERIOD * (command - before)
                v_new = (command - before) / PERIOD_S
                a_s, v_s = (v_new - v_s) / PERIOD_S if i == 0 else a_s, v_new
            else:
                if not holds_motor_force:
                    servo_force = K * (before + share * (command - before) - x_s) - D * v_s
                motor = motor + dt / lag * (servo_force - motor) if lag > dt else servo_force
                a_s = (motor - max(push, 0.0)) / slave_mass
                if slave_friction > 0.0:
                    a_s -= slave_friction / slave_mass * np.tanh(v_s / _SLAVE_FRICTION_SPEED_M_S)
                v_s += dt * a_s
                x_s += dt * v_s
            beyond = x_s - (x_w + (i + 1.0) / _SUBSTEPS_PER_CHANNEL_PERIOD * PERIOD_S * v_w)
            push_then, push = push, _wall_force(wall_stiffness, wall_damping, beyond, v_s - v_w)
            work = -_mean_of_positive_part_of_ramp(push_then, push) * (x_s - x_then)
            energies[AT_SLAVE] += scale * gamma * work
            # With the mean speed, the work of all forces equals the change of kinetic energy. An
            # ideal servo moves a slave without mass.
            if ideal == 0.0:
                work = -motor * 0.5 * (v_then + v_s) * dt
            energies[AT_MOTOR] += scale * gamma * work
        if not abs(x) + abs(x_s) < 1e3:
            rows[k + 1 :] = np.nan
            break
    return rows


@njit(cache=True)
def _quantise(x, resolution):
    return np.round(x / resolution) * resolution if resolution > 0.0 else x


@njit(cache=True)
def _wall_force(stiffness, damping, depth, speed):
    return stiffness * depth + (damping * speed if depth > 0.0 else 0.0)


@njit(cache=True)
def _mean_of_positive_part_of_ramp(start, end):
    if start >= 0.0 and end >= 0.0:
        return 0.5 * (start + end)
    if start <= 0.0 and end <= 0.0:
        return 0.0
    return 0.5 * max(start, end) ** 2 / abs(end - start)
