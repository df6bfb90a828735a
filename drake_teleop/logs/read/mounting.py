"""Rotation, position and clock of an IMU, from the pose or from a load's wrench, (T20) to (T22)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.numeric import Array, search_minimum
from drake_teleop.common.rotations import right_angled_rotations, rotation_matrices
from drake_teleop.common.vectors import cross_matrix
from drake_teleop.load.compensation import contact_wrench
from drake_teleop.load.regressor import regressor
from drake_teleop.logs.read import alignment
from drake_teleop.logs.read.alignment import low_pass_log, resample
from drake_teleop.logs.read.canonical import Log

# Least log likelihood ratio (times 2) and total lag [s] of a significant drift.
_MIN_CLOCK_DRIFT_LIKELIHOOD_GAIN, _MIN_CLOCK_DRIFT_S = 50.0, 0.01
SignalPairs = list[tuple[Array, Array]]
"""Signal of the pose and of the IMU, for each sensor, see `signal_pairs_of_pose_and_imu`."""


def signal_pairs_of_pose_and_imu(t: Array, imu: Log, pose: Log, gyroscope: bool) -> SignalPairs:
    """Return (pose signal at `t`, IMU signal) of specific force, and of omega if `gyroscope`."""
    signals = list(zip(pose.motion, imu.motion, strict=True))[: 1 + gyroscope]
    return [(resample(t, pose.t, x), y) for x, y in signals]


def lag_of_imu_clock(
    t: Array, pairs: SignalPairs, t_imu: Array, max_lag_s: float, lever_effects: Array
) -> float:
    """Return the lag of the IMU's clock [s], within +-`max_lag_s`, with the best fit to the pose.

    The axes of the IMU may differ by any affine map. Components along `lever_effects` (N, k),
    accelerations due to a lever arm, are removed.
    """
    U, singular, _ = np.linalg.svd(lever_effects - lever_effects.mean(axis=0), full_matrices=False)
    U = U[:, singular > 1e-3 * singular[0]]

    def remove_arm_effects(x: Array) -> Array:
        return x - U @ (U.T @ x)

    expected, sensed = [remove_arm_effects(y) for y, _ in pairs], np.hstack([x for _, x in pairs])

    def unexplained_at_shift(shift: float) -> float:
        moved = remove_arm_effects(resample(t + shift, t_imu, sensed))
        parts = np.split(moved, len(expected), axis=1)
        return sum(_unexplained_share(y, x) for y, x in zip(expected, parts, strict=True))

    return search_minimum(unexplained_at_shift, 0.01, max_lag_s)[0]


def mid_record_lag_and_clock_drift(
    t: Array, pairs: SignalPairs, t_imu: Array, lag: float, num_independent: float
) -> tuple[float, float]:
    """Return the lag of the IMU's clock at mid-record [s], and its drift [s/s].

    `lag` [s] is a first estimate. An insignificant drift is 0.
    """
    tau = t - t.mean()
    found = np.array([lag, 0.0])
    start = cost = np.inf
    for step in range(10):
        rows, left, cost = [], [], 0.0
        for y, x in pairs:
            at = t + found[0] + found[1] * tau
            moved, h = resample(at, t_imu, x), 0.01
            rate = (resample(at + h, t_imu, x) - resample(at - h, t_imu, x)) / (2 * h)
            basis = np.column_stack([np.ones(len(t)), moved])
            Q = np.linalg.qr(basis)[0]
            mapped = np.linalg.lstsq(basis, y, rcond=1e-6)[0][1:]
            # Effects of a small shift that a change of the map cannot reproduce.
            effects = [rate @ mapped, tau[:, None] * (rate @ mapped)]
            size = np.sqrt(y.var(axis=0).sum() + 1e-12)
            rows.append(np.stack([(e - Q @ (Q.T @ e)).ravel() / size for e in effects], axis=1))
            left.append(((y - y.mean(axis=0)) - (moved - moved.mean(axis=0)) @ mapped) / size)
            cost += float(left[-1].var(axis=0).sum())
        if step == 0:
            start = cost
        residual = np.concatenate([r.ravel() for r in left])
        found = found + np.linalg.lstsq(np.vstack(rows), residual, rcond=1e-6)[0]
    gain = num_independent * np.log(start / (cost + 1e-300))
    total_drift_s = abs(found[1]) * float(t[-1] - t[0])
    if gain < _MIN_CLOCK_DRIFT_LIKELIHOOD_GAIN or total_drift_s < _MIN_CLOCK_DRIFT_S:
        return lag, 0.0
    return float(found[0]), float(found[1])


def _unexplained_share(y: Array, x: Array) -> float:
    """Return the share of the variance of y (N, 3) that no affine map of x explains."""
    y, x = y - y.mean(axis=0), x - x.mean(axis=0)
    both, total = x.T @ y, float((y * y).sum()) + 1e-12 * len(y)
    explained = (both * (np.linalg.pinv(x.T @ x, rcond=1e-12, hermitian=True) @ both)).sum()
    return float((y * y).sum() - explained) / total


_NUM_JACKKNIFE_BLOCKS = 20
# Directions with smaller singular values, relative to the largest, are undetermined.
MIN_SINGULAR_VALUE_RATIO = 1e-5
_MAX_RESIDUAL_EVALUATIONS = 15  # evaluations of the solver: valid records need six


def least_squares_with_deviations(
    residual: Callable[[Array], Array], x: Array
) -> tuple[Array, Array]:
    """Return the least-squares solution x (n,), and its standard deviations; inf if undetermined.

    `residual` maps x to residuals (N, 3 k); each group of three channels has one weight.
    """
    from scipy.optimize import least_squares

    def weighted_residual(z: Array, sigma: Array) -> Array:
        return (residual(z) / sigma).ravel()

    for _ in range(2):  # then with updated weights
        errors = residual(x)
        power = errors.reshape(len(errors), -1, 3).var(axis=(0, 2))
        sigma = np.repeat(np.sqrt(power + 1e-12 * power.max() + 1e-30), 3)
        found = least_squares(
            weighted_residual, x, x_scale="jac", max_nfev=_MAX_RESIDUAL_EVALUATIONS, args=(sigma,)
        )
        x = found.x
    width = errors.shape[1] * (len(errors) // _NUM_JACKKNIFE_BLOCKS)
    return x, jackknife_deviations(found.jac, found.fun, width)


def jackknife_deviations(jacobian: Array, residual: Array, width: int) -> Array:
    """Return jackknife standard deviations (n,) of the parameters, for blocks of `width` rows."""
    size = np.linalg.norm(jacobian, axis=0) + 1e-300
    _, singular, Vt = np.linalg.svd(jacobian / size, full_matrices=False)
    known = singular > MIN_SINGULAR_VALUE_RATIO * singular[0]
    basis = Vt[known].T
    J = (jacobian / size) @ basis
    gram, steps = J.T @ J, []
    for start in range(0, len(J) - width + 1, width):
        part, error = J[start : start + width], residual[start : start + width]
        steps.append(np.linalg.lstsq(gram - part.T @ part, part.T @ error, rcond=1e-12)[0])
    spread = (np.array(steps) - np.mean(steps, axis=0)) @ basis.T / size
    deviations = np.sqrt((len(steps) - 1) / len(steps) * np.sum(spread**2, axis=0))
    unknown = np.linalg.norm(Vt[~known], axis=0) > 1e-3
    return np.where(unknown, np.inf, deviations)


MAX_LEVER_ARM_DEVIATION_M = 0.005  # of a determined coordinate
MAX_UNEXPLAINED_IMU_SHARE = 0.05  # of the variance, for a valid fit
IMU_COMPARISON_CUTOFF_HZ, NUM_COMPARED_SAMPLES = 8.0, 1500
# Least signal-to-noise power ratio of the motion; the lever arm is at most 5 % too short.
_MIN_MOTION_OVER_NOISE_POWER = 20.0


@dataclass(frozen=True)
class LeverArm:
    """Estimated position of the accelerometer, as a correction.

    Attributes:
        p_SoIo_S: (3,) position minus `imu.position` of the log description, in S [m].
        deviations: (3,) standard deviations [m]; inf if undetermined.
        source: "pose" or "wrench".
    """

    p_SoIo_S: Array
    deviations: Array
    source: str

    @property
    def are_axes_determined(self) -> NDArray[np.bool_]:
        return self.deviations < MAX_LEVER_ARM_DEVIATION_M


def lever_arm_from_wrench(log: Log) -> LeverArm | None:
    """Return the accelerometer's position, Eq. (T21); None for a poor fit or few samples."""
    cutoff = min(IMU_COMPARISON_CUTOFF_HZ, 0.2 / log.dt)
    delay_s = alignment.estimate_delay(log, None) or 0.0
    smooth = low_pass_log(alignment.remove_delay(log, delay_s), cutoff)
    margin = min(0.1, 0.1 * float(smooth.t[-1] - smooth.t[0]))
    t = times_outside_gaps(smooth.t[0] + margin, smooth.t[-1] - margin, (smooth,), cutoff)
    if len(t) < NUM_COMPARED_SAMPLES // 10:
        return None
    wrench = resample(t, smooth.t, smooth.wrench)

    def residual_at(x: Array) -> Array:
        s, omega, alpha = (resample(t + x[3], smooth.t, signal) for signal in smooth.motion)
        s = s - lever_matrix(omega, alpha) @ x[:3]
        return contact_wrench(wrench, x[4:10], s, omega, alpha, x[10:])

    motion = [resample(t, smooth.t, signal) for signal in smooth.motion]
    V = regressor(*motion)
    size = np.linalg.norm(V - V.mean(axis=0), axis=(0, 1)) + 1e-12
    centred = ((V - V.mean(axis=0)) / size).reshape(-1, 10)
    target = (wrench - wrench.mean(axis=0)).ravel()
    phi = np.linalg.lstsq(centred, target, rcond=MIN_SINGULAR_VALUE_RATIO)[0] / size
    offsets = (wrench - V @ phi).mean(axis=0)
    start = np.concatenate([np.zeros(4), offsets, phi])
    x, deviations = least_squares_with_deviations(residual_at, start)
    left, whole = (y.var(axis=0).reshape(2, 3).sum(axis=1) for y in (residual_at(x), wrench))
    if (left > MAX_UNEXPLAINED_IMU_SHARE * whole).any():
        return None
    observable = are_lever_arm_axes_observable(lever_matrix(*motion[1:]), smooth, cutoff)
    return LeverArm(x[:3], np.where(observable, deviations[:3], np.inf), "wrench")


def times_outside_gaps(start: float, stop: float, logs: Sequence[Log], cutoff: float) -> Array:
    t = np.linspace(start, stop, NUM_COMPARED_SAMPLES)
    known = [
        np.interp(t, x.t, alignment.is_far_from_gaps(x, cutoff).astype(float)) > 0.99 for x in logs
    ]
    return t[np.all(known, axis=0)]


def lever_matrix(omega: Array, alpha: Array) -> Array:
    """Return K (N, 3, 3), Eq. (T20): K p is the acceleration of point p relative to the origin."""
    W = cross_matrix(omega)
    return cross_matrix(alpha) + W @ W


def are_lever_arm_axes_observable(K: Array, log: Log, cutoff: float) -> NDArray[np.bool_]:
    """Return (3,) True for axes along which accelerations K (N, 3, 3) determine a lever arm."""
    alpha = log.angular_acceleration
    wide, narrow = (alignment.low_pass(alpha, log.dt, x) for x in (2 * cutoff, cutoff))
    noise = (wide - narrow).var(axis=0) / 7
    K = K - K.mean(axis=0)
    information = np.einsum("nij,nik->jk", K, K) / len(K)
    alone = 1 / np.diag(np.linalg.pinv(information, rcond=1e-12, hermitian=True))
    return alone > _MIN_MOTION_OVER_NOISE_POWER * (noise.sum() - noise)


MAX_RIGHT_ANGLE_ERROR_DEG = 5.0  # of a right-angled mounting
MAX_ROTATION_DEVIATION_DEG = 1.0  # of a determined rotation
MAX_UNEXPLAINED_SHARE_WITHOUT_POSITIONS = 0.005
"""Limit for logs without positions, where unmodelled accelerations resemble a rotation."""
_MAX_IMU_LAG_S = 1.0


@dataclass(frozen=True)
class Mounting:
    """Mounting of an IMU relative to the pose.

    Attributes:
        R_SI: (3, 3) rotation from the IMU axes of the log description to S.
        lag_s: best constant lag of the IMU's clock behind the pose's, even with drift [s].
        mid_record_lag_s, mid_record_time_s: lag at mid-record, and this time on the pose's clock
            [s].
        clock_drift: growth of the lag [s/s]; 0 if insignificant.
        unexplained, unexplained_omega: unexplained shares of the variance of specific
            force and angular velocity (None without a gyroscope).
        is_mirrored: True if a reflection fits clearly better, so that R_SI is invalid.
        speed_ratio: angular speed of gyroscope over pose (RMS); None if the pose hardly rotates.
        deviations_deg: (3,) standard deviations of R_SI about the axes of S [deg].
        lever_arm: position of the accelerometer; None without positions.
    """

    R_SI: Array
    lag_s: float
    mid_record_lag_s: float
    mid_record_time_s: float
    clock_drift: float
    unexplained: float
    unexplained_omega: float | None
    is_mirrored: bool
    speed_ratio: float | None
    deviations_deg: Array
    lever_arm: LeverArm | None

    @property
    def rotation_angle_deg(self) -> float:
        return rotation_angle_deg(self.R_SI)

    @property
    def nearest_right_angled_rotation(self) -> Array:
        """Rotation (3, 3) nearest to R_SI, of the 24 that map axes to axes."""
        return max(right_angled_rotations(), key=lambda R: float(np.trace(R.T @ self.R_SI)))

    @property
    def angle_to_right_angled_deg(self) -> float:
        return rotation_angle_deg(self.nearest_right_angled_rotation.T @ self.R_SI)

    @property
    def is_right_angled(self) -> bool:
        return self.angle_to_right_angled_deg < MAX_RIGHT_ANGLE_ERROR_DEG

    @property
    def fits_pose(self) -> bool:
        """Whether IMU and pose agree, with small unexplained shares."""
        omega = self.unexplained_omega
        if self.is_mirrored or (omega is not None and omega >= MAX_UNEXPLAINED_IMU_SHARE):
            return False
        if self.lever_arm is not None:
            return self.unexplained < MAX_UNEXPLAINED_IMU_SHARE
        # Without positions the pose determines the angular velocity, but not the acceleration.
        return omega is not None or self.unexplained < MAX_UNEXPLAINED_SHARE_WITHOUT_POSITIONS

    @property
    def is_determined(self) -> bool:
        """Whether `fits_pose` is True and R_SI known to 1 deg about every axis."""
        return self.fits_pose and bool((self.deviations_deg < MAX_ROTATION_DEVIATION_DEG).all())


def find_mounting(imu: Log, pose: Log, *, has_position: bool = False) -> Mounting | None:
    """Estimate rotation, clock and (with `has_position`) accelerometer position of an IMU.

    `pose` is the same log as `imu`, read without the IMU. Lags are within +-1 s. Return None if
    the specific force changes by less than 0.5 m/s^2 (RMS), or gaps leave too few samples.
    """
    start, stop = max(imu.t[0], pose.t[0]), min(imu.t[-1], pose.t[-1])
    max_lag_s = min(_MAX_IMU_LAG_S, 0.2 * float(stop - start))
    cutoff = min(IMU_COMPARISON_CUTOFF_HZ, 0.2 / imu.dt)
    sensed, smooth = low_pass_log(imu, cutoff), low_pass_log(pose, cutoff)
    t = times_outside_gaps(start + max_lag_s, stop - max_lag_s, (imu, pose), cutoff)
    if len(t) < NUM_COMPARED_SAMPLES // 10:
        return None
    # Without a gyroscope both readings contain the angular velocity of the pose.
    omega_imu, omega = (resample(t, log.t, log.angular_velocity) for log in (imu, pose))
    gyroscope = not np.allclose(omega_imu, omega, atol=1e-9)
    pairs = signal_pairs_of_pose_and_imu(t, sensed, smooth, gyroscope)
    expected = pairs[0][0]
    if expected.var(axis=0).sum() < 0.25:
        return None
    # Without a gyroscope, a long lever arm resembles a lag, so its effects are removed.
    arm = np.zeros((len(t), 1))
    if not gyroscope:
        omega, alpha = (resample(t, pose.t, x) for x in smooth.motion[1:])
        arm = lever_matrix(omega, alpha).reshape(-1, 9)
    lag = lag_of_imu_clock(t, pairs, imu.t, max_lag_s, arm)
    centre = float(t.mean())
    num_independent = 2 * cutoff * float(t[-1] - t[0])
    middle, drift = mid_record_lag_and_clock_drift(t, pairs, imu.t, lag, num_independent)
    shifted = resample(t + middle + drift * (t - centre), imu.t, pairs[0][1])
    R, mirrored = _kabsch_rotation_and_is_mirrored(shifted, expected)

    # The estimated lag allows the use of more samples.
    margin = min(max_lag_s, abs(middle) + 0.5 * abs(drift) * float(stop - start) + 0.1)
    t = times_outside_gaps(start + margin, stop - margin, (imu, pose), cutoff)
    pairs = signal_pairs_of_pose_and_imu(t, sensed, smooth, gyroscope)
    pose_omega = resample(t, pose.t, smooth.angular_velocity)
    K = lever_matrix(pose_omega, resample(t, pose.t, smooth.angular_acceleration))

    x, deviations, left = _refine_mounting(t, drift * (t - centre), imu.t, pairs, K, R, middle)
    lever = None
    if has_position:
        observable = are_lever_arm_axes_observable(K, pose, cutoff)
        lever = LeverArm(x[4:7], np.where(observable, deviations[4:7], np.inf), "pose")
    powers = left.reshape(len(t), -1, 3).var(axis=0).sum(axis=1)
    shares = [float(part / y.var(axis=0).sum()) for part, (y, _) in zip(powers, pairs, strict=True)]
    speeds = [float(np.linalg.norm(log.angular_velocity, axis=1).std()) for log in (imu, pose)]
    return Mounting(
        R_SI=_rotate_about_fixed_axes(R, x[:3]),
        lag_s=lag if drift else float(x[3]),
        mid_record_lag_s=float(x[3]),
        mid_record_time_s=centre,
        clock_drift=drift,
        unexplained=shares[0],
        unexplained_omega=shares[1] if len(shares) > 1 else None,
        is_mirrored=mirrored,
        speed_ratio=speeds[0] / speeds[1] if speeds[1] > 0.05 else None,
        deviations_deg=np.degrees(deviations[:3]),
        lever_arm=lever,
    )


def _refine_mounting(
    t: Array, drift_lag: Array, t_imu: Array, pairs: SignalPairs, K: Array, R: Array, lag: float
) -> tuple[Array, Array, Array]:
    known, moving = (np.stack(signals, axis=1) for signals in zip(*pairs, strict=True))

    def pose_residual(x: Array) -> Array:
        resampled = resample(t + x[3] + drift_lag, t_imu, moving).reshape(-1, 3)
        rotated = resampled @ _rotate_about_fixed_axes(R, x[:3]).T
        left = rotated.reshape(known.shape) - known
        left[:, 0] -= K @ x[4:7]
        return left.reshape(len(t), -1) + x[7:]

    first = np.zeros(7 + 3 * len(pairs))
    first[3] = lag
    first[7:] = -pose_residual(first).mean(axis=0)
    x, deviations = least_squares_with_deviations(pose_residual, first)
    return x, deviations, pose_residual(x)


def _kabsch_rotation_and_is_mirrored(x: Array, y: Array) -> tuple[Array, bool]:
    """Return the R that minimises |y - R x - b|, and whether a reflection fits clearly better."""
    x, y = x - x.mean(axis=0), y - y.mean(axis=0)
    U, _, Vt = np.linalg.svd(y.T @ x)
    side = np.linalg.det(U @ Vt)
    R, mirror = U @ np.diag([1.0, 1.0, side]) @ Vt, U @ np.diag([1.0, 1.0, -side]) @ Vt
    direct, reflected = (((y - x @ M.T) ** 2).sum() / (y**2).sum() for M in (R, mirror))
    return R, bool(reflected < 0.25 * direct and reflected < 0.05)


def _rotate_about_fixed_axes(R: Array, vector: Array) -> Array:
    return rotation_matrices(vector[None], "rotation_vector")[0] @ R


def rotation_angle_deg(R: Array) -> float:
    return float(np.degrees(np.arccos(np.clip((np.trace(R) - 1) / 2, -1, 1))))
