"""Safety functions between force commands and the motors of a haptic device.

* Timeout: the force fades from 20 ms after the last command and is zero at 50 ms.
* Limits of force, torque and their slew rates.
* Passivity observer (Hannaford and Ryu 2002): a force that would return more energy than is stored
  is reduced.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drake_teleop.common.numeric import Array

COMMAND_TIMEOUT_S = 0.05  #: age of a command at which the force is zero [s]
_FORCE_FADE_START_AGE_S = 0.02  # s
_RECOVERY_N_PER_S = 100.0  # N/s, slew rate of the force limit after silence
_MAX_STORED_ENERGY_J, _STORED_ENERGY_KEPT_J = 0.3, 3e-5  # J
_MAX_DAMPING_NS_M = 100.0  # N s/m


@dataclass(frozen=True)
class DeviceLimits:
    """Limits of force [N], torque [N m] and their slew rates [N/s, N m/s]."""

    force: float
    torque: float = 0.0
    slew: float = 5000.0
    torque_slew: float = 50.0


class DeviceGuard:
    """Safety functions of one haptic device; `observe` enables the passivity observer.

    Attributes:
        energy: energy from the hand into the device since the start [J].
        num_reduced_forces: number of forces that the observer has reduced.
    """

    def __init__(self, limits: DeviceLimits, *, observe: bool = True) -> None:
        self.energy, self.num_reduced_forces = 0.0, 0
        self._limits, self._observe = limits, observe
        self._stored_energy, self._force_limit, self._was_silent = 0.0, limits.force, True
        self._force, self._torque, self._velocity = np.zeros((3, 3))
        self._position: Array | None = None

    def limit_wrench(
        self, position: Sequence[float], wrench: Sequence[float], command_age: float, period: float
    ) -> tuple[float, ...]:
        """Return `wrench` (6,) after all limits; `position` (3,) in B [m], times [s]."""
        x = np.array(position, dtype=float)
        motion = np.zeros(3) if self._position is None else x - self._position
        work = -float(self._force @ motion)
        self.energy += work
        self._stored_energy = min(self._stored_energy + work, _MAX_STORED_ENERGY_J)
        # Extrapolate the speed linearly, over a period of the same length.
        velocity = motion / period
        next_step = period * (2.0 * velocity - self._velocity)
        self._position, self._velocity = x, velocity

        share = self._restore_limit_and_get_fade_factor(command_age, period)
        force, torque = _zeros_if_any_not_finite(wrench[:3]), _zeros_if_any_not_finite(wrench[3:])
        limits = self._limits
        force = _limit_norm(share * force, min(limits.force, self._force_limit))
        torque = _limit_norm(share * torque, limits.torque)
        force = _limit_slew(self._force, force, limits.slew * period)
        torque = _limit_slew(self._torque, torque, limits.torque_slew * period)
        if share == 0.0:  # the timeout overrides the slew limit
            force, torque = np.zeros((2, 3))
        elif self._observe:
            force = _limit_norm(self._limit_force_by_energy(force, next_step), limits.force)
        self._force, self._torque = force, torque
        return tuple(np.concatenate([force, torque]).tolist())

    def reset_force_and_motion(self) -> None:
        self._force, self._torque, self._velocity = np.zeros((3, 3))
        self._position = None

    def _restore_limit_and_get_fade_factor(self, command_age: float, period: float) -> float:
        if not command_age < COMMAND_TIMEOUT_S:
            self._was_silent = True
        elif self._was_silent:
            self._was_silent, self._force_limit = False, 0.0
        self._force_limit = min(self._force_limit + _RECOVERY_N_PER_S * period, self._limits.force)
        share = (COMMAND_TIMEOUT_S - command_age) / (COMMAND_TIMEOUT_S - _FORCE_FADE_START_AGE_S)
        return min(max(share, 0.0), 1.0) if command_age < COMMAND_TIMEOUT_S else 0.0

    def _limit_force_by_energy(self, force: Array, next_step: Array) -> Array:
        distance, available = math.hypot(*next_step), self._stored_energy - _STORED_ENERGY_KEPT_J
        returned = float(force @ next_step)
        if returned <= available or distance < 1e-12 or not force.any():
            return force
        self.num_reduced_forces += 1
        force_along = returned / distance
        max_force = max(available / distance, -_MAX_DAMPING_NS_M * math.hypot(*self._velocity))
        return force - max(force_along - max_force, 0.0) / distance * next_step


def _zeros_if_any_not_finite(a: Sequence[float]) -> Array:
    vector = np.array(a, dtype=float)
    return vector if math.isfinite(vector.sum()) else np.zeros(3)


def _limit_norm(a: Array, max_norm: float) -> Array:
    length = math.hypot(*a)
    return a if length <= max_norm else max_norm / length * a


def _limit_slew(last: Array, requested: Array, max_change: float) -> Array:
    return last + _limit_norm(requested - last, max_change)
