"""Public names of `drake_teleop`: fast import, complete list, docstrings."""

from __future__ import annotations

import ast
import pkgutil
import re
import subprocess
import sys
from pathlib import Path

import pytest

import drake_teleop

pytestmark = pytest.mark.checks


@pytest.mark.parametrize("name", drake_teleop.__all__)
def test_every_name_is_there(name):
    assert getattr(drake_teleop, name) is not None


def test_names_with_their_module_in_the_docs_exist():
    root = Path(__file__).parents[1]
    pages = [root / "README.md", *root.glob("docs/*.md")]
    # A build of the site copies CHANGELOG.md, which has old names.
    texts = [page.read_text() for page in pages if page.name != "changelog.md"]
    names = set(re.findall(r"\bdrake_teleop(?:\.[A-Za-z_]\w*)+", "\n".join(texts)))
    assert len(names) > 40
    for name in names:
        pkgutil.resolve_name(name)


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
    assert seen == drake_teleop._MODULE_BY_NAME
    eager = {"DrakeTeleopError", "__version__"}
    assert sorted(seen.keys() | eager) == sorted(drake_teleop.__all__)


@pytest.mark.parametrize(
    ("statement", "foreign"),
    [
        ("import drake_teleop", {"numpy", "numba", "polars", "matplotlib", "pydrake"}),
        ("from drake_teleop import identify, scaled_wrench, read_log", {"pydrake"}),
        # Imports at the start of a study's process, which may need less than a station.
        ("import drake_teleop.lab.studies.runs", {"numba", "matplotlib", "pydrake"}),
    ],
)
def test_nobody_pays_for_what_they_do_not_use(statement, foreign):
    code = f"import sys\n{statement}\nprint(*{{name.split('.')[0] for name in sys.modules}})"
    answer = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert not foreign & set(answer.stdout.split())


def without_a_docstring(
    file: str, node: ast.Module | ast.ClassDef, inherited: frozenset[str] = frozenset()
) -> list[str]:
    """Return classes, and public names with their methods, that have no docstring (or a base's).

    The docstring of a property is that of its setter.
    """
    found = []
    for each in node.body:
        if not isinstance(each, ast.FunctionDef | ast.ClassDef) or each.name.startswith("_"):
            continue
        if any(ast.unparse(line).endswith(".setter") for line in each.decorator_list):
            continue
        is_class, in_class = isinstance(each, ast.ClassDef), isinstance(node, ast.ClassDef)
        required = is_class or in_class or each.name in drake_teleop.__all__
        documented = ast.get_docstring(each) or each.name in inherited
        found += [f"{file}: {each.name}"] if required and not documented else []
        if isinstance(each, ast.ClassDef) and each.name in drake_teleop.__all__:
            names = {name for base in each.bases for name in METHODS.get(ast.unparse(base), ())}
            found += without_a_docstring(file, each, frozenset(names))
    return found


ROOT = Path(drake_teleop.__file__).parent
TREES = {
    str(file.relative_to(ROOT)): ast.parse(file.read_text(encoding="utf-8"))
    for file in sorted(ROOT.rglob("*.py"))
}
METHODS = {
    each.name: {
        method.name
        for method in each.body
        if isinstance(method, ast.FunctionDef) and ast.get_docstring(method)
    }
    for tree in TREES.values()
    for each in tree.body
    if isinstance(each, ast.ClassDef)
}
"""Documented methods of each class."""


def test_modules_classes_and_public_names_have_docstrings():
    assert len(TREES) > 200
    assert [file for file, tree in TREES.items() if not ast.get_docstring(tree)] == []
    missing = [without_a_docstring(file, tree) for file, tree in TREES.items()]
    assert [names for names in missing if names] == []
