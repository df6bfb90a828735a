"""What `compensator` does with the numbers of a sample, in compiled code.

The order of operations is that of `eliminate --causal`, to the last bit: elimination, then the
low-pass as `scipy.signal.lfilter` has it.
"""

from __future__ import annotations

import math

from drake_teleop.common.compiled import njit
from drake_teleop.load.compensation import scaled_wrench_into

NOT_FINITE, TOO_LARGE, AT_RANGE = 1, 2, 4


@njit(cache=True)
def doubts(values, largest, limits):
    """What speaks against the numbers of a reading: `NOT_FINITE`, or `TOO_LARGE`, or `AT_RANGE`.

    Args:
        values: (15,) of the reading.
        largest: (15,) above which it is none.
        limits: (6,) the sensor's range.
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
def low_passed_into(x, low_pass, memory):
    """One sample through a low-pass of second order, in place.

    Args:
        x: (n,) the sample.
        low_pass: (7,) b, a_1, a_2 and the memory that is settled at 1.
        memory: (2, n), NaN if it is to settle.
    """
    anew = math.isnan(memory[0, 0])
    for i in range(len(x)):
        u = x[i]
        if anew:
            memory[0, i], memory[1, i] = low_pass[5] * u, low_pass[6] * u
        y = memory[0, i] + low_pass[0] * u
        memory[0, i] = memory[1, i] + u * low_pass[1] - y * low_pass[3]
        memory[1, i] = u * low_pass[2] - y * low_pass[4]
        x[i] = y


@njit(cache=True)
def eliminated_into(values, offsets, phi, nothing, scales, low_pass, memory, rest, at, out):
    """Contact and scaled wrench of a good reading.

    Args:
        values: (15,) of the reading.
        offsets: (6,) of the sensor.
        phi, nothing: (10,) the load, and zeros.
        scales: (3,) of what is scaled, see `scaled_wrench_into`.
        low_pass, memory: see `low_passed_into`; the former is empty without one.
        rest: (rows, 21) whose row `at` becomes the reading and its contact, not filtered.
        out: (12,) contact and scaled.
    """
    wrench, s, omega, alpha = values[:6], values[6:9], values[9:12], values[12:]
    contact, scaled = out[:6], out[6:]
    scaled_wrench_into(wrench, offsets, s, omega, alpha, phi, nothing, 0.0, 0.0, 1.0, contact)
    a, b, c = scales[0], scales[1], scales[2]
    scaled_wrench_into(wrench, offsets, s, omega, alpha, nothing, phi, a, b, c, scaled)
    rest[at, :15] = values
    rest[at, 15:] = contact
    if len(low_pass) > 0:
        low_passed_into(out, low_pass, memory)


@njit(cache=True)
def clipped(wrenches, limits):
    """Limits (12,) wrenches to the sensor's range (6,), and says whether one was beyond."""
    beyond = False
    for i in range(12):
        limit = limits[i % 6]
        if abs(wrenches[i]) > limit:
            wrenches[i] = math.copysign(limit, wrenches[i])
            beyond = True
    return beyond
