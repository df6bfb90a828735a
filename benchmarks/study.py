"""How well does a study use two cores, is it reproducible, and what does a kill cost?

`python benchmarks/study.py [--runs 2000] [--kills 20] [--json FILE]` runs one study of the station
(a contact transition over sigma, gamma and seeds: 1 s simulated, the loads identified first). It
uses one process, two processes, and a local Dask cluster, each with an empty folder, and once more
two processes with SIGKILL at random times. Baseline of the efficiency is the one process, by the
clock, so the machine must be idle. Parts are compared byte by byte. `--shards 8` runs only one
process and, next to it, shards in random order: three are killed at random runs, submitted again
and merged. The overhead is their CPU time beyond that of one process, with and without the repeated
work of the kills: one more start each, and the CPU time since the last stored part.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import resource
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import polars as pl

_STARTS = 5  # repetitions of a finished shard
_STUDY = """
scenario: contact_transition
factors:
  - {{field: force_scaling.sigma, low: 0, high: 1, levels: {sigmas}}}
  - {{field: force_scaling.gamma, low: 0.5, high: 3, levels: {gammas}}}
  - {{field: rates.sensor_hz, values: [2000]}}
  - {{field: rates.hand_hz, values: [1000]}}
  - {{field: rates.joint_control_hz, values: [1000]}}
  - {{field: simulation.settle, values: [0.4]}}
  - {{field: simulation.duration, values: [0.6]}}
repeats: {repeats}
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=2000, help="number of runs, a multiple of 400")
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument(
        "--shards", type=int, default=0, help="compare only this number of shards with one process"
    )
    parser.add_argument("--shards-in", type=Path, help="folder of `--shards`")
    parser.add_argument("--no-cluster", action="store_true", help="skip Dask")
    parser.add_argument("--json", type=Path, help="file for the figures")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        measure = sharded if arguments.shards else measured
        if arguments.shards_in:
            measure, folder = shards, arguments.shards_in
        figures = measure(Path(folder), arguments)
    for name, figure in figures.items():
        print(f"{name:30s} {figure:10.4g}")
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=2) + "\n")


def measured(folder: Path, arguments: argparse.Namespace) -> dict[str, float]:
    """Return all figures; the studies are in `folder`."""
    study = folder / "study.yaml"
    half = folder / "half.yaml"
    warm = folder / "warm.yaml"  # fills the cache of compiled code
    repeats = max(arguments.runs // 400, 1)
    study.write_text(_STUDY.format(sigmas=20, gammas=20, repeats=repeats))
    half.write_text(_STUDY.format(sigmas=10, gammas=20, repeats=repeats))
    warm.write_text(_STUDY.format(sigmas=2, gammas=2, repeats=1))
    run(warm, folder / "warm", "--jobs", "1")
    halves = [command(half, folder / name, "--jobs", "1") for name in ("left", "right")]
    (serial, _), (joblib, _), (apart, _) = by_turns(
        (command(study, folder / "serial", "--jobs", "1"), 10.0),
        (command(study, folder / "joblib", "--jobs", "2"), 5.0),
        (["sh", "-c", " & ".join(map(shlex.join, halves)) + " & wait"], 5.0),
    )
    same = parts(folder / "serial") == parts(folder / "joblib")
    rows = pl.read_parquet(folder / "serial" / "runs.parquet")
    figures = {
        "runs": float(rows.height),
        "failed": float(rows["error"].count()),
        "one_process_s": serial,
        "two_processes_s": joblib,
        "two_studies_of_half_s": apart,
        "efficiency": serial / (2 * joblib),
        "efficiency_of_two_studies": serial / (2 * apart),
        "two_processes_the_same": float(same),
    }
    if not arguments.no_cluster:
        figures["dask_s"] = run(study, folder / "dask", "--jobs", "2", "--cluster", "local")
        figures["dask_the_same"] = float(parts(folder / "serial") == parts(folder / "dask"))
    kills = killed(study, folder / "killed", arguments.kills, joblib)
    run(study, folder / "killed", "--jobs", "2")
    rows = pl.read_parquet(folder / "killed" / "runs.parquet")
    return figures | {
        "kills": float(kills),
        "rows_doubled": float(rows.height - rows["run"].n_unique()),
        "rows_lost": figures["runs"] - rows["run"].n_unique(),
        "killed_the_same": float(parts(folder / "serial") == parts(folder / "killed")),
    }


def sharded(folder: Path, arguments: argparse.Namespace) -> dict[str, float]:
    """Run one process, and next to it shards in sequence: three are killed and submitted again."""
    study, warm, found = folder / "study.yaml", folder / "warm.yaml", folder / "shards.json"
    study.write_text(_STUDY.format(sigmas=arguments.runs // 8, gammas=2, repeats=4))
    warm.write_text(_STUDY.format(sigmas=2, gammas=2, repeats=4))
    run(warm, folder / "warm", "--jobs", "1")
    words = [sys.executable, __file__, "--runs", str(arguments.runs)]
    words += ["--shards", str(arguments.shards), "--shards-in", str(folder)]
    commands = (
        command(study, folder / "serial", "--jobs", "1"),
        [*words, "--json", str(found)],
    )
    started = [subprocess.Popen(each) for each in commands]
    ended = [os.wait4(process.pid, 0) for process in started]
    if any(status for _, status, _ in ended):
        raise SystemExit("a study has failed")
    whole = ended[0][2].ru_utime + ended[0][2].ru_stime
    figures: dict[str, float] = json.loads(found.read_text())
    before = cpu_s()
    for _ in range(_STARTS):
        run(study, folder / "out", "--jobs", "1", "--shard", f"1/{arguments.shards}")
    start = (cpu_s() - before) / _STARTS
    repeated = 3.0 * start + figures["cpu_s_of_killed_runs"]
    total = figures["shards_cpu_s"]
    table = pl.read_parquet(folder / "out" / "runs.parquet")
    return figures | {
        "runs": float(table.height),
        "one_process_cpu_s": whole,
        "finished_shard_cpu_s": start,
        "repeated_by_kills_cpu_s": repeated,
        "overhead": (total - repeated) / whole - 1.0,
        "overhead_with_kills": total / whole - 1.0,
        "cost_of_a_start_cpu_s": (total - repeated - whole) / arguments.shards,
        "the_same": float(parts(folder / "serial") == parts(folder / "out")),
    }


def shards(folder: Path, arguments: argparse.Namespace) -> dict[str, float]:
    """Run all shards in `folder`, then the merge; return CPU times without this process."""
    study, out, count = folder / "study.yaml", folder / "out", arguments.shards
    draw, lost, begin = random.Random(53), 0.0, cpu_s()
    chosen = draw.sample(range(1, count + 1), 3)
    for number in (*draw.sample(range(1, count + 1), count), *chosen):
        words = command(study, out, "--jobs", "1", "--shard", f"{number}/{count}")
        rows = out / f"shards/{number}-of-{count}/runs.parquet"
        process = subprocess.Popen(words)
        if number in chosen and not rows.exists():
            # A file contains several runs; a shard that finishes within one file is not killed.
            stored, last, stop = -1, 0.0, draw.randint(1, max(1, arguments.runs // count // 8))
            while stored < stop and process.poll() is None:
                if (now := len(list(rows.glob("run_*.parquet")))) != stored:
                    stored, last = now, cpu_s_of(process.pid)
                time.sleep(0.01)
            time.sleep(draw.uniform(0.0, 0.5))  # in the middle of a run
            if process.poll() is None:
                lost += cpu_s_of(process.pid) - last
                process.kill()
        process.wait()
    before = cpu_s()
    run(study, out, "--merge")
    return {
        "shards_cpu_s": cpu_s() - begin,
        "merge_cpu_s": cpu_s() - before,
        "cpu_s_of_killed_runs": lost,
    }


def cpu_s_of(pid: int) -> float:
    """Return the CPU time of a running process."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def cpu_s() -> float:
    """Return the CPU time of all ended processes."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def command(study: Path, out: Path, *options: str) -> list[str]:
    start = "from drake_teleop.cli.main import main; main()"
    return [
        sys.executable,
        "-c",
        start,
        "study",
        str(study),
        "--quiet",
        "--out",
        str(out),
        *options,
    ]


def run(study: Path, out: Path, *options: str) -> float:
    """Return elapsed seconds, with imports and pictures."""
    start = time.perf_counter()
    subprocess.run(command(study, out, *options), check=True)
    return time.perf_counter() - start


def by_turns(*studies: tuple[list[str], float]) -> list[tuple[float, float]]:
    """Return elapsed seconds, and CPU time, of commands that run by turns of some seconds."""
    started = [subprocess.Popen(words, start_new_session=True) for words, _ in studies]
    for process in started:
        os.killpg(process.pid, signal.SIGSTOP)
    spent, used = [0.0] * len(studies), [0.0] * len(studies)
    while any(process.returncode is None for process in started):
        for index, (process, (_, turn)) in enumerate(zip(started, studies, strict=True)):
            if process.returncode is not None:
                continue
            start, before = time.perf_counter(), cpu_s()
            os.killpg(process.pid, signal.SIGCONT)
            try:
                process.wait(turn)
                used[index] = cpu_s() - before
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGSTOP)
            spent[index] += time.perf_counter() - start
    if any(process.returncode for process in started):
        raise SystemExit("a study has failed")
    return list(zip(spent, used, strict=True))


def killed(study: Path, out: Path, times: int, whole: float) -> int:
    """Kill the study at random times; return the number of kills before its end."""
    pauses, kills = random.Random(0), 0
    for _ in range(times):
        process = subprocess.Popen(command(study, out, "--jobs", "2"))
        try:
            # Imports take seconds, so that some kills come before the first row.
            process.wait(timeout=pauses.uniform(0.0, 5.0 + whole / times))
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            kills += process.wait() == -signal.SIGKILL
    return kills


def parts(out: Path) -> dict[str, bytes]:
    return {part.name: part.read_bytes() for part in (out / "runs.parquet").iterdir()}


if __name__ == "__main__":
    main()
