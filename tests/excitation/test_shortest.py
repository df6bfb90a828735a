"""Shortest motion for a tolerance of the load."""

from __future__ import annotations

import numpy as np
import pytest

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.lab.excitation import shortest as module
from drake_teleop.lab.excitation.excite import trajectory_sensor_motion
from drake_teleop.lab.excitation.prediction import predicted_covariance
from drake_teleop.lab.excitation.robot import Robot, RobotFromScenario
from drake_teleop.lab.excitation.shortest import (
    ShortestMotionProblem,
    design_shortest_motion,
    sidak_factor,
)
from drake_teleop.load.tolerance import (
    derivatives_over_tolerances,
    deviations_over_tolerances,
    parse_tolerance,
)
from drake_teleop.station.scenario import LoadScenario

ASKED = parse_tolerance("mass 0.1 %, com 0.1 mm, inertia 1 %")


@pytest.fixture(scope="module")
def slave() -> Robot:
    return RobotFromScenario(LoadScenario("identification"))


def problem_of(slave: Robot, times: float = 1.0) -> ShortestMotionProblem:
    errors = times * derivatives_over_tolerances(ASKED, slave.limits.heaviest_phi)
    return ShortestMotionProblem(slave, 3, errors, None)


def test_reliable_factor_grows_with_the_number_of_tolerances() -> None:
    assert sidak_factor(1) == pytest.approx(1.96, abs=0.001)
    assert pytest.approx(0.95, abs=1e-3) == (1 - 2 * 0.0025573) ** 10
    assert sidak_factor(10) == pytest.approx(2.7996, abs=1e-3)


def test_gradients_equal_finite_differences(slave: Robot) -> None:
    problem, rng = problem_of(slave), np.random.default_rng(0)
    x = problem.candidate(rng, near_home=True)
    x[-1] = np.log(1.2)
    at = problem.evaluate(x, 2.0, 100.0)
    for step in (1e-6 * rng.normal(size=len(x)), np.append(np.zeros(len(x) - 1), 1e-6)):
        up, down = (problem.evaluate(x + sign * step, 2.0, 100.0) for sign in (1, -1))
        differences = [
            up.log_criterion - down.log_criterion,
            *(up.smooth_limit_uses - down.smooth_limit_uses),
        ]
        np.testing.assert_allclose(differences, 2 * at.gradients @ step, rtol=1e-4, atol=1e-11)


def test_tolerance_use_follows_from_white_noise_over_the_period(slave: Robot) -> None:
    problem = problem_of(slave)
    x = problem.candidate(np.random.default_rng(1), near_home=True)
    x[-1] = np.log(2.0)
    at = problem.evaluate(x, 200.0, 100.0)
    motion = tuple(problem._vectors.copy())
    worst = problem.deviations(motion, 2.0).max()
    assert np.exp(2 * (at.smooth_limit_uses[0] - 1)) == pytest.approx(worst, rel=0.01)
    assert problem.deviations(motion, 8.0).max() == pytest.approx(worst / 2, rel=1e-6)


@pytest.mark.slow
def test_shortest_motion_reaches_the_tolerance_within_all_limits(
    slave: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_MAX_ROUNDS_WITHOUT_PROGRESS", 0)
    found = design_shortest_motion(
        slave, parse_tolerance("mass 0.5 %, com 0.5 mm, inertia 5 %"), starts=1
    )
    assert 3 / 15.0 <= found.excitation.trajectory.period < 0.5
    assert 0.3 < found.errors_over_tolerances.max() <= 1.0
    assert all(use.used_share <= 1.0 for use in found.excitation.limit_uses)


def test_search_noise_is_close_to_the_prediction(slave: Robot) -> None:
    """Noise of the accelerometer would make the factor 2 to 5."""
    problem, errors = (
        problem_of(slave),
        derivatives_over_tolerances(ASKED, slave.limits.heaviest_phi),
    )
    x = problem.candidate(np.random.default_rng(2), near_home=True)
    x[-1] = np.log(1.2)
    motion = trajectory_sensor_motion(slave, problem.trajectory(x))
    covariance = predicted_covariance(*motion, 1e-3, slave.sensor_noise, slave.limits.heaviest_phi)
    known = problem.deviations(motion, 1.2)
    np.testing.assert_allclose(known, deviations_over_tolerances(errors, covariance), rtol=0.03)


def test_unreachable_tolerance_is_an_error(slave: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_MAX_INFEASIBLE_ROUNDS", 1)
    with pytest.raises(DrakeTeleopError, match="no motion within the limits"):
        design_shortest_motion(slave, parse_tolerance("inertia 0.00001 %"), starts=1)
