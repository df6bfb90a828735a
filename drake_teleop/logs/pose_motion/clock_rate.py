"""Rate of the poses' clock relative to the wrench's clock, Eq. (T76)."""

from __future__ import annotations

import numpy as np

from drake_teleop.logs.pose_motion.linear_model import Spectra, Window
from drake_teleop.logs.pose_motion.poses import Poses
from drake_teleop.logs.pose_motion.spectra import Grid, signal_spectrum
from drake_teleop.logs.pose_motion.splines import PoseSplines, SplineCache

_STEPS, _MIN_LIKELIHOOD_GAIN = 3, 25.0
# A larger change of the delay [s] is not caused by a clock.
_MAX_CHANGE_S = 0.2


def clock_rate(window: Window, cache: SplineCache, delay: float, spacing: float) -> float:
    """Return the relative rate error of the poses' clock, such as 5e-5, or 0 if insignificant."""
    first, grid = window.spectra(cache.at(spacing), delay), window.grid
    now, best = first, 0.0
    least = start = now.fit().cost
    for _ in range(_STEPS):
        step, gain = _step(now)
        trial = best + step
        if gain < _MIN_LIKELIHOOD_GAIN and best == 0.0:
            return 0.0
        if abs(trial) * float(grid.t[-1] - grid.t[0]) > 2.0 * _MAX_CHANGE_S:
            break
        splines = PoseSplines(at_rate(cache.poses, trial, grid, delay), spacing)
        now = first.with_motion(splines, window.gravity_W, delay)
        cost = now.fit().cost
        if not cost < least:
            break
        least, best = cost, trial
    return best if 2.0 * (start - least) > _MIN_LIKELIHOOD_GAIN else 0.0


def at_rate(poses: Poses, rate: float, grid: Grid, delay: float) -> Poses:
    """Return the poses on the wrench's clock, for a relative rate error of their own clock.

    The delay at mid-record, `delay` [s], is unchanged.
    """
    middle = 0.5 * float(grid.t[0] + grid.t[-1]) + delay
    return Poses(middle + (poses.t - middle) / (1.0 + rate), poses.position, poses.quaternion)


def _step(spectra: Spectra) -> tuple[float, float]:
    fit, grid = spectra.fit(), spectra.grid
    change = np.gradient(spectra.zeta, grid.dt, axis=0)
    from_middle = (grid.t - 0.5 * (grid.t[0] + grid.t[-1]))[:, None]
    count = len(spectra.of.frequency)
    free = spectra.signals if grid.load is None else spectra.signals[:, :1]
    k = free.shape[1]
    moves = [signal_spectrum(grid, spectra.taper, x, count) for x in (from_middle * change, change)]
    gram, right = np.zeros((2, 2)), np.zeros(2)
    for c, C in enumerate(fit.coefficients):
        weight = np.sqrt(spectra.of.weight / fit.power[spectra.of.band, c])[:, None]
        columns = np.column_stack([free, *(x @ C for x in moves)])
        left = (spectra.wrench[:, c] - spectra.signals @ C)[:, None]
        y = (np.hstack([columns, left]) * weight).view(np.float64).reshape(count, -1, 2)
        y = y.transpose(0, 2, 1).reshape(2 * count, -1)
        G = y.T @ y
        # Eliminate the coefficients.
        reduced = G[k:, k:] - G[k:, :k] @ np.linalg.pinv(G[:k, :k], 1e-12, True) @ G[:k, k:]
        gram += reduced[:2, :2]
        right += reduced[:2, 2]
    inverse = np.linalg.pinv(gram, 1e-12, True)
    step = float(inverse[0] @ right)
    return step, 2.0 * step**2 / float(inverse[0, 0] + 1e-300)
