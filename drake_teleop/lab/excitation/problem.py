"""Criterion and limits as functions of the optimiser's unknowns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drake_teleop.common.arrays import Array
from drake_teleop.lab.excitation.criteria import Criterion
from drake_teleop.lab.excitation.limits import (
    LIMITS,
    Limits,
    criterion_gradient,
    empty_motions,
    limit_uses,
    motions_of,
    sensor_vectors,
)
from drake_teleop.load.trajectory import FourierTrajectory

Bounds = list[tuple[float | None, float | None]]
"""Lower and upper bound of each unknown; None: unbounded."""

# Samples of a period per harmonic.
_SAMPLES_PER_HARMONIC = 24
# Size of random motions, as a share of the speed and acceleration limits.
_RELATIVE_SIZE = 0.35


@dataclass(frozen=True, eq=False)
class Task:
    """Specification of a design.

    Args:
        table: `ArmModel.table`, with the heaviest load.
        home: (n,) posture around which half of the candidates are drawn [rad].
        period: [s].
        harmonics: N of Eq. (9), at least 2.
    """

    table: Array
    limits: Limits
    criterion: Criterion
    home: Array
    period: float
    harmonics: int


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Criterion and limits at one point.

    Attributes:
        log_criterion: smooth logarithm of the criterion.
        uses: (7,) smooth largest use of each of `LIMITS`.
        gradients: (8, unknowns) of both, the criterion first.
        largest_use: exact largest use of any limit.
    """

    log_criterion: float
    uses: Array
    gradients: Array
    largest_use: float


class Problem:
    """Problem with the unknowns x = [q0, sine, cosine] of `FourierTrajectory.at_rest`."""

    def __init__(self, task: Task) -> None:
        self.task = task
        n, free = len(task.home), 2 * (task.harmonics - 1)
        samples = _SAMPLES_PER_HARMONIC * task.harmonics
        unit = np.eye(free)
        basis = FourierTrajectory.at_rest(
            np.zeros(free), unit[:, : free // 2], unit[:, free // 2 :], 1 / task.period
        )
        #: (3, T, free): q, qd, qdd of unit coefficients.
        self._basis = np.stack(basis.evaluate(np.arange(samples) * task.period / samples))
        self._motions = empty_motions(samples, n)
        self._vectors = np.empty((3, samples, 3))
        self._gradients = np.empty((1 + len(LIMITS), 3, samples, n))

    def trajectory(self, x: Array) -> FourierTrajectory:
        """Return the trajectory with the unknowns x."""
        n = len(self.task.home)
        sine, cosine = x[n:].reshape(2, n, -1)
        return FourierTrajectory.at_rest(x[:n], sine, cosine, 1 / self.task.period)

    def candidate(self, rng: np.random.Generator, *, near_home: bool) -> Array:
        """Return a random motion around the home or a random posture."""
        task, limits = self.task, self.task.limits
        rate = 2 * np.pi / task.period * np.sqrt(task.harmonics)
        size = np.minimum(limits.velocity / rate, limits.acceleration / rate**2)
        spread = np.tile(
            np.repeat(_RELATIVE_SIZE * np.minimum(size, limits.q_half), task.harmonics - 1), 2
        )
        q0 = task.home + 0.1 * rng.standard_normal(len(size))
        if not near_home:
            q0 = limits.q_middle + 0.6 * limits.q_half * rng.uniform(-1, 1, len(size))
        return np.concatenate([q0, spread * rng.standard_normal(len(spread))])

    def bounds(self, x: Array) -> Bounds | None:
        """Return the bounds of a descent from x; None: unbounded."""
        return None

    def evaluate(self, x: Array, of_criterion: float, of_maxima: float) -> Evaluation:
        """Evaluate at x with sharpness of criterion and smooth maxima."""
        task, n = self.task, len(self.task.home)
        coefficients = x[n:].reshape(2, n, -1).swapaxes(1, 2).reshape(-1, n)
        joints = self._basis @ coefficients
        joints[0] += x[:n]
        motions_of(task.table, *joints, self._motions)
        sensor_vectors(self._motions, self._vectors)
        self._gradients[0] = 0.0
        s, omega, alpha = self._vectors
        value, g_V = task.criterion.smooth(s, omega, alpha, of_criterion)
        criterion_gradient(task.table, self._motions, joints[1], joints[2], g_V, self._gradients[0])
        smooth, largest = np.empty((2, len(LIMITS)))
        limit_uses(
            task.table, *joints, self._motions, task.limits, of_maxima,
            smooth, largest, self._gradients[1:],
        )  # fmt: skip
        return Evaluation(value, smooth, self._gradients_by_unknowns(), float(largest.max()))

    def value(self) -> float:
        """Return the exact criterion of the last evaluated point."""
        s, omega, alpha = self._vectors
        return self.task.criterion.value(s, omega, alpha, self.task.period)

    def _gradients_by_unknowns(self) -> Array:
        g = self._gradients
        by_q0 = g[:, 0].sum(axis=1)
        # (8, free, n), summed over position, velocity, acceleration and time.
        by_coefficients = (self._basis.transpose(0, 2, 1) @ g).sum(axis=1)
        count, free, n = by_coefficients.shape
        by_coefficients = (
            by_coefficients.reshape(count, 2, free // 2, n).swapaxes(2, 3).reshape(count, -1)
        )
        return np.hstack([by_q0, by_coefficients])
