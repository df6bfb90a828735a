"""The contact wrench as a loop would have had it: from the past alone, late or predicted.

The zero-phase low-pass of `alignment` looks ahead. A loop cannot: its low-pass is a Butterworth
filter of second order that halves the amplitude at the same cut-off. It lags by sqrt(2) / w at low
frequencies (9.8 ms at 30 Hz), w = 2 pi cut-off / 3^(1/4), and a motion that comes later than the
wrench has to be waited for. Wrench and motion are aligned first and the result is filtered, so that
the elimination itself does not suffer from the lag; all that is late is the contact wrench. The
sensor's offsets are those that a loop knows beforehand: the load file's, or of a start of the
record in which nothing is touched.

Prediction extrapolates the filter's output by its slope over the whole lag L: the filter becomes
(1 + L s) H(s), whose delay is zero at low frequencies. The price is noise and overshoot: with no
motion to wait for the rms of white noise grows by sqrt(3).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.errors import DrakeTeleopError

MODES = ("delayed", "predicted")


@dataclass(frozen=True)
class CausalWrench:
    """Wrenches from the past alone, at the instants of the log, N samples.

    Args:
        mode: one of `MODES`.
        lag_s: L, by how much a slow contact comes late, or would without the prediction [s].
        contact: (N, 6) Eq. (13).
        scaled: (N, 6) gamma F_c + sigma V phi.
        offsets: (6,) of the sensor, known before: those of the load file or of the record's start.
    """

    mode: str
    lag_s: float
    contact: NDArray[np.float64]
    scaled: NDArray[np.float64]
    offsets: NDArray[np.float64] = field(default_factory=lambda: np.zeros(6))


def causal_low_pass(
    x: NDArray[np.float64], dt: float, cutoff_hz: float | None, ahead_s: float = 0.0
) -> NDArray[np.float64]:
    """Butterworth low-pass of second order along the first axis, settled at the first sample.

    Args:
        x: (N, ...) samples.
        dt: their spacing [s].
        cutoff_hz: where the amplitude is halved, as by `alignment.low_pass`; None, or anything
            above the Nyquist rate, leaves `x` as it is.
        ahead_s: the output's slope times this is added [s].

    Raises:
        DrakeTeleopError: for a prediction without a filter, whose slope would be all noise.
    """
    if cutoff_hz is None or cutoff_hz >= 0.5 / dt:
        if ahead_s != 0.0:
            raise DrakeTeleopError(
                "a prediction needs a low-pass",
                where="cutoff",
                remedy="give a cut-off below half the rate of the log, or causal mode `delayed`",
            )
        return x
    from scipy.signal import lfilter

    b, a, settled = low_pass_coefficients(dt, cutoff_hz, ahead_s)
    at_first = settled.reshape(2, *[1] * (x.ndim - 1)) * x[:1]
    return lfilter(b, a, x, axis=0, zi=at_first)[0]


def low_pass_coefficients(
    dt: float, cutoff_hz: float, ahead_s: float = 0.0
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Of `causal_low_pass`: b (3,), a (3,) and the memory (2,) that is settled at 1.

    Args:
        dt, cutoff_hz, ahead_s: see there; the cut-off is below the Nyquist rate.
    """
    # SciPy's filters take longer to import than all the rest of the command.
    from scipy.signal import bilinear, lfilter_zi

    w = _prewarped(cutoff_hz, dt)
    b, a = bilinear([ahead_s * w * w, w * w], [1.0, math.sqrt(2.0) * w, w * w], 1.0 / dt)
    return b, a, lfilter_zi(b, a)


def filter_lag(dt: float, cutoff_hz: float | None) -> float:
    """The delay of `causal_low_pass` at low frequencies [s]."""
    if cutoff_hz is None or cutoff_hz >= 0.5 / dt:
        return 0.0
    return math.sqrt(2.0) / _prewarped(cutoff_hz, dt)


def causal_wrenches(
    contact: NDArray[np.float64],
    scaled: NDArray[np.float64],
    dt: float,
    *,
    cutoff_hz: float | None,
    delay_s: float,
    mode: str,
) -> CausalWrench:
    """What a loop would have put out at each instant.

    Args:
        contact, scaled: (N, 6) each from wrench and motion of the same instants, not filtered.
        dt: their spacing [s].
        cutoff_hz: of the low-pass.
        delay_s: how far the motion lags behind the wrench [s]; if positive it is waited for, to
            the next full sample.
        mode: "delayed" leaves the lag, "predicted" extrapolates over it.

    Raises:
        DrakeTeleopError: for another mode, or a prediction without a low-pass.
    """
    if mode not in MODES:
        raise DrakeTeleopError(
            f"{mode!r} is not a causal mode", where="causal", remedy=f"give one of {MODES}"
        )
    wait = max(0, math.ceil(delay_s / dt - 1e-6))
    lag = wait * dt + filter_lag(dt, cutoff_hz)
    ahead = lag if mode == "predicted" else 0.0

    def late(wrench: NDArray[np.float64]) -> NDArray[np.float64]:
        filtered = causal_low_pass(wrench, dt, cutoff_hz, ahead)
        rows = np.maximum(np.arange(len(filtered)) - wait, 0)
        return filtered[rows]

    return CausalWrench(mode, lag, late(contact), late(scaled))


def _prewarped(cutoff_hz: float, dt: float) -> float:
    """The analogue rate w [rad/s]: 1 / (1 + (v / w)^4) is 1/4 for v that falls on `cutoff_hz`."""
    return 2.0 / dt * math.tan(math.pi * cutoff_hz * dt) / 3.0**0.25
