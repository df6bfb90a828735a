"""Numeric inverse kinematics against plants and the closed form, also out of reach."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
import pytest
from odd_arms import five_joint_plant, other_plant, rx90_plant, sliding_plant
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RotationMatrix

from drake_teleop.station.scenario import LoadScenario, replace
from drake_teleop.station.simulation import simulate
from drake_teleop.station.slave.arm import ArmModel, jacobian
from drake_teleop.station.slave.arm_from_plant import ArmModelFromPlant
from drake_teleop.station.slave.home import solve_start_posture
from drake_teleop.station.slave.inverse_kinematics import (
    IkStatus,
    InverseKinematics,
    solve_pose_command,
)
from drake_teleop.station.slave.joint_commands import IK_METHODS
from drake_teleop.station.slave.numeric_inverse_kinematics import (
    MAX_SOLVER_STEPS_PER_COMMAND,
    MIN_SINGULAR_VALUE_M,
    POSE_TOLERANCE_M,
    NumericInverseKinematics,
    find_posture,
    follow_pose,
    orientation_weight_m,
)
from drake_teleop.station.station import MakeTeleopStation

# Functions are compiled once, within three seconds.
pytestmark = pytest.mark.slow

PERIOD = 5e-4
#: RX90 with its elbow bent and its wrist stretched.
STRETCHED = np.array([0.2, -0.5, -1.6, 0.7, 0.0, 0.4])
BENT = np.array([0.2, -0.5, -1.6, 0.7, 0.8, 0.4])


class Case(NamedTuple):
    """An arm and its plant, which gives the true pose."""

    plant: object
    context: object
    frame: object
    arm: ArmModel

    def X_WS(self, q):
        full = np.zeros(self.plant.num_positions())
        full[self.arm.position_index] = q
        self.plant.SetPositions(self.context, full)
        return self.frame.CalcPoseInWorld(self.context)

    def pose(self, q):
        return pose_of(self.X_WS(q))

    def errors(self, pose, q):
        """Return the errors of position [m] and orientation [rad]."""
        X = self.X_WS(q)
        R = RotationMatrix(X.rotation().inverse().matrix() @ quaternion(pose).matrix())
        return np.linalg.norm(pose[4:] - X.translation()), R.ToAngleAxis().angle()


def quaternion(pose):
    return RotationMatrix(Quaternion(pose[:4] / np.linalg.norm(pose[:4])))


def pose_of(X: RigidTransform):
    return np.append(X.rotation().ToQuaternion().wxyz(), X.translation())


def case_of(plant, instance, frame) -> Case:
    arm = ArmModelFromPlant(plant, instance, frame)
    return Case(plant, plant.CreateDefaultContext(), plant.GetFrameByName(frame), arm)


@pytest.fixture(scope="module")
def rx90():
    return case_of(*rx90_plant())


@pytest.fixture(scope="module")
def seven():
    return case_of(*other_plant())


@pytest.fixture(scope="module")
def sliding():
    return case_of(*sliding_plant())


def follow(case, pose, reference, *, max_step=np.inf, posture=None, pull=0.0):
    arm, q = case.arm, np.empty(case.arm.num_joints)
    far = np.broadcast_to(np.asarray(max_step, dtype=float), q.shape).copy()
    posture = np.array(reference if posture is None else posture, dtype=float)
    reference = np.array(reference, dtype=float)
    status = follow_pose(
        arm.table, orientation_weight_m(arm), pose, reference, arm.lower, arm.upper, far, posture,
        pull, MIN_SINGULAR_VALUE_M, MAX_SOLVER_STEPS_PER_COMMAND, q,
    )  # fmt: skip
    return q, IkStatus(status)


@pytest.mark.parametrize("name", ["rx90", "seven", "sliding"])
def test_search_meets_random_poses(name, request):
    case = request.getfixturevalue(name)
    lower, upper = case.arm.lower, case.arm.upper
    random = np.random.default_rng(2)
    for _ in range(100):
        pose = case.pose(random.uniform(lower, upper))
        pose[:4] *= random.uniform(-3, 3)
        q, status = find_posture(case.arm, pose, (lower + upper) / 2)
        assert status == IkStatus.OK
        assert max(case.errors(pose, q)) < POSE_TOLERANCE_M
        assert np.all((lower <= q) & (q <= upper))


def test_rx90_result_equals_closed_form(rx90):
    arm, random = rx90.arm, np.random.default_rng(3)
    closed = np.empty(6)
    for _ in range(100):
        q = BENT + random.uniform(-0.3, 0.3, 6)
        reference = q + random.uniform(-0.05, 0.05, 6)
        pose = rx90.pose(q)
        assert solve_pose_command(pose, reference, arm.lower, arm.upper, 2.0, closed) == 0
        found, status = follow(rx90, pose, reference)
        assert status == IkStatus.OK
        np.testing.assert_allclose(found, closed, rtol=0, atol=1e-9)


def test_full_rotation_nearest_to_reference_is_selected(rx90):
    """Joints 4 and 6 have ranges above 360 degrees."""
    q = np.array([0.2, -0.5, -1.6, 0.7, 0.6, 4.0])
    assert q[5] < rx90.arm.upper[5]
    found, status = find_posture(rx90.arm, rx90.pose(q), np.append(q[:5], 3.9))
    assert status == IkStatus.OK
    np.testing.assert_allclose(found, q, atol=1e-9)
    found, _ = find_posture(rx90.arm, rx90.pose(q), np.append(q[:5], 4.0 - 2 * np.pi))
    np.testing.assert_allclose(found, [*q[:5], 4.0 - 2 * np.pi], atol=1e-9)


def singular_axis(case, q):
    J = np.empty((6, len(q)))
    jacobian(case.arm.table, q, J)
    axis = np.linalg.svd(J)[0][3:, 5]
    return axis / np.linalg.norm(axis)


def sweep(case, q, solve):
    """Rotate S back and forth about the axis with the smallest singular value at q.

    Returns:
        Largest step as a share of the speed limits; errors at the end; statuses.
    """
    axis = singular_axis(case, q)
    X, largest, statuses = case.X_WS(q), 0.0, set()
    for k in range(3000):
        half = 0.15 * np.sin(min(k * PERIOD, 1.0) * 2 * np.pi)
        turn = np.array([np.cos(half), *(np.sin(half) * axis)])
        R = quaternion(turn) @ X.rotation()
        pose = pose_of(RigidTransform(R, X.translation()))
        before = q
        q, status = solve(pose, before)
        statuses.add(status)
        largest = max(largest, np.abs((q - before) / (case.arm.velocity_limit * PERIOD)).max())
    return largest, case.errors(pose, q), statuses


@pytest.mark.parametrize("aside", [0.0, 1e-3])
def test_joint_speed_stays_within_limits_at_singular_wrist(rx90, aside):
    arm, start = rx90.arm, np.array([*STRETCHED[:4], aside, STRETCHED[5]])

    def closed(pose, reference):
        q = np.empty(6)
        return q, solve_pose_command(pose, reference, arm.lower, arm.upper, 2.0, q)

    def numeric(pose, reference):
        return follow(rx90, pose, reference, max_step=arm.velocity_limit * PERIOD)

    assert sweep(rx90, start, closed)[0] > 20  # the motion crosses a singularity
    largest, errors, statuses = sweep(rx90, start, numeric)
    assert largest < 1 + 1e-9
    assert max(errors) < 1e-5  # the rest is slow
    assert {IkStatus.OK, IkStatus.WRIST_SINGULAR, IkStatus.SPEED_LIMIT} <= statuses
    assert IkStatus.JOINT_LIMIT not in statuses


def test_small_error_at_singularity_causes_no_motion(rx90):
    """Joints 4 and 6 would rotate far for 1e-7 rad."""
    X, q = rx90.X_WS(STRETCHED), STRETCHED
    turn = np.array([1.0, *(0.5e-7 * singular_axis(rx90, STRETCHED))])
    pose = pose_of(RigidTransform(quaternion(turn) @ X.rotation(), X.translation()))
    for _ in range(200):
        q, _ = follow(rx90, pose, q, max_step=rx90.arm.velocity_limit * PERIOD)
    assert np.abs(q - STRETCHED).max() < 2e-3


@pytest.mark.parametrize(("max_step", "pull"), [(0.01, 0.02), (1e-3, 1.0)])
def test_null_space_motion_approaches_posture(seven, max_step, pull):
    """The arm moves in its null space and returns; the pose is met."""
    home, J = np.full(7, 0.4), np.empty((6, 7))
    jacobian(seven.arm.table, home, J)
    pose, q, away = seven.pose(home), home, []
    for posture in (home + np.linalg.svd(J)[2][6], home):
        for _ in range(1000):
            q, status = follow(seven, pose, q, max_step=max_step, posture=posture, pull=pull)
            assert status == IkStatus.OK
        assert max(seven.errors(pose, q)) < 2 * POSE_TOLERANCE_M
        away.append(np.abs(q - home).max())
    assert away[0] > 0.1 and away[1] < 1e-3


def test_posture_causes_no_oscillation_out_of_reach(sliding):
    home = np.array([0.2, 0.6, -0.4, 0.3, 0.9, -0.5, 0.4])
    pose, q, moved = sliding.pose(home), home, 0.0
    pose[4:] += [-3.0, 1.0, 2.0]
    for k in range(1500):
        before = q
        q, status = follow(sliding, pose, q, max_step=0.01, posture=home, pull=1e-3)
        moved += np.abs(q - before).max() if k >= 1000 else 0.0
    assert status in (IkStatus.OUT_OF_REACH, IkStatus.JOINT_LIMIT)
    assert moved < 1e-3


def test_arm_stops_at_boundary_and_returns(rx90):
    start, max_step = BENT, rx90.arm.velocity_limit * PERIOD
    pose = rx90.pose(start)
    far = pose.copy()
    far[4:] *= 3.0
    q = start
    for _ in range(3000):
        before = q
        q, status = follow(rx90, far, q, max_step=max_step)
    assert status == IkStatus.OUT_OF_REACH
    np.testing.assert_allclose(q, before, atol=1e-9)
    assert abs(q[2]) < 1e-3  # the elbow is straight
    for _ in range(3000):
        q, status = follow(rx90, pose, q, max_step=max_step)
    assert status == IkStatus.OK
    np.testing.assert_allclose(q, start, atol=1e-8)


FIVE_JOINTS = np.array([0.2, -0.46, 0.71, 1.11, -0.04])


def follow_displacement(case, displacement, turn):
    """Return position error [m], orientation error [rad] and status after a slow motion."""
    start, q = case.X_WS(FIVE_JOINTS), FIVE_JOINTS
    for k in range(1, 801):
        share = min(k / 500, 1.0)
        R = RotationMatrix.MakeZRotation(share * turn) @ start.rotation()
        pose = pose_of(RigidTransform(R, start.translation() + share * np.array(displacement)))
        q, status = follow(case, pose, q, max_step=0.01)
    return (*case.errors(pose, q), status)


@pytest.mark.parametrize("fourth_axis", [(0, 1, 0), (0, 0, 1)])
@pytest.mark.parametrize(
    ("displacement", "turn"),
    [([0, 0.002, 0], 0), ([0, -0.01, 0], 0), ([0.01, 0.02, 0.01], 0), ([0, 0, 0], 0.02)],
)
def test_five_joints_that_miss_only_the_orientation_are_not_out_of_reach(
    displacement, turn, fourth_axis
):
    case = case_of(*five_joint_plant(fourth_axis))
    position_error, angle, status = follow_displacement(case, displacement, turn)
    assert position_error < 1e-3 and angle > 1e-3
    assert status == IkStatus.WRIST_SINGULAR


@pytest.mark.parametrize("displacement", [[0.5, 0, 0], [0.25, 0.25, 0], [-0.02, 0.6, 0.1]])
def test_five_joints_that_miss_the_position_by_1_mm_are_out_of_reach(displacement):
    case = case_of(*five_joint_plant())
    position_error, _, status = follow_displacement(case, displacement, 0)
    assert position_error > 1e-3
    assert status == IkStatus.OUT_OF_REACH


def test_other_joints_compensate_for_joint_at_limit(rx90):
    beyond = BENT.copy()
    beyond[0] = rx90.arm.upper[0] + 0.2
    pose, start = rx90.pose(beyond), BENT.copy()
    start[0] = rx90.arm.upper[0] - 0.1
    q, status = follow(rx90, pose, start)
    assert status == IkStatus.JOINT_LIMIT
    assert q[0] == rx90.arm.upper[0]
    only_this_joint = np.append(q[0], beyond[1:])
    L = orientation_weight_m(rx90.arm)
    ours, simply = (np.hypot(p, L * turn) for p, turn in (
        rx90.errors(pose, q), rx90.errors(pose, only_this_joint)))  # fmt: skip
    assert ours < 0.8 * simply


def test_arm_lags_beyond_speed_limit(sliding):
    max_step = np.full(7, 1e-3)
    start = np.full(7, 0.4)
    q, status = follow(sliding, sliding.pose(start + 0.1), start, max_step=max_step)
    assert status == IkStatus.SPEED_LIMIT
    assert np.abs(q - start).max() == pytest.approx(1e-3, abs=1e-15)


@pytest.mark.parametrize(
    ("place", "value"), [(0, np.nan), (5, np.inf), (5, 2e6), (slice(0, 4), 0.0)]
)
def test_invalid_pose_holds_command(rx90, place, value):
    pose = rx90.pose(BENT)
    pose[place] = value
    q, status = follow(rx90, pose, [BENT[0], 9.0, *BENT[2:]])
    assert status == IkStatus.BAD_POSE
    np.testing.assert_array_equal(q, [BENT[0], rx90.arm.upper[1], *BENT[2:]])
    assert find_posture(rx90.arm, pose, BENT)[1] == IkStatus.BAD_POSE


def test_invalid_reference_gives_invalid_result(rx90):
    q, status = follow(rx90, rx90.pose(BENT), np.full(6, np.nan))
    assert status == IkStatus.BAD_POSE and np.isnan(q).all()


def test_status_of_unreachable_pose(rx90):
    pose = rx90.pose(BENT)
    pose[4:] *= 3.0
    assert find_posture(rx90.arm, pose, BENT)[1] in (IkStatus.OUT_OF_REACH, IkStatus.JOINT_LIMIT)


def test_system_continues_from_last_command(rx90):
    system = NumericInverseKinematics(rx90.arm, BENT, PERIOD)
    context = system.CreateDefaultContext()
    system.GetInputPort("joint_position").FixValue(context, BENT - 0.02)
    goal = BENT + 0.01
    system.GetInputPort("pose_command").FixValue(context, rx90.pose(goal))
    command, status = (system.GetOutputPort(name) for name in ("joint_command", "ik_status"))
    q = BENT
    for k in range(40):
        context.SetTime(k * PERIOD)
        before, q = q, command.Eval(context).copy()
        assert np.all(np.abs(q - before) <= rx90.arm.velocity_limit * PERIOD * (1 + 1e-9))
        state = system.EvalUniquePeriodicDiscreteUpdate(context)
        context.SetDiscreteState(state)
        # The first command is kept.
        np.testing.assert_array_equal(command.Eval(context), q)
    np.testing.assert_allclose(q, goal, atol=1e-9)
    system.GetInputPort("joint_position").FixValue(context, np.full(6, np.nan))
    system.GetInputPort("pose_command").FixValue(context, rx90.pose(BENT))
    context.SetTime(1.0)
    np.testing.assert_array_equal(command.Eval(context), q)
    assert status.Eval(context) == [IkStatus.BAD_POSE]
    # Ports, states and arrays share the compiled functions.
    assert len(follow_pose.signatures) == 1


def test_command_is_constant_without_elapsed_time(rx90):
    arm = dataclasses.replace(rx90.arm, velocity_limit=np.full(6, np.inf))
    system = NumericInverseKinematics(arm, BENT, PERIOD)
    context = system.CreateDefaultContext()
    system.GetInputPort("joint_position").FixValue(context, BENT)
    system.GetInputPort("pose_command").FixValue(context, rx90.pose(BENT + 0.5))
    command, status = (system.GetOutputPort(name) for name in ("joint_command", "ik_status"))
    np.testing.assert_array_equal(command.Eval(context), BENT)
    assert status.Eval(context) == [IkStatus.SPEED_LIMIT]
    context.SetTime(PERIOD)
    np.testing.assert_allclose(command.Eval(context), BENT + 0.5, atol=1e-8)


@pytest.mark.parametrize(("period", "left"), [(0.01, np.exp(-1.0)), (0.1, 0.9**10), (3.0, 0.0)])
def test_posture_rate_is_independent_of_period(seven, period, left):
    """1/e of the distance remains after 1 s, for any period, without overshoot."""
    home, J = np.full(7, 0.4), np.empty((6, 7))
    jacobian(seven.arm.table, home, J)
    pose, posture = seven.pose(home), home + 0.2 * np.linalg.svd(J)[2][6]
    away, _ = follow(seven, pose, home, posture=posture, pull=1.0)
    system = NumericInverseKinematics(seven.arm, home, period)
    context = system.CreateDefaultContext()
    context.SetDiscreteState(np.append(away, 0.0))
    system.GetInputPort("joint_position").FixValue(context, home)
    system.GetInputPort("pose_command").FixValue(context, pose)
    for k in range(1, max(round(1.0 / period), 1) + 1):
        context.SetTime(k * period)
        context.SetDiscreteState(system.EvalUniquePeriodicDiscreteUpdate(context))
    q = context.get_discrete_state_vector().value()[:-1]
    assert max(seven.errors(pose, q)) < 2 * POSE_TOLERANCE_M
    assert np.linalg.norm(away - home) > 0.1
    assert np.linalg.norm(q - home) / np.linalg.norm(away - home) == pytest.approx(left, abs=0.02)


def test_methods_have_the_same_ports(rx90):
    systems = [make(rx90.arm, BENT, PERIOD) for make in IK_METHODS.values()]
    assert {type(system) for system in systems} == {InverseKinematics, NumericInverseKinematics}
    for ports in ("input", "output"):
        names = [
            [
                (port.get_name(), port.size())
                for k in range(getattr(system, f"num_{ports}_ports")())
                for port in [getattr(system, f"get_{ports}_port")(k)]
            ]
            for system in systems
        ]
        assert names[0] == names[1]


def test_station_gives_same_result_with_both_methods(rx90):
    scenario = LoadScenario("free_motion_force")
    scenario = replace(scenario, simulation__duration=0.04, load_estimator__enabled=True)
    commands = [
        simulate(MakeTeleopStation(s), s.simulation)["joint_command"]
        for s in (replace(scenario, slave__inverse_kinematics=method) for method in IK_METHODS)
    ]
    assert np.ptp(commands[0], axis=0).max() > 1e-3
    np.testing.assert_allclose(commands[1], commands[0], atol=1e-8)


@pytest.mark.parametrize("seed", range(4))
def test_start_posture_is_within_ranges_that_exclude_zero(seed):
    """Four joints of the posture that has the pose are slightly beyond their limits near zero."""
    rng, arm = np.random.default_rng(seed), ArmModelFromPlant(*other_plant())
    ends = np.outer(rng.choice([-1.0, 1.0], 7), [0.3, 1.3])
    limited = dataclasses.replace(arm, lower=ends.min(axis=1), upper=ends.max(axis=1))
    sizes = np.concatenate([rng.uniform(0.22, 0.29, 4), rng.uniform(0.4, 0.9, 3)])
    pose = arm.pose(np.sign(ends[:, 0]) * rng.permutation(sizes))
    R_WS = RotationMatrix(Quaternion(pose[:4] / np.linalg.norm(pose[:4])))
    q, status = solve_start_posture(limited, pose[4:], R_WS)
    assert ((limited.lower <= q) & (q <= limited.upper)).all()
    reached = np.abs(arm.pose(q)[4:] - pose[4:]).max() < 1e-6
    assert reached == (status == IkStatus.OK)
