"""Sink that writes wrenches continuously to a CSV file or a folder of Parquet files."""

from __future__ import annotations

import errno
import os
import time
from pathlib import Path

import numpy as np

from drake_teleop.common.files import (
    make_folder,
    part_of_log,
    remove_log,
    wrap_write_errors,
    write_table,
)
from drake_teleop.logs.read.canonical import WRENCH
from drake_teleop.robots.streams import Compensated

#: Time between two writes [s]; a killed process loses its rows. A Parquet file takes milliseconds.
PERIOD_S = {".csv": 0.1, ".parquet": 1.0}


class TableSink:
    """Sink whose table has the columns t, number, contact_f_x ..., scaled_f_x ..., flags.

    An existing file or .parquet folder is replaced at the first wrench.
    """

    def __init__(self, path: Path) -> None:
        make_folder(path.parent)
        self._path, self._period = path, PERIOD_S[path.suffix]
        self._rows: list[Compensated] = []
        self._written, self._end = 0, 0  # rows; bytes of the CSV file
        self._due = -np.inf

    def write(self, out: Compensated) -> None:
        """See `Sink`."""
        self._rows.append(out)
        if time.monotonic() >= self._due:
            self._flush()

    def close(self) -> None:
        """See `Sink`."""
        if self._rows or not self._written:
            self._flush()

    def _flush(self) -> None:
        import polars as pl

        rows, table = len(self._rows), pl.DataFrame(self._columns())
        if not self._written:
            remove_log(self._path)
        if self._path.suffix == ".parquet":
            make_folder(self._path)
            write_table(part_of_log(self._path, self._written), table, aside=self._path)
        else:
            text = table.write_csv(include_header=not self._written).encode()
            mode = "r+b" if self._written else "wb"
            with wrap_write_errors(self._path), self._path.open(mode, buffering=0) as file:
                file.seek(self._end)
                if file.write(text) < len(text):  # a truncated number would be a wrong number
                    file.truncate(self._end)
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            self._end += len(text)
        self._written += rows
        del self._rows[:rows]
        self._due = time.monotonic() + self._period

    def _columns(self) -> dict[str, np.ndarray]:
        rows = self._rows
        columns = {
            "t": np.array([row.t for row in rows], float),
            "number": np.array([row.number for row in rows], np.uint64),
        }
        for name, i in (("contact", 2), ("scaled", 3)):
            values = np.array([row[i] for row in rows], float).reshape(-1, 6)
            columns |= {f"{name}_{c}": values[:, k] for k, c in enumerate(WRENCH)}
        return columns | {"flags": np.array([row.flags for row in rows], np.uint32)}
