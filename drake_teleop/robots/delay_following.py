"""Tracking of the motion's delay behind the wrench, from the wrench of the load.

If the motion is early by e, the residual wrench is r = o + g e, with offsets o and g the slope of
V phi. Least squares over the channels c, with weights that fade in `FADES_S`, gives

    e = sum_c w_c cov(g_c, r_c) / sum_c w_c var(g_c),    w_c = 1 / noise_c^2.
"""

from __future__ import annotations

import math

import numpy as np

from drake_teleop.common.arrays import Array
from drake_teleop.load.identification import Identification
from drake_teleop.load.regressor import non_contact_wrench_into
from drake_teleop.logs.processing import usable_phi
from drake_teleop.robots.watch import MODEL_ERROR, raw_noise

FADES_S = 10.0
"""Time constant of the weights [s]."""
SURE_S = 5e-4
"""Maximum standard deviation of a usable estimate [s]."""
SLEWS = 0.005
"""Maximum rate of change of the delay [s/s]."""
MOST_S = 0.1
"""Maximum magnitude of the delay [s]."""
FAR_S = 0.03
"""Error of the delay that the residual of a sample may contain at first [s]."""
NEAR_S = 0.004
"""The same when the delay is known, in addition to the remaining correction [s]."""
EVERY_S = 0.004
"""Period of the evaluated samples [s]."""
_OFFSETS = np.repeat([5.0, 0.25], 3)  # maximum drift, as for a tare [N, N m]
_SIGMAS, _FIRST = 5.0, 50  # samples before offsets are estimated

Motion = tuple[float, Array]
"""Time [s], and s, omega, alpha (9,)."""


class DelayFollower:
    """Tracked delay `delay_s` [s] of the motion."""

    def __init__(
        self, load: Identification, dt: float, cutoff_hz: float | None, delay_s: float
    ) -> None:
        self.delay_s = delay_s
        self._phi, self._noise = tuple(usable_phi(load)[0]), raw_noise(load, dt, cutoff_hz)
        self._weights, self._offsets = self._noise**-2, load.offsets.copy()
        self._wrenches = np.zeros((3, 6))
        self._forget(-math.inf)
        self.take((0.0, np.zeros(9)), self._offsets, (0.0, np.zeros(9)), (1.0, np.zeros(9)))
        self._forget(-math.inf)  # loads compiled code before the first sample

    def _forget(self, t: float) -> None:
        self._t = self._fitted = t
        self._seen, self._count, self._sums = 0, 0.0, np.zeros((5, 6))
        self._far = FAR_S

    def take(self, at: Motion, wrench: Array, before: Motion, after: Motion) -> None:
        """Take a wrench (6,), its motion at the present delay, and both neighbours."""
        t, step = at[0], after[0] - before[0]
        passed = t - self._t
        if 0.0 <= passed < EVERY_S or step <= 0.0:
            return
        if not 0.0 <= t - self._fitted < FADES_S:  # another clock, or no explained sample for long
            self._forget(t)
            passed = 0.0
        self._t = t
        for row, (_, of) in zip(self._wrenches, (at, before, after), strict=True):
            non_contact_wrench_into(of[:3], of[3:6], of[6:], self._phi, row)
        slope = (self._wrenches[2] - self._wrenches[1]) / step
        left = wrench - self._wrenches[0]
        if self._fits(left, slope):
            # The sums refer to zero delay; the motion is already shifted by the present one.
            left = left + slope * self.delay_s
            fades = math.exp(-(t - self._fitted) / FADES_S)
            self._fitted, self._seen = t, self._seen + 1
            self._count = fades * self._count + 1.0
            products = slope, left, slope * slope, slope * left, left * left
            self._sums = fades * self._sums + np.stack(products)
            self._move(min(passed, FADES_S))

    def _fits(self, left: Array, slope: Array) -> bool:
        """Return whether the residual is explained without contact."""
        few = self._seen < _FIRST
        may_be = _SIGMAS * self._noise + self._far * np.abs(slope)
        may_be += MODEL_ERROR * np.abs(self._wrenches[0]) + few * _OFFSETS
        offsets = self._offsets
        if not few:
            offsets = (self._sums[1] - self._sums[0] * self.delay_s) / self._count
        return bool((np.abs(left - offsets) < may_be).all())

    def _move(self, passed: float) -> None:
        """Slew the delay towards a sufficiently accurate estimate."""
        if self._seen < _FIRST:
            return
        g, r, gg, gr, rr = self._sums / self._count
        shown = float(self._weights @ (gg - g * g))
        if shown <= 0.0:
            return
        found = float(self._weights @ (gr - g * r)) / shown
        rest = rr - r * r - found * (gr - g * r)
        louder = max(1.0, float(self._weights @ rest) / 6.0)  # variance over the stated noise
        self._far = FAR_S
        if math.sqrt(louder / (shown * self._count)) < SURE_S:
            most = SLEWS * passed
            goes = min(MOST_S, max(-MOST_S, found)) - self.delay_s
            self.delay_s += min(most, max(-most, goes))
            self._far = min(FAR_S, NEAR_S + abs(goes))
