"""Content-Security-Policy of pages: only their own scripts run, and nothing is loaded."""

from __future__ import annotations

import base64
import hashlib

import numpy as np
import pytest

from drake_teleop.common.html import content_security_policy, render_page
from drake_teleop.station.replay_file import ReplayFile

CODE = "const a = 1;\nlet b = 'é';"


def hashed(script: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}'"


@pytest.mark.parametrize("tag", ["<script>", '<script type="text/javascript">', "<script id=a>"])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_policy_contains_the_hashes_of_the_scripts(tag, end):
    """Browsers hash scripts with line feeds only."""
    page = f"<body>{tag}{CODE}</script><p>{tag}other()</script>".replace("\n", end)
    parts = dict(part.split(" ", 1) for part in content_security_policy(page).split("; "))
    assert parts["script-src"].split() == [hashed(CODE), hashed("other()")]
    assert parts["default-src"] == parts["base-uri"] == parts["form-action"] == "'none'"


def test_policy_allows_connections_only_to_the_given_server():
    served = dict(
        part.split(" ", 1) for part in content_security_policy("", "127.0.0.1:80").split("; ")
    )
    assert served["connect-src"].split() == ["'self'", "ws://127.0.0.1:80", "data:", "blob:"]
    assert served["script-src"].split() == ["'self'"]
    assert "http" not in content_security_policy(
        "<script>x</script>"
    ) and "'self'" not in content_security_policy("")


@pytest.mark.slow
def test_replays_and_reports_have_a_policy(tmp_path):
    film = ReplayFile("x", np.arange(2.0), 1.0)
    film.write(tmp_path / "x.html", lambda meshcat: lambda time, frame: None)
    page = (tmp_path / "x.html").read_text(encoding="utf-8")
    head, _, rest = page.partition("<title>")
    assert (
        content_security_policy(page) in head
        and "<script" not in head
        and rest.count("<script") >= 3
    )
    report = render_page("drake_teleop.common", "page.html.j2")
    assert "default-src 'none'" in report.partition("<title>")[0]
