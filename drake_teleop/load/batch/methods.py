"""Batch estimators of the load and the sensor's offsets, by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_teleop.common.errors import DrakeTeleopError, expect_type
from drake_teleop.common.numeric import Array, broadcast_to_rows, to_float
from drake_teleop.common.registry import Registry
from drake_teleop.load.batch import uncertainty
from drake_teleop.load.batch.consistent import consistent_least_squares
from drake_teleop.load.batch.total_least_squares import (
    EstimatorFit,
    EstimatorOptions,
    SampleRecord,
    SolvedNormalEquations,
    total_least_squares,
)
from drake_teleop.load.identification import Identification, is_precise_enough
from drake_teleop.load.normal_equations import (
    SAMPLES_PER_CHUNK,
    NoiseStd,
    SecondMoments,
    excited_columns,
    normal_equations,
    residual_covariance,
    root_of_pseudo_inverse,
)

# Smallest noise of a channel, relative to the wrench: rounding in a noise-free record.
_MIN_RELATIVE_NOISE = 1e-7
# Smallest share of the residual's variance that is wrench noise, not noise of the motion.
_MIN_NOISE_SHARE_OF_VARIANCE = 0.01
# Limits of Huber's weights and of the rejection in robust standard deviations, largest number of
# fits, and largest number of samples for the median.
_HUBER_STDS, _REJECTION_STDS, _MAX_ROBUST_FITS, _MAX_MEDIAN_SAMPLES = 3.0, 4.5, 30, 20000
_NORMAL_STD_OVER_MEDIAN_DEVIATION = 1.4826
# Fewest samples for a rejection, number of samples for the first fit, and largest growth of a
# standard deviation by rejected samples.
_MIN_SAMPLES_TO_REJECT, _MAX_HUBER_SAMPLES, _MAX_FIT_STD_GROWTH = 12, 50_000, 2.0
NOTHING_REJECTED_NOTE = (
    "the residual is large where the load moves and small where it rests, so that disturbances"
    " are indistinguishable from motion errors: no sample was rejected; check delay, scale and"
    " mounting"
)


@dataclass(frozen=True, eq=False)
class BatchResult:
    """Result of `identify_batch`.

    Attributes:
        noise: (6,) standard deviations of the wrench channels, used as weights [N, N m].
        rejected: (N,) True for rejected samples.
        note: warning for the user, or "".
        equations: `SecondMoments` of the samples that are not rejected.
    """

    identification: Identification
    noise: Array
    rejected: NDArray[np.bool_]
    note: str
    equations: SecondMoments


def _fit_ordinary_least_squares(record: SampleRecord, options: EstimatorOptions) -> EstimatorFit:
    solved = total_least_squares(record.moments, NoiseStd(), np.ones(6), offsets=options.offsets)
    return EstimatorFit(solved, np.ones(6), record.moments, np.zeros(len(record.s), bool))


def _fit_whitened_least_squares(record: SampleRecord, options: EstimatorOptions) -> EstimatorFit:
    return _fit_total_least_squares(record, replace(options, noise=NoiseStd(options.noise.wrench)))


def _fit_total_least_squares(
    record: SampleRecord, options: EstimatorOptions, moments: SecondMoments | None = None
) -> EstimatorFit:
    moments = moments or record.moments
    noise, Z = options.noise, moments.mean_products
    if noise.wrench is not None:
        std = np.asarray(noise.wrench, np.float64)
    else:
        std = np.ones(6)
        floor = _MIN_RELATIVE_NOISE * np.sqrt(np.diag(Z)[1:7].reshape(2, 3).sum(axis=1)).repeat(3)
        floor = np.where(floor > 0.0, floor, 1.0)
        for known in (NoiseStd(), noise):
            theta = total_least_squares(moments, known, std, offsets=options.offsets).theta
            squares = np.diag(residual_covariance(Z, theta))
            motion = moments.mean_noise_covariance_of_z(noise, np.zeros(6))
            explained = np.diag(residual_covariance(motion, theta))
            if options.shared_noise:
                squares = squares.reshape(2, 3).mean(axis=1).repeat(3)
                explained = explained.reshape(2, 3).mean(axis=1).repeat(3)
            variances = np.maximum(squares - explained, _MIN_NOISE_SHARE_OF_VARIANCE * squares)
            std = np.sqrt(variances.clip(floor**2))
    solved = total_least_squares(moments, noise, std, offsets=options.offsets)
    return EstimatorFit(solved, std, moments, np.zeros(len(record.s), bool))


def _fit_consistent_least_squares(record: SampleRecord, options: EstimatorOptions) -> EstimatorFit:
    fit = _fit_robust_least_squares(record, options)
    gram, right, theta = fit.solved[:3]
    if theta[6] < 0.0:
        # The nearest consistent load is zero; it would hide an inverted sign or a missing load.
        return fit
    solved = fit.solved._replace(theta=consistent_least_squares(gram, right, theta))
    return replace(fit, solved=solved)


def _fit_robust_least_squares(record: SampleRecord, options: EstimatorOptions) -> EstimatorFit:
    whole = _fit_total_least_squares(record, options)
    n = len(record.s)
    if n < _MIN_SAMPLES_TO_REJECT:
        return whole
    # A subset of the samples is sufficient as a starting point.
    solved = _fit_huber_regression(record.with_row_step(max(1, n // _MAX_HUBER_SAMPLES)), options)
    rejected = np.zeros(n, bool)
    for _ in range(_MAX_ROBUST_FITS):
        previous = rejected
        distances = _max_normalised_residuals(record, solved.theta, options.shared_noise)
        rejected = distances > _REJECTION_STDS
        moments = SecondMoments()
        moments.add_samples(*record.wrench_and_motion, weights=~rejected)
        if _std_growth_by_rejection(whole, moments) > _MAX_FIT_STD_GROWTH:
            return replace(whole, note=NOTHING_REJECTED_NOTE)
        fit = _fit_total_least_squares(record, options, moments)
        solved = fit.solved
        if (rejected == previous).all():
            break
    return replace(fit, rejected=rejected)


def _fit_huber_regression(record: SampleRecord, options: EstimatorOptions) -> SolvedNormalEquations:
    moments, weights = record.moments, np.ones(len(record.s))
    for _ in range(_MAX_ROBUST_FITS):
        before = weights
        solved = _fit_total_least_squares(record, options, moments).solved
        distances = _max_normalised_residuals(record, solved.theta, options.shared_noise)
        weights = np.minimum(1.0, _HUBER_STDS / np.maximum(distances, _HUBER_STDS))
        if np.abs(weights - before).max() < 0.01:
            break
        moments = SecondMoments()
        moments.add_samples(*record.wrench_and_motion, weights=weights)
    return solved


def _std_growth_by_rejection(full_fit: EstimatorFit, kept_moments: SecondMoments) -> float:
    if kept_moments.num_samples < _MIN_SAMPLES_TO_REJECT:
        return np.inf
    used = excited_columns(full_fit.moments.mean_products)
    variances = []
    for moments in (full_fit.moments, kept_moments):
        gram, _ = normal_equations(moments.mean_products, full_fit.solved.weights)
        root = root_of_pseudo_inverse(moments.num_samples * gram, used)
        variances.append(np.sum(root**2, axis=1)[used])
    return float(np.sqrt(np.max(variances[1] / variances[0])))


class Method(NamedTuple):
    """Batch estimator: its name in results, and function that fits a record."""

    name: str
    fit: Callable[[SampleRecord, EstimatorOptions], EstimatorFit]


METHODS = Registry(
    "estimator",
    {
        "ordinary": Method("batch least squares", _fit_ordinary_least_squares),
        "whitened": Method("whitened least squares", _fit_whitened_least_squares),
        "robust": Method("robust least squares", _fit_robust_least_squares),
        "total": Method("total least squares", _fit_total_least_squares),
        "consistent": Method("physically consistent least squares", _fit_consistent_least_squares),
    },
    Method,
)
"""Estimators by name."""

DEFAULT_METHOD = "consistent"


def identify_batch(
    wrench: ArrayLike,
    s: ArrayLike,
    omega: ArrayLike,
    alpha: ArrayLike,
    *,
    method: str = DEFAULT_METHOD,
    noise: NoiseStd | None = None,
    offsets: bool = True,
    shared_noise: bool = False,
    resolution: tuple[float, float] = (0.0, 0.0),
    delay_s: float = 0.0,
    gain_std: float = 0.0,
) -> BatchResult:
    """Return load and sensor offsets of a free motion, fitted by the batch estimator `method`.

    Args:
        wrench, s, omega, alpha: (N, 6) [N, N m], and (N, 3) motion of sensor frame S [SI].
        noise: noise of wrench and motion; None: estimated wrench noise, exact motion.
        offsets: False if the wrench contains no offsets.
        shared_noise: True for poses at rest: one noise level for forces, one for torques.
        resolution: (2,) quantisation step of forces and torques [N, N m], for `shared_noise` only.
        delay_s, gain_std: removed delay of the motion [s]; relative std of the sensor's 36 gains.
    """
    METHODS.check(method, "method")
    expect_type((NoiseStd, type(None)), noise, "noise")
    if not to_float("gain_std", gain_std) >= 0.0:
        raise DrakeTeleopError(f"{gain_std} is negative", where="gain_std", remedy="give 0 or more")
    _, rows = broadcast_to_rows(wrench=(wrench, 6), s=(s, 3), omega=(omega, 3), alpha=(alpha, 3))
    record = SampleRecord(*rows)
    options = EstimatorOptions(noise or NoiseStd(), offsets, shared_noise)
    fit = METHODS[method].fit(record, options)
    steps_at_rest = resolution if shared_noise else None
    equations = SecondMoments(np.diag(fit.solved.weights) ** -0.5, resolution=steps_at_rest)
    kept = ~fit.rejected
    equations.add_samples(*(rows if kept.all() else [table[kept] for table in rows]))
    plain = equations.solve(delay_s)
    theta, Z = fit.solved.theta, fit.moments.mean_products
    walk = np.square(np.broadcast_to(options.noise.walk, 12))
    steps = residual_covariance(np.diag(np.pad(walk, (1, 6))), theta)
    covariance = uncertainty.covariance_for_white_noise(plain.covariance, equations, fit)
    covariance = covariance + uncertainty.covariance_for_random_walks(record, kept, fit, steps)
    covariance = uncertainty.covariance_of_solution(covariance, fit.solved, offsets)
    if gain_std > 0.0:
        known = np.isfinite(np.diag(covariance))
        gain_covariance = gain_std**2 * uncertainty.covariance_for_gain_errors(fit, offsets)
        covariance += np.outer(known, known) * gain_covariance
    identification = replace(
        plain,
        phi=theta[6:],
        offsets=theta[:6],
        covariance=covariance,
        identifiable=is_precise_enough(np.sqrt(np.diag(covariance)), theta[6:]),
        residual_rms=np.sqrt(np.diag(residual_covariance(Z, theta)).clip(0.0)),
        method=METHODS[method].name,
    )
    return BatchResult(identification, fit.wrench_noise, fit.rejected, fit.note, equations)


def _max_normalised_residuals(record: SampleRecord, theta: Array, shared_noise: bool) -> Array:
    n = len(record.s)
    magnitudes = np.abs(record.residual(theta, slice(0, n, max(1, n // _MAX_MEDIAN_SAMPLES))))
    median = np.median(magnitudes, axis=0)
    if shared_noise:
        median = np.median(magnitudes.reshape(-1, 2, 3), axis=(0, 2)).repeat(3)
    rms = np.sqrt(np.mean(record.wrench**2, axis=0).reshape(2, 3).sum(axis=1)).repeat(3)
    scale = np.maximum(_NORMAL_STD_OVER_MEDIAN_DEVIATION * median, _MIN_RELATIVE_NOISE * rms)
    scale = np.where(scale > 0.0, scale, 1.0)
    out = np.empty(n)
    for start in range(0, n, SAMPLES_PER_CHUNK):
        part = slice(start, start + SAMPLES_PER_CHUNK)
        out[part] = (np.abs(record.residual(theta, part)) / scale).max(axis=1)
    return out
