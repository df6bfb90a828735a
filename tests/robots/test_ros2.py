"""`ros2://` and the command `ros2` against real nodes of ROS 2 in other processes."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from peer import HASH
from test_compensator import DT, PHI, load, readings
from test_peers import LoopOutputs

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.robots.address import Address
from drake_teleop.robots.compensator import Compensator
from drake_teleop.robots.connections import open_sink
from drake_teleop.robots.lines import flag_names
from drake_teleop.robots.ros2 import (
    SOURCE_ADDRESS_PARAMETERS,
    MessageConverter,
    checked_topic_name,
    domain_of_address,
    topics_frames_and_streams,
)
from drake_teleop.robots.streams import NONZERO_WRENCH_FLAGS, POSE, CompensatedWrench, ReadingFlag

PEER = Path(__file__).with_name("ros2_peer.py")
DOMAIN = str(os.getpid() % 100 + 1)
ros = pytest.mark.skipif(find_spec("rclpy") is None, reason="rclpy (extra `ros2`) is not installed")


@contextmanager
def process(*words: str, **options: Any) -> Iterator[subprocess.Popen[str]]:
    with subprocess.Popen(
        [sys.executable, *words], stdout=subprocess.PIPE, text=True, **options
    ) as started:
        try:
            yield started
        finally:
            started.kill()


class Echo(list[dict[str, Any]]):
    """Lines of a peer's node in the order of arrival."""

    def __init__(self, started: subprocess.Popen[str]) -> None:
        self._thread = threading.Thread(target=self._read, args=(started,), daemon=True)
        self._thread.start()

    def _read(self, started: subprocess.Popen[str]) -> None:
        assert started.stdout is not None
        for line in started.stdout:
            self.append(json.loads(line))

    def wait(self, condition: Any, act: Any = lambda: None, seconds: float = 60.0) -> None:
        deadline = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < deadline
            act()
            time.sleep(0.005)


@ros
@pytest.mark.slow
def test_node_receives_wrench_and_every_flag_and_the_hash() -> None:
    wrench = np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    with process(str(PEER), "echo", DOMAIN, "/tool/contact") as peer:
        sink = open_sink(f"ros2://tool/contact?frame=tool0&domain={DOMAIN}")
        seen = Echo(peer)

        def write(flags: int) -> None:
            zero = flags & ~NONZERO_WRENCH_FLAGS
            sink.write(CompensatedWrench(7, 0.5, wrench * (not zero), -wrench, flags))

        seen.wait(lambda: any("wrench" in row for row in seen), lambda: write(0))
        seen.wait(lambda: any(row.get("message") == "ok" for row in seen), lambda: write(0), 30)
        for flag in (*ReadingFlag, ReadingFlag.WRONG_RATE | ReadingFlag.CLIPPED):
            words = ", ".join(flag_names(flag))
            write(int(flag))
            seen.wait(lambda words=words: any(row.get("message") == words for row in seen))
        sink.close()
    assert seen[0] == {"hash": f"RIHS01_{HASH}", "type": "geometry_msgs/msg/WrenchStamped"}
    first = next(row for row in seen if "wrench" in row)
    assert first["wrench"] == wrench.tolist() and first["frame"] == "tool0"
    assert abs(first["t"] - time.time()) < 600.0
    levels = {row["message"]: row["level"] for row in seen if "message" in row}
    for flag in ReadingFlag:
        expected = 1 if flag & NONZERO_WRENCH_FLAGS else 3 if flag == ReadingFlag.STALE else 2
        assert levels[flag_names(flag)[0]] == expected
    assert levels["ok"] == 0
    last = [row for row in seen if "message" in row][-1]
    assert last["name"] == "drake_teleop: /tool/contact"
    assert last["values"]["number"] == "7" and last["values"]["wrong rate"] == "2"


@ros
@pytest.mark.slow
def test_faults_of_a_node_are_named_and_zero() -> None:
    from drake_teleop.robots.ros2 import Ros2Source

    with process(str(PEER), "faults", DOMAIN) as peer:
        assert peer.stdout is not None and peer.stdout.readline() == "ready\n"
        source = Ros2Source(f"ros2://ft/wrench?domain={DOMAIN}&sign=1", 0.002)
        seen = LoopOutputs(source, 20, ReadingFlag.RESTART, 60.0)
        source.close()
    flags = (
        ReadingFlag.REORDERED
        | ReadingFlag.NOT_FINITE
        | ReadingFlag.DAMAGED
        | ReadingFlag.OUT_OF_RANGE
        | ReadingFlag.STALE
    )
    named = ReadingFlag(0)
    for row in seen:
        named |= ReadingFlag(row.flags)
        assert not row.flags or not row.contact.any()
    assert (
        named & (flags | ReadingFlag.CLOCK_JUMP | ReadingFlag.RESTART)
        == flags | ReadingFlag.CLOCK_JUMP | ReadingFlag.RESTART
    )


def test_static_and_moving_transforms_form_a_chain() -> None:
    """Messages of `/tf_static` yield no pose; those of `/tf` do."""

    def transforms(child: str, parent: str, x: float, sec: int) -> Any:
        stamp = SimpleNamespace(sec=sec, nanosec=0)
        return SimpleNamespace(
            transforms=[
                SimpleNamespace(
                    header=SimpleNamespace(stamp=stamp, frame_id=parent),
                    child_frame_id=child,
                    transform=SimpleNamespace(
                        translation=SimpleNamespace(x=x, y=0.0, z=0.0),
                        rotation=SimpleNamespace(w=1.0, x=0.0, y=0.0, z=0.0),
                    ),
                )
            ]
        )

    converter = MessageConverter(1.0, ("base", "sensor"))
    assert converter.readings_of_message("tf", transforms("flange", "base", 0.5, 3), 1) == []
    converter.add_transforms(transforms("sensor", "flange", 0.1, 0))
    (part,) = converter.readings_of_message("tf", transforms("flange", "base", 0.7, 4), 2)
    assert (part.stream, part.number, part.t) == (POSE, 2, 4.0)
    np.testing.assert_allclose(part.values, [1, 0, 0, 0, 0.8, 0, 0])


@ros
def test_wrong_addresses_are_one_error_line() -> None:
    from drake_teleop.robots.connections import open_source

    for address, words in (
        ("ros2://", "'' is not the name of a ROS topic"),
        ("ros2://ft wrench", "is not the name of a ROS topic"),
        ("ros2://ft/wrench?colour=1", "unknown parameter 'colour'"),
        (
            "ros2://ft/wrench?domain=300",
            "domain='300' is not a ROS domain; give a whole number from 0 to 232",
        ),
        ("ros2://ft/wrench?tf=base", "tf='base' does not name two frames; give tf=PARENT,CHILD"),
        ("ros2://ft/wrench?joints=/joint_states", "need the model of the arm"),
    ):
        with pytest.raises(DrakeTeleopError, match=words):
            open_source(address, load(), rate_hz=500.0)
    if find_spec("tf2_msgs") is None:
        with pytest.raises(DrakeTeleopError, match="needs the ROS package tf2_msgs"):
            open_source("ros2://ft/wrench?tf=base,tool", load(), rate_hz=500.0)


@pytest.mark.parametrize("query", ["pose=a&tf=b,c", "imu=a&joints=b", "pose=a&imu=b&tf=c,d"])
def test_only_one_motion_is_accepted(query: str) -> None:
    """Poses of two frames in one stream would be a motion that nothing has."""
    address = Address(f"zenoh://h/ft?{query}", None, SOURCE_ADDRESS_PARAMETERS)
    with pytest.raises(DrakeTeleopError, match=r"more than one motion.*give only one of them"):
        topics_frames_and_streams(address, ("joint_1",))
    for part in query.split("&"):
        one = Address(f"zenoh://h/ft?{part}", None, SOURCE_ADDRESS_PARAMETERS)
        assert len(topics_frames_and_streams(one, ("joint_1",))[2]) == 2


@pytest.mark.parametrize(
    ("query", "environment", "domain"),
    [("", None, 0), ("", "", 0), ("", "7", 7), ("?domain=3", "7", 3), ("?domain=0", "7", 0)],
)
def test_domain_is_that_of_the_address_or_the_environment(
    monkeypatch: pytest.MonkeyPatch, query: str, environment: str | None, domain: int
) -> None:
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    if environment is not None:
        monkeypatch.setenv("ROS_DOMAIN_ID", environment)
    assert (
        domain_of_address(Address(f"zenoh://h/ft{query}", None, SOURCE_ADDRESS_PARAMETERS))
        == domain
    )


@pytest.mark.parametrize("name", ["a//b", "a/1b", "1a", "a-b", "", "/", "ä"])
def test_name_that_no_topic_can_have_is_refused(name: str) -> None:
    address = Address("zenoh://h/ft", None, SOURCE_ADDRESS_PARAMETERS)
    with pytest.raises(DrakeTeleopError, match="is not the name of a ROS topic"):
        checked_topic_name(address, name)
    assert checked_topic_name(address, "/a1/_b/c_2/") == "a1/_b/c_2"


def test_missing_rclpy_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(DrakeTeleopError, match=r"rclpy, which is not installed.*\[ros2\]"):
        open_sink("ros2://contact")


@ros
@pytest.mark.parametrize("name", ["sigma_weight", "sigma_inertia"])
@pytest.mark.parametrize("removed", [False, True])
def test_scales_that_the_readings_do_not_support_are_refused(
    tmp_path: Path, name: str, removed: bool
) -> None:
    """Gravity is unknown, or the weight is removed; the node continues with its load."""
    from rclpy.parameter import Parameter

    from drake_teleop.robots.ros2 import shared_node
    from drake_teleop.robots.ros2_node import ServedCompensator

    files = [tmp_path / "load.json", tmp_path / "weightless.json"]
    load().save(files[0])
    replace(load(), weight_removed=True).save(files[1])
    scales = {"sigma": 0.5, "gamma": 1.0, "sigma_weight": -1.0, "sigma_inertia": -1.0}
    node = shared_node(int(DOMAIN))
    served = ServedCompensator(
        node.node, lambda one: Compensator(one, DT), files[removed], lambda *_: [], tmp_path, scales
    )
    served.step(readings(1)[0], 0.0)
    try:
        (refused,) = node.node.set_parameters([Parameter(name, value=0.25)])
        why = "the robot has removed the weight" if removed else "gravity in the sensor frame"
        assert not refused.successful and why in refused.reason
        (accepted,) = node.node.set_parameters([Parameter("sigma", value=0.25)])
        assert accepted.successful and served._scales.tolist() == [0.25, 0.25, 1.0, 0.0]
        if removed:
            return
        served.step(readings(2)[1]._replace(gravity=np.zeros(3)), DT)
        names = (name, 0.75), ("load", str(files[1]))
        done = node.node.set_parameters([Parameter(key, value=value) for key, value in names])
        assert all(each.successful for each in done)
        before = served._current
        reload = served._make_service_callback(served._reload_compensator)
        response = reload(None, SimpleNamespace())
        assert not response.success and "the robot has removed the weight" in response.message
        assert served._current is before
    finally:
        served.close()
        node.close()


@ros
@pytest.mark.parametrize("earlier", [None, {"advice": "swing", "doubts": []}])
@pytest.mark.parametrize("error", ["RuntimeError", "MemoryError"])
def test_crashed_calibration_is_refused_and_the_node_continues(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, earlier: dict[str, Any] | None, error: str
) -> None:
    from drake_teleop.robots import ros2_node
    from drake_teleop.robots.ros2 import shared_node

    monkeypatch.setattr(ros2_node, "_CALIBRATE_PYTHON_CODE", f"raise {error}('broken')")
    if earlier is not None:
        (tmp_path / "summary.json").write_text(json.dumps(earlier))
    load().save(tmp_path / "load.json")
    scales = {"sigma": 0.5, "gamma": 1.0, "sigma_weight": -1.0, "sigma_inertia": -1.0}
    node = shared_node(int(DOMAIN))
    served = ros2_node.ServedCompensator(
        node.node, lambda one: Compensator(one, DT), tmp_path / "load.json",
        lambda *_: [], tmp_path, scales,
    )  # fmt: skip
    answer = served._answer_calibration_request(None, SimpleNamespace())
    task, deadline = node.node.executor.create_task(answer), time.monotonic() + 60.0
    try:
        while not task.done() and time.monotonic() < deadline:
            node.spin(0.05)
        assert task.result().message == f"refused: {error}: broken"
    finally:
        served.close()
        node.close()


NODE = "import sys; from drake_teleop.cli.main import main; main(sys.argv[1:])"


@ros
@pytest.mark.slow
@pytest.mark.parametrize(
    ("stop", "during_calibration"), [(signal.SIGINT, False), (signal.SIGTERM, True)]
)
def test_services_and_parameters_of_the_node(
    tmp_path: Path, stop: signal.Signals, during_calibration: bool
) -> None:
    """Tare, scales, another load, a refused value, a calibration that is too short, and the end."""
    file, other = tmp_path / "load.json", tmp_path / "other.json"
    load().save(file)
    load().save(other)
    rest = non_contact_wrench(*np.split(np.array([0.0, 0.0, 9.81, *np.zeros(6)]), 3), PHI)
    np.save(tmp_path / "rows.npy", [[*(rest + 0.5), 1.0, *np.zeros(6)]])
    source = f"ros2://ft/wrench?pose=/ft/pose&domain={DOMAIN}&sign=1"
    words = ["ros2", source, f"ros2://contact?domain={DOMAIN}&wrench=scaled", "--load", str(file)]
    words += ["--rate", "200", "--sigma", "0", "--out", str(tmp_path / "out")]
    with (
        process(str(PEER), "moving", DOMAIN, str(tmp_path / "rows.npy"), "200"),
        process("-c", NODE, *words, stderr=subprocess.PIPE) as node,
        process(str(PEER), "echo", DOMAIN, "/contact") as peer,
        process(str(PEER), "calls", DOMAIN, stdin=subprocess.PIPE) as calls,
    ):
        seen = Echo(peer)

        def call(line: str) -> list[Any]:
            assert calls.stdin is not None and calls.stdout is not None
            calls.stdin.write(line + "\n")
            calls.stdin.flush()
            answer = json.loads(calls.stdout.readline())
            seen.clear()
            seen.wait(lambda: sum("wrench" in row and any(row["wrench"]) for row in seen) > 2)
            return answer

        def wrench() -> Any:
            return np.array([row["wrench"] for row in seen if any(row.get("wrench", []))][-1])

        seen.wait(lambda: any("wrench" in row and any(row["wrench"]) for row in seen), seconds=120)
        before = wrench()
        assert call("set gamma 2.0") == [True, ""]
        time.sleep(0.5)
        np.testing.assert_allclose(wrench(), 2.0 * before, atol=1e-6)
        assert call("set sigma -1.0") == [False, "sigma: -1.0 is outside 0 to inf"]
        assert call("set sigma 1.0")[0]
        time.sleep(0.5)
        np.testing.assert_allclose(wrench(), 2.0 * before + rest, atol=1e-6)
        assert call("set load /nowhere.json")[0]
        done, said = call("load")
        assert not done and said.startswith("refused: /nowhere.json")
        assert call(f"set load {other}")[0]
        assert call("load") == [True, f"done: {load().mass:.4g} kg"]
        assert call("set sigma 0.0")[0]
        done, said = call("tare")
        assert done == said.startswith("done: offsets moved by"), said
        assert call("set seconds 2.0")[0]
        done, said = call("calibrate")
        assert not done and "the wrench is the same in all samples" in said
        if during_calibration:
            assert call("set seconds 60.0")[0]
            assert calls.stdin is not None
            calls.stdin.write("calibrate\n")
            calls.stdin.flush()
            time.sleep(2.0)
        node.send_signal(stop)
        assert node.wait(5) == 0
        assert node.stderr is not None and "damaged" not in node.stderr.read()
