"""Fourier trajectories, condition numbers, and the design on an RX90 written down once more."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from drake_teleop.errors import DrakeTeleopError
from drake_teleop.load.excitation import (
    ExcitationLimits,
    FourierTrajectory,
    condition_numbers,
    design_excitation,
    limit_use,
)
from drake_teleop.load.regressor import regressor

GRAVITY = np.array([0.0, 0.0, -9.81])
# The heaviest load of the tests: 4 kg, 85 mm out, gyration radius about 60 mm.
COM = np.array([0.004, -0.003, 0.085])
INERTIA = np.diag([0.014, 0.0135, 0.006]) + 4.0 * (COM @ COM * np.eye(3) - np.outer(COM, COM))
PHI = np.array([4.0, *(4.0 * COM), *INERTIA[np.triu_indices(3)]])
HOME = np.array([0.0, 1.0, -2.83, 0.0, -1.0, 0.0])


def sensor_motion(q, qd, qdd):
    """The RX90 (modified DH of hardware.md) link by link in W; flange 85 mm from the wrist."""
    twist, along, offset = (
        np.radians([0, 90, 0, -90, 90, -90]),
        [0, 0, 0.45, 0, 0, 0],
        [0.42] + 5 * [0],
    )
    offset[3] = 0.45
    R = np.tile(np.eye(3), (len(q), 1, 1))
    p, omega, alpha, a = np.zeros((4, len(q), 3))
    a = a - GRAVITY

    def move(p, a, r):
        r = R @ r
        return p + r, a + np.cross(alpha, r) + np.cross(omega, np.cross(omega, r))

    for j in range(6):
        sin, cos = np.sin(twist[j]), np.cos(twist[j])
        p, a = move(p, a, np.array([along[j], -sin * offset[j], cos * offset[j]]))
        s, c, o = np.sin(q[:, j]), np.cos(q[:, j]), np.zeros(len(q))
        R = R @ np.stack(
            [c, -s, o, cos * s, cos * c, o - sin, sin * s, sin * c, o + cos], axis=1
        ).reshape(-1, 3, 3)
        z = R[:, :, 2]
        alpha = alpha + z * qdd[:, j : j + 1] + np.cross(omega, z * qd[:, j : j + 1])
        omega = omega + z * qd[:, j : j + 1]
    p, a = move(p, a, np.array([0.0, 0.0, 0.085]))
    return *(np.einsum("tji,tj->ti", R, v) for v in (a, omega, alpha)), p, R


@pytest.fixture(scope="module")
def limits() -> ExcitationLimits:
    zero = np.radians([0, 90, -90, 0, 0, 0])
    return ExcitationLimits(
        q_lower=0.8 * np.radians([-160, -137.5, -142.5, -270, -105, -270]) + zero,
        q_upper=0.8 * np.radians([160, 137.5, 142.5, 270, 120, 270]) + zero,
        velocity=0.8 * np.radians([236, 200, 286, 401, 320, 580]),
        acceleration=np.array([8.0, 10.0, 12.0, 20.0, 25.0, 30.0]),
        phi=PHI,
        force=180.0,
        torque=10.0,
        points_S=np.array([[0.0, 0.0, -0.085], [0.0, 0.0, 0.2]]),
        box_W=np.array([[0.25, -0.7, 0.1], [1.05, 0.7, 1.3]]),
    )


@pytest.fixture(scope="module")
def designed(limits) -> FourierTrajectory:
    return design_excitation(sensor_motion, limits, home=HOME, seed=1)


def random_trajectory(seed: int = 0) -> FourierTrajectory:
    rng = np.random.default_rng(seed)
    sine, cosine = rng.standard_normal((2, 6, 4))
    return FourierTrajectory.at_rest(rng.standard_normal(6), sine, cosine, 1 / 6)


def test_position_is_equation_9_and_10():
    rng = np.random.default_rng(1)
    q0, rho, delta = rng.standard_normal(2), *rng.standard_normal((2, 2, 3))
    t, f = 0.37, 0.4
    expected = [
        q0[i]
        + sum(
            rho[i, k - 1] * np.sin(2 * np.pi * k * f * t)
            + delta[i, k - 1] * np.cos(2 * np.pi * k * f * t)
            for k in (1, 2, 3)
        )
        for i in (0, 1)
    ]
    trajectory = FourierTrajectory(q0, rho, delta, f)
    np.testing.assert_allclose(trajectory.evaluate(t)[0], expected, rtol=0, atol=1e-14)
    assert trajectory.period == 2.5
    np.testing.assert_array_equal(trajectory.evaluate([t, 0.0])[1][0], trajectory.evaluate(t)[1])


def test_it_starts_and_ends_at_rest_and_moves_in_between():
    trajectory = random_trajectory()
    q, qd, qdd = trajectory.evaluate(np.array([0.0, trajectory.period / 3, trajectory.period]))
    np.testing.assert_allclose(qd[[0, 2]], 0, atol=1e-12)
    np.testing.assert_allclose(qdd[[0, 2]], 0, atol=1e-12)
    np.testing.assert_allclose(q[0], trajectory.q0 + trajectory.delta.sum(axis=1), atol=1e-12)
    np.testing.assert_allclose(q[2], q[0], atol=1e-12)
    assert np.abs(qd[1]).max() > 1


def test_elimination_leaves_all_other_freedom():
    """Every trajectory at rest is reached: 2 (N - 1) independent motions of each joint."""
    unit = np.eye(8)
    trajectory = FourierTrajectory.at_rest(np.zeros(8), unit[:, :4], unit[:, 4:], 1.0)
    assert np.linalg.matrix_rank(np.hstack([trajectory.rho, trajectory.delta])) == 8


def test_derivatives_agree_with_finite_differences():
    trajectory, step = random_trajectory(), 1e-5
    t = np.linspace(0, trajectory.period, 50)
    _, qd, qdd = trajectory.evaluate(t)
    ahead, behind = trajectory.evaluate(t + step), trajectory.evaluate(t - step)
    np.testing.assert_allclose((ahead[0] - behind[0]) / (2 * step), qd, atol=1e-7)
    np.testing.assert_allclose((ahead[1] - behind[1]) / (2 * step), qdd, atol=1e-7)


def test_condition_numbers_are_what_their_docstring_says():
    rng = np.random.default_rng(2)
    motion = rng.standard_normal((3, 300, 3)) * np.array([10.0, 2.0, 30.0])[:, None, None]
    V = regressor(*motion)
    rows = np.array(3 * [0.3] + 3 * [0.02])
    columns = np.array([1.0] + 3 * [0.07] + 6 * [0.07**2])
    whitened = V / rows[:, None] * columns
    kappa = condition_numbers(*motion, noise=(0.3, 0.02), length=0.07)
    assert kappa.kappa10 == pytest.approx(np.linalg.cond(V.reshape(-1, 10)), rel=1e-9)
    assert kappa.kappa_w10 == pytest.approx(np.linalg.cond(whitened.reshape(-1, 10)), rel=1e-9)


def test_long_records_are_taken_in_chunks():
    rng = np.random.default_rng(3)
    motion = rng.standard_normal((3, 700, 3))
    repeated = np.tile(motion, (1, 60, 1))
    np.testing.assert_allclose(condition_numbers(*repeated), condition_numbers(*motion), rtol=1e-9)


def test_the_floor_of_kappa10_is_reached_and_never_passed():
    """sqrt(8/3) for any motion; reached by isotropic, uncorrelated s and alpha, alpha^2 = 3 s^2."""
    axes = np.vstack([np.eye(3), -np.eye(3)])
    s = np.repeat(axes, 6, axis=0)
    alpha = np.sqrt(3) * np.tile(axes, (6, 1))
    at_best = condition_numbers(s, 0 * s, alpha)
    assert at_best.kappa10 == pytest.approx(np.sqrt(8 / 3), rel=1e-12)
    rng = np.random.default_rng(4)
    for scale in (0.1, 1.0, 10.0):
        omega = scale * rng.standard_normal(s.shape)
        assert condition_numbers(s, omega, alpha).kappa10 > np.sqrt(8 / 3)


def test_a_motion_that_determines_too_little_has_no_finite_condition_number():
    s = np.random.default_rng(5).standard_normal((50, 3))
    assert condition_numbers(s, 0 * s, 0 * s) == (np.inf, np.inf)


def test_limit_use_names_what_is_violated(limits):
    t = np.linspace(0, 6, 200)
    still = FourierTrajectory(HOME, np.zeros((6, 1)), np.zeros((6, 1)), 1 / 6)
    use = limit_use(still, sensor_motion, limits)
    assert use["velocity"] == use["acceleration"] == 0
    assert use["force"] == pytest.approx(4 * 9.81 / 180, rel=1e-12)
    swing = dataclasses.replace(still, rho=np.array([[0.9], *5 * [[0.0]]]))
    q = swing.evaluate(t)[0]
    use = limit_use(swing, sensor_motion, limits)
    assert use["velocity"] == pytest.approx(0.9 * 2 * np.pi / 6 / limits.velocity[0], rel=1e-6)
    assert use["position"] == pytest.approx(
        (
            2
            * np.abs(q - (limits.q_upper + limits.q_lower) / 2)
            / (limits.q_upper - limits.q_lower)
        ).max(),
        rel=1e-3,
    )
    narrow = dataclasses.replace(limits, box_W=np.array([[0.25, -0.1, 0.1], [1.05, 0.1, 1.3]]))
    assert limit_use(swing, sensor_motion, limits)["box"] < 1
    assert limit_use(swing, sensor_motion, narrow)["box"] > 1


def test_the_design_respects_every_limit_on_a_grid_of_its_own(designed, limits):
    q, qd, qdd = designed.evaluate(np.linspace(0, designed.period, 4999))
    s, omega, alpha, p_WS, R_WS = sensor_motion(q, qd, qdd)
    assert (q > limits.q_lower).all() and (q < limits.q_upper).all()
    assert (np.abs(qd) < limits.velocity).all()
    assert (np.abs(qdd) < limits.acceleration).all()
    f = 4.0 * (s + np.cross(alpha, COM) + np.cross(omega, np.cross(omega, COM)))
    assert np.linalg.norm(f, axis=1).max() < limits.force
    for point in limits.points_S:
        p = p_WS + R_WS @ point
        assert (p > limits.box_W[0]).all() and (p < limits.box_W[1]).all()


def test_the_design_is_at_rest_and_well_conditioned(designed):
    _, qd, qdd = designed.evaluate(np.array([0.0, designed.period]))
    np.testing.assert_allclose([qd, qdd], 0, atol=1e-12)
    motion = sensor_motion(*designed.evaluate(np.arange(0, 6, 1e-3)))
    kappa = condition_numbers(*motion[:3])
    assert kappa.kappa_w10 < 8
    assert kappa.kappa10 > np.sqrt(8 / 3)


def test_an_infeasible_design_is_never_returned(limits):
    cell = dataclasses.replace(limits, box_W=np.array([[0.6, -0.01, 0.5], [0.62, 0.01, 0.52]]))
    with pytest.raises(DrakeTeleopError, match=r"the best uses [0-9.]+% of its box"):
        design_excitation(sensor_motion, cell, home=HOME, seed=0, harmonics=2)


def test_same_seed_same_trajectory_other_seed_another(limits):
    first, again, other = (
        design_excitation(sensor_motion, limits, home=HOME, seed=seed, harmonics=2)
        for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(first.rho, again.rho)
    assert not np.allclose(first.rho, other.rho, atol=1e-3)
