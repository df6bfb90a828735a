"""Intended motion of the operator at many times, for the tests."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_teleop.station.operator.operator import (
    MinimumJerk,
    Sine,
    intended_motion_into,
    pack_intent,
)


def intent_at(
    segments: Sequence[MinimumJerk | Sine], start: NDArray[np.float64], t: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the intended motion at the times t (n,) [s].

    Args:
        segments: the intent, relative to the start pose.
        start: (7,) X_BE before the first segment.

    Returns:
        (n, 7) poses X_BE and (n, 6) twists [v; omega] of E in B.
    """
    times = np.atleast_1d(np.asarray(t, dtype=float))
    packed = pack_intent(segments)
    poses, twists = np.empty((len(times), 7)), np.empty((len(times), 6))
    for time, pose, twist in zip(times, poses, twists, strict=True):
        intended_motion_into(packed, start, time, pose, twist)
    return poses, twists
