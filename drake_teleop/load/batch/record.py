"""What a batch estimator is given, and what it finds."""

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
"""Samples of a long record that are looked at together."""


@dataclass(frozen=True, eq=False)
class Options:
    """What an estimator may know beyond the record.

    Attributes:
        noise: of wrench and motion.
        offsets: whether to estimate the sensor's; otherwise they were subtracted before.
        shared_noise: whether the forces, and the torques, have one estimated noise each.
        prior, ellipsoid: for `consistent`.
    """

    noise: Noise
    offsets: bool = True
    shared_noise: bool = False
    prior: Prior | None = None
    ellipsoid: Ellipsoid | None = None


@dataclass(frozen=True, eq=False)
class Record:
    """A checked record: (N, 6), (N, 3), (N, 3), (N, 3), as for `normal_equations.identify`."""

    wrench: Array
    s: Array
    omega: Array
    alpha: Array

    @property
    def arrays(self) -> tuple[Array, Array, Array, Array]:
        """Wrench (N, 6), then s, omega and alpha (N, 3) each."""
        return self.wrench, self.s, self.omega, self.alpha

    @cached_property
    def moments(self) -> Moments:
        """Its sums of squares and products, added up once."""
        moments = Moments()
        moments.add(*self.arrays)
        return moments

    def every(self, step: int) -> Record:
        """Every `step`th sample of it."""
        return Record(*(table[::step] for table in self.arrays))

    def residual(self, theta: Array, part: slice) -> Array:
        """(n, 6) F - [E V] theta of a part of the samples [N, N m]."""
        F, s, omega, alpha = (table[part] for table in self.arrays)
        return F - theta[:6] - non_contact_wrench(s, omega, alpha, theta[6:])


@dataclass(frozen=True, eq=False)
class Fit:
    """What an estimator found: the normal form, and of the wrench's noise (6,) what it used;
    `rejected` are (N,) bools, the samples it did without; `note`, what a user has to know."""

    form: NormalForm
    wrench_noise: Array
    moments: Moments
    rejected: NDArray[np.bool_]
    note: str = ""
