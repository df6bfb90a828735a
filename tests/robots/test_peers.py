"""Each source against a simulated device in another process, with all kinds of faults."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import sockets
from mcap.reader import make_reader
from peer import HASH
from test_compensator import PHI, load
from websockets.sync.client import connect

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.robots import netft, rtde
from drake_teleop.robots.compensator import Compensator
from drake_teleop.robots.connections import SOURCES, open_sink
from drake_teleop.robots.netft import NetFtSource, SampleClock, parse_counts_and_rate
from drake_teleop.robots.ros2_zenoh import ZenohSource
from drake_teleop.robots.rtde import RtdeSource
from drake_teleop.robots.streams import (
    ACCELERATION,
    POSE,
    WRENCH,
    WRENCH_AND_MOTION,
    CompensatedWrench,
    Reading,
    ReadingFlag,
    Source,
)
from drake_teleop.robots.udp import UdpSource

PEER = Path(__file__).with_name("peer.py")
AT_REST = np.array([0.0, 0.0, 9.81, *np.zeros(6)])
ADDRESS = f"127.{os.getpid() // 250 % 250}.{os.getpid() % 250}.7"  # ur_rtde has only one port
LOST = {9, 10, 11}
OFFSETS = np.array([0.0, 2.0, 3.0, 0.1, 0.2, 0.3])


@contextmanager
def peer(*words: str) -> Iterator[tuple[str, Iterator[str]]]:
    """Yield address and later output of a running peer."""
    with subprocess.Popen([sys.executable, PEER, *words], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        lines = (line.decode().strip() for line in process.stdout)
        try:
            yield next(lines), lines
        finally:
            process.kill()


class LoopOutputs(list[CompensatedWrench]):
    """Outputs of the loop of `compensate` for a source, with their times."""

    def __init__(
        self,
        source: Source,
        last: int,
        end: ReadingFlag = ReadingFlag.RESTART,
        seconds: float = 5.0,
    ) -> None:
        """Read until a good wrench with number `last` after the flag `end`, with a tool at rest."""
        self.at: list[float] = []
        self.parts: list[Reading] = []
        compensator = Compensator(load(), source.dt, cutoff_hz=None)
        compensator.offsets = OFFSETS - non_contact_wrench(*np.split(AT_REST, 3), PHI)
        begun, until = False, time.monotonic() + seconds
        while time.monotonic() < until:
            parts = source.read(0.01)
            assert parts is not None
            if (stale := compensator.stale_output(time.monotonic())) and not parts:
                self._take(stale)
            self.parts += parts
            for part in parts:
                reading = part
                if part.stream != WRENCH_AND_MOTION:
                    if part.stream != WRENCH:
                        continue
                    values = np.concatenate([part.values, AT_REST])
                    reading = Reading(part.number, part.t, values, part.flags)
                out = self._take(compensator.step(reading, time.monotonic()))
                begun |= bool(out.flags & end)
                if begun and not out.flags and out.number >= last:
                    return

    def _take(self, out: CompensatedWrench) -> CompensatedWrench:
        self.append(out)
        self.at.append(time.monotonic())
        return out

    def check(self, flags: ReadingFlag) -> None:
        """Check that faults are flagged with zero output, and that good outputs follow."""
        assert np.isfinite([[*row.contact, *row.scaled, row.t] for row in self]).all()
        assert not any(row.contact.any() or row.scaled.any() for row in self if row.flags)
        named = ReadingFlag(0)
        for row in self:
            named |= ReadingFlag(row.flags)
        assert named & flags == flags
        good = [row for row in self if not row.flags]
        for row in good:
            wanted = [row.number % 500, 0.0, 0.0, 0.0, 0.0, 0.0]
            np.testing.assert_allclose(row.contact, wanted, atol=1e-9)
        for flag in (
            each for each in ReadingFlag if each & flags
        ):  # Python 3.10 cannot split flags
            at = max(k for k, row in enumerate(self) if row.flags & flag)
            assert not all(row.flags for row in self[at:]), flag
        assert max(np.diff(self.at)) < 0.5  # and not silent: 0.05 s on an idle machine


def free_port() -> str:
    with socket.create_server(("127.0.0.1", 0)) as free:
        return str(free.getsockname()[1])


def test_udp_faults_are_flagged() -> None:
    source = UdpSource("udp://:0", 0.002)
    Compensator(load(), source.dt)  # loads compiled functions: the sender does not wait
    with peer("udp", str(source.port)):
        seen = LoopOutputs(source, 510, ReadingFlag.CLOCK_JUMP)
    source.close()
    flags = (
        ReadingFlag.REORDERED
        | ReadingFlag.NOT_FINITE
        | ReadingFlag.DAMAGED
        | ReadingFlag.SATURATED
        | ReadingFlag.STALE
    )
    seen.check(flags | ReadingFlag.RESTART | ReadingFlag.CLOCK_JUMP)
    numbers = [row.number for row in seen]
    assert numbers[numbers.index(12) - 1] == 8  # and no data instead of the lost packets


def test_netft_faults_are_flagged() -> None:
    with peer("netft") as (port, _):
        source = NetFtSource(f"netft://127.0.0.1:{port}?counts=1000,1000&sign=1", 0.002)
        seen = LoopOutputs(source, 10)
        source.close()
    flags = (
        ReadingFlag.REORDERED
        | ReadingFlag.DAMAGED
        | ReadingFlag.SATURATED
        | ReadingFlag.STALE
        | ReadingFlag.RESTART
    )
    seen.check(flags)
    numbers = [row.number for row in seen]
    assert numbers[numbers.index(12) - 1] == 8  # and no data instead of the lost packets


@pytest.mark.skipif(find_spec("rtde_receive") is None, reason="ur_rtde has no wheel here")
def test_rtde_faults_are_flagged() -> None:
    sockets.on_purpose.add(30004)  # of this machine, but not 127.0.0.1
    with peer("rtde", ADDRESS) as (host, _):
        source = RtdeSource(f"rtde://{host}?sign=1")
        seen = LoopOutputs(source, 510)
        source.close()
    assert source.dt == 0.002
    seen.check(
        ReadingFlag.REORDERED | ReadingFlag.NOT_FINITE | ReadingFlag.STALE | ReadingFlag.RESTART
    )
    assert not {50000 + number for number in LOST} & {row.number for row in seen}
    poses = [part.values for part in seen.parts if part.stream == POSE]
    np.testing.assert_allclose(poses[0], [np.cos(0.5), 0, 0, np.sin(0.5), 0.4, 0.1, 0.3])
    assert next(part.values.tolist() for part in seen.parts if part.stream == ACCELERATION) == [
        0,
        0,
        9.81,
    ]


def test_rate_of_a_robot_is_found_although_a_sample_is_lost(monkeypatch) -> None:
    rows = [(t, *[0.0] * 15) for t in (0.0, 0.008, 0.01, 0.018, 0.02)]
    monkeypatch.setattr(rtde, "require_library", lambda *_: None)
    monkeypatch.setattr(RtdeSource, "_start_reader_process", lambda self: None)
    monkeypatch.setattr(RtdeSource, "_read_samples", lambda self, timeout_s: rows)
    assert RtdeSource("rtde://192.0.2.1").dt == 0.002
    rows = [(0.008 * k, *[0.0] * 15) for k in range(5)]
    assert RtdeSource("rtde://192.0.2.1").dt == 0.008


def test_clock_of_sample_numbers_follows_the_measured_rate() -> None:
    clock, now, times = SampleClock(1e-3), 5.0, []
    for number in range(40_000):
        now += 1.001e-3 if number < 20_000 else 1.003e-3
        times.append(clock.time_of_sample(number, now))
    steps = np.diff(times)
    np.testing.assert_allclose(steps[:999], 1e-3, rtol=1e-9)
    np.testing.assert_allclose(steps[1100:19_000], 1.001e-3, rtol=1e-9)
    np.testing.assert_allclose(steps[-100:], 1.003e-3, rtol=1e-9)
    assert clock.time_of_sample(39_990, now) == pytest.approx(times[39_990], abs=1e-4)  # late
    assert clock.time_of_sample(40_000, now) == pytest.approx(times[-1] + 1.003e-3, abs=1e-9)


def test_ros_2_faults_are_flagged() -> None:
    with peer("ros", free_port()) as (port, _):
        source = ZenohSource(f"zenoh://127.0.0.1:{port}/ft/wrench?domain=3&sign=1", 0.002)
        seen = LoopOutputs(source, 510, ReadingFlag.CLOCK_JUMP)
        source.close()
    flags = (
        ReadingFlag.REORDERED
        | ReadingFlag.NOT_FINITE
        | ReadingFlag.DAMAGED
        | ReadingFlag.STALE
        | ReadingFlag.RESTART
    )
    seen.check(flags | ReadingFlag.CLOCK_JUMP)


@pytest.mark.parametrize("open_address", [open_sink, lambda address: ZenohSource(address, 0.002)])
def test_absent_zenoh_router_is_one_error_line(open_address: Callable[[str], object]) -> None:
    with pytest.raises(
        DrakeTeleopError, match=r"^zenoh://127.0.0.1:\d+/ft: no zenoh router answers"
    ):
        open_address(f"zenoh://127.0.0.1:{free_port()}/ft")


def test_ros_2_node_receives_the_wrench() -> None:
    wrench = np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    with peer("ros_echo", free_port()) as (port, lines):
        sink = open_sink(f"zenoh://127.0.0.1:{port}/tool/contact?frame=tool0&domain=4")
        seen: list[str] = []
        reader = threading.Thread(target=lambda: seen.extend(lines))
        reader.start()
        while reader.is_alive():
            sink.write(CompensatedWrench(1, 0.0, wrench, -wrench, 0))
            reader.join(0.01)
        sink.close()
    kind = f"geometry_msgs::msg::dds_::WrenchStamped_/RIHS01_{HASH}"
    session = seen[0].split("/")[2]
    assert sorted(seen[:2]) == [
        f"@ros2_lv/4/{session}/0/0/NN/%/%/drake_teleop",
        f"@ros2_lv/4/{session}/0/1/MP/%/%/drake_teleop/%tool%contact/{kind}/::,10:,:,:,,",
    ]
    assert seen[2] == f"4/tool/contact/{kind}"
    number, ns, length, _ = struct.unpack("<qqB16s", bytes.fromhex(seen[3]))
    assert number >= 1 and abs(ns * 1e-9 - time.time()) < 60.0 and length == 16
    sec, nanosec, *rest = struct.unpack("<4xiII6s6x6d", bytes.fromhex(seen[4]))
    assert (sec, nanosec) == divmod(ns, 10**9) and rest == [6, b"tool0\0", *wrench]


def test_foxglove_and_mcap(tmp_path: Path) -> None:
    path = tmp_path / "new" / "out.mcap"
    rows = [CompensatedWrench(k, 0.5 * k, np.arange(6.0), -np.arange(6.0), 32) for k in range(3)]
    file, live = open_sink(str(path)), open_sink("foxglove://127.0.0.1:0")
    with connect(f"ws://127.0.0.1:{live.port}", subprotocols=["foxglove.sdk.v1"]) as page:
        page.recv()
        channel = json.loads(page.recv())["channels"][0]["id"]
        asked = {"op": "subscribe", "subscriptions": [{"id": 1, "channelId": channel}]}
        page.send(json.dumps(asked))
        for row in rows:
            file.write(row)
        while True:  # no node answers the subscription
            live.write(rows[2])
            with contextlib.suppress(TimeoutError):
                shown = page.recv(timeout=0.01)
                break
    file.close()
    live.close()
    with path.open("rb") as back:
        schemas, _, messages = zip(*make_reader(back).iter_messages(), strict=True)
    assert [message.log_time for message in messages] == [0, 500_000_000, 1_000_000_000]
    assert messages[2].data == shown[13:]
    wrench = json.loads(messages[2].data)
    assert wrench["contact"]["tau_z"] == 5.0 and wrench["scaled"]["f_y"] == -1.0
    assert wrench["number"] == 2 and wrench["flags"] == ["stale"]
    described = json.loads(schemas[0].data)["properties"]
    assert described.keys() == wrench.keys()
    for name in ("contact", "scaled"):
        assert described[name]["properties"].keys() == wrench[name].keys()


@pytest.mark.parametrize(("real_hz", "named"), [(500.0, True), (1004.0, False)])
def test_netft_with_another_rate_has_only_the_rate_flag(real_hz: float, named: bool) -> None:
    source = NetFtSource("netft://127.0.0.1?counts=1,1&rate=1000&sign=1")
    compensator, flags = Compensator(load(), source.dt), []
    for k in range(round(2.5 * real_hz)):
        now = k / real_hz
        part = source.reading_of_packet(struct.pack(">III6i", k, k, 0, *range(6)), now)
        values = np.concatenate([part.values, AT_REST])
        flags.append(compensator.step(Reading(part.number, part.t, values, part.flags), now).flags)
    source.close()
    assert set(flags[-200:]) == {ReadingFlag.WRONG_RATE if named else 0}


@pytest.mark.parametrize("still", [False, True])
@pytest.mark.parametrize(
    ("status", "flag"),
    [(0, 0), (1 << 30 | 1 << 18 | 1 << 16, 0), (1 << 31, ReadingFlag.DAMAGED),
     (1 << 31 | 1, ReadingFlag.DAMAGED),
     (1 << 17, ReadingFlag.SATURATED), (1 << 31 | 1 << 17, ReadingFlag.SATURATED)],
)  # fmt: skip
def test_netft_status_and_repeated_samples_are_flagged(status: int, flag: int, still: bool) -> None:
    source = NetFtSource("netft://127.0.0.1?counts=2,4&rate=1000&sign=-1")
    counts = [2, -4, 6, 4, -8, 12]
    source.reading_of_packet(struct.pack(">III6i", 1, 7, 0, *counts), 0.0)
    for after, stale in ((0.049, 0), (0.051, ReadingFlag.STALE)):
        record = struct.pack(">III6i", 2, 7 + (not still), status, *counts)
        part = source.reading_of_packet(record, after)
        assert part.flags == flag | (stale if still else 0)
        np.testing.assert_array_equal(part.values, [-1, 2, -3, -1, 2, -3])
    source.close()


@pytest.mark.parametrize(
    ("force", "torque", "newtons", "newton_metres"),
    [("lbf", "N-mm", 4.4482216, 1e-3), ("klbf", "lbf-in", 4448.2216, 0.11298483),
     ("N", "N-m", 1.0, 1.0), ("kN", "kN-m", 1e3, 1e3), ("kgf", "kgf-cm", 9.80665, 0.0980665)],
)  # fmt: skip
def test_netft_page_contains_counts_units_and_rate(
    force: str, torque: str, newtons: float, newton_metres: float
) -> None:
    page = f"""<netft><cfgcpf>4448</cfgcpf><cfgcpt>1000000</cfgcpt><scfgfu>{force}</scfgfu>
        <scfgtu>{torque}</scfgtu><comrdtrate>500</comrdtrate></netft>"""
    counts = [4448 / newtons, 1e6 / newton_metres]
    assert parse_counts_and_rate(page.encode()) == pytest.approx([*counts, 500.0])
    for bad in (b"", b"<a/>", page.encode().replace(b"500", b"0"), page.encode()[:60]):
        with pytest.raises((ValueError, KeyError, SyntaxError)):
            parse_counts_and_rate(bad)
    with pytest.raises(DrakeTeleopError, match=r"page .*; check the host, or give netft://HOST"):
        NetFtSource("netft://127.0.0.9")


@pytest.mark.parametrize("rate_hz", [None, 250.0, 2000.0])
@pytest.mark.parametrize(
    ("query", "counts", "rate"),
    [("", (10, 20), None), ("?counts=2,4", (2, 4), None), ("?rate=1000", (10, 20), 1000.0),
     ("?counts=2,4&rate=1000", (2, 4), 1000.0)],
)  # fmt: skip
def test_counts_and_rate_of_netft_are_those_of_the_address_then_of_the_option_then_of_the_page(
    query: str,
    counts: tuple[int, int],
    rate: float | None,
    rate_hz: float | None,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(netft, "_fetch_counts_per_unit_and_rate", lambda _: [10.0, 20.0, 500.0])
    source = SOURCES["netft"](f"netft://127.0.0.1{query}", rate_hz, ())
    assert 1.0 / source.dt == pytest.approx(rate or rate_hz or 500.0)
    part = source.reading_of_packet(struct.pack(">III6i", 1, 7, 0, *[40] * 6), 0.0)
    np.testing.assert_allclose(part.values, -40.0 / np.repeat(counts, 3))
    source.close()
