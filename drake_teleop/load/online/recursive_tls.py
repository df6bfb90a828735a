"""Recursive total least squares: load and offsets for noise of wrench and motion, Eq. (T18).

The estimate minimises the squared residuals over their expected value (Kubus, Kroeger, Wahl, IROS
2008). Row c of the regressor [E V] is T_c z with the constant T_c and the products z (19) of
`load.normal_equations`; Z (19, 19) is the sum of z z^T, and [G g] are the normal equations.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from drake_teleop.common.compiled import njit
from drake_teleop.common.numeric import Array, nonnegative_array
from drake_teleop.common.registry import Registry
from drake_teleop.load.normal_equations import OMEGA_PRODUCT_INDICES, regressor_coefficients
from drake_teleop.load.online.recursive import (
    MAX_SETTLED_RELATIVE_STD,
    PRIOR_STD,
    RecursiveEstimator,
    RecursiveLeastSquares,
)
from drake_teleop.load.regressor import SAMPLE_MOTION, SAMPLE_WRENCH

# Relative increase of diagonal elements against rounding.
_RELATIVE_RIDGE = 1e-13
# Smallest excess of information over noise after compensation, in units of sqrt(2 / samples).
_MIN_INFORMATION_EXCESS = 4.0
# Smallest pivot relative to its diagonal element that is not rounding.
_MIN_RELATIVE_PIVOT = 1e-13
# Fewest samples for the noise scale from residuals.
_MIN_SAMPLES_FOR_NOISE_SCALE = 20


@njit(cache=True)
def products_vector(wrench, motion):
    """Return z (19,) of a sample with motion [s, omega, alpha] (9,)."""
    z, omega = np.ones(19), motion[3:6]
    z[1:7], z[7:10], z[10:13] = wrench, motion[:3], motion[6:]
    for i in range(3):
        for j in range(i + 1):
            z[OMEGA_PRODUCT_INDICES[i, j]] = omega[i] * omega[j]
    return z


@njit(cache=True)
def forget_samples(memory, theta, information, forgetting):
    """Multiply the sums in the memory by `forgetting`, and centre the prior at theta (16,)."""
    memory[:-1] *= forgetting
    memory[-1, :16] = information * theta


@njit(cache=True)
def residual_products(Z, theta, T):
    """Return the sum (6, 6) of r r^T, where r = F - [E V] theta is the residual."""
    L = np.zeros((6, 19))
    for c in range(6):
        L[c] = -np.dot(theta, T[c])
        L[c, 1 + c] += 1.0
    return np.dot(np.dot(L, Z), L.T)


@njit(cache=True)
def noise_products(Z, noise_std, motion_std):
    """Return the part Q (19, 19) of Z, the sum of z z^T, that noise is expected to cause."""
    Q = np.zeros((19, 19))
    for k in range(6):
        Q[1 + k, 1 + k] = Z[0, 0] * noise_std[k] ** 2
    for k in range(3):
        Q[7 + k, 7 + k] = Z[0, 0] * motion_std[k] ** 2
        Q[10 + k, 10 + k] = Z[0, 0] * motion_std[6 + k] ** 2
        # The derivative of w_i w_k by w_k is w_i, or 2 w_i for i = k.
        for i in range(3):
            for j in range(3):
                both = (1.0 + (i == k)) * (1.0 + (j == k)) * Z[0, OMEGA_PRODUCT_INDICES[i, j]]
                row, column = OMEGA_PRODUCT_INDICES[i, k], OMEGA_PRODUCT_INDICES[j, k]
                Q[row, column] += motion_std[3 + k] ** 2 * both
    return Q


@njit(cache=True)
def weighted_normal_equations(Z, W, T):
    """Return the sums of Y^T W X and Y^T W F; Z sums y z^T, and Y, X are [E V] of y, z."""
    TZ = np.dot(T.reshape(96, 19), Z).reshape(6, 304)
    weighted = np.dot(W, TZ).reshape(6, 16, 19)
    gram, right = np.zeros((16, 16)), np.zeros(16)
    for c in range(6):
        gram += np.dot(weighted[c], T[c].T)
        right += weighted[c, :, 1 + c]
    return gram, right


@njit(cache=True)
def solve_with_ridge(A, b):
    for i in range(A.shape[0]):
        A[i, i] *= 1.0 + _RELATIVE_RIDGE
    return np.linalg.solve(A, b)


class MomentEstimator(RecursiveEstimator):
    """Recursive estimator whose memory is the sum of z z^T of Eq. (T18), and a row of the prior."""

    def initial_memory(self, theta: Array) -> Array:
        memory = np.zeros((20, 19))
        memory[-1, :16] = theta / self._prior
        return memory

    def _residual_rms(self) -> Array:
        squares = residual_products(self._memory[:19], self._theta, regressor_coefficients())
        return np.sqrt(np.maximum(np.diag(squares), 0.0) / self._memory[0, 0])

    def _limit_variances_to_prior(self, covariance: Array) -> Array:
        shrink = 1.0 / np.maximum(1.0, np.sqrt(np.diag(covariance) / self._prior))
        return np.asarray(covariance * np.outer(shrink, shrink))


@njit(cache=True)
def select_compensated_parameters(G, N, strength):
    """Return (16,) 1 for parameters whose noise N can be removed from G, otherwise 0."""
    taper, K = np.ones(16), np.zeros((16, 16))
    for i in range(16):
        for attempt in range(2):
            taper[i] = 1.0 - attempt
            for j in range(i):
                total = G[i, j] - strength * taper[i] * taper[j] * N[i, j]
                for k in range(j):
                    total -= K[i, k] * K[j, k]
                K[i, j] = total / K[j, j]
            total = G[i, i] - strength * taper[i] * N[i, i]
            for k in range(i):
                total -= K[i, k] * K[i, k]
            if total > _MIN_RELATIVE_PIVOT * G[i, i]:
                break
        if not total > _MIN_RELATIVE_PIVOT * G[i, i]:
            return np.zeros(16)
        K[i, i] = math.sqrt(total)
    return taper


@njit(cache=True)
def rtls_normal_equations(Z, theta, noise_std, motion_std, T):
    """Return G, g, the part N of G from noise, and the ratio of actual to given noise."""
    Q = noise_products(Z, noise_std, motion_std)
    W = np.linalg.inv(residual_products(Q, theta, T) / Z[0, 0])
    scale = max(0.0, (W * residual_products(Z, theta, T)).sum()) / (6.0 * Z[0, 0])
    G, g = weighted_normal_equations(Z, W, T)
    return G, g, weighted_normal_equations(Q, W, T)[0], scale


@njit(cache=True)
def rtls_update(theta, memory, samples, noise_std, motion_std, forgetting, information, T):
    """Update theta (16,) and memory (20, 19) of recursive total least squares by N samples.

    `noise_std` (6,) and `motion_std` (9,) are standard deviations of the wrench and of [s, omega,
    alpha]; `information` (16,) are inverse variances of the prior; T: `regressor_coefficients`.
    """
    Z = memory[:19]
    for n in range(len(samples)):
        if forgetting < 1.0:
            forget_samples(memory, theta, information, forgetting)
        z = products_vector(samples[n, SAMPLE_WRENCH], samples[n, SAMPLE_MOTION])
        Z += np.outer(z, z)
        G, g, N, scale = rtls_normal_equations(Z, theta, noise_std, motion_std, T)
        G += np.diag(information)
        g += memory[19, :16]
        gain = 1.0 - _MIN_INFORMATION_EXCESS * math.sqrt(2.0 / Z[0, 0])
        if gain > 0.0:
            taper = select_compensated_parameters(G, N, scale / gain)
            taper[:6] = 0.0
            g += scale * taper * np.dot(N, taper * theta)
        theta[:] = solve_with_ridge(G, g)


class RecursiveTotalLeastSquares(MomentEstimator):
    """Recursive total least squares, which allows for noise of the measured motion.

    `motion_std` (9,) is the noise of s [m/s^2], omega [rad/s], alpha [rad/s^2].
    """

    method = "recursive total least squares"
    allows_for_noisy_motion = True

    def __init__(
        self,
        noise_std: ArrayLike,
        motion_std: ArrayLike,
        forgetting: float = 1.0,
        prior_std: ArrayLike = PRIOR_STD,
        bound: float = MAX_SETTLED_RELATIVE_STD,
    ) -> None:
        self._motion_std = nonnegative_array("motion_std", motion_std, 9)
        super().__init__(noise_std, forgetting, prior_std, bound)

    @classmethod
    def for_noise(
        cls, noise_std: ArrayLike, motion_std: ArrayLike, *, forgetting: float, bound: float
    ) -> RecursiveTotalLeastSquares:
        return cls(noise_std, motion_std, forgetting=forgetting, bound=bound)

    @property
    def noise_scale(self) -> float:
        """Ratio of observed to specified noise variances."""
        return self._normal_equations(self._theta, self._memory)[2]

    def covariance_of(self, theta: Array, memory: Array) -> Array:
        """Return the covariance (16, 16); poorly excited directions keep the prior's variance."""
        samples, information = memory[0, 0], np.diag(1.0 / self._prior)
        G, N, scale = self._normal_equations(theta, memory)
        root = np.linalg.inv(_regularized_cholesky(G + information))
        shares, vectors = np.linalg.eigh(scale * root @ N @ root.T)
        directions = root.T @ vectors
        excess = 1.0 - shares
        excited = (shares < _MIN_RELATIVE_PIVOT) | (
            excess > _MIN_INFORMATION_EXCESS * math.sqrt(2.0 / max(samples, 1.0))
        )
        inverse = (directions[:, excited] / excess[excited]) @ directions[:, excited].T
        factor = inverse @ _regularized_cholesky(scale * G + information)
        unknown = directions[:, ~excited]
        unknown = unknown / np.sqrt(np.sum(unknown**2 / self._prior[:, None], axis=0))
        return self._limit_variances_to_prior(factor @ factor.T + unknown @ unknown.T)

    def _normal_equations(self, theta: Array, memory: Array) -> tuple[Array, Array, float]:
        if not memory[0, 0] > 0.0:
            return np.zeros((16, 16)), np.zeros((16, 16)), 1.0
        noise, T = (self._noise_std, self._motion_std), regressor_coefficients()
        G, _, N, scale = rtls_normal_equations(memory[:19], theta, *noise, T)
        return G, N, scale if memory[0, 0] > _MIN_SAMPLES_FOR_NOISE_SCALE else 1.0

    def _update_state(self, theta: Array, memory: Array, samples: Array) -> None:
        options = (self._noise_std, self._motion_std, self._forgetting, 1.0 / self._prior)
        rtls_update(theta, memory, samples, *options, regressor_coefficients())


def _regularized_cholesky(A: Array) -> Array:
    return np.asarray(np.linalg.cholesky(A + _MIN_RELATIVE_PIVOT * np.diag(np.diag(A))))


METHODS: Registry[type[RecursiveEstimator]] = Registry(
    "recursive estimator", {"rls": RecursiveLeastSquares, "rtls": RecursiveTotalLeastSquares}
)
"""Recursive estimators by name."""
