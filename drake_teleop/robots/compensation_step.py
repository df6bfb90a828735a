"""Compiled operations of `compensator`, bit-equal to those of `eliminate --causal`."""

from __future__ import annotations

import math

from drake_teleop.common.compiled import njit
from drake_teleop.load.compensation import add_weight_into, scaled_wrench_into

NOT_FINITE, TOO_LARGE, AT_RANGE = 1, 2, 4


@njit(cache=True)
def value_problem(values, largest, limits):
    """Return 0 for valid values, else `NOT_FINITE`, `TOO_LARGE` or `AT_RANGE`.

    Args:
        values: (15,) reading.
        largest: (15,) maximum valid magnitudes.
        limits: (6,) range of the sensor.
    """
    for i in range(15):
        if not math.isfinite(values[i]):
            return NOT_FINITE
    for i in range(15):
        if abs(values[i]) > largest[i]:
            return TOO_LARGE
    for i in range(6):
        if abs(values[i]) >= limits[i]:
            return AT_RANGE
    return 0


@njit(cache=True)
def low_pass_into(x, low_pass, memory):
    """Filter a sample in place, by a second-order low-pass as in `scipy.signal.lfilter`.

    Args:
        x: (n,) sample.
        low_pass: (7,) coefficients b, a_1, a_2 and the steady-state memory at input 1.
        memory: (2, n) filter memory; NaN starts in the steady state.
    """
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
def eliminate_into(values, gravity, offsets, phi, nothing, scales, low_pass, memory, rest, at, out):
    """Write the contact wrench and scaled wrench of a valid reading to out (12,).

    Args:
        values: (15,) reading.
        gravity: (3,) gravity in S, used only for different scales of weight and inertia.
        offsets: (6,) sensor offsets.
        phi, nothing: (10,) the load, and zeros.
        scales: (4,) see `scaled_wrench_into`; then scale of the weight minus that of the inertia.
        low_pass, memory: see `low_pass_into`; low_pass may be empty.
        rest: (rows, 21); row `at` receives the reading and its unfiltered contact wrench.
    """
    wrench, s, omega, alpha = values[:6], values[6:9], values[9:12], values[12:]
    contact, scaled = out[:6], out[6:]
    scaled_wrench_into(wrench, offsets, s, omega, alpha, phi, nothing, 0.0, 0.0, 1.0, contact)
    a, b, c = scales[0], scales[1], scales[2]
    scaled_wrench_into(wrench, offsets, s, omega, alpha, nothing, phi, a, b, c, scaled)
    if scales[3] != 0.0:
        add_weight_into(gravity, nothing, phi, 0.0, scales[3], scaled)
    rest[at, :15] = values
    rest[at, 15:] = contact
    if len(low_pass) > 0:
        low_pass_into(out, low_pass, memory)


@njit(cache=True)
def clip(wrenches, limits):
    """Limit two wrenches (12,) to the sensor's range (6,); return whether a value exceeded it."""
    beyond = False
    for i in range(12):
        limit = limits[i % 6]
        if abs(wrenches[i]) > limit:
            wrenches[i] = math.copysign(limit, wrenches[i])
            beyond = True
    return beyond
