"""Studies in shards, by a custom executor, and on Dask workers of another version."""

from __future__ import annotations

import itertools
import json
import os
import random
import subprocess
import sys
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path

import pytest

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.version import __version__
from drake_teleop.lab.studies import runs
from drake_teleop.lab.studies.design import Factor, Study
from drake_teleop.lab.studies.runs import run_study
from drake_teleop.lab.studies.store import parse_shard
from drake_teleop.lab.studies.study import study_command

STUDY = Study(
    factors=[Factor("a.b", low=0.0, high=1.0, levels=10)], repeats=12, measures=["hand_work_J"]
)


def work(values, seed):
    if seed % 7 == 3:
        raise ValueError("a seventh of them")
    return {"hand_work_J": values["a.b"] / (1 + seed)}


def table(out):
    return {part.name: part.read_bytes() for part in (out / "runs.parquet").iterdir()}


def run(out, study=STUDY, function=work, **options):
    return run_study(study, out, function, {}, jobs=1, progress=False, **options)


@pytest.fixture(autouse=True)
def parts_of_several_runs(monkeypatch):
    """Use several runs per part, as in a large study."""
    monkeypatch.setattr(runs, "_TARGET_NUM_CHUNKS", 20)


@pytest.fixture
def whole(tmp_path):
    run(tmp_path / "whole")
    return table(tmp_path / "whole")


# Each shard is a forked process; polars has no threads yet. A shard with a positive number kills
# itself at that run.
SHARDS = """
import json, os, sys
from pathlib import Path
sys.path.insert(0, sys.argv[3])
import test_shards as shards
shards.runs._TARGET_NUM_CHUNKS = 20

def run(number, last):
    left = [last]

    def work(values, seed):
        left[0] -= 1
        if not left[0]:
            os.kill(os.getpid(), 9)
        return shards.work(values, seed)

    shards.run(Path(sys.argv[1]), function=work, shard=f"{number}/8")

for number, last in json.loads(sys.argv[2]):
    child = os.fork()
    if not child:
        run(number, last)
        os._exit(0)
    assert os.waitpid(child, 0)[1] == (9 if last else 0)
"""


@pytest.mark.slow
def test_killed_shards_in_any_order_give_the_bytes_of_one_process(tmp_path, whole):
    """Three of eight shards are killed at a random run and submitted again at the end."""
    draw, out = random.Random(3), tmp_path / "out"
    deaths = {number: draw.randint(1, 12) for number in draw.sample(range(1, 9), 3)}
    order = [[number, deaths.get(number, 0)] for number in draw.sample(range(1, 9), 8)]
    order += [[number, 0] for number in deaths]
    words = [str(out), json.dumps(order), str(Path(__file__).parent)]
    subprocess.run([sys.executable, "-c", SHARDS, *words], check=True)
    rows = run(out, function=pytest.fail, merge=True)
    assert table(out) == whole
    assert rows["run"].to_list() == list(range(120))
    assert rows.equals(run(out, function=pytest.fail)), "nothing remains to be run"


@pytest.mark.slow
def test_merge_names_the_shards_that_are_missing(tmp_path, whole):
    for number in (1, 2, 4):
        run(tmp_path / "out", shard=f"{number}/5")
    first = tmp_path / "out" / "shards" / "2-of-5" / "runs.parquet" / "run_00000001.parquet"
    first.write_bytes(first.read_bytes()[:-9])
    with pytest.raises(DrakeTeleopError, match=r"of 120 runs are missing; run shards 2,3,5 of 5"):
        run(tmp_path / "out", merge=True)
    for number in (5, 3, 2):
        run(tmp_path / "out", shard=f"{number}/5")
    run(tmp_path / "out", function=pytest.fail, merge=True)
    assert table(tmp_path / "out") == whole


def test_shard_contains_only_its_own_rows(tmp_path):
    rows = [run(tmp_path, shard=f"{k}/3")["run"].to_list() for k in (1, 2, 3)]
    assert sorted(itertools.chain(*rows)) == list(range(120))
    assert all(34 <= len(each) <= 46 for each in rows)
    assert rows[0][:3] == [0, 3, 6]


def test_merge_without_links_copies_the_parts(tmp_path, monkeypatch):
    run(tmp_path, shard="1/1")

    def no_links(*_):
        raise OSError("not supported")

    monkeypatch.setattr(os, "link", no_links)
    assert run(tmp_path, function=pytest.fail, merge=True).height == 120


def test_shards_of_another_version_are_not_merged(tmp_path, monkeypatch):
    run(tmp_path, shard="1/2")
    monkeypatch.setattr(runs, "__version__", "0.0.1")
    run(tmp_path, shard="2/2")
    monkeypatch.undo()
    with pytest.raises(DrakeTeleopError, match="2-of-2: contains runs of another study, or of ano"):
        run(tmp_path, merge=True)


@pytest.mark.parametrize("text", ["0/4", "5/4", "1", "a/b", "1/-2", "1/2/3", "", "²/3"])
def test_invalid_shard_is_refused(text):
    with pytest.raises(DrakeTeleopError, match="is not K/N with 1 <= K <= N"):
        parse_shard(text)


def test_wrong_combinations_are_refused(tmp_path):
    with pytest.raises(DrakeTeleopError, match=r"has no shards; run study --shard K/N"):
        run(tmp_path, merge=True)
    with pytest.raises(DrakeTeleopError, match=r"only 1 chunks of runs .*; give at most 1 shards"):
        run(tmp_path / "one", Study(factors=[Factor("a.b", values=[1.0])]), shard="1/2")
    adaptive = Study(factors=STUDY.factors, design="adaptive", objective="hand_work_J")
    for options in ({"shard": "1/2"}, {"merge": True}):
        with pytest.raises(DrakeTeleopError, match="adaptive design has no shards"):
            run(tmp_path / "adaptive", adaptive, **options)
    with pytest.raises(DrakeTeleopError, match="shard and merge cannot be combined"):
        study_command("scaling_press", tmp_path, shard="1/2", merge=True)
    with ThreadPoolExecutor() as pool, pytest.raises(DrakeTeleopError, match="cannot be combined"):
        study_command("scaling_press", tmp_path, cluster="local", executor=pool)
    with pytest.raises(DrakeTeleopError, match=r"executor: has type int, not concurrent\.futures"):
        run(tmp_path / "executor", executor=3)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [ThreadPoolExecutor, ProcessPoolExecutor])
def test_any_executor_gives_the_same_bytes(tmp_path, whole, kind):
    with kind(2) as pool:
        run(tmp_path / "out", executor=pool)
        assert pool.submit(int, "7").result() == 7, "it remains open"
    assert table(tmp_path / "out") == whole


@pytest.mark.slow
def test_executor_that_ends_is_an_error_and_finished_runs_are_kept(tmp_path, whole):
    class Ending(ThreadPoolExecutor):
        submitted = 0

        def submit(self, *arguments):
            self.submitted += 1
            if self.submitted <= 20:
                return super().submit(*arguments)
            future = Future()
            future.set_exception(BrokenExecutor("a node was lost"))
            return future

    with Ending(1) as pool, pytest.raises(DrakeTeleopError, match=r"were finished \(a node was"):
        run(tmp_path / "out", executor=pool)
    run(tmp_path / "out")
    assert table(tmp_path / "out") == whole


WORKER = """
import sys
import drake_teleop.common.version as version
version.__version__ = "0.0.1"
from distributed.cli.dask_worker import main
main([sys.argv[1], "--no-nanny", "--nthreads", "1", "--host", "127.0.0.1",
      "--dashboard-address", "127.0.0.1:0"])
"""


@pytest.mark.slow
@pytest.mark.parametrize("late", [False, True])
def test_dask_worker_of_another_version_is_refused_by_name(tmp_path, late, monkeypatch):
    """A worker that joins a running study is refused as well."""
    from distributed import LocalCluster

    def nested(values, seed):  # needs no import of this file
        return {"hand_work_J": 0.0}

    if late:
        monkeypatch.setattr(
            "drake_teleop.lab.studies.processes._check_worker_versions", lambda client: None
        )
    with LocalCluster(n_workers=0, host="127.0.0.1", dashboard_address="127.0.0.1:0") as cluster:
        address = cluster.scheduler_address
        process = subprocess.Popen([sys.executable, "-c", WORKER, address])
        try:
            from distributed import Client

            with Client(address) as client:
                client.wait_for_workers(1, timeout=60)
                (name,) = client.scheduler_info()["workers"]
            with pytest.raises(DrakeTeleopError) as error:
                run(tmp_path, function=nested, cluster=address)
            said = f"worker {name} has drake_teleop 0.0.1, this process has {__version__}"
            assert said in str(error.value)
        finally:
            process.kill()
            process.wait()
    assert not list((tmp_path / "runs.parquet").iterdir())
