"""Code style by ruff and types by mypy; tests leave the clock to other threads."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

# numpy's type stubs differ between Python versions, and so do the results of mypy.
pytestmark = [
    pytest.mark.checks,
    pytest.mark.skipif(
        sys.version_info[:2] != (3, 11), reason="linted on one version of Python, that of .ci/run"
    ),
]


#: mypy without its cache and with fewer garbage collections, which take a quarter of its time.
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


def test_no_test_replaces_the_clock_of_other_threads():
    """A drive of a session fixture would wait until a replaced clock's time has come."""
    replaced = re.compile(r"setattr\((\w+\.)*time, |setattr\(\"time\.")
    texts = {path.name: path.read_text() for path in (ROOT / "tests").rglob("*.py")}
    assert [name for name, text in texts.items() if replaced.search(text)] == []
