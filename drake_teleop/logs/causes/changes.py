"""Times at which the offsets or the load change."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from drake_teleop.common.numeric import Array
from drake_teleop.logs.causes.fit import regularized_inverse
from drake_teleop.logs.causes.model import DELAY, Step
from drake_teleop.logs.causes.rows import Spans, in_spans
from drake_teleop.logs.causes.state import State, gain_of

_MIN_GAIN = 60.0
_REFINEMENTS, _REFINEMENT_STEPS = (1.0, 0.25), 2  # instants
_MIN_DISTANCE_S, _RAMP_COST = 0.4, 80.0
RAMP_S = 0.5
"""Shortest omitted time around a gradual step [s]."""
_TRIED_TIMES = 2
_SIGNIFICANT, _NOISE_LEVELS, _MASS_SHARE, _SMALLEST_ARM_M = 5.0, 2.0, 0.01, 0.002


def add_step(state: State, kind: str) -> State | None:
    """Return the model with one more change of "offsets" or "load" (`kind`), or None.

    It is at the most likely time; None if no change is significant.
    """
    best: State | None = None
    for time in _likely_times(state, kind):
        found = _refine_time(state, kind, time)
        ramp = with_ramps(state, [[kind]], [time], state.spans)
        if 2.0 * (ramp.likelihood - found.likelihood) > _RAMP_COST:
            found = ramp
        if best is None or found.likelihood > best.likelihood:
            best = found
    last = len(state.model.steps)
    return best if best is not None and _is_step_significant(best, last) else None


def _likely_times(state: State, kind: str) -> list[float]:
    data, rows = state.data, state.data.block
    scan = _StepScan(state, kind)
    starts = np.arange(rows, len(data.t), rows)
    gains = np.array([scan.gain(int(n)) for n in starts])
    for time in state.model.times:
        gains[np.abs(data.t[starts] - time) < _MIN_DISTANCE_S] = 0.0
    out: list[float] = []
    for _ in range(_TRIED_TIMES):
        j = int(np.argmax(gains))
        if gains[j] < _MIN_GAIN:
            break
        near = range(max(1, starts[j] - 2 * rows), min(len(data.t), starts[j] + 2 * rows))
        time = float(data.t[max(near, key=scan.gain)]) - 0.5 * data.dt
        if all(abs(time - x) > _MIN_DISTANCE_S for x in state.model.times):
            out.append(time)
        distance = max(2.0 * _MIN_DISTANCE_S, 3.0 * rows * data.dt)
        gains[np.abs(data.t[starts] - time) < distance] = 0.0
    return out


class _StepScan:
    """Gain in log likelihood (times 2) by a change at any instant, for white noise."""

    def __init__(self, state: State, kind: str) -> None:
        power = np.maximum(state.rows.rms(state.fit.residual), 1e-12)
        J = state.model.derivative(state.x) / power[:, None]
        self._columns = state.rows.y @ J.transpose(1, 2, 0)  # (6, M, p)
        self._residual = (state.rows.y @ (state.fit.residual / power[:, None]).T).T
        self._which = slice(0, 6) if kind == "offsets" else slice(6, 16)
        self._rows = rows = state.data.block
        starts = np.arange(0, len(state.data.t), rows)
        gram, right = map(
            np.stack, zip(*(self._sums(n, n + rows) for n in starts.tolist()), strict=True)
        )
        self._gram = np.cumsum(gram[::-1], axis=0)[::-1]
        self._right = np.cumsum(right[::-1], axis=0)[::-1]
        self._inverse = np.linalg.pinv(self._gram[0], rcond=1e-12, hermitian=True)

    def _sums(self, start: int, stop: int) -> tuple[Array, Array]:
        A, e = self._columns[:, start:stop], self._residual[:, start:stop]
        flat = A.reshape(-1, A.shape[2])
        return flat.T @ flat, flat.T @ e.ravel()

    def gain(self, n: int) -> float:
        j = -(-n // self._rows)
        gram, right = self._sums(n, j * self._rows)
        if j < len(self._gram):
            gram, right = gram + self._gram[j], right + self._right[j]
        which = self._which
        mixed = gram[:, which]
        pull = right[which] - mixed.T @ (self._inverse @ self._right[0])
        schur = gram[which, which] - mixed.T @ self._inverse @ mixed
        return gain_of(schur, pull, 1e-6 * np.diag(gram)[which])[0]


def with_ramps(
    state: State,
    kinds: Sequence[Sequence[str]],
    times: Sequence[float],
    spans: Spans,
    widths: Sequence[float] | None = None,
) -> State:
    """Fit gradual changes of `kinds` at `times` [s], without the rows within `widths` [s].

    `spans` are other omitted time spans; `state` has the initial parameters.
    """
    widths = [max(RAMP_S, w + RAMP_S) for w in (widths or [0.0] * len(times))]
    around = tuple((t - 0.5 * w, t + 0.5 * w) for t, w in zip(times, widths, strict=True))
    steps = [Step(kind, t) for t, both in zip(times, kinds, strict=True) for kind in both]
    first = len(state.model.steps)
    model = replace(state.model, steps=(*state.model.steps, *steps))
    found = State.of(state.data, model, model.start(state.x, state.model), (*spans, *around))
    owners = [k for k, both in enumerate(kinds) for _ in both]
    middles = [_ramp_middle(found, kinds, first, k, span) for k, span in enumerate(around)]
    steps = [replace(step, time=middles[k]) for step, k in zip(steps, owners, strict=True)]
    model = replace(model, steps=(*state.model.steps, *steps))
    return State.of(state.data, model, found.x, found.spans)


def without_small_steps(state: State) -> State:
    """Remove insignificant changes one by one, the least significant first."""
    while True:
        small = [i for i in range(len(state.model.steps)) if not _is_step_significant(state, i)]
        if not small:
            return state
        least = min(small, key=lambda i: _significance(state, i))
        steps = tuple(x for i, x in enumerate(state.model.steps) if i != least)
        model = replace(state.model, steps=steps)
        x = np.concatenate([state.x[: DELAY + 1], np.zeros(model.size - DELAY - 1)])
        state = State.of(state.data, model, x, state.spans)


def _significance(state: State, i: int) -> float:
    where = state.model.slices[f"step {i}"]
    x, covariance = state.x[where], state.fit.covariance[where, where]
    return float(x @ regularized_inverse(covariance) @ x) / len(x)


def _ramp_middle(
    state: State, kinds: Sequence[Sequence[str]], first: int, k: int, span: tuple[float, float]
) -> float:
    data, at = state.data, first + sum(len(both) for both in kinds[:k])
    own = range(at, at + len(kinds[k]))
    rows = np.flatnonzero(data.used & in_spans(data, (span,)))
    if not len(rows):
        return 0.5 * (span[0] + span[1])

    def left(time: float) -> Array:
        times = tuple(time if i in own else x.time for i, x in enumerate(state.model.steps))
        y = data.with_steps(times)[rows][:, state.model.columns]
        return np.asarray(y @ state.fit.residual.T)

    before = left(span[1] + data.dt)
    whole = before - left(span[0] - data.dt)
    weight = 1.0 / np.maximum(data.white, 1e-12) ** 2
    share = (before * whole) @ weight / np.maximum((whole * whole) @ weight, 1e-12)
    done = float(np.clip(share, 0.0, 1.0).mean())
    return span[1] - done * (span[1] - span[0])


def _refine_time(state: State, kind: str, time: float) -> State:
    def at(time: float, start: Array | None = None) -> State:
        model = replace(state.model, steps=(*state.model.steps, Step(kind, time)))
        return state.extended(model, start)

    best = at(time)
    for share in _REFINEMENTS:
        for _ in range(_REFINEMENT_STEPS):
            now = best.model.steps[-1].time
            tried = [at(now + sign * share * state.data.dt, best.x) for sign in (-1.0, 1.0)]
            better = max(tried, key=lambda x: x.likelihood)
            if not better.likelihood > best.likelihood + 1e-3:
                break
            best = better
    return best


def _is_step_significant(state: State, i: int) -> bool:
    where = state.model.slices[f"step {i}"]
    values = state.x[where]
    deviations = np.sqrt(np.diag(state.fit.covariance[where, where]))
    if state.model.steps[i].kind == "offsets":
        clear = np.abs(values) > _SIGNIFICANT * deviations
        return bool((clear & (np.abs(values) > _NOISE_LEVELS * state.data.white)).any())
    mass = max(abs(state.x[6]), 1e-3)
    heavier = abs(values[0]) > max(_SIGNIFICANT * deviations[0], _MASS_SHARE * mass)
    size, moment = np.linalg.norm(values[1:4]), np.linalg.norm(deviations[1:4])
    moved = size > max(2.0 * _SIGNIFICANT * moment, _SMALLEST_ARM_M * mass)
    return bool(heavier or moved)
