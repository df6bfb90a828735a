"""Task measures compared with closed forms on a synthetic log."""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest

from drake_teleop.lab.identification import slave_arm
from drake_teleop.station.operator.decision import (
    PHASE_APPROACHING,
    PHASE_MOVING,
    PHASE_OVER,
    PHASE_PRESSING,
    PHASE_SEARCHING_SLOT,
    PHASE_WAITING,
    STATE_SIZE,
)
from drake_teleop.station.operator.operator import OperatorConfig
from drake_teleop.station.operator.task import TASK_MEASURE_NAMES, Insert, Press, Reach, Touch
from drake_teleop.station.result import SimulationResult
from drake_teleop.station.scenario import Scenario, replace
from drake_teleop.station.signals import SIGNALS
from drake_teleop.station.slave.home import home_posture
from drake_teleop.station.task_measures import task_failure, task_measures

T = np.arange(0.0, 4.0 + 1e-9, 1e-3)
START, END, CONTACT, NOTICED = 0.5, 3.0, 1.5, 1.75  # s, in the log
SETTLE = 0.25


@functools.cache  # compiled in the test, not by each worker during collection
def home():
    return home_posture(slave_arm(Scenario()), Scenario().slave.position)


def measures(task, **log):
    return task_measures(*run(task, **log))


def run(
    task, *, done: float = 1.0, force: float = 6.0, early: bool = False, phase: int = PHASE_MOVING
):
    """Return a log with a hand force of 2 N at 0.1 m/s back and forth, and contact from CONTACT on.

    The hand's torque of 0.5 N m turns the stylus at 0.06 rad/s. The tool stays at its start.
    """
    state = np.zeros((len(T), STATE_SIZE))
    state[T >= START, 0] = phase
    if done:
        state[T >= END, :2] = PHASE_OVER, done
    state[T >= NOTICED, 2] = 1.0
    if early:
        state[(T >= 1.0) & (T < 1.2), 2] = 1.0
    hand, twist, contact = np.zeros((len(T), 6)), np.zeros((len(T), 6)), np.zeros((len(T), 6))
    hand[:, 1], hand[:, 5] = 2.0, 0.5
    twist[:, [1, 5]] = np.where(T[:, None] < 2.0, 1.0, -1.0) * [0.1, 0.06]
    contact[T >= CONTACT, 2:4] = force, 40.0
    signals = {
        "task_state": state,
        "hand_wrench_E": hand,
        "twist_master": twist,
        "true_contact_wrench_W": contact,
        "slave_state": np.tile([*home(), *np.zeros(6)], (len(T), 1)),
    }
    result = SimulationResult(T, signals, [SIGNALS[name] for name in signals])
    operator = OperatorConfig(task=task)
    return result, replace(Scenario(), operator=operator, simulation__settle=SETTLE)


def test_measures_of_a_touch():
    found = measures(Touch(t_start=START + SETTLE))
    assert tuple(found) == TASK_MEASURE_NAMES
    assert found["success"] == 1.0
    assert found["task_time_s"] == pytest.approx(END - START)
    assert found["contact_force_overshoot_N"] == pytest.approx(6.0)
    assert found["effort_Ns"] == pytest.approx(2.0 * (END - START))
    # Both directions cost effort: the net work would be less.
    assert found["task_work_J"] == pytest.approx(0.23 * (END - START))
    assert found["detection_time_s"] == pytest.approx(NOTICED - CONTACT)
    assert found["false_notices"] == 0.0
    assert math.isnan(found["press_error_N"])
    assert measures(Touch(t_start=START + SETTLE), early=True)["false_notices"] == 1.0


def test_measures_of_a_press():
    found = measures(Press(t_start=START + SETTLE, force=5.0, tolerance=2.0, hold=1.0))
    assert found["success"] == 1.0
    assert found["contact_force_overshoot_N"] == pytest.approx(1.0)
    assert found["press_error_N"] == pytest.approx(1.0)


def test_failed_task_has_nan_measures():
    """The task was given up, or ended without success."""
    for found in (
        measures(Press(force=5.0, tolerance=0.5)),
        measures(Press(force=5.0, tolerance=2.0), done=-1.0),
    ):
        assert found["success"] == 0.0
        missing = {name for name, value in found.items() if math.isnan(value)}
        assert missing == set(TASK_MEASURE_NAMES) - {"success", "detection_time_s", "false_notices"}


def test_measures_of_a_given_up_task():
    found = measures(Touch(), done=-1.0, force=0.0)
    assert found["success"] == 0.0
    assert math.isnan(found["task_time_s"]) and math.isnan(found["detection_time_s"])


AT = {"t_start": START + SETTLE}
FAR = "the tip 100.0 mm from the target"
FAILURES = {
    # The operator reports success, the true state differs.
    "at 3.00 s, but the tool pressed with 6.00 N, not 5 ± 0.5 N": (
        Press(force=5.0, tolerance=0.5),
        {},
    ),
    f"but the tool touches nothing, {FAR}": (Touch(), {"force": 0.0}),
    "but the tip is 100.0 mm from the target, not 5 mm": (Reach(), {}),
    "but the tip is 140.0 mm above the floor": (Insert(), {}),
    # The operator gives up.
    f"at 3.00 s, after the 2.5 s of its timeout, while pressing, {FAR}, 6.0 N at the tool instead"
    " of 8 N": (Press(**AT, timeout=2.5), {"done": -1.0, "phase": PHASE_PRESSING}),
    f"at 3.00 s: it saw the tool far beyond the surface and detected no contact, {FAR}, 0.0 N": (
        Touch(**AT),
        {"done": -1.0, "phase": PHASE_APPROACHING, "force": 0.0},
    ),
    # The log ends before the task.
    f"after 3.50 s of the task, while the operator was searching for the slot, {FAR}": (
        Insert(**AT),
        {"done": 0.0, "phase": PHASE_SEARCHING_SLOT},
    ),
    f"moving to the target, {FAR}; set a longer": (Reach(**AT), {"done": 0.0}),
    "begins at 7 s, when the simulation has ended": (
        Reach(t_start=7.0),
        {"done": 0.0, "phase": PHASE_WAITING},
    ),
}


@pytest.mark.parametrize("said", FAILURES)
def test_failure_text_gives_the_reason(said):
    task, log = FAILURES[said]
    result, scenario = run(task, **log)
    assert said in task_failure(result, scenario)
    assert task_measures(result, scenario)["success"] == 0.0


@pytest.mark.parametrize("done", [1.0, -1.0])
@pytest.mark.parametrize("first", [int(1000 * END), int(1000 * END) + 400])
def test_task_that_ends_before_the_log_has_no_measures(done, first):
    result, scenario = run(Touch(**AT), done=done)
    late = result[first:]
    text = "the task ended before the log begins; set a shorter simulation.settle"
    assert task_failure(late, scenario) == text
    found = task_measures(late, scenario)
    assert found["success"] == 0.0 and math.isnan(found["task_time_s"])


def test_successful_task_has_no_failure_text():
    for task in (Touch(), Press(force=5.0, tolerance=2.0), Reach(translation=[0, 0, 0])):
        assert task_failure(*run(task)) == ""
