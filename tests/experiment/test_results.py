"""Results of participants with a known threshold."""

from __future__ import annotations

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest
from test_procedure import SMALL, run_participant

from drake_teleop.cli.experiment import experiment_command, next_participant
from drake_teleop.common.style import Picture
from drake_teleop.live.experiment import guided, simulated
from drake_teleop.live.experiment.apparatus import make_apparatus
from drake_teleop.live.experiment.design import Condition, ContactDetection, Experiment, PegInSlot
from drake_teleop.live.experiment.procedure import IntervalResult, Procedure, plan_trials
from drake_teleop.live.experiment.results import (
    ResultRow,
    _draw_results,
    compute_results,
    write_results,
)
from drake_teleop.live.experiment.simulated import with_noise_seed_of_interval
from drake_teleop.live.experiment.store import TrialRow, TrialStore
from drake_teleop.station.result import SimulationResult
from drake_teleop.station.scenario import LoadScenario, Scenario
from drake_teleop.station.signals import signal_with_size

CONTACT = "threshold of contact [N at the tool]"


def test_table_contains_the_true_thresholds(tmp_path):
    experiment = Experiment(tasks=[ContactDetection(trials=40)], conditions=[Condition(name="a")])
    store, rng = TrialStore(tmp_path), np.random.default_rng(2)
    for number in range(1, 6):
        run_participant(Procedure(experiment, number, store), rng, 2.0)
    found = [r for r in compute_results(experiment, store) if r.quantity == CONTACT]
    each = [r for r in found if r.participant]
    assert len(each) == 5 and {r.trials for r in each} == {40}
    assert sum(r.low <= 2.0 <= r.high for r in each) >= 4
    for over in (r for r in found if not r.participant):
        assert over.low < 2.0 < over.high < 2.0 * over.low


def test_intervals_have_different_random_numbers():
    seeds = {
        with_noise_seed_of_interval(
            Scenario(),
            SimpleNamespace(
                num_completed_trials=trial,
                interval=k,
                participant=person,
                experiment=Experiment(seed=seed),
            ),
        ).simulation.seed
        for trial in range(4)
        for k in (1, 2)
        for person in (1, 2)
        for seed in (0, 1)
    }
    assert len(seeds) == 32


def test_simulated_insertion_averages_the_contact_force_over_20_ms_as_for_people(monkeypatch):
    base, contact = LoadScenario("insert"), np.zeros((200, 6))
    contact[100, 2], contact[:, 1] = 90.0, 3.0
    signals = {"true_contact_wrench_W": contact, "force_to_master": np.zeros((200, 6))}
    specs = [signal_with_size(name, 6) for name in signals]
    result = SimulationResult(1e-3 * np.arange(200), signals, specs)
    for name, value in (
        ("MakeTeleopStation", None),
        ("simulate", result),
        ("task_measures", {"success": 1.0, "task_time_s": 2.0}),
    ):
        monkeypatch.setattr(simulated, name, lambda *_, value=value, **__: value)
    apparatus = make_apparatus(PegInSlot(), Condition(name="a"), base, None)
    procedure = SimpleNamespace(
        num_completed_trials=0, interval=1, participant=1, experiment=Experiment(seed=0)
    )
    inserted = simulated._simulate_peg_insertion(apparatus, procedure)
    assert inserted.force_N == pytest.approx((19 * 3.0 + math.hypot(3.0, 90.0)) / 20)
    assert inserted.done and inserted.time_s == 2.0


@pytest.mark.pictures
def test_folder_contains_table_trials_and_picture(tmp_path):
    store = TrialStore(tmp_path)
    assert write_results(SMALL, store).is_empty()
    run_participant(Procedure(SMALL, 4, store), np.random.default_rng(0), 2.0)
    table = write_results(SMALL, store)
    assert {p.name for p in tmp_path.glob("*.*")} == {"results.csv", "results.png", "trials.csv"}
    share = table.filter(quantity="share of trials done", condition="a").row(0, named=True)
    # Wilson's interval of 2 of 2: z^2 / (n + z^2) from 1 down.
    assert share["low"] == pytest.approx(2.0 / (2.0 + 1.959964**2)) and share["high"] == 1.0
    time = table.filter(quantity="time to the floor [s]", condition="a").row(0, named=True)
    assert math.isclose(time["value"], 1.0)


@pytest.mark.parametrize("least, most", [(27.0, 42.0), (0.03, 0.11), (0.4, 5.0), (0.1, 40.0)])
def test_axis_of_a_quantity_has_tick_labels(least, most):
    axes = Picture(figsize=(2.9, 2.0)).subplots()
    _draw_results(
        axes, ["a"], [ResultRow("t", "a", 1, 9, CONTACT, (least * most) ** 0.5, least, most)]
    )
    low, high = axes.get_xlim()
    labels = [*axes.xaxis.get_majorticklabels(), *axes.xaxis.get_minorticklabels()]
    labels = [label for label in labels if low <= label.get_position()[0] <= high]
    assert 2 <= sum(bool(label.get_text()) for label in labels) <= 7


def test_progress_is_that_of_each_trial_also_without_answers(tmp_path, monkeypatch):
    result = IntervalResult(done=True, time_s=1.0)
    monkeypatch.setattr(simulated, "_simulate_peg_insertion", lambda *_: result)
    experiment = Experiment(tasks=[PegInSlot(trials=3)], conditions=[Condition(name="a")])
    procedure, seen = Procedure(experiment, 1, TrialStore(tmp_path)), []
    stations = {(0, 0): None}
    simulated.simulate_participant(procedure, stations, lambda *counts: seen.append(counts))
    assert sorted(set(seen)) == [(k, 4) for k in range(5)]


def test_message_of_an_experiment_without_trials_lists_no_picture(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(guided, "serve_experiment", lambda *_, **__: None)
    experiment_command("contact_and_mass", tmp_path)
    assert capsys.readouterr().out.strip().startswith(f"written {tmp_path / 'results.csv'}, from")
    assert not (tmp_path / "results.png").exists()


def test_next_participant_has_trials_left_or_is_new(tmp_path):
    store, trials = TrialStore(tmp_path), len(plan_trials(SMALL, 1))
    assert next_participant(store, trials) == 1
    run_participant(Procedure(SMALL, 1, store), np.random.default_rng(0), 2.0)
    assert next_participant(store, trials) == 2
    run_participant(Procedure(SMALL, 2, store), np.random.default_rng(0), 2.0, most=5)
    assert (next_participant(store, trials), next_participant(store, trials, 7)) == (2, 7)


def test_shares_have_arithmetic_means_and_times_geometric_ones(tmp_path):
    """Failed and practice trials have no time; t(0.975, 1) = 12.706."""
    experiment, store = (
        Experiment(tasks=[PegInSlot()], conditions=[Condition(name="a")]),
        TrialStore(tmp_path),
    )
    for number, done, time in ((1, (1, 1, 1, 0), 2.0), (2, (0, 0, 1, 0), 8.0)):
        rows = [
            TrialRow(k, "PegInSlot", "a", 0, 0.0, 0, 0, ok, time if ok else 30.0, 3.0 * time, 0.0)
            for k, ok in enumerate(done)
        ]
        rows.append(dataclasses.replace(rows[2], trial=4, practice=1, time_s=20.0))
        store.write_rows(number, rows)
    found = {(r.quantity, r.participant): r for r in compute_results(experiment, store)}
    shares = [found["share of trials done", n].value for n in (1, 2, 0)]
    assert shares == pytest.approx([0.75, 0.25, 0.5])
    times = [found["time to the floor [s]", n].value for n in (1, 2, 0)]
    assert times == pytest.approx([2.0, 8.0, 4.0])
    half = 12.706 * np.std(np.log([2.0, 8.0]), ddof=1) / np.sqrt(2.0)
    over = found["time to the floor [s]", 0]
    assert (over.low, over.high) == pytest.approx(
        (4.0 / np.exp(half), 4.0 * np.exp(half)), rel=1e-3
    )
    assert found["largest contact force [N]", 0].value == pytest.approx(12.0)
    assert {r.trials for r in found.values() if not r.participant} == {8}
