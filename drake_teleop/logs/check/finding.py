"""Suspicious property of a log."""

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
"""Larger delays are errors of a clock, not the lag of a filter [s]."""


@dataclass(frozen=True)
class Finding:
    """Suspicious property of a log.

    Args:
        name: category for programs: "sign", "units" ...
        message: observation and remedy.
    """

    name: str
    message: str
