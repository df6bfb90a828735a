"""Targets of `fuzz.py`: readers of user files, and options (long: all of them).

A target has good inputs, a mutation, and a function that uses the result. A case is good if that
function returns, or raises a DrakeTeleopError of one line.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import math
import random
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import fuzz_mutations as mutations
import fuzz_recordings as recordings
import fuzz_robots as robots
import numpy as np
import polars as pl
from fuzz_mutations import Mutation
from pydrake.math import RollPitchYaw
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import DiagramBuilder

from drake_teleop.cli import main as cli
from drake_teleop.common.errors import MAX_ERROR_LINE_LENGTH, DrakeTeleopError
from drake_teleop.common.files import models_dir, scenarios_dir, studies_dir
from drake_teleop.common.parquet_sizes import check_parquet_content_sizes
from drake_teleop.common.texts import parse_yaml, read_json
from drake_teleop.lab.excitation.robot import RobotFromModel
from drake_teleop.lab.studies import study
from drake_teleop.live.inputs import INPUT_RANGES, Inputs, csv_header, input_range, read_inputs
from drake_teleop.live.inputs import csv_row as inputs_row
from drake_teleop.live.live import MAX_SLOWDOWN, parse_message
from drake_teleop.load.identification import Identification
from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.load.trajectory import FourierTrajectory
from drake_teleop.logs.inspection import inspect_command
from drake_teleop.logs.processing import eliminate_log, identify_log
from drake_teleop.logs.read.bags import list_topics, read_topic
from drake_teleop.logs.read.reading import read_log
from drake_teleop.robots import udp
from drake_teleop.robots.compensator import Compensator
from drake_teleop.robots.lines import reading_of_json_line
from drake_teleop.robots.streams import NONZERO_WRENCH_FLAGS, Reading
from drake_teleop.station.channel import network
from drake_teleop.station.passivity.packet import PACKET_SIZE
from drake_teleop.station.result import Signal, SimulationResult
from drake_teleop.station.scenario import LoadScenario, ScenarioFromData
from drake_teleop.station.scenario_reference import to_commented_yaml
from drake_teleop.station.sensor.sensor_chain import WristSensorConfig
from drake_teleop.station.slave.models import ParseModel, translate_drake_errors
from drake_teleop.station.slave.plant import AddSlavePlant
from drake_teleop.station.slave.scene import Scene
from drake_teleop.station.slave.slave_config import Slave

_AXES = [f"{group}_{axis}" for group in ("f", "tau", "s", "omega", "alpha") for axis in "xyz"]


@dataclasses.dataclass(frozen=True)
class Target:
    """Reader with its inputs.

    Args:
        name: of the target.
        suffix: of its files.
        share: of the time.
        seeds: returns good inputs, and writes the files that they refer to into the given folder.
        mutate: makes a case of a good input.
        run: reads the file.
    """

    name: str
    suffix: str
    share: float
    seeds: Callable[[Path], list[bytes]]
    mutate: Mutation
    run: Callable[[Path], Any]


def _contents(folder: Path, pattern: str) -> list[bytes]:
    return [path.read_bytes() for path in sorted(folder.glob(pattern))]


# Texts.


def _scenario(path: Path) -> None:
    scenario = LoadScenario(path)
    if path.stat().st_size % 4:  # the rest takes longer
        return
    text = to_commented_yaml(scenario)
    if ScenarioFromData(parse_yaml(text, "printed", tagged=True), "printed") != scenario:
        raise AssertionError("what `drake-teleop scenario` prints is another scenario")


class _Enough(Exception):
    """Exception that ends a command before it runs."""


def _study(path: Path) -> None:
    def enough(*_: Any, **__: Any) -> None:
        raise _Enough

    kept, study.run_study = study.run_study, enough
    try:
        study.study_command(path, path.parent / "out", quiet=True)
    except _Enough:
        design = study.LoadStudy(path)
        if design.num_points() <= 5000:
            design.points()
    finally:
        study.run_study = kept


def _load_files(_: Path) -> list[bytes]:
    phi = phi_from_mass_com_inertia(1.7, [0.01, -0.02, 0.06], np.diag([0.004, 0.005, 0.003]))
    variances = np.full(16, 1e-4)
    variances[15] = np.inf
    load = Identification(
        *(phi, np.arange(6.0), np.diag(variances), np.isfinite(variances), 4.0, 0.01, np.ones(6)),
        *("batch least squares", 100),
    )
    return [_written(load.save), _written(dataclasses.replace(load, phi=-phi).save)]


def _written(save: Callable[[Path], Any], suffix: str = "") -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"x{suffix}"
        save(path)
        return path.read_bytes()


def _load(path: Path) -> None:
    load = Identification.load(path)
    repr(load)
    if _written(Identification.load(path).save) != _written(load.save):
        raise AssertionError("it is read in two ways")


def _trajectories(_: Path) -> list[bytes]:
    rho = np.array([[0.1, 0.2, 0.0], [0.3, -0.1, 0.1]])
    motion = FourierTrajectory(np.zeros(2), rho, -rho, 0.1)
    return [_written(lambda path: motion.save(path, ("shoulder", "elbow")))]


def _trajectory(path: Path) -> None:
    motion = FourierTrajectory.load(path)
    motion.evaluate(np.linspace(0.0, 1.0, 5))


# Logs.


def columns(count: int = 80) -> dict[str, np.ndarray]:
    """Return a canonical log with a pose: `count` samples of a load that rotates and shakes."""
    t = 0.01 * np.arange(count)
    phases = np.outer(t, 2 * np.pi * np.array([0.9, 1.7, 2.3]))
    angles, rates = np.sin(phases), 2 * np.pi * np.array([0.9, 1.7, 2.3])
    rpy, omega = angles, rates * np.cos(phases)
    R = np.array([RollPitchYaw(*row).ToRotationMatrix().matrix() for row in rpy])
    q = np.array([RollPitchYaw(*row).ToQuaternion().wxyz() for row in rpy])
    s = np.einsum("nji,j->ni", R, [0.0, 0.0, 9.81]) + 3.0 * np.cos(2 * phases)
    alpha = -(rates**2) * angles
    phi = phi_from_mass_com_inertia(1.7, [0.01, -0.02, 0.06], np.diag([0.004, 0.005, 0.003]))
    wrench = non_contact_wrench(s, omega, alpha, phi) + 0.5 + 0.01 * np.sin(97.0 * phases[:, :1])
    values = np.hstack([wrench, s, omega, alpha, q, 0.1 * angles])
    names = [*_AXES, "q_w", "q_x", "q_y", "q_z", "p_x", "p_y", "p_z"]
    return {"t": t} | dict(zip(names, np.ascontiguousarray(values.T), strict=True))


def _tables(suffix: str) -> Callable[[Path], list[bytes]]:
    def tables(_: Path) -> list[bytes]:
        whole = columns()
        motion = {name: whole[name] for name in ("t", *_AXES)}
        pose = {name: x for name, x in whole.items() if name[0] in "tfqp"}
        return [mutations.encoded(suffix, each) for each in (whole, motion, pose)]

    return tables


_STREAM = "force: {columns: [f_x, f_y, f_z]}, torque: {columns: [tau_x, tau_y, tau_z]}"
_DESCRIPTIONS = (
    """gravity: 9.81
wrench:
  file: w.csv
  time: {column: t, unit: ms, offset: 0.5}
  force: {columns: [f_x, f_y, f_z]}
  torque: {columns: [tau_x, tau_y, tau_z]}
  sign: -1
pose:
  file: p.npz
  time: {rate: 100}
  orientation: {columns: [R], form: matrix, inverse: false}
  position: {columns: [p], unit: mm}
""",
    f"""wrench: {{file: w.csv, time: {{column: t, unit: ms}}, frame: base, {_STREAM}}}
imu:
  file: i.csv
  header: false
  time: {{column: 0, scale: 1.0}}
  specific_force: {{columns: [7, 8, 9], unit: g, bias: [0.1, 0, 0]}}
  angular_velocity: {{columns: [10, 11, 12], unit: deg/s}}
  sign: -1
  frame: [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
  position: [0.1, 0, 0.02]
pose:
  file: w.csv
  time: {{column: t, unit: ms}}
  orientation: {{columns: [q_w, q_x, q_y, q_z], form: quaternion_wxyz}}
""",
    """gravity: [0, 0, -9.81]
static:
  file: w.csv
  force: {columns: [f_x, f_y, f_z], unit: lbf}
  torque: {columns: [tau_x, tau_y, tau_z], unit: lbf in}
  gravity: {columns: [s_x, s_y, s_z]}
""",
    """wrench: {file: w.mcap, topic: /ft}
imu: {file: w.mcap, topic: /imu, angular_velocity: {bias: [0, 0, 0.1]}}
""",
)


def _descriptions(folder: Path) -> list[bytes]:
    whole = columns()
    scaled = whole | {"t": 1e3 * whole["t"]}
    (folder / "w.csv").write_bytes(mutations.encoded(".csv", scaled))
    (folder / "i.csv").write_bytes(mutations.encoded(".csv", whole).partition(b"\n")[2])
    (folder / "w.mcap").write_bytes(_bags(".mcap")(folder)[0])
    turned = np.tile(np.eye(3), (len(whole["t"]), 1, 1))
    place = np.column_stack([whole[name] for name in ("p_x", "p_y", "p_z")])
    (folder / "p.npz").write_bytes(mutations.encoded(".npz", {"R": turned, "p": place}))
    return [text.encode() for text in _DESCRIPTIONS]


def _processed(path: Path) -> None:
    found = identify_log(path)
    eliminate_log(path, found.identification)


def _inspected(path: Path) -> None:
    inspect_command(path, path.parent / "inspected", quiet=True)


def _bags(suffix: str) -> Callable[[Path], list[bytes]]:
    def bags(_: Path) -> list[bytes]:
        with tempfile.TemporaryDirectory() as folder:
            bag = _write_bag(Path(folder) / "x", suffix)
            return [(bag if bag.is_file() else next(bag.glob(f"*{suffix}"))).read_bytes()]

    return bags


def _write_bag(path: Path, suffix: str) -> Path:
    """Write wrenches, an IMU and transforms, 30 messages each, as a file or a ROS 2 folder."""
    from rosbags import rosbag1, rosbag2
    from rosbags.typesys import Stores, get_typestore

    old = suffix == ".bag"
    store = get_typestore(Stores.ROS1_NOETIC if old else Stores.ROS2_JAZZY)
    kind = rosbag2.StoragePlugin.MCAP if suffix == ".mcap" else rosbag2.StoragePlugin.SQLITE3
    writer = rosbag1.Writer(path) if old else rosbag2.Writer(path, version=9, storage_plugin=kind)
    with writer as bag:
        for topic, name, message in _messages(store.types, old):
            links = {link.topic: link for link in bag.connections}
            link = links.get(topic) or bag.add_connection(topic, name, typestore=store)
            raw = (store.serialize_ros1 if old else store.serialize_cdr)(message, name)
            stamp = (message.transforms[0] if topic == "/tf" else message).header.stamp
            bag.write(link, stamp.sec * 10**9 + stamp.nanosec + 10**6, raw)
    return path


def _metadata(folder: Path) -> list[bytes]:
    return _contents(_write_bag(folder / "bag", ".mcap"), "metadata.yaml")


def _messages(types: Any, old: bool) -> Any:
    kind = {name.split("/")[-1]: name for name in types}
    kind["Time"] = "builtin_interfaces/msg/Time"

    def new(name: str, *fields: Any) -> Any:
        return types[kind[name]](*fields)

    whole = columns(30)
    for row in range(30):
        w, s, omega = (
            [float(whole[name][row]) for name in names]
            for names in (_AXES[:6], _AXES[6:9], _AXES[9:12])
        )
        stamp = new("Time", 100, row * 10**7)
        header = new("Header", *([row] if old else []), stamp, "world")
        wrench = new("Wrench", new("Vector3", *w[:3]), new("Vector3", *w[3:]))
        yield "/ft", kind["WrenchStamped"], new("WrenchStamped", header, wrench)
        turn = new("Quaternion", 0.0, 0.0, 0.0, 1.0)
        rates, specific = new("Vector3", *omega), new("Vector3", *s)
        nine = np.zeros(9)
        yield "/imu", kind["Imu"], new("Imu", header, turn, nine - 1, rates, nine, specific, nine)
        place = new("Transform", new("Vector3", *w[:3]), turn)
        tool = new("TransformStamped", header, "tool0", place)
        if old:  # its types have no TFMessage
            yield "/tool", kind["TransformStamped"], tool
        else:
            yield "/tf", kind["TFMessage"], new("TFMessage", [tool, tool])


def _bag(path: Path) -> None:
    topics = list_topics(path)
    for topic in topics[:5]:
        read_topic(path, topic.name)


def _bag_folder(path: Path) -> None:
    shutil.copy(path, path.parent / "bag" / "metadata.yaml")
    _bag(path.parent / "bag")


_SPECS = [Signal("wrench", ("f_x", "f_y"), "N", "a force"), Signal("mode", ("mode",), "1", "")]


def _results(_: Path) -> list[bytes]:
    t = np.linspace(0.0, 1.0, 20)
    values = {"wrench": np.column_stack([t, t]), "mode": t[:, np.newaxis]}
    return [_written(SimulationResult(t, values, _SPECS).write_parquet, ".parquet")]


def _result_mutation(rng: random.Random, content: bytes, other: bytes) -> bytes:
    """Change the columns of a simulation's log, also by its own signals, or their names."""
    if rng.random() < 0.4:
        return mutations.damaged(rng, content, other)
    try:
        check_parquet_content_sizes(content)
        found = dict(pl.read_parquet_metadata(io.BytesIO(content)))
        key = next(name for name in found if name != "ARROW:schema")
        if rng.random() < 0.5:
            found[key] = mutations.json_text(rng, found[key].encode(), other).decode()
        else:
            content = mutations.table(".parquet")(rng, content, other)
        stream = io.BytesIO()
        mutations.read_parquet(io.BytesIO(content)).write_parquet(
            stream, metadata={key: found[key]}
        )
        return stream.getvalue()
    # Tables that polars cannot write are damaged as bytes.
    except (Exception, pl.exceptions.PanicException):
        return mutations.damaged(rng, content, other)


def _result(path: Path) -> None:
    result = SimulationResult.read_parquet(path)
    repr(result)
    result.to_dataframe()


# Arms.

_URDF = """<robot name="arm">
%s<joint name="tool" type="fixed"><parent link="l3"/><child link="sensor"/><origin xyz="0 0 0.1"/>
</joint><link name="sensor"/></robot>
"""
_LINK = """<link name="l{k}"><inertial><origin xyz="0 0 0.1" rpy="0 0 0"/><mass value="2"/>
<inertia ixx="0.02" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.01"/></inertial><collision>
<origin xyz="0 0 0.1"/><geometry><cylinder radius="0.03" length="0.2"/></geometry></collision>
<visual><geometry><mesh filename="package://parts/{k}.stl"/></geometry></visual></link>
"""
_JOINT = """<joint name="j{k}" type="revolute"><parent link="l{j}"/><child link="l{k}"/>
<origin xyz="0 0 0.3"/><axis xyz="{axis}"/><dynamics damping="0.1" friction="0"/>
<limit lower="-2" upper="2.5" velocity="3" effort="100"/></joint>
"""


def _urdfs(_: Path) -> list[bytes]:
    links = "".join(_LINK.format(k=k) for k in range(4))
    axes = ("0 0 1", "0 1 0", "1 0 0")
    joints = (_JOINT.format(j=k, k=k + 1, axis=axis) for k, axis in enumerate(axes))
    return [(_URDF % (links + "".join(joints))).encode()]


_MJCF = b"""<mujoco model="arm"><compiler eulerseq="xYz" inertiagrouprange="0 3"/>
<default><joint armature="0.1"/><default class="far"><geom type="box" size="0.1 0.2 0.1"/>
<motor gear="30"/></default></default><asset><mesh name="t" inertia="exact"
vertex="0 0 0 .1 0 0 0 .1 0 0 0 .1" scale="1 -1 2" refpos="0.1 0 0"/></asset>
<worldbody><frame pos="0 0 0.1" zaxis="0 1 1"><body name="l1" axisangle="0 0 1 20">
<inertial pos="0 0 0.1" mass="2" diaginertia="0.02 0.02 0.01" xyaxes="1 0 0 0 1 1"/>
<joint name="j1" type="hinge" axis="0 0 1" range="-100 100" damping="0.1" ref="10"/>
<geom type="capsule" size="0.03" fromto="0 0 0 0.1 0.2 0.1"/><geom type="mesh" mesh="t" mass="1"/>
<body name="l2" pos="0 0 0.3" euler="10 20 30" childclass="far"><joint name="j2" axis="0 1 0"
limited="true" range="-90 90"/><joint name="j3" type="slide" actuatorfrcrange="-9 8"/>
<geom mass="1"/><site name="sensor" pos="0 0 0.1"/><body name="tip"><joint name="j4"/>
<inertial pos="0 0 0" mass="0.1" fullinertia="1e-3 2e-3 4e-3 0 0 1e-5"/></body></body></body>
</frame><body name="cup"><freejoint/><geom size="0.1"/></body></worldbody>
<equality><joint joint1="j4"/><weld body1="tip" body2="l2"/></equality>
<actuator><motor joint="j1" ctrlrange="-10 10"/><motor class="far" joint="j2"
forcerange="-1 1"/></actuator><sensor><force site="sensor"/></sensor></mujoco>
"""


def _directives(folder: Path) -> list[bytes]:
    (folder / "parts").mkdir()
    for name in ("rx90", "tool"):
        shutil.copy(models_dir() / f"{name}.sdf", folder / "parts")
    (text,) = _contents(models_dir(), "slave.dmd.yaml")
    text = text.replace(b"package://drake_teleop", b"package://parts")
    return [text[: text.index(b"- add_model:\n    name: sheet_spring")]]


def _sdfs(_: Path) -> list[bytes]:
    return _contents(models_dir(), "rx90.sdf")


def _model(path: Path) -> None:
    plant = MultibodyPlant(0.0)
    ParseModel(plant, path, "sensor")
    with translate_drake_errors(path):
        plant.Finalize()


def _doors(_: Path) -> list[bytes]:
    return _contents(models_dir(), "door.sdf")


def _scene(path: Path) -> None:
    AddSlavePlant(DiagramBuilder(), Slave(), Scene(file=str(path)))


def _robot(path: Path) -> None:
    RobotFromModel(path, "sensor", WristSensorConfig())


# The network.


def _traces(suffix: str) -> Callable[[Path], list[bytes]]:
    def traces(_: Path) -> list[bytes]:
        time = 0.02 * np.arange(40)
        delay = 0.05 + 0.01 * np.sin(9.0 * time)
        delay[7] = np.nan
        return [mutations.encoded(suffix, {"time": time, "delay": delay})]

    return traces


def _trace(path: Path) -> None:
    config = network.NetworkConfig(trace=str(path))
    network.network_parameters(config, 0, network.FORWARD, 1e-3)
    if not network.mean_delay(config) <= network.longest_delay(config) + 1e-9:
        raise AssertionError("the mean delay is longer than the longest")


_LINES = (
    {"network": "internet"},
    {"network": "lan", "timeout": 0.05},
    {
        "delay": 0.01,
        "jitter": 0.5,
        "loss": 0.1,
        "burst": 0.02,
        "backward": {"delay": 0.003, "playout": 0.01, "redundant": True, "silence": "zero"},
    },
    {"rate_hz": 100.0, "silence": "extrapolate"},
)


def _exchanges(_: Path) -> list[bytes]:
    numbers = [1.0, 0.5, -3.0, 1e3, 0.0]
    return [json.dumps({"channel": line, "packets": numbers}).encode() for line in _LINES]


def _exchange(path: Path) -> None:
    """Send 60 packets through both lines; check that packets arrive unchanged."""
    data = read_json(path)
    known = data if isinstance(data, dict) else {}
    scenario = ScenarioFromData({"channel": known.get("channel", {})}, str(path))
    numbers = _floats(known.get("packets"))
    for direction, config in enumerate(scenario.channel.networks_of_directions()):
        p = network.network_parameters(config, 1, direction, 1e-3)
        neutral, packet = np.zeros(PACKET_SIZE), np.empty(PACKET_SIZE)
        state = network.initial_network_state(p, neutral)
        sent = [np.resize(np.roll(numbers, k), PACKET_SIZE) for k in range(60)]
        for k, each in enumerate(sent):
            network.send_packet(p, state, k, each)
            newest, fresh = network.receive_packet(p, state, k, packet)
            expected = sent[newest] if newest >= 0 else neutral
            if newest > k or (fresh and packet.tobytes() != expected.tobytes()):
                raise AssertionError(f"packet {newest} came changed, or before it was sent")


def _drives(_: Path) -> list[bytes]:
    lines = [
        inputs_row(ms, Inputs(x=ms, sigma=ms % 100, clutch=ms % 2)) for ms in range(0, 200, 20)
    ]
    return ["".join([csv_header(), *lines]).encode()]


_MESSAGES = (
    {"set": {"x": 10, "y": -20.5, "rz": 3, "sigma": 50, "force_scale": 5714, "held": 1}},
    {"pause": True, "slow": 5, "set": {"clutch": 0}},
    {"drive": True, "reset": True, "scene": "slot"},
    {"set": {"network": 7, "delay": 500, "method": 2, "sensor": 1, "object": 1, "grip": 0}},
)


def _message(path: Path) -> None:
    """Check that any message of a page gives only bounded values."""
    content = path.read_bytes()
    said = [parse_message(text) for text in (content, content.decode(errors="replace"))]
    for found in filter(None, said):
        inputs = Inputs().with_changes(found.get("set", {}))
        for name in INPUT_RANGES:
            value, (low, high) = getattr(inputs, name), input_range(name)
            if not (isinstance(value, int) and low <= value <= high):
                raise AssertionError(f"{name} = {value!r}")
        pose = inputs.with_changes({"held": 1}).intended_pose(np.zeros(3))
        if not 1.0 <= found.get("slow", 1.0) <= MAX_SLOWDOWN or not np.isfinite(pose).all():
            raise AssertionError(f"{found!r}")


def _floats(value: Any) -> np.ndarray:
    numbers = value if isinstance(value, list) and value else [0.0]
    return np.array([x if isinstance(x, (int, float)) else math.nan for x in numbers], float)


# Packets of robots to `compensate`.


def _readings() -> list[Reading]:
    values = np.tile([*np.arange(6.0), 0.0, 0.0, 9.81, *np.zeros(6)], (20, 1))
    values[:, 0] += np.sin(np.arange(20.0))
    return [Reading(k, 1e-3 * k, row) for k, row in enumerate(values)]


def _reading_packets(_: Path) -> list[bytes]:
    return [b"".join(map(udp.pack_reading, _readings()))]


def _reading_lines(_: Path) -> list[bytes]:
    names = {"wrench": slice(6), "s": slice(6, 9), "omega": slice(9, 12), "alpha": slice(12, 15)}
    rows = [
        {"t": each.t} | {name: each.values[part].tolist() for name, part in names.items()}
        for each in _readings()
    ]
    return ["\n".join(map(json.dumps, rows)).encode()]


def _wrenches(path: Path) -> None:
    """Check that all outputs are finite, and zero if they are flagged."""
    content, size = path.read_bytes(), udp.READING_FORMAT.size
    if path.suffix == ".bin":
        parts = [content[k : k + size] for k in range(0, len(content), size)]
        readings = [udp.unpack_reading(part) for part in parts]
    else:
        readings = [reading_of_json_line(line, k) for k, line in enumerate(content.split(b"\n"))]
    compensator = Compensator(robots.LOAD, 1e-3, gamma=2.0, sensor_range=np.full(6, 50.0))
    for k, reading in enumerate(readings):
        out = compensator.step(reading, 1e-3 * k)
        numbers = np.array([out.t, *out.contact, *out.scaled])
        zero = bool(out.flags & ~NONZERO_WRENCH_FLAGS)
        if not np.isfinite(numbers).all() or (np.abs(numbers[1:]) > 50.0).any():
            raise AssertionError(f"{out!r}")
        if zero and numbers[1:].any():
            raise AssertionError(f"{out!r}")
    compensator.tare()


# Options.

_COMMANDS = (
    "reproduce --out out/r --seed 3 --quiet",
    "run contact_transition --out out/c --seed 7 --fresh",
    "run --inputs out/d --out out/c",
    "drive press --record out/d --port 8000 --no-browser",
    "scenario press",
    "replay out/c --scenario press",
    "identify log.csv --gripper g.json --method robust --cutoff 20 --delay 0.01",
    "eliminate log.csv --load l.json --sigma 0.5 --gamma 2 --eta 0.1 --causal delayed "
    "--causal-tare 2 --free f.csv --delay auto",
    "detect log.csv --load l.json --statistic cusum",
    "compensate udp://:9000 --load l.json --out udp://:9001 --rate 1000 --range 200 10 --tare "
    "--control 9002 --sigma 0.5 --gamma 2 --predicted --cutoff 20",
    "compensate netft://10.0.0.1?counts=1e6,1e6 --motion rtde://10.0.0.2 --load l.json "
    "--out a.mcap --sensor-pose 0 0 0.045 0 0 45",
    "inspect log.csv",
    "sample-log --seed 1",
    "analyze press --direction x",
    "compare-passivity --networks lan,internet --methods none,wave --jobs 2",
    "study scaling_touch --jobs 1 --cluster local",
    "scaling-study --repeats 3",
    "excite identification --model rx90.sdf --sensor-frame sensor --package-path a --acceleration "
    "1,2,3 --payload 2 --criterion A16 --period 5 --harmonics 4 --time 3",
    "--version",
    "excite --help",
)


def _commands(_: Path) -> list[bytes]:
    for command in cli.cli.commands.values():
        command.callback = lambda **_: None  # only options are read here
    return [json.dumps(line.split()).encode() for line in _COMMANDS]


def _command_line(path: Path) -> None:
    said = io.StringIO()
    words = [word.replace("\0", "") for word in json.loads(path.read_bytes())]
    with contextlib.redirect_stderr(said):
        status = cli._run_and_get_exit_status(words)
    line = said.getvalue().rstrip("\n")
    refused = line.startswith("error: ") and len(line) <= MAX_ERROR_LINE_LENGTH and "\n" not in line
    if refused:
        raise DrakeTeleopError(line.removeprefix("error: "))
    if line or status not in (None, 0, 2):  # 2: help text, if words are missing
        raise AssertionError(f"exit status {status}, said {line!r}")


_yaml, _json = mutations.yaml_text, mutations.json_text
TARGETS = (
    Target(
        "scenario", ".yaml", 5, lambda _: _contents(scenarios_dir(), "*.yaml"), _yaml, _scenario
    ),
    Target("study", ".yaml", 1.5, lambda _: _contents(studies_dir(), "*.yaml"), _yaml, _study),
    Target("load", ".json", 3, _load_files, _json, _load),
    Target("trajectory", ".yaml", 1, _trajectories, _yaml, _trajectory),
    Target("description", ".yaml", 3, _descriptions, _yaml, read_log),
    *(
        Target(f"log_{suffix}", f".{suffix}", 2, _tables(f".{suffix}"), change, read_log)
        for suffix in ("csv", "npz", "parquet", "mat")
        for change in [mutations.table(f".{suffix}")]
    ),
    *(
        Target(f"log_{name}", f".{name}", 1, _tables(f".{name}"), mutations.damaged, read_log)
        for name in ("arrow", "jsonl", "npy", "h5")
    ),
    Target("identify", ".npz", 3, _tables(".npz"), mutations.table(".npz"), _processed),
    Target("inspect", ".npz", 1.5, _tables(".npz"), mutations.table(".npz"), _inspected),
    *(
        Target(f"bag_{suffix}", f".{suffix}", 1, _bags(f".{suffix}"), mutations.damaged, _bag)
        for suffix in ("mcap", "db3", "bag")
    ),
    Target("metadata", ".yaml", 0.5, _metadata, _yaml, _bag_folder),
    Target("result", ".parquet", 2, _results, _result_mutation, _result),
    Target("urdf", ".urdf", 1.5, _urdfs, mutations.xml, _model),
    Target("sdf", ".sdf", 1, _sdfs, mutations.xml, _model),
    Target("scene", ".sdf", 1, _doors, mutations.xml, _scene),
    Target("mjcf", ".xml", 1, lambda _: [_MJCF], mutations.xml, _model),
    Target("dmd", ".dmd.yaml", 0.5, _directives, _yaml, _model),
    Target("robot", ".urdf", 2, _urdfs, mutations.xml, _robot),
    *(
        Target(f"trace_{suffix}", f".{suffix}", 1, _traces(f".{suffix}"), change, _trace)
        for suffix in ("csv", "npz")
        for change in [mutations.table(f".{suffix}")]
    ),
    Target("packets", ".json", 2, _exchanges, _json, _exchange),
    Target("inputs", ".csv", 1, _drives, mutations.text, read_inputs),
    Target(
        "message",
        ".json",
        1,
        lambda _: [json.dumps(each).encode() for each in _MESSAGES],
        _json,
        _message,
    ),
    Target("wrenches", ".bin", 1, _reading_packets, mutations.damaged, _wrenches),
    Target("wrenches_lines", ".jsonl", 1, _reading_lines, mutations.text, _wrenches),
    *(
        Target(f"wrenches_{name}", ".bin", 0.5, seeds, mutations.damaged, run)
        for name, seeds, run in (
            ("netft", robots.records, robots.netft_wrenches),
            ("rtde", robots.samples, robots.rtde_wrenches),
            ("ros", robots.messages, robots.ros_wrenches),
        )
    ),
    Target("names", ".json", 2, recordings.names, recordings.name_mutation, recordings.new),
    Target("files", ".json", 2, recordings.includes, recordings.include_mutation, recordings.model),
    *(
        Target(name, ".json", 0.5, seeds, _json, run)
        for name, seeds, run in (
            ("stamps", recordings.stamps, recordings.recorded),
            ("full_disk", recordings.sizes, recordings.full_disk),
            ("killed", recordings.delays, recordings.killed),
        )
    ),
    Target("options", ".json", 2, _commands, mutations.arguments, _command_line),
)


def target_of(path: Path) -> Target:
    """Return the target of a stored case, TARGET-anything.suffix."""
    return next(target for target in TARGETS if path.name.startswith(f"{target.name}-"))
