"""Functional mock-up units (FMI 2.0 and 3.0, co-simulation) that compensate a load."""

from __future__ import annotations

import io
import platform
import shutil
import subprocess
import tempfile
import zipfile
from pathlib import Path
from uuid import NAMESPACE_URL, uuid5

from drake_teleop.robots.controller import c99

_MODEL_NAME = "wrench_compensator"
_WRENCH_COMPONENT_NAMES = ("f_x", "f_y", "f_z", "tau_x", "tau_y", "tau_z")
_PLATFORM_OF_FMI_VERSION = {"2.0": "linux64", "3.0": "x86_64-linux"}


def fmu_files(target: c99.ControllerTarget) -> c99.Files:
    """Return two FMUs: sources, and Linux binaries if there is a C compiler."""
    is_linux64 = platform.system() == "Linux" and platform.machine() == "x86_64"
    compiler = shutil.which("cc") if is_linux64 else None
    if compiler is None:
        target.notes.append("the FMUs contain sources only: there is no C compiler for linux64")
    kernel = dict(c99.kernel_files(target))
    token = str(uuid5(NAMESPACE_URL, "".join(map(str, kernel.values()))))
    kernel["token.h"] = f'#define TOKEN "{token}"\n'
    kernel["fmu.h"] = c99.read_template("fmu.h")
    return {
        f"{_MODEL_NAME}_fmi{version[0]}.fmu": _fmu_archive(target, kernel, version, token, compiler)
        for version in ("2.0", "3.0")
    }


def _fmu_archive(
    target: c99.ControllerTarget, kernel: c99.Files, version: str, token: str, cc: str | None
) -> bytes:
    sources = {**kernel, f"fmi{version[0]}.c": c99.read_template(f"fmi{version[0]}.c")}
    files: dict[str, str | bytes] = {f"sources/{name}": text for name, text in sources.items()}
    c_files = [name for name in sources if name.endswith(".c")]
    files["modelDescription.xml"] = _model_description(target, version, token)
    if version == "3.0":
        files["sources/buildDescription.xml"] = c99.read_template("buildDescription.xml")
    if cc is not None:
        binary = f"binaries/{_PLATFORM_OF_FMI_VERSION[version]}/{_MODEL_NAME}.so"
        files[binary] = _compile_library(cc, sources, c_files)
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            archive.writestr(zipfile.ZipInfo(name), data, zipfile.ZIP_DEFLATED)  # without the time
    return content.getvalue()


def _compile_library(compiler: str, sources: c99.Files, c_files: list[str]) -> bytes:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for file, text in sources.items():
            (folder / file).write_text(str(text), encoding="utf-8")
        options = [*c99.CFLAGS, "-shared", "-fPIC", "-fvisibility=hidden", "-s"]
        subprocess.run([compiler, *options, *c_files, "-o", "library.so"], cwd=folder, check=True)
        return (folder / "library.so").read_bytes()


def _model_description(target: c99.ControllerTarget, version: str, token: str) -> str:
    number, integer = ("Float64", "Int32") if version == "3.0" else ("Real", "Integer")
    variables = []
    for name, causality, unit, start in _model_variables(target):
        values = "" if start is None else f' start="{start!r}"'
        values += f' unit="{unit}"' if unit else ""
        variability = "tunable" if causality == "parameter" else "discrete"
        kind = integer if name == "flags" else number
        variables.append((name, causality, variability, kind, values))
    outputs = [k for k, variable in enumerate(variables) if variable[1] == "output"]
    names = {"token": token, "dt": repr(target.dt), "variables": variables, "outputs": outputs}
    return c99.render_template(f"modelDescription{version[0]}.xml", **names)


def _model_variables(target: c99.ControllerTarget) -> list[tuple[str, str, str, float | None]]:
    wrench = [(name, "N" if name.startswith("f") else "N.m") for name in _WRENCH_COMPONENT_NAMES]
    vectors = (("s", "m/s2"), ("omega", "rad/s"), ("alpha", "rad/s2"), ("gravity", "m/s2"))
    motion = [(f"{name}_{axis}", unit) for name, unit in vectors for axis in "xyz"]
    found = target.make_compensator().c_settings
    phi_units = ["kg", *["kg.m"] * 3, *["kg.m2"] * 6]
    phi_names = ("m", "mc_x", "mc_y", "mc_z", "I_xx", "I_xy", "I_xz", "I_yy", "I_yz", "I_zz")
    phi = zip(phi_names, phi_units, found["phi"], strict=True)
    offsets = zip(wrench, found["offsets"], strict=True)
    return [
        *((name, "input", unit, 0.0) for name, unit in (*wrench, *motion)),
        *((f"contact_{name}", "output", unit, None) for name, unit in wrench),
        *((f"scaled_{name}", "output", unit, None) for name, unit in wrench),
        ("flags", "output", "", None),
        ("sigma_weight", "parameter", "", 0.0),
        ("sigma_inertia", "parameter", "", 0.0),
        ("gamma", "parameter", "", 1.0),
        *((name, "parameter", unit, float(value)) for name, unit, value in phi),
        *((f"offset_{name}", "parameter", unit, float(x)) for (name, unit), x in offsets),
    ]
