"""Paths of the simulated hand are continuous, and their rates consistent."""

from __future__ import annotations

import numpy as np
import pytest

from drake_teleop.common.vectors import (
    conjugate_quaternion,
    quaternion_exponential,
    quaternion_logarithm,
    quaternion_product,
)
from drake_teleop.live.hand import LiveHand
from drake_teleop.station.operator.operator import GRIP_IMPEDANCES, OperatorConfig

START = np.array([1.0, 0.0, 0.0, 0.0, 0.1, 0.2, 0.3])
#: Time [s], rotation vector [rad] and position [m] of targets, with different axes.
TARGETS = (
    (0.0, (1.5, 0.0, 0.0), (0.2, 0.2, 0.3)),
    (0.05, (0.0, -2.0, 0.7), (0.1, 0.3, 0.3)),
    (0.08, (0.3, 0.4, 2.5), (0.0, 0.1, 0.2)),
)


class MovingHand:
    """Hand on a stylus at rest."""

    def __init__(self, grip: str = "medium") -> None:
        self.hand = LiveHand(OperatorConfig(grip=grip), START)
        self.context = self.hand.CreateDefaultContext()
        self.hand.GetInputPort("pose_master").FixValue(self.context, START)
        self.hand.GetInputPort("twist_master").FixValue(self.context, np.zeros(6))

    def intention(self, time: float) -> list[np.ndarray]:
        """Return the intended quaternion (4,), position [m], twist (6,) and acceleration (3,)."""
        self.context.SetTime(time)
        return np.split(self.hand._current_intended_motion(self.context).copy(), [4, 7, 13])

    def move_to(
        self, time: float, orientation: tuple[float, ...], position: tuple[float, ...]
    ) -> None:
        self.context.SetTime(time)
        self.hand.SetTarget(self.context, np.array([*orientation, *position]))


def rotation_between(to: np.ndarray, since: np.ndarray) -> np.ndarray:
    """Return the rotation vector (3,) in B [rad] between two orientations."""
    return np.array(
        quaternion_logarithm(quaternion_product(tuple(to), conjugate_quaternion(tuple(since))))
    )


@pytest.fixture
def moving_hand() -> MovingHand:
    """Return a hand on its way to the last of several targets."""
    moving_hand = MovingHand()
    for time, turn, position in TARGETS:
        moving_hand.move_to(time, quaternion_exponential(turn), position)
    return moving_hand


@pytest.mark.parametrize("angle", [2.5, 0.5, 9e-3, 1e-4])
def test_new_target_keeps_position_velocity_and_acceleration(moving_hand, angle):
    orientation, position, twist, acceleration = moving_hand.intention(0.11)
    across = np.cross(twist[3:], [0.3, -0.2, 0.5])
    turn = quaternion_exponential(tuple(angle / np.linalg.norm(across) * across))
    moving_hand.move_to(0.11, quaternion_product(turn, tuple(orientation)), (0.1, 0.1, 0.1))
    then = moving_hand.intention(0.11)
    assert np.linalg.norm(twist[3:]) > 5.0
    np.testing.assert_allclose(rotation_between(then[0], orientation), 0.0, atol=1e-12)
    np.testing.assert_allclose(then[1], position, atol=1e-15)
    np.testing.assert_allclose(then[2], twist, rtol=0, atol=1e-9)
    assert np.linalg.norm(acceleration) > 5.0
    np.testing.assert_allclose(then[3], acceleration, rtol=0, atol=1e-9)


@pytest.mark.parametrize(("before", "after"), [("light", "firm"), ("firm", "light")])
def test_change_of_the_grip_keeps_the_wrench(moving_hand, before, after):
    orientation, position, twist, _ = moving_hand.intention(0.11)
    turn = quaternion_exponential((0.05, -0.1, 0.08))
    pose = [*quaternion_product(turn, tuple(orientation)), *np.add(position, (0.01, -0.02, 0.03))]
    path = moving_hand.context.get_numeric_parameter(0).CopyToVector()
    wrenches = []
    for grip in (before, after):
        held = MovingHand(grip)
        held.context.SetTime(0.11)
        held.context.get_mutable_numeric_parameter(0).SetFromVector(path)
        held.hand.GetInputPort("pose_master").FixValue(held.context, np.array(pose))
        held.hand.GetInputPort("twist_master").FixValue(held.context, 0.5 * twist)
        if grip == after:
            held.hand.KeepWrench(held.context, GRIP_IMPEDANCES[before], GRIP_IMPEDANCES[after])
        wrenches.append(held.hand.GetOutputPort("hand_wrench_E").Eval(held.context).copy())
    assert np.abs(wrenches[0]).min() > 1e-3
    np.testing.assert_allclose(wrenches[1], wrenches[0], rtol=1e-9)


@pytest.mark.parametrize("time", [0.09, 0.12, 0.2, 0.4])
def test_twist_is_the_derivative_of_the_pose(moving_hand, time):
    h = 1e-5
    before, after, now = (
        moving_hand.intention(time - h),
        moving_hand.intention(time + h),
        moving_hand.intention(time),
    )
    rate = np.concatenate([after[1] - before[1], rotation_between(after[0], before[0])]) / (2 * h)
    np.testing.assert_allclose(rate, now[2], rtol=0, atol=1e-5)
    faster = (after[2] - before[2])[:3] / (2 * h)
    np.testing.assert_allclose(faster, now[3], rtol=1e-5, atol=1e-5)
