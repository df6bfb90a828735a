"""Safety functions between force commands and the motors of a haptic device.

* Timeout: the force fades from 20 ms after the last command and is zero at 50 ms; its limit then
  rises by 100 N/s.
* Limits of force, torque and their slew rates.
* Passivity observer (Hannaford and Ryu 2002) of the energy into the port,
  E += -f_k . (x_k+1 - x_k), at most 0.3 J. The next displacement is extrapolated from the last two.
  A force that would return more than E is reduced, by at most a damper of 100 N s/m; a reserve
  of 30 uJ covers the extrapolation error.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

SILENT = 0.05  #: age of a command at which the force is zero [s]
_FADES = 0.02  # s
_RETURNS = 100.0  # N/s
_MOST, _RESERVE = 0.3, 3e-5  # J
_DAMPER = 100.0  # N s/m

_Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Limits:
    """Limits of force [N], torque [N m] and their slew rates [N/s, N m/s]."""

    force: float
    torque: float = 0.0
    slew: float = 5000.0
    torque_slew: float = 50.0


class DeviceGuard:
    """Safety functions of one device; see the module.

    Attributes:
        energy: of the hand into the device since the start [J].
        slowed: number of forces that the passivity observer has changed.
    """

    def __init__(self, limits: Limits, *, observe: bool = True) -> None:
        self.energy, self.slowed = 0.0, 0
        self._limits, self._observe = limits, observe
        self._available, self._allowed, self._quiet = 0.0, limits.force, True
        self._force: _Vector = (0.0, 0.0, 0.0)
        self._torque: _Vector = (0.0, 0.0, 0.0)
        self._position: _Vector | None = None
        self._speed: _Vector = (0.0, 0.0, 0.0)

    def tick(
        self, position: Sequence[float], wrench: Sequence[float], age: float, period: float
    ) -> tuple[float, ...]:
        """Return the wrench to display (6,) [N, N m].

        Args:
            position: (3,) of the device [m].
            wrench: (6,) last command [N, N m].
            age: of the command [s].
            period: since the last tick [s].
        """
        x = (float(position[0]), float(position[1]), float(position[2]))
        last = self._position or x
        moved = (x[0] - last[0], x[1] - last[1], x[2] - last[2])
        given = -_dot(self._force, moved)
        self.energy += given
        self._available = min(self._available + given, _MOST)
        # Extrapolate the speed linearly, over a period of the same length.
        speed, before = _times(1.0 / period, moved), self._speed
        coming = (
            period * (2.0 * speed[0] - before[0]),
            period * (2.0 * speed[1] - before[1]),
            period * (2.0 * speed[2] - before[2]),
        )
        self._position, self._speed = x, speed

        share = self._share(age, period)
        force, torque = _sound(wrench[:3]), _sound(wrench[3:])
        limits = self._limits
        force = _shortened(_times(share, force), min(limits.force, self._allowed))
        torque = _shortened(_times(share, torque), limits.torque)
        force = _slewed(self._force, force, limits.slew * period)
        torque = _slewed(self._torque, torque, limits.torque_slew * period)
        if share == 0.0:  # the timeout overrides the slew limit
            force, torque = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        elif self._observe:
            force = _shortened(self._passive(force, coming, period), limits.force)
        self._force, self._torque = force, torque
        return (*force, *torque)

    def _share(self, age: float, period: float) -> float:
        if not age < SILENT:
            self._quiet = True
        elif self._quiet:
            self._quiet, self._allowed = False, 0.0
        self._allowed = min(self._allowed + _RETURNS * period, self._limits.force)
        return min(max((SILENT - age) / (SILENT - _FADES), 0.0), 1.0) if age < SILENT else 0.0

    def _passive(self, force: _Vector, coming: _Vector, period: float) -> _Vector:
        distance, there = math.hypot(*coming), self._available - _RESERVE
        out = _dot(force, coming)
        if out <= there or distance < 1e-12 or force == (0.0, 0.0, 0.0):
            return force
        self.slowed += 1
        along = out / distance
        most = max(there / distance, -_DAMPER * math.hypot(*self._speed))
        off = max(along - most, 0.0) / distance
        return (
            force[0] - off * coming[0],
            force[1] - off * coming[1],
            force[2] - off * coming[2],
        )


def _dot(a: _Vector, b: _Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _times(share: float, a: _Vector) -> _Vector:
    return (share * a[0], share * a[1], share * a[2])


def _sound(a: Sequence[float]) -> _Vector:
    x, y, z = float(a[0]), float(a[1]), float(a[2])
    return (x, y, z) if math.isfinite(x + y + z) else (0.0, 0.0, 0.0)


def _shortened(a: _Vector, longest: float) -> _Vector:
    length = math.hypot(*a)
    return a if length <= longest else _times(longest / length, a)


def _slewed(last: _Vector, wanted: _Vector, most: float) -> _Vector:
    step = (wanted[0] - last[0], wanted[1] - last[1], wanted[2] - last[2])
    step = _shortened(step, most)
    return (last[0] + step[0], last[1] + step[1], last[2] + step[2])
