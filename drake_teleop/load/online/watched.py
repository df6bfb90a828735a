"""A known load while it is watched: what the elimination is given of it, sample by sample.

The load was learnt and is frozen. `change.change_update` tells whether it is still there; this
module draws the conclusions::

    settled     the known load explains the wrench. It is handed out as it is
    disturbed   something is touched, or it is the moment of a grasp. The known load is handed out:
                a contact has to be felt
    changed     another load than the known one has been there for a while (`change.HOLD`), and
                has shown that it is none but a load (below): a request to identify again, by a
                motion that excites mass and first moments. The load handed out fades to what is
                known otherwise (the gripper alone, or nothing). The hand then feels of the unknown
                load what the sensor feels, sigma = gamma in Fig. 2: nothing that is not there, as
                eliminating a load that was put down would make it, and contacts too. It stays like
                this until either the old load explains the wrench again or the new one is
                identified, whatever is touched meanwhile; then "settled"

Whatever happens, what is handed out goes over with the time constant `FADE`: the force takes no
step, and is never outside what the two loads give.

**A constant push** and another weight are the same, at rest and for as long as they do not change.
What looks like another load is therefore taken for a contact until the force that it exerts has
changed by `VARIES`, and the new load has explained that for `EXPLAINED` seconds: until the tool is
turned or accelerated. Its centre of mass has to be within `REACH`; a friction that changes with the
motion needs one that is metres away.

**Offsets** drift with temperature. While S rests and the load is the known one, the known offsets
follow the residual with the time constant `FOLLOW`, as long as it is below `LARGEST`; what is
larger is a contact. A push of up to `LARGEST` at rest is therefore forgotten within seconds.
"""

from __future__ import annotations

import numpy as np

from drake_teleop.common.arrays import Array
from drake_teleop.common.compiled import njit
from drake_teleop.common.vectors import put
from drake_teleop.load.online import change
from drake_teleop.load.online.change import (
    CHANGED,
    KNOWN,
    change_state,
    change_update,
    known_load,
    new_load,
    new_load_age,
)
from drake_teleop.load.regressor import non_contact_wrench_into
from drake_teleop.load.sample import ANGULAR_ACCELERATION, ANGULAR_VELOCITY, SPECIFIC_FORCE, WRENCH

LOAD_STATES = ("learning", "settled", "disturbed", "changed")
"""What the state of a load estimator means; learning is what comes before this module."""
LEARNING, SETTLED, DISTURBED, OTHER_LOAD = range(4)

FADE, REST, FOLLOW, EXPLAINED = 0.1, 0.3, 3.0, 0.1
"""Durations in seconds (module docstring)."""
LARGEST = np.array([0.3] * 3 + [0.015] * 3)
"""Three times `change.OFFSET_DRIFT` [N, N m]."""
VARIES = 0.5
"""Noise never makes that much of a low-passed force [N]."""
REACH = 1.0
"""How far from So the centre of mass of something that is grasped or put down may be [m]."""

# At rest, low-passed by _SMOOTH [s], S turns slower than that [rad/s] and its specific force stays
# that near to where it was [m/s^2].
_SMOOTH, _TURNING, _MOVED = 0.05, 0.02, 0.1

# Parts of the memory, before that of `change`: state; samples at rest; low-passed specific force,
# angular velocity, residual; specific force at the beginning of the rest; least and largest
# residual force since a new load has explained it; samples since they are `VARIES` apart.
_STATE, _RESTED, _S, _OMEGA, _RESIDUAL = 0, 1, 2, 5, 8
_WHERE, _LEAST, _MOST, _VARIED, _CHANGE = 14, 17, 20, 23, 24

SIZE = _CHANGE + change.SIZE
"""Of the memory of `watched_update`."""


def watched_memory(theta: Array, covariance: Array) -> Array:
    """The memory (SIZE,) of `watched_update` when a load has settled.

    Args:
        theta: (16,) [offsets; phi] that is known.
        covariance: (16, 16) of it.
    """
    rest = np.zeros(_CHANGE)
    rest[_STATE] = SETTLED
    return np.concatenate([rest, change.change_memory(theta, covariance)])


@njit(cache=True)
def watched_state(memory):
    """Index into `LOAD_STATES`; that of a memory of zeros is `LEARNING`."""
    return int(memory[_STATE])


@njit(cache=True)
def _rests(memory, sample, period):
    """Whether S has been at rest for a while."""
    share = period / (_SMOOTH + period)
    s, omega = sample[SPECIFIC_FORCE], sample[ANGULAR_VELOCITY]
    moved, turning = 0.0, 0.0
    for i in range(3):
        memory[_S + i] += share * (s[i] - memory[_S + i])
        memory[_OMEGA + i] += share * (omega[i] - memory[_OMEGA + i])
        moved += (memory[_S + i] - memory[_WHERE + i]) ** 2
        turning += memory[_OMEGA + i] ** 2
    if moved > _MOVED**2 or turning > _TURNING**2:
        memory[_RESTED] = 0.0
        put(memory, _WHERE, memory, _S, 3)
    memory[_RESTED] += 1.0
    return memory[_RESTED] * period > REST


@njit(cache=True)
def _varies(memory, residual, age, period):
    """Whether a new load, `age` samples old, has explained a change of the residual force."""
    low_passed = memory[_RESIDUAL : _RESIDUAL + 3]
    least, most = memory[_LEAST:_MOST], memory[_MOST:_VARIED]
    share = 1.0 if age == 0.0 else period / (_SMOOTH + period)
    for i in range(_RESIDUAL, _RESIDUAL + 6):
        memory[i] += share * (residual[i - _RESIDUAL] - memory[i])
    if age * period < 2.0 * _SMOOTH:
        put(least, 0, low_passed, 0, 3)
        put(most, 0, low_passed, 0, 3)
    put(least, 0, np.minimum(least, low_passed), 0, 3)
    put(most, 0, np.maximum(most, low_passed), 0, 3)
    apart = ((most - least) ** 2).sum() > VARIES**2
    memory[_VARIED] = memory[_VARIED] + 1.0 if apart else 0.0
    return memory[_VARIED] * period > EXPLAINED


@njit(cache=True)
def _is_within_reach(known, new):
    """Whether what has come or gone has its centre of mass within `REACH`."""
    moment = ((new[7:10] - known[7:10]) ** 2).sum()
    return moment < (REACH * (new[6] - known[6])) ** 2


@njit(cache=True)
def watched_update(out, memory, sample, fallback, period, block, noise, window, hold, bound):
    """One sample, in place; compiled, checks nothing.

    Args:
        out: (16,) [offsets; phi] that is handed out, updated.
        memory: of `watched_memory`, updated.
        sample: see `drake_teleop.load.sample`, its first 15 numbers.
        fallback: (10,) phi of what is known of a load that has changed.
        period: between samples [s].
        block, noise, window, hold, bound: of `change.change_parameters`.
    """
    watch = memory[_CHANGE:]
    change_update(watch, sample, block, noise, window, hold, bound)
    known, residual, target = known_load(watch), np.empty(6), np.empty(16)
    s, omega, alpha = sample[SPECIFIC_FORCE], sample[ANGULAR_VELOCITY], sample[ANGULAR_ACCELERATION]
    non_contact_wrench_into(s, omega, alpha, known[6:], residual)
    wrench = sample[WRENCH]
    for i in range(6):
        residual[i] = wrench[i] - known[i] - residual[i]
    rests, verdict = _rests(memory, sample, period), change_state(watch)
    varies = _varies(memory, residual, new_load_age(watch), period)
    if verdict == KNOWN:
        memory[_STATE] = SETTLED
        if rests and (np.abs(memory[_RESIDUAL : _RESIDUAL + 6]) <= LARGEST).all():
            for i in range(6):
                known[i] += period / FOLLOW * residual[i]
    elif memory[_STATE] != OTHER_LOAD:
        another = verdict == CHANGED and varies and _is_within_reach(known, new_load(watch))
        memory[_STATE] = OTHER_LOAD if another else DISTURBED
    put(target, 0, known, 0, 16)
    if memory[_STATE] == OTHER_LOAD:
        put(target, 6, fallback, 0, 10)
    out += period / (FADE + period) * (target - out)
