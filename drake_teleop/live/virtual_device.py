"""Simulated haptic device in a simulated hand."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TypeAlias

from drake_teleop.station.operator.operator import GRIP_IMPEDANCES

_SIMULATION_STEPS_PER_MS = 10  # per ms
_MASS_KG, _DAMPING_NS_M = 0.15, 0.5  # of the device [kg], [N s/m]
HandMotion: TypeAlias = Callable[[float], tuple[Sequence[float], Sequence[float]]]
"""Function from time [s] to intended position [m] and velocity [m/s]."""


class VirtualDevice:
    """Simulated device in a moving hand; `energy`: work against the rendered force [J]."""

    def __init__(self, hand_motion: HandMotion, grip: str = "medium") -> None:
        held, self._hand = GRIP_IMPEDANCES[grip], hand_motion
        self._mass, self._k, self._d = _MASS_KG + held.mass, held.stiffness, held.damping
        self.position, self.velocity = list(map(float, hand_motion(0.0)[0])), [0.0, 0.0, 0.0]
        self.energy, self._t = 0.0, 0.0

    def simulate_motion(self, force: Sequence[float], seconds: float) -> None:
        """Simulate `seconds` under a constant force (3,) on the hand [N]."""
        steps = max(math.ceil(seconds * 1e3 * _SIMULATION_STEPS_PER_MS - 1e-9), 1)
        h = seconds / steps
        for _ in range(steps):
            self._t += h
            at, speed = self._hand(self._t)
            for i in range(3):
                x, v = self.position[i], self.velocity[i]
                elastic, damped = self._k * (at[i] - x), self._d * (speed[i] - v)
                pull = force[i] - _DAMPING_NS_M * v + elastic + damped
                v += h * pull / self._mass
                self.velocity[i], self.position[i] = v, x + h * v
                self.energy -= force[i] * h * v


def tapping_motion(depth: float, *, hertz: float = 0.5) -> HandMotion:
    """Return a hand motion along z between 10 mm and -`depth` [m], `hertz` times a second."""
    lift, hold = 0.01, 0.6

    def hand_motion(t: float) -> tuple[Sequence[float], Sequence[float]]:
        phase, way = (t * hertz) % 1.0, 0.5 * (1.0 - hold)
        if phase < way:
            s, rate = phase / way, 1.0
        elif phase < way + hold:
            s, rate = 1.0, 0.0
        else:
            s, rate = (1.0 - phase) / way, -1.0
        smooth, slope = s * s * (3.0 - 2.0 * s), 6.0 * s * (1.0 - s) * rate * hertz / way
        far = depth + lift
        return (0.0, 0.0, lift - far * smooth), (0.0, 0.0, -far * slope)

    return hand_motion
