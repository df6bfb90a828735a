"""A load from a stream: known when it is, and not before."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from drake_teleop.cli import cli
from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.load.tolerance import errors_of, read_tolerance, sizes_of, values_of
from drake_teleop.logs.processing import identify_log
from drake_teleop.logs.read.canonical import Log, write_log
from drake_teleop.robots.calibrate import Recorder, calibrate
from drake_teleop.robots.calibration import Look, look, missing_motion
from drake_teleop.robots.streams import DAMAGED, Reading

DT = 0.005
PHI = phi_from_mass_com_inertia(1.7, [0.01, -0.02, 0.06], np.diag([0.004, 0.005, 0.003]))
NOISE = np.repeat([0.1, 0.005], 3)
ASKED = read_tolerance("mass 0.5 %, com 0.5 mm")


def motion(t: np.ndarray, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Turns about `axes`, one after the other, by 1 rad and back in a second each."""
    angle, k = 0.5 * (1.0 - np.cos(2 * np.pi * t)), np.floor(t).astype(int) % len(axes)
    e = np.eye(3)[axes[k]]
    speed, change = np.pi * np.sin(2 * np.pi * t), 2 * np.pi**2 * np.cos(2 * np.pi * t)
    up = np.array([0.4, 0.5, np.sqrt(1 - 0.41)])
    along = (e @ up)[:, None] * e
    s = 9.81 * (along + np.cos(angle)[:, None] * (up - along)
                - np.sin(angle)[:, None] * np.cross(e, up))  # fmt: skip
    return s, speed[:, None] * e, change[:, None] * e


def recorded(seconds: float, axes: list[int], *, phi: np.ndarray = PHI) -> np.ndarray:
    t = DT * np.arange(round(seconds / DT))
    moved = motion(t, np.array(axes))
    noise = NOISE * np.random.default_rng(1).normal(size=(len(t), 6))
    return np.hstack([non_contact_wrench(*moved, phi) + 1.0 + noise, *moved])


class Stream:
    """A source that ends."""

    dt, live = DT, False

    def __init__(self, values: np.ndarray) -> None:
        self._readings = [Reading(k, DT * k, row) for k, row in enumerate(values)]

    def read(self, timeout_s: float) -> list[Reading] | None:
        now, self._readings = self._readings[:50], self._readings[50:]
        return now or None

    def close(self) -> None:
        pass


def test_it_stops_when_two_looks_know_and_says_what_identify_says(tmp_path: Path) -> None:
    path = tmp_path / "log.parquet"
    looks, recorder = calibrate(Stream(recorded(20.0, [0, 1, 2])), path, ASKED)
    assert recorder.seconds < 8.0
    assert [at.sure.all() for at in looks[-3:]] == [False, True, True]
    assert [at.known.all() for at in looks[-3:]] == [False, False, True]
    last = looks[-1]
    assert last.found is not None and last.advice == "" and all(at.advice for at in looks[:-2])
    again = identify_log(path).identification
    np.testing.assert_array_equal(last.found.identification.phi, again.phi)
    error = values_of(ASKED, again.phi) - values_of(ASKED, PHI)
    assert (np.abs(error) < sizes_of(ASKED, PHI)).all()
    assert last.t == pytest.approx(identify_log(path).log.t[-1])


def looked_at(values: np.ndarray, until: str, path: Path) -> Look:
    log = Log(DT * np.arange(len(values)), *np.split(values, [6, 9, 12], axis=1))
    write_log(log, path)
    return look(path, read_tolerance(until), None, cutoff_hz=30.0, delay="auto")


def test_about_one_axis_the_inertia_about_the_others_stays_unknown(tmp_path: Path) -> None:
    at = looked_at(recorded(4.0, [1]), "mass 5 %, inertia 20 %", tmp_path / "log.parquet")
    known = dict(zip(read_tolerance("mass 5 %, inertia 20 %").entries, at.sure, strict=True))
    assert known["mass"] and known["inertia xy"]
    assert not any(known[f"inertia {axes}"] for axes in ("xx", "xz", "zz"))
    assert "about y" not in at.advice


@pytest.mark.slow
def test_of_two_loads_none_is_known(tmp_path: Path) -> None:
    both = np.concatenate([recorded(3.0, [0, 1, 2]), recorded(3.0, [0, 1, 2], phi=1.5 * PHI)])
    at = looked_at(both, "mass 1000 %", tmp_path / "log.parquet")
    assert at.half < 1.0 and not at.sure.any() and "the load changes at t = 3" in at.doubts[0]


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_the_motion_that_was_not_made_is_missing(axis: int) -> None:
    """Swung about two axes, the third is what is asked for; at rest, no turn about the vertical."""
    others = [k for k in range(3) if k != axis]
    t = DT * np.arange(1600)
    errors = errors_of(read_tolerance("inertia 1 %"), PHI)
    words = missing_motion(motion(t, np.array(others)), DT, 30.0, errors, NOISE)
    assert f"swing the wrist about {'xyz'[axis]}" in words
    rest = np.tile(9.81 * np.eye(3)[axis], (400, 1)), np.zeros((400, 3)), np.zeros((400, 3))
    words = missing_motion(rest, DT, 30.0, errors_of(read_tolerance("mass 1 %"), PHI), NOISE)
    assert f"about {'xyz'[axis]}" not in words and "turn" in words


def test_bad_readings_are_left_out_and_a_set_clock_begins_anew(tmp_path: Path) -> None:
    rows, recorder = recorded(1.0, [0]), Recorder(np.full(6, 80.0))
    broken = rows[3].copy()
    broken[1], rows[5, 0] = np.nan, 80.0
    for reading in (Reading(0, 0.0, rows[0]), DAMAGED, Reading(1, DT, broken),
                    Reading(2, 2 * DT, rows[5]), Reading(3, 3 * DT, rows[7]),
                    Reading(2, 2 * DT, rows[6])):  # fmt: skip
        recorder.take(reading)
    assert recorder.left_out == 4 and recorder.seconds == pytest.approx(3 * DT)
    recorder.take(Reading(4, 100.0, rows[8]))
    assert recorder.began_anew == 1 and recorder.seconds == 0.0


@pytest.mark.slow
def test_the_command_says_by_its_status_that_it_is_not_known(tmp_path: Path) -> None:
    looked_at(recorded(2.0, [0, 1, 2]), "mass 1 %", tmp_path / "log.csv")
    out = tmp_path / "out"
    arguments = f"calibrate replay:{tmp_path}/log.csv --until".split()
    arguments += ["mass 0.0001 %", "--out", str(out)]
    assert CliRunner().invoke(cli, arguments, standalone_mode=False).return_value == 1
    summary = json.loads((out / "summary.json").read_text())
    assert summary["all_known"] is False and summary["known"] == {"mass": False}
    for name in ("log.parquet", "identification.json", "settling.png", "report.html"):
        assert (out / name).stat().st_size > 0
