"""Energy balances of a station's run, from its recorded signals.

The balances are those of `one_dof.OneDofRun.accounts`, at the master's scale, positive inwards [J],
by translation and rotation. MOTOR is from the motor torque minus weight, as a wrench at So.
"""

from __future__ import annotations

import numpy as np

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.lab.comparison.one_dof import ACTUAL, COMMAND, HAND, MOTOR
from drake_teleop.lab.identification import slave_arm
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.station.passivity import methods
from drake_teleop.station.passivity.energy import port_work
from drake_teleop.station.passivity.memory import STORED_ENERGY
from drake_teleop.station.result import SimulationResult
from drake_teleop.station.scenario import Scenario
from drake_teleop.station.slave.arm import (
    LAST_ROW_GRAVITY_COLUMN,
    inverse_dynamics,
    jacobian,
    pose_into,
    sensor_motion,
)


def station_accounts(result: SimulationResult, scenario: Scenario) -> Array:
    """Return the energies (N, 4, 2) [J] at `HAND` to `ACTUAL`, for translation and rotation.

    `MOTOR` is NaN if the log is slower than the joint control.
    """
    needed = ("ports", "slave_state", "joint_torque")
    if missing := [name for name in needed if name not in result]:
        what = f"lacks the signals {', '.join(missing)}, which the energy balances need"
        remedy = "run a station with a network or a passivity method"
        raise DrakeTeleopError(what, where="result", remedy=remedy)
    t, torque = result.t, result["joint_torque"]
    q = np.ascontiguousarray(result["slave_state"][:, : torque.shape[1]])
    poses, motor = _poses_and_motor_wrenches(scenario, q, torque)
    contact = np.zeros_like(motor)
    if "true_contact_wrench_W" in result:
        force, torque = np.split(result["true_contact_wrench_W"], 2, axis=1)
        contact = np.hstack([force, torque - np.cross(poses[:, 4:], force)])
    gamma = scenario.force_scaling.scales().gamma
    power = scenario.force_scaling.force_scale * gamma / _kinematic_scales(scenario)
    rates = scenario.rates
    accounts = np.empty((len(t), 4, 2))
    # A row contains the torque of the period before the row.
    has_torques = rates.log_hz >= rates.joint_control_hz
    accounts[:, MOTOR] = -power * port_work(motor, poses, "backward") if has_torques else np.nan
    accounts[:, ACTUAL] = power * port_work(contact, poses, "mean")
    # A row contains the channel's sum of one period ago.
    channel_times = t - 1 / rates.hand_hz
    for place, first in ((HAND, 0), (COMMAND, 6)):
        for g in range(2):
            so_far = np.interp(t, channel_times, result["ports"][:, first + g])
            accounts[:, place, g] = so_far - so_far[0]
    return accounts


def work_of_displayed_load_wrench(result: SimulationResult, scenario: Scenario) -> Array:
    """Return the cumulative work (N, 2) [J] of the load's displayed wrench on the hand.

    Columns: translation, rotation.
    """
    arm, t = slave_arm(scenario), result.t
    q, v = np.split(np.ascontiguousarray(result["slave_state"]), [arm.num_joints], axis=1)
    a, poses, motion = np.gradient(v, t, axis=0), np.empty((len(t), 7)), np.empty((len(t), 21))
    for k in range(len(t)):
        pose_into(arm.table, q[k], poses[k])
        sensor_motion(arm.table, q[k], v[k], a[k], motion[k])
    held = scenario.force_scaling.gripper_phi
    of_gripper = arm.phi_load if held is None else np.asarray(held)
    R_WS = motion[:, np.newaxis, 12:].reshape(-1, 1, 3, 3)
    gravity = arm.table[-1, LAST_ROW_GRAVITY_COLUMN : LAST_ROW_GRAVITY_COLUMN + 3] @ R_WS[:, 0]
    inertias, weights = np.split(np.array(scenario.force_scaling.scales().load_scales), 2)
    kept, excess = (
        part[0] * of_gripper + part[1] * (arm.phi_load - of_gripper)
        for part in (inertias, weights - inertias)
    )
    rest = np.zeros_like(gravity)
    wrench = -non_contact_wrench(motion[:, :3], motion[:, 3:6], motion[:, 6:9], kept)
    wrench -= non_contact_wrench(-gravity, rest, rest, excess)
    at_So = (R_WS @ wrench.reshape(-1, 2, 3, 1)).reshape(-1, 6)
    power = scenario.force_scaling.force_scale / _kinematic_scales(scenario)
    return np.asarray(power * port_work(at_So, poses, "mean"))


def start_energy(scenario: Scenario) -> Array:
    """Return the energy (2,) stored at both ends at the start [J], by translation and rotation."""
    scales = _kinematic_scales(scenario)
    power = scenario.force_scaling.force_scale / scales
    p = methods.method_parameters(scenario.passivity, list(power), list(scales))
    pose = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    return 2 * methods.initial_method_memory(scenario.passivity.method, p, pose)[STORED_ENERGY]


def _kinematic_scales(scenario: Scenario) -> Array:
    scales = scenario.kinematic_scaling.scales
    return np.where(scales > 0.0, scales, 1.0)


def _poses_and_motor_wrenches(scenario: Scenario, q: Array, torque: Array) -> tuple[Array, Array]:
    # X_WS (N, 7) and the motors' wrench (N, 6) at So, in W, without the weight.
    n = q.shape[1]
    arm, zero = slave_arm(scenario).table, np.zeros(n)
    poses, weight, J = np.empty((len(q), 7)), np.empty_like(q), np.empty((len(q), 6, n))
    for k in range(len(q)):
        pose_into(arm, q[k], poses[k])
        inverse_dynamics(arm, q[k], zero, zero, weight[k])
        jacobian(arm, q[k], J[k])
    to_torque, excess = J.swapaxes(1, 2), (torque - weight)[:, :, np.newaxis]
    wrench = np.linalg.solve(to_torque, excess) if n == 6 else np.linalg.pinv(to_torque) @ excess
    return poses, wrench[:, :, 0]
