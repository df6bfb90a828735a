"""Resampling, zero-phase low-pass, differentiation, delay and time shift of signals."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import next_fast_len

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array, finite_array, samples_to_nearest_true, to_float
from drake_teleop.load.compensation import contact_wrench
from drake_teleop.load.regressor import regressor
from drake_teleop.logs.read.canonical import Log

_MIN_SAMPLES_LEFT_AFTER_DELAY_SHIFT = 8
_INTERPOLATED_CHUNK_ROWS = 2**18
_MAX_VALUES_PER_FOURIER_TRANSFORM = 2**18  # limits the memory of the low-pass
_MIN_SMOOTHER_WINDOW_SAMPLES, _SMOOTHER_DEGREE = 9, 5
SMOOTHER_WINDOW_OVER_PERIOD = 1.8  # window [s] of the smoother times its bandwidth [Hz]


def mean_time_step(t: Array) -> float:
    return float(t[-1] - t[0]) / (len(t) - 1)


def uniform_times(t: Array) -> Array:
    """Return equidistant times over the span of `t` (N,), at its median rate."""
    even = np.linspace(t[0], t[-1], len(t))
    if np.abs(t - even).max() < 1e-3 * mean_time_step(t):
        return t
    dt = float(np.median(np.diff(t)))
    return t[0] + dt * np.arange(int((t[-1] - t[0]) / dt + 1e-6) + 1)


def resample(t_new: Array, t: Array, x: Array) -> Array:
    """Interpolate x (N, ...), sampled at `t`, linearly at `t_new`; hold the end values."""
    first = int(np.searchsorted(t, t_new[0])) if len(t_new) else 0
    if np.array_equal(t_new, t[first : first + len(t_new)]):
        return x[first : first + len(t_new)]
    out = np.empty((len(t_new), *x.shape[1:]))
    for row in range(0, len(t_new), _INTERPOLATED_CHUNK_ROWS):  # limits the memory of temporaries
        part = slice(row, row + _INTERPOLATED_CHUNK_ROWS)
        # A single search for all columns is faster than np.interp for each.
        before = np.searchsorted(t[1:-1], t_new[part], side="right")
        start, end = t[before], t[before + 1]
        share = np.minimum(np.maximum((t_new[part] - start) / (end - start), 0.0), 1.0)
        share = share.reshape(-1, *[1] * (x.ndim - 1))
        low = x.take(before, axis=0)
        out[part] = low + share * (x.take(before + 1, axis=0) - low)
    return out


def low_pass(x: Array, dt: float, cutoff_hz: float | None) -> Array:
    """Filter samples x (N, ...) without phase shift, Eq. (T10); return x for a cut-off None."""
    if cutoff_hz is None or cutoff_hz >= 0.5 / dt:
        return x
    n = len(x)
    pad = min(n - 1, math.ceil(3 / (cutoff_hz * dt)))
    # A length without large prime factors is several times faster. The additional samples
    # connect the two continuations by a straight line.
    length = next_fast_len(n + 2 * pad, real=True)
    gain = 1 / (1 + (np.fft.rfftfreq(length, dt) / cutoff_hz) ** 4)
    out = np.empty((n, x.size // n))
    columns = x.reshape(n, -1).T
    count = max(1, _MAX_VALUES_PER_FOURIER_TRANSFORM // length)
    for first in range(0, len(columns), count):  # one transform of several columns is faster
        part = slice(first, first + count)
        padded = _pad_by_continuation(columns[part], pad, length)
        out.T[part] = np.fft.irfft(np.fft.rfft(padded) * gain, length)[:, pad : pad + n]
    return out.reshape(x.shape)


def _pad_by_continuation(x: Array, pad: int, length: int) -> Array:
    """Return rows x (k, N) with `pad` odd-reflected samples at both ends, filled to `length`."""
    n, end = x.shape[1], x.shape[1] + 2 * pad
    padded = np.empty((len(x), length))
    padded[:, pad : pad + n] = x
    padded[:, :pad] = 2 * x[:, :1] - x[:, pad:0:-1]
    padded[:, pad + n : end] = 2 * x[:, -1:] - x[:, -2 : -2 - pad : -1]
    start, stop = padded[:, end - 1 : end], padded[:, :1]
    step = (stop - start) / max(length - end - 1, 1)
    padded[:, end:] = np.arange(length - end) * step + start
    if length - end > 1:
        padded[:, -1:] = stop
    return padded


def smooth_derivatives(
    x: Array, dt: float, bandwidth_hz: float | None
) -> tuple[Array, Array, Array]:
    """Return smoothed x (N, ...), dx/dt and d^2x/dt^2 by sliding polynomials of degree 5.

    Filter of Savitzky and Golay (1964), window 1.8 / `bandwidth_hz` [s], at least 9 samples;
    9 for None.
    """
    n = len(x)
    weights = polynomial_fit_weights(n, dt, bandwidth_hz)
    half = weights.shape[1] // 2
    flat = x.reshape(n, -1)
    inner = [
        np.stack([np.convolve(column, row[::-1], mode="valid") for column in flat.T], axis=1)
        for row in weights
    ]
    tau = dt * np.arange(1, half + 1)

    def derivative(order: int) -> Array:
        before = _evaluate_polynomial_derivatives([c[0] for c in inner], -tau[::-1], order)
        after = _evaluate_polynomial_derivatives([c[-1] for c in inner], tau, order)
        middle = math.factorial(order) * inner[order]
        return np.concatenate([before, middle, after]).reshape(x.shape)

    return derivative(0), derivative(1), derivative(2)


def noise_gain_of_derivatives(dt: float, bandwidth_hz: float | None) -> Array:
    """Return standard deviations (3,) of `smooth_derivatives` for unit white noise of x."""
    weights = polynomial_fit_weights(10**9, dt, bandwidth_hz)
    return np.linalg.norm(weights[:3], axis=1) * np.array([1.0, 1.0, 2.0])


def polynomial_fit_weights(n: int, dt: float, bandwidth_hz: float | None) -> Array:
    """Return weights (6, w) of w samples in six polynomial coefficients; w <= max(n, 9)."""
    window = 0.0 if bandwidth_hz is None else SMOOTHER_WINDOW_OVER_PERIOD / bandwidth_hz
    half = max(_MIN_SMOOTHER_WINDOW_SAMPLES // 2, min(round(window / (2 * dt)), (n - 1) // 2))
    powers = np.vander(np.arange(-half, half + 1) / half, _SMOOTHER_DEGREE + 1, increasing=True)
    # The interval -1 ... 1 makes the fit well-conditioned; then scale to seconds.
    return np.linalg.pinv(powers) / (half * dt) ** np.arange(_SMOOTHER_DEGREE + 1)[:, None]


def _evaluate_polynomial_derivatives(coefficients: list[Array], tau: Array, order: int) -> Array:
    terms = [
        math.perm(power, order) * np.outer(tau ** (power - order), c)
        for power, c in enumerate(coefficients)
        if power >= order
    ]
    return np.sum(terms, axis=0)


def angular_motion(R_WS: Array, dt: float, bandwidth_hz: float | None) -> tuple[Array, Array]:
    """Return omega_WS_S [rad/s] and alpha_WS_S [rad/s^2] (N, 3) of equidistant R_WS.

    `smooth_derivatives` filters R_WS, also if `bandwidth_hz` is None.
    """
    _, first, second = smooth_derivatives(R_WS, dt, bandwidth_hz)
    R_SW = np.swapaxes(R_WS, 1, 2)
    return vectors_of_skew_parts(R_SW @ first), vectors_of_skew_parts(R_SW @ second)


def vectors_of_skew_parts(A: Array) -> Array:
    """Return the vectors (N, 3) whose cross matrices are the skew parts of A (N, 3, 3)."""
    S = A - np.swapaxes(A, 1, 2)
    return 0.5 * np.stack([S[:, 2, 1], S[:, 0, 2], S[:, 1, 0]], axis=1)


def low_pass_log(log: Log, cutoff_hz: float | None) -> Log:
    """Return the log with zero-phase filtered wrench and motion; unchanged for static poses."""
    if log.static:
        return log
    wrench, *motion = (low_pass(x, log.dt, cutoff_hz) for x in (log.wrench, *log.motion))
    return log.with_motion(*motion, wrench=wrench)


def remove_delay(log: Log, delay_s: float) -> Log:
    """Return the log with its motion advanced by the delay [s]; drop samples without motion."""
    if log.static or delay_s == 0:
        return log
    at = log.t + delay_s
    known = (at >= log.t[0]) & (at <= log.t[-1])
    if known.sum() < _MIN_SAMPLES_LEFT_AFTER_DELAY_SHIFT:
        what = (
            f"a delay of {delay_s:g} s leaves {known.sum()} of {len(log)} samples"
            f" ({_MIN_SAMPLES_LEFT_AFTER_DELAY_SHIFT} are required)"
        )
        raise DrakeTeleopError(what, where=log.source, remedy="give a shorter delay, or `auto`")
    names = ("specific_force", "angular_velocity", "angular_acceleration", "gravity", "R_WS")
    present = {name: x for name in names if (x := getattr(log, name)) is not None}
    moved: dict[str, Any] = {k: resample(at[known], log.t, x) for k, x in present.items()}
    if log.bridged is not None:
        # A gap can belong to the wrench or to the motion, so both positions are flagged.
        bridged = resample(at[known], log.t, log.bridged.astype(float)) > 0
        moved["bridged"] = log.bridged[known] | bridged
    return replace(log.select_rows(known), **moved)


def is_far_from_gaps(log: Log, cutoff_hz: float | None) -> NDArray[np.bool_]:
    """Return (N,) True for samples that no gap affects, even after a low-pass."""
    if log.bridged is None:
        return np.ones(len(log), bool)
    reach = 0 if cutoff_hz is None else math.ceil(2 / (cutoff_hz * log.dt))
    return samples_to_nearest_true(log.bridged) > reach


def is_near_ends(log: Log, length_s: float, cutoff_hz: float | None) -> NDArray[np.bool_]:
    """Return (N,) True within `length_s` [s] or a low-pass period, at most N / 4, of an end."""
    out = np.zeros(len(log), bool)
    if log.static:
        return out
    if cutoff_hz is not None and cutoff_hz < 0.5 / log.dt:
        length_s = max(length_s, 1.0 / cutoff_hz)
    count = min(math.ceil(length_s / log.dt - 1e-6), len(log) // 4)
    out[:count] = out[len(out) - count :] = True
    return out


MAX_SEARCHED_DELAY_S = 0.25
_MIN_SAMPLES_FOR_DELAY, _MAX_SAMPLES_FOR_DELAY = 32, 5000


def estimate_delay(log: Log, cutoff_hz: float | None, phi: Array | None = None) -> float | None:
    """Return the delay of the motion behind the wrench [s], or None if undetermined.

    The delay minimizes the log variance of the residual, summed over the wrench channels. Offsets,
    and phi (10,) if not given, are fitted.
    """
    cutoff = min(cutoff_hz or 30.0, 0.2 / log.dt)
    smooth = low_pass_log(log, cutoff)
    reach = min(MAX_SEARCHED_DELAY_S, 0.1 * float(log.t[-1] - log.t[0]))
    step = min(1 / (8 * cutoff), reach / 8)
    inside = (smooth.t >= smooth.t[0] + reach) & (smooth.t <= smooth.t[-1] - reach)
    inside &= samples_to_nearest_true(~is_far_from_gaps(log, cutoff)) > math.ceil(reach / log.dt)
    inside = np.flatnonzero(inside)
    if len(inside) < _MIN_SAMPLES_FOR_DELAY:
        return None
    stride = max(1, math.floor(1 / (4 * cutoff * log.dt)), len(inside) // _MAX_SAMPLES_FOR_DELAY)
    cost = _cost_of_delay(smooth, inside[::stride], phi)
    shifts = step * np.arange(-round(reach / step), round(reach / step) + 1)
    costs = np.array([cost(shift) for shift in shifts])
    best = int(np.argmin(costs))
    independent = 2 * cutoff * float(log.t[-1] - log.t[0])
    if best in (0, len(shifts) - 1) or costs.max() - costs[best] < 0.1 + 50 / independent:
        return None
    delay = float(shifts[best])
    while step > 1e-5:
        step /= 4
        candidates = delay + step * np.arange(-4, 5)
        delay = float(candidates[int(np.argmin([cost(shift) for shift in candidates]))])
    return delay


def choose_delay(
    log: Log, cutoff_hz: float | None, delay: str | float, phi: Array | None = None
) -> tuple[float, str]:
    """Return the delay of the motion behind the wrench [s], and its source; `delay` may be "auto".

    The source is "static", "given", "estimated" or "undetermined" (delay 0).
    """
    if log.static:
        return 0.0, "static"
    if not isinstance(delay, str):
        return float(finite_array("delay", to_float("delay", delay))), "given"
    if delay != "auto":
        what = f"{delay!r} is neither seconds nor auto"
        raise DrakeTeleopError(what, where="delay", remedy="give a number or auto")
    found = estimate_delay(log, cutoff_hz, phi)
    return (0.0, "undetermined") if found is None else (found, "estimated")


def _cost_of_delay(log: Log, rows: NDArray[np.intp], phi: Array | None) -> Callable[[float], float]:
    t, wrench = log.t[rows], log.wrench[rows]
    # Common scales of forces and torques prevent large weights of channels without a signal; the
    # floor excludes rounding of a constant wrench.
    rounding = (1e-9 * np.abs(wrench).max()) ** 2 + 1e-30
    variance = np.repeat(wrench.var(axis=0).reshape(2, 3).sum(axis=1), 3) + rounding
    scale, floor = np.sqrt(variance), 1e-9 * variance
    motion = np.hstack(log.motion)  # one interpolation for all signals

    def residual_at_shift(shift: float) -> Array:
        s, omega, alpha = np.split(resample(t + shift, log.t, motion), 3, axis=1)
        if phi is not None:
            return contact_wrench(wrench, np.zeros(6), s, omega, alpha, phi)
        V = regressor(s, omega, alpha)
        # Subtracting the means fits the offsets; the scale weights force and torque equally.
        V = ((V - V.mean(axis=0)) / scale[:, None]).reshape(-1, 10)
        w = ((wrench - wrench.mean(axis=0)) / scale).ravel()
        # Normal equations are ten times faster than a decomposition of V.
        theta = np.linalg.lstsq(V.T @ V, V.T @ w, rcond=1e-12)[0]
        return (w - V @ theta).reshape(-1, 6) * scale

    return lambda shift: float(np.log(residual_at_shift(shift).var(axis=0) + floor).sum())
