"""Effects of factors on a measure, with 95 % intervals over seeds, and the Pareto front.

A half width is half the width of an interval; nan if undefined.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from drake_teleop.common.numeric import Array
from drake_teleop.lab.studies.design import Factor, Study
from drake_teleop.lab.studies.level_model import (
    CONFIDENCE_LEVEL,
    TOO_FEW_POINTS,
    BooleanArray,
    LevelModel,
    factor_levels,
    fit_level_model,
    largest_complete_block,
    missing_value_reasons,
)

if TYPE_CHECKING:
    import polars as pl


@dataclass(frozen=True, eq=False)
class FactorialModel:
    """Points of a factorial design at which a measure has values.

    Attributes:
        levels: for each factor, the level (n,) of each point.
        counts: number of levels of each factor.
        has_value: (n, seeds) True where a point has a value with a seed.
    """

    levels: list[NDArray[np.int64]]
    counts: list[int]
    has_value: BooleanArray

    def comparison_weights(self, *factors: int) -> tuple[BooleanArray, BooleanArray, Array]:
        """Return flags of comparable levels (or pairs) and of used combinations, and weights.

        Comparable levels have points at all used combinations of the other factors' levels. The
        weights (comparable levels, n) average over these points.
        """
        others = [factor for factor in range(len(self.counts)) if factor not in factors]
        row, rows = self._index_level_combinations(factors)
        column, columns = self._index_level_combinations(others)
        point = np.full((rows, columns), -1)
        point[row, column] = np.arange(len(row))
        is_compared, combinations = largest_complete_block(point >= 0)
        weights = np.zeros((int(is_compared.sum()), len(row)))
        points = point[is_compared][:, combinations]
        np.put_along_axis(weights, points, 1.0 / combinations.sum(), axis=1)
        return is_compared, combinations, weights

    def effects_and_half_widths(self, table: Array) -> tuple[list[Array], list[Array]]:
        means = [self.comparison_weights(factor)[2] for factor in range(len(self.counts))]
        found = [self.means(table, weights - weights.mean(axis=0)) for weights in means]
        return [effect for effect, _ in found], [half for _, half in found]

    def means(self, table: Array, weights: Array) -> tuple[Array, Array]:
        """Return the means `weights @ table` over seeds, and their half widths."""
        mean, half = means_and_half_widths_over_seeds(weights @ table)
        return mean, np.hypot(half, self._half_widths_due_to_missing_seeds(table, weights))

    def _index_level_combinations(self, factors: Sequence[int]) -> tuple[NDArray[np.int64], int]:
        place, count = np.zeros(len(self.has_value), dtype=np.int64), 1
        for factor in factors:
            place = place * self.counts[factor] + self.levels[factor]
            count *= self.counts[factor]
        return place, count

    def _half_widths_due_to_missing_seeds(self, table: Array, weights: Array) -> Array:
        points, seeds = table.shape
        runs = self.has_value.sum(axis=1)
        freedom = runs.sum() - points - seeds + 1
        if (runs == seeds).all():
            return np.zeros(len(weights))
        # Least squares for points and zero-sum seeds; points are eliminated (Schur complement).
        zero_sum = np.vstack([np.eye(seeds - 1), -np.ones((1, seeds - 1))])
        seen = self.has_value @ zero_sum
        left = (zero_sum.T * self.has_value.sum(axis=0)) @ zero_sum - (seen.T / runs) @ seen
        if freedom < 1 or np.linalg.matrix_rank(left) < seeds - 1:
            return np.where((weights[:, runs < seeds] != 0).any(axis=1), np.nan, 0.0)
        moved = (weights / runs) @ seen
        spread = weights**2 @ (1 / runs) + np.sum(moved @ np.linalg.inv(left) * moved, axis=1)
        # Subtract the variance that the intervals of the filled table already contain.
        spread -= weights**2 @ ((runs - 1) / (seeds * (seeds - 1)))
        residuals = table - table.mean(axis=1, keepdims=True) - table.mean(axis=0) + table.mean()
        variance = np.sum(residuals**2) / freedom
        quantile = stdtrit(freedom, 0.5 + CONFIDENCE_LEVEL / 2)
        return quantile * np.sqrt(variance * np.maximum(spread, 0.0))


def fill_missing_values(values: Array) -> Array:
    """Replace nan in values (n, seeds) by a least-squares point effect plus seed effect."""
    known = np.isfinite(values)
    if known.all():
        return values
    of_seed = np.zeros(values.shape[1])
    for _ in range(100):  # alternating least squares
        of_point = np.mean(values - of_seed, axis=1, where=known)
        of_seed = np.mean(values - of_point[:, None], axis=0, where=known)
    return np.where(known, values, of_point[:, None] + of_seed)


def means_and_half_widths_over_seeds(table: Array) -> tuple[Array, Array]:
    """Return means (n,) over the seeds of a table (n, seeds), and half widths; nan is ignored."""
    count = np.isfinite(table).sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.nansum(table, axis=1) / count
        spread = np.nansum((table - mean[:, None]) ** 2, axis=1) / (count - 1)
        quantile = stdtrit(np.maximum(count - 1, 1), 0.5 + CONFIDENCE_LEVEL / 2)
        half = quantile * np.sqrt(spread / count)
    return mean, np.where(count > 1, half, np.nan)


def effect_half_widths_over_seeds(table: Array) -> Array:
    """Return half widths (n,) of each level minus the mean level, from values (n, seeds)."""
    # Seeds without some level are excluded: they would shift all other levels.
    return means_and_half_widths_over_seeds(table - table.mean(axis=0))[1]


#: Measures of the Pareto front.
PARETO_MEASURES = ("effort_Ns", "task_time_s", "contact_force_overshoot_N")


@dataclass(frozen=True, eq=False)
class MainEffect:
    """Effect of one factor on a measure; nan at levels that are not comparable.

    Attributes:
        level_names: labels of the n levels, or of the n sections of a range.
        num_runs: (n,) number of runs with the measure.
        mean, half_width: (n,) mean over other factors and seeds, and its half width.
        effect, effect_half_width: (n,) difference from the mean of all levels, and its half width.
        missing_reasons: (n,) why a value is missing, else "".
        num_used_combinations, num_unused_combinations: combinations of the other factors.
        is_fitted: True if the values are from a `LevelModel`.
    """

    level_names: list[str]
    num_runs: NDArray[np.int64]
    mean: Array
    half_width: Array
    effect: Array
    effect_half_width: Array
    missing_reasons: list[str]
    num_used_combinations: int
    num_unused_combinations: int
    is_fitted: bool


@dataclass(frozen=True, eq=False)
class PairMeans:
    """Means of a measure over two factors with n and m levels.

    Attributes:
        mean: (n, m) means over other factors and seeds; nan if not comparable.
        missing_reasons: (n, m) why a value is missing, else "".
        num_used_combinations, num_unused_combinations, is_fitted: see `MainEffect`.
    """

    fields: tuple[str, str]
    level_names: tuple[list[str], list[str]]
    mean: Array
    missing_reasons: NDArray[Any]
    num_used_combinations: int
    num_unused_combinations: int
    is_fitted: bool


def main_effects_table(study: Study, rows: pl.DataFrame) -> pl.DataFrame:
    import polars as pl

    names = "measure factor level runs mean mean_half effect effect_half combinations left_out why"
    table = [
        {
            "measure": measure,
            "factor": field,
            "level": name,
            "runs": int(found.num_runs[index]),
            "mean": found.mean[index],
            "mean_half": found.half_width[index],
            "effect": found.effect[index],
            "effect_half": found.effect_half_width[index],
            "combinations": found.num_used_combinations,
            "left_out": found.num_unused_combinations,
            "why": found.missing_reasons[index] or None,
        }
        for measure in study.measures
        for field, found in main_effects(study, rows, measure).items()
        for index, name in enumerate(found.level_names)
    ]
    # All rows determine the types: the first reason may be in a late row.
    return pl.DataFrame(table, schema=names.split(), infer_schema_length=None)


def main_effects(study: Study, rows: pl.DataFrame, measure: str) -> dict[str, MainEffect]:
    data = _MeasureEffectModel(study, rows, measure)
    factors = [] if data.is_empty else data.factors
    return {factor.field: data.main_effect(k) for k, factor in enumerate(factors)}


def pair_means(study: Study, rows: pl.DataFrame, measure: str) -> list[PairMeans]:
    data = _MeasureEffectModel(study, rows, measure)
    pairs = itertools.combinations(range(len(data.factors)), 2)
    return [] if data.is_empty else [found for pair in pairs if (found := data.pair_means(*pair))]


class _MeasureEffectModel:
    def __init__(self, study: Study, rows: pl.DataFrame, measure: str) -> None:
        self.factors = varied_factors(study)
        values = values_by_seed(rows, measure)
        seen = np.isfinite(values)
        self.runs = seen.sum(axis=1)
        known = self.runs > 0
        self.is_empty = not known.any()
        if self.is_empty:
            return
        used = np.ix_(known, seen.any(axis=0))
        self.table = fill_missing_values(values[used])
        points = rows.unique("point", keep="first").sort("point")
        columns = [points[factor.field].to_list() for factor in self.factors]
        self.levels = [factor_levels(f, c) for f, c in zip(self.factors, columns, strict=True)]
        self.model: FactorialModel | LevelModel | None
        if study.design == "factorial":
            index = [levels.index[known] for levels in self.levels]
            counts = [len(levels.names) for levels in self.levels]
            self.model = FactorialModel(index, counts, seen[used])
        else:
            by_chance = study.design == "sobol"
            self.model = fit_level_model(self.factors, columns, known, by_chance=by_chance)
            self.levels = self.levels if self.model is None else self.model.factors

    def main_effect(self, factor: int) -> MainEffect:
        levels = self.levels[factor]
        count = len(levels.names)
        mean, half, effect, effect_half = figures = np.full((4, count), np.nan)
        is_compared, used = np.zeros(count, dtype=bool), np.zeros(1, dtype=bool)
        if self.model is not None:
            comparable, combinations, weights = self.model.comparison_weights(factor)
            if comparable.sum() > 1:
                is_compared, used = comparable, combinations
                effects, halves = self.model.effects_and_half_widths(self.table)
                found = [*self.model.means(self.table, weights), effects[factor], halves[factor]]
                figures[:, is_compared] = found
        runs = np.bincount(levels.index, self.runs, count).astype(np.int64)
        reasons_and_counts = self._reasons_and_counts(is_compared, levels.index, used, factor)
        return MainEffect(levels.names, runs, mean, half, effect, effect_half, *reasons_and_counts)

    def pair_means(self, first: int, second: int) -> PairMeans | None:
        if self.model is None or (isinstance(self.model, LevelModel) and not self.model.products):
            return None
        a, b = self.levels[first], self.levels[second]
        shape = len(a.names), len(b.names)
        is_compared, over, weights = self.model.comparison_weights(first, second)
        mean = np.full(len(is_compared), np.nan)
        mean[is_compared] = self.model.means(self.table, weights)[0]
        # The model also predicts cells without points; they are not shown.
        cell = a.index * shape[1] + b.index
        is_compared &= np.bincount(cell, self.runs, len(is_compared)) > 0
        mean[~is_compared] = np.nan
        why, used, unused, fitted = self._reasons_and_counts(is_compared, cell, over, first, second)
        fields, names = (self.factors[first].field, self.factors[second].field), (a.names, b.names)
        reasons = np.array(why).reshape(shape)
        return PairMeans(fields, names, mean.reshape(shape), reasons, used, unused, fitted)

    def _reasons_and_counts(
        self, compared: BooleanArray, cell: NDArray[np.int64], used: BooleanArray, *factors: int
    ) -> tuple[list[str], int, int, bool]:
        # The last four fields of `MainEffect`; `used` flags combinations.
        points, runs = (np.bincount(cell, each, len(compared)) for each in (None, self.runs))
        why = missing_value_reasons(compared, points, runs)
        why = [TOO_FEW_POINTS] * len(compared) if self.model is None else why
        total = math.prod(len(f.names) for k, f in enumerate(self.levels) if k not in factors)
        num_used = round(np.mean(used) * total)
        return why, num_used, total - num_used, not isinstance(self.model, FactorialModel)


def values_by_seed(rows: pl.DataFrame, measure: str, by: str = "point") -> Array:
    """Return the values (n, seeds) of a measure at the n sorted levels of the column `by`."""
    levels, level = np.unique(rows[by].to_numpy(), return_inverse=True)
    seeds, seed = np.unique(rows["seed"].to_numpy(), return_inverse=True)
    table = np.full((len(levels), len(seeds)), np.nan)
    table[level, seed] = measure_values(rows, measure)
    return table


def pareto_table(study: Study, rows: pl.DataFrame) -> pl.DataFrame | None:
    """Return means, half widths, "complete" and "front" by point; None without the measures."""
    import polars as pl

    if not set(PARETO_MEASURES) <= set(study.measures) or rows.is_empty():
        return None
    fields = [factor.field for factor in study.factors]
    points = rows.unique("point", keep="first").sort("point").select("point", *fields)
    tables = {name: values_by_seed(rows, name) for name in PARETO_MEASURES}
    complete = np.all(np.isfinite([*tables.values()]), axis=(0, 2))
    for name, table in tables.items():
        mean, half = means_and_half_widths_over_seeds(table)
        points = points.with_columns(pl.Series(name, mean), pl.Series(f"{name}_half", half))
    front = is_on_pareto_front(points.select(PARETO_MEASURES).to_numpy(), complete)
    return points.with_columns(pl.Series("complete", complete), pl.Series("front", front))


def is_on_pareto_front(values: Array, complete: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return flags (n,) of complete rows of `values` (minimised) that no complete row dominates."""
    found = complete.copy()
    other = values[complete]
    for index in np.flatnonzero(complete):
        dominated = np.all(other <= values[index], axis=1) & np.any(other < values[index], axis=1)
        found[index] = not dominated.any()
    return found


def varied_factors(study: Study) -> list[Factor]:
    return [factor for factor in study.factors if len(factor.level_values()) > 1]


def measure_values(rows: pl.DataFrame, measure: str) -> Array:
    """Return the values (N,) of a measure in all rows, nan where missing."""
    import polars as pl

    return rows[measure].cast(pl.Float64).fill_null(float("nan")).to_numpy()
