"""Unit and frame of the poses, checked with the accelerometer or with the wrench."""

from __future__ import annotations

from itertools import permutations
from typing import TYPE_CHECKING

import numpy as np

from drake_teleop.common.numeric import Array
from drake_teleop.logs.causes.cause import Finding
from drake_teleop.logs.check.log_data import LogData
from drake_teleop.logs.pose_motion.poses import PosesOfLog
from drake_teleop.logs.read.alignment import low_pass, resample
from drake_teleop.logs.read.auto_frames import round_for_yaml
from drake_teleop.logs.read.canonical import Log
from drake_teleop.logs.read.description import Description
from drake_teleop.logs.read.description_fields import POSITION_UNITS, SI_VALUE_OF_UNIT
from drake_teleop.logs.read.mounting import lever_matrix, rotation_angle_deg

if TYPE_CHECKING:
    from drake_teleop.logs.pose_motion.estimate import PoseEstimate

_ACCELERATION_CUTOFF_HZ, _MAX_SHIFT_FIT_CONDITION_NUMBER = 3.0, 1e8
_MIN_REPORTED_POSE_SHIFT_M, _MAX_POSE_SHIFT_DEVIATION_M = 0.02, 0.01  # m
_MIN_ERROR_OVER_DEVIATION = 5.0  # standard deviations
_UNIT_MATCH_RANGE, _MAX_SCALE_ERROR_FOR_SHIFT = (0.7, 1.43), 0.15
_MIN_UNIT_ERROR_FACTOR = 50.0
MIN_POSES_DURATION_S = 4.0  # shorter records have too few frequencies
_MAX_POSITION_SCALE_ERROR_FOR_FRAME, _MIN_COM_TO_SO_M, _MAX_COM_TO_SO_M = 0.1, 2e-4, 1.5  # 1, m, m
_TORQUE_UNIT_VALUES = [SI_VALUE_OF_UNIT[unit] for unit in ("N m", "N mm", "lbf in")]
_WRONG_TORQUE_UNIT_RATIOS = (
    *(a / b for a, b in permutations(_TORQUE_UNIT_VALUES, 2)),
    *(SI_VALUE_OF_UNIT["lbf"], 1.0 / SI_VALUE_OF_UNIT["lbf"]),
)
"""Ratios of torque and force in wrong units, which resemble a displaced pose frame."""
_COM_TOLERANCE_OF_WRONG_TORQUE_UNIT = 0.03


def position_unit_or_origin_findings(
    description: Description, data: LogData, lag: float
) -> list[Finding]:
    """Return findings for positions in a wrong unit, or of a point other than So.

    They are compared with the accelerometer, whose clock lags the pose's by `lag` [s].
    """
    imu, pose = description.imu, description.pose
    if imu is None or pose is None or imu.specific_force is None or pose.position is None:
        return []
    if imu.is_mounting_auto or pose.is_frame_auto:
        return []
    sensed = data.read_thinned_log(description)
    posed = data.read_thinned_log(description.model_copy(update={"imu": None}))
    if sensed.gravity is None or posed.gravity is None:
        return []
    # Both logs begin with the wrench, so that their times are on one clock.
    t = sensed.t[(sensed.t + lag <= sensed.t[-1]) & (sensed.t + lag >= sensed.t[0])]
    t = t[(t >= posed.t[0]) & (t <= posed.t[-1])]
    g = resample(t, posed.t, posed.gravity)
    by_pose = resample(t, posed.t, posed.specific_force) + g
    s, omega, alpha = (resample(t + lag, sensed.t, x) for x in sensed.motion)
    columns = np.concatenate([(s + g)[:, :, None], lever_matrix(omega, alpha)], axis=2)
    columns, by_pose = (low_pass(x, sensed.dt, _ACCELERATION_CUTOFF_HZ) for x in (columns, by_pose))
    inner = slice(len(t) // 50, len(t) - len(t) // 50)
    independent = 2.0 * _ACCELERATION_CUTOFF_HZ * float(t[-1] - t[0])
    fit = _fit_centred_signals(columns[inner], by_pose[inner], independent)
    if fit is None or abs(fit[0][0]) <= _MIN_ERROR_OVER_DEVIATION * fit[1][0]:
        return []
    x, deviations = fit
    k = float(x[0])
    unit = _position_unit_finding(pose.position.unit, 1.0 / k, float(deviations[0]) / k**2)
    if unit is not None:
        return [unit]
    shift, deviation = x[1:] / k, float(np.linalg.norm(deviations[1:]))
    size = float(np.linalg.norm(shift))
    if abs(k - 1.0) > _MAX_SCALE_ERROR_FOR_SHIFT or deviation > _MAX_POSE_SHIFT_DEVIATION_M:
        return []
    if size < max(_MIN_REPORTED_POSE_SHIFT_M, _MIN_ERROR_OVER_DEVIATION * deviation):
        return []
    place, other = shift + np.array(pose.position_in_sensor), np.array(imu.position) - shift
    text = (
        f"the described positions of the pose's origin and the accelerometer disagree by"
        f" {1e3 * size:.0f} mm (+- {1e3 * deviation:.2g}); if imu.position is right, set"
        f" pose.position_in_sensor: {round_for_yaml(place)}, otherwise set imu.position:"
        f" {round_for_yaml(other)}"
    )
    return [Finding("pose frame", text)]


def _position_unit_finding(now: str, kappa: float, deviation: float) -> Finding | None:
    if not abs(kappa) > _MIN_ERROR_OVER_DEVIATION * deviation:
        return None
    text = f"the acceleration of the positions is {1.0 / kappa:.3g} times the measured one:"
    for unit in POSITION_UNITS:
        ratio = SI_VALUE_OF_UNIT[unit] / SI_VALUE_OF_UNIT[now]
        if unit != now and _UNIT_MATCH_RANGE[0] < kappa / ratio < _UNIT_MATCH_RANGE[1]:
            return Finding("units", f"{text} they are not in {now}; set pose.position.unit: {unit}")
    if 1.0 / _MIN_UNIT_ERROR_FACTOR < abs(kappa) < _MIN_UNIT_ERROR_FACTOR:  # noise or another error
        return None
    remedy = f"multiply pose.position.scale (1 by default) by {kappa:.4g}"
    return Finding("units", f"{text} their unit is not known; {remedy}")


def _fit_centred_signals(
    columns: Array, target: Array, independent: float
) -> tuple[Array, Array] | None:
    if len(columns) == 0:
        return None
    columns, target = columns - columns.mean(axis=0), target - target.mean(axis=0)
    A, b = columns.reshape(-1, columns.shape[2]), target.ravel()
    size = np.linalg.norm(A, axis=0)
    if (size == 0.0).any():
        return None
    gram = (A / size).T @ (A / size)
    if np.linalg.cond(gram) > _MAX_SHIFT_FIT_CONDITION_NUMBER:
        return None
    inverse = np.linalg.inv(gram)
    x = inverse @ ((A / size).T @ b)
    variance = float(np.sum((b - (A / size) @ x) ** 2)) / (target.shape[1] * max(1.0, independent))
    return x / size, np.sqrt(variance * np.diag(inverse)) / size


def has_usable_poses(log: Log) -> bool:
    """Return whether a log of motion has poses over at least 4 s, as splines require."""
    duration_s = float(log.t[-1] - log.t[0])
    return log.posed is not None and not log.static and duration_s >= MIN_POSES_DURATION_S


def pose_unit_or_frame_finding(found: PoseEstimate, log: Log) -> Finding | None:
    """Return a finding for positions in a wrong unit, or for a pose frame that is not S."""
    assert log.posed is not None
    pose = None if log.described is None else log.described.pose
    seen = found.units_and_axes
    if pose is not None and pose.position is not None and seen.is_usable and not seen.is_mirrored:
        ratio, std = seen.position_unit_ratio, seen.position_unit_ratio_std
        unit = _position_unit_finding(pose.position.unit, ratio, std)
        if unit is not None:
            return unit
    return pose_frame_finding(found, log.posed)


def pose_frame_finding(found: PoseEstimate, posed: PosesOfLog) -> Finding | None:
    """Return a finding for a displaced or rotated pose frame, unless another error is likely."""
    frame, seen, phi = found.frame, found.units_and_axes, found.free_frame_fit.parameters.theta[6:]
    if not (frame.is_shifted or frame.is_rotated) or phi[0] <= 0.0:
        return None
    limit = max(_MAX_POSITION_SCALE_ERROR_FOR_FRAME, 5.0 * seen.position_unit_ratio_std)
    if abs(seen.position_unit_ratio - 1.0) > limit or (seen.is_usable and seen.is_mirrored):
        return None
    if _may_torque_unit_be_wrong(phi[1:4] / phi[0], frame.p_SoPo_S):
        return None
    place = frame.p_SoPo_S + frame.R_SP @ posed.p_SoPo_S
    texts, lines = [], []
    if frame.is_shifted:
        shift = ", ".join(f"{1e3 * x:.1f}" for x in frame.p_SoPo_S)
        deviation = 1e3 * float(frame.position_stds_m.max())
        texts.append(f"the pose's origin is at [{shift}] mm (+- {deviation:.2g}) in S")
        lines.append(f"pose.position_in_sensor: {round_for_yaml(place)}")
    if frame.is_rotated:
        angle, deviation = rotation_angle_deg(frame.R_SP), float(frame.rotation_stds_deg.max())
        texts.append(
            f"the pose's axes are rotated by {angle:.1f} deg (+- {deviation:.2g}) relative to S"
        )
        lines.append(f"pose.rotation_in_sensor: {round_for_yaml(frame.R_SP @ posed.R_SP)}")
    text = f"the pose is not that of S: {' and '.join(texts)}; set {' and '.join(lines)}"
    return Finding("pose frame", text)


def _may_torque_unit_be_wrong(com: Array, shift: Array) -> bool:
    size = float(np.linalg.norm(com))
    off = min(np.linalg.norm(com - ratio * (com - shift)) for ratio in _WRONG_TORQUE_UNIT_RATIOS)
    is_usual = _MIN_COM_TO_SO_M < size < _MAX_COM_TO_SO_M
    return not is_usual or bool(off < _COM_TOLERANCE_OF_WRONG_TORQUE_UNIT * size)
