"""Comparison of the displayed impedance with the ideal one and with human thresholds.

Arrays are over frequency, impedances in N s/m, omega in rad/s. H: hybrid matrix (see `two_port`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.lab.analysis.one_axis import Complex, OneAxis, device_impedance
from drake_teleop.lab.analysis.two_port import entries, transmitted_impedance

Real = NDArray[np.float64]


def ideal_impedance(axis: OneAxis, s: Complex, environment: ArrayLike) -> Complex:
    """Return the ideal displayed impedance [N s/m], set by the scales of force and motion (T52)."""
    felt = axis.gamma * np.asarray(environment) + axis.sigma * axis.tool_mass * s
    return device_impedance(axis, s) + axis.force_scale * axis.position_scale * felt


class Apparent(NamedTuple):
    """Displayed impedance as mass, damping and stiffness."""

    mass: NDArray[np.float64]  #: kg
    damping: NDArray[np.float64]  #: N s/m
    stiffness: NDArray[np.float64]  #: N/m


def apparent(felt: Complex, omega: Real) -> Apparent:
    """Return the mass, damping and stiffness that fit an impedance (n, ...) best."""
    basis = np.stack([omega, -1 / omega], axis=-1)
    flat = felt.imag.reshape(len(omega), -1)
    # Normalised columns: from 0.1 to 1000 rad/s they differ by eight orders of magnitude.
    size = np.linalg.norm(basis, axis=0)
    parts, *_ = np.linalg.lstsq(basis / size, flat, rcond=None)
    mass, stiffness = (parts / size[:, None]).reshape(2, *felt.shape[1:])
    return Apparent(mass, felt.real.mean(axis=0), stiffness)


class Tracking(NamedTuple):
    """Position and force tracking between master and slave."""

    position: Complex  #: slave over device, V_s / V_m; l_p is ideal
    force: Complex  #: hand over environment, F_h / F_e, including the force on the device
    reflected: Complex  #: as `force`, without the force on the device; k_f gamma is ideal


def tracking(H: Complex, environment: Complex, device: Complex) -> Tracking:
    """Return position and force tracking in contact; impedances in N s/m, `environment` not 0."""
    _, _, h21, h22 = entries(H)
    position = -h21 / (1 + h22 * environment)
    felt = transmitted_impedance(H, environment)
    pushed = environment * position
    return Tracking(position, felt / pushed, (felt - device) / pushed)


class ZWidth(NamedTuple):
    """Impedances displayed in free motion and at a rigid wall [N s/m]."""

    free: Complex
    rigid: Complex

    @property
    def decades(self) -> Real:
        """Dynamic range log10(|rigid| / |free|)."""
        return np.log10(np.abs(self.rigid) / np.abs(self.free))


def transmitted_width(H: Complex) -> ZWidth:
    """Return the transmitted Z-width; `rigid` is infinite behind an ideal servo.

    Colgate and Brown, ICRA 1994; Hannaford, T-RA 5 (1989).
    """
    h11, h12, h21, h22 = entries(H)
    with np.errstate(divide="ignore", invalid="ignore"):
        rigid = np.where(h22 == 0, np.inf, h11 - h12 * h21 / h22)
    return ZWidth(h11, rigid)


def sensitivity(H: Complex, environment: ArrayLike) -> Complex:
    """Return the derivative of the displayed impedance with respect to the environment's.

    Ideal: k_f l_p gamma. Its norm over frequencies is the fidelity of Cavusoglu, Sherman and
    Tendick, T-RA 18 (2002).
    """
    _, h12, h21, h22 = entries(H)
    return -h12 * h21 / (1 + h22 * np.asarray(environment)) ** 2


class WeberFraction(NamedTuple):
    """Smallest relative change of a quantity that a human can detect."""

    value: float
    source: str


#: Weber fractions of the human hand. Studies differ by a factor of two and more. "abstract": taken
#: from the source's abstract; "recalled": the value commonly cited from it.
WEBER_FRACTIONS = {
    "force": WeberFraction(
        0.07, "Pang, Tan and Durlach 1991, 2.5 to 10 N between two fingers; abstract"
    ),
    "stiffness": WeberFraction(0.23, "Jones and Hunter 1990, matching of both arms; recalled"),
    "compliance": WeberFraction(
        0.22,
        "Tan, Durlach, Beauregard and Srinivasan 1995, without cues of force or work; abstract",
    ),
    "damping": WeberFraction(
        0.19, "Jones, Hunter and Lafontaine 1997, forced choice; 0.34 by matching; abstract"
    ),
    "mass": WeberFraction(0.21, "Beauregard and Srinivasan 1997, pinch grasp; recalled"),
}


class Fidelity(NamedTuple):
    """Comparison of the displayed impedance with the ideal one."""

    level: Real  #: displayed over ideal [dB]
    phase: Real  #: phase lead [deg], within +-180
    noticed: NDArray[np.bool_]  #: True where a human can detect the difference


def fidelity(
    felt: Complex, ideal: Complex, weber: float = WEBER_FRACTIONS["stiffness"].value
) -> Fidelity:
    """Return level, phase and detectability of the difference from the ideal impedance.

    One Weber fraction applies to mass, damping and stiffness (Fu, Landman, van Paassen and Mulder,
    T-HMS 48, 2018; abstracts).
    """
    ratio = felt / ideal
    level, phase = 20 * np.log10(np.abs(ratio)), np.angle(ratio, deg=True)
    return Fidelity(level, phase, np.abs(ratio - 1) > weber)


def smallest_stiffness_change(
    H: Complex,
    omega: Real,
    stiffness: ArrayLike,
    weber: float = WEBER_FRACTIONS["stiffness"].value,
    damping: ArrayLike = 0.0,
) -> Real:
    """Return the smallest increase of the environment's stiffness that the hand can detect [N/m].

    It explores with a motion at `omega`; detection as in `fidelity`. inf: none is detectable; for
    stiffness 0: the softest detectable wall.
    """
    if weber <= 0:
        raise DrakeTeleopError("must be positive", where="weber")
    _, h12, h21, h22 = entries(H)
    s = 1j * omega
    environment = np.asarray(damping) + np.asarray(stiffness) / s
    # |Z_to(Z_e + x / s) - Z_to(Z_e)| = |h12 h21 x / s| / |a (a + b x)| with a = 1 + h22 Z_e and
    # b = h22 / s: at the threshold a quadratic in the increase x.
    a, b = 1 + h22 * environment, h22 / s
    share = weber * np.abs(transmitted_impedance(H, environment) * a * s)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (share / np.abs(h12 * h21)) ** 2
        q2 = 1 - share * np.abs(b) ** 2
        half = share * (a * b.conj()).real
        root = np.sqrt(half**2 + q2 * share * np.abs(a) ** 2)
        # The smaller positive root, without cancellation.
        change = share * np.abs(a) ** 2 / (root - half)
    return np.where(np.isfinite(change) & (change >= 0), change, np.inf)
