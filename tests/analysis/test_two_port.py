"""Two-ports against the block diagram, solved numerically at each frequency."""

from __future__ import annotations

import control
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
    H, truth = tp.hybrid(axis, S[::20]), solved_matrix(axis, S[::20])
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
    H = tp.hybrid(axis, S[::20], servo=(C / (Z_s + C), 1 / (Z_s + C)))
    np.testing.assert_allclose(H, solved_matrix(axis, S[::20], (m, k, d, 0.0)), rtol=1e-9)


def test_ideal_servo_without_delay_displays_scaled_environment_and_tool():
    axis = random_axis(np.random.default_rng(2), delay=0.0, mass_error=0.0, ideal_servo=True)
    Z_e = 40.0 + 5100.0 / S
    felt = tp.transmitted_impedance(tp.hybrid(axis, S), Z_e)
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
    stiff = tp.hybrid(OneAxis(**values), slow)
    ideal = tp.hybrid(OneAxis(**{**values, "ideal_servo": True}), slow)
    np.testing.assert_allclose(stiff[..., 0, :], ideal[..., 0, :], rtol=1e-6)


@pytest.mark.parametrize("scale", [0.3, 1.0, 1.7])
def test_estimate_has_no_effect_if_sigma_equals_gamma(scale):
    rng = np.random.default_rng(4)
    H = [
        tp.hybrid(
            random_axis(np.random.default_rng(4), sigma=scale, gamma=scale, mass_error=error), S
        )
        for error in rng.uniform(-1, 1, 5)
    ]
    np.testing.assert_allclose(H[1:], np.broadcast_to(H[0], (4, *H[0].shape)), rtol=1e-12)


def test_overestimated_mass_is_displayed_as_negative_mass():
    axis = random_axis(np.random.default_rng(5), sigma=0.0, gamma=1.0, delay=0.0, mass_error=0.3)
    values = {**axis.__dict__, "ideal_servo": True}
    free = tp.transmitted_impedance(tp.hybrid(OneAxis(**values), S), 0.0)
    exact = tp.hybrid(OneAxis(**{**values, "mass_error": 0.0}), S)[..., 0, 0]
    felt_mass = (free - exact).imag / OMEGA
    np.testing.assert_allclose(felt_mass, -axis.force_scale * axis.position_scale * 0.3, rtol=1e-9)


def test_parameters_may_be_arrays():
    delay = np.array([0.0, 0.05, 0.2])
    together = tp.hybrid(OneAxis(delay=delay, sigma=0.5), S[:, None])
    for i, one in enumerate(delay):
        assert np.array_equal(together[:, i], tp.hybrid(OneAxis(delay=one, sigma=0.5), S))


def hybrid_of_chain(A: np.ndarray) -> np.ndarray:
    a11, a12, a21, a22 = tp.entries(A)
    return tp.two_port(a12 / a22, a11 - a12 * a21 / a22, -1 / a22, a21 / a22)


def test_wave_line_delays_the_waves():
    b, delay = 3.7, 0.023
    for s, H in zip(S[::20], tp.wave_line(S, delay, b)[::20], strict=True):
        late = np.exp(-s * delay)
        # Unknown F_h, V_s given V_m, F_e: u_s = late u_m and w_m = late w_s.
        columns = []
        for v_m, f_e in np.eye(2):
            A = np.array([[late, -b], [1, late * b]])
            rhs = np.array([f_e - late * b * v_m, b * v_m + late * f_e])
            F_h, V_s = np.linalg.solve(A, rhs)
            columns.append([F_h, -V_s])
        truth = np.array(columns).T
        np.testing.assert_allclose(H, truth, rtol=1e-9, atol=1e-9)


def test_impedance_displayed_through_a_wave_line():
    b, delay = 3.7, 0.01
    s = S + 0.3  # Off the imaginary axis, which has poles of tanh and coth.
    H = tp.wave_line(s, delay, b)
    np.testing.assert_allclose(tp.transmitted_impedance(H, b), b, rtol=1e-12)
    np.testing.assert_allclose(tp.transmitted_impedance(H, 0.0), b * np.tanh(s * delay), rtol=1e-12)
    rigid = tp.impedance(H)[..., 0, 0]
    np.testing.assert_allclose(rigid, b / np.tanh(s * delay), rtol=1e-11)
    slow = 1e-3j
    free, hard = (
        tp.transmitted_impedance(tp.wave_line(np.array([slow]), delay, b), z) for z in (0, 1e15)
    )
    assert free[0].imag / 1e-3 == pytest.approx(b * delay, rel=1e-9)
    assert -hard[0].imag * 1e-3 == pytest.approx(b / delay, rel=1e-9)


def test_transparent_channels_are_ideal_without_delay():
    rng = np.random.default_rng(6)
    for c5, c6 in rng.uniform(-0.9, 2.0, (10, 2)):
        m, k, d = rng.uniform(0.1, 5.0), rng.uniform(10.0, 1e4), rng.uniform(1.0, 300.0)
        master, slave = m * S + d + k / S, 3 * m * S + 2 * d + k / S
        H = tp.four_channel(S, master, slave, tp.transparent_channels(master, slave, c5, c6))
        np.testing.assert_allclose(
            H, np.broadcast_to([[0, 1], [-1, 0]], H.shape), rtol=0, atol=1e-12
        )
        Z_e = 20 + 3000 / S
        np.testing.assert_allclose(tp.transmitted_impedance(H, Z_e), Z_e, rtol=1e-11)


def test_four_channel_equals_its_block_diagram():
    rng = np.random.default_rng(7)
    for s in S[::25]:
        c = rng.normal(size=6) + 1j * rng.normal(size=6)
        master, slave = rng.normal(size=2) + 1j * rng.normal(size=2)
        late = np.exp(-s * 0.013)
        columns = []
        for v_m, f_e in np.eye(2):
            A = [[1 + c[5], -c[3] * late], [-c[2] * late, slave]]
            rhs = [master * v_m + c[1] * late * f_e, c[0] * late * v_m - (1 + c[4]) * f_e]
            F_h, V_s = np.linalg.solve(A, rhs)
            columns.append([F_h, -V_s])
        H = tp.four_channel(s, master, slave, tp.Channels(*c), 0.013)
        np.testing.assert_allclose(H, np.array(columns).T, rtol=1e-9)


def random_two_ports(n: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.normal(size=(n, 2, 2)) + 1j * rng.normal(size=(n, 2, 2))


def test_conversions_relate_the_same_forces_and_velocities():
    H = random_two_ports(200)
    V_m, F_e = np.random.default_rng(8).normal(size=(2, 200)) + 0.3j
    F_h, minus_V_s = np.einsum("nij,jn->in", H, np.array([V_m, F_e]))

    def applied(matrix, x, y):
        return np.einsum("nij,jn->in", matrix, np.array([x, y]))

    np.testing.assert_allclose(applied(tp.impedance(H), V_m, minus_V_s), [F_h, F_e], rtol=1e-9)
    np.testing.assert_allclose(applied(tp.admittance(H), F_h, F_e), [V_m, minus_V_s], rtol=1e-9)
    np.testing.assert_allclose(applied(tp.chain(H), F_e, -minus_V_s), [F_h, V_m], rtol=1e-9)
    b1, b2 = 2.5, 0.4
    waves_in = [(F_h + b1 * V_m) / np.sqrt(b1), (F_e + b2 * minus_V_s) / np.sqrt(b2)]
    waves_out = [(F_h - b1 * V_m) / np.sqrt(b1), (F_e - b2 * minus_V_s) / np.sqrt(b2)]
    np.testing.assert_allclose(
        applied(tp.scattering(H, (b1, b2)), *waves_in), waves_out, rtol=1e-9, atol=1e-12
    )
    for there, back in (
        (tp.impedance, tp.impedance),
        (tp.admittance, tp.admittance),
        (tp.chain, hybrid_of_chain),
    ):
        np.testing.assert_allclose(back(there(H)), H, rtol=1e-9)


def test_absorbed_impedances_replace_hand_and_environment():
    H = random_two_ports(200)
    hand, here, there = 0.3 + 0.1j, 1.1 - 0.4j, 0.6 + 2j
    whole = tp.transmitted_impedance(H, here + there) + hand
    inside = tp.absorb(H, hand=hand, environment=here)
    np.testing.assert_allclose(tp.transmitted_impedance(inside, there), whole, rtol=1e-9)
    # The chain of device and delay line.
    line, device = tp.wave_line(S, 0.01, 2.0), tp.two_port(0.15 * S + 0.5, 1.0, -1.0, 0.0)
    chained = hybrid_of_chain(tp.chain(device) @ tp.chain(line))
    np.testing.assert_allclose(chained, tp.absorb(line, hand=0.15 * S + 0.5), rtol=1e-9, atol=1e-9)


def test_control_objects_have_the_same_response():
    axis = random_axis(np.random.default_rng(9), delay=0.0)
    H = tp.hybrid(axis, S)
    for one in (axis, OneAxis(**{**axis.__dict__, "ideal_servo": True})):
        G = tp.transfer_function(one)
        assert isinstance(G, control.TransferFunction)
        np.testing.assert_allclose(tp.from_control(G, OMEGA), tp.hybrid(one, S), rtol=1e-9)
    frd = tp.to_frd(H, OMEGA)
    assert np.array_equal(tp.from_control(frd), H)
    assert np.array_equal(tp.from_control(tp.to_frd(H[:, 0, 0], OMEGA)), H[:, 0, 0])
    backward = control.tf([1, -1], [1e-3, 0], 1e-3)  # (z - 1) / (z T)
    z = np.exp(1e-3 * S)
    np.testing.assert_allclose(tp.from_control(backward, OMEGA), (z - 1) / (1e-3 * z), rtol=1e-9)
    servo = control.ss(tp.transfer_function(axis)[1, 1])
    np.testing.assert_allclose(tp.from_control(servo, OMEGA), H[:, 1, 1], rtol=1e-9)


def test_invalid_input_raises():
    ideal = tp.hybrid(OneAxis(ideal_servo=True), S)
    with pytest.raises(DrakeTeleopError, match="impedance matrix where h22"):
        tp.impedance(ideal)
    with pytest.raises(DrakeTeleopError, match="ratio"):
        tp.power_scaled(ideal, 0.0)
    with pytest.raises(DrakeTeleopError, match="omega"):
        tp.from_control(control.tf([1], [1, 1]))
