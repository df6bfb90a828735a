"""Folder of a recorded live session: scenario, load, inputs and log."""

from __future__ import annotations

import hashlib
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from importlib import import_module
from importlib.metadata import version
from io import TextIOWrapper
from pathlib import Path
from typing import Any

from drake_teleop.common.files import (
    DRIVE_INPUTS_FILE_NAME,
    make_folder,
    wrap_write_errors,
    write_text,
)
from drake_teleop.common.version import __version__
from drake_teleop.lab.identified_load import IdentifiedLoad, write_cached_load
from drake_teleop.live.inputs import Inputs, csv_header, csv_row
from drake_teleop.station.result import SimulationResult
from drake_teleop.station.scenario import Scenario, referenced_files
from drake_teleop.station.scenario_reference import write_scenario
from drake_teleop.station.simulation import LogOnDisk

LOAD_FILE, SCENARIO_FILE = "load.npz", "scenario.yaml"
#: Marker file: the positions in the inputs are those of a haptic device.
HAPTIC_DEVICE_FILE = "device.txt"


def versions_and_file_digest(scenario: Scenario) -> dict[str, str]:
    """Return versions of drake_teleop and Drake, and a digest of the scenario's files."""
    digest = hashlib.sha256()
    for file in referenced_files(scenario):
        digest.update(file.read_bytes())
    versions = {"drake_teleop": __version__, "drake": version("drake")}
    return versions | {"files": digest.hexdigest()[:12]}


class SessionRecord:
    """Writer of scenario, load and inputs of a live session into a folder."""

    def __init__(
        self,
        folder: Path,
        scenario: Scenario,
        load: IdentifiedLoad | None,
        inputs: Inputs,
        *,
        device: bool,
    ) -> None:
        make_folder(folder)
        self._folder, path, self._last = folder, folder / DRIVE_INPUTS_FILE_NAME, ""
        with wrap_write_errors(path):  # mode x never overwrites another recorded drive
            self._file: TextIOWrapper = path.open("x", encoding="utf-8", newline="\n")
        try:
            write_scenario(folder / SCENARIO_FILE, scenario)
            if device:
                write_text(folder / HAPTIC_DEVICE_FILE, "A haptic device moved the hand.\n")
            if load is not None:
                write_cached_load(folder / LOAD_FILE, load)
            self._append_line(csv_header(versions_and_file_digest(scenario)))
            self.write(0, inputs)
        except BaseException:
            self._remove_record_files()
            raise

    def write(self, ms: int, inputs: Inputs) -> None:
        """Write time [ms] and inputs, if these have changed."""
        line = csv_row(ms, inputs)
        if line != self._last:
            self._append_line(line)
            self._last = line

    def _append_line(self, line: str) -> None:
        with wrap_write_errors(Path(self._file.name)):
            self._file.write(line)
            self._file.flush()

    def close(self, ms: int, inputs: Inputs) -> None:
        """Write the end time [ms] and close the files; remove a record of 0 ms."""
        if not ms:
            return self._remove_record_files()
        self.write(ms, inputs)
        with wrap_write_errors(Path(self._file.name)):
            self._file.close()

    def _remove_record_files(self) -> None:
        with suppress(OSError):
            self._file.close()
        with suppress(OSError):  # the folder contains other files
            for name in (DRIVE_INPUTS_FILE_NAME, SCENARIO_FILE, LOAD_FILE, HAPTIC_DEVICE_FILE):
                (self._folder / name).unlink(missing_ok=True)
            self._folder.rmdir()


class BackgroundLog(LogOnDisk):
    """Log that a thread writes; only `wait_until_written` and the next write wait for it."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._thread = ThreadPoolExecutor(1, "log of a drive")
        self._writing: Future[Any] = self._thread.submit(import_module, "polars")

    def wait_until_written(self) -> None:
        self._writing.result()

    def _write_log_part(self, part: SimulationResult) -> None:
        self.wait_until_written()
        self._writing = self._thread.submit(part.write_part, self._folder, self._rows)
