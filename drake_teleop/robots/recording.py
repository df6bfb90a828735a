"""Recorder that writes the readings of a source as a log."""

from __future__ import annotations

import math
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.files import write_table, write_text
from drake_teleop.common.numeric import Array
from drake_teleop.common.rotations import rotation_matrices
from drake_teleop.common.texts import to_yaml_text
from drake_teleop.logs.read import canonical
from drake_teleop.logs.read.canonical import Log, write_log
from drake_teleop.robots import streams
from drake_teleop.robots.assembly import IDENTITY_POSE
from drake_teleop.robots.compensator import MIN_CLOCK_JUMP_S
from drake_teleop.robots.streams import POSE, WRENCH, WRENCH_AND_MOTION, Reading, ReadingFlag

_FLAGS_OF_REJECTED_READINGS = (
    ReadingFlag.DAMAGED
    | ReadingFlag.NOT_FINITE
    | ReadingFlag.OUT_OF_RANGE
    | ReadingFlag.SATURATED
    | ReadingFlag.GAP
)
_LOG_COLUMNS_OF_STREAM: dict[str, dict[str, tuple[str, ...]]] = {
    WRENCH: {"force": canonical.WRENCH_COLUMNS[:3], "torque": canonical.WRENCH_COLUMNS[3:]},
    POSE: {"orientation": canonical.QUATERNION_COLUMNS, "position": canonical.POSITION_COLUMNS},
    streams.IMU: {
        "specific_force": canonical.SPECIFIC_FORCE_COLUMNS,
        "angular_velocity": canonical.ANGULAR_VELOCITY_COLUMNS,
    },
}
_GRAVITY_M_S2 = 9.81  # as in `compensate`
_QUATERNION_NORM_TOLERANCE = 0.01
_NUM_SAMPLES_THAT_CONFIRM_NEW_CLOCK = 50  # successive samples that confirm another clock


class Recorder:
    """Recorder of a source's readings, which are written as a log.

    A jump of the source's clock starts a new record; the longest one is written.

    Args:
        sensor_range: (6,) range of the sensor [N, N m]; None: unknown.
        X_FS: (7,) pose of the sensor in the frame F of the poses.
        two_clocks: whether wrench and motion have different clocks.

    Attributes:
        log_file_name, file_names: name of the log, and of all its files.
        left_out: number of rejected readings.
    """

    def __init__(
        self,
        streams: tuple[str, ...] = (WRENCH_AND_MOTION,),
        sensor_range: Array | None = None,
        X_FS: Array = IDENTITY_POSE,
        *,
        two_clocks: bool = False,
    ) -> None:
        self._streams, self._two_clocks = streams, two_clocks
        self._sensor_range = np.full(6, np.inf) if sensor_range is None else sensor_range
        self._R_SF = rotation_matrices(X_FS[None, :4], "quaternion_wxyz")[0].T
        self._p_FS = X_FS[4:]
        tables = [] if WRENCH_AND_MOTION in streams else list(_LOG_COLUMNS_OF_STREAM)
        self.log_file_name = "log.yaml" if tables else "log.parquet"
        self.file_names = self.log_file_name, *(f"{each}.parquet" for each in tables)
        self.left_out, self.clock_changes = 0, 0
        self._record, self._other_clock = self._make_empty_record(), self._make_empty_record()
        self._longest = self._record

    def _make_empty_record(self) -> dict[str, _SampleSeries]:
        return {stream: _SampleSeries() for stream in self._streams}

    def add(self, reading: Reading) -> None:
        stream, t, values = reading.stream, reading.t, reading.values
        if stream not in self._record:
            return
        finite = math.isfinite(t) and bool(np.isfinite(values).all())
        valid = finite and not reading.flags & _FLAGS_OF_REJECTED_READINGS
        if stream == POSE:
            valid &= abs(float(np.linalg.norm(values[:4])) - 1.0) < _QUATERNION_NORM_TOLERANCE
        elif stream in (WRENCH, WRENCH_AND_MOTION):
            valid &= not (np.abs(values[:6]) >= self._sensor_range).any()
        if not valid:
            self.left_out += 1
            return
        samples, other = self._record[stream], self._other_clock[stream]
        same_clock = not samples.is_clock_jump(t)
        if same_clock or other.is_clock_jump(t):
            self.left_out += len(other.t)
            other = self._other_clock[stream] = _SampleSeries()
        self.left_out += not (samples if same_clock else other).add_if_newer(reading)
        if len(other.t) == _NUM_SAMPLES_THAT_CONFIRM_NEW_CLOCK:
            self.clock_changes += 1
            self._longest = self._longest_record()
            self._record, self._other_clock = self._other_clock, self._make_empty_record()

    def _longest_record(self) -> dict[str, _SampleSeries]:
        return max(self._record, self._longest, key=_duration_of_shortest_stream_s)

    @property
    def longest_record_s(self) -> float:
        return _duration_of_shortest_stream_s(self._longest_record())

    def write(self, path: Path) -> None:
        import polars as pl

        record = self._longest_record()
        if WRENCH_AND_MOTION in record:
            size, samples = streams.NUM_READING_VALUES, record[WRENCH_AND_MOTION]
            t, values = samples.times_and_values(size, self.left_out)
            wrench, s, omega, alpha = np.split(values, [6, 9, 12], axis=1)
            write_log(Log(t - t[0], wrench, s, omega, alpha), path)
            return
        start = record[WRENCH].times_and_values(6, self.left_out)[0][0]
        for stream, samples in record.items():
            shift = samples.min_offset - record[WRENCH].min_offset if self._two_clocks else 0.0
            names = list(chain(*_LOG_COLUMNS_OF_STREAM[stream].values()))
            t, values = samples.times_and_values(len(names), self.left_out)
            columns = {"t": t + (shift - start)} | dict(zip(names, values.T, strict=True))
            write_table(path.with_name(f"{stream}.parquet"), pl.DataFrame(columns))
        write_text(path, to_yaml_text(self._make_log_description()))

    def _make_log_description(self) -> dict[str, Any]:
        found: dict[str, Any] = {"gravity": _GRAVITY_M_S2}
        for stream in self._streams:
            found[stream] = {"file": f"{stream}.parquet", "time": {"column": "t"}}
            for name, columns in _LOG_COLUMNS_OF_STREAM[stream].items():
                found[stream][name] = {"columns": list(columns)}
        if POSE in found:
            found[POSE]["orientation"]["form"] = "quaternion_wxyz"
            found[POSE]["position_in_sensor"] = (-self._R_SF @ self._p_FS).tolist()
            found[POSE]["rotation_in_sensor"] = self._R_SF.tolist()
        return found


class _SampleSeries:
    def __init__(self) -> None:
        self.t: list[float] = []
        self._values: list[Array] = []
        self.min_offset = math.inf

    def is_clock_jump(self, t: float) -> bool:
        return bool(self.t) and abs(t - self.t[-1]) > MIN_CLOCK_JUMP_S

    def add_if_newer(self, reading: Reading) -> bool:
        if self.t and reading.t <= self.t[-1]:
            return False
        self.t.append(reading.t)
        self._values.append(reading.values)
        self.min_offset = min(self.min_offset, reading.arrival - reading.t)
        return True

    def times_and_values(self, num_columns: int, num_rejected: int) -> tuple[Array, Array]:
        if len(self.t) < 2:
            counts = f"{len(self.t)} valid and {num_rejected} invalid readings"
            what, remedy = f"{counts} received (minimum: 2 valid)", "check the source's address"
            if num_rejected:
                remedy = "check --range and the values that the source sends"
            raise DrakeTeleopError(what, where="calibrate", remedy=remedy)
        return np.array(self.t), np.array(self._values).reshape(-1, num_columns)


def _duration_of_shortest_stream_s(record: dict[str, _SampleSeries]) -> float:
    return min(samples.t[-1] - samples.t[0] if samples.t else 0.0 for samples in record.values())
