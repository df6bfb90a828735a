"""Kalman filter update of a load estimate by the mean of a block of samples."""

from __future__ import annotations

import numpy as np

from drake_teleop.common.compiled import njit
from drake_teleop.common.vectors import cholesky
from drake_teleop.load.regressor import non_contact_wrench_into

# Smallest variance of a row relative to the sum of its terms, as in `recursive`.
_RESOLUTION = 1e-10


@njit(cache=True)
def whitening(motion, phi, noise, model_var, n):
    """Return the inverse (6, 6) of the Cholesky factor of a block mean's noise covariance.

    Args:
        motion: (9,) mean [s, omega, alpha].
        phi: (10,) load.
        noise: (15 or more,) long-run variances per sample of wrench and motion.
        model_var: squared model error.
        n: samples of the block.
    """
    root, N = np.zeros((6, 6)), np.zeros((6, 6))
    above, below, shifted = np.empty(6), np.empty(6), motion.copy()
    non_contact_wrench_into(motion[:3], motion[3:6], motion[6:], phi, above)
    f = above[0] ** 2 + above[1] ** 2 + above[2] ** 2
    tau = above[3] ** 2 + above[4] ** 2 + above[5] ** 2
    arm = (phi[1] ** 2 + phi[2] ** 2 + phi[3] ** 2) / max(phi[0] ** 2, 1e-12)
    for c in range(6):
        N[c, c] = noise[c] + n * model_var * (f if c < 3 else tau + arm * f)
    for k in range(9):
        if noise[6 + k] == 0.0:
            continue
        # The wrench is quadratic in the motion, so the central difference is exact.
        shifted[k] = motion[k] + 1.0
        non_contact_wrench_into(shifted[:3], shifted[3:6], shifted[6:], phi, above)
        shifted[k] = motion[k] - 1.0
        non_contact_wrench_into(shifted[:3], shifted[3:6], shifted[6:], phi, below)
        shifted[k] = motion[k]
        for i in range(6):
            for j in range(i + 1):
                N[i, j] += 0.25 * noise[6 + k] * (above[i] - below[i]) * (above[j] - below[j])
    N /= n
    cholesky(N, 6)
    for i in range(6):
        for j in range(i + 1):
            value = 1.0 if i == j else 0.0
            for k in range(j, i):
                value -= N[i, k] * root[k, j]
            root[i, j] = value / N[i, i]
    return root


@njit(cache=True)
def update_estimate(estimate, V, wrench, root):
    """Update [theta (16); P (256)] by a block, Eq. (T6); return the innovation's chi-squared."""
    row, gain = np.empty(16), np.empty(16)
    theta, P, chi = estimate[:16], estimate[16:].reshape(16, 16), 0.0
    for c in range(6):
        innovation = 0.0
        row[:] = 0.0
        for k in range(c + 1):
            row[k] = root[c, k]
            innovation += root[c, k] * wrench[k]
            for j in range(10):
                row[6 + j] += root[c, k] * V[k, j]
        predicted, uncorrelated = 0.0, 0.0
        for i in range(16):
            innovation -= row[i] * theta[i]
            value = 0.0
            for j in range(16):
                value += P[i, j] * row[j]
            gain[i] = value
            predicted += row[i] * value
            uncorrelated += row[i] * row[i] * P[i, i]
        total = max(1.0, _RESOLUTION * uncorrelated) + predicted
        chi += innovation * innovation / total
        for i in range(16):
            theta[i] += gain[i] * innovation / total
            for j in range(16):
                P[i, j] -= gain[i] * gain[j] / total
    return chi
