"""`export --to fmu`: FMPy accepts the units, and they have the bits of `compensate`."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.robots.controller.export import export_controller

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
import kernel

VERSIONS = ("fmi2", "fmi3")
WRENCH = ("f_x", "f_y", "f_z", "tau_x", "tau_y", "tau_z")
INPUTS = [*WRENCH, *(f"{v}_{a}" for v in ("s", "omega", "alpha", "gravity") for a in "xyz")]
OUTPUTS = [*(f"{group}_{name}" for group in ("contact", "scaled") for name in WRENCH), "flags"]
needs_cc = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler here")


@pytest.fixture(scope="module")
def units(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("fmu")
    export_controller(kernel.LOAD, "fmu", out, rate_hz=1024.0, sensor_range=(170.0, 9.0))
    return out


def simulated(unit: Path, rows: np.ndarray, step_size: float = kernel.DT) -> np.ndarray:
    fmpy = pytest.importorskip("fmpy")
    count = len(rows)
    table = np.zeros(count, dtype=[("time", float), *((name, float) for name in INPUTS)])
    table["time"] = kernel.DT * np.arange(count)
    for k, name in enumerate(INPUTS):
        table[name] = rows[:, k]
    found = fmpy.simulate_fmu(
        str(unit),
        start_values=dict(kernel.SCALES),
        input=table,
        output=OUTPUTS,
        stop_time=count * kernel.DT,
        step_size=step_size,
        output_interval=step_size,
    )
    return np.column_stack([found[name].astype(float) for name in OUTPUTS])


@needs_cc
@pytest.mark.slow
@pytest.mark.parametrize("version", VERSIONS)
def test_fmpy_validates_and_simulates_the_bits_of_compensate_one_step_later(units, version):
    validation = pytest.importorskip("fmpy.validation")
    unit = units / f"wrench_compensator_{version}.fmu"
    assert validation.validate_fmu(str(unit)) == []
    rows = kernel.readings(3000, seed=5)
    found = simulated(unit, rows)
    expected = kernel.compensated(rows)
    assert len(found) == len(rows) + 1
    assert not found[0].any()
    assert found[1:].tobytes() == expected.tobytes()


@needs_cc
@pytest.mark.slow
@pytest.mark.parametrize("version", VERSIONS)
def test_another_step_size_is_an_error(units, version):
    unit = units / f"wrench_compensator_{version}.fmu"
    with pytest.raises(Exception, match="DoStep"):
        simulated(unit, kernel.readings(3000, seed=5), 2.0 * kernel.DT)


@needs_cc
@pytest.mark.parametrize("version", VERSIONS)
def test_each_function_of_the_standard_is_exported(units, version, tmp_path):
    fmpy = pytest.importorskip("fmpy")
    header = Path(fmpy.__file__).parent / "c-code" / f"{version}Functions.h"
    required = set(re.findall(rf"{version}\w+TYPE\s+({version}\w+);", header.read_text()))
    if version == "fmi2":  # those of model exchange may be absent
        required -= set(
            re.findall(
                r"fmi2\w*(?:Event|Discrete|Continuous|Derivatives)\w*|fmi2SetTime|fmi2CompletedIntegratorStep",
                header.read_text(),
            )
        )
        required |= {"fmi2GetRealOutputDerivatives", "fmi2SetRealInputDerivatives"}
    assert len(required) > 30
    with zipfile.ZipFile(units / f"wrench_compensator_{version}.fmu") as archive:
        archive.extractall(tmp_path)
    (library,) = tmp_path.rglob("*.so")
    listed = subprocess.run(["nm", "-D", library], check=True, capture_output=True, text=True)
    exported = {line.split()[-1] for line in listed.stdout.splitlines() if " T " in line}
    assert exported == required


def test_without_a_compiler_the_units_contain_sources(monkeypatch, tmp_path):
    monkeypatch.setattr(shutil, "which", lambda _: None)
    notes = export_controller(kernel.LOAD, "fmu", tmp_path, rate_hz=500.0, sensor_range=(170, 9.0))
    assert notes == ["the FMUs contain sources only: there is no C compiler for linux64"]
    for version in VERSIONS:
        with zipfile.ZipFile(tmp_path / f"wrench_compensator_{version}.fmu") as archive:
            names = set(archive.namelist())
        assert {"modelDescription.xml", "sources/wrench_compensator.c"} <= names
        assert not any(name.endswith(".so") for name in names)


def test_failing_compiler_is_one_error_and_nothing_is_written(monkeypatch, tmp_path):
    monkeypatch.setattr(shutil, "which", lambda _: "false")
    with pytest.raises(DrakeTeleopError, match=r"^C compiler: .* remove it from PATH for FMUs"):
        export_controller(kernel.LOAD, "fmu", tmp_path / "fmu", rate_hz=500.0)
    assert not (tmp_path / "fmu").exists()


@pytest.mark.slow
def test_parameters_start_with_the_identified_load(units):
    with zipfile.ZipFile(units / "wrench_compensator_fmi2.fmu") as archive:
        root = ElementTree.fromstring(archive.read("modelDescription.xml"))
    parameters = [
        each for each in root.iter("ScalarVariable") if each.get("causality") == "parameter"
    ]
    starts = {each.get("name"): float(each[0].get("start")) for each in parameters}
    names = ["sigma_weight", "sigma_inertia", "gamma", "m", "mc_x", "mc_y", "mc_z"]
    assert [*starts][:7] == names and [*starts][-6:-3] == [f"offset_f_{k}" for k in "xyz"]
    expected = [0.0, 0.0, 1.0, *kernel.LOAD.phi, *kernel.LOAD.offsets]
    np.testing.assert_allclose([*starts.values()], expected)


def test_the_same_load_gives_the_same_bytes(units, tmp_path):
    export_controller(kernel.LOAD, "fmu", tmp_path, rate_hz=1024.0, sensor_range=(170.0, 9.0))
    for path in units.iterdir():
        assert path.read_bytes() == (tmp_path / path.name).read_bytes()
