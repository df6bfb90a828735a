"""Links from "(T12)" and "Eq. (13)" to the formula, and from the index of formulas to the code.

Displayed formulas get their ids from `mathml`. A formula number in running text gives its paragraph
the id.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx

_THEORY = "theory"
_SOURCE = (Path(__file__).parents[1] / "theory.md").read_text(encoding="utf-8")
_DISPLAYED = set(re.findall(r"\\tag\{(\w+)\}", _SOURCE))
_NUMBERS = _DISPLAYED | set(re.findall(r"\((T\d+)\)", _SOURCE))
_SAID = re.compile(r"\(T\d+\)|(?<=Eq\. )\(\d+\)|Eqs?\.\s+\(\d+\)(?:(?:-|, | and )\(\d+\))*")
_NUMBER = re.compile(r"\((T?\d+)\)")


def links(text: str) -> list[tuple[str, str]]:
    """Split the text; return each piece with the id of the formula that it names, or ""."""
    pieces, last = [], 0
    for said in _SAID.finditer(text):
        for found in _NUMBER.finditer(text, *said.span()):
            if found[1] in _NUMBERS:
                pieces += [(text[last : found.start()], ""), (found[0], f"eq-{found[1].lower()}")]
                last = found.end()
    return [piece for piece in [*pieces, (text[last:], "")] if piece[0]]


def setup(app: Sphinx) -> dict[str, Any]:
    """Add ids and links to code when a page is read, links to formulas when it is written."""
    app.connect("doctree-read", _read)
    app.connect("doctree-resolved", _resolved)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def _read(app: Sphinx, doctree: nodes.document) -> None:
    if app.env.docname != _THEORY:
        return
    missing = _NUMBERS - _DISPLAYED
    for paragraph in doctree.findall(nodes.paragraph):
        for number in sorted(missing & set(_NUMBER.findall(paragraph.astext()))):
            paragraph["ids"].append(f"eq-{number.lower()}")
            missing.discard(number)
    for row in list(doctree.findall(nodes.row)):
        *_, names, file = row.children
        path = file.astext()
        if path.startswith("drake_teleop/") and path.endswith(".py"):
            for literal in list(names.findall(nodes.literal)):
                module = path.removesuffix(".py").replace("/", ".")
                _link_to_code(literal, f"{module}.{literal.astext()}")


def _link_to_code(literal: nodes.literal, target: str) -> None:
    """Link a name to the reference, which does not contain names with a leading underscore."""
    link = pending_xref(
        "", refdomain="py", reftype="obj", reftarget=target, refexplicit=True, refwarn=False
    )
    literal.replace_self(link)
    link += literal


def _resolved(app: Sphinx, doctree: nodes.document, page: str) -> None:
    theory = app.builder.get_relative_uri(page, _THEORY) if page != _THEORY else ""
    for text in list(doctree.findall(nodes.Text)):
        if isinstance(text.parent, nodes.paragraph | nodes.emphasis | nodes.entry):
            pieces = links(text.astext())
            if any(name for _, name in pieces):
                text.parent.replace(text, [_node(piece, name, theory) for piece, name in pieces])


def _node(text: str, name: str, theory: str) -> nodes.Node:
    if not name:
        return nodes.Text(text)
    return nodes.reference("", text, internal=True, refuri=f"{theory}#{name}")
