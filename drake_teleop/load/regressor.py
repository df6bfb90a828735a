"""Wrench of a moving load: regressor V of Eq. (5), and Newton-Euler Eqs. (1)-(2).

A sample is one row of these numbers, in logs the first 15::

    [measured wrench (6) | specific force (3) | angular velocity (3) | angular acceleration (3) |
     flag: 1 saturated, >= 2 lost | joint positions (n) | time (output of the wrist sensor only)]
"""

from __future__ import annotations

import numpy as np
from numba.extending import register_jitable
from numpy.typing import ArrayLike

from drake_teleop.common.compiled import njit
from drake_teleop.common.numeric import Array, broadcast_to_rows, finite_array
from drake_teleop.common.vectors import (
    apply_matrix,
    cross,
    plus,
    scale_vector,
    symmetric_matrix_at,
    vector_at,
)

WRENCH_SLICE = slice(0, 6)
SPECIFIC_FORCE_SLICE = slice(6, 9)
ANGULAR_VELOCITY_SLICE = slice(9, 12)
ANGULAR_ACCELERATION_SLICE = slice(12, 15)
MOTION_SLICE = slice(6, 15)  #: specific force, angular velocity and angular acceleration of S
WRENCH_AND_MOTION_SLICE = slice(0, 15)
SATURATION_FLAG_INDEX = 15  #: above 0.5 the wrench is not valid
#: From this value of the saturation flag on, the reading was lost or impossible: the sample is an
#: old one. The excess counts the samples with remaining effects.
LOST_SAMPLE_FLAG_THRESHOLD = 2.0
FIRST_JOINT_INDEX = 16
JOINT_POSITIONS_SLICE = slice(FIRST_JOINT_INDEX, None)
SAMPLE_TIME_INDEX = -1  #: [s], only in the output of the wrist sensor


@njit(cache=True)
def regressor_into(s, omega, alpha, V):
    sx, sy, sz = s[0], s[1], s[2]
    wx, wy, wz = omega[0], omega[1], omega[2]
    ax, ay, az = alpha[0], alpha[1], alpha[2]
    xx, yy, zz = wx * wx, wy * wy, wz * wz
    xy, xz, yz = wx * wy, wx * wz, wy * wz

    V[:] = 0.0
    V[0, 0], V[1, 0], V[2, 0] = sx, sy, sz
    V[0, 1], V[0, 2], V[0, 3] = -yy - zz, xy - az, xz + ay
    V[1, 1], V[1, 2], V[1, 3] = xy + az, -xx - zz, yz - ax
    V[2, 1], V[2, 2], V[2, 3] = xz - ay, yz + ax, -yy - xx

    V[3, 2], V[3, 3] = sz, -sy
    V[4, 1], V[4, 3] = -sz, sx
    V[5, 1], V[5, 2] = sy, -sx
    V[3, 4], V[3, 5], V[3, 6], V[3, 7], V[3, 8], V[3, 9] = ax, ay - xz, az + xy, -yz, yy - zz, yz
    V[4, 4], V[4, 5], V[4, 6], V[4, 7], V[4, 8], V[4, 9] = xz, ax + yz, zz - xx, ay, az - xy, -xz
    V[5, 4], V[5, 5], V[5, 6], V[5, 7], V[5, 8], V[5, 9] = -xy, xx - yy, ax - yz, xy, ay + xz, az


@register_jitable
def wrench_of_load(s, omega, alpha, phi):
    """Return the force and the torque of V phi as tuples, for scalars of any type."""
    s, omega, alpha = vector_at(s, 0), vector_at(omega, 0), vector_at(alpha, 0)
    m, h, inertia = phi[0], vector_at(phi, 1), symmetric_matrix_at(phi, 4)  # h = m c
    force = plus(plus(scale_vector(m, s), cross(alpha, h)), cross(omega, cross(omega, h)))
    torque = plus(apply_matrix(inertia, alpha), cross(omega, apply_matrix(inertia, omega)))
    return force, plus(torque, cross(h, s))


@njit(cache=True)
def non_contact_wrench_into(s, omega, alpha, phi, out):
    force, torque = wrench_of_load(s, omega, alpha, phi)
    out[0], out[1], out[2] = force
    out[3], out[4], out[5] = torque


@njit(cache=True)
def _regressors_of_rows(s, omega, alpha, V):
    for i in range(s.shape[0]):
        regressor_into(s[i], omega[i], alpha[i], V[i])


@njit(cache=True)
def _non_contact_wrenches_of_rows(s, omega, alpha, phi, out):
    for i in range(s.shape[0]):
        non_contact_wrench_into(s[i], omega[i], alpha[i], phi, out[i])


def regressor(s: ArrayLike, omega: ArrayLike, alpha: ArrayLike) -> Array:
    """Return the regressor V (..., 6, 10), with the load's wrench [f; tau] = V phi, Eq. (5).

    Args:
        s: (..., 3) specific force a - g of the sensor origin So, in S [m/s^2].
        omega: (..., 3) angular velocity of S, in S [rad/s].
        alpha: (..., 3) angular acceleration of S, in S [rad/s^2].
    """
    leading, motion = broadcast_to_rows(s=(s, 3), omega=(omega, 3), alpha=(alpha, 3))
    V = np.empty((motion[0].shape[0], 6, 10))
    _regressors_of_rows(*motion, V)
    return V.reshape(*leading, 6, 10)


def non_contact_wrench(s: ArrayLike, omega: ArrayLike, alpha: ArrayLike, phi: ArrayLike) -> Array:
    """Return the wrench V phi (..., 6) of a load's weight and inertia [N, N m], Eqs. (1)-(2), (12).

    It acts on the load, about So, in S. Arguments as for `regressor`; phi (10,) about So in S.
    """
    phi = finite_array("phi", phi, 10)
    leading, motion = broadcast_to_rows(s=(s, 3), omega=(omega, 3), alpha=(alpha, 3))
    out = np.empty((motion[0].shape[0], 6))
    _non_contact_wrenches_of_rows(*motion, phi, out)
    return out.reshape(*leading, 6)


def signal_sizes_of_sample(num_joints: int) -> dict[str, int]:
    return {
        "measured_wrench_S": 6,
        "specific_force_S": 3,
        "angular_velocity_S": 3,
        "angular_acceleration_S": 3,
        "saturated": 1,
        "joint_position": num_joints,
    }


def sample_size(num_joints: int) -> int:
    return FIRST_JOINT_INDEX + num_joints
