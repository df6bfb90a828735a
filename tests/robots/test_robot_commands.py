"""Commands of docs/robot.md with a stream on this machine; a thread sends it."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from shown import press_ctrl_c, type_in
from test_calibrate import DT, PHI, recorded
from test_compensator import OFFSETS, load, resting

from drake_teleop.robots import udp
from drake_teleop.robots.streams import POSE, WRENCH, CompensatedWrench, Reading

pytestmark = pytest.mark.slow
TOUCH = np.array([5.0, 0.0, -3.0, 0.0, 0.2, 0.0])


@pytest.fixture
def in_folder(tmp_path, monkeypatch) -> Iterator[None]:
    """Change to a folder with the result of `identify`; a lock serialises tests on these ports."""
    monkeypatch.chdir(tmp_path)
    Path("out/load").mkdir(parents=True)
    load().save(Path("out/load/identification.json"))
    with Path(os.environ["DRAKE_TELEOP_CACHE_DIR"], "ports").open("w") as ports:
        fcntl.flock(ports, fcntl.LOCK_EX)
        yield


class Peer:
    """Sender of packets to port 49152, one every `each_s`, as soon as it is open.

    With a socket of answers the packets start after the first answer, and end with Ctrl-C. The
    first packet contains no reading, because a late one would shift the clock for good.
    """

    def __init__(
        self, packets: list[bytes], each_s: float, answers: socket.socket | None = None
    ) -> None:
        self.heard: list[CompensatedWrench] = []
        self._packets, self._each_s, self._answers = packets, each_s, answers
        self._over, self._thread = threading.Event(), threading.Thread(target=self._play)

    def __enter__(self) -> Peer:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def _play(self) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            while not self._over.wait(0.02) and not self._listens(sender):
                pass
            due = time.monotonic()
            with contextlib.suppress(ConnectionRefusedError):  # identified before the end
                for packet in self._packets:
                    due += self._each_s
                    if self._over.wait(max(0.0, due - time.monotonic())):
                        return
                    sender.send(packet)
                    self._hear()
        if self._answers is not None and not self._over.wait(0.2):
            self._hear()
            press_ctrl_c()

    def _listens(self, sender: socket.socket) -> bool:
        try:
            sender.connect(("127.0.0.1", 49152))
            sender.send(b"is anybody there?")
            time.sleep(0.02)
            sender.send(b"")  # the socket reports that the first packet was not received
        except ConnectionRefusedError:
            return False
        self._hear()
        return self._answers is None or bool(self.heard)

    def _hear(self) -> None:
        if self._answers is not None:
            with contextlib.suppress(BlockingIOError):
                while True:
                    self.heard.append(udp.unpack_wrench(self._answers.recv(1000)))


@pytest.fixture
def answers(in_folder) -> Iterator[socket.socket]:
    """Return a receiver of the wrenches."""
    with udp.open_udp_receiver(udp.LOCALHOST, 49153) as there:
        there.setblocking(False)
        yield there


def touched(count: int) -> list[Reading]:
    """Return readings at rest, first free, then in contact."""
    free, pushed = resting(count, OFFSETS), resting(2 * count, OFFSETS + TOUCH)
    return [row._replace(t=0.001 * row.number) for row in (*free, *pushed[count:])]


@pytest.mark.slow
def test_documented_calibrate_command_identifies_the_load(in_folder) -> None:
    rows = recorded(40.0, [0, 1, 2])
    packets = [udp.pack_reading(Reading(k, DT * k, row)) for k, row in enumerate(rows)]
    with Peer(packets, 0.1 * DT):
        type_in("docs/robot.md", "drake-teleop calibrate udp")
    found = json.loads(Path("out/load/identification.json").read_text())
    summary = json.loads(Path("out/load/summary.json").read_text())
    assert summary["all_known"] and summary["seconds"] < 40.0
    assert found["mass"] == pytest.approx(PHI[0], rel=0.005)


@pytest.mark.slow
def test_documented_compensate_command_eliminates_the_tool(in_folder, answers, capfd) -> None:
    with Peer([udp.pack_reading(row) for row in touched(800)], 0.001, answers) as peer:
        type_in("docs/robot.md", "drake-teleop compensate udp")
    assert "tare" in capfd.readouterr().err
    last = [row for row in peer.heard if not row.flags][-1]
    assert last.number >= 1599
    np.testing.assert_allclose(last.contact, TOUCH, atol=0.01)


def test_documented_compensate_command_works_with_poses(in_folder, answers) -> None:
    pose = np.array([1.0, 0.0, 0.0, 0.0, 0.4, 0.1, 0.3])
    packets = [
        udp.pack_wrench_and_pose(
            Reading(row.number, row.t, -row.values[:6], stream=WRENCH),
            Reading(row.number, row.t, pose, stream=POSE),
        )
        for row in touched(300)
    ]
    with Peer(packets, 0.001, answers) as peer:
        type_in("docs/robot.md", "drake-teleop compensate posed")
    last = [row for row in peer.heard if not row.flags][-1]
    assert last.number >= 539
    np.testing.assert_allclose(last.contact, TOUCH, atol=0.01)
