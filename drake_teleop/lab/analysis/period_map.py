"""Sampled one-axis model of the station over a hand period, 1 / `Sampling.hand_hz`.

Updates at one instant use values from before it. Device and servo hold their forces; the sensor
samples just before the servo's update.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
from numpy.typing import ArrayLike

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.lab.analysis.linear_model import Linearization
from drake_teleop.lab.analysis.one_axis import Complex, OneAxis
from drake_teleop.lab.analysis.two_port import two_port_matrix
from drake_teleop.station.sensor.sensor_chain import butterworth_sections

(MASTER_X, MASTER_V, SERVO_A, SLAVE_X, SLAVE_V, SAMPLED_FORCE, FIRST_FILTER_STATE) = range(7)
# After the states: the held inputs, and the force received where the loop is cut.
_HELD_HAND_FORCE, _HELD_ENVIRONMENT_FORCE, RECEIVED_FORCE = -3, -2, -1
_MAX_RATE_RATIO_TO_HAND = 1000  # over the hand's rate


@dataclass(frozen=True)
class Sampling:
    """Sample rates of the station; defaults: shipped scenarios with the ideal sensor."""

    hand_hz: float = 2000.0  #: of haptic device and channel
    joint_control_hz: float = 2000.0
    sensor_hz: float = 8000.0
    low_pass_hz: float | None = None  #: of the sensor's 4th-order Butterworth filter; None: ideal


def one_way_delay_in_hand_periods(axis: OneAxis, sampling: Sampling) -> int:
    """Return the one-way delay in hand periods, rounded; at least 1 for a positive delay."""
    steps = math.floor(axis.delay * sampling.hand_hz + 0.5)
    return max(steps, 1) if axis.delay > 0 else 0


def transition_matrix_of_cut_loop(axis: OneAxis, sampling: Sampling) -> Array:
    """Return the one-axis transition matrix over a hand period, cut at the received force.

    It maps n states, held hand and environment forces, received force: (..., n + 3, n + 3).
    """
    if axis.ideal_servo:
        what = "the sampled model does not include an ideal servo"
        remedy = "set it to False with high gains, or use two_port.hybrid_matrix"
        raise DrakeTeleopError(what, where="axis.ideal_servo", remedy=remedy)
    servo_samples = _samples_per_hand_period(sampling, "joint_control_hz")
    sensor_samples = _samples_per_hand_period(sampling, "sensor_hz")
    hand_period = 1 / np.asarray(sampling.hand_hz, dtype=float)
    sections = _low_pass_sections(sampling)
    n = FIRST_FILTER_STATE + 2 * sections.shape[-2]
    # Without the delay, which may be another array, and does not change the map.
    parameters = vars(axis) | vars(sampling) | {"delay": 0.0}
    shape = np.broadcast_shapes(*map(np.shape, parameters.values()))
    zeros = np.zeros((*shape, n + 3, n + 3))
    two_rows = zeros[..., :2, :]
    hand = _hand_transition_rows(two_rows, axis, hand_period)
    servo = _servo_transition_row(zeros[..., :1, :], axis)
    sensor = _sensor_transition_rows(zeros[..., SAMPLED_FORCE:n, :], axis, sections)
    times = sorted({Fraction(k, m) for m in (servo_samples, sensor_samples) for k in range(m)})
    gaps = [end - time for time, end in itertools.pairwise([*times, Fraction(1)])]
    slave = {
        gap: _slave_transition_rows(two_rows, axis, float(gap) * hand_period) for gap in set(gaps)
    }
    M = zeros + np.eye(n + 3)
    for time, gap in zip(times, gaps, strict=True):
        new = M.copy()
        if time == 0:
            new[..., [MASTER_X, MASTER_V], :] = hand @ M
        if (time * servo_samples).denominator == 1:
            new[..., [SERVO_A], :] = servo @ M
        if (time * sensor_samples).denominator == 1:
            new[..., SAMPLED_FORCE:n, :] = sensor @ M
        M = new
        M[..., [SLAVE_X, SLAVE_V], :] = slave[gap] @ M
    return M


def cut_axis_model(axis: OneAxis, sampling: Sampling) -> Linearization:
    """Return the linear one-axis model, cut at the received force, without delay."""
    M = transition_matrix_of_cut_loop(axis, sampling)
    n = M.shape[-1] - 3
    return Linearization(
        M[:n, :n],
        M[:n, n:],
        np.eye(n)[[MASTER_V, SLAVE_V, SAMPLED_FORCE]],
        np.zeros((3, 3)),
        1 / sampling.hand_hz,
        tuple(f"one axis [{k}]" for k in range(n)),
        ("hand_force", "environment_force", "received_force"),
        ("master_velocity", "slave_velocity", "displayed_force"),
    )


def closed_axis_model(axis: OneAxis, sampling: Sampling) -> Linearization:
    """Return the linear one-axis model with its loop closed over the round-trip delay."""
    periods = 2 * one_way_delay_in_hand_periods(axis, sampling)
    cut = cut_axis_model(axis, sampling)
    return cut.close_loop(["displayed_force"], ["received_force"], periods)


def sampled_two_port(axis: OneAxis, sampling: Sampling, frequency: ArrayLike) -> Complex:
    """Return the two-port H (N, 2, 2) of the sampled station without hand and wall.

    `frequency` (N,) [rad/s]: positive, below half the hand's rate.
    """
    bare = replace(axis, wall_stiffness=0.0, wall_damping=0.0)
    bare = replace(bare, hand_mass=0.0, hand_damping=0.0, hand_stiffness=0.0)
    model = cut_axis_model(bare, sampling)
    w = np.atleast_1d(np.asarray(frequency, dtype=float))
    delay_factor = np.exp(-1j * w * model.dt * one_way_delay_in_hand_periods(axis, sampling))
    # Responses without delay to a force on the device, and to one of the environment.
    response = model.frequency_response(w)[:, :, :2]
    (v_m, _), (v_s, yielding), (displayed, displayed_e) = np.moveaxis(response, 0, 2)
    hold = -np.expm1(-1j * w * model.dt) / (1j * w * model.dt)
    return two_port_matrix(
        hold * (1 + delay_factor**2 * displayed) / v_m,
        delay_factor * displayed_e,
        -delay_factor * v_s / v_m,
        -yielding / hold,
    )


def _samples_per_hand_period(sampling: Sampling, name: str) -> int:
    hand_hz = np.asarray(sampling.hand_hz, dtype=float)
    ratios = np.asarray(getattr(sampling, name) / hand_hz, dtype=float)
    count = round(float(ratios.flat[0]))
    fits = (np.abs(ratios - count) <= 1e-9 * count) & (1 <= count <= _MAX_RATE_RATIO_TO_HAND)
    if not fits.all():
        wrong = float(ratios[~fits].flat[0])
        what = f"is {wrong:.10g} times hand_hz (must be one whole multiple for all values)"
        remedy = f"choose hand_hz times a whole number from 1 to {_MAX_RATE_RATIO_TO_HAND}"
        raise DrakeTeleopError(what, where=f"sampling.{name}", remedy=remedy)
    return count


def _low_pass_sections(sampling: Sampling) -> Array:
    if sampling.low_pass_hz is None:
        return np.zeros((0, 5))
    cutoffs, rates = np.broadcast_arrays(sampling.low_pass_hz, sampling.sensor_hz)
    if (wrong := ~(cutoffs < rates / 2)).any():
        what = f"{cutoffs[wrong][0]:g} Hz is not below half of sensor_hz, {rates[wrong][0]:g} Hz"
        remedy = "choose less than half of sensor_hz"
        raise DrakeTeleopError(what, where="sampling.low_pass_hz", remedy=remedy)
    pairs = zip(cutoffs.flat, rates.flat, strict=True)
    sections = np.array([butterworth_sections(cutoff, rate) for cutoff, rate in pairs])
    return sections.reshape(*rates.shape, 2, 5)


def _hand_transition_rows(zero_rows: Array, axis: OneAxis, period: Array) -> Array:
    rows, mass = zero_rows.copy(), axis.hand_mass + axis.device_mass
    responses = mass_spring_unit_responses(0.0, axis.device_damping / mass, period)
    rows[..., [MASTER_X, MASTER_V]] = responses[..., :2]
    forces = {MASTER_X: -axis.hand_stiffness, MASTER_V: -axis.hand_damping}
    for column, force in (forces | {_HELD_HAND_FORCE: 1, RECEIVED_FORCE: -1}).items():
        rows[..., column] += np.asarray(force / mass)[..., None] * responses[..., 2]
    return rows


def _servo_transition_row(zero_row: Array, axis: OneAxis) -> Array:
    row, kv, kp = zero_row.copy(), axis.velocity_gain, axis.position_gain
    row[..., 0, MASTER_X] = kv * kp * axis.position_scale
    row[..., 0, SLAVE_X] = -kv * kp
    row[..., 0, SLAVE_V] = -kv
    return row


def _sensor_transition_rows(zero_rows: Array, axis: OneAxis, sections: Array) -> Array:
    rows, displayed_mass = zero_rows.copy(), axis.displayed_tool_mass
    scale = axis.force_scale * (axis.gamma - displayed_mass / axis.slave_mass)
    value = rows[..., 0, :]
    value[..., SLAVE_X] = scale * axis.wall_stiffness
    value[..., SLAVE_V] = scale * axis.wall_damping
    value[..., _HELD_ENVIRONMENT_FORCE] = scale
    value[..., SERVO_A] = axis.force_scale * displayed_mass
    for k in range(sections.shape[-2]):
        b0, b1, b2, a1, a2 = np.moveaxis(sections[..., k, :, None], -2, 0)
        first, raw = 1 + 2 * k, value.copy()
        value[:] = b0 * raw
        value[..., SAMPLED_FORCE + first] += 1.0
        rows[..., first, :] = b1 * raw - a1 * value
        rows[..., first, SAMPLED_FORCE + first + 1] += 1.0
        rows[..., first + 1, :] = b2 * raw - a2 * value
    return rows


def _slave_transition_rows(zero_rows: Array, axis: OneAxis, time: Array) -> Array:
    rows, mass = zero_rows.copy(), axis.slave_mass
    springs = axis.wall_stiffness / mass, axis.wall_damping / mass
    responses = mass_spring_unit_responses(*springs, time)
    rows[..., [SLAVE_X, SLAVE_V, SERVO_A]] = responses
    rows[..., _HELD_ENVIRONMENT_FORCE] = -responses[..., 2] / np.asarray(mass)[..., None]
    return rows


def mass_spring_unit_responses(stiffness: ArrayLike, damping: ArrayLike, time: ArrayLike) -> Array:
    """Return (x, x') after `time` [s] with x'' = u - b x' - k x, as an array (..., 2, 3).

    Columns: responses to x = 1 or x' = 1 at the start, and to constant u = 1.
    """
    k, b, t = np.broadcast_arrays(stiffness, damping, time)
    M = np.zeros((*k.shape, 3, 3))
    M[..., 0, 1], M[..., 1, 0], M[..., 1, 1], M[..., 1, 2] = t, -k * t, -b * t, t
    return _matrix_exponential(M)[..., :2, :]


def _matrix_exponential(M: Array) -> Array:
    largest = float(np.abs(M).sum(axis=-1).max(initial=0.0))
    halvings = math.ceil(math.log2(largest / 0.25)) if largest > 0.25 else 0
    term = E = np.broadcast_to(np.eye(M.shape[-1]), M.shape)
    for i in range(1, 15):  # 0.25^15 / 15! is below rounding
        term = term @ M / (i * 2.0**halvings)
        E = E + term
    for _ in range(halvings):
        E = E @ E
    return E
