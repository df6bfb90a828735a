"""Content-Security-Policy of pages: they run only their own scripts, and load nothing."""

from __future__ import annotations

import base64
import hashlib
import re

_SCRIPT = re.compile(r"<script[^>]*>(.*?)</script>", re.S)


def policy(page: str, host: str = "") -> str:
    """Return the policy of a page; `host` is its server's "address:port", "" for a file."""
    scripts = (script.replace("\r\n", "\n") for script in _SCRIPT.findall(page))
    digests = (hashlib.sha256(script.encode()).digest() for script in scripts if script)
    hashes = " ".join(f"'sha256-{base64.b64encode(digest).decode()}'" for digest in digests)
    own, stream = ("'self'", f"ws://{host}") if host else ("", "")
    return (
        f"default-src 'none'; script-src {own} {hashes}; connect-src {own} {stream} data: blob:; "
        "style-src 'unsafe-inline'; img-src data: blob:; base-uri 'none'; form-action 'none'"
    )
