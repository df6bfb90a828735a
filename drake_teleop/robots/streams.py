"""Types of the live streams: readings, parts, compensated wrenches, flags, sources and sinks.

Readings are in the sensor frame S, in SI units, with the sign of Eq. (1): wrench of sensor on load.
"""

from __future__ import annotations

from enum import IntFlag
from typing import NamedTuple, Protocol, TypeVar

import numpy as np

from drake_teleop.common.numeric import Array

_SampleT = TypeVar("_SampleT")
NUM_READING_VALUES = 15
"""Length of a reading: wrench (6), specific force, angular velocity and acceleration (3 each)."""


class ReadingFlag(IntFlag):
    """Flag of a wrench: reason why it is zero, or information; bits as in the packets."""

    SATURATED = 1  #: reported by the sensor, or a channel at its range
    DAMAGED = 2  #: invalid packet
    NOT_FINITE = 4  #: NaN or infinity
    OUT_OF_RANGE = 8  #: beyond any sensor or motion
    REORDERED = 16  #: not newer than an earlier reading
    STALE = 32  #: no reading for a while, or a late one
    CLOCK_JUMP = 64  #: the source's clock was set
    RESTART = 128  #: the source restarted
    GAP = 256  #: interpolated gap of a log
    WRONG_RATE = 512  #: not the stated rate; the wrench is not zero
    CLIPPED = 1024  #: limited to the sensor's range, not zero
    IN_CONTACT = 2048  #: not explained by the load; the wrench is not zero
    OTHER_LOAD = 4096  #: explained by another load; the wrench is not zero


NONZERO_WRENCH_FLAGS = (
    ReadingFlag.WRONG_RATE | ReadingFlag.CLIPPED | ReadingFlag.IN_CONTACT | ReadingFlag.OTHER_LOAD
)
"""Flags with a nonzero wrench."""


class Reading(NamedTuple):
    """Sample of wrench and motion: number, time [s] on the source's clock, values (15,), flags.

    Values: wrench of sensor on load (6) [N, N m], specific force, angular velocity and acceleration
    (3 each), in the sensor frame S. Gravity (3,) [m/s^2] in S is None without an orientation.
    """

    number: int
    t: float
    values: Array
    flags: int = 0
    gravity: Array | None = None


class Part(NamedTuple):
    """Sample of one of several streams, each with its own clock.

    The values are one of: the wrench in S (6); the pose X_WF of a frame on the wrist (7); specific
    force and angular velocity of S (6); joint positions (n); a tool acceleration (3).
    """

    stream: str
    number: int
    t: float
    values: Array
    flags: int = 0


WRENCH, POSE, IMU, JOINTS = "wrench", "pose", "imu", "joints"
ACCELERATION = "acceleration"


class CompensatedWrench(NamedTuple):
    """Sample for a sink: contact wrench (6,) and scaled wrench (6,) [N, N m]."""

    number: int
    t: float
    contact: Array
    scaled: Array
    flags: int


DAMAGED_READING = Reading(-1, np.nan, np.full(NUM_READING_VALUES, np.nan), int(ReadingFlag.DAMAGED))
"""Reading for invalid packets."""
DAMAGED_WRENCH_PART = Part(WRENCH, -1, np.nan, np.full(6, np.nan), int(ReadingFlag.DAMAGED))
"""Part for invalid packets."""


class Source(Protocol[_SampleT]):
    """Interface of a source of readings, or of other samples.

    Attributes:
        dt: period of the samples [s].
        live: whether they arrive in real time; else as fast as they are read.
    """

    dt: float
    live: bool

    def read(self, timeout_s: float) -> list[_SampleT] | None:
        """Return the samples after waiting for the first; [] after the timeout, None at the end."""

    def close(self) -> None:
        return


class PartSource(Protocol):
    """Interface of a source of parts; `dt` [s] is the period of the wrenches."""

    dt: float
    streams: tuple[str, ...]

    def read(self, timeout_s: float) -> list[Part] | None: ...

    def close(self) -> None: ...


class Sink(Protocol):
    """Interface of a sink of compensated wrenches."""

    def write(self, out: CompensatedWrench) -> None: ...

    def close(self) -> None:
        return
