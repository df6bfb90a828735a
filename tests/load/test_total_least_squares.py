"""Total least squares: second moments equal the stacked matrix, and results are unbiased."""

from __future__ import annotations

import numpy as np
import pytest
from load_cases import OFFSETS, TOOL, rich_motion

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.batch.total_least_squares import total_least_squares
from drake_teleop.load.normal_equations import (
    NoiseStd,
    SecondMoments,
    normal_equations,
    residual_covariance,
)
from drake_teleop.load.regressor import non_contact_wrench, regressor

TRUTH = np.concatenate([OFFSETS, TOOL])
WRENCH_NOISE = np.array([0.25] * 3 + [0.012] * 3)
NOISE = NoiseStd(s=0.1, omega=0.03, alpha=3.0)


def record(samples=500, seed=0):
    motion = rich_motion(samples, seed)
    return OFFSETS + non_contact_wrench(*motion, TOOL), *motion


def noisy(clean, seed):
    rng = np.random.default_rng(seed)
    std = [WRENCH_NOISE, 0.1, 0.03, 3.0]
    return [x + s * rng.normal(size=x.shape) for x, s in zip(clean, std, strict=True)]


def moments_of(arrays, **weights):
    moments = SecondMoments()
    moments.add_samples(*arrays, **weights)
    return moments


def test_moments_equal_those_of_the_stacked_matrix():
    F, *motion = noisy(record(), 1)
    A = np.concatenate([np.tile(np.eye(6), (500, 1, 1)), regressor(*motion)], axis=2)
    root = np.random.default_rng(2).normal(size=(6, 6))
    W, weights = root @ root.T, np.random.default_rng(3).uniform(size=500)
    moments = moments_of((F, *motion), weights=weights)
    gram, right = normal_equations(moments.mean_products, W)
    WA = np.einsum("n,cd,ndj->ncj", weights / weights.sum(), W, A)
    np.testing.assert_allclose(gram, np.einsum("nci,ncj->ij", A, WA), rtol=1e-9, atol=1e-8)
    np.testing.assert_allclose(right, np.einsum("ncj,nc->j", WA, F), rtol=1e-9, atol=1e-8)
    r = F - A @ TRUTH
    expected = np.einsum("n,nc,nd->cd", weights / weights.sum(), r, r)
    got = residual_covariance(moments.mean_products, TRUTH)
    np.testing.assert_allclose(got, expected, rtol=1e-6, atol=1e-9)


def test_noise_covariance_predicts_the_residual():
    clean = record(5000)
    Q = moments_of(clean).mean_noise_covariance_of_z(NOISE, WRENCH_NOISE)
    S = residual_covariance(moments_of(noisy(clean, 4)).mean_products, TRUTH)
    scale = np.sqrt(np.outer(np.diag(S), np.diag(S)))
    np.testing.assert_allclose(S / scale, residual_covariance(Q, TRUTH) / scale, atol=0.06)


def test_noise_of_each_axis_of_the_gyroscope_enters_its_products():
    """Sum of std_k^2 dz dz^T, where dz is the change of z by angular velocity about axis k."""
    rng, std = np.random.default_rng(5), np.array([0.01, 0.05, 0.2])
    clean = *record(200)[:2], rng.normal([0.3, -0.7, 1.1], [1.0, 0.5, 2.0], (200, 3)), np.zeros(3)
    expected = np.zeros((19, 19))
    for k in range(3):
        w = [clean[2] + sign * np.eye(3)[k] for sign in (-1.0, 1.0)]
        low, high = (x[:, [0, 1, 2, 0, 0, 1]] * x[:, [0, 1, 2, 1, 2, 2]] for x in w)
        expected[13:, 13:] += std[k] ** 2 * (high - low).T @ (high - low) / 4.0 / 200
    Q = moments_of(clean).mean_noise_covariance_of_z(NoiseStd(omega=std), np.zeros(6))
    np.testing.assert_allclose(Q, expected, rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("noise", [NoiseStd(), NOISE])
def test_exact_without_noise(noise):
    form = total_least_squares(moments_of(record()), noise, WRENCH_NOISE)
    np.testing.assert_allclose(form.theta, TRUTH, rtol=0, atol=1e-9)


def test_result_is_unbiased_in_contrast_to_least_squares():
    clean = record()
    errors = np.empty((2, 40, 16))
    for seed in range(40):
        moments = moments_of(noisy(clean, seed))
        for k, noise in enumerate([NoiseStd(), NOISE]):
            errors[k, seed] = total_least_squares(moments, noise, WRENCH_NOISE).theta - TRUTH
    bias, deviation = errors.mean(axis=1), errors.std(axis=1) / np.sqrt(40)
    moments_of_inertia = [10, 13, 15]
    assert (bias[0] < -3 * deviation[0])[moments_of_inertia].all()
    assert np.abs(bias[1] / bias[0])[moments_of_inertia].max() < 0.2
    assert np.abs(bias[1] / deviation[1]).max() < 4.0


def test_scale_is_the_ratio_of_true_and_stated_noise():
    moments = moments_of(noisy(record(4000), 5))
    stated = NoiseStd(s=0.05, omega=0.015, alpha=1.5)
    form = total_least_squares(moments, stated, 0.5 * WRENCH_NOISE)
    assert form.noise_scale == pytest.approx(4.0, rel=0.05)
    right = total_least_squares(moments, NOISE, WRENCH_NOISE)
    np.testing.assert_allclose(form.theta, right.theta, rtol=1e-6, atol=1e-8)


def test_known_offsets():
    F, *motion = record()
    form = total_least_squares(
        moments_of((F - OFFSETS, *motion)), NOISE, WRENCH_NOISE, offsets=False
    )
    np.testing.assert_array_equal(form.theta[:6], np.zeros(6))
    np.testing.assert_allclose(form.theta[6:], TOOL, rtol=0, atol=1e-9)


def test_static_poses_give_zero_inertia():
    s = record(50)[1]
    F = OFFSETS + non_contact_wrench(s, np.zeros(3), np.zeros(3), TOOL)
    moments = moments_of((F, s, np.zeros(3), np.zeros(3)))
    form = total_least_squares(moments, NoiseStd(s=0.1), WRENCH_NOISE)
    np.testing.assert_allclose(form.theta[:10], TRUTH[:10], rtol=0, atol=1e-9)
    np.testing.assert_array_equal(form.theta[10:], np.zeros(6))


def test_error_names_the_invalid_input():
    with pytest.raises(DrakeTeleopError, match=r"^noise\.alpha: has the negative value -"):
        NoiseStd(alpha=-1.0)
    with pytest.raises(
        DrakeTeleopError, match=r"^noise\.wrench: has the value .*, which is not positive"
    ):
        NoiseStd(wrench=np.zeros(6))
    with pytest.raises(DrakeTeleopError, match="2 samples cannot determine"):
        total_least_squares(moments_of([x[:2] for x in record()]), NoiseStd(), WRENCH_NOISE)
