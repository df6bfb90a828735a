"""The code keeps the house's style and its types hold."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

# The type stubs of numpy differ from one Python to the next, and with them what mypy finds.
pytestmark = pytest.mark.skipif(
    sys.version_info[:2] != (3, 11), reason="linted on one version of Python, that of .ci/run"
)


@pytest.mark.slow
@pytest.mark.parametrize("check", [["ruff", "check"], ["ruff", "format", "--check"], ["mypy"]])
def test_linters_find_nothing(check):
    answer = subprocess.run(
        [sys.executable, "-m", *check], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert answer.returncode == 0, answer.stdout + answer.stderr
