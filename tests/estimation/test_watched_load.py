"""Monitored load in the Diagram: settling, grasp, contacts, offsets."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.multibody.tree import RotationalInertia, SpatialInertia
from pydrake.systems.framework import DiagramBuilder

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.load.online.change import change_detector_parameters
from drake_teleop.load.online.recursive_tls import RecursiveTotalLeastSquares
from drake_teleop.load.online.watched import (
    LOAD_FADE_TIME_S,
    MEMORY_SIZE,
    STATE_DISTURBED,
    STATE_INDEX,
    STATE_LEARNING,
    STATE_OTHER_LOAD,
    STATE_SETTLED,
    _is_com_of_load_change_near_sensor,
    _update_force_change_detector,
    _update_rest_detector,
    initial_monitor_memory,
    monitor_load,
)
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.load.trajectory import FourierTrajectory
from drake_teleop.station.operator.operator import MinimumJerk, OperatorConfig, Sine
from drake_teleop.station.scenario import LoadScenario, Scenario, replace
from drake_teleop.station.simulation import (
    MakeSimulator,
    advance_without_garbage_collection,
    read_recorded_signals,
    simulate,
)
from drake_teleop.station.slave.plant import AddSlavePlant
from drake_teleop.station.station import GetBlock, MakeIdentificationStation, MakeTeleopStation

GRASP = 3.0
MASS, COM, INERTIA = 0.8, [0.04, 0.0, 0.16], [8e-4, 8e-4, 4e-4]
OBJECT = phi_from_mass_com_inertia(MASS, COM, np.diag(INERTIA))
SCENARIO = replace(
    LoadScenario("identification"), load_estimator__watch=True, load_estimator__method="rtls"
)
SENSOR = SCENARIO.wrist_sensor
# Result of `excite` for the station's slave, rounded.
TRAJECTORY = FourierTrajectory(
    np.array([-0.1481, -0.5268, -1.2922, 1.9415, -0.2313, -1.2508]),
    np.array([
        [-0.0466, 0.8201, -0.1875, -0.1524, -0.0843],
        [-0.2318, -0.0590, -0.1094, 0.0173, 0.1217],
        [0.9075, 0.3388, -0.2934, -0.1014, -0.0599],
        [0.2967, -0.9075, 0.9049, -0.1706, -0.1028],
        [0.1729, -0.0176, -0.2405, -0.4501, 0.4768],
        [-1.1637, 2.0826, -0.4508, -0.6788, 0.2132],
    ]),
    np.array([
        [0.2455, 0.1155, 0.1626, -0.1764, 0.0261],
        [0.1543, 0.3254, 0.2734, -0.2099, -0.0223],
        [0.2886, -0.5100, -0.2092, 0.1108, 0.0744],
        [1.4384, 0.8749, -0.5934, -0.0993, 0.0797],
        [0.2852, -0.0029, -0.1267, -0.2926, 0.2219],
        [-1.3576, -1.4207, 0.0871, 0.0948, 0.1896],
    ]),
    1 / 6,
)  # fmt: skip


@pytest.fixture(scope="module")
def tool():
    """Return phi of the plant's tool, which the station does not use."""
    return AddSlavePlant(DiagramBuilder(), SCENARIO.slave, None).arm.phi_load


def attach_object(station, simulator):
    """Add the object to the tool of the plant and to the wrist sensor's load."""
    plant = GetBlock(station, "slave_plant")
    context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    body = plant.GetBodyByName("tool")
    inertia = body.CalcSpatialInertiaInBodyFrame(context)
    inertia += SpatialInertia.MakeFromCentralInertia(MASS, COM, RotationalInertia(*INERTIA))
    body.SetSpatialInertiaInBodyFrame(context, inertia)
    GetBlock(station, "wrist_sensor").phi[:] += OBJECT


@pytest.fixture(scope="module")
def grasped():
    """Return signals of the excitation with a grasp in the middle."""
    station = MakeIdentificationStation(SCENARIO, TRAJECTORY)
    simulator = MakeSimulator(station, SCENARIO.simulation)
    simulator.Initialize()
    advance_without_garbage_collection(simulator, GRASP)
    attach_object(station, simulator)
    advance_without_garbage_collection(simulator, SCENARIO.simulation.duration)
    return read_recorded_signals(simulator, 0.0)


@pytest.fixture(scope="module")
def prior(grasped):
    """Return [offsets; phi] and covariance of the tool from the samples before the grasp."""
    names = ("measured_wrench_S", "specific_force_S", "angular_velocity_S")
    estimator = RecursiveTotalLeastSquares(SENSOR.wrench_std(), SENSOR.motion_std())
    rows = [grasped[name][:2900] for name in (*names, "angular_acceleration_S")]
    estimator.update_samples(*rows)
    return np.concatenate([estimator.offsets, estimator.phi]), estimator.covariance


@pytest.mark.parametrize(
    ("omega", "drift", "rests"), [(0.0, 0.0, True), (0.05, 0.0, False), (0.0, 0.5, False)]
)
def test_rest_is_300_ms_without_rotation_and_change_of_direction(omega, drift, rests):
    memory, sample = np.zeros(MEMORY_SIZE), np.zeros(15)
    for k in range(1000):
        sample[6:12] = [3.0 + 1e-3 * drift * k, 0.0, 9.3, 0.0, omega, 0.0]
        found = _update_rest_detector(memory, sample, 1e-3)
        assert found is False or k > 300
    assert found == rests


@pytest.mark.parametrize(("distance", "near"), [(0.9, True), (1.1, False)])
@pytest.mark.parametrize("mass", [0.5, -0.5])
def test_grasped_or_released_object_is_within_1_m_of_the_sensor(mass, distance, near):
    known, new = np.full(16, 3.0), np.full(16, 3.0)
    new[6] += mass
    new[7:10] += mass * distance * np.array([0.6, 0.0, -0.8])
    assert _is_com_of_load_change_near_sensor(known, new) == near


def test_force_changes_count_after_the_low_pass_has_settled():
    memory, period, found = np.zeros(MEMORY_SIZE), 1e-3, []
    for age in range(600):
        force = 2.0 if age < 5 else 1.0 if age >= 300 else 0.0
        residual = np.array([0.0, force, 0.0, 0.0, 0.0, 0.0])
        found.append(_update_force_change_detector(memory, residual, float(age), period))
    changed = 300 + round(1e3 * 0.05 * np.log(2.0))  # the low-pass reaches 0.5 N
    assert not any(found[: changed + 90]) and all(found[changed + 110 :])


def time_of(result, state, after=0.0):
    """Return the first time [s] of a state after a given time."""
    return result.t[np.argmax((result["load_state"][:, 0] == state) & (result.t >= after))]


@pytest.mark.slow
def test_estimate_settles_and_freezes(grasped, tool):
    settled = time_of(grasped, STATE_SETTLED)
    assert 0.1 < settled < 1.5
    during = (grasped.t >= settled) & (grasped.t < GRASP)
    assert (grasped["load_state"][during] == STATE_SETTLED).all()
    assert (grasped["load_state"][grasped.t < settled] == STATE_LEARNING).all()
    estimate = grasped["load_estimate"][during]
    np.testing.assert_array_equal(
        estimate[:, 6:], np.broadcast_to(estimate[0, 6:], (len(estimate), 10))
    )
    assert estimate[0, 6] == pytest.approx(tool[0], rel=0.002)
    com = estimate[0, 7:10] / estimate[0, 6]
    np.testing.assert_allclose(com, tool[1:4] / tool[0], atol=1e-3)


@pytest.mark.slow
def test_grasp_is_detected_and_the_object_identified(grasped):
    """The change is detected within half a second, the new load soon after."""
    assert time_of(grasped, STATE_DISTURBED) - GRASP < 0.05
    changed = time_of(grasped, STATE_OTHER_LOAD)
    assert changed - GRASP < 0.5
    again = time_of(grasped, STATE_SETTLED, changed)
    assert changed < again < changed + 2.0
    before, after = (grasped["load_estimate"][k, 6:] for k in (2900, -1))
    assert (after - before)[0] == pytest.approx(MASS, rel=0.01)
    found = (after - before)[1:4] / (after - before)[0]
    np.testing.assert_allclose(found, COM, atol=2e-3)
    assert grasped["load_state"][-1] == STATE_SETTLED


@pytest.mark.slow
def test_estimate_changes_without_a_step(grasped):
    """The load is zero between two loads; each sample changes the estimate by 1 %."""
    phi = grasped["load_estimate"][:, 6:]
    faded = phi[grasped.t < time_of(grasped, STATE_SETTLED, time_of(grasped, STATE_OTHER_LOAD))][-1]
    assert np.abs(faded[0]) < 0.01 * phi[2900, 0]
    watched = grasped.t > time_of(grasped, STATE_SETTLED) + 0.01
    steps = np.abs(np.diff(phi[watched], axis=0))
    assert (steps <= 1e-3 / LOAD_FADE_TIME_S * np.ptp(phi[watched], axis=0) * 1.02).all()


@pytest.mark.slow
def test_contacts_are_not_a_change_of_load(prior):
    """Contacts of Fig. 8, and lasting contact with the leaf at rest and sliding, change nothing."""
    touch = replace(LoadScenario("contact_transition"), load_estimator__watch=True)
    press = MinimumJerk(t_start=0.2, duration=0.5, translation=[0.0, 0.0, -0.075])
    hold = replace(
        touch,
        operator=OperatorConfig(grip="firm", intent=[press]),
        simulation__settle=0.0,
        simulation__duration=2.0,
    )
    sway = Sine(t_start=0.9, duration=9.0, ramp=0.5, frequency=1.0, translation=[0.0, 0.003, 0.0])
    slide = replace(
        hold,
        operator=OperatorConfig(grip="firm", intent=[press, sway]),
        simulation__duration=2.6,
    )
    for scenario, last in (
        (touch, STATE_SETTLED),
        (hold, STATE_DISTURBED),
        (slide, STATE_DISTURBED),
    ):
        station = MakeTeleopStation(scenario, load_estimate=prior[0], load_covariance=prior[1])
        result = simulate(station, scenario.simulation)
        states = result["load_state"][:, 0]
        assert states[0] == STATE_SETTLED and states[-1] == last
        assert set(states) == {STATE_SETTLED, STATE_DISTURBED}
        touched = np.any(result["true_contact_wrench_W"] != 0.0, axis=1)
        assert result.t[states == STATE_DISTURBED][0] - result.t[touched][0] < 0.1
        np.testing.assert_array_equal(
            result["load_estimate"][:, 6:], np.broadcast_to(prior[0][6:], (len(states), 10))
        )


def at_rest(theta, added, seed):
    """Return (N, 15) samples at 1 kHz with the arm at rest, `added` (N, 6) to the wrench."""
    rng, n = np.random.default_rng(seed), len(added)
    s, zero = np.tile([0.0, 3.0, 9.34], (n, 1)), np.zeros((n, 3))
    wrench = theta[:6] + non_contact_wrench(s, zero, zero, theta[6:]) + added
    std = np.concatenate([SENSOR.wrench_std(), SENSOR.motion_std()])
    return np.hstack([wrench, s, zero, zero]) + std / np.sqrt(8.0) * rng.normal(size=(n, 15))


def monitor_samples(prior, rows, fallback=None):
    """Return the output loads (N, 16), and the states (N,)."""
    theta, covariance = prior
    out, memory = theta.copy(), initial_monitor_memory(theta, covariance)
    options = change_detector_parameters(SENSOR.wrench_std(), SENSOR.motion_std(), 1e-3)
    handed, states = np.empty((len(rows), 16)), np.empty(len(rows))
    rest = np.zeros(10) if fallback is None else fallback
    for k, row in enumerate(rows):
        monitor_load(out, memory, row, rest, 1e-3, *options)
        handed[k], states[k] = out, memory[STATE_INDEX]
    return handed, states


@pytest.mark.parametrize(("force", "torque"), [(0.25, 0.0), (0.4, 0.0), (0.0, 0.01), (0.0, 0.025)])
def test_offsets_follow_residuals_of_a_drift_and_not_of_a_touch(force, torque):
    """Limits are 0.3 N and 0.015 N m; a light touch is hardly noticed."""
    theta = np.concatenate([np.zeros(6), OBJECT])
    variances = [*3 * [1e-4], *3 * [1e-7], *(2e-5 * OBJECT**2 + 1e-10)]
    added = np.zeros((3000, 6))
    added[500:] = [force, 0.0, 0.0, torque, 0.0, 0.0]
    handed, states = monitor_samples((theta, np.diag(variances)), at_rest(theta, added, 0))
    assert (states == STATE_SETTLED).mean() > 0.5
    share = np.linalg.norm(handed[-1, :6]) / max(force, torque)
    assert 0.4 < share < 0.8 if force < 0.3 and torque < 0.015 else share < 0.2


def test_offsets_are_kept_at_rest(prior):
    """The offsets drift by more than 1 N, within 3 s by less than the contact threshold."""
    t = np.arange(0.0, 30.0, 1e-3)[:, None]
    drift = t / 30.0 * np.array([1.5, -1.0, 1.5, 0.05, -0.05, 0.05])
    handed, states = monitor_samples(prior, at_rest(prior[0], drift, 0))
    assert (states == STATE_SETTLED).all()
    wrong = handed[-1, :6] - prior[0][:6] - drift[-1]
    assert (np.abs(wrong) < 0.15 * np.abs(drift[-1]) + np.repeat([0.05, 0.002], 3)).all()
    np.testing.assert_allclose(handed[-1, 6:], prior[0][6:], rtol=1e-12)


def test_a_push_at_rest_is_neither_an_offset_nor_a_load(prior):
    added = np.zeros((6000, 6))
    added[1000:] = [0.0, -1.5, -4.67, 0.3, 0.0, 0.0]  # along gravity, like half a kilogram
    handed, states = monitor_samples(prior, at_rest(prior[0], added, 1))
    assert states[900] == STATE_SETTLED
    assert (states[1100:] == STATE_DISTURBED).all()
    assert (np.abs(handed[-1, :6] - prior[0][:6]) < np.repeat([0.1, 0.005], 3)).all()
    np.testing.assert_allclose(handed[-1, 6:], prior[0][6:], rtol=1e-12)


@pytest.mark.slow
def test_known_gripper_stays_eliminated(prior, grasped):
    names = ("measured_wrench_S", "specific_force_S", "angular_velocity_S")
    rows = np.hstack([grasped[name] for name in (*names, "angular_acceleration_S")])[2500:]
    gripper = 0.5 * prior[0][6:]
    handed, states = monitor_samples(prior, rows, gripper)
    faded = handed[states == STATE_OTHER_LOAD][-1, 6]
    assert faded == pytest.approx(gripper[0], rel=0.02)
    assert handed[-1, 6] == pytest.approx(prior[0][6] + MASS, rel=0.01)


def test_watch_without_a_load_is_rejected():
    with pytest.raises(
        DrakeTeleopError, match=r"load_estimator.method: .rls. ignores the noise of motion.*rtls"
    ):
        replace(SCENARIO, load_estimator__method="rls").check()
    with pytest.raises(DrakeTeleopError, match=r"load_estimator.watch: .*no load to monitor"):
        MakeTeleopStation(replace(Scenario(), load_estimator__watch=True))


def test_station_without_watch_has_no_load_state():
    assert not MakeTeleopStation(Scenario()).HasOutputPort("load_state")
