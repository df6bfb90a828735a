"""Checks of an IMU: consistency of its three signals, and its motion against the pose."""

from __future__ import annotations

import numpy as np

from drake_teleop.common.numeric import Array
from drake_teleop.common.rotations import axis_names_of_rows, rotation_matrices, signed_permutations
from drake_teleop.logs.causes.cause import Finding
from drake_teleop.logs.check.against_load import (
    GOOD_UNEXPLAINED,
    MIN_REDUCTION_BY_EDIT,
    VALID_UNEXPLAINED,
)
from drake_teleop.logs.check.corrections import (
    MIN_LAG_OF_WRONG_CLOCK_S,
    Edit,
    call_or_none_if_unreadable,
    edit_field,
    orientation_and_gravity_sign_edits,
)
from drake_teleop.logs.check.log_data import LogData
from drake_teleop.logs.read.alignment import low_pass, smooth_derivatives
from drake_teleop.logs.read.canonical import Log
from drake_teleop.logs.read.description import Description, Imu
from drake_teleop.logs.read.mounting import Mounting, find_mounting

RANGE_OF_DEGREES_PER_RADIAN = (40.0, 80.0)
"""Range of a speed ratio of 180 / pi, degrees over radians, with noise and gain errors."""
MIN_REPORTED_GRAVITY_ERROR_SHARE = 0.02  # calibrated sensors are within 1 %
_MIN_GRAVITY_ERROR_OVER_DEVIATION, _ALPHA_COMPARISON_CUTOFF_HZ = 5.0, 5.0
_MIN_ALPHA_CORRELATION, _MAX_UNSWAPPED_OVER_BEST_CORRELATION = 0.8, 0.5
_GRAVITY_WINDOW_RANGE_S, _MIN_GRAVITY_WINDOWS, _MAX_GRAVITY_WINDOWS = (2.0, 8.0), 6, 60
_GYRO_AXES_RATE_HZ, _MIN_WRONG_AXES_MISFIT, _MIN_AXES_MISFIT_REDUCTION = 25.0, 0.05, 3.0


def check_imu_signals(description: Description, log: Log) -> tuple[list[Finding], Description]:
    """Return a contradiction among an IMU's signals, if any, and the corrected description."""
    imu = description.imu
    if imu is None or imu.angular_velocity is None or log.static or imu.is_mounting_auto:
        return [], description
    edit = _angle_unit_edit(description, imu, log)
    if edit is not None:
        return [edit[0]], edit[1]
    if imu.specific_force is None or imu.frame == "base":
        return [], description
    gravity = float(np.linalg.norm(description.gravity_W))
    edit = _gyro_axes_edit(description, imu, log, gravity)
    if edit is not None:
        return [edit[0]], edit[1]
    axes = _angular_acceleration_axes_finding(imu, log)
    finding = axes or _gravity_magnitude_finding(imu, log, gravity)
    return ([] if finding is None else [finding]), description


def _angle_unit_edit(description: Description, imu: Imu, log: Log) -> Edit | None:
    assert imu.angular_velocity is not None
    if imu.angular_acceleration is None:
        return None
    given_alpha, derived_alpha = _given_and_derived_alpha(log)
    sizes = float(np.linalg.norm(given_alpha)), float(np.linalg.norm(derived_alpha))
    correlation = float(np.sum(given_alpha * derived_alpha))
    if min(sizes) == 0.0 or correlation < _MIN_ALPHA_CORRELATION * sizes[0] * sizes[1]:
        return None
    ratio, (least, most) = sizes[0] / sizes[1], RANGE_OF_DEGREES_PER_RADIAN
    for wrong, quantity, unit, other in (
        (ratio, "angular_acceleration", "rad/s^2", "deg/s^2"),
        (1.0 / ratio, "angular_acceleration", "deg/s^2", "rad/s^2"),
        (1.0 / ratio, "angular_velocity", "rad/s", "deg/s"),
    ):
        if least < wrong < most and getattr(imu, quantity).unit == unit:
            text = f"the angular acceleration is {ratio:.3g} times the derivative of the angular"
            line = f"imu.{quantity}.unit"
            finding = Finding("degrees", f"{text} velocity; set {line}: {other}")
            return finding, edit_field(description, line, other)
    return None


def _given_and_derived_alpha(log: Log) -> tuple[Array, Array]:
    rate = smooth_derivatives(log.angular_velocity, log.dt, 30.0)[1]
    given = low_pass(log.angular_acceleration, log.dt, _ALPHA_COMPARISON_CUTOFF_HZ)
    return given, low_pass(rate, log.dt, _ALPHA_COMPARISON_CUTOFF_HZ)


def _gyro_axes_edit(description: Description, imu: Imu, log: Log, gravity: float) -> Edit | None:
    assert imu.angular_velocity is not None
    few = log.select_rows(slice(None, None, max(1, round(1.0 / (_GYRO_AXES_RATE_HZ * log.dt)))))
    given = _gravity_misfit(few, np.eye(3), gravity)
    if not given > _MIN_WRONG_AXES_MISFIT:
        return None
    misfits = ((_gravity_misfit(few, P, gravity), P) for P in signed_permutations())
    best, P = min(misfits, key=lambda entry: entry[0])
    if _MIN_AXES_MISFIT_REDUCTION * best > given:
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
    """Return mean specific forces (2, n, 3) in n Hann windows, and half a window later.

    The gyroscope, its axes permuted by `gyro_axes`, rotates them to the axes at the window's start.
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


def _gravity_misfit(log: Log, gyro_axes: Array, gravity: float) -> float:
    means = _mean_specific_forces_in_start_axes(log, gyro_axes) / gravity
    if means.shape[1] == 0:
        return np.nan
    off = np.linalg.norm(means, axis=2) - 1.0
    return float(np.sqrt(np.mean(off**2) + np.mean(np.sum((means[1] - means[0]) ** 2, axis=1))))


def _gravity_magnitude_finding(imu: Imu, log: Log, gravity: float) -> Finding | None:
    forces = _mean_specific_forces_in_start_axes(log, np.eye(3))[0]
    if len(forces) < _MIN_GRAVITY_WINDOWS:
        return None
    ratios = np.linalg.norm(forces, axis=1) / gravity
    ratio, deviation = np.mean(ratios), np.std(ratios, ddof=1) / np.sqrt(len(ratios))
    off = abs(ratio - 1.0)
    if not 0.7 < ratio < 1.4 or off < max(
        MIN_REPORTED_GRAVITY_ERROR_SHARE + 3.0 * deviation,
        _MIN_GRAVITY_ERROR_OVER_DEVIATION * deviation,
    ):
        return None
    assert imu.specific_force is not None
    measured_gravity = ratio * gravity
    remedy = f"divide the columns of imu.specific_force by {ratio:.4f}, or calibrate them"
    if imu.specific_force.unit != "g" and abs(measured_gravity / 9.80665 - 1.0) < 0.01:
        remedy = f"set gravity: {measured_gravity:.4g}"
    return Finding(
        "gravity",
        f"the accelerometer reads {measured_gravity:.4g} m/s^2 of gravity in the mean,"
        f" {100 * off:.2g} % (+- {100 * deviation:.1g})"
        f" {'more' if ratio > 1 else 'less'} than described: the mass would be wrong by as much;"
        f" {remedy}",
    )


def check_imu_against_pose(
    description: Description, data: LogData
) -> tuple[list[Finding], Mounting | None, Description]:
    """Return contradictions of IMU and pose, the IMU's mounting, and the corrected description."""

    def fit_mounting(edited: Description) -> Mounting | None:
        pose_alone = edited.model_copy(update={"imu": None})
        return find_mounting(data.read_thinned_log(edited), data.read_thinned_log(pose_alone))

    given = fit_mounting(description)
    if given is None:
        return [], None, description
    findings: list[Finding] = []
    if given.unexplained > GOOD_UNEXPLAINED or given.is_mirrored or given.rotation_angle_deg > 10:
        better = [
            (found.unexplained, finding, edited, found)
            for finding, edited in orientation_and_gravity_sign_edits(description)
            if (found := call_or_none_if_unreadable(fit_mounting, edited)) and not found.is_mirrored
        ]
        limit = min(VALID_UNEXPLAINED, given.unexplained / MIN_REDUCTION_BY_EDIT)
        if given.is_mirrored:
            better = [entry for entry in better if entry[3].rotation_angle_deg < 10]
        elif given.rotation_angle_deg > 10 and given.unexplained < VALID_UNEXPLAINED:
            # In a rotation about one axis an inverted orientation resembles a rotated IMU. An edit
            # that keeps the described mounting is the simpler explanation.
            better = [entry for entry in better if entry[3].rotation_angle_deg < 10]
            limit = min(VALID_UNEXPLAINED, 1.5 * given.unexplained + 1e-4)
        best = min(better, key=lambda entry: entry[0], default=None)
        if best and best[0] < limit:
            findings.append(best[1])
            description, given = best[2], best[3]
    if given.unexplained > VALID_UNEXPLAINED and not given.is_mirrored:
        return findings, given, description
    if abs(given.lag_s) > MIN_LAG_OF_WRONG_CLOCK_S or given.clock_drift:
        finding, description = _correct_imu_clock(description, given, data)
        findings.append(finding)
    least, most = RANGE_OF_DEGREES_PER_RADIAN
    if given.speed_ratio is not None and least < given.speed_ratio < most:
        text = f"the gyroscope reads {given.speed_ratio:.3g} times the speed of the pose;"
        findings.append(Finding("degrees", f"{text} set imu.angular_velocity.unit: deg/s"))
        description = edit_field(description, "imu.angular_velocity.unit", "deg/s")
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
        text = f"the IMU is turned by {given.rotation_angle_deg:.0f} deg against S;"
        oblique = "" if given.is_right_angled else " (not a right-angled mounting)"
        findings.append(Finding(kind, f"{text} set imu.frame: {shown}{oblique}"))
        description = edit_field(description, "imu.frame", tuple(map(tuple, frame.tolist())))
    return findings, given, description


def _correct_imu_clock(description: Description, found: Mounting, data: LogData) -> Edit:
    assert description.imu is not None
    drift = found.clock_drift
    if not drift:
        offset = description.imu.time.offset - found.lag_s
        text = f"the clock of the IMU lags that of the pose by {found.lag_s:.3f} s"
        finding = Finding("clock", f"{text}; set imu.time.offset: {offset:.3f}")
        return finding, edit_field(description, "imu.time.offset", offset)
    late = found.mid_record_lag_s - drift * found.mid_record_time_s
    lag, lines, edited = data.start_lag_and_clock_drift_correction("imu", description, late, drift)
    text = f"the clock of the IMU lags that of the pose by {lag:.3f} s at its first row and by"
    text += f" {1e3 * drift:.3g} ms more each second ({found.lag_s:.3f} s is the best constant)"
    return Finding("clock", f"{text}; set {lines}"), edited
