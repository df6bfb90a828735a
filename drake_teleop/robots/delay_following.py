"""By how much the motion's stamps come behind the wrench's, followed while it runs.

Clocks do not tell it: a driver may stamp what it filtered, or what it got late. The load does. With
the motion too early by e, the non-contact wrench V phi misses e times its slope g, so that of the
wrench r = o + g e is left, with offsets o. Least squares of the six channels together, with weights
that fade in `FADES_S`, gives

    e = sum_c w_c cov(g_c, r_c) / sum_c w_c var(g_c),    w_c = 1 / noise_c^2.

A contact is no noise: what offsets, noise, gains and a wrong delay cannot make is left out.
The delay moves to what is found, by `SLEWS` at most, and only while the standard deviation is below
`SURE_S`: a tool at rest shows nothing, and the last delay stays. It stays within `MOST_S`.
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
"""Time constant of what is remembered [s]."""
SURE_S = 5e-4
"""Standard deviation below which it is believed [s]."""
SLEWS = 0.005
"""How fast the delay may change [s/s]."""
MOST_S = 0.1
"""Delays of either sign [s]."""
FAR_S = 0.03
"""Error of the delay for which a sample may be off, until it is known [s]."""
NEAR_S = 0.004
"""Likewise then, beside what is not followed yet [s]."""
EVERY_S = 0.004
"""Samples are looked at so often."""
_OFFSETS = np.repeat([5.0, 0.25], 3)  # by which they may have drifted: as of a tare [N, N m]
_SIGMAS, _FIRST = 5.0, 50  # samples that tell the offsets

Motion = tuple[float, Array]
"""When [s], and s, omega, alpha (9,)."""


class DelayFollower:
    """Follows a delay.

    Args:
        load: whose wrench tells it.
        dt: between wrenches [s].
        cutoff_hz: see `raw_noise`.
        delay_s: to begin with [s].

    Attributes:
        delay_s: the present one [s].
    """

    def __init__(
        self, load: Identification, dt: float, cutoff_hz: float | None, delay_s: float
    ) -> None:
        self.delay_s = delay_s
        self._phi, self._noise = tuple(usable_phi(load)[0]), raw_noise(load, dt, cutoff_hz)
        self._weights, self._offsets = self._noise**-2, load.offsets.copy()
        self._wrenches = np.zeros((3, 6))
        self._forget(-math.inf)
        self.take((0.0, np.zeros(9)), self._offsets, (0.0, np.zeros(9)), (1.0, np.zeros(9)))
        self._forget(-math.inf)  # what is compiled is loaded now

    def _forget(self, t: float) -> None:
        self._t = self._fitted = t
        self._seen, self._count, self._sums = 0, 0.0, np.zeros((5, 6))
        self._far = FAR_S

    def take(self, at: Motion, wrench: Array, before: Motion, after: Motion) -> None:
        """A sample.

        Args:
            at: time of the wrench, and the motion by the present delay.
            wrench: (6,) as measured.
            before, after: motions around it, at times by the wrench's clock and that delay.
        """
        t, step = at[0], after[0] - before[0]
        passed = t - self._t
        if 0.0 <= passed < EVERY_S or step <= 0.0:
            return
        if not 0.0 <= t - self._fitted < FADES_S:  # another clock, or nothing fits any longer
            self._forget(t)
            passed = 0.0
        self._t = t
        for row, (_, of) in zip(self._wrenches, (at, before, after), strict=True):
            non_contact_wrench_into(of[:3], of[3:6], of[6:], self._phi, row)
        slope = (self._wrenches[2] - self._wrenches[1]) / step
        left = wrench - self._wrenches[0]
        if self._fits(left, slope):
            # What the present delay takes out is of the delay that is looked for.
            left = left + slope * self.delay_s
            fades = math.exp(-(t - self._fitted) / FADES_S)
            self._fitted, self._seen = t, self._seen + 1
            self._count = fades * self._count + 1.0
            products = slope, left, slope * slope, slope * left, left * left
            self._sums = fades * self._sums + np.stack(products)
            self._move(min(passed, FADES_S))

    def _fits(self, left: Array, slope: Array) -> bool:
        """Whether offsets, noise, gains and a delay can make this of it."""
        few = self._seen < _FIRST
        may_be = _SIGMAS * self._noise + self._far * np.abs(slope)
        may_be += MODEL_ERROR * np.abs(self._wrenches[0]) + few * _OFFSETS
        offsets = self._offsets
        if not few:
            offsets = (self._sums[1] - self._sums[0] * self.delay_s) / self._count
        return bool((np.abs(left - offsets) < may_be).all())

    def _move(self, passed: float) -> None:
        """Towards the delay that is found, if one is."""
        if self._seen < _FIRST:
            return
        g, r, gg, gr, rr = self._sums / self._count
        shown = float(self._weights @ (gg - g * g))
        if shown <= 0.0:
            return
        found = float(self._weights @ (gr - g * r)) / shown
        rest = rr - r * r - found * (gr - g * r)
        louder = max(1.0, float(self._weights @ rest) / 6.0)  # than the noise that was stated
        self._far = FAR_S
        if math.sqrt(louder / (shown * self._count)) < SURE_S:
            most = SLEWS * passed
            goes = min(MOST_S, max(-MOST_S, found)) - self.delay_s
            self.delay_s += min(most, max(-most, goes))
            self._far = min(FAR_S, NEAR_S + abs(goes))
