"""Start postures that `new` chooses: elbow up, shapes apart and above the base, any side."""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydrake.systems.framework import DiagramBuilder
from scipy.spatial.transform import Rotation

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.lab.identification import slave_arm
from drake_teleop.lab.new_station import scenario_text
from drake_teleop.lab.new_station.picture import draw_start_posture
from drake_teleop.lab.new_station.place import (
    _iter_posture_rows_by_score,
    _select_rows_far_from_limits_or_all,
    find_start_place,
    sensor_axis_along_tool,
)
from drake_teleop.lab.new_station.plan import plan_station
from drake_teleop.lab.new_station.random_postures import (
    Postures,
    _jacobian_singular_values,
    least_joint_margins,
    postures_at,
    random_postures,
    select_suitable_postures,
    sensor_degrees_of_freedom,
    upward_share_of_elbow_offset,
)
from drake_teleop.station.environment.solids import Wall
from drake_teleop.station.master.data_sheets import PHANTOM_NAME
from drake_teleop.station.scenario import LoadScenario
from drake_teleop.station.slave.arm import (
    IS_PRISMATIC_COLUMN,
    ROTATION_COLUMN,
    TRANSLATION_COLUMN,
    holding_torque,
    pose_into,
)
from drake_teleop.station.slave.numeric_inverse_kinematics import orientation_weight_m
from drake_teleop.station.slave.plant import AddSlavePlant, NominalSlave
from drake_teleop.station.slave.posture_shapes import (
    PostureShapes,
    overlap_warnings,
    start_overlap_texts,
)
from drake_teleop.station.slave.scene import Scene
from drake_teleop.station.slave.slave_config import Slave

pytestmark = pytest.mark.slow
_HALF = 0.5 * np.pi
MISSING_MESH = '<visual><geometry><mesh filename="link.stl"/></geometry></visual>'


def write_arm(path, *, base="0 0 0 0 0 0", ranges=()):
    """Write an arm with six joints; its shapes are boxes.

    Args:
        base: pose of the arm in the world.
        ranges: limits (lower, upper) of the joints by number [rad], where not +-pi.
    """
    limits = {k: (-np.pi, np.pi) for k in range(1, 7)} | dict(ranges)
    # Axis, origin of each joint, and length of its link along z.
    chain = [
        ("0 0 1", "0 0 0.1", 0.2),
        ("0 1 0", "0 0 0.2", 0.4),
        ("0 1 0", "0 0 0.4", 0.35),
        ("0 0 1", "0 0 0.2", 0.15),
        ("0 1 0", "0 0 0.15", 0.08),
        ("0 0 1", "0 0 0.08", 0.04),
    ]
    x, y, z, roll, pitch, yaw = base.split()
    links = [_link("base", 0.1, "0.3 0.3 0.02")]
    joints = [_joint("anchor", "fixed", "world", "base", f"{x} {y} {z}", f"{roll} {pitch} {yaw}")]
    for k, (axis, origin, length) in enumerate(chain, 1):
        links.append(_link(f"link{k}", length))
        parent = f"link{k - 1}" if k > 1 else "base"
        lower, upper = limits[k]
        motion = f'<axis xyz="{axis}"/><limit lower="{lower}" upper="{upper}" velocity="3"'
        joints.append(
            _joint(
                f"j{k}", "revolute", parent, f"link{k}", origin, "0 0 0", f'{motion} effort="300"/>'
            )
        )
    links.append('<link name="ft"/>')
    joints.append(_joint("flange", "fixed", "link6", "ft", "0 0 0.04"))
    path.write_text(
        f'<robot name="arm"><link name="world"/>{"".join(links)}{"".join(joints)}</robot>'
    )
    return path


def _link(name, length, plate=""):
    mass = '<mass value="1"/><inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/>'
    inertial = f'<inertial><origin xyz="0 0 {length / 2}"/>{mass}</inertial>'
    boxed = [(f"0.06 0.06 {length - 0.05 if length > 0.08 else 0.03}", length / 2)]
    boxed += [(plate, 0.01)] if plate else []
    shapes = "".join(
        f'<collision><origin xyz="0 0 {z}"/><geometry><box size="{size}"/></geometry></collision>'
        for size, z in boxed
    )
    return f'<link name="{name}">{inertial}{shapes}</link>'


def _joint(name, kind, parent, child, xyz, rpy="0 0 0", more=""):
    origin = f'<origin xyz="{xyz}" rpy="{rpy}"/>'
    links = f'<parent link="{parent}"/><child link="{child}"/>'
    return f'<joint name="{name}" type="{kind}">{links}{origin}{more}</joint>'


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """Return file and plan of an arm with boxes."""
    path = write_arm(tmp_path_factory.mktemp("plain") / "arm.urdf")
    return path, plan_station(path, "ft")


def elbow_of(plan):
    return upward_share_of_elbow_offset(
        postures_at(plan.posture_shapes.arm, plan.place.q[np.newaxis]), 1.0
    )[0]


def test_offset_of_a_nearly_straight_arm_has_no_direction():
    origins = np.zeros((3, 3, 3))
    origins[:, 2] = [0.0, 0.0, 1.0]
    origins[:, 1] = [[0.02, 0.0, 0.5], [0.3, 0.0, 0.5], [0.0, -0.3, 0.5]]
    origins[2, 2] = [0.8, 0.0, 0.6]
    postures = Postures(*[np.zeros((3, 3))], origins, origins, np.zeros((3, 3, 3)), origins[:, 2])
    line = np.array([0.8, 0.0, 0.6])
    offset = origins[2, 1] - (origins[2, 1] @ line) * line
    expected = [1.0, 0.0, offset[2] / np.linalg.norm(offset)]
    np.testing.assert_allclose(upward_share_of_elbow_offset(postures, 1.0), expected, atol=1e-12)


@pytest.mark.parametrize(
    ("before", "height", "com", "axis"),
    [
        (0.0, 0.1, [0.0, 0.0, 0.0], "y"),
        (0.0, 0.0, [0.0, 0.0, 0.0], "y"),
        (0.0, -0.1, [0.0, 0.0, 0.0], "-y"),
        (-0.2, 0.1, [0.0, 0.0, 0.0], "-y"),
        (0.2, -0.1, [0.0, -0.05, 0.0], "y"),
        (0.0, 0.1, [0.0, -0.2, 0.0], "-y"),
        (0.0, 0.1, [0.0, 0.0, 0.05], "z"),
        (0.0, 0.1, [0.0, 0.0, -0.3], "-z"),
    ],
)
def test_tool_axis_is_away_from_the_arm(before, height, com, axis):
    arm = slave_arm(LoadScenario("touch"))
    table = arm.table.copy()
    columns = slice(ROTATION_COLUMN, TRANSLATION_COLUMN + 3)
    table[-2, columns] = [1, 0, 0, 0, 1, 0, 0, 0, 1, 0.4, 0.5, before]
    table[-1, columns] = [0, 0, 1, 1, 0, 0, 0, 1, 0, 0.0, -0.3, height]
    assert sensor_axis_along_tool(replace(arm, table=table), np.array(com)) == axis


AXES = [
    ("0 -1.5707963 0", [1, 0, 0]),
    ("0 1.5707963 0", [-1, 0, 0]),
    ("1.5707963 0 0", [0, 1, 0]),
    ("3.1415927 0 0", [0, 0, -1]),
]


@pytest.mark.quick_cases(4)
@pytest.mark.parametrize(("rpy", "axis"), AXES)
@pytest.mark.parametrize("from_flange", [0.0, 0.1, 0.2])  # 0.2: S is at the end of the gripper
def test_gripper_of_the_model_points_down(from_flange, rpy, axis, tmp_path):
    path = write_arm(tmp_path / "arm.urdf")
    back = " ".join(f"{-float(angle)}" for angle in rpy.split())
    place = " ".join(map(str, -from_flange * np.array(axis)))
    gripper = _link("gripper", 0.2) + _joint("hold", "fixed", "ft", "gripper", place, back)
    flange = _joint("flange", "fixed", "link6", "ft", f"0 0 {0.04 + from_flange}", rpy)
    old = _joint("flange", "fixed", "link6", "ft", "0 0 0.04")
    path.write_text(path.read_text().replace(old, flange + gripper))
    plan = plan_station(path, "ft")
    assert plan.has_own_tool and plan.direction_at_start == "tool down"
    plan.posture_shapes.move_to(plan.place.q)
    down = plan.posture_shapes.X_WS.rotation().matrix() @ axis
    np.testing.assert_allclose(down, [0.0, 0.0, -1.0], atol=1e-3)
    assert plan.lowest_tool_point_W[2] < plan.place.position[2] - 0.17 + from_flange


def write_scara(path, flange, last_axis="0 0 1"):
    """Write a SCARA arm, whose last joint is below the joint before."""
    chain = [
        ("revolute", "0 0 0.4", "0 0 1", (-2.2, 2.2)),
        ("revolute", "0.25 0 0", "0 0 1", (-2.2, 2.2)),
        ("prismatic", "0.25 0 0", "0 0 1", (-0.2, 0.0)),
        ("revolute", "0 0 -0.05", last_axis, (-3.0, 3.0)),
    ]
    parts = [_link("link0", 0.1)]
    for k, (kind, origin, axis, (lower, upper)) in enumerate(chain):
        limits = f'<limit lower="{lower}" upper="{upper}" effort="200" velocity="2"/>'
        more = f'<axis xyz="{axis}"/>{limits}'
        parts.append(_joint(f"j{k}", kind, f"link{k}", f"link{k + 1}", origin, more=more))
        parts.append(_link(f"link{k + 1}", 0.04))
    parts += ['<link name="ft"/>', _joint("flange", "fixed", "link4", "ft", "0 0 0", flange)]
    path.write_text(f'<robot name="scara">{"".join(parts)}</robot>')
    return path


@pytest.mark.parametrize("last_axis", ["0 0 1", "0 0 -1"])
@pytest.mark.parametrize(("rpy", "axis"), [("0 0 0", [0, 0, -1]), ("3.1415927 0 0", [0, 0, 1])])
def test_rod_of_a_scara_points_down_for_each_sign(rpy, axis, last_axis, tmp_path):
    plan = plan_station(write_scara(tmp_path / "arm.urdf", rpy, last_axis), "ft")
    np.testing.assert_allclose(plan.stand_in_tool.com, 0.05 * np.array(axis), atol=1e-6)
    plan.posture_shapes.move_to(plan.place.q)
    R_WS = plan.posture_shapes.X_WS.rotation().matrix()
    np.testing.assert_allclose(R_WS @ axis, [0.0, 0.0, -1.0], atol=1e-6)
    assert plan.direction_at_start == "tool down" and not any(
        "away" in text for text in plan.assumptions
    )


def test_gripper_that_cannot_point_down_is_not_called_down(tmp_path):
    path = write_scara(tmp_path / "arm.urdf", "0 0 0")
    gripper = _link("gripper", 0.2) + _joint(
        "hold", "fixed", "ft", "gripper", "0 0 0", f"0 {_HALF} 0"
    )
    path.write_text(path.read_text().replace("</robot>", f"{gripper}</robot>"))
    plan = plan_station(path, "ft")
    assert plan.has_own_tool and plan.direction_at_start == "-z_S down"
    (text,) = [text for text in plan.assumptions if "away from the arm" in text]
    assert text.startswith(
        "-z_S points down at the start, because no posture was found in which x_S"
    )
    assert plan.tool_axis_advice.startswith("-z_S points down, so")
    model = {"model": str(path), "sensor_frame": "ft"}
    written = scenario_text(plan, model, None, PHANTOM_NAME, None)
    assert "-z_S down" in written and "tool down" not in written


def test_posture_of_weak_motors_holds_a_small_part_of_the_load():
    """The motors hold 5 % of the load in the first posture, in neither the whole load."""
    arm = slave_arm(LoadScenario("touch"))
    q = np.array([[0.0, -1.2, 1.9, 0.0, 0.9, 0.0], [0.0, 0.1, 1.4, 0.0, 0.1, 0.0]])
    whole = np.abs([holding_torque(arm, each) for each in q])
    part = np.abs([holding_torque(arm.with_load(0.05 * arm.phi_load), each) for each in q])
    limit = (np.maximum(0.5 * (whole[0] + part[0]), part[0]) + 1e-2) / 0.7
    assert (part[0] < 0.7 * limit).all() and (part[1] > 0.7 * limit).any()
    assert (whole > 0.7 * limit).any(axis=1).all()
    weak = replace(arm, effort_limit=limit)
    np.testing.assert_array_equal(_select_rows_far_from_limits_or_all(weak, q), [0])


def test_singular_values_agree_with_finite_differences_of_turning_and_sliding_joints():
    arm = slave_arm(LoadScenario("touch"))
    table, step = arm.table.copy(), 1e-6
    table[[1, 4], IS_PRISMATIC_COLUMN] = 1.0
    sliding, q = replace(arm, table=table), np.array([0.3, 0.2, 1.1, -0.4, 0.15, 0.6])
    moved = postures_at(sliding, q + step * np.vstack([np.eye(6), -np.eye(6)]))
    turns = Rotation.from_matrix(moved.R_WS[:6]) * Rotation.from_matrix(moved.R_WS[6:]).inv()
    linear = moved.p_WS[:6] - moved.p_WS[6:]
    columns = np.hstack([linear, orientation_weight_m(sliding) * turns.as_rotvec()]) / (2.0 * step)
    found = _jacobian_singular_values(sliding, postures_at(sliding, q[np.newaxis]))[0]
    np.testing.assert_allclose(found, np.linalg.svd(columns, compute_uv=False), atol=1e-8)


def slave_of(plan, path):
    return Slave(
        model=str(path), sensor_frame="ft", tool=plan.stand_in_tool, home=plan.place.q.tolist()
    )


def test_elbow_is_up_although_the_middle_of_the_ranges_is_elbow_down(tmp_path):
    """The middle of the ranges has the shoulder forward and the forearm back up."""
    trap = {2: (-1.2, 2.8), 3: (-2.9, 2.6), 5: (-2.9, 2.9)}
    path = write_arm(tmp_path / "arm.urdf", ranges=trap)
    plan = plan_station(path, "ft")
    assert elbow_of(plan) > 0.5
    plan.posture_shapes.move_to(plan.place.q)
    # The base link has a plate on the plane; all moving links are above it.
    assert plan.base_plane_height == pytest.approx(0.0, abs=1e-9)
    shapes = plan.posture_shapes
    assert shapes.points_on_bodies_W(shapes.moving_slave_bodies())[:, 2].min() > 0.02
    assert start_overlap_texts(slave_of(plan, path), plan.wall)[0] == ()
    assert plan.wall.position[2] < plan.lowest_tool_point_W[2] - 0.01


def test_arm_that_can_only_face_minus_y_starts_there(tmp_path):
    facing = {1: (-1.9, -1.2), 2: (0.0, 1.5), 3: (0.0, 2.6), 5: (0.0, 2.6)}
    path = write_arm(tmp_path / "arm.urdf", ranges=facing)
    x, y, _ = plan_station(path, "ft").place.position
    assert y < -0.2 and abs(x) < -y


@pytest.mark.parametrize("height", [0.0, 1.0])
def test_arm_on_a_torso_works_around_its_own_height(height, tmp_path):
    path = write_arm(tmp_path / "arm.urdf", base=f"0.4 -0.5 {height} 0 0 0")
    plan = plan_station(path, "ft")
    assert plan.base_plane_height == pytest.approx(height, abs=1e-6)
    assert height < plan.place.position[2] < height + 0.9
    assert np.hypot(*(plan.place.position[:2] - [0.4, -0.5])) > 0.25


@pytest.mark.parametrize(("height", "plane"), [(2.0, 0.0), (0.5, None)])
def test_hanging_arm_starts_below_its_base(height, plane, tmp_path):
    path = write_arm(tmp_path / "arm.urdf", base=f"0 0 {height} {np.pi} 0 0")
    plan = plan_station(path, "ft")
    sensor = plan.place.position[2]
    assert plan.direction_at_start == "tool down" and sensor < height - 0.3
    assert plan.base_plane_height < sensor
    assert plane is None or plan.base_plane_height == plane


def test_sticks_of_an_arm_without_shapes_are_not_the_base(tmp_path):
    path = write_arm(tmp_path / "arm.urdf")
    bare = re.sub("<collision>.*?</collision>", "", path.read_text())
    path.write_text(bare.replace("<inertial>", f"{MISSING_MESH}<inertial>"))
    plan = plan_station(path, "ft")
    assert plan.posture_shapes.has_sticks and plan.base_plane_height == 0.0
    caption = draw_start_posture(plan, "arm").get_supxlabel()
    assert "shapes of some links are missing, sticks replace them" in caption
    assert "base plane: z_W = 0 m;" in caption and "meshes" not in caption


def test_wall_of_a_start_is_free_of_the_arm_and_another_wall_is_reported(plain):
    path, plan = plain
    slave = slave_of(plan, path)
    assert start_overlap_texts(slave, plan.wall)[0] == ()
    elbow = postures_at(plan.posture_shapes.arm, plan.place.q[np.newaxis]).origins[0, 2]
    (said,) = [
        text
        for text in start_overlap_texts(slave, Wall(position=list(elbow)))[0]
        if "link3" in text
    ]
    assert said.startswith("link3 and wall overlap by ") and " mm at the start" in said
    assert said.endswith("move the object in environment, or give another start in slave.home")


def test_joints_without_limits_are_sampled_once_round_and_have_full_margin(plain):
    arm = plain[1].posture_shapes.arm
    endless = replace(
        arm,
        lower=np.array([-np.inf, *arm.lower[1:5], -np.inf]),
        upper=np.array([np.inf, *arm.upper[1:5], np.inf]),
    )
    drawn = random_postures(endless).q
    assert np.isfinite(drawn).all() and np.abs(drawn).max() <= np.pi
    assert least_joint_margins(endless, np.array([[9.0, 0, 0, 0, 0, -9.0]]))[0] == 1.0
    assert least_joint_margins(endless, np.array([[0.0, _HALF, 0, 0, 0, 0]]))[0] == pytest.approx(
        0.5
    )
    found = find_start_place(endless)
    assert found.cube_half_m > 0.0 and np.isfinite(found.q).all()


def test_reason_of_a_failure_counts_the_postures_of_each_condition(plain):
    arm = plain[1].posture_shapes.arm
    tilted = replace(arm, lower=arm.lower * 0.0 - 0.2, upper=arm.upper * 0.0 + 0.2)
    with pytest.raises(
        DrakeTeleopError, match=r"x_S points.*in 20000 this axis is more than 40 deg"
    ):
        find_start_place(tilted, axis="x")
    with pytest.raises(DrakeTeleopError, match=r"in \d+ S is too near .*; 0 are left"):
        find_start_place(arm, plane=5.0)


def test_frames_and_degrees_of_freedom_follow_the_joints(plain):
    arm = plain[1].posture_shapes.arm
    at_random = random_postures(arm)
    for k in (0, 17, 4000):
        pose = np.empty(7)
        pose_into(arm.table, at_random.q[k], pose)
        np.testing.assert_allclose(at_random.p_WS[k], pose[4:], atol=1e-12)
        z = 1 - 2 * (pose[1] ** 2 + pose[2] ** 2)
        assert at_random.R_WS[k, 2, 2] == pytest.approx(z, abs=1e-12)
    assert sensor_degrees_of_freedom(arm, at_random) == 6
    # With two wrist joints at rest, the sensor moves in four directions.
    table = np.delete(arm.table, [3, 5], axis=0)
    names = ("joint_names", "lower", "upper", "velocity_limit", "effort_limit")
    fewer = {n: tuple(getattr(arm, n)[k] for k in (0, 1, 2, 4)) for n in names}
    short = replace(
        arm, table=table, **{n: v if n == names[0] else np.array(v) for n, v in fewer.items()}
    )
    assert sensor_degrees_of_freedom(short, random_postures(short)) == 4


@pytest.mark.parametrize("included", [False, True])
def test_edited_scene_is_examined_again(tmp_path, included):
    """The file of a scene, or one that it includes, moves a box into the tool."""
    pad, scene = tmp_path / "pad.sdf", Scene(file=str(tmp_path / "pad.sdf"))
    if included:
        scene.file = str(tmp_path / "table.dmd.yaml")
        Path(scene.file).write_text(f"directives: [add_model: {{name: a, file: {pad.as_uri()}}}]")
    for time, (height, overlaps) in enumerate(((0.0, 0), (0.3, 1), (0.1, 0))):
        shape = f"<pose>0.55 0 {height} 0 0 0</pose><geometry><box><size>0.3 0.3 0.1</size></box>"
        link = f'<link name="pad"><collision name="c">{shape}</geometry></collision></link>'
        pad.write_text(f'<sdf version="1.9"><model name="pad">{link}</model></sdf>')
        os.utime(pad, ns=(time, time))
        warnings = start_overlap_texts(Slave(), scene)[0]
        assert sum("tool and pad overlap by" in text for text in warnings) == overlaps


def test_bodies_that_overlap_by_design_are_not_reported(plain, tmp_path):
    path = write_arm(tmp_path / "arm.urdf")
    # The hull of the forearm encloses the wrist, two joints further, in all postures.
    text = path.read_text().replace('<box size="0.06 0.06 0.3"/>', '<box size="0.3 0.3 0.9"/>', 1)
    path.write_text(text)
    shapes = PostureShapes(Slave(model=str(path), sensor_frame="ft", tool=plain[1].stand_in_tool))
    shapes.move_to(np.full(6, 0.3))
    assert not any(
        {first.name(), second.name()} == {"link3", "link5"}
        for first, second, _ in shapes.overlaps()
    )
    (said,) = [text for text in shapes.assumptions if "overlaps left out" in text]
    assert "link3 and link5" in said and "link1" not in said
    slave = Slave(model=str(path), sensor_frame="ft", tool=plain[1].stand_in_tool, home=[0.3] * 6)
    assert said in start_overlap_texts(slave, None)[1]


def test_start_is_free_although_shapes_overlap_in_most_postures(tmp_path):
    """Link 4 overlaps link 2 in most postures; the start avoids it, and the check remains."""
    path = write_arm(tmp_path / "arm.urdf", ranges={3: (-2.6, 2.6)})
    plate = '<collision><origin xyz="0 0 -0.02"/><geometry><box size="0.3 0.02 0.4"/></geometry>'
    link = '<link name="link4">'
    path.write_text(path.read_text().replace(link, f"{link}{plate}</collision>"))
    plan = plan_station(path, "ft")
    shapes = plan.posture_shapes
    random = np.random.default_rng(8).uniform(shapes.arm.lower, shapes.arm.upper, (200, 6))
    counts = []
    for q in random:
        shapes.move_to(q)
        near = [{first.name(), second.name()} for first, second, _ in shapes.overlaps()]
        counts.append({"link2", "link4"} in near)
    assert 0.6 < np.mean(counts) < 0.95
    assert start_overlap_texts(slave_of(plan, path), plan.wall)[0] == () == plan.overlap_warnings
    assert not any("link2 and link4" in text for text in plan.assumptions)


def test_postures_of_all_ranks_are_checked_if_the_best_ones_overlap(plain):
    shapes = plain[1].posture_shapes
    postures, region = select_suitable_postures(random_postures(shapes.arm), 0.0, 0.1)
    usable, clear, clear_of_all = _iter_posture_rows_by_score(shapes.arm, postures, region, shapes)
    expected = _select_rows_far_from_limits_or_all(shapes.arm, postures.q)
    np.testing.assert_array_equal(np.sort(usable), np.sort(expected))
    assert 3 < len(clear) < len(usable) < len(postures.q)
    assert set(clear) <= set(usable) and not set(clear_of_all) <= set(usable)
    for row in usable[:: len(usable) // 500 + 1]:
        shapes.move_to(postures.q[row])
        assert (row in clear) != bool(overlap_warnings(shapes, slave_only=True))
    (only,) = _iter_posture_rows_by_score(shapes.arm, postures, region, None)
    np.testing.assert_array_equal(only, usable)


def test_links_of_a_telescope_may_overlap_and_a_gantry_may_not(tmp_path):
    def arm(last_axis):
        text = write_arm(tmp_path / "arm.urdf").read_text()
        axes = {1: "0 0 1", 2: "0 0 1", 3: last_axis}
        for k, axis in axes.items():
            start = text.index(f'<joint name="j{k}" type="revolute">')
            end = text.index("</joint>", start)
            slide = text[start:end].replace("revolute", "prismatic")
            slide = slide[: slide.index("<axis")] + f'<axis xyz="{axis}"/>'
            limit = '<limit lower="0" upper="0.1" velocity="1" effort="300"/>'
            text = text[:start] + slide + limit + text[end:]
        path = tmp_path / f"{last_axis[:1]}.urdf"
        path.write_text(text.replace('xyz="0 0 0.4"', 'xyz="0 0 -0.2"'))
        shapes = PostureShapes(Slave(model=str(path), sensor_frame="ft"))
        shapes.move_to(np.zeros(6))
        near = [f"{first.name()} and {second.name()}" for first, second, _ in shapes.overlaps()]
        return [*near, *(text for text in shapes.assumptions if "overlaps left out" in text)]

    assert not any("link1 and link3" in text for text in arm("0 0 1"))
    assert any("link1 and link3" in text for text in arm("1 0 0"))


@pytest.mark.parametrize(("effort", "weak"), [(300, ()), (4, ("j2", "j3"))])
def test_torque_limits_that_cannot_hold_the_arm_are_left_out_and_stated(tmp_path, effort, weak):
    path = write_arm(tmp_path / "arm.urdf")
    path.write_text(path.read_text().replace('effort="300"', f'effort="{effort}"'))
    plan = plan_station(path, "ft")
    assert set(plan.weak_joints) <= set(weak) and bool(plan.weak_joints) == bool(weak)
    stated = [text for text in plan.assumptions if text.startswith("no torque limit for j")]
    assert len(stated) == len(plan.weak_joints)
    text = scenario_text(plan, {"model": str(path), "sensor_frame": "ft"}, None, PHANTOM_NAME, None)
    scenario = tmp_path / "station.yaml"
    scenario.write_text(text)
    slave = LoadScenario(scenario).slave
    assert slave.torque_limits == dict.fromkeys(plan.weak_joints, np.inf)
    arm = AddSlavePlant(DiagramBuilder(), slave, None).arm
    np.testing.assert_array_equal(
        np.isinf(arm.effort_limit), np.isin(arm.joint_names, plan.weak_joints)
    )


def test_weak_arm_with_a_heavy_tool_of_the_user_keeps_its_limits(plain, tmp_path):
    path, _ = plain
    tool = tmp_path / "tool.sdf"
    tool.write_text(
        '<sdf version="1.9"><model name="t"><link name="t"><inertial><pose>0 0 0.1 0 0 0</pose>'
        "<mass>500</mass></inertial></link></model></sdf>"
    )
    plan = plan_station(path, "ft", tool=tool)
    assert plan.weak_joints == ()


@pytest.mark.parametrize("low", [-0.01, 0.02])
def test_joints_of_a_mobile_base_may_be_at_the_base_plane(low: float) -> None:
    """Joints that no posture raises belong to the base; another joint below the plane counts."""
    count = 60
    origins = np.full((count, 4, 3), 0.5)
    origins[:, :2, 2] = low
    origins[:20, 3, 2] = -0.1
    p_WS = np.tile([0.6, 0.0, 0.4], (count, 1))
    p_WS[:, 0] += np.linspace(0.0, 0.2, count)
    origins[:, 0, :2] = 0.0
    R_WS = np.tile(np.diag([1.0, -1.0, -1.0]), (count, 1, 1))
    axes = np.tile([0.0, 0.0, 1.0], (count, 4, 1))
    kept, region = select_suitable_postures(
        Postures(np.zeros((count, 4)), origins, axes, R_WS, p_WS), 0.0, 0.1
    )
    assert region.can_joint_be_above_plane.tolist() == [False, False, True, True]
    assert region.removed_counts[2] == ("a joint is below the base plane", 20)
    assert (kept.origins[:, 3, 2] > 0.0).all() and len(kept.q) > 0


@pytest.mark.parametrize("share", [0.5, 1.5])
def test_postures_that_the_motors_cannot_hold_are_left_out(share: float) -> None:
    """The station's error names joint and torque if no posture can be held."""
    arm = NominalSlave(Slave()).arm
    q = np.random.default_rng(3).uniform(arm.lower, arm.upper, (40, arm.num_joints))
    torque = np.abs([holding_torque(arm, each) for each in q])
    limit = np.quantile(torque, 0.8, axis=0) if share < 1.0 else 0.1 * torque.min(axis=0)
    weak = replace(arm, effort_limit=limit)
    kept = q[_select_rows_far_from_limits_or_all(weak, q)]
    roomy = least_joint_margins(weak, q) > 0.22
    assert 0 < roomy.sum() < len(q)
    if share > 1.0:
        np.testing.assert_array_equal(kept, q[roomy])
    else:
        expected = q[(torque < 0.7 * limit).all(axis=1) & roomy]
        assert 0 < len(expected) < len(q)
        np.testing.assert_array_equal(kept, expected)
