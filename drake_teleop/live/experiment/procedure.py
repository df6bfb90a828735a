"""Sequence of a participant's trials, drawn from the seed and the participant's number."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from drake_teleop.live.experiment.design import ContactDetection, Experiment, PegInSlot, Task
from drake_teleop.live.experiment.psychometrics import PsiMethod
from drake_teleop.live.experiment.store import TrialRow, TrialStore

#: Phases of an experiment; `go` ends each one except gap, interval and answer.
CONSENT_PHASE, TASK_PHASE, READY_PHASE = "consent", "task", "ready"
INTERVAL_PHASE, GAP_PHASE, ANSWER_PHASE = "interval", "gap", "answer"
FEEDBACK_PHASE, BREAK_PHASE, END_PHASE = "told", "break", "end"


@dataclass(frozen=True)
class PlannedTrial:
    """Planned trial: indices of task and condition; interval with the stimulus, 0 in peg tasks."""

    task: int
    condition: int
    practice: bool
    signal_interval: int


@dataclass(frozen=True)
class IntervalResult:
    """Result of one interval of a trial.

    Attributes:
        level: measured stimulus [N or kg]; 0 without stimulus.
        force_N: largest 20 ms mean of the contact force.
        valid: False if a required contact is missing.
        done: True if the peg reached the slot's floor.
        time_s: time until the peg reached the floor, otherwise the duration.
        lost_s: delay of the simulation behind real time.
    """

    level: float = 0.0
    force_N: float = 0.0
    valid: bool = True
    done: bool = False
    time_s: float = 0.0
    lost_s: float = 0.0


def plan_trials(experiment: Experiment, participant: int) -> list[PlannedTrial]:
    rng = np.random.default_rng([experiment.seed, participant])
    conditions, trials = len(experiment.conditions), []
    for index in rng.permutation(len(experiment.tasks)).tolist():
        task = experiment.tasks[index]
        rounds = -(-task.practice // conditions)
        practice = [c for _ in range(rounds) for c in rng.permutation(conditions).tolist()]
        order = [(c, True) for c in practice[: task.practice]]
        for _ in range(task.trials):
            order += [(c, False) for c in rng.permutation(conditions).tolist()]
        for condition, is_practice in order:
            signal = int(rng.integers(1, 3))
            signal = 0 if isinstance(task, PegInSlot) else signal
            trials.append(PlannedTrial(index, condition, is_practice, signal))
    return trials


class Procedure:
    """Progress of a participant, continued from the stored trials.

    Attributes:
        level: intended level of the trial's stimulus [N or kg].
        prepared_intervals: number of prepared intervals, with repetitions.
        is_answer_right: whether the last answer was right.
        is_repeated: whether the trial is repeated because the tool made no contact.
    """

    def __init__(self, experiment: Experiment, participant: int, store: TrialStore) -> None:
        self.experiment, self.participant, self.store = experiment, participant, store
        self.trials = plan_trials(experiment, participant)
        self._rows = store.read_rows(participant)
        self._psi = {
            (t, c): PsiMethod(task.low, task.high)
            for t, task in enumerate(experiment.tasks)
            if not isinstance(task, PegInSlot)
            for c in range(len(experiment.conditions))
        }
        self._contact_forces: list[float] = []
        for trial, row in zip(self.trials, self._rows, strict=False):
            self._update_psi_method_and_contact_forces(trial, row)
        self.phase, self.is_answer_right, self.is_repeated = CONSENT_PHASE, False, False
        self.prepared_intervals = 0
        self._prepare_trial()

    @property
    def num_completed_trials(self) -> int:
        return len(self._rows)

    @property
    def trial(self) -> PlannedTrial:
        return self.trials[min(self.num_completed_trials, len(self.trials) - 1)]

    @property
    def task(self) -> Task:
        return self.experiment.tasks[self.trial.task]

    @property
    def current_level(self) -> float:
        """Stimulus level of the present interval [N or kg]; 0 without stimulus."""
        return self.level if self.trial.signal_interval == self.interval else 0.0

    @property
    def expected_contact_force(self) -> float:
        """Median of the participant's contact forces [N]; before the first, the task's estimate."""
        task = self.task
        if self._contact_forces:
            return float(np.median(self._contact_forces))
        return task.pressed if isinstance(task, ContactDetection) else 0.0

    def _prepare_trial(self) -> None:
        self.interval, self._results, self.level = 1, [IntervalResult(), IntervalResult()], 0.0
        self.prepared_intervals += 1
        task, trial = self.task, self.trial
        if not isinstance(task, PegInSlot):
            psi = self._psi[trial.task, trial.condition]
            self.level = task.high if trial.practice else psi.next_level()

    def advance_phase(self) -> None:
        if self.phase == CONSENT_PHASE:
            self.phase = END_PHASE if self.num_completed_trials >= len(self.trials) else TASK_PHASE
        elif self.phase in (TASK_PHASE, BREAK_PHASE):
            self.phase = READY_PHASE
        elif self.phase == READY_PHASE:
            self.phase, self.is_repeated = INTERVAL_PHASE, False
        elif self.phase == FEEDBACK_PHASE:
            self._start_next_trial()

    def finish_interval(self, result: IntervalResult) -> None:
        """End the present interval; repeat the trial if its result is invalid."""
        self._results[self.interval - 1] = result
        if not result.valid:
            self._prepare_trial()
            self.phase, self.is_repeated = READY_PHASE, True
        elif self.trial.signal_interval == 0:
            self._finish_trial(0, result.done, result.time_s)
        elif self.interval == 1:
            self.interval, self.phase = 2, GAP_PHASE
            self.prepared_intervals += 1
        else:
            self.phase = ANSWER_PHASE

    def start_second_interval(self) -> None:
        self.phase = INTERVAL_PHASE

    def restart_trial(self) -> None:
        if self.phase in (INTERVAL_PHASE, GAP_PHASE, ANSWER_PHASE):
            self._prepare_trial()
            self.phase = READY_PHASE

    def store_answer(self, interval: int, time_s: float) -> None:
        """Store the answer (`interval` 1 or 2, given after `time_s`) if the phase expects one."""
        if self.phase == ANSWER_PHASE:
            self._finish_trial(interval, interval == self.trial.signal_interval, time_s)

    def _finish_trial(self, answer: int, is_correct: bool, time_s: float) -> None:
        trial, results = self.trial, self._results
        row = TrialRow(
            trial=self.num_completed_trials,
            task=type(self.task).__name__,
            condition=self.experiment.conditions[trial.condition].name,
            practice=int(trial.practice),
            level=max(f.level for f in results),
            signal=trial.signal_interval,
            answer=answer,
            correct=int(is_correct),
            time_s=round(time_s, 4),
            force_N=max(f.force_N for f in results),
            lost_s=sum(f.lost_s for f in results),
        )
        self.store.write_rows(self.participant, [*self._rows, row])
        self._rows.append(row)
        self._update_psi_method_and_contact_forces(trial, row)
        self.is_answer_right = bool(is_correct)
        if trial.practice:
            self.phase = FEEDBACK_PHASE
        else:
            self._start_next_trial()

    def _update_psi_method_and_contact_forces(self, trial: PlannedTrial, row: TrialRow) -> None:
        if (trial.task, trial.condition) not in self._psi:
            return
        if isinstance(self.experiment.tasks[trial.task], ContactDetection):
            self._contact_forces.append(row.force_N)
        if not trial.practice:
            self._psi[trial.task, trial.condition].update_posterior(row.level, bool(row.correct))

    def _start_next_trial(self) -> None:
        before = self.trials[self.num_completed_trials - 1]
        if self.num_completed_trials == len(self.trials):
            self.phase = END_PHASE
            return
        self._prepare_trial()
        practised = before.practice and not self.trial.practice
        if self.trial.task != before.task:
            self.phase = TASK_PHASE
        elif practised or self.num_completed_trials % self.experiment.break_after == 0:
            self.phase = BREAK_PHASE
        else:
            self.phase = READY_PHASE

    def page_state(self) -> dict[str, Any]:
        # FEEDBACK_PHASE belongs to the finished trial.
        number = self.num_completed_trials - (self.phase == FEEDBACK_PHASE)
        trial = self.trials[min(number, len(self.trials) - 1)]
        return {
            "phase": self.phase,
            "participant": self.participant,
            "task": type(self.experiment.tasks[trial.task]).__name__,
            "trial": min(number + 1, len(self.trials)),
            "trials": len(self.trials),
            "practice": trial.practice,
            "interval": self.interval,
            "again": self.is_repeated,
            "said": self.is_answer_right if self.phase == FEEDBACK_PHASE else None,
            "consent": self.experiment.consent if self.phase == CONSENT_PHASE else "",
        }
