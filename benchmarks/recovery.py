"""Does every method recover from every random network within its force limit?

`python benchmarks/recovery.py [--json FILE] [--networks N]` presses on a wall of 0.1 to 5 kN/m with
`lab.comparison.one_dof` over N (10 000) pairs of random lines: delay up to 300 ms, jitter up to 100
%, loss up to 50 %, bursts that lose 50 to 100 % and often last longer than the watchdog's 0.1 s. At
4.5 s, in contact, the lines become good: 10 ms and no loss. The hand lets go and rests. A method
has recovered if at the end the slave is within 2 mm of the hand. The hand must be at rest within
0.5 mm, and the displayed force below 0.1 N. The force must never exceed 5 N, nor step up by more
than 0.5 N in the first 0.5 s after a silence.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import multiprocessing
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drake_teleop.lab.comparison.one_dof import (
    PERIOD_S,
    REFERENCE_ONE_DOF,
    OneDofRun,
    Task,
    operator_intent,
    run_one_dof,
)
from drake_teleop.station.channel.network import NetworkConfig
from drake_teleop.station.passivity.methods import METHODS, PassivityConfig
from drake_teleop.station.passivity.safe_state import RESUME_TIME_S

TASK = Task(
    swing_start=0.3,
    swing_end=1.5,
    press_start=2.0,
    press_end=2.6,
    release_start=6.5,
    release_end=7.1,
    end=10.0,
)
GOOD_FROM, TIMEOUT, LIMIT = 4.5, 0.1, 5.0  # s, s, N


@dataclasses.dataclass
class Row:
    """Figures of a method over all networks: the worst values."""

    method: str
    runs: int = 0
    recovered: int = 0
    silences: int = 0
    beside: float = 0.0  #: distance of slave and hand in the last half second [m]
    at_rest: float = 0.0  #: displayed force in that time [N]
    largest: float = 0.0  #: largest displayed force [N]
    step: float = 0.0  #: largest step of the force just after a silence [N]

    def add(self, run: OneDofRun) -> None:
        """Count one run."""
        end, felt = slice(-round(0.5 / PERIOD_S), None), np.abs(run.hand_force)
        beside = float(np.abs(run.slave_position - run.master_position)[end].max())
        at_rest = float(felt[end].max())
        still = np.ptp(run.master_position[end]) < 0.5e-3
        self.runs += 1
        self.recovered += bool(beside < 2e-3 and at_rest < 0.1 and still)  # False if not finite
        silent = run.time_without_packets[:, 0] > TIMEOUT
        grown = np.diff(felt, prepend=0.0)[_resuming(silent)]
        self.silences += int((np.diff(silent.astype(int)) < 0).sum())
        worst = dict(
            beside=beside, at_rest=at_rest, largest=felt.max(), step=grown.max(initial=0.0)
        )
        self._raise(worst)

    def join(self, other: Row) -> None:
        """Add the counts of another process."""
        for name in ("runs", "recovered", "silences"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        self._raise(dataclasses.asdict(other))

    def _raise(self, found: dict[str, float]) -> None:
        for name in ("beside", "at_rest", "largest", "step"):
            # The order matters: NaN is kept.
            setattr(self, name, float(np.maximum(found[name], getattr(self, name))))


def _resuming(silent: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return flags of the steps up to RESUME_TIME_S after a silence."""
    steps = np.arange(len(silent))
    since = steps - np.maximum.accumulate(np.where(silent, steps, -len(silent)))
    return (since > 0) & (since < round(RESUME_TIME_S / PERIOD_S))


def rough_line(path: Path, rng: np.random.Generator) -> NetworkConfig:
    """Return a very bad line until GOOD_FROM, as a trace of every millisecond."""
    steps = round(GOOD_FROM / PERIOD_S)
    mean, jitter = rng.uniform(0.0, 0.3), rng.uniform()
    delay = mean * (1.0 + jitter * rng.uniform(-1.0, 1.0, steps))
    lost = rng.uniform(size=steps) < rng.uniform(0.0, 0.5)
    start = 0.0
    while start < GOOD_FROM:
        stop = start + rng.exponential(0.15)
        burst = slice(round(start / PERIOD_S), round(stop / PERIOD_S))
        lost[burst] |= rng.uniform(size=len(lost[burst])) < rng.uniform(0.5, 1.0)
        start = stop + rng.exponential(0.5)
    cells = np.char.mod("%.6f", delay)
    cells[lost] = ""
    times = np.char.mod("%.3f", PERIOD_S * np.arange(steps))
    rows = np.char.add(np.char.add(times, ","), cells)
    text = "\n".join(["time,delay", *rows, f"{GOOD_FROM},0.01", "60,0.01"])
    path.write_text(text + "\n", encoding="utf-8")
    return NetworkConfig(trace=str(path))


def _some_networks(job: tuple[int, int]) -> list[Row]:
    """Run every method over the networks first..last-1."""
    rows, intent = [Row(method) for method in METHODS], operator_intent(TASK)
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder) / f"{way}.csv" for way in range(2)]
        for seed in range(*job):
            rng = np.random.default_rng(seed)
            lines = [rough_line(path, rng) for path in paths]
            wall = float(np.exp(rng.uniform(np.log(100), np.log(5000))))
            model = dataclasses.replace(REFERENCE_ONE_DOF, wall_stiffness=wall)
            for row in rows:
                config = PassivityConfig(method=row.method, force_limit=LIMIT)
                row.add(run_one_dof(model, config, *lines, timeout=TIMEOUT, intent=intent))
    return rows


def study(networks: int, processes: int = 2) -> list[Row]:
    """Run every method over the networks."""
    share = max(1, -(-networks // (16 * processes)))
    jobs = [(first, min(first + share, networks)) for first in range(0, networks, share)]
    run_one_dof(
        REFERENCE_ONE_DOF, PassivityConfig(), NetworkConfig()
    )  # compiles, before processes fork
    if processes > 1:
        with multiprocessing.get_context("fork").Pool(processes) as pool:
            parts = pool.map(_some_networks, jobs, chunksize=1)
    else:
        parts = [_some_networks(job) for job in jobs]
    total = parts[0]
    for part in parts[1:]:
        for row, other in zip(total, part, strict=True):
            row.join(other)
    return total


def holds(rows: list[Row]) -> bool:
    """Return whether every method recovered every time and kept its limits."""
    return all(
        row.recovered == row.runs and row.largest <= LIMIT + 1e-12 and row.step < 0.5
        for row in rows
    )


def main(arguments: list[str] | None = None) -> int:
    """Run and print the study; return 0 if `holds`."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="file for the figures")
    parser.add_argument(
        "--networks", type=int, default=10_000, help="number of networks (default: 10000)"
    )
    options = parser.parse_args(arguments)
    began = time.monotonic()
    rows = study(options.networks)
    took = time.monotonic() - began
    if options.json:
        found = {"wall_s": took, "rows": [dataclasses.asdict(row) for row in rows]}
        options.json.write_text(json.dumps(found, indent=2) + "\n")
    print(f"{options.networks} networks, {took:.0f} s")
    print("method        recovered of     runs  silences  beside mm  at rest N  largest N  step N")
    for row in rows:
        print(
            f"{row.method:<14}{row.recovered:>9} of {row.runs:>8}{row.silences:>10}"
            f"{1e3 * row.beside:>11.3f}{row.at_rest:>11.3f}{row.largest:>11.3f}"
            f"{row.step:>8.3f}"
        )
    return 0 if holds(rows) else 1


if __name__ == "__main__":
    sys.exit(main())
