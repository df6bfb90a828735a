"""The led hand: whatever turns follow, its way has no jump, and its rates are those of its pose."""

from __future__ import annotations

import numpy as np
import pytest

from drake_teleop.common.quaternions import conjugate, exponential, logarithm, multiply
from drake_teleop.live.hand import LiveHand
from drake_teleop.station.operator.operator import OperatorConfig

START = np.array([1.0, 0.0, 0.0, 0.0, 0.1, 0.2, 0.3])
#: When, and where to: a turn [rad] and a place [m], both about and along other axes each time.
TARGETS = (
    (0.0, (1.5, 0.0, 0.0), (0.2, 0.2, 0.3)),
    (0.05, (0.0, -2.0, 0.7), (0.1, 0.3, 0.3)),
    (0.08, (0.3, 0.4, 2.5), (0.0, 0.1, 0.2)),
)


class Led:
    """A hand on a stylus that rests, and what it wants."""

    def __init__(self) -> None:
        self.hand = LiveHand(OperatorConfig(), START)
        self.context = self.hand.CreateDefaultContext()
        self.hand.GetInputPort("pose_master").FixValue(self.context, START)
        self.hand.GetInputPort("twist_master").FixValue(self.context, np.zeros(6))

    def wants(self, time: float) -> list[np.ndarray]:
        """Quaternion (4,), place (3,) [m], twist [v; omega] (6,) and acceleration (3,) then."""
        self.context.SetTime(time)
        return np.split(self.hand._present_intention(self.context).copy(), [4, 7, 13])

    def lead(self, time: float, orientation: tuple[float, ...], place: tuple[float, ...]) -> None:
        self.context.SetTime(time)
        self.hand.SetTarget(self.context, np.array([*orientation, *place]))


def turned(to: np.ndarray, since: np.ndarray) -> np.ndarray:
    """(3,) rotation vector in B [rad] from one orientation to another."""
    return np.array(logarithm(multiply(tuple(to), conjugate(tuple(since)))))


@pytest.fixture
def led() -> Led:
    """On its way to the last of the targets."""
    led = Led()
    for time, turn, place in TARGETS:
        led.lead(time, exponential(turn), place)
    return led


@pytest.mark.parametrize("angle", [2.5, 0.5, 9e-3, 1e-4])
def test_to_another_target_it_goes_on_as_it_was(led, angle):
    """About an axis across the one that it turns about."""
    orientation, place, twist, acceleration = led.wants(0.11)
    across = np.cross(twist[3:], [0.3, -0.2, 0.5])
    turn = exponential(tuple(angle / np.linalg.norm(across) * across))
    led.lead(0.11, multiply(turn, tuple(orientation)), (0.1, 0.1, 0.1))
    then = led.wants(0.11)
    assert np.linalg.norm(twist[3:]) > 5.0
    np.testing.assert_allclose(turned(then[0], orientation), 0.0, atol=1e-12)
    np.testing.assert_allclose(then[1], place, atol=1e-15)
    np.testing.assert_allclose(then[2], twist, rtol=0, atol=1e-9)
    assert np.linalg.norm(acceleration) > 5.0
    np.testing.assert_allclose(then[3], acceleration, rtol=0, atol=1e-9)


@pytest.mark.parametrize("time", [0.09, 0.12, 0.2, 0.4])
def test_its_twist_is_the_rate_of_its_pose(led, time):
    h = 1e-5
    before, after, now = led.wants(time - h), led.wants(time + h), led.wants(time)
    rate = np.concatenate([after[1] - before[1], turned(after[0], before[0])]) / (2 * h)
    np.testing.assert_allclose(rate, now[2], rtol=0, atol=1e-5)
    faster = (after[2] - before[2])[:3] / (2 * h)
    np.testing.assert_allclose(faster, now[3], rtol=1e-5, atol=1e-5)
