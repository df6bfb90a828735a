"""Explanation of a wrench: noise test, search for causes, and the resulting load."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drake_teleop.common.numeric import Array, one_blas_thread
from drake_teleop.logs.causes.cause import Cause, Stretch, causes_of, stretches
from drake_teleop.logs.causes.instants import Instants
from drake_teleop.logs.causes.intervals import (
    block_deviations,
    covariance_of,
    factor_covariance,
    gain_covariance,
    misfit_deviations,
)
from drake_teleop.logs.causes.model import DELAY, LOAD
from drake_teleop.logs.causes.search import (
    WithDelay,
    is_clear_misfit,
    is_noise,
    may_be_coloured_noise,
    search,
)
from drake_teleop.logs.causes.state import State

_NO_MASS, _NO_MASS_DEVIATIONS, _SIGNIFICANT = 0.010, 4.0, 20.0


@dataclass(frozen=True, eq=False)
class Explanation:
    """Causes why a rigid load does not explain a wrench, and the load when they are in the model.

    Attributes:
        explained: whether the residual is sensor noise.
        theta: (16,) [offsets; phi] of the first part of the record [SI].
        covariance: (16, 16) of theta.
        deviations: (16,) standard deviations of theta due to the misfit.
        delay_s: additional delay of the motion behind the wrench [s].
        loads: parts of a record whose load changes.
        removed_weight: (4,) [m, m c] of a weight removed from the wrench, or None.
        given: extensions of the model that are no causes.
    """

    causes: tuple[Cause, ...]
    explained: bool
    theta: Array
    covariance: Array
    deviations: Array
    delay_s: float
    loads: tuple[Stretch, ...]
    removed_weight: Array | None
    state: State
    given: tuple[str, ...] = ()

    @property
    def misfit(self) -> bool:
        """Whether the residual is clearly not noise, not even coloured noise."""
        return not self.explained and is_clear_misfit(self.state)

    @property
    def several_gains(self) -> bool:
        """Whether gain errors of single channels stand for errors of the whole gain matrix."""
        model = self.state.model
        others = {"rotation", "cable"} & set(model.parts)
        return len(model.gains) > 1 or bool(model.gains and others)


def explain(
    data: Instants, with_delay: WithDelay | None = None, given: tuple[str, ...] = ()
) -> Explanation:
    """Test whether a rigid load explains a record, and search for causes if it does not.

    `with_delay` returns the record with an additional delay [s]; `given` are extensions of the
    model, such as "weight".
    """
    with one_blas_thread():
        state, delay_s, rejected = search(data, with_delay, given)
        blocks = block_deviations(state)
        gains = gain_covariance(state) + factor_covariance(state)
        covariance = covariance_of(state, rejected, blocks, gains)
        causes = causes_of(state, given)
        only_noise = is_noise(state)
        if (
            not causes
            and (only_noise or may_be_coloured_noise(state))
            and _no_load(state, covariance)
        ):
            causes = [_no_load_cause(state, covariance)]
        removed = None
        if "weight" in state.model.parts:
            removed = state.x[state.model.slices["weight"]]
        return Explanation(
            causes=tuple(causes),
            explained=only_noise,
            theta=state.x[LOAD],
            covariance=covariance,
            deviations=misfit_deviations(state, rejected, blocks, gains),
            delay_s=delay_s + float(state.x[DELAY]),
            loads=tuple(stretches(state, covariance)),
            removed_weight=removed,
            state=state,
            given=given,
        )


def _no_load(state: State, covariance: Array) -> bool:
    mass, deviation = abs(float(state.x[6])), float(np.sqrt(covariance[6, 6]))
    least = max(_NO_MASS_DEVIATIONS * deviation, min(_NO_MASS, _SIGNIFICANT * deviation))
    return bool(mass < least and deviation < 0.1)


def _no_load_cause(state: State, covariance: Array) -> Cause:
    most = abs(float(state.x[6])) + 1.96 * float(np.sqrt(covariance[6, 6]))
    return Cause(
        "no load",
        f"there is no load above {1e3 * most:.2g} g on the sensor: the record gives its offsets",
        values={"mass_limit": most},
    )
