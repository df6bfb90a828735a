"""Trials on disk: one file per participant, such as `participants/03.csv`."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import get_type_hints

import polars as pl

from drake_teleop.common.errors import DrakeTeleopError, wrap_read_errors
from drake_teleop.common.files import make_folder, write_table
from drake_teleop.common.version import __version__
from drake_teleop.lab.studies.store import locked_folder
from drake_teleop.live.experiment.design import Experiment

#: Largest valid participant number.
MAX_PARTICIPANT_NUMBER = 9999


@dataclass(frozen=True)
class TrialRow:
    """Finished trial.

    Attributes:
        practice: 1 if the trial is not evaluated.
        level: measured stimulus: contact force at the tool [N], mass at the hand [kg].
        signal: interval with the stimulus, 1 or 2; 0 for peg in slot.
        correct: 1 if the answer is right, or if the tool reached the floor.
        time_s: time until the answer or the floor.
        lost_s: delay of the simulation behind real time.
    """

    trial: int
    task: str
    condition: str
    practice: int
    level: float
    signal: int
    answer: int
    correct: int
    time_s: float
    force_N: float
    lost_s: float


def table_schema(row_type: type) -> dict[str, type[pl.DataType]]:
    """Return the column types for rows of the class `row_type`."""
    types: dict[type, type[pl.DataType]] = {int: pl.Int64, float: pl.Float64, str: pl.String}
    return {name: types[kind] for name, kind in get_type_hints(row_type).items()}


_TRIAL_COLUMN_TYPES = table_schema(TrialRow)


@dataclass(frozen=True)
class TrialStore:
    """Folder with an experiment's trials."""

    folder: Path

    def participant_file(self, participant: int) -> Path:
        return self.folder / "participants" / f"{participant:02}.csv"

    def participant_numbers(self) -> list[int]:
        stems = (path.stem for path in self.folder.glob("participants/*.csv"))
        return sorted(int(stem) for stem in stems if stem.isdecimal())

    def read_rows(self, participant: int) -> list[TrialRow]:
        path = self.participant_file(participant)
        if not path.exists():
            return []
        remedy = "remove this file; the participant then starts again"
        with wrap_read_errors(path, remedy):
            table = pl.read_csv(path, schema=_TRIAL_COLUMN_TYPES)
        rows = [TrialRow(**row) for row in table.iter_rows(named=True)]
        gaps = [index for index, row in enumerate(rows) if row.trial != index]
        if gaps or table.null_count().sum_horizontal()[0]:
            what = f"row {gaps[0]} is not that of trial {gaps[0]}" if gaps else "has empty cells"
            raise DrakeTeleopError(what, where=str(path), remedy=remedy)
        return rows

    def write_rows(self, participant: int, rows: list[TrialRow]) -> None:
        make_folder(self.participant_file(participant).parent)
        table = pl.DataFrame([dataclasses.asdict(row) for row in rows], schema=_TRIAL_COLUMN_TYPES)
        write_table(self.participant_file(participant), table)

    def trials_table(self) -> pl.DataFrame:
        rows = [
            {"participant": n} | dataclasses.asdict(row)
            for n in self.participant_numbers()
            for row in self.read_rows(n)
        ]
        return pl.DataFrame(rows, schema={"participant": pl.Int64, **_TRIAL_COLUMN_TYPES})


@contextmanager
def open_trial_store(folder: Path, experiment: Experiment) -> Iterator[TrialStore]:
    """Yield the trials in a folder, locked for this process."""
    make_folder(folder)
    identity = {"experiment": dataclasses.asdict(experiment), "version": __version__}
    with locked_folder(folder, identity):
        yield TrialStore(folder)
