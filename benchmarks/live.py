"""Does a driven station keep up with the clock, and which share of a core does it take?

    python benchmarks/live.py [--seconds 60] [--slices] [--json FILE]

A script taps on the leaf of `contact_transition` at 1 Hz, with fast motion in between, as a driver
would. It sends 60 messages per second through the page's handler and receives 60 frames per second
as JSON, with the 3D scene. The sensor runs at 8 kHz, slices are 5 ms, without a browser; Python's
garbage collection waits, as in the server.
Real time: simulated over elapsed time, lateness of slices, lost time, CPU time of the process over
elapsed time.
Baseline: the CPU time of the same drive by `repeat`, without clock, page and scene.

With --slices: the same taps with each method on each network preset, at full speed, without page
and scene. The figures are the CPU times of a slice of 5 ms, the least of three drives: 99th
percentile and largest, after the first second of each.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from itertools import product
from pathlib import Path

import numpy as np

from drake_teleop.common.progress import show_no_progress
from drake_teleop.lab.identified_load import identified_load
from drake_teleop.live.inputs import NETWORK_NAMES, SLICE_MS
from drake_teleop.live.live import FRAME_PERIOD_S, Live, without_garbage_collection
from drake_teleop.live.page_scene import PageScene
from drake_teleop.live.scenarios import live_scenario
from drake_teleop.live.session import Session, read_drive
from drake_teleop.station.channel.network import PRESETS as NETWORK_PRESETS
from drake_teleop.station.passivity.methods import METHODS
from drake_teleop.station.scenario import LoadScenario

DRIVES = 3


def wanted(t: float) -> dict[str, int]:
    """Return the inputs at a time [s], in the units of `Inputs`; the leaf is 65 mm below."""
    down, sway = 0.5 - 0.5 * np.cos(2 * np.pi * t), np.sin(2 * np.pi * 0.3 * t)
    return {"z": round(-7300 * down), "x": round(300 * sway), "sigma": round(50 + 50 * sway)}


def driven(seconds: float, folder: Path) -> dict[str, float]:
    """Return the figures of a drive in real time, which is recorded."""
    scenario = live_scenario(LoadScenario("contact_transition"))
    load = identified_load(scenario)
    clock = time.perf_counter
    live = Live(scenario, load, folder, PageScene("own", scenario).scene_values, clock())
    live.join(1, clock())
    for _ in range(200):  # compilation and imports of the first call
        live.tick(clock)
        time.sleep(live.time_to_next_tick(clock()))
    late, bytes_sent, touched, frames = [], 0, 0, 0
    start, cpu, lost = clock(), time.process_time(), live.pace.lost_time_s
    next_message = start
    while clock() - start < seconds:
        now = clock()
        if now >= next_message:
            next_message += FRAME_PERIOD_S
            live.handle_message(1, json.dumps({"set": wanted(now - start)}), now)
        if not live.is_halted and live.pace.time_to_next_slice(now) <= 0:
            late.append(-live.pace.time_to_next_slice(now))
        frame = live.tick(clock)
        if frame is not None:
            bytes_sent += len(json.dumps({"frame": frame}))
            touched, frames = touched + frame["contact"], frames + 1
        time.sleep(live.time_to_next_tick(clock()))
    elapsed, cpu = clock() - start, time.process_time() - cpu
    p50, p95, p99, most = 1e3 * np.percentile(late, [50, 95, 99, 100])
    lost = live.pace.lost_time_s - lost
    live.close()
    return {
        "factor": 1.0 - lost / elapsed,
        "late_p50_ms": float(p50),
        "late_p95_ms": float(p95),
        "late_p99_ms": float(p99),
        "late_max_ms": float(most),
        "given_up_s": lost,
        "core_share": cpu / elapsed,
        "frames_per_s": frames / elapsed,
        "kB_per_s": 1e-3 * bytes_sent / elapsed,
        "contact_share": touched / frames,
    }


def slices(seconds: float) -> dict[str, float]:
    """Return the CPU time of a slice [ms] by method and network: 99th percentile and largest.

    Each slice counts at its fastest of three equal drives. They are minutes apart, because other
    programs slow the machine for half a minute at a time.
    """
    scenario = live_scenario(LoadScenario("contact_transition"))
    load, figures = identified_load(scenario), {}
    cells = list(product(NETWORK_PRESETS, METHODS))
    drives: dict[tuple[str, str], list[list[float]]] = {cell: [] for cell in cells}
    for network, method in cells * DRIVES:
        choice = {"network": NETWORK_NAMES.index(network), "method": list(METHODS).index(method)}
        drives[network, method].append(spent(Session(scenario, load), choice, seconds))
    for network, method in cells:
        counted = np.min(drives[network, method], axis=0)
        figures[f"{network}_{method}_p99_ms"] = float(np.percentile(counted, 99))
        figures[f"{network}_{method}_most_ms"] = float(counted.max())
    return figures


def spent(session: Session, choice: dict[str, int], seconds: float) -> list[float]:
    """Return the CPU time of each slice [ms] after the first second."""
    session.apply_inputs(session.inputs.with_changes(choice))
    taken = []
    while session.ms < 1e3 * (1.0 + seconds):
        start = time.thread_time()
        session.apply_inputs(session.inputs.with_changes(wanted(1e-3 * session.ms)))
        session.advance()
        taken.append(1e3 * (time.thread_time() - start))
        session.new_rows()  # as for a page
    return taken[1000 // SLICE_MS :]


def finish(figures: dict[str, float], file: Path | None) -> None:
    """Print the figures, and write them if `file` is given."""
    for name, value in figures.items():
        print(f"{name:28} {value:.4g}", flush=True)
    if file is not None:
        file.write_text(json.dumps(figures, indent=2) + "\n")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument(
        "--slices", action="store_true", help="measure the slices of each method on each network"
    )
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    if options.slices:
        with without_garbage_collection():
            finish(slices(options.seconds), options.json)
        return
    with tempfile.TemporaryDirectory() as folder:
        with without_garbage_collection():
            figures = driven(options.seconds, Path(folder) / "drive")
        drive = read_drive(Path(folder) / "drive")
        cpu = time.process_time()
        drive.repeat(show_no_progress(""), Path(folder) / "again")
        seconds = drive.scenario.simulation.duration
        figures["core_share_of_repeat"] = (time.process_time() - cpu) / seconds
        parts = sorted((Path(folder) / "drive" / "log.parquet").iterdir())
        again = [Path(folder) / "again" / part.name for part in parts]
        figures["repeat_has_the_same_bytes"] = all(
            a.read_bytes() == b.read_bytes() for a, b in zip(parts, again, strict=True)
        )
    finish(figures, options.json)
    sys.exit(not figures["repeat_has_the_same_bytes"])


if __name__ == "__main__":
    main()
