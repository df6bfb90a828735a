"""Frame of the poses, checked with the wrench."""

from __future__ import annotations

from itertools import permutations
from typing import TYPE_CHECKING

import numpy as np

from drake_teleop.logs.check.against_position import position_unit
from drake_teleop.logs.check.finding import Finding
from drake_teleop.logs.check.wrench_alone import TORQUES, mirrored_finding, other_units
from drake_teleop.logs.pose_motion.poses import Posed
from drake_teleop.logs.read.canonical import Log
from drake_teleop.logs.read.description import UNITS, Pose, Wrench

if TYPE_CHECKING:
    from drake_teleop.logs.pose_motion.estimate import PoseEstimate
    from drake_teleop.logs.pose_motion.read_off import ReadOff

SHORTEST = 4.0
"""Shorter records have too few frequencies [s]."""
# Limit for the unit of the positions; plausible distances of a centre of mass [m].
_UNIT, _NEAREST, _FARTHEST = 0.1, 2e-4, 1.5
_TORQUE_UNITS = tuple(UNITS[unit] / UNITS[other] for unit, other in permutations(TORQUES, 2))
_SAME = 0.03
_OBLIQUE = 10.0


def usable(log: Log) -> bool:
    """Return whether the poses of a log suffice for its motion."""
    return log.posed is not None and not log.static and float(log.t[-1] - log.t[0]) >= SHORTEST


def against_frame(wrench: Wrench, pose: Pose, log: Log, delay: float) -> list[Finding]:
    """Return findings for mirrored axes, other units of the wrench, or another frame of the poses."""
    from drake_teleop.logs.pose_motion.estimate import estimate_from_poses

    if log.posed is None or not usable(log):
        return []
    posed = log.posed
    found = estimate_from_poses(
        log.t, log.wrench, posed.poses, posed.gravity_W, near=delay, lost=log.bridged
    )
    seen = found.seen
    finding = _of_position(pose, seen) or _of_wrench(wrench, seen) or frame_finding(found, posed)
    return [] if finding is None else [finding]


def _of_position(pose: Pose, seen: ReadOff) -> Finding | None:
    if pose.position is None or not seen.usable or seen.mirrored:
        return None
    return position_unit(pose.position.unit, seen.kappa, seen.kappa_deviation)


def _of_wrench(wrench: Wrench, seen: ReadOff) -> Finding | None:
    if not seen.usable or abs(seen.kappa - 1.0) > _UNIT:
        return None
    if seen.mirrored:
        sign = float(np.trace(seen.R_SP)) < -2.5
        return (
            None
            if sign or seen.oblique_deg > _OBLIQUE
            else mirrored_finding(wrench, seen.permutation)
        )
    mass = float(seen.masses.mean())
    both = seen.turning_force, seen.gravity_torque
    found = other_units(wrench, mass, both, seen.moment_deviations)
    return None if found is None else found[0]


def frame_finding(found: PoseEstimate, posed: Posed) -> Finding | None:
    """Return the finding for a displaced or rotated pose frame, unless another error is likely."""
    frame, seen, phi = found.frame, found.seen, found.free.state.theta[6:]
    if not (frame.shifted or frame.turned) or phi[0] <= 0.0:
        return None
    unit = abs(seen.kappa - 1.0) > max(_UNIT, 5.0 * seen.kappa_deviation)
    if unit or (seen.usable and seen.mirrored) or _torque_unit(phi[1:4] / phi[0], frame.p_SoPo_S):
        return None
    place = frame.p_SoPo_S + frame.R_SP @ posed.p_SoPo_S
    said, lines = [], []
    if frame.shifted:
        shift = ", ".join(f"{1e3 * x:.1f}" for x in frame.p_SoPo_S)
        sure = 1e3 * float(frame.position_deviations.max())
        said.append(f"its origin is [{shift}] mm from that of S in the axes of S (+- {sure:.2g})")
        lines.append(f"pose.position_in_sensor: {_written(place)}")
    if frame.turned:
        angle = np.degrees(np.arccos(np.clip(0.5 * (np.trace(frame.R_SP) - 1.0), -1.0, 1.0)))
        sure = float(frame.turn_deviations_deg.max())
        said.append(f"its axes are turned by {angle:.1f} deg (+- {sure:.2g})")
        lines.append(f"pose.rotation_in_sensor: {_written(frame.R_SP @ posed.R_SP)}")
    return Finding(
        "pose frame", f"the pose is not that of S: {', and '.join(said)}; set {' and '.join(lines)}"
    )


def _torque_unit(com: np.ndarray, shift: np.ndarray) -> bool:
    size = float(np.linalg.norm(com))
    off = [np.linalg.norm(com - unit * (com - shift)) for unit in _TORQUE_UNITS]
    return not _NEAREST < size < _FARTHEST or bool(min(off) < _SAME * size)


def _written(x: np.ndarray) -> list:
    return list((np.round(x, 4) + 0.0).tolist())
