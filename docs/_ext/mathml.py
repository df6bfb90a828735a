"""Formulas as MathML, which browsers draw without a script or font."""

from __future__ import annotations

import re
from typing import Any

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx

_TAG = re.compile(r"\\tag\{([^}]*)\}")
_MATRIX = re.compile(r"<mo>&#x0005B;</mo><mtable>(.*?)</mtable><mo>&#x0005D;</mo>")


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the renderer of formulas."""
    app.add_html_math_renderer("mathml", (_inline, None), (_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def _inline(translator: Any, node: nodes.math) -> None:
    translator.body.append(f'<span class="math">{_mathml(node.astext())}</span>')
    raise nodes.SkipNode


def _block(translator: Any, node: nodes.math_block) -> None:
    """Write a displayed formula; its tag becomes the number at the right."""
    text = node.astext()
    tag = _TAG.search(text)
    formula = _mathml(_TAG.sub("", text).strip(), display="block")
    number = f'<span class="eqno">({tag[1]})</span>' if tag else ""
    anchor = f' id="eq-{tag[1].lower()}"' if tag else ""
    translator.body.append(f'<div class="math" tabindex="0"{anchor}>{formula}{number}</div>')
    raise nodes.SkipNode


def _mathml(formula: str, **options: str) -> str:
    """Convert a formula; the style sheet draws matrix brackets, as some fonts lack tall ones."""
    return _MATRIX.sub(r'<mtable class="matrix">\1</mtable>', convert(formula, **options))
