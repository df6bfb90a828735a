"""Recursive total least squares: load and offsets for noise of wrench and motion, Eq. (T18).

The estimate minimises the squared residuals over their expected value (Kubus, Kroeger, Wahl, IROS
2008). Row c of the regressor [E V] is T_c z with constant T_c; [G g] are the normal equations, and
Z (19, 19) is the sum of z z^T, with w = omega:

    z = [1, s (3), alpha (3), w_x w_x, w_y w_y, w_z w_z, w_x w_y, w_x w_z, w_y w_z, F (6)]   (19).
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_teleop.common.compiled import njit
from drake_teleop.common.numeric import Array, nonnegative_array
from drake_teleop.common.registry import Registry
from drake_teleop.load.normal_equations import regressor_coefficients
from drake_teleop.load.online.recursive import RecursiveEstimator, RecursiveLeastSquares
from drake_teleop.load.regressor import MOTION_SLICE, WRENCH_SLICE

# Relative increase of diagonal elements against rounding.
RELATIVE_RIDGE = 1e-13
# Indices of the wrench and of the products w_i w_j in z, and z in the order of `normal_equations`.
_WRENCH_START_IN_Z, _OMEGA_PRODUCT_INDICES = 13, np.array([[7, 10, 11], [10, 8, 12], [11, 12, 9]])
_BATCH_INDEX_OF_Z = [0, *range(7, 19), *range(1, 7)]
# Smallest excess of information over noise after compensation, in units of sqrt(2 / samples).
_MIN_INFORMATION_EXCESS_SIGMAS = 4.0
# Smallest pivot relative to its diagonal element that is not rounding.
_MIN_RELATIVE_PIVOT = 1e-13
# Fewest samples for the noise scale from residuals.
_MIN_SAMPLES_FOR_NOISE_SCALE = 20


@cache
def nonzero_regressor_terms() -> tuple[NDArray[np.uintp], Array]:
    """Return nonzero terms of T, [E V] = T z: indices (n, 3) of channel, z, parameter; factors."""
    T = regressor_coefficients()[:, :, _BATCH_INDEX_OF_Z].swapaxes(1, 2)
    index = np.argwhere(T)
    # Unsigned, so that the compiled loops do not check for negative indices.
    return np.ascontiguousarray(index, dtype=np.uintp), T[tuple(index.T)]


@njit(cache=True)
def allocate_work_arrays():
    E, g, inverse = np.empty((13, 6, 16)), np.empty(16), np.empty((6, 12))
    return E, g, np.empty((6, 19)), np.empty((6, 19)), inverse, np.empty((6, 6)), np.empty((6, 6))


@njit(cache=True)
def write_moment_vector(wrench, motion, z):
    omega = motion[3:6]
    z[0], z[1:4], z[4:7], z[_WRENCH_START_IN_Z:] = 1.0, motion[:3], motion[6:], wrench
    for i in range(3):
        for j in range(i + 1):
            z[_OMEGA_PRODUCT_INDICES[i, j]] = omega[i] * omega[j]


@njit(cache=True)
def add_outer_product(y, z, total):
    for i in range(19):
        for j in range(19):
            total[i, j] += y[i] * z[j]


@njit(cache=True)
def discount_samples_and_set_prior_to_theta(memory, theta, information, forgetting):
    memory[:-1] *= forgetting
    memory[-1, :16] = information * theta


@njit(cache=True)
def write_residual_products(Z, theta, index, factors, L, LZ, S):
    """Write L, LZ = L Z, S = L Z L^T (6, 6), of the residual F - [E V] theta = L z (terms of T)."""
    L[:] = 0.0
    LZ[:] = 0.0
    for c in range(6):
        L[c, _WRENCH_START_IN_Z + c] = 1.0
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
def write_noise_products(Z, noise_std, motion_std, Q):
    """Write to Q (19, 19) the part of Z, the sum of z z^T, that noise is expected to cause."""
    Q[:] = 0.0
    for c in range(6):
        Q[_WRENCH_START_IN_Z + c, _WRENCH_START_IN_Z + c] = Z[0, 0] * noise_std[c] ** 2
    for k in range(3):
        Q[1 + k, 1 + k] = Z[0, 0] * motion_std[k] ** 2
        Q[4 + k, 4 + k] = Z[0, 0] * motion_std[6 + k] ** 2
        # The derivative of w_i w_k by w_k is w_i, or 2 w_i for i = k.
        for i in range(3):
            for j in range(3):
                both = (1.0 + (i == k)) * (1.0 + (j == k)) * Z[0, _OMEGA_PRODUCT_INDICES[i, j]]
                row, column = _OMEGA_PRODUCT_INDICES[i, k], _OMEGA_PRODUCT_INDICES[j, k]
                Q[row, column] += motion_std[3 + k] ** 2 * both


@njit(cache=True)
def write_weighted_gram(Z, W, index, factors, E, G, first_column):
    """Write sum of [E V](y)^T W [E V](z) to G[:, first_column:], from Z, the sum of y z^T."""
    E[:] = 0.0
    for t in range(len(factors)):
        c, b, k, factor = index[t, 0], index[t, 1], index[t, 2], factors[t]
        for a in range(13):
            E[a, c, k] += factor * Z[a, b]
    G[:, first_column : first_column + 16] = 0.0
    for t in range(len(factors)):
        c, a, j, factor = index[t, 0], index[t, 1], index[t, 2], factors[t]
        w0, w1, w2 = factor * W[c, 0], factor * W[c, 1], factor * W[c, 2]
        w3, w4, w5 = factor * W[c, 3], factor * W[c, 4], factor * W[c, 5]
        for k in range(16):
            G[j, first_column + k] += (
                (w0 * E[a, 0, k] + w1 * E[a, 1, k])
                + (w2 * E[a, 2, k] + w3 * E[a, 3, k])
                + (w4 * E[a, 4, k] + w5 * E[a, 5, k])
            )


@njit(cache=True)
def write_weighted_right_side(LZ, W, index, factors, g):
    """Write the sum of [E V](z)^T W F to g (16,), from LZ (6, 19), the sum of F z^T."""
    g[:] = 0.0
    for t in range(len(factors)):
        c, a = index[t, 0], index[t, 1]
        total = 0.0
        for d in range(6):
            total += W[c, d] * LZ[d, a]
        g[index[t, 2]] += factors[t] * total


@njit(cache=True)
def eliminate_below_diagonal(A):
    """Replace A = [S B] by [D L^T, L^-1 B], for symmetric S = L D L^T (n, n)."""
    n, m = A.shape
    for k in range(n):
        inverse = 1.0 / A[k, k]
        for i in range(k + 1, n):
            factor = A[k, i] * inverse
            # Whole rows, although the first part is eliminated: equal loops are vectorised better.
            for j in range(m):
                A[i, j] -= factor * A[k, j]


@njit(cache=True)
def solve_augmented_system_in_place(A):
    """Replace B in A = [S B] by S^-1 B, for symmetric, positive definite S (n, n)."""
    n, m = A.shape
    for i in range(n):
        A[i, i] *= 1.0 + RELATIVE_RIDGE
    eliminate_below_diagonal(A)
    for i in range(n - 1, -1, -1):
        for j in range(n, m):
            x = A[i, j] / A[i, i]
            A[i, j] = x
            for k in range(i):
                A[k, j] -= A[k, i] * x


@njit(cache=True)
def write_inverse_6x6(S, A, W):
    """Write S^-1 into W, both (6, 6); A (6, 12) is scratch memory."""
    A[:, :6], A[:, 6:] = S, 0.0
    for c in range(6):
        A[c, 6 + c] = 1.0
    solve_augmented_system_in_place(A)
    W[:] = A[:, 6:]


class MomentEstimator(RecursiveEstimator):
    """Recursive estimator with memory (20, 19): sum of z z^T, Eq. (T18), and prior row."""

    def initial_memory(self, theta: Array) -> Array:
        memory = np.zeros((20, 19))
        memory[-1, :16] = theta / self._prior
        return memory

    def _residual_rms(self) -> Array:
        L, LZ, S = np.empty((6, 19)), np.empty((6, 19)), np.empty((6, 6))
        Z, terms = self._memory[:19], nonzero_regressor_terms()
        write_residual_products(Z, self._theta, *terms, L, LZ, S)
        return np.sqrt(np.maximum(np.diag(S), 0.0) / Z[0, 0])

    def _limit_variances_to_prior(self, covariance: Array) -> Array:
        shrink = 1.0 / np.maximum(1.0, np.sqrt(np.diag(covariance) / self._prior))
        return np.asarray(covariance * np.outer(shrink, shrink))


@njit(cache=True)
def select_compensated_parameters(G, N, noise_scale, K, subtract):
    """Set `subtract` (16,) to 1 if the noise part N can be removed from G, else 0; K: scratch."""
    subtract[:] = 1.0
    for i in range(16):
        for j in range(16):
            K[i, j] = G[i, j] - noise_scale * N[i, j]
    eliminate_below_diagonal(K)
    definite = True
    for i in range(16):
        definite &= K[i, i] > _MIN_RELATIVE_PIVOT * G[i, i]
    if definite:
        return
    for i in range(16):
        for attempt in range(2):
            subtract[i] = 1.0 - attempt
            for j in range(i):
                total = G[i, j] - noise_scale * subtract[i] * subtract[j] * N[i, j]
                for k in range(j):
                    total -= K[i, k] * K[j, k]
                K[i, j] = total / K[j, j]
            total = G[i, i] - noise_scale * subtract[i] * N[i, i]
            for k in range(i):
                total -= K[i, k] * K[i, k]
            if total > _MIN_RELATIVE_PIVOT * G[i, i]:
                break
        if not total > _MIN_RELATIVE_PIVOT * G[i, i]:
            subtract[:] = 0.0
            return
        K[i, i] = math.sqrt(total)


@njit(cache=True)
def write_rtls_normal_equations(Z, theta, noise_std, motion_std, index, factors, scratch, Q, G, N):
    """Write [G g] to G and G's noise part to N; return the ratio of observed to stated noise."""
    E, g, L, LZ, inverse, S, W = scratch
    write_noise_products(Z, noise_std, motion_std, Q)
    write_residual_products(Q, theta, index, factors, L, LZ, S)
    S /= Z[0, 0]
    write_inverse_6x6(S, inverse, W)
    write_residual_products(Z, theta, index, factors, L, LZ, S)
    scale = 0.0
    for c in range(6):
        for d in range(6):
            scale += W[c, d] * S[c, d]
    write_weighted_gram(Z, W, index, factors, E, G, 0)
    write_weighted_gram(Q, W, index, factors, E, N, 0)
    write_weighted_right_side(Z[:, 13:].T, W, index, factors, g)
    G[:, 16] = g
    return max(0.0, scale) / (6.0 * Z[0, 0])


@njit(cache=True)
def rtls_update(
    theta, memory, samples, noise_std, motion_std, forgetting, information, index, factors
):
    """Update theta (16,) and memory (20, 19) of recursive total least squares by N samples.

    `noise_std` (6,) is of the wrench, `motion_std` (9,) of [s, omega, alpha]; `information` (16,)
    are inverse prior variances; `index`, `factors`: `nonzero_regressor_terms`.
    """
    scratch, Q, z, subtract = allocate_work_arrays(), np.empty((19, 19)), np.empty(19), np.empty(16)
    G, N, K = np.empty((16, 17)), np.empty((16, 16)), np.empty((16, 16))
    Z, options = memory[:19], (noise_std, motion_std, index, factors)
    for n in range(len(samples)):
        if forgetting < 1.0:
            discount_samples_and_set_prior_to_theta(memory, theta, information, forgetting)
        write_moment_vector(samples[n, WRENCH_SLICE], samples[n, MOTION_SLICE], z)
        add_outer_product(z, z, Z)
        scale = write_rtls_normal_equations(Z, theta, *options, scratch, Q, G, N)
        for i in range(16):
            G[i, i] += information[i]
            G[i, 16] += memory[19, i]
        gain = 1.0 - _MIN_INFORMATION_EXCESS_SIGMAS * math.sqrt(2.0 / Z[0, 0])
        if gain > 0.0:
            select_compensated_parameters(G, N, scale / gain, K, subtract)
            for i in range(6, 16):
                for j in range(6, 16):
                    G[i, 16] += scale * subtract[i] * subtract[j] * N[i, j] * theta[j]
        solve_augmented_system_in_place(G)
        theta[:] = G[:, 16]


class RecursiveTotalLeastSquares(MomentEstimator):
    """Recursive total least squares, which allows for noise of the measured motion.

    `motion_std` (9,) is the noise of s [m/s^2], omega [rad/s], alpha [rad/s^2].
    """

    method = "recursive total least squares"
    allows_for_noisy_motion = True

    def __init__(
        self, noise_std: ArrayLike, motion_std: ArrayLike, *options: Any, **named: Any
    ) -> None:
        self._motion_std = nonnegative_array("motion_std", motion_std, 9)
        super().__init__(noise_std, *options, **named)

    @property
    def noise_scale(self) -> float:
        """Ratio of observed to specified noise variances."""
        return self._gram_noise_part_and_scale(self._theta, self._memory)[2]

    def covariance_of(self, theta: Array, memory: Array) -> Array:
        """Return the covariance (16, 16); poorly excited directions keep the prior's variance."""
        samples, information = memory[0, 0], np.diag(1.0 / self._prior)
        G, N, scale = self._gram_noise_part_and_scale(theta, memory)
        root = np.linalg.inv(_regularized_cholesky(G + information))
        shares, vectors = np.linalg.eigh(scale * root @ N @ root.T)
        directions = root.T @ vectors
        excess = 1.0 - shares
        min_excess = _MIN_INFORMATION_EXCESS_SIGMAS * math.sqrt(2.0 / max(samples, 1.0))
        excited = (shares < _MIN_RELATIVE_PIVOT) | (excess > min_excess)
        inverse = (directions[:, excited] / excess[excited]) @ directions[:, excited].T
        factor = inverse @ _regularized_cholesky(scale * G + information)
        unknown = directions[:, ~excited]
        unknown = unknown / np.sqrt(np.sum(unknown**2 / self._prior[:, None], axis=0))
        return self._limit_variances_to_prior(factor @ factor.T + unknown @ unknown.T)

    def _gram_noise_part_and_scale(self, theta: Array, memory: Array) -> tuple[Array, Array, float]:
        G, N, Q = np.zeros((16, 17)), np.zeros((16, 16)), np.empty((19, 19))
        if not memory[0, 0] > 0.0:
            return G[:, :16], N, 1.0
        noise, scratch = (self._noise_std, self._motion_std), allocate_work_arrays()
        options = *noise, *nonzero_regressor_terms(), scratch, Q
        scale = write_rtls_normal_equations(memory[:19], theta, *options, G, N)
        return G[:, :16], N, scale if memory[0, 0] > _MIN_SAMPLES_FOR_NOISE_SCALE else 1.0

    def _update_state(self, theta: Array, memory: Array, samples: Array) -> None:
        options = (self._noise_std, self._motion_std, self._forgetting, 1.0 / self._prior)
        rtls_update(theta, memory, samples, *options, *nonzero_regressor_terms())


def _regularized_cholesky(A: Array) -> Array:
    return np.asarray(np.linalg.cholesky(A + _MIN_RELATIVE_PIVOT * np.diag(np.diag(A))))


METHODS: Registry[type[RecursiveEstimator]] = Registry(
    "recursive estimator",
    {"rls": RecursiveLeastSquares, "rtls": RecursiveTotalLeastSquares},
    RecursiveEstimator,
)
"""Recursive estimators by name."""
