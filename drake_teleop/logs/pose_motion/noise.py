"""What noise of the poses does to the moments of the motion's signals.

White noise of position, n, and of orientation, a turn d in the axes of P, moves the signals at the
frequency w by

    d a = R^T (-w^2 n) + a x d,   d(-g) = -g x d,   d omega = i w d,   d alpha = -w^2 d,
    d(w_i w_j) = w_i d w_j + w_j d w_i,

so that the mean covariance Q of the signals follows from the powers of n and d and from the means
of the products of a, g and omega over the record. It is real: what couples with an odd power of i w
is of mean zero. The signals' derivatives, i w times them, have w^2 Q. Splines pass a share of it.
"""

from __future__ import annotations

import numpy as np

from drake_teleop.common.arrays import Array
from drake_teleop.common.vectors import cross_matrix
from drake_teleop.logs.pose_motion.spectra import RATES, WIDTH, Bands, Grid
from drake_teleop.logs.pose_motion.splines import SIGNALS, PoseSplines, passed

PRODUCTS = np.array([[10, 13, 14], [13, 11, 15], [14, 15, 12]])
"""Where the products of angular velocity stand among the signals: (3, 3)."""
_A, _G, _ALPHA = slice(1, 4), slice(4, 7), slice(7, 10)


def noise_moments(
    splines: PoseSplines,
    grid: Grid,
    taper: Array,
    zeta: Array,
    of: Bands,
    noise: tuple[float, float],
) -> Array:
    """(bands, 38, 38) what noise adds to `spectra.moments`.

    Args:
        splines: of the poses.
        grid, taper: of the record.
        zeta: (M, 16) the signals.
        of: the bands.
        noise: standard deviations of position [m] and turn [rad], of each pose and axis.
    """
    w2 = (2.0 * np.pi * of.frequency) ** 2
    per_number = np.sum(taper**2) / (grid.dt * splines.rate)
    share = per_number * passed(of.frequency, splines.spacing)
    place, turn = (std**2 * share for std in noise)
    if splines.aid is not None:
        left = splines.aid.share(of.frequency)
        place, turn = place * left[0], turn * left[1]
    weight = taper**2 / np.sum(taper**2)
    still, first, second, third = _turning(zeta, weight)
    eye = np.zeros((SIGNALS, SIGNALS))
    eye[_A, _A] = np.eye(3)
    parts = [(place * w2**2, eye), (turn, still), (turn * w2, first + second)]
    parts.append((turn * w2**2, third))
    Q = np.zeros((of.count, WIDTH, WIDTH))
    for power, shape in parts:
        Q[:, :SIGNALS, :SIGNALS] += of.sums(power)[:, None, None] * shape
        Q[:, RATES, RATES] += of.sums(power * w2)[:, None, None] * shape
    return Q


def _turning(zeta: Array, weight: Array) -> tuple[Array, Array, Array, Array]:
    """Covariances (16, 16) of the signals by a turn of unit power: factors 1, w^2, w^2, w^4."""
    still, cross, products, alpha = np.zeros((4, SIGNALS, SIGNALS))
    mean = weight @ zeta
    for left in (_A, _G):
        for right in (_A, _G):
            # (x x d)(y x d)^T of a turn d of covariance 1.
            both = (weight[:, None] * zeta[:, left]).T @ zeta[:, right]
            still[left, right] = np.trace(both) * np.eye(3) - both.T
    for where in (_A, _G):
        cross[where, _ALPHA] = -cross_matrix(mean[where])
        cross[_ALPHA, where] = cross[where, _ALPHA].T
    jacobian = np.zeros((3, 3, SIGNALS))  # of the signals by omega_k, coefficient of omega_i
    for i in range(3):
        for j in range(3):
            jacobian[j, i, PRODUCTS[i, j]] += 1.0 + (i == j)
    ww = mean[PRODUCTS]
    for k in range(3):
        products += jacobian[k].T @ ww @ jacobian[k]
    alpha[_ALPHA, _ALPHA] = np.eye(3)
    return still, cross, products, alpha
