"""Directive `.. pydrake_system::` of docstrings: a block with its ports, as Drake draws it."""

from __future__ import annotations

from html import escape
from typing import Any

from docutils import nodes
from docutils.parsers.rst import Directive
from sphinx.application import Sphinx

PORTS = ("input_ports", "output_ports")


class PydrakeSystem(Directive):
    """Name, `input_ports:` and `output_ports:` of a system, one port per line: `- name: signal`."""

    has_content = True

    def run(self) -> list[nodes.Node]:
        """Return the drawn block, and the list of its ports with their signals."""
        name, ports = _read(list(self.content))
        left, right = (
            "".join(f"<span>{escape(port)}</span>" for port, _ in ports[kind]) for kind in PORTS
        )
        block = (
            f'<div class="system"><div class="ports">{left}</div><strong>{escape(name)}</strong>'
            f'<div class="ports output">{right}</div></div>'
        )
        rows = "".join(
            f"<tr><th>{escape(port)}</th><td>{kind[:-6]}</td><td>{escape(text)}</td></tr>"
            for kind in PORTS
            for port, text in ports[kind]
        )
        # A block that is wider than the page scrolls, also by keys.
        table = f'<table class="ports" tabindex="0"><tbody>{rows}</tbody></table>'
        return [nodes.raw("", block + table, format="html")]


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the directive."""
    app.add_directive("pydrake_system", PydrakeSystem)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def _read(lines: list[str]) -> tuple[str, dict[str, list[tuple[str, str]]]]:
    """Return the system's name and its ports, each with its signal.

    The text is not parsed as YAML, because descriptions of signals contain colons and brackets.
    """
    name, ports, kind = "", {kind: [] for kind in PORTS}, ""
    for line in filter(None, map(str.strip, lines)):
        key, _, value = line.partition(":")
        if key == "name":
            name = value.strip()
        elif key in ports:
            kind = key
        elif line.startswith("- "):
            ports[kind].append((key.removeprefix("- ").strip(), value.strip()))
        else:
            port, text = ports[kind][-1]
            ports[kind][-1] = (port, f"{text} {line}")
    return name, ports
