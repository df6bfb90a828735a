"""Assembled station without default values: frames, scales, delays, clutch.

The master's base is rotated about all three axes. Translation, rotation and force have different
scales. The two directions of the network differ, and the clutch opens and closes. The tests compare
the log with formulas in this file and with Drake's kinematics, so that an exchanged argument or a
transposed frame is found.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame, JacobianWrtVariable, MultibodyForces
from pydrake.systems.framework import Context, DiagramBuilder
from scipy.spatial.transform import Rotation

from drake_teleop.common.files import models_dir
from drake_teleop.lab.comparison.one_dof import AT_COMMAND, AT_HAND, AT_MOTOR, AT_SLAVE
from drake_teleop.lab.comparison.whole_station import station_energies
from drake_teleop.load.contact.detection import NoiseFloor
from drake_teleop.load.online.recursive_tls import RecursiveTotalLeastSquares
from drake_teleop.load.online.watched import STATE_OTHER_LOAD
from drake_teleop.station.channel.channel import Channel
from drake_teleop.station.channel.network import BACKWARD, FORWARD, NetworkConfig, newest_packets
from drake_teleop.station.estimation.contact_detection import ContactDetectionConfig
from drake_teleop.station.estimation.load_estimator import LoadEstimatorConfig
from drake_teleop.station.master.phantom import serial_joint_angles
from drake_teleop.station.operator.operator import OperatorConfig, Sine
from drake_teleop.station.passivity.energy import port_work
from drake_teleop.station.passivity.force_limit import ForceLimitConfig
from drake_teleop.station.passivity.methods import METHODS, PassivityConfig
from drake_teleop.station.result import SimulationResult
from drake_teleop.station.scaling.force_scaling import ForceScalingConfig
from drake_teleop.station.scaling.kinematic_scaling import KinematicScalingConfig
from drake_teleop.station.scenario import Rates, Scenario, Simulation, replace
from drake_teleop.station.sensor.motion_estimation import estimated_motion_std
from drake_teleop.station.sensor.sensor_chain import SAMPLES_PER_NOISE_BLOCK
from drake_teleop.station.simulation import (
    MakeSimulator,
    advance_without_garbage_collection,
    read_recorded_signals,
)
from drake_teleop.station.slave.joint_control import JointControlConfig
from drake_teleop.station.slave.plant import AddSlavePlant
from drake_teleop.station.slave.slave_config import Slave
from drake_teleop.station.station import MakeTeleopStation

ALIGNMENT = [0.5, -0.4, 0.8]
#: R_WB as roll, pitch and yaw about the fixed axes.
R_WB = Rotation.from_euler("xyz", ALIGNMENT).as_matrix()
MASTER_START, SLAVE_START = [0.25, 0.02, 0.05], [0.52, 0.04, 0.47]
TRANSLATION, ROTATION, FORCE = 1.5, 0.5, 0.04
SIGMA, GAMMA = 0.3, 1.3
#: Load estimate with an error of 10 %, so that the contact wrench is not zero, and offsets.
OFFSETS, ESTIMATED = np.array([0.5, -1.0, 2.0, 0.05, -0.1, 0.08]), 0.9
PERIOD = 1e-3  # s, period of hand, channel and log
TO_SLAVE, TO_HAND = 3, 7  # delay of a packet in steps
#: Times at which the clutch opens and closes [s]; these are rows of the log too.
OPENED, CLOSED = 800, 1000
END = 1500
#: Limits of the displayed wrench behind a channel [N, N m]: the peaks of the device.
PEAKS = 37.5, 0.17
#: Time at which both ends of a channel have left their safe state and its limits of the wrench.
SETTLED = 850
#: Rounding error after some thousand steps.
EXACT = 1e-12


@dataclass
class Recorded:
    """Log of a run, and Drake's kinematics along it.

    R_WS (N, 3, 3) and p_WS (N, 3) belong to the joint angles in the wrist sensor's sample.
    """

    scenario: Scenario
    log: SimulationResult
    plant: MultibodyPlant
    R_WS: np.ndarray
    p_WS: np.ndarray


@pytest.fixture(scope="module")
def slave():
    return AddSlavePlant(DiagramBuilder(), Slave(position=SLAVE_START), None)


def turned(**changes: object) -> Scenario:
    """Move and rotate the hand about all axes from 0.4 s on."""
    sine = Sine(
        t_start=0.4,
        duration=10.0,
        ramp=0.4,
        frequency=1.6,
        translation=[0.012, -0.015, 0.02],
        rotation=[0.2, 0.15, 0.15],
    )
    other = Sine(t_start=0.4, duration=10.0, ramp=0.3, frequency=2.3, rotation=[0.1, 0.1, -0.2])
    scenario = replace(
        Scenario(),
        simulation=Simulation(settle=0.0, duration=END * PERIOD),
        rates=Rates(sensor_hz=4e3, hand_hz=1e3, joint_control_hz=2e3, estimator_hz=500, log_hz=1e3),
        operator=OperatorConfig(grip="firm", intent=[sine, other]),
        master__position=MASTER_START,
        slave__position=SLAVE_START,
        kinematic_scaling=KinematicScalingConfig(TRANSLATION, ROTATION, ALIGNMENT),
        force_scaling__sigma=SIGMA,
        force_scaling__gamma=GAMMA,
        force_scaling__force_scale=FORCE,
    )
    return replace(scenario, **changes)


def delayed(method: str, **changes: object) -> Scenario:
    changes = {
        "channel": Channel(
            delay=TO_SLAVE * PERIOD, backward=NetworkConfig(delay=TO_HAND * PERIOD), timeout=0.05
        ),
        # A force is displayed at any speed of the hand.
        "passivity": PassivityConfig(method=method, retreat=[1e3, 1e3]),
        # Ideal sensor, because the log has other noise in the last sample of each noise block.
        "wrist_sensor__ideal": True,
    } | changes
    return turned(**changes)


def run(
    scenario: Scenario,
    slave,
    offsets: np.ndarray = OFFSETS,
    **known: Any,
) -> Recorded:
    """Run the scenario with the clutch open in rows OPENED to CLOSED; `known`: load estimate."""
    estimate = np.concatenate([offsets, ESTIMATED * slave.arm.phi_load])
    station = MakeTeleopStation(scenario, **({"load_estimate": estimate} | known))
    simulator = MakeSimulator(station, scenario.simulation)
    clutch = station.GetInputPort("clutch")
    end = round(scenario.simulation.duration / PERIOD)
    rows = round(scenario.simulation.duration * scenario.rates.log_hz)
    for engaged, until in ((1.0, OPENED), (0.0, CLOSED), (1.0, END)):
        clutch.FixValue(simulator.get_mutable_context(), [engaged])
        advance_without_garbage_collection(simulator, min(until, end) * PERIOD)
    log = read_recorded_signals(simulator, scenario.simulation.settle)
    assert len(log.t) == rows + 1
    return Recorded(scenario, log, slave.plant, *poses_of_S(slave.plant, log["joint_position"]))


def poses_of_S(plant: MultibodyPlant, angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return R_WS and p_WS at joint angles (N, 6) by Drake's kinematics."""
    context, sensor = plant.CreateDefaultContext(), plant.GetFrameByName("sensor")
    poses = []
    for q in angles:
        plant.SetPositions(context, q)
        poses.append(sensor.CalcPoseInWorld(context))
    R_WS = np.array([pose.rotation().matrix() for pose in poses])
    return R_WS, np.array([pose.translation() for pose in poses])


def poses_now(recorded: Recorded) -> tuple[np.ndarray, np.ndarray]:
    """Return R_WS and p_WS at each row's time, which is later than that of its sample."""
    return poses_of_S(recorded.plant, recorded.log["slave_state"][:, :6])


def rotations(pose: np.ndarray) -> np.ndarray:
    """Return the rotation matrices (N, 3, 3) of poses (N, 7)."""
    return Rotation.from_quat(pose[..., [1, 2, 3, 0]]).as_matrix()


def turn(R: np.ndarray) -> np.ndarray:
    """Return the rotation vectors of (N, 3, 3)."""
    return Rotation.from_matrix(R).as_rotvec()


def steps(R: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Return the motion (N, 6) since the previous row [dp; log(R_k R_(k-1)^T)], first zero."""
    moved = np.zeros((len(p), 6))
    moved[1:, :3] = np.diff(p, axis=0)
    moved[1:, 3:] = turn(R[1:] @ R[:-1].transpose(0, 2, 1))
    return moved


def inertial_wrench(log: SimulationResult, phi: np.ndarray) -> np.ndarray:
    """Return the wrench (N, 6) about So in S by Newton and Euler; phi is (10,) or (N, 10)."""
    s, omega, alpha = (
        log[name] for name in ("specific_force_S", "angular_velocity_S", "angular_acceleration_S")
    )
    phi = np.broadcast_to(phi, (len(s), 10))
    m, mc = phi[:, :1], phi[:, 1:4]
    inertia = phi[:, [4, 5, 6, 5, 7, 8, 6, 8, 9]].reshape(-1, 3, 3)
    turning, accelerating = (np.einsum("nij,nj->ni", inertia, w) for w in (omega, alpha))
    f = m * s + np.cross(alpha, mc) + np.cross(omega, np.cross(omega, mc))
    tau = np.cross(mc, s) + accelerating + np.cross(omega, turning)
    return np.hstack([f, tau])


def wanted_at_the_hand(recorded: Recorded, slave, offsets: np.ndarray = OFFSETS) -> np.ndarray:
    """Return the wrench (N, 6) -force_scale R_BW R_WS F' of each row's sample."""
    non_contact = inertial_wrench(recorded.log, ESTIMATED * slave.arm.phi_load)
    contact = recorded.log["measured_wrench_S"] - offsets - non_contact
    scaled_S = GAMMA * contact + SIGMA * non_contact
    R_BS = R_WB.T @ recorded.R_WS
    parts = [np.einsum("nij,nj->ni", R_BS, scaled_S[:, g : g + 3]) for g in (0, 3)]
    return -FORCE * np.hstack(parts)


def shortened(wrench: np.ndarray, force: float, torque: float) -> np.ndarray:
    """Return forces and torques (N, 3) that are limited in length."""
    parts = []
    for part, limit in ((wrench[:, :3], force), (wrench[:, 3:], torque)):
        length = np.linalg.norm(part, axis=1, keepdims=True)
        parts.append(part * np.minimum(1.0, limit / length))
    return np.hstack(parts)


def in_power_units(wrench_B: np.ndarray) -> np.ndarray:
    """Return the wrench in W whose work on the slave's command is that at the hand."""
    return np.hstack([wrench_B[:, :3] @ R_WB.T / TRANSLATION, wrench_B[:, 3:] @ R_WB.T / ROTATION])


def the_device() -> tuple[MultibodyPlant, Context, Frame, Frame]:
    """Return Drake's model of the Phantom from its SDF, with the frames of stylus and base."""
    phantom = MultibodyPlant(time_step=0.0)
    Parser(phantom).AddModels(str(models_dir() / "phantom.sdf"))
    phantom.WeldFrames(phantom.world_frame(), phantom.GetFrameByName("base"))
    phantom.Finalize()
    stylus = phantom.GetFrameByName("stylus")
    return phantom, phantom.CreateDefaultContext(), stylus, phantom.world_frame()


@pytest.fixture(scope="module")
def direct(slave) -> Recorded:
    return run(turned(), slave)


@pytest.fixture(scope="module")
def over_a_network(slave) -> dict[str, Recorded]:
    return {method: run(delayed(method), slave) for method in METHODS}


def test_the_hand_feels_the_slaves_wrench_in_its_own_base(direct, slave):
    expected = wanted_at_the_hand(direct, slave)
    assert np.abs(np.diff(expected, axis=0)).max() > 1e-3
    assert (np.ptp(expected, axis=0) > [0.1, 0.1, 0.1, 2e-3, 2e-3, 2e-3]).all()
    np.testing.assert_allclose(direct.log["force_to_master"], expected, atol=EXACT)


@pytest.fixture(params=["direct", *(pytest.param(m, marks=pytest.mark.slow) for m in METHODS)])
def assembled(request, direct) -> Recorded:
    if request.param == "direct":
        return direct
    return request.getfixturevalue("over_a_network")[request.param]


@pytest.fixture(params=METHODS)
def assembled_over_a_network(request, over_a_network) -> Recorded:
    return over_a_network[request.param]


def test_the_command_is_the_scaled_turned_motion_across_the_clutch(assembled):
    """The command follows the hand, rests while the clutch is open, and continues from there."""
    log = assembled.log
    command, master = log["pose_command"], log["pose_master"]
    p, R = command[:, 4:], rotations(command)
    p_master, R_master = master[:, 4:], rotations(master)
    np.testing.assert_allclose(p_master[0], MASTER_START, atol=EXACT)
    np.testing.assert_allclose(p[0], SLAVE_START, atol=EXACT)
    np.testing.assert_allclose(R[0], np.diag([1.0, -1.0, -1.0]), atol=EXACT)
    for first, last in ((0, OPENED), (CLOSED, END)):
        rows = slice(first, last + 1)
        moved = p_master[rows] - p_master[first]
        np.testing.assert_allclose(p[rows], p[first] + TRANSLATION * moved @ R_WB.T, atol=EXACT)
        turned_W = turn(R_master[rows] @ R_master[first].T) @ R_WB.T
        expected = Rotation.from_rotvec(ROTATION * turned_W).as_matrix() @ R[first]
        np.testing.assert_allclose(R[rows], expected, atol=EXACT)
        assert (np.ptp(moved, axis=0) > 0.01).all() and (np.ptp(turned_W, axis=0) > 0.03).all()
    held = slice(OPENED, CLOSED + 1)
    np.testing.assert_array_equal(command[held], np.tile(command[OPENED], (CLOSED - OPENED + 1, 1)))
    assert np.ptp(p_master[held], axis=0).max() > 0.01


def test_the_slave_goes_where_it_is_told(assembled):
    """The joint command puts S at the received pose; the arm reaches it with a lag."""
    log, plant = assembled.log, assembled.plant
    received = log["pose_received" if "pose_received" in log else "pose_command"]
    np.testing.assert_allclose(received[0, 4:], SLAVE_START, atol=EXACT)
    np.testing.assert_allclose(assembled.p_WS[0], SLAVE_START, atol=1e-5)
    R, p = poses_of_S(plant, log["joint_command"])
    np.testing.assert_allclose(p, received[:, 4:], atol=1e-9)
    np.testing.assert_allclose(R, rotations(received), atol=1e-9)
    # 12 Hz position control lags by about 13 ms.
    now, before = slice(SETTLED, None), slice(SETTLED - 13, -13)
    error = assembled.p_WS[now] - received[before, 4:]
    assert np.abs(error).max() < 0.1 * np.ptp(received[now, 4:], axis=0).max()
    error = turn(assembled.R_WS[now] @ rotations(received)[before].transpose(0, 2, 1))
    assert np.abs(error).max() < 0.1 * np.abs(turn(rotations(received)[now] @ R[0].T)).max()


@pytest.mark.slow
def test_without_a_method_a_network_delays_each_direction_by_its_own(over_a_network, slave):
    recorded = over_a_network["none"]
    log, now = recorded.log, np.arange(SETTLED, END + 1)
    np.testing.assert_allclose(
        log["pose_received"][now], log["pose_command"][now - TO_SLAVE], atol=EXACT
    )
    expected = shortened(wanted_at_the_hand(recorded, slave)[now - TO_HAND], *PEAKS)
    np.testing.assert_allclose(log["force_to_master"][now], expected, atol=EXACT)
    assert np.abs(np.diff(expected, axis=0)).max() > 1e-3


def test_each_direction_has_its_own_random_network_of_the_scenarios_seed(slave):
    lines = (
        NetworkConfig(delay=4e-3, jitter=0.7, loss=0.2),
        NetworkConfig(delay=8e-3, jitter=0.5, loss=0.1, distribution="gamma"),
    )
    fields = {name: getattr(lines[0], name) for name in ("delay", "jitter", "loss")}
    recorded = run(
        delayed("none", channel=Channel(**fields, backward=lines[1]), simulation__seed=5), slave
    )
    log, now = recorded.log, np.arange(SETTLED, END + 1)
    there, back = (
        newest_packets(line, 5, direction, END + 1, PERIOD)[now]
        for line, direction in zip(lines, (FORWARD, BACKWARD), strict=True)
    )
    assert len(np.unique(now - there)) > 3 and len(np.unique(now - back)) > 3
    np.testing.assert_allclose(log["pose_received"][now], log["pose_command"][there], atol=EXACT)
    expected = shortened(wanted_at_the_hand(recorded, slave)[back], *PEAKS)
    np.testing.assert_allclose(log["force_to_master"][now], expected, atol=EXACT)


@pytest.mark.slow
def test_the_local_limit_of_force_is_the_one_at_the_hand(over_a_network, slave):
    """The limit does not depend on the scales of motion."""
    recorded, limit = over_a_network["force_limit"], ForceLimitConfig()
    now = np.arange(SETTLED, END + 1)
    wanted = wanted_at_the_hand(recorded, slave)[now - TO_HAND]
    expected = shortened(wanted, limit.force, limit.torque)
    shown = recorded.log["force_to_master"][now]
    np.testing.assert_allclose(shown, expected, atol=EXACT)
    for part, most in ((shown[:, :3], limit.force), (shown[:, 3:], limit.torque)):
        assert np.linalg.norm(part, axis=1).max() == pytest.approx(most)
    assert (np.abs(wanted - expected) < EXACT).all(axis=1).any()


def test_the_drag_that_charges_a_channel_is_the_one_at_the_hand(slave):
    """Only the drag is displayed, because the load has a scale of zero."""
    nothing = {"force_scaling__sigma": 0.0, "force_scaling__gamma": 0.0}
    log = run(delayed("charged_tdpa", **nothing), slave).log
    for g, drag in enumerate(PassivityConfig().charged_tdpa.drag):
        felt = np.linalg.norm(log["force_to_master"][:, 3 * g : 3 * g + 3], axis=1)
        assert felt.max() == pytest.approx(drag, rel=1e-9)


@pytest.mark.slow
def test_the_flag_of_a_contact_comes_with_the_slaves_packets(slave):
    """The noise floor is so low that the moving load counts as contact."""
    rising, still = np.zeros((6, 2)), np.zeros(6)
    floor = NoiseFloor(
        0.05 * np.ones(6), np.identity(16), rising, np.identity(6), still, free_maxima=np.ones(3)
    )
    scenario = delayed("none", contact_detection=ContactDetectionConfig())
    log = run(scenario, slave, noise_floor=floor).log
    noticed, at_hand = log["contact"][:, 0], log["contact_at_hand"][:, 0]
    changed = np.flatnonzero(np.diff(noticed))
    # The detector runs at 500 Hz, the log at 1 kHz.
    assert len(changed) > 20 and (changed % 2 == 0).all()
    np.testing.assert_array_equal(at_hand[TO_HAND:], noticed[:-TO_HAND])
    direct = run(turned(contact_detection=ContactDetectionConfig()), slave, noise_floor=floor).log
    np.testing.assert_array_equal(direct["contact_at_hand"], direct["contact"])


@pytest.fixture(scope="module")
def finely_logged(slave) -> Recorded:
    """Return a run that is logged faster than any block runs, with a load estimator."""
    moving = Sine(
        duration=1.0, ramp=0.02, frequency=3.0, translation=[0.01] * 3, rotation=[0.1] * 3
    )
    scenario = delayed(
        "none",
        wrist_sensor__ideal=False,
        motion_estimation__source="encoders",
        rates=Rates(
            sensor_hz=4e3, hand_hz=1e3, joint_control_hz=2e3, estimator_hz=500.0, log_hz=8e3
        ),
        simulation=Simulation(settle=0.0, duration=0.15),
        operator=OperatorConfig(grip="firm", intent=[moving]),
        joint_control=JointControlConfig(8.0, 60.0),
        load_estimator=LoadEstimatorConfig(enabled=True, method="rtls", forgetting=0.98),
    )
    return run(scenario, slave, load_estimate=None)


def instants(recorded: Recorded, rate_hz: float) -> np.ndarray:
    """Return the rows at which something of this rate happens; the log shows it one row later."""
    step = round(recorded.scenario.rates.log_hz / rate_hz)
    return np.arange(0, len(recorded.log.t) - 1, step)


def test_every_block_runs_at_its_own_rate(finely_logged):
    """Signals change at nearly all instants of their block, and only there."""
    log, rates = finely_logged.log, finely_logged.scenario.rates
    for signal, rate_hz in {
        "measured_wrench_S": rates.sensor_hz,
        "joint_torque": rates.joint_control_hz,
        "load_estimate": rates.estimator_hz,
        "master_state": rates.hand_hz,
        "pose_command": rates.hand_hz,
        "ports": rates.hand_hz,
    }.items():
        changed = np.flatnonzero((log[signal][1:] != log[signal][:-1]).any(axis=1))
        at = instants(finely_logged, rate_hz)
        assert np.isin(changed, at).all(), signal
        assert len(changed) > 0.8 * len(at), signal


def test_the_motors_do_what_the_scenarios_controllers_ask_for(finely_logged, slave):
    """Position loop gives a speed, velocity loop an acceleration, Drake's model the torque."""
    log, plant = finely_logged.log, slave.plant
    context = plant.CreateDefaultContext()
    for row in instants(finely_logged, 2e3)[::10]:
        q, v = np.split(log["slave_state"][row], 2)
        speed = 2 * np.pi * 8.0 * (log["joint_command"][row] - q)
        assert (np.abs(speed) < slave.arm.velocity_limit).all()
        plant.SetPositions(context, q)
        plant.SetVelocities(context, v)
        gravity = MultibodyForces(plant)
        plant.CalcForceElementsContribution(context, gravity)
        torque = plant.CalcInverseDynamics(context, 2 * np.pi * 60.0 * (speed - v), gravity)
        np.testing.assert_allclose(log["joint_torque"][row + 1], torque, atol=1e-9)


def test_the_load_estimator_learns_by_the_scenarios_method_and_sensor(finely_logged):
    """The estimator of logs gives the same from the samples at the estimator's instants."""
    log, scenario = finely_logged.log, finely_logged.scenario
    sensor, period = scenario.wrist_sensor, 1 / scenario.rates.sensor_hz
    motion = estimated_motion_std(scenario.motion_estimation, sensor, 6, period)
    estimator = RecursiveTotalLeastSquares(sensor.wrench_std(), motion, forgetting=0.98)
    # The log has other noise in the last sample of each noise block.
    rows = instants(finely_logged, 500.0)
    rows = rows[log.t[rows] < 0.99 * SAMPLES_PER_NOISE_BLOCK * period]
    names = ("specific_force_S", "angular_velocity_S", "angular_acceleration_S")
    estimator.update_samples(log["measured_wrench_S"][rows], *(log[name][rows] for name in names))
    expected = np.concatenate([estimator.offsets, estimator.phi])
    np.testing.assert_allclose(log["load_estimate"][rows[-1] + 1], expected, rtol=1e-9, atol=1e-12)
    assert np.abs(expected).min() > 0.0 and len(rows) > 10


def test_the_masters_signals_are_what_their_names_say(direct):
    """Drake's model gives the device's signals, the impedance of a firm grip those of the hand."""
    log, rows = direct.log, np.arange(SETTLED, END)
    phantom, context, stylus, _ = the_device()
    for row in rows[::50]:
        q, v = np.split(log["master_state"][row], 2)
        serial = serial_joint_angles(np.array([q, v]))  # The same map transforms velocities.
        phantom.SetPositions(context, serial[0])
        phantom.SetVelocities(context, serial[1])
        X_BE, V_BE = stylus.CalcPoseInWorld(context), stylus.CalcSpatialVelocityInWorld(context)
        pose, twist = log["pose_master"][row], log["twist_master"][row]
        np.testing.assert_allclose(pose[4:], X_BE.translation(), atol=EXACT)
        np.testing.assert_allclose(rotations(pose), X_BE.rotation().matrix(), atol=EXACT)
        np.testing.assert_allclose(twist[:3], V_BE.translational(), atol=EXACT)
        np.testing.assert_allclose(twist[3:], V_BE.rotational(), atol=EXACT)
    intent, (first, second) = log["intent"], direct.scenario.operator.intent
    level = [np.sin(2 * np.pi * part.frequency * (log.t - 0.4)) for part in (first, second)]
    p = MASTER_START + np.outer(level[0], first.translation)
    turns = [
        Rotation.from_rotvec(np.outer(sine, part.rotation))
        for sine, part in zip(level, (first, second), strict=True)
    ]
    R = (turns[1] * turns[0]).as_matrix()
    np.testing.assert_allclose(intent[rows, 4:], p[rows], atol=EXACT)
    np.testing.assert_allclose(rotations(intent)[rows], R[rows], atol=EXACT)
    wanted = np.gradient(p, PERIOD, axis=0), (steps(R, p)[1:, 3:] / PERIOD)
    speed = (wanted[1][rows - 1] + wanted[1][rows]) / 2
    apart = p - log["pose_master"][:, 4:]
    turned_by = turn(R @ rotations(log["pose_master"]).transpose(0, 2, 1))
    twist, hand = log["twist_master"][rows], log["hand_wrench_E"][rows]
    force = 700.0 * apart[rows] + 20.0 * (wanted[0][rows] - twist[:, :3])
    torque = 3.0 * turned_by[rows] + 0.06 * (speed - twist[:, 3:])
    # Error of the intended velocity as a difference over 2 ms.
    np.testing.assert_allclose(hand[:, :3], force, atol=1e-3 * np.ptp(force))
    np.testing.assert_allclose(hand[:, 3:], torque, atol=1e-3 * np.ptp(torque))


def test_the_slaves_signals_are_what_their_names_say(direct, slave):
    """Measured, scaled and contact wrench and the sample's angles follow their definitions."""
    log = direct.log
    non_contact = inertial_wrench(log, ESTIMATED * slave.arm.phi_load)
    contact = log["measured_wrench_S"] - OFFSETS - non_contact
    np.testing.assert_allclose(log["contact_wrench_S"], contact, atol=1e-11)
    scaled = GAMMA * contact + SIGMA * non_contact
    np.testing.assert_allclose(log["scaled_wrench_S"], scaled, atol=1e-11)
    expected = np.tile(np.concatenate([OFFSETS, ESTIMATED * slave.arm.phi_load]), (len(log.t), 1))
    np.testing.assert_array_equal(log["load_estimate"], expected)
    # Offset of the sensor, and weight and inertia of the load.
    true = inertial_wrench(log, slave.arm.phi_load) + direct.scenario.wrist_sensor.offset
    error = log["measured_wrench_S"] - true
    assert (
        np.abs(error.mean(axis=0))[:3].max() < 0.1 and np.abs(error.mean(axis=0))[3:].max() < 0.01
    )


@pytest.mark.slow
def test_what_is_gripper_and_what_is_object_are_told_apart(slave):
    """A share eta of the object is displayed; the known load counts as the gripper.

    The true load is 10 % heavier than the estimate, whose covariance is zero.
    """
    gripper, eta = 0.5 * slave.arm.phi_load, 0.3
    scenario = turned(
        load_estimator__watch=True,
        force_scaling=ForceScalingConfig(0.0, 1.0, eta, gripper.tolist(), FORCE),
    )
    offsets = np.array(scenario.wrist_sensor.offset)
    log = run(scenario, slave, offsets, load_covariance=1e-6 * np.identity(16)).log
    known = log["load_estimate"]
    np.testing.assert_allclose(known[0], np.concatenate([offsets, 0.9 * slave.arm.phi_load]))
    np.testing.assert_allclose(known[-1, 6:], gripper, rtol=1e-3)
    assert log["load_state"][-1, 0] == STATE_OTHER_LOAD
    contact = log["measured_wrench_S"] - known[:, :6] - inertial_wrench(log, known[:, 6:])
    of_object = inertial_wrench(log, known[:, 6:] - gripper)
    np.testing.assert_allclose(log["scaled_wrench_S"], contact + eta * of_object, atol=1e-11)
    assert np.ptp(of_object, axis=0).max() > 1.0


@pytest.mark.slow
def test_a_sample_is_of_the_instant_that_the_log_says(over_a_network, slave):
    """The sample is the last one of the ideal 4 kHz sensor before the row's time."""
    log = over_a_network["none"].log
    age = log.t - log["sample_time"][:, 0]
    np.testing.assert_allclose(age[1:], 1 / 4000, atol=1e-9)
    q, v = np.split(log["slave_state"], 2, axis=1)
    np.testing.assert_allclose(log["joint_position"][1:], (q - v / 4000)[1:], atol=1e-5)
    assert np.abs(v / 4000).max() > 1e-4


def test_the_device_shows_what_it_can(slave):
    """The device displays 37.5 N, and a torque within the peaks of the wrist's motors."""
    offsets = np.array([700.0, -500.0, 600.0, 9.0, 15.0, -27.0])
    recorded = run(turned(simulation__duration=0.15), slave, offsets)
    wanted, shown = wanted_at_the_hand(recorded, slave, offsets), recorded.log["force_to_master"]
    phantom, context, stylus, base = the_device()
    length = np.linalg.norm(wanted[:, :3], axis=1)
    assert length.min() > 37.5
    np.testing.assert_allclose(
        shown[:, :3], wanted[:, :3] * (37.5 / length)[:, np.newaxis], atol=EXACT
    )
    for row, state in enumerate(recorded.log["master_state"]):
        phantom.SetPositions(context, serial_joint_angles(state[:6]))
        J = phantom.CalcJacobianAngularVelocity(context, JacobianWrtVariable.kV, stylus, base, base)
        motors = np.abs(J[:, 3:].T @ wanted[row, 3:])
        share = np.min([0.515, 0.515, 0.170] / motors)
        assert share < 1.0
        np.testing.assert_allclose(shown[row, 3:], share * wanted[row, 3:], atol=EXACT)


@pytest.mark.slow
def test_four_channels_add_force_to_motion_at_both_ends(over_a_network, slave):
    """Both ends of the method send in W and in the master's power units."""
    recorded, config = over_a_network["four_channel"], PassivityConfig(method="four_channel")
    log, own = recorded.log, config.four_channel
    p, R = log["pose_command"][:, 4:], rotations(log["pose_command"])
    R_now, p_now = poses_now(recorded)
    speed, slaves = steps(R, p) / PERIOD, steps(R_now, p_now) / PERIOD
    # The slave's servo yields to the hand's force like a spring. The ratio of force and motion
    # scales converts its stiffness to power units.
    hand = in_power_units(log["hand_wrench_E"])
    now = np.arange(SETTLED, END + 1)
    sent = now - TO_SLAVE
    for g, scale in ((0, TRANSLATION), (1, ROTATION)):
        group = slice(3 * g, 3 * g + 3)
        K, D = (
            servo[g] * GAMMA * FORCE / scale
            for servo in (config.servo_stiffness, config.servo_damping)
        )
        shift = (hand[sent, group] + D * speed[sent, group]) / K
        received = log["pose_received"][now]
        shifted = (
            received[:, 4:] - p[sent],
            turn(rotations(received) @ R[sent].transpose(0, 2, 1)),
        )
        np.testing.assert_allclose(shifted[g], shift, atol=EXACT)
        assert np.abs(hand[sent, group] / K).max() > 1e-4
    # The hand gets the slave's wrench, and a spring and damper to the slave's earlier pose.
    heard = now - TO_HAND
    apart = (p_now[heard] - p[now], turn(R_now[heard] @ R[now].transpose(0, 2, 1)))
    wrench = in_power_units(wanted_at_the_hand(recorded, slave))[heard]
    for g, scale in ((0, TRANSLATION), (1, ROTATION)):
        group = slice(3 * g, 3 * g + 3)
        wrench[:, group] += own.stiffness[g] * apart[g]
        wrench[:, group] += own.damping[g] * (slaves[heard, group] - speed[now, group])
        wrench[:, group] *= scale
    expected = shortened(np.hstack([wrench[:, :3] @ R_WB, wrench[:, 3:] @ R_WB]), *PEAKS)
    np.testing.assert_allclose(log["force_to_master"][now], expected, atol=1e-10)


@pytest.mark.slow
def test_the_hands_port_counts_the_work_of_the_device(assembled_over_a_network):
    """The wrench of row k acts until row k + 1; the log has its work at row k + 2.

    The motion is that of the command, rotated to B and divided by the scales. With the clutch
    closed,
    its translation equals the device's motion. Its rotation differs slightly: half the rotation
    angle
    does not have half the angular velocity while the axis moves.
    """
    log = assembled_over_a_network.log
    shown = log["force_to_master"]
    command = steps(rotations(log["pose_command"]), log["pose_command"][:, 4:])
    for g, scale in ((0, TRANSLATION), (1, ROTATION)):
        group = slice(3 * g, 3 * g + 3)
        moved = command[1:, group] @ R_WB / scale
        put_in = -np.cumsum(np.sum(shown[:-1, group] * moved, axis=1))
        counted = log["ports"][:, g]
        np.testing.assert_allclose(counted[2:], put_in[:-1], atol=EXACT)
        assert np.ptp(counted) > 2e-3
    closed = np.ones(END, dtype=bool)
    closed[OPENED:CLOSED] = False
    work = np.diff(port_work(shown, log["pose_master"], "held")[:, 0])
    np.testing.assert_allclose(log["ports"][2:, 0], -np.cumsum(work * closed)[:-1], atol=EXACT)
    assert np.abs(work[~closed]).sum() > 1e-5


@pytest.mark.slow
def test_the_slaves_port_counts_the_work_of_the_scaled_wrench(assembled_over_a_network, slave):
    """The work is in the master's power units, along the arm's motion at the row's time."""
    recorded = assembled_over_a_network
    wrench = in_power_units(wanted_at_the_hand(recorded, slave))
    moved = steps(*poses_now(recorded))
    for g in (0, 1):
        group = slice(3 * g, 3 * g + 3)
        put_in = np.cumsum(np.sum(wrench[:-1, group] * moved[1:, group], axis=1))
        counted = recorded.log["ports"][:, 2 + g]
        np.testing.assert_allclose(counted[2:], put_in[:-1], atol=EXACT)
        assert np.ptp(counted) > 1e-4


@pytest.mark.slow
def test_four_accounts_are_kept_of_the_station(assembled_over_a_network, slave):
    """The first two are zero to rounding without contact; for the motors this log is too slow."""
    recorded = assembled_over_a_network
    log = recorded.log
    energies = station_energies(log, recorded.scenario)
    wrench = in_power_units(wanted_at_the_hand(recorded, slave))
    received = steps(rotations(log["pose_received"]), log["pose_received"][:, 4:])
    for g in (0, 1):
        group = slice(3 * g, 3 * g + 3)
        # The log shows at row k + 1 what is sent at row k.
        put_in = np.cumsum(np.sum(wrench[:-1, group] * received[1:, group], axis=1))
        np.testing.assert_allclose(energies[:-1, AT_COMMAND, g], put_in - put_in[0], atol=EXACT)
        assert np.ptp(put_in) > 1e-4
        counted = log["ports"][1:, g] - log["ports"][1, g]
        np.testing.assert_allclose(energies[:-1, AT_HAND, g], counted, atol=EXACT)
    np.testing.assert_array_equal(energies[:, AT_SLAVE], 0.0)
    assert np.isnan(energies[:, AT_MOTOR]).all()


def test_the_motors_account_is_the_arms_speed(finely_logged, slave):
    """The motors' work beyond the weight is the arm's kinetic energy, as there is no friction."""
    log, scenario = finely_logged.log, finely_logged.scenario
    power = GAMMA * FORCE / np.array([TRANSLATION, ROTATION])
    given = -(station_energies(log, scenario)[:, AT_MOTOR] / power).sum(axis=1)
    context, rows = slave.plant.CreateDefaultContext(), slice(None, None, 16)
    moving = []
    for state in log["slave_state"][rows]:
        slave.plant.SetPositionsAndVelocities(context, state)
        moving.append(slave.plant.CalcKineticEnergy(context))
    np.testing.assert_allclose(given[rows], moving, atol=1e-6)
    assert max(moving) > 0.02
