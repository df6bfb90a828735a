"""Readings and wrenches as lines of JSON, and wrenches as tables.

Input: t [s], wrench (6), specific force s, omega, alpha (3 each); optionally number and saturated.
Output: number, t, contact and scaled wrench (6 each), and names of flags.
"""

from __future__ import annotations

import errno
import json
import os
import select
import time
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from drake_teleop.common import files
from drake_teleop.logs.read.canonical import WRENCH_COLUMNS
from drake_teleop.robots.streams import (
    DAMAGED_READING,
    NUM_READING_VALUES,
    CompensatedWrench,
    Reading,
    ReadingFlag,
    Sink,
    Source,
)

_MAX_LINE_BYTES, _READ_BLOCK_BYTES = 4096, 65536


def reading_of_json_line(line: bytes, number: int) -> Reading:
    """Return the reading in a JSON line; `DAMAGED_READING` if a field is missing or invalid."""
    if len(line) > _MAX_LINE_BYTES:
        return DAMAGED_READING
    try:
        data = json.loads(line)
        parts = [np.array(data[name], float) for name in ("wrench", "s", "omega", "alpha")]
        values = np.concatenate(parts)
        t, number = float(data["t"]), int(data.get("number", number))
        flags = int(ReadingFlag.SATURATED) if data.get("saturated") else 0
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError):
        return DAMAGED_READING
    good = values.shape == (NUM_READING_VALUES,) and [len(part) for part in parts] == [6, 3, 3, 3]
    return Reading(number, t, values, flags) if good and 0 <= number < 2**64 else DAMAGED_READING


def wrench_json_line(out: CompensatedWrench) -> str:
    data: dict[str, Any] = {"number": out.number, "t": out.t}
    data |= {"contact": out.contact.tolist(), "scaled": out.scaled.tolist()}
    return json.dumps(data | {"flags": flag_names(out.flags)})


def flag_names(flags: int) -> list[str]:
    return [str(flag.name).lower().replace("_", " ") for flag in ReadingFlag if flag & flags]


class JsonLineSource(Source):
    """Source of readings, as lines of JSON, from a growing file such as standard input."""

    def __init__(self, file: int, dt: float) -> None:
        self.dt, self._file, self._partial, self._number, self._ended = dt, file, b"", 0, False

    def read(self, timeout_s: float) -> list[Reading] | None:
        if self._ended:
            return None
        if not select.select([self._file], [], [], timeout_s)[0]:
            return []
        block = os.read(self._file, _READ_BLOCK_BYTES)
        self._ended = not block
        *lines, self._partial = (self._partial + block).split(b"\n")
        if self._ended or len(self._partial) > _MAX_LINE_BYTES:
            lines, self._partial = [*lines, self._partial], b""
        found = []
        for line in lines:
            if line.strip():
                found.append(reading_of_json_line(line, self._number))
                self._number += 1
        return found


class JsonLineSink(Sink):
    """Sink of unbuffered lines of JSON in a text file such as standard output."""

    def __init__(self, file: TextIO) -> None:
        self._file = file

    def write(self, out: CompensatedWrench) -> None:
        self._file.write(wrench_json_line(out) + "\n")
        self._file.flush()


#: Time between two writes [s]; a killed process loses its rows. A Parquet file takes milliseconds.
TABLE_WRITE_PERIOD_S = {".csv": 0.1, ".parquet": 1.0}


class TableSink:
    """Sink whose table has the columns t, number, contact_f_x ..., scaled_f_x ..., flags.

    An existing file or .parquet folder is replaced at the first wrench.
    """

    def __init__(self, path: Path) -> None:
        files.make_folder(path.parent)
        self._path, self._period = path, TABLE_WRITE_PERIOD_S[path.suffix]
        self._rows: list[CompensatedWrench] = []
        self._written, self._end = 0, 0  # rows; bytes of the CSV file
        self._due = -np.inf

    def write(self, out: CompensatedWrench) -> None:
        self._rows.append(out)
        if time.monotonic() >= self._due:
            self._write_buffered_rows()

    def close(self) -> None:
        if self._rows or not self._written:
            self._write_buffered_rows()

    def _write_buffered_rows(self) -> None:
        import polars as pl

        rows, table = len(self._rows), pl.DataFrame(self._columns_of_buffered_wrenches())
        if not self._written:
            files.remove_log(self._path)
        if self._path.suffix == ".parquet":
            files.make_folder(self._path)
            files.write_table(
                files.log_part_path(self._path, self._written), table, temporary_base=self._path
            )
        else:
            text = table.write_csv(include_header=not self._written).encode()
            mode = "r+b" if self._written else "wb"
            with files.wrap_write_errors(self._path), self._path.open(mode, buffering=0) as file:
                file.seek(self._end)
                if file.write(text) < len(text):  # a truncated number would be a wrong number
                    file.truncate(self._end)
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            self._end += len(text)
        self._written += rows
        del self._rows[:rows]
        self._due = time.monotonic() + self._period

    def _columns_of_buffered_wrenches(self) -> dict[str, np.ndarray]:
        rows = self._rows
        columns = {
            "t": np.array([row.t for row in rows], float),
            "number": np.array([row.number for row in rows], np.uint64),
        }
        for name, i in (("contact", 2), ("scaled", 3)):
            values = np.array([row[i] for row in rows], float).reshape(-1, 6)
            columns |= {f"{name}_{c}": values[:, k] for k, c in enumerate(WRENCH_COLUMNS)}
        return columns | {"flags": np.array([row.flags for row in rows], np.uint32)}
