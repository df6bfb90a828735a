"""Continuous joints: limits, commands over four rotations, start, excitation, summary."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from odd_arms import rx90_plant
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.vectors import quaternion_product
from drake_teleop.lab.excitation.check import check_trajectory
from drake_teleop.lab.excitation.excite import excite
from drake_teleop.lab.excitation.robot import RobotFromModel
from drake_teleop.lab.run import run_scenario, summarise
from drake_teleop.live.cockpit import PageValueCalculator
from drake_teleop.live.inputs import Inputs
from drake_teleop.station.master.leader_model import Leader
from drake_teleop.station.scenario import LoadScenario
from drake_teleop.station.sensor.sensor_chain import WristSensorConfig
from drake_teleop.station.slave.arm import pose_into
from drake_teleop.station.slave.arm_from_plant import ArmModelFromPlant, fill_missing_joint_limits
from drake_teleop.station.slave.home import solve_start_posture
from drake_teleop.station.slave.inverse_kinematics import IkStatus, InverseKinematics
from drake_teleop.station.slave.joint_commands import JointRangeMonitor, LeaderJointFollower
from drake_teleop.station.slave.numeric_inverse_kinematics import (
    NumericInverseKinematics,
    find_posture,
)

pytestmark = pytest.mark.slow

#: Axis, height [m] and limits [rad] of each joint; without limits it is continuous.
SIX = ("z 0.3 -2.9 2.9", "y 0.1 -2 2", "y 0.4 -2.6 2.6", "z 0.2 -3 3", "y 0.2 -2.1 2.1", "z 0.1")
SEVEN = ("z 0.16", "y 0.13 -2.2 2.2", "z 0.2", "y 0.2 -2.5 2.5", "z 0.2", "y 0.1 -2 2", "z 0.1")
POSTURES = {SIX: [0.3, 0.6, 1.2, 0.2, 1.0, 0.4], SEVEN: [0.3, 0.6, 0.4, 1.4, 0.3, 1.0, 0.4]}
#: Period of the commands [s], rate of the tool [rad/s], angle of four rotations.
PERIOD, RATE, TURNS = 1e-3, 2.0, 8 * np.pi
AXES = {"y": "0 1 0", "z": "0 0 1"}


def inertial(mass):
    return (
        f'<inertial><origin xyz="0 0 0.05"/><mass value="{mass}"/><inertia ixx="{0.02 * mass}"'
        f' iyy="{0.02 * mass}" izz="{0.01 * mass}" ixy="0" ixz="0" iyz="0"/></inertial>'
    )


def urdf(chain):
    parts = ['<robot name="arm"><link name="l0"/>']
    for k, description in enumerate(chain, start=1):
        axis, height, *limits = description.split()
        ends = 'lower="{}" upper="{}"'.format(*limits) if limits else ""
        parts.append(
            f'<link name="l{k}">{inertial(5 - 0.5 * k)}</link>'
            f'<joint name="j{k}" type="{"revolute" if limits else "continuous"}">'
            f'<parent link="l{k - 1}"/><child link="l{k}"/><origin xyz="0 0 {height}"/>'
            f'<axis xyz="{AXES[axis]}"/><limit {ends} velocity="3" effort="150"/></joint>'
        )
    parts.append(
        f'<link name="ft">{inertial(0.8)}</link><joint name="to_ft" type="fixed">'
        f'<parent link="l{len(chain)}"/><child link="ft"/><origin xyz="0 0 0.05"/></joint></robot>'
    )
    return "".join(parts)


def arm_of(text):
    plant = MultibodyPlant(0.0)
    (instance,) = Parser(plant).AddModelsFromString(text, "urdf")
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("l0"))
    plant.Finalize()
    return fill_missing_joint_limits(ArmModelFromPlant(plant, instance, "ft"), "arm")


ARMS = {chain: arm_of(urdf(chain))[0] for chain in POSTURES}


def pose_of(arm, q):
    pose = np.empty(7)
    pose_into(arm.table, np.array(q, dtype=float), pose)
    return pose


def turned_tool(pose, angle):
    """Return the pose rotated about z_S."""
    turn = (np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2))
    return np.append(quaternion_product(tuple(pose[:4]), turn), pose[4:])


def turned_base(pose, angle):
    """Return the pose rotated about z_W."""
    turn, c, s = (np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)), np.cos(angle), np.sin(angle)
    x, y, z = pose[4:]
    return np.append(quaternion_product(turn, tuple(pose[:4])), [c * x - s * y, s * x + c * y, z])


def pose_error(a, b):
    """Return the largest error [m, quaternion]; q and -q are one rotation."""
    return max(1 - abs(a[:4] @ b[:4]), np.abs(a[4:] - b[4:]).max())


def commands_of_four_turns(system, arm, start, sign, turned=turned_tool):
    """Return the joint commands while the tool rotates, and 2 s later, and the largest error."""
    context, pose, error = system.CreateDefaultContext(), pose_of(arm, start), 0.0
    command, status = (system.GetOutputPort(name) for name in ("joint_command", "ik_status"))
    q = np.array(start)
    commands = [q]
    for k in range(1, round((TURNS / RATE + 2.0) / PERIOD)):
        wanted = turned(pose, sign * min(RATE * PERIOD * k, TURNS))
        context.SetTime(k * PERIOD)
        system.GetInputPort("joint_position").FixValue(context, q)
        system.GetInputPort("pose_command").FixValue(context, wanted)
        q = command.Eval(context).copy()
        assert status.Eval(context)[0] == IkStatus.OK
        commands.append(q)
        error = max(error, pose_error(wanted, pose_of(arm, q)))
        if context.num_discrete_state_groups():
            context.SetDiscreteState(system.EvalUniquePeriodicDiscreteUpdate(context))
    return np.array(commands), error


@pytest.mark.quick_cases(1)
@pytest.mark.parametrize(("chain", "sign"), [(SEVEN, -1), (SIX, 1)])
def test_four_turns_of_the_tool_are_followed_without_a_jump(chain, sign):
    """Only the last joint rotates, also for a redundant arm."""
    arm, start = ARMS[chain], POSTURES[chain]
    system = NumericInverseKinematics(arm, start, PERIOD)
    q, error = commands_of_four_turns(system, arm, start, sign)
    assert error < 1e-7
    assert np.abs(np.diff(q, axis=0)).max() < 1.01 * RATE * PERIOD
    np.testing.assert_allclose(q[-1] - q[0], sign * TURNS * np.eye(len(start))[-1], atol=1e-6)
    np.testing.assert_allclose(q[:, :-1], q[:1, :-1].repeat(len(q), axis=0), atol=1e-6)


def test_redundant_arm_approaches_the_nearest_turn_of_its_posture():
    """The posture does not rotate joint 1 back while the arm rotates about its base."""
    arm, start = ARMS[SEVEN], POSTURES[SEVEN]
    system = NumericInverseKinematics(arm, start, PERIOD)
    q, error = commands_of_four_turns(system, arm, start, 1, turned_base)
    assert error < 1e-7
    assert np.abs(np.diff(q, axis=0)).max() < 1.5 * RATE * PERIOD
    np.testing.assert_allclose((q[-1] - q[0])[0], TURNS, atol=0.2)
    assert np.ptp(q[:, 1:], axis=0).max() < 1.0


def test_closed_form_follows_four_turns_of_an_endless_last_joint():
    arm = ArmModelFromPlant(*rx90_plant())
    endless = np.array([0.0, 0.0, 0.0, 0.0, 0.0, np.inf])
    lower, upper = arm.lower - endless, arm.upper + endless
    start = [0.2, -0.5, -1.6, 0.7, 0.8, 0.4]
    q, error = commands_of_four_turns(InverseKinematics(lower, upper), arm, start, 1)
    assert error < 1e-9
    np.testing.assert_allclose(q[-1] - q[0], [0, 0, 0, 0, 0, TURNS], atol=1e-9)
    assert np.abs(np.diff(q, axis=0)).max() < 1.01 * RATE * PERIOD


@given(
    chain=st.sampled_from([SIX, SEVEN]),
    shares=st.lists(st.floats(-0.9, 0.9), min_size=7, max_size=7),
    turns=st.lists(st.integers(-5, 5), min_size=7, max_size=7),
)
def test_search_takes_the_turn_nearest_to_the_reference(chain, shares, turns):
    arm = ARMS[chain]
    n, endless = arm.num_joints, np.isinf(arm.upper)
    half = np.where(endless, np.pi, (arm.upper - arm.lower) / 2)
    pose = pose_of(arm, arm.middle_positions + half * shares[:n])
    reference = np.where(endless, 2 * np.pi * np.array(turns[:n]), arm.middle_positions)
    q, status = find_posture(arm, pose, reference)
    assert status == IkStatus.OK
    assert pose_error(pose, pose_of(arm, q)) < 1e-7
    assert np.all((arm.lower <= q) & (q <= arm.upper))
    assert np.all(np.abs(q - reference)[endless] <= np.pi + 1e-9)


LIMIT = 'lower="-2.2" upper="2.2"'


@pytest.mark.parametrize(
    ("kind", "limit", "expected", "words"),
    [
        ("revolute", 'lower="-1.5" upper="2"', (-1.5, 2.0), ""),
        ("revolute", "", (-np.inf, np.inf), "unlimited rotation for"),
        ("revolute", 'lower="0" upper="0"', (-np.inf, np.inf), "unlimited rotation for"),
        ("revolute", 'lower="-1e16" upper="1e16"', (-np.inf, np.inf), "unlimited rotation for"),
        ("revolute", 'lower="-1e3" upper="1e3"', (-1e3, 1e3), "limits in rad, though"),
        ("revolute", 'lower="-1"', (-1.0, 2 * np.pi - 1), "360 degrees from the only"),
        ("revolute", 'upper="1"', (1 - 2 * np.pi, 1.0), "360 degrees from the only"),
        ("continuous", "", (-np.inf, np.inf), "unlimited rotation for"),
        ("prismatic", "", (-1.0, 1.0), "a range of +-1 m for j2"),
        ("prismatic", 'lower="0" upper="0"', (-1.0, 1.0), "a range of +-1 m for j2"),
        ("prismatic", 'lower="0.2"', (0.2, 2.2), "a range of 2 m"),
    ],
)
def test_limits_of_a_joint_are_read_or_assumed(kind, limit, expected, words):
    text = urdf(SEVEN).replace('"j2" type="revolute"', f'"j2" type="{kind}"')
    arm, assumed = arm_of(text.replace(LIMIT, limit, 1))
    assert (arm.lower[1], arm.upper[1]) == pytest.approx(expected)
    assert any(words in each and "j2" in each for each in assumed) == bool(words)
    assert np.isfinite(arm.middle_positions).all()
    assert arm.lower[1] <= arm.middle_positions[1] <= arm.upper[1]
    np.testing.assert_array_equal(arm.upper[[0, 2, 4, 6]], np.inf)


@pytest.mark.parametrize(
    ("joint", "value", "passes"),
    [(0, 40.0, True), (6, -1e3, True), (1, 2.24, True), (1, 2.3, False), (0, np.nan, False),
     (2, np.inf, False), (4, -np.inf, False)],
)  # fmt: skip
def test_monitor_accepts_any_finite_angle_of_an_endless_joint(joint, value, passes):
    system = JointRangeMonitor(ARMS[SEVEN], 0.01)
    context = system.CreateDefaultContext()
    state = np.zeros(14)
    state[joint] = value
    system.GetInputPort("slave_state").FixValue(context, state)
    if passes:
        system.EvalUniquePeriodicDiscreteUpdate(context)
    else:
        with pytest.raises(DrakeTeleopError, match=f"joint {joint + 1} of the slave left"):
            system.EvalUniquePeriodicDiscreteUpdate(context)


def test_endless_joints_follow_a_leader_over_many_turns():
    arm = ARMS[SEVEN]
    system = LeaderJointFollower(arm, np.full(7, 30.0) * np.isinf(arm.upper), 1.0)
    context = system.CreateDefaultContext()
    system.GetInputPort("leader_joints").FixValue(context, np.full(7, 32.0))
    np.testing.assert_allclose(
        system.GetOutputPort("joint_command").Eval(context), [32, 2.2, 32, 2.5, 32, 2, 32]
    )


@pytest.mark.parametrize("chain", [SIX, SEVEN])
@pytest.mark.parametrize("position", [[0.4, 0.1, 0.3], [0.3, -0.3, 0.5]])
def test_tool_down_is_found_with_endless_joints(chain, position):
    arm = ARMS[chain]
    q, status = solve_start_posture(arm, np.array(position))
    assert status == IkStatus.OK
    assert pose_error(pose_of(arm, q), np.array([0, 1, 0, 0, *position])) < 1e-7
    assert np.all(np.abs(q) <= np.pi)


@pytest.mark.parametrize("chain", [SIX, SEVEN, tuple(each[:6] for each in SIX)])
def test_excitation_of_endless_joints_is_within_speed_limits(tmp_path, chain):
    path = tmp_path / "arm.urdf"
    path.write_text(urdf(chain))
    robot = RobotFromModel(path, "ft", WristSensorConfig())
    found = excite(robot, period=3.0, harmonics=2, starts=1, progress=False)
    q, qd, _ = found.trajectory.evaluate(np.linspace(0, 3, 301))
    assert np.isfinite(q).all()
    assert np.abs(q).max() < 3 * np.pi
    assert 0.1 < (np.abs(qd).max(axis=0) / robot.arm.velocity_limit).max() <= 1.0
    uses = {use.limit_name: use for use in check_trajectory(robot, found.trajectory)}
    assert ("position" in uses) == np.isfinite(robot.arm.upper).any()
    assert all(0.0 <= use.used_share <= 1.0 for use in uses.values())


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_leader_has_no_stops_at_endless_joints(tmp_path):
    path = tmp_path / "leader.urdf"
    path.write_text(urdf(SEVEN))
    device = Leader(file=str(path), hand_frame="ft").device([0.0, 0.0, 0.0], 0.1, 0.001)
    np.testing.assert_array_equal(device.home, np.zeros(7))
    q = np.where(np.isinf(ARMS[SEVEN].upper), 50.0, 0.1)
    device.check_limits(q)
    assert not device.flag_samples_at_end_stop(q[np.newaxis]).any()
    q[1] = 2.3
    assert device.flag_samples_at_end_stop(q[np.newaxis]).all()


@pytest.mark.slow
def test_summary_of_a_run_and_frame_of_a_page_are_plain_json(tmp_path):
    (tmp_path / "arm.urdf").write_text(urdf(SEVEN))
    scenario = tmp_path / "station.yaml"
    scenario.write_text(
        "simulation: {duration: 0.05, settle: 0.02}\nload_estimator: {enabled: true}\n"
        "operator: {intent: [!Sine {duration: 9, frequency: 3, translation: [0.01, 0, 0]}]}\n"
        f"slave: {{model: arm.urdf, sensor_frame: ft, home: {POSTURES[SEVEN]}}}\n"
    )
    setup = LoadScenario(scenario)
    run = run_scenario(setup, progress=False)
    summary = summarise(run)
    json.dumps(summary, allow_nan=False)
    assert "unlimited rotation for j1, j3, j5, j7" in summary["assumed"]
    rows = {name: run.result[name] for name in run.result.signals} | {"t": run.result.t}
    json.dumps(
        PageValueCalculator(setup).page_values(rows, Inputs.from_scenario(setup)), allow_nan=False
    )


def test_one_finite_limit_keeps_the_middle_finite():
    arm = dataclasses.replace(ARMS[SIX], lower=np.full(6, 1.0), upper=np.full(6, np.inf))
    np.testing.assert_array_equal(arm.middle_positions, np.ones(6))
