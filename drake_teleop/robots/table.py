"""Wrenches into a CSV or Parquet file, when it is over."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from drake_teleop.logs.read.canonical import WRENCH
from drake_teleop.robots.streams import Compensated


class TableSink:
    """A row for each: t, number, contact_f_x ..., scaled_f_x ..., flags."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._rows: list[Compensated] = []

    def write(self, out: Compensated) -> None:
        """See `Sink`."""
        self._rows.append(out)

    def close(self) -> None:
        """Writes the file."""
        import polars as pl

        from drake_teleop.writing import make_folder, write_table

        rows = self._rows
        columns = {
            "t": np.array([row.t for row in rows], float),
            "number": np.array([row.number for row in rows], np.uint64),
        }
        for name, i in (("contact", 2), ("scaled", 3)):
            values = np.array([row[i] for row in rows], float).reshape(-1, 6)
            columns |= {f"{name}_{c}": values[:, k] for k, c in enumerate(WRENCH)}
        columns["flags"] = np.array([row.flags for row in rows], np.uint32)
        make_folder(self._path.parent)
        write_table(self._path, pl.DataFrame(columns))
