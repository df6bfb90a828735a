"""CSV files, with detection of separator, decimal sign, header and encoding (UTF-8, UTF-16).

Lines with `#` before the header are comments, except column names directly before the numbers.
"""

from __future__ import annotations

import codecs
import re
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import polars as pl

_INSPECTED_HEAD_BYTES = 2**16  # bytes from which the format is detected
_ROWS_FOR_TYPE_INFERENCE = 1000  # rows from which column types are inferred
_UTF_16_MARKS = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
_LONE_CR_PATTERN = re.compile(rb"\r(?!\n)")
_BLANK_BYTES = b' \t,;\r\n\x00\x1a"'  # characters of lines without a cell
_QUOTED_NUMBER_PATTERN = re.compile(rb'"\s*([-+]?\d*),(\d+(?:[eE][-+]?\d+)?)\s*"')
_THOUSANDS_PATTERN = re.compile(rb"[-+]?[1-9]\d{0,2},\d{3}")
_QUOTED_TEXT_PATTERN = re.compile('"[^"]*"')
_DECIMAL_COMMA_CELL_PATTERN = re.compile(r"\s*[-+]?\d*,\d+([eE][-+]?\d+)?\s*")


def read_csv(path: Path, header: bool) -> tuple[pl.DataFrame, int]:
    """Return the table of a CSV file, and the number of its first data line."""
    import polars as pl

    with path.open("rb") as file:
        head = file.read(_INSPECTED_HEAD_BYTES)
    source: Path | bytes = path
    if head.startswith(_UTF_16_MARKS):
        source = path.read_text("utf-16").encode()
        head = source[:_INSPECTED_HEAD_BYTES]
    if (text := _normalize_line_ends_and_decimal_commas(path, source, head)) is not None:
        source, head = text, text[:_INSPECTED_HEAD_BYTES]
    lines = head.decode("utf-8", "replace").lstrip("\ufeff").splitlines()
    table = (i for i, line in enumerate(lines) if line.strip() and not line.startswith("#"))
    before = next(table, 0)
    rest = lines[before:]
    separator = _find_separator(rest[0]) if rest else ","
    if separator == " " and any(line != " ".join(line.split()) for line in rest):
        text = path.read_bytes() if isinstance(source, Path) else source
        aligned = text.removeprefix(codecs.BOM_UTF8).splitlines()
        source = b"\n".join([b" ".join(line.split()) for line in aligned])
        rest = [" ".join(line.split()) for line in rest]
    names = _names_in_comment(lines[:before], rest, separator) if header else None
    header = header and names is None
    cells = (cell for line in rest for cell in line.split(separator))
    parse = partial(
        pl.read_csv,
        source,
        has_header=header,
        separator=separator,
        decimal_comma=separator in ";\t" and any(map(_DECIMAL_COMMA_CELL_PATTERN.fullmatch, cells)),
        skip_lines=before,
        try_parse_dates=True,
    )
    frame = _parse_with_inferred_types(parse)
    if names is not None:
        frame.columns = names
    return frame, before + (2 if header else 1)


def _normalize_line_ends_and_decimal_commas(
    path: Path, source: Path | bytes, head: bytes
) -> bytes | None:
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - _INSPECTED_HEAD_BYTES))
        tail = file.read() if isinstance(source, Path) else source
    returns, commas = bool(_LONE_CR_PATTERN.search(head)), _QUOTED_NUMBER_PATTERN.findall(head)
    # "1,500" can be 1500.
    commas = [found for found in commas if not _THOUSANDS_PATTERN.fullmatch(b",".join(found))]
    if not (returns or commas or _length_without_blank_end(tail) < len(tail)):
        return None
    text = path.read_bytes() if isinstance(source, Path) else source
    text = _LONE_CR_PATTERN.sub(b"\n", text) if returns else text
    text = _QUOTED_NUMBER_PATTERN.sub(rb"\1.\2", text) if commas else text
    return text[: _length_without_blank_end(text)]


def _length_without_blank_end(text: bytes) -> int:
    line = text.find(b"\n", len(text.rstrip(_BLANK_BYTES)))
    return len(text) if line < 0 else line + 1


def _parse_with_inferred_types(parse: Callable[..., pl.DataFrame]) -> pl.DataFrame:
    import polars as pl

    with suppress(pl.exceptions.ComputeError):
        frame = parse(infer_schema_length=_ROWS_FOR_TYPE_INFERENCE)
        if all(kind.is_numeric() for kind in frame.dtypes):
            return frame
    return parse(infer_schema_length=None)


def _find_separator(line: str) -> str:
    bare = _QUOTED_TEXT_PATTERN.sub("", line).strip()
    if ";" in bare or "\t" in bare:
        return ";" if ";" in bare else "\t"
    return " " if "," not in bare and " " in bare else ","


def _names_in_comment(comments: list[str], rest: list[str], separator: str) -> list[str] | None:
    marked = [line for line in comments if line.startswith("#")]
    if not marked or not all(_is_number(cell) for cell in rest[0].split(separator)):
        return None
    cells = None if separator == " " else separator
    names = [name.strip() for name in marked[-1].lstrip("# ").split(cells)]
    matching = len(names) == len(rest[0].split(separator)) and len(set(names)) == len(names)
    return names if matching else None


def _is_number(cell: str) -> bool:
    try:
        float(cell.replace(",", "."))
    except ValueError:
        return False
    return True
