"""Feedback loop of the sampled one-axis model, cut at the displayed force (T60).

The loop is L(z) z^(-D) for a round trip of D hand periods. Multipliers are the eigenvalues of
the model over one hand period.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_teleop.common.compiled import njit
from drake_teleop.common.numeric import Array
from drake_teleop.lab.analysis import period_map
from drake_teleop.lab.analysis.one_axis import Complex, OneAxis

# Frequencies of the search as angles of z: five decades up to half the hand's rate.
_GAIN_CROSSING_SEARCH_ANGLES_RAD = np.pi * np.logspace(-5, 0, 401)
# More angles near a pole, as multiples of its distance from the unit circle.
_POLE_ANGLE_OFFSET_FACTORS = np.array([-4.0, -2.0, -1.0, -0.5, -0.2, 0.0, 0.2, 0.5, 1.0, 2.0, 4.0])
_GOLDEN_RATIO, _NUM_GOLDEN_SECTION_STEPS = 0.6180339887498949, 25
_MAX_GAIN_CROSSINGS = 32
_UNIT_CIRCLE_TOLERANCE = 1e-9  # distance up to which a multiplier counts as on the circle


@dataclass(frozen=True)
class CutLoop:
    """Open-loop transfer function L(z) of one axis, cut at the displayed force, without delay."""

    open_multipliers: Complex  #: (..., n) multipliers of the cut loop
    closed_multipliers: Complex  #: (..., n) multipliers of the loop closed without delay
    period_s: Array  #: period of the hand [s], (...)
    #: (..., 32) from 0 to pi: crossings of |L| = 1, and ends with |L| > 1
    gain_crossing_angles: Array
    gain_crossing_phases: Array  #: unwrapped phases of L at these angles
    gain_crossing_signs: Array  #: 1 if |L| falls below 1, -1 if it rises, 0 if unused

    @classmethod
    def from_multipliers(
        cls, open_multipliers: Complex, closed_multipliers: Complex, period_s: ArrayLike
    ) -> CutLoop:
        """Return the loop of models with these eigenvalues (..., n), and its gain crossings."""
        shape, n = open_multipliers.shape[:-1], open_multipliers.shape[-1]
        found = np.zeros((3, *shape, _MAX_GAIN_CROSSINGS))
        _find_gain_crossings_into(
            open_multipliers.reshape(-1, n),
            closed_multipliers.reshape(-1, n),
            _GAIN_CROSSING_SEARCH_ANGLES_RAD,
            found.reshape(3, -1, _MAX_GAIN_CROSSINGS),
        )
        return cls(open_multipliers, closed_multipliers, np.broadcast_to(period_s, shape), *found)


def cut_loop(axis: OneAxis, sampling: period_map.Sampling) -> CutLoop:
    M = period_map.transition_matrix_of_cut_loop(axis, sampling)
    n = M.shape[-1] - 3
    closed = M[..., :n, :n].copy()
    closed[..., :, period_map.SAMPLED_FORCE] += M[..., :n, n + 3 + period_map.RECEIVED_FORCE]
    opened = np.linalg.eigvals(M[..., :n, :n]).astype(np.complex128)
    zeros = np.linalg.eigvals(closed).astype(np.complex128)
    return CutLoop.from_multipliers(opened, zeros, 1 / np.asarray(sampling.hand_hz))


def loop_response(loop: CutLoop, omega: ArrayLike, one_way_delay_s: ArrayLike = 0.0) -> Complex:
    """Return response L (N, ...) at `omega` (N,) [rad/s]; positive feedback: L = 1 is the limit."""
    dimensions = max(loop.period_s.ndim, np.ndim(one_way_delay_s))
    w = np.atleast_1d(np.asarray(omega, dtype=float)).reshape(-1, *[1] * dimensions)
    z = np.exp(1j * w * loop.period_s)[..., None]
    # Factor by factor, to keep precision for poles close to z = 1.
    L = 1 - np.prod((z - loop.closed_multipliers) / (z - loop.open_multipliers), axis=-1)
    return L * np.exp(-2j * w * np.asarray(one_way_delay_s))


def gain_and_phase_margin(response: Complex) -> tuple[float, float]:
    """Return gain margin (a factor) and phase margin [rad] of a stable loop; inf: unlimited.

    `response` (N,) is from `loop_response`, at increasing frequencies.
    """
    if np.abs(response).max() < 1e-9:  # no loop
        return np.inf, np.inf
    log_gain, angle = np.log(np.abs(response)), np.angle(response)
    crossings = _zero_crossing_fractions_of_intervals(log_gain)
    lag = np.mod(_interpolate_in_intervals(np.unwrap(angle), crossings), 2 * np.pi)
    phase = np.fmin.reduce(np.minimum(lag, 2 * np.pi - lag), initial=np.inf)
    is_jump = np.abs(np.diff(angle)) >= np.pi
    fraction = np.where(is_jump, np.nan, _zero_crossing_fractions_of_intervals(angle))
    factor = np.exp(-_interpolate_in_intervals(log_gain, fraction))
    return float(np.min(factor[factor > 1], initial=np.inf)), float(phase)


def _zero_crossing_fractions_of_intervals(value: Array) -> Array:
    before, after = value[:-1], value[1:]
    step = np.where(before == after, 1.0, before - after)
    return np.where((before < 0) != (after < 0), before / step, np.nan)


def _interpolate_in_intervals(value: Array, fraction: Array) -> Array:
    return value[:-1] + fraction * (value[1:] - value[:-1])


def count_unstable_multipliers(loop: CutLoop, one_way_delay_s: ArrayLike) -> NDArray[np.int64]:
    """Return the number of unstable multipliers (magnitude above 1) of the closed loop."""
    D = (2 * np.asarray(one_way_delay_s) / loop.period_s)[..., None]
    angles = loop.gain_crossing_angles
    turns = (loop.gain_crossing_phases - D * angles) / (2 * np.pi)
    # Whole turns count twice, once for each sign of the frequency; the ends count half.
    around = np.where(angles >= np.pi, np.rint(2 * turns), np.floor(turns) + np.ceil(turns))
    outside = (np.abs(loop.open_multipliers) > 1 + _UNIT_CIRCLE_TOLERANCE).sum(axis=-1)
    return outside - (loop.gain_crossing_signs * around).sum(axis=-1).astype(np.int64)


def delay_margin(loop: CutLoop, round_trip_s: float = 0.0) -> Array:
    """Return the shortest unstable round-trip delay [s] above `round_trip_s`, or inf."""
    angles = loop.gain_crossing_angles
    phases = loop.gain_crossing_phases - round_trip_s / loop.period_s[..., None] * angles
    inside = (angles > 0) & (angles < np.pi) & (loop.gain_crossing_signs != 0)
    steps = np.mod(phases, 2 * np.pi) / np.where(inside, angles, 1.0)
    more = np.where(inside, steps, np.inf).min(axis=-1) * loop.period_s
    unstable = count_unstable_multipliers(loop, round_trip_s / 2) > 0
    return round_trip_s + np.where(unstable, 0.0, more)


@njit(cache=True)
def _response_at(closed_multipliers, open_multipliers, angle, radius):
    z = complex(radius * math.cos(angle), radius * math.sin(angle))
    ratio = 1.0 + 0.0j
    for i in range(open_multipliers.shape[0]):
        ratio *= (z - closed_multipliers[i]) / (z - open_multipliers[i])
    return 1.0 - ratio


@njit(cache=True)
def _find_gain_crossings_into(open_multipliers, closed_multipliers, angles, found):
    for n in range(open_multipliers.shape[0]):
        poles, zeros, count = open_multipliers[n], closed_multipliers[n], 0
        # Beside z = 1, where the cut loop has a multiplier if the hand has no stiffness.
        value = _response_at(zeros, poles, 0.0, 1.0 + _UNIT_CIRCLE_TOLERANCE)
        before, size = 0.0, abs(value)
        phase = 0.0 if value.real >= 0.0 else math.pi
        if size > 1.0:
            found[0, n, 0], found[1, n, 0], found[2, n, 0] = 0.0, phase, -1.0
            count = 1
        more = _add_angles_near_poles(angles, poles)
        at, values = _add_angles_of_gain_extremes(more, poles, zeros)
        for i in range(at.shape[0]):
            angle, value = at[i], values[i]
            last_size, last_phase = size, phase
            size, phase = abs(value), _unwrap_phase(value, last_phase)
            if (size > 1.0) != (last_size > 1.0) and count < found.shape[2]:
                low, high = before, angle
                while high - low > 1e-12 * high:
                    middle = 0.5 * (low + high)
                    if (abs(_response_at(zeros, poles, middle, 1.0)) > 1.0) == (last_size > 1.0):
                        low = middle
                    else:
                        high = middle
                found[0, n, count] = low
                found[1, n, count] = _unwrap_phase(_response_at(zeros, poles, low, 1.0), last_phase)
                found[2, n, count] = 1.0 if size < last_size else -1.0
                count += 1
            before = angle
        if size > 1.0 and count < found.shape[2]:
            found[0, n, count], found[2, n, count] = math.pi, 1.0
            found[1, n, count] = math.pi * np.rint(phase / math.pi)


@njit(cache=True)
def _add_angles_near_poles(angles, poles):
    pole_angles, offsets = np.abs(np.angle(poles)), np.abs(1.0 - np.abs(poles))
    more = (pole_angles + _POLE_ANGLE_OFFSET_FACTORS.reshape(-1, 1) * offsets).ravel()
    inside = (more > angles[0]) & (more < math.pi)
    return np.sort(np.concatenate((angles, more[inside])))


@njit(cache=True)
def _add_angles_of_gain_extremes(angles, poles, zeros):
    values = np.empty(angles.shape[0], np.complex128)
    for i in range(angles.shape[0]):
        values[i] = _response_at(zeros, poles, angles[i], 1.0)
    size = np.abs(values)
    more = np.empty(angles.shape[0])
    count = 0
    for i in range(1, angles.shape[0] - 1):
        sign = 1.0 if size[i] <= 1.0 else -1.0
        is_extreme = sign * size[i] >= max(sign * size[i - 1], sign * size[i + 1])
        if is_extreme and 0.5 < size[i] < 2.0:
            low, high = angles[i - 1], angles[i + 1]
            for _ in range(_NUM_GOLDEN_SECTION_STEPS):
                a, b = (high - _GOLDEN_RATIO * (high - low), low + _GOLDEN_RATIO * (high - low))
                at_a = _response_at(zeros, poles, a, 1.0)
                at_b = _response_at(zeros, poles, b, 1.0)
                if sign * abs(at_a) > sign * abs(at_b):
                    high = b
                else:
                    low = a
            more[count] = 0.5 * (low + high)
            values = np.append(values, _response_at(zeros, poles, more[count], 1.0))
            count += 1
    if count == 0:
        return angles, values
    angles = np.concatenate((angles, more[:count]))
    order = np.argsort(angles)
    return angles[order], values[order]


@njit(cache=True)
def _unwrap_phase(response, reference):
    phase = math.atan2(response.imag, response.real)
    return phase + 2.0 * math.pi * np.rint((reference - phase) / (2.0 * math.pi))
