"""Closed-form inverse kinematics of the RX90 against the plant and the forward kinematics."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RotationMatrix
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant

from drake_teleop.common.files import models_dir
from drake_teleop.station.slave import inverse_kinematics as ik
from drake_teleop.station.slave.arm import forward_kinematics
from drake_teleop.station.slave.arm_from_plant import ArmModelFromPlant
from drake_teleop.station.slave.inverse_kinematics import (
    IkStatus,
    InverseKinematics,
    nearest_branch,
)

R_DOWN = np.diag([1.0, -1.0, -1.0])
P_HOME = np.array([0.55, 0.0, 0.45])
Q_HOME = np.array([0.0, -0.468148, -1.793054, 0.0, -0.880391, np.pi])


@pytest.fixture(scope="module")
def plant():
    plant = MultibodyPlant(0.0)
    (instance,) = Parser(plant).AddModels(str(models_dir() / "rx90.sdf"))
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base", instance))
    plant.Finalize()
    return plant


@pytest.fixture(scope="module")
def arm(plant):
    return ArmModelFromPlant(plant, plant.GetModelInstanceByName("rx90"))


def forward(arm, q):
    R, p = np.zeros((3, 3)), np.zeros(3)
    forward_kinematics(arm.table, np.asarray(q, dtype=float), R, p)
    return R, p


def angle_difference(difference):
    return difference - 2 * np.pi * np.round(difference / (2 * np.pi))


def test_lengths_are_those_of_the_model(plant):
    context = plant.CreateDefaultContext()

    def height(frame):
        return plant.GetFrameByName(frame).CalcPoseInWorld(context).translation()[2]

    heights = [height(name) for name in ["base", "link_2", "link_3", "link_5", "sensor"]]
    lengths = [ik.SHOULDER_HEIGHT_M, ik.UPPER_ARM_LENGTH_M, ik.FOREARM_LENGTH_M, ik.WRIST_TO_S_M]
    np.testing.assert_allclose(np.diff(heights), lengths, atol=1e-15)


def all_ik_solutions(R, p):
    q = np.empty((8, 6))
    assert ik._solve_all_branches_into(np.ascontiguousarray(R), p, 0.0, 0.0, q) == IkStatus.OK
    return angle_difference(q)


@pytest.mark.slow
def test_all_eight_branches_meet_random_poses(arm):
    rng = np.random.default_rng(0)
    for _ in range(10_000):
        q = rng.uniform(arm.lower, arm.upper)
        R, p = forward(arm, q)
        branches = all_ik_solutions(R, p)
        assert np.abs(angle_difference(branches - q)).max(axis=1).min() < 1e-9
        for branch in branches:
            R_branch, p_branch = forward(arm, branch)
            assert np.abs(R_branch - R).max() < 1e-9
            assert np.abs(p_branch - p).max() < 1e-9
        nearest, status = nearest_branch(R, p, q, arm.lower, arm.upper)
        assert status == IkStatus.OK
        np.testing.assert_allclose(nearest, q, atol=1e-9)


def test_row_order_of_branches(arm):
    q = np.array([0.3, -0.5, -1.2, 0.4, 0.8, -0.6])
    branches = all_ik_solutions(*forward(arm, q))
    np.testing.assert_allclose(branches[2], q, atol=1e-12)
    assert np.all(branches[[0, 1, 4, 5], 2] > 0) and np.all(branches[[2, 3, 6, 7], 2] < 0)
    assert np.all(branches[0::2, 4] > 0) and np.all(branches[1::2, 4] < 0)
    np.testing.assert_allclose(
        angle_difference(branches[4:, 0] - branches[:4, 0] - np.pi), 0, atol=1e-12
    )
    assert len(np.unique(branches.round(6), axis=0)) == 8
    assert np.all(np.abs(branches) <= np.pi)


def test_every_branch_meets_the_pose_in_the_plant(plant):
    context = plant.CreateDefaultContext()
    branches = all_ik_solutions(R_DOWN, P_HOME)
    assert branches.shape == (8, 6)
    for branch in branches:
        plant.SetPositions(context, branch)
        X_WS = plant.GetFrameByName("sensor").CalcPoseInWorld(context)
        np.testing.assert_allclose(X_WS.rotation().matrix(), R_DOWN, atol=1e-12)
        np.testing.assert_allclose(X_WS.translation(), P_HOME, atol=1e-12)


def test_home_has_elbow_up_and_margin_to_limits(arm):
    q, status = nearest_branch(R_DOWN, P_HOME, Q_HOME, arm.lower, arm.upper)
    assert status == IkStatus.OK
    np.testing.assert_allclose(q, Q_HOME, atol=1e-6)
    assert np.all(q > arm.lower + 0.6) and np.all(q < arm.upper - 0.6)


@pytest.mark.parametrize("turn", [-2 * np.pi, 0.0, 2 * np.pi])
def test_full_rotation_nearest_to_reference_is_selected(arm, turn):
    q = np.array([0.2, -0.4, -1.3, 0.3, -0.7, -2.0])
    near = q + np.array([0, 0, 0, 0, 0, turn])
    found, status = nearest_branch(*forward(arm, q), near, arm.lower, arm.upper)
    assert status == IkStatus.OK
    inside = near[5] if arm.lower[5] <= near[5] <= arm.upper[5] else q[5]
    np.testing.assert_allclose(found, [*q[:5], inside], atol=1e-12)


def test_arm_stretches_towards_pose_out_of_reach(arm):
    direction = np.array([0.64, -0.6, -0.48])
    shoulder = np.array([0, 0, ik.SHOULDER_HEIGHT_M])
    p = shoulder + 1.3 * direction + ik.WRIST_TO_S_M * R_DOWN[:, 2]
    q, status = nearest_branch(R_DOWN, p, Q_HOME, arm.lower, arm.upper)
    assert status == IkStatus.OUT_OF_REACH
    R, p_found = forward(arm, q)
    np.testing.assert_allclose(R, R_DOWN, atol=1e-12)
    reach = ik.UPPER_ARM_LENGTH_M + ik.FOREARM_LENGTH_M
    wrist = p_found - ik.WRIST_TO_S_M * R[:, 2]
    np.testing.assert_allclose(wrist, shoulder + reach * direction, atol=1e-12)


def test_q4_is_kept_at_wrist_singularity(arm):
    reference = np.array([0.1, -0.5, -1.0, 0.7, 0.02, -0.1])
    R, p = forward(arm, [0.1, -0.5, -1.0, 0.2, 0.0, 0.9])
    q, status = nearest_branch(R, p, reference, arm.lower, arm.upper)
    assert status == IkStatus.WRIST_SINGULAR
    np.testing.assert_allclose(q, [0.1, -0.5, -1.0, 0.7, 0.0, 0.4], atol=1e-9)
    np.testing.assert_allclose(forward(arm, q)[0], R, atol=1e-9)


@pytest.mark.parametrize("q5", [1e-15, 1e-12, 1e-10, 2e-9, 1e-8, 1e-6, 1e-4])
def test_pose_is_met_near_wrist_singularity(arm, q5):
    R, p = forward(arm, [0.1, -0.5, -1.0, 2.0, q5, -0.4])
    reference = np.array([0.1, -0.5, -1.0, 0.3, 0.0, 1.3])
    q, _ = nearest_branch(R, p, reference, arm.lower, arm.upper)
    R_found, p_found = forward(arm, q)
    np.testing.assert_allclose(R_found, R, atol=2e-9)
    np.testing.assert_allclose(p_found, p, atol=1e-9)
    # From the singularity on, the nearer wrist branch rotates joint 4 by 90 degrees at most.
    assert abs(q[3] - 0.3) <= np.pi / 2 + 1e-6


def test_q1_is_kept_at_shoulder_singularity(arm):
    # q3 = -2 q2 puts the wrist's centre above the shoulder.
    R, p = forward(arm, [0.4, -0.5, 1.0, 0.2, 0.5, 0.1])
    reference = np.array([0.9, -0.4, 1.1, 0.1, 0.4, 0.1])
    q, status = nearest_branch(R, p, reference, arm.lower, arm.upper)
    assert status == IkStatus.SHOULDER_SINGULAR
    np.testing.assert_allclose(q[:3], [0.9, -0.5, 1.0], atol=1e-9)
    R_found, p_found = forward(arm, q)
    np.testing.assert_allclose(R_found, R, atol=1e-9)
    np.testing.assert_allclose(p_found, p, atol=1e-9)


def test_branches_outside_limits_are_rejected(arm):
    lower, upper = arm.lower.copy(), arm.upper.copy()
    lower[4] = 0.0
    q, status = nearest_branch(R_DOWN, P_HOME, Q_HOME, lower, upper)
    assert status == IkStatus.OK
    assert q[4] > 0.8
    np.testing.assert_allclose(forward(arm, q)[0], R_DOWN, atol=1e-12)
    upper[2] = -2.0
    held, status = nearest_branch(R_DOWN, P_HOME, Q_HOME, lower, upper)
    assert status == IkStatus.JOINT_LIMIT
    np.testing.assert_array_equal(held, np.clip(Q_HOME, lower, upper))


def test_pose_on_limit_is_accepted(arm):
    q = np.array([arm.upper[0], -0.5, arm.lower[2], arm.upper[3], arm.lower[4], 0.0])
    found, status = nearest_branch(*forward(arm, q), q, arm.lower, arm.upper)
    assert status == IkStatus.OK
    np.testing.assert_allclose(found, q, atol=1e-9)
    assert np.all(found >= arm.lower) and np.all(found <= arm.upper)


def test_branches_beyond_max_step_are_rejected(arm):
    reference = Q_HOME + np.array([0, 0, 0, 0, 2.5, 0])
    held, status = nearest_branch(R_DOWN, P_HOME, reference, arm.lower, arm.upper, max_step=1.5)
    assert status == IkStatus.JOINT_LIMIT
    np.testing.assert_array_equal(held, reference)


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e9])
def test_invalid_pose_holds_reference(arm, bad):
    p = P_HOME + np.array([0, bad, 0])
    q, status = nearest_branch(R_DOWN, p, Q_HOME, arm.lower, arm.upper)
    assert status == IkStatus.BAD_POSE
    np.testing.assert_array_equal(q, Q_HOME)


def test_invalid_reference_gives_invalid_result(arm):
    reference = np.where(np.arange(6) == 3, np.nan, Q_HOME)
    q, status = nearest_branch(R_DOWN, P_HOME, reference, arm.lower, arm.upper)
    assert status == IkStatus.BAD_POSE and np.isnan(q).all()


def test_result_is_finite_and_within_limits_for_any_pose(arm):
    rng = np.random.default_rng(3)
    seen = set()
    for k in range(3000):
        R = RotationMatrix(Quaternion(wxyz=unit(rng.normal(size=4)))).matrix()
        p = rng.normal(size=3) * (0.3 if k % 2 else 1.0) + [0, 0, 0.4]
        reference = rng.uniform(-4, 4, 6)
        q, status = nearest_branch(R, p, reference, arm.lower, arm.upper)
        assert np.all(q >= arm.lower) and np.all(q <= arm.upper)
        if status == IkStatus.OK:
            assert np.abs(forward(arm, q)[1] - p).max() < 1e-9
        seen.add(status)
    assert seen >= {IkStatus.OK, IkStatus.OUT_OF_REACH, IkStatus.JOINT_LIMIT}


def unit(vector):
    return vector / np.linalg.norm(vector)


@pytest.mark.parametrize(
    ("quaternion", "expected_status", "expected"),
    [
        ([0, 2.0, 0, 0], IkStatus.OK, Q_HOME),
        ([1.0, 0, 0, 0], IkStatus.JOINT_LIMIT, Q_HOME + 0.05),
        ([0, 0, 0, 0], IkStatus.BAD_POSE, Q_HOME + 0.05),
    ],
)
def test_the_system_solves_its_pose_command(arm, quaternion, expected_status, expected):
    system = InverseKinematics(arm.lower, arm.upper)
    context = system.CreateDefaultContext()
    system.GetInputPort("joint_position").FixValue(context, Q_HOME + 0.05)
    system.GetInputPort("pose_command").FixValue(context, [*quaternion, *P_HOME])
    assert system.GetOutputPort("ik_status").Eval(context) == [expected_status]
    command = system.GetOutputPort("joint_command").Eval(context)
    np.testing.assert_allclose(command, expected, atol=1e-6)


def test_the_system_agrees_with_drakes_quaternions(arm):
    rng = np.random.default_rng(5)
    system = InverseKinematics(arm.lower, arm.upper)
    context = system.CreateDefaultContext()
    for _ in range(100):
        q = rng.uniform(arm.lower, arm.upper)
        R, p = forward(arm, q)
        wxyz = RotationMatrix(R).ToQuaternion().wxyz()
        system.GetInputPort("joint_position").FixValue(context, q)
        system.GetInputPort("pose_command").FixValue(context, [*wxyz, *p])
        np.testing.assert_allclose(
            system.GetOutputPort("joint_command").Eval(context), q, atol=1e-7
        )
