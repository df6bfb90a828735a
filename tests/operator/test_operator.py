"""Intent and hand impedance of the operator."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np
import phantom_arrays as arrays
import pytest
from operator_motion import intent_at
from pydrake.common.eigen_geometry import Quaternion
from pydrake.common.yaml import yaml_load_typed
from pydrake.math import RotationMatrix
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.station.master import device, phantom
from drake_teleop.station.master.data_sheets import Master, PhantomJointFriction
from drake_teleop.station.master.force_display import ForceDisplay
from drake_teleop.station.operator.operator import (
    GRIP_IMPEDANCES,
    MinimumJerk,
    Operator,
    OperatorConfig,
    Sine,
    hand_wrench_into,
)
from drake_teleop.station.scenario import Scenario

START = arrays.forward_kinematics(phantom.HOME_POSTURE_RAD)
SEGMENTS = [
    MinimumJerk(t_start=0.1, duration=0.5, translation=[0.01, 0.02, -0.03], rotation=[0.3, 0, 0.2]),
    Sine(
        t_start=0.2,
        duration=0.9,
        ramp=0.25,
        frequency=2.6,
        phase=0.4,
        translation=[0.0, 0.0, 0.05],
        rotation=[0.0, 0.4, 0.1],
    ),
    MinimumJerk(t_start=0.5, duration=0.6, rotation=[0.0, -0.5, 0.0]),
]


def rotation(pose) -> np.ndarray:
    return RotationMatrix(Quaternion(pose[:4] / np.linalg.norm(pose[:4]))).matrix()


def rotation_matrix(*vector) -> np.ndarray:
    angle = np.linalg.norm(vector)
    axis = np.array(vector) / angle
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def hand_wrench(impedance, wanted, wanted_twist, pose, twist) -> np.ndarray:
    wrench = np.empty(6)
    hand_wrench_into(np.array(impedance), wanted, wanted_twist, pose, twist, wrench)
    return wrench


def test_twist_is_the_derivative_of_the_intended_pose():
    times, step = np.linspace(0, 1.3, 301), 1e-5
    _, twists = intent_at(SEGMENTS, START, times)
    ahead, _ = intent_at(SEGMENTS, START, times + step)
    behind, _ = intent_at(SEGMENTS, START, times - step)
    velocity = (ahead[:, 4:] - behind[:, 4:]) / (2 * step)
    np.testing.assert_allclose(twists[:, :3], velocity, atol=1e-7)
    for a, b, twist in zip(ahead, behind, twists, strict=True):
        difference = rotation(a) @ rotation(b).T
        spin = (difference - difference.T) / (4 * step)
        angular = [spin[2, 1], spin[0, 2], spin[1, 0]]
        np.testing.assert_allclose(twist[3:], angular, atol=1e-7)
    assert np.max(np.abs(twists), axis=0).min() > 0.03


def test_intent_is_smooth_to_the_second_derivative():
    step = 1e-5
    _, twists = intent_at(SEGMENTS, START, np.arange(0, 1.3, step))
    acceleration = np.diff(twists, axis=0) / step
    # A jump of the acceleration would not shrink with the step.
    assert np.abs(np.diff(acceleration, axis=0)).max() < 0.1
    assert np.abs(acceleration[:, :3]).max() > 5
    np.testing.assert_allclose(acceleration[0], 0, atol=1e-9)


def test_segments_start_from_rest_and_are_added():
    (first, last), twists = intent_at(SEGMENTS, START, [0.0, 2.0])
    np.testing.assert_array_equal(first, START)
    np.testing.assert_array_equal(twists, 0)
    np.testing.assert_allclose(last[4:], START[4:] + np.array([0.01, 0.02, -0.03]), atol=1e-15)
    expected = rotation_matrix(0.0, -0.5, 0.0) @ rotation_matrix(0.3, 0.0, 0.2)
    np.testing.assert_allclose(rotation(last), expected, atol=1e-14)


def test_minimum_jerk_peaks_at_fifteen_eighths_of_the_mean_speed():
    move = [MinimumJerk(duration=0.4, translation=[0.1, 0, 0])]
    poses, twists = intent_at(move, START, [0.2])
    assert poses[0, 4] - START[4] == pytest.approx(0.05)
    assert twists[0, 0] == pytest.approx(15 / 8 * 0.1 / 0.4)


def test_second_sine_makes_every_other_minimum_deeper():
    """Contact experiment: the tip touches at 220 ms, but not one oscillation later."""
    main = Sine(t_start=0.0, duration=5.0, frequency=1 / 0.38, translation=[0, 0, 0.06])
    main.phase = -np.pi / 2 - 2 * np.pi * main.frequency * 0.22
    main.phase %= 2 * np.pi
    slow = Sine(t_start=0.0, duration=5.0, frequency=0.5 / 0.38, translation=[0, 0, 0.01])
    slow.phase = (-np.pi / 2 - 2 * np.pi * slow.frequency * 0.22) % (2 * np.pi)
    times = np.linspace(0.15, 0.7, 1101)
    height = intent_at([main, slow], START, times)[0][:, 6]
    bottoms = times[1:-1][(np.diff(height)[:-1] < 0) & (np.diff(height)[1:] > 0)]
    depths = np.interp(bottoms, times, height)
    np.testing.assert_allclose(bottoms, [0.22, 0.6], atol=0.01)
    assert depths[1] - depths[0] == pytest.approx(0.02, abs=1e-3)


def test_hand_pulls_towards_the_intent():
    wanted, pose = START.copy(), START.copy()
    wanted[4:] += [0.01, 0.0, -0.02]
    wrench = hand_wrench(
        [250, 8, 1.5, 0.03], wanted, np.array([0, 0.1, 0, 0, 0, 1.0]), pose, np.zeros(6)
    )
    np.testing.assert_allclose(wrench, [2.5, 0.8, -5.0, 0, 0, 0.03], atol=1e-12)


def test_hand_torque_is_about_the_axis_of_the_error():
    """An error of 0.4 rad about an axis of B gives a torque about this axis."""
    pose = arrays.forward_kinematics(np.array([0.3, 0.2, 0.4, -0.5, 0.6, 0.7]))
    axis = np.array([0.48, -0.6, 0.64])
    wanted = pose.copy()
    error = Quaternion(np.array([np.cos(0.2), *(np.sin(0.2) * axis)]))
    wanted[:4] = (error.multiply(Quaternion(pose[:4] / np.linalg.norm(pose[:4])))).wxyz()
    for sign in (1, -1):
        wanted[:4] *= sign
        wrench = hand_wrench([0, 0, 1.5, 0], wanted, np.zeros(6), pose, np.zeros(6))
        np.testing.assert_allclose(wrench[3:], 1.5 * 0.4 * axis, atol=1e-12)


def test_hand_force_and_torque_are_limited():
    wanted = START.copy()
    wanted[4:] += [3.0, 4.0, 0.0]
    wrench = hand_wrench([700, 20, 3, 0.06], wanted, np.zeros(6), START, np.zeros(6))
    np.testing.assert_allclose(wrench[:3], [36.0, 48.0, 0.0], rtol=1e-12)
    spin = np.array([0, 0, 0, 0, 0, 1e3])
    wrench = hand_wrench([700, 20, 3, 0.06], START, spin, START, np.zeros(6))
    np.testing.assert_allclose(wrench[3:], [0, 0, 2.0], atol=1e-12)


@pytest.mark.parametrize("grip", list(GRIP_IMPEDANCES))
def test_hand_yields_to_the_displayed_force(grip):
    """The hand at rest deflects by F / K."""
    period, force = 5e-4, np.array([0.4, 0.3, -1.0])
    viscous = PhantomJointFriction(coulomb=[0.0] * 6, viscous=[5e-4] * 3 + [5e-5] * 3)
    config = OperatorConfig(grip=grip)
    hand = config.hand
    model = Master(friction=viscous).device(hand.mass, hand.inertia)
    builder = DiagramBuilder()
    operator = builder.AddSystem(Operator(config, START))
    master = builder.AddSystem(device.MasterDevice(period, model, phantom.HOME_POSTURE_RAD))
    display = builder.AddSystem(ForceDisplay(period, model))
    for source, sink, port in (
        (master, operator, "pose_master"),
        (master, operator, "twist_master"),
        (operator, master, "hand_wrench_E"),
        (display, master, "drive"),
        (master, display, "for_display"),
    ):
        builder.Connect(source.GetOutputPort(port), sink.GetInputPort(port))
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    display.GetInputPort("wrench_command").FixValue(
        display.GetMyContextFromRoot(context), [*force, 0.0, 0.0, 0.01]
    )
    simulator.AdvanceTo(4.0)
    pose = master.GetOutputPort("pose_master").Eval(master.GetMyContextFromRoot(context))
    wrench = operator.GetOutputPort("hand_wrench_E").Eval(operator.GetMyContextFromRoot(context))
    np.testing.assert_allclose(wrench, [*-force, 0, 0, -0.01], atol=1e-5)
    np.testing.assert_allclose(pose[4:] - START[4:], force / hand.stiffness, atol=1e-6)
    angle = 2 * np.arcsin(pose[3])
    assert angle == pytest.approx(0.01 / hand.rotational_stiffness, rel=1e-3)


def test_operator_outputs_its_intent():
    operator = Operator(OperatorConfig(intent=SEGMENTS), START)
    context = operator.CreateDefaultContext()
    for time in (0.0, 0.37, 0.81):
        context.SetTime(time)
        expected, _ = intent_at(SEGMENTS, START, time)
        np.testing.assert_array_equal(operator.GetOutputPort("intent").Eval(context), expected[0])


def test_intent_loads_from_yaml():
    text = """
        grip: firm
        intent:
        - !MinimumJerk {duration: 2.0, translation: [0.0, 0.0, 0.1]}
        - !Sine {frequency: 3.0, rotation: [0.0, 0.2, 0.0]}
    """
    config = yaml_load_typed(schema=OperatorConfig, data=text)
    assert config.hand is GRIP_IMPEDANCES["firm"]
    assert config.intent == [
        MinimumJerk(duration=2.0, translation=[0.0, 0.0, 0.1]),
        Sine(frequency=3.0, rotation=[0.0, 0.2, 0.0]),
    ]


def test_ramps_longer_than_the_oscillation_are_an_error():
    segments = [MinimumJerk(), Sine(duration=0.4, ramp=0.2), Sine(duration=0.4, ramp=0.21)]
    with pytest.raises(
        DrakeTeleopError,
        match=r"operator\.intent\[2\]\.ramp: two ramps of 0\.21 s .* 0\.4 s; set it to 0\.2 or",
    ):
        Scenario(operator=OperatorConfig(intent=segments)).check()
    Scenario(operator=OperatorConfig(intent=segments[:2])).check()


def test_grips_in_docs_equal_the_code():
    page = Path(__file__).parents[2] / "docs" / "operator.md"
    text = page.read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(light|medium|firm)` \| (.*) \|$", text, re.MULTILINE)
    numbers = r"\d[\d.]*(?:e-\d)?"
    found = {name: tuple(float(x) for x in re.findall(numbers, row)) for name, row in rows}
    assert found == {name: dataclasses.astuple(hand) for name, hand in GRIP_IMPEDANCES.items()}
