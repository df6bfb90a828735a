"""Self-contained HTML pages with a common style, and their Content-Security-Policy."""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jinja2

from drake_teleop.common.files import write_picture, write_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def render_page(package: str, template: str, **values: Any) -> str:
    """Return the page of a Jinja template in `package`, which may extend page.html.j2.

    The keyword arguments are the template's variables; HTML in them is escaped.
    """

    def read_template(name: str) -> str:
        owner = "drake_teleop.common" if name == "page.html.j2" else package
        return resources.files(owner).joinpath(name).read_text(encoding="utf-8")

    loader, undefined = jinja2.FunctionLoader(read_template), jinja2.StrictUndefined
    environment = jinja2.Environment(
        loader=loader, undefined=undefined, autoescape=True, trim_blocks=True, lstrip_blocks=True
    )
    return environment.get_template(template).render(**values)


def png_data_url(path: Path) -> str:
    return "data:image/png;base64," + base64.b64encode(path.read_bytes()).decode()


def write_report_page_and_pictures(
    out: Path, package: str, pictures: Mapping[str, Figure], **values: Any
) -> None:
    """Write NAME.png for each figure, and report.html from the package's report.html.j2."""
    from drake_teleop.common.style import PAGE_DPI

    for name, figure in pictures.items():
        write_picture(out / f"{name}.png", figure, dpi=PAGE_DPI)
    urls = {name: png_data_url(out / f"{name}.png") for name in pictures}
    write_text(out / "report.html", render_page(package, "report.html.j2", pictures=urls, **values))


_SCRIPT_ELEMENT_PATTERN = re.compile(r"<script[^>]*>(.*?)</script>", re.S)


def content_security_policy(page: str, host: str = "") -> str:
    """Return the Content-Security-Policy of a page; `host`: "address:port", or "" for a file."""
    scripts = (script.replace("\r\n", "\n") for script in _SCRIPT_ELEMENT_PATTERN.findall(page))
    digests = (hashlib.sha256(script.encode()).digest() for script in scripts if script)
    hashes = " ".join(f"'sha256-{base64.b64encode(digest).decode()}'" for digest in digests)
    own, stream = ("'self'", f"ws://{host}") if host else ("", "")
    return (
        f"default-src 'none'; script-src {own} {hashes}; connect-src {own} {stream} data: blob:; "
        "style-src 'unsafe-inline'; img-src data: blob:; base-uri 'none'; form-action 'none'"
    )
