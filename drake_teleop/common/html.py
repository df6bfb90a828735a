"""Reports: self-contained HTML pages of one look, with their pictures inside."""

from __future__ import annotations

import base64
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2


def render(package: str, template: str, **values: Any) -> str:
    """The page that a template makes of values.

    Args:
        package: where the template is, such as "drake_teleop.logs".
        template: its file name; it may extend page.html.j2, which has the house's style.
        values: what the template asks for; anything missing is an error, and text is escaped.
    """

    def source(name: str) -> str:
        home = "drake_teleop.common" if name == "page.html.j2" else package
        return resources.files(home).joinpath(name).read_text(encoding="utf-8")

    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(source),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(**values)


def embedded(path: Path) -> str:
    """A PNG file in a data: URL."""
    return "data:image/png;base64," + base64.b64encode(path.read_bytes()).decode()
