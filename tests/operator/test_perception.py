"""What a human notices: Weber's law, masking, and an expectation that is learnt while moving."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.station.operator.perception import (
    EXCESS,
    NOTICED,
    THRESHOLD,
    Perception,
    perceive,
)

RATE = 200.0
T = np.arange(0.0, 6.0, 1 / RATE)
HUMAN = Perception()
PUSH = 5.0  # s, when a contact begins


def record(mass: float, steady: float, push: float, amplitude: float = 0.0):
    """The hand moves an object of this mass and weight at 1.5 Hz and is pushed from PUSH on."""
    omega = 2 * np.pi * 1.5
    velocity, force = np.zeros((len(T), 3)), np.zeros((len(T), 3))
    velocity[:, 2] = amplitude * omega * np.sin(omega * T)
    acceleration = amplitude * omega**2 * np.cos(omega * T)
    # Of the hand on the stylus: it carries, accelerates, and answers the push downwards.
    force[:, 2] = steady + mass * acceleration - push * (T >= PUSH)
    return force, velocity


def noticed(mass: float, steady: float, push: float, amplitude: float = 0.0, hand_mass=0.0):
    felt = perceive(T, *record(mass, steady, push, amplitude), HUMAN, hand_mass, attentive=3.0)
    return felt[:, NOTICED] > 0.0


@settings(max_examples=30, deadline=None)
@given(steady=st.floats(0.0, 8.0))
def test_a_push_is_noticed_beyond_the_just_noticeable_difference(steady):
    """Weber's law, and the absolute threshold where there is little to compare with."""
    least = max(HUMAN.absolute_threshold, HUMAN.weber_fraction * steady)
    after = T >= PUSH
    plain = noticed(0.0, steady, 1.2 * least)
    assert not plain[~after].any()
    first = T[np.argmax(plain)] - PUSH
    assert 0.0 <= first < 0.1
    assert not noticed(0.0, steady, 0.9 * least).any()


@pytest.mark.parametrize("push", [0.1, 0.3])
def test_a_felt_inertial_force_masks_a_contact(push):
    """1.2 kg at 8.9 m/s^2: 10.7 N at most, so that a push of 0.3 N is less than a tenth of it."""
    assert noticed(0.0, 0.0, push).any()
    assert not noticed(1.2, 0.0, push, amplitude=0.1).any()


def test_what_one_moves_is_learnt_and_is_no_contact():
    felt = perceive(T, *record(1.2, 2.0, 0.0, 0.1), HUMAN, 0.0, attentive=3.0)
    late = T > 3.0
    assert np.abs(felt[late, EXCESS:THRESHOLD]).max() < 0.1
    assert felt[late, THRESHOLD].min() > 0.4
    assert not felt[:, NOTICED].any()


def test_the_hands_own_mass_is_not_felt():
    """Who accelerates nothing but the own hand is not masked."""
    assert noticed(1.2, 0.0, 0.3, amplitude=0.1, hand_mass=1.2).any()


def test_masking_fades_with_its_time_constant():
    """After a motion has stopped the threshold falls as exp(-t / masking_time)."""
    force, velocity = record(1.2, 0.0, 0.0, 0.1)
    moving = (T < 4.0)[:, np.newaxis]
    felt = perceive(T, force * moving, velocity * moving, HUMAN, 0.0, attentive=6.0)
    a, b = np.searchsorted(T, [4.2, 4.5])
    ratio = felt[b, THRESHOLD] / felt[a, THRESHOLD]
    assert ratio == pytest.approx(np.exp(-0.3 / HUMAN.masking_time), rel=0.02)


def test_a_record_of_the_wrong_shape_is_refused():
    with pytest.raises(DrakeTeleopError, match="velocity"):
        perceive(T, np.zeros((len(T), 3)), np.zeros((len(T), 2)), HUMAN, 0.0)
    for times in (T[:1], T[::-1]):
        with pytest.raises(DrakeTeleopError, match="t: is not increasing"):
            perceive(times, np.zeros((len(times), 3)), np.zeros((len(times), 3)), HUMAN, 0.0)
