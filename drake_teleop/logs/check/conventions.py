"""Errors of convention in a log, found by what they do to the laws of motion.

Every suspicion is an edit of the description. The log is read again with it, thinned to about
100 Hz, and the edit is named only if the data then agree decisively better: with Eqs. (1)-(2) for
some load, or, of the IMU, with the motion of the pose. Nothing is changed in the log; a finding
says what to change.

When is better decisive? Unexplained variances u of n independent samples, noise and nothing else,
have ratios that follow Fisher's F(n, n). An edit has to exceed the quantile of F that one good log
in a million would exceed with any of `_EDITS` edits, and the factor `DECISIVE`, which is for what
is no noise: bending, cross-talk, a contact. n = 2 * cut-off * duration (Shannon).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtri

from drake_teleop.errors import DrakeTeleopError
from drake_teleop.load.batch.methods import identify_batch
from drake_teleop.load.compensation import contact_wrench
from drake_teleop.load.identification import Identification
from drake_teleop.load.regressor import regressor
from drake_teleop.logs.read.alignment import low_passed, measured, resample, undelayed
from drake_teleop.logs.read.bags import read_stream
from drake_teleop.logs.read.canonical import Log, describe_canonical
from drake_teleop.logs.read.delay import SEARCH_RANGE, estimate_delay
from drake_teleop.logs.read.description import Description, Time, load_description
from drake_teleop.logs.read.mounting import Mounting, find_mounting, right_angled_rotations
from drake_teleop.logs.read.reading import read_description
from drake_teleop.logs.read.tables import FORMATS, Table, read_table

EXPLAINED = 0.02
"""A fit that leaves less than this share of the variance, besides the sensor's white noise, and has
a positive mass, is not questioned."""
BELIEVABLE = 0.05
"""A hypothesis has to leave less than this share, besides the noise."""
DECISIVE = 4.0
"""... and at least this factor less than the description as given."""
HARDLY = 0.9
"""A load that leaves more than this share of the wrench's variance drowns in the rest."""
LAG = 0.002
"""Delays below this are not mentioned [s]."""
CLOCK = 0.05
"""Larger disagreements of clocks are no lag of a filter, but of the clocks [s]."""
_FALSE_ALARMS, _EDITS = 1e-6, 50
_CUTOFF = 15.0
_SAMPLES = 1500
_RATE = 100.0
_STAMPS = "time stamps of a stream without"


_NO_YAML = "in a description of this table, see docs/logs.md; the canonical form has no such line"


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
    """Least squares of Eq. (5).

    Args:
        unexplained: share of the wrench's variance that is left.
        mass: of the fit [kg].
        noise: share of the variance that is white noise of the sensor.
        independent: how many samples say something new.
    """

    unexplained: float
    mass: float
    noise: float = 0.0
    independent: float = 1e9

    @property
    def good(self) -> bool:
        return self.mass > 0 and self.unexplained < EXPLAINED + self.noise


@dataclass(frozen=True)
class Conventions:
    """What the data say about a description.

    Args:
        findings: the suspected errors.
        fit: of a load, to the description as given but for what is wrong with the IMU.
        mounting: of the IMU against the pose, if both are there and move enough.
        delay_s: of the motion behind the wrench, if determined [s].
    """

    findings: tuple[Finding, ...]
    fit: LoadFit
    mounting: Mounting | None
    delay_s: float | None


def load_fit(log: Log) -> LoadFit:
    """How much of the wrench a constant offset and some load explain.

    Forces weigh as their variance, torques as theirs or as forces 3 cm away, whichever is more: a
    torque that is nothing but noise does not count.

    Args:
        log: the log; it is low-passed at 15 Hz for this.
    """
    cutoff = _cutoff(log)
    smooth = low_passed(log, cutoff).only(measured(log, cutoff))
    rows = slice(None, None, max(1, len(log) // _SAMPLES))
    wrench = smooth.wrench[rows]
    w = wrench - wrench.mean(axis=0)
    scale = _scale(wrench)
    V = regressor(*(x[rows] for x in smooth.motion))
    V = (V - V.mean(axis=0)) / scale[:, None]
    matrix = V.reshape(-1, 10)
    size = np.linalg.norm(matrix, axis=0) + 1e-12
    theta = np.linalg.lstsq(matrix / size, (w / scale).ravel(), rcond=1e-6)[0] / size
    total = float((w / scale).var(axis=0).sum()) + 1e-30
    left_over = float((w / scale - V @ theta).var(axis=0).sum()) / total
    if cutoff is None:
        return LoadFit(left_over, float(theta[0]), independent=max(1.0, len(w) - 8.0))
    # The low-pass lets 0.83 * 2 * cut-off * dt of white noise pass.
    passed = min(1.0, 1.67 * cutoff * log.dt)
    noise = passed * float(((white_noise(log.wrench) / scale) ** 2).sum()) / total
    independent = 2 * cutoff * float(log.t[-1] - log.t[0])
    return LoadFit(left_over, float(theta[0]), noise, independent)


def unexplained_share(wrench: NDArray[np.float64], residual: NDArray[np.float64]) -> float:
    """Share of the variance of a wrench (N, 6) in a residual (N, 6), weighed as `load_fit` does."""
    scale = _scale(wrench)
    total = float((wrench / scale).var(axis=0).sum()) + 1e-30
    return float((residual / scale).var(axis=0).sum()) / total


def white_noise(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Standard deviations (k,) of white noise in (N, k), from third differences.

    Those know nothing of smooth motion.
    """
    if len(x) < 4:
        return np.zeros(x.shape[1:])
    # The squares of 1, 3, 3, 1 sum to 20; 1.4826 median |x| is the deviation of a normal x.
    return 1.4826 * np.median(np.abs(np.diff(x, 3, axis=0)), axis=0) / np.sqrt(20)


def _cutoff(log: Log) -> float | None:
    return None if log.static else min(_CUTOFF, 0.2 / log.dt)


def _scale(wrench: NDArray[np.float64]) -> NDArray[np.float64]:
    """(6,) units in which forces and torques weigh alike."""
    force, torque = np.sqrt(wrench.var(axis=0).reshape(2, 3).sum(axis=1))
    least = 1e-9 * float(np.abs(wrench).max()) + 1e-15
    return np.repeat([force + least, max(torque, 0.03 * force) + least], 3)


def _worse(fit: LoadFit) -> float:
    """The factor by which another description has to leave less."""
    n = max(1.0, fit.independent)
    return max(DECISIVE, float(fdtri(n, n, 1 - _FALSE_ALARMS / _EDITS)))


def check_log(path: Path) -> Conventions:
    """`check_conventions` of a canonical log or a log description, arguments as `read_log`.

    Raises:
        DrakeTeleopError: if the log cannot be read.
    """
    if path.suffix.lower() in FORMATS:
        table = read_table(path)
        return check_conventions(describe_canonical(path, table), str(path), {path: table})
    return check_conventions(load_description(path), str(path))


def question_fit(
    path: Path, log: Log, load: Identification, predicted: NDArray[np.float64], delay: float | None
) -> tuple[Finding, ...]:
    """What `check_log` says of a log, if what was identified from it looks wrong; else nothing.

    Args:
        path: the log's file.
        log: the samples that were used.
        load: what was identified.
        predicted: (N, 6) the wrench according to it.
        delay: what was taken out [s]; None if it could not be estimated.

    Returns:
        the findings but for "lag", which identification takes out; "payload" in the figures of
        this fit.

    Raises:
        DrakeTeleopError: if the log cannot be used as it is: the mass is negative, or a load
            explains less than half of the wrench, or the accelerometer is in another unit, and a
            finding says what to change.
    """
    unexplained = unexplained_share(log.wrench, log.wrench - predicted)
    weight = float(np.median(np.linalg.norm(log.specific_force, axis=1)))
    clocks = log.static or (delay is not None and abs(delay) < CLOCK)
    if load.mass > 0 and unexplained < EXPLAINED and clocks and 5.0 < weight < 20.0:
        return ()
    found = [finding for finding in check_log(path).findings if finding.name != "lag"]
    if any(finding.name == "payload" for finding in found):
        own = payload_finding(load, unexplained)
        found = [own if own and f.name == "payload" else f for f in found]
        if load.mass < 0 and load.identifiable[6]:
            raise DrakeTeleopError(found[-1].message, where=log.source)
        return tuple(found)
    negative = load.mass < 0 and bool(load.identifiable[6])
    worthless = negative or unexplained > 0.5 or any(f.name == "units" for f in found)
    if found and worthless:
        what = f"the fitted mass is {load.mass:.4g} kg"
        if not negative:
            what += f", and {100 * unexplained:.0f} % of the wrench's variance are left"
        raise DrakeTeleopError(f"{what}: {found[0].message}", where=log.source)
    if negative:
        sensor = "static" if log.static else "wrench"
        raise DrakeTeleopError(
            f"the fitted mass is {load.mass:.4g} kg: the sign of the wrench is probably inverted",
            where=f"{log.source}:{sensor}.sign",
            remedy="set `sign: -1` in the log description (or remove it if it is there)",
        )
    return tuple(found)


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
    found = _check(_Data(description, source, dict(tables or {})), description)
    if Path(source).suffix.lower() not in FORMATS:
        return found
    # A canonical table has no lines that could be changed.
    findings = (replace(f, message=f"{f.message} ({_NO_YAML})") for f in found.findings)
    return replace(found, findings=tuple(findings))


def _check(data: _Data, description: Description) -> Conventions:
    log = data.read(description)
    findings = list(_units(description, log))
    if findings:
        description = _in_g(description)
    mounting = None
    if description.imu and description.pose:
        more, mounting, description = _against_pose(description, data)
        findings += more
    fit = load_fit(data.thin(description))
    if mounting is not None and mounting.mirrored:
        return Conventions(tuple(findings), fit, mounting, None)
    more, delay = _against_load(description, data)
    findings = _one_clock(description, [*findings, *more], mounting, delay)
    return Conventions(tuple(findings), fit, mounting, delay)


class _Data:
    """The tables of a log, as they are and thinned."""

    def __init__(self, description: Description, source: str, tables: dict[Path, Table]) -> None:
        self._source = source
        self._tables = tables
        self._thinned: dict[Path, Table] = {}
        steps: dict[Path, list[int]] = {}
        for stream in _streams(description):
            if stream.source not in tables:
                tables[stream.source] = read_stream(stream)
            steps.setdefault(stream.source, []).append(self._stride(description, stream))
        for stream in _streams(description):
            thin = self._thinned.setdefault(
                stream.source,
                replace(tables[stream.source], columns=dict(tables[stream.source].columns)),
            )
            self._thin(stream, thin, min(steps[stream.source]))

    def read(self, description: Description) -> Log:
        """The whole log."""
        return read_description(description, self._source, tables=self._tables)

    def thin(self, description: Description) -> Log:
        """The log with as many samples as a comparison needs."""
        stamped = {
            name: stream.model_copy(
                update={"time": stream.time.model_copy(update={"column": _STAMPS, "rate": None})}
            )
            for name in ("wrench", "imu", "pose")
            if (stream := getattr(description, name)) and stream.time.column is None
        }
        description = description.model_copy(update=stamped)
        return read_description(description, self._source, tables=self._thinned)

    def start(self, stream: Any, description: Description) -> float:
        """When the stream's first row was taken, on the common clock [s]."""
        if stream.time.column is None:
            return float(stream.time.offset)
        t = self._tables[stream.source].raw(stream.time.column, "time")
        return float(t[0, 0]) * description.scale(stream.time.unit) + stream.time.offset

    def _stride(self, description: Description, stream: Any) -> int:
        """Rows that become one; an odd number, so that one of them is in the middle."""
        time: Time | None = getattr(stream, "time", None)
        if time is None:
            return 1
        if time.rate is not None:
            rate = time.rate
        else:
            t = self._tables[stream.source].raw(str(time.column), "time")[:, 0]
            rate = 1 / max(1e-12, float(np.median(np.diff(t))) * description.scale(time.unit))
        return max(1, math.floor((rate / _RATE - 1) / 2) * 2 + 1)

    def _thin(self, stream: Any, thin: Table, k: int) -> None:
        """Means over k rows; of an orientation, which has no mean, the row in the middle."""
        table = self._tables[stream.source]
        for field in type(stream).model_fields:
            quantity = getattr(stream, field)
            for column in map(str, getattr(quantity, "columns", ())):
                x = table.raw(column, field)
                taken = x[k // 2 :: k][: len(x) // k]
                thin.columns[column] = taken if field == "orientation" else _means(x, k)
        time: Time | None = getattr(stream, "time", None)
        if time is not None and time.column is not None:
            thin.columns[str(time.column)] = _means(table.raw(time.column, "time"), k)
        elif time is not None and time.rate is not None:
            thin.columns[_STAMPS] = _means(np.arange(table.rows)[:, None] / time.rate, k)


def _streams(description: Description) -> list[Any]:
    streams = (getattr(description, name) for name in ("wrench", "imu", "pose", "static"))
    return [stream for stream in streams if stream is not None]


def _means(x: NDArray[np.float64], k: int) -> NDArray[np.float64]:
    rows = len(x) // k
    return x[: rows * k].reshape(rows, k, -1).mean(axis=1) if k > 1 else x


def _gravity_field(description: Description) -> str | None:
    if description.imu is not None and description.imu.specific_force is not None:
        return "imu.specific_force"
    return "static.gravity" if description.static and description.static.gravity else None


def _units(description: Description, log: Log) -> Iterator[Finding]:
    field = _gravity_field(description)
    if field is None:
        return
    ratio = float(np.median(np.linalg.norm(log.specific_force, axis=1)))
    ratio /= float(np.linalg.norm(description.gravity))
    unit = _field(description, field).unit
    # 9.81 apart; a median that far from gravity is no motion.
    if (unit == "m/s^2" and 0.07 < ratio < 0.15) or (unit == "g" and 7 < ratio < 14):
        yield Finding(
            "units",
            f"the accelerometer reads {ratio:.3g} times gravity: it is not in {unit};"
            f" set {field}.unit: {_other_unit(unit)}",
        )


def _other_unit(unit: str) -> str:
    return "g" if unit == "m/s^2" else "m/s^2"


def _in_g(description: Description) -> Description:
    field = _gravity_field(description)
    assert field is not None
    return _edit(description, f"{field}.unit", _other_unit(_field(description, field).unit))


def _field(description: Description, path: str) -> Any:
    value: Any = description
    for name in path.split("."):
        value = getattr(value, name)
    return value


def _edit(description: Description, path: str, value: Any) -> Description:
    """The description with one field changed."""
    first, *rest = path.split(".", 1)
    if rest:
        model: Any = getattr(description, first)
        value = _edit(model, rest[0], value)
    return description.model_copy(update={first: value})


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
    field = "static.orientation" if description.static else "pose.orientation"
    orientation = pose.orientation if pose else getattr(description.static, "orientation", None)
    if orientation is None:
        return
    if imu is None or imu.specific_force is None:
        turned = tuple(0.0 - x for x in description.gravity)
        yield (
            Finding(
                "reversed gravity",
                f"gravity is reversed; set gravity: {list(turned)}, a vector in the world",
            ),
            _edit(description, "gravity", turned),
        )
    inverse = orientation.inverse
    yield (
        Finding(
            "inverted orientation",
            "the orientation is that of the world in S, R_SW, not R_WS;"
            f" set {field}.inverse: {str(not inverse).lower()}",
        ),
        _edit(description, f"{field}.inverse", not inverse),
    )
    forms = {"quaternion_wxyz": "quaternion_xyzw", "quaternion_xyzw": "quaternion_wxyz"}
    if orientation.form in forms:
        other = forms[orientation.form]
        yield (
            Finding(
                "quaternion order",
                f"the quaternions are not {orientation.form}; set {field}.form: {other}",
            ),
            _edit(description, f"{field}.form", other),
        )
    if orientation.form == "rotation_vector":
        unit = "deg" if orientation.unit == "rad" else "rad"
        yield (
            Finding(
                "degrees",
                f"the rotation vectors are not in {orientation.unit}; set {field}.unit: {unit}",
            ),
            _edit(description, f"{field}.unit", unit),
        )


def _against_pose(
    description: Description, data: _Data
) -> tuple[list[Finding], Mounting | None, Description]:
    """Findings about the IMU, its mounting, and the description with them taken into account."""

    def mounting(edited: Description) -> Mounting | None:
        pose_alone = edited.model_copy(update={"imu": None})
        return find_mounting(data.thin(edited), data.thin(pose_alone))

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
        limit = min(BELIEVABLE, given.unexplained / DECISIVE)
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
    if abs(given.lag_s) > CLOCK or given.drift:
        finding, description = _imu_clock(description, given, data)
        findings.append(finding)
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


def _imu_clock(description: Description, found: Mounting, data: _Data) -> _Edit:
    """What is wrong with the clock of the IMU, and the description without it."""
    assert description.imu is not None and description.wrench is not None
    time = description.imu.time
    if not found.drift:
        offset = time.offset - found.lag_s
        finding = Finding(
            "clock",
            f"the clock of the IMU lags that of the pose by {found.lag_s:.3f} s;"
            f" set imu.time.offset: {offset:.3f}",
        )
        return finding, _edit(description, "imu.time.offset", offset)
    start = data.start(description.imu, description) - data.start(description.wrench, description)
    scale = 1 / (1 + found.drift)
    lag = scale * (found.lag_middle_s + found.drift * (start - found.middle_s))
    offset, factor = time.offset - lag, scale * time.scale
    finding = Finding(
        "clock",
        f"the clock of the IMU lags that of the pose by {lag:.3f} s at its first row and by"
        f" {1e3 * found.drift:.3g} ms more each second ({found.lag_s:.3f} s is the best constant);"
        f" set imu.time.offset: {offset:.3f} and imu.time.scale: {factor:.6f}",
    )
    edited = _edit(description, "imu.time.offset", offset)
    return finding, _edit(edited, "imu.time.scale", factor)


def _one_clock(
    description: Description,
    findings: list[Finding],
    mounting: Mounting | None,
    delay: float | None,
) -> list[Finding]:
    """If IMU and wrench disagree with the pose by the same time, its clock is wrong, not theirs."""
    clocks = [finding for finding in findings if finding.name == "clock"]
    if len(clocks) < 2 or mounting is None or mounting.drift or delay is None:
        return findings
    if abs(mounting.lag_s + delay) > CLOCK:
        return findings
    assert description.pose is not None
    finding = Finding(
        "clock",
        f"the clock of the pose is {delay:.3f} s ahead of those of IMU and wrench;"
        f" set pose.time.offset: {description.pose.time.offset - delay:.3f}",
    )
    return [finding, *(other for other in findings if other.name != "clock")]


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


def _against_load(description: Description, data: _Data) -> tuple[list[Finding], float | None]:
    """Findings about wrench, orientation and clocks from the load, and the delay."""
    log = data.read(description)
    delay = None if log.static else estimate_delay(log, 30.0)
    thin = data.thin(description)

    def fitted(edited: Description) -> LoadFit:
        # A delay that was estimated under a wrong description may be wrong too.
        log = _rewrenched(thin, description, edited) or data.thin(edited)
        fits = [load_fit(undelayed(log, shift)) for shift in {0.0, delay or 0.0}]
        return min(fits, key=lambda fit: fit.unexplained)

    given = fitted(description)
    # Slow motion fits well enough with a wrong clock, but not with a delay within the range.
    inside = delay is not None and abs(delay) < 0.9 * SEARCH_RANGE
    edits: list[tuple[Finding | None, Description]] = []
    if not (given.good and inside):
        edits += _shifted(description, thin)
    if not given.good:
        edits = [*_load_edits(description), *edits]
    found: list[tuple[LoadFit, Finding | None, Description]] = []
    for finding, edited in edits:
        fit = _tried(fitted, edited)
        if fit is not None and fit.mass > 0:
            found.append((fit, finding, edited))
    # A negative mass is impossible: then it is enough to be as good with a positive one.
    limit = given.unexplained * 1.01 if given.mass < 0 else given.unexplained / _worse(given)
    limit = min(limit, BELIEVABLE + given.noise)
    found = [entry for entry in found if entry[0].unexplained < limit]
    if not found and given.good:
        return _lag(description, delay) if _shows(thin, delay) else [], delay
    if not found:
        return _without_remedy(description, log, given, delay)
    least = 1.2 * min(fit.unexplained for fit, *_ in found) + 1e-9
    equals = [(finding, edited) for fit, finding, edited in found if fit.unexplained <= least]
    finding, edited = equals[0]
    delay = None if log.static else estimate_delay(data.read(edited), 30.0)
    if finding is None:  # The clock of the wrench, which the edit set to the nearest 20 ms.
        assert description.wrench is not None and edited.wrench is not None
        shift = edited.wrench.time.offset - description.wrench.time.offset + (delay or 0.0)
        return _lag(description, shift), shift
    others = {f.name: f.message for f, _ in reversed(equals[1:]) if f and f.name != finding.name}
    message = "; just as possible: ".join([finding.message, *others.values()])
    return [Finding(finding.name, message), *_lag(description, delay)], delay


def _shows(log: Log, delay: float | None) -> bool:
    """Whether the delay is five standard errors from none: twice a log likelihood ratio of 25."""
    if delay is None:
        return False
    none, aligned = load_fit(log), load_fit(undelayed(log, delay))
    gain = none.independent * np.log(none.unexplained / (aligned.unexplained + 1e-30))
    return bool(gain > 25.0)


def _rewrenched(log: Log, old: Description, new: Description) -> Log | None:
    """The log of another description of the wrench, without reading it again; None if it must."""
    a, b = old.wrench, new.wrench
    if a is None or b is None or "base" in (a.frame, b.frame):
        return None
    changes = {"sign": a.sign, "frame": a.frame, "force": a.force, "torque": a.torque}
    if new.model_copy(update={"wrench": b.model_copy(update=changes)}) != old:
        return None
    R_old, R_new = (np.array(w.frame) if w.frame != "sensor" else np.eye(3) for w in (a, b))
    parts = []
    for x, force, again in (
        (log.wrench[:, :3], a.force.columns, b.force.columns),
        (log.wrench[:, 3:], a.torque.columns, b.torque.columns),
    ):
        if set(force) != set(again) or len(force) != 3:
            return None
        given = x @ R_old  # In the axes of the file.
        parts.append(given[:, [force.index(column) for column in again]] @ R_new.T)
    return replace(log, wrench=a.sign * b.sign * np.hstack(parts))


def _without_remedy(
    description: Description, log: Log, given: LoadFit, delay: float | None
) -> tuple[list[Finding], float | None]:
    """What is left to say of a wrench that no load explains and no edit mends."""
    smooth = low_passed(log, 30.0)
    fit = identify_batch(smooth.wrench, *smooth.motion, shared_noise=log.static)
    load = fit.identification
    finding = payload_finding(load, given.unexplained - given.noise)
    if finding:
        return [finding], None
    kept = ~fit.rejected
    wrench, (s, omega, alpha) = smooth.wrench[kept], (x[kept] for x in smooth.motion)
    residual = contact_wrench(wrench, load.offsets, s, omega, alpha, load.phi)
    if delay is None or unexplained_share(wrench, residual) > BELIEVABLE + given.noise:
        return [], None
    if fit.rejected.any():
        # A contact pulls at the delay.
        lost = fit.rejected if log.bridged is None else fit.rejected | log.bridged
        delay = estimate_delay(replace(log, bridged=lost), 30.0)
    return _lag(description, delay), delay


def payload_finding(load: Identification, unexplained: float) -> Finding | None:
    """That a record says nothing about the mass of a load, if so.

    Args:
        load: what was fitted.
        unexplained: share of the wrench's variance that it leaves, besides noise. With 0.9 the
            rest (contacts, with the sensor's cross-talk and drift) is at least three times as large
            as the load's part, and a robust fit believes the samples that suit it.
    """
    if load.verdicts[6] != "not" and unexplained < HARDLY:
        return None
    deviation = float(load.standard_deviations[6])
    fitted = f"{load.mass:.2g} ± {deviation:.2g} kg in the fit"
    if not np.isfinite(deviation):
        fitted = "nothing here depends on its mass"
    share = max(0.0, 100 * (1 - unexplained))
    return Finding(
        "payload",
        f"payload not identifiable: {fitted}, which explains {share:.0f} % of the wrench's"
        " variance; record slow turns about two horizontal axes that touch nothing",
    )


def _shifted(description: Description, log: Log) -> Iterator[tuple[None, Description]]:
    """The clock of the wrench shifted within 2 s, or a quarter of the record, to the best fit."""
    if description.wrench is None:
        return
    reach = min(2.0, 0.25 * float(log.t[-1] - log.t[0]))
    smooth = low_passed(log, min(5.0, 0.2 / log.dt))
    t = np.linspace(log.t[0] + reach, log.t[-1] - reach, 300)
    wrench = resample(t, smooth.t, smooth.wrench)

    def cost(shift: float) -> float:
        s, omega, alpha = (resample(t + shift, smooth.t, x) for x in smooth.motion)
        return load_fit(Log(t, wrench, s, omega, alpha)).unexplained

    shifts = np.arange(-reach, reach + 1e-9, 0.02)
    best = float(shifts[int(np.argmin([cost(x) for x in shifts]))])
    if abs(best) < reach - 0.03:
        offset = description.wrench.time.offset + best
        yield None, _edit(description, "wrench.time.offset", offset)


def _lag(description: Description, delay: float | None) -> list[Finding]:
    if delay is None or abs(delay) <= LAG or description.wrench is None:
        return []
    side = "behind" if delay > 0 else "ahead of"
    if abs(delay) > CLOCK:
        offset = description.wrench.time.offset + delay
        return [
            Finding(
                "clock",
                f"the motion is {abs(delay):.3f} s {side} the wrench: a clock is wrong;"
                f" set wrench.time.offset: {offset:.3f} (or shift the others the other way)",
            )
        ]
    return [
        Finding(
            "lag",
            f"the motion is {abs(delay) * 1e3:.1f} ms {side} the wrench; identify takes this out;"
            f" to say so in the description, add {delay:.4f} to wrench.time.offset",
        )
    ]
