"""Two-layer control with energy tanks (Franken et al., T-RO 27(4), 2011).

The transparency layer wants the received wrench at the hand and the received pose at the slave. The
passivity layer holds a tank of energy at each end: work done at its port flows in or out, a share
of the level is sent to the other end in every step, and a wrench is shortened to what the tank can
pay for. At the slave's end the port is that of its motors, whose pull K (x_command - x) - D v is
shortened through the command.

A wrench is held until the next step, so its work is f_(k-1) . (x_k - x_(k-1)): known only
afterwards. The next step cannot differ from the last one by more than a T^2, so a wrench may
cost f . dx + |f| a T^2 at most; this is what the tank must hold (Franken's |f| |dx| would
forbid even a wrench that brakes). At the hand a is `acceleration`; at the slave it is that, which
walls cause, and |f| / m, which its motors cause: they pull hard at a command that has jumped.
What is sent leaves the tank *before* that is asked. So the tanks are never overdrawn, between hand
and slave's *motors*, whatever the network does, as long as the hand and the walls accelerate no
more than `acceleration`, and the servo's K, D and the slave's mass m (or more) are those that were
told: by default those of the reference of one degree of freedom; a station's arm is stiffer and
heavier (`slave.joint_control`), so these values must be set. The energy at the actual
motion is then never negative either: energy of the motors that the wall does not get moves the
slave or is lost in friction. A tank that was overdrawn all the same carries its deficit.

A slave that is slower than a T might pay even for its brake: with an empty tank it would coast
on for ever. So the slave keeps a reserve that is neither sent nor spent on the spring; only the
brake may use it.

Where the tank of the master is below its level, a damper on the hand fills it. Of what the tank
holds the wrench may drain only a share in a step, which takes the edge off an empty tank; small
tanks end a limit cycle soon, because it lives on what they hold.
"""

# No postponed annotations here: yaml_load_typed reads the types of the dataclass's fields.
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
    MASS,
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
    length,
    limit,
    moved_into,
    scale,
)

# Parameters; those of two numbers are for translation and rotation.
_places = own_parameters()
_SEND, _DRAIN = _places.number(), _places.number()
_INITIAL, _LEVEL, _CAPACITY = _places.vector(2), _places.vector(2), _places.vector(2)
_DAMPER, ACCELERATION = _places.vector(2), _places.vector(2)
_RESERVE = 0.01  # share of the capacity
# Memory of the slave: pull of the spring, pull of the damper.
_places = own_memory()
_SPRING, _BRAKE = _places.vector(6), _places.vector(6)

AT_THE_MOTOR = True  #: the port of its account, see `methods`


@settings
@dataclass
class TwoLayerConfig:
    """Parameters of the energy tanks."""

    send_rate: float = quantity(5.0, "1/s", 0.0, 1e6, "share of a tank that is sent in a second")
    drain_rate: float = quantity(
        10.0, "1/s", 0.0, 1e6, "share of the master's tank that the wrench may drain in a second"
    )
    initial: list[float] = quantity([0.01, 2e-4], "J", 0.0, 1e3, "what a tank holds at the start")
    level: list[float] = quantity(
        [0.01, 2e-4], "J", 0.0, 1e3, "below which the hand is damped to fill the master's tank"
    )
    capacity: list[float] = quantity(
        [0.015, 3e-4], "J", 0.0, 1e6, "what a tank holds at most; the rest is lost"
    )
    damper: list[float] = quantity(
        [500.0, 100.0], "N s/m/J, N m s/rad/J", 0.0, 1e6, "damping of the hand for each J missing"
    )
    acceleration: list[float] = quantity(
        [20.0, 200.0], "m/s^2, rad/s^2", 0.0, 1e6, "a_max, largest acceleration of either end"
    )

    def pack_into(self, p: NDArray[np.float64]) -> None:
        """Writes the values to where the steps read them."""
        p[_SEND], p[_DRAIN] = self.send_rate, self.drain_rate
        p[_INITIAL], p[_LEVEL], p[_CAPACITY] = self.initial, self.level, self.capacity
        p[_DAMPER], p[ACCELERATION] = self.damper, self.acceleration


@njit(cache=True)
def initialize(p, memory):
    """Fills the tank at the start."""
    memory[LEDGER] = p[_INITIAL]


@njit(cache=True)
def _exchange(received, dx, T, p, memory, packet):
    """Work of the held wrench, receiving and sending: all before a new wrench is limited."""
    ledger, accounted, sent_so_far = memory[LEDGER], memory[RECEIVED], memory[SENT]
    held, capacity = memory[HELD], p[_CAPACITY]
    for g in range(2):
        level = ledger[g] - dot(held, dx, g)
        more = received[ENERGY][g] - accounted[g]
        if more > 0.0:
            level += more
            accounted[g] += more
        sent = min(T * p[_SEND], 1.0) * max(level - _RESERVE * capacity[g], 0.0)
        level -= sent
        lost = max(level - capacity[g], 0.0)
        sent_so_far[g] += sent
        memory[LOST][g] += lost
        ledger[g] = level - lost
        packet[ENERGY][g] = sent_so_far[g]


@njit(cache=True)
def _cost(f, dx, g, acceleration, T):
    """The most that a wrench can cost until the next step [J]."""
    return dot(f, dx, g) + length(f, g) * acceleration * T * T


@njit(cache=True)
def _afford(f, dx, g, acceleration, T, memory):
    """Shortens group g of a wrench to what the tank can pay for."""
    cost, level = _cost(f, dx, g, acceleration, T), max(memory[LEDGER][g], 0.0)
    if cost > level:
        scale(f, g, level / cost)


@njit(cache=True)
def master_step(received, fresh, pose, twist, dx, hand, limits, T, p, memory, wrench, packet):
    """One step of the master's end; see `methods.master_step`."""
    _exchange(received, dx, T, p, memory, packet)
    ledger, wanted = memory[LEDGER], received[WRENCH]
    for g in range(2):
        damping = p[_DAMPER][g] * max(p[_LEVEL][g] - ledger[g], 0.0)
        for i in range(3 * g, 3 * g + 3):
            wrench[i] = wanted[i] - damping * twist[i]
        limit(wrench, g, limits[g])
        drained = dot(wrench, dx, g)
        most = min(T * p[_DRAIN], 1.0) * max(ledger[g], 0.0)
        if drained > most:
            scale(wrench, g, most / drained)
        _afford(wrench, dx, g, p[ACCELERATION][g], T, memory)
    put(memory, HELD.start, wrench, 0, 6)
    fill(pose, twist, wrench, packet)


@njit(cache=True)
def slave_step(received, fresh, pose, twist, dx, wrench, T, p, memory, command, packet):
    """One step of the slave's end; see `methods.slave_step`."""
    spring, brake = memory[_SPRING], memory[_BRAKE]
    _exchange(received, dx, T, p, memory, packet)
    target = memory[COMMAND_POSE]
    if arrived(received):
        target = received[POSE]
    difference_into(target, pose, spring)
    pull, K, D = memory[HELD], p[STIFFNESS], p[DAMPING]
    for g in range(2):
        for i in range(3 * g, 3 * g + 3):
            spring[i] *= K[g]
            brake[i] = -D[g] * twist[i]
            pull[i] = spring[i] + brake[i]
        # The spring is shortened first and leaves the reserve, so that an empty tank brakes.
        room = max(memory[LEDGER][g] - _RESERVE * p[_CAPACITY][g], 0.0)
        most = p[ACCELERATION][g] + length(pull, g) / p[MASS][g]
        if _cost(pull, dx, g, most, T) > room:
            most = p[ACCELERATION][g] + length(brake, g) / p[MASS][g]
            room -= _cost(brake, dx, g, most, T)
            most = p[ACCELERATION][g] + length(spring, g) / p[MASS][g]
            cost = _cost(spring, dx, g, most, T)
            share = min(max(room / cost, 0.0), 1.0) if cost > 0.0 else 0.0
            for i in range(3 * g, 3 * g + 3):
                pull[i] = share * spring[i] + brake[i]
            most = p[ACCELERATION][g] + length(pull, g) / p[MASS][g]
            _afford(pull, dx, g, most, T, memory)
        for i in range(3 * g, 3 * g + 3):
            spring[i] = (pull[i] - brake[i]) / K[g]
    moved_into(pose, spring, memory[COMMAND_POSE])
    put(memory, COMMAND_TWIST.start, received, VELOCITY.start, 6)
    put(command, 0, memory, COMMAND.start, 13)
    fill(pose, twist, wrench, packet)


@njit(cache=True)
def command_left(wanted, command, pose, twist, p, memory):
    """Notes how the servo pulls at the command that has left; see `methods.Methods`."""
    spring, held, K, D = memory[_SPRING], memory[HELD], p[STIFFNESS], p[DAMPING]
    difference_into(command, pose, spring)
    for i in range(6):
        held[i] = K[i // 3] * spring[i] - D[i // 3] * twist[i]
