"""Identification of a station's load with the scenario's sensor."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from drake_teleop.lab import identification
from drake_teleop.lab.identification import identify_by_batch, slave_arm
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.load.trajectory import FourierTrajectory
from drake_teleop.station.scenario import LoadScenario, Scenario, replace
from drake_teleop.station.sensor.sensor_chain import WristSensorConfig
from drake_teleop.station.slave.slave_config import Payload, Slave


@pytest.mark.parametrize("rate_hz", [100.0, 400.0])
def test_offset_drift_does_not_depend_on_the_rate(rate_hz):
    """The mean of a Wiener process K sqrt(t) over T is K sqrt(T / 3) from its start."""
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
    found = identify_by_batch(scenario, wrench, *motion, rate_hz)
    expected = np.repeat([0.5, 0.03], 3) * np.sqrt(duration / 3)
    # The estimated load absorbs a small part.
    np.testing.assert_allclose(found.standard_deviations[:6], expected, rtol=0.05)


def test_motion_is_designed_once_for_all_seeds_and_again_for_another_sensor(monkeypatch):
    designs = []

    def excite(robot, *, period, **_):
        designs.append(period)
        found = FourierTrajectory(np.zeros(6), *np.full((2, 6, 3), len(designs)), 1 / period)
        return SimpleNamespace(trajectory=found)

    monkeypatch.setattr(identification, "_EXCITATION_BY_INPUT_HASH", {})
    monkeypatch.setattr(identification, "excite", excite)
    monkeypatch.setattr(identification, "RobotFromScenario", lambda scenario: None)
    monkeypatch.setattr(identification, "criterion_values", lambda *_: {"kappa_w10": 4.0})

    def designed(**changes) -> float:
        scenario = replace(LoadScenario("identification"), **changes)
        trajectory, _ = identification._get_motion_and_kappa(scenario, lambda _: None)
        trajectory.rho[1:] = 99.0  # callers may change their copy
        return trajectory.rho[0, 0]

    assert designed() == designed(simulation__seed=3) == designed(rates__log_hz=500.0) == 1.0
    assert designed(wrist_sensor__bandwidth_hz=200.0) == 2.0
    assert designed(simulation__duration=7.0) == 3.0 and designs == [6.0, 6.0, 7.0]
    assert designed(slave=Slave(payload=Payload(mass=1.0))) == 4.0
    assert designed() == 1.0
