"""The station's end of a haptic device: the newest pose in, a force out, and how late they are.

One device at a time: whoever sends first, until it has been silent for 50 ms. What is no packet,
repeats an earlier one or was overtaken by a later one changes nothing but a counter.
"""

from __future__ import annotations

import ipaddress
from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.quaternions import conjugate, logarithm, multiply
from drake_teleop.live.device_guard import SILENT
from drake_teleop.live.device_packets import (
    CLUTCH_OPEN,
    LONGEST,
    DeviceState,
    ForceCommand,
    packed_force,
    refusal,
    unpacked_state,
)
from drake_teleop.live.inputs import ANGLE, LENGTH
from drake_teleop.robots.udp import endpoint, listening

_MOST = 256  # packets at once
_REMEMBERED = 2000  # packets, of which lateness is told
# After silence the hand's place is taken anew, with the clutch open for so long [s].
_SETTLES = 0.05


class DeviceLink:
    """Listens on a port of this machine for a device; see the module.

    Attributes:
        refused: packets that were none, or another sender's.
        refusal: why the last of them was.
        lost: packets that never came, or came too late.
        port: that it listens on.

    Args:
        address: udp://127.0.0.1:PORT.

    Raises:
        DrakeTeleopError: for another machine's address, or a port that is taken.
    """

    def __init__(self, address: str) -> None:
        host, port = endpoint(address)
        if not _is_here(host):
            raise DrakeTeleopError(
                "is not this machine: whoever can send there moves the arm",
                where=address,
                remedy="give udp://127.0.0.1:PORT, and run the device's client here",
            )
        self._socket = listening(host, port)
        self._socket.setblocking(False)
        self.port = int(self._socket.getsockname()[1])
        self.refused = self.lost = 0
        self.refusal = ""
        self._peer: Any = None
        self._state: DeviceState | None = None
        self._heard, self._since, self._now = -np.inf, np.inf, 0.0
        self._origin: DeviceState | None = None
        # Arrival less the device's time, whose least is the difference of the clocks; `behind`.
        self._waited: deque[float] = deque(maxlen=_REMEMBERED)
        self._behind: deque[float] = deque(maxlen=_REMEMBERED)

    def poll(self, now: float) -> DeviceState | None:
        """Takes what has come; the newest state, None if there is none or it is silent.

        Args:
            now: a steady clock [s].
        """
        self._now = now
        for _ in range(_MOST):
            try:
                packet, peer = self._socket.recvfrom(LONGEST + 1)
            except (BlockingIOError, ConnectionError):
                break
            self._take(packet, peer, now)
        return None if self.silent(now) else self._state

    def _take(self, packet: bytes, peer: Any, now: float) -> None:
        state, silent = unpacked_state(packet), self.silent(now)
        if state is None or (peer != self._peer and not silent):
            self.refused += 1
            self.refusal = refusal(packet) if state is None else "is from a second device"
            return
        if silent:  # a new one, or the same one again
            self._peer, self._since, self._state = peer, now, None
            self._waited.clear()
        elif self._state is not None:
            if state.number <= self._state.number:  # was counted as lost
                self.lost -= state.number < self._state.number
                return
            self.lost += state.number - self._state.number - 1
        self._state, self._heard = state, now
        self._origin = self._origin or state
        self._waited.append(now - state.t)
        self._behind.append(state.behind)

    def silent(self, now: float) -> bool:
        """Whether nothing has come for 50 ms."""
        return now - self._heard > SILENT

    def send(self, wrench: np.ndarray) -> None:
        """Answers the newest state with the wrench (6,) that the hand shall feel [N, N m]."""
        if self._state is None or self._peer is None:
            return
        command = ForceCommand(self._state.number, self._state.t, tuple(wrench.tolist()))
        try:
            self._socket.sendto(packed_force(command), self._peer)
        except OSError:  # what cannot be sent now is too old later
            return

    def begin_anew(self, now: float) -> None:
        """Where the device is next is where the station's device starts."""
        self._origin, self._since = self._state, now

    def lead(self, now: float) -> Mapping[str, float]:
        """What the device makes of the `Inputs`: it holds the hand's place, or nobody does.

        Where it was first is where the station's device starts. Its clutch counts if it is open.
        """
        state = self.poll(now)
        if state is None or self._origin is None:
            return {"held": 0, "clutch": 0}
        first = self._origin
        turn = logarithm(multiply(state.orientation, conjugate(first.orientation)))
        values: dict[str, float] = {"held": 1}
        for k, name in enumerate("xyz"):
            values[name] = (state.position[k] - first.position[k]) / LENGTH
            values["r" + name] = turn[k] / ANGLE
        if state.flags & CLUTCH_OPEN or now - self._since < _SETTLES:
            values["clutch"] = 0
        return values

    def figures(self, now: float) -> dict[str, float]:
        """Packets a second, lateness of packets and of the force at the hand, p99 [ms]; lost."""
        late = np.array(self._waited or [0.0])
        behind = np.array(self._behind or [0.0])
        spent = min(now - self._since, 1e-3 * _REMEMBERED) if len(self._waited) > 1 else np.inf
        return {
            "rate_hz": float(len(late) / max(spent, 1e-3)),
            "late_p99_ms": float(1e3 * (np.percentile(late, 99) - late.min())),
            "behind_p50_ms": float(1e3 * np.median(behind)),
            "behind_p99_ms": float(1e3 * np.percentile(behind, 99)),
            "lost": float(max(self.lost, 0)),
        }

    def text(self) -> str:
        """The same at the last `poll` in words, for the page, and what was refused."""
        return self._heard_text() + self.refused_text()

    def refused_text(self) -> str:
        """Return how many packets were refused, and why the last was; "" if none was."""
        if not self.refused:
            return ""
        return f". Refused packets: {self.refused}; the last one {self.refusal}"

    def _heard_text(self) -> str:
        now = self._now
        if self.silent(now):
            what = "The device is silent: no force" if self._peer else "No device yet"
            return f"{what} (udp://127.0.0.1:{self.port})"
        found = self.figures(now)
        said = f"Device: packets arrive up to {found['late_p99_ms']:.1f} ms late (99 of 100)"
        if found["behind_p99_ms"] > 0.0:
            said += (
                f"; its force belongs to its position {found['behind_p50_ms']:.1f} ms ago"
                f" (99 of 100: up to {found['behind_p99_ms']:.1f} ms)"
            )
        return said + (f"; {found['lost']:.0f} packets lost" if found["lost"] else "")

    def close(self) -> None:
        """Frees the port."""
        self._socket.close()


def _is_here(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
