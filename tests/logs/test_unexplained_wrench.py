"""Records whose wrench the motion explains only in part: no precise load is stated."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from planted import PHI, Columns, good, written

from drake_teleop.logs.explained_log import add_errors_of_load
from drake_teleop.logs.processing import identify_log


def about_another_point(columns: Columns, distance_m: float) -> None:
    arm = np.array([0.02, -0.01, distance_m])
    columns["torque"] = columns["torque"] - np.cross(arm, columns["force"])


def with_clipped_gyroscope(columns: Columns, share: float) -> None:
    limit = share * np.abs(columns["omega"]).max(axis=0)
    columns["omega"] = np.clip(columns["omega"], -limit, limit)


def with_aliased_vibration(columns: Columns, size_m_s2: float) -> None:
    """Add an acceleration to the reading of the accelerometer that the wrench does not contain."""
    noise = np.random.default_rng(3).normal(size=columns["s"].shape)
    columns["s"] = columns["s"] + size_m_s2 * np.repeat(noise[::4], 4, axis=0)[: len(noise)]


def is_within_five_deviations(path: Path) -> np.ndarray:
    load = identify_log(path).identification
    error = np.abs(load.phi - PHI)
    deviations = np.sqrt(np.diag(load.covariance))[6:]
    return np.asarray((error < 5.0 * deviations) | ~load.identifiable[6:])


@pytest.mark.quick_cases(1)
@pytest.mark.slow
@pytest.mark.parametrize("distance_m", [0.15, 0.1, 0.06])
def test_torque_about_another_point_gives_no_precise_load(
    tmp_path: Path, distance_m: float
) -> None:
    columns = good()
    about_another_point(columns, distance_m)
    assert not identify_log(written(tmp_path, columns)).identification.identifiable[6:].any()


@pytest.mark.quick_cases(1)
@pytest.mark.slow
@pytest.mark.parametrize("share", [0.3, 0.6])
@pytest.mark.parametrize("pose", [False, True])
def test_clipped_gyroscope_gives_no_precise_wrong_load(
    tmp_path: Path, share: float, pose: bool
) -> None:
    columns = good()
    with_clipped_gyroscope(columns, share)
    assert is_within_five_deviations(written(tmp_path, columns, pose=pose)).all()


@pytest.mark.quick_cases(1)
@pytest.mark.slow
@pytest.mark.parametrize("size_m_s2", [1.0, 3.0])
def test_aliased_vibration_gives_no_precise_wrong_load(tmp_path: Path, size_m_s2: float) -> None:
    columns = good()
    with_aliased_vibration(columns, size_m_s2)
    path = written(tmp_path, columns, pose=False)
    assert abs(identify_log(path).identification.mass - PHI[0]) > 0.002 * PHI[0]
    assert is_within_five_deviations(path).all()


@pytest.mark.slow
def test_pushes_that_the_fit_rejects_do_not_widen_the_intervals(tmp_path: Path) -> None:
    """The pushes have about 40 % of the variance, which alone is a deviation of 1.2 kg."""
    rng, columns = np.random.default_rng(0), good()
    count = len(columns["t"]) // 40 + 1
    pushed = (rng.random(count) < 0.2)[:, None] * 90.0 * rng.normal(size=(count, 3))
    columns["force"] = columns["force"] + np.repeat(pushed, 40, axis=0)[: len(columns["t"])]
    load = identify_log(written(tmp_path, columns, pose=False)).identification
    assert load.mass == pytest.approx(PHI[0], rel=0.01)
    assert np.sqrt(load.covariance[6, 6]) < 1.0


@pytest.mark.slow
def test_errors_of_the_load_add_to_its_variances(tmp_path: Path) -> None:
    load = identify_log(written(tmp_path, good(), imu=False)).identification
    errors = np.arange(10.0) * 1e-3
    wider = add_errors_of_load(load, errors)
    added = np.diag(wider.covariance - load.covariance)
    np.testing.assert_allclose(added, np.append(np.zeros(6), errors**2), atol=1e-12)
    assert not add_errors_of_load(load, np.full(10, 10.0)).identifiable[6:].any()
