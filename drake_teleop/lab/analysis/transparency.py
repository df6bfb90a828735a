"""What the hand feels of the environment, against what it should, and whether a human can tell.

Arrays over frequency throughout; two-ports as in `two_port`.
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
    """Z_m + k_f l_p (gamma Z_e + sigma m_t s) [N s/m], what the scales of a station promise.

    It is felt with an ideal servo, no delay and a mass of the tool that is known exactly.
    """
    felt = axis.gamma * np.asarray(environment) + axis.sigma * axis.tool_mass * s
    return device_impedance(axis, s) + axis.force_scale * axis.position_scale * felt


class Apparent(NamedTuple):
    """A felt impedance as mass, damping and stiffness: numbers, or arrays over frequency."""

    mass: NDArray[np.float64]  #: kg
    damping: NDArray[np.float64]  #: N s/m
    stiffness: NDArray[np.float64]  #: N/m


def apparent_at_each(felt: Complex, omega: Real) -> Apparent:
    """At each frequency Re Z as damping and all of Im Z as mass, and again all of it as stiffness.

    A negative mass is a spring. Args: felt [N s/m], omega [rad/s], both (..., ).
    """
    return Apparent(felt.imag / omega, felt.real, -felt.imag * omega)


def apparent(felt: Complex, omega: Real) -> Apparent:
    """The m s + b + k / s nearest to a felt impedance, by least squares over the frequencies.

    Args:
        felt: (n, ...) [N s/m].
        omega: (n,) [rad/s], at least two.
    """
    basis = np.stack([omega, -1 / omega], axis=-1)
    flat = felt.imag.reshape(len(omega), -1)
    # Columns of equal size: from 0.1 to 1000 rad/s they differ by eight orders of magnitude.
    size = np.linalg.norm(basis, axis=0)
    parts, *_ = np.linalg.lstsq(basis / size, flat, rcond=None)
    mass, stiffness = (parts / size[:, None]).reshape(2, *felt.shape[1:])
    return Apparent(mass, felt.real.mean(axis=0), stiffness)


class Tracking(NamedTuple):
    """How the ends follow one another, (...,) over frequency."""

    position: Complex  #: slave over device, V_s / V_m; l_p is ideal
    force: Complex  #: hand over environment, F_h / F_e; it has the force on the device's own mass
    reflected: Complex  #: what is sent to the hand over F_e; k_f gamma is ideal


def tracking(H: Complex, environment: Complex, device: Complex) -> Tracking:
    """Position and force tracking in contact with an environment.

    Args:
        H: (..., 2, 2).
        environment: Z_e [N s/m], not 0.
        device: Z_m [N s/m], whose force is not counted as reflected.
    """
    _, _, h21, h22 = entries(H)
    position = -h21 / (1 + h22 * environment)
    felt = transmitted_impedance(H, environment)
    pushed = environment * position
    return Tracking(position, felt / pushed, (felt - device) / pushed)


class ZWidth(NamedTuple):
    """What is felt of nothing and of a rigid wall (...,) [N s/m]: the range there is between."""

    free: Complex
    rigid: Complex

    @property
    def decades(self) -> Real:
        """log10 |rigid| / |free| at each frequency."""
        return np.log10(np.abs(self.rigid) / np.abs(self.free))


def transmitted_width(H: Complex) -> ZWidth:
    """Z-width transmitted: h11 and h11 - h12 h21 / h22, infinite behind an ideal servo.

    Colgate and Brown, ICRA 1994, of haptic displays; Hannaford, T-RA 5 (1989), of two-ports.
    """
    h11, h12, h21, h22 = entries(H)
    with np.errstate(divide="ignore", invalid="ignore"):
        rigid = np.where(h22 == 0, np.inf, h11 - h12 * h21 / h22)
    return ZWidth(h11, rigid)


def sensitivity(H: Complex, environment: ArrayLike) -> Complex:
    """dZ_to / dZ_e: how much of a small change of the environment reaches the hand.

    k_f l_p gamma is ideal. The measure of fidelity of Cavusoglu, Sherman and Tendick, T-RA 18
    (2002), is the norm of this over the frequencies of interest.
    """
    _, h12, h21, h22 = entries(H)
    return -h12 * h21 / (1 + h22 * np.asarray(environment)) ** 2


class WeberFraction(NamedTuple):
    """The smallest share by which a quantity must change for a human to tell."""

    value: float
    source: str


#: Of the human hand. Values differ between studies by a factor of two and more with the way of
#: asking; "abstract" is what we read of a source, "recalled" is the value commonly cited from it.
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
    """What is felt against what should be, (...,) over frequency."""

    level: Real  #: how much more is felt [dB]
    phase: Real  #: how much earlier [deg], within +-180
    noticed: NDArray[np.bool_]  #: whether a human can tell the two apart


def fidelity(
    felt: Complex, ideal: Complex, weber: float = WEBER_FRACTIONS["stiffness"].value
) -> Fidelity:
    """Compares two impedances [N s/m]; a human can tell where they differ by more than a share.

    That one share of the impedance serves for mass, damping and stiffness is what Fu, Landman, van
    Paassen and Mulder found (T-HMS 48, 2018, and its sequels; abstracts).

    Args:
        felt: for instance `two_port.transmitted_impedance`.
        ideal: for instance `ideal_impedance`.
        weber: the share of `ideal`.
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
    """The least increase of the environment's stiffness that a hand on the device can tell [N/m].

    A human who moves it at `omega` tells two impedances apart as in `fidelity`. With the hand on
    the environment itself, if that has no damping, the answer is weber * stiffness; more than this
    is what the station hides, by what it adds of its own and by what its servo gives way. It can
    be less where the device's mass and the wall cancel. Of stiffness 0 it is the softest wall that
    can be told from none.

    Args:
        H: (..., 2, 2) at omega.
        omega: of the exploring motion [rad/s], (...,).
        stiffness, damping: of the environment [N/m], [N s/m], broadcast with omega.
        weber: of the impedance.

    Returns:
        (...,), infinite where no stiffness can be told from this one.

    Raises:
        DrakeTeleopError: if the Weber fraction is not positive.
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
        # The smaller positive root, in the form that does not cancel.
        change = share * np.abs(a) ** 2 / (root - half)
    return np.where(np.isfinite(change) & (change >= 0), change, np.inf)
