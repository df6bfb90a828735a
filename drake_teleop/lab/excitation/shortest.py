"""Shortest motion that identifies a load within tolerances: `excite --until`.

The logarithm of the period T is an unknown and is minimised; the tolerance is one more limit,

    use = 1 + 1/2 log max_k (z d_k / tolerance_k),

with standard deviations d_k after one period and z of `sidak_factor`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtri

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.common.vectors import cross_matrix
from drake_teleop.lab.excitation import excite, limits, optimizer, prediction
from drake_teleop.lab.excitation.check import CHECK_RATE_HZ
from drake_teleop.lab.excitation.criteria import Criterion
from drake_teleop.lab.excitation.robot import Robot
from drake_teleop.load.regressor import regressor
from drake_teleop.load.tolerance import (
    Tolerance,
    derivatives_over_tolerances,
    deviations_over_tolerances,
)
from drake_teleop.load.trajectory import FourierTrajectory

PROBABILITY_ALL_WITHIN_TOLERANCE = 0.95
"""Share of the records in which all numbers are within their tolerances together."""
# Longest period [s]; highest frequency of the shortest period [Hz], half the cutoff of `identify`.
_MAX_PERIOD_S, _MAX_FREQUENCY_HZ = 20.0, 15.0
# Largest step of log T in one descent: SLSQP's linear model would go to T = 0 and not return.
_MAX_LOG_PERIOD_CHANGE_BY_SLSQP = 0.15
# Largest number of rounds; number of successful rounds without progress; required progress factor.
_MAX_DESIGN_ROUNDS, _MAX_ROUNDS_WITHOUT_PROGRESS, _MAX_PERIOD_RATIO_OF_PROGRESS = 20, 1, 0.99
_TOLERANCE_TIGHTENING_FACTOR = 1.005  # after a round that missed the tolerance
_MAX_INFEASIBLE_ROUNDS = 3  # before the search fails
# Largest error over tolerance of a motion that later rounds vary; number of such starts.
_MAX_ERROR_RATIO_OF_VARIED_MOTION, _NUM_VARIED_STARTS = 1.5, 4
_SEED_INCREMENT_PER_ROUND = 2**33
# Variation in later rounds: share of the coefficients, factor of the period.
_MAX_COEFFICIENT_VARIATION, _MAX_PERIOD_VARIATION_FACTOR = 0.2, 1.3
_TOLERANCE_TO_CRITERION_SHARPNESS_RATIO = 4.0  # ratio of the maxima's sharpnesses
_INFORMATION_REGULARISATION = 1e-11  # of balanced information, which is singular without motion


@dataclass(frozen=True, eq=False)
class ShortestMotion:
    """Checked motion; `errors_over_tolerances` (k,) are predicted and at most 1."""

    excitation: excite.Excitation
    errors_over_tolerances: Array


def design_shortest_motion(
    robot: Robot,
    tolerance: Tolerance,
    *,
    harmonics: int = 3,
    seed: int = 0,
    starts: int = 24,
    progress: Callable[[float, float], None] = lambda done, best: None,
) -> ShortestMotion:
    """Design and check the shortest motion that identifies the load within a tolerance.

    Raises:
        DrakeTeleopError: if no motion of at most 20 s reaches the tolerance.
    """
    errors = derivatives_over_tolerances(tolerance, robot.limits.heaviest_phi)
    errors = errors * sidak_factor(len(tolerance.required_entry_names))
    factor = np.ones(len(errors))
    worst, around, rounds_without_progress, rounds_without_motion = np.inf, None, 0, 0
    best: ShortestMotion | None = None
    for k in range(_MAX_DESIGN_ROUNDS):
        problem = ShortestMotionProblem(robot, harmonics, errors * factor[:, np.newaxis], around)
        num_starts = starts if around is None else min(starts, _NUM_VARIED_STARTS)
        found = optimizer.minimise_criterion(
            problem, seed=seed + _SEED_INCREMENT_PER_ROUND * k, starts=num_starts, progress=progress
        )
        found = [each for each in found if each.criterion_value <= _MAX_PERIOD_S]
        if not found:
            if (rounds_without_motion := rounds_without_motion + 1) == _MAX_INFEASIBLE_ROUNDS:
                break
            around = None
            continue
        trajectory, uses = excite.find_best_within_limits(robot, found)
        motion = excite.trajectory_sensor_motion(robot, trajectory)
        noise, phi = robot.sensor_noise, robot.limits.heaviest_phi
        covariance = prediction.predicted_covariance(*motion, 1 / CHECK_RATE_HZ, noise, phi)
        reached = deviations_over_tolerances(errors, covariance)
        worst = float(reached.max())
        around = problem.best if worst < _MAX_ERROR_RATIO_OF_VARIED_MOTION else None
        if worst <= 1.0:
            shortest_period = np.inf if best is None else best.excitation.trajectory.period
            progressed = trajectory.period < _MAX_PERIOD_RATIO_OF_PROGRESS * shortest_period
            rounds_without_progress = 0 if progressed else rounds_without_progress + 1
            if trajectory.period < shortest_period:
                excitation = excite.assemble_excitation(robot, "period", found, trajectory, uses)
                best = ShortestMotion(excitation, reached)
            if rounds_without_progress == _MAX_ROUNDS_WITHOUT_PROGRESS:
                break
        modelled = problem.deviations(motion, trajectory.period)
        last_factor, factor = factor, factor * (reached / modelled)
        # No decrease after a round that missed the tolerance, to avoid oscillation.
        if worst > 1.0 and k > 0:
            factor = _TOLERANCE_TIGHTENING_FACTOR * np.maximum(factor, last_factor)
    if best is not None:
        return best
    what = "no motion within the limits reaches the tolerance"
    if np.isfinite(worst):
        what += f": the best one exceeds it by a factor of {worst:.3g}"
    remedy = "give larger tolerances, or repeat the motion of `excite`"
    raise DrakeTeleopError(what, where=f"{robot.name}: {tolerance}", remedy=remedy)


def sidak_factor(num_errors: int) -> float:
    """Return z: with 95 % probability `num_errors` errors are all within z deviations (Sidak)."""
    return float(ndtri(0.5 + 0.5 * PROBABILITY_ALL_WITHIN_TOLERANCE ** (1.0 / num_errors)))


class ShortestMotionProblem(optimizer.DesignProblem):
    """Optimisation of the period T in the unknowns x = [q0, sine, cosine, log T].

    Args:
        errors: (k, 16) combinations of offsets and phi, over tolerance; std must be below 1.
        around: unknowns of an earlier motion that candidates vary, if any.

    Attributes:
        best: unknowns of the shortest motion so far.
    """

    def __init__(self, robot: Robot, harmonics: int, errors: Array, around: Array | None) -> None:
        # The criterion is not used.
        super().__init__(robot, Criterion("A16", robot.criterion_scales), 1.0, harmonics)
        self._around, self._at, self.best = around, np.empty(0), around
        self._errors, self._least = errors, np.inf
        noise, phi = robot.sensor_noise, robot.limits.heaviest_phi
        self._noise = noise_density_relative_to_wrench_noise(noise, phi)
        self._roots = np.sqrt(noise.white_noise_densities[:6])
        self._gradients = np.empty((2 + len(limits.LIMIT_NAMES), *self._gradients.shape[1:]))
        self._period, self._shortest = 1.0, harmonics / _MAX_FREQUENCY_HZ

    def trajectory(self, x: Array) -> FourierTrajectory:
        return replace(super().trajectory(x[:-1]), frequency=float(np.exp(-x[-1])))

    def candidate(self, rng: np.random.Generator, *, near_home: bool) -> Array:
        """Return the unknowns of a random motion; `near_home`: near `around`, else near home."""
        if self._around is not None and near_home:
            other = _MAX_COEFFICIENT_VARIATION * rng.uniform() * np.abs(self._around[:-1]).mean()
            x = self._around + np.append(other * rng.standard_normal(len(self._around) - 1), 0.0)
            x[-1] += np.log(_MAX_PERIOD_VARIATION_FACTOR) * rng.uniform(-1.0, 1.0)
            return x
        period = float(np.exp(rng.uniform(np.log(2 * self._shortest), np.log(0.5 * _MAX_PERIOD_S))))
        self._period_s = period  # the size of motions depends on the period
        x = super().candidate(rng, near_home=near_home)
        self._period_s = 1.0
        return np.append(x, np.log(period))

    def bounds(self, x: Array) -> optimizer.Bounds:
        """Return the bounds of the unknowns; only log T is bounded, about its value in x."""
        ends = x[-1] + np.array([-_MAX_LOG_PERIOD_CHANGE_BY_SLSQP, _MAX_LOG_PERIOD_CHANGE_BY_SLSQP])
        low, high = np.clip(ends, np.log(self._shortest), np.log(2.0 * _MAX_PERIOD_S)).tolist()
        return [(None, None)] * (len(x) - 1) + [(low, high)]

    def evaluate(
        self, x: Array, criterion_sharpness: float, limit_sharpness: float
    ) -> optimizer.Evaluation:
        """Evaluate the objective log T and eight uses: of the tolerance, then of the limits."""
        self._at = x.copy()
        log_period = float(np.clip(x[-1], np.log(self._shortest), np.log(2.0 * _MAX_PERIOD_S)))
        self._period = T = float(np.exp(log_period))
        q_qd_qdd, g = self._evaluate_motion(x[:-1], T), self._gradients
        g[0] = 0.0
        sharpness = _TOLERANCE_TO_CRITERION_SHARPNESS_RATIO * criterion_sharpness
        use, worst, g_V = self._tolerance_uses_and_gradient(sharpness)
        smooth, largest = self._write_joint_gradients(q_qd_qdd, g_V, limit_sharpness, g[1:])
        by_log_period = -(g[:, 1] * q_qd_qdd[1] + 2.0 * g[:, 2] * q_qd_qdd[2]).sum(axis=(1, 2))
        # Longer periods have more samples; the objective is log T.
        by_log_period[1] -= 0.25
        by_log_period[0] = 1.0
        g[:, 1] /= T
        g[:, 2] /= T**2
        gradients = np.hstack([self._gradients_by_coefficients(), by_log_period[:, np.newaxis]])
        return optimizer.Evaluation(
            float(x[-1]), np.append(use, smooth), gradients, max(worst, largest)
        )

    def value(self) -> float:
        """Return the period of the last evaluated point [s]; update `best`."""
        if self._period < self._least:
            self._least, self.best = self._period, self._at
        return self._period

    def deviations(self, motion: tuple[Array, Array, Array], period: float) -> Array:
        """Return standard deviation over tolerance (k,), predicted for white noise only."""
        rows = self._weighted_regressor_rows(*motion)
        return np.sqrt(self._tolerance_scaled_variances(rows, period)[0])

    def _weighted_regressor_rows(self, s: Array, omega: Array, alpha: Array) -> Array:
        V = regressor(s, omega, alpha)
        rows = np.concatenate([np.broadcast_to(np.eye(6), (len(V), 6, 6)), V], axis=2)
        return rows / self._roots[:, np.newaxis]

    def _tolerance_scaled_variances(self, rows: Array, period: float) -> tuple[Array, Array, Array]:
        # Variances d_k^2 = v_k^T B v_k, v_k = G^-1 e_k, u_k = G^-1 B v_k: G is the information of
        # weighted least squares; B contains the noise densities; e_k is a row of `errors`
        # (sandwich, White, Econometrica 1980).
        share, flat = period / len(rows), rows.reshape(-1, rows.shape[2])
        G = share * (flat.T @ flat)
        B = share * (flat.T @ (self._noise @ rows).reshape(flat.shape))
        size = 1.0 / np.sqrt(np.diag(G))
        inverse = np.linalg.inv(G * np.outer(size, size) + _INFORMATION_REGULARISATION * np.eye(16))
        inverse *= np.outer(size, size)
        v = self._errors @ inverse
        Bv = v @ B
        return np.einsum("ki,ki->k", v, Bv), v, Bv @ inverse

    def _tolerance_uses_and_gradient(self, sharpness: float) -> tuple[float, float, Array]:
        rows = self._weighted_regressor_rows(*self._vectors)
        variances, v, u = self._tolerance_scaled_variances(rows, self._period)
        logs = 0.5 * np.log(variances)
        weights = np.exp(sharpness * (logs - logs.max()))
        smooth = float(logs.max() + np.log(weights.sum()) / sharpness)
        weights = 0.5 * self._period / len(rows) * weights / (weights.sum() * variances)
        cross = (v.T * weights) @ u
        g_rows = self._noise @ (rows @ ((v.T * weights) @ v)) - rows @ (cross + cross.T)
        g_V = (g_rows / self._roots[:, np.newaxis])[:, :, 6:]
        return 1.0 + 0.5 * smooth, 1.0 + 0.5 * float(logs.max()), np.ascontiguousarray(g_V)


def noise_density_relative_to_wrench_noise(noise: prediction.SensorNoise, phi: Array) -> Array:
    """Return noise density (6, 6) of wrench plus motion, scaled to unit wrench noise."""
    density = np.diag(noise.white_noise_densities[:6])
    if noise.motion_error_filters is not None:
        at_So = np.eye(6)
        at_So[:3, 3:] = cross_matrix(noise.p_SoAo_S)
        through = prediction.spatial_inertia_matrix(phi) @ at_So
        density = density + through @ np.diag(noise.white_noise_densities[6:]) @ through.T
    roots = np.sqrt(noise.white_noise_densities[:6])
    return density / np.outer(roots, roots)
