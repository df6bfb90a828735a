"""Displayed impedance against the station's equations solved at each frequency."""

from __future__ import annotations

import numpy as np
import pytest

from drake_teleop.lab.analysis import two_port as tp
from drake_teleop.lab.analysis.one_axis import OneAxis, environment_impedance

OMEGA = np.geomspace(0.1, 1000.0, 200)
S = 1j * OMEGA
AXIS = OneAxis(
    device_mass=0.4, force_scale=0.3, position_scale=1.7, sigma=0.6, gamma=1.3, delay=0.015,
    mass_error=0.2, wall_damping=30.0,
)  # fmt: skip


def closed(axis: OneAxis, s: complex, stiffness: float) -> dict[str, complex]:
    """Return all signals of station and wall for V_m = 1."""
    late = np.exp(-s * axis.delay)
    spring = axis.slave_mass * axis.velocity_gain * axis.position_gain / s
    slave = axis.slave_mass * (s + axis.velocity_gain) + spring
    estimate = axis.tool_mass + axis.mass_error
    names = ["hand", "slave", "wall", "sensor", "sent"]
    A, b = np.zeros((5, 5), dtype=complex), np.zeros(5, dtype=complex)
    A[0, [0, 4]], b[0] = [1, -axis.force_scale * late], axis.device_mass * s + axis.device_damping
    A[1, [1, 2]], b[1] = [slave, 1], spring * axis.position_scale * late
    A[2, [2, 1]] = [1, -(axis.wall_damping + stiffness / s)]
    A[3, [3, 2, 1]] = [1, -1, -axis.tool_mass * s]
    A[4, [4, 3, 1]] = [1, -axis.gamma, (axis.gamma - axis.sigma) * estimate * s]
    return dict(zip(names, np.linalg.solve(A, b), strict=True))


def solved(name: str, stiffness: float = AXIS.wall_stiffness, axis: OneAxis = AXIS) -> np.ndarray:
    return np.array([closed(axis, s, stiffness)[name] for s in S])


def test_impedance_agrees_with_solved_equations():
    H, wall = tp.hybrid_matrix(AXIS, S), environment_impedance(AXIS, S)
    np.testing.assert_allclose(tp.transmitted_impedance(H, wall), solved("hand"), rtol=1e-9)


def test_ideal_station_displays_the_ideal_impedance():
    values = {**AXIS.__dict__, "ideal_servo": True, "delay": 0.0, "mass_error": 0.0}
    axis = OneAxis(**values)
    H, wall = tp.hybrid_matrix(axis, S), environment_impedance(axis, S)
    felt, ideal = tp.transmitted_impedance(H, wall), tp.ideal_impedance(axis, S, wall)
    np.testing.assert_allclose(felt, ideal, rtol=1e-11)
    assert not np.any(tp.is_difference_noticed(felt, ideal))


def test_differences_above_the_weber_fraction_are_noticed():
    ideal = 2.0 + 3.0 * S
    assert np.all(tp.is_difference_noticed(ideal * np.exp(1j * np.radians(-20)), ideal))
    assert not np.any(tp.is_difference_noticed(1.22 * ideal, ideal))
    assert np.all(tp.is_difference_noticed(1.24 * ideal, ideal))
    # A station with a servo is near its ideal at low frequencies only.
    axis = OneAxis(sigma=0.5, wall_stiffness=1000.0)
    wall = environment_impedance(axis, S)
    felt = tp.transmitted_impedance(tp.hybrid_matrix(axis, S), wall)
    near = tp.is_difference_noticed(felt, tp.ideal_impedance(axis, S, wall))
    assert not np.any(near[OMEGA < 2.0])
    assert np.any(near[OMEGA > 10.0])


def test_apparent_mass_damping_and_stiffness():
    rng = np.random.default_rng(0)
    for _ in range(20):
        m, b, k = rng.uniform(-1, 3), rng.uniform(0, 50), rng.uniform(0, 5000)
        fitted = tp.fit_apparent_impedance(m * S + b + k / S, OMEGA)
        np.testing.assert_allclose(fitted, [m, b, k], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("sigma", [0.0, 0.5, 1.0, 1.5])
def test_apparent_mass_in_free_motion_follows_the_scales(sigma):
    slow = 1j * np.linspace(0.5, 5.0, 50)
    axis = OneAxis(sigma=sigma, ideal_servo=True, mass_error=-0.1)
    felt = tp.fit_apparent_impedance(tp.hybrid_matrix(axis, slow)[:, 0, 0], slow.imag)
    error = (sigma - 1.0) * -0.1
    mass = axis.device_mass + (sigma * axis.tool_mass + error) / 17.5
    assert felt.mass == pytest.approx(mass, rel=1e-9)
    assert felt.damping == pytest.approx(axis.device_damping, rel=1e-9)
    # The lag of the servo adds damping from the tool.
    real = tp.fit_apparent_impedance(tp.hybrid_matrix(OneAxis(sigma=1.0), slow)[:, 0, 0], slow.imag)
    assert real.damping > axis.device_damping
    assert real.mass == pytest.approx(axis.device_mass + axis.tool_mass / 17.5, rel=0.02)


def test_transmitted_width_agrees_with_solved_equations():
    width = tp.transmitted_z_width(tp.hybrid_matrix(AXIS, S))
    np.testing.assert_allclose(
        width.free,
        solved("hand", 0.0, OneAxis(**{**AXIS.__dict__, "wall_damping": 0.0})),
        rtol=1e-9,
    )
    np.testing.assert_allclose(width.rigid, solved("hand", 1e18), rtol=1e-9)
    np.testing.assert_allclose(
        width.decades, np.log10(np.abs(width.rigid / width.free)), rtol=1e-12
    )
    # At low frequency a rigid wall has the scaled stiffness of the servo.
    axis = OneAxis()
    rigid = tp.transmitted_z_width(tp.hybrid_matrix(axis, np.array([1e-3j]))).rigid
    spring = axis.slave_mass * axis.velocity_gain * axis.position_gain
    assert -rigid.imag * 1e-3 == pytest.approx(spring * axis.force_scale, rel=1e-6)
    assert np.all(
        np.isinf(tp.transmitted_z_width(tp.hybrid_matrix(OneAxis(ideal_servo=True), S)).rigid)
    )


@pytest.mark.parametrize("stiffness", [0.0, 50.0, 5100.0, 1e6])
def test_smallest_stiffness_change_differs_by_the_weber_fraction(stiffness):
    H = tp.hybrid_matrix(AXIS, S)
    change = tp.smallest_stiffness_change(H, OMEGA, stiffness)
    found = np.isfinite(change)
    before = tp.transmitted_impedance(H, stiffness / S)
    for i in np.flatnonzero(found):
        wall = (stiffness + change[i] * np.array([0.3, 0.9, 1.0, 1.1])) / S[i]
        share = np.abs(tp.transmitted_impedance(H[i], wall) / before[i] - 1)
        assert share[2] == pytest.approx(0.23, rel=1e-6)
        assert np.all(share[:2] < 0.23)
    trial = np.geomspace(1e-3, 1e12, 400)[:, None]
    share = np.abs(tp.transmitted_impedance(H, (stiffness + trial) / S) / before - 1)
    assert np.array_equal(np.any(share > 0.23, axis=0), found)


def test_smallest_stiffness_change_of_transparent_and_real_stations():
    direct = tp.two_port_matrix(0.0 * S, 1.0, -1.0, 0.0)
    for k in (10.0, 5100.0):
        np.testing.assert_allclose(
            tp.smallest_stiffness_change(direct, OMEGA, k), 0.23 * k, rtol=1e-12
        )
    # The device's mass and damping add to the wall and may cancel part of it.
    axis, k = OneAxis(ideal_servo=True), 5100.0
    change = tp.smallest_stiffness_change(tp.hybrid_matrix(axis, S), OMEGA, k)
    felt = axis.device_damping + 1j * (axis.device_mass * OMEGA - k / 17.5 / OMEGA)
    np.testing.assert_allclose(change, 0.23 * np.abs(felt) * OMEGA * 17.5, rtol=1e-9)
    # The servo's spring is in series with the wall: a stiffer one must change by more.
    H, axis = tp.hybrid_matrix(OneAxis(), S), OneAxis()
    spring = axis.slave_mass * axis.velocity_gain * axis.position_gain
    for k in (5100.0, 200000.0):
        both = 1.23 / (1 / k + 1 / spring)
        stiffer = 1 / (1 / both - 1 / spring) - k
        hidden = tp.smallest_stiffness_change(H, OMEGA, k)[0]
        assert hidden == pytest.approx(stiffer, rel=1e-3)
    # Above some stiffness no difference is detectable.
    assert np.isinf(tp.smallest_stiffness_change(H, OMEGA, 5 * spring)[0])
    # The softest detectable wall depends on the device's own impedance.
    w = 2 * np.pi
    axis = OneAxis(ideal_servo=True)
    softest = tp.smallest_stiffness_change(
        tp.hybrid_matrix(axis, np.array([1j * w])), np.array([w]), 0.0
    )
    device = abs(axis.device_mass * 1j * w + axis.device_damping)
    assert softest[0] == pytest.approx(0.23 * device * w * 17.5, rel=1e-9)
