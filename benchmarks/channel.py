"""How much does a passivity method cost in the station, over the same network without one?

The stations are in free motion over `internet`, so that all take the same steps (in contact, the
methods bounce differently). They run interleaved in this process; times are thread CPU time.

    python benchmarks/channel.py [--json FILE]
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from drake_teleop.lab.reproduction.reproduce import (
    MakeSettledStationSimulator,
    cpu_time_per_simulated_second,
)
from drake_teleop.station.channel.channel import Channel
from drake_teleop.station.passivity.methods import METHODS, PassivityConfig
from drake_teleop.station.scenario import LoadScenario, replace


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="file for the figures")
    arguments = parser.parse_args()
    direct = LoadScenario("free_motion_force")
    stations = {"direct": MakeSettledStationSimulator(direct)}
    for method in METHODS:
        over = replace(
            direct, channel=Channel(network="internet"), passivity=PassivityConfig(method=method)
        )
        stations[method] = MakeSettledStationSimulator(over)
    cost = cpu_time_per_simulated_second(stations)
    figures = {name: cost[name] / cost["none"] for name in cost}
    print("cost of the whole station over that without a method on the same network")
    for name, figure in figures.items():
        print(f"{name:20s} {figure:6.3f}")
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
