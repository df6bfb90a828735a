"""Location of a contact from its wrench."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from drake_teleop.common.arrays import Array, checked
from drake_teleop.common.errors import DrakeTeleopError


def wrench_axis(wrench: ArrayLike) -> tuple[Array, Array, Array]:
    """Return direction (..., 3), nearest point (..., 3) [m] and pitch (...) [m] of a wrench's axis.

    Poinsot's central axis of (..., 6) in S; the point is nearest to So. NaN where f = 0.
    """
    w = checked("wrench", wrench, 6, leading=True)
    f, tau = w[..., :3], w[..., 3:]
    square = np.sum(f * f, axis=-1)
    square = np.where(square > 0.0, square, np.nan)
    direction = f / np.sqrt(square)[..., None]
    return direction, np.cross(f, tau) / square[..., None], np.sum(f * tau, axis=-1) / square


def point_on_tool(wrench: ArrayLike, origin: ArrayLike, axis: ArrayLike) -> tuple[Array, Array]:
    """Return where on the tool's axis a pure force explains a wrench best, and the moment left.

    Args:
        wrench: (..., 6) about So in S [N, N m].
        origin: (3,) a point of the tool's axis in S [m].
        axis: (3,) its direction in S, of any length.

    Returns:
        Distance (...) from `origin` [m], NaN for a force along the axis; rest (...) [N m].

    Raises:
        DrakeTeleopError: for an axis of length 0.
    """
    w = checked("wrench", wrench, 6, leading=True)
    q, u = checked("origin", origin, 3), checked("axis", axis, 3)
    if not u.any():
        raise DrakeTeleopError("has no length", where="axis")
    f = w[..., :3]
    moment = w[..., 3:] - np.cross(q, f)
    lever = np.cross(u / np.linalg.norm(u), f)
    square = np.sum(lever * lever, axis=-1)
    known = square > 1e-12 * np.sum(f * f, axis=-1)
    x = np.where(known, np.sum(lever * moment, axis=-1) / np.where(known, square, 1.0), np.nan)
    rest = moment - np.where(known, x, 0.0)[..., None] * lever
    return x, np.linalg.norm(rest, axis=-1)
