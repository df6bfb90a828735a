"""Sensors that remove slow or fast forces: no load is stated, and the cause is named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from known_motion import motion_at
from planted import OFFSETS, PHI, Columns, written
from scipy.signal import butter, lfilter

from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.logs.check.sensor_filter import sensor_filter_finding
from drake_teleop.logs.processing import identify_log
from drake_teleop.logs.read.reading import read_log


def record(
    cutoff_hz: float | None, drift_N: float = 0.0, duration_s: float = 12.0, order: int = 0
) -> Columns:
    """Return a record with a high-pass, or with a low-pass of `order` 1 or 2."""
    rng, t = np.random.default_rng(2), np.arange(0.0, duration_s, 0.005)
    at = motion_at(0.5 * t)
    a = 0.25 * (at.specific_force + np.einsum("nji,j->ni", at.R_WS, [0.0, 0.0, -9.81]))
    s = a - np.einsum("nji,j->ni", at.R_WS, [0.0, 0.0, -9.81])
    wrench = non_contact_wrench(s, 0.5 * at.omega, 0.25 * at.alpha, PHI) + OFFSETS
    if order and cutoff_hz is not None:
        low = butter(order, cutoff_hz, fs=200.0)
        wrench = lfilter(*low, wrench - wrench[0], axis=0) + wrench[0]
    elif cutoff_hz is not None:
        decay = np.exp(-2.0 * np.pi * cutoff_hz * 0.005)
        wrench = lfilter([1.0, -1.0], [1.0, -decay], wrench, axis=0)
    wrench += rng.normal(size=wrench.shape) * np.repeat([0.05, 0.003], 3)
    wrench[:, :3] += drift_N * (t / t[-1])[:, None] ** 1.5
    position = at.p_WS + 2e-5 * rng.normal(size=(len(t), 3))
    columns = {"t": t, "force": wrench[:, :3], "torque": wrench[:, 3:], "R": at.R_WS}
    return columns | {"p": position, "s": s, "omega": 0.5 * at.omega}


@pytest.mark.parametrize("imu", [True, False])
@pytest.mark.parametrize("cutoff_hz", [0.05, 0.1, 0.2, 0.5])
def test_high_pass_is_named_with_its_frequency(tmp_path: Path, cutoff_hz: float, imu: bool) -> None:
    path = written(tmp_path, record(cutoff_hz), imu=imu, pose=not imu)
    finding = sensor_filter_finding(read_log(path, bandwidth_hz=15.0), 0.0)
    assert finding is not None and "removes slow forces" in finding.message
    assert finding.values["cutoff_hz"] == pytest.approx(cutoff_hz, rel=0.25)


@pytest.mark.parametrize("drift_N", [0.0, 1.0, 10.0])
def test_drift_is_no_high_pass(tmp_path: Path, drift_N: float) -> None:
    path = written(tmp_path, record(None, drift_N), pose=False)
    assert sensor_filter_finding(read_log(path), 0.004) is None


@pytest.mark.parametrize(
    ("cutoff_hz", "order", "imu"),
    [(0.3, 1, True), (0.5, 2, True), (0.7, 1, False), (1.0, 2, False)],
)
def test_low_pass_is_named_with_its_frequency(
    tmp_path: Path, cutoff_hz: float, order: int, imu: bool
) -> None:
    path = written(tmp_path, record(cutoff_hz, order=order), imu=imu, pose=not imu)
    finding = sensor_filter_finding(read_log(path, bandwidth_hz=15.0), 0.0)
    assert finding is not None and "removes fast forces" in finding.message
    assert finding.values["cutoff_hz"] == pytest.approx(cutoff_hz, rel=0.1)


@pytest.mark.quick_cases(1)
@pytest.mark.slow
@pytest.mark.parametrize(("cutoff_hz", "order", "imu"), [(0.5, 1, True), (1.0, 2, False)])
def test_no_load_is_identified_from_forces_without_fast_parts(
    tmp_path: Path, cutoff_hz: float, order: int, imu: bool
) -> None:
    path = written(tmp_path, record(cutoff_hz, order=order), imu=imu, pose=not imu)
    identified = identify_log(path)
    assert [finding.name for finding in identified.findings] == ["low-pass"]
    assert not identified.identification.identifiable.any()


@pytest.mark.quick_cases(1)
@pytest.mark.slow
@pytest.mark.parametrize(("cutoff_hz", "imu"), [(0.05, False), (0.5, True)])
def test_no_load_is_identified_from_forces_without_slow_parts(
    tmp_path: Path, cutoff_hz: float, imu: bool
) -> None:
    identified = identify_log(written(tmp_path, record(cutoff_hz), imu=imu, pose=not imu))
    assert [finding.name for finding in identified.findings] == ["high-pass"]
    assert not identified.identification.identifiable.any()
