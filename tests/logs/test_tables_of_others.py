"""Tables as recorders, robots and data sets write them: conventions, clocks, formats, drafts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from known_motion import quaternions
from planted import PHI, good
from scipy.spatial.transform import Rotation

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.rotations import EULER_AXIS_SEQUENCES, rotation_matrices
from drake_teleop.logs.check.draft import draft_description
from drake_teleop.logs.check.edits import (
    edit_with_opposite_wrench_sign,
    orientation_and_gravity_sign_edits,
)
from drake_teleop.logs.inspection import inspect_command
from drake_teleop.logs.processing import eliminate_log, identify_log
from drake_teleop.logs.read.clocks import join_episodes, read_clock
from drake_teleop.logs.read.description import Time, load_description
from drake_teleop.logs.read.reading import read_log
from drake_teleop.logs.read.table_files import read_table
from drake_teleop.logs.read.tables import Table

FORCE, TORQUE = ["f0", "f1", "f2"], ["m0", "m1", "m2"]
TUM_POSE = ["tx", "ty", "tz", "qx", "qy", "qz", "qw"]
POSITION, QUATERNION = ["p0", "p1", "p2"], ["q0", "q1", "q2", "q3"]


def table(sign: float = 1.0, start: float = 0.0) -> pl.DataFrame:
    """Return a wrench and its pose in one table, 4 s at 500 Hz."""
    c = good(start=start)
    groups = {"f": sign * c["force"], "m": sign * c["torque"]}
    groups |= {"p": c["p"], "q": quaternions(c["R"])}
    columns = {f"{name}{k}": x[:, k] for name, x in groups.items() for k in range(x.shape[1])}
    return pl.DataFrame({"t": c["t"]} | columns)


def described(folder: Path, frame: pl.DataFrame, **changes: Any) -> Path:
    """Write table and description; `changes` replace fields such as wrench__force__unit."""
    frame.write_parquet(folder / "table.parquet")
    file = {"file": "table.parquet", "time": {"column": "t"}}
    data: dict[str, Any] = {
        "wrench": {**file, "force": {"columns": FORCE}, "torque": {"columns": TORQUE}},
        "pose": {
            **file,
            "orientation": {"columns": QUATERNION, "form": "quaternion_wxyz"},
            "position": {"columns": POSITION},
        },
    }
    data = yaml.safe_load(yaml.safe_dump(data))  # no shared dictionaries
    for path, value in changes.items():
        *outer, last = path.split("__")
        place = data
        for name in outer:
            place = place[name]
        place[last] = value
    (folder / "log.yaml").write_text(yaml.safe_dump(data))
    return folder / "log.yaml"


@pytest.mark.parametrize(
    ("force", "torque", "newton", "newton_metre"),
    [
        ("kgf", "kgf cm", 9.80665, 0.0980665),
        ("daN", "daN m", 10.0, 10.0),
        ("mN", "mN m", 1e-3, 1e-3),
        ("lbf", "lbf ft", 4.4482216152605, 1.3558179483314004),
        ("ozf", "ozf in", 4.4482216152605 / 16, 4.4482216152605 / 16 * 0.0254),
        ("gf", "gf cm", 9.80665e-3, 9.80665e-5),
        ("kN", "N cm", 1e3, 1e-2),
    ],
)
def test_units_of_the_trade_become_si(
    tmp_path: Path, force: str, torque: str, newton: float, newton_metre: float
) -> None:
    units = {"wrench__force__unit": force, "wrench__torque__unit": torque}
    whole = read_log(described(tmp_path, table()))
    scaled = table().with_columns(pl.col(FORCE) / newton, pl.col(TORQUE) / newton_metre)
    log = read_log(described(tmp_path, scaled, **units))
    np.testing.assert_allclose(log.wrench, whole.wrench, rtol=1e-12, atol=1e-12)


def test_one_reversed_channel_of_counts_is_described_by_factors(tmp_path: Path) -> None:
    whole = read_log(described(tmp_path, table()))
    counts = table().with_columns(pl.col(FORCE) * 1e6, pl.col(TORQUE) * 1e5)
    counts = counts.with_columns(f1=-pl.col("f1"))
    scales = {"wrench__force__scale": [1e-6, -1e-6, 1e-6], "wrench__torque__scale": 1e-5}
    log = read_log(described(tmp_path, counts, **scales))
    np.testing.assert_allclose(log.wrench, whole.wrench, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("unit", ["rad", "deg"])
@pytest.mark.parametrize("axes", ["xyz", "ZYX", "zyz", "XYZ"])
def test_euler_angles_give_the_orientation_of_the_quaternion(
    tmp_path: Path, axes: str, unit: str
) -> None:
    quaternion = table().select(QUATERNION).to_numpy()[:, [1, 2, 3, 0]]
    angles = Rotation.from_quat(quaternion).as_euler(axes, degrees=unit == "deg")
    named = {f"e{k}": angles[:, k] for k in range(3)}
    orientation = {"columns": list(named), "form": "euler", "axes": axes, "unit": unit}
    path = described(tmp_path, table().with_columns(**named), pose__orientation=orientation)
    expected = read_log(described(tmp_path, table()))
    (tmp_path / "euler").mkdir()
    path = described(
        tmp_path / "euler", table().with_columns(**named), pose__orientation=orientation
    )
    np.testing.assert_allclose(read_log(path).R_WS, expected.R_WS, atol=1e-9)


@given(st.sampled_from(EULER_AXIS_SEQUENCES), st.tuples(*[st.floats(-1.4, 1.4)] * 3))
def test_euler_matrices_are_products_of_rotations_about_the_axes(
    axes: str, angles: tuple[float, float, float]
) -> None:
    single = [
        rotation_matrices(np.array([angle * np.eye(3)["xyz".index(axis)]]), "rotation_vector")[0]
        for axis, angle in zip(axes.lower(), angles, strict=True)
    ]
    if axes.islower():  # fixed axes: later rotations from the left
        single = single[::-1]
    R = rotation_matrices(np.array([angles]), "euler", axes)[0]
    np.testing.assert_allclose(R, single[0] @ single[1] @ single[2], atol=1e-12)


@pytest.mark.parametrize(
    ("orientation", "words"),
    [
        ({"form": "euler"}, "needs axes"),
        ({"form": "euler", "axes": "xxz"}, "are not known"),
        ({"form": "euler", "axes": "xYz"}, "are not known"),
        ({"form": "rotation_vector", "axes": "xyz"}, "other forms have none"),
    ],
)
def test_euler_axes_are_checked(tmp_path: Path, orientation: dict[str, str], words: str) -> None:
    columns = {"columns": ["q0", "q1", "q2"]}
    path = described(tmp_path, table(), pose__orientation=columns | orientation)
    with pytest.raises(DrakeTeleopError, match=words):
        read_log(path)


def test_seconds_and_nanoseconds_are_one_clock(tmp_path: Path) -> None:
    t = table()["t"].to_numpy()
    frame = table().with_columns(
        t=np.floor(t + 0.5 + 1.7e9), ns=np.round((t + 0.5) % 1.0 * 1e9).astype(np.int64)
    )
    time = {"column": "t", "nanoseconds": "ns"}
    log = read_log(described(tmp_path, frame, wrench__time=time, pose__time=time))
    whole = read_log(described(tmp_path, table()))
    np.testing.assert_allclose(log.t, whole.t, atol=1e-6)
    np.testing.assert_allclose(log.wrench, whole.wrench, atol=2e-3)
    wrong = {"column": "t", "nanoseconds": "ns", "unit": "ms"}
    with pytest.raises(DrakeTeleopError, match="column of seconds"):
        read_log(described(tmp_path, frame, wrench__time=wrong))


@pytest.mark.parametrize("decimated", [1, 3])
def test_rows_of_a_stream_are_those_in_which_its_columns_are_filled(
    tmp_path: Path, decimated: int
) -> None:
    """PlotJuggler, Foxglove and pandas.concat write several topics like this."""
    wrench = table().select("t", *FORCE, *TORQUE)
    pose = table().select("t", *POSITION, *QUATERNION).gather_every(decimated)
    pose = pose.with_columns(pl.col("t") + 3e-4)
    both = pl.concat([wrench, pose], how="diagonal").sort("t")
    mixed = read_log(described(tmp_path, both))
    apart = read_log(
        described(tmp_path, both, pose__time={"column": "t", "offset": 0.0})
    )  # the same clock, described explicitly
    np.testing.assert_array_equal(mixed.wrench, apart.wrench)
    found = identify_log(tmp_path / "log.yaml").identification
    assert found.mass == pytest.approx(PHI[0], abs=0.01)
    assert len(mixed) > 1900


@pytest.mark.parametrize("by_time", [False, True])
def test_rows_of_another_stream_are_no_gaps_at_a_constant_rate(
    tmp_path: Path, by_time: bool
) -> None:
    wrench = table().select("t", *FORCE, *TORQUE)
    pose = (
        table().select("t", *POSITION, *QUATERNION).gather_every(4).with_columns(pl.col("t") + 3e-4)
    )
    both = pl.concat([wrench, pose], how="diagonal")
    both = (both.sort("t") if by_time else both).drop("t")
    times = {"wrench__time": {"rate": 500.0}, "pose__time": {"rate": 125.0}}
    log = read_log(described(tmp_path, both, **times))
    assert log.t[0] == 0.0 and log.t[-1] == pytest.approx(3.99, abs=0.02)
    assert np.diff(log.t) == pytest.approx(2e-3, abs=1e-9)


def test_a_partly_filled_row_is_still_an_error(tmp_path: Path) -> None:
    frame = table().with_columns(f1=pl.when(pl.col("t") == 1.0).then(None).otherwise(pl.col("f1")))
    with pytest.raises(DrakeTeleopError, match="no finite number in 1 rows, the first is row 501"):
        read_log(described(tmp_path, frame))


def test_row_numbers_in_messages_are_those_of_the_file(tmp_path: Path) -> None:
    """One stream has rows of its own."""
    wrench = table().select("t", *FORCE, *TORQUE)
    pose = table().select("t", *POSITION, *QUATERNION)
    pose = pose.with_columns(q0=pl.when(pl.col("t") == 1.0).then(7.0).otherwise(pl.col("q0")))
    both = pl.concat([wrench, pose], how="diagonal")
    with pytest.raises(DrakeTeleopError, match=r"row 2501 of table\.parquet is not a rotation"):
        read_log(described(tmp_path, both))


@pytest.mark.slow
def test_episodes_follow_each_other_on_one_clock(tmp_path: Path) -> None:
    """Each starts at zero; differences across their boundaries are not used."""
    parts = [table(start=0.0), table(start=11.0), table(start=25.0)]
    path = described(tmp_path, pl.concat(parts))
    log = read_log(path)
    assert log.t[-1] == pytest.approx(3 * 3.998 + 2 * 1.0, abs=1e-6)
    assert any("starts 3 times" in note for note in log.notes)
    assert log.bridged is not None and log.bridged[np.searchsorted(log.t, 4.5)]
    found = identify_log(path)
    assert found.causes == ()
    assert found.identification.mass == pytest.approx(PHI[0], abs=5e-3)


@pytest.mark.filterwarnings("error")
def test_rows_without_a_finite_stamp_do_not_shorten_the_checks(tmp_path: Path) -> None:
    t = pl.col("t")
    frame = (
        table()
        .gather_every(5)[:80]
        .with_columns(t=pl.when(t.is_between(0.5, 0.525)).then(np.inf).otherwise(t))
    )
    summary = inspect_command(described(tmp_path, frame), tmp_path / "out", quiet=True)
    assert "unusable" not in [finding["name"] for finding in summary["findings"]]
    assert summary["fit"]["unexplained"] < 0.05


def test_episodes_in_several_files_are_refused(tmp_path: Path) -> None:
    path = described(tmp_path, pl.concat([table(), table(start=11.0)]))
    (tmp_path / "other.parquet").write_bytes((tmp_path / "table.parquet").read_bytes())
    text = yaml.safe_load(path.read_text())
    text["pose"]["file"] = "other.parquet"
    path.write_text(yaml.safe_dump(text))
    with pytest.raises(
        DrakeTeleopError, match="starts 2 times, which requires all streams in one file"
    ):
        read_log(path)


@pytest.mark.parametrize(
    ("t", "joined", "episodes"),
    [
        ([0, 1, 2, 3] * 8, 1, 1),  # too short to be episodes
        ([*range(40), *range(40)], 79 + 9, 2),
        ([*range(40), *range(1, 41)], 79 + 9, 2),
        ([*range(40), *range(20, 60)], 0, 1),  # a step back into the middle
        ([*range(20), 0, *range(21, 60)], 0, 1),  # one wrong stamp
    ],
)
def test_a_clock_starts_again_only_at_its_start(t: list[int], joined: float, episodes: int) -> None:
    result, found = join_episodes(np.array(t, float))
    assert found == episodes
    if episodes > 1:
        assert result[-1] == joined and (np.diff(result) > 0).all()
    else:
        np.testing.assert_array_equal(result, t)


@pytest.mark.parametrize("suffix", [".parquet", ".arrow", ".jsonl", ".npz", ".npy", ".h5", ".zarr"])
def test_formats_hold_the_same_columns(tmp_path: Path, suffix: str) -> None:
    t, w = np.arange(20) * 0.01, np.arange(120.0).reshape(20, 6)
    path = tmp_path / f"table{suffix}"
    frame = pl.DataFrame({"t": t, "w": w.tolist()})
    if suffix == ".h5":
        h5py = pytest.importorskip("h5py")
        with h5py.File(path, "w") as file:
            file["t"], file["w"], file["a/b"] = t, w, t
            file["image"] = np.zeros((20, 8, 8, 3), np.uint8)
    elif suffix == ".zarr":
        zarr = pytest.importorskip("zarr")
        group = zarr.open_group(path, mode="w")
        for name, data in (("t", t), ("w", w), ("a/b", t)):
            group.create_array(name, data=data)
    elif suffix == ".npz":
        np.savez(path, t=t, w=w)
    elif suffix == ".npy":
        np.save(path, np.column_stack([t, w]))
    else:
        write = {".parquet": frame.write_parquet, ".arrow": frame.write_ipc}
        write.get(suffix, frame.write_ndjson)(path)
    found = read_table(path)
    names = (
        ["0", *map(str, range(1, 7))] if suffix == ".npy" else ["t", *(f"w[{k}]" for k in range(6))]
    )
    np.testing.assert_array_equal(found.finite_numbers(names[:1], 1, "")[:, 0], t)
    np.testing.assert_array_equal(found.finite_numbers(names[1:], 6, ""), w)
    if suffix in (".h5", ".zarr"):
        np.testing.assert_array_equal(found.finite_numbers(["a.b"], 1, "")[:, 0], t)
        assert "image" not in found.columns


def test_structures_become_columns_and_other_columns_are_left_out(tmp_path: Path) -> None:
    frame = pl.DataFrame(
        {
            "wrench": [{"force": {"x": float(k)}, "note": "a"} for k in range(20)],
            "image": [{"bytes": b"\xff\xd8", "path": None}] * 20,
            "ragged": [[1.0] * (k % 3) for k in range(20)],
            "holed": [[float(k), 1.0] if k % 5 else None for k in range(20)],
        }
    )
    frame.write_parquet(tmp_path / "table.parquet")
    found = read_table(tmp_path / "table.parquet")
    np.testing.assert_array_equal(
        found.finite_numbers(["wrench.force.x"], 1, "")[:, 0], np.arange(20.0)
    )
    assert "ragged" not in found.columns and "image.bytes" not in found.columns
    assert (
        np.isnan(found.numbers_with_nan("holed[0]", "")[0, 0])
        and found.numbers_with_nan("holed[0]", "")[1, 0] == 1.0
    )


def test_hdf5_data_in_other_files_are_not_read(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    secret = tmp_path / "secret.bin"
    secret.write_bytes(b"\0" * 160)
    with h5py.File(tmp_path / "table.h5", "w") as file:
        file["t"] = np.arange(20.0)
        file.create_dataset("x", (20,), "f8", external=[(str(secret), 0, 160)])
    with pytest.raises(DrakeTeleopError, match="is in another file"):
        read_table(tmp_path / "table.h5")


def drafted(*tables: Path) -> tuple[dict[str, Any], list[str]]:
    """Return the draft for tables, and the names of the remaining findings."""
    out = tables[0].parent / "out"
    summary = inspect_command(tables[0], out, others=tables[1:], quiet=True)
    draft = yaml.safe_load((out / "draft.yaml").read_text())
    return draft, [finding["name"] for finding in summary["findings"]]


def renamed(frame: pl.DataFrame, names: dict[str, str]) -> pl.DataFrame:
    return frame.select([pl.col(old).alias(new) for old, new in names.items()])


@pytest.mark.parametrize(
    ("times", "unit"),
    [(np.arange(60) * 10.0, "ms"), (np.arange(60) * 0.01 + 5.0, "s"), (None, None)],
)
def test_time_is_the_column_that_increases_evenly(
    tmp_path: Path, times: np.ndarray | None, unit: str | None
) -> None:
    """Counters of rows and unevenly increasing values are not times."""
    uneven = np.cumsum(np.tile([0.1, 2.0], 30))
    columns = {"frame_index": np.arange(60), "F_sum": uneven}
    columns |= {} if times is None else {"Zeit": times}
    columns |= dict.fromkeys(["Fx", "Fy", "Fz", "Tx", "Ty", "Tz"], np.sin(uneven))
    pl.DataFrame(columns).write_csv(path := tmp_path / "x.csv")
    time = draft_description(read_table(path), tmp_path).streams["wrench"]["time"]
    assert time == ({"column": "FILL IN"} if unit is None else {"column": "Zeit", "unit": unit})


def test_units_at_the_end_of_names_are_drafted(tmp_path: Path) -> None:
    names = "t_s Fx_N Fy_N Fz_N Mx_Nm My_Nm Mz_Nm x_mm y_mm z_mm roll_deg pitch_deg yaw_deg"
    values = np.random.default_rng(0).normal(size=(60, 13)) + np.arange(60)[:, None]
    path = tmp_path / "x.csv"
    pl.DataFrame(values, schema=names.split(), orient="row").write_csv(path)
    draft = draft_description(read_table(path), tmp_path).streams
    found = [draft["wrench"]["force"], draft["wrench"]["torque"], draft["pose"]["position"]]
    assert [each["unit"] for each in found] == ["N", "N m", "mm"]
    assert found[1]["columns"] == ["Mx_Nm", "My_Nm", "Mz_Nm"]
    assert draft["pose"]["orientation"]["columns"] == ["roll_deg", "pitch_deg", "yaw_deg"]
    assert draft["pose"]["orientation"]["unit"] == "deg"


def test_force_without_torque_is_reported_as_incomplete(tmp_path: Path) -> None:
    columns = {"t": np.arange(60) * 0.01, **dict.fromkeys(["Fx", "Fy", "Fz"], np.ones(60))}
    pl.DataFrame(columns).write_csv(path := tmp_path / "x.csv")
    draft = draft_description(read_table(path), tmp_path)
    assert "A force alone is not enough: the commands need force and torque." in draft.text()


@pytest.mark.slow
def test_two_tables_give_one_draft_with_the_sign_of_the_data(tmp_path: Path) -> None:
    """A trajectory of TUM has a position tx ty tz, which is no torque."""
    frame = table(sign=-1.0)
    ft = {
        "t": "timestamp",
        **dict(zip([*FORCE, *TORQUE], ["fx", "fy", "fz", "tx", "ty", "tz"], strict=True)),
    }
    order = [*POSITION, *QUATERNION[1:], QUATERNION[0]]
    pose = {
        "t": "timestamp",
        **dict(zip(order, TUM_POSE, strict=True)),
    }
    renamed(frame, ft).write_csv(tmp_path / "ft.csv")
    renamed(frame, pose).write_csv(tmp_path / "pose.csv")
    for first, second in (("ft", "pose"), ("pose", "ft")):
        draft, left = drafted(tmp_path / f"{first}.csv", tmp_path / f"{second}.csv")
        assert draft["pose"]["position"]["columns"] == ["tx", "ty", "tz"]
        assert draft["wrench"]["torque"]["columns"] == ["tx", "ty", "tz"]
        assert draft["wrench"]["file"].endswith("ft.csv") and draft["wrench"]["sign"] == -1
        assert left == []
    found = identify_log(tmp_path / "out" / "draft.yaml").identification
    assert found.mass == pytest.approx(PHI[0], abs=5e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("names", "axes", "guessed", "unit"),
    [
        (("roll", "pitch", "yaw"), "xyz", "xyz", "deg"),
        (("A", "B", "C"), "ZYX", "ZYX", "deg"),
        (("tool_roll", "tool_pitch", "tool_yaw"), "XYZ", "xyz", "rad"),  # corrected by the data
    ],
)
def test_the_order_of_euler_angles_is_that_of_the_data(
    tmp_path: Path, names: tuple[str, ...], axes: str, guessed: str, unit: str
) -> None:
    frame = table()
    quaternion = frame.select(QUATERNION).to_numpy()[:, [1, 2, 3, 0]]
    angles = Rotation.from_quat(quaternion).as_euler(axes, degrees=unit == "deg")
    columns = {
        "t": "time",
        **dict(zip([*FORCE, *TORQUE], ["Fx", "Fy", "Fz", "Tx", "Ty", "Tz"], strict=True)),
    }
    written = renamed(frame, columns | dict(zip(POSITION, "xyz", strict=True)))
    written = written.with_columns(**{name: angles[:, k] for k, name in enumerate(names)})
    written.write_csv(tmp_path / "table.csv")
    draft, left = drafted(tmp_path / "table.csv")
    orientation = draft["pose"]["orientation"]
    assert orientation["columns"] == list(names) and orientation["unit"] == unit
    assert orientation["axes"] == axes and left == []
    text = (tmp_path / "out" / "draft.yaml").read_text()
    assert ("Corrected by the data: the Euler angles" in text) == (axes != guessed)


@pytest.mark.slow
@pytest.mark.quick_cases(2)
@pytest.mark.parametrize(
    ("names", "order", "form"),
    [
        (("q1", "q2", "q3", "q4"), (0, 1, 2, 3), "quaternion_wxyz"),  # as ABB writes them
        (("q1", "q2", "q3", "q4"), (1, 2, 3, 0), "quaternion_xyzw"),  # corrected by the data
        (
            ("tool_quat_0", "tool_quat_1", "tool_quat_2", "tool_quat_3"),
            (0, 1, 2, 3),
            "quaternion_wxyz",
        ),
    ],
)
def test_numbered_quaternions_are_drafted(
    tmp_path: Path, names: tuple[str, ...], order: tuple[int, ...], form: str
) -> None:
    frame = table()
    columns = {"t": "time", **dict(zip(POSITION, "xyz", strict=True))}
    columns |= dict(zip([*FORCE, *TORQUE], ["Fx", "Fy", "Fz", "Tx", "Ty", "Tz"], strict=True))
    columns |= dict(zip([QUATERNION[k] for k in order], names, strict=True))
    written = renamed(frame, columns)
    joints = {f"joint_{k}": 0.3 * k + frame["t"] for k in range(4)}  # no quaternion
    written.with_columns(**joints).write_csv(tmp_path / "table.csv")
    draft, left = drafted(tmp_path / "table.csv")
    assert draft["pose"]["orientation"] == {"columns": list(names), "form": form}
    assert draft["pose"]["position"]["columns"] == ["x", "y", "z"] and left == []


_XYZ = ("x", "y", "z")
POSE_NAMES = {  # of robots and recorders: position, orientation, and its drafted form
    "KUKA": ([f"RIst.{x}" for x in "XYZ"], [f"RIst.{x}" for x in "ABC"], ("euler", "ZYX")),
    "xArm": (
        [f"pose_{x}" for x in _XYZ],
        ["pose_roll", "pose_pitch", "pose_yaw"],
        ("euler", "xyz"),
    ),
    "Kinova": ([f"tool_pose_{x}" for x in _XYZ], [f"tool_pose_theta_{x}" for x in _XYZ], None),
    "Denso": ([f"P{x}[mm]" for x in "XYZ"], [f"R{x}[deg]" for x in "XYZ"], None),
    "Doosan": (
        [f"posx_{k}" for k in (0, 1, 2)],
        [f"posx_{k}" for k in (3, 4, 5)],
        ("euler", "ZYZ"),
    ),
    "ABB EGM": ([f"cartesian.pos.{x}" for x in _XYZ], [f"orient.u{k}" for k in range(4)], ()),
    "MATLAB": ([f"Pos_{k}" for k in (1, 2, 3)], [f"Quat_{k}" for k in (1, 2, 3, 4)], ()),
    "tf": ([f"tf/translation/{x}" for x in _XYZ], [f"tf/rotation/{x}" for x in "wxyz"], ()),
}


@pytest.mark.parametrize("name", POSE_NAMES)
def test_names_of_poses_are_drafted(tmp_path: Path, name: str) -> None:
    position, orientation, form = POSE_NAMES[name]
    t = np.arange(60) * 0.01
    columns = {"datetime": t} | {f"Force_{k}": np.sin(k + t) for k in (1, 2, 3)}
    columns |= {f"Torque_{k}": np.cos(k + t) for k in (1, 2, 3)}
    columns |= {name: np.sin(k + t) for k, name in enumerate(position)}
    columns |= {name: np.full(60, 0.5) for name in orientation}
    pl.DataFrame(columns).write_csv(path := tmp_path / "x.csv")
    streams = draft_description(read_table(path), tmp_path).streams
    found = streams["pose"]["orientation"]
    assert streams["pose"]["position"]["columns"] == position
    assert found["columns"] == orientation
    default = ("rotation_vector",) if form is None else ("quaternion_wxyz",)
    assert tuple(found[x] for x in ("form", "axes") if x in found) == (form or default)
    assert streams["wrench"]["force"]["columns"] == ["Force_1", "Force_2", "Force_3"]
    assert streams["wrench"]["torque"]["columns"] == ["Torque_1", "Torque_2", "Torque_3"]
    assert {stream["time"]["column"] for stream in streams.values()} == {"datetime"}


@pytest.mark.parametrize("axes", ["xyz", "ZYX", "ZYZ"])
@pytest.mark.parametrize("unit", ["rad", "deg"])
def test_one_correction_of_a_rotation_vector_states_euler_angles(
    tmp_path: Path, axes: str, unit: str
) -> None:
    orientation = {"columns": POSITION, "form": "rotation_vector", "unit": unit}
    path = described(tmp_path, table(), pose__orientation=orientation)
    edits = list(orientation_and_gravity_sign_edits(load_description(path)))
    fields = {"pose.orientation.form": "euler", "pose.orientation.axes": axes}
    (edited,) = [description for finding, description in edits if finding.fields == fields]
    assert edited.pose is not None and edited.pose.orientation.form == "euler"
    assert edited.pose.orientation.axes == axes and edited.pose.orientation.unit == unit


@pytest.mark.slow
@pytest.mark.parametrize(("axes", "sign"), [("xyz", -1), ("ZYX", 1), ("XYZ", -1)])
def test_rx_ry_rz_can_be_euler_angles(tmp_path: Path, axes: str, sign: int) -> None:
    frame = table(sign=float(sign))
    quaternion = frame.select(QUATERNION).to_numpy()[:, [1, 2, 3, 0]]
    angles = Rotation.from_quat(quaternion).as_euler(axes, degrees=True)
    columns = {"t": "t", **dict(zip(POSITION, _XYZ, strict=True))}
    columns |= dict(zip([*FORCE, *TORQUE], ["Fx", "Fy", "Fz", "Mx", "My", "Mz"], strict=True))
    written = renamed(frame, columns)
    written = written.with_columns(**{f"r{x}": angles[:, k] for k, x in enumerate(_XYZ)})
    written.write_csv(tmp_path / "table.csv")
    draft, left = drafted(tmp_path / "table.csv")
    found = draft["pose"]["orientation"]
    assert [found[x] for x in ("form", "axes", "unit")] == ["euler", axes, "deg"]
    assert draft["wrench"]["sign"] == sign and left == []


@pytest.mark.parametrize("texts", [["ft_link"], [], ["a", "b"]])
def test_first_line_of_numbers_is_no_header(tmp_path: Path, texts: list[str]) -> None:
    """`ros2 topic echo --csv` writes seconds, nanoseconds, the frame and numbers without names."""
    rows = [["170", str(k), *texts, *(f"{k + i}.5" for i in range(6))] for k in range(1, 30)]
    (tmp_path / "x.csv").write_text("\n".join(map(",".join, rows)))
    draft, _ = drafted(tmp_path / "x.csv")
    assert draft["wrench"]["header"] is False


@pytest.mark.slow
@pytest.mark.quick_cases(1)
@pytest.mark.parametrize(
    ("sign", "push"),
    [
        (1, 0.0),
        (-1, 50.0),
        (-1, 0.0),
        (1, 50.0),
    ],
)
def test_order_of_quaternions_and_sign_are_found_together(
    tmp_path: Path, sign: int, push: float
) -> None:
    """Contact leaves more than the residual that a valid description may have."""
    frame = table(sign=float(sign))
    touched = np.abs(frame["t"].to_numpy() - 2.0) < 0.35
    frame = frame.with_columns(pl.col(FORCE[1]) + pl.Series(push * touched))
    arrays = {"wrench": [*FORCE, *TORQUE], "eef_pos": POSITION}
    arrays |= {"eef_quat": [*QUATERNION[1:], QUATERNION[0]]}
    lists = {name: frame.select(x).to_numpy().tolist() for name, x in arrays.items()}
    pl.DataFrame({"timestamp": frame["t"]} | lists).write_parquet(tmp_path / "run.parquet")
    draft, _ = drafted(tmp_path / "run.parquet")
    assert draft["pose"]["orientation"]["form"] == "quaternion_xyzw"
    assert draft["wrench"]["sign"] == sign


def test_a_correction_with_the_opposite_sign_states_both(tmp_path: Path) -> None:
    description = load_description(described(tmp_path, table()))
    finding, edited = next(
        x
        for x in orientation_and_gravity_sign_edits(description)
        if x[0].name == "quaternion order"
    )
    both, changed = edit_with_opposite_wrench_sign(finding, edited)
    assert both.fields == {"pose.orientation.form": "quaternion_xyzw", "wrench.sign": -1}
    assert changed.wrench is not None and changed.wrench.sign == -1
    assert changed.pose == edited.pose and both.message.endswith("and wrench.sign: -1")


@pytest.mark.parametrize(
    ("name", "form"), [("xyzw", "quaternion_xyzw"), ("wxyz", "quaternion_wxyz")]
)
def test_name_of_an_array_states_the_order_of_its_quaternions(
    tmp_path: Path, name: str, form: str
) -> None:
    columns = {"t": np.arange(30) * 0.01, f"quaternion_{name}": [[0.5, 0.5, 0.5, 0.5]] * 30}
    columns |= {"force": [[1.0, 2.0, 3.0]] * 30, "torque": [[0.1, 0.2, 0.3]] * 30}
    pl.DataFrame(columns).write_parquet(tmp_path / "x.parquet")
    pose = draft_description(read_table(tmp_path / "x.parquet"), tmp_path).streams["pose"]
    assert pose["orientation"] == {"columns": [f"quaternion_{name}"], "form": form}


def test_four_joint_angles_are_no_quaternion(tmp_path: Path) -> None:
    frame = table()
    columns = dict(zip([*FORCE, *TORQUE], ["Fx", "Fy", "Fz", "Tx", "Ty", "Tz"], strict=True))
    written = renamed(frame, {"t": "time", **columns})
    written = written.with_columns(**{f"q{k}": 0.3 * k + frame["t"] for k in range(1, 5)})
    written.write_csv(tmp_path / "table.csv")
    draft, _ = drafted(tmp_path / "table.csv")
    assert list(draft) == ["wrench"]


@pytest.mark.slow
def test_a_robot_learning_table_is_drafted(tmp_path: Path) -> None:
    frame = table()
    pose = frame.select(*POSITION, "q1", "q2", "q3", "q0").to_numpy()
    pl.DataFrame(
        {
            "observation.state": pose.tolist(),
            "observation.wrench": frame.select(*FORCE, *TORQUE).to_numpy().tolist(),
            "timestamp": frame["t"],
            "episode_index": np.zeros(len(frame), np.int64),
        }
    ).write_parquet(tmp_path / "table.parquet")
    draft, left = drafted(tmp_path / "table.parquet")
    assert draft["pose"]["orientation"]["form"] == "quaternion_xyzw" and left == []
    assert draft["pose"]["position"]["columns"][2] == "observation.state[2]"
    assert draft["wrench"]["torque"]["columns"][0] == "observation.wrench[3]"
    found = identify_log(tmp_path / "out" / "draft.yaml").identification
    assert found.mass == pytest.approx(PHI[0], abs=5e-3)


def test_scale_of_raw_counts_is_a_placeholder(tmp_path: Path) -> None:
    names = dict(zip([*FORCE, *TORQUE], ["Fx", "Fy", "Fz", "Tx", "Ty", "Tz"], strict=True))
    frame = renamed(
        table(), {"t": "t", **names, **dict(zip(QUATERNION, ["qw", "qx", "qy", "qz"], strict=True))}
    )
    counts = frame.with_columns((pl.col(*names.values()) * 1e6).round().cast(pl.Int64))
    counts.write_csv(tmp_path / "table.csv")
    draft, left = drafted(tmp_path / "table.csv")
    assert draft["wrench"]["force"]["scale"] == draft["wrench"]["torque"]["scale"] == "FILL IN"
    assert "incomplete" in left
    assert "1e-6 for 1000000 counts per N" in (tmp_path / "out" / "draft.yaml").read_text()


def test_a_short_table_without_time_has_poses_at_rest(tmp_path: Path) -> None:
    rest = table().gather_every(200)
    names = dict(zip([*FORCE, *TORQUE], ["fx", "fy", "fz", "tx", "ty", "tz"], strict=True))
    renamed(
        rest, {**names, **dict(zip(QUATERNION, ["qw", "qx", "qy", "qz"], strict=True))}
    ).write_csv(tmp_path / "poses.csv")
    draft, _ = drafted(tmp_path / "poses.csv")
    assert list(draft) == ["static"] and "time" not in draft["static"]
    assert draft["static"]["orientation"]["columns"] == ["qw", "qx", "qy", "qz"]


@pytest.mark.slow
def test_offsets_are_from_free_motion_or_the_load_file(tmp_path: Path) -> None:
    path = described(tmp_path, table())
    load = identify_log(path).identification
    t = pl.col("t")
    pushed = pl.when(t > 1.0).then(pl.col("f2") + 5.0).otherwise(pl.col("f2"))
    path = described(tmp_path, table().with_columns(f2=pushed + 0.7))  # contact in most of it
    contact = {
        name: eliminate_log(path, load, **options).contact[:, 2]
        for name, options in (
            ("record", {}),
            ("untouched", {"untouched_s": (0.2, 0.9)}),
            ("load", {"tare": False}),
        )
    }
    late = slice(-1000, -100)
    assert contact["untouched"][late].mean() == pytest.approx(5.0, abs=0.1)
    assert contact["load"][late].mean() == pytest.approx(5.7, abs=0.1)
    assert abs(contact["record"][late].mean()) < 1.0  # most of the record decides
    for span, words in (((5.0, 9.0), "has 0 samples"), ((1.0, 1.001), "samples")):
        with pytest.raises(DrakeTeleopError, match=words):
            eliminate_log(path, load, untouched_s=span)
    with pytest.raises(DrakeTeleopError, match="remove one of the two"):
        eliminate_log(path, load, untouched_s=(0.2, 0.9), tare=False)


@pytest.mark.slow
@pytest.mark.quick_cases(1)
@pytest.mark.parametrize("stride", [2, 4, 8])
def test_arrays_of_different_length_in_a_file_have_rates(tmp_path: Path, stride: int) -> None:
    columns = table().drop("t").to_dict(as_series=False)
    arrays = {
        name: np.array(x)[:: 1 if name in (*FORCE, *TORQUE) else stride]
        for name, x in columns.items()
    }
    np.savez(tmp_path / "table.npz", **arrays)
    changes: dict[str, Any] = {"wrench__time": {"rate": 500}, "pose__time": {"rate": 500 / stride}}
    changes |= {f"{name}__file": "table.npz" for name in ("wrench", "pose")}
    path = described(tmp_path, table(), **changes)
    assert read_log(path).t[-1] == pytest.approx(4.0, abs=0.02)
    summary = inspect_command(path, tmp_path / "out", quiet=True)
    assert [each["duration_s"] for each in summary["streams"].values()] == pytest.approx(
        [4.0, 4.0], abs=0.02
    )
    assert summary["findings"] == []


@pytest.mark.slow
@pytest.mark.quick_cases(2)
@pytest.mark.parametrize(("unit", "scale"), [("us", 100.0), ("us", 1e3), ("ms", 0.01), ("s", 2e-3)])
def test_times_in_ticks_are_inspected_and_read(tmp_path: Path, unit: str, scale: float) -> None:
    """The pose begins later than the wrench, in a table of both."""
    tick_s = scale * {"s": 1.0, "ms": 1e-3, "us": 1e-6}[unit]
    wrench = table().select("t", *FORCE, *TORQUE)
    pose = table().select("t", *POSITION, *QUATERNION).gather_every(4, 200)
    both = pl.concat([wrench, pose], how="diagonal").sort("t")
    both = both.with_columns(pl.col("t") / tick_s)
    time = {"column": "t", "unit": unit, "scale": scale}
    path = described(tmp_path, both, wrench__time=time, pose__time=time)
    assert read_log(path).t[[0, -1]] == pytest.approx([0.4, 3.992], abs=1e-6)
    summary = inspect_command(path, tmp_path / "out", quiet=True)
    assert summary["findings"] == []
    assert summary["streams"]["wrench"]["rate_hz"] == pytest.approx(500.0)
    assert summary["streams"]["pose"]["duration_s"] == pytest.approx(3.592)
    assert abs(summary["delay_s"]) < 2e-4


@pytest.mark.parametrize(("unit", "scale"), [("s", 0.01), ("ms", 10.0), ("us", 100.0)])
def test_episodes_in_ticks_are_a_second_apart(unit: str, scale: float) -> None:
    tick_s = scale * {"s": 1.0, "ms": 1e-3, "us": 1e-6}[unit]
    ticks = np.tile(np.round(0.01 * np.arange(40) / tick_s), 2)
    time = Time.model_validate({"column": "t", "unit": unit, "scale": scale})
    clock = read_clock(time, Table(Path("x.csv"), {"t": ticks, "x": ticks}), ["x"], "here")
    assert clock.num_episodes == 2
    assert np.diff(clock.t).max() == pytest.approx(1.0)


def test_a_scaled_rate_is_checked() -> None:
    time = Time.model_validate({"column": "t", "unit": "ms", "scale": 500.0})
    t = np.arange(40.0) * 2.0
    with pytest.raises(DrakeTeleopError, match="the median step of the time stamps is 1 s"):
        read_clock(time, Table(Path("x.csv"), {"t": t, "x": t}), ["x"], "here")


@pytest.mark.quick_cases(3)
@pytest.mark.parametrize("column", ["f1", "m0", "m2"])
@pytest.mark.parametrize("decimated", [1, 4])
def test_dead_channel_beside_rows_of_another_stream_is_named(
    tmp_path: Path, column: str, decimated: int
) -> None:
    wrench = table().select("t", *FORCE, *TORQUE).with_columns(pl.lit(5.0).alias(column))
    pose = table().select("t", *POSITION, *QUATERNION).gather_every(decimated)
    both = pl.concat([wrench, pose.with_columns(pl.col("t") + 3e-4)], how="diagonal")
    path = described(tmp_path, both.sort("t"))
    summary = inspect_command(path, tmp_path / "out", quiet=True)
    messages = {each["name"]: each["message"] for each in summary["findings"]}
    assert messages["dead channel"].startswith(f"'{column}' is 5 in all rows")


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("step", "unit"), [(2e-3, "s"), (2.0, "ms"), (2e3, "us"), (2e6, "ns")])
@pytest.mark.parametrize("stride", [2, 3])
def test_unit_of_time_is_drafted_beside_empty_cells(
    tmp_path: Path, step: float, unit: str, stride: int
) -> None:
    """Rows with a wrench alternate with those of other streams."""
    rows = np.arange(120)
    filled = rows % stride == 0
    names = ["ft.time", *(f"ft.force.{x}" for x in "xyz"), *(f"ft.torque.{x}" for x in "xyz")]
    columns = {name: np.where(filled, np.cos(rows), np.nan) for name in names}
    columns["ft.time"] = np.where(filled, rows * step / stride, np.nan)
    draft = draft_description(Table(tmp_path / "x.csv", columns), tmp_path)
    assert draft.streams["wrench"]["time"] == {"column": "ft.time", "unit": unit}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("row", [0, 3, 11])
@pytest.mark.parametrize("sensor", ["gravity", "specific_force"])
def test_pose_at_rest_without_gravity_is_no_crash(tmp_path: Path, row: int, sensor: str) -> None:
    g = 9.81 * Rotation.random(12, random_state=3).as_matrix()[:, 2]
    g[row] = 0.0
    columns = dict(zip("abcdefghi", np.hstack([g, 2.0 * g + 1.0, 0.1 * g]).T, strict=True))
    pl.DataFrame(columns).write_csv(tmp_path / "x.csv")
    groups = {sensor: "abc", "force": "def", "torque": "ghi"}
    static = {name: {"columns": list(letters)} for name, letters in groups.items()}
    (tmp_path / "x.yaml").write_text(yaml.safe_dump({"static": {"file": "x.csv", **static}}))
    summary = inspect_command(tmp_path / "x.yaml", tmp_path / "out", quiet=True)
    assert "unusable" not in [finding["name"] for finding in summary["findings"]]


@pytest.mark.slow
@pytest.mark.parametrize(("first", "last"), [(1.0, 1.3), (0.5, 2.1)])
def test_gaps_of_episodes_do_not_include_those_between_them(
    tmp_path: Path, first: float, last: float
) -> None:
    whole = table(start=0.0)
    cut = whole.filter(~pl.col("t").is_between(first, last))
    path = described(tmp_path, pl.concat([whole, cut, whole]))
    (note,) = (note for note in read_log(path).notes if note.startswith("wrench: "))
    length = last - first + 0.004
    assert f"1 gaps, the longest of {length:.3g} s at {3.998 + 1.0 + first - 0.002:.3g} s" in note
    summary = inspect_command(path, tmp_path / "out", quiet=True)
    assert summary["streams"]["wrench"]["gaps"] == 1
    assert summary["streams"]["wrench"]["longest_gap_s"] == pytest.approx(length, abs=1e-6)
    assert f"the longest {length:.3g} s at {4.996 + first:.3g} s" in str(summary["findings"])


@pytest.mark.parametrize("column", ["f1", "q2"])
def test_rows_with_nan_keep_the_times_of_a_stream_without_stamps_in_their_table(
    tmp_path: Path, column: str
) -> None:
    lost = pl.int_range(pl.len()).is_between(600, 700)
    frame = table().with_columns(pl.when(lost).then(None).otherwise(column).alias(column))
    path = described(tmp_path, frame, wrench__time={"rate": 500.0})
    summary = inspect_command(path, tmp_path / "out", quiet=True)
    names = [finding["name"] for finding in summary["findings"]]
    assert names[0] == "nan" and set(names) <= {"nan", "gap"}
    assert "empty or repair them" in summary["findings"][0]["message"]
    assert abs(summary["delay_s"]) < 1e-3


@pytest.mark.parametrize("lost", [20, 400])
def test_rows_with_nan_of_a_stream_without_stamps_keep_the_times_of_others(
    tmp_path: Path, lost: int
) -> None:
    row = pl.int_range(pl.len())
    frame = table().with_columns(
        f1=pl.when(row.is_between(600, 599 + lost)).then(None).otherwise("f1")
    )
    frame.select(FORCE + TORQUE).write_parquet(tmp_path / "wrench.parquet")
    path = described(tmp_path, frame, wrench__time={"rate": 500.0}, wrench__file="wrench.parquet")
    summary = inspect_command(path, tmp_path / "out", quiet=True)
    assert [finding["name"] for finding in summary["findings"]] == ["nan"]
    assert "empty or repair them" in summary["findings"][0]["message"]
    assert abs(summary["delay_s"]) < 1e-3
