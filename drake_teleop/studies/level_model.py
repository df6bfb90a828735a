"""Effects of factors from a design that is not balanced: a regression with all factors at once.

Cells of a Sobol or an adaptive design, or of a factorial one in which points failed, differ in the
other factors too, so that plain means over them show effects that there are not. Here each measure
is regressed on

* one term for each level of each factor (a range is cut into equal parts), zero in sum;
* of each range its place within the part, which is zero in the mean over a part;
* the product of each pair of factors, zero in the mean over either, if there are points enough.

The last two do not change what the first ones mean, a level's mean over everything else; they take
out of the residuals what is known. What is left is how far the points of the design happen to be
from that mean, and the noise: both are in the residuals, and so in the intervals. Added is what
seeds do to the effects beyond that noise. The points have to be as good as drawn by chance, as
scrambled Sobol points are (Owen 1997, "Scrambled net variance for integrals of smooth functions").
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from drake_teleop.studies.design import Factor, Value

Array = NDArray[np.float64]

CONFIDENCE = 0.95
# Equal parts of a range and whether products of pairs are in the model: what leaves half of the
# points for the residuals is taken, or else the last.
_LADDER = (*((parts, True) for parts in (5, 4, 3)), *((parts, False) for parts in (5, 4, 3, 2)))


@dataclass(frozen=True, eq=False)
class Levels:
    """A factor's levels at some points.

    Attributes:
        index: (n,) the level of each point.
        names: of the levels that have a point.
        within: (n,) the place in its part of a range, from -1/2 to 1/2; None of a list.
        centred: (n, k) numbers by their size, or else a column for each word but one; zero in the
            mean over range or list.
        middles: (levels, k) the same in the middle of each level.
    """

    index: NDArray[np.int64]
    names: list[str]
    within: Array | None
    centred: Array
    middles: Array


def levels_of(factor: Factor, column: Sequence[Value], parts: int = 5) -> Levels:
    """The levels of points; a range with values anywhere is cut into parts, named by their middles.

    Args:
        factor: with all that it varies over.
        column: (n,) its values at the points.
        parts: of a range.
    """
    listed = factor.listed()
    places = np.array([factor.coordinates(value) for value in column])
    if factor.low is not None and factor.high is not None and any(v not in listed for v in column):
        share = places[:, 0]
        index = np.minimum((share * parts).astype(np.int64), parts - 1)
        within = share * parts - index - 0.5
        present, index = np.unique(index, return_inverse=True)
        middles = (present[:, None] + 0.5) / parts
        names = [f"{factor.low + m * (factor.high - factor.low):.3g}" for m in middles[:, 0]]
        return Levels(index, names, within, places - 0.5, middles - 0.5)
    present, index = np.unique([listed.index(v) for v in column], return_inverse=True)
    middles = np.array([factor.coordinates(value) for value in listed])
    # Of words one column follows from the others.
    middles = middles[:, : max(middles.shape[1] - 1, 1)]
    middles = (middles - middles.mean(axis=0))[present]
    names = [_name(listed[k]) for k in present]
    return Levels(index, names, None, middles[index], middles)


@dataclass(frozen=True, eq=False)
class LevelModel:
    """A regression of measures at the points of a design.

    Attributes:
        factors: the levels of each.
        products: (i, j) of each pair of factors, its columns; empty if it has none.
        X: (n, p) all columns, the mean first.
        solve: (p, n) from values at the points to the columns' coefficients.
    """

    factors: list[Levels]
    products: dict[tuple[int, int], slice]
    X: Array
    solve: Array

    def terms(self, factor: int) -> Array:
        """(levels, p) from the coefficients to the effect of each level."""
        first = 1 + sum(len(levels.names) - 1 for levels in self.factors[:factor])
        codes = _codes(len(self.factors[factor].names))
        terms = np.zeros((len(codes), self.X.shape[1]))
        terms[:, first : first + codes.shape[1]] = codes
        return terms

    def effects(self, table: Array) -> tuple[list[Array], list[Array]]:
        """Of each factor, (levels,) the effects and half the widths of their intervals.

        The intervals hold all effects of all factors together, with `CONFIDENCE` (Bonferroni).

        Args:
            table: (n, seeds) of values, none missing.
        """
        counts = [len(levels.names) for levels in self.factors]
        # Two levels have one effect, with two signs.
        all_of_them = sum(1 if count == 2 else count for count in counts)
        coefficients, design = self.solve @ table.mean(axis=1), self._design(table, all_of_them)
        effects, halves = [], []
        for factor in range(len(counts)):
            terms = self.terms(factor)
            effects.append(terms @ coefficients)
            halves.append(np.hypot(design * self._spread(terms), self._seeds(table, terms)))
        return effects, halves

    def means(self, table: Array, factor: int) -> tuple[Array, Array]:
        """(levels,) the mean at each level, and half the width of its own interval over seeds."""
        terms, seeds = self.terms(factor), table.shape[1]
        terms[:, 0] = 1.0
        each = terms @ self.solve @ table
        if seeds == 1:
            return each[:, 0], np.full(len(each), np.nan)
        over_seeds = _quantile(1, seeds - 1) * each.std(axis=1, ddof=1) / np.sqrt(seeds)
        return each.mean(axis=1), np.hypot(self._design(table, 1) * self._spread(terms), over_seeds)

    def cells(self, table: Array, first: int, second: int) -> Array:
        """(levels of the first, of the second) the means over all other factors.

        The first one stands before the second one among the factors.
        """
        coefficients = self.solve @ table.mean(axis=1)
        a, b = (self.terms(factor) @ coefficients for factor in (first, second))
        middles = (self.factors[factor].middles for factor in (first, second))
        together = np.einsum("ik,jl->ijkl", *middles).reshape(len(a), len(b), -1)
        product: Array = together @ coefficients[self.products[first, second]]
        return coefficients[0] + a[:, None] + b + product

    @property
    def _freedom(self) -> int:
        """Degrees of freedom of the residuals."""
        return self.X.shape[0] - self.X.shape[1]

    def _variance(self, table: Array, columns: int) -> float:
        """Of the residuals of a table with so many independent columns."""
        residuals = table - self.X @ (self.solve @ table)
        # What follows from the factors to the last digit is known to some digits less.
        least = (1e-10 * np.abs(table).max()) ** 2
        return max(float(np.sum(residuals**2)) / (columns * self._freedom), least)

    def _spread(self, terms: Array) -> Array:
        """(k,) the standard deviations of such terms, for residuals of variance 1."""
        return np.linalg.norm(terms @ self.solve, axis=1)

    def _design(self, table: Array, together: int) -> float:
        """Half the width for the design, by spread, if so many intervals hold together."""
        variance = self._variance(table.mean(axis=1, keepdims=True), 1)
        return _quantile(together, self._freedom) * float(np.sqrt(variance))

    def _seeds(self, table: Array, terms: Array) -> float:
        """Half the width for what seeds do to a factor's effects, beyond the residuals' noise."""
        seeds = table.shape[1]
        if seeds == 1:
            return 0.0
        apart = table - table.mean(axis=1, keepdims=True)
        moved = np.sum((terms @ self.solve @ apart) ** 2) / (seeds - 1)
        noise = self._variance(apart, seeds - 1) * np.sum(self._spread(terms) ** 2)
        deviation = np.sqrt(max(moved - noise, 0.0) / len(terms) / seeds)
        return _quantile(len(self.factors), seeds - 1) * float(deviation)


def level_model(factors: Sequence[Factor], columns: Sequence[Sequence[Value]]) -> LevelModel | None:
    """The richest model for these points, or None if they cannot tell the factors apart.

    Args:
        factors: those that are varied.
        columns: of each, (n,) its values at the points.
    """
    found = None
    for parts, products in _LADDER:
        levels = [levels_of(f, c, parts) for f, c in zip(factors, columns, strict=True)]
        model = _model(levels, products)
        if model is not None:
            found = model
            if model.X.shape[1] <= len(model.X) / 2:
                break
    return found


def _model(factors: list[Levels], products: bool) -> LevelModel | None:
    """The model with these terms; None if its coefficients do not follow from the points."""
    points = len(factors[0].index)
    columns = [np.ones((points, 1)), *(_codes(len(f.names))[f.index] for f in factors)]
    columns += [levels.within[:, None] for levels in factors if levels.within is not None]
    pairs = itertools.combinations(range(len(factors)), 2) if products else ()
    places, first = {}, sum(column.shape[1] for column in columns)
    for i, j in pairs:
        pair = np.einsum("ni,nj->nij", factors[i].centred, factors[j].centred).reshape(points, -1)
        places[i, j] = slice(first, first := first + pair.shape[1])
        columns.append(pair)
    X = np.hstack(columns)
    if X.shape[1] >= points:
        return None
    u, size, v = np.linalg.svd(X, full_matrices=False)
    return None if size[-1] < 1e-6 * size[0] else LevelModel(factors, places, X, v.T / size @ u.T)


def _codes(count: int) -> Array:
    """(count, count - 1) a column for each level but the last, which is minus their sum."""
    return np.vstack([np.eye(count - 1), -np.ones((1, count - 1))])


def _quantile(together: int, freedom: int) -> float:
    """Student's, if so many intervals hold together with `CONFIDENCE`."""
    return float(stdtrit(freedom, 1 - (1 - CONFIDENCE) / 2 / together))


def _name(value: Value) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)
