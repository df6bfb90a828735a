"""Energy ledgers at the slave's actual motion, and motors that are held to them. (long: one law)

With the hand's held wrench f, the contact's wrench w and the slave's *actual* motion x_s, hand and
contact have put in E_act = -sum f_(k-1) . dx_m + integral w . dx_s. The hand's ledger L_m counts
the work at the hand, the slave's ledger L_s that at the contact, each with what came and less what
was sent; and the account A leaves out what the slave's own mass holds, A = L_s - m v^2 / 2. Then

    dA/dt = -f_motor . v   (+ what comes, - what is sent, + friction):

the motors alone change A, whatever the wall does. So they are held to what A can pay for, and
L_s >= m v^2 / 2 >= 0 against every environment. E_act = -E_0 + L_m + L_s + what is on its way or
lost, where E_0 is what the ledgers hold at the start: `initial`. With 0 there, drag has to earn it,
and the slave hardly moves until the hand has gone about 0.1 m.

===================  ====================================  ========================================
port                 promise                               assumption
===================  ====================================  ========================================
hand (held), actual  E_act >= -E_0, whatever network,      the slave has at most the mass that was
motion of the slave  hand and environment do               told; K and D of its servo are within
                                                           20 %; w is the wrench at the contact; a
                                                           step each millisecond
hand, motors of the  E_mot >= -E_0 - friction's work       the same
slave
hand, command        none: it lies beyond the servo's
                     spring, and means no energy
hand alone           let go, it gets no more than          the device displays what it is told
                     R_m + 0.7 R_s, and no faster than
                     about twice `passivity.retreat`
what is felt         at rest, what is pressed              a wall that is a spring and a damper; a
                                                           stiff one is shown softer, by k_d of
                                                           step S3
===================  ====================================  ========================================

Before an unknown wall a slave that moves at v can give out m v^2 / 2: its reserve R_s, which limits
its speed, is the price of the promise, and is not used up. Nothing is asked about the hand. A force
that is predicted as in M2 makes hand and wall a loop that is stable for every hand and round trip
if k_c exceeds half of the wall's stiffness.

At each step of the master, with the slave's steps S1 to S6 in `ledger_slave`:

:M1: L_m -= f_(k-1) . dx; below zero it is a debt, never written off. While something is touched,
    and L_m has half of R_m, what the hand pays is sent instead: the slave presses with it.
    L_m += what came.
:M2: What is touched pushes along one unit wrench n, the mean of w over two round trips and 3 s
    at least: force and torque together, so that a point that is touched far from So is one spring
    and not two. With w_n = w . n and x_n = n . x, where a torque counts as a force at 0.1 m,

        u_n = w_n - 1.1 k_c (x_m - z - o)_n - b (v_m - z')_n   >= 0

    of the newest packet, where k_c and b are the wall's stiffness and damping along n, z where the
    slave would be without a wall, and o fades: how far hand and slave were apart at the onset, or 0
    if the wall was known. x_m is led by two steps, because a spring that is held over a step is
    active by k T / 2 (Colgate and Schenkel 1997). Across n there is friction. One that is felt late
    drives the hand, so the hand has a friction h of its own there, as in Dahl's model (1968):

        h' = -k_h v_m + (w - w_n n - h) / tau,    |h| <= h_m u_n / w_n,

    at rest what is measured too. What is shown is led by a step, h - k_h dx, for the same reason as
    x_m: a light hand that turned by 0.5 mrad kept itself shaking at 58 Hz. As n turns, what of h's
    force comes to lie along n's is dropped, of the force alone: a press that a torque hides in
    n . h would else be felt for as long as h lasts. k_h is 2.5 kN/m, h_m the largest |w - w_n n| of
    about a second or of tau, tau thirty round trips, but 0.6 s at least: friction that fades while
    the hand rests lets it move, and a round trip later the tip slips. Both means are so slow
    because what they pass on of the slave's friction, a round trip late, moves the hand, and that
    turns the friction round: with 0.8 s and ten round trips the tip stuck and slipped on for good
    over 100 ms. Of w_n, what friction alone explains is shown gradually, see S3.
:M3: The wall is remembered, so that fast taps are felt: while nothing else is heard,
    u_n = -k_c (x_m - x_w)_n. It is dropped when the slave says that it was the wall that went: a
    force of 0.3 N and twice what its motion explains was over within a step. Also when the slave
    was so deep in it that it should have met 1 N, 1 to 3 mm, and met nothing: a hard wall that has
    gone stops the hand before 3 mm; or when it missed 0.03 N s beyond 0.3 mm: a light hand leans on
    a wall by less than 1 N.
:M4: A hand that moves fast along u, as one that has let go, is pushed less: module `retreat`,
    after M6. The next step counts what was held.
:M5: u may spend a share of L_m; what was shortened comes back in 20 ms. With L_m at its end there
    is a force only at steps in which the hand is seen to move against it, likewise for M6: a
    reversal is seen late, by a step of the encoder at least, and nothing could pay for it.
:M6: Drag on the hand, from where a reserve is below 0.3 of itself (in contact: L_m below R_m) until
    both are full; what was sent counts as there. A wall that goes keeps what was put into it, and
    is to be felt no longer than the news takes. Drag, too, on a hand that was pushed since it last
    rested, while it is fast.
:M7: What L_m has beyond its reserve R_m (in contact R_m + 0.7 R_s) is sent.

Translation and rotation are two groups with a ledger each; what is touched is one for both. Where
packets were missing, or it has changed, the wrench goes over gradually. Not for a wall that goes:
that would be felt for longer than the news takes, and a hand that falls into it is not braked for
what pushed it before. A wrench against n is another contact. In a station the mass is that of its
arm at the start (`slave.joint_control`). It is 54 kg in its heaviest direction and counts as 79 kg,
since it may turn too: with R_s = 0.1 J it goes no faster than 0.2 m/s. A task at v needs
R_s = k_f m v^2 / 2. With sigma > 0 weight and inertia of the slave's load are felt as well, and are
no contact: what is touched, its direction, stiffness and prediction are of the contact's wrench w
alone. The load's is sent beside it, smoothed over a round trip, and added to u after M3. The
ledgers take the work of both, so that E_act is that of contact and load, which gives back what was
put into it. A hand that lowers the load is paid by L_m until the slave has done so too, and feels
it fade when that is spent: after 11 mm, of 1.75 N and R_m = 20 mJ. M4 fades it where the hand goes
down fast.
The account is behind the safe state, on whose command the motors' clamp has the last word, and
behind whatever else changes a command: it uses what the slave did. The packet's pose is z.
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
        """Writes the values to where the steps read them."""
        p[INITIAL], p[RESERVE], p[HAND_RESERVE] = self.initial, self.reserve, self.hand_reserve
        p[DRAG] = np.divide(self.drag, p[MOTION_SCALE])
        p[TOUCH] = np.divide(self.touch, p[MOTION_SCALE])
        p[METRIC] = np.square(np.divide(ARM * p[MOTION_SCALE], p[MOTION_SCALE][0]))


def initialize(p: NDArray[np.float64], memory: NDArray[np.float64]) -> None:
    """Half of the initial energy for each end; the servo's model rests where the slave does."""
    memory[LEDGER] = p[INITIAL] / 2.0
    memory[MODEL] = memory[COMMAND_POSE]


def fastest(config: LedgerConfig, mass: NDArray[np.float64]) -> NDArray[np.float64]:
    """(2,) what full reserves let the slave go at most, as S4 says [m/s, rad/s].

    Args:
        config: with the reserves, which grow with the square of the speed.
        mass: (2,) of the slave, in the master's power units [kg, kg m^2].
    """
    left = (1.0 - MARGIN) * np.asarray(config.reserve)
    return np.sqrt(2.0 * left / (HEAVY * mass))


@njit(cache=True)
def master_step(received, fresh, pose, twist, dx, hand, limits, T, p, memory, wrench, packet):
    """One step of the master's end; see `methods.master_step`."""
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
    """M1, but for what came."""
    work, ledger = dot(memory[HELD], dx, g), memory[LEDGER]
    memory[_GIVEN][g] = max(memory[_GIVEN][g] + work, 0.0)
    if work < 0.0 and touched and ledger[g] > _OWN * p[HAND_RESERVE][g]:
        memory[SENT][g] -= work
    else:
        ledger[g] -= work


@njit(cache=True)
def _predict(received, dx, T, p, memory, ahead, wrench):
    """M2, M3: the wrench is written, to where x_m - z is."""
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
    """M2, h: what there is across the contact's direction."""
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
    """M2: h, led by a step, is written."""
    normal, way = memory[NORMAL], over_way(memory[NORMAL], dx)
    for g in range(2):
        metric = max(p[METRIC][g], 1e-12)
        spring = _STIFFEST / metric
        for i in range(3 * g, 3 * g + 3):
            wrench[i] = memory[_RUBBING][i] - spring * (dx[i] - way * metric * normal[i])
        limit(wrench, g, pressed * memory[_FRICTION][g])


@njit(cache=True)
def _approach(g, T, p, memory, wrench):
    """The wrench goes over from the last one, without a blow."""
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
    """M5: the wrench is shortened to what the ledger can pay for until the next step."""
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
    """What an empty ledger leaves of a force that the hand pays for, 0 to 1.

    The filter is late for a reversal, by a step of the encoder at least. Nothing is earned yet that
    this could cost, so there is a force only where the hand is seen to move.
    """
    if memory[LEDGER][g] >= MARGIN * p[RESERVE][g]:
        return 1.0
    velocity = memory[VELOCITY_HERE]
    along, speed = dot(velocity, dx, g), length(velocity, g)
    return min(max(along, 0.0) / max(along, T * speed * speed, 1e-300), 1.0)


@njit(cache=True)
def _drag(g, received, dx, T, p, memory, wrench):
    """M6: adds drag."""
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
