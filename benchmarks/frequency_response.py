"""How well does the linearised Diagram predict the nonlinear station?

The operator's intent is a multi-sine; the sensor has all its noise. Measured responses are compared
with those of the linearisation: vertically, in free motion for several sigma, and pressing on a
leaf. The load is known exactly. Times are thread CPU time.

    python benchmarks/frequency_response.py [--json FILE]
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drake_teleop.lab.analysis.frequency_response import (
    MultiSine,
    StationResponse,
    measure_frequency_response,
)
from drake_teleop.lab.analysis.linearization import linearize_station, network_delay_periods
from drake_teleop.lab.analysis.one_axis import Complex
from drake_teleop.lab.analysis.task_direction import TaskDirection, task_direction
from drake_teleop.lab.identification import slave_arm
from drake_teleop.station.environment.sheet_spring import SheetSpring
from drake_teleop.station.operator.operator import MinimumJerk
from drake_teleop.station.scenario import LoadScenario, Scenario, replace

Array = NDArray[np.float64]

_UP = (0.0, 0.0, 1.0)
_GAP, _DEPTH = 0.03, 0.03  # m, distance from tip to leaf; depth of the press
_RATIOS = (
    ("hand_force", "hand_velocity"),
    ("displayed_force", "hand_velocity"),
    ("tool_velocity", "hand_velocity"),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="file for the figures")
    arguments = parser.parse_args()
    figures: dict[str, float] = {}
    for friction in (0.0, 1.0):
        for sigma in (0.0, 0.5, 1.0, 1.5):
            name = f"sigma {sigma:g}{', with friction' if friction else ''}"
            figures |= _compared(name, _scenario(sigma, friction), MultiSine())
    for ideal in (True, False):
        pressing = replace(_scenario(0.0, 0.0), sheet_spring=_leaf(), wrist_sensor__ideal=ideal)
        name = f"pressing, {'ideal' if ideal else 'noisy'} sensor"
        figures |= _compared(
            name, pressing, MultiSine(lowest=3.0, velocity=0.1, periods=5), -_GAP - _DEPTH
        )
    for name, figure in figures.items():
        print(f"{name:80s} {figure:10.5f}")
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=2) + "\n")


def predict_frequency_response(
    scenario: Scenario,
    task: TaskDirection,
    omega: Array,
    *,
    load_estimate: Array | None = None,
    displacement: Sequence[float] = (0.0, 0.0, 0.0),
) -> StationResponse:
    """Return the spectra at omega (n,) [rad/s] that the linearised Diagram predicts.

    They are for a unit force; other arguments: see `linearize`.
    """
    system = linearize_station(scenario, load_estimate=load_estimate, displacement=displacement)
    first = system.inputs.index("hand_wrench.x")
    pushed = system.frequency_response(omega)[:, :, first : first + 6] @ task.hand

    def along(port: str, direction: Array) -> Complex:
        row = system.outputs.index(f"{port}.x")
        return (pushed[:, row : row + 6] @ direction)[None]

    _, backward = network_delay_periods(scenario)
    delay_factor = np.exp(-1j * np.asarray(omega) * system.dt * backward)
    spectra = {
        # Unit force in place of the intent, plus the operator's reaction.
        "hand_force": 1 + along("operator_wrench", task.hand),
        "hand_velocity": along("twist_master", task.hand),
        "displayed_force": delay_factor * along("wrench_B", task.hand),
        "tool_velocity": along("twist_slave", task.tool),
    }
    return StationResponse(omega, spectra, scenario.force_scaling.force_scale)


def _scenario(sigma: float, friction: float) -> Scenario:
    scenario = LoadScenario("free_motion_force")
    coulomb = [friction * value for value in scenario.master.friction.coulomb]
    return replace(
        scenario,
        force_scaling__sigma=sigma,
        operator__grip="medium",
        master__friction=dataclasses.replace(scenario.master.friction, coulomb=coulomb),
    )


def _leaf() -> SheetSpring:
    position = [0.55, 0.0, 0.45 - 0.2 - _GAP]
    return SheetSpring(position=position, length=0.12, width=0.05, thickness=0.0015)


def _compared(
    name: str, scenario: Scenario, excitation: MultiSine, reach: float = 0.0
) -> dict[str, float]:
    estimate = np.concatenate([np.zeros(6), slave_arm(scenario).phi_load])
    if not scenario.wrist_sensor.ideal:
        estimate[:6] = scenario.wrist_sensor.offset
    displacement = (0.0, 0.0, reach)
    task = task_direction(scenario, _UP, displacement=displacement)
    started = time.thread_time()
    response = measure_frequency_response(
        scenario, task, excitation, load_estimate=estimate, approach=_approach(scenario, reach)
    )
    figures = {f"{name}: measured in, s": time.thread_time() - started}
    started = time.thread_time()
    predicted = predict_frequency_response(
        scenario, task, response.omega, load_estimate=estimate, displacement=displacement
    )
    figures[f"{name}: predicted in, s"] = time.thread_time() - started
    if not reach:
        figures[f"{name}: apparent mass, kg"] = response.apparent_mass()
    for output, input_ in _RATIOS:
        if output == "displayed_force" and not reach and not scenario.force_scaling.sigma:
            continue  # without load there is no force
        ratio = response.response(output, input_) / predicted.response(output, input_)
        label = f"{name}: {output} / {input_}"
        figures[f"{label}, magnitude, %"] = 100 * np.abs(np.abs(ratio) - 1).max()
        figures[f"{label}, phase, deg"] = np.degrees(np.abs(np.angle(ratio))).max()
        figures[f"{label}, coherence"] = response.coherence(output, input_).min()
    return figures


def _approach(scenario: Scenario, reach: float) -> list[MinimumJerk]:
    """Return an intent that leaves the tip at `reach` [m] against the hand's spring."""
    if not reach or scenario.sheet_spring is None:
        return []
    force = scenario.force_scaling.force_scale * scenario.sheet_spring.stiffness * _DEPTH
    target = reach - force / scenario.operator.hand.stiffness
    return [MinimumJerk(t_start=0.1, duration=0.8, translation=[0.0, 0.0, target])]


if __name__ == "__main__":
    main()
