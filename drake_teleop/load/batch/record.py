"""Input and result of a batch estimator."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.arrays import Array
from drake_teleop.load.batch.consistent import Ellipsoid, Prior
from drake_teleop.load.batch.moments import Moments, Noise
from drake_teleop.load.batch.total_least_squares import NormalForm
from drake_teleop.load.regressor import non_contact_wrench

CHUNK = 2**15
"""Samples per pass over a long record."""


@dataclass(frozen=True, eq=False)
class Options:
    """Options of an estimator, as for `identify_batch`."""

    noise: Noise
    offsets: bool = True
    shared_noise: bool = False
    prior: Prior | None = None
    ellipsoid: Ellipsoid | None = None


@dataclass(frozen=True, eq=False)
class Record:
    """Checked record: wrench (N, 6), s, omega and alpha (N, 3)."""

    wrench: Array
    s: Array
    omega: Array
    alpha: Array

    @property
    def arrays(self) -> tuple[Array, Array, Array, Array]:
        """Wrench (N, 6), s, omega and alpha (N, 3)."""
        return self.wrench, self.s, self.omega, self.alpha

    @cached_property
    def moments(self) -> Moments:
        """Second moments of the record."""
        moments = Moments()
        moments.add(*self.arrays)
        return moments

    def every(self, step: int) -> Record:
        """Return every `step`-th sample."""
        return Record(*(table[::step] for table in self.arrays))

    def residual(self, theta: Array, part: slice) -> Array:
        """Return F - [E V] theta (n, 6) of a part of the samples [N, N m]."""
        F, s, omega, alpha = (table[part] for table in self.arrays)
        return F - theta[:6] - non_contact_wrench(s, omega, alpha, theta[6:])


@dataclass(frozen=True, eq=False)
class Fit:
    """Normal form, wrench noise (6,), moments, rejected samples (N,) and a note for the user."""

    form: NormalForm
    wrench_noise: Array
    moments: Moments
    rejected: NDArray[np.bool_]
    note: str = ""
