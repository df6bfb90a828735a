"""When does the station detect a contact, when is it displayed, and what are false alarms?

`python benchmarks/contact_in_station.py [--minutes 100] [--json FILE]`. The load, its offsets and
the noise floor are identified first, by the station's own sensor (JR3, with noise, random walk and
drift), with another seed. All times are in ms from the first touch:

- The paper's contact (`contact_transition`, five seeds): time of detection; for each size of the
  force, the share of false alarms in free motion that is necessary to detect the contact at all, or
  within 10 ms. `raw` is the measured force, tared at the start; `gravity_only` is without the
  identified static weight; `eliminated` is Eq. (13).
- The networks of `PRESETS`, without their losses: arrival of the flag at the hand, beyond the
  one-way delay. A playout buffer of the longest delay keeps the command smooth; without it, jitter
  accelerates the arm until accelerometer and motors saturate (`torn`, for comparison).
- Fast free motion (`--minutes`, 0 for none): the hand swings in all directions and rotates, as fast
  as the arm can follow, in runs of five minutes with a seed each, without taring in between.
  `false_share` is the share of time with a raised flag, `false_contacts` the number of its rises.

`--processes` runs of free motion run in parallel. One minute takes some 20 s of a core.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
import math
import multiprocessing
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.progress import show_progress
from drake_teleop.lab.identification import (
    identification_scenario,
    identify_load,
    sensor_samples,
    slave_arm,
)
from drake_teleop.lab.run import is_in_contact
from drake_teleop.load.compensation import contact_wrench
from drake_teleop.load.contact.noise_floor import NoiseFloor
from drake_teleop.station.channel.channel import Channel
from drake_teleop.station.channel.network import PRESETS
from drake_teleop.station.estimation.contact_detection import ContactDetectionConfig
from drake_teleop.station.operator.operator import OperatorConfig, Sine
from drake_teleop.station.result import SimulationResult
from drake_teleop.station.scenario import LoadScenario, Scenario, replace
from drake_teleop.station.simulation import simulate
from drake_teleop.station.slave.arm import accelerations_from_specific_forces
from drake_teleop.station.station import MakeTeleopStation

Array = NDArray[np.float64]
Known = tuple[Array, NoiseFloor]

SEEDS = range(5)
RUN_S, SEGMENT_S = 300.0, 10.0
# Longest delay of the gamma distribution over its mean, in jitters (station.channel.network).
TAIL = 6.0


def detecting(name: str, **changes: object) -> Scenario:
    return replace(LoadScenario(name), contact_detection=ContactDetectionConfig(), **changes)


def identified(scenario: Scenario, seed: int) -> Known:
    found = identify_load(identification_scenario(scenario, seed))
    return found.estimate, found.noise_floor(slave_arm(scenario))


def run(scenario: Scenario, known: Known) -> SimulationResult:
    estimate, floor = known
    station = MakeTeleopStation(scenario, load_estimate=estimate, noise_floor=floor)
    return simulate(station, scenario.simulation)


def onset(result: SimulationResult, name: str, start: float) -> float | None:
    """Return the time from `start` [s] until the flag is up [ms]; None if it never is."""
    up = result.t[(result[name][:, 0] > 0) & (result.t >= start)]
    return 1e3 * float(up[0] - start) if len(up) else None


def papers_contact(progress: Callable[..., None]) -> dict[str, Any]:
    delays, false, share, soon = [], 0, [], []
    for done, seed in enumerate(SEEDS):
        scenario = detecting("contact_transition", simulation__seed=seed)
        known = identified(scenario, seed + 100)
        result = run(scenario, known)
        touched = is_in_contact(result)
        start = float(result.t[touched.argmax()])
        delays.append(onset(result, "contact", start))
        false += int(result["contact"][result.t < start].sum())
        forces = sizes(result, known[0], scenario)
        # Residual effects of a contact in the sensor's filter count neither as contact nor as free
        # motion.
        free = ~touched & ((result.t < start) | (result.t > result.t[touched][-1] + 0.02))
        first = touched & (result.t < start + 0.01)
        share.append([float((x[free] >= x[touched].max()).mean()) for x in forces.values()])
        soon.append([float((x[free] >= x[first].max()).mean()) for x in forces.values()])
        progress((done + 1) / len(SEEDS))
    return {
        "noticed_ms": delays,
        "samples_that_cried_wolf": false,
        "share_that_must_cry_wolf": dict(zip(forces, np.min(share, axis=0).tolist(), strict=True)),
        "share_that_must_cry_wolf_within_10_ms": dict(
            zip(forces, np.min(soon, axis=0).tolist(), strict=True)
        ),
    }


def sizes(result: SimulationResult, estimate: Array, scenario: Scenario) -> dict[str, Array]:
    """Return |f| (N,) by the eliminated part."""
    wrench, s, omega, alpha = sensor_samples(result)
    offsets, phi, rest = estimate[:6], estimate[6:], np.zeros_like(s)
    gravity = s - accelerations_from_specific_forces(
        slave_arm(scenario), result["joint_position"], s
    )
    wrenches = {
        "raw": wrench - wrench[0],
        "gravity_only": contact_wrench(wrench, offsets, gravity, rest, rest, phi),
        "eliminated": contact_wrench(wrench, offsets, s, omega, alpha, phi),
    }
    return {name: np.linalg.norm(w[:, :3], axis=1) for name, w in wrenches.items()}


def arrivals(progress: Callable[..., None]) -> dict[str, Any]:
    """Return by network the one-way delay, and the times of detection and arrival [ms]."""
    plain = detecting("contact_transition", rates__log_hz=2000.0)
    known = identified(plain, 100)
    table: dict[str, Any] = {}
    for done, (name, network) in enumerate(PRESETS.items()):
        line = dataclasses.replace(network, loss=0.0, burst=0.0)
        longest = line.delay * (1.0 + TAIL * line.jitter)
        smooth = dataclasses.replace(line, playout=math.ceil(longest * 2000.0) / 2000.0)
        table[name] = arrival(plain, known, smooth, smooth.playout)
        if line.jitter > 0.0:
            table[f"{name}, torn"] = arrival(plain, known, line, longest)
        progress((done + 1) / len(PRESETS))
    return table


def arrival(plain: Scenario, known: Known, line: Any, delay: float) -> dict[str, Any]:
    channel = Channel(**dataclasses.asdict(line), timeout=0.2)
    result = run(replace(plain, channel=channel, simulation__duration=0.8 + 2.0 * delay), known)
    touched = is_in_contact(result)
    start = float(result.t[touched.argmax()])
    slave, hand = (onset(result, x, start) for x in ("contact", "contact_at_hand"))
    return {
        "one_way_delay_ms": 1e3 * delay,
        "noticed_ms": slave,
        "at_hand_ms": hand,
        "beyond_delay_ms": None if hand is None else hand - 1e3 * delay,
        "cried_wolf_before": float(result["contact"][result.t < start].mean()),
        "saturated": float(result["saturated"].mean()),
    }


def fast_motion(seed: int, seconds: float) -> Scenario:
    """Return a hand motion at varying speed: up and down, with less lateral motion and rotation."""
    rng = np.random.default_rng(seed)
    intent = []
    for start in np.arange(0.0, seconds + 1.0, SEGMENT_S):
        for axis, largest in ((2, 14.0), (0, 4.0), (1, 4.0)):
            frequency = rng.uniform(1.6, 3.0)
            amplitude = rng.uniform(0.5, 1.0) * largest / (2.0 * np.pi * frequency) ** 2
            moved, turned = np.zeros(3), np.zeros(3)
            moved[axis] = amplitude
            turned[axis] = rng.uniform(0.0, 0.1)
            phase = rng.uniform(0.0, 2.0 * np.pi)
            common = {"t_start": float(start), "duration": SEGMENT_S, "ramp": 1.0, "phase": phase}
            intent.append(Sine(**common, frequency=frequency, translation=moved.tolist()))
            intent.append(Sine(**common, frequency=rng.uniform(0.5, 1.5), rotation=turned.tolist()))
    return detecting(
        "free_motion_force",
        simulation__seed=seed,
        simulation__settle=1.0,
        simulation__duration=seconds,
        operator=OperatorConfig(grip="firm", intent=intent),
        # A flag stays up for at least 20 ms.
        rates__log_hz=100.0,
    )


def free_run(seconds: float, seed: int) -> dict[str, float]:
    """Return one run of fast free motion, and its speed."""
    scenario = fast_motion(seed, seconds)
    result = run(scenario, identified(scenario, seed + 1000))
    flags = result["contact"][:, 0]
    arm = slave_arm(scenario)
    _, s, _, alpha = sensor_samples(result)
    a = np.linalg.norm(accelerations_from_specific_forces(arm, result["joint_position"], s), axis=1)
    return {
        "seconds": seconds,
        "up_s": float(flags.mean() * seconds),
        "false_contacts": int((np.diff(flags) > 0).sum()),
        "acceleration_rms": float(np.sqrt((a**2).mean())),
        "acceleration_peak": float(a.max()),
        "alpha_peak": float(np.linalg.norm(alpha, axis=1).max()),
        "saturated": float(result["saturated"].mean()),
        "speed_use": float(np.abs(result["slave_state"][:, 6:] / arm.velocity_limit).max()),
    }


def free_motion(minutes: float, processes: int, progress: Callable[..., None]) -> dict[str, Any]:
    runs = max(processes, math.ceil(60.0 * minutes / RUN_S))
    job = functools.partial(free_run, 60.0 * minutes / runs)
    rows = []
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, mp_context=context) as pool:
        for future in as_completed([pool.submit(job, seed) for seed in range(runs)]):
            rows.append(future.result())
            progress(len(rows) / runs, f"{sum(r['false_contacts'] for r in rows)} false")
    total = sum(row["seconds"] for row in rows)
    return {
        "minutes": total / 60.0,
        "false_share": sum(row["up_s"] for row in rows) / total,
        "false_contacts": sum(row["false_contacts"] for row in rows),
        "acceleration_rms": float(np.mean([row["acceleration_rms"] for row in rows])),
        **{
            name: max(row[name] for row in rows)
            for name in ("acceleration_peak", "alpha_peak", "saturated", "speed_use")
        },
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--minutes", type=float, default=100.0, help="minutes of fast free motion (default: 100)"
    )
    parser.add_argument("--processes", type=int, default=2, help="processes for the free motion")
    parser.add_argument("--json", type=Path, help="file for the figures")
    given = parser.parse_args()
    with show_progress(True) as stage:
        figures: dict[str, Any] = {"papers_contact": papers_contact(stage("The paper's contact"))}
        figures["arrivals"] = arrivals(stage("Networks"))
        if given.minutes > 0.0:
            progress = stage("Free motion")
            figures["free_motion"] = free_motion(given.minutes, given.processes, progress)
    for part, values in figures.items():
        print(part)
        for name, value in values.items():
            print(f"  {name:40s} {value}")
    if given.json:
        given.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
