"""Tables of a log in memory, and checks of its channels."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.numeric import Array
from drake_teleop.logs.causes.cause import Finding
from drake_teleop.logs.check.corrections import edit_field
from drake_teleop.logs.read.alignment import white_noise_deviations
from drake_teleop.logs.read.bags import read_stream_table
from drake_teleop.logs.read.canonical import Log
from drake_teleop.logs.read.clocks import spread_shared_stamps, time_stamps_and_num_episodes
from drake_teleop.logs.read.description import Description
from drake_teleop.logs.read.reading import read_described_log
from drake_teleop.logs.read.streams import MIN_STREAM_SAMPLES
from drake_teleop.logs.read.tables import Table

_THINNED_RATE_HZ = 100.0
_THIN_TIME_PREFIX = "thinned time stamps of"


class LogData:
    """Tables of a log in memory, whole and thinned, for reading with edited descriptions."""

    def __init__(self, description: Description, source: str, tables: dict[Path, Table]) -> None:
        self._source = source
        self.tables = tables
        self._thinned: dict[Path, Table] = {}
        steps: dict[Path, list[int]] = {}
        for stream in description.streams.values():
            if stream.source not in tables:
                tables[stream.source] = read_stream_table(stream)
            steps.setdefault(stream.source, []).append(self._thinning_stride(stream))
        for name, stream in description.streams.items():
            whole = tables[stream.source]
            copied = replace(whole, columns=dict(whole.columns))
            thinned = self._thinned.setdefault(stream.source, copied)
            self._add_thinned_columns(name, stream, thinned, min(steps[stream.source]))

    def read_whole_log(self, description: Description) -> Log:
        return read_described_log(description, self._source, tables=self.tables)

    def read_thinned_log(self, description: Description) -> Log:
        """Return the log at about 100 Hz, as a description defines it."""
        stamped = {}
        for name, stream in description.streams.items():
            if (time := getattr(stream, "time", None)) is not None:
                column = {"column": f"{_THIN_TIME_PREFIX} {name}", "unit": "s"}
                time = time.model_copy(update={**column, "nanoseconds": None, "rate": None})
                stamped[name] = stream.model_copy(update={"time": time})
        description = description.model_copy(update=stamped)
        return read_described_log(description, self._source, tables=self._thinned)

    def start_lag_and_clock_drift_correction(
        self, name: str, description: Description, lag_at_wrench_start_s: float, drift: float
    ) -> tuple[float, str, Description]:
        """Return a stream's lag at its first row [s], lines to set, and the edited description.

        The clock of stream `name` lags by `lag_at_wrench_start_s` at the wrench's first row, and by
        `drift` [s/s] more each second.
        """
        time = getattr(description, name).time
        start = self._start_time_of_stream(getattr(description, name))
        start -= self._start_time_of_stream(description.wrench)
        scale = 1.0 / (1.0 + drift)
        lag = scale * (lag_at_wrench_start_s + drift * start)
        offset, factor = time.offset - lag, scale * time.scale
        edited = edit_field(description, f"{name}.time.offset", offset)
        lines = f"{name}.time.offset: {offset:.3f} and {name}.time.scale: {factor:.6f}"
        return lag, lines, edit_field(edited, f"{name}.time.scale", factor)

    def _start_time_of_stream(self, stream: Any) -> float:
        return float(self._times_and_rows(stream)[0][0]) + float(stream.time.offset)

    def _thinning_stride(self, stream: Any) -> int:
        if getattr(stream, "time", None) is None:
            return 1
        t, _ = self._times_and_rows(stream)
        if len(t) < 2:  # read_log raises the error
            return 1
        rate = 1 / max(1e-12, float(np.median(np.diff(t))))
        # A short record keeps enough samples.
        most = min(rate / _THINNED_RATE_HZ, len(t) / MIN_STREAM_SAMPLES)
        return max(1, math.floor((most - 1) / 2) * 2 + 1)

    def _table_of_stream(self, stream: Any) -> Table:
        return self.tables[stream.source].rows_with_any_number(stream.columns)

    def _times_and_rows(self, stream: Any) -> tuple[Array, NDArray[np.intp]]:
        t, _ = time_stamps_and_num_episodes(stream.time, self._table_of_stream(stream), "time")
        rows = np.flatnonzero(np.isfinite(t))
        t = t[rows]
        steps = np.diff(t)
        shared = bool((steps == 0.0).any() and (steps >= 0.0).all() and t[0] < t[-1])
        return (spread_shared_stamps(t) if shared else t), rows

    def _add_thinned_columns(self, name: str, stream: Any, thinned: Table, block_rows: int) -> None:
        table, rows = self._table_of_stream(stream), None
        if getattr(stream, "time", None) is not None:
            t, rows = self._times_and_rows(stream)
            means = _means_of_consecutive_rows(t[:, None], block_rows)
            thinned.columns[f"{_THIN_TIME_PREFIX} {name}"] = means
        for field in type(stream).model_fields:
            quantity = getattr(stream, field)
            for column in map(str, getattr(quantity, "columns", ())):
                x = table.numbers_with_nan(column, field)
                x = x[rows] if rows is not None and len(rows) < len(x) == table.rows else x
                if field == "orientation":
                    x = x[block_rows // 2 :: block_rows][: len(x) // block_rows]
                else:
                    x = _means_of_consecutive_rows(x, block_rows)
                thinned.columns[column] = x


def _means_of_consecutive_rows(x: Array, block_rows: int) -> Array:
    if block_rows == 1:
        return x
    rows = len(x) // block_rows
    return np.asarray(x[: rows * block_rows].reshape(rows, block_rows, -1).mean(axis=1))


_CHECKED_FIELDS_OF_STREAM = {
    "wrench": ("force", "torque"),
    "imu": ("specific_force", "angular_velocity", "angular_acceleration"),
}
_MIN_LIVE_CHANNEL_NOISE_OVER_RANGE = 1e-6


def dead_or_repeated_channel_findings(
    stream: str, description: Description, tables: dict[Path, Table]
) -> list[Finding]:
    """Return findings about dead and repeated channels of the stream "wrench" or "imu"."""
    described = getattr(description, stream)
    found: list[Finding] = []
    named: dict[str, str] = {}
    for field in _CHECKED_FIELDS_OF_STREAM[stream]:
        quantity = getattr(described, field, None)
        if quantity is None:
            continue
        where = f"{stream}.{field}"
        numbers: dict[str, Array] = {}
        for column in quantity.columns:
            x = tables[described.source].numbers_with_nan(column, where).T
            parts = [f"{column}[{i}]" for i in range(len(x))] if len(x) > 1 else [str(column)]
            numbers |= zip(parts, x, strict=True)
        twice = _repeated_column_findings(where, quantity.columns, named)
        found += twice or _dead_channel_findings(where, numbers)
        found += [] if twice else _equal_channel_findings(where, numbers)
    return found


def _repeated_column_findings(where: str, columns: Any, named: dict[str, str]) -> list[Finding]:
    found = []
    for column, times in Counter(map(str, columns)).items():
        before = where if times > 1 else named.get(column)
        named[column] = where
        if before is not None:
            both = "twice" if before == where else f"in {before}.columns too"
            text = f"{where}.columns names {column!r} {both}: one number cannot be two channels"
            remedy = f"set {where}.columns to three columns of their own"
            found.append(Finding("repeated channel", f"{text}; {remedy}"))
    return found


def _dead_channel_findings(where: str, numbers: dict[str, Array]) -> list[Finding]:
    spread = {name: float(np.ptp(x)) for name, x in numbers.items()}
    noise = white_noise_deviations(np.stack(list(numbers.values()), axis=1))
    alive = noise > _MIN_LIVE_CHANNEL_NOISE_OVER_RANGE * (np.array(list(spread.values())) + 1e-300)
    dead = [name for name, width in spread.items() if width == 0.0]
    if not dead or not (alive & (noise > 0.0)).any():
        return []
    text = "in all rows, and its neighbours are not: the channel is dead or not connected"
    remedy = f"name another column in {where}.columns, or record again"
    values = [f"{name!r} is {numbers[name][0]:.4g}" for name in dead]
    return [Finding("dead channel", f"{value} {text}; {remedy}") for value in values]


def _equal_channel_findings(where: str, numbers: dict[str, Array]) -> list[Finding]:
    text = "are the same in all rows: one was recorded twice"
    remedy = f"name another column in {where}.columns, or record again"
    return [
        Finding("repeated channel", f"{a!r} and {b!r} {text}; {remedy}")
        for (a, x), (b, y) in combinations(numbers.items(), 2)
        if np.ptp(x) > 0.0 and np.array_equal(x, y)
    ]
