"""Each source against a peer in a process of its own, which does all that can go wrong."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import sockets
from test_compensator import PHI, load

from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.robots.compensator import STALE_S, Compensator
from drake_teleop.robots.netft import NetFtSource
from drake_teleop.robots.rtde import RtdeSource
from drake_teleop.robots.streams import IMU, POSE, WRENCH, Compensated, Flag, Part, Reading, Source

PEER = Path(__file__).with_name("peer.py")
AT_REST = np.array([0.0, 0.0, 9.81, *np.zeros(6)])
ADDRESS = f"127.{os.getpid() // 250 % 250}.{os.getpid() % 250}.7"  # ur_rtde has but one port
LOST = {12, 13, 14}
OFFSETS = np.array([0.0, 2.0, 3.0, 0.1, 0.2, 0.3])


@contextmanager
def peer(*words: str) -> Iterator[str]:
    """The peer while it runs, as it says where it is."""
    with subprocess.Popen([sys.executable, "-S", PEER, *words], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        try:
            yield process.stdout.readline().decode().strip()
        finally:
            process.kill()


class Seen(list[Compensated]):
    """What the loop of `compensate` makes of a source, with the times when."""

    def __init__(self, source: Source, last: int) -> None:
        """Until a good wrench of the last number after a restart; the tool is at rest."""
        self.at: list[float] = []
        self.parts: list[Part] = []
        compensator = Compensator(load(), source.dt, cutoff_hz=None)
        compensator.offsets = OFFSETS - non_contact_wrench(*np.split(AT_REST, 3), PHI)
        begun, end = False, time.monotonic() + 5.0
        while time.monotonic() < end:
            parts = source.read(0.01)
            assert parts is not None
            if (stale := compensator.idle(time.monotonic())) and not parts:
                self._take(stale)
            self.parts += parts
            for part in parts:
                if part.stream != WRENCH:
                    continue
                values = np.concatenate([part.values, AT_REST])
                reading = Reading(part.number, part.t, values, part.flags)
                out = self._take(compensator.step(reading, time.monotonic()))
                begun |= bool(out.flags & Flag.RESTART)
                if begun and not out.flags and out.number >= last:
                    return

    def _take(self, out: Compensated) -> Compensated:
        self.append(out)
        self.at.append(time.monotonic())
        return out

    def check(self, flags: Flag) -> None:
        """The story of the peer: named, zero, and good again by itself."""
        assert np.isfinite([[*row.contact, *row.scaled, row.t] for row in self]).all()
        assert not any(row.contact.any() or row.scaled.any() for row in self if row.flags)
        named = Flag(0)
        for row in self:
            named |= Flag(row.flags)
        assert named & flags == flags
        good = [row for row in self if not row.flags]
        for row in good:
            wanted = [row.number % 500, 0.0, 0.0, 0.0, 0.0, 0.0]
            np.testing.assert_allclose(row.contact, wanted, atol=1e-9)
        for flag in flags:
            at = max(k for k, row in enumerate(self) if row.flags & flag)
            assert not all(row.flags for row in self[at:]), flag
        first = next(k for k, row in enumerate(self) if row.flags == Flag.STALE)
        assert STALE_S <= self.at[first] - self.at[first - 1] < STALE_S + 0.04


def test_netft() -> None:
    with peer("netft") as port:
        source = NetFtSource(f"netft://127.0.0.1:{port}?counts=1000,1000&sign=1", 0.002)
        seen = Seen(source, 10)
        source.close()
    flags = Flag.REORDERED | Flag.DAMAGED | Flag.SATURATED | Flag.STALE | Flag.RESTART
    seen.check(flags)
    assert not LOST & {row.number for row in seen}


def test_rtde() -> None:
    sockets.on_purpose.add(30004)  # of this machine, but not 127.0.0.1
    with peer("rtde", ADDRESS) as host:
        source = RtdeSource(f"rtde://{host}?sign=1")
        seen = Seen(source, 510)
        source.close()
    assert source.dt == 0.002
    seen.check(Flag.REORDERED | Flag.NOT_FINITE | Flag.STALE | Flag.RESTART)
    assert not {50000 + number for number in LOST} & {row.number for row in seen}
    poses = [part.values for part in seen.parts if part.stream == POSE]
    np.testing.assert_allclose(poses[0], [np.cos(0.5), 0, 0, np.sin(0.5), 0.4, 0.1, 0.3])
    assert next(part.values.tolist() for part in seen.parts if part.stream == IMU) == [0, 0, 9.81]
