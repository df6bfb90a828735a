"""Commands and the example of the README run as written."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import polars as pl
import pytest

pytestmark = pytest.mark.checks

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.pictures
def test_the_python_example_runs(tmp_path, monkeypatch):
    (example,) = re.findall("```python\n(.*?)```", README, re.S)
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    exec(compile(example, "README.md", "exec"), names)
    contact = names["result"]["contact_wrench_S"]
    assert contact.shape == (len(names["result"].t), 6)
    assert len(pl.read_csv("log.csv")) == len(contact)
    assert Path("forces.png").stat().st_size > 10_000


def test_it_has_at_most_130_lines_and_begins_with_the_scene():
    lines = [line for line in README.splitlines() if not line.startswith("<!--")]
    assert len(lines) <= 130
    (first, *others) = [number for number, line in enumerate(lines) if line.startswith("![")]
    assert first < 10 and "scene.png" in lines[first]
    assert len(others) >= 5


def test_it_states_what_was_tested_on_real_hardware_near_the_top():
    top = " ".join(README.split("## First run")[0].split())
    assert "Tested so far" in top and "No command moves a real arm" in top


def test_every_link_into_the_repository_leads_somewhere():
    targets = re.findall(r"\]\((?!https?:)([^)]+)\)", README)
    titles = re.findall(r"^#+ (.+)$", README, re.M)
    anchors = {"#" + title.lower().replace(" ", "-").replace(",", "") for title in titles}
    assert len(anchors & set(targets)) == 3
    assert [x for x in targets if x not in anchors and not (ROOT / x).exists()] == []


def test_ci_runs_the_readmes_test_commands(tmp_path):
    # Copy of the two files in a folder in which all programs only print their names.
    (tmp_path / ".ci").mkdir()
    (tmp_path / ".ci" / "run").write_text((ROOT / ".ci" / "run").read_text())
    (tmp_path / "README.md").write_text(README)
    programs = tmp_path / ".venv-test" / "bin"
    fake = tmp_path / "fake"
    fake.mkdir()
    (fake / "python3").write_text(
        f"#!/bin/sh\necho python3 $*\nmkdir -p {programs}\n"
        "for name in pip pytest python sphinx-build; do\n"
        f"printf '#!/bin/sh\\necho '$name' $*\\n' > {programs}/$name\n"
        f"chmod +x {programs}/$name; done\n"
    )
    (fake / "python3").chmod(0o755)
    answer = subprocess.run(
        ["bash", ".ci/run"],
        cwd=tmp_path,
        env={"PATH": f"{fake}:/usr/bin:/bin"},
        capture_output=True,
        text=True,
        check=True,
    )
    (command,) = re.findall("<!-- the test command -->\n```sh\n(.*?)\n```", README, re.S)
    assert answer.stderr.startswith(command + "\n")  # bash prints the commands that it executes
    lines = answer.stdout.splitlines()
    assert [*lines[:-2], *sorted(lines[-2:])] == [  # fuzzer and site run in parallel
        "python3 -m venv --upgrade-deps .venv-test",
        "pip install -q --no-compile -e .[test,docs]",
        "pytest -n 2 --dist worksteal",
        "pytest -n 2 --dist worksteal -m checks or slow",
        "python benchmarks/fuzz.py --seconds 20 --seed 1",
        "sphinx-build -q -W --keep-going -j 2 docs out/site",
    ]
