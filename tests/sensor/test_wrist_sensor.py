"""The wrist sensor in the station."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pydrake.systems.framework import BasicVector, DiagramBuilder

from drake_teleop.load.trajectory import FourierTrajectory
from drake_teleop.station.environment.sheet_spring import SheetSpring
from drake_teleop.station.operator.operator import MinimumJerk
from drake_teleop.station.result import SimulationResult
from drake_teleop.station.scenario import Scenario, replace
from drake_teleop.station.sensor import wrist_sensor
from drake_teleop.station.sensor.sensor_chain import (
    SAMPLES_PER_NOISE_BLOCK,
    WristSensorConfig,
    butterworth_sections,
    without_parts,
)
from drake_teleop.station.sensor.wrist_sensor import WristSensor
from drake_teleop.station.simulation import simulate
from drake_teleop.station.slave.plant import AddSlavePlant, NominalSlave
from drake_teleop.station.slave.slave_config import Slave
from drake_teleop.station.station import GetBlock, MakeIdentificationStation, MakeTeleopStation

QUIET = without_parts(
    WristSensorConfig(), "place", "noise", "random_walk", "offset", "drift", "quantisation"
)


def at_rest(config: WristSensorConfig, **changes):
    """Run the station at rest; every sample is logged."""
    scenario = replace(
        Scenario(),
        wrist_sensor=config,
        motion_estimation__source="accelerometer",
        force_scaling__force_scale=0.0,
        rates__log_hz=8000.0,
        simulation__settle=0.2,
        simulation__duration=0.5,
        **changes,
    )
    arm = AddSlavePlant(DiagramBuilder(), scenario.slave, None).arm
    estimate = np.concatenate([config.offset, arm.phi_load])
    return simulate(MakeTeleopStation(scenario, load_estimate=estimate), scenario.simulation)


def response(cutoff: float, rate: float, frequency: float) -> complex:
    z = np.exp(2j * np.pi * frequency / rate)
    return np.prod(
        [
            (b0 + b1 / z + b2 / z**2) / (1 + a1 / z + a2 / z**2)
            for b0, b1, b2, a1, a2 in butterworth_sections(cutoff, rate)
        ]
    )


@pytest.mark.parametrize("rate", [1500.0, 8000.0])
def test_the_low_pass_is_a_fourth_order_butterworth(rate):
    cutoff = 500.0
    for frequency in (0.0, 50.0, 300.0, 500.0, 700.0):
        warped = np.tan(np.pi * frequency / rate) / np.tan(np.pi * cutoff / rate)
        expected = 1 / np.sqrt(1 + warped**8)
        assert abs(response(cutoff, rate, frequency)) == pytest.approx(expected, rel=1e-9)


@pytest.mark.slow
def test_reading_at_rest_is_weight_plus_offset():
    offset = [6.0, -3.0, 8.0, 0.3, -0.4, 0.1]
    result = at_rest(dataclasses.replace(QUIET, offset=offset))
    # S points down: Eq. (1) is -m g, which is m * 9.81 upwards, -z_S.
    weight = np.array([0, 0, -9.81])
    centre = np.array([0.004, -0.003, 0.085])
    force = 3.13 * weight
    expected = offset + np.concatenate([force, np.cross(centre, force)])
    np.testing.assert_allclose(result["measured_wrench_S"][-1], expected, atol=1e-3)
    np.testing.assert_allclose(result["specific_force_S"][-1], weight, atol=1e-3)


@pytest.mark.slow
def test_the_filtered_noise_has_the_variance_of_white_noise_through_the_filter():
    config = dataclasses.replace(QUIET, force_noise=0.25, angular_acceleration_noise=1.5)
    result = at_rest(config)
    frequencies = np.arange(4000) + 0.5
    gain = np.mean([abs(response(500.0, 8000.0, f)) ** 2 for f in frequencies])
    force = result["measured_wrench_S"][:, :3] - result["measured_wrench_S"][:, :3].mean(axis=0)
    assert force.std() == pytest.approx(0.25 * np.sqrt(gain), rel=0.05)
    assert result["angular_acceleration_S"].std() == pytest.approx(1.5 * np.sqrt(gain), rel=0.05)
    assert result["specific_force_S"].std(axis=0).max() < 1e-6


@pytest.mark.slow
def test_channels_are_independent_and_other_seeds_give_other_noise():
    config = dataclasses.replace(QUIET, force_noise=0.25, torque_noise=0.01)
    first, second = at_rest(config), at_rest(config, simulation__seed=1)
    wrench = first["measured_wrench_S"]
    correlation = np.corrcoef(wrench.T) - np.eye(6)
    assert np.abs(correlation).max() < 0.15
    assert not np.array_equal(wrench, second["measured_wrench_S"])
    np.testing.assert_array_equal(wrench, at_rest(config)["measured_wrench_S"])


@pytest.mark.slow
def test_converter_quantises_before_the_filter():
    """The reading at rest is a whole number of quanta."""
    result = at_rest(dataclasses.replace(QUIET, resolution=2.5e-4))
    force = result["measured_wrench_S"][-1, 2] / (2.5e-4 * 400.0)
    assert force == pytest.approx(round(force), abs=1e-6)
    assert result["measured_wrench_S"][-1, 2] != pytest.approx(-3.13 * 9.81, abs=1e-3)


@pytest.mark.slow
def test_a_saturated_sample_is_clipped_and_flagged():
    result = at_rest(dataclasses.replace(QUIET, force_range=[200.0, 200.0, 25.0]))
    assert (result["saturated"] == 1.0).all()
    np.testing.assert_allclose(result["measured_wrench_S"][:, 2], -25.0, atol=1e-9)
    assert (at_rest(QUIET)["saturated"] == 0.0).all()


@pytest.mark.slow
def test_angular_velocity_comes_from_the_encoders_with_their_resolution():
    rough = at_rest(dataclasses.replace(QUIET, encoder_resolution=1e-3))
    assert np.abs(rough["angular_velocity_S"]).max() < 1e-9  # rounding of the low-pass
    assert np.abs(at_rest(QUIET)["angular_velocity_S"]).max() < 0.05


def swinging(rate: float) -> SimulationResult:
    """Move all joints from a rotated start with an ideal sensor; every sample is logged."""
    scenario = replace(
        Scenario(),
        wrist_sensor__ideal=True,
        rates__sensor_hz=rate,
        rates__log_hz=rate,
        simulation__settle=0.1,
        simulation__duration=0.2,
    )
    start = [0.4, -0.3, -1.6, 0.7, -0.5, 2.0]
    swing = np.outer([0.1, -0.1, 0.15, 0.3, -0.3, 0.5], [1.0])
    trajectory = FourierTrajectory.rest_to_rest(start, np.zeros((6, 1)), swing, 2.0)
    return simulate(MakeIdentificationStation(scenario, trajectory), scenario.simulation)


@pytest.mark.slow
def test_sample_time_is_the_instant_of_the_sample():
    """Reaction force, motion and joint angles at `sample_time`, not at t, equal the sample."""
    result = swinging(8000.0)
    slave = AddSlavePlant(DiagramBuilder(), Slave(), None)
    plant, context = slave.plant, slave.plant.CreateDefaultContext()
    weld = plant.GetJointByName("sensor_weld")
    place = list(plant.GetJointIndices()).index(weld.index())
    tool, gravity_W = plant.GetBodyByName("tool"), np.array([0.0, 0.0, -9.81])
    torque = plant.get_actuation_input_port(slave.instance).FixValue(context, np.zeros(6))
    truth = []
    for state, tau in zip(result["slave_state"], result["joint_torque"], strict=True):
        plant.SetPositionsAndVelocities(context, state)
        torque.GetMutableData().set_value(BasicVector(tau))
        reaction = plant.get_reaction_forces_output_port().Eval(context)[place]
        acceleration = tool.EvalSpatialAccelerationInWorld(context)
        R_SW = tool.EvalPoseInWorld(context).rotation().matrix().T
        truth.append(
            [
                *reaction.translational(),
                *reaction.rotational(),
                *R_SW @ (acceleration.translational() - gravity_W),
                *R_SW @ tool.EvalSpatialVelocityInWorld(context).rotational(),
                *R_SW @ acceleration.rotational(),
                *state[:6],
            ]
        )
    names = (
        "measured_wrench_S",
        "specific_force_S",
        "angular_velocity_S",
        "angular_acceleration_S",
        "joint_position",
    )
    samples, times = np.hstack([result[name] for name in names]), result["sample_time"][1:, 0]
    row = np.searchsorted(result.t, times - 1e-9)
    np.testing.assert_allclose(times, result.t[row], rtol=0, atol=1e-12)
    np.testing.assert_allclose(samples[1:], np.array(truth)[row], rtol=0, atol=1e-11)
    by_row = np.abs(samples - truth).max(axis=0)
    assert by_row[:3].max() > 0.5  # N
    assert by_row.min() > 1e-4


def test_one_sample_for_equal_instants_with_rounding():
    """Rounding at 7 kHz makes a row's time later than the same instant of the 2 kHz events."""
    result = swinging(7000.0)
    np.testing.assert_allclose(result["sample_time"][1:, 0], result.t[:-1], rtol=0, atol=1e-12)
    np.testing.assert_allclose(
        result["joint_position"][1:], result["slave_state"][:-1, :6], rtol=0, atol=1e-13
    )


def test_samples_in_contact_wait_for_new_torque_or_noise():
    """Three calls per period; five periods share a torque, 128 a block of noise."""
    period, k = 1.25e-4, np.arange(3 * 1000)
    sensor: Any = SimpleNamespace(
        _period=period, _event_periods=(5 * period, SAMPLES_PER_NOISE_BLOCK * period)
    )
    due = [WristSensor._is_torque_or_noise_update_time(sensor, time) for time in k * period / 3]
    np.testing.assert_array_equal(due, (k % 15 == 0) | (k % (3 * SAMPLES_PER_NOISE_BLOCK) == 0))


def test_noisy_sensor_does_not_evaluate_plant_contact(monkeypatch):
    """The tip is in a leaf; the plant's wrench differs by rounding only."""
    asked, of_plant = [], wrist_sensor.contact_wrench_W

    def counted(*of_results):
        asked.append(of_plant(*of_results))
        return asked[-1]

    def on_a_leaf(ideal: bool, asks: bool) -> tuple[np.ndarray, int]:
        x, y, z = NominalSlave(Slave()).p_WTip_start
        scenario = replace(
            Scenario(),
            sheet_spring=SheetSpring(position=[x, y, z - 1e-3]),
            wrist_sensor__ideal=ideal,
            force_scaling__sigma=1.0,
            operator__intent=[MinimumJerk(duration=0.1, translation=[0.0, 0.0, -0.02])],
            simulation__settle=0.0,
            simulation__duration=0.15,
        )
        station, before = MakeTeleopStation(scenario), len(asked)
        sensor = GetBlock(station, "wrist_sensor")
        assert sensor._uses_plant_contact == ideal
        sensor._uses_plant_contact = asks
        result = simulate(station, scenario.simulation)
        assert np.abs(result["true_contact_wrench_W"][-20:, 2]).min() > 1.0
        return result["measured_wrench_S"], len(asked) - before

    monkeypatch.setattr(wrist_sensor, "contact_wrench_W", counted)
    told, times = on_a_leaf(True, True)
    by_law, no_times = on_a_leaf(True, False)
    assert times > 100 and no_times == 0
    assert 0.0 < np.abs(told - by_law).max() < 1e-6
    assert on_a_leaf(False, False)[1] == 0
