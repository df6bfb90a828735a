"""Readings and wrenches as lines of JSON.

Input: t [s], wrench (6), s, omega, alpha (3 each); optionally number and saturated. Output: number,
t, contact and scaled (6 each), and names of flags.
"""

from __future__ import annotations

import json
import os
import select
from typing import Any, TextIO

import numpy as np

from drake_teleop.robots.streams import DAMAGED, VALUES, Compensated, Flag, Reading, Sink, Source

_MAX_LINE_BYTES = 4096  # bytes per line
_BLOCK_BYTES = 65536


def read_line(line: bytes, number: int) -> Reading:
    """Return the reading in a line, `DAMAGED` if it is invalid; `number` is the default number."""
    if len(line) > _MAX_LINE_BYTES:
        return DAMAGED
    try:
        data = json.loads(line)
        parts = [np.array(data[name], float) for name in ("wrench", "s", "omega", "alpha")]
        values = np.concatenate(parts)
        t, number = float(data["t"]), int(data.get("number", number))
        flags = int(Flag.SATURATED) if data.get("saturated") else 0
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError):
        return DAMAGED
    good = values.shape == (VALUES,) and [len(part) for part in parts] == [6, 3, 3, 3]
    return Reading(number, t, values, flags) if good and 0 <= number < 2**64 else DAMAGED


def wrench_line(out: Compensated) -> str:
    """Return a compensated wrench as a line of JSON."""
    data: dict[str, Any] = {
        "number": out.number,
        "t": out.t,
        "contact": out.contact.tolist(),
        "scaled": out.scaled.tolist(),
        "flags": flag_names(out.flags),
    }
    return json.dumps(data)


def flag_names(flags: int) -> list[str]:
    """Return the names of the set flags, such as "out of range"."""
    return [str(flag.name).lower().replace("_", " ") for flag in Flag if flag & flags]


class LineSource(Source[Reading]):
    """Source of readings, as lines of JSON, from a growing file such as standard input."""

    live = True

    def __init__(self, file: int, dt: float) -> None:
        self.dt, self._file, self._partial, self._number, self._ended = dt, file, b"", 0, False

    def read(self, timeout_s: float) -> list[Reading] | None:
        """See `Source`."""
        if self._ended:
            return None
        if not select.select([self._file], [], [], timeout_s)[0]:
            return []
        block = os.read(self._file, _BLOCK_BYTES)
        self._ended = not block
        *lines, self._partial = (self._partial + block).split(b"\n")
        if self._ended or len(self._partial) > _MAX_LINE_BYTES:
            lines, self._partial = [*lines, self._partial], b""
        found = []
        for line in lines:
            if line.strip():
                found.append(read_line(line, self._number))
                self._number += 1
        return found


class LineSink(Sink):
    """Sink of unbuffered lines of JSON in a text file such as standard output."""

    def __init__(self, file: TextIO) -> None:
        self._file = file

    def write(self, out: Compensated) -> None:
        """See `Sink`."""
        self._file.write(wrench_line(out) + "\n")
        self._file.flush()
