"""Energy ledger in one degree of freedom: energy limits at each port, and rendered forces.

Walls, networks and hands are those of `drake_teleop.lab.comparison.one_dof`; the method has no data
of the hand.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from drake_teleop.lab.comparison.one_dof import (
    AT_MOTOR,
    AT_SLAVE,
    PERIOD_S,
    REFERENCE_ONE_DOF,
    OneDofRun,
    Task,
    measures_of_run,
    operator_intent,
    run_one_dof,
)
from drake_teleop.station.channel.network import NetworkConfig
from drake_teleop.station.passivity.ledger import LedgerConfig
from drake_teleop.station.passivity.ledger_slave import _AVAILABLE_MOTOR_ENERGY
from drake_teleop.station.passivity.memory import (
    DISSIPATED_ENERGY,
    RECEIVED_ENERGY,
    SENT_ENERGY,
    STORED_ENERGY,
    WRENCH_LIMIT,
)
from drake_teleop.station.passivity.methods import (
    PassivityConfig,
    initial_method_memory,
    master_step,
    method_parameters,
    slave_step,
    step_addresses,
)
from drake_teleop.station.passivity.packet import PACKET_SIZE

CHARGED_BY_DRAG = PassivityConfig(method="ledger", ledger=LedgerConfig(initial=[0.0, 0.0]))
CHARGED_BEFORE = PassivityConfig(method="ledger")
LIGHT, MEDIUM, FIRM = (0.1, 2.0, 50.0), (0.25, 8.0, 250.0), (0.5, 20.0, 700.0)
PATIENT = 1.0  # s, a time-out above any silence of these networks


def model(grip=MEDIUM, wall=5100.0, **imperfect):
    mass, damping, stiffness = grip
    return dataclasses.replace(
        REFERENCE_ONE_DOF,
        hand_mass=mass,
        hand_damping=damping,
        hand_stiffness=stiffness,
        wall_stiffness=wall,
        **imperfect,
    )


def times(end: float) -> np.ndarray:
    return np.arange(round(end / PERIOD_S)) * PERIOD_S


def moving(x: np.ndarray) -> np.ndarray:
    return np.stack([x, np.gradient(x, PERIOD_S)], axis=1)


def charging(t: np.ndarray, press: float, depth: float) -> np.ndarray:
    """Return swings before the wall until 3 s, then a press as deep within 1 s, and rest."""
    u = np.clip(t - press, 0.0, 1.0)
    swing = 0.03 * np.sin(3.0 * np.pi * t) * (t < 3.0)
    return moving(-0.04 + swing + (depth + 0.04) * u**3 * (10.0 + u * (6.0 * u - 15.0)))


def hard_taps(seed: int, passivity: PassivityConfig, **imperfect) -> OneDofRun:
    """Simulate taps with bursts of loss; walls appear and disappear, and the hand is released.

    A wall that disappears keeps its energy; every other one appears elsewhere, and pushes.
    """
    rng, t = np.random.default_rng(seed), times(6.0)
    rate, reach = rng.uniform(1.0, 3.0), rng.uniform(0.02, 0.04)
    x = reach * np.sin(2.0 * np.pi * rate * t) * np.minimum(t / 0.3, 1.0) - 0.3 * reach
    grip = np.tile(MEDIUM, (len(t), 1))
    grip[t > 5.0] = 0.0
    comes = np.sin(2.0 * np.pi * rng.uniform(1.0, 8.0) * t)
    wall = np.zeros((len(t), 2))
    wall[:, 0] = 0.015 * (seed % 2) * np.sign(np.sin(2.0 * np.pi * 1.7 * t))
    wall[:, 1] = np.exp(rng.uniform(np.log(2e3), np.log(5e4))) * (comes > 0.0)
    network = NetworkConfig(
        delay=rng.uniform(0.01, 0.3), jitter=0.5, loss=0.4, burst=rng.uniform(0.05, 0.3)
    )
    return run_one_dof(
        model(**imperfect), passivity, network, seed=seed, timeout=rng.choice([0.1, PATIENT]),
        intent=moving(x), grip=grip, wall=wall,
    )  # fmt: skip


@pytest.mark.parametrize("seed", [1, 9])
def test_no_energy_is_created_at_the_actual_motion(seed):
    """The initial energy is E_0 or none; drag charges the ledger.

    These of 40 seeds create the most energy if the balance does not limit the motors.
    """
    for passivity in (CHARGED_BY_DRAG, CHARGED_BEFORE):
        run = hard_taps(seed, passivity)
        assert run.start_energy == passivity.ledger.initial[0]
        assert run.least_energy_sum(AT_SLAVE) >= -1e-6 and run.least_energy_sum(AT_MOTOR) >= -1e-6
        assert run.wall_force.min() < -50.0, "the wall should have been hit"


@pytest.mark.parametrize(("step", "known"), [(5.5e-5, 5.5e-5), (2e-4, 2e-4), (2e-4, 5e-5)])
def test_no_energy_is_created_with_encoder_steps(step, known):
    """The encoder step is the configured one or larger."""
    ledger = LedgerConfig(encoder_step=[known, 0.0])
    run = hard_taps(1, PassivityConfig(method="ledger", ledger=ledger), master_resolution=step)
    assert run.least_energy_sum(AT_SLAVE) >= -1e-6 and run.least_energy_sum(AT_MOTOR) >= -1e-6
    assert run.wall_force.min() < -50.0, "the wall should have been hit"


@pytest.mark.parametrize("delay", [5e-4, 0.15])
def test_a_light_hand_that_has_bounced_off_a_hard_wall_comes_to_rest(delay):
    """The fit of the bounces must not sustain the motion."""
    axis = model(LIGHT, 50e3)
    run = run_one_dof(axis, CHARGED_BEFORE, NetworkConfig(delay=delay), timeout=PATIENT)
    assert run.wall_force[run.t < 4.0].min() < -50.0, "it should have hit the wall"
    found = measures_of_run(run, axis)
    assert found.stable and abs(found.force_error) < 0.01


@pytest.mark.parametrize(("servo", "damping"), [(0.8, 1.2), (1.2, 1.2), (1.2, 0.8)])
def test_no_energy_is_created_with_a_wrong_servo_or_slow_motor(servo, damping):
    imperfect = {
        "configured_stiffness_ratio": servo,
        "configured_damping_ratio": damping,
        "motor_lag": 3e-3,
    }
    for seed in (1, 9):
        assert hard_taps(seed, CHARGED_BEFORE, **imperfect).least_energy_sum(AT_SLAVE) >= -1e-6


def test_ledger_is_input_minus_output_and_keeps_its_deficit():
    """The balance holds at every step of both ends, also for a hand that is only pushed."""
    p, method = method_parameters(CHARGED_BY_DRAG), step_addresses("ledger")
    start = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    ends = [initial_method_memory("ledger", p, start) for _ in range(2)]
    packets, still = [np.zeros(PACKET_SIZE) for _ in range(2)], np.zeros(6)
    felt, command, wrench, work = np.zeros(6), np.zeros(13), np.zeros(6), np.zeros((2, 2))
    rng, least = np.random.default_rng(3), 0.0
    for k in range(600):
        dx, before, held = 1e-4 * rng.normal(size=(2, 6)), wrench.copy(), felt.copy()
        dx[0] += 2e-4 * np.sin(0.02 * k)
        wrench = 3.0 * np.sin(np.arange(6) + 0.03 * k) if k % 100 > 50 else np.zeros(6)
        given = [packet.copy() for packet in packets]
        for end in range(2):
            steps = (held if end == 0 else before) * dx[end], wrench * dx[end]
            both = [np.array([part[:3].sum(), part[3:].sum()]) for part in steps]
            work[end] += both[0] if end == 0 else -np.minimum(*both)
        master_step(
            method, given[1], True, start, dx[0] / 1e-3, dx[0], still, p[WRENCH_LIMIT], 1e-3, p,
            ends[0], felt, packets[0],
        )  # fmt: skip
        slave_step(
            method, given[0], True, start, dx[1] / 1e-3, dx[1], wrench, 1e-3, p, ends[1], command,
            packets[1],
        )  # fmt: skip
        for end, memory in enumerate(ends):
            books = (
                memory[RECEIVED_ENERGY]
                - memory[SENT_ENERGY]
                - memory[DISSIPATED_ENERGY]
                - work[end]
            )
            np.testing.assert_allclose(memory[STORED_ENERGY], books, atol=1e-12)
        least = min(least, ends[0][STORED_ENERGY].min(), ends[1][STORED_ENERGY].min())
    assert least < 0.0, "there should have been a debt"


def test_motors_cannot_use_the_kinetic_energy_of_the_slave():
    """A = L_s - m v^2 / 2 by group, with 1.05 times the configured mass."""
    p = method_parameters(PassivityConfig(method="ledger", slave_mass=[4.0, 0.02]))
    start = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    memory, zero = initial_method_memory("ledger", p, start), np.zeros(6)
    twist = np.array([0.06, 0.08, 0.0, 0.0, 0.0, 0.5])
    held = memory[STORED_ENERGY].copy()
    slave_step(
        step_addresses("ledger"), np.zeros(PACKET_SIZE), False, start, twist, PERIOD_S * twist,
        zero, PERIOD_S, p, memory, np.zeros(13), np.zeros(PACKET_SIZE),
    )  # fmt: skip
    moving = 1.05 * 0.5 * np.array([4.0 * 0.01, 0.02 * 0.25])
    np.testing.assert_allclose(memory[_AVAILABLE_MOTOR_ENERGY], held - moving, rtol=1e-12)


@pytest.mark.parametrize("seed", [4, 38])
def test_command_of_the_safe_state_is_limited_to_the_balance(seed):
    """The hand presses hard during silences, with delayed motors: worst seeds of 40.

    38 fail if the safe state takes precedence; 4 if the motors may brake with all that it requests.
    """
    rng, t = np.random.default_rng(seed), times(8.0)
    grip = rng.uniform(0.1, 0.4), 8.0, rng.uniform(200.0, 600.0)
    imperfect = {
        "configured_stiffness_ratio": 1.2,
        "configured_damping_ratio": 1.2,
        "configured_mass_ratio": 1.2,
    }
    run = run_one_dof(
        model(grip, 28.6e3, motor_lag=3e-3, **imperfect), CHARGED_BEFORE,
        NetworkConfig(delay=0.063, jitter=0.44, loss=0.44, burst=0.26), seed=seed, timeout=0.1,
        intent=charging(t, 2.0, rng.uniform(0.03, 0.06)),
    )  # fmt: skip
    assert run.time_without_packets.max() > 0.2 and run.wall_force.min() < -100.0
    assert run.least_energy_sum(AT_SLAVE) >= -1e-6


@pytest.mark.parametrize(
    ("grip", "wall", "delay", "loss"),
    [
        (MEDIUM, 50e3, 0.15, 0.0),
        (MEDIUM, 5.1e3, 0.3, 0.3),
        (FIRM, 500.0, 0.05, 0.3),
        (FIRM, 20e3, 5e-4, 0.0),
    ],
)
def test_rendered_force_equals_contact_force_at_rest(grip, wall, delay, loss):
    """The ledger has no initial energy and no information about the hand."""
    task = Task(
        press_start=3.5,
        press_end=4.5,
        release_start=9.0,
        release_end=10.0,
        end=12.5,
        rest_window=1.0,
    )
    network = NetworkConfig(delay=delay, jitter=0.5 if loss else 0.0, loss=loss, burst=0.08)
    pressing = operator_intent(task)
    axis = model(grip, wall)
    run = run_one_dof(axis, CHARGED_BY_DRAG, network, timeout=PATIENT, intent=pressing)
    found = measures_of_run(run, axis, task)
    assert found.stable and abs(found.force_error) < 0.01
    assert abs(found.drift) < 1e-4 and found.chatter < 0.05 * found.felt_force
    free = np.abs(run.hand_force[(run.t > 0.5) & (run.t < 3.5)])
    assert 0.2 < free.max() <= 0.3, "drag should have been felt while it charged"
    if wall <= 5.1e3:
        softer = axis.force_scale * wall
        assert found.felt_force > 0.95 * 0.02 * softer * grip[2] / (softer + grip[2])


@pytest.mark.parametrize(("grip", "delay"), [(LIGHT, 0.05), (MEDIUM, 0.05)])
def test_rendered_force_is_right_with_damped_wall_and_joint_friction(grip, delay):
    """Damping that counted as stiffness would be rendered without contact force."""
    axis = model(grip, 2.5e3, wall_damping=300.0, slave_friction=30.0)
    run = run_one_dof(axis, CHARGED_BEFORE, NetworkConfig(delay=delay), timeout=PATIENT)
    found = measures_of_run(run, axis)
    assert found.stable and abs(found.force_error) < 0.05
    assert run.least_energy_sum(AT_SLAVE) >= -1e-6


@pytest.mark.parametrize("grip", [MEDIUM, FIRM])
def test_displayed_stiffness_rises_for_a_hand_that_stays(grip):
    """20 kN/m are displayed as 1.1 kN/m at a delay of 300 ms; the first second displays 300 N/m."""
    axis = model(grip, 20e3)
    run = run_one_dof(axis, CHARGED_BEFORE, NetworkConfig(delay=0.15), timeout=PATIENT)
    found, hard = (
        measures_of_run(run, axis),
        axis.force_scale * 20e3 / (1.0 + 20e3 / axis.servo_stiffness),
    )
    assert found.stable and abs(found.force_error) < 0.01
    assert found.felt_force > 0.95 * 0.02 * hard * grip[2] / (hard + grip[2])


def test_short_silence_keeps_the_depth_of_a_hand_that_stays():
    """No packet arrives for 48 ms, at a round trip of 100 ms."""
    network = NetworkConfig(delay=0.05, loss=0.01, burst=0.02)
    run = run_one_dof(
        model(FIRM, 15e3), CHARGED_BEFORE, network, seed=4, timeout=PATIENT,
        intent=charging(times(9.0), 3.2, 0.02),
    )  # fmt: skip
    rest = run.t > 6.5
    assert 0.045 < run.time_without_packets[rest].max() < 0.05
    assert np.ptp(run.slave_position[rest]) < 2e-5 and np.ptp(run.hand_force[rest]) < 0.01


def test_motion_ends_after_a_change_of_grip():
    t = times(9.0)
    for before, after in ((FIRM, LIGHT), (LIGHT, FIRM)):
        share = np.clip((t - 6.0) / 0.1, 0.0, 1.0)[:, None]
        grip = (1.0 - share) * np.array(before) + share * np.array(after)
        run = run_one_dof(
            model(), CHARGED_BY_DRAG, NetworkConfig(delay=0.05), timeout=PATIENT,
            intent=charging(t, 3.2, 0.02), grip=grip,
        )  # fmt: skip
        rest = t > 8.0
        assert np.ptp(run.master_position[rest]) < 5e-5 and np.ptp(run.slave_position[rest]) < 5e-5
        pressed = model().force_scale * run.wall_force[rest].mean()
        assert run.hand_force[rest].mean() == pytest.approx(pressed, rel=0.01)


@pytest.mark.parametrize("delay", [0.05, 0.3])
def test_released_hand_is_not_accelerated(delay):
    t = times(10.0)
    grip = np.tile(MEDIUM, (len(t), 1))
    grip[t >= 8.0] = 0.0
    run = run_one_dof(
        model(), CHARGED_BY_DRAG, NetworkConfig(delay=delay), timeout=PATIENT,
        intent=charging(t, 3.2, 0.0296), grip=grip,
    )  # fmt: skip
    start = np.searchsorted(t, 8.0)
    assert abs(run.hand_force[start - 1]) == pytest.approx(4.0, rel=0.1)
    assert np.abs(np.diff(run.master_position[start:])).max() < 0.3 * PERIOD_S
    assert np.ptp(run.master_position[start:]) < 0.04


@pytest.mark.parametrize("wall", [5.1e3, 20e3])
def test_removed_wall_is_rendered_briefly(wall):
    """Taps at 1 Hz: the wall is rendered once more, until the slave has been there; RTT 100 ms."""
    t = times(10.0)
    x = -0.01 - 0.025 * np.cos(2.0 * np.pi * t)
    there = np.stack([np.zeros(len(t)), np.where(t < 5.05, wall, 0.0)], axis=1)
    run = run_one_dof(
        model(), CHARGED_BEFORE, NetworkConfig(delay=0.05), timeout=PATIENT, intent=moving(x),
        wall=there,
    )  # fmt: skip
    felt = np.abs(run.hand_force) > 0.05
    assert np.count_nonzero(felt[(t > 2.0) & (t < 5.0)]) > 500
    assert 100 < np.count_nonzero(felt[t > 5.05]) < 200


@pytest.mark.parametrize(
    ("grip", "delay"),
    [(LIGHT, 0.05), (MEDIUM, 0.15), (FIRM, 0.05)],
    ids=["light", "medium", "firm"],
)
def test_removed_wall_is_rendered_to_a_pressing_hand_for_one_delay(grip, delay):
    """The wall keeps a part of the reserves, but this is no reason for drag yet.

    A light hand presses with less than the threshold of 1 N for immediate detection.
    """
    t = times(7.0)
    there = np.stack([np.zeros(len(t)), np.where(t < 6.0, 5.1e3, 0.0)], axis=1)
    run = run_one_dof(
        model(grip), CHARGED_BEFORE, NetworkConfig(delay=delay), timeout=PATIENT,
        intent=charging(t, 3.0, 0.03), wall=there,
    )  # fmt: skip
    felt = np.abs(run.hand_force)
    assert felt[(t > 5.8) & (t < 6.0)].min() > 1.0
    assert felt[t > 6.0 + delay + 0.02].max() < 0.05
    assert run.least_energy_sum(AT_SLAVE) >= -1e-6


@pytest.mark.parametrize(
    ("grip", "wall"),
    [(LIGHT, 2e3), (LIGHT, 50e3), (FIRM, 20e3)],
    ids=["a touch", "hardly in", "hard"],
)
def test_removed_wall_is_rendered_for_half_a_round_trip_of_10_ms(grip, wall):
    """The remaining force is the drag of 0.28 N that refills the ledger."""
    t = times(7.0)
    there = np.stack([np.zeros(len(t)), np.where(t < 6.0, wall, 0.0)], axis=1)
    run = run_one_dof(
        model(grip), CHARGED_BEFORE, NetworkConfig(delay=5e-3), timeout=PATIENT,
        intent=charging(t, 3.0, 0.03), wall=there,
    )  # fmt: skip
    felt = np.abs(run.hand_force)
    assert felt[(t > 5.8) & (t < 6.0)].min() > 1.0
    assert felt[t > 6.0065].max() < 0.3
    assert run.least_energy_sum(AT_SLAVE) >= -1e-6


@pytest.mark.parametrize("rate", [0.7, 1.5])
def test_taps_are_rendered_from_the_second_on(rate):
    """Packets of each tap arrive after it: the stored wall replaces them."""
    t = times(9.0)
    x = charging(t, 20.0, 0.0)[:, 0]
    x = np.where(t < 3.2, x, -0.015 + 0.025 * np.cos(2.0 * np.pi * rate * (t - 3.2) + np.pi))
    run = run_one_dof(
        model(), CHARGED_BY_DRAG, NetworkConfig(delay=0.05), timeout=PATIENT, intent=moving(x)
    )
    later = t > 3.2 + 2.0 / rate
    pressed = model().force_scale * run.wall_force[later].sum()
    assert 0.75 < run.hand_force[later].sum() / pressed < 1.15


@pytest.mark.parametrize(
    ("grip", "wall", "delay", "end", "share"),
    [(FIRM, 5.1e3, 0.15, 6.0, 0.98), (MEDIUM, 20e3, 0.15, 9.0, 0.85), (FIRM, 2e4, 0.05, 12.0, 0.7)],
    ids=["firm", "hard", "both"],
)
def test_fast_hand_receives_the_contact_force(grip, wall, delay, end, share):
    """30 mm within a second: the slave uses its reserve before it receives energy."""
    axis = model(grip, wall)
    run = run_one_dof(
        axis, CHARGED_BEFORE, NetworkConfig(delay=delay), timeout=PATIENT,
        intent=charging(times(end), 3.0, 0.03),
    )  # fmt: skip
    last = run.t > end - 0.3
    felt, pressed = (
        np.abs(run.hand_force[last]),
        axis.force_scale * np.abs(run.wall_force[last]).mean(),
    )
    assert felt.mean() == pytest.approx(pressed, rel=0.02) and felt.std() < 0.05 * pressed
    softer = 1.0 / (1.0 / axis.servo_stiffness + 1.0 / wall) * axis.force_scale
    assert pressed > share * 0.03 * softer * grip[2] / (softer + grip[2])
