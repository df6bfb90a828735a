"""Leader arm: any serial arm that the operator holds at E as a haptic device.

M(q) dv/dt + h(q, v) = motors + J^T F_hand - friction,  motors = J^T F_displayed + weight
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.blocks import are_valid_port_values
from drake_teleop.common.compiled import njit
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array, Records
from drake_teleop.common.vectors import (
    add_vector_into,
    copy_into,
    cross,
    quaternion_of_matrix,
    vector_at,
)
from drake_teleop.station.master.device_parameters import DeviceParameters, end_stop_force
from drake_teleop.station.master.dynamics import add_runge_kutta_stage
from drake_teleop.station.slave import arm as serial_arm
from drake_teleop.station.slave.arm import ArmModel
from drake_teleop.station.slave.inverse_kinematics import IkStatus
from drake_teleop.station.slave.joint_control import mass_matrix
from drake_teleop.station.slave.numeric_inverse_kinematics import find_posture

# Rows of `LeaderDevice.joint_table`.
_COULOMB_ROW, _DAMPING_ROW, _MIN_Q_ROW, _MAX_Q_ROW, _STOP_STIFFNESS_ROW = range(5)
_STOP_DAMPING_ROW, _TORQUE_LIMIT_ROW, _CARRIED_WEIGHT_SHARE_ROW = range(5, 8)
# Coulomb friction is proportional to the tanh of speed over this one: a slower joint creeps.
LEADER_FRICTION_TANH_SPEED_SI = 0.02  # rad/s or m/s, estimate
# Natural frequency of the critically damped end stops with the joint's inertia, estimate.
_END_STOP_NATURAL_FREQUENCY_HZ = 12.0


@njit(cache=True)
def leader_acceleration_into(arm, joint_table, q, v, hand_wrench_minus_weight, motor, vdot):
    """Write joint accelerations (n,) [rad/s^2] of leader and hand, for motor torques, into `vdot`.

    `hand_wrench_minus_weight` (6,) is [f; tau] of the hand on E, in B, without its weight.
    """
    n = q.shape[0]
    R_BE, p_BE, tau, wrench = np.empty((3, 3)), np.empty(3), np.empty(n), np.empty(6)
    serial_arm.forward_kinematics(arm, q, R_BE, p_BE)
    copy_into(wrench, 0, hand_wrench_minus_weight, 0, 6)  # becomes the wrench about the origin of B
    add_vector_into(wrench, 3, cross(vector_at(p_BE, 0), vector_at(wrench, 0)))
    for i in range(n):
        tau[i] = motor[i] - joint_table[_COULOMB_ROW, i] * math.tanh(
            v[i] / LEADER_FRICTION_TANH_SPEED_SI
        )
        tau[i] -= joint_table[_DAMPING_ROW, i] * v[i]
        lower, upper, stiffness, damping = joint_table[_MIN_Q_ROW : _STOP_DAMPING_ROW + 1, i]
        tau[i] += end_stop_force(q[i], v[i], lower, upper, stiffness, damping)
    serial_arm.forward_dynamics(arm, q, v, tau, wrench, vdot)


@njit(cache=True)
def _update_pose_and_twist(arm, q, v, pose, twist):
    n = q.shape[0]
    J, x = np.empty((6, n)), np.empty(21)
    serial_arm.jacobian_and_pose(arm, q, J, x)
    turn = quaternion_of_matrix(x[12:].reshape((3, 3)))
    same = 0.0
    for i in range(4):
        same += turn[i] * pose[i]
    for i in range(4):
        pose[i] = turn[i] if same >= 0.0 else -turn[i]
    copy_into(pose, 4, x, 9, 3)
    for i in range(6):
        twist[i] = 0.0
        for k in range(n):
            twist[i] += J[i, k] * v[k]


@njit(cache=True)
def limited_leader_motor_torques_into(leader, q, F, torque):
    """Write motor torques J^T F plus weight compensation (n,), each clipped to its limit.

    F (6,) is the wrench at E; `leader` is `LeaderDevice.compiled_constants`.
    """
    arm_without_hand, arm, joint_table = leader
    n = q.shape[0]
    J, still = np.empty((6, n)), np.zeros(n)
    serial_arm.inverse_dynamics(arm_without_hand, q, still, still, torque)
    serial_arm.jacobian(arm, q, J)
    for i in range(n):
        torque[i] *= joint_table[_CARRIED_WEIGHT_SHARE_ROW, i]
        for k in range(6):
            torque[i] += J[k, i] * F[k]
        limit = joint_table[_TORQUE_LIMIT_ROW, i]
        torque[i] = min(max(torque[i], -limit), limit)


@njit(cache=True)
def step_leader(leader, weight, state, pose, twist, display, hand_wrench, drive, period):
    """Advance `state` (2 n,) by one Runge-Kutta step of `period` [s]; update pose and twist.

    `leader` is `LeaderDevice.compiled_constants`, `weight` [N] the hand's, which the operator
    carries, `display` and `drive` (27,) as in `MasterDevice`, `hand_wrench` (6,) at E, in B.
    """
    _, arm, joint_table = leader
    n = joint_table.shape[1]
    copy_into(display, 6, drive, 6, drive.shape[0] - 6)
    valid = are_valid_port_values(hand_wrench) and are_valid_port_values(drive[:6])
    if valid and are_valid_port_values(state):
        F, applied, motor = np.empty(6), np.empty(6), np.empty(n)
        for i in range(3):
            F[i], F[3 + i] = drive[i], drive[5 - i]
        copy_into(applied, 0, hand_wrench, 0, 6)
        # The arm's own gravity vector may have any direction.
        g = arm[n, serial_arm.LAST_ROW_GRAVITY_COLUMN : serial_arm.LAST_ROW_GRAVITY_COLUMN + 3]
        size = math.sqrt(g[0] * g[0] + g[1] * g[1] + g[2] * g[2])
        for i in range(3):
            applied[i] -= weight * g[i] / size if size > 0.0 else 0.0
        limited_leader_motor_torques_into(leader, state[:n], F, motor)
        stage, slope, total = np.empty(2 * n), np.empty(2 * n), np.zeros(2 * n)
        q, v, vdot = stage[:n], stage[n:], slope[n:]
        copy_into(stage, 0, state, 0, 2 * n)
        for i in range(4):
            copy_into(slope, 0, stage, n, n)
            leader_acceleration_into(arm, joint_table, q, v, applied, motor, vdot)
            add_runge_kutta_stage(i, period, slope, total, stage, state)
        _update_pose_and_twist(arm, state[:n], state[n:], pose, twist)
    for i in range(3):  # position for the display
        display[i] = pose[4 + i] if are_valid_port_values(state) else math.nan


@njit(cache=True)
def scale_wrench_to_motor_limits(leader, q, wrench, limited):
    """Write `wrench` (6,) to `limited`, scaled so that motors with weight keep their limits."""
    _, arm, joint_table = leader
    n = q.shape[0]
    weight, J, share = np.empty(n), np.empty((6, n)), 1.0
    limited_leader_motor_torques_into(leader, q, np.zeros(6), weight)
    serial_arm.jacobian(arm, q, J)
    for i in range(n):
        torque = 0.0
        for k in range(6):
            torque += J[k, i] * wrench[k]
        room = joint_table[_TORQUE_LIMIT_ROW, i] - (weight[i] if torque > 0.0 else -weight[i])
        if abs(torque) * share > room:
            share = max(room, 0.0) / abs(torque)
    for k in range(6):
        limited[k] = share * wrench[k]


@njit(cache=True)
def _flag_samples_at_motor_limit(leader, q, F, torque_share):
    rows, n = q.shape
    flags, torque = np.zeros(rows, np.bool_), np.empty(n)
    for row in range(rows):
        limited_leader_motor_torques_into(leader, q[row], F[row], torque)
        for i in range(n):
            flags[row] |= abs(torque[i]) >= torque_share * leader[2][_TORQUE_LIMIT_ROW, i]
    return flags


@dataclass(frozen=True)
class LeaderDevice:
    """Leader arm with the hand's passive mass; methods as for `HapticDevice`.

    Attributes:
        arm: dynamics of the chain from B to E, with the hand's mass.
        arm_without_hand: dynamics without the hand, for weight compensation.
        joint_table: (8, n) rows: Coulomb friction [N m], damping in addition to the model's
            [N m s/rad], lower and upper limits [rad], stiffness [N m/rad], damping [N m s/rad] of
            end stops, torque limits [N m], compensated share of the weight.
        home: (n,) joint positions [rad] at which E is parallel to B.
        packed_parameters: parameters for the force display, in an array (1,).
    """

    arm: ArmModel
    arm_without_hand: ArmModel
    joint_table: Array
    home: Array
    packed_parameters: Records
    name: str = "leader"
    is_phantom = False
    #: Scenario field of the friction.
    friction_setting_name = "master.leader"

    @property
    def parameters(self) -> DeviceParameters:
        return self.packed_parameters[0]

    @property
    def num_joints(self) -> int:
        return self.arm.num_joints

    @property
    def sliding_joints(self) -> tuple[int, ...]:
        return self.arm.sliding_joints

    @property
    def hand_weight(self) -> float:
        """Weight of the hand [N]."""
        gravity = np.linalg.norm(self.arm.table[-1, serial_arm.LAST_ROW_GRAVITY_COLUMN :][:3])
        return float(self.parameters.hand_mass * gravity)

    @property
    def compiled_constants(self) -> tuple[Array, Array, Array]:
        """Arm tables without and with the hand, and `joint_table`."""
        return self.arm_without_hand.table, self.arm.table, self.joint_table

    def coordinates_for_force_display(self, q: Array) -> Array:
        """Return the vector (6,) for the force display: position of E (3) [m], three zeros."""
        return np.append(self.forward_kinematics(q)[4:], np.zeros(3))

    def inverse_kinematics(self, pose: Array) -> Array:
        """Return joint positions (n,) for the pose X_BE (7,), found by a search from home."""
        if np.allclose(pose, self.forward_kinematics(self.home), rtol=0, atol=1e-9):
            return self.home.copy()
        q, status = find_posture(self.arm, np.asarray(pose, dtype=float), self.home)
        if status != IkStatus.OK:
            place = ", ".join(f"{x:.3g}" for x in pose[4:])
            cause = f"inverse kinematics: {status.name}"
            what = f"the leader arm cannot reach ({place}) m in B ({cause})"
            remedy = "choose a position that its joints reach, or another master.leader.home"
            raise DrakeTeleopError(what, where="master.position", remedy=remedy)
        return q

    def forward_kinematics(self, q: Array) -> Array:
        pose = np.array([1.0, *np.zeros(6)])
        _update_pose_and_twist(self.arm.table, np.asarray(q), np.zeros(len(q)), pose, np.empty(6))
        return pose

    def check_limits(self, q: Array) -> None:
        lower, upper = self.joint_table[[_MIN_Q_ROW, _MAX_Q_ROW]]
        for k in np.flatnonzero((q < lower) | (q > upper)):
            joint, limits = self.arm.joint_names[k], f"{lower[k]:.3g} to {upper[k]:.3g} (rad or m)"
            what = f"leader joint {joint} would be at {q[k]:.3g}, outside its limits {limits}"
            remedy = "choose leader.home and master.position within the joint limits"
            raise DrakeTeleopError(what, where="master.leader.home", remedy=remedy)

    def flag_samples_at_motor_limit(self, q: Array, F: Array, share: float) -> NDArray[np.bool_]:
        """Return flags (N,): a motor's torque is at least `share` of its limit.

        The motors compensate the weight at joint positions q (N, n) and display F (N, 6) at E.
        """
        constants = self.compiled_constants
        return np.asarray(_flag_samples_at_motor_limit(constants, q.copy(), F.copy(), share))

    def flag_samples_at_end_stop(self, q: Array) -> NDArray[np.bool_]:
        return ((q < self.joint_table[_MIN_Q_ROW]) | (q > self.joint_table[_MAX_Q_ROW])).any(axis=1)

    def jacobian(self, q: Array) -> Array:
        J = np.empty((6, self.num_joints))
        serial_arm.jacobian(self.arm.table, np.asarray(q), J)
        return J

    def mass_matrix(self, q: Array) -> Array:
        return mass_matrix(self.arm, np.asarray(q))

    def damping_matrix(self, q: Array, include_coulomb_slope: bool = False) -> Array:
        own = self.joint_table[_DAMPING_ROW] + self.arm.table[:-1, serial_arm.DAMPING_COLUMN]
        slope = self.joint_table[_COULOMB_ROW] / LEADER_FRICTION_TANH_SPEED_SI
        return np.diag(own + include_coulomb_slope * slope)


def make_leader_joint_table(
    arm: ArmModel, home: Array, coulomb: Array, viscous: Array, limit: Array, weight_share: float
) -> Array:
    """Return `LeaderDevice.joint_table` (8, n); end stops have 12 Hz with the inertia at home.

    `coulomb` and `limit` (n,) are friction and torque limit [N m], `viscous` (n,) further damping
    [N m s/rad], `weight_share` the compensated share of the weight.
    """
    inertia, w = np.diag(mass_matrix(arm, home)), 2 * np.pi * _END_STOP_NATURAL_FREQUENCY_HZ
    rows = [coulomb, viscous, arm.lower, arm.upper, w**2 * inertia, 2 * w * inertia, limit]
    return np.array([*rows, np.full(len(home), weight_share)])
