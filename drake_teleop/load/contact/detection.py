"""Noticing contact in the eliminated wrench, sample by sample, without calling fast motion contact.

Contact begins when the chosen one of the `statistics` reaches its threshold. It ends when for a
while the level has stayed below a share of the level's own threshold, and the sum over that while
is as low; then the sums start anew, because after a long contact they would take as long to come
down.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_teleop.common.arrays import Array, checked, positive
from drake_teleop.common.compiled import njit
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.contact.memory import (
    COUNT,
    FIRST_STATISTIC,
    FLAG,
    QUIET_FOR,
    RING,
    SIZE,
    SUM,
    TOTAL,
    WINDOW,
)
from drake_teleop.load.contact.noise_floor import NoiseFloor, checked_motion, statistic_index
from drake_teleop.load.contact.statistics import LEAVE, SLACK, detection_update


@njit(cache=True)
def _last_sum(memory, hold, widths):
    """The likelihood ratio of the longest window within `hold` samples, without a maximum."""
    m = 0
    while 2 << m <= min(hold, WINDOW // 2):
        m += 1
    # The sample before that window; what no sample has filled is zero.
    before = RING + 6 * ((int(memory[COUNT]) + WINDOW - 1 - (1 << m)) % WINDOW)
    total = 0.0
    for i in range(6):
        difference = memory[TOTAL + i] - memory[before + i]
        total += difference * difference
    return math.sqrt(total / (1 << m)) / widths[m]


@njit(cache=True)
def hysteresis_update(memory, statistic, enter, leave, hold, widths):
    """Whether there is contact, after `detection_update`; compiled, checks nothing.

    Args:
        memory: the same, updated.
        statistic: index into `STATISTICS`.
        enter: threshold of that statistic.
        leave: level below which contact may end, and sum of the longest window within `hold`.
        hold: samples below it, after which it has ended.
        widths: of the sums.
    """
    if memory[FLAG] == 0.0:
        if memory[FIRST_STATISTIC + statistic] >= enter:
            memory[FLAG], memory[QUIET_FOR] = 1.0, 0.0
    else:
        memory[QUIET_FOR] = memory[QUIET_FOR] + 1.0 if memory[FIRST_STATISTIC] < leave else 0.0
        if memory[QUIET_FOR] > hold and _last_sum(memory, hold, widths) < leave:
            # The sums start anew, the noise goes on.
            memory[FLAG] = 0.0
            memory[SUM:] = 0.0
            memory[COUNT] = 1.0
    return memory[FLAG] != 0.0


@njit(cache=True)
def flag_update(
    memory,
    contact,
    s,
    omega,
    alpha,
    acceleration,
    parameters,
    slack,
    following,
    statistic,
    enter,
    leave,
    hold,
):
    """One sample, in place; whether there is contact. `ContactDetector.settings` are the last."""
    detection_update(
        memory, contact, s, omega, alpha, acceleration, *parameters, slack, following, leave
    )
    return hysteresis_update(memory, statistic, enter, leave, hold, parameters[5])


@njit(cache=True)
def _flags(memory, rows, settings, out):
    contact, s, omega, alpha, acceleration = rows
    for k in range(contact.shape[0]):
        out[k] = flag_update(
            memory, contact[k], s[k], omega[k], alpha[k], acceleration[k], *settings
        )


class ContactDetector:
    """Says at each sample whether something is touched (module docstring).

    What it knows is a `memory` (an array), which can be kept outside, as in the state of a Drake
    system: `initial_memory`, `flag_update(memory, ..., *settings)`.

    Args:
        floor: of the free motion.
        threshold: of the chosen statistic; see `free_threshold`.
        statistic: one of `STATISTICS`.
        leave: level below which contact may end.
        hold: samples of quiet after which it has ended.
        slack: of the cumulative sum.
        following: share by which the mean of F_c, which is taken away, follows each sample while
            the level is below `leave`: period over time constant, or 0 for no mean.

    Raises:
        DrakeTeleopError: for another statistic or values that are not positive.
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
        enter, low = float(positive("threshold", threshold)), float(positive("leave", leave))
        if not 0.0 <= following < 1.0:
            raise DrakeTeleopError(f"{following} is not within [0, 1)", where="following")
        sums = float(positive("slack", slack)), float(following)
        decision = column, enter, low, int(hold)
        #: The last arguments of `flag_update`, the kernel of this class.
        self.settings = (floor.parameters, *sums, *decision)
        self._memory = self.initial_memory()

    @staticmethod
    def initial_memory() -> Array:
        """The memory before the first sample, (n,)."""
        return np.zeros(SIZE)

    def update(
        self,
        contact: ArrayLike,
        s: ArrayLike,
        omega: ArrayLike,
        alpha: ArrayLike,
        acceleration: ArrayLike,
    ) -> bool:
        """Takes one sample, (6,) and (3,) each as for `statistics`; whether there is contact.

        Raises:
            DrakeTeleopError: for other shapes or numbers that are not finite.
        """
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
        """`update` with each of N samples of a log, in a compiled loop; (N,) flags."""
        rows = checked_motion(
            contact=contact, s=s, omega=omega, alpha=alpha, acceleration=acceleration
        )
        out = np.empty(len(rows[0]), np.bool_)
        _flags(self._memory, tuple(rows), self.settings, out)
        return out
