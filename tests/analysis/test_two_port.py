"""Two-ports against the block diagram, solved numerically at each frequency."""

from __future__ import annotations

import numpy as np
import pytest

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.lab.analysis import two_port as tp
from drake_teleop.lab.analysis.one_axis import OneAxis

OMEGA = np.geomspace(0.1, 3000.0, 500)
S = 1j * OMEGA


def random_axis(rng: np.random.Generator, **fixed: float) -> OneAxis:
    values = {
        "device_mass": rng.uniform(0.05, 2.0),
        "device_damping": rng.uniform(0.1, 10.0),
        "slave_mass": rng.uniform(1.0, 30.0),
        "position_gain": rng.uniform(20.0, 100.0),
        "velocity_gain": rng.uniform(100.0, 600.0),
        "tool_mass": rng.uniform(0.2, 5.0),
        "mass_error": rng.uniform(-0.5, 0.5),
        "force_scale": rng.uniform(0.05, 2.0),
        "position_scale": rng.uniform(0.2, 3.0),
        "sigma": rng.uniform(0.0, 2.0),
        "gamma": rng.uniform(0.2, 2.0),
        "delay": rng.uniform(0.0, 0.3),
        "wall_stiffness": rng.uniform(100.0, 20000.0),
    }
    return OneAxis(**{**values, **fixed})


def solved(axis: OneAxis, s: complex, drive: np.ndarray, servo=None) -> np.ndarray:
    """Return [F_h, -V_s] for drive = [V_m, F_e] from the station's block diagram."""
    spring, damper = axis.slave_mass * axis.velocity_gain * axis.position_gain, 0.0
    brake, mass = axis.slave_mass * axis.velocity_gain, axis.slave_mass
    if servo:
        mass, spring, damper, brake = servo
    late = np.exp(-s * axis.delay)
    estimate = axis.tool_mass + axis.mass_error
    # Unknown: F_h, V_s, acceleration a, wrist's force F, sent force F', the command's velocity.
    A = np.zeros((6, 6), dtype=complex)
    b = np.zeros(6, dtype=complex)
    v_m, f_e = drive
    A[0, 0], A[0, 4], b[0] = 1, -axis.force_scale * late, (
        (axis.device_mass * s + axis.device_damping) * v_m
    )  # fmt: skip
    A[1, 1], A[1, 5] = mass * s + brake + damper + spring / s, -(damper + spring / s)
    b[1] = -f_e
    A[2, 2], A[2, 1] = 1, -s
    A[3, 3], A[3, 2], b[3] = 1, -axis.tool_mass, f_e
    A[4, 4], A[4, 3], A[4, 2] = 1, -axis.gamma, (axis.gamma - axis.sigma) * estimate
    A[5, 5], b[5] = 1, axis.position_scale * late * v_m
    x = np.linalg.solve(A, b)
    return np.array([x[0], -x[1]])


def solved_matrix(axis: OneAxis, s: np.ndarray, servo=None) -> np.ndarray:
    columns = [[solved(axis, si, drive, servo) for drive in np.eye(2)] for si in s]
    return np.swapaxes(np.array(columns), 1, 2)


@pytest.mark.parametrize("seed", range(10))
def test_hybrid_equals_the_block_diagram(seed):
    axis = random_axis(np.random.default_rng(seed))
    H, truth = tp.hybrid_matrix(axis, S[::20]), solved_matrix(axis, S[::20])
    np.testing.assert_allclose(H, truth, rtol=1e-9)
    wall = axis.wall_damping + axis.wall_stiffness / S[::20]
    felt = tp.transmitted_impedance(H, wall)
    for h, z, f in zip(truth, wall, felt, strict=True):
        # F_h, V_s, F_e for V_m = 1.
        A = np.array([[1, 0, -h[0, 1]], [0, -1, -h[1, 1]], [0, -z, 1]])
        F_h, _, _ = np.linalg.solve(A, np.array([h[0, 0], h[1, 0], 0]))
        assert abs(f - F_h) <= 1e-9 * abs(F_h)


def test_hybrid_with_a_user_supplied_servo():
    axis = random_axis(np.random.default_rng(1))
    m, k, d = 3.13, 9000.0, 300.0
    Z_s, C = m * S[::20], d + k / S[::20]
    H = tp.hybrid_matrix(axis, S[::20], servo=(C / (Z_s + C), 1 / (Z_s + C)))
    np.testing.assert_allclose(H, solved_matrix(axis, S[::20], (m, k, d, 0.0)), rtol=1e-9)


def test_ideal_servo_without_delay_displays_scaled_environment_and_tool():
    axis = random_axis(np.random.default_rng(2), delay=0.0, mass_error=0.0, ideal_servo=True)
    Z_e = 40.0 + 5100.0 / S
    felt = tp.transmitted_impedance(tp.hybrid_matrix(axis, S), Z_e)
    # F_h = m_m a + b_m v + k_f (gamma F_e + sigma m_t a), slave at l_p times the master.
    v, a = 1.0, S
    F_e = Z_e * axis.position_scale * v
    sent = axis.gamma * F_e + axis.sigma * axis.tool_mass * axis.position_scale * a
    F_h = axis.device_mass * a + axis.device_damping * v + axis.force_scale * sent
    np.testing.assert_allclose(felt, F_h, rtol=1e-12)


def test_stiff_servo_tends_to_the_ideal_one():
    slow = S[OMEGA < 200]
    axis = random_axis(np.random.default_rng(3))
    values = {**axis.__dict__, "position_gain": 1e9, "velocity_gain": 1e12}
    stiff = tp.hybrid_matrix(OneAxis(**values), slow)
    ideal = tp.hybrid_matrix(OneAxis(**{**values, "ideal_servo": True}), slow)
    np.testing.assert_allclose(stiff[..., 0, :], ideal[..., 0, :], rtol=1e-6)


@pytest.mark.parametrize("scale", [0.3, 1.0, 1.7])
def test_estimate_has_no_effect_if_sigma_equals_gamma(scale):
    rng = np.random.default_rng(4)
    H = [
        tp.hybrid_matrix(
            random_axis(np.random.default_rng(4), sigma=scale, gamma=scale, mass_error=error), S
        )
        for error in rng.uniform(-1, 1, 5)
    ]
    np.testing.assert_allclose(H[1:], np.broadcast_to(H[0], (4, *H[0].shape)), rtol=1e-12)


def test_overestimated_mass_is_displayed_as_negative_mass():
    axis = random_axis(np.random.default_rng(5), sigma=0.0, gamma=1.0, delay=0.0, mass_error=0.3)
    values = {**axis.__dict__, "ideal_servo": True}
    free = tp.transmitted_impedance(tp.hybrid_matrix(OneAxis(**values), S), 0.0)
    exact = tp.hybrid_matrix(OneAxis(**{**values, "mass_error": 0.0}), S)[..., 0, 0]
    felt_mass = (free - exact).imag / OMEGA
    np.testing.assert_allclose(felt_mass, -axis.force_scale * axis.position_scale * 0.3, rtol=1e-9)


def test_parameters_may_be_arrays():
    delay = np.array([0.0, 0.05, 0.2])
    together = tp.hybrid_matrix(OneAxis(delay=delay, sigma=0.5), S[:, None])
    for i, one in enumerate(delay):
        assert np.array_equal(together[:, i], tp.hybrid_matrix(OneAxis(delay=one, sigma=0.5), S))


def random_two_ports(n: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.normal(size=(n, 2, 2)) + 1j * rng.normal(size=(n, 2, 2))


def test_absorbed_impedances_replace_hand_and_environment():
    H = random_two_ports(200)
    hand, here, there = 0.3 + 0.1j, 1.1 - 0.4j, 0.6 + 2j
    whole = tp.transmitted_impedance(H, here + there) + hand
    inside = tp.absorb_impedances(H, hand=hand, environment=here)
    np.testing.assert_allclose(tp.transmitted_impedance(inside, there), whole, rtol=1e-9)


def test_ideal_station_has_no_reflections_at_the_reference_impedances():
    axis = OneAxis(force_scale=0.1, position_scale=3.0, hand_damping=8.0)
    ideal = tp.two_port_matrix(0.0, axis.force_scale, -axis.position_scale, 0.0)
    S = tp.scattering_matrix(ideal, tp.reference_impedances(axis))
    np.testing.assert_allclose([S[0, 0], S[1, 1]], 0.0, atol=1e-15)


def test_scattering_relates_the_waves():
    H = random_two_ports(200)
    V_m, F_e = np.random.default_rng(8).normal(size=(2, 200)) + 0.3j
    F_h, minus_V_s = np.einsum("nij,jn->in", H, np.array([V_m, F_e]))
    b1, b2 = 2.5, 0.4
    waves_in = [(F_h + b1 * V_m) / np.sqrt(b1), (F_e + b2 * minus_V_s) / np.sqrt(b2)]
    waves_out = [(F_h - b1 * V_m) / np.sqrt(b1), (F_e - b2 * minus_V_s) / np.sqrt(b2)]
    found = np.einsum("nij,jn->in", tp.scattering_matrix(H, (b1, b2)), np.array(waves_in))
    np.testing.assert_allclose(found, waves_out, rtol=1e-9, atol=1e-12)


def test_scales_and_ratio_of_powers_must_be_positive():
    with pytest.raises(DrakeTeleopError, match=r"OneAxis\.position_scale: is 0"):
        tp.reference_impedances(OneAxis(position_scale=0.0))
    for name in ("position_scale", "force_scale"):
        with pytest.raises(DrakeTeleopError, match=rf"OneAxis\.{name}: is 0"):
            tp.power_scaled_matrices(tp.hybrid_matrix(OneAxis(), S), OneAxis(**{name: 0.0}))
    with pytest.raises(DrakeTeleopError, match="ratio: 0, "):
        tp.scale_slave_power(tp.hybrid_matrix(OneAxis(), S), 0.0)
