"""Least squares over physically consistent loads by a semidefinite program."""

from __future__ import annotations

import numpy as np
import pytest
from load_cases import OFFSETS, TOOL, rich_motion

from drake_teleop.load.batch.consistent import consistent_least_squares
from drake_teleop.load.batch.total_least_squares import total_least_squares
from drake_teleop.load.inertia import (
    is_physically_consistent,
    phi_from_mass_com_inertia,
    pseudo_inertia,
)
from drake_teleop.load.normal_equations import NoiseStd, SecondMoments
from drake_teleop.load.regressor import non_contact_wrench

ROD = phi_from_mass_com_inertia(0.009, [0, 0.002, 0.06], np.diag([5e-5, 5e-5, 0.0]))
PLATE = phi_from_mass_com_inertia(0.3, [0, 0.01, 0.1], np.diag([1e-3, 2e-3, 3e-3]))
CENTRED = phi_from_mass_com_inertia(0.009, [0, 0, 0], np.diag([5e-5, 5e-5, 0.0]))
POINT = phi_from_mass_com_inertia(1.0, [0, 0.01, 0.1], np.zeros((3, 3)))
WRENCH_NOISE = np.array([0.1] * 3 + [0.005] * 3)


def normal_form_of(phi, noise=0.0, seed=0):
    motion = rich_motion(500)
    F = OFFSETS + non_contact_wrench(*motion, phi)
    F = F + noise * WRENCH_NOISE * np.random.default_rng(seed).normal(size=F.shape)
    moments = SecondMoments()
    moments.add_samples(F, *motion)
    return total_least_squares(moments, NoiseStd(), WRENCH_NOISE)


def inconsistent_fit(phi, noise, number=0):
    """Return the first fit to noisy data, over seeds, that is no possible body."""
    fits = (normal_form_of(phi, noise, seed) for seed in range(100))
    impossible = (form for form in fits if not is_physically_consistent(form.theta[6:]))
    return [next(impossible) for _ in range(number + 1)][-1]


def consistent(form):
    return consistent_least_squares(form.gram, form.right, form.theta)


def test_consistent_fit_is_unchanged():
    form = normal_form_of(TOOL, noise=0.1)
    np.testing.assert_array_equal(consistent(form), form.theta)


@pytest.mark.parametrize("phi", [ROD, PLATE, POINT])
def test_limiting_consistent_load_is_exact_without_noise(phi):
    # A little noise makes least squares inconsistent, so that the program is solved.
    form = inconsistent_fit(phi, 1e-6)
    found = consistent(form)[6:]
    assert is_physically_consistent(found)
    scale = np.repeat([phi[0], np.linalg.norm(phi[1:4]), np.abs(phi[4:]).max()], [1, 3, 6])
    assert np.abs((found - phi) / scale).max() < 1e-6


@pytest.mark.parametrize("phi", [TOOL, ROD, CENTRED])
def test_result_is_independent_of_the_unit_of_length(phi):
    form = inconsistent_fit(phi, 1e-6 if phi is not TOOL else 100.0)
    metres = np.repeat([1.0, 1e-3, 1e-6], [7, 3, 6])  # of the parameters' units, in mm
    found = consistent_least_squares(
        np.outer(metres, metres) * form.gram, metres * form.right, form.theta / metres
    )
    expected = consistent(form)
    assert np.abs(expected - form.theta)[10:].max() > 0.0  # fails unless the program is solved
    size = np.linalg.norm(expected[6:])
    np.testing.assert_allclose((found * metres)[6:], expected[6:], rtol=1e-9, atol=1e-11 * size)


@pytest.mark.parametrize("seed", range(5))
def test_result_has_the_least_cost_of_all_consistent_loads(seed):
    form = inconsistent_fit(PLATE, 10.0, number=seed)
    found = consistent(form)
    assert is_physically_consistent(found[6:])

    def cost(theta):
        return theta @ form.gram @ theta - 2.0 * form.right @ theta

    # Optimality: small steps towards other consistent loads, including the true one, cost more.
    rng = np.random.default_rng(seed)
    for _ in range(50):
        other = found.copy()
        J = pseudo_inertia(found[6:])
        values, vectors = np.linalg.eigh(J)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        root = root @ (np.eye(4) + 1e-2 * rng.normal(size=(4, 4)))
        J = root @ root.T
        S = J[:3, :3]
        inertia = np.trace(S) * np.eye(3) - S
        other[6:] = np.concatenate([[J[3, 3]], J[:3, 3], inertia[np.triu_indices(3)]])
        assert cost(other) > cost(found) - 1e-9 * abs(cost(found))
