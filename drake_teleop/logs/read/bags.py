"""ROS bags and MCAP files: each topic becomes a table whose columns are message fields.

Columns are numbers and arrays (up to 64) by path (`wrench.force.x`, `data.0`), unique short names
(`force.x`), `received` [s], `header.stamp` [s] if set, and `stamp` (`header.stamp` or `received`).
"""

from __future__ import annotations

import dataclasses
import itertools
import os
import resource
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.errors import DrakeTeleopError, remedy_to_install_extra, require_library
from drake_teleop.logs.read.description import Imu, Pose, Static, Wrench
from drake_teleop.logs.read.table_files import read_table
from drake_teleop.logs.read.tables import Table

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

BAG_SUFFIXES = (".mcap", ".db3", ".bag")
_MAX_MESSAGE_ARRAY_LENGTH = 64
_MESSAGES_PER_BLOCK, _RECEPTION_TIME_COLUMN = 10_000, "received at"
# MCAP: opcode of a chunk; limits of the total uncompressed size: ratio to the file, bytes.
_MCAP_CHUNK_OPCODE, _MAX_UNPACK_RATIO, _UNPACKED_BYTES_MARGIN = 6, 200, 100_000_000
_MAX_ADDED_PROCESS_MEMORY_BYTES = 1_500_000_000  # bytes
_BAG_SIZE_ERROR = "its uncompressed size is too large (more than 1.5 GB, or 200 times the file)"
_BAG_SIZE_REMEDY = "cut the bag, or write each topic to its own bag"
_KEPT_FIELD_NAMES = "orientation", "position", "force", "torque", "linear_acceleration"
_SHORT_NAME_OF_FIELD = {x: x for x in (*_KEPT_FIELD_NAMES, "angular_velocity")}
_SHORT_NAME_OF_FIELD |= {"rotation": "orientation", "translation": "position"}
_MESSAGE_TYPES_OF_STREAM = {
    "wrench": ("WrenchStamped", "Wrench"),
    "imu": ("Imu",),
    "pose": (
        *("PoseStamped", "PoseWithCovarianceStamped", "TransformStamped", "Odometry", "Pose"),
        "TFMessage",
    ),
}
"""Message types for each stream, the most likely first."""


class Topic(NamedTuple):
    """Topic of a bag: name, message type, number and mean rate [Hz] of messages."""

    name: str
    type: str
    messages: int
    rate_hz: float


def is_bag(path: Path) -> bool:
    """Return whether a path is a folder with metadata.yaml, or ends in .mcap, .db3 or .bag."""
    return os.path.isfile(path / "metadata.yaml") or path.suffix.lower() in BAG_SUFFIXES


def list_topics(path: Path) -> list[Topic]:
    with _open_bag(path) as reader:
        seconds = reader.duration * 1e-9
        return [
            Topic(name, info.msgtype or "several", count, count / seconds if seconds > 0 else 0.0)
            for name, info in sorted(reader.topics.items())
            for count in [info.msgcount]
        ]


def read_topic(path: Path, topic: str, child_frame: str | None = None) -> Table:
    """Return the messages of a topic as a table; of TF only those of one child frame."""
    with _open_bag(path) as reader:
        connections = [entry for entry in reader.connections if entry.topic == topic]
        if not connections:
            known = [f"{name} ({info.msgtype})" for name, info in sorted(reader.topics.items())]
            what = f"the bag has no topic {topic!r}"
            remedy = f"its topics are {', '.join(known)}"
            raise DrakeTeleopError(what, where=str(path), remedy=remedy)
        pairs = (
            (received, part)
            for connection, received, raw in reader.messages(connections)
            for message in [reader.deserialize(raw, connection.msgtype)]
            for part in getattr(message, "transforms", [message])
        )
        blocks = _read_column_blocks(pairs, child_frame, f"{path}:{topic}")
    if not blocks:
        raise DrakeTeleopError("topic is empty", where=f"{path}:{topic}", remedy="record it again")
    columns = {
        name: np.concatenate([block[name] for block in blocks])
        for name, values in blocks[0].items()
        if all(name in b and b[name].shape[1:] == values.shape[1:] for b in blocks)
    }
    received = columns.pop(_RECEPTION_TIME_COLUMN)
    absent = tuple(
        name.removesuffix("_covariance")
        for name, values in columns.items()
        if name.endswith("_covariance") and (values[:, 0] == -1).all()
    )
    columns = {k: x for k, x in columns.items() if k.rpartition(".")[0] not in absent}
    columns |= _columns_by_short_name(columns)
    columns["received"] = received
    if "header.stamp" in columns and not columns["header.stamp"].any():
        del columns["header.stamp"]
    columns["stamp"] = columns.get("header.stamp", received)
    return Table(path / topic.lstrip("/"), columns, absent_groups=absent)


def read_bag_topic_or_table(stream: Wrench | Imu | Pose | Static) -> Table:
    if not isinstance(stream, Static) and stream.topic is not None:
        return read_topic(stream.file, stream.topic, stream.child_frame)
    if is_bag(stream.file):
        raise missing_topic_error(stream.file)
    return read_table(stream.file, header=stream.header)


def draft_of_bag(path: Path, topics: Sequence[Topic], folder: Path) -> tuple[dict[str, Any], list]:
    """Return a draft log description with paths relative to `folder`, and its comment lines."""
    draft: dict[str, Any] = {}
    others: list[str] = []
    file = os.path.relpath(path, folder)
    for stream, types in _MESSAGE_TYPES_OF_STREAM.items():
        kinds = {topic.name: topic.type.split("/")[-1] for topic in topics if topic.messages}
        suitable = [name for kind in types for name in kinds if kinds[name] == kind]
        if suitable:
            draft[stream] = {"file": file, "topic": suitable[0]}
        if suitable and kinds[suitable[0]] == "TFMessage":
            draft[stream]["child_frame"] = "FILL IN"
        others += [f"{name} ({stream})" for name in suitable[1:]]
    if "wrench" in draft or not draft:
        draft["wrench"] = {"file": file, "topic": "FILL IN"} | draft.get("wrench", {}) | {"sign": 1}
    head = [
        "DRAFT, guessed from the types of topics by `drake-teleop inspect`: check every line,",
        "above all wrench.sign and the frames.",
        f"Other suitable topics: {', '.join(others) or 'none'}.",
    ]
    return draft, head


def missing_topic_error(path: Path) -> DrakeTeleopError:
    remedy = (
        "describe it in a YAML file with `topic` in each stream; `drake-teleop inspect` drafts one"
    )
    return DrakeTeleopError("no topic of the bag is specified", where=str(path), remedy=remedy)


@contextmanager
def _open_bag(path: Path) -> Iterator[AnyReader]:
    if not os.path.exists(path):
        raise DrakeTeleopError("no such file", where=str(path), remedy="check the path")
    if not is_bag(path):
        remedy = "give a folder with metadata.yaml, or a .mcap, .db3 or .bag file"
        raise DrakeTeleopError("the path is not a bag", where=str(path), remedy=remedy)
    require_library("rosbags", "rosbags", "ros", str(path))
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        what, remedy = f"cannot import rosbags: {error}", remedy_to_install_extra("ros")
        raise DrakeTeleopError(what, where=str(path), remedy=remedy) from error

    try:
        for file in path.iterdir() if path.is_dir() else [path]:
            if file.suffix.lower() == ".mcap":
                _check_unpacked_size(file)
        standard = get_typestore(Stores.LATEST)
        with _limit_process_memory(), AnyReader([path], default_typestore=standard) as reader:
            yield reader
    except DrakeTeleopError:
        raise
    except MemoryError:
        raise DrakeTeleopError(_BAG_SIZE_ERROR, where=str(path), remedy=_BAG_SIZE_REMEDY) from None
    # Damaged files cause many kinds of exceptions in rosbags and its libraries.
    except Exception as error:
        text = (str(error).splitlines() or [""])[0] or type(error).__name__
        what = f"the bag cannot be read: {text.rstrip('.')}"
        remedy = "check it with `ros2 bag info`"
        raise DrakeTeleopError(what, where=str(path), remedy=remedy) from error


def _check_unpacked_size(path: Path) -> None:
    total, limit = 0, path.stat().st_size * _MAX_UNPACK_RATIO + _UNPACKED_BYTES_MARGIN
    with path.open("rb") as file:
        file.seek(8)
        while len(head := file.read(33)) == 33:  # head of a record
            length = int.from_bytes(head[1:9], "little")
            total += int.from_bytes(head[25:33], "little") if head[0] == _MCAP_CHUNK_OPCODE else 0
            file.seek(min(length - 24, limit), 1)
            if total > limit:
                raise DrakeTeleopError(_BAG_SIZE_ERROR, where=str(path), remedy=_BAG_SIZE_REMEDY)


@contextmanager
def _limit_process_memory() -> Iterator[None]:
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[0])
    except OSError:  # only Linux enforces this limit
        yield
        return
    limit = pages * resource.getpagesize() + _MAX_ADDED_PROCESS_MEMORY_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit if soft < 0 else min(limit, soft), hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def _read_column_blocks(
    timed_messages: Iterator[tuple[int, Any]], child_frame: str | None, where: str
) -> list[dict[str, NDArray]]:
    children: set[str] = set()
    blocks: list[dict[str, NDArray]] = []

    def messages_of_child_frame() -> Iterator[tuple[int, Any]]:
        for received, part in timed_messages:
            children.add(getattr(part, "child_frame_id", ""))
            if child_frame in (None, getattr(part, "child_frame_id", "")):
                yield received, part

    found = messages_of_child_frame()
    while block := list(itertools.islice(found, _MESSAGES_PER_BLOCK)):
        received = {_RECEPTION_TIME_COLUMN: np.array([time for time, _ in block]) * 1e-9}
        blocks.append(_columns_of_messages([part for _, part in block]) | received)
    if (child_frame is None and len(children) > 1) or (child_frame and child_frame not in children):
        named = ", ".join(sorted(filter(None, children)))
        what = f"no child frame {child_frame!r}" if child_frame else "several child frames"
        remedy = f"set child_frame to one of {named}" if named else "remove child_frame"
        remedy += " in the log description"
        raise DrakeTeleopError(f"has {what}", where=where, remedy=remedy)
    return blocks


def _columns_of_messages(messages: list[Any]) -> dict[str, NDArray]:
    columns: dict[str, NDArray] = {}
    for path, sample in _numeric_fields(messages[0], ""):
        get = attrgetter(path)
        values = [get(message) for message in messages]
        if hasattr(sample, "nanosec"):
            seconds, rest = np.array([(v.sec, v.nanosec) for v in values]).T
            columns[path] = seconds + 1e-9 * rest
        elif not isinstance(sample, np.ndarray):
            columns[path] = np.array(values)
        elif all(len(v) == len(sample) for v in values):
            columns[path] = np.stack(values)
            columns |= {f"{path}.{i}": columns[path][:, i] for i in range(len(sample))}
    return columns


def _numeric_fields(message: Any, prefix: str) -> Iterator[tuple[str, Any]]:
    for field in dataclasses.fields(message):
        value, path = getattr(message, field.name), prefix + field.name
        if hasattr(value, "nanosec") or isinstance(value, (bool, int, float, np.number)):
            yield path, value
        elif isinstance(value, np.ndarray):
            if value.dtype.kind in "fiu" and 0 < len(value) <= _MAX_MESSAGE_ARRAY_LENGTH:
                yield path, value
        elif dataclasses.is_dataclass(value):
            yield from _numeric_fields(value, f"{path}.")


def _columns_by_short_name(columns: dict[str, NDArray]) -> dict[str, NDArray]:
    found: dict[str, list[str]] = {}
    for path in columns:
        *_, group, axis = ["", *path.split(".")]
        if group in _SHORT_NAME_OF_FIELD and axis in ("x", "y", "z", "w"):
            found.setdefault(f"{_SHORT_NAME_OF_FIELD[group]}.{axis}", []).append(path)
    return {short: columns[paths[0]] for short, paths in found.items() if len(paths) == 1}
