"""Sensors with dead band, curvature or hysteresis: no wrong load is stated as identified."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from planted import PHI, Columns, written
from scipy.signal import lfilter
from test_sensor_filter import record

from drake_teleop.load.batch.methods import identify_batch
from drake_teleop.logs.check.nonlinear_sensor import error_of_load_by_nonlinear_sensor
from drake_teleop.logs.processing import identify_log
from drake_teleop.logs.read.reading import read_log

PARTS = ("force", "torque")


def distorted(kind: str, size: float, *, drift_N: float = 0.0) -> Columns:
    """Return a record whose sensor has an error of `size` times the largest reading or range."""
    columns = record(None, drift_N)
    for part in PARTS:
        x = columns[part]
        largest, width = np.abs(x).max(axis=0), np.ptp(x, axis=0)
        if kind == "dead band":
            columns[part] = np.sign(x) * np.maximum(np.abs(x) - size * largest, 0.0)
        elif kind == "curvature":
            columns[part] = x + size * largest * (x / largest) ** 3
        elif kind == "hysteresis":
            smooth, reading, half = lfilter([0.1], [1.0, -0.9], x - x[0], axis=0), 0.0, size * width
            for n in range(len(x)):
                reading = np.clip(reading, smooth[n] - half, smooth[n] + half)
                columns[part][n] = x[n] + reading - smooth[n]
        elif kind == "coloured noise":
            white = np.random.default_rng(5).normal(size=x.shape)
            columns[part] = x + size * width * 0.3 * lfilter([1.0], [1.0, -0.97], white, axis=0)
        elif kind == "vibration":
            swing = np.sin(2.0 * np.pi * 17.0 * columns["t"])[:, None]
            columns[part] = x + size * width * swing * [1.0, -0.5, 0.3]
    return columns


@pytest.mark.parametrize("imu", [True, False])
@pytest.mark.parametrize(
    ("kind", "size"),
    [
        *(("dead band", 0.02), ("dead band", 0.1), ("dead band", 0.2)),
        *(("curvature", 0.1), ("curvature", -0.3)),
        *(("hysteresis", 0.02), ("hysteresis", 0.04)),
    ],
)
def test_nonlinear_sensor_is_named_and_its_error_is_covered(
    tmp_path: Path, kind: str, size: float, imu: bool
) -> None:
    path = written(tmp_path, distorted(kind, size), imu=imu, pose=not imu)
    log = read_log(path, bandwidth_hz=15.0)
    load = identify_batch(log.wrench, *log.motion).identification
    errors, finding = error_of_load_by_nonlinear_sensor(log, load)
    assert finding is not None and finding.name == kind
    mass_error = abs(load.mass - PHI[0])
    assert 0.005 * PHI[0] < mass_error < 1.5 * abs(errors[0])


@pytest.mark.parametrize(
    ("kind", "size", "drift_N"),
    [
        *(("none", 0.0, 0.0), ("none", 0.0, 3.0)),
        *(("vibration", 0.02, 0.0), ("vibration", 0.2, 0.0)),
        *(("coloured noise", 0.005, 0.0), ("coloured noise", 0.05, 0.0)),
    ],
)
def test_noise_and_drift_are_no_nonlinear_sensor(
    tmp_path: Path, kind: str, size: float, drift_N: float
) -> None:
    path = written(tmp_path, distorted(kind, size, drift_N=drift_N), imu=False)
    log = read_log(path, bandwidth_hz=15.0)
    load = identify_batch(log.wrench, *log.motion).identification
    errors, finding = error_of_load_by_nonlinear_sensor(log, load)
    assert finding is None
    np.testing.assert_array_equal(errors, 0.0)


def test_small_nonlinearity_widens_the_intervals_only(tmp_path: Path) -> None:
    path = written(tmp_path, distorted("dead band", 0.004), imu=False)
    log = read_log(path, bandwidth_hz=15.0)
    load = identify_batch(log.wrench, *log.motion).identification
    errors, finding = error_of_load_by_nonlinear_sensor(log, load)
    assert finding is None
    assert 0.5 * abs(load.mass - PHI[0]) < abs(errors[0]) < 0.01 * PHI[0]
    assert np.any(errors != 0.0)


@pytest.mark.quick_cases(2)
@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "size", "imu"),
    [
        ("hysteresis", 0.02, False),
        ("dead band", 0.1, True),
        ("curvature", 0.2, False),
        ("dead band", 0.02, False),
    ],
)
def test_nothing_is_identified_with_a_nonlinear_sensor(
    tmp_path: Path, kind: str, size: float, imu: bool
) -> None:
    identified = identify_log(written(tmp_path, distorted(kind, size), imu=imu, pose=not imu))
    assert [finding.name for finding in identified.findings] == [kind]
    assert not identified.identification.identifiable.any()
