"""Identification from a stream until the requested parameters are known."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Protocol, TypeVar

from drake_teleop.common.writing import set_aside
from drake_teleop.load.tolerance import Tolerance
from drake_teleop.robots.calibration import (
    FIRST_RECORD_S,
    RECORD_GROWTH,
    Evaluation,
    evaluate_record,
)
from drake_teleop.robots.recording import Records

DEFAULT_TOLERANCE = "mass 0.5 %, com 0.5 mm, inertia 5 %"
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
    show: Callable[[Evaluation], None] = lambda _: None,
) -> list[Evaluation]:
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
    results, next_length_s = list[Evaluation](), FIRST_RECORD_S
    earlier = [path.with_name(name) for name in recorder.files] if source.live else []
    pending: Future[Evaluation] | None = None

    def finish(result: Evaluation) -> bool:
        results.append(result)
        show(result)
        return bool(result.known.all())

    def record() -> None:
        if recorder.seconds:
            set_aside(*earlier)
            earlier.clear()
        recorder.write(path)

    done = False
    try:
        with ThreadPoolExecutor(1) as executor, suppress(KeyboardInterrupt):
            while not done and (readings := source.read(_IDLE_S)) is not None:
                for each in readings:
                    recorder.take(each)
                    if pending is None and recorder.seconds >= next_length_s:
                        next_length_s = max(FIRST_RECORD_S, RECORD_GROWTH * recorder.seconds)
                        record()
                        options = {"cutoff_hz": cutoff_hz, "delay": delay}
                        previous = results[-1] if results else None
                        pending = executor.submit(
                            evaluate_record, path, tolerance, previous, **options
                        )  # type: ignore[arg-type]
                    if pending is not None and (not source.live or pending.done()):
                        done, pending = finish(pending.result()), None
                        if done:
                            break
                done = done or recorder.seconds >= seconds
    except Exception:
        if recorder.seconds:
            record()
        raise
    if pending is not None:
        finish(pending.result())
    if not results or not results[-1].known.all():
        record()
        previous = results[-1] if results else None
        finish(evaluate_record(path, tolerance, previous, cutoff_hz=cutoff_hz, delay=delay))
    return results
