"""Recursive least squares for the load and the offsets, one sample at a time.

A sample's six rows of [E V] theta = F are taken one after the other, each a rank-one update of the
covariance P of theta = [offsets; phi], Eq. (7), weighted by the channel's noise. Without forgetting
the result is that of the batch with a weak prior (P's start). Ljung, System Identification,
section 11.2; the structural zeros of V are skipped.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from drake_teleop.errors import DrakeTeleopError
from drake_teleop.load.arrays import Array
from drake_teleop.load.identification import METHODS, Identification, positive, worth_stating
from drake_teleop.load.regressor import regressor_into

PRIOR_STD = (100.0,) * 3 + (10.0,) * 3 + (10.0,) + (3.0,) * 3 + (1.0,) * 6
"""Default prior of [offsets [N, N m]; phi [kg, kg m, kg m^2]] about zero: wide for hand tools."""

# A parameter whose standard deviation is still above this share of the prior's was not learnt.
_STILL_PRIOR = 0.5
# The least variance of a row relative to the sum of the variances that it is made of: below it,
# rounding would make P indefinite. It only slows the first samples of a sensor that is nearly ideal
# by the measure of the prior (with the default prior, one better than about 1 mN).
_RESOLUTION = 1e-10


@njit(cache=True)
def rls_update(theta, P, wrench, s, omega, alpha, noise_std, forgetting, largest, V, gain, squares):
    """One sample, in place; compiled, allocates nothing, checks nothing.

    Args:
        theta: (16,) [offsets; phi], updated.
        P: (16, 16) its covariance, exactly symmetric, updated.
        wrench, s, omega, alpha: (6,), (3,), (3,), (3,) the sample, as for `identify`.
        noise_std: (6,) standard deviations of the wrench channels [N, N m].
        forgetting: factor per sample on the weight of the past, 1 for none.
        largest: (16,) variances up to which forgetting may raise the diagonal of P. Without this
            bound P grows without end while the motion does not excite a parameter.
        V: (6, 10) and gain: (16,) scratch.
        squares: (6,) sums of squared residuals, forgotten likewise, updated [N^2, N^2 m^2].
    """
    if forgetting < 1.0:
        step = 1.0 / math.sqrt(forgetting)
        for i in range(16):
            gain[i] = max(1.0, min(step, math.sqrt(largest[i] / P[i, i])))
        for i in range(16):
            for j in range(16):
                P[i, j] *= gain[i] * gain[j]
        for c in range(6):
            squares[c] *= forgetting

    regressor_into(s, omega, alpha, V)
    for c in range(6):
        first, last = (0, 4) if c < 3 else (1, 10)
        for i in range(16):
            gain[i] = P[c, i]
        for j in range(first, last):
            v = V[c, j]
            for i in range(16):
                gain[i] += v * P[6 + j, i]
        innovation = wrench[c] - theta[c]
        predicted, uncorrelated = gain[c], P[c, c]
        for j in range(first, last):
            v = V[c, j]
            innovation -= v * theta[6 + j]
            predicted += v * gain[6 + j]
            uncorrelated += v * v * P[6 + j, 6 + j]
        variance = max(noise_std[c] * noise_std[c], _RESOLUTION * uncorrelated)
        total = variance + predicted
        share = innovation / total
        squares[c] += variance * innovation * share
        inverse = 1.0 / total
        for i in range(16):
            theta[i] += gain[i] * share
            # (a b) c is the same as (b a) c to the last bit: P stays symmetric.
            for j in range(16):
                P[i, j] -= gain[i] * gain[j] * inverse


class RecursiveLeastSquares:
    """The recursive estimator of load and offsets.

    Args:
        noise_std: (6,) standard deviations of the wrench channels [N, N m].
        forgetting: factor per sample on the weight of the past, 0 < forgetting <= 1.
        prior_std: (16,) standard deviations of [offsets; phi] about zero to begin with; default
            `PRIOR_STD`. Forgetting never widens the estimate beyond them.

    Raises:
        DrakeTeleopError: for other shapes or values.
    """

    def __init__(
        self,
        noise_std: ArrayLike,
        forgetting: float = 1.0,
        prior_std: ArrayLike = PRIOR_STD,
    ) -> None:
        if not 0.0 < forgetting <= 1.0:
            raise DrakeTeleopError(f"{forgetting} is not within (0, 1]", where="forgetting")
        self._noise_std = positive("noise_std", noise_std, 6)
        self._forgetting = float(forgetting)
        self._prior = positive("prior_std", prior_std, 16) ** 2
        self._theta, self._covariance = np.zeros(16), np.diag(self._prior)
        self._V, self._gain, self._squares = np.empty((6, 10)), np.empty(16), np.zeros(6)
        self._samples = 0

    @property
    def phi(self) -> Array:
        """(10,) the load about So in S [kg, kg m, kg m^2]."""
        return self._theta[6:].copy()

    @property
    def offsets(self) -> Array:
        """(6,) of the sensor [N, N m]."""
        return self._theta[:6].copy()

    @property
    def covariance(self) -> Array:
        """(16, 16) of [offsets; phi] [SI], taking the noise for white and as large as stated."""
        return self._covariance.copy()

    def update(self, wrench: ArrayLike, s: ArrayLike, omega: ArrayLike, alpha: ArrayLike) -> None:
        """Learns from one sample of a free motion.

        Args:
            wrench: (6,) measured [f; tau] in S about So, sign of Eq. (1) [N, N m].
            s, omega, alpha: (3,) specific force [m/s^2], angular velocity [rad/s] and
                acceleration [rad/s^2] of S in S.

        Raises:
            DrakeTeleopError: for other shapes or numbers that are not finite; the estimate is
                then as it was.
        """
        sample = np.concatenate([wrench, s, omega, alpha], dtype=np.float64)
        sizes = [np.shape(part) for part in (wrench, s, omega, alpha)]
        if sizes != [(6,), (3,), (3,), (3,)]:
            raise DrakeTeleopError(f"wrench, s, omega, alpha have shapes {sizes}", where="sample")
        if not math.isfinite(sample.sum()):
            raise DrakeTeleopError("is not finite", where="sample")
        self.update_into(self._theta, self._covariance, sample)
        self._samples += 1

    def update_into(self, theta: Array, covariance: Array, sample: Array) -> None:
        """The same update of an estimate that is kept elsewhere; checks nothing.

        Args:
            theta: (16,) estimate, updated in place.
            covariance: (16, 16) C-contiguous, updated in place.
            sample: at least 15 numbers [wrench (6), s (3), omega (3), alpha (3)].
        """
        rls_update(
            theta,
            covariance,
            sample[:6],
            sample[6:9],
            sample[9:12],
            sample[12:15],
            self._noise_std,
            self._forgetting,
            self._prior,
            self._V,
            self._gain,
            self._squares,
        )

    def identification(self) -> Identification:
        """The present estimate.

        `covariance` is that of white noise as large as stated; a parameter that is still as
        uncertain as the prior (above half its standard deviation) is not identifiable. The
        residuals are the recursion's, each after learning from its row, weighted by forgetting.

        Raises:
            DrakeTeleopError: before the first update.
        """
        if self._theta[6] == 0.0:
            raise DrakeTeleopError("no sample has been learnt from", where="estimator")
        deviations = np.sqrt(np.diag(self._covariance))
        learnt = deviations < _STILL_PRIOR * np.sqrt(self._prior)
        return Identification(
            phi=self.phi,
            offsets=self.offsets,
            covariance=self.covariance,
            identifiable=learnt & worth_stating(deviations, self._theta[6:]),
            condition_number=self._condition_number(),
            delay_s=0.0,
            residual_rms=np.sqrt(self._squares / self._memory()),
            method=METHODS[1],
            samples=self._samples,
        )

    def _memory(self) -> float:
        """The sum of the weights of the samples so far."""
        if self._forgetting == 1.0:
            return float(self._samples)
        return (1.0 - self._forgetting**self._samples) / (1.0 - self._forgetting)

    def _condition_number(self) -> float:
        """Of the information matrix, prior included, columns scaled as in the batch."""
        information = np.linalg.inv(self._covariance)
        scale = 1.0 / np.sqrt(np.diag(information))
        eigenvalues = np.linalg.eigvalsh(information * np.outer(scale, scale))
        return float(np.sqrt(eigenvalues[-1] / eigenvalues[0]))
