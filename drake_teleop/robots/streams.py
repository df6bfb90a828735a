"""Types of the live streams: readings, compensated wrenches, flags, sources and sinks.

Readings are in the sensor frame S, in SI units, with the sign of Eq. (1): wrench of sensor on load.
"""

from __future__ import annotations

from enum import IntFlag
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from drake_teleop.common.numeric import Array

NUM_READING_VALUES = 15
"""Length of a reading: wrench (6), specific force, angular velocity and acceleration (3 each)."""


class ReadingFlag(IntFlag):
    """Flag of a reading and its output wrench: reason why the wrench is zero, or information."""

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


WRENCH_AND_MOTION, WRENCH, POSE = "wrench and motion", "wrench", "pose"
IMU, JOINTS, ACCELERATION = "imu", "joints", "acceleration"
"""Streams of readings."""


class Reading(NamedTuple):
    """Sample of the stream `stream`: number, time [s] on the source's clock, values, flags.

    Attributes:
        values: WRENCH_AND_MOTION (15,): wrench of sensor on load [N, N m], specific force, angular
            velocity and acceleration, in S. WRENCH (6,): that wrench. POSE (7,): X_WF of a frame F
            on the wrist. IMU (6,): specific force and angular velocity of S. JOINTS (n,):
            positions. ACCELERATION (3,): of the tool.
        gravity: (3,) in S [m/s^2]; None without an orientation.
        arrival: arrival time on this computer's clock [s], if a source has several streams.
    """

    number: int
    t: float
    values: Array
    flags: int = 0
    gravity: Array | None = None
    stream: str = WRENCH_AND_MOTION
    arrival: float = 0.0


class CompensatedWrench(NamedTuple):
    """Sample for a sink: contact wrench (6,) and scaled wrench (6,) [N, N m]."""

    number: int
    t: float
    contact: Array
    scaled: Array
    flags: int


DAMAGED_READING = Reading(-1, np.nan, np.full(NUM_READING_VALUES, np.nan), int(ReadingFlag.DAMAGED))
"""Reading for invalid packets."""
DAMAGED_WRENCH_READING = DAMAGED_READING._replace(values=np.full(6, np.nan), stream=WRENCH)
"""Reading for invalid packets with a wrench alone."""


class Source(Protocol):
    """Interface of a source of readings.

    Attributes:
        dt: period of the wrenches [s].
        live: whether readings arrive in real time; False for a log without waiting times.
        streams: WRENCH_AND_MOTION, or streams of wrench and motion to combine.
        files: replayed files.
    """

    dt: float
    live: bool = True
    files: tuple[Path, ...] = ()
    streams: tuple[str, ...] = (WRENCH_AND_MOTION,)

    def read(self, timeout_s: float) -> list[Reading] | None:
        """Wait for a reading; return all that arrived, [] after the timeout, None at the end."""

    def close(self) -> None:
        return


class Sink(Protocol):
    """Interface of a sink of compensated wrenches."""

    def write(self, out: CompensatedWrench) -> None: ...

    def close(self) -> None:
        return
