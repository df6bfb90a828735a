"""Log descriptions: YAML files of files, columns, units and frames (docs/log-description.md).

A number x of a file becomes a quantity in S by

    x_S = sign * R_S,stream * scale * (x - bias) * unit
"""

from __future__ import annotations

import difflib
import os
import types
import typing
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field, ValidationError, model_validator

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.common.rotations import EULER_AXIS_SEQUENCES
from drake_teleop.common.texts import read_yaml
from drake_teleop.logs.read import description_fields as fields
from drake_teleop.logs.read.description_fields import STANDARD_GRAVITY, Column, Number, StrictModel

_MAX_GRAVITY_M_S2 = 100.0


class Time(StrictModel):
    """Time of the rows of a stream: a column of stamps or a nominal rate."""

    column: Column | None = None
    unit: Literal["s", "ms", "us", "ns"] = "s"
    nanoseconds: Column | None = Field(
        default=None, description="column of nanoseconds, added to the seconds of `column`"
    )
    rate: Number | None = Field(
        default=None, ge=1e-3, le=1e6, description="constant rate in Hz, if there is no column"
    )
    offset: Number = Field(default=0.0, description="seconds that are added to the stream's clock")
    scale: Number = Field(
        default=1.0,
        ge=1e-3,
        le=1e3,
        description="factor on the time since the first row, for a clock that drifts",
    )

    @model_validator(mode="after")
    def _check_column_or_rate(self) -> Time:
        if (self.column is None) == (self.rate is None):
            raise ValueError("time needs either column or rate: give exactly one of them")
        if self.nanoseconds is not None and (self.column is None or self.unit != "s"):
            raise ValueError("nanoseconds require a column of seconds: give column, with unit s")
        return self


class Orientation(StrictModel):
    """Columns and form of an orientation: R_WS of S, or R_WP of a posed frame P."""

    columns: tuple[Column, ...]
    form: Literal["matrix", "quaternion_wxyz", "quaternion_xyzw", "rotation_vector", "euler"]
    unit: Literal["rad", "deg"] = Field(default="rad", description="unit of the angles")
    axes: str | None = Field(
        default=None,
        description="axes of the Euler angles, in the order of the columns: small letters for"
        " fixed axes, such as xyz (roll, pitch, yaw), capitals for moving ones, such as ZYX",
    )
    inverse: bool = Field(default=False, description="true if the columns are the inverse, R_SW")

    @model_validator(mode="after")
    def _check_euler_axes(self) -> Orientation:
        if (self.axes is not None) != (self.form == "euler"):
            raise ValueError(
                "form: euler needs axes, such as xyz (fixed) or ZYX (moving); other forms have none"
            )
        if self.axes is not None and self.axes not in EULER_AXIS_SEQUENCES:
            raise ValueError(
                f"axes {self.axes!r} are not known: give three letters, xyz for fixed and XYZ for"
                " moving axes, none twice consecutively"
            )
        return self


def _columns_of_axes(group: str, axes: str = "xyz") -> list[str]:
    return [f"{group}.{axis}" for axis in axes]


_DEFAULTS_OF_TOPIC_QUANTITY: dict[str, dict[str, Any]] = {
    "force": {"columns": _columns_of_axes("force")},
    "torque": {"columns": _columns_of_axes("torque")},
    "specific_force": {"columns": _columns_of_axes("linear_acceleration")},
    "angular_velocity": {"columns": _columns_of_axes("angular_velocity")},
    "orientation": {"columns": _columns_of_axes("orientation", "wxyz"), "form": "quaternion_wxyz"},
    "position": {"columns": _columns_of_axes("position")},
}


class _StreamDescription(StrictModel):
    file: Path
    header: bool = True

    @property
    def source(self) -> Path:
        """Path that identifies the table: the file, in a bag with topic and child frame."""
        return self.file

    @property
    def columns(self) -> tuple[Column, ...]:
        """Columns of all quantities of the stream, except the time."""
        quantities = (getattr(self, field) for field in type(self).model_fields)
        return tuple(c for quantity in quantities for c in getattr(quantity, "columns", ()))


class _RecordedStreamDescription(_StreamDescription):
    topic: str | None = Field(default=None, description="topic of a ROS bag or MCAP file")
    child_frame: str | None = Field(
        default=None, description="child frame of the transform in the topic"
    )
    time: Time

    _quantities_of_topic: ClassVar[tuple[str, ...]] = ()

    @model_validator(mode="before")
    @classmethod
    def _fill_topic_defaults(cls, data: Any) -> Any:
        if not isinstance(data, dict) or data.get("topic") is None:
            if isinstance(data, dict) and data.get("child_frame") is not None:
                raise ValueError("child_frame requires a topic: add topic, or remove child_frame")
            return data
        data = {"time": {}, **{name: {} for name in cls._quantities_of_topic}, **data}
        time = data["time"]
        if isinstance(time, dict) and not {"column", "rate"} & set(time):
            data["time"] = {"column": "stamp", **time}
        for name in cls._quantities_of_topic:
            given = data[name]
            if isinstance(given, dict) and not {"columns", "form"} & set(given):
                data[name] = {**_DEFAULTS_OF_TOPIC_QUANTITY[name], **given}
        return data

    @property
    def source(self) -> Path:
        if self.topic is None:
            return self.file
        return self.file.joinpath(*f"{self.topic}/{self.child_frame or ''}".split("/"))


class Wrench(_RecordedStreamDescription):
    """File and columns of the force-torque sensor."""

    _quantities_of_topic = ("force", "torque")

    force: fields.Force
    torque: fields.Torque
    sign: Literal[1, -1] = 1
    frame: fields.Frame = "sensor"
    weight: fields.Weight = None
    gain_std: fields.GainStd = 0.0


class Imu(_RecordedStreamDescription):
    """File and columns of an IMU."""

    _quantities_of_topic = ("specific_force", "angular_velocity")

    specific_force: fields.Acceleration | None = None
    angular_velocity: fields.AngularVelocity | None = None
    angular_acceleration: fields.AngularAcceleration | None = None
    sign: Literal[1, -1] = Field(
        default=1, description="sign of the specific force; -1 if the file has g - a"
    )
    frame: fields.ImuFrame = Field(default="sensor", description="IMU axes in S; auto: estimated")
    position: fields.PositionOrAuto = Field(
        default=(0.0, 0.0, 0.0), description="accelerometer from So, in S, m; auto: estimated"
    )

    @model_validator(mode="after")
    def _check_imu_signals(self) -> Imu:
        if not (self.specific_force or self.angular_velocity):
            raise ValueError("an IMU has no signal: give specific_force, angular_velocity, or both")
        uses_force = self.is_mounting_auto or self.sign != 1 or any(self.position)
        if uses_force and not self.specific_force:
            raise ValueError("sign, position, auto require specific_force: add it, or remove them")
        return self

    @property
    def is_mounting_auto(self) -> bool:
        return self.frame == "auto" or self.position == "auto"


class Pose(_RecordedStreamDescription):
    """File and columns of a pose of sensor, flange or TCP."""

    _quantities_of_topic = ("orientation", "position")

    orientation: Orientation
    position: fields.Position | None = None
    frame: fields.Frame = "sensor"
    position_in_sensor: fields.PositionOrAuto = Field(
        default=(0.0, 0.0, 0.0),
        description="origin of the posed frame in S, p_SoPo_S, m; auto: estimated",
    )
    rotation_in_sensor: fields.RotationOrAuto = Field(
        default=None,
        description="rotation R_SP from the posed frame to S, instead of frame; auto: estimated",
    )

    @model_validator(mode="after")
    def _check_pose_frame(self) -> Pose:
        if self.frame == "base":
            raise ValueError("pose.frame must be the word sensor, or a rotation matrix from P to S")
        if self.frame != "sensor" and self.rotation_in_sensor is not None:
            raise ValueError("frame and rotation_in_sensor both give R_SP: give one of them")
        shifted = self.position_in_sensor == "auto" or any(self.position_in_sensor)
        if self.position is None and (shifted or self.rotation_in_sensor == "auto"):
            raise ValueError(
                "position_in_sensor and auto require pose.position: add it, or remove these fields"
            )
        return self

    @property
    def is_frame_auto(self) -> bool:
        return self.position_in_sensor == "auto" or self.rotation_in_sensor == "auto"

    @property
    def R_SP(self) -> Array | None:
        """Rotation (3, 3) from the axes of the posed frame P to those of S; None: identity."""
        for rotation in (self.rotation_in_sensor, self.frame):
            if isinstance(rotation, tuple):
                return np.array(rotation)
        return None


class Static(_StreamDescription):
    """Wrenches averaged over separate poses at rest, one pose per row."""

    force: fields.Force
    torque: fields.Torque
    sign: Literal[1, -1] = 1
    frame: fields.Frame = "sensor"
    weight: fields.Weight = None
    gravity: fields.Acceleration | None = Field(default=None, description="gravity in S")
    specific_force: fields.Acceleration | None = Field(
        default=None, description="what an accelerometer reads at rest, -g_S, in S"
    )
    orientation: Orientation | None = None
    gain_std: fields.GainStd = 0.0

    @model_validator(mode="after")
    def _check_orientation_source(self) -> Static:
        if sum(x is not None for x in (self.gravity, self.specific_force, self.orientation)) != 1:
            raise ValueError("static needs exactly one of gravity, specific_force and orientation")
        if self.weight == "removed":
            raise ValueError(
                "weight: removed cannot be used with static poses: record the load in motion,"
                " or give [m, m c_x, m c_y, m c_z] of the payload in the robot's controller"
            )
        return self


class Description(StrictModel):
    """Description of a log: a wrench with imu, pose or both; or static poses."""

    gravity: fields.Gravity = (0.0, 0.0, -STANDARD_GRAVITY)
    wrench: Wrench | None = None
    imu: Imu | None = None
    pose: Pose | None = None
    static: Static | None = None

    @model_validator(mode="after")
    def _check_stream_combination(self) -> Description:
        if not 0.0 < (largest := np.abs(self.gravity_W).max()) <= _MAX_GRAVITY_M_S2:
            rule = f"more than 0, at most {_MAX_GRAVITY_M_S2:g}"
            raise ValueError(f"the largest component of gravity is {largest:g} m/s^2 ({rule})")
        if self.gravity == "auto" and (self.pose is None or self.imu is not None):
            raise ValueError("gravity: auto requires a wrench and a pose alone: give the vector")
        if self.static is not None:
            if self.wrench or self.imu or self.pose:
                raise ValueError("static poses cannot be combined with wrench, imu or pose")
            return self
        if self.wrench is None:
            raise ValueError("no wrench: add wrench, or describe poses at rest as static")
        if self.pose is None:
            if self.imu is None:
                raise ValueError("a wrench without kinematics: add imu or pose (in any file)")
            if self.imu.angular_velocity is None:
                raise ValueError(
                    "the angular velocity is missing: add imu.angular_velocity or pose"
                )
            if self.imu.specific_force is None:
                raise ValueError("the specific force is missing: add imu.specific_force or pose")
            if self.imu.frame == "auto":
                raise ValueError("imu.frame: auto compares the IMU with a pose: add pose")
            if self.wrench.weight is not None:
                raise ValueError("wrench.weight requires an orientation: add pose")
        elif self.pose.is_frame_auto and self.wrench.frame == "base":
            raise ValueError("pose: auto requires a wrench in the axes of the sensor, not in base")
        pose = self.pose is not None and self.pose.is_frame_auto
        kinds = {"pose: auto": pose, "gravity: auto": self.gravity == "auto"}
        kinds["wrench.weight"] = self.wrench.weight is not None
        both = [name for name, present in kinds.items() if present]
        if len(both) > 1:
            raise ValueError(f"{' and '.join(both)} cannot be combined: give one of them alone")
        return self

    @property
    def streams(self) -> dict[str, Any]:
        names = ("wrench", "imu", "pose", "static")
        return {name: x for name in names if (x := getattr(self, name)) is not None}

    @property
    def gravity_W(self) -> Array:
        """Gravity (3,) in W [m/s^2]; along -z if the description asks for "auto"."""
        return np.array([0.0, 0.0, -STANDARD_GRAVITY] if self.gravity == "auto" else self.gravity)

    def unit_in_si(self, unit: str) -> float:
        """Return the SI value of a unit; "g" is the magnitude of the described gravity."""
        g = float(np.linalg.norm(self.gravity_W))
        return (fields.SI_VALUE_OF_UNIT | {"g": g, "mg": 1e-3 * g})[unit]


def load_description(path: str | Path) -> Description:
    """Return the log description of a YAML file, with paths joined to its folder."""
    path = Path(path)
    if not os.path.exists(path):
        raise DrakeTeleopError("no such log description", where=str(path), remedy="check the path")
    data = read_yaml(path)
    if not isinstance(data, dict):
        remedy = "see docs/log-description.md"
        raise DrakeTeleopError("YAML file contains no fields", where=str(path), remedy=remedy)
    try:
        description = Description.model_validate(data)
    except ValidationError as error:
        raise validation_error(error, path) from error
    streams = {
        name: stream.model_copy(update={"file": path.parent / stream.file})
        for name, stream in description.streams.items()
    }
    return description.model_copy(update=streams)


def validation_error(error: ValidationError, path: Path | str) -> DrakeTeleopError:
    # A misspelt field also causes "missing"; report the misspelling first.
    first = min(error.errors(), key=lambda entry: entry["type"] == "missing")
    *outer, last = first["loc"] or ("",)
    unknown = first["type"] == "extra_forbidden"
    location = [part for part in outer if _is_field_or_index(part)]
    location += [last] if unknown or _is_field_or_index(last) else []
    where = f"{path}:{'.'.join(map(str, location))}" if location else str(path)
    remedy = "docs/log-description.md lists fields and units"
    if unknown:
        known = list(_allowed_fields_at(location[:-1]))
        near = difflib.get_close_matches(str(location[-1]), known, n=1)
        what = f"unknown field {location[-1]!r}"
        remedy = f"did you mean {near[0]!r}" if near else f"the fields are {', '.join(known)}"
    elif first["type"] == "missing":
        what, remedy = "is missing", f"add {location[-1]}"
    elif first["type"] == "value_error":
        what = str(first["ctx"]["error"])
    else:
        what = f"{first['msg']}, found {first['input']!r}"
    return DrakeTeleopError(what, where=where, remedy=remedy)


def _is_field_or_index(part: str | int) -> bool:
    # Pydantic adds the tried branch of a union to the location, such as "tuple[...]".
    return isinstance(part, int) or part.isidentifier()


def _allowed_fields_at(location: Sequence[str | int]) -> Iterator[str]:
    model: Any = Description
    for part in location:
        annotation = model.model_fields[part].annotation
        options = typing.get_args(annotation) or (annotation,)
        model = next(option for option in options if option is not types.NoneType)
    yield from model.model_fields
