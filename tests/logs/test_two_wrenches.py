"""Tables with two wrenches: the draft uses one, and a finding names the columns of both."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest

from drake_teleop.logs.check.draft import draft_description
from drake_teleop.logs.read.table_files import read_table

PAIRS = {
    "wrist and estimate": (
        [f"wrist_{x}" for x in ("fx", "fy", "fz", "tx", "ty", "tz")],
        [f"ext_{x}" for x in ("fx", "fy", "fz", "tx", "ty", "tz")],
    ),
    "UR": ([f"ft_raw_wrench_{k}" for k in range(6)], [f"actual_TCP_force_{k}" for k in range(6)]),
    "two sensors": (
        ["Fx [N]", "Fy [N]", "Fz [N]", "Tx [Nm]", "Ty [Nm]", "Tz [Nm]"],
        [f"second_{kind}_{x}" for kind in ("force", "torque") for x in "xyz"],
    ),
}


def write(folder: Path, names: list[str]) -> Path:
    t = np.arange(50) * 0.01
    columns = {"t": t, **{name: np.sin(k + t) for k, name in enumerate(names)}}
    columns |= {f"q{x}": np.full(50, x == "w", float) for x in "wxyz"}
    pl.DataFrame(columns).write_csv(folder / "x.csv")
    return folder / "x.csv"


@pytest.mark.parametrize("is_first", [True, False])
@pytest.mark.parametrize("name", ["wrist and estimate", "UR"])
def test_measured_wrench_is_used_and_the_other_named(
    tmp_path: Path, name: str, is_first: bool
) -> None:
    used, other = PAIRS[name]
    path = write(tmp_path, [*used, *other] if is_first else [*other, *used])
    draft = draft_description(read_table(path), tmp_path)
    wrench = draft.streams["wrench"]
    assert wrench["force"]["columns"] + wrench["torque"]["columns"] == used
    (finding,) = draft.findings
    taken, _, rest = finding.message.partition("; another wrench is in ")
    assert all(x in taken for x in used) and all(x in rest for x in other)
    assert f"set wrench.force.columns: {other[:3]}" in rest


@pytest.mark.parametrize("is_first", [True, False])
def test_first_of_two_sensors_is_used(tmp_path: Path, is_first: bool) -> None:
    used, other = PAIRS["two sensors"][:: 1 if is_first else -1]
    draft = draft_description(read_table(write(tmp_path, [*used, *other])), tmp_path)
    assert draft.streams["wrench"]["force"]["columns"] == used[:3]
    assert all(x in draft.findings[0].message for x in [*used, *other])


@pytest.mark.parametrize("name", PAIRS)
def test_one_wrench_has_no_finding(tmp_path: Path, name: str) -> None:
    path = write(tmp_path, [*PAIRS[name][0], "mag_x", "mag_y", "mag_z"])
    assert draft_description(read_table(path), tmp_path).findings == ()


@pytest.mark.parametrize(
    ("other", "frame"), [("K_F_ext_hat_K", "sensor"), ("actual_TCP_force", "base")]
)
def test_lines_for_the_other_wrench_include_its_frame(
    tmp_path: Path, other: str, frame: str
) -> None:
    names = [f"{name}[{k}]" for name in ("O_F_ext_hat_K", other) for k in range(6)]
    draft = draft_description(read_table(write(tmp_path, names)), tmp_path)
    assert draft.streams["wrench"]["frame"] == "base"
    assert draft.findings[0].message.endswith(f" and wrench.frame: {frame}")
