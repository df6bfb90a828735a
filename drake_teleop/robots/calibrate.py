"""Identification from a stream: record and look until the requested parameters are known.

In a live stream the record is evaluated on another thread; the loop goes on reading. What is left
out of the record is described in `recording`.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Protocol, TypeVar

from drake_teleop.common.writing import set_aside
from drake_teleop.load.tolerance import Tolerance
from drake_teleop.robots.calibration import FIRST_S, GROWS, Look, look
from drake_teleop.robots.recording import Records

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
