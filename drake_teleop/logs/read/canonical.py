"""Canonical log: wrench and motion of the sensor frame S at common instants, with fixed columns."""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.files import write_table
from drake_teleop.common.numeric import Array
from drake_teleop.common.rotations import rotation_matrices
from drake_teleop.logs.pose_motion.poses import PosesOfLog
from drake_teleop.logs.read.clocks import MIN_RATE_HZ
from drake_teleop.logs.read.description import Description
from drake_teleop.logs.read.tables import Table

WRENCH_COLUMNS = ("f_x", "f_y", "f_z", "tau_x", "tau_y", "tau_z")
SPECIFIC_FORCE_COLUMNS = ("s_x", "s_y", "s_z")
ANGULAR_VELOCITY_COLUMNS = ("omega_x", "omega_y", "omega_z")
ANGULAR_ACCELERATION_COLUMNS = ("alpha_x", "alpha_y", "alpha_z")
QUATERNION_COLUMNS = ("q_w", "q_x", "q_y", "q_z")
POSITION_COLUMNS = ("p_x", "p_y", "p_z")
_COLUMNS_OF_KINEMATIC_FIELD = {
    "specific_force": SPECIFIC_FORCE_COLUMNS,
    "angular_velocity": ANGULAR_VELOCITY_COLUMNS,
    "angular_acceleration": ANGULAR_ACCELERATION_COLUMNS,
    "orientation": QUATERNION_COLUMNS,
    "position": POSITION_COLUMNS,
}
_MAX_ANGULAR_REST_SPEED_RAD_S = 0.05
_MIN_ROTATION_BETWEEN_POSES_RAD = np.radians(10.0)
_VECTOR_FIELDS = ("specific_force", "angular_velocity", "angular_acceleration", "gravity")
_ROW_SHAPE_OF_FIELD: dict[str, tuple[int, ...]] = {"t": (), "wrench": (6,)}
_ROW_SHAPE_OF_FIELD |= dict.fromkeys(_VECTOR_FIELDS, (3,)) | {"bridged": (), "R_WS": (3, 3)}


@dataclass(frozen=True, repr=False)
class Log:
    """Wrench and motion of the sensor frame S: N samples on one clock, SI units.

    Attributes:
        t: (N,) uniform time [s]; row numbers for static poses.
        wrench: (N, 6) [f; tau] that the sensor exerts on the load, about So [N, N m].
        specific_force: (N, 3) s = a - g of So, in S [m/s^2].
        angular_velocity: (N, 3) omega_WS_S [rad/s].
        angular_acceleration: (N, 3) alpha_WS_S [rad/s^2].
        gravity: (N, 3) gravity in S [m/s^2].
        static: True if the samples are separate poses at rest.
        bridged: (N,) True for samples interpolated over gaps.
        notes: assumptions made during reading.
        posed: recorded poses, if they have positions.
        gain_std: standard deviation of the sensor gains (relative).
        R_WS: (N, 3, 3) orientation of S in the world W.
        gravity_W: (3,) gravity in W [m/s^2].
        one_sided_s: time at start and end with one-sided derivatives [s].
        described: the description, with estimates for `auto`.
        estimated: "gravity", "weight", if they are estimated from the data.
        resolution: quantization step of force and torque, for static poses [N, N m].
        has_calendar_time: True for time stamps counted from 1970, whose unit is certain.
    """

    t: Array
    wrench: Array
    specific_force: Array
    angular_velocity: Array
    angular_acceleration: Array
    gravity: Array | None = None
    static: bool = False
    bridged: NDArray[np.bool_] | None = None
    notes: tuple[str, ...] = ()
    source: str = "log"
    posed: PosesOfLog | None = None
    gain_std: float = 0.0
    R_WS: Array | None = None
    gravity_W: Array | None = None
    one_sided_s: float = 0.0
    described: Description | None = None
    estimated: tuple[str, ...] = ()
    resolution: tuple[float, float] = (0.0, 0.0)
    has_calendar_time: bool = False

    def __post_init__(self) -> None:
        for name, row_shape in _ROW_SHAPE_OF_FIELD.items():
            value, shape = getattr(self, name), (len(self.t), *row_shape)
            if value is None:
                continue
            where = f"{self.source}:{name}"
            if np.shape(value) != shape:
                what = f"has shape {np.shape(value)} instead of {shape}"
                raise DrakeTeleopError(what, where=where, remedy="give one row per time")
            if not np.isfinite(value).all():
                what = f"holds NaN or infinity at index {np.argwhere(~np.isfinite(value))[0, 0]}"
                raise DrakeTeleopError(what, where=where, remedy="cut or repair these samples")
        if (wrong := np.diff(self.t) <= 0).any():
            what = f"does not increase at index {wrong.argmax() + 1}"
            remedy = "sort the rows, and remove repeated times"
            raise DrakeTeleopError(what, where=f"{self.source}:t", remedy=remedy)

    def __len__(self) -> int:
        return len(self.t)

    def __repr__(self) -> str:
        kind = "poses at rest" if self.static else f"samples, {self.t[0]:g} to {self.t[-1]:g} s"
        largest = np.linalg.norm(self.wrench[:, :3], axis=1).max()
        lines = [f"Log {self.source}: {len(self)} {kind}, force up to {largest:.3g} N"]
        return "\n  ".join([*lines, *self.notes])

    @cached_property
    def dt(self) -> float:
        """Mean sample spacing [s], without steps across removed gaps."""
        steps = np.diff(self.t)
        return float(steps[steps < 1.5 * np.median(steps)].mean())

    def with_times_relative_to(self, start: float) -> Log:
        posed = None if self.posed is None else self.posed.with_times_relative_to(start)
        return replace(self, t=self.t - start, posed=posed)

    def select_rows(self, rows: slice | NDArray[np.bool_]) -> Log:
        if not isinstance(rows, slice) and rows.all():
            return self
        arrays = {name: getattr(self, name) for name in _ROW_SHAPE_OF_FIELD}
        selected: dict[str, Any] = {k: None if x is None else x[rows] for k, x in arrays.items()}
        return replace(self, **selected)

    def with_motion(self, s: Array, omega: Array, alpha: Array, **changes: Any) -> Log:
        changes |= {"specific_force": s, "angular_velocity": omega, "angular_acceleration": alpha}
        return replace(self, **changes)

    @property
    def is_acceleration_unknown(self) -> bool:
        """Whether the log has neither accelerometer nor position, so that `a` is taken as zero."""
        if self.described is None or self.described.pose is None or self.static:
            return False
        imu = self.described.imu
        accelerometer = imu is not None and imu.specific_force is not None
        return self.described.pose.position is None and not accelerometer

    @property
    def motion(self) -> tuple[Array, Array, Array]:
        """Specific force, angular velocity and angular acceleration (N, 3)."""
        return self.specific_force, self.angular_velocity, self.angular_acceleration


def write_log(log: Log, path: str | Path) -> None:
    import polars as pl

    path = Path(path)
    names = [*WRENCH_COLUMNS, *SPECIFIC_FORCE_COLUMNS]
    names += [*ANGULAR_VELOCITY_COLUMNS, *ANGULAR_ACCELERATION_COLUMNS]
    values = np.hstack([log.wrench, *log.motion])
    time = {} if log.static else {"t": log.t}
    frame = pl.DataFrame(time | dict(zip(names, values.T, strict=True)))
    if path.suffix not in (".csv", ".parquet"):
        what = f"logs cannot be written in the format {path.suffix!r}"
        raise DrakeTeleopError(what, where=str(path), remedy="name it .csv or .parquet")
    write_table(path, frame)


def describe_canonical(path: Path, table: Table) -> Description:
    """Return the description of a canonical table (columns `t`, `f_x` ...).

    Rows with orientation or specific force are static poses without `t`, or below 5 Hz if a fifth
    of the steps tilt by over 10 deg. A given angular speed must have a median below 0.05 rad/s.
    """
    if not {"t", *WRENCH_COLUMNS} & set(table.columns):
        what = "is not a canonical log: it has none of the columns t, f_x ... tau_z"
        remedy = "describe it in a YAML file; `drake-teleop inspect` drafts one"
        raise DrakeTeleopError(what, where=str(path), remedy=remedy)
    table.finite_numbers(WRENCH_COLUMNS, 6, str(path))
    fields: dict[str, dict[str, Any]] = {}
    for name, names in _COLUMNS_OF_KINEMATIC_FIELD.items():
        present = [column for column in names if column in table.columns]
        if present and len(present) < len(names):
            table.finite_numbers(names, len(names), str(path))
        if present:
            fields[name] = {"columns": names}
    if "orientation" in fields:
        fields["orientation"]["form"] = "quaternion_wxyz"
    force, torque = {"columns": WRENCH_COLUMNS[:3]}, {"columns": WRENCH_COLUMNS[3:]}
    wrench = {"file": path, "force": force, "torque": torque}
    if _are_rows_poses_at_rest(table, fields):
        kinematics = "orientation" if "orientation" in fields else "specific_force"
        return Description.model_validate({"static": wrench | {kinematics: fields[kinematics]}})
    if "orientation" not in fields and not {"specific_force", "angular_velocity"} <= fields.keys():
        missing = ANGULAR_VELOCITY_COLUMNS if "specific_force" in fields else SPECIFIC_FORCE_COLUMNS
        what = f"a wrench without kinematics: no columns {' '.join(missing)}"
        remedy = "add them, or the pose q_w q_x q_y q_z (and p_x p_y p_z)"
        raise DrakeTeleopError(what, where=str(path), remedy=remedy)
    table.numbers_with_nan("t", str(path))
    stream = {"file": path, "time": {"column": "t"}}
    streams: dict[str, Any] = {"wrench": wrench | stream}
    pose = {name: fields.pop(name) for name in ("orientation", "position") if name in fields}
    if {"specific_force", "angular_velocity"} & fields.keys():
        streams["imu"] = stream | fields
    if "orientation" in pose:
        streams["pose"] = stream | pose
    return Description.model_validate(streams)


def _are_rows_poses_at_rest(table: Table, fields: Container[str]) -> bool:
    where, oriented = str(table.path), "orientation" in fields
    if not oriented and "specific_force" not in fields:
        return False
    if "angular_velocity" in fields:
        speed = table.finite_numbers(ANGULAR_VELOCITY_COLUMNS, 3, where)
        if len(speed) and np.median(np.linalg.norm(speed, axis=1)) > _MAX_ANGULAR_REST_SPEED_RAD_S:
            return False
    if "t" not in table.columns:
        return True
    t = table.single_column("t", where)
    if not np.isfinite(t).all():
        return False  # the reader raises an error that names the row
    steps = np.diff(t)
    if not len(steps) or not np.median(steps) > 1 / MIN_RATE_HZ:
        return False
    if oriented:
        quaternions = table.finite_numbers(QUATERNION_COLUMNS, 4, where)
        vertical = rotation_matrices(quaternions, "quaternion_wxyz")[:, 2]
    else:
        vertical = table.finite_numbers(SPECIFIC_FORCE_COLUMNS, 3, where)
    vertical = vertical / (np.linalg.norm(vertical, axis=1, keepdims=True) + 1e-300)
    turned = np.arccos(np.clip((vertical[1:] * vertical[:-1]).sum(axis=1), -1.0, 1.0))
    return bool(np.quantile(turned, 0.8) > _MIN_ROTATION_BETWEEN_POSES_RAD)
