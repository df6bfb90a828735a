"""Stations for custom arms that `drake-teleop new` writes."""

from __future__ import annotations

import dataclasses
import random
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RotationMatrix
from pydrake.multibody.parsing import (
    LoadModelDirectivesFromString,
    Parser,
    ProcessModelDirectives,
)
from pydrake.multibody.plant import MultibodyPlant
from shown import type_in

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.files import models_dir
from drake_teleop.lab import new_station
from drake_teleop.lab.analysis.linearization import linearize
from drake_teleop.lab.identification import true_load
from drake_teleop.lab.new_station import new_command, place, plan_station
from drake_teleop.lab.new_station.place import StartPlace, find_start_place
from drake_teleop.station.scenario import LoadScenario
from drake_teleop.station.slave.arm import holding_torque, pose_into
from drake_teleop.station.slave.home import R_WS_HOME
from drake_teleop.station.slave.inverse_kinematics import IkStatus
from drake_teleop.station.slave.joint_control import mass_matrix
from drake_teleop.station.slave.numeric_inverse_kinematics import find_posture
from drake_teleop.station.slave.plant import NominalSlave
from drake_teleop.station.slave.slave_config import Slave, Tool

ARM = models_dir() / "rx90.sdf"


@pytest.fixture
def runs(monkeypatch):
    """Record run commands instead of executing them."""
    calls = []

    def run(scenario, out, **options):
        calls.append((scenario, out, options))
        return {}

    monkeypatch.setattr(new_station, "run_command", run)
    return calls


@pytest.mark.slow
def test_station_is_written_and_run(tmp_path, runs, capsys):
    new_command(tmp_path / "mine", ARM, "sensor", device="omega_6", sensor="ati_gamma_imu")
    path = tmp_path / "mine" / "station.yaml"
    assert runs == [(path, tmp_path / "mine" / "first_run", {"quiet": False})]
    scenario = LoadScenario(path)
    assert scenario.slave.path.resolve() == ARM.resolve()
    assert (scenario.master.model, scenario.wrist_sensor.preset) == ("omega_6", "ati_gamma_imu")
    said = capsys.readouterr().out
    assert "6: joint_1" in said
    picture = tmp_path / "mine" / "start.png"
    assert picture.read_bytes().startswith(b"\x89PNG") and picture.name in said
    plan = plan_station(ARM, "sensor", device="omega_6")
    scale = scenario.kinematic_scaling.translation_scale
    # The scaled device workspace is reachable, and the hand stays inside the device workspace.
    assert 0.055 * scale <= plan.place.cube_half_m
    way = 1.5 * plan.swing_amplitude_m + 0.01
    assert way / scale <= 0.113 / 2
    # The distance from the tool's lowest point to the wall, which the tool enters by at most 1 cm.
    tip = NominalSlave(scenario.slave).p_WTip_start
    wall = scenario.environment[0].position[2]
    assert wall == pytest.approx(tip[2] - 1.5 * plan.swing_amplitude_m, abs=1e-3)
    into = -scenario.operator.intent[1].translation[2] * scale - (tip[2] - wall)
    assert 0.0 < into <= 0.0101
    with pytest.raises(DrakeTeleopError, match="already exists"):
        new_command(tmp_path / "mine", ARM, "sensor")


def test_beginners_page_matches_the_written_station(tmp_path, runs, monkeypatch):
    (tmp_path / "models").symlink_to(ARM.parent)
    monkeypatch.chdir(tmp_path)
    type_in("docs/start.md", ".venv/bin/drake-teleop new")
    assert LoadScenario("out/own/station.yaml").master.model == "omega_6"
    assert runs == [(Path("out/own/station.yaml"), Path("out/own/first_run"), {"quiet": False})]


@pytest.mark.slow
def test_place_is_in_front_with_a_reachable_cube():
    arm = NominalSlave(LoadScenario("free_motion_force").slave).arm
    found = find_start_place(arm)
    assert found.position[0] > abs(found.position[1]) and found.position[2] > 0.1
    w = R_WS_HOME.ToQuaternion().wxyz()
    for signs in product((-1.0, 1.0), repeat=3):
        pose = np.array([*w, *(found.position + found.cube_half_m * np.array(signs))])
        assert find_posture(arm, pose, found.q)[1] == IkStatus.OK
    stiff = dataclasses.replace(arm, lower=arm.lower * 0.0 - 0.01, upper=arm.upper * 0.0 + 0.01)
    stiff.upper[2] = -0.005
    said = r"no posture found in which z_S points down.* \(joint_3: -0.01 to -0.005 rad or m\)"
    with pytest.raises(DrakeTeleopError, match=said):
        find_start_place(stiff)


@pytest.mark.slow
@pytest.mark.parametrize("device", ["phantom_premium_15", "falcon"])  # high and low rates
def test_rates_match_the_device(tmp_path, runs, device):
    """`analyze` requires that sampling instants coincide."""
    new_command(tmp_path / "mine", ARM, "sensor", device=device)
    scenario = LoadScenario(tmp_path / "mine" / "station.yaml")
    assert scenario.master.sampling_period_if_slower_than_hand(scenario.rates.hand_hz) is None
    assert scenario.rates.hand_hz == scenario.rates.joint_control_hz
    linearize(scenario.without_environment(), load_estimate=true_load(scenario))


def test_joint_margin_counts_more_than_cube_size():
    best = StartPlace(np.zeros(7), True, np.zeros(6), cube_half_m=0.15, joint_margin=0.2)
    worse = [
        best._replace(cube_half_m=0.3, joint_margin=0.01),
        best._replace(cube_half_m=0.3, is_set_by_position=False),
        best._replace(cube_half_m=0.03, joint_margin=0.9),
        best._replace(cube_half_m=0.0, joint_margin=0.0),
    ]
    assert max([*worse, best], key=place._start_place_sort_key) is best


@pytest.mark.parametrize("axis", place.R_SA_BY_AXIS)
@pytest.mark.parametrize("com", [[0.2, 0.0, 0.0], [-0.05, 0.1, 0.15]])
def test_frame_along_any_axis_carries_the_same_load(axis, com):
    """The motors hold the same torques, whichever frame describes the load."""
    tool = Tool(mass=5.0, com=com, inertia=[0.02, 1e-3, -2e-3, 0.03, 1.5e-3, 0.025])
    arm, q = NominalSlave(Slave(tool=tool)).arm, np.array([0.3, -0.4, -1.2, 0.2, -0.9, 0.4])
    pointed = place._arm_with_frame_A(arm, axis)
    np.testing.assert_allclose(holding_torque(pointed, q), holding_torque(arm, q), atol=1e-9)
    np.testing.assert_allclose(mass_matrix(pointed, q), mass_matrix(arm, q), atol=1e-9)
    R_WA, R_WS = (RotationMatrix(Quaternion(each.pose(q)[:4])) for each in (pointed, arm))
    expected = R_WS @ place.R_SA_BY_AXIS[axis]
    np.testing.assert_allclose(R_WA.matrix(), expected.matrix(), atol=1e-9)
    np.testing.assert_allclose(pointed.pose(q)[4:], arm.pose(q)[4:], atol=1e-12)


def turned(rpy, tmp_path):
    """Write the RX90 with a rotated frame on its sensor."""
    text = ARM.read_text()
    frame = f'<frame name="ft" attached_to="sensor"><pose>0 0 0 {rpy}</pose></frame>'
    path = tmp_path / "turned.sdf"
    path.write_text(text.replace("</model>", f"{frame}</model>", 1))
    return path


@pytest.mark.quick_cases(1)
@pytest.mark.slow
@pytest.mark.parametrize(
    ("rpy", "axis", "back"),
    [("0 -1.5708 0", "x", "0 1.5708 0"), ("1.5708 0 0", "y", "-1.5708 0 0")],
)
def test_stand_in_is_along_the_last_joint(rpy, axis, back, tmp_path, runs, capsys):
    path = turned(rpy, tmp_path)
    new_command(tmp_path / "mine", path, "ft")
    said = " ".join(capsys.readouterr().out.split())
    assert f"note: the tool points along {axis}_S" in said
    assert f'<frame name="ft_z_to_tool" attached_to="ft"><pose>0 0 0 {back}</pose></frame>' in said
    slave = LoadScenario(tmp_path / "mine" / "station.yaml").slave
    start = NominalSlave(slave)
    R_WS = RotationMatrix(Quaternion(start.X_WS_start[:4])).matrix()
    along = np.eye(3)["xyz".index(axis)]
    np.testing.assert_allclose(R_WS @ along, [0.0, 0.0, -1.0], atol=1e-3)
    np.testing.assert_allclose(slave.tip, 0.112 * along, atol=1e-9)
    # The recommended frame gives a station with z_S down.
    text = path.read_text()
    frame = f'<frame name="ft_z_to_tool" attached_to="ft"><pose>0 0 0 {back}</pose></frame>'
    path.write_text(text.replace("</model>", f"{frame}</model>", 1))
    plan = plan_station(path, "ft_z_to_tool")
    assert (plan.tool_axis_advice, plan.tip_S, plan.place.is_set_by_position) == ("", [], True)


def rotation_at(arm, q=0.4):
    return RotationMatrix(Quaternion(arm.pose(np.array([q]))[:4])).matrix()


@pytest.mark.parametrize(
    ("name", "where"),
    [
        ("scene.xml", ' quat="0.70711 0 0.70711 0"/> in the body hand and give'),
        ("world.sdf", "</frame> in the model of hand and give"),
        ("arm.urdf", "add to arm.urdf <link"),
        ("arm.dmd.yaml", "add to arm.dmd.yaml - add_frame"),
    ],
)
def test_advised_line_names_the_file_only_if_it_includes_no_models(name, where):
    advice = place.tool_frame_advice(Path(name), "hand", "x")
    assert where in advice
    assert (name in advice) == ("add to" in where)


@pytest.mark.parametrize(("axis", "sensor"), [("x", "force"), ("y", "camera"), ("-z", "torque")])
def test_advised_site_turns_z_to_the_tool_and_keeps_the_load(axis, sensor, tmp_path):
    pose, joint = 'pos="0.1 0.2 0.3" euler="20 -30 50"', '<geom size="0.1"/><joint name="j"/>'
    advice = place.tool_frame_advice(Path("a.xml"), "ft", axis, is_site=True)
    advised = advice.split("write the site ft as ")[1].split(", where POSE")[0]
    arms = []
    for site in (f'<site name="ft" {pose}/>', advised.replace("POSE", pose)):
        tail = f'<sensor><{sensor} site="ft"/></sensor>'
        body = f"<worldbody><body>{joint}{site}</body></worldbody>{tail}"
        path = tmp_path / f"{len(arms)}.xml"
        path.write_text(f"<mujoco>{body}</mujoco>")
        arms.append(NominalSlave(Slave(model=str(path), sensor_frame="ft", home=[0.4])).arm)
    (before, after), (R_before, R_after) = arms, (rotation_at(each) for each in arms)
    z_in_site = R_before.T @ R_after[:, 2]
    np.testing.assert_allclose(z_in_site, place.R_SA_BY_AXIS[axis].matrix()[:, 2], atol=1e-4)
    assert after.phi_load[0] == pytest.approx(before.phi_load[0])


def test_advised_quaternion_has_no_rounding_errors():
    assert 'quat="0 1 0 0"' in place.tool_frame_advice(Path("scene.xml"), "hand", "-z")


@pytest.mark.parametrize("axis", ["x", "y"])
def test_advised_line_of_directives_turns_z_to_the_tool(axis):
    line = place.tool_frame_advice(Path("a.dmd.yaml"), "sensor", axis).split(" - ")[1]
    line = line.split(" and give")[0].replace("MODEL", "arm")
    plant = MultibodyPlant(0.0)
    added = f"- add_model: {{name: arm, file: file://{ARM}}}"
    text = f"directives:\n{added}\n- {line}\n"
    ProcessModelDirectives(LoadModelDirectivesFromString(text), Parser(plant))
    plant.Finalize()
    frames = plant.GetFrameByName("sensor_z_to_tool"), plant.GetFrameByName("sensor")
    X = plant.CalcRelativeTransform(plant.CreateDefaultContext(), *frames[::-1])
    z_in_sensor = X.rotation().matrix()[:, 2]
    np.testing.assert_allclose(z_in_sensor, np.eye(3)["xyz".index(axis)], atol=1e-4)


@pytest.mark.slow
def test_home_joints_are_written_if_the_position_is_not_sufficient(tmp_path, runs):
    """The last joint of this arm cannot turn x_S forward."""
    text = ARM.read_text()
    joint = text.index('name="joint_6"')
    lower, upper = (text.index(f"<{tag}>", joint) for tag in ("lower", "upper"))
    end = text.index("</upper>", upper)
    path = tmp_path / "arm.sdf"
    path.write_text(text[:lower] + "<lower>1.2</lower><upper>1.9" + text[end:])
    plan = plan_station(path, "sensor")
    assert not plan.place.is_set_by_position
    new_command(tmp_path / "mine", path, "sensor")
    slave = LoadScenario(tmp_path / "mine" / "station.yaml").slave
    start = NominalSlave(slave)
    np.testing.assert_allclose(start.X_WS_start[4:], plan.place.position, atol=1e-3)
    R_WS = RotationMatrix(Quaternion(start.X_WS_start[:4])).matrix()
    planned = RotationMatrix(Quaternion(plan.place.pose[:4])).matrix()
    np.testing.assert_allclose(R_WS, planned, atol=1e-3)
    assert R_WS[2, 2] < -0.999 and abs(R_WS[1, 0]) > 0.999


@pytest.mark.slow
def test_arm_of_five_joints_starts_with_tool_down(tmp_path, runs, monkeypatch):
    monkeypatch.setattr(place, "_CUBE_HALF_EDGES_M", (*place._CUBE_HALF_EDGES_M, 2.0))
    path = tmp_path / "five.sdf"
    path.write_text(ARM.read_text().replace('"joint_4" type="revolute"', '"joint_4" type="fixed"'))
    new_command(tmp_path / "mine", path, "sensor")
    slave = LoadScenario(tmp_path / "mine" / "station.yaml").slave
    start = NominalSlave(slave)
    assert len(slave.home) == start.arm.num_joints == 5
    assert RotationMatrix(Quaternion(start.X_WS_start[:4])).matrix()[2, 2] < -0.9999
    half, p_WS = plan_station(path, "sensor").place.cube_half_m, start.X_WS_start[4:]
    assert half >= 0.03
    for way in np.vstack([np.eye(3), -np.eye(3)]):
        target, reached = start.X_WS_start + half * np.append(np.zeros(4), way), np.empty(7)
        pose_into(start.arm.table, find_posture(start.arm, target, start.start)[0], reached)
        assert np.linalg.norm(reached[4:] - p_WS - half * way) < 0.11 * half


def test_tilt_of_a_tool_that_cannot_be_vertical_is_stated(tmp_path, runs, monkeypatch):
    path = tmp_path / "five.sdf"
    path.write_text(ARM.read_text().replace('"joint_4" type="revolute"', '"joint_4" type="fixed"'))
    monkeypatch.setattr(place, "find_posture", lambda *each: (each[2], IkStatus.OUT_OF_REACH))
    monkeypatch.setattr(place, "_can_reach_cube_corner", lambda *_: True)
    monkeypatch.setattr(place, "_NUM_SOLVED_POSTURES", 3)
    new_command(tmp_path / "mine", path, "sensor")
    start = NominalSlave(LoadScenario(tmp_path / "mine" / "station.yaml").slave)
    cosine = -RotationMatrix(Quaternion(start.X_WS_start[:4])).matrix()[2, 2]
    tilt = f"tool {np.degrees(np.arccos(cosine)):.0f} degrees from downwards"
    assert cosine < 0.999
    assert f"joints at the start, {tilt} [rad, m]" in (tmp_path / "mine/station.yaml").read_text()


PIECES = [
    *("#", " #", ": ", "{", "}", "[", "]", ",", "&", "*", "!", "|", ">", "'", '"', "%", "@", "`"),
    *("- ", "? ", "\t", "\n", "\r", " ", "~", "null", "true", "no", "1", "010", "1e-3", "0x1f"),
    *("1:30", "2001-01-01", "<<", "=", "--- ", "...", "\\", "$HOME", "..", "ä", "日本", "\u2028"),
    *("\x85", "\ufeff", "\x07", "\x1b[31m", "%41", "package://", "file:", "arm", "<", "&amp;"),
    *("\udcff", "x" * 40, "-", "_tag", "!Wall", ".inf", "yes", "\U0001f916"),
]


def odd_names(count: int) -> list[str]:
    rng = random.Random(3)
    drawn = ("".join(rng.choices(PIECES, k=rng.randrange(2, 5))) for _ in range(count))
    return [*PIECES, *drawn][:count]


@pytest.mark.slow
def test_odd_names_are_preserved_or_refused(tmp_path, runs, monkeypatch):
    """Try names of the arm's file and folder, packages, tool and sensor frame."""
    plan = plan_station(ARM, "sensor")
    monkeypatch.setattr(new_station, "plan_station", lambda *_: plan)
    monkeypatch.setattr(new_station, "write_picture", lambda *_: None)
    equal = 0
    for k, name in enumerate(odd_names(90)):
        folder = tmp_path / str(k) / f"{name}.d".replace("/", "_")
        folder.mkdir(parents=True)
        odd = folder / folder.name
        odd.touch()
        arm, tool = (odd, ARM) if k % 2 else (ARM, odd)
        station, options = tmp_path / str(k) / "mine" / "new", {"tool": tool, "quiet": True}
        try:
            new_command(station, arm, name, package_paths=(folder, ARM.parent), **options)
        except DrakeTeleopError as error:
            assert len(str(error).splitlines()) == 1 and not station.parent.exists()
            continue
        slave = LoadScenario(station / "station.yaml").slave
        read = [slave.path, *slave.package_folders, slave.tool.path]
        assert read == [path.resolve() for path in (arm, folder, ARM.parent, tool)]
        assert slave.sensor_frame == name and len(list(station.iterdir())) == 1
        equal += 1
    assert equal > 87


@pytest.mark.slow
@pytest.mark.parametrize("name", ["arm.sdf #2", "a\nb", "010", "%41"])
def test_station_with_an_odd_name_refers_to_its_arm(name, tmp_path, runs):
    path, text = tmp_path / f"{name}.sdf", ARM.read_text()
    path.write_text(text.replace("</model>", '<frame name="1e-3" attached_to="sensor"/></model>'))
    (tmp_path / "arm.sdf").write_text(
        text.replace("<mass>", "<mass>1")
    )  # different arm in the same folder
    new_command(tmp_path / "mine", path, "1e-3", quiet=True)
    slave = LoadScenario(tmp_path / "mine" / "station.yaml").slave
    assert (slave.path, slave.sensor_frame) == (path, "1e-3")
    assert NominalSlave(slave).arm.num_joints == 6


def test_misread_station_leaves_no_files(tmp_path, runs, monkeypatch):
    monkeypatch.setattr(new_station, "_relative_path", lambda folder, path: "tool.sdf")
    with pytest.raises(DrakeTeleopError, match="does not describe the given models"):
        new_command(tmp_path / "a" / "mine", ARM, "sensor")
    assert list(tmp_path.iterdir()) == [] and runs == []


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"device": "omega_5"}, r"--device: there is no device 'omega_5'.*omega_6"),
        (
            {"device": "leader"},
            r"--device: there is no device .leader.*; choose one of phantom.*master.leader",
        ),
        ({"sensor": "ati"}, r"--sensor: there is no sensor 'ati'.*ati_gamma"),
        ({"frame": "wrist"}, "wrist"),
    ],
)
def test_unknown_name_is_one_line_and_writes_no_files(options, says, tmp_path, runs):
    frame = options.pop("frame", "sensor")
    with pytest.raises(DrakeTeleopError, match=says):
        new_command(tmp_path / "mine", ARM, frame, **options)
    assert not (tmp_path / "mine").exists() and runs == []
