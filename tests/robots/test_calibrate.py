"""Calibration from a stream: parameters are reported only when they are determined."""

from __future__ import annotations

import io
import json
import time
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import polars as pl
import pytest
import sockets
from click.testing import CliRunner
from rich.console import Console
from scipy.spatial.transform import Rotation
from test_compensator import load
from test_peers import ADDRESS, peer
from test_reading_assembly import X_FS, truth

from drake_teleop.cli.calibrate import calibrate_command, make_progress_display
from drake_teleop.cli.main import cli
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.load.tolerance import (
    derivatives_over_tolerances,
    display_values_of_required_entries,
    parse_tolerance,
    tolerances_in_display_units,
)
from drake_teleop.logs.processing import identify_log
from drake_teleop.logs.read.canonical import (
    ANGULAR_VELOCITY_COLUMNS,
    SPECIFIC_FORCE_COLUMNS,
    WRENCH_COLUMNS,
    Log,
    write_log,
)
from drake_teleop.robots.calibration import (
    RecordEvaluation,
    advise_motion,
    calibrate,
    evaluate_record,
)
from drake_teleop.robots.compensate import run_compensate_command
from drake_teleop.robots.recording import Recorder
from drake_teleop.robots.streams import DAMAGED_READING, POSE, WRENCH, Reading, ReadingFlag

DT = 0.005
PHI = phi_from_mass_com_inertia(1.7, [0.01, -0.02, 0.06], np.diag([0.004, 0.005, 0.003]))
NOISE = np.repeat([0.1, 0.005], 3)
TOLERANCE = parse_tolerance("mass 0.5 %, com 0.5 mm")


def motion(t: np.ndarray, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rotations about `axes` one after another, by 1 rad and back in one second each."""
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
    """Source that ends."""

    dt, live = DT, False

    def __init__(self, values: np.ndarray) -> None:
        self._readings = [Reading(k, DT * k, row) for k, row in enumerate(values)]

    def read(self, timeout_s: float) -> list[Reading] | None:
        now, self._readings = self._readings[:50], self._readings[50:]
        return now or None

    def close(self) -> None:
        pass


@pytest.mark.slow
def test_calibration_stops_after_two_agreeing_results_and_equals_identify(tmp_path: Path) -> None:
    path = tmp_path / "log.parquet"
    recorder = Recorder()
    looks = calibrate(Stream(recorded(20.0, [0, 1, 2])), recorder, path, TOLERANCE)
    assert recorder.longest_record_s < 8.0
    assert [at.is_within_tolerance.all() for at in looks[-3:]] == [False, True, True]
    assert [at.is_known.all() for at in looks[-3:]] == [False, False, True]
    last = looks[-1]
    assert (
        last.identified_log is not None
        and last.advice == ""
        and all(at.advice for at in looks[:-2])
    )
    again = identify_log(path).identification
    np.testing.assert_array_equal(last.identified_log.identification.phi, again.phi)
    error = display_values_of_required_entries(
        TOLERANCE, again.phi
    ) - display_values_of_required_entries(TOLERANCE, PHI)
    assert (np.abs(error) < tolerances_in_display_units(TOLERANCE, PHI)).all()
    assert last.record_length_s == pytest.approx(identify_log(path).log.t[-1])


class FailingStream(Stream):
    """Live stream that ends with an error."""

    live = True

    def read(self, timeout_s: float) -> list[Reading] | None:
        found = super().read(timeout_s)
        if found is None:
            raise DrakeTeleopError("the robot is gone")
        return found


def test_failing_source_keeps_the_record_and_earlier_records(tmp_path: Path) -> None:
    path = tmp_path / "log.parquet"
    for seconds in (0.5, 0.8):
        with pytest.raises(DrakeTeleopError, match="the robot is gone"):
            calibrate(FailingStream(recorded(seconds, [0])), Recorder(), path, TOLERANCE)
    with pytest.raises(DrakeTeleopError, match="the robot is gone"):
        calibrate(FailingStream(recorded(0.0, [0])), Recorder(), path, TOLERANCE)  # no data
    assert len(pl.read_parquet(path)) == 160
    assert len(pl.read_parquet(tmp_path / "earlier-1" / path.name)) == 100
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize("seconds", [0.3, 0.6, 0.9])
def test_record_is_not_longer_than_the_maximum(tmp_path: Path, seconds: float) -> None:
    """A chunk of a replayed log can contain more than the rest of the record."""
    recorder = Recorder()
    calibrate(
        *(Stream(recorded(5.0, [0])), recorder, tmp_path / "log.parquet", TOLERANCE),
        seconds=seconds,
    )
    assert recorder.longest_record_s == pytest.approx(seconds, abs=1.1 * DT)


class UselessStream(Stream):
    """Live stream that repeats the same readings endlessly."""

    live = True

    def read(self, timeout_s: float) -> list[Reading]:
        time.sleep(0.01)
        return self._readings


@pytest.mark.slow
@pytest.mark.parametrize(
    ("readings", "remedy"),
    [
        ([], "0 invalid .* check the source's address"),
        ([DAMAGED_READING] * 7, r"[1-9]\d* invalid .* check --range and the values"),
    ],
)
def test_source_without_valid_readings_ends_after_the_maximum(
    tmp_path: Path, readings: list[Reading], remedy: str
) -> None:
    source, path = UselessStream(np.empty((0, 15))), tmp_path / "log.parquet"
    source._readings = readings
    path.write_text("earlier")
    with pytest.raises(DrakeTeleopError, match=f"0 valid and .*{remedy}"):
        calibrate(source, Recorder(), path, TOLERANCE, seconds=0.05)
    assert path.read_text() == "earlier"


def test_short_calibration_waits_for_a_late_source(tmp_path: Path) -> None:
    """Peers of ROS 2 are found after a second or more."""

    class LateStream(UselessStream):
        start = time.monotonic() + 0.3

        def read(self, timeout_s: float) -> list[Reading]:
            time.sleep(0.01)
            return Stream.read(self, timeout_s) if time.monotonic() > self.start else []

    recorder = Recorder()
    source = LateStream(recorded(1.0, [0]))
    calibrate(source, recorder, tmp_path / "log.parquet", TOLERANCE, seconds=0.2)
    assert recorder.longest_record_s == pytest.approx(0.2, abs=1.1 * DT)


@pytest.mark.parametrize("name", ["log.parquet", "../{}/log.parquet"])
def test_replayed_log_is_never_replaced(tmp_path: Path, name: str) -> None:
    log = Log(DT * np.arange(400), *np.split(recorded(2.0, [0]), [6, 9, 12], axis=1))
    path = tmp_path / name.format(tmp_path.name)
    write_log(log, path)
    before = path.read_bytes()
    load().save(tmp_path / "load.json")
    for command in (
        lambda: calibrate_command(f"replay:{path}", tmp_path, until="mass 50 %", quiet=True),
        lambda: run_compensate_command(
            f"replay:{path}", tmp_path / "load.json", str(tmp_path / path.name)
        ),
    ):
        with pytest.raises(DrakeTeleopError, match=r"contains the input log.parquet, .* --out"):
            command()
    assert path.read_bytes() == before


@pytest.mark.parametrize("names", [("log.parquet", "b.parquet"), ("a.csv", "log.parquet")])
def test_files_of_a_replayed_description_are_never_replaced(
    tmp_path: Path, names: tuple[str, str]
) -> None:
    wrench, *motion = np.split(recorded(2.0, [0]), [6, 9, 12], axis=1)
    zeros = np.zeros_like(motion)
    write_log(Log(DT * np.arange(400), wrench, *zeros), tmp_path / names[0])
    write_log(Log(DT * np.arange(400), 0.0 * wrench, *motion), tmp_path / names[1])
    groups = (
        *np.split(np.array(WRENCH_COLUMNS), 2),
        SPECIFIC_FORCE_COLUMNS,
        ANGULAR_VELOCITY_COLUMNS,
    )
    fields = [{"columns": list(map(str, group))} for group in groups]
    described = {
        "wrench": {"file": names[0], "force": fields[0], "torque": fields[1]},
        "imu": {"file": names[1], "specific_force": fields[2], "angular_velocity": fields[3]},
    }
    for stream in described.values():
        stream["time"] = {"column": "t"}
    (tmp_path / "log.yaml").write_text(json.dumps(described))
    load().save(tmp_path / "load.json")
    before = [(tmp_path / name).read_bytes() for name in names]
    source = f"replay:{tmp_path / 'log.yaml'}"
    for name in names:
        with pytest.raises(DrakeTeleopError, match=rf"contains the input {name}, .* --out"):
            run_compensate_command(source, tmp_path / "load.json", str(tmp_path / name))
    with pytest.raises(DrakeTeleopError, match=r"contains the input log.parquet, .* --out"):
        calibrate_command(source, tmp_path, until="mass 50 %", quiet=True)
    assert [(tmp_path / name).read_bytes() for name in names] == before


def evaluate(values: np.ndarray, until: str, path: Path) -> RecordEvaluation:
    log = Log(DT * np.arange(len(values)), *np.split(values, [6, 9, 12], axis=1))
    write_log(log, path)
    return evaluate_record(path, parse_tolerance(until), None, cutoff_hz=30.0, delay="auto")


def test_rotation_about_one_axis_leaves_other_inertias_unknown(tmp_path: Path) -> None:
    at = evaluate(recorded(4.0, [1]), "mass 5 %, inertia 20 %", tmp_path / "log.parquet")
    known = dict(
        zip(
            parse_tolerance("mass 5 %, inertia 20 %").required_entry_names,
            at.is_within_tolerance,
            strict=True,
        )
    )
    assert known["mass"] and known["inertia xy"]
    assert not any(known[f"inertia {axes}"] for axes in ("xx", "xz", "zz"))
    assert "about y" not in at.advice


@pytest.mark.slow
def test_no_parameter_is_known_after_a_change_of_load(tmp_path: Path) -> None:
    both = np.concatenate([recorded(3.0, [0, 1, 2]), recorded(3.0, [0, 1, 2], phi=1.5 * PHI)])
    at = evaluate(both, "mass 1000 %", tmp_path / "log.parquet")
    assert at.relative_half_widths < 1.0 and not at.is_within_tolerance.any()
    assert at.doubts[0].startswith("from t = 3.00 s on there is another load")
    assert at.advice == "start again: the sensor's zero or the load changes at t = 3.00 s"


def contact(seconds: float) -> np.ndarray:
    """Return a contact wrench (N, 6) of up to 12 N between 2.5 and 3.5 s."""
    t = DT * np.arange(round(seconds / DT))
    force = np.where(np.abs(t - 3.0) < 0.5, 12.0 * np.sin(np.pi * (t - 2.5)) ** 2, 0.0)
    return force[:, None] * np.array([1.0, -0.6, 0.3, 0.05, 0.1, 0.0]) * np.cos(9.0 * t)[:, None]


@pytest.mark.slow
def test_excluded_contact_causes_no_doubt(tmp_path: Path) -> None:
    values = recorded(6.0, [0, 1, 2])
    values[:, :6] += contact(6.0)
    at = evaluate(values, "mass 0.5 %", tmp_path / "log.parquet")
    assert at.identified_log is not None
    assert [cause.name for cause in at.identified_log.causes] == ["contact"]
    assert at.doubts == () and at.is_within_tolerance.all() and at.advice == ""


@pytest.mark.slow
@pytest.mark.pictures
def test_command_reports_the_time_of_a_tare(tmp_path: Path) -> None:
    """`test_no_parameter_is_known_after_a_change_of_load` tests a grasp."""
    values, time = recorded(6.0, [0, 1, 2]), 4.0
    values[round(time / DT) :, :6] += [2.0, -1.0, 3.0, 0.05, 0.1, -0.1]
    evaluate(values, "mass 1 %", tmp_path / "log.csv")
    arguments = ["calibrate", f"replay:{tmp_path}/log.csv", "--until", "mass 0.001 %"]
    result = CliRunner().invoke(cli, [*arguments, "--out", str(tmp_path)], standalone_mode=False)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert [cause["name"] for cause in summary["causes"]] == ["zero change"]
    assert summary["causes"][0]["start_s"] == pytest.approx(time, abs=0.02)
    words = f"from t = {time:.2f} s on"
    assert words in summary["doubts"][0] and not summary["all_known"]
    assert words in " ".join(result.stderr.split()) and "start again" in summary["advice"]


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_advice_is_the_missing_motion(axis: int) -> None:
    """The advice at rest is a rotation about a horizontal axis."""
    others = [k for k in range(3) if k != axis]
    t = DT * np.arange(1600)
    errors = derivatives_over_tolerances(parse_tolerance("inertia 1 %"), PHI)
    words = advise_motion(motion(t, np.array(others)), DT, 30.0, errors, NOISE)
    assert f"swing the wrist about {'xyz'[axis]}" in words
    rest = np.tile(9.81 * np.eye(3)[axis], (400, 1)), np.zeros((400, 3)), np.zeros((400, 3))
    words = advise_motion(
        rest, DT, 30.0, derivatives_over_tolerances(parse_tolerance("mass 1 %"), PHI), NOISE
    )
    assert f"about {'xyz'[axis]}" not in words and "rotate" in words


def test_bad_readings_are_rejected_and_a_set_clock_starts_a_new_part(tmp_path: Path) -> None:
    rows, recorder = recorded(1.0, [0]), Recorder(sensor_range=np.full(6, 80.0))
    broken = rows[3].copy()
    broken[1], rows[5, 0] = np.nan, 80.0
    for reading in (Reading(0, 0.0, rows[0]), DAMAGED_READING, Reading(1, DT, broken),
                    Reading(2, 2 * DT, rows[5]), Reading(3, 3 * DT, rows[7]),
                    Reading(2, 2 * DT, rows[6])):  # fmt: skip
        recorder.add(reading)
    assert recorder.left_out == 4 and recorder.longest_record_s == pytest.approx(3 * DT)
    for k in range(50):
        assert recorder.clock_changes == 0 and recorder.longest_record_s == pytest.approx(3 * DT)
        recorder.add(Reading(4 + k, 100.0 + DT * k, rows[8]))
    assert recorder.clock_changes == 1 and recorder.longest_record_s == pytest.approx(49 * DT)
    assert recorder.left_out == 4


def take(recorder: Recorder, *clocks: tuple[float, int]) -> Recorder:
    """Record a number of readings from each start time."""
    number = 0
    for start, count in clocks:
        for k in range(count):
            recorder.add(Reading(number, start + DT * k, np.ones(15)))
            number += 1
    return recorder


@pytest.mark.parametrize("wrong", [1e6, -1e6, 1e300, 20.0, 0.0])
@pytest.mark.parametrize("count", [1, 2, 49])
def test_wrong_stamps_reject_only_their_own_readings(wrong: float, count: int) -> None:
    recorder = take(Recorder(), (10.0, 800), (wrong, count), (14.0, 200))
    assert (recorder.left_out, recorder.clock_changes) == (count, 0)
    assert recorder.longest_record_s == pytest.approx(4.0 + 199 * DT)


@pytest.mark.parametrize(("first", "second"), [(800, 60), (60, 800)])
def test_longest_part_is_written_after_a_clock_change(
    first: int, second: int, tmp_path: Path
) -> None:
    recorder = take(Recorder(), (0.0, first), (1e6, 1), (500.0, second))
    assert (recorder.left_out, recorder.clock_changes) == (1, 1)
    assert recorder.longest_record_s == pytest.approx(799 * DT)
    recorder.write(tmp_path / recorder.log_file_name)
    assert len(pl.read_parquet(tmp_path / recorder.log_file_name)) == 800


def test_record_is_as_long_as_its_shortest_stream() -> None:
    recorder = Recorder((WRENCH, POSE), None, X_FS)
    for k in range(100):
        recorder.add(Reading(k, DT * k, np.ones(6), stream=WRENCH))
        if k < 60:
            recorder.add(Reading(k, DT * k, np.eye(7)[0], stream=POSE))
    assert recorder.longest_record_s == pytest.approx(59 * DT)


def test_wrong_stamps_of_one_stream_do_not_affect_the_other() -> None:
    recorder = Recorder((WRENCH, POSE), None, X_FS, two_clocks=True)
    pose, wrench = np.eye(7)[0], np.ones(6)
    for k in range(1000):
        recorder.add(Reading(k, 1e7 if k == 400 else DT * k, wrench, stream=WRENCH, arrival=DT * k))
        recorder.add(Reading(k, 1e4 + DT * k, pose, stream=POSE, arrival=DT * k))
    assert recorder.longest_record_s == pytest.approx(999 * DT) and recorder.left_out == 1
    for k in range(100):  # both clocks were set
        recorder.add(Reading(k, 70.0 + DT * k, wrench, stream=WRENCH, arrival=DT * k))
        recorder.add(Reading(k, 90.0 + DT * k, pose, stream=POSE, arrival=DT * k))
    assert recorder.longest_record_s == pytest.approx(999 * DT) and recorder.left_out == 1
    assert recorder.clock_changes <= 2


@pytest.mark.parametrize(("degrees", "known"), [(19.0, False), (21.0, True)])
def test_variance_of_few_degrees_of_freedom_is_not_sufficient(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, degrees: float, known: bool
) -> None:
    widths = np.array([0.5]), np.array([0.9]), np.array([degrees])
    monkeypatch.setattr(
        "drake_teleop.robots.calibration.half_widths_and_dof_over_tolerances", lambda *_: widths
    )
    at = evaluate(recorded(3.0, [0, 1, 2]), "mass 1 %", tmp_path / "log.parquet")
    assert at.is_within_tolerance.tolist() == [known]


def test_progress_shows_values_and_half_widths_in_their_units() -> None:
    tolerance = parse_tolerance("mass 0.5 %, com 0.5 mm")
    found = SimpleNamespace(identification=SimpleNamespace(phi=PHI))
    half, none = np.array([0.5, 0.4, 0.6, 0.8]), np.zeros(4, bool)
    at = RecordEvaluation(2.0, found, "", half, half < 1.0, none, (), "")
    console = Console(width=120, record=True, file=io.StringIO())
    console.print(make_progress_display(at, tolerance))
    text = " ".join(console.export_text().replace("│", "").split())
    for row in ("mass 1.7 0.00425 0.0085 kg", "com x 10 0.2 0.5 mm", "com z 60 0.4 0.5 mm"):
        assert row in text


def test_a_single_result_within_the_tolerance_is_not_known(tmp_path, monkeypatch) -> None:
    path, out = tmp_path / "log.parquet", tmp_path / "out"
    evaluate(recorded(3.0, [0, 1, 2]), "mass 1 %", path)
    monkeypatch.setattr("drake_teleop.cli.calibrate.identify_command", lambda *_, **__: {})
    monkeypatch.setattr("drake_teleop.robots.calibration.MIN_EVALUATED_RECORD_S", 9.0)
    summary = calibrate_command(f"replay:{path}", out, until="mass 50 %", quiet=True)
    assert summary["half_widths_95"]["mass"] < 0.1 and summary["looks"] == 1
    assert summary["known"] == {"mass": False} and not summary["all_known"]


@pytest.mark.slow
@pytest.mark.pictures
def test_exit_status_is_1_if_the_tolerance_is_not_met(tmp_path: Path) -> None:
    evaluate(recorded(2.0, [0, 1, 2]), "mass 1 %", tmp_path / "log.csv")
    out = tmp_path / "out"
    arguments = f"calibrate replay:{tmp_path}/log.csv --until".split()
    arguments += ["mass 0.0001 %", "--out", str(out)]
    assert CliRunner().invoke(cli, arguments, standalone_mode=False).return_value == 1
    summary = json.loads((out / "summary.json").read_text())
    assert summary["all_known"] is False and summary["known"] == {"mass": False}
    for name in ("log.parquet", "identification.json", "settling.png", "report.html"):
        assert (out / name).stat().st_size > 0


def posed(seconds: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times at 500 Hz, noisy wrenches of S and noisy poses of F."""
    t, rng = 0.002 * np.arange(round(seconds / 0.002)), np.random.default_rng(2)
    sent = [truth(each) for each in t]
    motion = np.split(np.array([each[1] for each in sent]), 3, axis=1)
    wrench = non_contact_wrench(*motion, PHI) + 1.0 + NOISE * rng.normal(size=(len(t), 6))
    poses = np.array([each[0] for each in sent])
    return t, wrench, poses + np.repeat([2e-5, 2e-5], [4, 3]) * rng.normal(size=(len(t), 7))


@pytest.mark.slow
def test_poses_of_another_frame_and_clock_are_recorded_unprocessed(tmp_path: Path) -> None:
    """The stamps of the motion are 4 ms late and from another clock."""
    recorder = Recorder((WRENCH, POSE), np.full(6, 80.0), X_FS, two_clocks=True)
    late, clock = 0.004, 1e4
    for k, (t, wrench, pose) in enumerate(zip(*posed(2.0), strict=True)):
        recorder.add(Reading(k, t, wrench, stream=WRENCH, arrival=t + 0.001))
        recorder.add(Reading(k, t + clock + late, pose, stream=POSE, arrival=t + late + 0.001))
    bad = np.full(6, 80.0), np.full(7, np.nan), np.full(7, 0.9)
    for stream, values, flags in zip(
        (WRENCH, POSE, POSE), bad, (0, 0, ReadingFlag.DAMAGED), strict=True
    ):
        recorder.add(Reading(0, 2.1, values, int(flags), stream=stream, arrival=2.1))
    assert recorder.left_out == 3 and recorder.clock_changes == 0
    recorder.write(tmp_path / recorder.log_file_name)
    found = identify_log(tmp_path / recorder.log_file_name)
    assert found.identification.delay_s == pytest.approx(late, abs=1e-3)
    error = display_values_of_required_entries(
        TOLERANCE, found.identification.phi
    ) - display_values_of_required_entries(TOLERANCE, PHI)
    assert (np.abs(error) < tolerances_in_display_units(TOLERANCE, PHI)).all()


@pytest.mark.slow
@pytest.mark.skipif(find_spec("rtde_receive") is None, reason="ur_rtde has no wheel here")
def test_calibration_with_a_ur_and_a_rotated_and_shifted_sensor(tmp_path: Path) -> None:
    sockets.on_purpose.add(30004)
    _, wrench, pose = posed(9.0)
    turn = Rotation.from_quat(pose[:, [1, 2, 3, 0]]).as_rotvec()
    (tmp_path / "told").write_bytes(np.hstack([-wrench, pose[:, 4:], turn]).tobytes())
    pitch = np.degrees(2.0 * np.arctan2(X_FS[2], X_FS[0]))
    with peer("rtde", ADDRESS, str(tmp_path / "told")) as (host, _):
        words = ["calibrate", f"rtde://{host}", "--until", "mass 1 %, com 1 mm"]
        words += ["--sensor-pose", *map(str, X_FS[4:]), "0", str(pitch), "0"]
        words += ["--range", "100", "10", "--seconds", "8", "--out", str(tmp_path / "out")]
        known = CliRunner().invoke(cli, words, standalone_mode=False)
    assert known.return_value == 0, known.output
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["all_known"] and summary["seconds"] < 8.0
    asked = parse_tolerance("mass 1 %, com 1 mm")
    phi = json.loads((tmp_path / "out" / "identification.json").read_text())["phi"]
    error = display_values_of_required_entries(
        asked, np.array(phi)
    ) - display_values_of_required_entries(asked, PHI)
    assert (np.abs(error) < tolerances_in_display_units(asked, PHI)).all()
