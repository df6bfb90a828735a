"""Joint position control of the slave."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.systems.framework import DiagramBuilder

from drake_teleop.station.slave.arm import inverse_dynamics
from drake_teleop.station.slave.joint_control import (
    JointControl,
    JointControlConfig,
    computed_torque_into,
)
from drake_teleop.station.slave.plant import AddSlavePlant
from drake_teleop.station.slave.slave_config import Slave


@pytest.fixture(scope="module")
def arm():
    return AddSlavePlant(DiagramBuilder(), Slave(), None).arm


def torque(arm, command, q, v):
    config, out = JointControlConfig(), np.zeros(6)
    computed_torque_into(
        arm.table,
        np.asarray(command, float),
        np.concatenate([q, v]),
        2 * np.pi * config.position_bandwidth_hz,
        2 * np.pi * config.velocity_bandwidth_hz,
        arm.velocity_limit,
        arm.effort_limit,
        np.zeros(18),
        out,
    )
    return out


def test_torque_at_setpoint_compensates_gravity(arm):
    q = np.array([0.3, -0.5, -1.5, 0.2, -0.9, 1.0])
    gravity = np.zeros(6)
    inverse_dynamics(arm.table, q, np.zeros(6), np.zeros(6), gravity)
    np.testing.assert_allclose(torque(arm, q, q, np.zeros(6)), gravity, rtol=1e-12)


@pytest.mark.parametrize("bad", [np.nan, 1e9])
def test_torque_with_invalid_encoders_or_command(arm, bad):
    q = np.array([0.3, -0.5, -1.5, 0.2, -0.9, 1.0])
    one = np.where(np.arange(6) == 2, bad, 0.0)
    gravity = torque(arm, q, q, np.zeros(6))
    np.testing.assert_array_equal(torque(arm, q, q + one, np.ones(6)), gravity)
    np.testing.assert_array_equal(torque(arm, q, q + 0.1, one), gravity)
    np.testing.assert_array_equal(torque(arm, q + one, q, np.zeros(6)), 0.0)  # previous content


def test_joints_are_decoupled(arm):
    """Computed torque: the error of one joint accelerates this joint only."""
    q, error = np.array([0.3, -0.5, -1.5, 0.2, -0.9, 1.0]), np.zeros(6)
    error[1] = 0.001
    wanted = np.zeros(6)
    wanted[1] = (2 * np.pi) ** 2 * 12.0 * 70.0 * 0.001
    expected = np.zeros(6)
    inverse_dynamics(arm.table, q, np.zeros(6), wanted, expected)
    np.testing.assert_allclose(torque(arm, q + error, q, np.zeros(6)), expected, rtol=1e-12)


def test_torque_stays_within_motor_limits(arm):
    q = np.array([0.3, -0.5, -1.5, 0.2, -0.9, 1.0])
    far = torque(arm, q + 3.0, q, np.zeros(6))
    assert (np.abs(far) <= arm.effort_limit).all()


@pytest.mark.parametrize("way", [1.0, -1.0])
@pytest.mark.parametrize("share", [0.999, 1.0, 1.001])
def test_joint_does_not_accelerate_beyond_speed_limit(arm, way, share):
    """The joint brakes beyond the limit for any setpoint; the block equals the formula."""
    q, config = np.array([0.3, -0.5, -1.5, 0.2, -0.9, 1.0]), JointControlConfig()
    limit = way * arm.velocity_limit
    braking = 2 * np.pi * config.velocity_bandwidth_hz * (1.0 - share) * limit
    expected = np.zeros(6)
    inverse_dynamics(arm.table, q, share * limit, braking, expected)
    assert (np.abs(expected) < arm.effort_limit).all()
    block = JointControl(arm, config, 1e-3, q)
    context = block.CreateDefaultContext()
    block.GetInputPort("joint_command").FixValue(context, q + 3.0 * way)
    block.GetInputPort("slave_state").FixValue(context, np.concatenate([q, share * limit]))
    updated = block.EvalUniquePeriodicDiscreteUpdate(context)
    np.testing.assert_allclose(updated.get_value(), expected, rtol=1e-9, atol=1e-9)
