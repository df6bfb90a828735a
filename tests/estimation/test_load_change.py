"""Load change detected from the station's wrist sensor: filtered, quantised noise, 8 kHz."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import sosfilt

from drake_teleop.load.batch.methods import identify_batch
from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.load.normal_equations import NoiseStd
from drake_teleop.load.online.change import (
    STATE_CHANGED,
    STATE_IDENTIFIED,
    STATE_KNOWN,
    change_detector_parameters,
    detector_states_of_log,
    identified_or_known_load,
    initial_change_memory,
)
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.station.sensor.sensor_chain import WristSensorConfig, butterworth_sections

SENSOR, RATE, EVENT = WristSensorConfig(), 8000.0, 2.0
TOOL = phi_from_mass_com_inertia(3.13, [0.004, -0.003, 0.085], np.diag([0.012, 0.0115, 0.0045]))
OBJECT = phi_from_mass_com_inertia(0.8, [0.04, 0.0, 0.16], np.diag([8e-4, 8e-4, 4e-4]))


def samples(seed, grasp=False, duration=8.0):
    """Return (N, 15) at 8 kHz: sines, through the sensor's noise, converter and filter."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, duration, 1.0 / RATE)
    frequency, phase = rng.uniform(0.2, 1.2, (9, 3)), rng.uniform(0.0, 6.28, (9, 3))
    waves = np.sin(2 * np.pi * frequency * t[:, None, None] + phase).sum(axis=2)
    motion = waves * np.repeat([2.5, 0.7, 4.0], 3) + [0.0, 0.0, 9.0, *[0.0] * 6]
    parts = np.split(motion, 3, axis=1)
    wrench = SENSOR.offset + non_contact_wrench(*parts, TOOL)
    if grasp:
        share = np.clip((t - EVENT) / 0.05, 0.0, 1.0)[:, None]
        wrench += share * non_contact_wrench(*parts, OBJECT)
    noise = rng.normal(size=(len(t), 12)) * SENSOR.noise_std()
    raw = np.hstack([wrench, motion])
    measured = [*range(9), *range(12, 15)]
    quantum = SENSOR.resolution * SENSOR.ranges()
    raw[:, measured] = quantum * np.rint((raw[:, measured] + noise) / quantum)
    sections = butterworth_sections(SENSOR.bandwidth_hz, RATE)
    filters = np.hstack([sections[:, :3], np.ones((2, 1)), sections[:, 3:]])
    return sosfilt(filters, raw - raw[0], axis=0) + raw[0]


def parts(rows):
    return np.split(rows, [6, 9, 12], axis=1)


@pytest.fixture(scope="module")
def tool():
    s, omega, alpha = np.split(SENSOR.motion_std(), 3)
    noise = NoiseStd(SENSOR.wrench_std(), s, omega, alpha)
    return identify_batch(*parts(samples(99)), method="total", noise=noise).identification


def monitor(tool, rows, period):
    """Return the states (N,) and the identified load."""
    parameters = change_detector_parameters(SENSOR.wrench_std(), SENSOR.motion_std(), period)
    memory = initial_change_memory(np.concatenate([tool.offsets, tool.phi]), tool.covariance)
    return detector_states_of_log(memory, parameters, *parts(rows)), identified_or_known_load(
        memory, tool
    )


def test_no_alarm_in_free_motion(tool):
    for seed in range(3):
        assert monitor(tool, samples(seed), 1 / RATE)[0].max() == STATE_KNOWN


@pytest.mark.parametrize("keep", [1, 8])
def test_grasp_is_detected_at_8_and_at_1_khz(tool, keep):
    """The given noise is that before the filter, at either rate."""
    for seed in range(3):
        states, load = monitor(tool, samples(seed, grasp=True)[::keep], keep / RATE)
        assert states[: int(EVENT * RATE / keep)].max() == STATE_KNOWN
        after = np.argmax(states >= STATE_CHANGED) * keep / RATE - EVENT
        assert 0.0 < after < 0.5
        assert states[-1] == STATE_IDENTIFIED
        assert load.mass - tool.mass == pytest.approx(0.8, rel=0.01)
