"""Recursive total least squares: bias by noisy motion, covariance, weak excitation."""

from __future__ import annotations

import numpy as np
import pytest
from load_cases import OFFSETS, TOOL, rich_motion

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.batch.methods import identify_batch
from drake_teleop.load.identification import Identification
from drake_teleop.load.normal_equations import NoiseStd, identify
from drake_teleop.load.online.recursive import PRIOR_STD, RecursiveLeastSquares
from drake_teleop.load.online.recursive_tls import RecursiveTotalLeastSquares
from drake_teleop.load.regressor import non_contact_wrench

# The JR3 of the station: wrench [N, N m], s [m/s^2], omega [rad/s], alpha [rad/s^2].
NOISE = np.repeat([0.25, 0.012], 3)
MOTION = np.repeat([0.06, 0.002, 1.5], 3)
TRUTH = np.concatenate([OFFSETS, TOOL])
INERTIAS = [10, 13, 15]
REST = np.zeros(3)


def record(seed, samples=1500, motion=None, scale=1.0):
    """Return a record with noise in wrench and motion, `scale` times the stated one."""
    rng = np.random.default_rng(seed)
    motion = rich_motion(samples) if motion is None else motion
    F = OFFSETS + non_contact_wrench(*motion, TOOL)
    noisy = [
        x + scale * std * rng.normal(size=x.shape)
        for x, std in zip(motion, np.split(MOTION, 3), strict=True)
    ]
    return F + scale * NOISE * rng.normal(size=F.shape), noisy


def run_estimator(F, motion, **options):
    estimator = RecursiveTotalLeastSquares(NOISE, MOTION, **options)
    estimator.update_samples(F, *motion)
    return estimator


def state_of(estimator):
    return np.concatenate([estimator.offsets, estimator.phi])


@pytest.mark.slow
def test_result_is_least_squares_without_noise_of_the_motion():
    motion = rich_motion(2000)
    noise = NOISE * np.random.default_rng(0).normal(size=(2000, 6))
    F = OFFSETS + non_contact_wrench(*motion, TOOL) + noise
    total = RecursiveTotalLeastSquares(NOISE, np.zeros(9))
    total.update_samples(F, *motion)
    least = RecursiveLeastSquares(NOISE)
    least.update_samples(F, *motion)
    np.testing.assert_allclose(total.phi, least.phi, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(total.offsets, least.offsets, rtol=1e-6)
    ratio = np.diag(total.covariance) / np.diag(least.covariance)
    np.testing.assert_allclose(ratio, total.noise_scale, rtol=1e-4)
    assert total.noise_scale == pytest.approx(1.0, abs=0.05)


def test_result_equals_the_batch_of_all_previous_samples():
    F, motion = record(9)
    estimator = run_estimator(F, motion)
    noise = NoiseStd(NOISE, *(std[0] for std in np.split(MOTION, 3)))
    batch = identify_batch(F, *motion, method="total", noise=noise).identification
    np.testing.assert_allclose(estimator.phi, batch.phi, rtol=2e-4, atol=1e-7)
    np.testing.assert_allclose(estimator.offsets, batch.offsets, rtol=2e-4)


def test_inertias_are_unbiased_and_the_covariance_is_right():
    totals, leasts, squares = [], [], []
    for seed in range(30):
        F, motion = record(seed)
        total = run_estimator(F, motion)
        least = RecursiveLeastSquares(NOISE)
        least.update_samples(F, *motion)
        totals.append(state_of(total) - TRUTH)
        leasts.append(state_of(least) - TRUTH)
        squares.append(np.square(totals[-1]) / np.diag(total.covariance))
    least_error, least_std = np.mean(leasts, axis=0), np.std(leasts, axis=0)
    biased = np.abs(least_error) > 3.0 * least_std / np.sqrt(30)
    assert biased[INERTIAS].all()
    # The stated deviation of least squares does not include the bias.
    predicted = np.sqrt(np.diag(least.covariance))
    assert (np.abs(least_error) > 3.5 * predicted)[INERTIAS].all()
    ratio = np.abs(np.mean(totals, axis=0) / least_error)[INERTIAS]
    assert ratio.max() < 0.2
    # Mean square error in units of the predicted one: 1 +- 0.26 (1 sigma) for 30 seeds.
    honest = np.mean(squares, axis=0)
    assert honest.min() > 0.4 and honest.max() < 2.2
    assert honest.mean() == pytest.approx(1.0, abs=0.25)


@pytest.mark.filterwarnings("error")
def test_estimate_is_the_prior_before_the_first_sample():
    estimator = RecursiveTotalLeastSquares(NOISE, MOTION)
    np.testing.assert_allclose(estimator.covariance, np.diag(np.square(PRIOR_STD)), rtol=1e-12)


def test_common_scale_of_the_noise_is_estimated():
    F, motion = record(0, scale=0.35)
    estimator = run_estimator(F, motion)
    assert estimator.noise_scale == pytest.approx(0.35**2, rel=0.1)
    error = np.abs(state_of(estimator) - TRUTH) / np.sqrt(np.diag(estimator.covariance))
    assert error.max() < 4.0


def test_after_one_and_a_half_seconds_the_load_is_settled():
    F, motion = record(1, samples=20_000)
    motion = [np.ascontiguousarray(x[::2]) for x in motion]  # any rate; a slow motion
    estimator = RecursiveTotalLeastSquares(NOISE, MOTION, settled_std=0.02)
    estimator.update_samples(F[:40], *(x[:40] for x in motion))
    assert not estimator.is_settled
    F, motion = record(2)
    estimator = run_estimator(F, motion)
    assert estimator.is_settled
    assert estimator.phi[0] == pytest.approx(TOOL[0], rel=0.02)
    com = estimator.phi[1:4] / estimator.phi[0] - TOOL[1:4] / TOOL[0]
    assert np.linalg.norm(com) < 0.05 * np.linalg.norm(TOOL[1:4] / TOOL[0])


def test_inertia_is_bounded_and_undetermined_without_rotation():
    s, omega, alpha = rich_motion(3000)
    F, motion = record(3, motion=(s, 0.0 * omega, 0.0 * alpha))
    estimator = RecursiveTotalLeastSquares(NOISE, MOTION)
    for sample in zip(F, *motion, strict=True):
        estimator.update(*sample)
        assert np.abs(estimator.phi[4:]).max() < 0.2
    assert not estimator.is_settled
    result = estimator.identification()
    assert not result.identifiable[INERTIAS].any()
    assert [result.verdicts[i] for i in INERTIAS] == ["prior"] * 3
    np.testing.assert_allclose(result.standard_deviations[INERTIAS], 1.0, rtol=0.2)
    error = np.abs(state_of(estimator) - TRUTH) / np.sqrt(np.diag(estimator.covariance))
    assert error[:10].max() < 4.0
    assert result.mass == pytest.approx(TOOL[0], rel=0.002)


def test_slow_rotation_gives_a_bounded_estimate():
    """Angular accelerations of 1 rad/s^2 with noise of 1.5: noise is half of the information."""
    s, omega, alpha = rich_motion(1500)
    errors = []
    for seed in range(10):
        estimator = run_estimator(*record(seed, motion=(s, omega, 0.1 * alpha)))
        deviations = np.sqrt(np.diag(estimator.covariance))
        errors.append((state_of(estimator) - TRUTH) / deviations)
    assert np.abs(errors).max() < 5.0


def test_covariance_is_bounded_at_rest():
    F, motion = record(4)
    estimator = run_estimator(F, motion, forgetting=0.99)
    s = np.tile([0.0, 0.0, 9.81], (20_000, 1))
    F_still, still = record(5, motion=(s, 0.0 * s, 0.0 * s))
    estimator.update_samples(F_still, *still)
    assert np.isfinite(state_of(estimator)).all()
    assert (np.abs(estimator.phi) <= PRIOR_STD[6:]).all()
    assert not estimator.is_settled
    deviations = np.sqrt(np.diag(estimator.covariance))
    assert (deviations <= np.array(PRIOR_STD) * (1 + 1e-9)).all()
    estimator.update_samples(F, *motion)
    assert estimator.phi[0] == pytest.approx(TOOL[0], abs=0.15)


def test_forgetting_follows_a_new_load():
    motion = rich_motion(3000)
    thing = np.array([0.5, 0.0, 0.0, 0.06, 0.008, 0.0, 0.0, 0.008, 0.0, 0.001])
    F, noisy = record(6, motion=motion)
    estimator = run_estimator(F, noisy, forgetting=0.995)
    estimator.update_samples(F + non_contact_wrench(*motion, thing), *noisy)
    error = state_of(estimator) - TRUTH - np.concatenate([np.zeros(6), thing])
    assert (np.abs(error) / np.sqrt(np.diag(estimator.covariance))).max() < 4.5
    assert estimator.phi[0] == pytest.approx(TOOL[0] + 0.5, abs=0.05)


@pytest.mark.parametrize("motion_std", [0.0, 1e-6])
@pytest.mark.parametrize("noise_std", [1e-9, 1e-6])
def test_ideal_sensor_gives_the_load(noise_std, motion_std):
    motion = rich_motion(3000)
    F = OFFSETS + non_contact_wrench(*motion, TOOL)
    estimator = RecursiveTotalLeastSquares(np.full(6, noise_std), np.full(9, motion_std))
    for part in np.split(np.arange(3000), [1, 2, 5, 20, 200]):
        estimator.update_samples(F[part], *(x[part] for x in motion))
        assert (np.linalg.eigvalsh(estimator.covariance) >= -1e-12).all()
    np.testing.assert_allclose(estimator.phi, TOOL, rtol=0, atol=1e-7)
    np.testing.assert_allclose(estimator.offsets, OFFSETS, rtol=0, atol=1e-6)
    assert estimator.is_settled and estimator.identification().identifiable.all()


def test_samples_log_and_external_state_give_the_same_result():
    F, motion = record(7, samples=300)
    log = run_estimator(F, motion, forgetting=0.999)
    single = RecursiveTotalLeastSquares(NOISE, MOTION, forgetting=0.999)
    elsewhere = RecursiveTotalLeastSquares(NOISE, MOTION, forgetting=0.999)
    state = np.zeros(16)
    memory = elsewhere.initial_memory(state)
    for sample in zip(F, *motion, strict=True):
        single.update(*sample)
        elsewhere.update_into(state, memory, np.concatenate(sample))
    np.testing.assert_array_equal(state_of(single), state_of(log))
    np.testing.assert_array_equal(state, state_of(log))
    np.testing.assert_array_equal(elsewhere.covariance_of(state, memory), log.covariance)
    assert single.identification().samples == log.identification().samples == 300


def test_estimation_starts_from_a_given_estimate():
    """Parameters without excitation are unchanged."""
    estimator = RecursiveTotalLeastSquares(NOISE, MOTION)
    state = TRUTH.copy()
    memory = estimator.initial_memory(state)
    sample = np.concatenate([OFFSETS, REST, REST, REST])
    for _ in range(50):
        estimator.update_into(state, memory, sample)
    np.testing.assert_allclose(state, TRUTH, rtol=1e-9)
    assert not estimator.is_state_settled(state, memory)


def test_identification_is_saved_and_read(tmp_path):
    F, motion = record(8)
    result = run_estimator(F, motion).identification()
    assert result.method == "recursive total least squares"
    assert result.identifiable.all() and result.physically_consistent
    batch = identify(F, *motion, noise=NOISE)
    np.testing.assert_allclose(result.residual_rms, batch.residual_rms, rtol=0.2)
    result.save(tmp_path / "identification.json")
    read = Identification.load(tmp_path / "identification.json")
    np.testing.assert_array_equal(read.phi, result.phi)


def test_error_names_the_invalid_input():
    with pytest.raises(DrakeTeleopError, match=r"^motion_std: has the negative value -"):
        RecursiveTotalLeastSquares(NOISE, -MOTION)
    with pytest.raises(DrakeTeleopError, match=r"^motion_std: has shape \(6,\)"):
        RecursiveTotalLeastSquares(NOISE, NOISE)
    with pytest.raises(DrakeTeleopError, match=r"^settled_std: 0\.0 is not positive"):
        RecursiveTotalLeastSquares(NOISE, MOTION, settled_std=0.0)
    with pytest.raises(DrakeTeleopError, match="estimator: has not received a sample"):
        RecursiveTotalLeastSquares(NOISE, MOTION).identification()
