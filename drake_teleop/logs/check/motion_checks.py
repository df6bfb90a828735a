"""Checks of the described motion: IMU signals, IMU against pose, unit and frame of poses."""

from __future__ import annotations

from functools import partial
from itertools import permutations
from typing import Any

import numpy as np

from drake_teleop.common.numeric import Array
from drake_teleop.common.rotations import axis_names_of_rows, rotation_matrices, signed_permutations
from drake_teleop.logs.causes.cause import Finding
from drake_teleop.logs.check.against_load import (
    MAX_GOOD_RESIDUAL_SHARE,
    MAX_VALID_RESIDUAL_SHARE,
    MIN_MISFIT_REDUCTION_FACTOR,
)
from drake_teleop.logs.check.edits import (
    MIN_LAG_OF_WRONG_CLOCK_S,
    Edit,
    LogTables,
    call_or_none_if_unreadable,
    edit_field,
    make_edit,
    orientation_and_gravity_sign_edits,
)
from drake_teleop.logs.pose_motion.estimate import PoseEstimate
from drake_teleop.logs.pose_motion.poses import PosesOfLog
from drake_teleop.logs.read.alignment import low_pass, resample, smooth_derivatives
from drake_teleop.logs.read.auto_frames import round_for_yaml
from drake_teleop.logs.read.canonical import Log
from drake_teleop.logs.read.description import Description, Imu
from drake_teleop.logs.read.description_fields import POSITION_UNITS, SI_VALUE_OF_UNIT
from drake_teleop.logs.read.mounting import (
    Mounting,
    find_mounting,
    lever_matrix,
    rotation_angle_deg,
)

GYRO_TO_POSE_SPEED_RANGE_OF_DEG_S = (40.0, 80.0)
"""Range of a speed ratio of 180 / pi, degrees over radians, with noise and gain errors."""
MIN_REPORTED_RELATIVE_GRAVITY_ERROR = 0.02  # calibrated sensors are within 1 %
_MIN_GRAVITY_ERROR_OVER_DEVIATION, _ALPHA_COMPARISON_CUTOFF_HZ = 5.0, 5.0
_MIN_ALPHA_CORRELATION, _MAX_UNSWAPPED_OVER_BEST_CORRELATION = 0.8, 0.5
_GRAVITY_WINDOW_RANGE_S, _MIN_GRAVITY_WINDOWS, _MAX_GRAVITY_WINDOWS = (2.0, 8.0), 6, 60
_GYRO_UNITS = "rad/s", "deg/s", "mdeg/s"
_GYRO_AXES_RATE_HZ, _MIN_WRONG_AXES_MISFIT, _MIN_AXES_MISFIT_REDUCTION = 25.0, 0.05, 3.0


def check_imu_signals(description: Description, log: Log) -> tuple[list[Finding], Description]:
    """Return up to one finding on contradictory IMU signals, and the corrected description."""
    imu = description.imu
    if imu is None or imu.angular_velocity is None or log.static or imu.is_mounting_auto:
        return [], description
    edit, finding = _angle_unit_edit(description, imu, log), None
    if edit is None and imu.specific_force is not None and imu.frame != "base":
        edit = _gyro_axes_edit(description, imu, log)
        if edit is None and (finding := _angular_acceleration_axes_finding(imu, log)) is None:
            finding = _gravity_magnitude_finding(imu, log, description.gravity_W)
    finding, description = edit or (finding, description)
    return ([finding] if finding else []), description


def _angle_unit_edit(description: Description, imu: Imu, log: Log) -> Edit | None:
    if imu.angular_acceleration is None:
        return None
    given_alpha, derived_alpha = _given_and_derived_alpha(log)
    sizes = float(np.linalg.norm(given_alpha)), float(np.linalg.norm(derived_alpha))
    correlation = float(np.sum(given_alpha * derived_alpha))
    if min(sizes) == 0.0 or correlation < _MIN_ALPHA_CORRELATION * sizes[0] * sizes[1]:
        return None
    ratio, (least, most) = sizes[0] / sizes[1], GYRO_TO_POSE_SPEED_RANGE_OF_DEG_S
    for wrong, quantity, unit, other in (
        (ratio, "angular_acceleration", "rad/s^2", "deg/s^2"),
        (1.0 / ratio, "angular_acceleration", "deg/s^2", "rad/s^2"),
        (1.0 / ratio, "angular_velocity", "rad/s", "deg/s"),
    ):
        if least < wrong < most and getattr(imu, quantity).unit == unit:
            text = f"the angular acceleration is {ratio:.3g} times the derivative of the angular"
            fields = {f"imu.{quantity}.unit": other}
            return make_edit(description, "degrees", f"{text} velocity", fields)
    return None


def _given_and_derived_alpha(log: Log) -> tuple[Array, Array]:
    rate = smooth_derivatives(log.angular_velocity, log.dt, 30.0)[1]
    given = low_pass(log.angular_acceleration, log.dt, _ALPHA_COMPARISON_CUTOFF_HZ)
    return given, low_pass(rate, log.dt, _ALPHA_COMPARISON_CUTOFF_HZ)


def _gyro_axes_edit(description: Description, imu: Imu, log: Log) -> Edit | None:
    assert imu.angular_velocity is not None
    few = log.select_rows(slice(None, None, max(1, round(1.0 / (_GYRO_AXES_RATE_HZ * log.dt)))))
    misfit = partial(_relative_gravity_misfit, few, float(np.linalg.norm(description.gravity_W)))
    given, unit = misfit(np.eye(3)), imu.angular_velocity.unit
    if not given > _MIN_WRONG_AXES_MISFIT:
        return None
    scales = {x: SI_VALUE_OF_UNIT[x] / SI_VALUE_OF_UNIT[unit] * np.eye(3) for x in _GYRO_UNITS}
    least, best_unit = min((misfit(P), x) for x, P in scales.items())
    # At rest a bias of the gyroscope is the only rotation, which another unit can remove.
    limit = min(given, misfit(np.zeros((3, 3)))) / _MIN_AXES_MISFIT_REDUCTION
    if least < limit:
        text = f"the rotation of gravity in S shows that the gyroscope is not in {unit}"
        return make_edit(description, "degrees", text, {"imu.angular_velocity.unit": best_unit})
    best, P = min(((misfit(P), P) for P in signed_permutations()), key=lambda entry: entry[0])
    if best > limit:
        return None
    text = "the axes of the gyroscope are not those of the accelerometer"
    names = imu.angular_velocity.columns
    if (P < 0).any() or len(names) != 3 or imu.frame != "sensor":
        text += f": the correct x, y, z are the present {', '.join(axis_names_of_rows(P))}"
        remedy = "reorder imu.angular_velocity.columns, and set signs by imu.angular_velocity.scale"
        return Finding("swapped axes", f"{text}; {remedy}"), description
    ordered = tuple(names[k] for k in np.abs(P).argmax(axis=1))
    finding = Finding("swapped axes", f"{text}; set imu.angular_velocity.columns: {list(ordered)}")
    return finding, edit_field(description, "imu.angular_velocity.columns", ordered)


def _angular_acceleration_axes_finding(imu: Imu, log: Log) -> Finding | None:
    if imu.angular_acceleration is None:
        return None
    given_alpha, derived_alpha = _given_and_derived_alpha(log)
    size = float(np.linalg.norm(given_alpha) * np.linalg.norm(derived_alpha)) + 1e-300
    alike = given_alpha.T @ derived_alpha / size
    best = max(signed_permutations(), key=lambda P: float(np.sum(alike * P)))
    largest = np.sum(alike * best)
    limit = _MAX_UNSWAPPED_OVER_BEST_CORRELATION * largest
    if largest < _MIN_ALPHA_CORRELATION or np.trace(alike) > limit:
        return None
    text = "the axes of the angular acceleration are not those of the gyroscope: its x, y, z are"
    text += f" the gyroscope's {', '.join(axis_names_of_rows(best))}"
    remedy = "reorder imu.angular_acceleration.columns, or remove imu.angular_acceleration"
    return Finding("swapped axes", f"{text}; {remedy}")


def _mean_specific_forces_in_start_axes(log: Log, gyro_axes: Array) -> Array:
    """Return mean specific forces (2, n, 3) in n Hann windows, then in windows half a length later.

    Integrated angular velocity, its axes permuted by `gyro_axes`, rotates them to the axes at the
    start of the window.
    """
    length = float(np.clip((log.t[-1] - log.t[0]) / 4.0, *_GRAVITY_WINDOW_RANGE_S))
    half = max(1, int(0.5 * length / log.dt))
    count = max(0, len(log) // half - 2)
    starts = np.linspace(0, len(log) - 3 * half, min(count, _MAX_GRAVITY_WINDOWS)).astype(int)
    take = starts[:, None] + np.arange(3 * half)
    omega, s = log.angular_velocity[take] @ gyro_axes.T, log.specific_force[take]
    steps = rotation_matrices((omega * log.dt).reshape(-1, 3), "rotation_vector")
    steps = steps.reshape(*omega.shape, 3)
    weight = np.zeros((2, 3 * half))
    weight[0, : 2 * half] = weight[1, half:] = np.hanning(2 * half + 2)[1:-1]
    weight /= weight[0].sum()
    R, means = np.broadcast_to(np.eye(3), (len(starts), 3, 3)), np.zeros((2, len(starts), 3))
    for k in range(3 * half):
        means += weight[:, k, None, None] * np.einsum("nij,nj->ni", R, s[:, k])
        R = R @ steps[:, k]
    return means


def _relative_gravity_misfit(log: Log, gravity: float, gyro_axes: Array) -> float:
    means = _mean_specific_forces_in_start_axes(log, gyro_axes) / gravity
    if means.shape[1] == 0:
        return np.nan
    off = np.linalg.norm(means, axis=2) - 1.0
    return float(np.sqrt(np.mean(off**2) + np.mean(np.sum((means[1] - means[0]) ** 2, axis=1))))


def _gravity_magnitude_finding(imu: Imu, log: Log, gravity_W: Array) -> Finding | None:
    gravity = float(np.linalg.norm(gravity_W))
    forces = _mean_specific_forces_in_start_axes(log, np.eye(3))[0]
    if len(forces) < _MIN_GRAVITY_WINDOWS:
        return None
    ratios = np.linalg.norm(forces, axis=1) / gravity
    ratio, deviation = np.mean(ratios), np.std(ratios, ddof=1) / np.sqrt(len(ratios))
    off = abs(ratio - 1.0)
    if not 0.7 < ratio < 1.4 or off < max(
        MIN_REPORTED_RELATIVE_GRAVITY_ERROR + 3.0 * deviation,
        _MIN_GRAVITY_ERROR_OVER_DEVIATION * deviation,
    ):
        return None
    assert imu.specific_force is not None
    measured_gravity = ratio * gravity
    remedy = f"divide the columns of imu.specific_force by {ratio:.4f}, or calibrate them"
    if imu.specific_force.unit not in ("g", "mg") and abs(measured_gravity / 9.80665 - 1.0) < 0.01:
        vector = [float(f"{ratio * x:.4g}") for x in gravity_W]
        remedy = f"set gravity: {vector if vector[:2] != [0, 0] or vector[2] > 0 else -vector[2]}"
    return Finding(
        "gravity",
        f"the accelerometer reads {measured_gravity:.4g} m/s^2 of gravity in the mean,"
        f" {100 * off:.2g} % (+- {100 * deviation:.1g})"
        f" {'more' if ratio > 1 else 'less'} than described: the mass would be wrong by as much;"
        f" {remedy}",
    )


def check_imu_against_pose(
    description: Description, data: LogTables
) -> tuple[list[Finding], Mounting | None, Description]:
    """Return findings on IMU against pose, the IMU's mounting, and the corrected description."""

    def fit_mounting(edited: Description) -> Mounting | None:
        pose_alone = edited.model_copy(update={"imu": None})
        return find_mounting(data.read_thinned_log(edited), data.read_thinned_log(pose_alone))

    given = fit_mounting(description)
    if given is None:
        return [], None, description
    findings: list[Finding] = []
    is_rotated = given.rotation_angle_deg > 10
    if given.unexplained > MAX_GOOD_RESIDUAL_SHARE or given.is_mirrored or is_rotated:
        better = [
            (found, finding, edited)
            for finding, edited in orientation_and_gravity_sign_edits(description)
            if (found := call_or_none_if_unreadable(fit_mounting, edited)) and not found.is_mirrored
        ]
        limit = min(MAX_VALID_RESIDUAL_SHARE, given.unexplained / MIN_MISFIT_REDUCTION_FACTOR)
        if given.is_mirrored:
            better = [entry for entry in better if entry[0].rotation_angle_deg < 10]
        elif is_rotated and given.unexplained < MAX_VALID_RESIDUAL_SHARE:
            # In a rotation about one axis an inverted orientation resembles a rotated IMU. An edit
            # that keeps the described mounting is the simpler explanation.
            better = [entry for entry in better if entry[0].rotation_angle_deg < 10]
            limit = min(MAX_VALID_RESIDUAL_SHARE, 1.5 * given.unexplained + 1e-4)
        best = min(better, key=lambda entry: entry[0].unexplained, default=None)
        if best and best[0].unexplained < limit:
            given, finding, description = best
            findings.append(finding)
    if given.unexplained > MAX_VALID_RESIDUAL_SHARE and not given.is_mirrored:
        return findings, given, description
    if abs(given.lag_s) > MIN_LAG_OF_WRONG_CLOCK_S or given.clock_drift:
        finding, description = _correct_imu_clock(description, given, data)
        findings.append(finding)
    gyro: Any = getattr(description.imu, "angular_velocity", None)
    ratio = given.speed_ratio or 0.0
    for unit in _GYRO_UNITS if gyro else ():
        least, most = np.array(_UNIT_MATCH_RANGE) * SI_VALUE_OF_UNIT[gyro.unit]
        if unit != gyro.unit and least < ratio * SI_VALUE_OF_UNIT[unit] < most:
            text = f"the gyroscope reads {ratio:.3g} times the speed of the pose"
            fields = {"imu.angular_velocity.unit": unit}
            finding, description = make_edit(description, "degrees", text, fields)
            findings.append(finding)
    if given.is_mirrored:
        text = (
            "the axes of the IMU are those of the pose mirrored: two columns are exchanged or one"
            " has the wrong sign; correct imu.specific_force.columns or imu.specific_force.scale"
        )
        findings.append(Finding("swapped axes", text))
    elif given.rotation_angle_deg > 10:
        assert description.imu is not None
        old = description.imu.frame
        R = given.nearest_right_angled_rotation if given.is_right_angled else given.R_SI
        frame = R @ (np.array(old) if isinstance(old, tuple) else np.eye(3))
        shown = np.round(frame, 4).tolist()
        kind = "swapped axes" if given.is_right_angled else "mounting"
        text = f"the IMU is rotated by {given.rotation_angle_deg:.0f} deg relative to S;"
        oblique = "" if given.is_right_angled else " (not a right-angled mounting)"
        findings.append(Finding(kind, f"{text} set imu.frame: {shown}{oblique}"))
        description = edit_field(description, "imu.frame", tuple(map(tuple, frame.tolist())))
    return findings, given, description


def _correct_imu_clock(description: Description, found: Mounting, data: LogTables) -> Edit:
    assert description.imu is not None
    drift = found.clock_drift
    if not drift:
        offset = description.imu.time.offset - found.lag_s
        text = f"the clock of the IMU lags that of the pose by {found.lag_s:.3f} s"
        finding = Finding("clock", f"{text}; set imu.time.offset: {offset:.3f}")
        return finding, edit_field(description, "imu.time.offset", offset)
    late = found.mid_record_lag_s - drift * found.mid_record_time_s
    lag, lines, edited = data.correction_of_lag_and_clock_drift("imu", description, late, drift)
    text = f"the clock of the IMU lags that of the pose by {lag:.3f} s at its first row and by"
    text += f" {1e3 * drift:.3g} ms more each second ({found.lag_s:.3f} s is the best constant)"
    return Finding("clock", f"{text}; set {lines}"), edited


_ACCELERATION_CUTOFF_HZ, _MAX_SHIFT_FIT_CONDITION_NUMBER = 3.0, 1e8
_MIN_REPORTED_POSE_SHIFT_M, _MAX_POSE_SHIFT_DEVIATION_M = 0.02, 0.01  # m
_MIN_POSITION_ERROR_OVER_STD = 5.0  # standard deviations
_UNIT_MATCH_RANGE, _MAX_SCALE_ERROR_FOR_SHIFT = (0.7, 1.43), 0.15
_MIN_UNIT_ERROR_FACTOR = 50.0
_MAX_POSITION_SCALE_ERROR_FOR_FRAME, _MIN_COM_TO_SO_M, _MAX_COM_TO_SO_M = 0.1, 2e-4, 1.5  # 1, m, m
_SI_VALUES_OF_TORQUE_UNITS = [SI_VALUE_OF_UNIT[unit] for unit in ("N m", "N mm", "lbf in")]
_WRONG_TORQUE_UNIT_RATIOS = (
    *(a / b for a, b in permutations(_SI_VALUES_OF_TORQUE_UNITS, 2)),
    *(SI_VALUE_OF_UNIT["lbf"], 1.0 / SI_VALUE_OF_UNIT["lbf"]),
)
"""Ratios of torque and force in wrong units, which resemble a displaced pose frame."""
_MAX_MASS_CENTRE_ERROR_OVER_DISTANCE = 0.03


def position_unit_or_origin_findings(
    description: Description, data: LogTables, lag: float
) -> list[Finding]:
    """Return a finding if positions have a wrong unit, or are of another point than described.

    The reference is the accelerometer, whose clock lags that of the pose by `lag` [s].
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
    num_samples = 2.0 * _ACCELERATION_CUTOFF_HZ * float(t[-1] - t[0])
    fit = _centred_fit_and_deviations(columns[inner], by_pose[inner], num_samples)
    if fit is None or abs(fit[0][0]) <= _MIN_POSITION_ERROR_OVER_STD * fit[1][0]:
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
    if size < max(_MIN_REPORTED_POSE_SHIFT_M, _MIN_POSITION_ERROR_OVER_STD * deviation):
        return []
    place, other = shift + np.array(pose.position_in_sensor), np.array(imu.position) - shift
    text = (
        f"the described positions of the pose's origin and the accelerometer disagree by"
        f" {1e3 * size:.0f} mm (+- {1e3 * deviation:.2g}); if imu.position is right, set"
        f" pose.position_in_sensor: {round_for_yaml(place)}, otherwise set imu.position:"
        f" {round_for_yaml(other)}"
    )
    return [Finding("pose frame", text)]


def _position_unit_finding(described: str, scale: float, deviation: float) -> Finding | None:
    if not abs(scale) > _MIN_POSITION_ERROR_OVER_STD * deviation:
        return None
    text = f"the acceleration by the positions is {1.0 / scale:.3g} times the measured one:"
    for unit in POSITION_UNITS:
        ratio = SI_VALUE_OF_UNIT[unit] / SI_VALUE_OF_UNIT[described]
        if unit != described and _UNIT_MATCH_RANGE[0] < scale / ratio < _UNIT_MATCH_RANGE[1]:
            what = f"the positions are not in {described}; set pose.position.unit: {unit}"
            return Finding("units", f"{text} {what}")
    if 1.0 / _MIN_UNIT_ERROR_FACTOR < abs(scale) < _MIN_UNIT_ERROR_FACTOR:  # noise or another error
        return None
    remedy = f"multiply pose.position.scale (1 by default) by {scale:.4g}"
    return Finding("units", f"{text} the unit of the positions is unknown; {remedy}")


def _centred_fit_and_deviations(
    columns: Array, target: Array, num_samples: float
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
    variance = float(np.sum((b - (A / size) @ x) ** 2)) / (target.shape[1] * max(1.0, num_samples))
    return x / size, np.sqrt(variance * np.diag(inverse)) / size


def pose_unit_or_frame_finding(found: PoseEstimate, log: Log) -> Finding | None:
    """Return a finding if the estimated position unit is wrong or the pose frame is not S."""
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
    """Return a finding if the estimated pose frame is not S; None if other errors are as likely."""
    frame, seen, phi = found.frame, found.units_and_axes, found.free_frame_fit.parameters.theta[6:]
    if not (frame.is_shifted or frame.is_rotated) or phi[0] <= 0.0:
        return None
    limit = max(_MAX_POSITION_SCALE_ERROR_FOR_FRAME, 5.0 * seen.position_unit_ratio_std)
    if abs(seen.position_unit_ratio - 1.0) > limit or (seen.is_usable and seen.is_mirrored):
        return None
    if _may_torque_unit_explain_position_shift(phi[1:4] / phi[0], frame.p_SoPo_S):
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


def _may_torque_unit_explain_position_shift(com: Array, shift: Array) -> bool:
    size = float(np.linalg.norm(com))
    off = min(np.linalg.norm(com - ratio * (com - shift)) for ratio in _WRONG_TORQUE_UNIT_RATIOS)
    is_usual = _MIN_COM_TO_SO_M < size < _MAX_COM_TO_SO_M
    return not is_usual or bool(off < _MAX_MASS_CENTRE_ERROR_OVER_DISTANCE * size)
