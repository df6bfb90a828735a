"""Oscillations and contact chatter in recorded signals that the command does not explain.

Chatter: the tool loses and regains contact several times a second.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, uniform_filter1d

from drake_teleop.common.numeric import Array

Flags = NDArray[np.bool_]

# Smallest reported amplitude of a pose: position [m] and orientation [rad].
_MIN_SWING_M, _MIN_SWING_RAD = 5e-4, np.deg2rad(0.5)
COMMAND_REVERSAL_WINDOW_S = 0.25
"""Largest time between a reversal of the command and the reversal that it explains [s]."""
MAX_FORCE_RIPPLE_RMS_AT_REST_N = 0.05
"""Largest rms of the rendered force above 5 Hz while the hand rests [N]."""
# Smallest number of reversals of an oscillation, and longest time between two of them [s].
_MIN_OSCILLATION_REVERSALS, _MAX_REVERSAL_INTERVAL_S = 4, 0.5
# A touch begins where the force exceeds this share of the largest force within the time around it.
_MIN_TOUCH_FORCE_SHARE_OF_PEAK, _PEAK_FORCE_WINDOW_S = 0.1, 0.1
_MIN_TOUCH_INTERVAL_S = 0.005  # closer touches are bounces of one touch-down
_MAX_TOUCH_INTERVAL_OF_CHATTER_S = 0.2  # of a series: 5 Hz
# Smallest number of touches, duration [s] and force [N] of a series.
_MIN_CHATTER_TOUCHES, _MIN_CHATTER_DURATION_S, _MIN_CHATTER_FORCE_N = 8, 0.3, 0.5
# Largest time between a touch and the reversal of the command that explains it [s].
_MAX_TOUCH_TO_COMMAND_REVERSAL_S = 0.1


def reversal_indices(x: Array, min_swing: float) -> NDArray[np.intp]:
    """Return indices of alternate maxima and minima of x (N,) more than `min_swing` apart."""
    slope = np.diff(x)
    near = np.flatnonzero(slope[1:] * slope[:-1] <= 0.0) + 1
    found: list[int] = []
    high = low = 0
    rising = 0  # 0: unknown
    for k in [*near, len(x) - 1]:
        high, low = (k if x[k] > x[high] else high), (k if x[k] < x[low] else low)
        if rising >= 0 and x[high] - x[k] > min_swing:
            found += [high] if rising else []
            rising, high, low = -1, k, k
        elif rising <= 0 and x[k] - x[low] > min_swing:
            found += [low] if rising else []
            rising, high, low = 1, k, k
    return np.array(found, dtype=np.intp)


def flag_unexplained_oscillation(
    t: Array, command: Array, actual: Array, swing: float, window: float = COMMAND_REVERSAL_WINDOW_S
) -> Flags:
    """Return (N,) flags: True while the actual motion oscillates and the command does not.

    An oscillation has at least four reversals larger than `swing`, each within 0.5 s of the
    previous one. The nearest reversal within `window` [s] of a command reversal is not counted.

    Args:
        t: (N,) times [s].
        command, actual: (N, k) commanded and actual motion in the unit of `swing`.
    """
    commanded = np.sort(np.concatenate([t[reversal_indices(x, swing)] for x in command.T]))
    oscillating = np.zeros(len(t), dtype=bool)
    for x in actual.T:
        times = remove_times_near_causes(t[reversal_indices(x, swing)], commanded, window)
        for series in split_times_at_gaps(times, _MAX_REVERSAL_INTERVAL_S):
            if len(series) >= _MIN_OSCILLATION_REVERSALS:
                oscillating |= (t >= series[0]) & (t <= series[-1])
    return oscillating


def flag_pose_oscillation(
    t: Array, command: Array, actual: Array, window: float = COMMAND_REVERSAL_WINDOW_S
) -> Flags:
    """Return (N,) flags: True while the actual pose (N, 7) oscillates and the command does not.

    Reversals exceed 0.5 mm or 0.5 degrees and are over `window` [s] from those of the command.
    """
    turned, wanted = (doubled_quaternions(pose, command) for pose in (actual, command))
    swaying = flag_unexplained_oscillation(t, command[:, 4:], actual[:, 4:], _MIN_SWING_M, window)
    return swaying | flag_unexplained_oscillation(t, wanted, turned, _MIN_SWING_RAD, window)


def pose_reversal_times(t: Array, pose: Array) -> Array:
    """Return sorted times [s] when a pose component (N, 7) reverses by 0.5 mm or 0.5 degrees."""
    rows = [reversal_indices(x, _MIN_SWING_M) for x in pose[:, 4:].T]
    rows += [reversal_indices(x, _MIN_SWING_RAD) for x in doubled_quaternions(pose, pose).T]
    return np.sort(t[np.concatenate(rows)])


def doubled_quaternions(pose: Array, reference: Array) -> Array:
    """Return quaternions (N, 4) of poses (N, 7), times 2: small differences are angles [rad].

    Each quaternion has the sign that is nearer to the pose `reference[0]`.
    """
    q: Array = pose[:, :4]
    return 2 * q * np.where(q @ reference[0, :4] < 0.0, -1.0, 1.0)[:, np.newaxis]


def remove_times_near_causes(times: Array, causes: Array, window: float) -> Array:
    """Return `times` [s] without, for each cause, the nearest one within `window` [s] of it."""
    for cause in causes:
        distances = np.abs(times - cause)
        if len(times) and distances.min() < window:
            times = np.delete(times, distances.argmin())
    return times


def split_times_at_gaps(times: Array, max_gap: float) -> list[Array]:
    """Split sorted times [s] into series where two are more than `max_gap` [s] apart."""
    return np.split(times, np.flatnonzero(np.diff(times) > max_gap) + 1)


def high_pass_above_5_hz(t: Array, signal: Array) -> Array:
    """Return `signal` (N, k) minus its moving mean over 0.2 s; `t` (N,) is evenly spaced [s]."""
    rows = max(round(0.2 / (t[1] - t[0])), 1) if len(t) > 1 else 1
    return signal - uniform_filter1d(signal, rows, axis=0, mode="nearest")


def dominant_frequency(t: Array, signal: Array) -> tuple[float, float]:
    """Return the strongest frequency [Hz] of `signal` (N, k) and the power share within 25 % of it.

    `t` (N,) are evenly spaced times [s].
    """
    spectrum = np.fft.rfft(signal * np.hanning(len(signal))[:, np.newaxis], axis=0)
    power, k = (np.abs(spectrum) ** 2).sum(axis=1), np.arange(len(spectrum))
    near = np.abs(k - power.argmax()) <= 0.25 * power.argmax() + 1
    frequency = float(power.argmax() / (len(signal) * (t[1] - t[0])))
    return frequency, float(power[near].sum() / power.sum())


class ContactChatter(NamedTuple):
    """Series of touches with number, mean rate [Hz], largest force [N], start and stop [s]."""

    num_touches: int
    rate_hz: float
    peak_force: float
    start: float
    stop: float


def find_contact_chatter(t: Array, force: Array, command_reversals: Array) -> list[ContactChatter]:
    """Return each long series of touches, after removal of touches near command reversals.

    A series has 8 or more touches, at most 0.2 s apart, lasts 0.3 s or longer and reaches 0.5 N.

    Args:
        t: (N,) evenly spaced times [s].
        force: (N,) magnitude of the contact force [N].
        command_reversals: times of the command's reversals [s].
    """
    touches = _find_touch_start_times(t, force)
    touches = remove_times_near_causes(touches, command_reversals, _MAX_TOUCH_TO_COMMAND_REVERSAL_S)
    found = []
    for series in split_times_at_gaps(touches, _MAX_TOUCH_INTERVAL_OF_CHATTER_S):
        if len(series) < _MIN_CHATTER_TOUCHES or series[-1] - series[0] < _MIN_CHATTER_DURATION_S:
            continue
        start, stop = float(series[0]), float(series[-1])
        peak = float(force[(t >= start) & (t <= stop)].max())
        if peak >= _MIN_CHATTER_FORCE_N:
            rate = (len(series) - 1) / (stop - start)
            found.append(ContactChatter(len(series), rate, peak, start, stop))
    return found


def _find_touch_start_times(t: Array, force: Array) -> Array:
    if len(t) < 2:
        return np.empty(0)
    rows = 2 * round(_PEAK_FORCE_WINDOW_S / (t[1] - t[0])) + 1
    least = _MIN_TOUCH_FORCE_SHARE_OF_PEAK * maximum_filter1d(force, rows)[1:]
    starts = t[1:][(force[1:] > least) & (force[:-1] <= least)]
    return starts[np.diff(starts, prepend=-np.inf) >= _MIN_TOUCH_INTERVAL_S]
