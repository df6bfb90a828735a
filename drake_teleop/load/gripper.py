"""The gripped object alone: phi_obj = phi_total - phi_gr with its uncertainty (section V, Eq. 14).

Parameters of parts add as long as both are about the same origin in the same sensor frame S, and
nothing in two identifications tells whether they were: a sensor that was turned or remounted
between them gives a difference that may look like a body. Use two records of one mounting.
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
"""Standard deviations below zero from which on a quantity counts as negative."""

_PHI = np.arange(16) >= 6


def identified_object(total: Identification, gripper: Identification) -> Identification:
    """What was identified of the object, from gripper with object and gripper alone.

    The two come from different records, so that their errors are independent and covariances of
    phi add. Offsets (with their covariances) are those of the sensor in the record with the object.
    A parameter that one of the two leaves undetermined is undetermined in the difference; which
    are identifiable is judged by the object's own mass and size, and a parameter that the total
    does not show cannot be one of them. Degrees of freedom are Satterthwaite's for the sum of two
    variances. Condition number, delay, residual, method and samples are those of the record with
    the object.

    Args:
        total: gripper with object.
        gripper: gripper alone, about the same origin in the same frame S (module docstring).

    Raises:
        DrakeTeleopError: if the object's mass is negative by more than `SIGNIFICANT` standard
            deviations, or exactly zero.
    """
    phi: Array = total.phi - gripper.phi
    covariance = total.covariance.copy()
    covariance[6:, 6:] += gripper.covariance[6:, 6:]
    unknown = np.isinf(np.diag(covariance))
    covariance[unknown, :] = covariance[:, unknown] = 0.0
    covariance[unknown, unknown] = np.inf
    deviations = np.sqrt(np.diag(covariance))
    if phi[0] < -SIGNIFICANT * deviations[6] or phi[0] == 0.0:
        raise DrakeTeleopError(
            f"total minus gripper leaves {phi[0]:.4g} kg for the object",
            where="gripper",
            remedy="give the gripper alone as gripper, and the record with the object as the load",
        )
    identifiable = worth_stating(deviations, phi) & ~unknown
    identifiable[6:] &= total.identifiable[6:]
    return replace(
        total,
        phi=phi,
        covariance=covariance,
        identifiable=identifiable,
        degrees_of_freedom=_degrees_of_freedom(total, gripper),
        prior_dominated=total.prior_dominated | gripper.prior_dominated & _PHI,
    )


def _degrees_of_freedom(total: Identification, gripper: Identification) -> Array:
    """(16,) of the sums of two variances, by Satterthwaite; offsets are those of the total."""
    a, b = (np.diag(load.covariance) for load in (total, gripper))
    b = np.where(_PHI, b, 0.0)
    known = np.isfinite(a + b) & (a + b > 0.0)
    a, b = np.where(known, a, 1.0), np.where(known, b, 0.0)
    with np.errstate(divide="ignore"):
        sums = (a + b) ** 2 / (a**2 / total.degrees_of_freedom + b**2 / gripper.degrees_of_freedom)
    return np.where(known, sums, np.inf)


def consistency_margin(load: Identification) -> tuple[float, float]:
    """How far a load is inside (> 0) or outside the set of possible bodies, and how sure that is.

    The smallest eigenvalue of the pseudo-inertia (Wensing, Kim, Slotine 2018), in units of the
    load's mass and of its radius of gyration about So, and its standard deviation to first order:
    with the eigenvector v the eigenvalue changes by v^T J(d phi) v.

    Args:
        load: about any origin.

    Returns:
        the eigenvalue and its standard deviation, both without unit; the latter is inf if
        the record does not determine all of phi.
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
