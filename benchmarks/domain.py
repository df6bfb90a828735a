"""For which stiffness, grip and round trip does each method hold a wall?

`python benchmarks/domain.py [--method M ...] [--json FILE]` runs the usual task of
`lab.comparison.one_dof` over a constant delay: a hand presses 20 mm into a wall, holds for 5 s and
lets go. Grips are light, medium and firm, walls 0.5 to 50 kN/m, round trips 1 ms to 2.6 s (there
the hold is 10 s longer); the methods have no information about the hand. A run is stable if it is
at rest within 0.5 mm, while holding and afterwards. It is good if it is also quiet (standard
deviation of the force below 5 %) and displays the contact force within 1 %. It is strong if it is
good and displays 95 % of the force without delay. It is prompt if the force is within 10 % of the
final one from two round trips and 0.5 s after the press.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import multiprocessing
import sys
from pathlib import Path

import numpy as np

from drake_teleop.lab.comparison.one_dof import (
    REFERENCE_ONE_DOF,
    Task,
    measures_of_run,
    operator_intent,
    run_one_dof,
)
from drake_teleop.station.channel.network import NetworkConfig
from drake_teleop.station.passivity.methods import METHODS, PassivityConfig

GRIPS = {"light": (0.1, 2.0, 50.0), "medium": (0.25, 8.0, 250.0), "firm": (0.5, 20.0, 700.0)}
WALLS = (500.0, 2500.0, 5100.0, 10e3, 20e3, 50e3)  # N/m
ROUND_TRIPS = (0.001, 0.01, 0.05, 0.1, 0.15, 0.3, 0.6, 1.0, 2.6)  # s
QUIET, EXACT, STRONG, DEPTH = 0.05, 0.01, 0.95, 0.02
SOON, NEAR = 0.5, 0.1  # s, 1
COUNTED = ("stable", "good", "strong", "prompt")


def hold(case: tuple[str, str, float, float]) -> dict[str, float]:
    """Return the figures of one hold: method, grip, stiffness of the wall, round trip."""
    method, grip, wall, round_trip = case
    longer = 10.0 if round_trip > 2.0 else 0.0
    task = Task(release_start=11.5 + longer, release_end=12.5 + longer, end=17.0 + longer)
    mass, damping, stiffness = GRIPS[grip]
    model = dataclasses.replace(
        REFERENCE_ONE_DOF,
        hand_mass=mass,
        hand_damping=damping,
        hand_stiffness=stiffness,
        wall_stiffness=wall,
    )
    run = run_one_dof(
        model, PassivityConfig(method=method), NetworkConfig(delay=round_trip / 2), timeout=1.0,
        intent=operator_intent(task),
    )  # fmt: skip
    found = measures_of_run(run, model, task)
    # The springs of hand, wall and servo are in series.
    felt = model.force_scale / (1.0 / wall + 1.0 / model.servo_stiffness)
    undelayed = DEPTH / (1.0 / stiffness + 1.0 / felt)
    quiet = found.chatter < QUIET * found.felt_force
    good = found.stable and quiet and abs(found.force_error) < EXACT
    share = found.felt_force / undelayed
    holds = (run.t >= task.press_end + 2 * round_trip + SOON) & (run.t < task.release_start)
    at_last = np.mean(run.hand_force[holds & (run.t >= task.release_start - task.rest_window)])
    return {
        "stable": found.stable,
        "good": good,
        "strong": good and share > STRONG,
        "felt": share,
        "prompt": bool(np.all(np.abs(run.hand_force[holds] / at_last - 1.0) < NEAR)),
    }


def reach(table: dict[tuple[str, float, float], dict[str, float]], grip: str, wall: float) -> str:
    """Return the longest round trips up to which all runs are stable, and are good [ms]."""
    reached = []
    for what in ("stable", "good"):
        held = [bool(table[grip, wall, round_trip][what]) for round_trip in ROUND_TRIPS] + [False]
        longest = held.index(False) - 1
        reached.append(f"{1e3 * ROUND_TRIPS[longest]:.0f}" if longest >= 0 else "-")
    return " / ".join(reached)


def main(arguments: list[str] | None = None) -> None:
    """Run all methods over all cases and print two tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--method", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument("--json", metavar="FILE", help="file for the figures")
    asked = parser.parse_args(arguments)
    places = list(itertools.product(GRIPS, WALLS, ROUND_TRIPS))
    cases = [(method, *place) for method in asked.method for place in places]
    with multiprocessing.get_context("fork").Pool(2) as pool:
        rows = pool.map(hold, cases, chunksize=9)
    found = {
        method: dict(zip(places, rows[n * len(places) :], strict=False))
        for n, method in enumerate(asked.method)
    }
    felt = "felt of undelayed, median of good ones"
    print(f"| method | stable of {len(places)} | good | strong | prompt | {felt} |")
    print("|---|---|---|---|---|---|")
    for method, table in found.items():
        counts = [sum(row[key] for row in table.values()) for key in COUNTED]
        shares = [row["felt"] for row in table.values() if row["good"]]
        share = f"{np.median(shares):.2f}" if shares else "-"
        print(f"| `{method}` | {' | '.join(map(str, counts))} | {share} |")
    print("\nLongest round trip [ms] up to which every one is stable / good:\n")
    print("| method, grip | " + " | ".join(f"{wall / 1e3:g} kN/m" for wall in WALLS) + " |")
    print("|---" * (len(WALLS) + 1) + "|")
    for method, table in found.items():
        for grip in GRIPS:
            cells = [reach(table, grip, wall) for wall in WALLS]
            print(f"| `{method}`, {grip} | " + " | ".join(cells) + " |")
    if asked.json:
        flat = {m: {f"{g} {w} {r}": row for (g, w, r), row in t.items()} for m, t in found.items()}
        Path(asked.json).write_text(json.dumps(flat, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
