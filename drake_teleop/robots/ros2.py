"""ROS 2 without ROS: what its middleware rmw_zenoh puts into a zenoh network, by eclipse-zenoh.

A topic is the key `DOMAIN/TOPIC/TYPE/HASH`, a message CDR, which rosbags writes and reads, with an
attachment: number, time of sending, and who sent it. What is in the graph (`ros2 topic list`) says
so by a liveliness token. All sessions are clients of a router, `ros2 run rmw_zenoh_cpp
rmw_zenohd`: nothing listens here, and a router that is not there yet is waited for.
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
_SENT = struct.Struct("<qqB16s")
_NAMED = b"\x0fsequence_number"  # how Jazzy's rmw_zenoh 0.2.0 to 0.2.3 began


def needed(where: str) -> None:
    """Refuses to go on without the libraries.

    Raises:
        DrakeTeleopError: naming the one that is missing.
    """
    for module, library in (("zenoh", "eclipse-zenoh"), ("rosbags", "rosbags")):
        if importlib.util.find_spec(module) is None:
            raise DrakeTeleopError(
                f"ROS 2 is spoken by the library {library}, which is not installed",
                where=where,
                remedy=install_extra("ros"),
            )


def types() -> Any:
    """The messages of ROS 2: `deserialize_cdr`, `serialize_cdr`, `hash_rihs01`, `types`."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


def opened(told: Address) -> Any:
    """A session with the router at that address, now or when it is there."""
    import zenoh

    config = zenoh.Config()
    retry = {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 2}
    for key, value in {
        "mode": "client",
        "connect/endpoints": [f"tcp/{told.host}:{told.port}"],
        "connect/timeout_ms": 0,
        "connect/exit_on_failure": False,
        "connect/retry": retry,
        "scouting/multicast/enabled": False,
    }.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def key(domain: int, topic: str, kind: str, hashed: str = "*") -> str:
    """Of a topic; with any hash, Humble's having none."""
    return f"{domain}/{topic}/{_dds(kind)}/{hashed}"


def domain_of(told: Address) -> int:
    """`domain=N`, 0 without.

    Raises:
        DrakeTeleopError: if it is none.
    """
    text = told.text_of("domain") or "0"
    if not (text.isdecimal() and text.isascii() and int(text) <= 232):
        raise DrakeTeleopError(f"domain={text!r} is not 0 to 232", where=told.text)
    return int(text)


def topic_of(told: Address, text: str) -> str:
    """A topic's name as keys have it, without the slash in front.

    Raises:
        DrakeTeleopError: if it is none.
    """
    topic = text.strip("/")
    if not topic or not topic.isascii() or not topic.replace("/", "_").isidentifier():
        raise DrakeTeleopError(
            f"{text!r} is no topic", where=told.text, remedy="zenoh://HOST/ft_sensor/wrench, say"
        )
    return topic


def tokens(domain: int, session: str, node: str, topic: str, kind: str, hashed: str) -> list[str]:
    """Of a node with one publisher, which keeps its last ten messages."""
    here = f"@ros2_lv/{domain}/{session}/0"
    name = "%" + topic.replace("/", "%")
    return [
        f"{here}/0/NN/%/%/{node}",
        f"{here}/1/MP/%/%/{node}/{name}/{_dds(kind)}/{hashed}/::,10:,:,:,,",
    ]


def attachment(number: int, ns: int, sender: bytes) -> bytes:
    """Of a message, as rmw_zenoh has it since 0.2.4."""
    return _SENT.pack(number, ns, len(sender), sender)


def number_of(attached: bytes) -> int | None:
    """The number in an attachment of either form; None if there is none."""
    if len(attached) == _SENT.size:
        return int(_NUMBER.unpack_from(attached)[0])
    if attached.startswith(_NAMED) and len(attached) >= len(_NAMED) + 8:
        return int(struct.unpack_from("<q", attached, len(_NAMED))[0])
    return None


def _dds(kind: str) -> str:
    package, _, name = kind.split("/")
    return f"{package}::msg::dds_::{name}_"
