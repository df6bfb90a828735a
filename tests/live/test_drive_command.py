"""Documented shell commands of `drake-teleop drive`, with a client in place of the browser."""

from __future__ import annotations

import json
import re
import signal
import threading
import time
import webbrowser
from collections.abc import Callable
from pathlib import Path

import pytest
from shown import hearing_ctrl_c, press_ctrl_c, type_in
from sockets import ports
from websockets.sync.client import connect

from drake_teleop.cli.main import main
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.live.session import Session, read_drive
from drake_teleop.station import replay

pytestmark = pytest.mark.slow


@pytest.fixture
def page(monkeypatch, tmp_path, load) -> Callable[..., list[dict]]:
    """Replace the browser by a client that collects frames and then sends Ctrl-C."""
    monkeypatch.chdir(tmp_path)
    for module in ("live.server", "live.experiment.apparatus"):
        monkeypatch.setattr(f"drake_teleop.{module}.identified_load", lambda *_: load)
    for name in (
        "station.replay.write_replay",
        "common.files.write_picture",
        "lab.run.draw_overview",
    ):
        monkeypatch.setattr(f"drake_teleop.{name}", lambda *_: None)

    def open_page(
        first_message: str = '{"set": {"z": -3000}}',
        until: Callable[[dict], bool] = lambda frame: frame["t"] > 0.3,
        action: Callable[[], None] = lambda: None,
        stop: signal.Signals = signal.SIGINT,
    ) -> list[dict]:
        frames: list[dict] = []

        def visit(url: str) -> None:
            try:
                address = url.replace("http:", "ws:").replace("/?", "/socket?")
                with connect(address, origin=url.partition("/?")[0]) as socket:
                    end = time.monotonic() + 20.0
                    while time.monotonic() < end and not (frames and until(frames[-1])):
                        message = json.loads(socket.recv(20.0))
                        if "frame" in message and not frames:
                            socket.send(first_message)
                            action()
                        frames.extend([message["frame"]] if "frame" in message else [])
            finally:
                press_ctrl_c(stop)

        monkeypatch.setattr(
            webbrowser, "open", lambda url: threading.Thread(target=visit, args=(url,)).start()
        )
        return frames

    return open_page


def log(folder: str) -> list[bytes]:
    return [part.read_bytes() for part in sorted(Path(folder, "log.parquet").iterdir())]


@pytest.mark.slow
def test_a_drive_is_recorded_and_repeated(page, capsys):
    frames = page()
    type_in("docs/live.md", "drake-teleop drive contact_transition --record")
    message, stages = capsys.readouterr()
    assert stages.startswith("Prepare the station and its 3D scenes ...\n")
    assert "the simulation waits until this page is open; Ctrl-C ends it" in message
    assert "repeat it: drake-teleop run --inputs out/drive" in message
    assert frames[-1]["inputs"]["z"] == -3000
    type_in("docs/live.md", "drake-teleop run --inputs")
    assert log("out/again") == log("out/drive")
    type_in("docs/start.md", ".venv/bin/drake-teleop drive")


@pytest.mark.slow
def test_virtual_device_moves_the_hand(page, capfd):
    enough = threading.Event()

    def client() -> None:
        type_in("docs/live.md", "python -m drake_teleop.live", ctrl_c=enough)

    device = threading.Thread(target=client)
    places = set()

    def tapped(frame: dict) -> bool:
        places.add(frame["tool"][2])
        return len(places) > 100

    page(first_message="{}", until=tapped, action=device.start)
    type_in("docs/live.md", "drake-teleop drive contact_transition --device")
    enough.set()
    device.join()
    changes = read_drive(Path("out/drive")).changes
    assert len({inputs.z for _, inputs in changes}) > 20
    (figures,) = re.findall(r"^{.*}$", capfd.readouterr().out, re.M)
    assert json.loads(figures)["largest_force_n"] > 0.0


@pytest.mark.slow
def test_experiment_starts_with_consent_and_draws_no_force(page, capsys, monkeypatch):
    monkeypatch.setattr(replay, "ForceArrow", None)  # fails if an arrow is drawn
    before, opened = ports(), list[int]()
    frames = page(
        '{"go": true}',
        lambda frame: frame["study"]["phase"] == "task",
        lambda: opened.append(len(ports() - before)),
    )
    type_in("docs/experiment.md", "drake-teleop drive --study", status=130)
    assert [frame["study"]["phase"] for frame in (frames[0], frames[-1])] == ["consent", "task"]
    message = capsys.readouterr()
    assert "written out/experiment/results.csv" in message.out
    assert "interrupted: Ctrl-C: participant 1 has done 0 of " in message.err
    assert opened == [1]


def drive(*arguments: str) -> object:
    """Return the exit status."""
    with hearing_ctrl_c(), pytest.raises(SystemExit) as ended:
        main(["drive", "contact_transition", *arguments])
    return ended.value.code


@pytest.mark.slow
@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM])
def test_drive_reports_the_signal_that_ended_it(page, capsys, stop):
    frames = page(stop=stop)
    assert drive("--record", "here") == 0
    message = capsys.readouterr().out
    name = {signal.SIGINT: "Ctrl-C", signal.SIGTERM: "SIGTERM"}[stop]
    (seconds,) = re.findall(rf"ended by {name} after (\S+) s of simulated time", message)
    assert float(seconds) >= round(frames[-1]["t"], 1)
    assert message.endswith("repeat it: drake-teleop run --inputs here\n")
    assert read_drive("here").changes[-1][0] == pytest.approx(1e3 * float(seconds), abs=51)


@pytest.mark.slow
def test_stopped_drive_ends_with_the_reason_and_status_2(page, capsys, monkeypatch):
    def fail(self, ms=5):
        raise RuntimeError("joint 2\nleaves its range")

    page(until=lambda frame: bool(frame["stopped"]))
    monkeypatch.setattr("drake_teleop.live.server.compile_slice_functions", lambda *_: None)
    monkeypatch.setattr(Session, "advance", fail)
    assert drive() == 2
    message = capsys.readouterr().err
    assert message.endswith("error: drive: the simulation has stopped: joint 2 leaves its range\n")


@pytest.mark.slow
def test_incomplete_record_has_status_2(page, capsys, monkeypatch):
    def fail(self):
        raise DrakeTeleopError("no space left on device", where="here/log.parquet")

    page()
    monkeypatch.setattr(Session, "close", fail)
    assert drive("--record", "here") == 2
    message = capsys.readouterr()
    assert message.err.endswith("error: here/log.parquet: no space left on device\n")
    assert "recorded" not in message.out
