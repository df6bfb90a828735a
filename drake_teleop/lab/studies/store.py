"""The rows of a study on disk: complete or absent, whenever a process dies.

A folder `runs.parquet` of parts is one table for polars, DuckDB and others. A part holds the rows
of one chunk of runs and is named after the first: a chunk that is run again replaces itself.
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

from drake_teleop.common.errors import DrakeTeleopError, reading
from drake_teleop.common.parquet_sizes import check_parquet
from drake_teleop.common.writing import make_folder, naming, write_table, write_text

if TYPE_CHECKING:
    import polars as pl

_PART = "run_{:08d}.parquet"


@dataclass(frozen=True)
class Store:
    """The rows of one study.

    Args:
        folder: of the parts.
    """

    folder: Path

    def finished(self) -> set[int]:
        """The first runs of the chunks that are complete."""
        return set(map(_first_run, self._parts()))

    def _parts(self) -> list[Path]:
        """The parts in order; other files in the folder are ignored."""
        return sorted(self.folder.glob(_PART.format(0).replace("0", "[0-9]")))

    def remove_damaged_parts(self) -> None:
        """Remove parts that cannot be read or are empty, so that their runs are repeated."""
        parts = self._parts()
        whole = _runs_in(parts)
        for part in parts:
            if not {_first_run(part)} & (whole or _runs_in([part])):
                part.unlink()

    def write(self, rows: pl.DataFrame) -> None:
        """Adds the rows of one chunk; column "run" of the first one gives the part's name."""
        write_table(self.folder / _PART.format(rows["run"][0]), rows, aside=self.folder)

    def mark(self, run: int) -> None:
        """Notes that the chunk with this first run is under way, once more."""
        path = self._marks / str(run)
        with naming(path):
            self._marks.mkdir(exist_ok=True)
            with path.open("ab") as mark:
                mark.write(b".")

    def unmark(self, run: int) -> None:
        """Takes its marks away, if it has any."""
        (self._marks / str(run)).unlink(missing_ok=True)

    def marked(self, times: int) -> set[int]:
        """The first runs of the chunks that were so often under way when their process ended."""
        marks = (mark for mark in self._marks.glob("*") if mark.name.isdecimal())
        return {int(mark.name) for mark in marks if mark.stat().st_size >= times}

    @property
    def _marks(self) -> Path:
        return self.folder.with_name("running")

    def read(self) -> pl.DataFrame:
        """All rows, sorted by run."""
        import polars as pl

        remedy = "remove the part that is damaged; the same command makes it anew"
        parts = self._parts()
        for part in parts:
            with reading(part, remedy):
                check_parquet(part)
        with reading(self.folder, remedy):
            return pl.read_parquet(parts).sort("run")


def _first_run(part: Path) -> int:
    return int(part.stem.removeprefix("run_"))


def _runs_in(parts: list[Path]) -> set[int]:
    """The runs that some parts hold; none if one of the parts cannot be read."""
    import polars as pl

    if parts:
        with suppress(DrakeTeleopError), reading(parts[0], ""):
            for part in parts:
                check_parquet(part)
            return set(pl.read_parquet(parts, columns=["run"])["run"])
    return set()


@contextmanager
def open_store(out: Path, identity: dict[str, Any]) -> Iterator[Store]:
    """The store in a folder, for this process alone, new or with the rows that it has.

    Args:
        out: the folder; gets study.json and runs.parquet.
        identity: all that the rows depend on, for JSON.

    Raises:
        DrakeTeleopError: if the folder holds the rows of something else, or is in use.
    """
    store = Store(out / "runs.parquet")
    make_folder(store.folder)
    with claimed(out, identity):
        store.remove_damaged_parts()
        yield store
        with suppress(OSError):  # not there, or with marks in it
            store._marks.rmdir()


@contextmanager
def claimed(out: Path, identity: dict[str, Any]) -> Iterator[None]:
    """Keeps a folder, which is there, for this process and for what `identity` says it holds.

    Raises:
        DrakeTeleopError: if the folder holds something else, or is in use.
    """
    handle = os.open(out, os.O_RDONLY)
    try:
        _lock(handle, out)
        _check_identity(out, identity)
        yield
    finally:
        os.close(handle)


def _lock(handle: int, out: Path) -> None:
    """The kernel takes the lock back from a process that dies, however it dies."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise DrakeTeleopError(
            "another process runs a study there", where=str(out), remedy="wait for it, or stop it"
        ) from None


def _check_identity(out: Path, identity: dict[str, Any]) -> None:
    path = out / "study.json"
    text = json.dumps(identity, indent=2) + "\n"
    if not path.exists():
        write_text(path, text)
    elif path.read_bytes() != text.encode():
        raise DrakeTeleopError(
            "holds the runs of another study, or of another version of this one",
            where=str(out),
            remedy="give another folder, or remove this one",
        )
