"""Motion with derivatives in closed form, and the logs of a sensor on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

GRAVITY_W = np.array([0.0, 0.0, -9.80665])


@dataclass(frozen=True)
class Motion:
    """Smooth R_WS = Rz(a(t)) Rx(b(t)) and p_WS(t) that excite all ten parameters."""

    t: NDArray[np.float64]
    R_WS: NDArray[np.float64]
    p_WS: NDArray[np.float64]
    specific_force: NDArray[np.float64]
    omega: NDArray[np.float64]
    alpha: NDArray[np.float64]


def _sine(t: NDArray[np.float64], size: float, rate: float, phase: float) -> NDArray[np.float64]:
    """Return value, first and second derivative, (3, N)."""
    w = 2 * np.pi * rate
    return size * np.array(
        [
            np.sin(w * t + phase),
            w * np.cos(w * t + phase),
            -w * w * np.sin(w * t + phase),
        ]
    )


def motion_at(t: NDArray[np.float64]) -> Motion:
    """Return the motion at the times t (N,)."""
    a, da, dda = _sine(t, 1.2, 0.7, 0.3) + _sine(t, 0.3, 1.9, 1.0)
    b, db, ddb = _sine(t, 0.9, 0.9, 0.0) + _sine(t, 0.4, 1.7, 2.0)
    zero, one = np.zeros_like(t), np.ones_like(t)
    Rz = np.array([[np.cos(a), -np.sin(a), zero], [np.sin(a), np.cos(a), zero], [zero, zero, one]])
    Rx = np.array([[one, zero, zero], [zero, np.cos(b), -np.sin(b)], [zero, np.sin(b), np.cos(b)]])
    R_WS = np.einsum("ijn,jkn->nik", Rz, Rx)
    z_S, dz_S = (
        np.array([zero, np.sin(b), np.cos(b)]),
        np.array([zero, db * np.cos(b), -db * np.sin(b)]),
    )
    x = np.array([one, zero, zero])
    omega = (da * z_S + db * x).T
    alpha = (dda * z_S + da * dz_S + ddb * x).T
    paths = [_sine(t, size, rate, rate) for size, rate in ((0.15, 0.8), (0.1, 1.3), (0.12, 1.1))]
    p_WS, _, a_W = np.array(paths).transpose(1, 2, 0)
    s = np.einsum("nji,nj->ni", R_WS, a_W - GRAVITY_W)
    return Motion(t, R_WS, p_WS, s, omega, alpha)


def quaternions(R: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (N, 4) wxyz of (N, 3, 3); the sign is arbitrary, as in real logs."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(R).as_quat()[:, [3, 0, 1, 2]]
