"""Errors of convention in real and simulated records, and what `identify` reports about them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import planted
import polars as pl
import pytest
import yaml
from known_motion import motion_at
from planted import NTNU_FRAME, findings, good, ntnu_log, written
from scipy.spatial.transform import Rotation

from drake_teleop.cli.logs import identify_command
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.logs.causes.cause import Finding
from drake_teleop.logs.check import conventions
from drake_teleop.logs.check.against_load import (
    _log_with_edited_wrench,
    clock_drift_finding_and_correction,
)
from drake_teleop.logs.check.edits import LogTables, edit_field
from drake_teleop.logs.inspection import inspect_command
from drake_teleop.logs.processing import eliminate_log, identify_log
from drake_teleop.logs.read.canonical import Log
from drake_teleop.logs.read.description import Description, load_description
from drake_teleop.logs.read.tables import Table

Tables = dict[str, pl.DataFrame]
Data = dict[str, Any]

FORCE, TORQUE = ["fx", "fy", "fz"], ["tx", "ty", "tz"]
MATRIX = [f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)]


def _set(tables: Tables, stream: str, names: list[str], values: np.ndarray) -> None:
    columns = [pl.Series(name, values[:, i]) for i, name in enumerate(names)]
    tables[stream] = tables[stream].with_columns(columns)


def _rotations(tables: Tables) -> np.ndarray:
    return tables["pose"].select(MATRIX).to_numpy().reshape(-1, 3, 3)


def _sign(data: Data, tables: Tables) -> None:
    data["wrench"]["sign"] = 1


def _inverted(data: Data, tables: Tables) -> None:
    _set(tables, "pose", MATRIX, _rotations(tables).transpose(0, 2, 1).reshape(-1, 9))


def _base(data: Data, tables: Tables) -> None:
    t, at = (tables[name]["t"].to_numpy() for name in ("wrench", "pose"))
    R = np.stack([np.interp(t, at, x) for x in _rotations(tables).reshape(-1, 9).T], axis=1)
    for names in (FORCE, TORQUE):
        turned = np.einsum(
            "nij,nj->ni", R.reshape(-1, 3, 3), tables["wrench"].select(names).to_numpy()
        )
        _set(tables, "wrench", names, turned)


def _reversed(data: Data, tables: Tables) -> None:
    data["imu"]["sign"] = -1


def _in_g(data: Data, tables: Tables) -> None:
    data["imu"]["specific_force"] |= {"unit": "m/s^2"}


def _xyzw(data: Data, tables: Tables) -> None:
    _set(tables, "pose", list("abcd"), Rotation.from_matrix(_rotations(tables)).as_quat())
    data["pose"]["orientation"] = {"columns": list("abcd"), "form": "quaternion_wxyz"}


def _degrees(data: Data, tables: Tables) -> None:
    vectors = Rotation.from_matrix(_rotations(tables)).as_rotvec(degrees=True)
    _set(tables, "pose", list("abc"), vectors)
    data["pose"]["orientation"] = {"columns": list("abc"), "form": "rotation_vector"}


def _swapped(data: Data, tables: Tables) -> None:
    for name, columns in (("force", FORCE), ("torque", TORQUE)):
        data["wrench"][name]["columns"] = [columns[i] for i in (1, 0, 2)]


def _imu_clock(data: Data, tables: Tables) -> None:
    data["imu"]["time"]["offset"] = 0.3


def _wrench_clock(data: Data, tables: Tables) -> None:
    data["wrench"]["time"]["offset"] = 0.5


def _repeated(data: Data, tables: Tables) -> None:
    values = tables["wrench"].select([*FORCE, *TORQUE]).to_numpy().copy()
    values[300:320] = values[300]
    _set(tables, "wrench", [*FORCE, *TORQUE], values)


def _nan(data: Data, tables: Tables) -> None:
    values = tables["wrench"].select(FORCE).to_numpy().copy()
    values[500:540] = np.nan
    _set(tables, "wrench", FORCE, values)


def _saturated(data: Data, tables: Tables) -> None:
    x = tables["wrench"].select(["fx"]).to_numpy()
    _set(tables, "wrench", ["fx"], np.minimum(x, np.quantile(x, 0.9)))


REAL: list[tuple[Callable[[Data, Tables], None], str, str]] = [
    (_sign, "sign", "wrench.sign: -1"),
    (_inverted, "inverted orientation", "pose.orientation.inverse: true"),
    (_base, "base axes", "wrench.frame: base"),
    (_reversed, "reversed gravity", "imu.sign: 1"),
    (_in_g, "units", "imu.specific_force.unit: g"),
    (_xyzw, "quaternion order", "pose.orientation.form: quaternion_xyzw"),
    (_degrees, "degrees", "pose.orientation.unit: deg"),
    (_swapped, "swapped axes", "wrench.force.columns: ['fx', 'fy', 'fz']"),
    (_imu_clock, "clock", "imu.time.offset"),
    (_wrench_clock, "clock", "wrench.time.offset"),
    (_repeated, "repeated rows", "19 rows"),
    (_nan, "nan", "40 rows"),
    (_saturated, "saturation", "fx"),
]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("plant", "name", "says", "record"),
    [(*p, ("1-baseline", "2-vibrations")[i % 2]) for i, p in enumerate(REAL)],
    ids=[p[0].__name__ for p in REAL],
)
def test_an_error_in_a_real_record_is_named(
    ntnu: Path,
    tmp_path: Path,
    plant: Callable[[Data, Tables], None],
    name: str,
    says: str,
    record: str,
) -> None:
    path = ntnu_log(ntnu, tmp_path, record, frame=NTNU_FRAME)
    data = yaml.safe_load(path.read_text())
    tables = {stream: pl.read_csv(data[stream]["file"]) for stream in ("wrench", "imu", "pose")}
    plant(data, tables)
    for stream, table in tables.items():
        table.write_parquet(tmp_path / f"{stream}.parquet")
        data[stream]["file"] = f"{stream}.parquet"
    path.write_text(yaml.safe_dump(data))
    summary = inspect_command(path, tmp_path, quiet=True)
    found = {entry["name"]: entry["message"] for entry in summary["findings"]}
    assert set(found) - {"lag"} == {name}  # The lag of the record itself may be named as well.
    assert says in found[name]
    if name == "clock":
        try:
            names = {finding.name for finding in identify_log(path).findings}
        except DrakeTeleopError as error:
            names = {"clock"} if "clock" in str(error) else set()
        assert names == {"clock"}
    if name == "clock" and "wrench" in says:
        assert summary["delay_s"] == pytest.approx(-0.494, abs=3e-3)


@pytest.mark.quick_cases(2)
@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_loads_and_streams_of_any_kind_raise_no_alarm(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    mass = float(np.exp(rng.uniform(np.log(0.1), np.log(5.0))))
    com = rng.uniform(-0.08, 0.08, 3)
    phi = phi_from_mass_com_inertia(mass, com, mass * np.diag(rng.uniform(1.0, 1.9, 3)) * 1e-3)
    columns = good(seed=seed, phi=phi, start=rng.uniform(0, 50))
    if seed % 2:
        columns["force"] = np.round(columns["force"] / 0.05) * 0.05
    streams = [{}, {"imu": False}, {"pose": False}][seed % 3]
    assert findings(tmp_path, columns, **streams) == {}


@pytest.mark.slow
def test_a_short_contact_on_a_light_load_is_no_alarm(tmp_path: Path) -> None:
    columns = good(phi=phi_from_mass_com_inertia(0.15, [0.0, 0.01, 0.04], 1e-4 * np.eye(3)))
    columns["force"][900:1100, 2] += 15 * np.sin(np.linspace(0, np.pi, 200))
    assert findings(tmp_path, columns) == {}


@pytest.mark.slow
def test_rate_of_a_held_sensor_is_reported(tmp_path: Path) -> None:
    columns = good()
    planted.held(columns)
    found = findings(tmp_path, columns)
    assert set(found) == {"repeated rows", "lag"}  # A held value is late by half of its period.
    assert "held for 5 rows: new values come at 100 Hz, not 500 Hz" in found["repeated rows"]
    assert "4.0 ms ahead" in found["lag"]


@pytest.mark.slow
def test_a_coarse_sensor_at_rest_repeats_rows_by_itself(tmp_path: Path) -> None:
    columns = good()
    for key in ("force", "torque"):
        columns[key][1000:] = np.round(columns[key][1000:].mean(axis=0), 1)
        steps = np.random.default_rng(1).random((1000, 3)) < 0.05
        columns[key][1000:] += 0.05 * steps
    assert "repeated rows" not in findings(tmp_path, columns)


@pytest.mark.slow
def test_remedy_for_a_drifting_clock_is_correct(tmp_path: Path) -> None:
    columns = good()
    planted.drifting_clock(columns)
    path = written(tmp_path, columns)
    found = inspect_command(path, tmp_path / "out", quiet=True)["findings"]
    assert [entry["name"] for entry in found] == ["clock"]
    data = yaml.safe_load(path.read_text())
    remedy = found[0]["message"].rsplit("; set ", 1)[1]
    for field in remedy.split(" and "):
        name, value = field.split(": ")
        data["imu"]["time"][name.removeprefix("imu.time.")] = float(value)
    assert data["imu"]["time"]["scale"] == pytest.approx(1 / 1.02, abs=1e-4)
    assert data["imu"]["time"]["offset"] == pytest.approx(-0.1, abs=2e-3)
    path.write_text(yaml.safe_dump(data))
    assert inspect_command(path, tmp_path / "again", quiet=True)["findings"] == []


@pytest.mark.quick_cases(2)
@pytest.mark.slow
@pytest.mark.parametrize(
    ("plant", "says"),
    [
        (planted.base, "base axes|wrench.frame: base"),
        (planted.in_g, "imu.specific_force.unit: g"),
        (planted.clock, "imu.time.offset: -0.300"),
    ],
)
def test_identify_refuses_a_useless_result_with_the_reason(
    tmp_path: Path, plant: Callable[[planted.Columns], None], says: str
) -> None:
    columns = good()
    plant(columns)
    with pytest.raises(DrakeTeleopError, match=says):
        identify_command(written(tmp_path, columns), tmp_path / "out", quiet=True)


@pytest.mark.slow
def test_identify_and_eliminate_pass_findings_on(tmp_path: Path) -> None:
    path = written(tmp_path, good())
    found = identify_log(path)
    assert found.findings == ()
    load = found.identification
    assert eliminate_log(path, load).findings == ()
    columns = good()
    columns["imu_t"] = columns["t"] + 0.08
    summary = identify_command(written(tmp_path, columns), tmp_path / "late", quiet=True)
    assert [entry["name"] for entry in summary["findings"]] == ["clock"]
    assert any("imu.time.offset: -0.080" in note for note in summary["notes"])
    columns = good()
    planted.sign(columns)
    suspected = eliminate_log(written(tmp_path, columns), load).findings
    assert [finding.name for finding in suspected] == ["sign"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("move", "force", "lag_s"),
    [
        ("No6_Acc_slow_Verify_Model", None, 0.22),
        ("No9_Singularity_Free_ForceSensor", "log_force_sensor", 0.11),
    ],
)
def test_delay_and_drift_of_a_ur5_imu_are_found(
    ur5: Path, tmp_path: Path, move: str, force: str | None, lag_s: float
) -> None:
    def stream(name: str, unit: str) -> dict[str, Any]:
        file = str(ur5 / f"{move}__{name}.csv")
        return {"file": file, "header": False, "time": {"column": 0, "unit": unit}}

    # The force sensor was not connected in the first record: other columns replace it.
    wrench = stream(force, "s") if force else stream("acc_data", "ms")
    first = [1, 2, 3] if force else [4, 5, 6]
    torque = [4, 5, 6]
    imu = {"specific_force": {"columns": [1, 2, 3]}, "angular_velocity": {"columns": [7, 8, 9]}}
    orientation = {"columns": [4, 5, 6], "form": "rotation_vector"}
    data = {
        "wrench": wrench | {"force": {"columns": first}, "torque": {"columns": torque}},
        "imu": stream("acc_data", "ms") | imu,
        "pose": stream("log_tool_vector", "s")
        | {"orientation": orientation, "position": {"columns": [1, 2, 3]}},
    }
    (tmp_path / "log.yaml").write_text(yaml.safe_dump(data))
    summary = inspect_command(tmp_path / "log.yaml", tmp_path, quiet=True)
    found = {x["name"]: x["message"] for x in summary["findings"]}
    assert summary["mounting"]["lag_s"] == pytest.approx(lag_s, abs=0.01)
    assert "imu.time.scale: 0.99" in found["clock"]  # The clocks drift by several ms per second.
    if force:
        assert "payload not identifiable" in found["payload"]
        assert "new values come at 20" in found["repeated rows"]
        identified = identify_log(tmp_path / "log.yaml")
        assert any(finding.name == "payload" for finding in identified.findings)
        assert not identified.identification.identifiable[6:].any()


@pytest.mark.parametrize("time", [{"column": "t"}, {"rate": 1000.0}, None])
def test_log_is_thinned_to_means_for_any_form_of_time(
    time: dict[str, Any] | None,
) -> None:
    t = np.arange(900) * 1e-3
    rise, still = np.outer(t, [1.0, 2.0, 3.0]), np.tile([0.0, 0.0, 9.8], (900, 1))
    table = Table(Path("w"), {"t": t, "f": rise, "m": -rise, "s": still, "o": 0 * rise})
    file: dict[str, Any] = {"file": "w"} if time is None else {"file": "w", "time": time}
    wrench = file | {"force": {"columns": ["f"]}, "torque": {"columns": ["m"]}}
    motion = {"specific_force": {"columns": ["s"]}, "angular_velocity": {"columns": ["o"]}}
    streams = {"wrench": wrench, "imu": file | motion}
    if time is None:
        streams = {"static": wrench | {"gravity": {"columns": ["s"]}}}
    description = Description.model_validate(streams)
    log = LogTables(description, "log.yaml", {Path("w"): table}).read_thinned_log(description)
    if time is None:  # poses are few and independent
        assert log.static and len(log) == 900
    else:
        np.testing.assert_allclose(np.diff(log.t), 0.009, atol=1e-12)
        np.testing.assert_allclose(np.diff(log.wrench[:, 2]), 0.027, atol=1e-12)
        assert log.wrench[0, 0] == pytest.approx(0.004)


@pytest.mark.parametrize(
    ("left", "moves", "refused"),
    [
        (0.45, 1.0, ""),
        (0.55, 1.0, "55 % of the wrench's variance are left"),
        (0.55, 0.1, "hardly moves or turns"),  # no reason to doubt the axes
    ],
)
def test_a_load_that_explains_less_than_half_is_refused_if_there_is_a_reason(
    left: float, moves: float, refused: str
) -> None:
    rng = np.random.default_rng(0)
    wrench, still = rng.normal(size=(200, 6)), np.tile([0.0, 0.0, 9.8], (200, 1))
    moving = still + moves * rng.normal(size=(200, 3))
    log = Log(np.arange(200) * 0.01, wrench, moving, 0 * still, 0 * still)
    reason = Finding("axes", "two axes of the wrench are exchanged")

    def check() -> Any:
        return SimpleNamespace(findings=(reason,))

    load: Any = SimpleNamespace(mass=1.0, identifiable=np.ones(16, bool))
    # This fraction of the wrench's standard deviation remains in all channels.
    predicted = (1 - np.sqrt(left)) * wrench
    if refused:
        with pytest.raises(DrakeTeleopError, match=refused):
            conventions.findings_if_load_is_suspicious(log, load, predicted, 0.0, check)
    else:
        assert conventions.findings_if_load_is_suspicious(log, load, predicted, 0.0, check) == (
            reason,
        )


@pytest.mark.slow
@pytest.mark.quick_cases(2)
@pytest.mark.parametrize("start", [0.0, 1.0, 4.0])
@pytest.mark.parametrize("drift", [2e-3, -3e-3])
def test_offset_of_a_drifting_pose_is_that_at_its_first_row(
    tmp_path: Path, start: float, drift: float
) -> None:
    t = np.arange(0.0, 24.0, 4e-3)
    at = motion_at(t)
    wrench = non_contact_wrench(at.specific_force, at.omega, at.alpha, planted.PHI)
    rows = t >= start
    columns = {
        "t": t,
        "force": wrench[:, :3] + 0.05 * np.random.default_rng(1).normal(size=(len(t), 3)),
        "torque": wrench[:, 3:],
        "s": at.specific_force,
        "omega": at.omega,
        "R": at.R_WS[rows],
        "p": at.p_WS[rows],
        "pose_t": t[rows] + 0.02 + drift * t[rows],
    }
    path = written(tmp_path, columns, imu=False)
    description = load_description(path)
    data = LogTables(description, str(path), {})
    (finding,), edited = clock_drift_finding_and_correction(description, data)
    time, stamps = edited.pose.time, columns["pose_t"]
    corrected = stamps[0] + time.scale * (stamps - stamps[0]) + time.offset
    np.testing.assert_allclose(corrected, t[rows], atol=1e-3)
    assert f"pose.time.offset: {time.offset:.3f}" in finding.message


@pytest.mark.parametrize("factors", [(1.0, 1.0, 1.0), (1.0, 1.0, -1.0), (0.5, -2.0, 1.0)])
@pytest.mark.parametrize("order", [(2, 1, 0), (1, 2, 0), (0, 2, 1)])
@pytest.mark.parametrize("weight", [None, (0.5, 0.0, 0.01, 0.02)])
def test_edited_wrench_is_that_of_the_edited_description(
    tmp_path: Path, factors: tuple[float, ...], order: tuple[int, ...], weight: Any
) -> None:
    path = written(tmp_path, good(), imu=False)
    description = load_description(path)
    for field in ("force", "torque"):
        description = edit_field(description, f"wrench.{field}.scale", factors)
    given = edit_field(description, "wrench.weight", weight)
    assert given.wrench is not None
    edited = edit_field(given, "wrench.sign", -1)
    for field in ("force", "torque"):
        names = getattr(given.wrench, field).columns
        edited = edit_field(edited, f"wrench.{field}.columns", tuple(names[k] for k in order))
    data = LogTables(given, str(path), {})
    found = _log_with_edited_wrench(data.read_thinned_log(given), given, edited)
    if weight is not None:
        assert found is None  # which the caller replaces by reading
        return
    assert found is not None
    np.testing.assert_allclose(found.wrench, data.read_thinned_log(edited).wrench, atol=1e-9)
