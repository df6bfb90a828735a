"""Task of the whole station: swing, press on a sheet spring, rest."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from drake_teleop.common.numeric import Array
from drake_teleop.lab.comparison import station_accounts
from drake_teleop.lab.comparison.one_dof import ACTUAL, HAND, RunMeasures, Task, figures_of_traces
from drake_teleop.lab.identification import slave_arm
from drake_teleop.station.channel.channel import Channel
from drake_teleop.station.environment.sheet_spring import SheetSpring
from drake_teleop.station.operator.operator import MinimumJerk, OperatorConfig, Sine
from drake_teleop.station.passivity.methods import PassivityConfig
from drake_teleop.station.result import SimulationResult
from drake_teleop.station.scenario import Scenario, replace
from drake_teleop.station.slave.arm import pose_into
from drake_teleop.station.slave.plant import NominalSlave

_TIP_LEAF_GAP_M, _PRESS_DEPTH_M = 0.03, 0.02  # m, between tip and leaf at the start; intended depth
_LEAF_SPRING_LENGTH_M, _LEAF_WIDTH_M = 0.12, 0.05  # m
# m/s, slip speed of full friction at the leaf: Drake's default. With a tenth of it, a tip at rest
# needs 9,000 to 16,000 steps per second instead of 1,500.
_LEAF_SLIP_SPEED_M_S = 1e-3
#: Leaves by name: thickness [m], light enough not to oscillate.
LEAF_THICKNESSES_M = {"contact": 0.0015, "stiff contact": 0.00236}


def task_for_round_trip(round_trip: float) -> Task:
    """Return the times of the task; longer round trips [s] have longer waits."""
    return Task(
        swing_start=0.3,
        swing_end=1.8,
        press_start=2.3 + round_trip,
        press_end=3.1 + round_trip,
        release_start=5.1 + 4 * round_trip,
        release_end=5.9 + 4 * round_trip,
        end=8.1 + 6 * round_trip,
        rest_window=1.0,
    )


def delayed_contact(
    base: Scenario,
    channel: Channel,
    passivity: PassivityConfig,
    leaf: str | float,
    *,
    task: Task | None = None,
    depth: float = _PRESS_DEPTH_M,
) -> tuple[Scenario, Task]:
    """Return the scenario with this task and the task's times.

    `leaf` is a key of `LEAF_THICKNESSES_M` or a stiffness [N/m]; `depth` [m] is the hand's intended
    displacement beyond the contact.
    """
    task = task or task_for_round_trip(sum(line.delay for line in channel.networks_of_directions()))
    settle = 0.5
    swing = Sine(
        t_start=settle + task.swing_start,
        duration=task.swing_end - task.swing_start,
        ramp=min(0.5, 0.5 * (task.swing_end - task.swing_start)),
        frequency=1.5,
        translation=[0.005, 0.0, 0.02],
        rotation=[0.0, 0.05, 0.0],
    )
    scale = base.kinematic_scaling.translation_scale
    reach = [0.0, 0.0, -(_TIP_LEAF_GAP_M / scale + depth)]
    press, retreat = (
        MinimumJerk(t_start=settle + start, duration=end - start, translation=translation)
        for start, end, translation in (
            (task.press_start, task.press_end, reach),
            (task.release_start, task.release_end, [-x for x in reach]),
        )
    )
    x, y, z = NominalSlave(base.slave).start_tip.tolist()
    sheet = SheetSpring(
        position=[x, y, z - _TIP_LEAF_GAP_M],
        length=_LEAF_SPRING_LENGTH_M,
        width=_LEAF_WIDTH_M,
        thickness=LEAF_THICKNESSES_M[leaf] if isinstance(leaf, str) else leaf_thickness(leaf),
        slip_speed=_LEAF_SLIP_SPEED_M_S,
    )
    scenario = replace(
        base.without_environment(),
        simulation=dataclasses.replace(base.simulation, settle=settle, duration=task.end),
        operator=OperatorConfig(grip=base.operator.grip, intent=[swing, press, retreat]),
        channel=channel,
        passivity=passivity,
        sheet_spring=sheet,
    )
    return scenario, task


def leaf_thickness(stiffness: float) -> float:
    """Return the thickness [m] of a sheet spring with this stiffness [N/m]."""
    unit = SheetSpring(length=_LEAF_SPRING_LENGTH_M, width=_LEAF_WIDTH_M, thickness=1e-3)
    return float(unit.thickness * np.cbrt(stiffness / unit.stiffness))


def figures_of_station_run(result: SimulationResult, scenario: Scenario, task: Task) -> RunMeasures:
    """Return the measures of a station's run of the task, along z of the world."""
    traces = force_and_energy_traces(result, scenario)
    traces |= {"master": result["pose_command"][:, 6]}
    traces["slave"], traces["turned"] = _slave_height_and_rotation(result, scenario)
    return figures_of_traces(**traces, task=task)


def force_and_energy_traces(result: SimulationResult, scenario: Scenario) -> dict[str, Array]:
    """Return a run's t [s], vertical forces at the master's scale [N] and `injected_energy` [J].

    "felt" is the displayed force, "pressed" the scaled true contact force.
    """
    scaling = scenario.force_scaling
    return {
        "t": result.t,
        "felt": result["force_to_master"][:, 2],
        "pressed": scaling.force_scale * scaling.gamma * result["true_contact_wrench_W"][:, 2],
        "energy": injected_energy(result, scenario),
    }


def injected_energy(result: SimulationResult, scenario: Scenario) -> Array:
    """Return the energy (N,) that hand and environment put in so far, plus `start_energy` [J]."""
    accounts = station_accounts.station_accounts(result, scenario)[:, [HAND, ACTUAL]].sum(axis=1)
    if any(scenario.force_scaling.scales().load_scales):
        accounts += station_accounts.work_of_displayed_load_wrench(result, scenario)
    return np.asarray(station_accounts.start_energy(scenario).sum() + accounts.sum(axis=1))


def _slave_height_and_rotation(result: SimulationResult, scenario: Scenario) -> tuple[Array, Array]:
    arm = slave_arm(scenario)
    poses = np.empty((len(result.t), 7))
    for pose, state in zip(poses, result["slave_state"], strict=True):
        pose_into(arm.table, np.ascontiguousarray(state[: arm.num_joints]), pose)
    rotations = Rotation.from_quat(poses[:, [1, 2, 3, 0]])
    return poses[:, 6], (rotations * rotations[0].inv()).as_rotvec()
