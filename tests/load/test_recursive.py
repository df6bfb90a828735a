"""Recursive least squares compared with the batch, and its behaviour without excitation."""

from __future__ import annotations

import numpy as np
import pytest
from load_cases import OFFSETS, TOOL, rich_motion

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.normal_equations import identify
from drake_teleop.load.online.recursive import PRIOR_STD, RecursiveLeastSquares
from drake_teleop.load.regressor import non_contact_wrench, regressor

NOISE = np.array([0.3, 0.3, 0.5, 0.01, 0.01, 0.005])
REST = np.zeros(3)


def noisy_record(samples, phi=TOOL, seed=0):
    motion = rich_motion(samples, seed)
    noise = NOISE * np.random.default_rng(seed).normal(size=(samples, 6))
    return OFFSETS + non_contact_wrench(*motion, phi) + noise, motion


def run_estimator(F, motion, **options):
    estimator = RecursiveLeastSquares(NOISE, **options)
    for sample in zip(F, *motion, strict=True):
        estimator.update(*sample)
    return estimator


def test_converges_to_the_batch():
    F, motion = noisy_record(3000)
    estimator, batch = run_estimator(F, motion), identify(F, *motion, noise=NOISE)
    np.testing.assert_allclose(estimator.phi, batch.phi, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(estimator.offsets, batch.offsets, rtol=1e-6)
    np.testing.assert_array_equal(estimator.covariance, estimator.covariance.T)


def test_result_is_the_bayesian_estimate_with_the_prior():
    F, motion = noisy_record(7)
    estimator = run_estimator(F, motion, prior_std=np.linspace(0.1, 2.0, 16))
    rows = np.concatenate([np.tile(np.eye(6), (7, 1, 1)), regressor(*motion)], axis=2)
    rows = (rows / NOISE[:, None]).reshape(-1, 16)
    information = np.diag(np.linspace(0.1, 2.0, 16) ** -2.0) + rows.T @ rows
    expected = np.linalg.solve(information, rows.T @ (F / NOISE).ravel())
    np.testing.assert_allclose(estimator.offsets, expected[:6], rtol=1e-9)
    np.testing.assert_allclose(estimator.phi, expected[6:], rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(
        estimator.covariance, np.linalg.inv(information), rtol=1e-6, atol=1e-10
    )


def test_identification_equals_that_of_the_batch():
    F, motion = noisy_record(3000)
    result = run_estimator(F, motion).identification()
    batch = identify(F, *motion, noise=NOISE)
    assert (result.method, result.samples) == ("recursive least squares", 3000)
    assert result.identifiable.all() and result.physically_consistent
    np.testing.assert_allclose(result.residual_rms, batch.residual_rms, rtol=0.02)
    # The batch estimates a conservative variance from the residual: up to twice.
    ratio = np.diag(batch.covariance) / np.diag(result.covariance)
    assert ratio.min() > 0.9 and ratio.max() < 2.5
    assert result.condition_number == pytest.approx(batch.condition_number, rel=0.01)


def test_residual_has_the_forgetting_factor_of_the_estimate():
    F, motion = noisy_record(9000)
    F[:1000, 0] += 50.0 * np.sin(np.arange(1000))  # an early disturbance
    result = run_estimator(F, motion, forgetting=0.998).identification()
    assert 0.8 * NOISE[0] < result.residual_rms[0] < 1.1 * NOISE[0]


def test_static_poses_keep_the_prior_of_the_inertia():
    up = np.random.default_rng(1).normal(size=(200, 3))
    s = 9.81 * up / np.linalg.norm(up, axis=1, keepdims=True)
    F = OFFSETS + non_contact_wrench(s, REST, REST, TOOL)
    estimator = RecursiveLeastSquares(NOISE)
    for wrench, specific_force in zip(F, s, strict=True):
        estimator.update(wrench, specific_force, REST, REST)
    result = estimator.identification()
    assert result.identifiable.tolist() == 10 * [True] + 6 * [False]
    assert result.verdicts == 10 * ("identified",) + 6 * ("prior",)
    np.testing.assert_allclose(result.standard_deviations[10:], PRIOR_STD[10:])
    assert result.mass == pytest.approx(TOOL[0], abs=1e-4)


def test_forgetting_follows_a_new_load():
    thing = np.array([0.5, 0.0, 0.0, 0.06, 0.008, 0.0, 0.0, 0.008, 0.0, 0.001])
    before, after = noisy_record(2000), noisy_record(2000, TOOL + thing, seed=1)
    estimator = RecursiveLeastSquares(NOISE, forgetting=0.995)
    for F, motion in (before, after):
        for sample in zip(F, *motion, strict=True):
            estimator.update(*sample)
    deviations = np.sqrt(np.diag(estimator.covariance))
    error = np.concatenate([estimator.offsets - OFFSETS, estimator.phi - TOOL - thing])
    assert np.abs(error / deviations).max() < 4.0
    assert estimator.phi[0] == pytest.approx(TOOL[0] + 0.5, abs=0.05)


def test_covariance_is_bounded_at_rest():
    F, motion = noisy_record(500)
    estimator = run_estimator(F, motion, forgetting=0.99)
    s = np.array([0.0, 0.0, 9.81])
    still = OFFSETS + non_contact_wrench(s, REST, REST, TOOL)
    for _ in range(20_000):
        estimator.update(still, s, REST, REST)
    P = estimator.covariance
    assert np.isfinite(P).all()
    assert (np.diag(P) <= np.square(PRIOR_STD) * (1 + 1e-9)).all()
    assert np.linalg.eigvalsh(P).min() > -1e-9 * np.linalg.eigvalsh(P).max()
    for sample in zip(F, *motion, strict=True):
        estimator.update(*sample)
    assert estimator.phi[0] == pytest.approx(TOOL[0], abs=0.1)


@pytest.mark.parametrize("forgetting", [1.0, 0.999])
def test_a_nearly_ideal_sensor_keeps_the_covariance_positive(forgetting):
    # Samples are so close that each is almost redundant.
    motion = [x[:1000] for x in rich_motion(8000)]
    F = OFFSETS + non_contact_wrench(*motion, TOOL)
    estimator = RecursiveLeastSquares(1e-9 * NOISE, forgetting)
    for sample in zip(F, *motion, strict=True):
        estimator.update(*sample)
        # Unit variances show whether a direction is negative beyond rounding.
        P = estimator.covariance
        scale = 1.0 / np.sqrt(np.diag(P))
        assert np.linalg.eigvalsh(P * np.outer(scale, scale)).min() > -1e-6
    np.testing.assert_allclose(estimator.phi, TOOL, rtol=0, atol=1e-9)


def test_external_estimate_is_updated():
    F, motion = noisy_record(50)
    own = run_estimator(F, motion)
    state = np.concatenate([np.zeros(16), np.diag(np.square(PRIOR_STD)).ravel()])
    estimator = RecursiveLeastSquares(NOISE)
    for sample in zip(F, *motion, strict=True):
        estimator.update_into(state[:16], state[16:].reshape(16, 16), np.concatenate(sample))
    np.testing.assert_array_equal(state[:6], own.offsets)
    np.testing.assert_array_equal(state[6:16], own.phi)
    np.testing.assert_array_equal(state[16:].reshape(16, 16), own.covariance)
    np.testing.assert_array_equal(estimator.phi, np.zeros(10))


def test_log_in_one_call_equals_sample_by_sample():
    F, motion = noisy_record(300)
    own, log = run_estimator(F, motion, forgetting=0.999), RecursiveLeastSquares(NOISE, 0.999)
    log.update_samples(F[:100], *(x[:100] for x in motion))
    log.update_samples(F[100:], *(x[100:] for x in motion))
    np.testing.assert_array_equal(log.phi, own.phi)
    np.testing.assert_array_equal(log.covariance, own.covariance)
    assert log.identification().samples == 300
    with pytest.raises(DrakeTeleopError, match="the numbers of samples differ"):
        log.update_samples(F, *(x[:100] for x in motion))
    with pytest.raises(DrakeTeleopError, match="is not finite"):
        log.update_samples(np.full((1, 6), np.nan), REST, REST, REST)


def test_settles_when_the_bound_is_reached():
    F, motion = noisy_record(3000)
    estimators = [RecursiveLeastSquares(NOISE, settled_std=x) for x in (0.1, 0.05, 0.02)]
    settled = []
    for estimator in estimators:
        assert not estimator.is_settled
        settled.append(3000)
        for k, sample in enumerate(zip(F, *motion, strict=True)):
            estimator.update(*sample)
            if estimator.is_settled:
                settled[-1] = k
                break
        deviations = np.sqrt(np.diag(estimator.covariance))
        assert deviations[6] < 0.1 * TOOL[0]
    assert 2 < settled[0] < settled[1] < settled[2] < 3000


def test_a_load_on_an_axis_can_be_settled_and_no_load_cannot():
    F, motion = noisy_record(3000)
    estimator = RecursiveLeastSquares(NOISE)
    theta = np.zeros(16)
    memory = estimator.initial_memory(theta)
    for sample in zip(F, *motion, strict=True):
        estimator.update_into(theta, memory, np.concatenate(sample))
    theta[7] = 0.0
    assert estimator.is_state_settled(theta, memory)
    theta[6] = 0.0
    assert not estimator.is_state_settled(theta, memory)


def test_error_names_the_invalid_input_and_keeps_the_estimate():
    F, motion = noisy_record(5)
    estimator = run_estimator(F, motion)
    before = estimator.phi
    for value, what in ((np.nan, "is not finite"), (np.inf, "is not finite"), (-1e200, "is -1e")):
        for name, place in (("wrench", 0), ("s", 6), ("omega", 9), ("alpha", 14)):
            sample = np.zeros(15)
            sample[place] = value
            with pytest.raises(DrakeTeleopError, match=f"^{name}: {what}.* at index"):
                estimator.update(*np.split(sample, [6, 9, 12]))
    with pytest.raises(
        DrakeTeleopError, match=r"^sample: wrench, s, omega, alpha of one sample have shapes"
    ):
        estimator.update(np.zeros(3), np.zeros(6), REST, REST)
    np.testing.assert_array_equal(estimator.phi, before)
    with pytest.raises(
        DrakeTeleopError, match=r"^forgetting: 1\.1 is outside the range 0 < forgetting <= 1"
    ):
        RecursiveLeastSquares(NOISE, forgetting=1.1)
    with pytest.raises(DrakeTeleopError, match=r"^settled_std: -1\.0 is not positive"):
        RecursiveLeastSquares(NOISE, settled_std=-1.0)
    with pytest.raises(
        DrakeTeleopError, match=r"^noise_std: has the value -.*, which is not positive"
    ):
        RecursiveLeastSquares(-NOISE)
    with pytest.raises(DrakeTeleopError, match=r"^prior_std: has shape \(10,\)"):
        RecursiveLeastSquares(NOISE, prior_std=np.ones(10))
    with pytest.raises(DrakeTeleopError, match="estimator: has not received a sample"):
        RecursiveLeastSquares(NOISE).identification()
