"""Poses of a left-handed world: no load is stated, and the remedy makes the log usable."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from known_motion import motion_at, quaternions
from planted import OFFSETS, PHI, Columns, written

from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.logs.check.handedness import left_handed_pose_finding
from drake_teleop.logs.processing import check_log, identify_log
from drake_teleop.logs.read.reading import read_log

MIRRORS = {
    "x": np.diag([-1.0, 1.0, 1.0]),
    "y": np.diag([1.0, -1.0, 1.0]),
    "z": np.diag([1.0, 1.0, -1.0]),
    "Unity": np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]),
}


def record(world: np.ndarray, body: np.ndarray, duration_s: float = 3.0) -> Columns:
    """Return a wrench in right-handed S, and poses in a world and a frame S changed by matrices."""
    rng, t = np.random.default_rng(2), np.arange(0.0, duration_s, 0.005)
    at = motion_at(t)
    wrench = non_contact_wrench(at.specific_force, at.omega, at.alpha, PHI) + OFFSETS
    wrench += rng.normal(size=wrench.shape) * np.repeat([0.05, 0.003], 3)
    position = at.p_WS @ world.T + 2e-5 * rng.normal(size=(len(t), 3))
    R = world @ at.R_WS @ body.T
    columns = {"t": t, "force": wrench[:, :3], "torque": wrench[:, 3:], "R": R, "p": position}
    return columns | {"s": at.specific_force, "omega": at.omega}


@pytest.mark.parametrize("body", MIRRORS)
@pytest.mark.parametrize("world", MIRRORS)
def test_mirrored_poses_are_named(tmp_path: Path, world: str, body: str) -> None:
    path = written(tmp_path, record(MIRRORS[world], MIRRORS[body]), imu=False)
    finding = left_handed_pose_finding(read_log(path), None, 0.0)
    assert finding is not None and "negate y of the positions" in finding.message


@pytest.mark.parametrize("change", ["nothing", "gravity", "axes", "sign", "torque sign", "unit"])
@pytest.mark.parametrize("turn", [np.eye(3), np.eye(3)[[2, 0, 1]]])
def test_other_errors_are_not_called_left_handed(
    tmp_path: Path, change: str, turn: np.ndarray
) -> None:
    c = record(turn if change == "gravity" else np.eye(3), turn)
    if change == "axes":
        c["force"], c["torque"] = c["force"][:, [1, 2, 0]], c["torque"][:, [1, 2, 0]]
    if change in ("sign", "torque sign"):
        c["torque"] = -c["torque"]
        c["force"] = -c["force"] if change == "sign" else c["force"]
    if change == "unit":
        c["torque"] = 1e3 * c["torque"]
    path = written(tmp_path, c, imu=False)
    assert left_handed_pose_finding(read_log(path), None, 0.0) is None


@pytest.mark.slow
@pytest.mark.parametrize(("mirror", "duration_s"), [("z", 3.0), ("y", 6.0)])
def test_no_load_is_identified_from_mirrored_poses(
    tmp_path: Path, mirror: str, duration_s: float
) -> None:
    D = MIRRORS[mirror]
    path = written(tmp_path, record(D, D, duration_s), imu=False)
    identified = identify_log(path)
    assert [x.name for x in identified.findings] == ["left-handed"]
    assert not identified.identification.identifiable.any()
    if mirror == "y":  # the remedy restores the right-handed poses
        c = record(D, D, duration_s)
        c["q"] = quaternions(c["R"]) * [1.0, -1.0, 1.0, -1.0]
        c["p"] = c["p"] * [1.0, -1.0, 1.0]
        found = identify_log(written(tmp_path, c, imu=False))
        assert found.findings == ()
        assert found.identification.mass == pytest.approx(PHI[0], rel=0.01)
    else:
        assert [x.name for x in check_log(path).findings] == ["left-handed"]


@pytest.mark.parametrize("axis", ["x", "y", "z"])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_sign_of_the_wrench_does_not_hide_mirrored_poses(
    tmp_path: Path, axis: str, sign: float
) -> None:
    c = record(MIRRORS[axis], MIRRORS[axis])
    c["force"], c["torque"] = sign * c["force"], sign * c["torque"]
    path = written(tmp_path, c, imu=False)
    assert left_handed_pose_finding(read_log(path), None, 0.0) is not None
