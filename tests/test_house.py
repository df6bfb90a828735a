"""The house: arrows between rooms point one way, no room is large, no file without a reason.

A room is a folder; a folder within it is a room of its own, and so is each module beside the rooms.
Imports count wherever they stand, but for those that only type checkers follow.
"""

from __future__ import annotations

import ast
import subprocess
from collections import Counter
from functools import cache
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "drake_teleop"
WITHOUT_DRAKE = ("load", "logs", "passivity")
SOLVER = ("load.batch.consistent", "pydrake.solvers")
"""The one exception: a convex solver, imported when a program is solved."""
LARGEST_ROOM = 0.15
LONGEST_FILE = 450
REASON = "(long: "
"""In the first line of a longer file, before why it is one file nevertheless."""

TOP = {
    *(".ci", ".github", ".gitignore", "CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md", "LICENSE"),
    *("README.md", "pyproject.toml"),
    *("benchmarks", "docs", "drake_teleop", "models", "notebooks", "tests"),
}

Sources = dict[str, str]
"""Text of each module, by its name below the package, such as "load.batch.methods"."""
Arrows = dict[str, set[str]]


def sources(package: Path) -> Sources:
    files = {
        ".".join(p.relative_to(package).with_suffix("").parts): p for p in package.rglob("*.py")
    }
    return {name: path.read_text(encoding="utf-8") for name, path in files.items()}


@cache
def imported(text: str) -> tuple[str, ...]:
    """What a module's text imports, with the names that are taken from it."""
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


def between_files(house: Sources) -> Arrows:
    """Of each module, those of the package that it imports, and "pydrake" if it does."""
    arrows: Arrows = {}
    for name, text in house.items():
        arrows[name] = set()
        for full in imported(text):
            package, _, rest = full.partition(".")
            if package == "pydrake" and (name, full.rpartition(".")[0]) != SOLVER:
                arrows[name].add(package)
            if package == "drake_teleop":
                # Either a module, or a name in one.
                arrows[name] |= {rest, rest.rpartition(".")[0]} & house.keys()
    return arrows


def room(name: str) -> str:
    return name.rpartition(".")[0] or name


def between_rooms(house: Sources) -> Arrows:
    arrows: Arrows = {}
    for name, targets in between_files(house).items():
        arrows.setdefault(room(name), set()).update(map(room, targets))
    return {name: targets - {name} for name, targets in arrows.items()}


def reached(arrows: Arrows, start: str) -> set[str]:
    """All that can be reached from somewhere by one arrow or more."""
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


def rooms_with_drake(house: Sources) -> list[str]:
    """Rooms that should be without Drake and import it, or a room that does."""
    arrows = between_rooms(house)
    plain = [name for name in arrows if name.split(".")[0] in WITHOUT_DRAKE]
    return sorted(name for name in plain if "pydrake" in reached(arrows, name))


def large_rooms(house: Sources) -> list[str]:
    lines: Counter[str] = Counter()
    for name, text in house.items():
        lines[room(name)] += len(text.splitlines())
    return sorted(name for name, n in lines.items() if n > LARGEST_ROOM * lines.total())


def long_files(house: Sources) -> list[str]:
    """Files that are too long, and do not say in their first line why they are one file."""
    long = {n: text for n, text in house.items() if len(text.splitlines()) > LONGEST_FILE}
    return sorted(name for name, text in long.items() if REASON not in text.splitlines()[0])


@pytest.fixture(scope="module")
def house() -> Sources:
    return sources(PACKAGE)


def test_no_circle_of_files_or_rooms(house: Sources) -> None:
    assert in_circles(between_files(house)) == []
    assert in_circles(between_rooms(house)) == []


def test_load_logs_and_passivity_do_without_drake(house: Sources) -> None:
    assert rooms_with_drake(house) == []


def test_no_room_is_too_large(house: Sources) -> None:
    assert large_rooms(house) == []


def test_the_top_folder_holds_what_it_should() -> None:
    tracked = subprocess.run(
        ["git", "ls-files", "-z"], cwd=PACKAGE.parent, capture_output=True, text=True
    )
    top = {name.split("/")[0] for name in tracked.stdout.split("\0") if name}
    assert top <= TOP, "a stray file was committed (in no clone, git names none)"


def test_long_files_say_why(house: Sources) -> None:
    assert long_files(house) == []


@pytest.mark.parametrize(
    "statement",
    [
        "from drake_teleop.analysis.analyze import analyze",
        "from drake_teleop.analysis import analyze",
        "import drake_teleop.analysis.analyze",
        "def lazily():\n    from drake_teleop.run import run_scenario",
    ],
)
def test_an_arrow_that_points_up_is_found(house: Sources, statement: str) -> None:
    """What the slave would import: analysis and run import the station, which imports it."""
    wrong = house | {"slave.plant": f"{house['slave.plant']}\n{statement}\n"}
    assert "slave" in in_circles(between_rooms(wrong))
    assert "slave.plant" in in_circles(between_files(wrong))


def test_an_arrow_for_type_checkers_is_none(house: Sources) -> None:
    statement = "if TYPE_CHECKING:\n    from drake_teleop.station import MakeTeleopStation"
    same = house | {"slave.plant": f"{house['slave.plant']}\n{statement}\n"}
    assert in_circles(between_rooms(same)) == []


@pytest.mark.parametrize(
    "name", ["load.inertia", "load.online.change", "logs.causal", "passivity.wave"]
)
@pytest.mark.parametrize(
    "statement",
    [
        "import pydrake.math",
        "from pydrake.math import RigidTransform",
        "def lazily():\n    from drake_teleop.slave.arm import ArmModel",
        "from drake_teleop.simulation import simulate",
    ],
)
def test_drake_where_it_should_not_be_is_found(house: Sources, name: str, statement: str) -> None:
    wrong = house | {name: f"{house[name]}\n{statement}\n"}
    assert room(name) in rooms_with_drake(wrong)


def test_a_room_that_has_grown_is_found(house: Sources) -> None:
    lines = sum(len(text.splitlines()) for text in house.values())
    assert large_rooms(house | {"pages.more": "\n" * (lines // 4)}) == ["pages"]


def test_a_long_file_without_a_reason_is_found(house: Sources) -> None:
    long = "\n" * (LONGEST_FILE + 1)
    wrong = house | {
        "pages.more": f'"""All."""{long}',
        "pages.other": f'"""All (long: why)."""{long}',
    }
    assert set(long_files(wrong)) - set(long_files(house)) == {"pages.more"}
