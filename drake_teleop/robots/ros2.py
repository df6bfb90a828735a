"""Source and sink for ROS 2 with rmw_zenoh, by the library eclipse-zenoh, without ROS.

A topic has the key `DOMAIN/TOPIC/TYPE/HASH`. Messages are CDR, with number, send time and sender
attached.
"""

from __future__ import annotations

import json
import queue
import struct
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from drake_teleop.common.errors import DrakeTeleopError, require_library
from drake_teleop.common.numeric import Array
from drake_teleop.common.vectors import multiply, rotate
from drake_teleop.robots.address import Address
from drake_teleop.robots.streams import DAMAGED_WRENCH, IMU, JOINTS, POSE, WRENCH, Compensated, Part

PORT = 7447
WRENCH_STAMPED = "geometry_msgs/msg/WrenchStamped"
_NUMBER = struct.Struct("<qq")
_ATTACHMENT = struct.Struct("<qqB16s")
_OLD_PREFIX = b"\x0fsequence_number"  # prefix in rmw_zenoh 0.2.0 to 0.2.3 (Jazzy)
KINDS = {
    WRENCH: WRENCH_STAMPED,
    "tf": "tf2_msgs/msg/TFMessage",
    POSE: "geometry_msgs/msg/PoseStamped",
    IMU: "sensor_msgs/msg/Imu",
    JOINTS: "sensor_msgs/msg/JointState",
}
_STREAMS = {"tf": POSE}
_MAX_QUEUED = 4096  # queued messages; newer ones are dropped
_MAX_FRAMES = 64  # frames in a chain
_NODE = "drake_teleop"


def require_libraries(where: str) -> None:
    """Raise DrakeTeleopError, for the address `where`, if a library is missing."""
    require_library("zenoh", "eclipse-zenoh", "ros", where)
    require_library("rosbags", "rosbags", "ros", where)


def message_types() -> Any:
    """Return the store of ROS 2 message types of rosbags."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


def open_session(address: Address) -> Any:
    """Return a session with the zenoh router at `address`, which may start later."""
    import zenoh

    config = zenoh.Config()
    retry = {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 2}
    for key, value in {
        "mode": "client",
        "connect/endpoints": [f"tcp/{address.host}:{address.port}"],
        "connect/timeout_ms": 0,
        "connect/exit_on_failure": False,
        "connect/retry": retry,
        "scouting/multicast/enabled": False,
    }.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def topic_key(domain: int, topic: str, kind: str, hashed: str = "*") -> str:
    """Return the zenoh key of a topic, by default with any hash (ROS Humble has none)."""
    return f"{domain}/{topic}/{_dds(kind)}/{hashed}"


def domain_of(address: Address) -> int:
    """Return the ROS domain in an address, by default 0; raise DrakeTeleopError if invalid."""
    text = address.parameter("domain") or "0"
    if not (text.isdecimal() and text.isascii() and int(text) <= 232):
        raise DrakeTeleopError(f"domain={text!r} is not 0 to 232", where=address.text)
    return int(text)


def topic_of(address: Address, text: str) -> str:
    """Return a topic name without leading slash; raise DrakeTeleopError if invalid."""
    topic = text.strip("/")
    if not topic or not topic.isascii() or not topic.replace("/", "_").isidentifier():
        raise DrakeTeleopError(
            f"{text!r} is not a topic",
            where=address.text,
            remedy="give one, such as zenoh://HOST/ft_sensor/wrench",
        )
    return topic


def liveliness_tokens(
    domain: int, session: str, node: str, topic: str, kind: str, hashed: str
) -> list[str]:
    """Return the liveliness tokens of a node with one publisher."""
    here = f"@ros2_lv/{domain}/{session}/0"
    name = "%" + topic.replace("/", "%")
    return [
        f"{here}/0/NN/%/%/{node}",
        f"{here}/1/MP/%/%/{node}/{name}/{_dds(kind)}/{hashed}/::,10:,:,:,,",
    ]


def attachment(number: int, ns: int, sender: bytes) -> bytes:
    """Return the attachment of a message, as in rmw_zenoh since 0.2.4; `ns`: send time."""
    return _ATTACHMENT.pack(number, ns, len(sender), sender)


def message_number(attached: bytes) -> int | None:
    """Return the message number in an attachment; None if it is absent."""
    if len(attached) == _ATTACHMENT.size:
        return int(_NUMBER.unpack_from(attached)[0])
    if attached.startswith(_OLD_PREFIX) and len(attached) >= len(_OLD_PREFIX) + 8:
        return int(struct.unpack_from("<q", attached, len(_OLD_PREFIX))[0])
    return None


def _dds(kind: str) -> str:
    package, _, name = kind.split("/")
    return f"{package}::msg::dds_::{name}_"


class Messages:
    """Converter of ROS 2 messages to parts (samples of single streams).

    Args:
        sign: see `Address.sign`.
        frames: parent and child frame of the pose from `/tf`; empty for none.
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
        """Return the parts of a CDR message, flagged if it is invalid; `name`: see `KINDS`."""
        self._counts[name] += 1
        number = message_number(attachment)
        if number is None:
            number = self._counts[name]
        stream = _STREAMS.get(name, name)
        try:
            data = self._types.deserialize_cdr(message, KINDS[name])
        except self._damaged:
            return [DAMAGED_WRENCH._replace(stream=stream)]
        if name == "tf":
            samples = self._transform_pose(data)
        else:
            values = self._values(name, data)
            samples = [] if values is None else [(data.header.stamp, values)]
        return [
            Part(stream, number, stamp.sec + 1e-9 * stamp.nanosec, values)
            for stamp, values in samples
        ]

    def _values(self, name: str, data: Any) -> Array | None:
        if name == WRENCH:
            wrench = data.wrench
            return self._sign * np.array([*_xyz(wrench.force), *_xyz(wrench.torque)])
        if name == POSE:
            return _pose(data.pose.position, data.pose.orientation)
        if name == JOINTS:
            positions = dict(zip(data.name, data.position, strict=False))
            if not self._joints or not all(joint in positions for joint in self._joints):
                return None
            return np.array([positions[joint] for joint in self._joints], float)
        return np.array([*_xyz(data.linear_acceleration), *_xyz(data.angular_velocity)])

    def _transform_pose(self, data: Any) -> list[tuple[Any, Array]]:
        newest = {each.child_frame_id: each for each in data.transforms}
        for child, each in newest.items():
            X = each.transform
            self._links[child] = each.header.frame_id, _pose(X.translation, X.rotation)
        if not self._frames:
            return []
        parent, frame = self._frames
        pose, stamp = np.array([1.0, 0, 0, 0, 0, 0, 0]), None
        for _ in range(_MAX_FRAMES):
            if frame == parent:
                return [] if stamp is None else [(stamp, pose)]
            if frame not in self._links:
                break
            if frame in newest:
                stamp = newest[frame].header.stamp
            frame, link = self._links[frame]
            pose = _compose(link, pose)
        return []


class Ros2Source:
    """Source at zenoh://HOST[:PORT]/TOPIC[?pose=TOPIC&imu=TOPIC&joints=TOPIC&tf=PARENT,CHILD&...].

    The first TOPIC is a WrenchStamped. `/tf` must contain all frames between PARENT and CHILD.
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
        def enqueue(sample: Any) -> None:
            if self._queue.qsize() < _MAX_QUEUED:
                attachment = sample.attachment
                attachment = b"" if attachment is None else attachment.to_bytes()
                self._queue.put((stream, sample.payload.to_bytes(), attachment))

        return enqueue


def _xyz(v: Any) -> tuple[float, float, float]:
    return v.x, v.y, v.z


def _pose(p: Any, q: Any) -> Array:
    return np.array([q.w, q.x, q.y, q.z, p.x, p.y, p.z])


def _compose(a: Array, b: Array) -> Array:
    q = tuple(a[:4].tolist())
    p = rotate(q, tuple(b[4:].tolist()))
    return np.array([*multiply(q, tuple(b[:4].tolist())), *(a[4:] + p)])


class Ros2Sink:
    """Sink for WrenchStamped at zenoh://HOST[:PORT]/TOPIC[?frame=NAME&wrench=scaled&domain=N].

    Messages contain the send time, because stale zeros have no other. Flags are not sent.
    """

    def __init__(self, address: str) -> None:
        parsed = Address(address, PORT, allowed=("frame", "wrench", "domain"))
        domain, topic = domain_of(parsed), topic_of(parsed, parsed.path)
        which = parsed.choice("wrench", ("contact", "scaled"))
        require_libraries(address)
        self._types, self._which = message_types(), which
        self._frame = parsed.parameter("frame") or ""
        hashed = self._types.hash_rihs01(WRENCH_STAMPED)
        self._session = open_session(parsed)
        session = str(self._session.info.zid())
        self._sender, self._number = bytes.fromhex(session.rjust(32, "0"))[:16], 0
        self._tokens = [
            self._session.liveliness().declare_token(token)
            for token in liveliness_tokens(domain, session, _NODE, topic, WRENCH_STAMPED, hashed)
        ]
        self._publisher = self._session.declare_publisher(
            topic_key(domain, topic, WRENCH_STAMPED, hashed), express=True
        )

    def write(self, out: Compensated) -> None:
        """See `Sink`."""
        ns = time.time_ns()
        self._number += 1
        message = self.message(getattr(out, self._which), ns)
        self._publisher.put(message, attachment=attachment(self._number, ns, self._sender))

    def message(self, wrench: Array, ns: int) -> bytes:
        """Return a WrenchStamped in CDR; `wrench` (6,) [N, N m], `ns`: its time stamp [ns]."""
        kinds = self._types.types
        vector, stamp = kinds["geometry_msgs/msg/Vector3"], kinds["builtin_interfaces/msg/Time"]
        header = kinds["std_msgs/msg/Header"](stamp(ns // 10**9, ns % 10**9), self._frame)
        parts = (vector(*map(float, part)) for part in np.split(wrench, 2))
        both = kinds["geometry_msgs/msg/Wrench"](*parts)
        return bytes(self._types.serialize_cdr(kinds[WRENCH_STAMPED](header, both), WRENCH_STAMPED))

    def close(self) -> None:
        """See `Sink`."""
        self._session.close()
