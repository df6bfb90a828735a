"""Wrenches as topics of ROS 2."""

from __future__ import annotations

import time

import numpy as np

from drake_teleop.common.arrays import Array
from drake_teleop.robots.address import Address
from drake_teleop.robots.ros2 import (
    PORT,
    WRENCH_STAMPED,
    attachment,
    domain_of,
    liveliness_tokens,
    message_types,
    open_session,
    require_libraries,
    topic_key,
    topic_of,
)
from drake_teleop.robots.streams import Compensated

_NODE = "drake_teleop"


class Ros2Sink:
    """WrenchStamped at zenoh://HOST[:PORT]/TOPIC[?frame=NAME&wrench=scaled&domain=N].

    It contains the send time, because stale zeros have no other. Flags are not sent.
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
        """Return WrenchStamped in CDR."""
        kinds = self._types.message_types
        vector, stamp = kinds["geometry_msgs/msg/Vector3"], kinds["builtin_interfaces/msg/Time"]
        header = kinds["std_msgs/msg/Header"](stamp(ns // 10**9, ns % 10**9), self._frame)
        parts = (vector(*map(float, part)) for part in np.split(wrench, 2))
        both = kinds["geometry_msgs/msg/Wrench"](*parts)
        return bytes(self._types.serialize_cdr(kinds[WRENCH_STAMPED](header, both), WRENCH_STAMPED))

    def close(self) -> None:
        """See `Sink`."""
        self._session.close()
