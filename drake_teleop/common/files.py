"""Output files, written completely or not at all, and folders of shipped files."""

from __future__ import annotations

import itertools
import json
import math
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any
from uuid import uuid4

from drake_teleop.common.errors import DrakeTeleopError, refuse_polars_in_forked_process

if TYPE_CHECKING:
    import polars as pl
    from matplotlib.figure import Figure

_MAX_LISTED_FILES = 6
_RUST_OS_ERROR_PATTERN = re.compile(r"([^:]+) \(os error \d+\)")

_LOG_PART_NAME_FORMAT = "row_{:010d}.parquet"
LOG_PARTS_GLOB = _LOG_PART_NAME_FORMAT.format(0).replace("0", "?")
DRIVE_INPUTS_FILE_NAME = "inputs.csv"
"""Name of the file with the inputs of a recorded live session."""


class CannotWrite(DrakeTeleopError):
    """Error for a file or folder that cannot be written."""


@contextmanager
def replace_file_on_success(
    path: Path, *, temporary_base: Path | None = None, shared: bool = False
) -> Iterator[Path]:
    """Yield a temporary path to write to; then rename this file to `path`.

    After a failure `path` is unchanged. The temporary file is `temporary_base` (default: `path`)
    plus a suffix, which is unique if processes write a `shared` path.
    """
    place, ending = temporary_base or path, uuid4().hex if shared else "unfinished"
    temporary = place.with_name(f"{place.name}.{ending}")
    try:
        with wrap_write_errors(path):
            yield temporary
            temporary.replace(path)
    except BaseException:
        with suppress(OSError):  # the first error is reported
            temporary.unlink(missing_ok=True)
        raise


@contextmanager
def wrap_write_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        what = f"cannot be written ({_os_error_reason(error)})"
        raise CannotWrite(what, where=str(path)) from error


def write_text(path: Path, text: str) -> None:
    with replace_file_on_success(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, data: Any) -> None:
    """Write indented JSON; arrays become lists, and non-finite numbers null."""
    write_text(path, json.dumps(to_json_data(data), indent=2, allow_nan=False) + "\n")


def write_picture(path: Path, figure: Figure, **options: Any) -> None:
    with replace_file_on_success(path) as temporary:
        figure.savefig(temporary, format=path.suffix.removeprefix("."), **options)


def write_table(
    path: Path, table: pl.DataFrame, *, temporary_base: Path | None = None, **options: Any
) -> None:
    """Write a table as CSV if `path` ends with .csv, else Parquet; polars gets other options."""
    import polars as pl

    refuse_polars_in_forked_process()
    write = table.write_csv if path.suffix == ".csv" else table.write_parquet
    with replace_file_on_success(path, temporary_base=temporary_base) as temporary:
        try:
            write(temporary, **options)
        except pl.exceptions.ComputeError as error:  # raised by polars for a full disk
            raise OSError(str(error)) from error


@contextmanager
def output_folder(
    out: Path, completion_file: str = "summary.json", *, valid_after_failure: Sequence[str] = ()
) -> Iterator[None]:
    """Create `out` and remove its `completion_file`, which the caller must write last.

    A CannotWrite error lists the valid files: new ones, and names in `valid_after_failure`.
    """
    make_folder(out)
    with wrap_write_errors(out / completion_file):
        (out / completion_file).unlink(missing_ok=True)
    before = _file_times_and_inodes(out)
    try:
        yield
    except CannotWrite as error:
        found = _file_times_and_inodes(out).items()
        valid = [x for x, state in found if x in valid_after_failure or before.get(x) != state]
        raise CannotWrite(str(error), remedy=f"{out} contains {_join_file_names(valid)}") from error


def refuse_to_replace_inputs(path: Path, *input_paths: str | Path) -> None:
    """Raise DrakeTeleopError if `path` is an input or a file of a recorded live session.

    Inputs that are no files, such as names of shipped scenarios, are ignored.
    """
    if not path.exists():
        return
    what = "a recorded live session" if (path.parent / DRIVE_INPUTS_FILE_NAME).exists() else ""
    if any(os.path.exists(x) and os.path.samefile(x, path) for x in input_paths):
        what = f"the input {path.name}"
    if what:
        what = f"contains {what}, which the results would replace"
        raise DrakeTeleopError(what, where=str(path.parent), remedy="give another --out")


def make_folder(folder: Path) -> None:
    remedy = "give another folder"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        what = f"cannot be created as a folder ({_os_error_reason(error)})"
        raise CannotWrite(what, where=str(folder), remedy=remedy) from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise CannotWrite("is a folder without write permission", where=str(folder), remedy=remedy)


def move_earlier_recordings(*paths: Path) -> Path | None:
    """Move existing recordings into a new folder `earlier-1`, `earlier-2`, ... and return it."""
    existing = [path for path in paths if path.exists()]
    if not existing:
        return None
    folders = (existing[0].with_name(f"earlier-{k}") for k in itertools.count(1))
    with wrap_write_errors(existing[0]):
        folder = next(folder for folder in folders if not folder.exists())
        folder.mkdir()
        for path in existing:
            path.rename(folder / path.name)
    return folder


def log_part_path(folder: Path, first_row: int) -> Path:
    return folder / _LOG_PART_NAME_FORMAT.format(first_row)


def remove_log(path: Path) -> None:
    """Remove a log file or the parts in a log folder; raise DrakeTeleopError for other files."""
    if not path.is_dir():
        path.unlink(missing_ok=True)
        return
    parts = sorted(path.glob(LOG_PARTS_GLOB))
    if others := sorted(set(path.iterdir()) - set(parts)):
        what = f"contains {others[0].name}, which is not part of a log"
        raise DrakeTeleopError(what, where=str(path), remedy="give another folder for the log")
    for part in reversed(parts):  # from the end: an interruption leaves no gap
        part.unlink()


def _os_error_reason(error: OSError) -> str:
    if found := _RUST_OS_ERROR_PATTERN.search(str(error)):
        return found[1].strip()
    return error.strerror or str(error) or type(error).__name__


def to_json_data(data: Any) -> Any:
    """Return data with arrays and tuples as lists, and nan and inf as None."""
    if isinstance(data, dict):
        return {key: to_json_data(value) for key, value in data.items()}
    if hasattr(data, "tolist"):  # of NumPy
        data = data.tolist()
    if isinstance(data, (list, tuple)):
        return [to_json_data(value) for value in data]
    return None if isinstance(data, float) and not math.isfinite(data) else data


def _file_times_and_inodes(folder: Path) -> dict[str, tuple[int, int]]:
    paths = (x for x in sorted(folder.iterdir()) if not x.is_dir() or any(x.iterdir()))
    states = {path.name: path.lstat() for path in paths}
    return {name: (state.st_mtime_ns, state.st_ino) for name, state in states.items()}


def _join_file_names(names: Sequence[str]) -> str:
    more = f" and {len(names) - _MAX_LISTED_FILES} more" if len(names) > _MAX_LISTED_FILES else ""
    return ", ".join(names[:_MAX_LISTED_FILES]) + more or "nothing"


_PACKAGE_FOLDER = Path(__file__).resolve().parents[1]


def models_dir() -> Path:
    packaged = _PACKAGE_FOLDER / "models"
    return packaged if packaged.is_dir() else _PACKAGE_FOLDER.parent / "models"


def scenarios_dir() -> Path:
    return _PACKAGE_FOLDER / "station" / "scenarios"


def studies_dir() -> Path:
    return _PACKAGE_FOLDER / "lab" / "studies"
