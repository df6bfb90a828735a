"""Loop of the command `drake-teleop compensate`, from a source to a sink."""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import numpy as np

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.files import move_earlier_recordings, refuse_to_replace_inputs
from drake_teleop.common.interruption import INTERRUPTED_EVENT, raise_interrupt_on_sigint
from drake_teleop.load.identification import Identification
from drake_teleop.logs.causal import low_pass_delay_s
from drake_teleop.logs.processing import notes_on_undetermined_load
from drake_teleop.robots.assembly import ReadingAssembler
from drake_teleop.robots.changes import ZeroAndLoadMonitor
from drake_teleop.robots.compensator import SCALE_NAMES, TARE_AVERAGING_S, Compensator
from drake_teleop.robots.connections import is_file_address, open_sink, open_source
from drake_teleop.robots.lines import flag_names
from drake_teleop.robots.streams import CompensatedWrench, Sink, Source
from drake_teleop.robots.udp import LOCALHOST, open_udp_receiver
from drake_teleop.robots.watch import ContactAndLoadMonitor, StreamContactDetector

_ZERO_WRENCH_SEND_PERIOD_S = 0.01  # period of zero wrenches while nothing comes


class TareRequestPort:
    """UDP port on localhost that accepts the request `tare`."""

    def __init__(self, port: int) -> None:
        self._socket = open_udp_receiver(LOCALHOST, port)
        self.port = self._socket.getsockname()[1]

    def answer_request(self, tare: Callable[[], str]) -> None:
        try:
            request, sender = self._socket.recvfrom(64)
            valid = request.strip() == b"tare"
            answer = tare() if valid else "unknown request: send tare"
            self._socket.sendto(answer.encode(), sender)
        except OSError:  # no request, or the sender is gone
            pass

    def close(self) -> None:
        self._socket.close()


def compensate_stream(
    source: Source,
    compensator: Compensator,
    sink: Sink,
    *,
    control: TareRequestPort | None = None,
    tare: bool = False,
    changes: ZeroAndLoadMonitor | None = None,
    report: Callable[[str], None] = lambda _: None,
) -> Counter[str]:
    """Compensate readings until the end or Ctrl-C; return counts of wrenches and flags."""
    counts: Counter[str] = Counter(wrenches=0)
    tare_count = np.inf if not tare else round(TARE_AVERAGING_S / source.dt)

    def write_and_count(out: CompensatedWrench) -> None:
        sink.write(out)
        counts["wrenches"] += 1
        for name in flag_names(out.flags) if out.flags else ():
            if counts[name] == 0:
                report(f"t = {out.t:.3f} s: {name}")
            counts[name] += 1

    with suppress(KeyboardInterrupt), raise_interrupt_on_sigint():
        while not INTERRUPTED_EVENT.is_set():
            if isinstance(source, ReadingAssembler):
                source.track_delay_with(compensator.load)
            left_s = compensator.time_to_stale(time.monotonic()) or _ZERO_WRENCH_SEND_PERIOD_S
            if (readings := source.read(min(left_s, _ZERO_WRENCH_SEND_PERIOD_S))) is None:
                break
            stale = compensator.stale_output(time.monotonic()) if source.live else None
            if stale and not readings:
                write_and_count(stale)
            for reading in readings:
                out = compensator.step(reading, time.monotonic() if source.live else reading.t)
                write_and_count(out)
                if changes is not None:
                    changes.add_reading(reading, out.flags)
                if compensator.good_readings_in_row >= tare_count:
                    tare_count = np.inf
                    report(f"tare {compensator.tare()}")
            if control is not None:
                control.answer_request(compensator.tare)
    return counts


def run_compensate_command(
    source: str,
    load: Path,
    sink: str,
    *,
    cutoff_hz: float | None = 30.0,
    sensor_range: tuple[float, float] | None = None,
    predicted: bool = False,
    tare: bool = False,
    watch: bool = False,
    free: Path | None = None,
    control: int | None = None,
    attach: Callable[[Callable[[Identification], Compensator]], Any] | None = None,
    **options: Any,
) -> None:
    """Run the command `compensate`; messages go to stderr.

    Args:
        sensor_range: range of the sensor: force [N], torque [N m].
        free: log of free motion, for contact detection.
        control: UDP port that accepts the request `tare`.
        attach: hook of the ROS 2 node: from the maker of compensators to the one in use.
        options: those of `Compensator.set_scales` and `open_source`.
    """
    found = Identification.load(load)
    scales = {name: options.pop(name) for name in SCALE_NAMES if name in options}
    limits = None if sensor_range is None else np.repeat(sensor_range, 3)
    readings = open_source(source, found, cutoff_hz=cutoff_hz, **options)
    input_files = [load, *readings.files]

    def make_compensator(load: Identification) -> Compensator:
        if load.weight_removed != found.weight_removed:
            what = "has another `weight_removed` than the load at the start"
            remedy = "end this command, and start it with the other load"
            raise DrakeTeleopError(what, where="load", remedy=remedy)
        dt, delay_readings = readings.dt, getattr(readings, "delay_readings", 0)
        ahead_s = delay_readings * dt + low_pass_delay_s(dt, cutoff_hz) if predicted else 0.0
        stream = dt, cutoff_hz, options.get("delay", "auto"), ahead_s
        detector = None if free is None else StreamContactDetector(load, free, *stream)
        input_files.extend(() if detector is None else detector.files)
        lag: Any = {"delay_readings": delay_readings, "predicted": predicted}
        monitors: Any = {"watch": ContactAndLoadMonitor(load, dt, cutoff_hz) if watch else None}
        monitors |= {"detector": detector, "sensor_range": limits}
        return Compensator(load, dt, cutoff_hz=cutoff_hz, **scales, **lag, **monitors)

    compensator = make_compensator(found) if attach is None else attach(make_compensator)

    def report(text: str) -> None:
        print(text, file=sys.stderr, flush=True)

    control_port = None if control is None else TareRequestPort(control)
    file = [Path(sink)] if is_file_address(sink) else []
    for path in file:
        refuse_to_replace_inputs(path, *input_files)
    if earlier := move_earlier_recordings(*file if readings.live else ()):
        report(f"{sink} exists; the existing file is moved to {earlier}")
    wrenches = open_sink(sink)
    changes = ZeroAndLoadMonitor(readings.dt, live=readings.live, report=report) if watch else None
    for note in notes_on_undetermined_load(found):
        report(f"warning: {note}")
    late_s = 0.0 if predicted else compensator.lag_s
    report(f"output delay: {1e3 * (getattr(readings, 'lag_s', 0.0) + late_s):.1f} ms")
    stale_ms = 1e3 * compensator.stale_age_s
    report(f"readings are stale after {stale_ms:.0f} ms; invalid wrenches are zero")
    if sensor_range is None:
        report("no --range: saturation of the sensor is not detected")
    try:
        loop: Any = {"control": control_port, "tare": tare, "changes": changes, "report": report}
        counts = compensate_stream(readings, compensator, wrenches, **loop)
        report(", ".join(f"{name} {count}" for name, count in counts.items()))
        if isinstance(readings, ReadingAssembler):
            report(f"output delay at the end: {1e3 * (readings.lag_s + late_s):.1f} ms")
            report(f"delay of motion behind wrench at the end: {1e3 * readings.delay_s:.1f} ms")
    finally:
        with ExitStack() as stack:
            for each in (wrenches, readings, control_port, changes):
                if each is not None:
                    stack.callback(each.close)
