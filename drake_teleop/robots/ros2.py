"""Source and sink for ROS 2 by rclpy, in one node of this process."""

from __future__ import annotations

import importlib
import time
from collections import Counter
from collections.abc import Callable
from functools import cache
from types import SimpleNamespace
from typing import Any

from drake_teleop.common.errors import DrakeTeleopError, require_library
from drake_teleop.common.interruption import delayed_signals
from drake_teleop.robots import ros2_messages, streams
from drake_teleop.robots.address import Address
from drake_teleop.robots.lines import flag_names

_NODE_NAME = "drake_teleop"
_MAX_DIAGNOSTICS_PERIOD_S = 1.0
_MAX_QUEUED_MESSAGES = 256  # of each stream
_MAX_SERVICE_SPIN_PERIOD_S = 0.05  # longest time between two waits for services [s]


class RosNode:
    """Node of this process in a ROS domain; `spin` executes its callbacks in the calling thread."""

    @delayed_signals()
    def __init__(self, domain: int) -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.signals import SignalHandlerOptions

        self._context = rclpy.Context()
        handlers = SignalHandlerOptions.NO
        rclpy.init(context=self._context, domain_id=domain, signal_handler_options=handlers)
        self.node = rclpy.create_node(_NODE_NAME, context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)

    def spin(self, timeout_s: float) -> None:
        self._executor.spin_once(timeout_sec=timeout_s)

    @delayed_signals()
    def close(self) -> None:
        if self._context.ok():
            shared_node.cache_clear()
            self._executor.shutdown()
            self.node.destroy_node()
            self._context.shutdown()


@cache
def shared_node(domain: int) -> RosNode:
    return RosNode(domain)


def parse_ros2_address(text: str, allowed: tuple[str, ...]) -> Address:
    """Return the parsed address ros2://TOPIC[?...], which has no host."""
    kind, _, rest = text.partition("://")
    address = Address(f"{kind}:///{rest.lstrip('/')}", None, allowed, host="localhost")
    require_library("rclpy", "rclpy", "ros2", text)
    return address


def message_class(kind: str, where: str) -> Any:
    """Return the class of a message type such as "sensor_msgs/msg/Imu"."""
    package, _, name = kind.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except ImportError:
        what = f"needs the ROS package {package}, which is not installed"
        remedy = "install it with ROS 2 and source its setup file, or use pose= or joints="
        raise DrakeTeleopError(what, where=where, remedy=remedy) from None


class Ros2Source(streams.Source):
    """Source at ros2://TOPIC[?pose=TOPIC&imu=TOPIC&joints=TOPIC&tf=PARENT,CHILD&domain=N&sign=1].

    TOPIC is a WrenchStamped. `/tf` and `/tf_static` contain all frames between PARENT and CHILD.
    """

    @delayed_signals()
    def __init__(self, address: str, dt: float, joints: tuple[str, ...] = ()) -> None:
        parsed = parse_ros2_address(address, ros2_messages.SOURCE_PARAMETERS)
        self.dt, sign, domain = dt, parsed.wrench_sign(), ros2_messages.domain_of_address(parsed)
        topics, frames, self.streams = ros2_messages.topics_frames_and_streams(parsed, joints)
        classes = {
            name: message_class(ros2_messages.MESSAGE_TYPE_OF_TOPIC[name], address)
            for name in topics
        }
        self._converter = ros2_messages.MessageConverter(sign, frames, joints)
        self._found: list[streams.Reading] = []
        self._counts: Counter[str] = Counter()
        self._node, self._next_spin = shared_node(domain), 0.0
        self._subscriptions = [
            self._subscribe_and_get_receiver(name, classes[name], topic)
            for name, topic in topics.items()
        ]

    @delayed_signals()
    def read(self, timeout_s: float) -> list[streams.Reading] | None:
        self._take_messages()
        if not self._found:
            self._node.spin(timeout_s)
            self._take_messages()
        elif time.monotonic() >= self._next_spin:  # services, under a constant load
            self._node.spin(0.0)
            self._next_spin = time.monotonic() + _MAX_SERVICE_SPIN_PERIOD_S
        found, self._found = self._found, []
        return found

    def close(self) -> None:
        self._node.close()

    def _take_messages(self) -> None:
        # An executor needs 0.3 ms to find each message; taking those that are there needs 0.02 ms.
        for subscription, receive in self._subscriptions:
            with subscription.handle:
                for _ in range(_MAX_QUEUED_MESSAGES):
                    taken = subscription.handle.take_message(subscription.msg_type, True)
                    if taken is None:
                        break
                    receive(*taken)

    def _subscribe_and_get_receiver(
        self, name: str, kind: Any, topic: str
    ) -> tuple[Any, Callable[..., None]]:
        from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
        from rclpy.serialization import deserialize_message

        def receive(message: bytes, info: Any) -> None:
            self._counts[name] += 1
            number = info["publication_sequence_number"] or self._counts[name]
            try:
                data = deserialize_message(message, kind)
            except Exception:  # of rmw, without a common type
                self._found.append(ros2_messages.damaged_reading_of_topic(name))
                return
            self._found += self._converter.readings_of_message(name, data, number)

        node = self._node.node
        if name == "tf":
            kept = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            node.create_subscription(kind, "/tf_static", self._converter.add_transforms, kept)
        newest = QoSProfile(depth=_MAX_QUEUED_MESSAGES, reliability=ReliabilityPolicy.BEST_EFFORT)
        options = {"callback": receive, "qos_profile": newest, "raw": True}
        return node.create_subscription(kind, f"/{topic}", **options), receive


class Ros2Sink:
    """Sink at ros2://TOPIC[?frame=NAME&wrench=scaled&domain=N], with flags on `/diagnostics`."""

    @delayed_signals()
    def __init__(self, address: str) -> None:
        parsed = parse_ros2_address(address, ("frame", "wrench", "domain"))
        from rclpy.qos import qos_profile_sensor_data

        topic, domain = (
            ros2_messages.checked_topic_name(parsed, parsed.path),
            ros2_messages.domain_of_address(parsed),
        )
        self._which = parsed.parameter_among_words("wrench", ("contact", "scaled"))
        names = "DiagnosticArray", "DiagnosticStatus", "KeyValue"
        types = (ros2_messages.WRENCH_STAMPED, *(f"diagnostic_msgs/msg/{name}" for name in names))
        classes = {kind.rpartition("/")[2]: message_class(kind, address) for kind in types}
        self._kinds = SimpleNamespace(**classes)
        self._message = self._kinds.WrenchStamped()
        self._message.header.frame_id = parsed.optional_parameter("frame") or ""
        self._node = shared_node(domain)
        self._topic, self._flags, self._next = f"/{topic}", -1, 0.0
        self._counts: Counter[str] = Counter()
        node, kinds = self._node.node, self._kinds
        quality = qos_profile_sensor_data
        self._wrenches = node.create_publisher(kinds.WrenchStamped, self._topic, quality)
        self._diagnostics = node.create_publisher(kinds.DiagnosticArray, "/diagnostics", 100)

    @delayed_signals()
    def write(self, out: streams.CompensatedWrench) -> None:
        message, ns = self._message, time.time_ns()
        _set_stamp(message.header, ns)
        wrench = getattr(out, self._which).tolist()
        force, torque = message.wrench.force, message.wrench.torque
        force.x, force.y, force.z, torque.x, torque.y, torque.z = wrench
        self._wrenches.publish(message)
        self._counts.update(flag_names(out.flags) if out.flags else ())
        now = time.monotonic()
        if out.flags != self._flags or now >= self._next:
            self._flags, self._next = out.flags, now + _MAX_DIAGNOSTICS_PERIOD_S
            self._diagnostics.publish(self._diagnostics_message(out, ns))

    def close(self) -> None:
        self._node.close()

    def _diagnostics_message(self, out: streams.CompensatedWrench, ns: int) -> Any:
        kind = self._kinds.DiagnosticStatus
        level = kind.OK if not out.flags else kind.WARN
        if out.flags & ~streams.NONZERO_WRENCH_FLAGS:
            level = kind.STALE if out.flags == streams.ReadingFlag.STALE else kind.ERROR
        pairs = {"number": out.number, "t": repr(float(out.t)), "flags": out.flags, **self._counts}
        values = [self._kinds.KeyValue(key=key, value=str(value)) for key, value in pairs.items()]
        status = kind(
            level=level,
            name=f"{_NODE_NAME}: {self._topic}",
            message=", ".join(flag_names(out.flags)) or "ok",
            values=values,
        )
        message = self._kinds.DiagnosticArray(status=[status])
        _set_stamp(message.header, ns)
        return message


def _set_stamp(header: Any, ns: int) -> None:
    header.stamp.sec, header.stamp.nanosec = divmod(ns, 10**9)
