"""Does a drive with every change repeat to the last bit, with slices of any length?

    python benchmarks/repeated.py [--seconds 60] [--json FILE]

A script taps and presses on the leaf of `touch` and moves every slider all the time. It opens and
closes the clutch, lets go, and chooses another grip, sensor, method and network (with delay, jitter
and loss); contact is detected for a while, an object is grasped and released. The drive runs as in
the server, in slices of 5 ms, with its log on the disk. Then `repeat` runs from the record alone.
`same_bytes`: whether the log's files are equal for the same slices. `differ_`: different numbers in
the log, for slices of 1, 7 and 1000 ms.
Baseline: `differ_late`, different numbers within a second if one input comes 1 ms later.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path

import numpy as np

from drake_teleop.common.progress import show_no_progress
from drake_teleop.lab.identified_load import identified_load
from drake_teleop.live.inputs import INPUT_RANGES, NETWORK_NAMES, SLICE_MS, Inputs
from drake_teleop.live.scenarios import live_scenario
from drake_teleop.live.session import RecordedDrive, Session, read_drive
from drake_teleop.station.passivity.methods import METHODS
from drake_teleop.station.result import SimulationResult
from drake_teleop.station.scenario import LoadScenario

#: Choices, and the share of the drive from which they hold.
STATION_INPUTS = (
    (0.10, {"object": 1}),
    (0.20, {"detection": 1}),
    (0.25, {"detection": 0}),
    (0.30, {"object": 0}),
    (
        0.40,
        {
            "network": NETWORK_NAMES.index("custom"),
            "method": list(METHODS).index("tdpa"),
            "delay": 200,
        },
    ),
    (0.50, {"delay": 350, "jitter": 10, "loss": 20}),
    (0.60, {"grip": 2}),
    (0.65, {"grip": 1}),
    (0.75, {"sensor": 1}),
    (0.80, {"sensor": 0}),
    (0.90, {"network": 0, "method": 0}),
)


def wanted(now: Inputs, ms: int, end: int) -> Inputs:
    """Return the inputs at a time [ms]."""
    t, share = 1e-3 * ms, ms / end
    down, sway = 0.5 - 0.5 * np.cos(2 * np.pi * 0.5 * t), np.sin(2 * np.pi * 0.3 * t)
    other = np.cos(2 * np.pi * 0.2 * t)
    values = {"z": round(-9500 * down), "x": round(300 * sway), "y": round(200 * other)}
    values |= {"rx": round(200 * sway), "ry": round(150 * other), "rz": round(300 * sway)}
    values |= {"sigma": round(50 + 50 * sway), "sigma_object": round(50 + 50 * other)}
    values |= {"gamma": round(100 + 40 * other), "force_scale": round(5714 + 2000 * sway)}
    values |= {"clutch": not 0.1633 < share < 0.17, "held": not 0.34 < share < 0.35}
    for begins, choices in STATION_INPUTS:
        if share >= begins:
            values |= choices
    return now.with_changes(values)


def driven(seconds: float, folder: Path) -> None:
    """Record a drive with its log, as a page does."""
    scenario = live_scenario(LoadScenario("touch"))
    load = identified_load(scenario)
    session = Session(scenario, load, log=folder / "log.parquet", record=folder)
    end = round(1e3 * seconds / SLICE_MS) * SLICE_MS
    while session.ms < end:
        session.apply_inputs(wanted(session.inputs, session.ms, end))
        session.advance()
        if session.ms % (3 * SLICE_MS) == 0:
            session.new_rows()
    session.close()


def begun(drive: RecordedDrive, late: int) -> SimulationResult:
    """Return the log of the first hundred changes, of which the 20th comes late [ms]."""
    changes = list(drive.changes[:100])
    ms, inputs = changes[20]
    changes[20] = ms + late, inputs
    return RecordedDrive(drive.scenario, drive.load, changes).repeat(show_no_progress(""))


def differ(one: SimulationResult, other: SimulationResult) -> int:
    """Return how many numbers of two logs have different bits; all if their shapes differ."""
    count = 0
    for name in ("t", *one):
        a, b = (np.ascontiguousarray(log[name]) for log in (one, other))
        same_form = a.shape == b.shape
        count += int((a.view(np.int64) != b.view(np.int64)).sum()) if same_form else a.size
    return count


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    figures: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as name:
        folder, again = Path(name) / "drive", Path(name) / "again"
        driven(options.seconds, folder)
        drive, log = read_drive(folder), SimulationResult.read_parquet(folder / "log.parquet")
        columns = np.array([[getattr(i, name) for name in INPUT_RANGES] for _, i in drive.changes])
        moved = [
            name for name, column in zip(INPUT_RANGES, columns.T, strict=True) if np.ptp(column)
        ]
        figures["inputs_changed"], figures["inputs"] = len(moved), len(INPUT_RANGES)
        figures["changes"] = len(drive.changes) - 1
        figures["numbers"] = sum(log[name].size for name in log)
        force = np.abs(log["true_contact_wrench_W"][:, 2])
        figures["contact_share"] = float((force > 0.5).mean())
        drive.repeat(show_no_progress(""), again)
        parts = sorted((folder / "log.parquet").iterdir())
        figures["same_bytes"] = all(p.read_bytes() == (again / p.name).read_bytes() for p in parts)
        for slice_ms in (1, 7, 1000):
            figures[f"differ_{slice_ms}_ms"] = differ(
                log, drive.repeat(show_no_progress(""), None, slice_ms)
            )
            print(f"sliced by {slice_ms} ms", flush=True)
        figures["differ_late"] = differ(begun(drive, 0), begun(drive, 1))
    for name, value in figures.items():
        print(f"{name:20} {value:.6g}")
    if options.json is not None:
        options.json.write_text(json.dumps(figures, indent=2) + "\n")
    sys.exit(not figures["same_bytes"] or any(figures[f"differ_{k}_ms"] for k in (1, 7, 1000)))


if __name__ == "__main__":
    main()
