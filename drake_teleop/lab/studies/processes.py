"""Execution of a study's runs by processes of this machine, Dask workers or a custom executor.

After a crash the runs of the chunk are repeated singly; one that crashes again gets an error text.
With one job, a crash ends the study.
"""

from __future__ import annotations

import os
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Executor, as_completed
from contextlib import contextmanager
from typing import Any, TypeAlias

from drake_teleop.common.errors import DrakeTeleopError, remedy_to_install_extra
from drake_teleop.common.version import __version__
from drake_teleop.lab.studies.store import Chunk, Store

RunRows: TypeAlias = Callable[[Chunk], Chunk]
RunChunks: TypeAlias = Callable[[RunRows, Sequence[Chunk]], Iterator[Chunk]]
"""Function that runs chunks in parallel and yields each one when it is finished."""
PROCESS_ENDED_ERROR_TEXT = "the run has ended its process"


@contextmanager
def open_executor(
    store: Store, jobs: int, cluster: str | None, executor: Executor | None
) -> Iterator[tuple[int, RunChunks]]:
    """Start `jobs` processes; yield the number of parallel runs and a function that runs chunks.

    `cluster` is the address of a Dask scheduler, or "local"; a given `executor` is not shut down.
    """
    if executor is not None:
        if not isinstance(executor, Executor):
            what = f"has type {type(executor).__name__}, not concurrent.futures.Executor"
            remedy = "pass an Executor, such as ProcessPoolExecutor"
            raise DrakeTeleopError(what, where="executor", remedy=remedy)
        workers = getattr(executor, "_max_workers", max(jobs, 1))
        yield workers, lambda run, chunks: _run_on_executor(run, chunks, executor)
        return
    if cluster is None:
        from joblib import effective_n_jobs

        workers = effective_n_jobs(jobs)
        yield workers, lambda run, chunks: _run_locally(run, chunks, store, jobs)
        return
    with _open_dask_client(cluster, jobs) as client:
        _check_worker_versions(client)
        workers = sum(client.nthreads().values())
        yield workers, lambda run, chunks: _run_on_cluster(run, chunks, client)


def _run_locally(run: RunRows, chunks: Sequence[Chunk], store: Store, jobs: int) -> Iterator[Chunk]:
    left = list(chunks)
    # One mark may come from a killed session; two marks of one chunk indicate a crash.
    suspicious = 2
    while left:
        marked = store.first_runs_of_chunks_by_min_starts(suspicious)
        for chunk in left:
            if chunk[0]["run"] in marked:
                yield _run_rows_one_by_one(run, chunk, store)
        left = [chunk for chunk in left if chunk[0]["run"] not in marked]
        done: set[int] = set()
        try:
            for found in _joblib_pool(jobs)(_joblib_task(run, chunk, store) for chunk in left):
                done.add(found[0]["run"])
                yield found
        except BrokenExecutor as error:
            suspicious = 1
            if not store.first_runs_of_chunks_by_min_starts(suspicious):
                what = f"processes ended before their first run ({error})"
                remedy = "repeat with --jobs 1 to see the cause"
                raise DrakeTeleopError(what, where="study", remedy=remedy) from error
        left = [chunk for chunk in left if chunk[0]["run"] not in done]


def _joblib_pool(jobs: int) -> Any:
    from joblib import Parallel

    # joblib also warns when it replaces processes that use much memory; a crash raises an error.
    warnings.filterwarnings("ignore", "A worker stopped while some jobs", UserWarning)
    return Parallel(
        n_jobs=jobs,
        backend="loky",
        return_as="generator_unordered",
        # Batches of chunks would leave processes idle at the end.
        batch_size=1,
        initializer=_exit_when_parent_ends,
        initargs=(os.getpid(),),
    )


def _joblib_task(run: RunRows, chunk: Chunk, store: Store) -> Any:
    from joblib import delayed

    return delayed(_run_chunk_and_count_start)(run, chunk, store)


def _run_rows_one_by_one(run: RunRows, chunk: Chunk, store: Store) -> Chunk:
    found = []
    for row in chunk:
        try:
            # With one job joblib would run it in this process.
            found += next(_joblib_pool(2)([_joblib_task(run, [row], store)]))
        except BrokenExecutor:
            found.append(row | {"error": PROCESS_ENDED_ERROR_TEXT})
    store.clear_start_count_of_chunk(chunk[0]["run"])
    return found


def _run_chunk_and_count_start(run: RunRows, chunk: Chunk, store: Store) -> Chunk:
    store.count_start_of_chunk(chunk[0]["run"])
    try:
        return run(chunk)
    finally:
        store.clear_start_count_of_chunk(chunk[0]["run"])


def _exit_when_parent_ends(parent: int) -> None:
    def exit_after_parent() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)

    threading.Thread(target=exit_after_parent, daemon=True).start()


@contextmanager
def _open_dask_client(address: str, jobs: int) -> Iterator[Any]:
    try:
        import dask
        from distributed import Client
    except ImportError:
        remedy = remedy_to_install_extra("cluster")
        raise DrakeTeleopError("Dask is not installed", where="--cluster", remedy=remedy) from None
    local: dict[str, Any] = {"host": "127.0.0.1", "dashboard_address": "127.0.0.1:0"}
    local |= {"n_workers": jobs if jobs > 0 else None, "threads_per_worker": 1}
    # A worker that dies must hold no waiting chunks.
    scheduler = {"worker-saturation": 1.0, "allowed-failures": 1}
    with dask.config.set({f"distributed.scheduler.{key}": v for key, v in scheduler.items()}):
        try:
            client = Client(**local) if address == "local" else Client(address)
        except (OSError, ValueError) as error:
            what = f"no Dask scheduler answers at {address} ({error})"
            remedy = "start one, or check the address"
            raise DrakeTeleopError(what, where="--cluster", remedy=remedy) from None
        with client:
            yield client


def _run_on_executor(run: RunRows, chunks: Sequence[Chunk], executor: Executor) -> Iterator[Chunk]:
    futures = [executor.submit(run, chunk) for chunk in chunks]
    try:
        for future in as_completed(futures):
            yield future.result()
    except BrokenExecutor as error:
        what = f"ended before all runs were finished ({error})"
        remedy = "repeat the call with a new executor; finished runs are kept"
        raise DrakeTeleopError(what, where="executor", remedy=remedy) from error
    finally:
        for future in futures:
            future.cancel()


def _check_worker_versions(client: Any) -> None:
    for worker, found in client.run(_make_version_reader(), on_error="return").items():
        if found != __version__:
            raise _version_mismatch_error(worker, found, __version__)


def _make_version_reader() -> Callable[[], str]:
    # Dask sends a nested function as code, so that a worker of any version can execute it.
    def read_version() -> str:
        from drake_teleop.common.version import __version__ as found

        return found

    return read_version


def _version_mismatch_error(worker: str, found: Any, expected: str) -> DrakeTeleopError:
    what = f"worker {worker} has drake_teleop {found}, this process has {expected}"
    remedy = "install the same version on all workers and start them again"
    return DrakeTeleopError(what, where="--cluster", remedy=remedy)


def _with_version_check(run: RunRows) -> RunRows:
    # For workers that join later.
    version, expected = _make_version_reader(), __version__

    def run_on_same_version(chunk: Chunk) -> Chunk:
        from distributed import get_worker

        if (found := version()) != expected:
            raise _version_mismatch_error(get_worker().address, found, expected)
        return run(chunk)

    return run_on_same_version


def _run_on_cluster(run: RunRows, chunks: Sequence[Chunk], client: Any) -> Iterator[Chunk]:
    from distributed import as_completed

    run = _with_version_check(run)
    futures = client.map(run, chunks, pure=False)
    chunk_of = dict(zip(futures, chunks, strict=True))
    for future in as_completed(futures):
        yield _await_rows(future, chunk_of.pop(future), run, client)


def _await_rows(future: Any, chunk: Chunk, run: RunRows, client: Any) -> Chunk:
    from distributed import KilledWorker

    try:
        found: Chunk = future.result()
    except KilledWorker:
        if len(chunk) == 1:
            return [chunk[0] | {"error": PROCESS_ENDED_ERROR_TEXT}]
        alone = [(client.submit(run, [row], pure=False), [row]) for row in chunk]
        found = [row for part, rows in alone for row in _await_rows(part, rows, run, client)]
    return found
