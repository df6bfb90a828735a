"""Check that the pages load nothing from other servers, so that the site works offline."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx
from sphinx.errors import SphinxError

_LOADED = re.compile(
    r"""<(?:script|img|iframe|source)[^>]*\ssrc=["']?(?:https?:)?//[^"'\s>]+"""
    r"""|<link(?=[^>]*\srel=["']?(?:stylesheet|preload|icon|modulepreload))[^>]*\shref=["']?(?:https?:)?//[^"'\s>]+"""
    r"""|@import\s[^;]*//[^;]+|url\(["']?(?:https?:)?//[^)]+"""
)


def loaded_from_elsewhere(text: str) -> list[str]:
    """Return the addresses on other servers that a page or style sheet loads, without its links."""
    return [found[0] for found in _LOADED.finditer(text)]


def setup(app: Sphinx) -> dict[str, Any]:
    """Check all written files at the end of a build."""
    app.connect("build-finished", _check)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def _check(app: Sphinx, exception: Exception | None) -> None:
    if exception is not None or app.builder.format != "html":
        return
    for pattern in ("*.html", "*.css"):
        for path in Path(app.outdir).rglob(pattern):
            for found in loaded_from_elsewhere(path.read_text(encoding="utf-8")):
                raise SphinxError(f"{path.relative_to(app.outdir)} is not for offline: {found}")
