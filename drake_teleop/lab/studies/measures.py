"""Measures of one run of a study: peak forces, work of the hand, times."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.station.operator.task import TASK_MEASURE_NAMES
from drake_teleop.station.result import SimulationResult

if TYPE_CHECKING:
    from drake_teleop.station.scenario import Scenario


def _force_norms(result: SimulationResult, signal: str) -> Array:
    return np.linalg.norm(result[signal][:, :3], axis=1) if signal in result else np.zeros(1)


def _seconds_with_force_above_threshold(result: SimulationResult, threshold: float) -> float:
    above = _force_norms(result, "force_to_master") > threshold
    return float(np.trapezoid(above.astype(float), result.t))


#: Measures of every run, from its signals and the study's `force_threshold` [N].
_MEASURE_FUNCTION_BY_NAME: dict[str, Callable[[SimulationResult, float], float]] = {
    # Largest displayed force.
    "peak_force_to_master_N": lambda result, _: _force_norms(result, "force_to_master").max(),
    "rms_force_to_master_N": lambda result, _: np.sqrt(
        np.mean(np.sum(result["force_to_master"][:, :3] ** 2, axis=1))
    ),
    # Largest true force between tool and environment.
    "peak_contact_force_N": lambda result, _: _force_norms(result, "true_contact_wrench_W").max(),
    # Work of the hand on the stylus: integral of F.v + tau.omega.
    "hand_work_J": lambda result, _: np.trapezoid(
        np.sum(result["hand_wrench_E"] * result["twist_master"], axis=1), result.t
    ),
    # Time of a displayed force above the threshold.
    "time_above_force_s": _seconds_with_force_above_threshold,
}
#: Names of all measures; for those of tasks see `task_measures.py`.
MEASURES = (*_MEASURE_FUNCTION_BY_NAME, *TASK_MEASURE_NAMES)


def default_measures() -> list[str]:
    return list(_MEASURE_FUNCTION_BY_NAME)


def evaluate_measures(
    result: SimulationResult, scenario: Scenario, names: Sequence[str], force_threshold: float
) -> dict[str, float]:
    """Return the measures `names` of one run, by name; `force_threshold` is in N."""
    if "force_to_master" not in result:
        what = "the run identifies the load without a hand, so it has no measures"
        remedy = "give the operator an intent or a task, or set load_estimator.enabled: false"
        raise DrakeTeleopError(what, where="operator.intent", remedy=remedy)
    own = [name for name in names if name in _MEASURE_FUNCTION_BY_NAME]
    found = {name: float(_MEASURE_FUNCTION_BY_NAME[name](result, force_threshold)) for name in own}
    if len(own) < len(names):
        from drake_teleop.station.task_measures import task_measures

        found |= task_measures(result, scenario)
    return {name: found[name] for name in names}
