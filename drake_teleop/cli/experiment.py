"""`drake-teleop drive --study STUDY.yaml`: an experiment with people or simulated participants."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import polars as pl

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.live.experiment.design import Experiment, LoadExperiment
from drake_teleop.live.experiment.procedure import Procedure, plan_trials
from drake_teleop.live.experiment.results import write_results
from drake_teleop.live.experiment.store import MAX_PARTICIPANT_NUMBER, TrialStore, open_trial_store
from drake_teleop.station.scenario import Scenario


def experiment_command(
    study: str | Path, out: Path, *, participant: int | None = None, simulated: int = 0, **page: Any
) -> pl.DataFrame:
    """Start or continue the experiment in folder `out`; return its result table.

    `simulated` is the total number of simulated participants; 0: people take part.
    """
    experiment, scenarios = LoadExperiment(study)
    with open_trial_store(out, experiment) as store:
        try:
            if simulated:
                _simulate_participants(experiment, scenarios, store, simulated)
            else:
                from drake_teleop.live.experiment.guided import serve_experiment

                number = next_participant(store, len(plan_trials(experiment, 1)), participant)
                serve_experiment(Procedure(experiment, number, store), scenarios, **page)
        finally:
            table = write_results(experiment, store)
            picture = " and .png" if (out / "results.png").exists() else ""
            print(f"written {out / 'results.csv'}{picture}, from {out / 'trials.csv'}", flush=True)
    return table


def next_participant(
    store: TrialStore, trials_per_participant: int, requested_number: int | None = None
) -> int:
    """Return the requested, else the first unfinished, else a new participant number."""
    if requested_number is not None:
        return requested_number
    known = store.participant_numbers()
    for number in known:
        if len(store.read_rows(number)) < trials_per_participant:
            return number
    number = max(known, default=0) + 1
    if number > MAX_PARTICIPANT_NUMBER:
        what = f"all participant numbers from 1 to {MAX_PARTICIPANT_NUMBER} are used"
        raise DrakeTeleopError(what, where=str(store.folder), remedy="choose another folder")
    return number


def _simulate_participants(
    experiment: Experiment, scenarios: list[Scenario], store: TrialStore, total: int
) -> None:
    from drake_teleop.live.experiment.simulated import make_apparatuses, simulate_participant

    apparatuses = make_apparatuses(experiment, scenarios)

    def print_progress(done: int, trials: int) -> None:
        print(f"\rparticipant {number} of {total}: trial {done} of {trials}", end="", flush=True)

    for number in range(1, total + 1):
        procedure = Procedure(experiment, number, store)
        simulate_participant(procedure, apparatuses, print_progress)
    print()
