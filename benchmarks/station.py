"""What does the whole station cost over its bare plant?

Bare plant: the same arm, tool and integrator step with a constant torque, nothing around it.
Both run interleaved in this process; times are thread CPU time, so a busy machine matters little.

    python benchmarks/station.py [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from pathlib import Path

from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from drake_teleop.scenario import LoadScenario, Scenario, Simulation, replace
from drake_teleop.simulation import MakeSimulator, advance
from drake_teleop.slave.plant import AddSlavePlant
from drake_teleop.station import MakeTeleopStation

_SPAN = 0.1  # simulated seconds a turn
_TURNS = 7


def make_bare(scenario: Scenario, step: float) -> Simulator:
    """Arm and tool under the torque that holds them at the start."""
    builder = DiagramBuilder()
    slave = AddSlavePlant(builder, scenario.slave.position, None)
    diagram = builder.Build()
    fixed_step = Simulation(integrator=scenario.simulation.integrator, max_step=step)
    simulator = MakeSimulator(diagram, fixed_step)
    context = slave.plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    slave.plant.get_actuation_input_port().FixValue(context, holding_torque(slave.plant, context))
    simulator.Initialize()
    return simulator


def holding_torque(plant: MultibodyPlant, context) -> list[float]:  # type: ignore[no-untyped-def]
    return list(-plant.CalcGravityGeneralizedForces(context))


def make_station(scenario: Scenario) -> Simulator:
    """The station of a scenario, moving (past its settling time)."""
    simulator = MakeSimulator(MakeTeleopStation(scenario), scenario.simulation)
    simulator.Initialize()
    simulator.AdvanceTo(scenario.simulation.settle)
    return simulator


def measure(simulators: dict[str, Simulator]) -> dict[str, float]:
    """CPU seconds a simulated second of each, median of interleaved turns."""
    spent: dict[str, list[float]] = {name: [] for name in simulators}
    for _ in range(_TURNS):
        for name, simulator in simulators.items():
            start = time.thread_time()
            advance(simulator, simulator.get_context().get_time() + _SPAN)
            spent[name].append((time.thread_time() - start) / _SPAN)
    return {name: statistics.median(times) for name, times in spent.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="write the figures here")
    arguments = parser.parse_args()
    free, contact = LoadScenario("free_motion_force"), LoadScenario("contact_transition")
    step = 1 / free.rates.sensor_hz
    stations = {
        "bare": make_bare(free, step),
        "free_motion": make_station(free),
        "contact": make_station(contact),
        "free_motion_joint_control_10_khz": make_station(
            replace(free, rates__joint_control_hz=10000.0)
        ),
        "free_motion_sensor_2_khz": make_station(replace(free, rates__sensor_hz=2000.0)),
    }
    cost = measure(stations)
    figures = {"bare_us_per_step": cost["bare"] * step * 1e6}
    for name in list(cost)[1:]:
        figures[f"{name}_over_bare"] = cost[name] / cost["bare"]
        figures[f"{name}_real_time_factor"] = 1 / cost[name]
    for name, figure in figures.items():
        print(f"{name:50s} {figure:8.3f}")
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
