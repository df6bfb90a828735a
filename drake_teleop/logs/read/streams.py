"""Signals on a clock of their own, brought to another, and vectors turned to the axes of S."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_teleop.logs.pose_motion.poses import Inertial, Poses
from drake_teleop.logs.read.alignment import low_pass, resample, spacing

LARGEST = {
    "force": (1e6, "N"),
    "torque": (1e6, "N m"),
    "specific_force": (1e6, "m/s^2"),
    "gravity": (1e6, "m/s^2"),
    "angular_velocity": (1e6, "rad/s"),
    "angular_acceleration": (1e9, "rad/s^2"),
    "position": (1e9, "m"),
}
"""What no log holds, not even in wrong units within reach: those are told by what they explain."""


@dataclass(frozen=True)
class Stream:
    """Signals on one clock. Arrays (N, ...) or None; `t` is [s] on the common clock.

    `raw` are the poses of S as they were recorded, `told` what an IMU tells of S.
    """

    name: str
    t: NDArray[np.float64]
    specific_force: NDArray[np.float64] | None = None
    angular_velocity: NDArray[np.float64] | None = None
    angular_acceleration: NDArray[np.float64] | None = None
    R_WS: NDArray[np.float64] | None = None
    raw: Poses | None = None
    told: Inertial | None = None

    @property
    def dt(self) -> float:
        """Usual time from one sample to the next [s]."""
        return spacing(self.t)


def on_clock(
    t: NDArray[np.float64], stream: Stream, values: NDArray[np.float64]
) -> NDArray[np.float64]:
    """`values` of a stream at times `t`, without what is too fast for their spacing."""
    rate = 1 / spacing(t)
    faster = stream.dt * rate < 0.9
    return resample(t, stream.t, low_pass(values, stream.dt, 0.4 * rate if faster else None))


def in_S(R_WS: NDArray[np.float64], vectors_W: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 3) vectors in S, of such in W."""
    return np.einsum("nji,nj->ni", R_WS, np.broadcast_to(vectors_W, (len(R_WS), 3)))


def turned_wrench(R_SW: NDArray[np.float64], wrench_W: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 6) wrenches in S, of such in W."""
    both = np.einsum("nij,nkj->nki", R_SW, wrench_W.reshape(-1, 2, 3))
    return both.reshape(-1, 6)


def at_S(
    s: NDArray[np.float64],
    p_SoIo_S: NDArray[np.float64],
    t: NDArray[np.float64],
    omega: NDArray[np.float64] | None,
    alpha: NDArray[np.float64] | None,
    pose: Stream | None,
) -> NDArray[np.float64]:
    """Specific force of So from the one measured at Io, a point of the same rigid body."""
    if omega is None or alpha is None:
        assert pose is not None and pose.angular_velocity is not None
        assert pose.angular_acceleration is not None
        omega = resample(t, pose.t, pose.angular_velocity)
        alpha = resample(t, pose.t, pose.angular_acceleration)
    return s - np.cross(alpha, p_SoIo_S) - np.cross(omega, np.cross(omega, p_SoIo_S))
