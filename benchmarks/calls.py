"""Is each call of the library fast enough for the station or for the waiting user?

    python benchmarks/calls.py [--json FILE]

The exit status is 1 if a call exceeds its limit. Baselines: the same function interpreted, for
calls
at every sample; one cell at a time, for grids; a second of simulation, for the linearisation. Times
are thread CPU time, the shortest of some rounds.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit

from drake_teleop.lab.analysis.cut_loop import count_unstable_multipliers, cut_loop, delay_margin
from drake_teleop.lab.analysis.linearization import linearize
from drake_teleop.lab.analysis.one_axis import OneAxis
from drake_teleop.lab.analysis.period_map import Sampling
from drake_teleop.lab.analysis.sampled_wall import passive_stiffness, stable_stiffness
from drake_teleop.lab.identification import slave_arm
from drake_teleop.load.contact.detection import MEMORY_SIZE, update_statistics
from drake_teleop.load.contact.noise_floor import NoiseFloor
from drake_teleop.station.environment.sheet_spring import SheetSpring
from drake_teleop.station.scenario import LoadScenario, replace
from drake_teleop.station.sensor.presets import PRESETS
from drake_teleop.station.sensor.sensor_chain import (
    NOISE_BLOCK_SIZE,
    WristSensorConfig,
    initialize_sensor_chain,
    read_sensor_into,
)
from drake_teleop.station.simulation import MakeSimulator, advance_without_garbage_collection
from drake_teleop.station.station import MakeTeleopStation

PERIOD = 1 / 8000  # [s], period of the sensor
N = 100  # cells of a grid in each direction
SAMPLE = 40  # cells of a grid for the baseline
#: Time limit of each call [s].
MAY_TAKE = {
    **{f"reading of {name}": 2.5e-6 for name in PRESETS},
    "detection of contact, a sample": 5e-6,
    f"delay margins, {N} x {N}": 2.0,
    f"limits of a sampled wall, {N} x {N}": 5.0,
    "linearisation of a station that presses on a leaf": 10.0,
}


def seconds(call: Callable[[], Any], rounds: int) -> float:
    """Return the shortest of some thread times [s], after a round that compiles."""
    times = []
    for _ in range(rounds + 1):
        began = time.thread_time()
        call()
        times.append(time.thread_time() - began)
    return min(times[1:])


@njit
def _read_often(constants, memory, noise, truth, reading, count):  # type: ignore[no-untyped-def]
    for _ in range(count):
        read_sensor_into(constants, memory, noise, truth, reading)


def reading(config: WristSensorConfig) -> tuple[float, float]:
    """Return the time of one sample of six joints through the sensor chain, and interpreted [s]."""
    rng = np.random.default_rng(0)
    constants, memory = initialize_sensor_chain(config, 6, PERIOD)
    noise = rng.standard_normal(NOISE_BLOCK_SIZE)
    rest = constants, memory, noise, rng.normal(size=21), np.empty(19)
    ours = seconds(lambda: _read_often(*rest, 2000), 5) / 2000
    return ours, seconds(lambda: read_sensor_into.py_func(*rest), 20)


@njit
def _detect_often(memory, wrenches, motion, parameters):  # type: ignore[no-untyped-def]
    for i in range(len(wrenches)):
        update_statistics(memory, wrenches[i], *motion, parameters, 1.0, 0.0, 0.0)


def detection() -> tuple[float, float]:
    """Return the time of all statistics of one sample at rest, and interpreted [s]."""
    noise = np.repeat([0.05, 0.002], 3)
    still = np.zeros(3)
    floor = NoiseFloor(noise, np.zeros((16, 16)), np.zeros((6, 2)), np.eye(6), np.full(6, 0.5))
    wrenches = np.random.default_rng(0).normal(size=(20_000, 6)) * noise
    motion = (np.array([0.0, 0.0, 9.81]), still, still, still)
    memory, parameters = np.zeros(MEMORY_SIZE), tuple(floor.compiled_parameters)
    ours = seconds(lambda: _detect_often(memory, wrenches, motion, parameters), 3) / len(wrenches)
    update = update_statistics.py_func
    slow = seconds(lambda: update(memory, wrenches[0], *motion, parameters, 1.0, 0.0, 0.0), 20)
    return ours, slow


def margin_grid() -> tuple[float, float]:
    """Return the time of margins and unstable multipliers over a grid, and cell by cell [s]."""

    def margins(delay: Any, stiffness: Any) -> None:
        loop = cut_loop(OneAxis(wall_stiffness=stiffness), Sampling())
        count_unstable_multipliers(loop, delay)
        delay_margin(loop)

    return grid(margins, np.linspace(0, 0.2, N), np.geomspace(100, 1e5, N))


def wall_grid() -> tuple[float, float]:
    """Return the time of passive and stable stiffness over a grid, and cell by cell [s]."""

    def limits(b: Any, B: Any) -> None:
        passive_stiffness(b, B, 1e-3)
        stable_stiffness(0.15, b, B, 1e-3)

    return grid(limits, np.linspace(0.1, 5, N), np.linspace(0, 2, N))


def grid(call: Callable[[Any, Any], None], a: Any, b: Any) -> tuple[float, float]:
    """Return the time of the call on the whole grid, and cell by cell from a sample [s]."""
    cells = np.random.default_rng(1).integers(N, size=(SAMPLE, 2))

    def some() -> None:
        for i, j in cells:
            call(float(a[i]), float(b[j]))

    return seconds(lambda: call(a[:, None], b), 1), seconds(some, 1) / SAMPLE * N * N


def linearisation() -> tuple[float, float]:
    """Return the time of linearising a station in contact, and of one simulated second [s]."""
    leaf = SheetSpring(
        position=[0.55, 0.0, 0.45 - 0.2 - 0.03], length=0.12, width=0.05, thickness=0.0015
    )
    scenario = replace(LoadScenario("free_motion_force"), sheet_spring=leaf)
    estimate = np.concatenate([np.zeros(6), slave_arm(scenario).phi_load])
    pressing = (0.0, 0.0, -0.04)
    ours = seconds(lambda: linearize(scenario, load_estimate=estimate, displacement=pressing), 1)
    station = MakeTeleopStation(scenario, load_estimate=estimate)
    return ours, seconds(
        lambda: advance_without_garbage_collection(
            MakeSimulator(station, scenario.simulation), 1.0
        ),
        1,
    )


def measure() -> dict[str, dict[str, float]]:
    """Return time, limit and time of the baseline for each call [s]."""
    calls: list[Callable[[], tuple[float, float]]] = [
        *(lambda name=name: reading(PRESETS[name]) for name in PRESETS),  # type: ignore[misc]
        detection,
        margin_grid,
        wall_grid,
        linearisation,
    ]
    rows = {}
    for (name, may_take), call in zip(MAY_TAKE.items(), calls, strict=True):
        ours, baseline = call()
        rows[name] = {"seconds": ours, "may_take": may_take, "baseline": baseline}
    return rows


def main() -> int:
    """Measure and print; return 0 if no call exceeds its limit."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="file for the figures")
    arguments = parser.parse_args()
    rows = measure()
    print(f"{'':52}{'takes':>10}{'may take':>10}{'baseline':>12}")
    for name, row in rows.items():
        print(
            f"{name:52}{row['seconds']:9.2g}s{row['may_take']:9.2g}s"
            f"{row['baseline'] / row['seconds']:10.1f} x"
        )
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")
    return 1 if any(row["seconds"] > row["may_take"] for row in rows.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
