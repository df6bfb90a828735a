"""How an IMU sits on the sensor: its rotation, its place and its clock, from the data.

An accelerometer at Io, a point of the body of S, measures in its own axes I, up to a bias,

    R_SI s_I = s + alpha x p + omega x (omega x p) = s + K p,    p = p_SoIo_S

with the specific force s of So and the motion of S. A pose with position gives s, omega and alpha,
hence R_SI and p. A pose without position gives s only as far as So does not accelerate: R_SI is
found, and p would be the distance from the centre of the rotation, so it is not told. The wrench
may tell it then (`lever_arm`).

Standard deviations are those of a `jackknife`. They contain noise, but not what interpolation
between the samples of a pose does (about 0.1 % of p) nor the errors of scale of an accelerometer.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_teleop.logs.read.alignment import low_passed, resample
from drake_teleop.logs.read.canonical import Log
from drake_teleop.logs.read.imu_clock import best_shift, clock_drift, signal_pairs
from drake_teleop.logs.read.jackknife import solve
from drake_teleop.logs.read.lever_arm import (
    BELIEVABLE,
    CUTOFF,
    SAMPLES,
    LeverArm,
    common_times,
    lever_matrix,
    shown_axes,
)
from drake_teleop.logs.read.rotations import right_angled_rotations, rotation_matrices

RIGHT_ANGLED_DEG = 5.0
"""A mounting within this angle of one that only exchanges axes counts as right-angled."""
ROTATION_KNOWN_DEG = 1.0
"""A rotation is determined if its standard deviation about every axis is below this."""
BELIEVABLE_GRAVITY = 0.005
"""The same of specific forces that are compared with gravity alone, as accelerations may look like
a rotation."""
_REACH = 1.0


@dataclass(frozen=True)
class Mounting:
    """The IMU against the pose.

    Args:
        R_SI: (3, 3) rotation from the axes of the IMU's stream to S: `imu.frame` on top of what the
            description says already.
        lag_s: how far the IMU's clock is behind that of the pose: the best single shift [s].
        lag_middle_s: the same in the middle of the record, if the clocks drift; else `lag_s`.
        middle_s: that instant, on the clock of the pose [s].
        drift: growth of the lag [s/s]; 0 if the record does not show one.
        unexplained: share of the variance of the specific force that this leaves.
        unexplained_turning: the same of the angular velocity; None without a gyroscope.
        mirrored: a reflection fits decisively better, so R_SI means nothing.
        speed_ratio: rms angular speed of the gyroscope over that of the pose; None without one.
        deviations_deg: (3,) standard deviations of R_SI about the axes of S [deg]; inf about an
            axis that the motion says nothing of.
        lever: of the accelerometer; None if the pose has no position.
    """

    R_SI: NDArray[np.float64]
    lag_s: float
    lag_middle_s: float
    middle_s: float
    drift: float
    unexplained: float
    unexplained_turning: float | None
    mirrored: bool
    speed_ratio: float | None
    deviations_deg: NDArray[np.float64]
    lever: LeverArm | None

    @property
    def angle_deg(self) -> float:
        """Angle of R_SI [deg]."""
        return _angle_deg(self.R_SI)

    @property
    def right_angled(self) -> NDArray[np.float64]:
        """(3, 3) the nearest of the 24 rotations that only exchange and turn axes."""
        return max(right_angled_rotations(), key=lambda R: float(np.trace(R.T @ self.R_SI)))

    @property
    def oblique_deg(self) -> float:
        """Angle between R_SI and `right_angled` [deg]."""
        return _angle_deg(self.right_angled.T @ self.R_SI)

    @property
    def is_right_angled(self) -> bool:
        """Whether axes only change places and signs."""
        return self.oblique_deg < RIGHT_ANGLED_DEG

    @property
    def fits(self) -> bool:
        """Whether IMU and pose agree, so that the rest means something."""
        turning = self.unexplained_turning is None or self.unexplained_turning < BELIEVABLE
        if self.lever is not None:
            return not self.mirrored and turning and self.unexplained < BELIEVABLE
        # Without a position the pose knows the angular velocity, but not the acceleration.
        known = self.unexplained_turning is not None or self.unexplained < BELIEVABLE_GRAVITY
        return not self.mirrored and turning and known

    @property
    def determined(self) -> bool:
        """Whether the motion shows the rotation about every axis."""
        return self.fits and bool((self.deviations_deg < ROTATION_KNOWN_DEG).all())


def find_mounting(imu: Log, pose: Log, *, position: bool = False) -> Mounting | None:
    """Rotation, place and clock of an IMU, from two readings of the same log.

    First the clock, to about 10 ms within +-1 s: at every shift, free linear maps of specific force
    and, with a gyroscope, angular velocity are fitted, which do not depend on the axes; a drift of
    the clocks is fitted on top, see `clock_drift`. Then
    R s_imu + b = s_pose + K p, and R omega_imu + b = omega_pose, by nonlinear least squares over
    the rotation R, constants b, the lever arm p and the clock, from the rotation of Kabsch (1976);
    the two sensors are weighted by their own residuals. All signals are low-passed at 8 Hz.

    Args:
        imu: specific force and angular velocity from the IMU.
        pose: the same from the pose alone.
        position: whether the pose has positions. If not, its specific force is minus gravity, p is
            the place of the accelerometer from the centre of the rotation, and it is not told.

    Returns:
        None if the specific force changes by less than 0.5 m/s^2 (rms), or gaps leave less than a
        tenth of the record, so that nothing can be said.
    """
    start, stop = max(imu.t[0], pose.t[0]), min(imu.t[-1], pose.t[-1])
    reach = min(_REACH, 0.2 * float(stop - start))
    cutoff = min(CUTOFF, 0.2 / imu.dt)
    sensed, smooth = low_passed(imu, cutoff), low_passed(pose, cutoff)
    t = common_times(start + reach, stop - reach, (imu, pose), cutoff)
    if len(t) < SAMPLES // 10:
        return None
    # Without a gyroscope both readings have the angular velocity of the pose.
    omega_imu, omega = (resample(t, log.t, log.angular_velocity) for log in (imu, pose))
    gyroscope = not np.allclose(omega_imu, omega, atol=1e-9)
    pairs = signal_pairs(t, sensed, smooth, gyroscope)
    expected = pairs[0][0]
    if expected.var(axis=0).sum() < 0.25:
        return None
    # A gyroscope tells the clock. Without one, a long lever arm must not be taken for a late clock.
    arm = np.zeros((len(t), 1))
    if not gyroscope:
        omega, alpha = (resample(t, pose.t, x) for x in smooth.motion[1:])
        arm = lever_matrix(omega, alpha).reshape(-1, 9)
    lag = best_shift(t, pairs, imu.t, reach, arm)
    centre = float(t.mean())
    middle, drift = clock_drift(t, pairs, imu.t, lag, 2 * cutoff * float(t[-1] - t[0]))
    R, mirrored = _kabsch(resample(t + middle + drift * (t - centre), imu.t, pairs[0][1]), expected)

    # With the clock known, more of the record can be used.
    margin = min(reach, abs(middle) + 0.5 * abs(drift) * float(stop - start) + 0.1)
    t = common_times(start + margin, stop - margin, (imu, pose), cutoff)
    pairs = signal_pairs(t, sensed, smooth, gyroscope)
    turned = resample(t, pose.t, smooth.angular_velocity)
    K = lever_matrix(turned, resample(t, pose.t, smooth.angular_acceleration))

    x, deviations, left = _refined(t, drift * (t - centre), imu.t, pairs, K, R, middle)
    lever = None
    if position:
        lever = LeverArm(
            x[4:7], np.where(shown_axes(K, pose, cutoff), deviations[4:7], np.inf), "pose"
        )
    powers = left.reshape(len(t), -1, 3).var(axis=0).sum(axis=1)
    shares = [float(part / y.var(axis=0).sum()) for part, (y, _) in zip(powers, pairs, strict=True)]
    speeds = [float(np.linalg.norm(log.angular_velocity, axis=1).std()) for log in (imu, pose)]
    return Mounting(
        R_SI=_turned(R, x[:3]),
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


def _refined(
    t: NDArray[np.float64],
    later: NDArray[np.float64],
    t_imu: NDArray[np.float64],
    pairs: list[tuple[NDArray[np.float64], NDArray[np.float64]]],
    K: NDArray[np.float64],
    R: NDArray[np.float64],
    lag: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """The least squares of `find_mounting`.

    Args:
        t: (N,) times on the clock of the pose [s].
        later: (N,) what a drift of the clocks adds to the lag by then [s].
        t_imu: (M,) times of the IMU's samples, on its own clock [s].
        pairs: specific force [m/s^2] and, with a gyroscope, angular velocity [rad/s]: (N, 3) of the
            pose and (M, 3) of the IMU.
        K: (N, 3, 3) of the module docstring.
        R, lag: R_SI and the lag [s] to begin with.

    Returns:
        (7 + 3 k,) rotation vector on top of R in S [rad], lag [s], p [m] and the k constants b;
        their standard deviations; (N, 3 k) what is left. k is the number of pairs.
    """
    known, moving = (np.stack(signals, axis=1) for signals in zip(*pairs, strict=True))

    def residual(x: NDArray[np.float64]) -> NDArray[np.float64]:
        seen = resample(t + x[3] + later, t_imu, moving).reshape(-1, 3) @ _turned(R, x[:3]).T
        left = seen.reshape(known.shape) - known
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


def _kabsch(x: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[NDArray[np.float64], bool]:
    """The rotation R of the smallest |y - R x - b|, and whether a reflection fits far better."""
    x, y = x - x.mean(axis=0), y - y.mean(axis=0)
    U, _, Vt = np.linalg.svd(y.T @ x)
    side = np.linalg.det(U @ Vt)
    R, mirror = U @ np.diag([1.0, 1.0, side]) @ Vt, U @ np.diag([1.0, 1.0, -side]) @ Vt
    direct, reflected = (((y - x @ M.T) ** 2).sum() / (y**2).sum() for M in (R, mirror))
    return R, bool(reflected < 0.25 * direct and reflected < 0.05)


def _turned(R: NDArray[np.float64], vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """R turned by a rotation vector (3,) in S [rad]."""
    return rotation_matrices(vector[None], "rotation_vector")[0] @ R


def _angle_deg(R: NDArray[np.float64]) -> float:
    return float(np.degrees(np.arccos(np.clip((np.trace(R) - 1) / 2, -1, 1))))
