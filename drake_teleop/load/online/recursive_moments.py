"""What the recursive estimators share that keep second moments: weights across rows, and solving.

As in `moments`, row c of [E V] is linear in what was measured, V_c = T_c z, with

    z = [1, s (3), alpha (3), w_x w_x, w_y w_y, w_z w_z, w_x w_y, w_x w_z, w_y w_z, F (6)]   (19),

so that the sums of z z^T give those of least squares for any weights W (6, 6) between the rows of a
sample. Noise of one acceleration is an error of several rows at once; W, the inverse covariance of
the rows' errors, tells it from an effect of the load. Each sample weighs all samples so far anew,
with what is known by then: weights that were wrong to begin with leave no trace.

The compiled functions allocate nothing (`scratch` is made once for many samples) and check nothing.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.arrays import Array
from drake_teleop.common.compiled import njit
from drake_teleop.load.batch.moments import coefficients
from drake_teleop.load.online.recursive import RecursiveEstimator

# Raises each diagonal element relative to itself, against rounding.
RIDGE = 1e-13
# Where the wrench and the products of angular velocity stand in z, and z in the order of `moments`.
_WRENCH, _PRODUCTS = 13, np.array([[7, 10, 11], [10, 8, 12], [11, 12, 9]])
_ORDER = [0, *range(7, 19), *range(1, 7)]


@cache
def terms() -> tuple[NDArray[np.uintp], Array]:
    """The map from z to [E V]: (n, 3) [channel, element of z, parameter], and n factors."""
    T = coefficients()[:, :, _ORDER].swapaxes(1, 2)
    index = np.argwhere(T)
    # Unsigned, so that the compiled loops need not look for negative indices.
    return np.ascontiguousarray(index, dtype=np.uintp), T[tuple(index.T)]


@njit(cache=True)
def scratch():
    """For the functions below."""
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
def observe(wrench, motion, z):
    """z of a wrench (6,) and a motion (9,) [s, omega, alpha]."""
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
def add_product(y, z, total):
    """Adds y z^T to total (19, 19)."""
    for i in range(19):
        for j in range(19):
            total[i, j] += y[i] * z[j]


@njit(cache=True)
def forget(memory, theta, information, forgetting):
    """Multiplies the sums by forgetting, and puts the prior about the present estimate."""
    last = memory.shape[0] - 1
    for i in range(last):
        for j in range(19):
            memory[i, j] *= forgetting
    for j in range(16):
        memory[last, j] = information[j] * theta[j]


@njit(cache=True)
def residual_products(Z, theta, index, factors, L, LZ, S):
    """L with r = F - [E V] theta = L z, L Z, and S = L Z L^T, the sum of r r^T.

    Args:
        Z: (19, 19) sum of z z^T, or a covariance of its noise.
        theta: (16,).
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
    """The part of the sum Z of z z^T that is noise into Q (19, 19), of omega to first order.

    Args:
        Z: (19, 19) sum of z z^T.
        noise_std: (6,) of the wrench [N, N m].
        motion_std: (9,) of s [m/s^2], omega [rad/s] and alpha [rad/s^2].
    """
    Q[:] = 0.0
    for c in range(6):
        Q[_WRENCH + c, _WRENCH + c] = Z[0, 0] * noise_std[c] ** 2
    for k in range(3):
        Q[1 + k, 1 + k] = Z[0, 0] * motion_std[k] ** 2
        Q[4 + k, 4 + k] = Z[0, 0] * motion_std[6 + k] ** 2
        # The derivative of w_i w_k by w_k is w_i, and twice that for i = k.
        for i in range(3):
            for j in range(3):
                both = (1.0 + (i == k)) * (1.0 + (j == k)) * Z[0, _PRODUCTS[i, j]]
                Q[_PRODUCTS[i, k], _PRODUCTS[j, k]] += motion_std[3 + k] ** 2 * both


@njit(cache=True)
def weighted_gram(Z, W, index, factors, E, G, first):
    """Writes the sum of X^T W Y into G, from the sum Z of y z^T: X, Y are [E V] of y, z.

    Args:
        Z: (19, 19).
        W: (6, 6).
        index, factors: from `terms`.
        E: (13, 6, 16) scratch.
        G: (16, m), 16 columns of it from `first` on are written.
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
    """Writes the sum of X^T W r into g (16,), from LZ (6, 19), the sum of r z^T."""
    g[:] = 0.0
    for t in range(len(factors)):
        c, a = index[t, 0], index[t, 1]
        total = 0.0
        for d in range(6):
            total += W[c, d] * LZ[d, a]
        g[index[t, 2]] += factors[t] * total


@njit(cache=True)
def eliminate(A):
    """Turns [A B] into [D L^T, L^-1 B] for the symmetric A = L D L^T (n, n), in place."""
    n, m = A.shape
    for k in range(n):
        inverse = 1.0 / A[k, k]
        for i in range(k + 1, n):
            factor = A[k, i] * inverse
            # Whole rows, the eliminated part too: loops of the same length are vectorised better.
            for j in range(m):
                A[i, j] -= factor * A[k, j]


@njit(cache=True)
def solve(A):
    """Turns [A B], A symmetric and positive definite, into [-, A^-1 B]."""
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
    """W = S^-1, all (6, 6) but A (6, 12), scratch."""
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
    """A recursive estimator whose memory is sums of z z^T and what its prior is about.

    Args:
        noise_std: (6,) standard deviations of the wrench channels [N, N m].
        forgetting: factor per sample on the weight of the past, 0 < forgetting <= 1.
        prior_std: (16,) standard deviations of [offsets; phi] to begin with. With forgetting the
            prior is about the present estimate and never vanishes.
        bound: of `settled`.

    Raises:
        DrakeTeleopError: for other shapes or values.
    """

    # Of (19, 19) sums. The first is that of what was measured.
    _sums = 1

    def initial_memory(self, theta: Array) -> Array:
        """(19 n + 1, 19): n sums, none yet, and the prior's information times theta (16,)."""
        memory = np.zeros((19 * self._sums + 1, 19))
        memory[-1, :16] = theta / self._prior
        return memory

    def _residual_rms(self) -> Array:
        L, LZ, S = np.empty((6, 19)), np.empty((6, 19)), np.empty((6, 6))
        residual_products(self._memory[:19], self._theta, *terms(), L, LZ, S)
        return np.sqrt(np.maximum(np.diag(S), 0.0) / self._memory[0, 0])

    def _within_prior(self, covariance: Array) -> Array:
        """Variances at most the prior's, which bounds what is unknown; correlations kept."""
        shrink = 1.0 / np.maximum(1.0, np.sqrt(np.diag(covariance) / self._prior))
        return np.asarray(covariance * np.outer(shrink, shrink))
