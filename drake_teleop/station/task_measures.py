"""Measures of a simulated operator's task, from the log of one run (docs/operator.md)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.station.operator import decision
from drake_teleop.station.operator.task import TASK_MEASURE_NAMES, Insert, Press, Reach, Task, Touch
from drake_teleop.station.result import SimulationResult
from drake_teleop.station.scenario import Scenario
from drake_teleop.station.slave.arm import forward_kinematics
from drake_teleop.station.slave.plant import NominalSlave

_SLOT_FLOOR_TOLERANCE_M = 2e-3  # m
_TASK_PHASE_TEXTS = {
    decision.PHASE_MOVING: "moving to the target",
    decision.PHASE_APPROACHING: "approaching the contact",
    decision.PHASE_STOPPING: "stopped after contact",
    decision.PHASE_PRESSING: "pressing",
    decision.PHASE_SEARCHING_SLOT: "searching for the slot",
}


def task_measures(result: SimulationResult, scenario: Scenario) -> dict[str, float]:
    """Return the measures of the operator's task in one run (docs/operator.md).

    A DrakeTeleopError is raised for a scenario without task or a log without samples.
    """
    task = scenario.operator.task
    if task is None:
        what = "the scenario has no operator's task to measure"
        remedy = "give the operator a task: !Reach, !Touch, !Press or !Insert"
        raise DrakeTeleopError(what, where="operator.task", remedy=remedy)
    if not len(result.t):
        remedy = "increase simulation.duration or rates.log_hz, or reduce simulation.settle"
        raise DrakeTeleopError("the log contains no samples", where="task", remedy=remedy)
    state, t, ended = result["task_state"], result.t, _log_row_at_task_end(result)
    begun = int(np.argmax(state[:, decision.PHASE_INDEX] != decision.PHASE_WAITING))
    span = slice(begun, ended + 1)
    done = ended > 0 and state[ended, decision.OUTCOME_INDEX] > 0.0
    force = true_contact_force_magnitudes(result)
    held = np.empty(0)
    if done and isinstance(task, Press):
        held = _contact_forces_during_hold(t, force, task, ended)
    wanted = _required_contact_force(task)
    hand, twist = result["hand_wrench_E"][span], result["twist_master"][span]
    power = np.abs(np.sum(hand * twist, axis=1))
    noticed, touching = state[span, decision.CONTACT_PERCEIVED_INDEX] > 0.0, force[span] > 0.0
    # The log may start after the start of the task.
    taken = float(t[ended]) + scenario.simulation.settle - task.t_start
    success = done and not _unmet_criterion(result, scenario, task, ended)
    measures_of_success = {
        "task_time_s": taken,
        "contact_force_overshoot_N": max(float(force[span].max()) - wanted, 0.0),
        "effort_Ns": float(np.trapezoid(np.linalg.norm(hand[:, :3], axis=1), t[span])),
        "task_work_J": float(np.trapezoid(power, t[span])),
        "press_error_N": float(np.sqrt(np.mean((held - wanted) ** 2))) if held.size else math.nan,
    }
    if not success:
        measures_of_success = dict.fromkeys(measures_of_success, math.nan)
    figures = measures_of_success | {
        "success": float(success),
        "detection_time_s": detection_delay(t[span], touching, noticed),
        "false_notices": float(_count_false_detections(touching, noticed)),
    }
    return {name: figures[name] for name in TASK_MEASURE_NAMES}


def task_failure(result: SimulationResult, scenario: Scenario) -> str:
    """Return the reason why the task failed (timeout, given up, not achieved); "" after success."""
    task, state, ended = scenario.operator.task, result["task_state"], _log_row_at_task_end(result)
    assert task is not None
    at, outcome = float(result.t[ended]), state[ended, decision.OUTCOME_INDEX]
    if outcome != 0.0 and ended == 0:
        return "the task ended before the log begins; set a shorter simulation.settle"
    if outcome > 0.0:
        wrong = _unmet_criterion(result, scenario, task, ended)
        return f"the operator finished at {at:.2f} s, but {wrong}" if wrong else ""
    phase = int(state[ended if outcome == 0.0 else max(ended - 1, 0), decision.PHASE_INDEX])
    if phase == decision.PHASE_WAITING:
        return f"the task begins at {task.t_start:g} s, when the simulation has ended"
    taken = at + scenario.simulation.settle - task.t_start
    found = f"{_TASK_PHASE_TEXTS[phase]}, {_force_and_position_text(result, scenario, task, ended)}"
    if outcome == 0.0:
        return (
            f"the simulation ended after {taken:.2f} s of the task, while the operator was {found};"
            " set a longer simulation.duration"
        )
    if taken >= task.timeout:
        return (
            f"the operator gave up at {at:.2f} s, after the {task.timeout:g} s of its timeout,"
            f" while {found}; set a longer operator.task.timeout, or find the cause"
        )
    return (
        f"the operator gave up at {at:.2f} s: it saw the tool far beyond the surface and detected"
        f" no contact, {_force_and_position_text(result, scenario, task, ended)}"
    )


def _log_row_at_task_end(result: SimulationResult) -> int:
    outcome = result["task_state"][:, decision.OUTCOME_INDEX]
    return int(np.argmax(outcome != 0.0)) if outcome.any() else len(outcome) - 1


def _required_contact_force(task: Task) -> float:
    if isinstance(task, Press):
        return task.force
    return task.push if isinstance(task, Insert) else 0.0


def true_contact_force_magnitudes(result: SimulationResult) -> Array:
    """Return (N,) magnitude of the true contact force at the tool [N]; zeros if not recorded."""
    if "true_contact_wrench_W" not in result:
        return np.zeros(len(result.t))
    return np.linalg.norm(result["true_contact_wrench_W"][:, :3], axis=1)


def detection_delay(t: Array, touching: NDArray[np.bool_], noticed: NDArray[np.bool_]) -> float:
    """Return the time from the first contact to the next detection [s]; nan if one is missing."""
    if not touching.any():
        return math.nan
    contact = int(np.argmax(touching))
    after = noticed[contact:]
    return float(t[contact + int(np.argmax(after))] - t[contact]) if after.any() else math.nan


def _count_false_detections(touching: NDArray[np.bool_], noticed: NDArray[np.bool_]) -> int:
    before = int(np.argmax(touching)) if touching.any() else len(touching)
    return int(np.count_nonzero(np.diff(noticed[:before].astype(int), prepend=0) == 1))


def _contact_forces_during_hold(t: Array, force: Array, task: Press, row: int) -> Array:
    return force[: row + 1][t[: row + 1] >= t[row] - task.hold]


def _unmet_criterion(result: SimulationResult, scenario: Scenario, task: Task, row: int) -> str:
    force = true_contact_force_magnitudes(result)
    if isinstance(task, Press):
        held = float(_contact_forces_during_hold(result.t, force, task, row).mean())
        if abs(held - task.force) <= task.tolerance:
            return ""
        return f"the tool pressed with {held:.2f} N, not {task.force:g} ± {task.tolerance:g} N"
    if isinstance(task, Touch) and force[row] > 0.0:
        return ""
    off = _tip_error_W(result, scenario, task, row)
    if isinstance(task, Insert):
        above = off[2] + task.depth
        wrong = f"the tip is {1e3 * above:.1f} mm above the floor"
        return "" if above <= _SLOT_FLOOR_TOLERANCE_M else wrong
    away = float(np.linalg.norm(off))
    if isinstance(task, Touch):
        return f"the tool touches nothing, the tip {1e3 * away:.1f} mm from the target"
    if away <= task.width / 2:
        return ""
    return f"the tip is {1e3 * away:.1f} mm from the target, not {500 * task.width:g} mm"


def _force_and_position_text(
    result: SimulationResult, scenario: Scenario, task: Task, row: int
) -> str:
    away = 1e3 * np.linalg.norm(_tip_error_W(result, scenario, task, row))
    place = f"the tip {away:.1f} mm from the target"
    if isinstance(task, Reach):
        return place
    required, force = _required_contact_force(task), true_contact_force_magnitudes(result)[row]
    instead = f" instead of {required:g} N" if required else ""
    return f"{place}, {force:.1f} N at the tool{instead}"


def _tip_error_W(result: SimulationResult, scenario: Scenario, task: Task, row: int) -> Array:
    slave = NominalSlave(scenario.slave)
    R_WS, p_WS = np.empty((3, 3)), np.empty(3)
    joints = result["slave_state"][row, : slave.arm.num_joints]
    forward_kinematics(slave.arm.table, joints, R_WS, p_WS)
    off: Array = p_WS + R_WS @ slave.tip - slave.p_WTip_start - np.array(task.translation)
    return off
