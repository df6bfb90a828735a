"""How good a detector is: thresholds, false alarms, detections and delays."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from drake_teleop.common.arrays import Array
from drake_teleop.common.errors import DrakeTeleopError


def free_threshold(free: ArrayLike, share: float = 0.0) -> float:
    """The least threshold that at most this share of the samples of free motion reach.

    Args:
        free: (N,) a statistic in free motion.
        share: of false alarms, 0 to 1.
    """
    ordered = np.sort(np.asarray(free, float))[::-1]
    allowed = math.floor(share * len(ordered))
    # An alarm is a statistic that reaches the threshold, so this is just above the next value.
    return float(np.nextafter(ordered[allowed], np.inf)) if allowed < len(ordered) else -math.inf


def roc(free: ArrayLike, touched: ArrayLike) -> tuple[Array, Array, Array]:
    """The receiver operating characteristic of a statistic.

    Args:
        free, touched: (N,), (M,) the statistic in free motion and in contact.

    Returns:
        false_alarms, detections: (K,) shares that reach each threshold, both from 0 to 1.
        thresholds: (K,) descending, the first inf.

    Raises:
        DrakeTeleopError: if either is empty or not finite.
    """
    a, b = _samples("free", free), _samples("touched", touched)
    thresholds = np.concatenate([[np.inf], np.unique(np.concatenate([a, b]))[::-1]])
    shares = [1.0 - np.searchsorted(x, thresholds, side="left") / len(x) for x in (a, b)]
    return shares[0], shares[1], thresholds


def auc(free: ArrayLike, touched: ArrayLike) -> float:
    """Area under `roc`: how often a sample in contact exceeds one in free motion, ties half."""
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
    """How long after the beginning of each contact the alarm is first on.

    An alarm that is on at the beginning already is a false one that happens to last: it counts with
    delay 0 here, and as false where false alarms are counted.

    Args:
        alarms: (N,) flags.
        starts, stops: (K,) first sample of each contact, and the first after it.
        period: between samples [s].

    Returns:
        (K,) delays [s]; NaN for contacts that were missed.
    """
    on = np.asarray(alarms, bool)
    delays = np.full(len(np.atleast_1d(starts)), np.nan)
    for k, (a, b) in enumerate(zip(np.atleast_1d(starts), np.atleast_1d(stops), strict=True)):
        inside = np.flatnonzero(on[a:b])
        if len(inside):
            delays[k] = inside[0] * period
    return delays
