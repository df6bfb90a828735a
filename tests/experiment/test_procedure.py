"""Sequence of an experiment: order, estimates, and continuation after a kill."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.live.experiment.design import (
    ApparentMass,
    Condition,
    ContactDetection,
    Experiment,
    LoadExperiment,
    PegInSlot,
)
from drake_teleop.live.experiment.procedure import IntervalResult, Procedure, plan_trials
from drake_teleop.live.experiment.psychometrics import PsiMethod, correct_answer_probability
from drake_teleop.live.experiment.store import TrialStore, open_trial_store

SMALL = Experiment(
    tasks=[ContactDetection(trials=6, practice=2), ApparentMass(trials=5), PegInSlot(trials=2)],
    conditions=[
        Condition(name="a"),
        Condition(name="b", sigma=1.0),
        Condition(name="c", gamma=2.0),
    ],
)


SHORT = dataclasses.replace(
    SMALL, tasks=[ContactDetection(trials=5, practice=1)], conditions=SMALL.conditions[:2]
)


def run_participant(procedure: Procedure, rng, threshold: float, most: int = 10_000) -> None:
    """Run a participant whose answers depend on the level, or until a number of trials."""
    while procedure.phase != "end" and procedure.num_completed_trials < most:
        if procedure.phase == "interval":
            force = 5.0 if isinstance(procedure.task, ContactDetection) else 50.0
            result = IntervalResult(procedure.current_level, force, done=True, time_s=1.0)
            procedure.finish_interval(result)
        elif procedure.phase == "gap":
            procedure.start_second_interval()
        elif procedure.phase == "answer":
            p = correct_answer_probability(procedure.level, threshold, 1.5, 0.0)
            signal = procedure.trial.signal_interval
            procedure.store_answer(signal if rng.random() < p else 3 - signal, 0.5)
        else:
            procedure.advance_phase()


def test_order_is_random_and_each_round_has_every_condition_once():
    one, other = plan_trials(SMALL, 1), plan_trials(SMALL, 2)
    assert one == plan_trials(SMALL, 1) != other
    counted = [t.condition for t in one if t.task == 0 and not t.practice]
    assert all(sorted(counted[k : k + 3]) == [0, 1, 2] for k in range(0, 18, 3))
    orders = {tuple(dict.fromkeys(t.task for t in plan_trials(SMALL, n))) for n in range(30)}
    assert len(orders) == 6
    signals = [t.signal_interval for n in range(30) for t in plan_trials(SMALL, n) if t.task == 0]
    assert {t.signal_interval for t in one if t.task == 2} == {0}
    assert 0.4 < np.mean(np.array(signals) == 1) < 0.6


def test_participant_continues_with_the_same_levels(tmp_path):
    """A new process has only the folder; an unfinished trial is lost."""
    whole, cut = TrialStore(tmp_path / "whole"), TrialStore(tmp_path / "cut")
    run_participant(Procedure(SMALL, 3, whole), np.random.default_rng(1), 2.0)
    rng = np.random.default_rng(1)
    first = Procedure(SMALL, 3, cut)
    run_participant(first, rng, 2.0, most=17)
    first.advance_phase()
    first.finish_interval(IntervalResult(first.current_level))
    again = Procedure(SMALL, 3, cut)
    assert (again.phase, again.num_completed_trials) == ("consent", 17)
    run_participant(again, rng, 2.0)
    assert cut.participant_file(3).read_bytes() == whole.participant_file(3).read_bytes()
    assert len(cut.read_rows(3)) == len(plan_trials(SMALL, 3))


def run_numbered(folder: str) -> None:
    """Run a participant with answers by trial number, and print each trial."""
    with open_trial_store(Path(folder), SHORT) as store:
        procedure = Procedure(SHORT, 1, store)
        while procedure.phase != "end":
            if procedure.phase == "answer":
                right = procedure.num_completed_trials % 4 != 2
                signal = procedure.trial.signal_interval
                procedure.store_answer(signal if right else 3 - signal, 0.5)
                print(procedure.num_completed_trials, flush=True)
            elif procedure.phase == "interval":
                procedure.finish_interval(
                    IntervalResult(procedure.current_level, force_N=5.0, done=True, time_s=1.0)
                )
            elif procedure.phase == "gap":
                procedure.start_second_interval()
            else:
                procedure.advance_phase()


@pytest.mark.slow
def test_killed_experiment_keeps_finished_trials_and_continues(tmp_path):
    code = "import sys; from test_procedure import run_numbered; run_numbered(sys.argv[1])"
    command = [sys.executable, "-c", code, str(tmp_path / "cut")]
    folder = Path(__file__).parent
    process = subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    message = next(int(line) for line in process.stdout if int(line) >= 4)
    process.kill()
    process.communicate()
    cut = TrialStore(tmp_path / "cut")
    left = len(cut.read_rows(1))
    assert message <= left < len(plan_trials(SHORT, 1))
    run_numbered(str(tmp_path / "cut"))
    run_numbered(str(tmp_path / "whole"))
    assert cut.read_rows(1) == TrialStore(tmp_path / "whole").read_rows(1)


def test_practice_is_not_evaluated_and_a_trial_without_contact_is_repeated(tmp_path):
    procedure = Procedure(SMALL, 1, TrialStore(tmp_path))
    before = procedure.num_completed_trials
    procedure.advance_phase(), procedure.advance_phase(), procedure.advance_phase()
    assert procedure.phase == "interval"
    procedure.store_answer(1, 0.1)  # not in the phase of an answer
    procedure.finish_interval(IntervalResult(valid=False))
    assert (procedure.phase, procedure.is_repeated, procedure.num_completed_trials) == (
        "ready",
        True,
        before,
    )
    run_participant(procedure, np.random.default_rng(0), 2.0)
    counted = [row for row in TrialStore(tmp_path).read_rows(1) if not row.practice]
    assert len(counted) == 3 * (6 + 5 + 2)


def test_expected_contact_force_is_the_median_of_contact_trials(tmp_path):
    few = [ContactDetection(trials=1, practice=0), *SMALL.tasks[1:]]
    procedure = Procedure(dataclasses.replace(SMALL, tasks=few), 1, TrialStore(tmp_path))
    run_participant(procedure, np.random.default_rng(0), 2.0)
    assert procedure.expected_contact_force == 5.0


def test_view_of_a_trial_is_independent_of_the_condition(tmp_path):
    def views(names: list[int]) -> list[dict]:
        conditions = [SMALL.conditions[k] for k in names]
        other = dataclasses.replace(SMALL, conditions=conditions)
        procedure = Procedure(other, 1, TrialStore(tmp_path / str(names)))
        seen = []
        while procedure.phase != "end" and procedure.num_completed_trials < 12:
            seen.append(procedure.page_state())
            if procedure.phase == "interval":
                procedure.finish_interval(IntervalResult(procedure.current_level))
            elif procedure.phase == "gap":
                procedure.start_second_interval()
            elif procedure.phase == "answer":
                procedure.store_answer(procedure.trial.signal_interval, 0.5)
            else:
                procedure.advance_phase()
        return seen

    assert views([0, 1, 2]) == views([2, 0, 1])
    assert not {"condition", "level", "signal"} & set(views([0, 1, 2])[0])


def test_folder_of_another_experiment_and_damaged_file_are_errors(tmp_path):
    with open_trial_store(tmp_path, SMALL) as store:
        with pytest.raises(DrakeTeleopError, match="another process"):
            open_trial_store(tmp_path, SMALL).__enter__()
        run_participant(Procedure(SMALL, 1, store), np.random.default_rng(0), 2.0, most=3)
        assert store.trials_table().shape == (3, 12)
        text = store.participant_file(1).read_text()
        for damaged in (text[:-30], text.replace("\n1,", "\n7,"), "trial\nx"):
            store.participant_file(1).write_text(damaged)
            with pytest.raises(DrakeTeleopError, match=r"01\.csv"):
                store.read_rows(1)
    with pytest.raises(DrakeTeleopError, match="another study"):
        open_trial_store(tmp_path, dataclasses.replace(SMALL, seed=1)).__enter__()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("tasks: []", "tasks: is empty"),
        ("tasks: [!PegInSlot {scenario: touch}]\nconditions: [{name: a}]", "has no slot"),
        (
            "tasks: [!PegInSlot {scenario: gone}]\nconditions: [{name: a}]",
            r":tasks\[0\]\.scenario: there is no scenario",
        ),
        ("tasks: [!Juggling {}]\nconditions: [{name: a}]", "Juggling"),
        (
            "tasks: [!ApparentMass {low: 0.1, high: 0.1}]\nconditions: [{name: a}]",
            "0.1 is less than twice low, 0.1: the range is too small",
        ),
        (
            "tasks: [!ApparentMass {}]\nconditions: [{name: a}, {name: a}]",
            "'a' is empty, or the name of an earlier",
        ),
        ("tasks: [!ApparentMass {}]\nconditions: [{name: a, sigma: 1, eta: 0.5}]", "eta"),
        ("tasks: [!ApparentMass {}]\nconditions: [{name: a, network: moon}]", "moon"),
    ],
)
def test_invalid_file_is_an_error_with_its_field(tmp_path, text, message):
    (tmp_path / "e.yaml").write_text(text)
    with pytest.raises(DrakeTeleopError, match=rf"e\.yaml.*{message}|{message}.*e\.yaml"):
        LoadExperiment(tmp_path / "e.yaml")


def test_the_shipped_experiment_is_complete():
    experiment, scenarios = LoadExperiment("contact_and_mass")
    assert len(scenarios) == len(experiment.tasks) == 3
    assert "without your name" in experiment.consent


@pytest.mark.parametrize(("low", "high"), [(0.2, 20.0), (1.0, 8.0)])
def test_practice_has_the_largest_level_and_changes_no_estimate(tmp_path, low, high):
    task = ContactDetection(trials=2, practice=3, low=low, high=high)
    experiment = Experiment(tasks=[task], conditions=[Condition(name="a")])
    store = TrialStore(tmp_path)
    run_participant(Procedure(experiment, 1, store), np.random.default_rng(3), 1e9)
    rows, psi = store.read_rows(1), PsiMethod(low, high)
    assert not all(row.correct for row in rows[:3])
    assert [row.level for row in rows[:4]] == [high, high, high, psi.next_level()]
    psi.update_posterior(rows[3].level, bool(rows[3].correct))
    assert rows[4].level == psi.next_level()
