"""Sample logs of a sensor that is not connected, or with a coarse clock."""

from __future__ import annotations

import numpy as np
import planted
import polars as pl
import pytest

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.logs import processing
from drake_teleop.logs.check import conventions
from drake_teleop.logs.inspection import inspect_command
from drake_teleop.logs.processing import identify_log
from drake_teleop.logs.sample import sample_log_command


@pytest.fixture(scope="module")
def sample_tables(tmp_path_factory):
    """Return a folder and the tables of a sample log, to be damaged."""
    folder = tmp_path_factory.mktemp("sample")
    sample_log_command(folder, quiet=True)
    return folder, pl.read_csv(folder / "free_wrench.csv"), pl.read_csv(folder / "free_pose.csv")


@pytest.mark.quick_cases(1)
@pytest.mark.slow
@pytest.mark.parametrize(("wrench_ms", "pose_ms"), [(200, 0), (0, 100), (100, 100)])
def test_load_is_identified_with_coarse_stamps(sample_tables, wrench_ms, pose_ms):
    """Checks of the fit use thinned rows and stamps."""
    folder, wrench, pose = sample_tables
    if wrench_ms:
        wrench = wrench.with_columns((pl.col("time") / wrench_ms).floor() * wrench_ms)
    if pose_ms:
        step = 1e-3 * pose_ms
        pose = pose.with_columns((pl.col("uptime") / step).floor() * step)
    wrench.write_csv(folder / "free_wrench.csv")
    pose.write_csv(folder / "free_pose.csv")
    found = identify_log(folder / "free.yaml").identification
    assert found.mass == pytest.approx(0.95, abs=2e-3)


@pytest.mark.quick_cases(1)
@pytest.mark.slow
@pytest.mark.parametrize("error", [DrakeTeleopError, OverflowError, np.linalg.LinAlgError])
def test_failing_check_does_not_stop_identify(sample_tables, error, monkeypatch):
    folder, wrench, pose = sample_tables
    wrench.write_csv(folder / "free_wrench.csv")
    pose.write_csv(folder / "free_pose.csv")

    def fail(*_):
        raise error("of our own")

    monkeypatch.setattr(processing, "check_conventions_of_file", fail)
    monkeypatch.setattr(conventions, "_has_dead_channel_or_imu_finding", lambda _: True)
    assert identify_log(folder / "free.yaml").identification.mass == pytest.approx(0.95, abs=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("change", [0.0, 1e-9])
@pytest.mark.parametrize("value", [3.5, -1e4, 0.0])
def test_constant_wrench_is_reported(sample_tables, change, value):
    """The driver of a sensor that is not connected repeats one value."""
    folder, wrench, pose = sample_tables
    names = [name for name in wrench.columns if name != "time"]
    noise = change * np.random.default_rng(0).normal(size=len(wrench))
    same = wrench.with_columns(*(pl.Series(name, value + value * noise) for name in names))
    same.write_csv(folder / "free_wrench.csv")
    pose.write_csv(folder / "free_pose.csv")
    with pytest.raises(DrakeTeleopError, match=r"the same in all samples|sensor is connected"):
        identify_log(folder / "free.yaml")
    inspect_command(folder / "free.yaml", folder / "inspected", quiet=True)


FROZEN_ROWS = slice(700, 1100)


def findings_of_edited_channel(tmp_path, name, edit):
    columns = planted.good()
    columns[name][:, 1] = edit(columns[name][:, 1].copy())
    return planted.findings(tmp_path, columns, imu=name == "omega")


@pytest.mark.slow
@pytest.mark.quick_cases(1)
@pytest.mark.parametrize("name", ["force", "torque", "omega"])
def test_channel_that_keeps_its_value_is_named_with_its_rows(tmp_path, name):
    def freeze(x):
        x[FROZEN_ROWS] = x[FROZEN_ROWS.start]
        return x

    message = findings_of_edited_channel(tmp_path, name, freeze)["dead channel"]
    column = {"force": "f1", "torque": "m1", "omega": "w1"}[name]
    assert f"{column} keeps the value" in message and "in rows 701 to 1100," in message


@pytest.mark.slow
@pytest.mark.quick_cases(1)
@pytest.mark.parametrize("name", ["torque", "force"])
def test_coarse_or_saturated_channels_are_not_frozen(tmp_path, name):
    def saturate(x):
        return x.clip(*np.quantile(x, [0.1, 0.9]))

    assert "dead channel" not in findings_of_edited_channel(tmp_path, name, saturate)

    def quantize(x):
        step = np.ptp(x) / 8
        return step * np.round(x / step)

    assert "dead channel" not in findings_of_edited_channel(tmp_path, name, quantize)
