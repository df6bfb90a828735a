"""Logs with a wrong rate of the clock: nothing is identified, and the remedy gives the load."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import planted
import pytest
import yaml
from known_motion import motion_at

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.logs.inspection import inspect_command
from drake_teleop.logs.processing import IdentifiedLog, identify_log

CALENDAR_TIME_S, UP_W = 1.7e9, np.array([0.0, 0.0, 9.80665])


def record(seconds: float, ratio: float = 1.0, *, removed: float = 0.0) -> planted.Columns:
    """Return a record whose time steps are `ratio` times the true ones.

    The weight of the share `removed` of the load is removed from the wrench.
    """
    rng = np.random.default_rng(7)
    t = np.arange(0.0, seconds, 2e-3)
    x = motion_at(0.6 * t)
    s_W = 0.6**2 * (np.einsum("nij,nj->ni", x.R_WS, x.specific_force) - UP_W)
    s = np.einsum("nji,nj->ni", x.R_WS, s_W + UP_W)
    omega, alpha = 0.6 * x.omega, 0.6**2 * x.alpha
    up = np.einsum("nji,j->ni", x.R_WS, UP_W)
    wrench = non_contact_wrench(s, omega, alpha, planted.PHI) + planted.OFFSETS
    wrench -= non_contact_wrench(up, 0.0 * up, 0.0 * up, removed * planted.PHI)
    noise = rng.normal(size=(4, len(t), 3))
    return {
        "t": ratio * t,
        "force": wrench[:, :3] + 0.1 * noise[0],
        "torque": wrench[:, 3:] + 0.01 * noise[1],
        "s": s + 0.06 * noise[2],
        "omega": omega + 2e-3 * noise[3],
        "R": x.R_WS,
        "p": x.p_WS + 1e-5 * rng.normal(size=(len(t), 3)),
    }


def identified(path: Path, columns: planted.Columns, streams: str) -> IdentifiedLog:
    """Identify the load with these of the streams: gyroscope, accelerometer, poses."""
    description = planted.written(path, columns, imu="a" in streams, pose="p" in streams)
    if "g" not in streams and "a" in streams:
        data = yaml.safe_load(description.read_text())
        del data["imu"]["angular_velocity"]
        description.write_text(yaml.safe_dump(data))
    return identify_log(description)


def apply_remedy(path: Path, fields: dict[str, Any]) -> None:
    data = yaml.safe_load(path.read_text())
    for name, value in fields.items():
        stream, time, key = name.split(".")
        data[stream].setdefault(time, {})[key] = value
    path.write_text(yaml.safe_dump(data))


@pytest.mark.slow
@pytest.mark.quick_cases(3)
@pytest.mark.parametrize(
    ("ratio", "streams"),
    [
        *((0.5, "p"), (1.02, "ga"), (0.7, "gap"), (3.0, "p")),
        *((4.0, "ga"), (10.0, "gap"), (1.02, "gap"), (1.5, "ap")),
    ],
)
def test_remedy_gives_the_load(tmp_path: Path, ratio: float, streams: str) -> None:
    found = identified(tmp_path, record(12.0, ratio), streams)
    assert not found.identification.identifiable.any()
    (finding,) = found.findings
    assert finding.name == "clock rate"
    assert finding.values["ratio"] == pytest.approx(ratio, rel=0.005)
    # Poses with a gyroscope that differs by 2 % are used as poses: its gain may be wrong.
    by_poses = streams == "p" or (streams, ratio) == ("gap", 1.02)
    assert ("same centre of mass" in finding.message) == (by_poses and ratio > 1.0)
    apply_remedy(tmp_path / "log.yaml", finding.fields)
    repaired = identify_log(tmp_path / "log.yaml")
    # A gyroscope determines the ratio to 0.2 %, which leaves the effect of a small gain error.
    accepted = {"gain"} if "g" in streams else set()
    assert {finding.name for finding in repaired.findings} <= accepted
    assert repaired.identification.mass == pytest.approx(3.13, rel=0.005)
    assert repaired.identification.identifiable[6]


@pytest.mark.slow
def test_positions_in_mm_are_no_clock_rate(tmp_path: Path) -> None:
    """A slow clock and a torque in N mm have nearly the same effect."""
    columns = planted.good()
    planted.in_mm(columns)
    with pytest.raises(DrakeTeleopError, match=r"pose\.position\.unit: mm"):
        identified(tmp_path, columns, "p")


@pytest.mark.slow
def test_inspect_names_the_clock_rate_alone(tmp_path: Path) -> None:
    path = planted.written(tmp_path, record(8.0, 2.0), imu=False)
    (finding,) = inspect_command(path, tmp_path / "out", quiet=True)["findings"]
    assert finding["name"] == "clock rate"
    assert "set wrench.time.scale: 0.5" in finding["message"]


@pytest.mark.slow
@pytest.mark.quick_cases(1)
@pytest.mark.parametrize("known_by", ["calendar", "gyroscope"])
def test_known_clock_leaves_a_configured_payload(tmp_path: Path, known_by: str) -> None:
    """A payload with the load's centre of mass has the effect of a slow clock."""
    columns = record(8.0, removed=0.4)
    if known_by == "calendar":
        columns["t"] = CALENDAR_TIME_S + columns["t"]
    found = identified(tmp_path, columns, "p" if known_by == "calendar" else "gap")
    assert [cause.name for cause in found.causes] == ["payload configured"]
    assert found.identification.mass == pytest.approx(3.13, rel=0.005)
    unknown = identified(tmp_path, record(8.0, removed=0.4), "p")
    assert [finding.name for finding in unknown.findings] == ["clock rate"]
    assert not unknown.identification.identifiable.any()
    assert "payload of 1.25" in unknown.findings[0].message
