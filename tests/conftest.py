"""Settings of the whole test suite."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import pytest
from hypothesis import settings

# One thread of BLAS in each process: the matrices are small, and threads that wait for a core which
# another worker has take longer than the work. numpy is not imported yet, so it will see this.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Tests are never timed (the first call of a compiled function takes seconds) and the same on
# every machine and day.
settings.register_profile("drake_teleop", deadline=None, derandomize=True)
settings.load_profile("drake_teleop")


#: Half of the tests, with which the second of two workers begins: they compile little of what the
#: first half does, so that the workers do not compile the same at the same time.
SECOND_HALF = (
    *("load", "logs"),  # in this order
    *("cli", "house", "malformed_input", "master", "passivity", "theory", "vectors"),
)


def pytest_configure(config: pytest.Config) -> None:
    """One cache of identified loads for all workers and their processes; never the user's."""
    if not hasattr(config, "workerinput"):
        folder = tempfile.TemporaryDirectory(prefix="drake_teleop-")
        config.add_cleanup(folder.cleanup)
        os.environ["DRAKE_TELEOP_CACHE_DIR"] = folder.name


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The notebooks first: what takes longest must not be what the other worker waits for."""

    def place(item: pytest.Item) -> int:
        if item.path.name == "test_notebooks.py":
            return -2
        room = item.path.relative_to(Path(__file__).parent).parts[0]
        room = room.removeprefix("test_").removesuffix(".py")
        return SECOND_HALF.index(room) if room in SECOND_HALF else -1

    items.sort(key=place)
