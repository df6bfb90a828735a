"""Estimated motion of S: accuracy, delays and residuals of elimination."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from pydrake.systems.framework import DiagramBuilder
from scipy.interpolate import make_interp_spline
from scipy.signal import sosfilt, sosfilt_zi, sosfreqz

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.compensation import contact_wrench
from drake_teleop.load.regressor import non_contact_wrench_into
from drake_teleop.station.sensor.motion_estimation import (
    MotionEstimationConfig,
    _update_fusion_filters,
    estimate_sample_into,
    estimated_motion_std,
    fusion_gains,
    initialize_motion_estimator,
    path_delays,
    steady_state_kalman_gains,
)
from drake_teleop.station.sensor.presets import PRESETS
from drake_teleop.station.sensor.sensor_chain import (
    NOISE_BLOCK_SIZE,
    SAMPLES_PER_NOISE_BLOCK,
    WristSensorConfig,
    butterworth_sections,
    initialize_sensor_chain,
    read_sensor_into,
    without_parts,
)
from drake_teleop.station.slave.arm import sensor_motion
from drake_teleop.station.slave.home import R_WS_HOME, home_posture
from drake_teleop.station.slave.inverse_kinematics import nearest_branch
from drake_teleop.station.slave.plant import AddSlavePlant
from drake_teleop.station.slave.slave_config import Slave

Array = NDArray[np.float64]

T = 1 / 8000
SOURCES = ("encoders", "accelerometer", "fused")
ARM = AddSlavePlant(DiagramBuilder(), Slave(), None, np.zeros(6)).arm
JR3 = PRESETS["jr3_85m35a3"]
#: Sensor with low-pass only, and an accelerometer at a wrong place and orientation.
QUIET = dataclasses.replace(
    without_parts(JR3, "noise", "random_walk", "offset", "drift", "quantisation"),
    p_SoAo_S=[0.02, -0.03, 0.05],
    R_SA=[0.0, -1.0, 0.0, 0.0, 0.0, 1.0, -1.0, 0.0, 0.0],
)


@functools.cache  # compilation in each worker during collection is avoided
def home() -> Array:
    return home_posture(ARM, [0.55, 0.0, 0.45])


def truth_of(motion, arm=ARM) -> Array:
    q, v, vdot = motion
    truth, x = np.empty((len(q), 15 + q.shape[1])), np.empty(21)
    truth[:, 15:] = q
    for k in range(len(q)):
        sensor_motion(arm.table, q[k], v[k], vdot[k], x)
        truth[k, 6:15] = x[:9]
        non_contact_wrench_into(x[:3], x[3:6], x[6:9], ARM.phi_load, truth[k, :6])
    return truth


def sampled(
    truth: Array,
    sensor: WristSensorConfig,
    config: MotionEstimationConfig,
    nominal: WristSensorConfig | None = None,
    table: Array = ARM.table,
    seed: int = 0,
) -> Array:
    """Return samples of sensor and estimation; `nominal` is the nominal sensor."""
    n = truth.shape[1] - 15
    noise = np.random.default_rng(seed).standard_normal(
        (len(truth) // SAMPLES_PER_NOISE_BLOCK + 1, NOISE_BLOCK_SIZE)
    )
    samples, reading = np.empty((len(truth), 16 + n)), np.empty(13 + n)
    chain, chain_memory = initialize_sensor_chain(sensor, n, T)
    constants, memory = initialize_motion_estimator(config, nominal or sensor, n, T)
    for k in range(len(truth)):
        read_sensor_into(
            chain, chain_memory, noise[k // SAMPLES_PER_NOISE_BLOCK], truth[k], reading
        )
        estimate_sample_into(constants, memory, table, reading, samples[k])
    return samples


def eliminated(samples: Array, offset=(0.0,) * 6) -> Array:
    motion = samples[:, 6:9], samples[:, 9:12], samples[:, 12:15]
    return contact_wrench(samples[:, :6], offset, *motion, ARM.phi_load)


def rms(rows: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(rows**2, axis=1))))


def swinging(t: Array, frequencies=(1.3, 2.1, 0.7, 2.6, 1.9, 3.1), start=None, acceleration=5.0):
    """Return sine motions of all joints about home or `start`, with exact derivatives."""
    start = home() if start is None else start
    w = 2 * np.pi * np.array(frequencies)
    phase = np.outer(t, w) + np.arange(len(w))
    amplitude = acceleration / w**2
    return (
        start + amplitude * np.sin(phase),
        amplitude * w * np.cos(phase),
        -amplitude * w**2 * np.sin(phase),
    )


def papers_motion(seconds: float):
    """Return the vertical motion of `free_motion_force` at 2.63 Hz, about 100 N."""
    coarse = np.arange(0.0, seconds + 0.01, 0.004)
    x = np.clip(coarse / 0.6, 0.0, 1.0)
    height = 0.45 + 0.078 * x**3 * (10 - 15 * x + 6 * x**2) * np.sin(2 * np.pi * 2.63 * coarse)
    path, q = [], home()
    for z in height:
        q, _ = nearest_branch(R_WS_HOME.matrix(), np.array([0.55, 0.0, z]), q, ARM.lower, ARM.upper)
        path.append(q)
    spline = make_interp_spline(coarse, np.array(path), k=5)
    t = np.arange(round(seconds / T)) * T
    return spline(t), spline(t, 1), spline(t, 2)


@pytest.fixture(scope="module")
def fast() -> Array:
    return truth_of(papers_motion(2.5))


SETTLED = 8000


# Outputs without errors of the sensor


@pytest.mark.parametrize(
    ("source", "tolerance"), [("encoders", 2e-3), ("accelerometer", 1e-4), ("fused", 1e-4)]
)
@pytest.mark.parametrize("latencies", [(0.0, 0.0, 0.0), (1e-3, 6e-3, 5e-4), (3e-3, 0.0, 2e-2)])
def test_noiseless_sensor_gives_truth_of_one_earlier_instant(source, tolerance, latencies):
    force, acceleration, encoders = latencies
    sensor = dataclasses.replace(
        QUIET,
        force_latency=force,
        acceleration_latency=acceleration,
        encoder_latency=encoders,
    )
    config = MotionEstimationConfig(source=source)
    t = np.arange(12000) * T
    samples = sampled(truth_of(swinging(t)), sensor, config)[SETTLED:]
    delay = path_delays(config, sensor, T).sample_s
    earlier = truth_of(swinging(t[SETTLED:] - delay))
    got = np.hstack([samples[:, :15], samples[:, 16:]])
    error = np.abs(got - earlier).max(axis=0) / np.abs(earlier).max(axis=0)
    assert error.max() < tolerance


def test_noiseless_accelerometer_sample_is_moved_and_filtered(fast):
    """The sample is at So with the wrench's low-pass; omega is the slope of filtered angles."""
    sensor = dataclasses.replace(QUIET, p_SoAo_S=[0.0] * 3, R_SA=list(np.eye(3).ravel()))
    config = MotionEstimationConfig(source="accelerometer")
    samples = sampled(fast, sensor, config)
    sections = butterworth_sections(sensor.bandwidth_hz, 1 / T)
    sos = np.insert(sections, 3, 1.0, axis=1)
    start = sosfilt_zi(sos)[:, :, None] * fast[0, :15]
    filtered, _ = sosfilt(sos, fast[:, :15], axis=0, zi=start)
    np.testing.assert_allclose(samples[:, :9], filtered[:, :9], atol=1e-9)
    np.testing.assert_allclose(samples[:, 12:15], filtered[:, 12:15], atol=1e-9)
    np.testing.assert_allclose(samples[:, 9:12], filtered[:, 9:12], atol=2e-4)


@pytest.mark.parametrize("source", ["accelerometer", "fused"])
def test_an_ideal_sensor_is_not_corrected(source, fast):
    samples = sampled(fast, WristSensorConfig(ideal=True), MotionEstimationConfig(source=source))
    np.testing.assert_array_equal(samples[:, :6], fast[:, :6])
    np.testing.assert_array_equal(samples[:, 12:15], fast[:, 12:15])
    np.testing.assert_allclose(samples[:, 6:9], fast[:, 6:9], rtol=0, atol=1e-14)
    np.testing.assert_array_equal(samples[:, 16:], fast[:, 15:])


@pytest.mark.parametrize("source", SOURCES)
@pytest.mark.parametrize("joints", [2, 4, 7])
def test_arms_with_other_numbers_of_joints(source, joints):
    # Links at the base may be removed or repeated without breaking the chain.
    rows = np.r_[np.zeros(max(joints - 6, 0), int), np.arange(max(6 - joints, 0), 7)]
    arm = dataclasses.replace(ARM, table=ARM.table[rows])
    t = np.arange(6000) * T
    motion = swinging(t, (1.3, 2.1, 0.7, 2.6, 1.9, 3.1, 1.1)[:joints], np.zeros(joints))
    samples = sampled(truth_of(motion, arm), QUIET, MotionEstimationConfig(source), table=arm.table)
    assert rms(eliminated(samples[4000:])) < 2e-3 * rms(samples[4000:, :6])


# Delays


@pytest.mark.quick_cases(6)
@pytest.mark.slow
@pytest.mark.parametrize("source", SOURCES)
@pytest.mark.parametrize("preset", ["jr3_85m35a3", "ati_gamma_imu"])
@pytest.mark.parametrize("frequency", [5.0, 20.0])
def test_wrench_and_motion_are_in_phase(source, preset, frequency):
    """The difference is within a fiftieth of a sample and a twentieth of the stated delay.

    Source `encoders` has a low-pass whose phase exceeds its delay by 0.1 samples at 5 Hz
    and 1.6 at 20 Hz.
    """
    sensor = without_parts(
        PRESETS[preset], "noise", "random_walk", "offset", "drift", "quantisation", "saturation"
    )
    config = MotionEstimationConfig(source=source)
    t = np.arange(12000) * T
    truth = truth_of(swinging(t, [frequency] * 6))
    samples = sampled(truth, sensor, config)
    window = slice(-3200, None)  # whole periods
    carrier = np.exp(-2j * np.pi * frequency * t[window])
    measured, true = carrier @ samples[window, :6], carrier @ truth[window, :6]
    removed = measured - carrier @ eliminated(samples)[window]
    per_sample = 2 * np.pi * frequency * T

    mismatch, expected = np.angle(removed / measured) / per_sample, 0.0
    if source == "encoders":
        sections = butterworth_sections(config.encoder_bandwidth_hz, 1 / T)
        sos = np.insert(sections, 3, 1.0, axis=1)
        _, (slow, response) = sosfreqz(sos, [1e-3 * per_sample, per_sample])
        lag = -np.angle(slow) / (1e-3 * per_sample)
        expected = np.angle(response * np.exp(1j * per_sample * lag)) / per_sample
    strong = np.abs(true) > 0.05 * np.repeat([np.abs(true[:3]).max(), np.abs(true[3:]).max()], 3)
    assert np.abs(mismatch[strong] - expected).max() < 0.02
    lateness = -np.angle(measured / true) / per_sample
    delay = path_delays(config, sensor, T).sample_s / T
    assert np.abs(lateness[strong] - delay).max() < 0.05


def test_total_delay_is_the_sum_of_delays():
    sensor = dataclasses.replace(
        JR3, force_latency=1e-3, acceleration_latency=3e-3, encoder_latency=2e-3
    )
    low_pass = 1 / (2 * np.pi * 500) / np.sin(np.pi / 8)  # sum of 2 zeta of a Butterworth
    delays = path_delays(MotionEstimationConfig("fused"), sensor, T)
    assert delays.wrench_s == pytest.approx(low_pass + 1e-3, abs=0.1 * T)
    assert delays.acceleration_s == delays.sample_s == pytest.approx(delays.wrench_s + 2e-3)
    assert delays.encoders_s == pytest.approx(delays.wrench_s + 1e-3)
    encoders = path_delays(MotionEstimationConfig("encoders", 50.0), sensor, T)
    assert encoders.encoders_s == pytest.approx(11 * low_pass + 2e-3, abs=0.2 * T)
    assert 0 <= encoders.sample_s - encoders.encoders_s < T
    assert (encoders.sample_s - encoders.wrench_s) / T == pytest.approx(
        round((encoders.sample_s - encoders.wrench_s) / T)
    )


@pytest.mark.slow
def test_6_ms_mismatch_is_worse_than_no_inertia_above_28_hz(fast):
    """The residual is 2 sin(pi f tau) of the inertial wrench: all of it at f = 1 / (6 tau)."""
    late = dataclasses.replace(QUIET, acceleration_latency=6e-3)
    config = MotionEstimationConfig("accelerometer")
    t = np.arange(12000) * T

    def left(truth: Array, nominal: WristSensorConfig) -> float:
        return rms(eliminated(sampled(truth, late, config, nominal)[SETTLED:])[:, :3])

    def inertial(truth: Array) -> float:
        """Return the residual after elimination of the weight only."""
        still = (truth[SETTLED:, 15:], np.zeros((len(truth), 6)), np.zeros((len(truth), 6)))
        return rms(truth[SETTLED:, :3] - truth_of(still)[:, :3])

    for truth, frequency in (
        (fast, 2.63),
        (truth_of(swinging(t, [20.0] * 6, acceleration=10.0)), 20.0),
        (truth_of(swinging(t, [40.0] * 6, acceleration=10.0)), 40.0),
    ):
        none, mismatched, matched = inertial(truth), left(truth, QUIET), left(truth, late)
        expected = 2 * np.sin(np.pi * frequency * 6e-3)
        assert mismatched / none == pytest.approx(expected, rel=0.1)
        assert (mismatched > none) == (frequency > 28.0)
        assert matched < 1e-3 * none


# Gains


@settings(max_examples=60)
@example(-6.0, -2.0, 0.0, 1e-2)
@given(st.floats(-7, -3), st.floats(-3, 1), st.floats(-4, 2), st.sampled_from([T, 1e-3, 1e-2]))
def test_gains_equal_those_of_the_kalman_filter(position, acceleration, drift, period):
    position_std, white, walk = 10.0**position, 10.0**acceleration, 10.0**drift
    found = steady_state_kalman_gains(position_std, white, walk, period)
    # In samples and standard deviations of the position.
    F, h = np.array([[1.0, 1, 1], [0, 1, 1], [0, 0, 1]]), np.array([[1.0, 0, 0]])
    noise = white * period**2 / position_std * np.array([1.0, 1.0, 0.0])
    Q = np.outer(noise, noise)
    Q[2, 2] = (walk * period**2.5 / position_std) ** 2
    gains = found * [1, period, period**2]
    # The gains are a fixed point of the Riccati equation: they follow from the covariance of
    # their own filter, a linear equation.
    A = (np.eye(3) - gains[:, None] * h) @ F
    N = (np.eye(3) - gains[:, None] * h) @ Q @ (np.eye(3) - gains[:, None] * h).T
    N += np.outer(gains, gains)
    assert np.abs(np.linalg.eigvals(A)).max() < 1.0
    P = np.linalg.solve(np.eye(9) - np.kron(A, A), N.ravel()).reshape(3, 3)
    ahead = F @ P @ F.T + Q
    np.testing.assert_allclose(ahead[:, 0] / (ahead[0, 0] + 1), gains, rtol=1e-3)
    assert gains[0] == pytest.approx(P[0, 0], rel=2e-3)
    assert 1 / (1 - gains[0]) == pytest.approx(ahead[0, 0] + 1, rel=2e-3)


def test_with_little_drift_the_poles_are_those_of_a_second_order_butterworth():
    """White noise only: crossover at the root of the noise ratio, damping 1/sqrt(2)."""
    position_std, acceleration_std = 5e-6, 1.5
    gains = steady_state_kalman_gains(position_std, acceleration_std, 1e-3, T)
    crossover = np.sqrt(acceleration_std / position_std)
    assert gains[0] == pytest.approx(np.sqrt(2) * crossover * T, rel=0.05)
    assert gains[1] == pytest.approx(crossover**2 * T, rel=0.05)


@pytest.mark.slow
def test_filter_errors_equal_the_predicted_deviations():
    position_std, white, walk, steps = 7e-6, 1.5, 3.0, 60000
    gains = steady_state_kalman_gains(position_std, white, walk, T)
    random = np.random.default_rng(1)
    error = np.cumsum(walk * np.sqrt(T) * random.standard_normal((steps, 3)), axis=0)
    # The true acceleration is zero: measurements are error and noise; rate and angle stay zero.
    measured = -error + white * random.standard_normal((steps, 3))
    angle = position_std * random.standard_normal((steps, 3))
    kept, bias, estimates, innovations = np.zeros(12), np.zeros(3), [], []
    for k in range(1, steps):
        acceleration, moved = measured[k] - bias, angle[k] - angle[k - 1]
        _update_fusion_filters(gains, T, moved, acceleration, kept)
        bias -= moved
        kept[6:9] = acceleration + moved
        estimates.append(angle[k] - kept[:3])
        innovations.append(moved / gains[2])
    assert np.std(estimates[8000:]) == pytest.approx(position_std * np.sqrt(gains[0]), rel=0.04)
    innovation_std = position_std / np.sqrt(1 - gains[0])
    assert np.std(innovations[8000:]) == pytest.approx(innovation_std, rel=0.01)


def test_gains_of_the_jr3_equal_the_docs():
    angular, linear = fusion_gains(MotionEstimationConfig(), JR3, 6, T)
    assert np.cbrt(angular[2] / T) / (2 * np.pi) == pytest.approx(28.9, abs=0.1)
    assert np.cbrt(linear[2] / T) / (2 * np.pi) == pytest.approx(18.4, abs=0.1)


# Residual of the elimination for the paper's 100 N


def left(fast: Array, sensor: WristSensorConfig, source: str) -> tuple[float, float]:
    samples = sampled(fast, sensor, MotionEstimationConfig(source))[SETTLED:]
    force = eliminated(samples, sensor.offset)[:, :3]
    return rms(force), float(np.linalg.norm(force, axis=1).max())


@pytest.mark.slow
def test_fused_corrects_a_wrong_accelerometer_without_loss(fast):
    sensor = without_parts(JR3, "drift")
    assert np.linalg.norm(fast[SETTLED:, :3], axis=1).max() == pytest.approx(97.0, abs=3.0)
    wrong = dataclasses.replace(
        sensor, acceleration_gain_error=0.01, acceleration_misalignment=0.01
    )
    plain = {source: left(fast, sensor, source) for source in SOURCES}
    off = {source: left(fast, wrong, source) for source in SOURCES}
    assert plain["fused"][0] < 1.01 * plain["accelerometer"][0] < 0.27
    assert off["fused"][0] < 0.33 and off["fused"][0] < 0.6 * off["accelerometer"][0]
    assert plain["fused"][1] < 1.0 and off["fused"][1] < 1.0
    # Encoders leave less, 8 ms later.
    assert plain["encoders"][0] < plain["fused"][0]
    late = path_delays(MotionEstimationConfig("encoders"), sensor, T).sample_s
    assert late > 8e-3 + path_delays(MotionEstimationConfig(), sensor, T).sample_s


@pytest.mark.parametrize("preset", ["jr3_85m35a3", "ati_gamma_imu"])
@pytest.mark.parametrize("source", ["encoders", "accelerometer"])
def test_motion_noise_equals_the_prediction(source, preset):
    """Encoders agree on average over the axes."""
    real = without_parts(PRESETS[preset], "random_walk", "offset", "drift", "saturation")
    config = MotionEstimationConfig(source)
    truth = truth_of(swinging(np.arange(16000) * T))
    noisy = sampled(truth, real, config)
    noise = (noisy - sampled(truth, without_parts(real, "noise", "quantisation"), config))[4000:]
    left = np.mean(noise[:, :6].std(axis=0) / real.wrench_std())  # by the low-pass, of any noise
    stated = left * estimated_motion_std(config, real, 6, T)
    for axes, expected in ((noise[:, 6:9], stated[:3]), (noise[:, 12:15], stated[6:])):
        if source == "accelerometer":
            np.testing.assert_allclose(axes.std(axis=0), expected, rtol=0.04)
        else:
            assert rms(axes) == pytest.approx(np.linalg.norm(expected), rel=0.12)


def test_the_offset_of_an_accelerometer_is_found(fast):
    """0.76 m/s^2 of the ATI's IMU: 2.4 N of a tool of 3.1 kg."""
    sensor = without_parts(PRESETS["ati_gamma_imu"], "noise", "random_walk", "drift")
    assert left(fast, sensor, "accelerometer")[0] == pytest.approx(2.4, abs=0.1)
    assert left(fast, sensor, "fused")[0] < 0.05


# Flag and messages


def test_flag_stays_while_part_of_the_reading_is_delayed():
    sensor = dataclasses.replace(QUIET, acceleration_latency=1e-3)
    constants, memory = initialize_motion_estimator(MotionEstimationConfig("fused"), sensor, 6, T)
    reading, sample, flags = np.zeros(19), np.zeros(22), []
    reading[13:] = home()
    for k in range(40):
        reading[12] = float(k == 20)
        estimate_sample_into(constants, memory, ARM.table, reading, sample)
        flags.append(sample[15])
    assert np.flatnonzero(flags).tolist() == list(range(20, 29))


def test_bandwidth_above_the_rate_is_rejected():
    with pytest.raises(DrakeTeleopError, match="encoder_bandwidth_hz"):
        initialize_motion_estimator(MotionEstimationConfig("encoders", 500.0), JR3, 6, 1e-3)
