"""How many planted faults of a dataset are named, and how good are wrench and contacts?

Usage: python benchmarks/dataset.py [EPISODES] [FRAMES] [--rates HZ ...] [--tools N] [--json FILE]
EPISODES is the number of clean ones in each dataset. FRAMES is the length of the dataset for the
CPU
time, followed by a run that is killed six times (0: neither).
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from sample_dataset import write_sample_dataset
from scipy.spatial.transform import Rotation

from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.logs.dataset.dataset import dataset_command
from drake_teleop.logs.sample import WRENCH_NOISE_STD, SampleEpisode

RATES = (10.0, 15.0, 30.0, 50.0)
TOOLS = [
    phi_from_mass_com_inertia(m, np.array(c), m * 2e-3 * np.eye(3))
    for m, c in (
        (0.95, (0.004, -0.011, 0.058)),
        (1.8, (0.02, 0.01, 0.09)),
        (0.5, (0, 0, 0.04)),
        (0.7, (0.01, 0, 0.05)),
        (0.8, (0, -0.02, 0.06)),
        (1.1, (0.015, 0.01, 0.045)),
        (1.2, (-0.02, 0, 0.08)),
        (1.4, (0, 0.01, 0.05)),
        (1.6, (-0.01, -0.01, 0.07)),
        (2.0, (0, 0, 0.06)),
    )
]
OTHER = phi_from_mass_com_inertia(1.3, np.array([-0.01, 0.02, 0.07]), 3e-3 * np.eye(3))
Fault = Callable[[SampleEpisode, np.ndarray], SampleEpisode]


def turn(axis: str, degrees: float) -> np.ndarray:
    return np.asarray(Rotation.from_euler(axis, degrees, degrees=True).as_matrix())


def mapped(M: np.ndarray, force: float = 1.0, torque: float = 1.0) -> Fault:
    def fault(x: SampleEpisode, phi: np.ndarray) -> SampleEpisode:
        f, tau = x.wrench[:, :3] @ M.T, x.wrench[:, 3:] @ M.T
        return x._replace(wrench=np.hstack([force * f, torque * tau]))

    return fault


def late(frames: int) -> Fault:
    return lambda x, phi: x._replace(wrench=np.roll(x.wrench, -frames, axis=0))


def tared(share: float) -> Fault:
    def fault(x: SampleEpisode, phi: np.ndarray) -> SampleEpisode:
        fps = (len(x.t) - 1) / (x.t[-1] - x.t[0])
        end, near = round(0.4 * fps), max(1, round(0.13 * fps))
        rows = range(end, len(x.t) - end)
        free = [k for k in rows if not x.contact_wrench[k - near : k + near].any()]
        k = min(free, key=lambda row: abs(row - share * len(x.t)))
        wrench = x.wrench.copy()
        wrench[k:] -= wrench[k]
        return x._replace(wrench=wrench)

    return fault


def weight_removed(x: SampleEpisode, phi: np.ndarray) -> SampleEpisode:
    R = Rotation.from_quat(x.quaternion[:, [1, 2, 3, 0]]).as_matrix()
    gravity = np.einsum("nji,j->ni", R, [0, 0, -9.80665])
    rest = np.zeros_like(gravity)
    return x._replace(wrench=x.wrench - non_contact_wrench(-gravity, rest, rest, phi))


def in_base(x: SampleEpisode, phi: np.ndarray) -> SampleEpisode:
    R = Rotation.from_quat(x.quaternion[:, [1, 2, 3, 0]]).as_matrix()
    parts = np.einsum("nij,nkj->nki", R, x.wrench.reshape(-1, 2, 3))
    return x._replace(wrench=parts.reshape(-1, 6))


def clipped(x: SampleEpisode, phi: np.ndarray) -> SampleEpisode:
    return x._replace(wrench=np.minimum(x.wrench, np.quantile(x.wrench, 0.9, axis=0)))


FAULTS: dict[str, tuple[set[str], Fault]] = {
    "z 90": ({"frame"}, mapped(turn("z", 90))),
    "x 90": ({"frame"}, mapped(turn("x", 90))),
    "y -90": ({"frame"}, mapped(turn("y", -90))),
    "z 180": ({"frame"}, mapped(turn("z", 180))),
    "z 45": ({"frame"}, mapped(turn("z", 45))),
    "x 20": ({"frame"}, mapped(turn("x", 20))),
    "base": ({"frame"}, in_base),
    "negated": ({"sign"}, mapped(-np.eye(3))),
    "z 90, negated": ({"frame", "sign"}, mapped(-turn("z", 90))),
    "x reversed": ({"sign"}, mapped(np.diag([-1.0, 1.0, 1.0]))),
    "lbf": ({"unit"}, mapped(np.eye(3), 1 / 4.4482, 1 / 0.112985)),
    "kgf": ({"unit"}, mapped(np.eye(3), 1 / 9.80665, 1 / 9.80665)),
    "N mm": ({"unit"}, mapped(np.eye(3), 1.0, 1000.0)),
    "1 frame late": ({"lag"}, late(1)),
    "3 frames late": ({"lag"}, late(3)),
    "2 frames early": ({"lag"}, late(-2)),
    "tared": ({"tared"}, tared(0.5)),
    "weight removed": ({"weight removed"}, weight_removed),
    "saturated": ({"saturated"}, clipped),
    "other tool": ({"tool changed"}, lambda x, phi: x),
}


def planted(folder: Path, fps: float, tool: int, clean: int) -> dict[str, Any]:
    phi = TOOLS[tool]
    changes = {k: {"phi": phi} for k in range(clean + len(FAULTS))}
    order = {clean + k: name for k, name in enumerate(FAULTS)}
    faults = {k: lambda x, f=FAULTS[n][1]: f(x, phi) for k, n in order.items()}
    changes |= {k: {"phi": OTHER} for k, name in order.items() if name == "other tool"}
    made = write_sample_dataset(
        folder / "in",
        episodes=clean + len(FAULTS),
        fps=fps,
        seed=tool,
        faults=faults,
        changes=changes,
    )
    started = time.process_time()
    summary = dataset_command(folder / "in", folder / "out", identify=True, quiet=True)
    cpu = time.process_time() - started
    rows = summary["episodes"]
    missed = [n for k, n in order.items() if set(rows[k]["verdict"]) != FAULTS[n][0]]
    false = sum(row["verdict"] != ["ok"] for row in rows[:clean])
    table = pl.read_parquet(next((folder / "out" / "in" / "data").glob("**/*.parquet")))
    table = table.filter(pl.col("episode_index") < clean)
    contact = np.array(table["observation.contact_wrench"].to_list())
    truth = np.vstack([x.contact_wrench for x in made[:clean]])
    touched = table["observation.in_contact"].to_numpy()
    true = np.hstack([x.in_contact for x in made[:clean]])
    free = ~truth.any(axis=1)
    residual = np.sqrt(np.mean(contact[free] ** 2, axis=0)) / WRENCH_NOISE_STD
    f1 = 2 * (touched & true).sum() / (touched.sum() + true.sum())
    return {
        "rate_hz": fps,
        "mass_kg": float(phi[0]),
        "planted": len(FAULTS),
        "missed": missed,
        "clean": clean,
        "false": false,
        "residual_of_noise": [float(residual[:3].mean()), float(residual[3:].mean())],
        "contact_f1": float(f1),
        "identified_kg": summary["mass"],
        "cpu_s": cpu,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("episodes", type=int, nargs="?", default=30)
    parser.add_argument("frames", type=int, nargs="?", default=10**6)
    parser.add_argument("--rates", type=float, nargs="+", default=RATES)
    parser.add_argument("--tools", type=int, default=len(TOOLS))
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    report: dict[str, Any] = {"cells": []}
    with tempfile.TemporaryDirectory() as name:
        for fps in given.rates:
            for k in range(given.tools):
                cell = planted(Path(name) / f"{fps}_{k}", fps, k, given.episodes)
                report["cells"].append(cell)
                print(cell, flush=True)
        if given.frames:
            report["long"] = long_dataset(Path(name) / "long", given.frames)
            report["killed"] = killed_dataset(Path(name) / "killed")
            print(report["long"], report["killed"])
    for fps in given.rates if report["cells"] else ():
        report[f"{fps:g} fps"] = summary = summarized(report["cells"], fps)
        print(fps, summary)
    if given.json:
        given.json.write_text(json.dumps(report, indent=2) + "\n")


def summarized(cells: list[dict[str, Any]], fps: float) -> dict[str, float]:
    """Return the figures of all tools at one rate."""
    some = [cell for cell in cells if cell["rate_hz"] == fps]
    planted = sum(cell["planted"] for cell in some)
    return {
        "planted": planted,
        "named_percent": 100.0 * (1.0 - sum(len(cell["missed"]) for cell in some) / planted),
        "clean": sum(cell["clean"] for cell in some),
        "false": sum(cell["false"] for cell in some),
        "largest_residual_of_noise": max(max(cell["residual_of_noise"]) for cell in some),
        "median_residual_of_noise": float(
            np.median([cell["residual_of_noise"] for cell in some], axis=0).max()
        ),
        "least_contact_f1": min(cell["contact_f1"] for cell in some),
        "median_contact_f1": float(np.median([cell["contact_f1"] for cell in some])),
    }


def command(folder: Path, out: str) -> list[str]:
    start = "from drake_teleop.cli.main import main; main()"
    words = [sys.executable, "-c", start, "dataset", str(folder / "in"), "--identify", "--quiet"]
    return [*words, "--out", str(folder / out)]


def long_dataset(folder: Path, frames: int) -> dict[str, float]:
    """Return CPU time and largest memory of the command, in a process of its own."""
    length = 1000
    write_sample_dataset(folder / "in", episodes=frames // length, duration_s=length / 30)
    _, status, used = os.wait4(subprocess.Popen(command(folder, "out")).pid, 0)
    if status:
        raise SystemExit("the command has failed")
    cpu, peak = used.ru_utime + used.ru_stime, used.ru_maxrss / 2**20
    return {"frames": frames, "cpu_s": cpu, "peak_GB": peak}


def killed_dataset(folder: Path, whole_s: float = 40.0, kills: int = 6) -> dict[str, float]:
    """Kill the command at random times; compare the copy with that of an undisturbed run."""
    write_sample_dataset(folder / "in", episodes=100)
    subprocess.run(command(folder, "whole"), check=True)
    pauses, killed = random.Random(52), 0
    while killed < kills:
        process = subprocess.Popen(command(folder, "killed"))
        try:
            process.wait(timeout=pauses.uniform(1.0, whole_s / kills))
            break
        except subprocess.TimeoutExpired:
            process.kill()
            killed += process.wait() == -signal.SIGKILL
    subprocess.run(command(folder, "killed"), check=True)
    copies = [
        {str(file.relative_to(copy)): file.read_bytes() for file in copy.rglob("*.*")}
        for copy in (folder / "whole" / "in", folder / "killed" / "in")
    ]
    return {"kills": killed, "same_bytes": float(copies[0] == copies[1]), "files": len(copies[0])}


if __name__ == "__main__":
    main()
