"""Settings of the whole test suite."""

from __future__ import annotations

import gc
import os
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings
from sockets import open_to_others

# One thread of BLAS in each process: the matrices are small, and threads that wait for a core which
# another worker has take longer than the work. numpy is not imported yet, so it will see this.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Libraries are installed as sources. What one process has compiled of them the others need not,
# even if the surroundings forbid to keep it: to import drake_teleop.run takes 2.6 s then, not 7.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# Cyclic garbage is looked for seldom: with Python's thresholds that took 11 % of the tests' time
# and a quarter of that of their collection.
gc.set_threshold(20_000, 20, 50)

# Tests are never timed (the first call of a compiled function takes seconds) and the same on
# every machine and day.
settings.register_profile("drake_teleop", deadline=None, derandomize=True)
settings.load_profile("drake_teleop")


#: What compiles little of what the notebooks and the stations do, in the order in which it is run.
COMPILE_LITTLE = (
    *("load", "logs"),
    *("cli", "house", "malformed_input", "master", "passivity", "theory", "vectors"),
)


def pytest_configure(config: pytest.Config) -> None:
    """One cache of identified loads for all workers and their processes; never the user's."""
    if not hasattr(config, "workerinput"):
        folder = tempfile.TemporaryDirectory(prefix="drake_teleop-")
        config.add_cleanup(folder.cleanup)
        os.environ["DRAKE_TELEOP_CACHE_DIR"] = folder.name


def pytest_collection_finish() -> None:
    """What is imported and collected by now is not looked through for garbage either."""
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def nothing_listens_to_other_machines() -> Iterator[None]:
    """Whatever command or function a test calls; see docs/security.md.

    Looked at now and then: Linux takes 8 ms to tell, and many tests make a film or a cluster.
    """
    found: set[str] = set()
    over = threading.Event()

    def look() -> None:
        while not over.wait(2.0):
            found.update(open_to_others())

    watch = threading.Thread(target=look, daemon=True)
    watch.start()
    yield
    over.set()
    watch.join()
    assert not found


@pytest.fixture
def meshcat() -> Iterator[Any]:
    """One that is unmade here: by the garbage collection of another thread it ends the process."""
    from pydrake.geometry import Meshcat, MeshcatParams  # not before OPENBLAS_NUM_THREADS is set

    yield Meshcat(MeshcatParams(host="localhost"))
    gc.collect()


@pytest.hookimpl(trylast=True)  # what is not run shall not count
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The first worker begins with the notebooks, the second with what compiles little.

    What takes longest must not be what the other one waits for at the end, and both shall not
    compile the same at the same time. Two workers get one half of the list each.
    """

    def place(item: pytest.Item) -> int:
        if item.path.name == "test_notebooks.py":
            return -2
        room = item.path.relative_to(Path(__file__).parent).parts[0]
        room = room.removeprefix("test_").removesuffix(".py")
        return COMPILE_LITTLE.index(room) if room in COMPILE_LITTLE else -1

    much = sorted((item for item in items if place(item) < 0), key=place)
    little = sorted((item for item in items if place(item) >= 0), key=place)
    half = len(items) // 2
    items[:] = [*much[:half], *little, *much[half:]]
