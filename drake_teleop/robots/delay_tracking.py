"""Tracking of the motion's delay behind the wrench, from the wrench of the load.

If the motion is early by e, the residual wrench is r = o + g e, with the offsets o and the time
derivative g of the load's wrench V phi. Least squares over the channels c, with weights that fade
in `FADE_TIME_S`, gives

    e = sum_c w_c cov(g_c, r_c) / sum_c w_c var(g_c),    w_c = 1 / noise_c^2.
"""

from __future__ import annotations

import math

import numpy as np

from drake_teleop.common.numeric import Array
from drake_teleop.load.identification import Identification
from drake_teleop.load.regressor import non_contact_wrench_into
from drake_teleop.logs.processing import usable_phi
from drake_teleop.robots.compensator import MAX_OFFSET_DRIFT
from drake_teleop.robots.watch import MODEL_ERROR, raw_noise

FADE_TIME_S = 10.0
"""Time constant of the weights [s]."""
MAX_STD_S = 5e-4
"""Maximum standard deviation of a usable estimate [s]."""
MAX_SLEW = 0.005
"""Maximum rate of change of the delay [s/s]."""
MAX_DELAY_S = 0.1
"""Maximum magnitude of the delay [s]."""
INITIAL_ERROR_S = 0.03
"""Delay error that the residual of a sample may contain before the delay is known [s]."""
TRACKING_ERROR_S = 0.004
"""Delay error in a residual once the delay is known, besides the remaining correction [s]."""
SAMPLE_PERIOD_S = 0.004
"""Period of the evaluated samples [s]."""
_SIGMAS, _MIN_SAMPLES = 5.0, 50  # samples before offsets are estimated

Motion = tuple[float, Array]
"""Time [s], and s, omega, alpha (9,)."""


class DelayTracker:
    """Estimator of the motion's delay behind the wrench, `delay_s` [s]."""

    def __init__(
        self, load: Identification, dt: float, cutoff_hz: float | None, delay_s: float
    ) -> None:
        self.delay_s = delay_s
        self._phi, self._noise = tuple(usable_phi(load)[0]), raw_noise(load, dt, cutoff_hz)
        self._weights, self._offsets = self._noise**-2, load.offsets.copy()
        self._wrenches = np.zeros((3, 6))
        self._reset(-math.inf)
        self.take((0.0, np.zeros(9)), self._offsets, (0.0, np.zeros(9)), (1.0, np.zeros(9)))
        self._reset(-math.inf)  # the call above loads compiled code before the first sample

    def _reset(self, t: float) -> None:
        self._t = self._fitted = t
        self._samples, self._count, self._sums = 0, 0.0, np.zeros((5, 6))
        self._delay_error = INITIAL_ERROR_S

    def take(self, at: Motion, wrench: Array, before: Motion, after: Motion) -> None:
        """Update the delay with a wrench (6,), its motion `at`, and the neighbouring motions."""
        t, step = at[0], after[0] - before[0]
        elapsed = t - self._t
        if 0.0 <= elapsed < SAMPLE_PERIOD_S or step <= 0.0:
            return
        # Another clock, or no explained sample for long.
        if not 0.0 <= t - self._fitted < FADE_TIME_S:
            self._reset(t)
            elapsed = 0.0
        self._t = t
        for row, (_, motion) in zip(self._wrenches, (at, before, after), strict=True):
            non_contact_wrench_into(motion[:3], motion[3:6], motion[6:], self._phi, row)
        slope = (self._wrenches[2] - self._wrenches[1]) / step
        residual = wrench - self._wrenches[0]
        if self._is_explained(residual, slope):
            # The sums refer to zero delay; the motion is already shifted by the present one.
            residual = residual + slope * self.delay_s
            fade = math.exp(-(t - self._fitted) / FADE_TIME_S)
            self._fitted, self._samples = t, self._samples + 1
            self._count = fade * self._count + 1.0
            products = slope, residual, slope * slope, slope * residual, residual * residual
            self._sums = fade * self._sums + np.stack(products)
            self._slew_delay(min(elapsed, FADE_TIME_S))

    def _is_explained(self, residual: Array, slope: Array) -> bool:
        starting = self._samples < _MIN_SAMPLES
        limit = _SIGMAS * self._noise + self._delay_error * np.abs(slope)
        limit += MODEL_ERROR * np.abs(self._wrenches[0]) + starting * MAX_OFFSET_DRIFT
        offsets = self._offsets
        if not starting:
            offsets = (self._sums[1] - self._sums[0] * self.delay_s) / self._count
        return bool((np.abs(residual - offsets) < limit).all())

    def _slew_delay(self, elapsed: float) -> None:
        if self._samples < _MIN_SAMPLES:
            return
        g, r, gg, gr, rr = self._sums / self._count
        information = float(self._weights @ (gg - g * g))
        if information <= 0.0:
            return
        estimate = float(self._weights @ (gr - g * r)) / information
        rest = rr - r * r - estimate * (gr - g * r)
        noise_ratio = max(1.0, float(self._weights @ rest) / 6.0)  # variance over the stated noise
        self._delay_error = INITIAL_ERROR_S
        if math.sqrt(noise_ratio / (information * self._count)) < MAX_STD_S:
            max_change = MAX_SLEW * elapsed
            correction = min(MAX_DELAY_S, max(-MAX_DELAY_S, estimate)) - self.delay_s
            self.delay_s += min(max_change, max(-max_change, correction))
            self._delay_error = min(INITIAL_ERROR_S, TRACKING_ERROR_S + abs(correction))
