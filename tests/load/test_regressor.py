"""V of Eq. (5) and the direct form against Eqs. (1)-(2), Pinocchio and Drake."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from load_cases import TOOL, loads, motions, rich_motion, rotations, vectors
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import MultibodyForces, SpatialInertia, UnitInertia

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.inertia import inertia_about_origin, transform_phi
from drake_teleop.load.regressor import (
    non_contact_wrench,
    non_contact_wrench_into,
    regressor,
    regressor_into,
)


def newton_euler(a, g, omega, alpha, phi):
    """Return the wrench by Eqs. (1) and (2)."""
    m, mc, I = phi[0], phi[1:4], inertia_about_origin(phi)  # noqa: E741
    f = m * a - m * g + np.cross(alpha, mc) + np.cross(omega, np.cross(omega, mc))
    tau = I @ alpha + np.cross(omega, I @ omega) + np.cross(mc, a) - np.cross(mc, g)
    return np.concatenate([f, tau])


def assert_close(actual, expected, relative=1e-12):
    assert np.abs(actual - expected).max() <= relative * max(1.0, np.abs(expected).max())


@given(vectors(3, 20.0), motions(), vectors(10))
def test_both_forms_equal_newton_euler(g, motion, phi):
    s, omega, alpha = motion
    expected = newton_euler(s + g, g, omega, alpha, phi)
    assert_close(regressor(s, omega, alpha) @ phi, expected)
    assert_close(non_contact_wrench(s, omega, alpha, phi), expected)


def test_at_rest_the_sensor_carries_the_weight():
    g = np.array([0.0, 0.0, -9.81])
    wrench = non_contact_wrench(-g, np.zeros(3), np.zeros(3), TOOL)
    np.testing.assert_allclose(wrench[:3], -3.13 * g)
    np.testing.assert_allclose(wrench[3:], np.cross(TOOL[1:4], -g))


def test_pinocchio_has_the_same_body_regressor():
    """24 motions determine every coefficient of s, alpha and the products of omega.

    The reference is a stored result of Pinocchio 4.1, whose installation takes long:
    `pin.bodyRegressor(pin.Motion(v, omega), pin.Motion(s - np.cross(omega, v), alpha))`, any v.
    """
    columns = [0, 1, 2, 3, 4, 5, 7, 6, 8, 9]  # Pinocchio: Ixx, Ixy, Iyy, Ixz, Iyz, Izz
    cases = json.loads((Path(__file__).parent / "pinocchio.json").read_text())
    monomials = []
    for case in cases:
        s, omega, alpha = (np.array(case[name]) for name in ("s", "omega", "alpha"))
        assert_close(regressor(s, omega, alpha), np.array(case["V"])[:, columns])
        products = np.outer(omega, omega)[np.triu_indices(3)]
        monomials.append(np.concatenate([[1.0], s, omega, alpha, products]))
    assert np.linalg.matrix_rank(monomials) == 16


@given(motions(), rotations(), vectors(3, 0.2))
def test_wrench_equals_inverse_dynamics_of_drake(motion, R_WS, p_WS):
    s, omega, alpha = motion
    plant = MultibodyPlant(0.0)
    com, m = TOOL[1:4] / TOOL[0], TOOL[0]
    xx, xy, xz, yy, yz, zz = TOOL[4:] / m
    body = plant.AddRigidBody("load", SpatialInertia(m, com, UnitInertia(xx, yy, zz, xy, xz, yz)))
    plant.Finalize()
    context = plant.CreateDefaultContext()
    R = RotationMatrix.ProjectToRotationMatrix(R_WS)
    plant.SetFreeBodyPose(context, body, RigidTransform(R, p_WS))
    plant.SetVelocities(context, np.concatenate([R.matrix() @ omega, [0.4, -1.0, 0.2]]))
    gravity = plant.gravity_field().gravity_vector()
    acceleration = np.concatenate([R.matrix() @ alpha, R.matrix() @ s + gravity])
    forces = MultibodyForces(plant)
    plant.CalcForceElementsContribution(context, forces)
    generalized = plant.CalcInverseDynamics(context, acceleration, forces)  # [tau; f] in W
    tau, f = R.matrix().T @ generalized[:3], R.matrix().T @ generalized[3:]
    assert_close(non_contact_wrench(s, omega, alpha, TOOL), np.concatenate([f, tau]))


@pytest.mark.slow
@given(motions(), loads(), rotations(), vectors(3, 1.0))
def test_wrench_is_transformed_with_frame_and_point(motion, phi_B, R_AB, p_AoBo_A):
    s_B, omega_B, alpha_B = motion
    f_B, tau_B = np.split(non_contact_wrench(s_B, omega_B, alpha_B, phi_B), 2)
    omega, alpha, p = R_AB @ omega_B, R_AB @ alpha_B, p_AoBo_A
    s = R_AB @ s_B - np.cross(alpha, p) - np.cross(omega, np.cross(omega, p))
    expected = np.concatenate([R_AB @ f_B, R_AB @ tau_B + np.cross(p, R_AB @ f_B)])
    phi_A = transform_phi(phi_B, R_AB, p_AoBo_A)
    # The wrench may be small compared with its terms of size phi |s|.
    size = np.abs(phi_A).max() * np.abs(regressor(s, omega, alpha)).max()
    difference = np.abs(non_contact_wrench(s, omega, alpha, phi_A) - expected)
    assert difference.max() <= 1e-11 * max(1.0, size)


@given(motions(), loads(), loads(), st.floats(0.0, 5.0))
def test_wrenches_of_parts_add(motion, phi_1, phi_2, factor):
    whole = non_contact_wrench(*motion, phi_1 + factor * phi_2)
    parts = non_contact_wrench(*motion, phi_1) + factor * non_contact_wrench(*motion, phi_2)
    np.testing.assert_allclose(whole, parts, rtol=1e-10, atol=1e-8)


def test_one_sample_and_many_are_the_same_to_the_last_bit():
    motion = rich_motion(60)
    V, wrench = regressor(*motion), non_contact_wrench(*motion, TOOL)
    assert V.shape == (60, 6, 10) and wrench.shape == (60, 6)
    for i, sample in enumerate(zip(*motion, strict=True)):
        V_i, wrench_i = np.full((6, 10), np.nan), np.full(6, np.nan)
        regressor_into(*sample, V_i)
        non_contact_wrench_into(*sample, TOOL, wrench_i)
        np.testing.assert_array_equal(V[i], V_i)
        np.testing.assert_array_equal(wrench[i], wrench_i)


def test_leading_dimensions_are_broadcast():
    s, omega, alpha = rich_motion(12)
    grid = [x.reshape(3, 4, 3) for x in (s, omega, alpha)]
    assert regressor(*grid).shape == (3, 4, 6, 10)
    np.testing.assert_array_equal(
        non_contact_wrench(*grid, TOOL).reshape(12, 6), non_contact_wrench(s, omega, alpha, TOOL)
    )
    rest = np.zeros(3)
    np.testing.assert_array_equal(
        non_contact_wrench(s, rest, rest, TOOL),
        non_contact_wrench(s, 0 * s, 0 * s, TOOL),
    )
    assert non_contact_wrench(np.empty((0, 3)), rest, rest, TOOL).shape == (0, 6)


@pytest.mark.parametrize(
    ("s", "omega", "phi", "message"),
    [
        (np.zeros((5, 2)), np.zeros(3), TOOL, r"^s: has shape \(5, 2\) instead of \(\.\.\., 3\)"),
        (np.zeros((5, 3)), np.zeros((4, 3)), TOOL, r"numbers of samples differ.*omega \(4, 3\)"),
        ([0, 0, np.nan], np.zeros(3), TOOL, r"^s: is not finite at index \(2,\)"),
        (np.zeros(3), "fast", TOOL, r"^omega: contains no real numbers"),
        (np.zeros(3), np.zeros(3), np.zeros(9), r"^phi: has shape \(9,\) instead of \(10,\)"),
        (np.zeros(3), np.zeros(3), np.full(10, np.inf), r"^phi: is not finite"),
    ],
)
def test_error_names_the_invalid_input(s, omega, phi, message):
    with pytest.raises(DrakeTeleopError, match=message):
        non_contact_wrench(s, omega, np.zeros(3), phi)
