"""What comes from a stream, kept until it is written as a log.

Readings make a canonical log. Parts make a table for each stream and a description of them,
log.yaml: the poses stay as they came, so that `identify` finds the motion, its noise, the delay and
the drift of the clock as it does of every log, and better than a motion that was differentiated as
it came. What is damaged, not finite, no pose, or saturated is left out, and so is what comes late;
a clock that was set begins the record anew.

**Clocks.** Streams of one source have one. Those of two are brought together by what each took
least time for; what is left of that is the delay that is estimated.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Protocol, TypeVar

import numpy as np

from drake_teleop.errors import DrakeTeleopError
from drake_teleop.load.arrays import Array
from drake_teleop.logs.read import canonical
from drake_teleop.logs.read.canonical import Log, write_log
from drake_teleop.logs.read.rotations import rotation_matrices
from drake_teleop.robots.compensator import JUMP_S
from drake_teleop.robots.parts import Parts
from drake_teleop.robots.streams import IMU, POSE, VALUES, WRENCH, Flag, Part, Reading
from drake_teleop.writing import write_table, write_text

_WRONG = Flag.DAMAGED | Flag.NOT_FINITE | Flag.OUT_OF_RANGE | Flag.SATURATED | Flag.GAP
_COLUMNS = {
    WRENCH: canonical.WRENCH,
    POSE: (*canonical.ORIENTATION, *canonical.POSITION),
    IMU: (*canonical.SPECIFIC_FORCE, *canonical.ANGULAR_VELOCITY),
}
_GRAVITY = 9.81  # as `compensate` has it
_UNIT = 0.01  # by which the norm of a quaternion may be off
_T = TypeVar("_T", contravariant=True)


class Records(Protocol[_T]):
    """Keeps what comes.

    Attributes:
        file: name of the log that it writes.
        left_out: of what came.
        began_anew: how often the clock was set.
        seconds: length of the record.
    """

    file: str
    left_out: int
    began_anew: int

    @property
    def seconds(self) -> float:
        """How long what was kept is."""
        ...

    def take(self, one: _T) -> None:
        """Keeps it if it is good."""

    def write(self, path: Path) -> None:
        """Writes the log.

        Raises:
            DrakeTeleopError: if hardly anything came, or it cannot be written.
        """


class Recorder:
    """`Records` of readings.

    Args:
        largest: (6,) the sensor's range [N, N m]; what is at its ends is left out.
    """

    file = "log.parquet"

    def __init__(self, largest: Array | None = None) -> None:
        self._kept = _Kept(largest)
        self.left_out, self.began_anew = 0, 0

    def take(self, reading: Reading) -> None:
        """See `Records`."""
        if not self._kept.fits(reading.t, reading.values, reading.flags):
            self.left_out += 1
        elif self._kept.jumps(reading.t):
            self._kept.forget()
            self.began_anew += 1
            self._kept.add(reading.t, reading.values)
        elif not self._kept.add(reading.t, reading.values):
            self.left_out += 1

    @property
    def seconds(self) -> float:
        """Length of the record [s]."""
        return self._kept.seconds

    def write(self, path: Path) -> None:
        """See `Records`."""
        t, values = self._kept.table(VALUES, self.left_out)
        wrench, s, omega, alpha = np.split(values, [6, 9, 12], axis=1)
        write_log(Log(t - t[0], wrench, s, omega, alpha), path)


class PartRecorder:
    """`Records` of what `Parts` reads.

    Args:
        parts: which streams there are, and whether they have a clock each.
        largest: see `Recorder`.
        X_FS: (7,) see `Assembly`.
    """

    file = "log.yaml"

    def __init__(self, parts: Parts, largest: Array | None, X_FS: Array) -> None:
        self._told, self._two_clocks = parts.told, parts.two_clocks
        self._streams = {WRENCH: _Kept(largest), parts.told: _Kept(None)}
        self._R_FS = rotation_matrices(X_FS[None, :4], "quaternion_wxyz")[0]
        self._p_FS = X_FS[4:]
        self.left_out, self.began_anew = 0, 0

    def take(self, one: tuple[Part, float]) -> None:
        """See `Records`."""
        part, now = one
        kept = self._streams.get(part.stream)
        if kept is None:
            return
        values = part.values
        posed = part.stream != POSE or abs(float(np.linalg.norm(values[:4])) - 1.0) < _UNIT
        if not (kept.fits(part.t, values, part.flags) and posed):
            self.left_out += 1
            return
        if kept.jumps(part.t):
            for each in self._streams.values():
                each.forget()
            self.began_anew += 1
        if not kept.add(part.t, values, now):
            self.left_out += 1

    @property
    def seconds(self) -> float:
        """Length of the record [s]."""
        return min(each.seconds for each in self._streams.values())

    def write(self, path: Path) -> None:
        """See `Records`. The tables stand beside the log."""
        import polars as pl

        wrench, motion = self._streams[WRENCH], self._streams[self._told]
        start = wrench.table(6, self.left_out)[0][0]
        behind = motion.least - wrench.least if self._two_clocks else 0.0
        for stream, kept, shift in ((WRENCH, wrench, -start), (self._told, motion, behind - start)):
            names = _COLUMNS[stream]
            t, values = kept.table(len(names), self.left_out)
            columns = {"t": t + shift} | dict(zip(names, values.T, strict=True))
            write_table(path.with_name(f"{stream}.parquet"), pl.DataFrame(columns))
        write_text(path, self._description())

    def _description(self) -> str:
        lines = [f"gravity: {_GRAVITY}"]
        for stream in self._streams:
            lines += [f"{stream}:", f"  file: {stream}.parquet", "  time: {column: t}"]
            lines += [f"  {field}: {{{words}}}" for field, words in _FIELDS[stream].items()]
        if self._told == POSE:
            R_SF = self._R_FS.T
            lines.append(f"  position_in_sensor: {(-R_SF @ self._p_FS).tolist()}")
            lines.append(f"  rotation_in_sensor: {R_SF.tolist()}")
        return "\n".join(lines) + "\n"


def _columns(names: tuple[str, ...], more: str = "") -> str:
    return f"columns: [{', '.join(names)}]{more}"


_FIELDS = {
    WRENCH: {"force": _columns(canonical.WRENCH[:3]), "torque": _columns(canonical.WRENCH[3:])},
    POSE: {
        "orientation": _columns(canonical.ORIENTATION, ", form: quaternion_wxyz"),
        "position": _columns(canonical.POSITION),
    },
    IMU: {
        "specific_force": _columns(canonical.SPECIFIC_FORCE),
        "angular_velocity": _columns(canonical.ANGULAR_VELOCITY),
    },
}


class _Kept:
    """Samples of one stream, in order.

    Attributes:
        least: our clock less the stream's, of the sample that took least time.
    """

    def __init__(self, largest: Array | None) -> None:
        self._largest = np.full(6, np.inf) if largest is None else largest
        self.forget()

    def forget(self) -> None:
        self._t: list[float] = []
        self._values: list[Array] = []
        self.least = math.inf

    def fits(self, t: float, values: Array, flags: int) -> bool:
        """Whether it is a sample at all."""
        finite = math.isfinite(t) and bool(np.isfinite(values).all())
        return finite and not flags & _WRONG and bool((np.abs(values[:6]) < self._largest).all())

    def jumps(self, t: float) -> bool:
        return bool(self._t) and abs(t - self._t[-1]) > JUMP_S

    def add(self, t: float, values: Array, now: float = 0.0) -> bool:
        """Whether it came in order; it is kept then."""
        if self._t and t <= self._t[-1]:
            return False
        self._t.append(t)
        self._values.append(values)
        self.least = min(self.least, now - t)
        return True

    @property
    def seconds(self) -> float:
        return self._t[-1] - self._t[0] if self._t else 0.0

    def table(self, width: int, left_out: int) -> tuple[Array, Array]:
        """(N,) times and (N, width) values."""
        if len(self._t) < 2:
            raise DrakeTeleopError(
                f"{len(self._t)} good readings came, {left_out} were left out",
                where="calibrate",
                remedy="does the source send, and to this port?",
            )
        return np.array(self._t), np.array(self._values).reshape(-1, width)
