"""Arrays of HDF5 and Zarr files; `group/name` becomes `group.name`."""

from __future__ import annotations

import math
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.errors import DrakeTeleopError, install_extra

_MAX_VALUES, _MAX_ROW = 2**28, 64  # numbers of an array, and of one row: wider ones are images


def read_hdf5(path: Path, *, transpose: bool = False, group: str = "/") -> dict[str, NDArray]:
    """Return the numeric arrays of an HDF5 file; links to other files are not followed.

    Args:
        path: the file.
        transpose: reverse the axes, as for files of MATLAB.
        group: only arrays in this group, with names relative to it.

    Raises:
        DrakeTeleopError: if h5py is not installed.
        OSError: if the file is damaged.
        ValueError: for an array that is too large or in another file.
    """
    h5py, found = library("h5py", path), dict[str, NDArray]()
    with h5py.File(path, "r") as file:

        def visit(name: str, item: Any) -> None:
            if isinstance(item, h5py.Dataset) and _is_table(item, transpose):
                if item.external is not None or item.is_virtual:
                    raise ValueError(f"{name} is in another file")
                array = np.asarray(item[()])
                found[name.replace("/", ".")] = array.T if transpose else array

        file[group].visititems(visit)
    return found


def read_zarr(path: Path, *, rows: slice = slice(None)) -> dict[str, NDArray]:
    """Return some rows of the numeric arrays of a Zarr folder; raises errors as `read_hdf5`."""
    zarr = library("zarr", path)
    group = zarr.open_group(path, mode="r")
    members = group.members(max_depth=None)
    arrays = {name: item for name, item in members if isinstance(item, zarr.Array)}
    return {
        name.replace("/", "."): np.asarray(item[rows])
        for name, item in arrays.items()
        if _is_table(item, False)
    }


def _is_table(item: Any, transpose: bool) -> bool:
    shape = item.shape[::-1] if transpose else item.shape
    if item.dtype.kind not in "fiu" or not 1 <= len(shape) <= 3 or math.prod(shape[1:]) > _MAX_ROW:
        return False
    if math.prod(shape) > _MAX_VALUES:
        raise ValueError(f"an array of {math.prod(shape):.2g} numbers is too large")
    return True


def library(name: str, path: Path) -> Any:
    """Return an optional package that reads a file; raise DrakeTeleopError if it is missing."""
    try:
        return import_module(name)
    except ImportError:
        raise DrakeTeleopError(
            f"reading {path.suffix} files needs {name}",
            where=str(path),
            remedy=install_extra("formats"),
        ) from None
