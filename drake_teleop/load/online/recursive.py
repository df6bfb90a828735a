"""Recursive least squares for load and offsets, Eq. (T6) (Ljung, System Identification, 11.2)."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_teleop.common import numeric
from drake_teleop.common.compiled import njit
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array, broadcast_to_rows, positive_array
from drake_teleop.load.batch.uncertainty import is_prior_dominated
from drake_teleop.load.identification import (
    MAX_IDENTIFIED_RELATIVE_STD,
    Identification,
    is_precise_enough,
)
from drake_teleop.load.regressor import MOTION_SLICE, WRENCH_SLICE, regressor_into

PRIOR_STD = (100.0,) * 3 + (10.0,) * 3 + (10.0,) + (3.0,) * 3 + (1.0,) * 6
"""Standard deviations of the default prior about zero [N, N m, kg, kg m, kg m^2]."""

MAX_SETTLED_RELATIVE_STD = 0.05
"""Default of `settled_std`, relative to the natural scale."""

# Smallest relative eigenvalue that is not rounding.
_MIN_RELATIVE_INFORMATION_EIGENVALUE = 1e-16
# Smallest variance of a row relative to the sum of its terms; rounding would make P indefinite. It
# slows only the first samples of sensors with noise below about 1 mN (for the default prior).
MIN_RELATIVE_NOISE_VARIANCE = 1e-10


@njit(cache=True)
def rls_update(theta, P, samples, noise_std, forgetting, max_variances, residual_square_sums):
    """Update theta (16,), covariance P (16, 16) and `residual_square_sums` (6,) by N samples.

    `max_variances` (16,) limits the variances during forgetting.
    """
    V, gain = np.empty((6, 10)), np.empty(16)
    step = 1.0 / math.sqrt(forgetting)
    for n in range(len(samples)):
        sample = samples[n]
        if forgetting < 1.0:
            for i in range(16):
                gain[i] = max(1.0, min(step, math.sqrt(max_variances[i] / P[i, i])))
            for i in range(16):
                for j in range(16):
                    P[i, j] *= gain[i] * gain[j]
            for c in range(6):
                residual_square_sums[c] *= forgetting

        wrench, motion = sample[WRENCH_SLICE], sample[MOTION_SLICE]
        regressor_into(motion[:3], motion[3:6], motion[6:], V)
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
            variance = max(noise_std[c] * noise_std[c], MIN_RELATIVE_NOISE_VARIANCE * uncorrelated)
            inverse = 1.0 / (variance + predicted)
            share = innovation * inverse
            residual_square_sums[c] += variance * innovation * share
            for i in range(16):
                theta[i] += gain[i] * share
                # (a b) c equals (b a) c to the last bit, so P stays symmetric.
                for j in range(16):
                    P[i, j] -= gain[i] * gain[j] * inverse


class RecursiveEstimator(ABC):
    """Recursive estimator of load and sensor offsets, theta = [offsets; phi] (16,).

    A caller may keep the state itself: theta, and an array from `initial_memory`.

    Args:
        noise_std: (6,) standard deviations of the wrench channels [N, N m].
        forgetting: factor per sample on the weight of past samples, 0 < forgetting <= 1.
        prior_std: (16,) standard deviations of the prior; forgetting does not exceed them.
        settled_std: largest standard deviation for `is_settled`, relative to `natural_scales`.
    """

    #: Value of `Identification.method`.
    method: str
    #: Whether the covariance includes noise of the measured motion.
    allows_for_noisy_motion = False

    def __init__(
        self,
        noise_std: ArrayLike,
        forgetting: float = 1.0,
        prior_std: ArrayLike = PRIOR_STD,
        settled_std: float = MAX_SETTLED_RELATIVE_STD,
    ) -> None:
        if not 0.0 < forgetting <= 1.0:
            what = f"{forgetting} is outside the range 0 < forgetting <= 1"
            raise DrakeTeleopError(what, where="forgetting", remedy="give 1 for no forgetting")
        if not settled_std > 0.0:
            what = f"{settled_std} is not positive"
            raise DrakeTeleopError(what, where="settled_std", remedy="give a number above 0")
        self._noise_std = positive_array("noise_std", noise_std, 6)
        self._forgetting, self._settled_std = float(forgetting), float(settled_std)
        self._prior = positive_array("prior_std", prior_std, 16) ** 2
        self._theta, self._samples = np.zeros(16), 0
        self._memory = self.initial_memory(self._theta)

    @classmethod
    def for_noise(
        cls, noise_std: ArrayLike, motion_std: ArrayLike, *, forgetting: float, settled_std: float
    ) -> RecursiveEstimator:
        """Return an estimator for noise of the wrench (6,) and, if supported, the motion (9,)."""
        motion: Any = {"motion_std": motion_std} if cls.allows_for_noisy_motion else {}
        return cls(noise_std, forgetting=forgetting, settled_std=settled_std, **motion)

    @property
    def phi(self) -> Array:
        return self._theta[6:].copy()

    @property
    def offsets(self) -> Array:
        return self._theta[:6].copy()

    @property
    def covariance(self) -> Array:
        return self.covariance_of(self._theta, self._memory)

    @property
    def is_settled(self) -> bool:
        """Whether data, not the prior, determine all parameters within `settled_std`."""
        return self.is_state_settled(self._theta, self._memory)

    def is_state_settled(self, theta: Array, memory: Array) -> bool:
        if theta[6] == 0.0:
            return False
        deviations = np.sqrt(np.diag(self.covariance_of(theta, memory)))
        return bool(self._are_identified(deviations, theta, self._settled_std).all())

    @abstractmethod
    def initial_memory(self, theta: Array) -> Array: ...

    @abstractmethod
    def covariance_of(self, theta: Array, memory: Array) -> Array: ...

    def update_into(self, theta: Array, memory: Array, sample: Array) -> None:
        """Update the given theta and memory by one sample, without checks."""
        self._update_state(theta, memory, np.array(sample, dtype=np.float64, ndmin=2))

    @abstractmethod
    def _update_state(self, theta: Array, memory: Array, samples: Array) -> None: ...

    @abstractmethod
    def _residual_rms(self) -> Array: ...

    def update(self, wrench: ArrayLike, s: ArrayLike, omega: ArrayLike, alpha: ArrayLike) -> None:
        """Process one sample of a free motion: wrench (6,); s, omega, alpha (3,)."""
        parts = (wrench, s, omega, alpha)
        shapes = [np.shape(part) for part in parts]
        if shapes != [(6,), (3,), (3,), (3,)]:
            what = f"wrench, s, omega, alpha of one sample have shapes {shapes}"
            remedy = "pass shapes (6,), (3,), (3,), (3,)"
            raise DrakeTeleopError(what, where="sample", remedy=remedy)
        sample = np.concatenate(parts, dtype=np.float64)
        if not np.abs(sample).max() <= numeric.MAX_ARRAY_VALUE:
            for name, part in zip(("wrench", "s", "omega", "alpha"), parts, strict=True):
                numeric.finite_array(name, part, *np.shape(part))
        self.update_into(self._theta, self._memory, sample)
        self._samples += 1

    def update_samples(
        self, wrench: ArrayLike, s: ArrayLike, omega: ArrayLike, alpha: ArrayLike
    ) -> None:
        """Process N samples of a free motion: wrench (N, 6), others (N, 3)."""
        _, rows = broadcast_to_rows(
            wrench=(wrench, 6), s=(s, 3), omega=(omega, 3), alpha=(alpha, 3)
        )
        self._update_state(self._theta, self._memory, np.concatenate(rows, axis=1))
        self._samples += len(rows[0])

    def identification(self) -> Identification:
        if self._theta[6] == 0.0:
            what = "has not received a sample"
            raise DrakeTeleopError(what, where="estimator", remedy="call update first")
        covariance = self.covariance
        deviations = np.sqrt(np.diag(covariance))
        return Identification(
            phi=self.phi,
            offsets=self.offsets,
            covariance=covariance,
            identifiable=self._are_identified(deviations, self._theta, MAX_IDENTIFIED_RELATIVE_STD),
            condition_number=self._condition_number(),
            delay_s=0.0,
            residual_rms=self._residual_rms(),
            method=self.method,
            samples=self._samples,
            prior_dominated=is_prior_dominated(deviations, np.sqrt(self._prior)),
        )

    def _are_identified(self, deviations: Array, theta: Array, max_std: float) -> NDArray[np.bool_]:
        scaled = deviations * (MAX_IDENTIFIED_RELATIVE_STD / max_std)
        from_data = ~is_prior_dominated(deviations, np.sqrt(self._prior))
        return from_data & is_precise_enough(scaled, theta[6:])

    def _condition_number(self) -> float:
        information = np.linalg.inv(self.covariance)
        scale = 1.0 / np.sqrt(np.diag(information))
        eigenvalues = np.linalg.eigvalsh(information * np.outer(scale, scale))
        smallest = max(eigenvalues[0], _MIN_RELATIVE_INFORMATION_EIGENVALUE * eigenvalues[-1])
        return float(np.sqrt(eigenvalues[-1] / smallest))


class RecursiveLeastSquares(RecursiveEstimator):
    """Recursive least squares, whose estimate is biased by noise of the measured motion."""

    method = "recursive least squares"

    def __init__(self, noise_std: ArrayLike, *options: Any, **named: Any) -> None:
        super().__init__(noise_std, *options, **named)
        self._squares = np.zeros(6)

    def initial_memory(self, theta: Array) -> Array:
        return np.diag(self._prior)

    def covariance_of(self, theta: Array, memory: Array) -> Array:
        return memory.copy()

    def _update_state(self, theta: Array, memory: Array, samples: Array) -> None:
        options = (self._noise_std, self._forgetting, self._prior)
        rls_update(theta, memory, samples, *options, self._squares)

    def _residual_rms(self) -> Array:
        factor, n = self._forgetting, self._samples
        weight = n if factor == 1.0 else (1.0 - factor**n) / (1.0 - factor)
        return np.sqrt(self._squares / weight)
