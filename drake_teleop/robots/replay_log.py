"""Source that replays a log, with motion and wrench aligned as by `eliminate`."""

from __future__ import annotations

import math
import time
from pathlib import Path

import numpy as np

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.identification import Identification
from drake_teleop.logs.aligned_log import replace_specific_force_by_acceleration
from drake_teleop.logs.processing import phi_with_inertia_replaced
from drake_teleop.logs.read.alignment import choose_delay, is_far_from_gaps, remove_delay
from drake_teleop.logs.read.reading import read_log
from drake_teleop.robots.streams import Reading, ReadingFlag, Source


class ReplayLogSource(Source):
    """Source of a log's readings, with the motion aligned to the wrench.

    `delay_readings`: removed delay of the motion [readings]; `chunk`: largest number of readings
    per call; `load` None: the motion is not aligned.
    """

    def __init__(
        self,
        path: str | Path,
        load: Identification | None,
        *,
        cutoff_hz: float | None = 30.0,
        delay: str | float = "auto",
        real_time: bool = False,
        chunk: int = 256,
    ) -> None:
        log = read_log(path, bandwidth_hz=cutoff_hz)
        if log.static:
            what = "is a log of static poses, which have no order in time"
            raise DrakeTeleopError(what, where=str(path), remedy="give a log of a motion")
        recorded = () if log.described is None else log.described.streams.values()
        delay_s, self.files = 0.0, (Path(path), *(stream.file for stream in recorded))
        if load is not None:
            log = replace_specific_force_by_acceleration(log) if load.weight_removed else log
            phi = phi_with_inertia_replaced(load)[0]
            delay_s, source = choose_delay(log, cutoff_hz, delay, phi)
            if source == "undetermined":
                delay_s = load.delay_s
            log = remove_delay(log, delay_s)
        self.dt, self.live = log.dt, real_time
        self.delay_readings = max(0, math.ceil(delay_s / log.dt - 1e-6))
        self._t, self._values = log.t, np.hstack([log.wrench, *log.motion])
        self._gravity = log.gravity
        self._flags = np.where(is_far_from_gaps(log, cutoff_hz), 0, int(ReadingFlag.GAP))
        self._at, self._chunk, self._start = 0, chunk, math.nan

    def read(self, timeout_s: float) -> list[Reading] | None:
        first, last = self._at, len(self._t)
        if first == last:
            return None
        stop = min(first + self._chunk, last)
        if self.live:
            now = time.monotonic()
            if math.isnan(self._start):
                self._start = now - self._t[0]
            time.sleep(max(0.0, min(timeout_s, self._t[first] + self._start - now)))
            here = time.monotonic() - self._start
            stop = min(stop, int(np.searchsorted(self._t, here, side="right")))
        self._at = max(first, stop)
        found = []
        for k in range(first, self._at):
            gravity = None if self._gravity is None else self._gravity[k]
            flags = int(self._flags[k])
            found.append(Reading(k, float(self._t[k]), self._values[k], flags, gravity))
        return found
