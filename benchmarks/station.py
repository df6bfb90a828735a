"""What does the whole station cost over its bare plant?

Bare plant: the same arm, tool and integrator step with a constant torque, nothing around it.
Both run interleaved in this process; times are thread CPU time, so a busy machine matters little.

    python benchmarks/station.py [--json FILE]
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from drake_teleop.experiments.speed import MakeBarePlant, MakeMovingStation, cpu_seconds
from drake_teleop.scenario import LoadScenario, replace


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="write the figures here")
    arguments = parser.parse_args()
    free, contact = LoadScenario("free_motion_force"), LoadScenario("contact_transition")
    cost = cpu_seconds(
        {
            "bare": MakeBarePlant(free),
            "free_motion": MakeMovingStation(free),
            "contact": MakeMovingStation(contact),
            "free_motion_joint_control_10_khz": MakeMovingStation(
                replace(free, rates__joint_control_hz=10000.0)
            ),
            "free_motion_sensor_2_khz": MakeMovingStation(replace(free, rates__sensor_hz=2000.0)),
        }
    )
    figures = {"bare_us_per_step": cost["bare"] / free.rates.sensor_hz * 1e6}
    for name in list(cost)[1:]:
        figures[f"{name}_over_bare"] = cost[name] / cost["bare"]
        figures[f"{name}_real_time_factor"] = 1 / cost[name]
    for name, figure in figures.items():
        print(f"{name:50s} {figure:8.3f}")
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
