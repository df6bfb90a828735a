"""What tells contact in the eliminated wrench, sample by sample, each compared with a threshold::

    level    |z|, the plain threshold; its square is chi-squared of six degrees of freedom
    cusum    |S|, S = (S + e) max(0, 1 - slack / |S + e|): the cumulative sum for a shift of the
             mean in an unknown direction (Crosier, Technometrics 30, 1988). Shifts below the slack
             [standard deviations] are never noticed, and never add up
    glr      max over n of |e_k + ... + e_{k-n+1}| / (w_n sqrt(n)): the generalised likelihood ratio
             for a shift of unknown size, direction and onset (Lorden 1971; Willsky and Jones 1976),
             the root of twice its logarithm. n are the powers of two up to `WINDOW`, so that a
             sample costs little however long the window; one of them gives at least 2^(-1/4) of
             what the best n would

z is the wrench over its noise floor, decorrelated, and e are its innovations (`noise_floor`).

The w_n are 1 if e is white. What is left of the load's wrench changes as slowly as the motion, more
slowly than rho tells, and adds up over long sums: w_n is by how much such sums exceeded those of
white noise in free motion, or rare ones a rare e, whichever is more. Without it the errors of the
load would set the threshold for all n; with it all n reach about the same in free motion, n = 1 is
the plain threshold, and the others notice weaker contacts at the same rate of false alarms
(benchmarks/contact_detection.py).

**Drift.** Long sums notice half a standard deviation, and in minutes a force sensor drifts as far.
So r may be taken about a mean of its own past, which follows with a time constant of some seconds
while the level is low: a push that is so weak and lasts so long cannot be told from drift.
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
"""Of the cumulative sum [standard deviations]. Half of the shift to be noticed is best in white
noise; this much lets lasting errors of the load pass (benchmarks/contact_detection.py)."""
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
    """One sample, in place: memory[5:8] are then the three `STATISTICS`; compiled, checks nothing.

    Args:
        memory: (SIZE,), zeros before the first sample.
        contact: (6,) F_c of Eq. (13).
        s, omega, alpha, acceleration: (3,) as for `NoiseFloor.sigma`.
        variances, P, growth, root, rho, widths, fade: `NoiseFloor.parameters`.
        slack: of the cumulative sum.
        following: share by which the mean of F_c follows each sample while the level is below
            `quiet`; 0 for no mean.
        quiet: see there.
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
        # Nothing is known before the first sample: it stands by itself.
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
    # Before the first sample of all the sum is zero, as is what the ring holds then.
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
    """The three `STATISTICS` of each sample of a log, without hysteresis.

    Args:
        floor: of the free motion.
        contact: (N, 6) F_c of Eq. (13) [N, N m].
        s, omega, alpha, acceleration: (N, 3) as for `NoiseFloor.sigma`.
        slack: of the cumulative sum [standard deviations].
        following: share by which the mean of F_c follows each sample, see `ContactDetector`.

    Returns:
        (N, 3).

    Raises:
        DrakeTeleopError: for other shapes or numbers that are not finite.
    """
    rows = checked_motion(contact=contact, s=s, omega=omega, alpha=alpha, acceleration=acceleration)
    out = np.empty((len(rows[0]), 3))
    sums = float(positive("slack", slack)), float(following), LEAVE
    _statistics(tuple(rows), floor.parameters, *sums, out)
    return out
