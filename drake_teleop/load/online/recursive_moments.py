"""Second moments and solvers of the recursive estimators for noisy motion, Eq. (T18).

As in `batch.moments`, row c of [E V] is T_c z, here with

    z = [1, s (3), alpha (3), w_x w_x, w_y w_y, w_z w_z, w_x w_y, w_x w_z, w_y w_z, F (6)]   (19).

Sums of z z^T allow new weights W (6, 6) between rows for all samples so far, at each sample.
Compiled functions allocate no memory and check no input.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.arrays import Array
from drake_teleop.common.compiled import njit
from drake_teleop.load.batch.moments import coefficients
from drake_teleop.load.online.recursive import RecursiveEstimator

# Relative increase of diagonal elements against rounding.
RIDGE = 1e-13
# Indices of the wrench and of the products w_i w_j in z, and z in the order of `moments`.
_WRENCH, _PRODUCTS = 13, np.array([[7, 10, 11], [10, 8, 12], [11, 12, 9]])
_ORDER = [0, *range(7, 19), *range(1, 7)]


@cache
def terms() -> tuple[NDArray[np.uintp], Array]:
    """Return the nonzero terms of T: (n, 3) [channel, element of z, parameter], and n factors."""
    T = coefficients()[:, :, _ORDER].swapaxes(1, 2)
    index = np.argwhere(T)
    # Unsigned, so that the compiled loops do not check for negative indices.
    return np.ascontiguousarray(index, dtype=np.uintp), T[tuple(index.T)]


@njit(cache=True)
def scratch():
    """Return working arrays (E, g, L, LZ, inverse, S, W)."""
    return (
        np.empty((13, 6, 16)),
        np.empty(16),
        np.empty((6, 19)),
        np.empty((6, 19)),
        np.empty((6, 12)),
        np.empty((6, 6)),
        np.empty((6, 6)),
    )


@njit(cache=True)
def write_z(wrench, motion, z):
    """Write z of a wrench (6,) and a motion (9,) [s, omega, alpha]."""
    s, omega, alpha = motion[:3], motion[3:6], motion[6:]
    z[0] = 1.0
    for i in range(3):
        z[1 + i] = s[i]
        z[4 + i] = alpha[i]
        for j in range(i + 1):
            z[_PRODUCTS[i, j]] = omega[i] * omega[j]
    for c in range(6):
        z[_WRENCH + c] = wrench[c]


@njit(cache=True)
def add_outer_product(y, z, total):
    """Add y z^T to total (19, 19)."""
    for i in range(19):
        for j in range(19):
            total[i, j] += y[i] * z[j]


@njit(cache=True)
def forget(memory, theta, information, forgetting):
    """Multiply the sums by `forgetting` and centre the prior at the present estimate."""
    last = memory.shape[0] - 1
    for i in range(last):
        for j in range(19):
            memory[i, j] *= forgetting
    for j in range(16):
        memory[last, j] = information[j] * theta[j]


@njit(cache=True)
def residual_products(Z, theta, index, factors, L, LZ, S):
    """Write L with r = F - [E V] theta = L z, L Z, and S = L Z L^T, the sum of r r^T.

    Args:
        Z: (19, 19) sum of z z^T, or a covariance of its noise.
        index, factors: from `terms`.
        L, LZ: (6, 19), S: (6, 6), written.
    """
    L[:] = 0.0
    LZ[:] = 0.0
    for c in range(6):
        L[c, _WRENCH + c] = 1.0
    for t in range(len(factors)):
        L[index[t, 0], index[t, 1]] -= factors[t] * theta[index[t, 2]]
    for c in range(6):
        for i in range(19):
            a = L[c, i]
            if a != 0.0:
                for j in range(19):
                    LZ[c, j] += a * Z[i, j]
    for c in range(6):
        for d in range(c + 1):
            total = 0.0
            for j in range(19):
                total += LZ[c, j] * L[d, j]
            S[c, d] = S[d, c] = total


@njit(cache=True)
def noise_products(Z, noise_std, motion_std, Q):
    """Write the expected noise in the sum Z of z z^T into Q (19, 19), omega to first order."""
    Q[:] = 0.0
    for c in range(6):
        Q[_WRENCH + c, _WRENCH + c] = Z[0, 0] * noise_std[c] ** 2
    for k in range(3):
        Q[1 + k, 1 + k] = Z[0, 0] * motion_std[k] ** 2
        Q[4 + k, 4 + k] = Z[0, 0] * motion_std[6 + k] ** 2
        # The derivative of w_i w_k by w_k is w_i, or 2 w_i for i = k.
        for i in range(3):
            for j in range(3):
                both = (1.0 + (i == k)) * (1.0 + (j == k)) * Z[0, _PRODUCTS[i, j]]
                Q[_PRODUCTS[i, k], _PRODUCTS[j, k]] += motion_std[3 + k] ** 2 * both


@njit(cache=True)
def weighted_gram(Z, W, index, factors, E, G, first):
    """Write the sum of X^T W Y into columns `first`... of G, X and Y being [E V] of y and z.

    Args:
        Z: (19, 19) sum of y z^T.
        index, factors: from `terms`.
        E: (13, 6, 16) scratch.
    """
    E[:] = 0.0
    for t in range(len(factors)):
        c, b, k, factor = index[t, 0], index[t, 1], index[t, 2], factors[t]
        for a in range(13):
            E[a, c, k] += factor * Z[a, b]
    G[:, first : first + 16] = 0.0
    for t in range(len(factors)):
        c, a, j, factor = index[t, 0], index[t, 1], index[t, 2], factors[t]
        w0, w1, w2 = factor * W[c, 0], factor * W[c, 1], factor * W[c, 2]
        w3, w4, w5 = factor * W[c, 3], factor * W[c, 4], factor * W[c, 5]
        for k in range(16):
            G[j, first + k] += (
                (w0 * E[a, 0, k] + w1 * E[a, 1, k])
                + (w2 * E[a, 2, k] + w3 * E[a, 3, k])
                + (w4 * E[a, 4, k] + w5 * E[a, 5, k])
            )


@njit(cache=True)
def weighted_right(LZ, W, index, factors, g):
    """Write the sum of X^T W r into g (16,), from LZ (6, 19), the sum of r z^T."""
    g[:] = 0.0
    for t in range(len(factors)):
        c, a = index[t, 0], index[t, 1]
        total = 0.0
        for d in range(6):
            total += W[c, d] * LZ[d, a]
        g[index[t, 2]] += factors[t] * total


@njit(cache=True)
def eliminate(A):
    """Turn [A B] into [D L^T, L^-1 B] in place, for the symmetric A = L D L^T (n, n)."""
    n, m = A.shape
    for k in range(n):
        inverse = 1.0 / A[k, k]
        for i in range(k + 1, n):
            factor = A[k, i] * inverse
            # Whole rows, although the first part is eliminated: equal loops are vectorised better.
            for j in range(m):
                A[i, j] -= factor * A[k, j]


@njit(cache=True)
def solve(A):
    """Turn [A B], A symmetric and positive definite, into [-, A^-1 B] in place."""
    n, m = A.shape
    for i in range(n):
        A[i, i] *= 1.0 + RIDGE
    eliminate(A)
    for i in range(n - 1, -1, -1):
        for j in range(n, m):
            x = A[i, j] / A[i, i]
            A[i, j] = x
            for k in range(i):
                A[k, j] -= A[k, i] * x


@njit(cache=True)
def invert(S, A, W):
    """Write S^-1 into W, both (6, 6); A (6, 12) is scratch."""
    for c in range(6):
        for d in range(6):
            A[c, d] = S[c, d]
            A[c, 6 + d] = 0.0
        A[c, 6 + c] = 1.0
    solve(A)
    for c in range(6):
        for d in range(6):
            W[c, d] = A[c, 6 + d]


class MomentEstimator(RecursiveEstimator):
    """Recursive estimator whose memory is sums of z z^T and the prior's part of the equations."""

    # Number of (19, 19) sums; the first is that of the measured z.
    _sums = 1

    def initial_memory(self, theta: Array) -> Array:
        """Return the memory (19 n + 1, 19): n sums, and the prior's information times theta."""
        memory = np.zeros((19 * self._sums + 1, 19))
        memory[-1, :16] = theta / self._prior
        return memory

    def _residual_rms(self) -> Array:
        L, LZ, S = np.empty((6, 19)), np.empty((6, 19)), np.empty((6, 6))
        residual_products(self._memory[:19], self._theta, *terms(), L, LZ, S)
        return np.sqrt(np.maximum(np.diag(S), 0.0) / self._memory[0, 0])

    def _within_prior(self, covariance: Array) -> Array:
        """Return the covariance with variances limited to the prior's, same correlations."""
        shrink = 1.0 / np.maximum(1.0, np.sqrt(np.diag(covariance) / self._prior))
        return np.asarray(covariance * np.outer(shrink, shrink))
