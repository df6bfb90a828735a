"""Check of an externally commanded intent."""

from __future__ import annotations

import math

from drake_teleop.common.compiled import njit


@njit(cache=True)
def unit_pose_into(pose, twist, out):
    """Write a pose (7,) with unit quaternion; return whether all inputs are valid and finite.

    Args:
        pose: (7,) X_BE.
        twist: (6,) of it.
        out: (7,) output.
    """
    square, rest = 0.0, 0.0
    for k in range(4):
        square += pose[k] * pose[k]
    for k in range(7):
        rest += pose[k] - pose[k]  # NaN unless it is finite
    for k in range(6):
        rest += twist[k] - twist[k]
    if not (rest == 0.0 and 0.0 < square < math.inf):
        return False
    size = math.sqrt(square)
    for k in range(7):
        out[k] = pose[k] / size if k < 4 else pose[k]
    return True
