"""Arms with a position interface: lag, dead time, limits and torques."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.station.scenario import Scenario, ScenarioFromData, replace
from drake_teleop.station.slave.arm import forward_dynamics, inverse_dynamics
from drake_teleop.station.slave.joint_control import (
    POSITION_INTERFACE_PRESETS,
    JointControl,
    PositionInterface,
    servo_impedance,
)
from drake_teleop.station.slave.plant import NominalSlave

HOME = np.array([0.3, -0.5, -1.5, 0.2, -0.9, 1.0])
PERIOD = 5e-4
UR = POSITION_INTERFACE_PRESETS["ur_servoj"]


@pytest.fixture(scope="module")
def arm():
    return NominalSlave(Scenario().slave).arm


def follow(arm, interface, command, steps):
    """Return [q; v] (steps, 12) of the arm under the block's torque, and the torque (steps, 6).

    Integrates with semi-implicit steps.
    """
    config = dataclasses.replace(Scenario().joint_control, servo="position", interface=interface)
    block = JointControl(arm, config, PERIOD, HOME)
    context, q, v = block.CreateDefaultContext(), HOME.copy(), np.zeros(6)
    states, torques, vdot = [], [], np.empty(6)
    for k in range(steps):
        block.GetInputPort("joint_command").FixValue(context, command(k * PERIOD))
        block.GetInputPort("slave_state").FixValue(context, np.concatenate([q, v]))
        update = block.EvalUniquePeriodicDiscreteUpdate(context)
        context.get_mutable_discrete_state().SetFrom(update)
        tau = block.GetOutputPort("joint_torque").Eval(context)
        forward_dynamics(arm.table, q, v, tau, np.zeros(6), vdot)
        v = v + PERIOD * vdot
        q = q + PERIOD * v
        states.append(np.concatenate([q, v]))
        torques.append(tau)
    return np.array(states), np.array(torques)


@pytest.mark.slow
def test_lag_is_lookahead_plus_dead_time_plus_half_a_period(arm):
    speed = np.array([0.2, -0.1, 0.15, 0.1, -0.2, 0.3])
    states, _ = follow(arm, UR, lambda t: HOME + speed * t, 2400)
    late = (HOME + speed * 2400 * PERIOD - states[-1, :6]) / speed
    expected = UR.lookahead + UR.dead_time + 0.5 / UR.command_hz
    np.testing.assert_allclose(late, expected, atol=1.5 * PERIOD)


@pytest.mark.slow
def test_step_response_equals_closed_form_after_dead_time(arm):
    """Solution of d2r/dt2 = k (1 - r - lookahead dr/dt), damping ratio 0.87."""
    states, _ = follow(arm, UR, lambda t: HOME + 0.02, 800)
    response = (states[:, 0] - HOME[0]) / 0.02
    assert np.abs(response[: round(UR.dead_time / PERIOD)]).max() < 1e-9
    w = np.sqrt(UR.acceleration_per_error)
    damping = 0.5 * w * UR.lookahead
    turning = w * np.sqrt(1 - damping**2)
    t = (np.arange(800) + 1) * PERIOD - UR.dead_time
    decay = np.exp(-damping * w * t)
    wanted = 1 - decay * (np.cos(turning * t) + damping * w / turning * np.sin(turning * t))
    np.testing.assert_allclose(response[20:], wanted[20:], atol=0.01)


@pytest.mark.parametrize("speeds", [np.full(6, 9.0), np.linspace(0.3, 0.6, 6)])
@pytest.mark.parametrize("accelerations", [np.full(6, 90.0), np.linspace(2.0, 6.0, 6)])
def test_speed_and_acceleration_reach_the_lower_limit(arm, speeds, accelerations):
    """Limits of the interface are 0.5 rad/s and 4 rad/s^2; those of the arm may be lower."""
    slow = dataclasses.replace(UR, max_speed=0.5, max_acceleration=4.0, dead_time=0.0)
    limited = dataclasses.replace(arm, velocity_limit=speeds, acceleration_limit=accelerations)
    states, _ = follow(limited, slow, lambda t: HOME + 0.4, 800)
    fastest, speed = np.minimum(speeds, 0.5), states[:, 6:]
    np.testing.assert_array_less(0.98 * fastest, speed.max(axis=0))
    np.testing.assert_array_less(speed.max(axis=0), fastest * (1 + 1e-6))
    largest = np.abs(np.diff(speed, axis=0)).max(axis=0) / PERIOD
    limit = np.minimum(accelerations, 4.0)
    np.testing.assert_array_less(0.98 * limit, largest)
    np.testing.assert_array_less(largest, limit * (1 + 1e-6))


def test_distant_target_is_reached_without_overshoot(arm):
    """A linear law would overshoot with a fast interface of weak motors."""
    franka = POSITION_INTERFACE_PRESETS["franka_position"]
    states, _ = follow(arm, franka, lambda t: HOME + 0.3, 1600)
    moved = states[:, :6] - HOME
    assert np.abs(moved[-1] - 0.3).max() < 1e-4
    assert moved.max() < 0.3 + 2e-3


def test_torque_is_inverse_dynamics_of_generated_motion(arm):
    """The torque is the inverse dynamics of the generated motion."""
    states, torques = follow(arm, UR, lambda t: HOME + 0.1, 60)
    q, v = np.split(states[40], 2)
    vdot, expected = (states[41, 6:] - v) / PERIOD, np.empty(6)
    inverse_dynamics(arm.table, q, v, vdot, expected)
    np.testing.assert_allclose(torques[41], expected, atol=1e-8)


@pytest.mark.parametrize("bad", [np.nan, 1e9])
def test_torque_with_invalid_command_or_encoders(arm, bad):
    held, _ = follow(arm, UR, lambda t: HOME if t < 0.01 else np.full(6, bad), 60)
    np.testing.assert_allclose(held[-1, :6], HOME, atol=1e-6)
    config = dataclasses.replace(Scenario().joint_control, servo="ur_servoj")
    block = JointControl(arm, config, PERIOD, HOME)
    context, weight = block.CreateDefaultContext(), np.empty(6)
    block.GetInputPort("joint_command").FixValue(context, HOME)
    block.GetInputPort("slave_state").FixValue(context, np.full(12, bad))
    update = block.EvalUniquePeriodicDiscreteUpdate(context)
    inverse_dynamics(arm.table, HOME, np.zeros(6), np.zeros(6), weight)
    np.testing.assert_array_equal(update.get_value(0), weight)


@pytest.mark.parametrize("dead_time", [0.0, 0.002, 0.02])
@pytest.mark.parametrize("bad", [np.nan, 1e9])
def test_invalid_commands_are_replaced_by_the_last_one(arm, dead_time, bad):
    interface, ends = dataclasses.replace(UR, dead_time=dead_time), (0.02, 0.05)

    def command(t, invalid):
        is_lost = ends[0] <= t < ends[1]
        last = HOME + 0.5 * min(t, ends[0] - 1 / UR.command_hz)
        return np.full(6, invalid) if is_lost else last if t < ends[1] else HOME

    def held(t):
        return command(min(t, ends[0] - PERIOD) if t < ends[1] else t, bad)

    states, torques = follow(arm, interface, lambda t: command(t, bad), 160)
    expected = follow(arm, interface, held, 160)
    assert np.abs(states[:, :6] - HOME).max() > 1e-3
    np.testing.assert_array_equal(states, expected[0])
    np.testing.assert_array_equal(torques, expected[1])


@pytest.mark.parametrize(
    ("changes", "where"),
    [
        ({"command_hz": 300.0}, "command_hz"),
        ({"acceleration_per_error": 1e7, "lookahead": 0.1}, "acceleration_per_error"),
        ({"drive_bandwidth_hz": 500.0}, "drive_bandwidth_hz"),
    ],
)
def test_invalid_interface_raises_one_error(changes, where):
    interface = dataclasses.replace(PositionInterface(), **changes)
    scenario = replace(
        Scenario(), joint_control__servo="position", joint_control__interface=interface
    )
    with pytest.raises(DrakeTeleopError, match=re.escape(f"joint_control.interface.{where}")):
        scenario.check()


def test_another_servo_has_its_own_interface():
    named = ScenarioFromData({"joint_control": {"servo": "franka_position"}}, "x")
    other = replace(named, joint_control__servo="ur_servoj").joint_control
    assert other.position_interface == POSITION_INTERFACE_PRESETS["ur_servoj"]


def test_scenario_overrides_single_interface_fields():
    data = {"joint_control": {"servo": "franka_position", "interface": {"dead_time": 0.01}}}
    found = ScenarioFromData(data, "x").joint_control.position_interface
    assert found == dataclasses.replace(
        POSITION_INTERFACE_PRESETS["franka_position"], dead_time=0.01
    )
    scenario = replace(Scenario(), joint_control__interface=UR)
    with pytest.raises(DrakeTeleopError, match="remove this field"):
        scenario.check()


def test_servo_at_tool_rejects_position_servo(arm):
    config = dataclasses.replace(Scenario().joint_control, servo="ur_servoj")
    with pytest.raises(DrakeTeleopError, match="choose computed_torque"):
        servo_impedance(arm, HOME, config)
