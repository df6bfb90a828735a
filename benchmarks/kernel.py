"""Does the exported C kernel equal `compensate` in every bit, and what are its size and speed?

`python benchmarks/kernel.py [--json FILE] [--readings 1000000]` replays readings with noise,
contact and invalid values. It uses every compiler that is installed, at -O0 to -O3 without
contraction: gcc, clang, gcc for aarch64 in qemu, and WebAssembly in node (by ziglang). It prints
the number of readings that differ from `compensate`, the bytes of the object, and ns per reading.

Baseline: the compiled Python kernel in a loop of its own.
"""

from __future__ import annotations

import argparse
import json
import math
import runpy
import shutil
import subprocess
import tempfile
import time
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from drake_teleop.common.compiled import njit
from drake_teleop.common.numeric import Array
from drake_teleop.load.identification import Identification
from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.robots.compensation_step import (
    clip_wrenches,
    contact_and_scaled_wrench_into,
    reading_problem,
)
from drake_teleop.robots.controller.export import CFLAGS, ExportedCompensation, kernel_files
from drake_teleop.robots.streams import Reading

HERE = Path(__file__).parent
PHI = phi_from_mass_com_inertia(1.7, [0.01, -0.02, 0.06], np.diag([0.004, 0.005, 0.003]))
OFFSETS = np.array([1.5, -2.5, 3.5, 0.1, -0.2, 0.3])
LOAD = Identification(
    *(PHI, OFFSETS, 1e-6 * np.eye(16), np.ones(16, bool), 4.0, 0.0, np.full(6, 0.01)),
    *("batch least squares", 100),
)
SCALES = {"sigma_weight": 0.3, "sigma_inertia": 1.2, "gamma": 1.3}
DT = 1.0 / 1024.0  # exact, because times decide whether the low-pass restarts
TARGET = ExportedCompensation(LOAD, DT, 30.0, np.repeat([170.0, 9.0], 3), -1, [])
LEVELS = ("-O0", "-O1", "-O2", "-O3")
WASM = runpy.run_path(str(HERE.parent / "docs" / "_ext" / "kernel_page.py"))
NODE = """
const fs = require("fs"), [wasm, input, output, ...rest] = process.argv.slice(2);
const numbers = rest.map(Number);
const rows = new Float64Array(fs.readFileSync(input).buffer), count = rows.length / 18;
WebAssembly.instantiate(fs.readFileSync(wasm)).then(({ instance: { exports } }) => {
  const at = (name, n) => new Float64Array(exports.memory.buffer, exports[name].value, n);
  const reading = at("reading", 18), result = at("result", 12), out = new Float64Array(13 * count);
  at("load", 16).set(numbers.slice(0, 16));
  exports.start(...numbers.slice(16));
  const start = process.hrtime.bigint();
  for (let k = 0; k < count; ++k) {
    reading.set(rows.subarray(18 * k, 18 * k + 18));
    out[13 * k + 12] = exports.step();
    out.set(result, 13 * k);
  }
  console.log(Number(process.hrtime.bigint() - start) / count);
  fs.writeFileSync(output, out);
});
"""


def readings(count: int, seed: int = 0) -> Array:
    """Return readings (count, 18) with gravity: moving load, contact, noise, and invalid ones."""
    rng = np.random.default_rng(seed)
    t = DT * np.arange(count)[:, None]
    omega = 2.0 * np.sin(5.0 * t + np.arange(3)) + rng.normal(0.0, 0.01, (count, 3))
    alpha = 10.0 * np.cos(5.0 * t + np.arange(3)) + rng.normal(0.0, 0.5, (count, 3))
    down = 9.81 * np.column_stack(
        [np.sin(t), np.cos(t) * np.sin(2 * t), -np.cos(t) * np.cos(2 * t)]
    )
    motion = rng.normal(0.0, 3.0, (count, 3)) - down, omega, alpha
    wrench = non_contact_wrench(*motion, PHI) + OFFSETS + rng.normal(0.0, 0.1, (count, 6))
    wrench += np.repeat([150.0, 8.0], 3) * np.maximum(np.sin(0.7 * t + np.arange(6)), 0.0) ** 3
    rows = np.hstack([wrench, *motion, down])
    for value in (np.nan, np.inf, 1e7, 401.0):
        rows[rng.integers(0, count, count // 2000), rng.integers(0, 6, count // 2000)] = value
    # Series about as long as the time after which the low-pass restarts, 51 readings.
    for k, first in enumerate(rng.integers(0, count, count // 1000)):
        rows[first : first + 49 + k % 4, 7] = np.nan
    return rows


def compensated(rows: Array) -> Array:
    """Return outputs (N, 13) of `compensate`: contact wrench, scaled wrench, flags."""
    loop, out = TARGET.make_compensator(**SCALES), np.empty((len(rows), 13))
    for k, row in enumerate(rows):
        one = loop.step(Reading(k, DT * k, row[:15], gravity=row[15:]), DT * k)
        out[k, :6], out[k, 6:12], out[k, 12] = one.contact, one.scaled, one.flags
    return out


def replayed(folder: Path, compile_: list[str], run: list[str]) -> tuple[Array, float, int]:
    """Return outputs (N, 13) of compiled C for `folder`/in, ns per reading, and object bytes."""
    for name in ("wrench_compensator", "kernel_replay"):
        source = folder / f"{name}.c"
        subprocess.run(
            [*compile_, "-c", str(source), "-o", str(source.with_suffix(".o"))], check=True
        )
    objects = [str(folder / f"{name}.o") for name in ("wrench_compensator", "kernel_replay")]
    subprocess.run([*compile_, "-static", *objects, "-o", str(folder / "replay")], check=True)
    scales = [repr(value) for value in SCALES.values()]
    arguments = [*run, str(folder / "replay"), str(folder / "in"), str(folder / "out"), *scales]
    said = subprocess.run(arguments, check=True, capture_output=True, text=True).stdout
    return np.fromfile(folder / "out").reshape(-1, 13), float(said), object_size(folder)


def object_size(folder: Path) -> int:
    """Return the bytes of code and constants of the kernel's object file."""
    said = subprocess.run(
        ["size", str(folder / "wrench_compensator.o")], check=True, capture_output=True, text=True
    )
    return int(said.stdout.split("\n")[1].split()[0])


def in_node(folder: Path) -> tuple[Array, float, int]:
    """Return outputs (N, 13) of WebAssembly in node, ns per reading, and bytes of the module."""
    module = WASM["compiled"](TARGET)
    (folder / "kernel.wasm").write_bytes(module)
    (folder / "replay.js").write_text(NODE)
    tangent = math.tan(math.pi * 30.0 * DT)
    numbers = [repr(float(x)) for x in (*PHI, *OFFSETS, DT, tangent, *SCALES.values())]
    files = [str(folder / name) for name in ("replay.js", "kernel.wasm", "in", "out")]
    said = subprocess.run(["node", *files, *numbers], check=True, capture_output=True, text=True)
    return np.fromfile(folder / "out").reshape(-1, 13), float(said.stdout), len(module)


@njit(cache=True)
def python_loop(rows, largest, limits, offsets, phi, nothing, scales, low_pass, memory, rest, out):
    """Call the compiled Python kernel as the exported step does."""
    for k in range(len(rows)):
        if reading_problem(rows[k, :15], largest, limits) == 0:
            parts = rows[k, :15], rows[k, 15:]
            contact_and_scaled_wrench_into(
                *parts, offsets, phi, nothing, scales, low_pass, memory, rest, 0, out
            )
            clip_wrenches(out, limits)


def python_ns(rows: Array) -> float:
    """Return ns per reading of the compiled Python kernel: best of three."""
    s = TARGET.make_compensator().c_settings
    scales = np.array([1.2, 1.2, 1.3, -0.9])
    best = np.inf
    for _ in range(4):
        memory, rest, out = np.full((2, 12), np.nan), np.zeros((1, 21)), np.zeros(12)
        start = time.thread_time()
        python_loop(
            rows, s["largest"], s["range"], s["offsets"], s["phi"], np.zeros(10), scales,
            s["low_pass"], memory, rest, out,
        )  # fmt: skip
        best = min(best, time.thread_time() - start)
    return 1e9 * best / len(rows)


def prepared(folder: Path, rows: Array) -> None:
    """Write sources and readings into a folder."""
    for name, text in kernel_files(TARGET).items():
        (folder / name).write_text(str(text))
    shutil.copy(HERE / "kernel_replay.c", folder)
    rows.tofile(folder / "in")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--json", type=Path, help="file for the figures")
    parser.add_argument("--readings", type=int, default=1_000_000)
    options = parser.parse_args()
    rows = readings(options.readings)
    expected = compensated(rows)
    figures: dict[str, float] = {"python.ns": python_ns(rows)}
    compilers: list[tuple[str, list[str]]] = [("gcc", []), ("clang", [])]
    compilers.append(("aarch64-linux-gnu-gcc", ["qemu-aarch64"]))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        prepared(folder, rows)

        def note(key: str, found: tuple[Array, float, int]) -> None:
            different = (found[0].view(np.uint64) != expected.view(np.uint64)).any(axis=1).sum()
            values = int(different), round(found[1], 1), found[2]
            figures.update(
                zip((f"{key}.different", f"{key}.ns", f"{key}.bytes"), values, strict=True)
            )
            print(
                f"{key:28} different {values[0]}, {values[1]:6.1f} ns, {values[2]} bytes",
                flush=True,
            )

        print(f"python {figures['python.ns']:.1f} ns", flush=True)
        for compiler, run in compilers:
            if not all(map(shutil.which, (compiler, *run))):
                print(f"there is no {' with '.join([compiler, *run])} here")
                continue
            for level in (*LEVELS, "-Os"):
                note(f"{compiler}.{level}", replayed(folder, [compiler, *CFLAGS, level], run))
        fused = ["gcc", "-std=gnu99", "-O2", "-mfma", "-ffp-contract=fast"]
        if shutil.which("gcc"):
            note("gcc.-O2.fused", replayed(folder, fused, []))
        if shutil.which("node") and find_spec("ziglang"):
            note("wasm", in_node(folder))
    if options.json is not None:
        options.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
