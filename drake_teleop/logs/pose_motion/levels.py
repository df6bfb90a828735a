"""Noise power of the wrench in bands of frequency, Eqs. (T74), (T75)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.arrays import Array
from drake_teleop.logs.pose_motion.spectra import Bands

_MIN_REMAINING_SHARE = 0.25


@dataclass(frozen=True, eq=False)
class Levels:
    """Noise with one level for each group of bands and channel.

    Attributes:
        sizes: (bands,) half the number of independent numbers.
        group: (bands,) number of the group.
        shape: (bands, 6) relative power.
    """

    sizes: Array
    group: NDArray[np.intp]
    shape: Array

    @classmethod
    def flat(cls, of: Bands) -> Levels:
        """Return white noise within each group."""
        return cls(of.sizes, of.group, np.ones((of.count, 6)))

    def power(self, sums: Array, used: Array | None = None) -> Array:
        """Return (..., bands, 6) mean power of residual power `sums` (..., bands, 6).

        `used` (bands, 6) are degrees of freedom used by parameters.
        """
        remaining = self._numbers
        if used is not None:
            remaining = np.maximum(
                remaining - 0.5 * self.grouped(used), _MIN_REMAINING_SHARE * remaining
            )
        level = np.add.reduceat(sums / self.shape, self._starts, axis=-2) / remaining
        return np.asarray(level[..., self.group, :] * self.shape)

    def grouped(self, x: Array) -> Array:
        """Return (groups, ...) sums of (bands, ...)."""
        return np.asarray(np.add.reduceat(x, self._starts, axis=0))

    @cached_property
    def _starts(self) -> NDArray[np.intp]:
        return np.flatnonzero(np.diff(self.group, prepend=-1))

    @cached_property
    def _numbers(self) -> Array:
        return self.grouped(self.sizes)[:, None]

    def costs(self, power: Array) -> Array:
        """Return (..., 6) costs (T75) of powers (..., bands, 6)."""
        return np.asarray(self.sizes @ np.log(power))


def random_walk_shape(of: Bands, corner: float) -> Array:
    """Return (bands,) means of 1 + (corner / f)^2, Eq. (T74)."""
    f = np.maximum(of.frequency, of.frequency[1])
    return np.asarray(1.0 + of.sums((corner / f) ** 2) / of.sizes)
