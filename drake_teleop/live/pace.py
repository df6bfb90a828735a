"""When slices are due: simulated time keeps up with a clock, or falls behind visibly."""

from __future__ import annotations

import gc
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager

#: Beyond this, lost time is given up instead of caught up with [s].
_GIVE_UP = 0.1
_REMEMBERED = 400  # slices


class Pace:
    """Says when the next slice is due. Times are those of any clock, [s].

    Attributes:
        slow: seconds of the clock for one of the simulation.
        given_up: lost time that was not caught up with [s].

    Args:
        slice_s: length of a slice [s].
        now: the clock.
    """

    def __init__(self, slice_s: float, now: float) -> None:
        self.slow, self.given_up = 1.0, 0.0
        self._slice = slice_s
        self._late: deque[float] = deque(maxlen=_REMEMBERED)
        self._begun: deque[float] = deque(maxlen=_REMEMBERED)
        self.start(now)

    def start(self, now: float) -> None:
        """The next slice is due now: at the beginning, or after a pause."""
        self._due = now
        self._begun.clear()

    def wait(self, now: float) -> float:
        """How long there is nothing to do [s]; 0 or less: a slice is due."""
        return self._due - now

    def begin(self, now: float) -> None:
        """A slice that is due is simulated now."""
        late = now - self._due
        if late > _GIVE_UP:
            self.given_up += late
            self._due = now
        self._late.append(late)
        self._begun.append(now)
        self._due += self._slice * self.slow

    @property
    def factor(self) -> float:
        """Simulated over elapsed time, of the last two seconds or so; 0 before there are any."""
        if len(self._begun) < 2 or self._begun[-1] <= self._begun[0]:
            return 0.0
        return (len(self._begun) - 1) * self._slice / (self._begun[-1] - self._begun[0])

    def lateness(self) -> float:
        """How late slices were begun in the same time [s]: 99 % of them were so late or less."""
        return sorted(self._late)[(99 * len(self._late) - 1) // 100] if self._late else 0.0


@contextmanager
def without_collections() -> Iterator[None]:
    """Python's garbage is not looked for: a full search takes as long as ten slices."""
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
        gc.unfreeze()
