"""How much energy does each method deliver to an adversary, and how fast does the hand move?

`python benchmarks/adversary.py [--runs N] [--seed S] [--method M ...] [--json FILE]` runs
`lab.comparison.one_dof` for 12 s, N (10 000) times in all, equally often with each method. Random
are:

* the network: single losses and bursts, jitter with and without reordering, outages, a delay that
  steps or oscillates;
* the hand: light to firm, a change of grip, letting go;
* the wall: 0.5 to 50 kN/m; it is fixed, vanishes, jumps or oscillates;
* the motion: slow presses, taps of 0.7 to 3 Hz, circles along one axis; at the end a hold.

Two thirds of the runs are drawn. The others start from the worst of these, change them, and keep a
change that makes the run worse: less energy at the slave's actual motion, a higher speed of a
released device, or a longer limit cycle.

Energy counts from the start energy that the method declares, at the four places of `one_dof`. The
least energy at the very start counts too; the search begins 1.5 s later. Speed and travel (in 2 s)
are of runs in which the hand lets go in front of a fixed wall. The length of a limit cycle is the
time during which hand or slave reverse by more than 0.5 mm although nothing else moves.

The same seed gives the same figures. Case 17 is the case drawn 17th; case 17.4.29 is case 17 after
its 4th and 29th change. `--replay 17.4.29 --method M` prints all about one run. `--known` runs a
few simple cases instead. With `--imperfect`, servo and mass differ from those that the method
assumes, the motor is slow, and encoders and sensor have errors. With `--drag`, `ledger` starts
with E_0 = 0, so that drag on the hand has to fill its reserves.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import multiprocessing
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from adversary_cases import FREE, STEPS, TIME, case_of, let_go_at, prepared, silences, smooth
from numpy.typing import NDArray

from drake_teleop.lab.comparison.one_dof import (
    AT_COMMAND,
    AT_HAND,
    AT_MOTOR,
    AT_SLAVE,
    PERIOD_S,
    REFERENCE_ONE_DOF,
    OneDof,
    OneDofRun,
    operator_intent,
    run_one_dof,
)
from drake_teleop.station.channel.network import NetworkConfig
from drake_teleop.station.passivity.ledger import LedgerConfig
from drake_teleop.station.passivity.methods import METHODS, PassivityConfig

CHARGED = 1.5  # s; later, the least energy is no longer that of the start
LEAKS = -1e-6  # J, smaller energies are rounding
#: Methods that promise to create no energy at the actual motion, by whether the servo is imperfect.
PROMISED: dict[bool, set[str]] = {False: {"pspm", "ledger"}, True: {"ledger"}}
CYCLES = 1.0  # s, longer cycles count in the share of runs
SWING = 0.5e-3  # m, least reversal


@dataclass(frozen=True)
class Options:
    """Options of all runs.

    Args:
        seed: of the random cases.
        imperfect: whether the station is imperfect.
        drag: whether `ledger` starts without energy.
    """

    seed: int = 0
    imperfect: bool = False
    drag: bool = False

    def told(self, method: str) -> PassivityConfig:
        """Return the parameters of a method."""
        if method == "ledger" and self.drag:
            return PassivityConfig(method=method, ledger=LedgerConfig(initial=[0.0, 0.0]))
        return PassivityConfig(method=method)


@dataclass
class Figures:
    """Figures of a run, or the worst of several runs: least energies [J], then maxima."""

    actual: float = math.inf
    motor: float = math.inf
    command: float = math.inf
    hand: float = math.inf
    actual_later: float = math.inf  #: at the actual motion, once it is charged
    speed: float = 0.0  #: largest speed after letting go [m/s]
    travel: float = 0.0  #: travel in 2 s after letting go [m]
    cycle: float = 0.0  #: longest limit cycle [s]

    def worse(self, other: Figures) -> Figures:
        """Return the worse value of both for each figure."""
        a, b = dataclasses.astuple(self), dataclasses.astuple(other)
        worst = [(min if i < 5 else max)(pair) for i, pair in enumerate(zip(a, b, strict=True))]
        return Figures(*worst)


AIMS: dict[str, Callable[[Figures], float]] = {
    "actual": lambda found: -found.actual_later,
    "speed": lambda found: found.speed,
    "cycle": lambda found: found.cycle,
}
"""Quantities that the search maximises."""


def measured(run: OneDofRun, case: dict[str, Any]) -> Figures:
    """Return the figures of a run."""
    charged = round(CHARGED / PERIOD_S)
    later = (run.input_energies[:, AT_HAND] + run.input_energies[:, AT_SLAVE])[charged:]
    found = Figures(
        actual=run.least_energy_sum(AT_SLAVE),
        motor=run.least_energy_sum(AT_MOTOR),
        command=run.least_energy_sum(AT_COMMAND),
        hand=run.least_energy_sum(AT_HAND),
        actual_later=run.start_energy + float(np.nanmin(later, initial=math.inf)),
    )
    if case["wall"] != "stands":
        return found
    over = round(let_go_at(case) / PERIOD_S)
    if case["end"] == "lets go":
        free = run.master_position[over - 1 : over + 2000]
        found.speed = float(np.nanmax(np.abs(np.diff(free)), initial=0.0)) / PERIOD_S
        found.travel = float(np.nanmax(np.abs(free - free[0]), initial=0.0))
    begin = round((case["until"] + 0.8) / PERIOD_S)
    still = slice(begin, None if case["end"] == "holds on" else over, 10)
    found.cycle = (
        max(_cycling(x[still].tolist()) for x in (run.master_position, run.slave_position))
        * 10
        * PERIOD_S
    )
    return found


def _cycling(x: list[float]) -> int:
    """Return the samples until the last reversal by more than `SWING`; 0 below two cycles."""
    last, way, extreme, turns = 0, 0, x[0], 0
    for k, value in enumerate(x):
        if way == 0:
            way = int(math.copysign(1, value - x[0])) if abs(value - x[0]) > SWING else 0
            extreme = value
        elif (value - extreme) * way > 0.0:
            extreme = value
        elif (extreme - value) * way > SWING:
            way, extreme, last, turns = -way, value, k, turns + 1
    return last if turns >= 4 else 0


def run_case(method: str, path: tuple[int, ...], options: Options) -> Figures:
    """Return the figures of one case."""
    case = case_of(path, options.seed)
    run = run_one_dof(passivity=options.told(method), **prepared(case, options.imperfect))
    return measured(run, case)


def _drawn(job: tuple[tuple[str, ...], range, Options]) -> list[list[Figures]]:
    """Return the figures of all methods for each drawn case."""
    names, cases, options = job
    found = []
    for index in cases:
        case = case_of((index,), options.seed)
        arguments = prepared(case, options.imperfect)
        runs = (run_one_dof(passivity=options.told(name), **arguments) for name in names)
        found.append([measured(run, case) for run in runs])
    return found


Seen = dict[str, tuple[float, tuple[int, ...]]]
"""Aim -> the worst value, and its case."""


def _searched(job: tuple[str, str, int, int, Options]) -> tuple[str, Figures, Seen]:
    """Search from a drawn case towards an aim; return the method and the worst of all its runs."""
    method, aim, index, trials, options = job
    best: tuple[int, ...] = (index,)
    worst = run_case(method, best, options)
    seen = {name: (of(worst), best) for name, of in AIMS.items()}
    for trial in range(1, trials):
        path = (*best, trial)
        found = run_case(method, path, options)
        worst = worst.worse(found)
        if AIMS[aim](found) > seen[aim][0]:
            best = path
        seen = {name: max(seen[name], (of(found), path)) for name, of in AIMS.items()}
    return method, worst, seen


def study(
    names: tuple[str, ...], runs: int, options: Options, starts: int = 3, processes: int = 2
) -> dict[str, dict[str, Any]]:
    """Return by method its figures after drawing and after the search, and its worst cases."""
    each = max(runs // len(names), 4)
    trials = max(each // (3 * len(AIMS) * starts), 1)
    drawn = max(each - trials * len(AIMS) * starts, starts)
    blocks = [range(i, min(i + 10, drawn)) for i in range(0, drawn, 10)]
    run_case(names[0], (0,), options)  # compiles, before the processes fork
    with multiprocessing.get_context("fork").Pool(processes) as pool:
        jobs = [(names, block, options) for block in blocks]
        table = [row for part in pool.imap(_drawn, jobs) for row in part]
        climbs = []
        for n, name in enumerate(names):
            for aim, of in AIMS.items():
                order = sorted(range(drawn), key=lambda i: -of(table[i][n]))
                climbs += [(name, aim, i, trials, options) for i in order[:starts]]
        climbed = pool.map(_searched, climbs, chunksize=1)
    result = {}
    for n, name in enumerate(names):
        random = Figures()
        for row in table:
            random = random.worse(row[n])
        searched, worst = random, {}
        climbs_of = [one for one in climbed if one[0] == name]
        for _, found, _ in climbs_of:
            searched = searched.worse(found)
        for aim in AIMS:
            value, path = max(seen[aim] for _, _, seen in climbs_of)
            worst[aim] = {"case": ".".join(map(str, path)), "value": value}
        result[name] = {
            "runs": drawn + trials * len(AIMS) * starts,
            "leaking": sum(row[n].actual < LEAKS for row in table) / drawn,
            "cycling": sum(row[n].cycle > CYCLES for row in table) / drawn,
            "random": dataclasses.asdict(random),
            "searched": dataclasses.asdict(searched),
            "worst": worst,
        }
    return result


def print_study(result: dict[str, dict[str, Any]]) -> None:
    """Print the table and the names of the worst cases."""
    print("Least energy [J] between the hand and ...: drawn / searched. Let go: drawn / searched.")
    ports = ("actual", "motor", "command", "hand")
    heads = ("the actual motion", "the motor", "the command", "the hand alone")
    print(f"{'method':<14}{'leak':>6} " + "".join(f"{head:>20}" for head in heads), end="")
    print(f"{'speed m/s':>14}{'travel m':>14}{'cycle s':>12}{'> 1 s':>8}")
    for name, found in result.items():
        random, searched = found["random"], found["searched"]
        line = f"{name:<14}{100 * found['leaking']:5.0f} %"
        line += "".join(f"{random[port]:10.2g} /{searched[port]:8.2g}" for port in ports)
        for key, width in (("speed", 7), ("travel", 7), ("cycle", 6)):
            line += f"{random[key]:{width}.2f} /{searched[key]:5.2f}"
        print(f"{line}{100 * found['cycling']:6.0f} %")
    for name, found in result.items():
        worst = found["worst"].items()
        cases = ", ".join(f"{aim} {one['value']:.3g} in {one['case']}" for aim, one in worst)
        print(f"worst of {name}: {cases}")


def known(names: tuple[str, ...]) -> dict[str, dict[str, list[float]]]:
    """Return the figures of the simple cases by case and method; see `print_known`."""
    medium = dataclasses.replace(
        REFERENCE_ONE_DOF, hand_mass=0.25, hand_damping=8.0, hand_stiffness=250.0
    )
    begun = np.clip(TIME / 0.5, 0.0, 1.0)
    taps = begun * 0.05 * np.sin(4 * np.pi * TIME) + FREE * (1 - begun)
    swing = 0.03 * np.sin(3 * np.pi * TIME) * (begun - smooth(2.5, 0.5))
    press = FREE + swing + smooth(3.5, 1.0) * (0.0275 - FREE)
    tap, push = (np.stack([x, np.gradient(x, PERIOD_S)], axis=1) for x in (taps, press))
    hand = np.tile([0.2, 5.0, 300.0], (STEPS, 1))
    hand[9000:] = 0.0
    steady = NetworkConfig(delay=0.05)
    bursts = NetworkConfig(delay=0.05, jitter=0.2, distribution="gamma", loss=0.3, burst=0.08)
    usual = operator_intent()
    times = PERIOD_S * np.arange(len(usual), dtype=np.float64)

    def outages(seed: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        rng = np.random.default_rng(seed)
        there, back = (silences(rng, times, 0.4, 0.6) for _ in range(2))
        return np.where(there, -1, 50), np.where(back, -1, 50)

    found: dict[str, dict[str, list[float]]] = {}

    def least(passivity: PassivityConfig, model: OneDof, line: NetworkConfig, **more: Any) -> float:
        return run_one_dof(model, passivity, line, **more).least_energy_sum(AT_SLAVE)

    for name in names:
        one = PassivityConfig(method=name)
        let_go = run_one_dof(REFERENCE_ONE_DOF, one, steady, intent=push, grip=hand)
        free = let_go.master_position[8999:11000]
        rows = {
            "taps": [least(one, REFERENCE_ONE_DOF, steady, intent=tap)],
            "taps, bursts": [least(one, medium, bursts, seed=n, intent=tap) for n in range(10)],
            "press, outages": [
                least(one, medium, steady, delays=outages(n), timeout=0.1) for n in range(20)
            ],
            "let go": [
                abs(float(let_go.hand_force[8999])),
                float(np.abs(np.diff(free)).max()) / PERIOD_S,
                float(np.abs(free - free[0]).max()),
            ],
        }
        for key, values in rows.items():
            found.setdefault(key, {})[name] = values
    return found


def print_known(found: dict[str, dict[str, list[float]]]) -> None:
    """Print a line for each method."""
    print("Round trip 100 ms. Taps of 50 mm at 2 Hz, the same by a medium grip with 30 % lost in")
    print("bursts of 80 ms (10 seeds), its usual press with outages of 0.4 s (20 seeds): least")
    print("energy at the actual motion [J], and in how many runs it is negative. Let go at 4 N.")
    print(f"{'method':<14}{'taps':>10}{'bursts':>16}{'outages':>16}{'held':>10}{'let go':>24}")
    for name in found["taps"]:
        line = f"{name:<14}{found['taps'][name][0]:10.2g}"
        for key in ("taps, bursts", "press, outages"):
            values = found[key][name]
            line += f"{min(values):8.2g} ({sum(e < LEAKS for e in values):2d}/{len(values)})"
        force, speed, travel = found["let go"][name]
        print(f"{line}{force:8.1f} N{speed:10.2f} m/s{1e3 * travel:7.0f} mm")


def main(arguments: list[str] | None = None) -> int:
    """Run and print the study; return 1 if a method of `PROMISED` creates energy, else 0."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--runs", type=int, default=10_000, help="runs of all methods together (default: 10000)"
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the random cases (default: 0)")
    parser.add_argument("--method", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument(
        "--imperfect", action="store_true", help="make servo, motor and sensors imperfect"
    )
    parser.add_argument("--drag", action="store_true", help="let ledger start without energy")
    parser.add_argument("--known", action="store_true", help="run the simple cases instead")
    parser.add_argument(
        "--replay", metavar="CASE", help="run one case by its name, such as 17.4.29"
    )
    parser.add_argument("--json", metavar="FILE", help="file for the figures")
    asked = parser.parse_args(arguments)
    names, options = tuple(asked.method), Options(asked.seed, asked.imperfect, asked.drag)
    figures: dict[str, Any]
    broken: list[str] = []
    began = time.monotonic()
    if asked.replay:
        path = tuple(int(part) for part in asked.replay.split("."))
        figures = {name: dataclasses.asdict(run_case(name, path, options)) for name in names}
        for part in (case_of(path, options.seed), figures):
            print(json.dumps(part, indent=2))
    elif asked.known:
        figures = known(names)
        print_known(figures)
    else:
        figures = study(names, asked.runs, options)
        print_study(figures)
        promised = set(names) & PROMISED[asked.imperfect]
        broken = [name for name in promised if figures[name]["searched"]["actual"] < LEAKS]
        print(f"{sum(one['runs'] for one in figures.values())} runs", end=" ")
        print(f"in {time.monotonic() - began:.0f} s, seed {asked.seed}")
    if asked.json:
        Path(asked.json).write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    return int(bool(broken))


if __name__ == "__main__":
    sys.exit(main())
