"""Time-domain passivity approach (TDPA) for a delayed two-port, with its controllers in clip form.

Each end observes the work at its port in both directions apart and sends what was put in, as a
counter. What an end gives out may never exceed what it has received of the other end's input
(Ryu, Artigas, Preusche 2010): then the channel is passive whatever the network does, between the
hand and the slave's *command*, by the backward pair f_k . (x_k - x_(k-1)). A wrench that is held
does other work at the hand, and the slave does not follow its command at once: see below.

The controllers do no more than that asks for. The master's shortens the wrench until what it drains
is covered; it never lengthens a wrench and divides by no velocity. The slave's shortens the step of
the command that would press further than the hand has paid for; what it withholds is made up for
later, as the energy allows (drift compensation).

Three things keep the force from chopping. A shortened wrench comes back slowly (force-jump filter);
of what the ledger holds a step may drain only a share, or all before the wrench falls by a blow;
and the master keeps a little of what the hand puts in for itself. With that it can give way a
little, the slave follows, and what it returns pays for the next little: without it a hand that
pressed too deep stays there, before a wall that pushes at every other sample.

That account is too strict for a long delay. A hand that feels nothing on its way into a wall does
no work, so nothing is there for the slave to press with, nor to push back the hand that went in too
deep. `charged_tdpa` is the same law with two additions, off in `tdpa`:

- A little drag on the hand earns the energy beforehand, wherever either end holds less than the
  reserve (the tank's level controller of Franken et al. 2011, here with a bounded force). The hand
  feels it in free motion; then |f_out| <= |f_in| + drag, and the energy's bound is the same. What
  the master's end holds beyond the reserve goes back to the slave's.
- The slave sends its wrench filtered. Hand, delay and a wall that is g times as stiff as the hand
  are the loop 1 + tau s + g e^(-s R) with the round trip R. Its fastest answer without an overshoot
  has ln(g R / tau) + R / tau + 1 = 0, which tau = (1 + e g) R meets within 4 % from g = 1 on; for
  softer walls it is slower than that. R is measured from the numbers of the packets, g from wrench
  and motion in contact. The share 1 / (1 + g) of the wrench need not wait, because with it the
  loop's gain is below one whatever the delay is; before the hand has answered it is all of the
  final wrench, so the filter goes on only when the answer is back. When the wrench is gone, what is
  left of it goes at once.

The slave's servo lags, and what it presses with after the command has stopped is paid by nobody. So
the slave keeps accounts of its command, as it left after the safe state, and of its actual motion,
charges the larger output and credits the smaller input. What was given out unpaid is a debt: it is
repaid before anything is sent to the hand. The command goes no faster than `speed`, so that packets
that come at once after a gap are no blow: what can be created at the actual motion is a debt, about
the energy m v^2 / 2 of that speed, 0.43 J in power units with 15 kg; a shove by the wall adds to
it. With the servo's lag that happens at most contacts; `ledger` has none of it.
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
    MOTION_SCALE,
    RECEIVED,
    SENT,
    STEPS,
    STIFFNESS,
    own_memory,
    own_parameters,
)
from drake_teleop.station.passivity.packet import (
    ENERGY,
    GENTLE,
    INTEGRAL,
    OTHER_ENERGY,
    POSE,
    SEQUENCE,
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

# Of what the hand puts in, until the reserve is full: all of it would leave a soft wall too little.
_SHARE_KEPT = 0.5
_QUICK = 0.1  # s, in which a wrench comes or goes that need not wait: slower than hand and servo
_GONE = 0.1  # a wrench below this share of the filtered one is on its way to zero
_COMPLETE = 0.98  # share of a quick onset at which it ends
# Of each group: travel in which the stiffness of a contact is learned [m, rad], and the speed below
# which the drag fades [m/s, rad/s].
_TRAVEL = (1e-3, 1e-2)
_FADING = (0.02, 0.2)

# In the packet: number of the newest packet that the master has; what the slave may give out.
_ECHO, _SLAVES_LEDGER = INTEGRAL.start, OTHER_ENERGY

# Parameters.
_places = own_parameters()
_RELEASE, _DRAIN, _DRIFT_RATE = _places.number(), _places.number(), _places.number()
_RESERVE, _DRAG, _HAND = _places.vector(2), _places.vector(2), _places.vector(2)  # in power units
_SPEED = _places.vector(2)
# Memory of the master: share of the wrench that is withheld, energy kept.
_places = own_memory()
_WITHHELD_SHARE, _KEPT = _places.vector(2), _places.vector(2)
# Memory of the slave: work in and out at the actual and the commanded motion; withheld command;
# filtered wrench; stiffness of the contact; number of the packet with the end of a quick onset.
_places = own_memory()
_IN, _OUT = _places.vector(2), _places.vector(2)
_IN_COMMAND, _OUT_COMMAND = _places.vector(2), _places.vector(2)
_WITHHELD, _FILTERED = _places.vector(6), _places.vector(6)
_CONTACT, _ONSET = _places.vector(2), _places.vector(2)
_BEFORE = _places.vector(7)  # the command of the last step


@settings
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
    speed: list[float] = quantity(
        [1.0, 10.0],
        "m/s, rad/s",
        1e-3,
        1e3,
        "of the slave's command; its kinetic energy may be created where the slave hits a wall",
    )
    reserve: list[float] = quantity(
        [2e-3, 1e-4], "J", 0.0, 1e3, "that the master keeps of what the hand puts in"
    )
    drag: list[float] = quantity(
        [0.0, 0.0], "N, N m", 0.0, 10.0, "on the hand while an end holds less than the reserve"
    )
    hand_stiffness: list[float] = quantity(
        [0.0, 0.0],
        "N/m, N m/rad",
        0.0,
        1e5,
        "of the hand, to which the filter of the returned wrench is set; 0: no filter",
    )

    def pack_into(self, p: NDArray[np.float64]) -> None:
        """Writes the values to where the steps read them."""
        p[_RELEASE], p[_DRAIN], p[_DRIFT_RATE] = self.release, self.drain_rate, self.drift_rate
        p[_RESERVE], p[_DRAG] = self.reserve, np.divide(self.drag, p[MOTION_SCALE])
        p[_HAND] = np.divide(self.hand_stiffness, np.square(p[MOTION_SCALE]))
        p[_SPEED] = self.speed


def charged() -> TdpaConfig:
    """The parameters of `charged_tdpa`: a normal grip, 0.28 N of drag that fills 60 mJ in 0.4 m."""
    return TdpaConfig(reserve=[0.06, 1e-3], drag=[0.28, 3e-3], hand_stiffness=[300.0, 1.5])


@njit(cache=True)
def receive(received, memory):
    """Adds what the other end has put in since the last step to this end's ledger."""
    ledger, accounted, counter = memory[LEDGER], memory[RECEIVED], received[ENERGY]
    for g in range(2):
        more = counter[g] - accounted[g]
        if more > 0.0:
            ledger[g] += more
            accounted[g] += more


@njit(cache=True)
def master_step(received, fresh, pose, twist, dx, hand, limits, T, p, memory, wrench, packet):
    """One step of the master's end; see `methods.master_step`."""
    receive(received, memory)
    drain, release = min(T * p[_DRAIN], 1.0), T / p[_RELEASE] if p[_RELEASE] > 0.0 else 1.0
    wanted = received[WRENCH]
    for i in range(6):
        wrench[i] = wanted[i]
    ledger, kept, withheld = memory[LEDGER], memory[_KEPT], memory[_WITHHELD_SHARE]
    for g in range(2):
        limit(wrench, g, limits[g])
        share = min(1.0, 1.0 - withheld[g] + release)
        drained = dot(wrench, dx, g)
        stored = ledger[g] + kept[g]
        if share * drained > drain * stored:
            share = _shortened(g, drained, drain, stored, share, T, p, memory[HELD], wrench)
        withheld[g] = 1.0 - share
        memory[LOST][g] += (1.0 - share) * drained
        scale(wrench, g, share)
        _drag(g, received[_SLAVES_LEDGER][g], dx, limits, T, p, memory, wrench)
        _account(g, dot(wrench, dx, g), p, memory)
        if p[_DRAG][g] > 0.0:
            _pass_on(g, p, memory)
        packet[ENERGY][g] = memory[SENT][g]
    put(memory, HELD.start, wrench, 0, 6)
    fill(pose, twist, wrench, packet)
    packet[_ECHO] = received[SEQUENCE]


@njit(cache=True)
def _shortened(g, drained, drain, stored, share, T, p, held, wrench):
    """The share of the wrench that a step may leave, of which all would drain `drained`.

    Less than `drain` of what is stored; more, even all of it, rather than a blow to the hand.
    """
    least, size = length(held, g) - GENTLE[g] * T / p[MOTION_SCALE][g], length(wrench, g)
    share = min(share, max(drain * stored / drained, least / size))
    return min(share, stored / drained)


@njit(cache=True)
def _drag(g, slaves_ledger, dx, limits, T, p, memory, wrench):
    """Adds the drag to the wrench; along dx, whose work is accounted: it never drains."""
    drag, level = p[_DRAG][g], memory[LEDGER][g] + memory[_KEPT][g]
    if drag > 0.0 and min(level, slaves_ledger) < p[_RESERVE][g]:
        damping = drag / max(length(dx, g), _FADING[g] * T)
        for i in range(3 * g, 3 * g + 3):
            wrench[i] -= damping * dx[i]
        limit(wrench, g, limits[g])


@njit(cache=True)
def _pass_on(g, p, memory):
    """Sends back what the master's end has beyond the reserve: the slave's end may need it."""
    ledger = memory[LEDGER]
    surplus = ledger[g] + memory[_KEPT][g] - p[_RESERVE][g]
    surplus = min(max(surplus, 0.0), ledger[g])
    ledger[g] -= surplus
    memory[SENT][g] += surplus


@njit(cache=True)
def _account(g, drained, p, memory):
    """Takes what the wrench drained from the ledger, then from what was kept; or sends input."""
    ledger, kept = memory[LEDGER], memory[_KEPT]
    if drained > 0.0:
        more = min(ledger[g] - drained, 0.0)
        ledger[g] = max(ledger[g] - drained, 0.0)
    else:
        more = min(-_SHARE_KEPT * drained, max(p[_RESERVE][g] - kept[g], 0.0))
        memory[SENT][g] -= drained + more
    kept[g] = max(kept[g] + more, 0.0)


@njit(cache=True)
def slave_step(received, fresh, pose, twist, dx, wrench, T, p, memory, command, packet):
    """One step of the slave's end; see `methods.slave_step`."""
    receive(received, memory)
    put(memory, _BEFORE.start, memory, COMMAND_POSE.start, 7)
    for g in range(2):
        work = dot(wrench, dx, g)
        memory[_IN][g] += max(work, 0.0)
        memory[_OUT][g] += max(-work, 0.0)
    if arrived(received):
        _follow(received, wrench, T, p, memory)
    for g in range(2):
        paid = _paid(memory, g)
        credit = min(memory[_IN][g], memory[_IN_COMMAND][g]) + min(paid, 0.0)
        # What was given out without payment is repaid before anything is sent.
        memory[SENT][g] = max(memory[SENT][g], credit)
        memory[LEDGER][g] = paid
        packet[ENERGY][g] = memory[SENT][g]
        packet[_SLAVES_LEDGER][g] = memory[LEDGER][g]
        _filter(g, received, dx, wrench, T, p, memory)
    put(command, 0, memory, COMMAND.start, 13)
    put(memory, HELD.start, wrench, 0, 6)
    fill(pose, twist, memory[_FILTERED], packet)


@njit(cache=True)
def _filter(g, received, dx, wrench, T, p, memory):
    """Filters the wrench that is sent."""
    filtered, hand = memory[_FILTERED], p[_HAND][g]
    rate, onset, gain = 1.0, 0.0, 0.0
    if hand > 0.0:
        gain = max(_contact_stiffness(g, dx, wrench, T, memory), 0.0) / hand
        # The servo's lag counts as delay.
        round_trip = max(memory[STEPS] - received[_ECHO], 1.0) * T
        lag = round_trip + p[DAMPING][g] / p[STIFFNESS][g]
        size, filtered_size = length(wrench, g), length(filtered, g)
        quick = min(T / _QUICK, 1.0)
        rate = min(T / (lag * (1.0 + math.e * gain)), 1.0)
        if size < _GONE * filtered_size:
            rate = max(rate, quick)
        else:
            if filtered_size * (1.0 + gain) < _COMPLETE * size:
                onset = quick
                memory[_ONSET][g] = memory[STEPS]
            if lag > _QUICK and received[_ECHO] < memory[_ONSET][g]:
                rate = 0.0
    for i in range(3 * g, 3 * g + 3):
        now = filtered[i]
        filtered[i] += rate * (wrench[i] - now) + onset * (wrench[i] / (1.0 + gain) - now)


@njit(cache=True)
def _contact_stiffness(g, dx, wrench, T, memory):
    """-df.dx / dx.dx of the contact, forgotten with the way travelled [N/m, N m/rad]."""
    size, stiffness = length(dx, g), memory[_CONTACT]
    if size > _TRAVEL[g] * T:
        change = dot(wrench, dx, g) - dot(memory[HELD], dx, g)
        forget = min(size / _TRAVEL[g], 1.0)
        stiffness[g] += forget * (-change / (size * size) - stiffness[g])
    return stiffness[g]


@njit(cache=True)
def _paid(memory, g):
    """What the hand has paid for and was not given out; negative if the servo gave too much."""
    return memory[RECEIVED][g] - max(memory[_OUT][g], memory[_OUT_COMMAND][g])


@njit(cache=True)
def _follow(received, wrench, T, p, memory):
    """Moves the command towards the received pose, as far as it is paid for."""
    now, withheld = memory[COMMAND_POSE], memory[_WITHHELD]
    step = memory[COMMAND_TWIST]
    later = 1.0 - min(T * p[_DRIFT_RATE], 1.0)
    difference_into(received[POSE], now, step)
    for i in range(6):
        step[i] -= later * withheld[i]
    for g in range(2):
        limit(step, g, p[_SPEED][g] * T)
        pressing, paid = -dot(wrench, step, g), max(_paid(memory, g), 0.0)
        if pressing > paid:
            scale(step, g, paid / pressing)
            memory[LOST][g] += pressing - paid
            pressing = paid
        memory[_OUT_COMMAND][g] += max(pressing, 0.0)
        memory[_IN_COMMAND][g] += max(-pressing, 0.0)
    moved_into(now, step, now)
    difference_into(received[POSE], now, withheld)
    for i in range(6):
        step[i] /= T


@njit(cache=True)
def _account_command(command, sign, memory):
    """Counts the work along the step of the command that leads to `command`, or takes it back."""
    step = np.empty(6)
    difference_into(command, memory[_BEFORE], step)
    for g in range(2):
        work = sign * dot(memory[HELD], step, g)
        into = work if work * sign > 0.0 else 0.0
        memory[_IN_COMMAND][g] += into
        memory[_OUT_COMMAND][g] += into - work


@njit(cache=True)
def command_left(wanted, command, pose, twist, p, memory):
    """Accounts for what the safe state has made of the command; see `methods.Methods`."""
    for i in range(7):
        if command[i] != wanted[i]:
            _account_command(wanted, -1.0, memory)
            _account_command(command, 1.0, memory)
            put(memory, COMMAND_POSE.start, command, 0, 7)
            return
