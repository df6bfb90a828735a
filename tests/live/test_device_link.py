"""Link to a haptic device: packets, silence, limits and passivity."""

from __future__ import annotations

import contextlib
import json
import re
import socket
import threading
import time
from importlib import resources

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import serve

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.progress import show_no_progress
from drake_teleop.common.vectors import quaternion_exponential, quaternion_product
from drake_teleop.live.device_client import DeviceClient, VirtualDevice, main, tapping_motion
from drake_teleop.live.device_guard import DeviceGuard, DeviceLimits
from drake_teleop.live.device_link import DeviceLink
from drake_teleop.live.device_packets import (
    CLUTCH_OPEN_FLAG,
    DeviceState,
    ForceCommand,
    pack_force,
    pack_state,
    unpack_force,
    unpack_state,
)
from drake_teleop.live.haply import HaplyDevice, make_force_message, parse_device_message
from drake_teleop.live.inputs import INPUT_RANGES, Inputs
from drake_teleop.live.live import Live
from drake_teleop.live.scenarios import with_task_space_device
from drake_teleop.live.session import Session, read_drive
from drake_teleop.station.result import SimulationResult

MS = 1e-3


class Sender:
    """Device that sends given packets."""

    def __init__(self, port):
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect(("127.0.0.1", port))
        self._socket.settimeout(1.0)

    def send(self, number, position=(0.0, 0.0, 0.0), **more):
        self._socket.send(pack_state(DeviceState(number, MS * number, position, **more)))

    def raw(self, packet):
        self._socket.send(packet)

    def force(self):
        return unpack_force(self._socket.recv(1000))


@pytest.fixture
def link():
    opened = DeviceLink("udp://127.0.0.1:0")
    yield opened
    opened.close()


def test_packets_match_the_c_header():
    text = resources.files("drake_teleop.live").joinpath("drake_teleop_device.h").read_text()
    sizes = [int(size) for size in re.findall(r"device: (\d+) bytes", text)]
    state = DeviceState(7, 1.5, (0.1, -0.2, 0.3), (0.0, 0.6, 0.8, 0.0), CLUTCH_OPEN_FLAG, 0.004)
    command = ForceCommand(7, 1.5, (1.0, 2.0, 3.0, 0.1, 0.2, 0.3))
    assert [len(pack_state(state)), len(pack_force(command))] == sizes
    assert unpack_state(pack_state(state)) == state
    assert unpack_force(pack_force(command)) == command
    assert pack_state(state)[24:32] == np.array([0.1], "<f8").tobytes()  # after 4 + 4 + 8 + 8


def test_invalid_packets_only_change_a_counter(link):
    random, good = np.random.default_rng(0), pack_state(DeviceState(1, 0.0, (0.01, 0.0, 0.0)))
    said = json.dumps(
        {"inverse3": [{"device_id": "a", "state": {"cursor_position": {"x": 1, "y": 2, "z": 3}}}]}
    )
    odd = [b"", b"DTD1", good[:-1], good + b"x", b"DTD2" + good[4:], b"DTF1" + good[4:]]
    for place in range(16, 88, 8):
        for value in (1e308, 1e30, np.nan, np.inf, -np.inf):
            odd.append(good[:place] + np.array([value], "<f8").tobytes() + good[place + 8 :])
            # `force_age_s` is only displayed: it is clipped to its range.
            assert unpack_state(odd[-1]) is None or (place == 80 and np.isfinite(value))
    far = DeviceState(1, 0.0, (0.0, 0.0, 0.0), (0.0, 1.8, 0.0, 0.0), 7, 1e9)
    near = far._replace(
        quaternion_wxyz=(0.0, 1.0, 0.0, 0.0), flags=CLUTCH_OPEN_FLAG, force_age_s=1.0
    )
    assert unpack_state(pack_state(far)) == near
    for places, values in zip(
        random.integers(0, 88, (500, 6)), random.integers(0, 256, (500, 6)), strict=True
    ):
        packet = bytearray(good)
        for place, value in zip(places, values, strict=True):
            packet[place] = value
        odd.append(bytes(packet))
    sender = Sender(link.port)
    for k, packet in enumerate(odd):
        sender.raw(packet)
        if k % 40 == 0:
            inputs = link.hand_inputs(1e-4 * k)
            assert all(np.isfinite(value) for value in inputs.values())
            assert np.isfinite(
                Inputs().with_changes(inputs).intended_pose(np.zeros(3))[0]
                if inputs["held"]
                else 0.0
            )
    assert link.refused > 40
    assert parse_device_message(said)[1].position == (-2.0, 1.0, 3.0)
    texts = ["", "[]", "{}", "null", "[" * 9000, '{"inverse3":[]}', said[:-1], "1e999", 7, None]
    texts += [said.replace(*pair) for pair in (("1,", "NaN,"), ("2", '"2"'), ("3}", "1e400}"))]
    for text in texts:
        assert parse_device_message(text) is None
    for places, values in zip(
        random.integers(0, len(said), (500, 3)), random.integers(32, 127, (500, 3)), strict=True
    ):
        letters = list(said)
        for place, value in zip(places, values, strict=True):
            letters[place] = chr(value)
        heard = parse_device_message("".join(letters))
        assert heard is None or np.isfinite(heard[1].position).all()


def test_force_and_position_of_haply_use_the_same_axes():
    said = json.loads(make_force_message("a", (1.0, 2.0, 3.0)))
    device = {"device_id": "a", "state": {"cursor_position": {"x": 2, "y": -1, "z": 3}}}
    assert said["inverse3"][0]["commands"]["set_cursor_force"]["values"] == {
        "x": 2.0, "y": -1.0, "z": 3.0,
    }  # fmt: skip
    assert parse_device_message(json.dumps({"inverse3": [device]}))[1].position == (
        1.0,
        2.0,
        3.0,
    )


@pytest.mark.parametrize("axis", np.eye(3).tolist())
@pytest.mark.parametrize("angle", [-1.2, 0.4])
def test_rotations_of_haply_are_in_the_axes_of_its_positions(axis, angle):
    cursor = {"device_id": "a", "state": {"cursor_position": dict(zip("xyz", axis, strict=True))}}
    turn = quaternion_exponential(tuple(angle * np.array(axis)))
    grip = {"state": {"orientation": dict(zip("wxyz", turn, strict=True))}}
    text = json.dumps({"inverse3": [cursor], "verse_grip": [grip]})
    _, state = parse_device_message(text)
    expected = quaternion_exponential(tuple(angle * np.array(state.position)))
    assert state.quaternion_wxyz == pytest.approx(expected)


@pytest.mark.parametrize(
    ("packet", "reason"),
    [
        (b"", "is 0 bytes long, not 88"),
        (pack_state(DeviceState(1, 0.0, (0.0, 0.0, 0.0)))[:-1], "is 87 bytes long, not 88"),
        (
            pack_state(DeviceState(1, 0.0, (0.0, 0.0, 0.0))) + b"more",
            "is more than 88 bytes long",
        ),
        (b"HELO" + bytes(84), "begins with b'HELO', not b'DTD1'"),
        (b"DTD2" + bytes(84), "has version b'2', not b'1'"),
        (
            pack_state(DeviceState(1, 0.0, (np.nan, 0.0, 0.0))),
            "has a position, orientation or time out",
        ),
        (
            pack_state(DeviceState(1, 0.0, (11.0, 0.0, 0.0))),
            "has a position, orientation or time out",
        ),
        (
            pack_state(DeviceState(1, 0.0, (0.0,) * 3, (0.0,) * 4)),
            "has a position, orientation or time out",
        ),
    ],
)
def test_refused_packet_is_counted_with_the_reason(link, packet, reason):
    sender = Sender(link.port)
    for _ in range(3):
        sender.raw(packet)
    link.receive_state(0.0)
    assert link.status_text().startswith("No device yet (udp://127.0.0.1:")
    assert f". Refused packets: 3; the last one {reason}" in link.status_text()


def test_first_device_is_followed_until_silent_and_late_packets_are_ignored(link):
    one, other = Sender(link.port), Sender(link.port)
    one.send(1, (0.1, 0.0, 0.0))
    assert link.hand_inputs(0.0) == {"held": 1, "clutch": 0} | dict.fromkeys(
        ("x", "y", "z", "rx", "ry", "rz"), 0.0
    )
    one.send(4, (0.11, 0.0, 0.0))
    one.send(3, (0.2, 0.0, 0.0))
    one.send(4, (0.2, 0.0, 0.0))
    other.send(9, (0.3, 0.0, 0.0))
    inputs = link.hand_inputs(0.049)
    assert inputs["x"] == pytest.approx(1000.0)
    assert (link.lost, link.refused) == (1, 1)
    assert ". Refused packets: 1; the last one is from a second device" in link.status_text()
    link.send_wrench(np.arange(6.0))
    assert one.force() == ForceCommand(4, 0.004, (0.0, 1.0, 2.0, 3.0, 4.0, 5.0))
    assert link.hand_inputs(0.0991) == {"held": 0, "clutch": 0}
    assert "silent" in link.status_text()
    other.send(1, (0.1, 0.02, 0.0))
    assert link.hand_inputs(0.2)["clutch"] == 0
    other.send(2, (0.1, 0.02, 0.0))
    inputs = link.hand_inputs(0.2401)
    assert inputs["y"] == pytest.approx(2000.0)
    other.send(3, (0.1, 0.02, 0.0))
    assert "clutch" not in link.hand_inputs(0.2801)
    other.send(4, (0.1, 0.02, 0.0), flags=CLUTCH_OPEN_FLAG)
    assert link.hand_inputs(0.29)["clutch"] == 0


def test_rotation_is_about_the_base_axes_and_the_new_origin_opens_the_clutch(link):
    sender, start = Sender(link.port), (0.5, 0.5, -0.5, 0.5)
    sender.send(100, quaternion_wxyz=start)
    link.hand_inputs(0.0)
    turned = quaternion_product(quaternion_exponential((0.3, -0.1, 0.2)), start)
    sender.send(101, (0.01, -0.02, 0.03), quaternion_wxyz=turned)
    inputs = link.hand_inputs(0.04)
    assert [inputs[name] for name in ("x", "y", "z")] == pytest.approx([1e3, -2e3, 3e3])
    assert [inputs[name] for name in ("rx", "ry", "rz")] == pytest.approx([3e3, -1e3, 2e3])
    sender.send(102, (0.01, -0.02, 0.03), quaternion_wxyz=turned)
    assert "clutch" not in link.hand_inputs(0.08)
    link.reset_pose_origin(0.09)
    sender.send(103, (0.01, -0.02, 0.03), quaternion_wxyz=turned)
    inputs = link.hand_inputs(0.1)
    assert inputs.pop("clutch") == 0 and inputs.pop("held") == 1
    assert list(inputs.values()) == pytest.approx([0.0] * 6, abs=1e-9)
    sender.send(5000)  # after silence, on another clock
    link.hand_inputs(0.3)
    assert link.link_statistics()["late_p99_ms"] == 0.0


def test_force_stays_within_limits_and_is_zero_after_50_ms_without_commands():
    guard, last = DeviceGuard(DeviceLimits(5.0, 0.1, slew=1000.0, torque_slew=10.0)), np.zeros(6)
    for k in range(300):
        wrench = (np.nan,) * 6 if k % 50 == 7 else (40.0, -30.0, 0.0, 1.0, 0.0, 0.0)
        age = MS * max(k - 150, 0) if k < 250 else 0.0
        now = np.array(guard.limit_wrench((0.0, 0.0, 0.0), wrench, age, MS))
        if k == 120:  # a tick was late, and the next one comes at once
            moves = guard.limit_wrench((0.0, 0.0, -0.02), wrench, age, 0.1)
            moves = guard.limit_wrench((0.0, 0.0, 0.02), wrench, age, 1e-5)
            assert np.linalg.norm(moves[:3]) <= 5.0 + 1e-12
            assert (
                np.linalg.norm(guard.limit_wrench((0.0, 0.0, 0.0), wrench, age, MS)[:3])
                <= 5.0 + 1e-12
            )
        assert np.linalg.norm(now[:3]) <= 5.0 + 1e-12
        assert np.linalg.norm(now[3:]) <= 0.1 + 1e-12
        if k == 149:
            assert np.linalg.norm(now[:3]) == pytest.approx(5.0)
        if age < 0.05:
            assert np.linalg.norm((now - last)[:3]) <= 1.0 + 1e-9
            assert np.linalg.norm((now - last)[3:]) <= 0.01 + 1e-9
        else:
            assert not now.any()
        if 0 <= k - 250 < 50:  # it comes back by 100 N/s
            assert np.linalg.norm(now[:3]) <= 0.1 * (k - 249) + 1e-9
        last = now


@pytest.mark.parametrize(
    ("axis", "force", "pressed"), [(0, 4.0, 0.2), (2, -9.0, 0.1), (1, 6.0, 0.02)]
)
def test_at_most_300_mJ_of_stored_energy_return(axis, force, pressed):
    guard, position, wrench = DeviceGuard(DeviceLimits(10.0, slew=1e9)), np.zeros(3), np.zeros(6)
    wrench[axis] = force
    for _ in range(200):
        guard.limit_wrench(position, wrench, 0.0, MS)
    energies = []
    for speed in (-1.0, 1.0):
        for _ in range(round(1.2e4 * pressed)):
            position[axis] += speed * np.sign(force) * 1e-4
            guard.limit_wrench(position, wrench, 0.0, MS)
        energies.append(guard.energy)
    stored = abs(force) * 1.2 * pressed
    assert energies[0] == pytest.approx(stored, rel=1e-2)
    assert energies[0] - energies[1] == pytest.approx(min(stored, 0.3), abs=1e-3)


def tap_on_wall(stiffness, grip, delay, *, observe):
    """Return the least energy of the port and the final speed after one tap on a wall."""
    virtual = VirtualDevice(tapping_motion(0.02, hertz=1.0), grip)
    guard, heights = DeviceGuard(DeviceLimits(37.5), observe=observe), [virtual.position[2]] * delay
    energy, speed = [], []
    for k in range(950):
        heights.append(virtual.position[2])
        push = max(-stiffness * heights[-1 - delay], 0.0)
        force = guard.limit_wrench(virtual.position, (0.0, 0.0, push, 0.0, 0.0, 0.0), 0.0, MS)
        virtual.simulate_motion(force[:3], MS)
        energy.append(virtual.energy)
        if 600 < k < 750:
            speed.append(abs(virtual.velocity[2]))
    assert guard.energy == pytest.approx(energy[-1], abs=1e-4 if observe else 1.0)
    return min(energy), max(speed)


def test_leaf_is_passive_with_a_delay_of_five_samples():
    assert tap_on_wall(291.0, "light", 5, observe=True)[0] >= -1e-6
    assert tap_on_wall(291.0, "light", 5, observe=False)[0] < -1e-3


def test_a_stiff_wall_comes_to_rest():
    assert tap_on_wall(6000.0, "medium", 3, observe=True)[1] < 0.05
    assert tap_on_wall(6000.0, "medium", 3, observe=False)[1] > 0.3


class RestingDevice:
    """Device at rest that records the displayed wrenches."""

    limits = DeviceLimits(10.0)

    def __init__(self):
        self.was_set = []

    def read(self):
        return DeviceState(0, 0.0, (0.0, 0.0, 0.0))

    def set_wrench(self, wrench):
        self.was_set.append(wrench)

    def close(self):
        self.set_wrench((0.0,) * 6)


@pytest.mark.parametrize(("force", "moved"), [(4.0, -0.05), (-6.0, 0.02)])
def test_motion_during_ticks_without_pose_stores_no_energy(link, force, moved):
    device, poses = RestingDevice(), [0.0] * 100 + [None] * 3 + [moved] * 20
    device.read = lambda: None if poses[0] is None else DeviceState(0, 0.0, (0.0, 0.0, poses[0]))
    client = DeviceClient(device, f"udp://127.0.0.1:{link.port}")
    for k in range(len(poses)):
        client.exchange_packets(lambda now=MS * k: now)
        link.hand_inputs(MS * k)
        link.send_wrench(np.array([0.0, 0.0, force, 0.0, 0.0, 0.0]))
        poses.pop(0)
    displayed = [wrench[2] for wrench in device.was_set]
    assert displayed[99] == pytest.approx(force) and displayed[100:103] == [0.0] * 3
    assert client.guard.energy == 0.0
    client.close()


def test_client_displays_the_stations_force_and_none_after_silence(link):
    device = RestingDevice()
    client = DeviceClient(device, f"udp://127.0.0.1:{link.port}")
    for k in range(200):
        now = MS * k
        client.exchange_packets(lambda now=now: now)
        if k < 100:
            link.hand_inputs(now)
            link.send_wrench(np.array([0.0, 0.0, 4.0, 0.0, 0.0, 0.0]))
        if k == 120:  # of an earlier client
            late = pack_force(ForceCommand(10**6, now, (0.0, 9.0, 9.0, 0.0, 0.0, 0.0)))
            link._socket.sendto(late, link._peer)
    force = [wrench[2] for wrench in device.was_set]
    assert force[99] == pytest.approx(4.0)
    assert max(np.abs(force[151:])) == 0.0
    assert 1 / 1.1 < 1000 * client.force_ages_s[50] < 1.1
    client.close()


def test_inverse3_answers_every_message_of_its_service():
    heard = []

    def service(connection):
        cursor = {"device_id": "b7", "state": {"cursor_position": {"x": 0.1, "y": 0.2, "z": 0.3}}}
        grip = {"state": {"orientation": {"w": 0, "x": 1, "y": 0, "z": 0}, "buttons": {"a": True}}}
        for message in ("oh", {"inverse3": [cursor]}, {"inverse3": [cursor], "verse_grip": [grip]}):
            connection.send(json.dumps(message))
            heard.append(json.loads(connection.recv()))

    with serve(service, "127.0.0.1", 0) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        device = HaplyDevice(f"haply://127.0.0.1:{server.socket.getsockname()[1]}")
        places = []
        for k in range(3):
            places.append(device.read())
            device.set_wrench((float(k), 0.0, 0.0, 0.0, 0.0, 0.0))
        with pytest.raises(DrakeTeleopError, match="has closed the connection"):
            device.read()
        device.close()
        server.shutdown()
    assert places == [
        None,
        DeviceState(0, 0.0, (-0.2, 0.1, 0.3)),
        DeviceState(0, 0.0, (-0.2, 0.1, 0.3), (0.0, 0.0, 1.0, 0.0), CLUTCH_OPEN_FLAG),
    ]
    values = [said["inverse3"][0]["commands"]["set_cursor_force"]["values"] for said in heard[1:]]
    assert values == [{"x": 0.0, "y": -1.0, "z": 0.0}, {"x": 0.0, "y": -2.0, "z": 0.0}]
    assert heard[0] == {}


@pytest.mark.slow
def test_end_of_a_drive_sets_the_force_of_an_inverse3_to_zero():
    heard, ended = [], threading.Event()

    def service(connection):
        threading.Thread(target=send_poses, args=(connection,), daemon=True).start()
        with contextlib.suppress(ConnectionClosed):
            heard.extend(map(json.loads, connection))
        ended.set()

    def send_poses(connection):
        cursor = {"device_id": "b7", "state": {"cursor_position": {"x": 0, "y": 0, "z": 0}}}
        with contextlib.suppress(ConnectionClosed):
            while not ended.wait(1e-3):
                connection.send(json.dumps({"inverse3": [cursor]}))

    with serve(service, "127.0.0.1", 0) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        link = DeviceLink(f"haply://127.0.0.1:{server.socket.getsockname()[1]}")
        end = time.monotonic() + 30.0
        while time.monotonic() < end and not (heard and force_of(heard[-1])["z"] > 1.0):
            link.receive_state(time.perf_counter())
            link.send_wrench(np.array([0.0, 0.0, 3.0, 0.0, 0.0, 0.0]))
            time.sleep(1e-3)
        link.close()
        assert ended.wait(10.0)
        server.shutdown()
    assert not any(force_of(heard[-1]).values())


def force_of(message) -> dict[str, float]:
    forces = (each["commands"]["set_cursor_force"]["values"] for each in message["inverse3"])
    return next(forces) if message else {"x": 0.0, "y": 0.0, "z": 0.0}


@pytest.mark.parametrize("name", ["figures.json", "new/figures.json", "a file/figures.json"])
def test_figures_of_a_client_are_written_or_refused_at_once(tmp_path, name):
    (tmp_path / "a file").touch()
    words = ["virtual", "udp://127.0.0.1:9", "--seconds", "0.01", "--json", str(tmp_path / name)]
    if "file/" in name:
        with pytest.raises(DrakeTeleopError, match="cannot be created as a folder"):
            main(words)
        return
    main(words)
    assert json.loads((tmp_path / name).read_text())["energy_j"] == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize("address", ["udp://192.0.2.1:9", "tcp://127.0.0.1:9", "udp://127.0.0.1"])
def test_device_address_of_another_machine_or_kind_is_an_error(address):
    with pytest.raises(DrakeTeleopError, match=re.escape(address)):
        DeviceLink(address)


@pytest.mark.slow
def test_device_drives_without_a_page_and_releases_after_silence(scenario, load, link):
    live = Live(with_task_space_device(scenario), load, None, lambda rows: {}, 0.0, link)
    sender, seen = Sender(link.port), []
    for k in range(95):
        if k < 60:
            sender.send(k + 1, (0.0, 0.0, -1e-4 * k))
        live.tick(lambda now=2 * MS * k: now)
        seen.append(live._session.inputs)
    assert seen[10].clutch == 0  # the hand first moves to the device's pose
    assert (seen[50].held, seen[50].clutch, seen[50].z) == (1, 1, -10 * 50)
    assert (seen[-1].held, seen[-1].clutch) == (0, 0)
    assert "silent" in live.frame()["device"]
    for _ in range(60):
        assert np.isfinite(sender.force().wrench).all()


@pytest.mark.slow
@pytest.mark.parametrize("opened", [None, 60])
def test_device_still_drives_after_a_page_is_closed(scenario, load, link, opened):
    """The page may also have opened the clutch."""
    live = Live(with_task_space_device(scenario), load, None, lambda rows: {}, 0.0, link)
    sender, seen = Sender(link.port), []
    for k in range(140):
        sender.send(k + 1, (0.0, 0.0, -1e-4 * k))
        now = 2 * MS * k
        if k == 50:
            live.join(1, now)
        if k == opened:
            live.handle_message(1, json.dumps({"set": {"clutch": 0}}), now)
        if k == 80:
            live.leave(1, now)
        live.tick(lambda now=now: now)
        seen.append(live._session.inputs)
    assert [each.clutch for each in seen[50:80:29]] == [1, int(opened is None)]
    assert all((each.held, each.clutch) == (1, 1) for each in seen[80:])
    assert seen[-1].z == -10 * 139


@pytest.mark.slow
def test_drive_by_a_device_repeats_to_the_same_bytes(scenario, load, tmp_path):
    setup = with_task_space_device(scenario)
    session = Session(setup, load, log=tmp_path / "log.parquet", record=tmp_path, device=True)
    rendered = []
    for k in range(128):
        down = {"z": -20 * k, "rx": k, "held": k < 100, "clutch": k < 100}
        session.apply_inputs(session.inputs.with_changes(down))
        session.advance(2)
        rendered.append(np.linalg.norm(session.device_wrench()[:3]))
    session.close()
    log = SimulationResult.read_parquet(tmp_path / "log.parquet")
    drive = read_drive(tmp_path)
    again = drive.repeat(show_no_progress(""))
    assert all(np.array_equal(log[name], again[name], equal_nan=True) for name in ("t", *log))
    assert max(rendered) > 0.3
    assert max(rendered[80:101]) > 0.3
    assert rendered[127] == 0.0  # 54 ms after the release
    steps = np.diff(log["pose_command"][:, 6])
    assert np.abs(steps).max() < 1.2e-4 * setup.kinematic_scaling.translation_scale
    assert set(INPUT_RANGES) == set(vars(drive.changes[0][1]))
