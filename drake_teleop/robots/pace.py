"""Times for a stream that numbers its samples and does not say when they were taken."""

from __future__ import annotations

_LEAST_S, _MOST_S = 1.0, 10.0  # of our clock, over which the period is measured
_JUMP_S = 1.0  # numbers further off than that are of another start


class Pace:
    """A clock made of numbers: a sample that comes late keeps the time when it was taken.

    The period is the stated one at first, and after a second what our clock says. So a stream at
    another rate than the stated one does not seem later and later; its rate is seen to be wrong.

    Args:
        dt: the stated period [s].
    """

    def __init__(self, dt: float) -> None:
        self._dt = self._period = dt
        self._number, self._t = 0, 0.0
        self._first: tuple[int, float] | None = None

    def time_of(self, number: int, now: float) -> float:
        """When a sample was taken, on a clock of its own [s].

        Args:
            number: of the sample; less than before if it is out of order, or after a restart.
            now: our clock, which never goes back [s].
        """
        step = number - self._number
        if self._first is None or abs(step) * self._dt > _JUMP_S:
            self._first = number, now
        elif now - self._first[1] >= _LEAST_S and number > self._first[0]:
            self._period = (now - self._first[1]) / (number - self._first[0])
            if now - self._first[1] > _MOST_S:
                self._first = number, now
        t = self._t + step * self._period
        if step > 0 or self._first == (number, now):
            self._number, self._t = number, t
        return t
