"""Does `ledger` meet its criteria in the whole station, over what network, leaf, hand and sigma?

`python benchmarks/ledger_in_station.py [--json FILE]` presses on a leaf as `compare-passivity` does
(`lab.comparison.whole_station`): 4 networks, 2 leaves, 3 grips, sigma 0 and 1, 48 runs. Each has
the station's noisy sensor and its identified load, or with `--ideal` an ideal sensor and the true
load. `--network`, `--leaf`, `--grip`, `--sigma` choose some, `--method` another method.
`--friction` is that of the arm's joints at the tool [N], `--damping` that of the leaf [N s/m]. The
criteria are, in the last second of the hold and at the end:

stable    at rest, within 0.5 mm peak to peak, and rotating as little
felt      displayed contact force (without the load's weight) over the scaled contact force, less
          1; the force is vertical
left      distance of the slave from the hand, 2 s after contact
energy    the least of hand and actual motion, E_act + E_0, contact and load together, for
          translation and rotation each
chatter   standard deviation of the displayed vertical force
motors    the least of hand and motors, E_mot + E_0 and the work of friction
friction  that work, at the scale of the hand's force
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid

from drake_teleop.lab.comparison.compare_passivity import base_scenario
from drake_teleop.lab.comparison.one_dof import AT_HAND, AT_MOTOR, AT_SLAVE
from drake_teleop.lab.comparison.whole_station import (
    LEAF_THICKNESSES_M,
    measures_of_press,
    press_scenario,
    start_energy,
    station_energies,
    work_of_displayed_load_wrench,
)
from drake_teleop.lab.identification import true_load
from drake_teleop.lab.identified_load import identified_load
from drake_teleop.station.channel.channel import Channel
from drake_teleop.station.environment.sheet_spring import SheetSpring
from drake_teleop.station.passivity.methods import METHODS, PassivityConfig
from drake_teleop.station.result import SimulationResult
from drake_teleop.station.scenario import Scenario, replace
from drake_teleop.station.simulation import simulate
from drake_teleop.station.slave.arm import dry_friction, jacobian
from drake_teleop.station.slave.plant import NominalSlave
from drake_teleop.station.slave.slave_config import Slave
from drake_teleop.station.station import MakeTeleopStation

NETWORKS = ("lan", "internet", "geostationary", "lunar")
GRIPS, SIGMAS = ("light", "medium", "firm"), (0.0, 1.0)
FELT, LEFT, CHATTER = 0.1, 5e-3, 0.05  # 1, m, N


@dataclasses.dataclass(frozen=True)
class Cell:
    """Figures of one run; see the module."""

    network: str
    leaf: str
    grip: str
    sigma: float
    stable: bool
    felt_error: float
    left_m: float
    energy_J: tuple[float, float]
    motors_J: float
    friction_J: float
    chatter_N: float
    hunting_m: float
    turning_rad: float
    cpu_s: float

    def missed(self) -> list[str]:
        """Return the criteria that the cell fails."""
        kept = {
            "stable": self.stable,
            "felt": abs(self.felt_error) <= FELT,
            "left": self.left_m <= LEFT,
            "energy": min(self.energy_J) >= -1e-6,
            "chatter": self.chatter_N <= CHATTER,
        }
        return [name for name, well in kept.items() if not well]


def friction_at_tool(slave: Slave, force: float) -> list[float]:
    """Return the friction (n,) [N m] of the joints for a force at the tool [N].

    It is proportional to the motor torques, and holds at the start, where the tool moves vertically
    without rotation.
    """
    nominal = NominalSlave(slave)
    J = np.empty((6, nominal.arm.num_joints))
    jacobian(nominal.arm.table, nominal.start, J)
    motors, speeds = nominal.arm.effort_limit, np.abs(np.linalg.pinv(J)[:, 2])
    return (force / (motors @ speeds) * motors).tolist()


def friction_work(result: SimulationResult, scenario: Scenario) -> NDArray[np.float64]:
    """Return the work (N,) of the joints' dry friction up to each row [J], at the slave."""
    v = np.split(result["slave_state"], 2, axis=1)[1]
    coulomb = np.broadcast_to(scenario.slave.friction or [0.0], v.shape)
    power = -(dry_friction(coulomb, v) * v).sum(axis=1)
    return cumulative_trapezoid(power, result.t, initial=0.0)


def cell(network: str, leaf: str, grip: str, sigma: float, asked: argparse.Namespace) -> Cell:
    """Run one cell."""
    base = replace(
        base_scenario("contact_transition", asked.seed),
        operator__grip=grip,
        force_scaling__sigma=sigma,
        wrist_sensor__ideal=asked.ideal,
    )
    estimate = true_load(base) if asked.ideal else identified_load(base, False).estimate
    passivity = PassivityConfig(method=asked.method)
    scenario, task = press_scenario(base, Channel(network=network), passivity, leaf)
    scenario = replace(scenario, sheet_spring__slip_speed=SheetSpring().slip_speed)
    if asked.friction > 0.0:
        # Friction stops a joint within 0.4 ms.
        scenario = replace(
            scenario,
            slave__friction=friction_at_tool(base.slave, asked.friction),
            simulation__max_step=5e-4,
        )
    if asked.damping is not None:
        sheet = scenario.sheet_spring
        ratio = asked.damping / (2 * np.sqrt(sheet.stiffness * sheet.effective_mass))
        scenario = replace(scenario, sheet_spring__damping_ratio=float(ratio))
    station = MakeTeleopStation(scenario, load_estimate=estimate)
    began = time.thread_time()
    result = simulate(station, scenario.simulation, progress=False)
    spent = time.thread_time() - began
    found = measures_of_press(result, scenario, task)
    energies = station_energies(result, scenario)
    energies[:, AT_HAND] += start_energy(scenario)
    if sigma > 0.0:
        energies[:, AT_HAND] += work_of_displayed_load_wrench(result, scenario)
    inside, at_motors = (energies[:, AT_HAND] + energies[:, k] for k in (AT_SLAVE, AT_MOTOR))
    scale = scenario.force_scaling.force_scale
    rubbed = scale * friction_work(result, scenario)
    held = (result.t >= task.release_start - task.rest_window) & (result.t < task.release_start)
    weight = sigma * scale * float(true_load(scenario)[6]) * 9.81
    contact = scale * float(result["true_contact_wrench_W"][held, 2].mean())
    felt = float(result["force_to_master"][held, 2].mean()) + weight
    return Cell(
        network,
        leaf,
        grip,
        sigma,
        stable=found.stable,
        felt_error=felt / contact - 1.0,
        left_m=abs(found.drift),
        energy_J=(float(inside[:, 0].min()), float(inside[:, 1].min())),
        motors_J=float((at_motors.sum(axis=1) + rubbed).min()),
        friction_J=float(rubbed[-1]),
        chatter_N=found.chatter,
        hunting_m=found.hunting,
        turning_rad=found.turning,
        cpu_s=spent,
    )


def print_cell(one: Cell) -> None:
    """Print a line of the table."""
    name = f"{one.network}, {one.leaf}, {one.grip}, sigma {one.sigma:g}"
    print(
        f"{name:<48}{'yes' if one.stable else 'NO':>4}{100 * one.felt_error:8.1f} %"
        f"{1e3 * one.left_m:8.2f}{one.energy_J[0]:9.4f}{one.energy_J[1]:9.4f}{one.motors_J:9.4f}"
        f"{one.friction_J:9.4f}{one.chatter_N:9.4f}"
        f"{1e3 * one.hunting_m:9.3f}{np.rad2deg(one.turning_rad):9.3f}{one.cpu_s:7.1f}"
        f"  {' '.join(one.missed())}",
        flush=True,
    )


def main(arguments: list[str] | None = None) -> int:
    """Run and print the cells; return 0 if all of them meet all criteria."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="file for the figures")
    parser.add_argument("--network", nargs="+", choices=NETWORKS, default=list(NETWORKS))
    parser.add_argument(
        "--leaf", nargs="+", choices=list(LEAF_THICKNESSES_M), default=list(LEAF_THICKNESSES_M)
    )
    parser.add_argument("--grip", nargs="+", choices=GRIPS, default=list(GRIPS))
    parser.add_argument("--sigma", nargs="+", type=float, default=list(SIGMAS))
    parser.add_argument(
        "--seed", type=int, default=0, help="seed of sensor and networks (default: 0)"
    )
    parser.add_argument("--method", choices=METHODS, default="ledger")
    parser.add_argument(
        "--ideal", action="store_true", help="use an ideal sensor and the true load"
    )
    parser.add_argument(
        "--friction", type=float, default=0.0, help="friction of the joints, at the tool [N]"
    )
    parser.add_argument(
        "--damping", type=float, help="damping of the leaf [N s/m] (default: 3 %% of critical)"
    )
    asked = parser.parse_args(arguments)
    print(
        f"{'':<48}{'rest':>4}{'felt':>10}{'left mm':>8}{'E tr J':>9}{'E rot J':>9}{'motors J':>9}"
        f"{'fric. J':>9}{'chat N':>9}"
        f"{'hunt mm':>9}{'turn deg':>9}{'CPU s':>7}  missed"
    )
    cells = []
    for case in itertools.product(asked.network, asked.leaf, asked.grip, asked.sigma):
        cells.append(cell(*case, asked))
        print_cell(cells[-1])
    missed = {name: 0 for name in ("stable", "felt", "left", "energy", "chatter")}
    for one in cells:
        for name in one.missed():
            missed[name] += 1
    counts = ", ".join(f"{name} {len(cells) - n}" for name, n in missed.items())
    print(f"of {len(cells)}: {counts}")
    if asked.json:
        rows = [dataclasses.asdict(one) for one in cells]
        figures: dict[str, Any] = {"cells": len(cells), "missed": missed, "rows": rows}
        asked.json.write_text(json.dumps(figures, indent=2) + "\n")
    return int(any(missed.values()))


if __name__ == "__main__":
    sys.exit(main())
