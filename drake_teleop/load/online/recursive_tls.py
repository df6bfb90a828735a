"""Recursive total least squares for load and offsets: noise in the measured motion too, Eq. (T18).

Minimises lambda, the weighted squared residuals over their expected value (Kubus, Kroeger, Wahl,
IROS 2008). G and g are the sums of least squares, N the expected noise in G. Each sample does one
step G theta' = g + lambda N theta of the inverse iteration.

Parameters are compensated only where the information exceeds that of the noise by 4
sqrt(2 / samples) of it; other combinations have the prior's variance.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from drake_teleop.common.arrays import Array, checked
from drake_teleop.common.compiled import njit
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.online.recursive import PRIOR_STD, SETTLED
from drake_teleop.load.online.recursive_moments import (
    MomentEstimator,
    add_outer_product,
    eliminate,
    forget,
    invert,
    noise_products,
    residual_products,
    scratch,
    solve,
    terms,
    weighted_gram,
    weighted_right,
    write_z,
)
from drake_teleop.load.sample import MOTION, WRENCH

# Smallest excess of information over noise after compensation, in units of sqrt(2 / samples).
_EXCESS = 4.0
# Smallest pivot relative to its diagonal element that is not rounding.
_MIN_PIVOT = 1e-13
# Fewest samples for the noise scale from residuals.
_MIN_SCALE_SAMPLES = 20


@njit(cache=True)
def select_compensated(G, N, strength, K, taper):
    """Set taper (16,) to 1 for parameters with compensated noise, otherwise to 0.

    G - strength N over them is positive definite; K (16, 16) is scratch.
    """
    taper[:] = 1.0
    for i in range(16):
        for j in range(16):
            K[i, j] = G[i, j] - strength * N[i, j]
    eliminate(K)
    definite = True
    for i in range(16):
        definite &= K[i, i] > _MIN_PIVOT * G[i, i]
    if definite:
        return
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
            if total > _MIN_PIVOT * G[i, i]:
                break
        if not total > _MIN_PIVOT * G[i, i]:
            taper[:] = 0.0
            return
        K[i, i] = math.sqrt(total)


@njit(cache=True)
def rtls_normal_equations(Z, theta, noise_std, motion_std, index, factors, space, Q, G, N):
    """Write G and g into G (16, >= 17) and N into N (16, 16); return lambda for theta.

    Args:
        Z: (19, 19) sum of z z^T.
        noise_std, motion_std: (6,) of the wrench, (9,) of [s, omega, alpha] [SI].
        index, factors: from `terms`, space: from `scratch`, Q: (19, 19) scratch.
    """
    E, g, L, LZ, inverse, S, W = space
    noise_products(Z, noise_std, motion_std, Q)
    residual_products(Q, theta, index, factors, L, LZ, S)
    for c in range(6):
        for d in range(6):
            S[c, d] /= Z[0, 0]
    invert(S, inverse, W)
    residual_products(Z, theta, index, factors, L, LZ, S)
    scale = 0.0
    for c in range(6):
        for d in range(6):
            scale += W[c, d] * S[c, d]
    weighted_gram(Z, W, index, factors, E, G, 0)
    weighted_gram(Q, W, index, factors, E, N, 0)
    weighted_right(Z[:, 13:].T, W, index, factors, g)
    for i in range(16):
        G[i, 16] = g[i]
    return max(0.0, scale) / (6.0 * Z[0, 0])


@njit(cache=True)
def rtls_update(
    theta, memory, samples, noise_std, motion_std, forgetting, information, index, factors
):
    """Update the estimate by each sample; compiled, without checks.

    Args:
        theta: (16,) [offsets; phi], updated.
        memory: (20, 19) sum of z z^T, and the prior's part; updated.
        samples: (N, at least 15), see `regressor`.
        forgetting, information: factor per sample, and (16,) of the prior.
    """
    space, Q, z, taper = scratch(), np.empty((19, 19)), np.empty(19), np.empty(16)
    G, N, K = np.empty((16, 17)), np.empty((16, 16)), np.empty((16, 16))
    Z, options = memory[:19], (noise_std, motion_std, index, factors)
    for n in range(len(samples)):
        if forgetting < 1.0:
            forget(memory, theta, information, forgetting)
        write_z(samples[n, WRENCH], samples[n, MOTION], z)
        add_outer_product(z, z, Z)
        scale = rtls_normal_equations(Z, theta, *options, space, Q, G, N)
        for i in range(16):
            G[i, i] += information[i]
            G[i, 16] += memory[19, i]
        gain = 1.0 - _EXCESS * math.sqrt(2.0 / Z[0, 0])
        if gain > 0.0:
            select_compensated(G, N, scale / gain, K, taper)
            for i in range(6, 16):
                for j in range(6, 16):
                    G[i, 16] += scale * taper[i] * taper[j] * N[i, j] * theta[j]
        solve(G)
        for i in range(16):
            theta[i] = G[i, 16]


class RecursiveTotalLeastSquares(MomentEstimator):
    """Recursive total least squares with constant cost per sample.

    Args:
        noise_std, forgetting, prior_std, bound: as for `RecursiveEstimator`.
        motion_std: (9,) of s [m/s^2], omega [rad/s] and alpha [rad/s^2]; zeros give least squares.
    """

    method = "recursive total least squares"
    allows_for_noisy_motion = True

    def __init__(
        self,
        noise_std: ArrayLike,
        motion_std: ArrayLike,
        forgetting: float = 1.0,
        prior_std: ArrayLike = PRIOR_STD,
        bound: float = SETTLED,
    ) -> None:
        self._motion_std = checked("motion_std", motion_std, 9)
        if (self._motion_std < 0.0).any():
            raise DrakeTeleopError("is negative", where="motion_std")
        super().__init__(noise_std, forgetting, prior_std, bound)

    @classmethod
    def for_noise(
        cls, noise_std: ArrayLike, motion_std: ArrayLike, *, forgetting: float, bound: float
    ) -> RecursiveTotalLeastSquares:
        """Return an estimator for noise of (6,) wrench and (9,) motion."""
        return cls(noise_std, motion_std, forgetting=forgetting, bound=bound)

    @property
    def noise_scale(self) -> float:
        """Ratio lambda of observed to specified noise variances."""
        return self._normal_equations(self._theta, self._memory)[2]

    def covariance_of(self, theta: Array, memory: Array) -> Array:
        """Return lambda H^-1 G H^-1 (16, 16), H = G - lambda N.

        Directions without sufficient information get the prior's variance.
        """
        samples, information = memory[0, 0], np.diag(1.0 / self._prior)
        G, N, scale = self._normal_equations(theta, memory)
        root = np.linalg.inv(_cholesky(G + information))
        shares, vectors = np.linalg.eigh(scale * root @ N @ root.T)
        directions = root.T @ vectors
        excess = 1.0 - shares
        excited = (shares < _MIN_PIVOT) | (excess > _EXCESS * math.sqrt(2.0 / max(samples, 1.0)))
        inverse = (directions[:, excited] / excess[excited]) @ directions[:, excited].T
        factor = inverse @ _cholesky(scale * G + information)
        unknown = directions[:, ~excited]
        unknown = unknown / np.sqrt(np.sum(unknown**2 / self._prior[:, None], axis=0))
        return self._within_prior(factor @ factor.T + unknown @ unknown.T)

    def _normal_equations(self, theta: Array, memory: Array) -> tuple[Array, Array, float]:
        """Return G and N (16, 16) without prior, and lambda (1 for few samples)."""
        G, N, Q = np.zeros((16, 17)), np.zeros((16, 16)), np.empty((19, 19))
        if not memory[0, 0] > 0.0:
            return G[:, :16], N, 1.0
        options = (self._noise_std, self._motion_std, *terms(), scratch(), Q)
        scale = rtls_normal_equations(memory[:19], theta, *options, G, N)
        return G[:, :16], N, scale if memory[0, 0] > _MIN_SCALE_SAMPLES else 1.0

    def _learn(self, theta: Array, memory: Array, samples: Array) -> None:
        options = (self._noise_std, self._motion_std, self._forgetting, 1.0 / self._prior)
        rtls_update(theta, memory, samples, *options, *terms())


def _cholesky(A: Array) -> Array:
    """Return the Cholesky factor of A with its diagonal raised by rounding."""
    return np.asarray(np.linalg.cholesky(A + _MIN_PIVOT * np.diag(np.diag(A))))
