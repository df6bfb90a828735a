"""Two-port of the station between hand and environment, along one direction, and transparency.

    [F_h; -V_s] = H [V_m; F_e]

F_h: force of the hand on the device; V_m: its velocity; F_e: force of the slave on the
environment; V_s: its velocity. The station absorbs the power F_h V_m - F_e V_s. Two-ports are
arrays (..., 2, 2), frequencies first; s in rad/s, impedances in N s/m, delays one way in s.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.lab.analysis import one_axis
from drake_teleop.lab.analysis.one_axis import Complex, OneAxis


def two_port_matrix(h11: ArrayLike, h12: ArrayLike, h21: ArrayLike, h22: ArrayLike) -> Complex:
    entries = np.broadcast_arrays(h11, h12, h21, h22)
    stacked = np.stack(entries, axis=-1).astype(complex, copy=False)
    return stacked.reshape(*stacked.shape[:-1], 2, 2)


def matrix_entries(H: Complex) -> tuple[Complex, Complex, Complex, Complex]:
    return H[..., 0, 0], H[..., 0, 1], H[..., 1, 0], H[..., 1, 1]


def hybrid_matrix(
    axis: OneAxis, s: Complex, *, servo: tuple[Complex, Complex] | None = None
) -> Complex:
    """Return the hybrid matrix H (..., 2, 2) of the position-force station at s [rad/s] (T51).

    `servo` = (response, admittance) at s replaces the servo of `axis`.
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
    """Return reference impedances [N s/m]: hand damping b, and b / (force scale * motion scale)."""
    scale = axis.force_scale * axis.position_scale
    if scale == 0:
        name = "force_scale" if axis.force_scale == 0 else "position_scale"
        what = "is 0, so that the reference impedances are undefined"
        raise DrakeTeleopError(what, where=f"OneAxis.{name}", remedy="set it above 0")
    return axis.hand_damping, axis.hand_damping / scale


def power_ratio(axis: OneAxis) -> float:
    """Return hand power / slave power = force scale * gamma / motion scale."""
    return axis.force_scale * axis.gamma / axis.position_scale


def scale_slave_power(H: Complex, ratio: ArrayLike) -> Complex:
    """Return hybrid matrix H with the power at the slave's port multiplied by `ratio` > 0."""
    root = np.sqrt(np.asarray(ratio, dtype=float))
    if not np.all(root > 0):
        what = f"{np.min(ratio):g}, a factor of the slave's power, is not positive"
        raise DrakeTeleopError(what, where="ratio", remedy="give values above 0")
    h11, h12, h21, h22 = matrix_entries(H)
    return two_port_matrix(h11, h12 / root, h21 * root, h22)


def power_scaled_matrices(H: Complex, axis: OneAxis) -> tuple[Complex, Complex]:
    """Return H and its scattering matrix S, with the slave's power scaled by `power_ratio`."""
    references, ratio = reference_impedances(axis), power_ratio(axis)
    scaled = scale_slave_power(H, ratio) if ratio > 0 else H
    return scaled, scattering_matrix(scaled, references)


def absorb_impedances(H: Complex, hand: ArrayLike = 0.0, environment: ArrayLike = 0.0) -> Complex:
    """Return hybrid matrix H with impedances [N s/m] of hand and environment included."""
    h11, h12, h21, h22 = matrix_entries(H)
    z = np.asarray(environment)
    reduction = 1 / (1 + h22 * z)
    rendered = h11 + np.asarray(hand) - h12 * h21 * z * reduction
    return two_port_matrix(rendered, h12 * reduction, h21 * reduction, h22 * reduction)


def transmitted_impedance(H: Complex, environment: ArrayLike) -> Complex:
    """Return the impedance [N s/m] displayed to the hand for this impedance of the environment."""
    return absorb_impedances(H, environment=environment)[..., 0, 0]


def ideal_impedance(axis: OneAxis, s: Complex, environment: ArrayLike) -> Complex:
    """Return the displayed impedance [N s/m] without servo lag and delay, with scales (T52)."""
    rendered = axis.gamma * np.asarray(environment) + axis.sigma * axis.tool_mass * s
    return one_axis.device_impedance(axis, s) + axis.force_scale * axis.position_scale * rendered


class ApparentImpedance(NamedTuple):
    """Displayed impedance as mass, damping and stiffness."""

    mass: Array  #: kg
    damping: Array  #: N s/m
    stiffness: Array  #: N/m


def fit_apparent_impedance(impedance: Complex, omega: Array) -> ApparentImpedance:
    """Return the best-fitting mass, damping, stiffness of an impedance (n, ...) at `omega` (n,)."""
    basis = np.stack([omega, -1 / omega], axis=-1)
    flat = impedance.imag.reshape(len(omega), -1)
    # Normalised columns: from 0.1 to 1000 rad/s they differ by eight orders of magnitude.
    size = np.linalg.norm(basis, axis=0)
    parts, *_ = np.linalg.lstsq(basis / size, flat, rcond=None)
    mass, stiffness = (parts / size[:, None]).reshape(2, *impedance.shape[1:])
    return ApparentImpedance(mass, impedance.real.mean(axis=0), stiffness)


class ZWidth(NamedTuple):
    """Impedances displayed in free motion and at a rigid wall [N s/m]."""

    free: Complex
    rigid: Complex

    @property
    def decades(self) -> Array:
        """Dynamic range log10(|rigid| / |free|)."""
        return np.log10(np.abs(self.rigid) / np.abs(self.free))


def transmitted_z_width(H: Complex) -> ZWidth:
    h11, h12, h21, h22 = matrix_entries(H)
    with np.errstate(divide="ignore", invalid="ignore"):
        rigid = np.where(h22 == 0, np.inf, h11 - h12 * h21 / h22)
    return ZWidth(h11, rigid)


#: Smallest relative change of a stiffness that a human hand can detect: Jones and Hunter 1990, by
#: matching of both arms, as commonly cited. Other studies: 0.19 to 0.34 for damping, 0.21 for mass.
WEBER_FRACTION = 0.23


def is_difference_noticed(rendered: Complex, ideal: Complex) -> NDArray[np.bool_]:
    """Return, for each frequency, whether a human distinguishes rendered from ideal impedance."""
    return np.abs(rendered / ideal - 1) > WEBER_FRACTION


def smallest_stiffness_change(H: Complex, omega: Array, stiffness: ArrayLike) -> Array:
    """Return the smallest increase [N/m] of wall stiffness that a human detects, or inf."""
    _, h12, h21, h22 = matrix_entries(H)
    s = 1j * omega
    environment = np.asarray(stiffness) / s
    # |Z_to(Z_e + x / s) - Z_to(Z_e)| = |h12 h21 x / s| / |a (a + b x)| with a = 1 + h22 Z_e and
    # b = h22 / s: at the threshold a quadratic in the increase x.
    a, b = 1 + h22 * environment, h22 / s
    share = WEBER_FRACTION * np.abs(transmitted_impedance(H, environment) * a * s)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (share / np.abs(h12 * h21)) ** 2
        q2 = 1 - share * np.abs(b) ** 2
        half = share * (a * b.conj()).real
        root = np.sqrt(half**2 + q2 * share * np.abs(a) ** 2)
        # The smaller positive root, without cancellation.
        change = share * np.abs(a) ** 2 / (root - half)
    return np.where(np.isfinite(change) & (change >= 0), change, np.inf)
