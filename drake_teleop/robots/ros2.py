"""Source and sink for ROS 2 by rclpy, and conversion of its messages."""

from __future__ import annotations

import importlib
import os
import time
from collections import Counter
from collections.abc import Callable
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np

from drake_teleop.common.errors import DrakeTeleopError, require_library
from drake_teleop.common.interruption import delayed_signals
from drake_teleop.common.numeric import Array
from drake_teleop.common.vectors import quaternion_product, rotate_vector
from drake_teleop.robots import streams
from drake_teleop.robots.address import Address
from drake_teleop.robots.lines import flag_names
from drake_teleop.robots.streams import DAMAGED_WRENCH_READING, IMU, JOINTS, POSE, WRENCH, Reading

_NODE_NAME = "drake_teleop"
_MAX_DIAGNOSTICS_PERIOD_S = 1.0
_MAX_QUEUED_MESSAGES = 256  # of each stream
_MAX_SERVICE_SPIN_PERIOD_S = 0.05  # longest time between two waits for services [s]
WRENCH_STAMPED = "geometry_msgs/msg/WrenchStamped"
MESSAGE_TYPE_OF_TOPIC = {
    WRENCH: WRENCH_STAMPED,
    "tf": "tf2_msgs/msg/TFMessage",
    POSE: "geometry_msgs/msg/PoseStamped",
    IMU: "sensor_msgs/msg/Imu",
    JOINTS: "sensor_msgs/msg/JointState",
}
_STREAM_OF_TOPIC = {"tf": POSE}
_MAX_TRANSFORM_CHAIN_FRAMES = 64
SOURCE_ADDRESS_PARAMETERS = ("pose", "imu", "joints", "tf", "domain", "sign")
"""Parameters of a source's address."""


def domain_of_address(address: Address) -> int:
    text = address.optional_parameter("domain") or os.environ.get("ROS_DOMAIN_ID") or "0"
    if not (text.isdecimal() and text.isascii() and int(text) <= 232):
        what, remedy = f"domain={text!r} is not a ROS domain", "give a whole number from 0 to 232"
        raise DrakeTeleopError(what, where=address.text, remedy=remedy)
    return int(text)


def checked_topic_name(address: Address, name: str) -> str:
    topic = name.strip("/")
    if not topic.isascii() or not all(part.isidentifier() for part in topic.split("/")):
        what = f"{name!r} is not the name of a ROS topic"
        remedy = "give one such as /ft_sensor/wrench"
        raise DrakeTeleopError(what, where=address.text, remedy=remedy)
    return topic


def topics_frames_and_streams(
    address: Address, joints: tuple[str, ...]
) -> tuple[dict[str, str], tuple[str, ...], tuple[str, ...]]:
    """Return topics by name, frames (parent, child) of `tf`, streams; `joints`: the arm's."""
    topics = {WRENCH: checked_topic_name(address, address.path)}
    for stream in (POSE, IMU, JOINTS):
        if (text := address.optional_parameter(stream)) is not None:
            topics[stream] = checked_topic_name(address, text)
    frames: tuple[str, ...] = ()
    if (text := address.optional_parameter("tf")) is not None:
        frames, topics["tf"] = tuple(text.split(",")), "tf"
        if len(frames) != 2 or not all(frames):
            what = f"tf={text!r} does not name two frames"
            raise DrakeTeleopError(what, where=address.text, remedy="give tf=PARENT,CHILD")
    if len(topics) > 2:  # poses of two frames would be one motion
        what = f"gives more than one motion: {', '.join(list(topics)[1:])}"
        raise DrakeTeleopError(what, where=address.text, remedy="give only one of them")
    if JOINTS in topics and not joints:
        what = "joint positions need the model of the arm"
        raise DrakeTeleopError(what, where=address.text, remedy="give --model and --sensor-frame")
    return topics, frames, tuple(_STREAM_OF_TOPIC.get(name, name) for name in topics)


def reading_for_damaged_message(topic: str) -> Reading:
    return DAMAGED_WRENCH_READING._replace(stream=_STREAM_OF_TOPIC.get(topic, topic))


class MessageConverter:
    """Converter of ROS 2 messages; `sign` multiplies wrenches; `frames`: parent, child in `/tf`."""

    def __init__(
        self, sign: float, frames: tuple[str, ...] = (), joints: tuple[str, ...] = ()
    ) -> None:
        self._sign, self._frames, self._joints = sign, frames, joints
        self._links: dict[str, tuple[str, Array]] = {}

    def readings_of_message(self, name: str, data: Any, number: int) -> list[Reading]:
        """Return the readings of a deserialized message; `name`: key of `MESSAGE_TYPE_OF_TOPIC`."""
        if name == "tf":
            samples = self._stamped_poses_of_transforms(data)
        else:
            values = self._reading_values_of_message(name, data)
            samples = [] if values is None else [(data.header.stamp, values)]
        stream = _STREAM_OF_TOPIC.get(name, name)
        return [
            Reading(number, stamp.sec + 1e-9 * stamp.nanosec, values, stream=stream)
            for stamp, values in samples
        ]

    def add_transforms(self, data: Any) -> None:
        """Store the transforms of a TFMessage for later poses."""
        for each in data.transforms:
            link = _pose_array(each.transform.translation, each.transform.rotation)
            self._links[each.child_frame_id] = each.header.frame_id, link

    def _reading_values_of_message(self, name: str, data: Any) -> Array | None:
        if name == WRENCH:
            return self._sign * _concatenate_xyz(data.wrench.force, data.wrench.torque)
        if name == POSE:
            return _pose_array(data.pose.position, data.pose.orientation)
        if name == JOINTS:
            positions = dict(zip(data.name, data.position, strict=False))
            if not self._joints or not all(joint in positions for joint in self._joints):
                return None
            return np.array([positions[joint] for joint in self._joints], float)
        return _concatenate_xyz(data.linear_acceleration, data.angular_velocity)

    def _stamped_poses_of_transforms(self, data: Any) -> list[tuple[Any, Array]]:
        newest = {each.child_frame_id: each for each in data.transforms}
        self.add_transforms(data)
        if not self._frames:
            return []
        parent, frame = self._frames
        pose, stamp = np.array([1.0, 0, 0, 0, 0, 0, 0]), None
        for _ in range(_MAX_TRANSFORM_CHAIN_FRAMES):
            if frame == parent:
                return [] if stamp is None else [(stamp, pose)]
            if frame not in self._links:
                break
            if frame in newest:
                stamp = newest[frame].header.stamp
            frame, link = self._links[frame]
            pose = _compose_poses(link, pose)
        return []


def _concatenate_xyz(v: Any, w: Any) -> Array:
    return np.array([v.x, v.y, v.z, w.x, w.y, w.z])


def _pose_array(p: Any, q: Any) -> Array:
    return np.array([q.w, q.x, q.y, q.z, p.x, p.y, p.z])


def _compose_poses(X_AB: Array, X_BC: Array) -> Array:
    q = tuple(X_AB[:4].tolist())
    p = rotate_vector(q, tuple(X_BC[4:].tolist()))
    return np.array([*quaternion_product(q, tuple(X_BC[:4].tolist())), *(X_AB[4:] + p)])


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


def message_class(message_type: str, where: str) -> Any:
    package, _, name = message_type.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except ImportError:
        what = f"needs the ROS package {package}, which is not installed"
        remedy = "install it with ROS 2 and source its setup file, or use pose= or joints="
        raise DrakeTeleopError(what, where=where, remedy=remedy) from None


class Ros2Source(streams.Source):
    """Source at ros2://TOPIC[?pose=TOPIC|imu=TOPIC|joints=TOPIC|tf=PARENT,CHILD&domain=N&sign=1].

    TOPIC is a WrenchStamped. `/tf` and `/tf_static` contain all frames between PARENT and CHILD.
    """

    @delayed_signals()
    def __init__(self, address: str, dt: float, joints: tuple[str, ...] = ()) -> None:
        parsed = parse_ros2_address(address, SOURCE_ADDRESS_PARAMETERS)
        self.dt, sign, domain = dt, parsed.wrench_sign(), domain_of_address(parsed)
        topics, frames, self.streams = topics_frames_and_streams(parsed, joints)
        classes = {name: message_class(MESSAGE_TYPE_OF_TOPIC[name], address) for name in topics}
        self._converter = MessageConverter(sign, frames, joints)
        self._found: list[Reading] = []
        self._counts: Counter[str] = Counter()
        self._node, self._next_spin = shared_node(domain), 0.0
        self._subscriptions = [
            self._create_subscription_and_callback(name, classes[name], topic)
            for name, topic in topics.items()
        ]

    @delayed_signals()
    def read(self, timeout_s: float) -> list[Reading] | None:
        self._take_queued_messages()
        if not self._found:
            self._node.spin(timeout_s)
            self._take_queued_messages()
        elif time.monotonic() >= self._next_spin:  # services, under a constant load
            self._node.spin(0.0)
            self._next_spin = time.monotonic() + _MAX_SERVICE_SPIN_PERIOD_S
        found, self._found = self._found, []
        return found

    def close(self) -> None:
        self._node.close()

    def _take_queued_messages(self) -> None:
        # An executor needs 0.3 ms to find each message; taking those that are there needs 0.02 ms.
        for subscription, receive in self._subscriptions:
            with subscription.handle:
                for _ in range(_MAX_QUEUED_MESSAGES):
                    taken = subscription.handle.take_message(subscription.msg_type, True)
                    if taken is None:
                        break
                    receive(*taken)

    def _create_subscription_and_callback(
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
                self._found.append(reading_for_damaged_message(name))
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
        from rclpy.qos import qos_profile_sensor_data as quality

        topic, domain = checked_topic_name(parsed, parsed.path), domain_of_address(parsed)
        self._which = parsed.requested_wrench_name()
        names = "DiagnosticArray", "DiagnosticStatus", "KeyValue"
        types = (WRENCH_STAMPED, *(f"diagnostic_msgs/msg/{name}" for name in names))
        classes = {kind.rpartition("/")[2]: message_class(kind, address) for kind in types}
        self._kinds = SimpleNamespace(**classes)
        self._message = self._kinds.WrenchStamped()
        self._message.header.frame_id = parsed.optional_parameter("frame") or ""
        self._node = shared_node(domain)
        self._topic, self._flags, self._next = f"/{topic}", -1, 0.0
        self._counts: Counter[str] = Counter()
        node, kinds = self._node.node, self._kinds
        self._wrenches = node.create_publisher(kinds.WrenchStamped, self._topic, quality)
        self._diagnostics = node.create_publisher(kinds.DiagnosticArray, "/diagnostics", 100)

    @delayed_signals()
    def write(self, out: streams.CompensatedWrench) -> None:
        message, ns = self._message, time.time_ns()
        _set_header_stamp(message.header, ns)
        wrench = getattr(out, self._which).tolist()
        force, torque = message.wrench.force, message.wrench.torque
        force.x, force.y, force.z, torque.x, torque.y, torque.z = wrench
        self._wrenches.publish(message)
        self._counts.update(flag_names(out.flags) if out.flags else ())
        now = time.monotonic()
        if out.flags != self._flags or now >= self._next:
            self._flags, self._next = out.flags, now + _MAX_DIAGNOSTICS_PERIOD_S
            self._diagnostics.publish(self._make_diagnostics_message(out, ns))

    def close(self) -> None:
        self._node.close()

    def _make_diagnostics_message(self, out: streams.CompensatedWrench, ns: int) -> Any:
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
        _set_header_stamp(message.header, ns)
        return message


def _set_header_stamp(header: Any, time_ns: int) -> None:
    header.stamp.sec, header.stamp.nanosec = divmod(time_ns, 10**9)
