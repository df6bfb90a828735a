"""Source for Universal Robots: wrench, pose and tool acceleration by RTDE, with ur_rtde."""

from __future__ import annotations

import os
import select
import subprocess
import sys
import time
from itertools import chain, pairwise

import numpy as np

from drake_teleop.common.errors import DrakeTeleopError, require_library
from drake_teleop.common.vectors import quaternion_exponential
from drake_teleop.robots.address import Address
from drake_teleop.robots.rtde_reader import SAMPLE_FORMAT
from drake_teleop.robots.streams import ACCELERATION, POSE, WRENCH, Reading, Source

RTDE_PORT = 30004
_FIRST_SAMPLES_TIMEOUT_S = 10.0  # wait for the robot at the start
_MIN_READER_RESTART_PERIOD_S = 0.2  # between two starts of the child
_RATE_MEASUREMENT_SAMPLES, _READ_BLOCK_BYTES = 5, 65536


class RtdeSource(Source):
    """Source of wrench, TCP pose and tool acceleration at rtde://HOST[?sign=-1], 500 or 125 Hz."""

    streams = WRENCH, POSE, ACCELERATION

    def __init__(self, address: str) -> None:
        parsed = Address(address, RTDE_PORT, allowed=("sign",))
        if parsed.port != RTDE_PORT:
            what = "RTDE always uses port 30004"
            raise DrakeTeleopError(what, where=address, remedy="remove the port")
        require_library("rtde_receive", "ur_rtde", "robots", address)
        self._host, self._sign = parsed.host, parsed.wrench_sign()
        self._partial, self._started = b"", 0.0
        self._start_reader_process()
        quaternion_exponential((0.0, 0.0, 0.0))  # loads compiled code before the first sample
        self._first: list[tuple[float, ...]] = []
        deadline = time.monotonic() + _FIRST_SAMPLES_TIMEOUT_S
        while len(self._first) < _RATE_MEASUREMENT_SAMPLES:
            if (left := deadline - time.monotonic()) <= 0.0:
                self.close()
                what, remedy = "no robot answers on port 30004", "check the host, and enable RTDE"
                raise DrakeTeleopError(what, where=address, remedy=remedy)
            self._first += self._read_samples(left)
        spacing = min(abs(b[0] - a[0]) for a, b in pairwise(self._first))
        self.dt = 0.002 if spacing < 0.005 else 0.008

    def read(self, timeout_s: float) -> list[Reading] | None:
        samples, self._first = [*self._first, *self._read_samples(timeout_s)], []
        readings = (readings_of_sample(sample, self.dt, self._sign) for sample in samples)
        return list(chain.from_iterable(readings))

    def _read_samples(self, timeout_s: float) -> list[tuple[float, ...]]:
        if not select.select([self._pipe], [], [], max(0.0, timeout_s))[0]:
            return []
        block = os.read(self._pipe, _READ_BLOCK_BYTES)
        if not block:
            if time.monotonic() - self._started > _MIN_READER_RESTART_PERIOD_S:
                self.close()
                self._start_reader_process()
            else:
                time.sleep(min(timeout_s, _MIN_READER_RESTART_PERIOD_S))
            return []
        block = self._partial + block
        complete = len(block) - len(block) % SAMPLE_FORMAT.size
        self._partial = block[complete:]
        return list(SAMPLE_FORMAT.iter_unpack(block[:complete]))

    def _start_reader_process(self) -> None:
        code = "from drake_teleop.robots.rtde_reader import main; main()"
        self._pipe, into = os.pipe()
        words, nowhere = [sys.executable, "-c", code, self._host, str(into)], subprocess.DEVNULL
        self._child = subprocess.Popen(words, pass_fds=[into], stdout=nowhere, stderr=nowhere)
        os.close(into)
        self._partial, self._started = b"", time.monotonic()

    def close(self) -> None:
        self._child.kill()
        self._child.wait()
        os.close(self._pipe)


def readings_of_sample(sample: tuple[float, ...], dt: float, sign: float) -> list[Reading]:
    t, values = sample[0], np.array(sample[1:])
    number = round(t / dt) if abs(t) < 1e12 else -1
    values_of_stream = {
        WRENCH: sign * values[:6],
        POSE: np.array([*quaternion_exponential(sample[10:13]), *sample[7:10]]),
        ACCELERATION: values[12:15],
    }
    return [Reading(number, t, each, stream=stream) for stream, each in values_of_stream.items()]
