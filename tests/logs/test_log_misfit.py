"""Records that no single correction explains: nothing is identified, and no correction stated."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from known_motion import quaternions
from posed_record import GRAVITY_W, Kind, motion_at, record
from scipy.spatial.transform import Rotation

from drake_teleop.cli.logs import identify_command
from drake_teleop.load.identification import Identification
from drake_teleop.logs.inspection import inspect_command
from drake_teleop.logs.read.description import load_description

pytestmark = pytest.mark.slow


def write_table(folder: Path, factors: np.ndarray, *, torque_first: bool = False) -> Path:
    """Write a table with exact poses; channel i of the wrench is multiplied by `factors[i]`."""
    t, wrench, _ = record(Kind(wrench_rate=100.0))
    at, up = motion_at(t), Rotation.align_vectors([[0, 0, -1]], [GRAVITY_W])[0].as_matrix()
    wrench = wrench * factors
    named = np.hstack([wrench[:, 3:], wrench[:, :3]]) if torque_first else wrench
    names = ["t", "fx", "fy", "fz", "tx", "ty", "tz", "qw", "qx", "qy", "qz", "px", "py", "pz"]
    values = np.column_stack([t, named, quaternions(up @ at.R_WS), at.p_WS @ up.T])
    pl.DataFrame(values, schema=names).write_csv(folder / "log.csv")
    return folder / "log.csv"


@pytest.fixture(scope="module")
def mirrored(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    """Summary of inspect, and folder of the draft, for a record with only f_y mirrored."""
    folder = tmp_path_factory.mktemp("mirrored")
    log = write_table(folder, np.array([-1, 1, -1, -1, -1, -1]))
    return inspect_command(log, folder, quiet=True), folder


def test_draft_keeps_no_correction_that_leaves_a_misfit(
    mirrored: tuple[dict[str, Any], Path],
) -> None:
    summary, folder = mirrored
    message = {x["name"]: x["message"] for x in summary["findings"]}["misfit"]
    assert (
        "no single correction explains the record" in message
        and message.count("check whether") == 1
    )
    assert not any("; set " in x["message"] for x in summary["findings"])
    assert "Corrected by the data" not in (folder / "draft.yaml").read_text()


def test_nothing_of_a_misfit_is_identified(
    mirrored: tuple[dict[str, Any], Path], tmp_path: Path
) -> None:
    summary = identify_command(mirrored[1] / "draft.yaml", tmp_path / "out", quiet=True)
    assert "misfit" in [x["name"] for x in summary["findings"]]
    assert summary["identifiable"] == [] and set(summary["verdicts"].values()) == {"not"}
    assert summary["determined"][0].startswith("0 of 16") and summary["loads"] == []
    assert summary["offsets_std"] == summary["phi_std"][:6] == [None] * 6
    load = Identification.load(tmp_path / "out" / "identification.json")
    assert not load.identifiable.any() and set(load.verdicts) == {"not"}
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["identifiable"] == []


def test_exchanged_force_and_torque_are_corrected(tmp_path: Path) -> None:
    log = write_table(tmp_path, np.full(6, -1), torque_first=True)
    summary = inspect_command(log, tmp_path / "out", quiet=True)
    assert summary["findings"] == []
    wrench = load_description(tmp_path / "out" / "draft.yaml").wrench
    assert wrench is not None and wrench.sign == -1
    assert wrench.force.columns == ("tx", "ty", "tz") and wrench.torque.columns[0] == "fx"
