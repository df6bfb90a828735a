"""What is designed, as functions of the optimiser's unknowns, with analytic gradients."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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

Array = NDArray[np.float64]
Bounds = list[tuple[float | None, float | None]]
"""Of each unknown, least and largest; None: none."""

# Samples of a period for each harmonic.
_SAMPLES = 24
# Random motions have this share of the size that would use all of a speed or acceleration.
_SIZE = 0.35


@dataclass(frozen=True, eq=False)
class Task:
    """What is designed.

    Args:
        table: `ArmModel.table`, with the heaviest load.
        limits: what must be respected.
        criterion: what is minimised.
        home: (n,) a posture around which half of the candidates are drawn [rad].
        period: of the trajectory [s].
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
    """Of one point.

    Attributes:
        log_criterion: smooth logarithm of the criterion.
        uses: (7,) smooth largest use of each of `LIMITS`.
        gradients: (8, unknowns) of these, the criterion's first.
        largest_use: of any limit at any sample, not smooth.
    """

    log_criterion: float
    uses: Array
    gradients: Array
    largest_use: float


class Problem:
    """The unknowns are x = [q0, sine, cosine], see `FourierTrajectory.at_rest`.

    Args:
        task: what is designed.
    """

    def __init__(self, task: Task) -> None:
        self.task = task
        n, free = len(task.home), 2 * (task.harmonics - 1)
        samples = _SAMPLES * task.harmonics
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
        """The trajectory that x stands for."""
        n = len(self.task.home)
        sine, cosine = x[n:].reshape(2, n, -1)
        return FourierTrajectory.at_rest(x[:n], sine, cosine, 1 / self.task.period)

    def candidate(self, rng: np.random.Generator, *, near_home: bool) -> Array:
        """A random motion of moderate size, around the home posture or any other."""
        task, limits = self.task, self.task.limits
        rate = 2 * np.pi / task.period * np.sqrt(task.harmonics)
        size = np.minimum(limits.velocity / rate, limits.acceleration / rate**2)
        spread = np.tile(np.repeat(_SIZE * np.minimum(size, limits.q_half), task.harmonics - 1), 2)
        q0 = task.home + 0.1 * rng.standard_normal(len(size))
        if not near_home:
            q0 = limits.q_middle + 0.6 * limits.q_half * rng.uniform(-1, 1, len(size))
        return np.concatenate([q0, spread * rng.standard_normal(len(spread))])

    def bounds(self, x: Array) -> Bounds | None:
        """Within which a descent from x stays; None: anywhere."""
        return None

    def evaluate(self, x: Array, of_criterion: float, of_maxima: float) -> Evaluation:
        """Criterion and limits at x; sharpness of the criterion and of the smooth maxima."""
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
        return Evaluation(value, smooth, self._of_unknowns(), float(largest.max()))

    def value(self) -> float:
        """The criterion itself at the point that was evaluated last, on the samples."""
        s, omega, alpha = self._vectors
        return self.task.criterion.value(s, omega, alpha, self.task.period)

    def _of_unknowns(self) -> Array:
        """From gradients with respect to joint samples to gradients with respect to x."""
        g = self._gradients
        of_q0 = g[:, 0].sum(axis=1)
        # (8, free, n), summed over position, velocity, acceleration and time.
        of_free = (self._basis.transpose(0, 2, 1) @ g).sum(axis=1)
        count, free, n = of_free.shape
        of_free = of_free.reshape(count, 2, free // 2, n).swapaxes(2, 3).reshape(count, -1)
        return np.hstack([of_q0, of_free])
