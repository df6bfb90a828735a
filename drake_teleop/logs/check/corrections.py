"""Edits of a log description, each for one suspected error."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import permutations
from typing import Any

import numpy as np

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.rotations import EULER_AXES, right_angled_rotations
from drake_teleop.logs.causes.cause import Finding
from drake_teleop.logs.read.canonical import Log
from drake_teleop.logs.read.description import Description

FINDINGS_CAUSED_BY_MISFIT = ("lag", "units", "payload")  # or by its cause, such as drift
MOTION_FINDINGS = (
    *("clock", "reversed gravity", "inverted orientation", "quaternion order", "degrees"),
    "base axes",
)
"""Errors of the described motion, which resemble causes."""
MIN_LAG_OF_WRONG_CLOCK_S = 0.05  # filters lag less


Edit = tuple[Finding, Description]  # a finding, and the corrected description


def edit_field(description: Description, path: str, value: Any) -> Description:
    first, *rest = path.split(".", 1)
    if rest:
        model: Any = getattr(description, first)
        value = edit_field(model, rest[0], value)
    return description.model_copy(update={first: value})


def _make_edit(
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
    """Return a finding for an accelerometer in a wrong unit, and the corrected description."""
    sensors: dict[str, Any] = {
        f"{stream}.{name}": getattr(getattr(description, stream), name, None)
        for stream in ("imu", "static")
        for name in ("specific_force", "gravity")
    }
    median = float(np.median(np.linalg.norm(log.specific_force, axis=1)))
    ratio = median / float(np.linalg.norm(description.gravity_W))
    for path, sensor in sensors.items():
        if sensor is None:
            continue
        read = ratio / description.unit_in_si(sensor.unit)
        text = f"the accelerometer reads {ratio:.3g} times gravity: it is not in {sensor.unit}"
        for unit in ("m/s^2", "g", "mm/s^2"):
            if unit != sensor.unit and 0.7 < read * description.unit_in_si(unit) < 1.43:
                finding, edited = _make_edit(description, "units", text, {f"{path}.unit": unit})
                return [finding], edited
    return [], description


def orientation_and_gravity_sign_edits(description: Description) -> Iterator[Edit]:
    """Yield edits of a description: other forms of the orientation, opposite sign of gravity."""
    pose, imu = description.pose, description.imu
    sensed = imu is not None and imu.specific_force is not None
    if imu is not None and sensed:
        text = "the accelerometer reads g - a: gravity is reversed"
        note = " (or turn the vector `gravity` if z points down)"
        yield _make_edit(description, "reversed gravity", text, {"imu.sign": -imu.sign}, note)
    where = "static.orientation" if description.static else "pose.orientation"
    orientation = pose.orientation if pose else getattr(description.static, "orientation", None)
    if orientation is None:
        return
    if not sensed:
        turned = [0.0 - x for x in description.gravity_W.tolist()]
        text, note = "gravity is reversed", ", a vector in the world"
        yield _make_edit(description, "reversed gravity", text, {"gravity": turned}, note)
    text = "the orientation is that of the world in S, R_SW, not R_WS"
    fields: dict[str, Any] = {f"{where}.inverse": not orientation.inverse}
    yield _make_edit(description, "inverted orientation", text, fields)
    forms = {"quaternion_wxyz": "quaternion_xyzw", "quaternion_xyzw": "quaternion_wxyz"}
    if orientation.form in forms:
        text = f"the quaternions are not {orientation.form}"
        fields = {f"{where}.form": forms[orientation.form]}
        yield _make_edit(description, "quaternion order", text, fields)
    for axes in EULER_AXES if orientation.form == "euler" else ():
        if axes != orientation.axes:
            text = f"the Euler angles do not turn about {orientation.axes}"
            yield _make_edit(description, "Euler axes", text, {f"{where}.axes": axes})
    if orientation.form in ("rotation_vector", "euler"):
        text = f"the angles are not in {orientation.unit}"
        unit = "deg" if orientation.unit == "rad" else "rad"
        yield _make_edit(description, "degrees", text, {f"{where}.unit": unit})


def edit_with_opposite_wrench_sign(finding: Finding, description: Description) -> Edit:
    """Return finding and description of an edit, with the sign of the wrench inverted, too."""
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
    text = "the sign of the wrench is inverted"
    yield _make_edit(description, "sign", text, {f"{stream}.sign": -sensor.sign})
    yield from orientation_and_gravity_sign_edits(description)
    if isinstance(sensor.frame, str):
        text, other = "the wrench is in the axes of the base", "base"
        if sensor.frame == "base":
            text, other = "the wrench is not in base axes", "sensor"
        yield _make_edit(description, "base axes", text, {f"{stream}.frame": other})
    imu, pose = description.imu, description.pose
    if pose is not None and pose.position and (imu is None or imu.specific_force is None):
        text = f"the position is not in {pose.position.unit}"
        unit = "mm" if pose.position.unit == "m" else "m"
        yield _make_edit(description, "units", text, {"pose.position.unit": unit})
    if imu is not None and imu.angular_velocity and imu.angular_velocity.unit == "rad/s":
        fields: dict[str, Any] = {"imu.angular_velocity.unit": "deg/s"}
        yield _make_edit(description, "degrees", "the gyroscope is in degrees", fields)
    columns: dict[str, Any] = {
        f"{stream}.{x}.columns": getattr(sensor, x).columns for x in ("force", "torque")
    }
    for order in list(permutations(range(3)))[1:]:
        if all(len(names) == 3 for names in columns.values()):
            fields = {path: [names[i] for i in order] for path, names in columns.items()}
            text = "axes of the wrench are exchanged"
            yield _make_edit(description, "swapped axes", text, fields)
    old = np.array(sensor.frame) if isinstance(sensor.frame, tuple) else np.eye(3)
    for R in right_angled_rotations()[1:] if sensor.frame != "base" else ():
        fields = {f"{stream}.frame": (R @ old).tolist()}
        yield _make_edit(description, "swapped axes", "the wrench is in other axes", fields)
