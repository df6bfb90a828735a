"""Recursive least squares for the load and the offsets, one sample at a time.

A sample's six rows of [E V] theta = F are taken one after the other, each a rank-one update of the
covariance P of theta = [offsets; phi], Eq. (7), weighted by the channel's noise. Without forgetting
the result is that of the batch with a weak prior (P's start). Ljung, System Identification,
section 11.2; the structural zeros of V are skipped.

`RecursiveEstimator` is what the recursive estimators share; the others are
`recursive_tls.RecursiveTotalLeastSquares` and `instrumental.RecursiveInstrumentalVariables`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_teleop.common.arrays import Array, checked_rows, positive
from drake_teleop.common.compiled import njit
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.batch.uncertainty import prior_dominated
from drake_teleop.load.identification import WORTH_STATING, Identification, worth_stating
from drake_teleop.load.regressor import regressor_into
from drake_teleop.load.sample import (
    ANGULAR_ACCELERATION,
    ANGULAR_VELOCITY,
    SPECIFIC_FORCE,
    WRENCH,
)

PRIOR_STD = (100.0,) * 3 + (10.0,) * 3 + (10.0,) + (3.0,) * 3 + (1.0,) * 6
"""Default prior of [offsets [N, N m]; phi [kg, kg m, kg m^2]] about zero: wide for hand tools."""

SETTLED = 0.05
"""Default bound of `RecursiveEstimator.settled`."""

# The least share of the largest eigenvalue that is not rounding.
_ROUNDING = 1e-16
# What a sample is made of.
_PARTS = {"wrench": 6, "s": 3, "omega": 3, "alpha": 3, "instruments": 9}
# The least variance of a row relative to the sum of the variances that it is made of: below it,
# rounding would make P indefinite. It only slows the first samples of a sensor that is nearly ideal
# by the measure of the prior (with the default prior, one better than about 1 mN).
_RESOLUTION = 1e-10


@njit(cache=True)
def rls_update(theta, P, samples, noise_std, forgetting, largest, squares):
    """One sample after the other, in place; compiled, checks nothing.

    Args:
        theta: (16,) [offsets; phi], updated.
        P: (16, 16) its covariance, exactly symmetric, updated.
        samples: (N, at least 15) rows of `drake_teleop.load.sample`.
        noise_std: (6,) standard deviations of the wrench channels [N, N m].
        forgetting: factor per sample on the weight of the past, 1 for none.
        largest: (16,) variances up to which forgetting may raise the diagonal of P. Without this
            bound P grows without end while the motion does not excite a parameter.
        squares: (6,) sums of squared residuals, forgotten likewise, updated [N^2, N^2 m^2].
    """
    V, gain = np.empty((6, 10)), np.empty(16)
    step = 1.0 / math.sqrt(forgetting)
    for n in range(len(samples)):
        sample = samples[n]
        if forgetting < 1.0:
            for i in range(16):
                gain[i] = max(1.0, min(step, math.sqrt(largest[i] / P[i, i])))
            for i in range(16):
                for j in range(16):
                    P[i, j] *= gain[i] * gain[j]
            for c in range(6):
                squares[c] *= forgetting

        wrench, s, omega = sample[WRENCH], sample[SPECIFIC_FORCE], sample[ANGULAR_VELOCITY]
        regressor_into(s, omega, sample[ANGULAR_ACCELERATION], V)
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
            inverse = 1.0 / (variance + predicted)
            share = innovation * inverse
            squares[c] += variance * innovation * share
            for i in range(16):
                theta[i] += gain[i] * share
                # (a b) c is the same as (b a) c to the last bit: P stays symmetric.
                for j in range(16):
                    P[i, j] -= gain[i] * gain[j] * inverse


class RecursiveEstimator(ABC):
    """An estimate [offsets; phi] that learns sample by sample, and what all of them offer.

    What an estimator knows is theta (16,) and a `memory`, an array of its own making. They can be
    kept outside, as in the state of a Drake system: `initial_memory`, `update_into`,
    `covariance_of`, `settled_at`.

    Args:
        noise_std: (6,) standard deviations of the wrench channels [N, N m].
        forgetting: factor per sample on the weight of the past, 0 < forgetting <= 1.
        prior_std: (16,) standard deviations of [offsets; phi] to begin with. Forgetting never
            widens the estimate beyond them: while the motion excites nothing, nothing winds up.
        bound: of `settled`.

    Raises:
        DrakeTeleopError: for other shapes or values.
    """

    #: How `Identification.method` calls it.
    method: str
    #: Numbers that a sample has to begin with.
    sample_size = 15
    #: Whether its covariance can be believed when the measured motion is noisy.
    allows_for_noisy_motion = False

    def __init__(
        self,
        noise_std: ArrayLike,
        forgetting: float = 1.0,
        prior_std: ArrayLike = PRIOR_STD,
        bound: float = SETTLED,
    ) -> None:
        if not 0.0 < forgetting <= 1.0:
            raise DrakeTeleopError(f"{forgetting} is not within (0, 1]", where="forgetting")
        if not bound > 0.0:
            raise DrakeTeleopError(f"{bound} is not positive", where="bound")
        self._noise_std = positive("noise_std", noise_std, 6)
        self._forgetting, self._bound = float(forgetting), float(bound)
        self._prior = positive("prior_std", prior_std, 16) ** 2
        self._theta, self._samples = np.zeros(16), 0
        self._memory = self.initial_memory(self._theta)

    @classmethod
    def for_noise(
        cls, noise_std: ArrayLike, motion_std: ArrayLike, *, forgetting: float, bound: float
    ) -> RecursiveEstimator:
        """One for noise of the wrench (6,) and of the motion (9,), if it allows for that."""
        return cls(noise_std, forgetting=forgetting, bound=bound)

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
        """(16, 16) of [offsets; phi] [SI], taking the noise for white."""
        return self.covariance_of(self._theta, self._memory)

    @property
    def settled(self) -> bool:
        """Whether every parameter is predicted to be known well enough.

        The bound is a share of what is natural for a load of this mass and size, as the 5 % of
        `Identification.identifiable`: 0.05 asks the mass for 5 %.
        """
        return self.settled_at(self._theta, self._memory)

    def settled_at(self, theta: Array, memory: Array) -> bool:
        """`settled` for an estimate that is kept elsewhere."""
        if theta[6] == 0.0:
            return False
        deviations = np.sqrt(np.diag(self.covariance_of(theta, memory)))
        return bool(self._known(deviations, theta, self._bound).all())

    @abstractmethod
    def initial_memory(self, theta: Array) -> Array:
        """The memory that goes with an estimate theta (16,) from which nothing is known yet."""

    @abstractmethod
    def covariance_of(self, theta: Array, memory: Array) -> Array:
        """`covariance` of an estimate that is kept elsewhere."""

    def update_into(self, theta: Array, memory: Array, sample: Array) -> None:
        """The update of an estimate that is kept elsewhere; compiled, checks nothing.

        Args:
            theta: (16,) estimate, updated in place.
            memory: C-contiguous, as from `initial_memory`, updated in place.
            sample: begins with `sample_size` numbers [wrench, s, omega, alpha, ...].
        """
        self._learn(theta, memory, np.array(sample, dtype=np.float64, ndmin=2))

    @abstractmethod
    def _learn(self, theta: Array, memory: Array, samples: Array) -> None:
        """Updates an estimate by each row of samples (N, at least `sample_size`), compiled."""

    @abstractmethod
    def _residual_rms(self) -> Array:
        """(6,) of the own estimate's residuals, weighted by forgetting."""

    def update(
        self,
        wrench: ArrayLike,
        s: ArrayLike,
        omega: ArrayLike,
        alpha: ArrayLike,
        instruments: ArrayLike | None = None,
    ) -> None:
        """Learns from one sample of a free motion.

        Args:
            wrench: (6,) measured [f; tau] in S about So, sign of Eq. (1) [N, N m].
            s, omega, alpha: (3,) specific force [m/s^2], angular velocity [rad/s] and
                acceleration [rad/s^2] of S in S.
            instruments: (9,) the motion [s; omega; alpha] once more with other noise, for the
                estimator that takes it.

        Raises:
            DrakeTeleopError: for other shapes or numbers that are not finite, or instruments too
                many or missing; the estimate is then as it was.
        """
        parts = self._parts([wrench, s, omega, alpha], instruments)
        shapes = [np.shape(part) for part in parts]
        if shapes != [(size,) for size in _PARTS.values()][: len(parts)]:
            names = ", ".join(list(_PARTS)[: len(parts)])
            raise DrakeTeleopError(f"{names} have shapes {shapes}", where="sample")
        sample = np.concatenate(parts, dtype=np.float64)
        if not math.isfinite(sample.sum()):
            raise DrakeTeleopError("is not finite", where="sample")
        self.update_into(self._theta, self._memory, sample)
        self._samples += 1

    def learn(
        self,
        wrench: ArrayLike,
        s: ArrayLike,
        omega: ArrayLike,
        alpha: ArrayLike,
        instruments: ArrayLike | None = None,
    ) -> None:
        """`update` with each of N samples of a log, in a compiled loop.

        Args:
            wrench, s, omega, alpha, instruments: (N, 6), (N, 3), (N, 3), (N, 3), (N, 9).

        Raises:
            DrakeTeleopError: as `update`.
        """
        parts = self._parts([wrench, s, omega, alpha], instruments)
        columns = zip(_PARTS, parts, strict=False)
        _, rows = checked_rows(**{name: (part, _PARTS[name]) for name, part in columns})
        self._learn(self._theta, self._memory, np.concatenate(rows, axis=1))
        self._samples += len(rows[0])

    def _parts(self, parts: list[ArrayLike], instruments: ArrayLike | None) -> list[ArrayLike]:
        if (instruments is None) == (self.sample_size > 15):
            needs = "needs" if instruments is None else "takes no"
            raise DrakeTeleopError(f"{self.method} {needs} instruments", where="sample")
        return parts if instruments is None else [*parts, instruments]

    def identification(self) -> Identification:
        """The present estimate.

        `covariance` is that of white noise. A parameter of which the prior still says most
        (`uncertainty.prior_dominated`) is not identifiable, and its verdict is "prior".

        Raises:
            DrakeTeleopError: before the first update.
        """
        if self._theta[6] == 0.0:
            raise DrakeTeleopError("no sample has been learnt from", where="estimator")
        covariance = self.covariance
        deviations = np.sqrt(np.diag(covariance))
        return Identification(
            phi=self.phi,
            offsets=self.offsets,
            covariance=covariance,
            identifiable=self._known(deviations, self._theta, WORTH_STATING),
            condition_number=self._condition_number(),
            delay_s=0.0,
            residual_rms=self._residual_rms(),
            method=self.method,
            samples=self._samples,
            prior_dominated=prior_dominated(deviations, np.sqrt(self._prior)),
        )

    def _known(self, deviations: Array, theta: Array, bound: float) -> NDArray[np.bool_]:
        """(16,) whether known better than the prior, and to `bound` of what is natural."""
        learnt = ~prior_dominated(deviations, np.sqrt(self._prior))
        return learnt & worth_stating(deviations * (WORTH_STATING / bound), theta[6:])

    def _condition_number(self) -> float:
        """Of the information matrix, prior included, columns scaled as in the batch."""
        information = np.linalg.inv(self.covariance)
        scale = 1.0 / np.sqrt(np.diag(information))
        eigenvalues = np.linalg.eigvalsh(information * np.outer(scale, scale))
        return float(np.sqrt(eigenvalues[-1] / max(eigenvalues[0], _ROUNDING * eigenvalues[-1])))


class RecursiveLeastSquares(RecursiveEstimator):
    """Recursive least squares: exact if the motion is known exactly.

    The memory is the covariance. Noise in the measured motion biases it, see `recursive_tls`.

    Args:
        noise_std: (6,) standard deviations of the wrench channels [N, N m].
        forgetting: factor per sample on the weight of the past, 0 < forgetting <= 1.
        prior_std: (16,) standard deviations of [offsets; phi] about zero to begin with; default
            `PRIOR_STD`. Forgetting never widens the estimate beyond them.
        bound: of `settled`.

    Raises:
        DrakeTeleopError: for other shapes or values.
    """

    method = "recursive least squares"

    def __init__(
        self,
        noise_std: ArrayLike,
        forgetting: float = 1.0,
        prior_std: ArrayLike = PRIOR_STD,
        bound: float = SETTLED,
    ) -> None:
        super().__init__(noise_std, forgetting, prior_std, bound)
        self._squares = np.zeros(6)

    def initial_memory(self, theta: Array) -> Array:
        """(16, 16) the prior's covariance, whatever theta."""
        return np.diag(self._prior)

    def covariance_of(self, theta: Array, memory: Array) -> Array:
        """(16, 16), the memory itself."""
        return memory.copy()

    def _learn(self, theta: Array, memory: Array, samples: Array) -> None:
        options = (self._noise_std, self._forgetting, self._prior)
        rls_update(theta, memory, samples, *options, self._squares)

    def _residual_rms(self) -> Array:
        """Of each residual after learning from its row."""
        factor, n = self._forgetting, self._samples
        weight = n if factor == 1.0 else (1.0 - factor**n) / (1.0 - factor)
        return np.sqrt(self._squares / weight)
