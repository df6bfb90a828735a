"""Properties of every method: finite, limited, numbered outputs; independence of frames."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
import pytest

from drake_teleop.common.config import check_all_field_values
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.vectors import normalized_quaternion, quaternion_product, rotate_vector
from drake_teleop.lab.comparison.one_dof import (
    OneDof,
    Task,
    measures_of_run,
    operator_intent,
    run_one_dof,
)
from drake_teleop.station.channel.network import NetworkConfig
from drake_teleop.station.master.data_sheets import Master
from drake_teleop.station.passivity import four_channel, ledger_slave, pspm, tdpa, two_layer, wave
from drake_teleop.station.passivity.force_limit import _WRENCH_LIMIT_SLICE, ForceLimitConfig
from drake_teleop.station.passivity.memory import (
    DISSIPATED_ENERGY,
    LAST_PORT_WRENCH,
    MEMORY_SIZE,
    RECEIVED_ENERGY,
    SENT_ENERGY,
    SERVO_D,
    SERVO_K,
    SLAVE_MASS,
    SLAVE_PER_MASTER_MOTION,
    STORED_ENERGY,
    WRENCH_LIMIT,
)
from drake_teleop.station.passivity.methods import (
    METHODS,
    PassivityConfig,
    initial_method_memory,
    master_step,
    method_parameters,
    slave_step,
    step_addresses,
)
from drake_teleop.station.passivity.packet import (
    CUMULATIVE_ENERGY,
    PACKET_NUMBER,
    PACKET_SIZE,
    POSE,
    SENDER_INPUTS_FINITE,
    VELOCITY,
    WRENCH,
    move_pose_into,
    pose_difference_into,
)
from drake_teleop.station.passivity.two_layer import TwoLayerConfig, _update_tank_and_send_energy

T = 1e-3
START = np.array([1.0, 0.0, 0.0, 0.0, 0.1, -0.2, 0.3])


def poses(rng: np.random.Generator, steps: int) -> np.ndarray:
    """Return (steps, 7): a smooth random motion from `START` in all six degrees of freedom."""
    t = np.arange(steps) * T
    pose = np.tile(START, (steps, 1))
    phase, rate = rng.uniform(0, 6, 6), rng.uniform(3, 12, 6)
    e = 0.05 * (np.sin(np.outer(t, rate) + phase) - np.sin(phase))
    for k in range(steps):
        move_pose_into(START, e[k], pose[k])
    return pose


def wrenches(rng: np.random.Generator, steps: int) -> np.ndarray:
    """Return (steps, 6): a random contact wrench that is zero half of the time."""
    t = np.arange(steps) * T
    f = np.array([6.0, 6.0, 6.0, 0.1, 0.1, 0.1]) * np.sin(
        np.outer(t, rng.uniform(2, 30, 6)) + rng.uniform(0, 6, 6)
    )
    return f * (np.sin(7.0 * t) > 0)[:, None]


class EnergyBalance(NamedTuple):
    """Energy balance of one end, each (2,) for translation and rotation [J]."""

    stored: np.ndarray
    received: np.ndarray
    sent: np.ndarray
    lost: np.ndarray


def energy_balance(memory: np.ndarray) -> EnergyBalance:
    parts = STORED_ENERGY, RECEIVED_ENERGY, SENT_ENERGY, DISSIPATED_ENERGY
    return EnergyBalance(*(memory[part] for part in parts))


def run(method, config, master_poses, slave_poses, f_e, newest):
    """Simulate both ends; packet `newest[way, k]` is the newest at step k (-1: none).

    Returns:
        wrench at the hand (N, 6), command of the slave (N, 13), both packets (2, N, PACKET_SIZE),
        increments of both ends (2, N, 6), both memories.
    """
    steps = len(f_e)
    p = method_parameters(config)
    memory = [initial_method_memory(method, p, ends[0]) for ends in (master_poses, slave_poses)]
    sent = np.zeros((2, steps, PACKET_SIZE))
    wrench, command, dx = np.zeros((steps, 6)), np.zeros((steps, 13)), np.zeros((2, steps, 6))
    nothing = np.zeros(PACKET_SIZE)
    m = step_addresses(method)
    for k in range(steps):
        for end, pose in enumerate((master_poses, slave_poses)):
            pose_difference_into(pose[k], pose[max(k - 1, 0)], dx[end, k])
            j, before = newest[1 - end, k], newest[1 - end, max(k - 1, 0)]
            received = nothing if j < 0 else sent[1 - end, j]
            fresh = j >= 0 and (k == 0 or j != before)
            twist = dx[end, k] / T
            if end == 0:
                master_step(
                    m, received, fresh, pose[k], twist, dx[end, k], np.zeros(6), p[WRENCH_LIMIT],
                    T, p, memory[end], wrench[k], sent[end, k],
                )  # fmt: skip
            else:
                slave_step(
                    m, received, fresh, pose[k], twist, dx[end, k], f_e[k], T, p,
                    memory[end], command[k], sent[end, k],
                )  # fmt: skip
    return wrench, command, sent, dx, memory


def line(rng: np.random.Generator, steps: int, delay: int = 20, jitter: int = 20) -> np.ndarray:
    """Return (2, steps) newest packets of a line that delays, reorders and loses a tenth."""
    newest = np.full((2, steps), -1)
    for way in range(2):
        arrival = np.arange(steps) + delay + rng.integers(0, jitter + 1, steps)
        for j in np.flatnonzero(rng.uniform(size=steps) > 0.1):
            if arrival[j] < steps:
                newest[way, arrival[j]] = max(newest[way, arrival[j]], j)
        newest[way] = np.maximum.accumulate(newest[way])
    return newest


@pytest.mark.parametrize("method", METHODS)
def test_outputs_are_finite_limited_and_numbered(method):
    rng = np.random.default_rng(1)
    config = PassivityConfig(method=method, force_limit=2.0, torque_limit=0.04)
    f_e = wrenches(rng, 1500) * np.repeat([1.0, 10.0], 3)  # the torque reaches its limit, too
    wrench, command, sent, *_ = run(
        method, config, poses(rng, 1500), poses(rng, 1500), f_e, line(rng, 1500)
    )
    assert np.isfinite(wrench).all() and np.isfinite(command).all() and np.isfinite(sent).all()
    assert np.linalg.norm(wrench[:, :3], axis=1).max() <= 2.0 + 1e-12
    assert np.linalg.norm(wrench[:, 3:], axis=1).max() <= 0.04 + 1e-12
    assert np.linalg.norm(wrench[:, :3], axis=1).max() > 1e-3, "nothing was ever displayed"
    np.testing.assert_allclose(np.linalg.norm(command[:, :4], axis=1), 1.0, atol=1e-9)
    for end in range(2):
        np.testing.assert_array_equal(sent[end, :, PACKET_NUMBER], np.arange(1500))
        assert (sent[end, :, SENDER_INPUTS_FINITE] == 1).all()


@pytest.mark.parametrize("method", METHODS)
def test_result_is_independent_of_the_world_axes(method):
    """A constant rotation of all inputs rotates the outputs."""
    rng = np.random.default_rng(2)
    config = PassivityConfig(method=method)
    master, slave, f_e, newest = (
        poses(rng, 800),
        poses(rng, 800),
        wrenches(rng, 800),
        line(rng, 800),
    )
    R = normalized_quaternion(tuple(rng.normal(size=4)))

    def rotated(vectors):
        return np.array([[*rotate_vector(R, v[:3]), *rotate_vector(R, v[3:6])] for v in vectors])

    def rotated_poses(x):
        return np.array(
            [[*quaternion_product(R, tuple(row[:4])), *rotate_vector(R, row[4:])] for row in x]
        )

    wrench, command, *_ = run(method, config, master, slave, f_e, newest)
    wrench_R, command_R, *_ = run(
        method, config, rotated_poses(master), rotated_poses(slave), rotated(f_e), newest
    )
    np.testing.assert_allclose(wrench_R, rotated(wrench), atol=1e-8)
    np.testing.assert_allclose(command_R[:, :7], rotated_poses(command[:, :7]), atol=1e-9)
    np.testing.assert_allclose(command_R[:, 7:], rotated(command[:, 7:]), atol=1e-6)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_input_not_finite_gives_zero_force_and_keeps_the_ledgers(method, bad):
    p = method_parameters(PassivityConfig(method=method))
    memory = initial_method_memory(method, p, START)
    received, zero = np.zeros(PACKET_SIZE), np.zeros(6)
    wrench, command, packet = np.ones(6), np.zeros(13), np.zeros(PACKET_SIZE)
    m = step_addresses(method)
    master_step(
        m, received, False, START, zero, zero, zero, p[WRENCH_LIMIT], T, p, memory, wrench, packet
    )
    before = memory.copy()
    received[20] = bad
    wrench[:] = 1.0
    master_step(
        m, received, True, START, zero, zero, zero, p[WRENCH_LIMIT], T, p, memory, wrench, packet
    )
    assert (wrench == 0).all() and packet[SENDER_INPUTS_FINITE] == 0 and np.isfinite(packet).all()
    np.testing.assert_array_equal(memory[1:], before[1:])
    slave_step(m, received, True, START, zero, zero, zero, T, p, memory, command, packet)
    np.testing.assert_array_equal(command[:7], START)
    assert (
        (command[7:] == 0).all()
        and packet[SENDER_INPUTS_FINITE] == 0
        and packet[PACKET_NUMBER] == 2
    )


@pytest.mark.parametrize("method", METHODS)
def test_step_writes_only_into_its_arguments(method):
    """Compiled code does not check bounds: each array lies between other numbers here."""
    rng, m = np.random.default_rng(4), step_addresses(method)
    around = []

    def guarded(values):
        wide = rng.uniform(1.0, 2.0, len(values) + 16)
        wide[8:-8] = values
        around.append((wide, wide.copy()))
        return wide[8:-8]

    p = guarded(method_parameters(PassivityConfig(method=method)))
    ends = [guarded(initial_method_memory(method, p, START)) for _ in range(2)]
    packets = [guarded(np.zeros(PACKET_SIZE)) for _ in range(2)]
    wrench, command, hand, limits = (guarded(x) for x in np.split(np.zeros(27), [6, 19, 25]))
    limits[:] = p[WRENCH_LIMIT]
    path = poses(rng, 200)
    for k in range(1, 200):
        pose, dx, f_e = guarded(path[k]), guarded(np.zeros(6)), guarded(rng.normal(size=6))
        pose_difference_into(pose, path[k - 1], dx)
        twist, given = guarded(dx / T), [packet.copy() for packet in packets]
        master_step(
            m, given[1], True, pose, twist, dx, hand, limits, T, p, ends[0], wrench, packets[0]
        )
        slave_step(m, given[0], True, pose, twist, dx, f_e, T, p, ends[1], command, packets[1])
    for wide, before in around:
        np.testing.assert_array_equal(wide[:8], before[:8])
        np.testing.assert_array_equal(wide[-8:], before[-8:])


@pytest.mark.parametrize("method", METHODS)
def test_slave_keeps_its_pose_until_a_packet_arrives(method):
    rng = np.random.default_rng(3)
    config = PassivityConfig(method=method)
    still = np.tile(START, (50, 1))
    _, command, *_ = run(
        method, config, poses(rng, 50), still, np.zeros((50, 6)), np.full((2, 50), -1)
    )
    np.testing.assert_allclose(command, np.tile([*START, *np.zeros(6)], (50, 1)), atol=1e-12)


@pytest.mark.parametrize("power", [(1.0, 1.0), (0.5, 8.0)])
@pytest.mark.parametrize("motion", [(1.0, 1.0), (4.0, 0.25)])
@pytest.mark.parametrize("limits", [(3.0, 0.2), (0.7, 5.0)])
def test_limits_and_servo_have_their_own_scales(power, motion, limits):
    config = PassivityConfig(
        method="force_limit",
        force_limit=limits[0],
        torque_limit=limits[1],
        servo_stiffness=[11.0, 12.0],
        servo_damping=[13.0, 14.0],
        slave_mass=[15.0, 16.0],
        local_force_limit=ForceLimitConfig(force=0.5 * limits[0], torque=2.0 * limits[1]),
    )
    p = method_parameters(config, power, motion)
    np.testing.assert_allclose(p[WRENCH_LIMIT] * motion, limits)
    np.testing.assert_allclose(p[_WRENCH_LIMIT_SLICE] * motion, np.multiply(limits, [0.5, 2.0]))
    for part, values in ((SERVO_K, (11, 12)), (SERVO_D, (13, 14)), (SLAVE_MASS, (15, 16))):
        np.testing.assert_allclose(p[part] / power, values)
    np.testing.assert_array_equal(p[SLAVE_PER_MASTER_MOTION], motion)


_TDPA_PARAMETERS = {
    "release": tdpa._WRENCH_RELEASE_TIME,
    "drain_rate": tdpa._LEDGER_DRAIN_RATE,
    "drift_rate": tdpa._COMMAND_DRIFT_RATE,
    "speed": tdpa._MAX_COMMAND_SPEED,
    "reserve": tdpa._TARGET_RESERVE,
    "drag": tdpa._DRAG_WRENCH,
    "hand_stiffness": tdpa._HAND_STIFFNESS,
}
PARAMETER_OF_SETTING = {
    "tdpa": _TDPA_PARAMETERS,
    "charged_tdpa": _TDPA_PARAMETERS,
    "wave": {
        "impedance": wave.WAVE_IMPEDANCE,
        "filter": wave._WAVE_FILTER_TIME,
        "matching": wave._MATCHING_DAMPER_SHARE,
        "patience": wave._MAX_SILENCE_BEFORE_HOLD,
        "drift_rate": wave._POSE_DRIFT_CORRECTION_RATE,
    },
    "two_layer": {
        "send_rate": two_layer._SEND_RATE,
        "drain_rate": two_layer._MAX_TANK_DRAIN_RATE,
        "initial": two_layer._INITIAL_TANK_ENERGY,
        "level": two_layer._TARGET_TANK_LEVEL,
        "capacity": two_layer._TANK_CAPACITY,
        "damper": two_layer._DAMPING_PER_MISSING_ENERGY,
        "acceleration": two_layer.MAX_PORT_ACCELERATION,
    },
    "pspm": {
        "initial": pspm._INITIAL_ENERGY,
        "ceiling": pspm._MAX_STORED_ENERGY,
        "stiffness": pspm._SPRING_STIFFNESS,
        "damping": pspm._HAND_DAMPING,
    },
    "four_channel": {
        "stiffness": four_channel._COUPLING_STIFFNESS,
        "damping": four_channel._COUPLING_DAMPING,
        "slave_feedback": four_channel._SLAVE_FEEDBACK_GAIN,
        "hand_feedback": four_channel._HAND_FEEDBACK_GAIN,
    },
    "ledger": {
        "initial": ledger_slave.INITIAL_LEDGER_ENERGY,
        "reserve": ledger_slave.SLAVE_RESERVE,
        "hand_reserve": ledger_slave.MASTER_RESERVE,
        "drag": ledger_slave.DRAG_WRENCH,
        "touch": ledger_slave.CONTACT_THRESHOLD,
        "encoder_step": ledger_slave.ENCODER_STEP,
    },
}
#: Settings at the hand: the power of the kinematic scale that converts them.
POWER_OF_SCALE = {"drag": -1, "touch": -1, "encoder_step": 1, "hand_stiffness": -2}


@pytest.mark.parametrize("motion", [(1.0, 1.0), (4.0, 0.25)])
@pytest.mark.parametrize("method", PARAMETER_OF_SETTING)
def test_each_setting_of_a_method_is_its_own_parameter(method, motion):
    own, places = getattr(PassivityConfig(), method), PARAMETER_OF_SETTING[method]
    assert {field.name for field in dataclasses.fields(own)} == places.keys()
    pairs = {name: isinstance(place, slice) for name, place in places.items()}
    numbers = {
        name: [0.01 + 0.002 * k, 0.011 + 0.002 * k] if is_pair else 0.01 + 0.002 * k
        for k, (name, is_pair) in enumerate(pairs.items())
    }
    config = PassivityConfig(method=method, **{method: dataclasses.replace(own, **numbers)})
    p = method_parameters(config, motion_scale=motion)
    for name, place in places.items():
        scale = np.power(motion, POWER_OF_SCALE.get(name, 0))
        expected = numbers[name] * scale if pairs[name] else numbers[name]
        np.testing.assert_allclose(p[place], expected, rtol=1e-12, err_msg=name)


def test_limits_are_those_of_the_default_device_unless_given():
    device, config = Master().device(0.0, 0.0), PassivityConfig()
    assert config.force_limit == device.parameters.peak_force
    assert config.torque_limit == min(device.parameters.peak_torque)


def test_unknown_method_is_rejected():
    with pytest.raises(DrakeTeleopError, match="there is no passivity method 'waves'"):
        initial_method_memory("waves", np.zeros(1), START)
    with pytest.raises(DrakeTeleopError, match="method"):
        check_all_field_values(PassivityConfig(method="waves"), "passivity")
    assert initial_method_memory("none", np.zeros(1), START).shape == (MEMORY_SIZE,)


@pytest.mark.slow
@pytest.mark.parametrize(("wall", "round_trip"), [(5100.0, 1.0), (20000.0, 0.3), (20000.0, 0.02)])
def test_charged_tdpa_holds_a_wall_over_a_long_delay_with_the_right_force(wall, round_trip):
    model, task = OneDof(wall_stiffness=wall), Task(release_start=15.5, release_end=16.5, end=21.0)
    network = NetworkConfig(delay=round_trip / 2, jitter=0.25, loss=0.1)

    def figures_of(method):
        passivity = PassivityConfig(method=method)
        run = run_one_dof(model, passivity, network, intent=operator_intent(task))
        return measures_of_run(run, model, task)

    charged, strict = figures_of("charged_tdpa"), figures_of("tdpa")
    assert charged.stable and abs(charged.force_error) < 0.01
    assert abs(charged.drift) < 0.5e-3 and charged.free_force < 0.3
    assert charged.rise_delay < 0.5 * round_trip + 0.25, "the quick onset should have come"
    assert abs(strict.force_error) > 0.3, "energy earned beforehand should have mattered"


@pytest.mark.parametrize("sigma", [0.5, 1.0])
def test_slave_follows_while_its_inertia_is_rendered(sigma):
    """Acceleration needs energy at the slave; surplus energy of the master returns."""
    model = OneDof(sigma=sigma)
    network = NetworkConfig(delay=0.3, jitter=0.25, loss=0.1)
    run = run_one_dof(model, PassivityConfig(method="charged_tdpa"), network)
    assert np.abs(run.slave_position[-1000:] - run.master_position[-1000:]).max() < 10e-3
    assert run.wall_force.min() < -10.0, "the wall should have been pressed"


@pytest.mark.parametrize(
    ("stored", "left"), [(2e-3, 3.0 - 0.45 / 2.0), (3e-4, 1.0), (9e-3, 3.0), (0.0, 0.0)]
)
def test_wrench_drops_abruptly_only_without_energy(stored, left):
    """3 N, the hand yields 0.3 mm in a step, motion scale 2: 450 N/s."""
    p = method_parameters(PassivityConfig(method="tdpa"), motion_scale=(2.0, 2.0))
    memory, packet, wrench = (
        initial_method_memory("tdpa", p, START),
        np.zeros(PACKET_SIZE),
        np.zeros(6),
    )
    received = packet.copy()
    received[WRENCH][1] = memory[LAST_PORT_WRENCH][1] = 3.0
    memory[STORED_ENERGY][0] = stored
    dx = np.array([0.1e-3, 0.3e-3, 0.0, 0.0, 0.0, 0.0])
    master_step(
        step_addresses("tdpa"), received, True, START, dx / T, dx, np.zeros(6), p[WRENCH_LIMIT], T,
        p, memory, wrench, packet,
    )  # fmt: skip
    np.testing.assert_allclose(wrench, [0.0, left, 0.0, 0.0, 0.0, 0.0], rtol=1e-12, atol=0.0)


def test_tank_with_fastest_sending_is_not_overdrawn():
    """The sent energy is 1000 times its content in a second, each millisecond and each 10 ms."""
    config = TwoLayerConfig(send_rate=1000.0)
    p = method_parameters(PassivityConfig(method="two_layer", two_layer=config))
    for step in (T, 10 * T):
        memory, packet = initial_method_memory("two_layer", p, START), np.zeros(PACKET_SIZE)
        full = memory[STORED_ENERGY].copy()
        assert np.all(full > 0.0)
        _update_tank_and_send_energy(np.zeros(PACKET_SIZE), np.zeros(6), step, p, memory, packet)
        reserve = 0.01 * np.array(config.capacity)
        np.testing.assert_allclose(memory[STORED_ENERGY], reserve, rtol=1e-9)
        np.testing.assert_allclose(memory[STORED_ENERGY] + memory[SENT_ENERGY], full, rtol=1e-12)


def test_command_of_the_tank_method_has_the_received_twist():
    m, p = step_addresses("two_layer"), method_parameters(PassivityConfig(method="two_layer"))
    memory, received = initial_method_memory("two_layer", p, START), np.zeros(PACKET_SIZE)
    command, packet, zero = np.zeros(13), np.zeros(PACKET_SIZE), np.zeros(6)
    twist = np.array([0.1, -0.2, 0.3, 0.4, -0.5, 0.6])
    received[POSE], received[VELOCITY], received[SENDER_INPUTS_FINITE] = START, twist, 1.0
    slave_step(m, received, True, START, zero, zero, zero, T, p, memory, command, packet)
    np.testing.assert_array_equal(command[7:], twist)


def test_full_tank_discards_the_rest():
    config = TwoLayerConfig(send_rate=0.0)
    p = method_parameters(PassivityConfig(method="two_layer", two_layer=config))
    memory, received = initial_method_memory("two_layer", p, START), np.zeros(PACKET_SIZE)
    received[CUMULATIVE_ENERGY] = 0.1
    _update_tank_and_send_energy(received, np.zeros(6), T, p, memory, np.zeros(PACKET_SIZE))
    np.testing.assert_allclose(memory[STORED_ENERGY], config.capacity)
    lost = np.add(config.initial, 0.1) - config.capacity
    np.testing.assert_allclose(memory[DISSIPATED_ENERGY], lost)


def test_overdrawn_tank_keeps_its_deficit():
    """Received energy repays it first."""
    p = method_parameters(PassivityConfig(method="two_layer"))
    memory, received = initial_method_memory("two_layer", p, START), np.zeros(PACKET_SIZE)
    memory[STORED_ENERGY] = -1e-3
    received[CUMULATIVE_ENERGY] = 4e-4
    _update_tank_and_send_energy(received, np.zeros(6), T, p, memory, np.zeros(PACKET_SIZE))
    np.testing.assert_allclose(memory[STORED_ENERGY], -6e-4, rtol=1e-12)
