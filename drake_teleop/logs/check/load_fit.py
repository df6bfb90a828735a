"""Share of a wrench that a load explains, and limits for a better description."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import fdtri

from drake_teleop.common.numeric import Array
from drake_teleop.load.regressor import regressor
from drake_teleop.logs.read.alignment import low_passed, measured
from drake_teleop.logs.read.canonical import Log

GOOD_SHARE = 0.02
"""Largest unexplained share of the variance, without white noise, of a good fit."""
VALID_SHARE = 0.05
"""Largest unexplained share of the variance, without white noise, of a valid description."""
MIN_IMPROVEMENT = 4.0
"""Smallest factor by which an edit must reduce the unexplained share."""
_FALSE_ALARMS, _TESTED_EDITS = 1e-6, 50
_CUTOFF_HZ = 15.0
_MAX_SAMPLES = 1500


@dataclass(frozen=True)
class LoadFit:
    """Least squares fit of a load to a log, Eq. (5).

    Attributes:
        unexplained, noise: shares of the wrench's variance: unexplained, and white noise.
        mass: fitted mass [kg].
        independent: number of independent samples.
    """

    unexplained: float
    mass: float
    noise: float = 0.0
    independent: float = 1e9

    @property
    def good(self) -> bool:
        """Whether some load of positive mass explains the wrench."""
        return self.mass > 0 and self.unexplained < GOOD_SHARE + self.noise


def load_fit(log: Log) -> LoadFit:
    """Fit a load and constant offsets to a log, low-passed at 15 Hz."""
    cutoff = _cutoff(log)
    smooth = low_passed(log, cutoff).only(measured(log, cutoff))
    rows = slice(None, None, max(1, len(log) // _MAX_SAMPLES))
    wrench = smooth.wrench[rows]
    w = wrench - wrench.mean(axis=0)
    scale = _scale(wrench)
    V = regressor(*(x[rows] for x in smooth.motion))
    if "weight" in log.free and smooth.gravity is not None:
        rest = np.zeros_like(smooth.gravity[rows])
        V = np.dstack([V, regressor(-smooth.gravity[rows], rest, rest)[..., :4]])
    V = (V - V.mean(axis=0)) / scale[:, None]
    matrix = V.reshape(-1, V.shape[2])
    size = np.linalg.norm(matrix, axis=0) + 1e-12
    theta = np.linalg.lstsq(matrix / size, (w / scale).ravel(), rcond=1e-6)[0] / size
    total = float((w / scale).var(axis=0).sum()) + 1e-30
    unexplained = float((w / scale - V @ theta).var(axis=0).sum()) / total
    if cutoff is None:
        return LoadFit(unexplained, float(theta[0]), independent=max(1.0, len(w) - 8.0))
    # The low-pass passes the share 0.83 * 2 * cut-off * dt of white noise.
    passed = min(1.0, 1.67 * cutoff * log.dt)
    noise = passed * float(((white_noise(log.wrench) / scale) ** 2).sum()) / total
    independent = 2 * cutoff * float(log.t[-1] - log.t[0])
    return LoadFit(unexplained, float(theta[0]), noise, independent)


def unexplained_share(wrench: Array, residual: Array) -> float:
    """Return the variance of a residual (N, 6) over that of the wrench (N, 6)."""
    scale = _scale(wrench)
    total = float((wrench / scale).var(axis=0).sum()) + 1e-30
    return float((residual / scale).var(axis=0).sum()) / total


def white_noise(x: Array) -> Array:
    """Return standard deviations (k,) of white noise in x (N, k), from third differences."""
    if len(x) < 4:
        return np.zeros(x.shape[1:])
    # The squares of 1, 3, 3, 1 sum to 20; 1.4826 median |x| is the deviation of a normal x.
    return 1.4826 * np.median(np.abs(np.diff(x, 3, axis=0)), axis=0) / np.sqrt(20)


def _cutoff(log: Log) -> float | None:
    return None if log.static else min(_CUTOFF_HZ, 0.2 / log.dt)


def _scale(wrench: Array) -> Array:
    force, torque = np.sqrt(wrench.var(axis=0).reshape(2, 3).sum(axis=1))
    least = 1e-9 * float(np.abs(wrench).max()) + 1e-15
    return np.repeat([force + least, max(torque, 0.03 * force) + least], 3)


def decisive_factor(fit: LoadFit) -> float:
    """Return the factor by which a corrected description must reduce the unexplained share."""
    n = max(1.0, fit.independent)
    return max(MIN_IMPROVEMENT, float(fdtri(n, n, 1 - _FALSE_ALARMS / _TESTED_EDITS)))
