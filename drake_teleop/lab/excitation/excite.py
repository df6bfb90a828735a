"""Design and check of an excitation trajectory for a robot."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import accumulate, chain, islice

import numpy as np

from drake_teleop.common import vectors
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.common.progress import StartStage, show_progress
from drake_teleop.lab.excitation import limits, optimizer
from drake_teleop.lab.excitation.check import CHECK_RATE_HZ, LimitUse, check_trajectory
from drake_teleop.lab.excitation.criteria import CRITERIA, Criterion
from drake_teleop.lab.excitation.prediction import predicted_deviations
from drake_teleop.lab.excitation.robot import Robot
from drake_teleop.load.trajectory import FourierTrajectory
from drake_teleop.station.slave.arm import ArmModel
from drake_teleop.station.slave.posture_shapes import random_posture_limits

# Scale factors of trajectories that exceed a limit between the optimiser's samples.
_AMPLITUDE_SHRINK_FACTORS = (1.0, 0.995, 0.99, 0.98)
# Smallest ratio of the criteria of successive candidates of one descent; maximum number of checks.
_MIN_CRITERION_RATIO_OF_CANDIDATES, _MAX_CHECKED_CANDIDATES = 1.05, 30
# If no candidate passes: amplitudes of motions about the start posture, and their number.
_FALLBACK_AMPLITUDE_FACTORS, _NUM_FALLBACK_MOTIONS = (1.0, 0.7, 0.5, 0.35, 0.25, 0.18, 0.12), 2
_ADVICE_BY_LIMIT = {
    "clearance": "; or, if the convex hulls of meshes touch, excite a station (drake-teleop new): "
    "shapes that touch in its start posture are ignored",
    **dict.fromkeys(("sensor", "torque"), "; or change --payload, sensor or start posture"),
}


@dataclass(frozen=True, eq=False)
class Excitation:
    """Trajectory that passed the check.

    Attributes:
        deviations: (16,) predicted standard deviations of offsets and phi with the heaviest load.
        limit_uses: use of every limit, largest first.
        criterion_history: (K, 2) number of evaluations, best criterion so far.
    """

    robot: Robot
    trajectory: FourierTrajectory
    criterion: str
    values: dict[str, float]
    deviations: Array
    limit_uses: list[LimitUse]
    criterion_history: Array
    design_cpu_time_s: float


def excite(
    robot: Robot,
    *,
    criterion: str = "kappa_w10",
    period: float = 6.0,
    harmonics: int = 5,
    seed: int = 0,
    starts: int = 4,
    seconds: float | None = None,
    progress: bool | StartStage = True,
) -> Excitation:
    """Design an excitation trajectory, a Fourier series of `harmonics` harmonics, and check it.

    `criterion` is a name in `CRITERIA`, `period` in s; for the others see `minimise_criterion`.
    """
    scaled = Criterion(criterion, robot.criterion_scales)
    if _num_sensor_rotation_axes(robot.arm) < 2:
        what = "no motion excites all parameters: joints rotate the sensor about at most one axis"
        remedy = "use an arm with two, or pass a known load_estimate to MakeTeleopStation (Python)"
        raise DrakeTeleopError(what, where=robot.name, remedy=remedy)
    with show_progress(progress) as stage:
        report = stage("Design the trajectory")

        def report_best(done: float, best: float) -> None:
            report(done, f"{criterion} {best:.4g}" if np.isfinite(best) else "")

        problem = optimizer.DesignProblem(robot, scaled, period, harmonics)
        found = optimizer.minimise_criterion(
            problem, seed=seed, starts=starts, seconds=seconds, progress=report_best
        )
        report_best(1.0, min((iterate.criterion_value for iterate in found), default=np.inf))
        small = _fallback_motions_about_start_posture(robot, found, problem, seed)
        trajectory, uses = find_best_within_limits(robot, found, stage("Check it at 1 kHz"), small)
    excitation = assemble_excitation(robot, criterion, found, trajectory, uses)
    if not np.isfinite(excitation.values[criterion]):
        what = "the largest motion that was found within all limits does not excite all parameters"
        remedy = "raise this limit, or give more --time, a longer --period or another --seed"
        raise DrakeTeleopError(f"{what}; limit use: {uses[0]}", where=robot.name, remedy=remedy)
    return excitation


def _num_sensor_rotation_axes(arm: ArmModel) -> int:
    # Axes in S: a SCARA arm has one, although it can rotate about several joints.
    postures = np.random.default_rng(0).uniform(*random_posture_limits(arm), (20, arm.num_joints))
    first, *others = (tuple(arm.pose(q)[:4]) for q in postures)
    inverse = vectors.conjugate_quaternion(first)
    axes = [vectors.quaternion_product(inverse, other)[1:] for other in others]
    return int(np.linalg.matrix_rank(np.array(axes), tol=1e-6))


def assemble_excitation(
    robot: Robot,
    criterion: str,
    iterates: list[optimizer.FeasibleIterate],
    trajectory: FourierTrajectory,
    uses: list[LimitUse],
) -> Excitation:
    motion = trajectory_sensor_motion(robot, trajectory)
    noise, phi = robot.sensor_noise, robot.limits.heaviest_phi
    best = accumulate((iterate.criterion_value for iterate in iterates), min)
    history = [(it.num_evaluations, value) for it, value in zip(iterates, best, strict=True)]
    return Excitation(
        robot,
        trajectory,
        criterion,
        criterion_values(robot, trajectory),
        predicted_deviations(*motion, 1 / CHECK_RATE_HZ, noise, phi),
        uses,
        np.array(history).reshape(-1, 2),
        iterates[-1].cpu_time_s if iterates else 0.0,
    )


def find_best_within_limits(
    robot: Robot,
    iterates: list[optimizer.FeasibleIterate],
    progress: Callable[[float], None] = lambda done: None,
    fallback_trajectories: Iterable[FourierTrajectory] = (),
) -> tuple[FourierTrajectory, list[LimitUse]]:
    """Return the best trajectory that passes the check, and its uses of the limits.

    If no iterate of the optimiser passes, `fallback_trajectories` are checked in their order.
    """
    worst: LimitUse | None = None
    candidates = islice(_feasible_candidates(iterates, robot), _MAX_CHECKED_CANDIDATES)
    for trajectory in chain(candidates, fallback_trajectories):
        uses = check_trajectory(robot, trajectory, progress)
        if uses[0].used_share <= 1:
            return trajectory, uses
        if worst is None or uses[0].used_share < worst.used_share:
            worst = uses[0]
    what = "no trajectory was found that respects all limits"
    remedy = "give more --time, a longer --period or another --seed"
    if worst is not None:
        what += f": the best uses {worst}"
        remedy += _ADVICE_BY_LIMIT.get(worst.limit_name, "")
    raise DrakeTeleopError(what, where=robot.name, remedy=remedy)


def criterion_values(robot: Robot, trajectory: FourierTrajectory) -> dict[str, float]:
    motion = trajectory_sensor_motion(robot, trajectory)
    return {
        name: Criterion(name, robot.criterion_scales).value(*motion, trajectory.period)
        for name in CRITERIA
    }


def trajectory_sensor_motion(
    robot: Robot, trajectory: FourierTrajectory
) -> tuple[Array, Array, Array]:
    """Return specific force, omega, alpha (T, 3) of the sensor, in S, at 1 kHz over one period."""
    _, motions = _joint_and_link_motions(robot, trajectory)
    s, omega, alpha = limits.sensor_motion_series(motions)
    return s, omega, alpha


def _joint_and_link_motions(
    robot: Robot, trajectory: FourierTrajectory
) -> tuple[tuple[Array, Array, Array], Array]:
    joints = trajectory.evaluate(np.arange(0.0, trajectory.period, 1 / CHECK_RATE_HZ))
    return joints, limits.link_motion_series(robot.arm.table, *joints)


def _feasible_candidates(
    iterates: list[optimizer.FeasibleIterate], robot: Robot
) -> Iterator[FourierTrajectory]:
    ranked = sorted(iterates, key=lambda iterate: iterate.criterion_value)
    last = dict.fromkeys((iterate.start_index for iterate in ranked), 0.0)
    for iterate in ranked:
        if iterate.criterion_value < _MIN_CRITERION_RATIO_OF_CANDIDATES * last[iterate.start_index]:
            continue
        last[iterate.start_index] = iterate.criterion_value
        for factor in _AMPLITUDE_SHRINK_FACTORS:
            trajectory = iterate.trajectory.with_scaled_amplitudes(factor)
            if _largest_limit_uses(robot, trajectory).max() <= 1:
                yield trajectory
                break


def _fallback_motions_about_start_posture(
    robot: Robot,
    iterates: list[optimizer.FeasibleIterate],
    problem: optimizer.DesignProblem,
    seed: int,
) -> Iterator[FourierTrajectory]:
    best = sorted(iterates, key=lambda iterate: iterate.criterion_value)[:_NUM_FALLBACK_MOTIONS]
    motions = [iterate.trajectory for iterate in best]
    rng = np.random.default_rng(seed)
    random = (problem.candidate(rng, near_home=True) for _ in range(_NUM_FALLBACK_MOTIONS))
    motions += [problem.trajectory(x) for x in random]
    for factor in _FALLBACK_AMPLITUDE_FACTORS:
        for motion in motions:
            small = replace(motion.with_scaled_amplitudes(factor), q0=robot.home_posture)
            # The last use is that of capsules; `check_trajectory` measures the true clearance.
            if _largest_limit_uses(robot, small)[:-1].max() <= 1:
                yield small
    yield replace(motions[-1].with_scaled_amplitudes(0.0), q0=robot.home_posture)  # rest


def _largest_limit_uses(robot: Robot, trajectory: FourierTrajectory) -> Array:
    joints, motions = _joint_and_link_motions(robot, trajectory)
    gradients = np.empty((len(limits.LIMIT_NAMES), 3, *joints[0].shape))
    table, bounds = robot.arm.table, robot.limits
    return limits.max_limit_uses_into(table, *joints, motions, bounds, 1e3, gradients)[1]
