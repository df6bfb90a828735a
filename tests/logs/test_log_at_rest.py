"""Records with little motion: noise of the poses counts neither as motion nor as a load."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from known_motion import GRAVITY_W
from planted import OFFSETS, PHI, Columns, good, written

from drake_teleop.common.rotations import rotation_matrices
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.logs import aligned_log
from drake_teleop.logs.check import against_load
from drake_teleop.logs.check.against_load import LoadFitQuality
from drake_teleop.logs.check.motion_size import explain_lack_of_motion, motion_rms
from drake_teleop.logs.processing import check_log, identify_log
from drake_teleop.logs.read.reading import read_log


def sway(size_mrad: float, noise_mm: float, sign: float = 1.0) -> Columns:
    """Return a wrench and poses that turn slowly, about two axes, by `size_mrad` at most."""
    rng, t = np.random.default_rng(3), np.arange(0, 20, 0.01)
    phases = np.array([0.0, 1.0, 2.0]) + np.outer(t, 2 * np.pi * np.array([0.23, 0.31, 0.17]))
    R = rotation_matrices([[0.4, -0.5, 0.2]], "rotation_vector")[0]
    R = R @ rotation_matrices(1e-3 * size_mrad * np.sin(phases), "rotation_vector")
    still = np.zeros((len(t), 3))
    wrench = non_contact_wrench(-R.swapaxes(1, 2) @ GRAVITY_W, still, still, PHI) + OFFSETS
    noise = rng.normal(size=(len(t), 12)) * np.repeat(
        [0.08, 0.003, 1e-3 * noise_mm, 2e-3 * noise_mm], 3
    )
    R = R @ rotation_matrices(noise[:, 9:], "rotation_vector")
    position = 0.3 + noise[:, 6:9]
    wrench = sign * (wrench + noise[:, :6])
    columns = {"t": t, "force": wrench[:, :3], "torque": wrench[:, 3:], "R": R, "p": position}
    return columns | {"s": still, "omega": still}


@pytest.mark.slow
@pytest.mark.quick_cases(3)
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(
    ("size_mrad", "noise_mm"), [(3.0, 0.05), (0.0, 0.3), (0.0, 0.1), (10.0, 0.05), (10.0, 0.3)]
)
def test_record_at_rest_causes_no_correction(
    tmp_path: Path, size_mrad: float, noise_mm: float, sign: float
) -> None:
    path = written(tmp_path, sway(size_mrad, noise_mm, sign), imu=False)
    found = check_log(path).findings
    assert {finding.name for finding in found} <= {"payload"}
    assert all(not finding.fields for finding in found)
    assert all("hardly moves or turns" in finding.message for finding in found)
    identified = identify_log(path)
    load = identified.identification
    assert {finding.name for finding in identified.findings} <= {"payload"}
    if load.identifiable[6]:  # never a wrong load or wrong offsets
        assert load.mass == pytest.approx(PHI[0], rel=0.1)
    if load.identifiable[:6].any():
        stds = np.maximum(load.standard_deviations[:6], 1e-12)
        assert (np.abs(load.offsets - OFFSETS) < 6.0 * stds).all()


@pytest.mark.slow
@pytest.mark.quick_cases(1)
@pytest.mark.parametrize("noise_mm", [0.02, 0.3])
def test_slow_rotation_corrects_the_sign(tmp_path: Path, noise_mm: float) -> None:
    path = written(tmp_path, sway(100.0, noise_mm, -1.0), imu=False)
    (finding,) = check_log(path).findings
    assert finding.fields == {"wrench.sign": -1}


def test_noise_of_poses_is_no_motion(tmp_path: Path) -> None:
    still = read_log(written(tmp_path, sway(0.0, 3.0), imu=False))
    rms_m_s2, rms_rad_s = motion_rms(still)
    assert rms_m_s2 < 0.06 and rms_rad_s < 0.02
    assert "hardly moves" in str(explain_lack_of_motion(still))
    assert explain_lack_of_motion(read_log(written(tmp_path, sway(25.0, 0.05), imu=False))) is None
    moving = read_log(written(tmp_path, sway(60.0, 0.3), imu=False))
    assert motion_rms(moving)[0] == pytest.approx(0.06 * 9.81 / np.sqrt(2) * 1.4, rel=0.3)
    assert explain_lack_of_motion(moving) is None


@pytest.mark.slow
@pytest.mark.quick_cases(1)
@pytest.mark.parametrize(("size_mrad", "noise_mm"), [(0.0, 0.1), (3.0, 0.05), (10.0, 0.3)])
def test_record_at_rest_has_one_pose_fit_and_no_search_over_wrench_edits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, size_mrad: float, noise_mm: float
) -> None:
    pose_fits, load_fits = [], []

    def count(module: Any, name: str, calls: list[int]) -> None:
        function = getattr(module, name)
        counted = lambda *a, **k: (calls.append(1), function(*a, **k))[1]  # noqa: E731
        monkeypatch.setattr(module, name, counted)

    count(aligned_log, "estimate_from_poses", pose_fits)
    count(against_load, "_fit_load_to_samples", load_fits)
    found = check_log(written(tmp_path, sway(size_mrad, noise_mm), imu=False))
    assert [finding.name for finding in found.findings] == ["payload"]
    assert len(pose_fits) == 1
    assert len(load_fits) < 10


def test_correction_with_an_implausible_mass_is_not_stated() -> None:
    given = LoadFitQuality(unexplained=0.8, mass=1.4)

    def fit(mass: float) -> Any:
        found = LoadFitQuality(unexplained=0.01, mass=mass)
        edited: Any = None
        return against_load._select_far_better_edits(lambda _: found, given, [(None, edited)])

    assert fit(1276.0) == []
    assert len(fit(1.5)) == 1


def test_motion_of_an_imu_counts_beside_poses_at_rest(tmp_path: Path) -> None:
    columns = good()
    size = len(columns["t"])
    noise = np.random.default_rng(1).normal(size=(size, 3))
    columns |= {"R": np.tile(np.eye(3), (size, 1, 1)), "p": 0.3 + 1e-5 * noise}
    s, omega = (float(np.linalg.norm(columns[x].std(axis=0))) for x in ("s", "omega"))
    assert motion_rms(read_log(written(tmp_path, columns))) == pytest.approx((s, omega), rel=0.1)
    by_pose = motion_rms(read_log(written(tmp_path, columns, imu=False)))
    assert by_pose[0] < 0.1 * s and by_pose[1] < 0.1 * omega
