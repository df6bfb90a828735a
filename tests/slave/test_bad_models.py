"""Faulty models cause one error that names the fault, or an assumption."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest
from pydrake.multibody.plant import MultibodyPlant

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.station.slave.home import (
    check_inertia_and_holding_torque,
    find_start_posture,
    home_posture,
)
from drake_teleop.station.slave.inverse_kinematics import IkStatus
from drake_teleop.station.slave.numeric_inverse_kinematics import find_posture
from drake_teleop.station.slave.plant import (
    NominalSlave,
    ParseSlave,
    finalize_without_limit_warnings,
)
from drake_teleop.station.slave.slave_config import Slave, Tool

AXES = ["0 0 1", "0 1 0", "0 1 0", "0 0 1", "0 1 0", "0 0 1"]
HOME = [0.1, 0.4, 1.2, 0.2, 1.4, 0.3]
LIMIT = '<limit lower="-2.5" upper="2.5" velocity="3" effort="200"/>'
MASS, INERTIA = '<mass value="2"/>', 'ixx="0.02" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.01"'
INERTIAL = f'<inertial><origin xyz="0 0 0.1"/>{MASS}<inertia {INERTIA}/></inertial>'


def link(name, inside=INERTIAL):
    return f'<link name="{name}">{inside}</link>'


def joint(k, kind="revolute", inside="", parent=None, child=None, name=None, tag="joint"):
    return (
        f'<{tag} name="{name or f"j{k}"}" type="{kind}"><parent link="{parent or f"l{k - 1}"}"/>'
        f'<child link="{child or f"l{k}"}"/><origin xyz="0 0 0.25"/>'
        f'<axis xyz="{AXES[(k - 1) % 6]}"/>{LIMIT}{inside}</{tag}>'
    )


def arm(joints=6, beyond="", j3=None, l3=None, l0=None):
    """Return a URDF with the given third joint and link."""
    parts = [l0 or link("l0")]
    for k in range(1, joints + 1):
        parts += [j3 if j3 and k == 3 else joint(k), l3 if l3 and k == 3 else link(f"l{k}")]
    return f'<robot name="arm" xmlns:drake="d">{"".join(parts)}{beyond}</robot>'


def with_limit(text):
    return arm(j3=joint(3).replace(LIMIT, text))


def with_inertial(*changes):
    inside = INERTIAL
    for old, new in changes:
        inside = inside.replace(old, new)
    return arm(l3=link("l3", inside))


def scaled(factor):
    return re.sub(r'xyz="0 0 (0\.\d+)"', lambda m: f'xyz="0 0 {factor * float(m[1]):g}"', arm())


def shaped(geometry):
    return arm(l3=link("l3", INERTIAL + f"<collision><geometry>{geometry}</geometry></collision>"))


def adding(*models):
    added = ", ".join(f"{{add_model: {{name: m{k}, file: {m}}}}}" for k, m in enumerate(models))
    return f"directives: [{added}]"


def mjcf(bodies, rest=""):
    return f"<mujoco model='m'><worldbody>{bodies}</worldbody>{rest}</mujoco>"


def sdf(inside, version="1.7"):
    return f"<sdf version='{version}'><model name='m'>{inside}</model></sdf>"


def sdf_joint(kind, axis="<axis><xyz>0 0 1</xyz></axis>"):
    ends = "<parent>l0</parent><child>l6</child>"
    return f"<link name='l0'/><link name='l6'/><joint name='j' type='{kind}'>{ends}{axis}</joint>"


def read(slave):
    """Read the slave as `run` and `new` do; return the assumptions."""
    slave.check("slave")
    plant = MultibodyPlant(0.0)
    parsed = ParseSlave(plant, slave)
    finalize_without_limit_warnings(plant)
    model, assumed = parsed.arm()
    check_inertia_and_holding_torque(model, find_start_posture(slave, model))
    return [*parsed.assumptions, *assumed]


TWO = mjcf(
    "<body name='b'><joint name='a'/><geom size='.1'/><body name='l6' pos='0 0 1'>"
    "<joint name='c' axis='0 1 0'/><geom size='.1'/></body></body>{}"
)
FINGER = joint(9, parent="l5", child="f", inside='<mimic joint="j2"/>') + link("f")
WORLD_NAME = link("world", "") + link("l0")
BALL = '<drake:joint name="j3" type="ball"><parent link="l2"/><child link="l3"/></drake:joint>'
ANOTHER = re.sub("</?robot.*?>", "", arm()).replace('="l', '="m').replace('="j', '="k')
DAMPED = '<dynamics damping="-1"/>'
ROTOR = '<transmission type="SimpleTransmission"><joint name="j3"/><actuator name="a">{}</actuator>'
ROTOR += "</transmission>"
OF_GEAR = ROTOR.format('<drake:rotor_inertia value="-1"/>')
IMPOSSIBLE = "an impossible inertia left out, as no joint of the arm moves the link, of "

ERRORS = {
    # Files
    "empty": ("urdf", "", "arm.urdf: is not XML"),
    "broken XML": ("urdf", arm()[:300], "arm.urdf: is not XML"),
    "binary": ("urdf", "\x00\x01", "arm.urdf: is not XML"),
    "two arms after each other": ("urdf", arm() + arm(), "is not XML .junk after"),
    "no robot": ("urdf", "<machine/>", "does not contain a robot tag"),
    "URDF called SDF": ("sdf", arm(), "arm.sdf: cannot be read as a robot"),
    "URDF called MJCF": ("xml", arm(), "does not contain a mujoco tag"),
    "no such kind": ("usda", "#usda 1.0", "give a URDF, SDF, MJCF.*not a recognized type"),
    "a macro by its name": ("urdf.xacro", arm(),
                            "is a xacro file, not a model; expand it first"),
    "a macro by what is in it": ("urdf", '<robot name="a" xmlns:xacro="x"><xacro:arm/></robot>',
                                 "arm.urdf: is a xacro file, not a model; expand it first"),
    "a property that is used": ("urdf", with_inertial((MASS, '<mass value="${m}"/>')).replace(
        "<link", '<xacro:property name="m" value="2"/><link', 1), "is a xacro file"),
    "a macro's number": ("urdf", with_inertial((MASS, '<mass value="${m}"/>')),
                         "link l3: mass ..m. kg is not between 0 and.*; expand it first"),
    "a macro's length": ("urdf", arm(j3=joint(3).replace('xyz="', 'xyz="${h} ', 1)),
                         "joint j3: xyz of origin is '..h.*; expand it first"),
    "a macro's limits": ("urdf", arm().replace('effort="', 'effort="$(arg e)'),
                         "j2: effort limit '..arg e.*; expand it first"),
    # Trees
    "a loop": ("urdf", arm(beyond=joint(9, parent="l6", child="l2")),
               "l2 is the child of two joints, j2 and j9"),
    "a circle": ("urdf", arm(j3=joint(3, parent="l5")), "joints form a loop through l"),
    "a joint on itself": ("urdf", arm(j3=joint(3, parent="l3")), "a loop through l3"),
    "a bushing": ("urdf", arm(beyond="<drake:linear_bushing_rpy/>"), "drake:.* closes a loop"),
    "no parent": ("urdf", arm(j3=joint(3).replace('<parent link="l2"/>', "")),
                  "joint j3 has no parent link"),
    "no such parent": ("urdf", arm(j3=joint(3, parent="zz")),
                       "joint j3: the parent link 'zz' does not exist"),
    "links of one name": ("urdf", arm(beyond=FINGER.replace('"f"', '"l2"')),
                          "two links are named l2"),
    "a link without name": ("urdf", arm(l3="<link/>"),
                            "2 faults: .1. joint j3: the child link 'l3' does not exist; .2. jo"),
    # Joints
    "mimic": ("urdf", arm(j3=joint(3, inside='<mimic joint="j2"/>')), "j3 moves with another"),
    "planar": ("urdf", arm(j3=joint(3, "planar")), "j3 is a planar joint, .*; up to the"),
    "ball": ("urdf", arm(j3=BALL), "j3 is a ball joint, .*; up to the sensor"),
    "screw": ("urdf", arm(j3=joint(3, "screw", '<drake:screw_thread_pitch value="1"/>',
                                   tag="drake:joint")), "j3 is a screw joint"),
    "floating in the chain": ("urdf", arm(j3=joint(3, "floating")), "j3 is a floating joint on l2"),
    "no such type": ("urdf", arm(j3=joint(3, "hinge")), "j3 is a hinge joint, which is .*; up to"),
    "an axis of no length": ("urdf", arm(j3=joint(3).replace("0 1 0", "0 0 0")),
                             "joint j3: axis '0 0 0' is no direction"),
    "an axis of two numbers": ("urdf", arm(j3=joint(3).replace("0 1 0", "0 1")),
                               "joint j3: axis '0 1' is no direction"),
    "an origin that is none": ("urdf", arm(j3=joint(3).replace("0.25", "nan")),
                               "origin nan is no finite number"),
    "a motor's negative inertia": ("urdf", arm(beyond=OF_GEAR), "a rotor inertia of -1 kg"),
    # Limits
    "lower above upper": ("urdf", with_limit('<limit lower="2" upper="-2"/>'),
                          "joint j3: lower limit 2 is above upper limit -2"),
    "a range of nothing": ("urdf", with_limit('<limit lower="1" upper="1"/>'),
                           "j3 cannot move: both of its limits are 1 rad"),
    "a limit that is none": ("urdf", with_limit('<limit lower="nan" upper="1"/>'),
                             "joint j3: lower limit 'nan' is not a number"),
    "a negative speed": ("urdf", with_limit('<limit velocity="-1"/>'), "velocity limit -1 is neg"),
    # Masses
    "a negative mass": ("urdf", with_inertial(('"2"', '"-2"')), "mass -2 kg is not between 0"),
    "a mass that is none": ("urdf", with_inertial(('"2"', '"nan"')), "l3: mass nan kg is not"),
    # Units
    "in mm": ("urdf", scaled(1000), "is 1.25e.03 m long; give lengths in m"),
    "in km": ("urdf", scaled(0.001), "is 0.00125 m long; give lengths in m"),
    "inertia in kg mm^2": ("urdf", with_inertial(('"0.02"', '"2e4"'), ('"0.01"', '"1e4"')),
                           r"the mass that j\d moves is \d+\.?\d* m away from j\d"),
    # MJCF, SDF, directives
    "MJCF without bodies": ("xml", mjcf(""), "no frames are named 'l6'; give a model"),
    "MJCF of a loop": ("xml", TWO.format("").replace(
        "</mujoco>", "<equality><weld body1='l6'/></equality></mujoco>"),
        "weld equality closes a loop"),
    "MJCF of tied joints": ("xml", TWO.format("").replace(
        "</mujoco>", "<equality><joint joint1='a' joint2='c'/></equality></mujoco>"),
        "a moves with another joint .equality"),
    "MJCF without its other file": ("xml", "<mujoco><include file='x.xml'/></mujoco>",
                                    "included file 'x.xml' was not found"),
    "SDF of two models": ("sdf", sdf("</model><model name='n'>"), "cannot be read as a robot"),
    "SDF of the future": ("sdf", sdf("", "99"), "Unable to convert from SDF version 99"),
    "SDF without an axis": ("sdf", sdf(sdf_joint("revolute", "")), "axis must be specified for"),
    "SDF of a mimic": ("sdf", sdf(sdf_joint("revolute", "<axis><xyz>0 0 1</xyz><mimic joint='j'>"
                       "<multiplier>1</multiplier></mimic></axis>")), "j moves with another"),
    "SDF of a gearbox": ("sdf", sdf(sdf_joint("gearbox")), "j is a gearbox joint"),
    "SDF of a fixed arm": ("sdf", sdf(sdf_joint("fixed")),
                           "sensor_frame: no joint moves l6: all joints"),
    "directives that are none": ("dmd.yaml", "directives: [{add_modell: {}}]",
                                 "arm.dmd.yaml:1:14: YAML"),
    "directives with a field too many": ("dmd.yaml", "directives: [{add_model: {name: a, file: "
                                         "file:///a.urdf, color: red}}]", "color"),
    "directives to nothing": ("dmd.yaml", adding("file:///none/a.urdf"), "does not exist"),
    "directives that are broken": ("dmd.yaml", "directives: [{", "arm.dmd.yaml: is not YAML"),
    "directives to two arms": ("dmd.yaml", adding("{good}", "{good}"), "2 frames are named 'l6'"),
}  # fmt: skip
ASSUMED = {
    "nothing": (arm(), "acceleration limits that reach full speed"),
    "no limits": (arm().replace(LIMIT, ""), "unlimited rotation for all joints"),
    "no range": (with_limit("<limit/>"), "unlimited rotation for j3"),
    "continuous": (with_limit("").replace('"j3" type="revolute"', '"j3" type="continuous"'),
                   "unlimited rotation for j3"),
    "no speed": (with_limit('<limit velocity="0" effort="200"/>'), "a speed limit of .* for j3"),
    "no strength": (with_limit('<limit velocity="3" effort="0"/>'), "no torque limit for j3"),
    "only an upper limit": (with_limit('<limit upper="2" velocity="3" effort="200"/>'),
                            "^a range of 360 degrees from the only limit for j3"),
    "only a lower limit": (with_limit('<limit lower="-2" velocity="3" effort="200"/>'),
                           "^a range of 360 degrees from the only limit for j3"),
    "limits in degrees": (with_limit('<limit lower="-170" upper="170"/>'),
                          "limits in rad, though more than 25.13 apart, for j3"),
    "massless": (arm(l3=link("l3", "")), "no inertia of l3; a rotor inertia of 0.219 kg m.2,"
                 " as the model has no inertia there, for j3"),
    "massless altogether": (re.sub("<inertial>.*?</inertial>", "", arm()),
                            "no inertia of l1, l2, l3, l4, l5, l6; a rotor inertia .*, j5, j6"),
    "a mass without an inertia": (with_inertial((f"<inertia {INERTIA}/>", "")), "no inertia of l3"),
    "an inertia without mass": (with_inertial(('"2"', '"0"')),
                                "left out, because the mass is 0, of link l3; a rotor inertia"),
    "a negative inertia": (with_inertial(('ixx="0.02"', 'ixx="-0.02"')),
                           "warning: inertia replaced by the nearest .* of link l3 .117 %."),
    "no triangle": (with_inertial(('izz="0.01"', 'izz="0.05"')),
                    "warning: inertia replaced by the nearest .* of link l3 .6.67 %."),
    "hardly a triangle": (with_inertial(('izz="0.01"', 'izz="0.0403"')),
                          "^inertia replaced by the nearest .* of link l3 .0.248 %."),
    "nearly a triangle": (with_inertial(('izz="0.01"', 'izz="0.046"')),
                          "^inertia replaced by the nearest .* of link l3 .4.35 %."),
    "no triangle of what hangs on the arm": (
        arm(beyond=link("x", INERTIAL.replace('izz="0.01"', 'izz="0.05"'))
            + joint(8, parent="l2", child="x")), "inertia replaced by .* of link x .6.67 %."),
    "two arms in one robot": (arm(beyond=ANOTHER), "left out: m0, m1, m2, m3, m4, m5, m6"),
    "a second root": (arm(beyond=link("cup")), "not connected to the arm and left out: cup"),
    "joints of one name": (arm(j3=joint(3, name="j2")), "a unique name for joint j2 .j2_3."),
    "a joint without name": (arm(j3=joint(3).replace('name="j3" ', "")), "without name .joint_3."),
    "a loop beside the arm": (arm(beyond=FINGER + joint(10, parent="l2", child="f")),
                              "left out, as it closes a loop or has no child: j9; held: j10"),
    "damping that drives": (arm(j3=joint(3, inside=DAMPED)), "damping is 0, not .* joint j3"),
    "two motors": (arm(beyond=2 * ROTOR.format("")), "^acceleration limits"),
    "an infinite limit": (with_limit('<limit effort="inf" lower="-2" upper="2"/>'),
                          "no torque limit for j3"),
    "an inertia of rounded numbers": (with_inertial(('izz="0.01"', 'izz="0.040001"')),
                                      "rounding errors in the inertia are corrected, of link l3"),
    "a base of an impossible inertia": (arm(l0=link("l0", INERTIAL.replace("0.01", "0.05"))),
                                        IMPOSSIBLE + "l0"),
    "the same of a base that is screwed down": (
        arm(l0=link("mount", "") + joint(1, "fixed", "", "mount", "l0", "bolts")
            + link("l0", INERTIAL.replace("0.01", "0.05"))), IMPOSSIBLE + "l0"),
    "an impossible inertia beside the arm": (
        arm(beyond=link("x", INERTIAL.replace('ixx="0.02"', 'ixx="-2"'))
            + joint(8, parent="l0", child="x")), IMPOSSIBLE + "x"),
    "an inertia that is rounding": (
        with_inertial(('ixx="0.02" ixy="0"', 'ixx="0" ixy="2e-35"'), ('"0.02"', '"0"'),
                      ('"0.01"', '"0"')), "errors in the inertia are corrected, of link l3"),
    "a mesh missing": (shaped('<mesh filename="package://none/a.stl"/>'),
                       "shapes are missing of l3: meshes were not found .--package-path"),
    "a mesh with a scale of two numbers": (shaped('<mesh filename="arm.urdf" scale="1 1"/>'),
                                           "missing of l3: a pose or scale is no list of finite"),
    "a shape with a pose of two numbers": (
        shaped('<sphere radius="1"/></geometry><origin xyz="0 0"/><geometry>'),
        "missing of l3: a pose or scale is no list of finite numbers"),
    "a mesh of no kind": (shaped('<mesh filename="arm.urdf"/>'), ".urdf meshes cannot be read"),
    "a finger": (arm(beyond=FINGER), "held: j9"),
    "a motor of another joint": (arm(beyond=ROTOR.format("").replace("j3", "j33")),
                                 "^acceleration limits"),
    "a fixed finger that moves with a joint": (arm(beyond=FINGER.replace("revolute", "fixed")),
                                               "acceleration limits"),
    "a base that floats": (arm(l0=WORLD_NAME + joint(1, "floating", "", "world", "l0", "free")),
                           "welded to the world instead of floating: l0"),
    "dry friction": (arm(j3=joint(3, inside='<dynamics friction="2"/>')),
                     "no effect of the dry friction in the file on j3"),
    "four joints": (arm(4).replace('"l4"', '"l6"'), "with 4 joints the tool follows only part"),
    "nine joints": (arm(9).replace('"l6"', '"x"').replace('"l9"', '"l6"'), "acceleration limits"),
}  # fmt: skip


@pytest.mark.parametrize("case", ERRORS)
def test_faulty_model_raises_one_error(tmp_path, case):
    suffix, text, expected = ERRORS[case]
    path, other = tmp_path / f"arm.{suffix}", tmp_path / "other.urdf"
    tool = Tool(mass=1.0)
    if suffix in ("dmd.yaml", "sdf"):
        text = text.replace("{good}", other.as_uri())
        other.write_text(arm())
    if "without a tool" in case:
        tool = Tool(mass=1e-9)
    path.write_text(text)
    with pytest.raises(DrakeTeleopError, match=expected) as error:
        read(Slave(model=str(path), sensor_frame="l6", home=HOME, tool=tool))
    said = str(error.value)
    assert said.startswith((str(path), str(other), "slave.", "sensor_frame: "))
    assert "\n" not in said


@pytest.mark.parametrize("case", ASSUMED)
def test_missing_data_become_named_assumptions(tmp_path, case):
    path = tmp_path / "arm.urdf"
    path.write_text(ASSUMED[case][0])
    joints = {"four joints": 4, "nine joints": 9}.get(case, 6)
    home = (HOME + 3 * [0.1])[:joints]
    assumed = read(Slave(model=str(path), sensor_frame="l6", home=home, tool=Tool(mass=1.0)))
    assert re.search(ASSUMED[case][1], "; ".join(assumed))


def test_start_posture_avoids_joint_limits(tmp_path):
    """One arm with different limits, at reachable positions."""
    path = tmp_path / "arm.urdf"
    path.write_text(arm())
    slave = Slave(model=str(path), sensor_frame="l6", home=HOME, tool=Tool(mass=1.0))
    model, rng, inside = NominalSlave(slave).arm, np.random.default_rng(0), []
    for _ in range(60):
        middle, half = rng.uniform(-1.0, 1.0, 6), rng.uniform(2.2, 3.3, 6)
        other = dataclasses.replace(model, lower=middle - half, upper=middle + half)
        position = rng.uniform([0.3, -0.2, 0.2], [0.6, 0.2, 0.7])
        first, status = find_posture(other, np.array([0.0, 1.0, 0.0, 0.0, *position]), middle)
        if status == IkStatus.OK:
            q = home_posture(other, position.tolist())
            inside.append([np.abs((x - middle) / half).max() <= 0.9 for x in (first, q)])
    of_first, of_home = np.transpose(inside)
    assert of_home[of_first].all() and of_home.sum() > 1.3 * of_first.sum()


def test_rounded_inertia_is_preserved(tmp_path):
    """Drake would replace it by that of a ball: 0.005 instead of 0.02 and 0.04 kg m^2."""
    path, plant = tmp_path / "arm.urdf", MultibodyPlant(0.0)
    path.write_text(ASSUMED["an inertia of rounded numbers"][0])
    ParseSlave(plant, Slave(model=str(path), sensor_frame="l6", home=HOME, tool=Tool(mass=1.0)))
    moments = plant.GetBodyByName("l3").default_rotational_inertia().get_moments()
    np.testing.assert_allclose(moments - 2.0 * 0.1**2 * np.array([1, 1, 0]), [0.02, 0.02, 0.04],
                               rtol=1e-4)  # fmt: skip


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"sensor_frame": "nose"}, "arm.urdf: no frames are named 'nose'; name one of l0, l1"),
        ({"sensor_frame": "l0"}, "sensor_frame: no joint moves"),
        ({"home": [], "position": [3.0, 0.0, 0.4]}, "slave.position: the arm cannot reach"),
        ({"home": [3.0, *HOME[1:]]}, "home: joint j1 at 3 is outside its limits, -2.5 to 2.5"),
        ({"home": HOME[:5]}, "slave.home: has 5 numbers, but the arm has 6 joints"),
        ({"tip": [0.0, 0.1]}, "slave.tip: has 2 numbers"),
        ({"tool": Tool(mass=90.0)}, "slave.tool: the arm cannot hold its 90 kg .* j2 needs"),
        ({"tool": Tool(model="none.sdf")}, "none.sdf: file does not exist"),
        ({"tool": None, "sensor_frame": "tcp"}, "slave.tool: no body with a mass is attached"),
    ],
)  # fmt: skip
def test_invalid_settings_of_valid_model_raise_error(tmp_path, change, expected):
    path = tmp_path / "arm.urdf"
    tcp = '<joint name="t" type="fixed"><parent link="l6"/><child link="tcp"/></joint>'
    path.write_text(arm(beyond=link("tcp", "") + tcp))
    given = {"sensor_frame": "l6", "home": HOME, "tool": Tool(mass=1.0)} | change
    with pytest.raises(DrakeTeleopError, match=expected):
        read(Slave(model=str(path), **given))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (sdf("<link name='a'/><link name='b'/>"), "one root link, but has 2: a, b"),
        (sdf("<link name='a'><inertial><mass>0</mass></inertial></link>"), "no body with a mass"),
        ("", "tool.sdf: is not XML"),
    ],
)  # fmt: skip
def test_invalid_tool_raises_error(tmp_path, text, expected):
    path, tool = tmp_path / "arm.urdf", tmp_path / "tool.sdf"
    path.write_text(arm())
    tool.write_text(text)
    with pytest.raises(DrakeTeleopError, match=expected):
        read(Slave(model=str(path), sensor_frame="l6", home=HOME, tool=Tool(model=str(tool))))
