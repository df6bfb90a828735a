"""How do noisy accelerations bias the load, and which estimator corrects it?

The station's tool rotates and moves by sines for 1.5 s at 1 kHz, in 200 records with different
noise: that of the station's JR3, or the level "High" of the UTIAS protocol (Nadeau, Giamou, Kelly,
ICRA 2023). The estimators are recursive least squares (RLS), instrumental variables (RIV) and total
least squares (RTLS), and the batch estimators. The instruments are the commanded motion, 10 ms
early, with the noise of differentiated encoders. Parameters count if their RLS bias exceeds three
standard errors of its mean; the figure is the bias of another estimator over that of RLS. A bias
below two of its own standard errors is not significant. Times are per sample, in one compiled
loop, next to the same RLS in plain numpy.

    python benchmarks/errors_in_variables.py [--seeds 200] [--first 0] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from instrumental import RecursiveInstrumentalVariables

from drake_teleop.load.batch.methods import identify_batch
from drake_teleop.load.identification import PARAMETER_NAMES
from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.load.normal_equations import NoiseStd
from drake_teleop.load.online.recursive import PRIOR_STD, RecursiveLeastSquares
from drake_teleop.load.online.recursive_tls import RecursiveTotalLeastSquares
from drake_teleop.load.regressor import non_contact_wrench, regressor

RATE, DURATION, LEAD = 1000.0, 1.5, 10
PHI = phi_from_mass_com_inertia(
    3.13,
    [0.004, -0.003, 0.085],
    [[0.012, 0.0002, -0.0004], [0.0002, 0.0115, 0.0003], [-0.0004, 0.0003, 0.0045]],
)
OFFSETS = np.array([6.2, -3.9, 8.1, 0.31, -0.42, 0.12])
TRUTH = np.concatenate([OFFSETS, PHI])
# Standard deviations of force [N], torque [N m]; s [m/s^2], omega [rad/s], alpha [rad/s^2].
LEVELS = {
    "JR3": ((0.25, 0.012), (0.06, 0.002, 1.5)),
    "UTIAS High": ((0.2, 0.01), (0.1, 0.0, 1.0)),
}
# Noise of the instruments: differentiated encoders.
INSTRUMENT_NOISE = (0.05, 0.001, 0.5)


def motion() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (s, omega, alpha), (N, 3) each: the angles and the acceleration of So are sines."""
    t = np.arange(0.0, DURATION, 1 / RATE)
    rng = np.random.default_rng(1)
    frequency = 2 * np.pi * np.array([1.0, 2.0, 3.0]) / DURATION
    wave = np.exp(1j * (frequency * t[:, None, None] + rng.uniform(0, 2 * np.pi, (6, 3))))
    amplitude = np.array([0.35, 0.12, 0.05])
    angles = np.moveaxis((amplitude * wave)[:, :3], 0, -1)  # (3, 3, N)
    (r, p, _), (dr, dp, dy), (ddr, ddp, ddy) = (
        (angles * ((1j * frequency) ** k)[:, None]).sum(axis=1).real for k in range(3)
    )
    sr, cr, sp, cp = np.sin(r), np.cos(r), np.sin(p), np.cos(p)
    omega = np.stack([dr - sp * dy, cr * dp + sr * cp * dy, cr * cp * dy - sr * dp], axis=1)
    alpha = np.stack(
        [
            ddr - sp * ddy - cp * dp * dy,
            cr * ddp + sr * cp * ddy - sr * dr * dp + (cr * cp * dr - sr * sp * dp) * dy,
            cr * cp * ddy - sr * ddp - (sr * cp * dr + cr * sp * dp) * dy - cr * dr * dp,
        ],
        axis=1,
    )
    gravity = 9.81 * np.stack([-sp, sr * cp, cr * cp], axis=1)
    acceleration = (wave[:, 3:] @ np.array([1.5, 1.0, 0.5])).real
    return gravity + acceleration, omega, alpha


def record(level: str, seed: int) -> tuple[np.ndarray, list[np.ndarray], np.ndarray]:
    """Return wrench (N, 6), measured motion (three (N, 3)) and instruments (N, 9) of one seed."""
    rng, clean = np.random.default_rng(seed), motion()
    wrench_std, motion_std = LEVELS[level]
    shape = clean[0].shape
    F = OFFSETS + non_contact_wrench(*clean, PHI)
    F += np.repeat(wrench_std, 3) * rng.normal(size=F.shape)
    measured = [x + n * rng.normal(size=shape) for x, n in zip(clean, motion_std, strict=True)]
    commanded = np.roll(np.hstack(clean), -LEAD, axis=0)
    commanded += np.repeat(INSTRUMENT_NOISE, 3) * rng.normal(size=commanded.shape)
    return F, measured, commanded


def estimators(level: str) -> dict[str, Any]:
    """Return new recursive estimators."""
    wrench_std, motion_std = (np.repeat(std, 3) for std in LEVELS[level])
    return {
        "RLS": RecursiveLeastSquares(wrench_std),
        "RIV": RecursiveInstrumentalVariables(wrench_std),
        "RTLS": RecursiveTotalLeastSquares(wrench_std, motion_std),
    }


def bound(level: str) -> np.ndarray:
    """Return the least standard deviations (16,) of an unbiased estimate for unknown true motion.

    Cramer-Rao: the samples have the information X^T R^-1 X. R is the covariance of the errors of
    the
    six equations by noise of wrench and motion, to first order in the motion's noise.
    """
    wrench_std, motion_std = LEVELS[level]
    clean = np.hstack(motion())
    V = regressor(*np.split(clean, 3, axis=1))
    X = np.concatenate([np.broadcast_to(np.eye(6), (len(V), 6, 6)), V], axis=2)
    R = np.zeros((len(V), 6, 6)) + np.diag(np.repeat(np.square(wrench_std), 3))
    step = 1e-4
    for shift, std in zip(step * np.eye(9), np.repeat(motion_std, 3), strict=True):
        ahead, behind = (
            non_contact_wrench(*np.split(clean + d, 3, axis=1), PHI) for d in (shift, -shift)
        )
        error = std * (ahead - behind) / (2 * step)
        R += error[:, :, None] * error[:, None, :]
    information = np.einsum("nci,ncd,ndj->ij", X, np.linalg.inv(R), X)
    return np.sqrt(np.diag(np.linalg.inv(information)))


def study(
    level: str, seeds: int, batch: tuple[str, ...] = (), first: int = 0
) -> dict[str, np.ndarray]:
    """Return errors (seeds, 16) of each estimator after 1.5 s, for the records from `first` on."""
    errors: dict[str, list[np.ndarray]] = {}
    wrench_std, (s, omega, alpha) = LEVELS[level]
    noise = NoiseStd(np.repeat(wrench_std, 3), s, omega, alpha)
    for seed in range(first, first + seeds):
        F, measured, commanded = record(level, seed)
        for name, estimator in estimators(level).items():
            extra = [commanded] if name == "RIV" else []
            estimator.update_samples(F, *measured, *extra)
            found = np.concatenate([estimator.offsets, estimator.phi])
            errors.setdefault(name, []).append(found - TRUTH)
        for method in batch:
            result = identify_batch(F, *measured, method=method, noise=noise).identification
            found = np.concatenate([result.offsets, result.phi])
            errors.setdefault(f"batch {method}", []).append(found - TRUTH)
    return {name: np.array(rows) for name, rows in errors.items()}


def summary(level: str, errors: dict[str, np.ndarray]) -> dict[str, Any]:
    """Return the bias over that of RLS, where it is significant; errors of mass and its centre."""
    least = bound(level)
    means = {name: rows.mean(axis=0) for name, rows in errors.items()}
    standard = {n: rows.std(axis=0, ddof=1) / len(rows) ** 0.5 for n, rows in errors.items()}
    biased = np.abs(means["RLS"]) > 3.0 * standard["RLS"]
    com = PHI[1:4] / PHI[0]
    figures: dict[str, Any] = {
        "biased": [n for n, b in zip(PARAMETER_NAMES, biased, strict=True) if b]
    }
    # A fifth of the RLS bias, in standard errors of the best unbiased estimator's mean.
    of_best = 0.2 * np.abs(means["RLS"]) / least * len(errors["RLS"]) ** 0.5
    figures["a_fifth_over_least_standard_error"] = of_best[biased].tolist()
    for name, rows in errors.items():
        phi = rows[:, 6:] + PHI
        distance = np.linalg.norm(phi[:, 1:4] / phi[:, :1] - com, axis=1)
        ratio = np.abs(means[name] / means["RLS"])[biased]
        own = (np.abs(means[name]) / standard[name])[biased]
        figures[name] = {
            "mean": means[name].tolist(),
            "standard_error": standard[name].tolist(),
            "bias_over_rls": ratio.tolist(),
            "bias_over_rls_max": float(ratio.max()),
            "bias_over_own_standard_error": own.tolist(),
            "neither_a_fifth_nor_insignificant": int(np.sum((ratio > 0.2) & (own > 2.0))),
            "scatter_over_bound_max": float((rows.std(axis=0, ddof=1) / least).max()),
            "mass_error_max_percent": float(np.abs(rows[:, 6]).max() / PHI[0] * 100),
            "com_error_max_percent": float(distance.max() / np.linalg.norm(com) * 100),
        }
    return figures


def numpy_rls(F: np.ndarray, measured: list[np.ndarray]) -> float:
    """Return the microseconds per sample of RLS in plain numpy: six rows at once, V given."""
    V, theta, P = regressor(*measured), np.zeros(16), np.diag(np.square(PRIOR_STD))
    R = np.diag(np.repeat(np.square(LEVELS["JR3"][0]), 3))
    rows = np.concatenate([np.broadcast_to(np.eye(6), (len(F), 6, 6)), V], axis=2)
    start = time.thread_time()
    for f, X in zip(F, rows, strict=True):
        PX = P @ X.T
        gain = PX @ np.linalg.inv(R + X @ PX)
        theta = theta + gain @ (f - X @ theta)
        P = P - gain @ PX.T
    return (time.thread_time() - start) / len(F) * 1e6


def times(repetitions: int = 15) -> dict[str, float]:
    """Return the least CPU microseconds per sample, interleaved."""
    F, measured, commanded = record("JR3", 0)
    best: dict[str, float] = {}
    for _ in range(repetitions):
        took = {"numpy RLS": numpy_rls(F, measured)}
        for name, estimator in estimators("JR3").items():
            extra = [commanded] if name == "RIV" else []
            start = time.thread_time()
            estimator.update_samples(F, *measured, *extra)
            took[name] = (time.thread_time() - start) / len(F) * 1e6
        best = {name: min(t, best.get(name, t)) for name, t in took.items()}
    return best


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=200)
    parser.add_argument("--first", type=int, default=0, help="first seed (default: 0)")
    parser.add_argument("--json", type=Path, help="file for the figures")
    arguments = parser.parse_args()
    report: dict[str, Any] = {"seeds": arguments.seeds}
    for level in LEVELS:
        errors = study(level, arguments.seeds, ("whitened", "total"), arguments.first)
        report[level] = figures = summary(level, errors)
        names = list(errors)
        print(f"\n{level}: mean error after {DURATION} s, in standard deviations of RLS")
        print(f"{'':8s}" + "".join(f"{name:>16s}" for name in names) + "  a fifth / least s.e.")
        deviation = errors["RLS"].std(axis=0)
        fifth = iter(figures["a_fifth_over_least_standard_error"])
        for i, parameter in enumerate(PARAMETER_NAMES):
            if parameter in figures["biased"]:
                row = "".join(f"{errors[n][:, i].mean() / deviation[i]:16.3f}" for n in names)
                print(f"{parameter:8s}{row}{next(fifth):10.2f}")
        for key in (
            *("bias_over_rls_max", "neither_a_fifth_nor_insignificant", "scatter_over_bound_max"),
            *("mass_error_max_percent", "com_error_max_percent"),
        ):
            print(f"{key}:  " + "  ".join(f"{n} {figures[n][key]:.3g}" for n in names))
    report["microseconds_a_sample"] = took = times()
    print("\nmicroseconds a sample, and over plain numpy RLS")
    for name, t in took.items():
        print(f"{name:10s}{t:8.2f}{t / took['numpy RLS']:8.3f}")
    if arguments.json:
        arguments.json.write_text(json.dumps(report, indent=2) + "\n")


if __name__ == "__main__":
    main()
