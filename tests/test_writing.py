"""Output files are complete or absent; a full disk at any file raises one line."""

from __future__ import annotations

import errno
import itertools
import json
import os
import resource
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from matplotlib.figure import Figure

from drake_teleop.common.errors import MAX_ERROR_LINE_LENGTH, DrakeTeleopError
from drake_teleop.common.files import (
    CannotWrite,
    make_folder,
    output_folder,
    replace_file_on_success,
    write_json,
    write_picture,
    write_table,
    write_text,
)
from drake_teleop.lab import run as runs
from drake_teleop.lab.studies import study as studies
from drake_teleop.logs import sample
from drake_teleop.station import replay
from drake_teleop.station.replay_file import ReplayFile
from drake_teleop.station.result import Signal, SimulationResult
from drake_teleop.station.scenario import LoadScenario

TABLE = pl.DataFrame({"x": np.random.default_rng(0).random(5000)})


@contextmanager
def small_disk(size: int = 100) -> Iterator[None]:
    """Limit the size of files of this process, as a full disk does."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@contextmanager
def full_at(write: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Path]]:
    """Simulate a full disk at the file with this number; yield the names of earlier files."""
    replace, named = Path.replace, []

    def filling(path: Path, target: Path) -> Path:
        if len(named) >= write:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        named.append(Path(target))
        return replace(path, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", filling)
        yield named


WRITERS: dict[str, Callable[[Path], object]] = {
    "x.txt": lambda path: write_text(path, "x" * 5000),
    "x.json": lambda path: write_json(path, ["x" * 5000]),
    "x.csv": lambda path: write_table(path, TABLE),
    "x.parquet": lambda path: write_table(path, TABLE),
    "x.png": lambda path: write_picture(path, Figure()),
}


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.pictures
def test_full_disk_raises_one_line_and_keeps_the_earlier_file(tmp_path, name):
    path = tmp_path / name
    path.write_text("earlier")
    with small_disk(), pytest.raises(CannotWrite) as error:
        WRITERS[name](path)
    assert str(error.value) == f"{path}: cannot be written (File too large)"
    assert path.read_text() == "earlier"
    WRITERS[name](path)
    assert path.stat().st_size > 1000
    assert list(tmp_path.iterdir()) == [path]


def test_interrupt_keeps_the_earlier_file(tmp_path):
    path = tmp_path / "x"
    path.write_text("earlier")
    with pytest.raises(KeyboardInterrupt), replace_file_on_success(path) as unfinished:
        unfinished.write_text("half")
        raise KeyboardInterrupt
    assert [p.read_text() for p in tmp_path.iterdir()] == ["earlier"]


def test_nonfinite_numbers_become_null(tmp_path):
    path = tmp_path / "x.json"
    write_json(path, {"a": float("nan"), "b": (float("inf"), {"c": -float("inf")}), "d": 1.5})
    assert json.loads(path.read_text()) == {"a": None, "b": [None, {"c": None}], "d": 1.5}


def test_impossible_folder_raises_one_line(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    for folder, reason in (("file", "File exists"), ("file/x", "Not a directory")):
        with pytest.raises(
            CannotWrite, match=f"cannot be created as a folder .{reason}.; give another"
        ):
            make_folder(tmp_path / folder)
    monkeypatch.setattr(os, "access", lambda path, mode: False)  # root can always read
    with pytest.raises(CannotWrite, match="is a folder without write permission; give another"):
        make_folder(tmp_path)


def test_last_file_marks_a_complete_folder(tmp_path):
    """The last file is removed first and written last; the error lists the new files."""
    out = tmp_path / "Käse und Brot"
    for name in ("summary.json", "earlier", "a"):
        make_folder(out)
        (out / name).touch()
    with pytest.raises(CannotWrite) as error, output_folder(out, valid_after_failure=["earlier"]):
        write_text(out / "a", "a")
        write_text(out / "b", "b")
        (out / "c").mkdir()
        write_text(out / "c", "c")
    message = f"{out / 'c'}: cannot be written (Is a directory); {out} contains a, b, earlier"
    assert str(error.value) == message
    assert sorted(path.name for path in out.iterdir()) == ["a", "b", "c", "earlier"]


def a_run(scenario, stage, log, *, fresh):
    """Return a result of `run_scenario` without a simulation."""
    t = np.arange(3.0)
    sizes = {"measured_wrench_S": 6, "specific_force_S": 3, "angular_velocity_S": 3}
    sizes |= {"angular_acceleration_S": 3, "sample_time": 1}
    specs = [Signal(name, tuple("abcdef"[:n]), "1") for name, n in sizes.items()]
    result = SimulationResult(t, {name: np.ones((3, n)) for name, n in sizes.items()}, specs)
    result.write_part(log, 0)
    return runs.ScenarioRun(scenario, SimulationResult.scan_parquet(log), None, "cache", 1.0)


def run(out: Path) -> None:
    runs.run_command("reach", out, quiet=True)


def study(out: Path) -> None:
    path = out.parent / "study.yaml"
    path.write_text(
        "scenario: reach\nmeasures: [hand_work_J]\n"
        "factors: [{field: force_scaling.sigma, values: [0, 1]}]\n"
    )
    studies.study_command(path, out, jobs=1, quiet=True)


def sample_log(out: Path) -> None:
    sample.sample_log_command(out, quiet=True)


COMMANDS: dict[str, tuple[Callable[[Path], None], int, str]] = {
    "run": (run, 7, "contains log.parquet, scenario.yaml"),
    "study": (study, 6, "contains 1 of 2 runs; repeat the command"),
    "sample-log": (sample_log, 8, "contains free.yaml, free_wrench.csv"),
}
"""Commands, their files, and their message if the disk is full at the third file."""


@pytest.fixture
def little_work(monkeypatch):
    """Replace the computations of the commands, which still write all files."""
    monkeypatch.setattr(runs, "run_scenario", a_run)
    monkeypatch.setattr(runs, "summarise", lambda run: {"x": float("nan")})
    monkeypatch.setattr(runs, "draw_overview", lambda result: Figure())
    monkeypatch.setattr(replay, "write_replay", lambda path, *_: write_text(path, "film"))
    monkeypatch.setattr(
        studies.StationRunFunction, "__call__", lambda self, values, seed: {"hand_work_J": 1.0}
    )
    painted = Figure.savefig
    monkeypatch.setattr(
        Figure,
        "savefig",
        lambda _, path, **options: painted(Figure(figsize=(1, 1)), path, format="png"),
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_full_disk_at_any_file(tmp_path, monkeypatch, little_work, name):
    command, files, third = COMMANDS[name]
    for write in itertools.count():
        out = tmp_path / str(write) / "out"
        out.parent.mkdir()
        with full_at(write, monkeypatch) as named:
            try:
                command(out)
                break
            except DrakeTeleopError as error:
                said = str(error)
        assert "cannot be written (No space left on device)" in said
        assert said.count(str(out)) >= 1 and len(said) <= MAX_ERROR_LINE_LENGTH
        if write == 2:
            assert third in said
        there = {path for path in out.rglob("*") if path.is_file()}
        lone = name == "run" and write == 1  # the scenario alone is incomplete
        assert there == (set() if lone else set(named))
        assert not (out / "summary.json").exists()
        for path in there:
            whole(path)
    assert write == files
    json.loads((out / "summary.json").read_text())


def whole(path: Path) -> None:
    if path.suffix == ".parquet":
        pl.read_parquet(path)
    elif path.suffix == ".json":
        json.loads(path.read_text())
    else:
        assert path.stat().st_size


def test_study_continues_after_a_full_disk(tmp_path, monkeypatch, little_work):
    out = tmp_path / "out"
    with full_at(2, monkeypatch), pytest.raises(DrakeTeleopError):
        study(out)
    calls = []
    monkeypatch.setattr(
        studies.StationRunFunction, "__call__", lambda self, values, seed: calls.append(seed) or {}
    )
    study(out)
    assert len(calls) == 1


def test_run_that_fails_early_leaves_no_files(tmp_path, monkeypatch):
    def fail(*_, **__):
        raise DrakeTeleopError("joint 1 leaves its range")

    monkeypatch.setattr(runs, "run_scenario", fail)
    with pytest.raises(DrakeTeleopError):
        run(tmp_path)
    assert list(tmp_path.iterdir()) == []
    mine = tmp_path / "scenario.yaml"  # file of the user
    mine.write_text("description: mine\n")
    with pytest.raises(DrakeTeleopError):
        runs.run_command(mine, tmp_path, quiet=True)
    assert LoadScenario(mine).description == "mine"


def test_summary_of_an_earlier_run_is_removed(tmp_path, monkeypatch, little_work):
    run(tmp_path)
    (tmp_path / "identification.json").touch()
    with full_at(2, monkeypatch), pytest.raises(DrakeTeleopError):
        run(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"scenario.yaml", "log.parquet"}


def test_replay_that_cannot_be_written_is_reported(tmp_path, monkeypatch):
    monkeypatch.setattr(ReplayFile, "_record_scene_html", lambda self, make_scene: "<body></body>")
    film = ReplayFile("x", np.arange(2.0), 1.0)
    with small_disk(), pytest.raises(CannotWrite, match=r"x\.html: cannot be written"):
        film.write(tmp_path / "x.html", lambda meshcat: lambda time, frame: None)
    assert list(tmp_path.iterdir()) == []
