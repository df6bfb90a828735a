"""Errors of convention in a log, found by what they do to the laws of motion.

Every suspicion is an edit of the description. The log is read again with it, and the edit is named
only if the data then agree decisively better: with Eqs. (1)-(2) for some load, or, of the IMU, with
the motion of the pose. Nothing is changed in the log; a finding says what to change.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np

from drake_teleop.errors import DrakeTeleopError
from drake_teleop.load.regressor import regressor
from drake_teleop.logs.alignment import low_passed, resample, undelayed
from drake_teleop.logs.canonical import Log
from drake_teleop.logs.delay import SEARCH_RANGE, estimate_delay
from drake_teleop.logs.description import Description
from drake_teleop.logs.mounting import Mounting, find_mounting, right_angled_rotations
from drake_teleop.logs.reading import read_description
from drake_teleop.logs.tables import Table

EXPLAINED = 0.02
"""A fit that leaves less than this share of the variance, with positive mass, is not questioned."""
DECISIVE = 0.25
"""A hypothesis has to leave less than this share of what the description as given leaves."""
BELIEVABLE = 0.05
"""... and less than this share of the variance."""
LAG = 0.002
"""Delays below this are not mentioned [s]."""
CLOCK = 0.05
"""Disagreements of IMU and pose below this are left to the delay [s]."""
_SAMPLES = 1500


@dataclass(frozen=True)
class Finding:
    """Something suspicious in a log.

    Args:
        name: what it is, in one word for programs: "sign", "units" ...
        message: what was seen and what to change.
    """

    name: str
    message: str


@dataclass(frozen=True)
class LoadFit:
    """Least squares of Eq. (5): `unexplained` share of the wrench's variance, and the `mass`."""

    unexplained: float
    mass: float

    @property
    def good(self) -> bool:
        return self.unexplained < EXPLAINED and self.mass > 0


@dataclass(frozen=True)
class Conventions:
    """What the data say about a description.

    Args:
        findings: the suspected errors.
        fit: of a load, to the description as given; None if nothing could be fitted.
        mounting: of the IMU against the pose, if both are there and move enough.
        delay_s: of the motion behind the wrench, if determined [s].
    """

    findings: tuple[Finding, ...]
    fit: LoadFit | None
    mounting: Mounting | None
    delay_s: float | None


def load_fit(log: Log) -> LoadFit:
    """How much of the wrench a constant offset and some load explain.

    Forces and torques weigh alike, each group in units of its own variance.

    Args:
        log: the log; it is low-passed at 15 Hz for this.
    """
    smooth = low_passed(log, None if log.static else min(15.0, 0.2 / log.dt))
    rows = slice(None, None, max(1, len(log) // _SAMPLES))
    wrench = smooth.wrench[rows]
    w = wrench - wrench.mean(axis=0)
    variance = np.repeat(w.var(axis=0).reshape(2, 3).sum(axis=1), 3)
    scale = np.sqrt(variance + (1e-9 * np.abs(wrench).max()) ** 2 + 1e-30)
    V = regressor(*(x[rows] for x in smooth.motion))
    V = (V - V.mean(axis=0)) / scale[:, None]
    matrix = V.reshape(-1, 10)
    size = np.linalg.norm(matrix, axis=0) + 1e-12
    theta = np.linalg.lstsq(matrix / size, (w / scale).ravel(), rcond=1e-6)[0] / size
    residual = w / scale - V @ theta
    return LoadFit(float(residual.var(axis=0).sum() / 2), float(theta[0]))


def check_conventions(
    description: Description, source: str, tables: dict[Path, Table] | None = None
) -> Conventions:
    """Compares the description with its data.

    Args:
        description: with absolute paths.
        source: its file, for messages.
        tables: its files, if they are read already.

    Raises:
        DrakeTeleopError: if the log cannot be read as it is described.
    """
    tables = dict(tables or {})

    def read(edited: Description) -> Log:
        return read_description(edited, source, tables=tables)

    log = read(description)
    findings = list(_units(description, log))
    if findings:
        description = _in_g(description)
        log = read(description)
    mounting = None
    if description.imu and description.pose:
        more, mounting, description = _against_pose(description, read)
        findings += more
        log = read(description)
    delay = None if log.static else estimate_delay(log, 30.0)
    fit = load_fit(log)
    if mounting is None or not mounting.mirrored:
        findings += _against_load(description, log, fit, delay, read)
    return Conventions(tuple(findings), fit, mounting, delay)


def _units(description: Description, log: Log) -> Iterator[Finding]:
    imu = description.imu
    if imu is None or imu.specific_force is None:
        return
    ratio = float(np.median(np.linalg.norm(log.specific_force, axis=1)))
    ratio /= float(np.linalg.norm(description.gravity))
    unit = imu.specific_force.unit
    if (unit == "m/s^2" and 0.07 < ratio < 0.15) or (unit == "g" and 7 < ratio < 14):
        other = "g" if unit == "m/s^2" else "m/s^2"
        yield Finding(
            "units",
            f"the accelerometer reads {ratio:.3g} times gravity: it is not in {unit};"
            f" set imu.specific_force.unit: {other}",
        )


def _in_g(description: Description) -> Description:
    assert description.imu is not None and description.imu.specific_force is not None
    other = "g" if description.imu.specific_force.unit == "m/s^2" else "m/s^2"
    return _edit(description, "imu.specific_force.unit", other)


def _edit(description: Description, path: str, value: Any) -> Description:
    """The description with one field changed."""
    first, *rest = path.split(".", 1)
    if rest:
        model: Any = getattr(description, first)
        value = _edit(model, rest[0], value)
    return description.model_copy(update={first: value})


_Reads = Callable[[Description], Log]
_Edit = tuple[Finding, Description]


def _pose_edits(description: Description) -> Iterator[_Edit]:
    """Orientations in another form, gravity or an accelerometer that point the other way."""
    pose, imu = description.pose, description.imu
    if imu is not None and imu.specific_force is not None:
        yield (
            Finding(
                "reversed gravity",
                "the accelerometer reads g - a: gravity is reversed;"
                f" set imu.sign: {-imu.sign} (or turn the vector `gravity` if z points down)",
            ),
            _edit(description, "imu.sign", -imu.sign),
        )
    if pose is None:
        return
    if imu is None or imu.specific_force is None:
        turned = tuple(-x for x in description.gravity)
        yield (
            Finding(
                "reversed gravity",
                f"gravity is reversed; set gravity: {list(turned)}, a vector in the world",
            ),
            _edit(description, "gravity", turned),
        )
    inverse = pose.orientation.inverse
    yield (
        Finding(
            "inverted orientation",
            "the orientation is that of the world in S, R_SW, not R_WS;"
            f" set pose.orientation.inverse: {str(not inverse).lower()}",
        ),
        _edit(description, "pose.orientation.inverse", not inverse),
    )
    forms = {"quaternion_wxyz": "quaternion_xyzw", "quaternion_xyzw": "quaternion_wxyz"}
    if pose.orientation.form in forms:
        other = forms[pose.orientation.form]
        yield (
            Finding(
                "quaternion order",
                f"the quaternions are not {pose.orientation.form}; set"
                f" pose.orientation.form: {other}",
            ),
            _edit(description, "pose.orientation.form", other),
        )


def _against_pose(
    description: Description, read: _Reads
) -> tuple[list[Finding], Mounting | None, Description]:
    """Findings about the IMU, its mounting, and the description with them taken into account."""

    def mounting(edited: Description) -> Mounting | None:
        return find_mounting(read(edited), read(edited.model_copy(update={"imu": None})))

    given = mounting(description)
    if given is None:
        return [], None, description
    findings: list[Finding] = []
    if given.unexplained > EXPLAINED or given.mirrored or given.angle_deg > 10:
        better = [
            (found.unexplained, finding, edited, found)
            for finding, edited in _pose_edits(description)
            if (found := _tried(mounting, edited)) and not found.mirrored
        ]
        limit = min(BELIEVABLE, DECISIVE * given.unexplained)
        if given.mirrored:
            better = [entry for entry in better if entry[3].angle_deg < 10]
        elif given.angle_deg > 10 and given.unexplained < BELIEVABLE:
            # About one axis an inverted orientation looks like a turned IMU: the edit that leaves
            # the IMU where it was said to be is the simpler explanation.
            better = [entry for entry in better if entry[3].angle_deg < 10]
            limit = min(BELIEVABLE, 1.5 * given.unexplained + 1e-4)
        best = min(better, key=lambda entry: entry[0], default=None)
        if best and best[0] < limit:
            findings.append(best[1])
            description, given = best[2], best[3]
    if given.unexplained > BELIEVABLE and not given.mirrored:
        return findings, given, description
    if abs(given.lag_s) > CLOCK:
        findings.append(
            Finding(
                "clock",
                f"the clock of the IMU lags that of the pose by {given.lag_s:.3f} s;"
                f" add {-given.lag_s:.3f} to imu.time.offset",
            )
        )
        assert description.imu is not None
        offset = description.imu.time.offset - given.lag_s
        description = _edit(description, "imu.time.offset", offset)
    if given.speed_ratio is not None and 40 < given.speed_ratio < 80:
        findings.append(
            Finding(
                "degrees",
                f"the gyroscope reads {given.speed_ratio:.3g} times the speed of the pose;"
                " set imu.angular_velocity.unit: deg/s",
            )
        )
        description = _edit(description, "imu.angular_velocity.unit", "deg/s")
    if given.mirrored:
        findings.append(
            Finding(
                "swapped axes",
                "the axes of the IMU are those of the pose mirrored: two columns are exchanged or"
                " one has the wrong sign; correct imu.specific_force.columns",
            )
        )
    elif given.angle_deg > 10:
        assert description.imu is not None
        old = np.eye(3)
        if isinstance(description.imu.frame, tuple):
            old = np.array(description.imu.frame)
        frame = np.array(given.right_angled if given.is_right_angled else given.R_SI) @ old
        shown = np.round(frame, 4).tolist()
        kind = "swapped axes" if given.is_right_angled else "mounting"
        findings.append(
            Finding(
                kind,
                f"the IMU is turned by {given.angle_deg:.0f} deg against S; set imu.frame: {shown}"
                + ("" if given.is_right_angled else " (not a right-angled mounting)"),
            )
        )
        description = _edit(description, "imu.frame", tuple(map(tuple, frame.tolist())))
    return findings, given, description


def _tried(function: Callable[[Description], Any], edited: Description) -> Any:
    """What the function makes of an edited description; None if such a log cannot be read."""
    try:
        return function(edited)
    except DrakeTeleopError:
        return None


def _load_edits(description: Description) -> Iterator[_Edit]:
    stream = "static" if description.static else "wrench"
    sensor: Any = getattr(description, stream)
    yield (
        Finding("sign", f"the sign of the wrench is inverted; set {stream}.sign: {-sensor.sign}"),
        _edit(description, f"{stream}.sign", -sensor.sign),
    )
    yield from _pose_edits(description)
    if sensor.frame == "sensor":
        yield (
            Finding(
                "base axes",
                f"the wrench is in the axes of the base; set {stream}.frame: base",
            ),
            _edit(description, f"{stream}.frame", "base"),
        )
    elif sensor.frame == "base":
        yield (
            Finding("base axes", f"the wrench is not in base axes; set {stream}.frame: sensor"),
            _edit(description, f"{stream}.frame", "sensor"),
        )
    imu = description.imu
    if imu is not None and imu.angular_velocity and imu.angular_velocity.unit == "rad/s":
        yield (
            Finding("degrees", "the gyroscope is in degrees; set imu.angular_velocity.unit: deg/s"),
            _edit(description, "imu.angular_velocity.unit", "deg/s"),
        )
    for order in list(permutations(range(3)))[1:]:
        if len(sensor.force.columns) == 3 and len(sensor.torque.columns) == 3:
            force, torque = (
                tuple(x.columns[i] for i in order) for x in (sensor.force, sensor.torque)
            )
            edited = _edit(description, f"{stream}.force.columns", force)
            yield (
                Finding(
                    "swapped axes",
                    f"axes of the wrench are exchanged; set {stream}.force.columns: {list(force)}"
                    f" and {stream}.torque.columns: {list(torque)}",
                ),
                _edit(edited, f"{stream}.torque.columns", torque),
            )
    old = np.array(sensor.frame) if isinstance(sensor.frame, tuple) else np.eye(3)
    for R in right_angled_rotations()[1:] if sensor.frame != "base" else ():
        frame = (R @ old).tolist()
        yield (
            Finding("swapped axes", f"the wrench is in other axes; set {stream}.frame: {frame}"),
            _edit(description, f"{stream}.frame", tuple(map(tuple, frame))),
        )


def _against_load(
    description: Description, log: Log, given: LoadFit, delay: float | None, read: _Reads
) -> list[Finding]:
    if delay is not None and abs(delay) > 0.9 * SEARCH_RANGE:
        delay = None  # At the end of the range it is a side minimum: the wide search decides.
    lag = [_lag(delay)] if delay is not None and abs(delay) > LAG else []
    aligned = load_fit(undelayed(log, delay)) if delay is not None else given
    if (given.good or aligned.good) and aligned.mass > 0:
        return lag
    fits: list[tuple[LoadFit, Finding]] = []
    for finding, edited in _load_edits(description):
        fit = _tried(lambda trial: load_fit(read(trial)), edited)
        if fit is not None and fit.mass > 0:
            fits.append((fit, finding))
    wide = None if log.static else _wide_lag(log)
    if wide is not None:
        fit = load_fit(undelayed(log, wide))
        if fit.mass > 0:
            fits.append((fit, _lag(wide)))
    # A negative mass is impossible: then it is enough to be as good with a positive one.
    limit = given.unexplained * (1.01 if given.mass < 0 else DECISIVE)
    fits = [entry for entry in fits if entry[0].unexplained < min(BELIEVABLE, limit)]
    if fits:
        least = min(fit.unexplained for fit, _ in fits)
        return [next(f for fit, f in fits if fit.unexplained <= 1.2 * least + 1e-9)]
    if given.unexplained > 0.5:
        return [
            Finding(
                "payload",
                f"payload not identifiable: a load ({given.mass:.2g} kg in the fit) explains"
                f" {100 * (1 - given.unexplained):.0f} % of the wrench's variance only",
            )
        ]
    return []


def _wide_lag(log: Log) -> float | None:
    """The shift within 2 s, or a quarter of the record, at which a load fits best [s]."""
    reach = min(2.0, 0.25 * float(log.t[-1] - log.t[0]))
    smooth = low_passed(log, min(5.0, 0.2 / log.dt))
    t = np.linspace(log.t[0] + reach, log.t[-1] - reach, 300)
    wrench = resample(t, smooth.t, smooth.wrench)

    def cost(shift: float) -> float:
        s, omega, alpha = (resample(t + shift, smooth.t, x) for x in smooth.motion)
        return load_fit(Log(t, wrench, s, omega, alpha)).unexplained

    shifts = np.arange(-reach, reach + 1e-9, 0.02)
    coarse = float(shifts[int(np.argmin([cost(x) for x in shifts]))])
    return coarse if abs(coarse) < reach - 0.03 else None


def _lag(delay: float) -> Finding:
    side = "behind" if delay > 0 else "ahead of"
    return Finding(
        "lag",
        f"the motion is {abs(delay) * 1e3:.1f} ms {side} the wrench; identify takes this out;"
        f" to say so in the description, add {-delay:.4f} to the time.offset of imu and pose",
    )
