"""Least squares of channels with one offset each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
_WORST_CONDITION = 1e8


@dataclass(frozen=True, eq=False)
class Fit:
    """Coefficients and their standard deviations, both (k,)."""

    x: Array
    deviations: Array


def fit_with_offset(columns: Array, target: Array, independent: float) -> Fit | None:
    """Solve columns x + offsets = target; return None if x is undetermined.

    Args:
        columns: (N, c, k).
        target: (N, c).
        independent: number of independent rows.
    """
    if len(columns) == 0:
        return None
    columns, target = columns - columns.mean(axis=0), target - target.mean(axis=0)
    A, b = columns.reshape(-1, columns.shape[2]), target.ravel()
    size = np.linalg.norm(A, axis=0)
    if (size == 0.0).any():
        return None
    gram = (A / size).T @ (A / size)
    if np.linalg.cond(gram) > _WORST_CONDITION:
        return None
    inverse = np.linalg.inv(gram)
    x = inverse @ ((A / size).T @ b)
    variance = float(np.sum((b - (A / size) @ x) ** 2)) / (target.shape[1] * max(1.0, independent))
    return Fit(x / size, np.sqrt(variance * np.diag(inverse)) / size)
