"""The Phantom Premium 1.5 HighForce/6DoF: kinematics and dynamics in closed form.

B: base frame at the intersection of yaw and shoulder axis, z up, x towards the operator. E: stylus
frame at the gimbal point. q (6,) [rad]: yaw; inner link up from the horizontal; outer link from the
downward vertical towards x_B (absolute); wrist yaw, pitch, roll.

    p_BE = Rz(q1) [l1 cos q2 + l2 sin q3, 0, l1 sin q2 - l2 cos q3]
    R_BE = Rz(q1) Ry(-q3) Rz(q4) Ry(q5) Rx(q6), singular at q5 = +-90 degrees

Comments name sources: P: Cavusoglu, Feygin, Tendick 2002, from mahilab/Phantom; D: manufacturer.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RollPitchYaw, RotationMatrix

from drake_teleop.common import vectors
from drake_teleop.common.compiled import njit
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.station.master.device_parameters import end_stop_force

GRAVITY_M_S2 = 9.81  # m/s^2, along -z_B

L1, L2, L3, L5, L6 = 0.215, 0.170, 0.0325, -0.0368, 0.0527  # m, P
# Mass [kg] and inertia [kg m^2] of P's segments a, c, be, df about x (the pitch axis), y and z.
MASS_A, MASS_C, MASS_BE, MASS_DF = 0.0202, 0.0249, 0.2359, 0.1906
SEGMENT_A_INERTIA_KG_M2 = (0.4864e-4, 0.001843e-4, 0.4864e-4)
SEGMENT_C_INERTIA_KG_M2 = (0.959e-4, 0.959e-4, 0.0051e-4)
SEGMENT_BE_INERTIA_KG_M2 = (11.09e-4, 10.06e-4, 0.591e-4)
SEGMENT_DF_INERTIA_KG_M2 = (7.11e-4, 0.629e-4, 6.246e-4)
BASE_INERTIA_YY_KG_M2 = 11.87e-4
GEAR_RATIOS = (13.3, 11.2, 11.2)  # P
MOTOR_INERTIA_KG_M2 = 1.08e-6  # kg m^2, P
WRIST_MASS_KG = 0.15  # kg, three links, each with its centre of mass at E, estimate
WRIST_LINK_INERTIA_KG_M2 = 5e-5  # kg m^2, each wrist link, about every axis, estimate

#: Joint limits [rad]: main axes P, wrist (297, 260, 335 degrees in all) D.
JOINT_LOWER_RAD = np.radians([-90.0, -124.0, -29.0, -148.5, -130.0, -167.5])
JOINT_UPPER_RAD = np.radians([90.0, 119.0, 214.0, 148.5, 130.0, 167.5])
#: Range of q2 - q3 [rad], limited by the five-bar, P.
Q2_MINUS_Q3_RANGE_RAD = (math.radians(-55.0), math.radians(65.0))
PEAK_FORCE_N = 37.5  # N, peak at the gimbal point, D
PEAK_WRIST_TORQUES_N_M = np.array([0.515, 0.515, 0.170])  # N m, peak at q4, q5, q6, D

#: Posture with R_BE = identity, in the middle of the workspace.
HOME_POSTURE_RAD = np.zeros(6)

# Coulomb friction is proportional to tanh(velocity / this): a slower device creeps.
FRICTION_TANH_SPEED_RAD_S = 0.01  # rad/s, estimate
# End stops of main axes and wrist: spring [N m/rad] and damper [N m s/rad] that never pull,
# estimate: 7 kN/m at the tip.
_STOP_STIFFNESSES, _STOP_DAMPINGS = np.repeat([300.0, 5.0], 3), np.repeat([1.5, 0.01], 3)

# Moments of inertia of the point masses of the links.
_LINK_1_STEINER_KG_M2 = L1**2 * (MASS_A + MASS_C / 4)
_LINK_2_STEINER_KG_M2, _LINK_3_STEINER_KG_M2 = L2**2 * MASS_A / 4, L3**2 * MASS_C
# Terms of M11: constant, times cos 2 q2, times cos 2 q3, 2 _M23_MAX_KG_M2 times cos q2 sin q3.
_a, _be = SEGMENT_A_INERTIA_KG_M2, SEGMENT_BE_INERTIA_KG_M2
_c, _df = SEGMENT_C_INERTIA_KG_M2, SEGMENT_DF_INERTIA_KG_M2
_yy_zz_sum_kg_m2 = sum(sum(inertia[1:]) for inertia in (_a, _be, _c, _df)) + _LINK_1_STEINER_KG_M2
_yy_zz_sum_kg_m2 = _yy_zz_sum_kg_m2 + _LINK_2_STEINER_KG_M2 + _LINK_3_STEINER_KG_M2
_M11_CONSTANT_TERM_KG_M2 = BASE_INERTIA_YY_KG_M2 + 0.5 * _yy_zz_sum_kg_m2
_M11_COS_2Q2_KG_M2 = 0.5 * (_be[1] - _be[2] + _c[1] - _c[2] + _LINK_1_STEINER_KG_M2)
_M11_COS_2Q3_KG_M2 = 0.5 * (_a[1] - _a[2] + _df[1] - _df[2] - _LINK_2_STEINER_KG_M2)
_M11_COS_2Q3_KG_M2 -= 0.5 * _LINK_3_STEINER_KG_M2
_M23_MAX_KG_M2 = 0.5 * L1 * (L2 * MASS_A + L3 * MASS_C)
_M22_KG_M2 = _be[0] + _c[0] + _LINK_1_STEINER_KG_M2
_M33_KG_M2 = _a[0] + _df[0] + _LINK_2_STEINER_KG_M2 + _LINK_3_STEINER_KG_M2
_REFLECTED_MOTOR_INERTIAS_KG_M2 = tuple(gear**2 * MOTOR_INERTIA_KG_M2 for gear in GEAR_RATIOS)
_JOINT_2_GRAVITY_N_M = 0.5 * GRAVITY_M_S2 * (2 * L1 * MASS_A + 2 * L5 * MASS_BE + L1 * MASS_C)
_JOINT_3_GRAVITY_N_M = 0.5 * GRAVITY_M_S2 * (L2 * MASS_A + 2 * L3 * MASS_C - 2 * L6 * MASS_DF)


@njit(cache=True)
def _mass_matrix_of_joints_1_to_3_into(q, M):
    M[:, :] = 0.0
    M[0, 0] = _M11_CONSTANT_TERM_KG_M2 + _M11_COS_2Q2_KG_M2 * math.cos(2.0 * q[1])
    M[0, 0] += _M11_COS_2Q3_KG_M2 * math.cos(2.0 * q[2])
    M[0, 0] += 2.0 * _M23_MAX_KG_M2 * math.cos(q[1]) * math.sin(q[2])
    M[1, 1], M[2, 2] = _M22_KG_M2, _M33_KG_M2
    M[1, 2] = M[2, 1] = -_M23_MAX_KG_M2 * math.sin(q[1] - q[2])


@njit(cache=True)
def jacobian_into(q, J):
    s1, c1 = math.sin(q[0]), math.cos(q[0])
    s2, c2 = math.sin(q[1]), math.cos(q[1])
    s3, c3 = math.sin(q[2]), math.cos(q[2])
    s4, c4 = math.sin(q[3]), math.cos(q[3])
    s5, c5 = math.sin(q[4]), math.cos(q[4])
    reach = L1 * c2 + L2 * s3
    J[:, :] = 0.0
    J[0, 0], J[1, 0] = -s1 * reach, c1 * reach
    J[0, 1], J[1, 1], J[2, 1] = -c1 * L1 * s2, -s1 * L1 * s2, L1 * c2
    J[0, 2], J[1, 2], J[2, 2] = c1 * L2 * c3, s1 * L2 * c3, L2 * s3
    J[5, 0] = 1.0
    J[3, 2], J[4, 2] = s1, -c1
    J[3, 3], J[4, 3], J[5, 3] = -c1 * s3, -s1 * s3, c3
    # The last two axes in the yawed frame, then rotated by q1.
    x5, y5 = -c3 * s4, c4
    J[3, 4], J[4, 4], J[5, 4] = c1 * x5 - s1 * y5, s1 * x5 + c1 * y5, -s3 * s4
    x6, y6 = c3 * c4 * c5 + s3 * s5, s4 * c5
    J[3, 5], J[4, 5], J[5, 5] = c1 * x6 - s1 * y6, s1 * x6 + c1 * y6, s3 * c4 * c5 - c3 * s5


@njit(cache=True)
def joint_mass_matrix_into(q, J, hand_mass, hand_inertia, M):
    """Write the mass matrix (6, 6) with wrist, hand (inertia about each axis) and motors into M."""
    _mass_matrix_of_joints_1_to_3_into(q, M)
    for i in range(3):
        M[i, i] += _REFLECTED_MOTOR_INERTIAS_KG_M2[i]
    tip_mass = WRIST_MASS_KG + hand_mass
    for j in range(6):
        # Joint j carries the wrist links from max(j, 3) on.
        carried = WRIST_LINK_INERTIA_KG_M2 * (6 - max(j, 3)) + hand_inertia
        for i in range(j + 1):
            value = carried * (J[3, i] * J[3, j] + J[4, i] * J[4, j] + J[5, i] * J[5, j])
            value += tip_mass * (J[0, i] * J[0, j] + J[1, i] * J[1, j] + J[2, i] * J[2, j])
            M[i, j] += value
            if i != j:
                M[j, i] += value


@njit(cache=True)
def gravity_compensation_torque_into(q, out):
    weight = WRIST_MASS_KG * GRAVITY_M_S2
    out[0] = 0.0
    out[1] = (_JOINT_2_GRAVITY_N_M + weight * L1) * math.cos(q[1])
    out[2] = (_JOINT_3_GRAVITY_N_M + weight * L2) * math.sin(q[2])
    out[3:6] = 0.0


@njit(cache=True)
def _subtract_coriolis_torque(q, v, J, hand_mass, hand_inertia, torque):
    # Main axes: Christoffel symbols of their closed-form M.
    coupling = _M23_MAX_KG_M2 * math.cos(q[1] - q[2])
    yaw_2 = _M23_MAX_KG_M2 * math.sin(q[1]) * math.sin(q[2])
    yaw_2 = -2.0 * (_M11_COS_2Q2_KG_M2 * math.sin(2.0 * q[1]) + yaw_2)
    yaw_3 = _M23_MAX_KG_M2 * math.cos(q[1]) * math.cos(q[2])
    yaw_3 = -2.0 * (_M11_COS_2Q3_KG_M2 * math.sin(2.0 * q[2]) - yaw_3)
    torque[0] -= (yaw_2 * v[1] + yaw_3 * v[2]) * v[0]
    torque[1] -= coupling * v[2] * v[2] - 0.5 * yaw_2 * v[0] * v[0]
    torque[2] -= -coupling * v[1] * v[1] - 0.5 * yaw_3 * v[0] * v[0]

    # Point mass at E: J_v^T m (dJ_v/dt) v.
    s1, c1 = math.sin(q[0]), math.cos(q[0])
    s2, c2 = math.sin(q[1]), math.cos(q[1])
    s3, c3 = math.sin(q[2]), math.cos(q[2])
    tip_mass = WRIST_MASS_KG + hand_mass
    radial = -L1 * c2 * v[1] ** 2 - L2 * s3 * v[2] ** 2 - (L1 * c2 + L2 * s3) * v[0] ** 2
    tangential = 2.0 * (-L1 * s2 * v[1] + L2 * c3 * v[2]) * v[0]
    fx = tip_mass * (c1 * radial - s1 * tangential)
    fy = tip_mass * (s1 * radial + c1 * tangential)
    fz = tip_mass * (-L1 * s2 * v[1] ** 2 + L2 * c3 * v[2] ** 2)
    for i in range(3):
        torque[i] -= J[0, i] * fx + J[1, i] * fy + J[2, i] * fz

    # Wrist links: angular velocity and velocity-product acceleration from link to link. Equal
    # moments of inertia give no gyroscopic moment.
    omega, alpha = (0.0, 0.0, v[0]), (0.0, 0.0, 0.0)
    for k in range(2, 6):
        turn = vectors.scale_vector(v[k], (J[3, k], J[4, k], J[5, k]))
        alpha = vectors.plus(alpha, vectors.cross(omega, turn))
        omega = vectors.plus(omega, turn)
        if k >= 3:
            inertia = WRIST_LINK_INERTIA_KG_M2 + (hand_inertia if k == 5 else 0.0)
            for i in range(k + 1):
                torque[i] -= inertia * vectors.dot((J[3, i], J[4, i], J[5, i]), alpha)


@njit(cache=True)
def _add_friction_and_end_stops(q, v, coulomb, viscous, torque):
    for i in range(6):
        torque[i] -= coulomb[i] * math.tanh(v[i] / FRICTION_TANH_SPEED_RAD_S) + viscous[i] * v[i]
        limits = JOINT_LOWER_RAD[i], JOINT_UPPER_RAD[i]
        torque[i] += end_stop_force(q[i], v[i], *limits, _STOP_STIFFNESSES[i], _STOP_DAMPINGS[i])
    stop = _STOP_STIFFNESSES[0], _STOP_DAMPINGS[0]
    five_bar = end_stop_force(q[1] - q[2], v[1] - v[2], *Q2_MINUS_Q3_RANGE_RAD, *stop)
    torque[1] += five_bar
    torque[2] -= five_bar


@njit(cache=True)
def joint_acceleration_into(q, v, hand_wrench, motor_torque, device, work, vdot):
    """Write the joint accelerations (6,) of device and hand into `vdot`.

    `hand_wrench` (6,) is [f; tau] of the hand on the stylus at E, in B; `work` is a scratch array.
    """
    J, M = work[0], work[1]
    jacobian_into(q, J)
    joint_mass_matrix_into(q, J, device.hand_mass, device.hand_inertia, M)
    gravity_compensation_torque_into(q, vdot)
    for i in range(6):
        vdot[i] = motor_torque[i] - vdot[i]
        for k in range(6):
            vdot[i] += J[k, i] * hand_wrench[k]
    _subtract_coriolis_torque(q, v, J, device.hand_mass, device.hand_inertia, vdot)
    _add_friction_and_end_stops(q, v, device.dry_friction, device.damping, vdot)
    vectors.solve_by_cholesky(M, vdot, 6)


@njit(cache=True)
def pose_into(q, pose):
    s1, c1 = math.sin(0.5 * q[0]), math.cos(0.5 * q[0])
    s3, c3 = math.sin(-0.5 * q[2]), math.cos(0.5 * q[2])
    s4, c4 = math.sin(0.5 * q[3]), math.cos(0.5 * q[3])
    s5, c5 = math.sin(0.5 * q[4]), math.cos(0.5 * q[4])
    s6, c6 = math.sin(0.5 * q[5]), math.cos(0.5 * q[5])
    # Rz(q1) Ry(-q3), then Rz(q4) Ry(q5), their product, then Rx(q6).
    a = c1 * c3, -s1 * s3, c1 * s3, s1 * c3
    b = c4 * c5, -s4 * s5, c4 * s5, s4 * c5
    yawed = vectors.quaternion_product(a, b)
    turned = vectors.quaternion_product(yawed, (c6, s6, 0.0, 0.0))
    pose[0], pose[1], pose[2], pose[3] = turned
    reach = L1 * math.cos(q[1]) + L2 * math.sin(q[2])
    pose[4] = math.cos(q[0]) * reach
    pose[5] = math.sin(q[0]) * reach
    pose[6] = L1 * math.sin(q[1]) - L2 * math.cos(q[2])


def inverse_kinematics(pose: Array) -> Array:
    """Return joint angles (6,) with the stylus at X_BE (7,), elbow up, |q5| <= 90 degrees."""
    x, y, z = pose[4:7]
    reach = math.hypot(x, y)
    # Two-link arm whose second link points along q3 - 90 degrees; elbow = q2 - (q3 - 90 degrees).
    cosine = (reach**2 + z**2 - L1**2 - L2**2) / (2 * L1 * L2)
    if abs(cosine) > 1:
        what = f"the Phantom's stylus cannot reach ({x:g}, {y:g}, {z:g}) m"
        remedy = "choose a start position inside the device's workspace, in its base frame B"
        raise DrakeTeleopError(what, where="master.position", remedy=remedy)
    elbow = math.acos(cosine)
    q2 = math.atan2(z, reach) + math.atan2(L2 * math.sin(elbow), L1 + L2 * math.cos(elbow))
    q3 = q2 - elbow + math.pi / 2
    q1 = math.atan2(y, x)
    R_BOuter = RotationMatrix.MakeZRotation(q1) @ RotationMatrix.MakeYRotation(-q3)
    R_BE = RotationMatrix(Quaternion(pose[:4] / np.linalg.norm(pose[:4])))
    wrist = RollPitchYaw(R_BOuter.inverse() @ R_BE)
    q = np.array([q1, q2, q3, wrist.yaw_angle(), wrist.pitch_angle(), wrist.roll_angle()])
    check_limits(q)
    return q


def serial_joint_angles(q: Array) -> Array:
    """Return q (..., 6) as joint angles of `phantom.sdf`, whose third one is q3 - q2."""
    serial = np.array(q, dtype=float)
    serial[..., 2] -= serial[..., 1]
    return serial


def flag_samples_at_end_stop(q: Array) -> NDArray[np.bool_]:
    folded = q[:, 1] - q[:, 2]
    beyond = ((q < JOINT_LOWER_RAD) | (q > JOINT_UPPER_RAD)).any(axis=1)
    return beyond | (folded < Q2_MINUS_Q3_RANGE_RAD[0]) | (folded > Q2_MINUS_Q3_RANGE_RAD[1])


def check_limits(q: Array) -> None:
    ranges = [*zip(JOINT_LOWER_RAD, JOINT_UPPER_RAD, strict=True), Q2_MINUS_Q3_RANGE_RAD]
    names = [*(f"joint {k}" for k in range(1, 7)), "angle q2 - q3"]
    for name, angle, (lower, upper) in zip(names, [*q, q[1] - q[2]], ranges, strict=True):
        if not lower - 1e-9 <= angle <= upper + 1e-9:
            at, least, most = np.degrees([angle, lower, upper])
            limits = f"its range is {least:.1f} to {most:.1f}"
            what = f"Phantom {name} would be at {at:.1f} degrees, {limits}"
            remedy = "choose a start position inside the device's workspace"
            raise DrakeTeleopError(what, where="master.position", remedy=remedy)
