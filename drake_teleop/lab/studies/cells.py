"""What can be compared if runs fail: never a level here with another one elsewhere.

Where all runs of a level fail at some combination of the other factors, its mean over the rest is
no match for another level's mean over everything. So levels of a factor, and cells of two factors,
are compared over those combinations of the other factors' levels at which every one of them has a
successful run. If there is no such combination, they are as many levels as any combination has; the
others have no value, and a reason why.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Flags: TypeAlias = NDArray[np.bool_]

#: Why a level or a cell has no value.
NO_RUN, NO_SUCCESS = "no run", "no successful run"
NOT_COMPARABLE = "not comparable with the others"
TOO_FEW = "too few points"


def comparable(there: Flags) -> tuple[Flags, Flags]:
    """The rows that have the same columns.

    Args:
        there: (rows, columns) whether there is a value, of levels or cells and of combinations.

    Returns:
        (rows,) as many as any column has, of several such sets the one that most columns have; and
        (columns,) those that have all these rows.
    """
    counts = there.sum(axis=0)
    patterns, times = np.unique(there[:, counts == counts.max()], axis=1, return_counts=True)
    rows = patterns[:, np.argmax(times)]
    columns: Flags = np.logical_and.reduce(there[rows], axis=0)
    return rows, columns


def reasons(compared: Flags, runs: NDArray[np.int64], good: NDArray[np.int64]) -> list[str]:
    """(n,) why levels or cells have no value; empty if they have.

    Args:
        compared: (n,) whether they have.
        runs: (n,) of each.
        good: (n,) those of them that have the measure.
    """
    why = np.where(runs == 0, NO_RUN, np.where(good == 0, NO_SUCCESS, NOT_COMPARABLE))
    return np.where(compared, "", why).tolist()
