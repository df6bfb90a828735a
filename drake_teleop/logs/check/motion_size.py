"""Size of the recorded motion, without the noise of poses and IMU."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from drake_teleop.common.numeric import Array, white_noise_deviations
from drake_teleop.common.rotations import rotation_matrices
from drake_teleop.logs.pose_motion.poses import Poses, PosesOfLog
from drake_teleop.logs.read.alignment import low_pass_log, vectors_of_skew_parts
from drake_teleop.logs.read.canonical import Log

_MIN_MOTION_RMS_M_S2_AND_RAD_S = 0.17, 0.06
"""Least rms of specific force [m/s^2] (gravity turned by 1 deg) and angular velocity [rad/s]."""
MORE_MOTION_REMEDY = "record 10 s of fast rotations about all axes (see `drake-teleop excite`)"
_BLOCK_S, _MIN_BLOCKS, _CUTOFF_HZ = 0.1, 8, 5.0
_MAX_NOISE_OVER_MOTION, _MIN_CUTOFF_HZ = 0.1, 2.0


def motion_rms(log: Log) -> tuple[float, float]:
    """Return rms changes of specific force [m/s^2] and angular velocity [rad/s], without noise."""
    smooth = low_pass_log(log, min(_CUTOFF_HZ, 0.2 / log.dt))
    s, omega = (float(np.linalg.norm(x.std(axis=0))) for x in smooth.motion[:2])
    by_pose = None if log.posed is None else _motion_rms_of_poses(log.posed)
    if by_pose is None:
        return s, omega
    imu = None if log.described is None else log.described.imu
    s = s if imu is not None and imu.specific_force is not None else 0.0
    omega = omega if imu is not None and imu.angular_velocity is not None else 0.0
    return max(s, by_pose[0]), max(omega, by_pose[1])


def max_cutoff_by_pose_noise(log: Log) -> float:
    """Return the cut-off [Hz] with little position noise in specific force; inf without poses."""
    by_pose = None if log.posed is None else _motion_rms_of_poses(log.posed)
    if log.posed is None or by_pose is None:
        return np.inf
    poses = log.posed.poses
    noise = float(np.linalg.norm(white_noise_deviations(poses.position)))
    # The second derivative of white noise has the rms noise (2 pi f)^2 sqrt(2 f / (5 rate)).
    at_1_hz = noise * (2.0 * np.pi) ** 2 * np.sqrt(2.0 / (5.0 * poses.rate))
    ratio = _MAX_NOISE_OVER_MOTION * by_pose[0] / (at_1_hz + 1e-300)
    return max(_MIN_CUTOFF_HZ, float(ratio**0.4))


def explain_lack_of_motion(log: Log) -> str | None:
    """Return an error text if the motion is too small to separate load and offsets, else None."""
    if log.static:
        return None
    s, omega = motion_rms(log)
    if s >= _MIN_MOTION_RMS_M_S2_AND_RAD_S[0] or omega >= _MIN_MOTION_RMS_M_S2_AND_RAD_S[1]:
        return None
    text = f"in {log.t[-1] - log.t[0]:.2g} s the sensor hardly moves or turns ({s:.2g} m/s^2,"
    return f"{text} {omega:.2g} rad/s rms): load and offsets cannot be separated"


@lru_cache(maxsize=1)  # edits of the wrench keep the poses, whose identity is the key
def _motion_rms_of_poses(posed: PosesOfLog) -> tuple[float, float] | None:
    """Return noise-free RMS changes by the covariance of even and odd poses; None for few poses."""
    poses = posed.poses.with_continuous_quaternions()
    count = max(1, int(0.5 * _BLOCK_S * poses.rate))
    rows = len(poses.t) // (2 * count) * 2 * count
    if rows < 2 * count * _MIN_BLOCKS:
        return None
    arrays = poses.t, poses.position, poses.quaternion
    halves = [Poses(*(x[k:rows:2] for x in arrays)).average_consecutive(count) for k in (0, 1)]
    motions = [_specific_force_and_omega(half, posed.gravity_W) for half in halves]
    s, omega = (
        np.sqrt(max(0.0, float(((a - a.mean(axis=0)) * (b - b.mean(axis=0))).mean(axis=0).sum())))
        for a, b in zip(*motions, strict=True)
    )
    return float(s), float(omega)


def _specific_force_and_omega(poses: Poses, gravity_W: Array) -> tuple[Array, Array]:
    R_WS = rotation_matrices(poses.quaternion, "quaternion_wxyz")
    acceleration = np.gradient(np.gradient(poses.position, poses.t, axis=0), poses.t, axis=0)
    s = np.einsum("nji,nj->ni", R_WS, acceleration - gravity_W)
    turned = np.einsum("nji,njk->nik", R_WS[:-1], R_WS[1:])
    return s, vectors_of_skew_parts(turned) / np.diff(poses.t)[:, None]
