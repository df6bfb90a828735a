"""A station that runs in slices, and takes its inputs between them; without any clock or page.

The inputs alone decide what happens: `repeat` simulates a recorded drive again, bit by bit,
however it was cut into slices. A recorded drive is a folder with `scenario.yaml`, `load.npz` (what
the station knew of its load), `inputs.csv` and `log.parquet`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.analysis import InitializeParams
from pydrake.systems.framework import Context

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.progress import Progress
from drake_teleop.lab.identified_load import IdentifiedLoad, read_load
from drake_teleop.live.choices import BLEND, chosen, filled_after, known_estimate
from drake_teleop.live.external_master import MakeExternalMasterSide
from drake_teleop.live.hand import MakeLiveMasterSide
from drake_teleop.live.handing_on import hand_on
from drake_teleop.live.inputs import INPUTS, SLICE_MS, Inputs, read_inputs
from drake_teleop.live.log_beside import LogBeside
from drake_teleop.live.record import DEVICE, LOAD, SCENARIO, Record, made_by
from drake_teleop.live.steps import take_short_steps_in_contact
from drake_teleop.station.result import SimulationResult
from drake_teleop.station.scenario import LoadScenario, Scenario, replace
from drake_teleop.station.signals import LOG, SIGNALS, signal_of
from drake_teleop.station.simulation import MakeSimulator, advance, columns, read_log
from drake_teleop.station.station import GetBlock, MakeTeleopStation

#: Of a log on disk: two seconds. A longer part takes longer to copy, which a driver would notice; a
#: file of its own takes 10 ms of CPU however short it is.
_PART_ROWS = 2000
# Of a change of scales [s]. A slider that is moved changes them 60 times a second, and each ramp
# begins slowly: with longer ones nothing would happen until it rests.
_RAMP = 0.05
# The shortest step that error control may ask for [s]: a slice in contact has time for no more.
# A third-order step follows vibrations up to 1.7 / step = 1.1 kHz without exciting them; the ball
# on a leaf vibrates at up to 700 Hz.
_SHORTEST_STEP = 2.5e-4
#: By how much another channel may raise what a pressing hand feels [N].
_MOST_RISE = 0.9


def live_scenario(scenario: Scenario) -> Scenario:
    """A scenario as it is driven: without intent, task and settling time.

    Its steps are controlled, see `_Station`.
    """
    return replace(
        scenario,
        operator__intent=[],
        operator__task=None,
        simulation__settle=0.0,
        simulation__end_with_task=False,
        simulation__on_fault="continue",
        simulation__integrator="runge_kutta3",
    )


def with_all_signals(log: SimulationResult) -> SimulationResult:
    """A log with what only some stations have: a channel's signals, and contact that is detected.

    Without a channel the slave receives the command of now, and no energy is counted.
    """
    n = len(log.t)
    missing = {"pose_received": log["pose_command"], "ports": np.zeros((n, 8))}
    missing |= dict.fromkeys(("contact", "contact_at_hand"), np.zeros((n, 1)))
    values = missing | {name: log[name] for name in log.signals}
    order = [name for name in SIGNALS if name in values]
    order += [name for name in values if name not in SIGNALS]
    specs = [signal_of(name, values[name].shape[-1]) for name in order]
    return SimulationResult(log.t, {name: values[name] for name in order}, specs)


class _Station:
    """A station that runs, and what of it is spoken to.

    Args:
        scenario: of the station.
        estimate: what it knows of its load.
        load: whose noise floor it knows.
        number: of the stations of this drive, which have different noise; the first is 0.
        device: as of `Session`.
    """

    def __init__(
        self,
        scenario: Scenario,
        estimate: NDArray[np.float64] | None,
        load: IdentifiedLoad | None,
        number: int,
        *,
        device: bool,
    ) -> None:
        self.scenario = scenario
        make_master = MakeExternalMasterSide if device else MakeLiveMasterSide
        self.station = MakeTeleopStation(
            scenario,
            load_estimate=estimate,
            noise_floor=None if load is None else load.noise_floor,
            master=make_master(scenario, goes_over=number > 0),
        )
        seeded = dataclasses.replace(scenario.simulation, seed=scenario.simulation.seed + number)
        self.simulator = MakeSimulator(self.station, seeded)
        if scenario.simulation.integrator == "runge_kutta3":  # the one with error control
            take_short_steps_in_contact(self.simulator, _SHORTEST_STEP)
        self.context = self.simulator.get_mutable_context()
        self.sink = self.station.GetSubsystemByName(LOG).FindMutableLog(self.context)
        self.columns = columns(self.station)

    def block(self, name: str) -> tuple[Any, Context]:
        """A block, and its context."""
        led = self.station.GetSubsystemByName("master_side").GetSubsystemByName("led")
        inside = led.HasSubsystemNamed(name)
        found = led.GetSubsystemByName(name) if inside else GetBlock(self.station, name)
        return found, found.GetMyMutableContextFromRoot(self.context)

    def value(self, signal: str) -> NDArray[np.float64]:
        """A signal now."""
        values: NDArray[np.float64] = self.station.GetOutputPort(signal).Eval(self.context).copy()
        return values

    def open(self, closed: bool) -> None:
        """Opens or closes the clutch."""
        self.station.GetInputPort("clutch").FixValue(self.context, [float(closed)])

    def follow(self, other: _Station, channel_anew: bool) -> float:
        """Goes on where another station is; returns how long its clutch has to be open [s]."""
        anew = {"channel"} if channel_anew else set()
        if not self.scenario.load_estimator.enabled:
            anew.add("load_estimator")  # it was told something else
        hand_on(other.station, other.context, self.station, self.context, anew)
        if other.scenario.wrist_sensor != self.scenario.wrist_sensor:
            sensor, context = self.block("wrist_sensor")
            sensor.bring_up_to_date(context)
        wait = filled_after(self.scenario) if channel_anew else 0.0
        over, context = self.block("goes_over")
        felt = other.value("force_to_master")
        over.Begin(context, self.context.get_time() + wait, BLEND, felt)
        if channel_anew:
            over.Limit(context, _MOST_RISE + float(np.linalg.norm(felt[:3])))
        grips = other.scenario.operator.hand, self.scenario.operator.hand
        if grips[0] != grips[1]:
            hand, context = self.block("live_hand")
            hand.Hold(context, *grips)
        if not channel_anew:
            return 0.0
        name = "pose_command" if other.scenario.is_direct else "pose_received"
        command = other.value(name)
        scaling, context = self.block("kinematic_scaling")
        scaling.Open(context, command)
        if not self.scenario.is_direct:
            channel, context = self.block("channel")
            side = self.station.GetSubsystemByName("slave_side")
            pose = side.GetOutputPort("pose_slave").Eval(side.GetMyContextFromRoot(self.context))
            channel.Begin(context, command, pose, wait)
        return wait + BLEND


class Session:
    """A running station with a hand that is led.

    Attributes:
        scenario: that is driven, as `live_scenario` makes it.
        inputs: that hold now.
        ms: simulated time since the start [ms].

    Args:
        scenario: to drive.
        load: what the station knows of its load; None if it learns it.
        log: a folder for the log; None keeps it in memory, until `news` has told of it.
        record: where scenario, load and inputs go to; None for nowhere.
        device: whether the inputs' place is that of a haptic device, and not what a hand wants.
    """

    def __init__(
        self,
        scenario: Scenario,
        load: IdentifiedLoad | None = None,
        *,
        log: Path | None = None,
        record: Path | None = None,
        device: bool = False,
    ) -> None:
        self.scenario, self._load, self._device = scenario, load, device
        self.inputs, self.ms = Inputs.of(scenario), 0
        self._start = np.array(scenario.master.position)
        self._stations, self._seen, self._fills_ms = 1, 0, 0
        estimate = None if load is None else load.estimate
        self._now = _Station(scenario, estimate, load, 0, device=device)
        self._record: Record | None = None
        if record is not None:
            self._record = Record(record, scenario, load, self.inputs, device=device)
        self._on_disk: LogBeside | None = None
        if log is not None:
            self._on_disk = LogBeside(log, self._now.simulator, 0.0, with_all_signals)
        self._earlier: list[SimulationResult] = []
        self._now.simulator.Initialize()

    def apply(self, inputs: Inputs) -> None:
        """Sets the inputs from now on, and records them if they are others.

        Raises:
            DrakeTeleopError: if there is no such station; then nothing has changed.
        """
        before = self.inputs
        if inputs == before:
            return
        if inputs.station != before.station:
            self._change(inputs)
        self.inputs = inputs
        if inputs.target != before.target:
            hand, context = self._now.block("live_hand")
            hand.Lead(context, inputs.pose(self._start))
        if inputs.clutch != before.clutch or inputs.station != before.station:
            self._now.open(bool(inputs.clutch) and self.ms >= self._fills_ms)
        if inputs.scales != before.scales:
            scaling, context = self._now.block("force_scaling")
            scaling.SetScales(context, **inputs.scales, duration=_RAMP)
        if self._record is not None:
            self._record.write(self.ms, inputs)

    def _change(self, inputs: Inputs) -> None:
        """Goes on with another station."""
        scenario = chosen(self.scenario, self._load, inputs)
        scenario.check()
        estimate = known_estimate(self.scenario, self._load, scenario)
        station = _Station(scenario, estimate, self._load, self._stations, device=self._device)
        filled = station.follow(self._now, inputs.channel != self.inputs.channel)
        if filled:
            self._fills_ms = self.ms + math.ceil(1e3 * filled)
        if self._on_disk is not None:
            self._on_disk.take()
            self._on_disk.follow(station.simulator)
        else:
            self._earlier.append(self._rows())
        station.simulator.Initialize(InitializeParams(suppress_initialization_events=True))
        station.sink.Clear()  # the row of now, which the other station has recorded
        self._now, self._seen, self._stations = station, 0, self._stations + 1

    @property
    def filling(self) -> bool:
        """Whether the clutch is open because a new channel is not filled yet."""
        return self.ms < self._fills_ms

    def advance(self, ms: int = SLICE_MS) -> None:
        """Simulates the next `ms` milliseconds."""
        end = self.ms + ms
        if self.ms < self._fills_ms <= end:
            self._advance_to(self._fills_ms)
            self._now.open(bool(self.inputs.clutch))
        self._advance_to(end)
        if self._on_disk is not None and self._on_disk.waiting() >= _PART_ROWS:
            self._on_disk.take()
            self._seen = 0

    def _advance_to(self, ms: int) -> None:
        self.ms = ms
        # A product, as Drake's event times are: see `simulate`.
        advance(self._now.simulator, 1e-3 * ms)

    def news(self) -> dict[str, NDArray[np.float64]]:
        """The rows of the log since the last call: (n, k) by signal, and "t" (n,) [s].

        What was not recorded is forgotten. Call it at least once a second.
        """
        sink, seen = self._now.sink, self._seen
        data, times = sink.data()[:, seen:].T.copy(), sink.sample_times()[seen:]
        found = {name: data[:, part] for name, part in self._now.columns.items()}
        found["t"] = times.copy()
        self._seen += len(times)
        if self._on_disk is None:
            sink.Clear()
            self._seen = 0
            self._earlier.clear()
        return found

    def pressed(self) -> float:
        """The calculated contact force of the log's last row, at the hand [N]; 0 if unknown."""
        part, sink = self._now.columns.get("contact_wrench_S"), self._now.sink
        if part is None or not sink.num_samples():
            return 0.0
        force = sink.data()[part.start : part.start + 3, -1]
        return self.inputs.scales["force_scale"] * math.sqrt(float(force @ force))

    def stylus(self) -> Inputs:
        """The inputs of a hand that takes hold of the stylus where it is, without pulling."""
        return self.inputs.held_at(self._now.value("pose_master"), self._start)

    def force(self) -> NDArray[np.float64]:
        """(6,) what a device shall display now [N, N m]."""
        return self._now.value("force_to_master")

    def kept_back(self) -> float:
        """What another channel has brought, and the hand does not feel until it eases off [N]."""
        if self._stations == 1:
            return 0.0
        over, context = self._now.block("goes_over")
        return float(over.kept_back(context))

    def keep(self) -> None:
        """Brings everything until now to the disk; the session may go on."""
        if self._record is not None:
            self._record.write(self.ms, self.inputs)
        if self._on_disk is not None:
            self._on_disk.keep()
            self._on_disk.finish()

    def _rows(self) -> SimulationResult:
        return with_all_signals(read_log(self._now.simulator, 0.0))

    def log(self) -> SimulationResult:
        """What is in memory of the log."""
        parts = [*self._earlier, self._rows()]
        values = {name: np.concatenate([p[name] for p in parts]) for name in parts[0].signals}
        t = np.concatenate([part.t for part in parts])
        return SimulationResult(t, values, parts[0].specs)

    def close(self) -> None:
        """Ends the record; that of a drive that never began is removed."""
        record, self._record = self._record, None
        try:
            if record is not None:
                record.close(self.ms, self.inputs)
        finally:
            if record is None or self.ms:
                self.keep()


@dataclass(frozen=True, eq=False)
class Drive:
    """A recorded drive.

    Attributes:
        scenario: that was driven, as long as it was.
        load: what the station knew of its load.
        changes: of the inputs, with their times [ms]; the last is the end.
        device: whether a haptic device was its hand.
        folder: of the recording.
    """

    scenario: Scenario
    load: IdentifiedLoad | None
    changes: Sequence[tuple[int, Inputs]]
    device: bool = False
    folder: Path = Path()

    def repeat(self, progress: Progress, log: Path | None = None) -> SimulationResult:
        """Simulate the drive again, see the function `repeat`."""
        return repeat(self, progress, log)


def read_drive(folder: str | Path) -> Drive:
    """Reads the folder of a recorded drive.

    Raises:
        DrakeTeleopError: if it is none, or naming what in it cannot be used.
    """
    folder = Path(folder)
    scenario = LoadScenario(folder / SCENARIO)
    changes = read_inputs(folder / INPUTS, made_by(scenario))
    load = read_load(folder / LOAD)
    known = load is None or (load.estimate.shape == (16,) and np.isfinite(load.estimate).all())
    if not known or (load is None and (folder / LOAD).exists()):
        raise DrakeTeleopError("is damaged, or no load of a drive", where=str(folder / LOAD))
    driven = replace(scenario, simulation__duration=1e-3 * changes[-1][0])
    return Drive(driven, load, changes, (folder / DEVICE).exists(), folder)


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
    session = Session(drive.scenario, drive.load, log=log, device=drive.device)
    end = drive.changes[-1][0]
    for ms, inputs in drive.changes:
        while session.ms < ms:
            session.advance(min(slice_ms, ms - session.ms))
            progress(session.ms / end)
        session.apply(inputs)
    session.close()
    return session.log() if log is None else SimulationResult.scan_parquet(log)
