"""Driver, spectators and frames in virtual time."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from full_disk import small_disk

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.files import CannotWrite
from drake_teleop.common.progress import show_no_progress
from drake_teleop.live.live import (
    FRAME_PERIOD_S,
    MAX_MESSAGE_BYTES,
    Live,
    SliceSchedule,
    parse_message,
)
from drake_teleop.live.session import Session, read_drive
from drake_teleop.station.result import SimulationResult


class Clock:
    """Clock that only advances on request."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


def make(scenario, load, clock, record=None) -> Live:
    return Live(scenario, load, record, lambda rows: {}, clock())


def pass_time(live: Live, clock: Clock, seconds: float) -> list[dict]:
    """Return all frames of a period without lateness."""
    end, frames = clock.now + seconds, []
    while clock.now < end:
        frame = live.tick(clock)
        if frame is not None:
            frames.append(json.loads(json.dumps(frame, allow_nan=False)))
        clock.now += max(live.time_to_next_tick(clock.now), 1e-4)
    return frames


@pytest.mark.slow
def test_closed_page_releases_the_hand_and_completes_the_record(scenario, load, clock, tmp_path):
    folder = tmp_path / "drive"
    live = make(scenario, load, clock, folder)
    live.join(1, clock())
    frames = []
    for z in range(-1000, -5001, -1000):
        live.handle_message(1, json.dumps({"set": {"z": z}}), clock())
        frames += pass_time(live, clock, 0.05)
    assert frames[-1]["contact"] and frames[-1]["f"][1][1] > 0.2
    assert not frames[1]["contact"] and frames[-1]["state"] == "running"
    assert frames[-1]["factor"] == pytest.approx(1.0, abs=0.01) and frames[-1]["lost"] == 0.0
    assert len(frames) == pytest.approx(0.25 / FRAME_PERIOD_S, abs=2)
    assert frames[-1]["energy"][0] > 0.0 and frames[-1]["energy"][1] > 0.0

    left = clock.now
    live.leave(1, clock())
    frames = pass_time(live, clock, 0.4)
    assert frames[-1]["state"] == "waiting"
    assert frames[-1]["t"] == pytest.approx(left - 99.75, abs=0.02)
    log = SimulationResult.read_parquet(folder / "log.parquet")
    gone = int(1e3 * (left - 100.0)) + 10  # much less than half a second later
    pull = log["hand_wrench_E"][gone:, :3] + 20.0 * log["twist_master"][gone:, :3]
    np.testing.assert_allclose(pull, 0.0, atol=1e-12)
    assert np.ptp(log["pose_command"][gone + 10 :, 4:], axis=0).max() == 0.0
    again = read_drive(folder).repeat(show_no_progress(""))
    assert len(again.t) == len(log.t)
    np.testing.assert_array_equal(again["slave_state"], log["slave_state"])

    # The next page continues from the current pose.
    live.join(2, clock())
    frame = pass_time(live, clock, 0.03)[-1]
    assert (frame["driver"], frame["state"], frame["inputs"]["held"]) == (2, "running", 1)
    live.close()
    pull = SimulationResult.read_parquet(folder / "log.parquet")["hand_wrench_E"][:, :3]
    assert len(pull) > len(log.t)
    assert np.abs(np.diff(pull[len(log.t) - 5 :], axis=0)).max() < 0.2


def test_first_page_drives_and_another_takes_over_on_request(scenario, load, clock):
    live = make(scenario, load, clock)
    live.join(1, clock())
    live.join(2, clock())
    live.handle_message(2, '{"set": {"x": 100}, "pause": true, "reset": true}', clock())
    (frame, *_) = pass_time(live, clock, FRAME_PERIOD_S)
    assert (frame["driver"], frame["inputs"]["x"], frame["drive"]) == (1, 0, 1)
    live.handle_message(2, '{"drive": true, "set": {"x": 100}}', clock())
    live.handle_message(1, '{"set": {"x": 500}}', clock())
    frame = pass_time(live, clock, FRAME_PERIOD_S)[-1]
    assert (frame["driver"], frame["inputs"]["x"]) == (2, 100)
    live.handle_message(2, '{"pause": true}', clock())
    frames = pass_time(live, clock, 0.1)
    assert frames[-1]["state"] == "paused" and frames[-1]["t"] == frames[0]["t"]
    live.handle_message(2, '{"pause": false, "slow": 10}', clock())
    assert pass_time(live, clock, 0.2)[-1]["t"] - frames[-1]["t"] == pytest.approx(0.02, abs=6e-3)
    live.handle_message(2, '{"reset": true}', clock())
    frame = pass_time(live, clock, FRAME_PERIOD_S)[-1]
    assert (frame["drive"], frame["inputs"]["x"]) == (2, 0) and frame["t"] < 0.02


def test_impossible_station_is_reported_and_the_drive_continues(scenario, load, clock, monkeypatch):
    live = make(scenario, load, clock)
    live.join(1, clock())

    def no_such(*_):
        raise DrakeTeleopError("there is no such station")

    monkeypatch.setattr("drake_teleop.live.session.scenario_of_inputs", no_such)
    live.handle_message(1, '{"set": {"network": 3, "x": 100}}', clock())
    frame = pass_time(live, clock, 0.03)[-1]
    assert (frame["state"], frame["inputs"]["network"], frame["inputs"]["x"]) == ("running", 0, 100)
    assert frame["words"] == ["there is no such station"]


def test_removed_force_is_reported(scenario, load, clock, monkeypatch):
    live = make(scenario, load, clock)
    live.join(1, clock())
    assert pass_time(live, clock, FRAME_PERIOD_S)[-1]["words"] == []
    monkeypatch.setattr(Session, "force_above_limit", lambda session: 1.234)
    said = "1.2 N are not rendered until the hand presses less"
    assert pass_time(live, clock, FRAME_PERIOD_S)[-1]["words"] == [said]


@pytest.mark.slow
def test_new_scene_starts_a_drive_with_its_own_folder(scenario, load, clock, tmp_path):
    live = make(scenario, load, clock, tmp_path / "drive")
    (tmp_path / "drive-2").mkdir()
    live.join(1, clock())
    pass_time(live, clock, 0.03)
    live.handle_message(1, '{"scene": "wall"}', clock())
    frame = pass_time(live, clock, 0.05)[-1]  # the simulation waits for its load
    assert (frame["state"], frame["scene"], live.requested_scene) == ("preparing", "wall", "wall")
    live.change_scene(scenario, load, lambda rows: {}, clock())
    frame = pass_time(live, clock, 0.03)[-1]
    assert (frame["state"], frame["scene"], frame["drive"]) == ("running", "wall", 2)
    assert frame["record"] == str(tmp_path / "drive-3")
    assert read_drive(tmp_path / "drive").changes[-1][0] > 0
    live.close()


@pytest.mark.slow
def test_a_recorded_drive_is_never_overwritten(scenario, load, clock, tmp_path, monkeypatch):
    """A new drive, a reset and a folder with other files keep earlier records."""
    monkeypatch.chdir(tmp_path)
    before: dict[Path, bytes] = {}
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "scenario.yaml").write_text("mine")
    for name, first in (("drive", "drive"), ("drive", "drive-3"), ("mine", "mine-2")):
        live = make(scenario, load, clock, Path(name))
        live.join(1, clock())
        assert pass_time(live, clock, 0.02)[-1]["record"] == first
        live.handle_message(1, '{"reset": true}', clock())
        pass_time(live, clock, 0.02)
        live.close()
        assert live.recorded[0] == first and len(set(live.recorded)) == 2
        assert all(path.read_bytes() == content for path, content in before.items())
        before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    monkeypatch.chdir(tmp_path / "drive")
    live = make(scenario, load, clock, Path("."))
    assert live.frame()["record"] == str(tmp_path / "drive-5")
    live.close()
    assert live.recorded == [] and not (tmp_path / "drive-5").exists()  # the drive has not begun


def test_simultaneous_drives_use_different_folders(scenario, load, tmp_path):
    first = Session(scenario, load, record=tmp_path)
    with pytest.raises(CannotWrite, match=r"inputs.csv: cannot be written .File exists"):
        Session(scenario, load, record=tmp_path)
    first.advance(5)
    first.close()
    assert read_drive(tmp_path).changes[-1][0] == 5


@pytest.mark.slow
@pytest.mark.parametrize("size_bytes", [60_000, 400_000])
def test_full_disk_stops_the_drive_with_an_error(scenario, load, clock, tmp_path, size_bytes):
    """The error is in writing the inputs or the log."""
    with small_disk(tmp_path, size_bytes):
        live = make(scenario, load, clock, tmp_path / "drive")
        live.join(1, clock())
        for k in range(6000):
            live.handle_message(1, json.dumps({"set": {"x": k % 2000}}), clock())
            frames = pass_time(live, clock, 0.005)
            if frames and frames[-1]["state"] == "stopped":
                break
        else:
            pytest.fail("the disk was never full")
        assert "cannot be written" in frames[-1]["stopped"]
        live.handle_message(1, '{"reset": true}', clock())
        live.frame()
        with pytest.raises(CannotWrite, match=r"cannot be written .*(No space left|large)"):
            live.close()
        assert live.recorded == []


def test_input_is_shown_before_the_next_scheduled_frame(scenario, load, clock):
    """The number of frames does not increase."""
    live = make(scenario, load, clock)
    live.join(1, clock())
    pass_time(live, clock, 0.1)
    live.handle_message(1, '{"set": {"x": 100}}', clock())
    start = clock.now
    frame = None
    while frame is None or frame["inputs"]["x"] != 100:
        frame = live.tick(clock)
        clock.now += 1e-3
    assert clock.now - start < 0.013
    assert len(pass_time(live, clock, 0.2)) <= 13
    frames = []
    for x in range(101, 121):  # continuous motion is shown each slice
        live.handle_message(1, json.dumps({"set": {"x": x}}), clock())
        frames += pass_time(live, clock, 0.005)
    assert len(frames) >= 15


def test_failure_is_reported_and_a_reset_restarts(scenario, load, clock, monkeypatch):
    live = make(scenario, load, clock)
    live.join(1, clock())

    def fail(self, ms=5):
        raise DrakeTeleopError("joint 2 leaves its range")

    with monkeypatch.context() as patch:
        patch.setattr(Session, "advance", fail)
        frame = pass_time(live, clock, 0.05)[-1]
        assert (frame["state"], frame["stopped"]) == ("stopped", "joint 2 leaves its range")
    live.handle_message(1, '{"reset": true}', clock())
    assert pass_time(live, clock, 0.02)[-1]["state"] == "running"


def test_failed_reset_is_reported_and_the_next_one_restarts(
    scenario, load, clock, monkeypatch, tmp_path
):
    """The failure is in the old record or in the new station."""
    live = make(scenario, load, clock, tmp_path / "drive")
    live.join(1, clock())
    pass_time(live, clock, 0.02)

    def fail(*_, **__):
        raise DrakeTeleopError("no space left on device")

    for owner, name, state in ((Session, "close", "running"), (Session, "__init__", "stopped")):
        with monkeypatch.context() as patch:
            patch.setattr(owner, name, fail)
            live.handle_message(1, '{"reset": true}', clock())
        frame = pass_time(live, clock, 0.03)[-1]
        assert frame["state"] == state
        assert "no space left on device" in [frame["stopped"], *frame["words"]]
    live.handle_message(1, '{"reset": true}', clock())
    frame = pass_time(live, clock, 0.03)[-1]
    assert (frame["state"], frame["words"]) == ("running", []) and frame["t"] > 0.0
    with pytest.raises(CannotWrite, match="no space left"):  # the record of the first is lost
        live.close()


def test_simulation_waits_without_a_page(scenario, load, clock, tmp_path):
    live = make(scenario, load, clock)
    frames = pass_time(live, clock, 0.5)
    assert live.simulated_ms == 0 and frames[-1]["state"] == "waiting"


def test_short_delays_are_caught_up_and_long_ones_given_up():
    pace = SliceSchedule(5e-3, 0.0)
    for k in range(10):
        pace.begin_slice(5e-3 * k)
    assert pace.real_time_factor == pytest.approx(1.0) and pace.lateness_p99_s() == pytest.approx(
        0.0, abs=1e-12
    )
    pace.begin_slice(0.09)  # 40 ms late: the next ones are due at once
    assert pace.time_to_next_slice(0.09) == pytest.approx(-0.035) and pace.lost_time_s == 0.0
    pace.begin_slice(0.3)
    assert pace.lost_time_s == pytest.approx(0.245) and pace.time_to_next_slice(
        0.3
    ) == pytest.approx(5e-3)
    assert pace.real_time_factor < 0.2 and pace.lateness_p99_s() == pytest.approx(0.245)
    pace.slowdown = 4.0
    pace.begin_slice(0.305)
    assert pace.time_to_next_slice(0.305) == pytest.approx(0.02)


def random_message(rng: np.random.Generator) -> object:
    """Return a random message: damaged, of other types, or with non-finite numbers."""
    good = json.dumps({"set": {"x": 10, "sigma": 50, "clutch": 1}, "slow": 2.0, "pause": False})
    kind = rng.integers(8)
    if kind == 0:
        return bytes(rng.integers(0, 256, 40, dtype=np.uint8))
    if kind == 1:
        return good[: rng.integers(len(good))]
    if kind == 2:
        place = rng.integers(len(good))
        return good[:place] + chr(rng.integers(1, 0x2000)) + good[place + 1 :]
    if kind == 3:
        return "[" * int(rng.integers(1, MAX_MESSAGE_BYTES + 9))
    wild = ["NaN", "Infinity", "-1e308", "1e999", "9" * 400, "null", "true", '"7"', "[1]", "{}"]
    names = ["x", "rz", "sigma", "force_scale", "held", "clutch", "__class__", "ms", ""]
    names += ["network", "method", "sensor", "object"]
    values = ", ".join(f'"{rng.choice(names)}": {rng.choice(wild)}' for _ in range(3))
    other = rng.choice(["slow", "pause", "reset", "drive", "set", "rates"])
    return f'{{"set": {{{values}}}, "{other}": {rng.choice(wild)}}}'


@pytest.mark.slow
def test_all_values_stay_finite_after_10000_random_messages(scenario, load, clock):
    live, rng = make(scenario, load, clock), np.random.default_rng(0)
    live.join(1, clock())
    live._start_session = lambda now: None  # a thousand resets would build as many stations
    for k in range(10_000):
        live.handle_message(1, random_message(rng), clock())
        if k % 1000 == 0:
            live.handle_message(1, '{"pause": false, "slow": 1}', clock())
            live.requested_scene = ""  # likewise
            live._session.apply_inputs(live._requested)
            live._session.advance()
    live.requested_scene = ""
    frame = live.frame()
    assert live.refused > 3000
    assert frame["state"] == "running" and math.isfinite(sum(frame["inputs"].values()))
    rows = live._session.log()
    json.dumps(frame, allow_nan=False)
    assert all(np.isfinite(rows[name]).all() for name in rows)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ('{"set": {"x": 1, "y": NaN, "z": true, "rx": "1"}}', {"set": {"x": 1}}),
        ('{"rates": {"x": -2.5, "y": null}, "set": 3}', {"rates": {"x": -2.5}}),
        ('{"slow": 1e9, "pause": 1}', {"slow": 20.0}),
        ('{"drive": true, "reset": 1}', {"drive": True}),
        ('{"scene": "leaf", "pause": true}', {"scene": "leaf", "pause": True}),
        ('{"scene": "../leaf"}', None),
        ("[]", None),
        ("{}", None),
        (b'{"reset": true}', None),
        ('{"reset": true}' + " " * MAX_MESSAGE_BYTES, None),
    ],
)
def test_unexpected_entries_of_a_message_are_ignored(text, found):
    assert parse_message(text) == found
