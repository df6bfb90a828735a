"""Wrench of an episode, and the wrench that a load has with its motion, at any lag."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np

from drake_teleop.common.numeric import Array
from drake_teleop.load.regressor import non_contact_wrench, regressor
from drake_teleop.logs.dataset.episode_verdict import MAX_LAG_FRAMES, STEPS, Predict
from drake_teleop.logs.pose_motion.splines import PoseSplines
from drake_teleop.logs.read.canonical import Log
from drake_teleop.logs.read.rotations import rotation_matrices

_MARGIN = 2 * MAX_LAG_FRAMES  # frames at both ends of the finely sampled motion


class Motion(NamedTuple):
    """Motion of S: specific force, angular velocity and acceleration, gravity and R_WS."""

    s: Array
    omega: Array
    alpha: Array
    gravity: Array
    R_WS: Array


class EpisodeSignals:
    """Wrench of one episode and its motion.

    Args:
        log: with orientation; not low-passed.
        spacing: knot distance of the splines of the poses [frames].
    """

    def __init__(self, log: Log, spacing: float) -> None:
        self.log = log
        self._splines = None
        if log.posed is not None:
            poses = log.posed.poses
            self._splines = PoseSplines(poses, spacing / poses.rate)
        grid = np.arange(-_MARGIN * STEPS, (len(log) + _MARGIN) * STEPS) / STEPS
        self._fine = self.motion(log.t[0] + grid * log.dt)

    def motion(self, t: Array) -> Motion:
        """Return the motion at times t (N,) [s]."""
        log = self.log
        if self._splines is None or log.posed is None:
            assert log.gravity is not None and log.R_WS is not None
            signals = (*log.motion, log.gravity, log.R_WS.reshape(-1, 9))
            at = (np.array([np.interp(t, log.t, x) for x in y.T]).T for y in signals)
            s, omega, alpha, gravity, R = at
            return Motion(s, omega, alpha, gravity, R.reshape(-1, 3, 3))
        g = log.posed.gravity_W
        R = rotation_matrices(self._splines.quaternion(t), "quaternion_wxyz")
        return Motion(*self._splines.motion(t, g), self._splines.gravity(t, g), R)

    def delayed(self, lag: float) -> Motion:
        """Return the motion (N, ...) at the frames, `lag` frames later."""
        step = round((lag + _MARGIN) * STEPS)
        if abs(step - (lag + _MARGIN) * STEPS) < 1e-6 and abs(lag) < _MARGIN:
            rows = slice(step, step + STEPS * len(self.log), STEPS)
            return Motion(*(x[rows] for x in self._fine))
        return self.motion(self.log.t + lag * self.log.dt)

    def regress(self, lag: float) -> Array:
        """Return the regressor V (N, 6, 10), with the motion `lag` frames later."""
        return regressor(*self.delayed(lag)[:3])

    def predictor(self, phi: Array) -> Predict:
        """Return reading and wrench of a load phi (10,) as a function of kind and lag [frames]."""

        @cache
        def predict(kind: str, lag: float) -> tuple[Array, Array]:
            at = self.delayed(lag)
            s = at.s + at.gravity if kind == "weight removed" else at.s
            wrench = self.log.wrench
            if kind == "base":
                wrench = (wrench.reshape(-1, 2, 3) @ at.R_WS).reshape(-1, 6)
            return wrench, non_contact_wrench(s, at.omega, at.alpha, phi)

        return predict
