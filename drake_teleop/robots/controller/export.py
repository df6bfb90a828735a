"""Export of an identified load with code that compensates it: C99, FMU, or filter of ros2_control.

FMUs are functional mock-up units for co-simulation, FMI 2.0 and 3.0.
"""

from __future__ import annotations

import io
import platform
import shutil
import subprocess
import tempfile
import zipfile
from collections.abc import Callable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple
from uuid import NAMESPACE_URL, uuid5

import numpy as np
from markupsafe import Markup

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.files import make_folder, replace_file_on_success
from drake_teleop.common.html import render_page
from drake_teleop.common.numeric import Array
from drake_teleop.common.version import __version__
from drake_teleop.load.identification import Identification
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.logs.processing import notes_on_undetermined_load
from drake_teleop.robots.compensator import STALE_AGE_S, Compensator
from drake_teleop.robots.export import refuse_removed_weight, unused_sensor_pose_error
from drake_teleop.robots.streams import NUM_READING_VALUES, Reading

TEMPLATE_PACKAGE = "drake_teleop.robots.controller"
CFLAGS = ("-std=c99", "-O2", "-ffp-contract=off")
"""Options of a C compiler for results that are bit-equal to those of Python."""
_TEST_VECTOR_SCALES = {"sigma_weight": 0.25, "sigma_inertia": 1.5, "gamma": 0.75}
_NUM_TEST_READINGS = 1000
_TEST_WRENCH_AMPLITUDES = np.repeat([1.0, 0.05], 3)
_FMU_MODEL_NAME = "wrench_compensator"
_WRENCH_COMPONENT_NAMES = ("f_x", "f_y", "f_z", "tau_x", "tau_y", "tau_z")
_FMU_BINARY_FOLDER_OF_FMI_VERSION = {"2.0": "linux64", "3.0": "x86_64-linux"}
_ROS2_FILTER_PACKAGE_NAME = "wrench_compensator_filter"
_ROS2_FILTER_TEMPLATE_FOLDER = "ros2_filter"

ExportedFiles = Mapping[str, str | bytes]


class ExportedCompensation(NamedTuple):
    """Load, rate, low-pass and sensor range of an export.

    Attributes:
        dt: period of the readings [s].
        sign: -1 if the sensor reports the wrench of the load on the sensor, else 1.
        notes: warnings for the user.
    """

    load: Identification
    dt: float
    cutoff_hz: float | None
    sensor_range: Array | None
    sign: int
    notes: list[str]

    def settings_initializer(self, **scales: Any) -> str:
        """Return the C initializer of `wrench_compensator_settings`, in the order of its fields."""
        others = self.make_compensator(**scales).c_settings
        values = {name: others.pop(name) for name in ("phi", "offsets")}
        values |= {"sigma_weight": 0.0, "sigma_inertia": 0.0, "gamma": 1.0, **scales, **others}
        return "".join(f"    {_c_literal(each)}, /* {name} */\n" for name, each in values.items())

    def make_compensator(self, **scales: Any) -> Compensator:
        load, dt, cutoff_hz, sensor_range, *_ = self
        return Compensator(load, dt, cutoff_hz=cutoff_hz, sensor_range=sensor_range, **scales)


def c99_files(target: ExportedCompensation) -> ExportedFiles:
    rate, period = f"{1.0 / target.dt:g}", f"{target.dt:g}"
    numbers = {"rate": rate, "period": period, "count": _NUM_TEST_READINGS}
    return {
        **kernel_files(target),
        "test_vector.h": _render_test_vector_header(target),
        "test_wrench_compensator.c": read_template("test_wrench_compensator.c"),
        "CMakeLists.txt": read_template("CMakeLists.txt"),
        "README.md": render_template("README.c99.md", notes=target.notes, **numbers),
    }


def kernel_files(target: ExportedCompensation) -> ExportedFiles:
    settings, dt = target.settings_initializer(), repr(target.dt)
    return {
        "wrench_compensator.h": read_template("wrench_compensator.h"),
        "wrench_compensator.c": render_template("wrench_compensator.c"),
        "load.h": render_template("load.h", dt=dt, settings=settings, notes=target.notes),
    }


def read_template(name: str) -> str:
    return resources.files(TEMPLATE_PACKAGE).joinpath(f"templates/{name}").read_text("utf-8")


def render_template(name: str, **values: Any) -> str:
    """Return a shipped template with inserted values; nothing is escaped."""

    def keep_unescaped(value: Any) -> Any:
        if isinstance(value, (list, tuple)):
            return [keep_unescaped(each) for each in value]
        return Markup(value) if isinstance(value, str) else value

    values = {key: keep_unescaped(value) for key, value in values.items()}
    values.setdefault("version", __version__)
    return render_page(TEMPLATE_PACKAGE, f"templates/{name}.j2", **values) + "\n"


def _render_test_vector_header(target: ExportedCompensation) -> str:
    inputs, sensor_range = _simulated_readings_and_sensor_range(target)
    target = target._replace(sensor_range=sensor_range)
    python = target.make_compensator(**_TEST_VECTOR_SCALES)
    outputs = [
        python.step(Reading(k, t, row[:NUM_READING_VALUES], gravity=row[NUM_READING_VALUES:]), t)
        for k, (t, row) in enumerate(zip(target.dt * np.arange(len(inputs)), inputs, strict=True))
    ]
    return render_template(
        "test_vector.h",
        settings=target.settings_initializer(**_TEST_VECTOR_SCALES),
        inputs=[_c_literal(row) for row in inputs],
        outputs=[_c_literal(np.concatenate([out.contact, out.scaled])) for out in outputs],
        flags="{" + ", ".join(str(out.flags) for out in outputs) + "}",
    )


def _simulated_readings_and_sensor_range(target: ExportedCompensation) -> tuple[Array, Array]:
    phase = 2.0 * np.pi * np.arange(_NUM_TEST_READINGS)[:, None] / _NUM_TEST_READINGS
    omega = np.sin(3.0 * phase + [0.0, 1.0, 2.0])
    alpha = 6.0 * np.cos(5.0 * phase + [2.0, 1.0, 0.0])
    down = np.array([3.0, -4.0, -8.0]) + omega
    motion = 5.0 * alpha - down, omega, alpha
    contact = 40.0 * np.maximum(np.sin(4.0 * phase + np.arange(6.0)), 0.0) * _TEST_WRENCH_AMPLITUDES
    wrench = non_contact_wrench(*motion, target.load.phi) + target.load.offsets + contact
    readings = np.round(np.hstack([wrench, *motion, down]), 6)
    sensor_range = 0.95 * np.abs(readings[:, :6]).max(axis=0)
    readings[100:103, 7], readings[200, 0], readings[201, 12] = np.nan, np.inf, 1e7
    first = _NUM_TEST_READINGS // 2
    readings[first : first + round(2.0 * STALE_AGE_S / target.dt) + 2, 5] = np.nan
    return readings, sensor_range


def _c_literal(value: Any) -> str:
    if isinstance(value, np.ndarray):
        text = ", ".join(repr(float(x)) for x in value)
        return "{" + text.replace("nan", "NAN").replace("inf", "INFINITY") + "}"
    return repr(value)


def fmu_files(target: ExportedCompensation) -> ExportedFiles:
    """Return FMUs for FMI 2 and 3, with sources, and Linux binaries if `cc` exists."""
    is_linux64 = platform.system() == "Linux" and platform.machine() == "x86_64"
    compiler = shutil.which("cc") if is_linux64 else None
    if compiler is None:
        target.notes.append("the FMUs contain sources only: there is no C compiler for linux64")
    kernel = dict(kernel_files(target))
    token = str(uuid5(NAMESPACE_URL, "".join(map(str, kernel.values()))))
    kernel["token.h"] = f'#define TOKEN "{token}"\n'
    kernel["fmu.h"] = read_template("fmu.h")
    return {
        f"{_FMU_MODEL_NAME}_fmi{version[0]}.fmu": _zip_fmu(target, kernel, version, token, compiler)
        for version in ("2.0", "3.0")
    }


def _zip_fmu(
    target: ExportedCompensation, kernel: ExportedFiles, version: str, token: str, cc: str | None
) -> bytes:
    sources = {**kernel, f"fmi{version[0]}.c": read_template(f"fmi{version[0]}.c")}
    files: dict[str, str | bytes] = {f"sources/{name}": text for name, text in sources.items()}
    c_files = [name for name in sources if name.endswith(".c")]
    files["modelDescription.xml"] = _render_fmi_model_description(target, version, token)
    if version == "3.0":
        files["sources/buildDescription.xml"] = read_template("buildDescription.xml")
    if cc is not None:
        binary = f"binaries/{_FMU_BINARY_FOLDER_OF_FMI_VERSION[version]}/{_FMU_MODEL_NAME}.so"
        files[binary] = _compile_shared_library(cc, sources, c_files)
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            archive.writestr(zipfile.ZipInfo(name), data, zipfile.ZIP_DEFLATED)  # without the time
    return content.getvalue()


def _compile_shared_library(compiler: str, sources: ExportedFiles, c_files: list[str]) -> bytes:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for file, text in sources.items():
            (folder / file).write_text(str(text), encoding="utf-8")
        options = [*CFLAGS, "-shared", "-fPIC", "-fvisibility=hidden", "-s"]
        try:
            subprocess.run([compiler, *options, *c_files, "-o", "library.so"], cwd=name, check=True)
        except (OSError, subprocess.CalledProcessError) as error:
            remedy = "correct it, or remove it from PATH for FMUs with sources only"
            raise DrakeTeleopError(str(error), where="C compiler", remedy=remedy) from error
        return (folder / "library.so").read_bytes()


def _render_fmi_model_description(target: ExportedCompensation, version: str, token: str) -> str:
    number, integer = ("Float64", "Int32") if version == "3.0" else ("Real", "Integer")
    variables = []
    for name, causality, unit, start in _fmi_variables(target):
        values = "" if start is None else f' start="{start!r}"'
        values += f' unit="{unit}"' if unit else ""
        variability = "tunable" if causality == "parameter" else "discrete"
        kind = integer if name == "flags" else number
        variables.append((name, causality, variability, kind, values))
    outputs = [k for k, variable in enumerate(variables) if variable[1] == "output"]
    names = {"token": token, "dt": repr(target.dt), "variables": variables, "outputs": outputs}
    return render_template(f"modelDescription{version[0]}.xml", **names)


def _fmi_variables(target: ExportedCompensation) -> list[tuple[str, str, str, float | None]]:
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


def ros2_filter_files(target: ExportedCompensation) -> ExportedFiles:
    name, folder = _ROS2_FILTER_PACKAGE_NAME, _ROS2_FILTER_TEMPLATE_FOLDER
    shipped = (f"{name}.xml", "package.xml", "CMakeLists.txt", f"src/{name}.cpp")
    kernel = dict(kernel_files(target))
    sign = f"#define WRENCH_COMPENSATOR_SIGN {target.sign}.0\n\n#endif"
    kernel["load.h"] = sign.join(str(kernel["load.h"]).rsplit("#endif", 1))
    values = {"rate": f"{1.0 / target.dt:g}", "sign": str(target.sign), "notes": target.notes}
    return {
        **{file: read_template(f"{folder}/{Path(file).name}") for file in shipped},
        **{f"src/{name}": text for name, text in kernel.items()},
        "README.md": render_template(f"{folder}/README.md", **values),
    }


CONTROLLER_FORMATS: dict[str, Callable[[ExportedCompensation], ExportedFiles]] = {
    "c99": c99_files,
    "fmu": fmu_files,
    "ros2_filter": ros2_filter_files,
}
"""Functions that return the files of a format."""


def export_controller(
    found: Identification,
    to: str,
    out: Path,
    *,
    rate_hz: float | None,
    cutoff_hz: float | None = 30.0,
    sensor_range: tuple[float, float] | None = None,
    sensor_pose: Sequence[float] | None = None,
    sign: int = -1,
) -> list[str]:
    """Write the files of the format `to` into the folder `out`; return warnings.

    `sign` is -1 if the sensor reports the wrench of load on sensor (usual), else 1.
    """
    if rate_hz is None:
        what, remedy = f"is missing, but required by {to}", "give the readings' rate in Hz"
        raise DrakeTeleopError(what, where="--rate", remedy=remedy)
    if sensor_pose is not None:
        raise unused_sensor_pose_error(to)
    refuse_removed_weight(found, to)
    notes = list(notes_on_undetermined_load(found))
    if sensor_range is None:
        notes.append("no range of the sensor was given: saturation is not detected; give --range")
    whole = None if sensor_range is None else np.repeat(np.array(sensor_range, float), 3)
    target = ExportedCompensation(found, 1.0 / rate_hz, cutoff_hz, whole, sign, notes)
    for name, content in CONTROLLER_FORMATS[to](target).items():
        path = out / name
        make_folder(path.parent)
        with replace_file_on_success(path) as temporary:
            data = content.encode() if isinstance(content, str) else content
            temporary.write_bytes(data)
    return notes
