"""The code keeps the house's style and its types hold."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

# The type stubs of numpy differ from one Python to the next, and with them what mypy finds.
pytestmark = [
    pytest.mark.checks,
    pytest.mark.skipif(
        sys.version_info[:2] != (3, 11), reason="linted on one version of Python, that of .ci/run"
    ),
]


#: mypy as it is, but for its search for garbage, a quarter of its time, which it turns on itself,
#: and for the cache that it would write.
MYPY = "import gc; gc.disable(); gc.enable = gc.disable; from mypy.main import main; main()"


@pytest.mark.slow
@pytest.mark.parametrize(
    "check",
    [
        ["-m", "ruff", "check"],
        ["-m", "ruff", "format", "--check"],
        ["-c", MYPY, "--cache-dir", os.devnull],
    ],
)
def test_linters_find_nothing(check):
    answer = subprocess.run(
        [sys.executable, *check], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert answer.returncode == 0, answer.stdout + answer.stderr
