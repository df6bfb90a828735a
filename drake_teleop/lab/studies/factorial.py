"""Effects of factors from a factorial design: plain means, over what all levels have.

Every level of a factor meets the same combinations of the others, and if points have failed with
every seed, what they meet is cut down to the same again: see `cells.py`. Intervals are Student's
for the mean over seeds. A point that has some of the seeds has the sums of point and seed in place
of the others (`filled`); by how much noise moves the sums more for that is added to the intervals,
with the variance that all residuals have.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from drake_teleop.lab.studies.cells import Flags, comparable
from drake_teleop.lab.studies.level_model import CONFIDENCE

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Factorial:
    """The points of a factorial design that have a measure.

    Attributes:
        levels: (n,) of each factor.
        counts: how many levels each factor has.
        seen: (n, seeds) which values are of a run; the others are as `filled` makes them.
    """

    levels: list[NDArray[np.int64]]
    counts: list[int]
    seen: Flags

    def compared(self, *shown: int) -> tuple[Flags, Flags, Array]:
        """What is comparable of the levels of a factor, or of the cells of two.

        Returns:
            (rows,) which levels or cells, (columns,) over which combinations of the other factors'
            levels, see `comparable`; (kept rows, n) from the values to the mean over these.
        """
        others = [factor for factor in range(len(self.counts)) if factor not in shown]
        (row, rows), (column, columns) = self._places(shown), self._places(others)
        point = np.full((rows, columns), -1)
        point[row, column] = np.arange(len(row))
        kept, over = comparable(point >= 0)
        weights = np.zeros((int(kept.sum()), len(row)))
        np.put_along_axis(weights, point[kept][:, over], 1.0 / over.sum(), axis=1)
        return kept, over, weights

    def effects(self, table: Array) -> tuple[list[Array], list[Array]]:
        """Of each factor, (kept levels,) the effects and half the widths of their intervals.

        Args:
            table: (n, seeds) of values, none missing.
        """
        means = [self.compared(factor)[2] for factor in range(len(self.counts))]
        found = [self.means(table, weights - weights.mean(axis=0)) for weights in means]
        return [effect for effect, _ in found], [half for _, half in found]

    def means(self, table: Array, weights: Array) -> tuple[Array, Array]:
        """(k,) sums of points with (k, n) weights, and half the widths of their intervals."""
        mean, half = interval(weights @ table)
        return mean, np.hypot(half, self._lacking(table, weights))

    def _places(self, factors: Sequence[int]) -> tuple[NDArray[np.int64], int]:
        """(n,) at which combination of some factors' levels a point is, and how many there are."""
        place, count = np.zeros(len(self.seen), dtype=np.int64), 1
        for factor in factors:
            place = place * self.counts[factor] + self.levels[factor]
            count *= self.counts[factor]
        return place, count

    def _lacking(self, table: Array, weights: Array) -> Array:
        """(k,) half the widths for what noise does through the seeds that points lack."""
        points, seeds = table.shape
        runs = self.seen.sum(axis=1)
        freedom = runs.sum() - points - seeds + 1
        if (runs == seeds).all():
            return np.zeros(len(weights))
        # Least squares for points and seeds, these zero in sum: what is left of the latter once the
        # points are known, and how it is in each weighted sum.
        zero_sum = np.vstack([np.eye(seeds - 1), -np.ones((1, seeds - 1))])
        seen = self.seen @ zero_sum
        left = (zero_sum.T * self.seen.sum(axis=0)) @ zero_sum - (seen.T / runs) @ seen
        if freedom < 1 or np.linalg.matrix_rank(left) < seeds - 1:
            return np.where((weights[:, runs < seeds] != 0).any(axis=1), np.nan, 0.0)
        moved = (weights / runs) @ seen
        spread = weights**2 @ (1 / runs) + np.sum(moved @ np.linalg.inv(left) * moved, axis=1)
        # Of points with n runs each, the spread over the filled table's seeds shows this much.
        spread -= weights**2 @ ((runs - 1) / (seeds * (seeds - 1)))
        residuals = table - table.mean(axis=1, keepdims=True) - table.mean(axis=0) + table.mean()
        variance = np.sum(residuals**2) / freedom
        quantile = stdtrit(freedom, 0.5 + CONFIDENCE / 2)
        return quantile * np.sqrt(variance * np.maximum(spread, 0.0))


def filled(values: Array) -> Array:
    """A table of points and seeds with sums of both where it has no number.

    The point's other runs alone would move it by what their seeds do to all points.

    Args:
        values: (n, seeds) with nan; no line and no column of nan alone.
    """
    known = np.isfinite(values)
    if known.all():
        return values
    of_seed = np.zeros(values.shape[1])
    for _ in range(100):  # least squares, in turns
        of_point = np.mean(values - of_seed, axis=1, where=known)
        of_seed = np.mean(values - of_point[:, None], axis=0, where=known)
    return np.where(known, values, of_point[:, None] + of_seed)


def interval(table: Array) -> tuple[Array, Array]:
    """(n,) means over the columns that are not nan, and half the widths of their intervals.

    Args:
        table: (n, seeds).
    """
    count = np.isfinite(table).sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.nansum(table, axis=1) / count
        spread = np.nansum((table - mean[:, None]) ** 2, axis=1) / (count - 1)
        quantile = stdtrit(np.maximum(count - 1, 1), 0.5 + CONFIDENCE / 2)
        half = quantile * np.sqrt(spread / count)
    return mean, np.where(count > 1, half, np.nan)
