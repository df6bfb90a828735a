"""Eliminating and scaling the non-contact wrench, Eqs. (12)-(14).

With the measured wrench F, the sensor's offsets F_o and the load phi = phi_gr + phi_obj,

    F_c = F - F_o - V phi                                          (13)
    F'  = gamma F_c + V (sigma_gr phi_gr + sigma_obj phi_obj)      (Fig. 2)

sigma = 0 eliminates the load, 0 < sigma < 1 makes it lighter, 1 keeps it, more makes it heavier:
the apparent mass is sigma m, in weight as well as in inertia. gamma scales the contact. Offsets
are subtracted and never scaled. eta of Eq. (14) is the case sigma_gr = 0, sigma_obj = eta,
gamma = 1.

All in the sensor frame S about its origin So; wrenches [f; tau] [N, N m], motion and phi as in
`regressor`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from drake_teleop.common.arrays import Array, checked, checked_rows, number
from drake_teleop.common.compiled import njit
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.regressor import non_contact_wrench_into


@njit(cache=True)
def scaled_wrench_into(
    wrench,
    offsets,
    s,
    omega,
    alpha,
    phi_gripper,
    phi_object,
    sigma_gripper,
    sigma_object,
    gamma,
    out,
):
    """Writes F' into out (6,). With sigma_gripper = sigma_object = 0, gamma = 1 this is Eq. (13).

    F' = gamma (F - F_o) + V ((sigma_gr - gamma) phi_gr + (sigma_obj - gamma) phi_obj) needs V once,
    and with sigma = gamma the load drops out exactly, whatever its error.
    """
    a, b = sigma_gripper - gamma, sigma_object - gamma
    phi = (
        a * phi_gripper[0] + b * phi_object[0],
        a * phi_gripper[1] + b * phi_object[1],
        a * phi_gripper[2] + b * phi_object[2],
        a * phi_gripper[3] + b * phi_object[3],
        a * phi_gripper[4] + b * phi_object[4],
        a * phi_gripper[5] + b * phi_object[5],
        a * phi_gripper[6] + b * phi_object[6],
        a * phi_gripper[7] + b * phi_object[7],
        a * phi_gripper[8] + b * phi_object[8],
        a * phi_gripper[9] + b * phi_object[9],
    )
    non_contact_wrench_into(s, omega, alpha, phi, out)
    for i in range(6):
        out[i] += gamma * (wrench[i] - offsets[i])


@njit(cache=True)
def _scaled_wrenches(
    wrench, offsets, s, omega, alpha, phi_gripper, phi_object, sigma_gr, sigma_obj, gamma, out
):
    for i in range(wrench.shape[0]):
        scaled_wrench_into(
            wrench[i],
            offsets[i],
            s[i],
            omega[i],
            alpha[i],
            phi_gripper,
            phi_object,
            sigma_gr,
            sigma_obj,
            gamma,
            out[i],
        )


def contact_wrench(
    wrench: ArrayLike,
    offsets: ArrayLike,
    s: ArrayLike,
    omega: ArrayLike,
    alpha: ArrayLike,
    phi: ArrayLike,
) -> Array:
    """The contact wrench F_c = F - F_o - V phi, Eq. (13).

    Args:
        wrench: (..., 6) measured, sign of Eq. (1) [N, N m].
        offsets: (6,) or (..., 6) of the sensor [N, N m].
        s, omega, alpha: (..., 3) motion of S, as for `regressor`.
        phi: (10,) the load about So in S.

    Returns:
        (..., 6) in S about So [N, N m].

    Raises:
        DrakeTeleopError: for arrays of another shape or with numbers that are not finite.
    """
    return scaled_wrench(
        wrench,
        offsets,
        s,
        omega,
        alpha,
        checked("phi", phi, 10),
        np.zeros(10),
        sigma_gripper=0.0,
        sigma_object=0.0,
        gamma=1.0,
    )


def scaled_wrench(
    wrench: ArrayLike,
    offsets: ArrayLike,
    s: ArrayLike,
    omega: ArrayLike,
    alpha: ArrayLike,
    phi_gripper: ArrayLike,
    phi_object: ArrayLike,
    *,
    sigma_gripper: float,
    sigma_object: float,
    gamma: float,
) -> Array:
    """F' = gamma F_c + V (sigma_gr phi_gr + sigma_obj phi_obj), Fig. 2.

    Args:
        wrench: (..., 6) measured, sign of Eq. (1) [N, N m].
        offsets: (6,) or (..., 6) of the sensor [N, N m].
        s, omega, alpha: (..., 3) motion of S, as for `regressor`.
        phi_gripper, phi_object: (10,) parts of the load about So in S; zeros for no such part.
        sigma_gripper, sigma_object: share of each part's non-contact wrench that is kept, >= 0.
        gamma: scale of the contact wrench, >= 0.

    Returns:
        (..., 6) in S about So [N, N m].

    Raises:
        DrakeTeleopError: for arrays of another shape or with numbers that are not finite, or for
            a negative scale.
    """
    scales = [
        _scale("sigma_gripper", sigma_gripper),
        _scale("sigma_object", sigma_object),
        _scale("gamma", gamma),
    ]
    phis = checked("phi_gripper", phi_gripper, 10), checked("phi_object", phi_object, 10)
    leading, rows = checked_rows(
        wrench=(wrench, 6), offsets=(offsets, 6), s=(s, 3), omega=(omega, 3), alpha=(alpha, 3)
    )
    out = np.empty_like(rows[0])
    _scaled_wrenches(*rows, *phis, *scales, out)
    return out.reshape(*leading, 6)


def modified_phi(phi_gripper: ArrayLike, phi_object: ArrayLike, eta: float) -> Array:
    """What is subtracted to remove the gripper and keep the share eta of the object, Eq. (14).

    Args:
        phi_gripper, phi_object: (10,) about So in S.
        eta: share of the object's non-contact wrench that is kept, 0 to 1.

    Returns:
        (10,) phi_gr + (1 - eta) phi_obj.

    Raises:
        DrakeTeleopError: for other shapes, numbers that are not finite, or eta outside [0, 1].
    """
    gripper, gripped = (
        checked("phi_gripper", phi_gripper, 10),
        checked("phi_object", phi_object, 10),
    )
    return gripper + (1.0 - scales_from_eta(eta)[1]) * gripped


def scales_from_eta(eta: float) -> tuple[float, float, float]:
    """(sigma_gripper, sigma_object, gamma) = (0, eta, 1), which is what Eq. (14) does.

    Raises:
        DrakeTeleopError: if eta is not within [0, 1].
    """
    if not 0.0 <= number("eta", eta) <= 1.0:
        raise DrakeTeleopError(f"{eta:g} is outside 0 to 1", where="eta")
    return 0.0, float(eta), 1.0


def _scale(name: str, value: float) -> float:
    if not 0.0 <= number(name, value) < np.inf:
        raise DrakeTeleopError(f"{value} is not a finite number >= 0", where=name)
    return float(value)
