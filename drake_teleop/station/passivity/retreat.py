"""Limit of the wrench on a retreating hand, for every method except `none`.

A released hand leaves the device alone with the wrench for a round trip: 4 N accelerate 0.15 kg to
2.7 m/s in 0.1 s. So the wrench fades where the hand moves along it faster than `retreat`, and is
zero at twice that speed. The methods account for the wrench that is held. It keeps the inertial
part (sigma > 0) that the slave's configured mass explains while the hand decelerates.
"""

from __future__ import annotations

from drake_teleop.common.compiled import njit
from drake_teleop.common.vectors import put
from drake_teleop.station.passivity.memory import HAND_VELOCITY, HELD_WRENCH, MASS, RETREAT
from drake_teleop.station.passivity.packet import dot, length, scale

_FILTER_S = 4e-3  # s, of the velocity: encoders have steps


@njit(cache=True)
def retreat(twist, T, p, memory, wrench):
    """Shorten the wrench (6,) at the hand in the master's power units.

    Args:
        twist: (6,) of the command before the channel [v; omega], in W.
        T: time between steps [s].
        p: parameters of the method.
        memory: of the master's end, updated.
        wrench: (6,) in W, updated.
    """
    velocity, rate = memory[HAND_VELOCITY], min(T / _FILTER_S, 1.0)
    for i in range(6):
        velocity[i] += rate * (twist[i] - velocity[i])
    for g in range(2):
        size = length(wrench, g)
        if size > 0.0:
            along = dot(wrench, velocity, g) / size
            slowing = (along - dot(wrench, twist, g) / size) / _FILTER_S
            share = max(2.0 - along / p[RETREAT][g], p[MASS][g] * slowing / size, 0.0)
            scale(wrench, g, min(share, 1.0))
    put(memory, HELD_WRENCH.start, wrench, 0, 6)
