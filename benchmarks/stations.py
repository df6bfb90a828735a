"""Do stations of other arms and devices fulfil the figures of the paper's station?

For each cell: the ideal sensor's force against the plant's reaction port; the mass from `identify`,
and the residual after elimination over the peak inertial force; the displayed device and sigma
times
the load, against (device + sigma k m_t), from forces and accelerations at 1.3 Hz; the largest
contact force, without which a wall is not tested; CPU time over the station's own bare plant, in
free motion and in contact; simulated over CPU time.

    python benchmarks/stations.py [--arms A,...] [--devices D,...] [--models DIR] [--json FILE]

Arms other than the RX90 move half as far. Those of Franka and Universal Robots are in the package
example-robot-data (the extra `bench`), or in --models, its folder of robots.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import tempfile
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from inverse_kinematics import described
from station import against_the_port, fastest

from drake_teleop.common.files import models_dir
from drake_teleop.lab.identification import slave_arm
from drake_teleop.lab.reproduction.reproduce import (
    MakeBarePlantSimulator,
    MakeSettledStationSimulator,
)
from drake_teleop.lab.run import run_scenario, summarise
from drake_teleop.station.master.data_sheets import FIGURES, LEADER_NAME, PHANTOM_NAME, Master
from drake_teleop.station.master.leader_model import Leader
from drake_teleop.station.operator.operator import Sine
from drake_teleop.station.scenario import LoadScenario, Scenario, replace
from drake_teleop.station.slave.arm import forward_kinematics
from drake_teleop.station.slave.plant import NominalSlave
from drake_teleop.station.slave.slave_config import Ball, Slave, Tool

_SIGMA, _PUSHED = 0.5, 1.3  # Hz
_DEEP = 0.005  # m, depth of the tip's lower turning point in the leaf, as in Fig. 8
_BEFORE = np.array([0.068, 0.0, -0.05])  # m, from the tip at the start to the foot of the block
_SCENARIOS = {
    "free motion": "free_motion_force",
    "wall": "contact_transition",
    "moving block": "push_block",
}
_REACH = 0.1  # m, largest displacement of the scenarios' intents from their start
_LEADERS = 0.15  # m, workspace of the leader around its home
_LEADER = Leader(
    file=str(models_dir() / "leader_arm.urdf"),
    hand_frame="hand",
    home=[0.0, -0.6, 1.9, 0.0, 0.5, 0.0],
    friction=[0.01],
)

#: Arms besides the RX90 and its copy on a rail: file and other fields.
_PEG = Tool(mass=1.5, com=[0.01, 0.0, 0.06], shapes=[Ball(0.012, [0.0, 0.0, 0.188])])
ARMS = {
    "rx90": ("", Slave()),
    "rail": ("", Slave()),
    "panda": (
        "panda_description/urdf/panda.urdf",
        Slave(sensor_frame="panda_link8", position=[0.5, 0.0, 0.45], tool=_PEG),
    ),
    "ur5": (
        "ur_description/urdf/ur5_robot.urdf",
        Slave(sensor_frame="tool0", position=[0.5, 0.1, 0.4]),
    ),
}
_RAIL = """<link name="foot"><inertial><mass>30</mass>
<inertia><ixx>1</ixx><iyy>1</iyy><izz>1</izz></inertia></inertial></link>
<joint name="rail" type="prismatic"><parent>foot</parent><child>base</child>
<axis><xyz>0 1 0</xyz><limit><lower>-0.4</lower><upper>0.4</upper><velocity>1</velocity>
<effort>4000</effort><drake:acceleration>8</drake:acceleration></limit></axis></joint>
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--arms", default=",".join(ARMS))
    parser.add_argument("--devices", default=",".join((PHANTOM_NAME, *FIGURES, LEADER_NAME)))
    parser.add_argument("--json", type=Path, help="file for the figures")
    parser.add_argument(
        "--models", type=Path, default=described(), help="example-robot-data/robots"
    )
    arguments = parser.parse_args()
    rows = []
    columns = "port N", "mass %", "left %", "felt %", "contact N", "cost", "with all", "rtf"
    print(f"{'arm':6s} {'device':20s} {'surroundings':12s}", *(f"{name:>10s}" for name in columns))
    for arm, device in product(arguments.arms.split(","), arguments.devices.split(",")):
        for surroundings, scenario in _scenarios(arm, device, arguments.models).items():
            row = figures(scenario, free=surroundings == "free motion")
            rows.append({"arm": arm, "device": device, "surroundings": surroundings} | row)
            shown = (f"{value:10.3g}" if value is not None else 10 * " " for value in row.values())
            print(f"{arm:6s} {device:20s} {surroundings:12s}", *shown, flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=2) + "\n")


def _slave(arm: str, models: Path | None) -> Slave:
    if arm == "rx90":
        return Slave()
    if arm == "rail":
        text = (models_dir() / "rx90.sdf").read_text()
        before, base, rest = text.partition('    <link name="base">')
        path = Path(tempfile.mkdtemp(prefix="drake_teleop_")) / "rail.sdf"
        path.write_text(before + _RAIL + base + rest)
        return Slave(model=str(path))
    if models is None:
        raise SystemExit("no example-robot-data: give --models or --arms rx90,rail")
    file, slave = ARMS[arm]
    return dataclasses.replace(slave, model=str(models / file))


def _scenarios(arm: str, device: str, models: Path | None) -> dict[str, Scenario]:
    """Return scenarios with the motion of the paper; small devices move less, by their scale.

    The same hand moves devices by different distances: the leaf is where the tip then comes down
    to.
    """
    scenarios, slave = {}, _slave(arm, models)
    own = 1.0 if arm == "rx90" else 0.5
    for what, name in _SCENARIOS.items():
        scenario, share = LoadScenario(name), 1.0
        if device != PHANTOM_NAME:
            size = _LEADERS if device == LEADER_NAME else min(FIGURES[device].size)
            share = min(1.0, 0.5 * size / _REACH)
        intent = [
            dataclasses.replace(move, translation=[own * share * x for x in move.translation])
            for move in scenario.operator.intent
        ]
        tip = NominalSlave(slave).p_WTip_start
        blocks = [
            dataclasses.replace(block, position=(tip + _BEFORE).tolist())
            for block in scenario.environment
        ]
        changed = replace(
            scenario,
            slave=slave,
            environment=blocks,
            master=Master(model=device, leader=_LEADER if device == LEADER_NAME else None),
            operator__intent=intent,
            kinematic_scaling__translation_scale=1 / share,
        )
        if scenario.sheet_spring is not None and (arm, device) != ("rx90", PHANTOM_NAME):
            leaf = _lowest(changed)
            leaf[2] += own * _DEEP
            changed = replace(changed, sheet_spring__position=leaf.tolist())
        scenarios[what] = changed
    return scenarios


def _lowest(scenario: Scenario) -> np.ndarray:
    """Return the lowest position of the tip without environment [m, in W]."""
    run = run_scenario(replace(scenario, sheet_spring=None), progress=False)
    slave, tips, R_WS, p_WS = NominalSlave(scenario.slave), [], np.empty((3, 3)), np.empty(3)
    for q in run.result["joint_position"]:
        forward_kinematics(slave.arm.table, q, R_WS, p_WS)
        tips.append(p_WS + R_WS @ slave.tip)
    return min(tips, key=lambda tip: tip[2])


def figures(scenario: Scenario, free: bool) -> dict[str, float | None]:
    """Return the row of one station; `felt` is in free motion only."""
    run = run_scenario(scenario, progress=False)
    summary = summarise(run)
    inertial = summary["peak_measured_force_N"]
    left = summary["residual_force_max_N"] if free else None
    makes = {
        "whole": partial(MakeSettledStationSimulator, scenario),
        "bare": partial(MakeBarePlantSimulator, scenario),
        "plant": partial(MakeBarePlantSimulator, scenario, touching=not free),
    }
    seconds = fastest(makes, scenario.simulation.duration)
    return {
        "port_N": against_the_port(scenario),
        "mass_error_percent": summary["mass_error_percent"],
        "left_percent": None if left is None else 100 * left / inertial,
        "felt_error_percent": _felt_error(scenario) if free else None,
        "contact_N": None if free else _hardest(run.result["true_contact_wrench_W"]),
        "cost_over_bare": seconds["whole"] / seconds["bare"],
        "cost_over_plant": seconds["whole"] / seconds["plant"],
        "real_time_factor": 1 / seconds["whole"],
    }


def _hardest(contact_W: np.ndarray) -> float:
    return float(np.linalg.norm(contact_W[:, :3], axis=1).max())


def _felt_error(scenario: Scenario) -> float:
    """Return the larger error [%] of the displayed mass along z: of device, or of sigma m_t k_f.

    It is from force and acceleration at one frequency; the load's share is scaled by the slave's
    motion.
    """
    found = {sigma: _pushed(scenario, sigma) for sigma in (0.0, _SIGMA)}
    device = scenario.master.device(*_hand(scenario))
    q = device.inverse_kinematics(np.array([1.0, 0.0, 0.0, 0.0, *scenario.master.position]))
    J = device.jacobian(q)
    alone = np.linalg.inv(J @ np.linalg.solve(device.mass_matrix(q), J.T))[2, 2]
    load = _SIGMA * slave_arm(scenario).phi_load[0] * scenario.force_scaling.force_scale
    (felt_0, _), (felt, follows) = found[0.0], found[_SIGMA]
    errors = felt_0.real / alone - 1, ((felt - felt_0) / follows).real / load - 1
    return 100 * float(np.abs(errors).max())


def _hand(scenario: Scenario) -> tuple[float, float]:
    return scenario.operator.hand.mass, scenario.operator.hand.inertia


def _pushed(scenario: Scenario, sigma: float) -> tuple[complex, complex]:
    """Return the hand's force over acceleration [kg], and the slave's over the master's motion."""
    changed = replace(
        scenario,
        force_scaling__sigma=sigma,
        operator__intent=[
            Sine(duration=10.0, ramp=0.5, frequency=_PUSHED, translation=[0.0, 0.0, 0.02])
        ],
        master=scenario.master.without_coulomb_friction_and_encoder_steps(),
        simulation__settle=1.5,
        simulation__duration=2 / _PUSHED,
    )
    result = run_scenario(changed, progress=False).result
    turning = np.exp(-2j * np.pi * _PUSHED * result.t[:-1])
    force, velocity, slave = (
        2 * np.mean(result[name][:-1, 2] * turning)
        for name in ("hand_wrench_E", "twist_master", "specific_force_S")
    )
    acceleration = 2j * np.pi * _PUSHED * velocity
    return force / acceleration, -slave / acceleration


if __name__ == "__main__":
    main()
