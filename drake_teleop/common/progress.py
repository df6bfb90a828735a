"""Progress of each named stage: a bar on a terminal, elsewhere one line on stderr."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeAlias

Progress: TypeAlias = Callable[..., None]
"""Called with the fraction done, 0 to 1, and perhaps with words on how it stands."""
Stage: TypeAlias = Callable[[str], Progress]
"""Opens a stage by its name."""


def silent(name: str) -> Progress:
    """A stage that shows nothing."""
    return lambda fraction, words="": None


@contextmanager
def show_progress(progress: bool | Stage, *, after: float = 0.0) -> Iterator[Stage]:
    """Bars on the terminal or in the notebook for as long as the context lasts.

    If the output goes elsewhere, each stage is one line on stderr when it begins.

    Args:
        progress: whether to show them; or what a caller has from here, and goes on showing.
        after: how long something takes before it has a bar [s].
    """
    if callable(progress):
        yield progress
    elif not progress:
        yield silent
    elif not _somebody_looks():
        yield _lines(after)
    else:
        yield from _bars(after)


def _somebody_looks() -> bool:
    from rich import get_console

    console = get_console()
    return console.is_terminal or console.is_jupyter


def _lines(after: float) -> Stage:
    opened = time.monotonic()

    def stage(name: str) -> Progress:
        told = False

        def update(fraction: float, words: str = "") -> None:
            nonlocal told
            if not told and time.monotonic() - opened >= after:
                told = True
                print(f"{name} ...", file=sys.stderr, flush=True)

        update(0.0)
        return update

    return stage


def _bars(after: float) -> Iterator[Stage]:
    from rich import progress as rich_progress
    from rich.errors import LiveError

    bars = rich_progress.Progress(
        rich_progress.TextColumn("{task.description:34s}"),
        rich_progress.BarColumn(),
        rich_progress.TaskProgressColumn(),
        rich_progress.TimeElapsedColumn(),
    )
    opened, shown = time.monotonic(), False

    def show() -> None:
        nonlocal shown
        if not shown and time.monotonic() - opened >= after:
            shown = True
            try:
                bars.start()
            except LiveError:  # older rich: bars of somebody else are being shown, and go on
                bars.disable = True

    def stage(name: str) -> Progress:
        task = bars.add_task(name, total=1.0)
        show()

        def update(fraction: float, words: str = "") -> None:
            bars.update(task, completed=fraction, description=f"{name} {words}")
            show()

        return update

    try:
        yield stage
    finally:
        if shown:
            bars.stop()
