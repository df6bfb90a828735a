"""Inertial parameters phi of a rigid load: conversions, frames and physical consistency.

phi = [m, m c (3), Ixx, Ixy, Ixz, Iyy, Iyz, Izz], Eq. (6) [kg, kg m, kg m^2], with mass m, centre
of mass c, and inertia about the frame's origin.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array, finite_array

# Tolerance for rounding, so that rods, plates and points are consistent.
_PSEUDO_INERTIA_ROUNDING_TOLERANCE = 1e-12
# Squared radius of gyration [m^2] below which a body is a point.
_MIN_SQUARED_GYRATION_RADIUS_M2 = 1e-290


def _inertia_of_point_mass(p_com: Array, mass: float) -> Array:
    return mass * (p_com @ p_com * np.eye(3) - np.outer(p_com, p_com))


def phi_from_mass_com_inertia(mass: float, p_SoBcm_S: ArrayLike, I_BBcm_S: ArrayLike) -> Array:
    m = float(finite_array("mass", mass))
    p = finite_array("p_SoBcm_S", p_SoBcm_S, 3)
    I = finite_array("I_BBcm_S", I_BBcm_S, 3, 3)  # noqa: E741
    if np.abs(I - I.T).max() > 1e-9 * np.abs(I).max():
        what = "the inertia tensor is not symmetric"
        remedy = "give equal products of inertia above and below the diagonal"
        raise DrakeTeleopError(what, where="I_BBcm_S", remedy=remedy)
    return np.concatenate([[m], m * p, (I + _inertia_of_point_mass(p, m))[np.triu_indices(3)]])


def mass_com_inertia(phi: ArrayLike) -> tuple[float, Array, Array]:
    """Return mass [kg], centre of mass c (3,) [m] and inertia (3, 3) about c [kg m^2] of phi."""
    phi = finite_array("phi", phi, 10)
    m = float(phi[0])
    if m == 0.0:
        what = "the mass is 0, so the centre of mass is undefined"
        raise DrakeTeleopError(what, where="phi", remedy="give a mass phi[0] other than 0")
    p = phi[1:4] / m
    return m, p, inertia_about_origin(phi) - _inertia_of_point_mass(p, m)


def inertia_about_origin(phi: ArrayLike) -> Array:
    xx, xy, xz, yy, yz, zz = finite_array("phi", phi, 10)[4:]
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def pseudo_inertia(phi: ArrayLike) -> Array:
    """Return the pseudo-inertia J = [Sigma, m c; m c^T, m] (4, 4), Eq. (T1)."""
    phi = finite_array("phi", phi, 10)
    I = inertia_about_origin(phi)  # noqa: E741
    J = np.empty((4, 4))
    J[:3, :3] = 0.5 * np.trace(I) * np.eye(3) - I
    J[:3, 3] = J[3, :3] = phi[1:4]
    J[3, 3] = phi[0]
    return J


def phi_from_pseudo_inertia(J: ArrayLike) -> Array:
    J = finite_array("J", J, 4, 4)
    if np.abs(J - J.T).max() > 1e-9 * np.abs(J).max():
        what = "the pseudo-inertia is not symmetric"
        raise DrakeTeleopError(what, where="J", remedy="give (J + J.T) / 2")
    Sigma = J[:3, :3]
    I = np.trace(Sigma) * np.eye(3) - Sigma  # noqa: E741
    return np.concatenate([[J[3, 3]], J[:3, 3], I[np.triu_indices(3)]])


def is_physically_consistent(phi: ArrayLike, tolerance: float = 0.0) -> bool:
    """Return whether a rigid body can have the parameters phi (10,), Eq. (T1).

    The pseudo-inertia, scaled as in `consistency_margin`, may have eigenvalues down to
    -`tolerance`.
    """
    J = pseudo_inertia(phi)
    if not J.any():
        return True
    mass, spread = J[3, 3], np.trace(J[:3, :3])
    if mass <= 0.0 or spread < 0.0:
        return False
    # Quotients of denormal numbers are inaccurate: treat such a body as a point.
    length = np.sqrt(spread / mass) if spread > _MIN_SQUARED_GYRATION_RADIUS_M2 * mass else 1.0
    unit = np.array([length, length, length, 1.0])
    eigenvalues = np.linalg.eigvalsh(J / np.outer(unit, unit) / mass)
    return bool(eigenvalues[0] >= -(tolerance + _PSEUDO_INERTIA_ROUNDING_TOLERANCE))


def transform_phi(phi_B: ArrayLike, R_AB: ArrayLike, p_AoBo_A: ArrayLike) -> Array:
    """Return the load (10,) about Ao in frame A, from the load about Bo in frame B, Eq. (T2)."""
    R = finite_array("R_AB", R_AB, 3, 3)
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-6 or np.linalg.det(R) < 0.0:
        remedy = "give an orthonormal, right-handed matrix"
        raise DrakeTeleopError("is not a rotation matrix", where="R_AB", remedy=remedy)
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = finite_array("p_AoBo_A", p_AoBo_A, 3)
    J = T @ pseudo_inertia(phi_B) @ T.T
    return phi_from_pseudo_inertia(0.5 * (J + J.T))
