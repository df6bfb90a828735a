"""The notebooks run from top to bottom, and show what they promise."""

from __future__ import annotations

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOKS = Path(__file__).parents[1] / "notebooks"

#: What must hold once a notebook has run, in its own variables.
CHECKS = {
    "01_quickstart": """
assert abs(load.mass - 3.13) < 0.01
assert np.abs(felt(1.0)[:, 2]).max() > 85
assert np.abs(felt(0.0)[:, 2]).max() < 5
np.testing.assert_allclose(felt(0.5), (felt(0.0) + felt(1.0)) / 2, atol=1e-9)
drawn, original = [], draw
def draw(sigma):
    drawn.append(sigma)
    return original(sigma)
feel.widget.children[0].value = 0.25
assert drawn == [0.25]
"""
}


def test_every_notebook_is_checked():
    assert {path.stem for path in NOTEBOOKS.glob("*.ipynb")} == CHECKS.keys()


@pytest.mark.parametrize("name", CHECKS)
def test_it_runs_and_shows_what_it_promises(name):
    notebook = nbformat.read(NOTEBOOKS / f"{name}.ipynb", as_version=4)
    notebook.cells.append(nbformat.v4.new_code_cell(CHECKS[name]))
    client = NotebookClient(notebook, timeout=120, resources={"metadata": {"path": str(NOTEBOOKS)}})
    client.execute()


@pytest.mark.parametrize("name", CHECKS)
def test_it_is_committed_without_outputs(name):
    notebook = nbformat.read(NOTEBOOKS / f"{name}.ipynb", as_version=4)
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert all(not cell.outputs and cell.execution_count is None for cell in code)
