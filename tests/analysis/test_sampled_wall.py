"""Z-width of a sampled device: in energy, and against poles of the loop."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import eigh, toeplitz

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.lab.analysis.sampled_wall import (
    passive_stiffness,
    sampled_poles,
    stable_stiffness,
)

PERIOD = 1e-3

stiffnesses = st.floats(10.0, 5000.0)
dampings = st.floats(-3.0, 3.0)


def wall_impulse_response(K: float, B: float, samples: int) -> np.ndarray:
    h = np.zeros(samples)
    h[:2] = K + B / PERIOD, -B / PERIOD
    return h


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


@pytest.mark.parametrize("b, B", [(2.0, 0.0), (2.0, 0.7), (2.0, -0.5), (0.4, 0.1)])
def test_passive_stiffness_is_the_largest_without_negative_energy(b, B):
    K = float(passive_stiffness(b, B, PERIOD))
    assert 0.99 * b < energy_damping(wall_impulse_response(K, B, 600)) <= b * (1 + 1e-9)


def test_no_wall_is_passive_whose_damping_exceeds_the_devices():
    assert passive_stiffness(1.0, 1.2, PERIOD) == 0.0


@given(stiffnesses, st.floats(0.0, 1.0), st.integers(0, 10**6))
def test_no_motion_takes_energy_from_a_passive_wall(K, share, seed):
    B = share * 3.0
    random = np.random.default_rng(seed)
    steps = random.normal(size=300) * random.choice([1e-6, 1e-4, 1e-2])
    x = np.concatenate([[0.0], np.cumsum(steps)])
    force = np.convolve(wall_impulse_response(K, B, len(x)), x)[: len(x)]
    b = K * PERIOD / 2 + B
    assert passive_stiffness(b, B, PERIOD) == pytest.approx(K, rel=1e-6)
    lost = np.cumsum(b / PERIOD * steps**2)
    assert np.all(np.cumsum(force[:-1] * steps) + lost >= -1e-12 * lost[-1])


@settings(max_examples=60)
@given(
    st.floats(0.02, 2.0),
    st.floats(0.1, 5.0),
    st.floats(-0.8, 1.0),
    st.floats(0.0, 2000.0),
)
def test_a_pole_leaves_the_circle_at_stable_stiffness(mass, b, ratio, hand):
    B = ratio * b
    K = float(stable_stiffness(mass, b, B, PERIOD, hand_stiffness=hand))
    radius = [
        np.abs(sampled_poles(mass, b, hand, f * K, B, PERIOD)).max() for f in (0.3, 0.999, 1.001)
    ]
    if K:
        assert radius[0] < 1 and radius[1] < 1 < radius[2]
    assert passive_stiffness(b, B, PERIOD) <= K * (1 + 1e-9)


def test_stable_stiffness_is_above_the_passive_one():
    """A free device of 0.15 kg: factor 1.00 to 1.06 without B, 1.66 with."""
    for b in (0.5, 2.0, 8.0):
        ratio = stable_stiffness(0.15, b, 0.0, PERIOD) / passive_stiffness(b, 0.0, PERIOD)
        assert 1.0 < ratio < (1.03 if b <= 2 else 1.06)
    for b in (0.5, 2.0):
        ratio = stable_stiffness(0.15, b, b / 4, PERIOD) / passive_stiffness(b, b / 4, PERIOD)
        assert ratio == pytest.approx(1.66, abs=0.01)


@pytest.mark.parametrize("B", [0.0, -0.5])
def test_the_worst_hand_comes_close_to_the_passive_limit(B):
    """The hands are undamped masses with springs."""
    mass, hand = np.geomspace(1e-3, 50, 20)[:, None], np.r_[0.0, np.geomspace(1, 1e5, 15)]
    stable = stable_stiffness(mass, 2.0, B, PERIOD, hand_stiffness=hand)
    worst = np.min(stable) / passive_stiffness(2.0, B, PERIOD)
    assert worst == pytest.approx(1.0, abs=1e-3) and worst >= 1


def test_sampled_poles_predict_growth_of_a_simulation():
    mass, b, B = 0.3, 1.5, 0.4
    limit = stable_stiffness(mass, b, B, PERIOD, hand_stiffness=300.0)
    fine = 20
    h = PERIOD / fine
    for ratio in (0.7, 1.3):
        x, v, before, sizes = 1e-3, 0.0, 0.0, []
        for _ in range(3000):
            force = ratio * limit * x + B * (x - before) / PERIOD
            before = x
            for _ in range(fine):
                middle = v - h / 2 * (b * v + 300.0 * x + force) / mass
                a = -(b * middle + 300.0 * (x + h / 2 * v) + force) / mass
                x, v = x + h * middle, v + h * a
            sizes.append(abs(x))
        poles = sampled_poles(mass, b, 300.0, ratio * limit, B, PERIOD)
        rate = np.log(np.max(sizes[-600:]) / np.max(sizes[-1800:-1200])) / 1200
        assert rate == pytest.approx(np.log(np.abs(poles).max()), rel=0.02)


def test_grid_of_parameters_equals_single_values():
    b, B = np.linspace(0.1, 5, 10)[:, None], np.linspace(0, 2, 10)
    stable = stable_stiffness(0.15, b, B, PERIOD)
    assert passive_stiffness(b, B, PERIOD).shape == stable.shape == (10, 10)
    for i, j in ((0, 0), (5, 2), (9, 9)):
        single = stable_stiffness(0.15, b[i, 0], B[j], PERIOD)
        assert single == pytest.approx(stable[i, j], rel=1e-9)


@pytest.mark.parametrize(
    "spoilt, match",
    [
        (lambda: passive_stiffness(1.0, 0.0, 0.0), "^period: has the value 0, which is not pos"),
        (lambda: passive_stiffness(-1.0, 0.0, PERIOD), "^device_damping: has the value -1"),
        (lambda: stable_stiffness(0.0, 1.0, 0.0, PERIOD), "^mass: has the value 0"),
        (lambda: stable_stiffness(1.0, 1.0, 0.0, PERIOD, hand_stiffness=-5.0), "^hand_stiffness:"),
        (lambda: passive_stiffness(1.0, np.nan, PERIOD), "^wall_damping: is not finite"),
        (lambda: stable_stiffness(1.0, 1.0, [2.0, np.inf], PERIOD), "^wall_damping: is not finite"),
        (lambda: sampled_poles(1.0, 1.0, 0.0, np.nan, 2.0, PERIOD), "^wall_stiffness: is not fin"),
        (lambda: sampled_poles(1.0, 1.0, 0.0, 3.0, -np.inf, PERIOD), "^wall_damping: is not fin"),
    ],
)
def test_invalid_numbers_raise(spoilt, match):
    with pytest.raises(DrakeTeleopError, match=match):
        spoilt()
