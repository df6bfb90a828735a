"""MATLAB's files up to version 7: variables, and fields of structures, that are arrays of numbers.

Files of version 5 to 7 are taken apart here (MathWorks, MAT-File Format, chapter 1), because what a
broken or planted file says leads SciPy's reader out of its memory, which ends the process; those of
version 4, one array after the other, are SciPy's. All else (texts, cells, sparse and complex
matrices, objects) is passed over.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

_HEADER, _MATRIX, _COMPRESSED, _STRUCTURE, _COMPLEX, _DEEPEST = 128, 14, 15, 2, 1 << 11, 20
_NUMBERS = range(6, 16)  # classes
_TYPES = {
    1: "i1",
    2: "u1",
    3: "i2",
    4: "u2",
    5: "i4",
    6: "u4",
    7: "f4",
    9: "f8",
    12: "i8",
    13: "u8",
}
_FLAGS_AND_SIZE = [6, 5]
_BROKEN = "it is broken, or not all of it is there"


def read_mat(path: Path) -> dict[str, NDArray]:
    """Arrays by name; those in structures as `structure.field`.

    Raises:
        ValueError: if it is no such file, not all of one, or has no arrays.
    """
    from scipy.io import loadmat
    from scipy.io.matlab import matfile_version

    version = matfile_version(path)[0]
    if version == 2:
        raise ValueError("it is of version 7.3; save(..., '-v7') writes one that can be")
    found: dict[str, NDArray] = {}
    if version == 1:
        data = path.read_bytes()
        order = "<" if data[126:128] == b"IM" else ">"
        for kind, content in _elements(memoryview(data)[_HEADER:], order):
            _take(kind, content, order, None, 0, found)
    else:
        for name, value in loadmat(path).items():
            if isinstance(value, np.ndarray):
                _put(name, value, found)
    if not found:
        raise ValueError("it has no arrays: what is in tables and timeseries, save as arrays")
    return found


def _elements(data: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """The kind of each element, and what is in it."""
    start = 0
    while start < len(data):
        if len(data) - start < 8:
            raise ValueError(_BROKEN)
        kind, size = struct.unpack_from(f"{order}II", data, start)
        small = kind >> 16
        kind, size, begin = (kind & 0xFFFF, small, 4) if small else (kind, size, 8)
        content = data[start + begin : start + begin + size]
        if len(content) < size or (small and size > 4):
            raise ValueError(_BROKEN)
        if kind == _COMPRESSED:
            yield from _elements(memoryview(zlib.decompress(content)), order)
        else:
            yield kind, content
        start += 8 if small else 8 + (size if kind == _COMPRESSED else -(-size // 8) * 8)


def _take(
    kind: int, content: memoryview, order: str, name: str | None, depth: int, found: dict
) -> None:
    """Puts the arrays of one variable, or of a field by its name, with those that were found."""
    parts = list(_elements(content, order)) if kind == _MATRIX else []
    if len(parts) < 3 or [kind for kind, _ in parts[:2]] != _FLAGS_AND_SIZE:  # objects have no size
        return
    if depth > _DEEPEST:
        raise ValueError(_BROKEN)
    (flags, *_), size = (_numbers(part, order).tolist() for part in parts[:2])
    name = bytes(parts[2][1]).decode("latin-1") if name is None else name
    if flags & 0xFF in _NUMBERS and not flags & _COMPLEX:
        if len(parts) != 4:
            raise ValueError(_BROKEN)
        _put(name, _numbers(parts[3], order).reshape(size, order="F"), found)
    elif flags & 0xFF == _STRUCTURE and math.prod(size) == 1 and len(parts) > 4:
        (length, *_), names = _numbers(parts[3], order).tolist(), bytes(parts[4][1])
        fields = [names[i : i + length] for i in range(0, len(names), max(length, 1))]
        for field, part in zip(fields, parts[5:], strict=True):
            label = field.partition(b"\0")[0].decode("latin-1")
            _take(*part, order, f"{name}.{label}", depth + 1, found)


def _numbers(part: tuple[int, memoryview], order: str) -> NDArray:
    kind, content = part
    if kind not in _TYPES:
        raise ValueError(_BROKEN)
    return np.frombuffer(content, f"{order}{_TYPES[kind]}").astype(_TYPES[kind])


def _put(name: str, array: NDArray, found: dict[str, NDArray]) -> None:
    """A row or a column is a list, and a single number nothing. MATLAB counts matrices last."""
    if array.size < 2 or not name:
        return
    if array.ndim == 2 and 1 in array.shape:
        array = array.ravel()
    if array.ndim == 3 and array.shape[:2] in ((3, 3), (4, 4)):
        array = np.moveaxis(array, 2, 0)
    found[name] = array
