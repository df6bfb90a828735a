"""Alignment of motion and wrench in time, and the load identified from a log with poses."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import (
    Array,
    one_blas_thread,
    samples_to_nearest_true,
    width_and_centre_of_narrowest_half,
)
from drake_teleop.load.batch.consistent import consistent_least_squares
from drake_teleop.load.batch.methods import METHODS, BatchResult
from drake_teleop.load.compensation import contact_wrench
from drake_teleop.load.identification import Identification, is_precise_enough, mark_undetermined
from drake_teleop.load.normal_equations import SecondMoments
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.logs.causes.cause import Finding
from drake_teleop.logs.check.motion_checks import pose_unit_or_frame_finding
from drake_teleop.logs.check.motion_size import explain_lack_of_motion
from drake_teleop.logs.pose_motion.estimate import (
    PoseEstimate,
    PoseMotion,
    estimate_from_poses,
    fit_motion_to_load,
)
from drake_teleop.logs.pose_motion.rigid import wrench_coefficients_of_load
from drake_teleop.logs.read import alignment
from drake_teleop.logs.read.alignment import choose_delay, is_far_from_gaps, low_pass, low_pass_log
from drake_teleop.logs.read.canonical import Log
from drake_teleop.logs.read.reading import read_log
from drake_teleop.logs.read.table_files import note_that_table_needs_description

_MAX_KNOWN_DELAY_STD_S, _EDGE_MARGIN_OVER_KNOT_SPACING = 0.005, 2.0
SPLINE_METHOD_NAMES = ("robust", "consistent")
"""Methods that use splines; the others differentiate the motion and take it as exact."""
_MIN_NOISE_STD_OVER_WRENCH_RMS = 1e-9
MIN_SPLINE_RECORD_DURATION_S = 4.0  # shorter records have too few frequencies for splines
# Fewest kept samples, and largest cut-off of the low-pass over their rate; kept samples per chunk,
# and neighbours for smoothing.
_MIN_SAMPLES_AT_REDUCED_RATE, _MAX_CUTOFF_OVER_REDUCED_RATE = 400_000, 0.25
_CHUNK_SAMPLES, _FILTER_MARGIN_SAMPLES = 2**14, 2**8
_PoseMotionType = TypeVar("_PoseMotionType", bound=PoseMotion)


def _fit_with_fallback_delay(
    log: Log,
    delay: str | float,
    fit_at_delay: Callable[..., _PoseMotionType],
    fallback_delay_s: float,
    fallback_source: str,
) -> tuple[_PoseMotionType, str]:
    posed = log.posed
    assert posed is not None
    arrays = log.t, log.wrench, posed.poses, posed.gravity_W
    fit_at_delay = partial(fit_at_delay, *arrays, lost=log.bridged, imu=posed.imu)
    known, source = (None, "estimated") if delay == "auto" else choose_delay(log, None, delay)
    found = fit_at_delay(delay=known)
    if known is None and not found.delay_std_s < _MAX_KNOWN_DELAY_STD_S:
        return fit_at_delay(delay=fallback_delay_s), fallback_source
    return found, source


def use_spline_motion_and_flag_edges(log: Log, found: PoseMotion) -> tuple[Log, NDArray[np.bool_]]:
    """Return the log without delay, with spline motion; and flags (N,): True near ends, gaps."""
    assert log.posed is not None
    moved, splines = alignment.remove_delay(log, found.delay_s), found.splines
    t, gravity_W = moved.t + found.delay_s, log.posed.gravity_W
    *motion, gravity = splines.motion(t, gravity_W)
    moved = moved.with_motion(*motion, gravity=gravity)
    stamps, margin = splines.poses.t, _EDGE_MARGIN_OVER_KNOT_SPACING * splines.spacing
    gaps = np.flatnonzero(np.diff(stamps) > splines.spacing)
    ends = stamps[np.concatenate([[0], gaps, gaps + 1, [len(stamps) - 1]])]
    change = np.zeros(len(t) + 1)
    np.add.at(change, np.searchsorted(t, ends - margin), 1.0)
    np.add.at(change, np.searchsorted(t, ends + margin), -1.0)
    return moved, np.cumsum(change[:-1]) > 0.0


def _pose_clock_rate_notes(estimate: PoseMotion) -> list[str]:
    if not estimate.clock_rate_error:
        return []
    side = "faster" if estimate.clock_rate_error > 0.0 else "slower"
    return [
        f"the clock of the pose runs {1e6 * abs(estimate.clock_rate_error):.0f} millionths {side}"
        " than that of the wrench, which is corrected; to state it, multiply pose.time.scale (1 by"
        f" default) by {1.0 / (1.0 + estimate.clock_rate_error):.6f}"
    ]


@dataclass(frozen=True)
class AlignedLog:
    """Log with motion and wrench at the same instants.

    Attributes:
        log: with gravity 0 and acceleration as specific force if the robot removed the weight.
        delay_s: removed delay of the motion behind the wrench [s].
        delay_source: "estimated", "given", "load" (identification file) or "static".
        log_with_differentiated_motion: log with numerically differentiated motion, if requested.
        edge: (N,) True for samples near ends and gaps, whose motion is less accurate.
        clock_notes: note on the clock rate of the poses, if it was corrected.
    """

    log: Log
    delay_s: float
    delay_source: str
    log_with_differentiated_motion: Log | None
    edge: NDArray[np.bool_]
    clock_notes: tuple[str, ...] = ()


def read_aligned_log(
    path: str | Path,
    phi: Array,
    fallback_delay_s: float,
    cutoff_hz: float | None,
    delay: str | float,
    differentiate: bool,
    weight_removed: bool,
) -> AlignedLog:
    """Return the log in a file, without the delay between motion and wrench.

    The motion is from pose splines, or from an IMU if the load phi (10,) then fits better. The
    removed delay is `delay` [s], or its estimate for "auto", or `fallback_delay_s` if undetermined.
    `differentiate` adds differentiated motion; `weight_removed`: the robot subtracted the weight.
    """
    log = read_log(path, bandwidth_hz=cutoff_hz, differentiate=differentiate)
    weight_removed = weight_removed or "weight" in log.estimated
    candidates: list[AlignedLog] = []
    motion = None
    if log.posed is not None and not log.static:
        coefficients = wrench_coefficients_of_load(phi, phi[:4] if weight_removed else None)
        fit = partial(fit_motion_to_load, coefficients=coefficients)
        with one_blas_thread(), suppress(DrakeTeleopError):  # too short
            motion, source = _fit_with_fallback_delay(log, delay, fit, fallback_delay_s, "load")
    if motion is not None and motion.is_imu_consistent_with_poses:
        moved, one_sided = use_spline_motion_and_flag_edges(log, motion)
        plain = alignment.remove_delay(log, motion.delay_s) if differentiate else None
        if weight_removed:
            moved = replace_specific_force_by_acceleration(moved)
            plain = None if plain is None else replace_specific_force_by_acceleration(plain)
        edge = one_sided | alignment.is_near_ends(moved, 0.0, cutoff_hz)
        notes = tuple(_pose_clock_rate_notes(motion))
        candidates = [AlignedLog(moved, motion.delay_s, source, plain, edge, notes)]
        if log.posed is None or log.posed.imu is None:
            return candidates[0]
    elif log.posed is not None and not differentiate:
        log = read_log(path, bandwidth_hz=cutoff_hz)
    log = replace_specific_force_by_acceleration(log) if weight_removed else log
    delay_s, source = choose_delay(log, cutoff_hz, delay, phi)
    if source == "undetermined":
        delay_s, source = fallback_delay_s, "load"
    log = alignment.remove_delay(log, delay_s)
    edge = alignment.is_near_ends(log, log.one_sided_s, cutoff_hz)
    candidates.append(AlignedLog(log, delay_s, source, log, edge))

    def ln_residual_width(aligned: AlignedLog) -> float:
        log = aligned.log
        residual = contact_wrench(log.wrench, np.zeros(6), *log.motion, phi)
        residual = low_pass(residual, log.dt, cutoff_hz)[~aligned.edge]
        return float(np.log(width_and_centre_of_narrowest_half(residual)[0] + 1e-12).sum())

    return min(candidates, key=ln_residual_width)


def removed_weight_needs_orientation_error(where: str) -> DrakeTeleopError:
    return DrakeTeleopError(
        "the robot has removed the weight of the load from the wrench, and without an orientation"
        " gravity cannot be subtracted from the measured acceleration",
        where=where,
        remedy="add poses, or use the wrench without payload compensation",
    )


def replace_specific_force_by_acceleration(log: Log) -> Log:
    """Return the log with the acceleration as its `specific_force`, and a `gravity` of zero."""
    if log.gravity is None:
        raise removed_weight_needs_orientation_error(log.source)
    s = log.specific_force + log.gravity
    return replace(log, specific_force=s, gravity=np.zeros_like(s))


@dataclass(frozen=True)
class LoadFitOfLog:
    """Load identified from a log; `log` contains the used samples without delay.

    `delay_source` is "static", "given", "estimated", or "undetermined" (delay 0). `motion` is the
    spline motion, if used.
    """

    log: Log
    fit: BatchResult
    delay_s: float
    delay_source: str
    motion: PoseEstimate | None = None


def fit_load_to_posed_log(
    log: Log, method: str, cutoff_hz: float | None, delay: str | float
) -> tuple[LoadFitOfLog | None, tuple[Finding, ...]]:
    """Return the load identified from wrench and poses, and any finding on unit or frame of poses.

    The load is None for a `method` without splines, a log at rest, poses over less than 4 s, or
    an IMU that contradicts the poses.
    """
    is_long = log.t[-1] - log.t[0] >= MIN_SPLINE_RECORD_DURATION_S
    if log.posed is None or log.static or method not in SPLINE_METHOD_NAMES or not is_long:
        return None, ()
    estimate = partial(estimate_from_poses, gain_std=log.gain_std)
    is_delay_unknown = delay == "auto" and explain_lack_of_motion(log) is not None
    options = 0.0 if is_delay_unknown else delay, estimate, 0.0, "undetermined"
    found, source = _fit_with_fallback_delay(log, *options)
    source = "undetermined" if is_delay_unknown else source
    finding = None if log.estimated else pose_unit_or_frame_finding(found, log)
    if log.posed.imu is not None:
        rotated = found.frame.is_rotated and not found.frame.is_shifted
        if not found.is_imu_consistent_with_poses or (finding is not None and not rotated):
            return None, () if finding is None else (finding,)
        finding = None  # the search of causes names the rotation
    moved, edge = use_spline_motion_and_flag_edges(_reduce_sample_rate(log, cutoff_hz), found)
    shown = low_pass_log(moved, cutoff_hz).select_rows(is_far_from_gaps(moved, cutoff_hz) & ~edge)
    at = np.clip(np.searchsorted(found.t, shown.t, side="right") - 1, 0, None)
    fit = _batch_result_of_pose_estimate(shown, found, found.rejected[at], method, log.gain_std)
    # Errors of gains beyond the stated ones make the load uncertain.
    if finding is not None or not found.fit.is_explained_by_gains:
        fit = replace(fit, identification=fit.identification.with_unidentified_load())
    if finding is not None:
        text = f"{finding.message}{note_that_table_needs_description(log.source)}"
        fit, finding = replace(fit, note=""), replace(finding, message=text)
    fitted = LoadFitOfLog(shown, fit, found.delay_s, source, found)
    return fitted, () if finding is None else (finding,)


def _reduce_sample_rate(log: Log, cutoff_hz: float | None) -> Log:
    stride = len(log) // _MIN_SAMPLES_AT_REDUCED_RATE
    if cutoff_hz is not None:
        stride = min(stride, int(_MAX_CUTOFF_OVER_REDUCED_RATE / (cutoff_hz * log.dt)))
    if stride < 2:
        return log
    few = log.select_rows(slice(None, None, stride))
    wrench = np.empty((len(few), 6))
    for start in range(0, len(few), _CHUNK_SAMPLES):  # in chunks, to save memory
        before = max(0, start - _FILTER_MARGIN_SAMPLES)
        stop = start + _CHUNK_SAMPLES + _FILTER_MARGIN_SAMPLES
        smooth = low_pass(log.wrench[before * stride : stop * stride], log.dt, 0.4 / few.dt)
        wrench[start : start + _CHUNK_SAMPLES] = smooth[::stride][start - before :][:_CHUNK_SAMPLES]
    bridged = None
    if log.bridged is not None:
        bridged = samples_to_nearest_true(log.bridged)[::stride] <= stride
    return replace(few, wrench=wrench, bridged=bridged)


def _batch_result_of_pose_estimate(
    log: Log, estimate: PoseEstimate, rejected: NDArray[np.bool_], method: str, gain_std: float
) -> BatchResult:
    kept = ~rejected
    theta = _consistent_parameters(estimate) if method == "consistent" else estimate.theta
    residual = log.wrench - theta[:6] - non_contact_wrench(*log.motion, theta[6:])
    noise = np.sqrt(np.mean(residual[kept] ** 2, axis=0))
    size = np.sqrt(np.mean(log.wrench**2, axis=0).reshape(2, 3).sum(axis=1)).repeat(3)
    equations = SecondMoments(np.maximum(noise, _MIN_NOISE_STD_OVER_WRENCH_RMS * size + 1e-30))
    equations.add_samples(*(table[kept] for table in (log.wrench, *log.motion)))
    plain = equations.solve(estimate.delay_s)
    unknown = np.isinf(np.diag(plain.covariance)) | np.isinf(np.diag(estimate.covariance))
    covariance = mark_undetermined(estimate.covariance, unknown)
    load: Identification = replace(
        plain,
        phi=theta[6:],
        offsets=theta[:6],
        covariance=covariance,
        identifiable=is_precise_enough(np.sqrt(np.diag(covariance)), theta[6:]),
        residual_rms=noise,
        method=METHODS[method].name,
    )
    notes = [*([estimate.note] if estimate.note else []), *_pose_clock_rate_notes(estimate)]
    if not estimate.fit.is_explained_by_gains:
        verb, beyond = ("increase", " beyond the stated") if gain_std else ("state", "")
        notes.append(
            "the wrench is not that of a rigid load alone, which increases all standard deviations"
            f" by a factor of {estimate.fit.std_inflation_by_misfit:.2g} (possible causes: gain"
            f" errors{beyond}, bending, or a pose frame that is not S); {verb} wrench.gain_std, or"
            " correct the frame of the pose"
        )
    return BatchResult(load, noise, rejected, "; ".join(notes), equations)


def _consistent_parameters(estimate: PoseEstimate) -> Array:
    theta, covariance = estimate.theta, estimate.covariance
    if theta[6] < 0.0 or np.isinf(np.diag(covariance)).any():
        return theta
    scale = 1.0 / np.sqrt(np.diag(covariance))
    gram = np.linalg.pinv(covariance * np.outer(scale, scale), hermitian=True)
    gram = gram * np.outer(scale, scale)
    return consistent_least_squares(gram, gram @ theta, theta)
