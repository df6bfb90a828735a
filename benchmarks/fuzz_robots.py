"""Inputs of `fuzz.py` for the sources of `compensate`: records, samples, messages.

A case is a sequence of a device's packets. The output of the loop must always be finite, within the
sensor's range, and zero if it is flagged.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from drake_teleop.load.identification import Identification
from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.robots.assembly import ReadingAssembler, WrenchAndMotionStreams
from drake_teleop.robots.compensator import Compensator
from drake_teleop.robots.netft import RECORD_FORMAT, NetFtSource
from drake_teleop.robots.ros2 import MESSAGE_TYPE_OF_TOPIC
from drake_teleop.robots.ros2_zenoh import CdrConverter, make_attachment, ros2_type_store
from drake_teleop.robots.rtde import readings_of_sample
from drake_teleop.robots.rtde_reader import SAMPLE_FORMAT
from drake_teleop.robots.streams import (
    IMU,
    JOINTS,
    NONZERO_WRENCH_FLAGS,
    POSE,
    WRENCH,
    Reading,
)

LOAD = Identification(
    phi_from_mass_com_inertia(1.7, [0.01, -0.02, 0.06], np.diag([0.004, 0.005, 0.003])),
    *(np.zeros(6), 1e-6 * np.eye(16), np.ones(16, bool), 4.0, 0.0, np.full(6, 0.01)),
    *("batch least squares", 100),
)
DT, COUNT, RANGE = 0.002, 60, 50.0
_JOINTS = ("shoulder", "elbow")
_WRENCH = (1.0, -2.0, 16.0, 0.1, 0.2, 0.3)
_SENT, _FRAMES = 33, ("base", "tool0")


def records(_: Path) -> list[bytes]:
    """Return records of RDT."""
    counts = [round(1000 * x) for x in _WRENCH]
    return [b"".join(RECORD_FORMAT.pack(k, 7 * k, 0, *counts) for k in range(COUNT))]


def samples(_: Path) -> list[bytes]:
    """Return samples of RTDE."""
    pose, gravity = (0.4, 0.1, 0.3, 0.1, 0.2, 0.3), (0.0, 0.0, 9.81)
    rows = [(100.0 + DT * k, *_WRENCH, *pose, *gravity) for k in range(COUNT)]
    return [b"".join(SAMPLE_FORMAT.pack(*row) for row in rows)]


def messages(_: Path) -> list[bytes]:
    """Return messages of ROS 2, each with its attachment."""
    return [
        b"".join(_message(name, k) for k in range(COUNT // 2) for name in MESSAGE_TYPE_OF_TOPIC)
    ]


def _message(name: str, k: int) -> bytes:
    store = ros2_type_store()
    kinds = {kind.split("/")[-1]: made for kind, made in store.types.items()}
    ns = round(1e9 * (1.7e9 + DT * k))
    header = kinds["Header"](kinds["Time"](ns // 10**9, ns % 10**9), "base")
    vector, turn = kinds["Vector3"](*_WRENCH[:3]), kinds["Quaternion"](0.0, 0.6, 0.0, 0.8)
    nine = np.zeros(9)
    data = {
        WRENCH: lambda: (kinds["Wrench"](vector, kinds["Vector3"](*_WRENCH[3:])),),
        POSE: lambda: (kinds["Pose"](kinds["Point"](0.4, 0.1, 0.3), turn),),
        IMU: lambda: (turn, nine, vector, nine, vector, nine),
        JOINTS: lambda: (list(_JOINTS), np.array([0.1, 0.2]), np.zeros(2), np.zeros(2)),
    }
    if name == "tf":
        motion = kinds["Transform"](vector, turn)
        link = kinds["TransformStamped"](header, "tool0", motion)
        message = kinds["TFMessage"]([link])
    else:
        message = store.types[MESSAGE_TYPE_OF_TOPIC[name]](header, *data[name]())
    return bytes(store.serialize_cdr(message, MESSAGE_TYPE_OF_TOPIC[name])) + make_attachment(
        k, ns, b"x" * 16
    )


class _Told:
    dt = DT

    def __init__(self, *streams: str) -> None:
        self.streams = streams

    def read(self, timeout_s: float) -> list[Reading]:
        return []

    def close(self) -> None:
        pass


def netft_wrenches(path: Path) -> None:
    """Check the loop's outputs for records of RDT and a valid IMU."""
    source = NetFtSource("netft://127.0.0.1?counts=1000,1000&rate=500", None)
    still = np.array([0.0, 0.0, 9.81, 0.0, 0.0, 0.0])

    def parts() -> Iterator[Reading]:
        for k, packet in enumerate(_pieces(path.read_bytes(), RECORD_FORMAT.size)):
            yield Reading(k, DT * k, still, stream=IMU)
            yield source.reading_of_packet(packet, DT * k)

    _checked(ReadingAssembler(WrenchAndMotionStreams(_Told(WRENCH), _Told(IMU))), parts())
    source._socket.close()


def rtde_wrenches(path: Path) -> None:
    """Check the loop's outputs for samples of RTDE."""
    whole = [
        each
        for each in _pieces(path.read_bytes(), SAMPLE_FORMAT.size)
        if len(each) == SAMPLE_FORMAT.size
    ]
    parts = (
        part for each in whole for part in readings_of_sample(SAMPLE_FORMAT.unpack(each), DT, -1.0)
    )
    _checked(ReadingAssembler(WrenchAndMotionStreams(_Told(WRENCH, POSE))), parts)


_SIZES = {name: len(_message(name, 0)) for name in MESSAGE_TYPE_OF_TOPIC}
_MESSAGES = CdrConverter(-1.0, _FRAMES, _JOINTS)


def ros_wrenches(path: Path) -> None:
    """Check the loop's outputs for messages of ROS 2, with poses from both topics."""
    content, parts = path.read_bytes(), []
    while content:
        for name, size in _SIZES.items():
            message, content = content[:size], content[size:]
            parts += _MESSAGES.readings_of_cdr(name, message[:-_SENT], message[-_SENT:])
    _checked(ReadingAssembler(WrenchAndMotionStreams(_Told(WRENCH, POSE))), iter(parts))


def _pieces(content: bytes, size: int) -> list[bytes]:
    return [content[k : k + size] for k in range(0, len(content), size)]


def _checked(assembly: ReadingAssembler, parts: Iterator[Reading]) -> None:
    compensator = Compensator(LOAD, DT, gamma=2.0, sensor_range=np.full(6, RANGE))
    for k, part in enumerate(parts):
        found: list[Reading] = assembly.readings_completed_by(part._replace(arrival=DT * k / 3))
        for reading in found:
            out = compensator.step(reading, DT * k / 3)
            numbers = np.array([out.t, *out.contact, *out.scaled])
            zero = bool(out.flags & ~NONZERO_WRENCH_FLAGS)
            if not np.isfinite(numbers).all() or (np.abs(numbers[1:]) > RANGE).any():
                raise AssertionError(f"{out!r}")
            if zero and numbers[1:].any():
                raise AssertionError(f"{out!r}")
    compensator.tare()
