"""Log of a drive, written by a separate thread: a part takes as long as three slices."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from pydrake.systems.analysis import Simulator

from drake_teleop.station.result import SimulationResult
from drake_teleop.station.simulation import LogOnDisk


class LogBeside(LogOnDisk):
    """`LogOnDisk` that waits for the disk only in `finish` and before the next part."""

    def __init__(
        self,
        folder: Path,
        simulator: Simulator,
        start: float,
        form: Callable[[SimulationResult], SimulationResult],
    ) -> None:
        super().__init__(folder, simulator, start, form)
        self._thread = ThreadPoolExecutor(1, "log of a drive")
        self._writing: Future[None] = self._thread.submit(_load)

    def finish(self) -> None:
        """Wait until all rows taken so far are on the disk.

        Raises:
            DrakeTeleopError: if they cannot be written.
        """
        self._writing.result()

    def _write(self, part: SimulationResult) -> None:
        self.finish()
        self._writing = self._thread.submit(part.write_part, self._folder, self._rows)


def _load() -> None:
    """Import polars on the thread, which takes 0.1 s."""
    import polars  # noqa: F401
