"""Load and sensor offsets by batch least squares, from second moments of a record.

Row c of the regressor [E V] of [offsets; phi] is T_c z, T_c (16, 19), s = a - g, w = omega:

    z = [1, F (6), s (3), alpha (3), w_x w_x, w_y w_y, w_z w_z, w_x w_y, w_x w_z, w_y w_z]   (19)

All least squares estimates follow from the mean of z z^T, Eqs. (7)-(8), (T3), (T4), (T16).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import fdtrc

from drake_teleop.common.compiled import njit
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import (
    Array,
    broadcast_to_rows,
    finite_array,
    nonnegative_array,
    positive_array,
)
from drake_teleop.load.identification import Identification, is_precise_enough, mark_undetermined
from drake_teleop.load.regressor import regressor

_MAX_STORED_SAMPLE_BLOCKS = 1024
SAMPLES_PER_CHUNK = 2**15
"""Samples per pass over a long record."""
# Smallest root mean square of an excited column [m/s^2, rad/s^2].
_MIN_RMS_OF_EXCITED_COLUMN = 1e-9
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
_SAME_POSE_DISTANCE_M_S2, _POSE_F_TEST_LEVEL = 0.05, 0.01
# Largest relative residual that is rounding of the sums.
_MAX_RELATIVE_ROUNDING = 1e-6
# Indices of wrench, specific force and products w_i w_j in z.
_WRENCH_COLUMNS, _SPECIFIC_FORCE_COLUMNS = slice(1, 7), slice(7, 10)
_OMEGA_PRODUCT_INDICES = np.array([[13, 16, 17], [16, 14, 18], [17, 18, 15]])


@dataclass(frozen=True, eq=False)
class NoiseStd:
    """Standard deviations of white measurement noise, independent between channels.

    Attributes:
        wrench: (6,) [N, N m]; None to estimate it from the residual.
        s, omega, alpha: (3,), or a number for all axes [m/s^2, rad/s, rad/s^2].
        walk: (12,) per sample, of random walk steps of [wrench, s, alpha]; 0: no walk.
        motion: (3, 3) rows s, omega, alpha.
    """

    wrench: ArrayLike | None = None
    s: ArrayLike = 0.0
    omega: ArrayLike = 0.0
    alpha: ArrayLike = 0.0
    walk: ArrayLike = 0.0
    motion: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        rows = []
        for name, size in (("s", 3), ("omega", 3), ("alpha", 3), ("walk", 12)):
            value = getattr(self, name)
            rows.append(value if np.ndim(value) else np.full(size, value))
            nonnegative_array(f"noise.{name}", rows[-1], size)
        object.__setattr__(self, "motion", np.stack(rows[:3]))
        if self.wrench is not None:
            positive_array("noise.wrench", self.wrench, 6)


class SecondMoments:
    """Sum of z z^T (19, 19) over the added samples, from which load and offsets are solved.

    z = [1; wrench; s; alpha; products of omega].

    Args:
        noise: (6,) standard deviations of the wrench channels [N, N m]; None: equal weights.
        resolution: (2,) quantisation step of forces and torques [N, N m], only for poses at rest.
    """

    def __init__(
        self, noise: ArrayLike | None = None, *, resolution: tuple[float, float] | None = None
    ) -> None:
        self._resolution = resolution
        self._weights = np.ones(6) if noise is None else positive_array("noise", noise, 6) ** -2.0
        self._sums, self._blocks = np.zeros((19, 19)), np.zeros((_MAX_STORED_SAMPLE_BLOCKS, 19))
        # Index of the open block, samples of a full block, samples of the open block.
        self._state = np.array([0, 1, 0])

    @property
    def num_samples(self) -> float:
        """Number of samples, or the sum of their weights."""
        return float(self._sums[0, 0])

    @property
    def mean_products(self) -> Array:
        if self.num_samples < 3:
            what = f"{self.num_samples:.3g} samples cannot determine a load"
            raise DrakeTeleopError(what, where="wrench", remedy="give 3 or more orientations")
        return self._sums / self.num_samples

    def add_samples(
        self,
        wrench: ArrayLike,
        s: ArrayLike,
        omega: ArrayLike,
        alpha: ArrayLike,
        weights: ArrayLike | None = None,
    ) -> None:
        """Add N samples, or a single one, with arguments as for `identify` and `weights` (N,)."""
        _, rows = broadcast_to_rows(
            wrench=(wrench, 6), s=(s, 3), omega=(omega, 3), alpha=(alpha, 3)
        )
        n = rows[0].shape[0]
        weight = np.ones(n) if weights is None else finite_array("weights", weights, n)
        for start in range(0, n, SAMPLES_PER_CHUNK):
            part = np.zeros((19, 19))
            chunk = (table[start : start + SAMPLES_PER_CHUNK] for table in (*rows, weight))
            _add_sample_products(*chunk, part, self._blocks, self._state)
            self._sums += part + np.triu(part, 1).T

    def mean_noise_covariance_of_z(self, noise: NoiseStd, wrench: Array) -> Array:
        """Return the mean covariance (19, 19) of z due to `noise` of motion and `wrench` (6,)."""
        Q = np.zeros((19, 19))
        std = np.concatenate([wrench, noise.motion[0], noise.motion[2]])
        Q[np.arange(1, 13), np.arange(1, 13)] = std**2
        products = self.mean_products[0, _OMEGA_PRODUCT_INDICES]
        jacobians = omega_product_jacobians(_OMEGA_PRODUCT_INDICES, 19)
        for std, J in zip(noise.motion[1], jacobians, strict=True):
            Q += std**2 * J.T @ products @ J
        return Q

    def solve(self, delay_s: float = 0.0) -> Identification:
        theta, inverse, undetermined, condition_number = self._minimum_norm_solution()
        if theta[6] == 0.0:
            raise unidentifiable_mass_error("the fitted mass is 0")
        covariance, degrees = self._covariance_and_dof(theta, inverse)
        covariance = mark_undetermined(covariance, undetermined)
        degrees[undetermined] = np.inf
        return Identification(
            phi=theta[6:],
            offsets=theta[:6],
            covariance=covariance,
            identifiable=is_precise_enough(np.sqrt(np.diag(covariance)), theta[6:]),
            condition_number=condition_number,
            delay_s=float(finite_array("delay_s", delay_s)),
            residual_rms=np.sqrt(self.residual_square_sums(theta) / self.num_samples),
            method="batch least squares",
            samples=int(self.num_samples),
            degrees_of_freedom=degrees,
        )

    def covariance(self) -> Array:
        """Return the finite covariance (16, 16) of the minimum-norm solution [offsets; phi]."""
        return self._covariance_and_dof(*self._minimum_norm_solution()[:2])[0]

    def _covariance_and_dof(self, theta: Array, inverse: Array) -> tuple[Array, Array]:
        variances, degrees, _ = self._variances_dof_and_slow_noise(theta, inverse)
        # Contribution of each channel to the covariance, and Satterthwaite's degrees of freedom.
        parts = self._gram_matrix_of_each_channel() * (self._weights**2 * variances)[:, None, None]
        parts = inverse @ parts @ inverse
        shares = np.diagonal(parts, axis1=1, axis2=2)
        if self._resolution is not None:  # three channels share one variance
            shares, degrees = shares.reshape(2, 3, 16).sum(axis=1), degrees[::3]
        total, square_sums = shares.sum(axis=0), (shares**2 / degrees[:, None]).sum(axis=0)
        known, infinite = (total > 0.0) & (square_sums > 0.0), np.full(16, np.inf)
        return parts.sum(axis=0), np.divide(total**2, square_sums, out=infinite, where=known)

    def _minimum_norm_solution(self) -> tuple[Array, Array, NDArray[np.bool_], float]:
        gram, right = self.normal_equations()
        inverse, undetermined, condition_number = _pseudo_inverse(gram, self.unexcited_columns)
        return inverse @ right, inverse, undetermined, condition_number

    def normal_equations(self) -> tuple[Array, Array]:
        return normal_equations(self._sums, np.diag(self._weights))

    def _gram_matrix_of_each_channel(self) -> Array:
        T = regressor_coefficients()
        return np.asarray(T @ self._sums @ T.transpose(0, 2, 1))

    @property
    def unexcited_columns(self) -> NDArray[np.bool_]:
        return ~excited_columns(self.mean_products)

    def residual_square_sums(self, theta: ArrayLike) -> Array:
        squares = np.diag(residual_covariance(self._sums, finite_array("theta", theta, 16)))
        return np.maximum(squares, 0.0)

    def long_run_variances(self, theta: ArrayLike) -> tuple[Array, Array]:
        """Return long-run variances (6,) of the residual, and their degrees of freedom.

        They are n times the variances of means of n samples, for large n.
        """
        inverse = self._minimum_norm_solution()[1]
        return self._variances_dof_and_slow_noise(finite_array("theta", theta, 16), inverse)[:2]

    def has_slow_noise(self) -> NDArray[np.bool_]:
        """Return (6,) True for wrench channels with drift, or noise as slow as the record."""
        return self._variances_dof_and_slow_noise(*self._minimum_norm_solution()[:2])[2]

    def _variances_dof_and_slow_noise(
        self, theta: Array, inverse: Array
    ) -> tuple[Array, Array, NDArray[np.bool_]]:
        grams = self._gram_matrix_of_each_channel()
        n = float(self.num_samples)
        square_sums = self.residual_square_sums(theta)
        if self._resolution is not None:
            fit_dof = self._degrees_of_freedom_of_fit(grams, inverse)
            rest_variances = self._residual_variances_of_poses_at_rest(square_sums, fit_dof, theta)
            return *rest_variances, np.zeros(6, dtype=bool)
        variances, degrees, sample_fit_dof = self._unbiased_residual_variances(
            square_sums, n, grams, grams, inverse
        )
        of_samples = variances
        # Rounding in the sums must not count as noise of the wrench.
        wrench = np.diag(self._sums)[_WRENCH_COLUMNS]
        found, slow = np.zeros(6, dtype=bool), np.zeros(6, dtype=bool)
        longest, longest_degrees = variances, degrees
        last, length, filled = (int(number) for number in self._state)
        # An unfinished last block would have the weight of a full one.
        blocks = self._blocks[: last + (filled == length)]
        while len(blocks) > _MIN_DOF_OF_VARIANCE:
            rows = _regressor_sums_of_blocks(blocks)
            square_sums = np.sum((blocks[:, _WRENCH_COLUMNS] - rows @ theta) ** 2, axis=0) / length
            between = rows.transpose(1, 2, 0) @ rows.transpose(1, 0, 2) / length
            estimated, counted, fit_dof = self._unbiased_residual_variances(
                square_sums, len(blocks), between, grams, inverse
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
            has_motion = fit_dof >= _MIN_FIT_DOF_SHARE_IN_BLOCKS * sample_fit_dof
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
        return variances, degrees, slow & (n * of_samples > _MAX_RELATIVE_ROUNDING**2 * wrench)

    def _residual_variances_of_poses_at_rest(
        self, square_sums: Array, fit_dof: Array, theta: Array
    ) -> tuple[Array, Array]:
        assert self._resolution is not None
        squares, fit_dof_sums = (x.reshape(2, 3).sum(axis=1) for x in (square_sums, fit_dof))
        min_variance = np.array(self._resolution) ** 2 / 12.0
        blocks = self._blocks[: self._state[0] + 1]
        count = blocks[:, 0]
        s = blocks[:, _SPECIFIC_FORCE_COLUMNS] / count[:, None]
        first = (np.linalg.norm(s[:, None] - s, axis=2) < _SAME_POSE_DISTANCE_M_S2).argmax(axis=1)
        groups = (np.unique(first)[:, None] == first).astype(float)
        sums = groups @ (blocks[:, _WRENCH_COLUMNS] - _regressor_sums_of_blocks(blocks) @ theta)
        between = (sums**2 / (groups @ count)[:, None]).reshape(-1, 2, 3).sum(axis=(0, 2))
        left, repeats = 3.0 * len(groups) - fit_dof_sums, 3.0 * (self.num_samples - len(groups))
        within = np.maximum(squares - between, repeats * min_variance) / max(repeats, 1.0)
        testable = (left > 0.0) & (within > 0.0)
        f_ratio = np.divide(between, left * within, out=np.zeros(2), where=testable)
        differ = fdtrc(np.maximum(left, 1.0), max(repeats, 1.0), f_ratio) < _POSE_F_TEST_LEVEL
        degrees = np.where(differ, left, left + repeats)
        squares = np.where(differ, between, squares)
        variances = np.maximum(squares / np.maximum(degrees, 1.0), min_variance)
        return variances.repeat(3), degrees.repeat(3)

    def _degrees_of_freedom_of_fit(self, block_grams: Array, inverse: Array) -> Array:
        return np.asarray(self._weights * np.einsum("cij,ji->c", block_grams, inverse))

    def _unbiased_residual_variances(
        self, square_sums: Array, count: float, block_grams: Array, grams: Array, inverse: Array
    ) -> tuple[Array, Array, Array]:
        w = self._weights
        fit_dof = self._degrees_of_freedom_of_fit(block_grams, inverse)
        shares = np.einsum("cij,kji->ck", block_grams, inverse @ grams @ inverse) * w**2
        degrees = np.maximum(count - fit_dof, 0.0)
        equations = np.diag(count - 2.0 * fit_dof) + shares
        if not (degrees > 0.0).all() or np.linalg.cond(equations) > 1e6:
            return square_sums / np.maximum(degrees, 1.0), degrees, fit_dof
        solution = np.linalg.solve(equations, square_sums)
        # Errors of the other channels can make a small solution negative.
        return np.maximum(solution, square_sums / count), degrees, fit_dof


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
    equations = SecondMoments(noise)
    equations.add_samples(wrench, s, omega, alpha)
    return equations.solve(delay_s)


def unidentifiable_mass_error(reason: str) -> DrakeTeleopError:
    remedy = "check that the sensor is connected and that its orientation changes"
    what = f"the mass cannot be identified: {reason}"
    return DrakeTeleopError(what, where="wrench", remedy=remedy)


@cache
def regressor_coefficients() -> Array:
    """Return the constant T (6, 16, 19) with regressor [E V] = T z, Eq. (T4)."""
    T, unit, zero = np.zeros((6, 16, 19)), np.eye(3), np.zeros(3)
    T[np.arange(6), np.arange(6), 0] = 1.0
    T[:, 6:, 7:10] = np.moveaxis(regressor(unit, zero, zero), 0, -1)
    T[:, 6:, 10:13] = np.moveaxis(regressor(zero, zero, unit), 0, -1)
    T[:, 6:, 13:16] = np.moveaxis(regressor(zero, unit, zero), 0, -1)
    for k, (i, j) in enumerate([(0, 1), (0, 2), (1, 2)]):
        both = regressor(zero, unit[i] + unit[j], zero)
        T[:, 6:, 16 + k] = both - regressor(zero, unit[[i, j]], zero).sum(axis=0)
    T.flags.writeable = False
    return T


def omega_product_jacobians(indices: NDArray[np.intp], size: int) -> Array:
    """Return J (3, 3, size): J[k, i, m] is the factor of w_i in the derivative of product m by w_k.

    `indices` (3, 3) contain the index m of each product w_i w_j.
    """
    jacobians = np.zeros((3, 3, size))
    for i in range(3):
        for j in range(3):
            jacobians[j, i, indices[i, j]] += 1.0 + (i == j)
    return jacobians


def centripetal_matrix(r: Array) -> Array:
    """Return C (..., 3, 6) with omega x (omega x r) = C z[13:19], the products w_i w_j of omega."""
    x, y, z = np.moveaxis(r, -1, 0)
    o = np.zeros_like(x)
    rows = [[o, -x, -x, y, z, o], [-y, o, -y, x, o, z], [-z, -z, o, o, x, y]]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def normal_equations(Z: Array, W: Array) -> tuple[Array, Array]:
    """Return Gram matrix (16, 16) and right side (16,) for [offsets; phi], from Z = sum of z z^T.

    `W` (6, 6) are the weights between the wrench channels.
    """
    T = regressor_coefficients()
    TZ = (T.reshape(96, 19) @ Z).reshape(6, 16, 19)
    WT = (W @ T.reshape(6, -1)).reshape(6, 16, 19)
    gram = TZ.transpose(1, 0, 2).reshape(16, -1) @ WT.transpose(1, 0, 2).reshape(16, -1).T
    return 0.5 * (gram + gram.T), np.einsum("cjd,cd->j", TZ[:, :, 1:7], W)


def residual_covariance(Z: Array, theta: Array) -> Array:
    """Return the mean (6, 6) of r r^T, r = F - [E, V] theta, from Z, the mean of z z^T."""
    L = -np.einsum("cjk,j->ck", regressor_coefficients(), theta)
    L[np.arange(6), np.arange(1, 7)] += 1.0
    S = L @ Z @ L.T
    return 0.5 * (S + S.T)


def excited_columns(Z: Array) -> NDArray[np.bool_]:
    """Return (16,) True for parameters whose influence on the wrench exceeds rounding errors."""
    return np.diag(normal_equations(Z, np.eye(6))[0]) > _MIN_RMS_OF_EXCITED_COLUMN**2


def root_of_pseudo_inverse(gram: Array, used: NDArray[np.bool_]) -> Array:
    """Return R (n, rank) with R R^T the pseudo-inverse of the Gram matrix of the `used` columns."""
    return _gram_root_and_null_space(gram, used)[0]


def _gram_root_and_null_space(gram: Array, used: NDArray[np.bool_]) -> tuple[Array, Array, Array]:
    scale = np.where(used, 1.0 / np.sqrt(np.where(used, np.diag(gram), 1.0)), 0.0)
    eigenvalues, vectors = np.linalg.eigh(gram * np.outer(scale, scale))
    kept = eigenvalues > _MIN_RELATIVE_GRAM_EIGENVALUE * eigenvalues[-1]
    root = np.asarray(scale[:, None] * vectors[:, kept] / np.sqrt(eigenvalues[kept]), np.float64)
    return root, eigenvalues[kept], vectors[:, ~kept]


def _pseudo_inverse(
    gram: Array, unexcited: NDArray[np.bool_]
) -> tuple[Array, NDArray[np.bool_], float]:
    root, eigenvalues, null = _gram_root_and_null_space(gram, ~unexcited)
    undetermined = np.asarray((np.abs(null) > _MAX_DETERMINED_NULL_COMPONENT).any(axis=1))
    return root @ root.T, undetermined, float(np.sqrt(eigenvalues[-1] / eigenvalues[0]))


def _regressor_sums_of_blocks(blocks: Array) -> Array:
    return np.asarray(np.einsum("cjk,bk->bcj", regressor_coefficients(), blocks))


@njit(cache=True)
def _add_sample_products(wrench, s, omega, alpha, weights, sums, blocks, block_state):
    z = np.empty(19)
    last, length, filled = block_state
    for i in range(wrench.shape[0]):
        if filled == length:
            last, filled = last + 1, 0
        if last == blocks.shape[0]:
            last, length = last // 2, 2 * length
            for b in range(last):
                blocks[b] = blocks[2 * b] + blocks[2 * b + 1]
            blocks[last:] = 0.0
        filled += 1
        z[0], z[1:7], z[7:10], z[10:13] = 1.0, wrench[i], s[i], alpha[i]
        for k in range(3):
            z[13 + k] = omega[i, k] * omega[i, k]
        z[16] = omega[i, 0] * omega[i, 1]
        z[17] = omega[i, 0] * omega[i, 2]
        z[18] = omega[i, 1] * omega[i, 2]
        for j in range(19):
            weighted = weights[i] * z[j]
            blocks[last, j] += weighted
            for k in range(j, 19):
                sums[j, k] += weighted * z[k]
    block_state[0], block_state[1], block_state[2] = last, length, filled
