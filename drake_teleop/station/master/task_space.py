"""Haptic device defined by its data sheet: dynamics of the grip in task space.

q (6,) = [x, y, z, yaw, pitch, roll] [m, rad],  p_BE = q[:3],  R_BE = Rz(q4) Ry(q5) Rx(q6)
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RollPitchYaw, RotationMatrix

from drake_teleop.common.compiled import njit
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.common.vectors import cross, plus, quaternion_product, scale_vector
from drake_teleop.station.master.device_parameters import DeviceParameters, end_stop_force

# Coulomb friction is proportional to tanh(speed / FRICTION_TANH_SPEED_M_S): a slower device creeps.
FRICTION_TANH_SPEED_M_S, FRICTION_TANH_SPEED_RAD_S = 0.002, 0.01  # m/s, rad/s, estimate
# End stops: spring and damper that never pull, estimate.
_STOP_STIFFNESS_N_M, _STOP_DAMPING_N_S_M = 5000.0, 20.0  # N/m, N s/m
_STOP_STIFFNESS_N_M_RAD, _STOP_DAMPING_N_M_S_RAD = 5.0, 0.01  # N m/rad, N m s/rad


@njit(cache=True)
def jacobian_into(q, J):
    s4, c4 = math.sin(q[3]), math.cos(q[3])
    s5, c5 = math.sin(q[4]), math.cos(q[4])
    J[:, :] = 0.0
    J[0, 0] = J[1, 1] = J[2, 2] = J[5, 3] = 1.0
    J[3, 4], J[4, 4] = -s4, c4
    J[3, 5], J[4, 5], J[5, 5] = c4 * c5, s4 * c5, -s5


@njit(cache=True)
def joint_mass_matrix_into(J, device, M):
    M[:, :] = 0.0
    inertia = device.inertia + device.hand_inertia
    for i in range(3):
        M[i, i] = device.mass + device.hand_mass
        for k in range(3):
            for row in range(3, 6):
                M[3 + i, 3 + k] += inertia * J[row, 3 + i] * J[row, 3 + k]


@njit(cache=True)
def _friction_force_to_speed_ratio(velocity, coulomb, viscous, tanh_speed):
    speed = math.hypot(math.hypot(velocity[0], velocity[1]), velocity[2])
    if speed < 1e-9 * tanh_speed:  # tanh(x) = x, without 0 / 0
        return viscous + coulomb / tanh_speed
    return viscous + coulomb * math.tanh(speed / tanh_speed) / speed


@njit(cache=True)
def joint_acceleration_into(q, v, hand_wrench, motor, device, work, vdot):
    J = work[0]
    jacobian_into(q, J)
    mass = device.mass + device.hand_mass
    drag = _friction_force_to_speed_ratio(
        v[:3], device.dry_friction[0], device.damping[0], FRICTION_TANH_SPEED_M_S
    )
    for i in range(3):
        x, half = q[i] - device.workspace_centre[i], device.half_workspace[i]
        stop = end_stop_force(x, v[i], -half, half, _STOP_STIFFNESS_N_M, _STOP_DAMPING_N_S_M)
        vdot[i] = (hand_wrench[i] + motor[i] + stop - drag * v[i]) / mass

    # Rotation: alpha = sum (axis vdot + omega of the axis x axis v), solved for vdot.
    inertia = device.inertia + device.hand_inertia
    omega, bias = (0.0, 0.0, v[3]), (0.0, 0.0, 0.0)
    for k in range(4, 6):
        turn = scale_vector(v[k], (J[3, k], J[4, k], J[5, k]))
        bias = plus(bias, cross(omega, turn))
        omega = plus(omega, turn)
    drag = _friction_force_to_speed_ratio(
        omega, device.dry_friction[3], device.damping[3], FRICTION_TANH_SPEED_RAD_S
    )
    # Joint torques of motors and stops, then of moments about B's axes.
    torque = np.empty(3)
    for i in range(3):
        half = device.max_rotation[i]
        torque[i] = motor[3 + i] + end_stop_force(
            q[3 + i], v[3 + i], -half, half, _STOP_STIFFNESS_N_M_RAD, _STOP_DAMPING_N_M_S_RAD
        )
        for k in range(3):
            about = hand_wrench[3 + k] - drag * omega[k] - inertia * bias[k]
            torque[i] += J[3 + k, 3 + i] * about
    # J^T J of the rotational axes is [[1, 0, -s5], [0, 1, 0], [-s5, 0, 1]].
    s5 = math.sin(q[4])
    determinant = 1.0 - s5 * s5
    vdot[3] = (torque[0] + s5 * torque[2]) / (determinant * inertia)
    vdot[4] = torque[1] / inertia
    vdot[5] = (torque[2] + s5 * torque[0]) / (determinant * inertia)


@njit(cache=True)
def pose_into(q, pose):
    s4, c4 = math.sin(0.5 * q[3]), math.cos(0.5 * q[3])
    s5, c5 = math.sin(0.5 * q[4]), math.cos(0.5 * q[4])
    s6, c6 = math.sin(0.5 * q[5]), math.cos(0.5 * q[5])
    yawed = c4 * c5, -s4 * s5, c4 * s5, s4 * c5
    pose[0], pose[1], pose[2], pose[3] = quaternion_product(yawed, (c6, s6, 0.0, 0.0))
    for i in range(3):
        pose[4 + i] = q[i]


def damping_matrix(q: Array, device: DeviceParameters, include_coulomb_slope: bool) -> Array:
    J = np.empty((6, 6))
    jacobian_into(q, J)
    of_tanh = np.array([FRICTION_TANH_SPEED_M_S, FRICTION_TANH_SPEED_RAD_S])
    drag = device.damping[[0, 3]] + include_coulomb_slope * device.dry_friction[[0, 3]] / of_tanh
    return J.T @ np.diag(np.repeat(drag, 3)) @ J


def inverse_kinematics(pose: Array, device: DeviceParameters) -> Array:
    turned = RollPitchYaw(RotationMatrix(Quaternion(pose[:4] / np.linalg.norm(pose[:4]))))
    turns = [turned.yaw_angle(), turned.pitch_angle(), turned.roll_angle()]
    q = np.concatenate([pose[4:7], turns])
    check_limits(q, device)
    return q


def _are_axes_past_end_stop(q: Array, device: DeviceParameters, margin: float) -> NDArray[np.bool_]:
    centre = np.append(device.workspace_centre, np.zeros(3))
    half = np.append(device.half_workspace, device.max_rotation)
    return np.abs(q - centre) > half + margin


def flag_samples_at_end_stop(q: Array, device: DeviceParameters) -> NDArray[np.bool_]:
    has_end_stop = np.append([True] * 3, device.max_rotation > 0.0)
    return (_are_axes_past_end_stop(q, device, 0.0) & has_end_stop).any(axis=1)


def check_limits(q: Array, device: DeviceParameters) -> None:
    if _are_axes_past_end_stop(q, device, 1e-9).any():
        centre, half = device.workspace_centre, device.half_workspace
        low, high = centre - half, centre + half
        axes = ", ".join(f"{a:.3g} to {b:.3g}" for a, b in zip(low, high, strict=True))
        turns = ", ".join(f"{a:.0f}" for a in np.degrees(device.max_rotation))
        what = f"the grip would be at ({', '.join(f'{x:.3g}' for x in q[:3])}) m, yaw, pitch, roll"
        what = f"{what} ({', '.join(f'{x:.0f}' for x in np.degrees(q[3:]))}) degrees; the device's"
        what = f"{what} workspace is {axes} m, +-({turns}) degrees"
        remedy = "choose a start position inside the device's workspace, in its base frame B"
        raise DrakeTeleopError(what, where="master.position", remedy=remedy)
