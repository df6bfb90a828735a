"""Units of IMU columns: drafted from the values or their names, and read as SI values."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import planted
import polars as pl
import pytest
import yaml

from drake_teleop.logs.inspection import inspect_command
from drake_teleop.logs.read.reading import read_log

ACCELERATIONS = {"m/s^2": 1.0, "g": 1 / 9.80665, "mg": 1e3 / 9.80665, "mm/s^2": 1e3}
RATES = {"rad/s": 1.0, "deg/s": 180 / np.pi, "mdeg/s": 1e3 * 180 / np.pi}


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
