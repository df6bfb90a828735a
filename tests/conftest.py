"""Settings of the whole test suite."""

from __future__ import annotations

import os

import pytest
from hypothesis import settings

# One thread of BLAS in each process: the matrices are small, and threads that wait for a core which
# another worker has take longer than the work. numpy is not imported yet, so it will see this.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Tests are never timed (the first call of a compiled function takes seconds) and the same on
# every machine and day.
settings.register_profile("drake_teleop", deadline=None, derandomize=True)
settings.load_profile("drake_teleop")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The notebooks first: what takes longest must not be what the other worker waits for."""
    items.sort(key=lambda item: item.path.name != "test_notebooks.py")
