"""Search for causes why a rigid load does not explain a wrench (docs/theory.md)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from drake_teleop.common.numeric import Array, one_blas_thread
from drake_teleop.load.identification import mark_undetermined
from drake_teleop.logs.causes import candidates, cause, changes, intervals
from drake_teleop.logs.causes.candidates import (
    CAUSES_BY_PLAUSIBILITY,
    Candidate,
    has_negative_inertia,
    has_negative_mass,
    start_parameters_of_tilt_fit,
)
from drake_teleop.logs.causes.cause import Finding, RecordPartWithLoad
from drake_teleop.logs.causes.changes import remove_small_steps
from drake_teleop.logs.causes.fitted_model import FittedModel, fit_model
from drake_teleop.logs.causes.instants import BlockMeans, delay_of_linear_fit
from drake_teleop.logs.causes.intervals import (
    GOOD_SMOOTH_MISFIT,
    covariance_of_load_by_gain_errors,
    covariance_of_load_by_torque_unit,
    deviations_of_load_if_unexplained,
)
from drake_teleop.logs.causes.model import (
    CLOCK_RATE_EXPONENTS,
    DELAY_INDEX,
    OFFSETS_AND_LOAD,
    LoadModel,
)

MAX_SEARCH_ROUNDS = 4
MeansByDelay = Callable[[float], BlockMeans]
_MIN_CORRECTED_DELAY_S, _MAX_CORRECTED_DELAY_S = 5e-4, 0.3
_EQUAL_DELAY_TOLERANCE_S, _MAX_DELAY_ITERATIONS = 0.004, 4
MAX_NOISE_RESIDUAL_RATIO, MAX_NOISE_SMOOTH_MISFIT, MAX_NOISE_EXTENSION_SCORE = 1.25, 2.2, 20.0
"""Limits of the noise test: residual ratio, smooth misfit and score of a larger model."""
_MAX_RESIDUAL_RATIO_TO_PERMUTED_AXES = 2.0
_MIN_CAUSE_SCORE, _NEAR_BEST_SCORE_MARGIN, _NEAR_BEST_SCORE_SHARE = 40.0, 25.0, 0.02
_MUCH_SMALLER_RESIDUAL, _EQUAL_RESIDUAL, _MAX_CONTACT_RESIDUAL_SHARE = 0.2, 1.1, 0.5
_MAX_COLOURED_NOISE_RESIDUAL_RATIO, _MAX_EFFECTIVE_MISFIT_SHARE = 15.0, 0.9
_CERTAIN_CAUSE_SCORE, _MIN_WEIGHT_OVER_CABLE_SCORE = 1000.0, 1.0 / 3.0
_STEP_CAUSES, _MAX_CANDIDATE_RESIDUAL_INCREASE = ("offsets", "load"), 3.0
_CAUSES_THAT_RESEMBLE_COLOURED_NOISE = (
    *("axes", "gravity", "weight", "torque factor", "contact"),
    *CLOCK_RATE_EXPONENTS,
)
_MANY_PARAMETER_CAUSES = ("cable", "drift")  # with many columns, which resemble other causes
_MANY_PARAMETER_SCORE_MARGIN, _MANY_PARAMETER_SCORE_SHARE = 80.0, 0.1


def residual_is_noise(fit: FittedModel) -> bool:
    if fit.residual_ratio > MAX_NOISE_RESIDUAL_RATIO or has_negative_inertia(fit):
        return False
    if fit.smooth_misfit > MAX_NOISE_SMOOTH_MISFIT:
        return False
    model = fit.model
    parts = ["frame", "linear drift", "rotation"]
    if fit.means.gravity_W is not None:
        parts += ["gravity", "weight"]
    larger = [model.with_extension(name) for name in parts if name not in model.extensions]
    others = set(range(6)) - set(model.gain_channels)
    larger += [replace(model, gain_channels=(*model.gain_channels, c)) for c in sorted(others)]
    return all(fit.score_of_larger_model(x) < MAX_NOISE_EXTENSION_SCORE for x in larger)


SearchResult = tuple[FittedModel, float, list[Candidate]]


def search_causes(
    means: BlockMeans, means_at: MeansByDelay | None = None, always_fitted: tuple[str, ...] = ()
) -> SearchResult:
    """Return the fit with the found causes, its additional motion delay [s], rejected causes."""
    plain = LoadModel(extensions=always_fitted)
    found = _search_causes_from(_fit_initial_model(means, plain), 0.0, means_at)
    if has_negative_mass(found[0]):
        # Without a positive mass no candidate is plausible, whatever else is in the record.
        mirrored = _fit_initial_model(means, replace(plain, axes=-np.eye(3)))
        opposite = _search_causes_from(mirrored, 0.0, means_at)
        # With a negative torque factor it is a reversed specific force, seen from the wrench.
        is_wrench = opposite[0].model.torque_factor > 0.0
        # An equal residual is sufficient for a positive mass, because a negative one is impossible.
        share = _MUCH_SMALLER_RESIDUAL if has_negative_mass(opposite[0]) else _EQUAL_RESIDUAL
        if is_wrench and opposite[0].residual_ratio < share * found[0].residual_ratio:
            found = opposite
    if means_at is None or resembles_coloured_noise(found[0]) or residual_is_noise(found[0]):
        return found
    delay_s = delay_of_linear_fit(means)
    if abs(delay_s - found[1]) < _EQUAL_DELAY_TOLERANCE_S:
        return found
    repeated = _search_causes_from(_fit_initial_model(means_at(delay_s), plain), delay_s, means_at)
    likelier = repeated[0].log_likelihood > found[0].log_likelihood + _MIN_CAUSE_SCORE
    better = likelier or _has_much_smaller_residual_than(repeated[0], found[0])
    return repeated if better or residual_is_noise(repeated[0]) else found


def _has_much_smaller_residual_than(fit: FittedModel, reference: FittedModel) -> bool:
    return fit.residual_ratio < _MUCH_SMALLER_RESIDUAL * reference.residual_ratio


def resembles_coloured_noise(fit: FittedModel) -> bool:
    """Return True if the residual is moderate and smooth signals do not explain it."""
    small = fit.residual_ratio < _MAX_COLOURED_NOISE_RESIDUAL_RATIO
    return small and fit.smooth_misfit < GOOD_SMOOTH_MISFIT


def _fit_initial_model(means: BlockMeans, model: LoadModel) -> FittedModel:
    fit = FittedModel.fit_record(means, model)
    start = start_parameters_of_tilt_fit(fit) if "gravity" in model.extensions else None
    return fit if start is None else FittedModel.fit_record(means, fit.model, start)


def _search_causes_from(
    fit: FittedModel, delay_s: float, means_at: MeansByDelay | None
) -> SearchResult:
    fit, delay_s = _refit_with_shifted_motion(fit, delay_s, means_at)
    rejected: list[Candidate] = []
    for number in range(MAX_SEARCH_ROUNDS):
        if residual_is_noise(fit):
            return fit, delay_s, []
        found = list(candidates.fit_candidates(fit, is_first_round=number == 0))
        found = _drop_cable_if_removed_weight_explains_it(found)
        rejected = [x for x in found if candidates.is_fit_plausible(x.fit)]
        effective = [x for x in rejected if _is_misfit_reduced(x, fit)]
        winner = _most_plausible_of_best_candidates(effective)
        calmest = _candidate_with_much_smaller_residual(fit, rejected)
        calm = calmest if calmest is not None and calmest.name != "contact" else None
        if winner is None or (calm and _has_much_smaller_residual_than(calm.fit, winner.fit)):
            winner = calmest
        if winner is None:
            limit = _MAX_CONTACT_RESIDUAL_SHARE * fit.residual_ratio
            contacts = (x.fit for x in rejected if x.name == "contact")
            touched = next((x for x in contacts if x.residual_ratio < limit), None)
            explained = None if touched is None else changes.replace_contacts_by_steps(touched)
            if explained is None:
                break
            fit, delay_s = _refit_with_shifted_motion(explained, delay_s, means_at)
            continue
        larger = changes.replace_steps_by_contact(winner.fit)
        if winner.name == "contact":
            larger = changes.replace_contacts_by_steps(larger) or changes.shorten_contacts(larger)
        elif larger.contact_spans != winner.fit.contact_spans:
            larger = changes.replace_contacts_by_steps(larger) or larger
        # A contact can take all the samples before or after an earlier step.
        fit, delay_s = _refit_with_shifted_motion(remove_small_steps(larger), delay_s, means_at)
        rejected = [x for x in rejected if x is not winner]
        if winner.name == "cable":
            return fit, delay_s, []
    return fit, delay_s, rejected


def _drop_cable_if_removed_weight_explains_it(tried: list[Candidate]) -> list[Candidate]:
    weights = (x for x in tried if x.name == "weight" and not candidates.is_fit_plausible(x.fit))
    best = max((x.score for x in weights), default=0)
    return [x for x in tried if x.name != "cable" or best < _MIN_WEIGHT_OVER_CABLE_SCORE * x.score]


def _refit_with_shifted_motion(
    fit: FittedModel, delay_s: float, means_at: MeansByDelay | None
) -> tuple[FittedModel, float]:
    for _ in range(_MAX_DELAY_ITERATIONS):
        more = float(fit.x[DELAY_INDEX])
        large = abs(delay_s) > _MAX_CORRECTED_DELAY_S
        if means_at is None or abs(more) < _MIN_CORRECTED_DELAY_S or large:
            break
        delay_s += more
        x = fit.x.copy()
        x[DELAY_INDEX] = 0.0
        fit = FittedModel.fit_record(means_at(delay_s), fit.model, x, fit.contact_spans)
    return fit, delay_s


def _candidate_with_much_smaller_residual(
    fit: FittedModel, found: list[Candidate]
) -> Candidate | None:
    small = [x for x in found if x.name in _CAUSES_THAT_RESEMBLE_COLOURED_NOISE]
    small = [x for x in small if _has_much_smaller_residual_than(x.fit, fit)]
    least = min([x.fit.residual_ratio for x in small], default=0.0)
    near = [x for x in small if x.fit.residual_ratio < 2.0 * least]
    return min(near, key=lambda x: CAUSES_BY_PLAUSIBILITY.index(x.name), default=None)


def _is_misfit_reduced(candidate: Candidate, fit: FittedModel) -> bool:
    fitted = candidate.fit
    smaller = fitted.residual_ratio < _MAX_EFFECTIVE_MISFIT_SHARE * fit.residual_ratio
    if candidate.name == "cable":
        return smaller  # the force of a cable far exceeds the noise
    increased = fitted.residual_ratio > _MAX_CANDIDATE_RESIDUAL_INCREASE * fit.residual_ratio
    if increased and candidate.name not in _STEP_CAUSES:
        return False  # coloured noise predicts the increased residual
    better = smaller or fitted.smooth_misfit < _MAX_EFFECTIVE_MISFIT_SHARE * fit.smooth_misfit
    return bool(better or has_negative_inertia(fit) or candidate.score > _CERTAIN_CAUSE_SCORE)


def _most_plausible_of_best_candidates(found: list[Candidate]) -> Candidate | None:
    best = max([x.score for x in found], default=0.0)
    if best < _MIN_CAUSE_SCORE:
        return None
    top = max(found, key=lambda x: x.score).name
    margin = max(_NEAR_BEST_SCORE_MARGIN, _NEAR_BEST_SCORE_SHARE * best)
    if top in _MANY_PARAMETER_CAUSES:
        margin = max(_MANY_PARAMETER_SCORE_MARGIN, _MANY_PARAMETER_SCORE_SHARE * best)
    near = [x for x in found if x.score > max(_MIN_CAUSE_SCORE, best - margin)]
    first = min(near, key=lambda x: CAUSES_BY_PLAUSIBILITY.index(x.name))
    least = _MIN_CAUSE_SCORE * max(1.0, first.fit.smooth_misfit / GOOD_SMOOTH_MISFIT) ** 1.5
    return first if first.score > least else None


_MAX_ABSENT_MASS_KG, _ABSENT_MASS_OVER_DEVIATION, _PRESENT_MASS_OVER_DEVIATION = 0.010, 4.0, 20.0


@dataclass(frozen=True, eq=False)
class MisfitExplanation:
    """Causes why a rigid load does not explain a wrench, and the load fitted with these causes.

    Attributes:
        explained: True if the residual is sensor noise.
        theta, covariance: [offsets; phi] (16,) before the first change [SI]; (16, 16).
        misfit_deviations: (16,) standard deviations of theta if the misfit is unexplained.
        delay_s: additional delay of the motion behind the wrench [s].
        loads: parts of the record with their loads; empty for one load.
        always_fitted: names of model terms, such as "gravity", that are no causes.
    """

    causes: tuple[Finding, ...]
    explained: bool
    theta: Array
    covariance: Array
    misfit_deviations: Array
    delay_s: float
    loads: tuple[RecordPartWithLoad, ...]
    fit: FittedModel
    always_fitted: tuple[str, ...] = ()

    @property
    def is_misfit(self) -> bool:
        """True if the residual is clearly not noise: large, or explained by smooth signals."""
        smooth = self.fit.smooth_misfit > MAX_NOISE_SMOOTH_MISFIT
        return not self.explained and (self.is_residual_large or smooth)

    @property
    def is_residual_large(self) -> bool:
        """True if the residual is too large for coloured sensor noise."""
        return self.fit.residual_ratio > _MAX_COLOURED_NOISE_RESIDUAL_RATIO

    @property
    def is_acceleration_missing(self) -> bool:
        """True if an acceleration is missing whose inertial force may cause the misfit."""
        return not self.explained and bool(np.isinf(self.fit.means.acceleration_noise))

    @property
    def needs_crosstalk_calibration(self) -> bool:
        """True if crosstalk is likely: several gain errors, or one with rotation or cable."""
        model = self.fit.model
        others = {"rotation", "cable"} & set(model.extensions)
        return len(model.gain_channels) > 1 or bool(model.gain_channels and others)


def explain_misfit(
    means: BlockMeans, means_at: MeansByDelay | None = None, always_fitted: tuple[str, ...] = ()
) -> MisfitExplanation:
    """Test whether a rigid load explains a record, and search for causes if it does not.

    The model contains the terms `always_fitted`, such as "weight" (subtracted by the robot).
    `means_at(x)` returns the block means with an additional motion delay x [s].
    """
    with one_blas_thread():
        fit, delay_s, rejected = search_causes(means, means_at, always_fitted)
        blocks = intervals.jackknife_load_deviations(fit)
        gains = covariance_of_load_by_gain_errors(fit) + covariance_of_load_by_torque_unit(fit)
        covariance = intervals.covariance_of_load(fit, rejected, blocks, gains)
        causes = cause.list_misfit_causes(fit, always_fitted)
        only_noise = residual_is_noise(fit)
        if not causes and (only_noise or resembles_coloured_noise(fit)):
            causes = _findings_if_load_is_absent(fit, covariance)
        return MisfitExplanation(
            causes=tuple(causes),
            explained=only_noise,
            theta=fit.x[OFFSETS_AND_LOAD],
            covariance=covariance,
            misfit_deviations=deviations_of_load_if_unexplained(fit, rejected, blocks, gains),
            delay_s=delay_s + float(fit.x[DELAY_INDEX]),
            loads=tuple(cause.loads_between_changes(fit, covariance)),
            fit=fit,
            always_fitted=always_fitted,
        )


def fit_with_missing_acceleration(misfit: MisfitExplanation) -> MisfitExplanation:
    """Return an explanation by a fit without acceleration, with a pessimistic covariance.

    Samples do not average the error out, because the missing acceleration depends on the
    orientation. The inertia is undetermined, because the centre of rotation is unknown.
    """
    means, axes = misfit.fit.means, misfit.fit.model.axes
    fits = []
    for Q in (axes, np.eye(3), -np.eye(3)):
        model = LoadModel(extensions=misfit.always_fitted, axes=Q)
        x = model.start_parameters(misfit.fit.x, misfit.fit.model)
        fit = FittedModel.fit_record(means, model, x)
        for _ in range(2):  # the first one may be limited in its largest change
            fit = fit_model(model, fit.rows, fit.x, iterations=2)
        fits.append(fit)
    # A rotation that is not right-angled resembles several permutations of axes.
    limit = _MAX_RESIDUAL_RATIO_TO_PERMUTED_AXES * fits[0].residual_ratio
    simple = (x for x in fits[1:] if x.x[6] > 0.0 and x.residual_ratio < limit)
    fit = next(simple, fits[0])
    covariance = float(means.used.sum()) * fit.covariance[OFFSETS_AND_LOAD, OFFSETS_AND_LOAD]
    covariance = mark_undetermined(covariance, np.arange(16) >= 10)
    causes = tuple(cause.list_misfit_causes(fit, misfit.always_fitted))
    found = replace(misfit, theta=fit.x[OFFSETS_AND_LOAD], covariance=covariance, causes=causes)
    return replace(found, fit=fit, delay_s=0.0, loads=())


def _findings_if_load_is_absent(fit: FittedModel, covariance: Array) -> list[Finding]:
    mass, deviation = abs(float(fit.x[6])), float(np.sqrt(covariance[6, 6]))
    largest = min(_MAX_ABSENT_MASS_KG, _PRESENT_MASS_OVER_DEVIATION * deviation)
    if not (mass < max(_ABSENT_MASS_OVER_DEVIATION * deviation, largest) and deviation < 0.1):
        return []
    most = mass + 1.96 * deviation
    text = f"the load on the sensor is below {1e3 * most:.2g} g; only the offsets are identified"
    return [Finding("no load", text, values={"mass_limit": most})]
