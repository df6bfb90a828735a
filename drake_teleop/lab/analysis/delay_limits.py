"""What hand and device bear: closed forms of the stiffness, the mass and the round trip."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from drake_teleop.lab.analysis.delayed_loop import checked_held, checked_positive, joined_windows
from drake_teleop.lab.analysis.polynomials import Array


def contact_delay_margin(
    mass: ArrayLike, damping: ArrayLike, stiffness: ArrayLike, felt_stiffness: ArrayLike
) -> Array:
    """Largest round trip time [s] of a held device on a wall: m s^2 + b s + k + K e^(-s RTT).

    atan2(b w, m w^2 - k) / w at the highest w with |k - m w^2 + j b w| = K; inf without such a w.

    Raises:
        DrakeTeleopError: mass, damping or the felt stiffness K is not positive, or k negative.
    """
    m, b, k = checked_held(mass, damping, stiffness)
    K = checked_positive(felt_stiffness, "felt stiffness of the wall")
    middle = (2 * m * k - b**2) / (2 * m**2)
    root = middle**2 - (k**2 - K**2) / m**2
    with np.errstate(invalid="ignore", divide="ignore"):
        w = np.sqrt(middle + np.sqrt(root))
        return np.where(w > 0, np.arctan2(b * w, m * w**2 - k) / w, np.inf)


def delay_independent_stiffness(mass: ArrayLike, damping: ArrayLike, stiffness: ArrayLike) -> Array:
    """Felt stiffness K [N/m] below which contact is stable for every delay.

    b sqrt(k / m - b^2 / 4 m^2) if b^2 < 2 k m, else k.

    Raises:
        DrakeTeleopError: mass or damping is not positive, or the stiffness negative.
    """
    m, b, k = checked_held(mass, damping, stiffness)
    resonant = b**2 < 2 * k * m
    return np.where(resonant, b * np.sqrt(np.where(resonant, k / m - b**2 / (4 * m**2), 0)), k)


def delay_independent_mass(mass: ArrayLike, damping: ArrayLike, stiffness: ArrayLike) -> Array:
    """Felt tool mass mu [kg] below which free motion is stable for every delay.

    m s^2 + b s + k + mu s^2 e^(-s RTT): b sqrt(m / k - b^2 / 4 k^2) if b^2 < 2 k m, else m.

    Raises:
        DrakeTeleopError: mass or damping is not positive, or the stiffness negative.
    """
    m, b, k = checked_held(mass, damping, stiffness)
    resonant = b**2 < 2 * k * m
    spring = np.where(resonant, k, 1.0)
    return np.where(resonant, b * np.sqrt(np.abs(m / spring - b**2 / (4 * spring**2))), m)


def unstable_delays_of_mass(
    mass: float, damping: float, stiffness: float, felt_mass: float, longest: float
) -> list[tuple[float, float]]:
    """Windows of the round trip time in [0, longest] [s] where free motion with mu < m is unstable.

    At the two frequencies with |k - m w^2 + j b w| = mu w^2 the delays (2 pi (n + 1) -
    atan2(b w, k - m w^2)) / w take a pole into the right half plane (the higher one) and back.

    Raises:
        DrakeTeleopError: mass, damping, stiffness or mu is not positive, or mu is not below m.
    """
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
    """Bound m / (k_f l_p) [kg] on |dm|: without contact force and at sigma = 0 an error of the
    estimated mass is felt as -k_f l_p dm, and more than hand and device weigh cannot be stable.

    Necessary for any delay above zero; `delay_independent_mass` over the scales is sufficient.

    Raises:
        DrakeTeleopError: mass or a scale is not positive.
    """
    scale = checked_positive(force_scale, "force scale") * checked_positive(
        position_scale, "position scale"
    )
    return checked_positive(mass, "mass of hand and device") / scale
