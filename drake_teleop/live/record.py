"""The folder of a recorded drive, while it is driven."""

from __future__ import annotations

import dataclasses
import hashlib
import os
from contextlib import suppress
from importlib.metadata import version
from io import TextIOWrapper
from pathlib import Path

from drake_teleop.common.version import __version__
from drake_teleop.common.writing import make_folder, naming, write_text
from drake_teleop.lab.identified_load import IdentifiedLoad, write_load
from drake_teleop.live.inputs import INPUTS, Inputs, header, row
from drake_teleop.station.scenario import Scenario
from drake_teleop.station.scenario_reference import write_scenario

LOAD, SCENARIO = "load.npz", "scenario.yaml"
#: If this file exists, the hand's place in the inputs is that of a device.
DEVICE = "device.txt"


def made_by(scenario: Scenario) -> dict[str, str]:
    """Return what the motion of a drive depends on besides its inputs, by name.

    Versions, and a digest of the files that the scenario names, such as models.
    """
    digest, left = hashlib.sha256(), [dataclasses.asdict(scenario)]
    while left:
        value = left.pop()
        if isinstance(value, (dict, list)):
            left.extend(value.values() if isinstance(value, dict) else value)
        elif isinstance(value, str) and os.path.isabs(value) and os.path.isfile(value):
            digest.update(Path(value).read_bytes())
    versions = {"drake_teleop": __version__, "drake": version("drake")}
    return versions | {"files": digest.hexdigest()[:12]}


class Record:
    """The folder of a drive without its log.

    Args:
        folder: absent, or without a drive.
        scenario, load, device: as of `Session`.
        inputs: at the start.

    Raises:
        CannotWrite: if there is a drive, or no room.
    """

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
        self._folder, path, self._last = folder, folder / INPUTS, ""
        with naming(path):  # never that of another drive
            self._file: TextIOWrapper = path.open("x", encoding="utf-8", newline="\n")
        try:
            write_scenario(folder / SCENARIO, scenario)
            if device:
                write_text(folder / DEVICE, "x to rz of inputs.csv are the places of a device.\n")
            if load is not None:
                write_load(folder / LOAD, load)
            self._append(header(made_by(scenario)))
            self.write(0, inputs)
        except BaseException:
            self._remove()
            raise

    def write(self, ms: int, inputs: Inputs) -> None:
        """Records a change at once: it outlives the process."""
        line = row(ms, inputs)
        if line != self._last:
            self._append(line)
            self._last = line

    def _append(self, line: str) -> None:
        with naming(Path(self._file.name)):
            self._file.write(line)
            self._file.flush()

    def close(self, ms: int, inputs: Inputs) -> None:
        """Write the end of the drive; remove the record of a drive that never began."""
        if not ms:
            return self._remove()
        self.write(ms, inputs)
        with naming(Path(self._file.name)):
            self._file.close()

    def _remove(self) -> None:
        with suppress(OSError):
            self._file.close()
        with suppress(OSError):  # a file of somebody else is in the folder
            for name in (INPUTS, SCENARIO, LOAD, DEVICE):
                (self._folder / name).unlink(missing_ok=True)
            self._folder.rmdir()
