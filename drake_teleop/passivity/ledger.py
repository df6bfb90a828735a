"""Energy ledgers at the slave's actual motion, and motors that are held to them.

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
hand (held), slave's E_act >= -E_0, whatever network,      the slave has at most the mass that was
actual motion        hand and environment do               told; K and D of its servo are within
                                                           20 %; w is the wrench at the contact; a
                                                           step each millisecond
hand, slave's motors E_mot >= -E_0 - friction's work       the same
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

M1. L_m -= f_(k-1) . dx; below zero it is a debt, never written off. While something is touched,
    what the hand pays is sent instead: the slave presses with it. L_m += what came.
M2. Of the newest packet, u = w - 1.1 k_c (x_m - z - o) - b (v_m - z') along w, where k_c and b are
    the wall's stiffness and damping, z where the slave would be without a wall, and o fades: how
    far hand and slave were apart at the onset, or 0 if the wall was known. x_m is led by two steps,
    because a spring that is held over a step is active by k T / 2 (Colgate and Schenkel 1997).
M3. The wall is remembered, so that fast taps are felt: while nothing else is heard,
    u = -k_c (x_m - x_w). It is dropped when the slave was so deep in it that it should have met
    1 N, 1 to 3 mm, and met nothing: a hard wall that has gone stops the hand before 3 mm.
M4. A hand that moves fast along u, as one that has let go, is pushed less: module `retreat`,
    after M6. The next step counts what was held.
M5. u may spend a share of L_m; what was shortened comes back in 20 ms.
M6. Drag on the hand until both reserves are full, and on one that was pushed, while it is fast.
M7. What L_m has beyond its reserve R_m (in contact R_m + 0.7 R_s) is sent.

Translation and rotation are two groups with a ledger each; the wall's direction is the wrench's.
The account is behind the safe state, on whose command the motors' clamp has the last word, and
behind whatever else changes a command: it uses what the slave did. The packet's pose is z.
"""

# No postponed annotations here: yaml_load_typed reads the types of the dataclass's fields.
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_teleop._compiled import njit
from drake_teleop.fields import settings
from drake_teleop.passivity import ledger_slave
from drake_teleop.passivity.ledger_slave import (
    ARM,
    CONTACT_DAMPING,
    CONTACT_STIFFNESS,
    DRAG,
    ECHO,
    HAND_RESERVE,
    INITIAL,
    LEVEL,
    LEVER,
    MARGIN,
    MODEL,
    PASSED,
    RESERVE,
    SPRING,
    TOUCH,
    TOUCHED,
    VELOCITY_HERE,
    receive,
    smooth_velocity,
)
from drake_teleop.passivity.memory import (
    COMMAND_POSE,
    HELD,
    LEDGER,
    MOTION_SCALE,
    SENT,
    own_memory,
)
from drake_teleop.passivity.packet import (
    ENERGY,
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
from drake_teleop.quantities import quantity
from drake_teleop.vectors import put

_FILTER = 4e-3  # s, of velocity: encoders have steps
_OVER = 1.1  # of k_c: a wall that is taken for too stiff is stable, for too soft is not
_STIFFEST, _SOFTEST = 2500.0, 50.0  # N/m that are predicted with at most; that make a wall
_LEAD = 2.0  # steps, by which the hand is led: half a step in theory, but velocity is filtered
_ONSET = 0.3  # s, in which o fades
_PREDICTED = 3.0  # N, beyond twice the wrench: more is no prediction
_REMEMBERED = 10.0  # N, the most that a remembered wall pushes with
_SAME = 5e-3  # m, between touches of one wall
_GONE, _EXPECTED, _SURE = (
    3e-3,
    1.0,
    1e-3,
)  # m, N, m: a slave that far in a wall met nothing; at least
_ALIGNED = 0.7  # cosine between the wrenches of one wall
_DRAIN = 50.0  # 1/s, share of the ledger that the wrench may spend
_RETURN = 0.02  # s, in which a shortened wrench comes back
_START = 5.0  # m/s^2, by which a hand may be faster at the next step
_FADING = 0.02  # m/s, below it drag fades
_BRAKE, _BRAKED = 0.5, 0.1  # N and m/s: what was pushed is braked with so much, down to this speed

# Memory: filtered velocity, whether something is touched; way between hand and slave at the onset;
# the remembered wall's direction (into it), its stiffness (0: none), how deep the hand is in it.
_places = own_memory()
_places.vector(8)  # VELOCITY_HERE, TOUCHED
_OFFSET, _INWARD = _places.vector(6), _places.vector(6)
_WALL, _DEPTH = _places.vector(2), _places.vector(2)
# What the force gave since it last came to rest; share of the wrench that is withheld.
_GIVEN, _WITHHELD = _places.vector(2), _places.vector(2)

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


def initialize(p: NDArray[np.float64], memory: NDArray[np.float64]) -> None:
    """Half of the initial energy for each end; the servo's model rests where the slave does."""
    memory[LEDGER] = p[INITIAL] / 2.0
    memory[MODEL] = memory[COMMAND_POSE]


@njit(cache=True)
def master_step(received, fresh, pose, twist, dx, hand, limits, T, p, memory, wrench, packet):
    """One step of the master's end; see `methods.master_step`."""
    velocity, ahead = memory[VELOCITY_HERE], wrench  # where it is, the wrench will be written
    smooth_velocity(twist, min(T / _FILTER, 1.0), memory)
    for g in range(2):
        _account_of_hand(g, dx, memory)
        receive(g, received, memory)
    ahead[:] = 0.0
    if arrived(received):
        difference_into(pose, received[POSE], ahead)
    for g in range(2):
        _predict(g, received, T, p, memory, ahead, wrench)
        limit(wrench, g, limits[g])
        _afford(g, dx, T, p, memory, wrench)
        _drag(g, received, dx, T, p, memory, wrench)
        limit(wrench, g, limits[g])
        level = p[HAND_RESERVE][g]
        if memory[TOUCHED][g] > 0.0:
            level += PASSED * p[RESERVE][g]
        surplus = max(memory[LEDGER][g] - level, 0.0)
        memory[SENT][g] += surplus
        memory[LEDGER][g] -= surplus
        packet[ENERGY][g], packet[LEVEL][g] = memory[SENT][g], memory[LEDGER][g]
    put(memory, HELD.start, wrench, 0, 6)
    fill(pose, velocity, wrench, packet)
    packet[ECHO] = received[SEQUENCE]


@njit(cache=True)
def _account_of_hand(g, dx, memory):
    """M1, but for what came."""
    work, ledger = dot(memory[HELD], dx, g), memory[LEDGER]
    memory[_GIVEN][g] = max(memory[_GIVEN][g] + work, 0.0)
    memory[_DEPTH][g] += dot(memory[_INWARD], dx, g)
    inside = memory[_WALL][g] > 0.0 and memory[_DEPTH][g] > 0.0
    if work < 0.0 < ledger[g] and (inside or memory[TOUCHED][g] > 0.0):
        memory[SENT][g] -= work
    else:
        ledger[g] -= work


@njit(cache=True)
def _predict(g, received, T, p, memory, ahead, wrench):
    """M2, M3: the wrench is written, to where x_m - z is."""
    shown, inward, offset = received[WRENCH], memory[_INWARD], memory[_OFFSET]
    size, wall = length(shown, g), memory[_WALL]
    k = min(_OVER * received[CONTACT_STIFFNESS][g], _STIFFEST * SPRING[g])
    if size > p[TOUCH][g]:
        damper, speed = received[CONTACT_DAMPING][g], dot(shown, received[VELOCITY], g) / size
        spring = max(size + damper * speed, 0.0)
        deep = spring / max(k, _SOFTEST * SPRING[g]) - dot(shown, ahead, g) / size
        if memory[TOUCHED][g] == 0.0:
            memory[TOUCHED][g] = 1.0
            same = wall[g] > 0.0 and -dot(shown, inward, g) > _ALIGNED * size
            near = abs(deep - memory[_DEPTH][g]) < _SAME * ARM[g]
            known = same and (near or memory[_DEPTH][g] < 0.0)
            for i in range(3 * g, 3 * g + 3):
                offset[i] = 0.0 if known else ahead[i]
        fade = 1.0 - min(T / _ONSET, 1.0)
        for i in range(3 * g, 3 * g + 3):
            offset[i] *= fade
        lead = _LEAD * T * dot(shown, memory[VELOCITY_HERE], g)
        further = (dot(shown, ahead, g) - dot(shown, offset, g) + lead) / size
        most = 2.0 * size + _PREDICTED * LEVER[g]
        faster = dot(shown, memory[VELOCITY_HERE], g) / size - speed
        force = min(max(size - k * further - damper * faster, 0.0), most)
        for i in range(3 * g, 3 * g + 3):
            wrench[i] = force / size * shown[i]
        if k > _SOFTEST * SPRING[g]:
            wall[g], memory[_DEPTH][g] = k, deep
            for i in range(3 * g, 3 * g + 3):
                inward[i] = -shown[i] / size
        return
    memory[TOUCHED][g] = 0.0
    expected = _EXPECTED * LEVER[g] / max(wall[g], SPRING[g])
    gone = min(_GONE * ARM[g], max(expected, _SURE * ARM[g]))
    if memory[_DEPTH][g] - dot(inward, ahead, g) > gone:
        wall[g] = 0.0
    inside = min(wall[g] * max(memory[_DEPTH][g], 0.0), _REMEMBERED * LEVER[g])
    for i in range(3 * g, 3 * g + 3):
        wrench[i] = -inside * inward[i]


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
    scale(wrench, g, share)


@njit(cache=True)
def _drag(g, received, dx, T, p, memory, wrench):
    """M6: adds drag."""
    velocity, drag = memory[VELOCITY_HERE], 0.0
    speed, touched = length(velocity, g), memory[TOUCHED][g] > 0.0
    poor = received[LEVEL][g] < p[RESERVE][g] and not touched
    if memory[LEDGER][g] < p[HAND_RESERVE][g] or poor:
        drag = p[DRAG][g]
    if memory[_GIVEN][g] > 0.0 and speed > _BRAKED * ARM[g]:
        drag = max(drag, _BRAKE * LEVER[g])
    if memory[LEDGER][g] < MARGIN * p[RESERVE][g]:
        # Nothing is earned yet that a reversal, which the filter is late for, could cost.
        along = dot(velocity, dx, g)
        drag *= min(max(along, 0.0) / max(along, T * speed * speed, 1e-300), 1.0)
    for i in range(3 * g, 3 * g + 3):
        wrench[i] -= drag * velocity[i] / max(speed, _FADING * ARM[g])


slave_step, command_left = ledger_slave.slave_step, ledger_slave.command_left
