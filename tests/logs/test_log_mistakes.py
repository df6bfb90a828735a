"""Mistakes that a good fit of the load hides are named, with the line that fixes them."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import polars as pl
import pytest
import yaml
from posed_record import GRAVITY_W, OFFSETS, PHI, motion_at
from scipy.spatial.transform import Rotation

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.rotations import quaternions_from_matrices
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.logs.check.edits import LogTables, edit_field
from drake_teleop.logs.check.motion_checks import (
    _correct_imu_clock,
    check_imu_against_pose,
    check_imu_signals,
    position_unit_or_origin_findings,
)
from drake_teleop.logs.processing import check_log, identify_log
from drake_teleop.logs.read.canonical import SPECIFIC_FORCE_COLUMNS, WRENCH_COLUMNS, Log
from drake_teleop.logs.read.description import Description
from drake_teleop.logs.read.description_fields import SI_VALUE_OF_UNIT
from drake_teleop.logs.read.tables import Table

Columns = dict[str, np.ndarray]
IMU, POSE, BOTH = ("imu",), ("pose",), ("imu", "pose")
FIELDS = {
    "wrench": ("force", "torque"),
    "imu": ("specific_force", "angular_velocity", "angular_acceleration"),
    "pose": ("orientation", "position"),
}


@pytest.fixture(scope="module")
def good() -> Columns:
    return record(12.0)


def record(seconds: float) -> Columns:
    """Return a record at 100 Hz with noise."""
    rng = np.random.default_rng(3)
    t = np.arange(0.0, seconds, 0.01)
    at = motion_at(t)
    wrench = non_contact_wrench(at.specific_force, at.omega, at.alpha, PHI) + OFFSETS
    wrench += np.repeat([0.1, 0.004], 3) * rng.normal(size=wrench.shape)
    return {
        "t": t,
        "force": wrench[:, :3],
        "torque": wrench[:, 3:],
        "specific_force": at.specific_force + 0.03 * rng.normal(size=(len(t), 3)),
        "angular_velocity": at.omega + 2e-3 * rng.normal(size=(len(t), 3)),
        "angular_acceleration": at.alpha + 0.1 * rng.normal(size=(len(t), 3)),
        "orientation": quaternions_from_matrices(at.R_WS),
        "position": at.p_WS + 2e-5 * rng.normal(size=(len(t), 3)),
        "R": at.R_WS,
    }


def findings_of(folder: Path, columns: Columns, motion: tuple[str, ...], **top: Any) -> list[str]:
    """Return findings other than lags; `top` are fields of the description."""
    document: dict[str, Any] = {"gravity": GRAVITY_W.tolist()}
    for stream in ("wrench", *motion):
        table = {"t": columns.get(f"{stream}_t", columns["t"])}
        document[stream] = {"file": f"{stream}.parquet", "time": {"column": "t"}}
        for name in FIELDS[stream]:
            names = [f"{name}_{i}" for i in range(columns[name].shape[1])]
            table |= dict(zip(names, columns[name].T, strict=True))
            document[stream][name] = {"columns": names} | top.get(name, {})
        pl.DataFrame(table).write_parquet(folder / f"{stream}.parquet")
    if "pose" in motion:
        document["pose"]["orientation"]["form"] = "quaternion_wxyz"
    (folder / "log.yaml").write_text(yaml.safe_dump(document))
    found = check_log(folder / "log.yaml").findings
    return [f"{f.name}: {f.message}" for f in found if f.name != "lag"]


@pytest.mark.slow
@pytest.mark.parametrize("motion", [IMU, POSE, BOTH])
def test_good_log_has_no_finding(good: Columns, tmp_path: Path, motion: tuple[str, ...]) -> None:
    assert findings_of(tmp_path, good, motion) == []


def _times(name: str, factor: float) -> Callable[[Columns], None]:
    return lambda c: c.update({name: factor * c[name]})


def _wrench_in(R: Any) -> Callable[[Columns], None]:
    return lambda c: c.update({k: c[k] @ np.array(R).T for k in ("force", "torque")})


def _gyro_axes(c: Columns) -> None:
    for name in ("angular_velocity", "angular_acceleration"):
        c[name] = c[name][:, [1, 0, 2]]


def _alpha_axes(c: Columns) -> None:
    c["angular_acceleration"] = c["angular_acceleration"][:, [1, 0, 2]] * [1, 1, -1]


def _tcp(c: Columns) -> None:
    c["position"] = c["position"] + c["R"] @ [0.02, 0.0, 0.15]


def _held(name: str) -> Callable[[Columns], None]:
    def plant(c: Columns) -> None:
        c[name] = c[name].copy()
        c[name][:, 1] = 0.5

    return plant


def _repeated_column(c: Columns) -> None:
    c["force"] = c["force"][:, [0, 0, 2]]


ABOUT_Z = Rotation.from_euler("z", 45, degrees=True).as_matrix()
TURNED = [[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]]


def described_imu(**changed: dict[str, Any]) -> Description:
    """Return a description with columns such as "force_x", and other fields of signals."""
    document: dict[str, Any] = {
        stream: {"file": "log.csv", "time": {"column": "t"}}
        | {
            name: {"columns": [f"{name}_{axis}" for axis in "xyz"]} | changed.get(name, {})
            for name in FIELDS[stream]
        }
        for stream in ("wrench", "imu")
    }
    return Description.model_validate(document)


@pytest.mark.parametrize(
    ("unit", "bias", "size_rad"),
    [("rad/s", 0.05, 0.0), ("rad/s", 0.02, 0.01), ("deg/s", 0.03, 0.02), ("mdeg/s", 0.02, 0.0)],
)
def test_bias_of_a_gyroscope_at_rest_is_no_wrong_unit_or_axis(
    unit: str, bias: float, size_rad: float
) -> None:
    t = np.arange(0.0, 20.0, 0.02)
    s = 9.80665 * Rotation.from_rotvec(np.outer(-size_rad * np.sin(t), [0, 1, 0])).apply([0, 0, 1])
    for axis in np.eye(3):
        omega = np.outer(size_rad * np.cos(t), [0, 1, 0]) + bias * (axis + 0.1)
        log = Log(t, np.zeros((len(t), 6)), s, omega, np.zeros((len(t), 3)))
        description = described_imu(angular_velocity={"unit": unit})
        assert check_imu_signals(description, log) == ([], description)


def test_axes_of_the_gyroscope_in_another_order_are_named() -> None:
    t = np.arange(0.0, 20.0, 0.02)
    at = motion_at(t)
    omega, alpha = at.omega[:, [1, 2, 0]], at.alpha[:, [1, 2, 0]]
    log = Log(t, np.zeros((len(t), 6)), at.specific_force, omega, alpha)
    (finding,), corrected = check_imu_signals(described_imu(), log)
    assert finding.name == "swapped axes" and corrected.imu is not None
    ordered = [f"angular_velocity_{axis}" for axis in "zxy"]
    assert finding.message.endswith(f"set imu.angular_velocity.columns: {ordered}")
    assert [*corrected.imu.angular_velocity.columns] == ordered


@pytest.mark.parametrize(
    ("omega", "alpha", "unit", "line"),
    [
        (1.0, 57.3, "rad/s^2", "set imu.angular_acceleration.unit: deg/s^2"),
        (1.0, 1 / 57.3, "deg/s^2", "set imu.angular_acceleration.unit: rad/s^2"),
        (57.3, 1.0, "rad/s^2", "set imu.angular_velocity.unit: deg/s"),
    ],
)
def test_unit_of_the_wrong_rate_is_named(omega: float, alpha: float, unit: str, line: str) -> None:
    t = np.arange(0.0, 4.0, 0.01)
    at = motion_at(t)
    log = Log(t, np.zeros((len(t), 6)), at.specific_force, omega * at.omega, alpha * at.alpha)
    description = described_imu(angular_acceleration={"unit": unit})
    (finding,), corrected = check_imu_signals(description, log)
    assert finding.name == "degrees" and finding.message.endswith(line)
    assert corrected != description


@pytest.mark.parametrize("unit", ["rad/s", "deg/s"])
@pytest.mark.parametrize("true", ["rad/s", "deg/s", "mdeg/s"])
def test_unit_of_the_gyroscope_follows_from_gravity_or_pose(unit: str, true: str) -> None:
    at = motion_at(np.arange(0.0, 12.0, 0.01))
    omega = at.omega / SI_VALUE_OF_UNIT[true]
    description, data = imu_and_pose(np.eye(3), angular_velocity=omega)
    description = edit_field(description, "imu.angular_velocity.unit", unit)
    of_imu = check_imu_signals(description, data.read_thinned_log(description))
    of_pose = check_imu_against_pose(description, data)
    for found, corrected in (of_imu, (of_pose[0], of_pose[2])):
        lines = [x.message.partition("; set ")[2] for x in found]
        assert lines == ([] if unit == true else [f"imu.angular_velocity.unit: {true}"])
        assert corrected.imu is not None and corrected.imu.angular_velocity is not None
        assert corrected.imu.angular_velocity.unit == true


def imu_and_pose(frame: np.ndarray, **changed: np.ndarray) -> tuple[Description, LogTables]:
    """Return a log of 12 s with an IMU in S, a description of its frame, and other columns."""
    t = np.arange(0.0, 12.0, 0.01)
    at = motion_at(t)
    columns = {
        "t": t,
        "force": at.specific_force,
        "torque": at.omega,
        "specific_force": at.specific_force,
        "angular_velocity": at.omega,
        "orientation": quaternions_from_matrices(at.R_WS),
        "position": at.p_WS,
    } | changed
    stream = {"file": "log", "time": {"column": "t"}}
    wrench, imu, pose = (
        stream | {name: {"columns": [name]} for name in FIELDS[kind] if name in columns}
        for kind in FIELDS
    )
    pose["orientation"]["form"] = "quaternion_wxyz"
    imu["frame"] = frame.tolist()
    document = {"gravity": GRAVITY_W.tolist(), "wrench": wrench, "imu": imu, "pose": pose}
    description = Description.model_validate(document)
    return description, LogTables(
        description, "log.yaml", {Path("log"): Table(Path("log"), columns)}
    )


@pytest.mark.slow
def test_mounting_in_the_description_is_corrected_from_the_left() -> None:
    at = motion_at(np.arange(0.0, 12.0, 0.01))
    R_SI = Rotation.from_euler("xyz", [30.0, 40.0, -70.0], degrees=True)
    given = np.round(Rotation.from_euler("z", 90.0, degrees=True).as_matrix())
    s, omega = (R_SI.apply(x, inverse=True) for x in (at.specific_force, at.omega))
    description, data = imu_and_pose(given, specific_force=s, angular_velocity=omega)
    (finding,), _, corrected = check_imu_against_pose(description, data)
    assert finding.name == "mounting" and corrected.imu is not None
    np.testing.assert_allclose(corrected.imu.frame, R_SI.as_matrix(), atol=2e-3)


@pytest.mark.parametrize(
    ("scale", "name", "line"),
    [
        (1.1, "pose frame", "set pose.position_in_sensor: ["),
        (1e3, "units", "set pose.position.unit: mm"),
    ],
)
def test_position_of_another_point_or_unit_is_named(scale: float, name: str, line: str) -> None:
    """Positions of the tool's centre point, with a gain error of 10 % or in mm."""
    at, rng = motion_at(np.arange(0.0, 12.0, 0.01)), np.random.default_rng(1)
    place = np.array([0.03, -0.02, 0.15])
    position = scale * (at.p_WS + at.R_WS @ place + 1e-4 * rng.normal(size=at.p_WS.shape))
    (finding,) = position_unit_or_origin_findings(*imu_and_pose(np.eye(3), position=position), 0.0)
    assert finding.name == name and line in finding.message
    if name == "pose frame":
        found = yaml.safe_load(re.findall(r"position_in_sensor: (\[.*?\])", finding.message)[0])
        np.testing.assert_allclose(found, place, atol=1e-3)


def test_wrong_position_of_the_accelerometer_is_corrected_from_the_described_one() -> None:
    """The accelerometer is in So; the described position of the pose is right."""
    at = motion_at(np.arange(0.0, 12.0, 0.01))
    tool, wrong = np.array([0.03, -0.02, 0.15]), (0.05, 0.02, -0.04)
    position = at.p_WS + at.R_WS @ tool
    description, data = imu_and_pose(np.eye(3), position=position)
    description = edit_field(description, "imu.position", wrong)
    description = edit_field(description, "pose.position_in_sensor", tuple(tool))
    (finding,) = position_unit_or_origin_findings(description, data, 0.0)
    found = yaml.safe_load(finding.message.rpartition("imu.position: ")[2])
    np.testing.assert_allclose(found, 0.0, atol=1e-3)


def test_lag_of_a_drifting_clock_is_given_at_the_first_row() -> None:
    drifting = SimpleNamespace(
        mid_record_lag_s=0.3, clock_drift=2e-3, mid_record_time_s=50.0, lag_s=0.31
    )
    data = SimpleNamespace(
        correction_of_lag_and_clock_drift=lambda *given: (given[2], "both", given)
    )
    description = SimpleNamespace(imu="an IMU")
    finding, (stream, _, _, drift) = _correct_imu_clock(description, drifting, data)
    assert (stream, drift) == ("imu", 2e-3)
    assert "by 0.200 s at its first row and by 2 ms more each second (0.310 s" in finding.message


MISTAKES: list[tuple[str, Callable[[Columns], None], tuple[str, ...], str, str]] = [
    ("N mm", _times("torque", 1e3), IMU, "torque factor", "wrench.torque.unit: N mm"),
    ("lbf in", _times("torque", 8.851), POSE, "torque factor", "wrench.torque.unit: lbf in"),
    ("alpha", _alpha_axes, IMU, "swapped axes", "the gyroscope's y, x, -z"),
    ("lbf", _times("force", 1 / 4.448), IMU, "torque factor", "wrench.force.unit: lbf"),
    (
        "mirrored",
        _wrench_in(np.diag([1, -1, 1])),
        IMU,
        "axes",
        "sign: -1 and wrench.frame: [[-1",
    ),
    (
        "mirrored pose",
        _wrench_in(np.diag([1, -1, 1])),
        POSE,
        "axes",
        "sign: -1 and wrench.frame: [[-1",
    ),
    ("turned", _wrench_in(TURNED), IMU, "sensor rotation", "imu.frame: [[0."),
    ("alpha", _times("angular_acceleration", 57.3), IMU, "degrees", "acceleration.unit: deg/s^2"),
    ("gyro", _times("angular_velocity", 57.3), IMU, "degrees", "velocity.unit: deg/s"),
    ("axes", _gyro_axes, IMU, "swapped axes", "['angular_velocity_1', 'angular_velocity_0', 'ang"),
    ("mm/s^2", _times("specific_force", 1e3), IMU, "units", "specific_force.unit: mm/s^2"),
    ("mg", _times("specific_force", 1e3 / 9.80665), IMU, "units", "specific_force.unit: mg"),
    ("mm", _times("position", 1e3), BOTH, "units", "pose.position.unit: mm"),
    (
        "km",
        _times("position", 1e-3),
        BOTH,
        "units",
        "multiply pose.position.scale",
    ),
    (
        "km pose",
        _times("position", 1e-3),
        POSE,
        "units",
        "multiply pose.position.scale",
    ),
    ("kN m", _times("torque", 1e-3), IMU, "torque factor", "wrench.torque.scale: 1000"),
    ("turned 45", _wrench_in(ABOUT_Z), POSE, "pose frame", "pose.rotation_in_sensor: [[0.7"),
    ("TCP", _tcp, BOTH, "pose frame", "pose.position_in_sensor: [0.0"),
    ("clock", lambda c: c.update(pose_t=1.01 * c["t"]), POSE, "clock", "pose.time.scale: 0.990"),
    ("dead", _held("torque"), IMU, "dead channel", "'torque_1'"),
    ("dead gyro", _held("angular_velocity"), IMU, "dead channel", "'angular_velocity_1'"),
    ("copied", _repeated_column, IMU, "repeated channel", "'force_0' and 'force_1'"),
]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("plant", "motion", "name", "line"), [m[1:] for m in MISTAKES], ids=[m[0] for m in MISTAKES]
)
def test_planted_mistake_is_named(
    good: Columns,
    tmp_path: Path,
    plant: Callable[[Columns], None],
    motion: tuple[str, ...],
    name: str,
    line: str,
) -> None:
    columns = dict(good)
    plant(columns)
    found = findings_of(tmp_path, columns, motion)
    assert any(text.startswith(f"{name}: ") and line in text for text in found), found


@pytest.mark.slow
def test_identify_names_a_wrong_scale_despite_a_good_fit(tmp_path: Path) -> None:
    columns = record(16.0)  # only then is the mean of an acceleration small
    columns["specific_force"] = 1.05 * columns["specific_force"]
    (text,) = findings_of(tmp_path, columns, IMU)
    assert text.startswith("gravity: ")
    assert float(text.split("force by ")[1].split(",")[0]) == pytest.approx(1.05, abs=2e-3)
    (found,) = identify_log(tmp_path / "log.yaml").findings
    assert found.name == "gravity"


@pytest.mark.slow
@pytest.mark.quick_cases(1)
@pytest.mark.parametrize("scale", [16384 / 9.80665, 0.4])
def test_accelerometer_in_no_known_unit_leaves_the_load_unknown(
    good: Columns, tmp_path: Path, scale: float
) -> None:
    columns = good | {"specific_force": scale * good["specific_force"]}
    (text,) = (x for x in findings_of(tmp_path, columns, IMU) if x.startswith("units: "))
    assert "imu.specific_force.scale" in text
    with pytest.raises(DrakeTeleopError, match=r"imu\.specific_force\.scale"):
        identify_log(tmp_path / "log.yaml")


@pytest.mark.slow
def test_a_column_that_is_named_twice_is_named(good: Columns, tmp_path: Path) -> None:
    names = {"columns": ["torque_0", "torque_0", "torque_2"]}
    found = findings_of(tmp_path, good, IMU, torque=names)
    assert [text for text in found if "names 'torque_0' twice" in text] == found[:1]


@pytest.mark.parametrize(
    ("turn", "rows", "says"), [(0.2, 12, "too alike"), (2.0, 12, None), (2.0, 5, "5 poses")]
)
def test_poses_at_rest_are_enough_and_different(
    tmp_path: Path, turn: float, rows: int, says: str | None
) -> None:
    rng = np.random.default_rng(1)
    R = Rotation.from_rotvec(turn * rng.normal(size=(rows, 3))).as_matrix()
    s, rest = -GRAVITY_W @ R, np.zeros((rows, 3))
    wrench = non_contact_wrench(s, rest, rest, PHI) + 0.01 * rng.normal(size=(rows, 6))
    table = dict(
        zip((*WRENCH_COLUMNS, *SPECIFIC_FORCE_COLUMNS), np.hstack([wrench, s]).T, strict=True)
    )
    pl.DataFrame(table).write_csv(tmp_path / "rest.csv")
    found = check_log(tmp_path / "rest.csv").findings
    assert [says is not None and says in f.message for f in found] == ([True] if says else [])
