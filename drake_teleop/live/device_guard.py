"""Safety functions between force commands and the motors of a haptic device.

* Timeout: the force fades from 20 ms after the last command and is zero at 50 ms. Afterwards its
  limit rises from zero by 100 N/s.
* Limits of force, torque and their slew rates.
* Passivity observer (Hannaford and Ryu 2002) of the stored energy E += -f_k . (x_k+1 - x_k), at
  most 0.3 J. A force that would return more than E along the extrapolated displacement is reduced,
  at most to that of a damper of 100 N s/m; 30 uJ cover the extrapolation error.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

COMMAND_TIMEOUT_S = 0.05  #: age of a command at which the force is zero [s]
_FADE_START_S = 0.02  # s
_FORCE_RETURN_N_S = 100.0  # N/s
_MAX_ENERGY_J, _RESERVE_J = 0.3, 3e-5  # J
_MAX_DAMPING_NS_M = 100.0  # N s/m

_Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Limits:
    """Limits of force [N], torque [N m] and their slew rates [N/s, N m/s]."""

    force: float
    torque: float = 0.0
    slew: float = 5000.0
    torque_slew: float = 50.0


class DeviceGuard:
    """Safety functions of one haptic device; `observe` enables the passivity observer.

    Attributes:
        energy: energy from the hand into the device since the start [J].
        slowed: number of forces that the observer has reduced.
    """

    def __init__(self, limits: Limits, *, observe: bool = True) -> None:
        self.energy, self.slowed = 0.0, 0
        self._limits, self._observe = limits, observe
        self._stored_energy, self._force_limit, self._was_silent = 0.0, limits.force, True
        self._force: _Vector = (0.0, 0.0, 0.0)
        self._torque: _Vector = (0.0, 0.0, 0.0)
        self._position: _Vector | None = None
        self._velocity: _Vector = (0.0, 0.0, 0.0)

    def tick(
        self, position: Sequence[float], wrench: Sequence[float], age: float, period: float
    ) -> tuple[float, ...]:
        """Return the wrench to display (6,) [N, N m].

        Args:
            position: (3,) position of the device [m].
            wrench: (6,) last commanded wrench [N, N m].
            age: age of this command [s].
            period: time since the last tick [s].
        """
        x = (float(position[0]), float(position[1]), float(position[2]))
        last = self._position or x
        motion = (x[0] - last[0], x[1] - last[1], x[2] - last[2])
        work = -_dot(self._force, motion)
        self.energy += work
        self._stored_energy = min(self._stored_energy + work, _MAX_ENERGY_J)
        # Extrapolate the speed linearly, over a period of the same length.
        velocity, last_velocity = _times(1.0 / period, motion), self._velocity
        next_motion = (
            period * (2.0 * velocity[0] - last_velocity[0]),
            period * (2.0 * velocity[1] - last_velocity[1]),
            period * (2.0 * velocity[2] - last_velocity[2]),
        )
        self._position, self._velocity = x, velocity

        share = self._command_share(age, period)
        force, torque = _finite_or_zero(wrench[:3]), _finite_or_zero(wrench[3:])
        limits = self._limits
        force = _limit_norm(_times(share, force), min(limits.force, self._force_limit))
        torque = _limit_norm(_times(share, torque), limits.torque)
        force = _limit_slew(self._force, force, limits.slew * period)
        torque = _limit_slew(self._torque, torque, limits.torque_slew * period)
        if share == 0.0:  # the timeout overrides the slew limit
            force, torque = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        elif self._observe:
            force = _limit_norm(self._limit_energy(force, next_motion, period), limits.force)
        self._force, self._torque = force, torque
        return (*force, *torque)

    def _command_share(self, age: float, period: float) -> float:
        if not age < COMMAND_TIMEOUT_S:
            self._was_silent = True
        elif self._was_silent:
            self._was_silent, self._force_limit = False, 0.0
        self._force_limit = min(self._force_limit + _FORCE_RETURN_N_S * period, self._limits.force)
        return (
            min(max((COMMAND_TIMEOUT_S - age) / (COMMAND_TIMEOUT_S - _FADE_START_S), 0.0), 1.0)
            if age < COMMAND_TIMEOUT_S
            else 0.0
        )

    def _limit_energy(self, force: _Vector, next_motion: _Vector, period: float) -> _Vector:
        distance, available = math.hypot(*next_motion), self._stored_energy - _RESERVE_J
        returned = _dot(force, next_motion)
        if returned <= available or distance < 1e-12 or force == (0.0, 0.0, 0.0):
            return force
        self.slowed += 1
        force_along = returned / distance
        max_force = max(available / distance, -_MAX_DAMPING_NS_M * math.hypot(*self._velocity))
        reduction = max(force_along - max_force, 0.0) / distance
        return (
            force[0] - reduction * next_motion[0],
            force[1] - reduction * next_motion[1],
            force[2] - reduction * next_motion[2],
        )


def _dot(a: _Vector, b: _Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _times(share: float, a: _Vector) -> _Vector:
    return (share * a[0], share * a[1], share * a[2])


def _finite_or_zero(a: Sequence[float]) -> _Vector:
    x, y, z = float(a[0]), float(a[1]), float(a[2])
    return (x, y, z) if math.isfinite(x + y + z) else (0.0, 0.0, 0.0)


def _limit_norm(a: _Vector, longest: float) -> _Vector:
    length = math.hypot(*a)
    return a if length <= longest else _times(longest / length, a)


def _limit_slew(last: _Vector, wanted: _Vector, max_force: float) -> _Vector:
    step = (wanted[0] - last[0], wanted[1] - last[1], wanted[2] - last[2])
    step = _limit_norm(step, max_force)
    return (last[0] + step[0], last[1] + step[1], last[2] + step[2])
