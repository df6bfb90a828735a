"""One task for every method and network: swing freely, rest, press on the leaf, hold, let go, rest.

The whole 6-DoF station does it; the times follow the network's round trip, so that a station over
the moon has as many round trips to come to rest as one in a building.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from drake_teleop.common.compiled import njit
from drake_teleop.common.quaternions import quaternion_of
from drake_teleop.common.vectors import put
from drake_teleop.lab.comparison.one_dof import ACTUAL, HAND, Figures, Task, figures_of
from drake_teleop.lab.comparison.station_accounts import load_work, start_energy, station_accounts
from drake_teleop.lab.identification import slave_arm
from drake_teleop.station.channel.channel import Channel
from drake_teleop.station.environment.sheet_spring import SheetSpring
from drake_teleop.station.operator.operator import MinimumJerk, OperatorConfig, Sine
from drake_teleop.station.passivity.methods import PassivityConfig
from drake_teleop.station.result import SimulationResult
from drake_teleop.station.scenario import Scenario, replace
from drake_teleop.station.slave.arm import forward_kinematics
from drake_teleop.station.slave.plant import NominalSlave

_GAP, _DEPTH = 0.03, 0.02  # m, between tip and leaf at the start; how deep the operator presses
#: Leaves by name: thickness [m] of a leaf of 120 mm x 50 mm, which is light enough not to rattle.
LEAVES = {"contact": 0.0015, "stiff contact": 0.00236}


def task_over(round_trip: float) -> Task:
    """The task; a round trip [s] before the press, three of them to hold, two to come to rest."""
    return Task(
        swing=0.3,
        swung=1.8,
        press=2.3 + round_trip,
        pressed=3.1 + round_trip,
        release=5.1 + 4 * round_trip,
        released=5.9 + 4 * round_trip,
        end=8.1 + 6 * round_trip,
        judged=1.0,
    )


def delayed_contact(
    base: Scenario, channel: Channel, passivity: PassivityConfig, leaf: str
) -> tuple[Scenario, Task]:
    """The scenario of the task.

    Args:
        base: rates, sensor, scales, grip of the operator.
        channel: the network.
        passivity: the method.
        leaf: one of `LEAVES`.
    """
    task = task_over(sum(line.delay for line in channel.lines()))
    settle = 0.5
    swing = Sine(
        t_start=settle + task.swing,
        duration=task.swung - task.swing,
        ramp=0.5,
        frequency=1.5,
        translation=[0.005, 0.0, 0.02],
        rotation=[0.0, 0.05, 0.0],
    )
    reach = [0.0, 0.0, -(_GAP + _DEPTH)]
    press, back = (
        MinimumJerk(t_start=settle + start, duration=end - start, translation=way)
        for start, end, way in (
            (task.press, task.pressed, reach),
            (task.release, task.released, [-x for x in reach]),
        )
    )
    x, y, z = NominalSlave(base.slave).start_tip.tolist()
    sheet = SheetSpring(position=[x, y, z - _GAP], length=0.12, width=0.05, thickness=LEAVES[leaf])
    return (
        replace(
            base.without_environment(),
            simulation=dataclasses.replace(base.simulation, settle=settle, duration=task.end),
            operator=OperatorConfig(grip=base.operator.grip, intent=[swing, press, back]),
            channel=channel,
            passivity=passivity,
            sheet_spring=sheet,
        ),
        task,
    )


def station_figures(result: SimulationResult, scenario: Scenario, task: Task) -> Figures:
    """The run in numbers: vertical motion and force, which the task is about, and the turning.

    Its energy is that between hand and actual motion (`energy_between`).
    """
    heights, turned = _slave_motion(result, scenario)
    scaling = scenario.force_scaling
    return figures_of(
        t=result.t,
        master=result["pose_command"][:, 6],
        slave=heights,
        felt=result["force_to_master"][:, 2],
        pressed=scaling.force_scale * scaling.gamma * result["true_contact_wrench_W"][:, 2],
        energy=energy_between(result, scenario),
        task=task,
        turned=turned,
    )


def vertical_traces(result: SimulationResult, scenario: Scenario) -> dict[str, NDArray[np.float64]]:
    """What a picture of the task shows: t [s], forces in the master's units [N], energy [J]."""
    scaling = scenario.force_scaling
    return {
        "t": result.t,
        "felt": result["force_to_master"][:, 2],
        "pressed": scaling.force_scale * scaling.gamma * result["true_contact_wrench_W"][:, 2],
        "energy": energy_between(result, scenario),
    }


def energy_between(result: SimulationResult, scenario: Scenario) -> NDArray[np.float64]:
    """(N,) that hand and environment have put in, and what the stores held at the start [J].

    It never falls below zero if the station is passive between the hand, with the force that is
    held there, and the slave's actual motion: that of contact and, with sigma > 0, load.
    """
    accounts = station_accounts(result, scenario)[:, [HAND, ACTUAL]].sum(axis=1)
    if any(scenario.force_scaling.scales()[:2]):
        accounts += load_work(result, scenario)
    return np.asarray(start_energy(scenario).sum() + accounts.sum(axis=1))


def _slave_motion(
    result: SimulationResult, scenario: Scenario
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(N,) height of So [m] and (N, 3) rotation vector since the start of the log [rad]."""
    arm = slave_arm(scenario)
    q = np.ascontiguousarray(result["slave_state"][:, : arm.num_joints])
    poses = _poses(arm.table, q)
    rotations = Rotation.from_quat(poses[:, [1, 2, 3, 0]])
    return poses[:, 6], (rotations * rotations[0].inv()).as_rotvec()


@njit(cache=True)
def _poses(arm, q):
    """(N, 7) X_WS at each row of q."""
    R, p, poses = np.empty((3, 3)), np.empty(3), np.empty((q.shape[0], 7))
    for k in range(q.shape[0]):
        forward_kinematics(arm, q[k], R, p)
        orientation = quaternion_of(R)
        for i in range(4):
            poses[k, i] = orientation[i]
        put(poses[k], 4, p, 0, 3)
    return poses
