"""An IMU beside the poses: rows of acceleration and of turning for the same splines.

Below the frequencies that splines of the poses pass, the IMU is compared with them,

    y(t) = b + (1 + D) x(t + tau) + noise,

y its specific force or angular velocity and x that of the splines: least squares over frequencies,
weighted by the noise of both, for the constants b, the small matrix D (gains and mounting; 0.1 is
its prior deviation, for motions that do not show it) and the time tau. What is left, less what the
poses' own noise makes, is the IMU's noise. So the poses tell its bias, axes and clock, and it tells
what they see too coarsely: with powers S_p and S_s of white noise (variance over rate) of position
and specific force, and S_r and S_w of turn and angular velocity, least squares over both leaves

    1 / (1 / S_p + w^4 / S_s)   and   1 / (1 / S_r + w^2 / S_w)

of noise in position and turn at the frequency w.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.arrays import Array
from drake_teleop.logs.pose_motion.poses import Inertial
from drake_teleop.logs.pose_motion.spectra import Complex, end_taper, without
from drake_teleop.logs.pose_motion.splines import Aid, PoseSplines

_PRIOR = 0.1
_STEPS, _FARTHEST, _ROUNDS, _ENOUGH = 4, 0.1, 10, 40
_LARGEST = 0.2  # of the entries of D
# Share of 1 / h up to which splines pass the motion, and of the motion that may stay unexplained.
_PASSED, _BELIEVABLE = 0.25, 0.05
# Rates [Hz] that are enough to compare and to add, and what a comparison needs at least [s].
_COMPARED, _ADDED, _SHORTEST = 125.0, 500.0, 2.0


@dataclass(frozen=True, eq=False)
class _Sensor:
    """How a sensor of the IMU differs from the poses: y = b + (1 + D) x(t + tau), and its noise."""

    D: Array
    b: Array
    tau: float
    power: float

    def corrected(self, y: Array) -> Array:
        """(K, 3) x of y."""
        return np.asarray(np.linalg.solve(np.eye(3) + self.D, (y - self.b).T).T)


def aid_of(splines: PoseSplines, imu: Inertial, gravity_W: Array) -> Aid | None:
    """What an IMU adds to splines of poses; None if the two do not agree.

    Args:
        splines: of the poses alone.
        imu: on about their clock.
        gravity_W: (3,) [m/s^2].
    """
    powers = tuple(std**2 / splines.rate for std in splines.noise())
    few, sensors = imu.averaged(_COMPARED), []
    for which, y in enumerate((few.specific_force, few.angular_velocity)):
        sensor = None
        if y is not None:
            by_pose = powers[which], 4 - 2 * which
            sensor = _compared(splines, few.t, y, gravity_W, which, by_pose)
            if sensor is None:
                return None
        sensors.append(sensor)
    known = [sensor for sensor in sensors if sensor is not None]
    if not known:
        return None
    rows = imu.averaged(_ADDED)
    t = rows.t + known[-1].tau  # a gyroscope tells the clock best
    inside = (t > splines.poses.t[0]) & (t < splines.poses.t[-1])
    s, omega = (
        None if sensor is None or y is None else sensor.corrected(y[inside])
        for sensor, y in zip(sensors, (rows.specific_force, rows.angular_velocity), strict=True)
    )
    own = [0.0 if sensor is None else sensor.power for sensor in sensors]
    aid = None
    for _ in range(2):  # its rows are turned by an orientation: better by that of both
        aid = Aid.of(
            PoseSplines(splines.poses, splines.spacing, aid),
            t[inside],
            gravity_W,
            s,
            omega,
            rate=rows.rate,
            pose_powers=(powers[0], powers[1]),
            own_powers=(own[0], own[1]),
        )
    return aid


def _compared(
    splines: PoseSplines,
    t: Array,
    y: Array,
    gravity_W: Array,
    which: int,
    by_pose: tuple[float, int],
) -> _Sensor | None:
    """A sensor's values y (K, 3) at t (K,) against the splines; None if these do not explain it.

    Args:
        which: 0 for the specific force, 1 for the angular velocity.
        by_pose: power of the poses' noise, and the power of w with which it comes in.
    """
    dt = float(np.median(np.diff(t)))
    place = np.round((t - t[0]) / dt).astype(int)
    even = t[0] + dt * np.arange(place[-1] + 1)
    lost, values = np.ones(len(even), bool), np.zeros((len(even), 3))
    lost[place], values[place] = False, y
    start, stop = max(t[0], splines.poses.t[0]), min(t[-1], splines.poses.t[-1])
    taper = without(end_taper(even, start + _FARTHEST, stop - _FARTHEST), lost, dt)
    if (taper > 0.5).sum() * dt < _SHORTEST:
        return None
    frequency = np.fft.rfftfreq(len(even), dt)
    used = frequency <= _PASSED / splines.spacing
    noise: NDArray[np.floating] = by_pose[0] * (2.0 * np.pi * frequency[used]) ** by_pose[1]
    energy = float(np.sum(taper**2)) / dt

    def spectrum(x: Array) -> Complex:
        return np.asarray(np.fft.rfft(x * taper[:, None], axis=0)[used], np.complex128)

    # Of its third differences, which know nothing of the motion; 1, 3, 3, 1 squared are 20.
    least = float(np.mean(np.diff(y, 3, axis=0) ** 2)) * dt / 20.0 + 1e-30
    Y, one, tau, power = spectrum(values), spectrum(np.ones((len(even), 1))), 0.0, least
    for step in range(_STEPS):
        x = splines.motion(even + tau, gravity_W)[which]
        X, change = spectrum(x), spectrum(np.gradient(x, dt, axis=0))
        if step == 0:
            power = max(power, float(np.median(np.abs(Y - X) ** 2)) / energy)
        weight = 1.0 / np.sqrt(energy * (noise + power))
        D, b, later = _least_squares(Y - X, X, one, change, weight)
        left: Array = np.abs(Y - X - X @ D.T - one * b - later * change) ** 2
        power = _power(left.sum(axis=1) / (3.0 * energy), noise, least)
        tau += later
        if abs(tau) > _FARTHEST:
            return None
    if np.abs(D).max() > _LARGEST or left[1:].sum() > _BELIEVABLE * (np.abs(X[1:]) ** 2).sum():
        return None
    return _Sensor(D, b, tau, power)


def _least_squares(
    y: Complex, X: Complex, one: Complex, change: Complex, weight: Array
) -> tuple[Array, Array, float]:
    """D (3, 3), b (3,) and tau of y = X D^T + b + tau change, spectra (K, 3)."""
    K = len(y)
    columns = np.zeros((K, 3, 13), complex)
    for i in range(3):
        columns[:, i, 3 * i : 3 * i + 3] = X
        columns[:, i, 9 + i] = one[:, 0]
    columns[:, :, 12] = change
    A = (columns * weight[:, None, None]).reshape(3 * K, 13)
    right = (y * weight[:, None]).ravel()
    gram = (A.conj().T @ A).real
    gram[range(9), range(9)] += 1.0 / _PRIOR**2
    found = np.linalg.solve(gram, (A.conj().T @ right).real)
    return found[:9].reshape(3, 3), found[9:12], float(found[12])


def _power(left: NDArray[np.floating], by_pose: NDArray[np.floating], white: float) -> float:
    """Of noise beside that of the poses, from powers (K,) of both and that of its white part.

    The latter alone where the poses' noise hides the IMU's at most frequencies that are compared.
    """
    power = max(float(np.median(left)), white)
    for _ in range(_ROUNDS):
        weight = 1.0 / (power + by_pose) ** 2
        power = max(float(weight @ (left - by_pose) / weight.sum()), white)
    seen = float(np.sum((white / (white + by_pose)) ** 2))
    return power if seen > _ENOUGH else white
