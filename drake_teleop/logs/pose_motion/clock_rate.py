"""By how much the clock of the poses runs faster than that of the wrench.

Stamps of the poses that are t + delay + rate (t - middle) at the wrench's time t move the signals
by

    d zeta / d rate = (t - middle) d zeta / dt,

which with the coefficients of `saturated` moves the wrench that is expected. Gauss-Newton for rate
and delay, the 16 coefficients of each channel being free, has no opinion on the load. A rate is
believed if twice the logarithm of the likelihood grows by 25, five standard deviations.
"""

from __future__ import annotations

import numpy as np

from drake_teleop.common.arrays import Array
from drake_teleop.logs.pose_motion.poses import Poses
from drake_teleop.logs.pose_motion.saturated import Spectra, spectra_of
from drake_teleop.logs.pose_motion.spectra import Grid, signal_spectrum
from drake_teleop.logs.pose_motion.splines import Choice, PoseSplines

_STEPS, _BELIEVED = 3, 25.0
# Farther than that from the middle's [s] is no clock's rate, but a motion that does not show it.
_FARTHEST = 0.2


def clock_rate(
    few: Choice,
    grid: Grid,
    taper: Array,
    gravity_W: Array,
    delay: float,
    top: float,
    spacing: float,
) -> float:
    """The rate, such as 5e-5; 0 if none is believed.

    Args:
        few: `for_search`.
        grid, taper: of the wrench.
        gravity_W: (3,) [m/s^2].
        delay: in the middle of the grid [s].
        top: highest frequency [Hz].
        spacing: of the knots [s].
    """
    first = spectra_of(few.at(spacing), grid, taper, gravity_W, delay, top)
    now, best = first, 0.0
    least = start = now.fit().cost
    for _ in range(_STEPS):
        step, gain = _step(now)
        trial = best + step
        if gain < _BELIEVED and best == 0.0:
            return 0.0
        if abs(trial) * float(grid.t[-1] - grid.t[0]) > 2.0 * _FARTHEST:
            break
        splines = PoseSplines(at_rate(few.poses, trial, grid, delay), spacing)
        now = first.with_motion(splines, gravity_W, delay)
        cost = now.fit().cost
        if not cost < least:
            break
        least, best = cost, trial
    return best if 2.0 * (start - least) > _BELIEVED else 0.0


def at_rate(poses: Poses, rate: float, grid: Grid, delay: float) -> Poses:
    """The poses on the clock of the wrench; `delay` [s] is theirs in the middle of the grid."""
    middle = 0.5 * float(grid.t[0] + grid.t[-1]) + delay
    return Poses(middle + (poses.t - middle) / (1.0 + rate), poses.position, poses.quaternion)


def _step(spectra: Spectra) -> tuple[float, float]:
    """Of the rate, and by how much twice the logarithm of the likelihood should grow."""
    fit, grid = spectra.fit(), spectra.grid
    change = np.gradient(spectra.zeta, grid.dt, axis=0)
    away = (grid.t - 0.5 * (grid.t[0] + grid.t[-1]))[:, None]
    count = len(spectra.of.frequency)
    free = spectra.signals if grid.load is None else spectra.signals[:, :1]
    k = free.shape[1]
    moves = [signal_spectrum(grid, spectra.taper, x, count) for x in (away * change, change)]
    gram, right = np.zeros((2, 2)), np.zeros(2)
    for c, C in enumerate(fit.coefficients):
        weight = np.sqrt(spectra.of.weight / fit.power[spectra.of.band, c])[:, None]
        columns = np.column_stack([free, *(x @ C for x in moves)])
        left = (spectra.wrench[:, c] - spectra.signals @ C)[:, None]
        y = (np.hstack([columns, left]) * weight).view(np.float64).reshape(count, -1, 2)
        y = y.transpose(0, 2, 1).reshape(2 * count, -1)
        G = y.T @ y
        # What is left when the coefficients have taken their part.
        rest = G[k:, k:] - G[k:, :k] @ np.linalg.pinv(G[:k, :k], 1e-12, True) @ G[:k, k:]
        gram += rest[:2, :2]
        right += rest[:2, 2]
    inverse = np.linalg.pinv(gram, 1e-12, True)
    step = float(inverse[0] @ right)
    return step, 2.0 * step**2 / float(inverse[0, 0] + 1e-300)
