"""Wrench and motion as block means at about 50 Hz, and sums of their products.

All models of this package are linear in 67 signals of one instant,

    y = [1, s, g, alpha, products of omega, F, dF/dt, R, R p, time],

with specific force s of So, gravity g, wrench F, R = R_SW and position p of So in the world.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from drake_teleop.common.numeric import Array, search_minimum, white_noise_deviations

AR_ORDER = 4  # of the autoregressive noise [rows]
CONSTANT_COLUMN, SPECIFIC_FORCE_SIGNALS, GRAVITY_SIGNALS = 0, slice(1, 4), slice(4, 7)
ALPHA_SIGNALS, OMEGA_PRODUCTS = slice(7, 10), slice(10, 16)
WRENCH_SIGNALS, WRENCH_RATE_SIGNALS = slice(16, 22), slice(22, 28)
ROTATION_SIGNALS, ROTATION_POSITION_PRODUCTS = slice(28, 37), slice(37, 64)
TIME_POLYNOMIALS, NUM_SIGNALS = slice(64, 67), 67
STEP_CHANGE_SIGNAL_INDICES = np.r_[0:16, 28:37]
"""Columns of the load's wrench; a step at t1 repeats them, multiplied by u(t - t1)."""
_INSTANT_RATE_HZ, _MAX_INSTANTS = 50.0, 20_000
_BLOCK_LENGTH_S, _MAX_BLOCKS, _MIN_BLOCK_ROWS = 0.25, 320, 5
_MAX_EXACTLY_AVERAGED_SAMPLES, _MIN_ACCELERATION_OVER_NOISE = 5, 4.0
_MAX_ALPHA_NOISE_SHARE = 1.0 / 64.0
_ALPHA_SMOOTHING_WIDTHS_ROWS = (5, 9, 15, 25)  # windows for a noisy angular acceleration [rows]
_MIN_WRENCH_NOISE_OVER_SIGNAL_STD = 1e-4  # smallest noise of a sensor, as a share of the wrench
_MAX_TRIED_DELAY_S, _DELAY_STEP_S = 0.25, 0.01
_CONSTANT_AND_MOTION_COLUMNS = slice(0, 16)
_OMEGA_PRODUCT_AXIS_PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))

MotionByTime = Callable[[Array], tuple[Array, ...]]
"""Function of times (K,): s, omega, alpha (K, 3); if known R_WS (K, 3, 3) and p (K, 3)."""


@dataclass(frozen=True, eq=False)
class BlockMeans:
    """Means of a record over blocks of about 20 ms.

    Attributes:
        t: (M,) middle of each block [s].
        y: (M, 67) wrench and motion signals, see the module; 0 in unused rows.
        used: (M,) True for rows without gaps and edges.
        wrench_noise: (6,) standard deviation of white wrench noise in a block mean.
        gravity_W: (3,) gravity in the world [m/s^2], or None.
        acceleration_noise: standard deviation of acceleration noise in a block mean [m/s^2]; inf if
            the acceleration is unknown and taken as zero.
        alpha_noise_share: share of noise in the variance of an IMU's angular acceleration.
        clock_rate: name of the model term for a wrong clock rate, or None.
    """

    t: Array
    y: Array
    used: NDArray[np.bool_]
    wrench_noise: Array
    gravity_W: Array | None
    has_positions: bool
    acceleration_noise: float = 0.0
    alpha_noise_share: float = 0.0
    clock_rate: str | None = None

    @cached_property
    def has_enough_acceleration(self) -> bool:
        """True if accelerations exceed their noise enough to separate inertia from weight."""
        if self.gravity_W is None:
            return self.alpha_noise_share < _MAX_ALPHA_NOISE_SHARE
        a = (self.y[:, SPECIFIC_FORCE_SIGNALS] + self.y[:, GRAVITY_SIGNALS])[self.used]
        largest = np.sqrt(a.var(axis=0).max())
        return bool(largest > _MIN_ACCELERATION_OVER_NOISE * self.acceleration_noise)

    @property
    def dt(self) -> float:
        return float(self.t[-1] - self.t[0]) / (len(self.t) - 1)

    @cached_property
    def rows_per_search_block(self) -> int:
        least = -(-len(self.t) // _MAX_BLOCKS)
        return max(least, _MIN_BLOCK_ROWS, round(_BLOCK_LENGTH_S / self.dt))

    def with_only_used_rows(self, used: NDArray[np.bool_]) -> BlockMeans:
        return replace(self, y=np.where(used[:, None], self.y, 0.0), used=used)

    def append_step_signals(self, times: tuple[float, ...]) -> Array:
        """Return y (M, 67) with 25 columns appended for each step time [s].

        These are the 25 signals of the load's wrench, times 0 before and 1 after the step.
        """
        parts = [self.y]
        for time in times:
            share = np.clip((self.t - time) / self.dt + 0.5, 0.0, 1.0)
            parts.append(self.y[:, STEP_CHANGE_SIGNAL_INDICES] * share[:, None])
        return np.hstack(parts)

    def lagged_block_sums(self, y: Array, *, rows: int, lags: int = AR_ORDER + 1) -> Array:
        """Return block sums (blocks, lags, W, W) of products y_i y_(i-d)^T; symmetric."""
        width = y.shape[1]
        count = -(-len(y) // rows)
        padded = np.zeros((lags - 1 + count * rows, width))
        padded[lags - 1 : lags - 1 + len(y)] = y
        now = padded[lags - 1 :].reshape(count, rows, width)
        out = np.empty((count, lags, width, width))
        for d in range(lags):
            before = padded[lags - 1 - d : len(padded) - d].reshape(count, rows, width)
            np.matmul(now.transpose(0, 2, 1), before, out=out[:, d])
            if d:
                out[:, d] += out[:, d].transpose(0, 2, 1).copy()
        return out


def block_means_of_record(
    t: Array,
    wrench: Array,
    motion: MotionByTime | tuple[Array, ...],
    gravity_W: Array | None,
    lost: NDArray[np.bool_] | None = None,
    acceleration_noise: float = 0.0,
) -> BlockMeans:
    """Return block means of a record with N samples at equally spaced times `t` [s].

    The wrench (N, 6) is [f; tau] on the load, in S about So, Eq. (1). `gravity_W` is in the world
    [m/s^2], None without orientation. Blocks with a missing (`lost`) sample are not used.
    """
    dt = float(t[-1] - t[0]) / (len(t) - 1)
    size = max(1, round(1.0 / (_INSTANT_RATE_HZ * dt)), -(-len(t) // _MAX_INSTANTS))
    rows = len(t) // size
    t, wrench = t[: rows * size], wrench[: rows * size]
    middle = t.reshape(rows, size).mean(axis=1)
    y = np.zeros((rows, NUM_SIGNALS))
    y[:, CONSTANT_COLUMN] = 1.0
    y[:, WRENCH_SIGNALS] = wrench.reshape(rows, size, 6).mean(axis=1)
    change = y[2:, WRENCH_SIGNALS] - y[:-2, WRENCH_SIGNALS]
    y[1:-1, WRENCH_RATE_SIGNALS] = change / (2.0 * size * dt)
    positions = _write_motion_and_get_has_positions(y, t, size, motion, gravity_W)
    x = np.linspace(-1.0, 1.0, rows)
    # Legendre polynomials.
    y[:, TIME_POLYNOMIALS] = np.stack([x, 1.5 * x**2 - 0.5, 2.5 * x**3 - 1.5 * x], axis=1)
    used = np.ones(rows, bool)
    used[[0, -1]] = False
    if lost is not None:
        used &= ~lost[: rows * size].reshape(rows, size).any(axis=1)
    white = white_noise_deviations(wrench)
    variance = np.array([column.var() for column in wrench.T])
    spread = np.sqrt(variance.reshape(2, 3).sum(axis=1)).repeat(3)
    white = np.maximum(white, _MIN_WRENCH_NOISE_OVER_SIGNAL_STD * spread)
    share = _smooth_noisy_alpha_and_get_noise_share(y, used) if gravity_W is None else 0.0
    noise = white / np.sqrt(size)
    out = BlockMeans(middle, y, used, noise, gravity_W, positions, acceleration_noise, share)
    return out.with_only_used_rows(used)


def _smooth_noisy_alpha_and_get_noise_share(y: Array, used: NDArray[np.bool_]) -> float:
    from scipy.signal import savgol_filter  # a slow import for a rare case

    alpha = y[used][:, ALPHA_SIGNALS]
    share = _min_noise_share_of_channels(alpha)
    for width in _ALPHA_SMOOTHING_WIDTHS_ROWS:
        if _min_noise_share_of_channels(alpha) < _MAX_ALPHA_NOISE_SHARE or width >= len(alpha):
            break
        alpha = savgol_filter(y[used][:, ALPHA_SIGNALS], width, 2, axis=0)
    y[np.flatnonzero(used)[:, None], np.arange(ALPHA_SIGNALS.start, ALPHA_SIGNALS.stop)] = alpha
    return share


def _min_noise_share_of_channels(x: Array) -> float:
    return float((white_noise_deviations(x) ** 2 / np.maximum(x.var(axis=0), 1e-12)).min())


def _write_motion_and_get_has_positions(
    y: Array, t: Array, size: int, motion: MotionByTime | tuple[Array, ...], gravity_W: Array | None
) -> bool:
    rows, total = len(y), np.zeros(())
    if not callable(motion) or size <= _MAX_EXACTLY_AVERAGED_SAMPLES:
        found = motion(t) if callable(motion) else tuple(x[: len(t)] for x in motion)
        total = _motion_signal_columns(found, gravity_W).reshape(rows, size, -1).mean(axis=1)
    else:  # Simpson's rule over an interval with the variance of `size` samples
        dt = float(t[-1] - t[0]) / (len(t) - 1)
        middle = t.reshape(rows, size).mean(axis=1)
        half = 0.5 * dt * np.sqrt(size**2 - 1.0)
        for shift, weight in ((-half, 1.0), (0.0, 4.0), (half, 1.0)):
            found = motion(middle + shift)
            total = total + weight / 6.0 * _motion_signal_columns(found, gravity_W)
    y[:, 1:16], rest = total[:, :15], total[:, 15:]
    y[:, ROTATION_SIGNALS.start : ROTATION_SIGNALS.start + rest.shape[1]] = rest
    return len(found) == 5


def _motion_signal_columns(motion: Sequence[Array], gravity_W: Array | None) -> Array:
    s, omega, alpha = motion[:3]
    products = np.stack([omega[:, i] * omega[:, k] for i, k in _OMEGA_PRODUCT_AXIS_PAIRS], axis=1)
    if len(motion) == 3 or gravity_W is None:
        return np.hstack([s, np.zeros_like(s), alpha, products])
    R_SW = np.swapaxes(motion[3], 1, 2)
    parts = [s, R_SW @ gravity_W, alpha, products, R_SW.reshape(-1, 9)]
    if len(motion) == 5:
        parts.append((R_SW[:, :, :, None] * motion[4][:, None, None, :]).reshape(-1, 27))
    return np.hstack(parts)


def delay_of_linear_fit(means: BlockMeans) -> float:
    """Return the motion delay behind the wrench [s] with the best linear fit.

    The fit combines 16 motion signals freely, without a rigid load. The delay is limited to
    0.25 s or a tenth of the record, the smaller; return 0 at an end of this range.
    """
    reach = min(_MAX_TRIED_DELAY_S, 0.1 * float(means.t[-1] - means.t[0]))
    rows = means.used & (means.t > means.t[0] + reach) & (means.t < means.t[-1] - reach)
    spline = CubicSpline(means.t, means.y[:, _CONSTANT_AND_MOTION_COLUMNS])
    forces = means.y[rows][:, WRENCH_SIGNALS]
    total = (forces * forces).sum(axis=0)

    def sum_ln_squared_residuals(shift_s: float) -> float:
        x = spline(means.t[rows] + shift_s)
        size = np.sqrt((x * x).mean(axis=0))
        x = x[:, size > 1e-9 * size.max()]
        x /= np.sqrt((x * x).mean(axis=0))
        found = np.linalg.lstsq(x.T @ x, x.T @ forces, rcond=1e-10)[0]
        left = total - ((x.T @ forces) * found).sum(axis=0)
        return float(np.log(np.maximum(left, 1e-12 * total + 1e-30)).sum())

    delay, is_inside = search_minimum(sum_ln_squared_residuals, _DELAY_STEP_S, reach)
    return delay if is_inside else 0.0
