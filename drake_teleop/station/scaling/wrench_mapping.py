"""Wrench to render at the hand: scaled, in the master's frame, as a reaction."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.compiled import njit
from drake_teleop.common.vectors import apply, rows, three, times, transposed


@njit(cache=True)
def wrench_to_master_into(wrench_S, R_WS, R_WB, force_scale, torque_scale, out):
    """Write `wrench_to_master` of one sample (6,) into `out`, compiled."""
    for part in range(2):
        scale = torque_scale if part == 1 else force_scale
        base = 3 * part
        in_W = apply(rows(R_WS), three(wrench_S, base))
        in_B = times(-scale, apply(transposed(rows(R_WB)), in_W))
        out[base], out[base + 1], out[base + 2] = in_B


def wrench_to_master(
    wrench_S: NDArray[np.float64],
    R_WS: NDArray[np.float64],
    R_WB: NDArray[np.float64],
    force_scale: float,
    torque_scale: float,
) -> NDArray[np.float64]:
    """Return the wrench to render at the master for a wrench of the slave's sensor.

    The operator feels the reaction of Eq. (1)'s wrench: for a load that is held up, the hand is
    pulled down. The moment about the origin of S becomes the moment about E. Equal power at both
    ends needs the translation scale as force scale; the paper's 1/17.5 is smaller.

    Args:
        wrench_S: (..., 6) [f; tau] of Eq. (1), sensor on load, about the origin of S, in S.
        R_WS: (..., 3, 3) orientation of the sensor.
        R_WB: (3, 3) alignment of the master's base B with the world.
        force_scale: force at the master over force at the slave.
        torque_scale: torque at the master over torque at the slave.

    Returns:
        (..., 6) F_E_B, [f; tau] on the hand at E, in B [N, N m].
    """
    R_BS = np.swapaxes(R_WB, -1, -2) @ R_WS
    force = np.einsum("...ij,...j->...i", R_BS, wrench_S[..., :3])
    torque = np.einsum("...ij,...j->...i", R_BS, wrench_S[..., 3:])
    return -np.concatenate([force_scale * force, torque_scale * torque], axis=-1)
