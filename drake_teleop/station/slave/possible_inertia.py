"""Nearest inertia tensor that a rigid body can have."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Margin of corrected moments against rounding in Drake's check, relative to the largest one.
_MARGIN = 1e-9


def nearest_possible_inertia(
    inertia: NDArray[np.float64],
) -> tuple[NDArray[np.float64], float]:
    """Return the nearest possible tensor (3, 3) about the centre of mass, and its distance.

    Negative principal moments become 0. Then a deficit of p3 <= p1 + p2 is distributed in equal
    parts, which is nearest in the Frobenius norm. The distance is the largest change of a
    principal moment, relative to the largest moment; it is 0 for a possible tensor, which is
    returned unchanged.
    """
    given, axes = np.linalg.eigh((inertia + inertia.T) / 2.0)
    moments = np.maximum(given, 0.0)
    deficit = moments[2] - moments[1] - moments[0]
    largest = float(np.abs(given).max())
    if given[0] >= 0.0 and deficit <= 0.0:
        return inertia, 0.0
    if deficit > 0.0:
        moments += (deficit + _MARGIN * largest) / 3.0 * np.array([1.0, 1.0, -1.0])
    distance = float(np.abs(moments - given).max()) / largest
    return (axes * moments) @ axes.T, distance
