from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
import yaml
from known_motion import GRAVITY_W, Motion, motion_at, quaternions
from scipy.spatial.transform import Rotation

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.logs.read.alignment import low_pass
from drake_teleop.logs.read.canonical import (
    ANGULAR_ACCELERATION_COLUMNS,
    ANGULAR_VELOCITY_COLUMNS,
    POSITION_COLUMNS,
    QUATERNION_COLUMNS,
    SPECIFIC_FORCE_COLUMNS,
    WRENCH_COLUMNS,
    Log,
    write_log,
)
from drake_teleop.logs.read.reading import read_log
from drake_teleop.logs.read.streams import check_for_lost_readings
from drake_teleop.logs.read.tables import Table

T = np.arange(0, 3, 0.002)
TURNED = np.array([[0.0, -1, 0], [0, 0, 1], [-1, 0, 0]])


def smooth_wrench(motion: Motion) -> np.ndarray:
    """Return a smooth function of the motion, which makes clock errors visible."""
    return np.hstack([2 * motion.specific_force, 0.1 * motion.omega])


def make_log(t: np.ndarray = T) -> Log:
    motion = motion_at(t)
    return Log(t, smooth_wrench(motion), motion.specific_force, motion.omega, motion.alpha)


def canonical(*groups: str) -> pl.DataFrame:
    motion = motion_at(T)
    columns: dict[str, Any] = {"t": T} | dict(
        zip(WRENCH_COLUMNS, smooth_wrench(motion).T, strict=True)
    )
    for name, names, values in (
        ("s", SPECIFIC_FORCE_COLUMNS, motion.specific_force),
        ("omega", ANGULAR_VELOCITY_COLUMNS, motion.omega),
        ("alpha", ANGULAR_ACCELERATION_COLUMNS, motion.alpha),
        ("q", QUATERNION_COLUMNS, quaternions(motion.R_WS)),
        ("p", POSITION_COLUMNS, motion.p_WS),
    ):
        if name in groups:
            columns |= dict(zip(names, values.T, strict=True))
    return pl.DataFrame(columns)


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_written_canonical_log_reads_unchanged(tmp_path: Path, suffix: str) -> None:
    log = make_log(2.0 + T)
    path = tmp_path / f"log.{suffix}"
    write_log(log, path)
    found = read_log(path)
    np.testing.assert_array_equal(found.t, log.t)
    np.testing.assert_array_equal(found.wrench, log.wrench)
    for ours, theirs in zip(found.motion, log.motion, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert found.notes == ()
    with pytest.raises(DrakeTeleopError, match=r"name it \.csv or \.parquet"):
        write_log(log, tmp_path / "log.txt")


@pytest.mark.parametrize(
    "groups", [("q", "p"), ("s", "omega"), ("s", "q"), ("omega", "q", "p"), ("s", "omega", "alpha")]
)
def test_pose_replaces_missing_kinematics(tmp_path: Path, groups: tuple[str, ...]) -> None:
    canonical(*groups).write_parquet(tmp_path / "log.parquet")
    found = read_log(tmp_path / "log.parquet", bandwidth_hz=None)
    motion = motion_at(found.t)
    inner = slice(5, -5)
    np.testing.assert_allclose(found.specific_force[inner], motion.specific_force[inner], atol=1e-4)
    np.testing.assert_allclose(found.angular_velocity[inner], motion.omega[inner], atol=1e-5)
    np.testing.assert_allclose(found.angular_acceleration[inner], motion.alpha[inner], atol=1e-3)
    if "q" in groups:
        expected = np.einsum("nji,j->ni", motion.R_WS, GRAVITY_W)
        assert found.gravity is not None
        np.testing.assert_allclose(found.gravity, expected, atol=1e-9)


def test_orientation_without_position_sets_acceleration_to_zero_with_a_note(tmp_path: Path) -> None:
    canonical("q").write_csv(tmp_path / "log.csv")
    found = read_log(tmp_path / "log.csv")
    assert "acceleration of S is taken as zero" in found.notes[0]
    assert found.gravity is not None
    np.testing.assert_allclose(found.specific_force, -found.gravity, atol=1e-12)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda f: f.drop("f_x"), "no column 'f_x'; did you mean "),
        (lambda f: f.drop("s_z"), "no column 's_z'"),
        (lambda f: f.drop(*SPECIFIC_FORCE_COLUMNS), "without kinematics: no columns s_x s_y s_z"),
        (lambda f: f.drop(*ANGULAR_VELOCITY_COLUMNS), "no columns omega_x omega_y omega_z"),
        (lambda f: f.head(15), "15 samples in log.csv are too few"),
        (
            lambda f: f.with_columns(t=pl.col("t").reverse()),
            "1499 time stamps decrease, the first in row 3",
        ),
        (lambda f: pl.concat([f[:9], f[4:]]), "1 time stamps decrease, the first in row 11"),
        (lambda f: f.with_columns(s_x=pl.lit("?")), "log.csv:s_x: '?' in row 2 is not a number"),
        (lambda f: f.with_columns(f_x=pl.lit(float("nan"))), "no finite number in 1500 rows"),
    ],
)
def test_invalid_canonical_log_raises_error(
    tmp_path: Path, change: Callable[[pl.DataFrame], pl.DataFrame], words: str
) -> None:
    path = tmp_path / "log.csv"
    change(canonical("s", "omega")).write_csv(path)
    with pytest.raises(DrakeTeleopError) as error:
        read_log(path)
    assert str(error.value).startswith(str(path))
    assert words in str(error.value)
    assert ";" in str(error.value)


def test_unknown_file_format_raises_error(tmp_path: Path) -> None:
    (tmp_path / "log.xls").touch()
    with pytest.raises(DrakeTeleopError, match=r"'\.xls' is not known; give a canonical log"):
        read_log(tmp_path / "log.xls")
    with pytest.raises(DrakeTeleopError, match=r"my_log: no such file; check the path"):
        read_log(tmp_path / "my_log")
    (tmp_path / "log.csv").mkdir()
    for folder in (tmp_path, tmp_path / "log.csv"):
        with pytest.raises(DrakeTeleopError, match=r"is a folder, not a file; check the path"):
            read_log(folder)
    with pytest.raises(DrakeTeleopError, match=r"no topic of the bag .*; describe it"):
        read_log(tmp_path / "log.bag")


def write_streams(folder: Path, **changes: Any) -> Path:
    """Write three files with different clocks, units, axes and signs, and their description."""
    rng = np.random.default_rng(5)
    epoch = 1_700_000_000

    def stamps(rate: float, start: float) -> np.ndarray:
        t = np.arange(start, 3 + start, 1 / rate)
        return t + rng.uniform(-0.02, 0.02, len(t)) / rate

    t_wrench, t_imu, t_pose = stamps(700, 0.013), stamps(1500, 0.0), stamps(200, 0.031)
    wrench = smooth_wrench(motion_at(t_wrench))
    frame = pl.DataFrame({"time": np.rint((epoch + t_wrench) * 1e6).astype(np.int64)})
    frame = frame.with_columns(
        **{f"F{i}": -wrench[:, i] / 4.4482216152605 for i in range(3)},
        **{f"T{i}": -1e3 * wrench[:, 3 + i] for i in range(3)},
    )
    frame.write_csv(folder / "wrench.csv")

    motion = motion_at(t_imu)
    lever = np.array([0.05, -0.02, 0.03])
    s = motion.specific_force + np.cross(motion.alpha, lever)
    s += np.cross(motion.omega, np.cross(motion.omega, lever))
    s_imu, gyro = s @ TURNED, np.rad2deg(motion.omega @ TURNED) + np.array([1.0, -2.0, 3.0])
    np.savez(folder / "imu.npz", clock=(epoch + t_imu) * 1e3, a=-s_imu / 9.80665 + 0.1, w=gyro)

    motion = motion_at(t_pose)
    q = quaternions(motion.R_WS @ TURNED)
    columns = {"sec": t_pose} | {f"q{i}": q[:, i] for i in range(4)}
    pl.DataFrame(columns).write_parquet(folder / "pose.parquet")

    description: dict[str, Any] = {
        "wrench": {
            "file": "wrench.csv",
            "time": {"column": "time", "unit": "us"},
            "force": {"columns": ["F0", "F1", "F2"], "unit": "lbf"},
            "torque": {"columns": ["T0", "T1", "T2"], "unit": "N mm"},
            "sign": -1,
        },
        "imu": {
            "file": "imu.npz",
            "time": {"column": "clock", "unit": "ms"},
            "specific_force": {"columns": ["a"], "unit": "g", "bias": [0.1, 0.1, 0.1]},
            "angular_velocity": {"columns": ["w"], "unit": "deg/s", "bias": [1, -2, 3]},
            "sign": -1,
            "frame": TURNED.tolist(),
            "position": lever.tolist(),
        },
        "pose": {
            "file": "pose.parquet",
            "time": {"column": "sec", "offset": float(epoch)},
            "orientation": {"columns": ["q1", "q2", "q3", "q0"], "form": "quaternion_xyzw"},
            "frame": TURNED.tolist(),
        },
    }
    for place, value in changes.items():
        *parents, last = place.split("__")
        target = description
        for key in parents:
            target = target[key]
        target[last] = value
    path = folder / "log.yaml"
    path.write_text(yaml.safe_dump(description), encoding="utf-8")
    return path


def test_streams_with_different_clocks_units_axes_and_signs_give_one_log(tmp_path: Path) -> None:
    log = read_log(write_streams(tmp_path), bandwidth_hz=60.0)
    motion = motion_at(log.t + 0.013)
    inner = slice(40, -40)
    assert 1 / log.dt == pytest.approx(700, rel=0.01)
    assert log.t[0] == pytest.approx(0.018, abs=1 / 700)
    # Interpolation between jittered stamps limits the accuracy, not the conversions.
    for found, expected, tolerance in (
        (log.wrench, smooth_wrench(motion), 0.01),
        (log.specific_force, motion.specific_force, 0.02),
        (log.angular_velocity, motion.omega, 2e-3),
        (log.angular_acceleration, motion.alpha, 0.15),
        (log.gravity, np.einsum("nji,j->ni", motion.R_WS, GRAVITY_W), 5e-3),
    ):
        assert found is not None
        np.testing.assert_allclose(found[inner], expected[inner], atol=tolerance)
    assert log.notes == ()


def test_base_axes_are_rotated_to_S_by_the_orientation(tmp_path: Path) -> None:
    motion = motion_at(T)
    wrench_W = np.einsum("nij,nkj->nki", motion.R_WS, smooth_wrench(motion).reshape(-1, 2, 3))
    s_W = np.einsum("nij,nj->ni", motion.R_WS, motion.specific_force)
    np.savez(
        tmp_path / "all.npz", t=T, w=wrench_W.reshape(-1, 6), s=s_W, R=motion.R_WS, n=T[:, None]
    )
    np.savez(tmp_path / "parts.npz", t=T, f=wrench_W[:, 0], tau=wrench_W[:, 1])
    time = {"column": "t"}
    description = {
        "wrench": {
            "file": "parts.npz",
            "time": time,
            "force": {"columns": ["f"]},
            "torque": {"columns": ["tau"]},
            "frame": "base",
        },
        "imu": {
            "file": "all.npz",
            "time": time,
            "specific_force": {"columns": ["s"]},
            "frame": "base",
        },
        "pose": {
            "file": "all.npz",
            "time": time,
            "orientation": {"columns": ["R"], "form": "matrix"},
        },
    }
    path = tmp_path / "log.yaml"
    path.write_text(yaml.safe_dump(description), encoding="utf-8")
    log = read_log(path)
    np.testing.assert_allclose(log.wrench, smooth_wrench(motion), atol=1e-9)
    np.testing.assert_allclose(log.specific_force, motion.specific_force, atol=1e-9)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"wrench__file": "none.csv"}, ["none.csv: no such file"]),
        (
            {"wrench__force__columns": ["F0", "F1", "FF2"]},
            ["wrench.force.columns", "did you mean F2"],
        ),
        ({"wrench__force__columns": ["F0", "F1"]}, ["wrench.force.columns", "2 columns, but 3"]),
        ({"imu__specific_force__columns": ["clock"]}, ["imu.specific_force.columns", "1 columns"]),
        (
            {"wrench__time": {"column": "time", "unit": "ms"}},
            ["wrench.time.unit", "a rate of 0.7 Hz", "`unit: us`"],
        ),
        ({"pose__time": {"column": "sec"}}, ["do not overlap in time", "pose 0.03"]),
        ({"pose__time": {"column": "q0"}}, ["pose.time", "decrease", "time.rate"]),
        (
            {"pose__orientation": {"columns": ["q0", "q1", "q2"], "form": "quaternion_wxyz"}},
            ["pose.orientation.columns", "3 columns, but 4"],
        ),
        (
            {"pose__orientation": {"columns": ["q0", "q1", "q2", "q2"], "form": "quaternion_wxyz"}},
            ["pose.orientation", "is not a rotation", "form is quaternion_wxyz"],
        ),
        ({"wrench__frame": "base", "pose": None}, ["wrench.frame", "add a pose stream"]),
        ({"imu__frame": "base", "pose": None}, ["imu.frame", "add a pose stream"]),
    ],
)
def test_invalid_stream_raises_error(
    tmp_path: Path, changes: dict[str, Any], words: list[str]
) -> None:
    path = write_streams(tmp_path, **changes)
    with pytest.raises(DrakeTeleopError) as error:
        read_log(path)
    message = str(error.value)
    assert str(tmp_path) in message
    for word in [*words, ";"]:
        assert word in message


def test_arrays_with_wrong_shapes_raise_error(tmp_path: Path) -> None:
    path = write_streams(tmp_path, imu__time={"column": "t"})
    with np.load(tmp_path / "imu.npz") as archive:
        np.savez(tmp_path / "imu.npz", t=archive["clock"][:-1] * 1e-3, **archive)
    with pytest.raises(DrakeTeleopError, match="has 4500 rows where 4499 are needed"):
        read_log(path)


def test_nominal_rate_replaces_time_stamps(tmp_path: Path) -> None:
    canonical("s", "omega").write_csv(tmp_path / "all.csv")
    stream = {"file": "all.csv", "time": {"rate": 500.0}}
    description = {
        "wrench": stream
        | {
            "force": {"columns": list(WRENCH_COLUMNS[:3])},
            "torque": {"columns": list(WRENCH_COLUMNS[3:])},
        },
        "imu": stream
        | {
            "specific_force": {"columns": list(SPECIFIC_FORCE_COLUMNS)},
            "angular_velocity": {"columns": list(ANGULAR_VELOCITY_COLUMNS)},
        },
    }
    path = tmp_path / "log.yaml"
    path.write_text(yaml.safe_dump(description), encoding="utf-8")
    log = read_log(path)
    np.testing.assert_allclose(log.t, T, atol=1e-12)
    np.testing.assert_allclose(log.specific_force, motion_at(T).specific_force, atol=1e-12)


def test_a_gap_is_noted_and_marked(tmp_path: Path) -> None:
    frame = canonical("s", "omega")
    pl.concat([frame[:500], frame[600:]]).write_csv(tmp_path / "log.csv")
    log = read_log(tmp_path / "log.csv")
    assert any("1 gaps, the longest of 0.202 s at 0.998 s" in note for note in log.notes)
    assert log.t[-1] == pytest.approx(T[-1])
    assert log.bridged is not None
    # Half of the smoother's 60 ms on either side.
    marked = log.t[log.bridged]
    assert [marked[0], marked[-1]] == pytest.approx([0.998 - 0.03, 1.2 + 0.03], abs=0.003)
    known = log.select_rows(~log.bridged)
    np.testing.assert_allclose(known.wrench, smooth_wrench(motion_at(known.t)), atol=1e-3)
    np.testing.assert_allclose(known.angular_acceleration, motion_at(known.t).alpha, atol=0.02)


def test_too_many_gaps_raise_error(tmp_path: Path) -> None:
    frame = canonical("s", "omega")
    pieces = [frame[i : i + 14] for i in range(0, 600, 30)]
    pl.concat(pieces).write_csv(tmp_path / "log.csv")
    with pytest.raises(
        DrakeTeleopError, match=r"0 samples are outside of gaps \(\d+ required\); record"
    ):
        read_log(tmp_path / "log.csv")


def test_static_poses_accept_gravity_or_orientation(tmp_path: Path) -> None:
    motion = motion_at(np.linspace(0, 5, 12))
    gravity = np.einsum("nji,j->ni", motion.R_WS, GRAVITY_W)
    wrench_W = np.einsum("nij,nj->ni", motion.R_WS, -2 * gravity)
    bias = [0.1, -0.2, 0.3]  # in g, the unit of its column
    np.savez(
        tmp_path / "x.npz",
        f=-2 * gravity,
        f_W=wrench_W,
        tau=0 * gravity,
        g=gravity,
        s=-gravity,
        in_g=gravity / np.linalg.norm(GRAVITY_W) + bias,
        R=motion.R_WS,
    )
    orientation = {"columns": ["R"], "form": "matrix"}
    for force, extra in (
        ("f", {"gravity": {"columns": ["g"]}}),
        ("f", {"gravity": {"columns": ["in_g"], "unit": "g", "bias": bias}}),
        ("f", {"specific_force": {"columns": ["s"]}}),
        ("f", {"orientation": orientation}),
        ("f_W", {"orientation": orientation, "frame": "base"}),
    ):
        stream = {"file": "x.npz", "force": {"columns": [force]}, "torque": {"columns": ["tau"]}}
        path = tmp_path / "log.yaml"
        described = {"static": stream | extra | {"gain_std": 0.01}}
        path.write_text(yaml.safe_dump(described), encoding="utf-8")
        log = read_log(path)
        assert log.static and log.gain_std == 0.01
        np.testing.assert_allclose(log.specific_force, -gravity, atol=1e-9)
        np.testing.assert_allclose(log.wrench[:, :3], -2 * gravity, atol=1e-9)
        assert not log.angular_velocity.any() and not log.angular_acceleration.any()


@pytest.mark.parametrize("columns", [["s"], ["q"], ["s", "omega"], ["q", "p"]])
@pytest.mark.parametrize("rate", [None, 1.0, 0.2])
@pytest.mark.parametrize("rows_a_pose", [1, 4])
def test_canonical_rows_at_rest_are_static_poses(
    tmp_path: Path, columns: list[str], rate: float | None, rows_a_pose: int
) -> None:
    R_WS = Rotation.random(12, np.random.default_rng(2)).as_matrix().repeat(rows_a_pose, axis=0)
    g_S = GRAVITY_W @ R_WS
    rest = np.zeros_like(g_S)
    groups = {
        "s": (SPECIFIC_FORCE_COLUMNS, -g_S),
        "omega": (ANGULAR_VELOCITY_COLUMNS, rest),
        "q": (QUATERNION_COLUMNS, quaternions(R_WS)),
        "p": (POSITION_COLUMNS, rest),
    }
    values = dict(zip(WRENCH_COLUMNS, np.hstack([-2 * g_S, rest]).T, strict=True))
    for group in columns:
        values |= dict(zip(groups[group][0], groups[group][1].T, strict=True))
    if rate is not None:
        values["t"] = np.arange(len(g_S)) / rate
    pl.DataFrame(values).write_csv(tmp_path / "log.csv")
    log = read_log(tmp_path / "log.csv")
    assert log.static and log.notes == ("each row is interpreted as a pose at rest",)
    assert log.gravity is not None
    np.testing.assert_allclose(log.gravity, g_S, atol=1e-9)
    np.testing.assert_allclose(log.wrench[:, :3], -2 * g_S, atol=1e-9)


def test_moving_log_with_stamps_in_ms_is_not_static(tmp_path: Path) -> None:
    for columns in (("s", "omega"), ("q", "p")):
        frame = canonical(*columns).with_columns(t=1e3 * pl.col("t"))
        frame.write_csv(tmp_path / "log.csv")
        with pytest.raises(DrakeTeleopError, match=r"probably `unit: ms`; if each row is a pose"):
            read_log(tmp_path / "log.csv")
    # Without a clock, but moving.
    canonical("s", "omega").drop("t").write_csv(tmp_path / "log.csv")
    with pytest.raises(DrakeTeleopError, match=r"no column 't'"):
        read_log(tmp_path / "log.csv")


@pytest.mark.parametrize("kind", ["wrench", "static"])
def test_axes_of_the_force_sensor_are_rotated_to_S(tmp_path: Path, kind: str) -> None:
    """The columns of `frame` are the axes of the file in S."""
    x, y, z = np.array([0.0, 0.6, -0.8]), np.array([1.0, 0.0, 0.0]), np.array([0.0, -0.8, -0.6])
    motion = motion_at(T)
    columns: dict[str, Any] = {"t": T, "s": motion.specific_force, "omega": motion.omega}
    for name, vectors in zip(("f", "tau"), np.split(smooth_wrench(motion), 2, axis=1), strict=True):
        columns[name] = np.column_stack([vectors @ axis for axis in (x, y, z)])
    np.savez(tmp_path / "x.npz", **columns)
    stream: dict[str, Any] = {
        "file": "x.npz",
        "force": {"columns": ["f"]},
        "torque": {"columns": ["tau"]},
        "frame": np.column_stack([x, y, z]).tolist(),
    }
    description: dict[str, Any] = {kind: stream}
    if kind == "static":
        stream["gravity"] = {"columns": ["s"]}
    else:
        time = {"column": "t"}
        stream["time"] = time
        description["imu"] = {
            "file": "x.npz",
            "time": time,
            "specific_force": {"columns": ["s"]},
            "angular_velocity": {"columns": ["omega"]},
        }
    path = tmp_path / "log.yaml"
    path.write_text(yaml.safe_dump(description), encoding="utf-8")
    np.testing.assert_allclose(read_log(path).wrench, smooth_wrench(motion), atol=1e-9)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"wrench": np.zeros((4, 5))}, r"wrench: has shape \(4, 5\) instead of \(4, 6\)"),
        ({"t": np.array([0.0, 1, 1, 2])}, "t: does not increase at index 2"),
        (
            {"angular_velocity": np.full((4, 3), np.nan)},
            "angular_velocity: holds NaN or infinity at index 0",
        ),
    ],
)
def test_log_with_impossible_values_raises_error(changes: dict[str, Any], words: str) -> None:
    good = {
        "t": np.arange(4.0),
        "wrench": np.zeros((4, 6)),
        "specific_force": np.zeros((4, 3)),
        "angular_velocity": np.zeros((4, 3)),
        "angular_acceleration": np.zeros((4, 3)),
    }
    with pytest.raises(DrakeTeleopError, match=words):
        Log(**good | changes)


@pytest.mark.parametrize("columns", [WRENCH_COLUMNS, WRENCH_COLUMNS[:3], SPECIFIC_FORCE_COLUMNS])
@pytest.mark.parametrize(("spacing", "length"), [(20, 1), (301, 1), (400, 19)])
def test_rows_of_zeros_between_other_values_are_lost_readings(
    tmp_path: Path, columns: tuple[str, ...], spacing: int, length: int
) -> None:
    table, row = canonical("s", "omega"), np.arange(len(T))
    lost = (row % spacing < length) & (row >= spacing)
    zero = [pl.when(pl.Series(lost)).then(0.0).otherwise(pl.col(x)).alias(x) for x in columns]
    path = tmp_path / "log.csv"
    table.with_columns(zero).write_csv(path)
    said = f"{lost.sum()} rows of zeros between other values, the first is row {spacing + 2}: "
    with pytest.raises(DrakeTeleopError, match=said):
        read_log(path)
    table.filter(pl.Series(~lost)).write_csv(path)
    read_log(path)


@pytest.mark.parametrize("lost", [(399,), (300, 301, 900), (7, 700, 1400)])
def test_remedy_for_lost_readings_keeps_the_times_of_a_given_rate(
    tmp_path: Path, lost: tuple[int, ...]
) -> None:
    table, is_lost = canonical("s", "omega"), pl.Series(np.isin(np.arange(len(T)), [1, *lost]))
    time = {"file": "log.csv", "time": {"rate": 500.0}}
    names = "force", "torque", "specific_force", "angular_velocity"
    groups = (
        *np.split(np.array(WRENCH_COLUMNS), 2),
        SPECIFIC_FORCE_COLUMNS,
        ANGULAR_VELOCITY_COLUMNS,
    )
    fields = {name: {"columns": list(map(str, x))} for name, x in zip(names, groups, strict=True)}
    wrench, imu = (time | {name: fields[name] for name in part} for part in (names[:2], names[2:]))
    (tmp_path / "log.yaml").write_text(yaml.safe_dump({"wrench": wrench, "imu": imu}))
    for value in 0.0, None:
        cells = [pl.when(is_lost).then(value).otherwise(x).alias(x) for x in table.columns]
        table.with_columns(cells).write_csv(tmp_path / "log.csv")
        if value == 0.0:
            with pytest.raises(DrakeTeleopError, match=r"empty their cells if time\.rate is given"):
                read_log(tmp_path / "log.yaml")
    log = read_log(tmp_path / "log.yaml")
    assert log.t[-1] - log.t[0] == pytest.approx(T[-1], abs=1e-6)


@pytest.mark.parametrize(
    "kind",
    [
        *("starts at zero", "crosses zero", "dead band", "contact", "few", "resolution"),
        *("constant", "opposite speeds", "stop and go", "taps"),
    ],
)
def test_measured_zeros_are_no_lost_readings(kind: str) -> None:
    t = np.arange(0.0, 4.0, 0.002)
    x = np.stack([np.sin(3.0 * t), np.sin(3.0 * t), 2.0 * np.sin(3.0 * t)], axis=1)
    rng, speed, about_x = np.random.default_rng(0), np.sin(12.5 * t), np.array([1.0, 0.0, 0.0])
    rest, free = np.abs(speed) < 0.12, (np.sin(60.0 * t) < -0.7) | (np.sin(3.0 * t) < 0.0)
    values = {
        "resolution": np.outer(rng.random(len(t)) < 0.7, about_x),
        "constant": np.outer(rng.random(len(t)) > 0.003, [0.0, -0.1, 0.0]),
        "opposite speeds": np.outer(np.where(rest, 0.0, np.sign(speed)), about_x),
        "stop and go": np.outer(~rest, about_x),
        "taps": np.outer(np.where(free, 0.0, 10.0 + 0.1 * rng.random(len(t))), about_x),
        "starts at zero": np.where(t[:, None] < 0.02, 0.0, x + 3.0),
        "crosses zero": np.round(x, 2),
        "dead band": np.where(np.abs(x) < 0.05, 0.0, x),
        "contact": np.where(np.sin(40.0 * t)[:, None] > 0.0, 0.0, np.abs(x)),
        "few": np.where(np.isin(np.arange(len(t)), [300, 900])[:, None], 0.0, x + 3.0),
    }[kind]
    check_for_lost_readings(values, Table(Path("x.csv"), {}), "force")


def test_ur5_gyroscope_agrees_with_the_pose(ur5: Path, tmp_path: Path) -> None:
    """Files without header, clocks in ms and s, rotation vectors; the IMU has the axes of the tool.

    The IMU's clock lags by 0.11 s; its map to the axes of the tool is the identity within 2.5 %.
    """
    time_ms, time_s = {"column": 0, "unit": "ms"}, {"column": 0}
    record = f"{ur5}/No9_Singularity_Free_ForceSensor__"
    description: dict[str, Any] = {
        "wrench": {
            "file": record + "log_force_sensor.csv",
            "header": False,
            "time": time_s,
            "force": {"columns": [1, 2, 3]},
            "torque": {"columns": [4, 5, 6]},
        },
        "imu": {
            "file": record + "acc_data.csv",
            "header": False,
            "time": time_ms | {"offset": -0.11},
            "specific_force": {"columns": [1, 2, 3]},
            "angular_velocity": {"columns": [7, 8, 9]},
        },
        "pose": {
            "file": record + "log_tool_vector.csv",
            "header": False,
            "time": time_s,
            "orientation": {"columns": [4, 5, 6], "form": "rotation_vector"},
            "position": {"columns": [1, 2, 3]},
        },
    }
    path = tmp_path / "log.yaml"
    path.write_text(yaml.safe_dump(description), encoding="utf-8")
    both = read_log(path, bandwidth_hz=10.0)
    del description["imu"]
    path.write_text(yaml.safe_dump(description), encoding="utf-8")
    posed = read_log(path, bandwidth_hz=10.0)
    at = np.searchsorted(posed.t, both.t + 1e-9) - 1
    omega = posed.angular_velocity[at]
    moving = np.linalg.norm(omega, axis=1) > 0.2
    scale = np.sum(both.angular_velocity[moving] * omega[moving]) / np.sum(omega[moving] ** 2)
    assert scale == pytest.approx(1.0, abs=0.025)
    error = (both.angular_velocity - omega)[moving]
    assert np.sqrt(np.mean(error**2)) < 0.1 * np.sqrt(np.mean(omega[moving] ** 2))
    tilt = low_pass(both.specific_force - posed.specific_force[at], both.dt, 1.0)
    assert np.median(np.linalg.norm(tilt, axis=1)) < 0.6


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
@pytest.mark.parametrize("step_deg", [3.0, 8.0, 45.0])
def test_written_poses_at_rest_read_unchanged(tmp_path: Path, suffix: str, step_deg: float) -> None:
    R = Rotation.from_euler("y", step_deg * np.arange(12.0)[:, None], degrees=True).as_matrix()
    gravity, rest = np.swapaxes(R, 1, 2) @ GRAVITY_W, np.zeros((12, 3))
    wrench = np.hstack([-gravity, 0.1 * gravity])
    log = Log(np.arange(12.0), wrench, -gravity, rest, rest, gravity, static=True)
    write_log(log, tmp_path / f"log.{suffix}")
    found = read_log(tmp_path / f"log.{suffix}")
    assert found.static
    np.testing.assert_array_equal(found.wrench, log.wrench)
    np.testing.assert_array_equal(found.specific_force, log.specific_force)
