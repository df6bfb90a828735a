"""Vector functions against NumPy, in Python, compiled, and with Drake's other scalars."""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit
from pydrake.autodiffutils import ExtractGradient, InitializeAutoDiff
from pydrake.symbolic import MakeVectorVariable

from drake_teleop.common import vectors
from drake_teleop.load.regressor import non_contact_wrench, non_contact_wrench_into, regressor

a, b, c = np.array([[0.3, -1.2, 2.5], [-0.7, 0.4, 1.1], [5.0, -6.0, 7.0]])
R = np.linalg.qr(np.array([[1.0, 2.0, 0.5], [-0.3, 1.0, 4.0], [2.0, 0.1, 1.0]]))[0]
phi = np.array([2.0, 0.1, -0.2, 0.3, 0.05, 0.01, -0.02, 0.06, 0.003, 0.07])
INERTIA = np.array([[0.05, 0.01, -0.02], [0.01, 0.06, 0.003], [-0.02, 0.003, 0.07]])


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize(
    ("function", "arguments", "expected"),
    [
        (vectors.vector_at, (phi, 1), phi[1:4]),
        (vectors.matrix_at, (phi, 1), phi[1:]),
        (vectors.matrix_as_tuple, (R,), R.ravel()),
        (vectors.transposed, (R.ravel(),), R.T.ravel()),
        (vectors.plus, (a, b), a + b),
        (vectors.minus, (a, b), a - b),
        (vectors.scale_vector, (3.0, b), 3 * b),
        (vectors.dot, (a, b), a @ b),
        (vectors.cross, (a, b), np.cross(a, b)),
        (vectors.add_cross_product, (c, a, b), c + np.cross(a, b)),
        (vectors.apply_matrix, (R.ravel(), a), R @ a),
        (vectors.symmetric_matrix_at, (phi, 4), INERTIA.ravel()),
    ],
)
def test_vector_functions_equal_numpy(function, arguments, expected, compiled):
    if compiled:
        function = njit(function)
    np.testing.assert_allclose(function(*arguments), expected, rtol=1e-15, atol=1e-15)


def test_add_into_changes_only_the_given_index():
    x = np.zeros(6)
    vectors.add_vector_into(x, 2, a)
    vectors.add_vector_into(x, 2, b)
    np.testing.assert_array_equal(x, [0, 0, *(a + b), 0])


@njit
def solved(M, b, n):
    vectors.solve_by_cholesky(M, b, n)


@pytest.mark.slow
@pytest.mark.parametrize("n", [1, 3, 6])
def test_cholesky_and_solve_equal_numpy_and_read_the_lower_half(n):
    random = np.random.default_rng(n)
    root, right = random.normal(size=(n, n)), random.normal(size=n)
    M = root @ root.T + np.eye(n)
    lower, x = np.where(np.tri(n) > 0, M, np.nan), right.copy()
    solved(lower, x, n)
    np.testing.assert_allclose(x, np.linalg.solve(M, right), rtol=1e-10)
    np.testing.assert_allclose(np.tril(lower), np.linalg.cholesky(M), rtol=1e-10)
    vectors.solve_by_cholesky(M, right, n)
    np.testing.assert_allclose(right, x, rtol=1e-14)


def test_cross_matrix_of_one_and_many_vectors():
    np.testing.assert_allclose(vectors.cross_matrix(a) @ b, np.cross(a, b), rtol=1e-15)
    many = np.array([[a, c], [c, a]])
    np.testing.assert_allclose(vectors.cross_matrix(many) @ b, np.cross(many, b), atol=1e-14)


def test_wrench_accepts_autodiff_and_expressions():
    s, omega, alpha = a, b, c
    derived, wrench = InitializeAutoDiff(phi).ravel(), np.empty(6, dtype=object)
    non_contact_wrench_into.py_func(s, omega, alpha, derived, wrench)
    np.testing.assert_allclose(ExtractGradient(wrench), regressor(s, omega, alpha), atol=1e-14)
    symbols = MakeVectorVariable(10, "phi")
    non_contact_wrench_into.py_func(s, omega, alpha, symbols, wrench)
    values = dict(zip(symbols, phi, strict=True))
    np.testing.assert_allclose(
        [entry.Evaluate(values) for entry in wrench],
        non_contact_wrench(s, omega, alpha, phi),
        rtol=1e-13,
    )
