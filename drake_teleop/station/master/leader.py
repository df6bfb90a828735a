"""Leader arm: any serial arm that the operator holds at E as a haptic device.

M(q) dv/dt + h(q, v) = motors + J^T F_hand - friction,  motors = J^T F_displayed + weight
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import BasicVector, Context

from drake_teleop.common.blocks import all_in_range
from drake_teleop.common.compiled import njit
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.vectors import copy_into, cross, quaternion_of_matrix, vector_at
from drake_teleop.station.master.device_parameters import HAND_MASS
from drake_teleop.station.master.dynamics import DisplayDevice
from drake_teleop.station.master.force_display import DeviceBlock, ForceDisplay, step_display
from drake_teleop.station.slave.arm import (
    DAMPING_COLUMN,
    GRAVITY_COLUMN,
    ArmModel,
    forward_dynamics,
    forward_kinematics,
    inverse_dynamics,
    jacobian,
    jacobian_and_pose,
)
from drake_teleop.station.slave.inverse_kinematics import IkStatus
from drake_teleop.station.slave.joint_control import mass_matrix
from drake_teleop.station.slave.numeric_inverse_kinematics import find_posture

Array = NDArray[np.float64]

# Rows of `LeaderDevice.joints`.
(
    _COULOMB,
    _VISCOUS,
    _LOWER,
    _UPPER,
    _STOP_STIFFNESS,
    _STOP_DAMPING,
    _TORQUE_LIMIT,
    _WEIGHT_SHARE,
) = range(8)
# Coulomb friction is proportional to tanh(speed / FRICTION_SPEED): a slower joint creeps.
FRICTION_SPEED = 0.02  # rad/s or m/s, estimate
# Natural frequency of the critically damped end stops with the joint's inertia, estimate.
_END_STOP_FREQUENCY_HZ = 12.0


@njit(cache=True)
def leader_acceleration(arm, joints, q, v, applied, motor, vdot):
    """Write the joint accelerations (n,) [rad/s^2] of leader and hand into `vdot`.

    `applied` (6,) is the hand's wrench minus the hand's weight, [f; tau] on E, in B.
    """
    n = q.shape[0]
    R_BE, p_BE, tau, wrench = np.empty((3, 3)), np.empty(3), np.empty(n), np.empty(6)
    forward_kinematics(arm, q, R_BE, p_BE)
    copy_into(wrench, 0, applied, 0, 6)  # becomes the wrench about the origin of B
    moment = cross(vector_at(p_BE, 0), vector_at(applied, 0))
    for i in range(3):
        wrench[3 + i] += moment[i]
    for i in range(n):
        tau[i] = motor[i] - joints[_COULOMB, i] * math.tanh(v[i] / FRICTION_SPEED)
        tau[i] -= joints[_VISCOUS, i] * v[i]
        over, under = q[i] - joints[_UPPER, i], q[i] - joints[_LOWER, i]
        damping = joints[_STOP_DAMPING, i] * v[i]
        if over > 0.0:
            tau[i] += min(0.0, -joints[_STOP_STIFFNESS, i] * over - damping)
        elif under < 0.0:
            tau[i] += max(0.0, -joints[_STOP_STIFFNESS, i] * under - damping)
    forward_dynamics(arm, q, v, tau, wrench, vdot)


@njit(cache=True)
def _update_pose_and_twist(arm, q, v, pose, twist):
    n = q.shape[0]
    J, x = np.empty((6, n)), np.empty(21)
    jacobian_and_pose(arm, q, J, x)
    turn = quaternion_of_matrix(x[12:].reshape((3, 3)))
    same = 0.0
    for i in range(4):
        same += turn[i] * pose[i]
    for i in range(4):
        pose[i] = turn[i] if same >= 0.0 else -turn[i]
    for i in range(3):
        pose[4 + i] = x[9 + i]
    for i in range(6):
        twist[i] = 0.0
        for k in range(n):
            twist[i] += J[i, k] * v[k]


@njit(cache=True)
def motor_torques_into(bare, arm, joints, q, F, torque):
    """Write the motor torques J^T F plus weight compensation (n,), within the torque limits.

    F (6,) is the wrench at E; `bare` is `ArmModel.table` without the hand.
    """
    n = q.shape[0]
    J, still = np.empty((6, n)), np.zeros(n)
    inverse_dynamics(bare, q, still, still, torque)
    jacobian(arm, q, J)
    for i in range(n):
        torque[i] *= joints[_WEIGHT_SHARE, i]
        for k in range(6):
            torque[i] += J[k, i] * F[k]
        limit = joints[_TORQUE_LIMIT, i]
        torque[i] = min(max(torque[i], -limit), limit)


@njit(cache=True)
def step_leader(
    bare, arm, joints, hand_weight, state, pose, twist, display, hand_wrench, drive, period
):  # fmt: skip
    """Advance `state` (2 n,) by one Runge-Kutta step of `period` [s]; update pose and twist.

    `bare` and `arm` are `ArmModel.table` without and with the hand, whose weight `hand_weight` [N]
    the operator carries.
    """
    n = joints.shape[1]
    copy_into(display, 6, drive, 6, drive.shape[0] - 6)
    if all_in_range(hand_wrench) and all_in_range(drive[:6]) and all_in_range(state):
        F, applied, motor = np.empty(6), np.empty(6), np.empty(n)
        for i in range(3):
            F[i], F[3 + i] = drive[i], drive[5 - i]
        copy_into(applied, 0, hand_wrench, 0, 6)
        # The arm's own gravity vector may have any direction.
        g = arm[n, GRAVITY_COLUMN : GRAVITY_COLUMN + 3]
        size = math.sqrt(g[0] * g[0] + g[1] * g[1] + g[2] * g[2])
        for i in range(3):
            applied[i] -= hand_weight * g[i] / size if size > 0.0 else 0.0
        motor_torques_into(bare, arm, joints, state[:n], F, motor)
        stage, slope, total = np.empty(2 * n), np.empty(2 * n), np.zeros(2 * n)
        copy_into(stage, 0, state, 0, 2 * n)
        for i in range(4):
            copy_into(slope, 0, stage, n, n)
            leader_acceleration(arm, joints, stage[:n], stage[n:], applied, motor, slope[n:])
            weight = 1.0 / 6.0 if i in (0, 3) else 1.0 / 3.0
            ahead = 1.0 if i == 2 else 0.5
            for k in range(2 * n):
                total[k] += weight * slope[k]
                stage[k] = state[k] + ahead * period * slope[k]
        for k in range(2 * n):
            state[k] += period * total[k]
        _update_pose_and_twist(arm, state[:n], state[n:], pose, twist)
    for i in range(3):  # position for the display
        display[i] = pose[4 + i] if all_in_range(state) else math.nan


@njit(cache=True)
def _limit_wrench_to_motors(bare, arm, joints, q, wrench, shortened):
    n = q.shape[0]
    weight, J, share = np.empty(n), np.empty((6, n)), 1.0
    motor_torques_into(bare, arm, joints, q, np.zeros(6), weight)
    jacobian(arm, q, J)
    for i in range(n):
        torque = 0.0
        for k in range(6):
            torque += J[k, i] * wrench[k]
        room = joints[_TORQUE_LIMIT, i] - (weight[i] if torque > 0.0 else -weight[i])
        if abs(torque) * share > room:
            share = max(room, 0.0) / abs(torque)
    for k in range(6):
        shortened[k] = share * wrench[k]


@dataclass(frozen=True)
class LeaderDevice(DisplayDevice):
    """Leader arm with the hand's passive mass; methods as for `HapticDevice`.

    Attributes:
        arm: dynamics of the chain from B to E, with the hand's mass.
        bare: dynamics without the hand, for weight compensation.
        joints: (8, n) Coulomb friction [N m], damping in addition to the model's [N m s/rad], lower
            and upper limits [rad], stiffness and damping of the end stops, torque limits [N m],
            compensated share of the weight.
        home: (n,) joint positions where E has the axes of B [rad].
        numbers: (NUM_DEVICE_PARAMETERS,) parameters for the force display.
    """

    arm: ArmModel
    bare: ArmModel
    joints: Array
    home: Array
    numbers: Array
    name: str = "leader"
    is_phantom = False
    #: Scenario field of the friction.
    friction_field = "master.leader"

    @property
    def num_joints(self) -> int:
        return self.arm.num_joints

    @property
    def compiled_constants(self) -> tuple[Array, Array, Array]:
        return self.bare.table, self.arm.table, self.joints

    def coordinates_for_display(self, q: Array) -> Array:
        """Return the vector (6,) for the force display: position of E (3) [m], three zeros."""
        return np.append(self.forward_kinematics(q)[4:], np.zeros(3))

    def inverse_kinematics(self, pose: Array) -> Array:
        """Return joint positions (n,) for the pose X_BE (7,), by a search from home."""
        if np.allclose(pose, self.forward_kinematics(self.home), rtol=0, atol=1e-9):
            return self.home.copy()
        q, status = find_posture(self.arm, np.asarray(pose, dtype=float), self.home)
        if status != IkStatus.OK:
            raise DrakeTeleopError(
                f"the leader arm cannot reach ({', '.join(f'{x:.3g}' for x in pose[4:])}) m in B"
                f" (inverse kinematics: {status.name})",
                where="pose_master",
                remedy="choose a pose that its joints reach, or another home",
            )
        return q

    def forward_kinematics(self, q: Array) -> Array:
        pose = np.array([1.0, *np.zeros(6)])
        _update_pose_and_twist(self.arm.table, np.asarray(q), np.zeros(len(q)), pose, np.empty(6))
        return pose

    def check_limits(self, q: Array) -> None:
        for k in np.flatnonzero((q < self.joints[_LOWER]) | (q > self.joints[_UPPER])):
            raise DrakeTeleopError(
                f"leader joint {self.arm.joint_names[k]} would be at {q[k]:.3g}, outside its limits"
                f" {self.joints[_LOWER, k]:.3g} and {self.joints[_UPPER, k]:.3g} (rad or m)",
                where="master.leader.home",
                remedy="start within the limits of its joints",
            )

    def is_at_end_stop(self, q: Array) -> NDArray[np.bool_]:
        return ((q < self.joints[_LOWER]) | (q > self.joints[_UPPER])).any(axis=1)

    def jacobian(self, q: Array) -> Array:
        J = np.empty((6, self.num_joints))
        jacobian(self.arm.table, np.asarray(q), J)
        return J

    def mass_matrix(self, q: Array) -> Array:
        return mass_matrix(self.arm, np.asarray(q))

    def damping_matrix(self, q: Array, creeping: bool = False) -> Array:
        own = self.joints[_VISCOUS] + self.arm.table[:-1, DAMPING_COLUMN]
        return np.diag(own + creeping * self.joints[_COULOMB] / FRICTION_SPEED)


def joint_parameters(
    arm: ArmModel, home: Array, coulomb: Array, viscous: Array, limit: Array, carried: float
) -> Array:
    """Return `LeaderDevice.joints` (8, n); the end stops scale with the inertia at home.

    `coulomb` and `limit` are friction and torque limit [N m], `viscous` the damping in addition to
    the model's [N m s/rad], each (n,); `carried` is the compensated share of the weight.
    """
    inertia, w = np.diag(mass_matrix(arm, home)), 2 * np.pi * _END_STOP_FREQUENCY_HZ
    rows = [coulomb, viscous, arm.lower, arm.upper, w**2 * inertia, 2 * w * inertia, limit]
    return np.array([*rows, np.full(len(home), carried)])


class LeaderArm(DeviceBlock):
    """Leader arm with n joints and the hand's passive mass, advanced once per period.

    .. pydrake_system::

        name: LeaderArm
        input_ports:
        - hand_wrench_E: (6,) as for `MasterDevice`
        - drive: (27,) from `LeaderDisplay`: wrench F (6) to display, the display's memory
        output_ports:
        - state: (2 n,) [q; qdot] [rad, rad/s]
        - pose_master: (7,) X_BE
        - twist_master: (6,) [v; omega] of E in B
        - for_display: (27,) position of E (3), three unused zeros, the display's memory
    """

    __slots__ = ()

    def __init__(self, period: float, device: LeaderDevice, q_initial: Array) -> None:
        constants = (*device.compiled_constants, _operator_hand_weight(device))
        super().__init__(period, device, q_initial, step_leader, constants)


def _operator_hand_weight(device: LeaderDevice) -> float:
    gravity = np.linalg.norm(device.arm.table[-1, GRAVITY_COLUMN : GRAVITY_COLUMN + 3])
    return float(device.numbers[HAND_MASS] * gravity)


class LeaderDisplay(ForceDisplay):
    """Force display of a leader arm, limited by motor torques after weight compensation.

    .. pydrake_system::

        name: LeaderDisplay
        input_ports:
        - wrench_command: (6,) F_E_B to render
        - for_display: from `LeaderArm`
        - state: (2 n,) of `LeaderArm`
        output_ports:
        - drive: for `LeaderArm`
        - force_to_master: (6,) wrench F, displayed within the limits [N, N m]
        - fault_at_hand: code of `blocks.Fault`
        - displayed_and_fault: (7,) the last two ports in one vector
    """

    __slots__ = ()

    def __init__(self, period: float, device: LeaderDevice) -> None:
        super().__init__(period, device)
        self._joints = self.DeclareVectorInputPort("state", 2 * device.num_joints)
        self._constants, self._n = device.compiled_constants, device.num_joints
        self._shortened = np.zeros(6)

    def _calc_drive(self, context: Context, output: BasicVector) -> None:
        wrench, q = self._command.Eval(context), self._joints.Eval(context)[: self._n]
        if np.isfinite(wrench).all() and np.isfinite(q).all():
            _limit_wrench_to_motors(*self._constants, q, wrench, self._shortened)
            wrench = self._shortened
        step_display(
            wrench,
            self._device.Eval(context),
            self._numbers,
            self._period,
            self._jacobian,
            output.get_mutable_value(),
        )
