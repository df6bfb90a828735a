"""Uncertainty of an identified load: intervals, share of the prior, determined combinations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import qr, solve_triangular
from scipy.special import stdtrit

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.load.identification import (
    PARAMETERS,
    WORTH_STATING,
    Identification,
    natural_scale,
)
from drake_teleop.load.normal_equations import NormalEquations

_NORMAL_DEGREES = 1e6  # Student's t is then normal to six digits
CHANNELS = ("f_x", "f_y", "f_z", "tau_x", "tau_y", "tau_z")
"""Names of the wrench channels."""

_UNITS = ("N",) * 3 + ("N m",) * 3 + ("kg",) + ("kg m",) * 3 + ("kg m^2",) * 6
# Smallest relative eigenvalue of a determined direction (as in `normal_equations`), and largest
# coefficient that is rounding.
_MIN_EIGENVALUE, _MIN_COEFFICIENT = 1e-12, 1e-6
# Terms of a combination, relative to the largest, that appear with a number, or as "...".
_NUMBER_SHARE, _ELLIPSIS_SHARE = 0.1, 0.01


def intervals(load: Identification, level: float = 0.95) -> tuple[Array, Array]:
    """Return lower and upper ends (16,) of the confidence intervals of [offsets; phi] [SI].

    By Student's t distribution; (-inf, inf) for undetermined parameters.

    Raises:
        DrakeTeleopError: if the level is outside (0, 1).
    """
    if not 0.0 < level < 1.0:
        raise DrakeTeleopError(f"{level} is not within (0, 1)", where="level")
    degrees = np.minimum(load.degrees_of_freedom, _NORMAL_DEGREES)
    half = stdtrit(degrees, 0.5 + 0.5 * level) * load.standard_deviations
    theta = np.concatenate([load.offsets, load.phi])
    return theta - half, theta + half


def prior_dominated(
    standard_deviations: ArrayLike, prior_std: ArrayLike, share: float = 0.5
) -> NDArray[np.bool_]:
    """Return (n,) True where a standard deviation is at least `share` of the prior's.

    Raises:
        DrakeTeleopError: if shapes differ or a prior standard deviation is not positive.
    """
    deviations, prior = np.asarray(standard_deviations), np.asarray(prior_std)
    if deviations.shape != prior.shape or not (prior > 0.0).all():
        raise DrakeTeleopError(
            f"needs positive numbers of shape {deviations.shape}", where="prior_std"
        )
    return np.asarray(deviations >= share * prior)


@dataclass(frozen=True, eq=False)
class Combination:
    """Linear combination of [offsets; phi] that a record determines.

    Attributes:
        coefficients: (16,) factors, 1 for the leading parameter, which gives the unit.
        leading: index of the leading parameter in `PARAMETERS`.
        value, standard_deviation: of the combination, in this unit.
        share: standard deviation over the natural scale.
        words: the sum as text; "..." stands for terms below a tenth of the largest.
    """

    coefficients: Array
    leading: int
    value: float
    standard_deviation: float
    share: float
    words: str

    def __str__(self) -> str:
        """Return text such as "I_zz + 0.2 m c_x = 0.31 +- 0.01 kg m^2"."""
        numbers = f"{self.value:.4g} +- {self.standard_deviation:.2g} {_UNITS[self.leading]}"
        return f"{self.words} = {numbers}"


@dataclass(frozen=True, eq=False)
class BaseParameters:
    """Base parameters: the combinations of load and offsets that a record determines.

    Gautier, Khalil, IEEE Trans. Robotics and Automation 6(3), 1990; Gautier, ICRA 1990.

    Attributes:
        without_influence: names of parameters without influence on the wrench.
        directions: principal combinations of determined but not identified parameters.
        slow_noise: names of wrench channels with drift.
    """

    combinations: tuple[Combination, ...]
    without_influence: tuple[str, ...]
    directions: tuple[Combination, ...]
    slow_noise: tuple[str, ...]

    @property
    def rank(self) -> int:
        """Number of determined combinations, at most 16."""
        return len(self.combinations)

    def lines(self) -> list[str]:
        """Return a text summary."""
        lines = [f"{self.rank} of 16 combinations of offsets and load are determined"]
        if self.without_influence:
            names = ", ".join(self.without_influence)
            lines.append(f"without influence on this record: {names}")
        lines += [
            f"only together: {c}" for c in self.combinations if np.count_nonzero(c.coefficients) > 1
        ]
        for c in self.directions:
            if np.count_nonzero(c.coefficients) == 1 or c.share > WORTH_STATING:
                percentage = f"{100.0 * c.share:.0f} % of" if c.share < 1.0 else "more than"
                lines.append(f"weak: {c} ({percentage} the natural scale of the load)")
            else:
                lines.append(f"identified although its parts are not: {c}")
        if self.slow_noise:
            names = ", ".join(self.slow_noise)
            lines.append(f"drift or slow noise in {names}: all +- are lower bounds")
        return lines


def base_parameters(equations: NormalEquations) -> BaseParameters:
    """Return the base parameters of a record.

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
        words = _combination_text(c, leading, np.abs(c) * natural)
        return Combination(c, leading, float(c @ theta), deviation, deviation / size, words)

    # Dependent columns of [E V] as combinations of independent ones. The scale prefers columns of
    # the load as independent, so that the text begins with its parameters.
    gram, _ = equations.normal_equations()
    norm = np.sqrt(np.where(unexcited, 1.0, np.diag(gram)))
    scale = np.where(unexcited, 0.0, np.repeat([1.0, 2.0], [6, 10]) / norm)
    eigenvalues, vectors = np.linalg.eigh(gram * np.outer(scale, scale))
    kept = eigenvalues > _MIN_EIGENVALUE * eigenvalues[-1]
    rank = int(kept.sum())
    R, order = qr(np.sqrt(eigenvalues[kept])[:, None] * vectors[:, kept].T, mode="r", pivoting=True)
    dependence = solve_triangular(R[:, :rank], R[:, rank:])
    dependence[np.abs(dependence) < _MIN_COEFFICIENT] = 0.0
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

    # Principal directions of determined but not identified parameters.
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


def _combination_text(coefficients: Array, leading: int, weights: Array) -> str:
    weights = weights / weights.max()
    text = PARAMETERS[leading]
    for i in np.flatnonzero(weights >= _NUMBER_SHARE):
        if i != leading:
            c = coefficients[i]
            size = "" if abs(abs(c) - 1.0) < 5e-4 else f"{abs(c):.3g} "
            text += f" {'-' if c < 0.0 else '+'} {size}{PARAMETERS[i]}"
    small = (weights < _NUMBER_SHARE) & (weights >= _ELLIPSIS_SHARE)
    return text + " + ..." if small.any() else text
