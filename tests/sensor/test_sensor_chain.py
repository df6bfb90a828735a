"""Parts of the wrist sensor's chain, and its noise."""

from __future__ import annotations

import dataclasses
import re
import runpy
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydrake.common.yaml import yaml_load
from scipy import signal
from scipy.spatial.transform import Rotation

from drake_teleop.common.config import check_all_field_values
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.station.scenario import Scenario, replace, settings_without_range_check
from drake_teleop.station.sensor.presets import PRESETS
from drake_teleop.station.sensor.sensor_chain import (
    DISABLED_PART_VALUES,
    NOISE_BLOCK_SIZE,
    PRESET_NAMES,
    SAMPLES_PER_NOISE_BLOCK,
    WristSensorConfig,
    are_values_plausible,
    calibration_matrices,
    initialize_sensor_chain,
    read_sensor_into,
    without_parts,
)

NOISE = runpy.run_path(str(Path(__file__).parents[2] / "docs" / "_ext" / "sensor_noise.py"))
allan_deviation, predicted_allan_deviation, rest_record, spectral_density = (
    NOISE[name]
    for name in ("allan_deviation", "predicted_allan_deviation", "rest_record", "spectral_density")
)

RATE, PERIOD, JOINTS = 8000.0, 125e-6, 3
BARE = without_parts(WristSensorConfig(), *DISABLED_PART_VALUES)
QUIET = ("noise", "random_walk")
RECORDS = Path(__file__).parents[2] / ".." / "shared" / "data"
ATI_AT_REST = RECORDS / "ntnu_fts_imu_contact"
UR5_AT_REST = RECORDS / "ur5_imu_fts_contact"


def readings(config, truths, noise=None, period=PERIOD):
    """Return (N, 13 + n) readings of `truths` (N, 15 + n); `noise` (blocks, NOISE_BLOCK_SIZE)."""
    blocks = (
        np.zeros((-(-len(truths) // SAMPLES_PER_NOISE_BLOCK), NOISE_BLOCK_SIZE))
        if noise is None
        else noise
    )
    constants, memory = initialize_sensor_chain(config, truths.shape[1] - 15, period)
    out = np.empty((len(truths), truths.shape[1] - 2))
    for k, truth in enumerate(truths):
        read_sensor_into(constants, memory, blocks[k // SAMPLES_PER_NOISE_BLOCK], truth, out[k])
    return out


def part(**changes):
    return dataclasses.replace(BARE, **changes)


def random_truths(count, seed=0, joints=JOINTS):
    scale = np.repeat([20.0, 1.0, 10.0, 1.0, 20.0, 1.0], [3, 3, 3, 3, 3, joints])
    return np.random.default_rng(seed).normal(size=(count, 15 + joints)) * scale


def random_noise(count, seed=1):
    blocks = -(-count // SAMPLES_PER_NOISE_BLOCK)
    return np.random.default_rng(seed).standard_normal((blocks, NOISE_BLOCK_SIZE))


def as_read(truths):
    """Return the reading of an ideal sensor at So."""
    flag = np.zeros((len(truths), 1))
    return np.hstack([truths[:, :9], truths[:, 12:15], flag, truths[:, 15:]])


@pytest.mark.parametrize("config", [PRESETS["ideal"], BARE], ids=["ideal", "all parts off"])
def test_sensor_without_parts_reads_the_truth(config):
    truths = random_truths(70)
    np.testing.assert_allclose(readings(config, truths, random_noise(70)), as_read(truths), 1e-14)


def test_every_field_that_can_be_off_belongs_to_a_part():
    fields = {field.name for field in dataclasses.fields(WristSensorConfig)}
    in_parts = [name for values in DISABLED_PART_VALUES.values() for name in values]
    ranges = {name for name in fields if name.endswith("_range")}
    assert len(in_parts) == len(set(in_parts))
    assert fields - set(in_parts) - ranges == {"preset", "ideal", "unit", "bandwidth_hz"}


@pytest.mark.parametrize("name", PRESETS)
def test_presets_are_plausible_and_settle_at_the_first_sample(name):
    config = PRESETS[name]
    check_all_field_values(config, "sensor")
    config.check("sensor", RATE)
    truths = np.repeat(random_truths(1), 400, axis=0)
    found = readings(without_parts(config, *QUIET, "drift"), truths)
    # The low-pass stores rounded values, so that its output moves within a quantum.
    quantum = config.resolution * config.ranges()
    assert np.all(np.ptp(found[:, :12], axis=0) <= quantum)
    assert np.ptp(found[:, 12:], axis=0).max() == 0.0


def test_file_accepts_every_preset():
    assert list(PRESETS) == list(PRESET_NAMES)


def test_the_default_is_the_sensor_of_the_paper():
    assert WristSensorConfig() == PRESETS["jr3_85m35a3"]


# Calibration and place


@given(unit=st.integers(0, 2**32 - 1), bound=st.floats(1e-4, 0.05))
@settings(max_examples=50, deadline=None)
def test_calibration_errors_stay_inside_their_bounds(unit, bound):
    ranges = BARE.ranges()[:6]
    matrices = calibration_matrices(
        part(unit=unit, gain_error=bound, acceleration_gain_error=bound)
    )
    for gains in matrices:
        assert np.count_nonzero(gains - np.diag(np.diag(gains))) == 0
        assert 0 < np.abs(np.diag(gains) - 1).max() <= bound
    # Each of the twelve channels has its own error.
    assert len(np.unique(np.concatenate([np.diag(gains) for gains in matrices]))) == 12
    talk, _, _ = calibration_matrices(part(unit=unit, cross_talk=bound))
    np.testing.assert_array_equal(np.diag(talk), 1.0)
    of_full_scale = (talk - np.eye(6)) * ranges / ranges[:, None]
    assert 0 < np.abs(of_full_scale).max() <= bound * (1 + 1e-12)
    turned, s, alpha = calibration_matrices(
        part(unit=unit, misalignment=bound, acceleration_misalignment=2 * bound)
    )
    np.testing.assert_array_equal(turned[:3, :3], turned[3:, 3:])
    assert np.count_nonzero(turned[:3, 3:]) == np.count_nonzero(turned[3:, :3]) == 0
    assert Rotation.from_matrix(turned[:3, :3]).magnitude() == pytest.approx(bound, rel=1e-6)
    assert Rotation.from_matrix(s).magnitude() == pytest.approx(2 * bound, rel=1e-6)
    np.testing.assert_array_equal(s, alpha)


def test_calibration_errors_are_linear_constant_and_independent_of_each_other():
    truths, errors = random_truths(40), {"gain_error": 0.01, "misalignment": 0.02}
    config = part(unit=7, cross_talk=0.01, acceleration_gain_error=0.01, **errors)
    wrench, s, alpha = calibration_matrices(config)
    found = readings(config, truths)
    np.testing.assert_allclose(found[:, :6], truths[:, :6] @ wrench.T, 1e-12, 1e-12)
    np.testing.assert_allclose(found[:, 6:9], truths[:, 6:9] @ s.T, 1e-12, 1e-12)
    np.testing.assert_allclose(found[:, 9:12], truths[:, 12:15] @ alpha.T, 1e-12, 1e-12)
    alone = calibration_matrices(part(unit=7, gain_error=0.01))[0]
    turned = calibration_matrices(part(unit=7, misalignment=0.02))[0]
    talk = calibration_matrices(part(unit=7, cross_talk=0.01))[0]
    np.testing.assert_allclose(wrench, (alone + talk - np.eye(6)) @ turned, 1e-12, 1e-15)


def test_accelerometer_on_the_rotation_axis_measures_gravity_only():
    """S moves on a circle about a vertical axis through the accelerometer."""
    radius, speed, growth = 0.12, 3.0, 5.0
    truth = np.zeros((1, 15))
    truth[0, 6:9] = [-(speed**2) * radius, growth * radius, 9.81]
    truth[0, 11], truth[0, 14] = speed, growth
    R_SA = Rotation.from_euler("xyz", [0.3, -1.0, 2.0]).as_matrix()
    config = part(p_SoAo_S=[-radius, 0.0, 0.0], R_SA=R_SA.ravel().tolist())
    found = readings(config, truth)[0]
    np.testing.assert_allclose(R_SA @ found[6:9], [0, 0, 9.81], atol=1e-13)
    np.testing.assert_allclose(R_SA @ found[9:12], [0, 0, growth], atol=1e-13)


# Low-pass


def filtered(values, bandwidth):
    sections = signal.butter(4, bandwidth, fs=RATE, output="sos")
    start = signal.sosfilt_zi(sections)[..., None] * values[0]
    return signal.sosfilt(sections, values, axis=0, zi=start)[0]


@pytest.mark.parametrize("place", ["before_noise", "after_converter"])
def test_low_pass_is_a_butterworth_with_settled_start(place):
    truths = random_truths(300)
    found = readings(part(low_pass=place, bandwidth_hz=300.0), truths)
    expected = as_read(truths)
    expected[:, :12] = filtered(expected[:, :12], 300.0)
    np.testing.assert_allclose(found, expected, 1e-9, 1e-9)


def test_low_pass_filters_only_the_effects_before_it():
    truths, noise = np.repeat(random_truths(1), 300, axis=0), random_noise(300)
    raw = part(force_noise=0.2, resolution=1e-3)
    unfiltered = readings(raw, truths, noise)
    after = readings(dataclasses.replace(raw, low_pass="after_converter"), truths, noise)
    before = readings(dataclasses.replace(raw, low_pass="before_noise"), truths, noise)
    np.testing.assert_allclose(before, unfiltered, 1e-9, 1e-9)
    # It settled on the truth, not on the first noisy sample.
    start = np.vstack([as_read(truths[:1])[:, :12], unfiltered[:, :12]])
    np.testing.assert_allclose(after[:, :12], filtered(start, 500.0)[1:], 1e-9, 1e-9)


@pytest.mark.parametrize("name", PRESETS)
def test_ramp_is_delayed_by_the_stated_delays(name):
    config = without_parts(
        PRESETS[name], *QUIET, "calibration", "offset", "drift", "quantisation", "place"
    )
    config = dataclasses.replace(config, encoder_latency=1e-3)
    slopes = np.linspace(1.0, 3.0, 15 + JOINTS)
    t = PERIOD * np.arange(2000)  # the slowest low-pass has 30 Hz
    late = t[-1] - readings(config, t[:, None] * slopes)[-1] / as_read(slopes[None])[0].clip(1e-9)
    force, acceleration, encoders = config.reading_delays(PERIOD)
    np.testing.assert_allclose(late[:6], force, atol=1e-9)
    np.testing.assert_allclose(late[6:12], acceleration, atol=1e-9)
    np.testing.assert_allclose(late[13:], encoders, atol=1e-9)


# Noise, offset, converter


def test_noise_and_walk_scale_the_given_random_numbers():
    count = 3 * SAMPLES_PER_NOISE_BLOCK + 5
    truths, noise = random_truths(count), random_noise(count)
    deviations = np.repeat([0.3, 0.02, 0.1, 2.0], 3)
    walks = np.repeat([0.4, 0.03, 0.2, 3.0], 3)
    config = part(
        force_noise=0.3, torque_noise=0.02, acceleration_noise=0.1, angular_acceleration_noise=2.0,
        force_walk=0.4, torque_walk=0.03, acceleration_walk=0.2, angular_acceleration_walk=3.0,
    )  # fmt: skip
    white = noise[:, :-12].reshape(-1, 12)[:count]
    steps = np.cumsum(noise[:, -12:], axis=0) * np.sqrt(SAMPLES_PER_NOISE_BLOCK * PERIOD)
    expected = as_read(truths)
    expected[:, :12] += (
        deviations * white + walks * np.repeat(steps, SAMPLES_PER_NOISE_BLOCK, 0)[:count]
    )
    np.testing.assert_allclose(readings(config, truths, noise), expected, 1e-12, 1e-12)


def test_offset_drifts_and_may_change_during_a_run():
    offset, bias = [1.0, 2.0, 3.0, 0.1, 0.2, 0.3], [0.3, 0.2, 0.1, 3.0, 2.0, 1.0]
    drift = [0.5, -0.4, 0.3, 0.02, -0.01, 0.03]
    truths = random_truths(100)
    found = readings(part(offset=offset, acceleration_offset=bias, drift=drift), truths)
    error = found[:, :12] - as_read(truths)[:, :12]
    expected = np.outer(np.arange(100) * PERIOD, [*drift, *[0.0] * 6])
    expected += np.array([*offset, *bias])
    np.testing.assert_allclose(error, expected, atol=1e-12)

    constants, memory = initialize_sensor_chain(part(offset=offset), JOINTS, PERIOD)
    constants[0].offset[:6] += 5.0
    reading = np.empty(13 + JOINTS)
    read_sensor_into(constants, memory, np.zeros(NOISE_BLOCK_SIZE), truths[0], reading)
    np.testing.assert_allclose(reading[:6], truths[0, :6] + offset + 5.0, 1e-12)


def test_quantisation_rounds_to_the_nearest_step():
    truths = random_truths(200)
    config = part(resolution=1e-3, encoder_resolution=0.01)
    steps = np.concatenate([config.resolution * config.ranges(), [1.0], [0.01] * JOINTS])
    found, expected = readings(config, truths), as_read(truths)
    np.testing.assert_allclose(found / steps, np.rint(found / steps), atol=1e-9)
    assert np.all(np.abs(found - expected) <= steps * 0.5 * (1 + 1e-12))


def test_saturation_clips_and_flags_with_latency_of_its_path():
    config = part(saturates=True, force_latency=3 * PERIOD, acceleration_latency=PERIOD)
    truths = np.zeros((12, 15 + JOINTS))
    truths[2, 0] = -1.5 * config.force_range[0]
    truths[7, 14] = 2 * config.angular_acceleration_range
    found = readings(config, truths)
    assert np.flatnonzero(found[:, 12]).tolist() == [5, 8]
    assert found[5, 0] == -config.force_range[0]
    assert found[8, 11] == config.angular_acceleration_range
    assert np.count_nonzero(found[:, :12]) == 2
    free = readings(dataclasses.replace(config, saturates=False), truths)
    assert free[5, 0] == -1.5 * config.force_range[0] and not free[:, 12].any()


@pytest.mark.parametrize("low_pass", ["none", "before_noise", "after_converter"])
def test_saturation_includes_the_offset(low_pass):
    """150 N with an offset of 60 N exceed the range of 200 N, with -60 N they do not."""
    truths = np.zeros((400, 15 + JOINTS))
    truths[:, 0] = 150.0
    for offset, reads, saturated in ((60.0, 200.0, True), (-60.0, 90.0, False)):
        config = part(
            saturates=True, offset=[offset, 0, 0, 0, 0, 0], low_pass=low_pass, bandwidth_hz=500.0
        )
        found = readings(config, truths)
        assert found[-1, 0] == pytest.approx(reads, rel=1e-9)
        assert found[:, 12].all() == found[:, 12].any() == saturated


def test_overload_including_offset_is_not_plausible():
    constants, _ = initialize_sensor_chain(part(saturates=True), JOINTS, PERIOD)
    truth, largest = np.zeros(15 + JOINTS), 10 * part().ranges()[0]
    assert are_values_plausible(constants, truth)
    truth[0] = 0.99 * largest
    assert are_values_plausible(constants, truth)
    constants[0].offset[0] = 0.02 * largest  # as with the offset
    assert not are_values_plausible(constants, truth)
    truth[0] = 0.0
    assert are_values_plausible(constants, truth)
    constants[0].offset[0] = np.nan
    assert not are_values_plausible(constants, truth)
    constants[0].offset[0] = 0.0
    for place in range(len(truth)):
        for bad in (np.nan, -np.inf, 1e9):
            assert not are_values_plausible(
                constants, np.where(np.arange(len(truth)) == place, bad, truth)
            )


# Latency


@given(late=st.lists(st.integers(0, 40), min_size=3, max_size=3), joints=st.integers(1, 7))
@settings(max_examples=25, deadline=None)
def test_latency_of_each_path_is_in_whole_samples(late, joints):
    force, acceleration, encoders = late
    config = part(
        force_latency=(force + 0.4) * PERIOD,
        acceleration_latency=max(acceleration - 0.4, 0) * PERIOD,
        encoder_latency=encoders * PERIOD,
    )
    assert config.latency_samples(PERIOD).tolist() == late
    truths = random_truths(100, joints=joints)
    found, expected = readings(config, truths), as_read(truths)
    columns = np.repeat(late[:2], 6).tolist() + [0] + [encoders] * joints
    before = np.arange(100)[:, None] - np.array(columns)
    rows = np.maximum(before, 0)  # the output is constant before the first sample
    np.testing.assert_array_equal(found, np.take_along_axis(expected, rows, axis=0))


def test_ideal_sensor_has_no_latency():
    config = dataclasses.replace(PRESETS["ati_gamma_imu"], ideal=True)
    assert not config.reading_delays(PERIOD).any() and not config.latency_samples(PERIOD).any()
    place, axes = config.accelerometer_pose()
    assert not place.any() and np.array_equal(axes, np.eye(3))


# Spectrum and Allan deviation

LONG = 2**18
#: Each effect separately, and the two sensors with all of them.
AT_REST = {
    "white": part(force_noise=0.25, torque_noise=0.01),
    "white and quantum": part(  # noise of 0.8 quanta: rounding adds 13 % to the power
        force_noise=0.032,
        force_range=[200.0] * 3,
        torque_noise=1.92e-3,
        acceleration_noise=8e-3,
        angular_acceleration_noise=0.08,
        resolution=2e-4,
    ),
    "walk": part(force_walk=0.05, angular_acceleration_walk=0.3),
    "jr3_85m35a3": without_parts(PRESETS["jr3_85m35a3"], "drift"),
    "ati_gamma_imu": without_parts(PRESETS["ati_gamma_imu"], "drift"),
    "before the noise": without_parts(
        dataclasses.replace(PRESETS["jr3_85m35a3"], low_pass="before_noise"), "drift"
    ),
}


@pytest.fixture(scope="module")
def records():
    return {name: rest_record(config, LONG, PERIOD, 3) for name, config in AT_REST.items()}


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in AT_REST if name != "walk"])
def test_spectrum_at_rest_equals_prediction(records, name):
    """Averaged over bands, to five standard deviations of the estimate."""
    config, length = AT_REST[name], 2048
    f, found = signal.welch(records[name], RATE, nperseg=length, noverlap=0, axis=0)
    for low, high in ((20, 60), (60, 200), (200, 400), (400, 600), (600, 1000), (1000, 2000)):
        band = (f >= low) & (f < high)
        predicted = spectral_density(config, f[band], PERIOD)
        noisy = predicted.mean(axis=1) > 0
        ratio = (found[band].T[noisy] / predicted[noisy]).mean(axis=1)
        # The Hann window correlates neighbouring lines: 1 + 2 (2/3)^2 + 2 (1/6)^2 = 1.94 times the
        # variance of independent ones.
        deviation = np.sqrt(1.94 / (band.sum() * (LONG // length)))
        assert noisy.any() and np.abs(ratio - 1).max() <= 5 * deviation, (low, ratio)


@pytest.mark.slow
@pytest.mark.parametrize("name", AT_REST)
def test_allan_deviation_at_rest_equals_prediction(records, name):
    lengths = 2 ** np.arange(0 if name != "walk" else 5, 14)
    found = allan_deviation(records[name], lengths)
    predicted = predicted_allan_deviation(AT_REST[name], lengths, PERIOD)
    noisy = predicted[:, 0] > 0
    assert noisy.any() and found[~noisy].max(initial=0.0) < 1e-9
    # Deviation of differences without overlap, an upper bound of that of the estimate; for white
    # noise, the worse of the two.
    deviation = np.sqrt(0.75 / (LONG / lengths - 1))
    assert np.all(np.abs(found[noisy] / predicted[noisy] - 1) <= 5 * deviation)


def test_the_predictions_have_the_textbook_slopes():
    lengths = np.array([1, 2, 10, 100, 3000])
    white = predicted_allan_deviation(part(force_noise=0.25), lengths, PERIOD)[0]
    np.testing.assert_allclose(white, 0.25 / np.sqrt(lengths), 1e-10)
    walk = predicted_allan_deviation(part(force_walk=0.05), lengths, PERIOD)[0]
    # IEEE 952: K sqrt(tau / 3); the second term is that of a walk in steps.
    closed = 0.05 * np.sqrt(lengths * PERIOD / 3 * (1 + 0.5 / lengths**2))
    np.testing.assert_allclose(walk, closed, 1e-10)
    f = np.array([0.1, 10.0])
    np.testing.assert_allclose(
        spectral_density(part(force_noise=0.25), f, PERIOD)[0], 0.25**2 / (RATE / 2), 1e-12
    )
    walks = spectral_density(part(force_walk=0.05), f, PERIOD)[0]
    np.testing.assert_allclose(walks, 2 * (0.05 / (2 * np.pi * f)) ** 2, 1e-4)


@given(st.integers(1, 400), st.floats(30.0, 3000.0))
@settings(max_examples=20, deadline=None)
def test_the_predicted_allan_deviation_is_that_of_the_filters_impulse_response(m, bandwidth):
    config = part(force_noise=1.0, low_pass="after_converter", bandwidth_hz=bandwidth)
    tail = int(8 * RATE / bandwidth)
    impulse = np.zeros(2 * m + tail)
    impulse[0] = 1.0
    sections = signal.butter(4, bandwidth, fs=RATE, output="sos")
    response = signal.sosfilt(sections, impulse)
    differences = np.convolve(response, np.repeat([1.0, -1.0], m) / m)[: 2 * m + tail]
    expected = np.sqrt(0.5 * np.sum(differences**2))
    found = predicted_allan_deviation(config, [m], PERIOD)[0, 0]
    assert found == pytest.approx(expected, rel=1e-6)


def test_the_same_seed_gives_the_same_bytes():
    first, second = (rest_record(WristSensorConfig(), 1000, PERIOD, 5) for _ in range(2))
    assert first.tobytes() == second.tobytes()
    assert first.tobytes() != rest_record(WristSensorConfig(), 1000, PERIOD, 6).tobytes()


def test_at_rest_gravity_is_along_z_and_the_wrench_is_the_offset():
    config = WristSensorConfig()
    mean = rest_record(config, 1000, PERIOD, 5).mean(axis=0)
    np.testing.assert_allclose(mean[:6], config.offset, atol=0.1)
    np.testing.assert_allclose(mean[6:9], [0.0, 0.0, 9.81], atol=0.05)


@pytest.mark.skipif(not ATI_AT_REST.is_dir(), reason="the recordings are not here")
@pytest.mark.parametrize(
    ("file", "figures", "unit"),
    [("wrench", {"force": slice(0, 3), "torque": slice(3, 6)}, 1.0),
     ("accel", {"acceleration": slice(0, 3)}, 9.80665)],
)  # fmt: skip
def test_ati_gamma_noise_equals_its_record(file, figures, unit):
    record = pl.read_csv(ATI_AT_REST / f"0-steady-state_{file}.csv").to_numpy() * unit
    step = allan_deviation(record, [1])[:, 0]
    for name, axes in figures.items():
        stated = getattr(PRESETS["ati_gamma_imu"], f"{name}_noise")
        assert stated == pytest.approx(np.sqrt(np.mean(step[axes] ** 2)), rel=0.03)


@pytest.mark.skipif(not UR5_AT_REST.is_dir(), reason="the recordings are not here")
def test_force_walk_equals_its_record():
    """Two averaging times only, with drift: within 30 %."""
    file = UR5_AT_REST / "No10_Standstill_ForceSensor_All2__log_force_sensor.csv"
    record = pl.read_csv(file, has_header=False).to_numpy()
    quiet = record[record[:, 0] < 8.7]  # until the first push
    lengths = np.array([256, 512])
    found = allan_deviation(quiet[:, 1:], lengths)
    third = np.sqrt(lengths * np.median(np.diff(quiet[:, 0])) / 3)
    for stated, axes in (
        (WristSensorConfig().force_walk, slice(0, 3)),
        (WristSensorConfig().torque_walk, slice(3, 6)),
    ):
        np.testing.assert_allclose(np.sqrt(np.mean(found[axes] ** 2, 0)), stated * third, rtol=0.3)


# Configuration


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"R_SA": [1.0, 0, 0, 0, 0.9, 0, 0, 0, 1]}, r"^sensor\.R_SA: is not a rotation"),
        ({"R_SA": [1.0, 0, 0, 0, 1, 0, 0, 0, -1]}, r"^sensor\.R_SA: is not a rotation"),
        ({"bandwidth_hz": 3700.0}, r"^sensor\.bandwidth_hz: .*the sensor's rate"),
    ],
)
def test_invalid_sensor_is_rejected(changes, message):
    with pytest.raises(DrakeTeleopError, match=message):
        dataclasses.replace(WristSensorConfig(), **changes).check("sensor", RATE)


def loaded(text):
    data = yaml_load(data=text)
    preset = PRESETS.get(data.get("preset"), WristSensorConfig())
    config = settings_without_range_check(WristSensorConfig, data, "sensor", preset)
    check_all_field_values(config, "sensor")
    return config


def test_file_overrides_fields_of_a_preset():
    ati = PRESETS["ati_gamma_imu"]
    config = loaded("{preset: ati_gamma_imu, force_noise: 0.5}")
    assert config == dataclasses.replace(ati, force_noise=0.5) and config.preset == "ati_gamma_imu"
    assert ati.force_noise != 0.5
    assert loaded("{preset: ideal}") == loaded("{ideal: true}") == PRESETS["ideal"]
    assert loaded("{force_noise: 0.5}") == WristSensorConfig(force_noise=0.5)
    with pytest.raises(DrakeTeleopError, match=r"preset: 'maker_x' is not known; choose one"):
        loaded("{preset: maker_x}")


def test_preset_without_effect_is_rejected():
    with pytest.raises(TypeError, match="preset"):
        WristSensorConfig(preset="ati_gamma_imu")
    with pytest.raises((TypeError, ValueError), match="preset"):
        dataclasses.replace(WristSensorConfig(), preset="ati_gamma_imu")
    with pytest.raises(DrakeTeleopError, match=r"preset: 'ideal' has no effect in Python"):
        WristSensorConfig().preset = "ideal"
    with pytest.raises(DrakeTeleopError, match=r"preset: 'ideal' has no effect in Python"):
        replace(Scenario(), wrist_sensor__preset="ideal")


DOCUMENT = (Path(__file__).parents[2] / "docs" / "sensor.md").read_text(encoding="utf-8")


def section(title):
    return DOCUMENT.partition(f"## {title}\n")[2].partition("\n## ")[0]


def test_docs_list_every_part_with_its_fields():
    rows = re.findall(r"^\| (\w+) \| (`.*?) \|", section("The parts"), re.MULTILINE)
    assert [name for name, _ in rows] == list(DISABLED_PART_VALUES)
    fields = {field.name for field in dataclasses.fields(WristSensorConfig)}
    for name, text in rows:
        named = re.findall(r"`(\w+)`", text)
        assert set(named) <= fields
        assert set(DISABLED_PART_VALUES[name]) <= set(named) or "…" in text


def test_figures_in_docs_equal_the_presets():
    row = re.compile(r"^\| `(\w+)` \|[^|]*\| ([^|]*) \| ([^|]*) \| [^|]* \|$", re.MULTILINE)
    rows = row.findall(section("The presets"))
    assert len(rows) == 18
    for field, *values in rows:
        for name, value in zip(("jr3_85m35a3", "ati_gamma_imu"), values, strict=True):
            stated = getattr(PRESETS[name], field)
            if isinstance(stated, str):
                assert value == stated, (field, name)
            else:
                numbers = [float(number) for number in value.split(",")]
                assert numbers == np.atleast_1d(stated).tolist(), (field, name)


def test_script_in_docs_runs(capsys):
    script = re.search(r"```python\n(.*?)```", DOCUMENT, re.DOTALL).group(1)
    exec(compile(script, "sensor.md", "exec"), {})
    assert capsys.readouterr().out.strip() == script.rpartition("# ")[2].strip()
