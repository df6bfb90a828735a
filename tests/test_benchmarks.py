"""The benchmarks' README names scripts that exist; what they compare with is what they measure."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

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
