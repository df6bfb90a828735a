"""Compiled code follows its sources, through calls from file to file."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

INNER = """
from numba import njit

@njit(cache=True)
def inner(x):
    return x + {number}
"""
OUTER = """
from numba import njit
from .inner import inner

@njit(cache=True)
def outer(x):
    return inner(x)
"""
MAIN = """
from pathlib import Path
from drake_teleop._compiled import discard_stale

if {discard}:
    discard_stale(Path("package"), Path("package"))
from package.outer import outer
print(outer(0.0))
"""


@pytest.mark.parametrize(("discard", "expected"), [(True, "2.0"), (False, "1.0")])
def test_a_function_is_compiled_again_when_one_that_it_calls_has_changed(
    tmp_path, discard, expected
):
    """The second case is numba's own behaviour, for which the function is there."""
    package = tmp_path / "package"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "outer.py").write_text(OUTER)
    environment = {key: os.environ[key] for key in os.environ if key != "NUMBA_CACHE_DIR"}

    def answer(number: int) -> str:
        (package / "inner.py").write_text(INNER.format(number=number))
        program = [sys.executable, "-c", MAIN.format(discard=discard)]
        done = subprocess.run(
            program, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
        )
        return done.stdout.strip()

    assert answer(1) == "1.0"
    assert answer(2) == expected
