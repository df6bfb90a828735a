"""Progress bars, one for each named stage of a command."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeAlias

Progress: TypeAlias = Callable[[float], None]
"""Called with the fraction done, 0 to 1."""
Stage: TypeAlias = Callable[[str], Progress]
"""Opens a stage by its name."""


def silent(name: str) -> Progress:
    """A stage that shows nothing."""
    return lambda fraction: None


@contextmanager
def progress_bars(quiet: bool) -> Iterator[Stage]:
    """Bars on the terminal for as long as the context lasts; nothing at all if `quiet`."""
    if quiet:
        yield silent
        return
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn("{task.description:34s}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
    )
    with Progress(*columns) as bars:

        def stage(name: str) -> Callable[[float], None]:
            task = bars.add_task(name, total=1.0)
            return lambda fraction: bars.update(task, completed=fraction)

        yield stage
