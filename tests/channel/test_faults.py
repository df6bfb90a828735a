"""Values that are not finite, and a saturated sensor, at either end."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from drake_teleop.station.channel import network
from drake_teleop.station.channel.channel import (
    SLAVE_METHOD_MEMORY_SLICE,
    initial_state_of_master_and_slave_ends,
    step_channel,
)
from drake_teleop.station.channel.network import NetworkConfig
from drake_teleop.station.passivity.memory import LAST_PORT_WRENCH, SERVO_D, SERVO_K
from drake_teleop.station.passivity.methods import (
    METHODS,
    PassivityConfig,
    method_parameters,
    step_addresses,
)
from drake_teleop.station.passivity.packet import PACKET_SIZE
from drake_teleop.station.passivity.safe_state import RESUME_TIME_S, STOP_TIME_S

T, STEPS, DELAY = 1e-3, 4000, 0.01
LIMIT = 5.0
TIMEOUT = 0.1
FAULT = (1.0, 1.4)  # s, in contact
FAULTS = ("hand_pose", "hand_wrench", "slave_pose", "slave_wrench", "saturated")


@dataclass
class Run:
    """Signals of all steps: x along the motion, wrench and contact flag `felt`, ports (N, 8)."""

    t: np.ndarray
    hand: np.ndarray
    command: np.ndarray
    felt: np.ndarray
    ports: np.ndarray
    servo: np.ndarray  # force of its servo, and the servo force assumed by the method at its port
    touched: np.ndarray  # by the wall, at the slave


def hand_position() -> np.ndarray:
    """Return x [m]: into the wall at 0, 5 mm deep, and out again from 2.5 s on."""
    t = np.arange(STEPS) * T
    u = np.clip(np.stack([t - 0.3, t - 2.5]) / 0.5, 0.0, 1.0)
    ramp = u**3 * (10.0 + u * (6.0 * u - 15.0))
    return -0.015 + 0.02 * (ramp[0] - ramp[1]) + 5e-4 * np.sin(12.0 * t)


def run(method: str, fault: str | None, span: tuple[float, float] = FAULT, bad=np.nan) -> Run:
    """Simulate both ends with a prescribed motion of the hand and a slave behind a servo."""
    p = method_parameters(PassivityConfig(method=method, force_limit=LIMIT), [1 / 17.5] * 2)
    line = NetworkConfig(delay=DELAY)
    lines = [network.network_parameters(line, 0, way, T, min_steps=1) for way in range(2)]
    states = [network.initial_network_state(each, np.zeros(PACKET_SIZE)) for each in lines]
    frame = np.array([1.0, 0, 0, 0, 1, 0, 0, 0, 1, 1, 1])
    hand = hand_position()
    start = np.array([1.0, 0, 0, 0, hand[0], 0, 0])
    ends, received, slave = (
        initial_state_of_master_and_slave_ends(method, p, start),
        start.copy(),
        start.copy(),
    )
    ports, felt, velocity = np.zeros(8), np.zeros(7), 0.0
    found = Run(
        np.arange(STEPS) * T, hand, *(np.zeros((STEPS, n)) for n in (7, 7, 8, 2)), np.zeros(STEPS)
    )
    for k, x in enumerate(hand):
        wall = -7000.0 * max(slave[4], 0.0)
        velocity += T * (117.0**2 * (received[4] - slave[4]) - 234.0 * velocity + wall / 15.13)
        slave[4] += T * velocity
        now = span[0] <= k * T < span[1]
        inputs = {
            "hand_pose": np.array([1.0, 0, 0, 0, x, 0, 0]),
            "slave_wrench": np.array([wall / 17.5, 0, 0, 0, 0, 0]),
            "load_wrench": np.zeros(6),
            "hand_wrench": np.zeros(6),
            "slave_pose": slave.copy(),
        }
        if now and fault in inputs:
            inputs[fault][:] = bad
        if now and fault == "saturated":
            inputs["slave_wrench"][:] = 1e3
        step_channel(
            step_addresses(method), *inputs.values(), now and fault == "saturated",
            float(wall < 0.0), T, TIMEOUT, frame, p, *lines, *states, ends, received, ports, felt,
        )  # fmt: skip
        found.touched[k] = wall < 0.0
        found.command[k], found.felt[k], found.ports[k] = received, felt, ports
        pull = p[SERVO_K][0] * (received[4] - slave[4]) - p[SERVO_D][0] * velocity
        found.servo[k] = pull, ends[SLAVE_METHOD_MEMORY_SLICE][LAST_PORT_WRENCH][0]
    return found


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_packets_contain_the_contact_flag(method):
    found = run(method, None)
    touched, told = found.touched, found.felt[:, 6]
    late = round(DELAY / T)
    assert 0 < np.count_nonzero(touched) < STEPS
    np.testing.assert_array_equal(told[late:], touched[: STEPS - late])


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("fault", FAULTS)
def test_signals_are_smooth_and_bounded_and_recover_after_a_fault(method, fault):
    sound, faulty = run(method, None), run(method, fault, bad=np.inf)
    t, x, f = faulty.t, faulty.command[:, 4], faulty.felt[:, 0]
    assert np.isfinite(faulty.command).all() and np.isfinite(faulty.felt).all()
    assert np.isfinite(faulty.ports[:, :4]).all()
    assert np.linalg.norm(faulty.felt[:, :3], axis=1).max() <= LIMIT + 1e-12
    before = (t > 0.9) & (t < FAULT[0])
    assert np.abs(f[before]).max() > 0.1, "nothing was felt that could fade"
    # Neither force nor command has a step that the run without fault does not have.
    assert np.abs(np.diff(f)).max() < 0.5
    missed = np.ptp(faulty.hand[(t > FAULT[0]) & (t < FAULT[1])])
    fastest = np.abs(np.diff(sound.command[:, 4])).max() + 2.0 * missed * T / RESUME_TIME_S
    assert np.abs(np.diff(x)).max() < 1.5 * fastest
    # The safe state of both ends.
    safe = (t > FAULT[0] + DELAY + STOP_TIME_S + 0.005) & (t < FAULT[1])
    if fault != "saturated":
        assert np.abs(f[safe]).max() < 1e-12
        assert np.ptp(x[safe]) < 1e-12
    # Free motion is as without the fault.
    after = t > 3.5
    assert np.abs(x - sound.command[:, 4])[after].max() < 1e-3
    assert np.abs(f - sound.felt[:, 0])[after].max() < 0.1


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("fault", ["hand_pose", "slave_wrench"])
def test_one_bad_sample_has_little_effect(method, fault):
    sound, faulty = run(method, None), run(method, fault, span=(1.2, 1.2 + T / 2), bad=1e9)
    assert np.abs(faulty.command[:, 4] - sound.command[:, 4]).max() < 1e-3
    assert np.abs(np.diff(faulty.felt[:, 0])).max() < 0.5


def test_force_at_the_hand_fades_over_50_ms():
    """The pose of the hand is valid; the slave's wrench is missing."""
    found = run("none", "slave_wrench")
    f = found.felt[:, 0]
    told = round((FAULT[0] + DELAY) / T) + 2
    fade = np.abs(f[told : told + round(STOP_TIME_S / T) + 2])
    assert (np.diff(fade) <= 0.0).all()
    assert np.abs(np.diff(fade)).max() < 2.5 * fade[0] * T / STOP_TIME_S
    assert fade[-1] < 1e-12


def test_last_valid_wrench_is_rendered_while_the_sensor_is_saturated():
    """The hand withdraws meanwhile; the wrench then blends to zero."""
    span = (2.4, 2.9)
    found = run("none", "saturated", span)
    t, f = found.t, found.felt[:, 0]
    held = f[(t > span[0] + 2 * DELAY) & (t < span[1])]
    assert np.ptp(held) < 1e-12 and abs(held[0]) > 1.0
    back = f[(t > span[1]) & (t < span[1] + DELAY + STOP_TIME_S + 0.01)]
    assert np.abs(np.diff(back)).max() < 0.1
    assert abs(back[-1]) < 0.1


@pytest.mark.parametrize("method", ["two_layer", "pspm"])
def test_motor_ledger_uses_the_command_after_the_safe_state(method):
    """The command in the safe state and at its end differs from that of the method."""
    found = run(method, "hand_wrench")
    t = found.t
    changed = (t > FAULT[0] + DELAY + 0.01) & (t < FAULT[1] + RESUME_TIME_S)
    assert np.abs(found.servo[changed, 0]).max() > 0.1
    np.testing.assert_allclose(found.servo[:, 1], found.servo[:, 0], atol=1e-6)
