"""What a packet holds, and the small vector operations that the methods share.

One layout serves every method and both directions: (32,) float64. Counters and integrals are
cumulative, so a receiver takes differences to the newest packet that it has, and lost, late or
doubled packets do no harm.

Vectors of six are two *groups* of three, translation first: a ledger is one number for each group
and a limit shortens a group without turning it, so that no result depends on the world's axes.
"""

from __future__ import annotations

import math

from drake_teleop._compiled import njit
from drake_teleop.quaternions import conjugate, exponential, logarithm, multiply, normalized

SEQUENCE = 0  #: number of the packet, counted by its sender
HEALTHY = 1  #: 1 if the sender's inputs were finite, else 0 (all else is then its last good packet)
POSE = 2  #: (7,) X_WS [qw qx qy qz px py pz] of the sender
VELOCITY = 9  #: (6,) its twist [v; omega], in W
WRENCH = 15  #: (6,) its wrench [f; tau], in W, in the master's power units
INTEGRAL = 21  #: (6,) cumulative integral, of the method's choice
ENERGY = 27  #: (2,) cumulative energy that the receiver may use, for each group [J]
OTHER_ENERGY = 29  #: (2,) a second counter of energy, for each group [J]
CONTACT = 31  #: 1 while the slave's detector says that something is touched
PACKET_SIZE = 32


@njit(cache=True)
def arrived(received):
    """Whether anything was received yet: before that a receiver has zeros."""
    return (
        received[POSE] != 0.0
        or received[POSE + 1] != 0.0
        or received[POSE + 2] != 0.0
        or received[POSE + 3] != 0.0
    )


@njit(cache=True)
def fill(pose, twist, wrench, packet):
    """Writes pose, twist and wrench of the sender into its packet."""
    for i in range(7):
        packet[POSE + i] = pose[i]
    for i in range(6):
        packet[VELOCITY + i] = twist[i]
        packet[WRENCH + i] = wrench[i]


@njit(cache=True)
def dot(a, b, g):
    """a . b of group g: 0 translation, 1 rotation."""
    i = 3 * g
    return a[i] * b[i] + a[i + 1] * b[i + 1] + a[i + 2] * b[i + 2]


@njit(cache=True)
def length(a, g):
    """|a| of group g; does not overflow."""
    i = 3 * g
    return math.hypot(math.hypot(a[i], a[i + 1]), a[i + 2])


@njit(cache=True)
def scale(a, g, s):
    """a <- s a in group g."""
    for i in range(3 * g, 3 * g + 3):
        a[i] *= s


@njit(cache=True)
def limit(a, g, most):
    """Shortens group g of `a` to the length `most`."""
    size = length(a, g)
    if size > most:
        scale(a, g, most / size)


@njit(cache=True)
def finite(a):
    """Whether every number of the vector is finite."""
    rest = 0.0
    for x in a:
        rest += x - x  # not a number as soon as one x is not finite
    return rest == 0.0


@njit(cache=True)
def difference_into(a, b, e):
    """e (6,) = [p_a - p_b; log(R_a R_b^T)] of two poses (7,), in W."""
    turn = logarithm(multiply((a[0], a[1], a[2], a[3]), conjugate((b[0], b[1], b[2], b[3]))))
    for i in range(3):
        e[i] = a[4 + i] - b[4 + i]
        e[3 + i] = turn[i]


@njit(cache=True)
def moved_into(pose, e, out):
    """out (7,) = the pose moved by e (6,): [exp(e_r) R; p + e_p]. It may be `pose` itself."""
    turn = exponential((e[3], e[4], e[5]))
    q = normalized(multiply(turn, (pose[0], pose[1], pose[2], pose[3])))
    for i in range(4):
        out[i] = q[i]
    for i in range(3):
        out[4 + i] = pose[4 + i] + e[i]
