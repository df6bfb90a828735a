"""Noise spectrum and Allan deviation of the wrist sensor at rest, predicted and measured.

White noise of variance sigma^2 per raw sample; rounding to a quantum q, which is white with q^2/12
if sigma is at least q/2; random walk K sqrt(t). With sampling period T and low-pass H after the
converter, the one-sided spectral density is

    S(f) = |H(f)|^2 (2 T (sigma^2 + q^2/12) + 2 K^2 T^2 / (2 sin(pi f T))^2)

The squared Allan deviation at m T is the integral of S(f) 2 sin^4(pi f m T) / (m sin(pi f T))^2:
sigma / sqrt(m) for white noise, K sqrt(m T / 3) for a random walk.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from drake_teleop.station.sensor.sensor_chain import (
    NOISE_BLOCK_SIZE,
    SAMPLES_PER_NOISE_BLOCK,
    WristSensorConfig,
    butterworth_sections,
    initialize_sensor_chain,
    read_sensor_into,
)

_CHANNELS = 12
_FILTER_LENGTHS = 32  # decay of the impulse response, in 1 / bandwidth


def spectral_density(
    config: WristSensorConfig, frequency: ArrayLike, period: float
) -> NDArray[np.float64]:
    """Return the one-sided power spectral density of the 12 channels at rest.

    Args:
        config: the sensor.
        frequency: (m,) above zero, to half the sampling rate [Hz].
        period: sampling period [s].

    Returns:
        (12, m) in N^2/Hz, (N m)^2/Hz, (m/s^2)^2/Hz, (rad/s^2)^2/Hz.
    """
    white, walk = _powers(config)
    f = np.asarray(frequency, float)
    densities = np.outer(white, 2 * period * np.ones_like(f))
    densities += np.outer(walk, 2 * period**2 / (2 * np.sin(np.pi * f * period)) ** 2)
    return densities * _gain(config, f, period)


def predicted_allan_deviation(
    config: WristSensorConfig, samples: ArrayLike, period: float
) -> NDArray[np.float64]:
    """Return the Allan deviation (12, m) of the channels at rest, without drift.

    Args:
        config: the sensor.
        samples: (m,) averaging times, in samples.
        period: sampling period [s].
    """
    white, walk = _powers(config)
    lengths = np.asarray(samples, int)
    deviations = np.empty((_CHANNELS, len(lengths)))
    for column, m in enumerate(lengths):
        # The impulse response is finite, so the integral is a finite sum (Parseval), on odd
        # multiples of half the spacing because the walk has a pole at zero.
        count = 2 * m + int(np.ceil(_FILTER_LENGTHS / (config.bandwidth_hz * period)))
        f = (np.arange(count) + 0.5) / (2 * count * period)
        sine2 = np.sin(np.pi * f * period) ** 2
        weight = 2 * np.sin(np.pi * f * m * period) ** 4 / (m**2 * sine2)
        weight *= _gain(config, f, period) / count
        variance = white * weight.sum() + walk * period * (weight / (4 * sine2)).sum()
        deviations[:, column] = np.sqrt(variance)
    return deviations


def allan_deviation(record: NDArray[np.float64], samples: ArrayLike) -> NDArray[np.float64]:
    """Return the overlapping Allan deviation (channels, m) of a record.

    Args:
        record: (N, channels) samples at a constant rate.
        samples: (m,) averaging times in samples, each at most N / 2.
    """
    start = np.zeros((1, record.shape[1]))
    sums = np.concatenate([start, np.cumsum(record - record.mean(axis=0), axis=0)])
    lengths = np.asarray(samples, int)
    deviations = np.empty((record.shape[1], len(lengths)))
    for column, m in enumerate(lengths):
        steps = (sums[2 * m :] - 2 * sums[m:-m] + sums[: -2 * m]) / m
        deviations[:, column] = np.sqrt(0.5 * np.mean(steps**2, axis=0))
    return deviations


def rest_record(
    config: WristSensorConfig, count: int, period: float, seed: int
) -> NDArray[np.float64]:
    """Return (count, 12) readings of a sensor without load at rest under gravity.

    Args:
        config: the sensor.
        count: samples.
        period: sampling period [s].
        seed: of the noise.
    """
    constants, memory = initialize_sensor_chain(config, 1, period)
    truth = np.zeros(16)
    truth[8] = 9.81
    noise = np.random.default_rng(seed).standard_normal(
        (-(-count // SAMPLES_PER_NOISE_BLOCK), NOISE_BLOCK_SIZE)
    )
    record = np.empty((count, _CHANNELS))
    _record_into(constants, memory, noise, truth, record)
    return record


@njit
def _record_into(constants, memory, noise, truth, record):
    reading = np.empty(14)
    for k in range(record.shape[0]):
        read_sensor_into(constants, memory, noise[k // SAMPLES_PER_NOISE_BLOCK], truth, reading)
        record[k] = reading[:12]


def _powers(config: WristSensorConfig) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (12,) variances of a raw sample, and of a walk after 1 s."""
    if config.ideal:
        return np.zeros(_CHANNELS), np.zeros(_CHANNELS)
    quantum = config.resolution * config.ranges()
    return config.noise_std() ** 2 + quantum**2 / 12, config.random_walk() ** 2


def _gain(
    config: WristSensorConfig, f: NDArray[np.float64], period: float
) -> NDArray[np.float64] | float:
    """Return |H|^2 between noise and reading."""
    if config.low_pass != "after_converter":
        return 1.0
    z = np.exp(-2j * np.pi * f * period)
    gain = np.ones_like(f)
    for b0, b1, b2, a1, a2 in butterworth_sections(config.bandwidth_hz, 1 / period):
        gain *= np.abs((b0 + z * (b1 + z * b2)) / (1 + z * (a1 + z * a2))) ** 2
    return gain
