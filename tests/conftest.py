"""Settings of the whole test suite."""

from __future__ import annotations

import gc
import os
import signal
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
# even if the surroundings forbid to keep it: importing lab.run takes 2.6 s then, not 7.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# A shell ignores SIGINT for what it starts in the background, and processes inherit that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Cyclic garbage is looked for seldom: with Python's thresholds that took 11 % of the tests' time
# and a quarter of that of their collection.
gc.set_threshold(20_000, 20, 50)

# Tests are never timed (the first call of a compiled function takes seconds) and the same on
# every machine and day.
settings.register_profile("drake_teleop", deadline=None, derandomize=True)
settings.load_profile("drake_teleop")


TESTS = Path(__file__).parent
#: What compiles little of what the stations do, in the order in which it is run.
COMPILE_LITTLE = (
    *("load", "logs"),
    *("cli", "house", "malformed_input", "master", "passivity", "theory", "vectors"),
)


def pytest_configure(config: pytest.Config) -> None:
    """One cache of identified loads for all workers and their processes; never the user's.

    The second worker collects from the other end: what both import is compiled by one of them.
    """
    if not hasattr(config, "workerinput"):
        folder = tempfile.TemporaryDirectory(prefix="drake_teleop-")
        config.add_cleanup(folder.cleanup)
        os.environ["DRAKE_TELEOP_CACHE_DIR"] = folder.name
    elif config.workerinput["workerid"] == "gw1" and config.args == ["tests"]:
        rooms = [path for path in TESTS.glob("[a-z]*") if path.is_dir() or path.match("test_*.py")]
        config.args[:] = sorted(map(str, rooms), reverse=True)


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


@pytest.fixture(autouse=True)
def pictures_in_outline(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures are made but not painted, which takes longer than most tests; see `pictures`.

    What tests share is made before, and painted.
    """
    from matplotlib.figure import Figure  # not before OPENBLAS_NUM_THREADS is set

    if request.node.get_closest_marker("pictures") is None:
        painted = Figure.savefig

        def outline(_: Figure, target: Any, **options: Any) -> None:
            painted(Figure(figsize=(0.1, 0.1)), target, **options)

        monkeypatch.setattr(Figure, "savefig", outline)


@pytest.fixture
def meshcat() -> Iterator[Any]:
    """One that is unmade here: by the garbage collection of another thread it ends the process."""
    from pydrake.geometry import Meshcat, MeshcatParams  # not before OPENBLAS_NUM_THREADS is set

    yield Meshcat(MeshcatParams(host="localhost"))
    gc.collect()


@pytest.hookimpl(trylast=True)  # what is not run shall not count
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """One worker begins with what compiles little: both shall not compile the same at one time.

    Two workers get one half of the list each, and have the same list, see `pytest_configure`.
    """

    def room(item: pytest.Item) -> str:
        first = item.path.relative_to(TESTS).parts[0]
        return first.removeprefix("test_").removesuffix(".py")

    items.sort(key=lambda item: item.path.parts)
    much = [item for item in items if room(item) not in COMPILE_LITTLE]
    little = [item for item in items if room(item) in COMPILE_LITTLE]
    little.sort(key=lambda item: COMPILE_LITTLE.index(room(item)))
    half = len(items) // 2
    items[:] = [*much[:half], *little, *much[half:]]
