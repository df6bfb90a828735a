"""The compensation kernel as WebAssembly, for the page `browser.md`.

The clang of `ziglang` (extra `docs`) compiles the C code of `drake-teleop export --to c99` into
`_static/kernel.js`. The page loads this file from the site or from disk.
"""

from __future__ import annotations

import base64
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from drake_teleop.load.identification import Identification
from drake_teleop.robots.controller.export import CFLAGS, ExportedCompensation, kernel_files

if TYPE_CHECKING:
    from sphinx.application import Sphinx

STEP = """\
#include "load.h"

static wrench_compensator c;
double load[16], reading[18], result[12];

/* load: phi, offsets. tangent: tan(pi cutoff dt); 0: no low-pass. */
__attribute__((export_name("start")))
void start(double dt, double tangent, double weight, double inertia, double gamma) {
  wrench_compensator_settings s = wrench_compensator_load;
  int i;
  for (i = 0; i < 10; ++i) s.phi[i] = load[i];
  for (i = 0; i < 6; ++i) s.offsets[i] = load[10 + i];
  s.sigma_weight = weight;
  s.sigma_inertia = inertia;
  s.gamma = gamma;
  s.low_pass_count = tangent > 0.0 ? 7 : 0;
  wrench_compensator_low_pass(dt, tangent, 0.0, s.low_pass);
  wrench_compensator_init(&c, &s);
}

__attribute__((export_name("step"))) unsigned step(void) {
  return wrench_compensator_step(&c, reading, reading + 6, reading + 9, reading + 12, reading + 15,
                                 result, result + 6);
}
"""
_EXPORTS = [f"-Wl,--export={name}" for name in ("load", "reading", "result")]
_TARGET = ("-target", "wasm32-freestanding", "-nostdlib", "-s", "-Wl,--no-entry")
# The page sets load and low-pass.
_ANY_LOAD = ExportedCompensation(
    Identification(
        *(np.ones(10), np.zeros(6), np.zeros((16, 16)), np.ones(16, bool), 1.0, 0.0, np.zeros(6)),
        *("none", 0),
    ),
    *(1e-3, None, None, 1, []),
)


def compiled(target: ExportedCompensation = _ANY_LOAD) -> bytes:
    """Return the kernel as WebAssembly, with the limits of `target`."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for file, text in {**kernel_files(target), "step.c": STEP}.items():
            (folder / file).write_text(str(text))
        command = [sys.executable, "-m", "ziglang", "cc", *CFLAGS, *_TARGET, *_EXPORTS]
        command += ["wrench_compensator.c", "step.c", "-o", "kernel.wasm"]
        subprocess.run(command, cwd=folder, check=True)
        return (folder / "kernel.wasm").read_bytes()


def script() -> str:
    """Return JavaScript that contains the module: a page on disk cannot fetch other files."""
    return f'const KERNEL = "{base64.b64encode(compiled()).decode()}";\n'


def setup(app: Sphinx) -> dict[str, Any]:
    """Write the script into the site."""
    app.connect("build-finished", _write)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def _write(app: Sphinx, exception: Exception | None) -> None:
    if exception is None and app.builder.format == "html":
        (Path(app.outdir) / "_static" / "kernel.js").write_text(script())
