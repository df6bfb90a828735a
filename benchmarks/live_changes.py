"""Does a driven station jump when network and method change under a pressing tool?

    python benchmarks/live_changes.py [--methods A,B] [--networks A,B] [--depth 95] [--json FILE]

The hand of `touch` (firm grip, JR3) has a target `depth` mm below its start and presses on the
leaf,
without network and method. Then both change to a method over a network, and back. The figures are
the jump of the slave's command, the later displacement of the arm, and the increase of the
displayed force.
Baseline: none over the ideal network, where only the station is exchanged.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from drake_teleop.lab.identification import slave_arm
from drake_teleop.lab.identified_load import IdentifiedLoad, identified_load
from drake_teleop.live.inputs import choice_names
from drake_teleop.live.scenarios import channel_fill_time_s, live_scenario, scenario_of_inputs
from drake_teleop.live.session import Session
from drake_teleop.station.scenario import LoadScenario, Scenario
from drake_teleop.station.slave.arm import forward_kinematics

AFTER = 0.7  # s


class Driven:
    """Drive whose log is kept, slice by slice."""

    def __init__(self, scenario: Scenario, load: IdentifiedLoad) -> None:
        self.scenario, self.load = scenario, load
        self.session = Session(scenario, load)
        self.inputs, self._arm = self.session.inputs, slave_arm(scenario)
        self.rows: list[dict[str, np.ndarray]] = []

    def go(self, seconds: float, **changes: int) -> None:
        """Drive for a time with changed inputs."""
        self.inputs, self.rows = self.inputs.with_changes(changes), []
        end = self.session.ms + round(1e3 * seconds)
        while self.session.ms < end:
            self.session.apply_inputs(self.inputs)
            self.session.advance()
            self.rows.append(self.session.new_rows())

    def signal(self, name: str, instead: str = "") -> np.ndarray:
        return np.concatenate([rows[name if name in rows else instead] for rows in self.rows])

    def tool(self) -> np.ndarray:
        """Return the sensor's origin (n, 3) in W [m]."""
        R_WS, places = np.empty((3, 3)), []
        for q in self.signal("slave_state")[:, : self._arm.num_joints]:
            places.append(np.empty(3))
            forward_kinematics(self._arm.table, q, R_WS, places[-1])
        return np.array(places)

    def change(self, seconds: float, **changes: int) -> dict[str, float]:
        """Return the figures of a change in contact, relative to the state before it."""
        self.go(0.01)
        was = (
            self.signal("pose_received", "pose_command")[-1, 4:],
            self.tool()[-1],
            np.linalg.norm(self.signal("force_to_master")[-1, :3]),
        )
        self.go(seconds, **changes)
        felt = np.linalg.norm(self.signal("force_to_master")[:, :3], axis=1)
        command = self.signal("pose_received", "pose_command")[:, 4:]
        return {
            "felt_before_N": float(was[2]),
            "command_jumps_mm": 1e3 * float(np.linalg.norm(command[0] - was[0])),
            "arm_moves_mm": 1e3 * float(np.linalg.norm(self.tool() - was[1], axis=1).max()),
            "felt_rises_N": float(felt.max() - was[2]),
            "felt_falls_N": float(was[2] - felt.min()),
            "felt_steps_N": float(np.abs(np.diff(np.append(was[2], felt))).max()),
        }


def measured(driven: Driven, z: int, network: int, method: int) -> dict[str, float]:
    """Return the figures of one network and method."""
    still = driven.inputs.with_changes({"network": network, "method": method})
    fills = channel_fill_time_s(scenario_of_inputs(driven.scenario, driven.load, still))
    figures = driven.change(fills + AFTER, network=network, method=method)
    driven.go(0.8 + fills, z=z)  # at rest, with no packet on its way
    back = driven.change(0.8, network=0, method=0)
    return figures | {f"back.{name}": value for name, value in back.items()}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    networks = [name for name in choice_names()["network"][1:] if name != "custom"]
    parser.add_argument("--methods", default=",".join(choice_names()["method"]))
    parser.add_argument("--networks", default=",".join(networks))
    parser.add_argument(
        "--depth", type=float, default=95.0, help="depth of the hand's target [mm] (default: 95)"
    )
    parser.add_argument("--json", type=Path, help="file for the figures")
    options = parser.parse_args()
    figures: dict[str, Any] = {}
    scenario = live_scenario(LoadScenario("touch"))
    load, z = identified_load(scenario), round(-100 * options.depth)
    for method in options.methods.split(","):
        for network in options.networks.split(","):
            driven = Driven(scenario, load)
            driven.go(1.0, z=z)
            pair = choice_names()["network"].index(network), choice_names()["method"].index(method)
            row = measured(driven, z, *pair)
            figures |= {f"{method}.{network}.{name}": round(x, 4) for name, x in row.items()}
            print(
                f"{method:13} {network:14}",
                *(f"{name} {x:.3g}" for name, x in row.items()),
                flush=True,
            )
            if options.json is not None:
                options.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
