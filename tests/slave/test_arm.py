"""Compiled arm kernels against the Drake plant from which they are read."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from odd_arms import other_arm_urdf, other_plant, rx90_plant, sliding_plant
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JacobianWrtVariable, MultibodyForces

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.station.slave.arm import (
    IS_PRISMATIC_COLUMN,
    SENSOR_MOTION_SIZE,
    forward_dynamics,
    forward_kinematics,
    holding_torque,
    inverse_dynamics,
    jacobian,
    sensor_motion,
)
from drake_teleop.station.slave.arm_from_plant import ArmModelFromPlant, fill_missing_joint_limits
from drake_teleop.station.slave.home import check_inertia_and_holding_torque


@pytest.fixture(
    scope="module",
    params=[rx90_plant, other_plant, sliding_plant],
    ids=["rx90", "other", "sliding"],
)
def case(request):
    plant, instance, frame = request.param()
    return plant, plant.GetFrameByName(frame), ArmModelFromPlant(plant, instance, frame)


def random_states(arm, count=50):
    rng = np.random.default_rng(1)
    n = arm.num_joints
    for _ in range(count):
        yield rng.uniform(arm.lower, arm.upper), rng.normal(size=n) * 3, rng.normal(size=n) * 20


def plant_vector(plant, arm, values):
    """Return the plant's vector with the arm's values and zeros for other joints."""
    vector = np.zeros(plant.num_velocities())
    vector[arm.velocity_index] = values
    return vector


def test_pose_and_jacobian_equal_the_plant(case):
    plant, frame_S, arm = case
    context = plant.CreateDefaultContext()
    R, p, J = np.zeros((3, 3)), np.zeros(3), np.zeros((6, arm.num_joints))
    for q, _, _ in random_states(arm):
        plant.SetPositions(context, plant_vector(plant, arm, q))
        X_WS = frame_S.CalcPoseInWorld(context)
        forward_kinematics(arm.table, q, R, p)
        np.testing.assert_allclose(R, X_WS.rotation().matrix(), atol=1e-12)
        np.testing.assert_allclose(p, X_WS.translation(), atol=1e-12)
        J_drake = plant.CalcJacobianSpatialVelocity(
            context,
            JacobianWrtVariable.kV,
            frame_S,
            np.zeros(3),
            plant.world_frame(),
            plant.world_frame(),
        )[:, arm.velocity_index]
        jacobian(arm.table, q, J)
        np.testing.assert_allclose(J[:3], J_drake[3:], atol=1e-12)
        np.testing.assert_allclose(J[3:], J_drake[:3], atol=1e-12)


def test_motion_of_the_sensor_equals_the_plant(case):
    plant, frame_S, arm = case
    context = plant.CreateDefaultContext()
    out = np.full(SENSOR_MOTION_SIZE, np.nan)
    for q, v, vdot in random_states(arm):
        plant.SetPositions(context, plant_vector(plant, arm, q))
        plant.SetVelocities(context, plant_vector(plant, arm, v))
        X_WS = frame_S.CalcPoseInWorld(context)
        R = X_WS.rotation().matrix()
        V = frame_S.CalcSpatialVelocityInWorld(context)
        # The plant gives accelerations of bodies only; shift the body's to the origin of S.
        body = frame_S.body()
        accelerations = plant.CalcSpatialAccelerationsFromVdot(
            context, plant_vector(plant, arm, vdot)
        )
        p_BS_W = X_WS.translation() - body.EvalPoseInWorld(context).translation()
        A = accelerations[body.index()].Shift(p_BS_W, V.rotational())
        sensor_motion(arm.table, q, v, vdot, out)
        s_S = R.T @ (A.translational() - plant.gravity_field().gravity_vector())
        np.testing.assert_allclose(out[0:3], s_S, rtol=1e-12, atol=1e-12 * np.linalg.norm(s_S))
        np.testing.assert_allclose(out[3:6], R.T @ V.rotational(), rtol=1e-12, atol=1e-12)
        alpha_S = R.T @ A.rotational()
        np.testing.assert_allclose(out[6:9], alpha_S, atol=1e-12 * np.linalg.norm(alpha_S))
        np.testing.assert_allclose(out[9:12], X_WS.translation(), atol=1e-12)
        np.testing.assert_allclose(out[12:21].reshape(3, 3), R, atol=1e-12)


def test_inverse_dynamics_equals_the_plant(case):
    plant, _, arm = case
    context = plant.CreateDefaultContext()
    tau = np.zeros(arm.num_joints)
    for q, v, vdot in random_states(arm):
        plant.SetPositions(context, plant_vector(plant, arm, q))
        plant.SetVelocities(context, plant_vector(plant, arm, v))
        forces = MultibodyForces(plant)
        plant.CalcForceElementsContribution(context, forces)
        expected = plant.CalcInverseDynamics(context, plant_vector(plant, arm, vdot), forces)
        inverse_dynamics(arm.table, q, v, vdot, tau)
        np.testing.assert_allclose(
            tau, expected[arm.velocity_index], atol=1e-10 * np.linalg.norm(expected)
        )


def test_forward_dynamics_inverts_inverse_dynamics(case):
    """A wrench on the load adds J^T F to the torques."""
    _, _, arm = case
    n, random = arm.num_joints, np.random.default_rng(5)
    tau, found, J = np.zeros(n), np.zeros(n), np.zeros((6, n))
    R_WS, p_WS = np.zeros((3, 3)), np.zeros(3)
    for q, v, vdot in random_states(arm):
        wrench_W = 50 * random.normal(size=6)
        inverse_dynamics(arm.table, q, v, vdot, tau)
        jacobian(arm.table, q, J)
        forward_kinematics(arm.table, q, R_WS, p_WS)
        about_So = wrench_W[3:] - np.cross(p_WS, wrench_W[:3])
        tau -= J.T @ np.concatenate([wrench_W[:3], about_So])
        forward_dynamics(arm.table, q, v, tau, wrench_W, found)
        np.testing.assert_allclose(found, vdot, atol=1e-9 * np.linalg.norm(vdot))


def test_plant_accelerates_as_requested():
    plant, instance, frame = rx90_plant()
    arm = ArmModelFromPlant(plant, instance, frame)
    context = plant.CreateDefaultContext()
    tau = np.zeros(arm.num_joints)
    for q, v, vdot in random_states(arm, 10):
        plant.SetPositionsAndVelocities(context, np.concatenate([q, v]))
        inverse_dynamics(arm.table, q, v, vdot, tau)
        plant.get_applied_generalized_force_input_port().FixValue(context, tau)
        actual = plant.get_generalized_acceleration_output_port().Eval(context)
        np.testing.assert_allclose(actual, vdot, rtol=1e-9)


def test_tool_is_load_and_can_be_removed():
    plant, instance, frame = rx90_plant()
    arm = ArmModelFromPlant(plant, instance, frame)
    bare = ArmModelFromPlant(*rx90_plant(tool=False))
    tool = plant.GetBodyByName("tool").default_spatial_inertia()
    assert arm.phi_load[0] == 3.13
    np.testing.assert_allclose(arm.phi_load[1:4], tool.CalcComMoment(), atol=1e-15)
    rotational = tool.CalcRotationalInertia().CopyToFullMatrix3()
    np.testing.assert_allclose(arm.phi_load[4:], rotational[np.triu_indices(3)], atol=1e-15)
    np.testing.assert_array_equal(bare.phi_load, np.zeros(10))
    np.testing.assert_allclose(arm.with_load(np.zeros(10)).table, bare.table, atol=1e-15)
    np.testing.assert_allclose(bare.with_load(arm.phi_load).table, arm.table, atol=1e-15)


def test_limits_are_read_from_the_model():
    arm = ArmModelFromPlant(*other_plant())
    assert arm.joint_names == tuple(f"j{k}" for k in range(1, 8))
    np.testing.assert_array_equal(arm.lower, np.full(7, -2.0))
    np.testing.assert_array_equal(arm.upper, np.full(7, 2.5))
    np.testing.assert_array_equal(arm.velocity_limit, np.full(7, 3.0))
    np.testing.assert_array_equal(arm.acceleration_limit, np.full(7, np.inf))
    np.testing.assert_array_equal(arm.effort_limit, np.full(7, 40.0))


@pytest.mark.parametrize("slides", [False, True])
@pytest.mark.parametrize("given", [(), (9.0,), tuple(np.arange(1.0, 7.0))])
def test_missing_limits_of_a_joint_are_those_of_its_type(slides, given):
    """One joint has all limits, and each of the others lacks some."""
    arm, inf = ArmModelFromPlant(*rx90_plant()), np.inf
    table = arm.table.copy()
    table[:-1, IS_PRISMATIC_COLUMN] = slides
    half, speed = (1.0, 1.0) if slides else (np.pi, np.pi)
    acceleration = np.array([6.0, inf, 0.0, inf, 8.0, np.nan])
    incomplete = dataclasses.replace(
        arm,
        table=table,
        lower=np.array([-2.0, -inf, -inf, 0.5, -1.0, -2.0]),
        upper=np.array([2.5, inf, 0.8, inf, 3.0, 2.0]),
        velocity_limit=np.array([2.0, inf, 0.0, 1.5, np.nan, 4.0]),
        acceleration_limit=acceleration,
        effort_limit=np.array([7.0, 0.0, inf, 9.0, np.nan, 4.0]),
    )
    found, _ = fill_missing_joint_limits(incomplete, "arm", given)
    middle = half if slides else inf  # a joint without limits that rotates has none
    np.testing.assert_allclose(found.lower, [-2.0, -middle, 0.8 - 2 * half, 0.5, -1.0, -2.0])
    np.testing.assert_allclose(found.upper, [2.5, middle, 0.8, 0.5 + 2 * half, 3.0, 2.0])
    velocity = [2.0, speed, speed, 1.5, speed, 4.0]
    np.testing.assert_allclose(found.velocity_limit, velocity)
    np.testing.assert_allclose(found.effort_limit, [7.0, inf, inf, 9.0, inf, 4.0])
    expected = np.broadcast_to(given, 6) if given else np.divide(velocity, 0.4)
    if not given:
        expected[[0, 4]] = 6.0, 8.0
    np.testing.assert_allclose(found.acceleration_limit, expected)


def test_each_overloaded_joint_is_named():
    """Only one motor is too weak, and it is not that of the largest torque."""
    arm, q = ArmModelFromPlant(*other_plant()), np.linspace(0.4, -0.7, 7)
    torque = np.abs(holding_torque(arm, q))
    loaded = np.flatnonzero(torque > 1e-3)
    assert len(loaded) >= 5
    for joint in loaded:
        limit = 1.1 * torque + 1e-6
        check_inertia_and_holding_torque(dataclasses.replace(arm, effort_limit=limit), q)
        limit[joint] = 0.9 * torque[joint]
        with pytest.raises(DrakeTeleopError, match=rf"at the start: j{joint + 1} needs"):
            check_inertia_and_holding_torque(dataclasses.replace(arm, effort_limit=limit), q)


def test_weaker_of_two_motors_sets_effort_limit():
    plant = MultibodyPlant(0.0)
    (arm,) = Parser(plant).AddModelsFromString(other_arm_urdf(), "urdf")
    plant.AddJointActuator("second", plant.GetJointByName("j3", arm), effort_limit=7.0)
    plant.Finalize()
    limits = ArmModelFromPlant(plant, arm, "ft").effort_limit
    np.testing.assert_array_equal(limits, [40.0, 40.0, 7.0, 40.0, 40.0, 40.0, 40.0])


def test_chain_continues_through_gripper_to_finger():
    arm = ArmModelFromPlant(*other_plant()[:2], "finger")
    np.testing.assert_array_equal(arm.table[:, IS_PRISMATIC_COLUMN], [0, 0, 0, 0, 0, 0, 0, 1, 0])


def test_non_serial_chain_is_rejected():
    with pytest.raises(
        DrakeTeleopError, match=r"^sensor_frame_name: .* no frame 'elsewhere'; name one of .*sensor"
    ):
        ArmModelFromPlant(*rx90_plant()[:2], "elsewhere")
    with pytest.raises(DrakeTeleopError, match="joint to_camera: moves on link l3, but"):
        ArmModelFromPlant(*other_plant(last_joint="revolute"))
    with pytest.raises(DrakeTeleopError, match="weld the arm's base to the world"):
        ArmModelFromPlant(*other_plant(root="ground"))
