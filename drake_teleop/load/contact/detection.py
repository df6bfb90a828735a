"""Contact detection, sample by sample, in a wrench from which the load's wrench is removed.

z is the wrench whitened to unit covariance, e (innovation) its part that the previous z does not
predict, at unit variance, and w_n, n = 1, 2, 4 ... 128, a factor from `NoiseFloor.sum_widths`::

    level    |z|; its square is chi-squared with six degrees of freedom
    cusum    |S|, S = (S + e) max(0, 1 - slack / |S + e|) (Crosier, Technometrics 30, 1988)
    glr      max over n of |e_k + ... + e_{k-n+1}| / (w_n sqrt(n)) (Willsky and Jones 1976)
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_teleop.common.compiled import njit
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array, finite_array, positive_array
from drake_teleop.load.contact.noise_floor import (
    MAX_GLR_WINDOW_SAMPLES,
    NUM_GLR_WINDOWS,
    DetectorSamples,
    NoiseFloor,
    noise_std_into,
    noise_variances_into,
    statistic_index,
    validate_detector_samples,
)

# Indices into the memory: sample count; held |a|^2 and |alpha|^2; contact flag; samples
# below CONTACT_END_LEVEL; statistics (3); previous z (6); mean of F_c (6); cumulative sum S (6);
# sum of all e (6); ring of its last MAX_GLR_WINDOW_SAMPLES values.
SAMPLE_COUNT_INDEX, HELD_SQUARES_START = 0, 1
CONTACT_INDEX, QUIET_SAMPLES_INDEX, STATISTICS_START = 3, 4, 5
NORMALIZED_WRENCH_START, MEAN_START, CUSUM_START = 8, 14, 20
INNOVATION_SUM_START, RING_BUFFER_START = 26, 32
MEMORY_SIZE = RING_BUFFER_START + 6 * MAX_GLR_WINDOW_SAMPLES
"""Length of the memory of `update_statistics`."""
CUSUM_SLACK = 1.0
"""Default slack of the cumulative sum [standard deviations]. In white noise, half of the smallest
shift to be detected is best; this value tolerates lasting errors of the load."""
NOISE_LEVEL_ONCE_PER_MILLION_SAMPLES = 6.2
"""Level that normal noise reaches once in a million samples."""
CONTACT_END_LEVEL = 0.7 * NOISE_LEVEL_ONCE_PER_MILLION_SAMPLES
"""Level below which contact may end."""


@njit(cache=True)
def _square_of_innovation_sum(memory, last, n):
    # The sum before the first sample is zero, as is the initial ring.
    before = RING_BUFFER_START + 6 * ((last + MAX_GLR_WINDOW_SAMPLES - n) % MAX_GLR_WINDOW_SAMPLES)
    total = 0.0
    for i in range(6):
        difference = memory[INNOVATION_SUM_START + i] - memory[before + i]
        total += difference * difference
    return total


@njit(cache=True)
def update_statistics(
    memory, contact_wrench, s, omega, alpha, acceleration, parameters, slack, following, quiet_level
):
    """Write level, cusum and glr of one sample to memory[5:8]; `memory` begins with zeros.

    `parameters`: `NoiseFloor.compiled_parameters`; `slack`: of cusum. While level < `quiet_level`,
    a mean follows the contact wrench by the share `following`, and is subtracted.
    """
    variances, P, growth, root, rho, widths, fade = parameters
    V, scaled = np.empty((6, 10)), np.empty(6)
    noise, peaks = (variances, P, growth, fade), memory[HELD_SQUARES_START:CONTACT_INDEX]
    noise_variances_into(peaks, s, omega, alpha, acceleration, *noise, V, scaled)
    for c in range(6):
        scaled[c] = (contact_wrench[c] - memory[MEAN_START + c]) / math.sqrt(scaled[c])
    count = int(memory[SAMPLE_COUNT_INDEX])
    level, length = 0.0, 0.0
    for i in range(6):
        z = 0.0
        for j in range(i + 1):
            z += root[i, j] * scaled[j]
        e = z
        if count > 0:  # the first sample has no predecessor
            e -= rho[i] * memory[NORMALIZED_WRENCH_START + i]
            e /= math.sqrt(1.0 - rho[i] * rho[i])
        memory[NORMALIZED_WRENCH_START + i] = z
        level += z * z
        memory[CUSUM_START + i] += e
        length += memory[CUSUM_START + i] * memory[CUSUM_START + i]
        memory[INNOVATION_SUM_START + i] += e
    level, length = math.sqrt(level), math.sqrt(length)
    if level < quiet_level:
        for c in range(6):
            memory[MEAN_START + c] += following * (contact_wrench[c] - memory[MEAN_START + c])
    shrink = max(0.0, 1.0 - slack / length) if length > 0.0 else 0.0
    for i in range(6):
        memory[CUSUM_START + i] *= shrink
    here = RING_BUFFER_START + 6 * (count % MAX_GLR_WINDOW_SAMPLES)
    best, n = 0.0, 1
    for m in range(NUM_GLR_WINDOWS):
        if n > count + 1:
            break
        best = max(best, _square_of_innovation_sum(memory, count, n) / (n * widths[m] * widths[m]))
        n *= 2
    memory[here : here + 6] = memory[INNOVATION_SUM_START:RING_BUFFER_START]
    memory[SAMPLE_COUNT_INDEX] += 1.0
    memory[STATISTICS_START] = level
    memory[STATISTICS_START + 1] = length * shrink
    memory[STATISTICS_START + 2] = math.sqrt(best)


@njit(cache=True)
def _norm_of_recent_innovation_sum(memory, max_samples, sum_widths):
    m = 0
    while 2 << m <= min(max_samples, MAX_GLR_WINDOW_SAMPLES // 2):
        m += 1
    last = int(memory[SAMPLE_COUNT_INDEX]) - 1
    total = _square_of_innovation_sum(memory, last, 1 << m)
    return math.sqrt(total / (1 << m)) / sum_widths[m]


@njit(cache=True)
def update_flag_with_hysteresis(memory, column, enter, leave, hold, widths):
    """Update the contact flag in `memory` after `update_statistics`; return True in contact.

    Contact begins if statistic number `column` reaches `enter`. It ends after more than `hold`
    samples below `leave`, if the sum of their innovations over its `widths` is below it, too.
    """
    if memory[CONTACT_INDEX] == 0.0:
        if memory[STATISTICS_START + column] >= enter:
            memory[CONTACT_INDEX], memory[QUIET_SAMPLES_INDEX] = 1.0, 0.0
    else:
        quiet = memory[QUIET_SAMPLES_INDEX] + 1.0 if memory[STATISTICS_START] < leave else 0.0
        memory[QUIET_SAMPLES_INDEX] = quiet
        if quiet > hold and _norm_of_recent_innovation_sum(memory, hold, widths) < leave:
            # Reset the sums, because they would decrease too slowly after a long contact. Keep z.
            memory[CONTACT_INDEX] = 0.0
            memory[CUSUM_START:] = 0.0
            memory[SAMPLE_COUNT_INDEX] = 1.0
    return memory[CONTACT_INDEX] != 0.0


@njit(cache=True)
def update_contact_flag(
    memory, contact_wrench, s, omega, alpha, acceleration, parameters, flag_settings
):
    """Update `memory` by a row of `DetectorSamples`; return True in contact."""
    slack, following, statistic, enter, leave, hold = flag_settings
    sample = contact_wrench, s, omega, alpha, acceleration
    update_statistics(memory, *sample, parameters, slack, following, leave)
    return update_flag_with_hysteresis(memory, statistic, enter, leave, hold, parameters[5])


@njit(cache=True)
def _detect_contact_in_rows(memory, rows, settings, statistics, flags):
    contact, s, omega, alpha, acceleration = rows
    for k in range(contact.shape[0]):
        sample = contact[k], s[k], omega[k], alpha[k], acceleration[k]
        flags[k] = update_contact_flag(memory, *sample, *settings)
        statistics[k] = memory[STATISTICS_START : STATISTICS_START + 3]


def statistics_of_log(floor: NoiseFloor, *samples: ArrayLike, slack: float = CUSUM_SLACK) -> Array:
    """Return (N, 3) with columns level, cusum, glr for the arrays of a `DetectorSamples`."""
    # Without contact, which would reset the sums.
    flag_settings = float(positive_array("slack", slack)), 0.0, 0, np.inf, CONTACT_END_LEVEL, 0
    settings = floor.compiled_parameters, flag_settings
    return _statistics_and_contact_flags(np.zeros(MEMORY_SIZE), samples, settings)[0]


def _statistics_and_contact_flags(
    memory: Array, samples: tuple[ArrayLike, ...], settings: tuple[Any, Any]
) -> tuple[Array, NDArray[np.bool_]]:
    rows = validate_detector_samples(*samples)
    statistics, flags = np.empty((len(rows[0]), 3)), np.empty(len(rows[0]), np.bool_)
    _detect_contact_in_rows(memory, tuple(rows), settings, statistics, flags)
    return statistics, flags


class ContactDetector:
    """Contact detector with hysteresis for a stream of samples.

    Args:
        threshold: value of the statistic at which contact begins.
        statistic: "level", "cusum" or "glr", see the module.
        hold: contact ends after more than `hold` successive levels below `CONTACT_END_LEVEL`, if
            also the normalised sum of their innovations is below it.
        following: sample period / time constant of a mean that is subtracted from the contact
            wrench, updated while the level is below `CONTACT_END_LEVEL`; 0: no mean.
    """

    def __init__(
        self,
        floor: NoiseFloor,
        threshold: float,
        *,
        statistic: str = "cusum",
        hold: int = 20,
        following: float = 0.0,
    ) -> None:
        column = statistic_index(statistic)
        enter = float(positive_array("threshold", threshold))
        if not 0.0 <= following < 1.0:
            what = f"{following} is outside the range 0 <= following < 1"
            raise DrakeTeleopError(what, where="following", remedy="use following=0 for no mean")
        flag_settings = CUSUM_SLACK, float(following), column, enter, CONTACT_END_LEVEL, int(hold)
        #: Last arguments of `update_contact_flag`.
        self.settings = (floor.compiled_parameters, flag_settings)
        self._memory = self.initial_memory()

    @staticmethod
    def initial_memory() -> Array:
        return np.zeros(MEMORY_SIZE)

    def update(self, *sample: ArrayLike) -> bool:
        named = zip(DetectorSamples._fields, sample, strict=True)
        arrays = [finite_array(name, x, 6 if name == "contact" else 3) for name, x in named]
        return bool(update_contact_flag(self._memory, *arrays, *self.settings))

    def detect(self, *samples: ArrayLike) -> NDArray[np.bool_]:
        """Process the arrays of a `DetectorSamples`; return (N,) True in contact."""
        return _statistics_and_contact_flags(self._memory, samples, self.settings)[1]


def central_axis_of_wrenches(wrench: ArrayLike) -> tuple[Array, Array, Array]:
    """Return direction, point nearest to So and pitch [m] of the central axes of wrenches, in S.

    NaN for a zero force.
    """
    w = finite_array("wrench", wrench, 6, leading=True)
    f, tau = w[..., :3], w[..., 3:]
    square = np.sum(f * f, axis=-1)
    square = np.where(square > 0.0, square, np.nan)
    direction = f / np.sqrt(square)[..., None]
    return direction, np.cross(f, tau) / square[..., None], np.sum(f * tau, axis=-1) / square


MIN_NOISE_FLOOR_SAMPLES = 100
# Lower limit of a noise floor [N, N m]: residuals of a noise-free simulation are rounding errors.
MIN_WRENCH_NOISE_STD = np.repeat([1e-3, 1e-4], 3)
_MAX_VARIANCE_FITS, _VARIANCE_FIT_TOLERANCE = 20, 1e-4
_MAX_LAG_ONE_CORRELATION, _MIN_SUM_WIDTH, _RARE_SUM_SHARE = 0.999, 0.1, 1e-3


def fit_noise_floor(
    contact: ArrayLike,
    s: ArrayLike,
    omega: ArrayLike,
    alpha: ArrayLike,
    acceleration: ArrayLike,
    covariance: ArrayLike,
    *,
    fade: float = 0.0,
) -> NoiseFloor:
    """Return the noise floor of free motion; `fade`: factor per sample on held accelerations."""
    from scipy.optimize import nnls

    rows = validate_detector_samples(contact, s, omega, alpha, acceleration)
    if len(rows[0]) < MIN_NOISE_FLOOR_SAMPLES:
        what = f"{len(rows[0])} samples of free motion are too few"
        remedy = f"give at least {MIN_NOISE_FLOOR_SAMPLES}"
        raise DrakeTeleopError(what, where="noise floor", remedy=remedy)
    P = finite_array("covariance", covariance, 16, 16)
    parameter_std, no_growth = np.empty_like(rows[0]), np.zeros((6, 2))
    noise_std_into(*rows[1:], np.zeros(6), P, no_growth, fade, parameter_std)
    held = np.empty((2, *rows[0].shape))
    for unit, out in zip(np.eye(2), held, strict=True):
        growth = np.tile(unit, (6, 1))
        noise_std_into(*rows[1:], np.zeros(6), np.zeros((16, 16)), growth, fade, out)
    fitted = np.zeros((6, 3))
    for c in range(6):
        square, explained = rows[0][:, c] ** 2, parameter_std[:, c] ** 2
        terms = np.stack([np.ones(len(square)), *held[:, :, c] ** 2], axis=1)
        variance = np.full(len(square), max(float(square.mean()), MIN_WRENCH_NOISE_STD[c] ** 2))
        for _ in range(_MAX_VARIANCE_FITS):
            previous = fitted[c].copy()
            weighted = np.column_stack([terms, square - explained]) / variance[:, None]
            R = np.asarray(np.linalg.qr(weighted, mode="r"))  # the same problem with four rows
            fitted[c] = nnls(R[:, :3], R[:, 3])[0]
            fitted[c, 0] = max(fitted[c, 0], MIN_WRENCH_NOISE_STD[c] ** 2)
            variance = terms @ fitted[c] + explained
            if np.allclose(fitted[c], previous, rtol=_VARIANCE_FIT_TOLERANCE, atol=0.0):
                break
    noise, per_acceleration = np.sqrt(fitted[:, 0]), np.sqrt(fitted[:, 1:])
    floor = NoiseFloor(noise, P, per_acceleration, np.eye(6), np.zeros(6), fade=fade)
    scaled = rows[0] / floor.noise_std_along(*rows[1:])
    scales = np.maximum(np.sqrt(np.mean(scaled**2, axis=0)), 1e-6)
    power = scaled.T @ scaled / len(scaled) / np.outer(scales, scales)
    # Keeps the correlation positive definite if a channel has no independent noise.
    correlation = 0.999 * power + 0.001 * np.eye(6)
    np.fill_diagonal(correlation, 1.0)
    z = scaled @ np.linalg.inv(np.linalg.cholesky(correlation)).T
    energy = np.maximum(np.sum(z**2, axis=0), 1e-12)
    rho = np.clip(np.sum(z[1:] * z[:-1], axis=0) / energy, 0.0, _MAX_LAG_ONE_CORRELATION)
    e = (z[1:] - rho * z[:-1]) / np.sqrt(1.0 - rho**2)
    sums = np.cumsum(np.vstack([np.zeros(6), e]), axis=0)
    lengths = [min(2**m, len(e)) for m in range(NUM_GLR_WINDOWS)]
    squares = [np.sum((sums[n:] - sums[:-n]) ** 2, axis=1) / n for n in lengths]
    power = np.array([square.mean() for square in squares]) / 6.0
    rare = np.array([np.quantile(square, 1.0 - _RARE_SUM_SHARE) for square in squares])
    # A short record has few long sums: their quantile can be small by chance, their power is not.
    rare /= max(rare[0], 1e-12)
    widths = np.sqrt(np.maximum(np.maximum(power, rare), _MIN_SUM_WIDTH**2))
    floor = replace(floor, correlation=correlation, rho=rho, sum_widths=widths)
    return replace(floor, free_maxima=statistics_of_log(floor, *rows).max(axis=0))
