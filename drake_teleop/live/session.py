"""A station that runs in slices, and takes its inputs between them; without any clock or page.

The inputs alone decide what happens: `repeat` simulates a recorded drive again, bit by bit,
however it was cut into slices. A recorded drive is a folder with `scenario.yaml`, `load.npz` (what
the station knew of its load), `inputs.csv` and `log.parquet`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from io import TextIOWrapper
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drake_teleop.errors import DrakeTeleopError
from drake_teleop.identified_load import IdentifiedLoad, read_load, write_load
from drake_teleop.live.hand import MakeLiveMasterSide
from drake_teleop.live.inputs import INPUTS, SLICE_MS, Inputs, header, read_inputs, row
from drake_teleop.pages.progress import Progress
from drake_teleop.result import SimulationResult
from drake_teleop.scenario import LoadScenario, Scenario, replace
from drake_teleop.scenario_reference import commented
from drake_teleop.signals import LOG
from drake_teleop.simulation import LogOnDisk, MakeSimulator, advance, columns, read_log
from drake_teleop.station import GetBlock, MakeTeleopStation
from drake_teleop.writing import make_folder, naming, write_text

#: Of a log on disk: a second. A longer part takes longer to write, which a driver would notice.
_PART_ROWS = 1000
# Of a change of scales [s]. A slider that is moved changes them 60 times a second, and each ramp
# begins slowly: with longer ones nothing would happen until it rests.
_RAMP = 0.05
_LOAD, _SCENARIO = "load.npz", "scenario.yaml"


def live_scenario(scenario: Scenario) -> Scenario:
    """A scenario as it is driven: without intent, task and settling time, with steps of 125 us.

    Steps of one length take the same time wherever the tool is.
    """
    return replace(
        scenario,
        operator__intent=[],
        operator__task=None,
        simulation__settle=0.0,
        simulation__end_with_task=False,
        simulation__on_fault="continue",
        simulation__integrator="runge_kutta2",
        simulation__max_step=min(scenario.simulation.max_step, 1.25e-4),
    )


class Session:
    """A running station with a hand that is led.

    Attributes:
        scenario: of the station, as `live_scenario` makes it.
        inputs: that hold now.
        ms: simulated time since the start [ms].

    Args:
        scenario: to drive.
        load: what the station knows of its load; None if it learns it.
        log: a folder for the log; None keeps it in memory, until `news` has told of it.
        record: where scenario, load and inputs go to; None for nowhere.
    """

    def __init__(
        self,
        scenario: Scenario,
        load: IdentifiedLoad | None = None,
        *,
        log: Path | None = None,
        record: Path | None = None,
    ) -> None:
        self.scenario = scenario
        self.inputs, self.ms = Inputs.of(scenario), 0
        self._station = MakeTeleopStation(
            scenario,
            load_estimate=None if load is None else load.estimate,
            noise_floor=None if load is None else load.noise_floor,
            master=MakeLiveMasterSide(scenario),
        )
        self._hand = GetBlock(self._station, "live_hand")
        self._scaling = GetBlock(self._station, "force_scaling")
        self._clutch = self._station.GetInputPort("clutch")
        self._start = np.array(scenario.master.position)
        self._simulator = MakeSimulator(self._station, scenario.simulation)
        self._context = self._simulator.get_mutable_context()
        self._sink = self._station.GetSubsystemByName(LOG).FindMutableLog(self._context)
        self._columns = columns(self._station)
        self._seen = 0
        self._record = None if record is None else _Record(record, scenario, load, self.inputs)
        self._on_disk = None if log is None else LogOnDisk(log, self._simulator, 0.0)
        self._simulator.Initialize()

    def apply(self, inputs: Inputs) -> None:
        """Sets the inputs from now on, and records them if they are others."""
        before, self.inputs = self.inputs, inputs
        if inputs == before:
            return
        if inputs.target != before.target:
            context = self._hand.GetMyMutableContextFromRoot(self._context)
            self._hand.Lead(context, inputs.pose(self._start))
        if inputs.clutch != before.clutch:
            self._clutch.FixValue(self._context, [float(inputs.clutch)])
        if inputs.scales != before.scales:
            context = self._scaling.GetMyMutableContextFromRoot(self._context)
            self._scaling.SetScales(context, **inputs.scales, duration=_RAMP)
        if self._record is not None:
            self._record.write(self.ms, inputs)

    def advance(self, ms: int = SLICE_MS) -> None:
        """Simulates the next `ms` milliseconds."""
        self.ms += ms
        # A product, as Drake's event times are: see `simulate`.
        advance(self._simulator, 1e-3 * self.ms)
        if self._on_disk is not None and self._on_disk.waiting() >= _PART_ROWS:
            self._on_disk.take()
            self._seen = 0

    def news(self) -> dict[str, NDArray[np.float64]]:
        """The rows of the log since the last call: (n, k) by signal, and "t" (n,) [s].

        What was not recorded is forgotten. Call it at least once a second.
        """
        data, times = self._sink.data()[:, self._seen :], self._sink.sample_times()[self._seen :]
        found = {name: data[part].T.copy() for name, part in self._columns.items()}
        found["t"] = times.copy()
        self._seen += len(times)
        if self._on_disk is None:
            self._sink.Clear()
            self._seen = 0
        return found

    def stylus(self) -> Inputs:
        """The inputs of a hand that takes hold of the stylus where it is, without pulling."""
        pose = self._station.GetOutputPort("pose_master").Eval(self._context)
        return self.inputs.held_at(pose, self._start)

    def keep(self) -> None:
        """Brings everything until now to the disk; the session may go on."""
        if self._record is not None:
            self._record.write(self.ms, self.inputs)
        if self._on_disk is not None:
            self._on_disk.keep()

    def log(self) -> SimulationResult:
        """What is in memory of the log."""
        return read_log(self._simulator, 0.0)

    def close(self) -> None:
        """Ends the record."""
        self.keep()
        if self._record is not None:
            self._record.close()


class _Record:
    """The folder of a drive, but for the log."""

    def __init__(
        self, folder: Path, scenario: Scenario, load: IdentifiedLoad | None, inputs: Inputs
    ) -> None:
        make_folder(folder)
        write_text(folder / _SCENARIO, commented(scenario))
        path = folder / INPUTS
        with naming(folder / _LOAD):
            (folder / _LOAD).unlink(missing_ok=True)
        if load is not None:
            write_load(folder / _LOAD, load)
        with naming(path):
            self._file: TextIOWrapper = path.open("w", encoding="utf-8", newline="\n")
        self._last = ""
        self._append(header())
        self.write(0, inputs)

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

    def close(self) -> None:
        self._file.close()


@dataclass(frozen=True, eq=False)
class Drive:
    """A recorded drive.

    Attributes:
        scenario: that was driven, as long as it was.
        load: what the station knew of its load.
        changes: of the inputs, with their times [ms]; the last is the end.
    """

    scenario: Scenario
    load: IdentifiedLoad | None
    changes: Sequence[tuple[int, Inputs]]


def read_drive(folder: str | Path) -> Drive:
    """Reads the folder of a recorded drive.

    Raises:
        DrakeTeleopError: if it is none, or naming what in it cannot be used.
    """
    folder = Path(folder)
    changes = read_inputs(folder / INPUTS)
    scenario = LoadScenario(folder / _SCENARIO)
    load = read_load(folder / _LOAD)
    known = load is None or (load.estimate.shape == (16,) and np.isfinite(load.estimate).all())
    if not known or (load is None and (folder / _LOAD).exists()):
        raise DrakeTeleopError("is damaged, or no load of a drive", where=str(folder / _LOAD))
    return Drive(replace(scenario, simulation__duration=1e-3 * changes[-1][0]), load, changes)


def repeat(
    drive: Drive, progress: Progress, log: Path | None = None, slice_ms: int = SLICE_MS
) -> SimulationResult:
    """Simulates a recorded drive again; the log is the same, bit by bit.

    Args:
        drive: as `read_drive` reads it.
        progress: called with the fraction done.
        log: a folder that the log goes to; None for one in memory.
        slice_ms: what is simulated at once, between changes [ms].
    """
    session = Session(drive.scenario, drive.load, log=log)
    end = drive.changes[-1][0]
    for ms, inputs in drive.changes:
        while session.ms < ms:
            session.advance(min(slice_ms, ms - session.ms))
            progress(session.ms / end)
        session.apply(inputs)
    session.close()
    return session.log() if log is None else SimulationResult.scan_parquet(log)
