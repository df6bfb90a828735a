"""Settings of the whole test suite."""

from __future__ import annotations

import os
from pathlib import Path

from hypothesis import settings

import drake_teleop
from drake_teleop._compiled import discard_stale

# numba's cache takes no lock: two processes that compile one function at once, for different
# types, can leave the code of one under the name of the other. So each worker of pytest-xdist
# keeps a cache of its own. numba is not imported yet, so it will see this.
if worker := os.environ.get("PYTEST_XDIST_WORKER"):
    cache = Path(__file__).parents[1] / ".pytest_cache" / "numba" / worker
    os.environ["NUMBA_CACHE_DIR"] = str(cache)
    discard_stale(Path(drake_teleop.__file__).parent, cache)

# Tests are never timed (the first call of a compiled function takes seconds) and the same on
# every machine and day.
settings.register_profile("drake_teleop", deadline=None, derandomize=True)
settings.load_profile("drake_teleop")
