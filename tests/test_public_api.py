"""`drake_teleop` itself: light to import, complete, and honest about what it holds."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import drake_teleop


@pytest.mark.parametrize("name", drake_teleop.__all__)
def test_every_name_is_there(name):
    assert getattr(drake_teleop, name) is not None


def test_dir_is_the_curated_list():
    assert dir(drake_teleop) == sorted(drake_teleop.__all__)


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="'drake_teleop' has no attribute 'Frobnicate'"):
        drake_teleop.Frobnicate  # noqa: B018


def test_type_checkers_see_the_names_where_they_are_at_run_time():
    tree = ast.parse(Path(drake_teleop.__file__).read_text())
    (guarded,) = (node for node in tree.body if isinstance(node, ast.If))
    seen = {
        alias.name: statement.module.removeprefix("drake_teleop.")
        for statement in guarded.body
        for alias in statement.names
    }
    assert seen == drake_teleop._HOME
    eager = {"DrakeTeleopError", "__version__"}
    assert sorted(seen.keys() | eager) == sorted(drake_teleop.__all__)


@pytest.mark.parametrize(
    ("statement", "foreign"),
    [
        ("import drake_teleop", {"numpy", "numba", "polars", "matplotlib", "pydrake"}),
        ("from drake_teleop import identify, scaled_wrench, read_log", {"pydrake"}),
        # What a process of a study begins with; its work may need less than a station.
        ("import drake_teleop.lab.studies.runs", {"numba", "matplotlib", "pydrake"}),
    ],
)
def test_nobody_pays_for_what_they_do_not_use(statement, foreign):
    code = f"import sys\n{statement}\nprint(*{{name.split('.')[0] for name in sys.modules}})"
    answer = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert not foreign & set(answer.stdout.split())


def without_a_docstring(file: str, node: ast.Module | ast.ClassDef) -> list[str]:
    """Public classes, functions and methods; a setter has its property's."""
    found = []
    for each in node.body:
        if not isinstance(each, ast.FunctionDef | ast.ClassDef) or each.name.startswith("_"):
            continue
        if any(ast.unparse(line).endswith(".setter") for line in each.decorator_list):
            continue
        found += [] if ast.get_docstring(each) else [f"{file}: {each.name}"]
        if isinstance(each, ast.ClassDef):
            found += without_a_docstring(file, each)
    return found


def test_everything_public_says_what_it_is():
    files = sorted(Path(drake_teleop.__file__).parent.rglob("*.py"))
    assert len(files) > 300
    root = Path(drake_teleop.__file__).parent
    trees = {str(f.relative_to(root)): ast.parse(f.read_text(encoding="utf-8")) for f in files}
    assert [file for file, tree in trees.items() if not ast.get_docstring(tree)] == []
    missing = [without_a_docstring(file, tree) for file, tree in trees.items()]
    assert [names for names in missing if names] == []
