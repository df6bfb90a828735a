"""Compiled dynamics of a haptic device, a `DEVICE_DTYPE` record; B: base frame, E: stylus frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.compiled import njit
from drake_teleop.common.numeric import Array, Records
from drake_teleop.common.vectors import copy_into
from drake_teleop.station.master import phantom, task_space
from drake_teleop.station.master.device_parameters import DeviceParameters


@njit(cache=True)
def jacobian_into(q, device, J):
    """Write the Jacobian (6, 6) of the stylus E, rows [v; omega] in the base B, into J."""
    if device.in_task_space:
        task_space.jacobian_into(q, J)
    else:
        phantom.jacobian_into(q, J)


@njit(cache=True)
def gravity_compensation_torque_into(q, device, out):
    """Write joint torques (6,) that cancel the weight into `out`; 0 for a `task_space` device."""
    if device.in_task_space:
        out[:6] = 0.0
    else:
        phantom.gravity_compensation_torque_into(q, out)


@njit(cache=True)
def pose_into(q, device, pose):
    """Write the stylus pose X_BE (7,) at the joint positions q (6,) into `pose`."""
    if device.in_task_space:
        task_space.pose_into(q, pose)
    else:
        phantom.pose_into(q, pose)


@njit(cache=True)
def twist_into(q, v, device, J, twist):
    """Write the twist (6,) [v; omega] of the stylus E in B into `twist`, its Jacobian into `J`."""
    jacobian_into(q, device, J)
    for i in range(6):
        twist[i] = 0.0
        for k in range(6):
            twist[i] += J[i, k] * v[k]


@njit(cache=True)
def add_runge_kutta_stage(i, period, slope, total, stage, state):
    """Add `slope` of stage i to `total`; write the next `stage`, or after stage 3 `state`."""
    weight = 1.0 / 6.0 if i in (0, 3) else 1.0 / 3.0
    ahead = 1.0 if i == 2 else 0.5
    for k in range(state.shape[0]):
        total[k] += weight * slope[k]
        stage[k] = state[k] + ahead * period * slope[k]
        if i == 3:
            state[k] += period * total[k]


@njit(cache=True)
def step_device(state, hand_wrench, motor, device, period, work, stages):
    """Advance `state` (12,) [q; v] in place by one Runge-Kutta step of `period` [s].

    `hand_wrench` (6,) is [f; tau] of the hand on the stylus at E, in B; `motor` (6,) are the motor
    torques or forces at the joints; `work` and `stages` are scratch arrays.
    """
    stage, slope, total = stages[0], stages[1], stages[2]
    q, v, vdot = stage[:6], stage[6:], slope[6:]
    copy_into(stage, 0, state, 0, 12)
    total[:] = 0.0
    for i in range(4):
        copy_into(slope, 0, stage, 6, 6)
        if device.in_task_space:
            task_space.joint_acceleration_into(q, v, hand_wrench, motor, device, work, vdot)
        else:
            phantom.joint_acceleration_into(q, v, hand_wrench, motor, device, work, vdot)
        add_runge_kutta_stage(i, period, slope, total, stage, state)


@dataclass(frozen=True)
class HapticDevice:
    """Dynamics of a haptic device (Phantom or `task_space`) with the hand's passive mass.

    Joint positions q are (6,) [rad; in task space m, rad]. B is the base frame, E the stylus.
    """

    packed_parameters: Records
    name: str = "phantom_premium_15"

    num_joints = 6

    @property
    def parameters(self) -> DeviceParameters:
        return self.packed_parameters[0]

    @property
    def friction_setting_name(self) -> str:
        return "master.friction" if self.is_phantom else "master.figures"

    def coordinates_for_force_display(self, q: Array) -> Array:
        return q

    @property
    def sliding_joints(self) -> tuple[int, ...]:
        """Indices of the prismatic joints."""
        return () if self.is_phantom else (0, 1, 2)

    @property
    def is_phantom(self) -> bool:
        return not self.parameters.in_task_space

    def inverse_kinematics(self, pose: Array) -> Array:
        """Return the joint positions (6,) for a stylus pose X_BE (7,)."""
        if self.is_phantom:
            return phantom.inverse_kinematics(pose)
        return task_space.inverse_kinematics(pose, self.parameters)

    def forward_kinematics(self, q: Array) -> Array:
        """Return the stylus pose X_BE (7,) at the joint positions q (6,)."""
        pose = np.empty(7)
        pose_into(q, self.parameters, pose)
        return pose

    def check_limits(self, q: Array) -> None:
        if self.is_phantom:
            phantom.check_limits(q)
        else:
            task_space.check_limits(q, self.parameters)

    def flag_samples_at_end_stop(self, q: Array) -> NDArray[np.bool_]:
        """Return flags (N,): True where an end stop acts at the row of q (N, 6)."""
        if self.is_phantom:
            return phantom.flag_samples_at_end_stop(q)
        return task_space.flag_samples_at_end_stop(q, self.parameters)

    def jacobian(self, q: Array) -> Array:
        J = np.empty((6, 6))
        jacobian_into(q, self.parameters, J)
        return J

    def mass_matrix(self, q: Array) -> Array:
        """Return the joints' mass matrix (6, 6), including the hand."""
        J, M, device = self.jacobian(q), np.empty((6, 6)), self.parameters
        if self.is_phantom:
            phantom.joint_mass_matrix_into(q, J, device.hand_mass, device.hand_inertia, M)
        else:
            task_space.joint_mass_matrix_into(J, device, M)
        return M

    def damping_matrix(self, q: Array, include_coulomb_slope: bool = False) -> Array:
        """Return the damping matrix D (6, 6) of the joint forces -D dq/dt.

        `include_coulomb_slope` adds the derivative of Coulomb friction by speed, at rest.
        """
        if self.is_phantom:
            slope = self.parameters.dry_friction / phantom.FRICTION_TANH_SPEED_RAD_S
            return np.diag(include_coulomb_slope * slope + self.parameters.damping)
        return task_space.damping_matrix(q, self.parameters, include_coulomb_slope)
