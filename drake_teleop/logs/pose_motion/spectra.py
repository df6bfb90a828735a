"""Second moments of a wrench and the signals of its motion, band by band of frequency.

Wrench F and signals zeta (`splines.PoseSplines.signals`) are multiplied by the same taper w(t), 0
where a sample is not to count, and transformed. What is linear at every instant stays so at every
frequency, the tapered constant included; and noise that is coloured is nearly white within a group
of bands. Noise that wanders is not: the bands of a group are narrow at low frequencies, so that it
may rise there (`levels`). Above `TOP` nothing is used. The wrench is transformed at its full rate,
the signals at about 100 Hz over the same span, so that the frequencies are the same.

White noise of variance v has the power v sum(w^2) in each frequency. Neighbours of a tapered record
are alike, so that they count less: as many as (sum w^2)^2 / sum w^4 samples give. A complex number
is two, but for that of frequency zero.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.fft import next_fast_len

from drake_teleop.common.arrays import Array
from drake_teleop.logs.pose_motion.splines import SIGNALS

Complex = NDArray[np.complex128]

TOP = 25.0
"""Frequencies above are not used [Hz]."""
RAMP = 1.0
"""Length of the taper's rise at the ends of the record [s]."""
EDGE = 0.2
"""Length of its rise beside samples that do not count [s]."""
_GRID = 100.0
_EDGES = (0.0, 0.1, 0.25, 0.5, 1.0, 2.0, 3.0, 4.5, 6.5, 9.0, 13.0, 18.0, TOP)
_FEWEST_IN_GROUP = 8.0
# Bands below this frequency [Hz] are at most so wide, as a ratio of their ends.
_NARROW, _RATIO = 3.0, 4.0 / 3.0
FORCES = slice(SIGNALS, SIGNALS + 6)
"""Where the wrench stands in the moments, and the signals' derivatives."""
RATES = slice(SIGNALS + 6, 2 * SIGNALS + 6)
WIDTH = 2 * SIGNALS + 6


@dataclass(frozen=True, eq=False)
class Grid:
    """Instants of the signals, and the wrench between them.

    Attributes:
        t: (M,) evenly spaced, about 100 Hz [s].
        wrench: (N, 6), every `stride`th at an instant of `t`, N = M stride.
        stride: samples of the wrench from one instant to the next.
        load: (6, 16) coefficients of the signals in the wrench of an identified load; None if the
            load is unknown.
    """

    t: Array
    wrench: Array
    stride: int
    load: Array | None = None

    @classmethod
    def of(cls, t: Array, wrench: Array, load: Array | None = None) -> Grid:
        """From evenly spaced samples (N,), (N, 6)."""
        dt = (t[-1] - t[0]) / (len(t) - 1)
        stride = max(1, int(1.0 / (_GRID * dt) + 1e-6))
        rows = len(t) // stride
        return cls(t[0] + stride * dt * np.arange(rows), wrench[: rows * stride], stride, load)

    @property
    def dt(self) -> float:
        """Time from one instant to the next [s]."""
        return float(self.t[-1] - self.t[0]) / (len(self.t) - 1)

    @cached_property
    def length(self) -> int:
        """Of the transforms, in instants."""
        return int(next_fast_len(len(self.t), real=True))

    @cached_property
    def frequency(self) -> Array:
        """(L,) all frequencies of the transforms [Hz]."""
        return np.asarray(np.fft.rfftfreq(self.length, self.dt), np.float64)


@dataclass(frozen=True, eq=False)
class Bands:
    """Bands of frequency.

    Attributes:
        frequency: (K,) those that are used [Hz].
        band: (K,) number of the band of each.
        weight: (K,) how many numbers each is worth, over two.
        group: (count,) number of the group of each band.
    """

    frequency: Array
    band: NDArray[np.intp]
    weight: Array
    group: NDArray[np.intp]

    @property
    def count(self) -> int:
        """How many bands there are."""
        return int(self.band[-1]) + 1

    @cached_property
    def sizes(self) -> Array:
        """(count,) of the bands: half as many independent numbers as each has."""
        return np.asarray(np.bincount(self.band, self.weight), np.float64)

    def sums(self, values: Array) -> Array:
        """(count, ...) sums of (K, ...) over each band, weighted."""
        flat = values.reshape(len(values), -1) * self.weight[:, None]
        starts = np.searchsorted(self.band, np.arange(self.count))
        return np.add.reduceat(flat, starts, axis=0).reshape(self.count, *values.shape[1:])


def bands(grid: Grid, taper: Array, top: float) -> Bands:
    """Of a grid and its taper (M,), up to a frequency; groups of too few are one with the next."""
    frequency = grid.frequency[grid.frequency <= top]
    worth = (taper**2).sum() ** 2 / ((taper**4).sum() * grid.length)
    weight = np.full(len(frequency), worth)
    weight[0] *= 0.5
    group = np.searchsorted(np.array(_EDGES[1:]), frequency, side="right")
    for k in range(len(_EDGES)):
        if 0.0 < weight[group == k].sum() < _FEWEST_IN_GROUP:
            group[group == k] = k + 1
    last = group == group[-1]
    if weight[last].sum() < _FEWEST_IN_GROUP and not last.all():
        group[last] = group[~last][-1]
    narrow = np.log(np.clip(frequency, frequency[1], _NARROW) / frequency[1]) // np.log(_RATIO)
    first = np.concatenate([[True], (np.diff(group) > 0) | (np.diff(narrow) > 0)])
    group = np.unique(group[first], return_inverse=True)[1]
    return Bands(frequency, np.cumsum(first) - 1, weight, group)


def end_taper(t: Array, start: float, stop: float) -> Array:
    """(M,) 1 inside of start ... stop, with cosine ramps; 0 outside."""
    ramp = min(RAMP, 0.1 * (stop - start))
    x = np.clip(np.minimum(t - start, stop - t) / ramp, 0.0, 1.0)
    return 0.5 - 0.5 * np.cos(np.pi * x)


def without(taper: Array, lost: NDArray[np.bool_], dt: float, margin: float = 0.0) -> Array:
    """The taper, 0 where `lost` (M,) and within `margin` [s] of it, with cosine edges beside."""
    edge = np.clip((distance(lost) * dt - margin) / EDGE, 0.0, 1.0)
    return np.asarray(taper * (0.5 - 0.5 * np.cos(np.pi * edge)))


def distance(flags: NDArray[np.bool_]) -> Array:
    """(M,) how many instants away the nearest flag of (M,) is; inf without any."""
    at = np.arange(len(flags), dtype=float)
    before = np.maximum.accumulate(np.where(flags, at, -np.inf))
    after = np.minimum.accumulate(np.where(flags, at, np.inf)[::-1])[::-1]
    return np.minimum(at - before, after - at)


def wrench_spectrum(grid: Grid, taper: Array, count: int) -> Complex:
    """(count, 6) of the tapered wrench, in the units of transforms of `grid.t`."""
    fine = np.zeros(grid.length * grid.stride)
    n = len(grid.wrench)
    full = np.interp(np.arange(n) / grid.stride, np.arange(len(taper)), taper)
    out = np.empty((count, 6), np.complex128)
    for c in range(6):
        fine[:n] = grid.wrench[:, c] * full
        out[:, c] = np.fft.rfft(fine)[:count] / grid.stride
    return out


def signal_spectrum(grid: Grid, taper: Array, zeta: Array, count: int) -> Complex:
    """(count, 16) of the tapered signals (M, 16)."""
    out = np.empty((count, zeta.shape[1]), np.complex128)
    for c, column in enumerate(zeta.T):
        out[:, c] = np.fft.rfft(column * taper, grid.length)[:count]
    return out


def shifted(spectrum: Complex, frequency: Array, shift: float) -> Complex:
    """Signals (K, 16) later by `shift` [s]; the constant stays. The taper moves with them."""
    out = spectrum * np.exp(2j * np.pi * frequency * shift)[:, None]
    out[:, 0] = spectrum[:, 0]
    return out


def later(grid: Grid, taper: Array, shift: float) -> Array:
    """(M,) the taper moved by `shift` [s]."""
    return _passed_through(grid, taper, np.exp(-2j * np.pi * grid.frequency * shift))


def slope(grid: Grid, taper: Array) -> Array:
    """(M,) its derivative [1/s]."""
    return _passed_through(grid, taper, 2j * np.pi * grid.frequency)


def _passed_through(grid: Grid, x: Array, response: NDArray[np.complexfloating]) -> Array:
    return np.asarray(np.fft.irfft(np.fft.rfft(x, grid.length) * response, grid.length)[: len(x)])


def moments(zeta: Complex, wrench: Complex, of: Bands, rates: Complex | None = None) -> Array:
    """(bands, 38, 38) sums of Re y* y^T over each band, y = [zeta (16), F (6), d zeta/dt (16)].

    Without rates (bands, 22, 22).
    """
    parts = [zeta, wrench] if rates is None else [zeta, wrench, rates]
    y = np.hstack(parts) * np.sqrt(of.weight)[:, None]
    starts = np.searchsorted(of.band, np.arange(of.count + 1))
    out = np.empty((of.count, y.shape[1], y.shape[1]))
    for k in range(of.count):
        # Real and imaginary parts as rows: one product of real matrices for each band.
        part = y[starts[k] : starts[k + 1]].view(np.float64).reshape(-1, y.shape[1], 2)
        part = part.transpose(0, 2, 1).reshape(-1, y.shape[1])
        out[k] = part.T @ part
    return out
