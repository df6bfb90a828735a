"""Fuzzer: cases that it found stay fixed, and it finds planted faults."""

from __future__ import annotations

import os
import random
import sys
import warnings
from argparse import Namespace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from drake_teleop.common.errors import MAX_ERROR_LINE_LENGTH, DrakeTeleopError

pytestmark = pytest.mark.checks

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
CASES = Path(__file__).parent / "fuzz_cases"
SAID = {
    "description-frame_nan.yaml": "imu.frame: must be a 3x3 rotation matrix",
    "description-long_name.yaml": "no such file",
    "dmd-circle.dmd.yaml": "its joints form a loop through",
    "dmd-own_alias.dmd.yaml": "is nested too deeply",
    "files-absent_folder.json": "includes itself through a.dmd.yaml",
    "files-double_slash.json": "includes '..//",
    "inspect-backwards.npz": "",
    "inspect-no_rows.npz": "",
    "inspect-no_stamp.npz": "",
    "inspect-lengths.npz": "'q_z' of case.npz has 160 rows where 80 are needed",
    "load-negative_variance.json": "covariance: has a negative variance",
    "load-no_mass.json": "phi: has the mass 0",
    "log_parquet-panic.parquet": "cannot be read: the file is damaged",
    "mjcf-latin_1.xml": "is not UTF-8 text (byte ",
    "mjcf-size.xml": "geom of l2: size '1e300 0.2 0.1' exceeds 1e+06",
    "result-absent_column.parquet": "cannot be read: unable to find column",
    "result-dates.parquet": "cannot be read: columns wrench.f_x, wrench.f_y do not contain numbers",
    "result-metadata_panic.parquet": "is not a simulation result",
    "result-name_3.parquet": "is not a simulation result",
    "result-name_of_fields.parquet": "is not a simulation result",
    "result-negative_size.parquet": "file is damaged: the number of values in a page of t is -21",
    "result-panic.parquet": "cannot be read: the file is damaged",
    "result-panic_2.parquet": "the file is damaged: wrench.f_x goes beyond the end of the file",
    "result-panic_3.parquet": "is not a simulation result",
    "result-times_in_pairs.parquet": "is not a simulation result",
    "robot-large_shape.urdf": "body 'l2' has a shape of 2.02e+05 m (at most 1000 m)",
    "robot-two_roots.urdf": "",
    "robot-no_radius.urdf": "",
    "robot-1e300_m.urdf": "",
    "scenario-tag_of_a_block.yaml": "rates: the tag !Rates is not allowed here",
    "scenario-whole_tag.yaml": "the tag tag:yaml.org,2002:int is not allowed here",
    "trajectory-1e308_rad.yaml": "contains -1e+308, outside +-1e+06",
    "scenario-tag_of_nothing.yaml": "operator.task: '!!' is not known",
    "sdf-colour.sdf": "",
    "sdf-logged_error.sdf": "",
    "urdf-circle_in_no_xml.urdf": "is not XML (not well-formed (invalid token): line 20",
    "urdf-long_package.urdf": "",
    "urdf-unknown_encoding.urdf": "is not XML (unknown encoding: utf-9)",
    "trace_npz-empty_delay.npz": "'delay' of case.npz has 0 numbers per row, not 1",
    "wrenches_ros-damaged_pose.bin": "",
    "wrenches_rtde-no_time_between.bin": "",
}
"""Part of each case's error message; empty if the case is valid."""


@pytest.fixture(scope="module")
def fuzz() -> ModuleType:
    sys.path.insert(0, str(BENCHMARKS))
    try:
        import fuzz  # type: ignore[import-not-found]
    finally:
        sys.path.remove(str(BENCHMARKS))
    return fuzz


def test_each_case_that_is_kept_is_a_test() -> None:
    assert sorted(path.name for path in CASES.iterdir()) == sorted(SAID)


@pytest.mark.parametrize("name", SAID)
def test_what_was_found_is_one_line(name: str, fuzz: ModuleType, tmp_path: Path, capfd) -> None:
    target = fuzz.target_of(CASES / name)
    case = tmp_path / f"case{target.suffix}"
    if target.name == "dmd":
        target.seeds(tmp_path)  # with the files that they refer to
    case.write_bytes((CASES / name).read_bytes())
    line = ""
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        try:
            target.run(case)
        except DrakeTeleopError as error:
            line = str(error)
    assert SAID[name] in line and bool(SAID[name]) == bool(line)
    assert len(line) <= MAX_ERROR_LINE_LENGTH and len(line.splitlines()) <= 1
    assert capfd.readouterr().err == ""


def test_the_same_numbers_make_the_same_case(fuzz: ModuleType, tmp_path: Path) -> None:
    for name in ("trajectory", "load", "log_npz", "urdf"):
        target = next(each for each in fuzz.TARGETS if each.name == name)
        good = target.seeds(tmp_path)

        def made(target: Any = target, good: list[bytes] = good) -> list[bytes]:
            draws = random.Random(5)
            return [target.mutate(draws, good[0], good[-1]) for _ in range(8)]

        assert made() == made()
        assert len({*made(), good[0]}) > 6


def _read(path: Path) -> None:
    """Fail in the way that the first letter of the file selects."""
    word = path.read_bytes()[:1]
    if word == b"e":
        raise KeyError("no such key")
    if word == b"w":
        os.write(2, b"beware")
    if word == b"h":
        while True:
            pass
    if word == b"d":
        os.abort()
    if word == b"r":
        raise DrakeTeleopError("is refused")


@pytest.mark.slow
def test_errors_warnings_hangs_and_deaths_are_found(
    fuzz: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def mutate(draws: random.Random, content: bytes, other: bytes) -> bytes:
        return [b"good", b"error", b"warn", b"refuse", b"hang", b"die"][draws.randrange(6)]

    target = fuzz.Target("letters", ".txt", 1.0, lambda _: [b"good"], mutate, _read)
    monkeypatch.setattr(fuzz, "_CPU_SECONDS", 0.05)
    options = Namespace(seconds=60.0, seed=1, jobs=2, cases=25)
    (state,) = fuzz.fuzzed([target], options, tmp_path)
    found = {finding.content: finding.times for finding in state.findings.values()}
    assert set(found) == {b"error", b"warn", b"hang", b"die"}
    assert state.counts[0] == 25 and state.counts[1] > 0
    figures = fuzz.report([state], tmp_path / "out")
    assert figures == {"letters.cases": 25, "cases": 25, "findings": 4}
    assert len(list((tmp_path / "out").iterdir())) == 4


@pytest.mark.slow
def test_a_death_while_a_case_is_made_is_told_apart_and_not_repeated(
    fuzz: ModuleType, tmp_path: Path
) -> None:
    def mutate(draws: random.Random, content: bytes, other: bytes) -> bytes:
        if draws.randrange(4) == 0:
            os.abort()
        return b"refuse"

    target = fuzz.Target("letters", ".txt", 1.0, lambda _: [b"good"], mutate, _read)
    options = Namespace(seconds=60.0, seed=1, jobs=2, cases=12)
    (state,) = fuzz.fuzzed([target], options, tmp_path)
    ((place, finding),) = state.findings.items()
    assert place.startswith("SIGABRT while a case was made of this one")
    assert finding.content == b"good"
    assert state.counts[0] == 12 and state.counts[1] + finding.times == 12
