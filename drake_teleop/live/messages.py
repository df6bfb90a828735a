"""What a page may say: one small JSON object, of which nothing is taken that is not expected."""

from __future__ import annotations

import json
import math
from typing import Any

from drake_teleop.live.scenes import SCENES

#: Bytes of a message; a longer one closes the connection.
LONGEST = 4096
#: Seconds for one simulated second.
SLOWEST = 20.0


def parse(text: Any) -> dict[str, Any] | None:
    """What a message asks for; None if it is not one.

    Returns:
        Any of "set" (a dict of numbers by input), "rates" (likewise, per simulated second),
        "pause" (bool), "slow" (1 to 20), "scene" (one of `SCENES`), "reset" and "drive" (True);
        nothing else is in it.
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
    """Whether it is a number of a size that means something; true and false are none."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    return abs(value) < 1e15 and math.isfinite(value)
