"""Wrench and motion from topics of ROS 2."""

from __future__ import annotations

import math
import queue
from collections.abc import Callable
from typing import Any

import numpy as np

from drake_teleop.common.arrays import Array
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.quaternions import multiply, rotate
from drake_teleop.robots.address import Address
from drake_teleop.robots.ros2 import (
    PORT,
    WRENCH_STAMPED,
    domain_of,
    message_number,
    message_types,
    open_session,
    require_libraries,
    topic_key,
    topic_of,
)
from drake_teleop.robots.streams import IMU, JOINTS, POSE, WRENCH, Flag, Part

_TF = "tf2_msgs/msg/TFMessage"
KINDS = {
    WRENCH: WRENCH_STAMPED,
    "tf": _TF,
    POSE: "geometry_msgs/msg/PoseStamped",
    IMU: "sensor_msgs/msg/Imu",
    JOINTS: "sensor_msgs/msg/JointState",
}
_STREAMS = {"tf": POSE}
_MAX_QUEUED = 4096  # queued messages; newer ones are dropped
_MAX_FRAMES = 64  # frames in a chain


class Messages:
    """Conversion of ROS 2 messages to parts.

    Args:
        frames: parent and child of the pose from transforms; empty for none.
        joints: names of the joints, in the order of the values.
    """

    def __init__(
        self, sign: float, frames: tuple[str, ...] = (), joints: tuple[str, ...] = ()
    ) -> None:
        from rosbags.serde.errors import SerdeError

        self._sign, self._frames, self._types = sign, frames, message_types()
        self._joints = joints
        self._damaged = SerdeError
        self._links: dict[str, tuple[str, Array]] = {}
        self._counts = dict.fromkeys(KINDS, 0)
        for name in KINDS:  # creates the deserializers before the first message
            self.parts(name, b"", b"")
        self._counts = dict.fromkeys(KINDS, 0)

    def parts(self, name: str, message: bytes, attachment: bytes) -> list[Part]:
        """Return the parts of a CDR message with a name in `KINDS`, flagged if it is invalid."""
        self._counts[name] += 1
        number = message_number(attachment)
        if number is None:
            number = self._counts[name]
        stream = _STREAMS.get(name, name)
        try:
            data = self._types.deserialize_cdr(message, KINDS[name])
        except self._damaged:
            return [Part(stream, -1, math.nan, np.full(6, math.nan), int(Flag.DAMAGED))]
        if name == "tf":
            parsed = self._transform_pose(data)
        else:
            values = self._values(name, data)
            parsed = [] if values is None else [(data.header, values)]
        return [
            Part(stream, number, stamp.sec + 1e-9 * stamp.nanosec, values)
            for stamp, values in ((header.stamp, values) for header, values in parsed)
        ]

    def _values(self, name: str, data: Any) -> Array | None:
        """Return the values; None for joints of another device, such as a gripper."""
        if name == WRENCH:
            wrench = data.wrench
            return self._sign * np.array([*_xyz(wrench.force), *_xyz(wrench.torque)])
        if name == POSE:
            return _pose(data.pose.position, data.pose.orientation)
        if name == JOINTS:
            parsed = dict(zip(data.name, data.position, strict=False))
            whole = self._joints and all(joint in parsed for joint in self._joints)
            return np.array([parsed[joint] for joint in self._joints], float) if whole else None
        return np.array([*_xyz(data.linear_acceleration), *_xyz(data.angular_velocity)])

    def _transform_pose(self, data: Any) -> list[tuple[Any, Array]]:
        """Return the pose of the child in the parent, if this message updates it."""
        newest = {each.child_frame_id: each for each in data.transforms}
        for child, each in newest.items():
            motion = each.transform
            self._links[child] = each.header.frame_id, _pose(motion.translation, motion.rotation)
        if not self._frames:
            return []
        parent, frame = self._frames
        pose, header = np.array([1.0, 0, 0, 0, 0, 0, 0]), None
        for _ in range(_MAX_FRAMES):
            if frame == parent:
                return [] if header is None else [(header, pose)]
            if frame not in self._links:
                break
            if frame in newest:
                header = newest[frame].header
            frame, link = self._links[frame]
            pose = _compose(link, pose)
        return []


class Ros2Source:
    """Parts of zenoh://HOST[:PORT]/TOPIC[?pose=TOPIC&imu=TOPIC&joints=TOPIC&tf=PARENT,CHILD&...].

    TOPIC is a WrenchStamped. `/tf` must contain all frames between PARENT and CHILD.
    """

    def __init__(self, address: str, dt: float, joints: tuple[str, ...] = ()) -> None:
        parsed = Address(address, PORT, allowed=("pose", "imu", "joints", "tf", "domain", "sign"))
        self.dt, sign, domain = dt, parsed.sign(), domain_of(parsed)
        topics = {WRENCH: topic_of(parsed, parsed.path)}
        for stream in (POSE, IMU, JOINTS):
            if (text := parsed.parameter(stream)) is not None:
                topics[stream] = topic_of(parsed, text)
        frames: tuple[str, ...] = ()
        if (text := parsed.parameter("tf")) is not None:
            frames, topics["tf"] = tuple(text.split(",")), "tf"
            if len(frames) != 2 or not all(frames):
                raise DrakeTeleopError("tf is not PARENT,CHILD", where=address)
        if JOINTS in topics and not joints:
            raise DrakeTeleopError(
                "joint positions need the model of the arm",
                where=address,
                remedy="give --model and --sensor-frame",
            )
        self.streams = tuple(_STREAMS.get(name, name) for name in topics)
        require_libraries(address)
        self.messages = Messages(sign, frames, joints)
        self._queue: queue.SimpleQueue[tuple[str, bytes, bytes]] = queue.SimpleQueue()
        self._session = open_session(parsed)
        for stream, topic in topics.items():
            self._session.declare_subscriber(
                topic_key(domain, topic, KINDS[stream]), self._callback(stream)
            )

    def read(self, timeout_s: float) -> list[Part] | None:
        """See `PartSource`."""
        found: list[Part] = []
        try:
            found += self.messages.parts(*self._queue.get(timeout=timeout_s))
            while len(found) < _MAX_QUEUED:
                found += self.messages.parts(*self._queue.get_nowait())
        except queue.Empty:
            pass
        return found

    def close(self) -> None:
        """See `PartSource`."""
        self._session.close()

    def _callback(self, stream: str) -> Callable[[Any], None]:
        def take(sample: Any) -> None:
            if self._queue.qsize() < _MAX_QUEUED:
                attachment = sample.attachment
                attachment = b"" if attachment is None else attachment.to_bytes()
                self._queue.put((stream, sample.payload.to_bytes(), attachment))

        return take


def _xyz(v: Any) -> tuple[float, float, float]:
    return v.x, v.y, v.z


def _pose(p: Any, q: Any) -> Array:
    return np.array([q.w, q.x, q.y, q.z, p.x, p.y, p.z])


def _compose(a: Array, b: Array) -> Array:
    turn = tuple(a[:4].tolist())
    p = rotate(turn, tuple(b[4:].tolist()))
    return np.array([*multiply(turn, tuple(b[:4].tolist())), *(a[4:] + p)])
