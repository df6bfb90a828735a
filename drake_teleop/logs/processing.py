"""Identification of the load, and its removal, for log files (long: code of three commands)."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array, finite_array, one_blas_thread, to_float
from drake_teleop.load import compensation
from drake_teleop.load.batch.methods import DEFAULT_METHOD, METHODS, identify_batch
from drake_teleop.load.batch.uncertainty import BaseParameters, base_parameters
from drake_teleop.load.compensation import contact_wrench
from drake_teleop.load.contact.detection import MIN_NOISE_FLOOR_SAMPLES
from drake_teleop.load.contact.noise_floor import limit_covariance_to_scales, statistic_index
from drake_teleop.load.identification import (
    PARAMETER_NAMES,
    Identification,
    load_of_object,
    natural_scales,
)
from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.logs import aligned_log, explained_log
from drake_teleop.logs import contact as contacts
from drake_teleop.logs.aligned_log import SPLINE_METHOD_NAMES, LoadFitOfLog, read_aligned_log
from drake_teleop.logs.causal import CausalContactAndScaledWrench, compute_causal_wrench
from drake_teleop.logs.causes.cause import (
    CAUSES_DETERMINED_AT_REST,
    CAUSES_WITHOUT_CORRECTION,
    Finding,
    RecordPartWithLoad,
)
from drake_teleop.logs.causes.explain import MisfitExplanation
from drake_teleop.logs.check import against_load, conventions, edits
from drake_teleop.logs.check.against_load import MAX_GOOD_RESIDUAL_SHARE, lag_findings
from drake_teleop.logs.check.conventions import ConventionCheckResult, check_conventions_of_file
from drake_teleop.logs.check.handedness import left_handed_pose_finding
from drake_teleop.logs.check.motion_size import MORE_MOTION_REMEDY, explain_lack_of_motion
from drake_teleop.logs.check.nonlinear_sensor import error_of_load_by_nonlinear_sensor
from drake_teleop.logs.check.sensor_filter import sensor_filter_finding
from drake_teleop.logs.check.wrench_channels import wrench_channel_finding
from drake_teleop.logs.read import alignment
from drake_teleop.logs.read.canonical import Log
from drake_teleop.logs.read.reading import check_path_and_cutoff, read_log

_CAUSES_EXPLAINED_BY_GAIN_ERRORS = {"gain", "sensor rotation", "torque factor"}
"""Causes that stated gain errors can explain."""
_CAUSES_RESEMBLING_NONLINEAR_SENSOR = (*CAUSES_DETERMINED_AT_REST, "load change", "gain")
_FINDINGS_PREVENTING_IDENTIFICATION = (
    *("left-handed", "high-pass", "low-pass", "clock rate", "channel sign", "mixed axes"),
    *("dead band", "curvature", "hysteresis"),
)
_MAX_CHANGE_OF_CONSTANT_CHANNEL = 1e-6  # largest relative change of a constant channel
_MIN_TARE_SAMPLES, _MIN_CORRECTED_DELAY_S = 10, 1e-4
_MIN_REPORTED_DELAY_OVER_STD = 5.0  # standard deviations
_MAX_TELEOP_FORCE_SCALE = 100.0  # as in `ForceScalingConfig`


@dataclass(frozen=True, repr=False)
class IdentifiedLog:
    """Log with its identified load.

    Attributes:
        log: used samples, low-passed, without delay and gaps.
        predicted: (N, 6) wrench offsets + V phi of the load [N, N m].
        delay_source: origin of the delay, such as "estimated".
        rejected: (N,) True for samples that robust fits reject.
        base_parameters: combinations of offsets and load that the samples determine.
        findings: suspected errors of the log description.
        causes: fitted effects besides a rigid load and constant offsets.
        loads: load of each part of the record, if it changes.
        delay_std_s: standard deviation of an estimated delay [s]; nan if unknown.
    """

    log: Log
    identification: Identification
    predicted: Array
    delay_source: str
    rejected: NDArray[np.bool_]
    base_parameters: BaseParameters
    findings: tuple[Finding, ...] = ()
    causes: tuple[Finding, ...] = ()
    loads: tuple[RecordPartWithLoad, ...] = ()
    delay_std_s: float = float("nan")

    def __repr__(self) -> str:
        return repr(self.identification)


@dataclass(frozen=True)
class EliminatedLog:
    """Log with the load's wrench (weight and inertia) removed.

    Wrenches are (N, 6), low-passed, in S [N, N m].

    Attributes:
        log: without delay and gaps; not low-passed.
        phi: (10,) removed load, gripper and object.
        offsets: (6,) sensor offsets of this record [N, N m].
        tare_fraction: share of samples that agree on `offsets`; 1 for given offsets or span.
        delay_s, delay_source: removed delay of the motion behind the wrench [s], and its origin.
        measured: wrench without offsets.
        non_contact: load's wrench V phi.
        contact: contact wrench F_c, Eq. (13).
        scaled: scaled wrench gamma F_c + sigma V phi.
        gravity_only: wrench without weight, with offsets chosen as for `contact`; or None.
        noise_floor: (6,) noise of `contact` [N, N m].
        causal: wrenches as in a control loop, if requested.
        edge: (N,) True for samples near ends and gaps, excluded from all figures.
        detection: contacts; None for static poses and very short records.
        findings: suspected errors of the description, after a poor fit.
    """

    log: Log
    phi: Array
    offsets: Array
    tare_fraction: float
    delay_s: float
    delay_source: str
    measured: Array
    non_contact: Array
    contact: Array
    scaled: Array
    gravity_only: Array | None
    noise_floor: Array
    causal: CausalContactAndScaledWrench | None
    edge: NDArray[np.bool_]
    detection: contacts.Detection | None = None
    findings: tuple[Finding, ...] = ()

    @property
    def touched(self) -> NDArray[np.bool_]:
        """Booleans (N,): True for contact; all False without a `detection`."""
        none = np.zeros(len(self.contact), bool)
        return none if self.detection is None else self.detection.touched


@one_blas_thread()
def identify_log(
    path: str | Path,
    *,
    method: str = DEFAULT_METHOD,
    cutoff_hz: float | None = 30.0,
    delay: str | float = "auto",
    checks: ConventionCheckResult | None = None,
) -> IdentifiedLog:
    """Identify the load and the sensor offsets from a log.

    With positions, "robust" and "consistent" use motion from splines. Otherwise wrench and motion
    pass one zero-phase low-pass, and the motion counts as exact. Static poses are unfiltered.

    Args:
        path: canonical table or log description.
        method: "ordinary", "whitened", "total", "robust", "consistent" or a registered name.
        cutoff_hz: cut-off of the low-pass; None for no filter.
        delay: delay of the motion behind the wrench [s], or "auto".
        checks: result of `check_conventions_of_file` for this log, if known.
    """
    METHODS.check(method, "method")
    check_path_and_cutoff(path, cutoff_hz)
    check = partial(check_conventions_of_file, Path(path)) if checks is None else lambda: checks
    options = method, cutoff_hz
    raw, fitted, frame_findings = _read_and_fit_load(path, *options, delay)
    mirrored = _left_handed_pose_finding(raw, fitted)
    misfit, too_still = None, None
    if mirrored is None:
        misfit, too_still = _explain_residual(raw, fitted, frame_findings)
    if misfit is not None:
        fitted, frame_findings = _correct_delay(raw, fitted, frame_findings, misfit, *options)
    errors = _findings_that_invalidate_load(raw, fitted, frame_findings, misfit, too_still, check)
    errors = errors if mirrored is None else (mirrored,)
    load_errors = np.zeros(10)
    if not errors and misfit is not None and _may_sensor_be_nonlinear(raw, misfit):
        sensor = error_of_load_by_nonlinear_sensor(fitted.log, fitted.fit.identification)
        load_errors, errors = sensor[0], () if sensor[1] is None else (sensor[1],)
    causes: tuple[Finding, ...] = ()
    result, note = fitted.fit.identification, fitted.fit.note
    accepted = None if errors else misfit
    if errors:
        useless = too_still or errors[0].name in _FINDINGS_PREVENTING_IDENTIFICATION
        result = result.with_nothing_identified() if useless else result.with_unidentified_load()
    if accepted is not None:
        result, causes, note = _apply_explanation(result, raw, accepted, frame_findings, note)
    log = replace(fitted.log, notes=(*fitted.log.notes, *([note] if note else [])))
    predicted = result.offsets + non_contact_wrench(*log.motion, result.phi)
    unexplained = against_load.unexplained_share(log.wrench, log.wrench - predicted)
    if not raw.static and not causes and (misfit is None or misfit.is_misfit):
        # Errors of the motion with this share of its variance reduce the load by this share.
        kept = ~fitted.fit.rejected
        share = against_load.unexplained_share(log.wrench[kept], (log.wrench - predicted)[kept])
        load_errors = np.hypot(load_errors, share * natural_scales(result.phi)[6:])
    if result.mass > 0.0:  # a negative mass is reported below
        result = explained_log.add_errors_of_load(result, load_errors)
    findings = errors or causes
    if not findings and not raw.estimated:
        known = None if fitted.delay_source == "undetermined" else fitted.delay_s
        findings = conventions.findings_if_load_is_suspicious(log, result, predicted, known, check)
        findings = findings or frame_findings
        if accepted and accepted.is_acceleration_missing and not result.identifiable.all():
            findings = (*findings, explained_log.missing_acceleration_finding(accepted))
    corrections = [x for x in causes if x.name not in CAUSES_WITHOUT_CORRECTION]
    open_misfit = _unexplained_misfit(misfit, result, corrections, unexplained)
    if open_misfit is not None and (corrections or not findings):
        findings, causes = (explained_log.misfit_finding(open_misfit, corrections),), ()
    mass_message = explained_log.implausible_mass_message(result.mass, causes, raw)
    if mass_message is not None:
        findings = (*findings, Finding("units", mass_message))
    if any(finding.name == "payload" for finding in findings):
        result = result.with_unidentified_load()
    determined = base_parameters(fitted.fit.equations)
    loads = () if accepted is None else accepted.loads
    if open_misfit is not None:
        result, loads = result.with_nothing_identified(), ()
        determined = BaseParameters((), (), (), ())
    return IdentifiedLog(
        *(log, result, predicted, fitted.delay_source, fitted.fit.rejected),
        *(determined, findings, causes, loads),
        delay_std_s=float("nan") if fitted.motion is None else fitted.motion.delay_std_s,
    )


def _read_and_fit_load(
    path: str | Path, method: str, cutoff_hz: float | None, delay: str | float
) -> tuple[Log, LoadFitOfLog, tuple[Finding, ...]]:
    log = read_log(path, bandwidth_hz=cutoff_hz, differentiate=method not in SPLINE_METHOD_NAMES)
    fitted, frame_findings = aligned_log.fit_load_to_posed_log(log, method, cutoff_hz, delay)
    if fitted is None and log.posed is not None and log.posed.imu is None:  # too short for splines
        log = read_log(path, bandwidth_hz=cutoff_hz)
    return log, fitted or _fit_load_to_filtered_log(log, method, cutoff_hz, delay), frame_findings


def _left_handed_pose_finding(log: Log, fitted: LoadFitOfLog) -> Finding | None:
    if log.posed is None or log.posed.imu is not None or log.static:
        return None
    load, shown = fitted.fit.identification, fitted.log
    residual = contact_wrench(shown.wrench, load.offsets, *shown.motion, load.phi)
    if against_load.unexplained_share(shown.wrench, residual) < MAX_GOOD_RESIDUAL_SHARE:
        return None
    splines = None if fitted.motion is None else fitted.motion.splines
    return left_handed_pose_finding(shown, splines, fitted.delay_s)


def _explain_residual(
    log: Log, fitted: LoadFitOfLog, frame_findings: tuple[Finding, ...]
) -> tuple[MisfitExplanation | None, str | None]:
    """Return causes of the residual, or the reason why the motion is too small to separate them.

    Gain errors within `log.gain_std` are no causes.
    """
    misfit = None
    if _is_misfit_explainable(log, fitted.motion is not None):
        misfit = explained_log.explain_log(log, fitted.delay_s, fitted.motion)
    if misfit is not None and misfit.is_misfit and _clock_rate_causes(misfit):
        misfit = replace(misfit, causes=())
    contradicts = fitted.motion is None and log.posed is not None and log.posed.imu is not None
    if contradicts and not _clock_rate_causes(misfit):
        misfit = _misfit_of_imu_motion(log, fitted.delay_s)  # the load is that of the IMU
    causes = () if misfit is None else misfit.causes
    need_motion = any(x.name not in CAUSES_DETERMINED_AT_REST for x in (*frame_findings, *causes))
    if need_motion and (too_still := explain_lack_of_motion(log)) is not None:
        return None, too_still
    by_gains = log.gain_std > 0.0 and {x.name for x in causes} <= _CAUSES_EXPLAINED_BY_GAIN_ERRORS
    if misfit is not None and by_gains and not misfit.is_acceleration_missing:
        misfit = replace(misfit, causes=(), explained=True, loads=())
    return misfit, None


def _misfit_of_imu_motion(log: Log, delay_s: float) -> MisfitExplanation | None:
    """Return the misfit if the motion of the IMU, without poses, does not explain the wrench."""
    is_short = log.t[-1] - log.t[0] < aligned_log.MIN_SPLINE_RECORD_DURATION_S  # no comparison
    if is_short or not _is_misfit_explainable(log, has_splines=False):
        return None
    log = replace(log, posed=None, R_WS=None, gravity=None, gravity_W=None)
    misfit = explained_log.explain_log(log, delay_s, None)
    if misfit is None or not (misfit.is_misfit and misfit.is_residual_large):
        return None
    valid = not misfit.causes or any(x.name not in CAUSES_WITHOUT_CORRECTION for x in misfit.causes)
    return misfit if valid and not _clock_rate_causes(misfit) else None


def _may_sensor_be_nonlinear(raw: Log, misfit: MisfitExplanation) -> bool:
    similar = all(cause.name in _CAUSES_RESEMBLING_NONLINEAR_SENSOR for cause in misfit.causes)
    return similar and not (misfit.explained or raw.static or misfit.is_acceleration_missing)


def _clock_rate_causes(misfit: MisfitExplanation | None) -> tuple[Finding, ...]:
    return () if misfit is None else tuple(x for x in misfit.causes if x.name == "clock rate")


def _correct_delay(
    log: Log,
    fitted: LoadFitOfLog,
    frame_findings: tuple[Finding, ...],
    misfit: MisfitExplanation,
    method: str,
    cutoff_hz: float | None,
) -> tuple[LoadFitOfLog, tuple[Finding, ...]]:
    source, motion = fitted.delay_source, fitted.motion
    if source != "estimated":
        return fitted, frame_findings
    delay_s = fitted.delay_s + misfit.delay_s
    if misfit.is_acceleration_missing:  # an acceleration resembles a delay
        source, fitted = "undetermined", _fit_load_to_filtered_log(log, method, cutoff_hz, 0.0)
    elif misfit.causes and abs(misfit.delay_s) > _MIN_CORRECTED_DELAY_S and motion is None:
        fitted = _fit_load_to_filtered_log(log, method, cutoff_hz, delay_s)
    elif misfit.causes and abs(misfit.delay_s) > _MIN_CORRECTED_DELAY_S:
        again, frame_findings = aligned_log.fit_load_to_posed_log(log, method, cutoff_hz, delay_s)
        fitted = again or fitted
    return replace(fitted, delay_source=source, motion=motion), frame_findings


def _findings_that_invalidate_load(
    raw: Log,
    fitted: LoadFitOfLog,
    frame_findings: tuple[Finding, ...],
    misfit: MisfitExplanation | None,
    too_still: str | None,
    check: Callable[[], ConventionCheckResult],
) -> tuple[Finding, ...]:
    errors = tuple(finding for finding in frame_findings if finding.name == "units")
    if too_still is not None:
        text = f"payload not identifiable: {too_still}; {MORE_MOTION_REMEDY}"
        errors = (Finding("payload", text),)
    elif not errors and misfit is not None and (misfit.is_misfit or misfit.causes):
        found = None if raw.static else sensor_filter_finding(fitted.log, fitted.delay_s)
        if not raw.static and misfit.is_misfit:
            splines = None if fitted.motion is None else fitted.motion.splines
            found = wrench_channel_finding(fitted.log, splines, fitted.delay_s) or found
        errors = () if found is None else (found,)
        if not errors and misfit.is_misfit and misfit.causes:
            errors = conventions.motion_findings(check)
    errors = _clock_rate_causes(misfit) or errors
    if raw.described is not None and raw.estimated:  # otherwise `findings_if_load_is_suspicious`
        errors += tuple(edits.correct_accelerometer_unit(raw.described, fitted.log)[0])
    return errors


def _apply_explanation(
    load: Identification,
    raw: Log,
    misfit: MisfitExplanation,
    frame_findings: tuple[Finding, ...],
    note: str,
) -> tuple[Identification, tuple[Finding, ...], str]:
    causes = misfit.causes
    if frame_findings:
        causes = explained_log.use_pose_frame_finding(misfit, frame_findings[0])
    if raw.estimated:
        note = explained_log.removed_weight_note(misfit)
    elif causes and not misfit.needs_crosstalk_calibration:
        note = ""
    return explained_log.apply_explanation_to_load(load, misfit), causes, note


def _unexplained_misfit(
    misfit: MisfitExplanation | None,
    load: Identification,
    corrections: list[Finding],
    unexplained: float,
) -> MisfitExplanation | None:
    """Return `misfit`, or None if causes, noise or a missing acceleration explain it."""
    if misfit is None or not misfit.is_misfit or misfit.is_acceleration_missing:
        return None
    useless = not misfit.causes and unexplained > 0.5
    if load.identifiable[6:].any() and not ((corrections and misfit.is_residual_large) or useless):
        return None  # vibrations may leave a large residual
    return misfit


def _fit_load_to_filtered_log(
    log: Log, method: str, cutoff_hz: float | None, delay: str | float
) -> LoadFitOfLog:
    delay_s, source = alignment.choose_delay(log, cutoff_hz, delay)
    log = alignment.remove_delay(log, delay_s)
    known = alignment.is_far_from_gaps(log, cutoff_hz)
    _require_usable_sample(log, known)
    log = alignment.low_pass_log(log, cutoff_hz).select_rows(known)
    fit = identify_batch(
        log.wrench,
        *log.motion,
        method=method,
        shared_noise=log.static,
        resolution=log.resolution,
        delay_s=delay_s,
        gain_std=log.gain_std,
    )
    return LoadFitOfLog(log, fit, delay_s, source)


def _require_usable_sample(log: Log, usable: NDArray[np.bool_]) -> None:
    if not usable.any():
        what = "all samples are near gaps or ends of the record, within the reach of the low-pass"
        raise DrakeTeleopError(what, where=log.source, remedy="raise the cut-off, or avoid gaps")


def _is_misfit_explainable(log: Log, has_splines: bool) -> bool:
    low, high = log.wrench.min(axis=0), log.wrench.max(axis=0)
    if log.static or (high - low <= _MAX_CHANGE_OF_CONSTANT_CHANNEL * np.maximum(high, -low)).any():
        return False
    imu = None if log.described is None else log.described.imu
    if has_splines or (log.described and (imu is None or imu.specific_force is None)):
        return True
    return bool(5.0 < np.median(np.linalg.norm(log.specific_force, axis=1)) < 20.0)


def check_log(path: Path, checks: ConventionCheckResult | None = None) -> ConventionCheckResult:
    """Identify the load and return `checks` of the log (computed if None), with found causes."""
    checks = check_conventions_of_file(path) if checks is None else checks
    try:
        identified = identify_log(path, checks=checks)
    except DrakeTeleopError as error:
        if not checks.findings:
            with suppress(DrakeTeleopError):
                read_log(path)
                return replace(checks, findings=(Finding("payload", str(error)),))
        return checks
    if any(x.name in _FINDINGS_PREVENTING_IDENTIFICATION for x in identified.findings):
        return replace(checks, findings=identified.findings)
    findings, delay = checks.findings, checks.delay_s
    deviation, own_delay = identified.delay_std_s, identified.identification.delay_s
    no_load = any(cause.name == "no load" for cause in identified.causes)  # explains the record
    caused = all(finding.name in edits.FINDINGS_CAUSED_BY_MISFIT for finding in findings)
    if identified.causes and (no_load or caused):
        delay = own_delay if np.isfinite(deviation) else delay
        return replace(checks, findings=identified.causes, delay_s=delay)
    if identified.log.is_acceleration_unknown and identified.delay_source == "undetermined":
        findings, delay = tuple(x for x in findings if x.name != "lag"), own_delay
    if any(finding.name == "misfit" for finding in identified.findings):
        kept = (x for x in findings if x.fields or x.name not in edits.FINDINGS_CAUSED_BY_MISFIT)
        findings = tuple(kept) or identified.findings
    elif all(finding.name == "lag" for finding in findings):
        findings = (*findings, *identified.findings)
    description = identified.log.described
    if identified.delay_source == "estimated" and np.isfinite(deviation) and description:
        findings = tuple(finding for finding in findings if finding.name != "lag")
        if not findings:
            delay = own_delay
            if abs(delay) > _MIN_REPORTED_DELAY_OVER_STD * deviation:
                findings = tuple(lag_findings(description, delay))
    return replace(checks, findings=findings, delay_s=delay)


def eliminate_log(
    path: str | Path,
    load: str | Path | Identification,
    *,
    gripper: str | Path | Identification | None = None,
    sigma: float = 0.0,
    sigma_object: float | None = None,
    gamma: float = 1.0,
    eta: float | None = None,
    sigma_weight: float | None = None,
    sigma_inertia: float | None = None,
    cutoff_hz: float | None = 30.0,
    delay: str | float = "auto",
    tare: bool = True,
    untouched_s: tuple[float, float] | None = None,
    causal: str | None = None,
    causal_tare_s: float | None = None,
    free: str | Path | None = None,
    statistic: str = "level",
) -> EliminatedLog:
    """Remove (or scale) the wrench of weight and inertia of a known load in a log.

    Args:
        path, delay: as in `identify_log`.
        load: identification.json, or its content.
        gripper: identification of the gripper alone, in the same frame S; `load` is then gripper
            with object.
        sigma: kept share of the load's wrench; with `gripper`, of the gripper's.
        sigma_object: kept share of the object's wrench, with `gripper` only; None: sigma.
        gamma: scale of the contact wrench.
        eta: kept share of the object's wrench, Eq. (14), in place of the other scales; that of the
            gripper is removed.
        sigma_weight, sigma_inertia: kept shares of weight and inertia, instead of sigma and
            sigma_object. They may differ if the log has an orientation.
        cutoff_hz: zero-phase low-pass on all outputs; None for no filter.
        tare: estimate the offsets from this record (`robust_offsets`), not from `load`.
        untouched_s: start and end of a time span without contact, which determines the offsets
            [s]; None: the whole record does, in which contact counts as outliers.
        causal: "delayed" or "predicted": also return `EliminatedLog.causal`.
        causal_tare_s: contact-free start that determines the offsets of `causal` [s]; None: those
            of `load`.
        free: log of free motion with the same load; None: calm parts of the record itself.
        statistic: contact statistic, "level", "cusum" or "glr".

    Raises:
        DrakeTeleopError: for an unusable file, contradictory scales, or `causal` or `free` with
            static poses.
    """
    check_path_and_cutoff(path, cutoff_hz)
    if untouched_s is not None:
        start_s, stop_s = finite_array("untouched_s", untouched_s, 2).tolist()
        untouched_s = start_s, stop_s
    if causal_tare_s is not None:
        causal_tare_s = to_float("causal_tare_s", causal_tare_s)
    identification = load if isinstance(load, Identification) else Identification.load(load)
    given = {"sigma": sigma, "sigma_object": sigma_object, "gamma": gamma}
    given |= {"sigma_weight": sigma_weight, "sigma_inertia": sigma_inertia}
    scales = _resolve_force_scales(given, eta, gripper is not None)
    statistic_index(statistic)  # raises an error for an unknown name before the long computation
    # Without a gripper the load is the object.
    phi_gripper = np.zeros(10)
    if gripper is not None:
        alone = gripper if isinstance(gripper, Identification) else Identification.load(gripper)
        load_of_object(identification, alone)  # raises an error for exchanged files
        phi_gripper = phi_with_inertia_replaced(alone)[0]
    common = identification, phi_gripper, scales, cutoff_hz, delay, tare
    if untouched_s is not None and not tare:
        what = "a contact-free span cannot be combined with --offsets load (tare=False)"
        raise DrakeTeleopError(what, where="untouched", remedy="remove one of the two")
    found = _read_log_and_remove_load(path, *common, untouched_s, causal, causal_tare_s)
    reference = None
    if free is not None:
        free_log = _read_log_and_remove_load(free, *common)
        _reject_static_log(free_log)
        _reject_static_log(found)
        free_samples = contacts.samples_for_detector(free_log.log, free_log.contact, cutoff_hz)
        reference = free_samples.select_rows(~free_log.edge), free_log.log.dt
    if found.log.static:
        return found
    samples = contacts.samples_for_detector(found.log, found.contact, cutoff_hz)
    covariance = limit_covariance_to_scales(found.phi, identification.covariance, tared=tare)
    detection = contacts.detect_contact(
        *(samples, found.log.dt, cutoff_hz, covariance, identification.residual_rms),
        edge=found.edge,
        free=reference,
        statistic=statistic,
    )
    if free is not None and tare and detection is not None:
        notes = contacts.note_on_drift_or_much_contact(found.offsets - free_log.offsets, detection)
        detection = replace(detection, notes=detection.notes + notes)
    return replace(found, detection=detection)


def _reject_static_log(found: EliminatedLog) -> None:
    if found.log.static:
        what = "contains only poses at rest (`static`), in which no contact can be detected"
        raise DrakeTeleopError(
            what, where=found.log.source, remedy="give a log that was recorded in motion"
        )


def _read_log_and_remove_load(
    path: str | Path,
    identification: Identification,
    phi_gripper: Array,
    scales: dict[str, Any],
    cutoff_hz: float | None,
    delay: str | float,
    tare: bool,
    untouched_s: tuple[float, float] | None = None,
    causal: str | None = None,
    causal_tare_s: float | None = None,
) -> EliminatedLog:
    if causal is None and causal_tare_s is not None:
        what = "a contact-free start requires `causal`, wrenches as in a control loop"
        remedy = "give causal as well, or remove causal_tare_s"
        raise DrakeTeleopError(what, where="causal_tare_s", remedy=remedy)
    phi = phi_with_inertia_replaced(identification)[0]
    removed, late_s = identification.weight_removed, identification.delay_s
    aligned = read_aligned_log(path, phi, late_s, cutoff_hz, delay, causal is not None, removed)
    log = aligned.log
    if log.static and causal is not None:
        what = "poses at rest have no times, which a causal filter requires"
        raise DrakeTeleopError(what, where="causal", remedy="remove it")
    known = alignment.is_far_from_gaps(log, cutoff_hz)
    shown, edge = log.select_rows(known), aligned.edge[known]
    _require_usable_sample(log, ~edge)
    parts = phi_gripper, phi - phi_gripper
    scales = scales | {"gravity": log.gravity}

    def low_pass_outside_gaps(wrench: Array) -> Array:
        return wrench if log.static else alignment.low_pass(wrench, log.dt, cutoff_hz)[known]

    def contact_and_scaled(
        offsets: Array, motion: tuple[Array, Array, Array]
    ) -> tuple[Array, Array]:
        reading = log.wrench, offsets, *motion
        scaled = compensation.scaled_wrench(*reading, *parts, **scales)
        return contact_wrench(*reading, phi), scaled

    def choose_offsets(residual: Array) -> tuple[Array, float]:
        if untouched_s is not None:
            return residual[_rows_in_tare_span(shown, *untouched_s)].mean(axis=0), 1.0
        return contacts.robust_offsets(residual) if tare else (identification.offsets, 1.0)

    residual = contact_wrench(log.wrench, np.zeros(6), *log.motion, phi)
    offsets, fraction = choose_offsets(low_pass_outside_gaps(residual))
    gravity_only = None
    removed = removed or "weight" in log.estimated
    sigmas = {name: scales[name] for name in scales if name not in ("gamma", "gravity")}
    weights, inertias = compensation.weight_scales_and_inertia_scales(**sigmas)
    if weights != inertias and removed:
        raise useless_weight_scale_error(log.source)
    if weights != inertias and log.gravity is None:
        where = f"{log.source}: gravity in the sensor frame"
        raise compensation.unknown_gravity_error(where, "add an orientation, or give sigma alone")
    if log.gravity is not None:
        rest = np.zeros_like(log.gravity)
        weightless = contact_wrench(log.wrench, np.zeros(6), -log.gravity, rest, rest, phi)
        weightless = low_pass_outside_gaps(weightless)
        gravity_only = weightless - choose_offsets(weightless)[0]
    contact, scaled = map(low_pass_outside_gaps, contact_and_scaled(offsets, log.motion))
    causal_wrench = None
    if causal is not None and aligned.log_with_differentiated_motion is not None:
        causal_offsets = identification.offsets
        motion = aligned.log_with_differentiated_motion.motion
        if causal_tare_s is not None:
            untouched = contact_wrench(log.wrench, np.zeros(6), *motion, phi)
            rows = _contact_free_rows(log, known, causal_tare_s)
            causal_offsets = untouched[rows].mean(axis=0)
        both = contact_and_scaled(causal_offsets, motion)
        options: dict[str, Any] = {"delay_s": aligned.delay_s, "mode": causal}
        late = compute_causal_wrench(*both, log.dt, cutoff_hz=cutoff_hz, **options)
        inner: dict[str, Any] = {"contact": late.contact[known], "scaled": late.scaled[known]}
        causal_wrench = replace(late, offsets=causal_offsets, **inner)
    measured = log.wrench - offsets
    findings = _check_log_if_contact_is_large(Path(path), measured, contact, identification)
    notes = (*log.notes, *notes_on_undetermined_load(identification))
    # A wrong description would explain the clock, too.
    shown = replace(shown, notes=notes if findings else (*notes, *aligned.clock_notes))
    return EliminatedLog(
        log=shown,
        phi=phi,
        offsets=offsets,
        tare_fraction=fraction,
        delay_s=aligned.delay_s,
        delay_source=aligned.delay_source,
        measured=low_pass_outside_gaps(measured),
        non_contact=low_pass_outside_gaps(non_contact_wrench(*log.motion, phi)),
        contact=contact,
        scaled=scaled,
        gravity_only=gravity_only,
        noise_floor=contacts.noise_floor(contact[~edge]),
        causal=causal_wrench,
        edge=edge,
        findings=findings,
    )


def _rows_in_tare_span(log: Log, start_s: float, stop_s: float) -> NDArray[np.bool_]:
    rows = (log.t - log.t[0] >= start_s) & (log.t - log.t[0] <= stop_s)
    if log.static or rows.sum() < _MIN_TARE_SAMPLES:
        found = "poses at rest without times" if log.static else f"{rows.sum()} samples"
        raise DrakeTeleopError(
            f"the span from {start_s:g} to {stop_s:g} s has {found} ({_MIN_TARE_SAMPLES} required)",
            where="untouched",
            remedy="give a longer span without contact, in seconds after the first sample; the"
            f" record has {log.t[-1] - log.t[0]:.4g} s",
        )
    return rows


def _contact_free_rows(log: Log, usable: NDArray[np.bool_], length_s: float) -> NDArray[np.bool_]:
    rows = usable & (log.t - log.t[0] < length_s)
    if (rows == usable).all() or rows.sum() < _MIN_TARE_SAMPLES:
        what = f"the first {length_s:g} s contain {rows.sum()} of {usable.sum()} samples"
        what += f" ({_MIN_TARE_SAMPLES} or more are required, but not all)"
        remedy = "give another duration of the contact-free start [s]"
        raise DrakeTeleopError(what, where="causal_tare_s", remedy=remedy)
    return rows


def phi_with_inertia_replaced(identification: Identification) -> tuple[Array, tuple[str, ...]]:
    """Return phi (10,) with undetermined inertias as of a point mass, and their names."""
    phi = identification.phi.copy()
    replaced = np.flatnonzero(np.isin(identification.verdicts[10:], ("not", "prior")))
    point = phi_from_mass_com_inertia(identification.mass, identification.com, np.zeros((3, 3)))
    phi[4 + replaced] = point[4 + replaced]
    return phi, tuple(PARAMETER_NAMES[10 + i] for i in replaced)


def notes_on_undetermined_load(load: Identification) -> tuple[str, ...]:
    """Return notes on unidentified parameters of a load, and their effects."""
    named = zip(PARAMETER_NAMES[6:10], load.verdicts[6:10], strict=True)
    moments = [name for name, verdict in named if verdict == "not"]
    return tuple(
        f"{', '.join(names)} of the load are not identified: {effect}"
        for names, effect in (
            (moments, "their errors are in the contact wrench; identify the load again"),
            (phi_with_inertia_replaced(load)[1], "the values of a point mass are used"),
        )
        if names
    )


def _check_log_if_contact_is_large(
    path: Path, wrench: Array, contact: Array, load: Identification
) -> tuple[Finding, ...]:
    sizes = [float(np.median(np.linalg.norm(x[:, :3], axis=1))) for x in (wrench, contact)]
    if sizes[1] < 0.3 * sizes[0]:
        return ()
    ignored = {"lag", "payload", *CAUSES_WITHOUT_CORRECTION}
    if load.weight_removed:
        ignored |= {"weight removed", "payload configured"}
    return tuple(x for x in check_log(path).findings if x.name not in ignored)


def useless_weight_scale_error(where: str) -> DrakeTeleopError:
    what = "the robot has removed the weight, so that a separate scale of it has no effect"
    return DrakeTeleopError(what, where=where, remedy="give sigma alone; it scales the inertia")


def _resolve_force_scales(
    given_scales: dict[str, Any], eta: float | None, has_gripper: bool
) -> dict[str, float | None]:
    for name, value in given_scales.items():
        if value is not None and not 0.0 <= to_float(name, value) <= _MAX_TELEOP_FORCE_SCALE:
            what = f"{value:g} is outside 0 to {_MAX_TELEOP_FORCE_SCALE:g}"
            raise DrakeTeleopError(what, where=name, remedy="give a force scale, such as 0 or 1")
    sigma, kept, gamma, *separate = given_scales.values()
    if kept is not None and not has_gripper:
        what = "sigma_object requires a gripper"
        remedy = "give the gripper's identification.json as well, or use sigma"
        raise DrakeTeleopError(what, where="sigma_object", remedy=remedy)
    if eta is not None:
        if sigma != 0 or gamma != 1 or any(other is not None for other in (kept, *separate)):
            what = "eta requires sigma = 0, gamma = 1 and no other scale (Eq. 14)"
            raise DrakeTeleopError(what, where="eta", remedy="remove all scales except eta")
        sigma, kept, gamma = compensation.scales_from_eta(eta)
    names = "sigma_gripper", "sigma_object", "gamma", "sigma_weight", "sigma_inertia"
    return dict(zip(names, (sigma, sigma if kept is None else kept, gamma, *separate), strict=True))


@dataclass(frozen=True)
class DetectedLog(contacts.Detection):
    """Contacts of a log, and `eliminated`, the log after removal of the load's wrench."""

    eliminated: EliminatedLog = field(kw_only=True)


def detect_log(
    path: str | Path,
    load: str | Path | Identification | None = None,
    *,
    free: str | Path | None = None,
    statistic: str = "level",
    cutoff_hz: float = 30.0,
    delay: str | float = "auto",
) -> DetectedLog:
    """Find contact in a log, after a zero-phase low-pass.

    Args:
        path: canonical table or log description.
        load: identification.json or its content; None: load identified from the log itself.
        free: log of equally fast free motion with the same load; None: calm parts of the log.
        statistic: "level", "cusum" or "glr".
        delay: delay of the motion behind the wrench [s], or "auto".
    """
    if load is None:
        load = identify_log(path, cutoff_hz=cutoff_hz, delay=delay).identification
    elif not isinstance(load, Identification):
        load = Identification.load(load)
    found = eliminate_log(
        path, load, cutoff_hz=cutoff_hz, delay=delay, free=free, statistic=statistic
    )
    _reject_static_log(found)
    if found.detection is None:
        what = f"{len(found.log)} samples are too few to separate contact from noise"
        remedy = f"give a record of at least {MIN_NOISE_FLOOR_SAMPLES} samples besides its ends"
        raise DrakeTeleopError(what, where=found.log.source, remedy=remedy)
    return DetectedLog(**vars(found.detection), eliminated=found)
