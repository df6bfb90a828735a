"""Load and sensor offsets by batch least squares, Eqs. (7)-(8), (T3) and (T16).

In directions without excitation the solution has minimum norm, and affected parameters are
undetermined. Theory: docs/theory.md, "Details of the estimators".
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import fdtrc

from drake_teleop.common.compiled import njit
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array, checked, checked_rows, number, positive
from drake_teleop.load.identification import Identification, worth_stating
from drake_teleop.load.regressor import regressor_into

# Smallest relative eigenvalue of the scaled Gram, largest component of a determined parameter in
# the null space, and smallest excitation of a column [m/s^2, rad/s^2].
_MIN_EIGENVALUE, _MAX_NULL_COMPONENT, _MIN_EXCITATION = 1e-12, 1e-6, 1e-9
# Number of blocks, smallest block length over the noise's correlation time, fewest degrees of
# freedom of a usable variance.
_MAX_BLOCKS, _MIN_CORRELATION_TIMES, _MIN_DEGREES = 1024, 4.0, 8.0
# For noise that is weaker at low frequencies: fewest degrees of freedom, and smallest share of the
# fit's degrees of freedom that the blocks contain.
_MIN_DEGREES_LONGEST, _MIN_ABSORBED_SHARE = 20.0, 0.9
_MIN_SAMPLES = 3
# Largest difference of specific force in one orientation [m/s^2], and level of the F test.
_SAME_POSE_M_S2, _F_TEST_LEVEL = 0.05, 0.01
# Largest relative residual that is rounding of the sums.
_ROUNDING_RESIDUAL = 1e-6
# Indices of the wrench and of the factors of [offset, phi] in x.
_WRENCH, _MODEL = 1, np.array([0, *range(2, 12)])


class NormalEquations:
    """Least squares sums of a record, from which load and sensor offsets are solved.

    Samples are added in the order of time, because their noise may be correlated.

    Args:
        noise: (6,) standard deviations of the wrench channels [N, N m]; None: equal weights.
        resolution: (2,) quantisation step of forces and torques [N, N m], only for poses at rest.
    """

    def __init__(
        self, noise: ArrayLike | None = None, *, resolution: tuple[float, float] | None = None
    ) -> None:
        self._resolution = resolution
        self._weights = np.ones(6) if noise is None else positive("noise", noise, 6) ** -2.0
        # Channel c: sum of x x^T, x = [1, wrench c, row c of V (10)], and its first row per block.
        self._moments = np.zeros((6, 12, 12))
        self._blocks = np.zeros((_MAX_BLOCKS, 6, 12))
        # Index of the open block, samples of a full block.
        self._state = np.array([0, 1])

    @property
    def samples(self) -> int:
        """Number of samples."""
        return int(self._moments[0, 0, 0])

    def add(self, wrench: ArrayLike, s: ArrayLike, omega: ArrayLike, alpha: ArrayLike) -> None:
        """Add N samples with arguments as for `identify`, or a single one, (6,) and (3,)."""
        _, rows = checked_rows(wrench=(wrench, 6), s=(s, 3), omega=(omega, 3), alpha=(alpha, 3))
        _accumulate(*rows, self._moments, self._blocks, self._state)

    def solve(self, delay_s: float = 0.0) -> Identification:
        """Return the least squares solution; `delay_s` [s] is only stored in it.

        Raises:
            DrakeTeleopError: for fewer than 3 samples or an estimated mass of exactly zero.
        """
        if self.samples < _MIN_SAMPLES:
            raise DrakeTeleopError(
                f"{self.samples} samples cannot determine a load",
                remedy=f"give at least {_MIN_SAMPLES}, in different orientations",
            )
        inverse, undetermined, condition_number = self._pseudo_inverse()
        theta = inverse @ self.normal_equations()[1]
        if theta[6] == 0.0:
            raise DrakeTeleopError(
                "the mass cannot be identified from this wrench",
                where="wrench",
                remedy="check that the sensor is connected and that its orientation changes",
            )
        covariance, degrees = self._covariance(theta, inverse)
        covariance[undetermined, :] = covariance[:, undetermined] = 0.0
        covariance[undetermined, undetermined] = degrees[undetermined] = np.inf
        return Identification(
            phi=theta[6:],
            offsets=theta[:6],
            covariance=covariance,
            identifiable=worth_stating(np.sqrt(np.diag(covariance)), theta[6:]),
            condition_number=condition_number,
            delay_s=number("delay_s", delay_s),
            residual_rms=np.sqrt(self.residual_squares(theta) / self.samples),
            method="batch least squares",
            samples=self.samples,
            degrees_of_freedom=degrees,
        )

    def covariance(self) -> Array:
        """Return the finite covariance C (16, 16) of the minimum-norm solution [offsets; phi].

        c^T C c is the variance of a determined combination c (16,) of parameters.
        """
        inverse, _, _ = self._pseudo_inverse()
        return self._covariance(inverse @ self.normal_equations()[1], inverse)[0]

    def _covariance(self, theta: Array, inverse: Array) -> tuple[Array, Array]:
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
        return _pseudo_inverse(self.normal_equations()[0], self.unexcited)

    def normal_equations(self, weights: ArrayLike | None = None) -> tuple[Array, Array]:
        """Return Gram matrix (16, 16) and right-hand side (16,) of [offsets; phi].

        `weights` (6,) of the channels are by default those of the noise.
        """
        weights = self._weights if weights is None else checked("weights", weights, 6)
        gram, right = np.tensordot(weights, self._channel_grams(), 1), np.zeros(16)
        for c, weight in enumerate(weights):
            right[_columns(c)] += weight * self._moments[c, _MODEL, _WRENCH]
        return gram, right

    def _channel_grams(self) -> Array:
        grams = np.zeros((6, 16, 16))
        for c in range(6):
            grams[c][np.ix_(_columns(c), _columns(c))] = self._moments[c][np.ix_(_MODEL, _MODEL)]
        return grams

    @property
    def unexcited(self) -> NDArray[np.bool_]:
        """Booleans (16,): True for parameters that do not influence the wrench."""
        squares = np.diag(self.normal_equations(np.ones(6))[0]) / self.samples
        return np.sqrt(squares) < _MIN_EXCITATION

    @property
    def weights(self) -> Array:
        """Weights (6,) of the squared residuals of the wrench channels."""
        return self._weights.copy()

    def residual_squares(self, theta: ArrayLike) -> Array:
        """Return the sums (6,) of squared residuals of the channels for theta = [offsets; phi]."""
        theta = checked("theta", theta, 16)
        squares = np.empty(6)
        for c in range(6):
            x = np.concatenate([[-theta[c], 1.0], -theta[6:]])
            squares[c] = max(0.0, x @ self._moments[c] @ x)
        return squares

    def long_run_variances(self, theta: ArrayLike) -> tuple[Array, Array]:
        """Return residual variances (6,) with correlation in time, and degrees of freedom (6,).

        `theta` is [offsets; phi] (16,).
        """
        inverse, _, _ = self._pseudo_inverse()
        return self._long_run_variances(checked("theta", theta, 16), inverse)[:2]

    def slow_noise(self) -> NDArray[np.bool_]:
        """Return (6,) True for wrench channels whose noise is slower than the record resolves.

        Standard deviations are then too small.
        """
        inverse, _, _ = self._pseudo_inverse()
        return self._long_run_variances(inverse @ self.normal_equations()[1], inverse)[2]

    def _long_run_variances(
        self, theta: Array, inverse: Array
    ) -> tuple[Array, Array, NDArray[np.bool_]]:
        grams = self._channel_grams()
        n = float(self.samples)
        power = self.residual_squares(theta)
        if self._resolution is not None:
            absorbed = self._absorbed(grams, inverse)
            return *self._pose_variances(power, absorbed, theta), np.zeros(6, dtype=bool)
        variances, degrees = self._unbiased(power, n, grams, grams, inverse)
        of_samples = variances
        # Rounding in the sums must not count as noise of the wrench.
        wrench = self._moments[:, _WRENCH, _WRENCH]
        found, slow = np.zeros(6, dtype=bool), np.zeros(6, dtype=bool)
        sample_absorbed = self._absorbed(grams, inverse)
        longest, longest_degrees = variances, degrees
        blocks, length = self._blocks[: self._state[0] + 1], float(self._state[1])
        # An unfinished last block would have the weight of a full one.
        blocks = blocks[: len(blocks) - (blocks[-1, 0, 0] < length)]
        while len(blocks) > _MIN_DEGREES:
            model = blocks[:, :, 0] * theta[:6] + blocks[:, :, 2:] @ theta[6:]
            power = np.sum((blocks[:, :, _WRENCH] - model) ** 2, axis=0) / length
            between = np.zeros((6, 16, 16))
            for c in range(6):
                means = blocks[:, c, _MODEL]
                between[c][np.ix_(_columns(c), _columns(c))] = means.T @ means / length
            estimated, counted = self._unbiased(power, len(blocks), between, grams, inverse)
            usable = ~found & (counted >= _MIN_DEGREES)
            correlation = np.divide(estimated, of_samples, out=np.ones(6), where=of_samples > 0.0)
            at_borders = np.minimum(correlation / (2.0 * length), 0.5 / _MIN_CORRELATION_TIMES)
            corrected = estimated / (1.0 - np.where(correlation > 1.5, at_borders, 0.0))
            enough = usable & (length >= _MIN_CORRELATION_TIMES * correlation)
            larger = usable & ~enough & (corrected > variances)
            take = enough | larger
            variances = np.where(take, corrected, variances)
            degrees = np.where(take, counted, degrees)
            found |= enough
            has_motion = self._absorbed(between, inverse) >= _MIN_ABSORBED_SHARE * sample_absorbed
            is_longest = has_motion & (counted >= _MIN_DEGREES_LONGEST)
            longest = np.where(is_longest, estimated, longest)
            longest_degrees = np.where(is_longest, counted, longest_degrees)
            significant = correlation > 1.0 + 3.0 * np.sqrt(2.0 / np.maximum(counted, 1.0))
            slow = np.where(usable, significant & ~found, slow & ~found)
            even = len(blocks) // 2 * 2
            blocks, length = blocks[0:even:2] + blocks[1:even:2], 2.0 * length
        # The logarithm of an estimated variance is nearly normal, with deviation sqrt(2 / degrees).
        weaker = found & (longest * np.exp(3.0 * np.sqrt(2.0 / longest_degrees)) < variances)
        variances = np.where(weaker, longest, variances)
        degrees = np.where(weaker, longest_degrees, degrees)
        return variances, degrees, slow & (n * of_samples > _ROUNDING_RESIDUAL**2 * wrench)

    def _pose_variances(self, power: Array, absorbed: Array, theta: Array) -> tuple[Array, Array]:
        assert self._resolution is not None
        squares, absorbed_sums = (x.reshape(2, 3).sum(axis=1) for x in (power, absorbed))
        min_variance = np.array(self._resolution) ** 2 / 12.0
        blocks = self._blocks[: self._state[0] + 1]
        count = blocks[:, 0, 0]
        s = blocks[:, range(3), 2] / count[:, None]
        first = (np.linalg.norm(s[:, None] - s, axis=2) < _SAME_POSE_M_S2).argmax(axis=1)
        groups = (np.unique(first)[:, None] == first).astype(float)
        sums = groups @ (
            blocks[:, :, _WRENCH] - blocks[:, :, 0] * theta[:6] - blocks[:, :, 2:] @ theta[6:]
        )
        between = (sums**2 / (groups @ count)[:, None]).reshape(-1, 2, 3).sum(axis=(0, 2))
        left, repeats = 3.0 * len(groups) - absorbed_sums, 3.0 * (self.samples - len(groups))
        within = np.maximum(squares - between, repeats * min_variance) / max(repeats, 1.0)
        f_ratio = np.divide(
            between, left * within, out=np.zeros(2), where=(left > 0.0) & (within > 0.0)
        )
        differ = fdtrc(np.maximum(left, 1.0), max(repeats, 1.0), f_ratio) < _F_TEST_LEVEL
        degrees = np.where(differ, left, left + repeats)
        squares = np.where(differ, between, squares)
        variances = np.maximum(squares / np.maximum(degrees, 1.0), min_variance)
        return variances.repeat(3), degrees.repeat(3)

    def _absorbed(self, between: Array, inverse: Array) -> Array:
        return np.asarray(self._weights * np.einsum("cij,ji->c", between, inverse))

    def _unbiased(
        self, power: Array, count: float, between: Array, grams: Array, inverse: Array
    ) -> tuple[Array, Array]:
        w = self._weights
        absorbed = self._absorbed(between, inverse)
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

    Raises:
        DrakeTeleopError: for fewer than 3 samples or an estimated mass of exactly zero.
    """
    equations = NormalEquations(noise)
    equations.add(wrench, s, omega, alpha)
    return equations.solve(delay_s)


def _columns(channel: int) -> NDArray[np.int_]:
    return np.array([channel, *range(6, 16)])


@njit(cache=True)
def _accumulate(wrench, s, omega, alpha, moments, blocks, state):
    """Add samples to the sums of x x^T, x = [1, wrench, row of V], per channel and per block.

    A full table of blocks is halved by joining pairs.
    """
    V, x, part = np.empty((6, 10)), np.empty(12), np.zeros((6, 12, 12))
    x[0] = 1.0
    last, length = state[0], state[1]
    remaining = length - int(blocks[last, 0, 0])
    for i in range(wrench.shape[0]):
        if remaining == 0:
            _add_block(part, moments, blocks[last])
            last += 1
            if last == blocks.shape[0]:
                last //= 2
                length *= 2
                for b in range(last):
                    blocks[b] = blocks[2 * b] + blocks[2 * b + 1]
                blocks[last:] = 0.0
            remaining = length
        remaining -= 1
        regressor_into(s[i], omega[i], alpha[i], V)
        for c in range(6):
            size = 6 if c < 3 else 12
            x[1] = wrench[i, c]
            for k in range(size - 2):
                x[2 + k] = V[c, k]
            for j in range(size):
                for k in range(j, size):
                    part[c, j, k] += x[j] * x[k]
    _add_block(part, moments, blocks[last])
    state[0], state[1] = last, length


@njit(cache=True)
def _add_block(part, moments, block):
    for c in range(6):
        for j in range(12):
            block[c, j] += part[c, 0, j]
            moments[c, j, j] += part[c, j, j]
            for k in range(j + 1, 12):
                moments[c, j, k] += part[c, j, k]
                moments[c, k, j] += part[c, j, k]
    part[:] = 0.0


def _pseudo_inverse(
    gram: Array, unexcited: NDArray[np.bool_]
) -> tuple[Array, NDArray[np.bool_], float]:
    scale = np.where(unexcited, 0.0, 1.0 / np.sqrt(np.where(unexcited, 1.0, np.diag(gram))))
    eigenvalues, vectors = np.linalg.eigh(gram * np.outer(scale, scale))
    kept = eigenvalues > _MIN_EIGENVALUE * eigenvalues[-1]
    half = scale[:, None] * vectors[:, kept] / np.sqrt(eigenvalues[kept])
    undetermined = (np.abs(vectors[:, ~kept]) > _MAX_NULL_COMPONENT).any(axis=1)
    condition_number = float(np.sqrt(eigenvalues[-1] / eigenvalues[kept][0]))
    return half @ half.T, undetermined, condition_number
