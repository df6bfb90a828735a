"""Runs the notebooks and writes them with their pictures as pages into docs/notebooks.

The notebooks are committed without outputs, so that a change of one can be read; these pages are
for who wants to see the pictures without running anything. Needs the extra `docs`:

    python docs/render_notebooks.py [NAME ...]
"""

from __future__ import annotations

import io
import re
import shutil
import sys
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbconvert import MarkdownExporter
from nbformat import NotebookNode
from PIL import Image

NOTEBOOKS = Path(__file__).parents[1] / "notebooks"
PAGES = Path(__file__).parent / "notebooks"
#: What the kernel does first: pictures small enough to be committed.
_SMALL = "%config InlineBackend.print_figure_kwargs = {'dpi': 72, 'bbox_inches': 'tight'}"


def main() -> None:
    names = sys.argv[1:] or sorted(path.stem for path in NOTEBOOKS.glob("*.ipynb"))
    for name in names:
        print(name, flush=True)
        render(name)


def render(name: str) -> None:
    """Writes docs/notebooks/NAME.md and its pictures, in a folder of the same name."""
    notebook = executed(NOTEBOOKS / f"{name}.ipynb")
    text, resources = MarkdownExporter().from_notebook_node(
        notebook, resources={"output_files_dir": name, "unique_key": name}
    )
    pictures = PAGES / name
    shutil.rmtree(pictures, ignore_errors=True)
    pictures.mkdir(parents=True)
    for path, content in resources["outputs"].items():
        (PAGES / path).write_bytes(_fewer_colours(content) if path.endswith("png") else content)
    about = f"*[{name}.ipynb](../../notebooks/{name}.ipynb) as it runs.*\n\n"
    # Links of the notebook start in its own folder, those of the page two folders further down.
    text = text.replace("](../docs/", "](../").replace("](../README", "](../../README")
    text = "\n".join(line.rstrip() for line in f"{about}{text}".splitlines())
    text = re.sub("<style>.*?</style>\n", "", text, flags=re.S)
    text = re.sub("\n{4,}", "\n\n", text).strip()
    (PAGES / f"{name}.md").write_text(text + "\n", encoding="utf-8")


def executed(path: Path) -> NotebookNode:
    """The notebook with its outputs."""
    notebook = nbformat.read(path, as_version=4)
    notebook.cells.insert(0, nbformat.v4.new_code_cell(_SMALL))
    place = {"metadata": {"path": str(path.parent)}}
    NotebookClient(notebook, timeout=900, resources=place).execute()
    del notebook.cells[0]
    # A slider or a bar means nothing on a page.
    widget = "application/vnd.jupyter.widget-view+json"
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.outputs = [shown for shown in cell.outputs if widget not in shown.get("data", {})]
    return notebook


def _fewer_colours(png: bytes) -> bytes:
    """The picture with 128 colours, a third of its size."""
    smaller = io.BytesIO()
    Image.open(io.BytesIO(png)).convert("RGB").quantize(128).save(smaller, "png", optimize=True)
    return smaller.getvalue()


if __name__ == "__main__":
    main()
