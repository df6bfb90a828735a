"""Motion from poses: splines of position and quaternion, and the signals that a wrench hangs on.

Every column of position p and quaternion q is a least-squares spline of degree 5 with uniform
knots. It takes uneven stamps as they are, and its fifth degree leaves accelerations smooth. With
n = q . q, which noise and the fit keep from 1, and products of quaternions,

    omega = 2 vec(q* qdot) / n,   alpha = 2 vec(q* qddot) / n - 2 omega (q . qdot) / n,

in the axes of the posed frame P. Of white noise at frequency f the splines pass the share

    g(f) = 1 / (1 + (f h / (1 - f h))^12)   below 1 / h

of the power, h the distance of the knots: nearly all up to 0.3 / h, nearly nothing from 0.7 / h on.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.linalg import solveh_banded

from drake_teleop.load.arrays import Array
from drake_teleop.logs.pose_motion.poses import Poses

DEGREE = 5
FEWEST_PER_KNOT = 2.0
"""Poses between two knots, at least, on average."""
SIGNALS = 16
"""Columns of `PoseSplines.signals`."""
# Frequencies times h between which the residual shows the noise: above what the splines pass.
_NOISE_BAND = (0.7, 1.5)
_CHUNK = 2**17


class PoseSplines:
    """Splines of poses.

    Attributes:
        poses: what they were fitted to, signs continuous.
        spacing: h of the knots [s].
        rate: of the poses [Hz].
    """

    def __init__(self, poses: Poses, spacing: float) -> None:
        """Fits them; `poses` with continuous signs, see `Poses.continued`."""
        self.poses, self.spacing, self.rate = poses, spacing, poses.rate
        self._start = float(poses.t[0])
        t = poses.t - self._start
        parts = [slice(k, k + _CHUNK) for k in range(0, len(t), _CHUNK)]
        self._parts, knots = parts, _knots(t, spacing)
        try:
            self._spline = self._fitted(t, knots)
        except np.linalg.LinAlgError:  # between gaps one pose to a knot is too little
            self._spline = self._fitted(t, _sparser(knots, t))

    def _fitted(self, t: Array, knots: Array) -> BSpline:
        poses, parts = self.poses, self._parts
        values = (np.hstack([poses.position[part], poses.quaternion[part]]) for part in parts)
        return _least_squares([t[part] for part in parts], values, knots)

    def signals(self, t: Array, gravity_W: Array) -> Array:
        """(N, 16) signals of P at times t, in the axes of P; outside of the poses those of the end.

        zeta = [1, a (3), -g (3), alpha (3), w_x w_x, w_y w_y, w_z w_z, w_x w_y, w_x w_z, w_y w_z]

        with the acceleration a of Po [m/s^2], gravity g, the angular acceleration alpha and the
        products of angular velocity. Whatever frame, units and axes the sensor has, the wrench of a
        rigid load is linear in them.

        Args:
            t: (N,) [s].
            gravity_W: (3,) in the world [m/s^2].
        """
        a, minus_g, omega, alpha = self._motion(t, gravity_W)
        zeta = np.empty((len(t), SIGNALS))
        zeta[:, 0] = 1.0
        zeta[:, 1:4], zeta[:, 4:7], zeta[:, 7:10] = a, minus_g, alpha
        zeta[:, 10:13] = omega * omega
        for column, (i, j) in enumerate(((0, 1), (0, 2), (1, 2)), start=13):
            zeta[:, column] = omega[:, i] * omega[:, j]
        return zeta

    def motion(self, t: Array, gravity_W: Array) -> tuple[Array, Array, Array]:
        """(N, 3) specific force of Po, angular velocity and acceleration of P, in its axes."""
        a, minus_g, omega, alpha = self._motion(t, gravity_W)
        return a + minus_g, omega, alpha

    def _motion(self, t: Array, gravity_W: Array) -> tuple[Array, Array, Array, Array]:
        """(N, 3) a, -g, omega and alpha."""
        out = np.empty((4, len(t), 3))
        for start in range(0, len(t), _CHUNK):
            part = slice(start, start + _CHUNK)
            out[:, part] = self._motion_at(t[part], gravity_W)
        return out[0], out[1], out[2], out[3]

    def _motion_at(self, t: Array, gravity_W: Array) -> tuple[Array, Array, Array, Array]:
        at = np.clip(t, self.poses.t[0], self.poses.t[-1]) - self._start
        x, first, second = (self._spline(at, order) for order in range(3))
        q, qd, qdd = x[:, 3:], first[:, 3:], second[:, 3:]
        n = np.sum(q * q, axis=1, keepdims=True)
        omega = 2.0 * _vector(q, qd) / n
        alpha = 2.0 * _vector(q, qdd) / n - 2.0 * omega * np.sum(q * qd, axis=1, keepdims=True) / n
        down = np.broadcast_to(-gravity_W, (len(t), 3))
        return _in_P(q, n, second[:, :3]), _in_P(q, n, down), omega, alpha

    def noise(self) -> tuple[float, float]:
        """Standard deviations per axis of position [m] and turn [rad], as if they were white.

        From what the splines leave just above the frequencies that they pass: coloured noise has
        more there than at higher ones.
        """
        sums, count = np.zeros(2), 0
        for part in self._parts:
            fitted = self._spline(self.poses.t[part] - self._start)
            position = self.poses.position[part] - fitted[:, :3]
            turn = 2.0 * _vector(fitted[:, 3:], self.poses.quaternion[part])
            powers = self._powers(position), self._powers(turn)
            sums, count = sums + np.sum(powers, axis=(1, 2)), count + np.size(powers[0])
        place_std, turn_std = np.sqrt(sums / count)
        return float(place_std), float(turn_std)

    def _powers(self, residual: Array) -> Array:
        """(3, m) powers of (K, 3) residuals at the frequencies that show the noise."""
        n = len(residual)
        frequency = np.fft.rfftfreq(n, 1.0 / self.rate)
        low, high = (share / self.spacing for share in _NOISE_BAND)
        inside = (frequency >= min(low, 0.35 * self.rate)) & (frequency <= high)
        return np.array([np.abs(np.fft.rfft(x)[inside]) ** 2 / n for x in residual.T])


class Choice:
    """Splines of the same poses with knots of several distances, each fitted once."""

    def __init__(self, poses: Poses) -> None:
        """`poses` with continuous signs."""
        self.poses = poses
        self._fitted: dict[float, PoseSplines] = {}

    def at(self, spacing: float) -> PoseSplines:
        """Those with knots at this distance [s]."""
        if spacing not in self._fitted:
            self._fitted[spacing] = PoseSplines(self.poses, spacing)
        return self._fitted[spacing]


def passed(frequency: Array, spacing: float) -> Array:
    """Share of white noise's power that splines pass (module docstring)."""
    x = np.minimum(frequency * spacing, 0.999)
    share: Array = 1.0 / (1.0 + (x / (1.0 - x)) ** (2 * (DEGREE + 1)))
    return np.where(frequency * spacing < 1.0, share, 0.0)


def _knots(t: Array, spacing: float) -> Array:
    """Uniform ones, without those that no sample stands before: over a gap goes one polynomial."""
    inner = np.arange(t[0] + spacing, t[-1] - 0.5 * spacing, spacing)
    before = np.searchsorted(t, inner)
    first = np.unique(before, return_index=True)[1]
    inner = inner[first[(before[first] > 0) & (before[first] < len(t))]]
    ends = np.repeat(t[[0, -1]], DEGREE + 1)
    return np.concatenate([ends[: DEGREE + 1], inner, ends[DEGREE + 1 :]])


def _sparser(knots: Array, t: Array) -> Array:
    """Those with `FEWEST_PER_KNOT` samples between any two."""
    inner, kept, last = knots[DEGREE + 1 : -DEGREE - 1], [], 0
    for knot, before in zip(inner, np.searchsorted(t, inner), strict=True):
        if min(before - last, len(t) - before) >= FEWEST_PER_KNOT:
            kept.append(knot)
            last = before
    return np.concatenate([knots[: DEGREE + 1], kept, knots[-DEGREE - 1 :]])


def _least_squares(times: list[Array], values: Iterable[Array], knots: Array) -> BSpline:
    """The spline of these knots next to values (k, 7) at times (k,), part after part.

    By the banded normal equations, as `scipy.interpolate.make_lsq_spline` did before it took QR,
    which is five times slower; with two poses to a knot they lose no digit that a pose has.
    """
    size, order = len(knots) - DEGREE - 1, DEGREE + 1
    band, right = np.zeros((order, size)), np.zeros((size, 7))
    for t, x in zip(times, values, strict=True):
        A = BSpline.design_matrix(t, knots, DEGREE)
        basis, first = A.data.reshape(-1, order), A.indices[::order]
        starts = np.flatnonzero(np.diff(first, prepend=-1))  # of the rows between two knots
        columns = np.hstack([basis, x])
        for i in range(order):
            sums = np.add.reduceat(basis[:, i : i + 1] * columns[:, i:], starts)
            at = first[starts] + i
            for k in range(order - i):
                band[DEGREE - k, at + k] += sums[:, k]
            right[at] += sums[:, -7:]
    return BSpline(knots, solveh_banded(band, right), DEGREE)


def _vector(q: Array, p: Array) -> Array:
    """(N, 3) vector part of q* p."""
    v, w = q[:, 1:], p[:, 1:]
    out: Array = q[:, :1] * w - p[:, :1] * v - _cross(v, w)
    return out


def _in_P(q: Array, n: Array, x: NDArray[np.float64]) -> Array:
    """(N, 3) vectors in the axes of P, of such in the world."""
    v = -q[:, 1:]
    once = _cross(v, x)
    out: Array = x + 2.0 * (q[:, :1] * once + _cross(v, once)) / n
    return out


def _cross(a: Array, b: Array) -> Array:
    """(N, 3) in a fifth of the time that numpy takes."""
    out = np.empty(a.shape)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        np.subtract(a[:, j] * b[:, k], a[:, k] * b[:, j], out=out[:, i])
    return out
