"""How well is a load identified with a realistic JR3, and what remains of the 100 N?

The slave runs the shipped identification; then it swings as in Fig. 6. Both are simulated once at
8 kHz with an ideal sensor. The true values pass through the kernels of sensor and motion estimation
with the noise of 20 seeds. The load is identified from the samples at 1 kHz, by total least squares
and, as the baseline, by least squares. For each load the contact wrench of Eq. (13) is calculated;
without contact it is the residual. `--whole` seeds (3) are simulated completely.

Then each source of error acts alone on an otherwise ideal sensor, with the true load: median of the
rms and largest peak of 20 seeds of the noise or of the sensor's calibration.

    python benchmarks/realistic_sensor.py [--seeds 20] [--whole 3] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numba import njit
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from drake_teleop.lab.identification import (
    identify_by_batch,
    identify_load,
    sensor_samples,
    slave_arm,
)
from drake_teleop.load.batch.uncertainty import confidence_intervals
from drake_teleop.load.compensation import contact_wrench
from drake_teleop.load.identification import Identification
from drake_teleop.load.inertia import mass_com_inertia
from drake_teleop.load.normal_equations import identify
from drake_teleop.load.trajectory import FourierTrajectory
from drake_teleop.station import scenario as scenarios
from drake_teleop.station.result import SimulationResult
from drake_teleop.station.scenario import LoadScenario, Scenario
from drake_teleop.station.sensor.motion_estimation import (
    estimate_sample_into,
    initialize_motion_estimator,
)
from drake_teleop.station.sensor.sensor_chain import (
    DISABLED_PART_VALUES,
    NOISE_BLOCK_SIZE,
    SAMPLES_PER_NOISE_BLOCK,
    WristSensorConfig,
    initialize_sensor_chain,
    read_sensor_into,
    without_parts,
)
from drake_teleop.station.simulation import simulate
from drake_teleop.station.station import MakeTeleopStation

Array = NDArray[np.float64]

RATE, EVERY = 8000.0, 8
IDENTIFICATION, SWING = LoadScenario("identification"), LoadScenario("free_motion_force")
JR3 = IDENTIFICATION.wrist_sensor
ARM = slave_arm(IDENTIFICATION)
ERRORS = ("mass %", "com mm", "inertia %", "offset N", "offset N m")
BARS = (0.1, 0.3, 5.0, 0.1, 0.005)
LATE = 1e-3


def true_motions() -> tuple[Array, Array, FourierTrajectory]:
    """Return the true values at 8 kHz (N, 15 + n), see `initialize_sensor_chain`: both motions."""
    ideal = {"wrist_sensor__ideal": True, "rates__log_hz": RATE}
    found = identify_load(scenarios.replace(IDENTIFICATION, **ideal))
    swing = scenarios.replace(SWING, **ideal)
    load = np.concatenate([np.zeros(6), ARM.phi_load])
    swung = simulate(MakeTeleopStation(swing, load_estimate=load), swing.simulation)
    return truth(found.result), truth(swung), found.trajectory


def truth(result: SimulationResult) -> Array:
    return np.hstack([*sensor_samples(result), result["joint_position"]])


@njit
def _run(chain, chain_memory, estimator, estimator_memory, arm, noise, truth, samples):  # type: ignore[no-untyped-def]
    reading = np.empty(truth.shape[1] - 2)
    for k in range(truth.shape[0]):
        read_sensor_into(
            chain, chain_memory, noise[k // SAMPLES_PER_NOISE_BLOCK], truth[k], reading
        )
        estimate_sample_into(estimator, estimator_memory, arm, reading, samples[k])


def sampled(
    sensor: WristSensorConfig, truth: Array, seed: int, assumed: WristSensorConfig | None = None
) -> tuple[Array, Array, Array, Array]:
    """Return wrench, s, omega, alpha at 8 kHz.

    Args:
        sensor: the true sensor.
        truth: (N, 15 + n).
        seed: of the noise.
        assumed: sensor that the motion estimation assumes (default: the true one).
    """
    n = truth.shape[1] - 15
    chain, memory = initialize_sensor_chain(sensor, n, 1 / RATE)
    motion = initialize_motion_estimator(
        IDENTIFICATION.motion_estimation, assumed or sensor, n, 1 / RATE
    )
    blocks = len(truth) // SAMPLES_PER_NOISE_BLOCK + 1
    noise = np.random.default_rng(seed).standard_normal((blocks, NOISE_BLOCK_SIZE))
    samples = np.empty((len(truth), 16 + n))
    _run(chain, memory, *motion, ARM.table, noise, truth, samples)
    wrench, s, omega, alpha, _ = np.split(samples, [6, 9, 12, 15], axis=1)
    return wrench, s, omega, alpha


def errors_of(load: Identification) -> Array:
    """Return `ERRORS` (5,): that of the worst principal inertia, and norms of the others."""
    (mass, com, inertia), (true_mass, true_com, true_inertia) = (
        mass_com_inertia(phi) for phi in (load.phi, ARM.phi_load)
    )
    principal, true = np.linalg.eigvalsh(inertia), np.linalg.eigvalsh(true_inertia)
    return np.array(
        [
            100 * abs(mass / true_mass - 1),
            1e3 * np.linalg.norm(com - true_com),
            100 * np.abs(principal / true - 1).max(),
            np.linalg.norm((load.offsets - JR3.offset)[:3]),
            np.linalg.norm((load.offsets - JR3.offset)[3:]),
        ]
    )


def held(load: Identification) -> NDArray[np.bool_]:
    """Return whether the 95 % intervals (16,) contain the truth, the offsets at the start."""
    low, high = confidence_intervals(load)
    true = np.concatenate([JR3.offset, ARM.phi_load])
    return np.asarray((low <= true) & (true <= high))


def least_squares(scenario: Scenario, *samples: Array) -> Identification:
    return identify(*samples, noise=scenario.wrist_sensor.wrench_std())


def total_least_squares(scenario: Scenario, *samples: Array) -> Identification:
    return identify_by_batch(scenario, *samples, rate_hz=RATE / EVERY)


ESTIMATORS: dict[str, Callable[..., Identification]] = {
    "total": total_least_squares,
    "least squares": least_squares,
}


def identified(
    name: str, motion: Array, seed: int, sensor: WristSensorConfig = JR3
) -> Identification:
    """Return the load of one seed."""
    samples = sampled(sensor, motion, seed)
    scenario = scenarios.replace(IDENTIFICATION, wrist_sensor=sensor)
    return ESTIMATORS[name](scenario, *(signal[::EVERY] for signal in samples))


def residual(
    sensor: WristSensorConfig,
    swing: Array,
    seed: int,
    offsets: Array,
    phi: Array = ARM.phi_load,
    assumed: WristSensorConfig | None = None,
) -> tuple[float, float, float]:
    """Return the residual: rms and peak of the force [N], rms of the torque [N m]."""
    wrench, s, omega, alpha = sampled(sensor, swing, seed, assumed)
    left = contact_wrench(wrench, offsets, s, omega, alpha, phi)
    force, torque = (np.linalg.norm(part, axis=1) for part in (left[:, :3], left[:, 3:]))
    return float(np.sqrt(np.mean(force**2))), float(force.max()), float(np.sqrt(np.mean(torque**2)))


def study(motion: Array, swing: Array, seeds: int) -> dict[str, dict[str, float]]:
    """Return by estimator medians of the errors, share of the intervals that hold, the residual."""
    rows = {}
    for name in ESTIMATORS:
        found = [identified(name, motion, seed) for seed in range(seeds)]
        errors = np.median([errors_of(load) for load in found], axis=0)
        # Noise of other seeds: the swing comes after the identification.
        left = np.array(
            [
                residual(JR3, swing, seeds + seed, load.offsets, load.phi)
                for seed, load in enumerate(found)
            ]
        )
        rows[name] = {
            **dict(zip(ERRORS, errors.tolist(), strict=True)),
            "in 95 %": 100 * float(np.mean([held(load) for load in found])),
            "residual rms N": float(np.median(left[:, 0])),
            "peak N": float(left[:, 1].max()),
        }
    return rows


def whole(trajectory: FourierTrajectory, seeds: int) -> dict[str, dict[str, float]]:
    """Return the same by complete simulations, with the estimate in the loop."""
    rows = {}
    for seed in range(seeds):
        scenario = scenarios.replace(IDENTIFICATION, simulation__seed=seed)
        found = identify_load(scenario, trajectory=trajectory)
        swing = scenarios.replace(SWING, simulation__seed=seeds + seed, rates__log_hz=RATE)
        station = MakeTeleopStation(swing, load_estimate=found.estimate)
        force = simulate(station, swing.simulation)["contact_wrench_S"][:, :3]
        norm = np.linalg.norm(force, axis=1)
        load = found.identification
        rows[f"seed {seed}"] = {
            **dict(zip(ERRORS, errors_of(load).tolist(), strict=True)),
            "in 95 %": 100 * float(held(load).mean()),
            "residual rms N": float(np.sqrt(np.mean(norm**2))),
            "peak N": float(norm.max()),
        }
    return rows


def same_samples(trajectory: FourierTrajectory, motion: Array) -> float:
    """Return the largest difference of a simulation's samples from the kernels', over the rms.

    There is no noise, because the two draw it from different sources.
    """
    sensor = without_parts(JR3, "noise", "random_walk")
    scenario = scenarios.replace(IDENTIFICATION, wrist_sensor=sensor, rates__log_hz=RATE)
    result = identify_load(scenario, trajectory=trajectory).result
    samples = sampled(sensor, motion, 0)
    return max(
        float(np.abs(a - b).max() / np.sqrt(np.mean(b**2)))
        for a, b in zip(sensor_samples(result), samples, strict=True)
    )


def sources(motion: Array, swing: Array, seeds: int) -> dict[str, dict[str, float]]:
    """Return figures of each source of error alone; `all` is their sum, with two loads."""
    nothing = without_parts(
        JR3, *(k for k in DISABLED_PART_VALUES if k not in ("place", "saturation"))
    )
    wrench, motion_noise = (
        ("force_noise", "torque_noise"),
        (
            "acceleration_noise",
            "angular_acceleration_noise",
        ),
    )
    wrong = {
        "gain_error": 0.01,
        "cross_talk": 0.01,
        "misalignment": 0.01,
        "acceleration_gain_error": 0.01,
        "acceleration_misalignment": 0.01,
    }
    alone: dict[str, dict[str, object]] = {
        "noise of the wrench": {name: getattr(JR3, name) for name in wrench},
        "noise of the accelerations": {name: getattr(JR3, name) for name in motion_noise},
        "walks and drift": {
            k: getattr(JR3, k)
            for k in (*DISABLED_PART_VALUES["random_walk"], *DISABLED_PART_VALUES["drift"])
        },
        "quantisation, encoders too": {
            k: getattr(JR3, k) for k in DISABLED_PART_VALUES["quantisation"]
        },
        "bandwidth": {"low_pass": JR3.low_pass},
        "cross-talk 1 %": {"cross_talk": 0.01},
        "gains 1 %": {"gain_error": 0.01},
        "axes 0.01 rad": {"misalignment": 0.01},
        "accelerometer 1 %, 0.01 rad": {
            name: wrong[name] for name in ("acceleration_gain_error", "acceleration_misalignment")
        },
    }
    # The low-pass belongs to the noise: it reduces the displayed noise.
    filtered = ("noise of the wrench", "noise of the accelerations", "quantisation, encoders too")
    rows = {}
    for name, fields in alone.items():
        low_pass = {"low_pass": JR3.low_pass} if name in filtered else {}
        sensor = replace(nothing, **low_pass, **fields)
        rows[name] = over_seeds(
            lambda seed, s=sensor: residual(replace(s, unit=seed), swing, seed, np.zeros(6)), seeds
        )
    for name, late in ((f"accelerations {1e3 * LATE:g} ms late", LATE), ("6 ms late", 6e-3)):
        sensor = replace(nothing, acceleration_latency=late)
        rows[name] = over_seeds(
            lambda seed, s=sensor: residual(s, swing, seed, np.zeros(6), assumed=nothing), 1
        )

    def found(sensor: WristSensorConfig, seed: int) -> Identification:
        return identified("total", motion, seed, replace(sensor, unit=seed))

    def with_found(sensor: WristSensorConfig) -> Callable[[int], tuple[float, float, float]]:
        def left(seed: int) -> tuple[float, float, float]:
            load, real = found(sensor, seed), replace(sensor, unit=seed)
            return residual(real, swing, seeds + seed, load.offsets, load.phi)

        return left

    def phi_alone(seed: int) -> tuple[float, float, float]:
        return residual(nothing, swing, seed, np.zeros(6), found(JR3, seed).phi)

    def offsets_alone(seed: int) -> tuple[float, float, float]:
        return residual(nothing, swing, seed, found(JR3, seed).offsets - np.array(JR3.offset))

    rows["phi as identified"] = over_seeds(phi_alone, seeds)
    rows["offsets as identified"] = over_seeds(offsets_alone, seeds)
    rows["JR3, true load"] = over_seeds(
        lambda seed: residual(JR3, swing, seed, np.array(JR3.offset)), seeds
    )
    rows["JR3, identified load"] = over_seeds(with_found(JR3), seeds)
    all_wrong = replace(JR3, **wrong)
    rows["JR3 with all calibration errors, true load"] = over_seeds(
        lambda seed: residual(replace(all_wrong, unit=seed), swing, seed, np.array(JR3.offset)),
        seeds,
    )
    rows["the same, load identified with it"] = over_seeds(with_found(all_wrong), seeds)
    return rows


def over_seeds(left: Callable[[int], tuple[float, float, float]], seeds: int) -> dict[str, float]:
    force, peak, torque = np.array([left(seed) for seed in range(seeds)]).T
    return {
        "rms N": float(np.median(force)),
        "peak N": float(peak.max()),
        "torque rms N m": float(np.median(torque)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--whole", type=int, default=3, help="seeds that are simulated completely")
    parser.add_argument("--json", type=Path, help="file for the figures")
    arguments = parser.parse_args()
    motion, swing, trajectory = true_motions()
    peak = float(np.linalg.norm(swing[:, :3], axis=1).max())
    figures = {
        "identification": study(motion, swing, arguments.seeds)
        | {"bar": dict(zip(ERRORS, BARS, strict=True))},
        "whole simulations": whole(trajectory, arguments.whole),
        f"what is left of {peak:.0f} N": sources(motion, swing, arguments.seeds),
    }
    console = Console(width=140)
    for title, rows in figures.items():
        columns = next(iter(rows.values()))
        table = Table("", *columns, title=title)
        for name, row in rows.items():
            table.add_row(name, *(f"{row[key]:.4g}" if key in row else "" for key in columns))
        console.print(table)
    same = same_samples(trajectory, motion)
    print(f"whole simulation against kernels, without noise: {same:.1e} of the rms")
    if arguments.json:
        arguments.json.write_text(json.dumps(figures | {"same": same}, indent=2) + "\n")


if __name__ == "__main__":
    main()
