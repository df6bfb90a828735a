"""Protocol of the ROS 2 middleware rmw_zenoh, by the library eclipse-zenoh, without ROS.

A topic has the key `DOMAIN/TOPIC/TYPE/HASH`. Messages are CDR, with number, send time and sender
attached. A liveliness token lists a node in the ROS graph.
"""

from __future__ import annotations

import importlib.util
import json
import struct
from typing import Any

from drake_teleop.common.errors import DrakeTeleopError, install_extra
from drake_teleop.robots.address import Address

PORT = 7447
WRENCH_STAMPED = "geometry_msgs/msg/WrenchStamped"
_NUMBER = struct.Struct("<qq")
_ATTACHMENT = struct.Struct("<qqB16s")
_OLD_PREFIX = b"\x0fsequence_number"  # prefix in rmw_zenoh 0.2.0 to 0.2.3 (Jazzy)


def require_libraries(where: str) -> None:
    """Raise DrakeTeleopError if a library is missing."""
    for module, library in (("zenoh", "eclipse-zenoh"), ("rosbags", "rosbags")):
        if importlib.util.find_spec(module) is None:
            raise DrakeTeleopError(
                f"ROS 2 needs the library {library}, which is not installed",
                where=where,
                remedy=install_extra("ros"),
            )


def message_types() -> Any:
    """Return the store of ROS 2 message types of rosbags."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


def open_session(address: Address) -> Any:
    """Return a session with a router, which may start later."""
    import zenoh

    config = zenoh.Config()
    retry = {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 2}
    for topic_key, value in {
        "mode": "client",
        "connect/endpoints": [f"tcp/{address.host}:{address.port}"],
        "connect/timeout_ms": 0,
        "connect/exit_on_failure": False,
        "connect/retry": retry,
        "scouting/multicast/enabled": False,
    }.items():
        config.insert_json5(topic_key, json.dumps(value))
    return zenoh.open(config)


def topic_key(domain: int, topic: str, kind: str, hashed: str = "*") -> str:
    """Return the key of a topic, by default with any hash (Humble has none)."""
    return f"{domain}/{topic}/{_dds(kind)}/{hashed}"


def domain_of(address: Address) -> int:
    """Return the parameter `domain`, by default 0; raise DrakeTeleopError if invalid."""
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
    """Return the attachment of a message, as in rmw_zenoh since 0.2.4."""
    return _ATTACHMENT.pack(number, ns, len(sender), sender)


def message_number(attached: bytes) -> int | None:
    """Return the number in an attachment, None without."""
    if len(attached) == _ATTACHMENT.size:
        return int(_NUMBER.unpack_from(attached)[0])
    if attached.startswith(_OLD_PREFIX) and len(attached) >= len(_OLD_PREFIX) + 8:
        return int(struct.unpack_from("<q", attached, len(_OLD_PREFIX))[0])
    return None


def _dds(kind: str) -> str:
    package, _, name = kind.split("/")
    return f"{package}::msg::dds_::{name}_"
