"""Load and sensor offsets by batch least squares, Eqs. (7)-(8), (T3) and (T16)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import fdtrc

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array, finite_array, positive_array, to_float
from drake_teleop.load.identification import (
    Identification,
    is_precise_enough,
    mark_undetermined,
)
from drake_teleop.load.moments import (
    SecondMoments,
    excited_columns,
    normal_equations,
    regressor_coefficients,
    residual_covariance,
)

# Smallest relative eigenvalue of the scaled Gram, and largest component of a determined parameter
# in the null space.
_MIN_RELATIVE_GRAM_EIGENVALUE, _MAX_DETERMINED_NULL_COMPONENT = 1e-12, 1e-6
# Smallest block length over the noise's correlation time, fewest degrees of freedom of a usable
# variance.
_MIN_BLOCK_OVER_CORRELATION, _MIN_DOF_OF_VARIANCE = 4.0, 8.0
# For noise that is weaker at low frequencies: fewest degrees of freedom, and smallest share of the
# fit's degrees of freedom that the blocks contain.
_MIN_DOF_OF_LONGEST_BLOCKS, _MIN_FIT_DOF_SHARE_IN_BLOCKS = 20.0, 0.9
# Largest difference of specific force in one orientation [m/s^2], and level of the F test.
_SAME_POSE_WITHIN_M_S2, _POSE_F_TEST_LEVEL = 0.05, 0.01
# Largest relative residual that is rounding of the sums.
_MAX_ROUNDING_RESIDUAL = 1e-6
_WRENCH_COLUMNS, _SPECIFIC_FORCE_COLUMNS = slice(1, 7), slice(7, 10)
"""Indices of wrench and specific force in the vector z of `SecondMoments`, Eq. (T4)."""


class NormalEquations(SecondMoments):
    """Least squares sums of a record, from which load and sensor offsets are solved.

    Args:
        noise: (6,) standard deviations of the wrench channels [N, N m]; None: equal weights.
        resolution: (2,) quantisation step of forces and torques [N, N m], only for poses at rest.
    """

    def __init__(
        self, noise: ArrayLike | None = None, *, resolution: tuple[float, float] | None = None
    ) -> None:
        super().__init__()
        self._resolution = resolution
        self._weights = np.ones(6) if noise is None else positive_array("noise", noise, 6) ** -2.0

    def solve(self, delay_s: float = 0.0) -> Identification:
        inverse, undetermined, condition_number = self._pseudo_inverse()
        theta = inverse @ self.normal_equations()[1]
        if theta[6] == 0.0:
            raise DrakeTeleopError(
                "the fitted mass is 0: the mass cannot be identified from this wrench",
                where="wrench",
                remedy="check that the sensor is connected and that its orientation changes",
            )
        covariance, degrees = self._covariance_and_degrees(theta, inverse)
        covariance = mark_undetermined(covariance, undetermined)
        degrees[undetermined] = np.inf
        return Identification(
            phi=theta[6:],
            offsets=theta[:6],
            covariance=covariance,
            identifiable=is_precise_enough(np.sqrt(np.diag(covariance)), theta[6:]),
            condition_number=condition_number,
            delay_s=to_float("delay_s", delay_s),
            residual_rms=np.sqrt(self.residual_squares(theta) / self.num_samples),
            method="batch least squares",
            samples=int(self.num_samples),
            degrees_of_freedom=degrees,
        )

    def covariance(self) -> Array:
        """Return the finite covariance (16, 16) of the minimum-norm solution [offsets; phi]."""
        inverse, _, _ = self._pseudo_inverse()
        return self._covariance_and_degrees(inverse @ self.normal_equations()[1], inverse)[0]

    def _covariance_and_degrees(self, theta: Array, inverse: Array) -> tuple[Array, Array]:
        variances, degrees, _ = self._long_run_variances(theta, inverse)
        # Contribution of each channel to the covariance, and Satterthwaite's degrees of freedom.
        parts = self._channel_grams() * (self._weights**2 * variances)[:, None, None]
        parts = inverse @ parts @ inverse
        shares = np.diagonal(parts, axis1=1, axis2=2)
        if self._resolution is not None:  # three channels share one variance
            shares, degrees = shares.reshape(2, 3, 16).sum(axis=1), degrees[::3]
        total, square_sums = shares.sum(axis=0), (shares**2 / degrees[:, None]).sum(axis=0)
        known = (total > 0.0) & (square_sums > 0.0)
        return parts.sum(axis=0), np.divide(
            total**2, square_sums, out=np.full(16, np.inf), where=known
        )

    def _pseudo_inverse(self) -> tuple[Array, NDArray[np.bool_], float]:
        return _pseudo_inverse(self.normal_equations()[0], self.unexcited_columns)

    def normal_equations(self, weights: ArrayLike | None = None) -> tuple[Array, Array]:
        weights = self._weights if weights is None else finite_array("weights", weights, 6)
        return normal_equations(self._sums, np.diag(weights))

    def _channel_grams(self) -> Array:
        T = regressor_coefficients()
        return np.asarray(T @ self._sums @ T.transpose(0, 2, 1))

    @property
    def unexcited_columns(self) -> NDArray[np.bool_]:
        return ~excited_columns(self.mean_products)

    def residual_squares(self, theta: ArrayLike) -> Array:
        squares = np.diag(residual_covariance(self._sums, finite_array("theta", theta, 16)))
        return np.maximum(squares, 0.0)

    def long_run_variances(self, theta: ArrayLike) -> tuple[Array, Array]:
        """Return residual variances (6,) with correlation in time, and their degrees of freedom."""
        inverse, _, _ = self._pseudo_inverse()
        return self._long_run_variances(finite_array("theta", theta, 16), inverse)[:2]

    def has_slow_noise(self) -> NDArray[np.bool_]:
        """Return (6,) True for wrench channels whose noise is slower than the record resolves."""
        inverse, _, _ = self._pseudo_inverse()
        return self._long_run_variances(inverse @ self.normal_equations()[1], inverse)[2]

    def _long_run_variances(
        self, theta: Array, inverse: Array
    ) -> tuple[Array, Array, NDArray[np.bool_]]:
        grams = self._channel_grams()
        n = float(self.num_samples)
        power = self.residual_squares(theta)
        if self._resolution is not None:
            absorbed = self._absorbed_degrees_of_freedom(grams, inverse)
            return *self._static_variances(power, absorbed, theta), np.zeros(6, dtype=bool)
        variances, degrees = self._unbiased_residual_variances(power, n, grams, grams, inverse)
        of_samples = variances
        # Rounding in the sums must not count as noise of the wrench.
        wrench = np.diag(self._sums)[_WRENCH_COLUMNS]
        found, slow = np.zeros(6, dtype=bool), np.zeros(6, dtype=bool)
        sample_absorbed = self._absorbed_degrees_of_freedom(grams, inverse)
        longest, longest_degrees = variances, degrees
        last, length, filled = (int(number) for number in self._state)
        # An unfinished last block would have the weight of a full one.
        blocks = self._blocks[: last + (filled == length)]
        while len(blocks) > _MIN_DOF_OF_VARIANCE:
            rows = _regressors_of_blocks(blocks)
            power = np.sum((blocks[:, _WRENCH_COLUMNS] - rows @ theta) ** 2, axis=0) / length
            between = rows.transpose(1, 2, 0) @ rows.transpose(1, 0, 2) / length
            estimated, counted = self._unbiased_residual_variances(
                power, len(blocks), between, grams, inverse
            )
            usable = ~found & (counted >= _MIN_DOF_OF_VARIANCE)
            correlation = np.divide(estimated, of_samples, out=np.ones(6), where=of_samples > 0.0)
            at_borders = np.minimum(correlation / (2.0 * length), 0.5 / _MIN_BLOCK_OVER_CORRELATION)
            corrected = estimated / (1.0 - np.where(correlation > 1.5, at_borders, 0.0))
            enough = usable & (length >= _MIN_BLOCK_OVER_CORRELATION * correlation)
            larger = usable & ~enough & (corrected > variances)
            take = enough | larger
            variances = np.where(take, corrected, variances)
            degrees = np.where(take, counted, degrees)
            found |= enough
            absorbed = self._absorbed_degrees_of_freedom(between, inverse)
            has_motion = absorbed >= _MIN_FIT_DOF_SHARE_IN_BLOCKS * sample_absorbed
            is_longest = has_motion & (counted >= _MIN_DOF_OF_LONGEST_BLOCKS)
            longest = np.where(is_longest, estimated, longest)
            longest_degrees = np.where(is_longest, counted, longest_degrees)
            significant = correlation > 1.0 + 3.0 * np.sqrt(2.0 / np.maximum(counted, 1.0))
            slow = np.where(usable, significant & ~found, slow & ~found)
            even = len(blocks) // 2 * 2
            blocks, length = blocks[0:even:2] + blocks[1:even:2], 2 * length
        # The logarithm of an estimated variance is nearly normal, with deviation sqrt(2 / degrees).
        weaker = found & (longest * np.exp(3.0 * np.sqrt(2.0 / longest_degrees)) < variances)
        variances = np.where(weaker, longest, variances)
        degrees = np.where(weaker, longest_degrees, degrees)
        return variances, degrees, slow & (n * of_samples > _MAX_ROUNDING_RESIDUAL**2 * wrench)

    def _static_variances(self, power: Array, absorbed: Array, theta: Array) -> tuple[Array, Array]:
        assert self._resolution is not None
        squares, absorbed_sums = (x.reshape(2, 3).sum(axis=1) for x in (power, absorbed))
        min_variance = np.array(self._resolution) ** 2 / 12.0
        blocks = self._blocks[: self._state[0] + 1]
        count = blocks[:, 0]
        s = blocks[:, _SPECIFIC_FORCE_COLUMNS] / count[:, None]
        first = (np.linalg.norm(s[:, None] - s, axis=2) < _SAME_POSE_WITHIN_M_S2).argmax(axis=1)
        groups = (np.unique(first)[:, None] == first).astype(float)
        sums = groups @ (blocks[:, _WRENCH_COLUMNS] - _regressors_of_blocks(blocks) @ theta)
        between = (sums**2 / (groups @ count)[:, None]).reshape(-1, 2, 3).sum(axis=(0, 2))
        left, repeats = 3.0 * len(groups) - absorbed_sums, 3.0 * (self.num_samples - len(groups))
        within = np.maximum(squares - between, repeats * min_variance) / max(repeats, 1.0)
        f_ratio = np.divide(
            between, left * within, out=np.zeros(2), where=(left > 0.0) & (within > 0.0)
        )
        differ = fdtrc(np.maximum(left, 1.0), max(repeats, 1.0), f_ratio) < _POSE_F_TEST_LEVEL
        degrees = np.where(differ, left, left + repeats)
        squares = np.where(differ, between, squares)
        variances = np.maximum(squares / np.maximum(degrees, 1.0), min_variance)
        return variances.repeat(3), degrees.repeat(3)

    def _absorbed_degrees_of_freedom(self, between: Array, inverse: Array) -> Array:
        return np.asarray(self._weights * np.einsum("cij,ji->c", between, inverse))

    def _unbiased_residual_variances(
        self, power: Array, count: float, between: Array, grams: Array, inverse: Array
    ) -> tuple[Array, Array]:
        w = self._weights
        absorbed = self._absorbed_degrees_of_freedom(between, inverse)
        spread = inverse @ grams @ inverse
        shares = np.einsum("cij,kji->ck", between, spread) * w**2
        degrees = np.maximum(count - absorbed, 0.0)
        equations = np.diag(count - 2.0 * absorbed) + shares
        if not (degrees > 0.0).all() or np.linalg.cond(equations) > 1e6:
            return power / np.maximum(degrees, 1.0), degrees
        solution = np.linalg.solve(equations, power)
        # Errors of the other channels can make a small solution negative.
        return np.maximum(solution, power / count), degrees


def identify(
    wrench: ArrayLike,
    s: ArrayLike,
    omega: ArrayLike,
    alpha: ArrayLike,
    *,
    noise: ArrayLike | None = None,
    delay_s: float = 0.0,
) -> Identification:
    """Return load and sensor offsets from free motion, by batch least squares, Eqs. (7)-(8).

    Args:
        wrench: (N, 6) measured force and torque on the load, Eq. (1) [N, N m].
        s, omega, alpha: (N, 3) specific force a - g, angular velocity and acceleration of S, in S
            [SI]; (3,) zeros for omega, alpha at rest.
        noise: (6,) standard deviations of the wrench channels [N, N m]; None: equal weights.
        delay_s: delay [s] that was removed from the motion, only stored in the result.
    """
    equations = NormalEquations(noise)
    equations.add_samples(wrench, s, omega, alpha)
    return equations.solve(delay_s)


def _regressors_of_blocks(blocks: Array) -> Array:
    return np.asarray(np.einsum("cjk,bk->bcj", regressor_coefficients(), blocks))


def _pseudo_inverse(
    gram: Array, unexcited: NDArray[np.bool_]
) -> tuple[Array, NDArray[np.bool_], float]:
    scale = np.where(unexcited, 0.0, 1.0 / np.sqrt(np.where(unexcited, 1.0, np.diag(gram))))
    eigenvalues, vectors = np.linalg.eigh(gram * np.outer(scale, scale))
    kept = eigenvalues > _MIN_RELATIVE_GRAM_EIGENVALUE * eigenvalues[-1]
    half = scale[:, None] * vectors[:, kept] / np.sqrt(eigenvalues[kept])
    undetermined = (np.abs(vectors[:, ~kept]) > _MAX_DETERMINED_NULL_COMPONENT).any(axis=1)
    condition_number = float(np.sqrt(eigenvalues[-1] / eigenvalues[kept][0]))
    return half @ half.T, undetermined, condition_number
