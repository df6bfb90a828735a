"""Optimiser of excitation trajectories: L-BFGS with penalties, then SLSQP.

All improving feasible iterates are recorded, because SLSQP often ends on an infeasible one.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array, one_blas_thread
from drake_teleop.lab.excitation import limits
from drake_teleop.lab.excitation.criteria import Criterion
from drake_teleop.lab.excitation.robot import Robot
from drake_teleop.load.trajectory import FourierTrajectory

Bounds = list[tuple[float | None, float | None]]
"""Lower and upper bound of each unknown; None: unbounded."""

_SAMPLES_PER_PERIOD_OF_TOP_HARMONIC = 24
_RANDOM_MOTION_SHARE_OF_JOINT_LIMITS = 0.35  # of speed and acceleration limits


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Criterion, and uses of limits (value over limit), at one point of the search.

    Attributes:
        log_criterion: smooth logarithm of the criterion.
        smooth_limit_uses: (7,) smooth largest use of each of `LIMIT_NAMES`.
        gradients: (8, unknowns) gradients of criterion (first) and uses.
        largest_limit_use: exact largest use of any limit.
    """

    log_criterion: float
    smooth_limit_uses: Array
    gradients: Array
    largest_limit_use: float


class DesignProblem:
    """Trajectory optimisation in x = [q0, sine, cosine], the Fourier coefficients of the joints.

    `num_harmonics` is at least 2.
    """

    def __init__(
        self, robot: Robot, criterion: Criterion, period_s: float, num_harmonics: int
    ) -> None:
        if not (num_harmonics >= 2 and period_s > 0.0):
            what = f"{num_harmonics} harmonics and a period of {period_s:g} s describe no motion"
            remedy = "give 2 harmonics or more, and a period above 0 s"
            raise DrakeTeleopError(what, where="excite", remedy=remedy)
        self._criterion, self._period_s, self._num_harmonics = criterion, period_s, num_harmonics
        self._table, self._limits, self._home = robot.arm.table, robot.limits, robot.home_posture
        free, samples = 2 * (num_harmonics - 1), _SAMPLES_PER_PERIOD_OF_TOP_HARMONIC * num_harmonics
        sine, cosine = np.hsplit(np.eye(free), 2)
        basis = FourierTrajectory.rest_to_rest(np.zeros(free), sine, cosine, 1 / period_s)
        #: (3, T, free): q, qd, qdd of unit coefficients.
        self._basis = np.stack(basis.evaluate(np.arange(samples) * period_s / samples))
        self._gradients = np.empty((1 + len(limits.LIMIT_NAMES), 3, samples, len(self._home)))

    def trajectory(self, x: Array) -> FourierTrajectory:
        n = len(self._home)
        sine, cosine = x[n:].reshape(2, n, -1)
        return FourierTrajectory.rest_to_rest(x[:n], sine, cosine, 1 / self._period_s)

    def candidate(self, rng: np.random.Generator, *, near_home: bool) -> Array:
        """Return the unknowns of a random motion, about a random posture unless `near_home`."""
        bounds, harmonics = self._limits, self._num_harmonics
        rate = 2 * np.pi / self._period_s * np.sqrt(harmonics)
        size = np.minimum(bounds.velocity / rate, bounds.acceleration / rate**2)
        amplitude = _RANDOM_MOTION_SHARE_OF_JOINT_LIMITS * np.minimum(size, bounds.q_half)
        spread = np.tile(np.repeat(amplitude, harmonics - 1), 2)
        q0 = self._home + 0.1 * rng.standard_normal(len(size))
        if not near_home:
            half = limits.finite_half_ranges(bounds.q_half)
            q0 = bounds.q_middle + 0.6 * half * rng.uniform(-1, 1, len(size))
        return np.concatenate([q0, spread * rng.standard_normal(len(spread))])

    def bounds(self, x: Array) -> Bounds | None:
        """Return the bounds of the unknowns; None: no unknown is bounded."""
        return None

    def evaluate(self, x: Array, criterion_sharpness: float, limit_sharpness: float) -> Evaluation:
        q_qd_qdd, g = self._evaluate_motion(x), self._gradients
        s, omega, alpha = self._vectors
        value, g_V = self._criterion.smooth_log_and_gradient(s, omega, alpha, criterion_sharpness)
        smooth, largest = self._write_joint_gradients(q_qd_qdd, g_V, limit_sharpness, g)
        return Evaluation(value, smooth, self._gradients_by_coefficients(), largest)

    def _evaluate_motion(self, x: Array, time_factor: float = 1.0) -> Array:
        # q, qd, qdd (3, T, n); also writes the motions of links and sensor.
        n = len(self._home)
        q_qd_qdd: Array = self._basis @ x[n:].reshape(2, n, -1).swapaxes(1, 2).reshape(-1, n)
        q_qd_qdd[0] += x[:n]
        q_qd_qdd[1] /= time_factor
        q_qd_qdd[2] /= time_factor**2
        self._motions = limits.link_motion_series(self._table, *q_qd_qdd)
        self._vectors = limits.sensor_motion_series(self._motions)
        return q_qd_qdd

    def _write_joint_gradients(
        self, q_qd_qdd: Array, g_V: Array, sharpness: float, gradients: Array
    ) -> tuple[Array, float]:
        # Gradients (8, 3, T, n) of a function of V and of uses; returns smooth and largest uses.
        gradients[0] = 0.0
        limits.add_gradient_by_joints(self._table, self._motions, *q_qd_qdd[1:], g_V, gradients[0])
        smooth, largest = limits.max_limit_uses_into(
            self._table, *q_qd_qdd, self._motions, self._limits, sharpness, gradients[1:]
        )
        return smooth, float(largest.max())

    def value(self) -> float:
        """Return the exact (not smooth) criterion of the last evaluated point."""
        s, omega, alpha = self._vectors
        return self._criterion.value(s, omega, alpha, self._period_s)

    def _gradients_by_coefficients(self) -> Array:
        g = self._gradients
        by_q0 = g[:, 0].sum(axis=1)
        # (8, free, n), summed over position, velocity, acceleration and time.
        by_coefficients = (self._basis.transpose(0, 2, 1) @ g).sum(axis=1)
        count, free, n = by_coefficients.shape
        by_coefficients = by_coefficients.reshape(count, 2, free // 2, n).swapaxes(2, 3)
        return np.hstack([by_q0, by_coefficients.reshape(count, -1)])


#: Usable share of each limit; the time grid misses up to 0.9 % of a fifth harmonic's peak.
USABLE_LIMIT_SHARE = 0.985
_MAX_FEASIBLE_LIMIT_USE_AT_SAMPLES = 0.9885

# Number of candidates in a batch, and number of them from which a descent starts.
_START_BATCH_SIZE, _NUM_DESCENT_STARTS = 128, 8
# (sharpness of the criterion, of the maxima, weight of the penalty, iterations) of L-BFGS.
_LBFGS_SETTINGS_BY_STAGE = ((1.0, 100.0, 20.0, 20), (12.0, 150.0, 50.0, 15))
# (sharpness of the criterion, of the maxima, iterations) of SLSQP.
_SLSQP_SETTINGS_BY_STAGE = ((12.0, 200.0, 80), (40.0, 400.0, 120))
# A start ends without a feasible iterate after so many evaluations, or after the first stage of
# SLSQP outside this factor of the best.
_MAX_INFEASIBLE_EVALUATIONS, _MAX_CRITERION_RATIO_TO_BEST = 250, 1.08
# A bounded descent is repeated while it improves the criterion by this factor.
_MAX_CRITERION_RATIO_TO_REPEAT_DESCENT = 0.995


@dataclass(frozen=True)
class FeasibleIterate:
    """Trajectory within the limits, found after `cpu_time_s` of thread CPU time."""

    cpu_time_s: float
    num_evaluations: int
    start_index: int
    criterion_value: float
    trajectory: FourierTrajectory


def minimise_criterion(
    problem: DesignProblem,
    *,
    seed: int,
    starts: int = 4,
    seconds: float | None = None,
    progress: Callable[[float, float], None] = lambda done, best: None,
) -> list[FeasibleIterate]:
    """Minimise the criterion within the limits; return the improving feasible iterates in order.

    `starts` limits the number of descents; `seconds` limits CPU time instead, so results vary.
    """
    search = _DescentSearch(problem, starts, seconds, progress)
    with one_blas_thread(), suppress(_TimeOutError):
        for candidate in search.candidates(np.random.default_rng(seed)):
            if seconds is None and search.start == starts:
                break
            with suppress(_InfeasibleStartError):
                search.descend_from(candidate)
            search.start += 1
    return search.found


class _TimeOutError(Exception): ...


class _InfeasibleStartError(Exception): ...


class _DescentSearch:
    def __init__(
        self,
        problem: DesignProblem,
        starts: int,
        seconds: float | None,
        progress: Callable[[float, float], None],
    ) -> None:
        self._problem, self._starts = problem, starts
        self._seconds, self._progress = seconds, progress
        self.start = 0
        self.found: list[FeasibleIterate] = []
        self._best = self._best_of_start = float("inf")
        self._evaluations = self._all_evaluations = 0
        self._key = b""
        from scipy.optimize import minimize

        self._minimize = minimize
        # Compile before the clock starts.
        first = problem.candidate(np.random.default_rng(0), near_home=True)
        self._last = problem.evaluate(first, 1.0, 1.0)
        self._start_time = time.thread_time()

    def candidates(self, rng: np.random.Generator) -> Iterator[Array]:
        while True:
            sides = [k % 2 == 0 for k in range(_START_BATCH_SIZE)]
            batch = [self._problem.candidate(rng, near_home=near) for near in sides]
            merit = []
            for x in batch:
                self._count_evaluation_and_check_time()
                point = self._problem.evaluate(x, *_LBFGS_SETTINGS_BY_STAGE[0][:2])
                merit.append(point.log_criterion + 10 * max(point.smooth_limit_uses.max() - 1, 0))
            for k in np.argsort(merit)[:_NUM_DESCENT_STARTS]:
                yield batch[k]

    def descend_from(self, x: Array) -> None:
        self._evaluations, self._best_of_start = 0, float("inf")
        penalised = self._penalised_value_and_gradient
        for *sharpness_and_weight, iterations in _LBFGS_SETTINGS_BY_STAGE:
            given, options = tuple(sharpness_and_weight), {"maxiter": iterations}
            x = self._minimize(penalised, x, given, "L-BFGS-B", jac=True, options=options).x
        is_bounded = self._problem.bounds(x) is not None
        for k, stage in enumerate(_SLSQP_SETTINGS_BY_STAGE):
            hopeless = self._best_of_start > _MAX_CRITERION_RATIO_TO_BEST * self._best
            if k > 0 and hopeless and not is_bounded:
                return
            x = self._run_slsqp(x, *stage)
        before = float("inf")
        while is_bounded and self._best_of_start < _MAX_CRITERION_RATIO_TO_REPEAT_DESCENT * before:
            before = self._best_of_start
            x = self._run_slsqp(x, *_SLSQP_SETTINGS_BY_STAGE[-1])

    def _run_slsqp(
        self, x: Array, criterion_sharpness: float, limit_sharpness: float, iterations: int
    ) -> Array:
        def evaluate(x: Array) -> Evaluation:
            return self._evaluate_or_reuse_last(x, criterion_sharpness, limit_sharpness)

        return self._minimize(
            lambda x: evaluate(x).log_criterion,
            x,
            method="SLSQP",
            jac=lambda x: evaluate(x).gradients[0],
            bounds=self._problem.bounds(x),
            constraints={
                "type": "ineq",
                "fun": lambda x: USABLE_LIMIT_SHARE - evaluate(x).smooth_limit_uses,
                "jac": lambda x: -evaluate(x).gradients[1:],
            },
            options={"maxiter": iterations, "ftol": 1e-5},
        ).x

    def _penalised_value_and_gradient(
        self, x: Array, criterion_sharpness: float, limit_sharpness: float, weight: float
    ) -> tuple[float, Array]:
        point = self._evaluate_or_reuse_last(x, criterion_sharpness, limit_sharpness)
        excess = np.maximum(point.smooth_limit_uses - USABLE_LIMIT_SHARE, 0)
        value = point.log_criterion + weight * float(excess @ excess)
        return value, point.gradients[0] + (2 * weight * excess) @ point.gradients[1:]

    def _evaluate_or_reuse_last(
        self, x: Array, criterion_sharpness: float, limit_sharpness: float
    ) -> Evaluation:
        key = np.array([*x, criterion_sharpness, limit_sharpness]).tobytes()
        if key != self._key:
            self._count_evaluation_and_check_time()
            self._last = self._problem.evaluate(x, criterion_sharpness, limit_sharpness)
            self._key = key
            if self._last.largest_limit_use <= _MAX_FEASIBLE_LIMIT_USE_AT_SAMPLES:
                self._record_iterate_if_improved(x)
            elif self._evaluations > _MAX_INFEASIBLE_EVALUATIONS and np.isinf(self._best_of_start):
                raise _InfeasibleStartError
        return self._last

    def _record_iterate_if_improved(self, x: Array) -> None:
        value = self._problem.value()
        if value < self._best_of_start:
            self._best_of_start = value
            self._best = min(value, self._best)
            seconds = time.thread_time() - self._start_time
            trajectory = self._problem.trajectory(x)
            counts = self._all_evaluations, self.start
            self.found.append(FeasibleIterate(seconds, *counts, value, trajectory))

    def _count_evaluation_and_check_time(self) -> None:
        self._evaluations += 1
        self._all_evaluations += 1
        done = self.start / self._starts
        if self._seconds is not None:
            done = (time.thread_time() - self._start_time) / self._seconds
            if done >= 1:
                raise _TimeOutError
        if self._evaluations % 20 == 0:
            self._progress(done, self._best)
