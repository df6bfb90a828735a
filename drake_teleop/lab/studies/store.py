"""Storage of a study's rows on disk; after a crash, each file is complete or absent.

The folder `runs.parquet` has a file for each chunk of runs. Shard K/N, for computers that share
only files, runs every N-th chunk into the folder `shards/K-of-N`.
"""

from __future__ import annotations

import fcntl
import json
import os
import re
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

from drake_teleop.common import files
from drake_teleop.common.errors import DrakeTeleopError, wrap_read_errors
from drake_teleop.common.parquet_sizes import check_parquet_sizes

if TYPE_CHECKING:
    import polars as pl

Chunk: TypeAlias = list[dict[str, Any]]
"""Rows that one process runs together."""
_PART_FILE_NAME_FORMAT = "run_{:08d}.parquet"
_MAX_SHARDS_IN_MESSAGE = 20


@dataclass(frozen=True)
class Store:
    """Table of a study's rows: a folder with one part file per chunk of runs."""

    folder: Path

    def first_runs_of_finished_chunks(self) -> set[int]:
        return set(map(_first_run_number, self.part_files()))

    def part_files(self) -> list[Path]:
        return sorted(self.folder.glob(_PART_FILE_NAME_FORMAT.format(0).replace("0", "[0-9]")))

    def remove_damaged_parts(self) -> None:
        parts = self.part_files()
        whole = _read_run_numbers_if_undamaged(parts)
        for part in parts:
            if not {_first_run_number(part)} & (whole or _read_run_numbers_if_undamaged([part])):
                part.unlink()

    def write(self, rows: pl.DataFrame) -> None:
        path = self.folder / _PART_FILE_NAME_FORMAT.format(rows["run"][0])
        files.write_table(path, rows, temporary_base=self.folder)

    def add_part(self, part: Path) -> None:
        """Add a part file of another store by a link or copy, unless a part has its name."""
        path = self.folder / part.name
        if path.exists():
            return
        with files.replace_file_on_success(path, temporary_base=self.folder) as temporary:
            try:
                os.link(part, temporary)
            except OSError:  # a file system without links
                shutil.copyfile(part, temporary)

    def count_start_of_chunk(self, first_run: int) -> None:
        path = self._run_start_counts_folder / str(first_run)
        with files.wrap_write_errors(path):
            self._run_start_counts_folder.mkdir(exist_ok=True)
            with path.open("ab") as mark:
                mark.write(b".")

    def clear_start_count_of_chunk(self, first_run: int) -> None:
        (self._run_start_counts_folder / str(first_run)).unlink(missing_ok=True)

    def first_runs_of_chunks_by_min_starts(self, times: int) -> set[int]:
        marks = (mark for mark in self._run_start_counts_folder.glob("*") if mark.name.isdecimal())
        return {int(mark.name) for mark in marks if mark.stat().st_size >= times}

    @property
    def _run_start_counts_folder(self) -> Path:
        return self.folder.with_name("running")

    def read(self) -> pl.DataFrame:
        import polars as pl

        remedy = "remove the damaged part and repeat the command"
        parts = self.part_files()
        for part in parts:
            with wrap_read_errors(part, remedy):
                check_parquet_sizes(part)
        with wrap_read_errors(self.folder, remedy):
            return pl.read_parquet(parts).sort("run")


def _first_run_number(part: Path) -> int:
    return int(part.stem.removeprefix("run_"))


def _read_run_numbers_if_undamaged(parts: list[Path]) -> set[int]:
    import polars as pl

    if parts:
        with suppress(DrakeTeleopError), wrap_read_errors(parts[0], ""):
            for part in parts:
                check_parquet_sizes(part)
            return set(pl.read_parquet(parts, columns=["run"])["run"])
    return set()


@contextmanager
def open_store(out: Path, identity: dict[str, Any]) -> Iterator[Store]:
    """Open the store in the folder `out` and lock it for this process.

    `identity` is JSON data of all inputs; raise an error if `out` has other inputs or is locked.
    """
    store = Store(out / "runs.parquet")
    files.make_folder(store.folder)
    with locked_folder(out, identity):
        store.remove_damaged_parts()
        yield store
        with suppress(OSError):  # missing, or with marks
            store._run_start_counts_folder.rmdir()


@contextmanager
def locked_folder(out: Path, identity: dict[str, Any]) -> Iterator[None]:
    """Lock folder `out`; raise an error if its results are of other inputs (`identity`)."""
    handle = os.open(out, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            what = "is in use by another process"
            raise DrakeTeleopError(what, where=str(out), remedy="wait for it to end") from None
        write_or_check_identity(out, identity)
        yield
    finally:
        os.close(handle)


def write_or_check_identity(out: Path, identity: dict[str, Any]) -> None:
    """Write `identity`, JSON data of all inputs, into `out`; raise an error if it differs."""
    path = out / "study.json"
    text = json.dumps(identity, indent=2) + "\n"
    if not path.exists():
        files.write_text(path, text)
    elif path.read_bytes() != text.encode():
        what = "contains runs of another study, or of another version of this one"
        remedy = "give another folder, or remove this one"
        raise DrakeTeleopError(what, where=str(out), remedy=remedy)


class Shard(NamedTuple):
    """One of `total` shards of a study, with its `number` from 1."""

    number: int
    total: int

    def folder(self, out: Path) -> Path:
        return out / "shards" / f"{self.number}-of-{self.total}"

    def chunks(self, chunks: Sequence[Chunk]) -> list[Chunk]:
        if self.total > len(chunks):
            what = f"the study has only {len(chunks)} chunks of runs (one for each shard)"
            remedy = f"give at most {len(chunks)} shards"
            raise DrakeTeleopError(what, where=f"shard {self.number}/{self.total}", remedy=remedy)
        return list(chunks[self.number - 1 :: self.total])


def parse_shard(text: str) -> Shard:
    found = re.fullmatch(r"(\d{1,6})/(\d{1,6})", text, re.ASCII)
    if not found or not 1 <= int(found[1]) <= int(found[2]):
        what = f"{text!r} is not K/N with 1 <= K <= N"
        raise DrakeTeleopError(what, where="shard", remedy="give a shard such as 3/8")
    return Shard(int(found[1]), int(found[2]))


def merge_shards(out: Path, store: Store, identity: dict[str, Any], chunks: list[Chunk]) -> None:
    """Link the part files of all shards in `out` into `store`; raise if runs are missing."""
    names = (re.fullmatch(r"([1-9]\d*)-of-([1-9]\d*)", p.name) for p in out.glob("shards/*"))
    shards = [Shard(int(name[1]), int(name[2])) for name in names if name]
    if not shards:
        raise DrakeTeleopError("has no shards", where=str(out), remedy="run study --shard K/N")
    for shard in sorted(shards):
        folder = shard.folder(out)
        write_or_check_identity(folder, identity)
        for part in Store(folder / "runs.parquet").part_files():
            store.add_part(part)
    store.remove_damaged_parts()
    finished = store.first_runs_of_finished_chunks()
    missing = [k for k, chunk in enumerate(chunks) if chunk[0]["run"] not in finished]
    if missing:
        count = max(shard.total for shard in shards)
        numbers = sorted({k % count + 1 for k in missing})
        listed = ",".join(map(str, numbers[:_MAX_SHARDS_IN_MESSAGE]))
        more = ",..." if len(numbers) > _MAX_SHARDS_IN_MESSAGE else ""
        runs = sum(len(chunks[k]) for k in missing)
        what = f"{runs} of {sum(map(len, chunks))} runs are missing"
        remedy = f"run shards {listed}{more} of {count} again, then merge"
        raise DrakeTeleopError(what, where=str(out), remedy=remedy)
