"""The SDF of the Phantom compared with the closed forms."""

from __future__ import annotations

import numpy as np
import phantom_arrays as arrays
import pytest
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant

from drake_teleop.common.files import models_dir
from drake_teleop.station.master import phantom

#: qdot of the serial tree = SERIAL @ qdot of the device.
SERIAL = np.eye(6)
SERIAL[2, 1] = -1.0


@pytest.fixture(scope="module")
def plant() -> MultibodyPlant:
    plant = MultibodyPlant(time_step=0.0)
    Parser(plant).AddModels(str(models_dir() / "phantom.sdf"))
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base"))
    plant.Finalize()
    return plant


def postures() -> np.ndarray:
    """Return postures inside the end stops."""
    return np.random.default_rng(0).uniform(-0.45, [1.0, 0.45, 0.5, 1.5, 1.5, 1.5], (30, 6))


def test_sdf_has_the_kinematics_of_the_device(plant):
    context = plant.CreateDefaultContext()
    for q in postures():
        plant.SetPositions(context, phantom.serial_joint_angles(q))
        X_BE = plant.GetFrameByName("stylus").CalcPoseInWorld(context)
        pose = arrays.forward_kinematics(q)
        np.testing.assert_allclose(X_BE.translation(), pose[4:], atol=1e-14)
        sign = np.sign(X_BE.rotation().ToQuaternion().wxyz() @ pose[:4])
        np.testing.assert_allclose(
            sign * X_BE.rotation().ToQuaternion().wxyz(), pose[:4], atol=1e-14
        )


def test_sdf_has_the_mass_matrix_and_coriolis_forces_of_the_device(plant):
    """Drake's multibody dynamics check the closed forms independently."""
    rng = np.random.default_rng(1)
    context = plant.CreateDefaultContext()
    still = np.zeros(6)
    no_friction = arrays.PHANTOM.packed_parameters.copy()[0]
    no_friction.dry_friction = no_friction.damping = still
    for q in postures():
        v = rng.normal(size=6)
        plant.SetPositions(context, phantom.serial_joint_angles(q))
        plant.SetVelocities(context, SERIAL @ v)
        mass = SERIAL.T @ plant.CalcMassMatrix(context) @ SERIAL
        np.testing.assert_allclose(mass, arrays.mass_matrix(q), atol=1e-11)
        vdot = np.empty(6)
        phantom.joint_acceleration_into(
            q, v, np.zeros(6), arrays.gravity_torque(q), no_friction, np.empty((2, 6, 6)), vdot
        )
        coriolis = SERIAL.T @ plant.CalcBiasTerm(context)
        np.testing.assert_allclose(-arrays.mass_matrix(q) @ vdot, coriolis, atol=1e-10)


def test_sdf_lacks_only_the_counterweight_of_the_outer_link(plant):
    context = plant.CreateDefaultContext()
    for q in postures():
        plant.SetPositions(context, phantom.serial_joint_angles(q))
        held = -SERIAL.T @ plant.CalcGravityGeneralizedForces(context)
        missing = arrays.gravity_torque(q) - held
        lever = 0.0249 * 0.0325 / 2 - 0.1906 * 0.0527
        np.testing.assert_allclose(missing[2], 9.81 * lever * np.sin(q[2]), atol=1e-11)
        np.testing.assert_allclose(missing[[0, 1, 3, 4, 5]], 0, atol=1e-11)


def test_sdf_has_the_limits_of_the_device(plant):
    lower, upper = plant.GetPositionLowerLimits(), plant.GetPositionUpperLimits()
    independent = [0, 1, 3, 4, 5]
    np.testing.assert_allclose(lower[independent], phantom.JOINT_LOWER_RAD[independent], atol=1e-6)
    np.testing.assert_allclose(upper[independent], phantom.JOINT_UPPER_RAD[independent], atol=1e-6)
    np.testing.assert_allclose([-upper[2], -lower[2]], phantom.Q2_MINUS_Q3_RANGE_RAD, atol=1e-6)
    np.testing.assert_allclose(
        plant.GetEffortUpperLimits()[3:], phantom.PEAK_WRIST_TORQUES_N_M, atol=1e-12
    )
