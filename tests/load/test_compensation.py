"""Scaling law of the load and its consequences."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from load_cases import OFFSETS, TOOL, loads, motions, rich_motion, vectors

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.compensation import (
    contact_wrench,
    scaled_wrench,
    scaled_wrench_into,
    scales_from_eta,
)
from drake_teleop.load.regressor import non_contact_wrench, regressor

scales = st.floats(0.0, 10.0)
NAMES = ("sigma_gripper", "sigma_object", "gamma")


def named(*values):
    return dict(zip(NAMES, values, strict=True))


@pytest.mark.slow
@given(vectors(6, 100.0), motions(), loads(), loads(), scales, scales, scales)
def test_law_equals_that_of_the_paper(F, motion, gripper, thing, sigma_gr, sigma_obj, gamma):
    V = regressor(*motion)
    F_c = F - OFFSETS - V @ (gripper + thing)
    expected = gamma * F_c + V @ (sigma_gr * gripper + sigma_obj * thing)
    actual = scaled_wrench(F, OFFSETS, *motion, gripper, thing, **named(sigma_gr, sigma_obj, gamma))
    np.testing.assert_allclose(actual, expected, rtol=1e-10, atol=1e-7)


@pytest.mark.slow
@given(vectors(6, 100.0), motions(), loads())
def test_elimination_leaves_the_contact(contact, motion, phi):
    F = contact + OFFSETS + non_contact_wrench(*motion, phi)
    np.testing.assert_allclose(contact_wrench(F, OFFSETS, *motion, phi), contact, atol=1e-8)


@given(vectors(6, 100.0), motions(), vectors(10), vectors(10), scales)
def test_equal_scales_make_the_load_irrelevant(F, motion, wrong_phi, other_phi, scale):
    actual = scaled_wrench(F, OFFSETS, *motion, wrong_phi, other_phi, **named(scale, scale, scale))
    np.testing.assert_array_equal(actual, scale * (F - OFFSETS))


@given(vectors(6, 100.0), motions(), loads(), loads(), st.floats(0.0, 1.0))
def test_eta_is_equation_14(F, motion, gripper, thing, eta):
    by_eq_14 = contact_wrench(F, OFFSETS, *motion, gripper + (1.0 - eta) * thing)
    by_scales = scaled_wrench(F, OFFSETS, *motion, gripper, thing, **named(*scales_from_eta(eta)))
    np.testing.assert_allclose(by_scales, by_eq_14, rtol=1e-10, atol=1e-8)
    F_c = contact_wrench(F, OFFSETS, *motion, gripper + thing)
    kept = eta * non_contact_wrench(*motion, thing)
    np.testing.assert_allclose(by_scales, F_c + kept, rtol=1e-10, atol=1e-7)


@given(motions(), loads(), scales)
def test_apparent_load_is_sigma_times_the_load(motion, phi, sigma):
    free = OFFSETS + non_contact_wrench(*motion, phi)
    felt = scaled_wrench(free, OFFSETS, *motion, phi, np.zeros(10), **named(sigma, 0.0, 1.0))
    np.testing.assert_allclose(felt, non_contact_wrench(*motion, sigma * phi), atol=1e-7)


def test_offsets_are_subtracted_and_never_scaled():
    motion = rich_motion(5)
    F = non_contact_wrench(*motion, TOOL)
    for values in [(0.0, 0.0, 1.0), (0.5, 0.5, 2.0), (1.5, 0.0, 0.3)]:
        with_offsets = scaled_wrench(
            F + OFFSETS, OFFSETS, *motion, TOOL, 0 * TOOL, **named(*values)
        )
        without = scaled_wrench(F, np.zeros(6), *motion, TOOL, 0 * TOOL, **named(*values))
        np.testing.assert_allclose(with_offsets, without, atol=1e-12)


def test_one_sample_and_many_are_the_same_to_the_last_bit():
    motion, thing = rich_motion(20), 0.1 * TOOL
    F = non_contact_wrench(*motion, TOOL) + np.arange(6)
    drifting = OFFSETS + np.linspace(0.0, 1.0, 20)[:, None]
    many = scaled_wrench(F, drifting, *motion, TOOL, thing, **named(0.3, 0.7, 1.2))
    for i, sample in enumerate(zip(*motion, strict=True)):
        out = np.full(6, np.nan)
        scaled_wrench_into(F[i], drifting[i], *sample, TOOL, thing, 0.3, 0.7, 1.2, out)
        np.testing.assert_array_equal(many[i], out)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("value", [-0.1, np.nan, np.inf])
def test_negative_scales_raise(name, value):
    values = {**named(1.0, 1.0, 1.0), name: value}
    with pytest.raises(DrakeTeleopError, match=f"^{name}: .* is not a finite number >= 0"):
        scaled_wrench(np.zeros(6), OFFSETS, *np.zeros((3, 3)), TOOL, TOOL, **values)


@pytest.mark.parametrize("eta", [-0.01, 1.01, np.nan])
def test_eta_outside_0_to_1_raises(eta):
    with pytest.raises(DrakeTeleopError, match=r"^eta: .* is outside 0 to 1"):
        scales_from_eta(eta)


def test_error_names_the_invalid_input():
    with pytest.raises(DrakeTeleopError, match=r"^wrench: has shape \(5,\)"):
        contact_wrench(np.zeros(5), OFFSETS, *np.zeros((3, 3)), TOOL)
    with pytest.raises(DrakeTeleopError, match=r"^offsets: is not finite"):
        contact_wrench(np.zeros(6), np.full(6, np.nan), *np.zeros((3, 3)), TOOL)


GRAVITY = np.array([1.2, -7.5, 6.1])


@given(vectors(6, 100.0), motions(), loads(), loads(), vectors(3, 10.0), scales, scales, scales)
def test_weight_and_inertia_have_separate_scales(F, motion, gripper, thing, g, weight, inertia, c):
    s, omega, alpha = motion
    phi, rest = gripper + thing, np.zeros(3)
    parts = (
        c * contact_wrench(F, OFFSETS, *motion, phi)
        + weight * non_contact_wrench(-g, rest, rest, phi)
        + inertia * non_contact_wrench(s + g, omega, alpha, phi)
    )
    found = scaled_wrench(
        F, OFFSETS, *motion, gripper, thing, **named(0.3, 0.4, c),
        sigma_weight=weight, sigma_inertia=inertia, gravity=g,
    )  # fmt: skip
    np.testing.assert_allclose(found, parts, rtol=1e-9, atol=1e-6)


@pytest.mark.parametrize("given", ["sigma_weight", "sigma_inertia"])
def test_other_share_is_the_remainder_of_each_part(given):
    motion, thing, g = rich_motion(5), 0.1 * TOOL, np.tile(GRAVITY, (5, 1))
    rest, F = np.zeros((5, 3)), np.ones((5, 6))
    free = {"sigma_gripper": 0.3, "sigma_object": 0.8, "gamma": 1.5, "gravity": GRAVITY}
    found = scaled_wrench(F, OFFSETS, *motion, TOOL, thing, **free, **{given: 0.5})
    weight = non_contact_wrench(-g, rest, rest, TOOL), non_contact_wrench(-g, rest, rest, thing)
    same = scaled_wrench(F, OFFSETS, *motion, TOOL, thing, **named(0.3, 0.8, 1.5))
    if given == "sigma_weight":
        expected = same + (0.5 - 0.3) * weight[0] + (0.5 - 0.8) * weight[1]
    else:
        halves = scaled_wrench(F, OFFSETS, *motion, TOOL, thing, **named(0.5, 0.5, 1.5))
        expected = halves + (0.3 - 0.5) * weight[0] + (0.8 - 0.5) * weight[1]
    np.testing.assert_allclose(found, expected, atol=1e-11)


@pytest.mark.parametrize("gravity", [None, GRAVITY])
def test_equal_shares_are_sigma_to_the_last_bit(gravity):
    motion, F = rich_motion(20), np.ones((20, 6))
    sigma = scaled_wrench(F, OFFSETS, *motion, TOOL, 0 * TOOL, **named(0.3, 0.3, 1.2))
    apart = scaled_wrench(
        F, OFFSETS, *motion, TOOL, 0 * TOOL, **named(2.0, 4.0, 1.2),
        sigma_weight=0.3, sigma_inertia=0.3, gravity=gravity,
    )  # fmt: skip
    assert sigma.tobytes() == apart.tobytes()


@pytest.mark.parametrize("shape", [(3,), (1, 3), (4, 3), (2, 4, 3)])
def test_one_sample_with_several_gravities_is_scaled_for_each(shape):
    gravity = np.random.default_rng(1).normal(size=shape)
    found = scaled_wrench(
        np.zeros(6), np.zeros(6), *np.zeros((3, 3)), TOOL, 0 * TOOL, **named(0.0, 0.0, 1.0),
        sigma_weight=0.5, sigma_inertia=0.0, gravity=gravity,
    )  # fmt: skip
    expected = 0.5 * non_contact_wrench(-gravity, np.zeros(3), np.zeros(3), TOOL)
    np.testing.assert_allclose(found, expected, atol=1e-14)


def test_different_shares_need_gravity():
    with pytest.raises(DrakeTeleopError, match=r"gravity: is unknown.*; pass gravity"):
        scaled_wrench(
            np.zeros(6), OFFSETS, *np.zeros((3, 3)), TOOL, TOOL, **named(1.0, 1.0, 1.0),
            sigma_weight=0.5,
        )  # fmt: skip
    with pytest.raises(DrakeTeleopError, match=r"sigma_inertia: .* is not a finite number >= 0"):
        scaled_wrench(
            np.zeros(6), OFFSETS, *np.zeros((3, 3)), TOOL, TOOL, **named(1.0, 1.0, 1.0),
            sigma_inertia=-0.5,
        )  # fmt: skip
