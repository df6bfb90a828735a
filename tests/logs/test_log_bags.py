"""ROS bags and MCAP files, written with rosbags and messages of ROS."""

from __future__ import annotations

import resource
import sys
from collections.abc import Iterable
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import polars as pl
import pytest
import yaml
from known_motion import Motion, motion_at, quaternions

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.logs.inspection import inspect_command
from drake_teleop.logs.processing import identify_log
from drake_teleop.logs.read import bags
from drake_teleop.logs.read.bags import is_bag, list_topics, read_topic
from drake_teleop.logs.read.description import load_description
from drake_teleop.logs.read.reading import read_log

rosbag2 = pytest.importorskip("rosbags.rosbag2")
rosbag1 = pytest.importorskip("rosbags.rosbag1")
typesys = pytest.importorskip("rosbags.typesys")

PHI = phi_from_mass_com_inertia(1.7, [0.01, -0.02, 0.06], np.diag([0.004, 0.005, 0.003]))
T = 100.0 + np.arange(0.0, 4.0, 0.004)
MOTION = motion_at(T)
FORCES = non_contact_wrench(MOTION.specific_force, MOTION.omega, MOTION.alpha, PHI) + 0.5
PLAIN = {"time": {"rate": 100}, "force": {"columns": [0]}, "torque": {"columns": [1]}}
Messages = Iterable[tuple[float, Any]]


def ros_messages(version: str = "ROS2_JAZZY") -> SimpleNamespace:
    """Return the message classes of a ROS version by short name."""
    store = typesys.get_typestore(typesys.Stores[version])
    types = {name.split("/")[-1]: kind for name, kind in store.types.items()}
    types["Time"] = store.types["builtin_interfaces/msg/Time"]
    return SimpleNamespace(store=store, **types)


ROS2 = ros_messages()
KIND = {"sqlite3": rosbag2.StoragePlugin.SQLITE3, "mcap": rosbag2.StoragePlugin.MCAP}


def stamped(t: float, of: SimpleNamespace = ROS2, frame: str = "world") -> Any:
    stamp = of.Time(*(int(x) for x in divmod(round(t * 1e9), 10**9)))
    return of.Header(*(() if of is ROS2 else (0,)), stamp=stamp, frame_id=frame)


def vector(x: np.ndarray, of: SimpleNamespace = ROS2) -> Any:
    return of.Vector3(*map(float, x))


def quaternion(q: np.ndarray) -> Any:
    return ROS2.Quaternion(**dict(zip("wxyz", map(float, q), strict=True)))


def wrenches(of: SimpleNamespace = ROS2) -> Messages:
    for t, w in zip(T, FORCES, strict=True):
        wrench = of.Wrench(vector(w[:3], of), vector(w[3:], of))
        yield t, of.WrenchStamped(stamped(t, of), wrench)


def imus(motion: Motion = MOTION, *, accelerometer: float = 0.0) -> Messages:
    none = np.full(9, -1.0)
    for t, s, omega in zip(motion.t, motion.specific_force, motion.omega, strict=True):
        yield (
            t,
            ROS2.Imu(
                header=stamped(t),
                orientation=quaternion(np.array([1.0, 0, 0, 0])),
                orientation_covariance=none,
                angular_velocity=vector(omega),
                angular_velocity_covariance=np.zeros(9),
                linear_acceleration=vector(s),
                linear_acceleration_covariance=np.full(9, accelerometer),
            ),
        )


def poses(kind: str) -> Messages:
    for t, q, p in zip(T, quaternions(MOTION.R_WS), MOTION.p_WS, strict=True):
        header, place = stamped(t), ROS2.Point(*map(float, p))
        pose = ROS2.Pose(place, quaternion(q))
        if kind == "PoseStamped":
            yield t, ROS2.PoseStamped(header, pose)
        elif kind == "Odometry":
            still = ROS2.Twist(vector(np.zeros(3)), vector(np.zeros(3)))
            twist = ROS2.TwistWithCovariance(still, np.zeros(36))
            pose = ROS2.PoseWithCovariance(pose, np.zeros(36))
            yield t, ROS2.Odometry(header, "tool0", pose, twist)
        else:
            transform = ROS2.Transform(vector(p), quaternion(q))
            tool = ROS2.TransformStamped(header, "tool0", transform)
            nothing = ROS2.Transform(vector(0 * p), quaternion(np.array([1.0, 0, 0, 0])))
            other = ROS2.TransformStamped(header, "camera", nothing)
            yield t, tool if kind == "TransformStamped" else ROS2.TFMessage([other, tool])


def write_bag(
    path: Path, topics: dict[str, Messages], storage: str = "sqlite3", store: Any = ROS2.store
) -> Path:
    """Write a bag whose messages are received 2 ms after their stamp."""
    with rosbag2.Writer(path, version=9, storage_plugin=KIND[storage]) as bag:
        for name, messages in topics.items():
            connection = None
            for t, message in messages:
                kind = message.__msgtype__
                connection = connection or bag.add_connection(name, kind, typestore=store)
                raw = store.serialize_cdr(message, kind)
                bag.write(connection, round((t + 0.002) * 1e9), raw)
    return path


def described(folder: Path, **streams: dict[str, Any]) -> Path:
    path = folder / "log.yaml"
    path.write_text(yaml.safe_dump(streams), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def parquet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the same record as a canonical table."""
    q = quaternions(MOTION.R_WS)
    names = "t f_x f_y f_z tau_x tau_y tau_z s_x s_y s_z omega_x omega_y omega_z q_w q_x q_y q_z"
    values = np.column_stack([T, FORCES, MOTION.specific_force, MOTION.omega, q, MOTION.p_WS])
    path = tmp_path_factory.mktemp("table") / "log.parquet"
    pl.DataFrame(values, schema=[*names.split(), "p_x", "p_y", "p_z"]).write_parquet(path)
    return path


@pytest.mark.slow
@pytest.mark.parametrize(("storage", "lone"), [("sqlite3", False), ("mcap", False), ("mcap", True)])
def test_bag_and_parquet_give_the_same_load(
    tmp_path: Path, parquet: Path, storage: str, lone: bool
) -> None:
    topics = {"/ft/wrench": wrenches(), "/imu": imus(), "/pose": poses("PoseStamped")}
    bag = write_bag(tmp_path / "run1", topics, storage)
    file = "run1/run1.mcap" if lone else "run1"
    assert is_bag(tmp_path / file)
    log = described(
        tmp_path,
        wrench={"file": file, "topic": "/ft/wrench"},
        imu={"file": file, "topic": "/imu"},
        pose={"file": file, "topic": "/pose"},
    )
    found, expected = identify_log(log), identify_log(parquet)
    assert found.log.notes == expected.log.notes
    np.testing.assert_allclose(found.identification.phi, expected.identification.phi, rtol=1e-9)
    np.testing.assert_allclose(found.identification.phi, PHI, rtol=0.02, atol=2e-4)
    names = [(topic.name, topic.type.split("/")[-1], topic.messages) for topic in list_topics(bag)]
    kinds = {"/ft/wrench": "WrenchStamped", "/imu": "Imu", "/pose": "PoseStamped"}
    assert names == [(name, kind, len(T)) for name, kind in kinds.items()]
    assert list_topics(bag)[0].rate_hz == pytest.approx(250, rel=0.01)


@pytest.mark.parametrize("kind", ["PoseStamped", "Odometry", "TransformStamped", "TFMessage"])
def test_every_pose_message_type_is_read(tmp_path: Path, kind: str) -> None:
    write_bag(tmp_path / "run1", {"/wrench": wrenches(), "/pose": poses(kind)}, "mcap")
    pose = {"file": "run1", "topic": "/pose"} | ({"child_frame": "tool0"} if kind[0] == "T" else {})
    wrench = {"file": "run1", "topic": "/wrench"}
    log = read_log(described(tmp_path, wrench=wrench, pose=pose))
    inner = slice(10, -10)
    np.testing.assert_allclose(log.specific_force[inner], MOTION.specific_force[inner], atol=0.02)
    np.testing.assert_allclose(log.angular_velocity[inner], MOTION.omega[inner], atol=1e-3)


def test_stamps_of_sender_or_recorder_are_used(tmp_path: Path) -> None:
    def unstamped() -> Messages:
        return ((t, message.wrench) for t, message in wrenches())

    def zero() -> Messages:
        return ((t, ROS2.WrenchStamped(stamped(0), message.wrench)) for t, message in wrenches())

    topics = {"/sent": wrenches(), "/plain": unstamped(), "/zero": zero(), "/imu": imus()}
    write_bag(tmp_path / "run1", topics, "mcap")
    imu = {"file": "run1", "topic": "/imu"}

    def log_of(topic: str, **more: Any) -> Any:
        wrench = {"file": "run1", "topic": topic, **more}
        return read_log(described(tmp_path, wrench=wrench, imu=imu), bandwidth_hz=None)

    sent = log_of("/sent")
    assert sent.notes == ()
    np.testing.assert_allclose(sent.wrench, FORCES, atol=1e-9)
    chosen = log_of("/sent", time={"column": "received"})
    assert chosen.notes == ()
    for log in (log_of("/plain"), log_of("/zero")):
        assert "has no header.stamp; the times of reception are used" in log.notes[0]
        np.testing.assert_array_equal(log.specific_force, chosen.specific_force)
    at = motion_at(T[:-1] + 0.002)
    np.testing.assert_allclose(chosen.specific_force[: len(T) - 1], at.specific_force, atol=0.02)
    assert np.abs(chosen.specific_force - sent.specific_force[: len(chosen)]).max() > 0.05
    back = log_of("/sent", time={"column": "received", "offset": -0.002})
    np.testing.assert_allclose(back.specific_force, sent.specific_force, atol=1e-6)


def test_custom_message_type_is_read_by_field_paths(tmp_path: Path) -> None:
    text = """
    builtin_interfaces/Time taken
    geometry_msgs/Wrench load
    float64[6] raw
    string state
    """
    store = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
    store.register(typesys.get_types_from_msg(text, "acme/msg/Gauge"))
    Gauge = store.types["acme/msg/Gauge"]

    def gauges() -> Messages:
        for t, message in wrenches():
            raw = FORCES[round((t - T[0]) / 0.004)]
            yield t, Gauge(stamped(t).stamp, message.wrench, raw, "ok")

    write_bag(tmp_path / "run1", {"/gauge": gauges(), "/imu": imus()}, "sqlite3", store)
    gauge = {"file": "run1", "topic": "/gauge", "time": {"column": "taken"}}
    groups = [
        {},
        {
            "force": {"columns": ["load.force.x", "load.force.y", "load.force.z"]},
            "torque": {"columns": ["raw.3", "raw.4", "raw.5"]},
        },
    ]
    for columns in groups:
        path = described(tmp_path, wrench=gauge | columns, imu={"file": "run1", "topic": "/imu"})
        np.testing.assert_allclose(read_log(path).wrench, FORCES, atol=1e-9)
    assert read_topic(tmp_path / "run1", "/gauge").columns["raw"].shape == (len(T), 6)


def test_bag_of_ros_1_is_read(tmp_path: Path) -> None:
    old = ros_messages("ROS1_NOETIC")
    with rosbag1.Writer(tmp_path / "old.bag") as bag:
        kind = "geometry_msgs/msg/WrenchStamped"
        connection = bag.add_connection("/wrench", kind, typestore=old.store)
        for t, message in wrenches(old):
            bag.write(connection, round(t * 1e9), old.store.serialize_ros1(message, kind))
    table = read_topic(tmp_path / "old.bag", "/wrench")
    found = table.finite_numbers(["force.x", "force.y", "force.z"], 3, "here")
    np.testing.assert_array_equal(found, FORCES[:, :3])
    np.testing.assert_allclose(table.columns["stamp"], T, atol=1e-9)


def test_description_fields_override_topic_defaults(tmp_path: Path) -> None:
    path = described(
        tmp_path,
        wrench={"file": "run1", "topic": "/ft", "force": {"unit": "lbf"}, "time": {"offset": 0.2}},
        imu={"file": "run1", "topic": "/imu", "angular_velocity": None},
        pose={
            "file": "run1",
            "topic": "/tf",
            "child_frame": "tool0",
            "orientation": {"inverse": True},
            "position": {"columns": ["a", "b", "c"]},
        },
    )
    found = load_description(path)
    assert found.wrench and found.imu and found.pose
    assert found.wrench.force.columns == ("force.x", "force.y", "force.z")
    assert (found.wrench.force.unit, found.wrench.torque.unit) == ("lbf", "N m")
    assert (found.wrench.time.column, found.wrench.time.offset) == ("stamp", 0.2)
    assert found.imu.angular_velocity is None and found.imu.specific_force is not None
    assert found.pose.orientation.inverse
    assert found.pose.orientation.columns[0] == "orientation.w"
    assert found.pose.position and found.pose.position.columns == ("a", "b", "c")
    assert found.pose.source == tmp_path / "run1" / "tf" / "tool0"
    for streams in ({"wrench": {"file": "x.csv"}}, {"static": {"file": "run1", "topic": "/ft"}}):
        with pytest.raises(DrakeTeleopError, match=r"is missing; add|unknown field 'topic'"):
            load_description(described(tmp_path, **streams))


@pytest.mark.slow
def test_inspecting_a_bag_lists_its_topics_and_drafts_a_description(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    topics = {
        "/ft": wrenches(),
        "/imu": imus(),
        "/odometry": poses("Odometry"),
        "/pose": poses("PoseStamped"),
    }
    bag = write_bag(tmp_path / "run1", {name: islice(x, 600) for name, x in topics.items()})
    summary = inspect_command(bag, tmp_path / "out")
    shown = capsys.readouterr().out
    assert summary["kind"] == "bag"
    assert summary["topics"]["/imu"]["type"] == "sensor_msgs/msg/Imu"
    assert summary["topics"]["/imu"]["messages"] == 600
    for word in ("/odometry", "geometry_msgs/msg/PoseStamped", "600"):
        assert word in shown
    draft = (tmp_path / "out" / "draft.yaml").read_text()
    assert "DRAFT" in draft and "suitable topics: /odometry (pose)" in draft
    # The draft is complete: every stream is used, without findings.
    found = inspect_command(tmp_path / "out" / "draft.yaml", tmp_path / "again", quiet=True)
    assert set(found["streams"]) == {"wrench", "imu", "pose"}
    assert found["findings"] == []
    assert found["fit"]["mass"] == pytest.approx(1.7, rel=0.01)


def test_draft_of_a_bag_without_wrench_topic_has_a_placeholder(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "run1", {"/odometry": islice(poses("Odometry"), 5)})
    (finding,) = inspect_command(bag, tmp_path / "out", quiet=True)["findings"]
    assert finding["message"].startswith("draft.yaml: no wrench: add wrench")
    draft = yaml.safe_load((tmp_path / "out" / "draft.yaml").read_text())
    assert draft == {"pose": {"file": "../run1", "topic": "/odometry"}}


@pytest.mark.parametrize(
    ("stream", "change", "words"),
    [
        ("wrench", {"topic": "/ft"}, ["no topic '/ft'", "/wrench (geometry_msgs/msg/Wrench"]),
        ("wrench", {"topic": "/imu"}, ["wrench.force.columns", "no column 'force.x'"]),
        (
            "wrench",
            {"topic": None} | PLAIN,
            ["run1", "no topic of the bag is specified", "`drake-teleop inspect` drafts"],
        ),
        ("wrench", {"file": "none.mcap"}, ["none.mcap", "no such file"]),
        ("wrench", {"file": "log.yaml"}, ["the path is not a bag", "metadata.yaml"]),
        ("wrench", {"file": "broken.mcap"}, ["broken.mcap", "cannot be read"]),
        ("wrench", {"file": "broken.bag"}, ["broken.bag", "cannot be read"]),
        ("wrench", {"file": "broken"}, ["cannot be read"]),
        ("imu", {"topic": "/blind"}, ["marks 'linear_acceleration.x' as not provided"]),
        ("pose", {}, ["/tf", "several child frames", "set child_frame to one of camera, tool0"]),
        ("pose", {"topic": "/tf", "child_frame": "hand"}, ["no child frame 'hand'", "tool0"]),
        (
            "pose",
            {"topic": "/imu", "child_frame": "x"},
            ["no child frame 'x'", "remove child_frame"],
        ),
        (
            "pose",
            {"topic": "/imu", "position": None},
            ["marks 'orientation.w' as not provided (covariance -1)"],
        ),
    ],
)
def test_invalid_bag_raises_error(
    tmp_path: Path, stream: str, change: dict[str, Any], words: list[str]
) -> None:
    topics = {
        "/wrench": wrenches(),
        "/imu": imus(),
        "/blind": imus(accelerometer=-1.0),
        "/tf": poses("TFMessage"),
    }
    write_bag(tmp_path / "run1", {name: islice(x, 20) for name, x in topics.items()})
    for name in ("broken.mcap", "broken.bag", "broken/metadata.yaml"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"rosbag2_bagfile_information: [1, 2")
    streams = {
        "wrench": {"file": "run1", "topic": "/wrench"},
        "imu": {"file": "run1", "topic": "/imu"},
    }
    if stream == "pose":
        streams["pose"] = {"file": "run1", "topic": "/tf"}
    streams[stream] |= change
    with pytest.raises(DrakeTeleopError) as error:
        read_log(described(tmp_path, **streams))
    for word in [*words, ";"]:
        assert word in str(error.value)


def test_error_names_the_missing_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_bag(tmp_path / "run1", {"/wrench": islice(wrenches(), 20)})
    monkeypatch.setitem(sys.modules, "rosbags", None)
    with pytest.raises(DrakeTeleopError, match=r"rosbags.*; install .*: pip install '\.\[ros\]' "):
        list_topics(tmp_path / "run1")


@pytest.mark.parametrize("limit", ["_UNPACKED_BYTES_MARGIN", "_MAX_ADDED_PROCESS_MEMORY_BYTES"])
def test_bag_with_excessive_uncompressed_size_raises_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: str
) -> None:
    """The size is declared in chunks or found while unpacking."""
    mcap = pytest.importorskip("mcap.writer")
    path, size = tmp_path / "x.mcap", 60_000_000
    with path.open("wb") as file:
        writer = mcap.Writer(file, chunk_size=2 * size)
        writer.start(profile="ros2", library="test")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        channel = writer.register_channel("/x", "cdr", schema)
        writer.add_message(channel, 0, b"\0\1\0\0" + bytes(size), 0)
        writer.finish()
    assert path.stat().st_size < size / 100
    monkeypatch.setattr(
        bags, "_MAX_UNPACK_RATIO", 1 if limit == "_UNPACKED_BYTES_MARGIN" else 10**6
    )
    monkeypatch.setattr(bags, limit, 40_000_000)
    with pytest.raises(DrakeTeleopError, match=r"its uncompressed size is too large \(.*\); cut"):
        read_topic(path, "/x")
    assert resource.getrlimit(resource.RLIMIT_AS)[0] == resource.RLIM_INFINITY


def test_messages_in_blocks_give_the_same_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bag = write_bag(tmp_path / "bag", {"/ft": wrenches(), "/tf": poses("TFMessage")})
    for topic, child in (("/ft", None), ("/tf", "tool0")):
        whole = read_topic(bag, topic, child).columns
        with monkeypatch.context() as patch:
            patch.setattr(bags, "_MESSAGES_PER_BLOCK", 7)
            parts = read_topic(bag, topic, child).columns
        assert parts.keys() == whole.keys() and len(whole["received"]) > 7
        for name, values in whole.items():
            np.testing.assert_array_equal(parts[name], values)
