"""Units of IMU columns: drafted from the values or their names, and read as SI values."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import planted
import polars as pl
import pytest
import yaml

from drake_teleop.logs.check.motion_checks import check_imu_signals
from drake_teleop.logs.inspection import inspect_command
from drake_teleop.logs.read.description import Description
from drake_teleop.logs.read.description_fields import SI_VALUE_OF_UNIT
from drake_teleop.logs.read.reading import read_described_log, read_log
from drake_teleop.logs.read.tables import Table

ACCELERATIONS = {"m/s^2": 1.0, "g": 1 / 9.80665, "mg": 1e3 / 9.80665, "mm/s^2": 1e3}
RATES = {"rad/s": 1.0, "deg/s": 180 / np.pi, "mdeg/s": 1e3 * 180 / np.pi}


@pytest.mark.quick_cases(4)
@pytest.mark.parametrize("named", [False, True])
@pytest.mark.parametrize(
    ("acceleration", "rate"),
    [("m/s^2", "mdeg/s"), ("g", "deg/s"), ("mg", "rad/s"), ("mm/s^2", "deg/s")],
)
def test_units_are_drafted_and_read(
    tmp_path: Path, acceleration: str, rate: str, named: bool
) -> None:
    columns = planted.good()
    units = (f" [{acceleration}]", f" [{rate}]") if named else ("", "")
    values = {"t": columns["t"]}
    for name, x, unit in (
        ("f", columns["force"], ""),
        ("m", columns["torque"], ""),
        ("acc_", ACCELERATIONS[acceleration] * columns["s"], units[0]),
        ("gyro_", RATES[rate] * columns["omega"], units[1]),
    ):
        values |= {f"{name}{axis}{unit}": x[:, i] for i, axis in enumerate("xyz")}
    pl.DataFrame(values).write_csv(tmp_path / "log.csv")
    inspect_command(tmp_path / "log.csv", tmp_path / "out", quiet=True)
    draft = yaml.safe_load((tmp_path / "out" / "draft.yaml").read_text())
    assert draft["imu"]["specific_force"].get("unit", "m/s^2") == acceleration
    assert draft["imu"]["angular_velocity"].get("unit", "rad/s") == rate
    log = read_log(tmp_path / "out" / "draft.yaml")
    assert np.abs(log.specific_force).mean(axis=0) == pytest.approx(
        np.abs(columns["s"]).mean(axis=0), rel=0.02
    )
    assert np.abs(log.angular_velocity).mean(axis=0) == pytest.approx(
        np.abs(columns["omega"]).mean(axis=0), rel=0.02
    )


@pytest.mark.parametrize(("unit", "is_set"), [("m/s^2", True), ("mm/s^2", True), ("mg", False)])
@pytest.mark.parametrize("gravity", [9.4, 10.3])
@pytest.mark.parametrize("direction", [[0.0, 0.0, -1.0], [0.0, 0.0, 1.0], [0.6, 0.8, 0.0]])
def test_gravity_is_proposed_only_for_units_without_it(
    tmp_path: Path, unit: str, is_set: bool, gravity: float, direction: list[float]
) -> None:
    """The units g and mg change with the described gravity, so that it cannot correct them."""
    size = 1e3 * 9.80665 / gravity if unit == "mg" else SI_VALUE_OF_UNIT[unit] ** -1 * 9.80665
    forces = size * np.tile([0.6, 0.0, 0.8], (2400, 1))
    columns = {"a": forces, "w": np.zeros((2400, 3)), "f": forces, "m": forces}
    values = {f"{name}{k}": x[:, k] for name, x in columns.items() for k in range(3)}
    fields = {name: {"columns": [f"{name}{k}" for k in range(3)]} for name in columns}
    file = {"file": tmp_path / "x.csv", "time": {"rate": 100.0}}
    imu = {"specific_force": fields["a"] | {"unit": unit}, "angular_velocity": fields["w"]}
    wrench = {"force": fields["f"], "torque": fields["m"]}
    description = Description.model_validate(
        {"gravity": [gravity * x for x in direction], "wrench": file | wrench, "imu": file | imu}
    )
    tables = {tmp_path / "x.csv": Table(tmp_path / "x.csv", values)}
    log = read_described_log(description, "x", tables=tables)
    (finding,), _ = check_imu_signals(description, log)
    vector = {-1.0: 9.807, 1.0: [0.0, 0.0, 9.807], 0.0: [5.884, 7.845, 0.0]}[direction[2]]
    assert finding.message.endswith(f"set gravity: {vector}") == is_set
    assert ("divide the columns" in finding.message) != is_set
