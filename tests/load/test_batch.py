"""Batch estimators: exact results without noise, rejection, deviations and intervals."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from load_cases import OFFSETS, TOOL, rich_motion, rotations

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.batch.methods import METHODS, _std_growth_by_rejection, identify_batch
from drake_teleop.load.batch.total_least_squares import EstimatorOptions, SampleRecord
from drake_teleop.load.batch.uncertainty import GAIN_ERROR_TORQUE_ARM_M
from drake_teleop.load.identification import Identification
from drake_teleop.load.inertia import (
    is_physically_consistent,
    mass_com_inertia,
    phi_from_mass_com_inertia,
    transform_phi,
)
from drake_teleop.load.normal_equations import NoiseStd, identify
from drake_teleop.load.regressor import non_contact_wrench, regressor
from drake_teleop.station.result import SimulationResult

TRUTH = np.concatenate([OFFSETS, TOOL])
WRENCH_NOISE = np.array([0.3, 0.3, 0.5, 0.01, 0.01, 0.005])
TOOLS = Path(__file__).parents[2] / ".." / "shared" / "data" / "utias_workshop_tools"
sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))


def estimate(result):
    return np.concatenate([result.identification.offsets, result.identification.phi])


def record(samples=2000, noise=0.0, seed=0):
    motion = rich_motion(samples)
    F = OFFSETS + non_contact_wrench(*motion, TOOL)
    return F + noise * WRENCH_NOISE * np.random.default_rng(seed).normal(size=F.shape), *motion


def add_impacts(wrench, seed=0):
    """Add twelve decaying impacts of 20 N and 1 N m; return the wrench and their samples."""
    wrench, hit = wrench.copy(), np.zeros(len(wrench), bool)
    decay = np.exp(-np.arange(30) / 10.0)[:, None]
    for start in np.random.default_rng(seed).integers(0, len(wrench) - 30, 12):
        wrench[start : start + 30] += np.array([20.0, 5.0, -10.0, 0.5, 1.0, 0.2]) * decay
        hit[start : start + 10] = True
    return wrench, hit


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    "noise", [NoiseStd(), NoiseStd(WRENCH_NOISE, s=0.1, omega=0.01, alpha=1.0)]
)
def test_exact_without_noise(method, noise):
    result = identify_batch(*record(), method=method, noise=noise)
    np.testing.assert_allclose(estimate(result), TRUTH, rtol=0, atol=1e-9)
    assert result.identification.identifiable.all()
    assert result.identification.method == METHODS[method].name
    assert not result.rejected.any()


@pytest.mark.slow
@pytest.mark.parametrize("offsets", [True, False])
def test_whitened_is_least_squares_with_the_channels_noise(offsets):
    F, *motion = record(noise=1.0)
    result = identify_batch(F, *motion, method="whitened", noise=NoiseStd(WRENCH_NOISE))
    expected = identify(F, *motion, noise=WRENCH_NOISE)
    np.testing.assert_allclose(estimate(result)[6:], expected.phi, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(result.identification.covariance, expected.covariance, rtol=1e-6)
    np.testing.assert_allclose(result.identification.residual_rms, expected.residual_rms)


def test_ordinary_is_least_squares():
    F, *motion = record(noise=1.0)
    result = identify_batch(F, *motion, method="ordinary")
    np.testing.assert_allclose(estimate(result)[6:], identify(F, *motion).phi, rtol=1e-8)


def test_noise_is_estimated():
    F, *motion = record(noise=1.0)
    result = identify_batch(F, *motion, method="whitened")
    np.testing.assert_allclose(result.noise, WRENCH_NOISE, rtol=0.08)
    given = identify_batch(F, *motion, method="whitened", noise=NoiseStd(WRENCH_NOISE))
    deviations = given.identification.standard_deviations
    assert (np.abs(estimate(result) - estimate(given)) / deviations).max() < 0.2


def test_noise_of_the_wrench_is_estimated_beside_noise_of_the_motion():
    F, s, omega, alpha = record(4000, noise=1.0)
    rng = np.random.default_rng(3)
    arrays = F, s + 0.2 * rng.normal(size=s.shape), omega, alpha + rng.normal(size=s.shape)
    result = identify_batch(*arrays, method="total", noise=NoiseStd(s=0.2, alpha=1.0))
    np.testing.assert_allclose(result.noise[:3], WRENCH_NOISE[:3], rtol=0.15)


def test_robust_fit_rejects_impacts():
    F, *motion = record(3000, noise=1.0)
    undisturbed = identify_batch(F, *motion, method="robust")
    assert undisturbed.rejected.mean() < 2e-3
    knocked, hit = add_impacts(F)
    plain = identify_batch(knocked, *motion, method="whitened")
    robust = identify_batch(knocked, *motion, method="robust")
    assert robust.rejected[hit].all()
    assert robust.rejected.mean() < 0.14  # 12 x 30 samples are 12 %
    deviations = undisturbed.identification.standard_deviations
    shift = np.abs(estimate(robust) - estimate(undisturbed)) / deviations
    assert shift.max() < 3.0
    assert (np.abs(estimate(plain) - estimate(undisturbed)) / deviations).max() > 10.0
    assert robust.identification.samples == (~robust.rejected).sum()


def test_robust_fit_rejects_a_short_contact():
    F, *motion = record(3000, noise=1.0)
    contact = np.zeros(3000, bool)
    contact[900:1350] = True
    F[contact] += [8.0, 0.0, -6.0, 0.0, 0.3, 0.0]
    result = identify_batch(F, *motion, method="robust")
    assert result.rejected[contact].all() and result.rejected[~contact].mean() < 2e-3
    errors = np.abs(estimate(result) - TRUTH) / result.identification.standard_deviations
    assert errors.max() < 4.5


def test_delayed_motion_is_not_rejected():
    """The motion has a delay, and the record rests three quarters of the time."""
    F, s, omega, alpha = record(4000, noise=0.3)
    rests = np.tile(np.repeat([False, True, True, True], 250), 4)
    F[rests] = OFFSETS + non_contact_wrench(s[[0]], [0, 0, 0], [0, 0, 0], TOOL)
    F[rests] += 0.3 * WRENCH_NOISE * np.random.default_rng(5).normal(size=(rests.sum(), 6))
    motion = [np.where(rests[:, None], rest, x) for rest, x in ((s[0], s), (0, omega), (0, alpha))]
    exact = identify_batch(F, *motion)
    assert exact.rejected.mean() < 1e-2 and exact.note == ""
    late = identify_batch(F, *(np.roll(x, 4, axis=0) for x in motion))
    assert not late.rejected.any() and "no sample was rejected" in late.note
    assert late.identification.mass == pytest.approx(TOOL[0], rel=0.05)


def test_deviations_double_for_a_quarter_of_the_samples():
    """The record has no rejected samples."""
    whole = SampleRecord(*record(2000, noise=1.0))
    fit = METHODS["whitened"].fit(whole, EstimatorOptions(NoiseStd(WRENCH_NOISE)))
    assert _std_growth_by_rejection(fit, whole.with_row_step(4).moments) == pytest.approx(
        2.0, rel=0.02
    )
    assert _std_growth_by_rejection(fit, whole.moments) == pytest.approx(1.0)


def test_shared_noise_is_equal_for_all_forces_and_all_torques():
    s = static_poses()
    F = OFFSETS + non_contact_wrench(s, np.zeros(3), np.zeros(3), TOOL)
    F = F + WRENCH_NOISE * np.random.default_rng(3).normal(size=F.shape)
    shared = identify_batch(F, s, np.zeros(3), np.zeros(3), shared_noise=True)
    assert len(set(shared.noise[:3])) == len(set(shared.noise[3:])) == 1
    # At rest forces give mass and torques the first moments: their ratio does not matter.
    plain = identify_batch(F, s, np.zeros(3), np.zeros(3), method="ordinary")
    np.testing.assert_allclose(estimate(shared)[:10], estimate(plain)[:10], rtol=1e-6)


def test_few_samples_are_not_rejected():
    s = static_poses()[:8]
    F = OFFSETS + non_contact_wrench(s, np.zeros(3), np.zeros(3), TOOL)
    F[3] += 5.0
    assert not identify_batch(F, s, np.zeros(3), np.zeros(3)).rejected.any()


def test_default_is_robust_consistent_and_uses_the_noise_of_the_motion():
    plate = phi_from_mass_com_inertia(0.3, [0, 0.01, 0.1], np.diag([1e-3, 2e-3, 3e-3]))
    motion = rich_motion(3000)
    rng = np.random.default_rng(8)
    F, hit = add_impacts(OFFSETS + non_contact_wrench(*motion, plate))
    F = F + 0.1 * WRENCH_NOISE * rng.normal(size=F.shape)
    s, omega, alpha = motion
    alpha = alpha + 2.0 * rng.normal(size=alpha.shape)
    noise = NoiseStd(alpha=2.0)
    found = identify_batch(F, s, omega, alpha, noise=noise)
    assert found.rejected[hit].all() and found.identification.physically_consistent
    errors = {
        method: np.abs(identify_batch(F, s, omega, alpha, method=method, noise=noise)
                       .identification.phi - plate)[4:].max()
        for method in ("whitened", "total", "consistent")
    }  # fmt: skip
    assert errors["consistent"] < 0.4 * min(errors["whitened"], errors["total"])


@pytest.mark.parametrize("method", METHODS)
def test_negative_mass_is_reported(method):
    F, *motion = record(noise=1.0)
    found = identify_batch(-F, *motion, method=method).identification
    assert found.mass == pytest.approx(-TOOL[0], rel=0.01)


def normalised_errors(method, noise, std, repetitions=60, **options):
    clean = record(1000)
    squares = np.zeros(16)
    for seed in range(repetitions):
        rng = np.random.default_rng(seed)
        arrays = [x + e * rng.normal(size=x.shape) for x, e in zip(clean, std, strict=True)]
        result = identify_batch(*arrays, method=method, noise=noise, **options)
        deviations = result.identification.standard_deviations
        squares += ((estimate(result) - TRUTH) / np.where(deviations, deviations, 1.0)) ** 2
    return squares / repetitions


def test_stated_deviations_hold_with_errors_in_variables():
    noise = NoiseStd(WRENCH_NOISE, s=0.1, omega=0.02, alpha=2.0)
    errors = normalised_errors("total", noise, [WRENCH_NOISE, 0.1, 0.02, 2.0])
    assert errors.max() < 2.0
    assert 0.4 < errors.mean() < 1.3


@pytest.mark.slow
def test_stated_deviations_are_not_too_large_where_noise_couples_the_channels():
    """Most noise is that of angular accelerations, which is in force and torque at once."""
    motion, errors = rich_motion(1000), []
    noise = NoiseStd(WRENCH_NOISE, alpha=1.0)
    clean = OFFSETS + non_contact_wrench(*motion, TOOL)
    for seed in range(150):
        rng = np.random.default_rng(seed)
        F = clean + WRENCH_NOISE * rng.normal(size=clean.shape)
        alpha = motion[2] + rng.normal(size=(1000, 3))
        result = identify_batch(F, motion[0], motion[1], alpha, method="total", noise=noise)
        deviations = result.identification.standard_deviations
        errors.append((estimate(result) - TRUTH) / deviations)
    scatter = np.std(errors, axis=0)
    # 150 records give a standard deviation within 6 %. Without the correlation: 0.3 for some.
    assert scatter.min() > 0.8 and scatter.max() < 1.2


def test_consistent_fit_is_the_constrained_total_fit():
    """The record has offsets and noise that correlates the channels."""
    plate = phi_from_mass_com_inertia(0.3, [0, 0.01, 0.1], np.diag([1e-3, 2e-3, 3e-3]))
    motion = rich_motion(1000)
    F = OFFSETS + non_contact_wrench(*motion, plate)
    noise, cost = NoiseStd(WRENCH_NOISE, s=0.3, alpha=3.0), []
    rng = np.random.default_rng(4)
    F = F + WRENCH_NOISE * rng.normal(size=F.shape)
    s, omega, alpha = motion
    s, alpha = s + 0.3 * rng.normal(size=s.shape), alpha + 3.0 * rng.normal(size=s.shape)
    fits = [
        METHODS[m].fit(SampleRecord(F, s, omega, alpha), EstimatorOptions(noise))
        for m in ("total", "consistent")
    ]
    gram, right, free = fits[0].solved[:3]
    found = fits[1].solved.theta
    assert not is_physically_consistent(free[6:]) and is_physically_consistent(found[6:])
    truth = np.concatenate([OFFSETS, plate])
    for theta in (free, found, truth):
        cost.append(theta @ gram @ theta - 2.0 * right @ theta)
    assert cost[0] < cost[1] < cost[2]
    # The offsets are the best for this load.
    np.testing.assert_allclose((gram @ found - right)[:6], 0.0, atol=1e-8 * np.abs(right).max())


def test_known_offsets():
    F, *motion = record(noise=1.0)
    free = identify_batch(F - OFFSETS, *motion)
    known = identify_batch(F - OFFSETS, *motion, offsets=False)
    assert (known.identification.offsets == 0.0).all()
    deviations = known.identification.standard_deviations
    assert (deviations[:6] == 0.0).all()
    # Up to rounding of the noise, which is estimated from another residual.
    assert (deviations[6:] <= 1.001 * free.identification.standard_deviations[6:]).all()
    assert (np.abs(known.identification.phi - TOOL) / deviations[6:]).max() < 4.5


@pytest.mark.parametrize("offsets", [True, False])
@pytest.mark.parametrize("method", ["ordinary", "whitened"])
def test_covariance_of_gains_is_the_sum_of_their_effects(method, offsets):
    F, *motion = record(300)
    F -= 0.0 if offsets else OFFSETS
    noise = NoiseStd(1e-6 * WRENCH_NOISE)

    def solved(F, **stated):
        return identify_batch(F, *motion, method=method, noise=noise, offsets=offsets, **stated)

    expected, length = np.zeros((16, 16)), np.repeat([1.0, GAIN_ERROR_TORQUE_ARM_M], 3)
    for d in range(6):
        for k in range(6):
            wrong = F.copy()
            wrong[:, d] += 0.01 * length[d] / length[k] * F[:, k]
            effect = estimate(solved(wrong)) - estimate(solved(F))
            expected += np.outer(effect, effect)
    exact, stated = (solved(F, gain_std=std).identification.covariance for std in (0.0, 0.01))
    size = np.sqrt(np.diag(expected)) + 1e-12
    np.testing.assert_allclose(
        (stated - exact) / np.outer(size, size), expected / np.outer(size, size), atol=1e-4
    )


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_intervals_cover_the_truth_with_stated_gain_errors(method):
    rng, within, length = np.random.default_rng(4), [], np.repeat([1.0, GAIN_ERROR_TORQUE_ARM_M], 3)
    exact, *motion = record()
    for seed in range(60):
        gains = np.eye(6) + 0.01 * rng.normal(size=(6, 6)) * np.outer(length, 1.0 / length)
        F = (exact - OFFSETS) @ gains.T + record(noise=0.3, seed=seed)[0] - exact
        load = identify_batch(F, *motion, method=method, gain_std=0.01).identification
        within.append(np.abs(load.phi - TOOL) < 1.96 * load.standard_deviations[6:])
    share = np.mean(within, axis=0)
    assert (share > 0.85).all() and share.mean() > 0.93


@pytest.mark.parametrize("method", METHODS)
def test_static_poses_do_not_determine_the_inertia(method):
    s = record(50)[1]
    F = OFFSETS + non_contact_wrench(s, np.zeros(3), np.zeros(3), TOOL)
    F = F + 0.1 * WRENCH_NOISE * np.random.default_rng(1).normal(size=F.shape)
    result = identify_batch(F, s, np.zeros(3), np.zeros(3), method=method).identification
    assert result.identifiable.tolist() == 10 * [True] + 6 * [False]
    assert np.isinf(result.standard_deviations[10:]).all()
    assert result.mass == pytest.approx(TOOL[0], rel=0.01)
    assert method != "consistent" or result.physically_consistent


@pytest.mark.parametrize("method", ["total", "consistent"])
def test_noise_does_not_count_as_excitation(method):
    s = np.repeat(static_poses(), 100, axis=0)
    rng = np.random.default_rng(2)
    F = OFFSETS + non_contact_wrench(s, np.zeros(3), np.zeros(3), TOOL)
    F = F + WRENCH_NOISE * rng.normal(size=F.shape)
    motion = [x + e * rng.normal(size=s.shape) for x, e in ((s, 0.06), (0.0, 0.002), (0.0, 1.5))]
    noise = NoiseStd(s=0.06, omega=0.002, alpha=1.5)
    result = identify_batch(F, *motion, method=method, noise=noise).identification
    assert result.identifiable.tolist() == 10 * [True] + 6 * [False]
    assert result.mass == pytest.approx(TOOL[0], rel=0.005)
    np.testing.assert_allclose(result.com, TOOL[1:4] / TOOL[0], atol=1e-3)
    assert np.abs(result.phi[4:]).max() < 0.1


def static_poses():
    up = np.random.default_rng(1).normal(size=(24, 3))
    return 9.81 * up / np.linalg.norm(up, axis=1, keepdims=True)


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
@settings(max_examples=10, deadline=None)
@given(rotation=rotations(), seed=st.integers(0, 1000), force=st.floats(0.1, 10.0))
def test_order_frame_and_units_do_not_matter(method, rotation, seed, force):
    isotropic = np.repeat([0.3, 0.01], 3)
    noise = NoiseStd(isotropic, s=0.1, omega=0.01, alpha=1.0)
    F, *motion = record(300, noise=1.0, seed=seed)

    def phi(wrench, motion, noise):
        return identify_batch(wrench, *motion, method=method, noise=noise).identification.phi

    expected, scale = phi(F, motion, noise), np.repeat([1.0, 0.1, 0.01], [1, 3, 6])
    order = np.random.default_rng(seed).permutation(300)
    shuffled = phi(F[order], [x[order] for x in motion], noise)
    np.testing.assert_allclose(shuffled / scale, expected / scale, rtol=0, atol=1e-7)
    # Forces in other units scale the load by the same factor.
    other = NoiseStd(force * isotropic, s=0.1, omega=0.01, alpha=1.0)
    scaled = phi(force * F, motion, other) / force
    np.testing.assert_allclose(scaled / scale, expected / scale, rtol=0, atol=1e-6)
    if method not in ("robust", "consistent"):  # these methods treat each axis separately
        turned = (F.reshape(-1, 2, 3) @ rotation.T).reshape(-1, 6)
        back = phi(turned, [x @ rotation.T for x in motion], noise)
        back = transform_phi(back, rotation.T, np.zeros(3))
        np.testing.assert_allclose(back / scale, expected / scale, rtol=0, atol=1e-6)


def test_result_of_each_method_is_saved_and_loaded(tmp_path):
    for method in METHODS:
        result = identify_batch(*record(200, noise=1.0), method=method).identification
        result.save(tmp_path / "identification.json")
        loaded = Identification.load(tmp_path / "identification.json")
        np.testing.assert_array_equal(loaded.phi, result.phi)
        assert loaded.method == METHODS[method].name


@pytest.mark.parametrize("what", ["complex", "masked"])
def test_complex_and_masked_numbers_are_refused(what):
    wrench, *motion = record(50, noise=1.0)
    other = wrench + 0j if what == "complex" else np.ma.masked_greater(wrench, 1.0)
    with pytest.raises(DrakeTeleopError, match=rf"wrench: contains no real numbers \({what}\)"):
        identify_batch(other, *motion)
    with pytest.raises(DrakeTeleopError, match=rf"t: contains no real numbers \({what}\)"):
        SimulationResult(other[:, 0], {}, [])
    kept = identify_batch(np.ma.array(wrench), *motion)  # no element is masked
    np.testing.assert_array_equal(
        kept.identification.phi, identify_batch(wrench, *motion).identification.phi
    )


def test_error_names_the_invalid_input():
    arrays = record(20)
    with pytest.raises(DrakeTeleopError, match=r"^method: there is no estimator 'guess'"):
        identify_batch(*arrays, method="guess")
    with pytest.raises(DrakeTeleopError, match=r"^gain_std: -.* is negative; give 0 or more"):
        identify_batch(*arrays, gain_std=-0.01)
    with pytest.raises(DrakeTeleopError, match="2 samples cannot determine"):
        identify_batch(*(x[:2] for x in arrays))
    with pytest.raises(DrakeTeleopError, match="the mass cannot be identified"):
        identify_batch(np.zeros((20, 6)), *arrays[1:])
    with pytest.raises(DrakeTeleopError, match=r"^wrench: is not finite at index"):
        identify_batch(np.full((20, 6), np.nan), *arrays[1:])


# ---- the UTIAS workshop tools


@pytest.fixture(scope="module")
def utias():
    import utias

    if not TOOLS.is_dir():
        pytest.skip("needs the UTIAS tools, which the project does not ship")
    return utias


@pytest.mark.parametrize("method", METHODS)
def test_load_of_each_workshop_tool_is_exact_without_noise(utias, method):
    for file in sorted(TOOLS.glob("*.npz")):
        *arrays, phi = utias.load(file)
        found = identify_batch(*arrays, method=method).identification.phi
        mass, com, inertia = utias.errors(found, phi)
        com /= np.linalg.norm(mass_com_inertia(phi)[1])
        assert max(mass, com, inertia) < 1e-6, file.stem


@pytest.mark.slow
def test_workshop_tools_are_identified_with_the_published_protocol(utias):
    for level, methods in utias.run(TOOLS, seeds=3).items():
        *errors, consistent = methods["consistent"]
        assert (np.array(errors) <= utias.TARGETS[level][:3]).all(), (level, errors)
        assert consistent == 100.0
        assert (np.array(errors[1:]) < np.array(methods["ordinary"][1:3]) / 2.5).all()


def test_intervals_cover_the_truth_with_drifting_offsets():
    """Drift of the offsets causes most of the low-frequency noise in 40 records."""
    motion = rich_motion(1500)
    clean = non_contact_wrench(*motion, TOOL)
    steps = WRENCH_NOISE / 120
    bent = np.array([4e-4, 4e-4, 4e-4, 4e-3, 4e-3, 4e-3])  # of s and alpha
    errors = {0.0: [], 1.0: []}
    for seed in range(40):
        rng = np.random.default_rng(seed)
        offsets = OFFSETS + np.cumsum(steps * rng.normal(size=clean.shape), axis=0)
        F = clean + offsets + WRENCH_NOISE * rng.normal(size=clean.shape)
        truth = np.concatenate([offsets[0], TOOL])
        wandering = np.cumsum(bent * rng.normal(size=(1500, 6)), axis=0)
        seen = motion[0] + wandering[:, :3], motion[1], motion[2] + wandering[:, 3:]
        for walk in errors:
            noise = NoiseStd(WRENCH_NOISE, walk=walk * np.concatenate([steps, bent]))
            result = identify_batch(F, *seen, method="total", noise=noise)
            deviations = result.identification.standard_deviations
            errors[walk].append((estimate(result) - truth) / deviations)
    held = {walk: np.mean(np.abs(ratios) < 1.96) for walk, ratios in errors.items()}
    assert held[0.0] < 0.7
    assert 0.92 < held[1.0] < 0.98


def test_covariance_of_drifting_offsets_is_a_double_sum():
    """Compare with the covariance min(i, j) of a random walk, with a rejected sample."""
    F, *motion = record(60, noise=1.0)
    F[20, 0] += 1e3
    steps = np.array([0.3, 0.1, 0.2, 0.01, 0.02, 0.005, 0.1, 0.2, 0.1, 0.3, 1.0, 2.0])
    with_walk, without = (
        identify_batch(F, *motion, method="robust", noise=NoiseStd(WRENCH_NOISE, walk=walk))
        for walk in (steps, 0.0)
    )
    kept = ~with_walk.rejected
    assert not kept[20]
    count = np.arange(60.0)[kept]
    walked = np.minimum(count[:, None], count)
    # Effect of steps of s and alpha on the wrench of this load.
    found = with_walk.identification.phi
    still, units = np.zeros((3, 3)), np.eye(3)
    by_s, by_alpha = (
        non_contact_wrench(*m, found) for m in ((units, still, still), (still, still, units))
    )
    covariance = np.diag(steps[:6] ** 2)
    covariance += by_s.T * steps[6:9] ** 2 @ by_s + by_alpha.T * steps[9:] ** 2 @ by_alpha
    rows = np.zeros((kept.sum(), 6, 16))
    rows[:, :, :6] = np.eye(6)
    rows[:, :, 6:] = regressor(*(table[kept] for table in motion))
    weighted = rows * with_walk.equations._weights[:, None]
    inverse = np.linalg.inv(np.einsum("nci,ncj->ij", rows, weighted))
    expected = np.einsum("nci,nm,mdj,cd->ij", weighted, walked, weighted, covariance)
    added = with_walk.identification.covariance - without.identification.covariance
    np.testing.assert_allclose(added, inverse @ expected @ inverse, rtol=1e-6, atol=1e-12)


def test_negative_random_walk_is_refused():
    with pytest.raises(DrakeTeleopError, match=r"noise\.walk: has the negative value -"):
        NoiseStd(walk=[-1.0] * 12)


@pytest.mark.parametrize("value", [1e300, -1.1e30])
@pytest.mark.parametrize("index", range(4))
def test_too_large_values_are_an_error_with_their_index(value, index):
    """The products of larger values overflow, and the eigenvalues of the Gram matrix fail."""
    rng = np.random.default_rng(0)
    motion = [rng.normal(size=(50, 3)) for _ in range(3)]
    arrays = [non_contact_wrench(*motion, TOOL), *motion]
    arrays[index] = np.array(arrays[index])
    arrays[index][7, 2] = value
    name = ("wrench", "s", "omega", "alpha")[index]
    with pytest.raises(DrakeTeleopError, match=rf"^{name}: is -?1\S* at index \(7, 2\), outside"):
        identify(*arrays)
    arrays[index][7, 2] = np.copysign(1e30, value)
    assert np.isfinite(identify(*arrays).mass)


@pytest.mark.parametrize("delay", [np.nan, -np.inf, 1e31])
def test_delay_of_a_fit_is_a_time(delay):
    rng = np.random.default_rng(0)
    motion = [rng.normal(size=(50, 3)) for _ in range(3)]
    wrench = non_contact_wrench(*motion, TOOL)
    assert identify(wrench, *motion, delay_s=0.02).delay_s == 0.02
    with pytest.raises(DrakeTeleopError, match=r"^delay_s: is "):
        identify(wrench, *motion, delay_s=delay)
