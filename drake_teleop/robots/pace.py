"""Sample times of a stream without time stamps."""

from __future__ import annotations

_MIN_SPAN_S, _MAX_SPAN_S = 1.0, 10.0  # span of our clock for measuring the period
_JUMP_S = 1.0  # a larger step of the number is a restart


class SampleClock:
    """Clock from sample numbers.

    The period is first the stated one, after a second the measured one, so that a wrong stated rate
    causes no growing delay.
    """

    def __init__(self, dt: float) -> None:
        self._dt = self._period = dt
        self._number, self._t = 0, 0.0
        self._first: tuple[int, float] | None = None

    def time_of(self, number: int, now: float) -> float:
        """Return the time of a sample, on its own clock [s].

        Args:
            number: smaller than before if out of order or after a restart.
            now: our monotonic clock [s].
        """
        step = number - self._number
        if self._first is None or abs(step) * self._dt > _JUMP_S:
            self._first = number, now
        elif now - self._first[1] >= _MIN_SPAN_S and number > self._first[0]:
            self._period = (now - self._first[1]) / (number - self._first[0])
            if now - self._first[1] > _MAX_SPAN_S:
                self._first = number, now
        t = self._t + step * self._period
        if step > 0 or self._first == (number, now):
            self._number, self._t = number, t
        return t
