"""Planted errors are named one at a time; a good log has no findings."""

from __future__ import annotations

import json
from collections import UserDict
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import planted
import polars as pl
import pytest
import yaml
from known_motion import quaternions
from planted import NTNU_FRAME, Columns, findings, good, ntnu_log, written
from scipy.io import savemat
from scipy.spatial.transform import Rotation

from drake_teleop.cli.main import main
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.logs import processing
from drake_teleop.logs.check.draft import draft_description
from drake_teleop.logs.inspection import _inspect_clock_and_flag_usable_rows, inspect_command
from drake_teleop.logs.processing import identify_log
from drake_teleop.logs.read.description import load_description
from drake_teleop.logs.read.reading import read_log
from drake_teleop.logs.read.table_files import read_table
from drake_teleop.logs.read.tables import Table

PLANTED: list[tuple[Callable[[Columns], None], str, str, dict[str, bool]]] = [
    (planted.sign, "sign", "wrench.sign: -1", {}),
    (planted.sign, "sign", "wrench.sign: -1", {"imu": False}),
    (planted.sign, "sign", "wrench.sign: -1", {"pose": False}),
    (planted.inverted, "inverted orientation", "pose.orientation.inverse: true", {}),
    (planted.inverted, "inverted orientation", "pose.orientation.inverse: true", {"imu": False}),
    (planted.base, "base axes", "wrench.frame: base", {}),
    (planted.base, "base axes", "wrench.frame: base", {"imu": False}),
    (planted.reversed_gravity, "reversed gravity", "imu.sign: -1", {}),
    (planted.reversed_gravity, "reversed gravity", "imu.sign: -1", {"pose": False}),
    (planted.in_g, "units", "imu.specific_force.unit: g", {}),
    (planted.in_g, "units", "imu.specific_force.unit: g", {"pose": False}),
    (planted.in_mm, "units", "pose.position.unit: mm", {"imu": False}),
    (planted.degrees, "degrees", "imu.angular_velocity.unit: deg/s", {}),
    (planted.degrees, "degrees", "imu.angular_velocity.unit: deg/s", {"pose": False}),
    (planted.degree_vectors, "degrees", "pose.orientation.unit: deg", {}),
    (planted.degree_vectors, "degrees", "pose.orientation.unit: deg", {"imu": False}),
    (planted.xyzw, "quaternion order", "form: quaternion_xyzw", {}),
    (planted.xyzw, "quaternion order", "form: quaternion_xyzw", {"imu": False}),
    (planted.swapped_wrench, "swapped axes", "wrench.force.columns: ['f1', 'f0', 'f2']", {}),
    (planted.swapped_imu, "swapped axes", "imu.specific_force.columns", {}),
    (planted.turned_imu, "swapped axes", "[[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]", {}),
    (planted.clock, "clock", "imu.time.offset: -0.300", {}),
    (planted.pose_clock, "clock", "pose.time.offset: -0.300", {}),
    (planted.wrench_clock, "clock", "wrench.time.offset: -0.500", {}),
    (planted.wrench_clock, "clock", "wrench.time.offset: -0.500", {"pose": False}),
    (planted.repeated, "repeated rows", "delete", {}),
    (planted.nan, "nan", "40 rows", {}),
    (planted.saturated, "saturation", "f2", {}),
]


@pytest.mark.slow
@pytest.mark.quick_cases(2)
@pytest.mark.parametrize("streams", [{}, {"imu": False}, {"pose": False}])
def test_good_log_has_no_finding(tmp_path: Path, streams: dict[str, bool]) -> None:
    assert findings(tmp_path, good(), **streams) == {}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("plant", "name", "says", "streams"),
    PLANTED,
    ids=["-".join([p[0].__name__.strip("_"), *p[3]]) for p in PLANTED],
)
def test_only_the_planted_error_is_named(
    tmp_path: Path,
    plant: Callable[[Columns], None],
    name: str,
    says: str,
    streams: dict[str, bool],
) -> None:
    columns = good()
    plant(columns)
    found = findings(tmp_path, columns, **streams)
    assert set(found) == {name}
    assert says in found[name]


@pytest.mark.slow
def test_two_errors_at_once_are_both_named(tmp_path: Path) -> None:
    columns = good()
    planted.turned_imu(columns)
    planted.inverted(columns)
    found = findings(tmp_path, columns)
    assert set(found) == {"inverted orientation", "swapped axes"}
    assert "[[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]" in found["swapped axes"]


@pytest.mark.slow
def test_repeated_rows_are_named(tmp_path: Path) -> None:
    found = findings(tmp_path, {key: np.repeat(x, 2, axis=0) for key, x in good().items()})
    assert set(found) == {"clock jump", "repeated rows"}
    expected = "every value is held for 2 rows: new values come at 500 Hz, not 1000 Hz"
    assert expected in found["repeated rows"]


@pytest.mark.parametrize("rows_per_stamp", [1, 2, 5])
def test_rate_counts_rows_that_share_a_time_stamp(rows_per_stamp: int) -> None:
    t, figures = 10.0 + 0.01 * np.repeat(np.arange(50.0), rows_per_stamp), dict[str, Any]()
    time = SimpleNamespace(column="t", unit="s", nanoseconds=None, scale=1.0)
    table = Table(Path("log.csv"), {"t": t})
    _inspect_clock_and_flag_usable_rows("log", time, table, ["t"], figures)
    assert figures["rate_hz"] == pytest.approx(100.0 * rows_per_stamp)


@pytest.mark.parametrize(("empty", "rows"), [([], 6), ([0], 5), ([0, 1], 4), ([0, 3, 5], 3)])
def test_row_after_an_empty_time_stamp_is_usable(empty: list[int], rows: int) -> None:
    t = np.arange(6.0)
    t[empty] = np.nan
    time = SimpleNamespace(column="t", unit="s", nanoseconds=None, scale=1.0)
    table = Table(Path("log.csv"), {"t": t})
    usable = _inspect_clock_and_flag_usable_rows("log", time, table, ["t"], {})[1]
    assert usable.sum() == rows and not usable[empty].any()


def test_channel_without_any_number_is_no_crash(tmp_path: Path) -> None:
    columns = good()
    columns["force"][:, 0] = np.nan
    found = findings(tmp_path, columns)
    assert "2000 rows contain NaN" in found["nan"] and "0 samples in" in found["unusable"]


@pytest.mark.slow
def test_a_wrong_clock_is_named_to_the_millisecond(tmp_path: Path) -> None:
    columns = good()
    columns["wrench_t"] = columns["t"] + 0.507
    found = findings(tmp_path, columns)
    assert "wrench.time.offset: -0.507" in found["clock"]


@pytest.mark.slow
def test_a_lag_of_6_ms_is_named(tmp_path: Path) -> None:
    found = findings(tmp_path, good(delay_s=0.006))
    assert set(found) == {"lag"}
    assert "6.0 ms behind" in found["lag"]


@pytest.mark.slow
@pytest.mark.parametrize(("deviation", "names"), [(0.001, set()), (0.0005, {"lag"})])
def test_lag_below_five_standard_deviations_is_not_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, deviation: float, names: set[str]
) -> None:
    path = written(tmp_path, good())
    found = replace(identify_log(path), delay_source="estimated", delay_std_s=deviation, causes=())
    found = replace(found, identification=replace(found.identification, delay_s=0.003))
    monkeypatch.setattr(processing, "identify_log", lambda *_, **__: found)
    summary = inspect_command(path, tmp_path / "out", quiet=True)
    assert {finding["name"] for finding in summary["findings"]} == names


@pytest.mark.slow
def test_an_inverse_orientation_is_read(tmp_path: Path) -> None:
    columns = good()
    planted.inverted(columns)
    path = written(tmp_path, columns)
    data = yaml.safe_load(path.read_text())
    data["pose"]["orientation"]["inverse"] = True
    path.write_text(yaml.safe_dump(data))
    assert inspect_command(path, tmp_path / "out", quiet=True)["findings"] == []


@pytest.mark.slow
def test_inspect_drafts_a_description(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    c = good()
    data = {"stamp": (c["t"] * 1e6).astype(np.int64), "status": np.zeros(len(c["t"]))}
    for key, x in (("F", c["force"]), ("T", c["torque"]), ("acc_", c["s"]), ("w", c["omega"])):
        data |= {f"{key}{axis}": x[:, i] for i, axis in enumerate("xyz")}
    pl.DataFrame(data).write_csv(tmp_path / "table.csv")
    with pytest.raises(SystemExit) as done:
        main(["inspect", str(tmp_path / "table.csv"), "--out", str(tmp_path)])
    assert done.value.code == 0
    assert "draft" in capsys.readouterr().out
    text = (tmp_path / "draft.yaml").read_text()
    assert text.startswith("# DRAFT") and "status" in text.splitlines()[2]
    described = load_description(tmp_path / "draft.yaml")
    assert described.wrench and described.imu and described.imu.specific_force
    assert described.wrench.force.columns == ("Fx", "Fy", "Fz")
    assert described.wrench.time.unit == "us"
    assert described.imu.specific_force.unit == "m/s^2"
    summary = inspect_command(tmp_path / "draft.yaml", tmp_path / "again", quiet=True)
    assert summary["findings"] == []
    assert json.loads((tmp_path / "again" / "summary.json").read_text()) == summary


def as_written(form: str, c: Columns) -> tuple[dict[str, np.ndarray], str]:
    """Return the columns of a good log in a format of others, and their separator."""
    wrench = np.hstack([c["force"], c["torque"]])
    R, q = c["R"], quaternions(c["R"])
    if form == "rtde":  # base axes, the pose as position and rotation vector
        base = -np.hstack([np.einsum("nij,nj->ni", R, x) for x in (c["force"], c["torque"])])
        pose = np.hstack([c["p"], Rotation.from_matrix(R).as_rotvec()])
        parts = {
            "target_TCP_pose_": pose + 1.0,
            "actual_TCP_pose_": pose,
            "actual_TCP_force_": base,
        }
        columns = {f"{name}{k}": x[:, k] for name, x in parts.items() for k in range(x.shape[1])}
        return {"timestamp": 1e5 + c["t"]} | columns, " "
    if form == "franka":  # 4 x 4, column by column
        X = np.zeros((len(R), 4, 4))
        X[:, :3, :3], X[:, :3, 3], X[:, 3, 3] = R, c["p"], 1.0
        parts = {"O_T_EE": X.transpose(0, 2, 1).reshape(-1, 16), "K_F_ext_hat_K": wrench}
        columns = {f"{name}[{k}]": x[:, k] for name, x in parts.items() for k in range(x.shape[1])}
        return {"time [ms]": 1e3 * c["t"]} | columns, ","
    if form == "units":
        names = [f"F{a} [N]" for a in "xyz"] + [f"M{a} (Nmm)" for a in "xyz"]
        columns = dict(zip(names, (wrench * np.repeat([1.0, 1e3], 3)).T, strict=True))
        columns |= {f"{a.upper()} [mm]": 1e3 * c["p"][:, k] for k, a in enumerate("xyz")}
        columns |= {f"r{i + 1}{j + 1}": R[:, i, j] for i in range(3) for j in range(3)}
        return {"Zeit [s]": c["t"]} | columns, ";"
    if form == "arrays":  # six and sixteen numbers a row
        X = np.zeros((len(R), 4, 4))
        X[:, :3, :3], X[:, :3, 3], X[:, 3, 3] = R, c["p"], 1.0
        return {"time": c["t"], "wrench": wrench, "T": X.transpose(1, 2, 0)}, ""
    if form == "matlab":  # structures, in a .mat file
        imu = {"acc": c["s"], "gyro": c["omega"]}
        tool = {"position": c["p"], "R": R.transpose(1, 2, 0)}
        return {
            "t": c["t"],
            "ft": {"F": c["force"], "M": c["torque"]},
            "imu": imu,
            "tool": tool,
        }, ""
    topics = {"ft/wrench/force": c["force"], "ft/wrench/torque": c["torque"]}
    topics |= {"tcp/pose/position": c["p"], "imu/linear_acceleration": c["s"]}
    topics |= {"imu/angular_velocity": c["omega"]}
    columns = {f"/{name}/{a}": x[:, k] for name, x in topics.items() for k, a in enumerate("xyz")}
    columns |= {f"/tcp/pose/orientation/{a}": q[:, (k + 1) % 4] for k, a in enumerate("xyzw")}
    return {"%time": (1e9 * (1.6e9 + c["t"])).astype(np.int64)} | columns, ","


@pytest.mark.slow
@pytest.mark.parametrize(
    ("form", "sign"),
    [
        ("rtde", -1),
        *((name, 1) for name in ("franka", "units", "arrays", "matlab", "topics")),
    ],
)
def test_draft_for_tables_of_robots_needs_no_change(tmp_path: Path, form: str, sign: int) -> None:
    columns, separator = as_written(form, good())
    if separator:
        pl.DataFrame(columns).write_csv(table := tmp_path / "table.csv", separator=separator)
    else:
        savemat(table := tmp_path / "table.mat", columns)
    drafted = inspect_command(table, tmp_path, quiet=True)
    assert drafted["findings"] == []
    if not separator:
        text = (tmp_path / "draft.yaml").read_text()
        assert "# Columns without a guess: none." in text and "No column of time" not in text
    found = inspect_command(tmp_path / "draft.yaml", tmp_path / "again", quiet=True)
    assert found["findings"] == []
    described = yaml.safe_load((tmp_path / "draft.yaml").read_text())
    assert described["wrench"]["sign"] == sign
    log = read_log(tmp_path / "draft.yaml")
    np.testing.assert_allclose(log.wrench[:, 2].mean(), good()["force"][:, 2].mean(), rtol=1e-3)
    assert identify_log(tmp_path / "draft.yaml").identification.mass == pytest.approx(
        3.13, rel=2e-3
    )


def test_drafting_reads_only_the_required_columns(tmp_path: Path) -> None:
    """Each access reads a column of a large Parquet file."""
    asked = set()

    class Columns(UserDict[str, np.ndarray]):
        def __getitem__(self, key: str) -> np.ndarray:
            asked.add(key)
            return super().__getitem__(key)

    names = ["t", *(f"{kind}{axis}" for kind in "FT" for axis in "xyz"), "current", "mode"]
    columns = Columns({name: np.arange(60.0) for name in names})
    draft_description(Table(tmp_path / "x.parquet", columns), tmp_path)
    assert asked <= {"t", "Fx", "Tx"}


def test_each_stream_of_a_draft_has_its_own_time(tmp_path: Path) -> None:
    """The time is in the same structure, or else has the same number of rows."""
    t, short, x = np.arange(60) * 0.01, np.arange(20) * 0.03, np.ones((60, 3))
    ft, imu = {"F": x, "M": x, "t": t}, {"acc": x, "gyro": x, "time": t}
    pose = {"p": x[:20], "q": np.ones((20, 4))}
    for name, columns, times in (
        ("structures", {"imu": imu, "ft": ft}, ["ft.t", "imu.time"]),
        ("lengths", {"pose_t": short, "ft": ft} | pose, ["ft.t", "pose_t"]),
        ("named t", {"T": np.ones((60, 4, 4)), "s_t": t, "F": x, "M": x}, ["s_t", "s_t"]),
        ("flat", {"a_t": short, "b_t": t, "F": x, "M": x} | pose, ["b_t", "a_t"]),
    ):
        savemat(tmp_path / "x.mat", columns)
        inspect_command(tmp_path / "x.mat", tmp_path, quiet=True)
        draft = yaml.safe_load((tmp_path / "draft.yaml").read_text())
        assert [stream["time"]["column"] for stream in draft.values()] == times, name


def test_an_array_that_is_not_recognized_is_named_once(tmp_path: Path) -> None:
    x = np.ones((60, 3))
    columns = {"t": np.arange(60) * 0.01, "F": x, "M": x, "current": x}
    savemat(tmp_path / "x.mat", columns)
    inspect_command(tmp_path / "x.mat", tmp_path, quiet=True)
    assert "# Columns without a guess: current.\n" in (tmp_path / "draft.yaml").read_text()


@pytest.mark.parametrize("first", ["0.00,1.5,0,0,0", "0.00,0,0,nan,1e-3"])
def test_table_without_names_keeps_its_first_row(tmp_path: Path, first: str) -> None:
    """A first row of numbers is data."""
    rows = [first, *(f"{0.01 * k:.2f},2.5,0,0,{k}" for k in range(1, 60))]
    (tmp_path / "x.csv").write_text("\n".join(rows))
    summary = inspect_command(tmp_path / "x.csv", tmp_path, quiet=True)
    message = summary["findings"][0]["message"]
    assert "not recognized: FILL IN wrench.force.columns, wrench.torque.columns" in message
    text = (tmp_path / "draft.yaml").read_text()
    assert "# Columns without a guess: 1, 2, 3, 4." in text
    wrench = yaml.safe_load(text)["wrench"]
    assert wrench["header"] is False and wrench["time"] == {"column": "0", "unit": "s"}
    assert len(read_table(tmp_path / "x.csv", header=False).numbers_with_nan(0, "here")) == 60


def test_unknown_unit_has_a_placeholder(tmp_path: Path) -> None:
    t = np.arange(50) * 0.01
    names = (
        [f"F{a} [kilo]" for a in "xyz"] + [f"T{a} [Nm]" for a in "xyz"] + ["qw", "qx", "qy", "qz"]
    )
    pl.DataFrame({"t": t} | dict.fromkeys(names, t)).write_csv(tmp_path / "table.csv")
    summary = inspect_command(tmp_path / "table.csv", tmp_path, quiet=True)
    assert "FILL IN" in summary["findings"][0]["message"]
    wrench = yaml.safe_load((tmp_path / "draft.yaml").read_text())["wrench"]
    assert (wrench["force"]["unit"], wrench["torque"]["unit"]) == ("FILL IN", "N m")


@pytest.mark.slow
def test_a_wrong_clock_and_the_sign_are_named_together(tmp_path: Path) -> None:
    columns = good()
    planted.sign(columns)
    planted.wrench_clock(columns)
    found = planted.findings(tmp_path, columns, imu=False)
    assert set(found) == {"sign", "clock"}
    assert "wrench.time.offset: -0.5" in found["clock"]


def test_a_record_at_rest_is_a_finding(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    columns = {name: np.repeat(x[:1], len(x), axis=0) for name, x in good().items()}
    columns["t"] = good()["t"]
    for name, noise in (("force", 0.05), ("torque", 0.003)):
        columns[name] = columns[name] + rng.normal(size=(2000, 3)) * noise
    found = planted.findings(tmp_path, columns, imu=False)
    assert set(found) == {"payload"} and "depends on its mass; record slow" in found["payload"]


def drafted(names: str) -> dict[str, Any]:
    columns = dict.fromkeys(names.split(", "), np.arange(60.0) * 0.01)
    return draft_description(Table(Path("x.csv"), columns), Path()).streams


def test_an_empty_cell_does_not_change_the_unit_of_time() -> None:
    """The last row has no time stamp."""
    columns = dict.fromkeys(["Fx", "Fy", "Fz", "Tx", "Ty", "Tz"], np.arange(60.0))
    columns["t"] = np.r_[np.arange(59.0) * 0.01, np.nan]
    draft = draft_description(Table(Path("x.csv"), columns), Path()).streams
    assert draft["wrench"]["time"] == {"column": "t", "unit": "s"}


@pytest.mark.parametrize(
    ("force", "torque", "position"), [("Kraft ", "Moment ", "Ort "), ("力", "力矩", "位置")]
)
def test_a_vector_in_any_language_is_recognized_by_its_unit(
    force: str, torque: str, position: str
) -> None:
    named = {force: "N", torque: "Nm", position: "mm"}
    vectors = {name: [f"{name}{a.upper()} [{unit}]" for a in "xyz"] for name, unit in named.items()}
    names = [name for columns in vectors.values() for name in columns]
    draft = drafted(", ".join(["Zeit [ms]", *names, "qw, qx, qy, qz"]))
    assert draft["wrench"]["force"] == {"columns": vectors[force], "unit": "N"}
    assert draft["wrench"]["torque"] == {"columns": vectors[torque], "unit": "N m"}
    assert draft["pose"]["position"] == {"columns": vectors[position], "unit": "mm"}


def test_force_and_torque_are_those_of_one_sensor() -> None:
    """Also if another one, which comes first, has only a force."""
    cell, ft = (f"{x}_fx, {x}_fy, {x}_fz" for x in ("cell", "ft"))
    draft = drafted(f"t, {cell}, b_tx, b_ty, b_tz, {ft}, ft_tx, ft_ty, ft_tz, qw, qx, qy, qz")
    assert draft["wrench"]["force"]["columns"] == ["ft_fx", "ft_fy", "ft_fz"]
    assert draft["wrench"]["torque"]["columns"] == ["ft_tx", "ft_ty", "ft_tz"]


@pytest.mark.parametrize(
    ("columns", "streams", "missing"),
    [
        (
            ["qw", "qx", "qy", "qz"],
            {"pose"},
            ["draft.yaml: no wrench: add wrench"],
        ),
        (["Fx", "Fy", "Fz", "Tx", "Ty", "Tz"], {"wrench"}, ["draft.yaml: a wrench without kine"]),
        (["Fx", "Fy", "Fz", "wx"], {"wrench"}, ["not recognized: FILL IN", "without kinematics"]),
        (["a", "b"], {"wrench"}, ["not recognized: FILL IN", "without kinematics"]),
    ],
)
def test_draft_has_the_available_streams_and_lists_missing_ones(
    tmp_path: Path, columns: list[str], streams: set[str], missing: list[str]
) -> None:
    t = np.arange(50) * 0.01
    pl.DataFrame({"t": t} | {name: t for name in columns}).write_csv(tmp_path / "table.csv")
    summary = inspect_command(tmp_path / "table.csv", tmp_path, quiet=True)
    text = (tmp_path / "draft.yaml").read_text()
    assert set(yaml.safe_load(text)) == streams
    assert [found["name"] for found in summary["findings"]] == ["incomplete"] * len(missing)
    for words, found in zip(missing, summary["findings"], strict=True):
        assert words in found["message"]
        assert f"# INCOMPLETE: {found['message'].removeprefix('draft.yaml: ')}" in text
        assert str(tmp_path) not in found["message"]


def test_unreadable_input_is_an_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as done:
        main(["inspect", str(tmp_path / "none.csv"), "--out", str(tmp_path)])
    assert done.value.code == 2
    assert "no such file" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.quick_cases(1)
@pytest.mark.parametrize("record", ["1-baseline", "2-vibrations"])
def test_good_real_record_has_only_a_lag(ntnu: Path, tmp_path: Path, record: str) -> None:
    path = ntnu_log(ntnu, tmp_path, record, frame=NTNU_FRAME)
    summary = inspect_command(path, tmp_path, quiet=True)
    assert [found["name"] for found in summary["findings"]] == ["lag"]
    assert summary["delay_s"] == pytest.approx(0.006, abs=1e-3)


@pytest.mark.slow
def test_mounting_of_a_real_imu_is_found(ntnu: Path, tmp_path: Path) -> None:
    summary = inspect_command(ntnu_log(ntnu, tmp_path, "1-baseline"), tmp_path, quiet=True)
    assert [found["name"] for found in summary["findings"]] == ["swapped axes", "lag"]
    np.testing.assert_allclose(summary["mounting"]["R_SI"], NTNU_FRAME, atol=0.03)
    assert summary["mounting"]["right_angled"]
    assert summary["delay_s"] == pytest.approx(0.006, abs=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("streams", [pytest.param({}, marks=pytest.mark.slow), {"pose": False}])
def test_reversed_gravity_is_not_reported_as_axes_and_a_torque_factor(
    tmp_path: Path, streams: dict[str, bool]
) -> None:
    """Mirrored axes explain the weight, but would make the inertia negative."""
    columns = good()
    planted.reversed_gravity(columns)
    with pytest.raises(DrakeTeleopError, match=r"gravity is reversed; set imu\.sign: -1"):
        identify_log(written(tmp_path, columns, **streams))


@pytest.mark.parametrize("streams", [{}, {"pose": False}, {"imu": False}])
def test_constant_wrench_is_named(tmp_path: Path, streams: dict[str, bool]) -> None:
    columns = good()
    columns["force"][:], columns["torque"][:] = 1.0, 0.1
    assert set(findings(tmp_path, columns, **streams)) == {"dead channel"}


@pytest.mark.slow
def test_edited_draft_is_kept(tmp_path: Path) -> None:
    """An unchanged draft is replaced, also by that of another table."""
    c = good()
    data = {"t": c["t"]}
    for key, x in (("F", c["force"]), ("T", c["torque"]), ("acc_", c["s"]), ("w", c["omega"])):
        data |= {f"{key}{axis}": x[:, i] for i, axis in enumerate("xyz")}
    pl.DataFrame(data).write_csv(tmp_path / "a.csv")
    pl.DataFrame(data).head(100).write_csv(tmp_path / "b.csv")
    for table in ("a.csv", "b.csv", "b.csv"):
        summary = inspect_command(tmp_path / table, tmp_path / "out", quiet=True)
        assert summary["draft"] == str(tmp_path / "out/draft.yaml")
        assert table in (tmp_path / "out/draft.yaml").read_text()
    for name in ("draft", "draft-2"):
        path = tmp_path / f"out/{name}.yaml"
        path.write_text(path.read_text().replace("unit: N\n", "unit: kN\n") + "# mine\n")
        edited = path.read_text()
        summary = inspect_command(tmp_path / "a.csv", tmp_path / "out", quiet=True)
        assert summary["draft"] != str(path) and load_description(summary["draft"]).wrench
        assert path.read_text() == edited
    assert sorted(path.name for path in (tmp_path / "out").glob("*.yaml")) == [
        "draft-2.yaml",
        "draft-3.yaml",
        "draft.yaml",
    ]
