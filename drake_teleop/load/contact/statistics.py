"""Statistics for contact in the eliminated wrench (`noise_floor` defines z and e).

    level    |z|; its square is chi-squared with six degrees of freedom
    cusum    |S|, S = (S + e) max(0, 1 - slack / |S + e|): cumulative sum (Crosier, Technometrics
             30, 1988)
    glr      max over n of |e_k + ... + e_{k-n+1}| / (w_n sqrt(n)), n = 1, 2, 4 ... `WINDOW`:
             generalised likelihood ratio (Lorden 1971; Willsky and Jones 1976)

w_n is the width of such sums in free motion; it accounts for slow errors of the load.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from drake_teleop.common.arrays import Array, positive
from drake_teleop.common.compiled import njit
from drake_teleop.load.contact.memory import (
    COUNT,
    FIRST_STATISTIC,
    HELD_A,
    HELD_ALPHA,
    LENGTHS,
    MEAN,
    RING,
    SIZE,
    SUM,
    TOTAL,
    WINDOW,
    Z,
)
from drake_teleop.load.contact.noise_floor import (
    NoiseFloor,
    checked_motion,
    hold_peaks,
    parameter_variance,
)

SLACK = 1.0
"""Slack of the cumulative sum [standard deviations]. In white noise, half of the smallest shift to
detect is best; this value tolerates lasting errors of the load."""
RARE = 6.2
"""Level that normal noise reaches once in a million samples."""
LEAVE = 0.7 * RARE
"""Level below which contact may end."""


@njit(cache=True)
def detection_update(
    memory,
    contact,
    s,
    omega,
    alpha,
    acceleration,
    variances,
    P,
    growth,
    root,
    rho,
    widths,
    fade,
    slack,
    following,
    quiet,
):
    """Update by one sample and write the `STATISTICS` to memory[5:8]; compiled, without checks.

    Args:
        memory: (SIZE,), zeros before the first sample.
        contact: (6,) F_c of Eq. (13).
        s, omega, alpha, acceleration: (3,) as for `NoiseFloor.sigma`.
        variances, P, growth, root, rho, widths, fade: `NoiseFloor.parameters`.
        slack, following, quiet: as for `ContactDetector`, quiet for leave.
    """
    V, scaled = np.empty((6, 10)), np.empty(6)
    hold_peaks(memory, acceleration, alpha, fade)
    parameter_variance(s, omega, alpha, P, V, scaled)
    for c in range(6):
        moving = growth[c, 0] * memory[HELD_A] + growth[c, 1] * memory[HELD_ALPHA]
        variance = variances[c] + max(scaled[c], 0.0) + moving
        scaled[c] = (contact[c] - memory[MEAN + c]) / math.sqrt(variance)
    count = int(memory[COUNT])
    level, length = 0.0, 0.0
    for i in range(6):
        z = 0.0
        for j in range(i + 1):
            z += root[i, j] * scaled[j]
        # The first sample has no predecessor.
        e = z if count == 0 else (z - rho[i] * memory[Z + i]) / math.sqrt(1.0 - rho[i] * rho[i])
        memory[Z + i] = z
        level += z * z
        memory[SUM + i] += e
        length += memory[SUM + i] * memory[SUM + i]
        memory[TOTAL + i] += e
    level, length = math.sqrt(level), math.sqrt(length)
    if level < quiet:
        for c in range(6):
            memory[MEAN + c] += following * (contact[c] - memory[MEAN + c])
    shrink = max(0.0, 1.0 - slack / length) if length > 0.0 else 0.0
    for i in range(6):
        memory[SUM + i] *= shrink
    # The sum before the first sample is zero, as is the initial ring.
    here = RING + 6 * (count % WINDOW)
    best, n = 0.0, 1
    for m in range(LENGTHS):
        if n > count + 1:
            break
        before = RING + 6 * ((count + WINDOW - n) % WINDOW)
        total = 0.0
        for i in range(6):
            difference = memory[TOTAL + i] - memory[before + i]
            total += difference * difference
        best = max(best, total / (n * widths[m] * widths[m]))
        n *= 2
    for i in range(6):
        memory[here + i] = memory[TOTAL + i]
    memory[COUNT] += 1.0
    memory[FIRST_STATISTIC] = level
    memory[FIRST_STATISTIC + 1] = length * shrink
    memory[FIRST_STATISTIC + 2] = math.sqrt(best)


@njit(cache=True)
def _statistics(rows, parameters, slack, following, quiet, out):
    contact, s, omega, alpha, acceleration = rows
    memory = np.zeros(SIZE)
    for k in range(contact.shape[0]):
        detection_update(
            memory, contact[k], s[k], omega[k], alpha[k], acceleration[k], *parameters, slack,
            following, quiet,
        )  # fmt: skip
        out[k] = memory[FIRST_STATISTIC : FIRST_STATISTIC + 3]


def statistics(
    floor: NoiseFloor,
    contact: ArrayLike,
    s: ArrayLike,
    omega: ArrayLike,
    alpha: ArrayLike,
    acceleration: ArrayLike,
    *,
    slack: float = SLACK,
    following: float = 0.0,
) -> Array:
    """Return the `STATISTICS` (N, 3) of each sample of a log, without hysteresis.

    Args:
        contact: (N, 6) F_c of Eq. (13) [N, N m].
        s, omega, alpha, acceleration: (N, 3) as for `NoiseFloor.sigma`.
        floor, slack, following: as for `ContactDetector`.
    """
    rows = checked_motion(contact=contact, s=s, omega=omega, alpha=alpha, acceleration=acceleration)
    out = np.empty((len(rows[0]), 3))
    sums = float(positive("slack", slack)), float(following), LEAVE
    _statistics(tuple(rows), floor.parameters, *sums, out)
    return out
