"""Absolute test of a fit, and search for causes if it fails (docs/theory.md)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from drake_teleop.logs.causes.candidates import (
    ORDER,
    Candidate,
    candidates,
    negative,
    plausible,
    tilted,
)
from drake_teleop.logs.causes.contacts import contact_of_steps, phases, shrunk
from drake_teleop.logs.causes.delay import free_delay
from drake_teleop.logs.causes.instants import Instants
from drake_teleop.logs.causes.model import DELAY, Model
from drake_teleop.logs.causes.state import State

ROUNDS = 4
Later = Callable[[float], Instants]
_LATE, _LATEST, _SAME, _MOVES = 5e-4, 0.3, 0.004, 4  # s
LOUD, IMPLAUSIBLE, SCORE = 1.25, 2.2, 20.0
"""Limits of the absolute test: residual over white noise, `State.probe`, `State.score`."""
_NAMED, _NEAR, _SHARE = 40.0, 25.0, 0.02
_HALF, _FIFTH, _COLOURED, _SMALLER, _CERTAIN = 0.5, 0.2, 15.0, 0.9, 1000.0
_ATTENUATED = 1.0 / 3.0
_SMOOTH = 1.35
"""Largest probe of good records."""
_STEPS, _LARGER = ("offsets", "load"), 3.0
_SMOOTH_CAUSES = ("axes", "gravity", "weight", "torque factor", "contact")
"""Causes whose misfit may be as smooth as coloured noise."""
_FLEXIBLE, _WIDE, _WIDE_SHARE = ("cable", "drift"), 80.0, 0.1
"""Causes with many columns, which resemble others; required margins of their scores."""


def explained(state: State) -> bool:
    """Return whether the residual is sensor noise: size, smooth columns, extensions."""
    if negative(state) or state.loudness > LOUD or state.probe > IMPLAUSIBLE:
        return False
    model = state.model
    parts = ["frame", "linear drift", "rotation"]
    if state.data.gravity_W is not None:
        parts += ["gravity", "weight"]
    larger = [model.extended(name) for name in parts if name not in model.parts]
    larger += [replace(model, gains=(*model.gains, c)) for c in range(6) if c not in model.gains]
    return all(state.score(x) < SCORE for x in larger)


Found = tuple[State, float, list[Candidate]]


def search(data: Instants, later: Later | None = None, given: tuple[str, ...] = ()) -> Found:
    """Return the model that explains a record, additional delay [s], and the last rejected
    candidates.

    If nothing explains the record, the search is repeated with the delay from `free_delay`,
    because a wrong model may have caused a wrong delay. `later` returns the record with additional
    delay [s].
    """
    found = _search(_begun(data, given), 0.0, later)
    if later is None or settled(found[0]) or explained(found[0]):
        return found
    late = free_delay(data)
    if abs(late - found[1]) < _SAME:
        return found
    other = _search(_begun(later(late), given), late, later)
    better = explained(other[0]) or other[0].likelihood > found[0].likelihood + _NAMED
    return other if better else found


def settled(state: State) -> bool:
    """Return whether the residual may be coloured noise: no smooth signal explains it."""
    return state.probe < _SMOOTH and state.loudness < _COLOURED


def clearly_wrong(state: State) -> bool:
    """Return whether smooth signals explain the residual, or it exceeds coloured noise."""
    return state.probe > IMPLAUSIBLE or state.loudness > _COLOURED


def _begun(data: Instants, given: tuple[str, ...]) -> State:
    state = State.of(data, Model(parts=given))
    start = tilted(state) if "gravity" in given else None
    return state if start is None else State.of(data, state.model, start)


def _search(state: State, late: float, later: Later | None) -> Found:
    state, late = _in_time(state, late, later)
    last: list[Candidate] = []
    for number in range(ROUNDS):
        if explained(state):
            return state, late, []
        found = _without_attenuation(list(candidates(state, first=number == 0)))
        last = [x for x in found if plausible(x.state)]
        effective = [x for x in last if _effective(x, state)]
        winner = _winner(effective) or _of_smallest_residual(state, last)
        if winner is None:
            other = _phases(state, last)
            if other is None:
                break
            state, late = _in_time(other, late, later)
            continue
        larger = contact_of_steps(winner.state)
        if winner.name == "contact":
            larger = phases(larger) or shrunk(larger)
        elif larger.spans != winner.state.spans:
            larger = phases(larger) or larger
        state, late = _in_time(larger, late, later)
        last = [x for x in last if x is not winner]
        if winner.name == "cable":
            return state, late, []
    return state, late, last


def _without_attenuation(found: list[Candidate]) -> list[Candidate]:
    """Remove the cable if an attenuated inertial mass explains a third of its score.

    Noise of the accelerations attenuates it if the load hardly accelerates.
    """
    best = max((x.score for x in found if x.name == "weight" and not plausible(x.state)), default=0)
    return [x for x in found if x.name != "cable" or best < _ATTENUATED * x.score]


def _in_time(state: State, late: float, later: Later | None) -> tuple[State, float]:
    """Remove the remaining delay from the motion; the model is linear in it."""
    for _ in range(_MOVES):
        if later is None or abs(state.x[DELAY]) < _LATE or abs(late) > _LATEST:
            break
        late += float(state.x[DELAY])
        x = state.x.copy()
        x[DELAY] = 0.0
        state = State.of(later(late), state.model, x, state.spans)
    return state, late


def _of_smallest_residual(state: State, found: list[Candidate]) -> Candidate | None:
    """Return the most plausible candidate that reduces the residual to a fifth, or None."""
    calm = [x for x in found if x.name in _SMOOTH_CAUSES]
    calm = [x for x in calm if x.state.loudness < _FIFTH * state.loudness]
    least = min([x.state.loudness for x in calm], default=0.0)
    near = [x for x in calm if x.state.loudness < 2.0 * least]
    return min(near, key=lambda x: ORDER.index(x.name), default=None)


def _phases(state: State, found: list[Candidate]) -> State | None:
    for candidate in found:
        if candidate.name == "contact" and candidate.state.loudness < _HALF * state.loudness:
            return phases(candidate.state)
    return None


def _effective(candidate: Candidate, state: State) -> bool:
    other = candidate.state
    smaller = other.loudness < _SMALLER * state.loudness
    if candidate.name == "cable":
        return smaller  # the force of a cable far exceeds the noise
    if candidate.name not in _STEPS and other.loudness > _LARGER * state.loudness:
        return False  # the candidate increases the residual, and coloured noise predicts it
    better = smaller or other.probe < _SMALLER * state.probe
    return bool(better or negative(state) or candidate.score > _CERTAIN)


def _winner(found: list[Candidate]) -> Candidate | None:
    """Return the most plausible candidate with nearly the best score and a small misfit."""
    best = max([x.score for x in found], default=0.0)
    if best < _NAMED:
        return None
    top = max(found, key=lambda x: x.score).name
    margin = max(_NEAR, _SHARE * best) if top not in _FLEXIBLE else max(_WIDE, _WIDE_SHARE * best)
    near = [x for x in found if x.score > max(_NAMED, best - margin)]
    first = min(near, key=lambda x: ORDER.index(x.name))
    return first if first.score > _NAMED * max(1.0, first.state.probe / _SMOOTH) ** 1.5 else None
