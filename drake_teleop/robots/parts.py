"""Wrench and motion parts of one or two sources."""

from __future__ import annotations

import time

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.robots.streams import IMU, POSE, WRENCH, Part, PartSource


class Parts:
    """One or two sources as one; raise DrakeTeleopError if there is no motion.

    Attributes:
        told: stream of the motion: poses if available, else an IMU.
        two_clocks: wrench and motion have different clocks.
    """

    live = True

    def __init__(self, wrench: PartSource, motion: PartSource | None = None) -> None:
        self._wrench, self._motion = wrench, motion
        self.dt, self.two_clocks = wrench.dt, motion is not None
        streams = (wrench if motion is None else motion).streams
        self.motion_stream = next((stream for stream in (POSE, IMU) if stream in streams), "")
        if not self.motion_stream:
            raise DrakeTeleopError(
                "delivers no motion",
                where="the source",
                remedy="give --motion, such as rtde://HOST",
            )

    def read(self, timeout_s: float) -> list[tuple[Part, float]] | None:
        """Return parts with their times of arrival."""
        found: list[tuple[Part, float]] = []
        if self._motion is not None:
            parts, now = self._motion.read(0.0) or (), time.monotonic()
            found += [(part, now) for part in parts if part.stream != WRENCH]
        motion_stream = self._wrench.read(timeout_s)
        if motion_stream is None:
            return None
        now = time.monotonic()
        alone = self._motion is None
        return found + [(part, now) for part in motion_stream if alone or part.stream == WRENCH]

    def close(self) -> None:
        """See `Source`."""
        self._wrench.close()
        if self._motion is not None:
            self._motion.close()
