"""`drake-teleop detect`: contact is found in logs, and fast motion is not contact."""

from __future__ import annotations

import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import polars as pl
import pytest
from click.testing import CliRunner
from test_log_commands import GRAVITY, describe_poses, describe_record

from drake_teleop.cli.logs import detect_command, eliminate_command, identify_command
from drake_teleop.cli.main import cli
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.logs.processing import detect_log, eliminate_log, identify_log
from drake_teleop.logs.read.canonical import Log, write_log
from drake_teleop.logs.summaries import shares_of_samples_above_force, summarize_log

TOOL = phi_from_mass_com_inertia(1.5, [0.01, -0.02, 0.1], np.diag([0.01, 0.009, 0.004]))
OFFSETS = np.array([3.0, -2.0, 7.0, 0.1, 0.2, -0.3])


def log_with_push(path: Path, push: np.ndarray, seed: int) -> Path:
    """Write 8 s of rotation and vibration; the environment pushes the tip from 5 s to 6 s."""
    t = np.arange(0.0, 8.0, 2e-3)
    rng = np.random.default_rng(seed)

    def sines(low: float, high: float, size: float) -> np.ndarray:
        angles = 2 * np.pi * rng.uniform(low, high, 3) * t[:, None] + rng.uniform(0, 6, 3)
        return size * np.sin(angles)

    s = sines(0.5, 3.0, 3.0) + sines(0.1, 0.3, 8.0)
    omega, alpha = sines(0.3, 1.0, 1.5), sines(0.5, 3.0, 6.0)
    wrench = OFFSETS + non_contact_wrench(s, omega, alpha, TOOL)
    wrench += rng.normal(size=wrench.shape) * np.repeat([0.1, 0.004], 3)
    pressed = (t >= 5.0) & (t < 6.0)
    # The wrench is that of the sensor on the tool: F_c = -F_env.
    wrench[pressed] -= np.r_[push, np.cross([0.0, 0.0, 0.2], push)]
    write_log(Log(t, wrench, s, omega, alpha), path)
    return path


@pytest.mark.pictures
@pytest.mark.parametrize("statistic", ["level", "cusum", "glr"])
def test_a_push_is_found_with_its_direction_and_place(tmp_path: Path, statistic: str) -> None:
    free = log_with_push(tmp_path / "free.parquet", np.zeros(3), 1)
    load = tmp_path / "identification.json"
    identify_log(free, delay=0.0).identification.save(load)
    log = log_with_push(tmp_path / "log.parquet", np.array([0.0, 1.0, 0.0]), 2)
    out = tmp_path / "out"
    arguments = ["detect", str(log), "--load", str(load), "--free", str(free), "--delay", "0"]
    result = CliRunner().invoke(cli, [*arguments, "--statistic", statistic, "--out", str(out)])
    assert result.exit_code == 0, result.output
    summary = json.loads((out / "summary.json").read_text())
    (touch,) = summary["contacts"]
    assert touch["start_s"] == pytest.approx(5.0, abs=0.03)
    assert touch["stop_s"] == pytest.approx(6.0, abs=0.1)
    np.testing.assert_allclose(touch["push"], [0, 1, 0], atol=0.2)
    assert touch["point_m"][2] == pytest.approx(0.2, abs=0.04)
    table = pl.read_parquet(out / "detection.parquet")
    assert table["in_contact"].mean() == pytest.approx(summary["in_contact"])
    assert (out / "detection.png").stat().st_size > 10_000
    assert f"{touch['start_s']:.3f}" in result.output


@pytest.mark.slow
def test_log_without_load_and_free_record_uses_its_own(tmp_path: Path) -> None:
    log = log_with_push(tmp_path / "log.parquet", np.array([3.0, 0.0, 0.0]), 3)
    summary = detect_command(log, tmp_path, delay=0.0, quiet=True)
    (touch,) = summary["contacts"]
    assert touch["start_s"] == pytest.approx(5.0, abs=0.05)
    assert summary["free"] is None
    assert summary["load"] is None


@pytest.mark.slow
def test_detect_and_eliminate_report_the_same_contacts_as_with_free_motion(tmp_path: Path) -> None:
    """A push of 20 N rises slowly and lasts a third of the record."""
    free = log_with_push(tmp_path / "free.parquet", np.zeros(3), 1)
    load = tmp_path / "identification.json"
    identify_log(free, delay=0.0).identification.save(load)
    log = log_with_push(tmp_path / "log.parquet", np.zeros(3), 2)
    table = pl.read_parquet(log)
    t = table["t"].to_numpy()
    rise = np.where((t > 4.0) & (t < 6.7), np.sin(np.pi * (t - 4.0) / 2.7) ** 2, 0.0)
    table.with_columns(f_y=pl.col("f_y") - 20.0 * rise).write_parquet(log)
    known, own = (detect_log(log, load, free=calm, delay=0.0) for calm in (free, None))
    for found, calm in ((known, free), (own, None)):
        other = eliminate_log(log, load, free=calm, delay=0.0)
        assert other.detection is not None
        assert other.detection.threshold == found.threshold
        np.testing.assert_array_equal(other.touched, found.touched)
    assert own.threshold < 1.6 / 1.25 * 1.1 * known.threshold
    start, start_known = (t[np.argmax(found.touched)] for found in (own, known))
    assert start == pytest.approx(start_known, abs=0.03)
    assert 4.0 < start < 4.12
    assert known.notes == ()
    # Contact during most of the record also shifts its offsets, and a note states this.
    pushed = pl.when((pl.col("t") > 2.0) & (pl.col("t") < 7.5)).then(6.0).otherwise(0.0)
    most = tmp_path / "most.parquet"
    table.with_columns(f_y=pl.col("f_y") - pushed).write_parquet(most)
    (note,) = detect_log(most, load, free=free, delay=0.0).notes
    assert "differ by 6 N from" in note
    out = tmp_path / "out"
    arguments = ["eliminate", str(log), "--load", str(load), "--free", str(free), "--delay", "0"]
    result = CliRunner().invoke(cli, [*arguments, "--out", str(out)])
    assert result.exit_code == 0, result.output
    summary = json.loads((out / "summary.json").read_text())
    assert summary["free"] == str(free)
    assert summary["threshold"] == known.threshold
    assert [c["start_s"] for c in summary["contacts"]] == [start_known]


@pytest.mark.slow
def test_poses_and_unknown_statistics_are_refused(ntnu: Path, tmp_path: Path) -> None:
    poses = describe_poses(tmp_path, ntnu, GRAVITY)
    with pytest.raises(DrakeTeleopError, match="at rest"):
        detect_log(poses)
    with pytest.raises(DrakeTeleopError, match="not a statistic"):
        detect_log(describe_record(tmp_path, ntnu, "1-baseline"), statistic="sum")


@pytest.mark.quick_cases(1)
@pytest.mark.slow
@pytest.mark.parametrize("statistic", ["level", "cusum", "glr"])
def test_ntnu_hammer_is_not_detected_as_contact(ntnu: Path, tmp_path: Path, statistic: str) -> None:
    """The threshold is that of the calm record; in the other, a hammer hits the robot."""
    load = tmp_path / "identification.json"
    identify_log(describe_poses(tmp_path, ntnu, GRAVITY)).identification.save(load)
    calm, shaken = (describe_record(tmp_path, ntnu, r) for r in ("1-baseline", "2-vibrations"))
    options = {"load": load, "statistic": statistic, "quiet": True}
    found = detect_command(shaken, tmp_path / "shaken", free=calm, **options)
    assert found["above_threshold"] <= 0.009
    assert found["above_force_threshold"]["raw"] > 0.85
    # A threshold that is equal for all motions is exceeded more often.
    assert found["above_force_threshold"]["eliminated"] > 2 * found["above_threshold"]
    # In reverse, so that no record sets its own threshold.
    calm_again = detect_command(calm, tmp_path / "calm", free=shaken, **options)
    assert calm_again["above_threshold"] == 0.0
    itself = detect_command(calm, tmp_path / "itself", free=calm, **options)
    assert itself["above_threshold"] == 0.0
    assert itself["above_force_threshold"]["raw"] > 0.85


@pytest.mark.parametrize("offset", [0.0, -2.0, 30.0])
def test_force_of_a_tared_sensor_is_relative_to_its_first_sample(offset: float) -> None:
    contact = np.outer(np.arange(8.0), [0.0, 0.6, -0.8, 50.0, 0.0, 0.0])
    wrenches: dict[str, Any] = {"measured": contact + offset, "contact": 0.5 * contact}
    for weightless, share in ((None, None), (2.0 * contact, 4 / 6)):
        edge = np.arange(8) > 5
        found = SimpleNamespace(**wrenches, gravity_only=weightless, edge=edge)
        shares = shares_of_samples_above_force(found, 3.5)
        assert shares == {"raw": 2 / 6, "gravity_only": share, "eliminated": 0.0}


def missing(summary: dict[str, Any], path: str = "") -> list[str]:
    """Return force residuals in a summary that have no counterpart of the torque."""
    left = re.compile("residual|rms|peak")
    names = []
    for name, value in summary.items():
        if isinstance(value, dict):
            names += missing(value, f"{path}{name}.")
        elif left.search(name) and not isinstance(value, list) and "torque" not in name:
            if name.endswith("per_channel"):  # may be null
                continue
            start, _, end = name.rpartition("_")
            twins = {f"{start}_torque_{end}", name.replace("force", "torque")}
            if not (twins - {name}) & set(summary):
                names.append(path + name)
    return names


@pytest.mark.slow
def test_force_residuals_have_torques(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = log_with_push(tmp_path / "log.parquet", np.zeros(3), 1)
    identified = identify_command(log, tmp_path, delay=0.0)
    options = {"causal": "delayed", "delay": 0.0}
    eliminated = eliminate_command(log, tmp_path / "identification.json", tmp_path / "e", **options)
    assert missing(identified) == [] and missing(eliminated) == []
    assert missing({"residual_rms_force": 1.0}) == ["residual_rms_force"]
    printed = capsys.readouterr().out.replace("\n", " ")
    for words in ("residual", "largest contact force", "causal: "):
        _, _, rest = printed.partition(words)
        assert re.match(r"[^;]*? N[ ,][^;]*? N m", rest), words
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "rms of the force and of the torque that" in page


@pytest.mark.slow
@pytest.mark.parametrize("count", [60, 133])
def test_too_short_records_are_one_error_with_a_valid_remedy(tmp_path: Path, count: int) -> None:
    long = log_with_push(tmp_path / "long.parquet", np.zeros(3), 1)
    load = identify_log(long, delay=0.0).identification
    for samples in (count, count + 160):
        pl.read_parquet(long)[:samples].write_parquet(tmp_path / "short.parquet")
        short = tmp_path / "short.parquet"
        calls: list[dict[str, Any]] = [{"path": short}, {"path": long, "free": short}]
        for options in calls:
            if samples > count:
                detect_log(load=load, delay=0.0, **options)
                continue
            with pytest.raises(DrakeTeleopError, match="samples are too few") as error:
                detect_log(load=load, delay=0.0, **options)
            text = str(error.value)
            assert ("free: " in text) == ("free" in options)
            assert "besides its ends" in text or "give a longer record" in text


@pytest.mark.parametrize(("rate", "cutoff", "used"), [(50, 30.0, None), (61, 30.0, 30.0)])
@pytest.mark.parametrize("static", [False, True])
def test_summary_states_the_cutoff_only_of_a_used_low_pass(
    rate: float, cutoff: float, used: float | None, static: bool
) -> None:
    ones = np.ones((20, 3))
    log = Log(np.arange(20) / rate, np.ones((20, 6)), ones, ones, ones, static=static)
    found: Any = SimpleNamespace(log=log, findings=(), delay_source="given")
    assert summarize_log(Path("log"), found, cutoff, 0.0)["cutoff_hz"] == (None if static else used)
    assert summarize_log(Path("log"), found, None, 0.0)["cutoff_hz"] is None
