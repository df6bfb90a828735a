"""Detection of a changed sensor zero or load in a stream, by the test of `identify`."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np

from drake_teleop.common.numeric import Array
from drake_teleop.logs.causes.cause import CHANGE_CAUSES, Finding, list_misfit_causes
from drake_teleop.logs.causes.explain import explain_misfit
from drake_teleop.logs.causes.fitted_model import FittedModel
from drake_teleop.logs.causes.instants import SPECIFIC_FORCE_SIGNALS, block_means_of_record
from drake_teleop.logs.causes.model import StepChange
from drake_teleop.robots import streams
from drake_teleop.robots.compensator import MIN_CLOCK_JUMP_S

TESTED_RECORD_SPAN_S = 20.0
"""Length of the record that a test examines [s]."""
MIN_FLAG_TIME_BEFORE_TEST_S = 2.0
"""Minimum duration of contact or load flags before a test [s]."""
_CHANGE_TEST_TRIGGER_FLAGS = int(streams.ReadingFlag.IN_CONTACT | streams.ReadingFlag.OTHER_LOAD)
_FLAGS_EXCLUDED_FROM_TEST = ~int(streams.NONZERO_WRENCH_FLAGS)
# [s]: maximum time between attempts, flag-free time after a change, time between two changes.
_MAX_TEST_SPACING_S, _MAX_PAUSE_IN_FLAGGED_TIME_S, _MIN_REPORTED_CHANGE_SPACING_S = 10.0, 1.0, 1.0
_MIN_TESTED_RECORD_S, _KIND_LIKELIHOOD_RATIO = 4.0, 40.0
_MIN_SPECIFIC_FORCE_STD_AFTER_CHANGE_M_S2 = 0.5
_CHANGE_TEST_NICENESS, _CHANGE_TEST_TIMEOUT_S = 10, 60.0

TimedChangeText = tuple[float, str]
"""Time of a change [s], and the change in words."""


class ZeroAndLoadMonitor:
    """Monitor that calls `report` once for each change of the sensor's zero or load."""

    def __init__(self, dt: float, *, live: bool, report: Callable[[str], None]) -> None:
        self._dt, self._live, self._report = dt, live, report
        self._rows = np.zeros((round(TESTED_RECORD_SPAN_S / dt), 1 + streams.NUM_READING_VALUES))
        self._count, self._last = 0, -math.inf
        self._flagged_since, self._last_flagged, self._next_attempt = math.inf, -math.inf, math.inf
        self._executor = ThreadPoolExecutor(1, "changes of a stream")
        self._pending: Future[list[TimedChangeText]] | None = None
        self._reported: list[float] = []

    def add_reading(self, reading: streams.Reading, output_flags: int) -> None:
        if output_flags & _FLAGS_EXCLUDED_FROM_TEST:
            return
        if not 0.0 < reading.t - self._last < MIN_CLOCK_JUMP_S:
            self._count, self._flagged_since = 0, math.inf
            self._reported = [t for t in self._reported if t < reading.t]  # of the same clock
        t = self._last = reading.t
        row = self._rows[self._count % len(self._rows)]
        row[0], row[1:] = t, reading.values
        self._count += 1
        if output_flags & _CHANGE_TEST_TRIGGER_FLAGS:
            self._last_flagged = t
            if self._flagged_since > t:
                self._flagged_since, self._next_attempt = t, t + MIN_FLAG_TIME_BEFORE_TEST_S
        elif t - self._last_flagged > _MAX_PAUSE_IN_FLAGGED_TIME_S:
            self._flagged_since = math.inf
        if self._pending is None and t >= self._next_attempt and self._flagged_since <= t:
            spacing_s = max(MIN_FLAG_TIME_BEFORE_TEST_S, 0.5 * (t - self._flagged_since))
            self._next_attempt = t + min(spacing_s, _MAX_TEST_SPACING_S)
            find = _find_changes_in_subprocess if self._live else find_zero_and_load_changes
            self._pending = self._executor.submit(find, self._rows_in_time_order(), self._dt)
        if self._pending is not None and (self._pending.done() or not self._live):
            self._report_changes(self._pending)
            self._pending = None

    def close(self) -> None:
        """Wait for the last test and report its changes."""
        if self._pending is not None:
            self._report_changes(self._pending)
        self._executor.shutdown()

    def _rows_in_time_order(self) -> Array:
        if self._count <= len(self._rows):
            return self._rows[: self._count].copy()
        return np.roll(self._rows, -self._count, axis=0)

    def _report_changes(self, found: Future[list[TimedChangeText]]) -> None:
        error = found.exception()
        if error is not None:  # the loop continues
            self._report(f"error in the test for a tare or another load ({error})")
            return
        for time, words in found.result():
            if all(abs(time - t) > _MIN_REPORTED_CHANGE_SPACING_S for t in self._reported):
                self._reported.append(time)
                self._next_attempt = self._last + _MAX_TEST_SPACING_S
                self._report(words)


def _find_changes_in_subprocess(rows: Array, dt: float) -> list[TimedChangeText]:
    words = [sys.executable, "-m", __name__, repr(dt)]
    # In a new session, so that Ctrl-C stops the loop only.
    options: Any = {"timeout": _CHANGE_TEST_TIMEOUT_S, "check": True, "start_new_session": True}
    done = subprocess.run(words, input=rows.tobytes(), stdout=subprocess.PIPE, **options)
    return [(time, words) for time, words in json.loads(done.stdout)]


def find_zero_and_load_changes(rows: Array, dt: float) -> list[TimedChangeText]:
    """Return the changes of zero and load in `rows` (N, 16) of time [s] and `Reading.values`."""
    t = np.arange(rows[0, 0], rows[-1, 0] + 0.5 * dt, dt)
    at = np.clip(np.searchsorted(rows[:, 0], t - 0.5 * dt), 0, len(rows) - 1)
    if len(t) * dt < _MIN_TESTED_RECORD_S:
        return []
    wrench, *motion = np.split(rows[at, 1:], [6, 9, 12], axis=1)
    lost = np.abs(rows[at, 0] - t) > dt
    state = explain_misfit(block_means_of_record(t, wrench, tuple(motion), None, lost)).fit
    return [
        (cause.start_s, _text_of_zero_or_load_change(cause))
        for cause in list_misfit_causes(state)
        if cause.name in CHANGE_CAUSES
        and cause.start_s is not None
        and _is_change_kind_certain(state, cause.start_s)
    ]


def _is_change_kind_certain(state: FittedModel, time: float) -> bool:
    steps, data = state.model.steps, state.means
    after = data.y[data.used & (data.t > time)][:, SPECIFIC_FORCE_SIGNALS]
    min_std = _MIN_SPECIFIC_FORCE_STD_AFTER_CHANGE_M_S2
    if len(after) == 0 or np.linalg.norm(after.std(axis=0)) < min_std:
        return False
    own = next(step for step in steps if step.time == time)
    other = StepChange("offsets" if own.kind == "load" else "load", own.time)
    model = replace(state.model, steps=(*(step for step in steps if step != own), other))
    start = np.zeros(model.size)
    start[:17] = state.x[:17]
    gain = state.log_likelihood - state.refit(model, start).log_likelihood
    return 2.0 * gain > _KIND_LIKELIHOOD_RATIO


def _text_of_zero_or_load_change(cause: Finding) -> str:
    if cause.name == "zero change":
        change = " ".join(f"{x:+.3g}" for x in np.array(cause.values["change"]))
        return (
            f"t = {cause.start_s:.2f} s: the sensor has another zero, {change} N and N m more (a"
            " tare, or a push that rotates with the tool); tare the compensation too"
        )
    return (
        f"t = {cause.start_s:.2f} s: another load, {cause.values['mass_change']:+.4g} kg; run"
        " `calibrate` with it"
    )


def main() -> None:
    if hasattr(os, "nice"):
        os.nice(_CHANGE_TEST_NICENESS)
    rows = np.frombuffer(sys.stdin.buffer.read()).reshape(-1, 1 + streams.NUM_READING_VALUES)
    json.dump(find_zero_and_load_changes(rows, float(sys.argv[1])), sys.stdout)


if __name__ == "__main__":
    main()
