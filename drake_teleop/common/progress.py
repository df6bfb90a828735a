"""Progress bars on a terminal or in a notebook, elsewhere lines on stderr."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeAlias

UpdateProgress: TypeAlias = Callable[..., None]
"""Function that displays a completed fraction, 0 to 1, and an optional status text."""
StartStage: TypeAlias = Callable[[str], UpdateProgress]
"""Function that begins a stage of work by its name, and returns its `UpdateProgress`."""
_PROGRESS_LINE_PERIOD_S = 15.0


def show_no_progress(name: str) -> UpdateProgress:
    return lambda fraction, words="": None


@contextmanager
def show_progress(progress: bool | StartStage, *, after: float = 0.0) -> Iterator[StartStage]:
    """Yield `progress`, or for True a function that displays stages lasting over `after` s."""
    if callable(progress):
        yield progress
    elif not progress:
        yield show_no_progress
    else:
        from rich import get_console

        console = get_console()
        if console.is_terminal or console.is_jupyter:
            yield from _show_stages_as_bars(after)
        else:
            yield _show_stages_as_lines(after)


def _show_stages_as_lines(delay_s: float) -> StartStage:
    opened = time.monotonic()

    def start_stage(name: str) -> UpdateProgress:
        next_line, text = opened + delay_s, "..."

        def update(fraction: float, words: str = "") -> None:
            nonlocal next_line, text
            if (now := time.monotonic()) >= next_line:
                text = text or f"{words} {fraction:.0%}".strip()
                print(f"{name} {text}", file=sys.stderr, flush=True)
                next_line, text = now + _PROGRESS_LINE_PERIOD_S, ""

        update(0.0)
        return update

    return start_stage


def _show_stages_as_bars(delay_s: float) -> Iterator[StartStage]:
    from rich import progress as rich_progress
    from rich.errors import LiveError

    bars = rich_progress.Progress(
        rich_progress.TextColumn("{task.description:34s}"),
        rich_progress.BarColumn(),
        rich_progress.TaskProgressColumn(),
        rich_progress.TimeElapsedColumn(),
    )
    opened, shown = time.monotonic(), False

    def show_bars_after_delay() -> None:
        nonlocal shown
        if not shown and time.monotonic() - opened >= delay_s:
            shown = True
            try:
                bars.start()
            except LiveError:  # older rich: other bars are active
                bars.disable = True

    def start_stage(name: str) -> UpdateProgress:
        task = bars.add_task(name, total=1.0)
        show_bars_after_delay()

        def update(fraction: float, words: str = "") -> None:
            bars.update(task, completed=fraction, description=f"{name} {words}")
            show_bars_after_delay()

        return update

    try:
        yield start_stage
    finally:
        if shown:
            bars.stop()
