"""`drake-teleop study`: design, crash-safe store, reproducible rows."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from shown import type_in
from sockets import THIS_MACHINE, listening
from threadpoolctl import threadpool_info, threadpool_limits

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.lab import run as runs_of_scenarios
from drake_teleop.lab.identified_load import IdentifiedLoad, identified_load
from drake_teleop.lab.studies import study as studies
from drake_teleop.lab.studies.adaptive import propose_points
from drake_teleop.lab.studies.design import Factor, Study
from drake_teleop.lab.studies.measures import default_measures, evaluate_measures
from drake_teleop.lab.studies.runs import SETUP_TIME_S_KEY, StudyProgress, run_study
from drake_teleop.lab.studies.store import Store, open_store
from drake_teleop.lab.studies.study import LoadStudy, study_command
from drake_teleop.station.result import SimulationResult
from drake_teleop.station.scenario import Scenario
from drake_teleop.station.signals import SIGNALS

# The estimator runs in the loop, so no identification is needed.
SCENARIO = """
simulation: {duration: 0.05, settle: 0.02}
operator:
  grip: firm
  intent: [!Sine {duration: 10.0, ramp: 0.1, frequency: 3.0, translation: [0.01, 0.01, 0.02]}]
load_estimator: {enabled: true}
"""
STUDY = """
scenario: tiny.yaml
factors:
  - {field: force_scaling.sigma, values: [0, 0.5, 1]}
  - {field: operator.grip, words: [light, firm]}
  - {field: simulation.max_step, values: [1e-3]}
repeats: 2
"""
# A study without a station is killed 8 times; runs take 1 ms, every seventh fails.
FAKE = """
import json, os, random, signal, sys, time
from pathlib import Path
import joblib, polars
from drake_teleop.lab.studies import runs
from drake_teleop.lab.studies.design import Factor, Study

runs._TARGET_NUM_CHUNKS = 150  # as many runs in a part as a larger study has

def work(values, seed):
    time.sleep(pause)
    if seed % 7 == 3:
        raise ValueError("a seventh\\nof them")
    return {"hand_work_J": values["a.b"] / (1 + seed)}

def run(out):
    factor = Factor("a.b", low=0.0, high=1.0, levels=40)
    study = Study(factors=[factor], repeats=30, measures=["hand_work_J"])
    return runs.run_study(study, out, work, {}, jobs=1)

killed, whole, report = map(Path, sys.argv[1:])
pause = 0.001
pauses, kept = random.Random(0), []
def parts():
    return len(list((killed / "runs.parquet").glob("*")))

for k in range(8):
    before, child = parts(), os.fork()
    if not child:
        run(killed)
        os._exit(0)
    # Every other one falls into the work; a run that was killed twice has a process of its own,
    # which takes its time to begin.
    deadline = time.monotonic() + 60.0
    while k % 2 and parts() == before and time.monotonic() < deadline:
        time.sleep(0.001)
    time.sleep(pauses.uniform(0.0, 0.1))
    os.kill(child, signal.SIGKILL)
    assert os.waitpid(child, 0)[1] == signal.SIGKILL, "it has ended by itself"
    kept.append(parts())
report.write_text(json.dumps(kept))
pause = 0.0
run(killed)
run(whole)
"""


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("files")
    (folder / "tiny.yaml").write_text(SCENARIO)
    (folder / "study.yaml").write_text(STUDY)
    return folder


@pytest.fixture(scope="module")
def serial(files):
    out = files / "serial"
    return study_command(files / "study.yaml", out, jobs=1, quiet=True), out


@pytest.fixture
def two_runs(monkeypatch):
    """Reduce a study to one seed, two points and this process; one load serves all.

    `test_identified_load.py` tests the loads of slaves, sensors and seeds.
    """
    loads: list[IdentifiedLoad] = []

    def identified(*arguments, **options):
        loads[:] = loads or [identified_load(*arguments, **options)]
        return loads[0]

    monkeypatch.setattr(runs_of_scenarios, "identified_load", identified)
    load, command = studies.LoadStudy, studies.study_command

    def small(path):
        study = load(path)
        first, *others = study.factors
        factors = [dataclasses.replace(first, values=first.values[:2])]
        factors += [dataclasses.replace(f, values=f.values[:1]) for f in others]
        return dataclasses.replace(study, factors=factors, samples=2, repeats=1)

    def in_one_process(*arguments, **options):
        return command(*arguments, **(options | {"jobs": 1}))

    monkeypatch.setattr(studies, "LoadStudy", small)
    monkeypatch.setattr(studies, "study_command", in_one_process)


@pytest.mark.slow
@pytest.mark.pictures
def test_commands_and_code_of_the_docs_run(two_runs, tmp_path, monkeypatch):
    """Each study has two runs."""
    monkeypatch.chdir(tmp_path)
    docs = Path(__file__).parents[2] / "docs"
    page = (docs / "studies.md").read_text(encoding="utf-8")
    (file,) = re.findall("```yaml\n(scenario: .*?)```", page, re.S)
    Path("study.yaml").write_text(file)
    type_in("docs/studies.md", "drake-teleop study")
    (script,) = re.findall("```python\n(from pathlib.*?)```", page, re.S)
    names: dict = {}
    exec(compile(script, "studies.md", "exec"), names)  # all runs are complete
    assert names["summary"] == json.loads(Path("out/study/summary.json").read_text())
    Path("out/study").rename("out/whole")
    type_in("docs/cluster.md", "drake-teleop study")
    assert parts(Path("out/study")) == parts(Path("out/whole"))
    (script,) = re.findall("```python\n(.*?)```", (docs / "cluster.md").read_text(), re.S)
    script = script.replace("ProcessPool", "ThreadPool")  # a process would have all points
    exec(compile(script, "cluster.md", "exec"), {"__name__": "__main__"})
    assert parts(Path("out/executor")) == parts(Path("out/whole"))
    type_in("README.md", ".venv/bin/drake-teleop study")
    for out in ("study", "touch"):
        summary = json.loads(Path(f"out/{out}/summary.json").read_text())
        assert (summary["runs"], summary["failed"]) == (2, 0)


def parts(out: Path) -> dict[str, bytes]:
    return {part.name: part.read_bytes() for part in (out / "runs.parquet").iterdir()}


@pytest.mark.slow
def test_table_has_a_row_for_each_run(serial):
    summary, out = serial
    rows = pl.read_parquet(out / "runs.parquet").sort("run")
    assert rows["run"].to_list() == list(range(12))
    assert rows.columns == [
        *("run", "point", "repeat", "seed"),
        *("force_scaling.sigma", "operator.grip", "simulation.max_step"),
        *default_measures(),
        "error",
    ]
    assert summary["runs"] == 12
    assert summary["points"] == 6
    assert summary["failed"] == rows["error"].count() == 0
    # All points share the seeds of the repeats; another seed gives other noise.
    assert rows["seed"].to_list() == [0, 2] * 6
    assert rows["rms_force_to_master_N"].n_unique() == 12
    # The full load gives a larger force.
    mean = rows.group_by("force_scaling.sigma").agg(pl.col("rms_force_to_master_N").mean())
    assert np.all(np.diff(mean.sort("force_scaling.sigma")["rms_force_to_master_N"]) > 0.1)


@pytest.mark.slow
def test_processes_give_the_same_bytes(serial, files):
    out = files / "parallel"
    summary = study_command(files / "study.yaml", out, jobs=2, quiet=True)
    assert summary == serial[0]
    assert parts(out) == parts(serial[1])
    assert not (out / "running").exists(), "nothing is under way any more"


@pytest.mark.slow
def test_local_dask_cluster_gives_the_same_bytes(serial, files, monkeypatch):
    out, write, seen = files / "dask", Store.write, set()

    def look_and_write(store, rows):
        seen.update(seen or listening())
        write(store, rows)

    monkeypatch.setattr(Store, "write", look_and_write)
    summary = study_command(files / "study.yaml", out, jobs=1, cluster="local", quiet=True)
    assert summary == serial[0]
    assert parts(out) == parts(serial[1])
    assert seen and seen <= THIS_MACHINE


def test_error_without_dask_names_the_extra(files, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(DrakeTeleopError, match=r"pip install '\.\[cluster\]' in"):
        study_command(files / "study.yaml", files / "none", cluster="local", quiet=True)


@pytest.mark.slow
def test_stopped_study_of_stations_continues(serial, files, monkeypatch):
    out, work, calls = files / "stopped", studies.StationRunFunction.__call__, []

    def stopping(self, values, seed):
        calls.append(seed)
        if len(calls) == 6:
            raise KeyboardInterrupt
        return work(self, values, seed)

    monkeypatch.setattr(studies.StationRunFunction, "__call__", stopping)
    with pytest.raises(KeyboardInterrupt, match="contains 5 of 12 runs"):
        study_command(files / "study.yaml", out, jobs=1, quiet=True)
    assert study_command(files / "study.yaml", out, jobs=1, quiet=True) == serial[0]
    assert parts(out) == parts(serial[1])


@pytest.mark.slow
def test_kills_neither_lose_nor_duplicate_rows(tmp_path):
    names = ("fake.py", "killed", "whole", "kept.json")
    script, killed, whole, report = (tmp_path / name for name in names)
    script.write_text(FAKE)
    # The output also contains that of its child processes after a kill.
    answer = subprocess.run(
        [sys.executable, *map(str, (script, killed, whole, report))],
        capture_output=True,
        text=True,
        check=False,
    )
    assert answer.returncode == 0, answer.stderr
    kept = json.loads(report.read_text())
    assert kept == sorted(kept)
    assert len(set(kept)) >= 4
    assert parts(killed) == parts(whole)
    rows = pl.read_parquet(killed / "runs.parquet").sort("run")
    assert rows["run"].to_list() == list(range(1200))
    failed = rows.filter(pl.col("error").is_not_null())
    assert set(failed["seed"] % 7) == {3}
    assert set(failed["error"]) == {"ValueError: a seventh of them"}
    assert rows["hand_work_J"].null_count() == failed["hand_work_J"].null_count() == failed.height


@pytest.mark.parametrize("repeats", [-1, 0, 2.5])
def test_invalid_repeats_raise(files, repeats):
    with pytest.raises(DrakeTeleopError, match=rf"repeats: .*{repeats}"):
        study_command(files / "study.yaml", files / "none", repeats=repeats, quiet=True)


def test_failed_run_is_a_row_with_an_error(files):
    (files / "failing.yaml").write_text(
        STUDY.replace(
            "values: [1e-3]", "values: [1e-3]}\n  - {field: force_scaling.eta, values: [1]"
        )
    )
    out = files / "failing"
    summary = study_command(files / "failing.yaml", out, jobs=1, quiet=True)
    rows = pl.read_parquet(out / "runs.parquet")
    assert rows.height == summary["failed"] == 12
    assert rows["error"].str.contains("tiny.yaml:force_scaling.eta: ").all()
    assert summary["measures"]["hand_work_J"] == {"mean": None, "least": None, "largest": None}


@pytest.mark.slow
def test_folder_of_another_study_is_refused(serial, files):
    before = parts(serial[1])
    (files / "other.yaml").write_text(STUDY + "seed: 1\n")
    with pytest.raises(DrakeTeleopError, match="another study"):
        study_command(files / "other.yaml", serial[1], quiet=True)
    assert parts(serial[1]) == before


@pytest.mark.parametrize("edited", ["arm.urdf", "leader.urdf", "scene.sdf", "ping.csv"])
def test_folder_with_runs_of_an_edited_file_is_refused(tmp_path, monkeypatch, edited):
    monkeypatch.setattr(studies.StationRunFunction, "__call__", lambda *_: {"hand_work_J": 1.0})
    study = "{scenario: base.yaml, factors: [{field: force_scaling.sigma, values: [0]}]}"
    base = (
        "{slave: {model: arm.urdf}, channel: {trace: ping.csv}, environment: [!Scene {file:"
        " scene.sdf}], master: {model: leader, leader: {file: leader.urdf, hand_frame: grip}}}"
    )
    files = {"base.yaml": base, "study.yaml": study, "ping.csv": "time,delay\n0,0.01\n1,0.01\n"}
    files |= {"arm.urdf": "<robot/>", "leader.urdf": "<robot/>", "scene.sdf": "<sdf/>"}
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    study_command(tmp_path / "study.yaml", tmp_path / "out", jobs=1, quiet=True)
    (tmp_path / edited).write_text(f"{files[edited]}\n")
    with pytest.raises(DrakeTeleopError, match="another study"):
        study_command(tmp_path / "study.yaml", tmp_path / "out", jobs=1, quiet=True)


@pytest.mark.parametrize("damage", ["empty", "no rows", "damaged"])
def test_empty_part_is_repeated_and_other_files_are_ignored(tmp_path, damage):
    study = Study(factors=[Factor("force_scaling.sigma", values=[0.0, 0.5, 1.0])], measures=[])
    calls: list[int] = []

    def work(values, seed):
        calls.append(seed)
        return {}

    def run():
        return run_study(study, tmp_path, work, {}, jobs=1, progress=False)

    rows, folder = run(), tmp_path / "runs.parquet"
    part = folder / "run_00000001.parquet"
    content = part.read_bytes()
    if damage == "no rows":
        pl.read_parquet(part).clear().write_parquet(part)
    else:
        part.write_bytes(b"" if damage == "empty" else content[:-20])
    (folder / "notes.txt").write_text("mine")
    (folder / "mine.parquet").write_bytes(b"")
    calls.clear()
    assert run().equals(rows) and len(calls) == 1
    assert part.read_bytes() == content and (folder / "notes.txt").read_text() == "mine"
    calls.clear()
    assert run().equals(rows) and not calls


def test_second_process_in_a_folder_is_refused(tmp_path):
    with (
        open_store(tmp_path, {}),
        pytest.raises(DrakeTeleopError, match="another process"),
        open_store(tmp_path, {}),
    ):
        pass
    with open_store(tmp_path, {}):
        pass


def test_interrupt_reports_stored_runs(tmp_path):
    calls = []

    def work(values, seed):
        calls.append(values)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return {}

    study = Study(factors=[Factor("a.b", values=[1.0, 2.0, 3.0, 4.0])])
    with pytest.raises(KeyboardInterrupt, match="contains 2 of 4 runs"):
        run_study(study, tmp_path, work, {}, jobs=1)
    assert run_study(study, tmp_path, work, {}, jobs=1).height == 4
    assert len(calls) == 5  # the third run again


def fatal_run(own: int, at: float):
    """Return a run that ends its process at one value; a closure needs no import."""

    def work(values, seed):
        assert os.getpid() != own
        if values["a.b"] == at:
            os._exit(1)
        return {"hand_work_J": values["a.b"]}

    return work


@pytest.mark.slow
@pytest.mark.parametrize("cluster", [None, "local"])
def test_run_that_ends_its_process_is_a_row_with_an_error(tmp_path, cluster):
    factor = Factor("a.b", low=0.0, high=9.0, levels=10)
    study = Study(factors=[factor], measures=["hand_work_J"])
    rows = run_study(study, tmp_path, fatal_run(os.getpid(), at=3.0), {}, jobs=2, cluster=cluster)
    assert rows["run"].to_list() == list(range(10))
    failed = rows.filter(pl.col("error").is_not_null())
    assert failed["a.b"].to_list() == [3.0]
    assert failed["error"].to_list() == ["the run has ended its process"]
    assert rows["hand_work_J"].drop_nulls().to_list() == [0, 1, 2, 4, 5, 6, 7, 8, 9]
    assert not list(tmp_path.glob("running/*"))


@pytest.mark.slow
def test_processes_that_never_begin_are_an_error(tmp_path):
    study = Study(factors=[Factor("a.b", values=[1.0, 2.0, 3.0])])
    with pytest.raises(DrakeTeleopError, match="processes ended before their first run"):
        run_study(study, tmp_path, Unreadable(), {}, jobs=2)


class Unreadable:
    """Work that ends each process that unpickles it."""

    def __reduce__(self):
        return os._exit, (1,)


ORPHANS = """
import os, sys, time
from pathlib import Path
from drake_teleop.lab.studies.runs import run_study
from drake_teleop.lab.studies.design import Factor, Study

out = Path(sys.argv[1])

def work(values, seed):
    (out / str(os.getpid())).touch()
    time.sleep(600)

run_study(Study(factors=[Factor("a.b", values=[1.0, 2.0])]), out / "out", work, {}, jobs=2)
"""


@pytest.mark.slow
def test_processes_end_with_a_study_that_is_killed(tmp_path):
    script = tmp_path / "orphans.py"
    script.write_text(ORPHANS)
    process = subprocess.Popen([sys.executable, str(script), str(tmp_path)])
    wait_for(lambda: sum(path.name.isdigit() for path in tmp_path.iterdir()) == 2)
    process.kill()
    process.wait()
    children = [int(path.name) for path in tmp_path.iterdir() if path.name.isdigit()]
    wait_for(lambda: not any(alive(pid) for pid in children))


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    # A zombie process.
    return Path(f"/proc/{pid}/stat").read_text().split()[2] != "Z"


def wait_for(condition, seconds=60.0):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.slow
def test_factors_over_flags_and_vectors(files, tmp_path):
    path = files / "kinds.yaml"
    path.write_text("""
scenario: tiny.yaml
factors:
  - {field: wrist_sensor.ideal, flags: [true, false]}
  - {field: slave.position, vectors: [[0.55, 0, 0.45], [0.5, 0.1, 0.45]]}
  - {field: slave.payload.mass, values: [0, 2]}
""")
    out = tmp_path / "out"
    assert study_command(path, out, jobs=1, quiet=True)["failed"] == 0
    rows = pl.read_parquet(out / "runs.parquet").sort("run")
    assert rows["wrist_sensor.ideal"].to_list() == [True] * 4 + [False] * 4
    assert rows["slave.position"].to_list() == [[0.55, 0, 0.45]] * 2 + [[0.5, 0.1, 0.45]] * 2 + (
        [[0.55, 0, 0.45]] * 2 + [[0.5, 0.1, 0.45]] * 2
    )
    assert rows["rms_force_to_master_N"].n_unique() == 8
    heavy = rows.filter(pl.col("wrist_sensor.ideal"))["rms_force_to_master_N"].to_list()
    # The displayed force is proportional to the load, without offsets.
    assert heavy[1] / heavy[0] == pytest.approx((3.13 + 2) / 3.13, rel=0.1)


def bowl(values, seed):
    """Minimum at (0.3, "b"), with equal noise at all points."""
    away = (values["a.x"] - 0.3) ** 2 + (values["a.w"] != "b")
    if values["a.w"] == "c" and values["a.x"] > 0.9:
        raise ValueError("out of reach")
    return {"hand_work_J": away + 0.01 * seed}


BOWL = Study(
    factors=[Factor("a.x", low=-1.0, high=1.0), Factor("a.w", words=["a", "b", "c"])],
    design="adaptive",
    samples=40,
    batch=4,
    repeats=2,
    measures=["hand_work_J"],
    objective="hand_work_J",
)


@pytest.fixture(scope="module")
def searched(tmp_path_factory):
    out = tmp_path_factory.mktemp("bowl")
    return run_study(BOWL, out, bowl, {}, jobs=1), out


@pytest.mark.slow
def test_an_adaptive_design_finds_the_best_point(searched):
    rows, _ = searched
    assert rows["point"].max() == 39 and rows.height == 80
    best = (
        rows.filter(pl.col("repeat") == 0).sort("hand_work_J", nulls_last=True).row(0, named=True)
    )
    assert best["a.w"] == "b"
    assert best["a.x"] == pytest.approx(0.3, abs=0.01)
    # The search concentrates there; random points would have one third.
    late = rows.filter(pl.col("point") >= 20)
    assert (late["a.w"] == "b").mean() > 0.5
    assert len(rows.select("a.x", "a.w").unique()) == 40


@pytest.mark.slow
def test_adaptive_design_continues_after_any_stop(tmp_path, searched):
    calls = []

    def stopping(values, seed):
        calls.append(values)
        if len(calls) % 15 == 0:  # at another run of each batch of 8
            raise KeyboardInterrupt
        return bowl(values, seed)

    while True:
        try:
            run_study(BOWL, tmp_path, stopping, {}, jobs=1)
            break
        except KeyboardInterrupt:
            pass
    assert len(calls) == 80 + 5
    assert parts(tmp_path) == parts(searched[1])


def test_proposed_points_are_near_the_optimum_despite_noise_and_failed_points():
    candidates, places = np.linspace(0, 1, 41)[:, None], np.repeat(np.linspace(0, 1, 9), 4)[:, None]
    exact = 4.0 * (places[:, 0] - 0.3) ** 2
    noisy = exact + 0.5 * np.random.default_rng(3).normal(size=36)
    failed = np.where(places[:, 0] > 0.7, np.nan, exact)
    for objective in (noisy, failed):
        found = candidates[propose_points(places, objective, candidates, 3), 0]
        assert np.abs(found - 0.3).max() < 0.1


def test_an_adaptive_design_ends_when_it_has_every_combination(tmp_path):
    factors = [Factor("a.x", values=[0.0, 1.0]), Factor("a.w", words=["a", "b", "c"])]
    rows = run_study(dataclasses.replace(BOWL, factors=factors), tmp_path, bowl, {}, jobs=1)
    assert len(rows.select("a.x", "a.w").unique()) == 6


def test_sobol_points_are_balanced():
    factors = [Factor("a.b", low=-1.0, high=3.0), Factor("a.c", words=["x", "y"])]
    study = Study(factors=factors, design="sobol", samples=64, seed=5)
    points = study.points()
    numbers = np.array([point["a.b"] for point in points])
    # One point in each of 64 parts of the range, and equal words in each half.
    np.testing.assert_array_equal(np.sort((numbers + 1) / 4 * 64 // 1), np.arange(64))
    words = np.array([point["a.c"] for point in points])
    assert [sum(words[numbers < 1] == word) for word in "xy"] == [16, 16]
    assert points == study.points()
    study.seed = 6
    assert points != study.points()


def test_a_factorial_design_has_every_combination_once():
    factors = [Factor("a.b", low=0.0, high=1.0, levels=5), Factor("a.c", words=["x", "y"])]
    points = Study(factors=factors).points()
    assert len({tuple(point.values()) for point in points}) == len(points) == 10
    assert {point["a.b"] for point in points} == {0.0, 0.25, 0.5, 0.75, 1.0}


def test_whole_numbers_in_a_list_of_a_factor_are_numbers(tmp_path):
    study = Study(factors=[Factor("a.b", values=[1, 2.5, 3])], measures=["hand_work_J"])
    found = run_study(study, tmp_path, lambda *_: {"hand_work_J": 1.0}, {}, jobs=1, progress=False)
    assert found["a.b"].to_list() == [1.0, 2.5, 3.0]


def test_measures_of_a_known_motion():
    """The hand pulls (3, 4, 0) N at 0.2 m/s along x; the display has 2 sin t along z."""
    t = np.linspace(0.0, 2 * math.pi, 20001)
    signals = {name: np.zeros((len(t), 6)) for name in ("hand_wrench_E", "twist_master")}
    signals |= {
        name: np.zeros((len(t), 6)) for name in ("force_to_master", "true_contact_wrench_W")
    }
    signals["hand_wrench_E"][:, :2] = 3.0, 4.0
    signals["hand_wrench_E"][:, 5] = 0.1
    signals["twist_master"][:, 0], signals["twist_master"][:, 5] = 0.2, 0.5
    signals["force_to_master"][:, 2] = 2 * np.sin(t)
    signals["force_to_master"][:, 3] = 9.0  # torques are ignored
    signals["true_contact_wrench_W"][100, :3] = 2.0, -3.0, 6.0
    result = SimulationResult(t, signals, [SIGNALS[name] for name in signals])
    found = evaluate_measures(result, Scenario(), default_measures(), 1.0)
    assert found == pytest.approx(
        {
            "peak_force_to_master_N": 2.0,
            "rms_force_to_master_N": math.sqrt(2.0),
            "peak_contact_force_N": 7.0,
            "hand_work_J": (3.0 * 0.2 + 0.1 * 0.5) * 2 * math.pi,
            "time_above_force_s": 4 / 3 * math.pi,
        },
        rel=1e-3,
    )


def test_run_without_a_hand_has_no_measures():
    result = SimulationResult(np.arange(3.0), {}, [])
    with pytest.raises(DrakeTeleopError, match=r"operator\.intent: the run identifies the load"):
        evaluate_measures(result, Scenario(), default_measures(), 1.0)


def test_preset_as_factor_sets_its_values():
    work = studies.StationRunFunction({}, "x", (), 1.0)
    ideal = work.scenario({"wrist_sensor.preset": "ideal"}, 3)
    assert ideal.simulation.seed == 3
    assert ideal.wrist_sensor != work.scenario({}, 3).wrist_sensor
    assert ideal.wrist_sensor.ideal


@pytest.mark.parametrize(
    ("scenario", "field", "value"),
    [("press", "force", 5.0), ("insert", "depth", 0.03), ("reach", "width", 0.02)],
)
def test_fields_of_the_scenarios_own_task_can_be_factors(
    tmp_path, monkeypatch, scenario, field, value
):
    scenarios = []

    def keep(work, values, seed):
        scenarios.append(work.scenario(values, seed))
        return {}

    monkeypatch.setattr(studies.StationRunFunction, "__call__", keep)
    path = tmp_path / "study.yaml"
    factor = f"{{field: operator.task.{field}, values: [{value}]}}"
    path.write_text(f"{{scenario: {scenario}, factors: [{factor}]}}")
    study_command(path, tmp_path / "out", jobs=1, quiet=True)
    assert [getattr(each.operator.task, field) for each in scenarios] == [value]
    # A field of another task is refused.
    path.write_text(path.read_text().replace(field, "stiffness"))
    with pytest.raises(DrakeTeleopError, match=r"factors\[0\]\.operator\.task\.stiffness: there"):
        study_command(path, tmp_path / "other", jobs=1, quiet=True)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            ("force_scaling.sigma", "force_scaling.sigm"),
            "factors[0].force_scaling.sigm: there is no",
        ),
        (("[0, 0.5, 1]", "[0, -0.5]"), "factors[0].force_scaling.sigma: -0.5"),
        (("[light, firm]", "[light, iron]"), "factors[1].operator.grip: 'iron' is not known"),
        (("words", "values"), "factors[1].values[0]: expected a number"),
        (("values: [0, 0.5, 1]", "low: 1"), "factors[0]: has low; give one of"),
        (("values: [0, 0.5, 1]", "low: 0, values: [1]"), "factors[0]: has values and low; give"),
        (("values: [0, 0.5, 1]", "values: []"), "factors[0]: has no values; give one of"),
        (("values: [0, 0.5, 1]", "low: 1, high: 0"), "factors[0].high: 0 is not above low"),
        (("[0, 0.5, 1]", "[0, .inf]"), "factors[0]: the value or range inf is not"),
        (("[0, 0.5, 1]", "[.nan]"), "factors[0]: the value or range nan is not"),
        (("values: [0, 0.5, 1]", "vectors: [[0, .inf]]"), "factors[0]: the value or range inf"),
        (("values: [0, 0.5, 1]", "low: 0, high: .inf"), "factors[0]: the value or range inf"),
        (("values: [0, 0.5, 1]", "low: -.inf, high: .inf"), "factors[0]: the value or range inf"),
        (
            ("values: [0, 0.5, 1]", "low: -1e308, high: 1e308"),
            "factors[0]: the value or range inf",
        ),
        (("[0, 0.5, 1]", "[1, 1]"), "factors[0]: lists 1.0 twice"),
        (("operator.grip, words: [light, firm]", "force_scaling.sigma, values: [1]"), "twice"),
        (
            ("force_scaling.sigma", "simulation.seed"),
            "factors[0].field: the seed cannot be a factor",
        ),
        (("tiny.yaml", "none.yaml"), "bad.yaml:scenario: there is no scenario"),
        (("repeats: 2", "repeats: 0"), "repeats: 0 is outside 1 to"),
        (("repeats: 2", "repeat: 2"), "did you mean 'repeats'"),
        (("repeats: 2", "design: taguchi"), "design: 'taguchi' is not known"),
        (("repeats: 2", "{design: sobol, samples: 48}"), "is not YAML"),
        (("repeats: 2", "design: sobol\nsamples: 48"), "samples: 48 Sobol points"),
        (("repeats: 2", "measures: [joy]"), "there is no measure 'joy'"),
        (("repeats: 2", "measures: [hand_work]"), "did you mean 'hand_work_J'"),
        (("repeats: 2", "design: adaptive"), "objective: '' cannot be the objective"),
        (("repeats: 2", "objective: hand_work_J"), "cannot be the objective of design 'factorial'"),
        ((STUDY, "scenario: tiny.yaml"), "factors: is empty (a study varies"),
        ((STUDY, "- 1"), "expected a mapping"),
    ],
)
def test_wrong_study_file_is_one_line_with_its_field(files, tmp_path, change, message):
    path = files / "bad.yaml"
    path.write_text(STUDY.replace(*change))
    with pytest.raises(DrakeTeleopError) as error:
        study_command(path, tmp_path / "out", quiet=True)
    assert message in str(error.value)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "out").exists()


MANY = """
scenario: tiny.yaml
factors: [{field: force_scaling.sigma, low: 0, high: 1, levels: LEVELS}]
repeats: 200
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("factors", "runs"),
    [(2, "1,000,000,000,000 runs"), (5, "10^21.0 runs"), (110, "10^336.0 runs")],
)
def test_too_large_study_is_refused_before_its_design(files, tmp_path, monkeypatch, factors, runs):
    monkeypatch.setattr(Study, "points", lambda self: pytest.fail("as large as that"))
    fields = [f"{{field: a.b{k}, low: 0, high: 1, levels: 1000}}" for k in range(factors)]
    path = files / "huge.yaml"
    path.write_text(f"factors: [{', '.join(fields)}]\nrepeats: 1000000")
    with pytest.raises(
        DrakeTeleopError,
        match=re.escape(f"huge.yaml: {runs} are too many (at most 1,000,000); give"),
    ):
        study_command(path, tmp_path / "out", yes=True)
    assert not (tmp_path / "out").exists()


def test_many_runs_require_consent(files, tmp_path, monkeypatch):
    class RunBegun(Exception):
        pass

    def begin(*arguments, **options):
        raise RunBegun

    monkeypatch.setattr(studies, "run_study", begin)
    path, out, asked = files / "many.yaml", tmp_path / "out", []
    path.write_text(MANY.replace("LEVELS", "501"))
    with pytest.raises(
        DrakeTeleopError,
        match=r"many\.yaml: 100,200 runs need your consent; confirm them by --yes",
    ):
        study_command(path, out)
    with pytest.raises(DrakeTeleopError, match="--yes"):
        study_command(path, out, yes=lambda question: asked.append(question))
    assert asked == [f"{path}: 100,200 runs. Begin?"]
    for yes in (True, lambda question: True):
        with pytest.raises(RunBegun):
            study_command(path, out, yes=yes)
    path.write_text(MANY.replace("LEVELS", "500"))
    with pytest.raises(RunBegun):
        study_command(path, out, yes=lambda question: pytest.fail("nobody need ask"))


def test_paths_of_the_scenario_are_relative_to_its_file(tmp_path):
    data = {
        "slave": {"model": "arm.sdf", "package_paths": ["meshes"], "tool": {"model": "tool.sdf"}},
        "channel": {"trace": "ping.csv", "backward": {"trace": "pong.csv"}},
    }
    work = studies.StationRunFunction(data, str(tmp_path / "base.yaml"), (), 1.0)
    scenario = work.scenario({"force_scaling.sigma": 0.5}, 1)
    slave, channel = scenario.slave, scenario.channel
    read = [slave.model, *slave.package_paths, slave.tool.model]
    read += [channel.trace, channel.backward.trace]
    names = ("arm.sdf", "meshes", "tool.sdf", "ping.csv", "pong.csv")
    assert read == [str(tmp_path / name) for name in names]


def test_edited_file_of_a_factor_is_another_study(tmp_path, monkeypatch):
    """The scenario contains the other tool; the mesh is in a package of the scenario."""
    (tmp_path / "parts").mkdir()
    for name in ("a", "b"):
        (tmp_path / f"{name}.sdf").write_text(
            f'<sdf version="1.9"><model name="{name}"><link name="body"><inertial><mass>1</mass>'
            "</inertial><visual name='v'><geometry><mesh><uri>package://parts/a.obj</uri></mesh>"
            "</geometry></visual></link></model></sdf>"
        )
    (tmp_path / "parts/a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (tmp_path / "tiny.yaml").write_text(
        f"{SCENARIO}slave: {{tool: {{model: a.sdf}}, package_paths: [parts]}}\n"
    )
    (tmp_path / "study.yaml").write_text(
        "scenario: tiny.yaml\nfactors: [{field: slave.tool.model, words: [a.sdf, b.sdf]}]\n"
    )
    seen = []
    monkeypatch.setattr(studies, "run_study", lambda *a, **_: seen.append(a[3]["files"]) or 1 / 0)
    for edited in ("tiny.yaml", "b.sdf", "parts/a.obj"):
        (tmp_path / edited).write_text((tmp_path / edited).read_text() + "\n")
        with pytest.raises(ZeroDivisionError):
            study_command(tmp_path / "study.yaml", tmp_path / "out", quiet=True)
    assert seen[0] != seen[1] != seen[2]


def test_missing_study_file_is_an_error(tmp_path):
    with pytest.raises(DrakeTeleopError, match=r"none\.yaml'; give a YAML file or one of scaling_"):
        LoadStudy(tmp_path / "none.yaml")


def threads(values, seed):
    return {"hand_work_J": float(max(library["num_threads"] for library in threadpool_info()))}


def test_runs_use_one_blas_thread(tmp_path):
    study = Study(factors=[Factor("a.b", values=[0.0, 1.0])], measures=["hand_work_J"])
    with threadpool_limits(2):
        rows = run_study(study, tmp_path, threads, {}, jobs=1)
        assert threads({}, 0) == {"hand_work_J": 2.0}
    assert rows["hand_work_J"].to_list() == [1.0, 1.0]


def test_remaining_time_follows_from_the_latest_runs():
    """Runs take 2 s, four in parallel; the first two also identify a load."""
    shown = []
    counter = StudyProgress(100)
    counter.start_reporting(lambda fraction, words="": shown.append((fraction, words)), 4)
    counter.add_earlier_runs(20)
    assert shown == [(0.2, "20/100, the first runs begin")]
    counter.add_finished_runs([{"seconds": 9.0, SETUP_TIME_S_KEY: 7.0}] * 2)
    assert shown[-1] == (0.22, "22/100, about 0:00:39 left")
    for _ in range(18):
        counter.add_finished_runs([{"seconds": 2.0}])
    counter.add_finished_runs([{"error": "the run has ended its process"}])
    assert shown[-1] == (0.41, "41/100, about 0:00:30 left")
    counter.add_finished_runs([{"seconds": 2.0}] * 59)
    assert shown[-1] == (1.0, "100/100, about 0:00:00 left")


def test_repeated_identifications_count_in_the_remaining_time():
    shown = []
    counter = StudyProgress(100)
    counter.start_reporting(lambda fraction, words="": shown.append(words), 1)
    for _ in range(40):
        counter.add_finished_runs([{"seconds": 9.0, SETUP_TIME_S_KEY: 7.0}])
    assert shown[0] == "1/100, about 0:03:18 left"
    assert shown[-1] == "40/100, about 0:09:00 left"


def test_first_rows_of_a_large_study_are_stored_one_by_one(tmp_path):
    factor = Factor("a.b", low=0.0, high=1.0, levels=1000)
    study = Study(factors=[factor], repeats=5, measures=["hand_work_J"])
    sizes = []

    def work(values, seed):
        if len(sizes) == 20:
            raise KeyboardInterrupt
        sizes.append(len(list((tmp_path / "runs.parquet").iterdir())))
        return {"hand_work_J": values["a.b"]}

    with pytest.raises(KeyboardInterrupt, match="contains 20 of 5000 runs"):
        run_study(study, tmp_path, work, {}, jobs=1)
    assert sizes == list(range(20))
