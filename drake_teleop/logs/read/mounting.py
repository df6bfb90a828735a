"""Rotation, position and clock of an IMU on the sensor, by comparison with the pose, Eq. (T20).

Without positions only rotation and clock are found.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drake_teleop.common.numeric import Array
from drake_teleop.logs.read.alignment import low_passed, resample
from drake_teleop.logs.read.canonical import Log
from drake_teleop.logs.read.imu_clock import best_shift, clock_drift, signal_pairs
from drake_teleop.logs.read.jackknife import solve
from drake_teleop.logs.read.lever_arm import (
    COMPARED_SAMPLES,
    CUTOFF_HZ,
    MAX_UNEXPLAINED,
    LeverArm,
    common_times,
    lever_matrix,
    observable_axes,
)
from drake_teleop.logs.read.rotations import right_angled_rotations, rotation_matrices

RIGHT_ANGLED_DEG = 5.0
"""Largest angle between a right-angled mounting and a rotation that maps axes to axes [deg]."""
MAX_DEVIATION_DEG = 1.0
"""Largest standard deviation of a determined rotation [deg]."""
MAX_UNEXPLAINED_GRAVITY = 0.005
"""Lower limit than `MAX_UNEXPLAINED`, for logs without positions: unmodelled accelerations resemble
a rotation."""
_MAX_LAG_S = 1.0


@dataclass(frozen=True)
class Mounting:
    """Mounting of an IMU relative to the pose.

    Attributes:
        R_SI: (3, 3) rotation from the described IMU axes to S.
        lag_s: constant lag of the IMU's clock behind the pose's clock [s].
        lag_middle_s, middle_s: lag at mid-record, and this time on the pose's clock [s].
        drift: growth of the lag [s/s]; 0 if insignificant.
        unexplained: unexplained share of the variance of the specific force.
        unexplained_turning: that of the angular velocity; None without a gyroscope.
        mirrored: True if a reflection fits clearly better, so that R_SI is invalid.
        speed_ratio: angular speed of gyroscope over pose (RMS), or None.
        deviations_deg: (3,) standard deviations of R_SI about the axes of S [deg].
        lever: position of the accelerometer; None without positions.
    """

    R_SI: Array
    lag_s: float
    lag_middle_s: float
    middle_s: float
    drift: float
    unexplained: float
    unexplained_turning: float | None
    mirrored: bool
    speed_ratio: float | None
    deviations_deg: Array
    lever: LeverArm | None

    @property
    def angle_deg(self) -> float:
        """Rotation angle of R_SI [deg]."""
        return _angle_deg(self.R_SI)

    @property
    def right_angled(self) -> Array:
        """Rotation (3, 3) nearest to R_SI, of the 24 that map axes to axes."""
        return max(right_angled_rotations(), key=lambda R: float(np.trace(R.T @ self.R_SI)))

    @property
    def oblique_deg(self) -> float:
        """Angle between R_SI and `right_angled` [deg]."""
        return _angle_deg(self.right_angled.T @ self.R_SI)

    @property
    def is_right_angled(self) -> bool:
        """Whether R_SI maps axes to axes, within 5 deg."""
        return self.oblique_deg < RIGHT_ANGLED_DEG

    @property
    def fits(self) -> bool:
        """Whether IMU and pose agree, with small unexplained shares."""
        omega_agrees = (
            self.unexplained_turning is None or self.unexplained_turning < MAX_UNEXPLAINED
        )
        if self.lever is not None:
            return not self.mirrored and omega_agrees and self.unexplained < MAX_UNEXPLAINED
        # Without positions the pose determines the angular velocity, but not the acceleration.
        known = self.unexplained_turning is not None or self.unexplained < MAX_UNEXPLAINED_GRAVITY
        return not self.mirrored and omega_agrees and known

    @property
    def determined(self) -> bool:
        """Whether the rotation is determined to 1 deg about every axis."""
        return self.fits and bool((self.deviations_deg < MAX_DEVIATION_DEG).all())


def find_mounting(imu: Log, pose: Log, *, position: bool = False) -> Mounting | None:
    """Estimate rotation, position and clock of an IMU relative to the pose.

    By least squares at 8 Hz, starting from the rotation of Kabsch (1976); lags are within +-1 s.
    None if the specific force changes by less than 0.5 m/s^2 (RMS), or gaps leave too few samples.

    Args:
        imu: the log.
        pose: the same log, read without the IMU.
        position: True to estimate the position of the accelerometer.
    """
    start, stop = max(imu.t[0], pose.t[0]), min(imu.t[-1], pose.t[-1])
    reach = min(_MAX_LAG_S, 0.2 * float(stop - start))
    cutoff = min(CUTOFF_HZ, 0.2 / imu.dt)
    sensed, smooth = low_passed(imu, cutoff), low_passed(pose, cutoff)
    t = common_times(start + reach, stop - reach, (imu, pose), cutoff)
    if len(t) < COMPARED_SAMPLES // 10:
        return None
    # Without a gyroscope both readings contain the angular velocity of the pose.
    omega_imu, omega = (resample(t, log.t, log.angular_velocity) for log in (imu, pose))
    gyroscope = not np.allclose(omega_imu, omega, atol=1e-9)
    pairs = signal_pairs(t, sensed, smooth, gyroscope)
    expected = pairs[0][0]
    if expected.var(axis=0).sum() < 0.25:
        return None
    # Without a gyroscope, a long lever arm resembles a lag, so its effects are removed.
    arm = np.zeros((len(t), 1))
    if not gyroscope:
        omega, alpha = (resample(t, pose.t, x) for x in smooth.motion[1:])
        arm = lever_matrix(omega, alpha).reshape(-1, 9)
    lag = best_shift(t, pairs, imu.t, reach, arm)
    centre = float(t.mean())
    middle, drift = clock_drift(t, pairs, imu.t, lag, 2 * cutoff * float(t[-1] - t[0]))
    R, mirrored = _kabsch(resample(t + middle + drift * (t - centre), imu.t, pairs[0][1]), expected)

    # The estimated lag allows the use of more samples.
    margin = min(reach, abs(middle) + 0.5 * abs(drift) * float(stop - start) + 0.1)
    t = common_times(start + margin, stop - margin, (imu, pose), cutoff)
    pairs = signal_pairs(t, sensed, smooth, gyroscope)
    pose_omega = resample(t, pose.t, smooth.angular_velocity)
    K = lever_matrix(pose_omega, resample(t, pose.t, smooth.angular_acceleration))

    x, deviations, left = _refine(t, drift * (t - centre), imu.t, pairs, K, R, middle)
    lever = None
    if position:
        lever = LeverArm(
            x[4:7], np.where(observable_axes(K, pose, cutoff), deviations[4:7], np.inf), "pose"
        )
    powers = left.reshape(len(t), -1, 3).var(axis=0).sum(axis=1)
    shares = [float(part / y.var(axis=0).sum()) for part, (y, _) in zip(powers, pairs, strict=True)]
    speeds = [float(np.linalg.norm(log.angular_velocity, axis=1).std()) for log in (imu, pose)]
    return Mounting(
        R_SI=_rotate(R, x[:3]),
        lag_s=lag if drift else float(x[3]),
        lag_middle_s=float(x[3]),
        middle_s=centre,
        drift=drift,
        unexplained=shares[0],
        unexplained_turning=shares[1] if len(shares) > 1 else None,
        mirrored=mirrored,
        speed_ratio=speeds[0] / speeds[1] if speeds[1] > 0.05 else None,
        deviations_deg=np.degrees(deviations[:3]),
        lever=lever,
    )


def _refine(
    t: Array,
    drift_lag: Array,
    t_imu: Array,
    pairs: list[tuple[Array, Array]],
    K: Array,
    R: Array,
    lag: float,
) -> tuple[Array, Array, Array]:
    known, moving = (np.stack(signals, axis=1) for signals in zip(*pairs, strict=True))

    def residual(x: Array) -> Array:
        rotated = resample(t + x[3] + drift_lag, t_imu, moving).reshape(-1, 3) @ _rotate(R, x[:3]).T
        left = rotated.reshape(known.shape) - known
        left[:, 0] -= K @ x[4:7]
        return left.reshape(len(t), -1) + x[7:]

    first = np.zeros(7 + 3 * len(pairs))
    first[3] = lag
    first[7:] = -residual(first).mean(axis=0)
    linear = np.zeros((len(t), 3 * len(pairs), len(first) - 4))
    linear[:, :3, :3] = -K
    linear[:, :, 3:] = np.eye(3 * len(pairs))
    x, deviations = solve(residual, first, linear)
    return x, deviations, residual(x)


def _kabsch(x: Array, y: Array) -> tuple[Array, bool]:
    """Return the R that minimises |y - R x - b|, and whether a reflection fits clearly better."""
    x, y = x - x.mean(axis=0), y - y.mean(axis=0)
    U, _, Vt = np.linalg.svd(y.T @ x)
    side = np.linalg.det(U @ Vt)
    R, mirror = U @ np.diag([1.0, 1.0, side]) @ Vt, U @ np.diag([1.0, 1.0, -side]) @ Vt
    direct, reflected = (((y - x @ M.T) ** 2).sum() / (y**2).sum() for M in (R, mirror))
    return R, bool(reflected < 0.25 * direct and reflected < 0.05)


def _rotate(R: Array, vector: Array) -> Array:
    return rotation_matrices(vector[None], "rotation_vector")[0] @ R


def _angle_deg(R: Array) -> float:
    return float(np.degrees(np.arccos(np.clip((np.trace(R) - 1) / 2, -1, 1))))
