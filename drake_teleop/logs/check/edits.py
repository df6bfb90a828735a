"""Edits of a log description, each for one suspected error, and logs read with these edits."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import permutations, product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.common.rotations import EULER_AXIS_SEQUENCES, right_angled_rotations
from drake_teleop.logs.causes.cause import Finding
from drake_teleop.logs.read.bags import read_bag_topic_or_table
from drake_teleop.logs.read.canonical import Log
from drake_teleop.logs.read.clocks import smooth_duplicate_stamps, time_stamps_and_num_episodes
from drake_teleop.logs.read.description import Description
from drake_teleop.logs.read.reading import read_described_log
from drake_teleop.logs.read.streams import MIN_STREAM_SAMPLES
from drake_teleop.logs.read.tables import Table

FINDINGS_CAUSED_BY_MISFIT = ("lag", "units", "payload")  # or by its cause, such as drift
MOTION_FINDINGS = (
    *("clock", "reversed gravity", "inverted orientation", "quaternion order", "degrees"),
    "base axes",
)
"""Errors of the described motion, which resemble causes."""
MIN_LAG_OF_WRONG_CLOCK_S = 0.05  # filters lag less
# Median specific force over gravity of an accelerometer on a moving arm.
_MIN_MEDIAN_OVER_GRAVITY, _MAX_MEDIAN_OVER_GRAVITY = 0.6, 1.6
Edit = tuple[Finding, Description]  # a finding, and the corrected description


def edit_field(description: Description, path: str, value: Any) -> Description:
    first, *rest = path.split(".", 1)
    value = edit_field(getattr(description, first), rest[0], value) if rest else value
    return description.model_copy(update={first: value})


def make_edit(
    description: Description, name: str, text: str, fields: dict[str, Any], note: str = ""
) -> Edit:
    shown = {path: str(x).lower() if isinstance(x, bool) else x for path, x in fields.items()}
    lines = " and ".join(f"{path}: {value}" for path, value in shown.items())
    for path, value in fields.items():
        description = edit_field(description, path, _lists_to_tuples(value))
    return Finding(name, f"{text}; set {lines}{note}", fields=fields), description


def _lists_to_tuples(value: Any) -> Any:
    return tuple(map(_lists_to_tuples, value)) if isinstance(value, list) else value


def correct_accelerometer_unit(
    description: Description, log: Log
) -> tuple[list[Finding], Description]:
    """Return a finding if the accelerometer is in a wrong unit, and the corrected description.

    If no unit fits, the finding has no fields, and the description is unchanged.
    """
    median = float(np.median(np.linalg.norm(log.specific_force, axis=1)))
    ratio = median / float(np.linalg.norm(description.gravity_W))
    for stream, name in product(("imu", "static"), ("specific_force", "gravity")):
        path, sensor = f"{stream}.{name}", getattr(getattr(description, stream), name, None)
        if sensor is None:
            continue
        read = ratio / description.unit_in_si(sensor.unit)
        text = f"the accelerometer reads {ratio:.3g} times gravity: it is not in {sensor.unit}"
        for unit in ("m/s^2", "g", "mg", "mm/s^2"):
            if unit != sensor.unit and 0.7 < read * description.unit_in_si(unit) < 1.43:
                finding, edited = make_edit(description, "units", text, {f"{path}.unit": unit})
                return [finding], edited
        if not _MIN_MEDIAN_OVER_GRAVITY < ratio < _MAX_MEDIAN_OVER_GRAVITY:
            remedy = f"correct {path}.scale or unit; a reading without gravity cannot be used"
            text = f"the accelerometer reads {ratio:.3g} times gravity in the median; {remedy}"
            return [Finding("units", text)], description
    return [], description


def orientation_and_gravity_sign_edits(description: Description) -> Iterator[Edit]:
    """Yield edits of a description: inverse or reordered orientation, opposite sign of gravity."""
    pose, imu, edit = description.pose, description.imu, partial(make_edit, description)
    sensed = imu is not None and imu.specific_force is not None
    if imu is not None and sensed:
        text = "the accelerometer reads g - a: gravity is reversed"
        note = " (or reverse the vector `gravity` if z points down)"
        yield edit("reversed gravity", text, {"imu.sign": -imu.sign}, note)
    where = "static.orientation" if description.static else "pose.orientation"
    orientation = pose.orientation if pose else getattr(description.static, "orientation", None)
    if orientation is None:
        return
    if not sensed:
        turned = [0.0 - x for x in description.gravity_W.tolist()]
        text, note = "gravity is reversed", ", a vector in the world"
        yield edit("reversed gravity", text, {"gravity": turned}, note)
    text = "the orientation is that of the world in S, R_SW, not R_WS"
    yield edit("inverted orientation", text, {f"{where}.inverse": not orientation.inverse})
    forms = {"quaternion_wxyz": "quaternion_xyzw", "quaternion_xyzw": "quaternion_wxyz"}
    if orientation.form in forms:
        text = f"the quaternions are not {orientation.form}"
        yield edit("quaternion order", text, {f"{where}.form": forms[orientation.form]})
    if orientation.form in ("rotation_vector", "euler"):
        form = {} if orientation.form == "euler" else {f"{where}.form": "euler"}
        text = "the angles are Euler angles, not a rotation vector"
        text = text if form else f"the Euler angles are not about the axes {orientation.axes}"
        for axes in EULER_AXIS_SEQUENCES:
            if axes != orientation.axes:
                yield edit("Euler axes", text, form | {f"{where}.axes": axes})
        text = f"the angles are not in {orientation.unit}"
        unit = "deg" if orientation.unit == "rad" else "rad"
        yield edit("degrees", text, {f"{where}.unit": unit})


def edit_with_opposite_wrench_sign(finding: Finding, description: Description) -> Edit:
    stream = "static" if description.static else "wrench"
    path, sign = f"{stream}.sign", -getattr(description, stream).sign
    text = f"the sign of the wrench is inverted, and {finding.message} and {path}: {sign}"
    changed = edit_field(description, path, sign)
    return replace(finding, message=text, fields=finding.fields | {path: sign}), changed


def call_or_none_if_unreadable(function: Callable[[Description], Any], edited: Description) -> Any:
    try:
        return function(edited)
    except DrakeTeleopError:
        return None


def wrench_and_motion_edits(description: Description) -> Iterator[Edit]:
    """Yield edits of a description: other signs, axes and units of wrench and motion."""
    stream = "static" if description.static else "wrench"
    sensor: Any = getattr(description, stream)
    edit = partial(make_edit, description)
    yield edit("sign", "the sign of the wrench is inverted", {f"{stream}.sign": -sensor.sign})
    yield from orientation_and_gravity_sign_edits(description)
    if isinstance(sensor.frame, str):
        text, other = "the wrench is in the axes of the base", "base"
        if sensor.frame == "base":
            text, other = "the wrench is not in base axes", "sensor"
        yield edit("base axes", text, {f"{stream}.frame": other})
    imu, pose = description.imu, description.pose
    if pose is not None and pose.position and (imu is None or imu.specific_force is None):
        text = f"the position is not in {pose.position.unit}"
        unit = "mm" if pose.position.unit == "m" else "m"
        yield edit("units", text, {"pose.position.unit": unit})
    if imu is not None and imu.angular_velocity:
        text = f"the gyroscope is not in {imu.angular_velocity.unit}"
        unit = "deg/s" if imu.angular_velocity.unit == "rad/s" else "rad/s"
        yield edit("degrees", text, {"imu.angular_velocity.unit": unit})
    columns: dict[str, Any] = {
        f"{stream}.{x}.columns": getattr(sensor, x).columns for x in ("force", "torque")
    }
    exchanged = dict(zip(columns, [list(names) for names in columns.values()][::-1], strict=True))
    yield edit("torque first", "force and torque are exchanged", exchanged)
    for order in list(permutations(range(3)))[1:]:
        if all(len(names) == 3 for names in columns.values()):
            fields = {path: [names[i] for i in order] for path, names in columns.items()}
            yield edit("swapped axes", "axes of the wrench are exchanged", fields)
    old = np.array(sensor.frame) if isinstance(sensor.frame, tuple) else np.eye(3)
    for R in right_angled_rotations()[1:] if sensor.frame != "base" else ():
        frame = {f"{stream}.frame": (R @ old).tolist()}
        yield edit("swapped axes", "the wrench is rotated relative to the motion", frame)


_THINNED_RATE_HZ = 100.0
_THINNED_TIME_COLUMN_PREFIX = "thinned time stamps of"


class LogTables:
    """Tables of a log in memory: the complete ones, and copies thinned to about 100 Hz."""

    def __init__(self, description: Description, source: str, tables: dict[Path, Table]) -> None:
        self._description, self._source, self.tables = description, source, tables
        self._thinned: dict[Path, Table] = {}
        steps: dict[Path, list[int]] = {}
        for stream in description.streams.values():
            if stream.source not in tables:
                tables[stream.source] = read_bag_topic_or_table(stream)
            steps.setdefault(stream.source, []).append(self._thinning_stride(stream))
        for name, stream in description.streams.items():
            whole = tables[stream.source]
            copied = replace(whole, columns=dict(whole.columns))
            thinned = self._thinned.setdefault(stream.source, copied)
            self._add_thinned_columns(name, stream, thinned, min(steps[stream.source]))

    def read_whole_log(self, description: Description) -> Log:
        return read_described_log(description, self._source, tables=self.tables)

    def read_thinned_log(self, description: Description) -> Log:
        stamped = {}
        for name, stream in description.streams.items():
            if (time := getattr(stream, "time", None)) is not None:
                column = f"{_THINNED_TIME_COLUMN_PREFIX} {name}"
                scale = time.scale / getattr(self._description, name).time.scale  # of the thinned
                changes = {"column": column, "unit": "s", "scale": scale}
                time = time.model_copy(update=changes | {"nanoseconds": None, "rate": None})
                stamped[name] = stream.model_copy(update={"time": time})
        description = description.model_copy(update=stamped)
        return read_described_log(description, self._source, tables=self._thinned)

    def correction_of_lag_and_clock_drift(
        self, name: str, description: Description, lag_at_wrench_start_s: float, drift: float
    ) -> tuple[float, str, Description]:
        """Return a stream's lag at its first row [s], YAML text of the fix, corrected description.

        The clock of stream `name` lags by `lag_at_wrench_start_s` at the wrench's first row. The
        lag grows by `drift` [s/s].
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
        return float(self._finite_times_and_row_indices(stream)[0][0]) + float(stream.time.offset)

    def _thinning_stride(self, stream: Any) -> int:
        if getattr(stream, "time", None) is None:
            return 1
        t, _ = self._finite_times_and_row_indices(stream)
        if len(t) < 2:  # read_log raises the error
            return 1
        rate = 1 / max(1e-12, float(np.median(np.diff(t))))
        # A short record keeps enough samples.
        most = min(rate / _THINNED_RATE_HZ, len(t) / MIN_STREAM_SAMPLES)
        return max(1, math.floor((most - 1) / 2) * 2 + 1)

    def _table_of_stream(self, stream: Any) -> Table:
        return self.tables[stream.source].rows_with_any_number(stream.columns)

    def _finite_times_and_row_indices(self, stream: Any) -> tuple[Array, NDArray[np.intp]]:
        table, columns = self._table_of_stream(stream), stream.columns
        t, _ = time_stamps_and_num_episodes(stream.time, table, columns, "time")
        rows = np.flatnonzero(np.isfinite(t))
        t = t[rows]
        steps = np.diff(t)
        shared = bool((steps == 0.0).any() and (steps >= 0.0).all() and t[0] < t[-1])
        return (smooth_duplicate_stamps(t) if shared else t), rows

    def _add_thinned_columns(self, name: str, stream: Any, thinned: Table, block_rows: int) -> None:
        table, rows = self._table_of_stream(stream), None
        if getattr(stream, "time", None) is not None:
            t, rows = self._finite_times_and_row_indices(stream)
            means = _means_of_consecutive_rows(t[:, None], block_rows)
            thinned.columns[f"{_THINNED_TIME_COLUMN_PREFIX} {name}"] = means
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
