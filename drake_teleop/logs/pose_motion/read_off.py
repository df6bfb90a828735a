"""Units, axes and masses from the coefficients of the linear model, before a load is assumed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drake_teleop.common.numeric import Array
from drake_teleop.logs.pose_motion.linear_model import LinearFit

_ITERATIONS = 5


@dataclass(frozen=True, eq=False)
class ReadOff:
    """Units, axes and masses that the free coefficients of a linear model of the wrench imply.

    Attributes:
        kappa: unit error of position; 1e-3 for mm described as m.
        kappa_deviation: its standard deviation; inf if undetermined.
        gravity_force: (3, 3) M_g, force over minus gravity [kg].
        deviation: largest standard deviation of M_g [kg].
        R_SP: (3, 3) polar factor of M_g; determinant -1 if mirrored.
        masses: (3,) singular values of M_g [kg].
        permutation: (3, 3) signed permutation nearest to R_SP.
        oblique_deg: angle between permutation and R_SP [deg].
        gravity_torque: (3, 3) torque over minus gravity [kg m].
        turning_force: (3, 3) force over minus angular acceleration [kg m]; equal if Po is So.
        moment_deviations: of the norms of turning_force and gravity_torque [kg m].
    """

    kappa: float
    kappa_deviation: float
    gravity_force: Array
    deviation: float
    R_SP: Array
    masses: Array
    permutation: Array
    oblique_deg: float
    gravity_torque: Array
    turning_force: Array
    moment_deviations: tuple[float, float]

    @property
    def usable(self) -> bool:
        """Whether M_g is known to 5 % of the mass."""
        return bool(self.deviation < 0.05 * self.masses.mean())

    @property
    def mirrored(self) -> bool:
        """Whether the axes of wrench and poses are mirror images."""
        return bool(np.linalg.det(self.R_SP) < 0.0)


def read_off(fit: LinearFit) -> ReadOff:
    """Return units, axes and masses that a fitted linear model implies."""
    C, variances = fit.coefficients, np.diagonal(fit.covariance, axis1=1, axis2=2)
    M_a, M_g = C[:3, 1:4], C[:3, 4:7]
    kappa, deviation = _ratio(M_a, M_g, variances[:3, 1:4], variances[:3, 4:7])
    determined = bool((variances[:3, 4:7] > 0.0).all())
    U, masses, Vt = np.linalg.svd(M_g)
    R_SP = U @ Vt
    permutation = nearest_permutation(R_SP)
    cosine = 0.5 * (float(np.trace(permutation.T @ R_SP)) - 1.0)
    return ReadOff(
        kappa=kappa,
        kappa_deviation=deviation,
        gravity_force=M_g,
        deviation=float(np.sqrt(variances[:3, 4:7].max())) if determined else np.inf,
        R_SP=R_SP,
        masses=masses,
        permutation=permutation,
        oblique_deg=float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))),
        gravity_torque=C[3:, 4:7],
        turning_force=-C[:3, 7:10],
        moment_deviations=(
            _norm_deviation(variances[:3, 7:10]),
            _norm_deviation(variances[3:, 4:7]),
        ),
    )


def _norm_deviation(variances: Array) -> float:
    return float(np.sqrt(variances.sum())) if (variances > 0.0).all() else np.inf


def _ratio(a: Array, g: Array, variances_a: Array, variances_g: Array) -> tuple[float, float]:
    known = (variances_a > 0.0) & (variances_g > 0.0)
    if not known.any():
        return np.nan, np.inf
    a, g, v_a, v_g = (x[known] for x in (a, g, variances_a, variances_g))
    kappa = 0.0
    for _ in range(_ITERATIONS):
        weight = 1.0 / (v_a + kappa**2 * v_g)
        information = float(weight @ np.maximum(g * g - v_g, 0.0))
        if not information > 0.0:  # gravity is not observable
            return np.nan, np.inf
        kappa = float(weight @ (a * g)) / information
    return kappa, information**-0.5


def nearest_permutation(R: Array) -> Array:
    """Return the signed permutation matrix (3, 3) nearest to the matrix R."""
    from scipy.optimize import linear_sum_assignment

    rows, columns = linear_sum_assignment(-np.abs(R))
    out = np.zeros((3, 3))
    out[rows, columns] = np.where(R[rows, columns] < 0.0, -1.0, 1.0)
    return out
