"""The whole station: task (swing, press on a sheet spring, rest), measures and energy balances.

Energies [J] are put in at hand, command, motors and slave, in units of the master's side, for
translation and rotation. The motors' energy is from motor torque minus gravity torque.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.lab.comparison import one_dof
from drake_teleop.lab.comparison.one_dof import AT_COMMAND, AT_HAND, AT_MOTOR, AT_SLAVE
from drake_teleop.lab.identification import slave_arm
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.station.channel.channel import Channel
from drake_teleop.station.channel.network import mean_delay
from drake_teleop.station.environment.sheet_spring import SheetSpring
from drake_teleop.station.operator.operator import MinimumJerk, OperatorConfig, Sine
from drake_teleop.station.passivity import methods
from drake_teleop.station.passivity.energy import port_work
from drake_teleop.station.passivity.memory import STORED_ENERGY
from drake_teleop.station.passivity.methods import PassivityConfig
from drake_teleop.station.result import SimulationResult
from drake_teleop.station.scenario import Scenario, replace
from drake_teleop.station.slave import arm as serial_arm
from drake_teleop.station.slave.plant import NominalSlave

_TIP_LEAF_GAP_M, _PRESS_DEPTH_M = 0.03, 0.02  # m, between tip and leaf at the start; intended depth
_LEAF_SPRING_LENGTH_M, _LEAF_WIDTH_M = 0.12, 0.05  # m
# m/s, slip speed of full friction at the leaf: Drake's default. With a tenth of it, a tip at rest
# needs 9,000 to 16,000 steps per second instead of 1,500.
_LEAF_STICTION_TOLERANCE_M_S = 1e-3
#: Leaves by name: thickness [m], light enough not to oscillate.
LEAF_THICKNESSES_M = {"contact": 0.0015, "stiff contact": 0.00236}


def task_for_round_trip(round_trip: float) -> one_dof.Task:
    """Return the task's times; longer round trips [s] lengthen its waits."""
    return one_dof.Task(
        swing_start=0.3,
        swing_end=1.8,
        press_start=2.3 + round_trip,
        press_end=3.1 + round_trip,
        release_start=5.1 + 4 * round_trip,
        release_end=5.9 + 4 * round_trip,
        end=8.1 + 6 * round_trip,
        rest_window=1.0,
    )


def press_scenario(
    base: Scenario,
    channel: Channel,
    passivity: PassivityConfig,
    leaf: str | float,
    *,
    task: one_dof.Task | None = None,
    depth: float = _PRESS_DEPTH_M,
) -> tuple[Scenario, one_dof.Task]:
    """Return the scenario of a press on a sheet spring, and the task's times.

    `leaf` is a key of `LEAF_THICKNESSES_M` or a stiffness [N/m]; `depth` [m] is the hand's intended
    displacement beyond the contact.
    """
    task = task or task_for_round_trip(sum(map(mean_delay, channel.networks_of_directions())))
    settle, scale = 0.5, base.kinematic_scaling.translation_scale
    x_B, y_B, z_B = base.kinematic_scaling.R_WB  # axes of W, in B
    swing = Sine(
        t_start=settle + task.swing_start,
        duration=task.swing_end - task.swing_start,
        ramp=min(0.5, 0.5 * (task.swing_end - task.swing_start)),
        frequency=1.5,
        # The slave's swing stays above the leaf.
        translation=((0.005 * x_B + 0.02 * z_B) / max(scale, 1.0)).tolist(),
        rotation=(0.05 * y_B).tolist(),
    )
    rise_B = (_TIP_LEAF_GAP_M / scale + depth) * z_B
    press, retreat = (
        MinimumJerk(t_start=settle + start, duration=end - start, translation=translation.tolist())
        for start, end, translation in (
            (task.press_start, task.press_end, -rise_B),
            (task.release_start, task.release_end, rise_B),
        )
    )
    x, y, z = NominalSlave(base.slave).p_WTip_start.tolist()
    sheet = SheetSpring(
        position=[x, y, z - _TIP_LEAF_GAP_M],
        length=_LEAF_SPRING_LENGTH_M,
        width=_LEAF_WIDTH_M,
        thickness=LEAF_THICKNESSES_M[leaf] if isinstance(leaf, str) else leaf_thickness(leaf),
        slip_speed=_LEAF_STICTION_TOLERANCE_M_S,
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


def measures_of_press(
    result: SimulationResult, scenario: Scenario, task: one_dof.Task
) -> one_dof.RunMeasures:
    traces = force_and_energy_traces(result, scenario)
    traces |= {"master": result["pose_command"][:, 6]}
    traces["slave"], traces["turned"] = _slave_height_and_rotation(result, scenario)
    return one_dof.measures_of_traces(**traces, task=task)


def force_and_energy_traces(result: SimulationResult, scenario: Scenario) -> dict[str, Array]:
    """Return "t" [s], vertical forces at the master's scale [N] and injected "energy" [J].

    "hand_force" is the displayed force, "pressed" the scaled true contact force.
    """
    scaling = scenario.force_scaling
    return {
        "t": result.t,
        "hand_force": result["force_to_master"][:, :3] @ scenario.kinematic_scaling.R_WB[2],
        "pressed": scaling.force_scale * scaling.gamma * result["true_contact_wrench_W"][:, 2],
        "energy": injected_energy(result, scenario),
    }


def injected_energy(result: SimulationResult, scenario: Scenario) -> Array:
    """Return the start energy plus the energy (N,) [J] put in so far by hand and environment."""
    energies = station_energies(result, scenario)[:, [AT_HAND, AT_SLAVE]].sum(axis=1)
    if any(scenario.force_scaling.scales().load_scales):
        energies += work_of_displayed_load_wrench(result, scenario)
    return np.asarray(start_energy(scenario).sum() + energies.sum(axis=1))


def _slave_height_and_rotation(result: SimulationResult, scenario: Scenario) -> tuple[Array, Array]:
    arm = slave_arm(scenario)
    poses = np.empty((len(result.t), 7))
    for pose, state in zip(poses, result["slave_state"], strict=True):
        serial_arm.pose_into(arm.table, np.ascontiguousarray(state[: arm.num_joints]), pose)
    rotations = Rotation.from_quat(poses[:, [1, 2, 3, 0]])
    return poses[:, 6], (rotations * rotations[0].inv()).as_rotvec()


def station_energies(result: SimulationResult, scenario: Scenario) -> Array:
    """Return energies (N, place, translation or rotation) [J] put in so far; AT_HAND to AT_SLAVE.

    AT_MOTOR is NaN if the log is slower than the joint control.
    """
    needed = ("ports", "slave_state", "joint_torque")
    if missing := [name for name in needed if name not in result]:
        what = f"lacks the signals {', '.join(missing)}, which the energy balances need"
        remedy = "run a station with a network or a passivity method"
        raise DrakeTeleopError(what, where="result", remedy=remedy)
    t, torque = result.t, result["joint_torque"]
    q = np.ascontiguousarray(result["slave_state"][:, : torque.shape[1]])
    poses, motor = _slave_pose_and_motor_wrench(scenario, q, torque)
    contact = np.zeros_like(motor)
    if "true_contact_wrench_W" in result:
        force, torque = np.split(result["true_contact_wrench_W"], 2, axis=1)
        contact = np.hstack([force, torque - np.cross(poses[:, 4:], force)])
    gamma = scenario.force_scaling.scales().gamma
    power = scenario.force_scaling.force_scale * gamma / _nonzero_kinematic_scales(scenario)
    rates = scenario.rates
    energies = np.empty((len(t), 4, 2))
    # A row contains the torque of the period before the row.
    has_torques = rates.log_hz >= rates.joint_control_hz
    energies[:, AT_MOTOR] = -power * port_work(motor, poses, "backward") if has_torques else np.nan
    energies[:, AT_SLAVE] = power * port_work(contact, poses, "mean")
    # A row contains the channel's sum of one period ago.
    channel_times = t - 1 / rates.hand_hz
    for place, first in ((AT_HAND, 0), (AT_COMMAND, 6)):
        for g in range(2):
            so_far = np.interp(t, channel_times, result["ports"][:, first + g])
            energies[:, place, g] = so_far - so_far[0]
    return energies


def work_of_displayed_load_wrench(result: SimulationResult, scenario: Scenario) -> Array:
    """Return the work (N, 2) [J] so far of the displayed load wrench: translation, rotation."""
    arm, t = slave_arm(scenario), result.t
    q, v = np.split(np.ascontiguousarray(result["slave_state"]), [arm.num_joints], axis=1)
    a, poses, motion = np.gradient(v, t, axis=0), np.empty((len(t), 7)), np.empty((len(t), 21))
    for k in range(len(t)):
        serial_arm.pose_into(arm.table, q[k], poses[k])
        serial_arm.sensor_motion(arm.table, q[k], v[k], a[k], motion[k])
    held = scenario.force_scaling.gripper_phi
    of_gripper = arm.phi_load if held is None else np.asarray(held)
    R_WS = motion[:, np.newaxis, 12:].reshape(-1, 1, 3, 3)
    column = serial_arm.LAST_ROW_GRAVITY_COLUMN
    gravity = arm.table[-1, column : column + 3] @ R_WS[:, 0]
    inertias, weights = np.split(np.array(scenario.force_scaling.scales().load_scales), 2)
    kept, excess = (
        part[0] * of_gripper + part[1] * (arm.phi_load - of_gripper)
        for part in (inertias, weights - inertias)
    )
    rest = np.zeros_like(gravity)
    wrench = -non_contact_wrench(motion[:, :3], motion[:, 3:6], motion[:, 6:9], kept)
    wrench -= non_contact_wrench(-gravity, rest, rest, excess)
    at_So = (R_WS @ wrench.reshape(-1, 2, 3, 1)).reshape(-1, 6)
    power = scenario.force_scaling.force_scale / _nonzero_kinematic_scales(scenario)
    return np.asarray(power * port_work(at_So, poses, "mean"))


def start_energy(scenario: Scenario) -> Array:
    """Return the energy (2,) [J] that the passivity method stores at both ends at the start.

    Columns: translation, rotation.
    """
    scales = _nonzero_kinematic_scales(scenario)
    power = scenario.force_scaling.force_scale / scales
    p = methods.method_parameters(scenario.passivity, list(power), list(scales))
    pose = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    return 2 * methods.initial_method_memory(scenario.passivity.method, p, pose)[STORED_ENERGY]


def _nonzero_kinematic_scales(scenario: Scenario) -> Array:
    scales = scenario.kinematic_scaling.scales
    return np.where(scales > 0.0, scales, 1.0)


def _slave_pose_and_motor_wrench(scenario: Scenario, q: Array, tau: Array) -> tuple[Array, Array]:
    # X_WS (N, 7) and the motors' wrench (N, 6) at So, in W, without the weight.
    n = q.shape[1]
    arm, zero = slave_arm(scenario).table, np.zeros(n)
    poses, weight, J = np.empty((len(q), 7)), np.empty_like(q), np.empty((len(q), 6, n))
    for k in range(len(q)):
        serial_arm.pose_into(arm, q[k], poses[k])
        serial_arm.inverse_dynamics(arm, q[k], zero, zero, weight[k])
        serial_arm.jacobian(arm, q[k], J[k])
    to_torque, excess = J.swapaxes(1, 2), (tau - weight)[:, :, np.newaxis]
    wrench = np.linalg.solve(to_torque, excess) if n == 6 else np.linalg.pinv(to_torque) @ excess
    return poses, wrench[:, :, 0]
