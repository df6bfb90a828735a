"""How accurate is each batch estimator for the UTIAS workshop tools?

The protocol is that of Nadeau, Giamou, Kelly (ICRA 2023): ten tools, simulated stop-and-go motion
of 1000 samples at 100 Hz, white noise of three levels on acceleration, angular acceleration and
wrench, five seeds. There are no offsets, and all methods assume this. The table gives medians over
tools and seeds. They are errors of mass [%], centre of mass [mm] and inertia about it [% of the
norm], and the share of physically consistent results. Ordinary least squares on the same draws is
the baseline. `consistent` without the motion's noise is the whitened semidefinite program of the
literature.

The recordings are not shipped; the folder contains one NPZ for each tool, with gravity upwards.

    python benchmarks/utias.py [--data FOLDER] [--seeds 5] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from drake_teleop.load.batch.methods import DEFAULT_METHOD, METHODS, identify_batch
from drake_teleop.load.inertia import mass_com_inertia
from drake_teleop.load.normal_equations import NoiseStd
from drake_teleop.load.regressor import non_contact_wrench

DATA = Path(__file__).parents[1] / ".." / "shared" / "data" / "utias_workshop_tools"
# Standard deviations of acceleration [m/s^2], angular one [rad/s^2], force [N], torque [N m].
LEVELS = {
    "Low": (0.025, 0.25, 0.05, 0.0025),
    "Moderate": (0.05, 0.5, 0.1, 0.005),
    "High": (0.1, 1.0, 0.2, 0.01),
}
TARGETS = {
    "Low": (0.042, 0.13, 27.0, 100.0),
    "Moderate": (0.076, 0.25, 57.0, 100.0),
    "High": (0.16, 0.51, 78.0, 100.0),
}
COLUMNS = ("mass_percent", "com_mm", "inertia_percent", "consistent_percent")


def load(file: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return (wrench, s, omega, alpha) without noise and phi of a tool."""
    with np.load(file) as data:
        s = data["a_S"] - data["R_WS"].transpose(0, 2, 1) @ np.array([0.0, 0.0, 9.81])
        phi = data["phi_true"]
        motion = s, data["omega_S"], data["alpha_S"]
    return non_contact_wrench(*motion, phi), *motion, phi


def errors(found: np.ndarray, phi: np.ndarray) -> tuple[float, float, float]:
    """Return error of mass (relative), of the centre of mass [m] and of inertia (relative)."""
    (m, c, inertia), (m_0, c_0, inertia_0) = mass_com_inertia(found), mass_com_inertia(phi)
    return (
        abs(m / m_0 - 1.0),
        float(np.linalg.norm(c - c_0)),
        float(np.linalg.norm(inertia - inertia_0) / np.linalg.norm(inertia_0)),
    )


def run(folder: Path, seeds: int) -> dict[str, dict[str, tuple[float, ...]]]:
    """Return medians by level and method: (mass %, com mm, inertia %, consistent %)."""
    tools = [load(file) for file in sorted(folder.glob("*.npz"))]
    table: dict[str, dict[str, tuple[float, ...]]] = {}
    for level, (acceleration, angular, force, torque) in LEVELS.items():
        wrench_noise = np.repeat([force, torque], 3)
        known = NoiseStd(wrench_noise, s=acceleration, alpha=angular)
        cases = {name: (name, known) for name in METHODS}
        cases["consistent, motion taken as exact"] = ("consistent", NoiseStd(wrench_noise))
        cases["consistent, wrench noise estimated"] = (
            "consistent",
            NoiseStd(s=acceleration, alpha=angular),
        )
        rows: dict[str, list[tuple[float, ...]]] = {name: [] for name in cases}
        for k, (F, s, omega, alpha, phi) in enumerate(tools):
            for seed in range(seeds):
                rng = np.random.default_rng([k, seed])
                arrays = (
                    F + wrench_noise * rng.normal(size=F.shape),
                    s + acceleration * rng.normal(size=s.shape),
                    omega,
                    alpha + angular * rng.normal(size=s.shape),
                )
                for name, (method, noise) in cases.items():
                    result = identify_batch(*arrays, method=method, noise=noise, offsets=False)
                    load_found = result.identification
                    rows[name].append(
                        (*errors(load_found.phi, phi), load_found.physically_consistent)
                    )
        table[level] = {}
        for name, found in rows.items():
            values = np.array(found, float)
            medians = np.median(values[:, :3], axis=0) * [100.0, 1000.0, 100.0]
            table[level][name] = (*medians.tolist(), float(100.0 * values[:, 3].mean()))
    return table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the tools' NPZ files")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--json", type=Path, help="file for the figures")
    arguments = parser.parse_args()
    if not any(arguments.data.glob("*.npz")):
        parser.error(f"no tools in {arguments.data}")
    table = run(arguments.data, arguments.seeds)
    for level, methods in table.items():
        print(f"{level:40s}    mass %   com mm  inertia %  consistent %")
        for name, row in {"(reference)": TARGETS[level], **methods}.items():
            mark = " *" if name == DEFAULT_METHOD else "  "
            print(f"  {name:36s}{mark} {row[0]:9.3f} {row[1]:8.3f} {row[2]:10.1f} {row[3]:13.0f}")
    if arguments.json:
        figures = {
            level: {name: dict(zip(COLUMNS, row, strict=True)) for name, row in methods.items()}
            for level, methods in table.items()
        }
        arguments.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
