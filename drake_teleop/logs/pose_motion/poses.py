"""Classes of recorded poses and IMU data, with block means."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from drake_teleop.common.numeric import Array


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses of frame P at increasing, maybe uneven stamps t (K,) [s].

    They are p_WoPo_W (K, 3) [m] and unit quaternions [w, x, y, z] of R_WP (K, 4).
    """

    t: Array
    position: Array
    quaternion: Array

    @property
    def rate(self) -> float:
        """Median rate [Hz]."""
        return float(1.0 / np.median(np.diff(self.t)))

    def with_continuous_quaternions(self) -> Poses:
        products = np.einsum("ki,ki->k", self.quaternion[1:], self.quaternion[:-1])
        if (products >= 0.0).all():
            return self
        sign = np.concatenate([[1.0], np.cumprod(np.where(products < 0.0, -1.0, 1.0))])
        return Poses(self.t, self.position, self.quaternion * sign[:, None])

    def average_consecutive(self, count: int) -> Poses:
        """Return the mean of each `count` consecutive poses; quaternion signs must not jump."""
        rows = len(self.t) // count * count
        t, p, q = (
            x[:rows].reshape(-1, count, *x.shape[1:]).mean(axis=1)
            for x in (self.t, self.position, self.quaternion)
        )
        return Poses(t, p, q / np.linalg.norm(q, axis=1, keepdims=True))


@dataclass(frozen=True, eq=False)
class ImuData:
    """Specific force and angular velocity (K, 3) of So in S at times t (K,) [s]; None if absent."""

    t: Array
    specific_force: Array | None
    angular_velocity: Array | None

    @property
    def rate(self) -> float:
        """Median rate [Hz]."""
        return float(1.0 / np.median(np.diff(self.t)))

    def average_to_rate(self, min_rate_hz: float) -> ImuData:
        """Return means of consecutive rows, at `min_rate_hz` or just above; none across gaps."""
        count = max(1, int(self.rate / min_rate_hz))
        rows = len(self.t) // count * count
        at = self.t[:rows].reshape(-1, count)
        whole = at[:, -1] - at[:, 0] < count / self.rate
        both = (
            None if x is None else x[:rows].reshape(-1, count, 3).mean(axis=1)[whole]
            for x in (self.specific_force, self.angular_velocity)
        )
        return ImuData(at.mean(axis=1)[whole], *both)


@dataclass(frozen=True, eq=False)
class PosesOfLog:
    """Poses of frame P in a log, with gravity (3,) in the world [m/s^2].

    `p_SoPo_S` (3,) [m] and `R_SP` (3, 3) are origin and axes of P in S as described.
    """

    poses: Poses
    gravity_W: Array
    p_SoPo_S: Array = field(default_factory=lambda: np.zeros(3))
    R_SP: Array = field(default_factory=lambda: np.eye(3))
    imu: ImuData | None = None

    def with_times_relative_to(self, start: float) -> PosesOfLog:
        imu = None if self.imu is None else replace(self.imu, t=self.imu.t - start)
        return replace(self, poses=replace(self.poses, t=self.poses.t - start), imu=imu)
