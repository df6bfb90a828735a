"""Causes in records with known truth, made by a generator that does not use the package."""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

from cause_records import make_record, write
from planted_causes import run

from drake_teleop.logs.processing import identify_log

pytestmark = pytest.mark.slow


@cache
def run_case(kind: str, motion: str, sensor: str, seed: int) -> dict[str, Any]:
    return run((kind, motion, sensor, seed))


@pytest.mark.parametrize(
    ("case", "names"),
    [
        (("zero change + load change", "fourier", "poses", 0), {"zero change", "load change"}),
        (("zero change + load change", "pick", "imu", 3), {"zero change", "load change"}),
        (("weight removed", "fourier", "imu", 5), {"weight removed"}),
        (("torque factor", "fourier", "poses", 4), {"torque factor"}),
        (("cable", "pick", "poses", 1), {"cable"}),
        (("gravity direction", "pick", "poses", 2), {"gravity direction"}),
        (("no load", "fourier", "imu", 3), {"no load"}),
        (("wrist only", "pick", "poses", 9), set()),
        (("contact", "fourier", "imu", 0), {"contact"}),  # 88 % of the record
        (("contact", "pick", "poses", 5), {"contact"}),
        (("none", "slow", "imu", 18), set()),
        (("none", "pick", "poses", 51), set()),
    ],
)
def test_the_right_causes_are_named_and_no_number_is_certain_and_wrong(
    case: tuple[str, str, str, int], names: set[str]
) -> None:
    found = run_case(*case)
    assert {name for name, *_ in found["named"]} == names
    assert found["false"] == []
    assert found["time_error"] is None or found["time_error"] < 0.1


@pytest.mark.parametrize(
    "case",
    [
        ("gain matrix", "fourier", "poses", 3),
        ("hysteresis", "pick", "poses", 1),
        ("gain", "pick", "poses", 2),
        ("torque factor", "fourier", "imu", 8),
        ("torque factor", "fourier", "imu", 14),
        ("none", "slow", "imu", 91),
    ],
)
def test_no_number_is_significantly_wrong_without_a_named_cause(
    case: tuple[str, str, str, int],
) -> None:
    assert run_case(*case)["false"] == []


def test_a_slow_record_of_an_imu_gives_mass_and_centre(tmp_path: Path) -> None:
    """Noise of the angular acceleration is not a misfit."""
    record = make_record("none", "slow", "imu", 31)
    found = identify_log(write(record, tmp_path)).identification
    assert found.identifiable.tolist() == [True] * 10 + [False] * 6
    assert found.standard_deviations[6] < 0.005
    assert found.mass == pytest.approx(record.truth.loads[0][0][0], abs=0.015)


def test_a_factor_that_slow_motion_does_not_determine_leaves_the_load_uncertain() -> None:
    found = run_case("torque factor", "pick", "poses", 25)
    assert [name for name, *_ in found["named"]] == ["torque factor"]
    assert "or 0.112985" in found["messages"][0]  # the true one: pound-force inches
    assert found["false"] == []


@pytest.mark.parametrize(("motion", "seed"), [("pick", 0), ("fourier", 1)])
def test_contact_and_the_opposite_sign_are_named_together(
    tmp_path: Path, motion: str, seed: int
) -> None:
    record = make_record("contact", motion, "poses", seed)
    path = write(replace(record, sign=-record.sign), tmp_path)
    found = identify_log(path)
    assert {cause.name for cause in found.causes} == {"axes", "contact"}
    assert found.causes[0].fields == {"wrench.sign": record.sign}
    assert found.identification.mass == pytest.approx(record.truth.loads[0][0][0], rel=0.005)


def test_a_misfit_without_a_known_cause_is_a_finding(tmp_path: Path) -> None:
    """No load is identified under undetected contact, and a finding states the reason."""
    found = identify_log(write(make_record("contact", "fourier", "poses", 22), tmp_path))
    assert not found.causes and not found.identification.identifiable[6:].any()
    (finding,) = found.findings
    assert finding.name == "misfit" and "times the sensor's noise" in finding.message
