"""Comparable levels and cells of a study with failed runs.

Levels are compared over those combinations of other factors at which all have a successful run. If
there is none, the largest comparable set is used.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Flags: TypeAlias = NDArray[np.bool_]

#: Reasons for a level or cell without value.
NO_RUN, NO_SUCCESS = "no run", "no successful run"
NOT_COMPARABLE = "not comparable with the others"
TOO_FEW = "too few points"


def comparable(there: Flags) -> tuple[Flags, Flags]:
    """Return the rows and columns of a complete block.

    Args:
        there: (rows, columns) True where level (or cell) and combination have a value.

    Returns:
        (rows,) the most frequent largest pattern; (columns,) all columns with these rows.
    """
    counts = there.sum(axis=0)
    patterns, times = np.unique(there[:, counts == counts.max()], axis=1, return_counts=True)
    rows = patterns[:, np.argmax(times)]
    columns: Flags = np.logical_and.reduce(there[rows], axis=0)
    return rows, columns


def reasons(compared: Flags, runs: NDArray[np.int64], good: NDArray[np.int64]) -> list[str]:
    """Return (n,) why levels or cells have no value; empty if `compared`."""
    why = np.where(runs == 0, NO_RUN, np.where(good == 0, NO_SUCCESS, NOT_COMPARABLE))
    return np.where(compared, "", why).tolist()
