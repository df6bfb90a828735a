"""`.. pydrake_system::` in docstrings: a block with its ports, drawn as Drake's own pages do."""

from __future__ import annotations

from html import escape
from typing import Any

from docutils import nodes
from docutils.parsers.rst import Directive
from sphinx.application import Sphinx

PORTS = ("input_ports", "output_ports")


class PydrakeSystem(Directive):
    """A name, `input_ports:` and `output_ports:`, one port in a line: `- name: what it is`."""

    has_content = True

    def run(self) -> list[nodes.Node]:
        """The block, and below it what each port carries."""
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
        # Where it is wider than the page it scrolls, by keys too.
        table = f'<table class="ports" tabindex="0"><tbody>{rows}</tbody></table>'
        return [nodes.raw("", block + table, format="html")]


def setup(app: Sphinx) -> dict[str, Any]:
    """Registers the directive."""
    app.add_directive("pydrake_system", PydrakeSystem)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def _read(lines: list[str]) -> tuple[str, dict[str, list[tuple[str, str]]]]:
    """The system's name and its ports, each with what it carries.

    No YAML, though it looks like it: what a port carries is said in words, colons and brackets.
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
