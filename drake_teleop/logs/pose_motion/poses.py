"""Poses of a frame in the world, as they were recorded."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from drake_teleop.load.arrays import Array


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses of a frame P in the world.

    Attributes:
        t: (K,) increasing stamps [s], uneven as they may be.
        position: (K, 3) p_WoPo_W [m].
        quaternion: (K, 4) [w, x, y, z] of R_WP, of unit length, either sign.
    """

    t: Array
    position: Array
    quaternion: Array

    @property
    def rate(self) -> float:
        """Median rate [Hz]."""
        return float(1.0 / np.median(np.diff(self.t)))

    def continued(self) -> Poses:
        """The same with the quaternions' signs such that none turns round."""
        products = np.einsum("ki,ki->k", self.quaternion[1:], self.quaternion[:-1])
        if (products >= 0.0).all():
            return self
        sign = np.concatenate([[1.0], np.cumprod(np.where(products < 0.0, -1.0, 1.0))])
        return Poses(self.t, self.position, self.quaternion * sign[:, None])

    def averaged(self, count: int) -> Poses:
        """Means of `count` poses, signs being continuous: as good for the search of the knots."""
        rows = len(self.t) // count * count
        t, p, q = (
            x[:rows].reshape(-1, count, *x.shape[1:]).mean(axis=1)
            for x in (self.t, self.position, self.quaternion)
        )
        return Poses(t, p, q / np.linalg.norm(q, axis=1, keepdims=True))


@dataclass(frozen=True, eq=False)
class Posed:
    """What a motion that is known by poses alone hangs on.

    Attributes:
        poses: of the sensor's frame S, as far as the description is right.
        gravity_W: (3,) in the world [m/s^2].
        gain_std: standard deviation of the sensor's gains, as stated.
        p_SoPo_S: (3,) where the recorded frame was said to be [m].
        R_SP: (3, 3) how it was said to be turned.
    """

    poses: Poses
    gravity_W: Array
    gain_std: float = 0.0
    p_SoPo_S: Array = field(default_factory=lambda: np.zeros(3))
    R_SP: Array = field(default_factory=lambda: np.eye(3))
