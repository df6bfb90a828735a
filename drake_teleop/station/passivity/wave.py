"""Wave variables: what travels is u = (b v + F) / sqrt(2 b) and w = (b v - F) / sqrt(2 b).

F = -f is the force that the hand puts into the port, and F v = (u^2 - w^2) / 2: an end gives out
the energy of the wave that it received and nothing else, so a line of constant delay is passive
(Anderson and Spong 1989; Niemeyer and Slotine 1991). With a step's increment v = dx / T this is
exact for the backward pair f_k . (x_k - x_(k-1)) at the hand and at the slave's *command*; the
servo between that and the actual motion is no part of it, and hard walls make it give out energy.

Over a network that is not constant an end sends the integral of its wave and the energy
e = F dx + |wave received|^2 T / 2 that is its to pass on, both cumulative. The receiver plays out
what has come of the integral through a filter of first order, and never more than has come of the
energy (Yokokohji, Imaida, Yoshikawa 1999 and Niemeyer and Slotine 2004, joined). So nothing is
created by jitter, loss or hold, nor by a wrench that the device cannot display; and nothing of the
integral is ever missing for good, so neither lost packets nor a limited wrench cause drift. What
long silence leaves is corrected in free motion, where that takes no work. Uneven arrival costs
energy: the filter then becomes as slow as it must be to play all that has come out of what is in
store. A playout buffer in the network keeps it fast.

What comes after packets were missing would be a blow. Instead the wrench at the hand then goes over
to the wave's at a bounded rate, but for what the wave does not pay for.

The slave's end is matched to the line by a damper m b that its command acts against: with m = 1
nothing is reflected in free motion, and the hand feels b v; with m = 0 it feels the mass b T of the
line's content. In contact the slave stays behind by f (T + filter) / b. Neither a wall nor the
spring of a hand takes much of a slow wave: at a round trip of 0.5 s what is left of a contact's
beginning fades with a time constant of 1.5 s, at 1 s with one of 9 s.

Without any wave a wall would push the slave away; in a silence it stays instead, and reflects. The
contact comes back after it, but not quite as deep: the hand went on while it felt nothing, and to
push it back takes energy that nobody has paid for. Pressed anew it is as deep as before.
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
    FILLS,
    HELD,
    LEDGER,
    LOST,
    MOTION_SCALE,
    RECEIVED,
    SENT,
    own_memory,
    own_parameters,
)
from drake_teleop.station.passivity.packet import (
    ENERGY,
    GENTLE,
    INTEGRAL,
    POSE,
    SEQUENCE,
    arrived,
    difference_into,
    dot,
    fill,
    limit,
    moved_into,
)

# Parameters.
_places = own_parameters()
IMPEDANCE = _places.vector(2)
_FILTER, _MATCHING = _places.number(), _places.number()
_PATIENCE, _DRIFT_RATE = _places.number(), _places.number()
# Memory: integral of the wave played out, of the wave sent, the wave of this step; silence [s].
_places = own_memory()
_PLAYED, _INTEGRAL, _WAVE = _places.vector(6), _places.vector(6), _places.vector(6)
_SILENT, _DRIFT = _places.number(), _places.vector(6)
# At the master: 1 from a step without a packet until all is made up for; number of the newest one.
_MISSING, _NEWEST = _places.number(), _places.number()


@settings
@dataclass
class WaveConfig:
    """Parameters of the wave variables."""

    impedance: list[float] = quantity(
        [10.0, 0.05], "N s/m, N m s/rad", 1e-6, 1e6, "b of the line, translation and rotation"
    )
    filter: float = quantity(0.003, "s", 0.0, 10.0, "time constant of the filter of either wave")
    matching: float = quantity(
        1.0, "1", 0.0, 100.0, "damper at the slave's end over b; 1 reflects nothing"
    )
    patience: float = quantity(
        0.03, "s", 0.0, 10.0, "silence after which the slave stays where it is, until it ends"
    )
    drift_rate: float = quantity(
        2.0, "1/s", 0.0, 1e3, "rate at which drift is corrected where that takes no work"
    )

    def pack_into(self, p: NDArray[np.float64]) -> None:
        """Writes the values to where the steps read them."""
        p[IMPEDANCE], p[_FILTER], p[_MATCHING] = self.impedance, self.filter, self.matching
        p[_PATIENCE], p[_DRIFT_RATE] = self.patience, self.drift_rate


@njit(cache=True)
def _play(received, T, p, memory, wave):
    """Writes the wave (6,) of this step: what is played out of the integral that has come.

    If a share a of what is left, d, is played in each step, that costs a |d|^2 / (2 T (2 - a)) in
    all: a is the filter's, or so small that the energy in store pays for that.
    """
    ledger, accounted, played = memory[LEDGER], memory[RECEIVED], memory[_PLAYED]
    integral = received[INTEGRAL]
    for g in range(2):
        more = received[ENERGY][g] - accounted[g]
        if more > 0.0:
            ledger[g] += more
            accounted[g] += more
        for i in range(3 * g, 3 * g + 3):
            wave[i] = integral[i] - played[i]
        left, store = dot(wave, wave, g), 2.0 * T * ledger[g]
        share = T / (T + p[_FILTER])
        if share * left > (2.0 - share) * store:
            share = 2.0 * store / (left + store)
        for i in range(3 * g, 3 * g + 3):
            played[i] += share * wave[i]
            wave[i] *= share / T
        ledger[g] = max(ledger[g] - 0.5 * T * dot(wave, wave, g), 0.0)


@njit(cache=True)
def master_step(received, fresh, pose, twist, dx, hand, limits, T, p, memory, wrench, packet):
    """One step of the master's end; see `methods.master_step`."""
    wave, integral, sent = memory[_WAVE], memory[_INTEGRAL], packet[INTEGRAL]
    _play(received, T, p, memory, wave)
    missing, newest = memory[_MISSING], received[SEQUENCE]
    if newest > memory[_NEWEST] + 1.0:
        missing = 1.0
    memory[_MISSING], memory[_NEWEST] = 0.0 if fresh else 1.0, newest
    for g in range(2):
        b = p[IMPEDANCE][g]
        for i in range(3 * g, 3 * g + 3):
            wrench[i] = math.sqrt(2.0 * b) * wave[i] - b * dx[i] / T
            # As if it could all be displayed, so that no momentum is missing on the line.
            integral[i] += (b * dx[i] - wrench[i] * T) / math.sqrt(2.0 * b)
            sent[i] = integral[i]
        limit(wrench, g, limits[g])
        energy = 0.5 * T * dot(wave, wave, g)
        if missing > 0.0:
            most = GENTLE[g] * T / p[MOTION_SCALE][g]
            if _approach(g, energy, dx, most, memory[HELD], wrench):
                memory[_MISSING] = 1.0
            limit(wrench, g, limits[g])
        # Not negative: of a wrench that was shortened even more is left than the wave going back.
        left = energy - dot(wrench, dx, g)
        memory[SENT][g] += max(left, 0.0)
        packet[ENERGY][g] = memory[SENT][g]
    put(memory, HELD.start, wrench, 0, 6)
    fill(pose, twist, wrench, packet)


@njit(cache=True)
def _approach(g, energy, dx, most, held, wrench):
    """Takes the wrench to within `most` of the one held, if that drains no more than `energy`.

    Returns:
        Whether it was beyond.
    """
    size = 0.0
    for i in range(3 * g, 3 * g + 3):
        size += (wrench[i] - held[i]) ** 2
    if size <= most * most:
        return False
    share = most / math.sqrt(size)
    now, last = energy - dot(wrench, dx, g), energy - dot(held, dx, g)
    if (1.0 - share) * last + share * now < 0.0:
        share = last / (last - now) if now > 0.0 else 1.0
    for i in range(3 * g, 3 * g + 3):
        wrench[i] = held[i] + share * (wrench[i] - held[i])
    return True


@njit(cache=True)
def slave_step(received, fresh, pose, twist, dx, wrench, T, p, memory, command, packet):
    """One step of the slave's end; see `methods.slave_step`."""
    now, step = memory[COMMAND_POSE], memory[COMMAND_TWIST]
    memory[_SILENT] = 0.0 if fresh else memory[_SILENT] + T
    if memory[FILLS] > 0.0:
        memory[FILLS] -= T
        step[:] = 0.0
        _stand(received, wrench, T, p, memory)
    elif memory[_SILENT] <= p[_PATIENCE]:
        _reflect(received, wrench, T, p, memory)
        if arrived(received):
            _correct(received, wrench, T, p, memory)
        moved_into(now, step, now)
        for i in range(6):
            step[i] /= T
    else:
        step[:] = 0.0
        _rest(wrench, T, p, memory)
    put(packet, INTEGRAL.start, memory, _INTEGRAL.start, 6)
    put(packet, ENERGY.start, memory, SENT.start, 2)
    put(command, 0, memory, COMMAND.start, 13)
    put(memory, HELD.start, wrench, 0, 6)
    fill(pose, twist, wrench, packet)


@njit(cache=True)
def _reflect(received, wrench, T, p, memory):
    """Step of the command under the wave and the contact wrench, and the wave that goes back."""
    wave, step, integral = memory[_WAVE], memory[COMMAND_TWIST], memory[_INTEGRAL]
    _play(received, T, p, memory, wave)
    for g in range(2):
        b, damper = p[IMPEDANCE][g], p[_MATCHING] * p[IMPEDANCE][g]
        for i in range(3 * g, 3 * g + 3):
            step[i] = T * (math.sqrt(2.0 * b) * wave[i] + wrench[i]) / (b + damper)
            integral[i] += T * wave[i] + math.sqrt(2.0 / b) * (T * wrench[i] - damper * step[i])
        damped = damper * dot(step, step, g) / T
        left = 0.5 * T * dot(wave, wave, g) + dot(wrench, step, g) - damped
        memory[LOST][g] += damped
        memory[SENT][g] += max(left, 0.0)


@njit(cache=True)
def _rest(wrench, T, p, memory):
    """Plays the wave that keeps the slave where it is, as long as the energy in store pays for it.

    It is reflected as by a rigid wall. What comes later has only to make up for the rest.
    """
    wave, ledger = memory[_WAVE], memory[LEDGER]
    played, integral = memory[_PLAYED], memory[_INTEGRAL]
    for g in range(2):
        for i in range(3 * g, 3 * g + 3):
            wave[i] = -wrench[i] / math.sqrt(2.0 * p[IMPEDANCE][g])
        energy = 0.5 * T * dot(wave, wave, g)
        if energy <= ledger[g]:
            ledger[g] -= energy
            memory[SENT][g] += energy
            for i in range(3 * g, 3 * g + 3):
                played[i] += T * wave[i]
                integral[i] -= T * wave[i]


@njit(cache=True)
def _stand(received, wrench, T, p, memory):
    """Reflects as a rigid wall while a new line fills, and has in store what would play that on.

    What comes is not played but made up to what stands: a filter that has been playing the wave of
    `wrench` for long is behind by its time constant of it, and a step more when the next has come:
    a store of half of that lets it. So the line begins with the energy of a contact that stood
    before there was a line, which nobody has put in: once, f^2 / 4 b for as long as a round trip
    and both filters take, and no end can get more of it.
    """
    wave, ledger, accounted = memory[_WAVE], memory[LEDGER], memory[RECEIVED]
    played, integral = memory[_PLAYED], memory[_INTEGRAL]
    for g in range(2):
        accounted[g] = max(accounted[g], received[ENERGY][g])
        for i in range(3 * g, 3 * g + 3):
            wave[i] = -wrench[i] / math.sqrt(2.0 * p[IMPEDANCE][g])
            integral[i] -= T * wave[i]
            played[i] = received[INTEGRAL][i] - p[_FILTER] * wave[i]
        memory[SENT][g] += 0.5 * T * dot(wave, wave, g)
        ledger[g] = 0.5 * (T + p[_FILTER]) * dot(wave, wave, g)


@njit(cache=True)
def _correct(received, wrench, T, p, memory):
    """Adds a step towards the received pose where it does not press on what the slave touches."""
    drift, step = memory[_DRIFT], memory[COMMAND_TWIST]
    difference_into(received[POSE], memory[COMMAND_POSE], drift)
    for g in range(2):
        if dot(wrench, drift, g) >= 0.0:
            for i in range(3 * g, 3 * g + 3):
                step[i] += min(T * p[_DRIFT_RATE], 1.0) * drift[i]
