"""Wrist sensor as a chain from truth to readings (long: one file for parameters and chain)::

    wrench at So in S        -> calibration errors ----.
    motion of S -> moved to Ao, turned into A          |
                             -> calibration errors ----+-> [low-pass] -> white noise + random walk
                -> offset + drift -> quantisation -> saturation -> [low-pass] -> latency of its path
    joints' angles           -> quantisation --------------------------------> latency of its path

The accelerometer with origin Ao and axes A measures specific force and angular acceleration. The
low-pass is analog or mechanical (`before_noise`), or digital as in the JR3 (`after_converter`).
"""

import copy
import dataclasses
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.blocks import LARGEST_PORT_VALUE
from drake_teleop.common.compiled import njit
from drake_teleop.common.config import choice, plain, quantity, settings
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array, Records, pack_for_compiled_code
from drake_teleop.common.vectors import (
    add_cross_product,
    apply_matrix,
    copy_into,
    cross,
    cross_matrix,
    matrix_as_tuple,
    vector_at,
)
from drake_teleop.load.regressor import (
    ANGULAR_ACCELERATION_SLICE,
    ANGULAR_VELOCITY_SLICE,
    SPECIFIC_FORCE_SLICE,
    WRENCH_SLICE,
)

#: Samples per block of random numbers: one event of a noise source, one step of a walk.
SAMPLES_PER_NOISE_BLOCK = 128
_NUM_NOISY_CHANNELS = 12
#: Standard normal numbers of a block: 12 for each sample, then 12 for the random walks.
NOISE_BLOCK_SIZE = _NUM_NOISY_CHANNELS * (SAMPLES_PER_NOISE_BLOCK + 1)

#: Samples for which a lost sample stays flagged, so that the log contains the flag.
NUM_FLAGGED_SAMPLES_AFTER_LOSS = 40

#: Keys of `drake_teleop.station.sensor.presets.PRESETS`.
PRESET_NAMES = (
    *("ideal", "jr3_85m35a3", "ati_gamma_imu", "ati_mini45", "bota_sensone", "bota_rokubi"),
    *("robotiq_ft300", "onrobot_hex_e", "ur5e_built_in", "franka_estimated"),
)
_LOW_PASS_STAGES = ("none", "before_noise", "after_converter")
_NUM_LOW_PASS_SECTIONS = 2  # second-order sections of the fourth-order low-pass
_MAX_ORTHOGONALITY_ERROR_OF_R_SA = 1e-6
_OVERLOAD_TO_RANGE_RATIO = 10.0
# The low-pass overshoots by 11 % of a step, which may be two ranges.
_MAX_SATURATED_READING_TO_RANGE_RATIO = 1.5


@settings
@dataclass
class WristSensorConfig:
    """Force/torque sensor with accelerometers; the defaults are the paper's, `jr3_85m35a3`."""

    preset: str = field(
        default="custom",
        init=False,
        compare=False,
        metadata={
            "choices": ("custom", *PRESET_NAMES),
            "doc": "sensor whose figures replace missing fields in a file; custom: the "
            'defaults. In Python: `dataclasses.replace(PRESETS["ati_gamma_imu"], force_noise=0.1)`',
            "in_python": "set wrist_sensor = drake_teleop.station.sensor.presets.PRESETS[name]",
        },
    )
    ideal: bool = plain(False, "no sensor errors: true values in sensor frame S, without delay")

    gain_error: float = quantity(0.0, "1", 0.0, 0.1, "largest gain error of force and torque")
    cross_talk: float = quantity(0.0, "1", 0.0, 0.1, "largest cross-talk, share of full range")
    misalignment: float = quantity(0.0, "rad", 0.0, 0.2, "rotation error of the wrench axes from S")
    acceleration_gain_error: float = quantity(0.0, "1", 0.0, 0.1, "largest acceleration gain error")
    acceleration_misalignment: float = quantity(0.0, "rad", 0.0, 0.2, "rotation error of axes A")
    unit: int = quantity(0, "1", 0, 2**32 - 1, "unit number, seed of the calibration errors")

    p_SoAo_S: list[float] = quantity([0.0, 0.0, 0.0175], "m", -1.0, 1.0, "accelerometer position")
    R_SA: list[float] = quantity(
        [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0], "1", -1.0, 1.0, "accelerometer axes by rows"
    )

    low_pass: str = choice("after_converter", _LOW_PASS_STAGES, "low-pass position in the chain")
    bandwidth_hz: float = quantity(500.0, "Hz", 1.0, 1e5, "4th-order Butterworth low-pass")

    force_noise: float = quantity(0.25, "N", 0.0, 100.0, "white noise of raw samples, 1 sigma")
    torque_noise: float = quantity(0.012, "N m", 0.0, 10.0, "white noise of raw samples, 1 sigma")
    acceleration_noise: float = quantity(0.06, "m/s^2", 0.0, 100.0, "white noise, 1 sigma")
    angular_acceleration_noise: float = quantity(1.5, "rad/s^2", 0.0, 1e3, "white noise, 1 sigma")
    force_walk: float = quantity(0.002, "N/sqrt(s)", 0.0, 10.0, "random walk")
    torque_walk: float = quantity(4e-5, "N m/sqrt(s)", 0.0, 1.0, "random walk")
    acceleration_walk: float = quantity(6e-4, "m/s^2/sqrt(s)", 0.0, 10.0, "random walk")
    angular_acceleration_walk: float = quantity(0.015, "rad/s^2/sqrt(s)", 0.0, 100.0, "random walk")

    offset: list[float] = quantity(
        [6.2, -3.9, 8.1, 0.31, -0.42, 0.12], "N, N m", -100.0, 100.0, "offset, Eq. (7)"
    )
    drift: list[float] = quantity(
        [4e-4, -3e-4, 8.3e-4, 2e-5, -2e-5, 1e-5], "N/s, N m/s", -10.0, 10.0, "thermal offset drift"
    )
    acceleration_offset: list[float] = quantity(
        [0.0] * 6, "m/s^2, rad/s^2", -100.0, 100.0, "offset of specific force, angular acceleration"
    )

    resolution: float = quantity(2.5e-4, "1", 0.0, 0.1, "quantum as a fraction of the range")
    encoder_resolution: float = quantity(1.745e-5, "rad", 0.0, 0.1, "resolver step, 0.001 deg")

    saturates: bool = plain(True, "readings are limited to the ranges and flagged by `saturated`")
    force_range: list[float] = quantity([200.0, 200.0, 400.0], "N", 1.0, 1e5, "force range x, y, z")
    torque_range: list[float] = quantity([12.0] * 3, "N m", 0.01, 1e4, "torque range x, y, z at So")
    acceleration_range: float = quantity(50.0, "m/s^2", 1.0, 1e4, "range of each axis")
    angular_acceleration_range: float = quantity(500.0, "rad/s^2", 1.0, 1e5, "range of each axis")

    force_latency: float = quantity(0.0, "s", 0.0, 0.1, "force and torque latency, whole samples")
    acceleration_latency: float = quantity(0.0, "s", 0.0, 0.1, "latency, rounded to whole samples")
    encoder_latency: float = quantity(0.0, "s", 0.0, 0.1, "encoder latency, whole samples")

    def noise_std(self) -> Array:
        """Return standard deviations (12,) of white noise in raw samples, ordered as `ranges`."""
        return np.repeat([getattr(self, name) for name in DISABLED_PART_VALUES["noise"]], 3)

    def random_walk(self) -> Array:
        """Return standard deviations (12,) of random walks after 1 s, ordered as `ranges`."""
        return np.repeat([getattr(self, name) for name in DISABLED_PART_VALUES["random_walk"]], 3)

    def ranges(self) -> Array:
        """Return ranges (12,) of force, torque, specific force, angular acceleration [SI units]."""
        motion = [self.acceleration_range] * 3 + [self.angular_acceleration_range] * 3
        return np.array([*self.force_range, *self.torque_range, *motion], np.float64)

    def largest_plausible_wrench(self) -> Array:
        """Return the largest plausible absolute readings (6,) of force and torque [N, N m]."""
        limited = self.saturates and not self.ideal
        factor = _MAX_SATURATED_READING_TO_RANGE_RATIO if limited else _OVERLOAD_TO_RANGE_RATIO
        return factor * self.ranges()[:6]

    def wrench_std(self) -> Array:
        """Return standard deviations (6,) of noise and quantisation of the wrench [N, N m]."""
        quantum = self.resolution * self.ranges()[:6]
        return np.maximum(np.hypot(self.noise_std()[:6], quantum / np.sqrt(12)), 1e-6)

    def motion_std(self) -> Array:
        """Return standard deviations (9,) of specific force, omega (0: exact), alpha [SI units]."""
        quantum = self.resolution * self.ranges()[6:]
        std = np.hypot(self.noise_std()[6:], quantum / np.sqrt(12))
        return np.concatenate([std[:3], np.zeros(3), std[3:]])

    def accelerometer_pose(self) -> tuple[Array, Array]:
        """Return position p_SoAo_S (3,) [m] and axes R_SA (3, 3) of the accelerometer."""
        if self.ideal:
            return np.zeros(3), np.eye(3)
        return np.array(self.p_SoAo_S), np.reshape(self.R_SA, (3, 3))

    def latency_samples(self, period: float) -> NDArray[np.int64]:
        """Return the latencies (3,) of wrench, acceleration and encoders, in whole samples."""
        seconds = (self.force_latency, self.acceleration_latency, self.encoder_latency)
        return np.rint(np.array(seconds) * (not self.ideal) / period).astype(np.int64)

    def reading_delays(self, period: float) -> Array:
        """Return the delays (3,) of wrench, acceleration and encoder readings [s]."""
        delays = self.latency_samples(period) * np.float64(period)
        if not self.ideal and self.low_pass != "none":
            for section in butterworth_sections(self.bandwidth_hz, 1 / period):
                delays[:2] += group_delay_samples(section) * period
        return delays

    def check(self, where: str, rate_hz: float) -> None:
        R_SA = np.reshape(self.R_SA, (3, 3))
        error = np.abs(R_SA @ R_SA.T - np.eye(3)).max()
        if error > _MAX_ORTHOGONALITY_ERROR_OF_R_SA or np.linalg.det(R_SA) < 0:
            what = "is not a rotation: its rows must be orthogonal unit vectors with determinant +1"
            remedy = "give nine numbers row by row; its columns are the axes of A in S"
            raise DrakeTeleopError(what, where=f"{where}.R_SA", remedy=remedy)
        if not self.ideal and self.low_pass != "none":
            place, alternative = f"{where}.bandwidth_hz", ", or set low_pass: none"
            check_bandwidth(self.bandwidth_hz, rate_hz, place, alternative)


def check_bandwidth(bandwidth_hz: float, rate_hz: float, where: str, alternative: str = "") -> None:
    if bandwidth_hz >= 0.45 * rate_hz:
        what = f"bandwidth {bandwidth_hz:g} Hz is too near half the sensor's rate ({rate_hz:g} Hz)"
        remedy = f"lower the bandwidth below 0.45 of the sensor's rate{alternative}"
        raise DrakeTeleopError(what, where=where, remedy=remedy)


_CALIBRATION_ERROR_FIELDS = (
    *("gain_error", "cross_talk", "misalignment"),
    *("acceleration_gain_error", "acceleration_misalignment"),
)
_NOISY_QUANTITIES = ("force", "torque", "acceleration", "angular_acceleration")
#: Parts of the sensor by name, with the field values that switch each part off.
DISABLED_PART_VALUES: dict[str, dict[str, Any]] = {
    "calibration": dict.fromkeys(_CALIBRATION_ERROR_FIELDS, 0.0),
    "place": {"p_SoAo_S": [0.0] * 3, "R_SA": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]},
    "low_pass": {"low_pass": "none"},
    "noise": {f"{name}_noise": 0.0 for name in _NOISY_QUANTITIES},
    "random_walk": {f"{name}_walk": 0.0 for name in _NOISY_QUANTITIES},
    "offset": {"offset": [0.0] * 6, "acceleration_offset": [0.0] * 6},
    "drift": {"drift": [0.0] * 6},
    "quantisation": {"resolution": 0.0, "encoder_resolution": 0.0},
    "saturation": {"saturates": False},
    "latency": {"force_latency": 0.0, "acceleration_latency": 0.0, "encoder_latency": 0.0},
}


def without_parts(config: WristSensorConfig, *parts: str) -> WristSensorConfig:
    """Return a copy of the configuration without `parts`, which are keys of `DISABLED_PART_VALUES`.

    >>> without_parts(WristSensorConfig(), "noise", "offset").force_noise
    0.0
    """
    changes = {name: value for part in parts for name, value in DISABLED_PART_VALUES[part].items()}
    return dataclasses.replace(config, **copy.deepcopy(changes))


def butterworth_sections(cutoff_hz: float, rate_hz: float) -> Array:
    """Return two second-order sections [b0, b1, b2, a1, a2] of a 4th-order Butterworth low-pass."""
    warped = np.tan(np.pi * cutoff_hz / rate_hz)
    sections = np.empty((_NUM_LOW_PASS_SECTIONS, 5))
    for row, angle in enumerate((np.pi / 8, 3 * np.pi / 8)):
        damping = 2 * np.cos(angle) * warped
        a0 = 1 + damping + warped**2
        b0, a1, a2 = warped**2, 2 * (warped**2 - 1), 1 - damping + warped**2
        sections[row] = np.array([b0, 2 * b0, b0, a1, a2]) / a0
    return sections


def group_delay_samples(section: Array) -> float:
    """Return the low-frequency delay of a filter section [b0, b1, b2, a1, a2] in samples."""
    b0, b1, b2, a1, a2 = section
    return float((b1 + 2 * b2) / (b0 + b1 + b2) - (a1 + 2 * a2) / (1 + a1 + a2))


def calibration_matrices(config: WristSensorConfig) -> tuple[Array, Array, Array]:
    """Return random matrices from true values to values with calibration errors.

    They are (6, 6) for [f; tau] in S, (3, 3) for specific force and (3, 3) for angular acceleration
    in A. `config.unit` is their seed.
    """
    random = np.random.default_rng(config.unit)
    gains, talk = random.uniform(-1, 1, 6), random.uniform(-1, 1, (6, 6))
    axis = random.normal(size=3)
    acceleration_gains, acceleration_axis = random.uniform(-1, 1, 6), random.normal(size=3)
    ranges = config.ranges()[:6]
    wrench = config.cross_talk * talk * ranges[:, None] / ranges
    np.fill_diagonal(wrench, 1 + config.gain_error * gains)
    scales = 1 + config.acceleration_gain_error * acceleration_gains
    turned = _rotation_about_axis(acceleration_axis, config.acceleration_misalignment)
    both = np.kron(np.eye(2), _rotation_about_axis(axis, config.misalignment))
    return wrench @ both, scales[:3, None] * turned, scales[3:, None] * turned


def _rotation_about_axis(axis: Array, angle: float) -> Array:
    K = cross_matrix(axis / np.linalg.norm(axis))
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


# True values: as a sample (`drake_teleop.load.regressor`) without the flag.
TRUE_ANGLES_SLICE = slice(15, None)
# A reading: wrench, accelerometer, whether a channel is saturated, angles.
READ_WRENCH, READ_ACCELERATION = slice(0, 6), slice(6, 12)
READ_SATURATED, READ_ANGLES = 12, slice(13, None)
_LOW_PASS_BEFORE_NOISE, _LOW_PASS_AFTER_CONVERTER = 1.0, 2.0  # as in _LOW_PASS_STAGES
# Memory: samples taken, 12 random walks, filter (2, 2, 12), delay line with a row per sample: 12
# channels, saturation of force and of acceleration, angles.
_RANDOM_WALK_START_INDEX = 1
FILTER_START_INDEX = _RANDOM_WALK_START_INDEX + _NUM_NOISY_CHANNELS
_DELAY_LINE_START_INDEX = FILTER_START_INDEX + 2 * _NUM_LOW_PASS_SECTIONS * _NUM_NOISY_CHANNELS
_DELAYED_ANGLES_INDEX = _NUM_NOISY_CHANNELS + 2


def initialize_sensor_chain(
    config: WristSensorConfig, num_joints: int, period: float
) -> tuple[Records, Array]:
    """Return constants and initial memory of `read_sensor_into`."""
    if config.ideal:
        config = without_parts(config, *DISABLED_PART_VALUES)
    wrench, force, angular = calibration_matrices(config)
    p_SoAo_S, R_SA = config.accelerometer_pose()
    ranges = config.ranges()
    limits = ranges if config.saturates else np.full(_NUM_NOISY_CHANNELS, np.inf)
    sections = np.zeros((_NUM_LOW_PASS_SECTIONS, 5))
    if config.low_pass != "none":
        sections = butterworth_sections(config.bandwidth_hz, 1 / period)
    latencies = config.latency_samples(period)
    drift = np.append(np.array(config.drift) * period, np.zeros(6))
    walk_step_std = config.random_walk() * np.sqrt(SAMPLES_PER_NOISE_BLOCK * period)
    constants = pack_for_compiled_code(
        offset=[*config.offset, *config.acceleration_offset],
        drift_per_sample=drift,
        noise_std=config.noise_std(),
        walk_step_std=walk_step_std,
        quantum=config.resolution * ranges,
        range=limits,
        wrench_calibration=wrench,
        motion_calibration=[force @ R_SA.T, angular @ R_SA.T],
        accelerometer_position=p_SoAo_S,
        low_pass=sections,
        low_pass_stage=_LOW_PASS_STAGES.index(config.low_pass),
        latency_samples=latencies,
        encoder_quantum=config.encoder_resolution,
        overload_limits=_OVERLOAD_TO_RANGE_RATIO * ranges[:6],
    )
    size = (latencies.max() + 1) * (_DELAYED_ANGLES_INDEX + num_joints)
    return constants, np.zeros(_DELAY_LINE_START_INDEX + size)


@njit(cache=True)
def are_values_plausible(constants, truth):
    """Return whether the true values are finite and do not overload the sensor."""
    offset, limits = constants[0].offset, constants[0].overload_limits
    good = True
    for i in range(6):
        good = good and abs(truth[i] + offset[i]) <= limits[i]
    for i in range(6, truth.shape[0]):
        good = good and abs(truth[i]) <= LARGEST_PORT_VALUE
    return good


@njit(cache=True)
def read_sensor_into(constants, memory, noise, truth, reading):
    """Convert true values to the sensor's reading at one instant, once per period.

    Args:
        constants, memory: results of `initialize_sensor_chain`; memory is updated.
        noise: (NOISE_BLOCK_SIZE,) standard normal numbers for this block of samples.
        truth: (15 + n,) [wrench (6) of the sensor on the tool at So in S | specific force of So
            (3), angular velocity (3), angular acceleration (3) in S | joint angles (n)].
        reading: (13 + n,) written: [wrench (6) | specific force at Ao (3), angular acceleration (3)
            in A | 1 if a channel is saturated, else 0 | joint angles (n)].
    """
    constants, angles = constants[0], truth[TRUE_ANGLES_SLICE]
    count = int(memory[0])
    line = memory[_DELAY_LINE_START_INDEX:].reshape((-1, _DELAYED_ANGLES_INDEX + angles.shape[0]))
    shift_delay_line(line)
    row, channels = line[0], line[0, :_NUM_NOISY_CHANNELS]
    walks = memory[_RANDOM_WALK_START_INDEX:FILTER_START_INDEX]
    filtered = memory[FILTER_START_INDEX:_DELAY_LINE_START_INDEX]
    sections, place = constants.low_pass[:], constants.low_pass_stage
    if count % SAMPLES_PER_NOISE_BLOCK == 0:
        step = noise[_NUM_NOISY_CHANNELS * SAMPLES_PER_NOISE_BLOCK :]
        for i in range(_NUM_NOISY_CHANNELS):
            walks[i] += constants.walk_step_std[i] * step[i]

    _apply_calibration_errors(constants, truth, channels)
    if place == _LOW_PASS_BEFORE_NOISE:
        if count == 0:
            settle_low_pass(sections, filtered, channels)
        low_pass_in_place(sections, filtered, channels)
    for i in range(_NUM_NOISY_CHANNELS):
        channels[i] += constants.offset[i] + count * constants.drift_per_sample[i]
    if place == _LOW_PASS_AFTER_CONVERTER and count == 0:
        settle_low_pass(sections, filtered, channels)
    first = _NUM_NOISY_CHANNELS * (count % SAMPLES_PER_NOISE_BLOCK)
    for i in range(_NUM_NOISY_CHANNELS):
        channels[i] += constants.noise_std[i] * noise[first + i] + walks[i]
    row[_NUM_NOISY_CHANNELS] = _quantize_and_saturate_channels(constants, 0, 6, channels)
    row[_NUM_NOISY_CHANNELS + 1] = _quantize_and_saturate_channels(constants, 6, 12, channels)
    if place == _LOW_PASS_AFTER_CONVERTER:
        low_pass_in_place(sections, filtered, channels)
    quantum, turned = constants.encoder_quantum, row[_DELAYED_ANGLES_INDEX:]
    for i in range(angles.shape[0]):
        turned[i] = quantum * np.rint(angles[i] / quantum) if quantum > 0.0 else angles[i]

    if count == 0:
        line[1:] = row
    memory[0] += 1.0
    late = constants.latency_samples
    force, acceleration = line[int(late[0])], line[int(late[1])]
    copy_into(reading, READ_WRENCH.start, force, 0, 6)
    copy_into(reading, READ_ACCELERATION.start, acceleration, 6, 6)
    reading[READ_SATURATED] = max(force[_NUM_NOISY_CHANNELS], acceleration[_NUM_NOISY_CHANNELS + 1])
    encoders = line[int(late[2])]
    copy_into(reading, READ_ANGLES.start, encoders, _DELAYED_ANGLES_INDEX, angles.shape[0])


@njit(cache=True)
def shift_delay_line(line):
    """Copy each row of the delay line to the next one; row 0 is then to be overwritten."""
    for k in range(line.shape[0] - 1, 0, -1):
        copy_into(line[k], 0, line[k - 1], 0, line.shape[1])


@njit(cache=True)
def _apply_calibration_errors(constants, truth, out):
    wrench, s = truth[WRENCH_SLICE], truth[SPECIFIC_FORCE_SLICE]
    omega, alpha = truth[ANGULAR_VELOCITY_SLICE], truth[ANGULAR_ACCELERATION_SLICE]
    for i in range(6):
        value = 0.0
        for j in range(6):
            value += constants.wrench_calibration[i, j] * wrench[j]
        out[i] = value
    r = vector_at(constants.accelerometer_position, 0)
    at_Ao = add_cross_product(add_cross_product(s, alpha, r), omega, cross(omega, r))
    force, angular = constants.motion_calibration[0], constants.motion_calibration[1]
    out[6], out[7], out[8] = apply_matrix(matrix_as_tuple(force), at_Ao)
    out[9], out[10], out[11] = apply_matrix(matrix_as_tuple(angular), alpha)


@njit(cache=True)
def _quantize_and_saturate_channels(constants, first_channel, end_channel, channels):
    saturated = 0.0
    for i in range(first_channel, end_channel):
        quantum, limit, value = constants.quantum[i], constants.range[i], channels[i]
        if quantum > 0.0:
            value = quantum * np.rint(value / quantum)
        if abs(value) >= limit:
            value = np.copysign(limit, value)
            saturated = 1.0
        channels[i] = value
    return saturated


@njit(cache=True)
def low_pass_in_place(sections, memory, values):
    """Apply the second-order `sections` (k, 5) in series to `values` (n,) in place."""
    n = values.shape[0]
    for k in range(sections.shape[0]):
        b0, b1, b2, a1, a2 = sections[k]
        if b0 == 1.0:
            continue
        first, second = 2 * k * n, (2 * k + 1) * n
        for i in range(n):
            value = values[i]
            out = b0 * value + memory[first + i]
            memory[first + i] = b1 * value - a1 * out + memory[second + i]
            memory[second + i] = b2 * value - a2 * out
            values[i] = out


@njit(cache=True)
def settle_low_pass(sections, memory, values):
    """Set the memory of `low_pass_in_place` to its steady state at `values` (n,)."""
    n = values.shape[0]
    for k in range(sections.shape[0]):
        _, b1, b2, a1, a2 = sections[k]
        for i in range(n):
            second = (b2 - a2) * values[i]
            memory[(2 * k + 1) * n + i] = second
            memory[2 * k * n + i] = (b1 - a1) * values[i] + second
