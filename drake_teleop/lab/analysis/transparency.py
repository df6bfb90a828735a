"""Comparison of the displayed impedance with the ideal one and with human thresholds.

Impedances are in N s/m, omega in rad/s; H is the station's hybrid matrix (see `two_port`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_teleop.common.numeric import Array
from drake_teleop.lab.analysis.one_axis import Complex, OneAxis, device_impedance
from drake_teleop.lab.analysis.two_port import matrix_entries, transmitted_impedance


def ideal_impedance(axis: OneAxis, s: Complex, environment: ArrayLike) -> Complex:
    """Return the ideal displayed impedance, set by the scales of force and motion (T52)."""
    felt = axis.gamma * np.asarray(environment) + axis.sigma * axis.tool_mass * s
    return device_impedance(axis, s) + axis.force_scale * axis.position_scale * felt


class ApparentImpedance(NamedTuple):
    """Displayed impedance as mass, damping and stiffness."""

    mass: Array  #: kg
    damping: Array  #: N s/m
    stiffness: Array  #: N/m


def fit_apparent_impedance(felt: Complex, omega: Array) -> ApparentImpedance:
    """Return the mass, damping and stiffness that fit an impedance (n, ...) best."""
    basis = np.stack([omega, -1 / omega], axis=-1)
    flat = felt.imag.reshape(len(omega), -1)
    # Normalised columns: from 0.1 to 1000 rad/s they differ by eight orders of magnitude.
    size = np.linalg.norm(basis, axis=0)
    parts, *_ = np.linalg.lstsq(basis / size, flat, rcond=None)
    mass, stiffness = (parts / size[:, None]).reshape(2, *felt.shape[1:])
    return ApparentImpedance(mass, felt.real.mean(axis=0), stiffness)


class ZWidth(NamedTuple):
    """Impedances displayed in free motion and at a rigid wall [N s/m]."""

    free: Complex
    rigid: Complex

    @property
    def decades(self) -> Array:
        """Dynamic range log10(|rigid| / |free|)."""
        return np.log10(np.abs(self.rigid) / np.abs(self.free))


def transmitted_z_width(H: Complex) -> ZWidth:
    """Return the impedances displayed in free motion and at a rigid wall."""
    h11, h12, h21, h22 = matrix_entries(H)
    with np.errstate(divide="ignore", invalid="ignore"):
        rigid = np.where(h22 == 0, np.inf, h11 - h12 * h21 / h22)
    return ZWidth(h11, rigid)


#: Smallest relative change of a stiffness that a human hand can detect: Jones and Hunter 1990, by
#: matching of both arms, as commonly cited. Other studies: 0.19 to 0.34 for damping, 0.21 for mass.
WEBER_FRACTION = 0.23


def is_difference_noticed(felt: Complex, ideal: Complex) -> NDArray[np.bool_]:
    """Return, for each frequency, whether a human notices the difference of the impedances."""
    return np.abs(felt / ideal - 1) > WEBER_FRACTION


def smallest_stiffness_change(H: Complex, omega: Array, stiffness: ArrayLike) -> Array:
    """Return the smallest increase [N/m] of a wall's stiffness that a human detects, or inf."""
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
