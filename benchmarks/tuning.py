"""Is a station as stable as `tune` states, and better than the advice of docs/choose.md?

`python benchmarks/tuning.py [--stations 20] [--draws 500] [--station-draws 10] [--json FILE]` draws
stations from arms, devices, networks and tool masses (seeded; none was used to develop `tune`). It
tunes each for light to firm grips at walls of 0.5 to 20 kN/m, and draws grips, walls and seeds:

inside    share of draws in the stated set that rest, rest quietly and render 0.9 of the contact
          force; in one axis, and for `--station-draws` of them in the whole station
outside   share of the draws in one axis that fail where gamma times stiffness is up to 20 % beyond
          margin and stiffest wall
advice    the same corners in the whole station with `ledger`, gamma 1, sigma 0, as choose.md
advises
          for unknown walls and operators: detection threshold and rendered share
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
from drake_teleop.lab.tuning.press_trial import GammaSearch, StationTrial, TunedSettings
from drake_teleop.lab.tuning.search import meets_requirements
from drake_teleop.lab.tuning.stated_set import make_stated_set, without_task_and_method
from drake_teleop.lab.tuning.tune import tune
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


def station(seed: int, draws: int, station_draws: int, jobs: int) -> dict[str, Any]:
    """Return the row of one station."""
    rng = np.random.default_rng([seed, 55])
    name, scenario, network = drawn(rng)
    row: dict[str, Any] = {"station": name}
    began, cpu = time.monotonic(), time.process_time()
    stated = make_stated_set(HANDS, WALLS, TASK)
    with tempfile.TemporaryDirectory() as folder:
        try:
            found = tune(
                scenario, folder, hands=HANDS, walls=WALLS, network=network, task=TASK, jobs=jobs,
                progress=False,
            )  # fmt: skip
        except DrakeTeleopError as error:
            return row | {"error": str(error)}
    row |= {"wall_s": time.monotonic() - began, "cpu_s": time.process_time() - cpu}
    row |= {"sentences": found["sentences"], **found["figures"]}
    names = [entry.name for entry in dataclasses.fields(TunedSettings)]
    settings = TunedSettings(**{name: found["settings"][name] for name in names})
    base = without_task_and_method(scenario, network)
    search = GammaSearch(base, stated, {})
    axis = OneAxisFromScenario(base, (0.0, 0.0, 1.0))
    axis = dataclasses.replace(axis, sigma=settings.sigma_inertia, wall_damping=0.0)

    def rests(grip: str, wall: float, gamma: float, number: int) -> bool:
        return search.share_in_one_axis(axis, settings, gamma, grip, wall, number) >= 0.9

    low, high = np.log(stated.walls)
    inside, outside = [], []
    for k in range(draws):
        grip, wall = str(rng.choice(HANDS)), float(np.exp(rng.uniform(low, high)))
        inside.append(rests(grip, wall, settings.gamma, k))
        beyond = stated.requirements.loop_gain_margin * float(rng.uniform(1.0, 1.2))
        outside.append(not rests(grip, stated.walls[1], settings.gamma * beyond, k))
    row |= {"inside": float(np.mean(inside)), "outside_fails": float(np.mean(outside))}
    trial = StationTrial(base, base, stated, identified_load(base, False).estimate)
    values = dataclasses.asdict(settings)
    runs = [
        trial(values | {"hand": str(rng.choice(HANDS)),
                        "wall": float(np.exp(rng.uniform(low, high)))}, 100 + k)
        for k in range(station_draws)
    ]  # fmt: skip
    row["station_inside"] = (
        float(np.mean([meets_requirements(run) for run in runs])) if runs else None
    )
    advice = values | {"method": "ledger", "gamma": 1.0, "sigma_inertia": 0.0}
    advice["low_pass_hz"] = base.wrist_sensor.bandwidth_hz
    advised = [trial(advice | {"hand": hand, "wall": wall}, 0) for hand, wall in stated.corners[:2]]
    row |= {
        "advice_holds": all(map(meets_requirements, advised)),
        "advice_threshold_N": max(run["threshold_N"] for run in advised),
        "advice_share": min(run["share"] for run in advised),
    }
    row["better_than_advice"] = bool(
        not row["advice_holds"] or row["threshold_N"] < row["advice_threshold_N"]
    )
    return row


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--stations", type=int, default=20)
    parser.add_argument("--draws", type=int, default=500, help="draws in one axis (default: 500)")
    parser.add_argument(
        "--station-draws", type=int, default=10, help="draws in the whole station (default: 10)"
    )
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--json", type=Path, help="file for the figures")
    asked = parser.parse_args(arguments)
    rows = []
    for seed in range(asked.stations):
        rows.append(station(seed, asked.draws, asked.station_draws, asked.jobs))
        print(json.dumps(rows[-1], indent=1), flush=True)
        if asked.json:
            tuned = [row for row in rows if "error" not in row]
            counts = {
                "stations": len(rows),
                "tuned": len(tuned),
                "all_inside": sum(row["inside"] == 1.0 for row in tuned),
                "all_station_inside": sum(row["station_inside"] == 1.0 for row in tuned),
                "outside_fails": sum(row["outside_fails"] > 0.0 for row in tuned),
                "better_than_advice": sum(row["better_than_advice"] for row in tuned),
                "longest_s": max((row["wall_s"] for row in tuned), default=None),
                "rows": rows,
            }
            asked.json.write_text(json.dumps(counts, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
