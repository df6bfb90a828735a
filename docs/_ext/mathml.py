"""Formulas as MathML, which every browser draws: no script, no font, nothing to load."""

from __future__ import annotations

import re
from typing import Any

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx

_TAG = re.compile(r"\\tag\{([^}]*)\}")


def setup(app: Sphinx) -> dict[str, Any]:
    """Makes it the renderer of formulas."""
    app.add_html_math_renderer("mathml", (_inline, None), (_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def _inline(translator: Any, node: nodes.math) -> None:
    translator.body.append(f'<span class="math">{convert(node.astext())}</span>')
    raise nodes.SkipNode


def _block(translator: Any, node: nodes.math_block) -> None:
    """A formula of its own, with its number at the right if it has a tag."""
    text = node.astext()
    tag = _TAG.search(text)
    formula = convert(_TAG.sub("", text).strip(), display="block")
    number = f'<span class="eqno">({tag[1]})</span>' if tag else ""
    anchor = f' id="eq-{tag[1].lower()}"' if tag else ""
    translator.body.append(f'<div class="math"{anchor}>{formula}{number}</div>')
    raise nodes.SkipNode
