"""Reading of tables from text, Excel, Parquet, Arrow, JSON lines, NumPy, MATLAB, HDF5 and Zarr.

Nested columns become several: `name.field` for the fields of a structure, and `name[k]` for the
elements of a list or array of constant length, besides the whole as `name`. Separator, decimal
sign, header and encoding (UTF-8, UTF-16, else Windows-1252) of text are detected.
"""

from __future__ import annotations

import codecs
import math
import os
import re
import zipfile
from collections.abc import Callable, Mapping, MutableMapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common import errors
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.parquet_sizes import check_parquet_sizes
from drake_teleop.common.registry import Registry
from drake_teleop.logs.read.array_files import read_hdf5, read_mat, read_zarr
from drake_teleop.logs.read.description_fields import known_unit
from drake_teleop.logs.read.tables import ColumnsOnAccess, Table

if TYPE_CHECKING:
    import polars as pl

_TEXT_SUFFIXES = (".csv", ".tsv", ".txt", ".dat", ".log")
_WRENCH_COLUMN_NAMES = {"f_x", "f_y", "f_z", "tau_x", "tau_y", "tau_z"}
_ColumnType = TypeVar("_ColumnType")
_MAX_ELEMENT_COLUMNS = 16  # elements of an array with their own columns: up to a homogeneous matrix
_INSPECTED_HEAD_BYTES = 2**16  # bytes from which the format is detected
_ROWS_FOR_TYPE_INFERENCE = 1000  # rows from which column types are inferred
_UTF_16_BYTE_ORDER_MARKS = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
_LONE_CR_PATTERN = re.compile(rb"\r(?!\n)")
_BLANK_BYTES = b' \t,;\r\n\x00\x1a"'  # characters of lines without a cell
_QUOTED_DECIMAL_COMMA_CELL = re.compile(rb'"\s*([-+]?\d*),(\d+(?:[eE][-+]?\d+)?)\s*"')
_THOUSANDS_COMMA_PATTERN = re.compile(rb"[-+]?[1-9]\d{0,2},\d{3}")
_QUOTED_TEXT_PATTERN = re.compile('"[^"]*"')
_DECIMAL_COMMA_CELL_PATTERN = re.compile(r"\s*[-+]?\d*,\d+([eE][-+]?\d+)?\s*")
_MIN_WRENCH_COLUMNS = 6
_MIN_SHEET_ROW_RATIO = 0.5  # rows of a second log in an Excel file, over those of the first
_TIME_CELL_PATTERN = re.compile(r"\d[\dT:./ +-]*Z?")  # of dates and times of day
_MAX_CELLS_IN_MEMORY = 2**24  # of a Parquet file; columns of larger ones are read on access


def note_that_table_needs_description(source: str) -> str:
    """Return a remark that fields of a table require a log description; "" for a description."""
    if Path(source).suffix.lower() not in TABLE_READERS:
        return ""
    return " (in a log description of this table; the canonical form has no such line)"


def read_table(path: Path, *, header: bool = True) -> Table:
    """Read a file with a suffix in `TABLE_READERS`; columns without header are "0", "1", ..."""
    kind = TABLE_READERS.check(path.suffix.lower(), str(path))
    require_file(path, folder=kind == ".zarr")
    errors.refuse_polars_in_forked_process()
    with errors.wrap_read_errors(path, f"check that the file is a valid {path.suffix} file"):
        columns = _read_text(path, header) if kind in _TEXT_SUFFIXES else TABLE_READERS[kind](path)
        table = columns if isinstance(columns, Table) else Table(path, columns)
    if not table.columns or not all(len(c) for c in table.columns.values()):
        raise DrakeTeleopError("has no rows", where=str(path), remedy="record it again")
    return table


def require_file(path: Path, *, folder: bool = False) -> None:
    if not (os.path.isdir if folder else os.path.isfile)(path):
        what = "no such folder" if folder else "no such file"
        if os.path.exists(path):
            what = "is a file, not a folder" if folder else "is a folder, not a file"
        raise DrakeTeleopError(what, where=str(path), remedy="check the path")


def _read_text(path: Path, header: bool = True) -> Table:
    frame, first_row = read_csv(path, header)
    names = [name if header else str(i) for i, name in enumerate(frame.columns)]
    found = [_to_numpy(series) for series in frame.get_columns()]
    columns = dict(zip(_strip_column_names(names), found, strict=True))
    return Table(path, _add_lower_case_names_if_canonical(columns), first_row)


def read_csv(path: Path, header: bool) -> tuple[pl.DataFrame, int]:
    """Return the table of a CSV file, and the line number of its first data row."""
    import polars as pl

    with path.open("rb") as file:
        head = file.read(_INSPECTED_HEAD_BYTES)
    source: Path | bytes = path
    if head.startswith(_UTF_16_BYTE_ORDER_MARKS):
        source = path.read_text("utf-16").encode()
    elif b"\0" not in head and not _is_utf_8(head):  # no binary file
        source = path.read_bytes().decode("cp1252", "replace").encode()
    head = head if isinstance(source, Path) else source[:_INSPECTED_HEAD_BYTES]
    if (text := _normalize_line_ends_and_decimal_commas(path, source, head)) is not None:
        source, head = text, text[:_INSPECTED_HEAD_BYTES]
    lines = re.split("\r?\n", head.decode("utf-8", "replace").lstrip("\ufeff"))
    table = (i for i, line in enumerate(lines) if line.strip() and not line.startswith("#"))
    before = next(table, 0)
    before, first, units = _find_table_below_text(lines, before) or (before, before + 1, [])
    cut = first - before - 1  # lines between the header and the numbers
    if cut > 0:
        text = path.read_bytes() if isinstance(source, Path) else source
        pieces = text.split(b"\n", first)
        source = b"\n".join([*pieces[: before + 1], pieces[-1]])
        del lines[before + 1 : first]
    rest = lines[before:]
    separator = find_separator(rest[0]) if rest else ","
    if separator == " " and any(line != " ".join(line.split()) for line in rest):
        text = path.read_bytes() if isinstance(source, Path) else source
        aligned = text.removeprefix(codecs.BOM_UTF8).splitlines()
        source = b"\n".join([b" ".join(line.split()) for line in aligned])
        rest = [" ".join(line.split()) for line in rest]
    names = _header_in_comment(lines[:before], rest, separator) if header else None
    header = header and names is None
    parse = partial(
        pl.read_csv,
        source,
        has_header=header,
        separator=separator,
        decimal_comma=has_decimal_commas(rest, separator),
        skip_lines=before,
        try_parse_dates=True,
    )
    frame = None
    with suppress(pl.exceptions.ComputeError):
        frame = parse(infer_schema_length=_ROWS_FOR_TYPE_INFERENCE)
    if frame is None or not all(kind.is_numeric() for kind in frame.dtypes):
        frame = parse(infer_schema_length=None)
    if names is not None:
        frame.columns = names
    elif header and units:
        pairs = zip(frame.columns, units, strict=True)
        frame.columns = [f"{name} [{unit}]" if unit else name for name, unit in pairs]
    return frame, before + cut + (2 if header else 1)


def _normalize_line_ends_and_decimal_commas(
    path: Path, source: Path | bytes, head: bytes
) -> bytes | None:
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - _INSPECTED_HEAD_BYTES))
        tail = file.read() if isinstance(source, Path) else source
    returns, commas = bool(_LONE_CR_PATTERN.search(head)), _QUOTED_DECIMAL_COMMA_CELL.findall(head)
    # "1,500" can be 1500.
    commas = [found for found in commas if not _THOUSANDS_COMMA_PATTERN.fullmatch(b",".join(found))]
    if not (returns or commas or _length_without_blank_end(tail) < len(tail)):
        return None
    text = path.read_bytes() if isinstance(source, Path) else source
    text = _LONE_CR_PATTERN.sub(b"\n", text) if returns else text
    text = _QUOTED_DECIMAL_COMMA_CELL.sub(rb"\1.\2", text) if commas else text
    return text[: _length_without_blank_end(text)]


def _length_without_blank_end(text: bytes) -> int:
    line = text.find(b"\n", len(text.rstrip(_BLANK_BYTES)))
    return len(text) if line < 0 else line + 1


def _is_utf_8(head: bytes) -> bool:
    with suppress(UnicodeDecodeError):
        codecs.getincrementaldecoder("utf-8")().decode(head)
        return True
    return False


def _find_table_below_text(lines: list[str], start: int) -> tuple[int, int, list[str]] | None:
    """Return the line of the header, the first line of numbers, and the units between them.

    Return None if the table begins at line `start`, or if a line in it is unclear.
    """
    rows = [_split_cells(line) for line in lines]

    def is_data(k: int) -> bool:
        return len(rows[k]) == len(rows[k + 1]) and all(map(_is_data_row, rows[k : k + 2]))

    first = next(filter(is_data, range(start, len(lines) - 1)), start)
    width, above = len(rows[first]), range(first - 1, start - 1, -1)
    if first <= start + 1 or any(len(rows[k]) == width and _is_data_row(rows[k]) for k in above):
        return None
    wide = (k for k in above if width in (len(rows[k]), len(rows[k]) - (not rows[k][-1])))
    names = [k for k in wide if not _is_row_of_units(rows[k])]
    whole = [k for k in names if len(set(rows[k])) == len(rows[k])]
    header = (whole or names or [first])[0]
    between = [rows[k] for k in above if k > header and rows[k] != [""]]
    if not all(map(_is_row_of_units, between)):
        return None
    units = [cell.strip("[]() ") for cell in between[-1]] if between else []
    return (header, first, units) if header < first else (first, first + 1, [])


def _split_cells(line: str) -> list[str]:
    separator = find_separator(line)
    return [x.strip(' \t"') for x in line.split(None if separator == " " else separator)]


def _is_data_row(cells: list[str]) -> bool:
    numbers = sum(map(is_decimal_number, cells))
    others = [cell for cell in cells if cell and not is_decimal_number(cell)]
    # A single number beside empty cells can be text above the table.
    if not numbers or numbers + len(others) < (1 if len(cells) == 2 else 2):
        return False
    return all(map(_TIME_CELL_PATTERN.fullmatch, others)) or numbers >= max(3, len(cells) / 2)


def _is_row_of_units(cells: list[str]) -> bool:
    filled = [cell for cell in cells if cell]
    known = [cell for cell in filled if cell[0] in "[(" or known_unit(cell)]
    return len(cells) > 1 and 2 * len(known) >= len(filled) > 0


def find_separator(line: str) -> str:
    bare = _QUOTED_TEXT_PATTERN.sub("", line).strip()
    if ";" in bare or "\t" in bare:
        return ";" if ";" in bare else "\t"
    return " " if "," not in bare and " " in bare else ","


def has_decimal_commas(lines: Sequence[str], separator: str) -> bool:
    cells = (cell for line in lines for cell in line.split(separator))
    return separator in ";\t" and any(map(_DECIMAL_COMMA_CELL_PATTERN.fullmatch, cells))


def _header_in_comment(comments: list[str], rows: list[str], separator: str) -> list[str] | None:
    marked = [line for line in comments if line.startswith("#")]
    if not marked or not all(is_decimal_number(cell) for cell in rows[0].split(separator)):
        return None
    cells = None if separator == " " else separator
    names = [name.strip() for name in marked[-1].lstrip("# ").split(cells)]
    matching = len(names) == len(rows[0].split(separator)) and len(set(names)) == len(names)
    return names if matching else None


def is_decimal_number(cell: str) -> bool:
    with suppress(ValueError):
        float(cell.replace(",", "."))
        return True
    return False


def _strip_column_names(names: list[str]) -> list[str]:
    stripped = [name.strip() for name in names]
    if len(set(stripped)) < len(names):
        raise ValueError("two column names differ only in spaces at their ends; rename one")
    return stripped


def _add_lower_case_names_if_canonical(columns: dict[str, _ColumnType]) -> dict[str, _ColumnType]:
    small = {name.lower(): column for name, column in columns.items()}
    canonical = len(small) == len(columns) and _WRENCH_COLUMN_NAMES.issubset(small)
    return small | columns if canonical and not _WRENCH_COLUMN_NAMES.issubset(columns) else columns


def _read_with_polars(path: Path) -> dict[str, NDArray] | ColumnsOnAccess:
    import polars as pl

    kind = path.suffix.lower()
    if kind == ".parquet":
        check_parquet_sizes(path)
        frame = pl.scan_parquet(path)
    else:
        from_json = partial(pl.read_ndjson, infer_schema_length=None)
        read = pl.read_ipc if kind in (".arrow", ".feather") else from_json
        frame = read(path.read_bytes()).lazy()
    columns = _column_expressions(frame)
    rows = frame.select(pl.len()).collect().item()
    if kind == ".parquet" and len(columns) * rows > _MAX_CELLS_IN_MEMORY:

        def read_column(name: str) -> NDArray:
            return _to_numpy(frame.select(columns[name].alias("x")).collect().to_series())

        return ColumnsOnAccess(columns, read_column)  # to limit memory
    return _collect_columns(frame, columns)


def _read_excel(path: Path) -> Table:
    import polars as pl

    sheets = pl.read_excel(path, sheet_id=0, raise_if_empty=False)
    number = pl.all().cast(pl.Float64, strict=False)
    rows, wide = dict.fromkeys(sheets, 0), []
    for name, sheet in sheets.items():
        if sheet.width:
            cells = sheet.select(number.is_not_null())
            rows[name] = int(cells.select((pl.sum_horizontal(pl.all()) > 1).sum()).item())
            full = cells.select(pl.all().sum() > 0.5 * rows[name]).row(0)
            wide += [name] if rows[name] and sum(full) >= _MIN_WRENCH_COLUMNS else []
    best = max(wide or rows, key=lambda name: rows[name])
    if similar := [x for x in wide if x != best and rows[x] >= _MIN_SHEET_ROW_RATIO * rows[best]]:
        names = ", ".join(map(repr, similar))
        what = f"the sheets {best!r} and {names} have tables of similar size"
        raise DrakeTeleopError(what, where=str(path), remedy="save each sheet as a CSV file")
    others = ", ".join(repr(name) for name in sheets if name != best)
    note = f"{path.name}: the sheet {best!r} was read; other sheets: {others}" if others else ""
    return Table(path, columns_of_frame(sheets[best].lazy()), first_row=2, note=note)


def _column_expressions(frame: pl.LazyFrame) -> dict[str, pl.Expr]:
    import polars as pl

    columns: dict[str, pl.Expr] = {}

    def add(label: str, column: pl.Expr, dtype: Any) -> None:
        length = 0
        if isinstance(dtype, pl.Struct):
            for field in dtype.fields:
                add(f"{label}.{field.name}", column.struct.field(field.name), field.dtype)
            return
        if isinstance(dtype, pl.List):
            lengths = frame.select(column.list.len().drop_nulls().unique()).collect().to_series()
            if not dtype.inner.is_numeric() or len(lengths) != 1 or not lengths[0]:
                return
            column, length = column.list.to_array(lengths[0]), int(lengths[0])
        elif isinstance(dtype, pl.Array):
            if not (dtype.inner.is_numeric() or isinstance(dtype.inner, pl.Array)):
                return
            length = dtype.shape[0] if len(dtype.shape) == 1 else 0
        elif isinstance(dtype, (pl.Binary, pl.Object)):
            return
        for k in range(min(length, _MAX_ELEMENT_COLUMNS)):
            columns[f"{label}[{k}]"] = column.arr.get(k)
        columns[label] = column

    for name, dtype in frame.collect_schema().items():
        add(name.strip(), pl.col(name), dtype)
    _strip_column_names(list(frame.collect_schema()))
    return _add_lower_case_names_if_canonical(columns)


def columns_of_frame(frame: pl.LazyFrame) -> dict[str, NDArray]:
    """Return the columns of a frame, and the elements of lists and structures, by name."""
    return _collect_columns(frame, _column_expressions(frame))


def _collect_columns(frame: pl.LazyFrame, columns: dict[str, pl.Expr]) -> dict[str, NDArray]:
    whole = frame.select(column.alias(name) for name, column in columns.items()).collect()
    return {series.name: _to_numpy(series) for series in whole.get_columns()}


def _to_numpy(series: pl.Series) -> NDArray:
    import polars as pl

    if series.dtype == pl.Time:
        series = series.cast(pl.Duration("ns"))
    if series.dtype in (pl.Datetime, pl.Duration):
        return series.to_numpy()
    if series.dtype == pl.Int128:  # not supported by NumPy
        series = series.cast(pl.Float64)
    if isinstance(series.dtype, pl.Array):
        if not series.null_count():
            return series.to_numpy()
        empty = [math.nan] * series.dtype.shape[0]
        return np.array([empty if row is None else row for row in series.to_list()], dtype=float)
    # Empty cells become NaN, which is reported with its row later.
    return series.to_numpy() if series.dtype.is_numeric() else series.cast(pl.String).to_numpy()


def array_columns(
    arrays: Mapping[str, NDArray], max_elements: int | None = _MAX_ELEMENT_COLUMNS
) -> dict[str, NDArray]:
    """Return arrays (N, ...) by name as columns, and their first `max_elements` as `name[k]`."""
    arrays = {name: array for name, array in arrays.items() if len(array)}
    parts = {
        f"{name}[{k}]": column
        for name, array in arrays.items()
        if 1 < array.ndim <= 3
        for k, column in enumerate(array.reshape(len(array), -1).T[:max_elements])
    }
    return parts | arrays


def _read_npz(path: Path) -> dict[str, NDArray]:
    if not zipfile.is_zipfile(path):
        raise ValueError("the file is not a complete NPZ archive; numpy.savez writes one")
    with np.load(path, allow_pickle=False) as archive:
        columns = {key: archive[key] for key in archive.files}
    return {key: x for key, x in columns.items() if isinstance(x, np.ndarray) and x.ndim}


def _read_npy(path: Path) -> dict[str, NDArray]:
    array = np.load(path, allow_pickle=False)
    if array.dtype.names is not None:
        return {name: array[name] for name in array.dtype.names}
    if array.ndim != 2:
        raise ValueError(f"the array has {array.ndim} dimensions; save one of rows and columns")
    return {str(k): array[:, k] for k in range(array.shape[1])}


_ArrayReader = Callable[[Path], dict[str, NDArray]]
_ARRAY_READERS: dict[str, _ArrayReader] = {".npz": _read_npz, ".npy": _read_npy, ".mat": read_mat}
_ARRAY_READERS |= {".h5": read_hdf5, ".hdf5": read_hdf5, ".zarr": read_zarr}


def _table_reader_of_arrays(read: _ArrayReader) -> _ArrayReader:
    return lambda path: array_columns(_with_samples_as_rows(read(path)))


def _with_samples_as_rows(arrays: dict[str, NDArray]) -> dict[str, NDArray]:
    """Move the last axis of arrays (k, ..., N > k) first if the file's 1-D arrays have length N."""
    lengths = {len(array) for array in arrays.values() if array.ndim == 1}

    def is_transposed(array: NDArray) -> bool:
        rows, last = len(array), array.shape[-1]
        return array.ndim > 1 and rows < last and rows not in lengths and last in lengths

    return {name: np.moveaxis(x, -1, 0) if is_transposed(x) else x for name, x in arrays.items()}


TABLE_READERS: Registry[Callable[[Path], MutableMapping[str, NDArray] | Table]] = Registry(
    "log format",
    {
        **dict.fromkeys(_TEXT_SUFFIXES, _read_text),
        **dict.fromkeys((".parquet", ".arrow", ".feather", ".jsonl", ".ndjson"), _read_with_polars),
        ".xlsx": _read_excel,
        **{suffix: _table_reader_of_arrays(read) for suffix, read in _ARRAY_READERS.items()},
    },
)
"""Readers of files by suffix; a reader returns columns by name."""
