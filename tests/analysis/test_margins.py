"""Margins of loops with delay, against closed forms, time, roots and the control library."""

from dataclasses import replace

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.lab.analysis.delayed_loop import (
    DelayedLoop,
    angle_of,
    delay_margin,
    gain_crossings,
    held_device,
    polynomial_roots,
    stable_delays,
    station_loop,
    unstable_poles,
)
from drake_teleop.lab.analysis.margins import (
    break_frequencies,
    encirclements,
    frequency_grid,
    margins,
    margins_of_response,
)
from drake_teleop.lab.analysis.one_axis import (
    OneAxis,
    device_impedance,
    environment_impedance,
    hand_impedance,
    servo_admittance,
    servo_response,
)

GRIPS = {"light": (0.1, 2.0, 50.0), "medium": (0.25, 8.0, 250.0), "firm": (0.5, 20.0, 700.0)}
WALLS = (1000.0, 5100.0, 20000.0)


def held(grip: str, **fields) -> OneAxis:
    mass, damping, stiffness = GRIPS[grip]
    hand = {"hand_mass": mass, "hand_damping": damping, "hand_stiffness": stiffness}
    return OneAxis(**{"ideal_servo": True, **hand, **fields})


positive = st.floats(0.02, 5.0)
devices = st.tuples(positive, st.floats(0.1, 50.0), st.floats(1.0, 3000.0))


def contact_delay_margin(m: float, b: float, k: float, K: float) -> float:
    """Return the largest round trip [s] of m s^2 + b s + k + K e^(-s RTT) (T41)."""
    middle = (2 * m * k - b**2) / (2 * m**2)
    root = middle**2 - (k**2 - K**2) / m**2
    with np.errstate(invalid="ignore", divide="ignore"):
        w = np.sqrt(middle + np.sqrt(root))
        return np.where(w > 0, np.arctan2(b * w, m * w**2 - k) / w, np.inf)


def delay_independent_stiffness(m: float, b: float, k: float) -> float:
    """Return the felt stiffness K [N/m] below which contact is stable for every delay."""
    return b * np.sqrt(k / m - b**2 / (4 * m**2)) if b**2 < 2 * k * m else k


def delay_independent_mass(m: float, b: float, k: float) -> float:
    """Return the felt tool mass [kg] below which free motion is stable for every delay."""
    return b * np.sqrt(m / k - b**2 / (4 * k**2)) if b**2 < 2 * k * m else m


def changes_of_stability(m: float, b: float, k: float, mu: float, longest: float) -> list[float]:
    """Return the round trips [s] at which free motion with a felt mass mu < m changes (T42).

    At the higher of two frequencies a pole enters the right half plane, at the lower it leaves.
    """
    middle = (2 * m * k - b**2) / (2 * (m**2 - mu**2))
    root = middle**2 - k**2 / (m**2 - mu**2)
    if middle <= 0 or root <= 0:
        return []
    crossings: list[tuple[float, int]] = []
    for sign in (1, -1):
        w = np.sqrt(middle + sign * np.sqrt(root))
        first = (2 * np.pi - np.arctan2(b * w, k - m * w**2)) / w
        crossings += [(t, sign) for t in np.arange(first, longest, 2 * np.pi / w)]
    changes, unstable = [], 0
    for t, sign in sorted(crossings):
        if unstable + sign == 0 or unstable == 0:
            changes.append(t)
        unstable += sign
    return changes


def nyquist_frequencies(loop: DelayedLoop) -> np.ndarray:
    """Return frequencies [rad/s] between which 1 + L turns by less than 30 deg."""
    slow, fast = break_frequencies(loop)
    crossing, _ = gain_crossings(loop)
    omega = frequency_grid(loop, slow, float(np.nanmax(1.5 * crossing, initial=fast)))
    while True:
        difference = 1 + loop(1j * omega)
        wide = np.abs(angle_of(difference[1:] / difference[:-1])) > np.pi / 6
        if not wide.any():
            return omega
        omega = np.sort(np.concatenate([omega, (omega[1:][wide] + omega[:-1][wide]) / 2]))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_leading_zero_gives_a_very_large_root(sign: float) -> None:
    polynomials = sign * np.array([[0.0, 2.0, 6.0], [2.0, 6.0, 4.0]])
    roots = polynomial_roots(polynomials)
    roots = np.take_along_axis(roots, np.argsort(np.abs(roots), axis=-1), axis=-1)
    np.testing.assert_allclose(roots[:, 0], [-3.0, -1.0], rtol=1e-12)
    assert abs(roots[0, 1]) > 1e20
    assert roots[1, 1] == pytest.approx(-2.0)


def test_loop_is_felt_impedance_over_that_of_hand_and_device():
    axis = OneAxis(sigma=0.7, gamma=0.9, mass_error=0.3, wall_damping=40.0, delay=0.02)
    s = 1j * np.geomspace(0.1, 1000, 50)
    G, Y, Z_e = servo_response(axis, s), servo_admittance(axis, s), environment_impedance(axis, s)
    M, scale = axis.displayed_tool_mass, axis.force_scale * axis.position_scale
    # h11 - Z_m and h12 h21 of the position-force two-port, then its transmitted impedance
    inertial = scale * M * s * G * np.exp(-2 * s * axis.delay)
    product = -scale * G * (axis.gamma - M * s * Y) * np.exp(-2 * s * axis.delay)
    felt = inertial - product * Z_e / (1 + Y * Z_e)
    L = felt / (hand_impedance(axis, s) + device_impedance(axis, s))
    np.testing.assert_allclose(station_loop(axis)(s), L, rtol=1e-12)


@pytest.mark.long
@given(devices, st.floats(0.01, 20.0))
def test_delay_margin_in_contact_equals_closed_form(device, ratio):
    m, b, k = device
    K = ratio * k
    loop = DelayedLoop([K], [m, b, k], 0.0)
    closed = contact_delay_margin(m, b, k, K)
    np.testing.assert_allclose(delay_margin(loop), closed, rtol=1e-6)
    bound = delay_independent_stiffness(m, b, k)
    assert np.isinf(closed) == (bound >= K) or bound == pytest.approx(K, rel=1e-12)


@given(devices, st.floats(0.02, 0.98))
def test_windows_of_free_motion_equal_closed_form(device, ratio):
    m, b, k = device
    mu = ratio * m
    loop = DelayedLoop([mu, 0, 0], [m, b, k], 0.0)
    changes = changes_of_stability(m, b, k, mu, 3.0)
    stable = stable_delays(loop, 3.0)
    assert bool(changes) == (mu > delay_independent_mass(m, b, k)) or stable == [(0.0, 3.0)]
    edges = [0.0, *changes, *([3.0] if len(changes) % 2 == 0 else [])]
    np.testing.assert_allclose(np.ravel(stable), edges, rtol=1e-6)


def test_delay_margins_of_three_grips_and_walls():
    """Round trip times [ms] of a softer wall, the paper's leaf and a stiffer one."""
    stated = [[51, np.inf, np.inf], [8.7, 36, np.inf], [2.2, 7.7, 21]]
    computed = [
        [1e3 * delay_margin(station_loop(held(g, wall_stiffness=k))) for g in GRIPS] for k in WALLS
    ]
    np.testing.assert_allclose(computed, stated, rtol=0.01)


def test_windows_of_a_light_grip_with_displayed_tool():
    axis = held("light", sigma=1.0)
    loop = station_loop(axis, contact=False)
    (_, first), (back, second), (again, _) = stable_delays(loop, 0.8)
    np.testing.assert_allclose(
        [first, back, second, again], [0.190, 0.339, 0.497, 0.788], atol=1e-3
    )
    assert stable_delays(station_loop(held("light", sigma=0.92), contact=False), 100.0) == [
        (0, 100)
    ]
    bounds = [delay_independent_mass(*held_device(held(g))) for g in GRIPS]
    np.testing.assert_allclose(bounds, [0.165, 0.308, 0.548], atol=6e-4)
    medium = station_loop(held("medium", sigma=2.0), contact=False)
    assert stable_delays(medium, 0.1)[0][1] == pytest.approx(0.061, abs=1e-3)
    assert unstable_poles(station_loop(replace(axis, sigma=0.0), contact=False)) == 0


def test_mass_error_above_hand_and_device_is_unstable_for_any_delay():
    m, _, _ = held_device(held("light"))
    bound = 17.5 * m  # m / (k_f l_p), with l_p = 1
    assert bound == pytest.approx(4.4, abs=0.03)
    for error, any_delay in ((1.01 * bound, np.inf), (0.99 * bound, 2)):
        axis = held("light", sigma=0.0, mass_error=error, delay=np.array([0.0, 1e-3]))
        counts = unstable_poles(station_loop(axis, contact=False))
        assert counts[1] >= any_delay
    assert delay_margin(station_loop(held("light", mass_error=1.01 * bound), contact=False)) == 0


@njit
def _growth(m, b, k, mu, K, lag, n, step):
    back = lag + 1
    x, a = np.zeros(back + n), np.zeros(back + n)
    v = 1.0
    a[back] = -b * v / m
    mass = m + step / 2 * b + step**2 / 4 * k
    for i in range(back, back + n - 1):
        v_free = v + step / 2 * a[i]
        x_free = x[i] + step * v + step**2 / 4 * a[i]
        force = -mu * a[i + 1 - lag] - K * x[i + 1 - lag]
        a[i + 1] = (force - b * v_free - k * x_free) / mass
        v = v_free + step / 2 * a[i + 1]
        x[i + 1] = x_free + step**2 / 4 * a[i + 1]
    early = np.abs(x[back + n // 3 : back + 2 * n // 3]).max()
    return np.abs(x[back + 2 * n // 3 :]).max() / early


def growth(m, b, k, mu, K, delay, *, longest=60.0, step=2.5e-4):
    """Return the ratio of late to early motion of m x'' + b x' + k x = -mu x''(t - T) - K x(t - T).

    By the trapezoidal rule, with the delay a whole number of steps.
    """
    return _growth(m, b, k, mu, K, max(round(delay / step), 1), int(longest / step), step)


@pytest.mark.long
@pytest.mark.slow
def test_simulations_2_ms_from_the_margin_decay_or_grow():
    """Three grips on five walls, and the edges of the windows of free motion."""
    cases = []
    for grip in GRIPS:
        m, b, k = held_device(held(grip))
        for wall in (500.0, 1000.0, 2500.0, 5100.0, 20000.0):
            edge = delay_margin(station_loop(held(grip, wall_stiffness=wall)))
            cases.append((m, b, k, 0.0, wall / 17.5, edge, 1))
    for grip, sigma, windows in (("light", 1.0, 2), ("medium", 2.0, 1)):
        m, b, k = held_device(held(grip))
        stable = stable_delays(station_loop(held(grip, sigma=sigma), contact=False), 0.6)
        for start, end in stable[:windows]:
            cases.append((m, b, k, sigma * 3.13 / 17.5, 0.0, end, 1))
            if start:
                cases.append((m, b, k, sigma * 3.13 / 17.5, 0.0, start, -1))
    assert 10 < np.isfinite([case[5] for case in cases]).sum() < len(cases)
    for *system, edge, direction in cases:
        if np.isfinite(edge):
            assert growth(*system, edge - 0.002 * direction) < 0.97, system
            assert growth(*system, edge + 0.002 * direction) > 1.03, system
        else:
            for delay in (0.01, 0.05, 0.2):
                assert growth(*system, delay) < 0.97, system


def count_by_collocation(loop: DelayedLoop, nodes: int = 120) -> int:
    """Return the unstable roots of D + N e^(-s T), from the history on Chebyshev nodes.

    Breda, Maset and Vermiglio (2005): the delay equation is a transport equation on [-T, 0].
    """
    N, D, T = loop.numerator, loop.denominator, float(loop.delay)
    n = len(D) - 1
    theta = np.cos(np.pi * np.arange(nodes + 1) / nodes)
    weight = np.r_[2, np.ones(nodes - 1), 2] * (-1.0) ** np.arange(nodes + 1)
    gap = theta[:, None] - theta[None, :] + np.eye(nodes + 1)
    derivative = weight[:, None] / weight[None, :] / gap
    derivative -= np.diag(derivative.sum(axis=1))
    derivative *= 2 / T
    # State x, x', ..; x^(n) = -(D_i / D_0) x^(i) - (N_i / D_0) x^(i)(t - T)
    present = np.eye(n, k=1)
    present[-1] = -D[:0:-1] / D[0]
    past, neutral = np.zeros((n, n)), np.zeros((n, n))
    past[-1] = -N[:0:-1] / D[0]
    neutral[-1, -1] = -N[0] / D[0]
    A = np.kron(derivative, np.eye(n))
    A[:n] = neutral @ A[-n:]
    A[:n, :n] += present
    A[:n, -n:] += past
    roots = np.linalg.eigvals(A)
    s = roots[roots.real > 0]
    # Eigenvalues beyond the resolution of the nodes are not roots.
    balance = np.polyval(N, s) / np.polyval(D, s) * np.exp(-s * T)
    return int(np.sum(np.abs(1 + balance) < 1e-3))


def random_loops(count: int, order: int, neutral: bool, seed: int):
    random = np.random.default_rng(seed)
    for _ in range(count):
        D = np.poly(-random.uniform(0.2, 4, order))
        N = random.normal(size=order + 1) * random.uniform(0.2, 3) * np.abs(D)
        N[0] = random.uniform(-0.9, 0.9) if neutral else 0.0
        yield DelayedLoop(N, D, random.uniform(0.05, 3.0))


@pytest.mark.slow
@pytest.mark.parametrize("order, neutral", [(1, False), (2, False), (3, False), (2, True)])
def test_counts_by_crossing_encirclement_and_roots_agree(order, neutral):
    seen = set()
    for loop in random_loops(25, order, neutral, seed=order + 10 * neutral):
        count = unstable_poles(loop)
        assert encirclements(loop(1j * nyquist_frequencies(loop))) == count
        assert count_by_collocation(loop) == count
        seen.add(float(count))
    assert len(seen) > 1


def test_encirclements_with_poles_at_the_origin():
    """A free hand gives integrators in the loop, which the contour passes on the right."""
    for sigma in (0.2, 0.7, 1.2):  # in free motion the integrator is also a zero
        axis = held("light", hand_stiffness=0.0, sigma=sigma, delay=0.1)
        loop = station_loop(axis, contact=False)
        assert encirclements(loop(1j * nyquist_frequencies(loop))) == unstable_poles(loop)
    for denominator, poles in (([1.0, 2.0, 0.0], 1), ([1.0, 2.0, 0.0, 0.0], 2)):
        for K, T in ((1.0, 0.1), (1.0, 3.0), (30.0, 0.2)):
            loop = DelayedLoop([0.3 * K, K], denominator, T)
            omega = nyquist_frequencies(loop)
            count = encirclements(loop(1j * omega), poles_at_origin=poles)
            assert count == unstable_poles(loop)


def test_encirclements_of_an_unstable_open_loop():
    omega = np.geomspace(1e-3, 100, 2000)
    for K, count in ((0.5, 1), (2.0, 0)):
        response = K / (1j * omega - 1)
        assert encirclements(response, open_loop_poles=1) == count
        assert unstable_poles(DelayedLoop([K], [1, -1], 0.0)) == count


def test_encirclements_of_a_sampled_loop():
    """A delayed integrator K z^-d / (z - 1), against the roots of z^d (z - 1) + K."""
    theta = np.linspace(1e-3, np.pi, 20000)
    z = np.exp(1j * theta)
    for d in (0, 1, 3):
        for K in (0.1, 0.35, 0.8, 1.7, 2.5):
            polynomial = np.zeros(d + 2)
            polynomial[:2], polynomial[-1] = (1, -1), polynomial[-1] + K
            if d == 0:
                polynomial = np.array([1, -1 + K])
            outside = np.sum(np.abs(np.roots(polynomial)) > 1)
            count = encirclements(K * z**-d / (z - 1), poles_at_origin=1, sampled=True)
            assert count == outside, (d, K)


@settings(max_examples=40)
@given(devices, st.floats(0.3, 20.0), st.floats(0.001, 0.2))
def test_margins_without_delay_equal_those_of_control(device, ratio, lag):
    m, b, k = device
    loop = DelayedLoop([ratio * k], np.polymul([m, b, k], [lag, 1]), 0.0)
    if unstable_poles(loop):
        return
    ours = margins(loop)
    transfer = control.tf([ratio * k], np.polymul([m, b, k], [lag, 1]))
    gain, phase, _, w_gain, w_phase, _ = control.stability_margins(transfer)
    np.testing.assert_allclose(ours.gain, gain, rtol=1e-6)
    np.testing.assert_allclose(ours.gain_frequency, w_gain, rtol=1e-6)
    if np.isfinite(phase):
        np.testing.assert_allclose(ours.phase, np.radians(phase), rtol=1e-5)
        np.testing.assert_allclose(ours.phase_frequency, w_phase, rtol=1e-5)
    else:
        assert np.isinf(ours.phase)


@given(
    st.sampled_from(list(GRIPS)),
    st.floats(300, 30000),
    st.floats(0.0, 1.5),
    st.floats(0.0, 0.1),
)
def test_loop_reaches_minus_one_at_its_margins(grip, wall, sigma, delay):
    axis = held(grip, wall_stiffness=wall, sigma=sigma, delay=delay, ideal_servo=False)
    loop = station_loop(axis)
    m = margins(loop)
    if m.unstable_poles:
        assert (m.gain, m.phase, m.delay) == (1, 0, 0)
        return
    for factor, more, w in ((m.gain, 0.0, m.gain_frequency), (1.0, m.delay, m.delay_frequency)):
        if np.isfinite(w):
            moved = DelayedLoop(factor * loop.numerator, loop.denominator, loop.delay + more)
            assert abs(1 + moved(1j * w)) < 1e-6
            for within in (0.5, 0.999):
                safe = DelayedLoop(
                    (1 + within * (factor - 1)) * loop.numerator,
                    loop.denominator,
                    loop.delay + within * more,
                )
                assert unstable_poles(safe) == 0
    if np.isfinite(m.phase):
        away = loop(1j * m.phase_frequency) * np.exp([1j * m.phase, -1j * m.phase])
        assert np.min(np.abs(1 + away)) < 1e-6


def test_gain_margins_at_infinite_frequency_and_below_one():
    """L tends to 0.4 e^-jwT, which 2.5 puts on -1; K (p + 1)^2 / p^3 has a margin below 1.

    Of K / (p + 1) e^-pT the limit is K T = pi / 2, however short T.
    """
    tail = margins(DelayedLoop([0.4, 0.4], [1.0, 2.0], 0.1))
    assert (tail.gain, tail.gain_frequency) == (pytest.approx(2.5), np.inf)
    conditional = margins(DelayedLoop(20.0 * np.array([1, 20, 100]), [1.0, 0, 0, 0], 0.0))
    assert (conditional.unstable_poles, conditional.gain) == (0, np.inf)
    for T in (1e-4, 1e-7):
        assert margins(DelayedLoop([1 / T], [1, 1], T)).gain == pytest.approx(np.pi / 2, rel=1e-3)


def test_margins_of_a_frequency_response_equal_those_of_the_loop():
    axis = held("medium", ideal_servo=False, delay=np.array([0.0, 0.004, 0.01]), sigma=0.5)
    omega = np.geomspace(0.1, 1000, 3000)
    loop = station_loop(axis)
    exact = margins(loop)
    data = margins_of_response(omega, loop(1j * omega))
    undelayed = station_loop(replace(axis, delay=0.0))
    frd = undelayed.to_control(omega)
    added = margins_of_response(frd.omega, frd.frdata[0, 0], delay=2 * axis.delay)
    for found in (data, added):
        np.testing.assert_array_equal(found.unstable_poles, exact.unstable_poles)
        for name in ("gain", "gain_frequency", "phase", "phase_frequency", "delay"):
            np.testing.assert_allclose(getattr(found, name), getattr(exact, name), rtol=2e-4)


def test_loops_from_control_objects():
    transfer = control.tf([291.0], [0.4, 8.5, 250.0])
    for system in (transfer, control.ss(transfer)):
        loop = DelayedLoop.from_control(system)
        assert delay_margin(loop) == pytest.approx(contact_delay_margin(0.4, 8.5, 250.0, 291.0))
    with pytest.raises(DrakeTeleopError, match="margins_of_response"):
        DelayedLoop.from_control(control.tf([1.0], [1.0, 0.5], 0.001))


@pytest.mark.slow
def test_grid_of_parameters_equals_single_loops():
    delay, wall = np.linspace(0, 0.2, 100)[:, None], np.geomspace(100, 1e5, 100)
    loop = station_loop(held("medium", ideal_servo=False, delay=delay, wall_stiffness=wall))
    count, margin = unstable_poles(loop), delay_margin(loop)
    assert count.shape == margin.shape == (100, 100)
    for i, j in ((0, 0), (50, 60), (10, 99), (99, 40)):
        single = station_loop(
            held("medium", ideal_servo=False, delay=delay[i, 0], wall_stiffness=wall[j])
        )
        assert unstable_poles(single) == count[i, j]
        np.testing.assert_allclose(delay_margin(single), margin[i, j], rtol=1e-9)


@pytest.mark.parametrize(
    "spoilt, match",
    [
        (lambda: held_device(replace(OneAxis(), hand_mass=-1.0)), "mass of hand and device"),
        (lambda: station_loop(OneAxis(hand_damping=-0.5)), "damping of hand and device"),
        (lambda: station_loop(OneAxis(slave_mass=0.0)), "mass of the slave"),
        (lambda: station_loop(OneAxis(delay=-0.001)), "delay of the loop"),
        (lambda: held_device(replace(OneAxis(), hand_stiffness=-1.0)), "stiffness of the hand"),
        (lambda: DelayedLoop([1, 0, 0], [1, 1], 0.0), "higher order"),
        (lambda: encirclements([3.0, -3.0]), "right angle"),
        (lambda: encirclements([3.0, 2.5]), "last frequency"),
        (lambda: margins_of_response([2.0, 1.0], [0.1, 0.1]), "must rise"),
    ],
)
def test_invalid_numbers_raise(spoilt, match):
    with pytest.raises(DrakeTeleopError, match=match):
        spoilt()
