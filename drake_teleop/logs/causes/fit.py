"""Gauss-Newton fit with autoregressive noise of order 4 in each channel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drake_teleop.common.numeric import Array
from drake_teleop.logs.causes.instants import FORCES, ORDER
from drake_teleop.logs.causes.model import Model
from drake_teleop.logs.causes.rows import Rows

_MAX_ITERATIONS, _CONVERGENCE, _UNWEIGHTED_ITERATIONS = 12, 0.02, 2
_RIDGE, _FLOOR = 1e-11, 1e-14


@dataclass(frozen=True, eq=False)
class Fit:
    """Model with parameters x (size,), fitted to rows of a record.

    Attributes:
        covariance: (size, size); huge for undetermined parameters.
        residual: (6, W) coefficients of the residual in the signals y.
        filters: (6, 5) filters that whiten the residual e: sum over d of filters[c, d] e_c[n - d].
        power: (6,) variance of the whitened residual.
    """

    model: Model
    rows: Rows
    x: Array
    covariance: Array
    residual: Array
    filters: Array
    power: Array

    @property
    def likelihood(self) -> float:
        """Logarithm of the likelihood up to a constant."""
        return -0.5 * len(self.rows.whole) * float(np.log(self.power).sum())

    def normal(self, model: Model, x: Array) -> tuple[Array, Array]:
        """Return Gram matrix and right-hand side of the normal equations at x (size,)."""
        whitened = self.rows.whitened(self.filters) / self.power[:, None, None]
        J = model.derivative(x).transpose(1, 0, 2)
        weighted = J @ whitened
        gram = (weighted @ J.transpose(0, 2, 1)).sum(axis=0)
        right = (weighted @ self.residual[:, :, None]).sum(axis=0)[:, 0]
        return 0.5 * (gram + gram.T), right


def fit(
    model: Model, rows: Rows, start: Array | None = None, *, steps: int = _MAX_ITERATIONS
) -> Fit:
    """Fit a model to rows in at most `steps` iterations, from the parameters `start` (size,)."""
    x = np.zeros(model.size) if start is None else start
    count = max(float(rows.used.sum()), 1.0)
    total = (rows.data.y[rows.used][:, FORCES] ** 2).sum(axis=0) / count
    both = total.reshape(2, 3).sum(axis=1).repeat(3)
    floor = np.maximum(_FLOOR * both, 1e-30)
    filters = np.zeros((6, ORDER + 1))
    filters[:, 0] = 1.0
    found = Fit(model, rows, x, np.zeros(0), model.residual(x), filters, np.maximum(both, floor))
    for step in range(steps):
        gram, right = found.normal(model, x)
        inverse = regularized_inverse(gram)
        move = inverse @ right
        move /= max(1.0, float(np.max(np.abs(move) / model.limits)))
        x = x + move
        residual = model.residual(x)
        order = 0 if step + 1 < _UNWEIGHTED_ITERATIONS else ORDER
        filters, power = rows.noise(residual, floor, order)
        found = Fit(model, rows, x, inverse, residual, filters, power)
        still = np.max(np.abs(move) / np.sqrt(np.diag(inverse))) < _CONVERGENCE
        if still and step > _UNWEIGHTED_ITERATIONS:
            break
    return found


def regularized_inverse(gram: Array) -> Array:
    """Invert a Gram matrix with a small ridge on its scaled diagonal."""
    diagonal = np.diag(gram)
    scale = 1.0 / np.sqrt(np.maximum(diagonal, 1e-14 * diagonal.max() + 1e-300))
    scaled = gram * np.outer(scale, scale)
    scaled[np.diag_indices(len(gram))] += _RIDGE
    values, vectors = np.linalg.eigh(scaled)
    values = np.maximum(values, _RIDGE)
    return np.asarray(scale[:, None] * ((vectors / values) @ vectors.T) * scale)
