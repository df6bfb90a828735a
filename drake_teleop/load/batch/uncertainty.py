"""Uncertainty of an identified load (docs/theory.md, "Details of the estimators")."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import qr, solve_triangular
from scipy.special import stdtrit

from drake_teleop.common.numeric import Array
from drake_teleop.load import identification
from drake_teleop.load.batch.total_least_squares import (
    EstimatorFit,
    SampleRecord,
    SolvedNormalEquations,
)
from drake_teleop.load.normal_equations import (
    SAMPLES_PER_CHUNK,
    SecondMoments,
    excited_columns,
    normal_equations,
    regressor_coefficients,
    root_of_pseudo_inverse,
)
from drake_teleop.load.regressor import regressor

_MAX_DEGREES_OF_FREEDOM = 1e6  # Student's t is then normal to six digits
WRENCH_CHANNEL_NAMES = ("f_x", "f_y", "f_z", "tau_x", "tau_y", "tau_z")
"""Names of the wrench channels."""

# Smallest relative eigenvalue of a determined direction (as in `normal_equations`), and largest
# coefficient that is rounding.
_MIN_RELATIVE_GRAM_EIGENVALUE, _MIN_COMBINATION_COEFFICIENT = 1e-12, 1e-6
# Terms of a combination, relative to the largest, that appear with a number, or as "...".
_MIN_TERM_SHARE_WITH_NUMBER, _MIN_TERM_SHARE_AS_ELLIPSIS = 0.1, 0.01


def confidence_intervals(load: identification.Identification) -> tuple[Array, Array]:
    """Return lower and upper ends (16,) of the 95 % confidence intervals of [offsets; phi]."""
    degrees = np.minimum(load.degrees_of_freedom, _MAX_DEGREES_OF_FREEDOM)
    half = stdtrit(degrees, 0.5 + 0.5 * 0.95) * load.standard_deviations
    theta = np.concatenate([load.offsets, load.phi])
    return theta - half, theta + half


def is_prior_dominated(standard_deviations: ArrayLike, prior_std: ArrayLike) -> NDArray[np.bool_]:
    return np.asarray(np.asarray(standard_deviations) >= 0.5 * np.asarray(prior_std))


@dataclass(frozen=True, eq=False)
class ParameterCombination:
    """Linear combination of [offsets; phi] that a record determines.

    Attributes:
        coefficients: (16,) factors, 1 for the leading parameter, which gives the unit.
        leading_index: index of the leading parameter in `PARAMETER_NAMES`.
        relative_std: standard deviation, relative to the typical size for such a load.
        text: the sum as a formula, such as "m c_x + 0.5 f_ox".
    """

    coefficients: Array
    leading_index: int
    value: float
    standard_deviation: float
    relative_std: float
    text: str

    def __str__(self) -> str:
        unit = identification.PARAMETER_UNITS[self.leading_index]
        return f"{self.text} = {self.value:.4g} +- {self.standard_deviation:.2g} {unit}"


@dataclass(frozen=True, eq=False)
class BaseParameters:
    """Combinations of load and offsets that a record determines (Gautier, Khalil, 1990).

    Attributes:
        weak_directions: principal axes of the covariance of unidentified parameters.
        channels_with_slow_noise: names of wrench channels with drift or slow noise.
    """

    combinations: tuple[ParameterCombination, ...]
    parameters_without_influence: tuple[str, ...]
    weak_directions: tuple[ParameterCombination, ...]
    channels_with_slow_noise: tuple[str, ...]

    def text_lines(self) -> list[str]:
        lines = [f"{len(self.combinations)} of 16 combinations of offsets and load are determined"]
        if self.parameters_without_influence:
            names = ", ".join(self.parameters_without_influence)
            lines.append(f"parameters without influence on this record: {names}")
        sums = (c for c in self.combinations if np.count_nonzero(c.coefficients) > 1)
        lines += [f"determined only in combination: {c}" for c in sums]
        for c in self.weak_directions:
            percent = 100.0 * c.relative_std
            share = f"{percent:.0f} % of" if percent < 100.0 else "more than"
            text = f"weak: {c} (+- is {share} the typical size for this load); rotate the load"
            text += " further and faster, about more axes"
            precise = c.relative_std <= identification.MAX_IDENTIFIED_RELATIVE_STD
            several = np.count_nonzero(c.coefficients) > 1
            lines.append(f"identified only as a combination: {c}" if several and precise else text)
        if self.channels_with_slow_noise:
            names = ", ".join(self.channels_with_slow_noise)
            lines.append(
                f"drift or slow noise in {names}: uncertainties are lower bounds; let the sensor"
                " warm up, and record again"
            )
        return lines


def base_parameters(equations: SecondMoments) -> BaseParameters:
    load = equations.solve()
    theta = np.concatenate([load.offsets, load.phi])
    covariance, natural = equations.covariance(), identification.natural_scales(load.phi)
    unexcited = equations.unexcited_columns

    def scaled_combination(coefficients: Array, leading_index: int) -> ParameterCombination:
        c = coefficients / coefficients[leading_index]
        std = float(np.sqrt(max(0.0, c @ covariance @ c)))
        relative_std = std / float(np.linalg.norm(c * natural))
        words = _parameter_combination_text(c, leading_index, np.abs(c) * natural)
        return ParameterCombination(c, leading_index, float(c @ theta), std, relative_std, words)

    # Dependent columns of [E V] as combinations of independent ones. The scale prefers columns of
    # the load as independent, so that the text begins with its parameters.
    gram, _ = equations.normal_equations()
    norm = np.sqrt(np.where(unexcited, 1.0, np.diag(gram)))
    scale = np.where(unexcited, 0.0, np.repeat([1.0, 2.0], [6, 10]) / norm)
    eigenvalues, vectors = np.linalg.eigh(gram * np.outer(scale, scale))
    kept = eigenvalues > _MIN_RELATIVE_GRAM_EIGENVALUE * eigenvalues[-1]
    rank = int(kept.sum())
    R, order = qr(np.sqrt(eigenvalues[kept])[:, None] * vectors[:, kept].T, mode="r", pivoting=True)
    dependence = solve_triangular(R[:, :rank], R[:, rank:])
    dependence[np.abs(dependence) < _MIN_COMBINATION_COEFFICIENT] = 0.0
    rows = np.eye(16)[order[:rank]]
    sizes = np.where(unexcited, np.inf, scale)[order[rank:]]
    rows[:, order[rank:]] = dependence * scale[order[:rank], None] / sizes
    combinations = [scaled_combination(c, int(i)) for c, i in zip(rows, order[:rank], strict=True)]
    combinations.sort(key=lambda c: c.leading_index)

    # Principal directions of determined but not identified parameters.
    weak = np.flatnonzero(~load.identifiable & np.isfinite(load.standard_deviations))
    scaled = covariance[np.ix_(weak, weak)] / np.outer(natural[weak], natural[weak])
    directions = []
    for direction in np.linalg.eigh(scaled)[1].T:
        c = np.zeros(16)
        c[weak] = direction / natural[weak]
        directions.append(scaled_combination(c, int(weak[np.argmax(np.abs(direction))])))
    names = tuple(identification.PARAMETER_NAMES[i] for i in np.flatnonzero(unexcited))
    slow = tuple(WRENCH_CHANNEL_NAMES[i] for i in np.flatnonzero(equations.has_slow_noise()))
    return BaseParameters(tuple(combinations), names, tuple(directions), slow)


def _parameter_combination_text(coefficients: Array, leading_index: int, weights: Array) -> str:
    weights = weights / weights.max()
    text = identification.PARAMETER_NAMES[leading_index]
    for i in np.flatnonzero(weights >= _MIN_TERM_SHARE_WITH_NUMBER):
        if i != leading_index:
            c = coefficients[i]
            size = "" if abs(abs(c) - 1.0) < 5e-4 else f"{abs(c):.3g} "
            text += f" {'-' if c < 0.0 else '+'} {size}{identification.PARAMETER_NAMES[i]}"
    small = (weights < _MIN_TERM_SHARE_WITH_NUMBER) & (weights >= _MIN_TERM_SHARE_AS_ELLIPSIS)
    return text + " + ..." if small.any() else text


GAIN_ERROR_TORQUE_ARM_M = 0.06
"""Length that relates gain errors of forces to those of torques [m]."""


def covariance_for_white_noise(
    least_squares_covariance: Array, equations: SecondMoments, fit: EstimatorFit
) -> Array:
    """Return the covariance (16, 16) of [offsets; phi] for noise correlated between channels.

    The correlation is that of the inverse of `fit.solved.weights`.
    """
    W, Z = fit.solved.weights, fit.moments.mean_products
    if np.array_equal(W, np.diag(np.diag(W))):
        return least_squares_covariance
    predicted = np.linalg.inv(W)
    scale = np.sqrt(equations.long_run_variances(fit.solved.theta)[0] / np.diag(predicted))
    of_sums = W @ (predicted * np.outer(scale, scale)) @ W
    inverse = _inverse_gram(fit)
    covariance = inverse @ (fit.moments.num_samples * normal_equations(Z, of_sums)[0]) @ inverse
    return identification.mark_undetermined(covariance, np.isinf(np.diag(least_squares_covariance)))


def _inverse_gram(fit: EstimatorFit) -> Array:
    Z = fit.moments.mean_products
    root = root_of_pseudo_inverse(normal_equations(Z, fit.solved.weights)[0], excited_columns(Z))
    return np.asarray(root @ root.T / fit.moments.num_samples)


def covariance_for_random_walks(
    record: SampleRecord, kept: NDArray[np.bool_], fit: EstimatorFit, step_covariance: Array
) -> Array:
    """Return the covariance (16, 16) of [offsets; phi] due to random walks of offsets and motion.

    `step_covariance` (6, 6) is that of the residual's change per sample; `kept` (N,) is True for
    used samples.
    """
    covariance = np.zeros((16, 16))
    if not step_covariance.any():
        return covariance
    backwards, used = record.with_row_step(-1), kept[::-1]
    after = np.zeros((6, 16))
    for start in range(0, len(used), SAMPLES_PER_CHUNK):
        part = slice(start, start + SAMPLES_PER_CHUNK)
        rows = np.zeros((len(used[part]), 6, 16))
        rows[:, np.arange(6), np.arange(6)] = 1.0
        rows[:, :, 6:] = regressor(*(table[part] for table in backwards.wrench_and_motion[1:]))
        rows = fit.solved.weights @ (rows * used[part, None, None])
        sums = after + np.cumsum(rows, axis=0)
        after = sums[-1]
        sums -= rows
        covariance += np.einsum("nci,cd,ndj->ij", sums, step_covariance, sums, optimize=True)
    inverse = _inverse_gram(fit)
    return inverse @ covariance @ inverse


def parameter_errors_by_gains(products: Array, weights: Array, inverse_gram: Array) -> Array:
    """Return the errors (n, 36) of n parameters for a unit error of each of the 36 sensor gains.

    `products` (k, 6, n, 6): sums of regressor times wrench in k sets of samples.
    """
    right = np.einsum("bcd,bcjk->jdk", weights, products, optimize=True)  # per gain (d, k)
    length = np.repeat([1.0, GAIN_ERROR_TORQUE_ARM_M], 3)
    effect = np.einsum("ij,jdk->idk", inverse_gram, right) * (length[:, None] / length)
    return np.asarray(effect.reshape(len(inverse_gram), 36))


def covariance_for_gain_errors(fit: EstimatorFit, offsets_estimated: bool) -> Array:
    """Return the covariance (16, 16) of [offsets; phi] for gain errors of standard deviation 1."""
    Z, W = fit.moments.mean_products, fit.solved.weights
    used = excited_columns(Z) & (offsets_estimated | (np.arange(16) >= 6))
    root = root_of_pseudo_inverse(normal_equations(Z, W)[0], used)
    products = (regressor_coefficients() @ Z)[None, :, :, 1:7]
    errors = parameter_errors_by_gains(products, W[None], root @ root.T)
    effects = fit.solved.map_from_ordinary @ errors
    return np.asarray(effects @ effects.T)


def covariance_of_solution(
    least_squares_covariance: Array, solved: SolvedNormalEquations, offsets_estimated: bool
) -> Array:
    """Return the covariance (16, 16) of [offsets; phi] from that of ordinary least squares."""
    unknown = np.isinf(np.diag(least_squares_covariance))
    covariance = np.where(unknown[:, None] | unknown, 0.0, least_squares_covariance)
    if not offsets_estimated:
        inner = np.linalg.pinv(covariance[:6, :6], hermitian=True)
        covariance -= covariance[:, :6] @ inner @ covariance[:6]
        covariance[:6], covariance[:, :6] = 0.0, 0.0
    covariance = solved.map_from_ordinary @ covariance @ solved.map_from_ordinary.T
    return identification.mark_undetermined(covariance, unknown | solved.is_undetermined)
