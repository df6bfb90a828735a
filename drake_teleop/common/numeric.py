"""Checks and conversions of input arrays, small numeric methods, single-threaded BLAS."""

from __future__ import annotations

import reprlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeAlias, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_teleop.common.errors import DrakeTeleopError

Array: TypeAlias = NDArray[np.float64]
Records: TypeAlias = NDArray[np.record]
"""Structured array; compiled code reads `records[0].name`."""
_Record = TypeVar("_Record", bound=Any)
MAX_ARRAY_VALUE = 1e30
"""Largest absolute value in an input array, in any unit; its eighth power must not overflow."""


def finite_array(name: str, value: ArrayLike, *shape: int, leading: bool = False) -> Array:
    """Return `value` as a float64 array; raise DrakeTeleopError for another shape, NaN or > 1e30.

    `leading` allows more dimensions in front; `name` is for the message.
    """
    expected = ", ".join(["..."] * leading + [str(n) for n in shape])
    expected = f"({expected},)" if len(shape) == 1 and not leading else f"({expected})"
    array = float_array(name, value, f"give an array of shape {expected}")
    actual = array.shape[array.ndim - len(shape) :] if leading else array.shape
    if actual != shape:
        what, remedy = f"has shape {array.shape} instead of {expected}", "give this shape"
        raise DrakeTeleopError(what, where=name, remedy=remedy)
    valid = np.abs(array) <= MAX_ARRAY_VALUE  # False for NaN
    if not valid.all():
        first = tuple(int(i) for i in np.argwhere(~valid)[0])
        place = f" at index {first}" if first else ""
        what, remedy = f"is not finite{place}", "replace NaN and infinity"
        if np.isfinite(array[first]):
            what = f"is {array[first]:g}{place}, outside +-{MAX_ARRAY_VALUE:g}"
            remedy = "correct the value or its unit"
        raise DrakeTeleopError(what, where=name, remedy=remedy)
    return array


def float_array(name: str, value: ArrayLike, remedy: str = "") -> Array:
    """Return `value` as a float64 array; raise DrakeTeleopError if it is not numeric and real."""
    try:
        if np.iscomplexobj(value) or np.ma.is_masked(value):
            raise ValueError("complex" if np.iscomplexobj(value) else "masked")
        if np.asarray(value).dtype.kind in "mMSU":
            raise ValueError("its values are dates, time spans or texts")
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        what = f"contains no real numbers ({error})"
        raise DrakeTeleopError(what, where=name, remedy=remedy) from error


def as_compiled_arguments(values: _Record) -> _Record:
    """Return a named tuple with its numbers as floats and its vectors as float64 arrays."""
    numbers = (np.array(value, float) if np.ndim(value) else float(value) for value in values)
    return values._make(numbers)


def pack_for_compiled_code(**values: ArrayLike) -> Records:
    """Return keyword arguments as float64 fields of a record array (1,) for compiled code."""
    arrays = {name: np.asarray(value, float) for name, value in values.items()}
    fields = [(name, float, array.shape) for name, array in arrays.items()]
    packed: Records = np.zeros(1, np.dtype((np.record, fields)))
    for name, array in arrays.items():
        packed[name] = array
    return packed


def broadcast_to_rows(**arrays: tuple[ArrayLike, int]) -> tuple[tuple[int, ...], list[Array]]:
    """Broadcast keyword arguments name=(array (..., n), n); return leading shape, arrays (N, n)."""
    tables = {
        name: finite_array(name, value, n, leading=True) for name, (value, n) in arrays.items()
    }
    try:
        leading = np.broadcast_shapes(*(table.shape[:-1] for table in tables.values()))
    except ValueError as error:
        shapes = ", ".join(f"{name} {table.shape}" for name, table in tables.items())
        what, remedy = f"the numbers of samples differ: {shapes}", "give one row of each per sample"
        raise DrakeTeleopError(what, where=", ".join(tables), remedy=remedy) from error
    rows = []
    for table in tables.values():
        shape = (*leading, table.shape[-1])
        # numpy broadcasts to read-only arrays, another type, which would be compiled again.
        same = table if table.shape == shape else np.array(np.broadcast_to(table, shape))
        rows.append(np.ascontiguousarray(same).reshape(-1, shape[-1]))
    return leading, rows


def to_float(name: str, value: Any) -> float:
    """Return `value` as a float, possibly NaN; raise DrakeTeleopError if not numeric."""
    try:
        if isinstance(value, (str, bytes)):
            raise TypeError
        of_numpy = isinstance(value, (np.generic, np.ndarray))
        return float(float_array(name, value) if of_numpy else value)
    except (TypeError, ValueError, OverflowError):
        what = f"expected a number, found {reprlib.repr(value)}"
        raise DrakeTeleopError(what, where=name) from None


def check_load_not_all_zero(name: str, phi: Array) -> Array:
    if not phi.any():
        what = "all ten parameters are zero: the load is not identified"
        remedy = "identify it first: identify_load for a scenario, identify_log for a log"
        raise DrakeTeleopError(what, where=name, remedy=remedy)
    return phi


def positive_array(name: str, value: ArrayLike, *shape: int) -> Array:
    """Return an array as `finite_array`; its values are at least 1 / `MAX_ARRAY_VALUE`."""
    array = finite_array(name, value, *shape)
    if not (array >= 1.0 / MAX_ARRAY_VALUE).all():
        kind = "not positive" if (array <= 0.0).any() else f"below {1.0 / MAX_ARRAY_VALUE:g}"
        what = f"has the value {array.min():g}, which is {kind}"
        raise DrakeTeleopError(what, where=name, remedy="give values above 0")
    return array


def nonnegative_array(name: str, value: ArrayLike, *shape: int) -> Array:
    array = finite_array(name, value, *shape)
    if (array < 0.0).any():
        what = f"has the negative value {array.min():g}"
        raise DrakeTeleopError(what, where=name, remedy="give values of 0 or more")
    return array


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Limit BLAS to one thread, in a context or a decorated function, for reproducible sums."""
    import scipy.linalg  # noqa: F401 (a BLAS that is loaded later is not limited)
    from threadpoolctl import threadpool_limits

    with threadpool_limits(1):
        yield


def find_runs_of_true(flags: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Return start and stop index (k, 2) of each run of True in flags (N,); stop is excluded."""
    ends = np.zeros(1, bool)
    return np.flatnonzero(np.diff(np.concatenate([ends, flags, ends]))).reshape(-1, 2)


def samples_to_nearest_true(flags: NDArray[np.bool_]) -> Array:
    """Return for each sample (N,) the distance in samples to the nearest True; inf without one."""
    at = np.arange(len(flags), dtype=float)
    before = np.maximum.accumulate(np.where(flags, at, -np.inf))
    after = np.minimum.accumulate(np.where(flags, at, np.inf)[::-1])[::-1]
    return np.minimum(at - before, after - at)


def contact_spans(t: ArrayLike, contact: ArrayLike) -> list[tuple[float, float]]:
    times = np.asarray(t, float)
    runs = find_runs_of_true(np.asarray(contact, bool))
    return [(float(times[a]), float(times[b - 1])) for a, b in runs]


def width_and_centre_of_narrowest_half(x: Array) -> tuple[Array, Array]:
    """Return width and centre (k,) of the narrowest interval with half of the samples x (N, k)."""
    ordered = np.sort(x, axis=0)
    half = len(ordered) // 2
    widths = ordered[half:] - ordered[: len(ordered) - half]
    start, channels = np.argmin(widths, axis=0), np.arange(x.shape[1])
    centres = (ordered[start, channels] + ordered[start + half, channels]) / 2
    return widths[start, channels], centres


def position_of_parabola_minimum(left: float, middle: float, right: float) -> float:
    """Return the position of the minimum of a parabola through values at -1, 0, 1; 0 without one.

    The result is clipped to [-1, 1].
    """
    bend = left - 2.0 * middle + right
    return float(np.clip(0.5 * (left - right) / bend, -1.0, 1.0)) if bend > 0.0 else 0.0


def search_minimum(cost: Callable[[float], float], step: float, reach: float) -> tuple[float, bool]:
    """Return the argument of the least cost, and True if it is inside the search grid.

    The grid has steps of `step` from -`reach` to `reach`; a parabola refines the argument.
    """
    at = step * np.arange(-round(reach / step), round(reach / step) + 1)
    costs = np.array([cost(x) for x in at])
    best = int(np.argmin(costs))
    if best in (0, len(at) - 1):
        return float(at[best]), False
    share = position_of_parabola_minimum(*costs[best - 1 : best + 2])
    return float(at[best]) + step * share, True


def white_noise_deviations(x: Array) -> Array:
    """Return std (k,) of white noise in smooth x (N, k) by third differences; 0 for N < 4."""
    if len(x) < 4:
        return np.zeros(x.shape[1:])
    # Third differences, whose factors 1, 3, 3, 1 have the square sum 20. The deviation of a normal
    # x is median |x| / 0.6745. Column by column, to save memory.
    medians = [np.median(np.abs(np.diff(column, 3))) for column in x.T]
    return np.array(medians) / 0.6745 / np.sqrt(20.0)
