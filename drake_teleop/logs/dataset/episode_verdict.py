"""Faults of an episode's wrench, found by comparison with the wrench of a known load.

A hypothesis predicts the reading G M p(t + lag) + offsets, with the load's wrench p, a rotation or
mirroring M and factors G of force and torque. The simplest hypothesis is chosen unless another one
reduces the spread of the residual decisively. The spread is that of the calmer half of the frames,
so that contact has no influence.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.numeric import Array, width_and_centre_of_narrowest_half
from drake_teleop.common.rotations import rotation_matrices, signed_permutations
from drake_teleop.load.regressor import non_contact_wrench, regressor
from drake_teleop.logs.pose_motion.splines import MIN_POSES_PER_KNOT, PoseSplines
from drake_teleop.logs.read.alignment import resample
from drake_teleop.logs.read.canonical import Log

NUM_LAGS_PER_FRAME = 8
"""Evenly spaced lags within one frame that are tried."""
MAX_LAG_FRAMES = 8
TRIED_WRENCH_CONVENTIONS = ("sensor", "weight removed", "base")
"""Wrenches of the load: in S; without its weight; in the axes of the base."""
STANDARD_NORMAL_QUARTILE = 0.674
"""Half width of the calmer half of normal numbers, in standard deviations."""
_SIGNED_PERMUTATIONS = np.array(signed_permutations())
_FORCE_AND_TORQUE_CHANNELS = slice(0, 3), slice(3, 6)
_REFITTED_ROWS_SHARE, _NUM_REFITS = 0.6, 4
# Required reduction of the log spread, for each deviation.
_SPREAD_COST_PER_FAULT, _SPREAD_COST_TIMES_FRAMES = 0.25, 40.0
_NUM_START_FIT_PARTS, _MIN_HALF_WIDTH_OVER_USUAL = 4, 0.3
_MAX_INLIER_DEVIATIONS, _MIN_OFFSET_STEP_DEVIATIONS = 5.0, 5.0
_MIN_FRAMES_BESIDE_STEP, _MIN_SHARE_BESIDE_STEP, _NUM_TRIED_STEP_FRAMES = 12, 0.12, 20
_MAX_STD_OVER_SAMPLE_STEP_NOISE = 1.5  # noise by differences of frames


@dataclass(frozen=True)
class WrenchHypothesis:
    """Hypothetical relation of an episode's reading to the wrench of a load.

    Attributes:
        kind: "sensor" (axes), "base" (axes) or "weight removed".
        lag: delay of the motion behind the wrench [frames].
        axes: two rotations or mirrorings (3, 3), of the load's force and torque.
        gains: (2,) factors of force and torque.
        phi: (10,) of another load; None for the known one.
        spread: (6,) logarithms of the residual's half widths.
        offsets: (6,) sensor offsets [N, N m].
        cost: sum of `spread`, plus a price for each fault.
    """

    kind: str
    lag: float
    axes: tuple[Array, Array]
    gains: Array
    phi: Array | None = None
    spread: Array = field(default_factory=lambda: np.zeros(6))
    offsets: Array = field(default_factory=lambda: np.zeros(6))
    cost: float = np.inf

    def reading_of_load(self, load_wrench: Array) -> Array:
        """Map the load's wrench (N, 6) by gain and axes to a reading (N, 6) without offsets."""
        parts = zip(_FORCE_AND_TORQUE_CHANNELS, self.axes, self.gains, strict=True)
        return np.hstack([gain * load_wrench[:, c] @ M.T for c, M, gain in parts])

    def wrench_of_reading(self, wrench: Array) -> Array:
        """Invert `reading_of_load`: map readings (N, 6) without offsets to wrenches in S."""
        parts = zip(_FORCE_AND_TORQUE_CHANNELS, self.axes, self.gains, strict=True)
        return np.hstack([wrench[:, c] @ M / gain for c, M, gain in parts])


def fault_free_hypothesis(lag: float) -> WrenchHypothesis:
    return WrenchHypothesis("sensor", lag, (np.eye(3), np.eye(3)), np.ones(2))


def ln_half_width_and_centre(residual: Array, floor: Array) -> tuple[Array, Array]:
    """Return log half widths (6,), at least log `floor`, and centres of its calmer half."""
    widths, centres = width_and_centre_of_narrowest_half(residual)
    return np.log(np.maximum(0.5 * widths, floor)), centres


def find_simplest_hypothesis_and_residual(
    signals: EpisodeSignals, phi: Array, usual_lag: float, usual_half_widths: Array
) -> tuple[WrenchHypothesis, Array]:
    """Return the simplest hypothesis that explains the wrench of an episode, and its residual.

    The residual (N, 6) is the reading without the wrench of load phi (10,); offsets remain.
    `usual_lag` [frames] and `usual_half_widths` (6,) [N, N m] are those of other episodes.
    """
    floor = _MIN_HALF_WIDTH_OVER_USUAL * usual_half_widths
    search = HypothesisSearch(signals, phi, usual_lag, floor)
    usual = search.with_spread_and_cost(fault_free_hypothesis(usual_lag))
    if usual.spread.sum() - np.log(usual_half_widths).sum() < search.price:
        return usual, search.reading_without_load(usual)
    found = [usual]
    for kind in TRIED_WRENCH_CONVENTIONS:
        best_lag = search.best_lag(replace(usual, kind=kind))
        for lag in {usual_lag, best_lag, search.lag_of_linear_fit(kind)}:
            found += search.hypotheses_at_lag(kind, lag)
            found += [search.hypothesis_of_other_load(lag)] if kind == "sensor" else []
    best = min(found, key=lambda x: x.cost)
    if best.phi is None:
        found.append(search.with_spread_and_cost(replace(best, lag=search.best_lag(best))))
    best = min(found, key=lambda x: x.cost)
    return best, search.reading_without_load(best)


class HypothesisSearch:
    """Search for the best hypothesis of an episode; half widths are at least `floor` (6,)."""

    def __init__(self, signals: EpisodeSignals, phi: Array, usual_lag: float, floor: Array) -> None:
        self.predict = lru_cache(maxsize=None)(partial(signals.measured_and_load_wrench, phi))
        self.regress = signals.regressor_at_lag
        self.usual_lag, self.floor, self.frames = usual_lag, floor, len(signals.log)
        self.price = _SPREAD_COST_PER_FAULT + _SPREAD_COST_TIMES_FRAMES / self.frames

    def reading_without_load(self, x: WrenchHypothesis) -> Array:
        """Return the reading (N, 6) minus the load's reading by hypothesis x; offsets remain."""
        wrench, load_wrench = self.predict(x.kind, x.lag)
        if x.phi is not None:
            return np.asarray(wrench - self.regress(x.lag) @ x.phi)
        return wrench - x.reading_of_load(load_wrench)

    def with_spread_and_cost(self, x: WrenchHypothesis) -> WrenchHypothesis:
        residual = self.reading_without_load(x)
        spread, offsets = ln_half_width_and_centre(residual, self.floor)
        cost = float(spread.sum()) + self.price * _weighted_number_of_faults(x, self.usual_lag)
        return replace(x, spread=spread, offsets=offsets, cost=cost)

    def _best_explained_rows(self, x: WrenchHypothesis) -> NDArray[np.bool_]:
        residual = (self.reading_without_load(x) - x.offsets) / np.exp(x.spread)
        return _rows_of_smallest_residual(residual)

    def hypotheses_at_lag(self, kind: str, lag: float) -> Iterator[WrenchHypothesis]:
        both, one, eye = self.predict(kind, lag), np.ones(2), np.eye(3)
        force, torque = (self.best_permutation(*both, c) for c in _FORCE_AND_TORQUE_CHANNELS)
        plain = replace(fault_free_hypothesis(lag), kind=kind)
        axes = ((eye, eye), (-eye, -eye), (force, force), (torque, torque), (force, torque))
        yield from (self.with_spread_and_cost(replace(plain, axes=x)) for x in axes)
        for det in (1.0, -1.0):
            start = self.refit_calm_rows(plain, det=det, scale=True)
            yield start
            yield self.refit_calm_rows(replace(start, gains=one), det=det, scale=False)
            nearest = max(_SIGNED_PERMUTATIONS, key=lambda M: float((M * start.axes[0]).sum()))
            for M in (eye, -eye, nearest):
                yield self.refit_calm_rows(replace(start, axes=(M, M)), det=0.0, scale=True)

    def best_permutation(self, w: Array, p: Array, channels: slice) -> Array:
        """Return the signed permutation M (3, 3) for which M p fits w best, in force or torque."""
        w, p, floor = w[:, channels], p[:, channels], self.floor[channels]
        pairs = w[:, :, None, None] - np.multiply.outer(p, [1.0, -1.0])[:, None]
        pairs = pairs.reshape(len(w), -1)
        spread = ln_half_width_and_centre(pairs, np.repeat(floor, 6))[0]
        spread = spread.reshape(3, 3, 2)
        costs = [
            sum(spread[i, j, int(M[i, j] < 0)] for i, j in zip(*np.nonzero(M), strict=True))
            for M in _SIGNED_PERMUTATIONS
        ]
        return np.asarray(_SIGNED_PERMUTATIONS[int(np.argmin(costs))])

    def _best_fit(self, fit: Callable[[NDArray[np.bool_]], WrenchHypothesis]) -> WrenchHypothesis:
        """Return the best result of `fit`, started from all frames and each quarter of them."""
        at = np.arange(self.frames) * _NUM_START_FIT_PARTS // self.frames
        quarters = (at == part for part in range(_NUM_START_FIT_PARTS))
        return min(map(fit, [at >= 0, *quarters]), key=lambda x: x.cost)

    def refit_calm_rows(self, x: WrenchHypothesis, *, det: float, scale: bool) -> WrenchHypothesis:
        """Return hypothesis x with axes and gains fitted to the frames with the least residual.

        `det` is the determinant of the fitted axes; 0 keeps those of x. `scale` fits the gains.
        """
        both = self.predict(x.kind, x.lag)

        def fit_from_rows(rows: NDArray[np.bool_]) -> WrenchHypothesis:
            found = x
            for _ in range(_NUM_REFITS):
                w, q = (y[rows] - y[rows].mean(axis=0) for y in both)
                if scale:
                    ratio = [
                        np.linalg.norm(w[:, c]) / (np.linalg.norm(q[:, c]) + 1e-12)
                        for c in _FORCE_AND_TORQUE_CHANNELS
                    ]
                    found = replace(found, gains=np.maximum(ratio, 1e-9))
                if det:
                    M = _fit_rotation(w, q, found.gains, det)
                    found = replace(found, axes=(M, M))
                if scale:
                    found = replace(found, gains=_fit_gains(w, q, found))
                found = self.with_spread_and_cost(found)
                rows = self._best_explained_rows(found)
            return found

        return self._best_fit(fit_from_rows)

    def hypothesis_of_other_load(self, lag: float) -> WrenchHypothesis:
        wrench, V = self.predict("sensor", lag)[0], self.regress(lag)
        first_weights = np.exp(-ln_half_width_and_centre(wrench, self.floor)[0])

        def fit_from_rows(rows: NDArray[np.bool_]) -> WrenchHypothesis:
            x, weights = fault_free_hypothesis(lag), first_weights
            for _ in range(_NUM_REFITS):
                w, A = (y[rows] - y[rows].mean(axis=0) for y in (wrench, V))
                A, w = (A * weights[:, None]).reshape(-1, 10), (w * weights).ravel()
                size = np.linalg.norm(A, axis=0) + 1e-12
                phi = np.linalg.lstsq(A / size, w, rcond=1e-3)[0] / size
                x = self.with_spread_and_cost(replace(x, phi=phi))
                rows, weights = self._best_explained_rows(x), np.exp(-x.spread)
            return x

        return self._best_fit(fit_from_rows)

    def best_lag(self, x: WrenchHypothesis) -> float:
        """Return the lag [frames] at which the load of `x` leaves the least residual spread."""
        lag, reach = self.usual_lag, float(MAX_LAG_FRAMES)
        for step in (0.5, 1.0 / NUM_LAGS_PER_FRAME):
            lags = lag + np.arange(-reach, reach + 0.5 * step, step)
            found = (self.with_spread_and_cost(replace(x, lag=float(y))) for y in lags)
            lag, reach = min(found, key=lambda x: x.spread.sum()).lag, 0.5
        return lag

    def lag_of_linear_fit(self, kind: str) -> float:
        """Return the lag [frames] at which a linear map of the load's wrench fits best."""

        def residual_and_cost(lag: float) -> tuple[Array, float]:
            w, p = self.predict(kind, lag)
            p = np.column_stack([p / (np.linalg.norm(p[rows], axis=0) + 1e-9), np.ones(len(p))])
            P, W = p[rows], w[rows]
            gram = P.T @ P + 1e-9 * np.eye(7)
            residual = w - p @ np.linalg.solve(gram, P.T @ W)
            return residual, float(np.log(residual[rows].var(axis=0) + self.floor**2).sum())

        lags = self.usual_lag + np.arange(-MAX_LAG_FRAMES, MAX_LAG_FRAMES + 0.1, 0.25)
        rows = np.ones(self.frames, bool)
        for _ in range(2):
            lag = float(min(lags, key=lambda x: residual_and_cost(float(x))[1]))
            rows = _rows_of_smallest_residual(residual_and_cost(lag)[0])
        return lag


def _rows_of_smallest_residual(residual: Array) -> NDArray[np.bool_]:
    distance = (residual**2).sum(axis=1)
    return np.asarray(distance <= np.quantile(distance, _REFITTED_ROWS_SHARE))


def _fit_rotation(w: Array, p: Array, gain: Array, det: float) -> Array:
    """Return the orthogonal M (3, 3) with determinant `det` and least |w - gain M p|."""
    H = np.zeros((3, 3))
    for channels, factor in zip(_FORCE_AND_TORQUE_CHANNELS, gain, strict=True):
        size = factor * np.linalg.norm(p[:, channels]) + 1e-12
        H += w[:, channels].T @ p[:, channels] * factor / size**2
    U, _, Vt = np.linalg.svd(H)
    return np.asarray(U @ np.diag([1.0, 1.0, det * np.sign(np.linalg.det(U @ Vt))]) @ Vt)


def _fit_gains(w: Array, p: Array, x: WrenchHypothesis) -> Array:
    gains = []
    for channels, M in zip(_FORCE_AND_TORQUE_CHANNELS, x.axes, strict=True):
        q = p[:, channels] @ M.T
        gains.append(float((w[:, channels] * q).sum() / ((q * q).sum() + 1e-12)))
    return np.maximum(gains, 1e-9)


def _weighted_number_of_faults(x: WrenchHypothesis, usual_lag: float) -> float:
    count = float(x.kind != "sensor") + float(abs(x.lag - usual_lag) > 1e-9)
    if x.phi is not None:
        return count + 4.0
    count += _fault_weight_of_rotation(x.axes[0]) + float(not np.allclose(*x.axes))
    return count + float((x.gains != 1.0).sum())


def _fault_weight_of_rotation(M: Array) -> float:
    if np.allclose(np.abs(M), np.eye(3)):
        return 0.0 if M.trace() > 2.9 else 1.0
    return 1.5 if np.allclose(np.abs(M).max(axis=0), 1.0) else 2.5


def find_offset_step(residual: Array, spread: Array) -> tuple[int, Array, Array] | None:
    """Return the frame at which the offsets of a residual (N, 6) jump, and both offsets, or None.

    Unlike contact, a jump leaves constant offsets in all frames beside it.
    """
    n = len(residual)
    # Offsets that change in the middle enlarge the spread, but no differences of frames.
    change = np.median(np.abs(np.diff(residual, axis=0)), axis=0)
    noise = change / (np.sqrt(2.0) * STANDARD_NORMAL_QUARTILE)
    by_spread = np.exp(spread) / STANDARD_NORMAL_QUARTILE
    deviation = np.minimum(by_spread, _MAX_STD_OVER_SAMPLE_STEP_NOISE * noise)
    fewest = max(_MIN_FRAMES_BESIDE_STEP, int(_MIN_SHARE_BESIDE_STEP * n))

    def inliers_and_centre(frames: Array) -> tuple[NDArray[np.bool_], Array]:
        centre = ln_half_width_and_centre(frames, np.full(6, 1e-300))[1]
        return (np.abs(frames - centre) <= _MAX_INLIER_DEVIATIONS * deviation).all(axis=1), centre

    whole = inliers_and_centre(residual)[0].sum()
    best: tuple[int, int, Array, Array] | None = None
    jumps = np.linalg.norm(np.diff(residual, axis=0) / deviation, axis=1)
    for k in 1 + np.argsort(-jumps)[:_NUM_TRIED_STEP_FRAMES]:
        if not fewest <= k <= n - fewest:
            continue
        first, before = inliers_and_centre(residual[:k])
        second, after = inliers_and_centre(residual[k:])
        gain = int(first.sum() + second.sum() - whole)
        sharp = first[-2:].all() and second[:2].all()
        full = min(first.mean(), second.mean()) > 0.4
        large = (np.abs(after - before) > _MIN_OFFSET_STEP_DEVIATIONS * deviation).any()
        if sharp and full and large and gain >= fewest // 2 and (best is None or gain > best[0]):
            best = gain, int(k), before, after
    return None if best is None else best[1:]


_MIN_POSE_KNOT_SPACING_S = 0.04
_MOTION_MARGIN_FRAMES = 2 * MAX_LAG_FRAMES  # frames at both ends of the finely sampled motion


class Motion(NamedTuple):
    """Motion of S: specific force, angular velocity and acceleration, gravity and R_WS."""

    s: Array
    omega: Array
    alpha: Array
    gravity: Array
    R_WS: Array


class EpisodeSignals:
    """Wrench and motion of an episode; its log must have an orientation and no low-pass."""

    def __init__(self, log: Log) -> None:
        self.log = log
        self._splines = None
        if log.posed is not None:
            poses = log.posed.poses
            spacing = max(MIN_POSES_PER_KNOT / poses.rate, _MIN_POSE_KNOT_SPACING_S)
            self._splines = PoseSplines(poses, spacing, smooth=True)
        margin = _MOTION_MARGIN_FRAMES * NUM_LAGS_PER_FRAME
        steps = np.arange(-margin, len(log) * NUM_LAGS_PER_FRAME + margin)
        self._fine = self.motion(log.t[0] + steps / NUM_LAGS_PER_FRAME * log.dt)

    def motion(self, t: Array) -> Motion:
        log = self.log
        if self._splines is None or log.posed is None:
            assert log.gravity is not None and log.R_WS is not None
            signals = (*log.motion, log.gravity, log.R_WS)
            return Motion(*(resample(t, log.t, x) for x in signals))
        R = rotation_matrices(self._splines.quaternion(t), "quaternion_wxyz")
        return Motion(*self._splines.motion(t, log.posed.gravity_W), R)

    def motion_at_lag(self, lag: float) -> Motion:
        """Return the motion (N, ...) at `lag` frames after each frame."""
        first = (lag + _MOTION_MARGIN_FRAMES) * NUM_LAGS_PER_FRAME
        step = round(first)
        if abs(step - first) < 1e-6 and abs(lag) < _MOTION_MARGIN_FRAMES:
            rows = slice(step, step + NUM_LAGS_PER_FRAME * len(self.log), NUM_LAGS_PER_FRAME)
            return Motion(*(x[rows] for x in self._fine))
        return self.motion(self.log.t + lag * self.log.dt)

    def regressor_at_lag(self, lag: float) -> Array:
        return regressor(*self.motion_at_lag(lag)[:3])

    def measured_and_load_wrench(self, phi: Array, kind: str, lag: float) -> tuple[Array, Array]:
        """Return the measured wrench (N, 6) in axes of S, and the wrench of load phi at `lag`."""
        at, wrench = self.motion_at_lag(lag), self.log.wrench
        s = at.s + at.gravity if kind == "weight removed" else at.s
        if kind == "base":
            wrench = (wrench.reshape(-1, 2, 3) @ at.R_WS).reshape(-1, 6)
        return wrench, non_contact_wrench(s, at.omega, at.alpha, phi)
