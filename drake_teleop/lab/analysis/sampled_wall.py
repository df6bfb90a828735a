"""Z-width of a sampled device: the stiffest virtual wall that it can render.

The device's position x is sampled every Ts [s]. The wall of stiffness K [N/m] and damping B [N s/m]
responds with the held force

    f_k = K x_k + B (x_k - x_(k-1)) / Ts.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.lab.analysis.one_axis import Complex

Array = NDArray[np.float64]

_NUM_STIFFNESS_BISECTIONS = 60


def passive_stiffness(device_damping: ArrayLike, wall_damping: ArrayLike, period: float) -> Array:
    """Return the largest stiffness [N/m] of a passive virtual wall; 0: none is passive (T62)."""
    b = _check_positive(device_damping, "damping of the device")
    _check_positive(period, "period")
    return np.maximum(2 * (b - np.abs(wall_damping)) / period, 0.0)


def stable_stiffness(
    mass: ArrayLike,
    damping: ArrayLike,
    wall_damping: ArrayLike,
    period: float,
    *,
    hand_stiffness: ArrayLike = 0.0,
) -> Array:
    """Return the wall stiffness [N/m] at which the loop becomes unstable; 0: always unstable.

    Mass [kg], damping [N s/m] and `hand_stiffness` [N/m] are those of device and hand together.
    """
    _, held = _sampled_device_matrices(mass, damping, hand_stiffness, period)
    # A coefficient of a stable cubic is below 3, which bounds the stiffness.
    high = 5 / held[..., 0] + np.abs(wall_damping) / period
    low = np.zeros_like(high)
    for _ in range(_NUM_STIFFNESS_BISECTIONS):
        middle = (low + high) / 2
        poles = sampled_poles(
            mass, damping, middle, wall_damping, period, hand_stiffness=hand_stiffness
        )
        stable = np.abs(poles).max(axis=-1) < 1
        low, high = np.where(stable, middle, low), np.where(stable, high, middle)
    return low


def sampled_poles(
    mass: ArrayLike,
    damping: ArrayLike,
    stiffness: ArrayLike,
    wall_damping: ArrayLike,
    period: float,
    *,
    hand_stiffness: ArrayLike = 0.0,
) -> Complex:
    """Return the closed loop's eigenvalues (..., 3) over a sample; `stiffness`: wall [N/m]."""
    mass, damping, K, B, hand = np.broadcast_arrays(
        mass, damping, stiffness, wall_damping, hand_stiffness
    )
    state, held = _sampled_device_matrices(mass, damping, hand, period)
    # States: position, velocity, last sampled position
    force = np.stack([K + B / period, np.zeros_like(B, dtype=float), -B / period], axis=-1)
    step = np.zeros((*mass.shape, 3, 3))
    step[..., :2, :2] = state
    step[..., :2, :] -= held[..., :, None] * force[..., None, :]
    step[..., 2, 0] = 1
    return np.linalg.eigvals(step).astype(complex)


def _sampled_device_matrices(
    mass: ArrayLike, damping: ArrayLike, stiffness: ArrayLike, period: float
) -> tuple[Array, Array]:
    from scipy.linalg import expm

    _check_positive(mass, "mass of the device")
    _check_positive(damping, "damping of the device")
    _check_positive(period, "period")
    m, b, k = np.broadcast_arrays(mass, damping, stiffness)
    if not np.all(k >= 0):
        raise DrakeTeleopError(
            "the stiffness of the hand is negative",
            where="hand_stiffness",
            remedy="give 0 or more [N/m]",
        )
    rates = np.zeros((*m.shape, 3, 3))
    rates[..., 0, 1] = 1
    rates[..., 1, 0], rates[..., 1, 1], rates[..., 1, 2] = -k / m, -b / m, 1 / m
    motion = expm(rates * period)
    return motion[..., :2, :2], motion[..., :2, 2]


def _check_positive(value: ArrayLike, what: str) -> Array:
    value = np.asarray(value, dtype=float)
    if not np.all(value > 0):
        raise DrakeTeleopError(f"the {what} is not positive", remedy="give values above 0")
    return value
