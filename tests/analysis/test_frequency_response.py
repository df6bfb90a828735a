"""Frequency responses measured on the nonlinear station against its linearisation."""

import dataclasses
import runpy
from pathlib import Path

import numpy as np
import pytest
from operator_motion import intent_at

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.lab.analysis import frequency_response
from drake_teleop.lab.analysis.frequency_response import (
    MultiSine,
    StationResponse,
    measure_frequency_response,
)
from drake_teleop.lab.analysis.task_direction import task_direction
from drake_teleop.lab.identification import slave_arm, true_load
from drake_teleop.station.estimation.load_estimator import LoadEstimatorConfig
from drake_teleop.station.scenario import LoadScenario, Scenario, replace
from drake_teleop.station.station import MakeTeleopStation

bench = runpy.run_path(str(Path(__file__).parents[2] / "benchmarks" / "frequency_response.py"))
predict_frequency_response = bench["predict_frequency_response"]

UP = (0.0, 0.0, 1.0)
EXCITATION = MultiSine(lowest=0.6, period=1.5, settle=1.0)


def station(sigma: float, coulomb: float) -> Scenario:
    """Return free motion with noise, quantisation and offsets of the sensor."""
    scenario = LoadScenario("free_motion_force")
    friction = scenario.master.friction
    friction = dataclasses.replace(friction, coulomb=[coulomb * c for c in friction.coulomb])
    return replace(
        scenario,
        force_scaling__sigma=sigma,
        operator__grip="medium",
        master__friction=friction,
    )


def measured(scenario: Scenario):
    offset = scenario.wrist_sensor.offset
    estimate = np.concatenate([offset, slave_arm(scenario).phi_load])
    task = task_direction(scenario, UP)
    response = measure_frequency_response(scenario, task, EXCITATION, load_estimate=estimate)
    predicted = predict_frequency_response(scenario, task, response.omega, load_estimate=estimate)
    return response, predicted


def assert_agrees(
    response: StationResponse, predicted: StationResponse, output: str, input_: str
) -> None:
    ratio = response.response(output, input_) / predicted.response(output, input_)
    assert np.abs(np.abs(ratio) - 1).max() < 0.02
    assert np.degrees(np.abs(np.angle(ratio))).max() < 2.0
    assert response.coherence(output, input_).min() > 0.95


@pytest.mark.slow
def test_station_with_displayed_tool_agrees_with_linearisation():
    response, predicted = measured(station(sigma=1.0, coulomb=0.0))
    assert response.omega[-1] >= 2 * np.pi * 29.99
    assert_agrees(response, predicted, "hand_velocity", "hand_force")
    assert_agrees(response, predicted, "displayed_force", "hand_velocity")
    assert_agrees(response, predicted, "tool_velocity", "hand_velocity")
    assert response.apparent_mass() == pytest.approx(3.13, rel=0.01)


@pytest.mark.slow
def test_friction_without_displayed_tool_changes_only_the_device():
    response, predicted = measured(station(sigma=0.0, coulomb=1.0))
    assert_agrees(response, predicted, "tool_velocity", "hand_velocity")
    assert response.apparent_mass() == pytest.approx(0.0, abs=0.02)
    force, velocity = "hand_force", "hand_velocity"
    drag = response.response(force, velocity) - predicted.response(force, velocity)
    assert drag.real.mean() > 0.2  # N s/m


def test_multisine_has_odd_multiples_and_low_peak():
    lines = EXCITATION.odd_multiples_of_base_rate()
    assert (lines % 2 == 1).all() and (np.diff(lines) > 0).all()
    direction = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    segments = EXCITATION.sines_along(direction, start=0.2)
    start = np.array([1.0, 0.0, 0.0, 0.0, 0.27, 0.0, 0.03])
    steps = 3000
    t = 0.2 + EXCITATION.settle + np.arange(steps) / 2000.0
    _, twists = intent_at(segments, start, t)
    velocity = twists[:, 2]
    spectrum = np.abs(np.fft.rfft(velocity)) * 2 / steps
    assert spectrum[lines] == pytest.approx(EXCITATION.velocity, rel=1e-6)
    assert np.delete(spectrum, lines).max() < 1e-6
    assert np.abs(velocity).max() / velocity.std() < 2.2


@pytest.mark.slow
def test_unsuitable_multisine_raises():
    scenario = station(sigma=1.0, coulomb=0.0)
    task = task_direction(scenario, UP)
    with pytest.raises(DrakeTeleopError, match=r"MultiSine\.period"):
        measure_frequency_response(scenario, task, MultiSine(period=1.0001))
    few = StationResponse(2 * np.pi * np.array([1.0, 30.0]), {}, 1.0)
    with pytest.raises(DrakeTeleopError, match="10 Hz"):
        few.apparent_mass()


@pytest.mark.slow
@pytest.mark.parametrize("given", [False, True])
@pytest.mark.parametrize("method", ["rls", "rtls"])
def test_load_is_that_of_the_argument_or_else_of_the_scenarios_estimator(
    monkeypatch, given, method
):
    stations = []

    def stop(scenario, **_):
        stations.append(scenario)
        MakeTeleopStation(scenario, load_estimate=estimate)
        raise KeyboardInterrupt

    own = LoadEstimatorConfig(enabled=True, method=method)
    scenario = replace(LoadScenario("free_motion_force"), load_estimator=own)
    estimate = true_load(scenario) if given else None
    monkeypatch.setattr(frequency_response, "MakeTeleopStation", stop)
    along = task_direction(scenario, UP)
    with pytest.raises(KeyboardInterrupt):
        measure_frequency_response(scenario, along, MultiSine(), load_estimate=estimate)
    assert stations[0].load_estimator == (LoadEstimatorConfig() if given else own)
