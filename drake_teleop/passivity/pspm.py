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

At the slave spring and damper are the servo's, and the wanted position is the received pose. At the
hand the wanted position is where a spring K_h shows the received wrench, x + f / K_h, next to a
damper.
"""

# No postponed annotations here: yaml_load_typed reads the types of the dataclass's fields.
import math
from dataclasses import dataclass

from drake_teleop._compiled import njit
from drake_teleop.passivity.memory import (
    COMMAND,
    DAMPING,
    HELD,
    LEDGER,
    LIMIT,
    LOST,
    METHOD,
    OWN,
    RECEIVED,
    SENT,
    STIFFNESS,
)
from drake_teleop.passivity.packet import (
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
from drake_teleop.quantities import quantity

# Parameters, for translation and rotation.
_INITIAL, _CEILING, _SPRING, _DAMPER = METHOD, METHOD + 2, METHOD + 4, METHOD + 6
# Memory: the set position less the position, and what is wanted of it.
OFFSET, _WANTED = OWN, OWN + 6


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

    def packed(self) -> list[float]:
        """The values in the order in which the steps read them."""
        return [*self.initial, *self.ceiling, *self.stiffness, *self.damping]


@njit(cache=True)
def initialize(p, memory):
    """Stores the energy of the start."""
    for g in range(2):
        memory[LEDGER + g] = p[_INITIAL + g]


@njit(cache=True)
def _modulate(received, g, stiffness, dx, before, shuffle, p, memory, packet):
    """Moves the set position of group g as far towards the wanted one as can be paid for.

    In memory the wrench held since the last step and the set position less the position, now;
    `before` is the square of the latter at the last step. What is above the ceiling is sent, or
    (not `shuffle`) lost.
    """
    offset, wanted = memory[OFFSET : OFFSET + 6], memory[_WANTED : _WANTED + 6]
    stored, needed = dot(offset, offset, g), dot(wanted, wanted, g)
    damped = -dot(memory[HELD : HELD + 6], dx, g) - 0.5 * stiffness * (stored - before)
    energy = memory[LEDGER + g] + damped
    more = received[ENERGY + g] - memory[RECEIVED + g]
    if more > 0.0:
        energy += more
        memory[RECEIVED + g] += more
    most = stored + 2.0 * energy / stiffness
    share = 1.0 if needed <= max(most, 0.0) else math.sqrt(max(most, 0.0) / needed)
    for i in range(3 * g, 3 * g + 3):
        offset[i] = share * wanted[i]
    energy -= 0.5 * stiffness * (dot(offset, offset, g) - stored)
    surplus = max(energy - p[_CEILING + g], 0.0)
    memory[SENT + g if shuffle else LOST + g] += surplus
    memory[LEDGER + g] = energy - surplus
    packet[ENERGY + g] = memory[SENT + g]


@njit(cache=True)
def master_step(received, fresh, pose, twist, dx, hand, T, p, memory, wrench, packet):
    """One step of the master's end; see `methods.master_step`."""
    offset, wanted = memory[OFFSET : OFFSET + 6], memory[_WANTED : _WANTED + 6]
    for g in range(2):
        before = dot(offset, offset, g)
        for i in range(3 * g, 3 * g + 3):
            offset[i] -= dx[i]
            wrench[i] = received[WRENCH + i]
        limit(wrench, g, p[LIMIT + g])
        for i in range(3 * g, 3 * g + 3):
            wanted[i] = wrench[i] / p[_SPRING + g]
        _modulate(received, g, p[_SPRING + g], dx, before, True, p, memory, packet)
        for i in range(3 * g, 3 * g + 3):
            wrench[i] = p[_SPRING + g] * offset[i] - p[_DAMPER + g] * twist[i]
        limit(wrench, g, p[LIMIT + g])
    memory[HELD : HELD + 6] = wrench
    fill(pose, twist, wrench, packet)


@njit(cache=True)
def slave_step(received, fresh, pose, twist, dx, wrench, T, p, memory, command, packet):
    """One step of the slave's end; see `methods.slave_step`."""
    offset, wanted = memory[OFFSET : OFFSET + 6], memory[_WANTED : _WANTED + 6]
    now = memory[COMMAND : COMMAND + 7]
    before = dot(offset, offset, 0), dot(offset, offset, 1)
    difference_into(now, pose, offset)
    wanted[:] = offset
    if arrived(received):
        difference_into(received[POSE : POSE + 7], pose, wanted)
        memory[COMMAND + 7 : COMMAND + 13] = received[VELOCITY : VELOCITY + 6]
    for g in range(2):
        _modulate(received, g, p[STIFFNESS + g], dx, before[g], False, p, memory, packet)
        for i in range(3 * g, 3 * g + 3):
            memory[HELD + i] = p[STIFFNESS + g] * offset[i] - p[DAMPING + g] * twist[i]
    moved_into(pose, offset, now)
    command[:] = memory[COMMAND : COMMAND + 13]
    fill(pose, twist, wrench, packet)
