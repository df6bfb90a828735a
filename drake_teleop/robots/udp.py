"""Sources and sink of UDP packets: little-endian, without padding, as in `drake_teleop_udp.h`."""

from __future__ import annotations

import select
import socket
import struct
from contextlib import suppress
from urllib.parse import urlsplit

import numpy as np

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.robots import streams
from drake_teleop.robots.address import Address
from drake_teleop.robots.streams import (
    POSE,
    WRENCH,
    CompensatedWrench,
    Reading,
    ReadingFlag,
    Source,
)

LOCALHOST = "127.0.0.1"
READING_FORMAT = struct.Struct("<4sIQd15d")
WRENCH_POSE_FORMAT = struct.Struct("<4sIQd13d")
COMPENSATED_WRENCH_FORMAT = struct.Struct("<4sIQd12d")
_READING_TAG, _WRENCH_POSE_TAG, _WRENCH_TAG = b"DTW1", b"DTP1", b"DTC1"
_HEADER_FORMAT = struct.Struct("<4sIQd")
_MAX_PACKETS_PER_CALL = 256
_SOCKET_BUFFER_BYTES = 1 << 20  # a tenth of a second at 8 kHz
_SATURATED_FLAG = int(ReadingFlag.SATURATED)


def pack_reading(reading: Reading) -> bytes:
    head = _READING_TAG, reading.flags, reading.number, reading.t
    return READING_FORMAT.pack(*head, *reading.values)


def unpack_reading(packet: bytes) -> Reading:
    """Return the reading in a packet, flagged as damaged if its length or tag is wrong."""
    if len(packet) != READING_FORMAT.size or packet[:4] != _READING_TAG:
        return streams.DAMAGED_READING
    _, flags, number, t = _HEADER_FORMAT.unpack_from(packet)
    values = np.frombuffer(packet, "<f8", 15, _HEADER_FORMAT.size).astype(np.float64)
    return Reading(number, t, values, flags & _SATURATED_FLAG)


def pack_wrench_and_pose(wrench: Reading, pose: Reading) -> bytes:
    head = _WRENCH_POSE_TAG, wrench.flags, wrench.number, wrench.t
    return WRENCH_POSE_FORMAT.pack(*head, *wrench.values, *pose.values)


def unpack_wrench_and_pose(packet: bytes) -> list[Reading]:
    if len(packet) != WRENCH_POSE_FORMAT.size or packet[:4] != _WRENCH_POSE_TAG:
        return [streams.DAMAGED_WRENCH_READING]
    _, flags, number, t = _HEADER_FORMAT.unpack_from(packet)
    values = np.frombuffer(packet, "<f8", 13, _HEADER_FORMAT.size).astype(np.float64)
    wrench = Reading(number, t, values[:6], flags & _SATURATED_FLAG, stream=WRENCH)
    return [wrench, Reading(number, t, values[6:], stream=POSE)]


def pack_wrench(out: CompensatedWrench) -> bytes:
    wrenches = (np.asarray(each, "<f8").tobytes() for each in (out.contact, out.scaled))
    return _HEADER_FORMAT.pack(_WRENCH_TAG, out.flags, out.number, out.t) + b"".join(wrenches)


def unpack_wrench(packet: bytes) -> CompensatedWrench:
    if len(packet) != COMPENSATED_WRENCH_FORMAT.size or packet[:4] != _WRENCH_TAG:
        what = f"its {len(packet)} bytes are not a compensated wrench of drake_teleop_udp.h"
        remedy = f"send {COMPENSATED_WRENCH_FORMAT.size} bytes that begin with {_WRENCH_TAG!r}"
        raise DrakeTeleopError(what, where="packet", remedy=remedy)
    _, flags, number, t, *values = COMPENSATED_WRENCH_FORMAT.unpack(packet)
    return CompensatedWrench(number, t, np.array(values[:6]), np.array(values[6:]), flags)


def host_and_port(address: str, port: int | None = None) -> tuple[str, int]:
    try:
        parts = urlsplit(address)
        host, port = parts.hostname or LOCALHOST, port if parts.port is None else parts.port
    except ValueError:
        host, port = "", None
    what, kind = "has no port from 0 to 65535", address.partition("://")[0]
    remedy = f"give one, such as {kind}://127.0.0.1:49152"
    if query := address.partition("?")[2]:
        what, remedy = f"has the unknown parameters {query!r}", f"remove ?{query}"
    if port is None or query:
        raise DrakeTeleopError(what, where=address, remedy=remedy)
    return host, port


def open_udp_receiver(host: str, port: int) -> socket.socket:
    receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    receiver.setblocking(False)
    try:
        receiver.bind((host, port))
    except OSError as error:
        receiver.close()
        remedy = "give a free port, and as host nothing or an address of this machine"
        raise DrakeTeleopError(str(error), where=f"udp://{host}:{port}", remedy=remedy) from error
    return receiver


class _PacketReceiver(Source):
    def __init__(self, address: str, dt: float) -> None:
        self.dt = dt
        self._socket = open_udp_receiver(*host_and_port(address))
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _SOCKET_BUFFER_BYTES)
        self._poll = select.poll()
        self._poll.register(self._socket, select.POLLIN)
        self.port = self._socket.getsockname()[1]

    def receive_packets(self, timeout_s: float) -> list[bytes]:
        found: list[bytes] = []
        if self._poll.poll(1e3 * timeout_s):
            with suppress(BlockingIOError):
                while len(found) < _MAX_PACKETS_PER_CALL:
                    found.append(self._socket.recv(READING_FORMAT.size + 1))
        return found

    def close(self) -> None:
        self._socket.close()


class UdpSource(_PacketReceiver):
    """Source of readings at udp://[HOST]:PORT."""

    def read(self, timeout_s: float) -> list[Reading] | None:
        return [unpack_reading(packet) for packet in self.receive_packets(timeout_s)]


class UdpWrenchPoseSource(_PacketReceiver):
    """Source of wrenches and poses at posed://[HOST]:PORT[?sign=-1]."""

    streams = WRENCH, POSE

    def __init__(self, address: str, dt: float) -> None:
        self._sign = Address(address, None, allowed=("sign",), host=LOCALHOST).wrench_sign()
        super().__init__(address.partition("?")[0], dt)

    def read(self, timeout_s: float) -> list[Reading] | None:
        found: list[Reading] = []
        for packet in self.receive_packets(timeout_s):
            wrench, *pose = unpack_wrench_and_pose(packet)
            found += [wrench._replace(values=self._sign * wrench.values), *pose]
        return found


class UdpSink:
    """Sink that sends wrenches to udp://HOST:PORT, with or without a receiver."""

    def __init__(self, address: str) -> None:
        host, port = host_and_port(address)
        if not port:
            raise DrakeTeleopError("has port 0", where=address, remedy="give the receiver's port")
        try:
            self._to = socket.gethostbyname(host), port  # once: a name server delays wrenches
        except (OSError, UnicodeError) as error:
            what, remedy = f"{host} is not a known host", "check the name, or give an IPv4 address"
            raise DrakeTeleopError(what, where=address, remedy=remedy) from error
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def write(self, out: CompensatedWrench) -> None:
        """Send a wrench; drop it if it cannot be sent now."""
        with suppress(OSError):
            self._socket.sendto(pack_wrench(out), self._to)

    def close(self) -> None:
        self._socket.close()
