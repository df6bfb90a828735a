"""Simulation of a station, which returns its recorded signals."""

from __future__ import annotations

import gc
from collections.abc import Callable
from pathlib import Path

import numpy as np
from pydrake.common import RandomGenerator
from pydrake.systems.analysis import ResetIntegratorFromFlags, Simulator
from pydrake.systems.framework import Diagram

from drake_teleop.common.blocks import FAULT_WARNINGS, Fault
from drake_teleop.common.config import check_all_field_values
from drake_teleop.common.errors import DrakeTeleopError, expect_type
from drake_teleop.common.files import remove_log
from drake_teleop.common.progress import UpdateProgress, show_progress
from drake_teleop.station.operator.decision import OUTCOME_INDEX
from drake_teleop.station.result import SimulationResult
from drake_teleop.station.scenario import Simulation
from drake_teleop.station.signals import LOG_BLOCK_NAME, SLIDING_JOINTS_ATTRIBUTE, signal_with_size

_PROGRESS_PERIOD_MS = 20
# Rows of a part of a log on disk: some seconds, some MB.
_LOG_ROWS_PER_PART = 8192


def simulate(
    diagram: Diagram,
    simulation: Simulation | None = None,
    *,
    progress: bool | UpdateProgress = True,
    log: str | Path | None = None,
) -> SimulationResult:
    """Simulate a station for its settling time and duration.

    Args:
        diagram: station from `MakeTeleopStation`.
        simulation: duration, settling time, integrator and seed.
        progress: True shows a progress bar after one second; or a function of the completed
            fraction.
        log: folder for a log in parts, written during the run so that memory does not grow. After
            Ctrl-C or an error it contains all samples. An old log is replaced.

    Returns:
        The recorded signals; t = 0 at the end of the settling time. With `log`, signals are read
            from the disk at each access.

    Raises:
        DrakeTeleopError: if a joint of the slave leaves its range, the folder contains other
            files, or a fault occurs with `simulation.on_fault` "stop".
    """
    expect_type(Diagram, diagram, "diagram", "make one: MakeTeleopStation(scenario)")
    if simulation is None:
        what = "the argument is missing"
        raise DrakeTeleopError(what, where="simulation", remedy="pass scenario.simulation")
    expect_type(Simulation, simulation, "simulation", "pass scenario.simulation")
    check_all_field_values(simulation, "simulation")
    expect_type((str, Path, type(None)), log, "log", "give a folder")
    if isinstance(progress, bool):
        with show_progress(progress, after=1.0) as stage:
            return simulate(diagram, simulation, progress=stage("Simulate"), log=log)
    simulator = MakeSimulator(diagram, simulation)
    end = simulation.settle + simulation.duration
    on_disk = None if log is None else LogOnDisk(Path(log), simulator, simulation.settle)
    stops, rows = simulation.on_fault == "stop", 0
    task = log_slices_of_signals(diagram).get("task_state") if simulation.end_with_task else None
    logged = diagram.GetSubsystemByName(LOG_BLOCK_NAME).FindLog(simulator.get_context())
    simulator.Initialize()
    try:
        # Products, as Drake's event times are: a rounding difference would be a step of 1e-17 s.
        milliseconds = np.arange(_PROGRESS_PERIOD_MS, 1e3 * end - 1, _PROGRESS_PERIOD_MS)
        for time in np.append(1e-3 * milliseconds, end):
            advance_without_garbage_collection(simulator, time)
            if stops:
                rows = _check_log_rows_for_faults(simulator, simulation.settle, rows)
            # The newest row counts: without the outcome in the log, the task would seem unfinished.
            over = task is not None and logged.data()[task][OUTCOME_INDEX, -1:].any()
            if on_disk is not None and on_disk.num_unwritten_rows() >= _LOG_ROWS_PER_PART:
                on_disk.write_and_clear_rows()
                rows = 0
            progress(1.0 if over else time / end)
            if over:
                break
    finally:
        if on_disk is not None:
            on_disk.write_and_clear_rows()
    if log is not None:
        return SimulationResult.scan_parquet(log)
    return read_recorded_signals(simulator, simulation.settle)


def _check_log_rows_for_faults(simulator: Simulator, start: float, num_checked_rows: int) -> int:
    station = simulator.get_system()
    log = station.GetSubsystemByName(LOG_BLOCK_NAME).FindLog(simulator.get_context())
    for name, column in log_slices_of_signals(station).items():
        if name not in ("fault", "fault_at_hand"):
            continue
        for k in np.flatnonzero(log.data()[column][0, num_checked_rows:])[:1] + num_checked_rows:
            what = FAULT_WARNINGS[Fault(int(log.data()[column][0, k]))]
            what = f"the run stops at {log.sample_times()[k] - start:.3f} s by a fault: {what}"
            remedy = "correct the cause, or set on_fault: continue to run on in the safe state"
            raise DrakeTeleopError(what, where="simulation.on_fault", remedy=remedy)
    return int(log.num_samples())


def log_slices_of_signals(station: Diagram) -> dict[str, slice]:
    """Return, by signal name, the slice of the signal's components in a row of the log."""
    ports = [station.get_output_port(index) for index in range(station.num_output_ports())]
    ends = np.cumsum([port.size() for port in ports])
    return {p.get_name(): slice(e - p.size(), e) for p, e in zip(ports, ends, strict=True)}


class LogOnDisk:
    """Writer that moves the log of a running station into a folder of parts.

    Args:
        folder: folder of the log; an old log is replaced.
        start: simulation time that becomes t = 0 [s].
        convert: function that changes each part before it is written.
    """

    def __init__(
        self,
        folder: Path,
        simulator: Simulator,
        start: float,
        convert: Callable[[SimulationResult], SimulationResult] = lambda rows: rows,
    ) -> None:
        remove_log(folder)
        self._folder, self._start, self._rows, self._convert = folder, start, 0, convert
        self.switch_simulator(simulator)

    def switch_simulator(self, simulator: Simulator) -> None:
        self._simulator = simulator
        sink = simulator.get_system().GetSubsystemByName(LOG_BLOCK_NAME)
        self._sink = sink.FindMutableLog(simulator.get_mutable_context())

    def num_unwritten_rows(self) -> int:
        return int(self._sink.num_samples())

    def write_and_clear_rows(self) -> None:
        """Write the rows in memory as the next part of the log, then clear them in memory."""
        rows = self.write_and_keep_rows()
        self._sink.Clear()
        self._rows += rows

    def write_and_keep_rows(self) -> int:
        """Write the rows in memory as a part that the next write replaces; return their number."""
        part = self._convert(read_recorded_signals(self._simulator, self._start))
        self._write_log_part(part)
        return len(part.t)

    def _write_log_part(self, part: SimulationResult) -> None:
        # `BackgroundLog` replaces this by a thread that writes.
        part.write_part(self._folder, self._rows)


def MakeSimulator(diagram: Diagram, simulation: Simulation) -> Simulator:
    context = diagram.CreateDefaultContext()
    diagram.SetRandomContext(context, RandomGenerator(simulation.seed))
    simulator = Simulator(diagram, context)
    ResetIntegratorFromFlags(simulator, simulation.integrator, simulation.max_step)
    if simulation.integrator == "runge_kutta3":  # the one with error control
        simulator.get_mutable_integrator().set_target_accuracy(simulation.accuracy)
    return simulator


def advance_without_garbage_collection(simulator: Simulator, time: float) -> None:
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        simulator.AdvanceTo(time)
    finally:
        if was_enabled:
            gc.enable()


def read_recorded_signals(simulator: Simulator, start: float) -> SimulationResult:
    """Return the recorded signals from time `start` [s] on; `start` becomes t = 0."""
    diagram = simulator.get_system()
    log = diagram.GetSubsystemByName(LOG_BLOCK_NAME).FindLog(simulator.get_context())
    t = log.sample_times() - start
    kept = t > -1e-9
    data = log.data().T[kept]
    signals = {name: data[:, column] for name, column in log_slices_of_signals(diagram).items()}
    if "sample_time" in signals:
        signals["sample_time"] -= start
    sliding = getattr(diagram, SLIDING_JOINTS_ATTRIBUTE, {})
    specs = [
        signal_with_size(name, values.shape[1], sliding.get(name == "master_state", ()))
        for name, values in signals.items()
    ]
    return SimulationResult(t[kept], signals, specs)
