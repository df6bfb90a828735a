"""Log whose delay is removed, with the motion that best explains the wrench of a known load."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array, one_blas_thread
from drake_teleop.load.compensation import contact_wrench
from drake_teleop.logs.pose_motion.rigid import load_coefficients
from drake_teleop.logs.read.alignment import ends, low_pass, undelayed
from drake_teleop.logs.read.canonical import Log
from drake_teleop.logs.read.delay import delay_of
from drake_teleop.logs.read.reading import read_log
from drake_teleop.logs.spline_motion import clock_note, motion_of_known_load, use_spline_motion


@dataclass(frozen=True)
class AlignedLog:
    """Log with motion and wrench at the same instants.

    Attributes:
        log: with acceleration instead of specific force if the robot had removed the weight.
        delay_s: removed delay of the motion behind the wrench [s].
        source: of the delay: "estimated", "given", "load" (identification file) or "static".
        differentiated: log with motion by numerical differentiation, if required.
        edge: (N,) True for samples near ends and gaps, whose motion is less accurate.
    """

    log: Log
    delay_s: float
    source: str
    differentiated: Log | None
    edge: NDArray[np.bool_]


def aligned_log(
    path: str | Path,
    phi: Array,
    usual_s: float,
    cutoff_hz: float | None,
    delay: str | float,
    differentiate: bool,
    weight_removed: bool = False,
) -> AlignedLog:
    """Read a log and remove the delay between motion and wrench.

    The motion is from splines of the poses, or from an IMU if the load then fits better.

    Args:
        path, cutoff_hz, delay: as in `eliminate_log`.
        phi: (10,) identified load.
        usual_s: delay for a record that does not determine it [s].
        weight_removed: True if the wrench does not contain the weight of the load.

    Raises:
        DrakeTeleopError: if the weight is removed and the log has no orientation.
    """
    log = read_log(path, bandwidth_hz=cutoff_hz, differentiate=differentiate)
    weight_removed = weight_removed or "weight" in log.free
    smooth = None
    coefficients = load_coefficients(phi, phi[:4] if weight_removed else None)
    with one_blas_thread():
        found = motion_of_known_load(log, delay, coefficients, usual_s)
    if found is not None:
        motion, source = found
        moved, one_sided = use_spline_motion(log, motion)
        moved = replace(moved, notes=(*moved.notes, *clock_note(motion)))
        plain = undelayed(log, motion.delay_s) if differentiate else None
        if weight_removed:
            moved = accelerated(moved)
            plain = None if plain is None else accelerated(plain)
        edge = one_sided | ends(moved, 0.0, cutoff_hz)
        smooth = AlignedLog(moved, motion.delay_s, source, plain, edge)
        if log.posed is None or log.posed.imu is None:
            return smooth
    elif log.posed is not None and not differentiate:
        log = read_log(path, bandwidth_hz=cutoff_hz)
    log = accelerated(log) if weight_removed else log
    delay_s, source = delay_of(log, cutoff_hz, delay, phi)
    if source == "undetermined":
        delay_s, source = usual_s, "load"
    log = undelayed(log, delay_s)
    other = AlignedLog(log, delay_s, source, log, ends(log, log.one_sided_s, cutoff_hz))
    if smooth is None or _spread(other, phi, cutoff_hz) < _spread(smooth, phi, cutoff_hz):
        return other
    return smooth


def without_orientation(where: str) -> DrakeTeleopError:
    """Return the error for a log with removed weight and without orientation."""
    return DrakeTeleopError(
        "the robot has removed the weight of the load from the wrench, and without an orientation"
        " gravity cannot be subtracted from the measured acceleration",
        where=where,
        remedy="add poses, or use the wrench without payload compensation",
    )


def accelerated(log: Log) -> Log:
    """Return the log with the acceleration in place of the specific force.

    Raises:
        DrakeTeleopError: if the log has no orientation.
    """
    if log.gravity is None:
        raise without_orientation(log.source)
    return replace(log, specific_force=log.specific_force + log.gravity)


def _spread(aligned: AlignedLog, phi: Array, cutoff_hz: float | None) -> float:
    log = aligned.log
    left = low_pass(contact_wrench(log.wrench, np.zeros(6), *log.motion, phi), log.dt, cutoff_hz)
    left = np.sort(left[~aligned.edge], axis=0)
    half = len(left) // 2
    return float(np.log((left[half:] - left[: len(left) - half]).min(axis=0) + 1e-12).sum())
