"""Least squares fit among loads that a rigid body can have, Eqs. (T1), (T5)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from threading import get_ident
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array, finite_array
from drake_teleop.load.inertia import is_physically_consistent, pseudo_inertia

_PSEUDO_INERTIA_BASIS = [pseudo_inertia(unit) for unit in np.eye(10)]
_CONSTRAINT_MATRICES = [np.zeros((4, 4)), *_PSEUDO_INERTIA_BASIS]
_PHI_FROM_PSEUDO_INERTIA = np.linalg.pinv(np.reshape(_PSEUDO_INERTIA_BASIS, (10, 16)).T)  # (10, 16)
_MIN_LENGTH_UNIT_M = 1e-3  # lower bound of the length unit L [m]
# Eigenvalues relative to the largest: limit of information, and replacement of smaller ones.
_MIN_EIGENVALUE, _RIDGE_EIGENVALUE = 1e-12, 1e-12
_PRIOR_KINDS = ("entropic", "geodesic")


@dataclass(frozen=True, eq=False)
class Prior:
    """Prior knowledge of the load, which adds a cost to the least squares fit.

    Attributes:
        phi: (10,) prior load about So in S, of a body with extent in all directions.
        weight: factor of the cost per sample, relative to squared normalised residuals.
        kind: cost of the pseudo-inertia J: "entropic" (Lee, Wensing, Park, T-RO 2020) or "geodesic"
            (Lee, Park, RA-L 2018).
    """

    phi: ArrayLike
    weight: float
    kind: str = "entropic"

    def __post_init__(self) -> None:
        if self.kind not in _PRIOR_KINDS:
            raise DrakeTeleopError(
                f"{self.kind!r} is unknown",
                where="prior.kind",
                remedy=f"choose {' or '.join(_PRIOR_KINDS)}",
            )
        if not 0.0 < self.weight < np.inf:
            raise DrakeTeleopError(
                f"{self.weight} is not positive and finite",
                where="prior.weight",
                remedy="give a number above 0",
            )
        if np.linalg.eigvalsh(pseudo_inertia(self.phi))[0] <= 0.0:
            raise DrakeTeleopError(
                "is the load of a body that has no extent in some direction",
                where="prior.phi",
                remedy="give a body with mass, and inertia about all axes",
            )

    def inverse_covariance(self, samples: int) -> Array:
        """Return the inverse covariance (10, 10) of phi that the prior contributes."""
        parts = np.linalg.solve(
            pseudo_inertia(finite_array("prior.phi", self.phi, 10)), _PSEUDO_INERTIA_BASIS
        )
        return np.asarray(samples * self.weight * np.einsum("aij,bji->ab", parts, parts))


@dataclass(frozen=True, eq=False)
class Ellipsoid:
    """Ellipsoid that encloses the load's mass: (r - center)^T matrix (r - center) <= 1.

    Attributes:
        center: (3,) position of the centre from So, in S [m].
        matrix: (3, 3) shape, positive definite [1/m^2].
    """

    center: ArrayLike
    matrix: ArrayLike

    def constraint_row(self) -> Array:
        """Return the row a (10,) with a^T phi >= 0 if the mass of phi is inside the ellipsoid."""
        A, c = (
            finite_array("ellipsoid.matrix", self.matrix, 3, 3),
            finite_array("center", self.center, 3),
        )
        if np.abs(A - A.T).max() > 1e-9 * np.abs(A).max() or np.linalg.eigvalsh(A)[0] <= 0.0:
            raise DrakeTeleopError(
                "is not positive definite",
                where="ellipsoid.matrix",
                remedy="give a symmetric matrix with positive eigenvalues",
            )
        E = np.block([[-A, (A @ c)[:, None]], [A @ c, 1.0 - c @ A @ c]])
        return np.array([np.sum(unit * E) for unit in _PSEUDO_INERTIA_BASIS])


def consistent_least_squares(
    gram: Array,
    right: Array,
    theta: Array,
    prior: Prior | None = None,
    ellipsoid: Ellipsoid | None = None,
) -> Array:
    """Return [offsets; phi] (16,) of the rigid body that fits best.

    `theta` (16,) is the unconstrained solution of the weighted normal equations `gram` and
    `right`.
    """
    row = None if ellipsoid is None else ellipsoid.constraint_row()
    inside = row is None or row @ theta[6:] >= 0.0
    if prior is None and inside and is_physically_consistent(theta[6:]):
        return theta
    unit = _parameter_units(
        theta[6:] if prior is None else finite_array("prior.phi", prior.phi, 10)
    )
    cross = gram[:6, 6:]
    offsets = np.linalg.solve(gram[:6, :6], np.column_stack([right[:6], cross]))
    reduced = (gram[6:, 6:] - cross.T @ offsets[:, 1:]) * np.outer(unit, unit)
    largest_diagonal = float((np.diag(gram)[6:] * unit**2).max())
    if prior is None and np.abs(reduced).max() <= _MIN_EIGENVALUE * largest_diagonal:
        return theta  # the record cannot separate load and offsets
    linear = (right[6:] - cross.T @ offsets[:, 0]) * unit
    phi = unit * _solve_consistent_fit(0.5 * (reduced + reduced.T), linear, unit, prior, row)
    return np.concatenate([offsets[:, 0] - offsets[:, 1:] @ phi, phi])


def _parameter_units(phi: Array) -> Array:
    m = abs(phi[0])
    if m == 0.0:
        raise DrakeTeleopError(
            "the fitted mass is 0: the mass cannot be identified from this wrench",
            where="wrench",
            remedy="check that the sensor is connected and its orientation changes",
        )
    spread = max(0.0, 0.5 * (phi[4] + phi[7] + phi[9]) / m)
    L = max(_MIN_LENGTH_UNIT_M, float(np.linalg.norm(phi[1:4])) / m, np.sqrt(spread))
    return m * np.repeat([1.0, L, L * L], [1, 3, 6])


def _solve_consistent_fit(
    H: Array, b: Array, unit: Array, prior: Prior | None, row: Array | None
) -> Array:
    entropic = prior is not None and prior.kind == "entropic"
    if prior is not None:
        J0_inverse = np.linalg.inv(pseudo_inertia(finite_array("prior.phi", prior.phi, 10) / unit))
        scaled = [J0_inverse @ part for part in _PSEUDO_INERTIA_BASIS]
        pull = prior.weight * np.array([np.trace(part) for part in scaled])
        if prior.kind == "geodesic":
            H = H + prior.weight * np.einsum("aij,bji->ab", scaled, scaled)
        b = b + (-pull if entropic else pull)
    if not entropic and row is None:
        problem = _cached_distance_program(get_ident())
    else:
        problem = _make_cone_program(distance=not entropic)
    program, x, cone, solver = problem
    if row is not None:
        normalised = row * unit / np.abs(row * unit).max()
        program.AddLinearConstraint(normalised[None, :], [0.0], [np.inf], x)
    if entropic:
        assert prior is not None
        scale = 10.0 / np.trace(H)
        program.AddQuadraticCost(scale * H, -scale * b, x, is_convex=True)
        _add_log_det_cost(program, x, prior.weight * scale)
    else:
        cone.UpdateCoefficients(*_distance_cone_coefficients(H, b))
    result = solver.Solve(program)
    if not result.is_success():
        raise DrakeTeleopError(
            f"the semidefinite program has no solution ({result.get_solution_result().name})",
            where="consistent",
            remedy="check the sign of the wrench, and that the load moves",
        )
    # The solver's tolerance leaves eigenvalues of about -1e-9.
    values, vectors = np.linalg.eigh(np.tensordot(result.GetSolution(x), _PSEUDO_INERTIA_BASIS, 1))
    J = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return np.asarray(_PHI_FROM_PSEUDO_INERTIA @ J.ravel(), np.float64)


def _make_cone_program(*, distance: bool) -> tuple[Any, Any, Any, Any]:
    # Imported here because the rest of the package starts ten times faster without Drake.
    from pydrake.solvers import ClarabelSolver, MathematicalProgram

    program, cone = MathematicalProgram(), None
    x = program.NewContinuousVariables(10)
    program.AddLinearMatrixInequalityConstraint(_CONSTRAINT_MATRICES, x)
    if distance:
        t = program.NewContinuousVariables(1)
        program.AddLinearCost([1.0], t)
        A, b = np.eye(11, 11, 10), np.zeros(11)
        cone = program.AddLorentzConeConstraint(A, b, np.append(x, t)).evaluator()
    return program, x, cone, ClarabelSolver()


@cache
def _cached_distance_program(thread: int) -> tuple[Any, Any, Any, Any]:
    return _make_cone_program(distance=True)


def _distance_cone_coefficients(H: Array, b: Array) -> tuple[Array, Array]:
    """Return matrix and vector of the cone t >= |R x - d| with R^T R = H and R^T d = b."""
    values, vectors = np.linalg.eigh(H)
    scale = values[-1]
    values = values / scale
    root = np.sqrt(np.maximum(values, _RIDGE_EIGENVALUE))
    cone, constants = np.zeros((11, 11)), np.zeros(11)
    cone[0, 10], cone[1:, :10] = 1.0, root[:, None] * vectors.T
    constants[1:] = -np.where(values > _MIN_EIGENVALUE, vectors.T @ b / root, 0.0) / scale
    return cone, constants


def _add_log_det_cost(program: Any, x: Any, weight: float) -> None:
    m, hx, hy, hz, xx, xy, xz, yy, yz, zz = x
    half = 0.5 * (xx + yy + zz)
    J = np.array(
        [
            [half - xx, -xy, -xz, hx],
            [-xy, half - yy, -yz, hy],
            [-xz, -yz, half - zz, hz],
            [hx, hy, hz, m],
        ]
    )
    (cost, t, _) = program.AddMaximizeLogDeterminantCost(J)
    program.RemoveCost(cost)
    program.AddLinearCost(-weight * np.ones(len(t)), t)
