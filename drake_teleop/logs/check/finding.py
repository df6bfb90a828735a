"""Something suspicious in a log, and what to change in its description."""

from __future__ import annotations

from dataclasses import dataclass

EFFECTS = ("lag", "units", "frame", "payload")
"""Findings that may be the effect of a cause, such as drift."""
OF_MOTION = (
    *("clock", "reversed gravity", "inverted orientation", "quaternion order", "degrees"),
    "base axes",
)
"""Errors of the described motion, which resemble causes."""
CLOCK = 0.05
"""Larger disagreements of clocks are no lag of a filter, but of the clocks [s]."""


@dataclass(frozen=True)
class Finding:
    """Something suspicious in a log.

    Args:
        name: what it is, in one word for programs: "sign", "units" ...
        message: what was seen and what to change.
    """

    name: str
    message: str
