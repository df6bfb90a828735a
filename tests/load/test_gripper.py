"""Load of gripper and object: difference, covariance and consistency, Eq. (14)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.identification import Identification, consistency_margin, load_of_object
from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.load.normal_equations import identify
from drake_teleop.load.regressor import non_contact_wrench

GRIPPER = phi_from_mass_com_inertia(1.2, [0.0, 0.01, 0.05], np.diag([0.004, 0.004, 0.002]))
OBJECT = phi_from_mass_com_inertia(0.7, [0.01, -0.02, 0.16], np.diag([0.003, 0.002, 0.002]))
NOISE = np.array([0.2, 0.2, 0.2, 0.02, 0.02, 0.02])


def estimate(phi: np.ndarray, seed: int, samples: int = 400, noise: float = 1.0) -> Identification:
    rng = np.random.default_rng(seed)
    s, omega, alpha = (rng.normal(size=(samples, 3)) * size for size in (9.0, 2.0, 15.0))
    wrench = non_contact_wrench(s, omega, alpha, phi) + noise * NOISE * rng.normal(
        size=(samples, 6)
    )
    return identify(wrench, s, omega, alpha, noise=NOISE)


def test_the_difference_has_the_object_and_the_sum_of_the_covariances() -> None:
    total, gripper = estimate(GRIPPER + OBJECT, 1), estimate(GRIPPER, 2)
    found = load_of_object(total, gripper)
    assert np.abs((found.phi - OBJECT) / found.standard_deviations[6:]).max() < 4
    expected = total.covariance[6:, 6:] + gripper.covariance[6:, 6:]
    np.testing.assert_allclose(found.covariance[6:, 6:], expected, rtol=1e-12)
    np.testing.assert_array_equal(found.covariance[:6], total.covariance[:6])
    assert found.identifiable.all() and found.physically_consistent


def test_errors_have_the_stated_covariance() -> None:
    scores = []
    for seed in range(60):
        found = load_of_object(
            estimate(GRIPPER + OBJECT, 2 * seed), estimate(GRIPPER, 2 * seed + 1)
        )
        scores.append((found.phi - OBJECT) / found.standard_deviations[6:])
    # The rms of 60 normal numbers with unit variance is 1 +- 0.09; this allows four of that.
    np.testing.assert_allclose(np.sqrt(np.mean(np.square(scores), axis=0)), 1.0, atol=0.37)


def test_object_is_saved_and_loaded(tmp_path) -> None:
    found = load_of_object(estimate(GRIPPER + OBJECT, 1), estimate(GRIPPER, 2))
    found.save(tmp_path / "object.json")
    again = Identification.load(tmp_path / "object.json")
    np.testing.assert_array_equal(again.covariance, found.covariance)
    np.testing.assert_array_equal(again.phi, found.phi)


def test_parameters_undetermined_for_the_gripper_are_undetermined_for_the_object() -> None:
    rng = np.random.default_rng(3)
    s = rng.normal(size=(30, 3)) * 9
    rest = np.zeros((30, 3))
    wrench = non_contact_wrench(s, rest, rest, GRIPPER) + 0.1 * NOISE * rng.normal(size=(30, 6))
    gripper = identify(wrench, s, rest, rest)
    found = load_of_object(estimate(GRIPPER + OBJECT, 1), gripper)
    assert found.identifiable.tolist() == [True] * 10 + [False] * 6
    assert np.isinf(np.diag(found.covariance)[10:]).all()
    assert consistency_margin(found)[1] == np.inf


@pytest.mark.parametrize(("of_total", "of_gripper"), [(0, 3), (3, 0), (6, 15), (12, 12)])
def test_only_a_prior_of_the_grippers_load_dominates_that_of_the_object(
    of_total: int, of_gripper: int
) -> None:
    """The offsets of the object are those of the record with the object."""
    total, gripper = (
        replace(estimate(phi, seed), prior_dominated=np.arange(16) == k)
        for phi, seed, k in ((GRIPPER + OBJECT, 1, of_total), (GRIPPER, 2, of_gripper))
    )
    expected = {of_total} | ({of_gripper} if of_gripper >= 6 else set())
    assert set(np.flatnonzero(load_of_object(total, gripper).prior_dominated)) == expected


@pytest.mark.parametrize(
    ("withdrawn", "identified"), [((6, 16), 6), ((6, 7), 6), ((8, 9), 6), ((0, 6), 16)]
)
def test_object_is_not_identified_if_the_gripper_is_withdrawn(
    withdrawn: tuple[int, int], identified: int
) -> None:
    """Findings about a record withdraw its precise load; the offsets are those of the total."""
    total, gripper = estimate(GRIPPER + OBJECT, 1), estimate(GRIPPER, 2)
    known = gripper.identifiable.copy()
    known[slice(*withdrawn)] = False
    found = load_of_object(total, replace(gripper, identifiable=known))
    assert found.identifiable.tolist() == [True] * identified + [False] * (16 - identified)
    assert set(found.verdicts[identified:]) <= {"weakly"}


def test_an_imprecise_gripper_does_not_withdraw_a_precise_object() -> None:
    gripper = estimate(0.05 * GRIPPER, 2)
    uncertain = replace(gripper, covariance=900.0 * gripper.covariance)
    uncertain = replace(uncertain, identifiable=np.zeros(16, bool))
    assert load_of_object(estimate(0.05 * GRIPPER + OBJECT, 1), uncertain).identifiable[6]


def test_exchanged_files_are_an_error() -> None:
    total, gripper = estimate(GRIPPER + OBJECT, 1), estimate(GRIPPER, 2)
    with pytest.raises(DrakeTeleopError, match=r"-0\.7\d* kg for the object.*gripper alone"):
        load_of_object(gripper, total)
    with pytest.raises(DrakeTeleopError, match="0 kg"):
        load_of_object(total, total)


def test_margin_distinguishes_possible_and_impossible_bodies() -> None:
    total, gripper = estimate(GRIPPER + OBJECT, 1), estimate(GRIPPER, 2)
    margin, deviation = consistency_margin(load_of_object(total, gripper))
    assert margin > 3 * deviation > 0
    impossible = OBJECT - np.array([0, 0, 0, 0, 0.018, 0, 0, 0, 0, 0])  # I_xx far too small
    margin, deviation = consistency_margin(
        load_of_object(estimate(GRIPPER + impossible, 1), gripper)
    )
    assert margin < -3 * deviation < 0


def test_margin_of_a_negative_mass_is_far_below_zero() -> None:
    load = estimate(OBJECT, 1)
    margin, deviation = consistency_margin(replace(load, phi=-load.phi))
    assert margin < -0.5  # of four eigenvalues with the sum -2
    assert deviation == pytest.approx(consistency_margin(load)[1], rel=10.0)


def test_deviation_of_the_margin_equals_its_scatter() -> None:
    pairs = [consistency_margin(estimate(OBJECT, seed)) for seed in range(80)]
    margins, deviations = np.array(pairs).T
    # 80 seeds give a standard deviation within 8 %.
    assert margins.std(ddof=1) == pytest.approx(np.median(deviations), rel=0.3)


def test_degrees_of_freedom_are_those_of_a_sum_of_variances() -> None:
    total, gripper = estimate(GRIPPER + OBJECT, 1), estimate(GRIPPER, 2)
    total = replace(total, degrees_of_freedom=np.full(16, 20.0))
    gripper = replace(
        gripper, degrees_of_freedom=np.full(16, 20.0), covariance=total.covariance.copy()
    )
    found = load_of_object(total, gripper)
    # Two equal variances with 20 degrees each have 40; only the total has offsets.
    np.testing.assert_allclose(found.degrees_of_freedom, [20.0] * 6 + [40.0] * 10)
    given = replace(total, degrees_of_freedom=np.full(16, np.inf))
    assert np.isinf(load_of_object(given, with_half_phi(given)).degrees_of_freedom).all()


def with_half_phi(load: Identification) -> Identification:
    return replace(load, phi=load.phi / 2)
