"""Recursive total least squares for the load and the offsets: noise in the measured motion too.

Least squares takes the matrix V of Eq. (5) for exact. Measured accelerations are noisy, V with
them, and the estimate is biased towards zero, the inertias most. Total least squares minimises

    lambda = (sum of r^T W r, r = F - [E V] theta) / (what noise of the stated levels makes of it)
           = (c - 2 g^T theta + theta^T G theta) / (n + theta^T N theta)

(Kubus, Kroeger, Wahl: On-line estimation of inertial parameters using a recursive total
least-squares approach, IROS 2008; Van Huffel, Vandewalle: The Total Least Squares Problem, SIAM
1991). G, g, c are the sums of least squares, N the expected share of the noise in G. Every column
has its own noise, and so do their correlations; exact columns (the offsets, the structural zeros of
V) have none. Only the ratios of the noise levels matter: lambda is their common scale, about 1 if
they are right, less behind a filter that takes noise off all channels alike. W (6, 6) is the
inverse covariance of the six rows' errors for the present theta, see `recursive_moments`.

At the minimum (G - lambda N) theta = g. Each sample does one step G theta' = g + lambda N theta
of the inverse iteration, starting from the last estimate. As G >= N in the mean, for given W lambda
never grows by it (it minimises a quadratic that touches the sum from above), so that a few samples
suffice: from then on it is the batch's `total_least_squares` of the samples so far.

**Poor excitation.** Where G holds nothing but noise, G - lambda N vanishes and total least squares
knows no bound. Parameters are compensated only as far as the information of every combination of
them exceeds that of the noise by more than the noise of the sums themselves (4 times
sqrt(2 / samples), of the noise's information); a combination that does not has the prior's
variance. Forgetting brings back the information of the prior, about the present estimate.
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
    add_product,
    eliminate,
    forget,
    invert,
    noise_products,
    observe,
    residual_products,
    scratch,
    solve,
    terms,
    weighted_gram,
    weighted_right,
)
from drake_teleop.load.sample import MOTION, WRENCH

# Excess of information over noise, in units of sqrt(2 / samples), that compensation has to leave.
_EXCESS = 4.0
# The least pivot relative to its diagonal element: below it is rounding.
_PIVOT = 1e-13
# Samples from which on the residuals tell the scale of the noise.
_FEWEST = 20


@njit(cache=True)
def compensable(G, N, strength, K, taper):
    """Marks in taper (16,) the parameters whose noise can be taken out of G: 1, else 0.

    They are such that G - strength N over them stays positive definite: its Cholesky factor is
    built in K (16, 16), and a parameter at which it would break down is left out. If that does not
    help, none is taken. All are tried at once first, by elimination, which is faster.
    """
    taper[:] = 1.0
    for i in range(16):
        for j in range(16):
            K[i, j] = G[i, j] - strength * N[i, j]
    eliminate(K)
    definite = True
    for i in range(16):
        definite &= K[i, i] > _PIVOT * G[i, i]
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
            if total > _PIVOT * G[i, i]:
                break
        if not total > _PIVOT * G[i, i]:
            taper[:] = 0.0
            return
        K[i, i] = math.sqrt(total)


@njit(cache=True)
def rtls_normal_equations(Z, theta, noise_std, motion_std, index, factors, space, Q, G, N):
    """Writes G and g into G (16, >= 17), N into N (16, 16); returns lambda for theta.

    Args:
        Z: (19, 19) sum of z z^T.
        theta: (16,) estimate, for the weights.
        noise_std: (6,) of the wrench [N, N m].
        motion_std: (9,) of [s, omega, alpha].
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
    """One sample after the other, in place; compiled, checks nothing.

    Args:
        theta: (16,) [offsets; phi], updated.
        memory: (20, 19) sum of z z^T, and prior theta_0; updated.
        samples: (N, at least 15) [wrench, s, omega, alpha].
        forgetting: factor per sample on the weight of the past.
        information: (16,) of the prior.
        noise_std, motion_std, index, factors: as for `rtls_normal_equations`.
    """
    space, Q, z, taper = scratch(), np.empty((19, 19)), np.empty(19), np.empty(16)
    G, N, K = np.empty((16, 17)), np.empty((16, 16)), np.empty((16, 16))
    Z, options = memory[:19], (noise_std, motion_std, index, factors)
    for n in range(len(samples)):
        if forgetting < 1.0:
            forget(memory, theta, information, forgetting)
        observe(samples[n, WRENCH], samples[n, MOTION], z)
        add_product(z, z, Z)
        scale = rtls_normal_equations(Z, theta, *options, space, Q, G, N)
        for i in range(16):
            G[i, i] += information[i]
            G[i, 16] += memory[19, i]
        kept = 1.0 - _EXCESS * math.sqrt(2.0 / Z[0, 0])
        if kept > 0.0:
            compensable(G, N, scale / kept, K, taper)
            for i in range(6, 16):
                for j in range(6, 16):
                    G[i, 16] += scale * taper[i] * taper[j] * N[i, j] * theta[j]
        solve(G)
        for i in range(16):
            theta[i] = G[i, 16]


class RecursiveTotalLeastSquares(MomentEstimator):
    """Recursive total least squares: for noise in the measured motion, see the module.

    The update takes the same number of operations for every sample.

    Args:
        noise_std: (6,) standard deviations of the wrench channels [N, N m].
        motion_std: (9,) of s [m/s^2], omega [rad/s] and alpha [rad/s^2]; zeros give least squares.
        forgetting: factor per sample on the weight of the past, 0 < forgetting <= 1.
        prior_std: (16,) standard deviations of [offsets; phi] to begin with.
        bound: of `settled`.

    Raises:
        DrakeTeleopError: for other shapes or values.
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
        """One for noise of (6,) wrench and (9,) motion, as `__init__` takes them."""
        return cls(noise_std, motion_std, forgetting=forgetting, bound=bound)

    @property
    def noise_scale(self) -> float:
        """lambda: the factor on the stated variances of all noise that the residuals show."""
        return self._normal_equations(self._theta, self._memory)[2]

    def covariance_of(self, theta: Array, memory: Array) -> Array:
        """(16, 16) lambda H^-1 G H^-1, H = G - lambda N; the prior's where H holds no more."""
        samples, information = memory[0, 0], np.diag(1.0 / self._prior)
        G, N, scale = self._normal_equations(theta, memory)
        root = np.linalg.inv(_root(G + information))
        shares, vectors = np.linalg.eigh(scale * root @ N @ root.T)
        directions = root.T @ vectors
        excess = 1.0 - shares
        excited = (shares < _PIVOT) | (excess > _EXCESS * math.sqrt(2.0 / max(samples, 1.0)))
        inverse = (directions[:, excited] / excess[excited]) @ directions[:, excited].T
        half = inverse @ _root(scale * G + information)
        unknown = directions[:, ~excited]
        unknown = unknown / np.sqrt(np.sum(unknown**2 / self._prior[:, None], axis=0))
        return self._within_prior(half @ half.T + unknown @ unknown.T)

    def _normal_equations(self, theta: Array, memory: Array) -> tuple[Array, Array, float]:
        """G and N (16, 16), without the prior, and lambda, 1 while there are too few samples."""
        G, N, Q = np.zeros((16, 17)), np.zeros((16, 16)), np.empty((19, 19))
        if not memory[0, 0] > 0.0:
            return G[:, :16], N, 1.0
        options = (self._noise_std, self._motion_std, *terms(), scratch(), Q)
        scale = rtls_normal_equations(memory[:19], theta, *options, G, N)
        return G[:, :16], N, scale if memory[0, 0] > _FEWEST else 1.0

    def _learn(self, theta: Array, memory: Array, samples: Array) -> None:
        options = (self._noise_std, self._motion_std, self._forgetting, 1.0 / self._prior)
        rtls_update(theta, memory, samples, *options, *terms())


def _root(A: Array) -> Array:
    """The Cholesky factor of A, its diagonal raised by what is rounding."""
    return np.asarray(np.linalg.cholesky(A + _PIVOT * np.diag(np.diag(A))))
