"""Fit of a load to a log with poses."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.numeric import Array
from drake_teleop.load.batch.consistent import consistent_least_squares
from drake_teleop.load.batch.methods import METHODS, BatchResult
from drake_teleop.load.identification import Identification, is_precise_enough, mark_undetermined
from drake_teleop.load.normal_equations import SecondMoments
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.logs.aligned_log import (
    clock_rate_notes,
    estimate_motion_and_load,
    use_spline_motion,
)
from drake_teleop.logs.check.corrections import Finding
from drake_teleop.logs.check.pose_checks import has_usable_poses, pose_unit_or_frame_finding
from drake_teleop.logs.pose_motion.estimate import PoseEstimate
from drake_teleop.logs.read.alignment import far_from_gaps, low_pass, low_pass_log, widen_flags
from drake_teleop.logs.read.canonical import Log
from drake_teleop.logs.read.table_files import yaml_only_note

METHODS_WITH_SPLINES = ("robust", "consistent")
"""Methods that use splines; the others differentiate the motion and take it as exact."""
_MIN_NOISE_STD_OVER_WRENCH_RMS = 1e-9
# Fewest kept samples, and largest cut-off of the low-pass over their rate; kept samples per chunk,
# and neighbours for smoothing.
_MIN_SAMPLES_AT_REDUCED_RATE, _MAX_CUTOFF_OVER_REDUCED_RATE = 400_000, 0.25
_CHUNK_SAMPLES, _FILTER_NEIGHBOURS = 2**14, 2**8


@dataclass(frozen=True)
class PosedFit:
    """Load identified from a log with poses, after removal of the delay `delay_s` [s].

    Attributes:
        log: used samples with the motion of splines, low-passed.
        delay_source: origin of the delay: "given", "estimated", or "undetermined" (0 was used).
    """

    log: Log
    fit: BatchResult
    delay_s: float
    delay_source: str
    motion: PoseEstimate


def fit_load_to_posed_log(
    log: Log, method: str, cutoff_hz: float | None, delay: str | float
) -> tuple[PosedFit | None, tuple[Finding, ...]]:
    """Return the load identified from wrench and poses, and findings about the pose frame.

    The load is None for a method without splines, a log without usable poses, or an IMU that
    contradicts the poses.
    """
    if log.posed is None or method not in METHODS_WITH_SPLINES or not has_usable_poses(log):
        return None, ()
    found, source = estimate_motion_and_load(log, delay)
    finding = None if log.estimated else pose_unit_or_frame_finding(found, log)
    if log.posed.imu is not None:
        rotated = found.frame.is_rotated and not found.frame.is_shifted
        if not found.is_imu_consistent_with_poses or (finding is not None and not rotated):
            return None, () if finding is None else (finding,)
        finding = None  # the search of causes names the rotation
    moved, one_sided = use_spline_motion(_reduce_log_rate(log, cutoff_hz), found)
    shown = low_pass_log(moved, cutoff_hz).select_rows(far_from_gaps(moved, cutoff_hz) & ~one_sided)
    at = np.clip(np.searchsorted(found.t, shown.t, side="right") - 1, 0, None)
    fit = _batch_result_of_estimate(shown, found, found.rejected[at], method, log.gain_std)
    # Errors of gains beyond the stated ones make the load uncertain.
    if finding is not None or not found.fit.is_explained_by_gains:
        fit = replace(fit, identification=fit.identification.with_unidentified_load())
    if finding is not None:
        fit = replace(fit, note="")
        finding = replace(finding, message=f"{finding.message}{yaml_only_note(log.source)}")
    findings = () if finding is None else (finding,)
    return PosedFit(shown, fit, found.delay_s, source, found), findings


def _reduce_log_rate(log: Log, cutoff_hz: float | None) -> Log:
    stride = len(log) // _MIN_SAMPLES_AT_REDUCED_RATE
    if cutoff_hz is not None:
        stride = min(stride, int(_MAX_CUTOFF_OVER_REDUCED_RATE / (cutoff_hz * log.dt)))
    if stride < 2:
        return log
    few = log.select_rows(slice(None, None, stride))
    wrench = np.empty((len(few), 6))
    for start in range(0, len(few), _CHUNK_SAMPLES):  # in chunks, to save memory
        before = max(0, start - _FILTER_NEIGHBOURS)
        stop = start + _CHUNK_SAMPLES + _FILTER_NEIGHBOURS
        smooth = low_pass(log.wrench[before * stride : stop * stride], log.dt, 0.4 / few.dt)
        wrench[start : start + _CHUNK_SAMPLES] = smooth[::stride][start - before :][:_CHUNK_SAMPLES]
    bridged = None if log.bridged is None else widen_flags(log.bridged, stride)[::stride]
    return replace(few, wrench=wrench, bridged=bridged)


def _batch_result_of_estimate(
    log: Log, found: PoseEstimate, rejected: NDArray[np.bool_], method: str, gain_std: float
) -> BatchResult:
    kept = ~rejected
    theta = _physically_consistent_theta(found) if method == "consistent" else found.theta
    residual = log.wrench - theta[:6] - non_contact_wrench(*log.motion, theta[6:])
    noise = np.sqrt(np.mean(residual[kept] ** 2, axis=0))
    size = np.sqrt(np.mean(log.wrench**2, axis=0).reshape(2, 3).sum(axis=1)).repeat(3)
    equations = SecondMoments(np.maximum(noise, _MIN_NOISE_STD_OVER_WRENCH_RMS * size + 1e-30))
    equations.add_samples(*(table[kept] for table in (log.wrench, *log.motion)))
    plain = equations.solve(found.delay_s)
    unknown = np.isinf(np.diag(plain.covariance)) | np.isinf(np.diag(found.covariance))
    covariance = mark_undetermined(found.covariance, unknown)
    load: Identification = replace(
        plain,
        phi=theta[6:],
        offsets=theta[:6],
        covariance=covariance,
        identifiable=is_precise_enough(np.sqrt(np.diag(covariance)), theta[6:]),
        residual_rms=noise,
        method=METHODS[method].name,
    )
    return BatchResult(load, noise, rejected, _note_on_estimate(found, gain_std), equations)


def _physically_consistent_theta(found: PoseEstimate) -> Array:
    theta, covariance = found.theta, found.covariance
    if theta[6] < 0.0 or np.isinf(np.diag(covariance)).any():
        return theta
    scale = 1.0 / np.sqrt(np.diag(covariance))
    gram = np.linalg.pinv(covariance * np.outer(scale, scale), hermitian=True)
    gram = gram * np.outer(scale, scale)
    return consistent_least_squares(gram, gram @ theta, theta)


def _note_on_estimate(found: PoseEstimate, stated: float) -> str:
    notes = [*([found.note] if found.note else []), *clock_rate_notes(found)]
    if not found.fit.is_explained_by_gains:
        gains = "gains (state wrench.gain_std), " if stated == 0.0 else f"gains beyond {stated:g}, "
        notes.append(
            f"the wrench is not that of a rigid load alone: {gains}bending, or a frame that is not"
            f" S; deviations are {found.fit.std_inflation_by_misfit:.2g} times as large as by noise"
        )
    return "; ".join(notes)
