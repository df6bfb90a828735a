"""Experimental source and sink for ROS 2 with rmw_zenoh, by eclipse-zenoh, without ROS."""

from __future__ import annotations

import json
import queue
import struct
import time
from functools import partial
from typing import Any

import numpy as np

from drake_teleop.common.errors import DrakeTeleopError, require_library
from drake_teleop.common.numeric import Array
from drake_teleop.robots.address import Address
from drake_teleop.robots.ros2 import (
    MESSAGE_TYPE_OF_TOPIC,
    SOURCE_ADDRESS_PARAMETERS,
    WRENCH_STAMPED,
    MessageConverter,
    checked_topic_name,
    domain_of_address,
    reading_for_damaged_message,
    topics_frames_and_streams,
)
from drake_teleop.robots.streams import CompensatedWrench, Reading, Source

DEFAULT_ROUTER_PORT = 7447
_SEQUENCE_NUMBER_AND_TIME_FORMAT = struct.Struct("<qq")
_ATTACHMENT_FORMAT = struct.Struct("<qqB16s")
_OLD_ATTACHMENT_PREFIX = b"\x0fsequence_number"  # prefix in rmw_zenoh 0.2.0 to 0.2.3 (Jazzy)
_MAX_QUEUED_MESSAGES = 4096  # newer ones are dropped
_NODE_NAME = "drake_teleop"


def require_libraries(where: str) -> None:
    require_library("zenoh", "eclipse-zenoh", "ros", where)
    require_library("rosbags", "rosbags", "ros", where)


def ros2_type_store() -> Any:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


def open_session(address: Address) -> Any:
    """Return a session with the zenoh router at `address`; it reconnects after an interruption."""
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
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        what = f"no zenoh router answers on port {address.port}"
        remedy = "check the host, and start the router: ros2 run rmw_zenoh_cpp rmw_zenohd"
        raise DrakeTeleopError(what, where=address.text, remedy=remedy) from error


def topic_key(domain: int, topic: str, message_type: str, type_hash: str = "*") -> str:
    """Return the zenoh key of a topic; "*" is any hash of the message type."""
    return f"{domain}/{topic}/{_dds_type_name(message_type)}/{type_hash}"


def liveliness_tokens(
    domain: int, session: str, node: str, topic: str, message_type: str, type_hash: str
) -> list[str]:
    """Return the Zenoh liveliness tokens by which ROS 2 finds a node with one publisher."""
    here = f"@ros2_lv/{domain}/{session}/0"
    name = "%" + topic.replace("/", "%")
    return [
        f"{here}/0/NN/%/%/{node}",
        f"{here}/1/MP/%/%/{node}/{name}/{_dds_type_name(message_type)}/{type_hash}/::,10:,:,:,,",
    ]


def make_attachment(number: int, time_ns: int, sender: bytes) -> bytes:
    """Return number, time [ns] and sender id of a message as bytes (rmw_zenoh since 0.2.4)."""
    return _ATTACHMENT_FORMAT.pack(number, time_ns, len(sender), sender)


def number_in_attachment(attached: bytes) -> int | None:
    if len(attached) == _ATTACHMENT_FORMAT.size:
        return int(_SEQUENCE_NUMBER_AND_TIME_FORMAT.unpack_from(attached)[0])
    number = attached.removeprefix(_OLD_ATTACHMENT_PREFIX)[:8]
    if attached.startswith(_OLD_ATTACHMENT_PREFIX) and len(number) == 8:
        return int.from_bytes(number, "little", signed=True)
    return None


def _dds_type_name(message_type: str) -> str:
    package, _, name = message_type.split("/")
    return f"{package}::msg::dds_::{name}_"


class CdrConverter(MessageConverter):
    """Converter from CDR (common data representation) of ROS 2 to readings."""

    def __init__(
        self, sign: float, frames: tuple[str, ...] = (), joints: tuple[str, ...] = ()
    ) -> None:
        from rosbags.serde.errors import SerdeError

        super().__init__(sign, frames, joints)
        self._types, self._damaged = ros2_type_store(), SerdeError
        self._counts = dict.fromkeys(MESSAGE_TYPE_OF_TOPIC, 0)
        for name in MESSAGE_TYPE_OF_TOPIC:  # creates the deserializers before the first message
            self.readings_of_cdr(name, b"", b"")
        self._counts = dict.fromkeys(MESSAGE_TYPE_OF_TOPIC, 0)

    def readings_of_cdr(self, name: str, message: bytes, attachment: bytes) -> list[Reading]:
        self._counts[name] += 1
        number = number_in_attachment(attachment)
        if number is None:
            number = self._counts[name]
        try:
            data = self._types.deserialize_cdr(message, MESSAGE_TYPE_OF_TOPIC[name])
        except self._damaged:
            return [reading_for_damaged_message(name)]
        return self.readings_of_message(name, data, number)


class ZenohSource(Source):
    """Source at zenoh://HOST[:PORT]/TOPIC[?pose=TOPIC&...], parameters as for `Ros2Source`.

    The first TOPIC is a WrenchStamped. `/tf` must contain all frames between PARENT and CHILD.
    """

    def __init__(self, address: str, dt: float, joints: tuple[str, ...] = ()) -> None:
        parsed = Address(address, DEFAULT_ROUTER_PORT, allowed=SOURCE_ADDRESS_PARAMETERS)
        self.dt, sign, domain = dt, parsed.wrench_sign(), domain_of_address(parsed)
        topics, frames, self.streams = topics_frames_and_streams(parsed, joints)
        require_libraries(address)
        self.messages = CdrConverter(sign, frames, joints)
        self._queue: queue.SimpleQueue[tuple[str, bytes, bytes]] = queue.SimpleQueue()
        self._session = open_session(parsed)
        for stream, topic in topics.items():
            key = topic_key(domain, topic, MESSAGE_TYPE_OF_TOPIC[stream])
            self._session.declare_subscriber(key, partial(self._enqueue_message, stream))

    def read(self, timeout_s: float) -> list[Reading] | None:
        found: list[Reading] = []
        try:
            found += self.messages.readings_of_cdr(*self._queue.get(timeout=timeout_s))
            while len(found) < _MAX_QUEUED_MESSAGES:
                found += self.messages.readings_of_cdr(*self._queue.get_nowait())
        except queue.Empty:
            pass
        return found

    def close(self) -> None:
        self._session.close()

    def _enqueue_message(self, stream: str, sample: Any) -> None:
        if self._queue.qsize() < _MAX_QUEUED_MESSAGES:
            attachment = sample.attachment
            attachment = b"" if attachment is None else attachment.to_bytes()
            self._queue.put((stream, sample.payload.to_bytes(), attachment))


class ZenohSink:
    """Sink for WrenchStamped at zenoh://HOST[:PORT]/TOPIC[?frame=NAME&wrench=scaled&domain=N].

    Flags are not sent.
    """

    def __init__(self, address: str) -> None:
        parsed = Address(address, DEFAULT_ROUTER_PORT, allowed=("frame", "wrench", "domain"))
        domain, topic = domain_of_address(parsed), checked_topic_name(parsed, parsed.path)
        self._which = parsed.requested_wrench_name()
        require_libraries(address)
        self._types = ros2_type_store()
        self._frame = parsed.optional_parameter("frame") or ""
        type_hash = self._types.hash_rihs01(WRENCH_STAMPED)
        self._session = open_session(parsed)
        zid = str(self._session.info.zid())
        self._sender, self._number = bytes.fromhex(zid.rjust(32, "0"))[:16], 0
        self._tokens = [
            self._session.liveliness().declare_token(each)
            for each in liveliness_tokens(domain, zid, _NODE_NAME, topic, WRENCH_STAMPED, type_hash)
        ]
        key = topic_key(domain, topic, WRENCH_STAMPED, type_hash)
        self._publisher = self._session.declare_publisher(key, express=True)

    def write(self, out: CompensatedWrench) -> None:
        ns = time.time_ns()
        self._number += 1
        message = self.wrench_message(getattr(out, self._which), ns)
        self._publisher.put(message, attachment=make_attachment(self._number, ns, self._sender))

    def wrench_message(self, wrench: Array, ns: int) -> bytes:
        """Return a WrenchStamped in CDR; `wrench` (6,) [N, N m], `ns`: its time stamp [ns]."""
        types = self._types.types
        vector, stamp = types["geometry_msgs/msg/Vector3"], types["builtin_interfaces/msg/Time"]
        header = types["std_msgs/msg/Header"](stamp(ns // 10**9, ns % 10**9), self._frame)
        parts = (vector(*map(float, part)) for part in np.split(wrench, 2))
        both = types["geometry_msgs/msg/Wrench"](*parts)
        return bytes(self._types.serialize_cdr(types[WRENCH_STAMPED](header, both), WRENCH_STAMPED))

    def close(self) -> None:
        self._session.close()
