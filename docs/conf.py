"""Configuration of the site: `sphinx-build -W docs out/site`, with the extra `docs`.

Every build executes the notebooks and the gallery's scripts. Any warning is an error. Pages load
nothing from other servers.
"""

from __future__ import annotations

import gc
import os
import re
import sys
from importlib import metadata
from pathlib import Path

from sphinx.ext import autosummary

_EXT = str(Path(__file__).parent / "_ext")
sys.path.insert(0, _EXT)
# Also for the processes that run the gallery.
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (_EXT, os.environ.get("PYTHONPATH"))))
# These processes and the notebooks' kernels share the byte code of the libraries.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
# One BLAS thread in each process: the matrices are small, and the other cores are in use.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Pages are trees with cyclic references; searching them for garbage takes long.
gc.set_threshold(20_000, 20, 50)

project = "drake_teleop"
author = "The drake_teleop authors"
copyright = author
version = release = metadata.version("drake_teleop")

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_gallery.gen_gallery",
    "myst_nb",
    "mathml",
    "formulas",
    "keywords",
    "kernel_page",
    "known_names",
    "pydrake_system",
    "repository",
    "offline",
]
exclude_patterns = [
    "gallery",
    "examples/*.json",
    "examples/*.ipynb",
    "examples/*.py*",
    "examples/*.zip",
]
default_role = "literal"
templates_path = ["_templates"]

# Markdown
myst_enable_extensions = ["dollarmath", "amsmath", "colon_fence", "deflist"]
myst_heading_anchors = 4

# Execution
nb_execution_mode = "force"
nb_execution_timeout = 600
nb_execution_raise_on_error = True
nb_execution_show_tb = True
nb_merge_streams = True
nb_ipywidgets_js = {}  # loaded from other servers; a slider of the page shows its position
sphinx_gallery_conf = {
    "examples_dirs": ["gallery"],
    "gallery_dirs": ["examples"],
    "filename_pattern": r"/.*\.py$",
    "abort_on_example_error": True,
    "parallel": True,  # number of processes from sphinx-build's -j
    "download_all_examples": False,
    "show_memory": False,
    "min_reported_time": 1e9,
    "write_computation_times": False,
    "matplotlib_animations": False,
    "capture_repr": (),
    "reset_modules": ("matplotlib", "gallery_style.set_style"),
    "image_scrapers": ("gallery_style.picture",),
    "within_subsection_order": "gallery_style.Order",
}

# The reference
viewcode_follow_imported_members = False
autosummary.WELL_KNOWN_ABBREVIATIONS += ("Eq.", "Eqs.", "Fig.", "Figs.")  # do not end a sentence
autosummary_generate = True
autodoc_default_options = {"members": True, "member-order": "bysource", "exclude-members": "set"}
autodoc_typehints = "signature"
toc_object_entries_show_parents = "hide"
autodoc_preserve_defaults = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
# Two classes may have one name; a bare name in an annotation then has no link.
suppress_warnings = ["ref.python"]

# Appearance
html_theme = "pydata_sphinx_theme"
html_title = "drake_teleop"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_sidebars = {"start": []}  # page without subpages
html_show_sourcelink = False
html_copy_source = False
html_theme_options = {
    "show_prev_next": False,
    "navigation_with_keys": False,
    "footer_start": ["copyright"],
    "footer_end": [],
    "secondary_sidebar_items": ["page-toc"],
}


def _as_rst(_app, what, _name, _object, _options, lines: list[str]) -> None:
    """Escape |x|, an absolute value in docstrings, and separate the s of `Range`s from its code.

    Remove the reason for the length of a file.
    """
    if what == "module":
        lines[:1] = [re.sub(r" \(long: [^)]*\)", "", line) for line in lines[:1]]
    for i, line in enumerate(lines):
        parts = line.split("`")
        parts[::2] = [part.replace("|", r"\|") for part in parts[::2]]
        parts[2::2] = ["\\ " * part[:1].isalpha() + part for part in parts[2::2]]
        lines[i] = "`".join(parts)


def setup(app) -> None:
    """Connect the functions of this file."""
    app.connect("autodoc-process-docstring", _as_rst)
