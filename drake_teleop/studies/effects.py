"""What a study's rows say about its factors: means with confidence intervals; the Pareto front.

All points of a design have the same seeds, and the seeds are what the runs are a sample of. So each
figure is calculated for each seed alone, and its interval is Student's for the mean over seeds.
Differences between levels are taken within each seed: what a seed does to all points cancels. One
repeat says nothing about other seeds, and has no intervals (nan).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from drake_teleop.studies.design import Factor, Study

if TYPE_CHECKING:
    import polars as pl

Array = NDArray[np.float64]

CONFIDENCE = 0.95
#: What a designer of the loop gives and takes: the hand's effort against what it gets for it.
PARETO = ("effort_Ns", "task_time_s", "contact_force_overshoot_N")
# Equal parts of a range, of points that lie anywhere in it.
_BINS = 5


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


def levels_of(factor: Factor, column: Sequence[Any]) -> tuple[NDArray[np.int64], list[str]]:
    """The level of each row, and the levels' names.

    A range with many values is cut into equal parts, named by their middles.
    """
    ranged = factor.low is not None and factor.high is not None
    present = [value for value in factor.listed() if value in column]
    if ranged and any(value not in present for value in column):
        low, high = float(factor.low or 0.0), float(factor.high or 0.0)
        share = (np.array(column, dtype=float) - low) / (high - low)
        middles = low + (np.arange(_BINS) + 0.5) / _BINS * (high - low)
        index = np.minimum((share * _BINS).astype(np.int64), _BINS - 1)
        return index, [f"{middle:.3g}" for middle in middles]
    return np.array([present.index(value) for value in column]), [_name(v) for v in present]


def estimated(values: Array, levels: NDArray[np.int64], seeds: Array, count: int) -> Estimate:
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

    seeds, table = rows["seed"].to_numpy(), []
    for factor in varied(study):
        levels, names = levels_of(factor, rows[factor.field].to_list())
        for measure in study.measures:
            found = estimated(numbers(rows, measure), levels, seeds, len(names))
            middle = np.sum(found.mean) / len(names)
            for index, name in enumerate(names):
                table.append(
                    {
                        "measure": measure,
                        "factor": factor.field,
                        "level": name,
                        "runs": int(np.sum(levels == index)),
                        "mean": found.mean[index],
                        "mean_half": found.half[index],
                        "effect": found.mean[index] - middle,
                        "effect_half": found.effect_half[index],
                    }
                )
    return pl.DataFrame(table)


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
        quantile = student.ppf(0.5 + CONFIDENCE / 2, np.maximum(count - 1, 1))
        half = quantile * np.sqrt(spread / count)
    return mean, np.where(count > 1, half, np.nan)


def _name(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)
