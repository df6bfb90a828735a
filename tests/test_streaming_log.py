"""Log on disk during a run: equal numbers, and no lost row."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from shown import hearing_ctrl_c

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.station import simulation
from drake_teleop.station.operator.operator import OperatorConfig, Sine
from drake_teleop.station.result import Signal, SimulationResult
from drake_teleop.station.scenario import Scenario, replace
from drake_teleop.station.simulation import (
    MakeSimulator,
    advance_without_garbage_collection,
    read_recorded_signals,
    simulate,
)
from drake_teleop.station.station import MakeTeleopStation

SCENARIO = replace(
    Scenario(),
    operator=OperatorConfig(
        grip="firm", intent=[Sine(duration=10.0, frequency=3.0, translation=[0.01, 0.0, 0.02])]
    ),
    simulation__settle=0.05,
    simulation__duration=0.1,
    rates__log_hz=4000.0,
    force_scaling__sigma=1.0,
)
# The load is estimated during the run, so no identification precedes it.
ENDLESS = """
simulation: {duration: 3600.0, settle: 0.05}
operator:
  grip: firm
  intent: [!Sine {duration: 1e4, ramp: 0.1, frequency: 3.0, translation: [0.01, 0.01, 0.02]}]
load_estimator: {enabled: true}
rates: {sensor_hz: 2000, log_hz: 2000}
"""


@pytest.fixture(autouse=True)
def _small_parts(monkeypatch):
    monkeypatch.setattr(simulation, "_LOG_ROWS_PER_PART", 100)


def run(**options) -> SimulationResult:
    return simulate(MakeTeleopStation(SCENARIO), SCENARIO.simulation, **options)


@pytest.fixture(scope="module")
def in_memory() -> SimulationResult:
    return run()


def assert_same(found: SimulationResult, expected: SimulationResult, samples=slice(None)) -> None:
    assert found.specs == expected.specs
    np.testing.assert_array_equal(found.t, expected.t[samples])
    for name in expected:
        np.testing.assert_array_equal(found[name], expected[name][samples])


@pytest.mark.slow
def test_the_parts_are_the_log_that_is_kept_in_memory(tmp_path, in_memory):
    folder = tmp_path / "log.parquet"
    assert_same(run(log=folder), in_memory)
    assert len(list(folder.iterdir())) > 3
    assert_same(SimulationResult.read_parquet(folder), in_memory)
    assert pl.scan_parquet(folder).collect().equals(in_memory.to_dataframe())
    assert [path.name for path in tmp_path.iterdir()] == ["log.parquet"]


@pytest.mark.slow
def test_looking_at_the_progress_changes_nothing():
    """Include 0.14 s, which is not 7 times 0.02 s in floating point."""
    often = replace(SCENARIO, rates__log_hz=8000.0, simulation__duration=0.25)
    simulator = MakeSimulator(MakeTeleopStation(often), often.simulation)
    simulator.Initialize()
    advance_without_garbage_collection(simulator, 0.3)
    at_once = read_recorded_signals(simulator, often.simulation.settle)
    assert_same(simulate(MakeTeleopStation(often), often.simulation), at_once)


def test_one_file_can_be_opened_without_reading_it_too(tmp_path, in_memory):
    in_memory.write_parquet(tmp_path / "one.parquet")
    assert_same(SimulationResult.scan_parquet(tmp_path / "one.parquet"), in_memory)


def test_a_signal_on_disk_is_found_by_its_name_and_read_only(tmp_path):
    result = run(log=tmp_path / "log")
    assert "intent" in result and "intents" not in result
    with pytest.raises(KeyError, match="there are intent"):
        result["intents"]
    with pytest.raises(ValueError, match="read-only"):
        result["intent"][0] = 1.0
    assert result.plot("intent").axes


def test_ctrl_c_keeps_all_that_was_recorded(tmp_path, in_memory):
    def stop(done: float) -> None:
        if done > 0.7:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(log=tmp_path / "log", progress=stop)
    kept = SimulationResult.read_parquet(tmp_path / "log")
    assert 200 < len(kept.t) < len(in_memory.t)
    assert_same(kept, in_memory, slice(len(kept.t)))


@pytest.mark.parametrize("when", ["before", "after"])
def test_ctrl_c_while_a_part_is_written_neither_loses_nor_doubles_rows(
    tmp_path, in_memory, monkeypatch, when
):
    replace_file, calls = Path.replace, []

    def interrupted(path: Path, target: Path) -> Path:
        calls.append(target)
        if len(calls) == 3 and when == "before":
            raise KeyboardInterrupt
        replace_file(path, target)
        if len(calls) == 3 and when == "after":
            raise KeyboardInterrupt
        return target

    monkeypatch.setattr(Path, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run(log=tmp_path / "log")
    kept = SimulationResult.read_parquet(tmp_path / "log")
    assert calls[2] == calls[3]
    assert_same(kept, in_memory, slice(len(kept.t)))


@pytest.mark.slow
def test_a_log_replaces_an_earlier_one_but_nothing_else(tmp_path, in_memory):
    folder = tmp_path / "log"
    in_memory.write_parquet(folder)
    assert_same(run(log=folder), in_memory)
    in_memory.write_part(folder, 7000)
    assert_same(run(log=folder), in_memory)
    (folder / "thesis.tex").write_text("all of it")
    with pytest.raises(DrakeTeleopError, match=r"log: contains thesis\.tex"):
        run(log=folder)
    assert len(list(folder.iterdir())) > 3


def test_a_run_that_logs_nothing_leaves_a_log_without_rows(tmp_path):
    seldom = replace(SCENARIO, rates__log_hz=1.0)
    result = simulate(MakeTeleopStation(seldom), seldom.simulation, log=tmp_path / "log")
    assert len(result.t) == 0
    assert result["intent"].shape == (0, 7)


def test_long_lines_are_drawn_with_their_peaks():
    t, values = np.arange(1e6) / 1e3, np.zeros(10**6)
    values[[5, 777_777, 999_999]] = 1.0, -2.0, 3.0
    (line,) = SimulationResult(t, {"x": values}, [Signal("x", ("x",), "N")]).plot("x").axes[0].lines
    drawn_t, drawn = line.get_data()
    assert len(drawn) < 50_000
    for row in (5, 777_777, 999_999):
        np.testing.assert_allclose(drawn_t[drawn == values[row]], t[row], atol=0.1)


def start_and(kill: signal.Signals, folder: Path) -> tuple[str, int]:
    """Run ENDLESS, send the signal after three parts; return stderr and exit status."""
    (folder / "endless.yaml").write_text(ENDLESS)
    command = (
        "from drake_teleop.cli.main import main; from drake_teleop.station import simulation;"
        " simulation._PART_ROWS = 500; main()"
    )
    arguments = ["run", "endless.yaml", "--out", "out", "--quiet"]
    with hearing_ctrl_c():
        process = subprocess.Popen(
            [sys.executable, "-c", command, *arguments],
            cwd=folder,
            stderr=subprocess.PIPE,
            text=True,
            env=os.environ | {"PYTHONPATH": str(Path(simulation.__file__).parents[2])},
        )
    while process.poll() is None and len(list((folder / "out").glob("log.parquet/*"))) < 3:
        time.sleep(0.02)
    process.send_signal(kill)
    return process.communicate(timeout=60)[1], process.returncode


@pytest.mark.slow
@pytest.mark.parametrize("kill", [signal.SIGKILL, signal.SIGTERM])
def test_a_killed_run_leaves_rows_without_gaps(tmp_path, kill):
    said, status = start_and(kill, tmp_path)
    log = tmp_path / "out" / "log.parquet"
    kept = SimulationResult.read_parquet(log)
    assert len(kept.t) >= 1000
    np.testing.assert_allclose(kept.t, np.arange(len(kept.t)) / 2e3, atol=1e-9)
    assert all(np.isfinite(kept[name]).all() for name in kept)
    assert not (tmp_path / "out" / "summary.json").exists()
    if kill == signal.SIGKILL:
        assert (said, status) == ("", -signal.SIGKILL)
    else:
        expected = f"interrupted: out/log.parquet contains the first {len(kept.t)} samples"
        assert (said.strip(), status) == (expected, 130)
