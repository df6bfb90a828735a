"""Contact wrench from past samples only."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from known_motion import motion_at

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.identification import Identification
from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.logs.causal import causal_low_pass, compute_causal_wrench, low_pass_delay_s
from drake_teleop.logs.processing import eliminate_log, identify_log
from drake_teleop.logs.read.canonical import Log, write_log
from drake_teleop.logs.read.reading import read_log

DT, CUTOFF = 1e-3, 30.0


def test_the_low_pass_is_a_butterworth_of_second_order() -> None:
    t = np.arange(0, 4, DT)
    for rate in (5.0, 30.0, 90.0):
        wave = np.stack([np.sin(2 * np.pi * rate * t), np.cos(2 * np.pi * rate * t)], axis=1)
        after = causal_low_pass(wave, DT, CUTOFF)[2000:]
        # Prewarped: half at the cut-off; elsewhere the bilinear transform bends the axis.
        warped = np.tan(np.pi * rate * DT) / np.tan(np.pi * CUTOFF * DT)
        gain = np.sqrt(np.mean(after**2) / 0.5)
        assert gain == pytest.approx(1 / np.sqrt(1 + 3 * warped**4), rel=2e-3)


def test_low_pass_is_causal_and_starts_settled() -> None:
    x = np.full((400, 6), 3.0)
    np.testing.assert_allclose(causal_low_pass(x, DT, CUTOFF), 3.0, rtol=1e-12)
    stepped = x.copy()
    stepped[200:] += 1
    for ahead in (0.0, 0.01):
        a, b = (causal_low_pass(v, DT, CUTOFF, ahead) for v in (x, stepped))
        np.testing.assert_array_equal(a[:200], b[:200])
        assert (b[200] != a[200]).all()


@pytest.mark.parametrize(("delay", "wait"), [(0.0, 0), (0.0052, 6), (0.006, 6), (-0.004, 0)])
def test_ramp_has_the_stated_lag_or_is_predicted(delay: float, wait: int) -> None:
    ramp = np.outer(np.arange(0, 2, DT), [1.0, 2, 3, 4, 5, 6])
    options = {"cutoff_hz": CUTOFF, "delay_s": delay}
    late = compute_causal_wrench(ramp, 2 * ramp, DT, mode="delayed", **options)
    assert late.lag_s == pytest.approx(wait * DT + low_pass_delay_s(DT, CUTOFF))
    assert late.lag_s - wait * DT == pytest.approx(
        np.sqrt(2) * 3**0.25 / (2 * np.pi * CUTOFF), rel=0.005
    )
    slope = np.array([1.0, 2, 3, 4, 5, 6])
    np.testing.assert_allclose((ramp - late.contact)[1000:] / slope, late.lag_s, rtol=1e-6)
    np.testing.assert_allclose(late.scaled, 2 * late.contact, atol=1e-12)
    np.testing.assert_array_equal(late.contact[: wait + 1], 0.0)  # until the first sample arrives
    ahead = compute_causal_wrench(ramp, ramp, DT, mode="predicted", **options)
    np.testing.assert_allclose(ahead.contact[1000:], ramp[1000:], rtol=1e-6)


def test_prediction_increases_noise_by_the_stated_factor() -> None:
    noise = np.random.default_rng(5).normal(size=(200_000, 1))
    lag = low_pass_delay_s(DT, CUTOFF)
    plain, ahead = (causal_low_pass(noise, DT, CUTOFF, a).std() for a in (0.0, lag))
    assert ahead / plain == pytest.approx(np.sqrt(3), rel=0.04)


def test_unusable_options_raise() -> None:
    x = np.zeros((50, 6))
    with pytest.raises(DrakeTeleopError, match=r"^cutoff: None is not below .* Hz, half the rate"):
        compute_causal_wrench(x, x, DT, cutoff_hz=None, delay_s=0.005, mode="predicted")
    with pytest.raises(DrakeTeleopError, match="'soon' is not a causal mode"):
        compute_causal_wrench(x, x, DT, cutoff_hz=None, delay_s=0.0, mode="soon")
    same = compute_causal_wrench(x, x, DT, cutoff_hz=None, delay_s=0.0, mode="delayed")
    assert same.lag_s == 0.0


PHI = phi_from_mass_com_inertia(1.2, [0.0, 0.01, 0.05], np.diag([0.004, 0.004, 0.002]))
OFFSETS = np.array([1.0, 2.0, -1.0, 0.1, 0.0, 0.2])
LOAD = Identification(
    PHI, np.zeros(6), 1e-8 * np.eye(16), np.ones(16, bool), 1.0, 0.0, np.full(6, 0.01), "true", 999
)


def log_with_gaps(path: Path, period: float, recorded: float, seconds: float = 12.0) -> Path:
    """Write a log at 500 Hz that lacks the end of each `period` [s], after `recorded` [s]."""
    t = np.arange(0.0, seconds, 2e-3)
    at = motion_at(t)
    motion = at.specific_force, at.omega, at.alpha
    wrench = non_contact_wrench(*motion, PHI) + OFFSETS
    wrench += np.random.default_rng(1).normal(size=wrench.shape) * np.repeat([0.02, 0.002], 3)
    log = Log(t, wrench, *motion)
    log = replace(log.select_rows(t % period < recorded), source=str(path))
    write_log(log, path)
    return path


@pytest.mark.parametrize(("period", "recorded"), [(12.0, 12.0), (0.6, 0.4), (0.9, 0.6)])
def test_contact_free_start_excludes_gaps(period: float, recorded: float, tmp_path: Path) -> None:
    log = log_with_gaps(tmp_path / "log.parquet", period, recorded, 6.0)
    options = {"delay": 0.0, "causal": "delayed", "causal_tare_s": 1.5}
    found = eliminate_log(log, LOAD, **options).causal
    assert found is not None
    np.testing.assert_allclose(found.offsets, OFFSETS, atol=0.012)


@pytest.mark.parametrize("start", [-3.0, 1e3])
def test_spans_without_contact_begin_with_the_first_sample(start: float, tmp_path: Path) -> None:
    path = log_with_gaps(tmp_path / "log.parquet", 4.0, 4.0, 4.0)
    options = {"delay": 0.0, "causal": "delayed", "causal_tare_s": 1.5, "untouched_s": (0.5, 2.0)}
    wanted, log = eliminate_log(path, LOAD, **options), read_log(path)
    write_log(replace(log, t=log.t + start), path)
    found = eliminate_log(path, LOAD, **options)
    assert found.log.t[0] == pytest.approx(start)
    assert found.causal is not None and wanted.causal is not None
    np.testing.assert_allclose(found.offsets, wanted.offsets, atol=1e-9)
    np.testing.assert_allclose(found.causal.offsets, wanted.causal.offsets, atol=1e-9)


@pytest.mark.parametrize(
    ("period", "recorded", "identifies"), [(3.0, 2.5, False), (2.8, 2.2, False), (4.0, 3.4, True)]
)
def test_low_pass_that_reaches_from_gap_to_gap_is_an_error(
    period: float, recorded: float, identifies: bool, tmp_path: Path
) -> None:
    """`eliminate` needs samples that are far from the ends, too."""
    log = log_with_gaps(tmp_path / "log.parquet", period, recorded, 6.0)
    message = r"log.*: all samples are near gaps.*cut-off"
    with pytest.raises(DrakeTeleopError, match=message):
        eliminate_log(log, LOAD, delay=0.0, cutoff_hz=1.0)
    if not identifies:
        with pytest.raises(DrakeTeleopError, match=message):
            identify_log(log, delay=0.0, cutoff_hz=1.0)


@pytest.mark.parametrize("recorded", [0.12, 0.15])
def test_bursts_that_are_too_short_for_the_noise_model_have_no_causes(
    recorded: float, tmp_path: Path
) -> None:
    """Block means of 20 ms have no four predecessors in a burst."""
    found = identify_log(log_with_gaps(tmp_path / "log.parquet", 0.25, recorded, 24.0), delay=0.0)
    assert found.causes == () and found.identification.mass == pytest.approx(1.2, rel=0.01)
