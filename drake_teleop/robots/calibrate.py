"""`drake-teleop calibrate`: the load from a stream, until it is known; and which motion is missing.

Writes into the folder

=================== ============================================================================
log.parquet         the record, a canonical log: `identify log.parquet` says the same
log.yaml            instead, of a source that tells poses or an IMU; its tables are beside it
identification.json of the record, with all else that `identify` writes: report.html, fit.png ...
settling.png        how the intervals shrank, and what was advised when
summary.json        that of `identify`, with "tolerance", "known" (by number), "all_known",
                    "half_widths_95" over the tolerances, "doubts", "looks"
=================== ============================================================================

What is left out of the record stands in `recording`. In a live stream the record is looked at
beside the loop, which goes on reading.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np

from drake_teleop.load.tolerance import Tolerance, read_tolerance
from drake_teleop.logs.commands import identify_command
from drake_teleop.robots.calibration import FIRST_S, GROWS, Look, look
from drake_teleop.robots.joints import arm_of
from drake_teleop.robots.recording import Records
from drake_teleop.robots.sources_and_sinks import recorded
from drake_teleop.writing import make_folder, set_aside, write_json, write_picture

DEFAULT = "mass 0.5 %, com 0.5 mm, inertia 5 %"
"""What is asked for if nothing is."""
_IDLE_S = 0.05
_T = TypeVar("_T")


class _Stream(Protocol[_T]):
    """A `Source` of whatever is recorded."""

    live: bool

    def read(self, timeout_s: float) -> list[_T] | None: ...


def calibrate(
    source: _Stream[_T],
    recorder: Records[_T],
    path: Path,
    tolerance: Tolerance,
    *,
    cutoff_hz: float | None = 30.0,
    delay: str | float = "auto",
    seconds: float = 120.0,
    show: Callable[[Look], None] = lambda _: None,
) -> list[Look]:
    """Records and looks until all that is asked is known, or the source or the time is over.

    Args:
        source: of readings, or of parts.
        recorder: of those.
        path: of the record, which is what the last look has seen.
        tolerance: what is asked.
        cutoff_hz, delay: as of `identify_log`.
        seconds: of the record, at most.
        show: takes each look.

    Returns:
        the looks, the last of which is the result.

    Raises:
        DrakeTeleopError: if hardly anything came, or the record cannot be written.
    """
    looks, after = list[Look](), FIRST_S
    earlier = [path.with_name(name) for name in recorder.files] if source.live else []
    pending: Future[Look] | None = None

    def seen(result: Look) -> bool:
        looks.append(result)
        show(result)
        return bool(result.known.all())

    def record() -> None:
        if recorder.seconds:
            set_aside(*earlier)
            earlier.clear()
        recorder.write(path)

    over = False
    try:
        with ThreadPoolExecutor(1) as beside, suppress(KeyboardInterrupt):
            while not over and (readings := source.read(_IDLE_S)) is not None:
                for each in readings:
                    recorder.take(each)
                    if pending is None and recorder.seconds >= after:
                        after = max(FIRST_S, GROWS * recorder.seconds)
                        record()
                        options = {"cutoff_hz": cutoff_hz, "delay": delay}
                        before = looks[-1] if looks else None
                        pending = beside.submit(look, path, tolerance, before, **options)  # type: ignore[arg-type]
                    if pending is not None and (not source.live or pending.done()):
                        over, pending = seen(pending.result()), None
                        if over:
                            break
                over = over or recorder.seconds >= seconds
    except Exception:
        if recorder.seconds:
            record()
        raise
    if pending is not None:
        seen(pending.result())
    if not looks or not looks[-1].known.all():
        record()
        before = looks[-1] if looks else None
        seen(look(path, tolerance, before, cutoff_hz=cutoff_hz, delay=delay))
    return looks


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
    motion: str | None = None,
    sensor_pose: tuple[float, ...] | None = None,
    model: Path | None = None,
    sensor_frame: str | None = None,
    package_paths: tuple[Path, ...] = (),
    quiet: bool = False,
) -> dict[str, Any]:
    """The command `calibrate`; see the top of this module.

    Args:
        source, real_time, motion, sensor_pose: see `source_of`.
        out: the folder.
        until: see `read_tolerance`.
        largest: the sensor's range [N], [N m].
        seconds, cutoff_hz, delay: see `calibrate`.
        model, sensor_frame, package_paths: see `compensate_command`.
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
    arm = arm_of(model, sensor_frame, package_paths)
    make_folder(out)
    limits = None if largest is None else np.repeat(largest, 3)
    stream, recorder = recorded(
        source, limits, real_time=real_time, motion=motion, sensor_pose=sensor_pose, arm=arm
    )
    console = Console(stderr=True, quiet=quiet)
    options = {"cutoff_hz": cutoff_hz, "delay": delay, "seconds": seconds}
    try:
        with Live(console=console, auto_refresh=False) as live:

            def show(at: Look) -> None:
                live.update(shown(at, tolerance), refresh=True)

            path = out / recorder.file
            looks = calibrate(stream, recorder, path, tolerance, show=show, **options)  # type: ignore[arg-type]
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
