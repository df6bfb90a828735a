"""Contact detection in a wrench from which the load's wrench is removed, sample by sample.

A statistic of the normalised wrench z and its innovations e (see `noise_floor`) reaches a threshold
when contact begins::

    level    |z|; its square is chi-squared with six degrees of freedom
    cusum    |S|, S = (S + e) max(0, 1 - slack / |S + e|): cumulative sum (Crosier, Technometrics
             30, 1988)
    glr      max over n of |e_k + ... + e_{k-n+1}| / (w_n sqrt(n)), n = 1, 2, 4 ... `WINDOW`:
             generalised likelihood ratio (Lorden 1971; Willsky and Jones 1976)

Contact ends after `hold` samples with a level below `leave`; then the sums restart.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_teleop.common.compiled import njit
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array, checked, positive
from drake_teleop.load.contact.noise_floor import (
    HELD_A,
    HELD_ALPHA,
    LENGTHS,
    WINDOW,
    NoiseFloor,
    checked_motion,
    hold_peaks,
    parameter_variance,
    statistic_index,
)

# Indices into the memory: sample count; held |a|^2 and |alpha|^2 (in `noise_floor`); flag; samples
# below `leave`; statistics (3); previous z (6); mean of F_c (6); cumulative sum S (6); sum of all
# e (6); ring of its last WINDOW values.
COUNT, FLAG, QUIET_FOR, FIRST_STATISTIC = 0, 3, 4, 5
Z, MEAN, SUM, TOTAL, RING = 8, 14, 20, 26, 32
SIZE = RING + 6 * WINDOW
"""Length of the memory of `detection_update`."""
SLACK = 1.0
"""Default slack of the cumulative sum [standard deviations]. In white noise, half of the smallest
shift to be detected is best; this value tolerates lasting errors of the load."""
RARE = 6.2
"""Level that normal noise reaches once in a million samples."""
LEAVE = 0.7 * RARE
"""Level below which contact may end."""


@njit(cache=True)
def detection_update(
    memory, contact, s, omega, alpha, acceleration, parameters, slack, following, quiet
):
    """Update the memory by one sample and write the `STATISTICS` to memory[5:8].

    Args:
        memory: (SIZE,), zeros before the first sample.
        contact: (6,) contact wrench F_c, Eq. (13) [N, N m].
        s, omega, alpha, acceleration: (3,) motion, as for `NoiseFloor.sigma`.
        parameters: `NoiseFloor.parameters`.
        slack, following, quiet: `slack`, `following`, `leave` of `ContactDetector`.
    """
    variances, P, growth, root, rho, widths, fade = parameters
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
        sample = contact[k], s[k], omega[k], alpha[k], acceleration[k]
        detection_update(memory, *sample, parameters, slack, following, quiet)
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
    """Return level, cusum and glr (N, 3) of each sample of a log, in standard deviations.

    Args:
        contact: (N, 6) contact wrench F_c, Eq. (13) [N, N m].
        s, omega, alpha, acceleration: (N, 3) motion, as for `NoiseFloor.sigma`.
        slack, following: as for `ContactDetector`.
    """
    rows = checked_motion(contact=contact, s=s, omega=omega, alpha=alpha, acceleration=acceleration)
    out = np.empty((len(rows[0]), 3))
    sums = float(positive("slack", slack)), float(following), LEAVE
    _statistics(tuple(rows), floor.parameters, *sums, out)
    return out


@njit(cache=True)
def _last_sum(memory, hold, widths):
    m = 0
    while 2 << m <= min(hold, WINDOW // 2):
        m += 1
    # Sum before that window; zero if there was no sample yet.
    before = RING + 6 * ((int(memory[COUNT]) + WINDOW - 1 - (1 << m)) % WINDOW)
    total = 0.0
    for i in range(6):
        difference = memory[TOTAL + i] - memory[before + i]
        total += difference * difference
    return math.sqrt(total / (1 << m)) / widths[m]


@njit(cache=True)
def hysteresis_update(memory, statistic, enter, leave, hold, widths):
    """Return whether there is contact, after `detection_update` of the same memory.

    Args:
        statistic: index into `STATISTICS`.
        enter: threshold of this statistic at which contact begins.
        leave, hold: contact ends after `hold` samples with a level below `leave`.
        widths: `NoiseFloor.widths`.
    """
    if memory[FLAG] == 0.0:
        if memory[FIRST_STATISTIC + statistic] >= enter:
            memory[FLAG], memory[QUIET_FOR] = 1.0, 0.0
    else:
        memory[QUIET_FOR] = memory[QUIET_FOR] + 1.0 if memory[FIRST_STATISTIC] < leave else 0.0
        if memory[QUIET_FOR] > hold and _last_sum(memory, hold, widths) < leave:
            # Reset the sums, because they would decrease too slowly after a long contact. Keep z.
            memory[FLAG] = 0.0
            memory[SUM:] = 0.0
            memory[COUNT] = 1.0
    return memory[FLAG] != 0.0


@njit(cache=True)
def flag_update(memory, contact, s, omega, alpha, acceleration, parameters, decision):
    """Update the memory by one sample and return whether there is contact.

    The last two arguments are `ContactDetector.settings`.
    """
    slack, following, statistic, enter, leave, hold = decision
    detection_update(
        memory, contact, s, omega, alpha, acceleration, parameters, slack, following, leave
    )
    return hysteresis_update(memory, statistic, enter, leave, hold, parameters[5])


@njit(cache=True)
def _flags(memory, rows, settings, out):
    contact, s, omega, alpha, acceleration = rows
    for k in range(contact.shape[0]):
        sample = contact[k], s[k], omega[k], alpha[k], acceleration[k]
        out[k] = flag_update(memory, *sample, *settings)


class ContactDetector:
    """Contact detector with hysteresis for a stream of samples.

    Args:
        threshold: of the statistic at which contact begins, such as `NoiseFloor.threshold`.
        statistic: "level", "cusum" or "glr".
        leave, hold: contact ends after `hold` samples with a level below `leave`.
        slack: slack of the cumulative sum [standard deviations].
        following: sample period over time constant of a mean that is subtracted from the contact
            wrench, updated while the level is below `leave`; 0: no mean.

    Raises:
        DrakeTeleopError: for an unknown statistic or values outside their range.
    """

    def __init__(
        self,
        floor: NoiseFloor,
        threshold: float,
        *,
        statistic: str = "cusum",
        leave: float = LEAVE,
        hold: int = 20,
        slack: float = SLACK,
        following: float = 0.0,
    ) -> None:
        column = statistic_index(statistic)
        enter, exit_level = float(positive("threshold", threshold)), float(positive("leave", leave))
        if not 0.0 <= following < 1.0:
            raise DrakeTeleopError(f"{following} is not within [0, 1)", where="following")
        sums = float(positive("slack", slack)), float(following)
        decision = column, enter, exit_level, int(hold)
        #: Last arguments of `flag_update`.
        self.settings = (floor.parameters, (*sums, *decision))
        self._memory = self.initial_memory()

    @staticmethod
    def initial_memory() -> Array:
        """Return the memory (SIZE,) before the first sample."""
        return np.zeros(SIZE)

    def update(
        self,
        contact: ArrayLike,
        s: ArrayLike,
        omega: ArrayLike,
        alpha: ArrayLike,
        acceleration: ArrayLike,
    ) -> bool:
        """Update by one sample, as for `statistics`; return whether there is contact."""
        parts = {"s": s, "omega": omega, "alpha": alpha, "acceleration": acceleration}
        motion = [checked(name, value, 3) for name, value in parts.items()]
        wrench = checked("contact", contact, 6)
        return bool(flag_update(self._memory, wrench, *motion, *self.settings))

    def detect(
        self,
        contact: ArrayLike,
        s: ArrayLike,
        omega: ArrayLike,
        alpha: ArrayLike,
        acceleration: ArrayLike,
    ) -> NDArray[np.bool_]:
        """Update by N samples of a log, as for `statistics`; return (N,) True for contact."""
        rows = checked_motion(
            contact=contact, s=s, omega=omega, alpha=alpha, acceleration=acceleration
        )
        out = np.empty(len(rows[0]), np.bool_)
        _flags(self._memory, tuple(rows), self.settings, out)
        return out


def wrench_axis(wrench: ArrayLike) -> tuple[Array, Array, Array]:
    """Return the central axis of wrenches (..., 6) in S (Poinsot); NaN where the force is 0.

    Returns:
        direction of the force (..., 3), point nearest to So (..., 3) [m], and pitch (...) [m].
    """
    w = checked("wrench", wrench, 6, leading=True)
    f, tau = w[..., :3], w[..., 3:]
    square = np.sum(f * f, axis=-1)
    square = np.where(square > 0.0, square, np.nan)
    direction = f / np.sqrt(square)[..., None]
    return direction, np.cross(f, tau) / square[..., None], np.sum(f * tau, axis=-1) / square
