"""Time-domain passivity approach (TDPA) for a delayed two-port, with its controllers in clip form.

Each end observes the work at its port in both directions apart and sends what was put in, as a
counter. What an end gives out may never exceed what it has received of the other end's input
(Ryu, Artigas, Preusche 2010): then the channel is passive whatever the network does. Work is that
of the backward pair f_k . (x_k - x_(k-1)).

The controllers do no more than that asks for. The master's shortens the wrench until what it drains
is covered; it never lengthens a wrench and divides by no velocity. The slave's shortens the step of
the command that would press further than the hand has paid for; what it withholds is made up for
later, as the energy allows (drift compensation).

Three things keep the force from chopping. A shortened wrench comes back slowly (force-jump filter);
of what the ledger holds a step may drain only a share; and the master keeps a little of what the
hand puts in for itself. With that it can give way a little, the slave follows, and what it returns
pays for the next little: without it a hand that pressed too deep stays there, before a wall that
pushes at every other sample.

The slave's motion is the actual one: its servo lags, and slave with wall is not passive in wrench
and commanded motion. The command counts too: of both motions the slave charges the larger output
and credits the smaller input, so that the account holds for either.
"""

# No postponed annotations here: yaml_load_typed reads the types of the dataclass's fields.
from dataclasses import dataclass

from numba import njit

from drake_teleop.passivity.memory import (
    COMMAND,
    HELD,
    LEDGER,
    LIMIT,
    LOST,
    METHOD,
    OWN,
    RECEIVED,
    SENT,
)
from drake_teleop.passivity.packet import (
    ENERGY,
    POSE,
    WRENCH,
    arrived,
    difference_into,
    dot,
    fill,
    limit,
    moved_into,
    scale,
)
from drake_teleop.quantities import quantity

# Of what the hand puts in, until the reserve is full: all of it would leave a soft wall too little.
_SHARE_KEPT = 0.5

# Parameters.
_RELEASE, _DRAIN, _DRIFT_RATE, _RESERVE = METHOD, METHOD + 1, METHOD + 2, METHOD + 3
# Memory of the master: share of the wrench that is withheld, energy kept.
_WITHHELD_SHARE, _KEPT = OWN, OWN + 2
# Memory of the slave: work in and out at the actual and the commanded motion; withheld command.
_IN, _OUT, _IN_COMMAND, _OUT_COMMAND, _WITHHELD = OWN, OWN + 2, OWN + 4, OWN + 6, OWN + 8


@dataclass
class TdpaConfig:
    """Parameters of the time-domain passivity approach."""

    release: float = quantity(
        0.02, "s", 0.0, 10.0, "time in which a shortened wrench may come back (force-jump filter)"
    )
    drain_rate: float = quantity(
        200.0, "1/s", 0.0, 1e6, "share of the ledger that the wrench may drain in a second"
    )
    drift_rate: float = quantity(
        20.0, "1/s", 0.0, 1e3, "rate at which a withheld command is made up for, if it is paid for"
    )
    reserve: list[float] = quantity(
        [2e-3, 1e-4], "J", 0.0, 1e3, "that the master keeps of what the hand puts in"
    )

    def packed(self) -> list[float]:
        """The values in the order in which the steps read them."""
        return [self.release, self.drain_rate, self.drift_rate, *self.reserve]


@njit(cache=True)
def receive(received, memory):
    """Adds what the other end has put in since the last step to this end's ledger."""
    for g in range(2):
        more = received[ENERGY + g] - memory[RECEIVED + g]
        if more > 0.0:
            memory[LEDGER + g] += more
            memory[RECEIVED + g] += more


@njit(cache=True)
def master_step(received, fresh, pose, twist, dx, hand, T, p, memory, wrench, packet):
    """One step of the master's end; see `methods.master_step`."""
    receive(received, memory)
    drain, release = min(T * p[_DRAIN], 1.0), T / p[_RELEASE] if p[_RELEASE] > 0.0 else 1.0
    for i in range(6):
        wrench[i] = received[WRENCH + i]
    for g in range(2):
        limit(wrench, g, p[LIMIT + g])
        share = min(1.0, 1.0 - memory[_WITHHELD_SHARE + g] + release)
        drained = dot(wrench, dx, g)
        most = drain * (memory[LEDGER + g] + memory[_KEPT + g])
        if share * drained > most:
            share = most / drained
        memory[_WITHHELD_SHARE + g] = 1.0 - share
        memory[LOST + g] += (1.0 - share) * drained
        scale(wrench, g, share)
        _account(g, share * drained, p, memory)
        packet[ENERGY + g] = memory[SENT + g]
    memory[HELD : HELD + 6] = wrench
    fill(pose, twist, wrench, packet)


@njit(cache=True)
def _account(g, drained, p, memory):
    """Takes what the wrench drained from the ledger, then from what was kept; or sends input."""
    if drained > 0.0:
        kept = min(memory[LEDGER + g] - drained, 0.0)
        memory[LEDGER + g] = max(memory[LEDGER + g] - drained, 0.0)
    else:
        kept = min(-_SHARE_KEPT * drained, max(p[_RESERVE + g] - memory[_KEPT + g], 0.0))
        memory[SENT + g] -= drained + kept
    memory[_KEPT + g] = max(memory[_KEPT + g] + kept, 0.0)


@njit(cache=True)
def slave_step(received, fresh, pose, twist, dx, wrench, T, p, memory, command, packet):
    """One step of the slave's end; see `methods.slave_step`."""
    receive(received, memory)
    for g in range(2):
        work = dot(wrench, dx, g)
        memory[_IN + g] += max(work, 0.0)
        memory[_OUT + g] += max(-work, 0.0)
    if arrived(received):
        _follow(received, wrench, T, p, memory)
    for g in range(2):
        # Both are increasing, and so is the smaller of them.
        memory[SENT + g] = min(memory[_IN + g], memory[_IN_COMMAND + g])
        memory[LEDGER + g] = _paid(memory, g)
        packet[ENERGY + g] = memory[SENT + g]
    command[:] = memory[COMMAND : COMMAND + 13]
    memory[HELD : HELD + 6] = wrench
    fill(pose, twist, wrench, packet)


@njit(cache=True)
def _paid(memory, g):
    """What the hand has paid for and was not given out; negative if the servo gave too much."""
    return memory[RECEIVED + g] - max(memory[_OUT + g], memory[_OUT_COMMAND + g])


@njit(cache=True)
def _follow(received, wrench, T, p, memory):
    """Moves the command towards the received pose, as far as it is paid for."""
    now, withheld = memory[COMMAND : COMMAND + 7], memory[_WITHHELD : _WITHHELD + 6]
    step = memory[COMMAND + 7 : COMMAND + 13]
    later = 1.0 - min(T * p[_DRIFT_RATE], 1.0)
    difference_into(received[POSE : POSE + 7], now, step)
    for i in range(6):
        step[i] -= later * withheld[i]
    # Where what is withheld passes half a turn, its sign changes: no whole turn in a step.
    limit(step, 1, 1.0)
    for g in range(2):
        pressing, paid = -dot(wrench, step, g), max(_paid(memory, g), 0.0)
        if pressing > paid:
            scale(step, g, paid / pressing)
            memory[LOST + g] += pressing - paid
            pressing = paid
        memory[_OUT_COMMAND + g] += max(pressing, 0.0)
        memory[_IN_COMMAND + g] += max(-pressing, 0.0)
    moved_into(now, step, now)
    difference_into(received[POSE : POSE + 7], now, withheld)
    for i in range(6):
        step[i] /= T
