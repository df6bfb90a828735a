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
from xml.etree.ElementTree import Element, SubElement

from drake_teleop.common.version import __version__
from drake_teleop.robots.controller import c99
from drake_teleop.robots.export import indented_xml

_MODEL_NAME, _XML_HEAD = "wrench_compensator", '<?xml version="1.0" encoding="UTF-8"?>\n'
_WRENCH_COMPONENT_NAMES = ("f_x", "f_y", "f_z", "tau_x", "tau_y", "tau_z")
_UNIT_EXPONENTS = {
    "N": {"kg": "1", "m": "1", "s": "-2"},
    "N.m": {"kg": "1", "m": "2", "s": "-2"},
    "m/s2": {"m": "1", "s": "-2"},
    "rad/s": {"rad": "1", "s": "-1"},
    "rad/s2": {"rad": "1", "s": "-2"},
    "kg": {"kg": "1"},
    "kg.m": {"kg": "1", "m": "1"},
    "kg.m2": {"kg": "1", "m": "2"},
}
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
    files["modelDescription.xml"] = _model_description(target, version, token, c_files)
    if version == "3.0":
        build = Element("fmiBuildDescription", fmiVersion="3.0")
        configuration = SubElement(build, "BuildConfiguration", modelIdentifier=_MODEL_NAME)
        group = SubElement(configuration, "SourceFileSet", language="C99")
        for name in c_files:
            SubElement(group, "SourceFile", name=name)
        files["sources/buildDescription.xml"] = _XML_HEAD + indented_xml(build)
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


def _model_description(
    target: c99.ControllerTarget, version: str, token: str, c_files: list[str]
) -> str:
    new = version == "3.0"
    root = Element(
        "fmiModelDescription",
        {
            "fmiVersion": version,
            "modelName": _MODEL_NAME,
            "instantiationToken" if new else "guid": token,
            "description": "Wrist wrench without weight and inertia of the load",
            "generationTool": f"drake_teleop {__version__}",
        },
    )
    simulation = SubElement(root, "CoSimulation", modelIdentifier=_MODEL_NAME)
    if new:
        simulation.set("fixedInternalStepSize", repr(target.dt))
    else:
        files = SubElement(simulation, "SourceFiles")
        for name in c_files:
            SubElement(files, "File", name=name)
    units = SubElement(root, "UnitDefinitions")
    for unit, base in _UNIT_EXPONENTS.items():
        SubElement(SubElement(units, "Unit", name=unit), "BaseUnit", base)
    SubElement(root, "DefaultExperiment", stepSize=repr(target.dt))
    variables = SubElement(root, "ModelVariables")
    listed = _model_variables(target)
    for reference, (name, causality, unit, start) in enumerate(listed):
        common = {"name": name, "valueReference": str(reference), "causality": causality}
        common["variability"] = "tunable" if causality == "parameter" else "discrete"
        values = {} if start is None else {"start": repr(start)}
        values |= {"unit": unit} if unit else {}
        if new:
            SubElement(variables, "Int32" if name == "flags" else "Float64", common | values)
        else:
            variable = SubElement(variables, "ScalarVariable", common)
            SubElement(variable, "Integer" if name == "flags" else "Real", values)
    if new:
        time = {"name": "time", "valueReference": str(len(listed)), "causality": "independent"}
        SubElement(variables, "Float64", time | {"variability": "continuous"})
    outputs = [k for k, variable in enumerate(listed) if variable[1] == "output"]
    structure = SubElement(root, "ModelStructure")
    for tag in ("Output", "InitialUnknown"):
        group = structure if new else SubElement(structure, f"{tag}s")
        for k in outputs:
            if new:
                SubElement(group, tag, valueReference=str(k))
            else:
                SubElement(group, "Unknown", index=str(k + 1))
    return _XML_HEAD + indented_xml(root)


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
