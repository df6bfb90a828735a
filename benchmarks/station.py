"""What does the station cost over its bare plant, and how fast and accurate is it?

The bare plant is arm and tool under a constant torque, without environment, in steps of 125 us by
the second-order Runge-Kutta method. All stations run interleaved in this process; times are thread
CPU time, so a busy machine matters little. "contact" is the mean over the whole of the shipped
scenario, in which the tool bounces on the leaf; "pressed" stays on it. "in_slot" is the tool as a
peg
that slides down into the slot and stays there, with up to four contacts at once. The cost of
`ledger` is over the same station with the method `none`, both over the network `lan`.

    python benchmarks/station.py [--ledger] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
from pydrake.systems.analysis import Simulator

from drake_teleop.lab.reproduction.reproduce import (
    MakeBarePlantSimulator,
    MakeSettledStationSimulator,
    cpu_time_per_simulated_second,
)
from drake_teleop.station.channel.channel import Channel
from drake_teleop.station.operator.operator import MinimumJerk
from drake_teleop.station.passivity.methods import PassivityConfig
from drake_teleop.station.scenario import LoadScenario, Scenario, replace
from drake_teleop.station.simulation import advance_without_garbage_collection, simulate
from drake_teleop.station.station import GetBlock, MakeTeleopStation

_TIGHT = {"simulation__max_step": 4e-5, "simulation__accuracy": 1e-10}
_REPEATS, _PIECES = 5, 16
_TOGETHER = 12.0  # simulated seconds, long enough for two processes to start at once


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--ledger", action="store_true", help="measure only the cost of ledger")
    parser.add_argument("--json", type=Path, help="file for the figures")
    arguments = parser.parse_args()
    free, contact = LoadScenario("free_motion_force"), LoadScenario("contact_transition")
    if arguments.ledger:
        finish(ledger_over_none(free, contact), arguments.json)
        return
    slot = replace(LoadScenario("peg_in_slot"), simulation__settle=1.1, simulation__duration=0.8)
    figures = (
        costs(free, contact, slot)
        | ledger_over_none(free, contact)
        | rates(free)
        | {"two_processes_throughput": two_processes()}
    )
    scenarios = {"free_motion": free, "contact": contact, "in_slot": slot}
    scenarios["contact_joint_control_10_khz"] = joint_control_10_khz(contact)
    for name, scenario in scenarios.items():
        figures[f"{name}_wrench_against_reaction_port_n"] = against_the_port(scenario)
        figures[f"{name}_wrench_against_tight_run_n"] = against_a_tight_run(scenario)
    old = {"simulation__integrator": "runge_kutta2", "simulation__max_step": 1.25e-4}
    figures["contact_wrench_with_runge_kutta2_125_us_n"] = against_a_tight_run(contact, **old)
    finish(figures, arguments.json)


def finish(figures: dict[str, float], file: Path | None) -> None:
    """Print the figures, and write them if `file` is given."""
    for name, figure in figures.items():
        print(f"{name:50s} {figure:10.4g}")
    if file:
        file.write_text(json.dumps(figures, indent=2) + "\n")


def pressed(contact: Scenario) -> Scenario:
    """Return a scenario in which the tool moves onto the leaf during settling, and presses."""
    return replace(
        contact,
        simulation__settle=1.0,
        operator__intent=[MinimumJerk(t_start=0.1, duration=0.6, translation=[0.0, 0.0, -0.084])],
    )


def joint_control_10_khz(scenario: Scenario) -> Scenario:
    """Return the scenario with the paper's rate of the joint control."""
    return replace(scenario, rates__joint_control_hz=10000.0)


def costs(free: Scenario, contact: Scenario, slot: Scenario) -> dict[str, float]:
    """Return CPU time over that of the bare plant; each piece counts at its fastest repeat."""
    scenarios = {
        "free_motion": free,
        "contact": contact,
        "pressed": pressed(contact),
        "in_slot": slot,
        "free_motion_joint_control_10_khz": joint_control_10_khz(free),
        "contact_joint_control_10_khz": joint_control_10_khz(contact),
    }
    makes = {name: partial(MakeSettledStationSimulator, s) for name, s in scenarios.items()}
    whole = fastest(
        makes | {"bare": partial(MakeBarePlantSimulator, free)}, contact.simulation.duration
    )
    figures = {"bare_us_per_step": whole["bare"] / free.rates.sensor_hz * 1e6}
    for name in scenarios:
        figures[f"{name}_over_bare"] = whole[name] / whole["bare"]
    return figures


def ledger_over_none(free: Scenario, contact: Scenario) -> dict[str, float]:
    """Return CPU time with `ledger` over that with `none`, on the same network.

    The cases are free motion, and a press on a leaf of 0.5 kN/m, on which both are at rest. On the
    shipped leaf, six times as stiff, the tool oscillates with `none` and rests with `ledger`, and
    sticking friction takes the integrator three times as many steps.
    """
    duration, figures = contact.simulation.duration, {}
    soft = replace(pressed(contact), sheet_spring__thickness=8e-4)
    for name, scenario in (("free_motion", free), ("pressed_softly", soft)):
        makes = {
            method: partial(
                MakeSettledStationSimulator,
                replace(
                    scenario,
                    channel=Channel(network="lan"),
                    passivity=PassivityConfig(method=method),
                ),
            )
            for method in ("none", "ledger")
        }
        whole = fastest(makes, duration)
        figures[f"{name}_ledger_over_none"] = whole["ledger"] / whole["none"]
    return figures


def fastest(makes: dict[str, Callable[[], Simulator]], duration: float) -> dict[str, float]:
    """Return the CPU time of a simulated second; each piece counts at its fastest repeat."""
    best = {name: np.full(_PIECES, np.inf) for name in makes}
    for _ in range(_REPEATS):
        simulators = {name: make() for name, make in makes.items()}
        for piece in range(_PIECES):
            for name, simulator in simulators.items():
                spent = _cpu(simulator, duration / _PIECES)
                best[name][piece] = min(best[name][piece], spent)
    return {name: pieces.sum() / duration for name, pieces in best.items()}


def _cpu(simulator: Simulator, span: float) -> float:
    start = time.thread_time()
    advance_without_garbage_collection(simulator, simulator.get_context().get_time() + span)
    return time.thread_time() - start


def rates(free: Scenario) -> dict[str, float]:
    """Return simulated over CPU time, by the sensor's rate."""
    sensors = {
        "8_khz": free,
        "2_khz": replace(free, rates__sensor_hz=2000.0),
        "1_khz": replace(free, rates__sensor_hz=1000.0, wrist_sensor__bandwidth_hz=400.0),
    }
    cost = cpu_time_per_simulated_second(
        {name: MakeSettledStationSimulator(s) for name, s in sensors.items()}
    )
    return {f"real_time_factor_sensor_{name}": 1 / seconds for name, seconds in cost.items()}


def two_processes() -> float:
    """Return how much more two processes simulate than one, by the clock."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(2, mp_context=context) as pool:
        list(pool.map(_run_alone, [0.1, 0.1]))  # imports are done and compiled code is cached
        alone = pool.submit(_run_alone, _TOGETHER).result()
        together = list(pool.map(_run_alone, [_TOGETHER] * 2))
    return 2 * alone / max(together)


def _run_alone(seconds: float) -> float:
    simulator = MakeSettledStationSimulator(LoadScenario("free_motion_force"))
    start = time.perf_counter()
    advance_without_garbage_collection(simulator, simulator.get_context().get_time() + seconds)
    return time.perf_counter() - start


def against_the_port(scenario: Scenario) -> float:
    """Return the largest difference of the ideal sensor's force from the plant's reaction port."""
    scenario = replace(scenario, wrist_sensor__ideal=True)
    simulator = MakeSettledStationSimulator(scenario)
    station, context = simulator.get_system(), simulator.get_context()
    plant, sensor = (GetBlock(station, name) for name in ("slave_plant", "wrist_sensor"))
    # The load on the body that carries S; each part has a weld.
    indices = list(plant.GetJointIndices())
    S = plant.GetFrameByName(scenario.slave.sensor_frame)
    welds = [
        (place, joint.frame_on_child())
        for place, joint in enumerate(map(plant.get_joint, indices))
        if joint.parent_body().index() == S.body().index()
    ]
    largest, period = 0.0, 1 / scenario.rates.hand_hz
    start = round(context.get_time() / period)
    for k in range(1, int(scenario.simulation.duration / period)):
        advance_without_garbage_collection(simulator, (start + k) * period)
        of_plant = plant.GetMyContextFromRoot(context)
        forces = plant.get_reaction_forces_output_port().Eval(of_plant)
        R_SW = S.CalcPoseInWorld(of_plant).rotation().inverse()
        port = sum(
            (R_SW @ frame.CalcPoseInWorld(of_plant).rotation()) @ forces[place].translational()
            for place, frame in welds
        )
        simulator.AdvancePendingEvents()  # the sensor's sample at this time
        sample = sensor.GetMyContextFromRoot(context).get_discrete_state_vector().value()
        largest = max(largest, float(np.abs(sample[:3] - port).max()))
    return largest


def against_a_tight_run(scenario: Scenario, **changes: object) -> float:
    """Return the largest difference of the force from a run with accuracy 1e-10."""
    # sigma = 1, so that no load is needed.
    scenario = replace(scenario, wrist_sensor__ideal=True, force_scaling__sigma=1.0)
    wrenches = []
    for variant in (replace(scenario, **changes), replace(scenario, **_TIGHT)):
        station = MakeTeleopStation(variant)
        wrenches.append(simulate(station, variant.simulation)["measured_wrench_S"])
    return float(np.abs(wrenches[0] - wrenches[1])[:, :3].max())


if __name__ == "__main__":
    main()
