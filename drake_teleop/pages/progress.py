"""Progress bars, one for each named stage of a command."""

from __future__ import annotations

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
def progress_bars(quiet: bool) -> Iterator[Stage]:
    """Bars on the terminal for as long as the context lasts; nothing at all if `quiet`."""
    if quiet:
        yield silent
        return
    from rich import progress as rich_progress

    columns = (
        rich_progress.TextColumn("{task.description:34s}"),
        rich_progress.BarColumn(),
        rich_progress.TaskProgressColumn(),
        rich_progress.TimeElapsedColumn(),
    )
    with rich_progress.Progress(*columns) as bars:

        def stage(name: str) -> Progress:
            task = bars.add_task(name, total=1.0)
            return lambda fraction, words="": bars.update(
                task, completed=fraction, description=f"{name} {words}"
            )

        yield stage
