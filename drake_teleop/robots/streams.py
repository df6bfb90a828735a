"""What flows through `compensate`: readings in, wrenches out, and what was wrong with either.

A source is an object with `dt` and `read`, a sink one with `write` and `close`: nothing else is
asked of them. Readings are of S, the sensor's frame, in SI, with the sign of Eq. (1): what the
sensor exerts on the load.
"""

from __future__ import annotations

from enum import IntFlag
from typing import NamedTuple, Protocol

import numpy as np

from drake_teleop.common.arrays import Array

VALUES = 15
"""Of a reading: wrench (6), specific force, angular velocity and acceleration (3 each)."""


class Flag(IntFlag):
    """Why a wrench is zero, or what else to know of it; the bits of the packets."""

    SATURATED = 1  #: the sensor says so, or a channel is at its range
    DAMAGED = 2  #: no reading could be made of what came
    NOT_FINITE = 4  #: NaN or infinity
    OUT_OF_RANGE = 8  #: beyond what any sensor or motion has
    REORDERED = 16  #: older than one that was here before, or the same
    STALE = 32  #: nothing has come for a while, or what came was late
    CLOCK_JUMP = 64  #: the source's clock was set
    RESTART = 128  #: the source began anew
    GAP = 256  #: a straight line stands in for what a log does not have
    WRONG_RATE = 512  #: the rate is not the stated one; the wrench is no zero for that
    CLIPPED = 1024  #: limited to the sensor's range; likewise
    IN_CONTACT = 2048  #: the known load does not explain the wrench; likewise
    OTHER_LOAD = 4096  #: another load hangs there; likewise


ONLY_SAID = Flag.WRONG_RATE | Flag.CLIPPED | Flag.IN_CONTACT | Flag.OTHER_LOAD
"""Flags whose wrench is not zero."""


class Reading(NamedTuple):
    """A sample of a source: its number and time [s], both of the source; (15,); flags."""

    number: int
    t: float
    values: Array
    flags: int = 0


class Part(NamedTuple):
    """What one stream of several told, on its own clock; readings are made of them.

    Args:
        stream: one of `WRENCH`, `POSE`, `IMU`, `JOINTS`, `ACCELERATION`, whose values are the
            wrench of S (6), the pose X_WF of a frame on the wrist (7), specific force and angular
            velocity of S (6), positions of the arm's joints (n), or what an accelerometer somewhere
            on the wrist says (3), which nobody reads yet.
        number: of the stream, one more each time.
        t: of the stream [s].
    """

    stream: str
    number: int
    t: float
    values: Array
    flags: int = 0


WRENCH, POSE, IMU, JOINTS = "wrench", "pose", "imu", "joints"
ACCELERATION = "acceleration"


class Compensated(NamedTuple):
    """A sample for a sink: number and time of the reading; contact and scaled (6,); flags."""

    number: int
    t: float
    contact: Array
    scaled: Array
    flags: int


DAMAGED = Reading(-1, np.nan, np.full(VALUES, np.nan), int(Flag.DAMAGED))
"""The reading of what is none."""


class Source(Protocol):
    """Where readings come from.

    Attributes:
        dt: between readings [s].
        live: they come when they come; else as fast as they are taken, on the clock that they tell.
    """

    dt: float
    live: bool

    def read(self, timeout_s: float) -> list[Reading] | None:
        """What has come, after waiting for the first; none in that time: []; at the end: None."""

    def close(self) -> None:
        """Ends it."""


class PartSource(Protocol):
    """Likewise of parts; `assembly` makes readings of them.

    Attributes:
        dt: between wrenches [s].
        streams: that it tells.
    """

    dt: float
    streams: tuple[str, ...]

    def read(self, timeout_s: float) -> list[Part] | None:
        """See `Source`."""

    def close(self) -> None:
        """See `Source`."""


class Sink(Protocol):
    """Where wrenches go."""

    def write(self, out: Compensated) -> None:
        """Takes one."""

    def close(self) -> None:
        """Ends it."""
