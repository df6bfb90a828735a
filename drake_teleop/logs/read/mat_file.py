"""Numeric arrays of MATLAB files, with fields of structures.

Version 7.3 is HDF5. Versions 5 to 7 are parsed here (MathWorks, MAT-File Format), because invalid
files can crash SciPy's reader. Other types are ignored.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drake_teleop.logs.read.array_files import read_hdf5

_HEADER, _MATRIX, _COMPRESSED, _STRUCTURE, _COMPLEX, _MAX_DEPTH = 128, 14, 15, 2, 1 << 11, 20
_NUMERIC_CLASSES = range(6, 16)  # numeric classes
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
_BROKEN = "it is damaged or incomplete"


def read_mat(path: Path) -> dict[str, NDArray]:
    """Return the numeric arrays of a MATLAB file by name; fields are named `structure.field`.

    Raises:
        ValueError: if the file is invalid or has no arrays.
    """
    from scipy.io import loadmat
    from scipy.io.matlab import matfile_version

    version, found = matfile_version(path)[0], dict[str, NDArray]()
    if version == 2:
        for name, value in read_hdf5(path, transpose=True).items():
            if not name.startswith("#refs#"):
                _add_array(name, value, found)
    elif version == 1:
        data = path.read_bytes()
        order = "<" if data[126:128] == b"IM" else ">"
        for kind, content in _iterate_elements(memoryview(data)[_HEADER:], order):
            _add_variable(kind, content, order, None, 0, found)
    else:
        for name, value in loadmat(path).items():
            if isinstance(value, np.ndarray):
                _add_array(name, value, found)
    if not found:
        raise ValueError("it has no arrays; save tables and timeseries as arrays")
    return found


def _iterate_elements(data: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
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
            yield from _iterate_elements(memoryview(zlib.decompress(content)), order)
        else:
            yield kind, content
        start += 8 if small else 8 + (size if kind == _COMPRESSED else -(-size // 8) * 8)


def _add_variable(
    kind: int, content: memoryview, order: str, name: str | None, depth: int, found: dict
) -> None:
    parts = list(_iterate_elements(content, order)) if kind == _MATRIX else []
    if len(parts) < 3 or [kind for kind, _ in parts[:2]] != _FLAGS_AND_SIZE:  # objects have no size
        return
    if depth > _MAX_DEPTH:
        raise ValueError(_BROKEN)
    (flags, *_), size = (_parse_numbers(part, order).tolist() for part in parts[:2])
    name = bytes(parts[2][1]).decode("latin-1") if name is None else name
    if flags & 0xFF in _NUMERIC_CLASSES and not flags & _COMPLEX:
        if len(parts) != 4:
            raise ValueError(_BROKEN)
        _add_array(name, _parse_numbers(parts[3], order).reshape(size, order="F"), found)
    elif flags & 0xFF == _STRUCTURE and math.prod(size) == 1 and len(parts) > 4:
        (length, *_), names = _parse_numbers(parts[3], order).tolist(), bytes(parts[4][1])
        fields = [names[i : i + length] for i in range(0, len(names), max(length, 1))]
        for field, part in zip(fields, parts[5:], strict=True):
            label = field.partition(b"\0")[0].decode("latin-1")
            _add_variable(*part, order, f"{name}.{label}", depth + 1, found)


def _parse_numbers(part: tuple[int, memoryview], order: str) -> NDArray:
    kind, content = part
    if kind not in _TYPES:
        raise ValueError(_BROKEN)
    return np.frombuffer(content, f"{order}{_TYPES[kind]}").astype(_TYPES[kind])


def _add_array(name: str, array: NDArray, found: dict[str, NDArray]) -> None:
    if array.size < 2 or not name:
        return
    if array.ndim == 2 and 1 in array.shape:
        array = array.ravel()
    if array.ndim == 3 and array.shape[:2] in ((3, 3), (4, 4)):
        array = np.moveaxis(array, 2, 0)
    found[name] = array
