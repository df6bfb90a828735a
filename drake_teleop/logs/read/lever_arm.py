"""Position of an accelerometer on the sensor, from a rigid load's wrench, Eqs. (T20), (T21)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.numeric import Array
from drake_teleop.common.vectors import cross_matrix
from drake_teleop.load.compensation import contact_wrench
from drake_teleop.load.regressor import regressor
from drake_teleop.logs.read.alignment import low_pass, low_passed, measured, resample, undelayed
from drake_teleop.logs.read.canonical import Log
from drake_teleop.logs.read.delay import estimate_delay
from drake_teleop.logs.read.jackknife import RANK, solve

MAX_LEVER_DEVIATION = 0.005
"""Largest standard deviation of a determined coordinate [m]."""
MAX_UNEXPLAINED = 0.05
"""Largest unexplained share of the variance of a valid fit."""
CUTOFF_HZ = 8.0
"""Cut-off of the low-pass on all signals [Hz]."""
COMPARED_SAMPLES = 1500
"""Number of compared samples."""
# Least signal-to-noise power ratio of the motion; the lever arm is at most 5 % too short.
_MIN_SIGNAL_RATIO = 20.0


@dataclass(frozen=True)
class LeverArm:
    """Estimated position of the accelerometer.

    Attributes:
        p_SoIo_S: (3,) position relative to the described one, in S [m].
        deviations: (3,) standard deviations [m]; inf if undetermined.
        source: "pose" or "wrench".
    """

    p_SoIo_S: Array
    deviations: Array
    source: str

    @property
    def determined(self) -> NDArray[np.bool_]:
        """Booleans (3,): True where the standard deviation is below 5 mm."""
        return self.deviations < MAX_LEVER_DEVIATION


def lever_arm_from_wrench(log: Log) -> LeverArm | None:
    """Return the position of the accelerometer, fitted with offsets, load and delay, Eq. (T21).

    None for a poor fit (contact), or few samples outside of gaps.
    """
    cutoff = min(CUTOFF_HZ, 0.2 / log.dt)
    delay = estimate_delay(log, None) or 0.0
    smooth = low_passed(undelayed(log, delay), cutoff)
    margin = min(0.1, 0.1 * float(smooth.t[-1] - smooth.t[0]))
    t = common_times(smooth.t[0] + margin, smooth.t[-1] - margin, (smooth,), cutoff)
    if len(t) < COMPARED_SAMPLES // 10:
        return None
    wrench = resample(t, smooth.t, smooth.wrench)

    def residual(x: Array) -> Array:
        s, omega, alpha = (resample(t + x[3], smooth.t, signal) for signal in smooth.motion)
        s = s - lever_matrix(omega, alpha) @ x[:3]
        return contact_wrench(wrench, x[4:10], s, omega, alpha, x[10:])

    motion = [resample(t, smooth.t, signal) for signal in smooth.motion]
    V = regressor(*motion)
    size = np.linalg.norm(V - V.mean(axis=0), axis=(0, 1)) + 1e-12
    centred = ((V - V.mean(axis=0)) / size).reshape(-1, 10)
    phi = np.linalg.lstsq(centred, (wrench - wrench.mean(axis=0)).ravel(), rcond=RANK)[0] / size
    offsets = (wrench - V @ phi).mean(axis=0)
    x, deviations = solve(residual, np.concatenate([np.zeros(4), offsets, phi]))
    left, whole = (y.var(axis=0).reshape(2, 3).sum(axis=1) for y in (residual(x), wrench))
    if (left > MAX_UNEXPLAINED * whole).any():
        return None
    observable = observable_axes(lever_matrix(*motion[1:]), smooth, cutoff)
    return LeverArm(x[:3], np.where(observable, deviations[:3], np.inf), "wrench")


def common_times(start: float, stop: float, logs: Sequence[Log], cutoff: float) -> Array:
    """Return evenly spaced times at which all logs have samples."""
    t = np.linspace(start, stop, COMPARED_SAMPLES)
    known = [np.interp(t, log.t, measured(log, cutoff).astype(float)) > 0.99 for log in logs]
    return t[np.all(known, axis=0)]


def lever_matrix(omega: Array, alpha: Array) -> Array:
    """Return the matrix K (N, 3, 3): K p is the acceleration of a point p relative to the origin.

    Eq. (T20), for omega and alpha (N, 3).
    """
    W = cross_matrix(omega)
    return cross_matrix(alpha) + W @ W


def observable_axes(K: Array, log: Log, cutoff: float) -> NDArray[np.bool_]:
    """Return (3,) True for axes along which the motion far exceeds its noise."""
    alpha = log.angular_acceleration
    above = low_pass(alpha, log.dt, 2 * cutoff) - low_pass(alpha, log.dt, cutoff)
    noise = above.var(axis=0) / 7
    K = K - K.mean(axis=0)
    information = np.einsum("nij,nik->jk", K, K) / len(K)
    alone = 1 / np.diag(np.linalg.pinv(information, rcond=1e-12, hermitian=True))
    return alone > _MIN_SIGNAL_RATIO * (noise.sum() - noise)
