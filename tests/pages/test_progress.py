"""Progress bars on terminals only, unless disabled, and only of long tasks."""

from __future__ import annotations

import inspect
import io
import time
from types import SimpleNamespace

import numpy as np
import pytest
import rich
from rich.console import Console

import drake_teleop
from drake_teleop import identify_load, run_scenario, simulate
from drake_teleop.cli.excitation import excite_command
from drake_teleop.common import progress
from drake_teleop.common.progress import show_no_progress, show_progress
from drake_teleop.lab.analysis.analyze import analyze, analyze_command
from drake_teleop.lab.comparison.compare_passivity import compare_command
from drake_teleop.lab.excitation.excite import excite
from drake_teleop.lab.identified_load import identified_load
from drake_teleop.lab.reproduction.reproduce import reproduce_command
from drake_teleop.lab.run import run_command
from drake_teleop.lab.studies.runs import run_study
from drake_teleop.lab.studies.scaling_study import scaling_study_command
from drake_teleop.lab.studies.study import study_command

SLOW = [
    *(identify_load, identified_load, run_scenario, simulate, analyze, excite, run_study),
    *(run_command, study_command, scaling_study_command, analyze_command, compare_command),
    *(excite_command, reproduce_command),
]


@pytest.fixture
def terminal(monkeypatch):
    """Output of a terminal."""
    written = io.StringIO()
    monkeypatch.setattr(rich, "_console", Console(file=written, force_terminal=True, width=100))
    return written


@pytest.mark.parametrize("function", SLOW, ids=lambda function: function.__name__)
def test_long_functions_show_progress_unless_disabled(function):
    assert inspect.signature(function).parameters["progress"].default is True
    if function.__name__ in drake_teleop.__all__ and function is not run_study:
        assert "progress" in function.__doc__


def run_with_progress(progress, **options) -> None:
    with show_progress(progress, **options) as stage:
        update = stage("Counting sheep")
        for fraction in np.linspace(0, 1, 5):
            update(fraction, f"{fraction:.2f}")


def test_terminal_shows_each_stage(terminal):
    run_with_progress(True)
    text = terminal.getvalue()
    assert "Counting sheep" in text and "100%" in text


def test_no_output_without_progress(terminal, capsys):
    run_with_progress(False)
    run_with_progress(show_no_progress)
    run_with_progress(True, after=3600.0)  # done before
    assert terminal.getvalue() == capsys.readouterr().err == ""


def test_without_a_terminal_each_stage_is_one_line_on_stderr(monkeypatch, capsys):
    file = io.StringIO()
    monkeypatch.setattr(rich, "_console", Console(file=file, force_terminal=False))
    with show_progress(True) as stage:
        first = stage("Counting sheep")
        assert capsys.readouterr().err == "Counting sheep ...\n"  # before it has done anything
        for fraction in (0.0, 0.5, 1.0):
            first(fraction, "words")
        stage("Counting goats")(1.0)
    run_with_progress(True, after=3600.0)
    run_with_progress(False)
    said = capsys.readouterr()
    assert (said.err, said.out, file.getvalue()) == ("Counting goats ...\n", "", "")


def test_without_a_terminal_the_line_appears_after_the_delay(monkeypatch, capsys):
    monkeypatch.setattr(rich, "_console", Console(file=io.StringIO(), force_terminal=False))
    with show_progress(True, after=0.05) as stage:
        update = stage("Counting sheep")
        update(0.1)
        assert capsys.readouterr().err == ""
        time.sleep(0.06)
        update(0.2)
        update(0.3)
        assert capsys.readouterr().err == "Counting sheep ...\n"


def test_callees_continue_the_stages_of_the_caller(terminal):
    with show_progress(True) as stage, show_progress(stage) as same:
        assert same is stage
    calls = []
    run_with_progress(lambda name: lambda fraction, words="": calls.append((name, fraction)))
    assert calls[-1] == ("Counting sheep", 1.0) and len(calls) == 5


def test_nested_bars_raise_no_error(terminal):
    with show_progress(True) as stage:
        stage("Outside")(0.5)
        run_with_progress(True)
    assert "Outside" in terminal.getvalue()
    run_with_progress(True)


@pytest.mark.parametrize("first", [0.0, 5.0])
def test_without_a_terminal_a_long_stage_has_a_line_every_15_s(monkeypatch, capsys, first):
    now = 100.0
    monkeypatch.setattr(rich, "_console", Console(file=io.StringIO(), force_terminal=False))
    # Not `time.monotonic` itself, because other threads use it.
    monkeypatch.setattr(progress, "time", SimpleNamespace(monotonic=lambda: now))
    with show_progress(True, after=first) as stage:
        update = stage("Study")
        for second in range(1, 41):
            now = 100.0 + second
            update(second / 40, f"{second} of 40")
    start = round(first)
    expected = [f"Study {k} of 40 {k / 40:.0%}" for k in (start + 15, start + 30)]
    assert capsys.readouterr().err.splitlines() == ["Study ...", *expected]
