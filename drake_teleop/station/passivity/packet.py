"""Layout of a packet (38,), and vector operations of all passivity methods.

Vectors (6,) have two *groups* g of three: 0 is translation, 1 rotation.
"""

from __future__ import annotations

import math

from drake_teleop.common import vectors
from drake_teleop.common.compiled import njit
from drake_teleop.common.vectors import normalized_quaternion, quaternion_product
from drake_teleop.station.passivity.memory import RECEIVED_ENERGY, SlotAllocator

PACKET_SIZE = 38
_packet_slots = SlotAllocator(PACKET_SIZE)
PACKET_NUMBER = _packet_slots.number()  #: number of the packet, counted by its sender
#: 1 if the sender's inputs were finite; else 0, with the contents of its last good packet.
SENDER_INPUTS_FINITE = _packet_slots.number()
POSE = _packet_slots.vector(7)  #: X_WS [qw qx qy qz px py pz] of the sender
VELOCITY = _packet_slots.vector(6)  #: twist of the sender [v; omega], in W
WRENCH = _packet_slots.vector(6)  #: wrench at the sender [f; tau], in W, master's power units
METHOD_VALUES = _packet_slots.vector(6)  #: values that the method defines, such as a wave integral
CUMULATIVE_ENERGY = _packet_slots.vector(2)  #: energy ever sent to the receiver, by group [J]
SENDER_ENERGY = _packet_slots.vector(2)  #: energy stored at the sender, by group [J]
CONTACT_FLAG = _packet_slots.number()  #: 1 while the slave's detector reports contact
#: Part of the slave's wrench from weight and inertia of its load, as `WRENCH`. It is the last
#: field, because only `ledger` uses it; with other methods it is not transmitted.
PACKET_LOAD_WRENCH = _packet_slots.vector(6)

#: Largest rate of force and torque at the hand that is not perceived as an impact [N/s, N m/s].
MAX_HAND_WRENCH_RATES = (450.0, 4.5)


@njit(cache=True)
def has_packet_arrived(received):
    """Return whether a packet has arrived: before the first, `received` contains zeros."""
    pose = received[POSE]
    return pose[0] != 0.0 or pose[1] != 0.0 or pose[2] != 0.0 or pose[3] != 0.0


@njit(cache=True)
def count_newly_received_energy(g, received, memory):
    """Return the energy of group `g` received since the last call [J]; count it as received."""
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
def length_of_group(vector, g):
    i = 3 * g
    return math.hypot(math.hypot(vector[i], vector[i + 1]), vector[i + 2])


@njit(cache=True)
def scale_group(vector, g, factor):
    for i in range(3 * g, 3 * g + 3):
        vector[i] *= factor


@njit(cache=True)
def limit_group(vector, g, max_length):
    size = length_of_group(vector, g)
    if size > max_length:
        scale_group(vector, g, max_length / size)


@njit(cache=True)
def are_vectors_finite(vectors):
    rest = 0.0
    for vector in vectors:
        for x in vector:
            rest += x - x  # NaN if any x is not finite
    return rest == 0.0


@njit(cache=True)
def pose_difference_into(pose, reference, difference):
    """Write the difference (6,) [m, rad] of two poses (7,), [quaternion wxyz; p] in W.

    It is [p - p_reference; log(R R_reference^T)].
    """
    inverse = vectors.conjugate_quaternion(vectors.quaternion_at(reference, 0))
    turn = vectors.quaternion_logarithm(quaternion_product(vectors.quaternion_at(pose, 0), inverse))
    for i in range(3):
        difference[i] = pose[4 + i] - reference[4 + i]
        difference[3 + i] = turn[i]


@njit(cache=True)
def move_pose_into(pose, displacement, out):
    """Write `pose` (7,), moved by a displacement (6,) [translation; rotation vector], to `out`."""
    turn = vectors.quaternion_exponential((displacement[3], displacement[4], displacement[5]))
    q = normalized_quaternion(quaternion_product(turn, (pose[0], pose[1], pose[2], pose[3])))
    out[0], out[1], out[2], out[3] = q
    for i in range(3):
        out[4 + i] = pose[4 + i] + displacement[i]
