"""CPU time of a station and of its bare plant (arm and tool under constant torque)."""

from __future__ import annotations

import time
from collections.abc import Mapping

from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from drake_teleop.common.progress import UpdateProgress
from drake_teleop.lab.identification import true_load
from drake_teleop.station.scenario import Scenario, Simulation
from drake_teleop.station.simulation import MakeSimulator, advance_without_garbage_collection
from drake_teleop.station.slave.plant import AddSlavePlant
from drake_teleop.station.station import MakeTeleopStation

_NUM_TIMINGS, _SIMULATED_TIME_PER_TIMING_S = 11, 0.1  # simulated time of one measurement [s]


def MakeBarePlantSimulator(scenario: Scenario) -> Simulator:
    """Return a simulator of arm and tool under constant holding torque."""
    builder = DiagramBuilder()
    slave = AddSlavePlant(builder, scenario.slave, None)
    step = 1 / scenario.rates.sensor_hz
    simulation = Simulation(integrator="runge_kutta2", max_step=step)
    simulator = MakeSimulator(builder.Build(), simulation)
    context = slave.plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    gravity = slave.plant.CalcGravityGeneralizedForces(context)
    torque = -slave.plant.GetVelocitiesFromArray(slave.instance, gravity)
    slave.plant.get_actuation_input_port(slave.instance).FixValue(context, list(torque))
    simulator.Initialize()
    return simulator


def MakeSettledStationSimulator(scenario: Scenario) -> Simulator:
    """Return a simulator of the station, advanced to the end of its settling time."""
    # The value of the estimate does not change the cost.
    station = MakeTeleopStation(scenario, load_estimate=true_load(scenario))
    simulator = MakeSimulator(station, scenario.simulation)
    simulator.Initialize()
    advance_without_garbage_collection(simulator, scenario.simulation.settle)
    return simulator


def cpu_time_per_simulated_second(
    simulators: Mapping[str, Simulator], *, progress: UpdateProgress = lambda done: None
) -> dict[str, float]:
    """Return the least CPU time per simulated second of each simulator."""
    times_s: dict[str, list[float]] = {name: [] for name in simulators}
    for k in range(_NUM_TIMINGS):
        for name, simulator in simulators.items():
            start = time.thread_time()
            end = simulator.get_context().get_time() + _SIMULATED_TIME_PER_TIMING_S
            advance_without_garbage_collection(simulator, end)
            times_s[name].append((time.thread_time() - start) / _SIMULATED_TIME_PER_TIMING_S)
        progress((k + 1) / _NUM_TIMINGS)
    return {name: min(times) for name, times in times_s.items()}
