"""Layout of a packet, (38,) float64, and vector operations of all passivity methods.

Vectors (6,) have two *groups* g of three: 0 is translation, 1 rotation.
"""

from __future__ import annotations

import math

from drake_teleop.common import vectors
from drake_teleop.common.compiled import njit
from drake_teleop.common.vectors import normalized_quaternion, quaternion_product
from drake_teleop.station.passivity.memory import RECEIVED_ENERGY, SlotAllocator

PACKET_SIZE = 38
_layout = SlotAllocator(PACKET_SIZE)
PACKET_NUMBER = _layout.number()  #: number of the packet, counted by its sender
#: 1 if the sender's inputs were finite; else 0, with the contents of its last good packet.
SENDER_INPUTS_FINITE = _layout.number()
POSE = _layout.vector(7)  #: X_WS [qw qx qy qz px py pz] of the sender
VELOCITY = _layout.vector(6)  #: twist of the sender [v; omega], in W
WRENCH = _layout.vector(6)  #: wrench at the sender [f; tau], in W, in the master's power units
METHOD_INTEGRAL = _layout.vector(6)  #: numbers of the method, such as a cumulative integral
CUMULATIVE_ENERGY = _layout.vector(2)  #: cumulative energy that the receiver may use, by group [J]
SECOND_ENERGY_COUNTER = _layout.vector(2)  #: second energy counter, by group [J]
CONTACT_FLAG = _layout.number()  #: 1 while the slave's detector reports contact
#: Part of the slave's wrench from weight and inertia of its load, as `WRENCH`. It is the last
#: field, because only `ledger` uses it; with other methods it is not transmitted.
PACKET_LOAD_WRENCH = _layout.vector(6)

#: Largest rate of force and torque at the hand that is not perceived as an impact [N/s, N m/s].
MAX_HAND_WRENCH_RATE = (450.0, 4.5)


@njit(cache=True)
def has_arrived(received):
    """Return whether a packet has arrived: before the first, `received` contains zeros."""
    pose = received[POSE]
    return pose[0] != 0.0 or pose[1] != 0.0 or pose[2] != 0.0 or pose[3] != 0.0


@njit(cache=True)
def count_newly_received_energy(g, received, memory):
    """Return the energy of group `g` received since the last call [J]; credit it in `memory`."""
    new = max(received[CUMULATIVE_ENERGY][g] - memory[RECEIVED_ENERGY][g], 0.0)
    memory[RECEIVED_ENERGY][g] += new
    return new


@njit(cache=True)
def fill_packet(pose, twist, wrench, packet):
    vectors.copy_into(packet, POSE.start, pose, 0, 7)
    vectors.copy_into(packet, VELOCITY.start, twist, 0, 6)
    vectors.copy_into(packet, WRENCH.start, wrench, 0, 6)


@njit(cache=True)
def dot_of_group(a, b, g):
    i = 3 * g
    return a[i] * b[i] + a[i + 1] * b[i + 1] + a[i + 2] * b[i + 2]


@njit(cache=True)
def length_of_group(a, g):
    i = 3 * g
    return math.hypot(math.hypot(a[i], a[i + 1]), a[i + 2])


@njit(cache=True)
def scale_group(a, g, s):
    for i in range(3 * g, 3 * g + 3):
        a[i] *= s


@njit(cache=True)
def limit_group(a, g, max_length):
    """Shorten group `g` of the vector `a` (6,) to at most `max_length`."""
    size = length_of_group(a, g)
    if size > max_length:
        scale_group(a, g, max_length / size)


@njit(cache=True)
def are_vectors_finite(vectors):
    rest = 0.0
    for vector in vectors:
        for x in vector:
            rest += x - x  # NaN if any x is not finite
    return rest == 0.0


@njit(cache=True)
def pose_difference_into(a, b, e):
    """Write the difference of two poses [quaternion wxyz; p] (7,) in W to `e` (6,) [m, rad].

    It is [p_a - p_b; log(R_a R_b^T)].
    """
    inverse = vectors.conjugate_quaternion((b[0], b[1], b[2], b[3]))
    turn = vectors.quaternion_logarithm(quaternion_product((a[0], a[1], a[2], a[3]), inverse))
    for i in range(3):
        e[i] = a[4 + i] - b[4 + i]
        e[3 + i] = turn[i]


@njit(cache=True)
def move_pose_into(pose, e, out):
    """Write the pose moved by `e` (6,), [exp(e_r) R; p + e_p], into `out` (7,)."""
    turn = vectors.quaternion_exponential((e[3], e[4], e[5]))
    q = normalized_quaternion(quaternion_product(turn, (pose[0], pose[1], pose[2], pose[3])))
    out[0], out[1], out[2], out[3] = q
    for i in range(3):
        out[4 + i] = pose[4 + i] + e[i]
