"""Writing into a user's folders: each file is complete or absent, and a failure is one line.

A file is written under another name beside it and then renamed, so neither a full disk nor a killed
process leaves a part of one under its name, and what was there before stays until then.
"""

from __future__ import annotations

import itertools
import json
import math
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any
from uuid import uuid4

from drake_teleop.common.errors import DrakeTeleopError, refuse_fork

if TYPE_CHECKING:
    import polars as pl
    from matplotlib.figure import Figure

_NAMED = 6  # so many files are named of those that are kept
_RUST = re.compile(r"([^:]+) \(os error \d+\)")

_PART_NAME = "row_{:010d}.parquet"
PARTS_OF_LOG = _PART_NAME.format(0).replace("0", "?")


class CannotWrite(DrakeTeleopError):
    """A file that cannot be written: a full or write-protected disk, a folder that is none."""


@contextmanager
def whole_file(path: Path, *, aside: Path | None = None, shared: bool = False) -> Iterator[Path]:
    """Gives the name to write under; after that, the file has its own.

    Args:
        path: of the file; its folder is there.
        aside: beside what the other name is, if not beside the file: a folder that others read as
            one table must not hold it.
        shared: whether other processes may write the same file now. It is then written under a name
            that nobody else has; else under one that the next attempt takes too, so that what
            killed processes leave does not grow.

    Raises:
        CannotWrite: naming the file, which then is as it was before.
    """
    place, ending = aside or path, uuid4().hex if shared else "unfinished"
    unfinished = place.with_name(f"{place.name}.{ending}")
    try:
        with naming(path):
            yield unfinished
            unfinished.replace(path)
    except BaseException:
        _try_to_remove(unfinished)
        raise


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Turns what the system says into an error that names the file.

    Raises:
        CannotWrite: for any OSError.
    """
    try:
        yield
    except OSError as error:
        raise CannotWrite(f"cannot be written ({_reason(error)})", where=str(path)) from error


def write_text(path: Path, text: str) -> None:
    """Writes a text in UTF-8, as `whole_file` does."""
    with whole_file(path) as unfinished:
        unfinished.write_text(text, encoding="utf-8")


def write_json(path: Path, data: Any) -> None:
    """Writes indented JSON. It has no NaN and no infinity: what is not finite is null."""
    write_text(path, json.dumps(_finite(data), indent=2, allow_nan=False) + "\n")


def write_picture(path: Path, figure: Figure, **options: Any) -> None:
    """Writes a figure in the format that the name ends in; `options` are for `savefig`."""
    with whole_file(path) as unfinished:
        figure.savefig(unfinished, format=path.suffix.removeprefix("."), **options)


def write_table(
    path: Path, table: pl.DataFrame, *, aside: Path | None = None, **options: Any
) -> None:
    """Writes CSV, or Parquet for any other name, as `whole_file` does; `options` are for polars."""
    import polars as pl

    refuse_fork()
    write = table.write_csv if path.suffix == ".csv" else table.write_parquet
    with whole_file(path, aside=aside) as unfinished:
        try:
            write(unfinished, **options)
        except pl.exceptions.ComputeError as error:  # what a full disk is for polars' Parquet
            raise OSError(str(error)) from error


@contextmanager
def output_folder(
    out: Path, last: str = "summary.json", *, kept: Sequence[str] = ()
) -> Iterator[None]:
    """The folder of a command, made if it is not there. Where its last file is, all is there.

    Args:
        out: the folder.
        last: the file that the command writes at the end. That of an earlier command is removed
            now: it would say that what is in the folder belongs together.
        kept: what was written before and remains, for the error.

    Raises:
        CannotWrite: if the folder cannot be made or is write-protected; or for a file, saying what
            has been written before it.
    """
    make_folder(out)
    with naming(out / last):
        (out / last).unlink(missing_ok=True)
    before = _states(out)
    try:
        yield
    except CannotWrite as error:
        after = _states(out)
        there = [name for name in after if name in kept or before.get(name) != after[name]]
        raise CannotWrite(str(error), remedy=f"{out} keeps {_listed(there)}") from error


def make_folder(folder: Path) -> None:
    """Makes a folder with those above it.

    Raises:
        CannotWrite: if that cannot be, or nothing can be written there.
    """
    remedy = "give another folder"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        what = f"cannot be made a folder ({_reason(error)})"
        raise CannotWrite(what, where=str(folder), remedy=remedy) from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise CannotWrite("is a write-protected folder", where=str(folder), remedy=remedy)


def set_aside(*paths: Path) -> Path | None:
    """Move recordings into the first absent folder `earlier-1`, `earlier-2`, ... beside them.

    Args:
        paths: of one folder; they may be absent.

    Returns:
        the new folder; None if there is nothing to move.

    Raises:
        CannotWrite: if they cannot be moved.
    """
    there = [path for path in paths if path.exists()]
    if not there:
        return None
    folders = (there[0].with_name(f"earlier-{k}") for k in itertools.count(1))
    with naming(there[0]):
        folder = next(folder for folder in folders if not folder.exists())
        folder.mkdir()
        for path in there:
            path.rename(folder / path.name)
    return folder


def part_of_log(folder: Path, first_row: int) -> Path:
    """Return the file of a part, named after the number of its first row."""
    return folder / _PART_NAME.format(first_row)


def remove_log(path: Path) -> None:
    """Remove a log that `write_part` or `write_parquet` wrote, if there is one.

    Raises:
        DrakeTeleopError: if it is a folder that holds something else.
    """
    if not path.is_dir():
        path.unlink(missing_ok=True)
        return
    parts = sorted(path.glob(PARTS_OF_LOG))
    if others := sorted(set(path.iterdir()) - set(parts)):
        raise DrakeTeleopError(
            f"holds {others[0].name}, which is no part of a log",
            where=str(path),
            remedy="give another folder for the log",
        )
    for part in reversed(parts):  # from its end: what remains if we die here has no gap
        part.unlink()


def _reason(error: OSError) -> str:
    """What the system says, without numbers and names, in C as in Rust."""
    if found := _RUST.search(str(error)):
        return found[1].strip()
    return error.strerror or str(error) or type(error).__name__


def _finite(data: Any) -> Any:
    if isinstance(data, dict):
        return {key: _finite(value) for key, value in data.items()}
    if isinstance(data, (list, tuple)):
        return [_finite(value) for value in data]
    return None if isinstance(data, float) and not math.isfinite(data) else data


def _try_to_remove(path: Path) -> None:
    try:
        path.unlink(missing_ok=True)
    except OSError:  # why it could not be written is what matters
        return


def _states(folder: Path) -> dict[str, tuple[int, int]]:
    """What tells each file from one that is written in its place; an empty folder is none."""
    found = {}
    for path in sorted(folder.iterdir()):
        if not path.is_dir() or any(path.iterdir()):
            state = path.lstat()
            found[path.name] = (state.st_mtime_ns, state.st_ino)
    return found


def _listed(names: Sequence[str]) -> str:
    if not names:
        return "nothing"
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return ", ".join(names[:_NAMED]) + more
