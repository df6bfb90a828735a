"""Batch least squares: exact without noise, stated deviations with it, measured static poses."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from load_cases import OFFSETS, TOOL, rich_motion

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.identification import PARAMETER_NAMES, Identification
from drake_teleop.load.normal_equations import SecondMoments, _pseudo_inverse, identify
from drake_teleop.load.regressor import non_contact_wrench, regressor

DATA = Path(__file__).parents[2] / ".." / "shared" / "data"
TRUTH = np.concatenate([OFFSETS, TOOL])
NOISE = np.array([0.3, 0.3, 0.5, 0.01, 0.01, 0.005])
REST = np.zeros(3)


def estimate(result):
    return np.concatenate([result.offsets, result.phi])


def record(samples, seed=0):
    motion = rich_motion(samples, seed)
    return OFFSETS + non_contact_wrench(*motion, TOOL), motion


def static_poses(samples=24, seed=0):
    """Return the specific force in random orientations."""
    up = np.random.default_rng(seed).normal(size=(samples, 3))
    return 9.81 * up / np.linalg.norm(up, axis=1, keepdims=True)


def about_one_axis(samples=500):
    """Return a swing about the horizontal axis y of S through So."""
    t = np.linspace(0.0, 10.0, samples)
    angle = np.cos(t)
    s = 9.81 * np.stack([np.sin(angle), 0 * t, np.cos(angle)], axis=1)
    turning = np.array([0.0, 1.0, 0.0])
    return s, np.outer(-np.sin(t), turning), np.outer(-np.cos(t), turning)


@pytest.mark.parametrize("noise", [None, NOISE])
def test_exact_without_noise(noise):
    F, motion = record(2000)
    result = identify(F, *motion, noise=noise, delay_s=0.006)
    np.testing.assert_allclose(estimate(result), TRUTH, rtol=0, atol=1e-9)
    assert result.identifiable.all() and result.physically_consistent
    assert result.residual_rms.max() < 1e-5
    assert (result.method, result.samples) == ("batch least squares", 2000)
    assert result.delay_s == 0.006


def test_same_as_the_stacked_matrix():
    F, motion = record(300)
    F = F + np.random.default_rng(1).normal(size=F.shape) * NOISE
    stacked = np.concatenate([np.tile(np.eye(6), (300, 1, 1)), regressor(*motion)], axis=2)
    rows = (stacked / NOISE[:, None]).reshape(-1, 16)
    expected = np.linalg.lstsq(rows, (F / NOISE).ravel(), rcond=None)[0]
    result = identify(F, *motion, noise=NOISE)
    np.testing.assert_allclose(estimate(result), expected, rtol=0, atol=1e-10)
    residual = F - stacked @ expected
    np.testing.assert_allclose(result.residual_rms, np.sqrt((residual**2).mean(axis=0)), rtol=1e-6)
    singular = np.linalg.svd(rows / np.linalg.norm(rows, axis=0), compute_uv=False)
    assert result.condition_number == pytest.approx(singular[0] / singular[-1], rel=1e-9)


def test_result_is_independent_of_chunks_and_order():
    F, motion = record(3000)
    F = F + np.random.default_rng(2).normal(size=F.shape) * NOISE
    whole = identify(F, *motion, noise=NOISE)
    in_chunks = SecondMoments(NOISE)
    for part in np.split(np.arange(3000), [1, 2, 700, 701, 2222]):
        in_chunks.add_samples(F[part], *(x[part] for x in motion))
    in_chunks.add_samples(F[:0], *(x[:0] for x in motion))
    chunked = in_chunks.solve()
    np.testing.assert_allclose(estimate(chunked), estimate(whole), rtol=0, atol=1e-12)
    np.testing.assert_allclose(chunked.covariance, whole.covariance, rtol=1e-9, atol=1e-15)
    shuffled = np.random.default_rng(3).permutation(3000)
    other = identify(F[shuffled], *(x[shuffled] for x in motion), noise=NOISE)
    np.testing.assert_allclose(estimate(other), estimate(whole), rtol=0, atol=1e-12)
    np.testing.assert_allclose(other.residual_rms, whole.residual_rms, rtol=1e-9)


def normalised_errors(noise_of, repetitions=60, samples=4000):
    """Return the mean square of error / stated standard deviation for each parameter."""
    F, motion = record(samples)
    squares = np.zeros(16)
    for seed in range(repetitions):
        noise = NOISE * noise_of(np.random.default_rng(seed), samples)
        result = identify(F + noise, *motion, noise=NOISE)
        squares += ((estimate(result) - TRUTH) / result.standard_deviations) ** 2
    return squares / repetitions


def test_variances_of_channels_follow_from_their_residuals():
    """Weights differ from the noise, so that noise of a channel leaves residuals in others."""
    rng, n = np.random.default_rng(7), 90
    weights, variances = rng.uniform(0.5, 2.0, 6), rng.uniform(2.0, 3.0, 6)
    A = rng.normal(size=(6, n, 16))
    grams = np.einsum("cni,cnj->cij", A, A)
    inverse = np.linalg.inv(np.einsum("c,cij->ij", weights, grams))
    # Residual of each channel by the noise of each: r = (1 - A (A^T W A)^-1 A^T W) e.
    rows = A.reshape(6 * n, 16)
    left = np.eye(6 * n) - rows @ inverse @ rows.T * np.repeat(weights, n)
    power = (left**2).reshape(6, n, 6, n).sum(axis=(1, 3)) @ variances
    equations = SecondMoments(weights**-0.5)
    found, degrees, _ = equations._unbiased_residual_variances(power, n, grams, grams, inverse)
    np.testing.assert_allclose(found, variances, rtol=1e-9)
    assert degrees.sum() == pytest.approx(6 * n - 16)


def test_stated_deviations_hold_for_white_noise():
    errors = normalised_errors(lambda rng, n: rng.normal(size=(n, 6)))
    # The expected value is 1; each is the mean of 60 squares with a scatter of 0.18.
    assert errors.max() < 1.6
    assert 0.8 < errors.mean() < 1.2


@pytest.mark.slow
def test_stated_deviations_hold_for_coloured_noise():
    def coloured(rng, n):
        white, noise = rng.normal(size=(n, 6)), np.zeros((n, 6))
        for i in range(1, n):
            noise[i] = 0.95 * noise[i - 1] + white[i]
        return noise * np.sqrt(1.0 - 0.95**2)

    errors = normalised_errors(coloured)
    # Under the assumption of white noise this would be about (1 + 0.95) / (1 - 0.95) = 39.
    assert errors.max() < 2.0
    assert 0.6 < errors.mean() < 1.4


def test_unweighted_fit_has_separate_deviations_of_force_and_torque():
    F, motion = record(4000)
    squares = np.zeros(16)
    for seed in range(40):
        noise = NOISE * np.random.default_rng(seed).normal(size=F.shape)
        result = identify(F + noise, *motion)
        squares += ((estimate(result) - TRUTH) / result.standard_deviations) ** 2
    assert (squares / 40).max() < 1.8
    assert 0.7 < squares.mean() / 40 < 1.3


@pytest.mark.slow
def test_static_poses_determine_all_but_the_inertia():
    s = static_poses()
    rng = np.random.default_rng(4)
    F = OFFSETS + non_contact_wrench(s, REST, REST, TOOL) + 0.1 * NOISE * rng.normal(size=(24, 6))
    result = identify(F, s, REST, REST)
    assert result.identifiable.tolist() == 10 * [True] + 6 * [False]
    np.testing.assert_array_equal(result.phi[4:], np.zeros(6))
    assert np.isinf(result.standard_deviations[10:]).all()
    assert np.isfinite(result.standard_deviations[:10]).all()
    assert np.abs(estimate(result) - TRUTH)[:10].max() < 0.1
    assert result.condition_number < 5.0


def test_angles_from_rounding_do_not_count_as_excitation():
    s = static_poses()
    rounding = 1e-13 * np.random.default_rng(5).normal(size=(24, 3))
    F = OFFSETS + non_contact_wrench(s, REST, REST, TOOL)
    result = identify(F, s, rounding, rounding)
    assert result.identifiable.tolist() == 10 * [True] + 6 * [False]


def test_one_axis_determines_only_the_excited_parameters():
    motion = about_one_axis()
    result = identify(OFFSETS + non_contact_wrench(*motion, TOOL), *motion)
    unknown = {
        n for n, known in zip(PARAMETER_NAMES, result.identifiable, strict=True) if not known
    }
    assert unknown == {"I_xx", "I_xz", "I_zz"}
    known = result.identifiable
    np.testing.assert_allclose(estimate(result)[known], TRUTH[known], rtol=0, atol=1e-9)


def test_one_pose_determines_no_mass():
    s = np.tile([0.0, 0.0, 9.81], (50, 1))
    F = OFFSETS + non_contact_wrench(s, REST, REST, TOOL)
    result = identify(F, s, REST, REST)
    # The minimum norm solution reproduces the wrench; one pose determines few parameters.
    predicted = result.offsets + non_contact_wrench(s, REST, REST, result.phi)
    np.testing.assert_allclose(predicted, F, atol=1e-9)
    known = {n for n, known in zip(PARAMETER_NAMES, result.identifiable, strict=True) if known}
    assert known <= {"f_ox", "f_oy", "tau_oz"}
    assert not result.identifiable[6:].any()


def test_slow_motion_in_noise_does_not_determine_the_inertia():
    s, omega, alpha = about_one_axis()
    F = OFFSETS + non_contact_wrench(s, omega, alpha, TOOL)
    rng = np.random.default_rng(6)
    wobble = np.cumsum(rng.normal(size=F.shape), axis=0)
    F = F + NOISE * (wobble - wobble.mean(axis=0)) / wobble.std(axis=0)
    result = identify(F, s, omega, alpha)
    assert result.identifiable[[0, 1, 2, 6]].all()
    assert not result.identifiable[10:].any()


def test_wrong_sign_gives_a_negative_mass():
    F, motion = record(500)
    result = identify(-F, *motion)
    assert result.mass == pytest.approx(-TOOL[0])
    assert not result.physically_consistent
    np.testing.assert_allclose(result.com, TOOL[1:4] / TOOL[0])


def test_measured_static_poses_give_the_load():
    path = DATA / "ntnu_fts_imu_contact" / "0-calibration_fts-accel.csv"
    if not path.is_file():
        pytest.skip("needs the NTNU static poses, which the project does not ship")
    table = np.genfromtxt(path, delimiter=",", skip_header=1)
    wrench, g = -table[:, :6], table[:, 9:12]  # wrench of the load on the sensor
    result = identify(wrench, -g, REST, REST)
    assert result.samples == 24
    assert result.mass == pytest.approx(0.9323, abs=0.0005)
    assert result.com[2] == pytest.approx(0.04390, abs=0.0001)
    expected = -np.array([9.0765, -1.0181, 9.9848, 0.4325, -0.6916, -0.1570])
    np.testing.assert_allclose(result.offsets, expected, rtol=0, atol=0.01)
    assert result.identifiable.tolist() == 10 * [True] + 6 * [False]


# ---- the file


def are_equal(a: Identification, b: Identification) -> bool:
    return all(np.array_equal(getattr(a, n), getattr(b, n)) for n in Identification.__annotations__)


@pytest.mark.parametrize("poses_only", [False, True])
def test_saved_identification_is_loaded_unchanged(tmp_path, poses_only):
    s = static_poses()
    F = OFFSETS + non_contact_wrench(s, REST, REST, TOOL)
    result = identify(F, s, REST, REST) if poses_only else identify(record(99)[0], *record(99)[1])
    path = tmp_path / "identification.json"
    result.save(path)
    assert are_equal(Identification.load(path), result)
    document = json.loads(path.read_text())
    assert set(document) == {
        *("phi", "offsets", "covariance", "identifiable", "mass", "com", "inertia_com"),
        *("physically_consistent", "condition_number", "delay_s", "residual_rms", "method"),
        *("samples", "verdicts", "degrees_of_freedom", "prior_dominated"),
        "weight_removed",
    }
    assert document["mass"] == result.mass
    nulls = [i for i in range(16) if document["covariance"][i][i] is None]
    assert nulls == (list(range(10, 16)) if poses_only else [])


def remove_field(name):
    return lambda document: document.pop(name)


def set_field(name, value):
    return lambda document: document.update({name: value})


def remove_covariance_entry(document):
    document["covariance"][0][1] = None


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (remove_field("phi"), "json:phi: is missing"),
        (remove_field("delay_s"), "json:delay_s: is missing"),
        (set_field("weight", 3.0), "json:weight: is not a field"),
        (set_field("phi", [1.0] * 9), r"json:phi: has shape \(9,\) instead of \(10,\)"),
        (set_field("phi", [float("nan")] * 10), "json:phi: is not finite"),
        (set_field("phi", None), "json:phi: "),
        (set_field("phi", [0.0] * 10), "json:phi: .* not identified"),
        (set_field("offsets", ["a"] * 6), "json:offsets: has values that are not numbers"),
        (set_field("covariance", [[1.0] * 16] * 15), "json:covariance: is not a"),
        (set_field("covariance", [[1.0] * 16] * 15 + [[1.0]]), "json:covariance: is not a"),
        (remove_covariance_entry, "json:covariance: has values that are not numbers"),
        (set_field("identifiable", [True] * 15), "json:identifiable: is not a list"),
        (set_field("identifiable", ["yes"] * 16), "json:identifiable: is not a list"),
        (set_field("mass", 99.0), "json:mass: contradicts phi"),
        (set_field("com", [0.0, 0.0]), "json:com: has shape"),
        (set_field("physically_consistent", False), "json:physically_consistent: contradicts"),
        (set_field("method", ["guess"]), "json:method: is not a text"),
        (set_field("samples", "many"), "json:samples: has values that are not numbers"),
    ],
)
def test_damaged_file_raises(tmp_path, spoil, message):
    path = tmp_path / "identification.json"
    identify(record(99)[0], *record(99)[1]).save(path)
    document = json.loads(path.read_text())
    spoil(document)
    path.write_text(json.dumps(document))
    with pytest.raises(DrakeTeleopError, match=message):
        Identification.load(path)


def test_load_of_zeros_is_refused():
    found = identify(record(99)[0], *record(99)[1])
    with pytest.raises(DrakeTeleopError, match=r"phi: .* not identified"):
        replace(found, phi=np.zeros(10))
    with pytest.raises(DrakeTeleopError, match=r"offsets: has shape \(10,\)"):
        replace(found, offsets=np.zeros(10))


def test_a_load_is_printed_in_eight_lines_with_units():
    lines = str(identify(record(99)[0], *record(99)[1])).splitlines()
    assert len(lines) == 8
    assert lines[0] == "batch least squares, 99 samples: 16 of 16 parameters identified"
    for line, unit in zip(
        lines[1:], ["kg", "m", "kg m^2", "kg m^2", "N", "N m", "N m"], strict=True
    ):
        assert unit in line.split("  ")[-1]
    assert lines[1].startswith(f"  mass              {TOOL[0]:.4g} +- ")


def test_undetermined_parameters_are_printed_without_a_number():
    """Poses at rest do not determine the inertia."""
    s = static_poses()
    text = str(identify(non_contact_wrench(s, REST, REST, TOOL), s, REST, REST))
    assert "10 of 16 parameters identified, I_xx not, I_xy not" in text
    assert "[?, ?, ?] kg m^2" in text and "+- ?" not in text


def test_unreadable_file_raises(tmp_path):
    with pytest.raises(DrakeTeleopError, match=r"absent\.json: cannot be read"):
        Identification.load(tmp_path / "absent.json")
    for text, message in [("{", "is not JSON"), ("[1]", "is not a JSON object")]:
        (tmp_path / "bad.json").write_text(text)
        with pytest.raises(DrakeTeleopError, match=rf"bad\.json: {message}"):
            Identification.load(tmp_path / "bad.json")
    (tmp_path / "binary.json").write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(DrakeTeleopError, match=r"binary\.json: is not UTF-8 text"):
        Identification.load(tmp_path / "binary.json")


# ---- bad input


def test_error_names_the_invalid_input():
    F, motion = record(10)
    with pytest.raises(DrakeTeleopError, match=r"^wrench: has shape \(10, 5\)"):
        identify(F[:, :5], *motion)
    with pytest.raises(DrakeTeleopError, match=r"^wrench, s, omega, alpha: the numbers of"):
        identify(F[:9], *motion)
    with pytest.raises(DrakeTeleopError, match=r"^wrench: is not finite at index \(3, 0\)"):
        identify(np.where(np.arange(10)[:, None] == 3, np.nan, F), *motion)
    with pytest.raises(DrakeTeleopError, match=r"^noise: has the value .*, which is not positive"):
        identify(F, *motion, noise=[1, 1, 1, 0, 1, 1])
    with pytest.raises(DrakeTeleopError, match=r"^wrench: 2 samples cannot determine a load"):
        identify(F[:2], *(x[:2] for x in motion))
    with pytest.raises(DrakeTeleopError, match="the mass cannot be identified"):
        identify(np.zeros((10, 6)), *motion)


@pytest.mark.parametrize(("rest", "known"), [(4.0, False), (50.0, True)])
def test_parameters_are_determined_relative_to_the_largest_eigenvalue(rest, known):
    """Sixteen almost equal columns: the largest eigenvalue is 16, the others are `rest`."""
    gram = np.ones((16, 16)) + rest * 1e-12 * np.eye(16)
    undetermined = _pseudo_inverse(gram, np.zeros(16, dtype=bool))[1]
    assert np.all(undetermined != known)
