"""J_M^T, the device's limits, the safe state."""

from __future__ import annotations

import numpy as np
import pytest

from drake_teleop.master import phantom
from drake_teleop.master.force_display import ForceDisplay

POSTURES = [
    np.zeros(6),
    np.array([0.4, 0.3, 0.5, -0.6, 0.7, 0.8]),
    np.array([-0.7, -0.2, 0.1, 1.2, -1.1, -2.0]),
]


def display(wrench, q, v=(0,) * 6) -> tuple[np.ndarray, np.ndarray]:
    """The block's outputs (motor torque, displayed wrench)."""
    block = ForceDisplay()
    context = block.CreateDefaultContext()
    block.GetInputPort("wrench_command").FixValue(context, np.asarray(wrench, dtype=float))
    block.GetInputPort("master_state").FixValue(context, np.array([*q, *v], dtype=float))
    return (
        block.GetOutputPort("motor_torque").Eval(context).copy(),
        block.GetOutputPort("force_to_master").Eval(context).copy(),
    )


@pytest.mark.parametrize("q", POSTURES)
def test_torque_does_the_virtual_work_of_the_wrench(q):
    """delta W = F . delta x for small displacements, delta x from the forward kinematics."""
    wrench = np.array([3.0, -2.0, 5.0, 0.05, -0.02, 0.03])
    torque, displayed = display(wrench, q)
    np.testing.assert_array_equal(displayed, wrench)
    step = 1e-6
    for k in range(6):
        ahead = phantom.forward_kinematics(q + step * np.eye(6)[k])
        behind = phantom.forward_kinematics(q - step * np.eye(6)[k])
        translation = (ahead[4:] - behind[4:]) / (2 * step)
        # Small rotation in B from the quaternions: 2 dq q*.
        w, x = ahead[0], ahead[1:4]
        w0, x0 = behind[0], -behind[1:4]
        rotation = 2 * (w * x0 + w0 * x + np.cross(x, x0)) / (2 * step)
        work = wrench[:3] @ translation + wrench[3:] @ rotation
        assert torque[k] - phantom.gravity_torque(q)[k] == pytest.approx(work, abs=1e-8)


@pytest.mark.parametrize("q", POSTURES)
def test_no_command_leaves_the_gravity_compensation(q):
    torque, displayed = display(np.zeros(6), q)
    np.testing.assert_allclose(torque, phantom.gravity_torque(q), atol=1e-15)
    np.testing.assert_array_equal(displayed, 0)


@pytest.mark.parametrize("q", POSTURES)
def test_limits_keep_the_direction(q):
    wrench = np.array([300.0, -200.0, 500.0, 5.0, -2.0, 3.0])
    torque, displayed = display(wrench, q)
    assert np.linalg.norm(displayed[:3]) == pytest.approx(37.5, rel=1e-12)
    np.testing.assert_allclose(np.cross(displayed[:3], wrench[:3]), 0, atol=1e-10)
    np.testing.assert_allclose(np.cross(displayed[3:], wrench[3:]), 0, atol=1e-14)
    assert displayed[:3] @ wrench[:3] > 0
    assert displayed[3:] @ wrench[3:] > 0
    share = np.abs(torque[3:]) / [0.515, 0.515, 0.170]
    assert share.max() == pytest.approx(1.0, rel=1e-12)
    np.testing.assert_allclose(
        torque, phantom.jacobian(q).T @ displayed + phantom.gravity_torque(q), atol=1e-12
    )


def test_force_and_torque_are_limited_apart():
    _, displayed = display([0, 0, 100.0, 0.01, 0, 0], phantom.HOME)
    np.testing.assert_allclose(displayed, [0, 0, 37.5, 0.01, 0, 0], rtol=1e-12)
    _, displayed = display([0, 0, 10.0, 0.34, 0.1, 0], phantom.HOME)
    np.testing.assert_allclose(displayed, [0, 0, 10.0, 0.17, 0.05, 0], rtol=1e-12)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("index", range(6))
def test_a_command_that_is_not_finite_displays_nothing(bad, index):
    wrench = np.ones(6)
    wrench[index] = bad
    torque, displayed = display(wrench, POSTURES[1])
    np.testing.assert_array_equal(displayed, 0)
    np.testing.assert_allclose(torque, phantom.gravity_torque(POSTURES[1]), atol=1e-15)


def test_a_huge_command_is_limited_too():
    _, displayed = display([1e308, 1e308, 0, 0, 0, 1e308], phantom.HOME)
    assert np.linalg.norm(displayed[:3]) == pytest.approx(37.5)
    assert displayed[5] == pytest.approx(0.515)


def test_a_state_that_is_not_finite_switches_the_motors_off():
    torque, displayed = display(np.ones(6), [0, np.nan, 0, 0, 0, 0])
    np.testing.assert_array_equal(torque, 0)
    np.testing.assert_array_equal(displayed, 0)
