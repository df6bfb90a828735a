"""Storage of a study's rows on disk; after a crash, each file is complete or absent.

The folder `runs.parquet` is one table, with a file for each chunk of runs.
"""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drake_teleop.common.errors import DrakeTeleopError, wrap_read_errors
from drake_teleop.common.files import make_folder, wrap_write_errors, write_table, write_text
from drake_teleop.common.parquet_sizes import check_parquet

if TYPE_CHECKING:
    import polars as pl

_PART_FILE_NAME = "run_{:08d}.parquet"


@dataclass(frozen=True)
class Store:
    """Table of a study's rows: a folder with a file per chunk (runs of one process)."""

    folder: Path

    def first_runs_of_finished_chunks(self) -> set[int]:
        return set(map(_first_run_of_part, self.part_files()))

    def part_files(self) -> list[Path]:
        return sorted(self.folder.glob(_PART_FILE_NAME.format(0).replace("0", "[0-9]")))

    def remove_damaged_parts(self) -> None:
        parts = self.part_files()
        whole = _read_run_numbers_if_undamaged(parts)
        for part in parts:
            if not {_first_run_of_part(part)} & (whole or _read_run_numbers_if_undamaged([part])):
                part.unlink()

    def write(self, rows: pl.DataFrame) -> None:
        path = self.folder / _PART_FILE_NAME.format(rows["run"][0])
        write_table(path, rows, temporary_base=self.folder)

    def count_chunk_start(self, first_run: int) -> None:
        path = self._start_counts_folder / str(first_run)
        with wrap_write_errors(path):
            self._start_counts_folder.mkdir(exist_ok=True)
            with path.open("ab") as mark:
                mark.write(b".")

    def clear_chunk_starts(self, first_run: int) -> None:
        (self._start_counts_folder / str(first_run)).unlink(missing_ok=True)

    def first_runs_of_chunks_started_at_least(self, times: int) -> set[int]:
        marks = (mark for mark in self._start_counts_folder.glob("*") if mark.name.isdecimal())
        return {int(mark.name) for mark in marks if mark.stat().st_size >= times}

    @property
    def _start_counts_folder(self) -> Path:
        return self.folder.with_name("running")

    def read(self) -> pl.DataFrame:
        import polars as pl

        remedy = "remove the damaged part and repeat the command"
        parts = self.part_files()
        for part in parts:
            with wrap_read_errors(part, remedy):
                check_parquet(part)
        with wrap_read_errors(self.folder, remedy):
            return pl.read_parquet(parts).sort("run")


def _first_run_of_part(part: Path) -> int:
    return int(part.stem.removeprefix("run_"))


def _read_run_numbers_if_undamaged(parts: list[Path]) -> set[int]:
    import polars as pl

    if parts:
        with suppress(DrakeTeleopError), wrap_read_errors(parts[0], ""):
            for part in parts:
                check_parquet(part)
            return set(pl.read_parquet(parts, columns=["run"])["run"])
    return set()


@contextmanager
def open_store(out: Path, identity: dict[str, Any]) -> Iterator[Store]:
    """Open the store in the folder `out` and lock it for this process.

    `identity` is JSON data of all inputs of the rows; rows of other inputs raise an error.
    """
    store = Store(out / "runs.parquet")
    make_folder(store.folder)
    with locked_folder(out, identity):
        store.remove_damaged_parts()
        yield store
        with suppress(OSError):  # missing, or with marks
            store._start_counts_folder.rmdir()


@contextmanager
def locked_folder(out: Path, identity: dict[str, Any]) -> Iterator[None]:
    """Lock the existing folder `out`; raise an error if its content is from other inputs."""
    handle = os.open(out, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            what = "is in use by another process"
            raise DrakeTeleopError(what, where=str(out), remedy="wait for it, or stop it") from None
        write_or_check_identity(out, identity)
        yield
    finally:
        os.close(handle)


def write_or_check_identity(out: Path, identity: dict[str, Any]) -> None:
    """Write the inputs of the rows into a new folder; raise an error if an old one has others."""
    path = out / "study.json"
    text = json.dumps(identity, indent=2) + "\n"
    if not path.exists():
        write_text(path, text)
    elif path.read_bytes() != text.encode():
        what = "contains runs of another study, or of another version of this one"
        remedy = "give another folder, or remove this one"
        raise DrakeTeleopError(what, where=str(out), remedy=remedy)
