"""Check of the sizes in a Parquet file: a damaged size can make polars abort the process."""

from __future__ import annotations

import mmap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

_PARQUET_MAGIC = b"PAR1"
_FOOTER_TAIL_SIZE_BYTES = 8  # bytes: length of the footer, and magic
_DATA_PAGE_TYPE, _DICTIONARY_PAGE_TYPE, _DATA_PAGE_V2_TYPE = 0, 2, 3
_REPETITION_TYPE_REPEATED = 2
# Type codes of Thrift.
_TRUE, _FALSE, _BYTE_TYPE, _DOUBLE_TYPE, _BINARY_TYPE, _STRUCT_TYPE = 1, 2, 3, 7, 8, 12
_INTEGER_TYPES, _LIST_TYPES = (4, 5, 6), (9, 10)
_MAX_THRIFT_NESTING_DEPTH = 32
_MAX_VARINT_BYTES = 10

_ThriftStruct = dict[int, Any]


def check_parquet_sizes(path: Path) -> None:
    """Raise ValueError if a Parquet file is empty or its numbers of rows or bytes do not agree."""
    with path.open("rb") as file:
        if not file.read(1):
            raise ValueError("the file is empty")
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            check_parquet_content_sizes(content)


def check_parquet_content_sizes(content: bytes | mmap.mmap) -> None:
    try:
        _check_footer_and_columns(content)
    except (IndexError, KeyError, TypeError, AttributeError, UnicodeDecodeError):
        raise ValueError("the file is damaged: its metadata cannot be read") from None


def _check_footer_and_columns(content: bytes | mmap.mmap) -> None:
    end = len(content) - _FOOTER_TAIL_SIZE_BYTES
    if end < len(_PARQUET_MAGIC) or content[-len(_PARQUET_MAGIC) :] != _PARQUET_MAGIC:
        raise ValueError("the file does not end with PAR1, as a Parquet file does")
    start = end - int.from_bytes(content[end : end + 4], "little")
    _require(start >= len(_PARQUET_MAGIC), "its footer is longer than the file")
    footer = _ThriftReader(content[start:end]).read_struct()
    columns = list(_read_column_names_and_flat_flags(footer[2]))
    groups = footer.get(4, [])
    rows = [_read_size(group, 3, "rows in a row group") for group in groups]
    same_rows = _read_size(footer, 3, "rows") == sum(rows)
    _require(same_rows, "the rows of its row groups do not add up to its number of rows")
    for group, count in zip(groups, rows, strict=True):
        _require(len(group[1]) == len(columns), "a row group and the schema have different columns")
        for chunk, (name, is_flat) in zip(group[1], columns, strict=True):
            _check_column_chunk(content, start, chunk[3], name, count if is_flat else None)


def _read_column_names_and_flat_flags(schema: list[_ThriftStruct]) -> Iterator[tuple[str, bool]]:
    above = [(len(schema), True)]  # of each enclosing group: remaining children, is flat
    for element in schema:
        while above[-1][0] == 0:
            above.pop()
        left, is_flat = above[-1]
        above[-1] = left - 1, is_flat
        is_flat = is_flat and element.get(3) != _REPETITION_TYPE_REPEATED
        if children := _read_size(element, 5, "children", 0):
            above.append((children, is_flat))
        elif element is not schema[0]:
            yield element[4].decode(), is_flat


def _check_column_chunk(
    content: bytes | mmap.mmap, data_end: int, column: _ThriftStruct, name: str, rows: int | None
) -> None:
    values = _read_size(column, 5, f"values in {name}")
    _require(rows in (None, values), f"column {name} has {values} values but {rows} rows")
    largest = _read_size(column, 6, f"bytes in {name}")
    length = _read_size(column, 7, f"bytes in {name}")
    at = _read_size(column, 9, f"the first byte of {name}")
    at = min(at, _read_size(column, 11, f"the first byte of {name}", 0) or at)
    _require(at + length <= data_end, f"{name} goes beyond the end of the file")
    found, where = 0, f"a page of {name}"
    while found < values:
        reader = _ThriftReader(content, at)
        page = reader.read_struct()
        length = _read_size(page, 3, f"bytes in {where}")
        at = reader.at + length
        _require(at <= data_end, f"{where} goes beyond the end of the file")
        size = _read_size(page, 2, f"bytes in {where}")
        _require(size <= largest, f"{where} is larger than {name}")
        found += _count_values_of_page(page, length, where)
    _require(found == values, f"the pages of {name} have {found} values instead of {values}")


def _count_values_of_page(page: _ThriftStruct, length: int, where: str) -> int:
    kind, what = page[1], f"values in {where}"
    if kind == _DATA_PAGE_TYPE:
        return _read_size(page[5], 1, what)
    if kind == _DICTIONARY_PAGE_TYPE:
        values = _read_size(page[7], 1, what)
        _require(values <= page[2], f"{where} has only {page[2]} bytes for {values} values")
    if kind != _DATA_PAGE_V2_TYPE:
        return 0
    header = page[8]
    values = _read_size(header, 1, what)
    for number, name in ((2, "nulls"), (3, "rows")):
        size = _read_size(header, number, f"{name} in {where}")
        _require(size <= values, f"{where} has {size} {name} but only {values} values")
    levels = sum(_read_size(header, number, f"bytes in {where}") for number in (5, 6))
    _require(levels <= length, f"{where} has {length} bytes, but its null flags have {levels}")
    return values


def _read_size(struct: _ThriftStruct, field_id: int, what: str, default: int | None = None) -> int:
    size = struct[field_id] if default is None else struct.get(field_id, default)
    _require(isinstance(size, int) and size >= 0, f"the number of {what} is {size!r}")
    return int(size)


def _require(condition: bool, damage: str) -> None:
    if not condition:
        raise ValueError(f"the file is damaged: {damage}")


class _ThriftReader:
    def __init__(self, content: bytes | mmap.mmap, at: int = 0) -> None:
        self._content, self.at = content, at

    def read_struct(self, depth: int = 0) -> _ThriftStruct:
        _require(depth < _MAX_THRIFT_NESTING_DEPTH, "its metadata is nested too deeply")
        fields: _ThriftStruct = {}
        number = 0
        while head := self._read_byte():
            number = number + (head >> 4) if head >> 4 else self._read_zigzag_integer()
            kind = head & 15
            fields[number] = kind == _TRUE if kind <= _FALSE else self._read_value(kind, depth + 1)
        return fields

    def _read_value(self, kind: int, depth: int) -> Any:
        if kind in _INTEGER_TYPES:
            return self._read_zigzag_integer()
        if kind == _BINARY_TYPE:
            return self._read_bytes(self._read_varint())
        if kind == _STRUCT_TYPE:
            return self.read_struct(depth)
        if kind in _LIST_TYPES:
            return self._read_list(depth)
        if kind <= _BYTE_TYPE:  # a boolean in a list has its own byte
            return self._read_byte()
        _require(kind == _DOUBLE_TYPE, "its metadata has an unknown type")
        return self._read_bytes(8)

    def _read_list(self, depth: int) -> list[Any]:
        _require(depth < _MAX_THRIFT_NESTING_DEPTH, "its metadata is nested too deeply")
        head = self._read_byte()
        size = head >> 4 if head >> 4 < 15 else self._read_varint()
        return [self._read_value(head & 15, depth + 1) for _ in range(size)]

    def _read_bytes(self, size: int) -> bytes:
        at, self.at = self.at, self.at + size
        _require(self.at <= len(self._content), "a value of its metadata is cut off")
        return bytes(self._content[at : self.at])

    def _read_byte(self) -> int:
        self.at += 1
        return self._content[self.at - 1]

    def _read_zigzag_integer(self) -> int:
        number = self._read_varint()
        return (number >> 1) ^ -(number & 1)

    def _read_varint(self) -> int:
        if (byte := self._read_byte()) < 128:
            return byte
        number = byte & 127
        for place in range(1, _MAX_VARINT_BYTES):
            byte = self._read_byte()
            number |= (byte & 127) << 7 * place
            if byte < 128:
                return number
        raise ValueError("the file is damaged: a number in its metadata is too long")
