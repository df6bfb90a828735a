"""Search for causes why a rigid load does not explain a wrench (docs/theory.md)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from drake_teleop.common.numeric import Array, one_blas_thread
from drake_teleop.load.identification import mark_undetermined
from drake_teleop.logs.causes import candidates, cause, changes, intervals
from drake_teleop.logs.causes.candidates import (
    EXTENSIONS_BY_PLAUSIBILITY,
    Candidate,
    has_negative_inertia,
    has_negative_mass,
    start_parameters_of_tilt_fit,
)
from drake_teleop.logs.causes.cause import Finding, RecordPartWithLoad
from drake_teleop.logs.causes.changes import remove_small_steps
from drake_teleop.logs.causes.instants import BlockMeans, delay_of_linear_fit
from drake_teleop.logs.causes.intervals import (
    GOOD_SMOOTH_MISFIT,
    covariance_of_load_by_gain_errors,
    covariance_of_load_by_torque_unit,
    deviations_of_load_if_unexplained,
)
from drake_teleop.logs.causes.model import (
    CLOCK_RATE_POWER,
    DELAY_INDEX,
    OFFSETS_AND_LOAD,
    LoadModel,
)
from drake_teleop.logs.causes.state import FittedModel, fit_model

MAX_SEARCH_ROUNDS = 4
MeansAtDelay = Callable[[float], BlockMeans]
_MIN_CORRECTED_DELAY_S, _MAX_CORRECTED_DELAY_S = 5e-4, 0.3
_EQUAL_DELAY_TOLERANCE_S, _MAX_DELAY_ITERATIONS = 0.004, 4
MAX_NOISE_RESIDUAL_RATIO, MAX_NOISE_SMOOTH_MISFIT, MAX_NOISE_EXTENSION_SCORE = 1.25, 2.2, 20.0
"""Limits of the noise test: residual ratio, smooth misfit and score of a larger model."""
_MAX_RESIDUAL_OVER_PERMUTED_AXES = 2.0
_MIN_CAUSE_SCORE, _NEAR_BEST_SCORE_MARGIN, _NEAR_BEST_SCORE_SHARE = 40.0, 25.0, 0.02
_MUCH_SMALLER_RESIDUAL, _EQUAL_RESIDUAL, _MAX_CONTACT_RESIDUAL_SHARE = 0.2, 1.1, 0.5
_MAX_COLOURED_NOISE_RESIDUAL_RATIO, _MAX_EFFECTIVE_MISFIT_SHARE = 15.0, 0.9
_CERTAIN_CAUSE_SCORE, _MIN_WEIGHT_OVER_CABLE_SCORE = 1000.0, 1.0 / 3.0
_STEP_CAUSES, _MAX_CANDIDATE_RESIDUAL_INCREASE = ("offsets", "load"), 3.0
_CAUSES_LIKE_COLOURED_NOISE = (
    *("axes", "gravity", "weight", "torque factor", "contact"),
    *CLOCK_RATE_POWER,
)
_FLEXIBLE_CAUSES = ("cable", "drift")  # with many columns, which resemble other causes
_FLEXIBLE_CAUSE_SCORE_MARGIN, _FLEXIBLE_CAUSE_SCORE_SHARE = 80.0, 0.1


def residual_is_noise(state: FittedModel) -> bool:
    if state.residual_ratio > MAX_NOISE_RESIDUAL_RATIO or has_negative_inertia(state):
        return False
    if state.smooth_misfit > MAX_NOISE_SMOOTH_MISFIT:
        return False
    model = state.model
    parts = ["frame", "linear drift", "rotation"]
    if state.data.gravity_W is not None:
        parts += ["gravity", "weight"]
    larger = [model.with_extension(name) for name in parts if name not in model.extensions]
    others = set(range(6)) - set(model.gain_channels)
    larger += [replace(model, gain_channels=(*model.gain_channels, c)) for c in sorted(others)]
    return all(state.score_of_larger_model(x) < MAX_NOISE_EXTENSION_SCORE for x in larger)


SearchResult = tuple[FittedModel, float, list[Candidate]]


def search_causes(
    data: BlockMeans, means_at: MeansAtDelay | None = None, always_fitted: tuple[str, ...] = ()
) -> SearchResult:
    """Return the fit with the found causes, added motion delay [s], and rejected candidates."""
    plain = LoadModel(extensions=always_fitted)
    found = _search_causes_from(_fit_initial_model(data, plain), 0.0, means_at)
    if has_negative_mass(found[0]):
        # Without a positive mass no candidate is plausible, whatever else is in the record.
        mirrored = _fit_initial_model(data, replace(plain, axes=-np.eye(3)))
        opposite = _search_causes_from(mirrored, 0.0, means_at)
        # With a negative torque factor it is a reversed specific force, seen from the wrench.
        is_wrench = opposite[0].model.torque_factor > 0.0
        # An equal residual is sufficient for a positive mass, because a negative one is impossible.
        share = _MUCH_SMALLER_RESIDUAL if has_negative_mass(opposite[0]) else _EQUAL_RESIDUAL
        if is_wrench and opposite[0].residual_ratio < share * found[0].residual_ratio:
            found = opposite
    if means_at is None or may_be_coloured_noise(found[0]) or residual_is_noise(found[0]):
        return found
    delay_s = delay_of_linear_fit(data)
    if abs(delay_s - found[1]) < _EQUAL_DELAY_TOLERANCE_S:
        return found
    repeated = _search_causes_from(_fit_initial_model(means_at(delay_s), plain), delay_s, means_at)
    likelier = repeated[0].log_likelihood > found[0].log_likelihood + _MIN_CAUSE_SCORE
    better = likelier or _has_much_smaller_residual_than(repeated[0], found[0])
    return repeated if better or residual_is_noise(repeated[0]) else found


def _has_much_smaller_residual_than(state: FittedModel, reference: FittedModel) -> bool:
    return state.residual_ratio < _MUCH_SMALLER_RESIDUAL * reference.residual_ratio


def may_be_coloured_noise(state: FittedModel) -> bool:
    """Return True for a moderate residual that smooth signals do not explain."""
    small = state.residual_ratio < _MAX_COLOURED_NOISE_RESIDUAL_RATIO
    return small and state.smooth_misfit < GOOD_SMOOTH_MISFIT


def _fit_initial_model(data: BlockMeans, model: LoadModel) -> FittedModel:
    state = FittedModel.fit_record(data, model)
    start = start_parameters_of_tilt_fit(state) if "gravity" in model.extensions else None
    return state if start is None else FittedModel.fit_record(data, state.model, start)


def _search_causes_from(
    state: FittedModel, delay_s: float, means_at: MeansAtDelay | None
) -> SearchResult:
    state, delay_s = _refit_with_shifted_motion(state, delay_s, means_at)
    rejected: list[Candidate] = []
    for number in range(MAX_SEARCH_ROUNDS):
        if residual_is_noise(state):
            return state, delay_s, []
        found = list(candidates.fit_candidates(state, is_first_round=number == 0))
        found = _remove_cable_if_weight_explains_as_much(found)
        rejected = [x for x in found if candidates.is_plausible(x.state)]
        effective = [x for x in rejected if _is_misfit_reduced(x, state)]
        winner = _most_plausible_of_best_candidates(effective)
        calmest = _candidate_with_much_smaller_residual(state, rejected)
        calm = calmest if calmest is not None and calmest.name != "contact" else None
        if winner is None or (calm and _has_much_smaller_residual_than(calm.state, winner.state)):
            winner = calmest
        if winner is None:
            limit = _MAX_CONTACT_RESIDUAL_SHARE * state.residual_ratio
            contacts = (x.state for x in rejected if x.name == "contact")
            touched = next((x for x in contacts if x.residual_ratio < limit), None)
            explained = None if touched is None else changes.replace_contacts_by_steps(touched)
            if explained is None:
                break
            state, delay_s = _refit_with_shifted_motion(explained, delay_s, means_at)
            continue
        larger = changes.replace_steps_by_contact(winner.state)
        if winner.name == "contact":
            larger = changes.replace_contacts_by_steps(larger) or changes.shrink_contacts(larger)
        elif larger.contact_spans != winner.state.contact_spans:
            larger = changes.replace_contacts_by_steps(larger) or larger
        # A contact can take all the samples before or after an earlier step.
        state, delay_s = _refit_with_shifted_motion(remove_small_steps(larger), delay_s, means_at)
        rejected = [x for x in rejected if x is not winner]
        if winner.name == "cable":
            return state, delay_s, []
    return state, delay_s, rejected


def _remove_cable_if_weight_explains_as_much(found: list[Candidate]) -> list[Candidate]:
    weights = (x for x in found if x.name == "weight" and not candidates.is_plausible(x.state))
    best = max((x.score for x in weights), default=0)
    return [x for x in found if x.name != "cable" or best < _MIN_WEIGHT_OVER_CABLE_SCORE * x.score]


def _refit_with_shifted_motion(
    state: FittedModel, delay_s: float, means_at: MeansAtDelay | None
) -> tuple[FittedModel, float]:
    for _ in range(_MAX_DELAY_ITERATIONS):
        more = float(state.x[DELAY_INDEX])
        large = abs(delay_s) > _MAX_CORRECTED_DELAY_S
        if means_at is None or abs(more) < _MIN_CORRECTED_DELAY_S or large:
            break
        delay_s += more
        x = state.x.copy()
        x[DELAY_INDEX] = 0.0
        state = FittedModel.fit_record(means_at(delay_s), state.model, x, state.contact_spans)
    return state, delay_s


def _candidate_with_much_smaller_residual(
    state: FittedModel, found: list[Candidate]
) -> Candidate | None:
    small = [x for x in found if x.name in _CAUSES_LIKE_COLOURED_NOISE]
    small = [x for x in small if _has_much_smaller_residual_than(x.state, state)]
    least = min([x.state.residual_ratio for x in small], default=0.0)
    near = [x for x in small if x.state.residual_ratio < 2.0 * least]
    return min(near, key=lambda x: EXTENSIONS_BY_PLAUSIBILITY.index(x.name), default=None)


def _is_misfit_reduced(candidate: Candidate, state: FittedModel) -> bool:
    fitted = candidate.state
    smaller = fitted.residual_ratio < _MAX_EFFECTIVE_MISFIT_SHARE * state.residual_ratio
    if candidate.name == "cable":
        return smaller  # the force of a cable far exceeds the noise
    increased = fitted.residual_ratio > _MAX_CANDIDATE_RESIDUAL_INCREASE * state.residual_ratio
    if increased and candidate.name not in _STEP_CAUSES:
        return False  # coloured noise predicts the increased residual
    better = smaller or fitted.smooth_misfit < _MAX_EFFECTIVE_MISFIT_SHARE * state.smooth_misfit
    return bool(better or has_negative_inertia(state) or candidate.score > _CERTAIN_CAUSE_SCORE)


def _most_plausible_of_best_candidates(found: list[Candidate]) -> Candidate | None:
    best = max([x.score for x in found], default=0.0)
    if best < _MIN_CAUSE_SCORE:
        return None
    top = max(found, key=lambda x: x.score).name
    margin = max(_NEAR_BEST_SCORE_MARGIN, _NEAR_BEST_SCORE_SHARE * best)
    if top in _FLEXIBLE_CAUSES:
        margin = max(_FLEXIBLE_CAUSE_SCORE_MARGIN, _FLEXIBLE_CAUSE_SCORE_SHARE * best)
    near = [x for x in found if x.score > max(_MIN_CAUSE_SCORE, best - margin)]
    first = min(near, key=lambda x: EXTENSIONS_BY_PLAUSIBILITY.index(x.name))
    least = _MIN_CAUSE_SCORE * max(1.0, first.state.smooth_misfit / GOOD_SMOOTH_MISFIT) ** 1.5
    return first if first.score > least else None


_MAX_ABSENT_MASS_KG, _ABSENT_MASS_OVER_DEVIATION, _PRESENT_MASS_OVER_DEVIATION = 0.010, 4.0, 20.0


@dataclass(frozen=True, eq=False)
class MisfitExplanation:
    """Causes why a rigid load does not explain a wrench, and the load fitted with these causes.

    Attributes:
        explained: True if the residual is sensor noise.
        theta, covariance: [offsets; phi] (16,) of the first part of the record [SI]; (16, 16).
        misfit_deviations: (16,) standard deviations of theta if the misfit is unexplained.
        delay_s: additional delay of the motion behind the wrench [s].
        loads: parts of the record with their loads; empty for one load.
        always_fitted: names of extensions, such as "gravity", that are fitted but are no causes.
    """

    causes: tuple[Finding, ...]
    explained: bool
    theta: Array
    covariance: Array
    misfit_deviations: Array
    delay_s: float
    loads: tuple[RecordPartWithLoad, ...]
    state: FittedModel
    always_fitted: tuple[str, ...] = ()

    @property
    def is_misfit(self) -> bool:
        """True if the residual is clearly not noise: large, or explained by smooth signals."""
        smooth = self.state.smooth_misfit > MAX_NOISE_SMOOTH_MISFIT
        return not self.explained and (self.is_residual_large or smooth)

    @property
    def is_residual_large(self) -> bool:
        """True if the residual is too large for coloured sensor noise."""
        return self.state.residual_ratio > _MAX_COLOURED_NOISE_RESIDUAL_RATIO

    @property
    def is_acceleration_missing(self) -> bool:
        """True if the record lacks an acceleration whose force may cause the misfit."""
        return not self.explained and bool(np.isinf(self.state.data.acceleration_noise))

    @property
    def needs_full_gain_matrix(self) -> bool:
        """True if crosstalk is likely: several gain errors, or one with rotation or cable."""
        model = self.state.model
        others = {"rotation", "cable"} & set(model.extensions)
        return len(model.gain_channels) > 1 or bool(model.gain_channels and others)


def explain_misfit(
    data: BlockMeans, means_at: MeansAtDelay | None = None, always_fitted: tuple[str, ...] = ()
) -> MisfitExplanation:
    """Test whether a rigid load explains a record, and search for causes if it does not.

    The model contains the extensions `always_fitted`, such as "weight", from the start.
    `means_at(x)` returns the block means with an additional motion delay x [s].
    """
    with one_blas_thread():
        state, delay_s, rejected = search_causes(data, means_at, always_fitted)
        blocks = intervals.jackknife_load_deviations(state)
        gains = covariance_of_load_by_gain_errors(state) + covariance_of_load_by_torque_unit(state)
        covariance = intervals.covariance_of_load(state, rejected, blocks, gains)
        causes = cause.name_misfit_causes(state, always_fitted)
        only_noise = residual_is_noise(state)
        if not causes and (only_noise or may_be_coloured_noise(state)):
            causes = _findings_if_load_is_absent(state, covariance)
        return MisfitExplanation(
            causes=tuple(causes),
            explained=only_noise,
            theta=state.x[OFFSETS_AND_LOAD],
            covariance=covariance,
            misfit_deviations=deviations_of_load_if_unexplained(state, rejected, blocks, gains),
            delay_s=delay_s + float(state.x[DELAY_INDEX]),
            loads=tuple(cause.loads_between_changes(state, covariance)),
            state=state,
            always_fitted=always_fitted,
        )


def fit_with_missing_acceleration(why: MisfitExplanation) -> MisfitExplanation:
    """Return the unweighted fit of a record without acceleration, with a pessimistic covariance.

    All residuals count as one common error, because the missing acceleration depends on the
    orientation. The centre of rotation is unknown, hence the inertia is undetermined.
    """
    data, axes = why.state.data, why.state.model.axes
    fits = []
    for Q in (axes, np.eye(3), -np.eye(3)):
        model = LoadModel(extensions=why.always_fitted, axes=Q)
        x = model.start_parameters(why.state.x, why.state.model)
        state = FittedModel.fit_record(data, model, x)
        for _ in range(2):  # the first one may be limited in its largest change
            state = fit_model(model, state.rows, state.x, iterations=2)
        fits.append(state)
    # A rotation that is not right-angled resembles several permutations of axes.
    limit = _MAX_RESIDUAL_OVER_PERMUTED_AXES * fits[0].residual_ratio
    simple = (x for x in fits[1:] if x.x[6] > 0.0 and x.residual_ratio < limit)
    state = next(simple, fits[0])
    covariance = float(data.used.sum()) * state.covariance[OFFSETS_AND_LOAD, OFFSETS_AND_LOAD]
    covariance = mark_undetermined(covariance, np.arange(16) >= 10)
    causes = tuple(cause.name_misfit_causes(state, why.always_fitted))
    found = replace(why, theta=state.x[OFFSETS_AND_LOAD], covariance=covariance, causes=causes)
    return replace(found, state=state, delay_s=0.0, loads=())


def _findings_if_load_is_absent(state: FittedModel, covariance: Array) -> list[Finding]:
    mass, deviation = abs(float(state.x[6])), float(np.sqrt(covariance[6, 6]))
    largest = min(_MAX_ABSENT_MASS_KG, _PRESENT_MASS_OVER_DEVIATION * deviation)
    if not (mass < max(_ABSENT_MASS_OVER_DEVIATION * deviation, largest) and deviation < 0.1):
        return []
    most = mass + 1.96 * deviation
    text = f"the load on the sensor is below {1e3 * most:.2g} g; only the offsets are identified"
    return [Finding("no load", text, values={"mass_limit": most})]
