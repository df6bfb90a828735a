"""Removal or scaling of the load's weight and inertia in a wrench, Eqs. (12)-(14), (T7)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from drake_teleop.common.compiled import njit
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array, broadcast_to_rows, finite_array, to_float
from drake_teleop.common.vectors import add_vector_into, cross, minus, plus, scale_vector, vector_at
from drake_teleop.load.regressor import wrench_of_load


@njit(cache=True)
def scaled_wrench_into(
    wrench, offsets, s, omega, alpha, phi_gripper, phi_object, sigma_gr, sigma_obj, gamma, out
):
    """Write F' = gamma F_c + V (sigma_gr phi_gripper + sigma_obj phi_object) (6,) to `out`."""
    a, b = sigma_gr - gamma, sigma_obj - gamma
    phi = (
        a * phi_gripper[0] + b * phi_object[0], a * phi_gripper[1] + b * phi_object[1],
        a * phi_gripper[2] + b * phi_object[2], a * phi_gripper[3] + b * phi_object[3],
        a * phi_gripper[4] + b * phi_object[4], a * phi_gripper[5] + b * phi_object[5],
        a * phi_gripper[6] + b * phi_object[6], a * phi_gripper[7] + b * phi_object[7],
        a * phi_gripper[8] + b * phi_object[8], a * phi_gripper[9] + b * phi_object[9],
    )  # fmt: skip
    force, torque = wrench_of_load(s, omega, alpha, phi)
    contact_force = minus(vector_at(wrench, 0), vector_at(offsets, 0))
    contact_torque = minus(vector_at(wrench, 3), vector_at(offsets, 3))
    out[0], out[1], out[2] = plus(force, scale_vector(gamma, contact_force))
    out[3], out[4], out[5] = plus(torque, scale_vector(gamma, contact_torque))


@njit(cache=True)
def add_excess_weight_into(gravity, phi_gripper, phi_object, excess_gripper, excess_object, out):
    """Add weights of gripper and object, times weight scale minus inertia scale, to `out` (6,)."""
    a, b = excess_gripper, excess_object
    up = scale_vector(-1.0, vector_at(gravity, 0))
    h = plus(scale_vector(a, vector_at(phi_gripper, 1)), scale_vector(b, vector_at(phi_object, 1)))
    add_vector_into(out, 0, scale_vector(a * phi_gripper[0] + b * phi_object[0], up))
    add_vector_into(out, 3, cross(h, up))


@njit(cache=True)
def _scaled_wrenches_of_rows(wrench, offsets, s, omega, alpha, phis, scales, gravity, excess, out):
    scales = *phis, *scales
    for i in range(wrench.shape[0]):
        scaled_wrench_into(wrench[i], offsets[i], s[i], omega[i], alpha[i], *scales, out[i])
        if gravity.shape[0] > 0:
            add_excess_weight_into(gravity[i], *phis, *excess, out[i])


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
    phis = finite_array("phi", phi, 10), np.zeros(10)
    scales = {"sigma_gripper": 0.0, "sigma_object": 0.0, "gamma": 1.0}
    return scaled_wrench(wrench, offsets, s, omega, alpha, *phis, **scales)


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
    sigma_weight: float | None = None,
    sigma_inertia: float | None = None,
    gravity: ArrayLike | None = None,
) -> Array:
    """Return F' = gamma F_c + V (sigma_gripper phi_gripper + sigma_object phi_object) (..., 6).

    F_c is the contact wrench, V phi the wrench of weight and inertia, Eq. (T7) [N, N m].

    Args:
        wrench, offsets, s, omega, alpha: as for `contact_wrench`.
        phi_gripper, phi_object: (10,) loads about So in S; zeros for a missing part.
        sigma_gripper, sigma_object, gamma: scales >= 0.
        sigma_weight, sigma_inertia: scales >= 0 of both parts' weight and inertia; None:
            sigma_gripper and sigma_object.
        gravity: (3,) or (..., 3) g in S [m/s^2]; needed if weight and inertia differ in scale.
    """
    weights, inertias = weight_scales_and_inertia_scales(
        _check_scale("sigma_gripper", sigma_gripper),
        _check_scale("sigma_object", sigma_object),
        None if sigma_weight is None else _check_scale("sigma_weight", sigma_weight),
        None if sigma_inertia is None else _check_scale("sigma_inertia", sigma_inertia),
    )
    scales = *inertias, _check_scale("gamma", gamma)
    if weights != inertias and gravity is None:
        raise unknown_gravity_error("gravity", "pass gravity in the sensor frame for each sample")
    phis = finite_array("phi_gripper", phi_gripper, 10), finite_array("phi_object", phi_object, 10)
    named = {"wrench": (wrench, 6), "offsets": (offsets, 6)}
    named |= {"s": (s, 3), "omega": (omega, 3), "alpha": (alpha, 3)}
    if weights != inertias and gravity is not None:
        named["gravity"] = gravity, 3
    leading, rows = broadcast_to_rows(**named)
    down = rows.pop() if "gravity" in named else np.empty((0, 3))
    out, excess = np.empty_like(rows[0]), (weights[0] - inertias[0], weights[1] - inertias[1])
    _scaled_wrenches_of_rows(*rows, phis, scales, down, excess, out)
    return out.reshape(*leading, 6)


def weight_scales_and_inertia_scales(
    sigma_gripper: float,
    sigma_object: float,
    sigma_weight: float | None = None,
    sigma_inertia: float | None = None,
) -> tuple[tuple[float, float], tuple[float, float]]:
    both = sigma_gripper, sigma_object
    weights = both if sigma_weight is None else (sigma_weight, sigma_weight)
    return weights, both if sigma_inertia is None else (sigma_inertia, sigma_inertia)


def unknown_gravity_error(where: str, remedy: str) -> DrakeTeleopError:
    what = "is unknown, but the scales of weight and inertia differ"
    return DrakeTeleopError(what, where=where, remedy=remedy)


def scales_from_eta(eta: float) -> tuple[float, float, float]:
    """Return sigma_gripper 0, sigma_object `eta` (share of its wrench) and gamma 1, Eq. (14)."""
    if not 0.0 <= to_float("eta", eta) <= 1.0:
        what = f"{eta:g} is outside 0 to 1"
        raise DrakeTeleopError(what, where="eta", remedy="give the object's remaining share")
    return 0.0, float(eta), 1.0


def _check_scale(name: str, value: float) -> float:
    if not 0.0 <= to_float(name, value) < np.inf:
        what = f"{value} is not a finite number >= 0"
        raise DrakeTeleopError(what, where=name, remedy="give a finite scale >= 0")
    return float(value)
