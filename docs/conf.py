"""The documentation as a site: `sphinx-build -W docs out/site`, with the extra `docs`.

Notebooks and the gallery's scripts are run at every build, so that what is shown is what the code
does; any warning is an error. Nothing is loaded from elsewhere: the site can be read offline.
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
# Of the processes that run the gallery, too.
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (_EXT, os.environ.get("PYTHONPATH"))))
# They and the notebooks' kernels do not compile the libraries again, whatever the surroundings say.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
# One thread of BLAS in each of them: the matrices are small, and the cores have other work.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Pages are trees with links to and fro, among which to look for garbage takes long.
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

# What is run
nb_execution_mode = "force"
nb_execution_timeout = 600
nb_execution_raise_on_error = True
nb_execution_show_tb = True
nb_merge_streams = True
nb_ipywidgets_js = {}  # they come from elsewhere; of a slider the page shows where it stands
sphinx_gallery_conf = {
    "examples_dirs": ["gallery"],
    "gallery_dirs": ["examples"],
    "filename_pattern": r"/.*\.py$",
    "abort_on_example_error": True,
    "parallel": True,  # as many at once as sphinx-build's -j says
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
autosummary.WELL_KNOWN_ABBREVIATIONS += ("Eq.", "Eqs.", "Fig.", "Figs.")  # end no sentence
autosummary_generate = True
autodoc_default_options = {"members": True, "member-order": "bysource", "exclude-members": "set"}
autodoc_typehints = "signature"
toc_object_entries_show_parents = "hide"
autodoc_preserve_defaults = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
# Two classes may have one name; a bare name in an annotation then leads nowhere.
suppress_warnings = ["ref.python"]

# Looks
html_theme = "pydata_sphinx_theme"
html_title = "drake_teleop"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_sidebars = {"start": []}  # a page without others below it
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
    """|x| is an absolute value in docstrings, no substitution, and `Range`s is a word with an s.

    Why a file is long is for who works on it.
    """
    if what == "module":
        lines[:1] = [re.sub(r" \(long: [^)]*\)", "", line) for line in lines[:1]]
    for i, line in enumerate(lines):
        parts = line.split("`")
        parts[::2] = [part.replace("|", r"\|") for part in parts[::2]]
        parts[2::2] = ["\\ " * part[:1].isalpha() + part for part in parts[2::2]]
        lines[i] = "`".join(parts)


def setup(app) -> None:
    """What no extension does."""
    app.connect("autodoc-process-docstring", _as_rst)
