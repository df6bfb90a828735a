"""Contact detection by the operator: Weber's law, masking and learned expectation."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.station.operator.perception import (
    _FORCE_MODEL_DRIFT_STD_PER_SQRT_S,
    _FORCE_NOISE_DENSITY_N_PER_SQRT_HZ,
    CONTACT_NOTICED_INDEX,
    DETECTION_THRESHOLD_INDEX,
    EXCESS_FORCE_START_INDEX,
    Perception,
    _update_force_model_by_kalman_filter,
    perceive_contact,
)

RATE = 200.0
T = np.arange(0.0, 6.0, 1 / RATE)
HUMAN = Perception()
PUSH = 5.0  # s, when a contact begins


@pytest.mark.parametrize("seed", range(4))
def test_update_of_the_force_model_is_that_of_all_three_forces_at_once(seed):
    """Compare with the equations of the Kalman filter."""
    rng, dt = np.random.default_rng(seed), 0.005
    theta, root, rows = rng.normal(size=6), rng.normal(size=(6, 6)), rng.normal(size=(3, 6))
    prior, excess = root @ root.T, rng.normal(size=3)
    P = prior + np.diag(_FORCE_MODEL_DRIFT_STD_PER_SQRT_S**2 * dt)
    noise = _FORCE_NOISE_DENSITY_N_PER_SQRT_HZ**2 / dt * np.eye(3)
    gain = P @ rows.T @ np.linalg.inv(rows @ P @ rows.T + noise)
    found, covariance = theta.copy(), prior.copy()
    _update_force_model_by_kalman_filter(found, covariance, rows, excess, dt)
    np.testing.assert_allclose(found, theta + gain @ excess, rtol=1e-7)
    np.testing.assert_allclose(covariance, P - gain @ rows @ P, rtol=1e-6, atol=1e-6)


def record(mass: float, steady: float, push: float, amplitude: float = 0.0):
    """Return a record of moving mass and weight at 1.5 Hz with a push from PUSH on."""
    omega = 2 * np.pi * 1.5
    velocity, force = np.zeros((len(T), 3)), np.zeros((len(T), 3))
    velocity[:, 2] = amplitude * omega * np.sin(omega * T)
    acceleration = amplitude * omega**2 * np.cos(omega * T)
    # Forces of the hand on the stylus: it carries, accelerates, and resists the push downwards.
    force[:, 2] = steady + mass * acceleration - push * (T >= PUSH)
    return force, velocity


def is_perceived(mass: float, steady: float, push: float, amplitude: float = 0.0, hand_mass=0.0):
    felt = perceive_contact(
        T, *record(mass, steady, push, amplitude), HUMAN, hand_mass, attentive=3.0
    )
    return felt[:, CONTACT_NOTICED_INDEX] > 0.0


@pytest.mark.slow
@settings(max_examples=30, deadline=None)
@given(steady=st.floats(0.0, 8.0))
def test_push_is_detected_above_the_just_noticeable_difference(steady):
    """Weber's law, and the absolute threshold for small forces."""
    least = max(HUMAN.absolute_threshold, HUMAN.weber_fraction * steady)
    after = T >= PUSH
    plain = is_perceived(0.0, steady, 1.2 * least)
    assert not plain[~after].any()
    first = T[np.argmax(plain)] - PUSH
    assert 0.0 <= first < 0.1
    assert not is_perceived(0.0, steady, 0.9 * least).any()


@pytest.mark.slow
@pytest.mark.parametrize("push", [0.1, 0.3])
def test_inertial_force_masks_a_contact(push):
    """1.2 kg at 8.9 m/s^2 give 10.7 N; a push of 0.3 N is below a tenth of it."""
    assert is_perceived(0.0, 0.0, push).any()
    assert not is_perceived(1.2, 0.0, push, amplitude=0.1).any()


def test_moved_mass_is_learned_and_is_no_contact():
    felt = perceive_contact(T, *record(1.2, 2.0, 0.0, 0.1), HUMAN, 0.0, attentive=3.0)
    late = T > 3.0
    assert np.abs(felt[late, EXCESS_FORCE_START_INDEX:DETECTION_THRESHOLD_INDEX]).max() < 0.1
    assert felt[late, DETECTION_THRESHOLD_INDEX].min() > 0.4
    assert not felt[:, CONTACT_NOTICED_INDEX].any()


def test_inertial_force_of_the_hand_is_not_perceived():
    assert is_perceived(1.2, 0.0, 0.3, amplitude=0.1, hand_mass=1.2).any()


def test_masking_fades_with_its_time_constant():
    """The threshold decays as exp(-t / masking_time) after a motion."""
    force, velocity = record(1.2, 0.0, 0.0, 0.1)
    moving = (T < 4.0)[:, np.newaxis]
    felt = perceive_contact(T, force * moving, velocity * moving, HUMAN, 0.0, attentive=6.0)
    a, b = np.searchsorted(T, [4.2, 4.5])
    ratio = felt[b, DETECTION_THRESHOLD_INDEX] / felt[a, DETECTION_THRESHOLD_INDEX]
    assert ratio == pytest.approx(np.exp(-0.3 / HUMAN.masking_time), rel=0.02)


def test_record_of_wrong_shape_is_rejected():
    with pytest.raises(DrakeTeleopError, match="velocity"):
        perceive_contact(T, np.zeros((len(T), 3)), np.zeros((len(T), 2)), HUMAN, 0.0)
    gap, two_rates = T[(T < 4.0) | (T > 4.5)], np.concatenate([T[T < 4.0], T[T >= 4.0][::2]])
    for times in (T[:1], T[::-1], gap, two_rates):
        with pytest.raises(DrakeTeleopError, match="t: times do not increase in even steps"):
            perceive_contact(
                times, np.zeros((len(times), 3)), np.zeros((len(times), 3)), HUMAN, 0.0
            )
