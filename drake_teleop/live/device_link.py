"""Station side of a haptic device: receives poses and sends forces."""

from __future__ import annotations

import ipaddress
import subprocess
import sys
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import numpy as np

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.vectors import conjugate_quaternion, quaternion_product
from drake_teleop.live import device_packets
from drake_teleop.live.device_guard import COMMAND_TIMEOUT_S
from drake_teleop.live.device_packets import CLUTCH_OPEN_FLAG, DeviceState, ForceCommand
from drake_teleop.live.inputs import inputs_at_displacement
from drake_teleop.robots.udp import LOCALHOST, host_and_port, open_udp_receiver

_CLIENT_EXIT_TIMEOUT_S = 2.0  # s
_MAX_PACKETS_PER_POLL = 256  # packets per poll
_LINK_STATISTICS_PACKETS = 2000  # packets in the statistics of lateness
# Duration of the open clutch after silence, while the hand moves to the device's pose [s].
_OPEN_CLUTCH_TIME_S = 0.05


class DeviceLink:
    """UDP link to one device client on this machine; 50 ms of silence admit another client.

    An address haply://HOST:PORT also starts the client.

    Attributes:
        refused: number of invalid packets and packets of other senders.
        refusal: reason of the last refusal.
        lost: number of packets that did not arrive.
    """

    def __init__(self, address: str) -> None:
        kind = address.partition("://")[0]
        if kind not in ("udp", "haply"):
            what = "is not the address of a haptic device"
            remedy = "use udp://127.0.0.1:PORT or haply://localhost:10001"
            raise DrakeTeleopError(what, where=address, remedy=remedy)
        host, port = host_and_port(address) if kind == "udp" else (LOCALHOST, 0)
        if not _is_loopback(host):
            what = "is not an address of this machine (other senders could move the arm)"
            remedy = "use udp://127.0.0.1:PORT, and run the device's client on this machine"
            raise DrakeTeleopError(what, where=address, remedy=remedy)
        self._socket = open_udp_receiver(host, port)
        self.port = int(self._socket.getsockname()[1])
        self.refused = self.lost = 0
        self.refusal = ""
        self._peer: Any = None
        self._state: DeviceState | None = None
        self._last_arrival, self._connected_at, self._polled_at = -np.inf, np.inf, 0.0
        self._origin: DeviceState | None = None
        # Arrival minus the device's time; the minimum is the clock offset.
        self._latencies: deque[float] = deque(maxlen=_LINK_STATISTICS_PACKETS)
        self._force_ages: deque[float] = deque(maxlen=_LINK_STATISTICS_PACKETS)
        self._client: subprocess.Popen[bytes] | None = None
        if kind == "haply":
            station = f"udp://{LOCALHOST}:{self.port}"
            client = [sys.executable, "-m", "drake_teleop.live.device_client", address, station]
            self._client = subprocess.Popen(client, stdout=subprocess.DEVNULL)

    def receive_state(self, now: float) -> DeviceState | None:
        """Receive waiting packets; return the newest device state, None if silent for 50 ms."""
        self._polled_at = now
        for _ in range(_MAX_PACKETS_PER_POLL):
            try:
                packet, peer = self._socket.recvfrom(device_packets.MAX_PACKET_BYTES + 1)
            except (BlockingIOError, ConnectionError):
                break
            self._accept_or_refuse_packet(packet, peer, now)
        return None if self.is_device_silent(now) else self._state

    def _accept_or_refuse_packet(self, packet: bytes, peer: Any, now: float) -> None:
        state, silent = device_packets.unpack_state(packet), self.is_device_silent(now)
        if state is None or (peer != self._peer and not silent):
            self.refused += 1
            second = "is from a second device"
            self.refusal = second if state else device_packets.rejection_reason(packet)
            return
        if silent:  # a new device, or the same one after a pause
            self._peer, self._connected_at, self._state = peer, now, None
            self._latencies.clear()
        elif self._state is not None:
            if state.number <= self._state.number:  # already counted as lost
                self.lost -= state.number < self._state.number
                return
            self.lost += state.number - self._state.number - 1
        self._state, self._last_arrival = state, now
        self._origin = self._origin or state
        self._latencies.append(now - state.t)
        self._force_ages.append(state.force_age_s)

    def is_device_silent(self, now: float) -> bool:
        return now - self._last_arrival > COMMAND_TIMEOUT_S

    def send_wrench(self, wrench: np.ndarray) -> None:
        """Send the wrench (6,) [N, N m] to the device, as answer to its newest state."""
        if self._state is None or self._peer is None:
            return
        command = ForceCommand(self._state.number, self._state.t, tuple(wrench.tolist()))
        try:
            self._socket.sendto(device_packets.pack_force(command), self._peer)
        except OSError:  # a later attempt would send an old force
            return

    def reset_pose_origin(self, now: float) -> None:
        """Let `hand_inputs` return zero displacement at the device's present pose."""
        self._origin, self._connected_at = self._state, now

    def hand_inputs(self, now: float) -> Mapping[str, float]:
        """Return inputs x ... rz and held for the device's displacement; held = 0 if silent."""
        state = self.receive_state(now)
        if state is None or self._origin is None:
            return {"held": 0, "clutch": 0}
        first = self._origin
        moved = np.subtract(state.position, first.position)
        back = conjugate_quaternion(first.quaternion_wxyz)
        values = inputs_at_displacement(moved, quaternion_product(state.quaternion_wxyz, back))
        if state.flags & CLUTCH_OPEN_FLAG or now - self._connected_at < _OPEN_CLUTCH_TIME_S:
            values["clutch"] = 0
        return values

    def link_statistics(self) -> dict[str, float]:
        """Return number of lost packets, percentiles of packet lateness and force age [ms]."""
        late = np.array(self._latencies or [0.0])
        behind = np.array(self._force_ages or [0.0])
        return {
            "late_p99_ms": float(1e3 * (np.percentile(late, 99) - late.min())),
            "behind_p50_ms": float(1e3 * np.median(behind)),
            "behind_p99_ms": float(1e3 * np.percentile(behind, 99)),
            "lost": float(max(self.lost, 0)),
        }

    def status_text(self) -> str:
        if not self.refused:
            return self._connection_text()
        reason = f"the last one {self.refusal}"
        return f"{self._connection_text()}. Refused packets: {self.refused}; {reason}"

    def _connection_text(self) -> str:
        if self.is_device_silent(self._polled_at):
            what = "The device is silent: no force" if self._peer else "No device yet"
            return f"{what} (udp://127.0.0.1:{self.port})"
        figures = self.link_statistics()
        text = f"Device: packets arrive up to {figures['late_p99_ms']:.1f} ms late (99 of 100)"
        if figures["behind_p99_ms"] > 0.0:
            text += (
                f"; its force belongs to its position {figures['behind_p50_ms']:.1f} ms ago"
                f" (99 of 100: up to {figures['behind_p99_ms']:.1f} ms)"
            )
        return text + (f"; {figures['lost']:.0f} packets lost" if figures["lost"] else "")

    def close(self) -> None:
        self._socket.close()
        if self._client is None:
            return
        self._client.terminate()
        try:
            self._client.wait(_CLIENT_EXIT_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._client.kill()
            self._client.wait()


def _is_loopback(host: str) -> bool:
    with suppress(ValueError):
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    return False
