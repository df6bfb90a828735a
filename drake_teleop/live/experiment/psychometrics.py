"""Thresholds from two-interval forced-choice answers, and the next level to present.

    d'(x) = (x / threshold)^slope,    P(correct) = lapse / 2 + (1 - lapse) Phi(d' / sqrt 2)

Psi method: Kontsevich and Tyler, Vision Research 39, 1999; Prins, J. Vision 13(7), 2013.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr, xlogy

from drake_teleop.common.numeric import Array

#: Grid of the uniform prior; thresholds and slopes are uniform in the logarithm.
_NUM_GRID_THRESHOLDS = 81
_GRID_SLOPES = np.geomspace(0.7, 3.0, 7)
_GRID_LAPSE_RATES = np.array([0.0, 0.02, 0.04, 0.08])
# Factor of the range of thresholds beyond the range of levels.
_THRESHOLD_GRID_FACTOR = 2.0
_NUM_STIMULUS_LEVELS = 25


def correct_answer_probability(level: Array, threshold: Array, slope: Array, lapse: Array) -> Array:
    """Return the probability of a correct two-interval answer at stimulus levels >= 0."""
    return 0.5 * lapse + (1.0 - lapse) * ndtr((level / threshold) ** slope / math.sqrt(2.0))


class EstimateWithLimits(NamedTuple):
    """Estimate with the limits of its 95 % interval."""

    value: float
    low: float
    high: float


class PsiMethod:
    """Psi method: posterior of threshold, slope and lapse, for levels `low` > 0 to `high`."""

    def __init__(self, low: float, high: float) -> None:
        self.levels = np.geomspace(low, high, _NUM_STIMULUS_LEVELS)
        self._thresholds = np.geomspace(
            low / _THRESHOLD_GRID_FACTOR, high * _THRESHOLD_GRID_FACTOR, _NUM_GRID_THRESHOLDS
        )
        self._grid = np.ix_(self._thresholds, _GRID_SLOPES, _GRID_LAPSE_RATES)
        shape = (_NUM_GRID_THRESHOLDS, len(_GRID_SLOPES), len(_GRID_LAPSE_RATES))
        self._posterior = np.full(shape, 1.0 / math.prod(shape))
        # P(correct) as (levels, thresholds, slopes and lapses).
        p_correct = np.stack([self._correct_probability_on_grid(x) for x in self.levels])
        self._p_correct = p_correct.reshape(_NUM_STIMULUS_LEVELS, _NUM_GRID_THRESHOLDS, -1)

    def _correct_probability_on_grid(self, level: float) -> Array:
        return correct_answer_probability(np.float64(level), *self._grid)

    def next_level(self) -> float:
        """Return the level whose answer minimises the expected entropy of the threshold."""
        posterior = self._posterior.reshape(_NUM_GRID_THRESHOLDS, -1)
        right = np.einsum("ltk,tk->lt", self._p_correct, posterior)  # P(correct and threshold)
        wrong = posterior.sum(axis=1) - right
        lost = np.zeros(_NUM_STIMULUS_LEVELS)
        for joint in (right, wrong):
            lost -= xlogy(joint, joint).sum(axis=1)
            total = joint.sum(axis=1)
            lost += xlogy(total, total)
        return float(self.levels[np.argmin(lost)])

    def update_posterior(self, level: float, correct: bool) -> None:
        p = self._correct_probability_on_grid(level)
        self._posterior = self._posterior * (p if correct else 1.0 - p)
        self._posterior /= self._posterior.sum()

    def threshold(self) -> EstimateWithLimits:
        """Return median and 95 % interval of the level with d' = 1."""
        share = self._posterior.sum(axis=(1, 2))
        # The probability of a node is uniform over its cell, in the logarithm.
        step = math.log(self._thresholds[1] / self._thresholds[0])
        edges = math.log(self._thresholds[0]) + step * (np.arange(_NUM_GRID_THRESHOLDS + 1) - 0.5)
        below = np.concatenate([[0.0], np.cumsum(share)])
        value, low, high = np.exp(np.interp([0.5, 0.025, 0.975], below, edges))
        return EstimateWithLimits(float(value), float(low), float(high))

    def estimate_d_prime(self, level: float) -> EstimateWithLimits:
        """Return median and 95 % interval of the sensitivity d' at a level."""
        d = (level / self._grid[0]) ** self._grid[1]
        values, share = d.ravel(), self._posterior.sum(axis=2).ravel()
        order = np.argsort(values)
        below = np.cumsum(share[order]) - 0.5 * share[order]
        found = np.interp([0.5, 0.025, 0.975], below, values[order])
        return EstimateWithLimits(*(float(x) for x in found))
