"""Z-width of a sampled device: in frequency, in time, and against poles of the loop."""

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import eigh, toeplitz

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.lab.analysis.sampled_wall import (
    _maximum,
    friction_stiffness,
    passive_damping,
    passive_damping_of,
    passive_friction,
    passive_stiffness,
    required_damping,
    sampled_poles,
    stable_stiffness,
)

PERIOD = 1e-3

stiffnesses = st.floats(10.0, 5000.0)
dampings = st.floats(-3.0, 3.0)
delays = st.integers(0, 6)


@given(stiffnesses, dampings, st.floats(1e-4, 1e-2))
def test_passive_damping_without_delay(K, B, period):
    np.testing.assert_allclose(passive_damping(K, B, period), K * period / 2 + abs(B), rtol=1e-9)


@given(stiffnesses, st.integers(0, 20), st.floats(1e-4, 1e-2))
def test_passive_damping_without_wall_damping(K, delay, period):
    closed = K * period * (0.5 + delay)
    np.testing.assert_allclose(passive_damping(K, 0.0, period, delay), closed, rtol=1e-9)


@given(stiffnesses, st.floats(0.0, 3.0))
def test_passive_damping_with_one_sample_of_delay(K, B):
    """A quadratic in cos(theta), whose maximum is inside the range if K Ts <= 4 B."""
    x = K * PERIOD
    closed = x / 2 + x**2 / (8 * B) + B if x <= 4 * B else 1.5 * x - B
    np.testing.assert_allclose(passive_damping(K, B, PERIOD, 1), closed, rtol=1e-9)


def test_passive_damping_with_damping_and_delay_is_below_the_sum():
    assert passive_damping(1000.0, 2.0, PERIOD, 1) == pytest.approx(2.5625, rel=1e-9)
    assert passive_damping(1000.0, 0.2, PERIOD, 3) == pytest.approx(3.30, rel=1e-9)
    assert passive_stiffness(2.0, 0.5, PERIOD, 1) == pytest.approx((7**0.5 - 1) / PERIOD, rel=1e-9)


def wall_impulse_response(K: float, B: float, delay: int, samples: int) -> np.ndarray:
    h = np.zeros(max(samples, delay + 2))
    h[delay], h[delay + 1] = K + B / PERIOD, -B / PERIOD
    return h[:samples]


def energy_damping(impulse_response: np.ndarray) -> float:
    """Return the device damping [N s/m] that makes a wall passive over n samples, from its energy.

    The work on the wall in a period is f_k (x_(k+1) - x_k). From rest, the energy is v' W v with
    mean velocities v and a strictly lower triangular Toeplitz matrix W of the step response. The
    device dissipates at least b Ts v'v.
    """
    step_response = np.cumsum(impulse_response)
    n = len(step_response)
    work = toeplitz(np.r_[0.0, step_response[:-1]], np.zeros(n)) * PERIOD**2
    least = eigh((work + work.T) / 2, eigvals_only=True, subset_by_index=[0, 0])
    return float(-least[0] / PERIOD)


def wall(z, K, B, delay):
    return z**-delay * (K + B * (z - 1) / (PERIOD * z))


@given(stiffnesses, dampings, delays)
def test_sum_of_cosines_equals_the_condition(K, B, delay):
    """Against the condition (T62) on a grid, and against the search for any wall."""
    theta = np.linspace(1e-2, np.pi, 2001)
    H = wall(np.exp(1j * theta), K, B, delay)
    written = PERIOD / 2 / (1 - np.cos(theta)) * ((1 - np.exp(-1j * theta)) * H).real
    np.testing.assert_allclose(required_damping(H, theta, PERIOD), written, atol=1e-9)
    exact = passive_damping(K, B, PERIOD, delay)
    assert written.max() <= exact * (1 + 1e-9)
    np.testing.assert_allclose(
        passive_damping_of(lambda z: wall(z, K, B, delay), PERIOD), exact, rtol=1e-8
    )


def test_higher_of_two_nearly_equal_peaks_is_found():
    """cos 5 theta has peaks at 0, 2/5 pi and 4/5 pi, here with the second one 6e-6 above the third.

    The grid passes it by 0.4 of a step, which costs 1e-4 there.
    """
    value, angle = _maximum(np.array([0.0, 0.0, -5e-6, 0.0, 0.0, 1.0]))
    assert angle == pytest.approx(0.4 * np.pi, abs=1e-5)
    assert value == pytest.approx(1.0 - 5e-6 * np.cos(0.8 * np.pi), abs=1e-10)


def test_passive_damping_of_a_control_transfer_function():
    """A spring with damping of a filtered velocity has no closed form."""
    z = control.tf("z")
    filtered = 800.0 + 0.4 * (z - 1) / (PERIOD * z) * 0.2 * z / (z - 0.8)
    filtered.dt = PERIOD
    h = control.impulse_response(filtered, T=PERIOD * np.arange(1500)).outputs * PERIOD
    damping = passive_damping_of(filtered, PERIOD)
    assert 0.99 * damping < energy_damping(h) <= damping * (1 + 1e-9)
    assert damping != pytest.approx(0.8, rel=1e-3)


@pytest.mark.parametrize(
    "K, B, delay",
    [(1000, 0, 0), (1000, 2, 1), (1000, 0.2, 3), (3000, 0.5, 0), (2000, -0.5, 0), (400, 0, 5)],
)
def test_energy_damping_tends_to_the_passive_damping(K, B, delay):
    """The least damping without negative energy is within 1 % of the condition."""
    damping = float(passive_damping(K, B, PERIOD, delay))
    found = [energy_damping(wall_impulse_response(K, B, delay, n)) for n in (50, 200, 600)]
    assert found[0] <= found[1] + 1e-12 <= found[2] + 2e-12
    assert 0.99 * damping <= found[-1] <= damping * (1 + 1e-9)


def wall_work(x, K, B, delay, friction=0.0, resolution=None):
    """Return the work on wall and friction along sampled positions, from rest at x[0] = 0."""
    seen = x if resolution is None else resolution * np.round(x / resolution)
    h = wall_impulse_response(K, B, delay, len(x))
    force = np.convolve(h, seen)[: len(x)]
    return np.cumsum(force[:-1] * np.diff(x) + friction * np.abs(np.diff(x)))


@given(stiffnesses, dampings, delays, st.integers(0, 10**6))
def test_no_motion_takes_energy_from_a_passive_wall(K, B, delay, seed):
    random = np.random.default_rng(seed)
    steps = random.normal(size=300) * random.choice([1e-6, 1e-4, 1e-2])
    x = np.concatenate([[0.0], np.cumsum(steps)])
    lost = np.cumsum(passive_damping(K, B, PERIOD, delay) / PERIOD * steps**2)
    assert np.all(wall_work(x, K, B, delay) + lost >= -1e-12 * lost[-1])


def test_friction_for_negative_damping_equals_that_for_positive():
    """Delta / 2 of error in each of two samples, times |B| / Ts each."""
    for B in (0.5, -0.5):
        assert passive_friction(0.0, B, PERIOD, 2e-5) == pytest.approx(2e-5 * 0.5 / PERIOD)


@given(stiffnesses, st.floats(-1.0, 1.0), delays, st.integers(0, 10**6))
def test_friction_covers_the_resolution_of_the_encoder(K, B, delay, seed):
    """Slow motion about an edge of the encoder is the worst case."""
    resolution = 2e-5
    random = np.random.default_rng(seed)
    steps = random.normal(size=300) * resolution * random.choice([1e-3, 0.1, 1.0])
    x = np.concatenate([[0.0, resolution / 2], resolution / 2 + np.cumsum(steps)])
    lost = np.cumsum(passive_damping(K, B, PERIOD, delay) / PERIOD * np.diff(x) ** 2)
    friction = float(passive_friction(K, B, PERIOD, resolution))
    energy = wall_work(x, K, B, delay, friction, resolution) + lost
    assert np.all(energy >= -1e-12 * np.max(np.abs(energy)))


def test_less_friction_allows_a_cycle_with_energy_gain():
    """A cycle about an edge of the encoder gains K Delta over half of the path."""
    resolution, friction, damping = 2e-5, 0.03, 2.0
    limit = float(friction_stiffness(damping, friction, PERIOD, resolution))
    assert limit == pytest.approx(2 * friction / resolution)
    tiny = 1e-4 * resolution
    x = np.concatenate(
        [[0.0], resolution / 2 + np.tile([-tiny, tiny], 200), [resolution / 2 - tiny]]
    )
    lost = damping / PERIOD * np.sum(np.diff(x)[1:] ** 2)
    for ratio, gives in ((0.99, False), (1.01, True)):
        work = wall_work(x, ratio * limit, 0.0, 0, friction, resolution)
        given_away = -(work[-1] - work[0] + lost)
        assert (given_away > 0) == gives
    assert friction_stiffness(damping, 1.0, PERIOD, resolution) == 2 * damping / PERIOD


@given(st.floats(0.1, 5.0), st.floats(-1.0, 1.5), delays)
def test_passive_stiffness_is_the_largest(b, ratio, delay):
    B = ratio * b
    K = float(passive_stiffness(b, B, PERIOD, delay))
    if K:
        assert passive_damping(K, B, PERIOD, delay) == pytest.approx(b, rel=1e-9)
    above = passive_damping(max(K, 1e-6) * np.array([1.001, 1.5, 10.0]), B, PERIOD, delay)
    assert np.all(above > b * (1 - 1e-9))


@settings(max_examples=60)
@given(
    st.floats(0.02, 2.0),
    st.floats(0.1, 5.0),
    st.floats(-0.8, 1.0),
    st.integers(0, 4),
    st.floats(0.0, 2000.0),
)
def test_a_pole_leaves_the_circle_at_stable_stiffness(mass, b, ratio, delay, hand):
    B = ratio * b
    args = (PERIOD, delay)
    K = float(stable_stiffness(mass, b, B, *args, hand_stiffness=hand))
    radius = [
        np.abs(sampled_poles(mass, b, f * K, B, *args, hand_stiffness=hand)).max()
        for f in (0.3, 0.999, 1.001)
    ]
    if K:
        assert radius[0] < 1 and radius[1] < 1 < radius[2]
    assert passive_stiffness(b, B, *args) <= K * (1 + 1e-9)


def test_stable_stiffness_is_above_the_passive_one():
    """A free device of 0.15 kg: factor 1.00 to 1.03 without B, 1.66 with."""
    for delay in (0, 1, 2, 5):
        for b in (0.5, 2.0, 8.0):
            ratio = stable_stiffness(0.15, b, 0.0, PERIOD, delay)
            ratio = ratio / passive_stiffness(b, 0.0, PERIOD, delay)
            assert 1.0 < ratio < (1.03 if b <= 2 else 1.06)
    for b in (0.5, 2.0):
        ratio = stable_stiffness(0.15, b, b / 4, PERIOD) / passive_stiffness(b, b / 4, PERIOD)
        assert ratio == pytest.approx(1.66, abs=0.01)


@pytest.mark.parametrize(
    "B, delay, ratio", [(0.0, 0, 1.0), (0.0, 2, 1.0), (-0.5, 0, 1.0), (0.5, 1, 1.013)]
)
def test_the_worst_hand_comes_close_to_the_passive_limit(B, delay, ratio):
    """Among undamped hands of mass and spring."""
    mass, hand = np.geomspace(1e-3, 50, 20)[:, None], np.r_[0.0, np.geomspace(1, 1e5, 15)]
    stable = stable_stiffness(mass, 2.0, B, PERIOD, delay, hand_stiffness=hand)
    worst = np.min(stable) / passive_stiffness(2.0, B, PERIOD, delay)
    assert worst == pytest.approx(ratio, abs=1e-3) and worst >= 1


def test_sampled_poles_predict_growth_of_a_simulation():
    mass, b, B, delay = 0.3, 1.5, 0.4, 2
    limit = stable_stiffness(mass, b, B, PERIOD, delay, hand_stiffness=300.0)
    fine = 20
    h = PERIOD / fine
    for ratio in (0.7, 1.3):
        x, v, history, sizes = 1e-3, 0.0, [0.0] * (delay + 1), []
        for _ in range(3000):
            history.insert(0, x)
            velocity = (history[delay] - history[delay + 1]) / PERIOD
            force = ratio * limit * history[delay] + B * velocity
            for _ in range(fine):
                middle = v - h / 2 * (b * v + 300.0 * x + force) / mass
                a = -(b * middle + 300.0 * (x + h / 2 * v) + force) / mass
                x, v = x + h * middle, v + h * a
            sizes.append(abs(x))
        poles = sampled_poles(mass, b, ratio * limit, B, PERIOD, delay, hand_stiffness=300.0)
        rate = np.log(np.max(sizes[-600:]) / np.max(sizes[-1800:-1200])) / 1200
        assert rate == pytest.approx(np.log(np.abs(poles).max()), rel=0.02)


@pytest.mark.long
@pytest.mark.slow
def test_grid_of_parameters_equals_single_values():
    b, B = np.linspace(0.1, 5, 100)[:, None], np.linspace(0, 2, 100)
    K = passive_stiffness(b, B, PERIOD, 1)
    stable = stable_stiffness(0.15, b, B, PERIOD, 1)
    assert K.shape == stable.shape == (100, 100)
    for i, j in ((0, 0), (50, 20), (99, 99)):
        assert passive_stiffness(b[i, 0], B[j], PERIOD, 1) == pytest.approx(K[i, j], rel=1e-12)
        single = stable_stiffness(0.15, b[i, 0], B[j], PERIOD, 1)
        assert single == pytest.approx(stable[i, j], rel=1e-9)


@pytest.mark.parametrize(
    "spoilt, match",
    [
        (lambda: passive_damping(1000.0, 0.0, 0.0), "period"),
        (lambda: passive_damping(1000.0, 0.0, PERIOD, -1), "whole number"),
        (lambda: passive_stiffness(-1.0, 0.0, PERIOD), "damping of the device"),
        (lambda: stable_stiffness(0.0, 1.0, 0.0, PERIOD), "mass"),
        (lambda: stable_stiffness(1.0, 1.0, 0.0, PERIOD, hand_stiffness=-5.0), "hand"),
        (lambda: stable_stiffness(1.0, 1.0, 0.0, PERIOD, 0.5), "whole number"),
        (lambda: passive_friction(1000.0, 0.0, PERIOD, 0.0), "resolution"),
        (lambda: friction_stiffness(1.0, -0.1, PERIOD, 1e-5), "friction"),
        (lambda: required_damping([1.0], [1.0], np.nan), "period"),
    ],
)
def test_invalid_numbers_raise(spoilt, match):
    with pytest.raises(DrakeTeleopError, match=match):
        spoilt()
