"""Number and variety of poses at rest."""

from __future__ import annotations

import numpy as np

from drake_teleop.logs.check.finding import Finding
from drake_teleop.logs.read.canonical import Log

ENOUGH = 6
"""Fewest poses that allow a check of the fit."""
SPREAD = 0.15
"""Smallest deviation of gravity's direction that separates offsets from a load."""


def rest_finding(log: Log) -> Finding | None:
    """Return a finding for too few or too similar poses at rest."""
    if not log.static:
        return None
    if len(log) < ENOUGH:
        return Finding(
            "static poses",
            f"{len(log)} poses at rest leave hardly anything to check the fit by; record 12, turned"
            " about two horizontal axes",
        )
    up = log.specific_force / np.linalg.norm(log.specific_force, axis=1, keepdims=True)
    least = float(np.linalg.svd(up - up.mean(axis=0), compute_uv=False)[-1]) / np.sqrt(len(up))
    if least >= SPREAD:
        return None
    angle = float(np.degrees(np.arcsin(least)))
    return Finding(
        "static poses",
        f"the poses are too alike: along one direction gravity in S deviates by {angle:.2g} deg"
        " only, so that offsets and load look alike there; add poses that are turned by 45 deg and"
        " more, about two horizontal axes",
    )
