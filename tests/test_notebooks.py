"""Notebooks as committed; the build of the site executes them and checks their statements."""

from __future__ import annotations

import runpy
from pathlib import Path

import nbformat
import pytest

pytestmark = pytest.mark.checks

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
CHECKS = runpy.run_path(str(ROOT / "docs" / "_ext" / "notebook_checks.py"))["CHECKS"]


def test_every_notebook_is_checked():
    assert {path.stem for path in NOTEBOOKS} == CHECKS.keys()
    assert all("assert " in check for check in CHECKS.values())


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_it_is_committed_without_outputs(path):
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert all(not cell.outputs and cell.execution_count is None for cell in code)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_it_is_a_page_of_the_site(path):
    assert f"notebooks/{path.stem}\n" in (ROOT / "docs" / "tutorials.md").read_text(
        encoding="utf-8"
    )


def test_the_blocks_in_a_diagram_take_at_most_60_lines():
    notebook = nbformat.read(ROOT / "notebooks" / "07_your_diagram.ipynb", as_version=4)
    code = "\n".join(cell.source for cell in notebook.cells if cell.cell_type == "code")
    assert len([line for line in code.splitlines() if line.strip()]) <= 60
