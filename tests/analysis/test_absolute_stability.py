"""Stability criteria against oscillating loads, energies and roots."""

from __future__ import annotations

import numpy as np
import pytest

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.lab.analysis import absolute_stability as ab
from drake_teleop.lab.analysis import two_port as tp
from drake_teleop.lab.analysis.one_axis import OneAxis

OMEGA = np.geomspace(0.1, 3000.0, 500)
S = 1j * OMEGA


def random_two_ports(n: int, seed: int) -> np.ndarray:
    """Return hybrid matrices near the limit of absolute stability, some with active ports."""
    rng = np.random.default_rng(seed)
    H = rng.normal(size=(n, 2, 2)) + 1j * rng.normal(size=(n, 2, 2))
    H *= np.exp(rng.normal(size=(n, 2, 2)))
    passive_ports = rng.random(n) < 0.8
    for i in (0, 1):
        H[passive_ports, i, i] = np.abs(H[passive_ports, i, i].real) + 1j * (
            H[passive_ports, i, i].imag
        )
    H[:, 0, 1] *= 0.7
    return H


def scanned_resistance(H: np.ndarray) -> np.ndarray:
    """Return the least Re Z displayed to the hand over all lossless environments [N s/m].

    Each of 8 rounds tries 17 susceptances around the best of the previous round.
    """
    h11, h12, h21, h22 = (entry[..., None] for entry in tp.matrix_entries(H))
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


def test_llewellyn_agrees_with_search_over_lossless_loads():
    H = random_two_ports(5000, 1)
    stable = (scanned_resistance(H) >= 0) & (H[:, 1, 1].real >= 0)
    assert np.array_equal(ab.is_absolutely_stable(H), stable)
    assert 1000 < np.sum(stable) < 4000
    # Random loads are independent of the search.
    rng = np.random.default_rng(2)
    for h, is_stable in zip(H[:200], stable[:200], strict=True):
        z_e = 1j * np.tan(rng.uniform(-np.pi / 2, np.pi / 2, 20000)) * np.exp(rng.normal())
        displayed = tp.transmitted_impedance(h, z_e).real
        assert not (is_stable and displayed.min() < 0)


def test_passive_implies_absolutely_stable_but_not_the_reverse():
    H = random_two_ports(20000, 4)
    passive, stable = ab.is_passive(H), ab.is_absolutely_stable(H)
    assert not np.any(passive & ~stable)
    assert np.sum(passive) > 500
    assert np.sum(stable & ~passive) > 500
    # Passive: the least eigenvalue of the Hermitian part is not negative.
    least = np.linalg.eigvalsh(H + np.conj(np.swapaxes(H, 1, 2)))[:, 0]
    assert np.array_equal(passive, least >= 0)
    # With a suitable power ratio both criteria are equal.
    even = tp.scale_slave_power(H, np.abs(H[:, 0, 1] / H[:, 1, 0]))
    np.testing.assert_allclose(
        ab.raisbeck_criterion(even), 2 * ab.llewellyn_criterion(H), rtol=1e-9, atol=1e-9
    )


def test_scales_alone_are_passive_on_scaled_ports():
    axis = OneAxis(ideal_servo=True, force_scale=1 / 17.5, position_scale=2.0, gamma=1.4)
    H = tp.hybrid_matrix(axis, S)
    assert np.all(ab.raisbeck_criterion(H) < -1)
    scaled = tp.scale_slave_power(H, tp.power_ratio(axis))
    np.testing.assert_allclose(ab.raisbeck_criterion(scaled), 0.0, atol=1e-12)
    assert np.all(ab.is_passive(scaled))
    np.testing.assert_allclose(
        ab.llewellyn_criterion(scaled), ab.llewellyn_criterion(H), atol=1e-12
    )


def pd_station(omega, axis):
    """Return the two-port of a position-force station with a PD servo."""
    s = 1j * omega
    Z_s, C = 3.13 * s, 300 + 9000 / s
    return tp.hybrid_matrix(axis, s, servo=(C / (Z_s + C), 1 / (Z_s + C)))


def test_position_force_is_not_absolutely_stable_even_without_delay():
    omega = np.geomspace(1.0, 1e4, 4000)
    axis = OneAxis(device_damping=0.0, sigma=0.0)
    H = pd_station(omega, axis)
    assert not np.any(ab.is_absolutely_stable(H)[omega > 100])
    needed = ab.required_damping(H)
    assert np.max(needed) == pytest.approx(890, rel=0.01)
    # 890 is the value at 10^4 rad/s; it grows without limit, k_f m_s w / 2.
    assert np.argmax(needed) == len(omega) - 1
    for w in (1e5, 1e6):
        damping = ab.required_damping(pd_station(np.array([w]), axis))[0]
        assert damping == pytest.approx(3.13 * w / 17.5 / 2, rel=1e-2)
    # It is the damping at which no lossless load gives a negative resistance.
    some = slice(1000, None, 100)
    less = tp.absorb_impedances(H, hand=0.999 * needed)
    more = tp.absorb_impedances(H, hand=1.001 * needed)
    assert np.all(scanned_resistance(less)[some] < 0)
    assert np.all(scanned_resistance(more)[some] > 0)
    # The station's servo damps the slave's velocity and requires much less.
    paper = tp.hybrid_matrix(OneAxis(device_damping=0.0), 1j * np.geomspace(0.01, 1e6, 4000))
    assert np.max(ab.required_damping(paper)) == pytest.approx(95.1, abs=0.1)


def test_structured_singular_value_agrees_with_llewellyn():
    H = random_two_ports(20000, 5)
    reference = (2.0, 0.5)
    mu = ab.structured_singular_value(tp.scattering_matrix(H, reference))
    assert np.array_equal(mu <= 1, ab.is_absolutely_stable(H))
    # It does not depend on the power ratio, in contrast to the norm, which is an upper bound.
    scaled = tp.scattering_matrix(tp.scale_slave_power(H, 7.0), reference)
    np.testing.assert_allclose(ab.structured_singular_value(scaled), mu, rtol=1e-9)
    assert np.all(mu <= ab.scattering_norm(scaled) * (1 + 1e-12))


def test_structured_singular_value_is_the_largest_gain_of_passive_terminations():
    scattered = tp.scattering_matrix(random_two_ports(30, 6))
    turns = np.exp(2j * np.pi * np.linspace(0, 1, 5001))
    for one, mu in zip(scattered, ab.structured_singular_value(scattered), strict=True):
        loads = np.zeros((len(turns), 2, 2), dtype=complex)
        loads[:, 0, 0], loads[:, 1, 1] = 1, turns
        radius = np.max(np.abs(np.linalg.eigvals(one @ loads)))
        assert radius == pytest.approx(mu, rel=1e-6)
        share = (0.3, 0.8)
        less = np.max(np.abs(np.linalg.eigvals(one @ np.diag(share) @ loads)))
        assert less == pytest.approx(ab.structured_singular_value(one, *share), rel=1e-6)


def roots(axis: OneAxis, hand: np.ndarray, wall: np.ndarray) -> np.ndarray:
    """Return the largest real part of the roots without delay.

    hand (n, 3) is m, b, k; wall (n, 2) is b, k. The equation of motion is
    hand and device (s) x + force(s) / slave(s) x = 0 with the servo's spring in the force.
    """
    (m_h, b_h, k_h), (b_e, k_e) = hand.T, wall.T
    kv, kp, m_s = axis.velocity_gain, axis.position_gain, axis.slave_mass
    zero = np.zeros_like(b_e)
    device = np.array([m_h + axis.device_mass, b_h + axis.device_damping, k_h])
    slave = np.array([zero + m_s, m_s * kv + b_e, m_s * kv * kp + k_e])
    force = np.array([zero + axis.displayed_tool_mass, axis.gamma * b_e, axis.gamma * k_e])
    force *= axis.force_scale * axis.position_scale * m_s * kv * kp
    polynomial = np.zeros((5, len(m_h)))
    for i in range(3):
        polynomial[2 + i] += force[i]
        for j in range(3):
            polynomial[i + j] += device[i] * slave[j]
    companion = np.zeros((len(m_h), 4, 4))
    companion[:, 0] = -(polynomial[1:] / polynomial[0]).T
    companion[:, [1, 2, 3], [0, 1, 2]] = 1
    return np.linalg.eigvals(companion).real.max(axis=1)


def members(hand: ab.ImpedanceRange, wall: ab.ImpedanceRange, n: int):
    ranges = (hand.mass, hand.damping, hand.stiffness, wall.damping, wall.stiffness)
    grids = [np.linspace(*r, n) for r in ranges]
    points = np.stack(np.meshgrid(*grids, indexing="ij"), -1).reshape(-1, 5)
    return points[:, :3], points[:, 3:]


def test_stiffness_limit_without_delay_agrees_with_roots_of_members():
    rng = np.random.default_rng(7)
    omega, limited = np.geomspace(0.1, 3000.0, 6000), 0
    for _ in range(40):
        axis = OneAxis(
            force_scale=rng.uniform(0.05, 1.0),
            sigma=rng.uniform(0, 1),
            slave_mass=rng.uniform(4, 20),
        )
        mass, damping, stiffness = (
            tuple(np.sort(np.exp(rng.uniform(np.log(low), np.log(high), 2))))
            for low, high in ((0.05, 2.0), (0.3, 30.0), (10.0, 1000.0))
        )
        hand = ab.ImpedanceRange(mass, damping, stiffness)
        H = tp.hybrid_matrix(axis, 1j * omega)
        limit = np.min(ab.stiffness_limit(H, omega, hand))

        def growth(walls, hand=hand, axis=axis):
            wall = ab.ImpedanceRange((0.0, 0.0), (0.0, 0.0), walls)
            return np.max(roots(axis, *members(hand, wall, 5)))

        if limit > 0.0:
            limited += limit < 1e5
            assert growth((0.0, min(0.98 * limit, 1e5))) < 0
        if 0.0 < limit < 1e5:
            assert growth((1.02 * limit, 1.1 * limit)) > 0
    assert limited > 8


def first_crossing(mass, damping, stiffness, contact):
    """Return the least round trip at which m s^2 + b s + k + K e^(-s RTT) has an imaginary root."""
    # |k - m w^2 + j b w|^2 = K^2 is a quadratic in w^2; at its larger root the root moves right.
    a, b, c = mass**2, damping**2 - 2 * mass * stiffness, stiffness**2 - contact**2
    with np.errstate(invalid="ignore"):
        w = np.sqrt((-b + np.sqrt(b**2 - 4 * a * c)) / (2 * a))
        trip = np.arctan2(damping * w, mass * w**2 - stiffness) / w
    return np.where(np.isnan(trip), np.inf, trip)


def largest_valid(holds, high):
    """Return the limit up to which `holds`, by bisection from 0."""
    low = 0.0
    while high - low > 1e-3 * high:
        middle = (low + high) / 2
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low


def test_disc_criterion_is_conservative_by_the_known_factor():
    """Softest rejected wall, by the discs and exactly; Llewellyn rejects all of them."""
    omega = np.geomspace(0.5, 3000.0, 1500)
    hand = ab.impedance_range_of_grips()
    for force_scale, delay, exact in (
        (1 / 17.5, 0.0, 3484),
        (1 / 17.5, 0.02, 888),
        (1, 0.005, 112),
    ):
        axis = OneAxis(force_scale=force_scale, delay=delay)
        H = tp.hybrid_matrix(axis, 1j * omega)
        assert not np.all(ab.is_absolutely_stable(tp.absorb_impedances(H, hand=hand.damping[0])))

        def wall(stiffness):
            return ab.ImpedanceRange((0.0, 0.0), (0.0, 0.1), (0.0, stiffness))

        def small(stiffness, H=H):
            return np.all(ab.singular_value_in_ranges(H, omega, hand, wall(stiffness)) < 1)

        largest, sufficient = np.min(ab.stiffness_limit(H, omega, hand)), largest_valid(small, 1e4)
        assert largest == pytest.approx(exact, rel=0.02)
        assert 0.9 * largest < sufficient < largest


def test_stiffness_limit_of_an_ideal_servo_is_that_of_its_lightest_grip():
    omega, hand = np.linspace(1.0, 100.0, 4000), ab.impedance_range_of_grips()
    for delay in (0.002, 0.01, 0.05):
        axis = OneAxis(ideal_servo=True, delay=delay)
        limit = np.min(ab.stiffness_limit(tp.hybrid_matrix(axis, 1j * omega), omega, hand))
        stiffnesses = limit * np.array([0.995, 1.005])
        wall = ab.ImpedanceRange((0.0, 0.0), (0.0, 0.0), tuple(stiffnesses))
        hands, walls = members(hand, wall, 11)
        trip = first_crossing(
            hands[:, 0] + axis.device_mass, hands[:, 1] + 0.5, hands[:, 2], walls[:, 1] / 17.5
        )
        assert np.min(trip[walls[:, 1] == stiffnesses[0]]) > 2 * delay
        assert np.min(trip[walls[:, 1] == stiffnesses[1]]) < 2 * delay
    # Some hands of the range oscillate without a wall.
    unstable = tp.absorb_impedances(tp.hybrid_matrix(axis, 1j * omega), hand=-1e3)
    wide = ab.ImpedanceRange((0.0, 1.0), (0.0, 2e3), (0.0, 1e3))
    assert np.min(ab.stiffness_limit(unstable, omega, wide)) == 0.0


def test_invalid_impedance_range_raises():
    for bad in ((2.0, 1.0), (0.0, np.inf), (np.nan, 1.0)):
        with pytest.raises(DrakeTeleopError, match=r"damping: .* is no range"):
            ab.ImpedanceRange((0.0, 0.0), bad, (0.0, 1.0))
