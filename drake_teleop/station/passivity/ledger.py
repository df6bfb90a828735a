"""Energy ledger at the slave's actual motion: parameters and the master's end.

docs/theory.md, section "The energy ledger", contains the law, its promises and the purpose of each
constant. M1 to M7 and S1 to S6 are the steps there. `ledger_slave` is the slave's end.
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
from drake_teleop.station.passivity import ledger_slave
from drake_teleop.station.passivity.ledger_slave import (
    ARM,
    CONTACT_DAMPING,
    CONTACT_STIFFNESS,
    DRAG,
    ECHO,
    HAND_RESERVE,
    HEAVY,
    INITIAL,
    LEVEL,
    LEVER,
    MARGIN,
    METRIC,
    MODEL,
    NORMAL,
    PASSED,
    PUSHED,
    RESERVE,
    TOUCH,
    TOUCHED,
    TRIP,
    VELOCITY_HERE,
    along,
    find_direction,
    over_way,
    receive,
    smooth_velocity,
    touches,
)
from drake_teleop.station.passivity.memory import (
    COMMAND_POSE,
    HELD,
    LEDGER,
    MOTION_SCALE,
    SENT,
    own_memory,
)
from drake_teleop.station.passivity.packet import (
    ENERGY,
    GENTLE,
    LOAD,
    POSE,
    SEQUENCE,
    VELOCITY,
    WRENCH,
    arrived,
    difference_into,
    dot,
    fill,
    length,
    limit,
    scale,
)

_FILTER = 4e-3  # s, of velocity: encoders have steps
_OVER = 1.1  # of k_c: a wall that is taken for too stiff is stable, for too soft is not
_STIFFEST, _SOFTEST = 2500.0, 50.0  # N/m that are predicted with at most; that make a wall
_LEAD = 2.0  # steps, by which the hand is led: half a step in theory, but velocity is filtered
_ONSET = 0.3  # s, in which o fades
_FORGET = 1.0  # s, of the largest friction, at least: h goes over to what is measured, not to 0
_PATIENCE = 30.0  # round trips, in which friction at the hand goes over to what is measured
_PREDICTED = 3.0  # N, beyond twice the wrench: more is no prediction
_REMEMBERED = 10.0  # N, the most that a remembered wall pushes with
_SAME = 5e-3  # m, between touches of one wall
# m, N, m: the slave so deep in a wall without meeting it that it has gone; what it should meet at
# least; and so deep at least.
_GONE, _EXPECTED, _SURE = 3e-3, 1.0, 1e-3
# m, N s: deeper than this it should meet something, and so much of it until the wall has gone.
_SLIGHT, _UNMET = 0.3e-3, 0.03
_ALIGNED = 0.7  # cosine between the wrenches of one wall
_OWN = 0.5  # of the hand's reserve, below which its end keeps what the hand pays
_DRAIN = 50.0  # 1/s, share of the ledger that the wrench may spend
_RETURN = 0.02  # s, in which a shortened wrench comes back
_START = 5.0  # m/s^2, by which a hand may be faster at the next step
_FADING = 0.02  # m/s, below it drag fades
_RESTED = 0.1  # s at rest, after which nothing is braked for what was given before
# Of a reserve: without contact drag begins below the one, and ends at the other, but for rounding.
_LOW, _FULL = 1.0 - PASSED, 1.0 - 1e-9
# N, m/s, m/s: what was pushed is braked with so much above the one speed, with nothing below the
# other; between them by share, as the edge of a brake would be felt.
_BRAKE, _BRAKED, _UNBRAKED = 0.5, 0.1, 0.05

# Memory as at the head of `ledger_slave`: filtered velocity, whether something is touched, what it
# pushes with and its direction. Way between hand and slave at the onset; the remembered wall's
# direction (into it), its stiffness (0: none), how deep the hand is in it, the impulse that the
# slave missed in it; friction that is shown, the largest that was seen.
_places = own_memory()
_places.vector(NORMAL.stop - VELOCITY_HERE.start)
_OFFSET, _INWARD = _places.vector(6), _places.vector(6)
_WALL, _DEPTH, _MISSED = _places.number(), _places.number(), _places.number()
_RUBBING, _FRICTION = _places.vector(6), _places.vector(2)
# What the force gave since it last came to rest; share of the wrench that is withheld.
_GIVEN, _WITHHELD = _places.vector(2), _places.vector(2)
_CHARGING = _places.vector(2)  # whether drag earns what a reserve lacks
# The newest packet; whether the wrench still goes over, after some were missing or what is touched
# has changed; the last wrench, before it was paid for.
_NEWEST, _MISSING, _LAST = _places.number(), _places.vector(2), _places.vector(6)

AT_THE_MOTOR = True  #: the port of its account, see `methods`


@settings
@dataclass
class LedgerConfig:
    """Parameters of the energy ledger."""

    initial: list[float] = quantity(
        [0.12, 0.011],
        "J",
        0.0,
        1e3,
        "E_0, in both reserves at the start; drag earns what is missing",
    )
    reserve: list[float] = quantity(
        [0.1, 0.01], "J", 1e-9, 1e3, "of the slave: energy of its fastest motion, scaled"
    )
    hand_reserve: list[float] = quantity(
        [0.02, 1e-3], "J", 1e-9, 1e3, "of the master, to push the hand back"
    )
    drag: list[float] = quantity(
        [0.28, 5e-3], "N, N m", 0.0, 10.0, "on the hand until both reserves are full"
    )
    touch: list[float] = quantity(
        [0.01, 1e-3], "N, N m", 0.0, 1e3, "at the hand; a wrench below it is no contact"
    )

    def pack_into(self, p: NDArray[np.float64]) -> None:
        """See `Methods`."""
        p[INITIAL], p[RESERVE], p[HAND_RESERVE] = self.initial, self.reserve, self.hand_reserve
        p[DRAG] = np.divide(self.drag, p[MOTION_SCALE])
        p[TOUCH] = np.divide(self.touch, p[MOTION_SCALE])
        p[METRIC] = np.square(np.divide(ARM * p[MOTION_SCALE], p[MOTION_SCALE][0]))


def initialize(p: NDArray[np.float64], memory: NDArray[np.float64]) -> None:
    """Give half of the initial energy to an end; place the servo model at the slave's pose."""
    memory[LEDGER] = p[INITIAL] / 2.0
    memory[MODEL] = memory[COMMAND_POSE]


def fastest(config: LedgerConfig, mass: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the largest speed of the slave with full reserves, step S4 (2,) [m/s, rad/s].

    Args:
        config: contains the reserves, which grow with the square of the speed.
        mass: (2,) of the slave, in the master's power units [kg, kg m^2].
    """
    left = (1.0 - MARGIN) * np.asarray(config.reserve)
    return np.sqrt(2.0 * left / (HEAVY * mass))


@njit(cache=True)
def master_step(received, fresh, pose, twist, dx, hand, limits, T, p, memory, wrench, packet):
    """See `methods.master_step`."""
    velocity, ahead = memory[VELOCITY_HERE], wrench  # where it is, the wrench will be written
    smooth_velocity(twist, min(T / _FILTER, 1.0), memory)
    memory[_DEPTH] += over_way(memory[_INWARD], dx)
    inside = memory[_WALL] > 0.0 and memory[_DEPTH] > 0.0
    for g in range(2):
        _account_of_hand(g, dx, inside or memory[TOUCHED] > 0.0, p, memory)
        receive(g, received, memory)
    ahead[:] = 0.0
    if arrived(received):
        difference_into(pose, received[POSE], ahead)
    _predict(received, dx, T, p, memory, ahead, wrench)
    for i in range(6):
        wrench[i] += received[LOAD][i]
    newest = received[SEQUENCE]
    if newest > memory[_NEWEST] + 1.0:
        memory[_MISSING] = 1.0
    memory[_NEWEST] = newest
    for g in range(2):
        _approach(g, T, p, memory, wrench)
        limit(wrench, g, limits[g])
        _afford(g, dx, T, p, memory, wrench)
        level = p[HAND_RESERVE][g]
        if memory[TOUCHED] > 0.0:
            level += PASSED * p[RESERVE][g]
        surplus = max(memory[LEDGER][g] - level, 0.0)
        memory[SENT][g] += surplus
        memory[LEDGER][g] -= surplus
        _drag(g, received, dx, T, p, memory, wrench)
        limit(wrench, g, limits[g])
        packet[ENERGY][g], packet[LEVEL][g] = memory[SENT][g], memory[LEDGER][g]
    put(memory, HELD.start, wrench, 0, 6)
    fill(pose, velocity, wrench, packet)
    packet[ECHO] = received[SEQUENCE]


@njit(cache=True)
def _account_of_hand(g, dx, touched, p, memory):
    """Step M1."""
    work, ledger = dot(memory[HELD], dx, g), memory[LEDGER]
    memory[_GIVEN][g] = max(memory[_GIVEN][g] + work, 0.0)
    if work < 0.0 and touched and ledger[g] > _OWN * p[HAND_RESERVE][g]:
        memory[SENT][g] -= work
    else:
        ledger[g] -= work


@njit(cache=True)
def _predict(received, dx, T, p, memory, ahead, wrench):
    """Write the predicted contact wrench (M2, M3) into `wrench`.

    `ahead` contains x_m - z; it may be the same array as `wrench`.
    """
    shown, normal, inward = received[WRENCH], memory[NORMAL], memory[_INWARD]
    k = min(_OVER * received[CONTACT_STIFFNESS], _STIFFEST)
    if not touches(shown, p):
        if memory[TOUCHED] > 0.0:
            memory[_MISSING][:] = 1.0
        memory[TOUCHED] = 0.0
        gone = min(_GONE, max(_EXPECTED / max(memory[_WALL], 1.0), _SURE))
        slaves = memory[_DEPTH] - over_way(inward, ahead)
        memory[_MISSED] += T * memory[_WALL] * (slaves - _SLIGHT)
        if slaves <= _SLIGHT:
            memory[_MISSED] = 0.0
        if memory[_WALL] > 0.0 and received[CONTACT_STIFFNESS] == 0.0:
            memory[_WALL] = 0.0
            memory[_MISSING][:] = memory[_GIVEN][:] = 0.0
        if slaves > gone or memory[_MISSED] > _UNMET:
            memory[_WALL] = 0.0
        inside = min(memory[_WALL] * max(memory[_DEPTH], 0.0), _REMEMBERED)
        for i in range(6):
            wrench[i] = -inside * inward[i]
        return
    memory[_MISSED] = 0.0
    offset, onset = memory[_OFFSET], memory[TOUCHED] == 0.0
    if onset or not along(shown, memory[PUSHED], p) > 0.0:
        memory[_MISSING][:] = 1.0
    size = find_direction(shown, received[TRIP], T, p, memory)
    damper, speed = received[CONTACT_DAMPING], over_way(normal, received[VELOCITY])
    deep = max(size + damper * speed, 0.0) / max(k, _SOFTEST) - over_way(normal, ahead)
    if onset:
        same = memory[_WALL] > 0.0 and -along(normal, inward, p) > _ALIGNED
        near = abs(deep - memory[_DEPTH]) < _SAME
        if same and (near or memory[_DEPTH] < 0.0):
            offset[:] = 0.0
        else:
            put(offset, 0, ahead, 0, 6)
        memory[TOUCHED] = 1.0
        memory[_FRICTION][:] = 0.0
        memory[_RUBBING][:] = 0.0
    fade = 1.0 - min(T / _ONSET, 1.0)
    for i in range(6):
        offset[i] *= fade
        ahead[i] -= offset[i]
    fast = over_way(normal, memory[VELOCITY_HERE])
    further = over_way(normal, ahead) + _LEAD * T * fast
    force = size
    if size > 0.0:
        change = k * further + damper * (fast - speed)
        force = min(max(size - change, 0.0), 2.0 * size + _PREDICTED)
    pressed = min(max(force, 0.0) / max(size, 1e-12), 1.0)
    for g in range(2):
        _rub(g, T, size, pressed, shown, received, dx, p, memory)
    # As n turns, some of what was across it comes to lie along it, where `force` is all there is.
    rubbing = memory[_RUBBING]
    within = dot(rubbing, normal, 0) / max(dot(normal, normal, 0), 1e-12)
    for i in range(3):
        rubbing[i] -= within * normal[i]
    _show_rubbing(dx, pressed, p, memory, wrench)
    for i in range(6):
        wrench[i] += force * normal[i]
    if k > _SOFTEST:
        memory[_WALL], memory[_DEPTH] = k, deep
        for i in range(6):
            inward[i] = -normal[i]


@njit(cache=True)
def _rub(g, T, size, pressed, shown, received, dx, p, memory):
    """Step M2, (T68)."""
    normal, rubbing, most = memory[NORMAL], memory[_RUBBING], memory[_FRICTION]
    # A torque's share of the metric is 0 where rotation is not passed on.
    metric, way, total = max(p[METRIC][g], 1e-12), over_way(normal, dx), 0.0
    spring = _STIFFEST / metric
    share = min(T / max(2.0 * _ONSET, _PATIENCE * received[TRIP]), 1.0)
    for i in range(3 * g, 3 * g + 3):
        part = shown[i] - size * normal[i]
        total += part * part
        rubbing[i] += share * (part - rubbing[i])
        rubbing[i] -= spring * (dx[i] - way * metric * normal[i])
    forgets = min(T / max(_FORGET, _PATIENCE * received[TRIP]), 1.0)
    most[g] = max(most[g] * (1.0 - forgets), math.sqrt(total))
    limit(rubbing, g, pressed * most[g])


@njit(cache=True)
def _show_rubbing(dx, pressed, p, memory, wrench):
    """Write the friction h, advanced by one step (M2)."""
    normal, way = memory[NORMAL], over_way(memory[NORMAL], dx)
    for g in range(2):
        metric = max(p[METRIC][g], 1e-12)
        spring = _STIFFEST / metric
        for i in range(3 * g, 3 * g + 3):
            wrench[i] = memory[_RUBBING][i] - spring * (dx[i] - way * metric * normal[i])
        limit(wrench, g, pressed * memory[_FRICTION][g])


@njit(cache=True)
def _approach(g, T, p, memory, wrench):
    """Bound the change of the wrench after missing packets or a change of contact."""
    last, missing = memory[_LAST], memory[_MISSING]
    for i in range(3 * g, 3 * g + 3):
        wrench[i] -= last[i]
    size, most = length(wrench, g), GENTLE[g] * T / p[MOTION_SCALE][g]
    if missing[g] > 0.0 and size > most:
        scale(wrench, g, most / size)
    else:
        missing[g] = 0.0
    for i in range(3 * g, 3 * g + 3):
        last[i] += wrench[i]
        wrench[i] = last[i]


@njit(cache=True)
def _afford(g, dx, T, p, memory, wrench):
    """Shorten the wrench so that its cost until the next step is within the ledger (M5)."""
    size, cost = length(wrench, g), 0.0
    if size > 0.0:
        way = dot(wrench, memory[VELOCITY_HERE], g) / size * T
        cost = size * max(dot(wrench, dx, g) / size, way, 0.0)
        if way >= 0.0:
            cost += size * _START * ARM[g] * T * T
    most = min(T * _DRAIN, 1.0) * max(memory[LEDGER][g] - MARGIN * p[RESERVE][g], 0.0)
    share = min(1.0, 1.0 - memory[_WITHHELD][g] + T / _RETURN)
    if share * cost > most:
        share = most / cost
    memory[_WITHHELD][g] = 1.0 - share
    if not cost > 0.0:
        share *= _earning(g, dx, T, p, memory)
    scale(wrench, g, share)


@njit(cache=True)
def _earning(g, dx, T, p, memory):
    """Return the share of an energy-absorbing force that an empty ledger permits, 0 to 1.

    The velocity filter detects a reversal at least one encoder step late (M5).
    """
    if memory[LEDGER][g] >= MARGIN * p[RESERVE][g]:
        return 1.0
    velocity = memory[VELOCITY_HERE]
    along, speed = dot(velocity, dx, g), length(velocity, g)
    return min(max(along, 0.0) / max(along, T * speed * speed, 1e-300), 1.0)


@njit(cache=True)
def _drag(g, received, dx, T, p, memory, wrench):
    """Step M6."""
    velocity, drag, charging = memory[VELOCITY_HERE], 0.0, memory[_CHARGING]
    speed, own = length(velocity, g), memory[LEDGER][g] / p[HAND_RESERVE][g]
    # What has been sent counts as there: to hear of it takes a round trip.
    least = min(own, (received[LEVEL][g] + memory[SENT][g]) / p[RESERVE][g])
    touched = memory[TOUCHED] > 0.0
    if (touched and own < _FULL) or (not touched and least < _LOW):
        charging[g] = 1.0
    elif touched or least >= _FULL:
        charging[g] = 0.0
    if charging[g] > 0.0:
        drag = p[DRAG][g]
    if speed < _FADING * ARM[g]:
        memory[_GIVEN][g] *= 1.0 - min(T / _RESTED, 1.0)
    if memory[_GIVEN][g] > 0.0:
        share = (speed / ARM[g] - _UNBRAKED) / (_BRAKED - _UNBRAKED)
        drag = max(drag, _BRAKE * LEVER[g] * min(share, 1.0))
    drag *= _earning(g, dx, T, p, memory)
    for i in range(3 * g, 3 * g + 3):
        wrench[i] -= drag * velocity[i] / max(speed, _FADING * ARM[g])


slave_step, command_left = ledger_slave.slave_step, ledger_slave.command_left
