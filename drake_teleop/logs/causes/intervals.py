"""Covariance of a load, widened by misfit (docs/theory.md, "Causes of a misfit")."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from drake_teleop.common.numeric import Array, white_noise_deviations
from drake_teleop.load.batch.uncertainty import GAIN_ERROR_TORQUE_ARM_M
from drake_teleop.load.identification import natural_scales
from drake_teleop.logs.causes.candidates import Candidate, fits_with_other_torque_units
from drake_teleop.logs.causes.fitted_model import FittedModel, regularized_inverse
from drake_teleop.logs.causes.instants import ALPHA_SIGNALS, WRENCH_SIGNALS
from drake_teleop.logs.causes.model import OFFSETS_AND_LOAD

_NUM_JACKKNIFE_PARTS = 12
_MAX_JACKKNIFE_OVER_FIT, _USUAL_JACKKNIFE_OVER_FIT = 1.5, 1.15
GOOD_SMOOTH_MISFIT, _WIDENING_BY_MISFIT = 1.35, 3.0
"""Largest smooth misfit of good records; growth of the deviations above it."""
_MIN_WIDENING_SCORE, _FULLY_WIDENING_SCORE, _FULLY_WIDENING_RESIDUAL_SHARE = 6.0, 15.0, 0.5
_CABLE_WIDENING_FACTOR, _LARGE_RESIDUAL_RATIO = 1.5, 20.0
_MIN_SMOOTH_MISFIT_IF_LARGE_RESIDUAL, _MIN_SMOOTH_MISFIT_IF_SMALL_RESIDUAL = 2.2, 6.0
_CAUSES_COVERED_BY_JACKKNIFE = ("offsets", "load", "linear drift", "drift")
_TRIED_GAIN_ERROR_STDS = np.geomspace(1e-4, 0.1, 31)
_MIN_LIKELIHOOD_RISE_BY_GAINS, _MIN_SHARE_EXPLAINED_BY_GAINS = 20.0, 0.5
_MAX_PLAUSIBLE_GAIN_ERROR_STD = 0.025


def covariance_of_load(
    fit: FittedModel, rejected: Sequence[Candidate], jackknife_std: Array, gain_covariance: Array
) -> Array:
    """Return the covariance (16, 16) of [offsets; phi], widened by misfit and rejected causes."""
    out = fit.covariance[OFFSETS_AND_LOAD, OFFSETS_AND_LOAD].copy()
    deviations = np.sqrt(np.diag(out))
    factor = widening_factor_by_misfit(fit, jackknife_std)
    squares = np.maximum(factor * deviations, jackknife_std) ** 2
    squares = squares + _load_variances_by_rejected_causes(fit, rejected)
    ratio = np.sqrt(squares) / deviations
    return np.asarray(out * np.outer(ratio, ratio) + gain_covariance)


def deviations_of_load_if_unexplained(
    fit: FittedModel, rejected: Sequence[Candidate], jackknife_std: Array, gain_covariance: Array
) -> Array:
    """Return standard deviations (16,) of [offsets; phi], `jackknife_std` widened by a misfit."""
    large = fit.residual_ratio > _LARGE_RESIDUAL_RATIO
    limits = _MIN_SMOOTH_MISFIT_IF_SMALL_RESIDUAL, _MIN_SMOOTH_MISFIT_IF_LARGE_RESIDUAL
    if fit.smooth_misfit > limits[large]:
        growth = 1.0 + _WIDENING_BY_MISFIT * (fit.smooth_misfit - GOOD_SMOOTH_MISFIT)
        jackknife_std = jackknife_std * growth
    lasting = [x for x in rejected if x.name not in _CAUSES_COVERED_BY_JACKKNIFE]
    variance = jackknife_std**2 + _load_variances_by_rejected_causes(fit, lasting)
    return np.asarray(np.sqrt(variance + np.diag(gain_covariance)))


def _load_variances_by_rejected_causes(fit: FittedModel, rejected: Sequence[Candidate]) -> Array:
    squares = np.zeros(16)
    for candidate in rejected:
        other, score = candidate.fit, candidate.score
        share = min(1.0, score / _FULLY_WIDENING_SCORE) if score > _MIN_WIDENING_SCORE else 0.0
        if other.residual_ratio < _FULLY_WIDENING_RESIDUAL_SHARE * fit.residual_ratio:
            share = 1.0  # the likelihood hides a smooth misfit, which coloured noise predicts
        own = np.diag(other.covariance)[OFFSETS_AND_LOAD]
        squares += share * ((other.x[OFFSETS_AND_LOAD] - fit.x[OFFSETS_AND_LOAD]) ** 2 + own)
    return squares


def covariance_of_load_by_gain_errors(fit: FittedModel) -> Array:
    """Return the covariance (16, 16) of [offsets; phi] by gain errors; 0 if they are unlikely."""
    rows = fit.rows
    weights = rows.whitened_products(fit.noise_filters) / fit.noise_power[:, None, None]
    unit = np.repeat([1.0, GAIN_ERROR_TORQUE_ARM_M], 3)
    # Gains multiply the wrench of the model, because noise of the reading is in the residual.
    channels = np.arange(WRENCH_SIGNALS.start, WRENCH_SIGNALS.stop)
    wrench = (rows.columns == channels[:, None]) - fit.residual
    J, inverse = fit.model.wrench_jacobian(fit.x), fit.covariance
    mixed, gram, right = np.zeros((len(J), 36)), np.zeros((36, 36)), np.zeros(36)
    for c in range(6):
        own = slice(6 * c, 6 * c + 6)
        columns = wrench * (unit[c] / unit)[:, None]
        weighted = columns @ weights[c]
        mixed[:, own] = J[:, c] @ weighted.T
        gram[own, own] = weighted @ columns.T
        right[own] = weighted @ fit.residual[c]
    schur = gram - mixed.T @ inverse @ mixed
    values, vectors = np.linalg.eigh(0.5 * (schur + schur.T))
    shown = values > 1e-9 * values[-1]
    seen, squares = values[shown], (vectors[:, shown].T @ right) ** 2 / values[shown]

    def twice_log_likelihood_ratio(gain_std: float) -> float:
        more = gain_std * gain_std * seen
        return float(np.sum(squares * more / (1.0 + more) - np.log1p(more)))

    likely = np.array([twice_log_likelihood_ratio(std) for std in _TRIED_GAIN_ERROR_STDS])
    explaining = squares.sum() > _MIN_SHARE_EXPLAINED_BY_GAINS * fit.smooth_likelihood_gain[0]
    plausible = _TRIED_GAIN_ERROR_STDS[int(likely.argmax())] < _MAX_PLAUSIBLE_GAIN_ERROR_STD
    if likely.max() < _MIN_LIKELIHOOD_RISE_BY_GAINS or not explaining or not plausible:
        return np.zeros((16, 16))
    largest = _TRIED_GAIN_ERROR_STDS[np.flatnonzero(likely > likely.max() - 2.0)[-1]]
    effects = largest * (inverse @ mixed)[OFFSETS_AND_LOAD]
    return np.asarray(effects @ effects.T)


def covariance_of_load_by_torque_unit(fit: FittedModel) -> Array:
    """Return the covariance (16, 16) of [offsets; phi] due to an uncertain torque unit."""
    out = np.zeros((16, 16))
    for other in fits_with_other_torque_units(fit):
        distance = other.x[OFFSETS_AND_LOAD] - fit.x[OFFSETS_AND_LOAD]
        out += np.outer(distance, distance)
    return out


def bias_of_load_by_alpha_noise(fit: FittedModel) -> Array:
    """Return the bias (16,) of [offsets; phi] due to noise of the angular acceleration."""
    means = fit.means
    at = np.searchsorted(fit.rows.columns, np.arange(ALPHA_SIGNALS.start, ALPHA_SIGNALS.stop))
    variance = white_noise_deviations(means.y[means.used][:, ALPHA_SIGNALS]) ** 2
    weights = fit.rows.used.sum() * (fit.noise_filters**2).sum(axis=1) / fit.noise_power
    J = fit.model.wrench_jacobian(fit.x)[:, :, at]
    right = np.einsum("pck,ck,c,k->p", J, fit.residual[:, at], weights, variance)
    return np.asarray((fit.covariance @ right)[OFFSETS_AND_LOAD])


def widening_factor_by_misfit(fit: FittedModel, jackknife_std: Array) -> float:
    """Return the factor by which misfit widens all standard deviations; 1 for stationary noise."""
    deviations = np.sqrt(np.diag(fit.covariance)[OFFSETS_AND_LOAD])
    shown = deviations < natural_scales(fit.x[6:16])
    factor = 1.0
    if shown.any():
        spread = float(np.sqrt(np.mean((jackknife_std[shown] / deviations[shown]) ** 2)))
        factor = spread / _USUAL_JACKKNIFE_OVER_FIT if spread > _MAX_JACKKNIFE_OVER_FIT else 1.0
    if "cable" in fit.model.extensions:
        factor *= _CABLE_WIDENING_FACTOR  # a spring models a cable only to first order
    return factor * (1.0 + _WIDENING_BY_MISFIT * max(0.0, fit.smooth_misfit - GOOD_SMOOTH_MISFIT))


def jackknife_load_deviations(fit: FittedModel) -> Array:
    """Return jackknife deviations (16,) of [offsets; phi] over twelve parts of the record."""
    rows = fit.rows
    whole, right = fit.normal_equations(fit.model, fit.x)
    moves = []
    for part in np.array_split(np.flatnonzero(rows.used), _NUM_JACKKNIFE_PARTS):
        used = np.zeros(len(rows.used), bool)
        used[part] = True
        few = replace(rows, used=used)
        gram, pull = replace(fit, rows=few).normal_equations(fit.model, fit.x)
        moves.append((regularized_inverse(whole - gram) @ (right - pull))[OFFSETS_AND_LOAD])
    spread = np.array(moves) - np.mean(moves, axis=0)
    share = (_NUM_JACKKNIFE_PARTS - 1.0) / _NUM_JACKKNIFE_PARTS
    return np.asarray(np.sqrt(share * np.sum(spread**2, axis=0)))
