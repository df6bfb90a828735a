"""Settings of the whole test suite."""

from __future__ import annotations

from hypothesis import settings

# Tests are never timed (the first call of a compiled function takes seconds) and the same on
# every machine and day.
settings.register_profile("drake_teleop", deadline=None, derandomize=True)
settings.load_profile("drake_teleop")
