"""Tables of numbers from files of text, Parquet, NPZ, MAT; messages name file, column, row.

Topics of bags become the same kind of table in `drake_teleop.logs.read.bags`.
"""

from __future__ import annotations

import difflib
import math
import os
import zipfile
from collections import UserDict
from collections.abc import Callable, MutableMapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.errors import DrakeTeleopError, reading, refuse_fork
from drake_teleop.common.parquet_sizes import check_parquet
from drake_teleop.logs.read.csv_text import read_csv
from drake_teleop.logs.read.mat_file import read_mat

if TYPE_CHECKING:
    import polars as pl

_TEXT = (".csv", ".tsv", ".txt", ".dat", ".log")
FORMATS = (*_TEXT, ".parquet", ".npz", ".mat")
LARGEST = 1e25
"""Numbers beyond are none that were measured, in whatever unit: nanoseconds since 1970 are 2e18."""
_CANONICAL = {"f_x", "f_y", "f_z", "tau_x", "tau_y", "tau_z"}
_Column = TypeVar("_Column")
_PARTS = 16  # numbers of an array that are columns of their own: up to a homogeneous matrix
_MOST_DECIMALS = 12
_LARGE = 2**24
"""Numbers in a table that are more than is kept in memory, where the file's format allows it."""


@dataclass(frozen=True)
class Table:
    """The columns of one file.

    Args:
        path: the file, for messages.
        columns: name to array (N,) or, from NPZ and MAT files, (N, ...), whose numbers are columns
            of their own as well, `name[0]` and so on in row-major order; of any type as yet.
        first_row: number of the first data row in the file as a reader counts, for messages.
        absent: groups of columns, such as "orientation", that the file says it does not have.
    """

    path: Path
    columns: MutableMapping[str, NDArray]
    first_row: int = 1
    absent: tuple[str, ...] = ()

    @property
    def rows(self) -> int:
        """Rows of the longest column."""
        return max(len(column) for column in self.columns.values())

    def numbers(
        self, names: Sequence[str | int], width: int, where: str, rows: int | None = None
    ) -> NDArray[np.float64]:
        """(N, width) finite numbers from the named columns side by side.

        An array with several columns counts as that many, row-major.

        Args:
            names: of the columns.
            width: how many they have to be.
            where: the field that names them, for messages.
            rows: how many rows they have to have; None for the same number in all of them.

        Raises:
            DrakeTeleopError: if a column is absent, a cell is no finite number, or the numbers of
                columns and rows are not these.
        """
        columns = [self._column(str(name), where) for name in names]
        self._check_rows(names, columns, where, rows)
        found = sum(column.shape[1] for column in columns)
        if found != width:
            raise DrakeTeleopError(
                f"{found} columns where {width} are needed",
                where=where,
                remedy=f"list {width} columns of {self.path.name}",
            )
        return np.hstack(columns)

    def _check_rows(
        self, names: Sequence[str | int], columns: list[NDArray], where: str, rows: int | None
    ) -> None:
        """Raises an error if not all have so many rows, or None: as many as the first."""
        rows = len(columns[0]) if columns and rows is None else rows
        for name, column in zip(names, columns, strict=True):
            if len(column) != rows:
                raise DrakeTeleopError(
                    f"{name!r} of {self.path.name} has {len(column)} rows where {rows} are needed",
                    where=where,
                    remedy="name columns that belong together",
                )

    def all_raw(self, names: Sequence[str | int], where: str) -> NDArray[np.float64]:
        """`raw` of several columns, side by side.

        Raises:
            DrakeTeleopError: as `raw`, and if they have different numbers of rows.
        """
        columns = [self.raw(name, where) for name in names]
        self._check_rows(names, columns, where, None)
        return np.hstack(columns)

    def raw(self, name: str | int, where: str) -> NDArray[np.float64]:
        """(N, k) numbers of one column, whatever they are: NaN and infinity included.

        Args:
            name: of the column.
            where: the field that names it, for messages.

        Raises:
            DrakeTeleopError: if the column is absent or a cell is no number.
        """
        name = str(name)
        if name not in self.columns:
            return self._column(name, where)
        numbers = self._numbers(name)
        self.check_size(numbers, LARGEST, "", f"{self.path}:{name}")
        return numbers

    def single(self, name: str | int, where: str) -> NDArray[np.float64]:
        """(N,) numbers of a column that is one wide, whatever they are: NaN and infinity included.

        Args:
            name: of the column.
            where: the field that names it, for messages.

        Raises:
            DrakeTeleopError: if the column is absent, wider, or a cell is no number.
        """
        numbers = self.raw(name, where)
        if numbers.shape[1] != 1:
            raise DrakeTeleopError(
                f"{str(name)!r} of {self.path.name} has {numbers.shape[1]} numbers in a row",
                where=where,
                remedy="name a column that has one",
            )
        return numbers[:, 0]

    def check_size(
        self,
        values: NDArray[np.float64],
        largest: float,
        unit: str,
        where: str,
        remedy: str = "check the column and its unit, or delete the row",
    ) -> None:
        """Refuses what cannot have been measured, and would be beyond all floats when squared.

        Args:
            values: (N, k), a row for each of the table's.
            largest: size of a value, in the unit.
            unit: for the message.
            where: the field, for the message.
            remedy: for the message.

        Raises:
            DrakeTeleopError: naming the first row with a number that is larger, but not infinite.
        """
        if not values.size or (values.min() >= -largest and values.max() <= largest):
            return
        bad = ((np.abs(values) > largest) & np.isfinite(values)).any(axis=1)
        if bad.any():
            first = int(np.argmax(bad))
            worst = values[first][np.argmax(np.abs(values[first]))]
            raise DrakeTeleopError(
                f"{worst:g} {unit}".rstrip() + f" in row {first + self.first_row} of"
                f" {self.path.name} is outside {-largest:g} to {largest:g}",
                where=where,
                remedy=remedy,
            )

    def _column(self, name: str, where: str) -> NDArray[np.float64]:
        if name not in self.columns:
            if name.rpartition(".")[0] in self.absent:
                raise DrakeTeleopError(
                    f"{self.path.name} says that it does not provide {name!r} (covariance -1)",
                    where=where,
                    remedy="name another column, or leave this out",
                )
            near = difflib.get_close_matches(name, self.columns, n=3, cutoff=0.5)
            hint = "did you mean" if near else "its columns are"
            raise DrakeTeleopError(
                f"{self.path.name} has no column {name!r}",
                where=where,
                remedy=f"{hint} {_listed(near or list(self.columns))}",
            )
        numbers = self.raw(name, where)
        bad = ~np.isfinite(numbers).all(axis=1)
        if bad.any():
            first = int(np.argmax(bad))
            raise DrakeTeleopError(
                f"no finite number in {int(bad.sum())} rows, the first is row"
                f" {first + self.first_row}",
                where=f"{self.path}:{name}",
                remedy="cut the log before it or repair the rows",
            )
        return numbers

    def _numbers(self, name: str) -> NDArray[np.float64]:
        column = self.columns[name]
        numbers = _as_numbers(column, lambda row, cell: self._bad(name, row, cell))
        return numbers.reshape(len(column), math.prod(numbers.shape[1:]))

    def _bad(self, name: str, row: int, cell: object) -> DrakeTeleopError:
        return DrakeTeleopError(
            f"{cell!r} in row {row + self.first_row} is not a number",
            where=f"{self.path}:{name}",
            remedy="correct the cell or delete the row"
            + (", if it holds units: the log description has them" if row == 0 else ""),
        )


def decimal_step(values: NDArray[np.float64]) -> float:
    """Largest power of ten, 1 at most, of which all values are multiples; 0 if there is none."""
    for decimals in range(_MOST_DECIMALS if values.any() else 0):
        error = np.abs(values - np.round(values, decimals))
        if (error <= 4.0 * np.finfo(float).eps * np.abs(values)).all():
            return float(10.0**-decimals)
    return 0.0


def read_table(path: Path, *, header: bool = True) -> Table:
    """Reads a file of one of the `FORMATS`, told apart by its suffix.

    Args:
        path: the file.
        header: whether the first line of a file of text holds names; if not, the columns are named
            by their numbers, from "0".

    Raises:
        DrakeTeleopError: if the file is absent, of another kind, or cannot be parsed.
    """
    if path.suffix.lower() not in FORMATS:
        raise DrakeTeleopError(
            f"format {path.suffix!r} is not known",
            where=str(path),
            remedy=f"convert it to one of {', '.join(FORMATS)}",
        )
    if not os.path.isfile(path):
        raise DrakeTeleopError("no such file", where=str(path), remedy="check the path")
    refuse_fork()
    with reading(path, f"check that it is a valid {path.suffix} file"):
        arrays = {".npz": _read_npz, ".mat": read_mat}.get(path.suffix.lower())
        table = _read_frame(path, header) if arrays is None else _table_of(path, arrays(path))
    if not table.columns or not all(len(c) for c in table.columns.values()):
        raise DrakeTeleopError("holds no rows", where=str(path), remedy="record it again")
    return table


def _read_frame(path: Path, header: bool) -> Table:
    import polars as pl

    if path.suffix.lower() == ".parquet":
        check_parquet(path)
        names = list(pl.read_parquet_schema(path))
        lazy = _ParquetColumns(
            path, _with_canonical(dict(zip(_stripped(names), names, strict=True)))
        )
        small = len(names) * pl.scan_parquet(path).select(pl.len()).collect().item() <= _LARGE
        return Table(path, dict(lazy) if small else lazy)
    frame, first_row = read_csv(path, header)
    names = [name if header else str(i) for i, name in enumerate(frame.columns)]
    found = [_frame_column(series) for series in frame.get_columns()]
    columns = dict(zip(_stripped(names), found, strict=True))
    return Table(path, _with_canonical(columns), first_row)


def _stripped(names: list[str]) -> list[str]:
    stripped = [name.strip() for name in names]
    if len(set(stripped)) < len(names):
        raise ValueError("two of its columns have names that differ in spaces alone")
    return stripped


def _with_canonical(columns: dict[str, _Column]) -> dict[str, _Column]:
    """The columns, and under their canonical names those of a canonical log in other letters."""
    small = {name.lower(): column for name, column in columns.items()}
    canonical = len(small) == len(columns) and _CANONICAL.issubset(small)
    return small | columns if canonical and not _CANONICAL.issubset(columns) else columns


class _ParquetColumns(UserDict[str, Any]):
    """The columns of a file, each read when it is asked for: all of an hour's fill the memory."""

    def __init__(self, path: Path, names: dict[str, str]) -> None:
        super().__init__(names)
        self._path = path

    def __getitem__(self, key: str) -> NDArray:
        import polars as pl

        name = self.data[key]
        return _frame_column(pl.read_parquet(self._path, columns=[name]).to_series())


def _frame_column(series: pl.Series) -> NDArray:
    import polars as pl

    if series.dtype == pl.Time:
        series = series.cast(pl.Duration("ns"))
    if series.dtype in (pl.Datetime, pl.Duration):
        return series.to_numpy()
    if series.dtype == pl.Int128:  # which numpy has not
        series = series.cast(pl.Float64)
    # Floats keep their empty cells as NaN, which is reported with its row later on.
    return series.to_numpy() if series.dtype.is_numeric() else series.cast(pl.String).to_numpy()


def _table_of(path: Path, arrays: dict[str, NDArray]) -> Table:
    arrays = {name: array for name, array in arrays.items() if len(array)}
    parts = {
        f"{name}[{k}]": array.reshape(len(array), -1)[:, k]
        for name, array in arrays.items()
        for k in range(math.prod(array.shape[1:]) if 1 < array.ndim <= 3 else 0)
        if k < _PARTS
    }
    return Table(path, parts | arrays)


def _read_npz(path: Path) -> dict[str, NDArray]:
    if not zipfile.is_zipfile(path):
        raise ValueError("it is no archive of arrays, or not all of one; numpy.savez writes them")
    with np.load(path, allow_pickle=False) as archive:
        columns = {key: archive[key] for key in archive.files}
    return {key: x for key, x in columns.items() if isinstance(x, np.ndarray) and x.ndim}


def _as_numbers(
    column: NDArray, bad: Callable[[int, object], DrakeTeleopError]
) -> NDArray[np.float64]:
    if column.dtype.kind in "fiu":
        return column.astype(float, copy=False)
    if column.dtype.kind in "mM":  # seconds, since 1970 or midnight
        count = column.astype(f"{column.dtype.kind}8[ns]").astype(np.int64)
        return np.where(np.isnat(column), np.nan, count * 1e-9)
    if column.dtype.kind == "c" and len(column):  # float() would drop half of it
        raise bad(0, column[0])
    numbers = np.empty(len(column))
    for row, cell in enumerate(column):
        try:
            numbers[row] = np.nan if cell is None else float(cell)
        except (TypeError, ValueError) as error:
            raise bad(row, cell) from error
        if isinstance(cell, str) and "_" in cell:  # which Python reads over
            raise bad(row, cell)
    return numbers


def _listed(names: Sequence[str]) -> str:
    shown = ", ".join(names[:12])
    return f"{shown}, ..." if len(names) > 12 else shown
