"""Scaling of translations and orientations, the clutch, and the mapping of wrenches back."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RollPitchYaw, RotationMatrix
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem

from drake_teleop.station.scaling.kinematic_scaling import (
    KinematicScaling,
    KinematicScalingConfig,
    scale_pose_into,
    scaled_rotation,
)

IDENTITY = np.array([1.0, 0, 0, 0, 0, 0, 0])
coordinates = st.floats(-1, 1)
vectors = st.tuples(coordinates, coordinates, coordinates).map(np.array)
#: Rotations by less than 180 degrees, as rotation vectors.
rotation_vectors = vectors.map(lambda v: 1.7 * v).filter(lambda v: np.linalg.norm(v) < 3.1)


def quaternion(vector) -> np.ndarray:
    angle = np.linalg.norm(vector)
    scale = np.sinc(angle / (2 * np.pi)) / 2
    return np.array([np.cos(angle / 2), *(scale * np.asarray(vector))])


poses = st.tuples(rotation_vectors, vectors).map(lambda p: np.array([*quaternion(p[0]), *p[1]]))


def rotation(pose) -> np.ndarray:
    return RotationMatrix(Quaternion(pose[:4] / np.linalg.norm(pose[:4]))).matrix()


def scale_pose(pose, master, command, alignment=IDENTITY[:4], translation=1.0, angle=1.0):
    out = np.empty(7)
    scale_pose_into(pose, master, command, alignment, translation, angle, out)
    return out


def assert_same_pose(a, b, atol=1e-12):
    np.testing.assert_allclose(a[4:], b[4:], atol=atol)
    np.testing.assert_allclose(rotation(a), rotation(b), atol=atol)


@given(rotation_vectors, st.floats(0, 1))
def test_orientation_scaling_scales_the_angle_about_the_same_axis(vector, scale):
    scaled = scaled_rotation(tuple(quaternion(vector)), scale)
    np.testing.assert_allclose(scaled, quaternion(scale * vector), atol=1e-14)


@given(poses)
def test_scale_one_is_the_identity(pose):
    assert_same_pose(scale_pose(pose, IDENTITY, IDENTITY), pose)


@given(poses, poses, poses, st.floats(0, 4), st.floats(0, 1))
def test_quaternion_sign_does_not_matter(pose, master, command, translation, angle):
    expected = scale_pose(pose, master, command, translation=translation, angle=angle)
    flip = np.array([-1.0] * 4 + [1.0] * 3)
    difference = rotation(pose) @ rotation(master).T
    if np.trace(difference) < -0.999:
        return  # at 180 degrees the shorter rotation is ambiguous
    for other in (
        scale_pose(flip * pose, master, command, translation=translation, angle=angle),
        scale_pose(pose, flip * master, command, translation=translation, angle=angle),
        scale_pose(pose, master, flip * command, translation=translation, angle=angle),
    ):
        assert_same_pose(other, expected)


@given(poses, st.floats(0, 2), st.floats(0, 2), st.floats(0, 1), st.floats(0, 1))
def test_scales_compose(pose, first, second, first_angle, second_angle):
    once = scale_pose(
        pose, IDENTITY, IDENTITY, translation=first * second, angle=first_angle * second_angle
    )
    half_way = scale_pose(pose, IDENTITY, IDENTITY, translation=first, angle=first_angle)
    twice = scale_pose(half_way, IDENTITY, IDENTITY, translation=second, angle=second_angle)
    assert_same_pose(twice, once)


@given(poses, poses, rotation_vectors, st.floats(0, 4), st.floats(0, 1))
def test_at_its_reference_the_master_commands_the_reference(master, command, R, length, angle):
    out = scale_pose(master, master, command, quaternion(R), length, angle)
    assert_same_pose(out, command)


@given(poses, poses, poses, rotation_vectors)
def test_alignment_turns_the_motion_into_the_world(pose, master, command, vector):
    R_WB = RotationMatrix(Quaternion(quaternion(vector))).matrix()
    out = scale_pose(pose, master, command, quaternion(vector))
    np.testing.assert_allclose(out[4:] - command[4:], R_WB @ (pose[4:] - master[4:]), atol=1e-12)
    turn_B = rotation(pose) @ rotation(master).T
    np.testing.assert_allclose(
        rotation(out), R_WB @ turn_B @ R_WB.T @ rotation(command), atol=1e-12
    )


@given(poses, poses, poses)
def test_commanded_quaternion_has_norm_one(pose, master, command):
    out = scale_pose(pose, master, 1.001 * command, angle=0.3)
    assert np.linalg.norm(out[:4]) == pytest.approx(1.0, abs=1e-15)


class HandAndClutch(LeafSystem):
    """Moving master, and a clutch that opens and closes."""

    def __init__(self) -> None:
        super().__init__()
        self.DeclareVectorOutputPort("pose_master", 7, self.calc_pose)
        self.DeclareVectorOutputPort("clutch", 1, self.calc_clutch)

    @staticmethod
    def pose(t) -> np.ndarray:
        return np.array([*quaternion([0.5 * t, -0.2 * t, np.sin(t)]), t, np.cos(2 * t), 0.3 * t])

    def calc_pose(self, context, output) -> None:
        output.SetFromVector(self.pose(context.get_time()))

    def calc_clutch(self, context, output) -> None:
        output.SetAtIndex(0, float(not 0.4 <= context.get_time() < 0.7))


def commands(config, start, times) -> np.ndarray:
    """Return the commanded poses at `times`, sampled at 1 kHz."""
    builder = DiagramBuilder()
    source = builder.AddSystem(HandAndClutch())
    scaling = builder.AddSystem(KinematicScaling(config, 1e-3, start))
    for port in ("pose_master", "clutch"):
        builder.Connect(source.GetOutputPort(port), scaling.GetInputPort(port))
    simulator = Simulator(builder.Build())
    simulator.Initialize()
    context = scaling.GetMyContextFromRoot(simulator.get_context())
    result = []
    for time in times:
        simulator.AdvanceTo(time)
        result.append(scaling.GetOutputPort("pose_command").Eval(context).copy())
    return np.array(result)


def test_clutch_holds_the_command_and_re_indexes_without_a_jump():
    config = KinematicScalingConfig(
        translation_scale=2.0, rotation_scale=0.5, alignment=[0.1, 0.2, 0.9]
    )
    start = np.array([*quaternion([3.0, 0.2, 0.1]), 0.5, 0.1, 0.4])
    times = np.arange(0.0, 1.0, 2.5e-4)
    path = commands(config, start, times)
    np.testing.assert_allclose(path[0], start, atol=1e-15)

    # The master moves at up to 2.3 m/s and 1.2 rad/s.
    assert np.linalg.norm(np.diff(path[:, 4:], axis=0), axis=1).max() < 2 * 2.3 * 2.6e-4
    assert np.linalg.norm(np.diff(path[:, :4], axis=0), axis=1).max() < 0.5 * 1.2 * 2.6e-4
    open_ = (times > 0.4015) & (times < 0.6995)
    np.testing.assert_array_equal(path[open_], np.broadcast_to(path[open_][0], path[open_].shape))

    R_WB = RollPitchYaw(config.alignment).ToRotationMatrix().matrix()
    source = HandAndClutch()
    held = path[open_][0]
    for time, command in ((0.3, path[1200]), (0.9, path[3600])):
        index = int(np.argmin(np.abs(times - time)))
        np.testing.assert_array_equal(path[index], command)
    moved = 2 * R_WB @ (source.pose(0.9) - source.pose(0.7))[4:]
    np.testing.assert_allclose(path[3600, 4:] - held[4:], moved, atol=1e-9)
    moved = 2 * R_WB @ (source.pose(0.3) - source.pose(0.0))[4:]
    np.testing.assert_allclose(path[1200, 4:] - start[4:], moved, atol=1e-12)


def test_clutch_requires_a_valid_pose():
    """An invalid pose would stay the reference."""
    system = KinematicScaling(KinematicScalingConfig(), 1e-3, np.arange(1.0, 8.0))
    context = system.CreateDefaultContext()
    for pose, closed in ((np.full(7, np.nan), 0.0), (np.array(IDENTITY), 1.0)):
        system.GetInputPort("pose_master").FixValue(context, pose)
        context.SetDiscreteState(system.EvalUniquePeriodicDiscreteUpdate(context))
        references = context.get_discrete_state_vector().value()
        assert references[14] == closed and np.isfinite(references).all()


def test_an_open_clutch_at_the_start_commands_the_start():
    system = KinematicScaling(KinematicScalingConfig(), 1e-3, np.arange(1.0, 8.0))
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    system.GetInputPort("pose_master").FixValue(context, IDENTITY)
    system.GetInputPort("clutch").FixValue(context, [0.0])
    simulator.AdvanceTo(0.1)
    np.testing.assert_array_equal(
        system.GetOutputPort("pose_command").Eval(context), np.arange(1.0, 8.0)
    )


@pytest.mark.parametrize("scale", [0.3, 0.5, 1.7])
@pytest.mark.parametrize("axis", [[0.0, 0.0, 1.0], [0.6, -0.8, 0.0]])
def test_command_is_continuous_over_more_than_a_turn(scale, axis):
    """The slave would turn back by up to 180 degrees at once."""
    block = KinematicScaling(KinematicScalingConfig(rotation_scale=scale), 0.01, IDENTITY)
    simulator = Simulator(block)
    context, angles = simulator.get_mutable_context(), np.linspace(0.0, 7.0, 300)
    for time, angle in enumerate([*angles, *angles[::-1]]):
        pose = np.array([np.cos(angle / 2), *np.sin(angle / 2) * np.array(axis), 0.0, 0.0, 0.0])
        block.GetInputPort("pose_master").FixValue(context, pose)
        simulator.AdvanceTo(0.01 * time)
        half = 0.5 * scale * angle
        expected = np.array([np.cos(half), *np.sin(half) * np.array(axis)])
        found = block.GetOutputPort("pose_command").Eval(context)[:4]
        assert abs(found @ expected) == pytest.approx(1.0, abs=1e-9)
