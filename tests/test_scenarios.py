"""Shipped scenarios load, and their motions are feasible."""

from __future__ import annotations

import numpy as np
import pytest

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.lab.identification import slave_arm
from drake_teleop.station.master import phantom
from drake_teleop.station.scenario import LoadScenario, Rates, Scenario, ScenarioNames, replace
from drake_teleop.station.simulation import simulate
from drake_teleop.station.station import MakeTeleopStation

MOVEMENTS = ("free_motion_force", "free_motion_torque", "contact_transition", "peg_in_slot")
TASKS = ("insert", "press", "reach", "touch")
#: Tasks of seconds; their speeds, distances and forces do not depend on these fields.
SLOWER = Rates(sensor_hz=2000.0, hand_hz=1000.0, joint_control_hz=1000.0)


def run(name: str, **changes):
    """Run the scenario with the true load."""
    scenario = replace(LoadScenario(name), **changes)
    estimate = np.concatenate([scenario.wrist_sensor.offset, slave_arm(scenario).phi_load])
    station = MakeTeleopStation(scenario, load_estimate=estimate)
    return scenario, simulate(station, scenario.simulation)


def margin(values, lower, upper):
    return np.minimum(values - lower, upper - values).min(axis=0)


def test_shipped_scenarios_have_descriptions():
    assert ScenarioNames() == sorted(
        [*MOVEMENTS, *TASKS, "ideal_sensor", "identification", "push_block"]
    )
    for name in ScenarioNames():
        scenario = LoadScenario(name)
        scenario.check()
        assert scenario.description


def test_ideal_sensor_measures_the_vertical_motion():
    ideal, realistic = LoadScenario("ideal_sensor"), LoadScenario("free_motion_force")
    assert ideal == replace(realistic, description=ideal.description, wrist_sensor__ideal=True)


@pytest.fixture(scope="module")
def movement(request):
    return run(request.param, **({"rates": SLOWER} if request.param in TASKS else {}))


ALL = pytest.mark.parametrize("movement", (*MOVEMENTS, *TASKS), indirect=True)


@pytest.mark.quick_cases(2)
@pytest.mark.slow
@ALL
def test_arm_and_sensor_stay_within_their_limits(movement):
    scenario, result = movement
    arm, state = slave_arm(scenario), result["slave_state"]
    assert np.all(margin(state[:, :6], arm.lower, arm.upper) > 0.3)
    assert np.all(np.abs(state[:, 6:]) < 0.8 * arm.velocity_limit)
    assert np.all(np.abs(result["joint_torque"]) < 0.8 * arm.effort_limit)
    assert not result["saturated"].any()
    assert not result["ik_status"].any()


@pytest.mark.slow
@ALL
def test_master_stays_within_workspace_and_force(movement):
    _, result = movement
    q = result["master_state"][:, :6]
    assert np.all(margin(q, phantom.JOINT_LOWER_RAD, phantom.JOINT_UPPER_RAD) > np.radians(30))
    assert np.all(margin(q[:, 1] - q[:, 2], *phantom.Q2_MINUS_Q3_RANGE_RAD) > np.radians(20))
    force = np.linalg.norm(result["force_to_master"][:, :3], axis=1)
    assert np.all(force < 0.2 * phantom.PEAK_FORCE_N)
    assert np.all(np.linalg.norm(result["hand_wrench_E"][:, :3], axis=1) < 30)


@pytest.mark.parametrize("name", MOVEMENTS)
def test_station_is_at_rest_before_the_intent_starts(name):
    """The intent starts at 0.1 s."""
    _, result = run(name, simulation__settle=0.0, simulation__duration=0.1)
    q = result["slave_state"][:, :6]
    assert np.abs(q - q[0]).max() < 2e-4  # rad: the sensor's noise reaches the hand
    assert np.linalg.norm(np.ptp(result["pose_master"][:, 4:], axis=0)) < 1e-4  # m


@pytest.mark.parametrize("movement", ["contact_transition"], indirect=True)
def test_contact_is_one_touch_with_small_deflection(movement):
    scenario, result = movement
    bend = np.abs(result["sheet_state"][:, 0]).max()
    assert 0.002 < bend < 0.5 * scenario.sheet_spring.max_deflection_of_linear_model
    touching = np.any(result["true_contact_wrench_W"] != 0, axis=1)
    assert 0.205 < result.t[touching].min() < 0.235
    assert result.t[touching].max() < 0.3
    upwards = result["true_contact_wrench_W"][touching, 2]
    assert np.all(upwards > 0)
    assert 10 < upwards.max() < 25


@pytest.mark.parametrize("block", ["description", "slot", "environment"])
def test_field_of_a_block_without_fields_is_one_line(block):
    with pytest.raises(DrakeTeleopError, match=f"so it has no field x; set .* {block} first"):
        replace(Scenario(), **{f"{block}__x": 1.0})
