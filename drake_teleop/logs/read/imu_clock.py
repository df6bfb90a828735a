"""Lag and drift of an IMU's clock behind the pose's clock, for an IMU with any axes."""

from __future__ import annotations

import numpy as np

from drake_teleop.common.numeric import Array
from drake_teleop.logs.read.alignment import resample
from drake_teleop.logs.read.canonical import Log

# Least log likelihood ratio (times 2) and total lag [s] of a significant drift.
_MIN_LIKELIHOOD_RATIO, _MIN_DRIFT_S = 50.0, 0.01


Pairs = list[tuple[Array, Array]]
"""Signal of the pose and of the IMU, for each sensor, see `signal_pairs`."""


def signal_pairs(t: Array, imu: Log, pose: Log, gyroscope: bool) -> Pairs:
    """Return pairs of signals (N, 3): of the pose at times `t`, and of the IMU on its own clock."""
    pairs = [(resample(t, pose.t, pose.specific_force), imu.specific_force)]
    if gyroscope:
        pairs.append((resample(t, pose.t, pose.angular_velocity), imu.angular_velocity))
    return pairs


def best_shift(t: Array, pairs: Pairs, t_imu: Array, reach: float, arm: Array) -> float:
    """Return the lag of the IMU's clock [s], within +-`reach`, with the best fit to the pose.

    Any affine map of the IMU's axes is permitted. Effects linear in `arm` (N, k) are removed.
    """
    U, singular, _ = np.linalg.svd(arm - arm.mean(axis=0), full_matrices=False)
    U = U[:, singular > 1e-3 * singular[0]]

    def without_arm(x: Array) -> Array:
        return x - U @ (U.T @ x)

    expected, sensed = [without_arm(y) for y, _ in pairs], np.hstack([x for _, x in pairs])

    def cost(shift: float) -> float:
        moved = without_arm(resample(t + shift, t_imu, sensed))
        return sum(
            _unexplained_share(y, moved[:, 3 * k : 3 * k + 3]) for k, y in enumerate(expected)
        )

    step = 0.01
    shifts = step * np.arange(-round(reach / step), round(reach / step) + 1)
    costs = np.array([cost(shift) for shift in shifts])
    best = int(np.argmin(costs))
    lag = float(shifts[best])
    if 0 < best < len(shifts) - 1:
        below, least, above = costs[best - 1 : best + 2]
        lag += 0.5 * step * float((below - above) / (below - 2 * least + above + 1e-300))
    return lag


def clock_drift(
    t: Array, pairs: Pairs, t_imu: Array, lag: float, independent: float
) -> tuple[float, float]:
    """Return the lag of the IMU's clock at mid-record [s], and its drift [s/s].

    `lag` [s] is a constant start, `independent` the number of independent samples. A drift that is
    insignificant or below 10 ms in total is 0.
    """
    tau = t - t.mean()
    found = np.array([lag, 0.0])
    start = cost = np.inf
    for step in range(10):
        rows, left, cost = [], [], 0.0
        for y, x in pairs:
            at = t + found[0] + found[1] * tau
            moved, h = resample(at, t_imu, x), 0.01
            rate = (resample(at + h, t_imu, x) - resample(at - h, t_imu, x)) / (2 * h)
            basis = np.column_stack([np.ones(len(t)), moved])
            Q = np.linalg.qr(basis)[0]
            mapped = np.linalg.lstsq(basis, y, rcond=1e-6)[0][1:]
            # Effects of a small shift that a change of the map cannot reproduce.
            effects = [rate @ mapped, tau[:, None] * (rate @ mapped)]
            size = np.sqrt(y.var(axis=0).sum() + 1e-12)
            rows.append(np.stack([(e - Q @ (Q.T @ e)).ravel() / size for e in effects], axis=1))
            left.append(((y - y.mean(axis=0)) - (moved - moved.mean(axis=0)) @ mapped) / size)
            cost += float(left[-1].var(axis=0).sum())
        if step == 0:
            start = cost
        residual = np.concatenate([r.ravel() for r in left])
        found = found + np.linalg.lstsq(np.vstack(rows), residual, rcond=1e-6)[0]
    gain = independent * np.log(start / (cost + 1e-300))
    total_drift_s = abs(found[1]) * float(t[-1] - t[0])
    if gain < _MIN_LIKELIHOOD_RATIO or total_drift_s < _MIN_DRIFT_S:
        return lag, 0.0
    return float(found[0]), float(found[1])


def _unexplained_share(y: Array, x: Array) -> float:
    """Return the share of the variance of y (N, 3) that no affine map of x explains."""
    y, x = y - y.mean(axis=0), x - x.mean(axis=0)
    both, total = x.T @ y, float((y * y).sum()) + 1e-12 * len(y)
    explained = (both * (np.linalg.pinv(x.T @ x, rcond=1e-12, hermitian=True) @ both)).sum()
    return float((y * y).sum() - explained) / total
