"""Wrench and motion as parts: of one source, or the wrench of one and the motion of another."""

from __future__ import annotations

import time

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.robots.streams import IMU, POSE, WRENCH, Part, PartSource


class Parts:
    """One or two sources as one.

    Args:
        wrench: tells the wrench, and without `motion` the motion, too.
        motion: tells the motion.

    Attributes:
        dt: between wrenches [s].
        told: the stream that tells the motion: poses, if there are some, else an IMU.
        two_clocks: the times of wrench and motion are of two clocks.

    Raises:
        DrakeTeleopError: if nobody tells a motion.
    """

    live = True

    def __init__(self, wrench: PartSource, motion: PartSource | None = None) -> None:
        self._wrench, self._motion = wrench, motion
        self.dt, self.two_clocks = wrench.dt, motion is not None
        streams = (wrench if motion is None else motion).streams
        self.told = next((stream for stream in (POSE, IMU) if stream in streams), "")
        if not self.told:
            raise DrakeTeleopError(
                "tells no motion", where="the source", remedy="give --motion rtde://HOST, say"
            )

    def read(self, timeout_s: float) -> list[tuple[Part, float]] | None:
        """As of `Source`, each with the time when it came."""
        found: list[tuple[Part, float]] = []
        if self._motion is not None:
            parts, now = self._motion.read(0.0) or (), time.monotonic()
            found += [(part, now) for part in parts if part.stream != WRENCH]
        told = self._wrench.read(timeout_s)
        if told is None:
            return None
        now = time.monotonic()
        alone = self._motion is None
        return found + [(part, now) for part in told if alone or part.stream == WRENCH]

    def close(self) -> None:
        """See `Source`."""
        self._wrench.close()
        if self._motion is not None:
            self._motion.close()
