"""Load, delay and frame from a wrench and noisy poses, for a motion in closed form."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from known_motion import GRAVITY_W as DOWN
from known_motion import quaternions
from posed_record import (
    GRAVITY_W,
    LATE,
    PHI,
    SECONDS,
    SHIFT,
    TRUTH,
    TURN,
    UNITS,
    Kind,
    motion_at,
    record,
)

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.rotations import rotation_matrices
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.logs.aligned_log import use_spline_motion_and_flag_edges
from drake_teleop.logs.explained_log import _acceleration_noise_of_splines_m_s2
from drake_teleop.logs.pose_motion.estimate import (
    PoseEstimate,
    _taper_excluding_gaps,
    estimate_from_poses,
)
from drake_teleop.logs.pose_motion.linear_model import (
    NOTHING_REJECTED_NOTE,
    _costs_at_delays,
    find_best_delay_and_cost,
    find_disturbances,
    fit_coefficients,
    fit_linear_model,
    fit_noise_levels,
)
from drake_teleop.logs.pose_motion.poses import Poses
from drake_teleop.logs.pose_motion.rigid import (
    RigidParameters,
    UnitsAndAxes,
    _add_increments,
    _parameter_errors_by_unit_gain_errors,
    _residual_and_derivative,
    _RigidFitData,
    _solve_rigid_fit,
    estimate_position_unit_axes_and_masses,
    fit_rigid,
    motion_transformation_matrix,
)
from drake_teleop.logs.pose_motion.spectra import (
    SIGNAL_RATE_SLICE,
    FitWindow,
    NoiseLevels,
    Spectra,
    WrenchGrid,
    end_taper,
    pose_noise_moments,
    second_moments,
)
from drake_teleop.logs.pose_motion.spectra import exclude_from_taper as exclude_from_taper
from drake_teleop.logs.pose_motion.splines import (
    SPLINE_DEGREE,
    PoseSplines,
    _place_knots,
    _remove_knots_with_too_few_poses,
)
from drake_teleop.logs.read.canonical import Log


@cache
def estimate(kind: Kind) -> PoseEstimate:
    return estimate_from_poses(*record(kind), GRAVITY_W)


def deviations(found: PoseEstimate) -> np.ndarray:
    return (found.theta - TRUTH) / np.sqrt(np.diag(found.covariance))


def test_signals_match_the_motion_with_jitter_and_a_gap():
    t, _, poses = record(Kind(place=0.0, turn=0.0))
    far = (poses.t < 9.0) | (poses.t > 9.6)
    poses = Poses(
        poses.t[far], poses.position[far], poses.quaternion[far]
    ).with_continuous_quaternions()
    zeta = PoseSplines(poses, 0.05).signals(t + LATE, GRAVITY_W)
    known = (t > 0.5) & (t < SECONDS - 0.5) & (np.abs(t - 9.3) > 1.2)
    true = motion_at(t)
    a = true.specific_force - zeta[:, 4:7]
    w = true.omega
    products = np.stack([w[:, i] * w[:, j] for i, j in ((0, 0), (1, 1), (2, 2))], 1)
    mixed = np.stack([w[:, 0] * w[:, 1], w[:, 0] * w[:, 2], w[:, 1] * w[:, 2]], 1)
    gravity = np.einsum("nji,j->ni", true.R_WS, -GRAVITY_W)
    expected = np.hstack([np.ones((len(t), 1)), a, gravity, true.alpha, products, mixed])
    error = np.abs(zeta - expected)[known]
    assert error[:, 0].max() == 0.0
    assert error[:, 4:7].max() < 2e-4
    assert error[:, 1:4].max() < 0.01  # of 2 m/s^2
    assert error[:, 7:10].max() < 0.05  # of 25 rad/s^2
    assert error[:, 10:].max() < 1e-3


@pytest.mark.parametrize(("spacing", "delay"), [(0.05, 0.0), (0.08, 0.013), (0.05, -0.02)])
def test_samples_within_two_knots_of_ends_and_gaps_are_flagged(spacing, delay):
    t, wrench, poses = record(Kind())
    kept = (np.abs(poses.t - 7.3) > 0.3) & (np.abs(poses.t - 12.0) > 0.01)
    poses = Poses(
        poses.t[kept], poses.position[kept], poses.quaternion[kept]
    ).with_continuous_quaternions()
    posed = SimpleNamespace(gravity_W=GRAVITY_W)
    log = Log(t, wrench, *np.zeros((3, len(t), 3)), posed=posed)
    found = SimpleNamespace(delay_s=delay, splines=PoseSplines(poses, spacing))
    moved, flags = use_spline_motion_and_flag_edges(log, found)
    at = moved.t + delay
    gap = np.searchsorted(poses.t, 7.3)
    ends = poses.t[[0, gap - 1, gap, -1]]
    distance = np.abs(at[:, None] - ends).min(axis=1) - 2.0 * spacing
    np.testing.assert_array_equal(flags[distance < -1e-9], True)
    np.testing.assert_array_equal(flags[distance > 1e-9], False)
    assert 20 < flags.sum() < 0.1 * len(t)


@pytest.mark.parametrize("delay", [0.0, 0.2, -0.15])
@pytest.mark.parametrize(("length", "excluded"), [(0.06, False), (0.12, True), (0.7, True)])
def test_400_ms_beside_gaps_of_the_poses_and_lost_samples_have_no_weight(delay, length, excluded):
    t, wrench, poses = record(Kind())
    kept = np.abs(poses.t - 7.0) > 0.5 * length
    poses = Poses(poses.t[kept], poses.position[kept], poses.quaternion[kept])
    gap = np.searchsorted(poses.t, 7.0)
    first, last = poses.t[gap - 1] - delay, poses.t[gap] - delay
    taper = _taper_excluding_gaps(WrenchGrid(t, wrench, 1), poses, np.abs(t - 12.0) < 0.05, delay)
    near = (t > first - 0.399) & (t < last + 0.399)
    assert (taper[near] == 0.0).all() if excluded else taper[near].min() > 0.99
    assert (taper[np.abs(t - 12.0) < 0.05] == 0.0).all()
    far = (t > 2.0) & (t < 18.0) & ((t < first - 1.5) | (t > last + 1.5)) & (np.abs(t - 12.0) > 1.0)
    assert taper[far].min() > 0.99


def test_knots_are_thinned_where_poses_are_too_few():
    """Gaps of all lengths, as on a busy computer, would make the spline undetermined."""
    t = np.cumsum(np.random.default_rng(1).exponential(0.0125, 200))
    knots = _remove_knots_with_too_few_poses(_place_knots(t, 0.0125), t)
    assert (
        np.diff(np.searchsorted(t, knots[SPLINE_DEGREE:-SPLINE_DEGREE])).min() >= 2
        and len(knots) > 80
    )
    assert knots[0] == t[0] and knots[-1] == t[-1]


def test_quaternions_of_other_length_give_the_same_motion():
    t, _, poses = record(Kind(place=0.0, turn=0.0))
    poses = poses.with_continuous_quaternions()
    longer = poses.quaternion * (1.0 + 0.1 * np.sin(3.0 * poses.t))[:, None]
    inside = slice(100, -100)
    signals, same = (
        PoseSplines(x, 0.05).signals(t, GRAVITY_W)[inside]
        for x in (poses, replace(poses, quaternion=longer))
    )
    np.testing.assert_allclose(same, signals, atol=0.01)  # of alpha, 25 rad/s^2


def test_noise_is_estimated_from_the_residual_of_the_splines():
    poses = record(Kind(place=3e-4, turn=7e-4))[2].with_continuous_quaternions()
    place, turn = PoseSplines(poses, 0.05).estimate_pose_noise()
    assert place == pytest.approx(3e-4, rel=0.08)
    assert turn == pytest.approx(7e-4, rel=0.08)


@pytest.mark.parametrize(
    ("rate", "spacing", "noise"), [(100.0, 0.05, 1e-4), (250.0, 0.08, 3e-4), (500.0, 0.04, 1e-5)]
)
def test_noise_of_the_acceleration_of_splines_is_predicted(rate, spacing, noise):
    """The second derivative of splines through positions of pure noise has this deviation."""
    t = np.arange(0.0, 60.0, 1.0 / rate)
    position = noise * np.random.default_rng(1).standard_normal((len(t), 3))
    splines = PoseSplines(Poses(t, position, np.tile([1.0, 0.0, 0.0, 0.0], (len(t), 1))), spacing)
    at = np.arange(2.0, 58.0, 0.002)
    acceleration = np.diff(splines.position(at), 2, axis=0) / 0.002**2
    predicted = _acceleration_noise_of_splines_m_s2(splines)
    assert predicted == pytest.approx(np.sqrt(np.mean(acceleration**2)), rel=0.1)


def test_noise_moments_predict_the_effect_of_noise():
    """Differences of signals with and without noise, over 12 records."""
    kind = Kind(place=0.0, turn=0.0)
    t, wrench, clean = record(kind)
    grid = WrenchGrid.from_samples(t, wrench)
    taper = end_taper(grid.t, 0.5, SECONDS - 0.5)
    window = FitWindow(grid, taper, GRAVITY_W, 8.0)
    splines, bands = PoseSplines(clean.with_continuous_quaternions(), 0.07), window.bands
    spectra = window.spectra_at_delay(splines, 0.0)
    zeta = spectra.motion_signals
    place, turn = 2e-4, 5e-4
    Q = pose_noise_moments(splines, spectra, (place, turn))
    sums = np.zeros_like(Q)
    none, rates = np.zeros((len(bands.frequency), 6)), 2j * np.pi * bands.frequency[:, None]
    for seed in range(12):
        noise = np.random.default_rng(seed).normal(size=(len(clean.t), 6))
        R = rotation_matrices(clean.quaternion, "quaternion_wxyz")
        R = R @ rotation_matrices(turn * noise[:, 3:], "rotation_vector")
        noisy = Poses(
            clean.t, clean.position + place * noise[:, :3], quaternions(R)
        ).with_continuous_quaternions()
        error = PoseSplines(noisy, 0.07).signals(grid.t, GRAVITY_W) - zeta
        spectrum = window.signal_spectrum(error)
        sums += second_moments(bands, spectrum, none, rates * spectrum) / 12
    # Below 2 Hz the motion modulates additional noise from higher frequencies.
    whole = NoiseLevels.white_noise_in_each_group(bands).sums_over_groups
    well = whole(bands.sums_over_bands(bands.frequency)) / whole(bands.half_dof_of_bands) > 2.0
    sums, Q = whole(sums), whole(Q)
    size = np.sqrt(np.einsum("bii,bjj->bij", Q, Q))
    error = np.abs(sums - Q)[well] / np.where(size > 0.0, size, np.inf)[well]
    assert error.max() < 0.45
    both = sums[well], Q[well]
    diagonal, expected = (np.diagonal(x, axis1=1, axis2=2).sum(axis=0) for x in both)
    shown = expected > 0.0
    assert shown[1:16].all() and shown[SIGNAL_RATE_SLICE][1:].all()
    np.testing.assert_allclose(diagonal[shown], expected[shown], rtol=0.15)


finite = st.floats(-1.0, 1.0, allow_subnormal=False)
vector = st.tuples(finite, finite, finite).map(np.array)


@given(vector, vector, vector, vector, vector, vector)
def test_motion_map_is_that_of_a_rigid_body(rho, r, a, minus_g, alpha, w):
    R = rotation_matrices(rho[None], "rotation_vector")[0]
    zeta = np.concatenate(
        [[1.0], a, minus_g, alpha, w * w, [w[0] * w[1], w[0] * w[2], w[1] * w[2]]]
    )
    F = np.arange(6.0)
    z = motion_transformation_matrix(R, r) @ np.concatenate([zeta, F])
    v = R.T @ w
    s = R.T @ (a + minus_g + np.cross(alpha, r) + np.cross(w, np.cross(w, r)))
    expected = [[1.0], F, s, R.T @ alpha, v * v, [v[0] * v[1], v[0] * v[2], v[1] * v[2]]]
    np.testing.assert_allclose(z, np.concatenate(expected), atol=1e-12)


@pytest.mark.slow
@given(vector, vector, st.integers(0, 22))
def test_columns_are_derivatives_of_the_residual(rho, r, k):
    R = rotation_matrices(rho[None], "rotation_vector")[0]
    state = RigidParameters(TRUTH, 1e-3, r, R)
    step = np.zeros(23)
    step[k] = 1e-5
    ahead, behind = (_residual_and_derivative(_add_increments(state, x))[1] for x in (step, -step))
    derivative = (ahead - behind) / 2e-5
    np.testing.assert_allclose(_residual_and_derivative(state)[0][:, k], -derivative, atol=1e-6)


@pytest.mark.parametrize(
    "kind",
    [
        Kind(seed=1),
        Kind(rate=60.0, seed=2),
        Kind(rate=500.0, place=5e-5, turn=1e-4, colour=0.9, seed=3),
    ],
)
def test_load_delay_and_frame_are_within_their_deviations(kind):
    found = estimate(kind)
    assert np.abs(deviations(found)).max() < 3.5
    assert found.delay_s == pytest.approx(LATE, abs=5 * found.delay_std_s)
    assert found.fit.is_rigid and found.rejected.mean() < 0.03 and found.note == ""
    assert not found.frame.is_shifted and not found.frame.is_rotated
    assert found.frame.is_position_known.all() and found.frame.is_rotation_known.all()
    assert np.abs(found.frame.p_SoPo_S / found.frame.position_stds_m).max() < 4.0
    assert np.sqrt(found.covariance[6, 6]) < 1e-3


def test_wrong_pose_frame_is_detected_and_estimated():
    kind = Kind(p_SoPo_S=tuple(SHIFT), turned=True, seed=4)
    found = estimate(kind)
    frame = found.frame
    assert frame.is_shifted and frame.is_rotated
    np.testing.assert_allclose(frame.p_SoPo_S, SHIFT, atol=5 * frame.position_stds_m.max())
    assert frame.position_stds_m.max() < 5e-4
    turn = np.degrees(np.arccos((np.trace(frame.R_SP.T @ TURN) - 1) / 2))
    assert turn < 5 * frame.rotation_stds_deg.max() < 0.2
    assert not found.fit.is_rigid and found.fit.std_inflation_by_misfit > 5.0


def test_deviations_of_the_frame_match_the_scatter():
    found = estimate(Kind(p_SoPo_S=tuple(SHIFT), turned=True, seed=4))
    place = np.empty((3, 6))
    for k in range(6):
        step = np.zeros(23)
        step[17 + k] = 1e-6
        states = [_add_increments(found.free_frame_fit.parameters, x) for x in (step, -step)]
        ahead, behind = (-state.R_PS.T @ state.p_PoSo_P for state in states)
        place[:, k] = (ahead - behind) / 2e-6
    covariance = place @ found.free_frame_fit.covariance[17:, 17:] @ place.T
    np.testing.assert_allclose(found.frame.position_stds_m, np.sqrt(np.diag(covariance)), rtol=1e-5)


def test_noise_of_poses_does_not_bias_the_load():
    """The knots are much too fine, so that accelerations are half noise."""
    t, wrench, poses = record(Kind(place=6e-4, turn=6e-4, seed=11))
    grid, splines = (
        WrenchGrid.from_samples(t, wrench),
        PoseSplines(poses.with_continuous_quaternions(), 0.035),
    )
    taper = end_taper(grid.t, 0.3, SECONDS - 0.3)
    spectra = FitWindow(grid, taper, GRAVITY_W, 12.0).spectra_at_delay(splines, LATE)
    Q = pose_noise_moments(splines, spectra, splines.estimate_pose_noise())
    free, start = np.arange(23) < 17, RigidParameters(np.zeros(16), 0.0, np.zeros(3), np.eye(3))
    inertias = []
    for noise in (Q, np.zeros_like(Q)):
        record_ = _RigidFitData(
            spectra.second_moments_with_rates(),
            noise,
            NoiseLevels.white_noise_in_each_group(spectra.window.bands),
            free,
            fit_coefficients(spectra).noise_power,
        )
        inertias.append(
            _solve_rigid_fit(record_, start).parameters.theta[[10, 13]] / PHI[[4, 7]] - 1.0
        )
    compensated, plain = np.abs(inertias)
    assert (compensated < 0.5 * plain).all()
    assert (compensated < 0.02).all()


@pytest.mark.slow
def test_described_or_estimated_frame_gives_the_load():
    arrays = record(Kind(p_SoPo_S=tuple(SHIFT), turned=True, seed=4))
    declared = estimate_from_poses(*arrays, GRAVITY_W, p_SoPo_S=SHIFT, R_SP=TURN)
    left = estimate_from_poses(*arrays, GRAVITY_W, p_SoPo_S=None, R_SP=None)
    for found in (declared, left):
        assert np.abs(deviations(found)).max() < 3.5
        assert found.fit.is_rigid
    assert not declared.frame.is_shifted and not declared.frame.is_rotated
    np.testing.assert_allclose(left.frame.p_SoPo_S, SHIFT, atol=1e-3)


def test_contact_and_impact_are_rejected():
    t, wrench, poses = record(Kind(seed=5))
    touched = wrench.copy()
    push = (t > 7.0) & (t < 9.5)
    touched[push] += np.array([6.0, -3.0, 12.0, 0.2, 0.3, -0.1]) * np.sin(t[push, None]) ** 2
    touched[(t > 15.0) & (t < 15.02)] += 40.0
    found = estimate_from_poses(t, touched, poses, GRAVITY_W)
    inside = (found.t > 7.1) & (found.t < 9.4)
    assert found.rejected[inside].mean() > 0.8  # no disturbance where the sine is zero
    assert found.rejected[(found.t > 15.0) & (found.t < 15.02)].all()
    assert found.rejected.mean() < 0.2
    assert np.abs(deviations(found)).max() < 3.5


def test_load_is_estimated_with_40_percent_of_the_record_excluded():
    """Ten pieces of 0.8 s give twenty edges, which must not bias the delay."""
    t, wrench, poses = record(Kind(seed=13))
    found = estimate_from_poses(t, wrench, poses, GRAVITY_W, lost=(t % 2.0) < 0.8)
    assert found.delay_s == pytest.approx(LATE, abs=5 * found.delay_std_s)
    assert found.delay_std_s < 3e-4
    assert found.fit.is_rigid and np.abs(deviations(found)).max() < 3.5
    assert np.sqrt(found.covariance[6, 6]) < 2e-3


def test_fixed_taper_keeps_its_place_when_the_delay_changes():
    t, wrench, poses = record(Kind(seed=1))
    grid, splines = (
        WrenchGrid.from_samples(t, wrench),
        PoseSplines(poses.with_continuous_quaternions(), 0.1),
    )
    taper = exclude_from_taper(end_taper(grid.t, 0.3, SECONDS - 0.3), (grid.t % 2.0) < 0.8, grid.dt)
    spectra, there = (
        FitWindow(grid, taper, GRAVITY_W, 20.0).spectra_at_delay(splines, delay)
        for delay in (LATE, LATE + 0.03)
    )
    moved, slight = spectra.with_delay(LATE + 0.03), spectra.with_delay(LATE + 1e-5)
    size = np.abs(spectra.signals).max(axis=0)
    np.testing.assert_allclose(moved.signals / size, there.signals / size, atol=1e-3)
    rates = (slight.signals - spectra.signals) / 1e-5
    expected = second_moments(
        spectra.window.bands, spectra.signals, spectra.window.wrench_spectrum, rates
    )
    scale = np.sqrt(np.einsum("bii,bjj->bij", expected, expected))
    scale[:, 22], scale[:, :, 22] = np.inf, np.inf  # the constant has zero derivative
    np.testing.assert_allclose(
        spectra.second_moments_with_rates() / scale, expected / scale, atol=2e-3
    )


def test_weights_recover_from_a_poor_start():
    """The upper bands contain only noise at 1 mm and 1 mrad."""
    t, wrench, poses = record(Kind(place=1e-3, turn=1e-3, seed=1))
    grid, splines = (
        WrenchGrid.from_samples(t, wrench),
        PoseSplines(poses.with_continuous_quaternions(), 0.1),
    )
    taper = end_taper(grid.t, 0.3, SECONDS - 0.3)
    spectra = FitWindow(grid, taper, GRAVITY_W, 20.0).spectra_at_delay(splines, LATE)
    Q = pose_noise_moments(splines, spectra, splines.estimate_pose_noise())
    start = RigidParameters(np.zeros(16), 0.0, np.zeros(3), np.eye(3))
    fit = fit_rigid(
        spectra.second_moments_with_rates(),
        Q,
        NoiseLevels.white_noise_in_each_group(spectra.window.bands),
        start,
        np.arange(23) < 17,
        fit_coefficients(spectra),
    )
    assert fit.is_rigid
    assert np.abs(fit.parameters.theta[6] - PHI[0]) < 4 * np.sqrt(fit.covariance[6, 6]) < 0.01


def test_coloured_noise_does_not_select_the_finest_knots():
    kind = Kind(place=3e-4, turn=6e-4, rate=250.0, colour=0.95, seed=6)
    assert estimate(kind).splines.spacing >= 0.05


def figures_of(wrench_of_S: np.ndarray, poses: Poses, t: np.ndarray) -> UnitsAndAxes:
    grid, splines = (
        WrenchGrid.from_samples(t, wrench_of_S),
        PoseSplines(poses.with_continuous_quaternions(), 0.1),
    )
    taper = end_taper(grid.t, 0.3, SECONDS - 0.3)
    return estimate_position_unit_axes_and_masses(
        fit_coefficients(FitWindow(grid, taper, GRAVITY_W, 20.0).spectra_at_delay(splines, LATE))
    )


def test_units_axes_and_sign_are_read_off():
    t, wrench, poses = record(Kind(seed=7))
    seen = figures_of(wrench, replace(poses, position=1000.0 * poses.position), t)
    assert seen.position_unit_ratio == pytest.approx(1e-3, abs=5 * seen.position_unit_ratio_std)
    assert seen.position_unit_ratio_std < 2e-5
    np.testing.assert_allclose(seen.axis_masses_kg, 1.7, atol=5 * seen.max_mass_std_kg)
    seen = figures_of(wrench[:, [1, 0, 2, 4, 3, 5]], poses, t)
    assert seen.is_usable and seen.is_mirrored
    np.testing.assert_allclose(seen.R_SP, [[0, 1, 0], [1, 0, 0], [0, 0, 1]], atol=0.01)
    assert seen.position_unit_ratio == pytest.approx(1.0, abs=5 * seen.position_unit_ratio_std)
    np.testing.assert_allclose(figures_of(-wrench, poses, t).R_SP, -np.eye(3), atol=0.01)


def test_planar_gravity_determines_the_unit_but_not_the_axes():
    """The known motion rotates about z and x only, so that gravity in S has no x component."""
    t, _, poses = record(Kind(seed=7))
    true = motion_at(t)
    s = true.specific_force + np.einsum("nji,j->ni", true.R_WS, GRAVITY_W - DOWN)
    noise = 0.01 * np.random.default_rng(7).normal(size=(len(t), 6))
    grid = WrenchGrid.from_samples(t, non_contact_wrench(s, true.omega, true.alpha, PHI) + noise)
    splines, taper = (
        PoseSplines(poses.with_continuous_quaternions(), 0.1),
        end_taper(t[::2], 0.3, SECONDS - 0.3),
    )
    seen = estimate_position_unit_axes_and_masses(
        fit_coefficients(FitWindow(grid, taper, DOWN, 20.0).spectra_at_delay(splines, LATE))
    )
    assert not seen.is_usable
    assert seen.position_unit_ratio == pytest.approx(1.0, abs=0.02)


def test_gain_errors_cause_a_misfit_unless_they_are_stated():
    found = estimate_from_poses(*record(Kind(gain=0.01, seed=8)), GRAVITY_W, gain_std=0.01)
    assert not found.fit.is_rigid
    assert np.abs(deviations(found)).max() < 4.0
    assert np.sqrt(found.covariance[6, 6]) == pytest.approx(0.02, rel=0.5)
    # Stated gain errors enter the deviations only once.
    assert found.fit.is_explained_by_gains and found.fit.std_inflation_by_misfit == 1.0
    assert replace(found.fit, expected_misfit_by_gains=0.0).std_inflation_by_misfit > 3.0


@pytest.mark.slow
def test_stated_gains_explain_only_their_share():
    kind = Kind(gain=0.01, seed=8)
    assert not estimate_from_poses(
        *record(kind), GRAVITY_W, gain_std=0.001
    ).fit.is_explained_by_gains
    turned = Kind(p_SoPo_S=tuple(SHIFT), turned=True, seed=4)
    assert not estimate_from_poses(
        *record(turned), GRAVITY_W, gain_std=0.01
    ).fit.is_explained_by_gains


def test_gain_effects_predict_the_change_of_the_estimate():
    """One gain error changes the estimate by one column of the effects."""
    t, wrench, poses = record(Kind(seed=9))
    grid, splines = (
        WrenchGrid.from_samples(t, wrench),
        PoseSplines(poses.with_continuous_quaternions(), 0.1),
    )
    taper = end_taper(grid.t, 0.3, SECONDS - 0.3)
    spectra = FitWindow(grid, taper, GRAVITY_W, 20.0).spectra_at_delay(splines, LATE)
    Z, levels, free = (
        spectra.second_moments_with_rates(),
        NoiseLevels.white_noise_in_each_group(spectra.window.bands),
        np.ones(23, bool),
    )
    none, start = np.zeros_like(Z), RigidParameters(np.zeros(16), 0.0, np.zeros(3), np.eye(3))
    power = fit_coefficients(spectra).noise_power
    solution = _solve_rigid_fit(_RigidFitData(Z, none, levels, free, power), start)
    effects = _parameter_errors_by_unit_gain_errors(solution, Z).reshape(23, 6, 6)
    size = np.sqrt(np.sum(effects**2, axis=(1, 2)))
    for d, k in ((0, 2), (2, 2), (4, 0), (1, 5)):
        A = np.eye(38)
        A[16 + d, 16 + k] += 1e-3 * UNITS[d, k]
        other = _solve_rigid_fit(
            _RigidFitData(A @ Z @ A.T, none, levels, free, power), solution.parameters
        ).parameters
        moved = 1e3 * (other.theta - solution.parameters.theta)
        np.testing.assert_allclose(moved / size[:16], effects[:16, d, k] / size[:16], atol=0.1)


def test_wandering_channels_are_found_and_get_less_weight():
    """Two of six channels are random walks that equal the white noise at 1.6 Hz."""
    t, wrench, poses = record(Kind(seed=12))
    walk = np.cumsum(np.random.default_rng(12).normal(size=(len(t), 6)), axis=0)
    both, step = np.repeat([0.1, 0.004], 3), 2.0 * np.pi * 1.6 / 200.0
    wrench = wrench + walk * both * step * np.array([0, 0, 1, 1, 0, 0])
    grid, taper = WrenchGrid.from_samples(t, wrench), end_taper(t[::2], 0.3, SECONDS - 0.3)
    splines = PoseSplines(poses.with_continuous_quaternions(), 0.1)
    spectra = FitWindow(grid, taper, GRAVITY_W, 20.0).spectra_at_delay(splines, LATE)
    levels = fit_noise_levels(spectra.second_moments_with_rates(), spectra.window.bands)
    at = (
        spectra.window.bands.sums_over_bands(spectra.window.bands.frequency)
        / spectra.window.bands.half_dof_of_bands
    )
    corner = np.sqrt(levels.relative_power - 1.0)[5] * at[5]
    assert (corner[[2, 3]] > 0.7).all() and (corner[[2, 3]] < 3.3).all()
    np.testing.assert_array_equal(corner[[0, 1, 4, 5]], 0.0)
    power = fit_linear_model(spectra.second_moments_with_rates(), levels).noise_power
    assert (power[0, 2:4] > 30.0 * power[-1, 2:4]).all()
    assert (np.diff(power[levels.group_of_band == 0, 2]) < 0.0).all()


def test_deviations_include_estimated_weights():
    """One offset in white noise in four groups of similar weight: Meier's factor in closed form."""
    n, power = 10.0, 0.3
    levels = NoiseLevels(np.full(4, n), np.arange(4), np.ones((4, 6)))
    Z = np.zeros((4, 38, 38))
    Z[:, 0, 0] = n
    for c in range(6):
        Z[:, 16 + c, 16 + c] = n * power
    start = RigidParameters(np.zeros(16), 0.0, np.zeros(3), np.eye(3))
    best = fit_linear_model(Z, levels)
    fit = fit_rigid(Z, np.zeros_like(Z), levels, start, np.arange(23) == 0, best)
    level = power * n / (n - 0.5 / 4)
    variance = level / (2 * 4 * n) * (1 + 4 * 4 * (1 / 4) * (3 / 4) / (2 * n))
    assert fit.covariance[0, 0] == pytest.approx(variance, rel=1e-3)


@pytest.mark.slow
def test_clock_rate_of_the_poses_is_corrected():
    """The clock drifts by 0.2 ms/s over 20 s; the delay is that at mid-record."""
    t, wrench, poses = record(Kind())
    late = Poses(1.0002 * (poses.t + 50.0) - 50.0, poses.position, poses.quaternion)
    found, plain = estimate_from_poses(t, wrench, late, GRAVITY_W), estimate(Kind())
    assert plain.clock_rate_error == 0.0
    assert found.clock_rate_error == pytest.approx(2e-4, abs=1e-5)
    assert found.delay_s == pytest.approx(LATE + 2e-4 * (50.0 + 10.0), abs=2e-4)
    assert np.sqrt(found.covariance[6, 6] / plain.covariance[6, 6]) < 1.05
    assert np.abs(deviations(found)).max() < 3.5


def test_given_delay_is_kept():
    found = estimate_from_poses(*record(Kind(seed=1)), GRAVITY_W, delay=LATE)
    assert found.delay_s == LATE
    assert found.delay_std_s == 0.0


def test_best_delay_is_found_from_a_distant_start():
    t, wrench, poses = record(Kind(seed=10))
    grid = WrenchGrid.from_samples(t, wrench)
    taper = end_taper(grid.t, 0.5, SECONDS - 0.5)
    spectra = FitWindow(grid, taper, GRAVITY_W, 20.0).spectra_at_delay(
        PoseSplines(poses.with_continuous_quaternions(), 0.07), -0.05
    )
    assert find_best_delay_and_cost(spectra, 0.1)[0] == pytest.approx(LATE, abs=2e-3)


@pytest.mark.parametrize("chopped", [False, True])
def test_costs_of_many_delays_equal_single_costs(chopped):
    t, wrench, poses = record(Kind(seed=10))
    grid = WrenchGrid.from_samples(t, wrench)
    taper = end_taper(grid.t, 0.5, SECONDS - 0.5)
    taper = exclude_from_taper(taper, chopped & (np.abs(grid.t - 5.0) < 0.3), grid.dt)
    spectra = FitWindow(grid, taper, GRAVITY_W, 20.0).spectra_at_delay(
        PoseSplines(poses.with_continuous_quaternions(), 0.07), -0.02
    )
    assert spectra.window.is_taper_fixed is chopped
    delays = np.array([-0.05, -0.02, LATE])
    alone = [fit_coefficients(spectra.with_delay(delay)).cost for delay in delays]
    np.testing.assert_allclose(_costs_at_delays(spectra, delays), alone, rtol=1e-9)


def test_exclude_sets_the_taper_to_zero_with_edges():
    taper = end_taper(np.arange(1000) / 100, 0.0, 10.0)
    lost = np.zeros(1000, bool)
    lost[500] = True
    cut = exclude_from_taper(taper, lost, 0.01)
    assert cut[500] == 0.0 and cut[490] == pytest.approx(0.5, abs=0.01) and cut[475] == 1.0
    assert taper[0] == 0.0 and taper[500] == 1.0


def test_too_little_overlap_raises_error():
    t, wrench, poses = record(Kind(seed=1))
    with pytest.raises(DrakeTeleopError, match="wrench and poses share"):
        estimate_from_poses(t + 100.0, wrench, poses, GRAVITY_W)


@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize(
    ("moving", "push"), [((0.0, 20.0), 4.0), ((0.0, 20.0), 0.0), ((8.0, 12.0), 0.0)]
)
def test_residual_only_where_the_load_moves_rejects_nothing(known, moving, push):
    """The third motion is sensed 50 ms late; a push of 1 s is rejected with a margin."""
    rng, t = np.random.default_rng(0), np.arange(0.0, 20.0, 0.01)
    C, late = rng.normal(size=(6, 16)), 0.05 if moving[1] < 20.0 else 0.0

    def signals(t):
        moves = ((t > moving[0]) & (t < moving[1]))[:, None]
        waves = [np.sin(2.0 * np.pi * f * t + f) for f in (0.3, 0.8, 1.3, 2.0)] + 11 * [0.0 * t]
        return np.column_stack([np.ones(len(t)), moves * np.transpose(waves)])

    wrench = signals(t + late) @ C.T + 0.02 * rng.normal(size=(len(t), 6))
    wrench[(t > 5.0) & (t < 6.0)] += push
    grid = WrenchGrid(t, wrench, 1, C if known else None)
    window = FitWindow(grid, np.ones(len(t)), GRAVITY_W, np.inf)
    spectra = Spectra(window, window.signal_spectrum(signals(t)), 0.0, signals(t))
    rejected, note = find_disturbances(spectra, 0.05)
    assert note == (NOTHING_REJECTED_NOTE if late else "")
    assert rejected[(t > 5.0) & (t < 6.0)].all() == bool(push)
    assert not rejected[(t < 4.6) | (t > 6.4)].any()


T_SMOOTH = (np.arange(180, dtype=np.float32) / np.float32(30)).astype(float)  # as datasets store it
STILL = np.tile([1.0, 0.0, 0.0, 0.0], (180, 1))
PATH = np.stack([0.1 * np.sin(2 * T_SMOOTH), 0 * T_SMOOTH, 0.05 * np.cos(5 * T_SMOOTH)], axis=1)
GAP = (T_SMOOTH < 2.0) | (T_SMOOTH > 3.5)
EXACT_POSITIONS = {
    "zero": 0.0 * PATH,
    "constant": 0.0 * PATH + [0.5, 0.1, 0.3],
    "uniform": np.outer(T_SMOOTH, [0.1, 0.0, 0.0]),
    "rounded to 1 mm": PATH.round(3),
    "moving": PATH,
}


@pytest.mark.parametrize("rows", [slice(None), slice(20), GAP], ids=["whole", "short", "gap"])
@pytest.mark.parametrize("name", EXACT_POSITIONS)
@pytest.mark.parametrize("noise", [0.0, 2e-4])
def test_smooth_splines_of_exact_positions_are_finite(name, rows, noise):
    q = STILL + noise * np.random.default_rng(1).normal(size=STILL.shape)
    poses = Poses(T_SMOOTH[rows], EXACT_POSITIONS[name][rows], q[rows])
    motion = PoseSplines(poses, 2 / 30, smooth=True).motion(T_SMOOTH, np.array([0.0, 0.0, -9.81]))
    assert all(np.isfinite(x).all() for x in motion)
    if name in ("zero", "constant", "uniform") and not noise:
        assert np.abs(motion[0] - [0.0, 0.0, 9.81]).max() < 1e-3


@pytest.mark.parametrize(("noise_m", "largest"), [(2e-5, 0.003), (2e-4, 0.01)])
def test_smooth_splines_follow_the_acceleration_up_to_the_ends(noise_m, largest):
    true = np.stack(
        [-0.4 * np.sin(2 * T_SMOOTH), 0 * T_SMOOTH, -1.25 * np.cos(5 * T_SMOOTH)], axis=1
    )
    inside, ends = [], []
    for seed in range(8):
        noise = noise_m * np.random.default_rng(seed).normal(size=PATH.shape)
        splines = PoseSplines(Poses(T_SMOOTH, PATH + noise, STILL), 2 / 30, smooth=True)
        error = splines.motion(T_SMOOTH, np.zeros(3))[0] - true
        inside.append(error[20:-20])
        ends.append(error[[0, -1]])
    assert np.sqrt(np.mean(np.square(inside))) < largest
    assert np.sqrt(np.mean(np.square(ends))) < 9 * largest
