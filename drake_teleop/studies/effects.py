"""What a study's rows say about its factors: means with confidence intervals; the Pareto front.

All points of a design have the same seeds, and the seeds are what the runs are a sample of. In a
factorial design every level of a factor meets the same combinations of the others. So each mean
is one over runs, calculated for each seed alone, and its interval is Student's for the mean over
seeds. Differences between levels are taken within each seed: what a seed does to all points
cancels. One repeat says nothing about other seeds, and has no intervals (nan).

The points of any other design are a sample, too, and its levels differ by chance in what else is
varied; likewise those of a factorial one if a point failed with every seed. There the effects are
those of a regression, and the intervals hold for the design and the seeds together; see
`level_model.py`. With one repeat the intervals of effects are those of the design alone.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from drake_teleop.studies.design import Factor, Study
from drake_teleop.studies.level_model import CONFIDENCE, Levels, level_model, levels_of

if TYPE_CHECKING:
    import polars as pl

Array = NDArray[np.float64]

#: What a designer of the loop gives and takes: the hand's effort against what it gets for it.
PARETO = ("effort_Ns", "task_time_s", "contact_force_overshoot_N")


@dataclass(frozen=True, eq=False)
class Estimate:
    """Means with their intervals.

    Attributes:
        mean: (n,) over the seeds.
        half: (n,) half the width of the interval of the mean.
        effect_half: (n,) half the width of the interval of the mean's difference from the mean of
            all n, which is the narrower one if seeds differ in the same way at every level.
    """

    mean: Array
    half: Array
    effect_half: Array


@dataclass(frozen=True, eq=False)
class MainEffect:
    """What one factor does to a measure.

    Attributes:
        names: of its n levels, or of parts of its range.
        runs: (n,) at each.
        mean: (n,) over all other factors and the seeds.
        half: (n,) half the width of the interval of the mean.
        effect: (n,) the difference of the mean from that over all levels.
        effect_half: (n,) half the width of its interval.
        fitted: whether a regression found it, see `level_model.py`.
    """

    names: list[str]
    runs: NDArray[np.int64]
    mean: Array
    half: Array
    effect: Array
    effect_half: Array
    fitted: bool


@dataclass(frozen=True, eq=False)
class PairMeans:
    """The means of a measure over two factors.

    Attributes:
        fields: of the two, n and m levels.
        names: of the levels.
        mean: (n, m) over all other factors and the seeds.
        fitted: whether a regression found it, see `level_model.py`.
    """

    fields: tuple[str, str]
    names: tuple[list[str], list[str]]
    mean: Array
    fitted: bool


def estimated(
    values: Array, levels: NDArray[np.int64], seeds: NDArray[Any], count: int
) -> Estimate:
    """The mean of each of `count` levels, over seeds.

    Args:
        values: (N,) of the rows; nan does not count.
        levels: (N,) indices of the level.
        seeds: (N,).
    """
    present, seed = np.unique(seeds, return_inverse=True)
    sums, runs = np.zeros((count, len(present))), np.zeros((count, len(present)))
    known = np.isfinite(values)
    np.add.at(sums, (levels[known], seed[known]), values[known])
    np.add.at(runs, (levels[known], seed[known]), 1.0)
    with np.errstate(invalid="ignore"):
        table = sums / runs
    mean, half = _interval(table)
    # Differences only between what is there: a seed that lacks a level would shift all others.
    _, effect_half = _interval(table - table.mean(axis=0))
    return Estimate(mean, half, effect_half)


def effects(study: Study, rows: pl.DataFrame) -> pl.DataFrame:
    """The main effects: a row for each measure, factor and level."""
    import polars as pl

    table = [
        {
            "measure": measure,
            "factor": field,
            "level": name,
            "runs": int(found.runs[index]),
            "mean": found.mean[index],
            "mean_half": found.half[index],
            "effect": found.effect[index],
            "effect_half": found.effect_half[index],
        }
        for measure in study.measures
        for field, found in main_effects(study, rows, measure).items()
        for index, name in enumerate(found.names)
    ]
    return pl.DataFrame(table)


def main_effects(study: Study, rows: pl.DataFrame, measure: str) -> dict[str, MainEffect]:
    """What each factor does to a measure, by field; nothing if no run has it."""
    data = _Data(study, rows, measure)
    return (
        {} if data.nothing else {f.field: data.main_effect(k) for k, f in enumerate(data.factors)}
    )


def pair_means(study: Study, rows: pl.DataFrame, measure: str) -> list[PairMeans]:
    """The means of a measure over each pair of factors; none if there are too few points."""
    data = _Data(study, rows, measure)
    pairs = itertools.combinations(range(len(data.factors)), 2)
    return [] if data.nothing else [found for pair in pairs if (found := data.pair(*pair))]


class _Data:
    """One measure at the points of a design, and how its effects are found: see above."""

    def __init__(self, study: Study, rows: pl.DataFrame, measure: str) -> None:
        self.factors = varied(study)
        points, self.table = _points_and_seeds(rows, measure)
        self.nothing = not len(points)
        self.columns = [points[factor.field].to_list() for factor in self.factors]
        self.balanced = study.design == "factorial" and len(points) == study.size()
        self.model = None
        if not self.balanced and not self.nothing:
            self.model = level_model(self.factors, self.columns)

    def main_effect(self, factor: int) -> MainEffect:
        levels = self._levels(factor)
        mean = half = effect = effect_half = np.full(len(levels.names), np.nan)
        if self.model is not None:
            effect, effect_half = (found[factor] for found in self.model.effects(self.table))
            mean, half = self.model.means(self.table, factor)
        elif self.balanced:
            found = self._cells(levels.index, len(levels.names))
            mean, half, effect_half = found.mean, found.half, found.effect_half
            effect = mean - mean.mean()
        runs = np.bincount(levels.index) * self.table.shape[1]
        return MainEffect(
            levels.names, runs, mean, half, effect, effect_half, self.model is not None
        )

    def pair(self, first: int, second: int) -> PairMeans | None:
        a, b = self._levels(first), self._levels(second)
        if self.balanced:
            shape = len(a.names), len(b.names)
            index = a.index * shape[1] + b.index
            mean = self._cells(index, shape[0] * shape[1]).mean.reshape(shape)
        elif self.model is not None and self.model.products:
            mean = self.model.cells(self.table, first, second)
        else:
            return None
        fields = self.factors[first].field, self.factors[second].field
        return PairMeans(fields, (a.names, b.names), mean, not self.balanced)

    def _levels(self, factor: int) -> Levels:
        if self.model is not None:
            return self.model.factors[factor]
        return levels_of(self.factors[factor], self.columns[factor])

    def _cells(self, index: NDArray[np.int64], count: int) -> Estimate:
        seeds = self.table.shape[1]
        places, of_seed = np.repeat(index, seeds), np.tile(np.arange(seeds), len(index))
        return estimated(self.table.ravel(), places, of_seed, count)


def _points_and_seeds(rows: pl.DataFrame, measure: str) -> tuple[pl.DataFrame, Array]:
    """The points at which a run has the measure, and (n, seeds) its values.

    What a failed run lacks is taken as its point and its seed have it elsewhere: the point's other
    runs alone would move it by what their seeds do to all points.
    """
    import polars as pl

    points = rows.unique("point", keep="first").sort("point")
    _, point = np.unique(rows["point"].to_numpy(), return_inverse=True)
    seeds, seed = np.unique(rows["seed"].to_numpy(), return_inverse=True)
    table = np.full((points.height, len(seeds)), np.nan)
    table[point, seed] = numbers(rows, measure)
    known = np.isfinite(table)
    kept, table = known.any(axis=1), table[known.any(axis=1)][:, known.any(axis=0)]
    return points.filter(pl.Series(kept)), _filled(table)


def _filled(table: Array) -> Array:
    """A table of points and seeds with sums of both where it has no number."""
    known = np.isfinite(table)
    if known.all():
        return table
    of_seed = np.zeros(table.shape[1])
    for _ in range(100):  # least squares, in turns
        of_point = np.mean(table - of_seed, axis=1, where=known)
        of_seed = np.mean(table - of_point[:, None], axis=0, where=known)
    return np.where(known, table, of_point[:, None] + of_seed)


def pareto(study: Study, rows: pl.DataFrame) -> pl.DataFrame | None:
    """Every point with the means of `PARETO`, their intervals, and whether it is on the front.

    On the front is a point to which no other is better or equal in everything. A point at which not
    every run has all three is not compared: a mean over the runs that went well would flatter it.

    Returns:
        A row for each point, or None if the study does not measure all three.
    """
    import polars as pl

    if not set(PARETO) <= set(study.measures) or rows.is_empty():
        return None
    fields = [factor.field for factor in study.factors]
    points = rows.unique("point", keep="first").sort("point").select("point", *fields)
    order, index = np.unique(rows["point"].to_numpy(), return_inverse=True)
    seeds, complete = rows["seed"].to_numpy(), np.ones(len(order), dtype=bool)
    means = []
    for name in PARETO:
        values = numbers(rows, name)
        complete &= np.bincount(index, ~np.isfinite(values), len(order)) == 0
        found = estimated(values, index, seeds, len(order))
        points = points.with_columns(
            pl.Series(name, found.mean), pl.Series(f"{name}_half", found.half)
        )
        means.append(found.mean)
    return points.with_columns(
        pl.Series("complete", complete), pl.Series("front", front(np.column_stack(means), complete))
    )


def front(values: Array, complete: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(n,) which of the complete points no other complete one dominates; (n, k), small is good."""
    found = complete.copy()
    for index in np.flatnonzero(complete):
        other = values[complete]
        dominated = np.all(other <= values[index], axis=1) & np.any(other < values[index], axis=1)
        found[index] = not dominated.any()
    return found


def varied(study: Study) -> list[Factor]:
    """The factors that have more than one value."""
    return [factor for factor in study.factors if len(factor.listed()) > 1]


def numbers(rows: pl.DataFrame, measure: str) -> Array:
    """(N,) a measure, nan where a run has none."""
    import polars as pl

    column: Array = rows[measure].cast(pl.Float64).fill_null(float("nan")).to_numpy()
    return column


def _interval(table: Array) -> tuple[Array, Array]:
    """Mean over the columns that are not nan, and half the width of its interval."""
    count = np.isfinite(table).sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.nansum(table, axis=1) / count
        spread = np.nansum((table - mean[:, None]) ** 2, axis=1) / (count - 1)
        quantile = stdtrit(np.maximum(count - 1, 1), 0.5 + CONFIDENCE / 2)
        half = quantile * np.sqrt(spread / count)
    return mean, np.where(count > 1, half, np.nan)
