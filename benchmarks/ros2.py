"""How fast is `compensate` between ROS 2 nodes, and does calibration by service give the truth?

`python benchmarks/ros2.py [--loads 50] [--services 2] [--seconds 20] [--json FILE]`, with the extra
`ros2`: nodes in other processes publish wrench and pose of a hand-moved tool (`posed_hand.py`:
noise of wrench and pose, offsets, poses late by up to 8 ms), receive the contact wrench, and call
the services.

* processing: from the arrival of the first message in Python to the end of each publication that
  follows, by the clock and in thread time (without waits for a core);
  echo: from the stamp of sending to the callback of the receiver, by the clock.
* calibrations: share of numbers whose truth is inside the 95 % and the 99.98 % interval, and within
  the tolerance. A calibration is right if all its numbers are inside the latter, its stop
  criterion.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from calibrate import load_of
from numpy.typing import NDArray
from posed_hand import NOISE, POSE_NOISE, Hand
from scipy.spatial.transform import Rotation

from drake_teleop.load.identification import Identification
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.load.tolerance import (
    display_values_of_required_entries,
    parse_tolerance,
    tolerances_in_display_units,
)
from drake_teleop.robots.calibration import half_widths_and_dof_over_tolerances

Array = NDArray[np.float64]

PEER = Path(__file__).parents[1] / "tests" / "robots" / "ros2_peer.py"
UNTIL = "mass 0.5 %, com 0.5 mm"
HZ, ECHO_HZ, TABLE_S = 200.0, 500.0, 120.0
DOMAIN = str(os.getpid() % 100 + 101)
SOURCE = f"ros2://ft/wrench?pose=/ft/pose&domain={DOMAIN}&sign=1"
NODE = "import sys; from drake_teleop.cli.main import main; main(sys.argv[1:])"


def table(rng: np.random.Generator, phi: Array, hz: float) -> Array:
    """Return wrench and pose (N, 13) of a hand-moved tool."""
    hand, t = Hand(rng), np.arange(round(TABLE_S * hz)) / hz
    noise = NOISE * np.sqrt(hz / 500.0) * rng.normal(size=(len(t), 6))
    offsets = rng.normal(size=6) * np.repeat([5.0, 0.3], 3)
    R, p = hand.at(t - rng.uniform(0.0, 0.008))
    R = R * Rotation.from_rotvec(POSE_NOISE[3:] * rng.normal(size=p.shape))
    wrench = non_contact_wrench(*hand.motion(t), phi) + offsets + noise
    q = R.as_quat()[:, [3, 0, 1, 2]]
    return np.hstack([wrench, q, p + POSE_NOISE[:3] * rng.normal(size=p.shape)])


def identification(phi: Array) -> Identification:
    """Return a load, as if it had been identified."""
    known = np.ones(16, dtype=bool)
    zero = np.zeros(6)
    return Identification(phi, zero, np.eye(16) * 1e-6, known, 1.0, 0.0, zero, "given", 1)


def started(stack: ExitStack, *words: str, **options: Any) -> subprocess.Popen[str]:
    """Start a process that ends with the exit stack."""
    process = subprocess.Popen([sys.executable, *words], text=True, **options)
    stack.callback(process.wait)
    stack.callback(process.kill)
    return process


def peer(stack: ExitStack, *words: str, **options: Any) -> subprocess.Popen[str]:
    """Start a node in another process."""
    return started(stack, str(PEER), *words, stdout=subprocess.PIPE, **options)


def processing(folder: Path, seconds: float) -> dict[str, float]:
    """Return the times of one pass of the loop, and of the path to the receiver."""
    from drake_teleop.robots.compensate import compensate_stream
    from drake_teleop.robots.compensator import Compensator
    from drake_teleop.robots.connections import open_sink, open_source
    from drake_teleop.robots.ros2 import MessageConverter

    rng = np.random.default_rng(7)
    phi = load_of(rng)
    np.save(folder / "rows.npy", table(rng, phi, ECHO_HZ))
    load = identification(phi)
    began: list[float] = []
    writes: list[int] = []
    spent: list[list[float]] = []
    parts_of = MessageConverter.readings_of_message

    def noted(self: Any, name: str, data: Any, number: int) -> Any:
        if not began:
            began[:] = time.perf_counter(), time.thread_time()
        return parts_of(self, name, data, number)

    MessageConverter.readings_of_message = noted  # type: ignore[method-assign]
    with ExitStack() as stack:
        sink = open_sink(f"ros2://contact?domain={DOMAIN}")
        source = open_source(SOURCE, load, rate_hz=ECHO_HZ)
        moving = peer(stack, "moving", DOMAIN, str(folder / "rows.npy"), str(ECHO_HZ))
        heard = stack.enter_context(open(folder / "echo.txt", "w+"))
        echo = started(stack, str(PEER), "echo", DOMAIN, "/contact", stdout=heard)
        assert moving.stdout is not None
        moving.stdout.readline()
        end = time.monotonic() + 5.0 + seconds
        write, read = sink.write, source.read

        def timed(out: Any) -> None:
            write(out)
            writes.append(out.flags)

        def until(timeout_s: float) -> Any:
            if began and writes:
                now = time.perf_counter(), time.thread_time()
                spent.append([(x - y) / len(writes) for x, y in zip(now, began, strict=True)])
            began.clear()
            writes.clear()
            return read(timeout_s) if time.monotonic() < end else None

        sink.write, source.read = timed, until  # type: ignore[method-assign]
        delay = getattr(source, "delay_readings", 0)
        compensator = Compensator(load, source.dt, delay_readings=delay)
        counts = compensate_stream(source, compensator, sink)
        echo.kill()
        heard.seek(0)
        rows = [json.loads(line) for line in heard.read().splitlines()[:-1]]
        source.close()
    late = np.array([row["late"] for row in rows if "late" in row and any(row["wrench"])])
    clock, thread = 1e3 * np.array(spent[len(spent) // 5 :]).T
    found = {"wrenches": float(counts["wrenches"]), "received": float(len(late))}
    for name, times in (("processing", clock), ("processing_thread", thread), ("echo", 1e3 * late)):
        for q in (50, 99):
            found[f"{name}_p{q}_ms"] = float(np.percentile(times, q))
    return found


class Tables:
    """Node of a moving tool, with one load after another."""

    def __init__(self, stack: ExitStack, folder: Path) -> None:
        self.path, self.count = folder / "rows.npy", 0
        self.next()
        moving = peer(stack, "moving", DOMAIN, str(self.path), str(HZ))
        assert moving.stdout is not None and moving.stdout.readline()

    def next(self) -> None:
        """Publish the next load, after the second that the node takes to notice it."""
        rng = np.random.default_rng([self.count, 53])
        self.phi, self.count = load_of(rng), self.count + 1
        np.save(self.path.with_name("new.npy"), table(rng, self.phi, HZ))
        os.replace(self.path.with_name("new.npy"), self.path)
        time.sleep(1.5)

    def judged(self, found: Identification) -> NDArray[np.bool_]:
        """Return flags (3, k): number within 95 % interval, 99.98 % interval, and tolerance."""
        tolerance = parse_tolerance(UNTIL)
        half, wide, _ = half_widths_and_dof_over_tolerances(
            SimpleNamespace(identification=found), tolerance
        )  # type: ignore[arg-type]
        error = np.abs(
            display_values_of_required_entries(tolerance, found.phi)
            - display_values_of_required_entries(tolerance, self.phi)
        )
        error /= tolerances_in_display_units(tolerance, self.phi)
        return np.array([error <= half, error <= wide, error <= 1.0])


def counted(name: str, inside: list[NDArray[np.bool_]], loads: int) -> dict[str, float]:
    """Return the figures of some calibrations."""
    held = np.array(inside)
    figures = {"loads": loads, "known": len(held), "inside_95": held[:, 0].mean()}
    figures["inside_all_intervals"] = held[:, 1].all(axis=1).sum()
    figures["within_all_tolerances"] = held[:, 2].all(axis=1).sum()
    return {f"{name}.{key}": float(value) for key, value in figures.items()}


def calibrations(folder: Path, loads: int) -> dict[str, float]:
    """Return the counts over calibrations from topics, each of another load."""
    from drake_teleop.robots.calibration import calibrate
    from drake_teleop.robots.connections import open_source_and_recorder

    inside: list[NDArray[np.bool_]] = []
    with ExitStack() as stack:
        tables = Tables(stack, folder)
        for k in range(loads):
            tables.next()
            stream, recorder = open_source_and_recorder(SOURCE, None)
            for name in recorder.file_names:
                (folder / name).unlink(missing_ok=True)
            looks = calibrate(
                stream, recorder, folder / recorder.log_file_name, parse_tolerance(UNTIL)
            )
            stream.close()
            last = looks[-1]
            if last.identified_log is not None and last.is_known.all():
                inside.append(tables.judged(last.identified_log.identification))
                print(
                    f"{k}: {last.record_length_s:.1f} s {inside[-1].all(axis=1).tolist()}",
                    flush=True,
                )
            else:
                print(
                    f"{k}: {last.record_length_s:.1f} s {last.failure} {last.doubts}"
                    f" {last.relative_half_widths}",
                    flush=True,
                )
    return counted("calibrations", inside, loads)


def services(folder: Path, loads: int) -> dict[str, float]:
    """Return the counts over calibrations by the service of one running node."""
    inside: list[NDArray[np.bool_]] = []
    with ExitStack() as stack:
        load = folder / "load.json"
        identification(load_of(np.random.default_rng(0))).save(load)
        tables = Tables(stack, folder)
        words = ["ros2", SOURCE, f"ros2://contact?domain={DOMAIN}", "--load", str(load)]
        words += ["--rate", str(HZ), "--out", str(folder / "out")]
        log = stack.enter_context(open(folder / "node.txt", "w"))
        started(stack, "-c", NODE, *words, stderr=log)
        calls = peer(stack, "calls", DOMAIN, stdin=subprocess.PIPE)

        def call(line: str) -> Any:
            assert calls.stdin is not None and calls.stdout is not None
            print(line, file=calls.stdin, flush=True)
            return json.loads(calls.stdout.readline())

        assert call(f"set until {UNTIL}")[0] and call("set seconds 60")[0]
        for k in range(loads):
            tables.next()
            done, said = call("calibrate")
            print(f"{k}: {said}", flush=True)
            if done:
                found = Identification.load(folder / "out" / "identification.json")
                inside.append(tables.judged(found))
    return counted("services", inside, loads)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--loads", type=int, default=50, help="number of calibrations from topics")
    parser.add_argument(
        "--services", type=int, default=2, help="number of calibrations by the service"
    )
    parser.add_argument(
        "--seconds", type=float, default=20.0, help="duration of the measured loop [s]"
    )
    parser.add_argument("--json", type=Path, help="file for the figures")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        figures = processing(Path(folder), options.seconds) if options.seconds else {}
        figures |= calibrations(Path(folder), options.loads) if options.loads else {}
        figures |= services(Path(folder), options.services) if options.services else {}
    for name, value in figures.items():
        print(f"{name:32} {value:.4g}")
    if options.json is not None:
        options.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
