"""Contact detection, sample by sample, in a wrench from which the load's wrench is removed.

The statistics are functions of the normalised wrench z and its unpredictable part e::

    level    |z|; its square is chi-squared with six degrees of freedom
    cusum    |S|, S = (S + e) max(0, 1 - slack / |S + e|) (Crosier, Technometrics 30, 1988)
    glr      max over n of |e_k + ... + e_{k-n+1}| / (w_n sqrt(n)) (Willsky and Jones 1976)
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_teleop.common.compiled import njit
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array, finite_array, positive_array
from drake_teleop.load.contact.noise_floor import (
    HELD_A,
    HELD_ALPHA,
    LENGTHS,
    WINDOW,
    NoiseFloor,
    Samples,
    checked_samples,
    hold_peaks,
    parameter_variance,
    statistic_index,
    write_sigmas,
)

# Indices into the memory: sample count; held |a|^2 and |alpha|^2 (in `noise_floor`); flag; samples
# below `leave`; statistics (3); previous z (6); mean of F_c (6); cumulative sum S (6); sum of all
# e (6); ring of its last WINDOW values.
COUNT, FLAG, QUIET_FOR, FIRST_STATISTIC = 0, 3, 4, 5
Z, MEAN, SUM, TOTAL, RING = 8, 14, 20, 26, 32
SIZE = RING + 6 * WINDOW
"""Length of the memory of `detection_update`."""
DEFAULT_SLACK = 1.0
"""Default slack of the cumulative sum [standard deviations]. In white noise, half of the smallest
shift to be detected is best; this value tolerates lasting errors of the load."""
MAX_NOISE_LEVEL = 6.2
"""Level that normal noise reaches once in a million samples."""
END_LEVEL = 0.7 * MAX_NOISE_LEVEL
"""Level below which contact may end."""


@njit(cache=True)
def detection_update(
    memory, contact, s, omega, alpha, acceleration, parameters, slack, following, quiet
):
    """Process one sample and write level, cusum and glr to memory[5:8].

    `memory` (SIZE,) is zero before the first sample; `quiet` is `leave` of `ContactDetector`.
    """
    variances, P, growth, root, rho, widths, fade = parameters
    V, scaled = np.empty((6, 10)), np.empty(6)
    hold_peaks(memory, acceleration, alpha, fade)
    parameter_variance(s, omega, alpha, P, V, scaled)
    for c in range(6):
        moving = growth[c, 0] * memory[HELD_A] + growth[c, 1] * memory[HELD_ALPHA]
        variance = variances[c] + max(scaled[c], 0.0) + moving
        scaled[c] = (contact[c] - memory[MEAN + c]) / math.sqrt(variance)
    count = int(memory[COUNT])
    level, length = 0.0, 0.0
    for i in range(6):
        z = 0.0
        for j in range(i + 1):
            z += root[i, j] * scaled[j]
        # The first sample has no predecessor.
        e = z if count == 0 else (z - rho[i] * memory[Z + i]) / math.sqrt(1.0 - rho[i] * rho[i])
        memory[Z + i] = z
        level += z * z
        memory[SUM + i] += e
        length += memory[SUM + i] * memory[SUM + i]
        memory[TOTAL + i] += e
    level, length = math.sqrt(level), math.sqrt(length)
    if level < quiet:
        for c in range(6):
            memory[MEAN + c] += following * (contact[c] - memory[MEAN + c])
    shrink = max(0.0, 1.0 - slack / length) if length > 0.0 else 0.0
    for i in range(6):
        memory[SUM + i] *= shrink
    # The sum before the first sample is zero, as is the initial ring.
    here = RING + 6 * (count % WINDOW)
    best, n = 0.0, 1
    for m in range(LENGTHS):
        if n > count + 1:
            break
        before = RING + 6 * ((count + WINDOW - n) % WINDOW)
        total = 0.0
        for i in range(6):
            difference = memory[TOTAL + i] - memory[before + i]
            total += difference * difference
        best = max(best, total / (n * widths[m] * widths[m]))
        n *= 2
    for i in range(6):
        memory[here + i] = memory[TOTAL + i]
    memory[COUNT] += 1.0
    memory[FIRST_STATISTIC] = level
    memory[FIRST_STATISTIC + 1] = length * shrink
    memory[FIRST_STATISTIC + 2] = math.sqrt(best)


@njit(cache=True)
def _statistics(rows, parameters, slack, following, quiet, out):
    contact, s, omega, alpha, acceleration = rows
    memory = np.zeros(SIZE)
    for k in range(contact.shape[0]):
        sample = contact[k], s[k], omega[k], alpha[k], acceleration[k]
        detection_update(memory, *sample, parameters, slack, following, quiet)
        out[k] = memory[FIRST_STATISTIC : FIRST_STATISTIC + 3]


def statistics(
    floor: NoiseFloor, *samples: ArrayLike, slack: float = DEFAULT_SLACK, following: float = 0.0
) -> Array:
    """Return level, cusum and glr (N, 3) of the `Samples` of a log, in standard deviations."""
    rows = checked_samples(*samples)
    out = np.empty((len(rows[0]), 3))
    sums = float(positive_array("slack", slack)), float(following), END_LEVEL
    _statistics(tuple(rows), floor.parameters, *sums, out)
    return out


@njit(cache=True)
def _last_sum(memory, hold, widths):
    m = 0
    while 2 << m <= min(hold, WINDOW // 2):
        m += 1
    # Sum before that window; zero if there was no sample yet.
    before = RING + 6 * ((int(memory[COUNT]) + WINDOW - 1 - (1 << m)) % WINDOW)
    total = 0.0
    for i in range(6):
        difference = memory[TOTAL + i] - memory[before + i]
        total += difference * difference
    return math.sqrt(total / (1 << m)) / widths[m]


@njit(cache=True)
def hysteresis_update(memory, statistic, enter, leave, hold, widths):
    """Return whether there is contact, after `detection_update` of the same memory."""
    if memory[FLAG] == 0.0:
        if memory[FIRST_STATISTIC + statistic] >= enter:
            memory[FLAG], memory[QUIET_FOR] = 1.0, 0.0
    else:
        memory[QUIET_FOR] = memory[QUIET_FOR] + 1.0 if memory[FIRST_STATISTIC] < leave else 0.0
        if memory[QUIET_FOR] > hold and _last_sum(memory, hold, widths) < leave:
            # Reset the sums, because they would decrease too slowly after a long contact. Keep z.
            memory[FLAG] = 0.0
            memory[SUM:] = 0.0
            memory[COUNT] = 1.0
    return memory[FLAG] != 0.0


@njit(cache=True)
def flag_update(memory, contact, s, omega, alpha, acceleration, parameters, decision):
    """Process one sample and return whether there is contact."""
    slack, following, statistic, enter, leave, hold = decision
    detection_update(
        memory, contact, s, omega, alpha, acceleration, parameters, slack, following, leave
    )
    return hysteresis_update(memory, statistic, enter, leave, hold, parameters[5])


@njit(cache=True)
def _flags(memory, rows, settings, out):
    contact, s, omega, alpha, acceleration = rows
    for k in range(contact.shape[0]):
        sample = contact[k], s[k], omega[k], alpha[k], acceleration[k]
        out[k] = flag_update(memory, *sample, *settings)


class ContactDetector:
    """Contact detector with hysteresis for a stream of samples.

    Args:
        threshold: value of the statistic at which contact begins.
        statistic: "level", "cusum" or "glr".
        leave, hold: contact ends after `hold` samples with a level below `leave`.
        slack: slack of the cumulative sum [standard deviations].
        following: sample period over time constant of a mean that is subtracted from the contact
            wrench, updated while the level is below `leave`; 0: no mean.
    """

    def __init__(
        self,
        floor: NoiseFloor,
        threshold: float,
        *,
        statistic: str = "cusum",
        leave: float = END_LEVEL,
        hold: int = 20,
        slack: float = DEFAULT_SLACK,
        following: float = 0.0,
    ) -> None:
        column = statistic_index(statistic)
        enter, exit_level = (
            float(positive_array("threshold", threshold)),
            float(positive_array("leave", leave)),
        )
        if not 0.0 <= following < 1.0:
            raise DrakeTeleopError(
                f"{following} is not at least 0 and below 1",
                where="following",
                remedy="give 0 for no following",
            )
        sums = float(positive_array("slack", slack)), float(following)
        decision = column, enter, exit_level, int(hold)
        #: Last arguments of `flag_update`.
        self.settings = (floor.parameters, (*sums, *decision))
        self._memory = self.initial_memory()

    @staticmethod
    def initial_memory() -> Array:
        return np.zeros(SIZE)

    def update(self, *sample: ArrayLike) -> bool:
        named = zip(Samples._fields, sample, strict=True)
        arrays = [finite_array(name, x, 6 if name == "contact" else 3) for name, x in named]
        return bool(flag_update(self._memory, *arrays, *self.settings))

    def detect(self, *samples: ArrayLike) -> NDArray[np.bool_]:
        """Process N samples of a log; return (N,) True for contact."""
        rows = checked_samples(*samples)
        out = np.empty(len(rows[0]), np.bool_)
        _flags(self._memory, tuple(rows), self.settings, out)
        return out


def wrench_axis(wrench: ArrayLike) -> tuple[Array, Array, Array]:
    """Return direction, point nearest to So and pitch [m] of the central axis of wrenches in S."""
    w = finite_array("wrench", wrench, 6, leading=True)
    f, tau = w[..., :3], w[..., 3:]
    square = np.sum(f * f, axis=-1)
    square = np.where(square > 0.0, square, np.nan)
    direction = f / np.sqrt(square)[..., None]
    return direction, np.cross(f, tau) / square[..., None], np.sum(f * tau, axis=-1) / square


# Lower limit of a noise floor [N, N m], as in `logs.contact`.
_RESOLUTION = np.repeat([1e-3, 1e-4], 3)
_MAX_FITS, _FIT_TOLERANCE = 20, 1e-4
_MAX_RHO, _MIN_WIDTH, _RARE_SHARE = 0.999, 0.1, 1e-3


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
    from scipy.optimize import nnls

    rows = checked_samples(contact, s, omega, alpha, acceleration)
    if len(rows[0]) < 100:
        raise DrakeTeleopError(
            f"{len(rows[0])} samples are too few for a noise floor",
            where="contact",
            remedy="give 100 samples of free motion or more",
        )
    P = finite_array("covariance", covariance, 16, 16)
    parameter_std, no_growth = np.empty_like(rows[0]), np.zeros((6, 2))
    write_sigmas(*rows[1:], np.zeros(6), P, no_growth, fade, parameter_std)
    held = np.empty((2, *rows[0].shape))
    for unit, out in zip(np.eye(2), held, strict=True):
        growth = np.tile(unit, (6, 1))
        write_sigmas(*rows[1:], np.zeros(6), np.zeros((16, 16)), growth, fade, out)
    fitted = np.zeros((6, 3))
    for c in range(6):
        square, explained = rows[0][:, c] ** 2, parameter_std[:, c] ** 2
        terms = np.stack([np.ones(len(square)), *held[:, :, c] ** 2], axis=1)
        variance = np.full(len(square), max(float(square.mean()), _RESOLUTION[c] ** 2))
        for _ in range(_MAX_FITS):
            previous = fitted[c].copy()
            weighted = np.column_stack([terms, square - explained]) / variance[:, None]
            R = np.asarray(np.linalg.qr(weighted, mode="r"))  # the same problem with four rows
            fitted[c] = nnls(R[:, :3], R[:, 3])[0]
            fitted[c, 0] = max(fitted[c, 0], _RESOLUTION[c] ** 2)
            variance = terms @ fitted[c] + explained
            if np.allclose(fitted[c], previous, rtol=_FIT_TOLERANCE, atol=0.0):
                break
    floor = NoiseFloor(
        np.sqrt(fitted[:, 0]), P, np.sqrt(fitted[:, 1:]), np.eye(6), np.zeros(6), fade=fade
    )
    scaled = rows[0] / floor.sigma(*rows[1:])
    deviations = np.sqrt(np.mean(scaled**2, axis=0))
    scales = np.maximum(deviations, 1e-6)
    power = scaled.T @ scaled / len(scaled) / np.outer(scales, scales)
    # Keeps the correlation positive definite if a channel has no independent noise.
    correlation = 0.999 * power + 0.001 * np.eye(6)
    np.fill_diagonal(correlation, 1.0)
    z = scaled @ np.linalg.inv(np.linalg.cholesky(correlation)).T
    energy = np.maximum(np.sum(z**2, axis=0), 1e-12)
    rho = np.clip(np.sum(z[1:] * z[:-1], axis=0) / energy, 0.0, _MAX_RHO)
    e = (z[1:] - rho * z[:-1]) / np.sqrt(1.0 - rho**2)
    sums = np.cumsum(np.vstack([np.zeros(6), e]), axis=0)
    lengths = [min(2**m, len(e)) for m in range(LENGTHS)]
    squares = [np.sum((sums[n:] - sums[:-n]) ** 2, axis=1) / n for n in lengths]
    power = np.array([square.mean() for square in squares]) / 6.0
    rare = np.array([np.quantile(square, 1.0 - _RARE_SHARE) for square in squares])
    # A short record has few long sums: their quantile can be small by chance, their power is not.
    rare /= max(rare[0], 1e-12)
    widths = np.sqrt(np.maximum(np.maximum(power, rare), _MIN_WIDTH**2))
    floor = replace(floor, correlation=correlation, rho=rho, widths=widths)
    return replace(floor, reached=statistics(floor, *rows).max(axis=0))
