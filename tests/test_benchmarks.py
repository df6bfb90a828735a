"""The benchmarks' README names scripts that exist; what they compare with is what they measure."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

pytestmark = pytest.mark.checks

FOLDER = Path(__file__).parents[1] / "benchmarks"
README = (FOLDER / "README.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def identification() -> ModuleType:
    spec = importlib.util.spec_from_file_location("bench", FOLDER / "identification.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["bench"] = module
    spec.loader.exec_module(module)
    return module


def test_the_readme_has_a_section_for_scripts_that_exist() -> None:
    scripts = re.findall(r"^## (\w+\.py): .+\?$", README, re.M)
    assert {"identification.py", "station.py", "utias.py"} <= set(scripts)
    assert [name for name in scripts if not (FOLDER / name).is_file()] == []


def test_the_stacked_baselines_are_right_and_the_batch_agrees(identification: ModuleType) -> None:
    data = identification.samples(500)
    stacked = identification._stacked(*data[1:]).reshape(500, 6, 16)
    np.testing.assert_allclose(stacked[:, :, 6:], identification.regressor(*data[1:]), atol=1e-12)
    np.testing.assert_array_equal(stacked[:, :, :6], np.tile(np.eye(6), (500, 1, 1)))
    ours = identification._chunked(*data)
    for solve in (identification._least_squares, identification._normal_equations):
        np.testing.assert_allclose(solve(*data), ours, atol=1e-9)


def test_best_takes_the_shortest_of_each(identification: ModuleType) -> None:
    calls: list[str] = []
    times = identification.best({name: lambda n=name: calls.append(n) for name in "ab"}, rounds=3)
    assert calls == ["a", "b"] + ["a", "b"] * 3
    assert set(times) == {"a", "b"} and all(0 <= value < np.inf for value in times.values())


NUMERIC = '''"""Doubles x - 1."""
import math
from numba import njit
class Config:
    share: float = quantity(0.5, "1", 0.0, 1.0, "share - of all")
@njit
def turned(R, x, out):
    """Half of R - 1."""
    if len(x) < 3:
        raise ValueError(f"{len(x) + 1} is too few")
    for i in range(3):
        out[i] = min(R[i, 0] * x[0], 1.5)
    turned(x, out, R)
    return math.sqrt(x[1]) + math.cos(x[2])
def describe(x):
    return x + 1
'''


@pytest.fixture(scope="module")
def changed() -> dict[str, set[str]]:
    """Lines that mutations make of `NUMERIC`, by their kinds."""
    spec = importlib.util.spec_from_file_location("mutations", FOLDER / "mutations.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["mutations"] = module
    spec.loader.exec_module(module)
    source = NUMERIC.encode()
    lines: dict[str, set[str]] = {}
    for mutant in module.mutations("numeric.py", source):
        assert mutant.valid(source)
        assert mutant.applied(source).count(b"\n") == source.count(b"\n")
        lines.setdefault(mutant.kind, set()).add(mutant.lines(source)[1])
    return lines


@pytest.mark.parametrize(
    ("kind", "line"),
    [
        ("constant", "for i in range(2):"),
        ("constant", "out[i] = min(R[i, 0] * x[0], 1.05)"),
        ("transposed", "out[i] = min(R[0, i] * x[0], 1.5)"),
        ("factor", "out[i] = min(R[i, 0] / x[0], 1.5)"),
        ("index", "out[i] = min(R[i, 0] * x[1], 1.5)"),
        ("extreme", "out[i] = max(R[i, 0] * x[0], 1.5)"),
        ("limit", "out[i] = (R[i, 0] * x[0])"),
        ("exchanged", "turned(out, x, R)"),
        ("statement", "pass"),
        ("removed", "return (x[1]) + math.cos(x[2])"),
        ("sign", "return math.sqrt(x[1]) - math.cos(x[2])"),
        ("angle", "return math.sqrt(x[1]) + math.sin(x[2])"),
    ],
)
def test_mutations_of_a_kind(changed: dict[str, set[str]], kind: str, line: str) -> None:
    assert line in changed[kind]


def test_no_mutation_of_text_messages_and_defaults(changed: dict[str, set[str]]) -> None:
    lines = set().union(*changed.values())
    assert not [line for line in lines if re.search("share|Half|too few|len|x [-+*/] ", line)]


@pytest.mark.slow
def test_a_mutant_is_killed_or_named_and_the_sources_stay_as_they_are(tmp_path: Path) -> None:
    files = {
        "drake_teleop/__init__.py": "",
        "drake_teleop/load/__init__.py": "",
        "drake_teleop/load/half.py": "import math\ndef half(x):\n    return 0.5 * abs(x)\n",
        "tests/load/test_half.py": "from drake_teleop.load.half import half\n"
        "def test_half():\n    assert half(2.0) == 1.0\n",
    }
    for name, text in files.items():
        (tmp_path / "root" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "root" / name).write_text(text, encoding="utf-8")
    options = ["--root", "root", "--folder", "work", "--jobs", "1", "--json", "figures.json"]
    said = subprocess.run(
        [sys.executable, str(FOLDER / "mutants.py"), *options],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(tmp_path / "root")},
        check=True,
        capture_output=True,
        text=True,
    ).stdout
    figures = json.loads((tmp_path / "figures.json").read_text())
    # Half the constant, and a quotient in place of the product: 0.25; but abs is never needed.
    assert (figures["load.made"], figures["load.killed"], figures["load.survived"]) == (3, 2, 1)
    assert "load/half.py:3 (removed)\n  - return 0.5 * abs(x)\n  + return 0.5 * (x)\n" in said
    assert {name: (tmp_path / "root" / name).read_text() for name in files} == files
