"""Candidate causes of a misfit: extensions of the wrench model with a sufficient effect."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from drake_teleop.common.numeric import Array
from drake_teleop.common.rotations import signed_permutations
from drake_teleop.load.identification import natural_scales
from drake_teleop.logs.causes.changes import add_step_change, find_contact_spans
from drake_teleop.logs.causes.fitted_model import FittedModel
from drake_teleop.logs.causes.instants import (
    CONSTANT_COLUMN,
    GRAVITY_SIGNALS,
    ROTATION_SIGNALS,
    SPECIFIC_FORCE_SIGNALS,
    WRENCH_SIGNALS,
)
from drake_teleop.logs.causes.model import (
    CLOCK_RATE_EXPONENTS,
    OFFSETS_AND_LOAD,
    SYMMETRIC_MATRIX_INDICES,
    LoadModel,
)

CAUSES_BY_PLAUSIBILITY = (
    *("axes", "gravity", *CLOCK_RATE_EXPONENTS, "weight", "torque factor", "offsets", "load"),
    *("linear drift", "gain", "frame", "rotation", "contact", "cable", "drift"),
)
"""Order of plausibility: of nearly equal candidates the first is chosen."""
_UNIT_RATIOS = (10.0, 100.0, 1000.0, 8.850746, 4.448222, 9.80665, 98.0665, 1.355818, 12.0, 39.37008)
TORQUE_UNIT_FACTORS = tuple(
    sign * ratio
    for sign in (1.0, -1.0)
    for ratio in (1.0, *_UNIT_RATIOS, *(1.0 / x for x in _UNIT_RATIOS))
    if sign * ratio != 1.0
)
"""Factors on the torque that a wrong unit or sign of force or torque causes."""
_MAX_RESIDUAL_SHARE_OF_PERMUTATION, _SCORE_OF_AVOIDED_NEGATIVE_MASS = 0.5, 1000.0
_MIN_GRAVITY_TILT_DEG, _MAX_GRAVITY_ERROR_TILTED, _MAX_GRAVITY_ERROR_UPRIGHT = 0.25, 0.05, 0.02
_MIN_REMOVED_MASS_SHARE, _MIN_REMOVED_MOMENT_ARM_M = 0.02, 0.004
_TRIED_CLOCK_RATE_FACTORS, _MIN_CLOCK_RATE_ERROR = np.geomspace(1e-3, 1e4, 71), 0.005
_MAX_CLOCK_RATE_STD_OVER_ERROR = 0.1
_MIN_CHANNEL_GAIN_ERROR, _MAX_CHANNEL_GAIN_ERROR = 0.003, 0.25
_MIN_POSE_SHIFT_M, _MAX_POSE_SHIFT_M = 0.010, 1.5
_MIN_SENSOR_ROTATION_DEG, _MIN_LOAD_MASS_OVER_DEVIATION = 1.0, 10.0
MAX_PLAUSIBLE_MASS_KG = 1000.0
_MAX_CABLE_STIFFNESS_N_M, _MIN_DRIFT_OVER_NOISE = 1000.0, 3.0
_NEGATIVE_INERTIA_OVER_DEVIATION, _NEGATIVE_INERTIA_OVER_SCALE = 8.0, 0.1
_TORQUE_FACTOR_MARGIN, _MAX_TORQUE_FACTOR_ERROR, _MAX_EXTREME_TORQUE_FACTOR_ERROR = 0.02, 0.06, 0.2
_MIN_USUAL_TORQUE_FACTOR, _EQUAL_LIKELIHOOD_TOLERANCE, _TORQUE_FACTOR_ITERATIONS = 0.2, 1.0, 4
_DECISIVE_RESIDUAL_OVER_USUAL = 0.2  # for which the residual selects the factor, not the likelihood
_MAX_LOG_LIKELIHOOD_LOSS_OF_OTHER_UNIT = 8.0  # of the logarithm; four standard deviations
_MAX_SCORE_OF_UNUSUAL_TORQUE_FACTOR = 30.0  # score that widens intervals but names no cause


@dataclass(frozen=True, eq=False)
class Candidate:
    """Fit with one more model term; `score` is twice its log likelihood gain, minus a BIC cost."""

    name: str
    fit: FittedModel
    score: float


def fit_candidates(fit: FittedModel, is_first_round: bool) -> Iterator[Candidate]:
    """Yield fits with one further term each, such as gravity, whose effect is not negligible."""
    model, means = fit.model, fit.means
    if is_first_round:
        yield from _axis_permutation_candidates(fit)
    drifts = bool({"linear drift", "drift"} & set(model.extensions))
    possible = {
        "gravity": means.gravity_W is not None,
        "weight": means.gravity_W is not None and means.has_enough_acceleration,
        "linear drift": not drifts,
        "frame": means.has_enough_acceleration,
        "rotation": is_first_round and not model.extensions,
        "cable": means.has_positions and means.has_enough_acceleration,
        "drift": not drifts,
    }
    if means.clock_rate is not None:
        possible[means.clock_rate] = means.has_enough_acceleration
    has_clock_rate = bool(CLOCK_RATE_EXPONENTS.keys() & set(model.extensions))
    for name, is_possible in possible.items():
        if is_possible and name not in model.extensions and not has_clock_rate:
            yield from _fit_with_extension(fit, name)
    if means.has_enough_acceleration and not has_clock_rate:
        yield from _torque_factor_candidates(fit)
    for kind in ("offsets", "load"):
        found = add_step_change(fit, kind)
        if found is not None:
            yield _scored_candidate(kind, fit, found, num_step_times=1)
    for c in range(6):
        if c not in model.gain_channels:
            larger = fit.refit(replace(model, gain_channels=(*model.gain_channels, c)))
            error = abs(larger.parameters_of_extension(f"gain {c}")[0][0])
            if _MIN_CHANNEL_GAIN_ERROR < error < _MAX_CHANNEL_GAIN_ERROR:
                yield _scored_candidate("gain", fit, larger)
    spans = find_contact_spans(fit)
    if spans and spans != fit.contact_spans:
        larger = FittedModel.fit_record(means, model, fit.x, spans)
        ends = sum(2 - (a <= means.t[1]) - (b >= means.t[-2]) for a, b in spans)
        yield _scored_candidate("contact", fit, larger, num_extra_parameters=6 + 2 * ends)


def _scored_candidate(
    name: str,
    fit: FittedModel,
    larger: FittedModel,
    *,
    num_step_times: int = 0,
    num_extra_parameters: int = 0,
) -> Candidate:
    rows = float(fit.means.used.sum())
    cost = larger.model.size - fit.model.size + num_extra_parameters
    score = 2.0 * (larger.log_likelihood - fit.log_likelihood) - cost * np.log(rows)
    if num_step_times:
        score += (0.5 * cost - 2.0 * num_step_times) * np.log(rows)
    return Candidate(name, larger, float(score))


def _fit_with_extension(fit: FittedModel, name: str) -> Iterator[Candidate]:
    model = fit.model.with_extension(name)
    starts: list[Array | None] = [None]
    if name == "gravity":
        starts = [start_parameters_of_tilt_fit(fit), None]
    if name in CLOCK_RATE_EXPONENTS:
        starts = [_start_parameters_of_clock_rate_fit(fit, model, name)]
    best = max((fit.refit(model, start) for start in starts), key=lambda x: x.log_likelihood)
    if _is_extension_effect_significant(best, name):
        yield _scored_candidate(name, fit, best)


def _is_extension_effect_significant(fit: FittedModel, extension: str) -> bool:
    x, _ = fit.parameters_of_extension(extension)
    match extension:
        case "gravity":
            _, angle, ratio = compare_gravity_with_description(fit)
            error = abs(ratio - 1.0)
            # Noise of the accelerations changes only the magnitude.
            turned = np.radians(angle) > error
            share = _MAX_GRAVITY_ERROR_TILTED if turned else _MAX_GRAVITY_ERROR_UPRIGHT
            return bool(angle > _MIN_GRAVITY_TILT_DEG and error < share)
        case "weight":
            mass = abs(fit.x[6])
            arm = np.linalg.norm(x[1:]) / max(mass, 1e-9)
            return bool(x[0] > _MIN_REMOVED_MASS_SHARE * mass or arm > _MIN_REMOVED_MOMENT_ARM_M)
        case "frame":
            return bool(np.linalg.norm(x) > _MIN_POSE_SHIFT_M)
        case _ if extension in CLOCK_RATE_EXPONENTS:
            ratio, deviation = time_step_ratio_and_std(fit, extension)
            # Without any weight in the wrench the ratio of poses is infinite.
            precise = deviation < _MAX_CLOCK_RATE_STD_OVER_ERROR * abs(ratio - 1.0)
            return bool(precise and abs(ratio - 1.0) > _MIN_CLOCK_RATE_ERROR)
        case "rotation":
            return bool(np.linalg.norm(x) > np.radians(_MIN_SENSOR_ROTATION_DEG))
        case "linear drift" | "drift":
            least = _MIN_DRIFT_OVER_NOISE * fit.means.wrench_noise
            return bool((drift_amplitudes(fit) > least).any())
    return True


def _start_parameters_of_clock_rate_fit(fit: FittedModel, model: LoadModel, name: str) -> Array:
    simple = LoadModel((name,), axes=model.axes, torque_factor=model.torque_factor)
    y = fit.means.with_only_used_rows(fit.rows.used).y[:, simple.columns]
    sums = y.T @ y
    channels = np.arange(WRENCH_SIGNALS.start, WRENCH_SIGNALS.stop)
    weights = 1.0 / sums[channels, channels].reshape(2, 3).sum(axis=1).repeat(3)[:, None]
    x, best = model.start_parameters(fit.x, fit.model), np.inf
    for factor in _TRIED_CLOCK_RATE_FACTORS:
        J = simple.wrench_jacobian(np.eye(simple.size)[-1] * (factor - 1.0))[OFFSETS_AND_LOAD]
        gram = np.einsum("pci,qci->pq", J @ sums, weights * J)
        right = np.einsum("pci,ci->p", J, weights * sums[channels])
        theta = np.linalg.lstsq(gram, right, rcond=1e-14)[0]
        if theta[6] > 0.0 and -right @ theta < best:
            best = -right @ theta
            x[OFFSETS_AND_LOAD], x[model.parameter_slices[name]] = theta, factor - 1.0
    return x


def time_step_ratio_and_std(fit: FittedModel, extension: str) -> tuple[float, float]:
    """Return stated over true time step, and its standard deviation; (0, inf) if undefined."""
    x, covariance = fit.parameters_of_extension(extension)
    power, factor = CLOCK_RATE_EXPONENTS[extension], 1.0 + float(x[0])
    if factor <= 0.0:
        return 0.0, np.inf
    ratio = factor ** (1.0 / power)
    return ratio, float(np.sqrt(covariance[0, 0])) * ratio / (power * factor)


def has_negative_mass(fit: FittedModel) -> bool:
    return bool(fit.x[6] < -4.0 * np.sqrt(fit.covariance[6, 6]))


def has_negative_inertia(fit: FittedModel) -> bool:
    """Return True if the mass or, for a precise mass, a principal inertia at So is negative."""
    if fit.x[6] < _MIN_LOAD_MASS_OVER_DEVIATION * np.sqrt(fit.covariance[6, 6]):
        return has_negative_mass(fit)
    i, j = np.triu_indices(3)
    inertia = np.zeros((3, 3))
    inertia[i, j] = inertia[j, i] = fit.x[10:16]
    least, axes = np.linalg.eigh(inertia)
    # The derivative of n^T I n by the six entries.
    slope = axes[i, 0] * axes[j, 0] * np.where(i == j, 1.0, 2.0)
    deviation = float(np.sqrt(slope @ fit.covariance[10:16, 10:16] @ slope))
    smallest = _NEGATIVE_INERTIA_OVER_SCALE * natural_scales(fit.x[6:16])[10]
    return bool(least[0] < -max(_NEGATIVE_INERTIA_OVER_DEVIATION * deviation, smallest))


def is_fit_plausible(fit: FittedModel) -> bool:
    if has_negative_inertia(fit):
        return False
    parts, mass = fit.model.parameter_slices, fit.x[6]
    clocks = CLOCK_RATE_EXPONENTS.keys() & parts.keys()
    if any(time_step_ratio_and_std(fit, name)[0] == 0.0 for name in clocks):
        return False
    # A removed weight or a cable requires an inertia to compare with.
    required = _MIN_LOAD_MASS_OVER_DEVIATION * np.sqrt(fit.covariance[6, 6])
    if {"weight", "cable"} & parts.keys() and not required <= mass < MAX_PLAUSIBLE_MASS_KG:
        return False
    if "weight" in parts and fit.x[parts["weight"]][0] < -0.01 * mass:
        return False  # a robot adds no weight
    if "frame" in parts and np.linalg.norm(fit.x[parts["frame"]]) > _MAX_POSE_SHIFT_M:
        return False
    return "cable" not in parts or fitted_max_cable_stiffness_n_m(fit) < _MAX_CABLE_STIFFNESS_N_M


def fitted_max_cable_stiffness_n_m(fit: FittedModel) -> float:
    K = fit.parameters_of_extension("cable")[0][3:9][SYMMETRIC_MATRIX_INDICES]
    return float(np.abs(np.linalg.eigvalsh(K)).max())


def compare_gravity_with_description(fit: FittedModel) -> tuple[Array, float, float]:
    """Return estimated gravity_W (3,), its angle [deg] and length ratio to the described one."""
    given = fit.means.gravity_W
    assert given is not None
    true = given - fit.parameters_of_extension("gravity")[0]
    sizes = np.linalg.norm(true), np.linalg.norm(given)
    angle = np.degrees(np.arccos(np.clip(true @ given / sizes[0] / sizes[1], -1.0, 1.0)))
    return true, float(angle), float(sizes[0] / sizes[1])


def start_parameters_of_tilt_fit(fit: FittedModel) -> Array | None:
    """Return start parameters with linearly estimated gravity; None if no weight is measured."""
    y = fit.means.with_only_used_rows(fit.rows.used).y
    sums = y.T @ y
    width = len(sums)
    J = np.zeros((7, 3, width))
    for i in range(3):
        J[i, i, CONSTANT_COLUMN] = 1.0
        J[3, i, SPECIFIC_FORCE_SIGNALS.start + i] = J[3, i, GRAVITY_SIGNALS.start + i] = 1.0
        J[4:, i, ROTATION_SIGNALS.start + 3 * i : ROTATION_SIGNALS.start + 3 * i + 3] = np.eye(3)
    force = np.eye(width)[WRENCH_SIGNALS][:3]
    gram = np.einsum("pci,ij,qcj->pq", J, sums, J)
    right = np.einsum("pci,ij,cj->p", J, sums, fit.model.axes.T @ force)
    u = np.linalg.lstsq(gram, right, rcond=1e-12)[0][4:]
    given, size = fit.means.gravity_W, float(np.linalg.norm(u))
    assert given is not None
    if size == 0.0:
        return None
    model = fit.model.with_extension("gravity")
    x = model.start_parameters(fit.x, fit.model)
    x[6:16] = 0.0
    x[6] = size / float(np.linalg.norm(given))
    x[model.parameter_slices["gravity"]] = given + u / size * np.linalg.norm(given)
    return x


def drift_amplitudes(fit: FittedModel) -> Array:
    """Return upper bounds (6,) of the drift of sensor offsets about their means [N, N m]."""
    name = "drift" if "drift" in fit.model.extensions else "linear drift"
    return np.abs(fit.parameters_of_extension(name)[0].reshape(6, -1)).sum(axis=1)


def _torque_factor_candidates(fit: FittedModel) -> Iterator[Candidate]:
    fits = []
    for factor in (1.0, *TORQUE_UNIT_FACTORS):
        model = replace(fit.model, torque_factor=factor)
        fits.append(fit.refit(model, fit.x, iterations=_TORQUE_FACTOR_ITERATIONS))
    most = max(x.log_likelihood for x in fits)
    best = next(x for x in fits if x.log_likelihood > most - _EQUAL_LIKELIHOOD_TOLERANCE)
    # Coloured noise predicts a large and smooth misfit as well: there the residual decides.
    least = min(x.residual_ratio for x in fits)
    usual = min(best.residual_ratio, fit.residual_ratio)
    by_residual = least < _DECISIVE_RESIDUAL_OVER_USUAL * usual
    if by_residual:
        small = (x for x in fits if x.residual_ratio < 2.0 * least)
        best = max(small, key=lambda x: x.log_likelihood)
    if best is fits[0]:
        return
    options = {"iterations": _TORQUE_FACTOR_ITERATIONS} if by_residual else {}
    best = fit.refit(best.model, best.x, **options)
    if 2.0 * (best.log_likelihood - fit.log_likelihood) < 20.0:
        return
    free = best.refit(best.model.with_extension("torque factor"))
    value, covariance = free.parameters_of_extension("torque factor")
    # A displaced pose frame resembles any factor, but only a distant frame resembles a large one.
    far = not _MIN_USUAL_TORQUE_FACTOR < best.model.torque_factor < 1.0 / _MIN_USUAL_TORQUE_FACTOR
    most = _MAX_EXTREME_TORQUE_FACTOR_ERROR if far else _MAX_TORQUE_FACTOR_ERROR
    limit = min(_TORQUE_FACTOR_MARGIN + 4.0 * np.sqrt(covariance[0, 0]), most)
    found = _scored_candidate("torque factor", fit, best, num_extra_parameters=1)
    if not abs(value[0]) < limit:  # a factor beside the known ratios is not a cause
        found = replace(found, score=min(found.score, _MAX_SCORE_OF_UNUSUAL_TORQUE_FACTOR))
    yield found


def fits_with_other_torque_units(fit: FittedModel) -> list[FittedModel]:
    """Return fits, if nearly as likely, with a torque unit 0.5 to 2 times the fitted one."""
    factor, found = fit.model.torque_factor, []
    for other in TORQUE_UNIT_FACTORS if factor != 1.0 else ():
        if other != factor and 0.5 < other / factor < 2.0:
            fitted = fit.refit(replace(fit.model, torque_factor=other), fit.x)
            if fit.log_likelihood - fitted.log_likelihood < _MAX_LOG_LIKELIHOOD_LOSS_OF_OTHER_UNIT:
                found.append(fitted)
    return found


def _axis_permutation_candidates(fit: FittedModel) -> Iterator[Candidate]:
    y = fit.means.with_only_used_rows(fit.rows.used).y[:, fit.model.columns]
    sums = y.T @ y
    sums = sums - np.outer(sums[:, CONSTANT_COLUMN], sums[CONSTANT_COLUMN]) / sums[0, 0]
    # m s + alpha x h + omega x (omega x h) for the three axes of S, and a removed weight
    model = LoadModel(extensions=fit.model.extensions)
    used = [6, 7, 8, 9]
    if "weight" in model.extensions:
        used.append(model.parameter_slices["weight"].start)
    J = model.wrench_jacobian(np.zeros(model.size))[used, :3]
    force = np.eye(len(sums))[WRENCH_SIGNALS][:3]
    gram = np.einsum("pci,ij,qcj->pq", J, sums, J)
    cross = np.einsum("pci,ij,dj->cdp", J, sums, force)  # axis c of S, channel d
    total = float(np.trace(sums[WRENCH_SIGNALS, WRENCH_SIGNALS][:3, :3]))
    inverse = np.linalg.pinv(gram, rcond=1e-12, hermitian=True)

    def squared_error(axes: Array) -> float:
        right = np.einsum("dc,cdp->p", axes, cross)
        found = inverse @ right
        return total - float(right @ found) if found[0] > 0.0 else total

    identity, *others = signed_permutations()
    best = min(others, key=squared_error)
    if squared_error(best) < _MAX_RESIDUAL_SHARE_OF_PERMUTATION * squared_error(identity):
        larger = fit.refit(replace(fit.model, axes=best), np.zeros(fit.model.size))
        if larger.x[6] > 0.0:
            found = _scored_candidate("axes", fit, larger, num_extra_parameters=3)
            # The given axes imply a negative mass, which is impossible.
            more = _SCORE_OF_AVOIDED_NEGATIVE_MASS if has_negative_inertia(fit) else 0.0
            yield replace(found, score=found.score + more)
