"""Gain, phase and delay margins of a loop with delay."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.lab.analysis.delayed_loop import (
    Array,
    DelayedLoop,
    angle_of,
    gain_crossings,
    margin_of_delay,
    min_without_nan,
    phase_lag_to_minus_one,
    polynomial_roots,
    unstable_poles,
)


@dataclass(frozen=True)
class Margins:
    """Stability margins of a loop, or of each loop of a grid (...).

    Unstable: gain 1, phase 0, delay 0. Without limit: inf, and frequency NaN.
    """

    unstable_poles: Array  #: number of them in the closed loop
    gain: Array  #: factor by which L may grow
    gain_frequency: Array  #: where L then reaches -1 [rad/s]
    phase: Array  #: rotation of L to -1, in either direction [rad]
    phase_frequency: Array  #: [rad/s]
    delay: Array  #: delay that may be added [s]
    delay_frequency: Array  #: [rad/s]


def margins(loop: DelayedLoop) -> Margins:
    """Return the margins of a loop from its coefficients; the delay is exact."""
    unstable = unstable_poles(loop)
    stable = unstable == 0
    frequency, _ = gain_crossings(loop)
    phase, phase_frequency = min_without_nan(
        np.abs(phase_lag_to_minus_one(loop, frequency)), frequency
    )
    delay, delay_frequency = margin_of_delay(loop, stable)
    limits = [_gain_margin(loop[cell]) for cell in np.ndindex(loop.delay.shape)]
    gain, gain_frequency = np.moveaxis(np.reshape(limits, (*loop.delay.shape, 2)), -1, 0)
    return Margins(
        unstable,
        np.where(stable, gain, 1.0),
        gain_frequency,
        np.where(stable, phase, 0.0),
        phase_frequency,
        delay,
        delay_frequency,
    )


def margins_of_response(
    omega: ArrayLike,
    response: ArrayLike,
    *,
    delay: ArrayLike = 0.0,
    open_loop_poles: int = 0,
    poles_at_origin: int = 0,
    sampled: bool = False,
) -> Margins:
    """Return the margins of loops from their frequency responses, interpolated in log w.

    Args:
        omega: (n,) frequencies [rad/s], increasing, positive.
        response: (n, ...) loop L(jw) or L(e^(jw Ts)), as `frdata[0, 0]` of a control.FRD.
        delay: (...) delay [s] that is added to the response, exactly.
        open_loop_poles, poles_at_origin, sampled: as in `encirclements`.
    """
    omega = np.asarray(omega, dtype=float)
    if omega.ndim != 1 or not np.all(np.diff(omega, prepend=0.0) > 0):
        raise DrakeTeleopError("the frequencies of a response must rise, from above zero")
    measured, added = np.asarray(response, dtype=complex), np.asarray(delay, dtype=float)
    dimensions = max(measured.ndim - 1, added.ndim)
    w = omega.reshape(-1, *(1,) * dimensions)
    L = measured.reshape(*measured.shape, *(1,) * (dimensions + 1 - measured.ndim))
    L = L * np.exp(-1j * w * added)
    unstable = encirclements(
        L, open_loop_poles=open_loop_poles, poles_at_origin=poles_at_origin, sampled=sampled
    )
    stable = unstable == 0
    log_w, log_gain, angle = np.log(w), np.log(np.abs(L)), angle_of(-L)
    turn = np.unwrap(angle, axis=0)

    gain_fraction = _zero_fraction(log_gain)
    w_c = np.exp(_interpolate(log_w, gain_fraction))
    past = np.mod(_interpolate(turn, gain_fraction), 2 * np.pi)
    phase, phase_frequency = min_without_nan(np.minimum(past, 2 * np.pi - past), w_c, axis=0)
    added_delay, added_delay_frequency = min_without_nan(past / w_c, w_c, axis=0)

    phase_fraction = np.where(np.abs(np.diff(angle, axis=0)) < np.pi, _zero_fraction(angle), np.nan)
    factor = np.exp(-_interpolate(log_gain, phase_fraction))
    w_p = np.exp(_interpolate(log_w, phase_fraction))
    factor, factor_frequency = min_without_nan(np.where(factor > 1, factor, np.nan), w_p, axis=0)
    return Margins(
        unstable,
        np.where(stable, factor, 1.0),
        factor_frequency,
        np.where(stable, phase, 0.0),
        phase_frequency,
        np.where(stable, added_delay, 0.0),
        added_delay_frequency,
    )


def encirclements(
    response: ArrayLike,
    *,
    open_loop_poles: int = 0,
    poles_at_origin: int = 0,
    sampled: bool = False,
) -> Array:
    """Return the number (...) of unstable closed-loop poles by Nyquist's encirclements of -1.

    Args:
        response: (n, ...) loop L at increasing frequencies, from near zero to where |L| remains
            below 1 (continuous) or to half the sampling rate (`sampled`).
        open_loop_poles: number of unstable poles of L.
        poles_at_origin: number of poles of L at s = 0 or z = 1.

    Raises:
        DrakeTeleopError: if the frequencies are too coarse, or end too early.
    """
    difference = 1 + np.asarray(response, dtype=complex)
    steps = np.angle(difference[1:] / difference[:-1])
    if not np.all(np.abs(steps) < np.pi / 2):
        raise DrakeTeleopError(
            "1 + L turns by more than a right angle between two frequencies",
            remedy="add frequencies there; at its stability limit a loop has no count",
        )
    if not sampled and not np.all(np.abs(difference[-1] - 1) < 1):
        raise DrakeTeleopError("|L| is not below 1 at the last frequency", remedy="go further up")
    start, end = np.angle(difference[0]), np.angle(difference[-1])
    # At s = 0, or right of poles there, 1 + L is real.
    start_turn = start + poles_at_origin * np.pi / 2
    turn = np.sum(steps, axis=0) + start_turn - np.pi * np.round(start_turn / np.pi)
    turn = turn - poles_at_origin * np.pi / 2
    if not sampled:
        turn = turn - end
    return open_loop_poles - np.round(turn / np.pi)


def _gain_margin(loop: DelayedLoop) -> tuple[float, float]:
    slow, fast = break_frequencies(loop)
    # Above the last pole |L| falls, and with a delay its phase passes -pi within one turn.
    delay = float(loop.delay)
    turn = 2 * np.pi / (delay if delay > 1e-9 / fast else 1e-3 / fast)
    omega = frequency_grid(loop, slow, 3 * fast + 2 * turn)
    angle = angle_of(-loop(1j * omega))
    crossed = ((angle[1:] < 0) != (angle[:-1] < 0)) & (np.abs(np.diff(angle)) < np.pi)
    low, high, below = omega[:-1][crossed], omega[1:][crossed], angle[:-1][crossed] < 0
    for _ in range(52):
        middle = (low + high) / 2
        same = (angle_of(-loop(1j * middle)) < 0) == below
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    size = np.abs(loop(1j * high))
    found = list(zip(1 / size[size > 0], high[size > 0], strict=True))

    N, D = loop.numerator, loop.denominator
    if N[-1] * D[-1] < 0:
        found.append((-D[-1] / N[-1], 0.0))
    if loop.high_frequency_gain > 0 and (loop.delay > 0 or N[0] * D[0] < 0):
        found.append((1 / loop.high_frequency_gain, np.inf))
    return min((limit for limit in found if limit[0] > 1), default=(np.inf, np.nan))


def break_frequencies(loop: DelayedLoop) -> tuple[float, float]:
    """Return the smallest and largest magnitude of the poles of N / D, without 0 [rad/s]."""
    breaks = np.abs(polynomial_roots(loop.denominator))
    breaks = breaks[breaks > 0]
    return float(np.min(breaks, initial=1.0)), float(np.max(breaks, initial=1.0))


def frequency_grid(loop: DelayedLoop, slow: float, top: float) -> Array:
    """Return frequencies [rad/s] up to `top`, dense enough for the phase of L."""
    step = np.pi / 8 / max(float(loop.delay), 1 / top)
    return np.union1d(np.geomspace(1e-3 * slow, top, 1000), np.arange(step, top, step))


def _zero_fraction(value: Array) -> Array:
    before, after = value[:-1], value[1:]
    step = np.where(before == after, 1.0, before - after)
    return np.where((before < 0) != (after < 0), before / step, np.nan)


def _interpolate(value: Array, fraction: Array) -> Array:
    return value[:-1] + fraction * (value[1:] - value[:-1])
