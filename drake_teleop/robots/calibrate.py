"""`drake-teleop calibrate`: the load from a stream, until it is known; and which motion is missing.

Writes into the folder

=================== ============================================================================
log.parquet         the record, a canonical log: `identify log.parquet` says the same
identification.json of the record, with all else that `identify` writes: report.html, fit.png ...
settling.png        how the intervals shrank, and what was advised when
summary.json        that of `identify`, with "tolerance", "known" (by number), "all_known",
                    "half_widths_95" over the tolerances, "doubts", "looks"
=================== ============================================================================

Readings that are damaged, not finite, or saturated are left out, and so is what comes late; a clock
that was set begins the record anew. In a live stream the record is looked at beside the loop, which
goes on reading.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from drake_teleop.errors import DrakeTeleopError
from drake_teleop.load.tolerance import Tolerance, read_tolerance
from drake_teleop.logs.commands import identify_command
from drake_teleop.logs.read.canonical import Log, write_log
from drake_teleop.robots.calibration import FIRST_S, GROWS, Look, look
from drake_teleop.robots.compensator import JUMP_S
from drake_teleop.robots.sources_and_sinks import source_of
from drake_teleop.robots.streams import VALUES, Flag, Reading, Source
from drake_teleop.writing import make_folder, write_json, write_picture

DEFAULT = "mass 0.5 %, com 0.5 mm, inertia 5 %"
"""What is asked for if nothing is."""
_WRONG = Flag.DAMAGED | Flag.NOT_FINITE | Flag.OUT_OF_RANGE | Flag.SATURATED | Flag.GAP
_IDLE_S = 0.05
_ANY_HZ = 1000.0  # readings are kept with their times: their rate is asked by the compensator alone


class Recorder:
    """The good readings of a stream.

    Args:
        largest: (6,) the sensor's range [N, N m]; what is at its ends is left out.

    Attributes:
        left_out: readings.
        began_anew: how often the clock was set.
    """

    def __init__(self, largest: np.ndarray[Any, Any] | None = None) -> None:
        self._largest = np.full(6, np.inf) if largest is None else largest
        self._t: list[float] = []
        self._values: list[np.ndarray[Any, Any]] = []
        self.left_out, self.began_anew = 0, 0

    def take(self, reading: Reading) -> None:
        """Keeps it if it is good."""
        values, t = reading.values, reading.t
        good = not reading.flags & _WRONG and np.isfinite(t) and np.isfinite(values).all()
        if not good or (np.abs(values[:6]) >= self._largest).any():
            self.left_out += 1
        elif self._t and abs(t - self._t[-1]) > JUMP_S:
            self._t, self._values = [t], [values]
            self.began_anew += 1
        elif self._t and t <= self._t[-1]:
            self.left_out += 1
        else:
            self._t.append(t)
            self._values.append(values)

    @property
    def seconds(self) -> float:
        """Length of the record [s]."""
        return self._t[-1] - self._t[0] if self._t else 0.0

    def write(self, path: Path) -> None:
        """Writes the canonical log.

        Raises:
            DrakeTeleopError: if there are fewer than two readings, or it cannot be written.
        """
        if len(self._t) < 2:
            raise DrakeTeleopError(
                f"{len(self._t)} good readings came, {self.left_out} were left out",
                where="calibrate",
                remedy="does the source send, and to this port?",
            )
        values = np.array(self._values).reshape(-1, VALUES)
        wrench, s, omega, alpha = np.split(values, [6, 9, 12], axis=1)
        write_log(Log(np.array(self._t) - self._t[0], wrench, s, omega, alpha), path)


def calibrate(
    source: Source,
    path: Path,
    tolerance: Tolerance,
    *,
    cutoff_hz: float | None = 30.0,
    delay: str | float = "auto",
    largest: np.ndarray[Any, Any] | None = None,
    seconds: float = 120.0,
    show: Callable[[Look], None] = lambda _: None,
) -> tuple[list[Look], Recorder]:
    """Records and looks until all that is asked is known, or the source or the time is over.

    Args:
        source: of readings.
        path: of the record, which is what the last look has seen.
        tolerance: what is asked.
        cutoff_hz, delay: as of `identify_log`.
        largest: see `Recorder`.
        seconds: of the record, at most.
        show: takes each look.

    Returns:
        the looks, the last of which is the result; and who recorded.

    Raises:
        DrakeTeleopError: if hardly anything came, or the record cannot be written.
    """
    recorder, looks, after = Recorder(largest), list[Look](), FIRST_S
    pending: Future[Look] | None = None

    def seen(result: Look) -> bool:
        looks.append(result)
        show(result)
        return bool(result.known.all())

    over = False
    with ThreadPoolExecutor(1) as beside, suppress(KeyboardInterrupt):
        while not over and (readings := source.read(_IDLE_S)) is not None:
            for reading in readings:
                recorder.take(reading)
                if pending is None and recorder.seconds >= after:
                    after = max(FIRST_S, GROWS * recorder.seconds)
                    recorder.write(path)
                    options = {"cutoff_hz": cutoff_hz, "delay": delay}
                    before = looks[-1] if looks else None
                    pending = beside.submit(look, path, tolerance, before, **options)  # type: ignore[arg-type]
                if pending is not None and (not source.live or pending.done()):
                    over, pending = seen(pending.result()), None
                    if over:
                        break
            over = over or recorder.seconds >= seconds
    if pending is not None:
        seen(pending.result())
    if not looks or not looks[-1].known.all():
        recorder.write(path)
        before = looks[-1] if looks else None
        seen(look(path, tolerance, before, cutoff_hz=cutoff_hz, delay=delay))
    return looks, recorder


def calibrate_command(
    source: str,
    out: Path,
    *,
    until: str = DEFAULT,
    largest: tuple[float, float] | None = None,
    seconds: float = 120.0,
    real_time: bool = False,
    cutoff_hz: float | None = 30.0,
    delay: str | float = "auto",
    quiet: bool = False,
) -> dict[str, Any]:
    """The command `calibrate`; see the top of this module.

    Args:
        source, real_time: see `source_of`.
        out: the folder.
        until: see `read_tolerance`.
        largest: the sensor's range [N], [N m].
        seconds, cutoff_hz, delay: see `calibrate`.
        quiet: no table.

    Returns:
        the summary.

    Raises:
        DrakeTeleopError: if one of them cannot be used, or nothing of a load is in the record.
    """
    from rich.console import Console
    from rich.live import Live

    from drake_teleop.robots.calibrate_view import draw_settling, shown

    tolerance = read_tolerance(until)
    make_folder(out)
    stream = source_of(source, None, rate_hz=_ANY_HZ, real_time=real_time)
    limits = None if largest is None else np.repeat(largest, 3)
    console = Console(stderr=True, quiet=quiet)
    options = {"cutoff_hz": cutoff_hz, "delay": delay, "largest": limits, "seconds": seconds}
    try:
        with Live(console=console, auto_refresh=False) as live:

            def show(at: Look) -> None:
                live.update(shown(at, tolerance), refresh=True)

            path = out / "log.parquet"
            looks, recorder = calibrate(stream, path, tolerance, show=show, **options)  # type: ignore[arg-type]
    finally:
        stream.close()
    last = looks[-1]
    summary = identify_command(path, out, cutoff_hz=cutoff_hz, delay=delay, quiet=True)
    write_picture(out / "settling.png", draw_settling(looks, tolerance))
    summary |= {
        "tolerance": str(tolerance),
        "known": dict(zip(tolerance.entries, last.known.tolist(), strict=True)),
        "all_known": bool(last.known.all()),
        "half_widths_95": dict(zip(tolerance.entries, last.half.tolist(), strict=True)),
        "doubts": list(last.doubts),
        "advice": last.advice,
        "seconds": last.t,
        "looks": len(looks),
        "left_out": recorder.left_out,
        "began_anew": recorder.began_anew,
    }
    write_json(out / "summary.json", summary)
    if summary["all_known"]:
        console.print(f"known after {last.t:.1f} s: {tolerance}", highlight=False)
    else:
        console.print(f"[bold red]not known[/] after {last.t:.1f} s: {tolerance}", highlight=False)
    console.print(f"written to {out}", highlight=False, markup=False)
    return summary
