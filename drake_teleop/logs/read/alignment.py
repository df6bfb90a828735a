"""Resampling, zero-phase low-pass, differentiation and time shift of signals."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.fft import next_fast_len

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.logs.read.canonical import Log

_MIN_SAMPLES = 8
_CHUNK_ROWS = 2**18
_MIN_WINDOW_SAMPLES = 9
_POLYNOMIAL_DEGREE = 5
SMOOTHER_WINDOW = 1.8
"""Window length [s] of the smoother times its bandwidth [Hz]."""


def spacing(t: Array) -> float:
    """Return the mean step of the times `t` (N,) [s]."""
    return float(t[-1] - t[0]) / (len(t) - 1)


def uniform_times(t: Array) -> Array:
    """Return equidistant times over the span of `t` (N,), at its median rate."""
    even = np.linspace(t[0], t[-1], len(t))
    if np.abs(t - even).max() < 1e-3 * spacing(t):
        return t
    dt = float(np.median(np.diff(t)))
    return t[0] + dt * np.arange(int((t[-1] - t[0]) / dt + 1e-6) + 1)


def resample(t_new: Array, t: Array, x: Array) -> Array:
    """Interpolate samples x (N, ...) at `t` linearly at `t_new`; hold the end values."""
    if np.array_equal(t_new, t):
        return x
    out = np.empty((len(t_new), *x.shape[1:]))
    for start in range(0, len(t_new), _CHUNK_ROWS):  # limits the memory of temporaries
        part = slice(start, start + _CHUNK_ROWS)
        out[part] = _interpolate(t_new[part], t, x)
    return out


def _interpolate(t_new: Array, t: Array, x: Array) -> Array:
    # A single search for all columns is faster than np.interp for each.
    before = np.searchsorted(t[1:-1], t_new, side="right")
    start, end = t[before], t[before + 1]
    share = np.minimum(np.maximum((t_new - start) / (end - start), 0.0), 1.0)
    share = share.reshape(-1, *[1] * (x.ndim - 1))
    first = x.take(before, axis=0)
    return first + share * (x.take(before + 1, axis=0) - first)


def low_pass(x: Array, dt: float, cutoff_hz: float | None) -> Array:
    """Filter samples x (N, ...) of spacing `dt` [s] without phase shift, Eq. (T10).

    There is no filter for a cut-off of None or above the Nyquist rate.
    """
    if cutoff_hz is None or cutoff_hz >= 0.5 / dt:
        return x
    n = len(x)
    pad = min(n - 1, math.ceil(3 / (cutoff_hz * dt)))
    # A length without large prime factors is several times faster. The additional samples
    # connect the two continuations by a straight line.
    length = next_fast_len(n + 2 * pad, real=True)
    gain = 1 / (1 + (np.fft.rfftfreq(length, dt) / cutoff_hz) ** 4)
    out, padded = np.empty((n, x.size // n)), np.empty(length)
    for column, filtered in zip(x.reshape(n, -1).T, out.T, strict=True):
        padded[pad : pad + n] = column
        padded[:pad] = 2 * column[0] - column[pad:0:-1]
        padded[pad + n : 2 * pad + n] = 2 * column[-1] - column[-2 : -2 - pad : -1]
        padded[2 * pad + n :] = np.linspace(
            padded[2 * pad + n - 1], padded[0], length - 2 * pad - n
        )
        filtered[:] = np.fft.irfft(np.fft.rfft(padded) * gain, length)[pad : pad + n]
    return out.reshape(x.shape)


def smooth_derivatives(
    x: Array, dt: float, bandwidth_hz: float | None
) -> tuple[Array, Array, Array]:
    """Return smoothed x (N, ...), dx/dt and d^2x/dt^2 by sliding polynomials of degree 5.

    Filter of Savitzky and Golay (1964), window 1.8 / `bandwidth_hz` [s], at least 9 samples.
    """
    n = len(x)
    weights = smoother(n, dt, bandwidth_hz)
    half = weights.shape[1] // 2
    flat = x.reshape(n, -1)
    inner = [
        np.stack([np.convolve(column, row[::-1], mode="valid") for column in flat.T], axis=1)
        for row in weights
    ]
    tau = dt * np.arange(1, half + 1)
    derivatives = []
    for order in range(3):
        before = _differentiate_polynomials([c[0] for c in inner], -tau[::-1], order)
        after = _differentiate_polynomials([c[-1] for c in inner], tau, order)
        middle = math.factorial(order) * inner[order]
        derivatives.append(np.concatenate([before, middle, after]).reshape(x.shape))
    return derivatives[0], derivatives[1], derivatives[2]


def noise_gain(dt: float, bandwidth_hz: float | None) -> Array:
    """Return factors (3,) of `smooth_derivatives` on white noise: [1], [1/s], [1/s^2]."""
    weights = smoother(10**9, dt, bandwidth_hz)
    return np.linalg.norm(weights[:3], axis=1) * np.array([1.0, 1.0, 2.0])


def smoother(n: int, dt: float, bandwidth_hz: float | None) -> Array:
    """Return weights (6, w) that map w <= n samples to the coefficients of their polynomial."""
    window = 0.0 if bandwidth_hz is None else SMOOTHER_WINDOW / bandwidth_hz
    half = max(_MIN_WINDOW_SAMPLES // 2, min(round(window / (2 * dt)), (n - 1) // 2))
    powers = np.vander(np.arange(-half, half + 1) / half, _POLYNOMIAL_DEGREE + 1, increasing=True)
    # The interval -1 ... 1 makes the fit well-conditioned; then scale to seconds.
    return np.linalg.pinv(powers) / (half * dt) ** np.arange(_POLYNOMIAL_DEGREE + 1)[:, None]


def _differentiate_polynomials(coefficients: list[Array], tau: Array, order: int) -> Array:
    terms = [
        math.perm(power, order) * np.outer(tau ** (power - order), c)
        for power, c in enumerate(coefficients)
        if power >= order
    ]
    return np.sum(terms, axis=0)


def angular_motion(R_WS: Array, dt: float, bandwidth_hz: float | None) -> tuple[Array, Array]:
    """Return omega_WS_S [rad/s] and alpha_WS_S [rad/s^2] (N, 3) of equidistant R_WS (N, 3, 3)."""
    _, first, second = smooth_derivatives(R_WS, dt, bandwidth_hz)
    R_SW = np.swapaxes(R_WS, 1, 2)
    return _skew_part(R_SW @ first), _skew_part(R_SW @ second)


def _skew_part(A: Array) -> Array:
    return 0.5 * np.stack(
        [A[:, 2, 1] - A[:, 1, 2], A[:, 0, 2] - A[:, 2, 0], A[:, 1, 0] - A[:, 0, 1]], axis=1
    )


def low_passed(log: Log, cutoff_hz: float | None) -> Log:
    """Return the log with wrench and motion low-passed (zero phase); unchanged for static poses."""
    if log.static:
        return log
    return replace(
        log,
        wrench=low_pass(log.wrench, log.dt, cutoff_hz),
        specific_force=low_pass(log.specific_force, log.dt, cutoff_hz),
        angular_velocity=low_pass(log.angular_velocity, log.dt, cutoff_hz),
        angular_acceleration=low_pass(log.angular_acceleration, log.dt, cutoff_hz),
    )


def undelayed(log: Log, delay_s: float) -> Log:
    """Return the log with its motion advanced by `delay_s` [s]; remove samples without motion.

    Raises:
        DrakeTeleopError: if fewer than 8 samples remain.
    """
    if log.static or delay_s == 0:
        return log
    at = log.t + delay_s
    known = (at >= log.t[0]) & (at <= log.t[-1])
    if known.sum() < _MIN_SAMPLES:
        raise DrakeTeleopError(
            f"a delay of {delay_s:g} s leaves {known.sum()} of {len(log)} samples",
            where=log.source,
            remedy="give a shorter one, or auto",
        )
    s, omega, alpha = (resample(at[known], log.t, x) for x in log.motion)
    gravity, R_WS = (
        None if x is None else resample(at[known], log.t, x) for x in (log.gravity, log.R_WS)
    )
    bridged = None
    if log.bridged is not None:
        # A gap can belong to the wrench or to the motion, so both positions are flagged.
        moved = resample(at[known], log.t, log.bridged.astype(float)) > 0
        bridged = log.bridged[known] | moved
    return replace(
        log.only(known),
        specific_force=s,
        angular_velocity=omega,
        angular_acceleration=alpha,
        gravity=gravity,
        R_WS=R_WS,
        bridged=bridged,
    )


def measured(log: Log, cutoff_hz: float | None) -> NDArray[np.bool_]:
    """Return (N,) booleans: True for samples that no gap affects, even after the low-pass."""
    if log.bridged is None:
        return np.ones(len(log), bool)
    return ~widened(log.bridged, 0 if cutoff_hz is None else math.ceil(2 / (cutoff_hz * log.dt)))


def ends(log: Log, length_s: float, cutoff_hz: float | None) -> NDArray[np.bool_]:
    """Return (N,) booleans: True within `length_s` [s], or a low-pass period, of either end."""
    out = np.zeros(len(log), bool)
    if log.static:
        return out
    if cutoff_hz is not None and cutoff_hz < 0.5 / log.dt:
        length_s = max(length_s, 1.0 / cutoff_hz)
    count = min(math.ceil(length_s / log.dt - 1e-6), len(log) // 4)
    out[:count] = out[len(out) - count :] = True
    return out


def widened(flags: NDArray[np.bool_], by: int) -> NDArray[np.bool_]:
    """Return (N,) booleans: True within `by` samples of a set flag."""
    count = np.concatenate([[0], np.cumsum(flags)])
    at = np.arange(len(flags))
    return count[np.minimum(at + by + 1, len(flags))] > count[np.maximum(at - by, 0)]
