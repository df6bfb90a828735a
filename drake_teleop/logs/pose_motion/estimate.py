"""Load, delay and pose frame from a wrench and poses (docs/theory.md)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array, finite_array, one_blas_thread
from drake_teleop.common.vectors import cross_matrix
from drake_teleop.logs.pose_motion import linear_model, rigid, spectra
from drake_teleop.logs.pose_motion.imu_correction import correct_imu_data
from drake_teleop.logs.pose_motion.linear_model import find_disturbances
from drake_teleop.logs.pose_motion.poses import ImuData, Poses
from drake_teleop.logs.pose_motion.rigid import RigidFit, RigidParameters, UnitsAndAxes
from drake_teleop.logs.pose_motion.spectra import FitWindow, Spectra, WrenchGrid
from drake_teleop.logs.pose_motion.splines import PoseSplines, SplineCache

_MAX_DELAY_SEARCH_RECORD_SPAN_S = 120.0
MIN_REPORTED_FRAME_SHIFT_M, MAX_KNOWN_FRAME_SHIFT_STD_M = 0.01, 0.02
"""Least shift that is reported, and largest standard deviation of a known one [m]."""
MIN_REPORTED_FRAME_ROTATION_DEG, MAX_KNOWN_FRAME_ROTATION_STD_DEG = 5.0, 1.0
"""Least rotation that is reported, and largest standard deviation of a known one [deg]."""
_MIN_FRAME_ERROR_WALD_STATISTIC, _MIN_FRAME_ERROR_OVER_STD = 50.0, 5.0
_MAX_FIT_FREQUENCY_OVER_SAMPLE_RATE = 0.45
# Least gap that splines cannot bridge, and excluded margin beside it [s].
_MIN_EXCLUDED_POSE_GAP_S, _GAP_MARGIN_S = 0.1, 0.4
_MIN_SHARED_INSTANTS, _MIN_SHARED_INSTANTS_WITH_KNOWN_LOAD = 100, 32
_MAX_ORIGIN_SENSITIVITY = 1e-3  # by undetermined parameters
_IDENTITY_ROTATION = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@dataclass(frozen=True, eq=False)
class PoseFrame:
    """Estimated frame P of the recorded poses, relative to the sensor frame S.

    Attributes:
        p_SoPo_S: (3,) origin of P from So, in S [m].
        R_SP: (3, 3) rotation from axes of P to those of S.
        position_stds_m: (3,) standard deviations of `p_SoPo_S` [m]; inf if undetermined.
        rotation_stds_deg: (3,) standard deviations of R_SP about the axes of S [deg].
        is_shifted, is_rotated: True if the origin, or the axes, differ clearly from the given ones.
    """

    p_SoPo_S: Array
    R_SP: Array
    position_stds_m: Array
    rotation_stds_deg: Array
    is_shifted: bool
    is_rotated: bool

    @property
    def is_position_known(self) -> NDArray[np.bool_]:
        """Flags (3,): True if the standard deviation in `p_SoPo_S` is below 2 cm."""
        return np.asarray(self.position_stds_m < MAX_KNOWN_FRAME_SHIFT_STD_M)

    @property
    def is_rotation_known(self) -> NDArray[np.bool_]:
        """Flags (3,): True if the standard deviation in `R_SP` is below 1 degree."""
        return np.asarray(self.rotation_stds_deg < MAX_KNOWN_FRAME_ROTATION_STD_DEG)


@dataclass(frozen=True, eq=False)
class PoseMotion:
    """Motion from splines of poses, with knots and delay that fit a wrench best.

    Attributes:
        splines: splines of the poses, on the wrench's clock.
        delay_s, delay_std_s: delay of the motion behind the wrench, and its standard
            deviation [s]; inf if undetermined.
        clock_rate_error: relative rate error of the poses' clock, such as 5e-5; 0 if insignificant.
        is_imu_consistent_with_poses: whether an IMU agrees with the poses; True without one.
    """

    splines: PoseSplines
    delay_s: float
    delay_std_s: float
    clock_rate_error: float
    is_imu_consistent_with_poses: bool


@dataclass(frozen=True, eq=False)
class PoseEstimate(PoseMotion):
    """Load, delay and pose frame from a wrench and poses.

    Attributes:
        fit: fit with the origin and axes of the pose frame that are given.
        free_frame_fit: fit with an estimated pose frame, `frame`.
        units_and_axes: position unit, axes and masses that a linear model implies.
        t, rejected: (M,) instants [s], and flags, True at disturbances.
        note: text if disturbances could not be rejected.
    """

    fit: RigidFit
    frame: PoseFrame
    free_frame_fit: RigidFit
    units_and_axes: UnitsAndAxes
    t: Array
    rejected: NDArray[np.bool_]
    note: str

    @property
    def theta(self) -> Array:
        """Estimated [offsets; phi] (16,) [SI]."""
        return self.fit.parameters.theta

    @property
    def covariance(self) -> Array:
        return self.fit.covariance[:16, :16]


def estimate_from_poses(
    t: ArrayLike,
    wrench: ArrayLike,
    poses: Poses,
    gravity_W: ArrayLike,
    *,
    p_SoPo_S: ArrayLike | None = (0.0, 0.0, 0.0),
    R_SP: ArrayLike | None = _IDENTITY_ROTATION,
    delay: float | None = None,
    gain_std: float = 0.0,
    lost: NDArray[np.bool_] | None = None,
    imu: ImuData | None = None,
) -> PoseEstimate:
    """Estimate load, sensor offsets, delay and pose frame P from a wrench and poses of P.

    The wrench (N, 6) at equidistant `t` is [f; tau] on the load, in S about So [N, N m]. Each of
    `p_SoPo_S` [m], `R_SP` and the delay of the poses behind the wrench [s] is estimated if None,
    else kept. `gain_std` is the standard deviation of the sensor gains. Samples with `lost` True
    are excluded. IMU data of S are used if they fit the wrench better.
    """
    with one_blas_thread():
        grid = WrenchGrid.from_samples(t, wrench)
        found, _, window = _fit_pose_splines_and_delay(grid, poses, gravity_W, delay, lost, imu)
        splines, late = found.splines, found.delay_s
        window = replace(window, taper=_taper_excluding_gaps(grid, splines.poses, lost, late))
        rejected, note = find_disturbances(window.spectra_at_delay(splines, late), splines.spacing)
        window = replace(window, taper=spectra.exclude_from_taper(window.taper, rejected, grid.dt))
        final = window.spectra_at_delay(splines, late)
        Z = final.second_moments_with_rates()
        Q = spectra.pose_noise_moments(splines, final, splines.estimate_pose_noise())
        levels = linear_model.fit_noise_levels(Z, window.bands)
        best = linear_model.fit_linear_model(Z, levels)

        def fit_rigid_from(start: RigidParameters, free: NDArray[np.bool_]) -> RigidFit:
            return rigid.fit_rigid(Z, Q, levels, start, free, best, gain_std=gain_std)

        seen = rigid.estimate_position_unit_axes_and_masses(best)
        has_axes = seen.is_usable and not seen.is_mirrored
        R = np.eye(3) if R_SP is None else np.asarray(R_SP, float).T
        R = seen.R_SP.T if R_SP is None and has_axes else R
        p = np.zeros(3) if p_SoPo_S is None else np.asarray(p_SoPo_S, float)
        start = RigidParameters(np.zeros(16), 0.0, -R @ p, R)
        fit_free = np.ones(rigid.NUM_RIGID_PARAMETERS, bool)
        fit_free[16] = delay is None
        fit_free[rigid.LEVER_PARAMETERS] = p_SoPo_S is None
        fit_free[rigid.ROTATION_PARAMETERS] = R_SP is None
        fit = free = fit_rigid_from(start, fit_free)
        if p_SoPo_S is not None or R_SP is not None:
            first = fit.parameters
            if has_axes and np.trace(seen.R_SP @ start.R_PS) < 2.9:
                origin = seen.R_SP.T @ start.R_PS.T @ start.p_PoSo_P
                first = RigidParameters(np.zeros(16), first.delay_s, origin, seen.R_SP.T)
            free = fit_rigid_from(first, fit_free | (np.arange(len(fit_free)) > 16))
        std = float(np.sqrt(min(x.covariance[16, 16] for x in (fit, free))))
        found = replace(found, delay_s=late + fit.parameters.delay_s, delay_std_s=std)
        return PoseEstimate(
            **vars(found),
            fit=fit,
            frame=_pose_frame_from_free_fit(free, start),
            free_frame_fit=free,
            units_and_axes=seen,
            t=grid.t,
            rejected=rejected,
            note=note,
        )


def fit_motion_to_load(
    t: ArrayLike,
    wrench: ArrayLike,
    poses: Poses,
    gravity_W: ArrayLike,
    coefficients: Array,
    *,
    delay: float | None = None,
    lost: NDArray[np.bool_] | None = None,
    imu: ImuData | None = None,
) -> PoseMotion:
    """Return the motion from poses of S with which a load fits a wrench best.

    `coefficients` (6, 16) are the load's, Eq. (T73). Other arguments as for `estimate_from_poses`.
    """
    with one_blas_thread():
        grid = WrenchGrid.from_samples(t, wrench, coefficients)
        motion, last, _ = _fit_pose_splines_and_delay(grid, poses, gravity_W, delay, lost, imu)
        return replace(motion, delay_std_s=linear_model.delay_std(last) if delay is None else 0.0)


def _fit_pose_splines_and_delay(
    grid: WrenchGrid,
    poses: Poses,
    gravity_W: ArrayLike,
    delay: float | None,
    lost: NDArray[np.bool_] | None,
    imu: ImuData | None,
) -> tuple[PoseMotion, Spectra, FitWindow]:
    gravity, poses = finite_array("gravity_W", gravity_W, 3), poses.with_continuous_quaternions()
    known, guess = delay is not None, delay or 0.0
    taper = _taper_excluding_gaps(grid, poses, lost, guess)
    usable = int((taper > 0.5).sum())
    free_load = grid.known_load is None
    fewest = _MIN_SHARED_INSTANTS if free_load else _MIN_SHARED_INSTANTS_WITH_KNOWN_LOAD
    if usable < fewest:
        what = f"wrench and poses share {usable} instants, {grid.dt:.2g} s apart"
        what += f" ({fewest} required, without pose gaps above {_MIN_EXCLUDED_POSE_GAP_S} s"
        remedy = "record both at the same time, longer, without interruptions, above 10 Hz"
        raise DrakeTeleopError(f"{what} and {_GAP_MARGIN_S} s beside each gap)", remedy=remedy)
    slower = min(poses.rate, grid.stride / grid.dt)
    top = min(spectra.MAX_FREQUENCY_HZ, _MAX_FIT_FREQUENCY_OVER_SAMPLE_RATE * slower)
    whole = FitWindow(grid, taper, gravity, top)
    part = whole.select_and_taper_rows(_rows_with_largest_force_variance(grid))
    margin = 2 * spectra.DELAY_SEARCH_HALF_RANGE_S
    near = (poses.t >= part.grid.t[0] - margin) & (poses.t <= part.grid.t[-1] + margin)
    near_poses = Poses(poses.t[near], poses.position[near], poses.quaternion[near])
    cache = linear_model.spline_cache_of_averaged_poses(near_poses)
    spacing, late = linear_model.guess_knot_spacing_and_delay(part, cache, guess, fixed=known)
    first = part.spectra_at_delay(PoseSplines(near_poses, spacing), late)
    disturbed = find_disturbances(first, spacing)[0]
    part = replace(part, taper=spectra.exclude_from_taper(part.taper, disturbed, grid.dt))
    rate = 0.0 if known else linear_model.estimate_clock_rate_error(part, cache, late, spacing)
    if rate:
        near_poses = linear_model.correct_clock_rate(near_poses, rate, part.grid, late)
        poses = linear_model.correct_clock_rate(poses, rate, part.grid, late)
        cache = linear_model.spline_cache_of_averaged_poses(near_poses)
    choices, imu_rows, imu_spacing = [cache], None, spacing
    if imu is not None:
        imu_rows = correct_imu_data(PoseSplines(near_poses, imu_spacing), imu, gravity)
        choices += [] if imu_rows is None else [SplineCache(cache.poses, imu_rows)]
    agrees = imu is None or imu_rows is not None
    chosen, spacing, late = linear_model.choose_knot_spacing_and_delay(
        part, choices, late, fixed=known
    )
    imu_rows = chosen.imu_rows
    if imu_rows is not None and imu is not None and len(near_poses.t) < len(poses.t):
        imu_rows = correct_imu_data(PoseSplines(poses, imu_spacing), imu, gravity)
    last = part.spectra_at_delay(chosen.splines_with_spacing(spacing), late)
    splines = PoseSplines(poses, spacing, imu_rows)
    return PoseMotion(splines, last.delay, np.inf, rate, agrees), last, whole


def _rows_with_largest_force_variance(grid: WrenchGrid) -> slice:
    rows, length = len(grid.t), round(_MAX_DELAY_SEARCH_RECORD_SPAN_S / grid.dt)
    if rows <= length:
        return slice(0, rows)
    coarse, parts = grid.wrench[:: grid.stride], range(0, rows - length, length // 2)
    first = max(parts, key=lambda k: float(np.var(coarse[k : k + length], axis=0)[:3].sum()))
    return slice(first, first + length)


def _taper_excluding_gaps(
    grid: WrenchGrid, poses: Poses, lost: NDArray[np.bool_] | None, delay: float
) -> Array:
    stamps = poses.t - delay
    start, stop = max(grid.t[0], stamps[0]), min(grid.t[-1], stamps[-1])
    if stop - start < 1.0:
        return np.zeros(len(grid.t))
    taper = spectra.end_taper(grid.t, start, stop)
    bad = np.zeros(len(grid.t), bool)
    if lost is not None:
        rows = len(grid.t) * grid.stride
        bad |= lost[:rows].reshape(-1, grid.stride).any(axis=1)
    for k in np.flatnonzero(np.diff(stamps) > _MIN_EXCLUDED_POSE_GAP_S):
        bad |= (grid.t > stamps[k] - _GAP_MARGIN_S) & (grid.t < stamps[k + 1] + _GAP_MARGIN_S)
    return spectra.exclude_from_taper(taper, bad, grid.dt, grid.dt)


def _pose_frame_from_free_fit(free: RigidFit, described: RigidParameters) -> PoseFrame:
    R_SP, r = free.parameters.R_PS.T, free.parameters.p_PoSo_P
    origin = -R_SP @ r
    covariance = free.covariance[17:, 17:]
    # p = -R^T r, and R exp([rho x]) changes it to p - rho x p.
    jacobian = np.hstack([-R_SP, cross_matrix(origin)])
    known = np.isfinite(np.diag(covariance))
    finite = np.where(known[:, None] & known, covariance, 0.0)
    deviations = np.sqrt(np.diag(jacobian @ finite @ jacobian.T))
    if not known.all():
        lost = np.abs(jacobian[:, ~known]).max(axis=1) > _MAX_ORIGIN_SENSITIVITY
        deviations = np.where(lost, np.inf, deviations)
    moved = free.parameters.p_PoSo_P - described.p_PoSo_P
    turned = Rotation.from_matrix(described.R_PS.T @ free.parameters.R_PS).as_rotvec()
    change = np.concatenate([moved, turned])[known]
    wald = float(change @ np.linalg.solve(covariance[np.ix_(known, known)], change))
    limits = MIN_REPORTED_FRAME_SHIFT_M, MAX_KNOWN_FRAME_SHIFT_STD_M
    shifted = _is_change_significant(moved, covariance[:3, :3], *limits)
    limits = MIN_REPORTED_FRAME_ROTATION_DEG, MAX_KNOWN_FRAME_ROTATION_STD_DEG
    tilted = _is_change_significant(turned, covariance[3:, 3:], *np.radians(limits))
    return PoseFrame(
        p_SoPo_S=origin,
        R_SP=R_SP,
        position_stds_m=deviations,
        rotation_stds_deg=np.degrees(np.sqrt(np.diag(covariance)[3:])),
        is_shifted=bool(wald > _MIN_FRAME_ERROR_WALD_STATISTIC and shifted),
        is_rotated=bool(wald > _MIN_FRAME_ERROR_WALD_STATISTIC and tilted),
    )


def _is_change_significant(x: Array, covariance: Array, min_size: float, max_std: float) -> bool:
    if not np.isfinite(np.diag(covariance)).all():
        return False
    length = np.linalg.norm(x)
    direction = x / (length + 1e-300)
    deviation = float(np.sqrt(direction @ covariance @ direction))
    significant = length > max(min_size, _MIN_FRAME_ERROR_OVER_STD * deviation)
    return bool(significant and deviation < max_std)
