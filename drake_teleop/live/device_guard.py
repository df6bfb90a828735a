"""What stands between a force command and a haptic device's motors, beside the device.

It knows which force was set and how far the device then moved, which nobody else knows in time:

* silence: 20 ms after the last command the force fades, at 50 ms it is zero; afterwards it
  may grow by 100 N/s;
* the device's largest force and torque, and their largest slew;
* a passivity observer (Hannaford and Ryu 2002): the energy that the hand has put in through this
  port, E += -f_k . (x_k+1 - x_k). Before each tick the next motion is foreseen to be the last one,
  and once again what it differed from the one before. What the force would give out along it
  beyond E is taken off it, as by a damper of 100 N s/m at most. 30 uJ are kept back, once, for no
  motion is foreseen exactly. Held from tick to tick a stiff wall gives out more than was put in;
  so does one that is late.

The energy that may come out again is bounded, so that a wall does not live on what was rubbed off
long ago; E itself, from the beginning, is then never less than what is counted.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

SILENT = 0.05  #: without a command the force is zero from then on [s]
_FADES = 0.02  # s
_RETURNS = 100.0  # N/s
_MOST, _RESERVE = 0.3, 3e-5  # J
_DAMPER = 100.0  # N s/m

_Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Limits:
    """Of a device: force [N], torque [N m], slew of the force [N/s] and of the torque [N m/s]."""

    force: float
    torque: float = 0.0
    slew: float = 5000.0
    torque_slew: float = 50.0


class DeviceGuard:
    """One tick after another; see the module.

    Attributes:
        energy: that the hand has put in since the beginning [J].
        slowed: how often the observer has changed the force.

    Args:
        limits: of the device.
        observe: whether passivity is observed.
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
        """The wrench to be set now (6,) [N, N m].

        Args:
            position: (3,) where the device is [m].
            wrench: (6,) the last command [N, N m].
            age: of that [s].
            period: since the last tick [s].
        """
        x = (float(position[0]), float(position[1]), float(position[2]))
        last = self._position or x
        moved = (x[0] - last[0], x[1] - last[1], x[2] - last[2])
        given = -_dot(self._force, moved)
        self.energy += given
        self._available = min(self._available + given, _MOST)
        # As fast as it was, and faster by as much as it has become; for as long as now.
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
        if share == 0.0:  # whatever the slew: at 50 ms there is none
            force, torque = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        elif self._observe:
            force = _shortened(self._passive(force, coming, period), limits.force)
        self._force, self._torque = force, torque
        return (*force, *torque)

    def _share(self, age: float, period: float) -> float:
        """Of a command of that age; counts how much force is allowed after silence."""
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
    """It, or zero if it is not finite."""
    x, y, z = float(a[0]), float(a[1]), float(a[2])
    return (x, y, z) if math.isfinite(x + y + z) else (0.0, 0.0, 0.0)


def _shortened(a: _Vector, longest: float) -> _Vector:
    length = math.hypot(*a)
    return a if length <= longest else _times(longest / length, a)


def _slewed(last: _Vector, wanted: _Vector, most: float) -> _Vector:
    step = (wanted[0] - last[0], wanted[1] - last[1], wanted[2] - last[2])
    step = _shortened(step, most)
    return (last[0] + step[0], last[1] + step[1], last[2] + step[2])
