"""Station of Fig. 4 compared with rigid-body mechanics and the paper."""

from __future__ import annotations

import gc
import re
import weakref

import numpy as np
import phantom_arrays as arrays
import pytest
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import ExternallyAppliedSpatialForce
from pydrake.systems.framework import BasicVector, Diagram, DiagramBuilder

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.lab.identification import identify_load
from drake_teleop.load.compensation import scaled_wrench
from drake_teleop.load.contact.noise_floor import NoiseFloor
from drake_teleop.load.trajectory import FourierTrajectory
from drake_teleop.station.environment.sheet_spring import SheetSpring
from drake_teleop.station.environment.slot import Slot
from drake_teleop.station.estimation.contact_detection import ContactDetectionConfig
from drake_teleop.station.master import phantom
from drake_teleop.station.master.data_sheets import PhantomJointFriction
from drake_teleop.station.operator.operator import MinimumJerk, OperatorConfig, Sine
from drake_teleop.station.operator.task import Touch
from drake_teleop.station.scenario import LoadScenario, Scenario, Simulation, replace
from drake_teleop.station.signals import SIGNALS
from drake_teleop.station.simulation import (
    MakeSimulator,
    advance_without_garbage_collection,
    simulate,
)
from drake_teleop.station.slave.arm import SENSOR_MOTION_SIZE, sensor_motion
from drake_teleop.station.slave.inverse_kinematics import IkStatus
from drake_teleop.station.slave.plant import AddSlavePlant
from drake_teleop.station.slave.slave_config import Slave
from drake_teleop.station.station import GetBlock, MakeIdentificationStation, MakeTeleopStation

FORCE_SCALE = 1 / 17.5
MASS = 3.13


@pytest.fixture(scope="module")
def slave():
    return AddSlavePlant(DiagramBuilder(), Slave(), None)


def true_estimate(slave, offset=(0.0,) * 6) -> np.ndarray:
    return np.concatenate([offset, slave.arm.phi_load])


def vertical(amplitude: float, frequency: float, **changes) -> Scenario:
    """Return an ideal loop in a vertical oscillation: no friction, no sensor errors."""
    sine = Sine(
        t_start=0.0, duration=100.0, ramp=0.5, frequency=frequency, translation=[0, 0, amplitude]
    )
    scenario = replace(
        Scenario(),
        operator=OperatorConfig(grip="firm", intent=[sine]),
        master__friction=PhantomJointFriction([0.0] * 6, [0.0] * 6),
        wrist_sensor__ideal=True,
        simulation__settle=1.0,
        simulation__duration=1.0,
    )
    return replace(scenario, **changes)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("touched", "at_once"),
    [
        ({}, 0),
        # The hand is slower than the motors, whose torques change between its samples.
        (
            {
                "sheet_spring": SheetSpring(position=[0.55, 0.0, 0.246]),
                "rates__hand_hz": 1000.0,
                "slave__friction": [11.1, 16.7, 7.0, 0.84, 0.84, 0.28],
            },
            1,
        ),
        # Down to the floor, or along a wall; the force at the hand is not tested here.
        (
            {
                "slot": Slot(position=[0.55, 0.0013, 0.222]),
                "force_scaling__force_scale": 0.0,
            },
            3,
        ),
    ],
    ids=["free", "leaf", "slot"],
)
def test_wrist_wrench_equals_drakes_reaction_force(slave, touched, at_once):
    """Compare the sample with the weld's reaction force in the same state."""
    scenario = vertical(0.07, 2.5, simulation__settle=0.0, **touched)
    simulator = MakeSimulator(MakeTeleopStation(scenario), scenario.simulation)
    simulator.Initialize()
    station, root = simulator.get_system(), simulator.get_mutable_context()
    plant, sensor = (GetBlock(station, name) for name in ("slave_plant", "wrist_sensor"))
    context, sensed = plant.GetMyContextFromRoot(root), sensor.GetMyContextFromRoot(root)
    weld = plant.GetJointByName("sensor_weld")
    place = list(plant.GetJointIndices()).index(weld.index())
    peak, contacts, most, error = 0.0, 0, 0, 0.0
    for k in range(1, 2001):
        simulator.AdvanceTo(k * 0.0005)
        reaction = plant.get_reaction_forces_output_port().Eval(context)[place]
        expected = np.concatenate([reaction.translational(), reaction.rotational()])
        if touched:
            results = plant.get_contact_results_output_port().Eval(context)
            contacts += results.num_point_pair_contacts() > 0
            most = max(most, results.num_point_pair_contacts())
        simulator.AdvancePendingEvents()
        sample = sensed.get_discrete_state_vector().value()[:6]
        peak = max(peak, np.linalg.norm(expected[:3]))
        error = max(error, np.abs(sample - expected).max())
    assert peak > 60.0
    assert (contacts > 50) == bool(touched)
    assert most >= at_once
    assert error < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "most"), [("free_motion_force", 1e-6), ("contact_transition", 0.15)]
)
def test_samples_between_steps_equal_those_of_short_steps(name, most):
    """Compare steps of 500 us with steps of 40 us."""
    scenario = replace(
        LoadScenario(name),
        wrist_sensor__ideal=True,
        simulation__settle=0.0,
        simulation__duration=0.3,
        operator__intent=[  # down into the leaf, if there is one, and up again
            MinimumJerk(t_start=0.01, duration=0.14, translation=[0.004, 0.003, -0.058]),
            MinimumJerk(t_start=0.19, duration=0.14, translation=[0.0, 0.0, 0.058]),
        ],
        force_scaling__sigma=1.0,  # sigma = 1, so that no load estimate is needed
    )
    tight = replace(scenario, simulation__accuracy=1e-9, simulation__max_step=4e-5)
    result, reference = (simulate(MakeTeleopStation(s), s.simulation) for s in (scenario, tight))
    if name == "contact_transition":
        assert reference["sheet_state"][:, 0].min() < -1e-3
    off = np.abs(result["measured_wrench_S"] - reference["measured_wrench_S"])[:, :3].max()
    # The log shows the sample 125 us before its instant, inside a step.
    assert off < most


def test_unknown_force_on_the_slave_is_an_error(slave):
    scenario = vertical(0.0, 1.0, simulation__settle=0.0, force_scaling__force_scale=0.0)
    simulator = MakeSimulator(MakeTeleopStation(scenario), scenario.simulation)
    station, root = simulator.get_system(), simulator.get_mutable_context()
    plant, sensor = (GetBlock(station, name) for name in ("slave_plant", "wrist_sensor"))
    push = ExternallyAppliedSpatialForce()
    push.body_index = plant.GetBodyByName("tool").index()
    push.F_Bq_W = SpatialForce([0.0, 0.0, 0.0], [0.0, 0.0, 2.0])
    port = plant.get_applied_spatial_force_input_port()
    port.FixValue(plant.GetMyMutableContextFromRoot(root), [push])
    told = sensor.GetInputPort("applied_wrench_W")
    fixed = told.FixValue(sensor.GetMyMutableContextFromRoot(root), [0, 0, 2.0, 0, 0, 0])
    simulator.AdvanceTo(0.2)
    sample = station.GetOutputPort("measured_wrench_S").Eval(root)
    # S points down and carries 2 N less: f = -m g - push.
    assert sample[2] == pytest.approx(-3.13 * 9.81 + 2.0, abs=0.05)
    fixed.GetMutableData().set_value(BasicVector(np.zeros(6)))
    with pytest.raises(DrakeTeleopError, match=r"wrist_sensor.applied_wrench_W: at 0\.3"):
        simulator.AdvanceTo(0.35)


def first_harmonic(signal: np.ndarray, t: np.ndarray, frequency: float) -> complex:
    """Return the amplitude over a whole number of periods."""
    return 2 * np.mean(signal * np.exp(-2j * np.pi * frequency * t))


@pytest.fixture(scope="module")
def felt(slave):
    """Return hand force and accelerations of master and slave at 1 Hz, vertical, per sigma."""
    responses = {}
    for sigma in (0.0, 0.5, 1.0, 1.5):
        scenario = vertical(0.03, 1.0, force_scaling__sigma=sigma)
        result = simulate(
            MakeTeleopStation(scenario, load_estimate=true_estimate(slave)), scenario.simulation
        )
        t = result.t[:-1]  # one period without its last sample
        height = result["pose_master"][:-1, 6]
        acceleration = -((2 * np.pi) ** 2) * first_harmonic(height, t, 1.0)
        slave_acceleration = -first_harmonic(result["specific_force_S"][:-1, 2], t, 1.0)
        hand = first_harmonic(result["hand_wrench_E"][:-1, 2], t, 1.0)
        responses[sigma] = hand, acceleration, slave_acceleration
    return responses


@pytest.mark.slow
@pytest.mark.parametrize("sigma", [0.5, 1.0, 1.5])
def test_apparent_mass_is_device_plus_sigma_times_load(felt, sigma):
    """m_a = sigma m (section V), here / 17.5 and times the slave's tracking ratio."""
    hand_0, acceleration_0, _ = felt[0.0]
    hand, acceleration, slave_acceleration = felt[sigma]
    tracking = slave_acceleration / acceleration
    added_mass = (hand / acceleration - hand_0 / acceleration_0) / tracking
    assert added_mass.real == pytest.approx(sigma * MASS * FORCE_SCALE, rel=0.02)


@pytest.mark.slow
def test_weight_and_inertia_of_the_tool_are_displayed_apart(slave):
    """Half of the weight is displayed at rest, a tenth of the mass under acceleration."""
    scenario = vertical(
        0.03, 1.0, force_scaling__sigma_weight=0.5, force_scaling__sigma_inertia=0.1
    )
    found = simulate(
        MakeTeleopStation(scenario, load_estimate=true_estimate(slave)), scenario.simulation
    )
    force, s = found["force_to_master"][:, 2] / FORCE_SCALE, found["specific_force_S"][:, 2]
    mass, weight = np.polyfit(-s - 9.81, -force, 1)  # z_S points down
    assert np.ptp(s) > 1.0
    assert weight == pytest.approx(0.5 * MASS * 9.81, rel=0.01)
    assert mass == pytest.approx(0.1 * MASS, rel=0.01)


@pytest.mark.slow
def test_apparent_mass_is_the_device_with_sigma_0(felt):
    """The mass is that of the device by closed forms, plus the hand's."""
    hand, acceleration, _ = felt[0.0]
    q = phantom.inverse_kinematics(np.array([1.0, 0, 0, 0, 0.27, 0, 0.03]))
    grip = OperatorConfig(grip="firm").hand
    M, J = arrays.mass_matrix(q, grip.mass, grip.inertia), arrays.jacobian(q)
    # Mass against a vertical force when the wrist holds the stylus upright.
    inverse_inertia = J @ np.linalg.inv(M) @ J.T
    mass = np.linalg.inv(inverse_inertia)[2, 2]
    assert (hand / acceleration).real == pytest.approx(mass, rel=0.02)


@pytest.mark.slow
def test_energy_balance_of_the_ideal_loop(slave):
    """Held wrenches and torques do an exactly known work in each period."""
    scenario = vertical(
        0.04, 1.5, rates__log_hz=2000.0, rates__sensor_hz=2000.0, simulation__settle=0.0
    )
    result = simulate(
        MakeTeleopStation(scenario, load_estimate=true_estimate(slave)), scenario.simulation
    )
    # The log shows each instant before its events: the wrenches of an entry are held from then on,
    # its torque was held until then.
    # Master: gravity is compensated, so the remaining torque changes only the kinetic energy.
    hand, twist = scenario.operator.hand, result["twist_master"]
    held = result["hand_wrench_E"] + result["force_to_master"]
    steps = np.sum(held[:-1] * (twist[1:] + twist[:-1]), axis=1) / 2 / 2000
    q, v = np.split(result["master_state"], 2, axis=1)
    kinetic = [
        0.5 * w @ arrays.mass_matrix(p, hand.mass, hand.inertia) @ w
        for p, w in zip(q, v, strict=True)
    ]
    work = np.concatenate([[0], np.cumsum(steps)])
    assert np.abs(work).max() > 0.02
    np.testing.assert_allclose(work, kinetic, atol=1e-3 * np.abs(work).max())

    # Slave: motor work = kinetic + potential energy, without contact and friction.
    plant, context = slave.plant, slave.plant.CreateDefaultContext()
    q, v = np.split(result["slave_state"], 2, axis=1)
    stored = []
    for p, w in zip(q, v, strict=True):
        plant.SetPositions(context, p)
        mass_matrix = plant.CalcMassMatrix(context)
        stored.append(0.5 * w @ mass_matrix @ w + plant.CalcPotentialEnergy(context))
    work = np.concatenate(
        [[0], np.cumsum(np.sum(result["joint_torque"][1:] * np.diff(q, axis=0), 1))]
    )
    np.testing.assert_allclose(work, np.array(stored) - stored[0], atol=1e-3 * np.ptp(stored))
    assert np.ptp(stored) > 1.0


@pytest.mark.slow
def test_station_outputs_equal_the_plain_functions(slave):
    """The blocks call these functions, so equal inputs give equal outputs."""
    scenario = vertical(0.05, 2.0, force_scaling__sigma=0.5, wrist_sensor__ideal=False)
    estimate = true_estimate(slave, scenario.wrist_sensor.offset)
    result = simulate(MakeTeleopStation(scenario, load_estimate=estimate), scenario.simulation)
    motion = ("specific_force_S", "angular_velocity_S", "angular_acceleration_S")
    wrench = scaled_wrench(
        result["measured_wrench_S"],
        estimate[:6],
        *(result[name] for name in motion),
        estimate[6:],
        np.zeros(10),
        sigma_gripper=0.5,
        sigma_object=0.0,
        gamma=1.0,
    )
    np.testing.assert_array_equal(result["scaled_wrench_S"], wrench)


@pytest.mark.slow
def test_ideal_sensor_and_true_load_give_zero_contact_wrench(slave):
    scenario = vertical(0.06, 2.5, force_scaling__sigma=0.0)
    result = simulate(
        MakeTeleopStation(scenario, load_estimate=true_estimate(slave)), scenario.simulation
    )
    assert np.abs(result["measured_wrench_S"][:, 2]).max() > 60.0
    assert np.abs(result["contact_wrench_S"]).max() < 1e-9


@pytest.mark.slow
def test_the_slave_follows_the_scaled_master(slave):
    scenario = vertical(
        0.02, 0.5, kinematic_scaling__translation_scale=2.0, simulation__duration=2.0
    )
    result = simulate(
        MakeTeleopStation(scenario, load_estimate=true_estimate(slave)), scenario.simulation
    )
    out = np.zeros(SENSOR_MOTION_SIZE)
    heights = []
    for state in result["slave_state"]:
        sensor_motion(slave.arm.table, state[:6], state[6:], np.zeros(6), out)
        heights.append(out[11])
    master = result["pose_master"][:, 6] - 0.03
    slave_offset = np.array(heights) - 0.45
    # 12 Hz position control lags a 0.5 Hz motion by about 13 ms.
    late = np.interp(result.t - 1 / (2 * np.pi * 12), result.t, master)
    assert np.ptp(slave_offset) == pytest.approx(2 * np.ptp(master), rel=0.01)
    np.testing.assert_allclose(slave_offset[50:], 2 * late[50:], atol=0.03 * np.ptp(slave_offset))


@pytest.mark.slow
def test_a_delay_delays_both_directions(slave):
    # Light load: with sigma = 1 the displayed rotational inertia exceeds that of hand and device,
    # and any delay makes the loop unstable.
    scenario = vertical(0.03, 1.0, channel__delay=0.1, force_scaling__sigma=0.1)
    result = simulate(
        MakeTeleopStation(scenario, load_estimate=true_estimate(slave)), scenario.simulation
    )
    lag = round(0.1 / 1e-3)
    # The displayed force is -1/17.5 of the force that the sensor measured 0.1 s ago; S points down.
    displayed, scaled = result["force_to_master"][:, 2], result["scaled_wrench_S"][:, 2]
    np.testing.assert_allclose(displayed[lag:], FORCE_SCALE * scaled[:-lag], atol=2e-4)
    assert np.ptp(FORCE_SCALE * scaled) > 0.01


def test_an_open_clutch_stops_the_slave(slave):
    scenario = vertical(0.03, 1.0, simulation__settle=0.0)
    station = MakeTeleopStation(scenario, load_estimate=true_estimate(slave))
    simulator = MakeSimulator(station, scenario.simulation)
    station.GetInputPort("clutch").FixValue(simulator.get_mutable_context(), [0.0])
    simulator.AdvanceTo(0.75)
    command = station.GetOutputPort("pose_command").Eval(simulator.get_context())
    master = station.GetOutputPort("pose_master").Eval(simulator.get_context())
    np.testing.assert_allclose(command[4:], scenario.slave.position, atol=1e-12)
    assert abs(master[6] - 0.03) > 0.005


@pytest.mark.slow
def test_scales_change_during_a_run_without_force_step(slave):
    """Change sigma from 1 to 0 and the force scale from 1/17.5 to 1/10 during a fast movement."""
    scenario = vertical(0.03, 1.0)
    station = MakeTeleopStation(scenario, load_estimate=true_estimate(slave))
    block = GetBlock(station, "force_scaling")

    def forces(duration: float | None) -> np.ndarray:
        simulator = MakeSimulator(station, scenario.simulation)
        advance_without_garbage_collection(simulator, 0.7)
        context = simulator.get_mutable_context()
        shown = [station.GetOutputPort("force_to_master").Eval(context)[:3].copy()]
        if duration is not None:
            block.SetScales(
                block.GetMyMutableContextFromRoot(context),
                sigma_gripper=0.0,
                sigma_object=0.0,
                gamma=1.0,
                force_scale=0.1,
                duration=duration,
            )
        for time in np.arange(0.7, 1.0, 1 / scenario.rates.hand_hz):
            advance_without_garbage_collection(simulator, time)
            shown.append(station.GetOutputPort("force_to_master").Eval(context)[:3].copy())
        return np.array(shown)

    def largest_step(force: np.ndarray) -> float:
        return float(np.linalg.norm(np.diff(force, axis=0), axis=1).max())

    changed, unchanged, at_once = forces(0.25), forces(None), forces(0.0)
    np.testing.assert_allclose(changed[-50:], 0.0, atol=1e-9)
    assert np.linalg.norm(unchanged[-50:], axis=1).max() > 0.1
    assert largest_step(changed) < 2 * largest_step(unchanged) + 0.01
    assert largest_step(at_once) > 10 * largest_step(changed)


def station_of_all_blocks() -> Diagram:
    scenario = replace(LoadScenario("contact_transition"), simulation=Simulation(duration=0.01))
    scenario = replace(scenario, channel__network="lan", load_estimator__watch=True)
    scenario = replace(scenario, operator__task=Touch())
    scenario = replace(scenario, contact_detection=ContactDetectionConfig())
    rising, still = np.zeros((6, 2)), np.zeros(6)
    floor = NoiseFloor(
        np.ones(6), np.identity(16), rising, np.identity(6), still, free_maxima=np.ones(3)
    )
    return MakeTeleopStation(
        scenario,
        load_estimate=np.ones(16),
        load_covariance=np.identity(16),
        noise_floor=floor,
    )


def test_every_output_port_is_a_signal_and_every_signal_a_port():
    station = station_of_all_blocks()
    names = {station.get_output_port(i).get_name() for i in range(station.num_output_ports())}
    assert names == set(SIGNALS)
    for name in names:
        assert station.GetOutputPort(name).size() == len(SIGNALS[name].components)


def test_a_start_out_of_reach_is_one_clear_error():
    with pytest.raises(DrakeTeleopError, match=r"slave\.position.*cannot reach"):
        MakeTeleopStation(replace(Scenario(), slave__position=[1.4, 0.0, 0.45]))


@pytest.mark.slow
def test_command_far_out_of_reach_is_clamped_and_reported(slave):
    """All joints stay within their ranges."""
    sine = Sine(duration=100.0, ramp=0.5, frequency=0.4, translation=[0.0, 0.06, 0.0])
    scenario = replace(
        Scenario(),
        operator=OperatorConfig(grip="firm", intent=[sine]),
        kinematic_scaling__translation_scale=20.0,
    )
    result = simulate(
        MakeTeleopStation(scenario, load_estimate=true_estimate(slave)), scenario.simulation
    )
    assert IkStatus.OUT_OF_REACH in result["ik_status"]
    for name in result:
        assert np.isfinite(result[name]).all(), name


def trajectory_of_joint_5(slave, amplitude: float) -> FourierTrajectory:
    cosine = np.zeros((6, 4))
    cosine[4, 0] = amplitude
    home = slave.plant.GetDefaultPositions(slave.instance)
    return FourierTrajectory.rest_to_rest(home, np.zeros((6, 4)), cosine, 0.5)


def test_elimination_without_load_estimate_is_rejected():
    with pytest.raises(DrakeTeleopError, match=r"load_estimate: .*estimate, but there is none; "):
        MakeTeleopStation(replace(Scenario(), force_scaling__sigma=0.0))
    MakeTeleopStation(replace(Scenario(), force_scaling__sigma=0.0, load_estimator__enabled=True))
    MakeTeleopStation(Scenario())
    seen = replace(Scenario(), contact_detection=ContactDetectionConfig())
    with pytest.raises(DrakeTeleopError, match=r"contact detection requires a load estimate"):
        MakeTeleopStation(seen)


@pytest.mark.parametrize("sigma", [0.0, 1.0])
def test_empty_load_estimate_is_rejected(sigma):
    """Otherwise weight and inertia of the tool (96 N) would count as contact."""
    scenario = replace(Scenario(), force_scaling__sigma=sigma)
    offsets_alone = np.repeat([1.0, 0.0], [6, 10])
    with pytest.raises(DrakeTeleopError, match=r"load_estimate: .* not identified; identify it"):
        MakeTeleopStation(scenario, load_estimate=offsets_alone)
    # A learning estimator may begin with it.
    learning = replace(scenario, load_estimator__enabled=True)
    MakeTeleopStation(learning, load_estimate=offsets_alone)


@pytest.mark.parametrize("enabled", [False, True])
def test_covariance_without_its_estimate_is_rejected(enabled):
    changes = {"load_estimator__watch": True, "load_estimator__method": "rtls"}
    scenario = replace(Scenario(), load_estimator__enabled=enabled, **changes)
    with pytest.raises(DrakeTeleopError, match=r"load_estimate: .*found None; pass both"):
        MakeTeleopStation(scenario, load_covariance=np.eye(16))


def test_station_without_load_has_no_contact_wrench():
    unknown, learning = Scenario(), replace(Scenario(), load_estimator__enabled=True)
    for scenario, told in ((unknown, False), (learning, True)):
        station = MakeTeleopStation(scenario)
        assert station.HasOutputPort("scaled_wrench_S")
        assert station.HasOutputPort("contact_wrench_S") == told
        assert station.HasOutputPort("load_estimate") == told


def test_identification_without_estimator_is_rejected():
    with pytest.raises(DrakeTeleopError, match=r"load_estimator\.enabled: .*call identified_load"):
        identify_load(LoadScenario("contact_transition"))


def test_joint_range_violation_ends_the_simulation(slave):
    scenario = replace(LoadScenario("identification"), simulation=Simulation(duration=2.0))
    station = MakeIdentificationStation(scenario, trajectory_of_joint_5(slave, 6.0))
    left = r"joint 5 of the slave left its range at \d\.\d+ s"
    with pytest.raises(DrakeTeleopError, match=left) as error:
        simulate(station, scenario.simulation)
    # The remedy in the message works.
    way, _, servo = re.search(r"(joint_control\.servo)(: )(\w+)", str(error.value)).groups()
    assert replace(scenario, **{way.replace(".", "__"): servo}).joint_control.servo == servo


@pytest.mark.slow
def test_identification_does_not_change_the_station(slave):
    """Stations do not share state."""
    short = Simulation(duration=0.02)
    scenario = replace(LoadScenario("identification"), simulation=short)
    station = MakeIdentificationStation(scenario, trajectory_of_joint_5(slave, 0.1))
    assert "joint_command" in simulate(station, short)
    assert "pose_master" in simulate(MakeTeleopStation(Scenario()), short)


@pytest.mark.slow
def test_unreferenced_stations_are_freed(slave):
    """Thousands of stations in one process need the memory of one."""
    short = Simulation(duration=0.02)
    identification = replace(LoadScenario("identification"), simulation=short)
    trajectory = trajectory_of_joint_5(slave, 0.1)
    stations = [
        station_of_all_blocks(),
        MakeTeleopStation(Scenario()),
        MakeIdentificationStation(identification, trajectory),
    ]
    for station in stations[1:]:
        simulate(station, short)
    # Python wrappers of C++ blocks are created and deleted at any time.
    sides = [side for station in stations for side in station.GetSystems()]
    blocks = [block for side in sides if hasattr(side, "GetSystems") for block in side.GetSystems()]
    ours = [system for system in blocks if type(system).__module__.startswith("drake_teleop")]
    alive = [weakref.ref(system) for system in [*stations, *ours]]
    del blocks, ours, station, sides
    gc.collect()
    assert len(alive) > 20 and all(system() is not None for system in alive)
    stations.clear()
    gc.collect()
    assert [type(left).__name__ for left in (system() for system in alive) if left] == []
