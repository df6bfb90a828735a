"""What the saturated model says of units, axes and frames, before any load is assumed.

Force over acceleration, M_a, and over minus gravity, M_g, are both the mass times the rotation from
P to S, if all is as described. Their ratio is the unit of the positions; the polar factor of M_g is
R_SP, mirrored if axes are; and its singular values are the mass three times, whose spread is an
error of gains.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drake_teleop.common.arrays import Array
from drake_teleop.logs.pose_motion.saturated import Saturated

_ROUNDS = 5


@dataclass(frozen=True, eq=False)
class ReadOff:
    """Figures of the saturated model.

    Attributes:
        kappa: force over acceleration, by force over gravity: 1 where the positions are in the unit
            that is described; 1e-3 where they are in mm and said to be in m.
        kappa_deviation: its standard deviation; inf if nothing accelerates or turns.
        gravity_force: (3, 3) M_g [kg].
        deviation: the largest standard deviation of its entries [kg]; inf if the orientation does
            not change enough.
        R_SP: (3, 3) its polar factor; of determinant -1 where an axis is mirrored, or the sign.
        masses: (3,) its singular values [kg].
        permutation: (3, 3) its nearest matrix of one 1 or -1 in each row and column.
        oblique_deg: the angle between `R_SP` and `permutation` [deg].
        gravity_torque: (3, 3) torque over minus gravity [kg m], [h]x R_SP with h = m c.
        turning_force: (3, 3) force over minus angular acceleration, the same if the origin of P is
            that of S, and the units are right.
        moment_deviations: of the lengths of the last and the one before; inf if not determined.
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
        """Whether the orientation changed enough for M_g to mean something: 5 % of the mass."""
        return bool(self.deviation < 0.05 * self.masses.mean())

    @property
    def mirrored(self) -> bool:
        """Whether the axes are left-handed."""
        return bool(np.linalg.det(self.R_SP) < 0.0)


def read_off(fit: Saturated) -> ReadOff:
    """The figures of a fit."""
    C, variances = fit.coefficients, np.diagonal(fit.covariance, axis1=1, axis2=2)
    M_a, M_g = C[:3, 1:4], C[:3, 4:7]
    kappa, deviation = _ratio(M_a, M_g, variances[:3, 1:4], variances[:3, 4:7])
    shown = bool((variances[:3, 4:7] > 0.0).all())
    U, masses, Vt = np.linalg.svd(M_g)
    R_SP = U @ Vt
    permutation = nearest_permutation(R_SP)
    cosine = 0.5 * (float(np.trace(permutation.T @ R_SP)) - 1.0)
    return ReadOff(
        kappa=kappa,
        kappa_deviation=deviation,
        gravity_force=M_g,
        deviation=float(np.sqrt(variances[:3, 4:7].max())) if shown else np.inf,
        R_SP=R_SP,
        masses=masses,
        permutation=permutation,
        oblique_deg=float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))),
        gravity_torque=C[3:, 4:7],
        turning_force=-C[:3, 7:10],
        moment_deviations=(_length(variances[:3, 7:10]), _length(variances[3:, 4:7])),
    )


def _length(variances: Array) -> float:
    return float(np.sqrt(variances.sum())) if (variances > 0.0).all() else np.inf


def _ratio(a: Array, g: Array, variances_a: Array, variances_g: Array) -> tuple[float, float]:
    """kappa of a = kappa g, (3, 3) both, and its standard deviation.

    Entries weigh as they are known: gravity that stays in a plane says nothing of one column.
    """
    known = (variances_a > 0.0) & (variances_g > 0.0)
    if not known.any():
        return np.nan, np.inf
    a, g, v_a, v_g = (x[known] for x in (a, g, variances_a, variances_g))
    kappa = 0.0
    for _ in range(_ROUNDS):
        weight = 1.0 / (v_a + kappa**2 * v_g)
        information = float(weight @ np.maximum(g * g - v_g, 0.0))
        if not information > 0.0:  # gravity is not seen
            return np.nan, np.inf
        kappa = float(weight @ (a * g)) / information
    return kappa, information**-0.5


def nearest_permutation(R: Array) -> Array:
    """Of the 48 matrices with one 1 or -1 in each row and column, that with the largest trace."""
    from scipy.optimize import linear_sum_assignment

    rows, columns = linear_sum_assignment(-np.abs(R))
    out = np.zeros((3, 3))
    out[rows, columns] = np.where(R[rows, columns] < 0.0, -1.0, 1.0)
    return out
