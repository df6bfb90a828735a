"""Two-layer control with energy tanks (Franken et al., T-RO 27(4), 2011).

The transparency layer wants the received wrench at the hand and the received pose at the slave. The
passivity layer holds a tank of energy at each end: work done at its port flows in or out, a share
of the level is sent to the other end in every step, and a wrench is shortened to what the tank can
pay for. At the slave's end the port is that of its motors, whose pull K (x_command - x) - D v is
shortened through the command.

A wrench is held until the next step, so its work is f_(k-1) . (x_k - x_(k-1)): known only
afterwards. The next step cannot differ from the last one by more than a_max T^2, so a wrench may
cost f . dx + |f| a_max T^2 at most; this is what the tank must hold (Franken's |f| |dx| would
forbid even a wrench that brakes). What is sent leaves the tank *before* that is asked. So the tanks
are never overdrawn, whatever the network does, as long as |x''| <= a_max at both ends.

A slave that is slower than a_max T might pay even for its brake: with an empty tank it would coast
on for ever. So the slave keeps a reserve that is neither sent nor spent on the spring; only the
brake may use it. And what a servo that is pulled harder than a_max has overdrawn is written off
when energy arrives: else that would be swallowed, and the slave would stay where it is.

Where the tank of the master is below its level, a damper on the hand fills it. Of what the tank
holds the wrench may drain only a share in a step, which takes the edge off an empty tank; small
tanks end a limit cycle soon, because it lives on what they hold.
"""

# No postponed annotations here: yaml_load_typed reads the types of the dataclass's fields.
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
    length,
    limit,
    moved_into,
    scale,
)
from drake_teleop.quantities import quantity

# Parameters; those of two numbers are for translation and rotation.
_SEND, _INITIAL, _LEVEL = METHOD, METHOD + 1, METHOD + 3
_CAPACITY, _DAMPER, ACCELERATION, _DRAIN = METHOD + 5, METHOD + 7, METHOD + 9, METHOD + 11
_RESERVE = 0.01  # share of the capacity
# Memory of the slave: pull of the spring, pull of the damper.
_SPRING, _BRAKE = OWN, OWN + 6


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

    def packed(self) -> list[float]:
        """The values in the order in which the steps read them."""
        rest = (self.initial, self.level, self.capacity, self.damper, self.acceleration)
        return [self.send_rate, *(value for pair in rest for value in pair), self.drain_rate]


@njit(cache=True)
def initialize(p, memory):
    """Fills the tank at the start."""
    for g in range(2):
        memory[LEDGER + g] = p[_INITIAL + g]


@njit(cache=True)
def _exchange(received, dx, T, p, memory, packet):
    """Work of the held wrench, receiving and sending: all before a new wrench is limited."""
    for g in range(2):
        level = memory[LEDGER + g] - dot(memory[HELD : HELD + 6], dx, g)
        more = received[ENERGY + g] - memory[RECEIVED + g]
        if more > 0.0:
            level = max(level, 0.0) + more
            memory[RECEIVED + g] += more
        sent = min(T * p[_SEND], 1.0) * max(level - _RESERVE * p[_CAPACITY + g], 0.0)
        level -= sent
        lost = max(level - p[_CAPACITY + g], 0.0)
        memory[SENT + g] += sent
        memory[LOST + g] += lost
        memory[LEDGER + g] = level - lost
        packet[ENERGY + g] = memory[SENT + g]


@njit(cache=True)
def _cost(f, dx, g, T, p):
    """The most that a wrench can cost until the next step [J]."""
    return dot(f, dx, g) + length(f, g) * p[ACCELERATION + g] * T * T


@njit(cache=True)
def _afford(f, dx, g, T, p, memory):
    """Shortens group g of a wrench to what the tank can pay for."""
    cost, level = _cost(f, dx, g, T, p), max(memory[LEDGER + g], 0.0)
    if cost > level:
        scale(f, g, level / cost)


@njit(cache=True)
def master_step(received, fresh, pose, twist, dx, hand, T, p, memory, wrench, packet):
    """One step of the master's end; see `methods.master_step`."""
    _exchange(received, dx, T, p, memory, packet)
    for g in range(2):
        damping = p[_DAMPER + g] * max(p[_LEVEL + g] - memory[LEDGER + g], 0.0)
        for i in range(3 * g, 3 * g + 3):
            wrench[i] = received[WRENCH + i] - damping * twist[i]
        limit(wrench, g, p[LIMIT + g])
        drained = dot(wrench, dx, g)
        most = min(T * p[_DRAIN], 1.0) * max(memory[LEDGER + g], 0.0)
        if drained > most:
            scale(wrench, g, most / drained)
        _afford(wrench, dx, g, T, p, memory)
    memory[HELD : HELD + 6] = wrench
    fill(pose, twist, wrench, packet)


@njit(cache=True)
def slave_step(received, fresh, pose, twist, dx, wrench, T, p, memory, command, packet):
    """One step of the slave's end; see `methods.slave_step`."""
    spring, brake = memory[_SPRING : _SPRING + 6], memory[_BRAKE : _BRAKE + 6]
    _exchange(received, dx, T, p, memory, packet)
    target = memory[COMMAND : COMMAND + 7]
    if arrived(received):
        target = received[POSE : POSE + 7]
    difference_into(target, pose, spring)
    pull = memory[HELD : HELD + 6]
    for g in range(2):
        for i in range(3 * g, 3 * g + 3):
            spring[i] *= p[STIFFNESS + g]
            brake[i] = -p[DAMPING + g] * twist[i]
            pull[i] = spring[i] + brake[i]
        # The spring is shortened first and leaves the reserve, so that an empty tank brakes.
        room = max(memory[LEDGER + g] - _RESERVE * p[_CAPACITY + g], 0.0)
        if _cost(pull, dx, g, T, p) > room:
            room -= _cost(brake, dx, g, T, p)
            cost = _cost(spring, dx, g, T, p)
            share = min(max(room / cost, 0.0), 1.0) if cost > 0.0 else 0.0
            for i in range(3 * g, 3 * g + 3):
                pull[i] = share * spring[i] + brake[i]
            _afford(pull, dx, g, T, p, memory)
        for i in range(3 * g, 3 * g + 3):
            spring[i] = (pull[i] - brake[i]) / p[STIFFNESS + g]
    moved_into(pose, spring, memory[COMMAND : COMMAND + 7])
    for i in range(6):
        memory[COMMAND + 7 + i] = received[VELOCITY + i]
    command[:] = memory[COMMAND : COMMAND + 13]
    fill(pose, twist, wrench, packet)
