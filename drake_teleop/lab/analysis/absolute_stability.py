"""For which hands and environments a station is stable: any passive ones, or those within ranges.

Everything here takes two-ports (..., 2, 2) on the imaginary axis, see `two_port`, and answers for
each frequency. Whoever concludes from it that a station is stable says at the same time that h11
and h22 have no poles to the right of the axis; the servo of a station takes care of that.

A hand and an environment that may be anything passive are a hard test: a position-force station
fails it with any delay and, behind a servo that gives way, without one. What is asked beside it is
therefore whether the station is stable for those that there are: for every hand and environment
whose mass, damping and stiffness lie within `ImpedanceRange`s.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.lab.analysis.one_axis import Complex
from drake_teleop.lab.analysis.two_port import entries, transmitted_impedance

if TYPE_CHECKING:
    import control

Real = NDArray[np.float64]
Flags = NDArray[np.bool_]

_ROUNDING = 1e-12  # relative to the terms that cancel in a criterion


def llewellyn(H: Complex) -> Real:
    """2 Re h11 Re h22 - Re(h12 h21) - |h12 h21|, not negative where absolutely stable.

    It depends on the product of the scales only. Llewellyn, Proc. IRE 40 (1952).
    """
    h11, h12, h21, h22 = entries(H)
    product = h12 * h21
    return 2 * h11.real * h22.real - product.real - np.abs(product)


def llewellyn_parameter(H: Complex) -> Real:
    """(2 Re h11 Re h22 - Re h12 h21) / |h12 h21|, at least 1 where absolutely stable."""
    product = np.abs(H[..., 0, 1] * H[..., 1, 0])
    with np.errstate(divide="ignore", invalid="ignore"):
        return 1.0 + llewellyn(H) / product


def absolutely_stable(H: Complex) -> Flags:
    """Whether no passive hand and environment can make the station oscillate at the frequency."""
    h11, h12, h21, h22 = entries(H)
    size = np.abs(h12 * h21) + np.abs(h11 * h22)
    return (
        (h11.real >= -_ROUNDING * np.abs(h11))
        & (h22.real >= -_ROUNDING * np.abs(h22))
        & (llewellyn(H) >= -_ROUNDING * size)
    )


def required_damping(H: Complex) -> Real:
    """Damping to add to the device, or at least to be had of the hand, for absolute stability.

    The largest over all frequencies is what the station lacks; negative is to spare. Infinite where
    no damping helps. [N s/m]
    """
    h11, h12, h21, h22 = entries(H)
    product = h12 * h21
    loss = product.real + np.abs(product)
    loss = np.where(loss <= _ROUNDING * np.abs(product), 0.0, loss)
    with np.errstate(divide="ignore", invalid="ignore"):
        through = np.where(loss > 0, loss / (2 * h22.real), 0.0)
    return np.where(h22.real < 0, np.inf, through) - h11.real


def raisbeck(H: Complex) -> Real:
    """4 Re h11 Re h22 - |h12 + conj(h21)|^2, not negative where passive.

    Of a station with scales take it on `power_scaled` ports: else their ratio alone is what it
    sees. Raisbeck, J. Appl. Phys. 25 (1954).
    """
    h11, h12, h21, h22 = entries(H)
    return 4 * h11.real * h22.real - np.abs(h12 + np.conj(h21)) ** 2


def passive(H: Complex) -> Flags:
    """Whether the station takes up power at the frequency, however it is driven."""
    h11, h12, h21, h22 = entries(H)
    size = np.abs(h11 * h22) + np.abs(h12) ** 2 + np.abs(h21) ** 2
    return (
        (h11.real >= -_ROUNDING * np.abs(h11))
        & (h22.real >= -_ROUNDING * np.abs(h22))
        & (raisbeck(H) >= -_ROUNDING * size)
    )


def positive_real(system: control.lti.LTI) -> bool:
    """Whether a rational system, as an impedance or hybrid matrix, is passive at all frequencies.

    No frequency is missed: the least eigenvalue of G + G^H changes its sign only where the pencil
    of G(s) + G(-s)^T has an eigenvalue, and it is evaluated once between any two of these.

    Args:
        system: continuous, with as many inputs as outputs, proper (of an impedance that is not,
            pass the admittance).

    Raises:
        DrakeTeleopError: if it has no state space, is not square or is sampled.
    """
    import control
    from scipy import linalg

    if system.ninputs != system.noutputs or not system.isctime():
        raise DrakeTeleopError("needs a continuous system with as many inputs as outputs")
    try:
        model = control.ss(system)
    except (ValueError, TypeError, control.ControlMIMONotImplemented) as error:
        raise DrakeTeleopError(
            "this system has no state space", remedy="test its admittance"
        ) from error
    n, m = model.nstates, model.ninputs
    # G(s + e) is positive real for all small e > 0 if and only if G is: so poles on the axis, as of
    # a lossless spring, need no case of their own.
    poles = model.poles()
    shift = 1e-11 * max(1.0, np.max(np.abs(poles), initial=0.0))
    furthest = np.max(poles.real, initial=-np.inf)
    if furthest >= shift:
        return False
    A = model.A - (shift if furthest > -shift else 0.0) * np.eye(n)
    B, C, D = model.B, model.C, model.D
    pencil = np.block([[A, np.zeros((n, n)), B], [np.zeros((n, n)), -A.T, -C.T], [C, B.T, D + D.T]])
    finite = linalg.block_diag(np.eye(2 * n), np.zeros((m, m)))
    found = np.abs(linalg.eigvals(pencil, finite).imag)
    edges = np.sort(found[np.isfinite(found)])
    edges = np.concatenate([[0.0], edges, [2 * np.max(edges, initial=1.0)]])
    omega = np.concatenate([edges, (edges[1:] + edges[:-1]) / 2])
    inner = np.linalg.solve(
        1j * omega[:, None, None] * np.eye(n) - A, np.broadcast_to(B, (len(omega), n, m))
    )
    G = C @ inner + D
    least = np.linalg.eigvalsh(G + np.conj(np.swapaxes(G, 1, 2)))[:, 0]
    return bool(np.all(least >= -1e-9 * np.max(np.abs(G), axis=(1, 2), initial=0.0)))


def scattering_norm(S: Complex) -> Real:
    """Largest singular value of S; the station is passive where it is at most 1."""
    return _largest_singular_value(*entries(S))


def structured_singular_value(
    S: Complex, hand: ArrayLike = 1.0, environment: ArrayLike = 1.0
) -> Real:
    """mu of S for a hand and an environment that reflect no more than these shares of a wave.

    With 1, which is anything passive, mu <= 1 where the station is absolutely stable. Exact: for
    two ports mu is the least norm of D S D^-1, and that of the D that makes both transmissions
    equally large.

    Args:
        S: (..., 2, 2) scattering matrices.
        hand, environment: largest |Z - b| / |Z + b| with the reference b of S at that port.
    """
    s11, s12, s21, s22 = entries(S)
    r1, r2 = np.asarray(hand), np.asarray(environment)
    product = s12 * s21 * r1 * r2
    even = np.sqrt(np.abs(product))
    turned = product / np.where(even > 0, even, 1.0)
    return _largest_singular_value(s11 * r1, turned, even, s22 * r2)


def _largest_singular_value(a: Complex, b: Complex, c: Complex, d: Complex) -> Real:
    """Of [[a, b], [c, d]], as the half sum of two norms: exact where the two values are equal."""
    determinant = a * d - b * c
    size = np.abs(determinant)
    phase = np.where(size > 0, determinant / np.where(size > 0, size, 1.0), 1.0)
    d, c = phase * np.conj(d), phase * np.conj(c)
    sums = _square(a + d) + _square(b - c)
    differences = _square(a - d) + _square(b + c)
    return (np.sqrt(sums) + np.sqrt(differences)) / 2


def _square(z: Complex) -> Real:
    return z.real**2 + z.imag**2


def scanned_resistance(H: Complex) -> Real:
    """Least Re Z felt by the hand over all lossless environments, found by trying them [N s/m].

    A second opinion of Llewellyn's criterion: where h11 and h22 have positive real parts the two
    have the same sign. Each of 8 rounds tries 17 susceptances around the best of the one before.
    """
    h11, h12, h21, h22 = (entry[..., None] for entry in entries(H))
    scale = np.where(h22.real != 0, np.abs(h22.real), 1.0)
    step = np.pi / 8
    angles = np.linspace(-np.pi, np.pi, 17)
    centre = np.zeros_like(scale)
    for _ in range(8):
        tried = centre + angles
        susceptance = scale * np.tan(tried / 2) - h22.imag
        resistance = (h11 - h12 * h21 / (h22 + 1j * susceptance)).real
        best = np.argmin(resistance, axis=-1, keepdims=True)
        centre = np.take_along_axis(tried, best, axis=-1)
        angles, step = np.linspace(-step, step, 17), step / 8
    return np.take_along_axis(resistance, best, axis=-1)[..., 0]


class WorstLoads(NamedTuple):
    """The lossless hand and environment that come nearest to oscillating, each (...,) [N s/m].

    A reactance X > 0 at a frequency w is a mass X / w, X < 0 a spring of stiffness -X w.
    """

    hand: Real
    environment: Real
    resistance: Real  #: what is left of the loop; where it is negative they oscillate ever more


def worst_loads(H: Complex) -> WorstLoads:
    """The terminations that prove a station not absolutely stable; Re h22 must not be 0."""
    h11, h12, h21, h22 = entries(H)
    product = h12 * h21
    size = np.abs(product)
    phase = np.where(size > 0, product / np.where(size > 0, size, 1.0), 1.0)
    # 1 / (h22 + j B) is on a circle through 0; product times it has its largest real part here.
    seen = (1 + np.conj(phase)) / (2 * h22.real)
    with np.errstate(divide="ignore", invalid="ignore"):
        reactance = -1 / (1 / seen - h22).imag
    felt = h11 - product * seen
    return WorstLoads(-felt.imag, reactance, felt.real)


@dataclass(frozen=True)
class ImpedanceRange:
    """Hands or environments m s + b + k / s with (smallest, largest) values.

    At a frequency they are all the impedances of a rectangle.

    Raises:
        DrakeTeleopError: if a smallest value exceeds its largest, or they are not finite.
    """

    mass: tuple[float, float]  #: kg
    damping: tuple[float, float]  #: N s/m
    stiffness: tuple[float, float]  #: N/m

    def __post_init__(self) -> None:
        for name in ("mass", "damping", "stiffness"):
            low, high = getattr(self, name)
            if not -np.inf < low <= high < np.inf:
                raise DrakeTeleopError(
                    f"no range from {low} to {high}", where=name, remedy="give (smallest, largest)"
                )

    def corners(self, omega: Real) -> Complex:
        """(..., 4) corners of the rectangle [N s/m], once around."""
        low = self.mass[0] * omega - self.stiffness[1] / omega
        high = self.mass[1] * omega - self.stiffness[0] / omega
        least, most = self.damping
        return np.stack(
            [least + 1j * low, most + 1j * low, most + 1j * high, least + 1j * high], -1
        )

    def contains(self, impedance: Complex, omega: Real) -> Flags:
        """Whether there is one among them with this impedance [N s/m] at omega [rad/s]."""
        corners = self.corners(omega)
        low, high = corners[..., 0], corners[..., 2]
        return (
            (impedance.real >= low.real)
            & (impedance.real <= high.real)
            & (impedance.imag >= low.imag)
            & (impedance.imag <= high.imag)
        )


def range_of_grips() -> ImpedanceRange:
    """From the lightest to the firmest hand of the station's operator."""
    from drake_teleop.station.operator.operator import GRIPS

    mass, damping, stiffness = (
        (min(values), max(values))
        for values in zip(
            *((hand.mass, hand.damping, hand.stiffness) for hand in GRIPS.values()), strict=True
        )
    )
    return ImpedanceRange(mass, damping, stiffness)


def can_oscillate(
    H: Complex, omega: Real, hand: ImpedanceRange, environment: ImpedanceRange
) -> Flags:
    """Whether some hand and environment of the ranges keep up an oscillation at the frequency.

    Exact: they do where Z_h + Z_to(Z_e) = 0 for impedances of the two rectangles. If it is so at no
    frequency, all of them are stable or none is (zero exclusion), and one need be looked at; behind
    an ideal servo that is so if the felt mass of the tool is less than that of hand and device.
    The frequencies have to be dense: a range of hands without width slips between them.

    Args:
        H: (..., 2, 2).
        omega: [rad/s], broadcasts with H[..., 0, 0].
        hand, environment: the ranges.
    """
    h11, h12, h21, h22 = (entry[..., None, None] for entry in entries(H))
    z, e = hand.corners(omega)[..., :, None], environment.corners(omega)[..., None, :]
    dz, de = np.roll(z, -1, axis=-2) - z, np.roll(e, -1, axis=-1) - e
    t, u = _edges_meet(h11, h12 * h21, h22, z, dz, e, de)
    crossing = np.any((t >= 0) & (t <= 1) & (u >= 0) & (u <= 1), axis=(0, -2, -1))
    # No edges cross if one region is within the other.
    felt = transmitted_impedance(H, e[..., 0, 0])
    z1, h11, h12, h21, h22 = (x[..., 0, 0] for x in (z, h11, h12, h21, h22))
    with np.errstate(divide="ignore", invalid="ignore"):
        wanted = 1 / (h12 * h21 / (z1 + h11) - h22)
    return crossing | hand.contains(-felt, omega) | environment.contains(wanted, omega)


def stiffness_limit(H: Complex, omega: Real, hand: ImpedanceRange, damping: float = 0.0) -> Real:
    """The softest wall with which some hand of the range oscillates at each frequency [N/m].

    The least over the frequencies is the stiffness up to which all hands of the range are stable,
    if they are without a wall; infinite if none of them oscillates with any. Exact, as
    `can_oscillate`.

    Args:
        H: (..., 2, 2).
        omega: [rad/s], broadcasts with H[..., 0, 0].
        hand: the range.
        damping: of the wall [N s/m].
    """
    h11, h12, h21, h22 = (entry[..., None] for entry in entries(H))
    z = hand.corners(omega)
    wall: Complex = np.array(damping, dtype=complex)
    stiffer: Complex = np.array(-1j / omega, dtype=complex)[..., None]
    t, u = _edges_meet(h11, h12 * h21, h22, z, np.roll(z, -1, axis=-1) - z, wall, stiffer)
    limit = np.min(np.where((t >= 0) & (t <= 1) & (u >= 0), u, np.inf), axis=(0, -1))
    return np.where(hand.contains(-transmitted_impedance(H, wall), omega), 0.0, limit)


def _edges_meet(
    h11: Complex, product: Complex, h22: Complex, z: Complex, dz: Complex, e: Complex, de: Complex
) -> tuple[Real, Real]:
    """(2, ...) t and u, nan if none, at which a hand z + t dz oscillates with a wall e + u de."""
    # (Z_h + h11)(1 + h22 Z_e) - h12 h21 Z_e = a + b t + (c + d t) u; it is zero where
    # t = -(a + c u) / (b + d u) is real.
    held, give = z + h11, 1 + h22 * e
    a, b = held * give - product * e, dz * give
    c, d = (held * h22 - product) * de, dz * h22 * de
    # (a + c u) conj(b + d u) as a polynomial of u: its imaginary part vanishes.
    p0, p1, p2 = a * b.conj(), a * d.conj() + c * b.conj(), c * d.conj()
    with np.errstate(divide="ignore", invalid="ignore"):
        half = -(p1.imag + np.copysign(np.sqrt(p1.imag**2 - 4 * p2.imag * p0.imag), p1.imag)) / 2
        u = np.stack([half / p2.imag, p0.imag / half])
        size = _square(b) + u * (2 * (b * d.conj()).real + u * _square(d))
        return -(p0.real + u * (p1.real + u * p2.real)) / size, u


def bounded_singular_value(
    H: Complex, omega: Real, hand: ImpedanceRange, environment: ImpedanceRange
) -> Real:
    """mu for hands and environments of the ranges; none can oscillate where it is less than 1.

    Sufficient, and graded where `can_oscillate` is not: the rectangle of each range is enlarged to
    a disc, from nearly the smallest around it to nearly the half plane of all that have as much
    damping, and the pair of discs counts that does best. It holds for any linear hand and
    environment in these discs.

    Args:
        H: (..., 2, 2).
        omega: [rad/s], broadcasts with H[..., 0, 0].
        hand, environment: the ranges.
    """
    z, r1 = (values[..., :, None] for values in _discs(hand.corners(omega)))
    e, r2 = (values[..., None, :] for values in _discs(environment.corners(omega)))
    h11, h12, h21, h22 = (entry[..., None, None] for entry in entries(H))
    give = 1 / (1 + h22 * e)
    felt = z + h11 - h12 * h21 * e * give
    through = h12 * h21 * give**2 / felt
    # (z + r1 d1) + Z_to(e + r2 d2) vanishes for some |d1|, |d2| <= 1 where mu >= 1 of the matrix
    # with this diagonal and this product of the other two.
    first, second, product = r1 / felt, r2 * (h22 * give - through), -r1 * r2 * through / felt
    square = _square(first) + _square(second) + 2 * np.abs(product)
    determinant = 4 * _square(first * second - product)
    square += np.sqrt(np.maximum(square**2 - determinant, 0.0))
    return np.sqrt(np.min(square, axis=(-2, -1)) / 2)


_WIDENING = np.array([0.3, 1.0, 3.0, 10.0, 100.0])  # of a disc, in half diagonals


def _discs(corners: Complex) -> tuple[Complex, Real]:
    """Centres and radii (..., 5) of discs through the two corners with the least damping."""
    diagonal = corners[..., 2] - corners[..., 0]
    right = diagonal.real[..., None] / 2 + np.abs(diagonal)[..., None] / 2 * _WIDENING
    middle = corners[..., 0] + 0.5j * diagonal.imag
    return middle[..., None] + right, np.hypot(right, diagonal.imag[..., None] / 2)
