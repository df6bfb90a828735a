"""Packets and lines: no input raises, and outputs can be read."""

from __future__ import annotations

import json
import os
import random
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import polars as pl
import pytest
from full_disk import small_disk
from shown import hearing_ctrl_c
from test_compensator import DT, load, readings

import drake_teleop.robots.udp as udp
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.files import CannotWrite
from drake_teleop.common.interruption import (
    INTERRUPTED_EVENT,
    delayed_signals,
    install_interrupt_handlers,
)
from drake_teleop.robots import lines
from drake_teleop.robots.compensate import (
    TareRequestPort,
    compensate_stream,
    run_compensate_command,
)
from drake_teleop.robots.compensator import Compensator
from drake_teleop.robots.connections import open_sink, open_source
from drake_teleop.robots.lines import JsonLineSource, reading_of_json_line, wrench_json_line
from drake_teleop.robots.streams import (
    DAMAGED_READING,
    POSE,
    WRENCH,
    CompensatedWrench,
    Reading,
    ReadingFlag,
)

HEADER = Path(udp.__file__).with_name("drake_teleop_udp.h").read_text()


def line_of(reading) -> bytes:
    parts = np.split(reading.values, [6, 9, 12])
    names = zip(("wrench", "s", "omega", "alpha"), parts, strict=True)
    return json.dumps({"t": reading.t} | {name: x.tolist() for name, x in names}).encode()


def test_packets_and_lines_are_read_back() -> None:
    reading = readings(3)[2]
    back = udp.unpack_reading(udp.pack_reading(reading._replace(flags=int(ReadingFlag.SATURATED))))
    assert back[:2] == reading[:2] and back.flags == ReadingFlag.SATURATED
    np.testing.assert_array_equal(back.values, reading.values)
    back = reading_of_json_line(line_of(reading), 7)
    assert back.number == 7
    np.testing.assert_array_equal(back.values, reading.values)
    out = CompensatedWrench(5, 0.5, np.arange(6.0), -np.arange(6.0), 34)
    again = udp.unpack_wrench(udp.pack_wrench(out))
    assert again.flags == 34 and again.scaled.tolist() == out.scaled.tolist()
    assert json.loads(wrench_json_line(out))["flags"] == ["damaged", "stale"]
    with pytest.raises(DrakeTeleopError, match=r"^packet: its 1 bytes are not a .*; send"):
        udp.unpack_wrench(b"x")


def test_c_header_has_the_same_layout_and_flags() -> None:
    sizes = {"char": 1, "uint32_t": 4, "uint64_t": 8, "double": 8}
    lengths = []
    for body in re.findall(r"typedef struct \{(.*?)\n\}", HEADER, re.S):
        fields = re.findall(r"^ +(\w+) ([^;]+);", re.sub(r"/\*.*?\*/", "", body), re.M)
        counts = [
            sum(int((re.findall(r"\d+", x) or [1])[0]) for x in n.split(",")) for _, n in fields
        ]
        lengths.append(sum(sizes[kind] * n for (kind, _), n in zip(fields, counts, strict=True)))
    assert lengths == [
        udp.READING_FORMAT.size,
        udp.WRENCH_POSE_FORMAT.size,
        udp.COMPENSATED_WRENCH_FORMAT.size,
    ]
    bits = {name: int(value) for name, value in re.findall(r"DT_(\w+) = (\d+)", HEADER)}
    assert bits == {str(flag.name): flag.value for flag in ReadingFlag}


@pytest.mark.parametrize("kind", ["packet", "line"])
def test_damaged_input_raises_no_error_and_gives_finite_numbers(kind: str) -> None:
    """5000 damaged inputs between good ones; the fuzz target `wrenches` tests more."""
    rng, compensator = random.Random(4), Compensator(load(), DT, gamma=2.0)
    good = [udp.pack_reading(each) if kind == "packet" else line_of(each) for each in readings(50)]
    flags = 0
    for k in range(5000):
        data = bytearray(good[k % 50])
        for _ in range(rng.randrange(1, 4)):
            data[rng.randrange(len(data))] = rng.randrange(256)
        if rng.random() < 0.1:
            data = data[: rng.randrange(len(data))]
        reading = (
            udp.unpack_reading(bytes(data))
            if kind == "packet"
            else reading_of_json_line(bytes(data), k)
        )
        out = compensator.step(reading, k * DT)
        assert np.isfinite([out.t, *out.contact, *out.scaled]).all()
        flags |= out.flags
    assert flags & ReadingFlag.DAMAGED
    for k, reading in enumerate(readings(1200, touched=5.0)):
        out = compensator.step(reading, (6000 + k) * DT)
    assert out.flags & ~ReadingFlag.WRONG_RATE == 0
    np.testing.assert_allclose(out.contact[0], 5.0, atol=1e-6)


@pytest.mark.parametrize(
    "line", [b"", b"[]", b"3", b"{}", b"\xff", b"[" * 4000, b"{" * 9000, b'{"t":1,"wrench":"x"}']
)
def test_invalid_line_is_damaged(line: bytes) -> None:
    assert reading_of_json_line(line, 0) is DAMAGED_READING


@pytest.mark.parametrize("number", [2**64, 10**20, -1, 1e300, 10**400, None, "x", [1]])
def test_number_outside_64_bits_is_damaged(number) -> None:
    line = json.loads(line_of(readings(1)[0]))
    assert (
        reading_of_json_line(json.dumps(line | {"number": number}).encode(), 0) is DAMAGED_READING
    )
    largest = reading_of_json_line(json.dumps(line | {"number": 2**64 - 1}).encode(), 0)
    out = Compensator(load(), DT).step(largest, 0.0)
    assert udp.unpack_wrench(udp.pack_wrench(out)).number == 2**64 - 1


@pytest.mark.parametrize("number", [-1, -5, -(2**40)])
def test_negative_number_of_a_reading_is_sent_as_0(number: int, tmp_path: Path) -> None:
    reading = readings(1)[0]._replace(number=number)
    out = Compensator(load(), DT).step(reading, 0.0)
    assert not out.flags and udp.unpack_wrench(udp.pack_wrench(out)).number == 0
    sink = open_sink(str(tmp_path / "x.csv"))
    sink.write(out)
    assert table_of(tmp_path / "x.csv")["number"].to_list() == [0]


def test_udp_round_trip_accepts_only_this_machine() -> None:
    source = udp.UdpSource("udp://:0", DT)
    with udp.open_udp_receiver(udp.LOCALHOST, 0) as there:
        there.settimeout(5.0)
        sink = open_sink(f"udp://127.0.0.1:{there.getsockname()[1]}")
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            for reading in readings(3, touched=5.0):
                sender.sendto(udp.pack_reading(reading), ("127.0.0.1", source.port))
            sender.sendto(b"x" * 1000, ("127.0.0.1", source.port))
        assert source._socket.getsockname()[0] == "127.0.0.1"
        found = source.read(5.0)
        assert found is not None
        compensator = Compensator(load(), DT)
        for reading in found:
            sink.write(compensator.step(reading, reading.t))
        back = [udp.unpack_wrench(there.recv(1000)) for _ in range(4)]
    assert [row.flags for row in back] == [0, 0, 0, ReadingFlag.DAMAGED]
    np.testing.assert_allclose(back[2].contact[0], 5.0, atol=1e-9)
    assert source.read(0.0) == []
    source.close()
    sink.close()


def test_wrench_and_pose_in_a_packet() -> None:
    wrench = Reading(4, 0.5, np.arange(6.0), int(ReadingFlag.SATURATED), stream=WRENCH)
    pose = Reading(4, 0.5, np.array([1.0, 0, 0, 0, 0.4, 0.1, 0.3]), stream=POSE)
    source = udp.UdpWrenchPoseSource("posed://:0", DT)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for packet in (
            udp.pack_wrench_and_pose(wrench, pose),
            b"x" * udp.WRENCH_POSE_FORMAT.size,
            b"DTP1",
        ):
            sender.sendto(packet, ("127.0.0.1", source.port))
    assert source._socket.getsockname()[0] == "127.0.0.1"
    found = source.read(5.0)
    source.close()
    assert found is not None and [part[:2] for part in found[:2]] == [wrench[:2], pose[:2]]
    assert [part.stream for part in found] == [WRENCH, POSE, WRENCH, WRENCH]
    np.testing.assert_array_equal(found[0].values, -wrench.values)
    np.testing.assert_array_equal(found[1].values, pose.values)
    assert [part.flags for part in found] == [
        ReadingFlag.SATURATED,
        0,
        ReadingFlag.DAMAGED,
        ReadingFlag.DAMAGED,
    ]


def test_lines_from_a_pipe_are_written_to_a_table(tmp_path: Path) -> None:
    out, into = os.pipe()
    lines = b"\n".join(map(line_of, readings(30, touched=5.0)))
    os.write(into, lines[:1000])
    os.write(into, lines[1000:] + b"\n{}\n")
    os.close(into)
    sink, messages = open_sink(str(tmp_path / "x" / "out.csv")), []
    counts = compensate_stream(
        JsonLineSource(out, DT), Compensator(load(), DT), sink, report=messages.append
    )
    os.close(out)
    sink.close()
    table = pl.read_csv(tmp_path / "x" / "out.csv")
    assert counts["wrenches"] == len(table) == 31 and counts["damaged"] == 1
    assert table["contact_f_x"][29] == pytest.approx(5.0) and table["flags"][30] == 2
    assert any(text.endswith("damaged") for text in messages)


def test_ignored_sigint_stays_ignored(monkeypatch: pytest.MonkeyPatch) -> None:
    """A shell ignores it for a background process."""
    installed = {signal.SIGINT: signal.SIG_IGN}
    monkeypatch.setattr(signal, "signal", installed.__setitem__)
    monkeypatch.setattr(signal, "getsignal", installed.get)
    install_interrupt_handlers()
    assert installed.keys() == {signal.SIGINT, signal.SIGTERM}
    assert installed[signal.SIGINT] is signal.SIG_IGN
    installed[signal.SIGINT] = signal.default_int_handler
    install_interrupt_handlers()
    assert installed[signal.SIGINT] is installed[signal.SIGTERM]


def test_lines_without_numbers_are_counted_without_empty_lines() -> None:
    out, into = os.pipe()
    line = line_of(readings(1)[0])
    os.write(into, line + b"\n\n \n" + line + b"\n{}\n" + line + b"\n")
    os.close(into)
    assert [each.number for each in JsonLineSource(out, DT).read(1.0)] == [0, 1, -1, 3]
    os.close(out)


TABLES = ("x.csv", "x.parquet")


def table_of(path: Path) -> pl.DataFrame:
    return (pl.read_csv if path.suffix == ".csv" else pl.read_parquet)(path)


WRITER = """
import sys, time
import numpy as np
from pathlib import Path
from drake_teleop.robots import lines
from drake_teleop.robots.streams import CompensatedWrench
lines.TABLE_WRITE_PERIOD_S = dict.fromkeys(lines.TABLE_WRITE_PERIOD_S, 0.02)
sink = lines.TableSink(Path(sys.argv[1]))
for k in range(10**6):
    sink.write(CompensatedWrench(k, 0.1 * k, np.full(6, k), np.zeros(6), 0))
    print(k, flush=True)
    time.sleep(1e-3)
"""


@pytest.mark.slow
@pytest.mark.parametrize("name", TABLES)
@pytest.mark.parametrize("after", [1, 57, 200])
def test_table_contains_the_rows_before_a_kill(tmp_path: Path, name: str, after: int) -> None:
    writer = subprocess.Popen(
        [sys.executable, "-c", WRITER, str(tmp_path / name)], stdout=subprocess.PIPE, text=True
    )
    assert writer.stdout is not None
    while int(writer.stdout.readline()) < after:
        pass
    writer.kill()
    last = int((writer.stdout.read().split() or [str(after)])[-1])
    writer.wait()
    rows = table_of(tmp_path / name)
    assert rows["number"].to_list() == list(range(len(rows)))
    assert rows["contact_tau_z"].to_list() == list(range(len(rows)))
    assert len(rows) >= last - 60  # of which 1000 come in a second


class FailingSink:
    """Sink that is used until the disk is full, or until an error or Ctrl-C."""

    def __init__(self, sink: lines.TableSink) -> None:
        self.sink, self.written = sink, 0

    def write_until(self, error: type[BaseException], count: int = 10**6) -> None:
        with pytest.raises(error):
            for k in range(self.written, count):
                self.sink.write(CompensatedWrench(k, 1e-5 / (k + 1), np.ones(6), np.zeros(6), 0))
                self.written += 1
            raise error


@pytest.mark.parametrize("name", TABLES)
def test_rows_before_a_full_disk_are_complete(tmp_path, name: str, monkeypatch) -> None:
    monkeypatch.setattr(lines, "TABLE_WRITE_PERIOD_S", dict.fromkeys((".csv", ".parquet"), 1e-3))
    with small_disk(tmp_path, 100_000):
        failing = FailingSink(lines.TableSink(tmp_path / name))
        failing.write_until(CannotWrite)
        with pytest.raises(CannotWrite):
            failing.sink.close()
        found = table_of(tmp_path / name)
        assert found["number"].to_list() == list(range(len(found))) and len(found) > 20
        np.testing.assert_array_equal(found["t"], 1e-5 / np.arange(1, len(found) + 1))


@pytest.mark.parametrize("name", TABLES)
@pytest.mark.parametrize("error", [KeyboardInterrupt, OverflowError])
def test_error_or_interrupt_neither_loses_nor_repeats_rows(tmp_path, name, error) -> None:
    """Interrupts may occur while rows are written."""
    failing, path = FailingSink(lines.TableSink(tmp_path / name)), tmp_path / name
    failing.write_until(error, 50)
    with pytest.MonkeyPatch.context() as patch:
        fail = SimpleNamespace(monotonic=lambda: (_ for _ in ()).throw(error))
        patch.setattr(lines, "time", fail)  # of this module only: other threads use the time
        with pytest.raises(error):
            failing.sink.close()
    failing.sink.close()
    assert table_of(path)["number"].to_list() == list(range(50))


@pytest.mark.parametrize("name", [*TABLES, "x.mcap"])
def test_live_source_keeps_earlier_files(tmp_path, name, monkeypatch) -> None:
    if name == "x.mcap":
        pytest.importorskip("foxglove")
    load().save(tmp_path / "load.json")
    for _ in range(3):
        out, into = os.pipe()
        os.write(into, b"\n".join(map(line_of, readings(30))))
        os.close(into)
        monkeypatch.setattr("sys.stdin", os.fdopen(out))
        run_compensate_command("-", tmp_path / "load.json", str(tmp_path / name), rate_hz=1 / DT)
    earlier = sorted(path.parent.name for path in tmp_path.glob(f"*/{name}"))
    assert earlier == ["earlier-1", "earlier-2"]
    if name != "x.mcap":
        assert len(table_of(tmp_path / "earlier-1" / name)) == 30
        assert len(table_of(tmp_path / name)) == 30


class InterruptedSource:
    """Source with one reading, followed by Ctrl-C."""

    dt, live = DT, True

    def __init__(self) -> None:
        self._left = readings(1)

    def read(self, timeout_s: float) -> list[Reading]:
        if not self._left:
            raise KeyboardInterrupt
        return [self._left.pop()]

    def close(self) -> None:
        pass


def test_ctrl_c_returns_the_counts(capsys: pytest.CaptureFixture[str]) -> None:
    assert compensate_stream(InterruptedSource(), Compensator(load(), DT), open_sink("-")) == {
        "wrenches": 1
    }
    assert json.loads(capsys.readouterr().out)["number"] == 0


class SignalLosingSource(InterruptedSource):
    """Source of which C code loses the KeyboardInterrupt of a signal."""

    def __init__(self, number: signal.Signals) -> None:
        super().__init__()
        self._number = number

    def read(self, timeout_s: float) -> list[Reading]:
        with suppress(KeyboardInterrupt):
            signal.raise_signal(self._number)
        return [self._left.pop()]


@pytest.fixture
def handlers() -> Iterator[None]:
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    install_interrupt_handlers()
    yield
    INTERRUPTED_EVENT.clear()
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.usefixtures("handlers")
def test_loop_ends_at_a_signal_whose_exception_is_lost() -> None:
    source = SignalLosingSource(signal.SIGTERM)
    assert compensate_stream(source, Compensator(load(), DT), open_sink("-")) == {"wrenches": 1}


def test_loop_of_a_program_ends_at_ctrl_c_whose_exception_is_lost() -> None:
    with hearing_ctrl_c():
        for _ in range(2):
            source = SignalLosingSource(signal.SIGINT)
            assert compensate_stream(source, Compensator(load(), DT), open_sink("-")) == {
                "wrenches": 1
            }
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.usefixtures("handlers")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_delayed_signals_are_handled_at_the_end(number: signal.Signals) -> None:
    finished = []

    @delayed_signals()
    def call() -> None:
        signal.raise_signal(number)
        finished.append(True)

    with pytest.raises(KeyboardInterrupt, match="^SIGTERM$" if number == signal.SIGTERM else "^$"):
        call()
    assert finished and INTERRUPTED_EVENT.is_set()


def test_control_port_answers_tare_requests() -> None:
    control = TareRequestPort(0)
    control.answer_request(lambda: "")  # no request
    with udp.open_udp_receiver(udp.LOCALHOST, 0) as asker:
        asker.settimeout(5.0)
        for word in (b"tare\n", b"tear"):
            asker.sendto(word, (udp.LOCALHOST, control.port))
            control.answer_request(Compensator(load(), DT).tare)
        messages = [asker.recv(100) for _ in range(2)]
    control.close()
    assert messages[0].startswith(b"refused: fewer than 0.5 s") and messages[1].startswith(
        b"unknown"
    )


@pytest.mark.parametrize(
    "address",
    ["udp://:x", "udp://:70000", "udp://a", "tcp://:1", "log.csv", "netft://", "rtde://a?x=1"],
)
def test_invalid_address_raises(address: str) -> None:
    with pytest.raises(DrakeTeleopError):
        open_source(address, load(), rate_hz=500.0)
    if address != "log.csv":
        with pytest.raises(DrakeTeleopError):
            open_sink(address)


@pytest.mark.parametrize("query", ["sign=1&sign=-1", "sign=1&sign=1"])
def test_parameter_that_is_given_twice_is_refused(query: str) -> None:
    for kind in ("posed://:0", "rtde://h", "netft://h"):
        with pytest.raises(DrakeTeleopError, match="gives a parameter twice"):
            open_source(f"{kind}?{query}", load(), rate_hz=500.0)


@pytest.mark.parametrize("kind", ["udp", "posed", "foxglove"])
def test_example_of_a_port_has_the_scheme_of_the_address(kind: str) -> None:
    with pytest.raises(DrakeTeleopError, match=f"such as {kind}://127.0.0.1:49152"):
        udp.host_and_port(f"{kind}://127.0.0.1:70000")


@pytest.mark.parametrize("address", ["udp://127.0.0.1:0", "udp://no-such-host.invalid:9"])
def test_sink_without_a_receiver_is_refused_at_once(address: str) -> None:
    with pytest.raises(DrakeTeleopError, match=re.escape(address)):
        open_sink(address)


def test_host_of_a_sink_is_looked_up_once(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    monkeypatch.setattr(socket, "gethostbyname", lambda name: asked.append(name) or udp.LOCALHOST)
    with udp.open_udp_receiver(udp.LOCALHOST, 0) as receiver:
        sink = open_sink(f"udp://slow-name.invalid:{receiver.getsockname()[1]}")
        for k in range(3):
            sink.write(CompensatedWrench(k, 0.0, np.zeros(6), np.ones(6), 0))
        assert [udp.unpack_wrench(receiver.recv(200)).number for _ in range(3)] == [0, 1, 2]
    sink.close()
    assert asked == ["slow-name.invalid"]


def test_earlier_file_stays_if_the_control_port_is_in_use(tmp_path: Path) -> None:
    load().save(tmp_path / "load.json")
    (tmp_path / "x.csv").write_text("earlier")
    with udp.open_udp_receiver(udp.LOCALHOST, 0) as taken:
        options = {"rate_hz": 1 / DT, "control": taken.getsockname()[1]}
        with pytest.raises(DrakeTeleopError, match="give a free port"):
            run_compensate_command(
                "udp://:0", tmp_path / "load.json", str(tmp_path / "x.csv"), **options
            )
    assert (tmp_path / "x.csv").read_text() == "earlier"


@pytest.mark.parametrize("query", ["sign=1", "wrench=scaled&domain=3", "x"])
def test_parameters_without_effect_are_refused(query: str) -> None:
    for open_address in (
        lambda: open_source(f"udp://:0?{query}", load(), rate_hz=500.0),
        lambda: open_sink(f"udp://127.0.0.1:9?{query}"),
    ):
        with pytest.raises(DrakeTeleopError, match=re.escape(f"{query!r}; remove ?{query}")):
            open_address()
    open_source("posed://:0?sign=1", load(), rate_hz=500.0).close()


@pytest.mark.parametrize("delay", [0.02, -0.005, 1.0])
def test_delay_of_a_source_with_its_own_motion_is_refused(delay: float) -> None:
    with pytest.raises(DrakeTeleopError, match=r"already contains the motion .* remove --delay"):
        open_source("udp://:0", load(), rate_hz=500.0, delay=delay)
    for valid in ("auto", 0.0):
        open_source("udp://:0", load(), rate_hz=500.0, delay=valid).close()
    open_source("posed://:0", load(), rate_hz=500.0, delay=delay).close()


def test_live_source_requires_a_rate() -> None:
    with pytest.raises(DrakeTeleopError, match="give --rate HZ"):
        open_source("udp://:0", load())
