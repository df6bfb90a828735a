"""Do the thresholds of an experiment hold for participants with a known threshold?

    python benchmarks/participants.py [--participants 200] [--trials 40] [--json FILE]

Each simulated participant takes part in one condition of an experiment
(`drake_teleop.live.experiment`): two intervals, and the answer which of them had the stimulus. A
psychometric function of the level gives the answers, without a station. Its threshold (d' = 1) is
drawn log-uniformly from the middle 90 % of the levels. The figures are the share of participants
whose 95 % interval contains the true threshold, for observers as `PsiMethod` assumes them and for
others, and the error: the factor that two thirds of the estimates are within. The baseline is a
staircase (two down, one up, steps of a factor 1.4; Levitt 1971) with the same participants. It
converges to 71 % correct, d' of 0.77, so its error refers to that level; it has no interval.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.special import ndtr, ndtri

from drake_teleop.live.experiment.psychometrics import PsiMethod, correct_answer_probability

LOW, HIGH = 0.2, 20.0
"""Range of the levels, for example in N."""
Curve = Callable[[float], float]
"""Function from a level to P(correct)."""


def as_thought(rng: np.random.Generator, threshold: float) -> Curve:
    """Return a curve with slope and lapses in the range that `PsiMethod` assumes."""
    slope, lapse = np.exp(rng.uniform(np.log(0.7), np.log(3.0))), rng.uniform(0.0, 0.06)
    return lambda x: float(correct_answer_probability(x, threshold, slope, lapse))


def without_lapse(rng: np.random.Generator, threshold: float) -> Curve:
    """Return a curve without lapses, with d' proportional to the level."""
    return lambda x: float(correct_answer_probability(x, threshold, 1.0, 0.0))


def weibull(rng: np.random.Generator, threshold: float) -> Curve:
    """Return a Weibull curve of slope 2, scaled to 76 % at the threshold."""
    half = -math.log(2.0 * (1.0 - ndtr(1.0 / math.sqrt(2.0))))
    return lambda x: 0.5 + 0.49 * (1.0 - math.exp(-half * (x / threshold) ** 2.0))


def inattentive(rng: np.random.Generator, threshold: float) -> Curve:
    """Return a curve with lapses in 10 % of the trials, beyond the range of `PsiMethod`."""
    return lambda x: float(correct_answer_probability(x, threshold, 1.5, 0.1))


def noticing(rng: np.random.Generator, threshold: float) -> Curve:
    """Return a curve of high threshold theory; P(noticed) is log-normal, other answers guessed."""
    share = 2.0 * ndtr(1.0 / math.sqrt(2.0)) - 1.0
    middle = math.log(threshold) - 0.6 * ndtri(share)
    return lambda x: 0.5 + 0.5 * float(ndtr((math.log(x) - middle) / 0.6))


OBSERVERS = (as_thought, without_lapse, weibull, inattentive, noticing)


def of_psi(curve: Curve, rng: np.random.Generator, trials: int) -> PsiMethod:
    """Return the `PsiMethod` after the answers of a participant."""
    psi = PsiMethod(LOW, HIGH)
    for _ in range(trials):
        level = psi.next_level()
        psi.update_posterior(level, bool(rng.random() < curve(level)))
    return psi


def of_staircase(curve: Curve, rng: np.random.Generator, trials: int, factor: float = 1.4) -> float:
    """Return the geometric mean of the last six reversals; nan if there are none."""
    level, in_a_row, down, turns = HIGH, 0, True, []
    for _ in range(trials):
        correct = rng.random() < curve(level)
        in_a_row = in_a_row + 1 if correct else 0
        if correct and in_a_row < 2:
            continue
        in_a_row = 0
        if correct != down:
            turns.append(level)
        down = correct
        level = min(max(level / factor if correct else level * factor, LOW), HIGH)
    return math.exp(np.mean(np.log(turns[-6:]))) if turns else math.nan


def figures(observer: Callable[[np.random.Generator, float], Curve], n: int, trials: int) -> dict:
    """Return the figures of n participants."""
    rng = np.random.default_rng(22)
    middle = 0.05 * math.log(HIGH / LOW)
    held, off, width, stair = [], [], [], []
    for _ in range(n):
        truth = math.exp(rng.uniform(math.log(LOW) + middle, math.log(HIGH) - middle))
        curve = observer(rng, truth)
        found = of_psi(curve, rng, trials).threshold()
        held.append(found.low <= truth <= found.high)
        off.append(math.log(found.value / truth))
        width.append(0.5 * math.log(found.high / found.low))
        steps = np.geomspace(LOW / 3, HIGH * 3, 2000)
        at_71 = steps[np.searchsorted([curve(x) for x in steps], math.sqrt(0.5))]
        stair.append(math.log(of_staircase(curve, rng, trials) / at_71))
    return {
        "in_interval": float(np.mean(held)),
        "interval_factor": float(np.exp(np.median(width))),
        "error_factor": float(np.exp(np.quantile(np.abs(off), 2 / 3))),
        "staircase_error_factor": float(np.exp(np.nanquantile(np.abs(stair), 2 / 3))),
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--participants", type=int, default=200)
    parser.add_argument("--trials", type=int, default=40)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    started, found = time.perf_counter(), {}
    print(f"{'observer':15} in 95 % interval   half interval   error   staircase")
    for observer in OBSERVERS:
        name = observer.__name__
        row = found[name] = figures(observer, options.participants, options.trials)
        print(
            f"{name:15} {row['in_interval']:16.1%}   x/ {row['interval_factor']:10.2f}"
            f"   {row['error_factor']:5.2f}   {row['staircase_error_factor']:9.2f}"
        )
    found["seconds"] = time.perf_counter() - started
    print(f"{options.participants} of each, {options.trials} trials; {found['seconds']:.1f} s")
    if options.json:
        options.json.write_text(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()
