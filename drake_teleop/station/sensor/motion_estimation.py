"""Estimated motion of the sensor frame S (long: one file for sources, their delays and noise).

Sources of specific force s of So, angular velocity omega and acceleration alpha:

- `encoders`: low-pass and second differences of the joint angles, then kinematics of the arm.
- `accelerometer` (default, as in the paper): measured s and alpha, omega from encoders.
- `fused`: a steady-state Kalman filter per axis integrates s and alpha, corrected by the encoders.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from drake_teleop.common.compiled import njit
from drake_teleop.common.config import choice, quantity, settings
from drake_teleop.common.numeric import Array, Records, pack_for_compiled_code
from drake_teleop.common.vectors import (
    add_cross_product,
    apply_matrix,
    copy_into,
    cross,
    matrix_as_tuple,
    minus,
    plus,
    transposed,
    vector_at,
)
from drake_teleop.load import regressor
from drake_teleop.station.sensor.sensor_chain import (
    NUM_FLAGGED_SAMPLES_AFTER_LOSS,
    READ_ANGLES,
    READ_SATURATED,
    WristSensorConfig,
    are_values_plausible,
    butterworth_sections,
    check_bandwidth,
    group_delay_samples,
    low_pass_in_place,
    read_sensor_into,
    settle_low_pass,
    shift_delay_line,
)
from drake_teleop.station.slave import arm as serial_arm

_MOTION_SOURCES = ("encoders", "accelerometer", "fused")
#: Displacement of So per encoder error, RMS over joints and directions [m/rad], for the RX90. The
#: gains depend on its square root at most.
_RMS_SENSOR_DISPLACEMENT_M_PER_RAD = 0.4
#: Smallest standard deviations of angles [rad] and accelerations [m/s^2, rad/s^2].
_MIN_ANGLE_STD, _MIN_ACCELERATION_STD = 1e-8, 1e-6

_NUM_ANGLE_LOW_PASS_SECTIONS = 4
# Memory: samples taken, samples for which the flag stays; state of `_update_fusion_filters` for
# angle and displacement, each with the accelerometer's error and the last R_WS or p_WS; scratch for
# kinematics; per joint: velocity, acceleration, last three angles, low-passes; delay line.
_FLAG_COUNTDOWN_INDEX = 1
_ANGULAR_FUSION_START_INDEX = 2
_FUSION_FILTER_MEMORY_SIZE = 24
_LINEAR_FUSION_START_INDEX = _ANGULAR_FUSION_START_INDEX + _FUSION_FILTER_MEMORY_SIZE
_SCRATCH_START_INDEX = _LINEAR_FUSION_START_INDEX + _FUSION_FILTER_MEMORY_SIZE
_JOINTS_START_INDEX = _SCRATCH_START_INDEX + serial_arm.SENSOR_MOTION_SIZE
_MEMORY_SIZE_PER_JOINT = 5 + 2 * _NUM_ANGLE_LOW_PASS_SECTIONS


@settings
@dataclass
class MotionEstimationConfig:
    """Settings of the estimation of the motion of the sensor frame S."""

    source: str = choice("accelerometer", _MOTION_SOURCES, "source of the estimated motion")
    encoder_bandwidth_hz: float = quantity(
        50.0, "Hz", 1.0, 1e4, "low-pass of the angles, 4th-order Butterworth (source `encoders`)"
    )
    acceleration_drift: float = quantity(
        0.05, "m/s^2/sqrt(s)", 1e-6, 1e3, "random walk of the specific-force error (source `fused`)"
    )
    angular_acceleration_drift: float = quantity(
        0.5, "rad/s^2/sqrt(s)", 1e-6, 1e4, "random walk of the error of alpha (source `fused`)"
    )


class PathDelays(NamedTuple):
    """Delays of the signal paths at low frequencies [s].

    `sample_s` is the delay of the slowest path in use, for which the others wait.
    """

    wrench_s: float
    acceleration_s: float
    encoders_s: float
    sample_s: float


def steady_state_kalman_gains(
    position_std: float, acceleration_std: float, drift: float, period: float
) -> Array:
    """Return Kalman gains (3,) from innovation to position [1], rate [1/s], acceleration [1/s^2].

    The filter fuses a measured position and a measured acceleration with a drifting error.

    Args:
        position_std: standard deviation of a measured position, in any unit.
        acceleration_std: standard deviation of a measured acceleration [that unit / s^2].
        drift: random walk of the error [that unit / s^2 / sqrt(s)], positive.
        period: sampling period [s].
    """
    white = (acceleration_std * period**2 / position_std) ** 2
    walk = (drift * period**2.5 / position_std) ** 2
    # With u = (1 - z)(1 - 1/z) the spectrum of the innovations is u^3 + white u + walk, up to a
    # factor. Its roots give the poles. Scaled, they are of order one and well conditioned.
    scale = max(np.sqrt(white), np.cbrt(walk))
    u = scale * np.roots([1.0, 0.0, white / scale**2, walk / scale**3]).astype(complex)
    root = np.sqrt(u * u - 4.0 * u)
    # Each root u has two solutions delta = 1 - z; the stable pole is inside the unit circle.
    delta = np.where(abs(2.0 - u - root) < abs(2.0 - u + root), u + root, u - root) / 2.0
    z = 1.0 - delta
    keeps = np.prod(z).real
    d = -delta / z
    third = np.prod(delta).real
    second = third + keeps * (d[0] * d[1] + d[0] * d[2] + d[1] * d[2]).real
    return np.array([1.0 - keeps, second / period, third / period**2])


def path_delays(
    config: MotionEstimationConfig, sensor: WristSensorConfig, period: float
) -> PathDelays:
    wrench, acceleration, encoders = sensor.reading_delays(period)
    sections = _joint_angle_filter_sections(config, sensor, period)
    encoders += float(np.sum([group_delay_samples(section) for section in sections])) * period
    sources = (encoders,) if config.source == "encoders" else (acceleration, encoders)
    waits = np.ceil((max(sources) - wrench) / period - 1e-6)
    sample = wrench + max(waits, 0.0) * period
    return PathDelays(float(wrench), float(acceleration), float(encoders), float(sample))


def fusion_gains(
    config: MotionEstimationConfig, sensor: WristSensorConfig, num_joints: int, period: float
) -> tuple[Array, Array]:
    """Return the Kalman gains (3,) of source `fused` for rotation and for displacement of S."""
    s_std, alpha_std = _accelerometer_std(sensor)
    angle_std = _sensor_rotation_std_by_encoders(sensor, num_joints)
    linear_std = angle_std * _RMS_SENSOR_DISPLACEMENT_M_PER_RAD
    drifts = config.angular_acceleration_drift, config.acceleration_drift
    angular = steady_state_kalman_gains(angle_std, alpha_std.mean(), drifts[0], period)
    return angular, steady_state_kalman_gains(linear_std, s_std.mean(), drifts[1], period)


def estimated_motion_std(
    config: MotionEstimationConfig, sensor: WristSensorConfig, num_joints: int, period: float
) -> Array:
    """Return standard deviations (9,) of specific force, omega (0: exact), alpha [SI units]."""
    if config.source != "encoders":
        s_std, alpha_std = _accelerometer_std(sensor)
        return np.concatenate([s_std, np.zeros(3), alpha_std])
    shift = np.exp(-1j * np.pi * (np.arange(1 << 14) + 0.5) / (1 << 14))
    response = [
        np.polyval([b2, b1, b0], shift) / np.polyval([a2, a1, 1.0], shift)
        for b0, b1, b2, a1, a2 in _joint_angle_filter_sections(config, sensor, period)
    ]
    differenced = np.polyval([-1.0, 4.0, -5.0, 2.0], shift) / period**2
    power = np.mean(np.abs(np.prod(response, axis=0) * differenced) ** 2)
    if sensor.low_pass == "after_converter":
        power /= np.mean(np.abs(response[0] * response[1]) ** 2)
    alpha = _sensor_rotation_std_by_encoders(sensor, num_joints) * np.sqrt(power)
    return np.repeat([alpha * _RMS_SENSOR_DISPLACEMENT_M_PER_RAD, 0.0, alpha], 3)


def _sensor_rotation_std_by_encoders(sensor: WristSensorConfig, num_joints: int) -> float:
    rounding = max(sensor.encoder_resolution / np.sqrt(12.0), _MIN_ANGLE_STD)
    return float(rounding * np.sqrt(num_joints / 3.0))


def _accelerometer_std(sensor: WristSensorConfig) -> tuple[Array, Array]:
    """Return standard deviations (3,) of specific force at So, (3,) of angular acceleration."""
    std = np.maximum(sensor.motion_std(), _MIN_ACCELERATION_STD)
    p_SoAo_S, R_SA = sensor.accelerometer_pose()
    s_std, alpha_std = np.sqrt(R_SA**2 @ std[:3] ** 2), np.sqrt(R_SA**2 @ std[6:] ** 2)
    x, y, z = p_SoAo_S**2
    crossed = np.array([[0.0, z, y], [z, 0.0, x], [y, x, 0.0]]) @ alpha_std**2
    return np.sqrt(s_std**2 + crossed), alpha_std


def initialize_motion_estimator(
    config: MotionEstimationConfig, sensor: WristSensorConfig, num_joints: int, period: float
) -> tuple[Records, Array]:
    """Return constants and initial memory of `estimate_sample_into`."""
    *paths, sample = path_delays(config, sensor, period)
    used = np.array([True, config.source != "encoders", True])
    waits = np.where(used, sample - np.array(paths), 0.0) / period
    # Remove rounding errors of whole numbers.
    waits = np.where(np.abs(waits - np.rint(waits)) < 1e-6, np.rint(waits), waits)
    p_SoAo_S, R_SA = sensor.accelerometer_pose()
    angle_gains, linear_gains = fusion_gains(config, sensor, num_joints, period)
    constants = pack_for_compiled_code(
        period=period,
        encoders_only=config.source == "encoders",
        fused=config.source == "fused" and not sensor.ideal,  # an ideal one needs no correction
        wait_samples=waits,
        accelerometer_position=p_SoAo_S,
        R_SA=R_SA,
        angle_low_passes=_joint_angle_filter_sections(config, sensor, period),
        angle_gains=angle_gains,
        linear_gains=linear_gains,
    )
    rows = int(np.ceil(waits.max())) + 1
    size = _MEMORY_SIZE_PER_JOINT * num_joints + rows * (12 + num_joints)
    return constants, np.zeros(_JOINTS_START_INDEX + size)


def _joint_angle_filter_sections(
    config: MotionEstimationConfig, sensor: WristSensorConfig, period: float
) -> Array:
    filters = np.zeros((_NUM_ANGLE_LOW_PASS_SECTIONS, 5))
    filters[:, 0] = 1.0
    if sensor.low_pass != "none" and not sensor.ideal:
        filters[:2] = butterworth_sections(sensor.bandwidth_hz, 1 / period)
    if config.source == "encoders":
        place = "motion_estimation.encoder_bandwidth_hz"
        check_bandwidth(config.encoder_bandwidth_hz, 1 / period, place)
        filters[2:] = butterworth_sections(config.encoder_bandwidth_hz, 1 / period)
    return filters


@njit(cache=True)
def estimate_sample_into(constants, memory, arm, reading, sample):
    """Convert one reading of the sensor per period to a sample whose values have the same instant.

    Args:
        constants, memory: results of `initialize_motion_estimator`; memory is updated.
        arm: `ArmModel.table`. If it has no rows, the first three of the n "joint angles" are the
            measured angular velocity of S, in S [rad/s] (only source `accelerometer`).
        reading: (13 + n,) output of `sensor_chain.read_sensor_into`.
        sample: (16 + n,) written, see `drake_teleop.load.regressor`.
    """
    constants, n = constants[0], sample.shape[0] - regressor.FIRST_JOINT_INDEX
    motion = memory[_SCRATCH_START_INDEX:_JOINTS_START_INDEX]
    angles, gravity = sample[regressor.JOINT_POSITIONS_SLICE], motion[:3]
    _equalize_signal_delays(constants, memory, n, reading, sample)
    if arm.shape[0] == 0:
        copy_into(motion, 3, angles, 0, 3)
    else:
        joints = memory[_JOINTS_START_INDEX:][: _MEMORY_SIZE_PER_JOINT * n]
        _differentiate_joint_angles(constants, memory[0] == 0.0, joints, angles)
        serial_arm.sensor_motion(arm, angles, joints[:n], joints[n:], motion)
        gravity = arm[n, serial_arm.LAST_ROW_GRAVITY_COLUMN :]
    if constants.encoders_only != 0.0:
        copy_into(sample, regressor.MOTION_SLICE.start, motion, 0, 9)
    else:
        _convert_and_fuse_accelerometer(constants, memory, gravity, motion, sample)
    memory[0] += 1.0


@njit(cache=True)
def measure_sample_into(sensor, arm, noise, truth, chain_memory, estimator_memory, sample):
    """Write the wrist sensor's `sample` of the true values `truth`, once per period.

    If `truth` is implausible, keep the last sample and flag it. `sensor` contains the constants of
    sensor chain and estimator, and whether the sensor is ideal. Others: see `read_sensor_into`.
    """
    chain, estimator, ideal = sensor
    flag = regressor.SATURATION_FLAG_INDEX
    if not are_values_plausible(chain, truth):  # keeps it out of the filters
        sample[flag] = regressor.LOST_SAMPLE_FLAG_THRESHOLD + NUM_FLAGGED_SAMPLES_AFTER_LOSS
        return
    lost = sample[flag] - 1.0
    if ideal:
        copy_into(sample, 0, truth, 0, flag)
        sample[flag] = 0.0
        copy_into(sample, flag + 1, truth, flag, truth.shape[0] - flag)
    else:
        reading = np.empty(truth.shape[0] - 2)
        read_sensor_into(chain, chain_memory, noise, truth, reading)
        estimate_sample_into(estimator, estimator_memory, arm, reading, sample)
    if lost >= regressor.LOST_SAMPLE_FLAG_THRESHOLD:
        sample[flag] = lost


@njit(cache=True)
def _equalize_signal_delays(constants, memory, num_joints, reading, sample):
    sections, angles = constants.angle_low_passes[:], sample[regressor.JOINT_POSITIONS_SLICE]
    filtered = memory[_JOINTS_START_INDEX:][: _MEMORY_SIZE_PER_JOINT * num_joints][5 * num_joints :]
    copy_into(angles, 0, reading, READ_ANGLES.start, num_joints)
    if memory[0] == 0.0:
        settle_low_pass(sections, filtered, angles)
    low_pass_in_place(sections, filtered, angles)
    delay_line = memory[_JOINTS_START_INDEX + _MEMORY_SIZE_PER_JOINT * num_joints :]
    line = delay_line.reshape((-1, 12 + num_joints))
    shift_delay_line(line)
    copy_into(line[0], 0, reading, 0, 12)
    copy_into(line[0], 12, angles, 0, num_joints)
    if memory[0] == 0.0:
        line[1:] = line[0]
    waits = constants.wait_samples
    copy_into(sample, regressor.WRENCH_SLICE.start, line[int(waits[0])], 0, 6)
    copy_into(sample, regressor.MOTION_SLICE.start, line[int(waits[1])], 6, 6)
    wait, older = int(waits[2]), waits[2] - int(waits[2])
    now, before = line[wait], line[min(wait + 1, line.shape[0] - 1)]
    for i in range(num_joints):
        angles[i] = (1.0 - older) * now[12 + i] + older * before[12 + i]
    flagged = memory[_FLAG_COUNTDOWN_INDEX] - 1.0
    if reading[READ_SATURATED] != 0.0:
        flagged = float(line.shape[0])
    memory[_FLAG_COUNTDOWN_INDEX] = max(flagged, 0.0)
    sample[regressor.SATURATION_FLAG_INDEX] = 1.0 if flagged > 0.0 else 0.0


@njit(cache=True)
def _differentiate_joint_angles(constants, is_first, memory, angles):
    n, period = angles.shape[0], constants.period
    for i in range(n):
        if is_first:
            memory[2 * n + i] = memory[3 * n + i] = memory[4 * n + i] = angles[i]
        q0, q1, q2, q3 = angles[i], memory[2 * n + i], memory[3 * n + i], memory[4 * n + i]
        memory[i] = (3.0 * q0 - 4.0 * q1 + q2) / (2.0 * period)
        if constants.encoders_only != 0.0:
            memory[n + i] = (2.0 * q0 - 5.0 * q1 + 4.0 * q2 - q3) / (period * period)
        memory[2 * n + i], memory[3 * n + i], memory[4 * n + i] = q0, q1, q2


@njit(cache=True)
def _convert_and_fuse_accelerometer(constants, memory, gravity, motion, sample):
    period, fused, starts = constants.period, constants.fused != 0.0, memory[0] == 0.0
    s, omega = sample[regressor.SPECIFIC_FORCE_SLICE], sample[regressor.ANGULAR_VELOCITY_SLICE]
    alpha = sample[regressor.ANGULAR_ACCELERATION_SLICE]
    R_SA, R = matrix_as_tuple(constants.R_SA), motion[12:21]
    alpha[0], alpha[1], alpha[2] = apply_matrix(R_SA, vector_at(omega, 0))
    s[0], s[1], s[2] = apply_matrix(R_SA, vector_at(s, 0))
    copy_into(omega, 0, motion, 3, 3)

    angular = memory[_ANGULAR_FUSION_START_INDEX:_LINEAR_FUSION_START_INDEX]
    linear = memory[_LINEAR_FUSION_START_INDEX:_SCRATCH_START_INDEX]
    if fused:
        if starts:
            copy_into(angular, 3, omega, 0, 3)
            copy_into(angular, 15, R, 0, 9)
        _small_rotation_vector_into(angular[15:], R, motion)
        copy_into(angular, 15, R, 0, 9)
        for i in range(3):
            alpha[i] -= angular[12 + i]
        _update_fusion_filters(constants.angle_gains, period, motion, alpha, angular)
        for i in range(3):
            angular[12 + i] -= motion[i]
            alpha[i] += motion[i]
            angular[6 + i] = alpha[i]
            omega[i] = angular[3 + i] + 0.5 * period * alpha[i]

    # From Ao to So, with r = p_SoAo_S.
    r, w = vector_at(constants.accelerometer_position, 0), vector_at(omega, 0)
    s[0], s[1], s[2] = minus(s, add_cross_product(cross(alpha, r), w, cross(w, r)))
    if fused:
        if starts:
            copy_into(linear, 15, motion, 9, 3)
        for i in range(3):
            motion[i] = motion[9 + i] - linear[15 + i]
            linear[15 + i] = motion[9 + i]
            s[i] -= linear[12 + i]
        a_W = motion[3:6]  # reuses the encoders' omega
        a_W[0], a_W[1], a_W[2] = plus(apply_matrix(R, s), gravity)
        _update_fusion_filters(constants.linear_gains, period, motion, a_W, linear)
        correction = apply_matrix(transposed(R), motion)
        for i in range(3):
            linear[12 + i] -= correction[i]
            s[i] += correction[i]
            linear[6 + i] = a_W[i] + motion[i]


@njit(cache=True)
def _small_rotation_vector_into(R_before, R, rotation_vector):
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        value = 0.0
        for row in range(0, 9, 3):
            value += R_before[row + k] * R[row + j] - R_before[row + j] * R[row + k]
        rotation_vector[i] = 0.5 * value


@njit(cache=True)
def _update_fusion_filters(gains, period, change_in_correction_out, acceleration, filter_memory):
    for i in range(3):
        mean = (acceleration[i] + 10.0 * filter_memory[6 + i] + filter_memory[9 + i]) / 12.0
        rate = filter_memory[3 + i] + period * mean
        innovation = filter_memory[i] + change_in_correction_out[i] - period * rate
        filter_memory[i] = innovation - gains[0] * innovation
        filter_memory[3 + i] = rate + gains[1] * innovation
        filter_memory[9 + i] = filter_memory[6 + i]
        change_in_correction_out[i] = gains[2] * innovation
