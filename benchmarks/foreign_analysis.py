"""Is `analyze` as accurate for other arms and devices as for those of the paper?

Stations are vertical with an ideal sensor and sigma 0.5: an RX90 with a Phantom, a Panda with an
omega.6 and a UR5 with a Touch. Compared are:

* the sampled model of one axis and the two-port of the linearised Diagram, up to 20 Hz: largest
  difference of each entry, over the entry's largest magnitude;
* the stiffest stable wall of `analyze` for each grip, and the nonlinear station: it presses on that
  wall with 0.9 and 1.1 times the scenario's force scale. The motion of the hand in a later second,
  over that in an earlier one, is below 1 if it decays. The dominant multiplier of the sampled
  axis predicts that ratio;
* the slowest motion of the linearised Diagram, and the share of tool and hand in it: a redundant
  arm moves slowly towards its posture.

    python benchmarks/foreign_analysis.py [--arms rx90,panda,ur5] [--models DIR] [--json FILE]
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from inverse_kinematics import described
from stations import ARMS

from drake_teleop.lab.analysis.analyze import (
    OMEGA,
    UNIT_VECTOR_W_BY_AXIS,
    axis_with_grip,
    close_all_loops,
    close_feedback_of_other_directions,
    sampling_of_scenario,
    stiffest_stable_walls,
)
from drake_teleop.lab.analysis.linear_model import Linearization
from drake_teleop.lab.analysis.linearization import linearize, two_port_along
from drake_teleop.lab.analysis.one_axis import OneAxis
from drake_teleop.lab.analysis.period_map import Sampling, closed_axis_model, sampled_two_port
from drake_teleop.lab.analysis.task_direction import task_direction
from drake_teleop.lab.analysis.two_port import absorb_impedances
from drake_teleop.lab.identification import slave_arm
from drake_teleop.station.environment.solids import Wall
from drake_teleop.station.master.data_sheets import Master
from drake_teleop.station.operator.operator import GRIP_IMPEDANCES, MinimumJerk
from drake_teleop.station.scenario import LoadScenario, Scenario, replace
from drake_teleop.station.simulation import MakeSimulator
from drake_teleop.station.slave.arm import jacobian
from drake_teleop.station.slave.plant import NominalSlave
from drake_teleop.station.station import GetBlock, MakeTeleopStation

DEVICES = {"rx90": "phantom_premium_15", "panda": "omega_6", "ur5": "geomagic_touch"}
Array = Any
_BAND = 2 * np.pi * 20.0
_PRESS, _DEEPEST = 15.0, 5e-3  # N on the wall, and largest depth of the tip in it [m]
# Stable share of the force scale; time of its change [s]; duration of the change; compared seconds.
_BEFORE, _CHANGE, _CHANGING = 0.6, 1.6, 0.4
_FIRST, _LAST, _SECOND = 2.1, 4.1, 1.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--arms", default=",".join(DEVICES))
    parser.add_argument(
        "--models", type=Path, default=described(), help="folder example-robot-data/robots"
    )
    parser.add_argument("--json", type=Path, help="file for the figures")
    arguments = parser.parse_args()
    rows = {}
    for arm in arguments.arms.split(","):
        rows[f"{arm}, {DEVICES[arm]}"] = row = figures(station_of(arm, arguments.models))
        print(f"{arm}, {DEVICES[arm]}")
        for name, value in row.items():
            print(f"  {name}: {value}", flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=2) + "\n")


def station_of(arm: str, models: Path | None) -> Scenario:
    """Return a station in free motion at the device's rate, without Coulomb friction."""
    file, slave = ARMS[arm]
    if file:
        slave = dataclasses.replace(slave, model=str(models / file) if models else "")
    scenario, master = LoadScenario("free_motion_force"), Master(model=DEVICES[arm])
    own_period = master.sampling_period_if_slower_than_hand(scenario.rates.hand_hz)
    rate = scenario.rates.hand_hz if own_period is None else 1 / own_period
    return replace(
        scenario,
        slave=slave,
        master=master.without_coulomb_friction_and_encoder_steps(),
        rates=dataclasses.replace(scenario.rates, hand_hz=rate, joint_control_hz=rate),
        force_scaling__sigma=0.5,
        operator__grip="light",
        wrist_sensor__ideal=True,
    )


def figures(scenario: Scenario) -> dict[str, Any]:
    estimate = np.concatenate([np.zeros(6), slave_arm(scenario).phi_load])
    along, sampling = (
        task_direction(scenario, UNIT_VECTOR_W_BY_AXIS["z"]),
        sampling_of_scenario(scenario),
    )
    free = linearize(scenario, load_estimate=estimate)
    with_hand = two_port_along(
        close_feedback_of_other_directions(free, scenario, along), OMEGA, along.hand, along.tool
    )
    axis = along.axis
    H = absorb_impedances(with_hand, hand=-1j * OMEGA * axis.hand_mass)
    limits = stiffest_stable_walls(H, axis, sampling)["each"]
    return {
        "joints": slave_arm(scenario).num_joints,
        "from the sampled axis, %": off(with_hand, axis, sampling),
        "stiffest stable wall, N/m": limits,
        "motion later over earlier, and as predicted": {
            f"{grip}, {share:g} of it": (
                pressed(scenario, grip, limit, share),
                predicted(axis_with_grip(axis, grip), limit, share, sampling),
            )
            for grip, limit in limits.items()
            for share in (0.9, 1.1)
        },
        "slowest motion": slowest(scenario, close_all_loops(free, scenario)),
    }


def off(with_hand: Any, axis: OneAxis, sampling: Sampling) -> dict[str, float]:
    band = OMEGA <= _BAND
    heavy = dataclasses.replace(axis, device_mass=axis.device_mass + axis.hand_mass)
    sampled = sampled_two_port(heavy, sampling, OMEGA[band])
    worst = 100 * np.abs(with_hand[band] - sampled).max(axis=0) / np.abs(sampled).max(axis=0)
    return {f"h{i + 1}{j + 1}": float(f"{worst[i, j]:.3g}") for i in range(2) for j in range(2)}


def pressed(scenario: Scenario, grip: str, stiffness: float, share: float) -> float:
    """Return the hand's speed along z on a wall, in a late second over that in an early one.

    The force scale ramps from a stable value to `share` of the scenario's.
    """
    tip, ball = NominalSlave(scenario.slave).p_WTip_start, 4e5  # N/m, in series
    wall = Wall(
        position=tip.tolist(),
        stiffness=stiffness * ball / (ball - stiffness),
        dissipation=0.0,
        friction=0.0,
    )
    scale, deep = share * scenario.force_scaling.force_scale, min(_DEEPEST, _PRESS / stiffness)
    reach = deep / scenario.kinematic_scaling.translation_scale
    push = scale * stiffness * deep / GRIP_IMPEDANCES[grip].stiffness
    press = MinimumJerk(t_start=0.1, duration=1.0, translation=[0.0, 0.0, -reach - push])
    held = replace(
        scenario,
        environment=[wall],
        operator__grip=grip,
        operator__intent=[press],
        force_scaling__force_scale=_BEFORE * scenario.force_scaling.force_scale,
        simulation__settle=0.0,
        simulation__duration=_LAST + _SECOND,
    )
    estimate = np.concatenate([np.zeros(6), slave_arm(held).phi_load])
    station = MakeTeleopStation(held, load_estimate=estimate)
    simulator = MakeSimulator(station, held.simulation)
    context, scaling = simulator.get_mutable_context(), GetBlock(station, "force_scaling")
    simulator.AdvanceTo(_CHANGE)
    sigma, sigma_object, gamma = held.force_scaling.scales()[:3]
    scaling.SetScales(
        scaling.GetMyMutableContextFromRoot(context),
        sigma_gripper=sigma, sigma_object=sigma_object, gamma=gamma, force_scale=scale,
        duration=_CHANGING,
    )  # fmt: skip
    size = []
    for start in (_FIRST, _LAST):
        speed = []
        for t in np.arange(start, start + _SECOND, 1e-3):
            simulator.AdvanceTo(t)
            speed.append(station.GetOutputPort("twist_master").Eval(context)[2])
        size.append(np.std(speed))
    return float(f"{size[1] / size[0]:.3g}")


def predicted(axis: OneAxis, stiffness: float, share: float, sampling: Sampling) -> float:
    """Return that ratio for the slowest motion of one axis."""
    scale = share * axis.force_scale
    loop = closed_axis_model(
        dataclasses.replace(axis, wall_stiffness=stiffness, force_scale=scale), sampling
    )
    multiplier = abs(loop.multipliers[0])
    return float(f"{multiplier ** ((_LAST - _FIRST) / loop.dt):.3g}")


def slowest(scenario: Scenario, system: Linearization) -> dict[str, float]:
    """Return half-life of the slowest motion, and speeds of tool and hand over the joints'."""
    slave, n = NominalSlave(scenario.slave), slave_arm(scenario).num_joints
    values, vectors = np.linalg.eig(system.A)
    k = int(np.argmax(np.abs(values)))

    def speeds(block: str, count: int) -> Array:
        first = system.states.index(f"{block}[0]")
        return vectors[first + count : first + 2 * count, k]

    J, v = np.empty((6, n)), speeds("slave_plant ", n)
    jacobian(slave.arm.table, slave.start, J)
    joints = np.linalg.norm(v)
    return {
        "halves_ms": float(-1e3 * np.log(2) * system.dt / np.log(np.abs(values[k]))),
        "tool_m_per_rad": float(np.linalg.norm((J @ v)[:3]) / joints),
        "tool_rad_per_rad": float(np.linalg.norm((J @ v)[3:]) / joints),
        "hand_per_rad": float(np.linalg.norm(speeds("master_device 0", 6)) / joints),
    }


if __name__ == "__main__":
    main()
