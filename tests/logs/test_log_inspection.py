"""Errors planted one at a time into a good log are named; a good log raises none."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
import yaml
from known_motion import motion_at, quaternions

from drake_teleop.cli import main
from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.logs.description import load_description
from drake_teleop.logs.inspection import inspect_command

PHI = phi_from_mass_com_inertia(3.13, [0.01, -0.02, 0.12], np.diag([0.02, 0.018, 0.006]))
OFFSETS = np.array([3.0, -2.0, 7.0, 0.1, 0.2, -0.3])

Columns = dict[str, np.ndarray]


def good(*, delay_s: float = 0.0) -> Columns:
    """4 s at 500 Hz: a wrist sensor with an IMU and the pose of the arm, noise in all of them."""
    rng = np.random.default_rng(5)
    t = np.arange(0, 4, 2e-3)
    now, then = motion_at(t), motion_at(t - delay_s)
    wrench = non_contact_wrench(now.specific_force, now.omega, now.alpha, PHI) + OFFSETS
    return {
        "t": t,
        "force": wrench[:, :3] + 0.1 * rng.normal(size=(len(t), 3)),
        "torque": wrench[:, 3:] + 0.01 * rng.normal(size=(len(t), 3)),
        "s": then.specific_force + 0.06 * rng.normal(size=(len(t), 3)),
        "omega": then.omega + 2e-3 * rng.normal(size=(len(t), 3)),
        "R": then.R_WS,
        "p": then.p_WS + 1e-5 * rng.normal(size=(len(t), 3)),
    }


def written(folder: Path, columns: Columns, *, imu: bool = True, pose: bool = True) -> Path:
    """A log of these columns in a table for each stream, and its description."""
    t, q = columns["t"], quaternions(columns["R"])
    clock = columns.get("imu_t", t)
    stored = {
        "wrench": (t, {"f": columns["force"], "m": columns["torque"]}),
        "imu": (clock, {"a": columns["s"], "w": columns["omega"]}),
        "pose": (t, {"q": q, "p": columns["p"]}),
    }
    for name, (at, fields) in stored.items():
        data = {"t": at} | {f"{k}{i}": x[:, i] for k, x in fields.items() for i in range(len(x[0]))}
        pl.DataFrame(data).write_parquet(folder / f"{name}.parquet")

    def stream(name: str) -> dict[str, Any]:
        return {"file": f"{name}.parquet", "time": {"column": "t"}}

    def named(key: str, width: int = 3) -> dict[str, Any]:
        return {"columns": [f"{key}{i}" for i in range(width)]}

    data: dict[str, Any] = {
        "wrench": stream("wrench") | {"force": named("f"), "torque": named("m")}
    }
    if imu:
        data["imu"] = stream("imu") | {"specific_force": named("a"), "angular_velocity": named("w")}
    if pose:
        orientation = named("q", 4) | {"form": "quaternion_wxyz"}
        data["pose"] = stream("pose") | {"orientation": orientation, "position": named("p")}
    (folder / "log.yaml").write_text(yaml.safe_dump(data))
    return folder / "log.yaml"


def findings(folder: Path, columns: Columns, **streams: bool) -> dict[str, str]:
    summary = inspect_command(written(folder, columns, **streams), folder / "out", quiet=True)
    return {found["name"]: found["message"] for found in summary["findings"]}


def _sign(c: Columns) -> None:
    c["force"], c["torque"] = -c["force"], -c["torque"]


def _inverted(c: Columns) -> None:
    c["R"] = np.swapaxes(c["R"], 1, 2)


def _base(c: Columns) -> None:
    for key in ("force", "torque"):
        c[key] = np.einsum("nij,nj->ni", c["R"], c[key])


def _reversed(c: Columns) -> None:
    c["s"] = -c["s"]


def _in_g(c: Columns) -> None:
    c["s"] = c["s"] / 9.80665


def _degrees(c: Columns) -> None:
    c["omega"] = np.degrees(c["omega"])


def _swapped_wrench(c: Columns) -> None:
    c["force"], c["torque"] = c["force"][:, [1, 0, 2]], c["torque"][:, [1, 0, 2]]


def _swapped_imu(c: Columns) -> None:
    c["s"], c["omega"] = c["s"][:, [1, 0, 2]], c["omega"][:, [1, 0, 2]]


def _turned_imu(c: Columns) -> None:
    c["s"], c["omega"] = c["s"][:, [2, 0, 1]], c["omega"][:, [2, 0, 1]]


def _clock(c: Columns) -> None:
    c["imu_t"] = c["t"] + 0.3


def _repeated(c: Columns) -> None:
    for key in ("force", "torque"):
        c[key][300:320] = c[key][300]


def _nan(c: Columns) -> None:
    c["force"][500:540] = np.nan


def _saturated(c: Columns) -> None:
    c["force"][:, 2] = np.minimum(c["force"][:, 2], np.quantile(c["force"][:, 2], 0.95))


PLANTED: list[tuple[Callable[[Columns], None], str, str, dict[str, bool]]] = [
    (_sign, "sign", "wrench.sign: -1", {}),
    (_sign, "sign", "wrench.sign: -1", {"imu": False}),
    (_sign, "sign", "wrench.sign: -1", {"pose": False}),
    (_inverted, "inverted orientation", "pose.orientation.inverse: true", {}),
    (_inverted, "inverted orientation", "pose.orientation.inverse: true", {"imu": False}),
    (_base, "base axes", "wrench.frame: base", {}),
    (_base, "base axes", "wrench.frame: base", {"imu": False}),
    (_reversed, "reversed gravity", "imu.sign: -1", {}),
    (_reversed, "reversed gravity", "imu.sign: -1", {"pose": False}),
    (_in_g, "units", "imu.specific_force.unit: g", {}),
    (_in_g, "units", "imu.specific_force.unit: g", {"pose": False}),
    (_degrees, "degrees", "imu.angular_velocity.unit: deg/s", {}),
    (_degrees, "degrees", "imu.angular_velocity.unit: deg/s", {"pose": False}),
    (_swapped_wrench, "swapped axes", "wrench.force.columns: ['f1', 'f0', 'f2']", {}),
    (_swapped_imu, "swapped axes", "imu.specific_force.columns", {}),
    (_turned_imu, "swapped axes", "[[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]", {}),
    (_clock, "clock", "imu.time.offset", {}),
    (_repeated, "repeated rows", "delete", {}),
    (_nan, "nan", "40 rows", {}),
    (_saturated, "saturation", "f2", {}),
]


@pytest.mark.parametrize("streams", [{}, {"imu": False}, {"pose": False}])
def test_nothing_is_suspected_in_a_good_log(tmp_path: Path, streams: dict[str, bool]) -> None:
    assert findings(tmp_path, good(), **streams) == {}


@pytest.mark.parametrize(
    ("plant", "name", "says", "streams"),
    PLANTED,
    ids=["-".join([p[0].__name__.strip("_"), *p[3]]) for p in PLANTED],
)
def test_a_planted_error_is_named_and_no_other(
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


def test_a_lag_of_6_ms_is_named(tmp_path: Path) -> None:
    found = findings(tmp_path, good(delay_s=0.006))
    assert set(found) == {"lag"}
    assert "6.0 ms behind" in found["lag"]


def test_an_inverse_orientation_is_read(tmp_path: Path) -> None:
    columns = good()
    _inverted(columns)
    path = written(tmp_path, columns)
    data = yaml.safe_load(path.read_text())
    data["pose"]["orientation"]["inverse"] = True
    path.write_text(yaml.safe_dump(data))
    assert inspect_command(path, tmp_path / "out", quiet=True)["findings"] == []


def test_an_unknown_table_gets_a_draft(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
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


def test_unreadable_input_is_an_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as done:
        main(["inspect", str(tmp_path / "none.csv"), "--out", str(tmp_path)])
    assert done.value.code == 2
    assert "no such file" in capsys.readouterr().err


def _ntnu(folder: Path, tmp_path: Path, record: str, **imu: Any) -> Path:
    def stream(name: str) -> dict[str, Any]:
        return {"file": str(folder / f"{record}_{name}.csv"), "time": {"column": "t", "unit": "us"}}

    matrix = [f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)]
    accelerometer = {"columns": ["ax", "ay", "az"], "unit": "g", "bias": [-0.0037, 0.0088, 0.0771]}
    data = {
        "gravity": 9.82,
        "wrench": stream("wrench")
        | {
            "force": {"columns": ["fx", "fy", "fz"]},
            "torque": {"columns": ["tx", "ty", "tz"]},
            "sign": -1,
        },
        "imu": stream("accel") | {"specific_force": accelerometer} | imu,
        "pose": stream("orientations") | {"orientation": {"columns": matrix, "form": "matrix"}},
    }
    (tmp_path / "log.yaml").write_text(yaml.safe_dump(data))
    return tmp_path / "log.yaml"


FRAME = [[0, -1, 0], [0, 0, 1], [-1, 0, 0]]


@pytest.mark.parametrize("record", ["1-baseline", "2-vibrations"])
def test_a_good_real_record_has_its_lag_only(ntnu: Path, tmp_path: Path, record: str) -> None:
    path = _ntnu(ntnu, tmp_path, record, frame=FRAME)
    summary = inspect_command(path, tmp_path, quiet=True)
    assert [found["name"] for found in summary["findings"]] == ["lag"]
    assert summary["delay_s"] == pytest.approx(0.006, abs=1e-3)


def test_the_mounting_of_a_real_imu_is_found(ntnu: Path, tmp_path: Path) -> None:
    summary = inspect_command(_ntnu(ntnu, tmp_path, "1-baseline"), tmp_path, quiet=True)
    assert [found["name"] for found in summary["findings"]] == ["swapped axes", "lag"]
    np.testing.assert_allclose(summary["mounting"]["R_SI"], FRAME, atol=0.03)
    assert summary["mounting"]["right_angled"]
    assert summary["delay_s"] == pytest.approx(0.006, abs=1e-3)


@pytest.mark.parametrize(
    ("move", "force", "lag_s"),
    [
        ("No6_Acc_slow_Verify_Model", None, 0.22),
        ("No9_Singularity_Free_ForceSensor", "log_force_sensor", 0.11),
    ],
)
def test_the_clock_of_a_ur5_imu(
    ur5: Path, tmp_path: Path, move: str, force: str | None, lag_s: float
) -> None:
    def stream(name: str, unit: str) -> dict[str, Any]:
        file = str(ur5 / f"{move}__{name}.csv")
        return {"file": file, "header": False, "time": {"column": 0, "unit": unit}}

    # The force sensor was not connected in the first record: other columns stand in for it.
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
    assert "clock" in found
    if force:
        assert "payload not identifiable" in found["payload"]
