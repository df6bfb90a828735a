"""Poses of a frame in the world, as they were recorded."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from drake_teleop.common.arrays import Array


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
class Inertial:
    """What an IMU tells of the same frame, at So and in its axes.

    Attributes:
        t: (K,) evenly spaced but for gaps [s].
        specific_force: (K, 3) [m/s^2], or None.
        angular_velocity: (K, 3) [rad/s], or None.
    """

    t: Array
    specific_force: Array | None
    angular_velocity: Array | None

    @property
    def rate(self) -> float:
        """Without the gaps [Hz]."""
        return float(1.0 / np.median(np.diff(self.t)))

    def averaged(self, fastest: float) -> Inertial:
        """Means of as many rows that the rate is not below `fastest` [Hz]; none over a gap."""
        count = max(1, int(self.rate / fastest))
        rows = len(self.t) // count * count
        at = self.t[:rows].reshape(-1, count)
        whole = at[:, -1] - at[:, 0] < count / self.rate

        def means(x: Array | None) -> Array | None:
            return None if x is None else x[:rows].reshape(-1, count, 3).mean(axis=1)[whole]

        means_t = at.mean(axis=1)[whole]
        return Inertial(means_t, means(self.specific_force), means(self.angular_velocity))


@dataclass(frozen=True, eq=False)
class Posed:
    """The poses of a log and what else is described of them.

    Attributes:
        poses: of the sensor's frame S, as far as the description is right.
        gravity_W: (3,) in the world [m/s^2].
        p_SoPo_S: (3,) where the recorded frame was said to be [m].
        R_SP: (3, 3) how it was said to be turned.
        imu: what an IMU beside them tells.
    """

    poses: Poses
    gravity_W: Array
    p_SoPo_S: Array = field(default_factory=lambda: np.zeros(3))
    R_SP: Array = field(default_factory=lambda: np.eye(3))
    imu: Inertial | None = None

    def earlier(self, start: float) -> Posed:
        """The same with the times since `start` [s]."""
        imu = None if self.imu is None else replace(self.imu, t=self.imu.t - start)
        return replace(self, poses=replace(self.poses, t=self.poses.t - start), imu=imu)
