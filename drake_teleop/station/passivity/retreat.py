"""What every method but `none` does to the wrench at last: a hand that retreats is not chased.

A hand that lets go while it presses leaves the device alone with the wrench, which goes on until
the slave's news have come, a round trip later: 4 N take a device of 0.15 kg to 2.7 m/s in 0.1 s.
So where the hand moves along the wrench faster than `retreat`, the wrench fades, and at twice that
speed it is gone. It does no work then, and no method need know: each counts what was really held,
or counts more.

A wrench along the motion may also be inertia that is felt (sigma > 0), of a hand that slows down.
So as much of it stays as the slave's believed mass takes for that. A device of less mass is not
driven by it: whoever is pushed does not slow down.
"""

from __future__ import annotations

from drake_teleop.common.compiled import njit
from drake_teleop.common.vectors import put
from drake_teleop.station.passivity.memory import HAND_VELOCITY, HELD, MASS, RETREAT
from drake_teleop.station.passivity.packet import dot, length, scale

_FILTER = 4e-3  # s, of velocity: encoders have steps


@njit(cache=True)
def retreat(twist, T, p, memory, wrench):
    """Shortens the wrench (6,) at the hand, that is held from now on; in master power units.

    Args:
        twist: (6,) of the command before the channel [v; omega], in W.
        T: time between steps [s].
        p: parameters of the method.
        memory: of the master's end, changed.
        wrench: (6,) in W, changed.
    """
    velocity, rate = memory[HAND_VELOCITY], min(T / _FILTER, 1.0)
    for i in range(6):
        velocity[i] += rate * (twist[i] - velocity[i])
    for g in range(2):
        size = length(wrench, g)
        if size > 0.0:
            along = dot(wrench, velocity, g) / size
            slowing = (along - dot(wrench, twist, g) / size) / _FILTER
            share = max(2.0 - along / p[RETREAT][g], p[MASS][g] * slowing / size, 0.0)
            scale(wrench, g, min(share, 1.0))
    put(memory, HELD.start, wrench, 0, 6)
