"""Running a station: simulate, and get named signals back."""

from __future__ import annotations

import gc
from collections.abc import Callable
from pathlib import Path

import numpy as np
from pydrake.common import RandomGenerator
from pydrake.systems.analysis import ResetIntegratorFromFlags, Simulator
from pydrake.systems.framework import Diagram

from drake_teleop.common.errors import DrakeTeleopError, expect
from drake_teleop.common.fault import MEANINGS, Fault
from drake_teleop.common.progress import Progress, show_progress
from drake_teleop.common.quantities import check_ranges
from drake_teleop.common.writing import remove_log
from drake_teleop.station.operator.decision import DONE
from drake_teleop.station.result import SimulationResult
from drake_teleop.station.scenario import Simulation
from drake_teleop.station.signals import LOG, signal_of

# In milliseconds; long enough to keep progress cheap, short enough to look alive.
_PROGRESS_STEP = 20
# A part of a log on disk: some seconds of a station, some MB.
_PART_ROWS = 8192


def simulate(
    diagram: Diagram,
    simulation: Simulation,
    *,
    progress: bool | Progress = True,
    log: str | Path | None = None,
) -> SimulationResult:
    """Runs a station through its settling time and its duration.

    Args:
        diagram: a station, as `MakeTeleopStation` makes it.
        simulation: duration, settling time, integrator and seed.
        progress: whether a bar is shown if it takes longer than a second; or what is called with
            the fraction done, 0 to 1.
        log: a folder that the log goes to while the station runs, in parts of some seconds
            (`SimulationResult.scan_parquet`): a long run then needs no more memory than a short
            one. What was recorded before Ctrl-C or an error is in it, and all but the last part
            if the process is killed. A log that is there already is replaced.

    Returns:
        The recorded signals; t = 0 is the end of the settling time. With `log` they are read
        when they are asked for.

    Raises:
        DrakeTeleopError: if an argument cannot be used, a joint of the slave leaves its range,
            the folder holds other files, or at a fault (`Simulation.on_fault`).
    """
    expect(Diagram, diagram, "diagram", "make one: MakeTeleopStation(scenario)")
    expect(Simulation, simulation, "simulation", "pass scenario.simulation")
    check_ranges(simulation, "simulation")
    expect((str, Path, type(None)), log, "log", "give a folder")
    if isinstance(progress, bool):
        with show_progress(progress, after=1.0) as stage:
            return simulate(diagram, simulation, progress=stage("Simulate"), log=log)
    simulator = MakeSimulator(diagram, simulation)
    end = simulation.settle + simulation.duration
    on_disk = None if log is None else LogOnDisk(Path(log), simulator, simulation.settle)
    stops, rows = simulation.on_fault == "stop", 0
    simulator.Initialize()
    try:
        # Products, as Drake's event times are: what differs by rounding alone would be a step of
        # its own, of 1e-17 s, with samples that are due at its start or at its end.
        milliseconds = np.arange(_PROGRESS_STEP, 1e3 * end - 1, _PROGRESS_STEP)
        for time in np.append(1e-3 * milliseconds, end):
            advance(simulator, time)
            if stops:
                rows = _stop_at_fault(simulator, simulation.settle, rows)
            if on_disk is not None and on_disk.waiting() >= _PART_ROWS:
                on_disk.take()
                rows = 0
            over = simulation.end_with_task and _task_is_over(simulator)
            progress(1.0 if over else time / end)
            if over:
                break
    finally:
        if on_disk is not None:
            on_disk.take()
    if log is not None:
        return SimulationResult.scan_parquet(log)
    return read_log(simulator, simulation.settle)


def _task_is_over(simulator: Simulator) -> bool:
    station = simulator.get_system()
    if not station.HasOutputPort("task_state"):
        return False
    return bool(station.GetOutputPort("task_state").Eval(simulator.get_context())[DONE] != 0.0)


def _stop_at_fault(simulator: Simulator, start: float, rows: int) -> int:
    """Looks at what was recorded after so many rows; returns how many there are now.

    Raises:
        DrakeTeleopError: for the first fault among them.
    """
    station = simulator.get_system()
    log = station.GetSubsystemByName(LOG).FindLog(simulator.get_context())
    for name, column in columns(station).items():
        if name not in ("fault", "fault_at_hand"):
            continue
        for k in np.flatnonzero(log.data()[column][0, rows:])[:1] + rows:
            what = MEANINGS[Fault(int(log.data()[column][0, k]))]
            raise DrakeTeleopError(
                f"at {log.sample_times()[k] - start:.3f} s {what}",
                where="simulation.on_fault",
                remedy="set it to continue, and the run goes on in its safe state",
            )
    return int(log.num_samples())


def columns(station: Diagram) -> dict[str, slice]:
    """Where the station's signals stand in its log, by name."""
    ports = [station.get_output_port(index) for index in range(station.num_output_ports())]
    ends = np.cumsum([port.size() for port in ports])
    return {p.get_name(): slice(e - p.size(), e) for p, e in zip(ports, ends, strict=True)}


class LogOnDisk:
    """Moves the log of a running station into a folder of parts.

    Args:
        folder: of the log; one that is there is replaced.
        simulator: of the station.
        start: the time that is called 0 [s].
        form: brings the rows into a form that all parts of the log have.
    """

    def __init__(
        self,
        folder: Path,
        simulator: Simulator,
        start: float,
        form: Callable[[SimulationResult], SimulationResult] = lambda rows: rows,
    ) -> None:
        remove_log(folder)
        self._folder, self._start, self._rows, self._form = folder, start, 0, form
        self.follow(simulator)

    def follow(self, simulator: Simulator) -> None:
        """The next rows are of this one; those of the last one have been taken."""
        self._simulator = simulator
        sink = simulator.get_system().GetSubsystemByName(LOG)
        self._sink = sink.FindMutableLog(simulator.get_mutable_context())

    def waiting(self) -> int:
        """The rows that are in memory."""
        return int(self._sink.num_samples())

    def take(self) -> None:
        """Writes them as the next part and forgets them.

        After an interrupt anywhere in here it may be called once more: that replaces the part by
        the same rows, or has none to write.
        """
        part = self._read()
        self._write(part)
        self._sink.Clear()
        self._rows += len(part.t)

    def keep(self) -> None:
        """Writes them, and keeps them: the next `take` writes the same part with more rows."""
        self._write(self._read())

    def _write(self, part: SimulationResult) -> None:
        part.write_part(self._folder, self._rows)

    def _read(self) -> SimulationResult:
        return self._form(read_log(self._simulator, self._start))


def MakeSimulator(diagram: Diagram, simulation: Simulation) -> Simulator:
    """A simulator with the scenario's integrator, its random sources seeded, at t = 0."""
    context = diagram.CreateDefaultContext()
    diagram.SetRandomContext(context, RandomGenerator(simulation.seed))
    simulator = Simulator(diagram, context)
    ResetIntegratorFromFlags(simulator, simulation.integrator, simulation.max_step)
    if simulation.integrator == "runge_kutta3":  # the one with error control
        simulator.get_mutable_integrator().set_target_accuracy(simulation.accuracy)
    return simulator


def advance(simulator: Simulator, time: float) -> None:
    """`simulator.AdvanceTo(time)` without Python's cyclic garbage collector.

    The blocks make no cycles, but thousands of short-lived arrays, each of which brings the
    collector's next round nearer: 7 % of the time.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        simulator.AdvanceTo(time)
    finally:
        if was_enabled:
            gc.enable()


def read_log(simulator: Simulator, start: float) -> SimulationResult:
    """The recorded signals from `start` [s] on, with t = 0 there."""
    diagram = simulator.get_system()
    log = diagram.GetSubsystemByName(LOG).FindLog(simulator.get_context())
    t = log.sample_times() - start
    kept = t > -1e-9
    data = log.data().T[kept]
    signals = {name: data[:, column] for name, column in columns(diagram).items()}
    if "sample_time" in signals:
        signals["sample_time"] -= start
    specs = [signal_of(name, values.shape[1]) for name, values in signals.items()]
    return SimulationResult(t[kept], signals, specs)
