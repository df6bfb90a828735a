"""Functions that open sources and sinks by their addresses."""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.common.registry import Registry
from drake_teleop.load.identification import Identification
from drake_teleop.logs.aligned_log import removed_weight_needs_orientation_error
from drake_teleop.robots import assembly
from drake_teleop.robots.lines import JsonLineSink, JsonLineSource, TableSink
from drake_teleop.robots.recording import Recorder
from drake_teleop.robots.replay_log import ReplayLogSource
from drake_teleop.robots.streams import IMU, WRENCH_AND_MOTION, Sink, Source
from drake_teleop.robots.udp import UdpSink, UdpSource, UdpWrenchPoseSource

_REPLAY_PREFIX = "replay:"
_PLACEHOLDER_RATE_HZ = 1000.0


def open_source(
    address: str,
    load: Identification | None,
    *,
    rate_hz: float | None = None,
    cutoff_hz: float | None = 30.0,
    delay: str | float = "auto",
    real_time: bool = False,
    **motion_options: Any,
) -> Source:
    """Return the source of wrench and motion at an address.

    Args:
        load: identified load, for the delay and for `weight_removed`.
        rate_hz: rate of the wrenches, if the source does not deliver its own.
        cutoff_hz, delay: see `eliminate_log`; "auto" tracks the delay of live streams.
        real_time: replay a log in real time.
        motion_options: `motion`, address of a separate source of motion; `sensor_pose`, x, y, z
            [m], roll, pitch, yaw [deg] of the sensor in the frame of the poses; `arm`, kinematics
            for joint positions.
    """
    if _address_scheme(address) == "replay":
        _refuse_motion_options(address, **motion_options)
        path = address.removeprefix(_REPLAY_PREFIX)
        return ReplayLogSource(path, load, cutoff_hz=cutoff_hz, delay=delay, real_time=real_time)
    fixed_delay = None if delay in ("auto", 0.0) else delay
    source = _open_wrench_and_motion_source(address, rate_hz, fixed_delay, **motion_options)
    weight_removed = load is not None and load.weight_removed
    if not isinstance(source, assembly.WrenchAndMotionStreams):
        if weight_removed:
            source.close()
            raise removed_weight_needs_orientation_error(address)
        return source
    track = load if isinstance(delay, str) else None
    if isinstance(delay, str):
        delay = 0.0 if load is None else load.delay_s
    load_options: Any = {"delay_s": delay, "track": track, "weight_removed": weight_removed}
    X_FS = _sensor_pose_from_option(motion_options.get("sensor_pose"))
    return assembly.ReadingAssembler(source, cutoff_hz=cutoff_hz, X_FS=X_FS, **load_options)


def open_source_and_recorder(
    address: str, sensor_range: Array | None, *, real_time: bool = False, **motion_options: Any
) -> tuple[Source, Recorder]:
    """Return the source that `calibrate` reads, and a recorder for its readings."""
    kind = _address_scheme(address)
    if kind == "replay":
        source = open_source(address, None, real_time=real_time, **motion_options)
        return source, Recorder(sensor_range=sensor_range)
    # Records keep their time stamps; only a NetBox, without stamps, needs its own rate.
    rate_hz = None if kind == "netft" else _PLACEHOLDER_RATE_HZ
    source = _open_wrench_and_motion_source(address, rate_hz, **motion_options)
    two_clocks = isinstance(source, assembly.WrenchAndMotionStreams) and source.two_clocks
    X_FS = _sensor_pose_from_option(motion_options.get("sensor_pose"))
    return source, Recorder(source.streams, sensor_range, X_FS, two_clocks=two_clocks)


def is_file_address(address: str) -> bool:
    return not _address_scheme(address) and Path(address).suffix in SINKS


def open_sink(address: str) -> Sink:
    kind = _address_scheme(address) or Path(address).suffix
    if kind not in SINKS:
        remedy = f"give {_list_address_prefixes(SINKS)}"
        raise DrakeTeleopError("is not the address of a sink", where=address, remedy=remedy)
    return SINKS[kind](address)


def _list_address_prefixes(table: Registry[Any]) -> str:
    return ", ".join(f"{name}://" if name[0].isalnum() else name for name in table)


def _address_scheme(address: str) -> str:
    if address.startswith(_REPLAY_PREFIX):
        return "replay"
    return address.partition("://")[0] if "://" in address or address == "-" else ""


def _period_s(rate_hz: float | None, address: str) -> float:
    if rate_hz is None:
        what = "the low-pass needs the rate of the readings"
        raise DrakeTeleopError(what, where=address, remedy="give --rate HZ")
    return 1.0 / rate_hz


def _refuse_motion_options(address: str, **motion_options: Any) -> None:
    options = {"motion": "--motion", "arm": "--model", "sensor_pose": "--sensor-pose"}
    options["delay"] = "--delay"
    if given := [options[name] for name, value in motion_options.items() if value is not None]:
        what = "this source already contains the motion of sensor frame S"
        raise DrakeTeleopError(what, where=address, remedy=f"remove {' and '.join(given)}")


def _open_wrench_and_motion_source(
    address: str,
    rate_hz: float | None,
    delay: str | float | None = None,
    *,
    motion: str | None = None,
    sensor_pose: tuple[float, ...] | None = None,
    arm: assembly.ArmKinematics | None = None,
) -> Source:
    joints = () if arm is None else arm.joint_names
    opened = [_open_registered_source(address, rate_hz, joints)]
    try:
        if WRENCH_AND_MOTION in opened[0].streams:
            given = {"motion": motion, "arm": arm, "sensor_pose": sensor_pose, "delay": delay}
            _refuse_motion_options(address, **given)
            return opened[0]
        if motion is not None:
            opened.append(_open_registered_source(motion, 1.0 / opened[0].dt, joints))
            if WRENCH_AND_MOTION in opened[1].streams:
                what = "delivers its motion only with a wrench"
                remedy = "give a source such as rtde://HOST"
                raise DrakeTeleopError(what, where=motion, remedy=remedy)
        streams = assembly.WrenchAndMotionStreams(*opened, where=motion or address, arm=arm)
        if streams.motion_stream == IMU:
            _refuse_motion_options(streams.where, sensor_pose=sensor_pose)
        return streams
    except BaseException:
        for each in opened:
            each.close()
        raise


def _open_registered_source(address: str, rate_hz: float | None, joints: tuple[str, ...]) -> Source:
    kind = _address_scheme(address)
    if kind not in SOURCES:
        other = "" if kind == "replay" else ", or replay:LOG"  # a log has no separate motion
        remedy = f"give {_list_address_prefixes(SOURCES)}{other}"
        raise DrakeTeleopError("is not the address of a source", where=address, remedy=remedy)
    return SOURCES[kind](address, rate_hz, joints)


def _sensor_pose_from_option(sensor_pose: tuple[float, ...] | None) -> Array:
    return assembly.IDENTITY_POSE if sensor_pose is None else assembly.pose_from_rpy(sensor_pose)


def _create(module: str, class_name: str, *arguments: Any) -> Any:
    return getattr(import_module(f"drake_teleop.robots.{module}"), class_name)(*arguments)


SOURCES: Registry[Callable[[str, float | None, tuple[str, ...]], Source]] = Registry(
    "source",
    {
        "udp": lambda at, hz, joints: UdpSource(at, _period_s(hz, at)),
        "-": lambda at, hz, joints: JsonLineSource(sys.stdin.fileno(), _period_s(hz, at)),
        "posed": lambda at, hz, joints: UdpWrenchPoseSource(at, _period_s(hz, at)),
        "rtde": lambda at, hz, joints: _create("rtde", "RtdeSource", at),
        "netft": lambda at, hz, joints: _create("netft", "NetFtSource", at, hz and 1.0 / hz),
        "zenoh": lambda at, hz, joints: _create(
            "ros2_zenoh", "ZenohSource", at, _period_s(hz, at), joints
        ),
        "ros2": lambda at, hz, joints: _create("ros2", "Ros2Source", at, _period_s(hz, at), joints),
    },
)
"""Sources by the scheme of their address, called with address, rate [Hz] or None, joint names."""
SINKS: Registry[Callable[[str], Sink]] = Registry(
    "sink",
    {
        "-": lambda address: JsonLineSink(sys.stdout),
        "udp": UdpSink,
        "zenoh": lambda address: _create("ros2_zenoh", "ZenohSink", address),
        "ros2": lambda address: _create("ros2", "Ros2Sink", address),
        "foxglove": lambda address: _create("foxglove", "FoxgloveSink", address),
        ".csv": lambda address: TableSink(Path(address)),
        ".parquet": lambda address: TableSink(Path(address)),
        ".mcap": lambda address: _create("foxglove", "McapSink", Path(address)),
    },
)
"""Sinks by the scheme or suffix of their address, called with the address."""
