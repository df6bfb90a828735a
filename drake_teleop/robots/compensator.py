"""Contact wrench of each reading; a flagged zero for each invalid reading.

Good readings pass the kernels of `eliminate --causal`, with bit-equal results. After a fault of
`STALE_S` the low-pass restarts in its steady state.

The source's time t is related to our clock by the least (now - t), which rises by `DRIFT`. The
excess of (now - t) is the age of a reading; if it lasts for `JUMP_S`, the clock was set.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from drake_teleop.common.arrays import Array
from drake_teleop.load.identification import Identification
from drake_teleop.logs.causal import filter_lag, low_pass_coefficients
from drake_teleop.logs.processing import usable_phi
from drake_teleop.robots.detector import Detector
from drake_teleop.robots.live_step import (
    AT_RANGE,
    NOT_FINITE,
    TOO_LARGE,
    clipped,
    doubts,
    eliminated_into,
)
from drake_teleop.robots.streams import ONLY_SAID, VALUES, Compensated, Flag, Reading
from drake_teleop.robots.watch import Watch

STALE_S = 0.05
"""Age above which the wrench is zero [s]."""
JUMP_S = 1.0
"""Larger steps between two clocks indicate a clock that was set [s]."""
DRIFT = 1e-3
"""Maximum relative drift of two clocks [s/s]."""
RATE_OFF = 0.05
"""Tolerated relative error of the rate, over `_RATE_OF` readings and `_RATE_S`."""
TARE_S = 0.5
"""Time at rest before a tare [s]."""
_RATE_OF, _RATE_S = 200, 0.4  # readings, [s]: longer than a burst
_LATEST = 1e12  # [s]
_LARGEST = np.repeat([1e5, 1e4, 1e4, 1e3, 1e6], 3)
# Integers, because each operation on a `Flag` takes a microsecond.
_DAMAGED, _STALE, _CLIPPED = int(Flag.DAMAGED), int(Flag.STALE), int(Flag.CLIPPED)
_ONLY_SAID, _GAP, _WRONG_RATE = int(ONLY_SAID), int(Flag.GAP), int(Flag.WRONG_RATE)
_IN_CONTACT = int(Flag.IN_CONTACT)
_DOUBTS = {NOT_FINITE: Flag.NOT_FINITE, TOO_LARGE: Flag.OUT_OF_RANGE, AT_RANGE: Flag.SATURATED}
# Maximum rms at rest: specific force [m/s^2], angular velocity [rad/s]; wrench, as a multiple of
# the residual of the identification, and at least [N, N m].
_MOVED, _TURNING = 0.1, 0.02
_WAVERS, _WAVERS_LEAST = 4.0, np.repeat([0.1, 0.005], 3)


class Compensator:
    """Conversion of readings to wrenches.

    Args:
        sigma, gamma: scales of load wrench and contact wrench in the scaled wrench.
        wait: readings by which the motion comes late, already aligned by the source.
        predicted: extrapolate over wait and low-pass.
        largest: (6,) range of the sensor [N, N m].
        detector: flags contact instead of `watch`.
        tare_limit: maximum drift of the offsets [N], [N m].

    Attributes:
        offsets: (6,) of the sensor [N, N m].
        lag_s: delay of a slow contact without prediction [s].
        rested: number of successive good readings.
    """

    def __init__(
        self,
        load: Identification,
        dt: float,
        *,
        sigma: float = 0.0,
        gamma: float = 1.0,
        cutoff_hz: float | None = 30.0,
        wait: int = 0,
        predicted: bool = False,
        largest: Array | None = None,
        watch: Watch | None = None,
        detector: Detector | None = None,
        tare_limit: tuple[float, float] = (5.0, 0.25),
    ) -> None:
        self._phi, self._nothing = usable_phi(load)[0], np.zeros(10)
        self._scales, self._dt = np.array([sigma, sigma, gamma], float), dt
        self.offsets = load.offsets.copy()
        self.lag_s = wait * dt + filter_lag(dt, cutoff_hz)
        self._low_pass, self._watch, self._detector = np.empty(0), watch, detector
        if cutoff_hz is not None and cutoff_hz < 0.5 / dt:
            b, a, settled = low_pass_coefficients(dt, cutoff_hz, self.lag_s if predicted else 0.0)
            self._low_pass = np.concatenate([b, a[1:], settled])
        self._range = np.full(6, np.inf) if largest is None else np.array(largest, float)
        self._largest = np.concatenate([np.minimum(_LARGEST[:6], 2.0 * self._range), _LARGEST[6:]])
        self._wavers = np.maximum(_WAVERS * load.residual_rms, _WAVERS_LEAST)
        self._tare_limit = np.repeat(tare_limit, 3)
        self._memory = np.full((2, 12), np.nan)
        self._late: deque[Array] = deque(maxlen=wait + 1)
        self._number, self._t, self._now = -1, 0.0, -math.inf
        self._offset = math.inf  # least (now - t)
        self._in_time = -math.inf  # arrival of the last reading in time
        self._since, self._first, self._readings, self._rate_off = 0.0, 0, 0, 0
        self._rate_of = max(_RATE_OF, round(_RATE_S / dt))
        self._rest = np.zeros((max(2, round(TARE_S / dt)), VALUES + 6))
        self.rested = 0
        # Load compiled code now; otherwise the first readings would be stale.
        doubts(np.zeros(VALUES), self._largest, self._range)
        clipped(self._eliminated(np.zeros(VALUES)), self._range)
        self._settle_anew()
        self.rested = 0

    def step(self, reading: Reading, now: float) -> Compensated:
        """Return the output for a reading received at `now` of a monotonic clock."""
        flags = self._judge(reading, now)
        wrong = flags & ~_ONLY_SAID
        if wrong & ~_GAP:
            return self._zero(flags)
        if now - self._now > STALE_S:
            self._settle_anew()
        self._now, self._number, self._t = now, reading.number, reading.t
        self._late.append(self._eliminated(reading.values))
        if wrong:
            return self._zero(flags)
        if self._watch is not None:
            flags |= self._watch.flags(reading.values)
        if self._detector is not None:
            flags &= ~_IN_CONTACT
            flags |= self._detector.flags(reading.values, self._late[-1][:6])
        wrench = self._late[0].copy()
        if clipped(wrench, self._range):
            flags |= _CLIPPED
        return Compensated(reading.number, reading.t, wrench[:6], wrench[6:], flags)

    def idle(self, now: float) -> Compensated | None:
        """Return a stale zero wrench if nothing came for `STALE_S`, else None."""
        if now - self._now <= STALE_S:
            return None
        return self._zero(_STALE)

    def left(self, now: float) -> float:
        """Return the time until the last reading is stale [s]."""
        return max(0.0, self._now + STALE_S - now)

    def tare(self) -> str:
        """Set the offsets to their mean in `TARE_S`; return the result or why it is refused."""
        if self.rested < len(self._rest):
            return f"refused: there are not {TARE_S:g} s of good readings yet"
        spread = self._rest.std(axis=0)
        turning = float(np.abs(self._rest[:, 9:12]).mean(axis=0).max())
        if spread[6:9].max() > _MOVED or turning > _TURNING:
            return "refused: it moves"
        if (spread[VALUES:] > self._wavers).any():
            return "refused: the wrench wavers, as in contact"
        step = self._rest[:, VALUES:].mean(axis=0)
        if (np.abs(step) > self._tare_limit).any():
            force, torque = np.linalg.norm(step[:3]), np.linalg.norm(step[3:])
            return (
                f"refused: {force:.3g} N and {torque:.3g} N m are more than offsets drift:"
                " something is touched, or it is another load"
            )
        self.offsets = self.offsets + step
        if self._watch is not None:
            self._watch.restart(self.offsets)
        if self._detector is not None:
            self._detector.restart()
        self.rested = 0
        return "done: offsets moved by " + " ".join(f"{x:+.3g}" for x in step)

    def _judge(self, reading: Reading, now: float) -> int:
        """Return the flags of a reading and update the clocks."""
        flags = reading.flags
        if flags & _DAMAGED:
            return _DAMAGED
        doubt = doubts(reading.values, self._largest, self._range)
        if not math.isfinite(reading.t):
            doubt = NOT_FINITE
        elif abs(reading.t) > _LATEST and doubt != NOT_FINITE:
            doubt = TOO_LARGE
        if doubt:
            flags |= int(_DOUBTS[doubt])
        if doubt in (NOT_FINITE, TOO_LARGE):
            return flags
        ahead = now - reading.t
        known = not math.isinf(self._offset)
        step = reading.t - self._t
        # Out-of-order readings are mixed with ordered ones; only such readings mean a restart.
        lost = now - self._now > STALE_S
        if known and reading.number <= self._number and (abs(step) > JUMP_S or lost):
            return self._anew(reading, ahead, flags | int(Flag.RESTART))
        if known and (abs(ahead - self._offset) > JUMP_S or (step <= 0.0 and lost)):
            return self._anew(reading, ahead, flags | int(Flag.CLOCK_JUMP))
        if known and step <= 0.0:
            return flags | int(Flag.REORDERED)
        if known and reading.number <= self._number:
            return self._anew(reading, ahead, flags | int(Flag.RESTART))
        self._offset = min(ahead, self._offset + (DRIFT * self._dt if known else 0.0))
        if ahead - self._offset <= STALE_S:
            self._in_time = now
        elif now - self._in_time > JUMP_S:
            return self._anew(reading, ahead, flags | int(Flag.CLOCK_JUMP))
        else:
            flags |= _STALE
        return flags | self._rate(reading)

    def _anew(self, reading: Reading, ahead: float, flags: int) -> int:
        """Accept the clock of this reading and restart."""
        self._offset, self._number, self._t = ahead, reading.number, reading.t
        self._readings, self._rate_off, self.rested = 0, 0, 0
        self._now = self._in_time = reading.t + ahead
        self._settle_anew()
        return flags

    def _settle_anew(self) -> None:
        self._memory[:] = np.nan
        if self._detector is not None:
            self._detector.restart()
        self._late.clear()

    def _rate(self, reading: Reading) -> int:
        if self._readings == 0:
            self._since, self._first = reading.t, reading.number
        self._readings += 1
        if self._readings > self._rate_of:
            spacing = (reading.t - self._since) / max(1, reading.number - self._first)
            off = abs(spacing / self._dt - 1.0) > RATE_OFF
            self._rate_off, self._readings = _WRONG_RATE if off else 0, 0
        return self._rate_off

    def _eliminated(self, values: Array) -> Array:
        """Return low-passed contact and scaled wrench (12,)."""
        out = np.empty(12)
        at = self.rested % len(self._rest)
        load = self._phi, self._nothing, self._scales
        kept = self._low_pass, self._memory, self._rest, at
        eliminated_into(values, self.offsets, *load, *kept, out)
        self.rested += 1
        return out

    def _zero(self, flags: int) -> Compensated:
        self.rested = 0
        return Compensated(max(0, self._number), self._t, np.zeros(6), np.zeros(6), int(flags))
