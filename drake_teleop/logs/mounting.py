"""How an IMU sits on the sensor: its rotation and its clock, from the motion of the pose."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations, product

import numpy as np
from numpy.typing import NDArray

from drake_teleop.logs.alignment import low_pass, resample
from drake_teleop.logs.canonical import Log

RIGHT_ANGLED_DEG = 5.0
"""A mounting within this angle of one that only exchanges axes counts as right-angled."""
_REACH = 1.0
_CUTOFF = 8.0
_SAMPLES = 1500
# A drift is believed from this likelihood ratio (twice its logarithm), and if it amounts to this.
_LIKELIHOOD, _DRIFTED = 50.0, 0.01


@dataclass(frozen=True)
class Mounting:
    """The IMU against the pose.

    Args:
        R_SI: (3, 3) rotation from the axes of the IMU's stream to S: `imu.frame` on top of what the
            description says already.
        lag_s: how far the IMU's clock is behind that of the pose: the best single shift [s].
        lag_middle_s: the same in the middle of the record, if the clocks drift; else `lag_s`.
        middle_s: that instant, on the clock of the pose [s].
        drift: growth of the lag [s/s]; 0 if the record does not show one.
        unexplained: share of the variance of the specific force that this leaves.
        mirrored: a reflection fits decisively better, so R_SI means nothing.
        speed_ratio: rms angular speed of the gyroscope over that of the pose; None without one.
    """

    R_SI: NDArray[np.float64]
    lag_s: float
    lag_middle_s: float
    middle_s: float
    drift: float
    unexplained: float
    mirrored: bool
    speed_ratio: float | None

    @property
    def angle_deg(self) -> float:
        """Angle of R_SI [deg]."""
        return _angle_deg(self.R_SI)

    @property
    def right_angled(self) -> NDArray[np.float64]:
        """(3, 3) the nearest of the 24 rotations that only exchange and turn axes."""
        return max(right_angled_rotations(), key=lambda R: float(np.trace(R.T @ self.R_SI)))

    @property
    def is_right_angled(self) -> bool:
        return _angle_deg(self.right_angled.T @ self.R_SI) < RIGHT_ANGLED_DEG


def find_mounting(imu: Log, pose: Log) -> Mounting | None:
    """Rotation and clock of an IMU, from two readings of the same log.

    At every shift s_pose = R s_imu + b is fitted with a rotation R (Kabsch 1976) and a constant b,
    both signals low-passed at 8 Hz; the shift is that of the smallest residual of free linear maps
    of specific force and, with a gyroscope, angular velocity, which do not depend on the axes,
    within +-1 s, refined by a parabola. A drift of the clocks is fitted on top, see `_drift`.

    Args:
        imu: specific force and angular velocity from the IMU.
        pose: the same from the pose alone.

    Returns:
        None if the specific force changes by less than 0.5 m/s^2 (rms), so nothing can be said.
    """
    start, stop = max(imu.t[0], pose.t[0]), min(imu.t[-1], pose.t[-1])
    reach = min(_REACH, 0.2 * float(stop - start))
    cutoff = min(_CUTOFF, 0.2 / imu.dt)
    t = np.linspace(start + reach, stop - reach, _SAMPLES)
    measured = low_pass(imu.specific_force, imu.dt, cutoff)
    expected = resample(t, pose.t, low_pass(pose.specific_force, pose.dt, cutoff))
    variance = float(expected.var(axis=0).sum())
    if variance < 0.25:
        return None
    turn = low_pass(imu.angular_velocity, imu.dt, cutoff)
    turned = resample(t, pose.t, low_pass(pose.angular_velocity, pose.dt, cutoff))
    # Without a gyroscope both readings have the angular velocity of the pose.
    gyroscope = not np.allclose(resample(t, imu.t, turn), turned, atol=1e-9)
    pairs = [(expected, measured)] + ([(turned, turn)] if gyroscope else [])

    def cost(shift: float) -> float:
        return sum(_unmapped(y, resample(t + shift, imu.t, x)) for y, x in pairs)

    step = 0.01
    shifts = step * np.arange(-round(reach / step), round(reach / step) + 1)
    costs = np.array([cost(shift) for shift in shifts])
    best = int(np.argmin(costs))
    lag = float(shifts[best])
    if 0 < best < len(shifts) - 1:
        below, least, above = costs[best - 1 : best + 2]
        lag += 0.5 * step * float((below - above) / (below - 2 * least + above + 1e-300))
    middle, drift = _drift(t, pairs, imu.t, lag, 2 * cutoff * float(t[-1] - t[0]))
    x = resample(t + middle + drift * (t - t.mean()), imu.t, measured)
    x, y = x - x.mean(axis=0), expected - expected.mean(axis=0)
    U, _, Vt = np.linalg.svd(y.T @ x)
    side = np.linalg.det(U @ Vt)
    R, mirror = U @ np.diag([1.0, 1.0, side]) @ Vt, U @ np.diag([1.0, 1.0, -side]) @ Vt
    left_over = float((y - x @ R.T).var(axis=0).sum()) / variance
    reflected = float((y - x @ mirror.T).var(axis=0).sum()) / variance
    speeds = [float(np.linalg.norm(log.angular_velocity, axis=1).std()) for log in (imu, pose)]
    return Mounting(
        R_SI=R,
        lag_s=lag,
        lag_middle_s=middle,
        middle_s=float(t.mean()),
        drift=drift,
        unexplained=left_over,
        mirrored=reflected < 0.25 * left_over and reflected < 0.05,
        speed_ratio=speeds[0] / speeds[1] if speeds[1] > 0.05 else None,
    )


def _drift(
    t: NDArray[np.float64],
    pairs: list[tuple[NDArray[np.float64], NDArray[np.float64]]],
    t_imu: NDArray[np.float64],
    lag: float,
    independent: float,
) -> tuple[float, float]:
    """Lag in the middle and its growth, by Gauss-Newton steps from a constant lag.

    Args:
        t: (N,) times on the clock of the pose.
        pairs: of signals at `t` and signals of the IMU at `t_imu`, each mapped freely.
        t_imu: times on the clock of the IMU.
        lag: the best constant lag [s].
        independent: how many samples of such signals say something new.

    Returns:
        the lag in the middle [s] and its growth [s/s]; `lag` and 0 if the likelihood of a constant
        lag is not exceeded decisively, or the lag changes by less than 10 ms.
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
            # What a small shift does, beyond what another map could do as well.
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
    moved_s = abs(found[1]) * float(t[-1] - t[0])
    if gain < _LIKELIHOOD or moved_s < _DRIFTED:
        return lag, 0.0
    return float(found[0]), float(found[1])


def right_angled_rotations() -> list[NDArray[np.float64]]:
    """The 24 rotations (3, 3) that exchange and turn axes, the identity first."""
    matrices = [
        np.diag(signs) @ np.eye(3)[list(order)]
        for order in permutations(range(3))
        for signs in product((1.0, -1.0), repeat=3)
    ]
    return [R for R in matrices if np.linalg.det(R) > 0]


def _unmapped(y: NDArray[np.float64], x: NDArray[np.float64]) -> float:
    """Share of the variance of y (N, 3) that no affine map of x (N, 3) explains."""
    y, x = y - y.mean(axis=0), x - x.mean(axis=0)
    left_over = y - x @ np.linalg.lstsq(x, y, rcond=1e-6)[0]
    return float(left_over.var(axis=0).sum() / (y.var(axis=0).sum() + 1e-12))


def _angle_deg(R: NDArray[np.float64]) -> float:
    return float(np.degrees(np.arccos(np.clip((np.trace(R) - 1) / 2, -1, 1))))
