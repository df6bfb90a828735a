"""Contact detection in the eliminated wrench, sample by sample.

Contact begins when the selected statistic reaches its threshold. It ends when the level and the sum
over the last samples have stayed below `leave` for `hold` samples; then the sums restart.
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
    """Return the likelihood ratio of the longest window within `hold` samples."""
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
    """Return whether there is contact, after `detection_update`; compiled, without checks.

    Args:
        memory: of `detection_update`, updated.
        statistic: index into `STATISTICS`.
        enter: its threshold.
        leave, hold: level, and samples below it, before contact ends.
        widths: of `NoiseFloor`.
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
    """Update by one sample with `ContactDetector.settings`; return whether there is contact."""
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
    """Contact detector for a stream of samples.

    `flag_update(memory, ..., *settings)` works on external memory, such as a Drake state.

    Args:
        floor: of the free motion.
        threshold: of the statistic, such as `NoiseFloor.threshold`.
        statistic: one of `STATISTICS`.
        leave, hold: level, and samples below it, before contact ends.
        slack: of the cumulative sum [standard deviations].
        following: period over time constant of the subtracted mean of F_c, updated while the level
            is below `leave`; 0 for no mean.

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
        self.settings = (floor.parameters, *sums, *decision)
        self._memory = self.initial_memory()

    @staticmethod
    def initial_memory() -> Array:
        """Return the memory (n,) before the first sample."""
        return np.zeros(SIZE)

    def update(
        self,
        contact: ArrayLike,
        s: ArrayLike,
        omega: ArrayLike,
        alpha: ArrayLike,
        acceleration: ArrayLike,
    ) -> bool:
        """Update by one sample as for `statistics`; return whether there is contact."""
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
        """Return the flags (N,) of N samples of a log, updating as `update` does."""
        rows = checked_motion(
            contact=contact, s=s, omega=omega, alpha=alpha, acceleration=acceleration
        )
        out = np.empty(len(rows[0]), np.bool_)
        _flags(self._memory, tuple(rows), self.settings, out)
        return out
