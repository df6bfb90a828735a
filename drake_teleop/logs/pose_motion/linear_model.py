"""Linear model of the wrench in 16 signals (1, a, -g, alpha, products of omega), (T73)-(T76)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from drake_teleop.common.numeric import Array, position_of_parabola_minimum
from drake_teleop.logs.pose_motion.poses import Poses
from drake_teleop.logs.pose_motion.spectra import (
    WRENCH_COLUMNS,
    ComplexArray,
    FrequencyBands,
    NoiseLevels,
    WrenchGrid,
    end_taper,
    filter_by_response,
    make_frequency_bands,
    random_walk_relative_power,
    second_moments,
    signal_spectrum,
    wrench_spectrum,
)
from drake_teleop.logs.pose_motion.splines import (
    MIN_POSES_PER_KNOT,
    NUM_MOTION_SIGNALS,
    PoseSplines,
    SplineCache,
)

TRIED_KNOT_SPACINGS_S = (0.28, 0.2, 0.14, 0.1, 0.07, 0.05, 0.035, 0.025)
"""Knot distances that are tried first; then two between the best and its neighbours [s]."""
DELAY_SEARCH_HALF_RANGE_S = 0.25
"""Largest change of the delay in the search, or a tenth of the record [s]."""
MIN_NOISE_STD_OVER_WRENCH_RMS = 1e-7
"""Least noise of a channel relative to the wrench, for rounded numbers."""
_COARSE_DELAY_STEP_S, _FINE_DELAY_STEP_S, _FINEST_DELAY_STEP_S = 0.016, 1e-3, 1e-5
_REWEIGHTING_ITERATIONS, _MIN_AVERAGED_POSE_RATE_HZ = 4, 125.0
_MIN_RELATIVE_GRAM_EIGENVALUE, _MIN_RELATIVE_PIVOT_FOR_INVERSE = 1e-12, 1e-8
# Corners of a wandering offset [Hz], and least reduction of a channel's cost.
_TRIED_OFFSET_DRIFT_CORNERS_HZ = tuple(0.05 * 2.0**k for k in range(9))
_MIN_COST_REDUCTION_BY_DRIFT = 3.0
_SPACING_OVER_BEST, _SPACING_OVER_BEST_KNOWN_LOAD, _MIN_COST_RISE_OFF_DELAY = 0.84, 0.92, 25.0


@dataclass(frozen=True, eq=False)
class LinearFit:
    """Fit of the wrench by free coefficients of 16 signals of the motion.

    Attributes:
        coefficients: (6, 16); 0 for signals that are 0.
        covariance: (6, 16, 16) of the rows of coefficients.
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


def fit_linear_model(Z: Array, levels: NoiseLevels) -> LinearFit:
    """Fit the wrench by 16 signals of the motion, from second moments Z (bands, 38, 38)."""
    return _fit_to_moments(*_moments_of_signals_and_wrench(Z), levels)


def _moments_of_signals_and_wrench(Z: Array) -> tuple[Array, Array, Array]:
    zz = Z[..., :NUM_MOTION_SIGNALS, :NUM_MOTION_SIGNALS]
    powers = np.diagonal(Z[..., WRENCH_COLUMNS, WRENCH_COLUMNS], axis1=-2, axis2=-1)
    return zz, Z[..., :NUM_MOTION_SIGNALS, WRENCH_COLUMNS], powers


def _fit_to_moments(
    zz: Array, zf: Array, ff: Array, levels: NoiseLevels, load: Array | None = None
) -> LinearFit:
    floor = _min_noise_power_of_wrench(ff, levels.half_dof_of_bands)
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
    return LinearFit(
        coefficients=C * scale[..., None, :],
        covariance=0.5 * inverse * both[..., None, :, :],
        noise_power=power,
        channel_costs=levels.negative_log_likelihoods(power),
    )


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


def min_noise_power(Z: Array, half_dof_of_bands: Array) -> Array:
    """Return the least noise power (6,) of the wrench, by rounding; Z: `Spectra.second_moments`."""
    return _min_noise_power_of_wrench(_moments_of_signals_and_wrench(Z)[2], half_dof_of_bands)


def _min_noise_power_of_wrench(ff: Array, half_dof_of_bands: Array) -> Array:
    power = ff.sum(axis=0) / half_dof_of_bands.sum()
    both = power.reshape(2, 3).sum(axis=1).repeat(3)
    return np.maximum(MIN_NOISE_STD_OVER_WRENCH_RMS**2 * both, 1e-60)


def fit_noise_levels(Z: Array, bands: FrequencyBands) -> NoiseLevels:
    """Return noise levels, with the best of white noise and random walks (T74) in each channel."""
    levels = NoiseLevels.white_within_groups(bands)
    least = fit_linear_model(Z, levels).channel_costs - _MIN_COST_REDUCTION_BY_DRIFT
    shape = levels.relative_power.copy()
    for corner in _TRIED_OFFSET_DRIFT_CORNERS_HZ:
        rising = np.repeat(random_walk_relative_power(bands, corner)[:, None], 6, axis=1)
        costs = fit_linear_model(Z, replace(levels, relative_power=rising)).channel_costs
        better = costs < least
        least, shape = np.where(better, costs, least), np.where(better, rising, shape)
    return replace(levels, relative_power=shape)


@dataclass(frozen=True, eq=False)
class Spectra:
    """Spectra of wrench (K, 6) and 16 motion signals (K, 16) at K frequencies of a record.

    Attributes:
        grid, taper: instants of the record, and their weights (M,).
        delay: delay of the signals behind the wrench [s].
        motion_signals: (M, 16) signals over time, see `PoseSplines.signals`.
    """

    bands: FrequencyBands
    wrench: ComplexArray
    signals: ComplexArray
    delay: float
    grid: WrenchGrid
    taper: Array
    motion_signals: Array

    @property
    def delay_search_half_range_s(self) -> float:
        return min(DELAY_SEARCH_HALF_RANGE_S, 0.1 * float(self.grid.t[-1] - self.grid.t[0]))

    @cached_property
    def is_taper_fixed(self) -> bool:
        """Whether the weights of samples stay in place when the delay changes."""
        inside = np.flatnonzero(self.taper > 0.5)
        edged = len(inside) > 0 and len(inside) <= inside[-1] - inside[0]
        return bool(edged or self.grid.known_load is not None)

    def with_delay(self, delay: float) -> Spectra:
        """Return the spectra with signals shifted to a delay [s]; only `signals` changes."""
        shift, signals = delay - self.delay, self.signals
        if self.is_taper_fixed:
            advance = np.exp(-2j * np.pi * self.grid.frequency * shift)
            before = filter_by_response(self.grid, self.taper, advance)
            signals = signal_spectrum(self.grid, before, self.motion_signals, len(signals))
        late = signals * np.exp(2j * np.pi * self.bands.frequency * shift)[:, None]
        late[:, 0] = self.signals[:, 0]
        return replace(self, signals=late)

    def second_moments(self) -> Array:
        """Return second moments (bands, 38, 38) of signals, wrench, and derivatives of signals."""
        rates = 2j * np.pi * self.bands.frequency[:, None] * self.signals
        edges = filter_by_response(self.grid, self.taper, 2j * np.pi * self.grid.frequency)
        rates -= signal_spectrum(self.grid, edges, self.motion_signals, len(rates))
        rates[:, 0] = 0.0
        return second_moments(self.signals, self.wrench, self.bands, rates)

    def fit_coefficients(self) -> LinearFit:
        """Fit the coefficients of all signals, or only the constants if the load is known."""
        Z, load = second_moments(self.signals, self.wrench, self.bands), self.grid.known_load
        levels = NoiseLevels.white_within_groups(self.bands)
        fit = _fit_to_moments(*_moments_of_signals_and_wrench(Z), levels, load)
        if load is None:
            return fit
        return replace(fit, coefficients=np.hstack([fit.coefficients, load[:, 1:]]))

    def costs_at_delays(self, delays: Array) -> Array:
        """Return the negative log likelihoods (D,) of fits with delays (D,) [s]."""
        if self.is_taper_fixed:
            late = map(self.with_delay, delays)
            Z = np.array([second_moments(x.signals, x.wrench, x.bands) for x in late])
            zz, zf, _ = _moments_of_signals_and_wrench(Z)
        else:
            zz, zf = self._delayed_moments(np.asarray(delays))
        ff = self.bands.sums_over_bands(np.abs(self.wrench) ** 2)
        levels = NoiseLevels.white_within_groups(self.bands)
        return _fit_to_moments(zz, zf, ff, levels, self.grid.known_load).channel_costs.sum(axis=-1)

    def _delayed_moments(self, delays: Array) -> tuple[Array, Array]:
        """Return moments of signals and wrench at delays (D,) [s], with a moving taper."""
        bands, Z = self.bands, second_moments(self.signals, self.wrench, self.bands)
        fixed = np.column_stack([self.wrench, self.signals[:, 0]]) * bands.frequency_weight[:, None]
        products = np.conj(self.signals)[:, :, None] * fixed[:, None]
        flat = products.reshape(len(products), -1)
        angle = 2.0 * np.pi * np.outer(delays - self.delay, bands.frequency)
        cosine, sine = np.cos(angle), np.sin(angle)
        starts = np.searchsorted(bands.band_of_frequency, np.arange(bands.num_bands + 1))
        sums = np.empty((len(delays), bands.num_bands, flat.shape[1]))
        for k in range(bands.num_bands):
            part = slice(starts[k], starts[k + 1])
            sums[:, k] = cosine[:, part] @ flat[part].real + sine[:, part] @ flat[part].imag
        zf = sums.reshape(len(delays), bands.num_bands, NUM_MOTION_SIGNALS, 7)
        zf[:, :, 0, :6], zf[:, :, 0, 6] = Z[:, 0, WRENCH_COLUMNS], Z[:, 0, 0]
        zz = np.repeat(Z[None, :, :NUM_MOTION_SIGNALS, :NUM_MOTION_SIGNALS], len(delays), axis=0)
        zz[..., 0] = zz[..., 0, :] = zf[..., 6]
        return zz, zf[..., :6]

    def with_motion(self, splines: PoseSplines, gravity_W: Array, delay: float) -> Spectra:
        """Return the spectra with the signals of other splines at a delay [s]."""
        zeta = splines.signals(self.grid.t + delay, gravity_W)
        signals = signal_spectrum(self.grid, self.taper, zeta, len(self.wrench))
        return replace(self, signals=signals, delay=delay, motion_signals=zeta)


@dataclass(frozen=True, eq=False)
class FitWindow:
    """Data of a fit: weights `taper` (M,), gravity (3,) [m/s^2], highest frequency [Hz]."""

    grid: WrenchGrid
    taper: Array
    gravity_W: Array
    max_frequency_hz: float

    def select_rows(self, rows: slice) -> FitWindow:
        grid = self.grid
        wrench = grid.wrench[rows.start * grid.stride : rows.stop * grid.stride]
        grid = replace(grid, t=grid.t[rows], wrench=wrench)
        taper = self.taper[rows] * end_taper(grid.t, grid.t[0], grid.t[-1])
        return replace(self, grid=grid, taper=taper)

    def spectra_at_delay(self, splines: PoseSplines, delay: float) -> Spectra:
        """Return spectra of the wrench, and of the motion `delay` [s] later."""
        bands = make_frequency_bands(self.grid, self.taper, self.max_frequency_hz)
        count = len(bands.frequency)
        zeta = splines.signals(self.grid.t + delay, self.gravity_W)
        wrench = wrench_spectrum(self.grid, self.taper, count)
        signals = signal_spectrum(self.grid, self.taper, zeta, count)
        return Spectra(bands, wrench, signals, delay, self.grid, self.taper, zeta)


def find_best_delay_and_cost(
    spectra: Spectra, reach: float, finest: float = _FINEST_DELAY_STEP_S
) -> tuple[float, float]:
    """Return the delay [s] of highest likelihood within +-`reach`, and its cost, Eq. (T75)."""
    step = min(_COARSE_DELAY_STEP_S, reach / 2)
    at: Array = spectra.delay + step * np.arange(-round(reach / step), round(reach / step) + 1.0)
    costs = spectra.costs_at_delays(at)
    while step > finest:
        best = int(np.clip(np.argmin(costs), 1, len(costs) - 2))
        centre = float(at[best] + step * position_of_parabola_minimum(*costs[best - 1 : best + 2]))
        step /= 8.0
        at = centre + step * np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
        costs = spectra.costs_at_delays(at)
    best = int(np.argmin(costs))
    return float(at[best]), float(costs[best])


def delay_std(spectra: Spectra) -> float:
    """Return the standard deviation of the delay [s]; inf if undetermined."""
    reach = spectra.delay_search_half_range_s
    beside = np.array([-_FINE_DELAY_STEP_S, 0.0, _FINE_DELAY_STEP_S])
    left, least, right = spectra.costs_at_delays(spectra.delay + beside)
    far = spectra.costs_at_delays(spectra.delay + np.arange(-reach, reach, _COARSE_DELAY_STEP_S))
    bend = left - 2.0 * least + right
    if bend <= 0.0 or far.max() - least < _MIN_COST_RISE_OFF_DELAY or far.min() < least - 1.0:
        return np.inf
    return float(_FINE_DELAY_STEP_S / np.sqrt(bend))


def guess_knot_spacing_and_delay(
    window: FitWindow, cache: SplineCache, delay: float, *, known: bool
) -> tuple[float, float]:
    """Return likeliest knot distance and delay [s] on a coarse grid; keep the delay if `known`."""
    spacings, found = _knot_spacings_for_pose_rate(cache)[::2], []
    start = window.spectra_at_delay(cache.splines_with_spacing(spacings[0]), delay)
    for h in spacings:
        spectra = start.with_motion(cache.splines_with_spacing(h), window.gravity_W, delay)
        if known:
            found.append((spectra.fit_coefficients().cost, h, delay))
            continue
        reach = spectra.delay_search_half_range_s
        late, cost = find_best_delay_and_cost(spectra, reach, _FINE_DELAY_STEP_S)
        found.append((cost, h, late))
    return min(found)[1:]


def choose_knot_spacing_and_delay(
    window: FitWindow, choices: Sequence[SplineCache], delay: float, *, known: bool
) -> tuple[SplineCache, float, float]:
    """Return splines, knot distance [s] and delay [s] of about the highest likelihood.

    Knots are 8 or 16 % closer than at the highest likelihood. The delay is not changed if `known`.
    """
    coarsest = choices[0].splines_with_spacing(TRIED_KNOT_SPACINGS_S[0])
    start = window.spectra_at_delay(coarsest, delay)

    def fit_cost(cache: SplineCache, knot_spacing_s: float) -> float:
        splines = cache.splines_with_spacing(knot_spacing_s)
        return start.with_motion(splines, window.gravity_W, delay).fit_coefficients().cost

    found = []
    for cache in choices:
        spacings = _knot_spacings_for_pose_rate(cache)
        costs = [(fit_cost(cache, h), h) for h in spacings]
        k = spacings.index(min(costs)[1])
        beside = spacings[max(0, k - 1) : k] + spacings[k + 1 : k + 2]
        between = [float(np.sqrt(spacings[k] * h)) for h in beside]
        found.append(min(costs + [(fit_cost(cache, h), h) for h in between]))
    least = min(range(len(found)), key=lambda k: found[k])
    cache = choices[least]
    finer = _SPACING_OVER_BEST if window.grid.known_load is None else _SPACING_OVER_BEST_KNOWN_LOAD
    best = max(finer * found[least][1], MIN_POSES_PER_KNOT / cache.rate)
    if not known:
        last = start.with_motion(cache.splines_with_spacing(best), window.gravity_W, delay)
        delay, _ = find_best_delay_and_cost(last, 3 * _COARSE_DELAY_STEP_S)
    return cache, best, delay


def spline_cache_of_averaged_poses(poses: Poses) -> SplineCache:
    """Return splines of poses that are averaged to 125 Hz or more."""
    count = max(1, int(poses.rate / _MIN_AVERAGED_POSE_RATE_HZ + 1e-6))
    return SplineCache(poses.average_consecutive(count))


def _knot_spacings_for_pose_rate(cache: SplineCache) -> list[float]:
    usable = [h for h in TRIED_KNOT_SPACINGS_S if h * cache.rate >= MIN_POSES_PER_KNOT]
    return usable or [TRIED_KNOT_SPACINGS_S[0]]


_MAX_CLOCK_RATE_ITERATIONS, _MIN_CLOCK_RATE_LIKELIHOOD_GAIN = 3, 25.0
# A larger change of the delay [s] is not caused by a clock.
_MAX_DELAY_CHANGE_BY_CLOCK_S = 0.2


def estimate_clock_rate_error(
    window: FitWindow, cache: SplineCache, delay: float, spacing: float
) -> float:
    """Return the relative rate error of the poses' clock, such as 5e-5, or 0 if insignificant."""
    first, grid = window.spectra_at_delay(cache.splines_with_spacing(spacing), delay), window.grid
    now, best = first, 0.0
    least = start = now.fit_coefficients().cost
    for _ in range(_MAX_CLOCK_RATE_ITERATIONS):
        step, gain = _clock_rate_step_and_likelihood_gain(now)
        trial = best + step
        if gain < _MIN_CLOCK_RATE_LIKELIHOOD_GAIN and best == 0.0:
            return 0.0
        if abs(trial) * float(grid.t[-1] - grid.t[0]) > 2.0 * _MAX_DELAY_CHANGE_BY_CLOCK_S:
            break
        splines = PoseSplines(correct_clock_rate(cache.poses, trial, grid, delay), spacing)
        now = first.with_motion(splines, window.gravity_W, delay)
        cost = now.fit_coefficients().cost
        if not cost < least:
            break
        least, best = cost, trial
    return best if 2.0 * (start - least) > _MIN_CLOCK_RATE_LIKELIHOOD_GAIN else 0.0


def correct_clock_rate(poses: Poses, rate_error: float, grid: WrenchGrid, delay: float) -> Poses:
    """Return the poses with stamps on the wrench's clock, for a relative rate error of theirs."""
    middle = 0.5 * float(grid.t[0] + grid.t[-1]) + delay
    return Poses(middle + (poses.t - middle) / (1.0 + rate_error), poses.position, poses.quaternion)


def _clock_rate_step_and_likelihood_gain(spectra: Spectra) -> tuple[float, float]:
    fit, grid = spectra.fit_coefficients(), spectra.grid
    change = np.gradient(spectra.motion_signals, grid.dt, axis=0)
    from_middle = (grid.t - 0.5 * (grid.t[0] + grid.t[-1]))[:, None]
    count = len(spectra.bands.frequency)
    free = spectra.signals if grid.known_load is None else spectra.signals[:, :1]
    k = free.shape[1]
    moves = [signal_spectrum(grid, spectra.taper, x, count) for x in (from_middle * change, change)]
    gram, right = np.zeros((2, 2)), np.zeros(2)
    for c, C in enumerate(fit.coefficients):
        power = fit.noise_power[spectra.bands.band_of_frequency, c]
        weight = np.sqrt(spectra.bands.frequency_weight / power)[:, None]
        columns = np.column_stack([free, *(x @ C for x in moves)])
        left = (spectra.wrench[:, c] - spectra.signals @ C)[:, None]
        y = (np.hstack([columns, left]) * weight).view(np.float64).reshape(count, -1, 2)
        y = y.transpose(0, 2, 1).reshape(2 * count, -1)
        G = y.T @ y
        # Eliminate the coefficients.
        reduced = G[k:, k:] - G[k:, :k] @ np.linalg.pinv(G[:k, :k], 1e-12, True) @ G[:k, k:]
        gram += reduced[:2, :2]
        right += reduced[:2, 2]
    inverse = np.linalg.pinv(gram, 1e-12, True)
    step = float(inverse[0] @ right)
    return step, 2.0 * step**2 / float(inverse[0, 0] + 1e-300)
