"""Load for the elimination while a known load is monitored, sample by sample.

    settled     the known load explains the wrench and is used
    disturbed   contact, or the moment of a grasp; the known load is used
    changed     another load: the fallback (gripper or nothing) is used until the known load
                explains the wrench again or the new one is identified

Changes cross-fade with the time constant `FADE`. A constant push at rest equals another weight: a
new load counts only if it explains a force that changed by `VARIES`, for `EXPLAINED` seconds, with
a centre of mass within `REACH`. At rest, offsets follow residuals below `LARGEST`.
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
"""States of a load estimator, by index; "learning" precedes this module."""
LEARNING, SETTLED, DISTURBED, OTHER_LOAD = range(4)

FADE, REST, FOLLOW, EXPLAINED = 0.1, 0.3, 3.0, 0.1
"""Durations [s]: cross-fade, rest before offsets follow, their time constant, new load explains."""
LARGEST = np.array([0.3] * 3 + [0.015] * 3)
"""Largest residual that offsets follow, three times `change.OFFSET_DRIFT` [N, N m]."""
VARIES = 0.5
"""Smallest change of the low-passed force that noise cannot cause [N]."""
REACH = 1.0
"""Largest distance of So from the centre of mass of a grasped or released object [m]."""

# Time constant of the low-pass [s]; largest angular velocity [rad/s] and change of the specific
# force [m/s^2] at rest.
_SMOOTH, _TURNING, _MOVED = 0.05, 0.02, 0.1

# Indices into the memory, before that of `change`: state; samples at rest; low-passed specific
# force, angular velocity and residual; specific force at the start of the rest; smallest and
# largest residual force of the new load; samples with a difference of `VARIES`.
_STATE, _RESTED, _S, _OMEGA, _RESIDUAL = 0, 1, 2, 5, 8
_WHERE, _LEAST, _MOST, _VARIED, _CHANGE = 14, 17, 20, 23, 24

SIZE = _CHANGE + change.SIZE
"""Length of the memory of `watched_update`."""


def watched_memory(theta: Array, covariance: Array) -> Array:
    """Return the memory of `watched_update` for identified [offsets; phi] and covariance."""
    rest = np.zeros(_CHANGE)
    rest[_STATE] = SETTLED
    return np.concatenate([rest, change.change_memory(theta, covariance)])


@njit(cache=True)
def watched_state(memory):
    """Return the index into `LOAD_STATES`; `LEARNING` for a memory of zeros."""
    return int(memory[_STATE])


@njit(cache=True)
def _rests(memory, sample, period):
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
    """Return whether a new load, `age` samples old, has explained a changed residual force."""
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
    moment = ((new[7:10] - known[7:10]) ** 2).sum()
    return moment < (REACH * (new[6] - known[6])) ** 2


@njit(cache=True)
def watched_update(out, memory, sample, fallback, period, block, noise, window, hold, bound):
    """Update by one sample; compiled, without checks.

    Args:
        out: (16,) [offsets; phi] for the elimination, updated.
        memory: of `watched_memory`, updated.
        sample: (15 or more,) see `regressor`.
        fallback: (10,) phi for a changed load.
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
