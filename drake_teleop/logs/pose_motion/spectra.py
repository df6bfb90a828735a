"""Spectra, second moments and noise of wrench and signals in frequency bands (docs/theory.md)."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.fft import next_fast_len

from drake_teleop.common.numeric import Array, finite_array, samples_to_nearest_true
from drake_teleop.common.vectors import cross_matrix
from drake_teleop.load.normal_equations import omega_product_jacobians
from drake_teleop.logs.pose_motion.splines import (
    NUM_MOTION_SIGNALS,
    PoseSplines,
    noise_share_passed_by_splines,
)

ComplexArray = NDArray[np.complex128]

MAX_FREQUENCY_HZ = 25.0
"""Highest frequency that is used [Hz]."""
# Length of the taper's ramps at the ends of the record, and beside excluded samples [s].
_TAPER_RAMP_S, _EXCLUSION_RAMP_S = 1.0, 0.2
_WRENCH_GRID_RATE_HZ = 100.0
DELAY_SEARCH_HALF_RANGE_S = 0.25
"""Largest change of the delay in the search, or a tenth of the record [s]."""
_GROUP_EDGES_HZ = (0.0, 0.1, 0.25, 0.5, 1.0, 2.0, 3.0, 4.5, 6.5, 9.0, 13.0, 18.0, MAX_FREQUENCY_HZ)
_MIN_FREQUENCIES_PER_NOISE_GROUP = 8.0
# Largest ratio of the ends of a band below this frequency [Hz].
_MAX_NARROW_BAND_FREQUENCY_HZ, _MAX_NARROW_BAND_EDGE_RATIO = 3.0, 4.0 / 3.0
NUM_SPECTRAL_COLUMNS = 2 * NUM_MOTION_SIGNALS + 6
# Columns of the wrench and of the signals' derivatives in `second_moments`.
WRENCH_COLUMNS = slice(NUM_MOTION_SIGNALS, NUM_MOTION_SIGNALS + 6)
SIGNAL_RATE_SLICE = slice(NUM_MOTION_SIGNALS + 6, NUM_SPECTRAL_COLUMNS)


@dataclass(frozen=True, eq=False)
class WrenchGrid:
    """Uniform times t (M,) of motion signals [s], below 200 Hz, and the wrench (M stride, 6).

    `known_load` (6, 16) are the coefficients of a known load, Eq. (T73).
    """

    t: Array
    wrench: Array
    stride: int
    known_load: Array | None = None

    @classmethod
    def from_samples(cls, t: ArrayLike, wrench: ArrayLike, load: Array | None = None) -> WrenchGrid:
        t = finite_array("t", t, np.size(t))
        wrench = finite_array("wrench", wrench, len(t), 6)
        dt = (t[-1] - t[0]) / (len(t) - 1)
        stride = max(1, int(1.0 / (_WRENCH_GRID_RATE_HZ * dt) + 1e-6))
        rows = len(t) // stride
        return cls(t[0] + stride * dt * np.arange(rows), wrench[: rows * stride], stride, load)

    @property
    def dt(self) -> float:
        return float(self.t[-1] - self.t[0]) / (len(self.t) - 1)

    @cached_property
    def transform_length(self) -> int:
        return int(next_fast_len(len(self.t), real=True))

    @cached_property
    def frequency(self) -> Array:
        return np.asarray(np.fft.rfftfreq(self.transform_length, self.dt), np.float64)


@dataclass(frozen=True, eq=False)
class FrequencyBands:
    """Frequency bands, which form groups with a common noise level.

    Attributes:
        frequency, band_of_frequency: (K,) used frequencies [Hz], and their bands.
        frequency_weight: (K,) half the number of independent values at each frequency.
        group_of_band: (num_bands,) group of each band.
    """

    frequency: Array
    band_of_frequency: NDArray[np.intp]
    frequency_weight: Array
    group_of_band: NDArray[np.intp]

    @property
    def num_bands(self) -> int:
        return int(self.band_of_frequency[-1]) + 1

    @cached_property
    def half_dof_of_bands(self) -> Array:
        """Half the number of independent values (num_bands,) in each band."""
        return np.asarray(np.bincount(self.band_of_frequency, self.frequency_weight), np.float64)

    @cached_property
    def slices(self) -> list[slice]:
        """Slice of `frequency` for each band."""
        starts = np.searchsorted(self.band_of_frequency, np.arange(self.num_bands + 1))
        return [slice(*ends) for ends in itertools.pairwise(starts)]

    def sums_over_bands(self, values: Array) -> Array:
        flat = values.reshape(len(values), -1) * self.frequency_weight[:, None]
        starts = [part.start for part in self.slices]
        return np.add.reduceat(flat, starts, axis=0).reshape(self.num_bands, *values.shape[1:])


def end_taper(t: Array, start: float, stop: float) -> Array:
    """Return a taper (M,): 0 outside `start` to `stop` [s], 1 inside after cosine ramps."""
    ramp = min(_TAPER_RAMP_S, 0.1 * (stop - start))
    x = np.clip(np.minimum(t - start, stop - t) / ramp, 0.0, 1.0)
    return 0.5 - 0.5 * np.cos(np.pi * x)


def exclude_from_taper(
    taper: Array, lost: NDArray[np.bool_], dt: float, margin: float = 0.0
) -> Array:
    """Return the taper (M,) with zeros within `margin` [s] of `lost` instants, and cosine edges."""
    edge = np.clip((samples_to_nearest_true(lost) * dt - margin) / _EXCLUSION_RAMP_S, 0.0, 1.0)
    return np.asarray(taper * (0.5 - 0.5 * np.cos(np.pi * edge)))


@dataclass(frozen=True, eq=False)
class FitWindow:
    """Time window of a fit: weights `taper` (M,), gravity (3,) [m/s^2], highest frequency [Hz]."""

    grid: WrenchGrid
    taper: Array
    gravity_W: Array
    max_frequency_hz: float

    @cached_property
    def bands(self) -> FrequencyBands:
        """Bands up to the highest frequency; groups with few values are joined to the next."""
        taper, frequency = self.taper, self.grid.frequency
        frequency = frequency[frequency <= self.max_frequency_hz]
        worth = (taper**2).sum() ** 2 / ((taper**4).sum() * self.grid.transform_length)
        weight = np.full(len(frequency), worth)
        weight[0] *= 0.5
        group = np.searchsorted(np.array(_GROUP_EDGES_HZ[1:]), frequency, side="right")
        for k in range(len(_GROUP_EDGES_HZ)):
            if 0.0 < weight[group == k].sum() < _MIN_FREQUENCIES_PER_NOISE_GROUP:
                group[group == k] = k + 1
        last = group == group[-1]
        if weight[last].sum() < _MIN_FREQUENCIES_PER_NOISE_GROUP and not last.all():
            group[last] = group[~last][-1]
        low = np.clip(frequency, frequency[1], _MAX_NARROW_BAND_FREQUENCY_HZ) / frequency[1]
        narrow = np.log(low) // np.log(_MAX_NARROW_BAND_EDGE_RATIO)
        first = np.concatenate([[True], (np.diff(group) > 0) | (np.diff(narrow) > 0)])
        group = np.unique(group[first], return_inverse=True)[1]
        return FrequencyBands(frequency, np.cumsum(first) - 1, weight, group)

    @cached_property
    def wrench_spectrum(self) -> ComplexArray:
        """Spectrum (K, 6) of the tapered wrench at the grid rate."""
        stride, n = self.grid.stride, len(self.grid.wrench)
        fine = np.zeros(self.grid.transform_length * stride)
        full = np.interp(np.arange(n) / stride, np.arange(len(self.taper)), self.taper)
        out = np.empty((len(self.bands.frequency), 6), np.complex128)
        for c in range(6):
            fine[:n] = self.grid.wrench[:, c] * full
            out[:, c] = np.fft.rfft(fine)[: len(out)] / stride
        return out

    @property
    def delay_search_half_range_s(self) -> float:
        return min(DELAY_SEARCH_HALF_RANGE_S, 0.1 * float(self.grid.t[-1] - self.grid.t[0]))

    @cached_property
    def is_taper_fixed(self) -> bool:
        """Whether a delay shifts only the signals, not the taper: with gaps or a known load."""
        inside = np.flatnonzero(self.taper > 0.5)
        edged = len(inside) > 0 and len(inside) <= inside[-1] - inside[0]
        return bool(edged or self.grid.known_load is not None)

    def signal_spectrum(self, x: Array, taper: Array | None = None) -> ComplexArray:
        """Return the spectrum (K, k) of tapered signals x (M, k)."""
        out = np.empty((len(self.bands.frequency), x.shape[1]), np.complex128)
        weight = self.taper if taper is None else taper
        for c, column in enumerate(x.T):
            out[:, c] = np.fft.rfft(column * weight, self.grid.transform_length)[: len(out)]
        return out

    def filtered_taper(self, response: NDArray[np.complexfloating]) -> Array:
        """Return the taper (M,), filtered by a frequency `response` on the grid."""
        n = self.grid.transform_length
        return np.asarray(np.fft.irfft(np.fft.rfft(self.taper, n) * response, n)[: len(self.taper)])

    def select_and_taper_rows(self, rows: slice) -> FitWindow:
        grid = self.grid
        wrench = grid.wrench[rows.start * grid.stride : rows.stop * grid.stride]
        grid = replace(grid, t=grid.t[rows], wrench=wrench)
        taper = self.taper[rows] * end_taper(grid.t, grid.t[0], grid.t[-1])
        return replace(self, grid=grid, taper=taper)

    def spectra_at_delay(self, splines: PoseSplines, delay: float) -> Spectra:
        """Return spectra of the wrench, and of the motion that is `delay` [s] behind it."""
        zeta = splines.signals(self.grid.t + delay, self.gravity_W)
        return Spectra(self, self.signal_spectrum(zeta), delay, zeta)


@dataclass(frozen=True, eq=False)
class Spectra:
    """Spectra of wrench (K, 6) and 16 motion signals (K, 16) at K frequencies of a window.

    Attributes:
        delay: delay of the signals behind the wrench [s].
        motion_signals: (M, 16) signals over time, see `PoseSplines.signals`.
    """

    window: FitWindow
    signals: ComplexArray
    delay: float
    motion_signals: Array

    def with_delay(self, delay: float) -> Spectra:
        """Return the spectra with motion signals at another delay [s]."""
        window, shift, signals = self.window, delay - self.delay, self.signals
        if window.is_taper_fixed:
            before = window.filtered_taper(np.exp(-2j * np.pi * window.grid.frequency * shift))
            signals = window.signal_spectrum(self.motion_signals, before)
        late = signals * np.exp(2j * np.pi * window.bands.frequency * shift)[:, None]
        late[:, 0] = self.signals[:, 0]
        return replace(self, signals=late, delay=delay)

    def second_moments(self) -> Array:
        """Return second moments (bands, 22, 22) of signals and wrench."""
        return second_moments(self.window.bands, self.signals, self.window.wrench_spectrum)

    def second_moments_with_rates(self) -> Array:
        """Return second moments (bands, 38, 38) of signals, wrench, and derivatives of signals."""
        window = self.window
        rates = 2j * np.pi * window.bands.frequency[:, None] * self.signals
        edges = window.filtered_taper(2j * np.pi * window.grid.frequency)
        rates -= window.signal_spectrum(self.motion_signals, edges)
        rates[:, 0] = 0.0
        return second_moments(window.bands, self.signals, window.wrench_spectrum, rates)

    def second_moments_at_delays(self, delays: Array) -> Array:
        """Return second moments (D, bands, 22, 22) at delays (D,) [s], valid in signal rows."""
        bands, wrench = self.window.bands, self.window.wrench_spectrum
        if self.window.is_taper_fixed:
            return np.array([self.with_delay(delay).second_moments() for delay in delays])
        fixed = np.column_stack([wrench, self.signals[:, 0]]) * bands.frequency_weight[:, None]
        products = np.conj(self.signals)[:, :, None] * fixed[:, None]
        flat = products.reshape(len(products), -1)
        angle = 2.0 * np.pi * np.outer(delays - self.delay, bands.frequency)
        cosine, sine = np.cos(angle), np.sin(angle)
        sums = np.empty((len(delays), bands.num_bands, flat.shape[1]))
        for k, part in enumerate(bands.slices):
            sums[:, k] = cosine[:, part] @ flat[part].real + sine[:, part] @ flat[part].imag
        moving = sums.reshape(len(delays), bands.num_bands, NUM_MOTION_SIGNALS, 7)[:, :, 1:]
        Z = np.repeat(self.second_moments()[None], len(delays), axis=0)
        Z[..., 1:NUM_MOTION_SIGNALS, WRENCH_COLUMNS] = moving[..., :6]
        Z[..., 1:NUM_MOTION_SIGNALS, 0] = Z[..., 0, 1:NUM_MOTION_SIGNALS] = moving[..., 6]
        return Z


def real_and_imaginary_rows(y: ComplexArray) -> Array:
    """Return rows (2 K, k): real and imaginary part alternate for each row of y (K, k)."""
    parts = y.view(np.float64).reshape(*y.shape, 2)
    return parts.transpose(0, 2, 1).reshape(-1, y.shape[1])


def second_moments(bands: FrequencyBands, *spectra: ComplexArray) -> Array:
    """Return sums of Re conj(y) y^T (bands, n, n) in each band, for spectra y of n columns."""
    y = np.hstack(spectra) * np.sqrt(bands.frequency_weight)[:, None]
    # Real and imaginary parts as rows need only one real product per band.
    parts = (real_and_imaginary_rows(y[part]) for part in bands.slices)
    return np.array([part.T @ part for part in parts])


_MIN_REMAINING_DOF_SHARE = 0.25


@dataclass(frozen=True, eq=False)
class NoiseLevels:
    """Noise of the wrench, with one level for each group of bands and channel.

    `relative_power` (bands, 6) is the noise power of a band over the level of its group.
    """

    half_dof_of_bands: Array
    group_of_band: NDArray[np.intp]
    relative_power: Array

    @classmethod
    def white_noise_in_each_group(cls, bands: FrequencyBands) -> NoiseLevels:
        return cls(bands.half_dof_of_bands, bands.group_of_band, np.ones((bands.num_bands, 6)))

    def noise_power(self, sums: Array, used: Array | None = None) -> Array:
        """Return the noise power (..., bands, 6) of residuals, from `sums` of squares in bands.

        `used` (bands, 6) degrees of freedom are those of fitted parameters.
        """
        remaining = self.sums_over_groups(self.half_dof_of_bands)[:, None]
        if used is not None:
            left = remaining - 0.5 * self.sums_over_groups(used)
            remaining = np.maximum(left, _MIN_REMAINING_DOF_SHARE * remaining)
        white = sums / self.relative_power
        level = np.add.reduceat(white, self._first_bands_of_noise_groups, axis=-2) / remaining
        return np.asarray(level[..., self.group_of_band, :] * self.relative_power)

    def sums_over_groups(self, x: Array) -> Array:
        return np.asarray(np.add.reduceat(x, self._first_bands_of_noise_groups, axis=0))

    @cached_property
    def _first_bands_of_noise_groups(self) -> NDArray[np.intp]:
        return np.flatnonzero(np.diff(self.group_of_band, prepend=-1))

    def negative_log_likelihoods(self, power: Array) -> Array:
        """Return negative log likelihoods (..., 6) of `power` (..., bands, 6), Eq. (T75)."""
        return np.asarray(self.half_dof_of_bands @ np.log(power))


def random_walk_relative_power(bands: FrequencyBands, corner: float) -> Array:
    """Return the mean (bands,) of 1 + (corner / f)^2 in each band, Eq. (T74)."""
    f = np.maximum(bands.frequency, bands.frequency[1])
    return np.asarray(1.0 + bands.sums_over_bands((corner / f) ** 2) / bands.half_dof_of_bands)


OMEGA_PRODUCT_COLUMNS = np.array([[10, 13, 14], [13, 11, 15], [14, 15, 12]])
"""(3, 3) indices of the products of angular velocity among the signals."""
_ACCELERATION_COLUMNS, _GRAVITY_COLUMNS, _ALPHA_COLUMNS = slice(1, 4), slice(4, 7), slice(7, 10)


def pose_noise_moments(splines: PoseSplines, spectra: Spectra, noise: tuple[float, float]) -> Array:
    """Return second moments (bands, 38, 38) of signals, wrench, signal rates due to pose noise.

    `noise`: standard deviations of position [m] and rotation [rad].
    """
    taper, bands = spectra.window.taper, spectra.window.bands
    w2 = (2.0 * np.pi * bands.frequency) ** 2
    per_number = np.sum(taper**2) / (spectra.window.grid.dt * splines.rate)
    share = per_number * noise_share_passed_by_splines(bands.frequency, splines.spacing)
    position_power, rotation_power = (std**2 * share for std in noise)
    if splines.imu_rows is not None:
        left = splines.imu_rows.pose_noise_shares_left_by_imu(bands.frequency)
        position_power, rotation_power = position_power * left[0], rotation_power * left[1]
    weight = taper**2 / np.sum(taper**2)
    shapes = _signal_covariances_by_unit_pose_noise(spectra.motion_signals, weight)
    powers = position_power * w2**2, rotation_power, rotation_power * w2, rotation_power * w2**2
    Q = np.zeros((bands.num_bands, NUM_SPECTRAL_COLUMNS, NUM_SPECTRAL_COLUMNS))
    signals, rates = slice(0, NUM_MOTION_SIGNALS), SIGNAL_RATE_SLICE
    for power, shape in zip(powers, shapes, strict=True):
        Q[:, signals, signals] += bands.sums_over_bands(power)[:, None, None] * shape
        Q[:, rates, rates] += bands.sums_over_bands(power * w2)[:, None, None] * shape
    return Q


def _signal_covariances_by_unit_pose_noise(signals: Array, weight: Array) -> tuple[Array, ...]:
    place, still, cross, products, alpha = np.zeros((5, NUM_MOTION_SIGNALS, NUM_MOTION_SIGNALS))
    place[_ACCELERATION_COLUMNS, _ACCELERATION_COLUMNS] = np.eye(3)
    mean = weight @ signals
    for left in (_ACCELERATION_COLUMNS, _GRAVITY_COLUMNS):
        for right in (_ACCELERATION_COLUMNS, _GRAVITY_COLUMNS):
            # Mean of (x x d)(y x d)^T for a rotation d of unit covariance.
            both = (weight[:, None] * signals[:, left]).T @ signals[:, right]
            still[left, right] = np.trace(both) * np.eye(3) - both.T
    for where in (_ACCELERATION_COLUMNS, _GRAVITY_COLUMNS):
        cross[where, _ALPHA_COLUMNS] = -cross_matrix(mean[where])
        cross[_ALPHA_COLUMNS, where] = cross[where, _ALPHA_COLUMNS].T
    ww = mean[OMEGA_PRODUCT_COLUMNS]
    for jacobian in omega_product_jacobians(OMEGA_PRODUCT_COLUMNS, NUM_MOTION_SIGNALS):
        products += jacobian.T @ ww @ jacobian
    alpha[_ALPHA_COLUMNS, _ALPHA_COLUMNS] = np.eye(3)
    return place, still, cross + products, alpha
