"""Table of numbers from one file; errors name file, column and row."""

from __future__ import annotations

import difflib
import math
from collections import UserDict
from collections.abc import Callable, Iterable, MutableMapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array

MAX_PLAUSIBLE_NUMBER = 1e25  # in any unit; nanoseconds since 1970 are 2e18
_MAX_RESOLUTION_DECIMALS = 12


@dataclass(frozen=True)
class Table:
    """Columns of one file.

    Attributes:
        columns: arrays (N,) by name; of arrays (N, ...) also the elements, `name[0]` (row-major).
        first_row: number of the first data row in the file.
        absent_groups: column groups, such as torque, that the file marks as not provided.
        whole_table: table of all rows, if this one has only some of them.
        kept_rows: row numbers in `whole_table`, counted from 0; None: all rows.
        note: which part of the file was read, if it has several.
    """

    path: Path
    columns: MutableMapping[str, NDArray]
    first_row: int = 1
    absent_groups: tuple[str, ...] = ()
    whole_table: Table | None = None
    kept_rows: NDArray[np.intp] | None = None
    note: str = ""

    def line_in_file(self, row: int) -> int:
        """Return the line number of a row in the file."""
        return self.first_row + int(row if self.kept_rows is None else self.kept_rows[row])

    def rows_with_any_number(self, names: Sequence[str | int]) -> Table:
        """Return a table of the rows with a number in at least one of the named columns."""
        names = [str(name) for name in names if str(name) in self.columns]
        if not names or np.isfinite(self.numbers_with_nan(names[0], "")).all():
            return self
        numbers = [self.numbers_with_nan(name, "") for name in names]
        if len({len(column) for column in numbers}) > 1:
            return self
        rows = np.flatnonzero(np.isfinite(np.hstack(numbers)).any(axis=1))
        if not 0 < len(rows) < self.rows:
            return self

        def kept_part_of_column(name: str) -> NDArray:
            column = self.columns[name]
            return column[rows] if rows[-1] < len(column) else column

        columns = ColumnsOnAccess(self.columns, kept_part_of_column)
        return replace(self, columns=columns, whole_table=self, kept_rows=rows)

    @property
    def rows(self) -> int:
        if self.kept_rows is not None:
            return len(self.kept_rows)
        return max(len(column) for column in self.columns.values())

    def finite_numbers(
        self, names: Sequence[str | int], width: int, where: str, rows: int | None = None
    ) -> Array:
        """Return the numbers (N, width) of the named columns; raise an error for NaN, infinity."""
        out, found = np.empty((0, width)), 0
        for name in names:  # one after the other, to save memory
            column = self._finite_column(str(name), where)
            rows = len(column) if rows is None else rows
            self._check_row_count(name, column, where, rows)
            out = out if found else np.empty((rows, width))
            found += column.shape[1]
            if found <= width:
                out[:, found - column.shape[1] : found] = column
        if found != width:
            what = f"lists {found} columns, but {width} are needed"
            remedy = f"list {width} columns of {self.path.name}"
            raise DrakeTeleopError(what, where=where, remedy=remedy)
        return out

    def _check_row_count(self, name: str | int, column: NDArray, where: str, rows: int) -> None:
        if len(column) != rows:
            what = f"{name!r} of {self.path.name} has {len(column)} rows where {rows} are needed"
            raise DrakeTeleopError(what, where=where, remedy="name columns that belong together")

    def numbers_with_nan_side_by_side(self, names: Sequence[str | int], where: str) -> Array:
        columns = [self.numbers_with_nan(name, where) for name in names]
        for name, column in zip(names, columns, strict=True):
            self._check_row_count(name, column, where, len(columns[0]))
        return np.hstack(columns)

    def numbers_with_nan(self, name: str | int, where: str) -> Array:
        """Return the numbers (N, k) of a column, with NaN and infinity; `where` is for errors."""
        name = str(name)
        if name not in self.columns:
            return self._finite_column(name, where)
        column = self.columns[name]
        numbers = _column_to_numbers(column, partial(self._not_a_number_error, name))
        numbers = numbers.reshape(len(column), math.prod(numbers.shape[1:]))
        self.check_magnitude(numbers, MAX_PLAUSIBLE_NUMBER, "", f"{self.path}:{name}")
        return numbers

    def single_column(self, name: str | int, where: str) -> Array:
        """Return the numbers (N,) of a column, with NaN and infinity."""
        numbers = self.numbers_with_nan(name, where)
        if numbers.shape[1] != 1:
            column = f"{str(name)!r} of {self.path.name}"
            what = f"{column} has {numbers.shape[1]} numbers per row, not 1"
            raise DrakeTeleopError(what, where=where, remedy="set a column with 1 number per row")
        return numbers[:, 0]

    def check_magnitude(
        self,
        values: Array,
        largest: float,
        unit: str,
        where: str,
        remedy: str = "check the column and its unit, or delete the row",
    ) -> None:
        """Raise an error that names the first row with a finite value beyond +-`largest`."""
        if not values.size or (values.min() >= -largest and values.max() <= largest):
            return
        bad = ((np.abs(values) > largest) & np.isfinite(values)).any(axis=1)
        if bad.any():
            first = int(np.argmax(bad))
            worst = values[first][np.argmax(np.abs(values[first]))]
            row = f"row {self.line_in_file(first)} of {self.path.name}"
            value = f"{worst:g} {unit}".rstrip()
            what = f"{value} in {row} is outside {-largest:g} to {largest:g}"
            raise DrakeTeleopError(what, where=where, remedy=remedy)

    def _finite_column(self, name: str, where: str) -> Array:
        if name not in self.columns:
            if name.rpartition(".")[0] in self.absent_groups:
                what = f"{self.path.name} marks {name!r} as not provided (covariance -1)"
                remedy = "name another column, or remove this field"
                raise DrakeTeleopError(what, where=where, remedy=remedy)
            similar = difflib.get_close_matches(name, self.columns, n=3, cutoff=0.5)
            hint = "did you mean" if similar else "its columns are"
            what = f"{self.path.name} has no column {name!r}"
            names = similar or list(self.columns)
            remedy = f"{hint} {', '.join(names[:12])}{', ...' if len(names) > 12 else ''}"
            raise DrakeTeleopError(what, where=where, remedy=remedy)
        numbers = self.numbers_with_nan(name, where)
        bad = ~np.isfinite(numbers).all(axis=1)
        if bad.any():
            row = self.line_in_file(int(np.argmax(bad)))
            what = f"no finite number in {int(bad.sum())} rows, the first is row {row}"
            remedy = "cut the log before this row, or repair the rows"
            raise DrakeTeleopError(what, where=f"{self.path}:{name}", remedy=remedy)
        return numbers

    def _not_a_number_error(self, name: str, row: int, cell: object) -> DrakeTeleopError:
        what = f"{cell!r} in row {self.line_in_file(row)} is not a number"
        remedy = "correct the cell or delete the row"
        if isinstance(cell, str) and (":" in cell or cell[4:5] == "-"):
            remedy = "write times in seconds, or as 2026-03-01T12:00:00.002"
        elif row == 0:
            remedy += ", for example a row of units, which belong into the log description"
        return DrakeTeleopError(what, where=f"{self.path}:{name}", remedy=remedy)


def decimal_resolution(values: Array) -> float:
    """Return the largest power of ten <= 1 of which all values are multiples; 0: none."""
    for decimals in range(_MAX_RESOLUTION_DECIMALS if values.any() else 0):
        error = np.abs(values - np.round(values, decimals))
        if (error <= 4.0 * np.finfo(float).eps * np.abs(values)).all():
            return float(10.0**-decimals)
    return 0.0


class ColumnsOnAccess(UserDict[str, Any]):
    """Columns by name; each access calls `read`."""

    def __init__(self, names: Iterable[str], read: Callable[[str], NDArray]) -> None:
        super().__init__(dict.fromkeys(names))
        self._read = read

    def __getitem__(self, key: str) -> NDArray:
        return self._read(key)


def _column_to_numbers(column: NDArray, reject: Callable[[int, object], DrakeTeleopError]) -> Array:
    if column.dtype.kind in "fiu":
        return column.astype(float, copy=False)
    if column.dtype.kind in "mM":  # seconds, since 1970 or midnight
        count = column.astype(f"{column.dtype.kind}8[ns]").astype(np.int64)
        return np.where(np.isnat(column), np.nan, count * 1e-9)
    if column.dtype.kind == "c" and len(column):  # float() would drop the imaginary part
        raise reject(0, column[0])
    numbers = np.empty(len(column))
    for row, cell in enumerate(column):
        try:
            number = cell.removesuffix(" sec") if isinstance(cell, str) else cell  # of MATLAB
            numbers[row] = np.nan if cell is None else float(number)
        except (TypeError, ValueError) as error:
            raise reject(row, cell) from error
        if isinstance(cell, str) and "_" in cell:  # which Python ignores
            raise reject(row, cell)
    return numbers
