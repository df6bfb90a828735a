"""Monitor of a known load in use, which selects the load to eliminate, sample by sample.

Its states::

    settled     the known load explains the wrench and is used
    disturbed   contact, or the moment of a grasp; the known load is used
    changed     another load; the fallback (gripper or nothing) is used
"""

from __future__ import annotations

import numpy as np

from drake_teleop.common.compiled import njit
from drake_teleop.common.numeric import Array
from drake_teleop.common.vectors import copy_into
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
from drake_teleop.load.regressor import (
    ANGULAR_ACCELERATION,
    ANGULAR_VELOCITY,
    SPECIFIC_FORCE,
    WRENCH,
    non_contact_wrench_into,
)

LOAD_STATES = ("learning", "settled", "disturbed", "changed")
"""States of a load estimator, by index; "learning": the load is not identified yet."""
LEARNING, SETTLED, DISTURBED, OTHER_LOAD = range(4)

FADE_TIME_S, MIN_REST_S, OFFSET_TIME_S, MIN_EXPLAINED_S = 0.1, 0.3, 3.0, 0.1
"""Durations [s]: cross-fade, rest before offsets follow residuals, time constant of the offsets,
and explanation of a changed force by a new load."""
MAX_OFFSET_RESIDUAL = np.array([0.3] * 3 + [0.015] * 3)
"""Largest residual that offsets follow, three times `change.OFFSET_DRIFT` [N, N m]."""
MIN_FORCE_CHANGE_N = 0.5
"""Smallest change of the low-passed force that noise cannot cause [N]."""
MAX_COM_DISTANCE_M = 1.0
"""Largest distance of So from the centre of mass of a grasped or released object [m]."""

# Time constant of the low-pass [s]; largest angular velocity [rad/s] and change of the specific
# force [m/s^2] at rest.
_LOW_PASS_S, _MAX_RATE, _MAX_SHIFT = 0.05, 0.02, 0.1

# Indices into the memory, before that of `change`: state; samples at rest; low-passed specific
# force, angular velocity and residual; specific force at the start of the rest; smallest and
# largest residual force of the new load; samples with a difference of `MIN_FORCE_CHANGE_N`.
_STATE, _REST_SAMPLES, _S, _OMEGA, _RESIDUAL = 0, 1, 2, 5, 8
_REST_S, _LOWEST, _HIGHEST, _CHANGED_SAMPLES, _CHANGE = 14, 17, 20, 23, 24

SIZE = _CHANGE + change.SIZE
"""Length of the memory of `watched_update`."""


def watched_memory(theta: Array, covariance: Array) -> Array:
    rest = np.zeros(_CHANGE)
    rest[_STATE] = SETTLED
    return np.concatenate([rest, change.change_memory(theta, covariance)])


@njit(cache=True)
def watched_state(memory):
    """Return the index into `LOAD_STATES`; `LEARNING` for a memory of zeros."""
    return int(memory[_STATE])


@njit(cache=True)
def _is_at_rest(memory, sample, period):
    share = period / (_LOW_PASS_S + period)
    s, omega = sample[SPECIFIC_FORCE], sample[ANGULAR_VELOCITY]
    shift, rate = 0.0, 0.0
    for i in range(3):
        memory[_S + i] += share * (s[i] - memory[_S + i])
        memory[_OMEGA + i] += share * (omega[i] - memory[_OMEGA + i])
        shift += (memory[_S + i] - memory[_REST_S + i]) ** 2
        rate += memory[_OMEGA + i] ** 2
    if shift > _MAX_SHIFT**2 or rate > _MAX_RATE**2:
        memory[_REST_SAMPLES] = 0.0
        copy_into(memory, _REST_S, memory, _S, 3)
    memory[_REST_SAMPLES] += 1.0
    return memory[_REST_SAMPLES] * period > MIN_REST_S


@njit(cache=True)
def _force_has_changed(memory, residual, age, period):
    low_passed = memory[_RESIDUAL : _RESIDUAL + 3]
    lowest, highest = memory[_LOWEST:_HIGHEST], memory[_HIGHEST:_CHANGED_SAMPLES]
    share = 1.0 if age == 0.0 else period / (_LOW_PASS_S + period)
    for i in range(_RESIDUAL, _RESIDUAL + 6):
        memory[i] += share * (residual[i - _RESIDUAL] - memory[i])
    if age * period < 2.0 * _LOW_PASS_S:
        copy_into(lowest, 0, low_passed, 0, 3)
        copy_into(highest, 0, low_passed, 0, 3)
    copy_into(lowest, 0, np.minimum(lowest, low_passed), 0, 3)
    copy_into(highest, 0, np.maximum(highest, low_passed), 0, 3)
    differs = ((highest - lowest) ** 2).sum() > MIN_FORCE_CHANGE_N**2
    memory[_CHANGED_SAMPLES] = memory[_CHANGED_SAMPLES] + 1.0 if differs else 0.0
    return memory[_CHANGED_SAMPLES] * period > MIN_EXPLAINED_S


@njit(cache=True)
def _is_within_reach(known, new):
    moment = ((new[7:10] - known[7:10]) ** 2).sum()
    return moment < (MAX_COM_DISTANCE_M * (new[6] - known[6])) ** 2


@njit(cache=True)
def watched_update(out, memory, sample, fallback, period, block, noise, window, hold, bound):
    """Process one sample: monitor the known load and write the load to eliminate into `out` (16,).

    `fallback` (10,) is the phi for a changed load; the last arguments are from
    `change_parameters`.
    """
    watch = memory[_CHANGE:]
    change_update(watch, sample, block, noise, window, hold, bound)
    known, residual, target = known_load(watch), np.empty(6), np.empty(16)
    s, omega, alpha = sample[SPECIFIC_FORCE], sample[ANGULAR_VELOCITY], sample[ANGULAR_ACCELERATION]
    non_contact_wrench_into(s, omega, alpha, known[6:], residual)
    wrench = sample[WRENCH]
    for i in range(6):
        residual[i] = wrench[i] - known[i] - residual[i]
    at_rest, verdict = _is_at_rest(memory, sample, period), change_state(watch)
    force_changed = _force_has_changed(memory, residual, new_load_age(watch), period)
    if verdict == KNOWN:
        memory[_STATE] = SETTLED
        if at_rest and (np.abs(memory[_RESIDUAL : _RESIDUAL + 6]) <= MAX_OFFSET_RESIDUAL).all():
            for i in range(6):
                known[i] += period / OFFSET_TIME_S * residual[i]
    elif memory[_STATE] != OTHER_LOAD:
        other = verdict == CHANGED and force_changed and _is_within_reach(known, new_load(watch))
        memory[_STATE] = OTHER_LOAD if other else DISTURBED
    copy_into(target, 0, known, 0, 16)
    if memory[_STATE] == OTHER_LOAD:
        copy_into(target, 6, fallback, 0, 10)
    out += period / (FADE_TIME_S + period) * (target - out)
