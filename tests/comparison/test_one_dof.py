"""One degree of freedom against closed forms of the theory of delay."""

from __future__ import annotations

import dataclasses
import importlib
import itertools
import math
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import brentq

from drake_teleop.lab.analysis.cut_loop import cut_loop, delay_margin
from drake_teleop.lab.analysis.one_axis import AxisParameters, OneAxis, servo_response
from drake_teleop.lab.analysis.period_map import Sampling
from drake_teleop.lab.comparison.one_dof import (
    AT_HAND,
    AT_SLAVE,
    PERIOD_S,
    REFERENCE_ONE_DOF,
    OneDof,
    Task,
    measures_of_run,
    measures_of_traces,
    operator_intent,
    run_one_dof,
)
from drake_teleop.station.channel.network import NetworkConfig
from drake_teleop.station.operator.operator import GRIP_IMPEDANCES
from drake_teleop.station.passivity.methods import PassivityConfig
from drake_teleop.station.slave.joint_control import JointControlConfig

DEVICE_MASS, DEVICE_DAMPING = 0.15, 0.5


def held(grip: str, **changes: float) -> OneDof:
    """Return a hand on a device without friction, and an ideal servo."""
    hand = GRIP_IMPEDANCES[grip]
    return OneDof(
        hand_mass=hand.mass,
        hand_damping=hand.damping + DEVICE_DAMPING,
        hand_stiffness=hand.stiffness,
        device_mass=DEVICE_MASS,
        device_friction=0.0,
        ideal_servo=True,
        **changes,
    )


def grows(model: OneDof, round_trip: int, rest: float) -> bool:
    """Return whether a small disturbance grows around `rest` [m], for a round trip in periods."""
    steps = 12000
    intent = np.full((steps, 2), 0.0)
    intent[:, 0] = rest * np.minimum(np.arange(steps) / 1000, 1.0)
    intent[1500:1520, 0] += 1e-4
    forward, backward = round_trip // 2, round_trip - round_trip // 2
    run = run_one_dof(
        model,
        PassivityConfig(),
        NetworkConfig(delay=forward * PERIOD_S),
        NetworkConfig(delay=backward * PERIOD_S),
        intent=intent,
    )
    if not np.isfinite(run.master_position).all():
        return True
    swing = [np.ptp(run.master_position[start : start + 2000]) for start in (2000, 10000)]
    return bool(swing[1] > swing[0])


def longest_stable_round_trip(model: OneDof, rest: float, low: int, high: int) -> int:
    """Return the largest stable round trip in periods, below `high`."""
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if grows(model, middle, rest) else (middle, high)
    return low


def contact_limit(grip: str, wall: float) -> float:
    """Return the least RTT [s] with an imaginary root of m s^2 + b s + k + K e^(-s RTT)."""
    hand = GRIP_IMPEDANCES[grip]
    m, b, k, K = hand.mass + DEVICE_MASS, hand.damping + DEVICE_DAMPING, hand.stiffness, wall / 17.5

    def excess(w: float) -> float:
        return math.hypot(k - m * w * w, b * w) - K

    w = brentq(excess, math.sqrt(k / m), 1e4)
    return math.atan2(b * w, m * w * w - k) / w


@pytest.mark.parametrize(
    ("grip", "wall"), [("light", 5100.0), ("medium", 5100.0), ("light", 1000.0), ("firm", 20000.0)]
)
def test_longest_delay_in_contact_equals_closed_form(grip, wall):
    model = held(grip, wall_stiffness=wall)
    # Interpolation and hold add a delay.
    expected = contact_limit(grip, wall) / PERIOD_S - 1.5
    found = longest_stable_round_trip(model, 0.02, 1, round(2 * expected) + 4)
    assert found == pytest.approx(expected, abs=1.0)


def free_windows(grip: str) -> list[float]:
    """Return RTT [s] with imaginary roots of m s^2 + b s + k + mu s^2 e^(-s RTT)."""
    hand = GRIP_IMPEDANCES[grip]
    m, b, k, mu = (
        hand.mass + DEVICE_MASS,
        hand.damping + DEVICE_DAMPING,
        hand.stiffness,
        3.13 / 17.5,
    )

    def excess(w: float) -> float:
        return math.hypot(k - m * w * w, b * w) - mu * w * w

    edges = []
    grid = np.linspace(1.0, 200.0, 4000)
    for low, high in itertools.pairwise(grid):
        if excess(low) * excess(high) < 0:
            w = brentq(excess, low, high)
            # k - m w^2 + j b w = mu w^2 e^(-j w RTT)
            angle = -math.atan2(b * w, k - m * w * w)
            edges.append((angle % (2 * math.pi)) / w)
    return sorted(edges)


def test_light_hand_has_an_unstable_window_in_free_motion():
    """The hand is unstable between 190 and 339 ms at sigma = 1."""
    first, last = (edge / PERIOD_S for edge in free_windows("light"))
    assert (first, last) == (pytest.approx(190, abs=1), pytest.approx(339, abs=1))
    model = held("light", sigma=1.0)
    # The second difference of the interpolated command is 2 periods late; the force is held.
    below, above = (round(edge - 2.5) for edge in (first, last))
    assert [grows(model, below + step, -0.5) for step in (-4, 4)] == [False, True]
    assert [grows(model, above + step, -0.5) for step in (-7, 7)] == [True, False]
    without = held("light", sigma=0.0)
    assert not any(grows(without, delay, -0.5) for delay in (190, 260, 330))


def test_default_hand_and_servo_are_those_of_the_station():
    hand, servo, model = GRIP_IMPEDANCES["medium"], JointControlConfig(), OneDof()
    assert (model.hand_mass, model.hand_damping) == (hand.mass, hand.damping)
    assert model.hand_stiffness == hand.stiffness
    assert model.position_gain == 2 * math.pi * servo.position_bandwidth_hz
    assert model.velocity_gain == 2 * math.pi * servo.velocity_bandwidth_hz

    def late_and_half_power(axis: OneDof) -> tuple[float, float]:
        """Return the low-frequency delay [s] and the half-power frequency of the slave [Hz]."""
        axis = OneAxis(position_gain=axis.position_gain, velocity_gain=axis.velocity_gain)

        def excess(f: float) -> float:
            return abs(servo_response(axis, np.array([2j * math.pi * f]))[0]) - math.sqrt(0.5)

        slow = servo_response(axis, np.array([1e-3j]))[0]
        return -np.angle(slow) / 1e-3, brentq(excess, 1.0, 100.0)

    assert late_and_half_power(model) == pytest.approx((13.3e-3, 14.4), rel=0.01)
    assert late_and_half_power(REFERENCE_ONE_DOF) == pytest.approx((17.1e-3, 12.0), rel=0.01)
    stiffness = [axis.servo_stiffness for axis in (model, REFERENCE_ONE_DOF)]
    assert stiffness == pytest.approx([502e3, 207e3], rel=0.01)
    assert REFERENCE_ONE_DOF.servo_damping**2 == pytest.approx(
        4 * REFERENCE_ONE_DOF.slave_mass * REFERENCE_ONE_DOF.servo_stiffness, rel=1e-12
    )


@pytest.mark.parametrize(("model", "longest"), [(OneDof(), 0.028), (REFERENCE_ONE_DOF, 0.008)])
def test_longest_round_trip_without_a_method(model, longest):
    none, found = PassivityConfig(), {}
    for round_trip in (0.002, longest, longest + 0.002, 0.05):
        run = run_one_dof(model, none, NetworkConfig(delay=round_trip / 2))
        found[round_trip] = measures_of_run(run, model)
    assert [result.stable for result in found.values()] == [True, True, False, False]
    assert abs(found[0.002].force_error) < 1e-3
    assert found[0.05].least_energy < -1.0


@pytest.mark.parametrize("model", [OneDof(), REFERENCE_ONE_DOF])
def test_simulation_and_linear_analysis_agree(model):
    shared = {
        entry.name: getattr(model, entry.name) for entry in dataclasses.fields(AxisParameters)
    }
    axis, fast = OneAxis(**shared, device_damping=DEVICE_DAMPING), 1e5
    margin = float(delay_margin(cut_loop(axis, Sampling(fast, fast, fast))))
    damped = dataclasses.replace(
        model, hand_damping=model.hand_damping + DEVICE_DAMPING, device_friction=0.0
    )
    expected = margin / PERIOD_S - 1.5
    found = longest_stable_round_trip(damped, 0.02, 1, round(2 * expected) + 4)
    assert found == pytest.approx(expected, abs=1.0)


def test_same_seed_gives_same_run():
    network = NetworkConfig(delay=0.05, jitter=0.5, loss=0.3)
    first, again, other = (
        run_one_dof(OneDof(), PassivityConfig(), network, seed=seed).hand_force
        for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 0


def test_energy_balances_agree_with_spring_and_inertia():
    task = Task(
        swing_start=0.1,
        swing_end=0.7,
        press_start=0.7,
        press_end=1.0,
        release_start=1.3,
        release_end=1.5,
        end=2.0,
    )
    model, intent, ahead = (
        dataclasses.replace(REFERENCE_ONE_DOF, gamma=0.8),
        operator_intent(task),
        10,
    )
    scale = model.gamma * model.force_scale
    run = run_one_dof(model, PassivityConfig(), NetworkConfig(delay=0.01), intent=intent)
    spring = 0.5 * scale * model.wall_stiffness * np.maximum(run.slave_position, 0.0) ** 2
    hand, command, motor, actual = run.input_energies.T
    # A spring returns its energy, to rounding: the wall is not active.
    np.testing.assert_allclose(actual, -spring, rtol=0.0, atol=1e-14)
    assert spring.max() > 0.01 and run.start_energy == 0.0
    assert run.least_energy_sum(AT_SLAVE) < -0.01
    # Motor energy equals wall and kinetic energy; v is half a step of 50 us late.
    speed = np.gradient(run.slave_position, PERIOD_S)
    moving = 0.5 * scale * model.slave_mass * speed**2
    assert moving.max() > 0.1
    np.testing.assert_allclose(motor, actual - moving, rtol=0.0, atol=6e-4)
    still = np.abs(speed) < 1e-4
    np.testing.assert_allclose(motor[still], actual[still], rtol=0.0, atol=1e-6)
    np.testing.assert_array_equal(hand, run.channel_energy[:, 0])
    assert run.least_energy_sum(AT_HAND) == hand.min()
    # The command's balance also contains the energy in the servo's lag.
    wrench, lag = scale * run.wall_force, run.command_position - run.slave_position
    sampled = np.cumsum(wrench * np.diff(run.slave_position, prepend=run.slave_position[0]))
    held = wrench * lag - np.cumsum(np.roll(lag, 1) * np.diff(wrench, prepend=0.0))
    np.testing.assert_allclose(command, sampled + held, rtol=0.0, atol=1e-12)
    assert (command - actual).max() > 1e-3
    # Explicit packet delays, constant hand and wall give the same run.
    given = run_one_dof(
        model,
        PassivityConfig(),
        NetworkConfig(),
        intent=intent,
        grip=np.tile([0.2, 5.0, 300.0], (len(intent), 1)),
        wall=np.tile([0.0, 5100.0], (len(intent), 1)),
        delays=(np.full(2000, ahead), np.full(2000, ahead)),
    )
    np.testing.assert_array_equal(given.input_energies, run.input_energies)


def test_changing_hand_wall_and_imperfections():
    steps = 900
    intent, grip, wall = np.zeros((steps, 2)), np.zeros((steps, 3)), np.zeros((steps, 2))
    intent[:, 0], grip[:600] = 0.019, (0.2, 5.0, 300.0)
    wall[:, 0], wall[600:, 0], wall[750:] = 0.02, 0.005, (0.02, 0.0)
    wall[:750, 1] = 5100.0
    lost = np.zeros(steps, np.int64)
    lost[800:] = -1
    model = dataclasses.replace(
        REFERENCE_ONE_DOF,
        slave_friction=30.0,
        wall_damping=300.0,
        motor_lag=3e-3,
        master_resolution=30e-6,
        slave_resolution=10e-6,
        wrench_noise=0.5,
    )
    run = run_one_dof(
        model,
        PassivityConfig(),
        NetworkConfig(),
        intent=intent,
        grip=grip,
        wall=wall,
        delays=(lost, lost),
        timeout=0.05,
    )
    # The wall moves by 15 mm, pushes slave and free device away and returns; then packets stop.
    assert (
        run.wall_force[:599].min() == 0.0 == run.wall_force[750:].min()
        and run.wall_force[600:750].min() < -20.0
    )
    assert run.input_energies[749, AT_SLAVE] == run.input_energies[-1, AT_SLAVE]
    noise = run.hand_force[50:590] / model.force_scale
    assert noise.std() == pytest.approx(0.5, rel=0.15)
    assert run.master_position[749] < 0.019 and np.all(run.time_without_packets[-1] > 0.09)
    step_addresses = np.round(run.command_position[600:800] / 30e-6) * 30e-6
    np.testing.assert_allclose(run.command_position[600:800], step_addresses, atol=1e-15)


def test_adversary_is_reproducible_and_finds_leaks_and_cycles(
    monkeypatch,
):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    adversary, cases = map(importlib.import_module, ("adversary", "adversary_cases"))
    changed = cases.coordinates((28, 3), 0) != cases.coordinates((28,), 0)
    assert 0 < changed.sum() < 0.5 * len(changed)
    np.testing.assert_array_equal(cases.coordinates((28, 3), 0), cases.coordinates((28, 3), 0))
    tdpa, again, pspm = (
        adversary.run_case(name, (28,), adversary.Options()) for name in ("tdpa", "tdpa", "pspm")
    )
    assert tdpa == again and tdpa.actual < -0.1 and pspm.actual > 0.0
    assert tdpa.worse(pspm).actual == tdpa.actual and tdpa.worse(pspm).speed == pspm.speed
    t = np.arange(400) * 1e-2
    swing = 1e-3 * np.sin(2 * np.pi * t)
    lasting, short = swing.tolist(), np.where(t < 2.6, swing, 0.0).tolist()
    found = [adversary._cycling(x) for x in (lasting, short, (0.1 * np.exp(-t)).tolist())]
    assert found == pytest.approx([400, 275, 0], abs=30)


@pytest.mark.parametrize(
    ("share", "late", "drag", "expected"),
    [
        (1.0, 0.1, 0.0, 0.1),
        # Half of the force, without delay: not earlier than the contact.
        (0.5, 0.0, 0.0, 0.0),
        # A drag of equal size hides the rise; a smaller one makes it 0.08 s earlier.
        (1.0, 0.1, 0.8, math.nan),
        (1.0, 0.1, 0.2, 0.02),
        (1.0, 0.1, -0.8, 0.1),
    ],
)
def test_rise_delay_is_never_negative(share, late, drag, expected):
    task, t = Task(), np.arange(round(Task().end / PERIOD_S)) * PERIOD_S
    middle = 0.5 * (task.press_start + task.press_end)

    def wall(now):
        return np.clip((now - middle) / 0.4, 0.0, 1.0)

    pulled = np.where((t > task.press_start) & (t < middle + 0.25), drag, 0.0)
    felt = np.minimum(wall(t - late), share) + (pulled if drag else 0.0)
    still = np.zeros_like(t)
    found = measures_of_traces(
        t=t, master=still, slave=still, hand_force=felt, pressed=wall(t), energy=still, task=task
    )
    assert found.rise_delay == pytest.approx(expected, abs=2 * PERIOD_S, nan_ok=True)
    assert not found.rise_delay < 0.0
