"""Delay between motion and wrench, estimated from the log."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array, checked, number
from drake_teleop.load.compensation import contact_wrench
from drake_teleop.load.regressor import regressor
from drake_teleop.logs.read.alignment import low_passed, measured, resample, widened
from drake_teleop.logs.read.canonical import Log

SEARCH_RANGE = 0.25
_MAX_SAMPLES = 5000
_MIN_SAMPLES = 32


def estimate_delay(log: Log, cutoff_hz: float | None, phi: Array | None = None) -> float | None:
    """Return the delay of the motion behind the wrench [s], or None if undetermined.

    It minimizes sum_c log var(w_c - o_c - (V(t + delay) phi)_c) over the channels c of the wrench
    w, within +-0.25 s or a tenth of the record. Offsets o, and phi (10,) if not given, are fitted.
    """
    cutoff = min(cutoff_hz or 30.0, 0.2 / log.dt)
    smooth = low_passed(log, cutoff)
    reach = min(SEARCH_RANGE, 0.1 * float(log.t[-1] - log.t[0]))
    step = min(1 / (8 * cutoff), reach / 8)
    inside = (smooth.t >= smooth.t[0] + reach) & (smooth.t <= smooth.t[-1] - reach)
    inside = np.flatnonzero(inside & _away_from_gaps(log, cutoff, reach))
    if len(inside) < _MIN_SAMPLES:
        return None
    stride = max(1, math.floor(1 / (4 * cutoff * log.dt)), len(inside) // _MAX_SAMPLES)
    cost = _shift_cost(smooth, inside[::stride], phi)
    shifts = step * np.arange(-round(reach / step), round(reach / step) + 1)
    costs = np.array([cost(shift) for shift in shifts])
    best = int(np.argmin(costs))
    independent = 2 * cutoff * float(log.t[-1] - log.t[0])
    if best in (0, len(shifts) - 1) or costs.max() - costs[best] < 0.1 + 50 / independent:
        return None
    return _refine_shift(cost, float(shifts[best]), step)


def delay_of(
    log: Log, cutoff_hz: float | None, delay: str | float, phi: Array | None = None
) -> tuple[float, str]:
    """Return the delay of the motion to remove [s], and its source; `delay` is in [s], or "auto".

    The source is "static", "given", "estimated" or "undetermined" (0).

    Raises:
        DrakeTeleopError: for another text.
    """
    if log.static:
        return 0.0, "static"
    if not isinstance(delay, str):
        return float(checked("delay", number("delay", delay))), "given"
    if delay != "auto":
        raise DrakeTeleopError(
            f"{delay!r} is neither seconds nor auto", where="delay", remedy="give a number or auto"
        )
    found = estimate_delay(log, cutoff_hz, phi)
    return (0.0, "undetermined") if found is None else (found, "estimated")


def _away_from_gaps(log: Log, cutoff: float, reach: float) -> NDArray[np.bool_]:
    gap = ~measured(log, cutoff)
    return ~widened(gap, math.ceil(reach / log.dt)) if gap.any() else ~gap


def _refine_shift(cost: Callable[[float], float], best: float, step: float) -> float:
    while step > 1e-5:
        step /= 4
        candidates = best + step * np.arange(-4, 5)
        best = float(candidates[int(np.argmin([cost(shift) for shift in candidates]))])
    return best


def _shift_cost(log: Log, rows: NDArray[np.intp], phi: Array | None) -> Callable[[float], float]:
    t, wrench = log.t[rows], log.wrench[rows]
    # Common scales of forces and torques prevent large weights of channels without a signal; the
    # floor excludes rounding of a constant wrench.
    rounding = (1e-9 * np.abs(wrench).max()) ** 2 + 1e-30
    variance = np.repeat(wrench.var(axis=0).reshape(2, 3).sum(axis=1), 3) + rounding
    scale, floor = np.sqrt(variance), 1e-9 * variance
    motion = np.hstack(log.motion)  # one interpolation for all signals

    def residual(shift: float) -> Array:
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

    return lambda shift: float(np.log(residual(shift).var(axis=0) + floor).sum())
