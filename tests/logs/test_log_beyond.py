"""Damaged files and values out of range: each raises one line."""

from __future__ import annotations

import io
import zipfile

import numpy as np
import pytest
from numpy.lib import format as npy

from drake_teleop.common.errors import MAX_ERROR_LINE_LENGTH, DrakeTeleopError
from drake_teleop.load.batch.methods import identify_batch
from drake_teleop.load.contact.detection import fit_noise_floor
from drake_teleop.logs.inspection import inspect_command
from drake_teleop.logs.processing import eliminate_log, identify_log
from drake_teleop.logs.read.description import load_description
from drake_teleop.logs.read.reading import read_log
from drake_teleop.logs.read.table_files import read_table

COLUMNS = (
    *("t", "f_x", "f_y", "f_z", "tau_x", "tau_y", "tau_z", "s_x", "s_y", "s_z"),
    *("omega_x", "omega_y", "omega_z", "alpha_x", "alpha_y", "alpha_z"),
)


def archive(**members: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, **members)
    return stream.getvalue()


def zipped(content: bytes) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as file:
        file.writestr("t.npy", content)
    return stream.getvalue()


def header(shape: tuple[int, ...]) -> bytes:
    stream = io.BytesIO()
    npy.write_array_header_1_0(stream, {"descr": "<f8", "fortran_order": False, "shape": shape})
    return stream.getvalue()


def one_array() -> bytes:
    stream = io.BytesIO()
    np.save(stream, np.zeros(3))
    return stream.getvalue()


WHOLE = archive(t=np.arange(100.0))
AT = WHOLE.index(np.arange(100.0)[50:52].tobytes())
DAMAGED = {
    "the end is missing": (WHOLE[:-30], "not a complete NPZ archive"),
    "the half is missing": (WHOLE[: len(WHOLE) // 2], "not a complete NPZ archive"),
    "a wrong checksum": (WHOLE[:AT] + b"\x7f" + WHOLE[AT + 1 :], "Bad CRC"),
    "one array": (one_array(), "not a complete NPZ archive"),
    "text": (b"t\n0\n1\n", "not a complete NPZ archive"),
    "nothing": (b"", "not a complete NPZ archive"),
    "objects": (archive(t=np.array([None, {}])), "Object arrays"),
    "73 TiB": (zipped(header((10**13,))), "cannot be read"),
    "no header": (zipped(b"\x93NUMPY\x01\x00\x10\x00{'descr': nonsens"), "cannot be read"),
    "no array": (zipped(b""), "has no rows"),
}


def error_line(call) -> str:
    with pytest.raises(DrakeTeleopError) as caught:
        call()
    line = str(caught.value)
    assert len(line) <= MAX_ERROR_LINE_LENGTH
    assert line.count("cannot be read") <= 1 and line.count("check ") <= 1
    return line


@pytest.mark.parametrize("name", DAMAGED)
def test_damaged_archive_raises_one_line(name, tmp_path):
    content, expected = DAMAGED[name]
    path = tmp_path / "x.npz"
    path.write_bytes(content)
    line = error_line(lambda: read_table(path))
    assert line.startswith(f"{path}: ") and expected in line


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_archive_with_another_suffix_is_an_error(suffix, tmp_path):
    path = tmp_path / f"x{suffix}"
    path.write_bytes(WHOLE)
    assert error_line(lambda: read_table(path)).startswith(f"{path}: cannot be read: ")


def test_complex_numbers_are_refused(tmp_path):
    path = tmp_path / "x.npz"
    path.write_bytes(archive(t=np.array([1.0 + 1.0j])))
    table = read_table(path)
    assert "is not a number" in error_line(lambda: table.finite_numbers(["t"], 1, "x"))


def test_names_that_differ_only_in_spaces_are_refused(tmp_path):
    path = tmp_path / "x.csv"
    path.write_text("a, a\n1,2\n")
    assert "differ only in spaces" in error_line(lambda: read_table(path))


def log_file(folder, **changes: float):
    t = np.arange(60) * 1e-3
    table = np.column_stack([t, np.sin(np.outer(t, 2.0 + np.arange(15)))])
    table[:, COLUMNS.index("s_z")] += 9.8
    for name, value in changes.items():
        table[17, COLUMNS.index(name)] = value
    path = folder / "log.csv"
    np.savetxt(path, table, delimiter=",", header=",".join(COLUMNS), comments="")
    return path


@pytest.mark.parametrize("name", ["t", "f_x", "tau_y", "s_z", "omega_x", "alpha_y"])
@pytest.mark.parametrize("value", [1e300, -1e26])
def test_value_beyond_all_units_is_refused(name, value, tmp_path):
    path = log_file(tmp_path, **{name: value})
    line = error_line(lambda: read_log(path))
    assert line.startswith(f"{path}:{name}: {value:g} in row 19 of log.csv is outside -1e+25 to")


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("f_y", 2e6, "wrench.force.columns: 2e+06 N in row 19 of log.csv is outside -1e+06 to"),
        ("tau_z", -2e6, "wrench.torque.columns: -2e+06 N m in row 19"),
        ("s_x", 2e6, "imu.specific_force.columns: 2e+06 m/s^2 in row 19"),
        ("omega_z", 2e6, "imu.angular_velocity.columns: 2e+06 rad/s in row 19"),
        ("alpha_x", 2e9, "imu.angular_acceleration.columns: 2e+09 rad/s^2 in row 19"),
    ],
)
def test_value_beyond_all_sensors_is_refused(name, value, expected, tmp_path):
    path = log_file(tmp_path, **{name: value})
    assert f"{path}:{expected}" in error_line(lambda: read_log(path))
    assert len(read_log(log_file(tmp_path, **{name: 0.45 * value}))) == 60


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ("gravity: 1e300", ":gravity: 1e+300 is outside -1e12 to 1e12"),
        ("gravity: [0, 0, -9810]", "largest component of gravity is 9810"),
        ("wrench: {time: {rate: 100, offset: -1e13}}", ":wrench.time.offset: -1e+13 is outside"),
        ("imu: {position: [0, 1e300, 0]}", ":imu.position: 1e+300 is outside -1e12 to 1e12"),
        ("wrench: {time: {rate: 1e-300}}", ":wrench.time.rate: "),
        ("pose: {time: {column: t, scale: 1e-300}}", ":pose.time.scale: "),
    ],
)
def test_description_beyond_all_units_is_refused(change, expected, tmp_path):
    path = tmp_path / "x.yaml"
    static = "static: {file: a.csv, force: {columns: [a]}, torque: {columns: [b]}, gravity:"
    static += " {columns: [c]}}"
    path.write_text(f"{static}\n{change}" if "gravity" in change else change)
    assert expected in error_line(lambda: load_description(path))


@pytest.mark.parametrize("rows", [2, 3])
def test_record_too_short_to_be_thinned_is_refused(rows, tmp_path):
    path = tmp_path / "log.csv"
    table = np.outer(np.arange(rows) * 1e-3, np.ones(len(COLUMNS)))
    np.savetxt(path, table, delimiter=",", header=",".join(COLUMNS), comments="")
    found = inspect_command(path, tmp_path / "out", quiet=True)["findings"]
    assert any("too few" in finding["message"] for finding in found)


def test_wrench_of_rounding_errors_determines_no_mass():
    motion = np.sin(np.outer(np.arange(100.0), 1.0 + np.arange(9)))
    wrench = 1e-150 * np.cos(np.outer(np.arange(100.0), 1.0 + np.arange(6)))
    line = error_line(lambda: identify_batch(wrench, *np.split(motion, 3, axis=1)))
    assert "the mass cannot be identified" in line


def test_channels_far_below_the_uncertainty_have_a_positive_floor():
    contact = np.tile([1e-5, 1e-5, 1e-5, 1e-5, 1e-6, 2e-7], (300, 1))
    known = np.diag(np.repeat([1.0, 0.0], [6, 10]))
    floor = fit_noise_floor(contact, *np.zeros((4, 300, 3)), known)
    assert np.linalg.eigvalsh(floor.correlation)[0] > 0.0


@pytest.mark.parametrize("delay", [1e29, -1e29, 5.0])
def test_delay_beyond_the_record_is_refused(delay, tmp_path):
    line = error_line(lambda: identify_log(log_file(tmp_path), delay=delay))
    assert f"a delay of {delay:g} s leaves 0 of 60 samples" in line


@pytest.mark.parametrize(
    ("delay", "fault"),
    [(1e300, "is 1e+300, outside"), (-1e300, "is -1e+300, outside"), (np.nan, "is not finite;")],
)
def test_delay_that_is_no_time_is_refused(delay, fault, tmp_path):
    line = error_line(lambda: identify_log(log_file(tmp_path), delay=delay))
    assert line.startswith(f"delay: {fault}")


@pytest.mark.parametrize(
    ("name", "value"), [("sigma", 1e308), ("sigma", np.nan), ("gamma", 1e308), ("gamma", -1.0)]
)
def test_scales_outside_0_to_100_are_refused(name, value, tmp_path):
    path = log_file(tmp_path)
    load = identify_log(path, delay=0.0).identification
    line = error_line(lambda: eliminate_log(path, load, **{name: value}))
    assert line == f"{name}: {value:g} is outside 0 to 100; give a finite scale >= 0"


@pytest.mark.parametrize("cutoff", [1e-300, np.nan])
def test_too_low_cutoff_is_refused(cutoff, tmp_path):
    path = log_file(tmp_path)
    assert "Hz is too low" in error_line(lambda: identify_log(path, cutoff_hz=cutoff))
