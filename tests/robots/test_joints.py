"""Motion of the sensor from the joint positions of a modelled arm."""

from __future__ import annotations

import json
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from peer import joint_state
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from test_calibrate import NOISE, PHI
from test_peers import free_port, peer
from test_reading_assembly import StreamStub

from drake_teleop.cli.main import cli, main
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.load.tolerance import (
    display_values_of_required_entries,
    parse_tolerance,
    tolerances_in_display_units,
)
from drake_teleop.robots.assembly import (
    ReadingAssembler,
    WrenchAndMotionStreams,
)
from drake_teleop.robots.connections import open_source
from drake_teleop.robots.ros2_zenoh import CdrConverter
from drake_teleop.robots.streams import JOINTS, POSE, WRENCH, Reading
from drake_teleop.station.slave.arm import sensor_motion
from drake_teleop.station.slave.plant import read_arm_without_default_limits

DT = 0.002
NAMES = ("lift", "bend", "roll", "yaw")
_AXES = ("0 0 1", "0 1 0", "0.6 0 0.8", "1 0 0")


def _urdf() -> str:
    inertia = '<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/>'
    body = f'<inertial><mass value="1"/>{inertia}</inertial>'
    text = '<robot name="arm"><link name="base"/>'
    parents = ("base", *NAMES[:-1])
    for k, (parent, name, axis) in enumerate(zip(parents, NAMES, _AXES, strict=True)):
        text += (
            f'<link name="{name}">{body}</link><joint name="{name}" type="revolute">'
            f'<parent link="{parent}"/><child link="{name}"/><axis xyz="{axis}"/>'
            f'<origin xyz="0.1 {0.02 * k} 0.2" rpy="0.3 {-0.2 * k} 0.5"/>'
            '<limit lower="-3" upper="3" velocity="9" effort="99"/></joint>'
        )
    return (
        text
        + f'<link name="tool">{body}</link><joint name="weld" type="fixed"><parent link="yaw"/>'
        '<child link="tool"/><origin xyz="0 0.01 0.08" rpy="0.1 0.2 0.3"/></joint></robot>'
    )


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("arm") / "arm.urdf"
    path.write_text(_urdf())
    return path


def moved(seconds: float) -> tuple[np.ndarray, ...]:
    """Return times, and positions, speeds and accelerations of the joints."""
    t = DT * np.arange(round(seconds / DT))
    w = 2.0 * np.pi * np.array([0.5, 0.9, 1.3, 1.1])
    a, phase = np.array([0.3, 0.4, 0.5, 0.6]), np.outer(t, w) + np.arange(4)
    return t, a * np.sin(phase), a * w * np.cos(phase), -a * w * w * np.sin(phase)


def motion_of(table: np.ndarray, joints: tuple[np.ndarray, ...]) -> np.ndarray:
    """Return the motion (N, 9) of S by the recursion of the arm."""
    out = np.empty((len(joints[0]), 21))
    for row, q, v, vdot in zip(out, *joints, strict=True):
        sensor_motion(table, q, v, vdot, row)
    return out[:, :9]


def test_pose_equals_drake(model: Path) -> None:
    arm = read_arm_without_default_limits(model, "tool")
    assert arm is not None and arm.joint_names == NAMES
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModels(str(model))
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base"))
    plant.Finalize()
    context, q = plant.CreateDefaultContext(), np.array([0.4, -0.7, 1.1, 0.3])
    plant.SetPositions(context, q)
    X_WS = plant.GetFrameByName("tool").CalcPoseInWorld(context)
    pose, wxyz = arm.pose(q), X_WS.rotation().ToQuaternion().wxyz()
    np.testing.assert_allclose(pose[4:], X_WS.translation(), atol=1e-12)
    assert abs(pose[:4] @ wxyz) == pytest.approx(1.0, abs=1e-12)


def test_joint_order_is_arbitrary_and_gripper_joints_are_ignored() -> None:
    messages = CdrConverter(1.0, joints=NAMES)
    sent = joint_state(5_250_000_000, [*NAMES[::-1], "finger"], [4.0, 3.0, 2.0, 1.0, 9.0])
    (part,) = messages.readings_of_cdr(JOINTS, sent, b"")
    assert part.stream == JOINTS and part.t == 5.25
    np.testing.assert_array_equal(part.values, [1.0, 2.0, 3.0, 4.0])
    assert messages.readings_of_cdr(JOINTS, joint_state(0, ["finger"], [9.0]), b"") == []
    assert messages.readings_of_cdr(JOINTS, joint_state(0, list(NAMES), [1.0]), b"") == []


class JointSource(StreamStub):
    """Source of given parts."""

    def __init__(self, parts: list[Reading]) -> None:
        super().__init__(WRENCH, JOINTS, POSE)
        self._parts = parts

    def read(self, timeout_s: float) -> list[Reading]:
        return self._parts


def test_joint_motion_gives_the_motion_of_the_sensor(model: Path) -> None:
    arm = read_arm_without_default_limits(model, "tool")
    assert arm is not None
    t, *joints = moved(0.4)
    bad = Reading(0, 0.0, np.zeros(7), stream=POSE), Reading(0, 0.0, np.full(3, 0.1), stream=JOINTS)
    parts = [Reading(k, float(t[k]), q, stream=JOINTS) for k, q in enumerate(joints[0])]
    source = WrenchAndMotionStreams(JointSource([*bad, *parts]), arm=arm)
    assert source.streams == (WRENCH, POSE)
    sent = source.read(0.0)
    assert sent is not None and len(sent) == len(parts) + 1 and np.isnan(sent[0].values).all()
    assembly, found = ReadingAssembler(source), []
    for k, part in enumerate(sent[1:]):
        wrench = Reading(k, part.t, np.zeros(6), stream=WRENCH, arrival=part.t)
        for each in (part._replace(arrival=part.t), wrench):
            found += assembly.readings_completed_by(each)
    good = [each for each in found if not each.flags]
    wanted = motion_of(arm.table, tuple(joints))[[each.number for each in good]]
    motion = np.array([each.values[6:] for each in good])
    assert len(good) > 100
    worst = np.abs(motion - wanted).max(axis=0)
    np.testing.assert_array_less(worst, np.repeat([0.05, 0.01, 0.3], 3))


def test_options_for_joints_are_checked_together(model: Path) -> None:
    arm, address = (
        read_arm_without_default_limits(model, "tool"),
        "zenoh://127.0.0.1/ft?joints=/joint_states",
    )
    with pytest.raises(DrakeTeleopError, match="joint positions need the model of the arm"):
        open_source(address, None, rate_hz=500.0)
    with pytest.raises(DrakeTeleopError, match="delivers no joint positions for --model"):
        open_source("posed://127.0.0.1:0", None, rate_hz=500.0, arm=arm)
    with pytest.raises(SystemExit):
        main(["compensate", "udp://:1", "--rate", "1", "--load", "x", "--sensor-frame", "tool"])


@pytest.mark.slow
@pytest.mark.parametrize("box", ["netft", "zenoh"])
def test_calibration_with_a_wrench_source_and_joints(box: str, model: Path, tmp_path: Path) -> None:
    """Wrench by either protocol and joints by ROS 2 come from other processes."""
    arm = read_arm_without_default_limits(model, "tool")
    assert arm is not None
    _, *joints = moved(40.0)
    motion = np.split(motion_of(arm.table, tuple(joints)), 3, axis=1)
    wrench = non_contact_wrench(*motion, PHI) + 1.0
    wrench += NOISE * np.random.default_rng(0).normal(size=wrench.shape)
    (tmp_path / "told").write_bytes(np.hstack([-wrench, joints[0]]).tobytes())
    words = [str(tmp_path / "told"), "10", str(time.time())]
    with ExitStack() as peers:
        port, _ = peers.enter_context(peer("ros_moving", free_port(), *words, ",".join(NAMES)))
        source = [f"zenoh://127.0.0.1:{port}/ft/wrench?joints=/joint_states"]
        if box == "netft":
            port, _ = peers.enter_context(peer("netft_moving", *words))
            there = f"netft://127.0.0.1:{port}?counts=100000,100000&rate=500"
            source = [there, "--motion", *source]
        command = ["calibrate", *source, "--model", str(model), "--sensor-frame", "tool"]
        command += ["--until", "mass 2 %, com 2 mm", "--seconds", "28", "--out", str(tmp_path)]
        known = CliRunner().invoke(cli, command, standalone_mode=False)
    assert known.return_value == 0, known.output
    asked = parse_tolerance("mass 2 %, com 2 mm")
    phi = json.loads((tmp_path / "identification.json").read_text())["phi"]
    error = display_values_of_required_entries(
        asked, np.array(phi)
    ) - display_values_of_required_entries(asked, PHI)
    assert (np.abs(error) < tolerances_in_display_units(asked, PHI)).all()
