"""Alignment of motion and wrench of a log: removal of the delay between them."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array, narrowest_half_interval, one_blas_thread
from drake_teleop.load.compensation import contact_wrench
from drake_teleop.logs.pose_motion.estimate import (
    PoseEstimate,
    PoseMotion,
    estimate_from_poses,
    fit_motion_to_load,
)
from drake_teleop.logs.pose_motion.rigid import load_coefficients
from drake_teleop.logs.read.alignment import choose_delay, is_near_ends, low_pass, remove_delay
from drake_teleop.logs.read.canonical import Log
from drake_teleop.logs.read.reading import read_log

_MAX_KNOWN_DELAY_STD_S = 0.005  # s, standard deviation
_EDGE_MARGIN_OVER_KNOT_SPACING = 2.0
_PoseMotionT = TypeVar("_PoseMotionT", bound=PoseMotion)


def estimate_motion_and_load(log: Log, delay: str | float) -> tuple[PoseEstimate, str]:
    """Return motion and load fitted to a log with poses, and the delay's source ("given" ...)."""
    posed = log.posed
    assert posed is not None

    def estimate_at_delay(late: float | None) -> PoseEstimate:
        arrays = log.t, log.wrench, posed.poses, posed.gravity_W
        return estimate_from_poses(
            *arrays, delay=late, gain_std=log.gain_std, lost=log.bridged, imu=posed.imu
        )

    return _fit_with_usual_delay_if_undetermined(log, delay, estimate_at_delay, 0.0, "undetermined")


def fit_motion_to_known_load(
    log: Log, delay: str | float, load: Array, usual_s: float
) -> tuple[PoseMotion, str] | None:
    """Return the motion from poses that fits an identified load best, and the delay's source.

    `load` (6, 16) are the load's coefficients, Eq. (T73). The delay is `usual_s` [s] if the record
    does not determine it. Return None for a short log, and without poses or if the IMU disagrees.
    """
    posed = log.posed
    if posed is None or log.static:
        return None
    arrays = log.t, log.wrench, posed.poses, posed.gravity_W, load

    def motion_at_delay(late: float | None) -> PoseMotion:
        return fit_motion_to_load(*arrays, delay=late, lost=log.bridged, imu=posed.imu)

    with suppress(DrakeTeleopError):  # too short
        found, source = _fit_with_usual_delay_if_undetermined(
            log, delay, motion_at_delay, usual_s, "load"
        )
        return (found, source) if found.is_imu_consistent_with_poses else None
    return None


def _fit_with_usual_delay_if_undetermined(
    log: Log,
    delay: str | float,
    motion: Callable[[float | None], _PoseMotionT],
    usual_s: float,
    usual: str,
) -> tuple[_PoseMotionT, str]:
    known, source = (None, "estimated") if delay == "auto" else choose_delay(log, None, delay)
    found = motion(known)
    if known is None and not found.delay_std_s < _MAX_KNOWN_DELAY_STD_S:
        return motion(usual_s), usual
    return found, source


def use_spline_motion(log: Log, found: PoseMotion) -> tuple[Log, NDArray[np.bool_]]:
    """Return the log with motion from splines of poses, and (N,) True near ends and gaps."""
    assert log.posed is not None
    moved, splines = remove_delay(log, found.delay_s), found.splines
    t, gravity_W = moved.t + found.delay_s, log.posed.gravity_W
    s, omega, alpha = splines.motion(t, gravity_W)
    moved = replace(
        moved,
        specific_force=s,
        angular_velocity=omega,
        angular_acceleration=alpha,
        gravity=splines.gravity(t, gravity_W),
    )
    stamps, margin = splines.poses.t, _EDGE_MARGIN_OVER_KNOT_SPACING * splines.spacing
    gaps = np.flatnonzero(np.diff(stamps) > splines.spacing)
    ends = stamps[np.concatenate([[0], gaps, gaps + 1, [len(stamps) - 1]])]
    change = np.zeros(len(t) + 1)
    np.add.at(change, np.searchsorted(t, ends - margin), 1.0)
    np.add.at(change, np.searchsorted(t, ends + margin), -1.0)
    return moved, np.cumsum(change[:-1]) > 0.0


def clock_rate_notes(found: PoseMotion) -> list[str]:
    """Return a note if the clock rate of the poses differs from that of the wrench."""
    if not found.clock_rate_error:
        return []
    side = "faster" if found.clock_rate_error > 0.0 else "slower"
    return [
        f"the clock of the pose runs {1e6 * abs(found.clock_rate_error):.0f} millionths {side} than"
        " that of the wrench, which is corrected; to state it, multiply pose.time.scale (1 by"
        f" default) by {1.0 / (1.0 + found.clock_rate_error):.6f}"
    ]


@dataclass(frozen=True)
class AlignedLog:
    """Log with motion and wrench at the same instants.

    Attributes:
        log: with acceleration instead of specific force if the robot had removed the weight.
        delay_s: removed delay of the motion behind the wrench [s].
        delay_source: "estimated", "given", "load" (identification file) or "static".
        log_with_differentiated_motion: log with motion by numerical differentiation, if required.
        edge: (N,) True for samples near ends and gaps, whose motion is less accurate.
        clock_notes: note on the clock rate of the poses, if it is corrected.
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
    usual_s: float,
    cutoff_hz: float | None,
    delay: str | float,
    differentiate: bool,
    weight_removed: bool = False,
) -> AlignedLog:
    """Read a log and remove the delay between motion and wrench.

    The motion is from splines of the poses, or from an IMU if the load phi (10,) then fits better.
    `delay` [s] or "auto" is removed; `usual_s` [s] is used if the record does not determine it.
    """
    log = read_log(path, bandwidth_hz=cutoff_hz, differentiate=differentiate)
    weight_removed = weight_removed or "weight" in log.estimated
    smooth = None
    coefficients = load_coefficients(phi, phi[:4] if weight_removed else None)
    with one_blas_thread():
        found = fit_motion_to_known_load(log, delay, coefficients, usual_s)
    if found is not None:
        motion, source = found
        moved, one_sided = use_spline_motion(log, motion)
        plain = remove_delay(log, motion.delay_s) if differentiate else None
        if weight_removed:
            moved = replace_specific_force_by_acceleration(moved)
            plain = None if plain is None else replace_specific_force_by_acceleration(plain)
        edge = one_sided | is_near_ends(moved, 0.0, cutoff_hz)
        notes = tuple(clock_rate_notes(motion))
        smooth = AlignedLog(moved, motion.delay_s, source, plain, edge, notes)
        if log.posed is None or log.posed.imu is None:
            return smooth
    elif log.posed is not None and not differentiate:
        log = read_log(path, bandwidth_hz=cutoff_hz)
    log = replace_specific_force_by_acceleration(log) if weight_removed else log
    delay_s, source = choose_delay(log, cutoff_hz, delay, phi)
    if source == "undetermined":
        delay_s, source = usual_s, "load"
    log = remove_delay(log, delay_s)
    other = AlignedLog(log, delay_s, source, log, is_near_ends(log, log.one_sided_s, cutoff_hz))
    if smooth is None or _log_residual_spread(other, phi, cutoff_hz) < _log_residual_spread(
        smooth, phi, cutoff_hz
    ):
        return other
    return smooth


def missing_orientation_error(where: str) -> DrakeTeleopError:
    return DrakeTeleopError(
        "the robot has removed the weight of the load from the wrench, and without an orientation"
        " gravity cannot be subtracted from the measured acceleration",
        where=where,
        remedy="add poses, or use the wrench without payload compensation",
    )


def replace_specific_force_by_acceleration(log: Log) -> Log:
    """Return the log with acceleration in place of specific force, by adding gravity."""
    if log.gravity is None:
        raise missing_orientation_error(log.source)
    return replace(log, specific_force=log.specific_force + log.gravity)


def _log_residual_spread(aligned: AlignedLog, phi: Array, cutoff_hz: float | None) -> float:
    log = aligned.log
    left = low_pass(contact_wrench(log.wrench, np.zeros(6), *log.motion, phi), log.dt, cutoff_hz)
    return float(np.log(narrowest_half_interval(left[~aligned.edge])[0] + 1e-12).sum())
