"""Structure of the package: dependencies point from upper to lower layers, files have one idea.

A package is a folder; each module directly in `station` or `lab` counts as a package of its own.
Imports count wherever they are in a file, except those for type checkers only.
"""

from __future__ import annotations

import ast
import subprocess
from collections import Counter
from functools import cache
from pathlib import Path

import pytest

pytestmark = pytest.mark.checks

PACKAGE = Path(__file__).parents[1] / "drake_teleop"
LAYERS = ("cli", "live", "lab", "station", "robots", "logs", "load", "common")
"""Layers from top to bottom; a module imports only from its own layer and from lower ones."""
WITHOUT_DRAKE = ("common", "load", "logs", "robots", "station.passivity")
SOLVER = ("load.batch.consistent", "pydrake.solvers")
"""The only exception: a convex solver, imported when a program is solved."""
LARGEST_SHARE = 0.15
LONGEST_FILE = 450
REASON = "(long: "
"""Mark in the first line of a long file, before the reason for its length."""

TOP = {
    *(".ci", ".github", ".gitignore", "CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md", "LICENSE"),
    *("README.md", "pyproject.toml"),
    *("benchmarks", "docs", "drake_teleop", "models", "notebooks", "tests"),
}

Sources = dict[str, str]
"""Text of each module by its name below the package, such as "load.batch.methods"."""
Arrows = dict[str, set[str]]


def sources(package: Path) -> Sources:
    files = {
        ".".join(p.relative_to(package).with_suffix("").parts): p for p in package.rglob("*.py")
    }
    return {name: path.read_text(encoding="utf-8") for name, path in files.items()}


@cache
def imported(text: str) -> tuple[str, ...]:
    """Return the imports of a module's text, with the imported names."""
    return tuple(imports(ast.parse(text)))


def imports(node: ast.AST) -> list[str]:
    found: list[str] = []
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING":
            continue
        if isinstance(child, ast.Import):
            found += [alias.name for alias in child.names]
        elif isinstance(child, ast.ImportFrom):
            found += [f"{child.module}.{alias.name}" for alias in child.names]
        found += imports(child)
    return found


def between_files(modules: Sources) -> Arrows:
    """Return for each module its imports from the package, and "pydrake" if it imports Drake."""
    arrows: Arrows = {}
    for name, text in modules.items():
        arrows[name] = set()
        for full in imported(text):
            package, _, rest = full.partition(".")
            if package == "pydrake" and (name, full.rpartition(".")[0]) != SOLVER:
                arrows[name].add(package)
            if package == "drake_teleop":
                # The name is a module, or a name in a module.
                arrows[name] |= {rest, rest.rpartition(".")[0]} & modules.keys()
    return arrows


def package_of(name: str) -> str:
    parent = name.rpartition(".")[0]
    return name if parent in ("", "station", "lab") else parent


def upward(modules: Sources) -> list[str]:
    """Return the imports of a higher layer, as "module -> imported module"."""
    rank = {layer: i for i, layer in enumerate(LAYERS)}
    return sorted(
        f"{name} -> {target}"
        for name, targets in between_files(modules).items()
        for target in targets - {"pydrake", "__init__"}
        if name != "__init__" and rank[target.split(".")[0]] < rank[name.split(".")[0]]
    )


def between_packages(modules: Sources) -> Arrows:
    arrows: Arrows = {}
    for name, targets in between_files(modules).items():
        arrows.setdefault(package_of(name), set()).update(map(package_of, targets))
    return {name: targets - {name} for name, targets in arrows.items()}


def reached(arrows: Arrows, start: str) -> set[str]:
    """Return all modules that are reached from `start` by one import or more."""
    found: set[str] = set()
    ahead = [*arrows[start]]
    while ahead:
        name = ahead.pop()
        if name not in found:
            found.add(name)
            ahead += arrows.get(name, ())
    return found


def in_circles(arrows: Arrows) -> list[str]:
    return sorted(name for name in arrows if name in reached(arrows, name))


def packages_with_drake(modules: Sources) -> list[str]:
    """Return packages that import Drake, directly or indirectly, although they must not."""
    arrows = between_packages(modules)
    plain = [name for name in arrows if name.startswith(WITHOUT_DRAKE)]
    return sorted(name for name in plain if "pydrake" in reached(arrows, name))


def large_packages(modules: Sources) -> list[str]:
    lines: Counter[str] = Counter()
    for name, text in modules.items():
        lines[package_of(name)] += len(text.splitlines())
    return sorted(name for name, n in lines.items() if n > LARGEST_SHARE * lines.total())


def long_files(modules: Sources) -> list[str]:
    """Return the files above `LONGEST_FILE` lines without a reason in their first line."""
    long = {n: text for n, text in modules.items() if len(text.splitlines()) > LONGEST_FILE}
    return sorted(name for name, text in long.items() if REASON not in text.splitlines()[0])


@pytest.fixture(scope="module")
def modules() -> Sources:
    return sources(PACKAGE)


def test_no_import_circle_of_files_or_packages(modules: Sources) -> None:
    assert in_circles(between_files(modules)) == []
    assert in_circles(between_packages(modules)) == []


def test_lower_layers_and_passivity_do_not_import_drake(modules: Sources) -> None:
    assert packages_with_drake(modules) == []


def test_no_package_is_too_large(modules: Sources) -> None:
    assert large_packages(modules) == []


def test_the_repository_has_no_stray_files() -> None:
    tracked = subprocess.run(
        ["git", "ls-files", "-z"], cwd=PACKAGE.parent, capture_output=True, text=True
    )
    top = {name.split("/")[0] for name in tracked.stdout.split("\0") if name}
    assert top <= TOP, "a stray file was committed (in no clone, git names none)"


def test_imports_point_to_the_same_or_a_lower_layer(modules: Sources) -> None:
    assert upward(modules) == []


def test_the_package_has_nine_entries() -> None:
    names = {path.name for path in PACKAGE.iterdir()} - {"__pycache__", "py.typed"}
    assert names == {*LAYERS, "__init__.py"}


def test_an_import_of_a_higher_layer_is_found(modules: Sources) -> None:
    name = "robots.compensator"
    wrong = modules | {name: f"{modules[name]}\nimport drake_teleop.station.signals\n"}
    assert upward(wrong) == ["robots.compensator -> station.signals"]


def test_long_files_say_why(modules: Sources) -> None:
    assert long_files(modules) == []


@pytest.mark.parametrize(
    "statement",
    [
        "from drake_teleop.lab.analysis.analyze import analyze",
        "from drake_teleop.lab.analysis import analyze",
        "import drake_teleop.lab.analysis.analyze",
        "def lazily():\n    from drake_teleop.lab.run import run_scenario",
    ],
)
def test_an_import_circle_is_found(modules: Sources, statement: str) -> None:
    """Analysis and run import the station, which imports the slave."""
    wrong = modules | {"station.slave.plant": f"{modules['station.slave.plant']}\n{statement}\n"}
    assert "station.slave" in in_circles(between_packages(wrong))
    assert "station.slave.plant" in in_circles(between_files(wrong))


def test_imports_for_type_checkers_do_not_count(modules: Sources) -> None:
    statement = "if TYPE_CHECKING:\n    from drake_teleop.station.station import MakeTeleopStation"
    same = modules | {"station.slave.plant": f"{modules['station.slave.plant']}\n{statement}\n"}
    assert in_circles(between_packages(same)) == []


@pytest.mark.parametrize(
    "name", ["load.inertia", "load.online.change", "logs.causal", "station.passivity.wave"]
)
@pytest.mark.parametrize(
    "statement",
    [
        "import pydrake.math",
        "from pydrake.math import RigidTransform",
        "def lazily():\n    from drake_teleop.station.slave.arm import ArmModel",
        "from drake_teleop.station.simulation import simulate",
    ],
)
def test_drake_in_a_lower_layer_is_found(modules: Sources, name: str, statement: str) -> None:
    wrong = modules | {name: f"{modules[name]}\n{statement}\n"}
    assert package_of(name) in packages_with_drake(wrong)


def test_a_package_that_is_too_large_is_found(modules: Sources) -> None:
    lines = sum(len(text.splitlines()) for text in modules.values())
    assert large_packages(modules | {"common.more": "\n" * (lines // 4)}) == ["common"]


def test_a_long_file_without_a_reason_is_found(modules: Sources) -> None:
    long = "\n" * (LONGEST_FILE + 1)
    wrong = modules | {
        "common.more": f'"""All."""{long}',
        "common.other": f'"""All (long: why)."""{long}',
    }
    assert set(long_files(wrong)) - set(long_files(modules)) == {"common.more"}
