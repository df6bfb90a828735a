"""Criteria and limits: documented values, and gradients against finite differences."""

from __future__ import annotations

from itertools import count
from types import SimpleNamespace

import numpy as np
import pytest
from pydrake.systems.framework import DiagramBuilder

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.lab.excitation.criteria import (
    CRITERIA,
    Criterion,
    CriterionScales,
    limited_gyration_radius,
)
from drake_teleop.lab.excitation.limits import (
    CLEARANCE_USE_RANGE_M,
    LIMIT_NAMES,
    Limits,
    capsule_distances,
    link_motion_series,
    max_limit_uses_into,
)
from drake_teleop.lab.excitation.optimizer import DesignProblem, _DescentSearch
from drake_teleop.lab.excitation.prediction import (
    SensorNoise,
    _motion_error_transfer_function,
    predicted_deviations,
)
from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.load.regressor import regressor
from drake_teleop.station.sensor.motion_estimation import MotionEstimationConfig, fusion_gains
from drake_teleop.station.sensor.sensor_chain import WristSensorConfig
from drake_teleop.station.slave.arm import IS_PRISMATIC_COLUMN
from drake_teleop.station.slave.plant import AddSlavePlant
from drake_teleop.station.slave.slave_config import Slave

PHI = phi_from_mass_com_inertia(3.0, [0.01, -0.02, 0.08], np.diag([0.012, 0.0115, 0.0045]))
SCALES = CriterionScales((0.3, 0.02), 0.07, PHI)


def motion(samples: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.standard_normal((3, samples, 3)) * np.array([10.0, 2.0, 30.0])[:, None, None]


def value(name: str, samples: np.ndarray, duration: float = 1.0) -> float:
    return Criterion(name, SCALES).value(*samples, duration)


def test_condition_numbers_match_their_definition():
    samples = motion(300)
    V = regressor(*samples)
    rows = np.array(3 * [0.3] + 3 * [0.02])
    columns = np.array([1.0] + 3 * [0.07] + 6 * [0.07**2])
    whitened = (V / rows[:, None] * columns).reshape(-1, 10)
    with_offsets = np.concatenate([np.tile(np.eye(6), (300, 1, 1)), V], axis=2).reshape(-1, 16)
    assert value("kappa_w10", samples) == pytest.approx(np.linalg.cond(whitened), rel=1e-9)
    assert value("kappa10", samples) == pytest.approx(np.linalg.cond(V.reshape(-1, 10)), rel=1e-9)
    assert value("kappa16", samples) == pytest.approx(np.linalg.cond(with_offsets), rel=1e-7)


def test_kappa10_reaches_its_lower_bound():
    """The bound sqrt(8/3) needs isotropic, uncorrelated s and alpha with alpha^2 = 3 s^2."""
    axes = np.vstack([np.eye(3), -np.eye(3)])
    s = np.repeat(axes, 6, axis=0)
    alpha = np.sqrt(3) * np.tile(axes, (6, 1))
    assert value("kappa10", (s, 0 * s, alpha)) == pytest.approx(np.sqrt(8 / 3), rel=1e-12)
    rng = np.random.default_rng(4)
    for scale in (0.1, 1.0, 10.0):
        omega = scale * rng.standard_normal(s.shape)
        assert value("kappa10", (s, omega, alpha)) > np.sqrt(8 / 3)


@pytest.mark.parametrize("name", CRITERIA)
def test_singular_motion_has_infinite_criteria(name):
    s = np.random.default_rng(5).standard_normal((50, 3))
    assert value(name, (s, 0 * s, 0 * s)) == np.inf


def test_unknown_criterion_error_lists_the_known_ones():
    with pytest.raises(DrakeTeleopError, match="kappa_w10, kappa10"):
        Criterion("kappa11", SCALES)


def test_predicted_deviations_are_those_of_white_noise():
    """Scatter of weighted least squares over 400 draws; A16 and D16 from the same covariance."""
    samples = motion(200, seed=2)
    sigma = np.repeat(SCALES.wrench_noise, 3)
    rows = np.concatenate([np.tile(np.eye(6), (200, 1, 1)), regressor(*samples)], axis=2)
    whitened = (rows / sigma[:, None]).reshape(-1, 16)
    errors = np.linalg.pinv(whitened) @ np.random.default_rng(3).standard_normal((1200, 400))
    white = np.concatenate([sigma**2 * 1e-3, np.zeros(6)])
    noise = SensorNoise(sigma, white, np.zeros(12), np.zeros(3), None)
    predicted = predicted_deviations(*samples, 1e-3, noise, PHI)
    np.testing.assert_allclose(errors.std(axis=1), predicted, rtol=0.12)

    inertia = 0.1 * (PHI[4] + PHI[7] + PHI[9]) / 3
    would_do = np.array([*3 * [0.1], *3 * [0.005], 0.03, *3 * [0.003], *6 * [inertia]])
    rms = np.sqrt(np.mean((predicted / would_do)[6:] ** 2))
    assert value("A16", samples, 0.2) == pytest.approx(rms, rel=1e-6)
    covariance = np.linalg.inv(whitened.T @ whitened) / np.outer(would_do, would_do)
    mean_axis = np.exp(np.linalg.slogdet(covariance)[1] / 32)
    assert value("D16", samples, 0.2) == pytest.approx(mean_axis, rel=1e-6)


def test_error_filter_has_the_poles_of_the_motion_filter():
    """One filter step predicts by (1, T, T^2 / 2) and then corrects."""
    T = 1 / 32000  # the filter is then nearly continuous
    for gains in fusion_gains(MotionEstimationConfig("fused"), WristSensorConfig(), 6, T):
        numerator, denominator = _motion_error_transfer_function(gains, T)
        predict = np.array([[1.0, T, T**2 / 2], [0.0, 1.0, T], [0.0, 0.0, 1.0]])
        correct = np.eye(3) - np.outer(gains, [1.0, 0.0, 0.0])
        poles = np.sort_complex(np.log(np.linalg.eigvals(correct @ predict).astype(complex)) / T)
        found = np.sort_complex(np.roots(denominator).astype(complex))
        np.testing.assert_allclose(found, poles, rtol=0.015)
        # High frequencies pass; at zero frequency the encoders replace the accelerometer.
        assert numerator[0] == denominator[0] and numerator[-1] == 0.0


def test_characteristic_length_is_at_most_the_radius_of_gyration():
    assert limited_gyration_radius(PHI) == pytest.approx(0.1, rel=0.05)
    far = phi_from_mass_com_inertia(2.0, [0, 0, 0.3], 0.01 * np.eye(3))
    assert limited_gyration_radius(far) == 0.1
    near = phi_from_mass_com_inertia(2.0, [0, 0, 0], 2.0 * 0.03**2 * np.eye(3) * 2 / 3)
    assert limited_gyration_radius(near) == pytest.approx(0.03)


def limits_of(arm) -> Limits:
    """Return limits near a moderate motion, with three capsules, one of them fixed."""
    middle, half = (arm.lower + arm.upper) / 2, (arm.upper - arm.lower) / 2
    return Limits(
        q_middle=middle,
        q_half=half,
        velocity=arm.velocity_limit,
        acceleration=arm.acceleration_limit,
        max_torques=arm.effort_limit,
        heaviest_phi=arm.phi_load,
        max_sensor_norms=np.array([180.0, 10.0, 50.0, 500.0]),
        points_S=np.array([[0.0, 0.0, -0.085], [0.01, 0.02, 0.2]]),
        box_middle=np.array([0.65, 0.0, 0.7]),
        box_half=np.array([0.4, 0.7, np.inf]),
        capsule_links=np.array([1, 5, -1]),
        capsule_ends=np.array(
            [
                [[0.0, 0.0, -0.12], [0.45, 0.0, -0.12]],
                [[0.0, 0.0, 0.1], [0.0, 0.0, 0.28]],
                [[0.5, 0.1, 0.0], [0.5, 0.1, 0.3]],
            ]
        ),
        capsule_radius=np.array([0.08, 0.04, 0.05]),
        capsule_pairs=np.array([[0, 1], [1, 2]]),
        min_pair_distances=np.array([0.02, -0.01]),
        clearance=0.02,
    )


def problem_of(table, limits, home, name="kappa_w10", period=6.0) -> DesignProblem:
    robot = SimpleNamespace(arm=SimpleNamespace(table=table), limits=limits, home_posture=home)
    return DesignProblem(robot, Criterion(name, SCALES), period, 3)


@pytest.fixture(scope="module")
def arm():
    return AddSlavePlant(DiagramBuilder(), Slave(), None).arm


@pytest.mark.parametrize(
    ("name", "sliding"), [*((name, []) for name in CRITERIA), ("kappa_w10", [0, 3])]
)
def test_gradients_of_criterion_and_limits(arm, name, sliding):
    # Add damping, and make some joints prismatic.
    table = arm.table.copy()
    table[:-1, 23] = 0.5
    table[sliding, IS_PRISMATIC_COLUMN] = 1.0
    home = np.array([0.1, -0.5, -1.8, 0.2, -0.9, 3.0])
    problem = problem_of(table, limits_of(arm), home, name)
    x = problem.candidate(np.random.default_rng(0), near_home=True)
    gradients = problem.evaluate(x, 3.0, 5.0).gradients
    scale = np.abs(gradients).max(axis=1)
    assert np.all(scale > 1e-3), LIMIT_NAMES
    step = 1e-6
    for k, unit in enumerate(np.eye(len(x))):
        ahead, behind = (problem.evaluate(x + sign * step * unit, 3.0, 5.0) for sign in (1, -1))
        of_criterion = ahead.log_criterion - behind.log_criterion
        numeric = np.array(
            [of_criterion, *(ahead.smooth_limit_uses - behind.smooth_limit_uses)]
        ) / (2 * step)
        np.testing.assert_allclose(gradients[:, k] / scale, numeric / scale, rtol=0, atol=2e-5)


def test_largest_use_of_each_limit_matches_its_definition(arm):
    limits, rng = limits_of(arm), np.random.default_rng(3)
    q = np.array([0.1, -0.5, -1.8, 0.2, -0.9, 3.0]) + 0.3 * rng.normal(size=(30, 6))
    qd, qdd = rng.normal(size=(2, 30, 6))
    motions, gradient = link_motion_series(arm.table, q, qd, qdd), np.empty((7, 3, 30, 6))
    smooth, largest = max_limit_uses_into(arm.table, q, qd, qdd, motions, limits, 20.0, gradient)
    assert np.all(smooth >= largest)
    R_WS, p_WS = motions[:, -1, 12:].reshape(-1, 3, 3), motions[:, -1, 9:12]
    points = p_WS[:, None] + np.einsum("tij,kj->tki", R_WS, limits.points_S)
    capsules = (
        limits.capsule_links,
        limits.capsule_ends,
        limits.capsule_radius,
        limits.capsule_pairs,
    )
    distances = capsule_distances(motions, *capsules)
    found = dict(zip(LIMIT_NAMES, largest, strict=True))
    for name, expected in {
        "position": np.abs(q - limits.q_middle) / limits.q_half,
        "velocity": np.abs(qd) / limits.velocity,
        "acceleration": np.abs(qdd) / limits.acceleration,
        "workspace": np.abs(points - limits.box_middle) / limits.box_half,
        "clearance": 1.0 - (distances - limits.min_pair_distances) / CLEARANCE_USE_RANGE_M,
    }.items():
        assert found[name] == pytest.approx(expected.max(), rel=1e-12), name
    # A use of 1 is the minimum distance.
    assert (found["clearance"] > 1.0) == (distances < limits.min_pair_distances).any()


def test_candidates_cover_the_middle_of_the_range(arm):
    limits, rng = limits_of(arm), np.random.default_rng(1)
    home = np.zeros(6)
    problem = problem_of(arm.table, limits, home)
    starts = np.array([problem.candidate(rng, near_home=False)[:6] for _ in range(50)])
    share = np.abs(starts - limits.q_middle) / limits.q_half
    assert np.all(share <= 0.6) and np.all(share.max(axis=0) > 0.5)
    near = np.array([problem.candidate(rng, near_home=True)[:6] for _ in range(50)])
    assert np.abs(near - home).max() < 0.5


def test_candidate_size_grows_with_the_square_of_the_period(arm):
    wide = np.full(6, 1e3)
    limits = limits_of(arm)._replace(q_half=wide, velocity=wide, acceleration=np.ones(6))
    coefficients = []
    for period in (3.0, 6.0):
        problem = problem_of(arm.table, limits, np.zeros(6), period=period)
        rng = np.random.default_rng(2)
        coefficients.append(problem.candidate(rng, near_home=True)[6:])
    np.testing.assert_allclose(coefficients[1], 4.0 * coefficients[0], rtol=1e-12)


def test_the_best_candidates_within_the_limits_are_followed_first():
    numbers = count(-1)  # the search evaluates one in advance
    uses = {0: 1.5, 60: 0.1}
    problem = SimpleNamespace(
        candidate=lambda rng, near_home: np.array([next(numbers)]),
        evaluate=lambda x, *sharpness: SimpleNamespace(
            log_criterion=0.01 * x[0], smooth_limit_uses=np.full(2, uses.get(x[0], 0.9))
        ),
    )
    search = _DescentSearch(problem, 1, None, lambda *_: None)
    followed = search.candidates(np.random.default_rng(0))
    assert [int(next(followed)[0]) for _ in range(8)] == list(range(1, 9))


def test_improving_iterates_are_recorded_with_start_and_evaluations():
    values = iter([3.0, 2.0, 2.5, 1.5])
    problem = SimpleNamespace(
        candidate=lambda rng, near_home: np.zeros(1),
        evaluate=lambda x, *sharpness: SimpleNamespace(largest_limit_use=0.5),
        value=lambda: next(values),
        trajectory=lambda x: int(x[0]),
    )
    search = _DescentSearch(problem, 9, None, lambda *_: None)
    search.start = 7
    for k in range(4):
        search._evaluate_or_reuse_last(np.array([float(k)]), 3.0, 5.0)
    noted = [
        (x.num_evaluations, x.start_index, x.criterion_value, x.trajectory) for x in search.found
    ]
    assert noted == [(1, 7, 3.0, 0), (2, 7, 2.0, 1), (4, 7, 1.5, 3)]


def test_distances_of_capsules():
    """Crossing lines, parallel segments, collinear segments, points."""
    ends = np.array(
        [
            [[-1.0, 0, 0], [1, 0, 0]],
            [[0.0, -1, 0.5], [0, 1, 0.5]],
            [[0.5, 0.3, 0], [2, 0.3, 0]],
            [[2.0, 0, 0], [3, 0, 0]],
            [[0.0, 0, 2], [0, 0, 2]],
            [[0.0, 3, 2], [0, 3, 2]],
        ]
    )
    rows, radii = np.full(6, -1), np.full(6, 0.1)
    pairs = np.array([[0, 1], [0, 2], [0, 3], [0, 4], [4, 5], [3, 4], [4, 3]])
    distances = capsule_distances(np.empty((1, 2, 21)), rows, ends, radii, pairs)[0]
    expected = [0.5, 0.3, 1, 2, 3, np.sqrt(8), np.sqrt(8)]
    np.testing.assert_allclose(distances, np.array(expected) - 0.2, atol=1e-12)
