"""Quality of a detector: thresholds, false alarms, detections and delays."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from drake_teleop.common.arrays import Array
from drake_teleop.common.errors import DrakeTeleopError


def free_threshold(free: ArrayLike, share: float = 0.0) -> float:
    """Return the least threshold reached by at most this share of free-motion samples.

    Args:
        free: (N,) statistic in free motion.
        share: of false alarms, 0 to 1.
    """
    ordered = np.sort(np.asarray(free, float))[::-1]
    allowed = math.floor(share * len(ordered))
    # A statistic equal to the threshold is an alarm, so the threshold is just above the next value.
    return float(np.nextafter(ordered[allowed], np.inf)) if allowed < len(ordered) else -math.inf


def roc(free: ArrayLike, touched: ArrayLike) -> tuple[Array, Array, Array]:
    """Return the receiver operating characteristic of a statistic.

    Args:
        free, touched: (N,), (M,) statistic in free motion and in contact.

    Returns:
        Shares (K,) of false alarms and detections, and descending thresholds (K,), the first inf.

    Raises:
        DrakeTeleopError: if either is empty or not finite.
    """
    a, b = _samples("free", free), _samples("touched", touched)
    thresholds = np.concatenate([[np.inf], np.unique(np.concatenate([a, b]))[::-1]])
    shares = [1.0 - np.searchsorted(x, thresholds, side="left") / len(x) for x in (a, b)]
    return shares[0], shares[1], thresholds


def auc(free: ArrayLike, touched: ArrayLike) -> float:
    """Return the area under `roc`: share of pairs with contact above free motion, ties half."""
    false_alarms, detections, _ = roc(free, touched)
    return float(np.trapezoid(detections, false_alarms))


def _samples(name: str, value: ArrayLike) -> Array:
    array = np.sort(np.asarray(value, float).ravel())
    if len(array) == 0 or not np.isfinite(array).all():
        raise DrakeTeleopError("holds no samples, or some that are not finite", where=name)
    return array


def detection_delays(
    alarms: ArrayLike, starts: ArrayLike, stops: ArrayLike, period: float = 1.0
) -> Array:
    """Return the delays (K,) of the first alarm in each contact [s]; NaN for a missed contact.

    An alarm that is already on at the start counts as delay 0.

    Args:
        alarms: (N,) flags.
        starts, stops: (K,) first sample of each contact, and the first after it.
        period: between samples [s].
    """
    on = np.asarray(alarms, bool)
    delays = np.full(len(np.atleast_1d(starts)), np.nan)
    for k, (a, b) in enumerate(zip(np.atleast_1d(starts), np.atleast_1d(stops), strict=True)):
        inside = np.flatnonzero(on[a:b])
        if len(inside):
            delays[k] = inside[0] * period
    return delays
