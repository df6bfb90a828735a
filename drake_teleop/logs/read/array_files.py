"""Arrays of HDF5, Zarr and MATLAB files; `group/name` becomes `group.name`.

MATLAB files of versions 5 to 7 are parsed here (MathWorks, MAT-File Format), because invalid files
can crash SciPy's reader.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.errors import DrakeTeleopError, remedy_to_install_extra

_MAX_NUMBERS_PER_ARRAY, _MAX_NUMBERS_PER_ROW = 2**28, 64  # arrays with wider rows are images


def read_hdf5(path: Path, *, transpose: bool = False, group: str = "/") -> dict[str, NDArray]:
    """Return the numeric arrays of an HDF5 file; links to other files are not followed.

    Names are relative to `group`. `transpose` reverses the axes, as for files of MATLAB. Raise
    OSError for a damaged file, ValueError for a too large array or one in another file.
    """
    h5py, found = import_optional_module("h5py", path), dict[str, NDArray]()
    with h5py.File(path, "r") as file:

        def add_dataset(name: str, item: Any) -> None:
            if isinstance(item, h5py.Dataset) and _is_numeric_non_image_array(item, transpose):
                if item.external is not None or item.is_virtual:
                    raise ValueError(f"the array {name} is in another file, which is not read")
                array = np.asarray(item[()])
                found[name.replace("/", ".")] = array.T if transpose else array

        file[group].visititems(add_dataset)
    return found


def read_zarr(path: Path, *, rows: slice = slice(None)) -> dict[str, NDArray]:
    """Return `rows` of the numeric arrays of a Zarr folder; raise errors as `read_hdf5`."""
    zarr = import_optional_module("zarr", path)
    members = zarr.open_group(path, mode="r").members(max_depth=None)
    arrays = {name: item for name, item in members if isinstance(item, zarr.Array)}
    return {
        name.replace("/", "."): np.asarray(item[rows])
        for name, item in arrays.items()
        if _is_numeric_non_image_array(item, False)
    }


def _is_numeric_non_image_array(item: Any, transpose: bool) -> bool:
    shape = item.shape[::-1] if transpose else item.shape
    if item.dtype.kind not in "fiu" or not 1 <= len(shape) <= 3:
        return False
    if min(math.prod(shape[1:]), math.prod(shape[:-1])) > _MAX_NUMBERS_PER_ROW:
        return False
    if (count := math.prod(shape)) > _MAX_NUMBERS_PER_ARRAY:
        raise ValueError(f"an array has {count:.2g} numbers (at most {_MAX_NUMBERS_PER_ARRAY:.2g})")
    return True


def import_optional_module(name: str, path: Path) -> Any:
    try:
        return import_module(name)
    except ImportError:
        what = f"reading {path.suffix} files requires the Python package {name}"
        remedy = remedy_to_install_extra("formats")
        raise DrakeTeleopError(what, where=str(path), remedy=remedy) from None


_MAT_HEADER_BYTES, _MAT_FLAGS_AND_SIZE_TYPES = 128, [6, 5]
_MAT_MATRIX_TYPE, _MAT_COMPRESSED_TYPE = 14, 15
_MAT_STRUCTURE_CLASS, _MAX_MAT_STRUCTURE_DEPTH = 2, 20
_MAT_NUMERIC_CLASSES, _MAT_COMPLEX_FLAG = range(6, 16), 1 << 11
_DTYPE_OF_MAT_TYPE = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4"}
_DTYPE_OF_MAT_TYPE |= {9: "f8", 12: "i8", 13: "u8"}
_DAMAGED_FILE_MESSAGE = "it is damaged or incomplete"


def read_mat(path: Path) -> dict[str, NDArray]:
    """Return the numeric arrays of a MATLAB file by name; fields are named `structure.field`."""
    from scipy.io import loadmat
    from scipy.io.matlab import matfile_version

    version, found = matfile_version(path)[0], dict[str, NDArray]()
    if version == 2:
        for name, value in read_hdf5(path, transpose=True).items():
            if not name.startswith("#refs#"):
                _add_mat_array_unless_scalar(name, value, found)
    elif version == 1:
        data = path.read_bytes()
        order = "<" if data[126:128] == b"IM" else ">"
        for kind, content in _iterate_mat_elements(memoryview(data)[_MAT_HEADER_BYTES:], order):
            _add_mat_variable(kind, content, order, None, 0, found)
    else:
        for name, value in loadmat(path).items():
            if isinstance(value, np.ndarray):
                _add_mat_array_unless_scalar(name, value, found)
    if not found:
        raise ValueError("the file has no arrays of numbers; save tables and timeseries as arrays")
    return found


def _iterate_mat_elements(data: memoryview, byte_order: str) -> Iterator[tuple[int, memoryview]]:
    start = 0
    while start < len(data):
        if len(data) - start < 8:
            raise ValueError(_DAMAGED_FILE_MESSAGE)
        kind, size = struct.unpack_from(f"{byte_order}II", data, start)
        small = kind >> 16
        kind, size, begin = (kind & 0xFFFF, small, 4) if small else (kind, size, 8)
        content = data[start + begin : start + begin + size]
        if len(content) < size or (small and size > 4):
            raise ValueError(_DAMAGED_FILE_MESSAGE)
        if kind == _MAT_COMPRESSED_TYPE:
            yield from _iterate_mat_elements(memoryview(zlib.decompress(content)), byte_order)
        else:
            yield kind, content
        start += 8 if small else 8 + (size if kind == _MAT_COMPRESSED_TYPE else -(-size // 8) * 8)


def _add_mat_variable(
    kind: int, content: memoryview, byte_order: str, name: str | None, depth: int, found: dict
) -> None:
    parts = list(_iterate_mat_elements(content, byte_order)) if kind == _MAT_MATRIX_TYPE else []
    # Objects have no size.
    if len(parts) < 3 or [kind for kind, _ in parts[:2]] != _MAT_FLAGS_AND_SIZE_TYPES:
        return
    if depth > _MAX_MAT_STRUCTURE_DEPTH:
        raise ValueError(_DAMAGED_FILE_MESSAGE)
    (flags, *_), size = (_parse_mat_numbers(part, byte_order).tolist() for part in parts[:2])
    name = bytes(parts[2][1]).decode("latin-1") if name is None else name
    if flags & 0xFF in _MAT_NUMERIC_CLASSES and not flags & _MAT_COMPLEX_FLAG:
        if len(parts) != 4:
            raise ValueError(_DAMAGED_FILE_MESSAGE)
        array = _parse_mat_numbers(parts[3], byte_order).reshape(size, order="F")
        _add_mat_array_unless_scalar(name, array, found)
    elif flags & 0xFF == _MAT_STRUCTURE_CLASS and math.prod(size) == 1 and len(parts) > 4:
        (length, *_), names = _parse_mat_numbers(parts[3], byte_order).tolist(), bytes(parts[4][1])
        fields = [names[i : i + length] for i in range(0, len(names), max(length, 1))]
        for field, part in zip(fields, parts[5:], strict=True):
            label = field.partition(b"\0")[0].decode("latin-1")
            _add_mat_variable(*part, byte_order, f"{name}.{label}", depth + 1, found)


def _parse_mat_numbers(element: tuple[int, memoryview], byte_order: str) -> NDArray:
    kind, content = element
    if kind not in _DTYPE_OF_MAT_TYPE:
        raise ValueError(_DAMAGED_FILE_MESSAGE)
    dtype = _DTYPE_OF_MAT_TYPE[kind]
    return np.frombuffer(content, f"{byte_order}{dtype}").astype(dtype)


def _add_mat_array_unless_scalar(name: str, array: NDArray, found: dict[str, NDArray]) -> None:
    if array.size < 2 or not name:
        return
    if array.ndim == 2 and 1 in array.shape:
        array = array.ravel()
    if array.ndim == 3 and array.shape[:2] in ((3, 3), (4, 4)):
        array = np.moveaxis(array, 2, 0)
    found[name] = array
