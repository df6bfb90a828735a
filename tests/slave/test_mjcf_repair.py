"""MJCF files are read as MuJoCo reads them; expected values are closed forms of its rules."""

from __future__ import annotations

import re
import struct
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.systems.framework import DiagramBuilder
from test_model_repairs import pose, read, written

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.station.slave.arm import DAMPING_COLUMN, PHI_COLUMN, ROTOR_COLUMN
from drake_teleop.station.slave.model.meshes import Triangles
from drake_teleop.station.slave.model.mjcf_elements import Attributes, Mjcf
from drake_teleop.station.slave.model.mjcf_meshes import Mesh, fit_shape_to_mesh
from drake_teleop.station.slave.model.model_references import ModelFiles
from drake_teleop.station.slave.model.model_repair import ModelPurpose, ModelRepair
from drake_teleop.station.slave.models import ParseScene, ParseTool
from drake_teleop.station.slave.plant import NominalSlave
from drake_teleop.station.slave.slave_config import Slave, Tool

INERTIAL = '<inertial pos="0 0 0" mass="2" diaginertia="0.02 0.02 0.02"/>'
SENSOR = '<body name="S" pos="0 0 0.5"/>'
JOINT = '<joint name="j" axis="0 1 0"/>'


def mjcf(bodies: str, head: str = "", tail: str = "") -> str:
    return f"<mujoco model='m'>{head}<worldbody>{bodies}</worldbody>{tail}</mujoco>"


def arm(
    joint: str = JOINT, inside: str = "", attributes: str = "", *, inertial: str = INERTIAL
) -> str:
    """Return one moving body with the sensor 0.5 m along z."""
    return f'<body name="b" {attributes}>{inertial}{joint}{inside}{SENSOR}</body>'


def degrees(*angles: float) -> RotationMatrix:
    return RollPitchYaw(np.radians(angles)).ToRotationMatrix()


@pytest.mark.parametrize(("s", "q"), [(0.0, 0.0), (0.3, 0.4), (-0.2, -1.1)])
def test_second_joint_of_rotated_body_moves_after_the_first(tmp_path, s, q):
    """Drake takes the parent's directions for the first joint's axis."""
    joints = '<joint name="s" type="slide" axis="0 1 0"/><joint name="q" axis="1 0 0"/>'
    text = mjcf(arm(joints, attributes='pos="0 0 1" euler="90 0 0"'))
    _, model, said = read(written(tmp_path, text, "a.xml"), "S")
    turned = np.pi / 2 + q
    expected = [0.0, -0.5 * np.sin(turned), 1.0 + s + 0.5 * np.cos(turned)]
    assert model.joint_names == ("s", "q")
    np.testing.assert_allclose(pose(model, [s, q])[:, 3], expected, atol=1e-12)
    assert "rotor inertia" not in said


@pytest.mark.parametrize(
    ("orientation", "compiler", "expected"),
    [
        ('quat="0 0 0 3"', "", degrees(0, 0, 180)),
        ('axisangle="0 0 2 30"', "", degrees(0, 0, 30)),
        ('euler="10 20 30"', "", degrees(10, 0, 0) @ degrees(0, 20, 0) @ degrees(0, 0, 30)),
        ('euler="10 20 30"', 'eulerseq="XYZ"', degrees(10, 20, 30)),
        ('euler="0.1 0.2 0.3"', 'angle="radian" eulerseq="zYx"',
         degrees(0, 36 / np.pi, 0) @ degrees(0, 0, 18 / np.pi) @ degrees(54 / np.pi, 0, 0)),
        ('xyaxes="0 2 0 -1 5 0"', "", degrees(0, 0, 90)),
        ('zaxis="3 0 0"', "", degrees(0, 90, 0)),
        ('zaxis="0 0 -1"', "", degrees(180, 0, 0)),
    ],
)  # fmt: skip
def test_body_orientation_is_read_in_every_form(tmp_path, orientation, compiler, expected):
    text = mjcf(arm(attributes=f'pos="1 2 3" {orientation}'), f"<compiler {compiler}/>")
    _, model, _ = read(written(tmp_path, text, "a.xml"), "S")
    found = pose(model, [0.0])
    np.testing.assert_allclose(found[:, :3], expected.matrix(), atol=1e-12)
    np.testing.assert_allclose(found[:, 3], [1, 2, 3] + expected.matrix()[:, 2] / 2, atol=1e-12)


def test_frames_and_classes_of_included_files_apply(tmp_path):
    """Poses of frames are composed; the included compiler counts; a class has its parent's axis."""
    (tmp_path / "parts").mkdir()
    inner = '<frame euler="0 0 1.5707963267948966" childclass="far">{}</frame>'.format(
        arm('<joint name="j"/>')
    )
    written(tmp_path / "parts", f"""<x><compiler angle="radian"/><default><joint axis="0 2 0"/>
        <default class="far"><joint range="-1 2" pos="0 0 0.1"/></default></default>
        <worldbody><frame pos="1 0 0">{inner}</frame></worldbody></x>""", "arm.xml")  # fmt: skip
    path = written(tmp_path, "<mujoco><include file='parts/arm.xml'/></mujoco>", "a.xml")
    _, model, said = read(path, "S")
    assert (model.lower, model.upper) == (-1.0, 2.0)
    # The joint rotates about the world's -x, through a point 0.1 m above the body's origin.
    np.testing.assert_allclose(
        pose(model, [0.7])[:, 3], [1, 0.4 * np.sin(0.7), 0.1 + 0.4 * np.cos(0.7)], atol=1e-12
    )
    assert "gets that of its file: a" in said


@pytest.mark.parametrize(
    ("joint", "compiler", "expected"),
    [
        ('range="-90 45"', "", (-np.pi / 2, np.pi / 4)),
        ('range="-1 2"', 'angle="radian"', (-1.0, 2.0)),
        ('range="-1 2" limited="false"', "", (-np.inf, np.inf)),
        ('range="-1 2"', 'autolimits="false"', (-np.inf, np.inf)),
        ('range="-90 45" limited="true"', 'autolimits="false"', (-np.pi / 2, np.pi / 4)),
        ('type="slide" range="-1 2"', "", (-1.0, 2.0)),
        ("", "", (-np.inf, np.inf)),
    ],
)
def test_position_limits_follow_the_compiler(tmp_path, joint, compiler, expected):
    text = mjcf(arm(f'<joint name="j" {joint}/>'), f"<compiler {compiler}/>")
    _, model, _ = read(written(tmp_path, text, "a.xml"), "S")
    np.testing.assert_allclose((model.lower[0], model.upper[0]), expected)


@pytest.mark.parametrize(
    ("joint", "actuator", "expected"),
    [
        ("", '<position joint="j" ctrlrange="-6.28 6.28"/>', np.inf),
        ("", '<position joint="j" ctrlrange="-6 6" forcerange="-150 150" gear="2"/>', 300.0),
        ("", '<position class="big" joint="j"/>', 87.0),
        ("", '<general class="big" joint="j" gear="2"/>', 174.0),
        ("", '<general joint="j" gainprm="3" ctrlrange="-5 4" gear="2"/>', 24.0),
        ("", '<general joint="j" biastype="affine" gainprm="9" biasprm="0 -9 0" ctrlrange="-1 1"/>',
         np.inf),
        ("", '<motor joint="j" ctrlrange="-1 1" gear="-30"/>', 30.0),
        ("", '<motor joint="j" ctrlrange="-9 9" forcerange="-4 4"/>', 4.0),
        ("", '<motor joint="j" ctrlrange="-9 9" ctrllimited="false"/>', np.inf),
        ("", '<velocity joint="j" ctrlrange="-9 9"/>', np.inf),
        ('actuatorfrcrange="-12 12"', '<motor joint="j" ctrlrange="-1 1" gear="30"/>', 12.0),
        ('actuatorfrcrange="-12 12"', "", 12.0),
        ("", '<motor joint="j" ctrlrange="-2 2"/><motor joint="j" ctrlrange="-3 3"/>', 5.0),
        ("", '<motor joint="j" forcerange="0 7"/>', 7.0),
    ],
)  # fmt: skip
def test_effort_limit_is_the_largest_force_of_the_actuators(tmp_path, joint, actuator, expected):
    classes = '<default><default class="big"><general forcerange="-87 87"/></default></default>'
    text = mjcf(
        arm(f'<joint name="j" armature="0.3" damping="4" {joint}/>'),
        classes,
        f"<actuator>{actuator}</actuator>",
    )
    _, model, _ = read(written(tmp_path, text, "a.xml"), "S")
    np.testing.assert_allclose(model.effort_limit[0], expected)
    np.testing.assert_allclose(model.table[0, [ROTOR_COLUMN, DAMPING_COLUMN]], [0.3, 4.0])


# Volume, and principal moments by volume, of shapes.
PI = np.pi
SHAPES = {
    'type="sphere" size="0.1"': (4e-3 / 3 * PI, [0.004, 0.004, 0.004]),
    'type="box" size="0.1 0.2 0.3"': (0.048, [0.13 / 3, 0.1 / 3, 0.05 / 3]),
    'type="ellipsoid" size="0.1 0.2 0.3"': (8e-3 * PI, [0.13 / 5, 0.1 / 5, 0.05 / 5]),
    'type="cylinder" size="0.1 0.3"': (6e-3 * PI, [0.0025 + 0.03, 0.0325, 0.005]),
    # Cylinder of 6e-3 pi and two half spheres of 2e-3/3 pi.
    'type="capsule" size="0.1 0.3"': (
        22e-3 / 3 * PI,
        np.array([6 * 0.0325 + 4 / 3 * (0.004 + 0.09 + 0.0225)] * 2 + [0.03 + 4 / 3 * 0.004])
        / (22 / 3),
    ),
    'type="box" fromto="0 0 -0.2 0 0 0.2" size="0.1"': (0.016, [0.05 / 3, 0.05 / 3, 0.02 / 3]),
    'class="small"': (0.008, [0.02 / 3, 0.02 / 3, 0.02 / 3]),
    'type="mesh" mesh="cube"': (0.001, [0.01 / 6, 0.01 / 6, 0.01 / 6]),
    'type="mesh" mesh="beam"': (0.006, [0.13 / 12, 0.1 / 12, 0.05 / 12]),
    'type="sphere" mesh="cube"': (PI / 6e3, [0.001, 0.001, 0.001]),
}
CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * 0.1 - 0.05
FACES = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7],
                  [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]])  # fmt: skip
CLASSES = (
    '<default><default class="small"><geom type="box" size="0.1 0.1 0.1"/></default></default>'
)


def write_cube(folder, suffix, offset=0.0):
    """Write a cube of 0.1 m, in a format that Drake does not read or in OBJ."""
    vertices = CORNERS + offset
    corners = vertices[FACES].astype("<f4")
    if suffix == "stl":
        rows = [struct.pack("<3f", 0, 0, 0) + row.tobytes() + b"\0\0" for row in corners]
        data = bytes(80) + struct.pack("<I", len(FACES)) + b"".join(rows)
    elif suffix == "msh":
        counts = struct.pack("<4i", len(vertices), 0, 0, len(FACES))
        data = counts + vertices.astype("<f4").tobytes() + FACES.astype("<i4").tobytes()
    else:
        rows = ["v {} {} {}".format(*row) for row in vertices]
        rows += ["f {}/1 {}/1 {}/1".format(*(row + 1)) for row in FACES]
        data = "\n".join(rows).encode()
    (folder / f"cube.{suffix}").write_bytes(data)


@pytest.mark.parametrize(
    ("shape", "suffix"),
    [
        *((shape, "stl") for shape in SHAPES),
        *(('type="mesh" mesh="beam"', s) for s in ("msh", "obj")),
    ],
)
def test_mass_and_moments_of_shapes_are_closed_forms(tmp_path, shape, suffix):
    """The second moments are those about the joint, 0.4 m below the shape."""
    (tmp_path / "parts").mkdir()
    write_cube(tmp_path / "parts", suffix, offset=1.0)
    scaled = '<mesh name="beam" inertia="exact" scale="1 -2 3" refpos="1 1 1" file="cube.{0}"/>'
    assets = f'<asset><mesh file="cube.{{0}}" refpos="1 1 1"/>{scaled}</asset>'.format(suffix)
    head = f'<compiler meshdir="parts"/>{CLASSES}{assets}'
    geom = f'<body pos="0 0 0.4"><geom {shape}/></body>'
    text = mjcf(arm(inside=geom, inertial=""), head)
    _, model, _ = read(written(tmp_path, text, "a.xml"), "S", shapes=True)
    volume, moments = SHAPES[shape]
    mass = 1000.0 * volume
    joint_frame = model.table[0, PHI_COLUMN : PHI_COLUMN + 10]
    np.testing.assert_allclose(joint_frame[0], mass, rtol=1e-5)
    # The joint's axis, y, is z of its frame.
    np.testing.assert_allclose(joint_frame[9], mass * (moments[1] + 0.16), rtol=1e-5)
    across = np.sort(mass * np.array([moments[0] + 0.16, moments[2]]))
    np.testing.assert_allclose(np.sort(joint_frame[[4, 7]]), across, rtol=1e-5)


@pytest.mark.parametrize(
    ("kind", "by_box", "expected"),
    [
        ("box", False, [0.05, 0.1, 0.15]),
        ("ellipsoid", True, [0.05, 0.1, 0.15]),
        ("sphere", False, [0.1, 0.0, 0.0]),
        ("sphere", True, [0.15, 0.0, 0.0]),
        ("cylinder", False, [0.075, 0.15, 0.0]),
        ("cylinder", True, [0.1, 0.15, 0.0]),
        ("capsule", False, [0.075, 0.1125, 0.0]),
        ("capsule", True, [0.1, 0.05, 0.0]),
    ],
)
@pytest.mark.parametrize("sides", [(1, 2, 3), (3, 1, 2), (2, 3, 1)])
def test_primitive_replaces_a_mesh_with_its_pose_and_size(kind, by_box, expected, sides):
    """A box of 0.1 x 0.2 x 0.3 m, in any order and orientation; z is the longest axis."""
    X = RigidTransform(degrees(10, 20, 30), [0.4, -0.5, 0.6])
    triangles = Triangles(X.multiply((CORNERS * sides).T).T, FACES)
    mesh = SimpleNamespace(triangles=triangles, inertia="exact")
    X_found, size = fit_shape_to_mesh(mesh, kind, by_box=by_box)
    np.testing.assert_allclose(size, expected, atol=1e-12)
    np.testing.assert_allclose(X_found.translation(), X.translation(), atol=1e-12)
    longest = X.rotation().matrix()[:, sides.index(3)]
    assert abs(longest @ X_found.rotation().matrix()[:, 2]) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("attributes", "file", "expected"),
    [
        ({}, "a.obj", True),
        ({"scale": "1 1 1", "refpos": "0 0 0"}, "a.OBJ", True),
        ({}, "a.stl", False),
        ({"scale": "1 1 -1"}, "a.obj", False),
        ({"refpos": "0 0 1"}, "a.obj", False),
        ({"refquat": "0 1 0 0"}, "a.obj", False),
    ],
)
def test_mesh_that_drake_can_read_is_recognized(tmp_path, attributes, file, expected):
    path = written(tmp_path, mjcf(""), "a.xml")
    model = ModelRepair(path, ModelFiles(path, ()), ModelPurpose(), tmp_path)
    mesh = Mesh(Mjcf(model), Attributes(attributes, "mesh", model), Path(file))
    assert mesh.is_readable_by_drake == expected


@pytest.mark.parametrize(
    ("mode", "expected"),
    [
        ("exact", 7.0),  # a square of 3 x 3 without 1 x 2, 1 thick
        ("convex", 9.0),
        ("shell", 2 * 7.0 + 16.0),  # two sides and the edge
        # Tetrahedra between the centre and all triangles, also those that face it: MuJoCo 4.0.
        ("legacy", 8.61754009),
    ],
)
def test_mass_of_a_non_convex_mesh_follows_its_inertia_mode(tmp_path, mode, expected):
    outline = [(0, 0), (3, 0), (3, 3), (2, 3), (2, 1), (1, 1), (1, 3), (0, 3)]
    vertices = [(x, y, z) for z in (0, 1) for x, y in outline]
    lower = [(4, 1, 0), (5, 4, 0), (3, 2, 1), (4, 3, 1), (6, 5, 0), (7, 6, 0)]
    faces = [*lower, *((c + 8, b + 8, a + 8) for a, b, c in lower)]
    for k in range(8):
        following = (k + 1) % 8
        faces += [(k, following, following + 8), (k, following + 8, k + 8)]
    vertex, face = (" ".join(map(str, np.ravel(each))) for each in (vertices, faces))
    asset = f'<asset><mesh name="u" inertia="{mode}" vertex="{vertex}" face="{face}"/></asset>'
    geom = '<geom type="mesh" mesh="u" density="1"/>'
    _, model, _ = read(written(tmp_path, mjcf(arm(inside=geom, inertial=""), asset), "a.xml"), "S")
    np.testing.assert_allclose(model.table[0, PHI_COLUMN], expected, rtol=1e-7)


@pytest.mark.parametrize(
    ("compiler", "moments", "expected"),
    [
        ("", "0.02 0.03 0.04", 0.03),
        ('boundinertia="0.035"', "0.02 0.03 0.04", 0.035),
        ('balanceinertia="true"', "0.02 0.03 0.10", 0.05),
    ],
)
def test_compiler_bounds_and_balances_inertia(tmp_path, compiler, moments, expected):
    """The joint rotates about y."""
    inertial = f'<inertial pos="0 0.1 0" mass="1" diaginertia="{moments}"/>'
    text = mjcf(arm(inertial=inertial), f"<compiler {compiler}/>")
    _, model, said = read(written(tmp_path, text, "a.xml"), "S")
    np.testing.assert_allclose(model.table[0, PHI_COLUMN + 9], expected)
    assert "inertia replaced" not in said


@pytest.mark.parametrize(
    ("compiler", "geoms", "expected"),
    [
        ("", '<geom size="0.1" mass="0.7"/><geom size="0.2" mass="0"/>', 0.7),
        ("", '<geom size="0.1" mass="0.7"/>' + INERTIAL, 2.0),
        ('inertiafromgeom="true"', '<geom size="0.1" mass="0.7"/>' + INERTIAL, 0.7),
        ('inertiagrouprange="1 2"', '<geom size="1"/><geom size="1" mass="3" group="2"/>', 3.0),
        ('boundmass="2.5"', '<geom size="0.1" mass="0.7"/>', 5.0),  # also of the sensor's body
        ('settotalmass="6"', '<geom size="0.1" mass="0.7"/>', 4.2),  # of 1 kg in the file
    ],
)
def test_compiler_sets_the_mass(tmp_path, compiler, geoms, expected):
    cup = '<body><freejoint/><geom size="0.1" mass="0.3"/></body>'
    text = mjcf(arm(inside=geoms, inertial="") + cup, f"<compiler {compiler}/>")
    _, model, said = read(written(tmp_path, text, "a.xml"), "S")
    np.testing.assert_allclose(model.table[:, PHI_COLUMN].sum(), expected)
    assert "elements beside the arm are left out: a body without name" in said


@pytest.mark.parametrize(("sensor", "beyond"), [("", 0.0), ("force", 3.0), ("torque", 3.0)])
def test_site_is_the_sensor_frame(tmp_path, sensor, beyond):
    """The site of a force sensor carries its body, as in MuJoCo; another one is on its body."""
    hand = (
        '<body name="h" pos="0 0 1" euler="0 0 90"><joint name="k" axis="1 0 0"/>'
        '<site class="s" name="site"/><geom size="0.1" mass="2"/>'
        '<body name="g"><geom size="0.1" mass="1"/></body></body>'
    )
    classes = (
        '<default><default class="s"><site pos="0.1 0.2 0" euler="0 90 0"/></default></default>'
    )
    tail = f'<sensor><{sensor} site="site"/></sensor>' if sensor else ""
    _, model, said = read(written(tmp_path, mjcf(arm(inside=hand), classes, tail), "a.xml"), "site")
    assert model.joint_names == ("j", "k")
    assert "in place of the site site" in said
    np.testing.assert_allclose(model.table[:, PHI_COLUMN], [2.0, 3.0 - beyond, beyond])
    # Mass times centre: 0.1 m along -z of S, 0.2 m along -y.
    centre = beyond * np.array([0, -0.2, -0.1])
    np.testing.assert_allclose(model.table[2, PHI_COLUMN + 1 : PHI_COLUMN + 4], centre, atol=1e-12)
    turned = RigidTransform(degrees(0, 0, 90) @ degrees(40, 0, 0), [0, 0, 1])
    expected = turned @ RigidTransform(degrees(0, 90, 0), [0.1, 0.2, 0])
    found = pose(model, [0.0, np.radians(40)])
    np.testing.assert_allclose(found, expected.GetAsMatrix34(), atol=1e-12)


FINGERS = (
    '<body name="f"><joint name="f" type="slide" ref="0.02"/><geom size="0.01"/></body>'
    '<body name="g"><joint name="g"/><geom size="0.01"/></body>'
)
BESIDE = (
    '<body name="cup"><freejoint/><replicate count="3"/><geom size="0.1"/></body>'
    '<body name="hand of god" mocap="true"/>'
)


@pytest.mark.parametrize(
    ("joint", "inside", "tail", "expected"),
    [
        (JOINT, FINGERS, "", "held: f, g"),
        (JOINT, FINGERS, '<equality><connect body1="f" body2="g" anchor="0 0 0"/></equality>',
         "no effect on the arm of the equality constraint connect"),
        (JOINT, FINGERS, '<equality><joint joint1="f" joint2="j"/></equality>',
         "no effect on the arm of the equality constraint f and j"),
        (JOINT, "", '<equality><weld name="w" body1="S" body2="hand of god"/></equality>',
         "no effect on the arm of the equality constraint w"),
        (JOINT, "", '<tendon><fixed><joint joint="j" coef="1"/></fixed></tendon>',
         "no effect of the tendons in the file on j"),
        (JOINT.replace("/>", ' stiffness="5"/>'), "", "", "no effect of the spring in .* on j"),
        (JOINT.replace("/>", ' frictionloss="5"/>'), "", "", "dry friction in .* on j"),
        (JOINT.replace("/>", ' damping="-0.01"/>'), "", "", "damping is 0, not negative.* joint j"),
        (JOINT, '<geom type="mesh" mesh="none"/>', "", r"not found \(.*shapes are missing of b"),
        (JOINT, '<body name="flat"><inertial pos="0 0 0" mass="1" diaginertia="1 1 2.5"/></body>',
         "", r"warning: inertia replaced by the nearest .* of link flat \(6.67 %\)"),
        *((JOINT, f'<body name="flat">{INERTIAL.replace("0.02 0.02 0.02", f"1 1 {z}")}</body>', "",
           expected) for z, expected in (
            (2.0045, "rounding errors in the inertia are corrected, of link flat"),
            (2.009, r"(^|; )inertia replaced by the nearest .* of link flat \(0.149 %\)"),
            (2.28, r"(^|; )inertia replaced by the nearest .* of link flat \(4.09 %\)"))),
        (JOINT, '<body name="p"><inertial pos="0 0 0" mass="0" diaginertia="1 1 1"/></body>', "",
         "inertia is left out, because the mass is 0, of link p"),
        (JOINT, "", '<option gravity="0 0 0"/>', r"gravity is 9.81 m/s\^2, not the file's 0 0 0"),
        (JOINT, '<geom type="hfield" hfield="h"/>', "", "hfield are not supported; .* of b"),
    ],
)  # fmt: skip
def test_repair_is_stated(tmp_path, joint, inside, tail, expected):
    text = mjcf(arm(joint, inside) + BESIDE, tail=tail)
    _, model, said = read(written(tmp_path, text, "a.xml"), "S", shapes=True)
    assert re.search(expected, said)
    assert "beside the arm are left out: cup, hand of god" in said
    np.testing.assert_allclose(pose(model, [0.3])[:, 3], [np.sin(0.3) / 2, 0, np.cos(0.3) / 2])


def test_held_joint_has_the_drawn_or_requested_pose(tmp_path):
    """A joint with `ref` is drawn at this position."""
    lift = '<body name="lift"><joint name="lift" type="slide" axis="0 0 3" ref="0.2"/>{}</body>'
    path = written(tmp_path, mjcf(lift.format(INERTIAL + arm())), "a.xml")
    for hold, height in (({"lift": 0.5}, 0.3), ({"lift": 0.1}, -0.1), ({}, None)):
        _, model, _ = read(path, "S", hold=hold)
        q, z = ([0.0], height) if hold else ([0.2, 0.0], 0.0)
        np.testing.assert_allclose(pose(model, q)[:, 3], [0, 0, z + 0.5], atol=1e-12)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (mjcf(arm(inside='<replicate count="2"/>')), "b contains the unsupported <replicate>"),
        (mjcf(arm("<joint name='j' type='ball'/>")), "j is a ball joint"),
        (mjcf(arm(JOINT * 2)), "several joints are named j"),
        (mjcf(arm('<joint name="j" range="9 -9"/>')), "swap the ends of range, 9 to -9"),
        (mjcf(arm('<joint name="j" axis="0 0 1e-200"/>')), "joint j: axis has length 0"),
        (mjcf(arm('<joint name="j" class="none"/>')), "default class none is undefined"),
        (mjcf(arm(attributes='pos="0 0"')), "body b: pos '0 0' is not 3 numbers"),
        (mjcf(arm(attributes='pos="0 0 nan"')), "body b: pos '0 0 nan' is not a list"),
        (mjcf(arm(inertial=INERTIAL.replace('"2"', '"-2"'))), "body b: mass -2 kg is negative"),
        (mjcf(arm(), '<compiler coordinate="global"/>'), "coordinate='global'"),
        (mjcf(arm(), tail='<equality><weld body1="S"/></equality>'), "weld equality closes a loop"),
        (mjcf(arm(), tail='<equality><joint joint1="j"/></equality>'), "j moves with another"),
        (mjcf(arm(), '<include file="b.xml"/><include file="b.xml"/>'), "b.xml is included twice"),
        (mjcf("<frame>" * 200 + "</frame>" * 200), "nested more than 150 deep"),
        (mjcf(arm()).replace('"S"', '"T"'), "no frames are named 'S'; name one of T, b"),
    ],
)  # fmt: skip
def test_all_faults_are_in_one_error(tmp_path, text, expected):
    written(tmp_path, "<mujoco/>", "b.xml")
    with pytest.raises(DrakeTeleopError, match=re.escape(expected)) as error:
        read(written(tmp_path, text, "a.xml"), "S")
    assert str(error.value).startswith(str(tmp_path / "a.xml"))
    with_another = text.replace("<worldbody>", "<compiler boundmass='x'/><worldbody>")
    if "name one" in expected or "nested" in expected:
        return
    with pytest.raises(DrakeTeleopError, match=re.escape(expected)) as error:
        read(written(tmp_path, with_another, "a.xml"), "S")
    assert "2 faults: (1)" in str(error.value)
    assert "compiler: boundmass 'x'" in str(error.value)


def test_mesh_outside_the_folder_is_named_once(tmp_path):
    (tmp_path / "model").mkdir()
    write_cube(tmp_path, "stl")
    inside = '<geom type="mesh" mesh="cube"/><geom type="mesh" mesh="cube" mass="1"/>'
    head = '<compiler meshdir=".."/><asset><mesh file="cube.stl"/></asset>'
    path = written(tmp_path / "model", mjcf(arm(inside=inside), head), "a.xml")
    plant, _, said = read(path, "S", shapes=True)
    assert re.search(f"mesh files in {tmp_path} are outside .*; shapes are missing of b$", said)
    assert not plant.GetCollisionGeometriesForBody(plant.GetBodyByName("b"))


@pytest.mark.parametrize(
    ("attributes", "collisions", "visuals"),
    [("", 1, 1), ('group="3"', 1, 0), ('contype="0" conaffinity="0"', 0, 1)],
)
def test_stl_mesh_is_converted(tmp_path, attributes, collisions, visuals):
    write_cube(tmp_path, "stl")
    inside = f'<geom type="mesh" mesh="cube" rgba="1 0 0 1" {attributes}/>'
    text = mjcf(arm(inside=inside), '<asset><mesh file="cube.stl"/></asset>')
    plant, _, _ = read(written(tmp_path, text, "a.xml"), "S", shapes=True)
    body = plant.GetBodyByName("b")
    assert len(plant.GetCollisionGeometriesForBody(body)) == collisions
    assert len(plant.GetVisualGeometriesForBody(body)) == visuals


CUP = '<body name="cup" pos="0 0 2"><freejoint/><geom size="0.1"/></body>'
DOOR = '<body name="door"><joint name="hinge"{}/><geom type="box" size="1 1 1"/></body>'


def test_scene_keeps_its_bodies_and_refuses_what_drake_ignores(tmp_path):
    plant, _ = AddMultibodyPlantSceneGraph(DiagramBuilder(), 0.0)
    floor = '<geom type="plane" size="1 1 1"/>'
    ParseScene(plant, written(tmp_path, mjcf(floor + CUP + DOOR.format("")), "a.xml"))
    plant.Finalize()
    assert plant.num_velocities() == 7
    assert len(plant.GetCollisionGeometriesForBody(plant.world_body())) == 1
    rough = mjcf(DOOR.format(' frictionloss="0.3" range="0 90"'))
    notes = ParseScene(MultibodyPlant(0.0), written(tmp_path, rough, "c.xml"))
    for what in ("dry friction", "position limits"):
        assert f"no effect of the {what} in the file on hinge" in notes
    for door, tail, expected in (
        (DOOR.format(' stiffness="3"'), "", "springs, .* lost: hinge"),
        (DOOR.format(""), '<equality><weld body1="cup"/></equality>', "couplings .* lost: weld"),
        (DOOR.format("").replace('"box"', '"sdf"'), "", "shapes are missing of door"),
    ):
        with pytest.raises(DrakeTeleopError, match=expected):
            ParseScene(plant, written(tmp_path, mjcf(CUP + door, tail=tail), "b.xml"))


@pytest.mark.parametrize("place", [(0.03, 0.0, 0.15), (-0.01, 0.02, 0.3)])
@pytest.mark.parametrize("inner", ["{}", '<body name="finger" pos="0 0.1 0">{}</body>'])
def test_site_named_tip_is_the_tip_of_a_tool(tmp_path, place, inner):
    site = inner.format(f'<site name="tip" pos="{" ".join(map(str, place))}"/>')
    text = mjcf(f'<body name="hand" pos="1 2 3">{INERTIAL}{site}</body>')
    tool = Tool(model=str(written(tmp_path, text, "a.xml")))
    tip, offset = NominalSlave(Slave(tool=tool)).tip, [0.0, 0.1 * ("finger" in inner), 0.0]
    np.testing.assert_allclose(tip, np.add(place, offset), atol=1e-12)


@pytest.mark.parametrize("z", [0.1, 0.25])
@pytest.mark.parametrize("site", ["", '<site name="tip" pos="0 0 0.05"/>'])
def test_body_named_tip_is_the_tip_of_a_tool_also_beside_such_a_site(tmp_path, site, z):
    body = f'<body name="tip" pos="0.02 0 {z}">{site}</body>'
    text = mjcf(f'<body name="hand">{INERTIAL}{body}</body>')
    tool = Tool(model=str(written(tmp_path, text, "a.xml")))
    np.testing.assert_allclose(NominalSlave(Slave(tool=tool)).tip, [0.02, 0.0, z], atol=1e-12)


@pytest.mark.parametrize("root", ["", "<freejoint/>"])
def test_tool_has_one_free_root_and_held_joints(tmp_path, root):
    plant, _ = AddMultibodyPlantSceneGraph(DiagramBuilder(), 0.0)
    loop = '<equality><connect body1="f" body2="g" anchor="0 0 0"/></equality>'
    text = mjcf(f'<body name="hand" pos="1 2 3">{root}{INERTIAL}{FINGERS}</body>', tail=loop)
    body, assumptions = ParseTool(plant, written(tmp_path, text, "a.xml"), plant.world_frame())
    plant.Finalize()
    assert body.name() == "hand"
    assert "held: f, g" in assumptions
    assert plant.num_velocities() == 0
    X_WT = body.EvalPoseInWorld(plant.CreateDefaultContext())
    assert X_WT.IsExactlyIdentity()
