"""Messages of an experiment's page, a subset of those of a drive."""

from __future__ import annotations

import json
from typing import Any

from drake_teleop.live.messages import parse

#: Inputs of a drive that move the hand.
HAND = ("x", "y", "z", "rx", "ry", "rz", "clutch")


def parse_study(text: Any) -> dict[str, Any] | None:
    """Return the valid requests of a message; None without any.

    Returns:
        Any of "set" and "rates" (numbers of `HAND`), "drive", "go" (True), "answer" (1 or 2).
    """
    said = parse(text) or {}
    found: dict[str, Any] = {}
    for kind in said.keys() & {"set", "rates"}:
        found[kind] = {name: value for name, value in said[kind].items() if name in HAND}
    if "drive" in said:
        found["drive"] = True
    try:
        whole = json.loads(text) if isinstance(text, str) and len(text) < 100 else None
    except (ValueError, RecursionError):
        whole = None
    if isinstance(whole, dict):
        if whole.get("go") is True:
            found["go"] = True
        answer = whole.get("answer")
        if isinstance(answer, int) and not isinstance(answer, bool) and answer in (1, 2):
            found["answer"] = answer
    return found or None
