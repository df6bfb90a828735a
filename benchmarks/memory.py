"""Does the memory of a long simulation stay constant when its log is written to disk?

The contact of Fig. 8 is repeated. The figures are the resident memory after the first minute and at
the end, with the log written in parts. The baseline is the same station with its log in memory, for
at most two minutes. Each runs in a process of its own. It needs /proc, so Linux.

    python benchmarks/memory.py [--seconds 600] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import tempfile
import time
from pathlib import Path

import numpy as np

from drake_teleop.lab.identification import true_load
from drake_teleop.station.operator.operator import Sine
from drake_teleop.station.scenario import LoadScenario, Scenario, replace
from drake_teleop.station.simulation import simulate
from drake_teleop.station.station import MakeTeleopStation

FIRST = 60.0  # s, memory of this time does not count: compilation, buffers, caches
IN_MEMORY = 120.0  # s


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--seconds", type=float, default=600.0, help="simulated time [s], more than 60"
    )
    parser.add_argument("--json", type=Path, help="file for the figures")
    arguments = parser.parse_args()
    figures = {}
    for name, seconds in (
        ("in_memory", min(IN_MEMORY, arguments.seconds)),
        ("on_disk", arguments.seconds),
    ):
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            figures[name] = pool.apply(measure, (seconds, name == "on_disk"))
    baseline = figures["in_memory"]
    baseline["at_the_end_of_the_other_MB"] = baseline["after_60_s_MB"] + 1e-6 * (
        baseline["bytes_per_simulated_second"] * (arguments.seconds - FIRST)
    )
    for name, figure in figures.items():
        for what, value in figure.items():
            print(f"{name:10s} {what:30s} {value:12.1f}")
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=2) + "\n")


def repeated_contact(seconds: float) -> Scenario:
    """Return the movement of Fig. 8 for this time, with a touch at every lower turning point."""
    up_down = Sine(
        t_start=0.1, duration=seconds + 10, ramp=1.8, frequency=2.63, translation=[0, 0, 0.062]
    )
    return replace(
        LoadScenario("contact_transition"),
        operator__intent=[up_down],
        simulation__duration=seconds,
    )


def measure(seconds: float, on_disk: bool) -> dict[str, float]:
    """Simulate; return this process's memory after `FIRST` and at the end."""
    scenario = repeated_contact(seconds)
    station = MakeTeleopStation(scenario, load_estimate=true_load(scenario))
    start, seen = time.process_time(), {}

    def look(done: float) -> None:
        simulated = done * (seconds + scenario.simulation.settle)
        if simulated >= FIRST and "first" not in seen:
            seen["first"] = resident()
        if done == 1.0:
            seen["end"] = resident()

    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "log.parquet" if on_disk else None
        result = simulate(station, scenario.simulation, progress=look, log=log)
        contacts = np.any(result["true_contact_wrench_W"] != 0, axis=1)
        size = sum(part.stat().st_size for part in log.iterdir()) if log else 0
    return {
        "simulated_s": seconds,
        "touches": float(np.count_nonzero(np.diff(contacts.astype(int)) == 1)),
        "after_60_s_MB": seen["first"] / 1e6,
        "at_the_end_MB": seen["end"] / 1e6,
        "growth_percent": 100 * (seen["end"] / seen["first"] - 1),
        "bytes_per_simulated_second": (seen["end"] - seen["first"]) / (seconds - FIRST),
        "on_disk_MB": size / 1e6,
        "cpu_s": time.process_time() - start,
    }


def resident() -> int:
    """Return the resident memory of this process [bytes]."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return 1024 * int(line.split()[1])
    raise OSError("no VmRSS in /proc/self/status")


if __name__ == "__main__":
    main()
