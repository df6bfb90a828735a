"""Stability criteria of a station for passive, or bounded, impedances of hand and environment.

H is the station's hybrid matrix (..., 2, 2) of `two_port` at frequencies omega [rad/s].
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.lab.analysis.one_axis import Complex
from drake_teleop.lab.analysis.two_port import matrix_entries, two_port_matrix

BooleanArray = NDArray[np.bool_]

_RELATIVE_ROUNDING_TOLERANCE = 1e-12  # relative to the terms that cancel in a criterion


def llewellyn_criterion(H: Complex) -> Array:
    """Return Llewellyn's criterion of hybrid matrices H; negative: not absolutely stable.

    2 Re h11 Re h22 - Re(h12 h21) - |h12 h21| (Llewellyn, Proc. IRE 40, 1952; T54).
    """
    h11, h12, h21, h22 = matrix_entries(H)
    product = h12 * h21
    return 2 * h11.real * h22.real - product.real - np.abs(product)


def llewellyn_parameter(H: Complex) -> Array:
    """Return `llewellyn_criterion` / |h12 h21| + 1; absolute stability requires at least 1."""
    product = np.abs(H[..., 0, 1] * H[..., 1, 0])
    with np.errstate(divide="ignore", invalid="ignore"):
        return 1.0 + llewellyn_criterion(H) / product


def is_absolutely_stable(H: Complex) -> BooleanArray:
    """Return whether H is stable with any passive hand and environment, at each frequency."""
    h11, h12, h21, h22 = matrix_entries(H)
    return _is_criterion_met(H, llewellyn_criterion(H), np.abs(h12 * h21) + np.abs(h11 * h22))


def _is_criterion_met(H: Complex, criterion: Array, term_magnitude: Array) -> BooleanArray:
    met = criterion >= -_RELATIVE_ROUNDING_TOLERANCE * term_magnitude
    for port in (H[..., 0, 0], H[..., 1, 1]):
        met &= port.real >= -_RELATIVE_ROUNDING_TOLERANCE * np.abs(port)
    return met


def required_damping(H: Complex) -> Array:
    """Return the device damping [N s/m] to add for absolute stability, for each frequency of H.

    Negative: surplus damping. inf: no damping is sufficient.
    """
    h11, h12, h21, h22 = matrix_entries(H)
    product = h12 * h21
    loss = product.real + np.abs(product)
    loss = np.where(loss <= _RELATIVE_ROUNDING_TOLERANCE * np.abs(product), 0.0, loss)
    with np.errstate(divide="ignore", invalid="ignore"):
        through = np.where(loss > 0, loss / (2 * h22.real), 0.0)
    return np.where(h22.real < 0, np.inf, through) - h11.real


def raisbeck_criterion(H: Complex) -> Array:
    """Return Raisbeck's criterion of hybrid matrices H; negative: not passive.

    4 Re h11 Re h22 - |h12 + h21*|^2 (Raisbeck, J. Appl. Phys. 25, 1954; T55).
    """
    h11, h12, h21, h22 = matrix_entries(H)
    return 4 * h11.real * h22.real - np.abs(h12 + np.conj(h21)) ** 2


def is_passive(H: Complex) -> BooleanArray:
    """Return whether the station is passive (absorbs power), for each frequency of H."""
    h11, h12, h21, h22 = matrix_entries(H)
    size = np.abs(h11 * h22) + np.abs(h12) ** 2 + np.abs(h21) ** 2
    return _is_criterion_met(H, raisbeck_criterion(H), size)


def scattering_norm(S: Complex) -> Array:
    """Return the largest singular value of each scattering matrix S; passive if at most 1."""
    return _largest_singular_value(*matrix_entries(S))


def structured_singular_value(
    S: Complex, max_hand_reflection: ArrayLike = 1.0, max_environment_reflection: ArrayLike = 1.0
) -> Array:
    """Return the structured singular value mu of the scattering matrix S (T56).

    Hand and environment have at most these wave reflection factors. With 1 (passive),
    mu <= 1 means absolutely stable.
    """
    s11, s12, s21, s22 = matrix_entries(S)
    r1, r2 = np.asarray(max_hand_reflection), np.asarray(max_environment_reflection)
    product = s12 * s21 * r1 * r2
    even = np.sqrt(np.abs(product))
    turned = product / np.where(even > 0, even, 1.0)
    return _largest_singular_value(s11 * r1, turned, even, s22 * r2)


def _largest_singular_value(a: Complex, b: Complex, c: Complex, d: Complex) -> Array:
    determinant = a * d - b * c
    size = np.abs(determinant)
    phase = np.where(size > 0, determinant / np.where(size > 0, size, 1.0), 1.0)
    d, c = phase * np.conj(d), phase * np.conj(c)
    sums = _squared_abs(a + d) + _squared_abs(b - c)
    differences = _squared_abs(a - d) + _squared_abs(b + c)
    return (np.sqrt(sums) + np.sqrt(differences)) / 2


def _squared_abs(z: Complex) -> Array:
    return z.real**2 + z.imag**2


@dataclass(frozen=True)
class ImpedanceRange:
    """Range of hand or environment impedances m s + b + k / s; each field: (smallest, largest)."""

    mass: tuple[float, float]  #: kg
    damping: tuple[float, float]  #: N s/m
    stiffness: tuple[float, float]  #: N/m

    def __post_init__(self) -> None:
        for name in ("mass", "damping", "stiffness"):
            low, high = getattr(self, name)
            if not -np.inf < low <= high < np.inf:
                what = f"{low} to {high} is no range (finite, smallest first)"
                remedy = "give (smallest, largest), which may be equal"
                raise DrakeTeleopError(what, where=f"ImpedanceRange.{name}", remedy=remedy)

    def corners(self, omega: Array) -> Complex:
        """Return the corners (..., 4) of the rectangle of impedances [N s/m] at `omega` [rad/s].

        In the complex plane, counter-clockwise from the lower left.
        """
        low = self.mass[0] * omega - self.stiffness[1] / omega
        high = self.mass[1] * omega - self.stiffness[0] / omega
        b0, b1 = self.damping
        return np.stack([b0 + 1j * low, b1 + 1j * low, b1 + 1j * high, b0 + 1j * high], -1)

    def contains(self, impedance: Complex, omega: Array) -> BooleanArray:
        corners, z = self.corners(omega), impedance
        above, below = z - corners[..., 0], corners[..., 2] - z
        return np.min([above.real, above.imag, below.real, below.imag], axis=0) >= 0


def impedance_range_of_grips() -> ImpedanceRange:
    from drake_teleop.station.operator.operator import GRIP_IMPEDANCES

    hands = [(hand.mass, hand.damping, hand.stiffness) for hand in GRIP_IMPEDANCES.values()]
    return ImpedanceRange(*((min(values), max(values)) for values in zip(*hands, strict=True)))


def stiffness_limit(H: Complex, omega: Array, hand: ImpedanceRange) -> Array:
    """Return, for each omega, the softest wall [N/m] that oscillates with a hand in range (T57).

    0: free motion oscillates; inf: no wall stiffness does. If a dense grid of omega gives inf only,
    stability is the same for all hands in range. A range of one hand always gives inf.
    """
    h11, h12, h21, h22 = (entry[..., None] for entry in matrix_entries(H))
    z = hand.corners(omega)
    # Hand z + t dz and wall u / s oscillate where (Z_h + h11)(1 + h22 Z_e) - h12 h21 Z_e =
    # a + b t + (c + d t) u is zero, so that t = -(a + c u) / (b + d u) is real.
    a, b = z + h11, np.roll(z, -1, axis=-1) - z
    per_stiffness = np.asarray(-1j / omega)[..., None]
    c, d = (a * h22 - h12 * h21) * per_stiffness, b * h22 * per_stiffness
    # (a + c u) conj(b + d u) as a polynomial of u: its imaginary part vanishes.
    p0, p1, p2 = a * b.conj(), a * d.conj() + c * b.conj(), c * d.conj()
    with np.errstate(divide="ignore", invalid="ignore"):
        half = -(p1.imag + np.copysign(np.sqrt(p1.imag**2 - 4 * p2.imag * p0.imag), p1.imag)) / 2
        u = np.stack([half / p2.imag, p0.imag / half])
        t = -(p0.real + u * (p1.real + u * p2.real)) / _squared_abs(b + d * u)
    limit = np.min(np.where((t >= 0) & (t <= 1) & (u >= 0), u, np.inf), axis=(0, -1))
    return np.where(hand.contains(-H[..., 0, 0], omega), 0.0, limit)


def singular_value_in_ranges(
    H: Complex, omega: Array, hand: ImpedanceRange, environment: ImpedanceRange
) -> Array:
    """Return the structured singular value mu for ranges of hand and environment.

    Below 1: no hand and environment in these ranges oscillate at this `omega` [rad/s].
    """
    z, r1 = (values[..., :, None] for values in _discs_around_rectangle(hand.corners(omega)))
    e, r2 = (values[..., None, :] for values in _discs_around_rectangle(environment.corners(omega)))
    h11, h12, h21, h22 = (entry[..., None, None] for entry in matrix_entries(H))
    reduction = 1 / (1 + h22 * e)
    displayed = z + h11 - h12 * h21 * e * reduction
    through = h12 * h21 * reduction**2 / displayed
    # (z + r1 d1) + Z_to(e + r2 d2) vanishes for some |d1|, |d2| <= 1 where mu >= 1 of the matrix
    # with this diagonal and this product of the other two.
    first, second = r1 / displayed, r2 * (h22 * reduction - through)
    mu = structured_singular_value(two_port_matrix(first, -first * r2 * through, 1.0, second))
    return np.min(mu, axis=(-2, -1))


def _discs_around_rectangle(corners: Complex) -> tuple[Complex, Array]:
    half = (corners[..., 2:3] - corners[..., :1]) / 2
    # Centres of the discs, from few to many half diagonals beside the range.
    right = half.real + np.abs(half) * np.array([0.3, 1.0, 3.0, 10.0, 100.0])
    return corners[..., :1] + 1j * half.imag + right, np.hypot(right, half.imag)
