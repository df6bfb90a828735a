"""What a participant goes through, one step after another; without page, clock and station.

The order is drawn from the experiment's seed and the participant's number: the tasks, in each task
practice first, and then rounds in which each condition comes once. So the levels of a condition
find its threshold while the others go on beside it, and nobody gets used to one of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from drake_teleop.live.experiment.design import ContactDetection, Experiment, PegInSlot, Task
from drake_teleop.live.experiment.psychometrics import Psi
from drake_teleop.live.experiment.store import Row, Store

#: Where a participant stands; `go` leads on from each but GAP, INTERVAL and ANSWER.
CONSENT, TASK, READY, INTERVAL, GAP, ANSWER, TOLD, BREAK, END = (
    *("consent", "task", "ready", "interval", "gap", "answer"),
    *("told", "break", "end"),
)


@dataclass(frozen=True)
class Trial:
    """A trial that will be.

    Attributes:
        task, condition: which of the experiment's.
        practice: whether it does not count.
        signal: the interval that has the stimulus, 1 or 2; 0 where there are none.
    """

    task: int
    condition: int
    practice: bool
    signal: int


@dataclass(frozen=True)
class Felt:
    """What an interval was.

    Attributes:
        level: of the stimulus; 0 if it had none, or if it cannot have been felt.
        force_N: largest contact force at the tool.
        valid: False if it has to be done again: the tool touched nothing.
        done: whether the tool got to the floor of the slot.
        time_s: until then.
        lost_s: that the machine was too slow by.
    """

    level: float = 0.0
    force_N: float = 0.0
    valid: bool = True
    done: bool = False
    time_s: float = 0.0
    lost_s: float = 0.0


def trials_of(experiment: Experiment, participant: int) -> list[Trial]:
    """All trials of a participant, in order."""
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
            trials.append(Trial(index, condition, is_practice, signal))
    return trials


class Procedure:
    """One participant's way through an experiment; it begins where its rows end.

    Attributes:
        phase: see `CONSENT` and the following.
        interval: 1 or 2 of the trial; of peg in slot 1.
        level: of the trial's stimulus, as it should be.
        prepared: counts the intervals that are to come, also those that come again.
        said: whether the last answer was right, for practice.
        again: whether the trial is done again, because the tool touched nothing.

    Args:
        experiment: its design.
        participant: the number.
        store: where trials go to, and come from.
    """

    def __init__(self, experiment: Experiment, participant: int, store: Store) -> None:
        self.experiment, self.participant, self._store = experiment, participant, store
        self.trials = trials_of(experiment, participant)
        self._rows = store.rows(participant)
        self._psi = {
            (t, c): Psi(task.low, task.high)
            for t, task in enumerate(experiment.tasks)
            if not isinstance(task, PegInSlot)
            for c in range(len(experiment.conditions))
        }
        self._pressed: list[float] = []
        for trial, row in zip(self.trials, self._rows, strict=False):
            self._learn(trial, row)
        self.phase, self.said, self.again = CONSENT, False, False
        self.prepared = 0
        self._new_trial()

    @property
    def number(self) -> int:
        """Of the trial, from 0; as many as there are at the end."""
        return len(self._rows)

    @property
    def trial(self) -> Trial:
        """The one that is next or under way."""
        return self.trials[min(self.number, len(self.trials) - 1)]

    @property
    def task(self) -> Task:
        """Of that trial."""
        return self.experiment.tasks[self.trial.task]

    @property
    def shown(self) -> float:
        """The level of the present interval."""
        return self.level if self.trial.signal == self.interval else 0.0

    @property
    def pressed(self) -> float:
        """The contact force that the participant presses with, so far as it is known [N]."""
        task = self.task
        if self._pressed:
            return float(np.median(self._pressed))
        return task.pressed if isinstance(task, ContactDetection) else 0.0

    def _new_trial(self) -> None:
        self.interval, self._felt, self.level = 1, [Felt(), Felt()], 0.0
        self.prepared += 1
        task, trial = self.task, self.trial
        if not isinstance(task, PegInSlot):
            psi = self._psi[trial.task, trial.condition]
            self.level = task.high if trial.practice else psi.next_level()

    def go(self) -> None:
        """The participant goes on."""
        if self.phase == CONSENT:
            self.phase = END if self.number >= len(self.trials) else TASK
        elif self.phase in (TASK, BREAK):
            self.phase = READY
        elif self.phase == READY:
            self.phase, self.again = INTERVAL, False
        elif self.phase == TOLD:
            self._go_on()

    def finished(self, felt: Felt) -> None:
        """The present interval is over."""
        self._felt[self.interval - 1] = felt
        if not felt.valid:
            self._new_trial()
            self.phase, self.again = READY, True
        elif self.trial.signal == 0:
            self._over(0, felt.done, felt.time_s)
        elif self.interval == 1:
            self.interval, self.phase = 2, GAP
            self.prepared += 1
        else:
            self.phase = ANSWER

    def second(self) -> None:
        """The gap between the intervals is over."""
        self.phase = INTERVAL

    def interrupted(self) -> None:
        """Whoever drives has gone: the trial begins again."""
        if self.phase in (INTERVAL, GAP, ANSWER):
            self._new_trial()
            self.phase = READY

    def answer(self, interval: int, time_s: float) -> None:
        """The participant says which interval it was; at any other time it says nothing."""
        if self.phase == ANSWER:
            self._over(interval, interval == self.trial.signal, time_s)

    def _over(self, answer: int, correct: bool, time_s: float) -> None:
        trial, felt = self.trial, self._felt
        row = Row(
            trial=self.number,
            task=type(self.task).__name__,
            condition=self.experiment.conditions[trial.condition].name,
            practice=int(trial.practice),
            level=max(f.level for f in felt),
            signal=trial.signal,
            answer=answer,
            correct=int(correct),
            time_s=round(time_s, 4),
            force_N=max(f.force_N for f in felt),
            lost_s=sum(f.lost_s for f in felt),
        )
        self._store.write(self.participant, [*self._rows, row])
        self._rows.append(row)
        self._learn(trial, row)
        self.said = bool(correct)
        if trial.practice:
            self.phase = TOLD
        else:
            self._go_on()

    def _learn(self, trial: Trial, row: Row) -> None:
        if (trial.task, trial.condition) not in self._psi:
            return
        if isinstance(self.experiment.tasks[trial.task], ContactDetection):
            self._pressed.append(row.force_N)
        if not trial.practice:
            self._psi[trial.task, trial.condition].answered(row.level, bool(row.correct))

    def _go_on(self) -> None:
        """To what comes after a trial."""
        before = self.trials[self.number - 1]
        if self.number == len(self.trials):
            self.phase = END
            return
        self._new_trial()
        practised = before.practice and not self.trial.practice
        if self.trial.task != before.task:
            self.phase = TASK
        elif practised or self.number % self.experiment.break_after == 0:
            self.phase = BREAK
        else:
            self.phase = READY

    def view(self) -> dict[str, Any]:
        """What the participant may know."""
        number = self.number - (self.phase == TOLD)  # of a trial that is over
        trial = self.trials[min(number, len(self.trials) - 1)]
        return {
            "phase": self.phase,
            "participant": self.participant,
            "task": type(self.experiment.tasks[trial.task]).__name__,
            "trial": min(number + 1, len(self.trials)),
            "trials": len(self.trials),
            "practice": trial.practice,
            "interval": self.interval,
            "again": self.again,
            "said": self.said if self.phase == TOLD else None,
            "consent": self.experiment.consent if self.phase == CONSENT else "",
        }
