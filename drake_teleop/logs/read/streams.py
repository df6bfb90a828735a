"""Signals of one stream on its clock: resampling and transformation to S."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_teleop.logs.pose_motion.poses import Inertial, Poses
from drake_teleop.logs.read.alignment import low_pass, resample, spacing

MAX_VALUES = {
    "force": (1e6, "N"),
    "torque": (1e6, "N m"),
    "specific_force": (1e6, "m/s^2"),
    "gravity": (1e6, "m/s^2"),
    "angular_velocity": (1e6, "rad/s"),
    "angular_acceleration": (1e9, "rad/s^2"),
    "position": (1e9, "m"),
}
"""Largest plausible value of each signal and its unit, also for wrong units."""


@dataclass(frozen=True)
class Stream:
    """Signals (N, ...) on one clock `t` [s], or None.

    `raw` are the recorded poses of S, `inertial` the IMU data in S.
    """

    name: str
    t: NDArray[np.float64]
    specific_force: NDArray[np.float64] | None = None
    angular_velocity: NDArray[np.float64] | None = None
    angular_acceleration: NDArray[np.float64] | None = None
    R_WS: NDArray[np.float64] | None = None
    raw: Poses | None = None
    inertial: Inertial | None = None

    @property
    def dt(self) -> float:
        """Mean sample spacing [s]."""
        return spacing(self.t)


def on_clock(
    t: NDArray[np.float64], stream: Stream, values: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return `values` of a stream at times `t`, low-passed if the stream is faster."""
    rate = 1 / spacing(t)
    faster = stream.dt * rate < 0.9
    return resample(t, stream.t, low_pass(values, stream.dt, 0.4 * rate if faster else None))


def in_S(R_WS: NDArray[np.float64], vectors_W: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (N, 3) vectors in S of vectors in W."""
    return np.einsum("nji,nj->ni", R_WS, np.broadcast_to(vectors_W, (len(R_WS), 3)))


def wrench_in_S(R_SW: NDArray[np.float64], wrench_W: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (N, 6) wrenches in S of wrenches in W."""
    both = np.einsum("nij,nkj->nki", R_SW, wrench_W.reshape(-1, 2, 3))
    return both.reshape(-1, 6)


def move_to_So(
    s: NDArray[np.float64],
    p_SoIo_S: NDArray[np.float64],
    t: NDArray[np.float64],
    omega: NDArray[np.float64] | None,
    alpha: NDArray[np.float64] | None,
    pose: Stream | None,
) -> NDArray[np.float64]:
    """Return the specific force of So from that of Io on the same rigid body."""
    if omega is None or alpha is None:
        assert pose is not None and pose.angular_velocity is not None
        assert pose.angular_acceleration is not None
        omega = resample(t, pose.t, pose.angular_velocity)
        alpha = resample(t, pose.t, pose.angular_acceleration)
    return s - np.cross(alpha, p_SoIo_S) - np.cross(omega, np.cross(omega, p_SoIo_S))
