"""What a contact's wrench says about where the contact is."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from drake_teleop.common.arrays import Array, checked
from drake_teleop.common.errors import DrakeTeleopError


def wrench_axis(wrench: ArrayLike) -> tuple[Array, Array, Array]:
    """The central axis of a wrench: f along it, and a moment parallel to f (Poinsot).

    With the contact wrench of Eq. (13), which is what the sensor exerts beyond the load's motion,
    the environment pushes the tool with -f along the same line.

    Args:
        wrench: (..., 6) about So in S [N, N m].

    Returns:
        direction: (..., 3) f / |f|; NaN where f = 0, as for the others;
        point: (..., 3) of the axis nearest to So [m];
        pitch: (...) f . tau / |f|^2 [m]: the couple in the contact or in the load's error.
    """
    w = checked("wrench", wrench, 6, leading=True)
    f, tau = w[..., :3], w[..., 3:]
    square = np.sum(f * f, axis=-1)
    square = np.where(square > 0.0, square, np.nan)
    direction = f / np.sqrt(square)[..., None]
    return direction, np.cross(f, tau) / square[..., None], np.sum(f * tau, axis=-1) / square


def point_on_tool(wrench: ArrayLike, origin: ArrayLike, axis: ArrayLike) -> tuple[Array, Array]:
    """Where along the tool a pure force must act to explain a wrench best.

    Least squares of the moments: the x in tau = (origin + x u) x f + rest with the least |rest|.

    Args:
        wrench: (..., 6) about So in S [N, N m].
        origin: (3,) a point of the tool's axis in S [m].
        axis: (3,) its direction u in S, of any length.

    Returns:
        x: (...) distance from `origin` along the axis [m]; NaN for a force along the axis;
        rest: (...) |moment| that no point of the axis explains [N m].

    Raises:
        DrakeTeleopError: for other shapes, numbers that are not finite, or an axis of length 0.
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
