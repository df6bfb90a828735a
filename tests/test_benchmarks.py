"""Benchmarks: the README lists existing scripts, and their baselines are correct."""

from __future__ import annotations

import ast
import dataclasses
import importlib.metadata
import importlib.util
import inspect
import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

pytestmark = pytest.mark.checks

FOLDER = Path(__file__).parents[1] / "benchmarks"
README = (FOLDER / "README.md").read_text(encoding="utf-8")
SCRIPTS = [*sorted(FOLDER.glob("*.py")), *sorted((FOLDER.parent / "docs/gallery").glob("*.py"))]


@pytest.fixture(scope="module")
def identification() -> ModuleType:
    spec = importlib.util.spec_from_file_location("bench", FOLDER / "identification.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["bench"] = module
    spec.loader.exec_module(module)
    return module


def test_the_readme_has_a_section_for_scripts_that_exist() -> None:
    scripts = re.findall(r"^## (\w+\.py)\n\n.+\?$", README, re.M)
    assert {"identification.py", "station.py", "utias.py"} <= set(scripts)
    assert [name for name in scripts if not (FOLDER / name).is_file()] == []


def named_objects(tree: ast.Module) -> dict[str, Any]:
    """Return what a script imports from the package, by its name in the script."""
    found: dict[str, Any] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("drake_teleop"):
            module = importlib.import_module(node.module or "")
            for alias in node.names:
                if not hasattr(module, alias.name):
                    importlib.import_module(f"{node.module}.{alias.name}")
                found[alias.asname or alias.name] = getattr(module, alias.name)
    return found


def accepts_keyword(function: Any, keyword: str) -> bool:
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        return True
    any_keyword = inspect.Parameter.VAR_KEYWORD
    return any(p.name == keyword or p.kind == any_keyword for p in parameters)


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.stem)
def test_calls_of_the_package_have_keywords_that_exist(path):
    """Imports, attributes of modules, and keywords of calls and of `partial`."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    objects = named_objects(tree)
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            module = objects.get(node.value.id)
            if isinstance(module, ModuleType):
                assert hasattr(module, node.attr), ast.unparse(node)
        if isinstance(node, ast.Call):
            called = ast.unparse(node.args[0] if ast.unparse(node.func) == "partial" else node.func)
            first, _, rest = called.partition(".")
            function = objects.get(first)
            if isinstance(function, ModuleType) and rest.isidentifier():
                function = getattr(function, rest)
            elif rest:
                continue
            if callable(function):
                given = [keyword.arg for keyword in node.keywords if keyword.arg]
                wrong = [name for name in given if not accepts_keyword(function, name)]
                assert not wrong, f"{called}: {wrong}"


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
    """Return the lines that mutations make of `NUMERIC`, by kind of mutation."""
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
    # Tests kill half the constant and a quotient for the product; removing abs changes no result.
    assert (figures["load.made"], figures["load.killed"], figures["load.survived"]) == (3, 2, 1)
    assert "load/half.py:3 (removed)\n  - return 0.5 * abs(x)\n  + return 0.5 * (x)\n" in said
    assert {name: (tmp_path / "root" / name).read_text() for name in files} == files


# arms.py

ARM_SDF = """<sdf version="1.7"><model name="arm"><link name="base"/>
<link name="a"><pose>0 0 0.4 0 0 0.5</pose>
<inertial><mass>3</mass><inertia><ixx>1</ixx><iyy>1</iyy><izz>1</izz></inertia></inertial></link>
<link name="b"><pose>0.1 0 0.9 0.3 0 0</pose>
<inertial><mass>2</mass><inertia><ixx>1</ixx><iyy>1</iyy><izz>1</izz></inertia></inertial></link>
<link name="tool"><pose>0.1 0 1.2 0 0 0</pose>
<inertial><mass>0.5</mass><inertia><ixx>1</ixx><iyy>1</iyy><izz>1</izz></inertia></inertial></link>
<joint name="turn" type="revolute"><parent>base</parent><child>a</child><axis><xyz>0 0.6 0.8</xyz>
<limit><lower>-2</lower><upper>1</upper><effort>30</effort></limit></axis></joint>
<joint name="slide" type="prismatic"><pose>0 0 0.1 0 0.7 0</pose><parent>a</parent>
<child>b</child><axis><xyz>1 0 0</xyz>
<limit><lower>0</lower><upper>0.3</upper><effort>80</effort></limit></axis></joint>
<joint name="weld" type="fixed"><parent>b</parent><child>tool</child></joint>
</model></sdf>"""
ARM_MJCF = """<mujoco model="arm"><worldbody><body name="a" pos="0 0 0.3"><freejoint/>
<geom size="0.1" mass="4"/><body name="b" pos="0 0 0.2" euler="90 0 0">
<joint name="turn" axis="0 0 1" ref="30" range="-90 60" actuatorfrcrange="-40 40"/>
<geom size="0.1" mass="2"/><site name="ft" pos="0 0 0.1" euler="0 90 0"/>
<body name="c" pos="0.5 0 0"><joint name="slide" type="slide" axis="1 0 0"/>
<geom size="0.1" mass="1"/><body name="d" pos="0.2 0 0"><geom size="0.1" mass="0.25"/></body></body>
</body></body></worldbody><actuator>
<position joint="turn" ctrlrange="-3.14 3.14" forcerange="-5 5" gear="10" kp="9"/>
<motor joint="slide" ctrlrange="-2 2" gear="50"/></actuator></mujoco>"""


@pytest.fixture(scope="module")
def arms() -> ModuleType:
    spec = importlib.util.spec_from_file_location("arms", FOLDER / "arms.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["arms"] = module
    spec.loader.exec_module(module)
    return module


def arm_file(arms: ModuleType, folder: Path) -> Any:
    path = folder / "arm.sdf"
    path.write_text(ARM_SDF, encoding="utf-8")
    return arms.ArmFile("package", "arm.sdf", path, "b")


def test_the_matrix_has_72_files_and_a_pattern_selects(arms: ModuleType, tmp_path: Path) -> None:
    files = arms.matrix(tmp_path)
    assert len(files) == len(set(files)) == 72
    (chosen,) = arms.matrix(tmp_path, "rtb-data/*puma*")
    assert (chosen.package, chosen.frame) == ("rtb-data", "link7")
    assert chosen.path.is_relative_to(tmp_path / "rtb_data")


def test_an_arm_that_is_read_right_differs_in_nothing(arms: ModuleType, tmp_path: Path) -> None:
    file = arm_file(arms, tmp_path)
    reference = arms.read_reference(file.path, "b")
    assert [joint.name for joint in reference.joints] == ["turn", "slide"]
    assert (reference.mass_beyond, reference.mass_moved) == (0.5, 5.5)
    figures = arms.compare(arms._read_package(file)[0], reference, "arm.sdf")
    assert figures["differs"] == []
    assert figures["position_m"] < 1e-12
    assert abs(figures["mass_moved_kg"]) < 1e-12


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"effort_limit": [30.0, 8.0]}, "effort of slide: 8, file: 80"),
        ({"upper": [1.1, 0.3]}, "upper of turn: 1.1, file: 1"),
        ({"lower": [-2.0, -1.0]}, "lower of slide: -1, file: 0"),
        ({"table": (1, 9, 2e-6)}, "position_m"),  # the slide's origin
        ({"table": (2, 12, 0.1)}, "mass_beyond_kg 0.1"),
        ({"joint_names": ("slide", "turn")}, "rotation_rad"),
        ({"joint_names": ("turn", "other")}, "joints ['turn', 'other'], own SDF:"),
        ({"table": (0, 9, 0.5)}, ""),  # other position of the base
    ],
)
def test_planted_differences_are_found(
    arms: ModuleType, tmp_path: Path, change: dict[str, Any], text: str
) -> None:
    file = arm_file(arms, tmp_path)
    arm, reference = arms._read_package(file)[0], arms.read_reference(file.path, "b")
    for name, value in change.items():
        if name == "table":
            row, column, added = value
            arm.table[row, column] += added
        else:
            changed = value if name == "joint_names" else np.array(value)
            arm = dataclasses.replace(arm, **{name: changed})
    differs = arms.compare(arm, reference, "arm.sdf")["differs"]
    assert text in "; ".join(differs)
    assert bool(differs) == bool(text)


def test_mujoco_gives_sites_and_torque_limits(arms: ModuleType, tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    path = tmp_path / "arm.xml"
    path.write_text(ARM_MJCF, encoding="utf-8")
    at_site, at_body = (arms.read_reference(path, frame) for frame in ("ft", "c"))
    assert [joint.effort for joint in at_body.joints] == [40.0, 100.0]
    assert at_body.joints[0].upper == pytest.approx(np.pi / 3)
    assert [at_site.mass_beyond, at_body.mass_beyond] == [0.0, 0.25]
    assert (at_site.mass_moved, len(at_site.joints)) == (3.25, 1)
    # At q = ref the body is in its drawn pose; the site is 0.1 m along the body's z, which is -y_W.
    X = at_site.pose(np.array([np.pi / 6]))
    np.testing.assert_allclose(X[:3, 3], [0, -0.1, 0.5], atol=1e-12)
    np.testing.assert_allclose(X[:3, 0], [0, 1, 0], atol=1e-12)


def write_boxes(path: Path, top: str, joint: str) -> Path:
    """Write an arm with three joints along or about x, at one point, and boxes on its links."""
    inertial = (
        '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
        "</inertial>"
    )
    sizes = ("0.1 0.1 0.1", "0.1 0.1 0.1", "0.01 0.01 0.01", top)
    links = "".join(
        f'<link name="l{k}">{inertial}<collision><origin xyz="{0.5 * (k == 0)} 0 0"/><geometry>'
        f'<box size="{size}"/></geometry></collision></link>'
        for k, size in enumerate(sizes)
    )
    limit = f'<axis xyz="1 0 0"/><limit {joint} velocity="1" effort="900"/>'
    kind = "revolute" if "-3" in joint else "prismatic"
    joints = "".join(
        f'<joint name="j{k}" type="{kind}"><parent link="l{k - 1}"/><child link="l{k}"/>'
        f'<origin xyz="0.02 0 0"/>{limit}</joint>'
        for k in (1, 2, 3)
    )
    path.write_text(f'<robot name="r">{links}{joints}</robot>', encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("top", "joint", "assumed", "found"),
    [
        # Link 3 is around link 1 in all postures.
        ("0.3 0.3 0.3", 'lower="-3" upper="3"', "", True),
        ("0.3 0.3 0.3", 'lower="-3" upper="3"', "overlaps left out: l3 and l1", False),
        ("0.3 0.3 0.3", 'lower="-3" upper="3"', "overlaps left out: l3 and l2", True),
        ("0.1 0.1 0.1", 'lower="-2" upper="2"', "", False),  # a telescope
    ],
)
def test_overlaps_at_the_start_count_unless_stated_and_by_design(
    arms: ModuleType, tmp_path: Path, top: str, joint: str, assumed: str, found: bool
) -> None:
    scenario = tmp_path / "a.yaml"
    write_boxes(tmp_path / "arm.urdf", top, joint)
    scenario.write_text(
        "slave: {model: arm.urdf, sensor_frame: l3, home: [0.1, 0.1, 0.1], tool: {mass: 1}}"
    )
    figures = arms.start_figures(arms.LoadScenario(scenario), [assumed])
    assert bool([text for text in figures["overlaps"] if "l1 and l3" in text]) == found


def test_a_pair_that_overlaps_in_few_postures_counts_although_it_is_stated(
    arms: ModuleType, tmp_path: Path
) -> None:
    path = write_boxes(tmp_path / "arm.urdf", "0.1 0.1 0.1", 'lower="-3" upper="3"')
    # Link 3 is 0.2 m beside the axis and overlaps link 1, which is too, near equal angles only.
    text = path.read_text(encoding="utf-8").replace(
        '<origin xyz="0.0 0 0"/>', '<origin xyz="0 0.2 0"/>'
    )
    path.write_text(text, encoding="utf-8")
    scenario = tmp_path / "a.yaml"
    scenario.write_text(
        "slave: {model: arm.urdf, sensor_frame: l3, home: [0.1, 0.1, 0.1], tool: {mass: 1}}"
    )
    figures = arms.start_figures(arms.LoadScenario(scenario), ["overlaps left out: l1 and l3"])
    assert [text for text in figures["overlaps"] if "l1 and l3" in text]


@pytest.mark.parametrize(("ending", "text"), [("exit", "exit 3"), ("sleep", "longer than")])
def test_a_process_that_dies_or_hangs_is_a_row(
    arms: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ending: str, text: str
) -> None:
    end = {"exit": lambda *_: os._exit(3), "sleep": lambda *_: time.sleep(60)}[ending]
    monkeypatch.setattr(arms, "_check", end)
    monkeypatch.setitem(arms.TIME_LIMITS, "read", 1.5)
    (row,) = arms.measure([arm_file(arms, tmp_path)], ["read"], jobs=2)
    assert row["read"]["joints"] == ["turn", "slide"]
    assert text in row["check"]["error"]
    page = arms.page_text([row | {"plan": {"error": "link a|b_c: <none>"}}])
    assert "<summary>no start found</summary>link a&#124;b&#95;c: &lt;none&gt;</details> |" in page


@pytest.mark.slow
def test_six_published_arms_are_read_and_planned(arms: ModuleType, tmp_path: Path) -> None:
    robots = importlib.metadata.distribution("example-robot-data").locate_file("")
    (tmp_path / "example_robot_data").symlink_to(str(robots))
    names = ("baxter", "panda", "romeo", "tiago_no_hand", "ur5_robot", "ur10_joint_limited_robot")
    files = [arms.matrix(tmp_path, f"example-robot-data/*/{name}.urdf")[0] for name in names]
    rows = arms.measure(files, ["read", "plan"], jobs=2)
    assert [len(row["read"]["joints"]) for row in rows] == [7, 7, 8, 8, 6, 6]
    assert [row["plan"].get("error") for row in rows] == 6 * [None]
    if importlib.util.find_spec("yourdfpy") is not None:
        assert [row["check"]["differs"] for row in rows] == 6 * [[]]
