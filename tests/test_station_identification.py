"""What the identification of a station's load makes of the scenario's sensor."""

from __future__ import annotations

import numpy as np
import pytest

from drake_teleop.identification import batch_identification, slave_arm
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.scenario import Scenario, replace
from drake_teleop.sensor.sensor_chain import WristSensorConfig


@pytest.mark.parametrize("rate_hz", [100.0, 400.0])
def test_how_far_the_offsets_have_wandered_does_not_depend_on_the_rate(rate_hz):
    """Of a walk K sqrt(t) the mean over a record T is K sqrt(T / 3) off its start (Wiener)."""
    duration = 10.0
    sensor = WristSensorConfig(
        force_noise=0.1, torque_noise=0.005, force_walk=0.5, torque_walk=0.03,
        acceleration_noise=0.01, angular_acceleration_noise=0.1,
    )  # fmt: skip
    scenario = replace(Scenario(), wrist_sensor=sensor)
    turns = 2 * np.pi * np.arange(round(duration * rate_hz))[:, np.newaxis] / rate_hz / duration
    phases = np.random.default_rng(0).uniform(0.0, 2 * np.pi, (9, 4))
    sines = sum(np.sin((k + 1) * turns + phases[:, k]) for k in range(4))
    motion = 6.0 * sines[:, :3], 2.0 * sines[:, 3:6], 10.0 * sines[:, 6:]
    wrench = non_contact_wrench(*motion, slave_arm(scenario).phi_load)
    found = batch_identification(scenario, wrench, *motion, rate_hz)
    expected = np.repeat([0.5, 0.03], 3) * np.sqrt(duration / 3)
    # The load takes up a little of it.
    np.testing.assert_allclose(found.standard_deviations[:6], expected, rtol=0.05)
