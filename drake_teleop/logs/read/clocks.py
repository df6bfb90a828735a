"""Clock of one stream: checks and corrections of its time stamps (docs/log-description.md)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.logs.read.description import Time
from drake_teleop.logs.read.description_fields import SI_VALUE_OF_UNIT
from drake_teleop.logs.read.tables import Table

EPISODE_SPACING_S = 1.0  # least time between two episodes of a file
MIN_GAP_STEPS = 4.0  # median steps
MIN_RATE_HZ, MAX_RATE_HZ = 5.0, 1e5  # other rates indicate a wrong unit
_MAX_MEAN_OVER_MEDIAN_TIME_STEP = 4.0
# Limits of an episode, in median steps: distance of its start from that of the first episode, and
# each of its first steps. Least number of its rows.
_MAX_EPISODE_START_OFFSET_STEPS, _MAX_STEP_AT_EPISODE_START_STEPS, _MIN_EPISODE_ROWS = 2.0, 10.0, 16
_SMOOTHING_WINDOW_STAMPS = 50


@dataclass(frozen=True)
class Clock:
    """Increasing times t (N,) of the rows of a stream on the common clock [s].

    Attributes:
        kept_rows: (N,) row of the table for each time.
        num_rows: number of the table's rows, with removed ones.
        notes: sentences about corrections.
        num_episodes: number of episodes; the clock starts again in each.
    """

    t: Array
    kept_rows: NDArray[np.intp]
    num_rows: int
    notes: tuple[str, ...] = ()
    num_episodes: int = 1


def read_clock(time: Time, table: Table, columns: Sequence[str | int], where: str) -> Clock:
    """Return checked and corrected times of a stream's rows.

    A row that repeats the time stamp and the values in `columns` of the previous row is removed.
    """
    t, episodes = time_stamps_and_num_episodes(time, table, columns, where)
    total, rows, notes = len(t), np.flatnonzero(np.isfinite(t)), []
    if time.column is None:
        return Clock(t + time.offset, rows, total)
    if len(rows) < total:
        notes.append(f"{total - len(rows)} rows without a time stamp are removed")
    _check_stamps_go_forward(t[rows], rows, table, where)
    if (np.diff(t[rows]) == 0).any():
        same = _find_duplicate_rows(rows, t, table, columns, where)
        rows = rows[~same]
        if same.any():
            text = f"{same.sum()} rows that repeat the previous row and its time stamp are removed"
            notes.append(text)
    t = t[rows]
    if shared := int((np.diff(t) == 0).sum()):
        even = smooth_duplicate_stamps(t)
        if (np.diff(even) <= 0).any():
            row = table.line_in_file(rows[int(np.argmax(np.diff(even) <= 0))])
            what = f"the time stamps do not increase around row {row} of {table.path.name}"
            remedy = "cut the log there, or give time.rate instead of the stamps"
            raise DrakeTeleopError(what, where=where, remedy=remedy)
        notes.append(
            f"{shared} rows share the time stamp of the previous row: all rows are spaced evenly"
            f" over {_SMOOTHING_WINDOW_STAMPS} stamps, which changes times by up to"
            f" {np.abs(even - t).max():.2g} s"
        )
        t = even
    _check_sampling(t, rows, time, table, where)
    return Clock(t + time.offset, rows, total, tuple(notes), episodes)


def time_stamps_and_num_episodes(
    time: Time, table: Table, columns: Sequence[str | int], where: str
) -> tuple[Array, int]:
    """Return the scaled times (N,) of a table's rows [s], NaN if absent, and number of episodes.

    `time.scale` and joining of episodes use the whole table: all its streams keep one clock. With
    `time.rate`, rows without numbers in `columns` are gaps, except for rows of other streams.
    """
    if time.column is None:
        assert time.rate is not None
        rows = _row_numbers_excluding_other_streams(table, columns)
        spacing = np.median(np.diff(rows)) if len(rows) > 1 else 1.0
        return np.asarray(rows * (time.scale / spacing / time.rate), dtype=float), 1
    whole = table.whole_table or table
    names = [time.column] + ([] if time.nanoseconds is None else [time.nanoseconds])
    for name in names:
        if not np.isfinite(whole.single_column(name, f"{where}.column")).any():
            whole.finite_numbers([name], 1, f"{where}.column")
    if time.unit != "s" and whole.columns[str(time.column)].dtype.kind in "mM":
        what = "the column holds dates or times of day, which have no unit"
        raise DrakeTeleopError(what, where=f"{where}.unit", remedy="leave `unit` out")
    stamps = whole.numbers_with_nan_side_by_side(names, f"{where}.column")
    t = stamps[:, 0] * SI_VALUE_OF_UNIT[time.unit]
    if time.nanoseconds is not None:
        t = t + stamps[:, 1] * SI_VALUE_OF_UNIT["ns"]
    start = next(iter(t[np.isfinite(t)]), 0.0)
    t, episodes = join_episodes(start + time.scale * (t - start))
    return (t if table.kept_rows is None else t[table.kept_rows]), episodes


def _row_numbers_excluding_other_streams(
    table: Table, columns: Sequence[str | int]
) -> NDArray[np.intp]:
    whole, kept = table.whole_table, table.kept_rows
    if whole is None or kept is None:  # arrays of other streams may have other lengths
        lengths = (len(table.columns[x]) for x in map(str, columns) if x in table.columns)
        return np.arange(next(lengths, table.rows))
    only_others = np.zeros(whole.rows, bool)
    for column in whole.columns.values():
        if len(column) == whole.rows and column.dtype.kind == "f":
            known = np.isfinite(column.reshape(len(column), -1)).any(axis=1)
            if not known[kept].any():
                only_others |= known
    return np.searchsorted(np.flatnonzero(~only_others), kept)


def join_episodes(t: Array) -> tuple[Array, int]:
    """Return increasing times (N,) for a clock that starts again, and the number of episodes.

    A step back to near the first stamp is a new start. Times with other steps back are unchanged.
    """
    finite = np.isfinite(t)
    known = t[finite]
    steps = np.diff(known)
    back = np.flatnonzero(steps < 0.0) + 1
    if not len(back) or not (steps > 0.0).any():
        return t, 1
    step = float(np.median(steps[steps > 0.0]))
    again = np.abs(known[back] - known[0]) <= _MAX_EPISODE_START_OFFSET_STEPS * step
    if not again.all() or np.diff([0, *back, len(known)]).min() < _MIN_EPISODE_ROWS:
        return t, 1
    after = steps[back[:, None] + np.arange(_MIN_EPISODE_ROWS - 1)]
    if (after > _MAX_STEP_AT_EPISODE_START_STEPS * step).any():  # one wrong stamp
        return t, 1
    joined = known.copy()
    for start in back:
        joined[start:] += joined[start - 1] + max(EPISODE_SPACING_S, 10.0 * step) - joined[start]
    result = t.copy()
    result[finite] = joined
    return result, len(back) + 1


def set_episode_steps_to_zero(steps: Array, median_step: float, num_episodes: int) -> Array:
    error, inner = np.abs(steps - max(EPISODE_SPACING_S, 10.0 * median_step)), steps.copy()
    inner[np.argsort(error, kind="stable")[: num_episodes - 1]] = 0.0
    return inner


def smooth_duplicate_stamps(t: Array) -> Array:
    distinct = np.unique(t)
    step = float(np.median(np.diff(distinct)))
    per_stamp = len(t) / len(distinct)
    parts = np.split(t, np.flatnonzero(np.diff(t) > 3 * step) + 1)
    half = math.ceil(0.5 * _SMOOTHING_WINDOW_STAMPS * per_stamp)
    return np.concatenate([_smooth_stamps(part, half, step / per_stamp) for part in parts])


def find_gaps_in_times(t: Array, bandwidth_hz: float | None) -> Array:
    """Return start and end (G, 2) of the gaps in increasing times `t` (N,) [s]."""
    steps = np.diff(t)
    at = np.flatnonzero(steps > min_gap_length_s(float(np.median(steps)), bandwidth_hz))
    return np.stack([t[at], t[at + 1]], axis=1)


def min_gap_length_s(step: float, bandwidth_hz: float | None) -> float:
    """Return the least length of a gap [s]: the larger of 4 steps and half a bandwidth period."""
    return max(MIN_GAP_STEPS * step, 0.0 if bandwidth_hz is None else 0.5 / bandwidth_hz)


def _smooth_stamps(t: Array, half: int, dt: float) -> Array:
    n = len(t)
    if t[0] == t[-1]:
        return t[0] + dt * (np.arange(n) - (n - 1) / 2)
    half = min(half, (n - 1) // 2)
    width = 2 * half + 1
    # Small deviations keep the precision: stamps can count from 1970.
    line = np.linspace(t[0], t[-1], n)
    deviation = t - line
    sums = np.concatenate([[0.0], np.cumsum(deviation)])
    smooth = np.empty(n)
    smooth[half : n - half] = (sums[width:] - sums[:-width]) / width
    for ends, window in (slice(half), slice(width)), (slice(n - half, n), slice(n - width, n)):
        index = np.arange(n)[window]
        slope = np.polyfit(index - index.mean(), deviation[window], 1)[0] if half else 0.0
        smooth[ends] = deviation[window].mean() + slope * (np.arange(n)[ends] - index.mean())
    return line + smooth


def _find_duplicate_rows(
    rows: NDArray[np.intp], t: Array, table: Table, columns: Sequence[str | int], where: str
) -> NDArray[np.bool_]:
    values = [table.numbers_with_nan(column, where) for column in columns]
    values = [x[rows] for x in values if len(x) == len(t)]
    same = np.diff(t[rows]) == 0
    for x in values:
        same &= ((x[1:] == x[:-1]) | (np.isnan(x[1:]) & np.isnan(x[:-1]))).all(axis=1)
    return np.concatenate([[False], same])


def _check_stamps_go_forward(t: Array, rows: NDArray[np.intp], table: Table, where: str) -> None:
    steps = np.diff(t)
    if (steps < 0).any():
        first = int(np.argmax(steps < 0))
        count, row = int((steps < 0).sum()), table.line_in_file(rows[first + 1])
        what = f"{count} time stamps decrease, the first in row {row} of {table.path.name}"
        what += f", by {-steps[first]:.3g} s"
        remedy = "cut the log there, sort the rows, or use another clock: time.column, time.rate"
        raise DrakeTeleopError(what, where=where, remedy=remedy)
    if len(t) > 1 and t[0] == t[-1]:
        what = f"the time stamps of {table.path.name} never increase"
        raise DrakeTeleopError(what, where=where, remedy="set time.column, or time.rate")


def _check_sampling(t: Array, rows: NDArray[np.intp], time: Time, table: Table, where: str) -> None:
    if len(t) < 2:
        return
    steps = np.diff(t)
    step = float(np.median(steps))
    if 1 / MAX_RATE_HZ <= step <= 1 / MIN_RATE_HZ:
        if len(t) > 2 and t[-1] - t[0] > _MAX_MEAN_OVER_MEDIAN_TIME_STEP * len(t) * step:
            longest = int(np.argmax(steps))
            row = table.line_in_file(rows[longest + 1])
            raise DrakeTeleopError(
                f"the time stamps are too uneven: median step {step:.3g} s, mean"
                f" {steps.mean():.3g} s (at most {_MAX_MEAN_OVER_MEDIAN_TIME_STEP:g} times that),"
                f" longest {steps[longest]:.3g} s to row {row} of {table.path.name}",
                where=where,
                remedy="cut the log where its clock jumps; if rows come in bursts, give time.rate",
            )
        return
    counts = step / SI_VALUE_OF_UNIT[time.unit]
    # Typical sensor rates are 20 Hz to 10 kHz.
    likely = [x for x in ("s", "ms", "us", "ns") if 1e-4 <= counts * SI_VALUE_OF_UNIT[x] <= 0.05]
    remedy = f"probably `unit: {likely[0]}`" if likely else "check the unit, or give time.rate"
    if step > 1 / MIN_RATE_HZ:
        remedy += "; if each row is a pose at rest, describe them as `static:`"
    what = (
        f"the median step of the time stamps is {step:.3g} s ({1 / MAX_RATE_HZ:g} to"
        f" {1 / MIN_RATE_HZ:g} s are plausible), a rate of {1 / step:.3g} Hz"
    )
    raise DrakeTeleopError(what, where=f"{where}.unit", remedy=remedy)
