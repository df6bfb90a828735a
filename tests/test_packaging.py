"""The wheel contains all files and works in its own environment and folder."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from importlib.metadata import metadata
from pathlib import Path

import pytest
import yaml

import drake_teleop
from drake_teleop.common.errors import remedy_to_install_extra

pytestmark = pytest.mark.checks

ROOT = Path(__file__).parents[1]

USE = """
from importlib.resources import files
from pathlib import Path

import drake_teleop
from drake_teleop.common.errors import remedy_to_install_extra
from drake_teleop.common.files import models_dir, scenarios_dir

home = Path(drake_teleop.__file__).parent
assert home.parent.name == "site-packages", home
assert models_dir() == home / "models" and scenarios_dir() == home / "station" / "scenarios"
assert files("drake_teleop.lab.reproduction").joinpath("report.html.j2").is_file()
for name in drake_teleop.ScenarioNames():
    scenario = drake_teleop.LoadScenario(name)
    station = drake_teleop.MakeTeleopStation(scenario, load_estimate=[1.0] * 16)
    print(station.get_name(), name)
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    return built("wheel", ROOT, tmp_path_factory.mktemp("wheel"))


def built(target: str, source: Path, folder: Path) -> Path:
    run(sys.executable, "-m", "hatchling", "build", "-t", target, "-d", str(folder), cwd=source)
    (path,) = folder.iterdir()
    return path


def run(*command: str, cwd: Path) -> str:
    # Only installed packages may be found, not those of the shell's or the tests' environment.
    foreign = {"PYTHONPATH", "NUMBA_CACHE_DIR"}
    environment = {name: value for name, value in os.environ.items() if name not in foreign}
    answer = subprocess.run(
        command, cwd=cwd, env=environment, capture_output=True, text=True, check=False
    )
    assert answer.returncode == 0, answer.stdout + answer.stderr
    return answer.stdout


def test_the_wheel_holds_what_the_repository_holds_and_nothing_else(wheel):
    held = set(zipfile.ZipFile(wheel).namelist())
    python = {f"drake_teleop/{path}" for path in relative(ROOT / "drake_teleop")}
    models = {f"drake_teleop/models/{path}" for path in relative(ROOT / "models")}
    assert "drake_teleop/models/rx90.sdf" in models
    assert "drake_teleop/station/scenarios/free_motion_force.yaml" in python
    assert "drake_teleop/py.typed" in python
    assert {name for name in held if ".dist-info/" not in name} == python | models
    assert any(name.endswith(".dist-info/licenses/LICENSE") for name in held)


@pytest.mark.slow
def test_the_source_distribution_builds_the_same_wheel(wheel, tmp_path):
    source = built("sdist", ROOT, tmp_path / "sdist")
    # Without `filter`, which Python 3.11.2 lacks; this test made the archive.
    shutil.unpack_archive(source, tmp_path / "source")
    (unpacked,) = (tmp_path / "source").iterdir()
    again = zipfile.ZipFile(built("wheel", unpacked, tmp_path / "wheel"))
    ours = zipfile.ZipFile(wheel)
    assert again.namelist() == ours.namelist()
    assert all(again.read(name) == ours.read(name) for name in ours.namelist())
    assert (unpacked / "tests").is_dir() and (unpacked / "docs" / "conf.py").is_file()


def relative(folder: Path) -> set[str]:
    return {
        path.relative_to(folder).as_posix()
        for path in folder.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }


@pytest.mark.slow
def test_the_wheel_works_from_an_empty_folder(wheel, tmp_path):
    home = tmp_path / "environment"
    venv.create(home)
    scheme = {"base": str(home), "platbase": str(home)}
    scripts, library = (
        Path(sysconfig.get_path(kind, "posix_prefix", scheme)) for kind in ("scripts", "purelib")
    )
    python = str(scripts / Path(sys.executable).name)
    empty = tmp_path / "empty"
    empty.mkdir()
    pip = (sys.executable, "-m", "pip", "--python", python)
    run(*pip, "install", "--no-deps", "--no-index", "--no-compile", str(wheel), cwd=empty)
    # Code that was compiled from the same sources is reused from any folder.
    for compiled in (ROOT / "drake_teleop").rglob("*.nbc"):
        copy = library / compiled.relative_to(ROOT)
        copy.parent.mkdir(exist_ok=True)
        shutil.copy(compiled, copy)
    # The dependencies are those of this run. Its own drake_teleop comes later in the path, or is
    # absent.
    (library / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    listing = run(python, "-c", USE, cwd=empty).splitlines()
    assert "teleop_station free_motion_force" in listing
    assert "reproduce" in run(str(scripts / "drake-teleop"), "--help", cwd=empty)
    assert not list(empty.iterdir())


def test_the_version_that_is_released_is_the_one_that_is_cited():
    released = re.findall(r"^## \[(\d\S+)\] - (\S+)$", (ROOT / "CHANGELOG.md").read_text(), re.M)[0]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert released == (citation["version"], str(citation["date-released"]))
    assert drake_teleop.__version__.startswith(released[0])


def test_what_is_advised_installs_an_extra_that_there_is():
    """The recommended command installs an extra from the clone; no index has the project."""
    extras = set(metadata("drake_teleop").get_all("Provides-Extra"))
    texts = {
        path: path.read_text(encoding="utf-8")
        for folder, kind in (("drake_teleop", "py"), ("docs", "md"), ("notebooks", "ipynb"))
        for path in (ROOT / folder).rglob(f"*.{kind}")
    }
    assert not [path for path, text in texts.items() if re.search(r"install '?drake_teleop", text)]
    advised = {
        name
        for text in texts.values()
        for name in re.findall(
            r"remedy_to_install_extra\(\"(\w+)\"\)|install '\.\[([a-z]\w*)\]'", text
        )
        for name in name
        if name
    }
    assert {"notebook", "ros", "robots", "cluster"} <= advised <= extras
    assert remedy_to_install_extra("ros").endswith(
        "pip install '.[ros]' in the clone of this project"
    )
