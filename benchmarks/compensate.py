"""What does `drake-teleop compensate` cost at the rates of robots, over UDP from another process?

`python benchmarks/compensate.py [--json FILE] [--seconds 10]` prints for 1 and 8 kHz:

* processing: time from the received packet to the sent wrench, by the clock: median, 99 %, largest;
* way: time from the sender's stamp to the sent wrench, likewise;
* core: CPU time of the loop over elapsed time; good: share of the packets that arrived in time and
  were compensated. The others were lost, or were late and therefore zero.

Baseline: the same loop, which forwards the same packets. The machine must be otherwise idle: the
largest times are those of the operating system.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import socket
import time
from pathlib import Path
from typing import Any

import numpy as np

from drake_teleop.load.identification import Identification
from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.robots.compensate import compensate_stream
from drake_teleop.robots.compensator import Compensator
from drake_teleop.robots.streams import CompensatedWrench, Reading
from drake_teleop.robots.udp import READING_FORMAT, UdpSink, UdpSource, pack_reading

PHI = phi_from_mass_com_inertia(1.7, [0.01, -0.02, 0.06], np.diag([0.004, 0.005, 0.003]))
RATES = (1000.0, 8000.0)


def send(port: int, rate: float, seconds: float) -> None:
    """Send readings of a moving load, stamped when they are sent, at regular times."""
    t = np.arange(round(rate * seconds)) / rate
    omega = np.column_stack([np.sin(5 * t + k) for k in range(3)])
    alpha = np.column_stack([5 * np.cos(5 * t + k) for k in range(3)])
    motion = 3.0 * omega + [0.0, 0.0, 9.81], omega, alpha
    values = np.hstack([non_contact_wrench(*motion, PHI), *motion])
    packets = [bytearray(pack_reading(Reading(k, 0.0, row))) for k, row in enumerate(values)]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        start = time.monotonic() + 0.1
        for packet, after in zip(packets, t, strict=True):
            if (left := start + after - time.monotonic()) > 0.0:
                time.sleep(left)
            packet[16:24] = np.float64(time.monotonic()).tobytes()
            sender.sendto(packet, ("127.0.0.1", port))
        time.sleep(0.1)
        sender.sendto(b"end", ("127.0.0.1", port))


class Timed:
    """Source and sink that record times; the first packet without a reading ends the run."""

    live = True

    def __init__(self, source: UdpSource, sink: UdpSink) -> None:
        self._source, self._sink, self.dt = source, sink, source.dt
        self._over, self._before = False, 0.0
        self.processing: list[float] = []
        self.way: list[float] = []

    def read(self, timeout_s: float) -> list[Reading] | None:
        """See `Source`."""
        found = None if self._over else self._source.read(timeout_s)
        if found and found[-1].number < 0:
            self._over, found = True, found[:-1]
        self._before = time.perf_counter()
        return found

    def write(self, out: CompensatedWrench) -> None:
        """See `Sink`."""
        self._sink.write(out)
        now = time.perf_counter()
        if not out.flags:
            self.processing.append(now - self._before)
            self.way.append(time.monotonic() - out.t)
        self._before = now

    def close(self) -> None:
        """See both."""
        self._source.close()
        self._sink.close()


class Passed(Compensator):
    """Baseline: forwards its input."""

    def step(self, reading: Reading, now: float) -> CompensatedWrench:
        """Return a copy."""
        self._now = now
        return CompensatedWrench(
            reading.number, reading.t, reading.values[:6], reading.values[:6], 0
        )


def measured(rate: float, seconds: float, kind: type[Compensator]) -> dict[str, Any]:
    """Return the figures of a stream."""
    load = Identification(
        *(PHI, np.zeros(6), 1e-6 * np.eye(16), np.ones(16, bool), 4.0, 0.0, np.full(6, 0.01)),
        *("batch least squares", 100),
    )
    source = UdpSource("udp://:0", 1.0 / rate)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as there:
        there.bind(("127.0.0.1", 0))
        timed = Timed(source, UdpSink(f"udp://127.0.0.1:{there.getsockname()[1]}"))
        loop = kind(load, timed.dt)
        context = multiprocessing.get_context("spawn")
        sender = context.Process(target=send, args=(source.port, rate, seconds), daemon=True)
        sender.start()
        while not (first := timed.read(1.0)):
            pass
        clock, cpu = time.perf_counter(), time.process_time()
        compensate_stream(timed, loop, timed)
        clock, cpu = time.perf_counter() - clock, time.process_time() - cpu
        sender.join()
        timed.close()
    figures: dict[str, Any] = {"core": cpu / clock}
    figures["good"] = (len(timed.way) + len(first)) / round(rate * seconds)
    for name, values in (("processing", timed.processing), ("way", timed.way)):
        p50, p99, most = 1e6 * np.percentile(values, [50, 99, 100])
        figures |= {f"{name}_p50_us": p50, f"{name}_p99_us": p99, f"{name}_max_us": most}
    return figures


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--json", type=Path, help="file for the figures")
    parser.add_argument(
        "--seconds", type=float, default=10.0, help="duration of each stream [s] (default: 10)"
    )
    options = parser.parse_args()
    figures: dict[str, float] = {}
    for rate in RATES:
        for name, kind in (("ours", Compensator), ("baseline", Passed)):
            for key, value in measured(rate, options.seconds, kind).items():
                figures[f"{name}.{rate:.0f}_Hz.{key}"] = round(float(value), 4)
    for name, value in figures.items():
        print(f"{name:40} {value:g}")
    if options.json is not None:
        options.json.write_text(
            json.dumps({"bytes": READING_FORMAT.size, **figures}, indent=2) + "\n"
        )


if __name__ == "__main__":
    main()
