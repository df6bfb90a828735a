"""An excitation trajectory for a robot: designed, and checked; or an error."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.progress import Stage, show_progress
from drake_teleop.lab.excitation.check import RATE, Use, check
from drake_teleop.lab.excitation.criteria import CRITERIA, Criterion
from drake_teleop.lab.excitation.design import Iterate, design
from drake_teleop.lab.excitation.limits import (
    LIMITS,
    empty_motions,
    limit_uses,
    motions_of,
    sensor_vectors,
)
from drake_teleop.lab.excitation.prediction import predicted_deviations
from drake_teleop.lab.excitation.problem import Problem, Task
from drake_teleop.lab.excitation.robot import Robot
from drake_teleop.load.trajectory import FourierTrajectory

Array = NDArray[np.float64]

# A trajectory between whose samples the optimiser missed a peak is made smaller about its middle.
_REPAIRS = (1.0, 0.995, 0.99, 0.98)
# Of one descent, a candidate at every such factor of the criterion; how many are checked at most.
_WORSE, _CHECKED = 1.05, 30
_HULLS = (
    "; or, if it is the hulls of meshes that touch, excite a station (drake-teleop new): what"
    " touches where its arm starts is let off"
)


@dataclass(frozen=True, eq=False)
class Excitation:
    """A trajectory that was checked.

    Attributes:
        robot: the arm, its surroundings and its limits.
        trajectory: at rest at both ends.
        criterion: name of what was minimised.
        values: every criterion, by name, of one period at 1 kHz.
        deviations: (16,) predicted standard deviations of offsets and phi of the heaviest load,
            see `predicted_deviations`.
        uses: of every limit, as checked, the largest first.
        history: (K, 2) evaluations of the criterion, and its best value until then.
        seconds: thread CPU time until the last of them, which no two designs have the same [s].
    """

    robot: Robot
    trajectory: FourierTrajectory
    criterion: str
    values: dict[str, float]
    deviations: Array
    uses: list[Use]
    history: Array
    seconds: float


def excite(
    robot: Robot,
    *,
    criterion: str = "kappa_w10",
    period: float = 6.0,
    harmonics: int = 5,
    seed: int = 0,
    starts: int = 4,
    seconds: float | None = None,
    progress: bool | Stage = True,
) -> Excitation:
    """Designs an excitation trajectory and checks it.

    Args:
        robot: from `RobotFromScenario` or `RobotFromModel`.
        criterion: one of `criteria.CRITERIA`.
        period: of the trajectory [s].
        harmonics: N of Eq. (9), at least 2.
        seed, starts, seconds: see `design`.
        progress: whether bars are shown, or where: see `pages/progress.py`.

    Raises:
        DrakeTeleopError: if nothing was found that respects all limits.
    """
    task = Task(
        robot.arm.table,
        robot.limits,
        Criterion(criterion, robot.scales),
        robot.home,
        period,
        harmonics,
    )
    with show_progress(progress) as stage:
        told = stage("Design the trajectory")

        def designing(done: float, best: float) -> None:
            told(done, f"{criterion} {best:.4g}" if np.isfinite(best) else "")

        found = design(Problem(task), seed=seed, starts=starts, seconds=seconds, progress=designing)
        designing(1.0, min((iterate.value for iterate in found), default=np.inf))
        trajectory, uses = best_checked(robot, found, stage("Check it at 1 kHz"))
    best = accumulate((iterate.value for iterate in found), min)
    return Excitation(
        robot,
        trajectory,
        criterion,
        criteria_of(robot, trajectory),
        _deviations(robot, trajectory),
        uses,
        np.array([(it.evaluations, value) for it, value in zip(found, best, strict=True)]),
        found[-1].seconds,
    )


def best_checked(
    robot: Robot, found: list[Iterate], progress: Callable[[float], None] = lambda done: None
) -> tuple[FourierTrajectory, list[Use]]:
    """The best of `design` that passes the check, and what it uses of every limit.

    Args:
        robot: the arm in its surroundings.
        found: from `design`.
        progress: of each check.

    Raises:
        DrakeTeleopError: if nothing passes.
    """
    worst: Use | None = None
    for trajectory in _candidates(found, robot):
        uses = check(robot, trajectory, progress)
        if uses[0].share <= 1:
            return trajectory, uses
        if worst is None or uses[0].share < worst.share:
            worst = uses[0]
    raise DrakeTeleopError(
        "no trajectory was found that respects all limits"
        + (f": the best uses {worst}" if worst else ""),
        where=robot.name,
        remedy="take more time, a longer period or another seed"
        + (_HULLS if worst is not None and worst.limit == "clearance" else ""),
    )


def criteria_of(robot: Robot, trajectory: FourierTrajectory) -> dict[str, float]:
    """The value of every criterion over one period at 1 kHz."""
    motion = sensor_motion(robot, trajectory)
    return {
        name: Criterion(name, robot.scales).value(*motion, trajectory.period) for name in CRITERIA
    }


def sensor_motion(robot: Robot, trajectory: FourierTrajectory) -> tuple[Array, Array, Array]:
    """s, omega, alpha of S, (T, 3) each, in S, of one period at 1 kHz."""
    joints = trajectory.evaluate(np.arange(0.0, trajectory.period, 1 / RATE))
    motions = empty_motions(*joints[0].shape)
    motions_of(robot.arm.table, *joints, motions)
    out = np.empty((3, len(motions), 3))
    sensor_vectors(motions, out)
    s, omega, alpha = out
    return s, omega, alpha


def _deviations(robot: Robot, trajectory: FourierTrajectory) -> Array:
    motion = sensor_motion(robot, trajectory)
    return predicted_deviations(*motion, 1 / RATE, robot.noise, robot.limits.phi)


def _candidates(found: list[Iterate], robot: Robot) -> Iterator[FourierTrajectory]:
    """What respects the limits between the optimiser's samples too, the best first.

    The optimiser knows shapes as capsules and may pass a corner too near, along all of a descent's
    end. So of each descent there are iterates at every `_WORSE`, as long as the check fails them.
    """
    ranked = sorted(found, key=lambda iterate: iterate.value)
    last = dict.fromkeys((iterate.start for iterate in ranked), 0.0)
    offered = 0
    for iterate in ranked:
        if iterate.value < _WORSE * last[iterate.start]:
            continue
        last[iterate.start] = iterate.value
        for factor in _REPAIRS:
            trajectory = iterate.trajectory.scaled(factor)
            if _largest_use(robot, trajectory) <= 1:
                yield trajectory
                offered += 1
                break
        if offered == _CHECKED:
            return


def _largest_use(robot: Robot, trajectory: FourierTrajectory) -> float:
    joints = trajectory.evaluate(np.arange(0.0, trajectory.period, 1 / RATE))
    motions = empty_motions(*joints[0].shape)
    motions_of(robot.arm.table, *joints, motions)
    smooth, largest = np.empty((2, len(LIMITS)))
    gradients = np.empty((len(LIMITS), 3, *joints[0].shape))
    limit_uses(robot.arm.table, *joints, motions, robot.limits, 1e3, smooth, largest, gradients)
    return float(largest.max())
