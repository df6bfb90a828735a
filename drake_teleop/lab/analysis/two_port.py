"""Two-port of the station between hand and environment, along one direction.

    [F_h; -V_s] = H [V_m; F_e]

F_h: force of the hand on the device; V_m: its velocity; F_e: force of the slave on the
environment; V_s: its velocity. The station absorbs the power F_h V_m - F_e V_s. Two-ports are
arrays (..., 2, 2), frequencies first; s in rad/s, impedances in N s/m, delays one way in s.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.lab.analysis import one_axis
from drake_teleop.lab.analysis.one_axis import Complex, OneAxis


def two_port_matrix(h11: ArrayLike, h12: ArrayLike, h21: ArrayLike, h22: ArrayLike) -> Complex:
    """Return matrices (..., 2, 2) of four entries that broadcast."""
    entries = np.broadcast_arrays(h11, h12, h21, h22)
    stacked = np.stack(entries, axis=-1).astype(complex, copy=False)
    return stacked.reshape(*stacked.shape[:-1], 2, 2)


def matrix_entries(H: Complex) -> tuple[Complex, Complex, Complex, Complex]:
    return H[..., 0, 0], H[..., 0, 1], H[..., 1, 0], H[..., 1, 1]


def hybrid_matrix(
    axis: OneAxis, s: Complex, *, servo: tuple[Complex, Complex] | None = None
) -> Complex:
    """Return the hybrid matrix H (..., 2, 2) of the position-force station at s [rad/s] (T51).

    `servo` replaces the axis' servo response and admittance.
    """
    servo = servo or (one_axis.servo_response(axis, s), one_axis.servo_admittance(axis, s))
    response, slave_admittance = servo
    delay_factor = np.exp(-s * axis.delay)
    tool = axis.displayed_tool_mass * s
    slave = axis.position_scale * delay_factor * response
    return two_port_matrix(
        one_axis.device_impedance(axis, s) + axis.force_scale * delay_factor * tool * slave,
        axis.force_scale * delay_factor * (axis.gamma - tool * slave_admittance),
        -slave,
        slave_admittance,
    )


def scattering_matrix(H: Complex, reference: tuple[ArrayLike, ArrayLike] = (1.0, 1.0)) -> Complex:
    """Return the scattering matrix S for reference impedances b [N s/m] of both ports.

    S maps the waves F + b V to F - b V.
    """
    h11, h12, h21, h22 = matrix_entries(H)
    b1, b2 = np.asarray(reference[0]), np.asarray(reference[1])
    ratio = np.sqrt(b2 / b1)
    h11, h12, h21, h22 = h11 / b1, h12 * ratio, h21 * ratio, h22 * b2
    product = h12 * h21
    determinant = (1 + h11) * (1 + h22) - product
    s11, s22 = (h11 - 1) * (h22 + 1) - product, (1 + h11) * (1 - h22) + product
    return two_port_matrix(s11, 2 * h12, -2 * h21, s22) / determinant[..., None, None]


def reference_impedances(axis: OneAxis) -> tuple[float, float]:
    """Return the reference impedances b [N s/m] of both ports for `scattering_matrix`."""
    scale = axis.force_scale * axis.position_scale
    if scale == 0:
        what = "one of them is 0 (reference impedances need both above 0)"
        remedy = "set both above 0"
        raise DrakeTeleopError(what, where="force_scale, translation_scale", remedy=remedy)
    return axis.hand_damping, axis.hand_damping / scale


def power_ratio(axis: OneAxis) -> float:
    """Return hand power over slave power: force scale times gamma over motion scale."""
    return axis.force_scale * axis.gamma / axis.position_scale


def scale_slave_power(H: Complex, ratio: ArrayLike) -> Complex:
    """Return H with the slave's power multiplied by `ratio` > 0."""
    root = np.sqrt(np.asarray(ratio, dtype=float))
    if not np.all(root > 0):
        what = "the ratio of slave power to master power is not positive"
        raise DrakeTeleopError(what, where="ratio", remedy="give values above 0")
    h11, h12, h21, h22 = matrix_entries(H)
    return two_port_matrix(h11, h12 / root, h21 * root, h22)


def power_scaled_matrices(H: Complex, axis: OneAxis) -> tuple[Complex, Complex]:
    """Return H and its scattering matrix S, with the slave's power at the hand's scale."""
    ratio = power_ratio(axis)
    scaled = scale_slave_power(H, ratio) if ratio > 0 else H
    return scaled, scattering_matrix(scaled, reference_impedances(axis))


def absorb_impedances(H: Complex, hand: ArrayLike = 0.0, environment: ArrayLike = 0.0) -> Complex:
    """Return H that includes parallel impedances [N s/m] of the hand and of the environment."""
    h11, h12, h21, h22 = matrix_entries(H)
    z = np.asarray(environment)
    reduction = 1 / (1 + h22 * z)
    felt = h11 + np.asarray(hand) - h12 * h21 * z * reduction
    return two_port_matrix(felt, h12 * reduction, h21 * reduction, h22 * reduction)


def transmitted_impedance(H: Complex, environment: ArrayLike) -> Complex:
    """Return the impedance displayed to the hand with this impedance of the environment [N s/m]."""
    return absorb_impedances(H, environment=environment)[..., 0, 0]
