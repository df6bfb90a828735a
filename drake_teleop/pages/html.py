"""Reports: self-contained HTML pages of one look, with their pictures inside."""

from __future__ import annotations

import base64
import io
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2
from matplotlib.figure import Figure


def render(package: str, template: str, **values: Any) -> str:
    """The page that a template makes of values.

    Args:
        package: where the template is, such as "drake_teleop.logs".
        template: its file name; it may extend page.html.j2, which has the house's style.
        values: what the template asks for; anything missing is an error, and text is escaped.
    """

    def source(name: str) -> str:
        home = "drake_teleop.pages" if name == "page.html.j2" else package
        return resources.files(home).joinpath(name).read_text(encoding="utf-8")

    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(source),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(**values)


def embedded(figure: Figure) -> str:
    """The figure as a PNG in a data: URL."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=160)
    return _data(buffer.getvalue())


def embedded_png(path: Path) -> str:
    """A PNG file in a data: URL."""
    return _data(path.read_bytes())


def _data(png: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(png).decode()
