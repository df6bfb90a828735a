"""Polynomials of whole grids: coefficients (..., n + 1), highest power first."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_teleop.lab.analysis.one_axis import Complex

Array = NDArray[np.float64]


def stack(*coefficients: Any) -> Array:
    """Return broadcast coefficients along the last axis."""
    return np.stack(np.broadcast_arrays(*(np.asarray(c, float) for c in coefficients)), axis=-1)


def multiply(p: Array, q: Array) -> Array:
    """Return the product of polynomials."""
    n = q.shape[-1]
    grid = np.broadcast_shapes(p.shape[:-1], q.shape[:-1])
    product = np.zeros((*grid, p.shape[-1] + n - 1))
    for i in range(p.shape[-1]):
        product[..., i : i + n] += p[..., i : i + 1] * q
    return product


def squared_magnitude(p: Array) -> Array:
    """Return |p(jw)|^2 in x = w^2: p(s) p(-s) with s^2 = -x."""
    powers = np.arange(p.shape[-1] - 1, -1, -1)
    return multiply(p, p * (-1.0) ** powers)[..., ::2] * (-1.0) ** powers


def value_at(p: Array, x: Any) -> Any:
    """Return p(x) by Horner's method."""
    value = p[..., 0] + 0 * x
    for i in range(1, p.shape[-1]):
        value = value * x + p[..., i]
    return value


def roots_of(p: Array) -> Complex:
    """Return the roots (..., n); a leading zero gives a very large root."""
    order = p.shape[-1] - 1
    if order == 0:
        return np.zeros((*p.shape[:-1], 0), dtype=complex)
    far = 1e-30 * np.max(np.abs(p), axis=-1)
    lead = np.where(p[..., 0] == 0, np.where(far == 0, 1.0, far), p[..., 0])
    companion = np.zeros((*p.shape[:-1], order, order))
    companion[..., np.arange(1, order), np.arange(order - 1)] = 1
    companion[..., 0, :] = -p[..., 1:] / lead[..., None]
    return np.linalg.eigvals(companion).astype(complex)
