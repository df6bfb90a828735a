"""Effects from an unbalanced design by one regression with all factors (docs/studies.md).

Intervals assume that scrambled Sobol points are a random sample (Owen 1997).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from drake_teleop.common.numeric import Array
from drake_teleop.lab.studies.design import Factor, FactorValue

BooleanArray: TypeAlias = NDArray[np.bool_]

#: Reasons for a level or cell without value.
NO_RUN, NO_SUCCESS = "no run", "no successful run"
NOT_COMPARABLE = "not comparable with the others"
TOO_FEW_POINTS = "too few points"


def largest_complete_block(has_value: BooleanArray) -> tuple[BooleanArray, BooleanArray]:
    """Return flags of the rows and columns of a large block without missing values."""
    counts = has_value.sum(axis=0)
    patterns, times = np.unique(has_value[:, counts == counts.max()], axis=1, return_counts=True)
    rows = patterns[:, np.argmax(times)]
    return rows, np.logical_and.reduce(has_value[rows], axis=0)


def missing_value_reasons(
    compared: BooleanArray, points: NDArray[np.int64], successes: NDArray[np.int64]
) -> list[str]:
    """Return why each level or cell has no value; "" where `compared` is True.

    `points` and `successes`: numbers of points, and of runs with a value, at each level or cell.
    """
    why = np.where(points == 0, NO_RUN, np.where(successes == 0, NO_SUCCESS, NOT_COMPARABLE))
    return np.where(compared, "", why).tolist()


CONFIDENCE_LEVEL = 0.95
# Models: number of sections of a range, and whether products of pairs are terms. The first one that
# leaves half of the points for the residuals is used, or else the last feasible one.
_MODEL_FORMS_BY_PREFERENCE = [(num_sections, True) for num_sections in (5, 4, 3)]
_MODEL_FORMS_BY_PREFERENCE += [(num_sections, False) for num_sections in (5, 4, 3, 2)]
# Maximum number of combinations of levels of factors that are related to failures (40 MB).
_MAX_LEVEL_COMBINATIONS = 50_000


@dataclass(frozen=True, eq=False)
class Levels:
    """Levels of a factor at n points.

    Attributes:
        index: (n,) index in `names` of each point's level.
        names: labels of the levels with a point.
        within: (n,) position in the section of a range, -1/2 to 1/2; None for listed values.
        centred_columns: (n, k) regressors with mean 0: numbers, or indicators of other values.
        middle_columns: (levels, k) the same regressors at the middle of each level.
    """

    index: NDArray[np.int64]
    names: list[str]
    within: Array | None
    centred_columns: Array
    middle_columns: Array


def factor_levels(factor: Factor, column: Sequence[FactorValue], num_sections: int = 5) -> Levels:
    """Return the levels of a factor's values (n,); a range is cut into equal sections."""
    listed = factor.level_values()
    places = np.array([factor.coordinates(value) for value in column])
    if factor.low is not None and factor.high is not None and any(v not in listed for v in column):
        share = places[:, 0]
        index = np.minimum((share * num_sections).astype(np.int64), num_sections - 1)
        within = share * num_sections - index - 0.5
        present, index = np.unique(index, return_inverse=True)
        middles = (present[:, None] + 0.5) / num_sections
        names = [f"{factor.low + m * (factor.high - factor.low):.3g}" for m in middles[:, 0]]
        return Levels(index, names, within, places - 0.5, middles - 0.5)
    present, index = np.unique([listed.index(v) for v in column], return_inverse=True)
    middles = np.array([factor.coordinates(value) for value in listed])
    # The last indicator column depends on the others.
    middles = middles[:, : max(middles.shape[1] - 1, 1)]
    middles = (middles - middles.mean(axis=0))[present]
    values = [listed[k] for k in present]
    names = [f"{value:g}" if isinstance(value, float) else str(value) for value in values]
    names = names if len(set(names)) == len(names) else list(map(str, values))
    return Levels(index, names, None, middles[index], middles)


@dataclass(frozen=True, eq=False)
class LevelModel:
    """Linear regression of a measure on the levels of all factors.

    Attributes:
        codes: for each factor, the values (levels, k) of its k columns of X at its levels.
        products: columns of X for the interaction of factors (i, j).
        excluded_cells: (levels of i, levels of j) flags of unused cells by factors (i, j), i <= j.
        X: (n, p) design matrix; first column: the mean.
        pseudo_inverse: (p, n) pseudo-inverse of X.
    """

    factors: list[Levels]
    codes: list[Array]
    products: dict[tuple[int, int], slice]
    excluded_cells: dict[tuple[int, int], BooleanArray]
    X: Array
    pseudo_inverse: Array

    def comparison_weights(self, *factors: int) -> tuple[BooleanArray, BooleanArray, Array]:
        """Return flags of comparable levels and used combinations, and weights of coefficients."""
        others = sorted(set(itertools.chain(*self.excluded_cells)) - set(factors))
        related = [*factors, *others]
        shape = [len(self.factors[factor].names) for factor in related]
        at = dict(zip(related, np.indices(shape).reshape(len(shape), -1), strict=True))
        there = np.ones(math.prod(shape), dtype=bool)
        for (i, j), excluded in self.excluded_cells.items():
            there &= ~excluded[at[i], at[j]]
        count = math.prod(shape[: len(factors)])
        rows, columns = largest_complete_block(there.reshape(count, -1))
        terms = self._regressor_rows_of_levels(at).reshape(count, -1, self.X.shape[1])
        return rows, columns, terms[rows][:, columns].mean(axis=1)

    def effects_and_half_widths(self, table: Array) -> tuple[list[Array], list[Array]]:
        """Return the effects of each factor and half widths of joint intervals (Bonferroni).

        `table` (points, seeds) contains the measure.
        """
        means = [self.comparison_weights(factor)[2] for factor in range(len(self.factors))]
        # Two levels have one effect with two signs.
        num_effects = max(sum(1 if len(terms) == 2 else len(terms) for terms in means), 1)
        coefficients = self.pseudo_inverse @ table.mean(axis=1)
        design = self._half_width_over_points(table, num_effects)
        effects, halves = [], []
        for terms in means:
            terms = terms - terms.sum(axis=0) / max(len(terms), 1)
            effects.append(terms @ coefficients)
            over_points = design * self._relative_std_of_means(terms)
            halves.append(np.hypot(over_points, self._effects_half_width_over_seeds(table, terms)))
        return effects, halves

    def means(self, table: Array, weights: Array) -> tuple[Array, Array]:
        seeds = table.shape[1]
        each = weights @ self.pseudo_inverse @ table
        if seeds == 1:
            return each[:, 0], np.full(len(each), np.nan)
        over_seeds = _student_quantile(1, seeds - 1) * each.std(axis=1, ddof=1) / np.sqrt(seeds)
        over_points = self._half_width_over_points(table, 1) * self._relative_std_of_means(weights)
        return each.mean(axis=1), np.hypot(over_points, over_seeds)

    def _regressor_rows_of_levels(self, level_indices: dict[int, NDArray[np.int64]]) -> Array:
        count = len(next(iter(level_indices.values())))
        terms, first = np.zeros((count, self.X.shape[1])), 1
        terms[:, 0] = 1.0
        for factor, codes in enumerate(self.codes):
            if factor in level_indices:
                terms[:, first : first + codes.shape[1]] = codes[level_indices[factor]]
            first += codes.shape[1]
        for (i, j), columns in self.products.items():
            if i in level_indices and j in level_indices:
                a, b = (self.factors[k].middle_columns[level_indices[k]] for k in (i, j))
                terms[:, columns] = _pair_products(a, b)
        return terms

    @property
    def _degrees_of_freedom(self) -> int:
        return self.X.shape[0] - self.X.shape[1]

    def _residual_variance(self, table: Array, num_columns: int) -> float:
        residuals = table - self.X @ (self.pseudo_inverse @ table)
        # Lower bound by rounding errors for exact fits.
        least = (1e-10 * np.abs(table).max()) ** 2
        return max(float(np.sum(residuals**2)) / (num_columns * self._degrees_of_freedom), least)

    def _relative_std_of_means(self, weights: Array) -> Array:
        return np.linalg.norm(weights @ self.pseudo_inverse, axis=1)

    def _half_width_over_points(self, table: Array, num_intervals: int) -> float:
        variance = self._residual_variance(table.mean(axis=1, keepdims=True), 1)
        return _student_quantile(num_intervals, self._degrees_of_freedom) * float(np.sqrt(variance))

    def _effects_half_width_over_seeds(self, table: Array, effect_rows: Array) -> float:
        seeds = table.shape[1]
        if seeds == 1:
            return 0.0
        apart = table - table.mean(axis=1, keepdims=True)
        moved = np.sum((effect_rows @ self.pseudo_inverse @ apart) ** 2) / (seeds - 1)
        relative_variance = np.sum(self._relative_std_of_means(effect_rows) ** 2)
        noise = self._residual_variance(apart, seeds - 1) * relative_variance
        deviation = np.sqrt(max(moved - noise, 0.0) / len(effect_rows) / seeds)
        return _student_quantile(len(self.factors), seeds - 1) * float(deviation)


def fit_level_model(
    factors: Sequence[Factor],
    columns: Sequence[Sequence[FactorValue]],
    known: BooleanArray | None = None,
    *,
    by_chance: bool = True,
) -> LevelModel | None:
    """Return a regression model with as many terms as the points determine, or None.

    `columns` contains the n values of each factor; `known` (n,) flags points with a value. Without
    `by_chance`, combinations without points are excluded as failures.
    """
    found, known = None, np.ones(len(columns[0]), bool) if known is None else known
    for num_sections, products in _MODEL_FORMS_BY_PREFERENCE:
        levels = [factor_levels(f, c, num_sections) for f, c in zip(factors, columns, strict=True)]
        model = _build_level_model(levels, products, known, by_chance)
        if model is not None:
            found = model
            if model.X.shape[1] <= len(model.X) / 2:
                break
    return found


def _build_level_model(
    factors: list[Levels], products: bool, known: BooleanArray, by_chance: bool
) -> LevelModel | None:
    points = int(known.sum())
    failed = _excluded_level_cells_by_factor_pair(factors, known, by_chance)
    codes = [_effect_codes(len(levels.names), np.unique(levels.index[known])) for levels in factors]
    columns = [np.ones((points, 1))]
    columns += [code[f.index[known]] for f, code in zip(factors, codes, strict=True)]
    columns += [f.within[known, None] for f in factors if f.within is not None]
    places, first = {}, sum(column.shape[1] for column in columns)
    for i, j in itertools.combinations(range(len(factors)), 2) if products else ():
        pair = _pair_products(factors[i].centred_columns[known], factors[j].centred_columns[known])
        places[i, j] = slice(first, first := first + pair.shape[1])
        columns.append(pair)
    X = np.hstack(columns)
    counts = sorted(len(levels.names) for levels in factors)
    involved = [len(factors[k].names) for k in set(itertools.chain(*failed))] + counts[-2:]
    if X.shape[1] >= points or math.prod(involved) > _MAX_LEVEL_COMBINATIONS:
        return None
    u, size, v = np.linalg.svd(X, full_matrices=False)
    if size[-1] < 1e-6 * size[0]:
        return None
    return LevelModel(factors, codes, places, failed, X, v.T / size @ u.T)


def _excluded_level_cells_by_factor_pair(
    factors: list[Levels], has_value: BooleanArray, missing_by_chance: bool
) -> dict[tuple[int, int], BooleanArray]:
    excluded = {}
    for i, j in itertools.combinations_with_replacement(range(len(factors)), 2):
        a, b = factors[i], factors[j]
        tried, good = np.zeros((2, len(a.names), len(b.names)))
        np.add.at(tried, (a.index, b.index), 1.0)
        np.add.at(good, (a.index[has_value], b.index[has_value]), 1.0)
        failed = good == 0
        if missing_by_chance:
            share = good / np.maximum(tried, 1.0)
            best = np.minimum(share.max(axis=1, keepdims=True), share.max(axis=0))
            failed = (tried > 0) & (failed | (share < best / 2))
        if failed.any():
            excluded[i, j] = failed
    return excluded


def _pair_products(a: Array, b: Array) -> Array:
    return np.einsum("ni,nj->nij", a, b).reshape(len(a), -1)


def _effect_codes(num_levels: int, used: NDArray[np.int64]) -> Array:
    codes = np.zeros((num_levels, len(used) - 1))
    codes[used[:-1]], codes[used[-1]] = np.eye(len(used) - 1), -1.0
    return codes


def _student_quantile(num_intervals: int, degrees_of_freedom: int) -> float:
    return float(stdtrit(degrees_of_freedom, 1 - (1 - CONFIDENCE_LEVEL) / 2 / num_intervals))
