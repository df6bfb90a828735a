"""What lies beside `docs` in the repository comes into the site: notebooks, changes, evidence.

They are copied before a build reads anything, and links between them and `docs` are made to fit:
written so as to be right in the repository, they are right on the site as well.
"""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Any

import nbformat
from notebook_checks import CHECKS
from sphinx.application import Sphinx
from sphinx.config import Config
from sphinx.environment import BuildEnvironment

DOCS = Path(__file__).parents[1]
ROOT = DOCS.parent
#: Pages of the site whose source is elsewhere.
PAGES = {
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "benchmarks/README.md": "benchmarks.md",
}
#: What links begin with in the repository, and on the site.
LINKS = {
    "](../docs/": "](../",
    "](docs/": "](",
    "](../notebooks/": "](notebooks/",
    "](../benchmarks/README.md": "](benchmarks.md",
}


def setup(app: Sphinx) -> dict[str, Any]:
    """Copies as soon as the settings are read, before Sphinx looks for sources."""
    app.connect("config-inited", _copy)
    app.connect("env-before-read-docs", _spread)
    app.connect("source-read", _pages_link)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def _copy(_app: Sphinx, _config: Config) -> None:
    (DOCS / "notebooks").mkdir(exist_ok=True)
    for path in (ROOT / "notebooks").glob("*.ipynb"):
        _write(DOCS / "notebooks" / path.name, nbformat.writes(_checked(path)))
    for source, page in PAGES.items():
        text = (ROOT / source).read_text(encoding="utf-8")
        _write(DOCS / page, text.replace("](../docs/", "](").replace("](docs/", "]("))
    _write(DOCS / "evidence.md", _evidence())


def _spread(_app: Sphinx, _env: BuildEnvironment, pages: list[str]) -> None:
    """Notebooks stand far from each other: a process reads, and runs, neighbours one by one."""
    notebooks = [page for page in pages if page.startswith("notebooks/")]
    others = [page for page in pages if page not in notebooks]
    apart = len(others) // max(len(notebooks), 1)
    for k, notebook in enumerate(notebooks):
        others.insert(k * (apart + 1), notebook)
    pages[:] = others


def _evidence() -> str:
    """What `benchmarks/evidence.py` says of the records that are kept."""
    sys.path.insert(0, str(ROOT / "benchmarks"))
    try:
        return importlib.import_module("evidence").page()
    finally:
        sys.path.pop(0)


def _checked(path: Path) -> nbformat.NotebookNode:
    """With its checks as a last cell that is run, and not shown."""
    notebook = nbformat.read(path, as_version=4)
    check = nbformat.v4.new_code_cell(
        CHECKS[path.stem], id="checks", metadata={"tags": ["remove-cell"]}
    )
    notebook.cells.append(check)
    return notebook


def _write(path: Path, text: str) -> None:
    """Only what is new, so that a second build finds the rest unchanged."""
    if not path.exists() or path.read_text(encoding="utf-8") != text:
        path.write_text(text, encoding="utf-8")


def _pages_link(_app: Sphinx, _name: str, source: list[str]) -> None:
    for there, here in LINKS.items():
        source[0] = source[0].replace(there, here)
