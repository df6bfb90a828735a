"""Is the motion of `excite --until` the shortest, and does it reach the required accuracy?

`python benchmarks/shortest.py [--json FILE] [--restarts 20] [--records 50]` designs it for the
shipped station's arm and "mass 0.1 %, com 0.1 mm, inertia 1 %" from 20 seeds, and prints how much
longer each is than the shortest of them. Then the first motion is executed 50 times. The station's
sensor chain and motion estimation give its samples at 8 kHz, with noise, random walks and
quantisation, without calibration errors. Weighted least squares with the stated noise identifies
the
load; the figure is the share of records in which all ten numbers are within their tolerances. The
aim is 95 %. Baseline: the default period of `excite`, 6 s, and the share for a motion that is a
fifth faster.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from numba import njit

from drake_teleop.lab.excitation.limits import link_motion_series, sensor_motion_series
from drake_teleop.lab.excitation.robot import Robot, RobotFromScenario
from drake_teleop.lab.excitation.shortest import design_shortest_motion
from drake_teleop.load.normal_equations import identify
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.load.tolerance import (
    Tolerance,
    display_values_of_required_entries,
    parse_tolerance,
    tolerances_in_display_units,
)
from drake_teleop.load.trajectory import FourierTrajectory
from drake_teleop.station.scenario import LoadScenario, Scenario
from drake_teleop.station.sensor.motion_estimation import (
    estimate_sample_into,
    initialize_motion_estimator,
)
from drake_teleop.station.sensor.sensor_chain import (
    NOISE_BLOCK_SIZE,
    SAMPLES_PER_NOISE_BLOCK,
    initialize_sensor_chain,
    read_sensor_into,
    without_parts,
)

ASKED = "mass 0.1 %, com 0.1 mm, inertia 1 %"


@njit
def record(constants, memory, estimator, remembered, table, truth, noise, samples):
    """Return the samples of sensor chain and motion estimation over a whole record."""
    reading = np.empty(truth.shape[1] - 2)
    for k in range(len(truth)):
        read_sensor_into(constants, memory, noise[k // SAMPLES_PER_NOISE_BLOCK], truth[k], reading)
        estimate_sample_into(estimator, remembered, table, reading, samples[k])


def reached(
    scenario: Scenario,
    robot: Robot,
    trajectory: FourierTrajectory,
    tolerance: Tolerance,
    records: int,
) -> float:
    """Return the share of the records with all required numbers within their tolerances."""
    sensor, table, phi = scenario.wrist_sensor, robot.arm.table, robot.limits.heaviest_phi
    period = 1.0 / scenario.rates.sensor_hz
    joints = trajectory.evaluate(np.arange(0.0, trajectory.period, period))
    vectors = sensor_motion_series(link_motion_series(table, *joints))
    truth = np.hstack([non_contact_wrench(*vectors, phi), *vectors, joints[0]])
    noisy = without_parts(sensor, "calibration")
    constants, memory = initialize_sensor_chain(noisy, joints[0].shape[1], period)
    estimator, remembered = initialize_motion_estimator(
        scenario.motion_estimation, noisy, joints[0].shape[1], period
    )
    samples, within = np.empty((len(truth), 22)), 0
    rng = np.random.default_rng(0)
    true, sizes = (
        display_values_of_required_entries(tolerance, phi),
        tolerances_in_display_units(tolerance, phi),
    )
    for _ in range(records):
        noise = rng.standard_normal((len(truth) // SAMPLES_PER_NOISE_BLOCK + 1, NOISE_BLOCK_SIZE))
        record(constants, memory.copy(), estimator, remembered.copy(), table, truth, noise, samples)
        parts = (samples[:, part] for part in np.split(np.r_[:15], [6, 9, 12]))
        load = identify(*parts, noise=sensor.wrench_std())
        within += int(
            (np.abs(display_values_of_required_entries(tolerance, load.phi) - true) <= sizes).all()
        )
    return within / records


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--json", type=Path, help="file for the figures")
    parser.add_argument("--restarts", type=int, default=20)
    parser.add_argument("--records", type=int, default=50)
    options = parser.parse_args()
    scenario, tolerance = LoadScenario("identification"), parse_tolerance(ASKED)
    robot, found = RobotFromScenario(scenario), []
    for seed in range(options.restarts):
        found.append(design_shortest_motion(robot, tolerance, seed=seed).excitation)
        print(f"seed {seed}: {found[-1].trajectory.period:.4f} s", flush=True)
    periods = np.array([each.trajectory.period for each in found])
    first = found[0].trajectory
    hasty = FourierTrajectory(first.q0, first.rho, first.delta, 1.2 * first.frequency)
    figures = {
        "shortest_s": periods.min(),
        "median_over_shortest": np.median(periods) / periods.min(),
        "longest_over_shortest": periods.max() / periods.min(),
        "within_10_percent": np.mean(periods <= 1.1 * periods.min()),
        "reached": reached(scenario, robot, first, tolerance, options.records),
        "baseline_period_s": 6.0,
        "baseline_reached_a_fifth_faster": reached(
            scenario, robot, hasty, tolerance, options.records
        ),
    }
    for name, value in figures.items():
        print(f"{name:40} {value:.4g}")
    if options.json is not None:
        options.json.write_text(json.dumps({k: float(v) for k, v in figures.items()}, indent=2))


if __name__ == "__main__":
    main()
