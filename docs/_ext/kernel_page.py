"""The compensation kernel as WebAssembly, in the page `compensate.html` of the site.

The same C code as `drake-teleop export --to c99` is compiled by the clang of `ziglang` (extra
`docs`). The page contains it, and loads nothing.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from drake_teleop.robots.controller.c99 import CFLAGS, Target, kernel_files

STEP = """
#include "load.h"

static wrench_compensator c;
double reading[18], result[12];

/* The load of load.h. */
__attribute__((export_name("start"))) void start(
    double dt, double weight, double inertia, double gamma) {
  wrench_compensator_settings settings = wrench_compensator_load;
  (void)dt;
  settings.sigma_weight = weight;
  settings.sigma_inertia = inertia;
  settings.gamma = gamma;
  wrench_compensator_init(&c, &settings);
}

__attribute__((export_name("step"))) unsigned step(void) {
  return wrench_compensator_step(&c, reading, reading + 6, reading + 9, reading + 12, reading + 15,
                                 result, result + 6);
}
"""
_OPTIONS = (
    *("-target", "wasm32-freestanding", "-nostdlib", "-s", "-Wl,--no-entry"),
    *("-Wl,--export=reading", "-Wl,--export=result"),
)


def compiled(target: Target) -> bytes:
    """WebAssembly of the kernel with a load."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for file, text in kernel_files(target).items():
            (folder / file).write_text(str(text))
        (folder / "step.c").write_text(STEP)
        sources = [str(folder / file) for file in ("wrench_compensator.c", "step.c")]
        command = [sys.executable, "-m", "ziglang", "cc", *CFLAGS, *_OPTIONS, *sources]
        subprocess.run([*command, "-o", str(folder / "kernel.wasm")], check=True)
        return (folder / "kernel.wasm").read_bytes()
