"""What an identification knows: intervals, determined combinations, priors, predicted wrenches.

Standard deviations and degrees of freedom come with the `Identification`; how they are made honest
in coloured noise is said in the docstring of `identification`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import qr, solve_triangular
from scipy.special import stdtrit

from drake_teleop.common.arrays import Array, checked_rows
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.identification import (
    PARAMETERS,
    WORTH_STATING,
    Identification,
    natural_scale,
)
from drake_teleop.load.normal_equations import NormalEquations
from drake_teleop.load.regressor import regressor

_MANY_DEGREES = 1e6  # beyond, Student's t is the normal distribution to six digits
CHANNELS = ("f_x", "f_y", "f_z", "tau_x", "tau_y", "tau_z")
"""Names of the wrench channels."""

_UNITS = ("N",) * 3 + ("N m",) * 3 + ("kg",) + ("kg m",) * 3 + ("kg m^2",) * 6
# Directions of the scaled Gram below which nothing is determined (as in `identification`), and
# coefficients of combinations that count as zero: rounding.
_RANK, _NO_COEFFICIENT = 1e-12, 1e-6
# Terms of a combination that are worth a number, or a mention, as shares of the largest.
_WORTH_A_NUMBER, _WORTH_A_MENTION = 0.1, 0.01
_CHUNK = 2**13  # rows of V at a time: 4 MB


def intervals(load: Identification, level: float = 0.95) -> tuple[Array, Array]:
    """(16,) lower and (16,) upper ends of the intervals of [offsets; phi] [SI].

    Student's t with the degrees of freedom of each variance: variances that were estimated from few
    independent stretches of noise scatter themselves, and 1.96 standard deviations would hold
    less often than stated. Undetermined parameters have (-inf, inf).

    Args:
        load: the identification.
        level: share of the records in which an interval is to hold the truth.

    Raises:
        DrakeTeleopError: if the level is not within (0, 1).
    """
    if not 0.0 < level < 1.0:
        raise DrakeTeleopError(f"{level} is not within (0, 1)", where="level")
    degrees = np.minimum(load.degrees_of_freedom, _MANY_DEGREES)
    half = stdtrit(degrees, 0.5 + 0.5 * level) * load.standard_deviations
    theta = np.concatenate([load.offsets, load.phi])
    return theta - half, theta + half


def prior_dominated(
    standard_deviations: ArrayLike, prior_std: ArrayLike, share: float = 0.5
) -> NDArray[np.bool_]:
    """Which parameters are still mostly the prior's, for `Identification.prior_dominated`.

    An estimate with a Gaussian prior is the mean of data and prior weighted by their information;
    the prior's weight is the square of (posterior / prior standard deviation). From a share of 0.5
    on, the prior has a quarter of the weight or more, and the data alone would be less certain than
    0.58 of the prior.

    Args:
        standard_deviations: (n,) of the estimate.
        prior_std: (n,) of the prior; inf for none.
        share: of the prior's standard deviation from which on it dominates.

    Returns:
        (n,) bools.

    Raises:
        DrakeTeleopError: if the shapes differ or a standard deviation of the prior is not positive.
    """
    deviations, prior = np.asarray(standard_deviations), np.asarray(prior_std)
    if deviations.shape != prior.shape or not (prior > 0.0).all():
        raise DrakeTeleopError(
            f"takes positive numbers, one for each of {deviations.shape} parameters",
            where="prior_std",
        )
    return np.asarray(deviations >= share * prior)


@dataclass(frozen=True, eq=False)
class Combination:
    """A linear combination of [offsets; phi] that a record determines.

    Attributes:
        coefficients: (16,) of [offsets; phi]; the combination has the unit of its leading
            parameter, whose coefficient is 1.
        leading: index of that parameter in `PARAMETERS`.
        value: the estimate, in the unit of the leading parameter.
        standard_deviation: likewise.
        share: standard deviation over what is natural for the load (`natural_scale`).
        words: the sum, such as "I_zz + 0.2 m c_x"; terms below a tenth of the largest, by what is
            natural for the load, are "...", and those below a hundredth are left out.
    """

    coefficients: Array
    leading: int
    value: float
    standard_deviation: float
    share: float
    words: str

    def __str__(self) -> str:
        """For instance "I_zz + 0.2 m c_x = 0.31 +- 0.01 kg m^2"."""
        numbers = f"{self.value:.4g} +- {self.standard_deviation:.2g} {_UNITS[self.leading]}"
        return f"{self.words} = {numbers}"


@dataclass(frozen=True, eq=False)
class BaseParameters:
    """Which combinations of load and offsets a record determines (base parameters).

    Attributes:
        combinations: as many as the rank of [E V]; each is one parameter plus multiples of those
            that cannot be told from it. Gautier, Khalil, IEEE Trans. Robotics and Automation 6(3),
            1990, whose numerical form is a QR decomposition with pivoting (Gautier, ICRA 1990).
        without_influence: names of the parameters that had no part in the wrench at all.
        directions: of the parameters that are determined but not identified, the independent
            combinations from the best to the worst known, in units natural for the load. One that
            has a share of at most 5 % is identified although its parts are not.
        slow_noise: names of the wrench channels whose noise remembers longer than the record can
            tell (drift): the standard deviations are then lower bounds.
    """

    combinations: tuple[Combination, ...]
    without_influence: tuple[str, ...]
    directions: tuple[Combination, ...]
    slow_noise: tuple[str, ...]

    @property
    def rank(self) -> int:
        """The number of independent combinations that the record determines, 16 at most."""
        return len(self.combinations)

    def lines(self) -> list[str]:
        """What the record determines beyond single parameters, in words; one line for each."""
        lines = [f"{self.rank} of 16 combinations of offsets and load are determined"]
        if self.without_influence:
            names = ", ".join(self.without_influence)
            lines.append(f"without influence on this record: {names}")
        lines += [
            f"only together: {c}" for c in self.combinations if np.count_nonzero(c.coefficients) > 1
        ]
        for c in self.directions:
            if np.count_nonzero(c.coefficients) == 1 or c.share > WORTH_STATING:
                much = f"{100.0 * c.share:.0f} % of" if c.share < 1.0 else "more than"
                lines.append(f"weak: {c} ({much} what is natural for the load)")
            else:
                lines.append(f"identified although its parts are not: {c}")
        if self.slow_noise:
            names = ", ".join(self.slow_noise)
            lines.append(f"drift or slow noise in {names}: all +- are lower bounds")
        return lines


def base_parameters(equations: NormalEquations) -> BaseParameters:
    """What a record determines, exactly and within its noise.

    Args:
        equations: the sums over the record.

    Raises:
        DrakeTeleopError: as `NormalEquations.solve`.
    """
    load = equations.solve()
    theta = np.concatenate([load.offsets, load.phi])
    covariance, natural = equations.covariance(), natural_scale(load.phi)
    unexcited = equations.unexcited

    def combination(coefficients: Array, leading: int) -> Combination:
        c = coefficients / coefficients[leading]
        deviation = float(np.sqrt(max(0.0, c @ covariance @ c)))
        size = float(np.linalg.norm(c * natural))
        words = _sum_in_words(c, leading, np.abs(c) * natural)
        return Combination(c, leading, float(c @ theta), deviation, deviation / size, words)

    # Exactly: the dependent columns of [E V] as combinations of independent ones. Of equals, the
    # load's columns are taken for independent, so that the words begin with its parameters.
    gram, _ = equations.normal_equations()
    norm = np.sqrt(np.where(unexcited, 1.0, np.diag(gram)))
    scale = np.where(unexcited, 0.0, np.repeat([1.0, 2.0], [6, 10]) / norm)
    eigenvalues, vectors = np.linalg.eigh(gram * np.outer(scale, scale))
    kept = eigenvalues > _RANK * eigenvalues[-1]
    rank = int(kept.sum())
    R, order = qr(np.sqrt(eigenvalues[kept])[:, None] * vectors[:, kept].T, mode="r", pivoting=True)
    dependence = solve_triangular(R[:, :rank], R[:, rank:])
    dependence[np.abs(dependence) < _NO_COEFFICIENT] = 0.0
    combinations = []
    for row, i in enumerate(order[:rank]):
        c = np.zeros(16)
        c[i] = 1.0
        others = [int(j) for j in order[rank:]]
        for column, j in enumerate(others):
            if dependence[row, column] != 0.0:
                c[j] = dependence[row, column] * scale[i] / scale[j]
        combinations.append(combination(c, int(i)))
    combinations.sort(key=lambda c: c.leading)

    # Within the noise: principal directions of what is determined but not identified.
    weak = np.flatnonzero(~load.identifiable & np.isfinite(load.standard_deviations))
    scaled = covariance[np.ix_(weak, weak)] / np.outer(natural[weak], natural[weak])
    directions = []
    for direction in np.linalg.eigh(scaled)[1].T:
        c = np.zeros(16)
        c[weak] = direction / natural[weak]
        directions.append(combination(c, int(weak[np.argmax(np.abs(direction))])))
    names = tuple(PARAMETERS[i] for i in np.flatnonzero(unexcited))
    slow = tuple(CHANNELS[i] for i in np.flatnonzero(equations.slow_noise()))
    return BaseParameters(tuple(combinations), names, tuple(directions), slow)


def _sum_in_words(coefficients: Array, leading: int, weights: Array) -> str:
    weights = weights / weights.max()
    text = PARAMETERS[leading]
    for i in np.flatnonzero(weights >= _WORTH_A_NUMBER):
        if i != leading:
            c = coefficients[i]
            size = "" if abs(abs(c) - 1.0) < 5e-4 else f"{abs(c):.3g} "
            text += f" {'-' if c < 0.0 else '+'} {size}{PARAMETERS[i]}"
    small = (weights < _WORTH_A_NUMBER) & (weights >= _WORTH_A_MENTION)
    return text + " + ..." if small.any() else text


def wrench_standard_deviations(
    load: Identification, s: ArrayLike, omega: ArrayLike, alpha: ArrayLike
) -> Array:
    """How well an identified load predicts the wrench V phi of a motion.

    The variance of row v of V is v C v^T with the covariance C of phi, products between parameters
    included: a motion like that of the record is predicted better than the parameters are known.
    Errors of the motion and the model are not in it, nor are the offsets.

    Args:
        load: the identification.
        s, omega, alpha: (..., 3) motion, as for `regressor`.

    Returns:
        (..., 6) standard deviations of [f; tau] [N, N m]; inf where an undetermined parameter has a
        part in the wrench.

    Raises:
        DrakeTeleopError: for arrays of another shape or with numbers that are not finite.
    """
    leading, motion = checked_rows(s=(s, 3), omega=(omega, 3), alpha=(alpha, 3))
    covariance = load.covariance[6:, 6:]
    unknown = np.isinf(np.diag(covariance))
    finite = np.where(np.isinf(covariance), 0.0, covariance)
    samples = motion[0].shape[0]
    deviations = np.empty((samples, 6))
    for start in range(0, samples, _CHUNK):
        V = regressor(*(table[start : start + _CHUNK] for table in motion))
        variances = np.einsum("nci,nci->nc", V @ finite, V)
        variances[(V[:, :, unknown] != 0.0).any(axis=2)] = np.inf
        deviations[start : start + _CHUNK] = np.sqrt(np.maximum(variances, 0.0))
    return deviations.reshape(*leading, 6)
