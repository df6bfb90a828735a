"""Closed forms of the stiffness, mass and round trip at which hand and device remain stable."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from drake_teleop.lab.analysis.delayed_loop import checked_held, checked_positive, joined_windows
from drake_teleop.lab.analysis.polynomials import Array


def contact_delay_margin(
    mass: ArrayLike, damping: ArrayLike, stiffness: ArrayLike, felt_stiffness: ArrayLike
) -> Array:
    """Return the largest round trip [s] of m s^2 + b s + k + K e^(-s RTT) (T41)."""
    m, b, k = checked_held(mass, damping, stiffness)
    K = checked_positive(felt_stiffness, "felt stiffness of the wall")
    middle = (2 * m * k - b**2) / (2 * m**2)
    root = middle**2 - (k**2 - K**2) / m**2
    with np.errstate(invalid="ignore", divide="ignore"):
        w = np.sqrt(middle + np.sqrt(root))
        return np.where(w > 0, np.arctan2(b * w, m * w**2 - k) / w, np.inf)


def delay_independent_stiffness(mass: ArrayLike, damping: ArrayLike, stiffness: ArrayLike) -> Array:
    """Return the felt stiffness K [N/m] below which contact is always stable."""
    m, b, k = checked_held(mass, damping, stiffness)
    resonant = b**2 < 2 * k * m
    return np.where(resonant, b * np.sqrt(np.where(resonant, k / m - b**2 / (4 * m**2), 0)), k)


def delay_independent_mass(mass: ArrayLike, damping: ArrayLike, stiffness: ArrayLike) -> Array:
    """Return the felt tool mass mu [kg] below which free motion is stable for every delay."""
    m, b, k = checked_held(mass, damping, stiffness)
    resonant = b**2 < 2 * k * m
    spring = np.where(resonant, k, 1.0)
    return np.where(resonant, b * np.sqrt(np.abs(m / spring - b**2 / (4 * spring**2))), m)


def unstable_delays_of_mass(
    mass: float, damping: float, stiffness: float, felt_mass: float, longest: float
) -> list[tuple[float, float]]:
    """Return windows of the round trip [s] with unstable free motion (T42)."""
    m, b, k = checked_held(mass, damping, stiffness)
    mu = checked_positive(felt_mass, "felt mass of the tool")
    checked_positive(k, "stiffness of the hand")
    checked_positive(m - mu, "mass of hand and device less that of the tool")
    middle = (2 * m * k - b**2) / (2 * (m**2 - mu**2))
    root = middle**2 - k**2 / (m**2 - mu**2)
    if middle <= 0 or root <= 0:
        return []
    changes: list[tuple[float, int]] = []
    for sign in (1, -1):
        w = np.sqrt(middle + sign * np.sqrt(root))
        first = (2 * np.pi - np.arctan2(b * w, k - m * w**2)) / w
        changes += [(float(t), sign) for t in np.arange(first, longest, 2 * np.pi / w)]
    return joined_windows(changes, longest, inside=lambda count: count > 0)


def tolerated_mass_error(
    mass: ArrayLike, force_scale: ArrayLike, position_scale: ArrayLike
) -> Array:
    """Return the bound on |dm| [kg] in free motion at sigma = 0 (T61)."""
    scale = checked_positive(force_scale, "force scale") * checked_positive(
        position_scale, "position scale"
    )
    return checked_positive(mass, "mass of hand and device") / scale
