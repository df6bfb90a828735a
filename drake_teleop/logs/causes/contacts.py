"""Contacts of the load within a record, by trimmed least squares."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise, product

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.numeric import Array
from drake_teleop.logs.causes.changes import with_ramps, without_small_steps
from drake_teleop.logs.causes.fit import regularized_inverse
from drake_teleop.logs.causes.instants import FORCES
from drake_teleop.logs.causes.model import DELAY
from drake_teleop.logs.causes.rows import Spans, in_spans
from drake_teleop.logs.causes.state import State

_KEPT_SHARES, _ITERATIONS, _FEWEST_BLOCKS, _GROWTH = (0.12, 0.3, 0.55), 15, 8, 1.3
_START_LENGTHS = (8, 16, 32)
_CONTACT_LEVEL, _CALM_RATIO, _SPREAD = 8.0, 5.0, 1.3
_MAX_LOADS, _MAX_STEPS, _SHORTEST_RUN, _MAX_UNCOVERED = 4, 4, 4, 0.12
_LARGEST_INCREASE, _SMALL_RESIDUAL = 1.3, 1.25


def contact_spans(state: State) -> Spans:
    """Return time spans (start, stop) [s] with a residual far above noise and calm parts."""
    blocks = _Blocks(state)
    contact_blocks = blocks.contact_blocks(blocks.usable)
    if contact_blocks is None or not contact_blocks.any():
        return ()
    wide = contact_blocks.copy()
    wide[:-1] |= contact_blocks[1:]
    wide[1:] |= contact_blocks[:-1]
    return _spans(wide, state.data.t, state.data.block)


def replace_contacts_by_steps(larger: State) -> State | None:
    """Explain long contacts by changed loads and offsets, or return None if impossible."""
    blocks = _Blocks(larger)
    left, number = blocks.usable.copy(), np.full(len(blocks.usable), -1)
    for load in range(_MAX_LOADS):
        contact_blocks = blocks.contact_blocks(left)
        if contact_blocks is None:
            break
        calm = _runs(left & ~contact_blocks, _SHORTEST_RUN)
        number[calm], left = load, left & ~calm
    inner = np.flatnonzero(number >= 0)
    if not len(inner) or left.sum() > _MAX_UNCOVERED * blocks.usable.sum():
        return None
    borders = [(a, b) for a, b in pairwise(inner) if number[a] != number[b]]
    if not 0 < len(borders) <= _MAX_STEPS:
        return None
    dt, rows = larger.data.dt, larger.data.block
    t = larger.data.t[0] + dt * rows * np.arange(len(number))
    times = [float(0.5 * (t[a] + dt * rows + t[b])) for a, b in borders]
    widths = [float(t[b] - t[a] - dt * rows) for a, b in borders]
    found = with_ramps(larger, [("offsets", "load")] * len(times), times, (), widths)
    found = without_small_steps(found)
    limit = max(_LARGEST_INCREASE * larger.residual_ratio, _SMALL_RESIDUAL)
    return found if found.residual_ratio < limit else None


def _runs(flags: NDArray[np.bool_], shortest: int) -> NDArray[np.bool_]:
    closed = flags.copy()
    closed[1:-1] |= flags[:-2] & flags[2:]
    edges = np.flatnonzero(np.diff(np.concatenate([[0], closed.astype(np.int8), [0]])))
    out = np.zeros(len(flags), bool)
    for a, b in zip(edges[::2], edges[1::2], strict=True):
        out[a:b] = b - a >= shortest
    return out


class _Blocks:
    def __init__(self, state: State) -> None:
        data = state.data
        self._state = state
        y = data.with_steps(state.model.times)[:, state.model.columns]
        sums = data.sums(y, rows=data.block, lags=1)[:, 0]
        self._counts = sums[:, 0, 0]
        self.usable = self._counts > 0.5 * data.block
        J = state.model.derivative(state.x)
        sizes = np.sqrt(np.diag(sums.sum(axis=0))[FORCES] / max(self._counts.sum(), 1.0))
        least = 1e-6 * sizes.reshape(2, 3).max(axis=1).repeat(3) + 1e-12
        scale = np.maximum(data.white, least)
        self._gram = np.zeros((len(sums), len(J), len(J)))
        self._right = np.zeros((len(sums), len(J)))
        self._square = np.zeros(len(sums))
        for c in range(6):
            weighted = J[:, c] @ sums / scale[c] ** 2
            self._gram += weighted @ J[:, c].T
            self._right += weighted @ state.fit.residual[c]
            left = state.fit.residual[c] / scale[c]
            self._square += np.einsum("i,bij,j->b", left, sums, left)

    def contact_blocks(self, among: NDArray[np.bool_]) -> NDArray[np.bool_] | None:
        """Return True for blocks with a residual far above the calmest; None for too few blocks."""
        found = self._fit_calmest(np.flatnonzero(among))
        if found is None:
            return None
        level, calm, move = found
        excess = np.sqrt(np.maximum(level**2 - (_SPREAD * calm) ** 2, 0.0))
        by_motion = _motion_error_level(self._state, self._state.x + move, excess, among)
        usual = np.hypot(calm, by_motion)
        return np.asarray((level > _CONTACT_LEVEL) & (level > _CALM_RATIO * usual) & among)

    def _fit_calmest(self, blocks: NDArray[np.intp]) -> tuple[Array, float, Array] | None:
        if len(blocks) < 2 * _FEWEST_BLOCKS:
            return None
        starts = [blocks]
        for length in _START_LENGTHS:
            begins = range(0, len(blocks) - length // 2, length // 2)
            starts += [blocks[k : k + length] for k in begins]
        found, usual = [], np.inf
        for kept, share in product(starts, _KEPT_SHARES):
            level, move, last = self._trimmed_fit(blocks, kept, share)
            found.append((level, move))
            if share == _KEPT_SHARES[1]:
                usual = min(usual, float(np.median(level[last])))
        limit = max(_CONTACT_LEVEL**2, (_CALM_RATIO**2) * usual)
        level, move = min(found, key=lambda x: float(np.minimum(x[0][blocks], limit).sum()))
        calm = np.median(level[blocks][level[blocks] < limit])
        return np.sqrt(np.maximum(level, 0.0)), float(np.sqrt(max(calm, 0.0))), move

    def _trimmed_fit(
        self, blocks: NDArray[np.intp], kept: NDArray[np.intp], share: float
    ) -> tuple[Array, Array, NDArray[np.intp]]:
        keep = max(_FEWEST_BLOCKS, int(share * len(blocks)))
        for _ in range(_ITERATIONS):
            move = regularized_inverse(self._gram[kept].sum(axis=0)) @ self._right[kept].sum(axis=0)
            left = self._square - 2.0 * self._right @ move + (self._gram @ move) @ move
            level = left / (6.0 * np.maximum(self._counts, 1.0))
            size = min(keep, 1 + int(_GROWTH * len(kept))) if len(kept) < keep else keep
            chosen = np.sort(blocks[np.argsort(level[blocks])[:size]])
            if np.array_equal(chosen, kept):
                break
            kept = chosen
        return level, move, kept


def _motion_error_level(state: State, x: Array, level: Array, usable: NDArray[np.bool_]) -> Array:
    data, rows = state.data, state.data.block
    y = data.with_steps(state.model.times)
    wrench = y @ state.model.wrench(x[None])[0].T
    bend = np.zeros(len(y))
    both = data.used[2:] & data.used[:-2]
    second = np.diff(wrench, 2, axis=0) / np.maximum(data.white, 1e-12)
    bend[1:-1] = np.where(both, (second * second).sum(axis=1), 0.0)
    blocks = np.add.reduceat(bend, np.arange(0, len(y), rows)) / rows
    fast = np.sqrt(blocks[: len(level)])
    accelerates_enough = usable & (fast > np.median(fast[usable]))
    if accelerates_enough.sum() < 8:
        return np.zeros(len(level))
    ratio = level[accelerates_enough] / np.maximum(fast[accelerates_enough], 1e-12)
    return np.asarray(2.0 * np.quantile(ratio, 0.25) * fast)


def replace_steps_by_contact(state: State) -> State:
    """Replace changes of the offsets by a contact if the residual requires it."""
    steps = sorted(enumerate(state.model.steps), key=lambda x: x[1].time)
    first, last = float(state.data.t[0]), float(state.data.t[-1])
    borders = [(-1, first), *((i, step.time) for i, step in steps), (-1, last)]
    for (i, start), (j, stop) in pairwise(borders):
        ends = [k for k in (i, j) if k >= 0]
        if not ends or all(state.model.steps[k].kind == "load" for k in ends):
            continue
        kept = tuple(x for k, x in enumerate(state.model.steps) if k not in ends)
        model = replace(state.model, steps=kept)
        x = np.concatenate([state.x[: DELAY + 1], np.zeros(model.size - DELAY - 1)])
        dt = state.data.dt
        span = (start - dt, stop + dt)
        if len(ends) == 2 and _cancels(state, i, j):
            return State.of(state.data, model, x, (*state.spans, span))
        if _median_residual_ratio(state, span) > _CONTACT_LEVEL:
            calm = State.of(state.data, model, x, (*state.spans, span))
            if calm.residual_ratio < min(_CALM_RATIO, state.residual_ratio / _CALM_RATIO):
                return shrink_contacts(calm)
    return state


def shrink_contacts(state: State) -> State:
    """Shorten the time spans of contacts to the rows with a large residual."""
    dt = state.data.dt
    spans = [_contact_span(state, span) for span in state.spans]
    return State.of(state.data, state.model, state.x, tuple((a - dt, b + dt) for a, b in spans))


def _contact_span(state: State, span: tuple[float, float]) -> tuple[float, float]:
    data = state.data
    inside = np.flatnonzero(data.used & in_spans(data, (span,)))
    y = data.with_steps(state.model.times)[:, state.model.columns]
    usual = np.maximum(np.maximum(data.white, state.rows.rms(state.fit.residual)), 1e-12)
    contact_blocks = np.abs(y[inside] @ state.fit.residual.T) > _CALM_RATIO * usual
    at = inside[contact_blocks.any(axis=1)]
    if not len(at):
        return span
    return float(data.t[at[0]]) - 0.5 * data.dt, float(data.t[at[-1]]) + 0.5 * data.dt


def _median_residual_ratio(state: State, span: tuple[float, float]) -> float:
    chosen = state.rows.used & in_spans(state.data, (span,))
    if not chosen.any():
        return 0.0
    e = np.abs(state.rows.y[chosen] @ state.fit.residual.T)
    return float((np.median(e, axis=0) / 0.6745 / np.maximum(state.data.white, 1e-12)).max())


def _cancels(state: State, i: int, j: int) -> bool:
    steps = state.model.steps
    if (steps[i].kind, steps[j].kind) != ("offsets", "offsets"):
        return False
    a, b = (state.model.slices[f"step {k}"] for k in (i, j))
    both = state.x[a] + state.x[b]
    covariance = state.fit.covariance
    variance = np.diag(covariance[a, a] + covariance[b, b] + 2.0 * covariance[a, b])
    return bool((np.abs(both) < 4.0 * np.sqrt(np.maximum(variance, 0.0))).all())


def _spans(contact_blocks: NDArray[np.bool_], t: Array, rows: int) -> Spans:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], contact_blocks.astype(np.int8), [0]])))
    half = 0.5 * float(t[1] - t[0])
    last = len(t) - 1
    return tuple(
        (float(t[a * rows]) - half, float(t[min(b * rows - 1, last)]) + half)
        for a, b in zip(edges[::2], edges[1::2], strict=True)
    )
