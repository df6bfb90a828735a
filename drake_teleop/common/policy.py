"""Content-Security-Policy of pages: only their own scripts run, and nothing is loaded."""

from __future__ import annotations

import base64
import hashlib
import re

_SCRIPT = re.compile(r"<script[^>]*>(.*?)</script>", re.S)


def policy(page: str, host: str = "") -> str:
    """Return the policy of an HTML page.

    Args:
        page: with its scripts.
        host: "address:port" of its server, for its files and its WebSocket; "" if it is a file.
    """
    scripts = (script.replace("\r\n", "\n") for script in _SCRIPT.findall(page))
    digests = (hashlib.sha256(script.encode()).digest() for script in scripts if script)
    hashes = " ".join(f"'sha256-{base64.b64encode(digest).decode()}'" for digest in digests)
    own, stream = ("'self'", f"ws://{host}") if host else ("", "")
    return (
        f"default-src 'none'; script-src {own} {hashes}; connect-src {own} {stream} data: blob:; "
        "style-src 'unsafe-inline'; img-src data: blob:; base-uri 'none'; form-action 'none'"
    )
