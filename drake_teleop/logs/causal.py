"""Contact wrench from past samples only, as in a control loop."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from drake_teleop.common.compiled import njit
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array

_ROOT_OF_2, _FOURTH_ROOT_OF_3 = math.sqrt(2.0), 3.0**0.25
CAUSAL_FILTER_MODES = ("delayed", "predicted")


@dataclass(frozen=True)
class CausalContactAndScaledWrench:
    """Contact and scaled wrench of N samples, each computed from past samples only.

    Attributes:
        mode: "delayed", or "predicted" (extrapolated over `lag_s`).
        lag_s: sum of the motion's delay and the delay of the low-pass [s].
        contact, scaled: (N, 6) F_c, and gamma F_c plus sigma times the load's wrench.
        offsets: (6,) subtracted sensor offsets [N, N m].
    """

    mode: str
    lag_s: float
    contact: Array
    scaled: Array
    offsets: Array = field(default_factory=lambda: np.zeros(6))


def causal_low_pass(x: Array, dt: float, cutoff_hz: float | None, ahead_s: float = 0.0) -> Array:
    """Filter samples x (N, ...) by a causal second-order Butterworth low-pass, Eq. (T11).

    Extrapolate the output over `ahead_s` [s] by its slope. A cut-off above Nyquist has no effect.
    """
    low_pass = low_pass_coefficients(dt, cutoff_hz, ahead_s)
    if not len(low_pass):
        return x
    from scipy.signal import lfilter

    b, a, settled = low_pass[:3], [1.0, *low_pass[3:5]], low_pass[5:]
    at_first = settled.reshape(2, *[1] * (x.ndim - 1)) * x[:1]
    return lfilter(b, a, x, axis=0, zi=at_first)[0]


def low_pass_coefficients(dt: float, cutoff_hz: float | None, ahead_s: float = 0.0) -> Array:
    """Return filter coefficients and steady state (7,); (0,) if the filter has no effect."""
    if cutoff_hz is None or cutoff_hz >= 0.5 / dt:
        if ahead_s != 0.0:
            what = f"{cutoff_hz} is not below {0.5 / dt:g} Hz, half the rate, for a prediction"
            remedy = "give a lower cut-off, or remove `predicted`"
            raise DrakeTeleopError(what, where="cutoff", remedy=remedy)
        return np.empty(0)
    low_pass = np.empty(7)
    design_low_pass(dt, math.tan(math.pi * cutoff_hz * dt), ahead_s, low_pass)
    return low_pass


@njit(cache=True)
def design_low_pass(dt, tangent, ahead_s, low_pass):
    """Write filter coefficients b (3), a (2) and settled state (2) to `low_pass` (7,), Eq. (T11).

    `tangent` is tan(pi cutoff dt), `ahead_s` [s] the time over which the output is extrapolated.
    """
    k = 2.0 / dt
    w = k * tangent / _FOURTH_ROOT_OF_3
    square, damping = w * w, _ROOT_OF_2 * w * k
    a = k * k + damping + square
    low_pass[0] = (square + ahead_s * square * k) / a
    low_pass[1] = (square + square) / a
    low_pass[2] = (square - ahead_s * square * k) / a
    low_pass[3] = 2.0 * (square - k * k) / a
    low_pass[4] = (k * k - damping + square) / a
    low_pass[6] = low_pass[2] - low_pass[4]
    low_pass[5] = low_pass[6] + low_pass[1] - low_pass[3]


def low_pass_delay_s(dt: float, cutoff_hz: float | None) -> float:
    """Return the delay [s] of `causal_low_pass` at low frequencies, without extrapolation."""
    if cutoff_hz is None or cutoff_hz >= 0.5 / dt:
        return 0.0
    return _ROOT_OF_2 / (2.0 / dt * math.tan(math.pi * cutoff_hz * dt) / _FOURTH_ROOT_OF_3)


def compute_causal_wrench(
    contact: Array, scaled: Array, dt: float, *, cutoff_hz: float | None, delay_s: float, mode: str
) -> CausalContactAndScaledWrench:
    """Return contact and scaled wrench (N, 6), low-passed as in a control loop.

    `delay_s`, the motion's delay behind the wrench, is rounded up to full samples. Mode "delayed"
    does not correct the lag; "predicted" extrapolates over it.
    """
    if mode not in CAUSAL_FILTER_MODES:
        what = f"{mode!r} is not a causal mode"
        raise DrakeTeleopError(what, where="causal", remedy=f"give one of {CAUSAL_FILTER_MODES}")
    wait = max(0, math.ceil(delay_s / dt - 1e-6))
    lag = wait * dt + low_pass_delay_s(dt, cutoff_hz)
    ahead = lag if mode == "predicted" else 0.0

    def filter_and_delay(wrench: Array) -> Array:
        filtered = causal_low_pass(wrench, dt, cutoff_hz, ahead)
        return filtered[np.maximum(np.arange(len(filtered)) - wait, 0)]

    contact, scaled = filter_and_delay(contact), filter_and_delay(scaled)
    return CausalContactAndScaledWrench(mode, lag, contact, scaled)
