"""Findings about a log, and edits of its description, each for one suspected error."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import permutations
from typing import Any

import numpy as np

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.logs.read.canonical import Log
from drake_teleop.logs.read.description import Description
from drake_teleop.logs.read.rotations import EULER_AXES, right_angled_rotations

EFFECTS = ("lag", "units", "payload")
"""Findings that may be the effect of a cause, such as drift."""
MOTION_ERRORS = (
    *("clock", "reversed gravity", "inverted orientation", "quaternion order", "degrees"),
    "base axes",
)
"""Errors of the described motion, which resemble causes."""
MIN_CLOCK_ERROR_S = 0.05
"""Delay above which a clock error, not the lag of a filter, is the reason [s]."""


@dataclass(frozen=True)
class Finding:
    """Suspicious property of a log.

    Args:
        name: category for programs: "sign", "units" ...
        message: observation and remedy.
        fields: fields of the description and their corrected values, as in YAML.
    """

    name: str
    message: str
    fields: dict[str, Any] = field(default_factory=dict)


def _gravity_field(description: Description) -> str | None:
    if description.imu is not None and description.imu.specific_force is not None:
        return "imu.specific_force"
    for name in ("gravity", "specific_force"):
        if getattr(description.static, name, None) is not None:
            return f"static.{name}"
    return None


def correct_gravity_unit(description: Description, log: Log) -> tuple[list[Finding], Description]:
    """Return a finding for an accelerometer in a wrong unit, and the corrected description."""
    path = _gravity_field(description)
    unit = None if path is None else _right_unit(description, log, path)
    if path is None or unit is None:
        return [], description
    finding = Finding(
        "units",
        f"the accelerometer reads {_over_gravity(description, log):.3g} times gravity: it is not in"
        f" {_field(description, path).unit}; set {path}.unit: {unit}",
        {f"{path}.unit": unit},
    )
    return [finding], edit_field(description, f"{path}.unit", unit)


def _over_gravity(description: Description, log: Log) -> float:
    median = float(np.median(np.linalg.norm(log.specific_force, axis=1)))
    return median / float(np.linalg.norm(description.gravity_W))


def _right_unit(description: Description, log: Log, field: str) -> str | None:
    given = _field(description, field).unit
    number = _over_gravity(description, log) / description.scale(given)
    for unit in ("m/s^2", "g", "mm/s^2"):
        if unit != given and 0.7 < number * description.scale(unit) < 1.43:
            return unit
    return None


def _field(description: Description, path: str) -> Any:
    value: Any = description
    for name in path.split("."):
        value = getattr(value, name)
    return value


def edit_field(description: Description, path: str, value: Any) -> Description:
    """Return the description with one field changed; `path` is such as "imu.time.offset"."""
    first, *rest = path.split(".", 1)
    if rest:
        model: Any = getattr(description, first)
        value = edit_field(model, rest[0], value)
    return description.model_copy(update={first: value})


Edit = tuple[Finding, Description]
"""Finding, and the corrected description."""


def _edit(description: Description, name: str, text: str, path: str, value: Any) -> Edit:
    shown = str(value).lower() if isinstance(value, bool) else value
    finding = Finding(name, f"{text}; set {path}: {shown}", {path: value})
    return finding, edit_field(description, path, value)


def pose_edits(description: Description) -> Iterator[Edit]:
    """Yield edits of the form of the orientation and of the sign of gravity."""
    pose, imu = description.pose, description.imu
    sensed = imu is not None and imu.specific_force is not None
    if imu is not None and sensed:
        yield (
            Finding(
                "reversed gravity",
                "the accelerometer reads g - a: gravity is reversed;"
                f" set imu.sign: {-imu.sign} (or turn the vector `gravity` if z points down)",
                {"imu.sign": -imu.sign},
            ),
            edit_field(description, "imu.sign", -imu.sign),
        )
    where = "static.orientation" if description.static else "pose.orientation"
    orientation = pose.orientation if pose else getattr(description.static, "orientation", None)
    if orientation is None:
        return
    if not sensed:
        turned = tuple(0.0 - x for x in description.gravity_W.tolist())
        yield (
            Finding(
                "reversed gravity",
                f"gravity is reversed; set gravity: {list(turned)}, a vector in the world",
                {"gravity": list(turned)},
            ),
            edit_field(description, "gravity", turned),
        )
    text = "the orientation is that of the world in S, R_SW, not R_WS"
    path = f"{where}.inverse"
    yield _edit(description, "inverted orientation", text, path, not orientation.inverse)
    forms = {"quaternion_wxyz": "quaternion_xyzw", "quaternion_xyzw": "quaternion_wxyz"}
    if orientation.form in forms:
        text = f"the quaternions are not {orientation.form}"
        other = forms[orientation.form]
        yield _edit(description, "quaternion order", text, f"{where}.form", other)
    if orientation.form == "euler":
        for axes in EULER_AXES:
            if axes != orientation.axes:
                text = f"the Euler angles do not turn about {orientation.axes}"
                yield _edit(description, "Euler axes", text, f"{where}.axes", axes)
    if orientation.form in ("rotation_vector", "euler"):
        text = f"the angles are not in {orientation.unit}"
        unit = "deg" if orientation.unit == "rad" else "rad"
        yield _edit(description, "degrees", text, f"{where}.unit", unit)


def try_edit(function: Callable[[Description], Any], edited: Description) -> Any:
    """Return `function(edited)`, or None if the edited description cannot be read."""
    try:
        return function(edited)
    except DrakeTeleopError:
        return None


def load_edits(description: Description) -> Iterator[Edit]:
    """Yield edits of signs, axes and units of wrench and motion, including `pose_edits`."""
    stream = "static" if description.static else "wrench"
    sensor: Any = getattr(description, stream)
    text = "the sign of the wrench is inverted"
    yield _edit(description, "sign", text, f"{stream}.sign", -sensor.sign)
    yield from pose_edits(description)
    if sensor.frame == "sensor":
        text = "the wrench is in the axes of the base"
        yield _edit(description, "base axes", text, f"{stream}.frame", "base")
    elif sensor.frame == "base":
        text = "the wrench is not in base axes"
        yield _edit(description, "base axes", text, f"{stream}.frame", "sensor")
    imu, pose = description.imu, description.pose
    if pose is not None and pose.position and (imu is None or imu.specific_force is None):
        text = f"the position is not in {pose.position.unit}"
        unit = "mm" if pose.position.unit == "m" else "m"
        yield _edit(description, "units", text, "pose.position.unit", unit)
    if imu is not None and imu.angular_velocity and imu.angular_velocity.unit == "rad/s":
        text = "the gyroscope is in degrees"
        yield _edit(description, "degrees", text, "imu.angular_velocity.unit", "deg/s")
    yield from _axis_edits(description, stream, sensor)


def _axis_edits(description: Description, stream: str, sensor: Any) -> Iterator[Edit]:
    if len(sensor.force.columns) == 3 and len(sensor.torque.columns) == 3:
        for order in list(permutations(range(3)))[1:]:
            force, torque = (
                tuple(x.columns[i] for i in order) for x in (sensor.force, sensor.torque)
            )
            edited = edit_field(description, f"{stream}.force.columns", force)
            yield (
                Finding(
                    "swapped axes",
                    f"axes of the wrench are exchanged; set {stream}.force.columns: {list(force)}"
                    f" and {stream}.torque.columns: {list(torque)}",
                    {
                        f"{stream}.force.columns": list(force),
                        f"{stream}.torque.columns": list(torque),
                    },
                ),
                edit_field(edited, f"{stream}.torque.columns", torque),
            )
    old = np.array(sensor.frame) if isinstance(sensor.frame, tuple) else np.eye(3)
    for R in right_angled_rotations()[1:] if sensor.frame != "base" else ():
        frame = (R @ old).tolist()
        yield (
            Finding(
                "swapped axes",
                f"the wrench is in other axes; set {stream}.frame: {frame}",
                {f"{stream}.frame": frame},
            ),
            edit_field(description, f"{stream}.frame", tuple(map(tuple, frame))),
        )
