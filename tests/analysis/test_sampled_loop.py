"""The sampled one axis: against a simulation, the continuous limit, and its own eigenvalues."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from registers import closed_map, growth_rate, multipliers

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.lab.analysis import period_map
from drake_teleop.lab.analysis.cut_loop import (
    CutLoop,
    count_unstable_multipliers,
    cut_loop,
    delay_margin,
    gain_and_phase_margin,
    loop_response,
)
from drake_teleop.lab.analysis.one_axis import OneAxis
from drake_teleop.lab.analysis.period_map import (
    MASTER_V,
    MASTER_X,
    RECEIVED_FORCE,
    SAMPLED_FORCE,
    SLAVE_V,
    SLAVE_X,
    Sampling,
    mass_spring_unit_responses,
    one_way_delay_in_hand_periods,
    sampled_two_port,
    transition_matrix_of_cut_loop,
)
from drake_teleop.station.operator.operator import GRIP_IMPEDANCES

STATION = Sampling()
JR3 = Sampling(low_pass_hz=500.0)


@pytest.fixture(scope="module")
def bench() -> ModuleType:
    """Return the benchmark, whose simulation is independent of the analysis."""
    path = Path(__file__).parents[2] / "benchmarks/analysis.py"
    spec = importlib.util.spec_from_file_location("bench_analysis", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["bench_analysis"] = module
    spec.loader.exec_module(module)
    return module


def held(grip: str, **fields: float) -> OneAxis:
    hand = GRIP_IMPEDANCES[grip]
    axis = OneAxis(hand_mass=hand.mass, hand_damping=hand.damping, hand_stiffness=hand.stiffness)
    return replace(axis, **fields)


axes = st.builds(
    OneAxis,
    hand_mass=st.floats(0.05, 0.6),
    hand_damping=st.floats(0.01, 25.0),
    device_damping=st.sampled_from([0.0, 0.5]),
    hand_stiffness=st.floats(0.0, 900.0),
    sigma=st.floats(0.0, 2.0),
    gamma=st.floats(0.0, 2.0),
    mass_error=st.floats(-1.0, 1.0),
    wall_stiffness=st.sampled_from([0.0, 1e3, 5.1e3, 2e4, 1e5]),
    wall_damping=st.floats(0.0, 100.0),
    force_scale=st.sampled_from([1 / 17.5, 0.3]),
)


@pytest.mark.slow
@pytest.mark.parametrize(
    "sampling", [STATION, JR3, Sampling(joint_control_hz=10e3, low_pass_hz=500.0)]
)
def test_loop_agrees_with_a_simulation_with_small_steps(
    bench: ModuleType, sampling: Sampling
) -> None:
    axis = OneAxis(sigma=0.7, mass_error=0.4, wall_damping=30.0, position_scale=1.3)
    start = np.array([1e-3, 0.1, 2e-3, -0.05])
    simulated = bench.simulate(axis, sampling, start, 0.1, 20)
    step = closed_map(axis, sampling)
    state = np.zeros(len(step))
    state[[MASTER_X, MASTER_V, SLAVE_X, SLAVE_V]] = start
    outputs = np.empty_like(simulated)
    for row in outputs:
        row[:] = state[[MASTER_X, MASTER_V, SLAVE_X, SLAVE_V, SAMPLED_FORCE]]
        state = step @ state
    np.testing.assert_allclose(
        outputs / np.abs(simulated).max(axis=0),
        simulated / np.abs(simulated).max(axis=0),
        atol=1e-12,
    )


def _rates(factor: float) -> Sampling:
    return Sampling(*(factor * rate for rate in (2e3, 2e3, 8e3)))


def _without_first_order(at_rate, factor: float):
    """Return the limit of short periods, from two of them."""
    return 2 * at_rate(_rates(2 * factor)) - at_rate(_rates(factor))


@pytest.mark.parametrize("stiffness", [0.0, 5.1e3])
def test_short_periods_give_the_continuous_loop(stiffness: float) -> None:
    axis = OneAxis(sigma=0.6, mass_error=0.3, wall_stiffness=stiffness, position_scale=1.2)
    w = 2 * np.pi * np.geomspace(0.1, 50.0, 30)
    s = 1j * w
    # m x'' = m k_v (k_p (l_p x_m - x) - x') - k_e x, and the eliminated force.
    gain = axis.velocity_gain * axis.position_gain
    slave = axis.slave_mass * (s**2 + axis.velocity_gain * s + gain) + stiffness
    position = axis.slave_mass * gain * axis.position_scale / slave
    true, estimate = axis.tool_mass * s**2, (axis.tool_mass + axis.mass_error) * s**2
    felt = axis.gamma * (stiffness + true - estimate) + axis.sigma * estimate
    hand = (axis.hand_mass + axis.device_mass) * s**2 + axis.hand_stiffness
    hand += (axis.hand_damping + axis.device_damping) * s
    expected = -axis.force_scale * felt * position / hand

    def at_rate(sampling: Sampling):
        return loop_response(cut_loop(axis, sampling), w)

    coarse = np.abs(at_rate(_rates(4.0)) / expected - 1).max()
    fine = np.abs(at_rate(_rates(8.0)) / expected - 1).max()
    assert 0.45 < fine / coarse < 0.55  # first order: holds delay by half a period
    np.testing.assert_allclose(_without_first_order(at_rate, 8.0) / expected, 1.0, atol=2e-4)


def test_two_port_tends_to_the_continuous_one_for_short_periods() -> None:
    axis = OneAxis(sigma=0.6, mass_error=0.3, delay=5e-3)
    w = 2 * np.pi * np.geomspace(0.1, 30.0, 20)
    s, kv = 1j * w, axis.velocity_gain
    spring, slave = axis.slave_mass * kv * axis.position_gain / s, axis.slave_mass * (s + kv)
    M = axis.sigma * axis.tool_mass + (axis.sigma - axis.gamma) * axis.mass_error
    late, kf = np.exp(-s * axis.delay), axis.force_scale
    expected = np.empty((20, 2, 2), complex)
    expected[:, 0, 0] = axis.device_mass * s + axis.device_damping
    expected[:, 0, 0] += kf * M * s * spring / (slave + spring) * late**2
    expected[:, 0, 1] = kf * late * (axis.gamma - M * s / (slave + spring))
    expected[:, 1, 0] = -spring / (slave + spring) * late
    expected[:, 1, 1] = 1 / (slave + spring)
    limit = _without_first_order(lambda rates: sampled_two_port(axis, rates, w), 8.0)
    np.testing.assert_allclose(limit / expected, 1.0, atol=1e-4)


@pytest.mark.parametrize(
    ("delay", "steps"), [(0.0, 0), (1e-6, 1), (2e-4, 1), (7e-4, 1), (8e-4, 2), (1e-2, 20)]
)
def test_delay_is_rounded_to_hand_periods_and_at_least_one(delay: float, steps: int) -> None:
    assert one_way_delay_in_hand_periods(OneAxis(delay=delay), STATION) == steps


def test_period_map_is_computed_once_for_all_delays_and_equal_gaps(monkeypatch):
    gaps, slave_rows = [], period_map._slave_transition_rows
    monkeypatch.setattr(
        period_map,
        "_slave_transition_rows",
        lambda *given: gaps.append(given[2]) or slave_rows(*given),
    )
    delays, sigmas = np.linspace(0.0, 0.1, 7), np.array([[0.0], [1.0]])
    M = transition_matrix_of_cut_loop(OneAxis(delay=delays, sigma=sigmas), STATION)
    assert M.shape[:-2] == sigmas.shape
    assert gaps == [1 / STATION.sensor_hz]


@pytest.mark.parametrize("sampling", [STATION, JR3])
@pytest.mark.parametrize("steps", [0, 8])
def test_two_port_agrees_with_loop_without_hand_and_wall(sampling: Sampling, steps: int) -> None:
    axis = OneAxis(sigma=0.6, mass_error=0.3, position_scale=2.0)
    w = 2 * np.pi * np.geomspace(1.0, 900.0, 20)
    H = sampled_two_port(replace(axis, delay=steps / 2e3), sampling, w)
    # Remove the delay of each way: it is in h12 and h21 once, and in the force of h11 twice.
    z, port = np.exp(1j * w / 2e3), sampled_two_port(axis, sampling, w)
    late = np.moveaxis([[z ** (-2 * steps), z**-steps], [z**-steps, np.ones(20)]], 2, 0)
    bare = replace(axis, hand_mass=0.0, hand_damping=0.0, hand_stiffness=0.0, wall_stiffness=0.0)
    device = sampled_two_port(replace(bare, force_scale=0.0), sampling, w)[:, 0, 0]
    port[:, 0, 0] -= device
    H[:, 0, 0] -= device
    np.testing.assert_allclose(H, port * late, atol=1e-9)
    M = transition_matrix_of_cut_loop(bare, sampling)
    n = len(M) - 3
    A = M[:n, :n].copy()
    A[:, SAMPLED_FORCE] += M[:n, RECEIVED_FORCE]
    inner = z[:, None, None] * np.eye(n) - A
    response = np.linalg.solve(inner, np.broadcast_to(M[:n, n : n + 2], (len(w), n, 2)))
    hold = (1 - np.exp(-1j * w / 2e3)) / (1j * w / 2e3)
    port[:, 0, 0] += device
    for force in range(2):
        v_m, v_s = (response[:, MASTER_V, force] / hold, response[:, SLAVE_V, force] / hold)
        F = np.array([1 - force, force])
        np.testing.assert_allclose(port[:, 0, 0] * v_m + port[:, 0, 1] * F[1], F[0], atol=1e-9)
        np.testing.assert_allclose(
            (port[:, 1, 0] * v_m + port[:, 1, 1] * F[1]) / v_s, -1.0, atol=1e-9
        )


@settings(max_examples=60, deadline=None)
@given(axis=axes, steps=st.integers(0, 30), low_pass=st.booleans())
def test_argument_principle_agrees_with_eigenvalues(
    axis: OneAxis, steps: int, low_pass: bool
) -> None:
    sampling = JR3 if low_pass else STATION
    delay = steps / sampling.hand_hz
    size = np.abs(multipliers(replace(axis, delay=delay), sampling))
    if np.abs(size - 1).min() > 1e-9:  # a multiplier on the circle has no count
        count = count_unstable_multipliers(cut_loop(axis, sampling), delay)
        assert count == (size > 1).sum()


@settings(max_examples=200, deadline=None)
@given(
    poles=st.lists(st.floats(-1.2, 1.2), min_size=2, max_size=4),
    numerator=st.lists(st.floats(-2.0, 2.0), min_size=2, max_size=2),
    D=st.integers(0, 12),
)
def test_count_agrees_with_roots_also_at_both_ends_of_the_circle(
    poles: list[float], numerator: list[float], D: int
) -> None:
    """|L| > 1 at z = 1 or -1, either sign, and unstable cut loops."""
    p, q = np.poly(poles), np.array(numerator)
    loop = CutLoop.from_multipliers(
        np.array(poles, complex), np.roots(np.polysub(p, q)).astype(complex), 1.0
    )
    size = np.abs(np.roots(np.polysub(np.append(p, np.zeros(D)), q)))
    if np.abs(np.concatenate([size, np.abs(poles)]) - 1).min() < 1e-3:
        return  # on the circle
    w = np.linspace(0, np.pi, 2001)
    gain = np.abs(loop_response(loop, w))
    grazing = np.abs(gain[1:-1] - 1)[(np.diff(gain)[1:] * np.diff(gain)[:-1]) <= 0]
    if (grazing > 1e-2).all():
        assert count_unstable_multipliers(loop, D / 2) == (size > 1).sum()


@pytest.mark.parametrize(
    ("axis", "sampling"),
    [
        pytest.param(held("light", sigma=1.0, wall_stiffness=0.0), STATION, marks=pytest.mark.slow),
        (held("medium"), JR3),
        (held("medium", sigma=1.0), STATION),
        (held("medium", sigma=1.0), JR3),
        (held("firm", wall_stiffness=2e4), STATION),
    ],
)
def test_a_multiplier_leaves_the_circle_at_the_margin(axis: OneAxis, sampling: Sampling) -> None:
    margin = float(delay_margin(cut_loop(axis, sampling)))
    steps = int(margin / 2 * sampling.hand_hz)
    assert 5 < steps < 250
    before, after = (
        growth_rate(replace(axis, delay=n / sampling.hand_hz), sampling) for n in (steps, steps + 1)
    )
    assert before < 0 < after


@pytest.mark.parametrize(
    "axis", [held("light", wall_stiffness=1e3), held("firm", wall_stiffness=2e4)]
)
def test_a_multiplier_reaches_the_circle_at_gain_and_phase_margin(axis: OneAxis) -> None:
    loop = cut_loop(axis, JR3)
    w = np.geomspace(1e-2, np.pi * JR3.hand_hz, 6000)
    gain, phase = gain_and_phase_margin(loop_response(loop, w))
    moved = multipliers(replace(axis, force_scale=gain * axis.force_scale), JR3)
    assert np.abs(moved).max() == pytest.approx(1.0, abs=1e-6)
    # The phase margin is the lag of the delay margin where |L| = 1.
    crossing = w[np.argmin(np.abs(np.abs(loop_response(loop, w)[w > 1.0]) - 1)) + np.sum(w <= 1.0)]
    assert phase == pytest.approx(float(delay_margin(loop)) * crossing, rel=0.02)


def test_margins_of_a_delayed_integrator() -> None:
    """L = -K e^(-s) / s: gain margin pi / (2 K), phase margin pi / 2 - K."""
    w = np.geomspace(1e-3, 100.0, 20000)
    gain, phase = gain_and_phase_margin(-0.5 * np.exp(-1j * w) / (1j * w))
    assert gain == pytest.approx(np.pi, rel=1e-4) and phase == pytest.approx(np.pi / 2 - 0.5)
    assert gain_and_phase_margin(0.5 / (1 + 1j * w)) == (np.inf, np.inf)


@pytest.mark.parametrize("round_trip", [0.0, 0.1, 0.18, 0.43, 0.48])
def test_delay_margin_above_a_stable_delay_is_the_next_unstable_one(round_trip) -> None:
    """Between 186 and about 400 ms and from about 500 ms the loop is unstable."""
    loop = cut_loop(held("light", sigma=1.0, wall_stiffness=0.0), STATION)
    margin = float(delay_margin(loop, round_trip))
    between = np.linspace(round_trip, margin - 1e-6, 200)
    assert margin > round_trip
    assert not any(count_unstable_multipliers(loop, delay / 2) for delay in between)
    assert count_unstable_multipliers(loop, (margin + 1e-6) / 2) == 2
    assert delay_margin(loop, margin + 1e-3) == margin + 1e-3  # unstable


def test_delay_margin_is_0_if_unstable_and_infinite_without_limit() -> None:
    assert delay_margin(cut_loop(held("light", wall_stiffness=5.1e3), STATION)) == 0.0
    firm = cut_loop(held("firm", wall_stiffness=5.1e3), STATION)
    assert delay_margin(firm) == np.inf
    assert (count_unstable_multipliers(firm, np.geomspace(5e-4, 100.0, 1000)) == 0).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    "axis", [held("medium", wall_stiffness=2.5e3), held("firm", wall_stiffness=2e4)]
)
def test_a_simulation_becomes_unstable_at_the_margin(bench: ModuleType, axis: OneAxis) -> None:
    simulated = bench.simulated_margin(axis, JR3)
    assert float(delay_margin(cut_loop(axis, JR3))) == pytest.approx(simulated, abs=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("delay", [0.0, 5e-3, 20e-3, 40e-3])
def test_multipliers_predict_how_a_perturbation_grows(bench: ModuleType, delay: float) -> None:
    axis = held("medium", delay=delay)
    simulated = bench.simulated_growth(axis, STATION)
    assert growth_rate(axis, STATION) == pytest.approx(simulated, rel=0.02)


def test_arrays_of_parameters_equal_single_loops() -> None:
    k, sigma = np.array([[0.0], [5.1e3], [2e4]]), np.array([0.0, 1.0])
    both = cut_loop(replace(OneAxis(), wall_stiffness=k, sigma=sigma), JR3)
    assert both.open_multipliers.shape == (3, 2, 10)
    margins = delay_margin(both)
    w = np.array([1.0, 20.0])
    responses = loop_response(both, w, 0.01)
    for i in range(3):
        for j in range(2):
            one = cut_loop(OneAxis(wall_stiffness=k[i, 0], sigma=sigma[j]), JR3)
            assert margins[i, j] == pytest.approx(float(delay_margin(one)), rel=1e-9)
            np.testing.assert_allclose(
                responses[:, i, j], loop_response(one, w, 0.01), rtol=1e-8, atol=1e-12
            )


@pytest.mark.parametrize(
    "call, words",
    [
        (lambda: cut_loop(OneAxis(ideal_servo=True), STATION), "ideal servo"),
        (lambda: cut_loop(OneAxis(), Sampling(joint_control_hz=1999.0)), "joint_control_hz"),
        (lambda: cut_loop(OneAxis(), Sampling(joint_control_hz=1e3)), "whole multiple"),
        (lambda: cut_loop(OneAxis(), Sampling(low_pass_hz=5e3)), "5000 Hz is not .*, 8000 Hz"),
    ],
)
def test_ideal_servo_and_incompatible_rates_raise(call, words: str) -> None:
    with pytest.raises(DrakeTeleopError, match=words):
        call()


@pytest.mark.parametrize("turns", [0.01, 1.0, 50.0])
def test_held_response_on_a_stiff_wall_equals_closed_form(turns):
    """x'' = u - w^2 x: cosines and sines, for any number of oscillations in a step."""
    w, t = 300.0, turns * 2 * np.pi / 300.0 + 1e-3
    c, s = np.cos(w * t), np.sin(w * t)
    (found,) = mass_spring_unit_responses(w**2, 0.0, np.array([t]))
    exact = [[c, s / w, (1 - c) / w**2], [-w * s, c, s / w]]
    np.testing.assert_allclose(found, exact, atol=1e-9 * w)
