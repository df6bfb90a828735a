"""Lasting contact chatter: the tool loses and regains contact several times a second."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

from drake_teleop.station.oscillation import remove_explained_times, split_at_gaps

Array = NDArray[np.float64]

# A touch begins where the force exceeds this share of the largest force within the time around it.
_TOUCH_FORCE_SHARE, _PEAK_FORCE_WINDOW_S = 0.1, 0.1
# Smallest time between two touches [s]; closer ones are bounces of one touch-down.
_MIN_TOUCH_INTERVAL_S = 0.005
# Largest time between two touches of a series [s]: 5 Hz.
_MAX_TOUCH_INTERVAL_S = 0.2
# Smallest number of touches, duration [s] and force [N] of a series.
_MIN_CHATTER_TOUCHES, _MIN_CHATTER_DURATION_S, _MIN_CHATTER_FORCE_N = 8, 0.3, 0.5
# Largest time between a touch and the reversal of the command that explains it [s].
_MAX_TIME_TO_REVERSAL_S = 0.1


class Chatter(NamedTuple):
    """Series of touches: number, mean rate [Hz], largest force [N], start and stop [s]."""

    touches: int
    rate_hz: float
    peak_force: float
    start: float
    stop: float


def find_chatter(t: Array, force: Array, reversals: Array) -> list[Chatter]:
    """Return each long series of touches, without touches explained by reversals of the command.

    A series has 8 or more touches, at most 0.2 s apart, and lasts 0.3 s or longer.

    Args:
        t: (N,) evenly spaced times [s].
        force: (N,) magnitude of the contact force [N].
        reversals: times of the command's reversals [s].
    """
    touches = remove_explained_times(_find_touches(t, force), reversals, _MAX_TIME_TO_REVERSAL_S)
    found = []
    for series in split_at_gaps(touches, _MAX_TOUCH_INTERVAL_S):
        if len(series) < _MIN_CHATTER_TOUCHES or series[-1] - series[0] < _MIN_CHATTER_DURATION_S:
            continue
        start, stop = float(series[0]), float(series[-1])
        peak = float(force[(t >= start) & (t <= stop)].max())
        if peak >= _MIN_CHATTER_FORCE_N:
            rate = (len(series) - 1) / (stop - start)
            found.append(Chatter(len(series), rate, peak, start, stop))
    return found


def _find_touches(t: Array, force: Array) -> Array:
    if len(t) < 2:
        return np.empty(0)
    rows = 2 * round(_PEAK_FORCE_WINDOW_S / (t[1] - t[0])) + 1
    least = _TOUCH_FORCE_SHARE * maximum_filter1d(force, rows)[1:]
    starts = t[1:][(force[1:] > least) & (force[:-1] <= least)]
    return starts[np.diff(starts, prepend=-np.inf) >= _MIN_TOUCH_INTERVAL_S]
