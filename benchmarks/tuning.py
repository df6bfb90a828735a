"""Is a station as stable as `tune` states, and better than the advice of docs/choose.md?

`python benchmarks/tuning.py [--stations 20] [--draws 500] [--station-draws 8] [--json FILE]` draws
stations from arms, devices, networks and force scales (seeds from `--first-seed`, default 5;
`tune` was developed on 0 to 4). For each it tunes for light to firm grips at walls of 0.5 to
20 kN/m, then draws:

inside    share of random grips, walls and seeds in the stated set that do not rest quietly or do
          not render 0.9 to 1.1 of the contact force: `--draws` in one axis, `--station-draws` in
          the whole station, there with random factors of gamma up to the stated margin
outside   number of the first of at most `--outside-draws` runs that fails with gamma 20 % beyond
          the margin, with other seeds, all grips and both ends of the walls in turn
advice    the stiffest wall in the whole station with `ledger`, gamma 1, sigma 0, as choose.md says
          for unknown walls and operators: detection threshold and error of the rendered force
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from stations import _slave

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.lab.analysis.task_direction import OneAxisFromScenario
from drake_teleop.lab.identified_load import identified_load
from drake_teleop.lab.tuning.press_trial import (
    OneAxisGammaSearch,
    StationPressTrial,
    is_force_share_accepted,
    make_operating_range,
    settings_of_point,
    without_task_and_passivity_method,
)
from drake_teleop.lab.tuning.tune import meets_requirements, tune
from drake_teleop.station.master.data_sheets import Master
from drake_teleop.station.scenario import LoadScenario, Scenario, replace

ARMS, DEVICES = ("rx90", "rail"), ("phantom_premium_15", "omega_6", "omega_7", "haply_inverse3")
NETWORKS = ("lan", "wan", "internet")
HANDS, WALLS, TASK = ("light", "medium", "firm"), (0.5, 20.0), "press"


def drawn(rng: np.random.Generator) -> tuple[str, Scenario, str]:
    """Return name, scenario and network of a station."""
    arm, device, network = (str(rng.choice(names)) for names in (ARMS, DEVICES, NETWORKS))
    scale = float(np.exp(rng.uniform(np.log(0.03), np.log(0.2))))
    scenario = replace(
        LoadScenario("contact_transition"),
        slave=_slave(arm, None),
        master=Master(model=device),
        force_scaling__force_scale=scale,
        rates__sensor_hz=2000.0,
        rates__hand_hz=1000.0,
        rates__joint_control_hz=1000.0,
        simulation__seed=int(rng.integers(1, 2**16)),
    )
    return f"{arm}, {device}, {network}, force scale {scale:.3f}", scenario, network


def station(asked: argparse.Namespace, seed: int) -> dict[str, Any]:
    """Return the row of one station."""
    rng = np.random.default_rng([seed, 55])
    name, scenario, network = drawn(rng)
    row: dict[str, Any] = {"seed": seed, "station": name}
    began, cpu = time.monotonic(), time.process_time()
    stated = make_operating_range(HANDS, WALLS, TASK)
    with tempfile.TemporaryDirectory() as folder:
        try:
            found = tune(
                scenario, folder, hands=HANDS, walls=WALLS, network=network, task=TASK,
                jobs=asked.jobs, progress=False,
            )  # fmt: skip
        except DrakeTeleopError as error:
            return row | {"error": str(error)}
    row |= {"wall_s": time.monotonic() - began}
    if asked.jobs == 1:  # else other processes compute
        row |= {"cpu_s": time.process_time() - cpu}
    row |= {"sentences": found["sentences"], **found["figures"]}
    values = found["settings"]
    settings = settings_of_point(values)
    base = without_task_and_passivity_method(scenario, network)
    search = OneAxisGammaSearch(base, stated, {})
    axis = OneAxisFromScenario(base, (0.0, 0.0, 1.0))
    axis = dataclasses.replace(axis, sigma=settings.sigma_inertia, wall_damping=0.0)
    trial = StationPressTrial(base, base, stated, identified_load(base, False).estimate)
    outside_gamma = 1.2 * row["margin"] * settings.gamma

    def drawn_walls(low: float, high: float, number: int) -> list[dict[str, Any]]:
        walls = np.exp(rng.uniform(np.log(low), np.log(high), number)).tolist()
        return [{"hand": str(rng.choice(HANDS)), "wall": wall} for wall in walls]

    def fails(point: dict[str, Any], seed: int) -> bool:
        return not meets_requirements(trial(values | point, seed))

    def failing_share_in_axis(points: list[dict[str, Any]], gamma: float) -> float:
        tried = dataclasses.replace(settings, gamma=gamma)
        shares = [
            search.displayed_force_share(axis, tried, p["hand"], p["wall"], 100 + k)
            for k, p in enumerate(points)
        ]
        return float(np.mean([not is_force_share_accepted(share) for share in shares]))

    inside = drawn_walls(*stated.walls, asked.station_draws)
    for point in inside:
        point["gamma"] = settings.gamma * float(rng.uniform(1.0, row["margin"]))
    corners = [{"hand": hand, "wall": wall} for wall in stated.walls[::-1] for hand in HANDS]
    outside = [corner | {"gamma": outside_gamma} for corner in corners]
    row |= {
        "inside_fails_in_axis": failing_share_in_axis(
            drawn_walls(*stated.walls, asked.draws), settings.gamma
        ),
        "inside_fails": float(np.mean([fails(point, 100 + k) for k, point in enumerate(inside)])),
        "outside_fails_in_axis": failing_share_in_axis(corners, outside_gamma),
        "outside_fails_at_draw": next(
            (
                k + 1
                for k in range(asked.outside_draws)
                if fails(outside[k % len(outside)], 200 + k)
            ),
            None,
        ),
    }
    advice = {"method": "ledger", "gamma": 1.0, "sigma_inertia": 0.0}
    advice["low_pass_hz"] = base.wrist_sensor.bandwidth_hz
    advised = [
        trial(values | advice | {"hand": hand, "wall": stated.walls[1]}, 0)
        for hand in (HANDS[0], HANDS[-1])
    ]
    row |= {
        "advice_holds": all(map(meets_requirements, advised)),
        "advice_threshold_N": max(run["threshold_N"] for run in advised),
        "advice_force_error": max(abs(run["share"] - 1.0) for run in advised),
    }
    force_error = max(1.0 - row["share"], row["largest_share"] - 1.0)
    better = (
        row["threshold_N"] < row["advice_threshold_N"],
        force_error < row["advice_force_error"],
    )
    row["better_than_advice"] = not row["advice_holds"] or better[0]
    row["worse_than_advice"] = row["advice_holds"] and not any(better)
    return row


def counts(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the numbers of stations, and the rows."""
    tuned = [row for row in rows if "error" not in row]
    return {
        "stations": len(rows),
        "tuned": len(tuned),
        "all_inside_in_axis": sum(row["inside_fails_in_axis"] == 0.0 for row in tuned),
        "all_inside": sum(row["inside_fails"] == 0.0 for row in tuned),
        "outside_fails": sum(row["outside_fails_at_draw"] is not None for row in tuned),
        "outside_fails_in_axis": sum(row["outside_fails_in_axis"] > 0.0 for row in tuned),
        "better_than_advice": sum(row["better_than_advice"] for row in tuned),
        "worse_than_advice": sum(row["worse_than_advice"] for row in tuned),
        "longest_s": max((row["wall_s"] for row in tuned), default=None),
        "longest_cpu_s": max((row["cpu_s"] for row in tuned if "cpu_s" in row), default=None),
        "rows": rows,
    }


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--stations", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=5)
    parser.add_argument("--draws", type=int, default=500, help="draws in one axis (default: 500)")
    parser.add_argument(
        "--station-draws", type=int, default=8, help="draws in the whole station (default: 8)"
    )
    parser.add_argument(
        "--outside-draws", type=int, default=24, help="most draws outside (default: 24)"
    )
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--json", type=Path, help="file for the figures")
    asked = parser.parse_args(arguments)
    rows = []
    for seed in range(asked.first_seed, asked.first_seed + asked.stations):
        rows.append(station(asked, seed))
        print(json.dumps(rows[-1], indent=1), flush=True)
        if asked.json:
            asked.json.write_text(json.dumps(counts(rows), indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
