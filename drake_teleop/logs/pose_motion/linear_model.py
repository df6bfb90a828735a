"""Linear model of the wrench in 16 signals (1, a, -g, alpha, products of omega), (T73)-(T76).

Its residual reveals disturbances: contacts, impacts and saturation (docs/theory.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.numeric import Array, position_of_parabola_minimum, samples_to_nearest_true
from drake_teleop.load.batch.methods import NOTHING_REJECTED_NOTE
from drake_teleop.logs.pose_motion import spectra as spectral
from drake_teleop.logs.pose_motion.poses import Poses
from drake_teleop.logs.pose_motion.spectra import (
    WRENCH_COLUMNS,
    FitWindow,
    FrequencyBands,
    NoiseLevels,
    Spectra,
    WrenchGrid,
)
from drake_teleop.logs.pose_motion.splines import (
    MIN_POSES_PER_KNOT,
    NUM_MOTION_SIGNALS,
    SIGNALS_ZERO_AT_REST,
    PoseSplines,
    SplineCache,
)

TRIED_KNOT_SPACINGS_S = (0.28, 0.2, 0.14, 0.1, 0.07, 0.05, 0.035, 0.025)
"""Knot spacings that are tried first; then two between the best and its neighbours [s]."""
MIN_NOISE_STD_OVER_WRENCH_RMS = 1e-7
"""Least noise of a channel relative to the wrench, for rounded numbers."""
_COARSE_DELAY_STEP_S, _FINE_DELAY_STEP_S, _FINEST_DELAY_STEP_S = 0.016, 1e-3, 1e-5
_REWEIGHTING_ITERATIONS, _MIN_AVERAGED_POSE_RATE_HZ = 4, 125.0
_MIN_RELATIVE_GRAM_EIGENVALUE, _MIN_RELATIVE_PIVOT_FOR_INVERSE = 1e-12, 1e-8
# Corners of a wandering offset [Hz], and least reduction of a channel's cost.
_TRIED_OFFSET_DRIFT_CORNERS_HZ = tuple(0.05 * 2.0**k for k in range(9))
_MIN_LOG_LIKELIHOOD_GAIN_BY_DRIFT = 3.0
_SPACING_OVER_BEST, _SPACING_OVER_BEST_KNOWN_LOAD, _MIN_COST_RISE_OFF_DELAY = 0.84, 0.92, 25.0


@dataclass(frozen=True, eq=False)
class LinearFit:
    """Fit of the wrench by free coefficients of 16 signals of the motion.

    Attributes:
        coefficients: (6, 16); their product with the signals is the wrench; 0 for absent signals.
        covariance: (6, 16, 16) of each row of coefficients.
        noise_power: (bands, 6) mean noise power.
        channel_costs: (6,) negative log likelihood of each channel.
    """

    coefficients: Array
    covariance: Array
    noise_power: Array
    channel_costs: Array

    @property
    def cost(self) -> float:
        """Negative log likelihood, up to a constant, Eq. (T75)."""
        return float(self.channel_costs.sum())


def fit_linear_model(Z: Array, levels: NoiseLevels, load: Array | None = None) -> LinearFit:
    """Fit the wrench by 16 signals, from their second moments Z (..., bands, n, n).

    If the coefficients `load` (6, 16) are given, only offsets are fitted.
    """
    zz, zf = (Z[..., :NUM_MOTION_SIGNALS, x] for x in (slice(NUM_MOTION_SIGNALS), WRENCH_COLUMNS))
    ff, floor = _wrench_channel_powers(Z), min_noise_power(Z, levels)
    if load is not None:
        explained = zz @ load.T
        ff = ff - np.sum((2.0 * zf - explained) * load.T, axis=-2)
        zf, zz = (zf - explained)[..., :1, :], zz[..., :1, :1]
    size = np.diagonal(zz.sum(axis=-3), axis1=-2, axis2=-1)
    constant = zz[..., 0, 0].sum(axis=-1)[..., None]
    scale = np.where(size > 1e-18 * constant, 1.0 / np.sqrt(size + 1e-300), 0.0)
    both = scale[..., :, None] * scale[..., None, :]
    zz, zf = zz * both[..., None, :, :], zf * scale[..., None, :, None]
    power = np.maximum(ff / levels.half_dof_of_bands[:, None], floor).mean(axis=-2, keepdims=True)
    power = np.broadcast_to(power, (*zf.shape[:-2], 6))
    flat = zz.reshape(*zz.shape[:-2], -1)
    for _ in range(_REWEIGHTING_ITERATIONS):
        weight = 1.0 / power
        gram = (np.swapaxes(weight, -1, -2) @ flat).reshape(*zz.shape[:-3], 6, *zz.shape[-2:])
        right = np.swapaxes(np.sum(zf * weight[..., None, :], axis=-3), -1, -2)
        inverse = _pseudo_inverses_of_grams(gram)
        C = (inverse @ right[..., None])[..., 0]
        across = np.swapaxes(C, -1, -2)[..., None, :, :]
        explained = np.sum((2.0 * zf - zz @ across) * across, axis=-2)
        power = np.maximum(levels.noise_power(ff - explained), floor)
    C = C * scale[..., None, :]
    if load is not None:
        C = np.concatenate([C, np.broadcast_to(load[:, 1:], (*C.shape[:-1], len(load[0]) - 1))], -1)
    covariance = 0.5 * inverse * both[..., None, :, :]
    return LinearFit(C, covariance, power, levels.negative_log_likelihoods(power))


def _wrench_channel_powers(Z: Array) -> Array:
    return np.diagonal(Z[..., WRENCH_COLUMNS, WRENCH_COLUMNS], axis1=-2, axis2=-1)


def _pseudo_inverses_of_grams(gram: Array) -> Array:
    largest = np.diagonal(gram, axis1=-2, axis2=-1).max(axis=-1, keepdims=True)
    try:
        pivots = np.diagonal(np.linalg.cholesky(gram), axis1=-2, axis2=-1) ** 2
        if (pivots > _MIN_RELATIVE_PIVOT_FOR_INVERSE * largest).all():
            return np.asarray(np.linalg.inv(gram))  # three times faster
    except np.linalg.LinAlgError:
        pass
    values, vectors = np.linalg.eigh(gram)
    good = values > _MIN_RELATIVE_GRAM_EIGENVALUE * values[..., -1:]
    scaled = vectors * np.where(good, 1.0 / np.where(good, values, 1.0), 0.0)[..., None, :]
    return np.asarray(scaled @ np.swapaxes(vectors, -1, -2))


def min_noise_power(Z: Array, levels: NoiseLevels) -> Array:
    """Return a lower limit (..., 1, 6) of noise power, a small share of the wrench's power."""
    power = _wrench_channel_powers(Z).sum(axis=-2, keepdims=True) / levels.half_dof_of_bands.sum()
    both = power.reshape(*power.shape[:-1], 2, 3).sum(axis=-1).repeat(3, axis=-1)
    return np.maximum(MIN_NOISE_STD_OVER_WRENCH_RMS**2 * both, 1e-60)


def fit_noise_levels(Z: Array, bands: FrequencyBands) -> NoiseLevels:
    """Return noise levels from second moments Z: white, plus a random walk if likelier (T74)."""
    levels = NoiseLevels.white_noise_in_each_group(bands)
    least = fit_linear_model(Z, levels).channel_costs - _MIN_LOG_LIKELIHOOD_GAIN_BY_DRIFT
    shape = levels.relative_power.copy()
    for corner in _TRIED_OFFSET_DRIFT_CORNERS_HZ:
        rising = np.repeat(spectral.random_walk_relative_power(bands, corner)[:, None], 6, axis=1)
        costs = fit_linear_model(Z, replace(levels, relative_power=rising)).channel_costs
        better = costs < least
        least, shape = np.where(better, costs, least), np.where(better, rising, shape)
    return replace(levels, relative_power=shape)


def fit_coefficients(spectra: Spectra) -> LinearFit:
    """Fit the coefficients of all signals, or only the offsets if the load is known."""
    levels = NoiseLevels.white_noise_in_each_group(spectra.window.bands)
    return fit_linear_model(spectra.second_moments(), levels, spectra.window.grid.known_load)


def _costs_at_delays(spectra: Spectra, delays: Array) -> Array:
    window, Z = spectra.window, spectra.second_moments_at_delays(delays)
    wrench = np.arange(NUM_MOTION_SIGNALS, NUM_MOTION_SIGNALS + 6)
    Z[..., wrench, wrench] = window.bands.sums_over_bands(np.abs(window.wrench_spectrum) ** 2)
    levels = NoiseLevels.white_noise_in_each_group(window.bands)
    return fit_linear_model(Z, levels, window.grid.known_load).channel_costs.sum(axis=-1)


def find_best_delay_and_cost(
    spectra: Spectra, half_range_s: float, finest_step_s: float = _FINEST_DELAY_STEP_S
) -> tuple[float, float]:
    """Return the likeliest delay [s] within `half_range_s` of the present one, and cost (T75)."""
    step = min(_COARSE_DELAY_STEP_S, half_range_s / 2)
    count = round(half_range_s / step)
    at: Array = spectra.delay + step * np.arange(-count, count + 1.0)
    costs = _costs_at_delays(spectra, at)
    while step > finest_step_s:
        best = int(np.clip(np.argmin(costs), 1, len(costs) - 2))
        centre = float(at[best] + step * position_of_parabola_minimum(*costs[best - 1 : best + 2]))
        step /= 8.0
        at = centre + step * np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
        costs = _costs_at_delays(spectra, at)
    best = int(np.argmin(costs))
    return float(at[best]), float(costs[best])


def delay_std(spectra: Spectra) -> float:
    """Return the standard deviation of `spectra.delay` [s]; inf if undetermined."""
    reach = spectra.window.delay_search_half_range_s
    beside = np.array([-_FINE_DELAY_STEP_S, 0.0, _FINE_DELAY_STEP_S])
    left, least, right = _costs_at_delays(spectra, spectra.delay + beside)
    far = _costs_at_delays(spectra, spectra.delay + np.arange(-reach, reach, _COARSE_DELAY_STEP_S))
    bend = left - 2.0 * least + right
    if bend <= 0.0 or far.max() - least < _MIN_COST_RISE_OFF_DELAY or far.min() < least - 1.0:
        return np.inf
    return float(_FINE_DELAY_STEP_S / np.sqrt(bend))


def guess_knot_spacing_and_delay(
    window: FitWindow, cache: SplineCache, delay: float, *, fixed: bool
) -> tuple[float, float]:
    """Return likeliest knot spacing and delay [s] on a coarse grid; a `fixed` delay is kept."""
    found, reach = [], window.delay_search_half_range_s
    for h in _knot_spacings_allowed_by_pose_rate(cache)[::2]:
        spectra, late = window.spectra_at_delay(cache.splines_with_spacing(h), delay), delay
        if fixed:
            cost = fit_coefficients(spectra).cost
        else:
            late, cost = find_best_delay_and_cost(spectra, reach, _FINE_DELAY_STEP_S)
        found.append((cost, h, late))
    return min(found)[1:]


def choose_knot_spacing_and_delay(
    window: FitWindow, caches: Sequence[SplineCache], delay: float, *, fixed: bool
) -> tuple[SplineCache, float, float]:
    """Return splines, knot spacing [s] and delay [s] near the highest likelihood.

    Knots are closer by 8 % for a known load, else by 16 %, for a smaller bias. The delay is
    kept if `fixed`.
    """

    def spectra_of(cache: SplineCache, knot_spacing_s: float) -> Spectra:
        return window.spectra_at_delay(cache.splines_with_spacing(knot_spacing_s), delay)

    found = []
    for cache in caches:
        spacings = _knot_spacings_allowed_by_pose_rate(cache)
        costs = [(fit_coefficients(spectra_of(cache, h)).cost, h) for h in spacings]
        k = spacings.index(min(costs)[1])
        for h in spacings[max(0, k - 1) : k] + spacings[k + 1 : k + 2]:
            between = float(np.sqrt(spacings[k] * h))
            costs.append((fit_coefficients(spectra_of(cache, between)).cost, between))
        found.append((*min(costs), cache))
    _, best, cache = min(found, key=lambda x: x[:2])
    finer = _SPACING_OVER_BEST if window.grid.known_load is None else _SPACING_OVER_BEST_KNOWN_LOAD
    best = max(finer * best, MIN_POSES_PER_KNOT / cache.rate)
    if not fixed:
        reach = 3 * _COARSE_DELAY_STEP_S
        delay, _ = find_best_delay_and_cost(spectra_of(cache, best), reach)
    return cache, best, delay


def spline_cache_of_averaged_poses(poses: Poses) -> SplineCache:
    """Return splines of poses that are averaged down to 125 Hz or just above."""
    count = max(1, int(poses.rate / _MIN_AVERAGED_POSE_RATE_HZ + 1e-6))
    return SplineCache(poses.average_consecutive(count))


def _knot_spacings_allowed_by_pose_rate(cache: SplineCache) -> list[float]:
    usable = [h for h in TRIED_KNOT_SPACINGS_S if h * cache.rate >= MIN_POSES_PER_KNOT]
    return usable or [TRIED_KNOT_SPACINGS_S[0]]


_MAX_CLOCK_RATE_ITERATIONS, _MIN_CLOCK_RATE_CHI_SQUARED = 3, 25.0
# A larger change of the delay [s] is not caused by a clock.
_MAX_DELAY_CHANGE_BY_CLOCK_DRIFT_S = 0.2


def estimate_clock_rate_error(
    window: FitWindow, cache: SplineCache, delay: float, spacing: float
) -> float:
    """Return the relative rate error of the poses' clock, > 0 if fast; 0 if insignificant."""
    now, best = window.spectra_at_delay(cache.splines_with_spacing(spacing), delay), 0.0
    grid, least = window.grid, fit_coefficients(now).cost
    start = least
    for _ in range(_MAX_CLOCK_RATE_ITERATIONS):
        step, chi_squared = _clock_rate_change_and_chi_squared(now)
        trial = best + step
        if chi_squared < _MIN_CLOCK_RATE_CHI_SQUARED and best == 0.0:
            return 0.0
        if abs(trial) * float(grid.t[-1] - grid.t[0]) > 2.0 * _MAX_DELAY_CHANGE_BY_CLOCK_DRIFT_S:
            break
        splines = PoseSplines(correct_clock_rate(cache.poses, trial, grid, delay), spacing)
        now = window.spectra_at_delay(splines, delay)
        cost = fit_coefficients(now).cost
        if not cost < least:
            break
        least, best = cost, trial
    return best if 2.0 * (start - least) > _MIN_CLOCK_RATE_CHI_SQUARED else 0.0


def correct_clock_rate(poses: Poses, rate_error: float, grid: WrenchGrid, delay: float) -> Poses:
    """Return the poses with stamps corrected for the relative rate error of their clock."""
    middle = 0.5 * float(grid.t[0] + grid.t[-1]) + delay
    return Poses(middle + (poses.t - middle) / (1.0 + rate_error), poses.position, poses.quaternion)


def _clock_rate_change_and_chi_squared(spectra: Spectra) -> tuple[float, float]:
    window, fit = spectra.window, fit_coefficients(spectra)
    grid, bands = window.grid, window.bands
    change = np.gradient(spectra.motion_signals, grid.dt, axis=0)
    from_middle = (grid.t - 0.5 * (grid.t[0] + grid.t[-1]))[:, None]
    free = spectra.signals if grid.known_load is None else spectra.signals[:, :1]
    k = free.shape[1]
    moves = [window.signal_spectrum(x) for x in (from_middle * change, change)]
    gram, right = np.zeros((2, 2)), np.zeros(2)
    for c, C in enumerate(fit.coefficients):
        weight = np.sqrt(bands.frequency_weight / fit.noise_power[bands.band_of_frequency, c])
        columns = np.column_stack([free, *(x @ C for x in moves)])
        left = (window.wrench_spectrum[:, c] - spectra.signals @ C)[:, None]
        y = spectral.real_and_imaginary_rows(np.hstack([columns, left]) * weight[:, None])
        G = y.T @ y
        # Eliminate the coefficients.
        reduced = G[k:, k:] - G[k:, :k] @ np.linalg.pinv(G[:k, :k], 1e-12, True) @ G[:k, k:]
        gram += reduced[:2, :2]
        right += reduced[:2, 2]
    inverse = np.linalg.pinv(gram, 1e-12, True)
    step = float(inverse[0] @ right)
    return step, 2.0 * step**2 / float(inverse[0, 0] + 1e-300)


_HUBER_STDS, _REJECTION_STDS, _MAX_ROBUST_FITS = 3.0, 4.5, 30
_NORMAL_STD_OVER_MEDIAN_DEVIATION, _MAX_FIT_STD_GROWTH = 1.4826, 2.5
_RESIDUAL_FILTER_CUTOFF_OVER_KNOT_RATE = 0.3
_MIN_REJECTION_MARGIN_S = 0.1  # least margin on both sides of a rejected time span [s]


def find_disturbances(spectra: Spectra, spacing: float) -> tuple[NDArray[np.bool_], str]:
    """Return flags (M,) of instants to reject (contact, impact, saturation), and a note.

    `spacing` [s] is that of knots. If too little motion would remain, only a note is returned.
    """
    # A Gaussian gain, one half at `_RESIDUAL_FILTER_CUTOFF_OVER_KNOT_RATE` / h, does not ring.
    window, grid = spectra.window, spectra.window.grid
    gain = 0.5 ** ((window.bands.frequency * spacing / _RESIDUAL_FILTER_CUTOFF_OVER_KNOT_RATE) ** 2)
    filtered = (x * gain[:, None] for x in (spectra.signals, window.wrench_spectrum))
    x, y = (np.fft.irfft(z, grid.transform_length, axis=0)[: len(grid.t)] for z in filtered)
    inside = window.taper > 0.5
    size = np.sqrt(np.mean(x**2, axis=0))
    used = size > 1e-9 * size[0]
    if grid.known_load is None:
        x = test_signals = x[:, used] / size[used]
    else:
        y = y - x @ grid.known_load.T
        test_signals = x[:, SIGNALS_ZERO_AT_REST] @ grid.known_load[:3, SIGNALS_ZERO_AT_REST].T
        x, test_signals = x[:, :1] / size[0], np.linalg.norm(test_signals, axis=1, keepdims=True)
    weights = inside.astype(float)
    for _ in range(_MAX_ROBUST_FITS):
        before = weights
        distances = _max_residuals_over_std(x, y, weights, inside)
        weights = inside * np.minimum(1.0, _HUBER_STDS / np.maximum(distances, _HUBER_STDS))
        if np.abs(weights - before).max() < 0.01:
            break
    rejected = np.zeros(len(x), bool)
    for _ in range(_MAX_ROBUST_FITS):
        last = rejected
        rejected = _max_residuals_over_std(x, y, weights, inside) > _REJECTION_STDS
        weights = (inside & ~rejected).astype(float)
        if (rejected == last).all() or weights.sum() < 2 * x.shape[1]:
            break
    if not rejected.any():
        return rejected, ""
    rejected = samples_to_nearest_true(rejected) * grid.dt <= max(_MIN_REJECTION_MARGIN_S, spacing)
    if _std_growth_by_rejection(test_signals, inside, inside & ~rejected) > _MAX_FIT_STD_GROWTH:
        return np.zeros(len(x), bool), NOTHING_REJECTED_NOTE
    return rejected, ""


def _max_residuals_over_std(x: Array, y: Array, weights: Array, used: NDArray[np.bool_]) -> Array:
    weighted = x * weights[:, None]
    C = np.linalg.lstsq(weighted.T @ x, weighted.T @ y, rcond=1e-12)[0]
    residual = np.abs(y - x @ C)
    scale = _NORMAL_STD_OVER_MEDIAN_DEVIATION * np.median(residual[used], axis=0)
    rms = np.sqrt(np.mean(y**2, axis=0).reshape(2, 3).sum(axis=1)).repeat(3)
    scale = np.maximum(scale, MIN_NOISE_STD_OVER_WRENCH_RMS * rms + 1e-30)
    return np.asarray((residual / scale).max(axis=1))


def _std_growth_by_rejection(
    x: Array, used_rows: NDArray[np.bool_], kept_rows: NDArray[np.bool_]
) -> float:
    if kept_rows.sum() < 2 * x.shape[1]:
        return np.inf
    whole, left = (x[rows].T @ x[rows] for rows in (used_rows, kept_rows))
    # pinv returns zeros for motions that no kept sample contains, hence the share of the whole.
    grams = np.array([whole, left + 1e-6 * whole])
    inverses = np.linalg.pinv(grams, rcond=1e-12, hermitian=True)
    every, some = np.diagonal(inverses, axis1=1, axis2=2)
    return float(np.sqrt(np.max(some / every) * kept_rows.sum() / used_rows.sum()))
