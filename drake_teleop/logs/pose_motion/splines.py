"""Motion from poses by splines of position and quaternion, Eqs. (T71), (T72)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import cho_solve_banded, cholesky_banded, solveh_banded
from scipy.optimize import minimize_scalar
from scipy.sparse import csr_array, diags_array, eye_array

from drake_teleop.common.numeric import Array
from drake_teleop.logs.pose_motion.poses import Poses

SPLINE_DEGREE = 5
MIN_POSES_PER_KNOT = 2.0
"""Least average number of poses between two knots."""
NUM_MOTION_SIGNALS = 16
"""Number of columns of `PoseSplines.signals`."""
GRAVITY_COLUMNS, SIGNALS_ZERO_AT_REST = slice(4, 7), [1, 2, 3, *range(7, 16)]
"""Columns of minus gravity, and columns that are zero at rest."""
# Frequency times h where the residual is noise: just above the passed frequencies.
_POSE_NOISE_BAND_OVER_KNOT_RATE = (0.7, 1.5)
_MAX_ROWS_PER_BLOCK = 2**17
_DERIVATIVE_ORDERS_LIMITED_AT_ENDS = range(1, 5)
# Largest weight of the penalty or of a limit over that of the poses; rounding allows no more.
_MAX_PENALTY_OVER_POSE_WEIGHT = 1e12


@dataclass(frozen=True, eq=False)
class ImuSplineRows:
    """IMU data at times t (K,) [s], in the axes and clock of the poses, without bias.

    Attributes:
        rate: mean rate of the data [Hz].
        acceleration_W: (K, 3) acceleration of So in the world [m/s^2], or None.
        quaternion_rate: (K, 4) derivative of the quaternion [1/s], or None.
        pose_noise_powers: noise power densities of position [m^2/Hz] and rotation [rad^2/Hz].
        imu_noise_powers: noise power densities of acceleration and angular velocity.
    """

    t: Array
    rate: float
    pose_noise_powers: tuple[float, float]
    imu_noise_powers: tuple[float, float]
    acceleration_W: Array | None = None
    quaternion_rate: Array | None = None

    def with_sensor_data_in_world_axes(
        self, splines: PoseSplines, gravity_W: Array, s: Array | None, omega: Array | None
    ) -> ImuSplineRows:
        """Return rows in the world from specific force s and angular velocity (K, 3) in S."""
        q = splines.quaternion(self.t)
        n = np.sum(q * q, axis=1, keepdims=True)
        acceleration = rates = None
        if s is not None:
            acceleration = _rotate_W_to_P(q * (1.0, -1.0, -1.0, -1.0), n, s) + gravity_W
        if omega is not None:
            w, v = q[:, :1], q[:, 1:]
            real = -np.sum(v * omega, axis=1, keepdims=True)
            rates = 0.5 * np.hstack([real, w * omega + _cross_products(v, omega)])
        return replace(self, acceleration_W=acceleration, quaternion_rate=rates)

    def pose_noise_shares_left_by_imu(self, frequency: Array) -> tuple[Array, Array]:
        """Return shares (K,) of position and rotation noise that remain with an IMU, (T83)."""
        w = 2.0 * np.pi * frequency
        data = self.acceleration_W, self.quaternion_rate
        ratios = zip(self.pose_noise_powers, self.imu_noise_powers, data, strict=True)
        position, rotation = (0.0 if rows is None else a / b for a, b, rows in ratios)
        return 1.0 / (1.0 + position * w**4), 1.0 / (1.0 + rotation * w**2)


class PoseSplines:
    """Least-squares splines of poses of a frame P, with knots every `spacing` [s].

    Args:
        smooth: penalize the fifth derivative with the likeliest weight, Eq. (T84), and
            derivatives at the ends that exceed usual ones.
    """

    def __init__(
        self,
        poses: Poses,
        spacing: float,
        imu_rows: ImuSplineRows | None = None,
        *,
        smooth: bool = False,
    ) -> None:
        self.poses, self.spacing, self.rate, self.imu_rows = poses, spacing, poses.rate, imu_rows
        self._smooth, self._start = smooth, float(poses.t[0])
        t = poses.t - self._start
        self._blocks = _split_rows_into_blocks(len(t))
        knots = _place_knots(t, spacing, with_imu=imu_rows is not None)
        try:
            self._spline = self._fit_spline(t, knots)
        except np.linalg.LinAlgError:  # too few poses per knot between gaps
            self._spline = self._fit_spline(t, _remove_knots_with_too_few_poses(knots, t))

    def _fit_spline(self, t: Array, knots: Array) -> BSpline:
        poses, imu_rows = self.poses, self.imu_rows
        parts = ((t[x], np.hstack([poses.position[x], poses.quaternion[x]])) for x in self._blocks)
        gram, right = _spline_normal_equations(parts, knots, SPLINE_DEGREE, 7)
        if imu_rows is None:
            if self._smooth:
                return self._fit_smooth_spline(t, knots, gram, right)
            return BSpline(knots, solveh_banded(gram, right), SPLINE_DEGREE)
        columns, shifted_t = [], imu_rows.t - self._start
        inside = (shifted_t >= knots[0]) & (shifted_t <= knots[-1])
        powers = zip(imu_rows.pose_noise_powers, imu_rows.imu_noise_powers, strict=True)
        position = slice(0, 3), 2, imu_rows.acceleration_W
        rotation = slice(3, 7), 1, imu_rows.quaternion_rate
        for (part, order, rows), (pose, own) in zip((position, rotation), powers, strict=True):
            band, side = gram, right[:, part]
            if rows is not None:
                weight = pose * self.rate / (own * imu_rows.rate)
                inner = shifted_t[inside], rows[inside]
                more, other = _normal_equations_of_rates(*inner, knots, order)
                band, side = gram + weight * more, side + weight * other
            columns.append(solveh_banded(band, side))
        return BSpline(knots, np.hstack(columns), SPLINE_DEGREE)

    def _fit_smooth_spline(self, t: Array, knots: Array, gram: Array, right: Array) -> BSpline:
        values = np.hstack([self.poses.position, self.poses.quaternion])
        A = BSpline.design_matrix(t, knots, SPLINE_DEGREE)
        root = diags_array(np.sqrt(np.diff(knots[SPLINE_DEGREE:-SPLINE_DEGREE])))
        root = root @ _derivative_coefficients_matrix(knots, SPLINE_DEGREE)
        penalty = _upper_band_of_gram((root.T @ root).tocsr())
        largest = _MAX_PENALTY_OVER_POSE_WEIGHT * gram[-1].max()
        lowest = (self.rate * penalty[-1].max() / largest) ** (0.5 / SPLINE_DEGREE) / (2 * np.pi)
        coefficients = np.empty_like(right)
        for part in (slice(0, 3), slice(3, 7)):

            def fit_part(ln_cutoff_hz: float, part: slice = part) -> tuple[Array, float, float]:
                """Fit columns `part`; return normal matrix, noise variance, -2 ln likelihood."""
                weight = self.rate / (2 * np.pi * np.exp(ln_cutoff_hz)) ** (2 * SPLINE_DEGREE)
                band = gram + weight * penalty
                factor = cholesky_banded(band)
                c = cho_solve_banded((factor, False), right[:, part])
                misfit = np.square(values[:, part] - A @ c).sum()
                misfit += weight * np.square(root @ c).sum() + 1e-300
                poses, rank = len(t) - SPLINE_DEGREE, len(c) - SPLINE_DEGREE
                cost = poses * np.log(misfit) + 2 * np.log(factor[-1]).sum() - rank * np.log(weight)
                return band, misfit / (poses * c.shape[1]), cost

            bounds = np.log([min(lowest, 0.5 * self.rate), self.rate])
            best = minimize_scalar(
                lambda x: fit_part(x)[2], bounds=bounds, method="bounded", options={"xatol": 0.05}
            )
            band, noise, _ = fit_part(best.x)
            spline = BSpline(knots, solveh_banded(band, right[:, part]), SPLINE_DEGREE)
            self._add_end_derivative_penalties(band, spline, t, noise, largest)
            coefficients[:, part] = solveh_banded(band, right[:, part])
        return BSpline(knots, coefficients, SPLINE_DEGREE)

    def _add_end_derivative_penalties(
        self, band: Array, spline: BSpline, t: Array, noise_variance: float, max_penalty: float
    ) -> None:
        count, margin = SPLINE_DEGREE + 1, SPLINE_DEGREE * self.spacing
        inside = t[(t > t[0] + margin) & (t < t[-1] - margin)]
        if not len(inside):
            return
        x = np.stack([spline(inside, order) for order in _DERIVATIVE_ORDERS_LIMITED_AT_ENDS])
        covariance = np.einsum("inc,jnc->ij", x, x) / (x.shape[1] * x.shape[2])
        std = np.sqrt(np.diag(covariance)) + 1e-150
        correlation = covariance / np.outer(std, std) + 1e-6 * np.eye(len(std))
        weight = noise_variance * np.linalg.inv(correlation) / np.outer(std, std)
        for at, columns in ((t[0], slice(count)), (t[-1], slice(-count, None))):
            basis = BSpline(spline.t, np.eye(band.shape[1])[:, columns], SPLINE_DEGREE)
            values = np.stack([basis(at, order) for order in _DERIVATIVE_ORDERS_LIMITED_AT_ENDS])
            limit = values.T @ weight @ values
            # Constant poses have no derivatives inside; their limit would exceed all poses.
            limit *= min(1.0, max_penalty / np.trace(limit))
            for k in range(count):
                band[SPLINE_DEGREE - k, columns][k:] += np.diag(limit, k)

    def quaternion(self, t: Array) -> Array:
        """Return quaternions (N, 4) [w, x, y, z] of R_WP at times t, nearly of unit length."""
        return np.asarray(self._evaluate_derivative(t, 0)[:, 3:])

    def position(self, t: Array) -> Array:
        """Return positions (N, 3) of Po in the world at times t [m]."""
        return np.asarray(self._evaluate_derivative(t, 0)[:, :3])

    def _evaluate_derivative(self, t: Array, order: int) -> Array:
        at = np.clip(t, self.poses.t[0], self.poses.t[-1]) - self._start
        return np.asarray(self._spline(at, order))

    def signals(self, t: Array, gravity_W: Array) -> Array:
        """Return [1, a, -g, alpha, products of omega] (N, 16) at times t [s], in P, Eq. (T73)."""
        a, minus_g, omega, alpha = self._evaluate_motion_in_P(t, gravity_W)
        products = np.hstack([omega, omega[:, [0, 0, 1]]]) * np.hstack([omega, omega[:, [1, 2, 2]]])
        return np.hstack([np.ones((len(t), 1)), a, minus_g, alpha, products])

    def motion(self, t: Array, gravity_W: Array) -> tuple[Array, Array, Array, Array]:
        """Return specific force of Po, omega, alpha and gravity (N, 3) at times t, in P [SI]."""
        a, minus_g, omega, alpha = self._evaluate_motion_in_P(t, gravity_W)
        return a + minus_g, omega, alpha, -minus_g

    def _evaluate_motion_in_P(self, t: Array, gravity_W: Array) -> Array:
        out = np.empty((4, len(t), 3))
        for part in _split_rows_into_blocks(len(t)):
            x, first, second = (self._evaluate_derivative(t[part], order) for order in range(3))
            q, qd, qdd = x[:, 3:], first[:, 3:], second[:, 3:]
            n = np.sum(q * q, axis=1, keepdims=True)
            omega = 2.0 * _vector_part_of_relative_quaternion(q, qd) / n
            alpha = (
                2.0 * _vector_part_of_relative_quaternion(q, qdd) / n
                - 2.0 * omega * np.sum(q * qd, axis=1, keepdims=True) / n
            )
            minus_g = _rotate_W_to_P(q, n, np.broadcast_to(-gravity_W, omega.shape))
            out[:, part] = _rotate_W_to_P(q, n, second[:, :3]), minus_g, omega, alpha
        return out

    def estimate_pose_noise(self) -> tuple[float, float]:
        """Return the standard deviations per axis of noise of position [m] and rotation [rad]."""
        if self.imu_rows is not None:
            stds = np.sqrt(np.array(self.imu_rows.pose_noise_powers) * self.rate)
            return float(stds[0]), float(stds[1])
        low, high = (share / self.spacing for share in _POSE_NOISE_BAND_OVER_KNOT_RATE)
        sums, count = np.zeros(2), 0
        for part in self._blocks:
            fitted = self._spline(self.poses.t[part] - self._start)
            position = self.poses.position[part] - fitted[:, :3]
            measured = self.poses.quaternion[part]
            turn = 2.0 * _vector_part_of_relative_quaternion(fitted[:, 3:], measured)
            residual, n = np.hstack([position, turn]), len(position)
            frequency = np.fft.rfftfreq(n, 1.0 / self.rate)
            inside = (frequency >= min(low, 0.35 * self.rate)) & (frequency <= high)
            powers = np.array([np.abs(np.fft.rfft(x)[inside]) ** 2 / n for x in residual.T])
            sums += powers.reshape(2, 3, -1).sum(axis=(1, 2))
            count += powers.size // 2
        position_std, rotation_std = np.sqrt(sums / count)
        return float(position_std), float(rotation_std)


class SplineCache:
    """Splines of the same poses by knot spacing, each fitted once."""

    def __init__(self, poses: Poses, imu_rows: ImuSplineRows | None = None) -> None:
        self.poses, self.imu_rows = poses, imu_rows
        self._splines_by_spacing: dict[float, PoseSplines] = {}

    @property
    def rate(self) -> float:
        """Sum of the rates of the fitted poses and IMU data [Hz]."""
        return self.poses.rate + (0.0 if self.imu_rows is None else self.imu_rows.rate)

    def splines_with_spacing(self, spacing: float) -> PoseSplines:
        if spacing not in self._splines_by_spacing:
            self._splines_by_spacing[spacing] = PoseSplines(self.poses, spacing, self.imu_rows)
        return self._splines_by_spacing[spacing]


def noise_share_passed_by_splines(frequency: Array, spacing: float) -> Array:
    """Return the share (K,) of noise power that splines pass at frequencies [Hz], Eq. (T72)."""
    x = np.minimum(frequency * spacing, 0.999)
    share: Array = 1.0 / (1.0 + (x / (1.0 - x)) ** (2 * (SPLINE_DEGREE + 1)))
    return np.where(frequency * spacing < 1.0, share, 0.0)


def _place_knots(t: Array, spacing: float, *, with_imu: bool = False) -> Array:
    inner = np.arange(t[0] + spacing, t[-1] - 0.5 * spacing, spacing)
    if not with_imu:
        before = np.searchsorted(t, inner)
        first = np.unique(before, return_index=True)[1]
        inner = inner[first[(before[first] > 0) & (before[first] < len(t))]]
    start, stop = (np.repeat(end, SPLINE_DEGREE + 1) for end in t[[0, -1]])
    return np.concatenate([start, inner, stop])


def _remove_knots_with_too_few_poses(knots: Array, t: Array) -> Array:
    inner, kept, last = knots[SPLINE_DEGREE + 1 : -SPLINE_DEGREE - 1], [], 0
    for knot, before in zip(inner, np.searchsorted(t, inner), strict=True):
        if min(before - last, len(t) - before) >= MIN_POSES_PER_KNOT:
            kept.append(knot)
            last = before
    return np.concatenate([knots[: SPLINE_DEGREE + 1], kept, knots[-SPLINE_DEGREE - 1 :]])


def _split_rows_into_blocks(num_rows: int) -> list[slice]:
    return [slice(k, k + _MAX_ROWS_PER_BLOCK) for k in range(0, num_rows, _MAX_ROWS_PER_BLOCK)]


def _spline_normal_equations(
    samples: Iterable[tuple[Array, Array]], knots: Array, degree: int, width: int
) -> tuple[Array, Array]:
    """Return a spline's normal equations: banded matrix (degree + 1, n), right side (n, width)."""
    size, order = len(knots) - degree - 1, degree + 1
    band, right = np.zeros((order, size)), np.zeros((size, width))
    for t, x in samples:
        A = BSpline.design_matrix(t, knots, degree)
        basis, first = A.data.reshape(-1, order), A.indices[::order]
        starts = np.flatnonzero(np.diff(first, prepend=-1))  # first row after each knot
        columns = np.hstack([basis, x])
        for i in range(order):
            sums = np.add.reduceat(basis[:, i : i + 1] * columns[:, i:], starts)
            at = first[starts] + i
            for k in range(order - i):
                band[degree - k, at + k] += sums[:, k]
            right[at] += sums[:, -width:]
    return band, right


def _normal_equations_of_rates(t: Array, x: Array, knots: Array, order: int) -> tuple[Array, Array]:
    change = _derivative_coefficients_matrix(knots, order)
    degree, parts = SPLINE_DEGREE - order, _split_rows_into_blocks(len(t))
    inner = knots[order : len(knots) - order]
    band, right = _spline_normal_equations(((t[p], x[p]) for p in parts), inner, degree, x.shape[1])
    upper = diags_array(
        [band[degree - k, k:] for k in range(degree + 1)], offsets=list(range(degree + 1))
    ).tocsr()
    gram = change.T @ (upper + upper.T - diags_array(band[degree])) @ change
    return _upper_band_of_gram(gram.tocsr()), change.T @ right


def _derivative_coefficients_matrix(knots: Array, order: int) -> csr_array:
    change = eye_array(len(knots) - SPLINE_DEGREE - 1, format="csr")
    for k in range(order):
        inner, degree = knots[k : len(knots) - k], SPLINE_DEGREE - k
        span = inner[degree + 1 : -1] - inner[1 : -degree - 1]
        n = len(span)
        step = diags_array([-degree / span, degree / span], offsets=[0, 1], shape=(n, n + 1))
        change = step @ change
    return change


def _upper_band_of_gram(gram: csr_array) -> Array:
    out = np.zeros((SPLINE_DEGREE + 1, gram.shape[0]))
    for k in range(SPLINE_DEGREE + 1):
        out[SPLINE_DEGREE - k, k:] = gram.diagonal(k)
    return out


def _vector_part_of_relative_quaternion(q: Array, p: Array) -> Array:
    v, w = q[:, 1:], p[:, 1:]
    out: Array = q[:, :1] * w - p[:, :1] * v - _cross_products(v, w)
    return out


def _rotate_W_to_P(q: Array, squared_norm: Array, x: Array) -> Array:
    v = -q[:, 1:]
    once = _cross_products(v, x)
    out: Array = x + 2.0 * (q[:, :1] * once + _cross_products(v, once)) / squared_norm
    return out


def _cross_products(a: Array, b: Array) -> Array:
    out = np.empty(a.shape)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        np.subtract(a[:, j] * b[:, k], a[:, k] * b[:, j], out=out[:, i])
    return out
