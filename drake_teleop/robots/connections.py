"""Functions that open sources and sinks by their addresses."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.load.identification import Identification
from drake_teleop.logs.aligned_log import without_orientation
from drake_teleop.robots.assembly import (
    IDENTITY_POSE,
    Assembly,
    Parts,
    PosedByJoints,
    SensorPoseOfJoints,
    pose_from_rpy,
)
from drake_teleop.robots.lines import LineSink, LineSource, TableSink
from drake_teleop.robots.recording import PartRecorder, Recorder, Records
from drake_teleop.robots.replay_log import LogSource
from drake_teleop.robots.streams import JOINTS, PartSource, Reading, Sink, Source
from drake_teleop.robots.udp import PosedSource, UdpSink, UdpSource

_SOURCES = (
    "udp://:PORT, posed://:PORT, rtde://HOST, netft://HOST, ros2://TOPIC, zenoh://HOST/TOPIC,"
    " - for stdin, or replay:LOG"
)
_SINKS = (
    "udp://HOST:PORT, ros2://TOPIC, zenoh://HOST/TOPIC, foxglove://[HOST][:PORT], -,"
    " or a .csv, .parquet or .mcap file"
)
_REPLAY = "replay:"
_UNUSED_RATE_HZ = 1000.0
_PART_KINDS = ("posed", "rtde", "netft", "ros2", "zenoh")


def open_source(
    address: str,
    load: Identification | None,
    *,
    rate_hz: float | None = None,
    cutoff_hz: float | None = 30.0,
    delay: str | float = "auto",
    real_time: bool = False,
    motion: str | None = None,
    sensor_pose: tuple[float, ...] | None = None,
    arm: SensorPoseOfJoints | None = None,
) -> Source[Reading]:
    """Return the source at an address (docs/robot.md).

    Args:
        load: identified load, for the delay and for `weight_removed`.
        rate_hz: rate of the wrenches; logs, UR robots and NetBoxes deliver their own.
        cutoff_hz, delay: see `eliminate_log`; "auto" tracks the delay of live parts.
        real_time: replay a log in real time.
        motion: address of a second source, for the motion.
        sensor_pose: x, y, z [m], roll, pitch, yaw [deg] of the sensor in the posed frame.
        arm: kinematics for joint positions.
    """
    kind = _kind(address)
    if kind in _PART_KINDS:
        track = load if isinstance(delay, str) else None
        if isinstance(delay, str):
            delay = 0.0 if load is None else load.delay_s
        parts = _open_parts(address, rate_hz, motion, arm)
        return Assembly(
            parts,
            cutoff_hz=cutoff_hz,
            delay_s=delay,
            track=track,
            X_FS=_pose(sensor_pose),
            weight_removed=load is not None and load.weight_removed,
        )
    if motion is not None or sensor_pose is not None or arm is not None:
        raise DrakeTeleopError(
            "delivers the motion of the sensor itself",
            where=address,
            remedy="remove --motion, --model and --sensor-pose",
        )
    if kind == "replay":
        path = address.removeprefix(_REPLAY)
        options = {"cutoff_hz": cutoff_hz, "delay": delay, "real_time": real_time}
        return LogSource(path, load, **options)  # type: ignore[arg-type]
    if kind not in ("-", "udp"):
        raise DrakeTeleopError("is not a source", where=address, remedy=_SOURCES)
    if load is not None and load.weight_removed:
        raise without_orientation(address)
    dt = _period(rate_hz, address)
    return LineSource(sys.stdin.fileno(), dt) if kind == "-" else UdpSource(address, dt)


def open_recording(
    address: str,
    largest: Array | None,
    *,
    real_time: bool = False,
    motion: str | None = None,
    sensor_pose: tuple[float, ...] | None = None,
    arm: SensorPoseOfJoints | None = None,
) -> tuple[Source[Any], Records[Any]]:
    """Return the stream that `calibrate` reads, and its recorder.

    Args:
        largest: (6,) range of the sensor [N, N m]; the others: see `open_source`.
    """
    kind = _kind(address)
    # Records keep their time stamps; only a NetBox, without stamps, needs its own rate.
    rate_hz = None if kind == "netft" else _UNUSED_RATE_HZ
    if kind in _PART_KINDS:
        parts = _open_parts(address, rate_hz, motion, arm)
        return parts, PartRecorder(parts, largest, _pose(sensor_pose))
    readings = {"real_time": real_time, "motion": motion, "sensor_pose": sensor_pose, "arm": arm}
    return open_source(address, None, rate_hz=rate_hz, **readings), Recorder(largest)  # type: ignore[arg-type]


def is_file(address: str) -> bool:
    """Return whether the address of a sink is a file or a folder of files."""
    return not _kind(address) and Path(address).suffix in (".csv", ".parquet", ".mcap")


def open_sink(address: str) -> Sink:
    """Return the sink at an address; raise DrakeTeleopError if it is invalid."""
    kind, path = _kind(address), Path(address)
    if kind == "-":
        return LineSink(sys.stdout)
    if kind == "udp":
        return UdpSink(address)
    if kind == "zenoh":
        from drake_teleop.robots.ros2_zenoh import ZenohSink

        return ZenohSink(address)
    if kind == "ros2":
        from drake_teleop.robots.ros2 import Ros2Sink

        return Ros2Sink(address)
    if kind == "foxglove" or (is_file(address) and path.suffix == ".mcap"):
        from drake_teleop.robots.foxglove import FoxgloveSink, McapSink

        return FoxgloveSink(address) if kind else McapSink(path)
    if not is_file(address):
        raise DrakeTeleopError("is not a sink", where=address, remedy=_SINKS)
    return TableSink(path)


def _kind(address: str) -> str:
    if address.startswith(_REPLAY):
        return "replay"
    return address.partition("://")[0] if "://" in address or address == "-" else ""


def _period(rate_hz: float | None, address: str) -> float:
    if rate_hz is None:
        raise DrakeTeleopError(
            "the low-pass needs the rate of the readings", where=address, remedy="give --rate HZ"
        )
    return 1.0 / rate_hz


def _open_part_source(
    address: str, rate_hz: float | None, joints: tuple[str, ...] = ()
) -> PartSource:
    kind = _kind(address)
    if kind == "posed":
        return PosedSource(address, _period(rate_hz, address))
    if kind == "rtde":
        from drake_teleop.robots.rtde import RtdeSource

        return RtdeSource(address)
    if kind == "netft":
        from drake_teleop.robots.netft import NetFtSource

        return NetFtSource(address, None if rate_hz is None else 1.0 / rate_hz)
    if kind == "zenoh":
        from drake_teleop.robots.ros2_zenoh import ZenohSource

        return ZenohSource(address, _period(rate_hz, address), joints)
    if kind == "ros2":
        from drake_teleop.robots.ros2 import Ros2Source

        return Ros2Source(address, _period(rate_hz, address), joints)
    raise DrakeTeleopError(
        "delivers no motion", where=address, remedy="rtde://HOST or ros2://TOPIC"
    )


def _open_parts(
    address: str, rate_hz: float | None, motion: str | None, arm: SensorPoseOfJoints | None
) -> Parts:
    names = () if arm is None else arm.joint_names
    wrench = _open_part_source(address, rate_hz, names)
    other: PartSource | None = None
    try:
        other = None if motion is None else _open_part_source(motion, 1.0 / wrench.dt, names)
        if arm is None:
            return Parts(wrench, other)
        motion_source = wrench if other is None else other
        if JOINTS not in motion_source.streams:
            raise DrakeTeleopError(
                "delivers no joint positions for --model",
                where=address if motion is None else motion,
                remedy="give a source such as zenoh://HOST/TOPIC?joints=/joint_states",
            )
        posed = PosedByJoints(motion_source, arm)
        return Parts(posed) if other is None else Parts(wrench, posed)
    except BaseException:
        for each in (wrench, other):
            if each is not None:
                each.close()
        raise


def _pose(sensor_pose: tuple[float, ...] | None) -> Array:
    return IDENTITY_POSE if sensor_pose is None else pose_from_rpy(sensor_pose)
