"""Recursive total least squares for the load and the offsets: noise in the measured motion too.

Least squares takes the matrix V of Eq. (5) for exact. Measured accelerations are noisy, V with
them, and the estimate is biased towards zero, the inertias most. Total least squares minimises

    J(theta) = (sum of weighted squares of F - [E V] theta) / (what noise of the stated levels makes
               of that sum) = (c - 2 g^T theta + theta^T G theta) / (n + theta^T N theta)

(Kubus, Kroeger, Wahl: On-line estimation of inertial parameters using a recursive total
least-squares approach, IROS 2008; Van Huffel, Vandewalle: The Total Least Squares Problem, SIAM
1991). G, g, c are the sums of least squares, N the expected share of the noise in G. Every column
has its own noise, and so do their correlations, because N is made from the derivatives of V by
s, omega and alpha; exact columns (the offsets, the structural zeros of V) have none. Only the
ratios of the noise levels matter: the minimum lambda of J is their common scale, about 1 if they
are right, less behind a filter that takes noise off all channels alike.

At the minimum (G - lambda N) theta = g. Each sample does one step G theta' = g + lambda N theta
of the inverse iteration, starting from the last estimate. As G >= N in the mean, J never grows
by it (it minimises a quadratic that touches J from above), so that a few samples suffice.

A row's weight is the inverse of the variance of its equation error, for the load as far as it is
known then: wide to begin with, so that the first samples do not weigh too much.

**Poor excitation.** Where G holds nothing but noise, G - lambda N vanishes and total least squares
knows no bound. Parameters are compensated only as far as the information of every combination of
them exceeds that of the noise by more than the noise of the sums themselves (4 times
sqrt(2 / samples), of the noise's information); a combination that does not has the prior's
variance. Forgetting brings back the information of the prior, about the present estimate.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from drake_teleop.errors import DrakeTeleopError
from drake_teleop.load.arrays import Array, checked
from drake_teleop.load.recursive import PRIOR_STD, SETTLED, RecursiveEstimator
from drake_teleop.load.regressor import regressor_into

# Rows of the memory: G (16), N (16), Q (16), g, [c, n, samples, -, -, -, variances of phi (10)].
_ROWS = 50
# Excess of information over noise, in units of sqrt(2 / samples), that compensation has to leave.
_EXCESS = 4.0
# Size of a load that is not known otherwise [m], for the weights.
_SIZE = 0.1
# The least pivot relative to its diagonal element: below it is rounding.
_PIVOT = 1e-13
# Share of the sum of squared wrenches below which a residual is rounding.
_RESOLUTION = 1e-14
# Samples from which on the residuals tell the scale of the noise.
_FEWEST = 20


@njit(cache=True)
def motion_noise_into(omega, motion_std, noise, D):
    """Writes the derivatives of V times the noise of the motion into D (9, 6, 10).

    Args:
        omega: (3,) angular velocity [rad/s]; V is linear in the rest.
        motion_std: (9,) standard deviations of [s; omega; alpha].
        noise: (9,) scratch.
        D: (9, 6, 10) one for each component of [s; omega; alpha]; those that do not depend on
            omega are from `constant_noise`, which also adds one for scratch.
    """
    for k in range(3):
        std = motion_std[3 + k]
        if std == 0.0:
            continue
        for i in range(9):
            noise[i] = 0.0
        # V is quadratic in omega: V(omega + d) - V(omega - d) is twice the derivative along d.
        for i in range(3):
            noise[3 + i] = omega[i]
        noise[3 + k] = omega[k] + std
        regressor_into(noise[:3], noise[3:6], noise[6:], D[3 + k])
        for c in range(6):
            for j in range(1, 10):
                D[3 + k, c, j] *= 0.5
        noise[3 + k] = omega[k] - std
        regressor_into(noise[:3], noise[3:6], noise[6:], D[9])
        for c in range(6):
            for j in range(1, 10):
                D[3 + k, c, j] -= 0.5 * D[9, c, j]


def constant_noise(motion_std: Array) -> Array:
    """(10, 6, 10): the derivatives of V by s and alpha times their noise; the last is scratch."""
    D, none = np.zeros((10, 6, 10)), np.zeros(3)
    for k in range(3):
        unit = np.eye(3)[k]
        regressor_into(motion_std[k] * unit, none, none, D[k])
        regressor_into(none, none, motion_std[6 + k] * unit, D[6 + k])
    return D


@njit(cache=True)
def equation_variance(c, theta, spread, noise_std, D):
    """Variance of the error of row c for a load theta[6:] +- spread (10,) variances."""
    first, last = (0, 4) if c < 3 else (1, 10)
    variance = noise_std[c] * noise_std[c]
    for k in range(9):
        error = 0.0
        for j in range(first, last):
            d = D[k, c, j]
            error += d * theta[6 + j]
            variance += d * d * spread[j]
        variance += error * error
    return variance


@njit(cache=True)
def factorise(A, L):
    """The inverse of the Cholesky factor of A (16, 16, lower half read) into L.

    A pivot that is rounding is replaced by a small one.
    """
    for i in range(16):
        for j in range(i):
            total = A[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            L[i, j] = total / L[j, j]
        total = A[i, i]
        for k in range(i):
            total -= L[i, k] * L[i, k]
        L[i, i] = math.sqrt(max(total, _PIVOT * A[i, i]))
    invert(L)


@njit(cache=True)
def invert(L):
    """Replaces the lower triangular L (16, 16) by its inverse."""
    for i in range(16):
        inverse = 1.0 / L[i, i]
        for j in range(i):
            total = 0.0
            for k in range(j, i):
                total -= L[i, k] * L[k, j]
            L[i, j] = total * inverse
        L[i, i] = inverse


@njit(cache=True)
def compensate(memory, strength, L, K, taper):
    """Marks in taper (16,) the parameters whose noise can be taken out of G: 1, else 0.

    They are such that G - strength N over them stays positive definite: its Cholesky factor is
    built in K (16, 16), and a parameter at which it would break down is left out. If that does not
    help, none is taken. In the end K is the inverse factor; L is that of G.
    """
    for i in range(16):
        for attempt in range(2):
            taper[i] = 1.0 - attempt
            for j in range(i):
                total = memory[i, j] - strength * taper[i] * taper[j] * memory[16 + i, j]
                for k in range(j):
                    total -= K[i, k] * K[j, k]
                K[i, j] = total / K[j, j]
            total = memory[i, i] - strength * taper[i] * memory[16 + i, i]
            for k in range(i):
                total -= K[i, k] * K[i, k]
            if total > _PIVOT * memory[i, i]:
                break
        if not total > _PIVOT * memory[i, i]:
            taper[:] = 0.0
            K[:] = L
            return
        K[i, i] = math.sqrt(total)
    invert(K)


@njit(cache=True)
def solve(L, right, work, x):
    """x = A^-1 right, with the inverse factor of `factorise`."""
    for i in range(16):
        total = 0.0
        for k in range(i + 1):
            total += L[i, k] * right[k]
        work[i] = total
    for i in range(16):
        x[i] = 0.0
    for k in range(16):
        for i in range(k + 1):
            x[i] += L[k, i] * work[k]


@njit(cache=True)
def rtls_update(
    theta,
    memory,
    sample,
    noise_std,
    motion_std,
    forgetting,
    prior,
    V,
    D,
    L,
    K,
    scores,
    vectors,
    squares,
):
    """One sample, in place; compiled, allocates nothing, checks nothing.

    Args:
        theta: (16,) [offsets; phi], updated.
        memory: (50, 16), updated.
        sample: at least 15 numbers [wrench, s, omega, alpha].
        noise_std: (6,) of the wrench [N, N m].
        motion_std: (9,) of s, omega, alpha.
        forgetting: factor per sample on the weight of the past.
        prior: (16,) least information on each parameter.
        V: (6, 10), D: (10, 6, 10) from `constant_noise`, L, K: (16, 16), scores: (9, 16),
            vectors: (4, 16): scratch.
        squares: (6,) sums of squared residuals, forgotten likewise, updated.
    """
    right, sums = memory[48], memory[49]
    work, goal, taper, scratch = vectors[0], vectors[1], vectors[2], vectors[3]
    if forgetting < 1.0:
        fresh = 1.0 - forgetting
        for i in range(16):
            for j in range(16):
                memory[i, j] *= forgetting
                memory[16 + i, j] *= forgetting
                memory[32 + i, j] *= forgetting * forgetting
            memory[i, i] += fresh * prior[i]
            memory[32 + i, i] += (1.0 - forgetting * forgetting) * prior[i]
            right[i] = forgetting * right[i] + fresh * prior[i] * theta[i]
        for i in range(3):
            sums[i] *= forgetting
        for i in range(16):
            sums[0] += fresh * prior[i] * theta[i] * theta[i]
        for c in range(6):
            squares[c] *= forgetting

    regressor_into(sample[6:9], sample[9:12], sample[12:15], V)
    motion_noise_into(sample[9:12], motion_std, scratch, D)
    sums[2] += 1.0
    for m in range(9):
        for i in range(16):
            scores[m, i] = 0.0
    for c in range(6):
        first, last = (0, 4) if c < 3 else (1, 10)
        weight = 1.0 / equation_variance(c, theta, memory[49, 6:], noise_std, D)
        f = sample[c]
        sums[0] += weight * f * f
        sums[1] += weight * noise_std[c] * noise_std[c]
        memory[c, c] += weight
        own = (weight * noise_std[c]) ** 2
        memory[32 + c, c] += own
        right[c] += weight * f
        for j in range(first, last):
            v = weight * V[c, j]
            right[6 + j] += v * f
            memory[6 + j, c] += v
            memory[38 + j, c] += own * V[c, j]
            for k in range(first, j + 1):
                memory[6 + j, 6 + k] += v * V[c, k]
                memory[38 + j, 6 + k] += own * V[c, j] * V[c, k]
        for m in range(9):
            error = 0.0
            for j in range(first, last):
                d = weight * D[m, c, j]
                if d != 0.0:
                    error += d * theta[6 + j]
                    for k in range(first, j + 1):
                        memory[22 + j, 6 + k] += d * D[m, c, k]
            scores[m, c] += error
            for j in range(first, last):
                scores[m, 6 + j] += error * V[c, j]
    # What the noise of each component of the motion does to all rows at once.
    for m in range(9):
        for i in range(16):
            for j in range(i + 1):
                memory[32 + i, j] += scores[m, i] * scores[m, j]

    factorise(memory, L)

    # lambda = J(theta), and N theta with the parameters that are not excited left out.
    above, below = sums[0], sums[1]
    for i in range(16):
        Gx, Nx = memory[i, i] * theta[i], memory[16 + i, i] * theta[i]
        for j in range(i):
            Gx += 2.0 * memory[i, j] * theta[j]
            Nx += 2.0 * memory[16 + i, j] * theta[j]
        above += theta[i] * (Gx - 2.0 * right[i])
        below += theta[i] * Nx
    scale = max(0.0, above) / below
    kept = 1.0 - _EXCESS * math.sqrt(2.0 / sums[2])
    for i in range(16):
        goal[i] = right[i]
        taper[i] = 0.0
    if kept > 0.0:
        compensate(memory, scale / kept, L, K, taper)
        for j in range(6, 16):
            memory[49, j] = 0.0
            for i in range(j, 16):
                memory[49, j] += K[i, j] * K[i, j]
        mass = abs(theta[6]) + math.sqrt(memory[49, 6])
        first_moment = 0.0
        for j in range(7, 10):
            first_moment = max(first_moment, abs(theta[j]) + math.sqrt(memory[49, j]))
        length = max(first_moment / mass, _SIZE)
        for j in range(7, 16):
            if taper[j] == 0.0:
                natural = mass * length if j < 10 else mass * length * length
                memory[49, j] = min(max(memory[49, j], natural * natural), 1.0 / prior[j])
    for i in range(6, 16):
        goal[i] += scale * taper[i] * memory[16 + i, i] * taper[i] * theta[i]
        for j in range(6, i):
            compensation = scale * taper[i] * memory[16 + i, j] * taper[j]
            goal[i] += compensation * theta[j]
            goal[j] += compensation * theta[i]
    solve(L, goal, work, theta)

    for c in range(6):
        first, last = (0, 4) if c < 3 else (1, 10)
        residual = sample[c] - theta[c]
        for j in range(first, last):
            residual -= V[c, j] * theta[6 + j]
        squares[c] += residual * residual


@njit(cache=True)
def _rtls_over(
    theta,
    memory,
    samples,
    noise_std,
    motion_std,
    forgetting,
    prior,
    V,
    D,
    L,
    K,
    scores,
    vectors,
    squares,
):
    """`rtls_update` for each row of samples (N, 15)."""
    for k in range(samples.shape[0]):
        rtls_update(
            theta,
            memory,
            samples[k],
            noise_std,
            motion_std,
            forgetting,
            prior,
            V,
            D,
            L,
            K,
            scores,
            vectors,
            squares,
        )


class RecursiveTotalLeastSquares(RecursiveEstimator):
    """Recursive total least squares: for noise in the measured motion, see the module.

    The memory is the sums. The update takes the same number of operations for every sample.

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

    def __init__(
        self,
        noise_std: ArrayLike,
        motion_std: ArrayLike,
        forgetting: float = 1.0,
        prior_std: ArrayLike = PRIOR_STD,
        bound: float = SETTLED,
    ) -> None:
        self._motion_std = not_negative("motion_std", motion_std, 9)
        super().__init__(noise_std, forgetting, prior_std, bound)
        self._constants = (
            self._noise_std,
            self._motion_std,
            self._forgetting,
            1.0 / self._prior,
            np.empty((6, 10)),
            constant_noise(self._motion_std),
            np.zeros((16, 16)),
            np.zeros((16, 16)),
            np.zeros((9, 16)),
            np.empty((4, 16)),
        )

    def initial_memory(self, theta: Array) -> Array:
        """(50, 16): the information of the prior about theta (16,)."""
        memory, information = np.zeros((_ROWS, 16)), 1.0 / self._prior
        memory[:16] = memory[32:48] = np.diag(information)
        memory[48] = information * theta
        memory[49, 0] = theta @ memory[48]
        memory[49, 6:] = self._prior[6:]
        return memory

    @property
    def noise_scale(self) -> float:
        """lambda: the factor on the stated variances of all noise that the residuals show."""
        return _noise_scale(self._theta, self._memory)

    def covariance_of(self, theta: Array, memory: Array) -> Array:
        """(16, 16) lambda H^-1 Q H^-1, H = G - lambda N; the prior's where H holds no more.

        Q is the covariance of g - (G - N) theta: what the noise of the wrench, and that of the
        motion in all rows at once, does to it.
        """
        G, N, Q = (_whole(memory[i : i + 16]) for i in (0, 16, 32))
        samples = memory[49, 2]
        scale = _noise_scale(theta, memory) if samples > _FEWEST else 1.0
        root = np.linalg.inv(_root(G))
        shares, vectors = np.linalg.eigh(scale * root @ N @ root.T)
        directions = root.T @ vectors
        excess = 1.0 - shares
        excited = (shares < _PIVOT) | (excess > _EXCESS * math.sqrt(2.0 / max(samples, 1.0)))
        inverse = (directions[:, excited] / excess[excited]) @ directions[:, excited].T
        information = np.diag(1.0 / self._prior)
        half = inverse @ _root(scale * (Q - information) + information)
        unknown = directions[:, ~excited]
        unknown = unknown / np.sqrt(np.sum(unknown**2 / self._prior[:, None], axis=0))
        covariance = half @ half.T + unknown @ unknown.T
        # Forgetting's mixture of old and new can exceed the prior, which bounds what is unknown.
        wider = np.sqrt(np.diag(covariance) / self._prior)
        shrink = 1.0 / np.maximum(1.0, wider)
        return np.asarray(covariance * np.outer(shrink, shrink))

    def update_into(self, theta: Array, memory: Array, sample: Array) -> None:
        """See `RecursiveEstimator`; memory: (50, 16)."""
        rtls_update(theta, memory, sample, *self._constants, self._squares)

    def _learn(self, samples: Array) -> None:
        _rtls_over(self._theta, self._memory, samples, *self._constants, self._squares)


def not_negative(name: str, value: ArrayLike, *shape: int) -> Array:
    """`value` as a `checked` array without negative numbers."""
    array = checked(name, value, *shape)
    if (array < 0.0).any():
        raise DrakeTeleopError("is negative", where=name)
    return array


def _whole(lower: Array) -> Array:
    """A symmetric matrix from its lower half."""
    return np.asarray(np.tril(lower) + np.tril(lower, -1).T)


def _root(A: Array) -> Array:
    """The Cholesky factor of A, its diagonal raised by what is rounding."""
    return np.asarray(np.linalg.cholesky(A + _PIVOT * np.diag(np.diag(A))))


def _noise_scale(theta: Array, memory: Array) -> float:
    G, N, (right, sums) = _whole(memory[:16]), _whole(memory[16:32]), memory[48:]
    above = max(sums[0] - 2.0 * theta @ right + theta @ G @ theta, _RESOLUTION * sums[0])
    return float(above / (sums[1] + theta @ N @ theta)) if sums[1] > 0.0 else 1.0
