"""Recursive instrumental variables for the load and the offsets: a second view of the motion.

Least squares correlates the equation errors with V of Eq. (5), which carries the noise that made
them: hence its bias. Instrumental variables correlate them with Z, the same matrix from another
source whose noise is independent: the commanded motion, or derivatives of the encoders' readings
(Kubus, Kroeger, Wahl: On-line rigid object recognition and pose estimation based on inertial
parameters, IROS 2007; Ljung, System Identification, section 7.6). No noise level of the motion has
to be known for the estimate to be free of bias, and the instruments may be off: a wrong instrument
costs precision only, as long as its error has nothing to do with the noise of the measured motion.

With the sums M = Z^T W Z, R = Z^T W X, g = Z^T W F over the samples, X = [E V],
Z = [E V(instruments)] and W the inverse noise of the wrench, the estimate is that of two-stage
least squares,

    (R^T M^-1 R + prior) theta = R^T M^-1 g + prior theta_0,

which is R^-1 g as soon as the motion outweighs the prior, and unlike R^-1 g has no pole on the way.
Weak instruments make R^T M^-1 R small: the estimate stays with the prior, and its variance large.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from drake_teleop.load.arrays import Array
from drake_teleop.load.recursive import PRIOR_STD, SETTLED, RecursiveEstimator
from drake_teleop.load.recursive_tls import factorise, solve
from drake_teleop.load.regressor import regressor_into

# Rows of the memory: M of each channel (6 x 16), R (16), g, prior information times theta_0,
# [variance of each channel's equation error (6), samples].
_ROWS = 115
# Share of the instruments' own information by which M is raised, against rounding.
_RIDGE = 1e-9
# Samples from which on the residuals tell the scale of the noise.
_FEWEST = 20


@njit(cache=True)
def riv_update(
    theta, memory, sample, noise_std, forgetting, prior, V, Z, A, L, B, vectors, squares
):
    """One sample, in place; compiled, allocates nothing, checks nothing.

    Args:
        theta: (16,) [offsets; phi], updated.
        memory: (115, 16), updated.
        sample: 24 numbers [wrench, s, omega, alpha, instruments (s, omega, alpha)].
        noise_std: (6,) of the wrench [N, N m].
        forgetting: factor per sample on the weight of the past.
        prior: (16,) information on each parameter.
        V, Z: (6, 10), A, L, B: (16, 16), vectors: (2, 16): scratch.
        squares: (6,) sums of squared residuals, forgotten likewise, updated.
    """
    right, start, sums = memory[112], memory[113], memory[114]
    goal, work = vectors[0], vectors[1]
    if forgetting < 1.0:
        for i in range(16):
            for j in range(16):
                for c in range(7):
                    memory[16 * c + i, j] *= forgetting
            right[i] *= forgetting
            start[i] = prior[i] * theta[i]
        for c in range(6):
            squares[c] *= forgetting
        sums[6] *= forgetting

    regressor_into(sample[6:9], sample[9:12], sample[12:15], V)
    regressor_into(sample[15:18], sample[18:21], sample[21:24], Z)
    for c in range(6):
        first, last = (0, 4) if c < 3 else (1, 10)
        weight = 1.0 / (noise_std[c] * noise_std[c])
        own = memory[16 * c : 16 * c + 16]
        own[c, c] += weight
        memory[96 + c, c] += weight
        right[c] += weight * sample[c]
        for j in range(first, last):
            z = weight * Z[c, j]
            right[6 + j] += z * sample[c]
            own[6 + j, c] += z
            memory[102 + j, c] += z
            memory[96 + c, 6 + j] += weight * V[c, j]
            for k in range(first, last):
                memory[102 + j, 6 + k] += z * V[c, k]
            for k in range(first, j + 1):
                own[6 + j, 6 + k] += z * Z[c, k]
    sums[6] += 1.0

    # B = (inverse factor of M) R; then the normal equations B^T B.
    for i in range(16):
        for j in range(i + 1):
            A[i, j] = 0.0
            for c in range(6):
                A[i, j] += memory[16 * c + i, j]
        A[i, i] += _RIDGE * A[i, i] + prior[i]
    factorise(A, L)
    for i in range(16):
        goal[i] = 0.0
        for j in range(16):
            B[i, j] = 0.0
        for k in range(i + 1):
            goal[i] += L[i, k] * right[k]
            for j in range(16):
                B[i, j] += L[i, k] * memory[96 + k, j]
    for i in range(16):
        for j in range(i + 1):
            total = 0.0
            for k in range(16):
                total += B[k, i] * B[k, j]
            A[i, j] = total
        A[i, i] += prior[i]
        work[i] = start[i]
        for k in range(16):
            work[i] += B[k, i] * goal[k]
    factorise(A, L)
    solve(L, work, goal, theta)

    for c in range(6):
        first, last = (0, 4) if c < 3 else (1, 10)
        residual = sample[c] - theta[c]
        for j in range(first, last):
            residual -= V[c, j] * theta[6 + j]
        squares[c] += residual * residual
        # Later samples count more, so that what was not yet learnt at the start is soon gone.
        sums[c] += 2.0 / (sums[6] + 1.0) * (residual * residual - sums[c])


@njit(cache=True)
def _riv_over(
    theta, memory, samples, noise_std, forgetting, prior, V, Z, A, L, B, vectors, squares
):
    """`riv_update` for each row of samples (N, 24)."""
    for k in range(samples.shape[0]):
        riv_update(
            theta,
            memory,
            samples[k],
            noise_std,
            forgetting,
            prior,
            V,
            Z,
            A,
            L,
            B,
            vectors,
            squares,
        )


class RecursiveInstrumentalVariables(RecursiveEstimator):
    """Recursive instrumental variables: `update` and `learn` need instruments; see the module.

    Args:
        noise_std: (6,) standard deviations of the wrench channels [N, N m], for the weights.
        forgetting: factor per sample on the weight of the past, 0 < forgetting <= 1.
        prior_std: (16,) standard deviations of [offsets; phi] to begin with. With forgetting the
            prior is about the present estimate and never vanishes.
        bound: of `settled`.

    Raises:
        DrakeTeleopError: for other shapes or values.
    """

    method = "recursive instrumental variables"
    sample_size = 24

    def __init__(
        self,
        noise_std: ArrayLike,
        forgetting: float = 1.0,
        prior_std: ArrayLike = PRIOR_STD,
        bound: float = SETTLED,
    ) -> None:
        super().__init__(noise_std, forgetting, prior_std, bound)
        square = (np.zeros((16, 16)) for _ in range(3))
        self._constants = (
            *(self._noise_std, self._forgetting, 1.0 / self._prior),
            *(np.empty((6, 10)), np.empty((6, 10)), *square, np.empty((2, 16))),
        )

    def initial_memory(self, theta: Array) -> Array:
        """(115, 16): no information but the prior's about theta (16,)."""
        memory = np.zeros((_ROWS, 16))
        memory[113] = theta / self._prior
        return memory

    def covariance_of(self, theta: Array, memory: Array) -> Array:
        """(16, 16) P (R^T M^-1 S M^-1 R + prior) P, P the inverse of the left-hand side above.

        S is M with the variances that the equation errors have instead of the stated ones; those
        of different channels count as independent, and white.
        """
        channels, R = memory[:96].reshape(6, 16, 16), memory[96:112]
        variances, samples = memory[114, :6], memory[114, 6]
        information = np.diag(1.0 / self._prior)
        ratios = variances / self._noise_std**2 if samples > _FEWEST else np.ones(6)
        channels = channels + np.tril(channels, -1).swapaxes(1, 2)
        M = channels.sum(axis=0) + information
        S = np.einsum("c,cij->ij", ratios, channels)
        first = np.linalg.solve(M, R)
        P = np.linalg.inv(R.T @ first + information)
        covariance = P @ (first.T @ S @ first + information) @ P
        wider = np.sqrt(np.diag(covariance) / self._prior)
        shrink = 1.0 / np.maximum(1.0, wider)
        return np.asarray(covariance * np.outer(shrink, shrink))

    def update_into(self, theta: Array, memory: Array, sample: Array) -> None:
        """See `RecursiveEstimator`; memory: (115, 16)."""
        riv_update(theta, memory, sample, *self._constants, self._squares)

    def _learn(self, samples: Array) -> None:
        _riv_over(self._theta, self._memory, samples, *self._constants, self._squares)
