"""Effects from a factorial design: plain means over comparable combinations.

Missing seeds of a point follow an additive model of point and seed (`filled`); its variance widens
the intervals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from drake_teleop.common.arrays import Array
from drake_teleop.lab.studies.cells import Flags, comparable
from drake_teleop.lab.studies.level_model import CONFIDENCE


@dataclass(frozen=True, eq=False)
class Factorial:
    """Points of a factorial design that have a measure.

    Attributes:
        levels: (n,) of each factor.
        counts: number of levels of each factor.
        seen: (n, seeds) True for measured values.
    """

    levels: list[NDArray[np.int64]]
    counts: list[int]
    seen: Flags

    def compared(self, *shown: int) -> tuple[Flags, Flags, Array]:
        """Return the comparable levels of a factor, or cells of two factors.

        Returns:
            (rows,) levels or cells; (columns,) combinations of others; (kept rows, n) matrix from
            values to means.
        """
        others = [factor for factor in range(len(self.counts)) if factor not in shown]
        (row, rows), (column, columns) = (
            self._combination_indices(shown),
            self._combination_indices(others),
        )
        point = np.full((rows, columns), -1)
        point[row, column] = np.arange(len(row))
        kept, over = comparable(point >= 0)
        weights = np.zeros((int(kept.sum()), len(row)))
        np.put_along_axis(weights, point[kept][:, over], 1.0 / over.sum(), axis=1)
        return kept, over, weights

    def effects(self, table: Array) -> tuple[list[Array], list[Array]]:
        """Return (kept levels,) effects and half widths of each factor."""
        means = [self.compared(factor)[2] for factor in range(len(self.counts))]
        found = [self.means(table, weights - weights.mean(axis=0)) for weights in means]
        return [effect for effect, _ in found], [half for _, half in found]

    def means(self, table: Array, weights: Array) -> tuple[Array, Array]:
        """Return (k,) sums with (k, n) weights, and half widths."""
        mean, half = interval(weights @ table)
        return mean, np.hypot(half, self._missing_seed_widths(table, weights))

    def _combination_indices(self, factors: Sequence[int]) -> tuple[NDArray[np.int64], int]:
        place, count = np.zeros(len(self.seen), dtype=np.int64), 1
        for factor in factors:
            place = place * self.counts[factor] + self.levels[factor]
            count *= self.counts[factor]
        return place, count

    def _missing_seed_widths(self, table: Array, weights: Array) -> Array:
        """Return (k,) half widths due to missing seeds."""
        points, seeds = table.shape
        runs = self.seen.sum(axis=1)
        freedom = runs.sum() - points - seeds + 1
        if (runs == seeds).all():
            return np.zeros(len(weights))
        # Least squares for points and zero-sum seeds; points are eliminated (Schur complement).
        zero_sum = np.vstack([np.eye(seeds - 1), -np.ones((1, seeds - 1))])
        seen = self.seen @ zero_sum
        left = (zero_sum.T * self.seen.sum(axis=0)) @ zero_sum - (seen.T / runs) @ seen
        if freedom < 1 or np.linalg.matrix_rank(left) < seeds - 1:
            return np.where((weights[:, runs < seeds] != 0).any(axis=1), np.nan, 0.0)
        moved = (weights / runs) @ seen
        spread = weights**2 @ (1 / runs) + np.sum(moved @ np.linalg.inv(left) * moved, axis=1)
        # Subtract the variance that the intervals of the filled table already contain.
        spread -= weights**2 @ ((runs - 1) / (seeds * (seeds - 1)))
        residuals = table - table.mean(axis=1, keepdims=True) - table.mean(axis=0) + table.mean()
        variance = np.sum(residuals**2) / freedom
        quantile = stdtrit(freedom, 0.5 + CONFIDENCE / 2)
        return quantile * np.sqrt(variance * np.maximum(spread, 0.0))


def filled(values: Array) -> Array:
    """Replace nan in (n, seeds) by least squares sums."""
    known = np.isfinite(values)
    if known.all():
        return values
    of_seed = np.zeros(values.shape[1])
    for _ in range(100):  # alternating least squares
        of_point = np.mean(values - of_seed, axis=1, where=known)
        of_seed = np.mean(values - of_point[:, None], axis=0, where=known)
    return np.where(known, values, of_point[:, None] + of_seed)


def interval(table: Array) -> tuple[Array, Array]:
    """Return (n,) means of (n, seeds) without nan, and half widths."""
    count = np.isfinite(table).sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.nansum(table, axis=1) / count
        spread = np.nansum((table - mean[:, None]) ** 2, axis=1) / (count - 1)
        quantile = stdtrit(np.maximum(count - 1, 1), 0.5 + CONFIDENCE / 2)
        half = quantile * np.sqrt(spread / count)
    return mean, np.where(count > 1, half, np.nan)
