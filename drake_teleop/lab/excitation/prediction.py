"""Predicted standard deviations of identified offsets and load after an excitation (T46).

Gain errors, delay, thermal drift and rounding of encoders are not included.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from drake_teleop.common.numeric import Array
from drake_teleop.common.vectors import cross_matrix
from drake_teleop.load.inertia import inertia_about_origin
from drake_teleop.load.regressor import regressor
from drake_teleop.station.sensor.motion_estimation import MotionEstimationConfig, fusion_gains
from drake_teleop.station.sensor.sensor_chain import WristSensorConfig


class SensorNoise(NamedTuple):
    """Noise of the 12 channels [f, tau, s, alpha] and its filters.

    Attributes:
        assumed_wrench_std: (6,) deviations that weight the wrench in the estimator [N, N m].
        white_noise_densities: (12,) two-sided spectral densities of white noise [unit^2 s].
        random_walk_variances: (12,) random walks: variance per second [unit^2 / s].
        p_SoAo_S: (3,) position of the accelerometer [m].
        motion_error_filters: transfer functions (numerator, denominator) from the noise of s
            and of alpha to the estimates; None without accelerometer.
    """

    assumed_wrench_std: Array
    white_noise_densities: Array
    random_walk_variances: Array
    p_SoAo_S: Array
    motion_error_filters: tuple[tuple[Array, Array], tuple[Array, Array]] | None


def sensor_noise(
    sensor: WristSensorConfig, estimation: MotionEstimationConfig, num_joints: int, period_s: float
) -> SensorNoise:
    std = np.concatenate([sensor.wrench_std(), sensor.motion_std()[[0, 1, 2, 6, 7, 8]]])
    walk = np.zeros(12) if sensor.ideal else sensor.random_walk()
    filters = None
    if estimation.source == "accelerometer":
        filters = (np.ones(1), np.ones(1)), (np.ones(1), np.ones(1))
    elif estimation.source == "fused":
        angular, linear = fusion_gains(estimation, sensor, num_joints, period_s)
        polynomials = _motion_error_transfer_function
        filters = polynomials(linear, period_s), polynomials(angular, period_s)
    place = sensor.accelerometer_pose()[0]
    return SensorNoise(sensor.wrench_std(), std**2 * period_s, walk**2, place, filters)


def predicted_deviations(
    s: Array, omega: Array, alpha: Array, step: float, noise: SensorNoise, phi: Array
) -> Array:
    return np.sqrt(np.diag(predicted_covariance(s, omega, alpha, step, noise, phi)))


def predicted_covariance(
    s: Array, omega: Array, alpha: Array, step: float, noise: SensorNoise, phi: Array
) -> Array:
    """Return the covariance (16, 16) of identified offsets and phi after s, omega, alpha (T, 3).

    `step` is the sample period [s], `phi` (10,) the true load.
    """
    rows = np.concatenate([np.tile(np.eye(6), (len(s), 1, 1)), regressor(s, omega, alpha)], axis=2)
    weighted = rows / noise.assumed_wrench_std[:, np.newaxis] ** 2
    gram = np.einsum("tci,tcj->ij", rows, weighted)
    # Balance before inversion: the columns have different units.
    size = np.sqrt(np.diag(gram))
    inverse = np.linalg.inv(gram / np.outer(size, size)) / np.outer(size, size)
    influence = np.zeros((len(s), 12, 16))
    influence[:, :6] = weighted @ inverse
    if noise.motion_error_filters is not None:
        of_s, of_alpha = noise.motion_error_filters
        of_motion = -spatial_inertia_matrix(phi) @ influence[:, :6]
        through_s = _filter_backwards(of_s, of_motion[:, :3], step)
        # s of So = s of Ao + p_SoAo x alpha.
        through_alpha = of_motion[:, 3:] + cross_matrix(noise.p_SoAo_S).T @ through_s
        influence[:, 6:9] = through_s
        influence[:, 9:] = _filter_backwards(of_alpha, through_alpha, step)
    # A step of a random walk affects all later samples.
    later = np.cumsum(influence[::-1], axis=0)
    of_white = _covariance_from_noise_influence(influence, noise.white_noise_densities) / step
    return of_white + _covariance_from_noise_influence(later, noise.random_walk_variances) * step


def _covariance_from_noise_influence(influence: Array, variances: Array) -> Array:
    rows = (influence * np.sqrt(variances)[:, np.newaxis]).reshape(-1, influence.shape[2])
    return rows.T @ rows


def _motion_error_transfer_function(gains: Array, period: float) -> tuple[Array, Array]:
    denominator = np.array([1.0, *(gains / period)])
    return denominator * [1.0, 1.0, 1.0, 0.0], denominator


def _filter_backwards(polynomials: tuple[Array, Array], signals: Array, step: float) -> Array:
    # Imported late: slower than the station's import.
    from scipy.signal import bilinear, lfilter

    b, a = bilinear(*polynomials, fs=1 / step)
    return np.asarray(lfilter(b, a, signals[::-1], axis=0)[::-1])


def spatial_inertia_matrix(phi: Array) -> Array:
    """Return the matrix (6, 6) that maps [s, alpha] of the sensor to the wrench of load phi."""
    moment = cross_matrix(phi[1:4])
    return np.block([[phi[0] * np.eye(3), -moment], [moment, inertia_about_origin(phi)]])
