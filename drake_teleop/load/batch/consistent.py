"""Least squares fit restricted to physically consistent loads, Eqs. (T1), (T5)."""

from __future__ import annotations

from functools import cache
from threading import get_ident
from typing import Any

import numpy as np

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.load.inertia import is_physically_consistent, pseudo_inertia
from drake_teleop.load.normal_equations import unidentifiable_mass_error

_PSEUDO_INERTIA_BASIS = [pseudo_inertia(unit) for unit in np.eye(10)]
_PSEUDO_INERTIA_LMI_MATRICES = [np.zeros((4, 4)), *_PSEUDO_INERTIA_BASIS]
_PSEUDO_INERTIA_TO_PHI = np.linalg.pinv(np.reshape(_PSEUDO_INERTIA_BASIS, (10, 16)).T)  # (10, 16)
_MIN_LOAD_RADIUS_M = 1e-3  # lower bound of the length unit L [m]
# Eigenvalues relative to the largest: limit of information, and replacement of smaller ones.
_MIN_KEPT_EIGENVALUE, _RIDGE_EIGENVALUE = 1e-12, 1e-12


def consistent_least_squares(gram: Array, right: Array, theta: Array) -> Array:
    """Return [offsets; phi] (16,) of the best-fitting physically consistent load.

    `theta` (16,), the solution of gram theta = right, is returned if it is consistent, or if load
    and offsets cannot be separated.
    """
    if is_physically_consistent(theta[6:]):
        return theta
    unit = _natural_scales_of_phi(theta[6:])
    cross = gram[:6, 6:]
    offsets = np.linalg.solve(gram[:6, :6], np.column_stack([right[:6], cross]))
    reduced = (gram[6:, 6:] - cross.T @ offsets[:, 1:]) * np.outer(unit, unit)
    largest_diagonal = float((np.diag(gram)[6:] * unit**2).max())
    if np.abs(reduced).max() <= _MIN_KEPT_EIGENVALUE * largest_diagonal:
        return theta  # the record cannot separate load and offsets
    linear = (right[6:] - cross.T @ offsets[:, 0]) * unit
    phi = unit * _solve_consistent_fit(0.5 * (reduced + reduced.T), linear)
    return np.concatenate([offsets[:, 0] - offsets[:, 1:] @ phi, phi])


def _natural_scales_of_phi(phi: Array) -> Array:
    m = abs(phi[0])
    if m == 0.0:
        raise unidentifiable_mass_error("the fitted mass is 0")
    spread = max(0.0, 0.5 * (phi[4] + phi[7] + phi[9]) / m)
    L = max(_MIN_LOAD_RADIUS_M, float(np.linalg.norm(phi[1:4])) / m, np.sqrt(spread))
    return m * np.repeat([1.0, L, L * L], [1, 3, 6])


def _solve_consistent_fit(H: Array, b: Array) -> Array:
    program, x, cone, solver = _make_cone_program_for_thread(get_ident())
    cone.UpdateCoefficients(*_distance_cone_coefficients(H, b))
    result = solver.Solve(program)
    if not result.is_success():
        what = f"the semidefinite program has no solution ({result.get_solution_result().name})"
        remedy = "check the sign of the wrench, and that the load moves"
        raise DrakeTeleopError(what, where="consistent", remedy=remedy)
    # The solver's tolerance leaves eigenvalues of about -1e-9.
    values, vectors = np.linalg.eigh(np.tensordot(result.GetSolution(x), _PSEUDO_INERTIA_BASIS, 1))
    J = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return np.asarray(_PSEUDO_INERTIA_TO_PHI @ J.ravel(), np.float64)


@cache
def _make_cone_program_for_thread(thread_id: int) -> tuple[Any, Any, Any, Any]:
    # Imported here because the rest of the package starts ten times faster without Drake.
    from pydrake.solvers import ClarabelSolver, MathematicalProgram

    program = MathematicalProgram()
    x, t = program.NewContinuousVariables(10), program.NewContinuousVariables(1)
    program.AddLinearMatrixInequalityConstraint(_PSEUDO_INERTIA_LMI_MATRICES, x)
    program.AddLinearCost([1.0], t)
    A, b = np.eye(11, 11, 10), np.zeros(11)
    cone = program.AddLorentzConeConstraint(A, b, np.append(x, t)).evaluator()
    return program, x, cone, ClarabelSolver()


def _distance_cone_coefficients(H: Array, b: Array) -> tuple[Array, Array]:
    """Return A, c: A [x; t] + c is in the Lorentz cone if t >= |R x - d|, R^T R ~ H, R^T d ~ b."""
    values, vectors = np.linalg.eigh(H)
    scale = values[-1]
    values = values / scale
    root = np.sqrt(np.maximum(values, _RIDGE_EIGENVALUE))
    cone, constants = np.zeros((11, 11)), np.zeros(11)
    cone[0, 10], cone[1:, :10] = 1.0, root[:, None] * vectors.T
    constants[1:] = -np.where(values > _MIN_KEPT_EIGENVALUE, vectors.T @ b / root, 0.0) / scale
    return cone, constants
