"""Joint position control of the slave."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.systems.framework import DiagramBuilder

from drake_teleop.slave.arm import inverse_dynamics
from drake_teleop.slave.joint_control import JointControlConfig, joint_control_torque
from drake_teleop.slave.plant import AddSlavePlant


@pytest.fixture(scope="module")
def arm():
    return AddSlavePlant(DiagramBuilder(), [0.55, 0.0, 0.45], None).arm


def torque(arm, command, q, v):
    config, out = JointControlConfig(), np.zeros(6)
    joint_control_torque(
        arm.table,
        np.asarray(command, float),
        np.asarray(q, float),
        np.asarray(v, float),
        2 * np.pi * config.position_bandwidth_hz,
        2 * np.pi * config.velocity_bandwidth_hz,
        arm.velocity_limit,
        arm.effort_limit,
        np.zeros(6),
        out,
    )
    return out


def test_at_the_setpoint_it_holds_the_arm_against_gravity(arm):
    q = np.array([0.3, -0.5, -1.5, 0.2, -0.9, 1.0])
    gravity = np.zeros(6)
    inverse_dynamics(arm.table, q, np.zeros(6), np.zeros(6), gravity)
    np.testing.assert_allclose(torque(arm, q, q, np.zeros(6)), gravity, rtol=1e-12)


def test_the_joints_do_not_disturb_each_other(arm):
    """Computed torque: an error of one joint accelerates that joint alone."""
    q, error = np.array([0.3, -0.5, -1.5, 0.2, -0.9, 1.0]), np.zeros(6)
    error[1] = 0.001
    wanted = np.zeros(6)
    wanted[1] = (2 * np.pi) ** 2 * 12.0 * 70.0 * 0.001
    expected = np.zeros(6)
    inverse_dynamics(arm.table, q, np.zeros(6), wanted, expected)
    np.testing.assert_allclose(torque(arm, q + error, q, np.zeros(6)), expected, rtol=1e-12)


def test_speed_and_torque_stay_within_the_motors_limits(arm):
    q = np.array([0.3, -0.5, -1.5, 0.2, -0.9, 1.0])
    far = torque(arm, q + 3.0, q, np.zeros(6))
    assert (np.abs(far) <= arm.effort_limit).all()
    # At its speed limit a joint is not accelerated any more, however far away the setpoint is.
    at_limit = np.zeros(6)
    inverse_dynamics(arm.table, q, arm.velocity_limit * 0.2, np.zeros(6), at_limit)
    slow = torque(arm, q + arm.velocity_limit * 0.2 / (2 * np.pi * 12), q, arm.velocity_limit * 0.2)
    np.testing.assert_allclose(slow, at_limit, rtol=1e-9, atol=1e-9)
