"""Covariance of the signals caused by noise of the poses, Eq. (T77)."""

from __future__ import annotations

import numpy as np

from drake_teleop.common.arrays import Array
from drake_teleop.common.vectors import cross_matrix
from drake_teleop.logs.pose_motion.spectra import RATES, WIDTH, Bands, Grid
from drake_teleop.logs.pose_motion.splines import SIGNALS, PoseSplines, passed

PRODUCTS = np.array([[10, 13, 14], [13, 11, 15], [14, 15, 12]])
"""(3, 3) indices of the products of angular velocity among the signals."""
_A, _G, _ALPHA = slice(1, 4), slice(4, 7), slice(7, 10)


def noise_moments(
    splines: PoseSplines,
    grid: Grid,
    taper: Array,
    zeta: Array,
    of: Bands,
    noise: tuple[float, float],
) -> Array:
    """Return (bands, 38, 38) Q that noise of the poses adds to `spectra.moments`.

    `zeta` (M, 16) are the signals, `noise` standard deviations of position [m] and rotation [rad].
    """
    w2 = (2.0 * np.pi * of.frequency) ** 2
    per_number = np.sum(taper**2) / (grid.dt * splines.rate)
    share = per_number * passed(of.frequency, splines.spacing)
    position_power, rotation_power = (std**2 * share for std in noise)
    if splines.imu_rows is not None:
        left = splines.imu_rows.share(of.frequency)
        position_power, rotation_power = position_power * left[0], rotation_power * left[1]
    weight = taper**2 / np.sum(taper**2)
    still, first, second, third = _rotation_covariances(zeta, weight)
    eye = np.zeros((SIGNALS, SIGNALS))
    eye[_A, _A] = np.eye(3)
    parts = [
        (position_power * w2**2, eye),
        (rotation_power, still),
        (rotation_power * w2, first + second),
    ]
    parts.append((rotation_power * w2**2, third))
    Q = np.zeros((of.count, WIDTH, WIDTH))
    for power, shape in parts:
        Q[:, :SIGNALS, :SIGNALS] += of.sums(power)[:, None, None] * shape
        Q[:, RATES, RATES] += of.sums(power * w2)[:, None, None] * shape
    return Q


def _rotation_covariances(zeta: Array, weight: Array) -> tuple[Array, Array, Array, Array]:
    """Return covariances (16, 16) for unit rotation noise; factors 1, w^2, w^2, w^4."""
    still, cross, products, alpha = np.zeros((4, SIGNALS, SIGNALS))
    mean = weight @ zeta
    for left in (_A, _G):
        for right in (_A, _G):
            # Mean of (x x d)(y x d)^T for a rotation d of unit covariance.
            both = (weight[:, None] * zeta[:, left]).T @ zeta[:, right]
            still[left, right] = np.trace(both) * np.eye(3) - both.T
    for where in (_A, _G):
        cross[where, _ALPHA] = -cross_matrix(mean[where])
        cross[_ALPHA, where] = cross[where, _ALPHA].T
    jacobian = np.zeros(
        (3, 3, SIGNALS)
    )  # derivative of the signals by omega_j, coefficient of omega_i
    for i in range(3):
        for j in range(3):
            jacobian[j, i, PRODUCTS[i, j]] += 1.0 + (i == j)
    ww = mean[PRODUCTS]
    for k in range(3):
        products += jacobian[k].T @ ww @ jacobian[k]
    alpha[_ALPHA, _ALPHA] = np.eye(3)
    return still, cross, products, alpha
