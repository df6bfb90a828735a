"""Running a station: simulate, and get named signals back."""

from __future__ import annotations

import gc
from collections.abc import Callable

import numpy as np
from pydrake.common import RandomGenerator
from pydrake.systems.analysis import ResetIntegratorFromFlags, Simulator
from pydrake.systems.framework import Diagram

from drake_teleop.result import SimulationResult
from drake_teleop.scenario import Simulation
from drake_teleop.signals import LOG, SIGNALS

# Long enough to keep progress cheap, short enough to look alive.
_PROGRESS_STEP = 0.02


def simulate(
    diagram: Diagram,
    simulation: Simulation,
    *,
    progress: Callable[[float], None] | None = None,
) -> SimulationResult:
    """Runs a station through its settling time and its duration.

    Args:
        diagram: a station, as `MakeTeleopStation` makes it.
        simulation: duration, settling time, integrator and seed.
        progress: called with the fraction done, 0 to 1.

    Returns:
        The recorded signals; t = 0 is the end of the settling time.

    Raises:
        DrakeTeleopError: if a joint of the slave leaves its range.
    """
    simulator = MakeSimulator(diagram, simulation)
    end = simulation.settle + simulation.duration
    simulator.Initialize()
    for time in np.append(np.arange(_PROGRESS_STEP, end, _PROGRESS_STEP), end):
        advance(simulator, time)
        if progress is not None:
            progress(time / end)
    return read_log(simulator, simulation.settle)


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
    ports = [diagram.get_output_port(index) for index in range(diagram.num_output_ports())]
    ends = np.cumsum([port.size() for port in ports])
    columns = np.split(log.data().T[kept], ends[:-1], axis=1)
    signals = dict(zip((port.get_name() for port in ports), columns, strict=True))
    return SimulationResult(t[kept], signals, [SIGNALS[name] for name in signals])
