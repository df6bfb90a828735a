"""Rotation and lever arm of an IMU: estimates against known mountings."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from known_motion import GRAVITY_W, Motion, motion_at, quaternions
from scipy.spatial.transform import Rotation
from test_log_commands import GRAVITY, describe_poses, describe_record

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.logs.inspection import inspect_command
from drake_teleop.logs.processing import eliminate_log, identify_log
from drake_teleop.logs.read import auto_frames
from drake_teleop.logs.read.canonical import Log
from drake_teleop.logs.read.description import Description, load_description
from drake_teleop.logs.read.mounting import (
    LeverArm,
    Mounting,
    are_lever_arm_axes_observable,
    find_mounting,
    lag_of_imu_clock,
    lever_arm_from_wrench,
    lever_matrix,
)
from drake_teleop.logs.read.reading import read_described_log, read_log
from drake_teleop.logs.read.tables import Table

PHI = phi_from_mass_com_inertia(3.13, [0.01, -0.02, 0.12], np.diag([0.02, 0.018, 0.006]))
OFFSETS = np.array([3.0, -2.0, 7.0, 0.1, 0.2, -0.3])
RIGHT_ANGLED = np.array([[0.0, -1, 0], [0, 0, 1], [-1, 0, 0]])
LAG = 0.006


def rotation_about_y(t: np.ndarray, *, arm: float = 0.0) -> Motion:
    """Return a swing about the y axis of S, with So on an arc of this radius."""
    angle, rate = 1.4 * np.sin(1.1 * t), 1.4 * 1.1 * np.cos(1.1 * t)
    acceleration = -1.1 * 1.1 * angle
    R_WS = Rotation.from_rotvec(np.outer(angle, [0.0, 1, 0])).as_matrix()
    omega, alpha = np.outer(rate, [0.0, 1, 0]), np.outer(acceleration, [0.0, 1, 0])
    r = np.array([0.0, 0, arm])
    p_WS = R_WS @ r
    s = np.cross(alpha, r) + np.cross(omega, np.cross(omega, r))
    return Motion(t, R_WS, p_WS, s - np.einsum("nji,j->ni", R_WS, GRAVITY_W), omega, alpha)


@dataclass(frozen=True)
class Recorder:
    """IMU on the sensor, wrench of a load, and pose, each with its own clock."""

    R_SI: np.ndarray
    p_SoIo_S: np.ndarray
    seed: int = 0
    noise: float = 1.0
    motion: Any = motion_at
    seconds: float = 6.0
    lag: float = LAG

    def tables(self) -> dict[Path, Table]:
        """Noise and bias of a small MEMS IMU, of a wrist sensor, and of joint encoders."""
        rng, p = np.random.default_rng(self.seed), self.p_SoIo_S

        def noisy(x: np.ndarray, *sizes: float) -> np.ndarray:
            return x + self.noise * rng.normal(size=x.shape) * np.repeat(sizes, 3)

        t = np.arange(0, self.seconds, 1 / 500)
        m = self.motion(t)
        wrench = non_contact_wrench(m.specific_force, m.omega, m.alpha, PHI)
        wrench = noisy(wrench, 0.1, 0.005) + OFFSETS
        columns = {"w": {"t": t, "f": wrench[:, :3], "m": wrench[:, 3:]}}
        t = np.arange(0, self.seconds, 1 / 250) + 0.0013
        m = self.motion(t - self.lag)
        s = m.specific_force + np.cross(m.alpha, p) + np.cross(m.omega, np.cross(m.omega, p))
        columns["i"] = {
            "t": t,
            "s": noisy(s @ self.R_SI, 0.06) + 0.3 * rng.normal(size=3),
            "omega": noisy(m.omega @ self.R_SI, 2e-3) + 0.01 * rng.normal(size=3),
        }
        t = np.arange(0, self.seconds, 1 / 125) + 0.0021
        m = self.motion(t)
        wobble = Rotation.from_rotvec(noisy(np.zeros((len(t), 3)), 1e-4)).as_matrix()
        columns["p"] = {"t": t, "q": quaternions(m.R_WS @ wobble), "p": noisy(m.p_WS, 5e-5)}
        return {Path(name): Table(Path(name), data) for name, data in columns.items()}


def described(
    *, gyroscope: bool = True, pose: bool = True, positioned: bool = True, **imu: Any
) -> Description:
    """Return the description of the tables of a `Recorder`."""

    def stream(file: str, **fields: str) -> dict[str, Any]:
        columns = {name: {"columns": [column]} for name, column in fields.items()}
        return {"file": file, "time": {"column": "t"}} | columns

    imus = {"specific_force": "s"} | ({"angular_velocity": "omega"} if gyroscope else {})
    data = {"wrench": stream("w", force="f", torque="m"), "imu": stream("i", **imus) | imu}
    if pose:
        data["pose"] = stream("p", orientation="q") | (
            {"position": {"columns": ["p"]}} if positioned else {}
        )
        data["pose"]["orientation"]["form"] = "quaternion_wxyz"
    return Description.model_validate(data)


def mounting(
    recorder: Recorder, tables: dict[Path, Table] | None = None, **streams: bool
) -> Mounting:
    description, tables = described(**streams), tables or recorder.tables()
    imu = read_described_log(description, "log.yaml", tables=tables)
    alone = description.model_copy(update={"imu": None})
    pose = read_described_log(alone, "log.yaml", tables=tables)
    found = find_mounting(imu, pose, has_position=streams.get("positioned", True))
    assert found is not None
    return found


def random_rotation(seed: int) -> np.ndarray:
    return Rotation.random(random_state=np.random.default_rng(seed)).as_matrix()


def rotation_vector_deg(R: np.ndarray) -> np.ndarray:
    """Return the rotation vector [deg]."""
    return np.degrees(Rotation.from_matrix(R).as_rotvec())


rotations = st.integers(0, 10**6).map(random_rotation)
places = st.tuples(*[st.floats(-0.1, 0.1)] * 3).map(np.array)


@pytest.mark.slow
@settings(max_examples=6, deadline=None)
@given(rotations, places, st.integers(0, 10**6), st.booleans())
def test_mounting_is_estimated_within_its_deviations(
    R_SI: np.ndarray, p_SoIo_S: np.ndarray, seed: int, gyroscope: bool
) -> None:
    found = mounting(Recorder(R_SI, p_SoIo_S, seed), gyroscope=gyroscope)
    assert (
        found.is_determined
        and found.lever_arm is not None
        and found.lever_arm.are_axes_determined.all()
    )
    # Interpolation of the pose causes errors of 0.1 % of lever arm and rotation.
    error = np.abs(rotation_vector_deg(found.R_SI @ R_SI.T))
    assert (error < 5 * found.deviations_deg + 0.02).all()
    assert (
        np.abs(found.lever_arm.p_SoIo_S - p_SoIo_S) < 5 * found.lever_arm.deviations + 3e-4
    ).all()
    assert found.deviations_deg.max() < 0.1
    assert found.lever_arm.deviations.max() < 5e-4
    assert found.lag_s == pytest.approx(LAG, abs=3e-4)


@pytest.mark.parametrize(("lag", "is_found"), [(0.9, True), (1.2, False)])
def test_lag_is_searched_within_one_second(lag: float, is_found: bool) -> None:
    found = mounting(
        Recorder(random_rotation(3), np.array([0.05, -0.03, 0.08]), seconds=8.0, lag=lag)
    )
    assert found.fits_pose == is_found
    assert (found.lag_s == pytest.approx(lag, abs=1e-3)) == is_found


@pytest.mark.slow
def test_deviations_equal_the_scatter_of_repeated_records() -> None:
    truth = [(random_rotation(seed), np.array([0.05, -0.03, 0.08])) for seed in range(16)]
    ratios = []
    for seed, (R_SI, p) in enumerate(truth):
        found = mounting(Recorder(R_SI, p, seed, noise=8.0), gyroscope=False)
        assert found.lever_arm is not None
        ratios.append(rotation_vector_deg(found.R_SI @ R_SI.T) / found.deviations_deg)
        ratios.append((found.lever_arm.p_SoIo_S - p) / found.lever_arm.deviations)
    ratios = np.array(ratios)
    # 95 % of 96 ratios should be within +-1.96: at least 86 in 99 of 100 such tests.
    assert (np.abs(ratios) < 1.96).sum() >= 86
    assert 0.7 < np.sqrt((ratios**2).mean()) < 1.3


@pytest.mark.quick_cases(1)
@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_wrench_determines_the_lever_arm_without_a_pose(seed: int) -> None:
    p = np.random.default_rng(seed).uniform(-0.1, 0.1, 3)
    recorder = Recorder(random_rotation(seed), p, seed, noise=3.0)
    description = described(pose=False, frame=recorder.R_SI.tolist())
    tables = recorder.tables()
    found = lever_arm_from_wrench(read_described_log(description, "log.yaml", tables=tables))
    assert found is not None and found.are_axes_determined.all()
    assert (np.abs(found.p_SoIo_S - p) < 4 * found.deviations + 3e-4).all()
    auto = read_described_log(
        described(pose=False, frame=recorder.R_SI.tolist(), position="auto"),
        "log.yaml",
        tables=tables,
    )
    assert len(auto.notes) == 1 and "from the wrench" in auto.notes[0]


@pytest.mark.parametrize(
    ("of_wrench", "taken"), [(0, "pose"), (1, "pose"), (2, "pose"), (3, "wrench")]
)
def test_wrench_is_used_if_it_determines_more_coordinates_than_the_pose(
    monkeypatch: pytest.MonkeyPatch, of_wrench: int, taken: str
) -> None:
    """The pose determines two of three coordinates here."""
    of_pose, other = (
        LeverArm(np.zeros(3), np.where(np.arange(3) < known, 1e-3, np.inf), source)
        for known, source in ((2, "pose"), (of_wrench, "wrench"))
    )
    monkeypatch.setattr(auto_frames, "lever_arm_from_wrench", lambda _: other)
    of_the_pose: Any = SimpleNamespace(fits_pose=True, lever_arm=of_pose)
    if taken == "wrench":
        assert auto_frames._lever_arm_from_pose_or_wrench(of_the_pose, None, "here") is other
        return
    with pytest.raises(DrakeTeleopError, match=r"determine z of .* from the pose\)"):
        auto_frames._lever_arm_from_pose_or_wrench(of_the_pose, None, "here")


def test_contact_prevents_a_lever_arm_from_the_wrench() -> None:
    tables = Recorder(np.eye(3), np.array([0.05, 0, 0])).tables()
    touched = tables[Path("w")].columns["f"].copy()
    touched[1000:1600] += 40.0
    tables[Path("w")] = replace(
        tables[Path("w")], columns=tables[Path("w")].columns | {"f": touched}
    )
    with pytest.raises(DrakeTeleopError, match="determine the position of the accelerometer"):
        read_described_log(described(pose=False, position="auto"), "log.yaml", tables=tables)


@pytest.mark.parametrize(("force", "torque"), [(0.043, 0.043), (0.0, 0.057)])
def test_load_may_leave_5_percent_of_the_wrench_unexplained(force: float, torque: float) -> None:
    recorder = Recorder(np.eye(3), np.array([0.05, 0, 0]))
    log = read_described_log(described(pose=False), "log.yaml", tables=recorder.tables())
    touch = np.zeros((len(log), 2, 3))
    # The motion explains a small part of a step of 1/6 of the record.
    touch[len(log) // 3 : len(log) // 2, :, 0] = 1.0
    whole = log.wrench.reshape(-1, 2, 3).var(axis=0).sum(axis=1)
    touch *= np.sqrt(np.array([force, torque]) * whole / (5 / 36))[:, None]
    log = replace(log, wrench=log.wrench + touch.reshape(-1, 6))
    assert (lever_arm_from_wrench(log) is None) == (torque > 0.05)


@pytest.mark.quick_cases(1)
@pytest.mark.slow
@pytest.mark.parametrize("source", ["wrench", "pose"])
def test_rotation_about_one_axis_determines_two_coordinates(source: str) -> None:
    recorder = Recorder(np.eye(3), np.array([0.03, 0.04, -0.05]), motion=rotation_about_y)
    streams = {"pose": True} if source == "pose" else {"pose": False}
    at_Io = read_described_log(described(**streams), "log.yaml", tables=recorder.tables())
    lever = mounting(recorder).lever_arm if source == "pose" else lever_arm_from_wrench(at_Io)
    assert lever is not None and lever.source == source
    assert lever.are_axes_determined.tolist() == [True, False, True]
    known = lever.are_axes_determined
    error = (lever.p_SoIo_S - recorder.p_SoIo_S)[known]
    assert (np.abs(error) < 4 * lever.deviations[known] + 3e-4).all()
    with pytest.raises(DrakeTeleopError, match=r"imu.position: .*determine y of"):
        read_described_log(
            described(**streams, position="auto"), "log.yaml", tables=recorder.tables()
        )


def test_orientation_alone_does_not_determine_the_lever_arm() -> None:
    # So moves on an arc of 0.3 m; the accelerometer is 0.3 m + p from the centre.
    recorder = Recorder(
        random_rotation(2),
        np.array([0.02, 0.0, 0.05]),
        motion=lambda t: rotation_about_y(t, arm=0.3),
    )
    found = mounting(recorder, gyroscope=False, positioned=False)
    assert found.lever_arm is None
    # The arc does not affect the estimated rotation.
    assert found.is_determined
    assert np.linalg.norm(rotation_vector_deg(found.R_SI @ recorder.R_SI.T)) < 0.3


def write_tables(folder: Path, recorder: Recorder, **imu: Any) -> Path:
    """Write the tables as NPZ files with their description."""
    for name, table in recorder.tables().items():
        np.savez(folder / f"{name}.npz", **table.columns)
    data = described(**imu).model_dump(mode="json", exclude_none=True)
    for name in ("wrench", "imu", "pose"):
        data[name]["file"] += ".npz"
    data["gravity"] = 9.80665
    (folder / "log.yaml").write_text(yaml.safe_dump(data), encoding="utf-8")
    return folder / "log.yaml"


@pytest.mark.quick_cases(1)
@pytest.mark.slow
@pytest.mark.parametrize("oblique", [False, True])
def test_estimates_from_notes_reproduce_the_log(tmp_path: Path, oblique: bool) -> None:
    R_SI = Rotation.from_rotvec([0.1, -0.4, 0.2]).as_matrix() @ RIGHT_ANGLED
    recorder = Recorder(R_SI if oblique else RIGHT_ANGLED, np.array([0.04, -0.06, 0.02]))
    path = write_tables(tmp_path, recorder, frame="auto", position="auto")
    auto = read_log(path)
    notes = "\n".join(auto.notes)
    assert ("warning: the IMU is mounted obliquely, 26." in notes) == oblique
    assert "warning" in notes or not oblique
    assert "from the right-angled mounting [[0, -1, 0], [0, 0, 1], [-1, 0, 0]]" in notes
    assert "mm, from the pose" in notes
    data = yaml.safe_load(path.read_text())
    for field in ("frame", "position"):
        data["imu"][field] = yaml.safe_load(re.search(rf"imu.{field}: (\[.*\])", notes)[1])
    path.write_text(yaml.safe_dump(data))
    given_now = read_log(path)
    assert given_now.notes == ()
    # Rounding to four digits and 0.1 mm causes this difference.
    np.testing.assert_allclose(auto.specific_force, given_now.specific_force, atol=0.01)
    assert inspect_command(path, tmp_path / "out", quiet=True)["mounting"]["angle_deg"] < 0.1


@pytest.mark.slow
def test_given_position_is_in_the_estimated_frame(tmp_path: Path) -> None:
    p = np.array([0.04, -0.06, 0.02])
    recorder = Recorder(random_rotation(5), p, noise=0.1)
    log = read_log(write_tables(tmp_path, recorder, frame="auto", position="auto"))
    half = read_log(write_tables(tmp_path, recorder, frame="auto"))
    data = yaml.safe_load((tmp_path / "log.yaml").read_text())
    data["imu"]["position"] = p.tolist()
    (tmp_path / "log.yaml").write_text(yaml.safe_dump(data))
    given_place = read_log(tmp_path / "log.yaml")
    assert np.abs(log.specific_force - half.specific_force).max() > 1.0
    assert np.abs(log.specific_force - given_place.specific_force).max() < 0.1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"rest": True}, ["the specific force hardly changes", "turn the sensor"]),
        ({"mirror": True}, ["mirrored", "exchange two of its columns"]),
        ({"sign": -1}, ["mirrored", "imu.sign"]),
        ({"degrees": True}, ["no rotation makes", "angular velocity", "drake-teleop inspect"]),
    ],
)
def test_undetermined_rotation_raises_error(changes: dict[str, Any], words: list[str]) -> None:
    motion = (lambda t: motion_at(0 * t)) if changes.get("rest") else motion_at
    tables = Recorder(RIGHT_ANGLED, np.zeros(3), motion=motion).tables()
    columns = tables[Path("i")].columns
    if changes.get("rest"):
        still = {"s": motion(columns["t"]).specific_force, "omega": 0 * columns["omega"]}
        columns |= still
    if changes.get("mirror"):
        columns |= {"s": columns["s"][:, [1, 0, 2]], "omega": columns["omega"][:, [1, 0, 2]]}
    if changes.get("degrees"):
        columns |= {"omega": np.degrees(columns["omega"])}
    description = described(frame="auto", sign=changes.get("sign", 1))
    with pytest.raises(DrakeTeleopError) as error:
        read_described_log(description, "log.yaml", tables=tables)
    message = str(error.value)
    assert message.startswith("log.yaml:imu.frame: the data do not determine the rotation")
    for word in words:
        assert word in message


@pytest.mark.parametrize("gyroscope", [False, True])
@pytest.mark.parametrize("place", [[0.08, -0.05, 0.02], [-0.02, 0.03, 0.1]])
def test_specific_force_is_that_of_the_origin_of_S(place: list[float], gyroscope: bool) -> None:
    found = []
    for p in (place, [0.0, 0.0, 0.0]):
        tables = Recorder(np.eye(3), np.array(p), noise=0.0, lag=0.0, seconds=2.0).tables()
        description = described(gyroscope=gyroscope, position=p)
        found.append(read_described_log(description, "log.yaml", tables=tables).specific_force)
    assert np.abs(found[0] - found[1])[50:-50].max() < 0.1  # of 5 m/s^2


@pytest.mark.parametrize("axis", range(3))
def test_noise_about_an_axis_hides_coordinates_across_it(axis: int) -> None:
    t = np.arange(0, 4, 2e-3)
    at, noise = (
        motion_at(t),
        np.outer(np.random.default_rng(0).normal(size=len(t)), np.eye(3)[axis]),
    )
    log = Log(t, np.zeros((len(t), 6)), at.specific_force, at.omega, at.alpha + 3000.0 * noise)
    observable = are_lever_arm_axes_observable(lever_matrix(at.omega, at.alpha), log, 8.0)
    assert np.flatnonzero(observable).tolist() == [axis]


def test_mirrored_axes_are_found_despite_a_lag() -> None:
    recorder = Recorder(random_rotation(3), np.zeros(3), seconds=3.0, lag=0.4)
    tables = recorder.tables()
    columns = tables[Path("i")].columns
    columns |= {"s": columns["s"][:, [1, 0, 2]], "omega": columns["omega"][:, [1, 0, 2]]}
    assert mounting(recorder, tables).is_mirrored


@pytest.mark.slow
@pytest.mark.quick_cases(1)
@pytest.mark.parametrize("later", [0.2, -0.3])
def test_lag_of_the_imu_is_reported_but_not_corrected(later: float) -> None:
    tables = Recorder(RIGHT_ANGLED, np.zeros(3)).tables()

    def read_with_imu_stamps_later(shift: float) -> Log:
        columns = tables[Path("i")].columns
        moved = replace(tables[Path("i")], columns=columns | {"t": columns["t"] + shift})
        shifted = tables | {Path("i"): moved}
        return read_described_log(described(frame="auto"), "log.yaml", tables=shifted)

    log = read_with_imu_stamps_later(later)
    (note,) = (note for note in log.notes if "lags that of the pose" in note)
    assert f" by {later + LAG:.3f} s" in note
    s = motion_at(log.t - LAG - later).specific_force
    assert np.abs(log.specific_force - s)[20:-20].mean() < 0.4
    offset = float(note.split("; add ")[1].split(" to imu.time.offset")[0])
    assert not any("lags" in x for x in read_with_imu_stamps_later(later + offset).notes)


def test_gaps_are_excluded_from_the_mounting() -> None:
    p = np.array([0.05, -0.04, 0.06])
    recorder = Recorder(random_rotation(3), p)
    tables = recorder.tables()
    for name in ("p", "i"):
        columns = tables[Path(name)].columns
        kept = (columns["t"] < 2.2) | (columns["t"] > 2.7)
        tables[Path(name)] = replace(
            tables[Path(name)], columns={k: x[kept] for k, x in columns.items()}
        )
    found = mounting(recorder, tables)
    assert found.lever_arm is not None and found.is_determined and found.unexplained < 1e-3
    assert np.linalg.norm(rotation_vector_deg(found.R_SI @ recorder.R_SI.T)) < 0.1
    assert np.abs(found.lever_arm.p_SoIo_S - p).max() < 1e-3


# Real records


@pytest.mark.slow
@pytest.mark.parametrize(
    ("record", "residual", "delay_s"),
    [("1-baseline", 0.296, 0.00612), ("2-vibrations", 0.316, 0.00588)],
)
def test_ntnu_mounting_and_delay_are_estimated(
    ntnu: Path, tmp_path: Path, record: str, residual: float, delay_s: float
) -> None:
    path = describe_record(tmp_path, ntnu, record)
    known = load_description(path)
    assert known.imu is not None
    data = yaml.safe_load(path.read_text())
    data["imu"]["frame"] = "auto"
    path.write_text(yaml.safe_dump(data))
    own = identify_log(path)
    note = next(note for note in own.log.notes if note.startswith("imu.frame found"))
    R_SI = np.array(yaml.safe_load(note.split("imu.frame: ")[1]))
    assert np.linalg.norm(rotation_vector_deg(R_SI @ np.array(known.imu.frame).T)) < 1.5
    assert not any("warning" in note for note in own.log.notes)
    assert own.identification.delay_s == pytest.approx(delay_s, abs=3e-4)
    assert own.identification.mass == pytest.approx(0.9323, rel=0.01)
    assert own.identification.com[2] == pytest.approx(0.0439, abs=3e-4)
    # The load fitted with poses alone leaves a smaller residual than with exact axes.
    poses = identify_log(describe_poses(tmp_path, ntnu, GRAVITY)).identification
    contact = eliminate_log(path, poses).contact[:, :3]
    assert np.sqrt(np.mean(np.sum(contact**2, axis=1))) < residual
    data["imu"]["position"] = "auto"
    path.write_text(yaml.safe_dump(data))
    # 0.8 rad/s about one axis cannot determine a few centimetres.
    with pytest.raises(DrakeTeleopError, match="determine x, y, z of"):
        read_log(path)


def test_ur5_imu_has_the_axes_of_the_tool(ur5: Path) -> None:
    """The map of the gyroscope is the identity; lag and drift are reported, not corrected."""
    record = "No9_Singularity_Free_ForceSensor__"

    def stream(name: str, unit: str, **columns: Any) -> dict[str, Any]:
        time = {"column": 0, "unit": unit}
        return {"file": str(ur5 / f"{record}{name}.csv"), "header": False, "time": time} | columns

    first, second = {"columns": [1, 2, 3]}, {"columns": [4, 5, 6]}
    rotation = second | {"form": "rotation_vector"}
    gyroscope = {"columns": [7, 8, 9]}
    description = Description.model_validate(
        {
            "wrench": stream("log_force_sensor", "s", force=first, torque=second),
            "imu": stream("acc_data", "ms", specific_force=first, angular_velocity=gyroscope)
            | {"frame": "auto"},
            "pose": stream("log_tool_vector", "s", orientation=rotation, position=first),
        }
    )
    notes = read_described_log(description, "log.yaml").notes
    found = next(note for note in notes if note.startswith("imu.frame found"))
    R_SI = np.array(yaml.safe_load(found.split("imu.frame: ")[1]))
    assert np.linalg.norm(rotation_vector_deg(R_SI)) < 1.0
    assert any("the clock of the IMU lags that of the pose by 0.1" in note for note in notes)


@pytest.mark.parametrize("lag", [-0.173, 0.0, 0.062])
def test_best_shift_is_the_lag_for_rotated_axes(lag):
    rng = np.random.default_rng(2)
    clock = np.arange(0, 12, 0.005)
    kernel = np.exp(-0.5 * (np.arange(-40, 41) / 12) ** 2)
    noise = rng.normal(size=(3, len(clock)))
    signal = np.array([np.convolve(row, kernel, mode="same") for row in noise]).T
    t = np.arange(1, 11, 0.01)
    shown = np.stack([np.interp(t, clock - lag, column) for column in signal.T], axis=1)
    turned = signal[:, [1, 2, 0]] * [1.0, -1.0, 1.0]
    found = lag_of_imu_clock(t, [(shown, turned)], clock, 0.5, np.zeros((len(t), 1)))
    assert found == pytest.approx(lag, abs=2e-3)
