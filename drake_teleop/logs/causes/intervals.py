"""Covariance of a load that counts what the model leaves unexplained.

The covariance of generalised least squares holds for stationary noise. Leaving out each of twelve
parts of the record shows the rest: with f the root mean square of block deviation over stated
deviation, all sixteen deviations grow by f / 1.15 if f > 1.5. A probe above 1.35 widens all of
them further, and every candidate that the search rejected adds its distance from the estimate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from drake_teleop.load.arrays import Array
from drake_teleop.load.identification import natural_scale
from drake_teleop.logs.causes.candidates import Candidate
from drake_teleop.logs.causes.fit import inverted
from drake_teleop.logs.causes.model import LOAD
from drake_teleop.logs.causes.rows import Rows
from drake_teleop.logs.causes.state import State

_GROUPS = 12
_TOLERATED, _USUAL = 1.5, 1.15
_PROBE, _PROBE_SLOPE = 1.35, 3.0
_CONSIDERED, _BELIEVED = 6.0, 15.0


def covariance_of(state: State, rejected: Sequence[Candidate] = ()) -> Array:
    """(16, 16) of [offsets; phi], widened by what the model leaves unexplained."""
    out = state.fit.covariance[LOAD, LOAD].copy()
    deviations = np.sqrt(np.diag(out))
    blocks = block_deviations(state)
    factor = misfit_factor(state, blocks)
    final = np.maximum(factor * deviations, blocks)
    squares = final**2
    for candidate in rejected:
        if candidate.score > _CONSIDERED:
            other = candidate.state
            own = np.diag(other.fit.covariance)[LOAD]
            apart = (other.x[LOAD] - state.x[LOAD]) ** 2 + own
            squares = squares + min(1.0, candidate.score / _BELIEVED) * apart
    ratio = np.sqrt(squares) / deviations
    return np.asarray(out * np.outer(ratio, ratio))


def misfit_factor(state: State, blocks: Array) -> float:
    """Factor of all deviations; 1 where the residual is stationary noise."""
    deviations = np.sqrt(np.diag(state.fit.covariance)[LOAD])
    shown = deviations < natural_scale(state.x[6:16])
    factor = 1.0
    if shown.any():
        spread = float(np.sqrt(np.mean((blocks[shown] / deviations[shown]) ** 2)))
        factor = spread / _USUAL if spread > _TOLERATED else 1.0
    return factor * (1.0 + _PROBE_SLOPE * max(0.0, state.probe - _PROBE))


def block_deviations(state: State) -> Array:
    """(16,) deviations by leaving out each of twelve parts of the record (jackknife)."""
    rows = state.rows
    at = np.array_split(np.flatnonzero(rows.used), _GROUPS)
    whole, right = state.fit.normal(state.model, state.x)
    moves = []
    for part in at:
        used = np.zeros(len(rows.used), bool)
        used[part] = True
        few = Rows(rows.data, used, rows.times, rows.columns)
        gram, pull = replace(state.fit, rows=few).normal(state.model, state.x)
        moves.append((inverted(whole - gram) @ (right - pull))[LOAD])
    spread = np.array(moves) - np.mean(moves, axis=0)
    return np.asarray(np.sqrt((_GROUPS - 1.0) / _GROUPS * np.sum(spread**2, axis=0)))
