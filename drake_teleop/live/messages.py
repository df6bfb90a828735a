"""Messages of a page: one small JSON object."""

from __future__ import annotations

import json
import math
from typing import Any

from drake_teleop.live.scenes import SCENES

#: Largest message [bytes]; a longer one closes the connection.
LONGEST = 4096
#: Largest clock time per simulated time.
SLOWEST = 20.0


def parse(text: Any) -> dict[str, Any] | None:
    """Return the valid requests of a message; None without any.

    Returns:
        Any of "set" and "rates" (numbers by input), "pause" (bool), "slow" (1 to 20), "scene" (of
        `SCENES`), "reset" and "drive" (True).
    """
    if not isinstance(text, str) or len(text) > LONGEST:
        return None
    try:
        said = json.loads(text)
    except (ValueError, RecursionError):
        return None
    if not isinstance(said, dict):
        return None
    found: dict[str, Any] = {}
    for kind in ("set", "rates"):
        values = said.get(kind)
        if isinstance(values, dict):
            found[kind] = {name: value for name, value in values.items() if _is_number(value)}
    if isinstance(said.get("pause"), bool):
        found["pause"] = said["pause"]
    if _is_number(said.get("slow")):
        found["slow"] = min(max(float(said["slow"]), 1.0), SLOWEST)
    if isinstance(said.get("scene"), str) and said["scene"] in SCENES:
        found["scene"] = said["scene"]
    found |= {name: True for name in ("reset", "drive") if said.get(name) is True}
    return found or None


def _is_number(value: Any) -> bool:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    return abs(value) < 1e15 and math.isfinite(value)
