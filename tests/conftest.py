"""Settings of the test suite."""

from __future__ import annotations

import gc
import os
import signal
import sys
import tempfile
import threading
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings
from sockets import open_to_others

# One BLAS thread for each process: the matrices are small, and threads that wait for a core of
# another worker cost more time than they save. numpy reads the variable when it is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Libraries are installed as sources. Processes share their byte code even if the environment
# forbids to write it, because importing lab.run without it takes more than twice as long.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# A shell starts background processes with SIGINT ignored, and processes inherit that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Fewer garbage collections: with Python's thresholds they take 11 % of the tests' time and a
# quarter of the time of collecting the tests.
gc.set_threshold(20_000, 20, 50)

# No deadline, because the first call of a compiled function takes seconds; the same examples on
# every machine and day.
settings.register_profile("drake_teleop", deadline=None, derandomize=True)
settings.load_profile("drake_teleop")


TESTS = Path(__file__).parent
#: Tests that compile few functions of stations, in the order in which they run.
COMPILE_LITTLE = (
    *("load", "logs"),
    *("cli", "malformed_input", "master", "passivity", "theory", "vectors"),
)
#: Number of collected cases of each test with the mark `quick_cases`.
COLLECTED_CASES = Counter[str]()


def pytest_configure(config: pytest.Config) -> None:
    """Give all workers and their processes one temporary cache of identified loads.

    The second worker collects the tests in reverse order, so that it compiles other functions.
    """
    if not hasattr(config, "workerinput"):
        folder = tempfile.TemporaryDirectory(prefix="drake_teleop-")
        config.add_cleanup(folder.cleanup)
        os.environ["DRAKE_TELEOP_CACHE_DIR"] = folder.name
    elif config.workerinput["workerid"] == "gw1" and config.args == ["tests"]:
        paths = [path for path in TESTS.glob("[a-z]*") if path.is_dir() or path.match("test_*.py")]
        config.args[:] = sorted(map(str, paths), reverse=True)


def pytest_itemcollected(item: pytest.Item) -> None:
    """Mark all cases of a test except the first n of its mark `quick_cases(n)` as `slow`."""
    mark = item.get_closest_marker("quick_cases")
    if mark is not None:
        COLLECTED_CASES[test := item.nodeid.partition("[")[0]] += 1
        if COLLECTED_CASES[test] > mark.args[0]:
            item.add_marker("slow")


def pytest_collection_finish() -> None:
    """Exclude all imported and collected objects from later garbage collections."""
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def nothing_listens_to_other_machines() -> Iterator[None]:
    """Check that no test opens a port to other machines; see docs/security.md.

    The ports are read every 2 s, because a reading takes 8 ms.
    """
    found: set[str] = set()
    finished = threading.Event()

    def record_open_ports() -> None:
        while not finished.wait(2.0):
            found.update(open_to_others())

    monitor = threading.Thread(target=record_open_ports, daemon=True)
    monitor.start()
    yield
    finished.set()
    monitor.join()
    assert not found


@pytest.fixture(autouse=True)
def render_only_marked_pictures(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Replace the rendering of pictures by a small empty one, except in tests marked `pictures`.

    Rendering takes longer than most tests. Session fixtures run earlier and do render.
    """
    from matplotlib.figure import Figure  # not before OPENBLAS_NUM_THREADS is set

    if request.node.get_closest_marker("pictures") is None:
        render = Figure.savefig

        def render_small_figure(_: Figure, target: Any, **options: Any) -> None:
            render(Figure(figsize=(0.1, 0.1)), target, **options)

        monkeypatch.setattr(Figure, "savefig", render_small_figure)


@pytest.fixture
def meshcat() -> Iterator[Any]:
    """Yield a Meshcat and delete it on this thread; another thread would abort the process."""
    from pydrake.geometry import Meshcat, MeshcatParams  # not before OPENBLAS_NUM_THREADS is set

    yield Meshcat(MeshcatParams(host="localhost"))
    gc.collect()


@pytest.hookimpl(trylast=True)  # after tests are deselected
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Let one of two workers begin with tests that compile little.

    Otherwise both compile the same functions at the same time. Each worker gets one half of the
    list; `pytest_configure` gives both the same list.
    """

    def topic(item: pytest.Item) -> str:
        first = item.path.relative_to(TESTS).parts[0]
        return first.removeprefix("test_").removesuffix(".py")

    items.sort(key=lambda item: item.path.parts)
    much = [item for item in items if topic(item) not in COMPILE_LITTLE]
    little = [item for item in items if topic(item) in COMPILE_LITTLE]
    little.sort(key=lambda item: COMPILE_LITTLE.index(topic(item)))
    half = len(items) // 2
    items[:] = [*much[:half], *little, *much[half:]]
