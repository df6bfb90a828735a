"""Conversion of a canonical table or a described recording into a `Log`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common import rotations
from drake_teleop.common.errors import DrakeTeleopError, expect_type
from drake_teleop.common.numeric import Array, to_float
from drake_teleop.common.rotations import nearest_rotation
from drake_teleop.logs.pose_motion.poses import ImuData, Poses, PosesOfLog
from drake_teleop.logs.read import alignment, auto_frames, clocks, streams, table_files
from drake_teleop.logs.read.alignment import SMOOTHER_WINDOW_OVER_PERIOD, angular_motion, resample
from drake_teleop.logs.read.auto_frames import restore_removed_weight
from drake_teleop.logs.read.bags import is_bag, missing_topic_error, read_bag_topic_or_table
from drake_teleop.logs.read.canonical import Log, describe_canonical
from drake_teleop.logs.read.clocks import Clock
from drake_teleop.logs.read.description import (
    Description,
    Imu,
    Pose,
    Static,
    Wrench,
    load_description,
)
from drake_teleop.logs.read.streams import MIN_STREAM_SAMPLES, OrientationColumns, Stream
from drake_teleop.logs.read.table_files import TABLE_READERS
from drake_teleop.logs.read.tables import Table, decimal_resolution

MIN_STATIC_POSES, MIN_CUTOFF_HZ = 3, 1e-3
_CONVERTED_CHUNK_ROWS, _MIN_IMU_GAP_OVER_STEP = 2**16, 4.0
_MIN_CALENDAR_TIME_S, _MAX_CALENDAR_TIME_S = 1e8, 1e10  # years 1973 and 2286
_AutoEstimator = Callable[..., auto_frames.Estimate]


def read_log(
    path: str | Path, *, bandwidth_hz: float | None = 30.0, differentiate: bool = True
) -> Log:
    """Read a canonical table (.csv, .parquet ...) or a log description (.yaml, .yml).

    Signals are resampled to the wrench's clock at its median rate. Angular velocity is from the
    gyroscope, else from the orientation; angular acceleration from the file, else differentiated;
    specific force from the accelerometer, else from the position, else it is -gravity.

    Args:
        bandwidth_hz: bandwidth of derivatives, see `smooth_derivatives`; None: the largest.
        differentiate: False leaves the motion zero where poses are its only source, for users of
            `Log.posed`.
    """
    check_path_and_cutoff(path, bandwidth_hz, "bandwidth_hz")
    path = Path(path)
    if path.suffix.lower() in (".yaml", ".yml"):
        reader = _LogReader(load_description(path), str(path), bandwidth_hz)
        return reader.read_recording(differentiate=differentiate)
    if path.suffix.lower() in TABLE_READERS:
        table = table_files.read_table(path)
        description = describe_canonical(path, table)
        reader = _LogReader(description, str(path), bandwidth_hz, {path: table})
        return reader.read_recording(keep_time_origin=True, differentiate=differentiate)
    if is_bag(path):
        raise missing_topic_error(path)
    table_files.require_file(path)
    remedy = f"give a canonical log ({', '.join(TABLE_READERS)}) or a log description (.yaml)"
    raise DrakeTeleopError(f"format {path.suffix!r} is not known", where=str(path), remedy=remedy)


def check_path_and_cutoff(path: Any, cutoff_hz: Any, option: str = "cutoff_hz") -> None:
    expect_type((str, Path), path, "log", "give the file's name")
    if cutoff_hz is not None and not to_float(option, cutoff_hz) >= MIN_CUTOFF_HZ:
        remedy = f"give at least {MIN_CUTOFF_HZ:g} Hz, or None for no limit"
        raise DrakeTeleopError(f"cut-off {cutoff_hz:g} Hz is too low", where=option, remedy=remedy)


def read_described_log(
    description: Description,
    source: str,
    *,
    tables: dict[Path, Table] | None = None,
    differentiate: bool = True,
) -> Log:
    """Return the log of a description with absolute paths, as `read_log`."""
    reader = _LogReader(description, source, 30.0, dict(tables or {}))
    return reader.read_recording(differentiate=differentiate)


@dataclass
class _LogReader:
    description: Description
    source: str
    bandwidth_hz: float | None
    tables: dict[Path, Table] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    gaps: list[Array] = field(default_factory=list)
    one_sided_s: float = 0.0

    def read_recording(self, *, keep_time_origin: bool = False, differentiate: bool = True) -> Log:
        if self.description.static is not None:
            if keep_time_origin:
                self.notes.append("each row is interpreted as a pose at rest")
            return self._read_static_poses(self.description.static)
        stream = self.description.wrench
        assert stream is not None
        weight, gravity = stream.weight, self.description.gravity
        free = {"gravity": gravity == "auto", "weight": weight == "removed"}
        if gravity == "auto":
            self._replace_auto_fields(auto_frames.estimate_auto_gravity)
        if self.description.pose is not None and self.description.pose.is_frame_auto:
            self._replace_auto_fields(auto_frames.estimate_auto_pose_frame, differentiate=False)
        if self.description.imu is not None and self.description.imu.is_mounting_auto:
            self._replace_auto_fields(auto_frames.estimate_auto_imu_mounting)
        table = self._table_of_stream(stream)
        clock = self._read_clock_and_gaps("wrench", stream, table)
        wrench = self._read_wrench("wrench", stream, table, clock.num_rows)[clock.kept_rows]
        pose = imu = None
        if self.description.pose is not None:
            pose = self._read_pose(self.description.pose, differentiate=differentiate)
        if self.description.imu is not None:
            imu = self._read_imu(self.description.imu, pose)
        kinematics = [stream for stream in (imu, pose) if stream is not None]
        t = streams.uniform_times_of_streams(clock.t, kinematics, self.source)
        log = self._make_log(t, resample(t, clock.t, wrench), imu, pose)
        log = replace(log, estimated=tuple(name for name, is_free in free.items() if is_free))
        has_calendar_time = _MIN_CALENDAR_TIME_S < clock.t[0] < _MAX_CALENDAR_TIME_S
        log = replace(log, has_calendar_time=bool(has_calendar_time))
        log = log if keep_time_origin else log.with_times_relative_to(float(clock.t[0]))
        if not isinstance(weight, tuple):
            return log
        without = stream.model_copy(update={"weight": None})
        other = self.description.model_copy(update={"wrench": without})
        return restore_removed_weight(log, np.array(weight), self._read_described_log(other))

    def _replace_auto_fields(self, estimate: _AutoEstimator, *, differentiate: bool = True) -> None:
        read = partial(self._read_described_log, differentiate=differentiate)
        self.description, notes = estimate(self.description, self.source, read)
        self.notes += notes

    def _read_described_log(self, description: Description, *, differentiate: bool = True) -> Log:
        for stream in self.description.streams.values():
            self._table_of_stream(stream)
        reader = _LogReader(description, self.source, 30.0, dict(self.tables))
        return reader.read_recording(differentiate=differentiate)

    def _table_of_stream(self, stream: Wrench | Imu | Pose | Static) -> Table:
        if stream.source not in self.tables:
            self.tables[stream.source] = read_bag_topic_or_table(stream)
        table = self.tables[stream.source]
        if table.note and table.note not in self.notes:
            self.notes.append(table.note)
        return table if isinstance(stream, Static) else table.rows_with_any_number(stream.columns)

    def _read_wrench(self, name: str, stream: Wrench | Static, table: Table, rows: int) -> Array:
        both = [
            self._read_vectors(f"{name}.{field}", table, rows, stream.sign)
            for field in ("force", "torque")
        ]
        if isinstance(stream.frame, tuple):
            R = np.array(stream.frame)
            both = [vectors @ R.T for vectors in both]
        return np.hstack(both)

    def _read_vectors(self, name: str, table: Table, rows: int, sign: float = 1.0) -> Array:
        """Return the vectors (rows, 3) of a quantity such as `wrench.force` [SI]."""
        quantity, where = attrgetter(name)(self.description), f"{self.source}:{name}.columns"
        values = table.finite_numbers(quantity.columns, 3, where, rows)
        streams.check_for_lost_readings(values, table, where)
        values -= getattr(quantity, "bias", 0.0)
        values *= sign * self.description.unit_in_si(quantity.unit) * np.array(quantity.scale)
        of_table = table_files.note_that_table_needs_description(self.source)
        remedy = (
            f"if these are raw counts, set {name}.scale, such as 1e-6{of_table};"
            " else check column and unit, or delete the row"
        )
        limit = streams.MAX_PLAUSIBLE_VALUES[name.partition(".")[2]]
        table.check_magnitude(values, *limit, where, remedy)
        return values

    def _read_pose(self, stream: Pose, *, differentiate: bool) -> Stream:
        table = self._table_of_stream(stream)
        clock = self._read_clock_and_gaps("pose", stream, table)
        t, raw = alignment.uniform_times(clock.t), None
        quaternion, position = self._poses_of_S(stream, table, clock)
        if position is not None:
            raw = Poses(clock.t, position, quaternion).with_continuous_quaternions()
            wrench, imu = self.description.wrench, self.description.imu
            if not differentiate and imu is None and wrench is not None and wrench.frame != "base":
                return Stream("pose", t, recorded_poses=raw)
        dt = alignment.mean_time_step(t)
        self.one_sided_s = max(self.one_sided_s, self._half_smoother_window_s(dt))
        raw_R = rotations.rotation_matrices(quaternion, "quaternion_wxyz")
        R_WS = nearest_rotation(resample(t, clock.t, raw_R))
        acceleration = np.zeros(3)
        if position is not None:
            position = resample(t, clock.t, position)
            acceleration = alignment.smooth_derivatives(position, dt, self.bandwidth_hz)[2]
        s = streams.rotate_world_to_S(R_WS, acceleration - self.description.gravity_W)
        return Stream("pose", t, s, *angular_motion(R_WS, dt, self.bandwidth_hz), R_WS, raw)

    def _poses_of_S(self, stream: Pose, table: Table, clock: Clock) -> tuple[Array, Array | None]:
        """Return quaternions (N, 4) [w, x, y, z] of R_WS, and positions p_WoSo_W (N, 3) or None."""
        position = None
        if stream.position is not None:
            position = self._read_vectors("pose.position", table, clock.num_rows)[clock.kept_rows]
        where, form = f"{self.source}:pose.orientation", stream.orientation
        orientations = OrientationColumns(self.description, form, table, clock.num_rows, where)
        quaternion = orientations.allocate_quaternions(len(clock.kept_rows))
        origin = np.array(stream.position_in_sensor)
        for start in range(0, len(quaternion), _CONVERTED_CHUNK_ROWS):
            part = slice(start, start + _CONVERTED_CHUNK_ROWS)
            q = orientations.quaternions(clock.kept_rows[part])
            if stream.R_SP is not None or (position is not None and origin.any()):
                R_WS = rotations.rotation_matrices(q, "quaternion_wxyz")
                if stream.R_SP is not None:
                    R_WS = R_WS @ stream.R_SP.T
                    q = rotations.quaternions_from_matrices(R_WS)
                if position is not None:  # from Po to So
                    position[part] -= R_WS @ origin
            quaternion[part] = q
        return quaternion, position

    def _read_imu(self, stream: Imu, pose: Stream | None) -> Stream:
        table = self._table_of_stream(stream)
        clock = self._read_clock_and_gaps("imu", stream, table)
        raw_t, t = clock.t, alignment.uniform_times(clock.t)
        dt = alignment.mean_time_step(t)

        def imu_vectors(field: str, sign: float = 1.0) -> Array | None:
            if getattr(stream, field) is None:
                return None
            values = self._read_vectors(f"imu.{field}", table, clock.num_rows, sign)
            values = resample(t, raw_t, values[clock.kept_rows])
            if stream.frame == "sensor":
                return values
            if isinstance(stream.frame, tuple):
                return values @ np.array(stream.frame).T
            if pose is None or pose.R_WS is None:
                raise self._no_R_WS_error("imu")
            R_WS = nearest_rotation(resample(t, pose.t, pose.R_WS))
            return streams.rotate_world_to_S(R_WS, values)

        s = imu_vectors("specific_force", stream.sign)
        omega, alpha = imu_vectors("angular_velocity"), imu_vectors("angular_acceleration")
        if omega is not None and alpha is None:
            self.one_sided_s = max(self.one_sided_s, self._half_smoother_window_s(dt))
            alpha = alignment.smooth_derivatives(omega, dt, self.bandwidth_hz)[1]
        assert stream.position != "auto"
        if s is not None and any(stream.position):
            turning: list[Any] = [omega, alpha]
            if omega is None:
                assert pose is not None
                both = pose.angular_velocity, pose.angular_acceleration
                turning = [resample(t, pose.t, x) for x in both if x is not None]
            p, (omega_S, alpha_S) = np.array(stream.position), turning
            s = s - np.cross(alpha_S, p) - np.cross(omega_S, np.cross(omega_S, p))  # Io to So
        at = np.clip(np.searchsorted(raw_t, t), 1, len(raw_t) - 1)
        outside_gaps = raw_t[at] - raw_t[at - 1] < _MIN_IMU_GAP_OVER_STEP * dt
        signals = (None if x is None else x[outside_gaps] for x in (s, omega))
        return Stream("imu", t, s, omega, alpha, imu_data=ImuData(t[outside_gaps], *signals))

    def _no_R_WS_error(self, name: str, remedy: str = "add a pose stream") -> DrakeTeleopError:
        what = "vectors in the axes of the base cannot be rotated to S without an orientation"
        return DrakeTeleopError(what, where=f"{self.source}:{name}.frame", remedy=remedy)

    def _read_static_poses(self, stream: Static) -> Log:
        table = self._table_of_stream(stream)
        wrench = self._read_wrench("static", stream, table, table.rows)
        R_SW = None
        if stream.gravity is not None:
            gravity = self._read_vectors("static.gravity", table, table.rows)
        elif stream.specific_force is not None:
            gravity = -self._read_vectors("static.specific_force", table, table.rows)
        else:
            assert stream.orientation is not None
            where, form = f"{self.source}:static.orientation", stream.orientation
            orientations = OrientationColumns(self.description, form, table, table.rows, where)
            R_SW = np.swapaxes(orientations.rotations(np.arange(table.rows)), 1, 2)
            gravity = R_SW @ self.description.gravity_W
        if stream.frame == "base":
            if R_SW is None:
                remedy = "give static.orientation instead of gravity or specific_force"
                raise self._no_R_WS_error("static", remedy)
            wrench = streams.rotate_wrench_world_to_S(R_SW, wrench)
        if isinstance(stream.weight, tuple):
            wrench = wrench + auto_frames.wrench_of_weight(np.array(stream.weight), gravity)
        n = len(wrench)
        if n < MIN_STATIC_POSES:
            what = f"{n} poses at rest are too few (at least {MIN_STATIC_POSES} are required)"
            remedy = "record 12 or more, with different orientations"
            raise DrakeTeleopError(what, where=f"{self.source}:static", remedy=remedy)
        rest, steps = np.zeros((n, 3)), []
        for name, quantity in (("force", stream.force), ("torque", stream.torque)):
            values = table.finite_numbers(quantity.columns, 3, f"static.{name}", table.rows)
            unit = self.description.unit_in_si(quantity.unit) * np.abs(quantity.scale).max()
            steps.append(decimal_resolution(values) * unit)
        return Log(
            *(np.arange(float(n)), wrench, -gravity, rest, rest, gravity, True),
            notes=tuple(self.notes),
            source=self.source,
            gain_std=stream.gain_std,
            described=self.description,
            resolution=(steps[0], steps[1]),
        )

    def _read_clock_and_gaps(self, name: str, stream: Wrench | Imu | Pose, table: Table) -> Clock:
        clock = clocks.read_clock(stream.time, table, stream.columns, f"{self.source}:{name}.time")
        t = clock.t
        if len(t) < MIN_STREAM_SAMPLES or len(alignment.uniform_times(t)) < MIN_STREAM_SAMPLES:
            what = f"{len(t)} samples in {table.path.name} are too few"
            remedy = f"record at least {MIN_STREAM_SAMPLES}, evenly spaced"
            raise DrakeTeleopError(what, where=f"{self.source}:{name}", remedy=remedy)
        self.notes += [f"{name}: {note}" for note in clock.notes]
        if stream.topic and stream.time.column == "stamp" and "header.stamp" not in table.columns:
            self.notes.append(
                f"{name}: {stream.topic} has no header.stamp; the times of reception are used"
            )
        step, found_gaps = np.median(np.diff(t)), clocks.find_gaps_in_times(t, self.bandwidth_hz)
        lengths = found_gaps[:, 1] - found_gaps[:, 0]
        lengths = clocks.set_episode_steps_to_zero(lengths, step, clock.num_episodes)
        if clock.num_episodes > 1:
            starts = f"the clock starts {clock.num_episodes} times"
            if len({stream.source for stream in self.description.streams.values()}) > 1:
                what = f"{starts}, which requires all streams in one file"
                remedy = "write all streams into one table, or each episode into files of its own"
                raise DrakeTeleopError(what, where=f"{self.source}:{name}.time", remedy=remedy)
            if name == "wrench":
                self.notes.append(
                    f"{starts}: episodes are joined 1 s or more apart; samples near"
                    " their ends are not used"
                )
        if lengths.any():
            start = found_gaps[int(np.argmax(lengths)), 0]
            self.notes.append(
                f"{name}: {np.count_nonzero(lengths)} gaps, the longest of {lengths.max():.3g} s at"
                f" {start - t[0]:.3g} s; samples in and near them are not used"
            )
        if len(found_gaps):
            half = self._half_smoother_window_s(float(step))
            self.gaps.append(found_gaps + np.array([-half, half]))
        return clock

    def _half_smoother_window_s(self, dt: float) -> float:
        window = SMOOTHER_WINDOW_OVER_PERIOD / self.bandwidth_hz if self.bandwidth_hz else 0.0
        return max(4 * dt, 0.5 * window)

    def _make_log(self, t: Array, wrench: Array, imu: Stream | None, pose: Stream | None) -> Log:
        def signal_on_clock(field: str) -> Array:
            for stream in (imu, pose):
                if stream is not None and (values := getattr(stream, field)) is not None:
                    return streams.resample_to_clock(t, stream, values)
            return np.broadcast_to(0.0, (len(t), 3))  # not differentiated

        gravity = R_WS = posed = None
        described, wrench_stream = self.description, self.description.wrench
        assert wrench_stream is not None
        in_base = wrench_stream.frame == "base"
        if pose is not None and pose.R_WS is not None:
            R_WS = nearest_rotation(streams.resample_to_clock(t, pose, pose.R_WS))
            gravity = np.swapaxes(R_WS, 1, 2) @ described.gravity_W
            if in_base:
                wrench = streams.rotate_wrench_world_to_S(np.swapaxes(R_WS, 1, 2), wrench)
        if in_base and pose is None:
            raise self._no_R_WS_error("wrench")
        accelerometer = imu is not None and imu.specific_force is not None
        if not accelerometer and described.pose and described.pose.position is None:
            self.notes.append(
                "neither accelerometer nor position: the acceleration of S is taken as zero"
            )
        if described.pose and pose is not None and pose.recorded_poses is not None:
            inertial = None if imu is None else imu.imu_data
            R_SP = np.eye(3) if described.pose.R_SP is None else described.pose.R_SP
            p_SoPo_S = np.array(described.pose.position_in_sensor)
            posed = PosesOfLog(pose.recorded_poses, described.gravity_W, p_SoPo_S, R_SP, inertial)
        names = ("specific_force", "angular_velocity", "angular_acceleration")
        s, omega, alpha = map(signal_on_clock, names)
        return Log(
            *(t, wrench, s, omega, alpha),
            gravity=gravity,
            R_WS=R_WS,
            gravity_W=None if R_WS is None else described.gravity_W,
            bridged=self._flag_samples_in_gaps(t),
            notes=tuple(self.notes),
            source=self.source,
            posed=posed,
            gain_std=wrench_stream.gain_std,
            one_sided_s=self.one_sided_s,
            described=described,
        )

    def _flag_samples_in_gaps(self, t: Array) -> NDArray[np.bool_] | None:
        if not self.gaps:
            return None
        flags = np.zeros(len(t), bool)
        for start, stop in np.concatenate(self.gaps):
            flags[slice(*np.searchsorted(t, [start, stop]))] = True
        if (~flags).sum() < MIN_STREAM_SAMPLES:
            what = f"{(~flags).sum()} samples are outside of gaps ({MIN_STREAM_SAMPLES} required)"
            raise DrakeTeleopError(what, where=self.source, remedy="record without interruptions")
        return flags
