"""Conversion of ROS 2 messages to readings, for the sources by rclpy and by zenoh."""

from __future__ import annotations

from typing import Any

import numpy as np

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.common.vectors import quaternion_product, rotate_vector
from drake_teleop.robots.address import Address
from drake_teleop.robots.streams import DAMAGED_WRENCH_READING, IMU, JOINTS, POSE, WRENCH, Reading

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
SOURCE_PARAMETERS = ("pose", "imu", "joints", "tf", "domain", "sign")
"""Parameters of a source's address."""


def domain_of_address(address: Address) -> int:
    text = address.optional_parameter("domain") or "0"
    if not (text.isdecimal() and text.isascii() and int(text) <= 232):
        what, remedy = f"domain={text!r} is not a ROS domain", "give a whole number from 0 to 232"
        raise DrakeTeleopError(what, where=address.text, remedy=remedy)
    return int(text)


def checked_topic_name(address: Address, name: str) -> str:
    topic = name.strip("/")
    if not topic or not topic.isascii() or not topic.replace("/", "_").isidentifier():
        what = f"{name!r} is not the name of a ROS topic"
        remedy = "give one such as /ft_sensor/wrench"
        raise DrakeTeleopError(what, where=address.text, remedy=remedy)
    return topic


def topics_frames_and_streams(
    address: Address, joints: tuple[str, ...]
) -> tuple[dict[str, str], tuple[str, ...], tuple[str, ...]]:
    """Return the topics in an address by stream, the two frames of `tf`, and the streams."""
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
    if JOINTS in topics and not joints:
        what = "joint positions need the model of the arm"
        raise DrakeTeleopError(what, where=address.text, remedy="give --model and --sensor-frame")
    return topics, frames, tuple(_STREAM_OF_TOPIC.get(name, name) for name in topics)


def damaged_reading_of_topic(name: str) -> Reading:
    return DAMAGED_WRENCH_READING._replace(stream=_STREAM_OF_TOPIC.get(name, name))


class MessageConverter:
    """Converter of ROS 2 messages; `frames` are parent and child of the pose in `/tf`."""

    def __init__(
        self, sign: float, frames: tuple[str, ...] = (), joints: tuple[str, ...] = ()
    ) -> None:
        self._sign, self._frames, self._joints = sign, frames, joints
        self._links: dict[str, tuple[str, Array]] = {}

    def readings_of_message(self, name: str, data: Any, number: int) -> list[Reading]:
        """Return the readings of a ROS message; `name` is a key of `MESSAGE_TYPE_OF_TOPIC`."""
        if name == "tf":
            samples = self._pose_from_transforms(data)
        else:
            values = self._message_values(name, data)
            samples = [] if values is None else [(data.header.stamp, values)]
        stream = _STREAM_OF_TOPIC.get(name, name)
        return [
            Reading(number, stamp.sec + 1e-9 * stamp.nanosec, values, stream=stream)
            for stamp, values in samples
        ]

    def add_transforms(self, data: Any) -> None:
        """Store the transforms of a TFMessage; those of `/tf_static` yield no pose."""
        for each in data.transforms:
            link = _pose_array(each.transform.translation, each.transform.rotation)
            self._links[each.child_frame_id] = each.header.frame_id, link

    def _message_values(self, name: str, data: Any) -> Array | None:
        if name == WRENCH:
            return self._sign * _six_numbers(data.wrench.force, data.wrench.torque)
        if name == POSE:
            return _pose_array(data.pose.position, data.pose.orientation)
        if name == JOINTS:
            positions = dict(zip(data.name, data.position, strict=False))
            if not self._joints or not all(joint in positions for joint in self._joints):
                return None
            return np.array([positions[joint] for joint in self._joints], float)
        return _six_numbers(data.linear_acceleration, data.angular_velocity)

    def _pose_from_transforms(self, data: Any) -> list[tuple[Any, Array]]:
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


def _six_numbers(v: Any, w: Any) -> Array:
    return np.array([v.x, v.y, v.z, w.x, w.y, w.z])


def _pose_array(p: Any, q: Any) -> Array:
    return np.array([q.w, q.x, q.y, q.z, p.x, p.y, p.z])


def _compose_poses(a: Array, b: Array) -> Array:
    q = tuple(a[:4].tolist())
    p = rotate_vector(q, tuple(b[4:].tolist()))
    return np.array([*quaternion_product(q, tuple(b[:4].tolist())), *(a[4:] + p)])
