"""Online detection of a grasped or released object, from a changed load, Eqs. (T23), (T24).

Its states::

    known       the known load explains the mean wrench of blocks of samples
    disturbed   neither the known nor a new load explains it: contact, or the moment of a grasp
    changed     a new load explains it
    identified  mass and first moments of the new load are identified: it is now the known load
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_teleop.common.compiled import njit
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array, broadcast_to_rows, finite_array, positive_array
from drake_teleop.common.vectors import cholesky, copy_into
from drake_teleop.load import regressor
from drake_teleop.load.identification import Identification, is_precise_enough
from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.load.online.recursive import MIN_RELATIVE_NOISE_VARIANCE, PRIOR_STD

STATE_NAMES = ("known", "disturbed", "changed", "identified")
"""States of the change detector, by index."""
STATE_KNOWN, STATE_DISTURBED, STATE_CHANGED, STATE_IDENTIFIED = range(4)

DETECTOR_BLOCK_DURATION_S, FILTER_RESTART_INTERVAL_S = 0.016, 2.0
MIN_NEW_LOAD_AGE_S, MODEL_ERROR_PERSISTENCE_S = 0.2, 0.3
"""Durations [s]: of a block, until a filter restarts, until a new load is accepted, and of a model
error."""
MAX_MASS_STD_TO_MASS_CHANGE = 0.0025
"""Default of `mass_std_ratio`: four standard deviations are 1 % of the change of mass."""
OFFSET_DRIFT_STD = (0.1,) * 3 + (0.005,) * 3
"""Default standard deviation of the offsets' drift since the identification [N, N m]."""

# Standard deviations of a grasped or released object [kg, kg m, kg m^2].
OBJECT_PRIOR_STD = PRIOR_STD[6:]
# Cumulative sum of the blocks' chi-squared (six degrees of freedom): slack, alarm, and return to
# the known load. With a slack of twice the mean, noise reaches the alarm once in 1e10 blocks; five
# blocks of noise reach the return limit.
_CHI_SQUARED_SLACK, _ALARM_CUSUM, _RETURN_TO_KNOWN_CUSUM = 12.0, 60.0, -30.0
# Factor of this limit for first moments relative to that of the mass, and smallest size [m].
_FIRST_MOMENT_BOUND_FACTOR, _MIN_LOAD_SIZE_M = 10.0, 0.03
# Standard deviations below zero at which the mass of a new load is impossible.
_NEGATIVE_MASS_LIMIT_SIGMAS = 4.0

# Indices into the memory: status; squared residuals of the known and the new load; sums of a block;
# then [theta (16); P (256)] of the known load, of its filter, and of the new load's filter.
_STATE_INDEX, _BASE_STATE_INDEX, _BLOCK_SAMPLES_INDEX, _SAMPLE_COUNT_INDEX = range(4)
_CUSUM_INDEX, _RETURN_CUSUM_INDEX, _ESTIMATE_AGE_INDEX, _NEW_LOAD_START_INDEX = range(4, 8)
_IDENTIFIED_SAMPLES_INDEX, _ALPHA_SQUARES_INDEX = 8, 9
_KNOWN_RESIDUAL_SQUARES_START, _NEW_RESIDUAL_SQUARES_START, _WRENCH_SUM_START = 10, 16, 22
_MOTION_SUM_START, _REGRESSOR_SUM_START, _KNOWN_LOAD_START = 28, 37, 97
_MONITOR_FILTER_START, _NEW_FILTER_START = _KNOWN_LOAD_START + 272, _KNOWN_LOAD_START + 544

MEMORY_SIZE = _KNOWN_LOAD_START + 816
"""Length of the memory of `update_change_detector`."""
KNOWN_LOAD_SLICE = slice(_KNOWN_LOAD_START, _KNOWN_LOAD_START + 16)
NEW_LOAD_SLICE = slice(_NEW_FILTER_START, _NEW_FILTER_START + 16)
"""Parts of the memory: [offsets; phi] of the known and of the new load."""
_NEW_LOAD_COVARIANCE_SLICE = slice(NEW_LOAD_SLICE.stop, MEMORY_SIZE)


@njit(cache=True)
def whitening_matrix(motion, phi, noise, relative_error_variance, num_samples):
    """Return the matrix (6, 6) that maps noise of a mean wrench to unit covariance.

    `motion` (9,): [s, omega, alpha]; `noise` (>= 15,): variances of one wrench and motion [SI].
    """
    root, N = np.zeros((6, 6)), np.zeros((6, 6))
    above, below, shifted = np.empty(6), np.empty(6), motion.copy()
    regressor.non_contact_wrench_into(motion[:3], motion[3:6], motion[6:], phi, above)
    f = above[0] ** 2 + above[1] ** 2 + above[2] ** 2
    tau = above[3] ** 2 + above[4] ** 2 + above[5] ** 2
    arm = (phi[1] ** 2 + phi[2] ** 2 + phi[3] ** 2) / max(phi[0] ** 2, 1e-12)
    for c in range(6):
        N[c, c] = noise[c] + num_samples * relative_error_variance * (f if c < 3 else tau + arm * f)
    for k in range(9):
        if noise[6 + k] == 0.0:
            continue
        # The wrench is quadratic in the motion, so the central difference is exact.
        shifted[k] = motion[k] + 1.0
        regressor.non_contact_wrench_into(shifted[:3], shifted[3:6], shifted[6:], phi, above)
        shifted[k] = motion[k] - 1.0
        regressor.non_contact_wrench_into(shifted[:3], shifted[3:6], shifted[6:], phi, below)
        shifted[k] = motion[k]
        for i in range(6):
            for j in range(i + 1):
                N[i, j] += 0.25 * noise[6 + k] * (above[i] - below[i]) * (above[j] - below[j])
    N /= num_samples
    cholesky(N, 6)
    for i in range(6):
        for j in range(i + 1):
            value = 1.0 if i == j else 0.0
            for k in range(j, i):
                value -= N[i, k] * root[k, j]
            root[i, j] = value / N[i, i]
    return root


@njit(cache=True)
def update_estimate_by_block_mean(estimate, V, wrench, whitening):
    """Update `estimate` [theta (16); P (256)] by a mean wrench (6,); return its chi-squared."""
    row, gain = np.empty(16), np.empty(16)
    theta, P, chi = estimate[:16], estimate[16:].reshape(16, 16), 0.0
    for c in range(6):
        innovation = 0.0
        row[:] = 0.0
        for k in range(c + 1):
            row[k] = whitening[c, k]
            innovation += whitening[c, k] * wrench[k]
            for j in range(10):
                row[6 + j] += whitening[c, k] * V[k, j]
        predicted, uncorrelated = 0.0, 0.0
        for i in range(16):
            innovation -= row[i] * theta[i]
            value = 0.0
            for j in range(16):
                value += P[i, j] * row[j]
            gain[i] = value
            predicted += row[i] * value
            uncorrelated += row[i] * row[i] * P[i, i]
        total = max(1.0, MIN_RELATIVE_NOISE_VARIANCE * uncorrelated) + predicted
        chi += innovation * innovation / total
        for i in range(16):
            theta[i] += gain[i] * innovation / total
            for j in range(16):
                P[i, j] -= gain[i] * gain[j] / total
    return chi


@njit(cache=True)
def _update_load_filter_by_block(memory, filter_start, samples_per_block, noise):
    phi = memory[filter_start + 6 : filter_start + 16].copy()
    wrench = memory[_WRENCH_SUM_START:_MOTION_SUM_START]
    motion = memory[_MOTION_SUM_START:_REGRESSOR_SUM_START]
    V = memory[_REGRESSOR_SUM_START:_KNOWN_LOAD_START].reshape(6, 10)
    before = memory[filter_start : filter_start + 272].copy()
    root = whitening_matrix(motion, phi, noise, noise[15], samples_per_block)
    chi = update_estimate_by_block_mean(before, V, wrench, root)
    if noise[15] == 0.0:
        copy_into(memory, filter_start, before, 0, 272)
    else:
        root = whitening_matrix(motion, phi, noise, noise[15] * noise[16], samples_per_block)
        update_estimate_by_block_mean(memory[filter_start : filter_start + 272], V, wrench, root)
    return chi


@njit(cache=True)
def _restart_filter_from_known_load(memory, filter_start):
    copy_into(memory, filter_start, memory, _KNOWN_LOAD_START, 272)
    if filter_start == _NEW_FILTER_START:
        for j in range(10):
            memory[filter_start + 16 + 17 * (6 + j)] += OBJECT_PRIOR_STD[j] ** 2
        memory[_NEW_LOAD_START_INDEX] = memory[_SAMPLE_COUNT_INDEX]
        memory[_NEW_RESIDUAL_SQUARES_START:_WRENCH_SUM_START] = memory[_ALPHA_SQUARES_INDEX] = 0.0
    memory[_CUSUM_INDEX] = memory[_ESTIMATE_AGE_INDEX] = 0.0


@njit(cache=True)
def _is_new_load_identified(memory, mass_std_ratio):
    theta, P = memory[NEW_LOAD_SLICE], memory[_NEW_LOAD_COVARIANCE_SLICE].reshape(16, 16)
    change = abs(theta[6] - memory[_KNOWN_LOAD_START + 6])
    size = math.sqrt(theta[7] ** 2 + theta[8] ** 2 + theta[9] ** 2) / abs(theta[6])
    moment = mass_std_ratio * change * max(size, _MIN_LOAD_SIZE_M) * _FIRST_MOMENT_BOUND_FACTOR
    largest = max(P[7, 7], P[8, 8], P[9, 9])
    return math.sqrt(P[6, 6]) <= mass_std_ratio * change and math.sqrt(largest) <= moment


@njit(cache=True)
def _inflate_inertia_variances(memory, noise, samples_per_block):
    theta, P = memory[NEW_LOAD_SLICE], memory[_NEW_LOAD_COVARIANCE_SLICE].reshape(16, 16)
    expected = memory[_ESTIMATE_AGE_INDEX] * (noise[12] + noise[13] + noise[14]) / samples_per_block
    share = min(1.0, expected / max(memory[_ALPHA_SQUARES_INDEX], 1e-300))
    moment = theta[7] ** 2 + theta[8] ** 2 + theta[9] ** 2
    scale = abs(theta[10]) + abs(theta[13]) + abs(theta[15]) + 2.0 * moment / abs(theta[6])
    for i in range(10, 16):
        P[i, i] += (share * scale) ** 2


@njit(cache=True)
def update_change_detector(memory, sample, block, noise, window, hold, mass_std_ratio):
    """Update `memory` by a sample (15,); others: results of `change_detector_parameters`."""
    V = np.empty((6, 10))
    motion = sample[regressor.MOTION_SLICE]
    regressor.regressor_into(motion[:3], motion[3:6], motion[6:], V)
    memory[_WRENCH_SUM_START:_REGRESSOR_SUM_START] += sample[regressor.WRENCH_AND_MOTION_SLICE]
    memory[_REGRESSOR_SUM_START:_KNOWN_LOAD_START] += V.ravel()
    memory[_SAMPLE_COUNT_INDEX] += 1.0
    memory[_BLOCK_SAMPLES_INDEX] += 1.0
    if memory[_BLOCK_SAMPLES_INDEX] >= block:
        memory[_WRENCH_SUM_START:_KNOWN_LOAD_START] /= block
        _update_change_state_by_block(memory, block, noise, window, hold, mass_std_ratio)
        memory[_WRENCH_SUM_START:_KNOWN_LOAD_START] = 0.0
        memory[_BLOCK_SAMPLES_INDEX] = 0.0


@njit(cache=True)
def _update_change_state_by_block(memory, block, noise, window, hold, mass_std_ratio):
    if memory[_STATE_INDEX] == memory[_BASE_STATE_INDEX]:
        if memory[_ESTIMATE_AGE_INDEX] >= window:
            excess = memory[_CUSUM_INDEX]
            _restart_filter_from_known_load(memory, _MONITOR_FILTER_START)
            memory[_CUSUM_INDEX] = excess
        memory[_ESTIMATE_AGE_INDEX] += 1.0
        chi = _update_load_filter_by_block(memory, _MONITOR_FILTER_START, block, noise)
        memory[_CUSUM_INDEX] = max(0.0, memory[_CUSUM_INDEX] + chi - _CHI_SQUARED_SLACK)
        if memory[_CUSUM_INDEX] > _ALARM_CUSUM:
            memory[_STATE_INDEX], memory[_RETURN_CUSUM_INDEX] = STATE_DISTURBED, 0.0
            _restart_filter_from_known_load(memory, _NEW_FILTER_START)
        return
    # Return to the known load if it explains the blocks without an update.
    copy_into(memory, _MONITOR_FILTER_START, memory, _KNOWN_LOAD_START, 272)
    chi = _update_load_filter_by_block(memory, _MONITOR_FILTER_START, block, noise)
    memory[_RETURN_CUSUM_INDEX] = min(0.0, memory[_RETURN_CUSUM_INDEX] + chi - _CHI_SQUARED_SLACK)
    if memory[_RETURN_CUSUM_INDEX] < _RETURN_TO_KNOWN_CUSUM:
        memory[_STATE_INDEX] = memory[_BASE_STATE_INDEX]
        _restart_filter_from_known_load(memory, _MONITOR_FILTER_START)
        return
    # Test whether one new load explains all blocks since its start.
    chi = _update_load_filter_by_block(memory, _NEW_FILTER_START, block, noise)
    memory[_ESTIMATE_AGE_INDEX] += 1.0
    for k in range(3):
        memory[_ALPHA_SQUARES_INDEX] += memory[_MOTION_SUM_START + 6 + k] ** 2
    for c in range(6):
        residual = memory[_WRENCH_SUM_START + c] - memory[_NEW_FILTER_START + c]
        row = memory[_REGRESSOR_SUM_START + 10 * c : _REGRESSOR_SUM_START + 10 * c + 10]
        for j in range(10):
            residual -= row[j] * memory[_NEW_FILTER_START + 6 + j]
        memory[_NEW_RESIDUAL_SQUARES_START + c] += residual * residual
    memory[_CUSUM_INDEX] = max(0.0, memory[_CUSUM_INDEX] + chi - _CHI_SQUARED_SLACK)
    # A clearly negative mass is not a load.
    mass = memory[_NEW_FILTER_START + 6]
    deviation = math.sqrt(memory[_NEW_FILTER_START + 16 + 17 * 6])
    if memory[_CUSUM_INDEX] > _ALARM_CUSUM or mass < -_NEGATIVE_MASS_LIMIT_SIGMAS * deviation:
        memory[_STATE_INDEX] = STATE_DISTURBED
        _restart_filter_from_known_load(memory, _NEW_FILTER_START)
    elif memory[_STATE_INDEX] == STATE_DISTURBED and memory[_ESTIMATE_AGE_INDEX] >= hold:
        memory[_STATE_INDEX] = STATE_CHANGED
    elif memory[_STATE_INDEX] == STATE_CHANGED and _is_new_load_identified(memory, mass_std_ratio):
        memory[_STATE_INDEX] = memory[_BASE_STATE_INDEX] = STATE_IDENTIFIED
        _inflate_inertia_variances(memory, noise, block)
        copy_into(memory, _KNOWN_LOAD_START, memory, _NEW_FILTER_START, 272)
        memory[_IDENTIFIED_SAMPLES_INDEX] = memory[_ESTIMATE_AGE_INDEX] * block
        share = block / memory[_ESTIMATE_AGE_INDEX]
        for i in range(6):
            squares = memory[_NEW_RESIDUAL_SQUARES_START + i]
            memory[_KNOWN_RESIDUAL_SQUARES_START + i] = squares * share
        _restart_filter_from_known_load(memory, _MONITOR_FILTER_START)


@njit(cache=True)
def _detect_changes_in_samples(memory, samples, states, block, noise, window, hold, mass_std_ratio):
    for k in range(samples.shape[0]):
        update_change_detector(memory, samples[k], block, noise, window, hold, mass_std_ratio)
        states[k] = int(memory[_STATE_INDEX])


DetectorParameters: TypeAlias = tuple[int, Array, int, int, float]


def change_detector_parameters(
    wrench_std: ArrayLike,
    motion_std: ArrayLike,
    period: float,
    *,
    relative_wrench_error: float = 0.0,
    mass_std_ratio: float | None = None,
) -> DetectorParameters:
    """Return block length [samples], noise (17,), window and hold [blocks], mass_std_ratio.

    `noise`: variances of wrench, motion and relative wrench error, duration of that error [blocks].
    A filter restarts after `window`; a new load is accepted after `hold`.

    Args:
        wrench_std, motion_std: (6,), (9,) roots of the long-run variances of `SecondMoments` [SI].
        period: time between samples [s].
        relative_wrench_error: relative error of the load's wrench.
        mass_std_ratio: required standard deviation of a new mass / change of mass.
    """
    positive_array("period", period)
    if not 0.0 <= relative_wrench_error < 1.0:
        what = f"{relative_wrench_error} is outside the range 0 <= relative_wrench_error < 1"
        remedy = "give the relative error of the wrench"
        raise DrakeTeleopError(what, where="relative_wrench_error", remedy=remedy)
    if mass_std_ratio is None:
        mass_std_ratio = max(MAX_MASS_STD_TO_MASS_CHANGE, 2.0 * relative_wrench_error)
    positive_array("mass_std_ratio", mass_std_ratio)
    block = max(1, round(DETECTOR_BLOCK_DURATION_S / period))
    window, hold, memory = (
        max(1, round(x / (block * period)))
        for x in (FILTER_RESTART_INTERVAL_S, MIN_NEW_LOAD_AGE_S, MODEL_ERROR_PERSISTENCE_S)
    )
    std = positive_array("wrench_std", wrench_std, 6), finite_array("motion_std", motion_std, 9)
    noise = np.concatenate([*std, [relative_wrench_error]]) ** 2
    return block, np.append(noise, memory), window, hold, float(mass_std_ratio)


def initial_change_memory(
    theta: Array, covariance: Array, offset_drift: ArrayLike = OFFSET_DRIFT_STD
) -> Array:
    """Return the initial memory of the change detector for a known load.

    `offset_drift` (6,): standard deviation of the offsets' drift since identification [N, N m].
    """
    prior = np.square(PRIOR_STD)
    P = covariance.copy()
    unknown = np.diag(P) > prior
    P[unknown, :] = P[:, unknown] = 0.0
    P[unknown, unknown] = prior[unknown]
    P[range(6), range(6)] += np.square(finite_array("offset_drift", offset_drift, 6))
    # Undetermined inertias are those of a point mass, as in `phi_with_inertia_replaced`.
    phi = theta[6:].copy()
    point = phi_from_mass_com_inertia(phi[0], phi[1:4] / phi[0], np.zeros((3, 3)))
    phi[4:] = np.where(unknown[10:], point[4:], phi[4:])
    memory = np.zeros(MEMORY_SIZE)
    memory[KNOWN_LOAD_SLICE] = np.concatenate([theta[:6], phi])
    memory[_KNOWN_LOAD_START + 16 : _MONITOR_FILTER_START] = P.ravel()
    copy_into(memory, _MONITOR_FILTER_START, memory, _KNOWN_LOAD_START, 272)
    return memory


@njit(cache=True)
def current_state_index(memory):
    """Return the index in `STATE_NAMES`; "known" also if the known load was identified here."""
    is_known = memory[_STATE_INDEX] == memory[_BASE_STATE_INDEX]
    return STATE_KNOWN if is_known else int(memory[_STATE_INDEX])


@njit(cache=True)
def new_load_age_in_samples(memory):
    return memory[_SAMPLE_COUNT_INDEX] - memory[_NEW_LOAD_START_INDEX]


def detector_states_of_log(
    memory: Array,
    parameters: DetectorParameters,
    wrench: ArrayLike,
    s: ArrayLike,
    omega: ArrayLike,
    alpha: ArrayLike,
) -> NDArray[np.int_]:
    """Process a log of N samples; return the states (N,) as indices into `STATE_NAMES`."""
    _, rows = broadcast_to_rows(wrench=(wrench, 6), s=(s, 3), omega=(omega, 3), alpha=(alpha, 3))
    states = np.empty(len(rows[0]), np.int_)
    _detect_changes_in_samples(memory, np.concatenate(rows, axis=1), states, *parameters)
    return states


def identified_or_known_load(memory: Array, known: Identification) -> Identification:
    """Return the last load that the detector identified, or `known`."""
    if memory[_BASE_STATE_INDEX] == STATE_KNOWN:
        return known
    theta = memory[KNOWN_LOAD_SLICE].copy()
    covariance = memory[_KNOWN_LOAD_START + 16 : _MONITOR_FILTER_START].reshape(16, 16).copy()
    return replace(
        known,
        phi=theta[6:],
        offsets=theta[:6],
        covariance=covariance,
        identifiable=is_precise_enough(np.sqrt(np.diag(covariance)), theta[6:]),
        residual_rms=np.sqrt(memory[_KNOWN_RESIDUAL_SQUARES_START:_NEW_RESIDUAL_SQUARES_START]),
        method="recursive least squares",
        samples=int(memory[_IDENTIFIED_SAMPLES_INDEX]),
        degrees_of_freedom=np.full(16, np.inf),
        prior_dominated=np.zeros(16, dtype=bool),
    )
