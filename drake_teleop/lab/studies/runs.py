"""Execution of a study: runs its design in processes and stores the results."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.files import CannotWrite
from drake_teleop.common.numeric import Array, one_blas_thread
from drake_teleop.common.progress import StartStage, UpdateProgress, show_progress
from drake_teleop.common.version import __version__
from drake_teleop.lab.studies.design import FactorValues, Study
from drake_teleop.lab.studies.processes import open_executor
from drake_teleop.lab.studies.store import Chunk, Store, merge_shards, open_store, parse_shard

if TYPE_CHECKING:
    import polars as pl

RunFunction: TypeAlias = Callable[[FactorValues, int], dict[str, float]]
"""Function from factor values and seed to the run's measures; `SETUP_TIME_S_KEY` is optional."""

SETUP_TIME_S_KEY = "seconds_once"
"""Name of the time [s] for work that most other runs do not repeat, e.g. load identification."""
_RUN_TIME_S_KEY = "seconds"

# A chunk is one part of the store and the work of a process. Chunks are small, so that no process
# waits at the end. The first chunks have one run, for early results and time estimates.
_MAX_RUNS_PER_CHUNK, _TARGET_NUM_CHUNKS, _NUM_SINGLE_RUNS = 8, 512, 64
_NUM_RUNS_FOR_TIME_ESTIMATE = 16  # latest runs, for the estimate of the remaining time


def run_study(
    study: Study,
    out: Path,
    run_function: RunFunction,
    inputs: dict[str, Any],
    *,
    jobs: int = -1,
    cluster: str | None = None,
    executor: Executor | None = None,
    shard: str | None = None,
    merge: bool = False,
    progress: bool | StartStage = True,
) -> pl.DataFrame:
    """Run all runs that `out` does not contain yet; return the rows of all runs, sorted by run.

    `inputs` is JSON data of all else that determines results, to refuse an `out` of other inputs.
    `shard` "K/N" restricts runs and rows to this shard; `merge` only collects all shards' rows.
    """
    import polars as pl

    part = None if shard is None else parse_shard(shard)
    if (part or merge) and study.design == "adaptive":
        what = "an adaptive design has no shards, because its points depend on earlier runs"
        raise DrakeTeleopError(what, where="study", remedy="use jobs, cluster or executor")
    points = study.points()
    first_rows = study.rows(points)
    digest = hashlib.sha256(json.dumps(first_rows).encode()).hexdigest()
    identity = dataclasses.asdict(study) | inputs | {"design_sha256": digest}
    identity |= {"version": __version__, "single_runs": _NUM_SINGLE_RUNS}  # determines chunks
    schema = _schema_of_run_table(study, first_rows[0])
    run = partial(_run_chunk, run_function, [factor.field for factor in study.factors])
    chunks = _split_rows_into_chunks(first_rows)
    chunks = chunks if part is None else part.chunks(chunks)
    total = sum(map(len, chunks)) if part else study.num_points() * study.repeats
    with open_store(part.folder(out) if part else out, identity) as store:
        if merge:
            merge_shards(out, store, identity, chunks)
        counter = StudyProgress(total)
        try:
            with (
                show_progress(progress) as stage,
                open_executor(store, jobs, cluster, executor) as (num_workers, run_chunks),
            ):
                counter.start_reporting(stage("Study"), num_workers)
                new = points
                while new:
                    finished = store.first_runs_of_finished_chunks()
                    left = [chunk for chunk in chunks if chunk[0]["run"] not in finished]
                    counter.add_earlier_runs(sum(map(len, chunks)) - sum(map(len, left)))
                    for found in run_chunks(run, left):
                        columns = {name: [row.get(name) for row in found] for name in schema}
                        store.write(pl.DataFrame(columns, schema=schema))
                        counter.add_finished_runs(found)
                    new = study.next_points(points, _objective_means(study, store, len(points)))
                    chunks = _split_rows_into_chunks(study.rows(new, len(points)))
                    points += new
        except (KeyboardInterrupt, CannotWrite) as error:
            remedy = f"{out} contains {counter.done} of {counter.total} runs; repeat the command"
            if isinstance(error, CannotWrite):
                raise DrakeTeleopError(str(error), remedy=remedy) from error
            raise KeyboardInterrupt(remedy) from error
        return store.read()


def _split_rows_into_chunks(rows: Chunk) -> list[Chunk]:
    size = min(max(len(rows) // _TARGET_NUM_CHUNKS, 1), _MAX_RUNS_PER_CHUNK)
    chunks = [[row] for row in rows[:_NUM_SINGLE_RUNS]]
    chunks += [rows[first : first + size] for first in range(_NUM_SINGLE_RUNS, len(rows), size)]
    return chunks


def _objective_means(study: Study, store: Store, points: int) -> Array:
    if not study.objective:
        return np.empty(0)
    import polars as pl

    # One NaN would make the whole mean NaN.
    value = pl.col(study.objective).fill_nan(None).mean()
    means = store.read().filter(pl.col("point") < points).group_by("point").agg(value).sort("point")
    return means[study.objective].cast(pl.Float64).fill_null(float("nan")).to_numpy()


class StudyProgress:
    """Finished runs and remaining time of a study."""

    def __init__(self, total: int) -> None:
        self.total, self.done, self._num_timed = total, 0, 0
        self._recent: deque[float] = deque(maxlen=_NUM_RUNS_FOR_TIME_ESTIMATE)

    def start_reporting(self, progress: UpdateProgress, processes: int) -> None:
        self._progress, self._processes = progress, processes

    def add_earlier_runs(self, runs: int) -> None:
        self.done += runs
        self._report_progress()

    def add_finished_runs(self, rows: Chunk) -> None:
        self.done += len(rows)
        for row in rows:
            if _RUN_TIME_S_KEY in row:  # missing if the run ended its process
                first = self._num_timed < _NUM_RUNS_FOR_TIME_ESTIMATE
                self._recent.append(row[_RUN_TIME_S_KEY] - first * row.get(SETUP_TIME_S_KEY, 0.0))
                self._num_timed += 1
        self._report_progress()

    def _report_progress(self) -> None:
        left, words = self.total - self.done, "the first runs begin"
        if self._recent:
            at_once = min(self._processes, left) or 1
            seconds = float(np.median(self._recent)) * left / at_once
            minutes, rest = divmod(round(seconds), 60)
            words = f"about {minutes // 60}:{minutes % 60:02d}:{rest:02d} left"
        self._progress(self.done / self.total, f"{self.done}/{self.total}, {words}")


def _run_chunk(run_function: RunFunction, names: Sequence[str], rows: Chunk) -> Chunk:
    found = []
    with one_blas_thread():
        for row in rows:
            start = time.monotonic()
            values = {name: row[name] for name in names}
            try:
                measures: dict[str, Any] = run_function(values, row["seed"])
            except DrakeTeleopError as error:
                measures = {"error": str(error)}
            except Exception as error:  # other runs must continue
                measures = {"error": " ".join(f"{type(error).__name__}: {error}".split())}
            # Not stored in the table, which must be reproducible.
            found.append(row | measures | {_RUN_TIME_S_KEY: time.monotonic() - start})
    return found


def _schema_of_run_table(study: Study, row: dict[str, Any]) -> dict[str, Any]:
    import polars as pl

    vector = pl.List(pl.Float64)
    types = {int: pl.Int64, float: pl.Float64, str: pl.String, bool: pl.Boolean, list: vector}
    columns = {name: types[type(value)] for name, value in row.items()}
    return columns | dict.fromkeys(study.measures, pl.Float64) | {"error": pl.String}
