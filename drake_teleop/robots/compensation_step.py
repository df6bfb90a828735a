"""Compiled operations of `compensator`, bit-equal to those of `eliminate --causal`."""

from __future__ import annotations

import math

from drake_teleop.common.compiled import njit
from drake_teleop.load.compensation import add_excess_weight_into, scaled_wrench_into

VALUE_NOT_FINITE, VALUE_TOO_LARGE, VALUE_AT_RANGE = 1, 2, 4
TARE_IN_MOTION, TARE_WRENCH_VARIES, TARE_EXCEEDS_DRIFT = 1, 2, 3
"""Reasons to refuse a tare: motion, contact, or more than the drift of offsets."""
MAX_FORCE_OFFSET_DRIFT_N, MAX_TORQUE_OFFSET_DRIFT_NM = 5.0, 0.25
"""Maximum drift of the offsets [N], [N m]."""
_MAX_REST_SPECIFIC_FORCE_RMS, _MAX_REST_OMEGA_RMS = 0.1, 0.02  # [m/s^2], [rad/s]


@njit(cache=True)
def reading_problem(values, largest, limits):
    """Return 0 for a valid reading (15,); 1: not finite, 2: implausible, 4: at sensor range."""
    for i in range(15):
        if not math.isfinite(values[i]):
            return VALUE_NOT_FINITE
    for i in range(15):
        if abs(values[i]) > largest[i]:
            return VALUE_TOO_LARGE
    for i in range(6):
        if abs(values[i]) >= limits[i]:
            return VALUE_AT_RANGE
    return 0


@njit(cache=True)
def low_pass_into(x, low_pass, memory):
    """Filter x (n,) in place by `low_pass` (7,): b (3), a_1, a_2, zi (2); state `memory` (2, n)."""
    start = math.isnan(memory[0, 0])
    for i in range(len(x)):
        u = x[i]
        if start:
            memory[0, i], memory[1, i] = low_pass[5] * u, low_pass[6] * u
        y = memory[0, i] + low_pass[0] * u
        memory[0, i] = memory[1, i] + u * low_pass[1] - y * low_pass[3]
        memory[1, i] = u * low_pass[2] - y * low_pass[4]
        x[i] = y


@njit(cache=True)
def contact_and_scaled_wrench_into(
    values, gravity, offsets, phi, no_load, scales, low_pass, memory, rest, at, out
):
    """Write contact wrench and scaled wrench of a valid reading `values` (15,) to out (12,).

    Row `at` of `rest` (n, 21), for a tare, receives the reading and its unfiltered contact wrench.
    `gravity` (3,): in S; `no_load` (10,): zeros; `scales` (4,): see `set_scale_factors_into`;
    `low_pass` (7,), or [] for none, with state `memory` (2, 12).
    """
    wrench, s, omega, alpha = values[:6], values[6:9], values[9:12], values[12:]
    contact, scaled = out[:6], out[6:]
    scaled_wrench_into(wrench, offsets, s, omega, alpha, phi, no_load, 0.0, 0.0, 1.0, contact)
    a, b, c = scales[0], scales[1], scales[2]
    scaled_wrench_into(wrench, offsets, s, omega, alpha, no_load, phi, a, b, c, scaled)
    if scales[3] != 0.0:
        add_excess_weight_into(gravity, no_load, phi, 0.0, scales[3], scaled)
    rest[at, :15] = values
    rest[at, 15:] = contact
    if len(low_pass) > 0:
        low_pass_into(out, low_pass, memory)


@njit(cache=True)
def set_scale_factors_into(sigma_weight, sigma_inertia, gamma, scales):
    """Write to `scales` (4,): inertia scale of two loads, gamma, weight minus inertia scale."""
    scales[0], scales[1], scales[2] = sigma_inertia, sigma_inertia, gamma
    scales[3] = sigma_weight - sigma_inertia


@njit(cache=True)
def add_to_statistics(row, count, mean, squares):
    """Add row number `count` to mean and sum of squared deviations (Welford 1962)."""
    for i in range(len(row)):
        step = row[i] - mean[i]
        mean[i] += step / count
        squares[i] += step * (row[i] - mean[i])


@njit(cache=True)
def update_tare_offsets(count, mean, squares, noise_limits, offsets):
    """Add the mean contact wrench to `offsets` (6,); return 0, or the reason of a refusal."""
    for i in range(6, 9):
        if squares[i] > count * (_MAX_REST_SPECIFIC_FORCE_RMS * _MAX_REST_SPECIFIC_FORCE_RMS):
            return TARE_IN_MOTION
    for i in range(9, 12):
        square_sum = squares[i] + count * (mean[i] * mean[i])
        if square_sum > count * (_MAX_REST_OMEGA_RMS * _MAX_REST_OMEGA_RMS):
            return TARE_IN_MOTION
    for i in range(6):
        if squares[15 + i] > count * (noise_limits[i] * noise_limits[i]):
            return TARE_WRENCH_VARIES
    for i in range(3):
        force, torque = abs(mean[15 + i]), abs(mean[18 + i])
        if force > MAX_FORCE_OFFSET_DRIFT_N or torque > MAX_TORQUE_OFFSET_DRIFT_NM:
            return TARE_EXCEEDS_DRIFT
    for i in range(6):
        offsets[i] += mean[15 + i]
    return 0


@njit(cache=True)
def clip_wrenches(wrenches, limits):
    """Limit two wrenches (12,) to the sensor's range (6,); return whether one exceeded it."""
    beyond = False
    for i in range(12):
        limit = limits[i % 6]
        if abs(wrenches[i]) > limit:
            wrenches[i] = math.copysign(limit, wrenches[i])
            beyond = True
    return beyond
