"""Passive set-position modulation (Lee and Huang, T-RO 26(2), 2010).

A spring K pulls each end towards a set position y, and the set position may jump only as far as the
end can pay. An end stores the energy E; its account is

    E_k = E_(k-1) + received - sent + d_k - (K / 2) (|x_k - y_k|^2 - |x_k - y_(k-1)|^2)

where d_k is what its damper took since the last step, and y_k is the set position nearest to the
wanted one with E_k >= 0. Energy above a ceiling is sent from the hand to the slave (energy
shuffling) and lost at the slave: if it went round, a limit cycle could live on it for long. Neither
the delay nor a bound of the acceleration has to be known.

Lee and Huang take d_k >= B |dx|^2 / T of a damper in continuous time. Here a wrench is held over
a step, which makes a spring active; so d_k is what was put into the port, -f_(k-1) . dx_k, less
what the spring has gained by the motion. Then E plus the spring's energy is the energy of the true
port, to rounding. A step that costs more than was stored leaves E negative until it is paid back.

The port is that of hand and slave's *motors*, and so no energy comes out at the slave's actual
motion either, as long as the servo's K and D are those that were told: with 20 % more or less a
third of an adversary's runs create some. By default that is the servo of the reference of one
degree of freedom; a station's is stiffer (`slave.joint_control`), and has to be told.

At the slave spring and damper are the servo's, and the wanted position is the received pose. At the
hand the wanted position is where a spring K_h shows the received wrench, x + f / K_h, next to a
damper.
"""

# No postponed annotations here: yaml_load_typed reads the types of the dataclass's fields.
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.compiled import njit
from drake_teleop.common.fields import settings
from drake_teleop.common.quantities import quantity
from drake_teleop.common.vectors import put
from drake_teleop.station.passivity.memory import (
    COMMAND,
    COMMAND_POSE,
    COMMAND_TWIST,
    DAMPING,
    HELD,
    LEDGER,
    LOST,
    RECEIVED,
    SENT,
    STIFFNESS,
    own_memory,
    own_parameters,
)
from drake_teleop.station.passivity.packet import (
    ENERGY,
    POSE,
    VELOCITY,
    WRENCH,
    arrived,
    difference_into,
    dot,
    fill,
    limit,
    moved_into,
)

# Parameters, for translation and rotation.
_places = own_parameters()
_INITIAL, _CEILING = _places.vector(2), _places.vector(2)
_SPRING, _DAMPER = _places.vector(2), _places.vector(2)
# Memory: the set position less the position, and what is wanted of it.
_places = own_memory()
_OFFSET, _WANTED = _places.vector(6), _places.vector(6)

AT_THE_MOTOR = True  #: the port of its account, see `methods`


@settings
@dataclass
class PspmConfig:
    """Parameters of the passive set-position modulation."""

    initial: list[float] = quantity([0.01, 2e-4], "J", 0.0, 1e3, "E at the start")
    ceiling: list[float] = quantity(
        [0.015, 3e-4], "J", 0.0, 1e6, "of E; what is above is sent to the slave, there lost"
    )
    stiffness: list[float] = quantity(
        [1000.0, 10.0], "N/m, N m/rad", 1e-6, 1e9, "K_h, through which the hand feels"
    )
    damping: list[float] = quantity(
        [0.5, 0.005], "N s/m, N m s/rad", 0.0, 1e6, "B, shown to the hand"
    )

    def pack_into(self, p: NDArray[np.float64]) -> None:
        """Writes the values to where the steps read them."""
        p[_INITIAL], p[_CEILING] = self.initial, self.ceiling
        p[_SPRING], p[_DAMPER] = self.stiffness, self.damping


@njit(cache=True)
def initialize(p, memory):
    """Stores the energy of the start."""
    memory[LEDGER] = p[_INITIAL]


@njit(cache=True)
def _modulate(received, g, stiffness, dx, before, shuffle, p, memory, packet):
    """Moves the set position of group g as far towards the wanted one as can be paid for.

    In memory the wrench held since the last step and the set position less the position, now;
    `before` is the square of the latter at the last step. What is above the ceiling is sent, or
    (not `shuffle`) lost.
    """
    offset, wanted = memory[_OFFSET], memory[_WANTED]
    stored, needed = dot(offset, offset, g), dot(wanted, wanted, g)
    damped = -dot(memory[HELD], dx, g) - 0.5 * stiffness * (stored - before)
    ledger, accounted = memory[LEDGER], memory[RECEIVED]
    energy = ledger[g] + damped
    more = received[ENERGY][g] - accounted[g]
    if more > 0.0:
        energy += more
        accounted[g] += more
    most = stored + 2.0 * energy / stiffness
    share = 1.0 if needed <= max(most, 0.0) else math.sqrt(max(most, 0.0) / needed)
    for i in range(3 * g, 3 * g + 3):
        offset[i] = share * wanted[i]
    energy -= 0.5 * stiffness * (dot(offset, offset, g) - stored)
    surplus = max(energy - p[_CEILING][g], 0.0)
    if shuffle:
        memory[SENT][g] += surplus
    else:
        memory[LOST][g] += surplus
    ledger[g] = energy - surplus
    packet[ENERGY][g] = memory[SENT][g]


@njit(cache=True)
def master_step(received, fresh, pose, twist, dx, hand, limits, T, p, memory, wrench, packet):
    """One step of the master's end; see `methods.master_step`."""
    offset, wanted, shown = memory[_OFFSET], memory[_WANTED], received[WRENCH]
    K, B = p[_SPRING], p[_DAMPER]
    for g in range(2):
        before = dot(offset, offset, g)
        for i in range(3 * g, 3 * g + 3):
            offset[i] -= dx[i]
            wrench[i] = shown[i]
        limit(wrench, g, limits[g])
        for i in range(3 * g, 3 * g + 3):
            wanted[i] = wrench[i] / K[g]
        _modulate(received, g, K[g], dx, before, True, p, memory, packet)
        for i in range(3 * g, 3 * g + 3):
            wrench[i] = K[g] * offset[i] - B[g] * twist[i]
        limit(wrench, g, limits[g])
    put(memory, HELD.start, wrench, 0, 6)
    fill(pose, twist, wrench, packet)


@njit(cache=True)
def slave_step(received, fresh, pose, twist, dx, wrench, T, p, memory, command, packet):
    """One step of the slave's end; see `methods.slave_step`."""
    offset, wanted = memory[_OFFSET], memory[_WANTED]
    now, held, K, D = memory[COMMAND_POSE], memory[HELD], p[STIFFNESS], p[DAMPING]
    before = dot(offset, offset, 0), dot(offset, offset, 1)
    difference_into(now, pose, offset)
    put(wanted, 0, offset, 0, 6)
    if arrived(received):
        difference_into(received[POSE], pose, wanted)
        put(memory, COMMAND_TWIST.start, received, VELOCITY.start, 6)
    for g in range(2):
        _modulate(received, g, K[g], dx, before[g], False, p, memory, packet)
        for i in range(3 * g, 3 * g + 3):
            held[i] = K[g] * offset[i] - D[g] * twist[i]
    moved_into(pose, offset, now)
    put(command, 0, memory, COMMAND.start, 13)
    fill(pose, twist, wrench, packet)


@njit(cache=True)
def command_left(wanted, command, pose, twist, p, memory):
    """Notes how the servo pulls at the command that has left; see `methods.Methods`.

    What the spring has more of than was wanted is paid for.
    """
    offset, other, held = memory[_OFFSET], np.empty(6), memory[HELD]
    K, D = p[STIFFNESS], p[DAMPING]
    difference_into(command, pose, offset)
    difference_into(wanted, pose, other)
    for i in range(6):
        held[i] = K[i // 3] * offset[i] - D[i // 3] * twist[i]
    put(memory, COMMAND_POSE.start, command, 0, 7)
    for g in range(2):
        more = dot(offset, offset, g) - dot(other, other, g)
        memory[LEDGER][g] -= 0.5 * K[g] * more
