"""Where a station's energy comes from: four accounts of a run, from the signals that it recorded.

They are those of one degree of freedom (`lab.comparison.one_dof`), in the same order, for
translation and rotation apart; in the master's power units, positive inwards [J]. What comes out of
a passive station never exceeds what its stores held at the start: the hand's account plus any one
of the others never falls below -E_0 then. The command is no physical port. With sigma > 0 the hand
feels the load too, which gives back what was put into it: energy that `MOTOR` and `ACTUAL` lack,
and `load_work` has.

    HAND      -sum f_(k-1) . dx_k           the held wrench, at every period of the channel: exact
    COMMAND    sum w_k . dc_k               what the slave sends, along its command: as exact
    MOTOR     -integral c f_m . dx_s        the motors' torque less the weight, as a wrench at So
    ACTUAL     integral c f_w . dx_s        the true contact wrench at So

with c = k_f gamma over the kinematic scale. The first two are summed up by the running channel
(signal `ports`). The others are taken from the log's rows: a torque is held, so its work is exact
if none lies between two rows; that of the contact is exact for a spring, and else of second order
in the time between rows.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.lab.comparison.one_dof import ACTUAL, COMMAND, HAND, MOTOR
from drake_teleop.lab.identification import slave_arm
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.station.passivity import methods
from drake_teleop.station.passivity.energy import ledger, port_work
from drake_teleop.station.result import SimulationResult
from drake_teleop.station.scenario import Scenario
from drake_teleop.station.slave.arm import inverse_dynamics, jacobian, sensor_motion
from drake_teleop.station.slave.forward_kinematics import pose_into

Array = NDArray[np.float64]

_NEEDED = ("ports", "slave_state", "joint_torque")


def station_accounts(result: SimulationResult, scenario: Scenario) -> Array:
    """What has gone into the station at its four places, up to each row.

    Args:
        result: of a station with a channel. With nothing to touch, the account at the actual
            motion is zero.
        scenario: what it was made of; its scales, arm and rates.

    Returns:
        (N, 4, 2) at `HAND`, `COMMAND`, `MOTOR` and `ACTUAL` motion, by translation and rotation
        [J], zero in the first row. Hand and command lack what belongs to the last row's period.
        The motors' is not a number if the log is slower than the joint control, whose torque may
        alternate from one period to the next.

    Raises:
        DrakeTeleopError: if the result lacks a signal that is needed.
    """
    if missing := [name for name in _NEEDED if name not in result]:
        raise DrakeTeleopError(
            f"this result holds no {', '.join(missing)}",
            where="accounts",
            remedy="run a station over a network, or with a method",
        )
    t, torque = result.t, result["joint_torque"]
    q = np.ascontiguousarray(result["slave_state"][:, : torque.shape[1]])
    poses, motor = _motors(scenario, q, torque)
    contact = np.zeros_like(motor)
    if "true_contact_wrench_W" in result:
        force, torque = np.split(result["true_contact_wrench_W"], 2, axis=1)
        contact = np.hstack([force, torque - np.cross(poses[:, 4:], force)])
    _, _, gamma = scenario.force_scaling.scales()
    power = scenario.force_scaling.force_scale * gamma / _motion_scale(scenario)
    rates = scenario.rates
    accounts = np.empty((len(t), 4, 2))
    # A row shows the torque that has acted before it.
    known = rates.log_hz >= rates.joint_control_hz
    accounts[:, MOTOR] = -power * port_work(motor, poses, "backward") if known else np.nan
    accounts[:, ACTUAL] = power * port_work(contact, poses, "mean")
    # A row shows what the channel had summed up a period ago.
    then = t - 1 / rates.hand_hz
    for place, first in ((HAND, 0), (COMMAND, 6)):
        for g in range(2):
            so_far = np.interp(t, then, result["ports"][:, first + g])
            accounts[:, place, g] = so_far - so_far[0]
    return accounts


def load_work(result: SimulationResult, scenario: Scenario) -> Array:
    """What weight and inertia of the slave's load have put in along its actual motion, as felt.

    It is to `ACTUAL` as the load is to the contact: where the load is felt (sigma > 0), the two
    together are the environment. Of the true load, with accelerations from one row to the next.

    Returns:
        (N, 2) by translation and rotation [J], zero in the first row; never more in all than the
        load's energy at the start, if both kinematic scales are alike.
    """
    arm, t, joints = slave_arm(scenario), result.t, slave_arm(scenario).num_joints
    q, v = np.split(np.ascontiguousarray(result["slave_state"]), [joints], axis=1)
    a, poses, motion = np.gradient(v, t, axis=0), np.empty((len(t), 7)), np.empty((len(t), 21))
    for k in range(len(t)):
        pose_into(arm.table, q[k], poses[k])
        sensor_motion(arm.table, q[k], v[k], a[k], motion[k])
    gripper, rest, _ = scenario.force_scaling.scales()
    held = scenario.force_scaling.gripper_phi
    of_gripper = arm.phi_load if held is None else np.asarray(held)
    felt = gripper * of_gripper + rest * (arm.phi_load - of_gripper)
    wrench = -non_contact_wrench(motion[:, :3], motion[:, 3:6], motion[:, 6:9], felt)
    R_WS = motion[:, np.newaxis, 12:].reshape(-1, 1, 3, 3)
    at_So = (R_WS @ wrench.reshape(-1, 2, 3, 1)).reshape(-1, 6)
    power = scenario.force_scaling.force_scale / _motion_scale(scenario)
    return np.asarray(power * port_work(at_So, poses, "mean"))


def start_energy(scenario: Scenario) -> Array:
    """(2,) E_0, what the method says that its stores hold at the start, by group [J]."""
    scales = _motion_scale(scenario)
    power = scenario.force_scaling.force_scale / scales
    p = methods.parameters(scenario.passivity, list(power), list(scales))
    pose = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    return 2 * ledger(methods.initial_memory(scenario.passivity.method, p, pose)).stored


def _motion_scale(scenario: Scenario) -> Array:
    """(2,) slave over master, of translation and rotation; 1 where motion is scaled to zero."""
    scaling = scenario.kinematic_scaling
    scales = np.array([scaling.translation_scale, scaling.rotation_scale])
    return np.where(scales > 0.0, scales, 1.0)


def _motors(scenario: Scenario, q: Array, torque: Array) -> tuple[Array, Array]:
    """(N, 7) X_WS; (N, 6) what the motors do beside bearing the weight, as a wrench at So in W.

    Of a redundant arm, what comes nearest: the rest of its torques moves it within itself.
    """
    n = q.shape[1]
    arm, still = slave_arm(scenario).table, np.zeros(n)
    poses, weight, J = np.empty((len(q), 7)), np.empty_like(q), np.empty((len(q), 6, n))
    for k in range(len(q)):
        pose_into(arm, q[k], poses[k])
        inverse_dynamics(arm, q[k], still, still, weight[k])
        jacobian(arm, q[k], J[k])
    to_torque, beside = J.swapaxes(1, 2), (torque - weight)[:, :, np.newaxis]
    wrench = np.linalg.solve(to_torque, beside) if n == 6 else np.linalg.pinv(to_torque) @ beside
    return poses, wrench[:, :, 0]
