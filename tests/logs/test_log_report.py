"""Report of identify: identified values are printed, undetermined ones are not."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from known_motion import motion_at

from drake_teleop.cli.logs import identify_command, print_identification
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.identification import PARAMETER_NAMES
from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.load.normal_equations import identify
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.logs.pictures import (
    amplitude_spectral_densities,
    draw_fit,
    draw_spectrum_and_intervals,
)
from drake_teleop.logs.processing import identify_log
from drake_teleop.logs.read.canonical import Log, write_log
from drake_teleop.logs.read.reading import read_log
from drake_teleop.logs.report import parameter_rows

PHI = phi_from_mass_com_inertia(1.9, [0.0, 0.01, 0.09], np.diag([0.008, 0.007, 0.004]))


def record(path: Path) -> Path:
    t = np.arange(0, 3, 2e-3)
    motion = motion_at(t)
    kinematics = motion.specific_force, motion.omega, motion.alpha
    noise = np.random.default_rng(4).normal(size=(len(t), 6)) * np.repeat([0.1, 0.01], 3)
    write_log(Log(t, non_contact_wrench(*kinematics, PHI) + 1.0 + noise, *kinematics), path)
    return path


@pytest.mark.slow
@pytest.mark.pictures
def test_page_is_self_contained_and_has_the_numbers_of_the_summary(tmp_path: Path) -> None:
    out = tmp_path / "out"
    summary = identify_command(record(tmp_path / "<log>.parquet"), out, delay=0.0, quiet=True)
    page = (out / "report.html").read_text(encoding="utf-8")
    assert (out / "report.png").stat().st_size > 50_000
    # The page loads no address, and text from the log is escaped.
    assert re.findall(r'(?:src|href)="(?!data:)', page) == []
    assert "://" not in page and "<log>" not in page and "&lt;log&gt;.parquet" in page
    assert page.count("data:image/png;base64,") == 2
    assert f"{summary['mass']:.4g}" in page
    assert page.count('"pill agrees"') == len(summary["identifiable"])
    assert "10 of 10" in page
    assert summary["determined"] == ["16 of 16 combinations of offsets and load are determined"]
    assert summary["verdicts"] == dict.fromkeys(PARAMETER_NAMES, "identified")
    low, high = np.array(summary["phi_interval"]).T
    assert ((low < summary["phi"]) & (summary["phi"] < high)).all()
    assert ((low - PHI) < (high - low)).all() and ((PHI - high) < (high - low)).all()


@pytest.mark.slow
def test_the_centre_of_mass_is_not_identifiable_without_the_mass(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    summary = identify_command(record(tmp_path / "log.parquet"), tmp_path, delay=0.0, quiet=True)
    for known, count in ((PARAMETER_NAMES, 0), ([x for x in PARAMETER_NAMES if x != "m"], 4)):
        print_identification(summary | {"identifiable": list(known)}, tmp_path)
        lines = [x for x in capsys.readouterr().out.splitlines() if "not identifiable" in x]
        assert len(lines) == count and all("mass" in x or "com" in x for x in lines)


def test_undetermined_parameter_has_no_value_in_the_table() -> None:
    rng = np.random.default_rng(1)
    s = rng.normal(size=(24, 3)) * 9
    rest = np.zeros((24, 3))
    wrench = non_contact_wrench(s, rest, rest, PHI) + 0.01 * rng.normal(size=(24, 6))
    rows = parameter_rows(identify(wrench, s, rest, rest))
    assert [row.verdict for row in rows[10:]] == ["not identified"] * 6
    assert {(row.value, row.deviation, row.interval) for row in rows[10:]} == {("–", "", "")}
    mass = rows[6]
    low, high = (float(text) for text in mass.interval.split(" … "))
    assert low < float(mass.value) < high
    assert (high - low) / 2 == pytest.approx(2.0 * float(mass.deviation), rel=0.3)
    # Two digits of the deviation.
    assert len(mass.deviation.replace("0.", "").lstrip("0")) == 2


def test_static_poses_have_a_page(tmp_path: Path) -> None:
    poses = tmp_path / "poses.csv"
    rng = np.random.default_rng(2)
    gravity = rng.normal(size=(15, 3))
    gravity *= 9.81 / np.linalg.norm(gravity, axis=1, keepdims=True)
    rest = np.zeros_like(gravity)
    wrench = non_contact_wrench(-gravity, rest, rest, PHI) + 0.01 * rng.normal(size=(15, 6))
    header = "fx,fy,fz,tx,ty,tz,gx,gy,gz"
    np.savetxt(poses, np.hstack([wrench, gravity]), delimiter=",", header=header, comments="")
    description = tmp_path / "poses.yaml"
    description.write_text(
        "static:\n  file: poses.csv\n  force: {columns: [fx, fy, fz]}\n"
        "  torque: {columns: [tx, ty, tz]}\n  gravity: {columns: [gx, gy, gz]}\n"
    )
    identify_command(description, tmp_path / "out", quiet=True)
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "15 poses at rest" in page and "not identified" in page
    assert page.count("4 of 10") == 1
    assert "10 of 16 combinations of offsets and load are determined" in page
    assert "without influence on this record: I_xx, I_xy, I_xz, I_yy, I_yz, I_zz" in page


def test_the_page_of_pictures_shows_all_channels_and_parameters(tmp_path: Path) -> None:
    found = identify_log(record(tmp_path / "log.parquet"), delay=0.0)
    axes = [*_all_axes(draw_fit(found)), *_all_axes(draw_spectrum_and_intervals(found))]
    # Six channels, two spectra, intervals, deviations.
    assert len(axes) == 10
    (intervals_axis,) = [axis for axis in axes if "intervals" in axis.get_title("left")]
    assert len(intervals_axis.get_yticklabels()) == 16


def _all_axes(figure) -> list:
    return [*figure.axes] or [axis for part in figure.subfigs for axis in _all_axes(part)]


def test_the_spectrum_has_the_power_of_the_signal() -> None:
    dt = 1e-3
    x = np.random.default_rng(3).normal(size=(40_000, 2)) * [1.0, 3.0]
    rate, density = amplitude_spectral_densities(x, dt)
    # White noise: variance over half the sampling rate, at every frequency.
    assert rate[-1] == pytest.approx(0.5 / dt)
    expected = np.array([1.0, 3.0]) * np.sqrt(2 * dt)
    np.testing.assert_allclose(np.sqrt(np.mean(density**2, axis=0)), expected, rtol=0.03)
    t = dt * np.arange(40_000)
    rate, density = amplitude_spectral_densities(np.sin(2 * np.pi * 50 * t)[:, None], dt)
    assert rate[np.argmax(density)] == pytest.approx(50, abs=0.3)


@pytest.mark.slow
def test_report_states_the_samples_rejected_by_a_robust_fit(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = record(tmp_path / "log.parquet")
    whole = identify_command(log, tmp_path / "a", delay=0.0, method="ordinary")
    assert whole["rejected"] == 0.0 and whole["method"] == "batch least squares"
    assert "rejected" not in capsys.readouterr().out
    tapped = read_log(log)
    wrench = tapped.wrench.copy()
    wrench[600:640] += [30.0, -20.0, 40.0, 2.0, 1.0, 0.5]
    write_log(replace(tapped, wrench=wrench), tmp_path / "tapped.parquet")
    errors = {}
    for method in ("ordinary", "robust"):
        summary = identify_command(tmp_path / "tapped.parquet", tmp_path / method, method=method,
                                   delay=0.0)  # fmt: skip
        errors[method] = np.linalg.norm(np.array(summary["phi"])[:4] - PHI[:4])
    assert summary["method"] == "robust least squares"
    # The low-pass at 30 Hz lengthens the 40 samples by about 20.
    assert 40 / 1500 < summary["rejected"] < 90 / 1500
    assert "rejected as disturbed" in capsys.readouterr().out
    assert errors["robust"] < 0.1 * errors["ordinary"]
    with pytest.raises(DrakeTeleopError, match="there is no estimator 'best'"):
        identify_log(log, method="best")
