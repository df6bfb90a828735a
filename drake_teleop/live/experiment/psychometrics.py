"""Thresholds from answers: which stimulus to show next, and what the answers say. Without Drake.

A participant says in which of two intervals a stimulus was (two-interval forced choice), so that
how ready somebody is to say "yes" does not matter. Of a stimulus of level x

    d'(x) = (x / threshold)^slope,    P(correct) = lapse / 2 + (1 - lapse) Phi(d' / sqrt 2),

so the threshold is where d' is 1, and 76 % of the answers are right if nobody lapses. (Power law of
d': Foley and Legge, Vision Research 21, 1981. Phi: Green and Swets, Signal detection theory and
psychophysics, 1966.) All three parameters are unknown. `Psi` has their joint probability on a grid,
and asks for the level whose answer will tell most about the threshold: the psi method of Kontsevich
and Tyler, Vision Research 39, 1999, with the others marginalised (Prins, J. Vision 13(7), 2013).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, xlogy

Array = NDArray[np.float64]

#: What is thought possible beforehand, all of it as likely: log-uniform thresholds and slopes.
_THRESHOLDS = 81
_SLOPES = np.geomspace(0.7, 3.0, 7)
_LAPSES = np.array([0.0, 0.02, 0.04, 0.08])
# Thresholds may lie so much beyond the levels that can be shown.
_BEYOND = 2.0
_LEVELS = 25


def correct_probability(level: Array, threshold: Array, slope: Array, lapse: Array) -> Array:
    """P(correct) as above; the arguments broadcast. Level and threshold in one unit, level >= 0."""
    d = (level / threshold) ** slope
    return 0.5 * lapse + (1.0 - lapse) * ndtr(d / math.sqrt(2.0))


@dataclass(frozen=True)
class Estimate:
    """A quantity with its 95 % interval.

    Attributes:
        value: the median.
        low, high: where 2.5 % and 97.5 % of the probability lie below.
    """

    value: float
    low: float
    high: float


class Psi:
    """What is known of one participant in one condition.

    Args:
        low, high: the range of levels that can be shown, both > 0.
    """

    def __init__(self, low: float, high: float) -> None:
        self.levels = np.geomspace(low, high, _LEVELS)
        self._thresholds = np.geomspace(low / _BEYOND, high * _BEYOND, _THRESHOLDS)
        self._grid = tuple(
            np.meshgrid(self._thresholds, _SLOPES, _LAPSES, indexing="ij", sparse=True)
        )
        shape = (_THRESHOLDS, len(_SLOPES), len(_LAPSES))
        self._likely = np.full(shape, 1.0 / math.prod(shape))
        # (levels, thresholds, the rest): P(correct) at all that may be asked.
        self._correct = np.stack([self._probability(x).reshape(shape) for x in self.levels])
        self._correct = self._correct.reshape(_LEVELS, _THRESHOLDS, -1)

    def _probability(self, level: float) -> Array:
        return correct_probability(np.float64(level), *self._grid)

    def next_level(self) -> float:
        """The level whose answer leaves the least expected entropy of the threshold.

        It is the same as the largest mutual information of answer and threshold, as entropy now is
        the same for all levels.
        """
        likely = self._likely.reshape(_THRESHOLDS, -1)
        right = np.einsum("ltk,tk->lt", self._correct, likely)  # P(correct and threshold)
        wrong = likely.sum(axis=1) - right
        lost = np.zeros(_LEVELS)
        for joint in (right, wrong):
            lost -= xlogy(joint, joint).sum(axis=1)
            total = joint.sum(axis=1)
            lost += xlogy(total, total)
        return float(self.levels[np.argmin(lost)])

    def answered(self, level: float, correct: bool) -> None:
        """Takes an answer to any level >= 0 into account, also one that was not asked for."""
        p = self._probability(level)
        self._likely = self._likely * (p if correct else 1.0 - p)
        self._likely /= self._likely.sum()

    def threshold(self) -> Estimate:
        """Where d' is 1, in the unit of the levels."""
        share = self._likely.sum(axis=(1, 2))
        # The probability of a node is spread over its cell, evenly in the logarithm.
        step = math.log(self._thresholds[1] / self._thresholds[0])
        edges = math.log(self._thresholds[0]) + step * (np.arange(_THRESHOLDS + 1) - 0.5)
        below = np.concatenate([[0.0], np.cumsum(share)])
        value, low, high = np.exp(np.interp([0.5, 0.025, 0.975], below, edges))
        return Estimate(float(value), float(low), float(high))

    def d_prime(self, level: float) -> Estimate:
        """d' at a level."""
        d = (level / self._grid[0]) ** self._grid[1]
        values, share = d.ravel(), self._likely.sum(axis=2).ravel()
        order = np.argsort(values)
        below = np.cumsum(share[order]) - 0.5 * share[order]
        found = np.interp([0.5, 0.025, 0.975], below, values[order])
        return Estimate(*(float(x) for x in found))
