"""The shortest motion after which a load is known as well as is asked: `excite --until`.

The unknowns are those of `problem.py` and log T, the period's: with the coefficients, q(t / T)
stays, qd falls with T and qdd with T^2. log T is minimised, and what is asked is one more limit,

    use = 1 + 1/2 log max_k (z d_k / tolerance_k),

with the standard deviations d_k of the asked numbers (`load.tolerance`) of all of one period's
samples, offsets estimated too, and z such that all numbers are within their tolerances at once in
`RELIABLE` of the records (Sidak's inequality). The optimiser sees white noise of the wrench alone;
how much more `prediction.py` knows of (accelerometer, random walks) is a factor for each number,
from the motion that was found before, and the search is repeated with it, from there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import accumulate

import numpy as np
from scipy.special import ndtri

from drake_teleop.errors import DrakeTeleopError
from drake_teleop.excitation.check import RATE, Use
from drake_teleop.excitation.criteria import Criterion
from drake_teleop.excitation.design import Iterate, design
from drake_teleop.excitation.excite import Excitation, best_checked, criteria_of, sensor_motion
from drake_teleop.excitation.limits import (
    LIMITS,
    criterion_gradient,
    limit_uses,
    motions_of,
    sensor_vectors,
)
from drake_teleop.excitation.prediction import predicted_covariance
from drake_teleop.excitation.problem import Bounds, Evaluation, Problem, Task
from drake_teleop.excitation.robot import Robot
from drake_teleop.load.arrays import Array
from drake_teleop.load.regressor import regressor
from drake_teleop.load.tolerance import Tolerance, deviations_of, errors_of
from drake_teleop.load.trajectory import FourierTrajectory

RELIABLE = 0.95
"""Share of the records in which all asked numbers are to be within their tolerances at once."""
# The longest period [s]; the highest harmonic of the shortest [Hz]: half of what the low-pass of
# `identify` lets through, and more than most joint control follows.
_LONGEST, _FASTEST = 20.0, 15.0
# Of log T, in one descent: SLSQP, which sees straight lines, would go to nothing, and not return.
_STEP = 0.15
# Rounds of the search at most; how many that reach what is asked may come without one that is
# shorter by this share; and by how much more than needed is asked when one fell short.
_ROUNDS, _IN_VAIN, _SHORTER, _MORE = 20, 3, 0.995, 1.005
# Rounds that find nothing, after which there is nothing.
_LOST = 3
# What misses by more is no place to begin from; then the search looks everywhere, with so many
# times as many starts.
_NEAR = 1.5
_EVERYWHERE = 10
# Between the seeds of rounds: each has candidates of its own.
_OTHER = 2**33
# Later rounds look around what was found: share of the coefficients, and of the period.
_AROUND, _PERIODS = 0.2, 1.3
# The maximum over the asked numbers is sharper than that over eigenvalues: they are ten.
_SHARPER = 4.0


@dataclass(frozen=True, eq=False)
class Shortest:
    """A motion that was found.

    Attributes:
        excitation: the motion, checked; its criterion is the period.
        reached: (k,) z d_k over the tolerances, none above 1.
    """

    excitation: Excitation
    reached: Array


def shortest(
    robot: Robot,
    tolerance: Tolerance,
    *,
    harmonics: int = 3,
    seed: int = 0,
    starts: int = 4,
    progress: Callable[[float, float], None] = lambda done, best: None,
) -> Shortest:
    """Designs and checks the shortest motion that reaches a tolerance.

    Args:
        robot: the arm.
        tolerance: of its heaviest load.
        harmonics: N of Eq. (9).
        seed, progress: see `design`.
        starts: of `design`, for searches around what was found; ten times that where nothing was.

    Raises:
        DrakeTeleopError: if nothing within the limits reaches it in `_LONGEST` seconds.
    """
    errors = errors_of(tolerance, robot.limits.phi) * reliable_factor(len(tolerance.entries))
    factor = np.ones(len(errors))
    task = Task(
        robot.arm.table,
        robot.limits,
        Criterion("A16", robot.scales),
        robot.home,
        1.0,
        harmonics,
    )
    worst, around = np.inf, None
    best: Shortest | None = None
    in_vain, lost = 0, 0
    for k in range(_ROUNDS):
        problem = ShortestProblem(task, errors * factor[:, np.newaxis], robot, around)
        # The first round only tells what noise there is beside that of the wrench.
        many = _EVERYWHERE * starts if k > 0 and around is None else starts
        found = design(problem, seed=seed + _OTHER * k, starts=many, progress=progress)
        found = [each for each in found if each.value <= _LONGEST]
        if not found:
            if (lost := lost + 1) == _LOST:
                break
            around = None
            continue
        trajectory, uses = best_checked(robot, found)
        motion = sensor_motion(robot, trajectory)
        covariance = predicted_covariance(*motion, 1 / RATE, robot.noise, robot.limits.phi)
        reached = deviations_of(errors, covariance)
        worst = float(reached.max())
        around = problem.best if worst < _NEAR else None
        if worst <= 1.0:
            least = np.inf if best is None else best.excitation.trajectory.period
            in_vain = 0 if trajectory.period < _SHORTER * least else in_vain + 1
            if trajectory.period < least:
                best = Shortest(_excitation(robot, trajectory, covariance, uses, found), reached)
            if in_vain == _IN_VAIN:
                break
        seen = problem.deviations(motion, trajectory.period)
        now = factor * (reached / seen)
        # Not less than before, where a round fell short: else it might go to and fro.
        factor = _MORE * np.maximum(now, factor) if worst > 1.0 and k > 0 else now
    if best is not None:
        return best
    raise DrakeTeleopError(
        "no motion within the limits was found that reaches it"
        + (f": the best misses it by {worst:.3g} times" if np.isfinite(worst) else ""),
        where=f"{robot.name}: {tolerance}",
        remedy="ask for less, or repeat the motion of `excite`",
    )


def _excitation(
    robot: Robot,
    trajectory: FourierTrajectory,
    covariance: Array,
    uses: list[Use],
    found: list[Iterate],
) -> Excitation:
    periods = accumulate((each.value for each in found), min)
    history = [(each.evaluations, value) for each, value in zip(found, periods, strict=True)]
    return Excitation(
        robot,
        trajectory,
        "period",
        criteria_of(robot, trajectory),
        np.sqrt(np.diag(covariance)),
        uses,
        np.array(history),
        found[-1].seconds,
    )


def reliable_factor(count: int) -> float:
    """z: half-widths in standard deviations that hold `count` numbers at once in `RELIABLE`."""
    return float(ndtri(0.5 + 0.5 * RELIABLE ** (1.0 / count)))


class ShortestProblem(Problem):
    """The unknowns are x = [q0, sine, cosine, log T], see `Problem`.

    Args:
        task: its period is 1 s, its criterion is not looked at.
        errors: (k, 16) what has to be 1 or less in standard deviations.
        robot: whose sensor measures.
        around: unknowns to begin from, if there are some.

    Attributes:
        best: the unknowns with the least period of those whose `value` was asked for.
    """

    def __init__(self, task: Task, errors: Array, robot: Robot, around: Array | None) -> None:
        super().__init__(task)
        self._around, self._at, self.best = around, np.empty(0), around
        self._least = np.inf
        self._errors = errors
        self._density = robot.noise.white[:6]
        samples, n = self._vectors.shape[1], len(task.home)
        self._gradients = np.empty((2 + len(LIMITS), 3, samples, n))
        self._period, self._shortest = 1.0, task.harmonics / _FASTEST

    def trajectory(self, x: Array) -> FourierTrajectory:
        """The trajectory that x stands for."""
        return replace(super().trajectory(x[:-1]), frequency=float(np.exp(-x[-1])))

    def candidate(self, rng: np.random.Generator, *, near_home: bool) -> Array:
        """A random motion of moderate size for a random period; or like one that was found."""
        if self._around is not None and near_home:
            other = _AROUND * rng.uniform() * np.abs(self._around[:-1]).mean()
            x = self._around + np.append(other * rng.standard_normal(len(self._around) - 1), 0.0)
            x[-1] += np.log(_PERIODS) * rng.uniform(-1.0, 1.0)
            return x
        period = float(np.exp(rng.uniform(np.log(2 * self._shortest), np.log(0.5 * _LONGEST))))
        task = self.task
        self.task = replace(task, period=period)  # how large it may be depends on it
        x = super().candidate(rng, near_home=near_home)
        self.task = task
        return np.append(x, np.log(period))

    def bounds(self, x: Array) -> Bounds:
        """Of log T."""
        least, largest = np.log(self._shortest), np.log(2.0 * _LONGEST)
        around = (np.clip(x[-1] + step, least, largest) for step in (-_STEP, _STEP))
        low, high = (float(each) for each in around)
        return [(None, None)] * (len(x) - 1) + [(low, high)]

    def evaluate(self, x: Array, of_criterion: float, of_maxima: float) -> Evaluation:
        """log T, and eight limits: those of the arm, and what is asked."""
        task, n, self._at = self.task, len(self.task.home), x.copy()
        log_period = float(np.clip(x[-1], np.log(self._shortest), np.log(2.0 * _LONGEST)))
        self._period = T = float(np.exp(log_period))
        coefficients = x[n:-1].reshape(2, n, -1).swapaxes(1, 2).reshape(-1, n)
        q, qd, qdd = self._basis @ coefficients
        q, qd, qdd = q + x[:n], qd / T, qdd / T**2
        motions_of(task.table, q, qd, qdd, self._motions)
        sensor_vectors(self._motions, self._vectors)
        g = self._gradients
        g[:2] = 0.0
        use, worst, g_V = self._asked(_SHARPER * of_criterion)
        criterion_gradient(task.table, self._motions, qd, qdd, g_V, g[1])
        smooth, largest = np.empty((2, len(LIMITS)))
        limit_uses(
            task.table, q, qd, qdd, self._motions, task.limits, of_maxima, smooth, largest, g[2:]
        )
        of_period = -(g[:, 1] * qd + 2.0 * g[:, 2] * qdd).sum(axis=(1, 2))
        # More samples, and log T itself.
        of_period[1] -= 0.25
        of_period[0] = 1.0
        g[:, 1] /= T
        g[:, 2] /= T**2
        gradients = np.hstack([self._of_unknowns(), of_period[:, np.newaxis]])
        return Evaluation(
            float(x[-1]), np.append(use, smooth), gradients, max(worst, float(largest.max()))
        )

    def value(self) -> float:
        """The period at the point that was evaluated last [s]."""
        if self._period < self._least:
            self._least, self.best = self._period, self._at
        return self._period

    def deviations(self, motion: tuple[Array, Array, Array], period: float) -> Array:
        """(k,) standard deviations of what is asked in white noise of the wrench alone."""
        rows = self._rows(*motion)
        gram = np.einsum("tci,tcj->ij", rows, rows) * (period / len(rows))
        return deviations_of(self._errors, np.linalg.inv(gram))

    def _rows(self, s: Array, omega: Array, alpha: Array) -> Array:
        """(T, 6, 16) of the regression, over the roots of the noise's densities."""
        V = regressor(s, omega, alpha)
        rows = np.concatenate([np.broadcast_to(np.eye(6), (len(V), 6, 6)), V], axis=2)
        return rows / np.sqrt(self._density)[:, np.newaxis]

    def _asked(self, sharpness: float) -> tuple[float, float, Array]:
        """Use of what is asked, smooth and exact, and the gradient of the smooth one by V."""
        rows = self._rows(*self._vectors)
        share = self._period / len(rows)
        gram = np.einsum("tci,tcj->ij", rows, rows) * share
        size = 1.0 / np.sqrt(np.diag(gram))
        scaled = gram * np.outer(size, size) + 1e-11 * np.eye(16)
        inverse = np.linalg.inv(scaled) * np.outer(size, size)
        of_errors = self._errors @ inverse
        logs = 0.5 * np.log(np.einsum("ki,ki->k", of_errors, self._errors))
        weights = np.exp(sharpness * (logs - logs.max()))
        smooth = float(logs.max() + np.log(weights.sum()) / sharpness)
        weights /= weights.sum() * np.exp(2.0 * logs)
        # d log d_k = -1/2 e_k^T C dG C e_k / d_k^2, and half of that is the use's.
        g_gram = -0.25 * (of_errors.T * weights) @ of_errors
        g_rows = 2.0 * share * (rows.reshape(-1, 16) @ g_gram).reshape(rows.shape)
        g_V = (g_rows / np.sqrt(self._density)[:, np.newaxis])[:, :, 6:]
        return 1.0 + 0.5 * smooth, 1.0 + 0.5 * float(logs.max()), np.ascontiguousarray(g_V)
