"""Logs whose motion is known only by noisy poses, from file to load."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import polars as pl
import pytest
import yaml
from posed_record import GRAVITY_W, LATE, PHI, SHIFT, TURN, Kind, record

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.rotations import rotation_matrices
from drake_teleop.logs.check.motion_checks import pose_frame_finding
from drake_teleop.logs.inspection import inspect_command
from drake_teleop.logs.pose_motion.estimate import estimate_from_poses
from drake_teleop.logs.pose_motion.poses import PosesOfLog
from drake_teleop.logs.processing import IdentifiedLog, identify_log
from drake_teleop.logs.read.description import load_description
from drake_teleop.logs.read.reading import read_log
from drake_teleop.logs.read.table_files import read_table

WRENCH, POSE = ("fx", "fy", "fz", "tx", "ty", "tz"), ("qw", "qx", "qy", "qz", "x", "y", "z")


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Records of 10 s: poses of S, of a shifted and rotated frame, and with gain errors."""
    folder = tmp_path_factory.mktemp("posed")
    for name, kind in (
        ("own", Kind(seed=1)),
        ("tcp", Kind(p_SoPo_S=tuple(SHIFT), turned=True, seed=2)),
        ("gains", Kind(gain=0.01, seed=8)),
    ):
        t, wrench, poses = record(kind)
        for file, times, names, values in (
            ("wrench", t, WRENCH, wrench),
            ("pose", poses.t, POSE, np.hstack([poses.quaternion, poses.position])),
        ):
            times, values = times[times < 10.0], values[times < 10.0]
            columns = {"t": times + 50.0} | dict(zip(names, values.T, strict=True))
            pl.DataFrame(columns).write_csv(folder / f"{name}_{file}.csv")
    return folder


def described(folder: Path, name: str, wrench: Any = None, **pose: Any) -> Path:
    time = {"column": "t"}
    path = folder / f"{name}.yaml"
    document = {
        "gravity": GRAVITY_W.tolist(),
        "wrench": {
            "file": f"{name}_wrench.csv",
            "time": time,
            "force": {"columns": list(WRENCH[:3])},
            "torque": {"columns": list(WRENCH[3:])},
            **(wrench or {}),
        },
        "pose": {
            "file": f"{name}_pose.csv",
            "time": time,
            "orientation": {"columns": list(POSE[:4]), "form": "quaternion_wxyz"},
            "position": {"columns": list(POSE[4:])},
            **pose,
        },
    }
    path.write_text(yaml.safe_dump(document))
    return path


def deviations(found: IdentifiedLog) -> np.ndarray:
    load = found.identification
    return (load.phi - PHI) / load.standard_deviations[6:]


@pytest.fixture(scope="module")
def from_whole(folder) -> IdentifiedLog:
    return identify_log(described(folder, "own"), cutoff_hz=10.0)


def test_identify_compensates_for_noise_of_poses(from_whole):
    found = from_whole
    load = found.identification
    assert np.abs(deviations(found)).max() < 3.5
    assert load.identifiable.all() and not found.findings
    assert load.delay_s == pytest.approx(LATE, abs=1e-3)
    assert load.standard_deviations[6] < 1e-3
    residual = found.log.wrench - found.predicted
    np.testing.assert_allclose(residual[~found.rejected].std(axis=0), load.residual_rms, rtol=0.1)
    assert load.residual_rms[:3].max() < 0.1  # of 0.1 N before the low-pass


@pytest.mark.slow
@pytest.mark.parametrize("bursts", [True, False])
def test_load_is_identified_despite_inexact_stamps(from_whole, folder, tmp_path, bursts):
    """Five rows per stamp of 1 ms resolution, or 1.6 ms jitter and a clock 0.04 % faster."""
    table = pl.read_csv(folder / "own_pose.csv")
    t = table["t"].to_numpy()
    jitter = np.random.default_rng(1).uniform(-1.6e-3, 1.6e-3, len(t))
    stamps = np.repeat(np.floor(1e3 * t[4::5]) / 1e3, 5) if bursts else 1.0004 * (t + jitter)
    table[: len(stamps)].with_columns(t=pl.Series(stamps)).write_csv(tmp_path / "own_pose.csv")
    (tmp_path / "own_wrench.csv").write_bytes((folder / "own_wrench.csv").read_bytes())
    found = identify_log(described(tmp_path, "own"), cutoff_hz=10.0)
    load, exact = found.identification, from_whole.identification
    assert np.abs(deviations(found)).max() < 3.5
    assert load.identifiable.all() and not found.findings
    wider = load.standard_deviations[6:] / exact.standard_deviations[6:]
    assert wider.max() < 1.35
    assert any("pose.time.scale (1 by default) by 0.9996" in x for x in found.log.notes) != bursts


@pytest.mark.slow
@pytest.mark.parametrize("method", ["consistent", "ordinary"])
def test_stated_gain_errors_increase_the_deviations(folder, method):
    path = described(folder, "own", wrench={"gain_std": 0.01})
    load = identify_log(path, method=method).identification
    assert 0.005 * load.mass < load.standard_deviations[6] < 0.03 * load.mass


@pytest.mark.slow
def test_gain_errors_prevent_identification_unless_they_are_stated(folder):
    found = identify_log(described(folder, "gains"))
    assert not found.identification.identifiable[6:].any()
    assert any("state wrench.gain_std" in note for note in found.log.notes)
    stated = identify_log(described(folder, "gains", wrench={"gain_std": 0.01}))
    assert stated.identification.identifiable[6:10].all()
    assert not any("rigid load alone" in note for note in stated.log.notes)


LIMITS = {
    "read.table_files._MAX_CELLS_IN_MEMORY": 100,
    "read.reading._CONVERTED_CHUNK_ROWS": 300,
    "read.alignment._INTERPOLATED_CHUNK_ROWS": 170,
    "pose_motion.splines._MAX_ROWS_PER_BLOCK": 260,
    "aligned_log._MIN_SAMPLES_AT_REDUCED_RATE": 300,
    "aligned_log._CHUNK_SAMPLES": 70,
    "aligned_log._FILTER_MARGIN_SAMPLES": 30,
}
"""Limits so low that a record of 10 s is read in parts, as an hour at 1 kHz."""


def test_long_log_read_in_parts_gives_the_same_load(from_whole, folder, tmp_path, monkeypatch):
    files = {}
    for stream in ("wrench", "pose"):
        files[stream] = f"own_{stream}.parquet"
        pl.read_csv(folder / f"own_{stream}.csv").write_parquet(tmp_path / files[stream])
    for name, value in LIMITS.items():
        monkeypatch.setattr(f"drake_teleop.logs.{name}", value)
    path = described(tmp_path, "own", wrench={"file": files["wrench"]}, file=files["pose"])
    parts = identify_log(path, cutoff_hz=10.0)
    assert not isinstance(read_table(tmp_path / files["pose"]).columns, dict)
    moved = parts.identification.phi - from_whole.identification.phi
    assert (np.abs(moved) < 0.02 * from_whole.identification.standard_deviations[6:]).all()
    few, all_ = parts.log, from_whole.log
    assert len(few) == pytest.approx(len(all_) / 5, abs=8)
    np.testing.assert_allclose(few.dt, 5 * all_.dt)
    same = np.searchsorted(all_.t, few.t - 1e-6)[5:-5]
    np.testing.assert_allclose(all_.t[same], few.t[5:-5], atol=1e-9)
    off = few.wrench[5:-5] - all_.wrench[same]
    assert (np.abs(off).max(axis=0) < 0.5 * from_whole.identification.residual_rms).all()
    for one, other in zip(few.motion, all_.motion, strict=True):
        scale = np.abs(other).max(axis=0)
        np.testing.assert_allclose(one[5:-5] / scale, other[same] / scale, atol=5e-3)
    np.testing.assert_allclose(
        parts.identification.residual_rms, from_whole.identification.residual_rms, rtol=0.1
    )


@pytest.mark.slow
def test_wrong_pose_frame_is_reported_with_the_lines_that_fix_it(folder):
    path = described(folder, "tcp")
    found = identify_log(path)
    (finding,) = found.findings
    assert finding.name == "pose frame"
    place, turn = (
        json.loads(finding.message.split(f"pose.{name}: ")[1].split(" and ")[0])
        for name in ("position_in_sensor", "rotation_in_sensor")
    )
    np.testing.assert_allclose(place, SHIFT, atol=1e-3)
    np.testing.assert_allclose(turn, TURN, atol=2e-3)
    mended = described(folder, "tcp", position_in_sensor=place, rotation_in_sensor=turn)
    found = identify_log(mended)
    assert not found.findings and found.identification.identifiable.all()
    assert np.abs(deviations(found)).max() < 4.0


@pytest.mark.slow
def test_reported_frame_is_relative_to_S_not_to_the_description(folder, tmp_path):
    """The description has half of the shift; the report has the full shift."""
    path = described(folder, "tcp", position_in_sensor=(0.5 * SHIFT).tolist(), frame=TURN.tolist())
    (finding,) = identify_log(path).findings
    assert "rotation_in_sensor" not in finding.message
    summary = inspect_command(path, tmp_path, quiet=True)
    assert finding.message.split("set ")[1] in summary["findings"][-1]["message"]
    place = json.loads(finding.message.split("position_in_sensor: ")[1])
    np.testing.assert_allclose(place, SHIFT, atol=1e-3)


def test_auto_estimates_the_frame_with_a_note(folder):
    path = described(folder, "tcp", position_in_sensor="auto", rotation_in_sensor="auto")
    log = read_log(path)
    assert log.posed is not None
    np.testing.assert_allclose(log.posed.p_SoPo_S, SHIFT, atol=1e-3)
    np.testing.assert_allclose(log.posed.R_SP, TURN, atol=1e-3)
    assert [note.split(" found")[0] for note in log.notes] == [
        "pose.position_in_sensor",
        "pose.rotation_in_sensor",
    ]


def test_undetermined_auto_raises_error(folder, tmp_path):
    t, wrench, poses = record(Kind(seed=3))
    rest = np.hstack([np.repeat(poses.quaternion[:1], len(poses.t), 0), 0.0 * poses.position])
    still = pl.DataFrame({"t": poses.t} | dict(zip(POSE, rest.T, strict=True)))
    noise = np.random.default_rng(0).normal(size=wrench.shape) + wrench[:1]
    moved = pl.DataFrame({"t": t} | dict(zip(WRENCH, noise.T, strict=True)))
    still.write_csv(tmp_path / "rest_pose.csv")
    moved.write_csv(tmp_path / "rest_wrench.csv")
    with pytest.raises(DrakeTeleopError, match="do not determine the pose's origin along x, y, z"):
        read_log(described(tmp_path, "rest", position_in_sensor="auto"))
    still[:40].write_csv(tmp_path / "short_pose.csv")
    moved[:60].write_csv(tmp_path / "short_wrench.csv")
    with pytest.raises(DrakeTeleopError, match=r"\.yaml:pose: wrench and poses share .* required"):
        read_log(described(tmp_path, "short", position_in_sensor="auto"))


@pytest.mark.parametrize(
    ("pose", "wrench", "message"),
    [
        ({"frame": TURN.tolist(), "rotation_in_sensor": TURN.tolist()}, {}, "give one of them"),
        ({"position": None, "position_in_sensor": "auto"}, {}, "require pose.position"),
        ({"rotation_in_sensor": "auto"}, {"frame": "base"}, "axes of the sensor, not in base"),
        ({"rotation_in_sensor": "base"}, {}, "must be a 3x3 rotation matrix"),
        ({"rotation_in_sensor": "tool"}, {}, "from the stream to S, or the word auto"),
        ({}, {"gain_std": -0.1}, "greater than or equal to 0"),
    ],
)
def test_contradictory_description_raises_error(folder, pose, wrench, message):
    with pytest.raises(DrakeTeleopError, match=message):
        load_description(described(folder, "own", wrench, **pose))


@pytest.mark.parametrize("seed", range(3))
def test_found_frame_and_described_frame_are_composed(seed):
    """The description has put the pose into a frame that is shifted and rotated in S."""
    X_SD, X_DP = np.tile(np.eye(4), (2, 1, 1))
    rng = np.random.default_rng(seed)
    for X in (X_SD, X_DP):
        X[:3, :3] = rotation_matrices(rng.uniform(-1.0, 1.0, (1, 3)), "rotation_vector")[0]
        X[:3, 3] = rng.uniform(-0.1, 0.1, 3)
    found = SimpleNamespace(
        frame=SimpleNamespace(
            is_shifted=True, is_rotated=True, p_SoPo_S=X_SD[:3, 3], R_SP=X_SD[:3, :3],
            position_stds_m=np.full(3, 1e-3), rotation_stds_deg=np.full(3, 0.1),
        ),
        units_and_axes=SimpleNamespace(
            position_unit_ratio=1.0, position_unit_ratio_std=0.01, is_usable=False
        ),
        free_frame_fit=SimpleNamespace(parameters=SimpleNamespace(theta=np.r_[np.zeros(6), PHI])),
    )  # fmt: skip
    _, _, poses = record(Kind(seed=4))
    posed = PosesOfLog(poses, GRAVITY_W, X_DP[:3, 3], X_DP[:3, :3])
    lines = pose_frame_finding(found, posed).message.split("; set ")[1].split(" and ")
    place, turn = (json.loads(line.split(": ")[1]) for line in lines)
    X_SP = X_SD @ X_DP
    np.testing.assert_allclose(place, X_SP[:3, 3], atol=1e-4)
    np.testing.assert_allclose(turn, X_SP[:3, :3], atol=1e-4)


@pytest.mark.parametrize("unit", [1e-3, 8.8507])
def test_wrong_torque_unit_is_not_reported_as_a_shift(unit):
    """The motion determines r + R c and the torque c, so a lever along c resembles a wrong unit."""
    t, wrench, poses = record(Kind(seed=4))
    wrench = wrench * np.repeat([1.0, unit], 3)
    posed = PosesOfLog(poses, GRAVITY_W)
    found = estimate_from_poses(t, wrench, poses, GRAVITY_W)
    assert pose_frame_finding(found, posed) is None


@pytest.mark.parametrize("inverse", [False, True])
def test_quaternions_and_matrices_give_the_same_poses(tmp_path, inverse):
    t, wrench, poses = record(Kind(seed=3))
    q = 1.002 * poses.quaternion[:, [1, 2, 3, 0]]  # length error by rounding
    R = rotation_matrices(poses.quaternion, "quaternion_wxyz").reshape(-1, 9)
    columns = {"t": t} | dict(zip(WRENCH, wrench.T, strict=True))
    pl.DataFrame(columns).write_parquet(tmp_path / "a_wrench.parquet")
    columns = {"t": poses.t, "q": q, "R": R, "p": poses.position}
    np.savez(tmp_path / "a_pose.npz", **columns)
    read = []
    for form, column in (("quaternion_xyzw", "q"), ("matrix", "R")):
        path = described(
            tmp_path,
            "a",
            {"file": "a_wrench.parquet"},
            file="a_pose.npz",
            orientation={"columns": [column], "form": form, "inverse": inverse},
            position={"columns": ["p"]},
            position_in_sensor=[0.1, 0.0, -0.2],
        )
        posed = read_log(path, differentiate=False).posed
        assert posed is not None
        read.append(posed.poses)
    one, other = (rotation_matrices(x.quaternion, "quaternion_wxyz") for x in read)
    np.testing.assert_allclose(one, other, atol=1e-12)
    np.testing.assert_allclose(read[0].position, read[1].position, atol=1e-12)
