"""The load and the sensor's offsets from a record: batch least squares, Eqs. (7)-(8).

The measured wrench of a free motion is F = [E V] [F_o; phi] + residual. `NormalEquations` sums what
least squares needs over any number of samples, chunk by chunk, and never builds the stacked matrix.

**Directions.** Columns are scaled to unit norm and the Gram matrix is decomposed. Directions with
an eigenvalue below 1e-12 of the largest are undetermined: that is 1e-6 in terms of the regressor,
which no sensor resolves, and where the rounding of the sums begins. The solution has no component
there (minimum norm), and a parameter that has one is undetermined: its variance is infinite.

**Coloured residuals.** Residuals of real records are coloured (filters, vibration, drift), so that
N samples are worth far fewer. With the noise of channel c stationary and independent of the motion,
and its spectrum flat over the frequencies of the motion, the covariance of the solution is that of
white noise with the long-run variance v_c (spectral density at zero) in place of the variance of a
sample: C = G^+ (sum_c w_c^2 v_c G_c) G^+, G_c the Gram matrix of channel c and w_c its weight.
Noise that is strongest at low frequency makes this cautious for fast motion. v_c comes from blocks
of n samples whose sums were kept (batch means):

- The residual's power between the B blocks, q_c = sum_b (sum of residual)^2 / n, would be B v_c on
  average, but the fit has taken part of it away, most at the low frequencies of the motion, where
  blocks look. With H_c the Gram matrix of the blocks' means, E q_c = v_c (B - 2 w_c tr(H_c G^+))
  + sum_k w_k^2 v_k tr(H_c G^+ G_k G^+): six linear equations whose solution has no such bias.
- The length is the first of 1, n, 2 n, 4 n, ... that is at least `_WINDOW` times the noise's memory
  T = v_c / (variance of a sample), T estimated at that length: the automatic windowing of Sokal
  (Monte Carlo Methods in Statistical Mechanics, 1997, section 3) applied to batch means. Blocks
  miss what correlates across their borders; for an AR(1) process that is T / (2 n) of v_c, which is
  put back. If no length with `_FEWEST_DEGREES` degrees of freedom is long enough (drift), the
  largest v_c of all lengths is taken: it is then still a lower bound.
- Noise may also be weaker at low frequencies than from sample to sample, as that of accelerations
  that were fused with encoders. Short blocks do not see that. The longest blocks are therefore
  looked at that leave `_MANY_DEGREES` and still see the motion (`_SEEN` of what the fit took away):
  if their v_c is smaller by three of its standard deviations, it is the one.
- v_c has about B - w_c tr(H_c G^+) degrees of freedom, few if the noise is slow. The variance of a
  parameter is a weighted sum of the six v_c; Satterthwaite's formula gives its degrees of freedom
  nu, and an interval is +- t_nu times the standard deviation (`uncertainty.intervals`).
  benchmarks/intervals.py counts how often such intervals hold.

**Poses at rest** are few, and in no order. The three forces then share one noise and the three
torques another, from all of their residuals and the degrees of freedom that the fit leaves. Poses
with the same orientation show what repeats: if the others deviate from the fit by significantly
more (F test at `_ALPHA`), the error belongs to the orientation, and repeating it adds no
information. The variance is then that between orientations. It is never below that of rounding.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import fdtrc

from drake_teleop.common.arrays import Array, checked, checked_rows, number, positive
from drake_teleop.common.compiled import njit
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.identification import METHODS, Identification, worth_stating
from drake_teleop.load.regressor import regressor_into

# Rank: smallest eigenvalue of the scaled Gram over the largest, component of a parameter in the
# null space, and excitation of a column [m/s^2, rad/s^2] below which it counts as none.
_RANK, _NULL_COMPONENT, _NO_EXCITATION = 1e-12, 1e-6, 1e-9
# Blocks kept, least length of a block in memories of the noise, degrees of freedom to be trusted.
_MOST_BLOCKS, _WINDOW, _FEWEST_DEGREES = 1024, 4.0, 8.0
# For noise that is weaker at low frequencies: degrees of freedom, share of the motion that is seen.
_MANY_DEGREES, _SEEN = 20.0, 0.9
_FEWEST_SAMPLES = 3
# Poses of one orientation: difference of specific force [m/s^2]; level of the F test.
_SAME_POSE, _ALPHA = 0.05, 0.01
# Residual over wrench that rounding of the sums may leave.
_ROUNDING = 1e-6
# Where the wrench and the factors of [offset, phi] stand in x of the sums.
_WRENCH, _MODEL = 1, np.array([0, *range(2, 12)])


class NormalEquations:
    """Sums over a record from which the load follows, in memory that does not grow with it.

    Samples have to come in the order of time: the variances are judged from consecutive blocks.

    Args:
        noise: (6,) standard deviations of the wrench channels [N, N m], for the weights. None
            gives every row the same weight, in N and N m alike.
        resolution: (2,) step of the numbers of forces and torques [N, N m], if the samples are
            poses at rest; None for samples in the order of time.

    Raises:
        DrakeTeleopError: if a standard deviation is not a positive number.
    """

    def __init__(
        self, noise: ArrayLike | None = None, *, resolution: tuple[float, float] | None = None
    ) -> None:
        self._resolution = resolution
        self._weights = np.ones(6) if noise is None else positive("noise", noise, 6) ** -2.0
        # Channel c: sum of x x^T, x = [1, wrench c, row c of V (10)]; and its first row by blocks.
        self._moments = np.zeros((6, 12, 12))
        self._blocks = np.zeros((_MOST_BLOCKS, 6, 12))
        # Block that is being filled, samples of a full block.
        self._state = np.array([0, 1])

    @property
    def samples(self) -> int:
        """The number of samples so far."""
        return int(self._moments[0, 0, 0])

    def add(self, wrench: ArrayLike, s: ArrayLike, omega: ArrayLike, alpha: ArrayLike) -> None:
        """Adds samples.

        Args:
            wrench: (N, 6) or (6,) measured [f; tau] in S about So, sign of Eq. (1) [N, N m].
            s, omega, alpha: (N, 3) or (3,) specific force [m/s^2], angular velocity [rad/s] and
                acceleration [rad/s^2] of S in S.

        Raises:
            DrakeTeleopError: for arrays of another shape or with numbers that are not finite.
        """
        _, rows = checked_rows(wrench=(wrench, 6), s=(s, 3), omega=(omega, 3), alpha=(alpha, 3))
        _accumulate(*rows, self._moments, self._blocks, self._state)

    def solve(self, delay_s: float = 0.0) -> Identification:
        """Least squares with the six offsets.

        Args:
            delay_s: the delay that was taken out of the motion, for the record [s].

        Raises:
            DrakeTeleopError: for fewer than 3 samples, or if the wrench is zero throughout.
        """
        if self.samples < _FEWEST_SAMPLES:
            raise DrakeTeleopError(
                f"{self.samples} samples cannot determine a load",
                remedy=f"give at least {_FEWEST_SAMPLES}, in different orientations",
            )
        inverse, undetermined, condition_number = self._pseudo_inverse()
        theta = inverse @ self.normal_equations()[1]
        if theta[6] == 0.0:
            raise DrakeTeleopError(
                "no mass can be told from this wrench",
                where="wrench",
                remedy="is the sensor connected, and does its orientation change?",
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
            method=METHODS[0],
            samples=self.samples,
            degrees_of_freedom=degrees,
        )

    def covariance(self) -> Array:
        """(16, 16) covariance of the least squares solution of minimum norm, columns scaled.

        Unlike `Identification.covariance` it has no infinite entries: the variance c^T C c of a
        combination c that the record determines is right even if its parts are undetermined.
        """
        inverse, _, _ = self._pseudo_inverse()
        return self._covariance(inverse @ self.normal_equations()[1], inverse)[0]

    def _covariance(self, theta: Array, inverse: Array) -> tuple[Array, Array]:
        """(16, 16) covariance without infinities and (16,) degrees of freedom of its diagonal."""
        variances, degrees, _ = self._long_run_variances(theta, inverse)
        # What each channel adds to the covariance, and Satterthwaite's degrees of freedom.
        parts = self._channel_grams() * (self._weights**2 * variances)[:, None, None]
        parts = inverse @ parts @ inverse
        shares = np.diagonal(parts, axis1=1, axis2=2)
        if self._resolution is not None:  # three channels have one variance
            shares, degrees = shares.reshape(2, 3, 16).sum(axis=1), degrees[::3]
        total, of_squares = shares.sum(axis=0), (shares**2 / degrees[:, None]).sum(axis=0)
        known = (total > 0.0) & (of_squares > 0.0)
        return parts.sum(axis=0), np.divide(
            total**2, of_squares, out=np.full(16, np.inf), where=known
        )

    def _pseudo_inverse(self) -> tuple[Array, NDArray[np.bool_], float]:
        return _pseudo_inverse(self.normal_equations()[0], self.unexcited)

    def normal_equations(self, weights: ArrayLike | None = None) -> tuple[Array, Array]:
        """Gram (16, 16) and right-hand side (16,) of [E V], sums over the rows.

        Args:
            weights: (6,) of the squares of each wrench channel [1/N^2, 1/(N m)^2]; default: those
                of the noise given at the start.
        """
        weights = self._weights if weights is None else checked("weights", weights, 6)
        gram, right = np.tensordot(weights, self._channel_grams(), 1), np.zeros(16)
        for c, weight in enumerate(weights):
            right[_columns(c)] += weight * self._moments[c, _MODEL, _WRENCH]
        return gram, right

    def _channel_grams(self) -> Array:
        """(6, 16, 16) Gram matrices of the rows of each channel."""
        grams = np.zeros((6, 16, 16))
        for c in range(6):
            grams[c][np.ix_(_columns(c), _columns(c))] = self._moments[c][np.ix_(_MODEL, _MODEL)]
        return grams

    @property
    def unexcited(self) -> NDArray[np.bool_]:
        """(16,) parameters that had no part in the wrench at all, up to rounding."""
        squares = np.diag(self.normal_equations(np.ones(6))[0]) / self.samples
        return np.sqrt(squares) < _NO_EXCITATION

    @property
    def weights(self) -> Array:
        """(6,) of the squares of each wrench channel, from the noise given at the start."""
        return self._weights.copy()

    def residual_squares(self, theta: ArrayLike) -> Array:
        """(6,) sums of squared residuals; rounding leaves 1e-7 of the wrench in their roots.

        Args:
            theta: (16,) [offsets; phi].
        """
        theta = checked("theta", theta, 16)
        squares = np.empty(6)
        for c in range(6):
            x = np.concatenate([[-theta[c], 1.0], -theta[6:]])
            squares[c] = max(0.0, x @ self._moments[c] @ x)
        return squares

    def long_run_variances(self, theta: ArrayLike) -> tuple[Array, Array]:
        """Long-run variances of the channels' residuals, for any estimate (module docstring).

        Args:
            theta: (16,) [offsets; phi].

        Returns:
            (6,) variances of a sample by which the mean of many scatters [N^2, N^2 m^2], corrected
            for what least squares with the present weights takes from the residuals, and (6,) their
            degrees of freedom.
        """
        inverse, _, _ = self._pseudo_inverse()
        return self._long_run_variances(checked("theta", theta, 16), inverse)[:2]

    def slow_noise(self) -> NDArray[np.bool_]:
        """(6,) channels whose noise remembers longer than the record can tell, as drift does.

        The standard deviations that follow from them are lower bounds.
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
            return *self._of_poses(power, absorbed, theta), np.zeros(6, dtype=bool)
        variances, degrees = self._unbiased(power, n, grams, grams, inverse)
        of_samples = variances
        # Rounding in the sums is no noise of the wrench.
        wrench = self._moments[:, _WRENCH, _WRENCH]
        found, slow = np.zeros(6, dtype=bool), np.zeros(6, dtype=bool)
        absorbed_by_samples = self._absorbed(grams, inverse)
        of_longest, degrees_of_longest = variances, degrees
        blocks, length = self._blocks[: self._state[0] + 1], float(self._state[1])
        # An unfinished last block would count as much as a full one.
        blocks = blocks[: len(blocks) - (blocks[-1, 0, 0] < length)]
        while len(blocks) > _FEWEST_DEGREES:
            model = blocks[:, :, 0] * theta[:6] + blocks[:, :, 2:] @ theta[6:]
            power = np.sum((blocks[:, :, _WRENCH] - model) ** 2, axis=0) / length
            between = np.zeros((6, 16, 16))
            for c in range(6):
                means = blocks[:, c, _MODEL]
                between[c][np.ix_(_columns(c), _columns(c))] = means.T @ means / length
            now, trusted = self._unbiased(power, len(blocks), between, grams, inverse)
            usable = ~found & (trusted >= _FEWEST_DEGREES)
            memory = np.divide(now, of_samples, out=np.ones(6), where=of_samples > 0.0)
            missed = np.minimum(memory / (2.0 * length), 0.5 / _WINDOW)
            corrected = now / (1.0 - np.where(memory > 1.5, missed, 0.0))
            enough = usable & (length >= _WINDOW * memory)
            larger = usable & ~enough & (corrected > variances)
            take = enough | larger
            variances = np.where(take, corrected, variances)
            degrees = np.where(take, trusted, degrees)
            found |= enough
            sees = self._absorbed(between, inverse) >= _SEEN * absorbed_by_samples
            longest = sees & (trusted >= _MANY_DEGREES)
            of_longest = np.where(longest, now, of_longest)
            degrees_of_longest = np.where(longest, trusted, degrees_of_longest)
            significant = memory > 1.0 + 3.0 * np.sqrt(2.0 / np.maximum(trusted, 1.0))
            slow = np.where(usable, significant & ~found, slow & ~found)
            even = len(blocks) // 2 * 2
            blocks, length = blocks[0:even:2] + blocks[1:even:2], 2.0 * length
        # Logarithms of estimated variances scatter by sqrt(2 / degrees), and about normally.
        weaker = found & (of_longest * np.exp(3.0 * np.sqrt(2.0 / degrees_of_longest)) < variances)
        variances = np.where(weaker, of_longest, variances)
        degrees = np.where(weaker, degrees_of_longest, degrees)
        return variances, degrees, slow & (n * of_samples > _ROUNDING**2 * wrench)

    def _of_poses(self, power: Array, absorbed: Array, theta: Array) -> tuple[Array, Array]:
        """(6,) variances of poses at rest and (6,) their degrees of freedom (module docstring).

        Args:
            power: (6,) sums of squared residuals.
            absorbed: (6,) degrees of freedom that the fit takes from them.
            theta: (16,) [offsets; phi].
        """
        assert self._resolution is not None
        squares, lost = (x.reshape(2, 3).sum(axis=1) for x in (power, absorbed))
        least = np.array(self._resolution) ** 2 / 12.0
        blocks = self._blocks[: self._state[0] + 1]
        count = blocks[:, 0, 0]
        s = blocks[:, range(3), 2] / count[:, None]
        first = (np.linalg.norm(s[:, None] - s, axis=2) < _SAME_POSE).argmax(axis=1)
        groups = (np.unique(first)[:, None] == first).astype(float)
        sums = groups @ (
            blocks[:, :, _WRENCH] - blocks[:, :, 0] * theta[:6] - blocks[:, :, 2:] @ theta[6:]
        )
        between = (sums**2 / (groups @ count)[:, None]).reshape(-1, 2, 3).sum(axis=(0, 2))
        left, repeats = 3.0 * len(groups) - lost, 3.0 * (self.samples - len(groups))
        within = np.maximum(squares - between, repeats * least) / max(repeats, 1.0)
        apart = np.divide(
            between, left * within, out=np.zeros(2), where=(left > 0.0) & (within > 0.0)
        )
        differ = fdtrc(np.maximum(left, 1.0), max(repeats, 1.0), apart) < _ALPHA
        degrees = np.where(differ, left, left + repeats)
        squares = np.where(differ, between, squares)
        variances = np.maximum(squares / np.maximum(degrees, 1.0), least)
        return variances.repeat(3), degrees.repeat(3)

    def _absorbed(self, between: Array, inverse: Array) -> Array:
        """(6,) degrees of freedom that the fit takes from the residuals between blocks."""
        return np.asarray(self._weights * np.einsum("cij,ji->c", between, inverse))

    def _unbiased(
        self, power: Array, count: float, between: Array, grams: Array, inverse: Array
    ) -> tuple[Array, Array]:
        """(6,) v_c and (6,) degrees of freedom from the residual's power between `count` blocks.

        Args:
            power: (6,) q_c of the module's docstring.
            between: (6, 16, 16) H_c; grams: (6, 16, 16) G_c; inverse: (16, 16) G^+.
        """
        w = self._weights
        absorbed = self._absorbed(between, inverse)
        spread = inverse @ grams @ inverse
        shares = np.einsum("cij,kji->ck", between, spread) * w**2
        degrees = np.maximum(count - absorbed, 0.0)
        equations = np.diag(count - 2.0 * absorbed) + shares
        if not (degrees > 0.0).all() or np.linalg.cond(equations) > 1e6:
            return power / np.maximum(degrees, 1.0), degrees
        solution = np.linalg.solve(equations, power)
        # Noise in q_c can make a small one negative, where the others' errors dominate it.
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
    """Load and sensor offsets of a free motion by batch least squares, Eqs. (7)-(8).

    Args:
        wrench: (N, 6) measured [f; tau] in S about So, sign of Eq. (1) [N, N m].
        s, omega, alpha: (N, 3) specific force a - g [m/s^2], angular velocity [rad/s] and angular
            acceleration [rad/s^2] of S in S, at the same instants; zeros (3,) for static poses.
        noise: (6,) standard deviations of the wrench channels, for the weights; None: unweighted.
        delay_s: the delay that was taken out of the motion, for the record [s].

    Raises:
        DrakeTeleopError: for arrays of another shape, numbers that are not finite, fewer than
            3 samples, or a wrench that is zero throughout.
    """
    equations = NormalEquations(noise)
    equations.add(wrench, s, omega, alpha)
    return equations.solve(delay_s)


def _columns(channel: int) -> NDArray[np.int_]:
    """Columns of [E V] that a row of this channel may use: its offset and phi."""
    return np.array([channel, *range(6, 16)])


@njit(cache=True)
def _accumulate(wrench, s, omega, alpha, moments, blocks, state):
    """Adds sum x x^T, x = [1, wrench, row of V], by channel to moments (6, 12, 12), and the sums of
    x by blocks of samples to blocks (_MOST_BLOCKS, 6, 12).

    Rows of force have no inertia in them: their sums end with the first moments. Sums are gathered
    block by block, which keeps their rounding small. When the table of blocks is full, neighbours
    are joined. state: the block that is being filled, and how many samples a full one has.
    """
    V, x, part = np.empty((6, 10)), np.empty(12), np.zeros((6, 12, 12))
    x[0] = 1.0
    last, length = state[0], state[1]
    room = length - int(blocks[last, 0, 0])
    for i in range(wrench.shape[0]):
        if room == 0:
            _flush(part, moments, blocks[last])
            last += 1
            if last == blocks.shape[0]:
                last //= 2
                length *= 2
                for b in range(last):
                    blocks[b] = blocks[2 * b] + blocks[2 * b + 1]
                blocks[last:] = 0.0
            room = length
        room -= 1
        regressor_into(s[i], omega[i], alpha[i], V)
        for c in range(6):
            size = 6 if c < 3 else 12
            x[1] = wrench[i, c]
            for k in range(size - 2):
                x[2 + k] = V[c, k]
            for j in range(size):
                for k in range(j, size):
                    part[c, j, k] += x[j] * x[k]
    _flush(part, moments, blocks[last])
    state[0], state[1] = last, length


@njit(cache=True)
def _flush(part, moments, block):
    """Adds the upper halves of part (6, 12, 12) to moments, their first rows to block; clears."""
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
    """(inverse, undetermined (16,), condition number) of a Gram matrix, columns scaled."""
    scale = np.where(unexcited, 0.0, 1.0 / np.sqrt(np.where(unexcited, 1.0, np.diag(gram))))
    eigenvalues, vectors = np.linalg.eigh(gram * np.outer(scale, scale))
    kept = eigenvalues > _RANK * eigenvalues[-1]
    half = scale[:, None] * vectors[:, kept] / np.sqrt(eigenvalues[kept])
    undetermined = (np.abs(vectors[:, ~kept]) > _NULL_COMPONENT).any(axis=1)
    condition_number = float(np.sqrt(eigenvalues[-1] / eigenvalues[kept][0]))
    return half @ half.T, undetermined, condition_number
