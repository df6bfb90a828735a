"""Estimates for `auto` in a log description: frames of IMU and pose, direction of gravity."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.logs.causes.cause import direction_std_deg
from drake_teleop.logs.causes.explain import explain_misfit
from drake_teleop.logs.causes.instants import BlockMeans, block_means_of_record, delay_of_linear_fit
from drake_teleop.logs.read.alignment import remove_delay, resample
from drake_teleop.logs.read.canonical import Log
from drake_teleop.logs.read.description import Description
from drake_teleop.logs.read.description_fields import STANDARD_GRAVITY
from drake_teleop.logs.read.mounting import LeverArm, Mounting, find_mounting, lever_arm_from_wrench

MIN_WARNED_IMU_LAG_S = 0.05
LogReader = Callable[[Description], Log]
Estimate = tuple[Description, tuple[str, ...]]  # description with estimates, and notes


def estimate_auto_imu_mounting(description: Description, source: str, read: LogReader) -> Estimate:
    """Return the description with estimates for `auto` in the IMU's mounting, and notes."""
    imu = description.imu
    assert imu is not None

    def replace_imu_fields(**changes: Any) -> Description:
        return description.model_copy(update={"imu": imu.model_copy(update=changes)})

    frame: Any = imu.frame
    position: Any = imu.position
    notes: list[str] = []
    start = "sensor" if frame == "auto" else frame
    mounting = None
    if description.pose is not None:
        alone = read(description.model_copy(update={"imu": None}))
        log_Io = read(replace_imu_fields(frame=start, position=(0.0, 0.0, 0.0)))
        mounting = find_mounting(log_Io, alone, has_position=description.pose.position is not None)
    if frame == "auto":
        mounting = _require_imu_rotation(mounting, f"{source}:imu.frame")
        frame = tuple(map(tuple, mounting.R_SI.tolist()))
        notes += _imu_rotation_notes(mounting)
    if position == "auto":
        log_Io = read(replace_imu_fields(frame=frame, position=(0.0, 0.0, 0.0)))
        lever = _lever_arm_from_pose_or_wrench(mounting, log_Io, f"{source}:imu.position")
        position = tuple(lever.p_SoIo_S.tolist())
        found = f": {_format_arm_mm(lever)} mm, from the {lever.source}"
        notes.append(_note_on_estimate("imu.position", found, lever.p_SoIo_S))
    return replace_imu_fields(frame=frame, position=position), tuple(notes)


def _require_imu_rotation(mounting: Mounting | None, where: str) -> Mounting:
    if mounting is None:
        problem = "the specific force hardly changes, or gaps leave too little of it"
        remedy = "turn the sensor about two axes"
    elif mounting.is_mirrored:
        problem = "the axes of the IMU are mirrored relative to those of the pose"
        remedy = "exchange two of its columns, or change imu.sign"
    elif not mounting.fits_pose:
        problem = f"no rotation makes IMU and pose agree ({_format_unexplained_shares(mounting)})"
        remedy = "find wrong units, signs or clocks by `drake-teleop inspect` with `frame: sensor`"
    elif not mounting.is_determined:
        worst = float(mounting.deviations_deg.max())
        problem = f"one direction has a standard deviation of {worst:.2g} deg"
        remedy = "turn the sensor about two axes, by more than 30 deg"
    else:
        return mounting
    what = f"the data do not determine the rotation of the IMU: {problem}"
    raise DrakeTeleopError(what, where=where, remedy=f"{remedy}, or set imu.frame")


def _format_unexplained_shares(found: Mounting) -> str:
    shares = {"specific force": found.unexplained, "angular velocity": found.unexplained_omega}
    return ", ".join(f"{v:.2g} of the {k}'s variance" for k, v in shares.items() if v is not None)


def _imu_rotation_notes(found: Mounting) -> list[str]:
    nearest = found.nearest_right_angled_rotation.astype(int).tolist()
    oblique = f"{found.angle_to_right_angled_deg:.1f} deg from the right-angled mounting {nearest}"
    std = f"{float(found.deviations_deg.max()):.2g} deg"
    notes = [_note_on_estimate("imu.frame", f": {oblique}, standard deviation {std}", found.R_SI)]
    if not found.is_right_angled:
        notes.append(f"warning: the IMU is mounted obliquely, {oblique}: check imu.frame")
    if abs(found.lag_s) > MIN_WARNED_IMU_LAG_S:
        notes.append(
            f"warning: the clock of the IMU lags that of the pose by {found.lag_s:.3f} s;"
            f" add {-found.lag_s:.3f} to imu.time.offset to correct it"
        )
    return notes


def _lever_arm_from_pose_or_wrench(mounting: Mounting | None, log_Io: Log, where: str) -> LeverArm:
    lever = None
    if mounting is not None and mounting.fits_pose:
        lever = mounting.lever_arm
    if lever is None or not lever.are_axes_determined.all():
        arms = [arm for arm in (lever, lever_arm_from_wrench(log_Io)) if arm is not None]
        lever = max(arms, key=lambda arm: int(arm.are_axes_determined.sum()), default=None)
    if lever is None:
        what = (
            "pose and wrench do not determine the position of the accelerometer: the pose has no"
            " positions or disagrees with the IMU, and the load alone does not explain the wrench"
        )
        remedy = "give imu.position in metres, or pose.position"
        raise DrakeTeleopError(what, where=where, remedy=remedy)
    if not lever.are_axes_determined.all():
        what = f"the motion does not determine {_unknown_axes(lever.are_axes_determined)} of the"
        what += f" accelerometer's position ({_format_arm_mm(lever)} mm, from the {lever.source})"
        remedy = "turn faster, about more axes, or give imu.position in metres"
        raise DrakeTeleopError(what, where=where, remedy=remedy)
    return lever


def _note_on_estimate(field: str, found: str, value: Array) -> str:
    written = f"{field}: {round_for_yaml(value)}"
    return f"{field} found{found}; write it into the description as {written}"


def round_for_yaml(x: Array) -> list:
    return list((np.round(x, 4) + 0.0).tolist())


def _format_arm_mm(lever: LeverArm) -> str:
    return ", ".join(
        f"{axis} {1e3 * value:.1f} +- {1e3 * deviation:.1f}" if deviation < 1 else f"{axis} unknown"
        for axis, value, deviation in zip("xyz", lever.p_SoIo_S, lever.deviations, strict=True)
    )


def estimate_auto_pose_frame(description: Description, source: str, read: LogReader) -> Estimate:
    """Return the description with estimates for `auto` in the pose frame, and notes."""
    from drake_teleop.logs.pose_motion.estimate import estimate_from_poses

    pose = description.pose
    assert pose is not None
    plain = {"position_in_sensor": (0.0, 0.0, 0.0), "rotation_in_sensor": None, "frame": "sensor"}
    alone = {"imu": None, "pose": pose.model_copy(update=plain)}
    log = read(description.model_copy(update=alone))
    assert log.posed is not None
    arrays = log.t, log.wrench, log.posed.poses, log.posed.gravity_W
    try:
        frame = estimate_from_poses(*arrays, p_SoPo_S=None, R_SP=None, lost=log.bridged).frame
    except DrakeTeleopError as error:
        raise DrakeTeleopError(str(error), where=f"{source}:pose") from error
    changes: dict[str, Any] = {}
    notes: list[str] = []
    mm, deg = 1e3 * frame.position_stds_m.max(), frame.rotation_stds_deg.max()
    for name, value, known, quantity, deviation in (
        ("position", frame.p_SoPo_S, frame.is_position_known, "origin along", f"{mm:.2g} mm"),
        ("rotation", frame.R_SP, frame.is_rotation_known, "turn about", f"{deg:.2g} deg"),
    ):
        field = f"{name}_in_sensor"
        if getattr(pose, field) != "auto":
            continue
        if not known.all():
            what = f"the data do not determine the pose's {quantity} {_unknown_axes(known)}"
            remedy = "turn the sensor faster, about more axes, without contact; or give the values"
            raise DrakeTeleopError(what, where=f"{source}:pose.{field}", remedy=remedy)
        changes[field] = tuple(map(tuple, value.tolist()) if value.ndim == 2 else value.tolist())
        notes.append(_note_on_estimate(f"pose.{field}", f", standard deviation {deviation}", value))
    return description.model_copy(update={"pose": pose.model_copy(update=changes)}), tuple(notes)


def _unknown_axes(known: Any) -> str:
    return ", ".join(axis for axis, is_known in zip("xyz", known, strict=True) if not is_known)


def block_means_of_log(log: Log) -> BlockMeans:
    gravity = None
    motion: tuple[Array, ...] = log.motion
    if log.R_WS is not None and log.gravity_W is not None:
        gravity, motion = log.gravity_W, (*log.motion, log.R_WS)
    noise = np.inf if log.is_acceleration_unknown else 0.0
    means = block_means_of_record(log.t, log.wrench, motion, gravity, log.bridged, noise)
    return replace(means, clock_rate=_clock_rate_extension_name(log))


def _clock_rate_extension_name(log: Log) -> str | None:
    """Return the name of the model extension for a wrong clock rate; None: not fitted."""
    if log.described is None or log.has_calendar_time or log.is_acceleration_unknown:
        return None
    imu = log.described.imu
    if imu is None:
        return "clock rate of poses"
    if imu.specific_force is None or imu.angular_acceleration is not None:
        return None
    return f"clock rate of {'orientations' if imu.angular_velocity is None else 'gyroscope'}"


def wrench_of_weight(weight: Array, gravity: Array) -> Array:
    """Return the wrench (N, 6) that holds a weight [m, m c] at rest in gravity (N, 3), in S."""
    return np.hstack([-weight[0] * gravity, np.cross(weight[1:], -gravity)])


def restore_removed_weight(log: Log, weight: Array, motion_log: Log) -> Log:
    """Return the log plus the wrench of a weight [m, m c] (4,) that the robot has subtracted.

    Gravity is from `motion_log`, the same log with motion, at its estimated delay.
    """
    assert motion_log.gravity is not None
    at = log.t + delay_of_linear_fit(block_means_of_log(motion_log))
    gravity = resample(at.clip(*motion_log.t[[0, -1]]), motion_log.t, motion_log.gravity)
    return replace(log, wrench=log.wrench + wrench_of_weight(weight, gravity))


_MAX_GRAVITY_DIRECTION_STD_DEG = 2.0


def estimate_auto_gravity(description: Description, source: str, read: LogReader) -> Estimate:
    """Return the description with an estimate for `gravity: auto`, and notes."""
    start = description.model_copy(update={"gravity": tuple(description.gravity_W.tolist())})
    log, deviation = read(start), np.inf

    def block_means_at_delay(delay_s: float) -> BlockMeans:
        return block_means_of_log(remove_delay(log, delay_s))

    explanation = explain_misfit(block_means_of_log(log), block_means_at_delay, ("gravity",))
    if explanation.theta[6] > 0.0:
        change, covariance = explanation.fit.parameters_of_extension("gravity")
        estimated = description.gravity_W - change
        estimated *= STANDARD_GRAVITY / np.linalg.norm(estimated)
        deviation = direction_std_deg(estimated, covariance)
    if not deviation < _MAX_GRAVITY_DIRECTION_STD_DEG:
        what = "the data do not determine the direction of gravity"
        remedy = "record the load in more orientations, without contact; or give the vector"
        raise DrakeTeleopError(what, where=f"{source}:gravity", remedy=remedy)
    note = _note_on_estimate("gravity", f", standard deviation {deviation:.2g} deg", estimated)
    return description.model_copy(update={"gravity": tuple(round_for_yaml(estimated))}), (note,)
