"""Recorders that write the samples of a stream as a log."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.files import write_table, write_text
from drake_teleop.common.numeric import Array
from drake_teleop.common.rotations import rotation_matrices
from drake_teleop.common.texts import to_yaml_text
from drake_teleop.logs.read import canonical
from drake_teleop.logs.read.canonical import Log, write_log
from drake_teleop.robots.assembly import PartStreams
from drake_teleop.robots.compensator import CLOCK_JUMP_S
from drake_teleop.robots.streams import (
    IMU,
    NUM_READING_VALUES,
    POSE,
    WRENCH,
    Part,
    Reading,
    ReadingFlag,
)

_INVALID_FLAGS = (
    ReadingFlag.DAMAGED
    | ReadingFlag.NOT_FINITE
    | ReadingFlag.OUT_OF_RANGE
    | ReadingFlag.SATURATED
    | ReadingFlag.GAP
)
_LOG_COLUMNS_OF_STREAM: dict[str, dict[str, tuple[str, ...]]] = {
    WRENCH: {"force": canonical.WRENCH_COLUMNS[:3], "torque": canonical.WRENCH_COLUMNS[3:]},
    POSE: {"orientation": canonical.QUATERNION_COLUMNS, "position": canonical.POSITION_COLUMNS},
    IMU: {
        "specific_force": canonical.SPECIFIC_FORCE_COLUMNS,
        "angular_velocity": canonical.ANGULAR_VELOCITY_COLUMNS,
    },
}
_GRAVITY_M_S2 = 9.81  # as in `compensate`
_QUATERNION_NORM_TOLERANCE = 0.01  # tolerated error of a quaternion's norm
_NEW_CLOCK_CONFIRMATION_SAMPLES = 50  # successive samples that confirm another clock
_SampleT = TypeVar("_SampleT")


class SampleRecorder(ABC, Generic[_SampleT]):
    """Recorder of samples; `largest`: stream -> largest valid magnitudes (6,), or None.

    If the source's clock is set, a new record starts; the longest one is written.

    Attributes:
        left_out: number of rejected samples.
        clock_changes: number of clock changes.
    """

    log_file_name: str
    file_names: tuple[str, ...]

    def __init__(self, largest: dict[str, Array | None]) -> None:
        self._largest = {k: np.full(6, np.inf) if x is None else x for k, x in largest.items()}
        self.left_out, self.clock_changes = 0, 0
        self._part, self._other_clock = self._make_empty_part(), self._make_empty_part()
        self._longest = self._part

    def _make_empty_part(self) -> dict[str, _SampleSeries]:
        return {stream: _SampleSeries() for stream in self._largest}

    def _add_sample(
        self, stream: str, t: float, values: Array, flags: int, now: float = 0.0
    ) -> None:
        finite = math.isfinite(t) and bool(np.isfinite(values).all())
        saturated = (np.abs(values[:6]) >= self._largest[stream]).any()
        if not finite or flags & _INVALID_FLAGS or saturated:
            self.left_out += 1
            return
        samples, other = self._part[stream], self._other_clock[stream]
        same_clock = not samples.is_clock_jump(t)
        if same_clock or other.is_clock_jump(t):
            self.left_out += len(other.t)
            other = self._other_clock[stream] = _SampleSeries()
        self.left_out += not (samples if same_clock else other).add(t, values, now)
        if len(other.t) == _NEW_CLOCK_CONFIRMATION_SAMPLES:
            self.clock_changes += 1
            self._longest = self._longest_part()
            self._part, self._other_clock = self._other_clock, self._make_empty_part()

    def _longest_part(self) -> dict[str, _SampleSeries]:
        return max(self._part, self._longest, key=_min_stream_duration_s)

    @property
    def longest_part_s(self) -> float:
        return _min_stream_duration_s(self._longest_part())

    @abstractmethod
    def add(self, sample: _SampleT) -> None:
        """Add a sample if it is valid."""

    @abstractmethod
    def write(self, path: Path) -> None: ...


class ReadingRecorder(SampleRecorder[Reading]):
    """Recorder of readings; `largest` (6,) is the range of the sensor [N, N m]."""

    log_file_name = "log.parquet"
    file_names: tuple[str, ...] = (log_file_name,)

    def __init__(self, largest: Array | None = None) -> None:
        super().__init__({WRENCH: largest})

    def add(self, sample: Reading) -> None:
        self._add_sample(WRENCH, sample.t, sample.values, sample.flags)

    def write(self, path: Path) -> None:
        t, values = self._longest_part()[WRENCH].times_and_values(NUM_READING_VALUES, self.left_out)
        wrench, s, omega, alpha = np.split(values, [6, 9, 12], axis=1)
        write_log(Log(t - t[0], wrench, s, omega, alpha), path)


class PartRecorder(SampleRecorder[tuple[Part, float]]):
    """Recorder of parts: wrenches, and poses or IMU samples.

    `largest` (6,) is the range of the sensor [N, N m]; `X_FS` (7,) its pose in the posed frame F.
    """

    log_file_name = "log.yaml"
    file_names: tuple[str, ...] = (
        log_file_name,
        *(f"{stream}.parquet" for stream in _LOG_COLUMNS_OF_STREAM),
    )

    def __init__(self, parts: PartStreams, largest: Array | None, X_FS: Array) -> None:
        super().__init__({WRENCH: largest, parts.motion_stream: None})
        self._motion_stream, self._two_clocks = parts.motion_stream, parts.two_clocks
        self._R_FS = rotation_matrices(X_FS[None, :4], "quaternion_wxyz")[0]
        self._p_FS = X_FS[4:]

    def add(self, sample: tuple[Part, float]) -> None:
        part, now = sample
        if part.stream not in self._part:
            return
        size = float(np.linalg.norm(part.values[:4])) if part.stream == POSE else 1.0
        flags = (
            part.flags
            if abs(size - 1.0) < _QUATERNION_NORM_TOLERANCE
            else part.flags | ReadingFlag.DAMAGED
        )
        self._add_sample(part.stream, part.t, part.values, flags, now)

    def write(self, path: Path) -> None:
        import polars as pl

        wrench, motion = (self._longest_part()[stream] for stream in (WRENCH, self._motion_stream))
        start = wrench.times_and_values(6, self.left_out)[0][0]
        behind = motion.min_offset - wrench.min_offset if self._two_clocks else 0.0
        for stream, samples, shift in (
            (WRENCH, wrench, -start),
            (self._motion_stream, motion, behind - start),
        ):
            names = [
                name for columns in _LOG_COLUMNS_OF_STREAM[stream].values() for name in columns
            ]
            t, values = samples.times_and_values(len(names), self.left_out)
            columns = {"t": t + shift} | dict(zip(names, values.T, strict=True))
            write_table(path.with_name(f"{stream}.parquet"), pl.DataFrame(columns))
        write_text(path, to_yaml_text(self._log_description()))

    def _log_description(self) -> dict[str, Any]:
        found: dict[str, Any] = {"gravity": _GRAVITY_M_S2}
        for stream in (WRENCH, self._motion_stream):
            fields = {
                name: {"columns": list(names)}
                for name, names in _LOG_COLUMNS_OF_STREAM[stream].items()
            }
            found[stream] = {"file": f"{stream}.parquet", "time": {"column": "t"}} | fields
        if self._motion_stream == POSE:
            R_SF = self._R_FS.T
            found[POSE]["orientation"]["form"] = "quaternion_wxyz"
            found[POSE]["position_in_sensor"] = (-R_SF @ self._p_FS).tolist()
            found[POSE]["rotation_in_sensor"] = R_SF.tolist()
        return found


class _SampleSeries:
    def __init__(self) -> None:
        self.t: list[float] = []
        self._values: list[Array] = []
        self.min_offset = math.inf

    def is_clock_jump(self, t: float) -> bool:
        return bool(self.t) and abs(t - self.t[-1]) > CLOCK_JUMP_S

    def add(self, t: float, values: Array, now: float) -> bool:
        if self.t and t <= self.t[-1]:
            return False
        self.t.append(t)
        self._values.append(values)
        self.min_offset = min(self.min_offset, now - t)
        return True

    def times_and_values(self, width: int, left_out: int) -> tuple[Array, Array]:
        if len(self.t) < 2:
            raise DrakeTeleopError(
                f"{len(self.t)} valid and {left_out} invalid readings received (minimum: 2 valid)",
                where="calibrate",
                remedy="check that the source sends to this port",
            )
        return np.array(self.t), np.array(self._values).reshape(-1, width)


def _min_stream_duration_s(part: dict[str, _SampleSeries]) -> float:
    return min(samples.t[-1] - samples.t[0] if samples.t else 0.0 for samples in part.values())
