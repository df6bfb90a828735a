"""Fourier trajectories: Eqs. (9)-(10), rest at both ends, files."""

from __future__ import annotations

import numpy as np
import pytest

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.trajectory import FourierTrajectory


def random_trajectory(seed: int = 0) -> FourierTrajectory:
    rng = np.random.default_rng(seed)
    sine, cosine = rng.standard_normal((2, 6, 4))
    return FourierTrajectory.rest_to_rest(rng.standard_normal(6), sine, cosine, 1 / 6)


def test_position_equals_equations_9_and_10():
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


def test_trajectory_starts_and_ends_at_rest():
    trajectory = random_trajectory()
    q, qd, qdd = trajectory.evaluate(np.array([0.0, trajectory.period / 3, trajectory.period]))
    np.testing.assert_allclose(qd[[0, 2]], 0, atol=1e-12)
    np.testing.assert_allclose(qdd[[0, 2]], 0, atol=1e-12)
    np.testing.assert_allclose(q[0], trajectory.q0 + trajectory.delta.sum(axis=1), atol=1e-12)
    np.testing.assert_allclose(q[2], q[0], atol=1e-12)
    assert np.abs(qd[1]).max() > 1


def test_rest_constraints_keep_all_other_freedom():
    """Every trajectory at rest can be reached: 2 (N - 1) independent motions of each joint."""
    unit = np.eye(8)
    trajectory = FourierTrajectory.rest_to_rest(np.zeros(8), unit[:, :4], unit[:, 4:], 1.0)
    assert np.linalg.matrix_rank(np.hstack([trajectory.rho, trajectory.delta])) == 8


def test_derivatives_agree_with_finite_differences():
    trajectory, step = random_trajectory(), 1e-5
    t = np.linspace(0, trajectory.period, 50)
    _, qd, qdd = trajectory.evaluate(t)
    ahead, behind = trajectory.evaluate(t + step), trajectory.evaluate(t - step)
    np.testing.assert_allclose((ahead[0] - behind[0]) / (2 * step), qd, atol=1e-7)
    np.testing.assert_allclose((ahead[1] - behind[1]) / (2 * step), qdd, atol=1e-7)


def test_saved_trajectory_is_loaded_unchanged(tmp_path):
    trajectory = random_trajectory(3)
    trajectory.save(tmp_path / "e.yaml", tuple("abcdef"))
    again = FourierTrajectory.load(tmp_path / "e.yaml")
    for name in ("q0", "rho", "delta", "frequency"):
        np.testing.assert_array_equal(getattr(again, name), getattr(trajectory, name))


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[1, 2]",
        "{frequency: 1}",
        "{frequency: 1, joints: {a: {q0: 0, rho: [1, 2]}}}",
        "{frequency: 1, joints: {a: {q0: 0, rho: [1, 2], delta: [1]}}}",
        "{frequency: 1, joints: {a: {q0: 0, rho: [1], delta: [.nan]}}}",
        "{frequency: fast, joints: {a: {q0: 0, rho: [1], delta: [1]}}}",
        "{frequency: 1, joints: {}}",
        "{",
    ],
)
def test_invalid_trajectory_file_is_one_error(tmp_path, text):
    path = tmp_path / "e.yaml"
    path.write_text(text)
    with pytest.raises(DrakeTeleopError, match=r"e\.yaml: "):
        FourierTrajectory.load(path)


@pytest.mark.parametrize(
    ("numbers", "said"),
    [
        ("frequency: 0, joints: {a: {q0: 0, rho: [1], delta: [1]}}", r"e\.yaml:frequency: 0 Hz is"),
        ("frequency: 1, joints: {a: {q0: .nan, rho: [1], delta: [1]}}", r"e\.yaml: contains nan,"),
        ("frequency: 1, joints: {a: {q0: 0, rho: [1], delta: [1, 2]}}", r"\(1, 1\) and \(1, 2\)"),
    ],
)
def test_error_of_trajectory_file_contains_the_wrong_value(tmp_path, numbers, said):
    path = tmp_path / "e.yaml"
    path.write_text(f"{{{numbers}}}")
    with pytest.raises(DrakeTeleopError, match=said):
        FourierTrajectory.load(path)
