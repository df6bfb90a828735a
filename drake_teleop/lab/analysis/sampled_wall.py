"""Z-width of a sampled device: the stiffest virtual wall that it can render.

The device's position x is sampled every Ts [s]. The wall of stiffness K [N/m] and damping B [N s/m]
responds with the held force

    f_k = K x_k + B (x_k - x_(k-1)) / Ts.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from drake_teleop.common.numeric import Array, finite_array, nonnegative_array, positive_array
from drake_teleop.lab.analysis.one_axis import Complex
from drake_teleop.lab.analysis.period_map import mass_spring_unit_responses

_NUM_STIFFNESS_BISECTIONS = 60


def passive_stiffness(device_damping: ArrayLike, wall_damping: ArrayLike, period: float) -> Array:
    """Return the largest stiffness [N/m] of a passive virtual wall; 0: no wall is passive (T62)."""
    b = positive_array("device_damping", device_damping, *np.shape(device_damping))
    B = finite_array("wall_damping", wall_damping, *np.shape(wall_damping))
    positive_array("period", period)
    return np.maximum(2 * (b - np.abs(B)) / period, 0.0)


def stable_stiffness(
    mass: ArrayLike,
    damping: ArrayLike,
    wall_damping: ArrayLike,
    period: float,
    *,
    hand_stiffness: ArrayLike = 0.0,
) -> Array:
    """Return the largest stiffness [N/m] of a stable virtual wall with `wall_damping` [N s/m].

    0: no wall is stable. Mass [kg] and damping [N s/m] are those of device and hand together.
    """
    device = mass, damping, hand_stiffness
    push = _sampled_device_responses_to_unit_x_v_f(*device, period)[..., 2]
    B = finite_array("wall_damping", wall_damping, *np.shape(wall_damping))
    # A coefficient of a stable cubic is below 3, which bounds the stiffness.
    high = 5 / push[..., 0] + np.abs(B) / period
    low = np.zeros_like(high)
    for _ in range(_NUM_STIFFNESS_BISECTIONS):
        middle = (low + high) / 2
        poles = sampled_poles(*device, middle, B, period)
        stable = np.abs(poles).max(axis=-1) < 1
        low, high = np.where(stable, middle, low), np.where(stable, high, middle)
    return low


def sampled_poles(
    mass: ArrayLike,
    damping: ArrayLike,
    hand_stiffness: ArrayLike,
    wall_stiffness: ArrayLike,
    wall_damping: ArrayLike,
    period: float,
) -> Complex:
    """Return the eigenvalues (..., 3) of device, hand and virtual wall over one sampling period."""
    walls = {"wall_stiffness": wall_stiffness, "wall_damping": wall_damping}
    K, B = np.broadcast_arrays(*(finite_array(k, x, *np.shape(x)) for k, x in walls.items()))
    responses = _sampled_device_responses_to_unit_x_v_f(mass, damping, hand_stiffness, period)
    # States: position, velocity, last sampled position
    force = np.stack([K + B / period, np.zeros_like(B, dtype=float), -B / period], axis=-1)
    held = responses[..., 2:] * force[..., None, :]
    step = np.zeros((*held.shape[:-2], 3, 3))
    step[..., :2, :2], step[..., 2, 0] = responses[..., :2], 1
    step[..., :2, :] -= held
    return np.linalg.eigvals(step).astype(complex)


def _sampled_device_responses_to_unit_x_v_f(
    mass: ArrayLike, damping: ArrayLike, stiffness: ArrayLike, period: float
) -> Array:
    m = positive_array("mass", mass, *np.shape(mass))
    b = positive_array("damping", damping, *np.shape(damping))
    k = nonnegative_array("hand_stiffness", stiffness, *np.shape(stiffness))
    positive_array("period", period)
    responses = mass_spring_unit_responses(k / m, b / m, period)
    responses[..., 2] /= m[..., None]
    return responses
