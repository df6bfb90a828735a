"""Monitor of a known load in use, which selects the load whose wrench is removed from a sample.

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
from drake_teleop.load import regressor
from drake_teleop.load.online import change

LOAD_STATE_NAMES = ("learning", "settled", "disturbed", "changed")
"""States of a load estimator, by index; "learning": the load is not identified yet."""
STATE_LEARNING, STATE_SETTLED, STATE_DISTURBED, STATE_OTHER_LOAD = range(4)

LOAD_FADE_TIME_S, MIN_REST_TIME_S, OFFSET_TIME_CONSTANT_S, MIN_CHANGE_TIME_S = 0.1, 0.3, 3.0, 0.1
"""Durations [s]: cross-fade, rest before offsets follow residuals, time constant of the offsets,
and explanation of a changed force by a new load."""
MAX_OFFSET_DRIFT_RESIDUAL = np.array([0.3] * 3 + [0.015] * 3)
"""Largest residual that offsets follow, three times `change.OFFSET_DRIFT_STD` [N, N m]."""
MIN_FORCE_CHANGE_N = 0.5
"""Smallest change of the low-passed force that noise cannot cause [N]."""
MAX_COM_DISTANCE_FROM_SENSOR_M = 1.0
"""Largest distance of So from the centre of mass of a grasped or released object [m]."""

# Time constant of the low-pass [s]; largest angular velocity [rad/s] and change of the specific
# force [m/s^2] at rest.
_LOW_PASS_TIME_CONSTANT_S, _MAX_REST_ANGULAR_SPEED, _MAX_REST_ACCELERATION_CHANGE = 0.05, 0.02, 0.1

# Indices into the memory, before that of `change`: state; samples at rest; low-passed specific
# force, angular velocity and residual; specific force at the start of the rest; smallest and
# largest residual force of the new load; samples with a difference of `MIN_FORCE_CHANGE_N`.
STATE_INDEX, _REST_SAMPLES_INDEX, _SPECIFIC_FORCE_START, _OMEGA_START = 0, 1, 2, 5
_RESIDUAL_START, _REST_FORCE_START, _LOWEST_FORCE_START, _HIGHEST_FORCE_START = 8, 14, 17, 20
_CHANGED_SAMPLES_INDEX, _CHANGE_DETECTOR_START = 23, 24

MEMORY_SIZE = _CHANGE_DETECTOR_START + change.MEMORY_SIZE
"""Length of the memory of `monitor_load`; `STATE_INDEX` is the index of its state."""


def initial_monitor_memory(theta: Array, covariance: Array) -> Array:
    rest = np.zeros(_CHANGE_DETECTOR_START)
    rest[STATE_INDEX] = STATE_SETTLED
    return np.concatenate([rest, change.initial_change_memory(theta, covariance)])


@njit(cache=True)
def _update_rest_detector(memory, sample, period):
    share = period / (_LOW_PASS_TIME_CONSTANT_S + period)
    s, omega = sample[regressor.SPECIFIC_FORCE_SLICE], sample[regressor.ANGULAR_VELOCITY_SLICE]
    shift, rate = 0.0, 0.0
    for i in range(3):
        memory[_SPECIFIC_FORCE_START + i] += share * (s[i] - memory[_SPECIFIC_FORCE_START + i])
        memory[_OMEGA_START + i] += share * (omega[i] - memory[_OMEGA_START + i])
        shift += (memory[_SPECIFIC_FORCE_START + i] - memory[_REST_FORCE_START + i]) ** 2
        rate += memory[_OMEGA_START + i] ** 2
    if shift > _MAX_REST_ACCELERATION_CHANGE**2 or rate > _MAX_REST_ANGULAR_SPEED**2:
        memory[_REST_SAMPLES_INDEX] = 0.0
        copy_into(memory, _REST_FORCE_START, memory, _SPECIFIC_FORCE_START, 3)
    memory[_REST_SAMPLES_INDEX] += 1.0
    return memory[_REST_SAMPLES_INDEX] * period > MIN_REST_TIME_S


@njit(cache=True)
def _update_force_change_detector(memory, residual, age_samples, period):
    low_passed = memory[_RESIDUAL_START : _RESIDUAL_START + 3]
    lowest = memory[_LOWEST_FORCE_START:_HIGHEST_FORCE_START]
    highest = memory[_HIGHEST_FORCE_START:_CHANGED_SAMPLES_INDEX]
    share = 1.0 if age_samples == 0.0 else period / (_LOW_PASS_TIME_CONSTANT_S + period)
    for i in range(_RESIDUAL_START, _RESIDUAL_START + 6):
        memory[i] += share * (residual[i - _RESIDUAL_START] - memory[i])
    if age_samples * period < 2.0 * _LOW_PASS_TIME_CONSTANT_S:
        copy_into(lowest, 0, low_passed, 0, 3)
        copy_into(highest, 0, low_passed, 0, 3)
    copy_into(lowest, 0, np.minimum(lowest, low_passed), 0, 3)
    copy_into(highest, 0, np.maximum(highest, low_passed), 0, 3)
    differs = ((highest - lowest) ** 2).sum() > MIN_FORCE_CHANGE_N**2
    memory[_CHANGED_SAMPLES_INDEX] = memory[_CHANGED_SAMPLES_INDEX] + 1.0 if differs else 0.0
    return memory[_CHANGED_SAMPLES_INDEX] * period > MIN_CHANGE_TIME_S


@njit(cache=True)
def _is_com_of_load_change_near_sensor(known, new):
    moment = ((new[7:10] - known[7:10]) ** 2).sum()
    return moment < (MAX_COM_DISTANCE_FROM_SENSOR_M * (new[6] - known[6])) ** 2


@njit(cache=True)
def monitor_load(out, memory, sample, fallback, period, block, noise, window, hold, mass_std_ratio):
    """Process one sample (15,): fade `out` (16,), [offsets; phi], to the load to remove.

    `fallback` (10,): phi for a changed load; `block` ... : results of `change_detector_parameters`.
    """
    watch = memory[_CHANGE_DETECTOR_START:]
    change.update_change_detector(watch, sample, block, noise, window, hold, mass_std_ratio)
    known, residual, target = watch[change.KNOWN_LOAD_SLICE], np.empty(6), np.empty(16)
    wrench, motion = sample[regressor.WRENCH_SLICE], sample[regressor.MOTION_SLICE]
    regressor.non_contact_wrench_into(motion[:3], motion[3:6], motion[6:], known[6:], residual)
    for i in range(6):
        residual[i] = wrench[i] - known[i] - residual[i]
    at_rest = _update_rest_detector(memory, sample, period)
    verdict, age = change.current_state_index(watch), change.new_load_age_in_samples(watch)
    force_changed = _update_force_change_detector(memory, residual, age, period)
    if verdict == change.STATE_KNOWN:
        memory[STATE_INDEX] = STATE_SETTLED
        low_passed = np.abs(memory[_RESIDUAL_START : _RESIDUAL_START + 6])
        if at_rest and (low_passed <= MAX_OFFSET_DRIFT_RESIDUAL).all():
            for i in range(6):
                known[i] += period / OFFSET_TIME_CONSTANT_S * residual[i]
    elif memory[STATE_INDEX] != STATE_OTHER_LOAD:
        near = _is_com_of_load_change_near_sensor(known, watch[change.NEW_LOAD_SLICE])
        other = verdict == change.STATE_CHANGED and force_changed and near
        memory[STATE_INDEX] = STATE_OTHER_LOAD if other else STATE_DISTURBED
    copy_into(target, 0, known, 0, 16)
    if memory[STATE_INDEX] == STATE_OTHER_LOAD:
        copy_into(target, 6, fallback, 0, 10)
    out += period / (LOAD_FADE_TIME_S + period) * (target - out)
