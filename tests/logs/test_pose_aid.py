"""IMU beside noisy poses: common splines, and rejection of the IMU."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from posed_record import GRAVITY_W, LATE, PHI, SECONDS, TRUTH, Kind, motion_at, record
from scipy.interpolate import BSpline

from drake_teleop.logs.pose_motion.estimate import estimate_from_poses
from drake_teleop.logs.pose_motion.imu_correction import (
    _fit_imu_gain_errors_bias_and_shift,
    correct_imu_data,
)
from drake_teleop.logs.pose_motion.poses import ImuData, Poses, PosesOfLog
from drake_teleop.logs.pose_motion.spectra import (
    FitWindow,
    Spectra,
    WrenchGrid,
    end_taper,
    pose_noise_moments,
)
from drake_teleop.logs.pose_motion.splines import (
    SPLINE_DEGREE,
    PoseSplines,
    SplineCache,
    _normal_equations_of_rates,
)
from drake_teleop.logs.processing import identify_log

RATE, NOISE = 250.0, (0.03, 2e-3)
BIAS, MATRIX = (
    np.array([0.2, -0.1, 0.05]),
    np.eye(3) + 0.02 * np.array([[0.3, 1.0, -0.5], [-1.0, -0.4, 0.2], [0.6, -0.1, 0.5]]),
)
ROUGH = Kind(place=1e-3, turn=1e-3, rate=50.0, seed=4)


def imu_data(seed: int, later: float = 0.0) -> ImuData:
    """Return an IMU with bias, gain and axis errors, on the clock of the poses plus `later`."""
    rng, t = np.random.default_rng([seed, 5]), np.arange(0.05, SECONDS - 0.05, 1 / RATE)
    at = motion_at(t - LATE - later)
    s, omega = (
        x @ MATRIX.T + k * BIAS + std * rng.normal(size=x.shape)
        for x, k, std in zip((at.specific_force, at.omega), (1.0, 0.1), NOISE, strict=True)
    )
    return ImuData(t, s, omega)


def poses_of(kind: Kind) -> tuple[np.ndarray, np.ndarray, Poses]:
    t, wrench, poses = record(kind)
    return t, wrench, poses.with_continuous_quaternions()


def test_poses_determine_bias_axes_clock_and_noise_of_an_imu():
    splines = PoseSplines(poses_of(Kind(seed=4))[2], 0.07)
    aid = correct_imu_data(splines, imu_data(4, later=0.008), GRAVITY_W)
    assert aid is not None
    truth = motion_at(aid.t - LATE)
    acceleration = np.einsum("nij,nj->ni", truth.R_WS, truth.specific_force) + GRAVITY_W
    error = (aid.acceleration_W - acceleration)[100:-100]
    assert np.sqrt((error**2).mean()) == pytest.approx(NOISE[0], rel=0.1)
    assert np.abs(error.mean(axis=0)).max() < 3e-3
    assert aid.imu_noise_powers == pytest.approx([x**2 / RATE for x in NOISE], rel=0.3)


@pytest.mark.parametrize("size", [1.0, 0.3, 1e-3])
def test_gains_of_an_imu_have_a_prior_of_10_percent(size):
    """Ridge regression: an axis that hardly rotates has no gain error."""
    rng, K = np.random.default_rng(7), 40
    y, X, one, change = rng.normal(size=(4, K, 3)) + 1j * rng.normal(size=(4, K, 3))
    X[:, 1] *= size
    one, weight = one[:, :1], rng.uniform(0.5, 2.0, K)
    rows = []
    for i in range(3):
        row = np.zeros((K, 13), complex)
        row[:, 3 * i : 3 * i + 3], row[:, 9 + i], row[:, 12] = X, one[:, 0], change[:, i]
        rows.append(np.column_stack([row, y[:, i]]) * weight[:, None])
    stacked = np.concatenate(rows)
    prior = np.column_stack([np.eye(9) / 0.1, np.zeros((9, 5))])
    stacked = np.concatenate([stacked.real, stacked.imag, prior])
    expected = np.linalg.lstsq(stacked[:, :13], stacked[:, 13], rcond=None)[0]
    D, b, shift = _fit_imu_gain_errors_bias_and_shift(y, X, one, change, weight)
    np.testing.assert_allclose([*D.ravel(), *b, shift], expected, atol=1e-10)


def test_derivatives_enter_the_normal_equations_as_rows():
    rng, t = np.random.default_rng(1), np.sort(np.random.default_rng(2).uniform(0.0, 3.0, 200))
    inner = np.arange(0.3, 2.8, 0.3)
    knots = np.concatenate([np.zeros(SPLINE_DEGREE + 1), inner, np.full(SPLINE_DEGREE + 1, 3.0)])
    x = rng.normal(size=(200, 2))
    size = len(knots) - SPLINE_DEGREE - 1
    for order in (1, 2):
        rows = BSpline(knots, np.eye(size), SPLINE_DEGREE).derivative(order)(t)
        band, right = _normal_equations_of_rates(t, x, knots, order)
        gram = sum(np.diag(band[SPLINE_DEGREE - k, k:], k) for k in range(SPLINE_DEGREE + 1))
        gram = gram + np.triu(gram, 1).T
        np.testing.assert_allclose(gram, rows.T @ rows, atol=1e-9 * np.abs(gram).max())
        np.testing.assert_allclose(right, rows.T @ x, atol=1e-9 * np.abs(right).max())


def test_noise_of_splines_of_poses_and_imu_is_predicted():
    """Means over 6 records, of acceleration and angular acceleration, 2 to 6 Hz."""
    exact = poses_of(replace(ROUGH, place=0.0, turn=0.0))[2]
    t = np.arange(0.0, SECONDS, 0.01)
    grid, taper = WrenchGrid(t, np.zeros((len(t), 6)), 1), end_taper(t, 1.0, SECONDS - 1.0)
    window = FitWindow(grid, taper, GRAVITY_W, 6.0)
    bands = window.bands
    clean = PoseSplines(exact, 0.05).signals(t, GRAVITY_W)
    sums, said = np.zeros(2), np.zeros(2)
    for seed in range(6):
        rng = np.random.default_rng(seed)
        moved = exact.position + ROUGH.place * rng.normal(size=exact.position.shape)
        # The quaternion contains half the angle.
        q = exact.quaternion + 0.5 * ROUGH.turn * rng.normal(size=exact.quaternion.shape)
        noisy = Poses(exact.t, moved, q / np.linalg.norm(q, axis=1, keepdims=True))
        aid = correct_imu_data(PoseSplines(noisy, 0.1), imu_data(seed), GRAVITY_W)
        assert aid is not None
        splines = SplineCache(noisy, aid).splines_with_spacing(0.05)
        error = splines.signals(t, GRAVITY_W) - clean
        power = bands.sums_over_bands(np.abs(window.signal_spectrum(error)) ** 2)
        spectra = Spectra(window, window.signal_spectrum(clean), 0.0, clean)
        Q = pose_noise_moments(splines, spectra, splines.estimate_pose_noise())
        fast = bands.sums_over_bands(bands.frequency) / bands.half_dof_of_bands > 2.0
        for k, where in enumerate((slice(1, 4), slice(7, 10))):
            sums[k] += power[fast, where].sum()
            said[k] += np.diagonal(Q, axis1=1, axis2=2)[fast, where].sum()
    np.testing.assert_allclose(said / sums, 1.0, atol=0.2)


@pytest.mark.slow
def test_imu_reduces_the_deviations_with_noisy_poses():
    t, wrench, poses = poses_of(ROUGH)
    alone = estimate_from_poses(t, wrench, poses, GRAVITY_W)
    both = estimate_from_poses(t, wrench, poses, GRAVITY_W, imu=imu_data(4))
    assert both.splines.imu_rows is not None
    deviations = np.sqrt(np.diag(both.covariance))
    assert np.abs((both.theta - TRUTH) / deviations).max() < 3.5
    inertia = deviations[10:] / np.sqrt(np.diag(alone.covariance))[10:]
    assert inertia.mean() < 0.8


def test_imu_with_other_axes_is_rejected():
    splines, imu = PoseSplines(poses_of(Kind(seed=4))[2], 0.07), imu_data(4)
    assert imu.specific_force is not None
    other = replace(imu, specific_force=imu.specific_force[:, [1, 0, 2]])
    assert correct_imu_data(splines, other, GRAVITY_W) is None


@pytest.mark.slow
@pytest.mark.slow  # two loads from files of 20 s
def test_identify_uses_both_but_only_the_imu_if_the_pose_frame_is_wrong(tmp_path):
    kinds = Kind(seed=4), Kind(seed=4, p_SoPo_S=(0.0, 0.0, 0.1))
    own, tcp = (identify_log(write_record(tmp_path / str(k), kind)) for k, kind in enumerate(kinds))
    assert not own.findings
    assert [finding.name for finding in tcp.findings] == ["pose frame"]
    of_splines, of_imu = (
        np.abs((x.log.specific_force - motion_at(x.log.t).specific_force)[500:-500]).max()
        for x in (own, tcp)
    )
    assert of_splines < 0.05 < of_imu  # the IMU has a bias and wrong gains
    load = own.identification
    assert np.abs((load.phi - PHI) / load.standard_deviations[6:]).max() < 4.0
    assert tcp.identification.mass == pytest.approx(PHI[0], rel=0.03)


def write_record(folder: Path, kind: Kind) -> Path:
    """Write the files of a record with an IMU and their description."""
    folder.mkdir()
    t, wrench, poses = record(kind)
    imu = imu_data(4)
    np.savez(folder / "wrench.npz", t=t, f=wrench[:, :3], tau=wrench[:, 3:])
    np.savez(folder / "pose.npz", t=poses.t, q=poses.quaternion, p=poses.position)
    np.savez(folder / "imu.npz", t=imu.t, s=imu.specific_force, omega=imu.angular_velocity)

    def stream(name: str, **columns: str) -> dict[str, Any]:
        fields = {field: {"columns": [column]} for field, column in columns.items()}
        return {"file": f"{name}.npz", "time": {"column": "t"}} | fields

    document: dict[str, Any] = {
        "gravity": GRAVITY_W.tolist(),
        "wrench": stream("wrench", force="f", torque="tau"),
        "pose": stream("pose", orientation="q", position="p"),
        "imu": stream("imu", specific_force="s", angular_velocity="omega"),
    }
    document["pose"]["orientation"]["form"] = "quaternion_wxyz"
    path = folder / "log.yaml"
    path.write_text(yaml.safe_dump(document))
    return path


@pytest.mark.parametrize("start", [-4.0, 50.0, 1e6])
def test_poses_and_imu_of_a_log_keep_one_clock(start):
    poses, imu = poses_of(Kind(seed=4))[2], imu_data(4)
    late = PosesOfLog(
        replace(poses, t=poses.t + start), GRAVITY_W, imu=replace(imu, t=imu.t + start)
    )
    moved = late.with_times_relative_to(start)
    np.testing.assert_allclose(moved.poses.t, poses.t, atol=1e-9)
    np.testing.assert_allclose(moved.imu.t, imu.t, atol=1e-9)


@pytest.mark.parametrize("count", [2, 5])
@pytest.mark.parametrize("gap_s", [0.0, 0.02, 3.0])
def test_means_of_an_imu_are_not_across_gaps(gap_s, count):
    t = np.arange(203.0) / RATE
    t[101:] += gap_s
    imu = ImuData(t, np.outer(t, [1.0, -2.0, 0.5]), None)
    found = imu.average_to_rate(0.99 * RATE / count)
    assert len(found.t) == len(t) // count - (gap_s > 0.0)
    np.testing.assert_allclose(found.specific_force, np.outer(found.t, [1.0, -2.0, 0.5]))
    assert np.abs(t - found.t[:, None]).min(axis=1).max() < 0.51 / RATE
