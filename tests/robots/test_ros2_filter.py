"""`export --to ros2_filter`: the plugin, compiled against stubs of ROS 2, has Python's numbers."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from drake_teleop.robots.controller.export import export_controller
from drake_teleop.robots.streams import Reading

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
import kernel

HERE = Path(__file__).parent
RATE, DT = 1000.0, 1e-3
CXX = shutil.which("c++") or ""
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not CXX, reason="there is no C++ compiler here"),
]


@pytest.fixture(scope="module")
def package(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("ros2")
    export_controller(kernel.LOAD, "ros2_filter", out, rate_hz=RATE, sensor_range=(170.0, 9.0))
    strict = ["-Wall", "-Wextra", "-Werror", "-O1", "-ffp-contract=off"]
    source = out / "src"
    subprocess.run(
        ["cc", "-std=c99", *strict, "-c", "wrench_compensator.c"], cwd=source, check=True
    )
    sources = ["wrench_compensator_filter.cpp", str(HERE / "ros2_filter_run.cpp")]
    stubs = ["-isystem", str(HERE / "ros2_stubs")]
    command = [CXX, "-std=c++17", *strict, *stubs, *sources, "wrench_compensator.o", "-pthread"]
    subprocess.run([*command, "-o", str(out / "run")], cwd=source, check=True)
    return out


def filtered(package: Path, rows: np.ndarray, with_imu: np.ndarray, *arguments: str) -> np.ndarray:
    """Return the output (N, 6) for rows of specific force, angular velocity and wrench (N, 12)."""
    lines = "\n".join(
        f"{k // 1000} {k % 1000 * 1_000_000} {int(imu)} " + " ".join(map(repr, map(float, row)))
        for k, (row, imu) in enumerate(zip(rows, with_imu, strict=True))
    )
    command = [str(package / "run"), *arguments]
    said = subprocess.run(command, input=lines, capture_output=True, text=True, check=True).stdout
    return np.array([list(map(float, line.split())) for line in said.splitlines()])


def inputs(count: int) -> np.ndarray:
    rows = kernel.readings(count, seed=7)
    rows[~np.isfinite(rows)] = 0.5
    return np.hstack([rows[:, 6:12], -rows[:, :6]])  # the sensor has the opposite sign


def by_python(rows: np.ndarray, **scales: float) -> tuple[np.ndarray, np.ndarray]:
    """Return contact and scaled wrench, both with the sign of the sensor."""
    loop = kernel.TARGET._replace(dt=DT).make_compensator(**scales)
    t = np.array([k // 1000 + 1e-9 * (k % 1000 * 1_000_000) for k in range(len(rows))])
    alpha = np.zeros((len(rows), 3))
    alpha[1:] = np.diff(rows[:, 3:6], axis=0) / np.diff(t)[:, None]
    values = np.hstack([-rows[:, 6:], rows[:, :6], alpha])
    out = [loop.step(Reading(k, DT * k, row), DT * k) for k, row in enumerate(values)]
    return -np.array([x.contact for x in out]), -np.array([x.scaled for x in out])


def test_output_has_the_bits_of_python(package):
    rows = inputs(2000)
    contact, scaled = by_python(rows, sigma=0.4, gamma=0.8)
    always = np.ones(len(rows), bool)
    assert (filtered(package, rows, always) == contact).all()
    found = filtered(package, rows, always, "scaled", "sigma=0.4", "gamma=0.8")
    assert (found == scaled).all()
    assert np.abs(contact).max() > 10.0 and not (scaled == contact).all(axis=1).all()


def test_sign_is_a_parameter(package):
    rows = inputs(200)
    opposite = rows * np.repeat([1.0, -1.0], 6)
    always = np.ones(len(rows), bool)
    assert (filtered(package, opposite, always, "sign=1") == -filtered(package, rows, always)).all()


def test_wrench_is_zero_without_motion_for_50_ms(package):
    rows = inputs(400)
    with_imu = np.ones(len(rows), bool)
    with_imu[:10] = with_imu[100:300] = False
    zero = ~filtered(package, rows, with_imu).any(axis=1)
    assert zero[:10].all() and not zero[10:149].any()
    assert zero[150:300].all() and not zero[300:].any()


@pytest.mark.parametrize("silent", [120, 700])
def test_low_pass_restarts_after_a_silence_of_the_imu(package, silent):
    """The wrench after the silence is independent of the one before."""
    rows, first = inputs(1200), 200
    with_imu = np.ones(len(rows), bool)
    with_imu[first : first + silent] = False
    other = rows.copy()
    other[:first, 6:] += 20.0
    after = slice(first + silent, None)
    found, expected = (filtered(package, each, with_imu)[after] for each in (rows, other))
    assert found.any(axis=1).all() and (found == expected).all()


def test_tare_removes_a_shift_of_the_offsets(package):
    count = 1500
    rows = np.tile([0.0, 0.0, 9.81, *[0.0] * 9], (count, 1))
    load = kernel.non_contact_wrench(rows[:, :3], rows[:, 3:6], rows[:, 3:6], kernel.PHI)
    noise = np.random.default_rng(0).normal(0.0, 1e-3, (count, 6))
    rows[:, 6:] = -(load + kernel.OFFSETS + [2.0, 0, 0, 0.1, 0, 0] + noise)
    always = np.ones(count, bool)
    assert abs(filtered(package, rows, always)[-1, 0] + 2.0) < 0.01
    assert np.abs(filtered(package, rows, always, "tare")[-1]).max() < 0.01


def test_package_names_the_library_and_its_dependencies(package):
    library = ElementTree.parse(package / "wrench_compensator_filter.xml").find("library")
    assert library is not None
    cmake = (package / "CMakeLists.txt").read_text()
    assert f"project({library.get('path')} C CXX)" in cmake
    code = (package / "src" / "wrench_compensator_filter.cpp").read_text()
    described = library.find("class").attrib
    assert described["type"] in code and described["base_class_type"] in code
    depends = {x.text for x in ElementTree.parse(package / "package.xml").findall("depend")}
    assert f"DEPENDENCIES {' '.join(sorted(depends))})" in cmake


@pytest.mark.parametrize("sign", [-1, 1])
def test_defaults_in_the_readme_are_floating_point_as_in_the_code(tmp_path, sign):
    """ROS 2 refuses the integer 1 for a parameter of type double."""
    export_controller(kernel.LOAD, "ros2_filter", tmp_path, rate_hz=RATE, sign=sign)
    text = (tmp_path / "README.md").read_text()
    assert "| 0.0, 1.0 |" in text and f"| {sign}.0 |" in text
    assert f"WRENCH_COMPENSATOR_SIGN {sign}.0\n" in (tmp_path / "src" / "load.h").read_text()
