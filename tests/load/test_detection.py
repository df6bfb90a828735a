"""Detection of contact: closed forms, reference loops of the kernels, and its requirements."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from load_cases import OFFSETS, TOOL, motions, vectors
from scipy.stats import chi2, norm

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

from contact_detection import auc, free_threshold

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.compensation import contact_wrench
from drake_teleop.load.contact.detection import (
    CONTACT_END_LEVEL,
    CUSUM_SLACK,
    MEMORY_SIZE,
    ContactDetector,
    central_axis_of_wrenches,
    fit_noise_floor,
    statistics_of_log,
    update_statistics,
)
from drake_teleop.load.contact.noise_floor import (
    MAX_GLR_WINDOW_SAMPLES,
    STATISTIC_NAMES,
    NoiseFloor,
    limit_covariance_to_scales,
)
from drake_teleop.load.identification import natural_scales
from drake_teleop.load.regressor import non_contact_wrench, regressor

NOISE = np.repeat([0.05, 0.002], 3)
STILL = (np.array([0.0, 0.0, 9.81]), np.zeros(3), np.zeros(3), np.zeros(3))


def white(rho: float = 0.0) -> NoiseFloor:
    """Return a noise floor of white channels that is independent of the motion."""
    return NoiseFloor(NOISE, np.zeros((16, 16)), np.zeros((6, 2)), np.eye(6), np.full(6, rho))


def at_rest(samples: int):
    return tuple(np.tile(x, (samples, 1)) for x in STILL)


def swing(samples: int, seed: int, largest: float = 5.0):
    """Return (s, omega, alpha, a) of alternately slow and fast sines under gravity."""
    rng = np.random.default_rng(seed)
    t = np.arange(samples) * 1e-3
    burst = 0.5 * (1.0 + np.sin(0.9 * t))[:, None]
    a, alpha = (
        largest * burst * np.sin(np.outer(t, rng.uniform(5, 15, 3)) + rng.uniform(0, 6, 3))
        for _ in range(2)
    )
    omega = np.sin(np.outer(t, rng.uniform(1, 3, 3)))
    return a + np.array([0.0, 0.0, 9.81]), omega, alpha, a


# The noise floor


@pytest.mark.slow
@given(motions(), vectors(3, 20.0), arrays(np.float64, (16, 16), elements=st.floats(-0.1, 0.1)))
def test_the_floor_is_the_sum_of_its_parts(motion, a, root):
    growth = np.arange(12.0).reshape(6, 2) * 0.01
    floor = NoiseFloor(NOISE, root @ root.T, growth, np.eye(6), np.zeros(6))
    J = np.hstack([np.eye(6), regressor(*motion)])
    expected = NOISE**2 + np.diag(J @ root @ root.T @ J.T)
    expected += growth[:, 0] ** 2 * (a @ a) + growth[:, 1] ** 2 * (motion[2] @ motion[2])
    sigma = floor.noise_std_along(*(x[None] for x in (*motion, a)))[0]
    np.testing.assert_allclose(sigma**2, expected, rtol=1e-9, atol=1e-12)


@given(vectors(3, 20.0), st.floats(1.0, 10.0))
def test_faster_motion_never_lowers_the_floor(a, factor):
    floor = NoiseFloor(NOISE, np.zeros((16, 16)), np.full((6, 2), 0.1), np.eye(6), np.zeros(6))
    s, rest = np.array([[0.0, 0.0, 9.81]]), np.zeros((1, 3))
    slow = floor.noise_std_along(s, rest, rest, a[None])
    assert (floor.noise_std_along(s, rest, rest, factor * a[None]) >= slow).all()


def test_excitation_of_a_held_acceleration_fades():
    floor = NoiseFloor(NOISE, np.zeros((16, 16)), np.ones((6, 2)), np.eye(6), np.zeros(6), fade=0.5)
    a = np.zeros((4, 3))
    a[1, 0] = 2.0
    sigma = floor.noise_std_along(np.zeros((4, 3)), np.zeros((4, 3)), np.zeros((4, 3)), a)
    held = np.array([0.0, 4.0, 2.0, 1.0])
    np.testing.assert_allclose(sigma**2, NOISE**2 + held[:, None], rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_known_noise_floor_is_estimated(seed):
    rng, samples = np.random.default_rng(seed), 40_000
    motion = swing(samples, seed)
    growth = np.repeat([[0.08, 0.05], [0.004, 0.002]], 3, axis=0)
    root = np.linalg.cholesky(0.5 * np.eye(6) + 0.5)
    true = NoiseFloor(NOISE, np.zeros((16, 16)), growth, root @ root.T, np.zeros(6))
    contact = true.noise_std_along(*motion) * (rng.normal(size=(samples, 6)) @ root.T)
    found = fit_noise_floor(contact, *motion, np.zeros((16, 16)))
    np.testing.assert_allclose(found.noise, NOISE, rtol=0.1)
    np.testing.assert_allclose(found.per_acceleration, growth, rtol=0.1)
    np.testing.assert_allclose(found.correlation, true.correlation, atol=0.03)
    np.testing.assert_allclose(found.rho, 0.0, atol=0.03)
    np.testing.assert_allclose(found.sum_widths, 1.0, atol=0.1)
    level = statistics_of_log(found, contact, *motion)[:, 0]
    # Its square is chi-squared in slow and in fast motion.
    for rows in (np.linalg.norm(motion[3], axis=1) < 2.0, np.linalg.norm(motion[3], axis=1) > 5.0):
        assert (level[rows] ** 2 > chi2.isf(0.01, 6)).mean() == pytest.approx(0.01, abs=0.004)


@pytest.mark.slow
@pytest.mark.parametrize(("fade", "seed"), [(0.0, 0), (0.9, 3), (0.997, 5)])
def test_fitted_noise_floor_holds_accelerations_as_requested(fade, seed):
    rng, motion = np.random.default_rng(seed), swing(6000, seed)
    growth = np.repeat([[0.08, 0.05], [0.004, 0.002]], 3, axis=0)
    true = NoiseFloor(NOISE, np.zeros((16, 16)), growth, np.eye(6), np.zeros(6), fade=fade)
    contact = true.noise_std_along(*motion) * rng.normal(size=(6000, 6))
    found = fit_noise_floor(contact, *motion, np.zeros((16, 16)), fade=fade)
    assert found.fade == fade
    ratio = found.noise_std_along(*motion) / true.noise_std_along(*motion)
    np.testing.assert_allclose(ratio.mean(axis=0), 1.0, atol=0.1)
    maxima = statistics_of_log(found, contact, *motion).max(axis=0)
    np.testing.assert_array_equal(found.free_maxima, maxima)


def test_coloured_noise_is_whitened():
    rng, rho = np.random.default_rng(5), 0.9
    noise = rng.normal(size=(50_000, 6)) * NOISE
    for k in range(1, len(noise)):
        noise[k] = rho * noise[k - 1] + math.sqrt(1 - rho**2) * noise[k]
    found = fit_noise_floor(noise, *at_rest(len(noise)), np.zeros((16, 16)))
    np.testing.assert_allclose(found.rho, rho, atol=0.01)
    # The maximum of the likelihood ratios exceeds its threshold as rarely as in white noise.
    glr = statistics_of_log(found, noise, *at_rest(len(noise)))[:, 2]
    assert (glr > 6.2).mean() < 1e-4
    assert (statistics_of_log(white(), noise, *at_rest(len(noise)))[:, 2] > 6.2).mean() > 0.1


def test_record_without_noise_has_a_positive_floor():
    found = fit_noise_floor(np.zeros((200, 6)), *at_rest(200), np.zeros((16, 16)))
    np.testing.assert_allclose(found.noise, [1e-3] * 3 + [1e-4] * 3)


def test_slow_error_does_not_raise_the_threshold_of_quick_contacts():
    """An oscillation of half a standard deviation within seconds dominates long sums."""
    rng, n = np.random.default_rng(6), 60_000
    slow = 0.7 * np.sin(np.arange(n)[:, None] * 1e-3 * rng.uniform(1.0, 3.0, 6))
    noise = (rng.normal(size=(n, 6)) + slow) * NOISE
    found = fit_noise_floor(noise, *at_rest(n), np.zeros((16, 16)))
    assert found.sum_widths[0] == pytest.approx(1.0, abs=0.05)
    assert found.sum_widths[-1] > 2.0
    blind = replace(found, sum_widths=np.ones(len(found.sum_widths)))
    quick = noise.copy()
    quick[500::1000, 0] += 6.0 * NOISE[0]
    quick[501::1000, 0] += 6.0 * NOISE[0]
    noticed = []
    for floor in (found, blind):
        threshold = free_threshold(statistics_of_log(floor, noise, *at_rest(n))[:, 2], 1e-4)
        noticed.append(
            (statistics_of_log(floor, quick, *at_rest(n))[501::1000, 2] >= threshold).mean()
        )
    assert noticed[0] > 0.9
    assert noticed[1] < 0.5


def test_undetermined_parameters_have_their_natural_scale():
    covariance = np.diag(np.r_[np.full(6, 0.01), np.full(4, 1e-6), np.full(6, np.inf)])
    P = limit_covariance_to_scales(TOOL, covariance)
    np.testing.assert_allclose(np.diag(P)[10:], natural_scales(TOOL)[10:] ** 2)
    np.testing.assert_array_equal(P[:10, :10], covariance[:10, :10])
    assert (limit_covariance_to_scales(TOOL, covariance, tared=True)[:6] == 0.0).all()


# The statistics


@given(
    arrays(np.float64, (40, 6), elements=st.floats(-0.5, 0.5)),
    st.floats(0.0, 0.99),
    st.floats(0.1, 2.0),
)
@settings(max_examples=40)
def test_statistics_equal_their_definitions(contact, rho, slack):
    z = contact / NOISE
    e = z.copy()
    e[1:] = (z[1:] - rho * z[:-1]) / math.sqrt(1.0 - rho**2)
    S, cusum, glr = np.zeros(6), [], []
    for k in range(len(e)):
        length = float(np.linalg.norm(S + e[k]))
        S = (S + e[k]) * (max(0.0, 1.0 - slack / length) if length > 0 else 0.0)
        cusum.append(np.linalg.norm(S))
        lengths = [n for n in (1, 2, 4, 8, 16, 32) if n <= k + 1]
        glr.append(max(np.linalg.norm(e[k + 1 - n : k + 1].sum(0)) / math.sqrt(n) for n in lengths))
    expected = np.stack([np.linalg.norm(z, axis=1), cusum, glr], axis=1)
    found = statistics_of_log(white(rho), contact, *at_rest(len(contact)), slack=slack)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-8)


def test_window_of_the_likelihood_ratio_is_finite():
    contact = np.zeros((3 * MAX_GLR_WINDOW_SAMPLES, 6))
    contact[10] = 100.0 * NOISE
    glr = statistics_of_log(white(), contact, *at_rest(len(contact)))[:, 2]
    assert glr[10 + MAX_GLR_WINDOW_SAMPLES - 1] == pytest.approx(
        100.0 * math.sqrt(6.0 / MAX_GLR_WINDOW_SAMPLES)
    )
    np.testing.assert_allclose(glr[10 + MAX_GLR_WINDOW_SAMPLES :], 0.0, atol=1e-9)


@given(arrays(np.float64, (30, 6), elements=st.floats(-5.0, 5.0)))
def test_correlated_channels_have_mahalanobis_distance(z):
    correlation = 0.6 * np.eye(6) + 0.4
    floor = NoiseFloor(NOISE, np.zeros((16, 16)), np.zeros((6, 2)), correlation, np.zeros(6))
    level = statistics_of_log(floor, z * NOISE, *at_rest(30))[:, 0]
    expected = np.einsum("ki,ij,kj->k", z, np.linalg.inv(correlation), z)
    np.testing.assert_allclose(level**2, expected, rtol=1e-9, atol=1e-9)


def test_sums_detect_a_weak_contact_sooner_at_equal_false_alarms():
    """A push of one standard deviation: sums need about 20 samples, the level far more."""

    def found(x):
        return statistics_of_log(white(), x, *at_rest(len(x)), slack=0.5)

    rng, length, runs = np.random.default_rng(2), 400, 200
    free = rng.normal(size=(200_000, 6)) * NOISE
    thresholds = [free_threshold(x, 1e-4) for x in found(free).T]
    delays = np.empty((runs, 3))
    for k in range(runs):
        contact = rng.normal(size=(length, 6)) * NOISE
        contact[100:, 0] += NOISE[0]
        alarms = found(contact)[100:] >= thresholds
        delays[k] = [np.argmax(a) if a.any() else length for a in alarms.T]
    level, cusum, glr = np.median(delays, axis=0)
    assert cusum < 0.25 * level
    assert glr < 0.25 * level


# The detector


@pytest.mark.slow
@given(st.sampled_from(STATISTIC_NAMES), st.integers(0, 100))
@settings(max_examples=20)
def test_sample_by_sample_equals_a_log_in_one_call(statistic, seed):
    rng = np.random.default_rng(seed)
    contact = rng.normal(size=(200, 6)) * NOISE
    contact[60:120, 1] += 10.0 * NOISE[1]
    rows = (contact, *swing(200, seed))
    floor = NoiseFloor(
        NOISE, 1e-8 * np.eye(16), np.full((6, 2), 1e-3), np.eye(6), np.full(6, 0.3), fade=0.9
    )
    whole = ContactDetector(floor, 7.0, statistic=statistic)
    single = ContactDetector(floor, 7.0, statistic=statistic)
    flags = whole.detect(*rows)
    assert flags[60:120].any()
    np.testing.assert_array_equal(flags, [single.update(*x) for x in zip(*rows, strict=True)])


@pytest.mark.parametrize("statistic", STATISTIC_NAMES)
def test_interrupted_contact_is_one_and_ends_after_the_hold(statistic):
    contact = np.zeros((400, 6))
    contact[100:200:5, 2] = 12.0 * NOISE[2]
    flags = ContactDetector(white(), 8.0, statistic=statistic, hold=20).detect(
        contact, *at_rest(400)
    )
    np.testing.assert_array_equal(np.flatnonzero(flags), np.arange(100, 195 + 21))


def test_weak_force_keeps_a_contact_for_any_hold():
    """Two standard deviations are invisible in one sample, but clear in the longest window, 64."""
    contact = np.zeros((2500, 6))
    contact[100:200, 2], contact[200:1500, 2] = 30.0 * NOISE[2], 2.0 * NOISE[2]
    for hold in (100, 300):
        flags = ContactDetector(white(), 8.0, hold=hold).detect(contact, *at_rest(2500))
        assert flags[100:1500].all() and not flags[1500 + 64 + hold :].any()


def test_correlated_rest_after_a_contact_is_no_new_contact():
    """The first innovation after the end of the contact has a predecessor: 0.46, not 2."""
    contact = np.zeros((400, 6))
    contact[100:200, 2], contact[200:, 2] = 30.0 * NOISE[2], 2.0 * NOISE[2]
    flags = ContactDetector(white(0.9), 0.5, hold=20).detect(contact, *at_rest(400))
    np.testing.assert_array_equal(np.flatnonzero(np.diff(flags)), [99, 219])


@pytest.mark.parametrize("following", [0.0, 1e-3])
def test_long_contact_ends_at_once_and_the_next_is_detected(following):
    contact = np.zeros((20_000, 6))
    contact[100:15_000, 0] = contact[15_100:, 0] = 30.0 * NOISE[0]
    detector = ContactDetector(white(), 8.0, hold=20, following=following)
    flags = detector.detect(contact, *at_rest(len(contact)))
    np.testing.assert_array_equal(np.flatnonzero(np.diff(flags)), [99, 15_019, 15_099])


@pytest.mark.parametrize("statistic", ["cusum", "glr"])
def test_weak_contact_is_not_interrupted(statistic):
    """Two standard deviations, which only sums detect: the flag must be constant."""
    rng = np.random.default_rng(3)
    noise = rng.normal(size=(6000, 6)) * NOISE
    contact = noise.copy()
    contact[3000:5000, 1] += 2.0 * NOISE[1]
    rows = at_rest(6000)
    threshold = (
        1.25 * statistics_of_log(white(), noise, *rows)[:, STATISTIC_NAMES.index(statistic)].max()
    )
    flags = ContactDetector(white(), threshold, statistic=statistic).detect(contact, *rows)
    first, last = np.flatnonzero(np.diff(flags))
    assert 3000 <= first < 3050
    assert 5000 <= last < 5080


@pytest.mark.parametrize("seed", range(3))
def test_only_the_push_is_contact_during_drift(seed):
    """A drift of 1.5 standard deviations in 100 s, twice that of the station's sensor."""
    rng, n = np.random.default_rng(seed), 100_000
    wrench = rng.normal(size=(n, 6)) * NOISE
    quiet = wrench[:20_000]
    floor = fit_noise_floor(quiet, *at_rest(len(quiet)), np.zeros((16, 16)))
    wrench[:, 2] += np.linspace(0.0, 1.5, n) * NOISE[2]
    wrench[-1000:, 2] -= 3.0 * NOISE[2]
    threshold = floor.threshold("glr")
    follows, stays = (
        ContactDetector(floor, threshold, statistic="glr", following=following).detect(
            wrench, *at_rest(n)
        )
        for following in (1 / 5000, 0.0)
    )
    assert not follows[:-1000].any()
    assert follows[-950:].all()
    assert stays[:-1000].mean() > 0.2


def test_only_the_push_is_contact_in_fast_motion():
    """The estimated load is 1 % too light and 2 ms late, so that elimination leaves a residual."""
    samples = 40_000
    s, omega, alpha, a = swing(samples, 1, 8.0)
    rng = np.random.default_rng(9)
    noise = rng.normal(size=(samples, 6)) * NOISE
    wrench = OFFSETS + non_contact_wrench(s, omega, alpha, TOOL) + noise
    late = [np.roll(x, 2, axis=0) for x in (s, omega, alpha)]
    contact = contact_wrench(wrench, OFFSETS, *late, 0.99 * TOOL)
    contact -= np.median(contact, axis=0)
    motion = (*late, np.roll(a, 2, axis=0))
    half = samples // 2
    free = [x[:half] for x in (contact, *motion)]
    floor = fit_noise_floor(*free, np.zeros((16, 16)), fade=0.97)
    fixed = fit_noise_floor(free[0], *at_rest(half), np.zeros((16, 16)))

    second = [x[half:] for x in (contact, *motion)]
    slow = np.linalg.norm(second[4], axis=1) < 2.0
    push = np.zeros_like(second[0])
    push[:, 2] = 0.6
    seen = []
    for f, train, test in (
        (floor, free, second),
        (fixed, [free[0], *at_rest(half)], [second[0], *at_rest(half)]),
    ):
        threshold = free_threshold(statistics_of_log(f, *train)[:, 0], 1e-3)
        assert (statistics_of_log(f, *test)[:, 0] >= threshold).mean() < 0.005
        pushed = statistics_of_log(f, test[0] + push, *test[1:])[:, 0]
        seen.append((pushed[slow] >= threshold).mean())
    # A single floor for all motions has the threshold of the fastest one.
    assert seen[0] > 0.5 > 5.0 * seen[1]


def test_each_update_counts_one_sample():
    memory, floor = np.zeros(MEMORY_SIZE), white(0.5)
    for count in (1.0, 2.0):
        update_statistics(
            memory, NOISE, *STILL, floor.compiled_parameters, CUSUM_SLACK, 0.0, CONTACT_END_LEVEL
        )
        assert memory[0] == count


# Quality of a detector


@given(
    st.lists(st.integers(-5, 5), min_size=1, max_size=30),
    st.lists(st.integers(-5, 5), min_size=1, max_size=30),
)
def test_auc_is_the_share_of_ordered_pairs(free, touched):
    a, b = np.array(free, float), np.array(touched, float)
    pairs = (b[:, None] > a).mean() + 0.5 * (b[:, None] == a).mean()
    assert auc(a, b) == pytest.approx(pairs)
    assert auc(b, a) == pytest.approx(1.0 - pairs)
    assert auc(np.exp(a), np.exp(b)) == pytest.approx(pairs)


def test_auc_of_two_normals():
    rng = np.random.default_rng(0)
    found = auc(rng.normal(size=200_000), 1.5 + rng.normal(size=200_000))
    assert found == pytest.approx(norm.cdf(1.5 / math.sqrt(2.0)), abs=0.002)


@given(arrays(np.float64, st.integers(1, 50), elements=st.floats(-9, 9)), st.floats(0.0, 0.9999))
def test_threshold_is_the_least_for_a_false_alarm_rate(free, share):
    threshold = free_threshold(free, share)
    assert (free >= threshold).mean() <= share
    assert (free >= np.nextafter(threshold, -np.inf)).mean() > share
    assert free_threshold(free, 1.0) == -math.inf


# Direction and place of a contact


@given(vectors(3), vectors(3, 0.5), st.floats(-0.2, 0.2))
def test_a_wrench_is_rebuilt_from_its_axis(f, p, pitch):
    size = np.linalg.norm(f)
    if size < 1e-3:
        return
    wrench = np.r_[f, np.cross(p, f) + pitch * f]
    direction, point, found = central_axis_of_wrenches(wrench)
    assert found == pytest.approx(pitch, abs=1e-9)
    np.testing.assert_allclose(direction, f / size)
    assert point @ f == pytest.approx(0.0, abs=1e-9 * size)
    np.testing.assert_allclose(np.cross(point, f) + found * f, wrench[3:], atol=1e-9 * size)


def test_a_wrench_without_force_has_no_axis():
    assert np.isnan(central_axis_of_wrenches(np.zeros(6))[1]).all()


# Invalid input


def test_error_names_the_invalid_input():
    with pytest.raises(DrakeTeleopError, match=r"statistic.*not a statistic.*level, cusum, glr"):
        ContactDetector(white(), 5.0, statistic="sum")
    with pytest.raises(DrakeTeleopError, match="threshold"):
        ContactDetector(white(), 0.0)
    with pytest.raises(DrakeTeleopError, match="rho"):
        white(1.0)
    with pytest.raises(DrakeTeleopError, match="too few"):
        fit_noise_floor(np.zeros((9, 6)), *at_rest(9), np.zeros((16, 16)))
    with pytest.raises(DrakeTeleopError, match=r"alpha.*not finite"):
        ContactDetector(white(), 5.0).update(np.zeros(6), *STILL[:2], [np.nan] * 3, STILL[3])
