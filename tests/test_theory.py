"""docs/theory.md: every formula has a number, and every number an existing function."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

import pytest

pytestmark = pytest.mark.checks

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "docs" / "theory.md").read_text(encoding="utf-8")
METHOD, INDEX = TEXT.split("## Index")
ROWS = [
    [cell.strip() for cell in line.strip("|").split("|")]
    for line in INDEX.splitlines()
    if line.startswith("|")
][2:]
NUMBER = re.compile(r"\((T?\d+)\)")


@cache
def defined(path: Path) -> set[str]:
    """Return functions, classes and methods ("Class.method") of a module."""
    names = set()
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            names.add(node.name)
        if isinstance(node, ast.ClassDef):
            names |= {
                f"{node.name}.{inner.name}"
                for inner in node.body
                if isinstance(inner, ast.FunctionDef)
            }
    return names


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0])
def test_every_function_of_the_index_exists(row: list[str]) -> None:
    _, numbers, functions, file = row
    path = ROOT / file.strip("`")
    assert NUMBER.findall(numbers)
    names = re.findall("`([^`]+)`", functions)
    assert names
    assert [name for name in names if name not in defined(path)] == []


def test_every_formula_is_in_the_index_and_the_other_way_round() -> None:
    tags = set(re.findall(r"\\tag\{(T?\d+)\}", METHOD))
    written = tags | set(NUMBER.findall(METHOD)) - {"11"}  # The paper has no Eq. (11).
    indexed = {number for row in ROWS for number in NUMBER.findall(row[1])}
    assert written == indexed
    assert {str(i) for i in range(1, 15)} - {"11"} <= written
    assert {f"T{i}" for i in range(1, 20)} <= written
