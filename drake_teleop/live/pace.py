"""Real-time schedule of a live session's simulation slices, and their lateness."""

from __future__ import annotations

import gc
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager

#: Lateness above which lost time is not caught up [s].
_MAX_CAUGHT_UP_LATENESS_S = 0.1
_PACE_STATISTICS_SLICES = 400  # slices


class Pace:
    """Schedule of the simulation slices of `slice_s` simulated seconds; times `now` in s.

    Attributes:
        slowdown: clock time per simulated time; 1: real time.
        lost_time_s: lost time that is not caught up [s].
    """

    def __init__(self, slice_s: float, now: float) -> None:
        self.slowdown, self.lost_time_s = 1.0, 0.0
        self._slice = slice_s
        self._lateness: deque[float] = deque(maxlen=_PACE_STATISTICS_SLICES)
        self._starts: deque[float] = deque(maxlen=_PACE_STATISTICS_SLICES)
        self.restart(now)

    def restart(self, now: float) -> None:
        self._due = now
        self._starts.clear()

    def time_to_next_slice(self, now: float) -> float:
        return self._due - now

    def begin_slice(self, now: float) -> None:
        late = now - self._due
        if late > _MAX_CAUGHT_UP_LATENESS_S:
            self.lost_time_s += late
            self._due = now
        self._lateness.append(late)
        self._starts.append(now)
        self._due += self._slice * self.slowdown

    @property
    def real_time_factor(self) -> float:
        """Simulated over clock time of the last slices, at most 400; 0 before the second one."""
        if len(self._starts) < 2 or self._starts[-1] <= self._starts[0]:
            return 0.0
        return (len(self._starts) - 1) * self._slice / (self._starts[-1] - self._starts[0])

    def lateness_p99_s(self) -> float:
        late = sorted(self._lateness) or [0.0]
        return late[(99 * len(late) - 1) // 100]


@contextmanager
def without_garbage_collection() -> Iterator[None]:
    """Disable Python's garbage collector, which would delay slices."""
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
        gc.unfreeze()
