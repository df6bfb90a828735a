"""Recursive instrumental variables: bias, weak instruments, invalid input."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from load_cases import OFFSETS, TOOL, rich_motion

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

from instrumental import RecursiveInstrumentalVariables

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.identification import Identification
from drake_teleop.load.online.recursive import PRIOR_STD, RecursiveLeastSquares
from drake_teleop.load.regressor import non_contact_wrench, regressor

pytestmark = pytest.mark.checks  # of a method that only benchmarks use

NOISE = np.repeat([0.25, 0.012], 3)
MOTION = np.repeat([0.06, 0.002, 1.5], 3)
TRUTH = np.concatenate([OFFSETS, TOOL])
INERTIAS = [10, 13, 15]


def record(seed, samples=1500):
    """Return wrench, measured motion, and the commanded motion: 10 samples late, 3 % too small."""
    rng = np.random.default_rng(seed)
    motion = rich_motion(samples)
    F = OFFSETS + non_contact_wrench(*motion, TOOL) + NOISE * rng.normal(size=(samples, 6))
    noise = np.split(MOTION * rng.normal(size=(samples, 9)), 3, axis=1)
    commanded = 0.97 * np.roll(np.hstack(motion), 10, axis=0)
    return F, [x + n for x, n in zip(motion, noise, strict=True)], commanded


def run_estimator(F, motion, instruments, **options):
    estimator = RecursiveInstrumentalVariables(NOISE, **options)
    estimator.update_samples(F, *motion, instruments)
    return estimator


def state_of(estimator):
    return np.concatenate([estimator.offsets, estimator.phi])


def stacked_regressor(motion):
    V = regressor(*motion)
    return np.concatenate([np.broadcast_to(np.eye(6), (len(V), 6, 6)), V], axis=2)


@pytest.mark.parametrize("own", [pytest.param(True, marks=pytest.mark.slow), False])
def test_result_equals_three_stage_least_squares(own):
    """Compare with the stacked matrices; the motion as its own instrument gives weighted LS."""
    F, motion, commanded = record(0)
    instruments = np.hstack(motion) if own else commanded
    estimator = run_estimator(F, motion, instruments)
    X, Y = stacked_regressor(motion), stacked_regressor(np.split(instruments, 3, axis=1))
    found = np.zeros(16)
    for _ in range(6):
        r = F - X @ found
        # The stated noise counts 20 samples.
        W = np.linalg.inv((r.T @ r + 20.0 * np.diag(NOISE**2)) / (len(F) + 20))
        M, R = (np.einsum("nci,cd,ndj->ij", Y, W, other) for other in (Y, X))
        g = np.einsum("nci,cd,nd->i", Y, W, F)
        first = np.linalg.solve(M, R).T
        found = np.linalg.solve(first @ R, first @ g)
    np.testing.assert_allclose(state_of(estimator), found, rtol=1e-4, atol=1e-6)


def test_prior_has_the_weight_of_its_deviations():
    """Compare with the stacked matrices after one sample, where the prior dominates."""
    F, motion, commanded = record(7, samples=1)
    deviations = 0.2 * np.array(PRIOR_STD)
    estimator = run_estimator(F, motion, commanded, prior_std=deviations)
    X, Y = stacked_regressor(motion)[0], stacked_regressor(np.split(commanded, 3, axis=1))[0]
    W = np.linalg.inv((F.T @ F + 20.0 * np.diag(NOISE**2)) / 21)
    prior = np.diag(deviations**-2)
    first = np.linalg.solve(Y.T @ W @ Y + prior, Y.T @ W @ X).T
    found = np.linalg.solve(first @ (Y.T @ W @ X) + prior, first @ (Y.T @ W @ F[0]))
    np.testing.assert_allclose(state_of(estimator), found, rtol=1e-5, atol=1e-7)


def test_bias_is_removed_without_known_noise_and_the_covariance_is_right():
    errors, leasts, squares = [], [], []
    for seed in range(30):
        F, motion, commanded = record(seed)
        estimator = run_estimator(F, motion, commanded)
        errors.append(state_of(estimator) - TRUTH)
        squares.append(np.square(errors[-1]) / np.diag(estimator.covariance))
        least = RecursiveLeastSquares(NOISE)
        least.update_samples(F, *motion)
        leasts.append(state_of(least) - TRUTH)
    mean = np.mean(leasts, axis=0)
    assert (np.abs(mean) > 3.0 * np.std(leasts, axis=0) / np.sqrt(30))[INERTIAS].all()
    assert np.abs(np.mean(errors, axis=0) / mean)[INERTIAS].max() < 0.2
    honest = np.mean(squares, axis=0)
    assert honest.min() > 0.3 and honest.max() < 2.2
    assert honest.mean() == pytest.approx(1.0, abs=0.3)


def test_uncorrelated_instruments_keep_the_prior():
    F, motion, _ = record(1)
    estimator = run_estimator(F, motion, np.zeros((1500, 9)))
    assert not estimator.is_settled
    assert (np.abs(estimator.phi) < 0.1 * np.array(PRIOR_STD[6:])).all()
    deviations = np.sqrt(np.diag(estimator.covariance))
    np.testing.assert_allclose(deviations[6:], PRIOR_STD[6:], rtol=0.05)


def test_static_instruments_do_not_change_the_inertia():
    F, motion, commanded = record(2)
    commanded[:, 3:] = 0.0
    result = run_estimator(F, motion, commanded).identification()
    assert result.verdicts[10:] == 6 * ("prior",)
    assert np.isfinite(result.phi).all()


def test_covariance_is_bounded_at_rest():
    F, motion, commanded = record(3)
    estimator = run_estimator(F, motion, commanded, forgetting=0.99)
    s = np.tile([0.0, 0.0, 9.81], (20_000, 1))
    still = OFFSETS + non_contact_wrench(s, 0.0 * s, 0.0 * s, TOOL)
    still += NOISE * np.random.default_rng(0).normal(size=still.shape)
    estimator.update_samples(still, s, 0.0 * s, 0.0 * s, np.hstack([s, 0.0 * s, 0.0 * s]))
    assert np.isfinite(state_of(estimator)).all()
    assert (np.abs(estimator.phi) <= PRIOR_STD[6:]).all()
    deviations = np.sqrt(np.diag(estimator.covariance))
    assert (deviations <= np.array(PRIOR_STD) * (1 + 1e-9)).all()
    assert not estimator.is_settled
    estimator.update_samples(F, *motion, commanded)
    assert estimator.phi[0] == pytest.approx(TOOL[0], abs=0.15)


def test_forgetting_follows_a_new_load():
    thing = np.array([0.5, 0.0, 0.0, 0.06, 0.008, 0.0, 0.0, 0.008, 0.0, 0.001])
    F, motion, commanded = record(4, samples=3000)
    estimator = run_estimator(F, motion, commanded, forgetting=0.995)
    F += non_contact_wrench(*rich_motion(3000), thing)
    estimator.update_samples(F, *motion, commanded)
    assert estimator.phi[0] == pytest.approx(TOOL[0] + 0.5, abs=0.05)


def test_samples_log_and_external_state_give_the_same_result(tmp_path):
    F, motion, commanded = record(5, samples=400)
    log = run_estimator(F, motion, commanded)
    single, elsewhere = (RecursiveInstrumentalVariables(NOISE) for _ in range(2))
    state = np.zeros(16)
    memory = elsewhere.initial_memory(state)
    for sample in zip(F, *motion, commanded, strict=True):
        single.update_samples(*(np.reshape(part, (1, -1)) for part in sample))
        elsewhere.update_into(state, memory, np.concatenate(sample))
    np.testing.assert_array_equal(state_of(single), state_of(log))
    np.testing.assert_array_equal(state, state_of(log))
    np.testing.assert_array_equal(elsewhere.covariance_of(state, memory), log.covariance)
    result = single.identification()
    assert (result.method, result.samples) == ("recursive instrumental variables", 400)
    result.save(tmp_path / "identification.json")
    read = Identification.load(tmp_path / "identification.json")
    np.testing.assert_array_equal(read.phi, result.phi)


def test_error_names_the_invalid_input_and_keeps_the_estimate():
    F, motion, commanded = record(6, samples=50)
    estimator = run_estimator(F, motion, commanded)
    before = state_of(estimator)
    with pytest.raises(DrakeTeleopError, match=r"^instruments: has shape"):
        estimator.update_samples(F, *motion, np.zeros((50, 3)))
    with pytest.raises(DrakeTeleopError, match=r"^instruments: is not finite"):
        estimator.update_samples(F, *motion, np.full((50, 9), np.inf))
    np.testing.assert_array_equal(state_of(estimator), before)
    with pytest.raises(DrakeTeleopError, match="estimator: has not received a sample"):
        RecursiveInstrumentalVariables(NOISE).identification()
