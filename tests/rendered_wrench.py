"""Wrench to render at the hand, with numpy: a reference for the compiled form."""

from __future__ import annotations

import numpy as np


def wrench_to_master(wrench_S, R_WS, R_WB, force_scale, torque_scale) -> np.ndarray:
    """Return F_E_B (..., 6): the reaction to the sensor's wrench (..., 6), with a scale each."""
    R_BS = np.swapaxes(R_WB, -1, -2) @ R_WS
    force = np.einsum("...ij,...j->...i", R_BS, wrench_S[..., :3])
    torque = np.einsum("...ij,...j->...i", R_BS, wrench_S[..., 3:])
    return -np.concatenate([force_scale * force, torque_scale * torque], axis=-1)
