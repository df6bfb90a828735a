"""Pages of the site from outside of `docs`: notebooks, changelog, evidence.

They are copied before a build reads the sources. Links between them and `docs` are correct in the
repository; they are changed so that they are correct on the site too.
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
#: Pages of the site whose source is outside of `docs`.
PAGES = {
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "benchmarks/README.md": "benchmarks.md",
}
#: Beginnings of links in the repository, and on the site.
LINKS = {
    "](../docs/": "](../",
    "](docs/": "](",
    "](../notebooks/": "](notebooks/",
    "](../benchmarks/README.md": "](benchmarks.md",
}


def setup(app: Sphinx) -> dict[str, Any]:
    """Copy the files after the settings are read, before Sphinx looks for sources."""
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
    """Distribute notebooks among the pages: a process reads neighbouring pages in sequence."""
    notebooks = [page for page in pages if page.startswith("notebooks/")]
    others = [page for page in pages if page not in notebooks]
    apart = len(others) // max(len(notebooks), 1)
    for k, notebook in enumerate(notebooks):
        others.insert(k * (apart + 1), notebook)
    pages[:] = others


def _evidence() -> str:
    """Return the page of `benchmarks/evidence.py` about the stored records."""
    sys.path.insert(0, str(ROOT / "benchmarks"))
    try:
        return importlib.import_module("evidence").page()
    finally:
        sys.path.pop(0)


def _checked(path: Path) -> nbformat.NotebookNode:
    """Return the notebook with its checks in a last cell, which is executed and hidden."""
    notebook = nbformat.read(path, as_version=4)
    check = nbformat.v4.new_code_cell(
        CHECKS[path.stem], id="checks", metadata={"tags": ["remove-cell"]}
    )
    notebook.cells.append(check)
    return notebook


def _write(path: Path, text: str) -> None:
    """Write a file only if its content changes, so that a second build reuses the rest."""
    if not path.exists() or path.read_text(encoding="utf-8") != text:
        path.write_text(text, encoding="utf-8")


def _pages_link(_app: Sphinx, _name: str, source: list[str]) -> None:
    for there, here in LINKS.items():
        source[0] = source[0].replace(there, here)
