"""How good is an excitation trajectory, how soon, and how much does the criterion matter?

`python benchmarks/excitation.py [--seeds 7] [--json FILE]` designs trajectories for the station's
slave with its tool and 30 % more, with every limit, and prints

* the value of the best trajectory that passed the check (Drake, 1 kHz, collisions included) after
  a second and later, median and worst of the seeds; thread CPU time of the optimiser without
  compilation, and the time of the check. Baseline: the same SLSQP on the same functions
  from the same candidate with finite differences;
* the errors of whitened least squares after the motions of each criterion, 16 draws each, with
  errors that are not white noise: gains of 1 % and cross-talk of 0.3 %, the wrench 1 ms late, and
  noise in the measured accelerations and angular velocity.
"""

from __future__ import annotations

import argparse
import json
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize

from drake_teleop.lab.excitation.check import check_trajectory
from drake_teleop.lab.excitation.criteria import CRITERIA, Criterion
from drake_teleop.lab.excitation.excite import (
    criterion_values,
    excite,
    find_best_within_limits,
    trajectory_sensor_motion,
)
from drake_teleop.lab.excitation.optimizer import (
    USABLE_LIMIT_SHARE,
    DesignProblem,
    minimise_criterion,
)
from drake_teleop.lab.excitation.robot import Robot, RobotFromScenario
from drake_teleop.load.inertia import mass_com_inertia, phi_from_mass_com_inertia
from drake_teleop.load.normal_equations import identify
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.station.scenario import LoadScenario

#: (criterion, period [s], short and long computation time [s]), five harmonics.
ROWS = (
    ("kappa_w10", 6.0, 1.0, 3.0),
    ("kappa_w10", 10.0, 1.0, 2.0),
    ("kappa10", 6.0, 1.0, 5.0),
    ("kappa10", 10.0, 1.0, 15.0),
)
TOOL = phi_from_mass_com_inertia(
    3.13,
    [0.004, -0.003, 0.085],
    [[0.012, 0.0002, -0.0004], [0.0002, 0.0115, 0.0003], [-0.0004, 0.0003, 0.0045]],
)
WRENCH_NOISE = np.repeat([0.25, 0.012], 3)
MOTION_NOISE = (0.06, 0.002, 1.5)
GAIN, CROSS_TALK, DELAY, DRAWS = 0.01, 0.003, 1e-3, 16


def problem_of(robot: Robot, criterion: str, period: float) -> DesignProblem:
    return DesignProblem(robot, Criterion(criterion, robot.criterion_scales), period, 5)


def speed(robot: Robot, row: tuple[str, float, float, float], seeds: int) -> dict[str, Any]:
    """Return the checked values after both times, by seed, and the time of one check."""
    criterion, period, soon, later = row
    values: dict[str, list[float]] = {"soon": [], "later": []}
    for seed in range(seeds):
        found = minimise_criterion(problem_of(robot, criterion, period), seed=seed, seconds=later)
        for name, seconds in (("soon", soon), ("later", later)):
            trajectory, _ = find_best_within_limits(
                robot, [it for it in found if it.cpu_time_s <= seconds]
            )
            values[name].append(criterion_values(robot, trajectory)[criterion])
    start = time.thread_time()
    check_trajectory(robot, trajectory)
    values["check_s"] = [time.thread_time() - start]
    return {"criterion": criterion, "period": period, "soon_s": soon, "later_s": later} | values


class _TimeIsUpError(Exception):
    pass


def finite_differences(robot: Robot, period: float, seconds: float, seed: int) -> float:
    """Return kappa_w10 on the grid after a time of SLSQP without gradients, or inf."""
    problem = problem_of(robot, "kappa_w10", period)
    rng = np.random.default_rng(seed)
    candidates = [problem.candidate(rng, near_home=k % 2 == 0) for k in range(64)]
    merits = []
    for x in candidates:
        point = problem.evaluate(x, 1.0, 100.0)
        merits.append(point.log_criterion + 10 * max(point.smooth_limit_uses.max() - 1, 0))
    best, start = float("inf"), time.thread_time()

    def evaluate(x: np.ndarray) -> Any:
        nonlocal best
        if time.thread_time() - start > seconds:
            raise _TimeIsUpError
        point = problem.evaluate(x, 12.0, 200.0)
        if point.largest_limit_use <= 1:
            best = min(best, problem.value())
        return point

    with suppress(_TimeIsUpError):
        minimize(
            lambda x: evaluate(x).log_criterion,
            candidates[int(np.argmin(merits))],
            method="SLSQP",
            constraints={
                "type": "ineq",
                "fun": lambda x: USABLE_LIMIT_SHARE - evaluate(x).smooth_limit_uses,
            },
            options={"maxiter": 1000},
        )
    return best


def errors(robot: Robot, criterion: str, seeds: int) -> list[float]:
    """Return the rms errors of mass [%], centre of mass [mm] and inertia about it [%]."""
    squares = []
    for seed in range(seeds):
        motion = excite(robot, criterion=criterion, seed=seed).trajectory
        s, omega, alpha = trajectory_sensor_motion(robot, motion)
        late = round(DELAY * 1e3)
        truth = np.roll(non_contact_wrench(s, omega, alpha, TOOL), late, axis=0)
        rng = np.random.default_rng(seed)
        for _ in range(DRAWS):
            gains = np.eye(6) + np.diag(GAIN * rng.standard_normal(6))
            # Cross-talk in the natural proportion of the channels, 0.1 m between force and torque.
            lengths = np.repeat([1.0, 0.1], 3)
            gains += CROSS_TALK * rng.standard_normal((6, 6)) * np.outer(lengths, 1 / lengths)
            wrench = truth @ gains.T + WRENCH_NOISE * rng.standard_normal(truth.shape)
            measured = [
                x + std * rng.standard_normal(x.shape)
                for x, std in zip((s, omega, alpha), MOTION_NOISE, strict=True)
            ]
            found = identify(wrench, *measured, noise=WRENCH_NOISE)
            squares.append(np.square(_relative(found.phi)))
    return np.sqrt(np.mean(squares, axis=0)).tolist()


def _relative(phi: np.ndarray) -> list[float]:
    mass, com, inertia = mass_com_inertia(phi)
    true_mass, true_com, true_inertia = mass_com_inertia(TOOL)
    off = np.linalg.norm(inertia - true_inertia) / np.linalg.norm(true_inertia)
    return [100 * (mass / true_mass - 1), 1e3 * float(np.linalg.norm(com - true_com)), 100 * off]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=7)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    robot = RobotFromScenario(LoadScenario("identification"))
    results: dict[str, Any] = {"speed": [], "errors": {}}
    print("criterion  period  after    median  worst | after    median  worst | one check")
    for row in ROWS:
        answer = speed(robot, row, options.seeds)
        results["speed"].append(answer)
        parts = [
            f"{answer[f'{name}_s']:4.0f} s  {np.median(answer[name]):7.3f}{max(answer[name]):7.3f}"
            for name in ("soon", "later")
        ]
        print(f"{row[0]:10s} {row[1]:4.0f} s  {' | '.join(parts)} | {answer['check_s'][0]:.2f} s")
    baseline = [finite_differences(robot, 6.0, 3.0, seed) for seed in range(options.seeds)]
    results["finite_differences"] = baseline
    print(f"finite differences, kappa_w10, 6 s, after 3 s: {np.sort(baseline).round(3)}")
    print("\nWith errors that are not white noise (3 motions): mass [%], com [mm], inertia [%]")
    for criterion in CRITERIA:
        results["errors"][criterion] = errors(robot, criterion, 3)
        print(f"{criterion:10s} " + "".join(f"{x:9.3f}" for x in results["errors"][criterion]))
    if options.json:
        options.json.write_text(json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    main()
