"""Does the load change within a record? The instants, and the load of each part.

Samples are averaged over `change.BLOCK` seconds, because noise of the motion would bias least
squares otherwise. A record is cut into at most `_BLOCKS` blocks. A part (i, j) of it costs what
least squares with its own offsets and load leaves of its whitened wrench, from sums that are
differences of cumulative ones. The division whose parts cost least in total, if every further part
has to save 1 % of what a single load costs, follows by dynamic programming (Jackson et al.
2005, "optimal partitioning"). The noise is the median of those of short windows, which a change or
a contact spoils in a few of them only.

Contact makes parts too, and so do vibration and drift. A change of load is reported between two
parts only if

- each is explained by a load of its own, down to twice the noise, without its first and last block,
- the mass is identifiable in both, and differs by more than 5 % and by more than six standard
  deviations, coloured noise included,
- the offsets do not differ by as much of the weight: a constant push is no load,
- the difference can be a body (`gripper.consistency_margin`): a push along gravity has no inertia.

Of two parts that differ otherwise, the shorter is left out.

Smaller changes, and loads that were there for less than about a twentieth of the record, are not
seen. `drake_teleop.load.online.change` does it online, from a load that is known.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_teleop.load.arrays import Array, checked_rows, positive
from drake_teleop.load.batch.moments import Moments, normal_equations, residual_covariance
from drake_teleop.load.gripper import SIGNIFICANT, consistency_margin, identified_object
from drake_teleop.load.identification import WORTH_STATING, Identification, natural_scale
from drake_teleop.load.normal_equations import NormalEquations
from drake_teleop.load.online.change import BLOCK
from drake_teleop.load.regressor import non_contact_wrench

# Blocks at most, least samples of a block, least blocks of a part, and of a window for the noise.
_BLOCKS, _FEWEST, _SHORTEST, _NOISE_WINDOW = 60, 8, 3, 6
# What a further part has to save: a share of a single load's cost, and more than of noise (16).
_PENALTY, _LEAST_PENALTY = 0.01, 100.0
# Noise over wrench that averaging makes; directions of the scaled Gram that are not determined.
_ROUNDING, _RANK = 1e-4, 1e-12
# Residual over noise up to which a load explains a part; standard deviations of a difference.
_EXPLAINED, _SIGNIFICANT = 2.0, 6.0
# In [offsets; phi].
_OFFSETS, _MASS = slice(0, 6), slice(6, 7)


@dataclass(frozen=True, eq=False)
class Segment:
    """A part of a record during which the load is one and the same.

    Attributes:
        start, stop: its samples, as of a slice.
        load: what was identified from it.
    """

    start: int
    stop: int
    load: Identification


def segments(
    wrench: ArrayLike, s: ArrayLike, omega: ArrayLike, alpha: ArrayLike, period: float
) -> list[Segment]:
    """The parts of a record with a load each; none if one load does for all of it.

    Args:
        wrench: (N, 6) measured [f; tau] in S about So, sign of Eq. (1), in the order of time
            [N, N m].
        s, omega, alpha: (N, 3) motion of S in S, as for `regressor`.
        period: between samples [s].

    Returns:
        two or more parts in the order of time, or an empty list. What belongs to none of them
        (contact between two loads) is left out.

    Raises:
        DrakeTeleopError: for arrays of another shape or with numbers that are not finite.
    """
    _, rows = checked_rows(wrench=(wrench, 6), s=(s, 3), omega=(omega, 3), alpha=(alpha, 3))
    each = max(1, round(BLOCK / float(positive("period", period))))
    n = len(rows[0]) // each
    if n == 0:
        return []
    rows = [table[: n * each].reshape(n, each, -1).mean(axis=1) for table in rows]
    length = max(_FEWEST, -(-n // _BLOCKS))
    edges = np.append(np.arange(0, n - length + 1, length), n)
    if len(edges) <= 2 * _SHORTEST:
        return []
    sums = _block_sums(rows, edges)
    noise = _noise(sums, rows[0])
    parts = [_identified(rows, noise, edges[i : j + 1]) for i, j in _cheapest_parts(sums, noise)]
    loads: list[Segment] = []
    for part in parts:
        if part is None:
            continue
        if loads and not _is_object(loads[-1].load, part.load):
            last = loads.pop()
            # Of the same load twice, or of a load and a contact, the longer record is believed.
            longer = max(last, part, key=lambda x: x.stop - x.start)
            if not _differ(last.load, part.load, slice(0, 7)):
                longer = Segment(last.start, part.stop, longer.load)
            part = longer
        loads.append(part)
    if len(loads) < 2:
        return []
    return [
        Segment(part.start * each, part.stop * each, part.load)
        for part in _sharpened(rows, noise, loads)
    ]


def _block_sums(rows: list[Array], edges: NDArray[np.int_]) -> Array:
    """(B + 1, 19, 19) cumulative sums of z z^T at the edges of blocks."""
    sums = np.zeros((len(edges), 19, 19))
    for k, (start, stop) in enumerate(pairwise(edges)):
        moments = Moments()
        moments.add(*(table[start:stop] for table in rows))
        sums[k + 1] = sums[k] + moments.mean * moments.samples
    return sums


def _noise(sums: Array, wrench: Array) -> Array:
    """(6,) median over short windows of what a load of their own leaves [N, N m]."""
    found = []
    for i in range(0, len(sums) - _NOISE_WINDOW, _NOISE_WINDOW // 2):
        Z = sums[i + _NOISE_WINDOW] - sums[i]
        Z = Z / Z[0, 0]
        # The plain fit first, then weighted by what it left.
        std = np.sqrt(np.mean(wrench**2, axis=0))
        floor = _ROUNDING * np.repeat([np.linalg.norm(std[:3]), np.linalg.norm(std[3:])], 3)
        floor = np.where(floor > 0.0, floor, 1.0)
        std = np.maximum(std, floor)  # a channel may say nothing at all
        for _ in range(2):
            theta = _fit(*normal_equations(Z, np.diag(std**-2.0)))
            left = np.diag(residual_covariance(Z, theta))
            std = np.sqrt(np.maximum(left, floor**2))
        found.append(std)
    return np.median(found, axis=0)


def _fit(gram: Array, right: Array) -> Array:
    """(..., 16) least squares of minimum norm, columns scaled; gram (..., 16, 16)."""
    scale = np.sqrt(np.diagonal(gram, axis1=-2, axis2=-1))
    scale = np.divide(1.0, scale, out=np.zeros_like(scale), where=scale > 0.0)
    values, vectors = np.linalg.eigh(gram * scale[..., :, None] * scale[..., None, :])
    kept = values > _RANK * values[..., -1:]
    inverse = np.divide(1.0, values, out=np.zeros_like(values), where=kept)
    along = np.einsum("...ji,...j->...i", vectors, scale * right) * inverse
    return scale * np.einsum("...ij,...j->...i", vectors, along)


def _cheapest_parts(sums: Array, noise: Array) -> list[tuple[int, int]]:
    """The blocks [i, j) of the parts of the division that costs least."""
    W, B = np.diag(noise**-2.0), len(sums) - 1
    pairs = [normal_equations(Z, W) for Z in sums]
    grams, rights = np.array([p[0] for p in pairs]), np.array([p[1] for p in pairs])
    squares = np.array([np.diag(Z)[1:7] @ np.diag(W) for Z in sums])
    i, j = np.triu_indices(B + 1, _SHORTEST)
    theta = _fit(grams[j] - grams[i], rights[j] - rights[i])
    cost = np.full((B + 1, B + 1), np.inf)
    explained = np.einsum("pi,pi->p", theta, rights[j] - rights[i])
    cost[i, j] = np.maximum(0.0, squares[j] - squares[i] - explained)
    penalty = max(_PENALTY * cost[0, B], _LEAST_PENALTY)
    best, before = np.full(B + 1, np.inf), np.zeros(B + 1, int)
    best[0] = 0.0
    for end in range(_SHORTEST, B + 1):
        total = best[:end] + cost[:end, end] + penalty
        before[end] = int(np.argmin(total))
        best[end] = total[before[end]]
    parts, end = [], B
    while end > 0:
        parts.append((int(before[end]), end))
        end = int(before[end])
    return parts[::-1]


def _identified(rows: list[Array], noise: Array, edges: NDArray[np.int_]) -> Segment | None:
    """A part, the edges of its blocks given, and its load; None if no load explains it."""
    inner = edges[1:-1] if len(edges) > _SHORTEST + 1 else edges
    equations = NormalEquations(noise)
    equations.add(*(table[inner[0] : inner[-1]] for table in rows))
    load = equations.solve()
    if load.mass <= 0.0 or np.sqrt(np.mean((load.residual_rms / noise) ** 2)) > _EXPLAINED:
        return None
    return Segment(int(edges[0]), int(edges[-1]), load)


def _differ(a: Identification, b: Identification, which: slice) -> bool:
    """Whether some of [offsets; phi] are surely not the same (module docstring)."""
    change = np.abs(np.concatenate([a.offsets - b.offsets, a.phi - b.phi]))
    heavier = max(a, b, key=lambda load: load.mass)
    least = np.maximum(
        WORTH_STATING * natural_scale(heavier.phi),
        _SIGNIFICANT * np.hypot(a.standard_deviations, b.standard_deviations),
    )
    return bool((a.identifiable & b.identifiable & (change > least))[which].any())


def _is_object(a: Identification, b: Identification) -> bool:
    """Whether two loads surely differ, and by what a body makes (module docstring)."""
    if _differ(a, b, _OFFSETS) or not _differ(a, b, _MASS):
        return False
    lighter, heavier = sorted((a, b), key=lambda load: load.mass)
    if lighter.mass == heavier.mass:
        return False
    margin, deviation = consistency_margin(identified_object(heavier, lighter))
    return margin >= -SIGNIFICANT * deviation


def _sharpened(rows: list[Array], noise: Array, loads: list[Segment]) -> list[Segment]:
    """Parts that meet do so where the one load stops to explain the wrench and the next begins."""

    def misfit(part: Segment, samples: slice) -> Array:
        F, s, omega, alpha = (table[samples] for table in rows)
        left: Array = F - part.load.offsets - non_contact_wrench(s, omega, alpha, part.load.phi)
        return np.sum((left / noise) ** 2, axis=1)

    found = [loads[0]]
    for part in loads[1:]:
        last = found[-1]
        if last.stop == part.start:
            # Within the halves that touch.
            samples = slice((last.start + last.stop) // 2, (part.start + part.stop) // 2)
            gain = np.cumsum(misfit(last, samples) - misfit(part, samples))
            cut = samples.start + int(np.argmin(np.append(0.0, gain)))
            found[-1] = Segment(last.start, cut, last.load)
            part = Segment(cut, part.stop, part.load)
        found.append(part)
    return found
