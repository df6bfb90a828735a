"""How soon is a grasped object noticed and identified, and what causes false alarms?

The station's tool is identified from 10 s of motion. Then it moves by sines at 1 kHz for 10 s with
different noise: that of the JR3 in force, torque and measured accelerations, or an ideal sensor.
After 3 s nothing happens, 0.8 kg is grasped or released within 50 ms, or the environment touches:

    knock    3 to 40 ms, 5 to 100 N, any direction
    push     2 to 50 N, constant in S, any direction, 3 s
    hand     2 to 30 N that vary by 40 % with 0.3 to 3 Hz, any direction, 4 s
    along g  2 to 25 N, constant, up or down, 3 s: as a weight without inertia

States are those of `drake_teleop.load.online.change`. Times are per sample in one compiled loop,
next to recursive least squares.

    python benchmarks/load_change.py [--seeds 500] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from drake_teleop.load.batch.methods import identify_batch
from drake_teleop.load.identification import Identification, load_of_object
from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.load.normal_equations import NoiseStd
from drake_teleop.load.online.change import (
    OFFSET_DRIFT_STD,
    STATE_NAMES,
    change_detector_parameters,
    detector_states_of_log,
    identified_or_known_load,
    initial_change_memory,
    new_load_age_in_samples,
)
from drake_teleop.load.online.recursive import RecursiveLeastSquares
from drake_teleop.load.regressor import non_contact_wrench

PERIOD, DURATION, EVENT = 1e-3, 10.0, 3.0
TOOL = phi_from_mass_com_inertia(
    3.13,
    [0.004, -0.003, 0.085],
    [[0.012, 0.0002, -0.0004], [0.0002, 0.0115, 0.0003], [-0.0004, 0.0003, 0.0045]],
)
OBJECT = phi_from_mass_com_inertia(0.8, [0.04, 0.0, 0.16], np.diag([8e-4, 8e-4, 4e-4]))
OFFSETS = np.array([6.2, -3.9, 8.1, 0.31, -0.42, 0.12])
# Standard deviations of force [N], torque [N m]; s [m/s^2], omega [rad/s], alpha [rad/s^2]. The
# monitor requires small positive ones for an ideal sensor.
SENSORS = {"JR3": ((0.25, 0.012), (0.06, 0.0, 1.5)), "ideal": ((1e-6, 1e-6), (0.0, 0.0, 0.0))}
CONTACTS = ("knock", "push", "hand", "along g")

Record = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def motion(seed: int) -> tuple[np.ndarray, list[np.ndarray], np.ndarray]:
    """Return times (N,); (s, omega, alpha) and the vertical in S, (N, 3) each.

    Roll, pitch, yaw and the acceleration of So are sines.
    """
    t, rng = np.arange(0.0, DURATION, PERIOD), np.random.default_rng(seed)
    frequency = 2 * np.pi * rng.uniform(0.2, 1.2, (6, 3))
    wave = np.exp(1j * (frequency * t[:, None, None] + rng.uniform(0, 2 * np.pi, (6, 3))))
    angles = np.moveaxis((np.array([0.35, 0.15, 0.08]) * wave)[:, :3], 0, -1)  # (3, 3, N)
    (r, p, _), (dr, dp, dy), (ddr, ddp, ddy) = (
        (angles * ((1j * frequency[:3, :, None]) ** k)).sum(axis=1).real for k in range(3)
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
    up = np.stack([-sp, sr * cp, cr * cp], axis=1)
    acceleration = (wave[:, 3:] @ np.array([1.0, 0.6, 0.3])).real
    return t, [9.81 * up + acceleration, omega, alpha], up


def touch(kind: str, seed: int, t: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return the wrench (N, 6) of the environment on the tool, about 0.2 m in front of So."""
    rng, after = np.random.default_rng([seed, 1]), t - EVENT
    direction = rng.normal(size=3)
    direction = np.broadcast_to(direction / np.linalg.norm(direction), up.shape)
    if kind == "knock":
        length = rng.uniform(0.003, 0.04)
        shape = np.sin(np.pi * np.clip(after / length, 0.0, 1.0))
        force = rng.uniform(5.0, 100.0)
    else:
        lasts, force = (4.0, rng.uniform(2.0, 30.0)) if kind == "hand" else (3.0, 0.0)
        shape = np.clip(after / 0.05, 0.0, 1.0) * (after < lasts)
    if kind == "hand":
        shape = shape * (0.6 + 0.4 * np.sin(2 * np.pi * rng.uniform(0.3, 3.0) * after))
    if kind == "push":
        force = rng.uniform(2.0, 50.0)
    if kind == "along g":
        force = rng.uniform(2.0, 25.0) * rng.choice([-1.0, 1.0])
        direction = up
    f = force * shape[:, None] * direction
    return np.hstack([f, np.cross(np.array([0.0, 0.0, 0.2]) + 0.02 * rng.normal(size=3), f)])


def record(sensor: str, seed: int, kind: str = "free", load: np.ndarray = TOOL) -> Record:
    """Return measured wrench and motion."""
    t, clean, up = motion(seed)
    F = OFFSETS + non_contact_wrench(*clean, load)
    if kind in ("grasp", "release"):
        share = np.clip((t - EVENT) / 0.05, 0.0, 1.0)[:, None]
        F += share * (1.0 if kind == "grasp" else -1.0) * non_contact_wrench(*clean, OBJECT)
    elif kind in CONTACTS:
        F -= touch(kind, seed, t, up)
    if sensor == "ideal":
        return F, *clean
    rng = np.random.default_rng([seed, 2])
    wrench_std, motion_std = SENSORS[sensor]
    F += np.repeat(wrench_std, 3) * rng.normal(size=F.shape)
    return F, *(x + n * rng.normal(size=x.shape) for x, n in zip(clean, motion_std, strict=True))


def known(sensor: str, load: np.ndarray = TOOL, seed: int = 10**6) -> Identification:
    """Return the load, identified from another record."""
    wrench_std, (s, omega, alpha) = SENSORS[sensor]
    noise = NoiseStd(np.repeat(wrench_std, 3), s, omega, alpha)
    rows = record(sensor, seed, load=load)
    return identify_batch(*rows, method="total", noise=noise).identification


class Monitor:
    """Memory and parameters of `drake_teleop.load.online.change` for one known load."""

    def __init__(
        self,
        known: Identification,
        wrench_std: np.ndarray,
        motion_std: np.ndarray,
        period: float = PERIOD,
        *,
        offset_drift: Any = OFFSET_DRIFT_STD,
        **options: float,
    ) -> None:
        self.known, self.period, self.samples = known, period, 0
        self.parameters = change_detector_parameters(wrench_std, motion_std, period, **options)
        theta = np.concatenate([known.offsets, known.phi])
        self.memory = initial_change_memory(theta, known.covariance, offset_drift)

    def watch(self, *rows: np.ndarray) -> np.ndarray:
        """Return the states (N,) for wrench, s, omega and alpha of N samples."""
        self.samples += len(rows[0])
        return detector_states_of_log(self.memory, self.parameters, *rows)

    @property
    def load(self) -> Identification:
        """Known load, or the new one once it is identified."""
        return identified_or_known_load(self.memory, self.known)

    @property
    def changed_at(self) -> float:
        """Start of the newest load [s after the first sample]."""
        return float(self.samples - new_load_age_in_samples(self.memory)) * self.period


def monitor(sensor: str, load: Identification) -> Monitor:
    """Return a monitor with the noise of this sensor."""
    return Monitor(load, *(np.repeat(std, 3) for std in SENSORS[sensor]))


def study(sensor: str, kind: str, seeds: int) -> dict[str, Any]:
    """Return the reached states, delays [s], and errors of the object [%, mm]."""
    total = TOOL + OBJECT if kind == "release" else TOOL
    load = known(sensor, total)
    highest, last, delays, errors, changed = [], [], [], [], []
    for seed in range(seeds):
        watch = monitor(sensor, load)
        states = watch.watch(*record(sensor, seed, kind, total))
        highest.append(int(states.max()))
        last.append(int(states[-1]))
        changed.append(float((states == STATE_NAMES.index("changed")).sum() * PERIOD))
        if kind in ("grasp", "release"):
            reached = [int(np.argmax(states >= k)) for k in (1, 2, 3)]
            delays.append([i * PERIOD - EVENT if i > 0 else np.inf for i in reached])
            if states[-1] == STATE_NAMES.index("identified"):
                pair = (watch.load, load) if kind == "grasp" else (load, watch.load)
                phi = load_of_object(*pair).phi
                mass = abs(phi[0] / OBJECT[0] - 1.0) * 100.0
                com = np.linalg.norm(phi[1:4] / phi[0] - OBJECT[1:4] / OBJECT[0]) * 1e3
                errors.append([mass, com])
    figures: dict[str, Any] = {
        "highest": dict(zip(STATE_NAMES, np.bincount(highest, minlength=4).tolist(), strict=True)),
        "last": dict(zip(STATE_NAMES, np.bincount(last, minlength=4).tolist(), strict=True)),
        "changed_s_max": max(changed),
    }
    for name, column in zip(STATE_NAMES[1:], np.transpose(delays) if delays else [], strict=False):
        figures[f"{name}_after_s"] = [float(np.median(column)), float(np.max(column))]
    parts = ("mass_percent", "com_mm")
    for name, column in zip(parts, np.transpose(errors) if errors else [], strict=False):
        figures[name] = [float(np.median(column)), float(np.max(column))]
    return figures


def times(repetitions: int = 7) -> dict[str, float]:
    """Return the least CPU microseconds per sample, interleaved."""
    load, best = known("JR3"), {}
    for _ in range(repetitions):
        for name in ("recursive least squares", "known", "disturbed"):
            rows = record("JR3", 0)
            if name == "disturbed":
                rows[0][:, 0] += 30.0
            learner = monitor("JR3", load)
            update_samples = learner.watch
            if name == "recursive least squares":
                update_samples = RecursiveLeastSquares(
                    np.repeat(SENSORS["JR3"][0], 3)
                ).update_samples
            start = time.thread_time()
            update_samples(*rows)
            took = (time.thread_time() - start) / len(rows[0]) * 1e6
            best[name] = min(took, best.get(name, took))
    return best


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=500)
    parser.add_argument("--json", type=Path, help="file for the figures")
    arguments = parser.parse_args()
    report: dict[str, Any] = {"seeds": arguments.seeds}
    for sensor in SENSORS:
        report[sensor] = {}
        for kind in ("free", "grasp", "release", *CONTACTS):
            report[sensor][kind] = figures = study(sensor, kind, arguments.seeds)
            print(f"\n{sensor}, {kind}")
            for name, value in figures.items():
                text = f"{value}"
                if isinstance(value, list):
                    text = f"median {value[0]:.3g}, largest {value[1]:.3g}"
                print(f"    {name}: {text}")
    report["microseconds_a_sample"] = times()
    print("\nmicroseconds a sample")
    for name, took in report["microseconds_a_sample"].items():
        print(f"    {name}: {took:.2f}")
    if arguments.json:
        arguments.json.write_text(json.dumps(report, indent=2) + "\n")


if __name__ == "__main__":
    main()
