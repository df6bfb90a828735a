"""Removal or scaling of the load's weight and inertia in a measured wrench, Eqs. (12)-(14), (T7).

    F_c = F - F_o - V phi                                          (13)
    F'  = gamma F_c + V (sigma_gr phi_gr + sigma_obj phi_obj)      (T7)

F is the measured wrench, F_o the sensor offsets, V phi the wrench of weight and inertia. Wrenches
act on the load, about the sensor origin So, in S.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from drake_teleop.common.compiled import njit
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array, checked, checked_rows, number
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
    """Write F' (6,) of `scaled_wrench` into out, for one sample.

    For sigma = gamma the result does not depend on errors of the load parameters.
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
    """Return the contact wrench F_c = F - F_o - V phi (..., 6) of Eq. (13) [N, N m].

    Args:
        wrench: (..., 6) measured wrench F on the load, Eq. (1).
        offsets: (6,) or (..., 6) sensor offsets F_o.
        s, omega, alpha: (..., 3) specific force a - g, angular velocity and acceleration of S, in S
            [SI].
        phi: (10,) load about So in S.
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
    """Return F' = gamma F_c + V (sigma_gripper phi_gripper + sigma_object phi_object) (..., 6).

    F_c is the contact wrench, V phi that of weight and inertia, Eq. (T7) [N, N m].

    Args:
        wrench, offsets, s, omega, alpha: as for `contact_wrench`.
        phi_gripper, phi_object: (10,) loads about So in S; zeros for a missing part.
        sigma_gripper, sigma_object, gamma: scales >= 0.

    Raises:
        DrakeTeleopError: for a negative scale.
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


def scales_from_eta(eta: float) -> tuple[float, float, float]:
    """Return sigma_gripper, sigma_object, gamma = 0, eta, 1 for `scaled_wrench`, Eq. (14).

    They remove the gripper and keep the share eta of the object.

    Raises:
        DrakeTeleopError: if eta is outside [0, 1].
    """
    if not 0.0 <= number("eta", eta) <= 1.0:
        raise DrakeTeleopError(f"{eta:g} is outside 0 to 1", where="eta")
    return 0.0, float(eta), 1.0


def _scale(name: str, value: float) -> float:
    if not 0.0 <= number(name, value) < np.inf:
        raise DrakeTeleopError(f"{value} is not a finite number >= 0", where=name)
    return float(value)
