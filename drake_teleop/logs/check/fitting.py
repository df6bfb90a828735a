"""Least squares of channels that have an offset each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
_WORST_CONDITION = 1e8


@dataclass(frozen=True, eq=False)
class Fit:
    """Coefficients and their standard deviations, (k,) both."""

    x: Array
    deviations: Array


def fit_with_offset(columns: Array, target: Array, independent: float) -> Fit | None:
    """The coefficients x of columns x + offsets = target; None if they are not determined.

    Args:
        columns: (N, c, k).
        target: (N, c)
        independent: how many of the N rows say something new.
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
