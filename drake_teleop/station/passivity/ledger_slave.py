"""Slave's end of the energy ledger (long: all steps of one end).

See docs/theory.md, section "The energy ledger": steps S1 to S6, promises, constants.
"""

from __future__ import annotations

import math

from drake_teleop.common.compiled import njit
from drake_teleop.common.vectors import put
from drake_teleop.station.passivity.contact_fit import SUMS, fit, slipped, steadied
from drake_teleop.station.passivity.memory import (
    COMMAND,
    COMMAND_POSE,
    COMMAND_TWIST,
    DAMPING,
    HELD,
    LEDGER,
    LOST,
    MASS,
    OF_LOAD,
    RECEIVED,
    SENT,
    STEPS,
    STIFFNESS,
    own_memory,
    own_parameters,
)
from drake_teleop.station.passivity.packet import (
    ENERGY,
    INTEGRAL,
    LOAD,
    OTHER_ENERGY,
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

# Of translation and rotation: a length is an angle at an arm of 0.1 m, a force a torque at the
# lever of 0.01 m that haptic devices have. What is touched is known along one wrench of force and
# torque together, where a torque counts as a force at the same arm: at the slave, so in the
# master's power units it depends on the scales of both.
ARM, LEVER = (1.0, 10.0), (1.0, 0.01)
MARGIN = 0.03  #: of the slave's reserve: never spent; more than what a step can cost
_KEPT = 0.1  # of that reserve, in contact, however short the hand's end is
PASSED = 0.7  #: share of the slave's reserve that the hand's end may have in contact

# What servo and mass are taken for, over what was configured: so errors of 20 % brake, and do not
# push.
_STIFF, _DAMPED, HEAVY = 1.15, 0.9, 1.05
_CAPACITY = 4.0  # of the reserve: what is above is lost, or limit cycles would live on it
_FILTER = 3e-3  # s, of velocity, wrench and way: encoders have steps
_CALM, _CALM_RATE, _RATE = 0.05, 5.0, 50.0  # m/s, at rest; 1/s in which surplus goes, there and not
_FORGET = 5.0  # s, of the largest round trip
_SHOWN, _PRESS = 300.0, 0.06  # k_0 [N/m]; v_p, of a hand that presses [m/s]
_STRETCH, _LONG = 2e-4, 2e-3  # m, way for a stiffness; likewise in fast motion
_LEARN, _KNOWN = 1e-3, 1e-2  # m, way that a stiffness is the mean of at least, and at most
_SLOW = 0.15  # m/s; an impact's wrench says less of the stiffness
_SMOOTH = 0.02  # s, of the wall's place and of rho
_FALLS = 0.3  # N, felt: from this on, what ends within a step may be a wall that goes
_SURE = 0.1  # of rho, by which it is not changed: it moves the slave, which changes k
_DIRECTION = 3.0  # s, of the contact's direction at least: a tip that sticks and slips turns it
_TILTED, _RUBBED = 0.6, 1.0  # s, in which friction's step along n is shown; of the largest one
# s and c, of a hand that stays; s, in which c falls: faster than the news it hunts
_SETTLED, _TIMES, _TIRED = 0.5, 10.0, 1.0
_STIFFEST = 1200.0  # N/m, of its k_d
_FOLLOW = 0.01  # s, of the command's generator
_FASTER = 30.0  # m/s^2, its acceleration
_STOPPING = 0.7  # of the speed from which that acceleration stops in time
_NEWS = 0.02  # s without a packet, after which the hand's velocity is not fed forward any more
_SHORT, _LONGER = 0.5, 0.06  # of the round trip; s: a silence that is little to what is late
_HORIZON = 4e-3  # s, in which the motors may spend what there is
_UNPAID = 5.0  # N, what the slave may press a wall with though nobody has paid
_STILL = 2e-3  # m/s, at rest: standing costs nothing
_DECELERATION = 20.0  # m/s^2, of the brake when nothing is left

# In the packet: stiffness k_c, damping b and round trip (slave's), number of the newest packet
# (master's), ledger.
CONTACT_STIFFNESS, CONTACT_DAMPING, TRIP = range(INTEGRAL.start, INTEGRAL.start + 3)
LEVEL = OTHER_ENERGY
ECHO = INTEGRAL.stop - 1

# Parameters, in the master's power units.
_places = own_parameters()
INITIAL, RESERVE, HAND_RESERVE = _places.vector(2), _places.vector(2), _places.vector(2)
DRAG, TOUCH = _places.vector(2), _places.vector(2)
METRIC = _places.vector(2)  #: of wrenches: what a squared force counts, and a squared torque
# Memory: filtered velocity; whether something is touched; the servo's model; the motors' pull.
_places = own_memory()
VELOCITY_HERE, TOUCHED = _places.vector(6), _places.number()
#: What the contact pushes with, smoothed: its direction is the contact's.
PUSHED, NORMAL = _places.vector(6), _places.vector(6)
MODEL, _MODEL_TWIST, _PULL = _places.vector(7), _places.vector(6), _places.vector(6)
_ACCOUNT, _PAID = _places.vector(2), _places.vector(2)  # A, Q
# k, b; rho and where it goes to, c less 1, how deep the slave is in the wall.
_STIFFNESS, _DAMPER = _places.number(), _places.number()
_SHARE, _GOAL, _STAYED, _INSIDE = (_places.number() for _ in range(4))
# Of the search for k and b: wrench filtered, it and the speed at the anchor; way since then, how
# far that is behind; way since the onset; the fit's sums.
_SMOOTHED, _ANCHOR, _FAST = (_places.number() for _ in range(3))
_WAY, _BEHIND, _LEARNT, _SUMS = *(_places.number() for _ in range(3)), _places.vector(SUMS)
# Time without packets and the longest such, the largest round trip, the period [s].
_SILENT, _GAP, _ROUND_TRIP, _PERIOD = (_places.number() for _ in range(4))
# The contact's wrench; the load's, smoothed.
_CONTACT, _WEIGHT = _places.vector(6), _places.vector(6)
# What is shown along n; the last speed into it; the largest friction.
_PUSH, _BEFORE, _ACROSS = (_places.number() for _ in range(3))


@njit(cache=True)
def smooth_velocity(twist, share, memory):
    velocity = memory[VELOCITY_HERE]
    for i in range(6):
        velocity[i] += share * (twist[i] - velocity[i])


@njit(cache=True)
def touches(wrench, p):
    """Return whether a wrench exceeds the contact threshold."""
    return length(wrench, 0) > p[TOUCH][0] or length(wrench, 1) > p[TOUCH][1]


@njit(cache=True)
def along(a, b, p):
    """Return the component of the wrench `a` along the unit wrench `b` [N]."""
    return p[METRIC][0] * dot(a, b, 0) + p[METRIC][1] * dot(a, b, 1)


@njit(cache=True)
def over_way(wrench, way):
    """Return the work of a wrench over a displacement; for a unit wrench the component [m]."""
    return dot(wrench, way, 0) + dot(wrench, way, 1)


@njit(cache=True)
def find_direction(wrench, trip, T, p, memory):
    """Update the contact's direction, a unit wrench, and return the component along it [N].

    A much larger wrench or the opposite direction is a new contact and replaces the mean at once.
    """
    pushed, normal = memory[PUSHED], memory[NORMAL]
    rate = 1.0
    if memory[TOUCHED] > 0.0:
        # What is far more than was there, noise say, is found at once.
        more = 1.0 - 3.0 * math.sqrt(
            along(pushed, pushed, p) / max(along(wrench, wrench, p), 1e-300)
        )
        rate = max(min(T / max(_DIRECTION, 2.0 * trip), 1.0), more)
        if not along(wrench, pushed, p) > 0.0:  # another contact
            rate = 1.0
    for i in range(6):
        pushed[i] += rate * (wrench[i] - pushed[i])
    size = max(math.sqrt(along(pushed, pushed, p)), 1e-12)
    for i in range(6):
        normal[i] = pushed[i] / size
    return along(wrench, normal, p)


@njit(cache=True)
def receive(g, received, memory):
    """Add newly received energy to the ledger of group `g` and return it."""
    more = max(received[ENERGY][g] - memory[RECEIVED][g], 0.0)
    memory[LEDGER][g] += more
    memory[RECEIVED][g] += more
    return more


@njit(cache=True)
def slave_step(received, fresh, pose, twist, dx, wrench, T, p, memory, command, packet):
    """See `methods.slave_step`."""
    gap, now, going = command[:6], memory[COMMAND_POSE], memory[COMMAND_TWIST]
    heard = arrived(received)
    memory[_PERIOD] = T
    memory[_SILENT] = 0.0 if fresh else memory[_SILENT] + T
    silence = memory[_SILENT] if heard else 0.0
    memory[_GAP] = max(memory[_GAP] * (1.0 - T / _FORGET), silence)
    trip = max((memory[STEPS] - received[ECHO]) * T, 0.0) if heard else 0.0
    memory[_ROUND_TRIP] = max(memory[_ROUND_TRIP] * (1.0 - T / _FORGET), trip)
    smooth_velocity(twist, min(T / _FILTER, 1.0), memory)
    contact, load, weight = memory[_CONTACT], memory[OF_LOAD], memory[_WEIGHT]
    for i in range(6):
        contact[i] = wrench[i] - load[i]
    touched = touches(contact, p)
    late = memory[_ROUND_TRIP] + _lag(p)
    share = min(T / late, 1.0) if memory[STEPS] > 0.0 else 1.0
    for i in range(6):
        weight[i] += share * (load[i] - weight[i])
    for g in range(2):
        _account_of_slave(g, received, heard, touched, twist, dx, wrench, T, p, memory)
    _learn(received, touched, dx, contact, T, p, memory)
    put(memory, HELD.start, wrench, 0, 6)
    gap[:] = 0.0
    if heard:
        difference_into(received[POSE], now, gap)
    difference_into(now, pose, memory[_PULL])
    _generate(received, heard, T, p, memory, gap)
    for i in range(6):
        gap[i] = T * going[i]
    moved_into(now, gap, now)
    _clamp(now, pose, twist, p, memory)
    _model(received, heard, T, p, memory, gap)
    put(command, 0, memory, COMMAND.start, 13)
    fill(memory[MODEL], memory[_MODEL_TWIST], contact, packet)
    if memory[TOUCHED] > 0.0:
        instead = memory[_PUSH] - along(contact, memory[NORMAL], p)
        for i in range(6):
            packet[WRENCH][i] += instead * memory[NORMAL][i]
    put(packet, LOAD.start, weight, 0, 6)
    k, yields = memory[_STIFFNESS], 0.0
    for g in range(2):
        size = length(memory[NORMAL], g)
        yields += size * size / (_STIFF * p[STIFFNESS][g])
        packet[ENERGY][g] = memory[SENT][g]
        packet[LEVEL][g] = memory[LEDGER][g] - memory[RECEIVED][g]
    packet[CONTACT_DAMPING], packet[TRIP] = memory[_DAMPER], memory[_ROUND_TRIP]
    packet[CONTACT_STIFFNESS] = memory[_SHARE] * k / (1.0 + k * yields)


@njit(cache=True)
def _account_of_slave(g, received, heard, touched, twist, dx, wrench, T, p, memory):
    """Update the slave's ledger and return surplus energy (S1, S2)."""
    # The wrench went from the last one to this one: of both works the smaller is credited.
    work = min(dot(wrench, dx, g), dot(memory[HELD], dx, g))
    more = receive(g, received, memory)
    ledger, paid, reserve = memory[LEDGER], memory[_PAID], p[RESERVE][g]
    ledger[g] += work
    paid[g] = (paid[g] + work if touched else 0.0) + more
    speed = length(twist, g)
    moving = 0.5 * HEAVY * p[MASS][g] * speed * speed
    # At rest in contact energy is needed to push the hand back, else for speed.
    keep, hold, rate = reserve, p[HAND_RESERVE][g], _RATE
    free, short, give = ledger[g] - moving, hold - received[LEVEL][g], 0.0
    needed = short
    if touched and speed < _CALM * ARM[g]:
        keep, rate = (1.0 - PASSED) * reserve, _CALM_RATE
        needed += PASSED * reserve
        give = min(free - _KEPT * reserve, short)
    give = max(give, min(free - keep, needed), 0.0) * min(T * rate, 1.0) if heard else 0.0
    lost = max(ledger[g] - give - _CAPACITY * reserve, 0.0)
    memory[SENT][g] += give
    memory[LOST][g] += lost
    ledger[g] -= give + lost
    memory[_ACCOUNT][g] = ledger[g] - moving


@njit(cache=True)
def _lag(p):
    """Return the servo's delay [s]."""
    return 2.0 * math.sqrt(p[MASS][0] / p[STIFFNESS][0])


@njit(cache=True)
def _shown_at_most(received, T, p, memory):
    """Return the largest displayed stiffness k_d (S3) [N/m]."""
    normal, paid = memory[NORMAL], 0.0
    depth, first = _PRESS * (memory[_ROUND_TRIP] + _lag(p)), math.inf
    for g in range(2):
        part, reserve = ARM[g] * length(normal, g) * depth, p[HAND_RESERVE][g]
        first = min(first, 2.0 * reserve / max(part * part, 1e-300))
        there = min(max(received[LEVEL][g] / reserve, 0.0), 1.0)
        paid += p[METRIC][g] * dot(normal, normal, g) * there
    quiet = min(max(_NEWS, _SHORT * memory[_ROUND_TRIP]), _LONGER)
    if memory[TOUCHED] == 0.0 or memory[_GAP] >= quiet:
        memory[_STAYED] = 0.0
    else:
        more = (_TIMES - 1.0) * paid - memory[_STAYED]
        memory[_STAYED] += T / (_SETTLED if more > 0.0 else _TIRED) * more
    return max(_SHOWN, first, min((1.0 + memory[_STAYED]) * first, _STIFFEST))


@njit(cache=True)
def _learn(received, touched, dx, wrench, T, p, memory):
    """Identify direction, stiffness, damping, displayed share and depth of the contact (S3)."""
    normal, k, velocity = memory[NORMAL], memory[_STIFFNESS], memory[VELOCITY_HERE]
    if not touched:
        if memory[TOUCHED] > 0.0 and _goes(dx, memory):
            memory[_SHARE] = 0.0
        memory[TOUCHED] = memory[_SMOOTHED] = memory[_ACROSS] = 0.0
        return
    size = find_direction(wrench, memory[_ROUND_TRIP], T, p, memory)
    most = _shown_at_most(received, T, p, memory)
    turned = _turns(wrench, size, T, p, memory)
    inward, rate = -over_way(normal, dx), min(T / _FILTER, 1.0)
    speed = -over_way(normal, velocity)
    if memory[_SMOOTHED] == 0.0:
        # From the first sample in contact: on the way to it a part was outside.
        memory[_SMOOTHED] = memory[_ANCHOR] = memory[_PUSH] = size
        memory[_BEHIND] = inward
        memory[_FAST] = memory[_BEFORE] = speed
        memory[_WAY] = memory[_LEARNT] = 0.0
        memory[_SHARE] = memory[_GOAL] = most / max(k, most)
    follows = rate * (inward - memory[_BEHIND])
    memory[_BEHIND] += follows - inward
    memory[_WAY] += follows
    memory[_SMOOTHED] += rate * (size - memory[_SMOOTHED])
    fastest = math.hypot(length(velocity, 0), length(velocity, 1) / ARM[1])
    slow, far = fastest < _SLOW, abs(memory[_WAY])
    if far > (_STRETCH if slow else _LONG):
        memory[_LEARNT] = min(memory[_LEARNT] + far, _KNOWN)
        keep = max(1.0 - far / max(memory[_LEARNT], _LEARN), 0.0) if slow else 0.5
        faster = speed - memory[_FAST]
        more = memory[_SMOOTHED] - memory[_ANCHOR] - memory[_DAMPER] * faster
        more -= slipped(more, max(2.0 * k, _SHOWN) * memory[_WAY], turned)
        more += memory[_DAMPER] * faster
        k, damper = fit(memory[_SUMS], more, memory[_WAY], faster, keep)
        memory[_STIFFNESS], memory[_DAMPER] = k, damper
        memory[_WAY], memory[_ANCHOR], memory[_FAST] = 0.0, memory[_SMOOTHED], speed
    if k > 1.0:  # N/m: something is known
        rate, goal = min(T / _SMOOTH, 1.0), most / max(k, most)
        if abs(goal - memory[_GOAL]) > _SURE * memory[_GOAL]:
            memory[_GOAL] = goal
        memory[_SHARE] += rate * (memory[_GOAL] - memory[_SHARE])
        deep = max(size - memory[_DAMPER] * speed, 0.0) / k
        if memory[TOUCHED] == 0.0:
            memory[_INSIDE] = deep
        memory[_INSIDE] += inward + rate * (deep - memory[_INSIDE] - inward)
        memory[TOUCHED] = 1.0
    explained = memory[_STIFFNESS] * inward + memory[_DAMPER] * (speed - memory[_BEFORE])
    rate = T / _TILTED + abs(inward) / _LEARN
    memory[_PUSH] = steadied(memory[_PUSH], size, explained, rate, turned)
    memory[_BEFORE] = speed


@njit(cache=True)
def _goes(dx, memory):
    """Return whether the contact ended with the step `dx` because the wall was removed (S6)."""
    normal = memory[NORMAL]
    faster = over_way(normal, memory[VELOCITY_HERE]) + memory[_BEFORE]
    explained = abs(memory[_STIFFNESS] * over_way(normal, dx)) + abs(memory[_DAMPER] * faster)
    return memory[_PUSH] > max(_FALLS, 2.0 * explained)


@njit(cache=True)
def _turns(wrench, size, T, p, memory):
    """Return f^2 / |w| of S3: the largest change along n that a slip can cause [N]."""
    pushed = memory[PUSHED]
    mean = max(math.sqrt(along(pushed, pushed, p)), 1e-12)
    rubs = math.sqrt(max(along(wrench, wrench, p) - size * size, 0.0))
    memory[_ACROSS] = max(memory[_ACROSS] * (1.0 - min(T / _RUBBED, 1.0)), rubs)
    return memory[_ACROSS] * min(memory[_ACROSS] / mean, 1.0)


@njit(cache=True)
def _generate(received, heard, T, p, memory, gap):
    """Compute the command's velocity (S3, S4).

    `gap` contains the pose difference from the command to the received pose and is overwritten.
    """
    going, normal, feed = memory[COMMAND_TWIST], memory[NORMAL], received[VELOCITY]
    yields, over, fast = 0.0, 0.0, 0.0
    if memory[TOUCHED] > 0.0:
        over = memory[_INSIDE] - over_way(normal, gap) - over_way(normal, memory[_PULL])
        if over > 0.0:
            yields, fast = 1.0 - memory[_SHARE], -over_way(normal, feed)
    feeds = heard and memory[_SILENT] < _NEWS
    for g in range(2):
        for i in range(3 * g, 3 * g + 3):
            gap[i] += yields * over * p[METRIC][g] * normal[i]
        away, most = length(gap, g), _FASTER * ARM[g]
        rate = 1.0 / _FOLLOW
        if away > 0.0:
            rate = min(rate, _STOPPING * math.sqrt(2.0 * most / away))
        for i in range(3 * g, 3 * g + 3):
            gap[i] *= rate
            if feeds:
                gap[i] += feed[i] + yields * fast * p[METRIC][g] * normal[i]
        left = max(memory[LEDGER][g] - MARGIN * p[RESERVE][g], 0.0)
        limit(gap, g, math.sqrt(2.0 * left / (HEAVY * p[MASS][g])))
        for i in range(3 * g, 3 * g + 3):
            gap[i] -= going[i]
        limit(gap, g, most * T)
        for i in range(3 * g, 3 * g + 3):
            going[i] += gap[i]


@njit(cache=True)
def _clamp(command, pose, twist, p, memory):
    """Move the command (7,) so that the motors' energy suffices (S5); return whether it moved.

    The command generator then continues from there, at most as fast as the slave.
    """
    pull, changed = memory[_PULL], False
    difference_into(command, pose, pull)
    for g in range(2):
        K, D = _STIFF * p[STIFFNESS][g], _DAMPED * p[DAMPING][g]
        for i in range(3 * g, 3 * g + 3):
            pull[i] = K * pull[i] - D * twist[i]
        if _hold_back(g, D, twist, p, memory):
            changed = True
            going = memory[COMMAND_TWIST]
            if length(going, g) > length(twist, g) or dot(going, twist, g) < 0.0:
                for i in range(3 * g, 3 * g + 3):
                    going[i] = twist[i]
        for i in range(3 * g, 3 * g + 3):
            pull[i] = (pull[i] + D * twist[i]) / K
    if changed:
        moved_into(pose, pull, command)
    return changed


@njit(cache=True)
def _hold_back(g, damping, twist, p, memory):
    """Limit the motors' wrench to the available energy, or brake; return whether it changed."""
    pull, velocity, held = memory[_PULL], memory[VELOCITY_HERE], memory[_CONTACT]
    size, speed, mass = length(pull, g), length(twist, g), HEAVY * p[MASS][g]
    still = length(velocity, g) < _STILL * ARM[g]
    margin, account, changed = MARGIN * p[RESERVE][g], memory[_ACCOUNT][g], False
    pushing = dot(pull, twist, g) > 0.0 or dot(pull, velocity, g) > 0.0
    touched, room, least = length(held, g), account, 0.0
    if touches(held, p) and dot(pull, held, g) < 0.0:
        unpaid = _UNPAID * LEVER[g] * ARM[g]
        spring = (1.0 + memory[_STAYED]) * unpaid * unpaid / (2.0 * max(memory[_STIFFNESS], 1.0))
        room = min(account, min(p[RESERVE][g], spring) + memory[_PAID][g])
        if still or not pushing:
            # Motors that are late earn a little by standing: with an empty account they give way.
            least = touched * min(max(account / margin, 0.0), 1.0)
    if not pushing:
        least += mass * speed / _HORIZON  # comes to rest, and does not bounce
    reach = _HORIZON * (speed + memory[_PERIOD] * size / mass)
    if size * reach > max(room - margin, least * reach):
        scale(pull, g, max(max(room - margin, 0.0) / reach, least) / size)
        changed = True
    if account < margin and not still:
        brake = min(damping * speed, mass * _DECELERATION * ARM[g] * (1.0 - account / margin))
        if -brake * speed < dot(pull, twist, g):
            for i in range(3 * g, 3 * g + 3):
                pull[i] = -brake * twist[i] / max(speed, 1e-12)
            changed = True
    return changed


@njit(cache=True)
def _model(received, heard, T, p, memory, gap):
    """Advance the servo model (S6) by implicit Euler, which is stable for every servo."""
    model, going = memory[MODEL], memory[_MODEL_TWIST]
    gap[:] = 0.0
    if heard:
        difference_into(received[POSE], model, gap)
    for i in range(6):
        stiff, damped = p[STIFFNESS][i // 3] / p[MASS][i // 3], p[DAMPING][i // 3] / p[MASS][i // 3]
        going[i] = (going[i] + T * stiff * gap[i]) / (1.0 + T * damped + T * T * stiff)
        gap[i] = T * going[i]
    moved_into(model, gap, model)


@njit(cache=True)
def command_left(wanted, command, pose, twist, p, memory):
    """Limit the command after the safe state changed it (S5); see `methods.Methods`."""
    for i in range(7):
        if command[i] != wanted[i]:
            if _clamp(command, pose, twist, p, memory):
                put(memory, COMMAND_POSE.start, command, 0, 7)
            return
