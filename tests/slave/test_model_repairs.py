"""Models as they are published: repairs keep kinematics, masses and limits, and are stated."""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.systems.framework import DiagramBuilder
from test_bad_models import INERTIA, INERTIAL, LIMIT, arm, joint, link

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.station.scenario import LoadScenario
from drake_teleop.station.scenario_reference import write_scenario
from drake_teleop.station.slave.arm import forward_kinematics, holding_torque
from drake_teleop.station.slave.arm_from_plant import ArmModelFromPlant
from drake_teleop.station.slave.chain_joints import bodies_carried_by
from drake_teleop.station.slave.model.model_numbers import (
    check_lengths_and_inertias,
    nearest_possible_inertia,
    repair_inertia_and_detect_missing,
)
from drake_teleop.station.slave.model.model_repair import ModelPurpose, ModelRepair
from drake_teleop.station.slave.model.urdf_and_sdf_repair import (
    _has_valid_colour,
    find_mimics_and_floating_links,
)
from drake_teleop.station.slave.models import ParseModel, ParseScene, translate_drake_errors
from drake_teleop.station.slave.plant import NominalSlave
from drake_teleop.station.slave.slave_config import Slave, Tool


def read(path, sensor="l6", hold=None, shapes=False):
    """Return plant, arm model and assumptions of a file."""
    plant = MultibodyPlant(0.0)
    if shapes:
        plant, _ = AddMultibodyPlantSceneGraph(DiagramBuilder(), 0.0)
    parsed = ParseModel(plant, path, sensor, hold=hold)
    plant.Finalize()
    model = ArmModelFromPlant(plant, parsed.instance, parsed.sensor_frame.name())
    return plant, model, "; ".join(parsed.assumptions)


def pose(model, q):
    R, p = np.empty((3, 3)), np.empty(3)
    forward_kinematics(model.table, np.asarray(q, dtype=float), R, p)
    return np.column_stack([R, p])


def written(folder, text, name="arm.urdf"):
    (folder / name).write_text(text)
    return folder / name


@pytest.mark.parametrize(
    ("given", "expected", "share"),
    [
        ((0.1, 0.1, 0.2001), (0.1 + 1e-4 / 3, 0.1 + 1e-4 / 3, 0.2001 - 1e-4 / 3), 1e-4 / 0.6003),
        ((0.0, 0.0, 3.0), (1.0, 1.0, 2.0), 1 / 3),
        ((0.2, 1.0, 1.8), (0.4, 1.2, 1.6), 1 / 9),
        ((-0.3, 1.0, 1.0), (0.0, 1.0, 1.0), 0.3),
        ((-1.0, 1.0, 4.0), (1.0, 2.0, 3.0), 0.5),
        ((0.3, 0.4, 0.7), (0.3, 0.4, 0.7), 0.0),
    ],
)
def test_nearest_possible_inertia_shares_the_deficit(given, expected, share):
    R = RollPitchYaw(0.3, -0.7, 1.1).ToRotationMatrix().matrix()
    for axes in (np.eye(3), R):
        found, change = nearest_possible_inertia(axes @ np.diag(given) @ axes.T)
        np.testing.assert_allclose(found, axes @ np.diag(expected) @ axes.T, atol=3e-9)
        assert change == pytest.approx(share, abs=3e-9)
        moments = np.linalg.eigvalsh(found)
        assert moments[0] >= -1e-15 and moments[2] <= moments[0] + moments[1] + 1e-15


LIMITLESS = '<axis xyz="0 0 1"/>'
TWICE = "".join(
    f'<transmission name="t{k}"><type>transmission_interface/SimpleTransmission</type><joint '
    f'name="j{k}"/><actuator name="motor"><mechanicalReduction>1</mechanicalReduction></actuator>'
    "</transmission>"
    for k in (1, 2, 3)
)
COLOUR = '<visual><geometry><box size=".1 .1 .1"/></geometry><material name="grey"><color rgba="{} '
COLOUR += '0 0 1"/></material></visual>'
OFF_CHAIN = link("a") + link("b") + link("c") + link("d") + link("e")
OFF_CHAIN += joint(21, "planar", parent="l4", child="a") + joint(22, "floating", parent="a",
                                                                  child="b")  # fmt: skip
OFF_CHAIN += joint(23, parent="l4", child="c", inside='<mimic joint="j2" multiplier="-1"/>')
OFF_CHAIN += joint(24, "hinge", parent="c", child="d").replace("0 0 1", "0 0 0")
OFF_CHAIN += joint(25, parent="l6", child="e").replace(LIMIT, '<limit lower="2" upper="1"/>')
# Defects of published files, and the statement about them.
LOOKALIKES = {
    "six-joint arm with rounded and thin links": (
        arm(l3=link("l3", INERTIAL.replace('izz="0.01"', 'izz="0.0405"')))
        .replace(INERTIA, INERTIA.replace('izz="0.01"', 'izz="0.06"'), 1),
        "an impossible inertia left out, .* of l0; inertia replaced by .* of link l3 .0.412 %."),
    "seven-joint arm on a base without mass": (
        arm(l0=link("l0", INERTIAL.replace('value="2"', 'value="0.0"'))),
        "^an impossible inertia left out, as no joint of the arm moves the link, of l0$"),
    "mobile manipulator with commas and shared motor names": (
        arm(beyond=TWICE, l3=link("l3", INERTIAL + COLOUR.format(1) + COLOUR.format(0.5)))
        .replace('xyz="0 0 0.25"', 'xyz="0, 0,0.25" rpy="0, 0 0"'), "^$"),
    "humanoid with coupled fingers, wheels and odd joints": (
        arm(beyond=OFF_CHAIN), "^held: j21, j22, j23, j24, j25$"),
    "arm without masses": (
        re.sub("<inertial>.*?</inertial>", "", arm()),
        "a rotor inertia of 0.219 kg m.2, as the model has no inertia there, for j1, .*, j6$"),
    "arm with unused properties of xacro": (
        arm(l0='<xacro:property name="m" value="2"/><xacro:arg name="n"/>' + link("l0")), "^$"),
    "arm with plugins, a loose cup and a floating base": (
        arm(l0=link("world", "") + link("l0") + joint(30, "floating", "", "world", "l0"),
            beyond=link("cup") + '<gazebo reference="l3"><kp>1</kp></gazebo><sensor/>'),
        "^welded to the world instead of floating: l0; .* and left out: cup$"),
}  # fmt: skip


@pytest.mark.parametrize("case", LOOKALIKES)
def test_repairs_keep_kinematics_and_limits(tmp_path, case):
    text, expected = LOOKALIKES[case]
    _, clean, _ = read(written(tmp_path, arm(), "clean.urdf"))
    _, model, said = read(written(tmp_path, text))
    assert re.search(expected, said), said
    for q in np.random.default_rng(3).uniform(-2, 2, (5, 6)):
        np.testing.assert_allclose(pose(model, q), pose(clean, q), atol=1e-12)
    for name in ("joint_names", "lower", "upper", "effort_limit", "velocity_limit"):
        np.testing.assert_array_equal(getattr(model, name), getattr(clean, name))


def test_masses_beside_the_chain_stay(tmp_path):
    """The planar, floating and coupled links move with l4, the last one with the sensor."""
    plant, model, _ = read(written(tmp_path, arm(beyond=OFF_CHAIN)))
    assert model.phi_load[0] == pytest.approx(2.0)  # link e
    masses = model.table[:-1, 12]  # first of the inertial parameters
    np.testing.assert_allclose(masses, [2.0, 2.0, 2.0, 10.0, 2.0, 2.0])
    assert plant.num_positions() == 6


PALM_AND_FINGER = link("palm") + joint(21, parent="l6", child="palm")
PALM_AND_FINGER += link("finger") + joint(22, "prismatic", parent="palm", child="finger")


def frames_on_last_link(*origins: str) -> str:
    """Return massless links, each welded to the one before; the last one is `tool`."""
    names = ["l6", *(f"frame_{k}" for k in range(1, len(origins))), "tool"]
    return "".join(
        f'{link(child, "")}<joint name="to_{child}" type="fixed"><parent link="{parent}"/>'
        f'<child link="{child}"/><origin {origin}/></joint>'
        for parent, child, origin in zip(names, names[1:], origins, strict=False)
    )


@pytest.mark.parametrize(
    "origins",
    [
        ['rpy="0 1.5708 0"'],
        ['rpy="0.3 -0.2 2.5"'],
        ['rpy="1 0 0"', 'rpy="0 0 0.5"'],
        ['xyz="0 0 0.2"', 'xyz="0 0 -0.2" rpy="0 0 3"'],
    ],
)
def test_massless_frame_at_the_last_link_carries_what_the_link_carries(tmp_path, origins):
    path = written(tmp_path, arm(beyond=PALM_AND_FINGER + frames_on_last_link(*origins)))
    _, on_link, _ = read(path)
    plant, on_frame, said = read(path, "tool")
    assert "not part of the load" not in said
    names = {body.name() for body in bodies_carried_by(plant, plant.GetBodyByName("tool"))}
    assert names == {"palm", "finger"}
    np.testing.assert_allclose(on_frame.table[:-1], on_link.table[:-1], atol=1e-12)
    q = np.full(6, 0.3)
    R_WL, R_WF = pose(on_link, q)[:, :3], pose(on_frame, q)[:, :3]
    moments = R_WL @ on_link.phi_load[1:4], R_WF @ on_frame.phi_load[1:4]
    np.testing.assert_allclose(*moments, atol=1e-12)
    torques = holding_torque(on_link, q), holding_torque(on_frame, q)
    np.testing.assert_allclose(*torques, atol=1e-12)


@pytest.mark.parametrize("offset", [1e-3, -0.1])
def test_bodies_beside_a_frame_elsewhere_on_the_link_are_stated(tmp_path, offset):
    frame = frames_on_last_link(f'xyz="0 {offset} 0"')
    _, model, said = read(written(tmp_path, arm(beyond=PALM_AND_FINGER + frame)), "tool")
    assert model.phi_load[0] == 0.0
    expected = "not part of the load at tool: palm of the model, 4 kg (part of the load with"
    assert f"{expected} sensor_frame l6)" in said


@pytest.mark.parametrize("hold", [None, {"j1": 0.3}])
def test_motors_keep_gear_rotor_and_effort_of_their_joint(tmp_path, hold):
    """Reflected inertia: gear ratio squared times the rotor's."""
    gears, rotors, efforts = (
        [1, 7, 50, 100, 3, 20],
        [2e-3, 1e-3, 1e-4, 5e-5, 3e-3, 2e-4],
        range(11, 17),
    )
    text, order = arm(), [3, 0, 5, 2, 1, 4]
    for k in range(6):
        text = text.replace(joint(k + 1), joint(k + 1).replace('"200"', f'"{efforts[k]}"'))
    motors = "".join(
        f'<transmission type="SimpleTransmission"><joint name="j{k + 1}"/><actuator name="a{k}">'
        f'<drake:gear_ratio value="{gears[k]}"/><drake:rotor_inertia value="{rotors[k]}"/>'
        "</actuator></transmission>"
        for k in order
    )
    _, model, _ = read(written(tmp_path, text.replace("</robot>", f"{motors}</robot>")), hold=hold)
    kept = slice(0 if hold is None else 1, 6)
    np.testing.assert_allclose(model.table[:-1, 22], (np.square(gears) * rotors)[kept])
    np.testing.assert_array_equal(model.effort_limit, efforts[kept])


SDF_MASS = "<inertial><mass>1</mass><inertia><ixx>1</ixx><iyy>1</iyy><izz>1</izz></inertia>"
SDF_JOINT = f"""<sdf version="1.9" xmlns:drake="d"><model name="a">
<link name="a">{SDF_MASS}</inertial></link><link name="b">{SDF_MASS}</inertial></link>
<joint name="j" type="revolute"><parent>a</parent><child>b</child><axis><xyz>0 1 0</xyz><limit>
<lower>-1</lower><upper>1</upper><effort>{{}}</effort></limit></axis>{{}}</joint></model></sdf>"""


@pytest.mark.parametrize("effort", ["0", "0.0", "", "-0"])
@pytest.mark.parametrize("gear", [1.0, 50.0])
def test_rotor_of_a_motor_without_effort_limit_is_kept(tmp_path, effort, gear):
    """Drake omits a motor with a limit of 0, which exporters write for unknown limits."""
    motor = (
        '<transmission type="SimpleTransmission"><joint name="j3"/><actuator name="a">'
        f'<drake:gear_ratio value="{gear}"/><drake:rotor_inertia value="2e-3"/></actuator>'
        "</transmission>"
    )
    third = joint(3).replace('effort="200"', f'effort="{effort}"')
    _, model, _ = read(written(tmp_path, arm(j3=third, beyond=motor)))
    assert model.effort_limit[2] == np.inf
    np.testing.assert_allclose(model.table[:-1, 22], [0, 0, gear**2 * 2e-3, 0, 0, 0])
    motor = f"<drake:rotor_inertia>2e-3</drake:rotor_inertia><drake:gear_ratio>{gear}"
    text = SDF_JOINT.format(effort, f"{motor}</drake:gear_ratio>")
    _, model, _ = read(written(tmp_path, text, "arm.sdf"), "b")
    assert model.effort_limit[0] == np.inf
    np.testing.assert_allclose(model.table[0, 22], gear**2 * 2e-3)


def test_continuous_joints_keep_their_limits_only_if_given(tmp_path):
    text = arm(j3=joint(3, "continuous").replace(LIMIT, '<limit effort="9" velocity="1"/>'))
    _, model, _ = read(
        written(tmp_path, text.replace('"j2" type="revolute"', '"j2" type="continuous"'))
    )
    np.testing.assert_array_equal(model.lower[1:4], [-2.5, -np.inf, -2.5])
    np.testing.assert_array_equal(model.upper[1:4], [2.5, np.inf, 2.5])
    np.testing.assert_array_equal(model.effort_limit[1:4], [200.0, 9.0, 200.0])


@pytest.mark.parametrize("name", ["j1", "j3", "j5"])
@pytest.mark.parametrize("position", [0.0, -0.7, 1.9])
def test_held_joint_is_fixed_at_its_position(tmp_path, name, position):
    text = arm().replace('"j3" type="revolute"', '"j3" type="prismatic"')
    path, k = written(tmp_path, text), int(name[1]) - 1
    _, free, _ = read(path)
    _, held, said = read(path, hold={name: position})
    assert held.joint_names == tuple(f"j{i}" for i in range(1, 7) if f"j{i}" != name)
    assert f"held at {position:g}: {name}" in said
    for q in np.random.default_rng(4).uniform(-2, 2, (3, 5)):
        expected = pose(free, np.insert(q, k, position))
        np.testing.assert_allclose(pose(held, q), expected, atol=1e-12)


def test_hold_frees_chain_from_coupled_joint_and_opens_gripper(tmp_path):
    finger = joint(9, "prismatic", '<mimic joint="j2"/>', parent="l6", child="f") + link("f")
    coupled = joint(3, inside='<mimic joint="j2"/>')
    path = written(tmp_path, arm(j3=coupled, beyond=finger))
    with pytest.raises(DrakeTeleopError, match=r"j3 moves with another joint.*slave\.hold"):
        read(path)
    plant, model, said = read(path, hold={"j3": 0.4, "j9": 0.03})
    assert model.joint_names == ("j1", "j2", "j4", "j5", "j6")
    assert "held at 0.4: j3; held at 0.03: j9" in said
    context = plant.CreateDefaultContext()
    frames = [plant.GetFrameByName(each) for each in ("l6", "f")]
    p = plant.CalcRelativeTransform(context, *frames).translation()
    np.testing.assert_allclose(p, [0, 0.03, 0.25], atol=1e-12)


def test_joint_of_the_chain_does_not_mimic_a_joint_beside_it(tmp_path):
    """Such joints are those of a parallelogram, of which the tree has one side."""
    beside = joint(9, parent="l1", child="f") + link("f")
    text = arm(j3=joint(3, inside='<mimic joint="j9" multiplier="-1"/>'), beyond=beside)
    _, model, said = read(written(tmp_path, text))
    assert model.joint_names == tuple(f"j{i}" for i in range(1, 7))
    assert said.startswith("joint moves alone, as the joint that it mimics does not move S: j3; ")
    path = written(tmp_path, text)
    with pytest.raises(DrakeTeleopError, match=r"j3 moves with another joint"):
        read(path, hold={"j9": 0.3})  # which would not hold j3


def test_massless_link_of_a_held_joint_before_the_arm_is_not_reported(tmp_path):
    path = written(tmp_path, arm(l3=link("l3", "")))
    assert "no inertia of l3" in read(path, hold={"j3": 0.2})[2]  # j1 and j2 move it
    assert "no inertia" not in read(path, hold={"j1": 0.2, "j2": 0.1, "j3": 0.0})[2]


@pytest.mark.parametrize(
    ("hold", "expected"),
    [
        (
            {"torso": 0.1},
            r"slave\.hold: the model has no moving joint 'torso'; name one of j1, j2, j3",
        ),
        ({"j3": 2.6}, r"slave\.hold: j3 at 2\.6 is outside its limits, -2\.5 to 2\.5"),
        ({"j3": float("nan")}, r"Slave\.hold\.j3: nan rad, m is outside -10000 to 10000"),
    ],
)
def test_invalid_hold_is_one_error(tmp_path, hold, expected):
    path = written(tmp_path, arm())
    with pytest.raises(DrakeTeleopError, match=expected):
        NominalSlave(Slave(model=str(path), sensor_frame="l6", hold=hold))


def test_hold_is_read_from_a_scenario_and_written_to_one(tmp_path):
    written(tmp_path, arm())
    text = "slave: {model: arm.urdf, sensor_frame: l6, home: [0.1, 0.4, 1.2, 1.4, 0.3], hold: "
    scenario = LoadScenario(written(tmp_path, f"{text}{{j4: -0.2}}}}", "a.yaml"))
    assert scenario.slave.hold == {"j4": -0.2}
    assert NominalSlave(scenario.slave).arm.joint_names == ("j1", "j2", "j3", "j5", "j6")
    write_scenario(tmp_path / "b.yaml", scenario)
    assert LoadScenario(tmp_path / "b.yaml").slave.hold == {"j4": -0.2}
    for wrong, expected in (
        ("[j4]", "slave.hold: expected names with values"),
        ("{j4: x}", "hold.j4: exp"),
    ):
        with pytest.raises(DrakeTeleopError, match=expected):
            LoadScenario(written(tmp_path, f"{text}{wrong}}}", "c.yaml"))


ARM_SDF = """<model name="arm"><pose>0.3 0 0.5 0 0 0</pose>
<link name="base"><inertial><mass>0</mass></inertial></link>
<link name="l1"><pose>0 0 0.2 0.1 0.2 0.3</pose><inertial><mass>2</mass><inertia><ixx>0.1</ixx>
<iyy>0.1</iyy><izz>0.3</izz></inertia></inertial><sensor name="s" type="imu"/>
<collision name="c"><material/><geometry><box><size>.1, .1, .1</size></box></geometry></collision>
<visual name="v"><geometry><box><size>.1 .1 .1</size></box></geometry><plugin/></visual></link>
<link name="hand"><pose>0 0.1 0.6 0 0 0</pose><inertial><mass>0</mass></inertial></link>
<joint name="a" type="revolute"><parent>base</parent><child>l1</child><axis><xyz>0 1 0</xyz><limit>
<lower>-1</lower><upper>2</upper><effort>30</effort></limit></axis></joint>
<joint name="f" type="ball"><parent>l1</parent><child>hand</child></joint>
<frame name="ft" attached_to="l1"><pose>0 0 0.3 0 0 0</pose></frame></model>"""
TABLE = '<model name="table"><link name="top"/><joint name="x" type="gearbox"/></model>'


@pytest.mark.parametrize(
    ("text", "stated"),
    [
        (
            f"<world name='w'>{TABLE}<light/>{ARM_SDF}</world>",
            "models beside the arm are left out: table",
        ),
        (f"{ARM_SDF}{TABLE}", "models beside the arm are left out: table"),
        (ARM_SDF, "held: f"),
    ],
)
def test_arm_is_taken_out_of_an_sdf(tmp_path, text, stated):
    path = written(tmp_path, f"<sdf version='1.7'>{text}</sdf>", "arm.sdf")
    plant, model, said = read(path, "ft", shapes=True)
    assert stated in said
    assert "replaced by the nearest possible one" in said and "of link l1 (11.1 %)" in said
    assert "an impossible inertia left out, as no joint of the arm moves the link, of base" in said
    assert "inertia is left out, because the mass is 0, of link hand" in said
    assert (model.lower[0], model.upper[0], model.effort_limit[0]) == (-1.0, 2.0, 30.0)
    assert plant.GetBodyByName("hand").default_mass() == 0.0
    X_BaseL1 = RigidTransform(RollPitchYaw(0.1, 0.2, 0.3), [0, 0, 0.2])
    for q in (-0.4, 0.0, 1.3):
        turn = RigidTransform(RollPitchYaw(0, q, 0), np.zeros(3))
        expected = (X_BaseL1 @ turn @ RigidTransform([0, 0, 0.3])).GetAsMatrix34()
        np.testing.assert_allclose(pose(model, [q]), expected, atol=1e-12)


@pytest.mark.parametrize("name", ["hand", "base", "l1"])
def test_sdf_joint_with_the_name_of_a_link_gets_another(tmp_path, name):
    """Drake rejects such a file; older simulators accept it."""
    text = ARM_SDF.replace('<joint name="a"', f'<joint name="{name}"')
    path = written(tmp_path, f"<sdf version='1.7'>{text}</sdf>", "arm.sdf")
    _, model, said = read(path, "ft", shapes=True)
    assert f"a unique name for joint {name} ({name}_1)" in said
    assert model.joint_names == (f"{name}_1",) and model.effort_limit[0] == 30.0


TURN = '<joint name="turn" type="revolute"><parent>{}</parent><child>{}</child>{}{}</joint>'


@pytest.mark.parametrize("own_pose", ["", "<pose>0.1 0 0 0 0.4 0</pose>"])
@pytest.mark.parametrize("parent", ["base", "mount", "nested"])
@pytest.mark.parametrize("child", ["hand", "bearing"])
def test_sdf_joints_between_frames_are_those_of_the_file(tmp_path, parent, child, own_pose):
    inertial = "<inertial><mass>1</mass></inertial>"
    links = "".join(f'<link name="{name}">{inertial}</link>' for name in ("base", "hand"))
    frames = "".join(
        f'<frame name="{name}" attached_to="{link}"><pose>{place}</pose></frame>'
        for name, link, place in (
            ("mount", "base", "0 0.1 0.2 0.3 0 0"),
            ("nested", "mount", "0.2 0 0 0 0.1 0"),
            ("bearing", "hand", "0 0.2 0.1 0 0.5 0.6"),
        )
    )
    turn = TURN.format(parent, child, own_pose, "<axis><xyz>0.6 0 0.8</xyz></axis>")
    text = f'<sdf version="1.9"><model name="m">{links}{frames}{turn}</model></sdf>'
    path = written(tmp_path, text, "arm.sdf")
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModels(str(path))
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base"))
    plant.Finalize()
    context, (_, model, said) = plant.CreateDefaultContext(), read(path, "hand")
    assert model.joint_names == ("turn",) and "left out" not in said
    for q in (-0.4, 0.0, 1.3):
        plant.SetPositions(context, [q])
        expected = plant.GetBodyByName("hand").EvalPoseInWorld(context).GetAsMatrix34()
        np.testing.assert_allclose(pose(model, [q]), expected, atol=1e-12)


@pytest.mark.parametrize("outer_name", ["outer.sdf", "arm.sdf"])
@pytest.mark.parametrize("uri", ["inside/arm.sdf", "inside", "model://inside"])
def test_included_model_is_repaired(tmp_path, uri, outer_name):
    """The folder of a model, also the outer one, names its file in model.config."""
    written(tmp_path, f"<model><sdf>{outer_name}</sdf></model>", "model.config")
    (tmp_path / "inside").mkdir()
    written(tmp_path / "inside", f"<sdf version='1.7'>{ARM_SDF}</sdf>", "arm.sdf")
    written(tmp_path / "inside", "<model><sdf> arm.sdf </sdf></model>", "model.config")
    outer = f"<sdf version='1.7'><model name='m'><include><uri>{uri}</uri></include></model></sdf>"
    _, model, said = read(written(tmp_path, outer, outer_name), "ft")
    assert model.joint_names == ("a",) and model.effort_limit[0] == 30.0
    assert "of link l1 (11.1 %)" in said


GRIPPER = f"""<robot name="g">{link("palm", INERTIAL.replace('izz="0.01"', 'izz="0.05"'))}
{link("f")}<joint name="slide" type="prismatic"><parent link="palm"/><child link="f"/>
<axis xyz="1 0 0"/>{LIMIT}</joint></robot>"""
DIRECTIVES = """directives:
- add_model: {{name: arm, file: "file://{0}/arm.urdf", default_joint_positions: {{j8: [0.3]}}}}
- add_weld: {{parent: world, child: arm::l0, X_PC: {{translation: [0.1, 0.2, 0.3]}}}}
- add_model: {{name: hand, file: "file://{0}/f.urdf", default_joint_positions: {{slide: [0.02]}}}}
- add_weld: {{parent: arm::l6, child: hand::palm, X_PC: {{translation: [0, 0, 0.1]}}}}
- add_model: {{name: cup, file: "file://{0}/cup.urdf"}}
"""


@pytest.mark.parametrize("limit", [7.0, 90.0])
@pytest.mark.parametrize("inside", ["", '<mimic joint="j4"/>'])
def test_joints_of_another_model_may_have_the_same_names(tmp_path, limit, inside):
    """The hand's joint j3 limits neither torque nor motion of the arm's joint j3."""
    written(tmp_path, arm())
    hand = link("palm") + link("f") + link("g")
    for k, child, own in ((3, "f", inside), (4, "g", "")):
        text = joint(k, "prismatic", own, "palm", child)
        hand += text.replace('effort="200"', f'effort="{limit}"')
    written(tmp_path, f'<robot name="hand">{hand}</robot>', "f.urdf")
    written(tmp_path, f'<robot name="cup">{link("cup")}</robot>', "cup.urdf")
    directives = re.sub(r", default_joint_positions: {{\w+: \[[\d.]+\]}}", "", DIRECTIVES)
    path = written(tmp_path, directives.format(tmp_path), "arm.dmd.yaml")
    _, model, _ = read(path)
    np.testing.assert_array_equal(model.effort_limit, 200.0)
    with pytest.raises(DrakeTeleopError, match=r"j3 moves with another joint \(mimic\)"):
        written(tmp_path, arm(j3=joint(3, inside='<mimic joint="j1"/>')))
        read(path)


@pytest.mark.parametrize("order", [("left", "right"), ("right", "left"), ("b", "a")])
@pytest.mark.parametrize("name", ["j1", "j4"])
def test_held_joint_is_that_of_the_arm_with_the_sensor(tmp_path, order, name):
    written(tmp_path, arm())
    url = (tmp_path / "arm.urdf").as_uri()
    models = [f"- add_model: {{name: {each}, file: {url}}}" for each in order]
    for owner in order:
        frame = f"- add_frame: {{name: {owner}::ft, X_PF: {{base_frame: {owner}::l6}}}}"
        text = "\n".join(["directives:", *models, frame])
        path = written(tmp_path, text, "arms.dmd.yaml")
        plant, model, said = read(path, "ft", hold={name: 0.3})
        assert model.joint_names == tuple(f"j{k}" for k in range(1, 7) if f"j{k}" != name)
        assert f"held at 0.3: {name};" in said
        instance = plant.GetModelInstanceByName(owner)
        weld = plant.GetJointByName(f"{name}_held", instance)
        angle = weld.X_FM().rotation().ToAngleAxis().angle()
        np.testing.assert_allclose(angle, 0.3)


def test_models_of_directives_are_repaired(tmp_path):
    beside = link("x") + joint(8, parent="l6", child="x")
    written(tmp_path, arm(beyond=beside, l3=link("l3", INERTIAL.replace(INERTIA, INERTIA.replace(
        'izz="0.01"', 'izz="0.05"')))))  # fmt: skip
    written(tmp_path, GRIPPER, "f.urdf")
    written(tmp_path, f'<robot name="cup">{link("cup")}</robot>', "cup.urdf")
    path = written(tmp_path, DIRECTIVES.format(tmp_path), "arm.dmd.yaml")
    plant, model, said = read(path)
    assert "of link l3 (6.67 %)" in said and "of link palm (6.67 %)" in said
    assert "connected to the arm and welded to the world: cup" in said
    assert "held: j8, slide" in said
    assert model.joint_names == tuple(f"j{k}" for k in range(1, 7))
    np.testing.assert_array_equal(model.effort_limit, 200.0)
    assert model.phi_load[0] == pytest.approx(6.0)
    np.testing.assert_allclose(pose(model, np.zeros(6))[:, 3], [0.1, 0.2, 1.8], atol=1e-12)
    context = plant.CreateDefaultContext()
    frames = [plant.GetFrameByName(each) for each in ("palm", "f")]
    p = plant.CalcRelativeTransform(context, *frames).translation()
    np.testing.assert_allclose(p, [0.02, 0, 0], atol=1e-12)


def test_all_faults_are_listed_at_once(tmp_path):
    bad = joint(5, "ball").replace(LIMIT, '<limit lower="3" upper="x"/>')
    text = arm(j3=joint(3, inside='<mimic joint="j2"/>')).replace(joint(5), bad)
    text = text.replace('<mass value="2"/>', '<mass value="-4"/>', 3).replace("0.25", "1e9", 1)
    with pytest.raises(DrakeTeleopError) as error:
        read(written(tmp_path, text))
    said = str(error.value)
    assert said.startswith(f"{tmp_path}/arm.urdf: the model has 6 faults: (1) ")
    for part in ("j3 moves with another joint", "j5 is a ball joint", "'x' is not a number",
                 "origin 1e9 is no", "link l1: mass -4", "link l2: mass -4"):  # fmt: skip
        assert part in said


@pytest.mark.parametrize("origin", ['xyz="0 0.25"', 'xyz="0 0 a"', 'rpy="0 0 0 0"', 'xyz="${x}"'])
def test_invalid_origin_of_the_chain_names_its_joint(tmp_path, origin):
    path = written(tmp_path, arm(j3=joint(3).replace('xyz="0 0 0.25"', origin)))
    with pytest.raises(DrakeTeleopError, match=r"joint j3: \w+ of origin is '.*', not three"):
        read(path)


def test_message_of_drake_is_whole_and_names_the_users_file(tmp_path):
    path = written(tmp_path, f"<sdf version='99'>{ARM_SDF}</sdf>", "arm.sdf")
    outer = f"<sdf version='1.7'><model name='m'><include><uri>{path}</uri></include></model></sdf>"
    for file in (path, written(tmp_path, outer, "outer.sdf")):
        with pytest.raises(DrakeTeleopError) as error:
            read(file, "ft")
        said = str(error.value)
        assert said.startswith(f"{file}: cannot be read as a robot; give a URDF, SDF, MJCF or .dmd")
        assert "Unable to convert from SDF version 99 to 1.12" in said and said.endswith(")")
        assert not re.search(r"-string|drake_teleop_| \.\.\. ", said)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            "Failure at bazel-out/k8/a.h:104 in Set(): condition 'm > 0' failed.",
            "condition 'm > 0'",
        ),
        ("<literal-string>.urdf:12: error: body b", "(error: body b)"),
        (
            "error: /tmp/folder/3_arm.sdf:7: body b; file:///tmp/folder/0_a.sdf",
            "arm.sdf: body b; a.sdf)",
        ),
        ("x" * 2000, "x ...)"),
    ],
)
def test_message_of_drake_loses_only_places_that_the_user_has_not(text, expected):
    def fail():
        with translate_drake_errors(Path("arm.urdf"), folder="/tmp/folder"):
            raise RuntimeError(text)

    with pytest.raises(DrakeTeleopError) as error:
        fail()
    said = str(error.value)
    assert expected in said and not re.search("bazel|-string|/tmp", said) and len(said) < 1000


MESHES = {
    "text.obj": "hello",
    "empty.stl": "",
    "nan.obj": "v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
    "corner.obj": "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n",
    "points.obj": "v 0 0 0\nv 1 0 0\nv 0 1 0\n",
    "cut.gltf": '{"asset"',
    "shape.dae": "<COLLADA/>",
}
SHAPES = ('<ellipsoid a="-1" b="1" c="1"/>', '<box size="1 nan 1"/>', "<cone/>", "",
          '<mesh filename="flat.stl" scale="1 nan 1"/>')  # fmt: skip


def test_damaged_meshes_are_dropped_and_stated_for_an_arm_only(tmp_path):
    flat = "solid a\nfacet\nvertex 0 0 0\nvertex .1 0 0\nvertex 0 .1 0\nendfacet\n"
    for name, content in (MESHES | {"flat.stl": flat}).items():
        (tmp_path / name).write_text(content)

    def shape(name):
        return f'<collision><geometry><mesh filename="{name}"/></geometry></collision>'

    shapes = "".join(map(shape, [*MESHES, "gone.obj"]))
    shapes += "".join(f"<visual><geometry>{each}</geometry></visual>" for each in SHAPES)
    path = written(tmp_path, arm(l3=link("l3", INERTIAL + shapes + shape("flat.stl"))))
    plant, _, said = read(path, shapes=True)
    assert len(plant.GetCollisionGeometriesForBody(plant.GetBodyByName("l3"))) == 1
    for part in (".obj meshes are empty or damaged", ".stl meshes are empty or damaged",
                 ".dae meshes cannot be read", "were not found", "cut.gltf: is no"):  # fmt: skip
        assert part in said
    _, _, without = read(path)
    assert "shapes are missing of l3" in without
    pad = f'<robot name="s">{link("pad", INERTIAL + shape("gone.obj"))}</robot>'
    with pytest.raises(DrakeTeleopError, match="shapes are missing of pad"):
        ParseScene(MultibodyPlant(0.0), written(tmp_path, pad, "pad.urdf"))


@pytest.mark.parametrize("visual", ['<box size="1 1 1"/>', '<sphere radius="0.1"/>'])
@pytest.mark.parametrize("fault", ['<mesh filename="gone.obj"/>', "<cone/>"])
def test_lost_contact_is_stated_beside_visual_shapes(tmp_path, visual, fault):
    """Visual shapes make no contact: of an arm they replace lost shapes, of a tool they do not."""
    shapes = f"<visual><geometry>{visual}</geometry></visual>"
    shapes += f"<collision><geometry>{fault}</geometry></collision>"
    pad = f'<robot name="s">{link("pad", INERTIAL + shapes)}</robot>'
    path, what = written(tmp_path, pad, "pad.urdf"), "shapes are missing of pad"
    with pytest.raises(DrakeTeleopError, match=what):
        ParseScene(MultibodyPlant(0.0), path)
    assert what in "; ".join(NominalSlave(Slave(tool=Tool(model=str(path)))).assumptions)
    _, _, said = read(written(tmp_path, arm(l3=link("l3", INERTIAL + shapes))))
    assert "shapes are missing" not in said


def test_tool_may_have_joints_of_any_kind(tmp_path):
    tool = written(tmp_path, GRIPPER.replace("prismatic", "planar"), "tool.urdf")
    path = written(tmp_path, arm())
    slave = Slave(model=str(path), sensor_frame="l6", home=[0.1, 0.4, 1.2, 0.2, 1.4, 0.3],
                  tool=Tool(model=str(tool)))  # fmt: skip
    nominal = NominalSlave(slave)
    assert nominal.arm.phi_load[0] == pytest.approx(4.0)
    assert "held: slide" in nominal.assumptions


@pytest.mark.parametrize(
    ("inside", "expected"),
    [
        ("", {}),
        ('<mimic joint="k"/>', {"j": "moves with another joint (mimic)"}),
        ('<axis><mimic joint="k"/></axis>', {"j": "moves with another joint (mimic)"}),
    ],
)
@pytest.mark.parametrize("parent", ["world", "l2"])
def test_coupled_joints_and_floating_links_are_dependent(inside, expected, parent):
    ends = f'<parent link="{parent}"/><child link="c"/>'
    root = ElementTree.fromstring(
        f'<r><joint name="j" type="revolute">{inside}</joint>'
        f'<joint name="f" type="floating">{ends}</joint></r>'
    )
    floating = {} if parent == "world" else {"c": "floats on l2"}
    assert find_mimics_and_floating_links(root) == expected | floating


@pytest.mark.parametrize(
    ("value", "allowed"),
    [("9e5", True), ("1.1e6", False), ("-9e5", True), ("-1.1e6", False), ("inf", False)],
)
def test_lengths_masses_and_inertias_are_at_most_1e6(tmp_path, value, allowed):
    texts = [f'<origin xyz="0 0 {value}"/>', f'<box size="1 1 {value}"/>']
    inertial = '<inertial><mass value="{}"/><inertia ixx="1e6" iyy="1e6" izz="1e6" ixy="{}"/>'
    texts += [inertial.format(value, 0.0), inertial.format(1, value)]
    for k, text in enumerate(texts):
        model = ModelRepair(tmp_path, None, ModelPurpose(), tmp_path)
        link = ElementTree.fromstring(f'<link name="l">{text}{"</inertial>" * (k > 1)}</link>')
        check_lengths_and_inertias(link, "link l", model)
        repair_inertia_and_detect_missing(link, model, is_sdf=False, is_fixed=False)
        if allowed and not (k == 2 and value[0] == "-"):
            model.raise_faults()
        else:
            with pytest.raises(DrakeTeleopError, match="link l"):
                model.raise_faults()


@pytest.mark.parametrize(
    ("rgba", "kept"),
    [
        ("0.8 1 0 1", True),
        ("0 0 0 0", True),
        ("1.1 0 0 1", False),
        ("0 0 -0.1 1", False),
        ("0 0 1", False),
        ("0 0 1 a", False),
    ],
)
def test_colours_have_four_numbers_from_0_to_1(rgba, kept):
    material = ElementTree.fromstring(f'<material><texture/><color rgba="{rgba}"/></material>')
    assert _has_valid_colour(material) == kept
    assert material.find("texture") is None


@pytest.mark.parametrize("izz", [0.04, 0.09])
@pytest.mark.parametrize("is_sdf", [False, True])
def test_products_of_inertia_are_kept(tmp_path, izz, is_sdf):
    """The nearest possible inertia is written for 0.09."""
    inertia = np.array([[0.03, 4e-3, -5e-3], [4e-3, 0.035, 6e-3], [-5e-3, 6e-3, izz]])
    entries = {f"i{'xyz'[i]}{'xyz'[j]}": inertia[i, j] for i in range(3) for j in range(i, 3)}
    inner = "".join(f"<{name}>{value}</{name}>" for name, value in entries.items())
    text = f"<mass>2</mass><inertia>{inner}</inertia>"
    if not is_sdf:
        words = " ".join(f'{name}="{value}"' for name, value in entries.items())
        text = f'<mass value="2"/><inertia {words}/>'
    link = ElementTree.fromstring(f'<link name="l"><inertial>{text}</inertial></link>')
    model = ModelRepair(tmp_path, None, ModelPurpose(), tmp_path)
    repair_inertia_and_detect_missing(link, model, is_sdf=is_sdf, is_fixed=False)
    element = link.find("inertial/inertia")
    nearest, change = nearest_possible_inertia(inertia)
    assert (change > 0.0) == (izz == 0.09)
    for (name, _), value in zip(entries.items(), nearest[np.triu_indices(3)], strict=True):
        assert float(element.get(name) or element.findtext(name)) == pytest.approx(value)
