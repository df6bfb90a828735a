"""Hand motion as reported by a robot, for `calibrate.py`: poses of a frame other than S.

The poses at 250 Hz have white noise of 0.1 mm and 0.2 mrad and a delay up to 8 ms. For every second
load they have another clock than the wrench, and packets take up to 2 ms longer than the fastest.
The sensor is rotated and shifted in the frame of the poses.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.robots.recording import Recorder
from drake_teleop.robots.streams import POSE, WRENCH, Reading

Array = NDArray[np.float64]

HZ = 500.0
NOISE = np.repeat([0.25, 0.012], 3) / np.sqrt(2.0)  # N, N m, with the density of 1 kHz
COLOURS = (0.0, 0.5, 0.9)
POSE_HZ, POSE_NOISE = 250.0, np.repeat([1e-4, 2e-4], 3)  # m, rad
CLOCK_S, STEP_S = 5e3, 1e-5
UP = np.array([0.0, 0.0, 9.81])


class Hand:
    """Angles (z, y, x) and position of S as sums of sines, after half a second of rest."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rates = rng.uniform(0.2, 1.2, (6, 4)) * 2.0 * np.pi
        self._phases = rng.uniform(0.0, 2.0 * np.pi, (6, 4))
        sizes = np.repeat([rng.uniform(1.0, 3.0) / np.sqrt(3.0), rng.uniform(0.5, 2.0)], 3)
        powers = np.repeat([1.0, 2.0], 3)[:, None]
        self._sizes = sizes[:, None] / self._rates**powers / np.sqrt(2.0)
        self._middle = rng.uniform(-0.5, 0.5, 6)

    def at(self, t: Array) -> tuple[Rotation, Array]:
        """Return R_WS and p_WS (N, 3) [m]."""
        start = np.clip((t - 0.5) / 1.0, 0.0, 1.0)[:, None]
        start = start**4 * (35.0 - 84.0 * start + 70.0 * start**2 - 20.0 * start**3)
        waves = (self._sizes * np.sin(t[:, None, None] * self._rates + self._phases)).sum(axis=2)
        x = self._middle + start * waves
        return Rotation.from_euler("ZYX", x[:, :3]), x[:, 3:]

    def motion(self, t: Array) -> tuple[Array, Array, Array]:
        """Return s, omega, alpha in S, by differences of 10 and 100 us."""

        def omega_at(t: Array) -> Array:
            before, after = (self.at(t + h)[0] for h in (-STEP_S, STEP_S))
            return np.asarray((before.inv() * after).as_rotvec()) / (2.0 * STEP_S)

        step = 10.0 * STEP_S
        R, p = self.at(t)
        places = (self.at(t + h)[1] for h in (-step, step))
        a = (sum(places) - 2.0 * p) / step**2
        alpha = (omega_at(t + step) - omega_at(t - step)) / (2.0 * step)
        return np.asarray(R.inv().apply(a + UP)), omega_at(t), alpha


class Played:
    """Source that delivers readings without waiting, each with its time of arrival."""

    live = False

    def __init__(self, parts: list[Reading]) -> None:
        self._parts, self._at = sorted(parts, key=lambda part: part.arrival), 0

    def read(self, timeout_s: float) -> list[Reading] | None:
        """See `Source`."""
        start, self._at = self._at, self._at + 96
        return self._parts[start : self._at] or None

    def close(self) -> None:
        """See `Source`."""


def posed(rng: np.random.Generator, phi: Array, seconds: float) -> tuple[Played, Recorder]:
    """Return the readings of a load's record, and their recorder."""
    hand = Hand(rng)
    t, late = np.arange(round(seconds * HZ)) / HZ, rng.uniform(0.0, 0.008)
    a = rng.choice(COLOURS)
    white = rng.normal(size=(len(t) + 500, 6)) * np.sqrt(1.0 - a * a)
    noise = lfilter([1.0], [1.0, -a], white, axis=0)[500:] * NOISE
    offsets = rng.normal(size=6) * np.repeat([5.0, 0.3], 3)
    wrench = non_contact_wrench(*hand.motion(t), phi) + offsets + noise
    taken = np.arange(round(seconds * POSE_HZ)) / POSE_HZ
    R_WS, p_WS = hand.at(taken)
    X_FS = np.concatenate(
        [Rotation.random(random_state=rng).as_quat()[[3, 0, 1, 2]], [0.02, -0.03, 0.08]]
    )
    R_WF = R_WS * Rotation.from_quat(X_FS[[1, 2, 3, 0]]).inv()
    p_WF = p_WS - R_WF.apply(X_FS[4:]) + POSE_NOISE[:3] * rng.normal(size=p_WS.shape)
    R_WF = R_WF * Rotation.from_rotvec(POSE_NOISE[3:] * rng.normal(size=p_WS.shape))
    poses = np.hstack([R_WF.as_quat()[:, [3, 0, 1, 2]], p_WF])
    two = bool(rng.integers(2))
    clock, ways = CLOCK_S * two, rng.exponential(4e-4, (2, len(t))).clip(0.0, 2e-3)
    parts = [
        Reading(k, t[k], row, stream=WRENCH, arrival=t[k] + ways[0, k])
        for k, row in enumerate(wrench)
    ]
    for k, row in enumerate(poses):
        stamp, arrival = taken[k] + late + clock, taken[k] + late + ways[1, k]
        parts.append(Reading(k, stamp, row, stream=POSE, arrival=arrival))
    return Played(parts), Recorder((WRENCH, POSE), None, X_FS, two_clocks=two)
