"""Nonlinear least squares with jackknife standard deviations, Eq. (T22)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from drake_teleop.common.numeric import Array

_BLOCKS = 20
# Directions with smaller singular values, relative to the largest, are undetermined.
RANK = 1e-5
_MAX_EVALUATIONS = 15  # evaluations of the solver: valid records need six


def solve(
    residual: Callable[[Array], Array], x: Array, linear: Array | None = None
) -> tuple[Array, Array]:
    """Return the solution x (n,) and its standard deviations (n,); inf if undetermined.

    Args:
        residual: function of x that returns residuals (N, 3 k).
        x: start.
        linear: (N, 3 k, m) constant derivatives by the last m parameters.
    """
    linear = np.empty((*residual(x).shape, 0)) if linear is None else linear
    rows, channels, _ = linear.shape
    found = _fit(residual, x, linear)
    found = _fit(residual, found.x, linear)  # with updated weights
    return found.x, jackknife(found.jac, found.fun, channels * (rows // _BLOCKS))


def _fit(residual: Callable[[Array], Array], x: Array, linear: Array) -> Any:
    from scipy.optimize import approx_fprime, least_squares

    errors, others = residual(x), len(x) - linear.shape[2]
    power = errors.reshape(len(errors), -1, 3).var(axis=(0, 2))
    sigma = np.repeat(np.sqrt(power + 1e-12 * power.max() + 1e-30), 3)
    known = (linear / sigma[:, None]).reshape(errors.size, linear.shape[2])

    def weighted(z: Array) -> Array:
        return (residual(z) / sigma).ravel()

    def derivatives(z: Array) -> Array:
        found = approx_fprime(z[:others], lambda y: weighted(np.append(y, z[others:])))
        return np.hstack([found, known])

    return least_squares(weighted, x, jac=derivatives, x_scale="jac", max_nfev=_MAX_EVALUATIONS)


def jackknife(jacobian: Array, residual: Array, width: int) -> Array:
    """Return jackknife standard deviations (n,) of the parameters, for blocks of `width` rows."""
    size = np.linalg.norm(jacobian, axis=0) + 1e-300
    _, singular, Vt = np.linalg.svd(jacobian / size, full_matrices=False)
    known = singular > RANK * singular[0]
    basis = Vt[known].T
    J = (jacobian / size) @ basis
    gram, steps = J.T @ J, []
    for start in range(0, len(J) - width + 1, width):
        part, error = J[start : start + width], residual[start : start + width]
        steps.append(np.linalg.lstsq(gram - part.T @ part, part.T @ error, rcond=1e-12)[0])
    spread = (np.array(steps) - np.mean(steps, axis=0)) @ basis.T / size
    deviations = np.sqrt((len(steps) - 1) / len(steps) * np.sum(spread**2, axis=0))
    unknown = np.linalg.norm(Vt[~known], axis=0) > 1e-3
    return np.where(unknown, np.inf, deviations)
