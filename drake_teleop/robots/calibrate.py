"""Identification from a stream until the requested parameters are known."""

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
"""Default tolerances."""
_IDLE_S = 0.05
_T = TypeVar("_T")


class _Stream(Protocol[_T]):
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
    """Record a stream until the tolerance is met, the source ends or the time is over.

    Args:
        path: file of the record; the last result refers to it.
        cutoff_hz, delay: see `identify_log`.
        seconds: maximum length of the record.
        show: callback for each result.

    Returns:
        All results.

    Raises:
        DrakeTeleopError: if too few samples came, or the record cannot be written.
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
