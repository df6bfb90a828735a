"""Correction of an IMU's bias, axes and clock by splines of poses, Eqs. (T82), (T83)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.numeric import Array
from drake_teleop.logs.pose_motion.poses import ImuData
from drake_teleop.logs.pose_motion.spectra import ComplexArray, end_taper, exclude_from_taper
from drake_teleop.logs.pose_motion.splines import ImuSplineRows, PoseSplines

_GAIN_ERROR_PRIOR_STD, _MAX_GAIN_ERROR = 0.1, 0.2
_SENSOR_FIT_STEPS, _MAX_IMU_SHIFT_S, _NOISE_POWER_STEPS, _MIN_NOISE_FREQUENCIES = 4, 0.1, 10, 40
# Share of 1 / h that splines pass, and largest unexplained share of the motion.
_COMPARED_FREQUENCY_OVER_KNOT_RATE, _MAX_RESIDUAL_OVER_MOTION_POWER = 0.25, 0.05
# Rates of comparison and of added rows [Hz], and least length of a comparison [s].
_COMPARED_IMU_RATE_HZ, _ADDED_IMU_ROWS_RATE_HZ, _MIN_COMPARED_DURATION_S = 125.0, 500.0, 2.0


@dataclass(frozen=True, eq=False)
class _ImuSensorModel:
    """Sensor model y = bias + (1 + gain_errors) x(t + time_shift_s) for the motion x."""

    gain_errors: Array
    bias: Array
    time_shift_s: float
    noise_power: float

    def correct_bias_and_gain(self, y: Array) -> Array:
        return np.linalg.solve(np.eye(3) + self.gain_errors, (y - self.bias).T).T


def correct_imu_data(splines: PoseSplines, imu: ImuData, gravity_W: Array) -> ImuSplineRows | None:
    """Return IMU data with bias, axes and clock corrected to splines; None if they disagree."""
    position_std, rotation_std = splines.estimate_pose_noise()
    powers = position_std**2 / splines.rate, rotation_std**2 / splines.rate
    averaged = imu.average_to_rate(_COMPARED_IMU_RATE_HZ)
    sensors = {
        index: _fit_sensor_model(splines, averaged.t, y, gravity_W, index, powers[index])
        for index, y in enumerate((averaged.specific_force, averaged.angular_velocity))
        if y is not None
    }
    found = {index: sensor for index, sensor in sensors.items() if sensor is not None}
    if not found or len(found) < len(sensors):
        return None
    rows = imu.average_to_rate(_ADDED_IMU_ROWS_RATE_HZ)
    t = rows.t + found[max(found)].time_shift_s  # the gyroscope determines the clock best
    inside = (t > splines.poses.t[0]) & (t < splines.poses.t[-1])
    s, omega = (
        found[index].correct_bias_and_gain(y[inside]) if index in found and y is not None else None
        for index, y in enumerate((rows.specific_force, rows.angular_velocity))
    )
    own = tuple(found[index].noise_power if index in found else 0.0 for index in range(2))
    imu_rows = ImuSplineRows(t[inside], rows.rate, powers, (own[0], own[1]))
    imu_rows = imu_rows.with_sensor_data_in_world_axes(splines, gravity_W, s, omega)
    both = PoseSplines(splines.poses, splines.spacing, imu_rows)
    return imu_rows.with_sensor_data_in_world_axes(both, gravity_W, s, omega)


def _fit_sensor_model(
    splines: PoseSplines,
    t: Array,
    y: Array,
    gravity_W: Array,
    sensor_index: int,
    pose_noise_power: float,
) -> _ImuSensorModel | None:
    """Fit a model of accelerometer (0) or gyroscope (1) data y (K, 3); None for a poor fit."""
    dt = float(np.median(np.diff(t)))
    place = np.round((t - t[0]) / dt).astype(int)
    even = t[0] + dt * np.arange(place[-1] + 1)
    lost, values = np.ones(len(even), bool), np.zeros((len(even), 3))
    lost[place], values[place] = False, y
    start, stop = max(t[0], splines.poses.t[0]), min(t[-1], splines.poses.t[-1])
    ends = start + _MAX_IMU_SHIFT_S, stop - _MAX_IMU_SHIFT_S
    taper = exclude_from_taper(end_taper(even, *ends), lost, dt)
    if (taper > 0.5).sum() * dt < _MIN_COMPARED_DURATION_S:
        return None
    frequency = np.fft.rfftfreq(len(even), dt)
    used = frequency <= _COMPARED_FREQUENCY_OVER_KNOT_RATE / splines.spacing
    omega: NDArray[np.floating] = 2.0 * np.pi * frequency[used]
    noise = pose_noise_power * omega ** (4 - 2 * sensor_index)
    energy = float(np.sum(taper**2)) / dt

    def tapered_spectrum(x: Array) -> ComplexArray:
        return np.asarray(np.fft.rfft(x * taper[:, None], axis=0)[used], np.complex128)

    # Third differences remove the motion; the squares of 1, 3, 3, 1 add up to 20.
    least = float(np.mean(np.diff(y, 3, axis=0) ** 2)) * dt / 20.0 + 1e-30
    Y = tapered_spectrum(values)
    ones = tapered_spectrum(np.ones((len(even), 1)))
    tau, power = 0.0, least
    for step in range(_SENSOR_FIT_STEPS):
        x = splines.motion(even + tau, gravity_W)[sensor_index]
        X, change = tapered_spectrum(x), tapered_spectrum(np.gradient(x, dt, axis=0))
        if step == 0:
            power = max(power, float(np.median(np.abs(Y - X) ** 2)) / energy)
        weight = 1.0 / np.sqrt(energy * (noise + power))
        D, b, shift = _fit_imu_gain_errors_bias_and_shift(Y - X, X, ones, change, weight)
        residual: Array = np.abs(Y - X - X @ D.T - ones * b - shift * change) ** 2
        power = _estimate_imu_noise_power(residual.sum(axis=1) / (3.0 * energy), noise, least)
        tau += shift
        if abs(tau) > _MAX_IMU_SHIFT_S:
            return None
    limit = _MAX_RESIDUAL_OVER_MOTION_POWER * (np.abs(X[1:]) ** 2).sum()
    if np.abs(D).max() > _MAX_GAIN_ERROR or residual[1:].sum() > limit:
        return None
    return _ImuSensorModel(D, b, tau, power)


def _fit_imu_gain_errors_bias_and_shift(
    y: ComplexArray, X: ComplexArray, ones: ComplexArray, X_rate: ComplexArray, weight: Array
) -> tuple[Array, Array, float]:
    K = len(y)
    columns = np.zeros((K, 3, 13), complex)
    for i in range(3):
        columns[:, i, 3 * i : 3 * i + 3] = X
        columns[:, i, 9 + i] = ones[:, 0]
    columns[:, :, 12] = X_rate
    A = (columns * weight[:, None, None]).reshape(3 * K, 13)
    right = (y * weight[:, None]).ravel()
    gram = (A.conj().T @ A).real
    gram[range(9), range(9)] += 1.0 / _GAIN_ERROR_PRIOR_STD**2
    found = np.linalg.solve(gram, (A.conj().T @ right).real)
    return found[:9].reshape(3, 3), found[9:12], float(found[12])


def _estimate_imu_noise_power(
    residual_power: NDArray[np.floating], pose_noise_power: NDArray[np.floating], min_power: float
) -> float:
    power = max(float(np.median(residual_power)), min_power)
    for _ in range(_NOISE_POWER_STEPS):
        weight = 1.0 / (power + pose_noise_power) ** 2
        power = max(float(weight @ (residual_power - pose_noise_power) / weight.sum()), min_power)
    effective = float(np.sum((min_power / (min_power + pose_noise_power)) ** 2))
    return power if effective > _MIN_NOISE_FREQUENCIES else min_power
