"""Gripped object as the difference of two identifications, Eqs. (14), (T8) and (T9).

Both must refer to the same So in the same S: use two records of one mounting.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from drake_teleop.common.arrays import Array
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.identification import Identification, worth_stating
from drake_teleop.load.inertia import pseudo_inertia

SIGNIFICANT = 3.0
"""Standard deviations below zero at which a mass counts as negative."""

_IS_PHI = np.arange(16) >= 6


def identified_object(total: Identification, gripper: Identification) -> Identification:
    """Return the object's identification: gripper with object minus gripper alone.

    Covariances of phi add. All fields that do not concern phi are those of `total`.

    Raises:
        DrakeTeleopError: if the object's mass is zero, or negative by more than `SIGNIFICANT`
            standard deviations.
    """
    phi: Array = total.phi - gripper.phi
    covariance = total.covariance.copy()
    covariance[6:, 6:] += gripper.covariance[6:, 6:]
    undetermined = np.isinf(np.diag(covariance))
    covariance[undetermined, :] = covariance[:, undetermined] = 0.0
    covariance[undetermined, undetermined] = np.inf
    deviations = np.sqrt(np.diag(covariance))
    if phi[0] < -SIGNIFICANT * deviations[6] or phi[0] == 0.0:
        raise DrakeTeleopError(
            f"total minus gripper leaves {phi[0]:.4g} kg for the object",
            where="gripper",
            remedy="give the gripper alone as gripper, and the record with the object as the load",
        )
    identifiable = worth_stating(deviations, phi) & ~undetermined
    identifiable[6:] &= total.identifiable[6:]
    return replace(
        total,
        phi=phi,
        covariance=covariance,
        identifiable=identifiable,
        degrees_of_freedom=_degrees_of_freedom(total, gripper),
        prior_dominated=total.prior_dominated | gripper.prior_dominated & _IS_PHI,
    )


def _degrees_of_freedom(total: Identification, gripper: Identification) -> Array:
    """Return (16,) Satterthwaite degrees of freedom; those of the total for offsets."""
    a, b = (np.diag(load.covariance) for load in (total, gripper))
    b = np.where(_IS_PHI, b, 0.0)
    finite = np.isfinite(a + b) & (a + b > 0.0)
    a, b = np.where(finite, a, 1.0), np.where(finite, b, 0.0)
    with np.errstate(divide="ignore"):
        sums = (a + b) ** 2 / (a**2 / total.degrees_of_freedom + b**2 / gripper.degrees_of_freedom)
    return np.where(finite, sums, np.inf)


def consistency_margin(load: Identification) -> tuple[float, float]:
    """Return the smallest eigenvalue of the pseudo-inertia and its standard deviation, Eq. (T9).

    In units of mass and radius of gyration about So; positive for a consistent load. The standard
    deviation is inf if phi is not fully determined.
    """
    J = pseudo_inertia(load.phi)
    mass, spread = abs(J[3, 3]), abs(float(np.trace(J[:3, :3])))
    length = np.sqrt(spread / mass) if spread > 0.0 else 1.0
    scale: Array = np.sqrt(mass) * np.array([length, length, length, 1.0])
    eigenvalues, vectors = np.linalg.eigh(J / np.outer(scale, scale))
    v = vectors[:, 0] / scale
    gradient = np.array([float(v @ pseudo_inertia(unit) @ v) for unit in np.eye(10)])
    covariance = load.covariance[6:, 6:]
    if np.isinf(covariance).any():
        return float(eigenvalues[0]), float("inf")
    variance = max(0.0, float(gradient @ covariance @ gradient))
    return float(eigenvalues[0]), math.sqrt(variance)
