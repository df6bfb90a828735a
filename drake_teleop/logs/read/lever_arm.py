"""Where an accelerometer sits on the sensor, from the wrench of a rigid load.

An accelerometer at Io, a point of the body of S, measures in the axes of S, up to a bias,

    s_I = s + alpha x p + omega x (omega x p) = s + K p,    p = p_SoIo_S

with the specific force s of So and the motion of S. Force and torque, Eqs. (1)-(2), are linear in
s, and while a shift of the accelerometer looks like a shift of the centre of mass in the force
alone, the torque knows the centre of mass from the weight. So the wrench tells p.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.vectors import cross_matrix
from drake_teleop.load.compensation import contact_wrench
from drake_teleop.load.regressor import regressor
from drake_teleop.logs.read.alignment import low_pass, low_passed, measured, resample, undelayed
from drake_teleop.logs.read.canonical import Log
from drake_teleop.logs.read.delay import estimate_delay
from drake_teleop.logs.read.jackknife import RANK, solve

LEVER_KNOWN = 0.005
"""A coordinate of the accelerometer is determined if its standard deviation is below this [m]."""
BELIEVABLE = 0.05
"""A fit that leaves more of the variance than this tells nothing."""
CUTOFF = 8.0
"""Of the low-pass on everything [Hz]."""
SAMPLES = 1500
"""As many are compared."""
# Least ratio of a motion's power to that of its noise, for a lever arm 5 % too short at worst.
_SIGNAL = 20.0


@dataclass(frozen=True)
class LeverArm:
    """Where the accelerometer is.

    Args:
        p_SoIo_S: (3,) its position in S, on top of what the description says already [m].
        deviations: (3,) standard deviations [m]; inf along an axis that the motion says nothing of.
        source: "pose" or "wrench", which told it.
    """

    p_SoIo_S: NDArray[np.float64]
    deviations: NDArray[np.float64]
    source: str

    @property
    def determined(self) -> NDArray[np.bool_]:
        """(3,) the verdict on each axis."""
        return self.deviations < LEVER_KNOWN


def lever_arm_from_wrench(log: Log) -> LeverArm | None:
    """The lever arm of an accelerometer from the wrench of a rigid load that touches nothing.

    Least squares of the wrench over offsets, load, delay and lever arm together: the wrench of
    Eqs. (1)-(2) with s = s_measured - K p. Forces and torques are weighted by their own residuals.
    All signals are low-passed at 8 Hz.

    Args:
        log: its specific force is that of the accelerometer, in the axes of S.

    Returns:
        None if the load leaves more than 5 % of the wrench's variance: then something is touched;
        or if gaps leave less than a tenth of the record.
    """
    cutoff = min(CUTOFF, 0.2 / log.dt)
    delay = estimate_delay(log, None) or 0.0
    smooth = low_passed(undelayed(log, delay), cutoff)
    margin = min(0.1, 0.1 * float(smooth.t[-1] - smooth.t[0]))
    t = common_times(smooth.t[0] + margin, smooth.t[-1] - margin, (smooth,), cutoff)
    if len(t) < SAMPLES // 10:
        return None
    wrench = resample(t, smooth.t, smooth.wrench)

    def residual(x: NDArray[np.float64]) -> NDArray[np.float64]:
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
    if (left > BELIEVABLE * whole).any():
        return None
    shown = shown_axes(lever_matrix(*motion[1:]), smooth, cutoff)
    return LeverArm(x[:3], np.where(shown, deviations[:3], np.inf), "wrench")


def common_times(
    start: float, stop: float, logs: Sequence[Log], cutoff: float
) -> NDArray[np.float64]:
    """Evenly spaced times at which all logs have samples, and not bridges over gaps."""
    t = np.linspace(start, stop, SAMPLES)
    known = [np.interp(t, log.t, measured(log, cutoff).astype(float)) > 0.99 for log in logs]
    return t[np.all(known, axis=0)]


def lever_matrix(omega: NDArray[np.float64], alpha: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 3, 3) K = [alpha x] + [omega x]^2: K p is what p adds to the specific force."""
    W = cross_matrix(omega)
    return cross_matrix(alpha) + W @ W


def shown_axes(K: NDArray[np.float64], log: Log, cutoff: float) -> NDArray[np.bool_]:
    """(3,) lever arms that the motion shows, and not only its noise.

    Noise in K is not seen in residuals: it draws the lever arm to zero, with confidence. The power
    per Hz of white noise that was differentiated grows with the square of the frequency at least,
    so below the cut-off there is at most a seventh of what is in the octave above it.
    """
    alpha = log.angular_acceleration
    above = low_pass(alpha, log.dt, 2 * cutoff) - low_pass(alpha, log.dt, cutoff)
    noise = above.var(axis=0) / 7
    K = K - K.mean(axis=0)
    information = np.einsum("nij,nik->jk", K, K) / len(K)
    alone = 1 / np.diag(np.linalg.pinv(information, rcond=1e-12, hermitian=True))
    return alone > _SIGNAL * (noise.sum() - noise)
