"""Choice of the next points of an adaptive design by expected improvement (Jones 1998).

A batch uses the "kriging believer" (Ginsbourger 2010).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.optimize import minimize
from scipy.special import ndtr
from scipy.stats import norm

from drake_teleop.common.numeric import Array

# Bounds of log length scale, in units of the design's span, and of log noise variance, in units of
# the objective's variance.
_LOG_LENGTH_BOUNDS, _LOG_NOISE_BOUNDS = (np.log(0.05), np.log(10.0)), (np.log(1e-6), np.log(1.0))


def propose_points(points: Array, objective: ArrayLike, candidates: Array, count: int) -> list[int]:
    """Return the indices of `count` candidates, chosen in turn by the largest expected improvement.

    `points` (n, d) and `candidates` (m, d) have coordinates from 0 to 1; `objective` (n,) is
    minimised; nan counts as the worst value.
    """
    y = np.array(objective, dtype=float)
    if not np.isfinite(y).any():
        return list(range(count))
    y = np.where(np.isfinite(y), y, np.nanmax(np.where(np.isfinite(y), y, np.nan)))
    y = (y - y.mean()) / (y.std() or 1.0)
    lengths, noise = _fit_kernel_lengths_and_noise(points, y)
    points, candidates = points / lengths, candidates / lengths
    chosen: list[int] = []
    for _ in range(count):
        mean, deviation = _predict_mean_std(points, y, candidates, noise)
        # Improvement over the best predicted mean, not over the best noisy value.
        best = _predict_mean_std(points, y, points, noise)[0].min()
        u = (best - mean) / deviation
        improvement = deviation * (u * ndtr(u) + norm.pdf(u))
        improvement[chosen] = -1.0
        chosen.append(int(np.argmax(improvement)))
        points = np.vstack([points, candidates[chosen[-1]]])
        y = np.append(y, mean[chosen[-1]])
    return chosen


def _fit_kernel_lengths_and_noise(points: Array, y: Array) -> tuple[Array, float]:
    def neg_log_likelihood(x: Array) -> float:
        K = _matern_kernel(points / np.exp(x[:-1]), points / np.exp(x[:-1]))
        K[np.diag_indices_from(K)] += np.exp(x[-1])
        factor = cho_factor(K, lower=True)
        logarithm = np.log(np.diag(factor[0])).sum()
        return float(0.5 * y @ cho_solve(factor, y) + logarithm)

    bounds = [_LOG_LENGTH_BOUNDS] * points.shape[1] + [_LOG_NOISE_BOUNDS]
    starts = (np.log([length] * points.shape[1] + [0.1]) for length in (0.3, 1.5))
    found = [minimize(neg_log_likelihood, x0, method="L-BFGS-B", bounds=bounds) for x0 in starts]
    x = min(found, key=lambda result: result.fun).x
    return np.exp(x[:-1]), float(np.exp(x[-1]))


def _predict_mean_std(points: Array, y: Array, queries: Array, noise: float) -> tuple[Array, Array]:
    K = _matern_kernel(points, points)
    K[np.diag_indices_from(K)] += noise
    lower, _ = cho_factor(K, lower=True)
    cross = _matern_kernel(points, queries)
    mean = cross.T @ cho_solve((lower, True), y)
    explained = np.sum(solve_triangular(lower, cross, lower=True) ** 2, axis=0)
    return mean, np.sqrt(np.maximum(1.0 - explained, 1e-12))


def _matern_kernel(a: Array, b: Array) -> Array:
    r = np.sqrt(5.0 * ((a[:, None] - b[None]) ** 2).sum(axis=-1))
    return (1.0 + r + r * r / 3.0) * np.exp(-r)
