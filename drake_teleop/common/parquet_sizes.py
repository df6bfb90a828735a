"""Check of the sizes in a Parquet file: a damaged size can make polars abort the process."""

from __future__ import annotations

import mmap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

_MAGIC = b"PAR1"
_FOOTER_END = 8  # bytes: length of the footer, and magic
_DATA_PAGE, _DICTIONARY_PAGE, _DATA_PAGE_V2 = 0, 2, 3
_REPEATED = 2
# Type codes of Thrift.
_TRUE, _FALSE, _BYTE, _DOUBLE, _BINARY, _STRUCT = 1, 2, 3, 7, 8, 12
_INTEGERS, _LISTS = (4, 5, 6), (9, 10)
_MAX_DEPTH = 32
_MAX_NUMBER_BYTES = 10

_Struct = dict[int, Any]


def check_parquet(path: Path) -> None:
    """Raise ValueError, with column and number, if sizes in a Parquet file are wrong."""
    with path.open("rb") as file:
        if not file.read(1):
            raise ValueError("it is empty")
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            check_parquet_content(content)


def check_parquet_content(content: bytes | mmap.mmap) -> None:
    try:
        _check(content)
    except (IndexError, KeyError, TypeError, AttributeError, UnicodeDecodeError):
        raise ValueError("it is damaged: its metadata cannot be read") from None


def _check(content: bytes | mmap.mmap) -> None:
    end = len(content) - _FOOTER_END
    if end < len(_MAGIC) or content[-len(_MAGIC) :] != _MAGIC:
        raise ValueError("it does not end as a Parquet file does")
    start = end - int.from_bytes(content[end : end + 4], "little")
    _require(start >= len(_MAGIC), "its footer is longer than the file")
    footer = _CompactReader(content[start:end]).struct()
    columns = list(_columns(footer[2]))
    groups = footer.get(4, [])
    rows = [_size(group, 3, "rows in a row group") for group in groups]
    _require(_size(footer, 3, "rows") == sum(rows), "its row groups do not add up to its rows")
    for group, count in zip(groups, rows, strict=True):
        _require(len(group[1]) == len(columns), "a row group has not the columns of the schema")
        for chunk, (name, is_flat) in zip(group[1], columns, strict=True):
            _check_column(content, start, chunk[3], name, count if is_flat else None)


def _columns(schema: list[_Struct]) -> Iterator[tuple[str, bool]]:
    above = [(len(schema), True)]  # of each enclosing group: remaining children, is flat
    for element in schema:
        while above[-1][0] == 0:
            above.pop()
        left, is_flat = above[-1]
        above[-1] = left - 1, is_flat
        is_flat = is_flat and element.get(3) != _REPEATED
        if children := _size(element, 5, "children", 0):
            above.append((children, is_flat))
        elif element is not schema[0]:
            yield element[4].decode(), is_flat


def _check_column(
    content: bytes | mmap.mmap, end: int, column: _Struct, name: str, rows: int | None
) -> None:
    values = _size(column, 5, f"values in {name}")
    _require(rows in (None, values), f"{name} has {values} values in {rows} rows")
    largest, length = _size(column, 6, f"bytes in {name}"), _size(column, 7, f"bytes in {name}")
    at = _size(column, 9, f"the first byte of {name}")
    at = min(at, _size(column, 11, f"the first byte of {name}", 0) or at)
    _require(at + length <= end, f"{name} goes beyond the end of the file")
    found, where = 0, f"a page of {name}"
    while found < values:
        reader = _CompactReader(content, at)
        page = reader.struct()
        length = _size(page, 3, f"bytes in {where}")
        at = reader.at + length
        _require(at <= end, f"{where} goes beyond the end of the file")
        _require(_size(page, 2, f"bytes in {where}") <= largest, f"{where} is larger than {name}")
        found += _values(page, length, where)
    _require(found == values, f"the pages of {name} have {found} values instead of {values}")


def _values(page: _Struct, length: int, where: str) -> int:
    kind, what = page[1], f"values in {where}"
    if kind == _DATA_PAGE:
        return _size(page[5], 1, what)
    if kind == _DICTIONARY_PAGE:
        _require(_size(page[7], 1, what) <= page[2], f"{where} has fewer bytes than values")
    if kind != _DATA_PAGE_V2:
        return 0
    header = page[8]
    values = _size(header, 1, what)
    _require(_size(header, 2, f"nulls in {where}") <= values, f"{where} has more nulls than values")
    _require(_size(header, 3, f"rows in {where}") <= values, f"{where} has more rows than values")
    levels = sum(_size(header, number, f"bytes in {where}") for number in (5, 6))
    _require(levels <= length, f"{where} is shorter than its levels")
    return values


def _size(struct: _Struct, number: int, what: str, default: int | None = None) -> int:
    size = struct[number] if default is None else struct.get(number, default)
    _require(isinstance(size, int) and size >= 0, f"the number of {what} is {size!r}")
    return int(size)


def _require(condition: bool, otherwise: str) -> None:
    if not condition:
        raise ValueError(f"it is damaged: {otherwise}")


class _CompactReader:
    def __init__(self, content: bytes | mmap.mmap, at: int = 0) -> None:
        self._content, self.at = content, at

    def struct(self, depth: int = 0) -> _Struct:
        _require(depth < _MAX_DEPTH, "its metadata is nested too deeply")
        fields: _Struct = {}
        number = 0
        while head := self._byte():
            number = number + (head >> 4) if head >> 4 else self._integer()
            kind = head & 15
            fields[number] = kind == _TRUE if kind <= _FALSE else self._value(kind, depth + 1)
        return fields

    def _value(self, kind: int, depth: int) -> Any:
        if kind in _INTEGERS:
            return self._integer()
        if kind == _BINARY:
            return self._bytes(self._varint())
        if kind == _STRUCT:
            return self.struct(depth)
        if kind in _LISTS:
            return self._list(depth)
        if kind <= _BYTE:  # a boolean in a list has its own byte
            return self._byte()
        _require(kind == _DOUBLE, "its metadata has an unknown type")
        return self._bytes(8)

    def _list(self, depth: int) -> list[Any]:
        _require(depth < _MAX_DEPTH, "its metadata is nested too deeply")
        head = self._byte()
        size = head >> 4 if head >> 4 < 15 else self._varint()
        return [self._value(head & 15, depth + 1) for _ in range(size)]

    def _bytes(self, size: int) -> bytes:
        at, self.at = self.at, self.at + size
        _require(self.at <= len(self._content), "its metadata goes beyond its end")
        return bytes(self._content[at : self.at])

    def _byte(self) -> int:
        self.at += 1
        return self._content[self.at - 1]

    def _integer(self) -> int:
        number = self._varint()
        return (number >> 1) ^ -(number & 1)

    def _varint(self) -> int:
        if (byte := self._byte()) < 128:
            return byte
        number = byte & 127
        for place in range(1, _MAX_NUMBER_BYTES):
            byte = self._byte()
            number |= (byte & 127) << 7 * place
            if byte < 128:
                return number
        raise ValueError("it is damaged: a number in its metadata is too long")
