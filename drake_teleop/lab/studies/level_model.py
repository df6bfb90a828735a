"""Effects of factors from a design that is not balanced: a regression with all factors at once.

Cells of a Sobol or an adaptive design differ in the other factors too, so that plain means over
them show effects that there are not. Here each measure is regressed on

* one term for each level of each factor (a range is cut into equal parts), zero in sum;
* of each range its place within the part, which is zero in the mean over a part;
* the product of each pair of factors, zero in the mean over either, if there are points enough.

The last two do not change what the first ones mean, a level's mean over everything else; they take
out of the residuals what is known. What is left is how far the points of the design happen to be
from that mean, and the noise: both are in the residuals, and so in the intervals. Added is what
seeds do to the effects beyond that noise. The points have to be as good as drawn by chance, as
scrambled Sobol points are (Owen 1997, "Scrambled net variance for integrals of smooth functions").

Where runs fail a regression has nothing to hold on to, and would go on beyond. So nothing is
averaged over those cells of two factors in which all points failed, or of which less than half as
large a share came out well as of others at the same levels, because the edge runs through them; see
`cells.py`. A cell in which no point lies by chance counts; in an adaptive design, whose points lie
where they do for a reason, it does not.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from drake_teleop.lab.studies.cells import Flags, comparable
from drake_teleop.lab.studies.design import Factor, Value

Array = NDArray[np.float64]

CONFIDENCE = 0.95
# Equal parts of a range and whether products of pairs are in the model: what leaves half of the
# points for the residuals is taken, or else the last.
_LADDER = (*((parts, True) for parts in (5, 4, 3)), *((parts, False) for parts in (5, 4, 3, 2)))
# Combinations of levels, of the factors that have something to do with failures: 40 MB.
_COMBINATIONS = 50_000


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
        factors: the levels of each, at all points.
        codes: of each, (levels, k) its terms' columns; zero at a level without a value.
        products: (i, j) of each pair of factors, its columns; empty if it has none.
        failed: (i, j) of some pairs: (levels, levels) which cells to leave out; (i, i): levels.
        X: (n, p) all columns, the mean first, at the points that have a value.
        solve: (p, n) from values at these points to the columns' coefficients.
    """

    factors: list[Levels]
    codes: list[Array]
    products: dict[tuple[int, int], slice]
    failed: dict[tuple[int, int], Flags]
    X: Array
    solve: Array

    def compared(self, *shown: int) -> tuple[Flags, Flags, Array]:
        """What is comparable of the levels of a factor, or of the cells of two.

        Returns:
            (rows,) which levels or cells, (columns,) over which combinations of the levels of those
            other factors that have something to do with failures, see `comparable`; (kept rows, p)
            from the coefficients to the mean over these.
        """
        others = sorted(set(itertools.chain(*self.failed)) - set(shown))
        factors = [*shown, *others]
        shape = [len(self.factors[factor].names) for factor in factors]
        at = dict(zip(factors, np.indices(shape).reshape(len(shape), -1), strict=True))
        there = np.ones(math.prod(shape), dtype=bool)
        for (i, j), failed in self.failed.items():
            there &= ~failed[at[i], at[j]]
        count = math.prod(shape[: len(shown)])
        rows, columns = comparable(there.reshape(count, -1))
        terms = self._terms(at).reshape(count, -1, self.X.shape[1])
        return rows, columns, terms[rows][:, columns].mean(axis=1)

    def effects(self, table: Array) -> tuple[list[Array], list[Array]]:
        """Of each factor, (kept levels,) the effects and half the widths of their intervals.

        The intervals hold all effects of all factors together, with `CONFIDENCE` (Bonferroni).

        Args:
            table: (n, seeds) of values, none missing.
        """
        means = [self.compared(factor)[2] for factor in range(len(self.factors))]
        # Two levels have one effect, with two signs.
        all_of_them = max(sum(1 if len(terms) == 2 else len(terms) for terms in means), 1)
        coefficients, design = self.solve @ table.mean(axis=1), self._design(table, all_of_them)
        effects, halves = [], []
        for terms in means:
            terms = terms - terms.sum(axis=0) / max(len(terms), 1)
            effects.append(terms @ coefficients)
            halves.append(np.hypot(design * self._spread(terms), self._seeds(table, terms)))
        return effects, halves

    def means(self, table: Array, terms: Array) -> tuple[Array, Array]:
        """(kept levels,) the mean at each level, and half the width of its interval over seeds."""
        seeds = table.shape[1]
        each = terms @ self.solve @ table
        if seeds == 1:
            return each[:, 0], np.full(len(each), np.nan)
        over_seeds = _quantile(1, seeds - 1) * each.std(axis=1, ddof=1) / np.sqrt(seeds)
        return each.mean(axis=1), np.hypot(self._design(table, 1) * self._spread(terms), over_seeds)

    def _terms(self, at: dict[int, NDArray[np.int64]]) -> Array:
        """(N, p) from the coefficients to the means in cells.

        Args:
            at: (N,) the levels of some factors; each mean is over all others.
        """
        count = len(next(iter(at.values())))
        terms, first = np.zeros((count, self.X.shape[1])), 1
        terms[:, 0] = 1.0
        for factor, codes in enumerate(self.codes):
            if factor in at:
                terms[:, first : first + codes.shape[1]] = codes[at[factor]]
            first += codes.shape[1]
        for (i, j), columns in self.products.items():
            if i in at and j in at:
                a, b = self.factors[i].middles[at[i]], self.factors[j].middles[at[j]]
                terms[:, columns] = _products(a, b)
        return terms

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


def level_model(
    factors: Sequence[Factor],
    columns: Sequence[Sequence[Value]],
    known: Flags | None = None,
    *,
    by_chance: bool = True,
) -> LevelModel | None:
    """The richest model for these points, or None if they cannot tell the factors apart.

    Args:
        factors: those that are varied.
        columns: of each, (n,) its values at the points.
        known: (n,) which points have a value; all, if left out.
        by_chance: whether cells without a point are so by chance.
    """
    found, known = None, np.ones(len(columns[0]), bool) if known is None else known
    for parts, products in _LADDER:
        levels = [levels_of(f, c, parts) for f, c in zip(factors, columns, strict=True)]
        model = _model(levels, products, known, by_chance)
        if model is not None:
            found = model
            if model.X.shape[1] <= len(model.X) / 2:
                break
    return found


def _model(
    factors: list[Levels], products: bool, known: Flags, by_chance: bool
) -> LevelModel | None:
    """The model with these terms; None if its coefficients do not follow from the points."""
    points = int(known.sum())
    failed = _failed(factors, known, by_chance)
    codes = [_codes(len(levels.names), np.unique(levels.index[known])) for levels in factors]
    columns = [np.ones((points, 1))]
    columns += [code[f.index[known]] for f, code in zip(factors, codes, strict=True)]
    columns += [f.within[known, None] for f in factors if f.within is not None]
    places, first = {}, sum(column.shape[1] for column in columns)
    for i, j in itertools.combinations(range(len(factors)), 2) if products else ():
        pair = _products(factors[i].centred[known], factors[j].centred[known])
        places[i, j] = slice(first, first := first + pair.shape[1])
        columns.append(pair)
    X = np.hstack(columns)
    counts = sorted(len(levels.names) for levels in factors)
    involved = [len(factors[k].names) for k in set(itertools.chain(*failed))] + counts[-2:]
    if X.shape[1] >= points or math.prod(involved) > _COMBINATIONS:
        return None
    u, size, v = np.linalg.svd(X, full_matrices=False)
    if size[-1] < 1e-6 * size[0]:
        return None
    return LevelModel(factors, codes, places, failed, X, v.T / size @ u.T)


def _failed(factors: list[Levels], known: Flags, by_chance: bool) -> dict[tuple[int, int], Flags]:
    """Of pairs of factors, the cells to leave out, see above; of (i, i), the levels."""
    found = {}
    for i, j in itertools.combinations_with_replacement(range(len(factors)), 2):
        a, b = factors[i], factors[j]
        tried, good = np.zeros((2, len(a.names), len(b.names)))
        np.add.at(tried, (a.index, b.index), 1.0)
        np.add.at(good, (a.index[known], b.index[known]), 1.0)
        failed = good == 0
        if by_chance:
            share = good / np.maximum(tried, 1.0)
            best = np.minimum(share.max(axis=1, keepdims=True), share.max(axis=0))
            failed = (tried > 0) & (failed | (share < best / 2))
        if failed.any():
            found[i, j] = failed
    return found


def _products(a: Array, b: Array) -> Array:
    """(n, j k) of (n, j) and (n, k)."""
    return np.einsum("ni,nj->nij", a, b).reshape(len(a), -1)


def _codes(count: int, present: NDArray[np.int64]) -> Array:
    """(count, k - 1) a column for each of the k present levels but the last: minus their sum."""
    codes = np.zeros((count, len(present) - 1))
    codes[present[:-1]], codes[present[-1]] = np.eye(len(present) - 1), -1.0
    return codes


def _quantile(together: int, freedom: int) -> float:
    """Student's, if so many intervals hold together with `CONFIDENCE`."""
    return float(stdtrit(freedom, 1 - (1 - CONFIDENCE) / 2 / together))


def _name(value: Value) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)
