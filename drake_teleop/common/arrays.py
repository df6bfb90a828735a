"""Checks of the arrays that come into the load core from outside."""

from __future__ import annotations

import reprlib
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_teleop.common.errors import DrakeTeleopError

Array: TypeAlias = NDArray[np.float64]


def checked(name: str, value: ArrayLike, *shape: int, leading: bool = False) -> Array:
    """`value` as a finite float64 array of the given shape.

    Args:
        name: what the array is called in the error message.
        shape: the shape demanded.
        leading: allow any further dimensions in front of `shape`.

    Raises:
        DrakeTeleopError: if it holds no numbers, has another shape, or is not finite.
    """
    wanted = ", ".join(["..."] * leading + [str(n) for n in shape])
    wanted = f"({wanted},)" if len(shape) == 1 and not leading else f"({wanted})"
    array = numbers(name, value, f"give an array of shape {wanted}")
    own = array.shape[array.ndim - len(shape) :] if leading else array.shape
    if own != shape:
        raise DrakeTeleopError(f"has shape {array.shape} instead of {wanted}", where=name)
    finite = np.isfinite(array)
    if not finite.all():
        first = tuple(int(i) for i in np.argwhere(~finite)[0])
        raise DrakeTeleopError(f"is not finite at index {first}", where=name)
    return array


def numbers(name: str, value: ArrayLike, remedy: str = "") -> Array:
    """`value` as a float64 array of any shape, without loss.

    Raises:
        DrakeTeleopError: if it holds no numbers, complex ones, or some that are masked.
    """
    try:
        if np.iscomplexobj(value) or np.ma.is_masked(value):
            raise ValueError("complex" if np.iscomplexobj(value) else "masked")
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        what = f"holds no numbers ({error})"
        raise DrakeTeleopError(what, where=name, remedy=remedy) from error


def checked_rows(**arrays: tuple[ArrayLike, int]) -> tuple[tuple[int, ...], list[Array]]:
    """Arrays of vectors, each (..., n), as contiguous tables of N rows.

    Args:
        arrays: name -> (value, n); the leading dimensions are broadcast against each other.

    Returns:
        The common leading shape, and for each array an (N, n) table.

    Raises:
        DrakeTeleopError: as `checked`, or if the leading dimensions do not fit together.
    """
    tables = {name: checked(name, value, n, leading=True) for name, (value, n) in arrays.items()}
    try:
        leading = np.broadcast_shapes(*(table.shape[:-1] for table in tables.values()))
    except ValueError as error:
        shapes = ", ".join(f"{name} {table.shape}" for name, table in tables.items())
        raise DrakeTeleopError(
            f"the numbers of samples differ: {shapes}", remedy="give one row of each per sample"
        ) from error
    return leading, [_rows(table, (*leading, table.shape[-1])) for table in tables.values()]


def _rows(table: Array, shape: tuple[int, ...]) -> Array:
    # What numpy broadcasts cannot be written to, another type, for which all is compiled again.
    same = table if table.shape == shape else np.array(np.broadcast_to(table, shape))
    return np.ascontiguousarray(same).reshape(-1, shape[-1])


def number(name: str, value: Any) -> float:
    """`value` as a float, which may be NaN; raises DrakeTeleopError unless it is one."""
    try:
        return float(numbers(name, value) if isinstance(value, (np.generic, np.ndarray)) else value)
    except (TypeError, ValueError, OverflowError):
        raise DrakeTeleopError(
            f"expected a number, found {reprlib.repr(value)}", where=name
        ) from None


def learnt(name: str, phi: Array) -> Array:
    """`phi` (10,), unless it is zero throughout: the load of an estimator that never learnt.

    Raises:
        DrakeTeleopError: then; every wrench would be taken for contact.
    """
    if not phi.any():
        raise DrakeTeleopError(
            "is zero throughout, so this load was never learnt",
            where=name,
            remedy="identify it first: identify_load for a scenario, identify_log for a log",
        )
    return phi


def positive(name: str, value: ArrayLike, *shape: int) -> Array:
    """`value` as a `checked` array of positive numbers."""
    array = checked(name, value, *shape)
    if not (array > 0.0).all():
        raise DrakeTeleopError("is not positive throughout", where=name)
    return array
