"""The trials of an experiment on disk: one file for each participant, complete after each trial.

A participant is a number. `participants/03.csv` has a row for each trial that is over. It is
written anew after each, complete or not at all: a kill loses the trial that was under way.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import polars as pl

from drake_teleop.common.errors import DrakeTeleopError, reading
from drake_teleop.common.version import __version__
from drake_teleop.common.writing import make_folder, write_table
from drake_teleop.lab.studies.store import claimed
from drake_teleop.live.experiment.design import Experiment

#: Participants have numbers up to this.
MOST = 9999


@dataclass(frozen=True)
class Row:
    """A trial that is over.

    Attributes:
        trial: its number, from 0.
        task, condition: by name.
        practice: 1 if it does not count.
        level: of the stimulus, as it was: contact force at the tool [N], mass at the hand [kg].
        signal: the interval that had it, 1 or 2; 0 where there are none.
        answer: the interval that the participant said.
        correct: 1 if right; of peg in slot, 1 if the tool got to the floor.
        time_s: until the answer, from the end of the intervals; of peg in slot, to the floor.
        force_N: largest contact force at the tool.
        lost_s: that the machine was too slow by.
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


_SCHEMA: dict[str, type[pl.DataType]] = {
    field.name: {"int": pl.Int64, "float": pl.Float64, "str": pl.String}[str(field.type)]
    for field in dataclasses.fields(Row)
}


@dataclass(frozen=True)
class Store:
    """The trials in a folder.

    Args:
        folder: of the results.
    """

    folder: Path

    def path(self, participant: int) -> Path:
        """Of a participant's trials."""
        return self.folder / "participants" / f"{participant:02}.csv"

    def participants(self) -> list[int]:
        """Those that have done a trial, in order."""
        stems = (path.stem for path in self.folder.glob("participants/*.csv"))
        return sorted(int(stem) for stem in stems if stem.isdecimal())

    def rows(self, participant: int) -> list[Row]:
        """A participant's trials, in order.

        Raises:
            DrakeTeleopError: naming a file that is damaged.
        """
        path = self.path(participant)
        if not path.exists():
            return []
        remedy = "remove it; the participant then begins again"
        with reading(path, remedy):
            table = pl.read_csv(path, schema=_SCHEMA)
        rows = [Row(**row) for row in table.iter_rows(named=True)]
        if (
            any(row.trial != index for index, row in enumerate(rows))
            or table.null_count().sum_horizontal()[0]
        ):
            raise DrakeTeleopError("lacks trials", where=str(path), remedy=remedy)
        return rows

    def write(self, participant: int, rows: list[Row]) -> None:
        """All trials of a participant, in place of what was there."""
        make_folder(self.path(participant).parent)
        table = pl.DataFrame([dataclasses.asdict(row) for row in rows], schema=_SCHEMA)
        write_table(self.path(participant), table)

    def table(self) -> pl.DataFrame:
        """All trials, with the column participant."""
        parts = [
            pl.DataFrame(
                [dataclasses.asdict(row) for row in self.rows(n)], schema=_SCHEMA
            ).insert_column(0, pl.Series("participant", [n]).new_from_index(0, len(self.rows(n))))
            for n in self.participants()
        ]
        return (
            pl.concat(parts) if parts else pl.DataFrame(schema={"participant": pl.Int64, **_SCHEMA})
        )


@contextmanager
def open_results(folder: Path, experiment: Experiment) -> Iterator[Store]:
    """The results in a folder, for this process alone, new or with the trials that it has.

    Raises:
        DrakeTeleopError: if the folder holds those of another experiment, or is in use.
    """
    make_folder(folder)
    identity = {"experiment": dataclasses.asdict(experiment), "version": __version__}
    with claimed(folder, identity):
        yield Store(folder)
