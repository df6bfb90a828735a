"""Inertial parameters phi and their equivalent forms."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from load_cases import TOOL, loads, rotations, vectors

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.inertia import (
    inertia_about_origin,
    is_physically_consistent,
    mass_com_inertia,
    phi_from_mass_com_inertia,
    phi_from_pseudo_inertia,
    pseudo_inertia,
    transform_phi,
)


def point_masses(masses, positions):
    """Return phi of point masses by the definition of the inertia tensor."""
    phi = np.zeros(10)
    for m, r in zip(masses, positions, strict=True):
        tensor = m * (r @ r * np.eye(3) - np.outer(r, r))
        phi += np.concatenate([[m], m * r, tensor[np.triu_indices(3)]])
    return phi


def test_parallel_axis_of_a_box():
    m, sides, p = 2.0, np.array([0.1, 0.2, 0.3]), np.array([0.05, -0.1, 0.2])
    about_com = m / 12.0 * np.diag([0.04 + 0.09, 0.01 + 0.09, 0.01 + 0.04])
    phi = phi_from_mass_com_inertia(m, p, about_com)
    # The box as 8 points at +-sides / sqrt(12): same mass, centre and second moments.
    corners = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T * sides / np.sqrt(12.0)
    np.testing.assert_allclose(phi, point_masses(np.full(8, m / 8), p + corners), atol=1e-15)
    assert phi[5] == pytest.approx(-m * p[0] * p[1])  # a product is the tensor's entry


@given(loads())
def test_mass_com_inertia_round_trip(phi):
    np.testing.assert_allclose(
        phi_from_mass_com_inertia(*mass_com_inertia(phi)), phi, rtol=1e-9, atol=1e-9
    )


@given(vectors(10))
def test_pseudo_inertia_round_trip(phi):
    J = pseudo_inertia(phi)
    np.testing.assert_array_equal(J, J.T)
    np.testing.assert_allclose(phi_from_pseudo_inertia(J), phi, rtol=0, atol=1e-13)
    np.testing.assert_allclose(
        J[:3, :3], 0.5 * np.trace(inertia_about_origin(phi)) * np.eye(3) - inertia_about_origin(phi)
    )


@given(rotations(), vectors(3, 1.0), st.integers(0, 1000))
def test_transform_equals_that_of_point_masses(R_AB, p_AoBo_A, seed):
    rng = np.random.default_rng(seed)
    masses, r_B = rng.uniform(0.1, 1.0, 5), rng.uniform(-1.0, 1.0, (5, 3))
    expected = point_masses(masses, r_B @ R_AB.T + p_AoBo_A)
    actual = transform_phi(point_masses(masses, r_B), R_AB, p_AoBo_A)
    np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-12)


@given(loads(), rotations(), vectors(3, 1.0))
def test_inverse_transform_restores_phi(phi, R_AB, p_AoBo_A):
    there = transform_phi(phi, R_AB, p_AoBo_A)
    back = transform_phi(there, R_AB.T, -R_AB.T @ p_AoBo_A)
    np.testing.assert_allclose(back, phi, rtol=0, atol=1e-11)
    assert is_physically_consistent(there, tolerance=1e-9)


@pytest.mark.parametrize(
    ("phi", "consistent"),
    [
        (TOOL, True),
        (np.zeros(10), True),
        (point_masses([2.0], [np.array([0.1, 0.2, -0.3])]), True),
        (point_masses([1.0], [np.zeros(3)]), True),
        (point_masses([1e-3, 1e-3], [np.zeros(3), np.array([1e-3, 0, 0])]), True),
        (-TOOL, False),
        (phi_from_mass_com_inertia(1.0, np.zeros(3), np.diag([1.0, 1.0, 2.1])), False),
        (phi_from_mass_com_inertia(1.0, np.zeros(3), np.diag([1.0, 1.0, 1.9])), True),
        (phi_from_mass_com_inertia(1.0, np.zeros(3), np.diag([-1.0, 1.0, 1.0])), False),
        (np.array([1.0, 0, 0, 0.04, 0, 0, 0, 0, 0, 0]), False),
        (np.array([0.0, 0, 0, 0.04, 0, 0, 0, 0, 0, 0]), False),
    ],
)
def test_physical_consistency(phi, consistent):
    assert is_physically_consistent(phi) is consistent
    # The result is the same in grams and millimetres.
    scale = np.repeat([1e3, 1e6, 1e9], [1, 3, 6])
    assert is_physically_consistent(scale * phi) is consistent


def test_tolerance_accepts_loads_just_outside():
    phi = phi_from_mass_com_inertia(1.0, np.zeros(3), np.diag([1.0, 1.0, 2.0 + 1e-6]))
    assert not is_physically_consistent(phi)
    # The least eigenvalue of Sigma is -5e-7 and its trace 2, for any mass.
    for mass in (1e-3, 1.0, 1e3):
        assert is_physically_consistent(mass * phi, tolerance=2.6e-7)
        assert not is_physically_consistent(mass * phi, tolerance=2.4e-7)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: phi_from_mass_com_inertia(np.nan, np.zeros(3), np.eye(3)), "^mass: is not finite"),
        (lambda: phi_from_mass_com_inertia(1.0, np.zeros(2), np.eye(3)), r"^p_SoBcm_S: .*\(2,\)"),
        (
            lambda: phi_from_mass_com_inertia(1.0, np.zeros(3), np.triu(np.ones((3, 3)))),
            "^I_BBcm_S: the inertia tensor is not symmetric",
        ),
        (lambda: mass_com_inertia(np.zeros(10)), "mass is 0"),
        (lambda: phi_from_pseudo_inertia(np.triu(np.ones((4, 4)))), "^J: .*not symmetric"),
        (lambda: transform_phi(TOOL, 2 * np.eye(3), np.zeros(3)), "^R_AB: is not a rotation"),
        (lambda: transform_phi(TOOL, -np.eye(3), np.zeros(3)), "^R_AB: is not a rotation"),
    ],
)
def test_error_names_the_invalid_input(call, message):
    with pytest.raises(DrakeTeleopError, match=message):
        call()
