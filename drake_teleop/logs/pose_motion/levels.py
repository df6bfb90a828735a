"""How the power of the wrench's noise goes with frequency.

Each group of bands and channel has a level of its own, and within the group the power is that level
times a shape: 1, or for a channel whose offset wanders as a random walk does

    1 + (corner / f)^2,

with the corner of the greatest likelihood (`saturated.wandering`). A group of one level would let
the lowest frequencies, where such noise is largest and gravity turns, count as much as the others.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.arrays import Array
from drake_teleop.logs.pose_motion.spectra import Bands

_LEAST_LEFT = 0.25


@dataclass(frozen=True, eq=False)
class Levels:
    """Bands of frequency, and what the noise is like in them.

    Attributes:
        sizes: (bands,) half as many independent numbers as each has.
        group: (bands,) number of its group.
        shape: (bands, 6) of the power in each channel.
    """

    sizes: Array
    group: NDArray[np.intp]
    shape: Array

    @classmethod
    def flat(cls, of: Bands) -> Levels:
        """White within each group."""
        return cls(of.sizes, of.group, np.ones((of.count, 6)))

    def power(self, sums: Array, taken: Array | None = None) -> Array:
        """(..., bands, 6) mean power of a number.

        Args:
            sums: (..., bands, 6) of the power of the residual's numbers.
            taken: (bands, 6) numbers that parameters took, of twice `sizes`.
        """
        left = self._numbers
        if taken is not None:
            left = np.maximum(left - 0.5 * self.grouped(taken), _LEAST_LEFT * left)
        level = np.add.reduceat(sums / self.shape, self._starts, axis=-2) / left
        return np.asarray(level[..., self.group, :] * self.shape)

    def grouped(self, x: Array) -> Array:
        """(groups, ...) sums of (bands, ...)."""
        return np.asarray(np.add.reduceat(x, self._starts, axis=0))

    @cached_property
    def _starts(self) -> NDArray[np.intp]:
        return np.flatnonzero(np.diff(self.group, prepend=-1))

    @cached_property
    def _numbers(self) -> Array:
        """(groups, 1) half as many as each group has."""
        return self.grouped(self.sizes)[:, None]

    def costs(self, power: Array) -> Array:
        """(..., 6) minus the log likelihood of each channel with powers (..., bands, 6), but for a
        constant."""
        return np.asarray(self.sizes @ np.log(power))


def wander(of: Bands, corner: float) -> Array:
    """(bands,) mean of 1 + (corner / f)^2 in each band; at zero as at the least frequency."""
    f = np.maximum(of.frequency, of.frequency[1])
    return np.asarray(1.0 + of.sums((corner / f) ** 2) / of.sizes)
