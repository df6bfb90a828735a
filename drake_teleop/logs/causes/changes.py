"""Detection of contacts, and of changes of offsets or load, within a record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise, product

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.numeric import Array, find_runs_of_true
from drake_teleop.logs.causes.fitted_model import (
    MIN_ROWS_FOR_AUTOREGRESSION,
    FittedModel,
    TimeSpans,
    is_in_time_spans,
    regularized_inverse,
    score_statistic,
)
from drake_teleop.logs.causes.instants import WRENCH_SIGNALS
from drake_teleop.logs.causes.model import LoadModel, StepChange

_MIN_SCORE_STATISTIC_OF_STEP_CHANGE = 60.0
_STEP_TIME_REFINEMENT_ROWS, _MAX_STEP_TIME_MOVES = (1.0, 0.25), 2  # instants
_MIN_TIME_BETWEEN_STEPS_S, _MIN_TIME_TO_END_S, _MIN_LIKELIHOOD_GAIN_OF_RAMP = 0.4, 0.2, 80.0
OMITTED_SPAN_AROUND_RAMP_S = 0.5
_NUM_TRIED_STEP_TIMES, _MIN_STEP_OVER_DEVIATION, _MIN_OFFSET_STEP_OVER_NOISE = 2, 5.0, 2.0
_MIN_MASS_STEP_OVER_MASS, _MIN_MOMENT_STEP_OVER_MASS_M = 0.01, 0.002


def add_step_change(fit: FittedModel, kind: str) -> FittedModel | None:
    """Return a fit with the likeliest change of `kind` "offsets" or "load"; None: insignificant."""
    best: FittedModel | None = None
    for time in _likely_step_times_s(fit, kind):
        found = _fit_with_refined_step_time(fit, kind, time)
        ramp = fit_steps_at_middle_of_ramps(fit, [[kind]], [time], fit.contact_spans)
        if 2.0 * (ramp.log_likelihood - found.log_likelihood) > _MIN_LIKELIHOOD_GAIN_OF_RAMP:
            found = ramp
        if best is None or found.log_likelihood > best.log_likelihood:
            best = found
    return best if best and _is_step_significant(best, len(fit.model.steps)) else None


def _likely_step_times_s(fit: FittedModel, kind: str) -> list[float]:
    means, rows = fit.means, fit.means.rows_per_search_block
    scan = _StepTimeScoreTest(fit, kind)
    starts = np.arange(rows, len(means.t), rows)
    gains = np.array([scan.score_statistic_of_step_at_row(int(n)) for n in starts])
    for time in fit.model.step_times:
        gains[np.abs(means.t[starts] - time) < _MIN_TIME_BETWEEN_STEPS_S] = 0.0
    out: list[float] = []
    for _ in range(_NUM_TRIED_STEP_TIMES):
        j = int(np.argmax(gains))
        if gains[j] < _MIN_SCORE_STATISTIC_OF_STEP_CHANGE:
            break
        near = range(max(1, starts[j] - 2 * rows), min(len(means.t), starts[j] + 2 * rows))
        time = float(means.t[max(near, key=scan.score_statistic_of_step_at_row)]) - 0.5 * means.dt
        far = [abs(time - x) > _MIN_TIME_BETWEEN_STEPS_S for x in fit.model.step_times]
        if all(far) and min(time - means.t[0], means.t[-1] - time) > _MIN_TIME_TO_END_S:
            out.append(time)
        distance = max(2.0 * _MIN_TIME_BETWEEN_STEPS_S, 3.0 * rows * means.dt)
        gains[np.abs(means.t[starts] - time) < distance] = 0.0
    return out


class _StepTimeScoreTest:
    def __init__(self, fit: FittedModel, kind: str) -> None:
        scale = np.maximum(fit.rows.residual_rms(fit.residual), 1e-12)
        self._y, self._rows = fit.rows.y, fit.means.rows_per_search_block
        self._J = fit.model.wrench_jacobian(fit.x) / scale[:, None]
        self._residual = fit.residual / scale[:, None]
        self._which = slice(0, 6) if kind == "offsets" else slice(6, 16)
        sums = fit.means.lagged_block_sums(self._y, rows=self._rows, lags=1)[:, 0]
        gram, right = _wrench_normal_equations(self._J, self._residual, sums)
        self._gram = np.cumsum(gram[::-1], axis=0)[::-1]
        self._right = np.cumsum(right[::-1], axis=0)[::-1]
        self._inverse = np.linalg.pinv(self._gram[0], rcond=1e-12, hermitian=True)

    def score_statistic_of_step_at_row(self, row: int) -> float:
        j = -(-row // self._rows)
        y = self._y[row : j * self._rows]
        gram, right = _wrench_normal_equations(self._J, self._residual, y.T @ y)
        if j < len(self._gram):
            gram, right = gram + self._gram[j], right + self._right[j]
        which = self._which
        mixed = gram[:, which]
        pull = right[which] - mixed.T @ (self._inverse @ self._right[0])
        schur = gram[which, which] - mixed.T @ self._inverse @ mixed
        return score_statistic(schur, pull, 1e-6 * np.diag(gram)[which])[0]


def _wrench_normal_equations(J: Array, residual: Array, products: Array) -> tuple[Array, Array]:
    gram = [J[:, c] @ products @ J[:, c].T for c in range(6)]
    right = [products @ residual[c] @ J[:, c].T for c in range(6)]
    return np.sum(gram, axis=0), np.sum(right, axis=0)


def fit_steps_at_middle_of_ramps(
    fit: FittedModel,
    kinds: Sequence[Sequence[str]],
    times: Sequence[float],
    contact_spans: TimeSpans,
    widths: Sequence[float] | None = None,
) -> FittedModel:
    """Return a fit with more changes of "offsets" or "load", in the middle of gradual transitions.

    `kinds` lists the changes at each of `times` [s]. Rows within the transitions, with durations
    `widths` [s], and in `contact_spans` are not used.
    """
    least = OMITTED_SPAN_AROUND_RAMP_S
    widths = [max(least, w + least) for w in (widths or [0.0] * len(times))]
    around = tuple((t - 0.5 * w, t + 0.5 * w) for t, w in zip(times, widths, strict=True))
    steps = [StepChange(kind, t) for t, both in zip(times, kinds, strict=True) for kind in both]
    first = len(fit.model.steps)
    model = replace(fit.model, steps=(*fit.model.steps, *steps))
    start = model.start_parameters(fit.x, fit.model)
    found = FittedModel.fit_record(fit.means, model, start, (*contact_spans, *around))
    steps = []
    for both, span in zip(kinds, around, strict=True):
        added = range(first + len(steps), first + len(steps) + len(both))
        middle = _ramp_middle_time_s(found, added, span)
        steps += [StepChange(kind, middle) for kind in both]
    model = replace(model, steps=(*fit.model.steps, *steps))
    return FittedModel.fit_record(fit.means, model, found.x, found.contact_spans)


def remove_small_steps(fit: FittedModel) -> FittedModel:
    while True:
        small = [i for i in range(len(fit.model.steps)) if not _is_step_significant(fit, i)]
        if not small:
            return fit
        least = min(small, key=lambda i: _reduced_chi_squared_of_step(fit, i))
        fit = _refit_without_steps(fit, [least], fit.contact_spans)


def _refit_without_steps(
    fit: FittedModel, removed: Sequence[int], contact_spans: TimeSpans
) -> FittedModel:
    kept = tuple(x for i, x in enumerate(fit.model.steps) if i not in removed)
    model = replace(fit.model, steps=kept)
    x = model.start_parameters(fit.x, LoadModel())
    return FittedModel.fit_record(fit.means, model, x, contact_spans)


def _reduced_chi_squared_of_step(fit: FittedModel, i: int) -> float:
    x, covariance = fit.parameters_of_extension(f"step {i}")
    return float(x @ regularized_inverse(covariance) @ x) / len(x)


def _ramp_middle_time_s(fit: FittedModel, step_ids: range, span: tuple[float, float]) -> float:
    means = fit.means
    rows = np.flatnonzero(means.used & is_in_time_spans(means, (span,)))
    if not len(rows):
        return 0.5 * (span[0] + span[1])

    def residual_with_steps_at(time: float) -> Array:
        times = tuple(time if i in step_ids else x.time for i, x in enumerate(fit.model.steps))
        y = means.append_step_signals(times)[rows][:, fit.model.columns]
        return np.asarray(y @ fit.residual.T)

    before = residual_with_steps_at(span[1] + means.dt)
    whole = before - residual_with_steps_at(span[0] - means.dt)
    weight = 1.0 / np.maximum(means.wrench_noise, 1e-12) ** 2
    share = (before * whole) @ weight / np.maximum((whole * whole) @ weight, 1e-12)
    return span[1] - float(np.clip(share, 0.0, 1.0).mean()) * (span[1] - span[0])


def _fit_with_refined_step_time(fit: FittedModel, kind: str, time: float) -> FittedModel:
    def fit_with_step_at(time: float, start: Array | None = None) -> FittedModel:
        model = replace(fit.model, steps=(*fit.model.steps, StepChange(kind, time)))
        return fit.refit(model, start)

    best = fit_with_step_at(time)
    for share in _STEP_TIME_REFINEMENT_ROWS:
        for _ in range(_MAX_STEP_TIME_MOVES):
            now = best.model.steps[-1].time
            move = share * fit.means.dt
            tried = [fit_with_step_at(now + x, best.x) for x in (-move, move)]
            better = max(tried, key=lambda x: x.log_likelihood)
            if not better.log_likelihood > best.log_likelihood + 1e-3:
                break
            best = better
    return best


def _is_step_significant(fit: FittedModel, i: int) -> bool:
    values, covariance = fit.parameters_of_extension(f"step {i}")
    deviations, t, time = np.sqrt(np.diag(covariance)), fit.means.t, fit.model.steps[i].time
    if min(time - t[0], t[-1] - time) < _MIN_TIME_TO_END_S:
        return False  # the few samples before or after it do not determine the change
    if fit.model.steps[i].kind == "offsets":
        clear = np.abs(values) > _MIN_STEP_OVER_DEVIATION * deviations
        large = np.abs(values) > _MIN_OFFSET_STEP_OVER_NOISE * fit.means.wrench_noise
        return bool((clear & large).any())
    mass, limit = max(abs(fit.x[6]), 1e-3), _MIN_STEP_OVER_DEVIATION * deviations[0]
    heavier = abs(values[0]) > max(limit, _MIN_MASS_STEP_OVER_MASS * mass)
    size, moment = np.linalg.norm(values[1:4]), np.linalg.norm(deviations[1:4])
    moved = size > max(2.0 * _MIN_STEP_OVER_DEVIATION * moment, _MIN_MOMENT_STEP_OVER_MASS_M * mass)
    return bool(heavier or moved)


_TRIED_SHARES_OF_KEPT_BLOCKS = (0.12, 0.3, 0.55)
_MAX_TRIMMED_FIT_ITERATIONS, _MIN_TRIMMED_FIT_BLOCKS = 15, 8
_KEPT_GROWTH_FACTOR = 1.3  # largest growth of their number in one iteration
_TRIED_START_RUN_LENGTHS_BLOCKS, _TRIED_END_RUN_LENGTHS_BLOCKS = (8, 16, 32), (2, 4, 8)
_CONTACT_RMS_OVER_NOISE, _CONTACT_RMS_OVER_CALM, _CALM_RMS_MARGIN = 8.0, 5.0, 1.3
_MAX_NUM_LOADS, _MAX_LOAD_STEPS, _MIN_CALM_RUN_BLOCKS, _MAX_UNFITTED_BLOCK_SHARE = 4, 4, 4, 0.12
_MAX_STEP_OVER_CONTACT_RESIDUAL, _SMALL_RESIDUAL_OVER_NOISE = 1.3, 1.25


def find_contact_spans(fit: FittedModel) -> TimeSpans:
    """Return time spans (start, stop) [s] of contact, found by a much larger residual."""
    blocks = _NormalEquationsOfBlocks(fit)
    contact_blocks = blocks.find_contact_blocks(blocks.usable)
    if contact_blocks is None or not contact_blocks.any():
        return ()
    wide = contact_blocks.copy()
    wide[:-1] |= contact_blocks[1:]
    wide[1:] |= contact_blocks[:-1]
    t, rows = fit.means.t, fit.means.rows_per_search_block
    half, last = 0.5 * float(t[1] - t[0]), len(t) - 1
    ends = rows * find_runs_of_true(wide)
    return tuple((float(t[a]) - half, float(t[min(b - 1, last)]) + half) for a, b in ends)


def replace_contacts_by_steps(fit: FittedModel) -> FittedModel | None:
    """Return a fit with step changes in place of contacts; None without contacts or if poor."""
    blocks = _NormalEquationsOfBlocks(fit)
    left, number = blocks.usable.copy(), np.full(len(blocks.usable), -1)
    for load in range(_MAX_NUM_LOADS):
        contact_blocks = blocks.find_contact_blocks(left)
        if contact_blocks is None:
            break
        calm = _fill_single_gaps_keep_long_runs(left & ~contact_blocks, _MIN_CALM_RUN_BLOCKS)
        number[calm], left = load, left & ~calm
    inner = np.flatnonzero(number >= 0)
    if not len(inner) or left.sum() > _MAX_UNFITTED_BLOCK_SHARE * blocks.usable.sum():
        return None
    borders = [(a, b) for a, b in pairwise(inner) if number[a] != number[b]]
    if not 0 < len(borders) <= _MAX_LOAD_STEPS:
        return None
    dt, rows = fit.means.dt, fit.means.rows_per_search_block
    t = fit.means.t[0] + dt * rows * np.arange(len(number))
    times = [float(0.5 * (t[a] + dt * rows + t[b])) for a, b in borders]
    widths = [float(t[b] - t[a] - dt * rows) for a, b in borders]
    both = [("offsets", "load")] * len(times)
    found = remove_small_steps(fit_steps_at_middle_of_ramps(fit, both, times, (), widths))
    limit = max(_MAX_STEP_OVER_CONTACT_RESIDUAL * fit.residual_ratio, _SMALL_RESIDUAL_OVER_NOISE)
    return found if found.residual_ratio < limit else None


def _fill_single_gaps_keep_long_runs(flags: NDArray[np.bool_], min_run: int) -> NDArray[np.bool_]:
    closed = flags.copy()
    closed[1:-1] |= flags[:-2] & flags[2:]
    out = np.zeros(len(flags), bool)
    for a, b in find_runs_of_true(closed):
        out[a:b] = b - a >= min_run
    return out


class _NormalEquationsOfBlocks:
    def __init__(self, fit: FittedModel) -> None:
        means = fit.means
        self._fit = fit
        y = means.append_step_signals(fit.model.step_times)[:, fit.model.columns]
        sums = means.lagged_block_sums(y, rows=means.rows_per_search_block, lags=1)[:, 0]
        self._counts = sums[:, 0, 0]
        self.usable = self._counts > 0.5 * means.rows_per_search_block
        sizes = np.sqrt(np.diag(sums.sum(axis=0))[WRENCH_SIGNALS] / max(self._counts.sum(), 1.0))
        least = 1e-6 * sizes.reshape(2, 3).max(axis=1).repeat(3) + 1e-12
        scale = np.maximum(means.wrench_noise, least)
        J, left = fit.model.wrench_jacobian(fit.x), fit.residual / scale[:, None]
        self._gram, self._right = _wrench_normal_equations(J / scale[:, None], left, sums)
        self._square = ((left @ sums) * left).sum(axis=(1, 2))

    def find_contact_blocks(self, among: NDArray[np.bool_]) -> NDArray[np.bool_] | None:
        """Flag blocks of contact within the flags `among`; None if these are too few."""
        found = self._fit_calmest_blocks(np.flatnonzero(among))
        if found is None:
            return None
        level, calm, move = found
        excess = np.sqrt(np.maximum(level**2 - (_CALM_RMS_MARGIN * calm) ** 2, 0.0))
        quantile = min(0.25, 0.5 * float(np.mean(level[among] < _CONTACT_RMS_OVER_CALM * calm)))
        x = self._fit.x + move
        by_motion = _block_residuals_due_to_motion_errors(self._fit, x, excess, among, quantile)
        usual = _CONTACT_RMS_OVER_CALM * np.hypot(calm, by_motion)
        return np.asarray((level > np.maximum(_CONTACT_RMS_OVER_NOISE, usual)) & among)

    def _fit_calmest_blocks(self, blocks: NDArray[np.intp]) -> tuple[Array, float, Array] | None:
        if len(blocks) < 2 * _MIN_TRIMMED_FIT_BLOCKS:
            return None
        starts = [blocks]
        for length in _TRIED_START_RUN_LENGTHS_BLOCKS:
            begins = range(0, len(blocks) - length // 2, length // 2)
            starts += [blocks[k : k + length] for k in begins]
        found, usual = [], np.inf
        for kept, share in product(starts, _TRIED_SHARES_OF_KEPT_BLOCKS):
            level, move, last = self._trimmed_fit_of_blocks(blocks, kept, share)
            found.append((level, move))
            if share == _TRIED_SHARES_OF_KEPT_BLOCKS[1]:
                usual = min(usual, float(np.median(level[last])))
        for length in _TRIED_END_RUN_LENGTHS_BLOCKS:
            ends = np.r_[blocks[:length], blocks[-length:]]
            level, move, last = self._trimmed_fit_of_blocks(blocks, ends, 0.0)
            calm = float(np.median(level[last]))
            if self._is_residual_large_in_others(level, last, np.setdiff1d(blocks, last), calm):
                found.append((level, move))
                usual = min(usual, calm)
        limit = max(_CONTACT_RMS_OVER_NOISE**2, (_CONTACT_RMS_OVER_CALM**2) * usual)
        level, move = min(found, key=lambda x: float(np.minimum(x[0][blocks], limit).sum()))
        calm = np.median(level[blocks][level[blocks] < limit])
        return np.sqrt(np.maximum(level, 0.0)), float(np.sqrt(max(calm, 0.0))), move

    def _is_residual_large_in_others(
        self, level: Array, kept: NDArray[np.intp], others: NDArray[np.intp], calm: float
    ) -> bool:
        covariance = regularized_inverse(self._gram[kept].sum(axis=0))
        share = np.einsum("bij,ji->b", self._gram[others], covariance)
        predicted = calm * (1.0 + share / (6.0 * np.maximum(self._counts[others], 1.0)))
        differ = np.mean(level[others] > _CONTACT_RMS_OVER_CALM**2 * predicted)
        return bool(differ > 1.0 - _MAX_UNFITTED_BLOCK_SHARE)

    def _trimmed_fit_of_blocks(
        self, blocks: NDArray[np.intp], kept: NDArray[np.intp], kept_share: float
    ) -> tuple[Array, Array, NDArray[np.intp]]:
        keep = max(_MIN_TRIMMED_FIT_BLOCKS, int(kept_share * len(blocks)))
        for _ in range(_MAX_TRIMMED_FIT_ITERATIONS):
            move = regularized_inverse(self._gram[kept].sum(axis=0)) @ self._right[kept].sum(axis=0)
            left = self._square - 2.0 * self._right @ move + (self._gram @ move) @ move
            level = left / (6.0 * np.maximum(self._counts, 1.0))
            size = min(keep, 1 + int(_KEPT_GROWTH_FACTOR * len(kept))) if len(kept) < keep else keep
            chosen = np.sort(blocks[np.argsort(level[blocks])[:size]])
            if np.array_equal(chosen, kept):
                break
            kept = chosen
        return level, move, kept


def _block_residuals_due_to_motion_errors(
    fit: FittedModel, x: Array, level: Array, usable: NDArray[np.bool_], quantile: float
) -> Array:
    means, rows = fit.means, fit.means.rows_per_search_block
    y = means.append_step_signals(fit.model.step_times)
    wrench = y @ fit.model.wrench_coefficients(x[None])[0].T
    bend = np.zeros(len(y))
    both = means.used[2:] & means.used[:-2]
    second = np.diff(wrench, 2, axis=0) / np.maximum(means.wrench_noise, 1e-12)
    bend[1:-1] = np.where(both, (second * second).sum(axis=1), 0.0)
    fast = np.sqrt(np.add.reduceat(bend, np.arange(0, len(y), rows)) / rows)[: len(level)]
    fastest = usable & (fast > np.median(fast[usable]))
    if fastest.sum() < 8:
        return np.zeros(len(level))
    ratio = level[fastest] / np.maximum(fast[fastest], 1e-12)
    return np.asarray(2.0 * np.quantile(ratio, quantile) * fast)


def replace_steps_by_contact(fit: FittedModel) -> FittedModel:
    """Replace step changes by a contact if two cancel, or if the residual beside one is large."""
    steps = sorted(enumerate(fit.model.steps), key=lambda x: x[1].time)
    first, last = float(fit.means.t[0]), float(fit.means.t[-1])
    borders = [(-1, first), *((i, step.time) for i, step in steps), (-1, last)]
    for (i, start), (j, stop) in pairwise(borders):
        ends = [k for k in (i, j) if k >= 0]
        if not ends or all(fit.model.steps[k].kind == "load" for k in ends):
            continue
        span = start - fit.means.dt, stop + fit.means.dt
        spans = (*fit.contact_spans, span)
        left = fit.means.used & ~is_in_time_spans(fit.means, spans)
        if left.sum() < MIN_ROWS_FOR_AUTOREGRESSION:
            continue
        if len(ends) == 2 and _do_offset_steps_cancel(fit, i, j):
            return _refit_without_steps(fit, ends, spans)
        if _median_residual_over_noise(fit, span) > _CONTACT_RMS_OVER_NOISE:
            calm = _refit_without_steps(fit, ends, spans)
            limit = min(_CONTACT_RMS_OVER_CALM, fit.residual_ratio / _CONTACT_RMS_OVER_CALM)
            if calm.residual_ratio < limit:
                return shorten_contacts(calm)
    return fit


def shorten_contacts(fit: FittedModel) -> FittedModel:
    """Return a fit with contact spans shortened to rows with a large residual."""
    means, spans = fit.means, []
    y = means.append_step_signals(fit.model.step_times)[:, fit.model.columns]
    usual = np.maximum(means.wrench_noise, fit.rows.residual_rms(fit.residual)).clip(1e-12)
    for start, stop in fit.contact_spans:
        inside = np.flatnonzero(means.used & is_in_time_spans(means, ((start, stop),)))
        large = (np.abs(y[inside] @ fit.residual.T) > _CONTACT_RMS_OVER_CALM * usual).any(axis=1)
        first = np.flatnonzero(large[:-1] & large[1:])  # single rows are outliers of the noise
        if len(first):
            start = float(means.t[inside[first[0]]]) - 0.5 * means.dt
            stop = float(means.t[inside[first[-1] + 1]]) + 0.5 * means.dt
        spans.append((start - means.dt, stop + means.dt))
    return FittedModel.fit_record(means, fit.model, fit.x, tuple(spans))


def _median_residual_over_noise(fit: FittedModel, span: tuple[float, float]) -> float:
    chosen = fit.rows.used & is_in_time_spans(fit.means, (span,))
    if not chosen.any():
        return 0.0
    e = np.abs(fit.rows.y[chosen] @ fit.residual.T)
    return float((np.median(e, axis=0) / 0.6745 / np.maximum(fit.means.wrench_noise, 1e-12)).max())


def _do_offset_steps_cancel(fit: FittedModel, i: int, j: int) -> bool:
    steps = fit.model.steps
    if (steps[i].kind, steps[j].kind) != ("offsets", "offsets"):
        return False
    a, b = (fit.model.parameter_slices[f"step {k}"] for k in (i, j))
    both = fit.x[a] + fit.x[b]
    covariance = fit.covariance
    variance = np.diag(covariance[a, a] + covariance[b, b] + 2.0 * covariance[a, b])
    return bool((np.abs(both) < 4.0 * np.sqrt(np.maximum(variance, 0.0))).all())
